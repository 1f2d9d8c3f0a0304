"""The closed loop as episodes for environments: somebody else acts, and robots begin again one by one."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numba import float64, njit
from numpy.typing import NDArray

from mrctl.control.chain import GIVEN, OWN, one, rows, stamp
from mrctl.control.kanayama import posture_error
from mrctl.loop.hierarchy import STATE as CONTROLLER
from mrctl.loop.simulation import SENSORS, Simulation, course, group_of, start_pose, tick_of
from mrctl.physics.plant import OMEGA, RATE_LEFT, RATE_RIGHT, STEERING, THETA, V, X
from mrctl.physics.plant import STATE as ROBOT
from mrctl.record import InputError
from mrctl.results import dataset as result
from mrctl.scenario import Scenario
from mrctl.theory.robot import Robot

Array = NDArray[np.float64]
Action = Literal["twist", "voltage", "residual"]
ACTIONS: tuple[Action, ...] = ("twist", "voltage", "residual")

OBSERVATIONS: dict[str, int] = {
    "error": 3, "twist": 2, "reference": 4, "wheel_rates": 2, "steering_angle": 1, "voltage": 2,
}  # fmt: skip
"""Names and sizes: measured posture error in the robot's frame (m, m, rad); measured V and θ̇ (m/s, rad/s); those of the
reference and their derivatives; rates of the rear wheels (rad/s); angle of the fork (rad); voltages sent last (V)."""
RESIDUAL = 0.25  # of the supply, what a residual may add
NEAR = 0.05  # m off the reference at which the reward is a half
_ERROR = list(result.SIGNALS).index("longitudinal_error")  # and lateral, and heading
_posture_error = one(posture_error)


def _compile(version: int) -> Callable[..., Any]:
    """What `observe` gives; see `chain.stamp` for the version."""

    @njit((rows(ROBOT), rows(SENSORS), rows(CONTROLLER), GIVEN, GIVEN, float64, OWN, float64[::1]), cache=True)
    def see(robots, sensors, controllers, goal, record, half_track, seen, reward):  # noqa: ANN001, ANN202
        _ = version
        for i in range(len(robots)):
            r, s, out = robots[i], sensors[i], seen[i]
            _posture_error(s.pose, goal[i, :3], out[:3])
            out[3:5], out[5:9] = s.twist, goal[i, 3:]
            out[9], out[10], out[11] = r.reading[RATE_LEFT], r.reading[RATE_RIGHT], r.reading[STEERING]
            out[12:] = controllers[i].output[:2]
            x, y, theta = record[i, _ERROR], record[i, _ERROR + 1], half_track * record[i, _ERROR + 2]
            reward[i] = 1 / (1 + (x * x + y * y + theta * theta) / NEAR**2)
            if r.failed:
                reward[i] = 0.0
                for k in range(len(out)):  # it may have blown up
                    if not np.isfinite(out[k]):
                        out[k] = 0.0

    return see


_see = _compile(stamp(posture_error))


class Given:
    """A motion controller that asks for the action."""

    def __init__(self, robot: Robot, size: int) -> None:
        """Takes the number of robots."""
        self.request = np.zeros((size, 2))

    def reset(self, pose: Array, reference: Array, period: float) -> None:
        """Nothing to begin."""

    def output(self, pose: Array, twist: Array, reference: Array) -> Array:
        """The action."""
        return self.request


class Episodes(Simulation):
    """`Simulation` with an action a tick; each robot's clock runs from its own start, and only the last tick is kept.

    An episode has the bits of the same scenario under `simulate`, whatever its neighbours do and whenever it begins.

    - `twist`: the action is the requested twist, m/s and rad/s, in place of the motion controller.
    - `voltage`: the voltages left and right in V, in place of both controllers; the fork follows the reference.
    - `residual`: volts left and right on top of what the controllers command.

    Attributes:
        bound: Largest action of each component, `(2,)`.
    """

    def __init__(self, scenarios: Sequence[Scenario], action: Action, *, threads: int = 0) -> None:
        """Stands the robots on their references.

        Args:
            scenarios: One a robot, which may differ in what `simulate` may run together.
            action: What an action is.
            threads: Of the batch engine; 0 for all cores.

        Raises:
            InputError: As `simulate`, an unknown action, or scenarios that cannot run together.
        """
        first = scenarios[0]
        if action not in ACTIONS:
            raise InputError(f"action: {action!r} is not {', '.join(ACTIONS)}")
        if len(set(map(group_of, scenarios))) > 1:
            raise InputError("scenarios: differ in world, steering, feedforward, length or rates")
        if len(scenarios) > 1 and first.motion_period != first.control_period:
            raise InputError("motion_period: robots that begin at different times need that of control_period")
        if action == "voltage":  # nobody shall learn from feedback that does not act
            scenarios = [s.model_copy(update={"feedforward": "none"}) for s in scenarios]
        self._given: Given | None = None
        super().__init__(scenarios, threads=threads, motion=self._give if action == "twist" else None)
        self._action = np.zeros((len(scenarios), 2)) if self._given is None else self._given.request
        self.override = {"twist": None, "voltage": self._replace, "residual": self._add}[action]
        robot = self.plant.robot
        self._supply = robot.supply
        limits = robot.max_speed, robot.max_rotation
        share = RESIDUAL if action == "residual" else 1.0
        self.bound = np.array(limits if action == "twist" else [share * robot.supply] * 2)
        self.log = np.full((2, len(scenarios), len(result.SIGNALS)), np.nan)

    def _give(self, robot: Robot, size: int) -> Given:
        self._given = Given(robot, size)
        return self._given

    def _replace(self, output: Array) -> None:
        output[:, :2] = np.clip(self._action, -self._supply, self._supply)

    def _add(self, output: Array) -> None:
        output[:, :2] = np.clip(output[:, :2] + self._action, -self._supply, self._supply)

    @property
    def _row(self) -> Array:
        return self.log[self.tick % 2]

    def _plan(self) -> None:
        """Samples every course once, to the end of the episode and one tick more."""
        super()._plan()
        whole, end = range(self.ticks), range(self.ticks, self.ticks + 1)
        courses = [np.vstack([course(s, whole), course(s, end)]) for s in self._courses.values()]
        self._table = np.stack(courses, axis=1)
        self._since = np.zeros(len(self.scenarios), int)

    def _reference_now(self) -> Array:
        return self._table[np.minimum(self.tick - self._since, self.ticks), self._place]

    def begin(self, row: int, seed: int) -> None:
        """Begins another episode of one robot at the coming tick, which must not be sensed yet.

        Args:
            row: Which.
            seed: Of its scenario from now on.
        """
        scenario = self.scenarios[row] = self.scenarios[row].model_copy(update={"seed": seed})
        self._since[row] = self.tick
        coming = {t: [e for e in some if e[0] != row] for t, some in self._schedule.items() if t >= self.tick}
        self._schedule = defaultdict(list, coming)
        for event in sorted(scenario.events, key=lambda e: e.time):
            self._schedule[self.tick + tick_of(event, self._period)].append((row, event))
        self._random[row] = np.random.default_rng([seed, 2])
        self.hierarchy.renew(row, scenario)
        if any(event.perturbation for event in scenario.events):
            self._perturb(row, scenario.perturbation)
        else:
            self._noise[row] = 0.0
            if self._oracle:
                self._oracle.set_robot(row, self.plant.truth[row])
        start = self._reference_now()
        self.plant.restart(row, start_pose(scenario, start[row, :3]), start[row, 3:5])
        reading, sensor = self.plant.reading, self._sensors[row]
        self.hierarchy.reset(start[:, 3:5], start[:, 5:], reading[:, STEERING], row)
        sensor["pose"], sensor["twist"] = reading[row, X : THETA + 1], reading[row, V : OMEGA + 1]
        sensor["elapsed"] = sensor["slip"] = 0.0
        self._failure_time[row] = np.nan
        self._action[row] = 0.0

    def begin_all(self, seeds: Sequence[int]) -> None:
        """Begins another episode of every robot."""
        self._sensed = -1
        if len(seeds) == 1:
            self.hierarchy.restart_clock()
        for row, seed in enumerate(seeds):
            self.begin(row, seed)

    def act(self, action: Array) -> None:
        """Sets the action of the coming tick, `(B, 2)`."""
        self._action[:] = action

    def observe(self) -> tuple[Array, Array]:
        """What the robots see at the coming tick, and what the last one was worth.

        Returns:
            The numbers that `OBSERVATIONS` names side by side, `(B, 14)`. And the reward, `(B,)`: one on the reference,
            a half where the rear wheels are 5 cm off, zero where a robot has failed. That distance is the root mean
            square of the two wheels', √(e_x² + e_y² + (D e_θ)²), of the true posture.
        """
        self.sense()
        size, half_track = len(self.scenarios), self.plant.robot.half_track
        seen, reward = np.empty((size, sum(OBSERVATIONS.values()))), np.empty(size)
        _see(self.plant.state, self._sensors, self.hierarchy.state, self._goal, self._row, half_track, seen, reward)
        return seen, reward

    def over(self) -> NDArray[np.bool]:
        """Which robots have driven their scenario to the end, `(B,)`."""
        return self.tick - self._since >= self.ticks


def read(scenario: Scenario | str | Path | None) -> Scenario:
    """A scenario as environments take it: itself, its file, or by default one lap.

    Raises:
        InputError: The file is bad.
    """
    if isinstance(scenario, Scenario):
        return scenario
    return Scenario(laps=1) if scenario is None else Scenario.from_toml(scenario)
