"""THE closed loop: scenarios in, result out."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Hashable, Sequence
from typing import Any, Unpack

import numpy as np
import xarray as xr
from numba import float64, njit
from numpy.typing import NDArray
from tqdm import tqdm

from mrctl.control.chain import ANY, GIVEN, OWN, one, rows, stamp
from mrctl.control.feedforward import InverseDynamics, feature_scale
from mrctl.control.fel import FeedbackErrorLearning
from mrctl.control.kanayama import posture_error
from mrctl.control.stages import Own, StageError, Stages
from mrctl.loop.hierarchy import STATE as CONTROLLER
from mrctl.loop.hierarchy import Hierarchy
from mrctl.physics import mjcf
from mrctl.physics.parameters import read_robot
from mrctl.physics.plant import OMEGA, RATE_LEFT, RATE_RIGHT, STEERING, THETA, Plant, V, X, build
from mrctl.physics.plant import STATE as ROBOT
from mrctl.record import InputError
from mrctl.results import dataset as result
from mrctl.scenario import Event, Scenario
from mrctl.sensing.sensors import observe, watch_slip
from mrctl.theory.perturbation import Perturbation
from mrctl.theory.references import check

Array = NDArray[np.float64]

DIVERGED = 1.0  # m of lateral error
LATERAL_ERROR = list(result.SIGNALS).index("lateral_error")
BLOCK = 10_000  # control ticks whose references are sampled at once
FAR = 0.8  # m between robot and reference at the start

_observe, _watch_slip, _posture_error = one(observe), one(watch_slip), one(posture_error)
_STATE, _REFERENCE, _ERROR = STEERING + 1, 5, 3  # how many columns of the record each takes


# What is measured of one robot: the last measurement and how long ago it was, this tick's noise, whether by odometry.
SENSORS = np.dtype(
    [
        ("pose", "f8", 3), ("twist", "f8", 2), ("slip", "f8", (1,)), ("noise", "f8", 5), ("odometry", "f8"),
        ("elapsed", "f8"),
    ],
    align=True,
)  # fmt: skip


def _compile(version: int) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """What the loop does for each robot beside control and physics; see `chain.stamp` for the version."""

    @njit((rows(ROBOT), GIVEN, rows(SENSORS), *[float64] * 3, OWN), cache=True)
    def sense(robots, reference, sensors, wheel_radius, half_track, period, record):  # noqa: ANN001, ANN202
        """Measures, and records state, reference, true error, measured twist and slip."""
        _ = version
        speeds = np.empty(2)
        for i in range(len(robots)):
            true, s, row = robots[i].reading, sensors[i], record[i]
            speeds[0], speeds[1] = wheel_radius * true[RATE_LEFT], wheel_radius * true[RATE_RIGHT]
            slip_free = (speeds[0] + speeds[1]) / 2
            _observe(
                true[X : THETA + 1], true[V : OMEGA + 1], s.noise, s.odometry, slip_free, s.elapsed, s.pose, s.twist
            )
            _watch_slip(speeds, s.twist, half_track, period, s.slip)
            s.elapsed = period
            row[:_STATE] = true[:_STATE]
            row[_STATE : _STATE + _REFERENCE] = reference[i, :_REFERENCE]
            at = _STATE + _REFERENCE
            _posture_error(true[X : THETA + 1], reference[i, :3], row[at : at + _ERROR])
            row[at + _ERROR : at + _ERROR + 2] = s.twist
            row[at + _ERROR + 2] = s.slip[0]

    @njit((rows(CONTROLLER), ANY, rows(ROBOT), OWN), cache=True)
    def record(controllers, norm, robots, row):  # noqa: ANN001, ANN202
        """Records commands, currents and power; returns whether all robots are near their references."""
        _ = version
        near = True
        at = _STATE + _REFERENCE + _ERROR + 3
        for i in range(len(row)):
            r, c, p = row[i, at:], controllers[i], robots[i]
            r[0:2], r[2:6], r[6:10] = c.command, c.parts, c.output
            r[10], r[11] = c.saturated[0], norm[i]
            r[12:14] = p.current
            r[14] = p.applied[0] * p.current[0] + p.applied[1] * p.current[1]
            r[15], r[16] = c.guard.action, c.guard.reason
            near &= not abs(row[i, LATERAL_ERROR]) > DIVERGED or p.failed
        return near

    return sense, record


_sense, _record = _compile(stamp(observe, watch_slip, posture_error))


def simulate(
    scenarios: Scenario | Sequence[Scenario], *, progress: bool = False, threads: int = 0, **stages: Unpack[Stages]
) -> xr.Dataset:
    """Runs scenarios in closed loop.

    One scenario runs through dm_control, several run together on MuJoCo's batch engine, with the same bits.

    Args:
        scenarios: One, or several; those that differ in world, laws, steering, length or rates run in turn.
        progress: Shows a progress bar.
        threads: Of the batch engine, which change no bit; 0 for all cores.
        stages: Stages of your own, `motion`, `feedback`, `feedforward` or `steering`, instead of the scenario's: a
            factory, called with the nominal robot and the number of robots, which returns an object with the two
            methods of that stage in `mrctl.control.stages`. One that raises, or returns what does not fit, fails its
            whole group of runs; one that returns NaN for a robot fails that run.

    Returns:
        The signals of `results.dataset.SIGNALS` with dimensions run and time (time alone for one scenario), with units;
        `failed`, `failure` and `failure_time` a run; `weights` where a network learned.

    Raises:
        InputError: A scenario asks for what is not there or what the robot cannot do; the message names the field. Or
            a stage of yours cannot be made.
    """
    several = [scenarios] if isinstance(scenarios, Scenario) else list(scenarios)
    if not several:
        raise InputError("scenarios: none given")
    if len({s.control_period for s in several}) > 1:
        raise InputError("control_period: runs of one result share their time axis, so also their control period")
    # Built first, so that bad input is refused before anything is computed.
    simulations = batches(several, threads=threads, **stages)
    total = sum(simulation.ticks * len(rows) for rows, simulation in simulations)
    parts = []
    with tqdm(total=total, unit="tick", unit_scale=True, disable=not progress) as bar:
        for rows, simulation in simulations:
            with np.errstate(
                invalid="ignore", over="ignore"
            ):  # a robot that blew up is computed on in NaN, to no effect
                while simulation.running:
                    simulation.step()
                    bar.update(len(rows))
            parts.append((rows, simulation.result()))
    whole = result.combine(parts, several)
    return whole.isel(run=0) if isinstance(scenarios, Scenario) else whole


def batches(
    scenarios: Sequence[Scenario], *, threads: int = 0, **stages: Unpack[Stages]
) -> list[tuple[list[int], Simulation]]:
    """Uniform groups of scenarios: which they are, and their simulation. Arguments and errors as in `simulate`."""
    groups: dict[Hashable, list[int]] = defaultdict(list)
    for row, s in enumerate(scenarios):
        groups[group_of(s)].append(row)
    return [(rows, Simulation([scenarios[r] for r in rows], threads=threads, **stages)) for rows in groups.values()]


def group_of(s: Scenario) -> Hashable:
    """What runs in one simulation must share."""
    net = s.fel.hidden, s.composite.weights
    rates = s.ticks, s.physics_step, s.control_period, s.motion_period
    return s.world, s.robot, s.steering, s.feedforward, *rates, *net


class Simulation:
    """A uniform group of runs, one control period at a time.

    Attributes:
        scenarios: What is run, with the events that were added.
        model: The compiled world with the nominal robot.
        plant: The physics.
        hierarchy: The controllers.
        tick: Control periods done.
        ticks: Control periods in the whole run.
        log: What was recorded, `(ticks, B, signals)`; nothing yet from `tick` on.
        override: Changes what the controllers command, `(B, 4)`, in place, before it is sent; None.
    """

    def __init__(self, scenarios: Sequence[Scenario], *, threads: int = 0, **stages: Unpack[Stages]) -> None:
        """Compiles the world, stands the robots on their references, rolling.

        Args:
            scenarios: Scenarios that `simulate` would run together.
            threads: As in `simulate`.
            stages: As in `simulate`.

        Raises:
            InputError: As `simulate`.
        """
        first, size = scenarios[0], len(scenarios)
        self.scenarios = list(scenarios)
        self.ticks, self.tick = first.ticks, 0
        self._period = first.control_period
        self.model = compiled = mjcf.load(first.world, first.steering, first.physics_step, first.robot)
        robot = read_robot(compiled)
        self._reverses = mjcf.reverses(compiled, first.steering)
        for scenario in scenarios:
            for reference in (scenario.reference, *(e.reference for e in scenario.events if e.reference)):
                check(reference, robot, self._reverses)
        factories: dict[str, Any] = {name: factory for name, factory in stages.items() if factory}
        own = {name: Own(name, factory, robot, size) for name, factory in factories.items()}
        names = {name: getattr(factory, "__name__", "custom") for name, factory in factories.items()}
        self._feedforward = names.pop("feedforward", first.feedforward)
        self._label = " + ".join([self._feedforward, *names.values()])
        self.plant: Plant = build(compiled, size, round(first.control_period / first.physics_step), threads)
        self.hierarchy = Hierarchy(scenarios, robot, own=own)
        stage = self.hierarchy.feedforward
        self._oracle = stage if first.feedforward == "oracle" and isinstance(stage, InverseDynamics) else None
        self._plan()
        self._geometry = robot.wheel_radius, robot.half_track
        self._sensors = np.zeros(size, SENSORS)
        self._sensors["odometry"] = [s.measurement == "odometry" for s in scenarios]
        self._pose, self._twist, self._noise = (self._sensors[name] for name in ("pose", "twist", "noise"))
        self._slip = self._sensors["slip"][:, 0]
        self._noise_scale = np.zeros((size, 5))
        self._noisy: list[int] = []
        self._random = [np.random.default_rng([s.seed, 2]) for s in scenarios]
        self._schedule: dict[int, list[tuple[int, Event]]] = defaultdict(list)
        for row, scenario in enumerate(scenarios):
            self._perturb(row, scenario.perturbation)
            for event in sorted(scenario.events, key=lambda e: e.time):
                self._schedule[tick_of(event, self._period)].append((row, event))
        start = self._reference_now()
        self.plant.reset(np.stack([start_pose(s, start[i, :3]) for i, s in enumerate(scenarios)]), start[:, 3:5])
        reading = self.plant.reading
        self.hierarchy.reset(start[:, 3:5], start[:, 5:], reading[:, STEERING])
        self._pose[:], self._twist[:] = reading[:, X : THETA + 1], reading[:, V : OMEGA + 1]
        # A tick's records side by side: the loop writes one block of memory a tick, however many robots there are.
        self.log = np.empty((self.ticks, size, len(result.SIGNALS)))
        self._failure_time = np.full(size, np.nan)
        self._sensed = -1
        self.override: Callable[[Array], None] | None = None

    @property
    def running(self) -> bool:
        """Whether there is anything left to do."""
        return self.tick < self.ticks and self.plant.running > 0

    def add(self, event: Event) -> None:
        """Adds an event to every run under way: `scenarios` then hold it, and run again give the same bits.

        Args:
            event: What happens, not before the coming tick.

        Raises:
            InputError: It comes too late, or a scenario with it is refused; then nothing was added.
        """
        if (tick := tick_of(event, self._period)) < self.tick:
            raise InputError(f"time: {event.time:g} s has passed, it is {self.tick * self._period:g} s")
        if event.perturbation is not None:
            self.plant.check(event.perturbation)
        if event.reference is not None:
            check(event.reference, self.plant.robot, self._reverses)
        self.scenarios = [scenario.with_event(event) for scenario in self.scenarios]
        self._schedule[tick] += enumerate([event] * len(self.scenarios))
        if event.reference is not None:
            self._plan()

    def step(self) -> None:
        """One control period: events, measurement, control, physics, record."""
        self.decide()
        self.plant.advance()
        self.settle()

    @property
    def _row(self) -> Array:
        """Where the record of this tick goes, `(B, signals)`."""
        return self.log[self.tick]

    def sense(self) -> None:
        """Lets this tick's events happen and measures, once a tick."""
        if self._sensed == self.tick:
            return
        self._sensed = self.tick
        for row, event in self._schedule.get(self.tick, ()):
            self._happen(row, event)
        for row in self._noisy:
            self._noise[row] = self._noise_scale[row] * self._random[row].standard_normal(5)
        self._goal = self._reference_now()
        _sense(self.plant.state, self._goal, self._sensors, *self._geometry, self._period, self._row)

    def decide(self) -> None:
        """What comes before the physics: events, measurement, control."""
        self.sense()
        plant, hierarchy = self.plant, self.hierarchy
        try:
            output = hierarchy.update(self._pose, self._twist, self._goal, self._slip)
        except StageError as error:  # of the whole group: what was recorded until now is kept
            output = hierarchy.output
            hierarchy.faults = dict.fromkeys(range(plant.size), str(error))
        for row, fault in hierarchy.faults.items():
            plant.fail(row, f"{fault}, tick {self.tick}")
        if not hierarchy.finite:  # the limit would turn NaN into the full voltage
            for row in np.flatnonzero(~np.isfinite(hierarchy.parts).all(axis=1)):
                plant.fail(int(row), "non-finite voltage")
        if self.override:
            self.override(output)
        plant.send(output)

    def settle(self) -> None:
        """What comes after the physics: readouts, record, failures."""
        plant, hierarchy, log = self.plant, self.hierarchy, self._row
        plant.look()
        near = _record(hierarchy.state, hierarchy.weight_norm, plant.state, log)
        if not near:
            for row in np.flatnonzero(np.abs(log[:, LATERAL_ERROR]) > DIVERGED):
                plant.fail(int(row), f"lateral error over {DIVERGED:g} m")
        self.tick += 1
        if plant.running < plant.size:
            new = plant.failed & np.isnan(self._failure_time)
            self._failure_time[new] = self.tick * self._period
            log[plant.failed] = np.nan

    def _plan(self) -> None:
        """Finds the courses: robots on the same one share its samples."""
        names = [(s.reference, *((e.time, e.reference) for e in s.events if e.reference)) for s in self.scenarios]
        self._courses = dict(zip(names, self.scenarios, strict=True))
        order = list(self._courses)
        self._place = np.array([order.index(n) for n in names])
        self._which = self._place if 1 < len(order) < len(names) else None
        self._block = range(0)

    def _reference_now(self) -> Array:
        if self.tick not in self._block:  # a long run does not hold all samples: (BLOCK, courses, 7)
            first = self.tick // BLOCK * BLOCK
            self._block = range(first, min(first + BLOCK, self.ticks))
            samples = np.stack([course(s, self._block) for s in self._courses.values()], axis=1)
            everyone = (len(samples), len(self.scenarios), 7)
            self._reference = np.broadcast_to(samples, everyone) if len(self._courses) == 1 else samples
        now = self._reference[self.tick - self._block.start]
        return now if self._which is None else now[self._which]

    def result(self) -> xr.Dataset:
        """What was recorded so far; the whole length, ending in NaN, once every robot has failed."""
        stage = self.hierarchy.feedforward
        weights = stage.state["weights"].copy() if isinstance(stage, FeedbackErrorLearning) else None
        size, robot = len(self.scenarios), self.plant.robot
        log = self.log[: self.tick] if self.running else self.log
        log[self.tick :] = np.nan
        by_run = log.transpose(1, 0, 2)
        names = [self._label] * size, [self._feedforward] * size
        found = result.dataset(self.scenarios, *names, by_run, self.plant.failure, self._failure_time, weights)
        return found.assign(  # what turns the commanded motion into features
            half_track=("run", np.full(size, robot.half_track), {"units": "m"}),
            feature_scale=(("run", "feature"), np.tile(feature_scale(robot), (size, 1))),
        )

    def _perturb(self, row: int, perturbation: Perturbation) -> None:
        p = perturbation
        self.plant.perturb(row, p, round(p.control_delay / self._period))
        self._noise_scale[row] = p.position_noise, p.position_noise, p.heading_noise, p.velocity_noise, p.rotation_noise
        self._noise[row] = 0.0
        self._noisy = np.flatnonzero(self._noise_scale.any(axis=1)).tolist()
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


def tick_of(event: Event, period: float) -> int:
    """The first control tick that is not before an event."""
    return int(np.ceil(event.time / period - 1e-9))


def course(scenario: Scenario, ticks: range) -> Array:
    """Posture, twist and acceleration to follow, `(ticks, 7)`, through all events that change the reference."""
    period = scenario.control_period
    posts = np.hstack(scenario.reference.sample(period * np.array(ticks, float)))
    for event in sorted(scenario.events, key=lambda e: e.time):
        start = tick_of(event, period)
        if event.reference is not None and (since := max(start, ticks.start)) < ticks.stop:
            times = period * np.arange(since - start, ticks.stop - start, dtype=float)
            posts[since - ticks.start :] = np.hstack(event.reference.sample(times))
    return posts


def start_pose(scenario: Scenario, reference: Array) -> Array:
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
