"""The closed loop: plant, sensors, estimator, controllers and log of robots that run together, tick by tick."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NoReturn, Unpack

import numpy as np
import xarray as xr

from mrctl.control.stages import Stages
from mrctl.kernel import Rows
from mrctl.loop.courses import Courses, RestartingCourses, start_pose
from mrctl.loop.events import Events
from mrctl.loop.goals import Goals
from mrctl.loop.groups import together, worthwhile
from mrctl.loop.hierarchy import Hierarchy
from mrctl.loop.log import MAX_LATERAL_ERROR, Log
from mrctl.loop.outcome import Outcome
from mrctl.loop.user_hierarchy import UserHierarchy
from mrctl.loop.user_stages import StageError, UserEstimator, UserStage, named_stages
from mrctl.physics import mjcf, tyres
from mrctl.physics.plant import Plant, build
from mrctl.record import InputError
from mrctl.scenario import Event, Scenario
from mrctl.sensing.estimators import Estimator
from mrctl.sensing.scanner import Scanner
from mrctl.sensing.sensors import Sensors
from mrctl.theory.references import check
from mrctl.theory.robot import Robot, Tyres


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
        outcome: How the runs ended.
        tick: Number of control periods done.
        ticks: Number of control periods in the whole run, in the longest where they differ.
    """

    def __init__(
        self, scenarios: Sequence[Scenario], *, threads: int = 0, restarting: bool = False, **stages: Unpack[Stages]
    ) -> None:
        """Compiles the world, and sets the robots on their references with the twist of the reference.

        Args:
            scenarios: Scenarios of one group, see `groups.group_of`.
            threads: Largest number of threads of the batch engine; 0 for all cores. Control runs on one.
            restarting: Whether robots begin again on their own, with `restart`. Then no run ends at its own time, and
                the log keeps the last tick only.
            stages: As in `simulate`.

        Raises:
            InputError: A scenario or a stage is refused, as in `simulate`.
        """
        from mrctl.loop.announcement import announced  # imported here because it needs Numba

        announced()
        self.scenarios = scenarios = together(scenarios)
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
        self.log = Log(1 if restarting else self.ticks, size)
        self.goals = Goals(scenarios, timed=not restarting)
        self.outcome = Outcome(self.plant, self.hierarchy, self.estimator, self.period)
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
        """Computes one control period, as in figure 3; an error of a user's stage fails all robots, which share it.

        Raises:
            ValueError: All `ticks` are done, and the simulation was not made with `restarting`.
        """
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
            self.plant.stop(row, reason)
        self.log.blank(self.tick, slice(None))

    def judge(self) -> None:
        """Ends the tick: fails robots that have left their references, and ends runs at their goals, stuck or over."""
        plant, log, tick = self.plant, self.log, self.tick
        if not log.near and not self.hierarchy.roams:
            for row in np.flatnonzero(np.abs(log.now["lateral_error"]) > MAX_LATERAL_ERROR):
                if self.scenarios[row].goal is None:  # a robot with a goal may wait, or leave its reference
                    plant.stop(int(row), f"lateral error over {MAX_LATERAL_ERROR:g} m")
        self.tick, self._sensed = self.tick + 1, False
        if plant.running < plant.size:
            self.outcome.fail(self.tick)
            log.blank(tick, plant.stopped)
        if self.goals.any:
            self.outcome.end(self.goals.ended(tick, log.now), self.tick)  # the record of the tick is kept

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
        self.goals.restart(row, tick)
        self.outcome.restart(row)

    def result(self) -> xr.Dataset:
        """Returns the signals so far or, once every run has ended, those of the whole time, with NaN after the ends."""
        length = self.tick if self.running else self.ticks
        for tick in range(self.tick, length):
            self.log.blank(tick, slice(None))
        return self.outcome.result(self.scenarios, self._stages, self.log, length)
