"""Collision avoidance: a filter that changes a requested twist as little as the braking distance to obstacles asks for.

Discs cover the footprint. For each disc and each obstacle the barrier h is their distance less a margin, and the twist
u = (V, θ̇) has to keep ḣ ≥ −α(h), a half-plane of twists (Ames, Xu, Grizzle and Tabuada, "Control barrier function based
quadratic programs for safety critical systems", IEEE TAC 62(8), 2017). Here α(h) is the speed from which a robot stops
within h: α T + α² / (2 a) = h, with the deceleration a and the period T for which a twist is held. As α ≥ 0, rest is
always among the twists that are allowed.

A robot that follows a plan in time is not helped by the nearest twist: the plan goes on without it, and its controller
then asks for a way across obstacles. `Pacing` therefore slows the plan itself.

What the robot avoids is what it knows: its map, and what its lidar sees beside the map (`Sight`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from mrctl.control.design import motion as design
from mrctl.control.kanayama import GAINS, kanayama, posture_error
from mrctl.control.stages import Motion
from mrctl.kernel import Array, kernel
from mrctl.loop.goals import RESTING
from mrctl.loop.simulation import arranged
from mrctl.navigation.planning import least_clearance
from mrctl.navigation.replanning import SHORTER, Planner, Replan
from mrctl.navigation.sight import Sight
from mrctl.scenario import Scenario
from mrctl.theory.clearance import clearance, outside, point_to_segment, rim
from mrctl.theory.obstacles import Outlines, moved
from mrctl.theory.rays import Scan
from mrctl.theory.references import Reference, Waypoints
from mrctl.theory.robot import Robot

BRAKING = 0.5  # share of the robot's acceleration that the filter counts on, for the robot lags behind the twist
RIM = 0.02  # m, radius of the discs around the robot for `Pacing`, which reach as far beyond its footprint
KEPT, AWAY = 0.02, 0.1  # m, margins of these discs from what is on the map and from what moves; chosen
TRACKED = 0.01  # m, by which the margin KEPT is smaller than what the discs have on the plan, at least
STANDOFF = 1.0  # m before a blocked place of its plan, where the robot stops, so that it can drive around it; chosen
SLOW, WAITED = 0.1, 1.0  # mean λ over so many s, below which a robot makes another plan; chosen
SPACING = 0.05  # m, of the places of a plan that are looked at


class Barrier(NamedTuple):
    """Parameters of the braking filter of one robot."""

    discs: Array
    """Discs that cover the robot: x and y of the centre in its frame and radius in m, `(k, 3)`; see `cover`."""
    margin: float
    """Clearance of the discs in m."""
    deceleration: float
    """Deceleration a with which the robot can brake in m/s²."""
    period: float
    """Period T for which a twist is held in s."""
    lever: float = 0.3
    """Weight of a change of θ̇ against one of V in m: a change of 1 rad/s counts as much as one of `lever` m/s."""


def avoid(request: Array, pose: Array, outlines: Outlines, barrier: Barrier) -> Array:
    """Returns the allowed twist that is nearest to a request; the request itself where it is allowed.

    Args:
        request: Requested V in m/s and θ̇ in rad/s, `(2,)`.
        pose: x and y in m and θ in rad, `(3,)`.
        outlines: The obstacles.
        barrier: Discs, margin and braking of the robot.
    """
    found = np.empty(2)
    rows = _scratch(outlines, barrier)
    allowed.compiled(np.asarray(request, float), np.asarray(pose, float), outlines, barrier, rows, found)
    return found


class Avoiding:
    """A motion stage whose request passes the filter: `simulate(…, motion=lambda *robots: Avoiding(*robots, …))`.

    Obstacles on the map are known; the others are seen by the lidar, and taken where they are, as if they stood.
    """

    def __init__(self, robot: Robot, size: int, motion: Callable[[Robot, int], Motion], barrier: Barrier) -> None:
        """Makes the stage.

        Args:
            robot: Nominal robot.
            size: Number of robots.
            motion: Factory of the motion stage that makes the requests.
            barrier: Discs, margin and braking of the robots.
        """
        self._motion, self._barrier = motion(robot, size), barrier

    def assign(self, scenarios: Sequence[Scenario]) -> None:
        """Takes the scenarios of the robots, with their maps, and hands them on to the motion stage."""
        self._sights = Sight.each(scenarios)
        if take := getattr(self._motion, "assign", None):
            take(scenarios)

    def reset(self, pose: Array, reference: Array, period: float) -> None:
        """Starts a run; the arguments are those of `mrctl.control.stages.Motion`."""
        self._motion.reset(pose, reference, period)
        self._time, self._period = 0.0, period
        for sight in self._sights:
            sight.forget()

    def see(self, row: int, scan: Scan) -> None:
        """Takes a scan of one robot, for the filter and for the motion stage, if that takes scans."""
        self._sights[row].see(scan)
        if look := getattr(self._motion, "see", None):
            look(row, scan)

    @property
    def followed(self) -> Array | None:
        """What the robots follow, as in `mrctl.control.stages.Motion`."""
        return getattr(self._motion, "followed", None)

    def output(self, pose: Array, twist: Array, reference: Array) -> Array:
        """Returns the allowed twist, `(B, 2)`; the arguments are those of `mrctl.control.stages.Motion`."""
        requests = np.asarray(self._motion.output(pose, twist, reference))
        around = [sight.outlines(self._time) for sight in self._sights]
        self._time += self._period
        return np.stack([avoid(*own, self._barrier) for own in zip(requests, pose, around, strict=True)])


class Following:
    """Kanayama's motion controller as a stage, with the gains that scenarios have or that are designed for them."""

    def __init__(self, robot: Robot, scenarios: Sequence[Scenario]) -> None:
        """Takes the nominal robot, and the scenario of each robot."""
        self._gains = np.zeros(len(scenarios), GAINS)
        for row, scenario in enumerate(scenarios):
            rigid = arranged(scenario).steering == "rigid"
            latency = scenario.sensing.loop_delay(scenario.control_period) * scenario.control_period
            gains = scenario.pid.channels(robot, rigid, latency, scenario.control_period)
            designed = design(robot, rigid, gains, latency, scenario.control_period, scenario.prefilter).kanayama
            own = scenario.kanayama.completed(designed)
            self._gains[row] = own.k_x, own.k_y, own.k_theta

    def reset(self, pose: Array, reference: Array, period: float) -> None:
        """Has nothing to start."""

    def output(self, pose: Array, twist: Array, reference: Array) -> Array:
        """Returns the requested twists, `(B, 2)`; the arguments are those of `mrctl.control.stages.Motion`."""
        error, requests = np.empty(3), np.empty((len(pose), 2))
        for row in range(len(pose)):
            posture_error.compiled(pose[row], reference[row, :3], error)
            kanayama.compiled(error, reference[row, 3:5], self._gains[row], requests[row])
        return requests


