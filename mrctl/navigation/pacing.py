"""A plan in time whose clock the braking filter slows: the motion stage `barrier` of missions.

A robot that follows a plan in time is not helped by the nearest twist that the filter of `avoidance` allows: the plan
goes on without it, and its controller then asks for a way across obstacles. `Pacing` therefore slows the plan itself.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mrctl.control.kanayama import Kanayama, kanayama, posture_error
from mrctl.kernel import Array, Rows, kernel
from mrctl.loop.goals import RESTING
from mrctl.loop.hierarchy import Hierarchy
from mrctl.navigation.avoidance import Barrier, approach, share
from mrctl.navigation.plan import least_clearance
from mrctl.navigation.replanning import SHORTER, SURE, Planner, Replan, blocked_at
from mrctl.scenario import Scenario
from mrctl.theory.clearance import rim
from mrctl.theory.rays import Scan
from mrctl.theory.references import Reference, Waypoints
from mrctl.theory.robot import Robot

BRAKING = 0.5  # share of the robot's acceleration that the filter counts on, for the robot lags behind the twist
RIM = 0.02  # m, radius of the discs around the robot, which reach as far beyond its footprint
KEPT, AWAY = 0.02, 0.1  # m, margins of these discs from what is on the map and from what moves; chosen
TRACKED = 0.01  # m, by which the margin KEPT is smaller than what the discs have on the plan, at least
STANDOFF = 1.0  # m before a blocked place of its plan, where the robot stops, so that it can drive around it; chosen
SLOW, WAITED = 0.1, 1.0  # mean λ over so many s, below which a robot makes another plan; chosen


class Following:
    """Kanayama's motion controller, with the gains that it has in a hierarchy where no stage takes its place."""

    def __init__(self, robot: Robot, scenarios: Sequence[Scenario]) -> None:
        """Takes the nominal robot, and the scenario of each robot of a group."""
        alone = [scenario.model_copy(update={"learner": "none", "learned": None}) for scenario in scenarios]
        self._gains = Hierarchy(alone, robot).state["kanayama"]  # which do not depend on the learner

    def tune(self, row: int, gains: Kanayama) -> None:
        """Changes the gains of one robot, all of which are set."""
        self._gains[row] = gains.k_x, gains.k_y, gains.k_theta

    def output(self, pose: Array, reference: Array) -> Array:
        """Returns the requested twists, `(B, 2)`; the arguments are those of `mrctl.control.stages.Motion`."""
        requests = np.empty((len(pose), 2))
        follow_all.compiled(pose, reference, self._gains, np.empty(3), requests)
        return requests


@kernel
def follow_all(pose: Array, reference: Array, gains: Rows, error: Array, requests: Array) -> None:
    """Writes what `Following.output` returns into `requests`, `(B, 2)`; `error` is scratch, `(3,)`."""
    for i in range(len(pose)):
        posture_error(pose[i], reference[i, :3], error)
        kanayama(error, reference[i, 3:5], gains[i], requests[i])


