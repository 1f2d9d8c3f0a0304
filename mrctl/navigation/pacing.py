"""A plan in time whose clock waits for the braking filter and for the robot: the motion stage `barrier` of missions.

A robot that follows a plan in time is not helped by the nearest twist that `barrier_filter` allows: the plan goes on
without it, and its controller then asks for a way across obstacles. The same holds for a robot whose motors are too
weak for the plan. `Pacing` therefore slows the plan itself.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mrctl.control.kanayama import GAINS, Kanayama, kanayama, posture_error
from mrctl.kernel import Array, Rows, kernel
from mrctl.loop.goals import ARRIVAL_SPEED
from mrctl.navigation.barrier import Barrier, approach, share
from mrctl.navigation.plan import least_clearance
from mrctl.navigation.replanning import BLOCKED_RETRY, HEADWAY_TIME, SHORTER_SHARE, Planner, Replan
from mrctl.scenario import Scenario
from mrctl.theory.clearance import rim
from mrctl.theory.rays import Scan
from mrctl.theory.references import Reference, Waypoints
from mrctl.theory.robot import Robot

BRAKING_SHARE = 0.5  # share of the robot's acceleration that the filter counts on, for the robot lags behind the twist
RIM_RADIUS = 0.02  # m, radius of the discs around the robot, which reach as far beyond its footprint
# m, margins of these discs from what is on the map and from what moves; chosen
STANDING_MARGIN, MOVING_MARGIN = 0.02, 0.1
# m, for errors of tracking: by so much the margin from the map is at least below that of the plan
TRACKING_MARGIN = 0.01
STANDOFF = 1.0  # m before a blocked place of its plan, where the robot stops, so that it can drive around it; chosen
CATCH_UP_SPEED = 0.1  # m/s, by which a robot that lags drives faster than the plan at most; chosen
MIN_PACE = 0.1  # mean λ over the time HEADWAY_TIME, below which a robot makes no headway; chosen


class Following:
    """Kanayama's motion controller, as a part of a stage that is told its gains."""

    def __init__(self, size: int) -> None:
        """Takes the number of robots."""
        self._gains = np.zeros(size, GAINS)

    def tune(self, row: int, gains: Kanayama) -> None:
        """Sets the gains of one robot."""
        self._gains[row] = gains.k_x, gains.k_y, gains.k_theta

    def output(self, pose: Array, reference: Array) -> Array:
        """Returns the requested twists, `(B, 2)`; the arguments are those of `mrctl.control.stages.MotionStage`."""
        requests = np.empty((len(pose), 2))
        follow_all.compiled(pose, reference, self._gains, np.empty(3), requests)
        return requests


@kernel
def follow_all(pose: Array, reference: Array, gains: Rows, error: Array, requests: Array) -> None:
    """Writes what `Following.output` returns into `requests`, `(B, 2)`; `error` is scratch, `(3,)`."""
    for i in range(len(pose)):
        posture_error(pose[i], reference[i, :3], error)
        kanayama(error, reference[i, 3:5], gains[i], requests[i])