class Pacing:
    """A motion stage that follows a plan with Kanayama's law, and slows the clock of the plan where the filter asks.

    With the clock s of the plan, the request u(s) of Kanayama's law, and the largest λ ≤ 1 for which λ u is allowed,

        u_c = λ u(s),    ds/dt = λ

    (path-velocity decomposition: Kant and Zucker, "Toward efficient trajectory planning", IJRR 5(3), 1986). The robot
    drives the curvature that the plan asks for, and in the time s its error of posture obeys the same equations as
    without obstacles. λ changes no faster than the robot can follow.

    Where something that stands and is not on the map blocks the plan, the robot stops `STANDOFF` before it, and drives
    on along another plan. Where the map has changed and another plan would take less than `SHORTER` of the time that is
    left, it also stops, because a plan begins at rest, and drives on along that.

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
        self._footprint = self._planners[0].footprint
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
        self._plans = [self._sampled(planner.first) for planner in self._planners]
        self._kept = [self._margin(planner.first, row) for row, planner in enumerate(self._planners)]
        self._blocked = np.full(size, np.inf)  # where plans are blocked, in motion periods
        self._anchor, self._since = np.zeros(size), np.zeros(size)  # clock and s at which robots last got on
        self._looked = np.zeros(size, bool)  # which robots have a scan that is new
        self._map_changed = np.zeros(size, bool)  # so that a shorter way may be free
        self._stops = np.zeros(size, bool)  # which stop for a shorter way

    def _sampled(self, plan: Waypoints) -> Array:
        """Returns a plan as `output` gets it, for each motion period, `(n, 7)`."""
        step, sensing, period = self._scenarios[0].control_period, self._scenarios[0].sensing, self._period
        ticks = round(period / step) * np.arange(int(plan.period / period) + 2) + sensing.periods("delay", step)
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

    def _begin(self, row: int, plan: Waypoints) -> None:
        """Lets a robot drive a plan from its beginning."""
        self._plans[row], self._kept[row] = self._sampled(plan), self._margin(plan, row)
        self._clock[row], self._anchor[row], self._blocked[row] = 0.0, 0.0, np.inf
        self._map_changed[row] = self._stops[row] = False

    def see(self, row: int, scan: Scan) -> None:
        """Takes a scan of one robot, and looks whether its plan is free; for the arguments see `stages.Motion`."""
        self._map_changed[row] |= self._planners[row].sight.see(scan)
        self._looked[row] = True
        standing = self._planners[row].sight.standing
        self._blocked[row] = np.inf
        if not len(standing.discs):
            return
        plan = self._plans[row]
        first = min(int(self._clock[row]), len(plan) - 2)
        way = np.cumsum(np.abs(plan[first:, 3])) * self._period
        ahead = first + np.searchsorted(way, np.arange(0.0, way[-1], SPACING))
        free = [clearance(self._footprint, plan[k, :3], standing) for k in ahead]
        if len(blocked := ahead[np.array(free) <= 0]):
            self._blocked[row] = blocked[0]

    def output(self, pose: Array, twist: Array, reference: Array) -> Array:
        """Returns the allowed twist, `(B, 2)`; the arguments are those of `mrctl.control.stages.Motion`."""
        for row in np.flatnonzero(self._looked):  # robots that have failed do not look
            self._get_on(int(row), pose[row], abs(float(twist[row, 0])))
        self._looked[:] = False
        now = np.empty((len(pose), 7))
        for row, plan in enumerate(self._plans):
            first = min(int(self._clock[row]), len(plan) - 2)
            now[row] = plan[first] + min(self._clock[row] - first, 1.0) * (plan[first + 1] - plan[first])
        requests, twists = self._follow.output(pose, twist, now), now[:, 3:5].copy()
        free = [self._share(row, *own) for row, own in enumerate(zip(requests, pose, strict=True))]
        change = self._period * self._robot.max_acceleration / np.maximum(np.abs(twists[:, 0]), 1e-9)
        pace = np.minimum(np.clip(free, self._pace - change, self._pace + BRAKING * change), 1.0)[:, None]
        now[:, 3:5] = pace * twists
        now[:, 5:] = pace**2 * now[:, 5:] + (pace - self._pace[:, None]) / self._period * twists
        self._pace, self._clock = pace[:, 0], self._clock + pace[:, 0]
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
        return min(
            allowed, *(share(request, pose, *each) for each in around if len(each[0].discs) + len(each[0].rings))
        )

    def _get_on(self, row: int, pose: Array, speed: float) -> None:
        """Gives a robot another plan, if what stands there has hardly let it get on, or if the map lets it.

        Args:
            row: Which robot.
            pose: x and y in m and θ in rad, `(3,)`.
            speed: |V| in m/s.
        """
        planner, now = self._planners[row], self._period * self._tick
        if self._stops[row]:
            if speed < RESTING:
                self._stops[row] = False
                if plan := planner.plan(pose, now):
                    self._begin(row, plan)
            return
        if self._map_changed[row]:
            self._map_changed[row] = False
            left = self._period * (len(self._plans[row]) - self._clock[row])
            plan = planner.plan(pose, now)
            self._stops[row] = plan is not None and plan.period + speed / self._brakes < SHORTER * left
        standing = planner.sight.standing
        if self._clock[row] - self._anchor[row] > SLOW * WAITED / self._period or not len(standing.discs):
            self._anchor[row], self._since[row] = self._clock[row], now
        if now - self._since[row] < WAITED:
            return
        self._since[row] = now  # where there is no other plan, it tries again later
        if plan := planner.plan(pose, now):
            self._begin(row, plan)


def share(request: Array, pose: Array, outlines: Outlines, barrier: Barrier) -> float:
    """Returns the largest λ in [0, 1] for which λ times a request is allowed; the arguments are those of `avoid`.

    As rest is allowed and what is allowed is convex, so is every smaller λ. All have the curvature of the request.
    """
    return largest.compiled(request, pose, outlines, barrier, _scratch(outlines, barrier))


def _scratch(outlines: Outlines, barrier: Barrier) -> Array:
    """Returns room for a row for each disc and obstacle, `(m, 3)`."""
    return np.empty((len(barrier.discs) * (len(outlines.discs) + len(outlines.rings)), 3))


@kernel
def allowed(request: Array, pose: Array, outlines: Outlines, barrier: Barrier, rows: Array, found: Array) -> None:
    """Writes what `avoid` returns into `found`; `rows` is scratch with a row for each disc and obstacle, `(m, 3)`."""
    n = half_planes(request, pose, outlines, barrier, rows)
    found[0], found[1] = nearest(request[0], barrier.lever * request[1], rows[:n])
    if found[0] == request[0] and found[1] == barrier.lever * request[1]:
        found[1] = request[1]  # bit for bit
    else:
        found[1] /= barrier.lever


@kernel
def largest(request: Array, pose: Array, outlines: Outlines, barrier: Barrier, rows: Array) -> float:
    """Returns what `share` returns; `rows` is scratch with a row for each disc and obstacle, `(m, 3)`."""
    found = 1.0
    for k in range(half_planes(request, pose, outlines, barrier, rows)):
        rate = rows[k, 0] * request[0] + rows[k, 1] * barrier.lever * request[1]
        if rate < rows[k, 2]:
            found = min(found, rows[k, 2] / rate)
    return found


@kernel
def half_planes(request: Array, pose: Array, outlines: Outlines, barrier: Barrier, rows: Array) -> int:
    """Writes a, b and c of each half-plane a V + b (θ̇ · lever) ≥ c of allowed twists into rows; returns their number.

    Obstacles that are too far for any twist that is no larger than the request are left out.
    """
    discs, edges, first, rings = outlines
    cos, sin, n, reach, arm = np.cos(pose[2]), np.sin(pose[2]), 0, 0.0, 0.0
    for k in range(len(barrier.discs)):
        centre = np.hypot(barrier.discs[k, 0], barrier.discs[k, 1])
        reach, arm = max(reach, centre + barrier.discs[k, 2]), max(arm, centre / barrier.lever)
    fastest = np.sqrt((1 + arm * arm) * (request[0] ** 2 + (barrier.lever * request[1]) ** 2))  # m/s, of a disc
    for other in range(len(discs) + len(rings)):
        p = other - len(discs)
        ring = discs[other] if p < 0 else rings[p]
        away = np.hypot(pose[0] - ring[0], pose[1] - ring[1]) - ring[2] - reach - barrier.margin
        if approach(away, barrier.deceleration, barrier.period) >= fastest:
            continue
        for k in range(len(barrier.discs)):
            ahead, aside, radius = barrier.discs[k]
            x, y = moved(pose, ahead, aside)
            if p < 0:
                dx, dy = x - ring[0], y - ring[1]
                centre = np.hypot(dx, dy)
                away, nx, ny = centre - ring[2], dx / max(centre, 1e-9), dy / max(centre, 1e-9)
            else:
                away, nx, ny = from_polygon(x, y, edges[first[p] : first[p + 1]])
            # ḣ = n · ṗ of the disc's centre p, with ṗ = V (cos θ, sin θ) + θ̇ (−(p − P)_y, (p − P)_x).
            rows[n, 0] = nx * cos + ny * sin
            rows[n, 1] = (ny * (x - pose[0]) - nx * (y - pose[1])) / barrier.lever
            rows[n, 2] = -approach(away - radius - barrier.margin, barrier.deceleration, barrier.period)
            n += 1
    return n


@kernel
def approach(h: float, deceleration: float, period: float) -> float:
    """Returns α(h) in m/s: the speed from which the robot stops within h in m after one period in s; 0 below h = 0."""
    step = deceleration * period
    return np.sqrt(step * step + 2 * deceleration * max(h, 0.0)) - step


@kernel
def from_polygon(x: float, y: float, sides: Array) -> tuple[float, float, float]:
    """Returns the distance of a point from a convex polygon in m, negative inside, and the unit vector away from it.

    Args:
        x: x of the point in m.
        y: y of the point in m.
        sides: x and y of start and end of each side in m, counter-clockwise, `(n, 4)`.
    """
    depth, distance, deepest, closest = -np.inf, np.inf, 0, 0
    for k in range(len(sides)):
        out, far = outside(x, y, sides[k]), point_to_segment(x, y, sides[k])
        if out > depth:
            depth, deepest = out, k
        if far < distance:
            distance, closest = far, k
    side = sides[deepest if depth <= 0 else closest]
    dx, dy = side[2] - side[0], side[3] - side[1]
    length = np.hypot(dx, dy)
    if depth <= 1e-9:  # inside, or on the side
        return depth, dy / length, -dx / length
    along = min(max(((x - side[0]) * dx + (y - side[1]) * dy) / (length * length), 0.0), 1.0)
    return distance, (x - side[0] - along * dx) / distance, (y - side[1] - along * dy) / distance


@kernel
def nearest(x: float, y: float, rows: Array) -> tuple[float, float]:
    """Returns the point of an intersection of half-planes that is nearest to (x, y).

    The half-planes are taken one by one. Where the nearest point so far is outside the next one, the new one is on its
    border, and is there the foot of the perpendicular, cut to what the half-planes before leave of it (as in the
    programme in two variables of van den Berg, Guy, Lin and Manocha, "Reciprocal n-body collision avoidance", 2011).

    Args:
        x: First coordinate.
        y: Second coordinate.
        rows: a, b and c of each half-plane a x + b y ≥ c, `(m, 3)`; the origin is in all, so c ≤ 0.
    """
    px, py = x, y
    for k in range(len(rows)):
        a, b, c = rows[k]
        square = a * a + b * b
        if a * px + b * py >= c or square < 1e-18:
            continue
        fx, fy = c * a / square, c * b / square  # the point of the border that is nearest to the origin
        low, high = -np.inf, np.inf  # of s on the border f + s (−b, a)
        for i in range(k):
            slope = rows[i, 1] * a - rows[i, 0] * b
            rest = rows[i, 2] - rows[i, 0] * fx - rows[i, 1] * fy
            if slope > 1e-12:
                low = max(low, rest / slope)
            elif slope < -1e-12:
                high = min(high, rest / slope)
        if low > high + 1e-9:
            return 0.0, 0.0  # by rounding nothing is left but rest
        s = min(max((a * y - b * x) / square, low), high)
        px, py = fx - s * b, fy + s * a
    return px, py
