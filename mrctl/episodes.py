"""The closed loop as episodes for environments: somebody else acts, and robots begin again one by one."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from mrctl import result
from mrctl.control.kanayama import posture_error
from mrctl.plant import OMEGA, RATE_LEFT, RATE_RIGHT, STEERING, THETA, V, X
from mrctl.record import InputError
from mrctl.robot import Robot
from mrctl.scenario import Scenario
from mrctl.simulate import Simulation, course, start_pose, tick_of

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
_ERROR = slice(list(result.SIGNALS).index("longitudinal_error"), list(result.SIGNALS).index("heading_error") + 1)


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
        if (
            len({(s.world, s.steering, s.feedforward, s.ticks, s.physics_step, s.control_period) for s in scenarios})
            > 1
        ):
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
        order = list(self._courses)
        names = [(s.reference, *((e.time, e.reference) for e in s.events if e.reference)) for s in self.scenarios]
        self._which_course = np.array([order.index(name) for name in names])
        self._since = np.zeros(len(names), int)

    def _reference_now(self) -> Array:
        return self._table[np.minimum(self.tick - self._since, self.ticks), self._which_course]

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
        self._perturb(row, scenario.perturbation)
        start = self._reference_now()
        self.plant.restart(row, start_pose(scenario, start[row, :3]), start[row, 3:5])
        reading, sensor = self.plant.reading, self._sensors[row]
        self.hierarchy.reset(start[:, 3:5], start[:, 5:], reading[:, STEERING], row)
        sensor["pose"], sensor["twist"] = reading[row, X : THETA + 1], reading[row, V : OMEGA + 1]
        sensor["elapsed"] = 0.0
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

    def observe(self) -> dict[str, Array]:
        """What the robots see at the coming tick, by the names of `OBSERVATIONS`, `(B, n)`."""
        self.sense()
        reading, goal = self.plant.reading, self._goal
        error = np.empty_like(self._pose)
        posture_error(self._pose, goal[:, :3], error)
        seen = {
            "error": error,
            "twist": self._twist.copy(),
            "reference": goal[:, 3:].copy(),
            "wheel_rates": reading[:, [RATE_LEFT, RATE_RIGHT]],
            "steering_angle": reading[:, [STEERING]],
            "voltage": self.hierarchy.output[:, :2].copy(),
        }
        if self.plant.running < self.plant.size:  # a robot that blew up
            seen = {name: np.nan_to_num(value, posinf=0.0, neginf=0.0) for name, value in seen.items()}
        return seen

    def reward(self) -> Array:
        """One on the reference, a half where the rear wheels are 5 cm off, zero where a robot has failed, `(B,)`.

        The distance is the root mean square of the two wheels', √(e_x² + e_y² + (D e_θ)²), of the true posture.
        """
        self.sense()
        error = self._row[:, _ERROR]
        square = error[:, 0] ** 2 + error[:, 1] ** 2 + (self.plant.robot.half_track * error[:, 2]) ** 2
        return np.where(self.plant.failed, 0.0, 1 / (1 + square / NEAR**2))

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
