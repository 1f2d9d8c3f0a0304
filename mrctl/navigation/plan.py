"""A plan: a way from start to goal as poses on arcs, and the reference in time that it makes for the hierarchy."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from mrctl.kernel import Array
from mrctl.navigation.steer import CHECK_SPACING, SWITCH_COST
from mrctl.record import InputError
from mrctl.theory.clearance import clearance
from mrctl.theory.obstacles import Outlines
from mrctl.theory.references import Waypoints
from mrctl.theory.timing import Limits

POINT_SPACING = 0.25  # m, about the distance of the points that the spline of a reference goes through
MIN_CHORD = 1e-3  # m; the curvature at an end is computed as if its chord were at least that long
NEARLY_STRAIGHT = 1e-12  # 1/m, in place of the curvature 0 of an end, which would leave its heading free


class Plan(NamedTuple):
    """A way from start to goal."""

    poses: Array
    """x and y in m and θ in rad, `(n, 3)`, at most 5 cm apart."""
    directions: Array
    """1 where the robot comes to the pose forward, −1 in reverse and 0 at the start, `(n,)`."""
    cost: float
    """Length in m, in reverse times 1.5, plus 0.5 m for each change of direction."""
    expanded: int
    """Number of poses that the search expanded."""
    searched: Array = np.zeros((0, 2, 2))
    """Ends of the arcs that the search drove, x and y in m, `(k, 2, 2)`."""

    @property
    def length(self) -> float:
        """Length in m."""
        return float(np.hypot(*np.diff(self.poses[:, :2], axis=0).T).sum())

    def after(self, arc: Array) -> Plan:
        """Returns the plan with an arc before it, poses in m, m, rad, `(k, 3)`, that is driven forward to its start."""
        poses, forward = np.concatenate([arc[:-1], self.poses]), np.ones(len(arc) - 1)
        directions = np.concatenate([[0.0], forward, self.directions[1:]])
        cost = self.cost + float(np.hypot(*np.diff(arc[:, :2], axis=0).T).sum())
        if len(arc) > 1 and self.directions[1] < 0:
            cost += SWITCH_COST
        return self._replace(poses=poses, directions=directions, cost=cost)

    def reference(self, speed: float, limits: Limits, velocity: float = 0.0, curvature: float = 0.0) -> Waypoints:
        """Returns the plan as a reference: splines of continuous curvature, with the time law under all limits.

        It begins and ends with the headings of the plan, on arcs through the points next to its ends. Where the plan
        changes its direction, a spline ends at rest and another one begins, with a curvature of its own.

        Args:
            speed: Largest speed in m/s.
            limits: Limits of the time law, such as `Limits.of(robot)`.
            velocity: V at the start in m/s; a plan that sets out in reverse begins at rest.
            curvature: Curvature at the start in 1/m where V is not zero; if it is not that of the plan, the heading is
                off by up to 0.1 rad there.

        Raises:
            InputError: The speed is not positive, the plan has no length, or a spline turns too far from the plan at a
                change of direction.
        """
        if len(self.poses) < 2:
            raise InputError("plan: has no length, as it leads to where it starts")
        turns = np.flatnonzero(self.directions[2:] * self.directions[1:-1] < 0) + 1
        places = list(pairwise([0, *turns.tolist(), len(self.poses) - 1]))
        legs = [_points(self.poses[a : b + 1], velocity > 0 and a == 0) for a, b in places]
        points = np.concatenate([legs[0][:1], *(leg[1:] for leg in legs)])
        cusps = np.cumsum([len(leg) - 1 for leg in legs[:-1]], dtype=int).tolist()
        start, *between, end = [
            bend
            for leg, (a, b) in zip(legs, places, strict=True)
            for bend in _bends(leg, self.poses[a, 2], self.poses[b, 2], self.directions[b] < 0)
        ]
        values = {"points": points.tolist(), "closed": False, "timing": "limits", "speed": speed, "limits": limits}
        values |= {"start_curvature": start, "end_curvature": end}
        values["cusp_curvatures"] = list(zip(between[::2], between[1::2], strict=True))
        if self.directions[1] < 0:
            cusps = [0, *cusps]
        elif velocity > 0:
            values |= {"start_speed": min(velocity, speed), "start_curvature": curvature}
        return Waypoints.from_dict(values | {"cusps": cusps}, "plan")


def run_out(start: Array, velocity: float, curvature: float, limits: Limits) -> Array:
    """Returns the arc on which a robot that drives forward can come to rest under limits.

    Args:
        start: x and y in m and θ in rad, `(3,)`.
        velocity: V in m/s, positive.
        curvature: Curvature of the arc in 1/m.
        limits: The limits; the time law keeps the speed for half of `smoothing` at first.

    Returns:
        Poses from the start on, at most 5 cm apart, `(n, 3)`.
    """
    length = velocity * limits.smoothing / 2 + velocity**2 / (2 * limits.acceleration)
    way = np.linspace(0, length, int(np.ceil(length / CHECK_SPACING)) + 1)
    chord = way * np.sinc(curvature * way / (2 * np.pi))
    heading = start[2] + curvature * way / 2
    return np.column_stack([
        start[0] + chord * np.cos(heading), start[1] + chord * np.sin(heading), start[2] + curvature * way
    ])  # fmt: skip


def _points(poses: Array, near: bool) -> Array:
    """Returns points at equal distances of about `POINT_SPACING` along poses with arcs between them, `(n, 2)`.

    Args:
        poses: The poses.
        near: Whether there is another point near the first, which holds the heading there.
    """
    chords, turns = np.diff(poses[:, :2] @ (1, 1j)), np.diff(poses[:, 2])
    turns -= 2 * np.pi * np.round(turns / (2 * np.pi))
    lengths = np.abs(chords) / np.sinc(turns / (2 * np.pi))
    way = np.append(0, np.cumsum(lengths))
    places = np.linspace(0, way[-1], max(2, round(way[-1] / POINT_SPACING) + 1))
    if near and places[1] > 2 * CHECK_SPACING:
        places = np.insert(places, 1, CHECK_SPACING)
    arc = np.clip(np.searchsorted(way, places, side="right") - 1, 0, len(chords) - 1)
    ahead = places - way[arc]
    turn = turns[arc] * ahead / lengths[arc]
    tangent = chords / np.abs(chords) * np.exp(-0.5j * turns)  # at the start of each arc
    points = poses[arc, :2] @ (1, 1j) + ahead * np.sinc(turn / (2 * np.pi)) * np.exp(0.5j * turn) * tangent[arc]
    return np.column_stack([points.real, points.imag])


def _bends(points: Array, start: float, end: float, reverse: bool) -> tuple[float, float]:
    """Returns the curvatures in 1/m of the arcs through the first two points and the last two, positive to the left.

    Args:
        points: Points of a way in m, `(n, 2)`.
        start: Heading of the robot at the first in rad.
        end: Heading of the robot at the last in rad.
        reverse: Whether it drives in reverse.
    """
    first, last = np.diff(points @ (1, 1j))[[0, -1]] * (-1 if reverse else 1)
    before, after = np.angle([first * np.exp(-1j * start), np.exp(1j * end) / last])  # half of the turns of the arcs
    bends = [2 * np.sin(half) / max(abs(chord), MIN_CHORD) for half, chord in ((before, first), (after, last))]
    return tuple(round(bend, 6) or NEARLY_STRAIGHT for bend in bends)  # type: ignore[return-value]


def least_clearance(footprint: Array, plan: Waypoints, outlines: Outlines) -> float:
    """Returns the smallest clearance along a plan in m; `footprint` has the corners of the robot in m, `(n, 2)`."""
    times = np.linspace(0, plan.period, max(2, round(plan.speed * plan.period / 0.01)))
    return min(clearance(footprint, pose, outlines) for pose in plan.sample(times).pose)
