"""The closed loop: scenarios in, result out."""

from __future__ import annotations

import json
import os
import threading
from collections import defaultdict
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NoReturn, Unpack

import numpy as np
import xarray as xr
from tqdm import tqdm

from mrctl.control.features import feature_scale
from mrctl.control.stages import Stages
from mrctl.kernel import Array, Rows
from mrctl.loop.courses import Courses, RestartingCourses, start_pose
from mrctl.loop.events import Events
from mrctl.loop.goals import Goals
from mrctl.loop.hierarchy import Hierarchy
from mrctl.loop.learned import LAYOUT
from mrctl.loop.log import MAX_LATERAL_ERROR, Log
from mrctl.loop.user_hierarchy import UserHierarchy
from mrctl.loop.user_stages import StageError, UserEstimator, UserFeedforward, UserStage, name_of
from mrctl.physics import hull, mjcf, tyres
from mrctl.physics import obstacles as walls
from mrctl.physics.plant import Plant, build
from mrctl.record import InputError
from mrctl.results import dataset
from mrctl.scenario import Event, Scenario, feedforward_name
from mrctl.sensing.estimators import Estimator
from mrctl.sensing.scanner import Scanner
from mrctl.sensing.sensors import Sensors
from mrctl.theory.clearance import clearances
from mrctl.theory.dynamics import inverse_coefficients
from mrctl.theory.obstacles import Surroundings
from mrctl.theory.references import check, enlarged
from mrctl.theory.robot import ANY_ANGLE, LIMITS, Robot, Tyres
from mrctl.theory.timing import LIMIT_SHARE

MIN_ROBOTS_OF_THREAD = 8  # smallest number of robots for which a thread pays


def simulate(
    scenarios: Scenario | Sequence[Scenario], *, progress: bool = False, threads: int = 0, **stages: Unpack[Stages]
) -> xr.Dataset:
    """Runs scenarios in closed loop.

    One scenario runs through dm_control, several run together on MuJoCo's batch engine, with the same bits.

    Args:
        scenarios: One scenario, or several. They run in one batch if they have the same world, robot, laws, estimator,
            steering, delay and rates, obstacles of the same kinds in about the same number and, unless they have goals,
            the same length; else in several.
        progress: Whether to show a progress bar.
        threads: Number of threads for control and physics, which does not change the result; 0 for all cores.
        stages: The user's stages `motion`, `feedback`, `feedforward`, `steering` or `estimator` in place of the
            scenario's: a factory, called with the nominal robot and the number of robots, which returns an object with
            the two methods of that stage in `mrctl.control.stages`. One that raises in a tick, or returns an array of
            the wrong shape there, fails all runs that are computed together; one that returns NaN for a robot fails
            that run, except for an estimator, which odometry then replaces, and for a feedforward, which the guard
            replaces if it is on.

    Returns:
        The signals of `results.dataset.SIGNALS` with dimensions run and time (time alone for one scenario), with units;
        `failed`, `failure` and `failure_time` of each run; `weights`, flat, where something was learned.

    Raises:
        InputError: There is no scenario, or one asks for something that does not exist or that the robot cannot do, and
            the message names the field; or a user's stage fails before the first tick, in its factory, in `reset` or
            another method that prepares it, or, for a feedforward, in its first `output`.
    """
    single = isinstance(scenarios, Scenario) or not isinstance(scenarios, Iterable)
    listed: list[Any] = [scenarios] if single else list(scenarios)
    if not all(isinstance(s, Scenario) for s in listed):
        raise InputError("scenarios: neither a Scenario nor a list of them")
    given = [s.replace() for s in listed]  # validated
    several = [arranged(s) for s in given]
    if not several:
        raise InputError("scenarios: none given")
    if len({s.control_period for s in several}) > 1:
        raise InputError("control_period: differs between the scenarios, but runs of one result share their time axis")
    # Built first, so that bad input is refused before anything is computed.
    parts = [part for rows in uniform(several) for part in split(several, rows, threads, **stages)]
    total = sum(simulation.ticks * len(rows) for rows, simulation in parts)
    at_once = 1 if any(stages.values()) else threads
    with tqdm(total=total, unit="tick", unit_scale=True, disable=not progress) as bar:
        run([simulation for _, simulation in parts], bar.update if progress else None, threads=at_once)
        bar.total = bar.n  # where runs ended early, at their goals or because they failed
    whole = dataset.combine([(rows, simulation.result()) for rows, simulation in parts], given)
    if names := named_stages(stages):
        whole.attrs["stages"] = json.dumps(names)
    return whole.isel(run=0) if isinstance(scenarios, Scenario) else whole