class Pacer:
    """One robot on a plan in time: its clock, how fast that goes, and when it takes another plan."""

    def __init__(self, planner: Planner, robot: Robot, period: float) -> None:
        """Starts a run on the plan of the mission.

        Args:
            planner: Its mission, and what it knows.
            robot: Nominal robot.
            period: Motion period in s.
        """
        self._planner, self._robot, self._period = planner, robot, period
        self._brakes = BRAKING_SHARE * robot.max_acceleration
        self._discs = rim(planner.vehicle.footprint, RIM_RADIUS)
        self._near, self._away = self._barrier(-RIM_RADIUS), self._barrier(MOVING_MARGIN)
        self._pace, self._driven = 1.0, np.zeros(2)  # λ, and the twist of the plan at this pace, m/s and rad/s
        planner.reset()
        scenario = planner.scenario
        self._follow(planner.first, scenario.sensing.periods("delay", scenario.control_period))

    def _barrier(self, margin: float) -> Barrier:
        """Returns the filter that keeps this clearance in m."""
        return Barrier(self._discs, margin, self._brakes, self._period)

    def _follow(self, plan: Waypoints, delay: int = 0) -> None:
        """Goes along a plan from its beginning.

        Args:
            plan: The plan.
            delay: Control periods after its beginning at which the first voltage acts.
        """
        scenario, footprint = self._planner.scenario, self._planner.vehicle.footprint
        step = scenario.control_period
        ticks = round(self._period / step) * np.arange(int(plan.period / self._period) + 2) + delay
        # For each motion period the plan as the stage gets a reference, `(n, 7)`.
        self._plan = np.hstack(plan.sample(np.asarray(step * ticks, float)))
        # The margin from the map is smaller than what the plan has, and negative where the discs overlap the map on it.
        free = least_clearance(footprint, plan, self._planner.sight.map)
        self._kept = self._barrier(min(STANDING_MARGIN, free - RIM_RADIUS - TRACKING_MARGIN))
        self._clock, self._anchor = 0.0, 0.0  # the clock in motion periods: now, and where the robot last made headway
        self._place = np.inf  # the clock at which the plan is blocked, in motion periods; infinite where it is free
        self._stops = False  # whether the robot stops for a shorter way
        self._planner.blocked = np.inf

    def take(self, plan: Reference, now: float) -> None:
        """Takes a plan to another goal at a time in s."""
        self._begin(self._planner.take(plan, now), now)

    def _begin(self, plan: Waypoints, now: float) -> None:
        """Drives another plan from now on, a time in s, at the pace at which the robot keeps its speed."""
        self._follow(plan)
        velocity, first = float(self._driven[0]), float(self._plan[0, 3])
        if velocity * first > 0:
            self._pace = min(1.0, velocity / first)
        self._planner.got_on, self._planner.tried, self._planner.map_changed = now, -np.inf, False

    def see(self, scan: Scan) -> None:
        """Takes a scan, and looks whether its plan is free."""
        self._planner.see(scan)
        first = self._first
        way = np.cumsum(np.abs(self._plan[first:, 3])) * self._period
        place = self._planner.look_ahead(self._plan[first:, :3], way, scan.time)
        self._place = np.inf if place is None else first + place

    @property
    def _first(self) -> int:
        """Index of the sample of the plan before its clock."""
        return min(int(self._clock), len(self._plan) - 2)

    @property
    def reference(self) -> Array:
        """The plan at its clock, in the units of a reference of the stage, `(7,)`."""
        first = self._first
        return self._plan[first] + min(self._clock - first, 1.0) * (self._plan[first + 1] - self._plan[first])

    def go_on(self, request: Array, pose: Array, reference: Array, time: float) -> None:
        """Sets the pace as near to the allowed λ as the robot can follow, and advances the clock of the plan by it.

        Args:
            request: Twist that Kanayama's law requests, V in m/s and θ̇ in rad/s, `(2,)`; out: what is allowed of it.
            pose: x and y in m and θ in rad, `(3,)`.
            reference: The plan at its clock, `(7,)`; out: the same at the pace.
            time: Time in s.
        """
        before, twist, tick = self._pace, reference[3:5].copy(), self._planner.scenario.control_period
        change = self._period * self._robot.max_acceleration / max(abs(float(twist[0])), 1e-9)
        wanted = self._share(request, pose, twist, time)
        self._pace = min(max(wanted, before - change), before + BRAKING_SHARE * change, 1.0)
        # The twist goes on at the rate of its acceleration, and so gets to the new pace in the last control period.
        start = self._pace - (1 - tick / self._period) * (self._pace - before)
        reference[3:5], self._driven = start * twist, self._pace * twist
        reference[5:] = self._pace * self._pace * reference[5:] + (self._pace - before) / self._period * twist
        self._clock += self._pace
        request *= start

    def _share(self, request: Array, pose: Array, twist: Array, time: float) -> float:
        """Returns the largest λ at a time in s for the filter, the lag, the way to where it is blocked, and a stop."""
        sight, found = self._planner.sight, 0.0 if self._stops else 1.0
        if request[0] * twist[0] > 0:
            found = min(found, float((abs(twist[0]) + CATCH_UP_SPEED) / abs(request[0])))
        if np.isfinite(self._place):
            part = self._plan[int(self._clock) : int(self._place), 3]
            left = self._period * float(np.abs(part).sum()) - STANDOFF
            braked = approach.compiled(left, self._brakes, self._period) / max(abs(float(request[0])), 1e-9)
            found = min(found, braked)
        around = (sight.map, self._kept), (sight.standing, self._near), (sight.moving(time), self._away)
        near = [each for each in around if len(each[0].discs) + len(each[0].rings)]
        return min([found, *(share(request, pose, *each) for each in near)])

    def replan(self, pose: Array, velocity: float, now: float) -> None:
        """Takes another plan if its own is blocked, if a changed map allows a shorter one, or if it makes no headway.

        It does so only after a new scan. A plan that begins at about the robot's speed is taken at once. For a shorter
        one that does not, the robot stops first. It also plans where it has made no headway for `HEADWAY_TIME` beside
        something that stands.

        Args:
            pose: x and y in m and θ in rad, `(3,)`.
            velocity: V in m/s.
            now: Time in s.
        """
        planner = self._planner
        if not planner.looked:
            return
        planner.looked = False
        if self._stops:
            if abs(velocity) < ARRIVAL_SPEED:
                self._stops = False
                self._take_any(pose, now)
            return
        blocked = planner.is_blocked(now)
        if self._clock - self._anchor > MIN_PACE * HEADWAY_TIME / self._period or not len(planner.sight.standing.discs):
            self._anchor, planner.got_on = self._clock, now
        if now - planner.got_on >= HEADWAY_TIME:
            planner.got_on = planner.tried = now  # where there is no other plan, it tries again later
            self._take_any(pose, now)
        elif planner.map_changed or (blocked and now - planner.tried >= BLOCKED_RETRY):
            planner.tried = now
            self._take_shorter(pose, velocity, now, blocked)

    def _take_any(self, pose: Array, now: float) -> None:
        """Takes another plan if there is one."""
        if plan := self._planner.plan(pose, self._driven, now):
            self._begin(plan, now)

    def _take_shorter(self, pose: Array, velocity: float, now: float, blocked: bool) -> None:
        """Takes a plan that needs less than `SHORTER_SHARE` of the time that is left, which is infinite if blocked.

        Where the plan does not begin with about the speed of the robot, the robot stops for it, unless it has to stop
        anyway because its own plan is blocked.
        """
        planner = self._planner
        plan = planner.plan(pose, self._driven, now, ahead=not planner.map_changed)
        if plan is None:
            return
        left = np.inf if blocked else self._period * (len(self._plan) - self._clock)
        excess = self._driven[0] - plan.sample(np.zeros(1)).twist[0, 0]
        off = excess**2 / (2 * self._robot.max_acceleration)  # how far the robot is off the plan while it brakes
        if off < TRACKING_MARGIN:
            if plan.period < SHORTER_SHARE * left:
                self._begin(plan, now)
        elif plan.period + abs(velocity) / self._brakes < SHORTER_SHARE * left:
            self._stops = not blocked