class Pacing:
    """A motion stage that follows a plan with Kanayama's law, and slows the clock of the plan where the filter asks.

    With the clock s of the plan, the request u(s) of Kanayama's law, and the largest λ ≤ 1 for which λ u is allowed,

        u_c = λ u(s),    ds/dt = λ

    (path-velocity decomposition: Kant and Zucker, "Toward efficient trajectory planning", IJRR 5(3), 1986). The robot
    drives the curvature that the plan asks for, and in the time s its error of posture obeys the same equations as
    without obstacles. λ changes no faster than the robot can follow.

    Where something that stands and is not on the map blocks the plan, the robot drives on along another plan that
    begins with about its speed. If there is none, it stops `STANDOFF` before that place, and makes a plan there. Where
    the map has changed and another plan takes less than `SHORTER` of the time that is left, it takes that plan; if the
    plan cannot begin with about the speed of the robot, it stops first.

    Attributes:
        followed: What the robots follow, as in `mrctl.control.stages.Motion`, `(B, 7)`.
    """

    def __init__(self, robot: Robot, size: int, replan: Replan) -> None:
        """Makes the stage.

        Args:
            robot: Nominal robot.
            size: Number of robots.
            replan: Makes a plan to the goal.
        """
        self._robot, self._size, self._replan = robot, size, replan
        self._brakes = BRAKING * robot.max_acceleration

    def assign(self, scenarios: Sequence[Scenario]) -> None:
        """Takes the missions of the robots, with their maps and with their plans as references."""
        self._follow, self._scenarios = Following(self._robot, scenarios), scenarios
        self._planners = Planner.each(self._replan, scenarios)
        self._footprint = self._planners[0].vehicle.footprint
        self._near, self._away = self._barrier(-RIM), self._barrier(AWAY)

    def _barrier(self, margin: float) -> Barrier:
        """Returns the filter that keeps this clearance in m."""
        return Barrier(rim(self._footprint, RIM), margin, self._brakes, self._scenarios[0].motion_period)

    def reset(self, pose: Array, reference: Array, period: float) -> None:
        """Starts a run; the arguments are those of `mrctl.control.stages.Motion`."""
        size = self._size
        for planner in self._planners:
            planner.reset()
        self._period, self._tick, self.followed = period, 0, reference
        self._clock, self._pace = np.zeros(size), np.ones(size)  # s in motion periods, and λ
        self._driven = np.zeros((size, 2))  # twists of the plans at their paces, m/s and rad/s
        delay = self._scenarios[0].sensing.periods("delay", self._scenarios[0].control_period)
        self._plans = [self._sampled(planner.first, delay) for planner in self._planners]
        self._kept = [self._margin(planner.first, row) for row, planner in enumerate(self._planners)]
        self._blocked = np.full(size, np.inf)  # where plans are blocked, in motion periods
        self._anchor, self._since = np.zeros(size), np.zeros(size)  # clock and s at which robots last got on
        self._since_blocked = np.full(size, np.inf)  # s since which their plans are blocked
        self._tried = np.full(size, -np.inf)  # s at which they last looked for another plan
        self._looked = np.zeros(size, bool)  # which robots have a scan that is new
        self._map_changed = np.zeros(size, bool)  # so that a shorter way may be free
        self._stops = np.zeros(size, bool)  # which stop for a shorter way

    def _sampled(self, plan: Waypoints, delay: int) -> Array:
        """Returns a plan as `output` gets it, for each motion period, `(n, 7)`.

        Args:
            plan: The plan.
            delay: Control periods after its beginning at which the voltage of the first one acts.
        """
        step, period = self._scenarios[0].control_period, self._period
        ticks = round(period / step) * np.arange(int(plan.period / period) + 2) + delay
        return np.hstack(plan.sample(np.asarray(step * ticks, float)))

    def _margin(self, plan: Waypoints, row: int) -> Barrier:
        """Returns the filter for the map of one robot, with less clearance than the plan has.

        The clearance is negative where the discs would overlap the map on the plan.
        """
        free = least_clearance(self._footprint, plan, self._planners[row].sight.map)
        return self._barrier(min(KEPT, free - RIM - TRACKED))

    def follow(self, row: int, plan: Reference) -> None:
        """Takes another plan for one robot, which is a way to another goal."""
        self._begin(row, self._planners[row].take(plan))

    def tune(self, row: int, gains: Kanayama) -> None:
        """Takes the gains that an event brings for one robot."""
        self._follow.tune(row, gains)

    def _begin(self, row: int, plan: Waypoints) -> None:
        """Lets a robot drive a plan from its beginning, at the pace at which it keeps its speed."""
        self._plans[row], self._kept[row] = self._sampled(plan, 0), self._margin(plan, row)
        velocity, first = self._driven[row, 0], self._plans[row][0, 3]
        if velocity * first > 0:
            self._pace[row] = min(1.0, velocity / first)
        self._clock[row], self._anchor[row], self._blocked[row] = 0.0, 0.0, np.inf
        self._since[row], self._since_blocked[row], self._tried[row] = self._period * self._tick, np.inf, -np.inf
        self._map_changed[row] = self._stops[row] = False

    def see(self, row: int, scan: Scan) -> None:
        """Takes a scan of one robot, and looks whether its plan is free; for the arguments see `stages.Motion`."""
        self._map_changed[row] |= self._planners[row].sight.see(scan)
        self._looked[row] = True
        standing, plan, place = self._planners[row].sight.standing, self._plans[row], None
        first = min(int(self._clock[row]), len(plan) - 2)
        if len(standing.discs):
            way = np.cumsum(np.abs(plan[first:, 3])) * self._period
            place = blocked_at(self._footprint, plan[first:, :3], way, standing)
        self._blocked[row] = np.inf if place is None else first + place
        self._since_blocked[row] = np.inf if place is None else min(self._since_blocked[row], scan.time)

    def output(self, pose: Array, twist: Array, reference: Array) -> Array:
        """Returns the allowed twist, `(B, 2)`; the arguments are those of `mrctl.control.stages.Motion`."""
        for row in np.flatnonzero(self._looked):  # robots that have failed do not look
            self._get_on(int(row), pose[row], float(twist[row, 0]))
        self._looked[:] = False
        now = np.empty((len(pose), 7))
        for row, plan in enumerate(self._plans):
            first = min(int(self._clock[row]), len(plan) - 2)
            now[row] = plan[first] + min(self._clock[row] - first, 1.0) * (plan[first + 1] - plan[first])
        requests, twists = self._follow.output(pose, now), now[:, 3:5].copy()
        free = [self._share(row, *own) for row, own in enumerate(zip(requests, pose, strict=True))]
        change = self._period * self._robot.max_acceleration / np.maximum(np.abs(twists[:, 0]), 1e-9)
        pace = np.minimum(np.clip(free, self._pace - change, self._pace + BRAKING * change), 1.0)[:, None]
        now[:, 3:5] = pace * twists
        now[:, 5:] = pace**2 * now[:, 5:] + (pace - self._pace[:, None]) / self._period * twists
        self._pace, self._clock, self._driven = pace[:, 0], self._clock + pace[:, 0], pace * twists
        self._tick, self.followed = self._tick + 1, now
        return pace * requests

    def _share(self, row: int, request: Array, pose: Array) -> float:
        """Returns λ of one robot."""
        sight, allowed = self._planners[row].sight, 0.0 if self._stops[row] else 1.0
        if np.isfinite(self._blocked[row]):
            part = self._plans[row][int(self._clock[row]) : int(self._blocked[row]), 3]
            left = self._period * float(np.abs(part).sum()) - STANDOFF
            allowed = approach.compiled(left, self._brakes, self._period) / max(abs(float(request[0])), 1e-9)
        moving = sight.moving(self._period * self._tick)
        around = (sight.map, self._kept[row]), (sight.standing, self._near), (moving, self._away)
        near = [each for each in around if len(each[0].discs) + len(each[0].rings)]
        return min([allowed, *(share(request, pose, *each) for each in near)])

    def _get_on(self, row: int, pose: Array, velocity: float) -> None:
        """Gives a robot another plan, if its own is blocked, or the map lets it have a shorter one.

        It takes at once a plan that begins at about its own speed. Otherwise it plans again at rest: after a stop for
        a shorter way, or when something that stands has hardly let it get on for a second.

        Args:
            row: Which robot.
            pose: x and y in m and θ in rad, `(3,)`.
            velocity: V in m/s.
        """
        planner, now, asked = self._planners[row], self._period * self._tick, self._driven[row]
        if self._stops[row]:
            if abs(velocity) < RESTING:
                self._stops[row] = False
                if plan := planner.plan(pose, asked, now):
                    self._begin(row, plan)
            return
        standing, blocked = planner.sight.standing, now - self._since_blocked[row] >= SURE
        if self._clock[row] - self._anchor[row] > SLOW * WAITED / self._period or not len(standing.discs):
            self._anchor[row], self._since[row] = self._clock[row], now
        if now - self._since[row] >= WAITED:
            self._since[row] = self._tried[row] = now  # where there is no other plan, it tries again later
            self._map_changed[row] = False
            if plan := planner.plan(pose, asked, now):
                self._begin(row, plan)
        elif self._map_changed[row] or (blocked and now - self._tried[row] >= WAITED):
            left = np.inf if blocked else self._period * (len(self._plans[row]) - self._clock[row])
            ahead, self._map_changed[row], self._tried[row] = not self._map_changed[row], False, now
            if plan := planner.plan(pose, asked, now, ahead):
                excess = asked[0] - plan.sample(np.zeros(1)).twist[0, 0]
                at_once = excess**2 < 2 * self._robot.max_acceleration * TRACKED  # so far it is off while it brakes
                if plan.period + (0.0 if at_once else abs(velocity) / self._brakes) < SHORTER * left:
                    if at_once:
                        self._begin(row, plan)
                    else:
                        self._stops[row] = not blocked
