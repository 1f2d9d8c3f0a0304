"""The closed loop as episodes for environments: an agent acts, and each robot begins new episodes on its own."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mrctl.control.kanayama import posture_error
from mrctl.kernel import Array, Rows, kernel
from mrctl.loop.simulation import Simulation
from mrctl.record import InputError
from mrctl.scenario import Scenario
from mrctl.theory.perturbation import Perturbation
from mrctl.theory.robot import Robot

Action = Literal["twist", "voltage", "residual"]
Draw = Callable[[np.random.Generator], Perturbation | Mapping[str, Any]]
"""Function that draws the perturbation of an episode at random, such as `PERTURBATIONS["all"].drawn`."""
ACTION_KINDS: tuple[Action, ...] = ("twist", "voltage", "residual")

OBSERVATIONS: dict[str, int] = {
    "error": 3, "twist": 2, "reference": 4, "wheel_rates": 2, "steering_angle": 1, "voltage": 2,
}  # fmt: skip
"""Parts of an observation with their sizes: estimated posture error in the robot's frame (m, m, rad); estimated V and
θ̇ (m/s, rad/s); V and θ̇ of the reference with their derivatives; rates of the rear wheels from the encoders (rad/s);
commanded steering angle (rad); voltages sent last (V)."""
EPISODE_METRICS = ("v_rmse", "omega_rmse", "position_rmse")
"""Metrics of an episode, root mean squares over all its laps as of `results.metrics.over_laps`: m/s, rad/s and m."""
MAX_SEEDS = 2**32  # number of seeds that a scenario can have
MAX_RESIDUAL = 0.25  # largest residual, as a share of the supply
HALF_REWARD_DISTANCE = 0.05  # distance from the reference in m at which the reward is a half


@kernel
def observe(
    plant: Rows, seen: Rows, wanted: Rows, now: Rows, control: Rows, there: NDArray[np.bool], radius: float,
    half_track: float, observation: Array, reward: Array,
) -> None:  # fmt: skip
    """Computes what `Episodes.observe` returns, from the `PLANT`, `SEEN`, `REFERENCE` and `CONTROL` of each robot.

    The observation uses the reference `wanted` at the time when the voltage acts, the reward the present one, `now`.
    """
    error = np.empty(3)
    for i in range(len(plant)):
        p, s, g, out = plant[i], seen[i], wanted[i], observation[i]
        posture_error(s.pose, g.pose, out[:3])
        posture_error(p.reading.pose, now[i].pose, error)
        for k in range(2):
            out[3 + k], out[5 + k], out[7 + k] = s.twist[k], g.twist[k], g.acceleration[k]
            out[9 + k], out[12 + k] = s.wheel_speeds[k] / radius, control[i].allocation.command[k]
        out[11] = control[i].allocation.angle
        x, y, theta = error[0], error[1], half_track * error[2]
        reward[i] = 1 / (1 + (x * x + y * y + theta * theta) / HALF_REWARD_DISTANCE**2)
        if p.stopped and not there[i]:
            reward[i] = 0.0
            for k in range(len(out)):  # the state may have diverged
                if not np.isfinite(out[k]):
                    out[k] = 0.0


@kernel
def add_squares(ticks: Rows, squares: Array) -> None:
    """Adds the squares of the errors of V, θ̇ and position of one control tick of all robots, `(B, 3)`."""
    for i in range(len(ticks)):
        t, total = ticks[i], squares[i]
        total[0] += (t.v - t.v_ref) ** 2
        total[1] += (t.omega - t.omega_ref) ** 2
        total[2] += (t.x_ref - t.x) ** 2 + (t.y_ref - t.y) ** 2


class AgentMotion:
    """A motion controller whose request is the agent's action."""

    def __init__(self, robot: Robot, size: int) -> None:
        """Takes the robot and the number of robots B."""
        self.request = np.zeros((size, 2))

    def reset(self, pose: Array, reference: Array, period: float) -> None:
        """Does nothing, because this controller has no state."""

    def output(self, pose: Array, twist: Array, reference: Array) -> Array:
        """Returns the action as the requested twist, `(B, 2)` in m/s and rad/s."""
        return self.request


