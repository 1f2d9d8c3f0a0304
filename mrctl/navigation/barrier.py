"""The braking distance to obstacles as a control barrier: which twists a robot may drive.

Discs cover the footprint. For each disc and each obstacle the barrier h is their distance less a margin, and the twist
u = (V, θ̇) has to keep ḣ ≥ −α(h), a half-plane of twists (Ames, Xu, Grizzle and Tabuada, "Control barrier function based
quadratic programs for safety critical systems", IEEE TAC 62(8), 2017). Here α(h) is the speed from which a robot stops
within h: α T + α² / (2 a) = h, with the deceleration a and the period T for which a twist is held. As α ≥ 0, rest is
always among the twists that are allowed.

`share` returns the largest share of a request that is among them, which `pacing` needs. `barrier_filter` finds the
nearest of them to a request.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mrctl.kernel import Array, kernel
from mrctl.theory.clearance import farthest_outside, outside, point_to_segment
from mrctl.theory.obstacles import Outlines, moved


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


def share(request: Array, pose: Array, outlines: Outlines, barrier: Barrier) -> float:
    """Returns the largest λ in [0, 1] for which λ times a request is allowed.

    As rest is allowed and what is allowed is convex, so is every smaller λ. All have the curvature of the request.

    Args:
        request: Requested V in m/s and θ̇ in rad/s, `(2,)`.
        pose: x and y in m and θ in rad, `(3,)`.
        outlines: The obstacles.
        barrier: Discs, margin and braking of the robot.
    """
    return largest.compiled(request, pose, outlines, barrier, scratch(outlines, barrier))


def scratch(outlines: Outlines, barrier: Barrier) -> Array:
    """Returns room for a row for each disc and obstacle, `(m, 3)`."""
    return np.empty((len(barrier.discs) * (len(outlines.discs) + len(outlines.rings)), 3))


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
                away, nx, ny = away_from(x, y, edges[first[p] : first[p + 1]])
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
def away_from(x: float, y: float, sides: Array) -> tuple[float, float, float]:
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