def named_stages(stages: Stages) -> dict[str, str]:
    """Returns the names of the user's factories by stage."""
    return {stage: name_of(factory) for stage, factory in stages.items() if factory}


def titles(scenario: Scenario, stages: Mapping[str, str]) -> tuple[str, str]:
    """Returns the label of a run that has no name, and the name of its feedforward.

    Args:
        scenario: The run.
        stages: Names of the user's factories by stage.
    """
    others = dict(stages)
    feedforward = feedforward_name(scenario.prior, others.pop("feedforward", scenario.learner))
    return " + ".join([feedforward, *others.values()]), feedforward


def cores() -> int:
    """Returns the number of processor cores that this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)  # only Linux has it
    return len(affinity(0)) if affinity else os.cpu_count() or 1


def worthwhile(threads: int, size: int) -> int:
    """Returns how many of the allowed threads (0 for all cores) pay for a number of robots.

    Raises:
        InputError: The number of threads is negative.
    """
    if threads < 0:
        raise InputError(f"threads: {threads} is below 0, which stands for all cores")
    return min(threads or cores(), max(1, size // MIN_ROBOTS_OF_THREAD))


def uniform(scenarios: Sequence[Scenario]) -> list[list[int]]:
    """Returns groups of scenarios that run best in one simulation, as lists of their indices.

    Worlds whose numbers of obstacles differ by a factor of two or more are kept apart, because in one simulation all
    worlds get as many geoms as the largest has, and each costs time.
    """
    groups: dict[Hashable, list[int]] = defaultdict(list)
    for row, s in enumerate(scenarios):
        groups[group_of(s), len(s.obstacles.shapes).bit_length()].append(row)
    return list(groups.values())


def split(
    scenarios: Sequence[Scenario], rows: list[int], threads: int, **stages: Unpack[Stages]
) -> list[tuple[list[int], Simulation]]:
    """Splits a uniform group into simulations that run at the same time, one in each thread.

    With stages of the user the group stays whole: a stage serves all robots at once, and only the engine has threads.

    Args:
        scenarios: All scenarios.
        rows: Indices of those in the group.
        threads: Number of threads; 0 for all cores.
        stages: As in `simulate`.

    Raises:
        InputError: As `simulate`.
    """
    if any(stages.values()):
        return [(rows, Simulation([scenarios[row] for row in rows], threads=threads, **stages))]
    count = worthwhile(threads, len(rows))
    parts = [part.tolist() for part in np.array_split(rows, count)]
    return [(part, Simulation([scenarios[row] for row in part], threads=1)) for part in parts]


def run(
    simulations: Sequence[Simulation],
    progress: Callable[[int], object] | None = None,
    ticks: int | None = None,
    threads: int = 0,
) -> None:
    """Runs simulations, as many at the same time as there are threads; control and physics release the global lock.

    Args:
        simulations: The simulations.
        progress: Is called after every tick of a simulation with the number of its robots.
        ticks: Number of control periods; by default to the end of the runs.
        threads: Number of threads; 0 for all cores.
    """
    stop = threading.Event()

    def drive(simulation: Simulation) -> None:
        last = simulation.ticks if ticks is None else simulation.tick + ticks
        with np.errstate(invalid="ignore", over="ignore"):  # NaN of a failed robot have no effect on the others
            while simulation.running and simulation.tick < last and not stop.is_set():
                simulation.step()
                if progress:
                    progress(simulation.plant.size)

    count = min(threads or cores(), len(simulations))
    if count == 1:
        for simulation in simulations:
            drive(simulation)
        return
    with ThreadPoolExecutor(count) as pool:
        try:
            for future in [pool.submit(drive, simulation) for simulation in simulations]:
                future.result()
        except BaseException:
            stop.set()
            raise


def arranged(scenario: Scenario) -> Scenario:
    """Returns the scenario with the steering arrangement of its robot, where it names none.

    Raises:
        InputError: The robot's file has no robot that can be driven.
    """
    return scenario if scenario.steering else scenario.replace(steering=mjcf.arrangement(scenario.robot))


def suited(scenario: Scenario) -> Scenario:
    """Returns the scenario with the steering of its robot, and with a circle or lemniscate that the robot can follow.

    The reference of the scenario is slowed where necessary, and enlarged where no period is enough; one of another kind
    stays as it is.

    Raises:
        InputError: The robot cannot be driven.
    """
    scenario = arranged(scenario)
    model, robot = mjcf.build(scenario.world, scenario.steering, robot=scenario.robot)
    names = (*LIMITS, "steering_limit") if robot.steering_limit < ANY_ANGLE else LIMITS  # a caster swings to any angle
    careful = robot.replace(**{name: LIMIT_SHARE * getattr(robot, name) for name in names})
    found = enlarged(scenario.reference, careful, mjcf.reverses(model, scenario.steering))
    return scenario.replace(reference=found or scenario.reference)


def group_of(s: Scenario) -> Hashable:
    """Returns what the runs of one simulation must share; runs with goals end one by one, and may differ in length."""
    rates = s.ticks if s.goal is None else None, s.physics_step, s.control_period, s.motion_period
    sensing, period = s.sensing, s.control_period
    delays = [sensing.loop_delay(period, estimator) for estimator in (None, "user")]  # a user's may replace `source`
    chain = sensing.source, sensing.periods("delay", period), *delays
    laws = s.prior, s.learner, s.fel.hidden
    return s.world, walls.layout(s.obstacles), s.robot, s.steering, *laws, *rates, *chain


def _together(scenarios: Sequence[Scenario]) -> list[Scenario]:
    """Returns the scenarios of one simulation, `arranged`.

    Raises:
        InputError: They are not scenarios of one group; the message names the fields in which two of them differ.
    """
    if not (isinstance(scenarios, Sequence) and scenarios and all(isinstance(s, Scenario) for s in scenarios)):
        raise InputError("scenarios: must be a list of one or more scenarios")
    found = [arranged(s) for s in scenarios]
    first, group = found[0], group_of(found[0])
    for row, s in enumerate(found):
        if group_of(s) != group:
            fields = {name: getattr(s, name) for name in Scenario.model_fields}
            apart = [n for n, value in fields.items() if group_of(first.model_copy(update={n: value})) != group]
            raise InputError(f"scenarios: 0 and {row} differ in {', '.join(apart)}, and cannot run in one simulation")
    return found


class Simulation:
    """A uniform group of runs, one control period at a time.

    Attributes:
        scenarios: Scenario of each run, with the events that were added.
        model: The compiled world of the first run with the nominal robot.
        preview: Number of control periods that the reference is taken ahead, because a voltage acts that much later.
        courses: The references that the robots follow.
        sensors: The sensors of the robots.
        estimator: The estimator of the posture and the twist that the controllers use.
        hierarchy: The controllers.
        plant: The physics.
        events: The perturbations, pushes and other changes during the run.
        log: The recorded signals; the records from `tick` on are not written yet.
        goals: Where the runs end before their time.
        tick: Number of control periods done.
        ticks: Number of control periods in the whole run, in the longest where they differ.
    """

    def __init__(
        self, scenarios: Sequence[Scenario], *, threads: int = 0, restarting: bool = False, **stages: Unpack[Stages]
    ) -> None:
        """Compiles the world, and sets the robots on their references with the twist of the reference.

        Args:
            scenarios: Scenarios of one group, see `group_of`.
            threads: Largest number of threads of the batch engine; 0 for all cores. Control runs on one.
            restarting: Whether robots begin again on their own, with `restart`. Then no run ends at its own time, and
                the log keeps the last tick only.
            stages: As in `simulate`.

        Raises:
            InputError: A scenario or a stage is refused, as in `simulate`.
        """
        from mrctl.loop.announcement import announced  # imported here because it needs Numba

        announced()
        self.scenarios = scenarios = _together(scenarios)
        first, size = scenarios[0], len(scenarios)
        self.ticks, self.tick, self.period = max(s.ticks for s in scenarios), 0, first.control_period
        obstacles = [s.obstacles for s in scenarios]
        models, robot = mjcf.build_each(obstacles, first.world, first.steering, first.physics_step, first.robot)
        self.model = models[0]
        self._reverses = mjcf.reverses(self.model, first.steering)
        self._check_references(robot)
        factories: dict[str, Any] = {name: factory for name, factory in stages.items() if factory}
        users = {name: UserStage(name, factory, robot, size) for name, factory in factories.items()}
        self._stages = named_stages(stages)

        self.preview = first.sensing.periods("delay", self.period)
        self.courses = (RestartingCourses if restarting else Courses)(scenarios, self.preview)
        self.plant = self._build_plant(models, robot, worthwhile(threads, size))
        self.hierarchy = (UserHierarchy if users.keys() - {"estimator"} else Hierarchy)(scenarios, robot, users)
        for event in (event for scenario in scenarios for event in scenario.events):
            self._check_gains(event)
        self.hierarchy.scanner = self._build_scanner()
        self.sensors = Sensors([s.sensing for s in scenarios], [s.seed for s in scenarios], self.period)
        self.estimator = self._build_estimator(users.get("estimator"))
        self.events = Events(scenarios, self.plant, self.hierarchy, self.period, self.preview)
        self.log = Log(1 if restarting else self.ticks, size, self.hierarchy.rigid)
        self.goals = Goals(scenarios, timed=not restarting)
        self._failure_time = np.full(size, np.nan)
        self._learned: dict[int, Array] = {}  # what each robot had adapted when its run ended, flat
        self._final: dict[int, tuple[Array, Array]] = {}  # what `parameters` had where a run ended without failure
        self._sensed = False  # whether the coming tick is sensed
        self._start()

    def _check_references(self, robot: Robot) -> None:
        """Refuses references, also those of events, that the robot cannot follow."""
        for scenario in self.scenarios:
            for reference in (scenario.reference, *(e.reference for e in scenario.events if e.reference)):
                check(reference, robot, self._reverses)

    def _check_gains(self, event: Event) -> None:
        """Refuses an event with gains for a controller that has none of that kind."""
        if event.pid is not None and "feedback" in self._stages:
            feedback = self._stages["feedback"]
            raise InputError(f"events: pid at {event.time:g} s: the feedback {feedback} is not the PID")
        if event.kanayama is not None and not self.hierarchy.tunable:
            motion = self._stages["motion"]
            raise InputError(
                f"events: kanayama at {event.time:g} s: the motion controller {motion} does not take gains in an event"
            )

    def _build_plant(self, models: Sequence[Any], robot: Robot, threads: int) -> Plant:
        """Builds the physics; refuses perturbations of events, before anything is computed."""
        substeps = round(self.period / self.scenarios[0].physics_step)
        plant = build(models, robot, substeps, threads, [s.obstacles for s in self.scenarios])
        for perturbation in {event.perturbation: None for scenario in self.scenarios for event in scenario.events}:
            if perturbation is not None:
                plant.check(perturbation)
        return plant

    def _build_scanner(self) -> Scanner | None:
        """Builds the lidars, if a motion stage or the localisation of a robot takes their scans."""
        sensing = [s.sensing for s in self.scenarios]
        if self.hierarchy.looks or any(s.localisation != "fixes" for s in sensing):
            return Scanner(sensing, self.period, [s.obstacles for s in self.scenarios])
        return None

    def _build_estimator(self, own: UserStage | None) -> Estimator:
        """Builds the estimator: the user's, if there is one, or that of the scenarios."""
        first, scanner = self.scenarios[0], self.hierarchy.scanner
        # The engine integrates positions with the velocities at the end of a step: velocities are half a step behind.
        skew = first.physics_step / 2
        known = [s.known for s in self.scenarios] if scanner else ()
        sensing, robot = [s.sensing for s in self.scenarios], self.plant.robot
        parts = sensing, robot, self.sensors, self.plant.imu, skew, self._tyres(first), scanner, known
        return UserEstimator(own, *parts) if own else Estimator(first.sensing.source, *parts)

    def _tyres(self, scenario: Scenario) -> Tyres:
        """Measures the tyres of the nominal robot on a level floor, where the estimator needs them."""
        if scenario.sensing.source != "ekf":
            return Tyres()
        if scenario.world == "flat" and not scenario.obstacles.shapes:
            return tyres.measure(self.model)
        return tyres.measure(mjcf.load("flat", scenario.steering, scenario.physics_step, scenario.robot))

    def _start(self) -> None:
        """Sets the robots on their references with the twist of these; controllers and estimates start from there."""
        reference, _ = self.courses.at(0)
        poses = np.stack([start_pose(s, reference["pose"][row]) for row, s in enumerate(self.scenarios)])
        self.plant.reset(poses, reference["twist"])
        self.hierarchy.reset(reference["twist"], reference["acceleration"], self.plant.reading["steering_angle"])
        for row, scenario in enumerate(self.scenarios):
            self.estimator.start(row, self.plant.reading[row], scenario.seed, 0)

    @property
    def running(self) -> bool:
        """Whether the run goes on: ticks are left, and at least one robot has neither failed nor arrived."""
        return self.tick < self.ticks and self.plant.running > 0

    def add(self, event: Event) -> None:
        """Adds an event to every run; `scenarios` then contain it, and a new run of them gives the same bits.

        Args:
            event: The event, not before the coming tick, or the one after it once `sense` has applied its events; if
                it has a reference, not before the voltage of that tick acts.

        Raises:
            InputError: The event is in the past, or a scenario with it is refused; then nothing is added.
            ValueError: It has a reference, and the simulation was made with `restarting`.
        """
        coming = self.tick + self._sensed
        if event.tick(self.period) < coming:
            raise InputError(f"time: {event.time:g} s has passed, the next tick is at {coming * self.period:g} s")
        if event.reference is not None and event.tick(self.period) < coming + self.preview:
            raise InputError(f"time: a reference must be known {self.preview * self.period:g} s before it begins")
        self._check_gains(event)
        if event.perturbation is not None:
            self.plant.check(event.perturbation)
        if event.reference is not None:
            check(event.reference, self.plant.robot, self._reverses)
        scenarios = [scenario.with_event(event) for scenario in self.scenarios]
        if event.reference is not None:
            self.courses = self.courses.extended(scenarios)
        self.scenarios = scenarios
        self.events.add(event)

    def __reduce__(self) -> NoReturn:
        """Refuses to be copied or pickled: laws hold addresses of its arrays, so that a copy would move the original.

        Raises:
            TypeError: Always.
        """
        raise TypeError("simulation: cannot be copied or pickled; another one of its scenarios gives the same bits")

    def step(self) -> None:
        """Computes one control period, as in figure 3; an error of a user's stage fails all robots, which share it."""
        try:
            seen, reference = self.sense()
            now, _ = self.courses.at(self.tick)
            self.plant.step(self.hierarchy.update(seen, reference), self.hierarchy.faults)
            self.log.record(self.tick, self.plant.state, seen, now, self.hierarchy.state)
        except StageError as error:
            self._abort(f"{error}, tick {self.tick}")
        self.judge()

    def sense(self) -> tuple[Rows, Rows]:
        """Applies the events of the coming tick and measures; further calls before `judge` only return the result.

        Returns:
            Estimate of each robot, a record of `SEEN`, and its reference, one of `REFERENCE`, `(B,)` each; both are
            predicted to the time at which the voltage of this tick acts.

        Raises:
            StageError: The user's estimator raised, or returned something of another shape.
        """
        if not self._sensed:
            self.events.apply(self.tick)
            self.estimator.measure(self.tick, self.plant.state, self.hierarchy.derivative)
            self._sensed = True
        _, reference = self.courses.at(self.tick)
        return self.estimator.seen, reference

    def _abort(self, reason: str) -> None:
        """Fails all robots before the physics; the records until now are kept."""
        for row in range(self.plant.size):
            self.plant.fail(row, reason)
        self.log.blank(self.tick, slice(None))

    def judge(self) -> None:
        """Ends the tick: fails robots that have left their references, and ends runs at their goals, stuck or over."""
        plant, log, tick = self.plant, self.log, self.tick
        if not log.near and not self.hierarchy.roams:
            for row in np.flatnonzero(np.abs(log.now["lateral_error"]) > MAX_LATERAL_ERROR):
                if self.scenarios[row].goal is None:  # a robot with a goal may wait, or leave its reference
                    plant.fail(int(row), f"lateral error over {MAX_LATERAL_ERROR:g} m")
        self.tick, self._sensed = self.tick + 1, False
        if plant.running < plant.size:
            new = plant.failed & np.isnan(self._failure_time)
            new[list(self._learned)] = False
            self._failure_time[new] = self.tick * self.period
            self._keep_learned(np.flatnonzero(new).tolist())
            log.blank(tick, plant.failed)
        if self.goals.any:
            self._end(tick)

    def restart(self, row: int, scenario: Scenario) -> None:
        """Begins the run of one robot again at the coming tick.

        The tick must not be sensed yet, unless all robots begin again in it.

        Args:
            row: Index of the robot.
            scenario: Its scenario from now on, which fits the group and differs in seed and perturbation at most.

        Raises:
            InputError: The robot could not stand.
            ValueError: The simulation was not made with `restarting`.
        """
        if not isinstance(self.courses, RestartingCourses):
            raise ValueError("restart: the simulation was not made with `restarting`")
        plant, tick = self.plant, self.tick
        if scenario.perturbation != self.scenarios[row].perturbation:
            self.events.perturb(row, scenario.perturbation)
        self.courses.restart(row, tick)
        self.scenarios[row], self._sensed = scenario, False
        self.hierarchy.renew(row, scenario)
        self.events.restart(row, scenario, tick)
        reference, _ = self.courses.at(tick)
        plant.restart(row, start_pose(scenario, reference["pose"][row]), reference["twist"][row])
        self.hierarchy.reset(reference["twist"], reference["acceleration"], plant.reading["steering_angle"], row)
        self.sensors.restart(row, scenario.seed, tick)
        self.estimator.start(row, plant.reading[row], scenario.seed, tick)
        self._failure_time[row] = np.nan
        self.goals.restart(row, tick)
        self._learned.pop(row, None)
        self._final.pop(row, None)

    def _end(self, tick: int) -> None:
        """Ends the runs that are at their goals, stuck or at their own end; the record of the tick is kept."""
        ended = self.goals.ended(tick, self.log.now)
        ended = {row: reason for row, reason in ended.items() if row not in self._learned}
        if ended and not all(ended.values()) and (coefficients := self.parameters()) is not None:
            known, true = coefficients
            self._final |= {row: (known[row].copy(), true[row].copy()) for row in ended if not ended[row]}
        for row, reason in ended.items():
            self.plant.fail(row, reason)
            self._keep_learned([row])
            if reason:
                self._failure_time[row] = self.tick * self.period

    def _keep_learned(self, rows: Sequence[int]) -> None:
        """Keeps what robots have learned at their ends, for their learners go on in the batch."""
        if rows:
            learned = self._adapted()
            self._learned |= {row: learned[row].copy() for row in rows}

    def _adapted(self) -> Array:
        """Returns what the learners have adapted, as `Learner.adapted`; a stage that cannot say it fails all runs."""
        learner = self.hierarchy.learner
        try:
            return learner.adapted()
        except StageError as error:
            assert isinstance(learner, UserFeedforward)
            for row in np.flatnonzero(~self.plant.failed).tolist():
                self.plant.fail(row, str(error))
                self._failure_time[row] = self.tick * self.period
            width = sum(int(np.prod(shape)) for shape in learner.shapes.values())
            return np.full((self.plant.size, width), np.nan)

    def result(self) -> xr.Dataset:
        """Returns the signals so far or, once every run has ended, those of the whole time, with NaN after the ends."""
        size, length = len(self.scenarios), self.tick if self.running else self.ticks
        for tick in range(self.tick, length):
            self.log.blank(tick, slice(None))
        label, feedforward = titles(self.scenarios[0], self._stages)
        names = [label] * size, [feedforward] * size
        log, failure = self.log.ticks[:length], self.plant.failure
        found = dataset.dataset(self.scenarios, *names, log, failure, self._failure_time, self._weights())
        scanned = {}
        if self.estimator.scanner:
            scanned["scanned"] = "run", np.ones(size, bool), {"long_name": "whether its lidar scanned"}
        faults = {name: ("run", np.array(texts, object)) for name, texts in self.faults.items()}
        extra = self._coefficients() | self._layout() | self._clearance(length) | scanned | faults
        return found.assign(extra | self._constants() | self._gains())

    def _weights(self) -> Array | None:
        """Returns what each robot has learned, as of its end if it has ended, flat; None if nothing is learned."""
        learned = self._adapted()
        if not learned.size:
            return None
        for row, kept in self._learned.items():
            learned[row] = kept
        return learned

    def _layout(self) -> dict[str, Any]:
        """Returns the variable `LAYOUT`, where a feedforward of the user keeps what it learns."""
        learner = self.hierarchy.learner
        if not (isinstance(learner, UserFeedforward) and learner.shapes):
            return {}
        text = json.dumps({"learner": learner.stage.name, "shapes": learner.shapes})
        return {LAYOUT: ("run", np.array([text] * len(self.scenarios), object))}

    def _coefficients(self) -> dict[str, Any]:
        """Returns variables with the coefficients of `parameters`, where the learner has some."""
        if (coefficients := self.parameters()) is None:
            return {}
        axes, units = ("run", "feature", "channel"), {"units": "V"}
        known, true = coefficients
        return {"parameters": (axes, known, units), "true_parameters": (axes, true, units)}

    def _constants(self) -> dict[str, Any]:
        """Returns the variables with which the features of a commanded motion are computed."""
        size, robot = len(self.scenarios), self.plant.robot
        return {
            "half_track": ("run", np.full(size, robot.half_track), {"units": "m"}),
            "feature_scale": (("run", "feature"), np.tile(feature_scale(robot), (size, 1))),
        }

    def _gains(self) -> dict[str, Any]:
        """Returns variables with the gains of the controllers before any event."""
        gains = {}
        for name, (unit, meaning) in dataset.GAIN_VARIABLES.items():
            values = self.hierarchy.gains[name].copy()
            gains[name] = ("run", "channel")[: values.ndim], values, {"units": unit, "long_name": meaning}
        return gains

    @property
    def faults(self) -> dict[str, list[str]]:
        """Variables of `dataset.FAULTS`: for each robot the first fault of a stage of the user, or ""."""
        none = [""] * len(self.scenarios)
        return {
            "estimator_fault": getattr(self.estimator, "faults", none),
            "feedforward_fault": getattr(self.hierarchy, "feedforward_faults", none),
        }

    def _clearance(self, length: int) -> dict[str, Any]:
        """Returns the variable `clearance`, where there are obstacles: the distance of each footprint from them."""
        if not self.scenarios[0].obstacles.shapes:
            return {}
        footprint, ticks = hull.footprint(self.model), self.log.ticks[:length]
        made = {obstacles: Surroundings(obstacles) for obstacles in dict.fromkeys(s.obstacles for s in self.scenarios)}
        around = [made[s.obstacles] for s in self.scenarios]
        poses, times = (
            np.stack([ticks[name].T for name in ("x", "y", "theta")], -1),
            self.period * np.arange(length, dtype=float),
        )
        found = np.stack([clearances(footprint, poses[row], times, around[row]) for row in range(len(poses))])
        attributes = {"units": "m", "long_name": "distance of the footprint from the nearest obstacle"}
        return {"clearance": (("run", "time"), found, attributes)}

    def parameters(self) -> tuple[Array, Array] | None:
        """Returns the coefficients of the scaled features: the sum of prior and learner, and the true ones.

        They are those of now or, where a run has ended without failure, those of its end.

        Returns:
            Two arrays `(B, 8, 2)` in V, NaN where the second channel is steering, and the first also where a robot has
            failed; None if the learner has no such coefficients.
        """
        hierarchy = self.hierarchy
        if (learned := hierarchy.learner.parameters) is None:
            return None
        scale = feature_scale(self.plant.robot)[:, None]
        known = scale * hierarchy.prior.rows["c"] + learned
        true = scale * np.stack([inverse_coefficients(robot) for robot in self.plant.truth])
        known[self.plant.failed] = np.nan
        if self.scenarios[0].steering == "rigid":  # the second channel is steering
            known[:, :, 1] = true[:, :, 1] = np.nan
        for row, final in self._final.items():
            known[row], true[row] = final
        return known, true
