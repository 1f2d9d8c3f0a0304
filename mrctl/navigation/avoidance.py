"""Collision avoidance: a filter that changes a requested twist as little as the braking distance to obstacles asks for.

Discs cover the footprint. For each disc and each obstacle the barrier h is their distance less a margin, and the twist
u = (V, θ̇) has to keep ḣ ≥ −α(h), a half-plane of twists (Ames, Xu, Grizzle and Tabuada, "Control barrier function based
quadratic programs for safety critical systems", IEEE TAC 62(8), 2017). Here α(h) is the speed from which a robot stops
within h: α T + α² / (2 a) = h, with the deceleration a and the period T for which a twist is held. As α ≥ 0, rest is
always among the twists that are allowed.

`avoid` returns the nearest of these twists, and `Avoiding` is a motion stage whose requests pass it, by what the robot
knows: its map, and what its lidar sees beside the map (`Sight`). `share` returns the largest share of a request that is
among them, which `pacing` needs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from mrctl.control.stages import Motion
from mrctl.kernel import Array, kernel
from mrctl.navigation.sight import Sight
from mrctl.scenario import Scenario
from mrctl.theory.clearance import farthest_outside, outside, point_to_segment
from mrctl.theory.obstacles import Outlines, moved
from mrctl.theory.rays import Scan
from mrctl.theory.robot import Robot


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

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401
        """Returns the method `follow` or `tune` of the motion stage, which a stage has or has not."""
        if name in ("follow", "tune"):
            return getattr(self._motion, name)
        raise AttributeError(name)

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
    enough = barrier.margin + fastest * barrier.period + fastest * fastest / (2 * barrier.deceleration)  # m
    for other in range(len(discs) + len(rings)):
        p = other - len(discs)
        ring = discs[other] if p < 0 else rings[p]
        if np.hypot(pose[0] - ring[0], pose[1] - ring[1]) - ring[2] - reach >= enough:
            continue
        if p >= 0 and farthest_outside(pose[0], pose[1], edges[first[p] : first[p + 1]]) - reach >= enough:
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