class Pacing:
    """A motion stage that follows plans with Kanayama's law, at a pace that the filter allows and the robot can keep.

    With the clock s of the plan, the request u(s) of Kanayama's law, and the largest λ ≤ 1 for which λ u is allowed,

        u_c = λ u(s),    ds/dt = λ

    (path-velocity decomposition: Kant and Zucker, "Toward efficient trajectory planning", IJRR 5(3), 1986). The robot
    drives the curvature that the plan asks for, and in the time s its error of posture obeys the same equations as
    without obstacles. λ changes no faster than the robot can follow.

    A robot that does not get to the speed of the plan lags, and the request grows with the lag. Where the request is
    faster than the plan by more than v = `CATCH_UP_SPEED`, λ is at most (|V_r| + v) / |V(s)|: the request λ V(s) keeps
    to the speed of the plan, which brakes in time, and the clock goes at the rate of the robot.

    Where something that stands and is not on the map blocks the plan, the robot drives on along another plan that
    begins with about its speed. If there is none, it stops `STANDOFF` before that place, and makes a plan there. Where
    the map has changed and another plan takes less than `SHORTER_SHARE` of the time that is left, it takes that plan;
    if the plan cannot begin with about the speed of the robot, it stops first.

    Attributes:
        followed: What the robots follow, as in `mrctl.control.stages.MotionStage`, `(B, 7)`.
    """

    def __init__(self, robot: Robot, size: int, replan: Replan) -> None:
        """Makes the stage.

        Args:
            robot: Nominal robot.
            size: Number of robots.
            replan: Makes a plan to the goal.
        """
        self._robot, self._replan, self._law = robot, replan, Following(size)

    def assign(self, scenarios: Sequence[Scenario]) -> None:
        """Takes the missions of the robots, with their maps and with their plans as references."""
        self._planners = Planner.each(self._replan, scenarios)

    def tune(self, row: int, gains: Kanayama) -> None:
        """Takes the gains of one robot, at the start and from an event."""
        self._law.tune(row, gains)

    def reset(self, pose: Array, reference: Array, period: float) -> None:
        """Starts a run; the arguments are those of `mrctl.control.stages.MotionStage`."""
        self._period, self._tick, self.followed = period, 0, reference
        self._pacers = [Pacer(planner, self._robot, period) for planner in self._planners]

    @property
    def _now(self) -> float:
        """Time in s."""
        return self._period * self._tick

    def follow(self, row: int, plan: Reference) -> None:
        """Takes another plan for one robot, which is a way to another goal."""
        self._pacers[row].take(plan, self._now)

    def see(self, row: int, scan: Scan) -> None:
        """Takes a scan of one robot; for the arguments see `mrctl.control.stages.MotionStage`."""
        self._pacers[row].see(scan)

    def output(self, pose: Array, twist: Array, reference: Array) -> Array:
        """Returns the allowed twist, `(B, 2)`; the arguments are those of `mrctl.control.stages.MotionStage`."""
        for pacer, place, (velocity, _) in zip(self._pacers, pose, twist, strict=True):
            pacer.replan(place, float(velocity), self._now)
        self.followed = np.stack([pacer.reference for pacer in self._pacers])
        requests = self._law.output(pose, self.followed)
        for pacer, request, place, own in zip(self._pacers, requests, pose, self.followed, strict=True):
            pacer.go_on(request, place, own, self._now)
        self._tick += 1
        return requests
