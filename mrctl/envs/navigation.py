"""Navigation as episodes: a robot with a lidar gets a goal, and an agent requests its twists."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mrctl.control.kanayama import posture_error
from mrctl.envs.episodes import AgentMotion, Draw, Episodes, read
from mrctl.kernel import Array, Rows
from mrctl.navigation.planning import prepared
from mrctl.navigation.tasks import task_of
from mrctl.record import InputError
from mrctl.scenario import Scenario
from mrctl.theory.rays import Scan

END_REWARD = 1.0  # reward of an arrival, and minus that of a failure
DEFAULT_WORLD = "doorway:3"  # of the default mission


class Looking(AgentMotion):
    """An agent with a lidar, whose scans are parts of its observations."""

    def see(self, row: int, scan: Scan) -> None:
        """Does nothing, because the observation already contains the scan."""


class Navigating(Episodes):
    """Episodes in which an action is a requested twist, and which end at the goal of the scenario.

    The reference of the scenario determines only how long an episode may last, and with what twist it begins. The lidar
    is `sensing.lidar`. It scans at the first tick of an episode and then at its rate; where `sensing.localisation` uses
    the lidar, the agent gets the same scans.
    """

    agent = Looking

    def __init__(self, scenarios: Sequence[Scenario], *, draw: Draw | None = None, threads: int = 0) -> None:
        """Stands the robots at their starts.

        Args:
            scenarios: One for each robot, with the same lidar.
            draw: As for `Episodes`.
            threads: Number of threads of the batch engine; 0 for all cores.

        Raises:
            InputError: As `Episodes`; or a scenario has no goal, the lidars differ, or the time between two scans is
                not a whole number of control periods.
        """
        self._lidar = scenarios[0].sensing.lidar
        if any(s.goal is None for s in scenarios):
            raise InputError("goal: navigation needs one")
        if any(s.sensing.lidar != self._lidar for s in scenarios):
            raise InputError("sensing.lidar: the robots of one environment must have the same lidar")
        super().__init__(scenarios, "twist", draw=draw, threads=threads)
        beams, free = self._lidar.beams, np.full(5, np.inf)
        self.sizes = {"goal": 3, "twist": 2, "scan": beams}
        self.limits = np.append(-free, np.zeros(beams)), np.append(free, np.full(beams, self._lidar.range))
        far = self._lidar.range
        self.scale = np.array([far, far, np.pi, *self.bound, *[far] * beams])
        self._scans = np.zeros((len(scenarios), beams))  # ranges in m
        self._away, self._drives = self._distance(), np.ones(len(scenarios), bool)
        self._reward = np.zeros(len(scenarios))

    def _begin(self, row: int, scenario: Scenario) -> None:
        """Begins an episode of one robot; see `Episodes._begin`."""
        super()._begin(row, scenario)
        self._away[row], self._reward[row] = self._distance()[row], 0.0

    def sense(self) -> tuple[Rows, Rows]:
        """Measures as `Episodes.sense`, and takes the scans of this tick."""
        found, scanner = super().sense(), self.loop.estimator.scanner
        assert scanner is not None
        for row in np.flatnonzero(scanner.taken == self.tick):
            ranges = scanner.scans[row]
            assert ranges is not None
            self._scans[row] = np.minimum(ranges, self._lidar.range)
        return found

    def send(self) -> None:
        """Sends as `Episodes.send`, and notes which robots still drive."""
        self._drives = ~self.plant.stopped
        super().send()

    def settle(self) -> None:
        """Settles as `Episodes.settle`, and computes the reward of the tick."""
        super().settle()
        before, self._away = self._away, self._distance()
        end = np.where(self.arrived(), END_REWARD, -END_REWARD) * self.ended()[0]
        self._reward = np.where(self._drives, np.nan_to_num(before - self._away) + end, 0.0)

    def metrics(self, row: int) -> dict[str, float]:
        """Returns no metrics, since a robot that gets a goal follows no reference."""
        return {}

    def _distance(self) -> Array:
        """Returns the straight-line distances of the robots from their goals in m, `(B,)`."""
        return np.hypot(*(self.plant.reading["pose"][:, :2] - self.goals[:, :2]).T)

    def observe(self) -> tuple[Array, Array]:
        """Returns the observations for the coming tick, and the rewards of the last one.

        Returns:
            Observations, `(B, n)`, with the parts in `sizes` side by side: the estimated posture error from the goal in
            the robot's frame in m, m, rad, and the estimated V and θ̇ in m/s and rad/s, both at the time when the twist
            acts; and the ranges of the last scan in m, with the largest range where nothing returned. Rewards, `(B,)`:
            the decrease of the true distance to the goal in m, plus one on arrival, minus one on a failure.
        """
        seen, _ = self.sense()
        found = np.empty((len(self.scenarios), len(self.limits[0])))
        for row, own in enumerate(found):
            posture_error.compiled(seen["pose"][row], self.goals[row], own[:3])
        found[:, 3:5], found[:, 5:] = seen["twist"], self._scans
        found[self.plant.stopped] = np.nan_to_num(found[self.plant.stopped], posinf=0, neginf=0)  # may have diverged
        return found, self._reward.copy()


def read_mission(scenario: Scenario | str | Path | None) -> Scenario:
    """Returns a scenario, that in a file, or by default a mission through a door.

    Raises:
        InputError: The file is not a valid scenario.
    """
    return prepared(task_of(DEFAULT_WORLD, Scenario()), Scenario())[1] if scenario is None else read(scenario)
