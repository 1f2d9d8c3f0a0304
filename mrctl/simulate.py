"""THE closed loop: scenarios in, result out."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Hashable, Sequence

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from tqdm import tqdm

from mrctl import model as mjcf
from mrctl import result
from mrctl.control.feedforward import Feedforward, InverseDynamics
from mrctl.control.fel import FeedbackErrorLearning
from mrctl.control.hierarchy import Hierarchy, feedforward_of
from mrctl.control.kanayama import posture_error
from mrctl.measurement import observe
from mrctl.plant import OMEGA, RATE_LEFT, RATE_RIGHT, STEERING, THETA, Plant, V, X, build
from mrctl.record import InputError
from mrctl.references import check
from mrctl.robot import Perturbation, Robot
from mrctl.scenario import Event, Scenario

Array = NDArray[np.float64]
Factory = Callable[[Robot, int], Feedforward]

DIVERGED = 1.0  # m of lateral error
FAR = 0.8  # m between robot and reference at the start


def simulate(
    scenarios: Scenario | Sequence[Scenario],
    feedforward: Factory | None = None,
    progress: bool = False,
    threads: int = 0,
) -> xr.Dataset:
    """Runs scenarios in closed loop.

    One scenario runs through dm_control, several run together on MuJoCo's batch engine, with the same bits.

    Args:
        scenarios: One, or several; those that differ in world, laws, steering, length or rates run in turn.
        feedforward: A stage of your own instead of the named one: called with the nominal robot and the number of
            robots, returns an object with the two methods of `mrctl.control.feedforward.Feedforward`.
        progress: Shows a progress bar.
        threads: Of the batch engine, which change no bit; 0 for all cores.

    Returns:
        The signals of `mrctl.result.SIGNALS` with dimensions run and time (time alone for one scenario), with units;
        `failed`, `failure` and `failure_time` a run; `weights` where a network learned.

    Raises:
        InputError: A scenario asks for what is not there or what the robot cannot do; the message names the field.
    """
    several = [scenarios] if isinstance(scenarios, Scenario) else list(scenarios)
    if not several:
        raise InputError("scenarios: none given")
    if len({s.control_period for s in several}) > 1:
        raise InputError("control_period: runs of one result share their time axis, so also their control period")
    groups: dict[Hashable, list[int]] = defaultdict(list)
    for row, scenario in enumerate(several):
        groups[_group(scenario)].append(row)
    # Built first, so that bad input is refused before anything is computed.
    simulations = [(rows, Simulation([several[r] for r in rows], feedforward, threads)) for rows in groups.values()]
    total = sum(simulation.ticks * len(rows) for rows, simulation in simulations)
    parts = []
    with tqdm(total=total, unit="tick", unit_scale=True, disable=not progress) as bar:
        for rows, simulation in simulations:
            while simulation.running:
                simulation.step()
                bar.update(len(rows))
            parts.append((rows, simulation.result()))
    whole = result.combine(parts, several)
    return whole.isel(run=0) if isinstance(scenarios, Scenario) else whole


def _group(scenario: Scenario) -> Hashable:
    """Scenarios with equal keys run in one batch."""
    s = scenario
    return s.world, s.steering, s.feedforward, s.ticks, s.physics_step, s.motion_period, s.fel.hidden


class Simulation:
    """A uniform group of runs, one control period at a time.

    Attributes:
        scenarios: What is run.
        plant: The physics.
        hierarchy: The controllers.
        tick: Control periods done.
        ticks: Control periods in the whole run.
    """

    def __init__(self, scenarios: Sequence[Scenario], feedforward: Factory | None = None, threads: int = 0) -> None:
        """Compiles the world, stands the robots on their references, rolling.

        Args:
            scenarios: Scenarios that `simulate` would run together.
            feedforward: As in `simulate`.
            threads: As in `simulate`.

        Raises:
            InputError: As `simulate`.
        """
        first, size = scenarios[0], len(scenarios)
        self.scenarios = list(scenarios)
        self.ticks, self.tick = first.ticks, 0
        self._period = first.control_period
        compiled = mjcf.load(first.world, first.steering, first.physics_step)
        robot = mjcf.read_robot(compiled)
        rigid = first.steering == "rigid"
        for scenario in scenarios:
            check(scenario.reference, robot, reverse=rigid)
        stage = feedforward(robot, size) if feedforward else feedforward_of(scenarios, robot)
        self._label = getattr(feedforward, "__name__", "custom") if feedforward else first.feedforward
        self._oracle = stage if first.feedforward == "oracle" and isinstance(stage, InverseDynamics) else None
        self.plant: Plant = build(compiled, size, round(first.control_period / first.physics_step), threads)
        self.hierarchy = Hierarchy(scenarios, robot, stage)
        times = self._period * np.arange(self.ticks, dtype=float)
        motions = [s.reference.sample(times) for s in scenarios]
        self._reference = np.stack([np.hstack(motion) for motion in motions], axis=1)  # (ticks, B, 7)
        self._wheel_radius = robot.wheel_radius
        self._odometry = np.array([float(s.measurement == "odometry") for s in scenarios])
        self._noise, self._noise_scale = np.zeros((2, size, 5))
        self._random = [np.random.default_rng([s.seed, 2]) for s in scenarios]
        self._schedule: dict[int, list[tuple[int, Event]]] = defaultdict(list)
        for row, scenario in enumerate(scenarios):
            self._perturb(row, scenario.perturbation)
            for event in sorted(scenario.events, key=lambda e: e.time):
                self._schedule[int(np.ceil(event.time / self._period - 1e-9))].append((row, event))
        start = self._reference[0]
        self.plant.reset(np.stack([_start(s, start[i, :3]) for i, s in enumerate(scenarios)]), start[:, 3:5])
        reading = self.plant.reading
        self.hierarchy.reset(start[:, 3:5], start[:, 5:], reading[:, STEERING])
        self._pose, self._twist = reading[:, X : THETA + 1].copy(), reading[:, V : OMEGA + 1].copy()
        self._error = np.zeros((size, 3))
        self._log = np.full((size, self.ticks, len(result.SIGNALS)), np.nan)
        self._failure_time = np.full(size, np.nan)

    @property
    def running(self) -> bool:
        """Whether there is anything left to do."""
        return self.tick < self.ticks and not self.plant.failed.all()

    @np.errstate(invalid="ignore", over="ignore")  # a robot that blew up is computed on in NaN, to no effect
    def step(self) -> None:
        """One control period: events, measurement, control, record, physics."""
        for row, event in self._schedule.get(self.tick, ()):
            self._happen(row, event)
        plant, hierarchy, reading = self.plant, self.hierarchy, self.plant.reading
        if self._noise_scale.any():
            for row in np.flatnonzero(self._noise_scale.any(axis=1)):
                self._noise[row] = self._noise_scale[row] * self._random[row].standard_normal(5)
        observe(
            reading[:, X : THETA + 1], reading[:, V : OMEGA + 1], self._noise, self._odometry,
            self._wheel_radius * (reading[:, RATE_LEFT] + reading[:, RATE_RIGHT]) / 2,
            self._period if self.tick else 0.0, self._pose, self._twist,
        )  # fmt: skip
        reference = self._reference[self.tick]
        output = hierarchy.update(self._pose, self._twist, reference[:, :3], reference[:, 3:5], reference[:, 5:])
        if not np.isfinite(hierarchy.parts.sum()):  # the limit would turn NaN into the full voltage
            for row in np.flatnonzero(~np.isfinite(hierarchy.parts).all(axis=1)):
                plant.fail(int(row), "non-finite voltage")
        before = reading[:, : STEERING + 1].copy()
        posture_error(before[:, X : THETA + 1], reference[:, :3], self._error)
        plant.step(output)
        current = plant.current()
        np.concatenate(  # in the order of result.SIGNALS
            [
                before, reference[:, :5], self._error, self._twist, hierarchy.command, hierarchy.parts, output,
                hierarchy.saturated[:, None], hierarchy.weight_norm[:, None], current,
                (plant.applied * current).sum(axis=1, keepdims=True),
            ],
            axis=1,
            out=self._log[:, self.tick],
        )  # fmt: skip
        for row in np.flatnonzero(np.abs(self._error[:, 1]) > DIVERGED):
            plant.fail(int(row), f"lateral error over {DIVERGED:g} m")
        self.tick += 1
        if plant.failed.any():
            new = plant.failed & np.isnan(self._failure_time)
            self._failure_time[new] = self.tick * self._period
            self._log[plant.failed, self.tick - 1] = np.nan

    def result(self) -> xr.Dataset:
        """What was recorded so far; the whole length, ending in NaN, once every robot has failed."""
        stage = self.hierarchy.feedforward
        weights = stage.state["weights"].copy() if isinstance(stage, FeedbackErrorLearning) else None
        labels = [self._label] * len(self.scenarios)
        log = self._log[:, : self.tick] if self.running else self._log
        return result.dataset(self.scenarios, labels, log, self.plant.failure, self._failure_time, weights)

    def _perturb(self, row: int, perturbation: Perturbation) -> None:
        p = perturbation
        self.plant.perturb(row, p, round(p.control_delay / self._period))
        self._noise_scale[row] = p.position_noise, p.position_noise, p.heading_noise, p.velocity_noise, p.rotation_noise
        self._noise[row] = 0.0
        if self._oracle:
            self._oracle.set_robot(row, self.plant.truth[row])

    def _happen(self, row: int, event: Event) -> None:
        if event.perturbation is not None:
            self._perturb(row, event.perturbation)
        if event.push is not None:
            self.plant.push(row, np.array(event.push), max(1, round(event.push_duration / self._period)))
        if event.kanayama is not None:
            self.hierarchy.set_kanayama(row, event.kanayama)
        if event.pid is not None:
            self.hierarchy.set_pid(row, event.pid)
        if event.learning is not None:
            self.hierarchy.set_learning(row, event.learning)


def _start(scenario: Scenario, reference: Array) -> Array:
    """Posture at the start `(3,)`: the given one or the reference's, plus the seeded offset.

    Raises:
        InputError: It is far from the reference.
    """
    base = reference if scenario.initial_pose is None else np.array(scenario.initial_pose)
    offset = np.random.default_rng([scenario.seed, 0]).standard_normal(3) * scenario.initial_spread
    distance = float(np.hypot(*(base + offset - reference)[:2]))
    if distance > FAR:
        raise InputError(
            f"initial_pose: {distance:.2f} m from the start of the reference at "
            f"({reference[0]:.2f}, {reference[1]:.2f}); at most {FAR:g} m"
        )
    return base + offset
