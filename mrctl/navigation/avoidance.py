"""Collision avoidance: a filter that changes a requested twist as little as the braking distance to obstacles asks for.

Discs cover the footprint. For each disc and each obstacle the barrier h is their distance less a margin, and the twist
u = (V, θ̇) has to keep ḣ ≥ −α(h), a half-plane of twists (Ames, Xu, Grizzle and Tabuada, "Control barrier function based
quadratic programs for safety critical systems", IEEE TAC 62(8), 2017). Here α(h) is the speed from which a robot stops
within h: α T + α² / (2 a) = h, with the deceleration a and the period T for which a twist is held. As α ≥ 0, rest is
always among the twists that are allowed.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from mrctl.control.design import motion as design
from mrctl.control.kanayama import GAINS, kanayama, posture_error
from mrctl.control.stages import Motion
from mrctl.kernel import Array, kernel
from mrctl.loop.simulation import arranged
from mrctl.scenario import Scenario
from mrctl.theory.clearance import outside, point_to_segment
from mrctl.theory.obstacles import Obstacles, Outlines, Surroundings, moved
from mrctl.theory.robot import Robot


class Barrier(NamedTuple):
    """What the filter keeps."""

    discs: Array
    """Discs that cover the robot: x and y of the centre in its frame and radius in m, `(k, 3)`; see `cover`."""
    margin: float
    """Clearance of the discs in m."""
    deceleration: float
    """Deceleration a with which the robot can brake in m/s²."""
    period: float
    """Period T for which a twist is held in s."""
    lever: float
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
    rows = np.empty((len(barrier.discs) * (len(outlines.discs) + len(outlines.rings)), 3))
    allowed.compiled(np.asarray(request, float), np.asarray(pose, float), outlines, barrier, rows, found)
    return found


class Avoiding:
    """A motion stage whose request passes the filter: `simulate(…, motion=lambda *robots: Avoiding(*robots, …))`."""

    def __init__(
        self,
        robot: Robot,
        size: int,
        motion: Callable[[Robot, int], Motion],
        obstacles: Obstacles,
        barrier: Barrier,
    ) -> None:
        """Makes the stage.

        Args:
            robot: Nominal robot.
            size: Number of robots.
            motion: Factory of the motion stage that makes the requests.
            obstacles: The obstacles; those that move are taken where they are, as if they stood.
            barrier: Discs, margin and braking of the robot.
        """
        self._motion, self._around, self._barrier = motion(robot, size), Surroundings(obstacles), barrier

    def reset(self, pose: Array, reference: Array, period: float) -> None:
        """Starts a run; the arguments are those of `mrctl.control.stages.Motion`."""
        self._motion.reset(pose, reference, period)
        self._time, self._period = 0.0, period

    def output(self, pose: Array, twist: Array, reference: Array) -> Array:
        """Returns the allowed twist, `(B, 2)`; the arguments are those of `mrctl.control.stages.Motion`."""
        requests, outlines = np.asarray(self._motion.output(pose, twist, reference)), self._around.at(self._time)
        self._time += self._period
        return np.stack([avoid(r, p, outlines, self._barrier) for r, p in zip(requests, pose, strict=True)])


class Following:
    """Kanayama's motion controller as a stage, with the gains that a scenario has or that are designed for it."""

    def __init__(self, robot: Robot, size: int, scenario: Scenario) -> None:
        """Takes the nominal robot, the number of robots, and the scenario of all, which differ in what they learn."""
        rigid = arranged(scenario).steering == "rigid"
        latency = scenario.sensing.periods("delay", scenario.control_period) * scenario.control_period
        gains = scenario.pid.channels(robot, rigid, latency, scenario.control_period)
        designed = design(robot, rigid, gains, latency, scenario.control_period, scenario.prefilter).kanayama
        self._gains = np.zeros((), GAINS)
        for name in self._gains.dtype.names or ():
            own = getattr(scenario.kanayama, name)
            self._gains[name] = getattr(designed, name) if own is None else own

    def reset(self, pose: Array, reference: Array, period: float) -> None:
        """Has nothing to start."""

    def output(self, pose: Array, twist: Array, reference: Array) -> Array:
        """Returns the requested twists, `(B, 2)`; the arguments are those of `mrctl.control.stages.Motion`."""
        error, requests = np.empty(3), np.empty((len(pose), 2))
        for row in range(len(pose)):
            posture_error.compiled(pose[row], reference[row, :3], error)
            kanayama.compiled(error, reference[row, 3:5], self._gains[()], requests[row])
        return requests


@kernel
def allowed(request: Array, pose: Array, outlines: Outlines, barrier: Barrier, rows: Array, found: Array) -> None:
    """Writes what `avoid` returns into `found`; `rows` is scratch with a row for each disc and obstacle, `(m, 3)`."""
    discs, edges, first, rings = outlines
    cos, sin, n = np.cos(pose[2]), np.sin(pose[2]), 0
    for k in range(len(barrier.discs)):
        ahead, aside, radius = barrier.discs[k]
        x, y = moved(pose, ahead, aside)
        for other in range(len(discs) + len(rings)):
            if other < len(discs):
                dx, dy = x - discs[other, 0], y - discs[other, 1]
                centre = np.hypot(dx, dy)
                away, nx, ny = centre - discs[other, 2], dx / max(centre, 1e-9), dy / max(centre, 1e-9)
            else:
                p = other - len(discs)
                away, nx, ny = from_polygon(x, y, edges[first[p] : first[p + 1]])
            # ḣ = n · ṗ of the disc's centre p, with ṗ = V (cos θ, sin θ) + θ̇ (−(p − P)_y, (p − P)_x).
            rows[n, 0] = nx * cos + ny * sin
            rows[n, 1] = (ny * (x - pose[0]) - nx * (y - pose[1])) / barrier.lever
            rows[n, 2] = -approach(away - radius - barrier.margin, barrier.deceleration, barrier.period)
            n += 1
    found[0], found[1] = nearest(request[0], barrier.lever * request[1], rows)
    if found[0] == request[0] and found[1] == barrier.lever * request[1]:
        found[1] = request[1]  # bit for bit
    else:
        found[1] /= barrier.lever


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