class Episodes:
    """A closed loop with an action in each tick; each robot's clock has its own start, and only one tick is logged.

    An episode has the same bits as its scenario under `simulate`, whatever its neighbours do and whenever it begins.

    - `twist`: the action is the requested twist, m/s and rad/s, in place of the motion controller.
    - `voltage`: the voltages left and right in V, in place of both controllers; the steering follows the reference.
    - `residual`: voltages left and right in V that are added to those of the controllers, cut off at `bound`.

    With voltages `pid.retune` of the scenarios is False, for `simulate` too if it is to have the same bits: what an
    agent does to them is no oscillation of a loop.

    Attributes:
        loop: The simulation, of which this class takes a tick apart: `sense`, `send`, the physics, `settle`.
        plant: Its physics.
        log: Its log, which keeps the last tick.
        period: Control period in s.
        start: Tick at which the episode of each robot began, `(B,)`.
        goals: Goals of the scenarios in m, m, rad, `(B, 3)`; NaN for none.
        bound: Largest action of each component, `(2,)`.
        scale: Divisors that bring the numbers of an observation to about 1, `(n,)`: 5 cm for the posture error (of the
            rear wheels, for its angle), the robot's limits for twists, reference, wheels and steering, and its supply
            for voltages.
        sizes: Names and sizes of the parts of an observation, in their order.
        limits: Least and largest value of each number of an observation, `(n,)` each.
        agent: Motion controller through which an agent requests twists.
    """

    agent: type[AgentMotion] = AgentMotion

    def __init__(
        self, scenarios: Sequence[Scenario], action: Action, *, draw: Draw | None = None, threads: int = 0
    ) -> None:
        """Stands the robots on their references.

        Args:
            scenarios: One for each robot; they must fit one batch.
            action: Meaning of an action, as the class says.
            draw: Draws the perturbation of every episode, in place of the scenario's, from a generator that the
                episode's seed determines; with `scenario.perturbation.drawn` the episode of seed k is replicate k of
                `replicates`, if no event changes the perturbation.
            threads: Number of threads of the batch engine; 0 for all cores.

        Raises:
            InputError: As `simulate`; or the action is unknown, `draw` is no function, or the scenarios cannot run
                together.
        """
        first = scenarios[0]
        if draw is not None and not callable(draw):
            raise InputError("draw: must be a function of a random generator, such as mrctl.PERTURBATIONS['all'].drawn")
        if action not in ACTION_KINDS:
            raise InputError(f"action: {action!r} is not {', '.join(ACTION_KINDS)}")
        if len(scenarios) > 1 and first.motion_period != first.control_period:
            raise InputError("motion_period: robots that begin at different times need that of control_period")
        if action == "voltage":  # a learner must not learn from feedback that does not act
            scenarios = [s.model_copy(update={"prior": "none", "learner": "none"}) for s in scenarios]
        if action != "twist":
            scenarios = [s.model_copy(update={"pid": s.pid.model_copy(update={"retune": False})}) for s in scenarios]
        self._agent: AgentMotion | None = None

        def agent(robot: Robot, size: int) -> AgentMotion:  # whose name begins the reason of a failure
            self._agent = self.agent(robot, size)
            return self._agent

        motion = agent if action == "twist" else None
        self.loop = Simulation(scenarios, threads=threads, restarting=True, motion=motion)
        self.plant, self.log, self.period = self.loop.plant, self.loop.log, self.loop.period
        self._kind = action
        self._action = np.zeros((len(scenarios), 2)) if self._agent is None else self._agent.request
        robot = self.plant.robot
        limits = robot.max_speed, robot.max_rotation
        share = MAX_RESIDUAL if action == "residual" else 1.0
        self.bound = np.array(limits if action == "twist" else [share * robot.supply] * 2)
        wheel_rate = (robot.max_speed + robot.half_track * robot.max_rotation) / robot.wheel_radius
        near = HALF_REWARD_DISTANCE
        self.scale = np.array(
            [near, near, near / robot.half_track, *limits, *limits, robot.max_acceleration]
            + [robot.max_rotation_acceleration, *[wheel_rate] * 2, robot.steering_limit, *[robot.supply] * 2]
        )
        self._given, self._draw = [s.perturbation for s in self.scenarios], draw
        self._squares = np.zeros((len(scenarios), 3))
        self.start = np.zeros(len(scenarios), int)
        self.sizes = dict(OBSERVATIONS)
        self.limits = np.full(sum(OBSERVATIONS.values()), -np.inf), np.full(sum(OBSERVATIONS.values()), np.inf)
        self._lengths = np.array([s.ticks for s in scenarios])
        self.goals = np.array([(np.nan,) * 3 if s.goal is None else s.goal for s in scenarios])

    @property
    def tick(self) -> int:
        """Number of control periods done."""
        return self.loop.tick

    @property
    def scenarios(self) -> list[Scenario]:
        """Scenario of each robot, with the seed and the perturbation of its episode."""
        return self.loop.scenarios

    def _next(self, row: int, seed: int, perturbation: object) -> Scenario:
        """Returns the scenario of a robot's next episode."""
        if perturbation is None:
            perturbation = self._given[row]
            if self._draw is not None:
                try:
                    perturbation = self._draw(np.random.default_rng([seed, 5]))  # as `replicates` draws
                except InputError as error:
                    raise InputError(f"perturbation.{error}") from None
        if perturbation == self.scenarios[row].perturbation:
            return self.scenarios[row].model_copy(update={"seed": seed})
        return self.scenarios[row].replace(seed=seed, perturbation=perturbation)

    def begin(self, row: int, seed: int, perturbation: object = None) -> None:
        """Begins another episode of one robot at the coming tick, which must not be sensed yet.

        Args:
            row: Index of the robot.
            seed: Seed of its scenario from now on.
            perturbation: Perturbation of this episode, a mapping of its fields or one of the names in `PERTURBATIONS`;
                by default `draw` draws it, or it is that of the scenario.

        Raises:
            InputError: The perturbation is invalid, or the robot could not stand.
        """
        self._begin(row, self._next(row, seed, perturbation))

    def _begin(self, row: int, scenario: Scenario) -> None:
        """Begins an episode of one robot with a scenario of `_next`."""
        if len(self.scenarios) == 1:
            self.loop.hierarchy.restart_clock()
        self.loop.restart(row, scenario)
        self.start[row] = self.tick
        self._action[row] = self._squares[row] = 0.0

    def begin_all(self, seeds: Sequence[int], perturbations: Sequence[object] | None = None) -> None:
        """Begins another episode of every robot; see `begin` for the perturbations.

        Raises:
            InputError: No scenario can have a seed, there are not as many perturbations as robots, or as `begin`.
        """
        for seed in seeds:
            if not 0 <= seed < MAX_SEEDS:
                raise InputError(f"seed: {seed} is not between 0 and {MAX_SEEDS - 1}")
        perturbations = [None] * len(seeds) if perturbations is None else perturbations
        if len(perturbations) != len(seeds):
            raise InputError(f"perturbation: {len(perturbations)} of them for {len(seeds)} robots")
        coming = [self._next(row, seed, perturbations[row]) for row, seed in enumerate(seeds)]
        for row, scenario in enumerate(coming):  # if one of them is invalid, no robot has begun
            self._begin(row, scenario)

    def act(self, action: Array, scale: Array | float = 1.0) -> None:
        """Sets the action of the coming tick, `(B, 2)`, or `(2,)` for one robot, times a scale.

        Raises:
            InputError: It has another shape, or holds no real numbers.
        """
        size, action = self._action.shape, np.asarray(action)
        if not np.can_cast(action.dtype, float, "same_kind"):
            raise InputError(f"action: holds {action.dtype.name}, and real numbers are expected")
        if (shape := np.shape(action)) != size and not (shape == (2,) and size == (1, 2)):
            raise InputError(f"action: has shape {shape}, and {size if size[0] > 1 else (2,)} is expected")
        self._action[:] = action * scale

    def step(self) -> None:
        """Computes one control period; where others step the physics, they do what `Plant.advance` does around that."""
        self.send()
        self.plant.advance()
        self.plant.look()
        self.settle()

    def sense(self) -> tuple[Rows, Rows]:
        """Measures; see `Simulation.sense`."""
        return self.loop.sense()

    def send(self) -> None:
        """Sends the commands of the hierarchy, with the action in place of their voltages or added to them."""
        hierarchy, supply = self.loop.hierarchy, self.plant.robot.supply
        command = hierarchy.update(*self.sense())
        if self._kind == "voltage":
            command[:, :2] = np.clip(self._action, -supply, supply)
        elif self._kind == "residual":
            residual = np.clip(self._action, -self.bound, self.bound)
            command[:, :2] = np.clip(command[:, :2] + residual, -supply, supply)
        self.plant.send(command, hierarchy.faults)

    def observe(self) -> tuple[Array, Array]:
        """Returns the observations for the coming tick, and the rewards for the present state.

        Returns:
            Observations, `(B, 14)`, with the parts in `OBSERVATIONS` side by side. Rewards, `(B,)`: one on the
            reference, a half where the rear wheels are 5 cm off it, zero where a robot has failed, and after the tick
            in which it arrived. That distance is the root mean square over the two wheels, √(e_x² + e_y² + (D e_θ)²),
            of the true posture.
        """
        seen, wanted = self.sense()
        loop, size, robot = self.loop, len(self.scenarios), self.plant.robot
        now, _ = loop.courses.at(self.tick)
        constants = robot.wheel_radius, robot.half_track
        observation, reward = np.empty((size, sum(OBSERVATIONS.values()))), np.empty(size)
        there = loop.goals.there
        observe(self.plant.state, seen, wanted, now, loop.hierarchy.state, there, *constants, observation, reward)
        return observation, reward

    def settle(self) -> None:
        """Does what comes after the physics: the record, the squared errors and the failures."""
        loop, tick = self.loop, self.tick
        seen, now = loop.estimator.seen, loop.courses.at(tick)[0]
        self.log.record(tick, self.plant.state, seen, now, loop.hierarchy.state)
        loop.judge()
        add_squares.compiled(self.log.now, self._squares)

    def metrics(self, row: int) -> dict[str, float]:
        """Returns the `EPISODE_METRICS` of a robot's episode so far, by name; all NaN if the robot has failed."""
        means = self._squares[row] / (self.tick - self.start[row])
        return dict(zip(EPISODE_METRICS, np.sqrt(means).tolist(), strict=True))

    def arrived(self) -> NDArray[np.bool]:
        """Tells which robots stood at the goals of their scenarios in the last tick, `(B,)`."""
        return self.loop.goals.there.copy()

    def ended(self) -> tuple[NDArray[np.bool], NDArray[np.bool]]:
        """Tells which episodes ended by a failure or at a goal, and which at the end of their scenario, `(B,)` each."""
        terminated = self.plant.stopped.copy()
        return terminated, (self.tick - self.start >= self._lengths) & ~terminated

    def failure(self, row: int) -> str:
        """Returns why a robot has failed, with ticks counted from the beginning of its episode; "" if it has not."""
        reason = self.plant.failure[row]
        before, says, tick = reason.rpartition(", tick ")
        return f"{before}{says}{int(tick) - self.start[row]}" if says else reason


def read(scenario: Scenario | str | Path | None) -> Scenario:
    """Returns a scenario, that in a file, or by default one lap.

    Raises:
        InputError: The file is not a valid scenario, or it is none of the three.
    """
    if isinstance(scenario, Scenario):
        return scenario
    if scenario is not None and not isinstance(scenario, str | Path):
        raise InputError(f"scenario: {type(scenario).__name__} is neither a Scenario nor the path of a file")
    return Scenario(laps=1) if scenario is None else Scenario.from_toml(scenario)
