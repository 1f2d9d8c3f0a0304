"""A live session: robots that drive, and events that visitors add; its scenarios repeat it headless, bit for bit."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import ceil, floor, pi, remainder
from typing import Any

import numpy as np
import xarray as xr

from mrctl.control.kanayama import Kanayama
from mrctl.control.margins import Gains
from mrctl.control.stages import MotionStage, Stages
from mrctl.kernel import Array, Rows
from mrctl.loop.groups import arranged, uniform
from mrctl.loop.runs import run
from mrctl.loop.simulation import Simulation
from mrctl.loop.timeline import followed, state
from mrctl.navigation.avoiders import avoiding
from mrctl.navigation.generators import Task
from mrctl.navigation.plan import Plan
from mrctl.navigation.planning import PLAN_MARGIN, REPLAN_MARGIN, Avoid, prepared
from mrctl.navigation.reactive import Reactive
from mrctl.physics.contacts import NO_CONTACTS, Contacts
from mrctl.physics.hull import footprint
from mrctl.record import InputError
from mrctl.results.dataset import blank, combine, dataset
from mrctl.scenario import Event, Scenario
from mrctl.sensing.prediction import advance
from mrctl.theory.clearance import clearance, clearances
from mrctl.theory.obstacles import Pose, Surroundings, turned
from mrctl.theory.references import Waypoints, check
from mrctl.theory.robot import Robot
from mrctl.theory.timing import LIMIT_SHARE, Limits

MAX_TIME = 3600.0  # s of simulated time after which a session ends
MIN_PUSH_TIME = 0.5  # s, for which a push is drawn, at least
SHARED_FIELDS = ("world", "obstacles", "map", "robot", "steering", "control_period", "physics_step")


class Session:
    """One or more robots in one world, driven by `Simulation.step` alone.

    Attributes:
        start: Scenarios at the start of the session.
        avoid: What keeps the robots from obstacles that the map lacks or that move.
        simulations: Indices of the robots in each simulation, and the simulation.
        period: Control period in s.
        preview: Number of control periods until all robots follow a new reference, the largest of the simulations.
        tick: Number of control periods done.
    """

    def __init__(self, scenarios: Sequence[Scenario], avoid: Avoid = "none") -> None:
        """Sets the robots on their references.

        Args:
            scenarios: Scenario of each robot; their laps are ignored, since a session lasts up to an hour.
            avoid: What keeps robots on a mission from obstacles that the map lacks or that move.

        Raises:
            InputError: A scenario is refused, as by `mrctl.simulate`, or robots differ in a field of `SHARED_FIELDS`.
        """
        scenarios = [arranged(s) for s in scenarios]
        for name in SHARED_FIELDS:
            if len({getattr(s, name) for s in scenarios}) > 1:
                raise InputError(f"{name}: robots in one scene must share it")
        self.start = list(scenarios)
        self.period = scenarios[0].control_period
        long = [s.model_copy(update={"laps": max(1, floor(MAX_TIME / s.reference.period))}) for s in scenarios]
        self.avoid: Avoid = avoid
        motion, self._stages = avoiding(avoid), []

        def kept(robot: Robot, size: int) -> MotionStage:
            assert motion is not None
            self._stages.append(motion(robot, size))
            return self._stages[-1]

        stages: Stages = {"motion": kept} if motion else {}
        self.simulations = [
            (rows, Simulation([long[row] for row in rows], threads=1, **stages)) for rows in uniform(long)
        ]
        self._place = {row: (sim, k) for rows, sim in self.simulations for k, row in enumerate(rows)}
        self.preview = max(sim.preview for _, sim in self.simulations)
        self.tick = 0
        self._surroundings = Surroundings(scenarios[0].obstacles)
        self._footprint = footprint(self.simulations[0][1].model) if scenarios[0].obstacles.shapes else np.zeros((0, 2))
        self._clearance = np.empty((max(sim.ticks for _, sim in self.simulations), len(scenarios)))
        self._cleared = 0  # number of ticks whose clearances are known

    @property
    def size(self) -> int:
        """Number of robots."""
        return len(self.start)

    @property
    def robot(self) -> Robot:
        """Parameters of the robots without their perturbations."""
        return self.simulations[0][1].plant.robot

    @property
    def time(self) -> float:
        """Simulated time in s."""
        return self.tick * self.period

    @property
    def running(self) -> bool:
        """Whether at least one robot still drives."""
        return any(sim.running for _, sim in self.simulations)

    @property
    def tunable(self) -> bool:
        """Whether the motion controller takes gains of Kanayama's law."""
        return all(sim.hierarchy.tunable for _, sim in self.simulations)

    def step(self) -> None:
        """Does one control period of every robot."""
        with np.errstate(invalid="ignore", over="ignore"):  # as in `simulate`
            for _, sim in self.simulations:
                if sim.running:
                    sim.step()
        self.tick += 1

    @property
    def added(self) -> tuple[Event, ...]:
        """Events that visitors have added, in the order in which they did."""
        each = (saved.events[len(start.events) :] for saved, start in zip(self.saved(), self.start, strict=True))
        return max(each, key=len)  # a robot that has stopped gets no more

    def repeated(
        self, scenarios: Sequence[Scenario], tick: int, progress: Callable[[int], object] | None = None
    ) -> Session:
        """Returns another session that has done the ticks before one of this one, with the same events of visitors.

        With the scenarios of this session the robots did the same in them, to the bit.

        Args:
            scenarios: Scenario of each robot at the start.
            tick: Number of control periods to do; events that had no effect before are left out.
            progress: Is called after every tick of a simulation with the number of its robots.

        Raises:
            InputError: As for a new session, or an event does not fit the scenarios.
        """
        other = Session(scenarios, self.avoid)
        for event in self.added:
            known = self.preview if event.reference else 0  # a reference acts that long before its time
            if event.tick(self.period) - known < tick:
                for _, sim in other.simulations:
                    sim.add(event)
        run([sim for _, sim in other.simulations], progress, tick, threads=1)
        other.tick = tick
        return other

    def apply(self, **change: Any) -> None:  # noqa: ANN401
        """Applies an event to every robot at the coming tick, or a new reference as soon as a voltage can act on it.

        Args:
            change: Fields of `Event`, without the time.

        Raises:
            InputError: The event is refused; then nothing changes.
        """
        preview = self.preview if "reference" in change else 0
        event = Event.from_dict({"time": (self.tick + preview) * self.period, **change})
        for _, sim in self.simulations:
            if sim.tick == self.tick:  # the others have stopped
                sim.add(event)

    def head_for(self, goal: Pose) -> Plan:
        """Plans a way for the first robot, and gives it to every robot as an event.

        The plan begins where that robot is when it follows it, with the twist that it is asked for now. It keeps 5 cm
        from obstacles on the map, or 2 cm where the robot is nearer than that then.

        Args:
            goal: x and y in m and θ in rad.

        Raises:
            InputError: The robot has stopped, the goal is in an obstacle, or there is no way.
        """
        (x, y, theta), twist = self._coming("goal")
        first = self.start[0]
        start = x, y, remainder(theta, 2 * pi)
        task = Task.from_dict({"obstacles": first.obstacles, "map": first.map, "start": start, "goal": goal})
        near = clearance(self._footprint, np.array(start), Surroundings(first.known).at(0.0))
        plan = followed(self.saved()[0], self.time)
        speed = plan.speed if isinstance(plan, Waypoints) else None
        margin = PLAN_MARGIN if near > PLAN_MARGIN else REPLAN_MARGIN
        found, driven = prepared(task, first, speed, margin, self.avoid, twist)
        self.apply(reference=driven.reference)
        return found

    def check_way(self) -> None:
        """Raises `InputError` if robots have an avoider, which takes goals alone."""
        if self.avoid != "none":
            raise InputError(f"way: with --avoid {self.avoid} the robots take goals alone")

    def way(self, points: Sequence[Array], closed: bool) -> Waypoints:
        """Returns a way from the first robot, straight ahead at first, through points, at the speed of its reference.

        One that does not return begins with the speed of the robot, or with the largest that its limits allow.

        Args:
            points: Places in m, `(2,)` each.
            closed: Whether it returns to where the robot is and begins again; otherwise it ends on the last point.

        Raises:
            InputError: The robot has stopped, cannot follow such a way, or would touch an obstacle as they are now; or
                it has an avoider, which takes goals alone.
        """
        self.check_way()
        (x, y, theta), (velocity, _) = self._coming("way")
        reach = abs(self.robot.wheelbase)
        ahead = x + reach * np.cos(theta), y + reach * np.sin(theta)
        now = followed(self.saved()[0], self.time)
        speed = (
            now.speed if isinstance(now, Waypoints) else now.sample(np.linspace(0, now.period, 400)).twist[:, 0].max()
        )
        found = Waypoints.from_dict({
            "points": [(x, y), ahead, *map(tuple, points)], "closed": closed, "timing": "limits",
            "speed": min(speed, LIMIT_SHARE * self.robot.max_speed), "limits": Limits.of(self.robot),
            "start_speed": 0.0 if closed else max(0.0, velocity),
        })  # fmt: skip
        check(found, self.robot, reverse=False)
        if len(self._footprint):
            poses = found.sample(np.linspace(0, found.period, max(2, round(100 * found.period)))).pose
            near = clearances(self._footprint, poses, np.full(len(poses), self.time), self._surroundings)
            if near.min() <= 0:
                raise InputError("way: meets an obstacle near ({:.2f}, {:.2f}) m".format(*poses[near.argmin(), :2]))
        return found

    def _coming(self, what: str) -> tuple[tuple[float, float, float], tuple[float, float]]:
        """Returns where the first robot is when it follows a new reference, and how it drives; refuses a stopped one.

        Returns:
            x and y in m and θ in rad; and the twist that it is asked for now, V in m/s and θ̇ in rad/s.
        """
        sim, k = self._place[0]
        if sim.plant.stopped[k]:
            raise InputError(f"{what}: the first robot has stopped; a reset starts again")
        (x, y, theta), (v, omega) = sim.plant.reading["pose"][k].tolist(), sim.hierarchy.command[k].tolist()
        x, y, theta, *_ = advance.compiled(x, y, theta, v, omega, 0.0, 0.0, self.preview * self.period)
        return (x, y, theta), (v, omega)

    def state(self, time: float | None = None) -> dict[str, Any]:
        """Returns the values of the fields `CHANGEABLE`, and `learning`, at a time in s, by default now."""
        return state(self.fullest, self.time if time is None else time)

    def designed(self) -> dict[tuple[str, ...], float | None]:
        """Returns what fields of the first robot are while they are not set, by path, as `Hierarchy` designs them.

        The values are in the units of the fields, to three digits. `pid.time_constant` is 0, as the designed gains are
        not those of any; the gains on the steering are None unless it is rigid.
        """
        sim, k = self._place[0]
        rigid, over = self.start[0].steering == "rigid", sim.hierarchy.settings[k].design
        _, delay = sim.hierarchy.lengthened(k, self.state()["pid"])
        kanayama = Kanayama(k_y=self.state()["kanayama"].k_y).completed(over.kanayama)  # K_θ follows a K_y that is set
        values: dict[tuple[str, ...], float | None] = {
            ("prefilter",): over.prefilter,
            **{("kanayama", name): value for name, value in kanayama.model_dump().items()},
            ("pid", "time_constant"): 0.0,
            ("pid", "delay"): delay,
        }
        _, second = self.gains()
        values |= {
            ("pid", "steering_kp"): second.k_p if rigid else None,
            ("pid", "steering_ki"): second.k_i if rigid else None,
        }
        return {path: None if value is None else float(f"{value:.3g}") for path, value in values.items()}

    def gains(self) -> tuple[Gains, Gains]:
        """Returns the present gains of both channels of the first robot, in the units of `Pid.channels`."""
        sim, k = self._place[0]
        pid, delay = sim.hierarchy.lengthened(k, self.state()["pid"])
        return pid.channels(self.robot, self.start[0].steering == "rigid", delay, self.period)

    @property
    def oscillations(self) -> int:
        """Number of oscillations that have slowed the controllers of the first robot; see `mrctl.control.delay`."""
        sim, k = self._place[0]
        moves = int(sim.hierarchy.state["delay"]["moves"][k])
        return moves // 2 if self._stages else moves  # beside an avoider two moves answer each

    def saved(self) -> list[Scenario]:
        """Returns scenarios that repeat the session, to the end of the present lap of each robot."""
        whole = [sim.scenarios[k] for sim, k in (self._place[row] for row in range(self.size))]
        return [s.model_copy(update={"laps": max(1, ceil(self.time / s.reference.period - 1e-9))}) for s in whole]

    @property
    def fullest(self) -> Scenario:
        """The scenario with the most events; a robot that has stopped gets no more."""
        return max(self.saved(), key=lambda s: len(s.events))

    def log(self, first: int = 0, last: int | None = None) -> Rows:
        """Returns the log from a tick on, and up to another one, without it.

        Returns:
            A record of `TICK` for each tick and robot, `(T, B)`; NaN after a robot has stopped.
        """
        last = self.tick if last is None else last
        parts = blank(last - first, self.size)
        for rows, sim in self.simulations:
            done = sim.log.ticks[first : min(last, sim.tick)]
            parts[: len(done), rows] = done
        return parts

    def parameter_error(self) -> Array | None:
        """Returns the learned less the true coefficients of the scaled features now, `(B, 8, 2)` in V.

        They are NaN for learners without such coefficients; None if no learner has any.
        """
        found = np.full((self.size, 8, 2), np.nan)
        for rows, sim in self.simulations:
            if (coefficients := sim.outcome.parameters()) is not None:
                found[rows] = coefficients[0] - coefficients[1]
        return None if np.isnan(found).all() else found

    def clearance(self, first: int = 0) -> Array | None:
        """Returns the distances from the nearest obstacle in m from a tick on, `(T, B)`; None without obstacles.

        They are NaN after a robot has stopped. Each is computed once, when it is asked for.
        """
        if not self.start[0].obstacles.shapes:
            return None
        known, now = self._cleared, self.tick
        if known == now:
            return self._clearance[first:now]
        times, log = self.period * np.arange(known, now, dtype=float), self.log(known)
        poses = np.stack([log[name] for name in ("x", "y", "theta")], axis=-1)
        for row in range(self.size):
            self._clearance[known:now, row] = clearances(self._footprint, poses[:, row], times, self._surroundings)
        self._cleared = now
        return self._clearance[first:now]

    def scan(self, row: int) -> tuple[Array, Array] | None:
        """Returns what a robot has of its last scan; None where no lidar has scanned yet.

        Returns:
            Places in the world that the beams met, as seen from the true pose, in m, `(n, 2)`; and the particles, poses
            in m, m, rad, `(k, 3)`, none with scan matching.
        """
        sim, k = self._place[row]
        scanner, localiser = sim.estimator.scanner, sim.estimator.localiser
        if scanner is None or (ranges := scanner.scans[k]) is None or scanner.taken[k] >= sim.tick:
            return None
        then, particles = sim.log.ticks[scanner.taken[k], k], localiser.filters[k] if localiser else None
        pose = np.array([then["x"], then["y"], then["theta"]])
        met = turned(self.start[row].sensing.lidar.points(ranges), pose)
        return met, np.zeros((0, 3)) if particles is None else particles.particles

    def contacts(self, row: int) -> Contacts:
        """Returns what a robot touches now; nothing once it has stopped."""
        sim, k = self._place[row]
        return NO_CONTACTS if sim.plant.stopped[k] else sim.plant.contacts(k)

    def considered(self, row: int) -> tuple[Array, Array] | None:
        """Returns the ways that the avoider of a robot considered last, from the samples that it drew itself.

        Returns:
            Places on some of its roll-outs and on the one that it chose in m, `(k, n, 2)` and `(n, 2)`; None where it
            has none.
        """
        sim, k = self._place[row]
        index = next(i for i, (_, other) in enumerate(self.simulations) if other is sim)
        stage = self._stages[index] if self._stages else None
        if not isinstance(stage, Reactive) or not sim.tick or (found := stage.considered[k]) is None:
            return None
        return found.paths(self.start[row].motion_period)

    def result(self, first: int, last: int | None = None) -> xr.Dataset:
        """Returns the signals of what `log` returns, as a result of `simulate` without what was learned."""
        names, failure = [s.feedforward for s in self.start], [self.failure(row) for row in range(self.size)]
        nothing = np.full(self.size, np.nan)
        saved = self.saved()
        part = dataset(saved, names, names, self.log(first, last), failure, nothing, None)
        if (clearance := self.clearance(first)) is not None:
            part = part.assign(clearance=(("run", "time"), clearance[: part.sizes["time"]].T))
        found = combine([(range(self.size), part)], saved)
        return found.assign_coords(time=found["time"] + first * self.period)

    def driven(self) -> Rows:
        """Returns a view of the log of the first robot, a record of `TICK` for each tick that it has driven."""
        sim, k = self._place[0]
        return sim.log.ticks[: sim.tick, k]

    def qpos(self, row: int) -> Array:
        """Returns the generalised position of a robot, `(nq,)`."""
        sim, k = self._place[row]
        return sim.plant.qpos[k]

    def failure(self, row: int) -> str:
        """Returns the reason why a robot has stopped, or ""."""
        sim, k = self._place[row]
        return sim.plant.failure[k]


def pushed(scenario: Scenario, time: float) -> Array | None:
    """Returns the sum of the pushes that act, or are half a second old at most, along x and y in N, `(2,)`, or None."""
    forces = [
        event.push[:2]
        for event in scenario.events
        if event.push is not None and 0 < time - event.time + 1e-9 < max(event.push_duration, MIN_PUSH_TIME)
    ]
    return np.sum(forces, axis=0) if forces else None
