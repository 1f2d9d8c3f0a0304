"""Clearance: the distance between a footprint, as a convex polygon or as discs, and the obstacles."""

from __future__ import annotations

import numpy as np

from mrctl.kernel import Array, kernel
from mrctl.theory.obstacles import Outlines, Surroundings, moved


def cover(footprint: Array, count: int = 3, rows: int = 1) -> Array:
    """Covers a footprint with equal discs in rows (Ziegler and Stiller, "Fast collision checking for intelligent
    vehicle motion planning", IEEE Intelligent Vehicles Symposium 2010, with one row).

    Args:
        footprint: Corners in the robot's frame in m, `(n, 2)`.
        count: Number of discs in a row, along the x axis.
        rows: Number of rows; with two the discs reach less far beyond nose and tail.

    Returns:
        x and y of the centres in the robot's frame and radius in m, `(rows · count, 3)`.
    """  # noqa: D205
    low, high = footprint.min(axis=0), footprint.max(axis=0)
    length, width = (high - low) / [count, rows]
    x = low[0] + length * (np.arange(count) + 0.5)
    y = (low[1] + high[1]) / 2 + width * (np.arange(rows) - (rows - 1) / 2)
    places = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    return np.column_stack([places, np.full(len(places), np.hypot(length, width) / 2)])


def rim(footprint: Array, radius: float) -> Array:
    """Covers the outline of a footprint, but not what is within it, with equal discs, which reach `radius` beyond it.

    Args:
        footprint: Corners in the robot's frame in m, `(n, 2)`.
        radius: Radius of the discs in m.

    Returns:
        x and y of the centres in the robot's frame and radius in m, `(k, 3)`.
    """
    corners = np.vstack([footprint, footprint[:1]])
    along = np.append(0.0, np.cumsum(np.hypot(*np.diff(corners, axis=0).T)))
    count = int(np.ceil(along[-1] / (2 * radius)))
    places = along[-1] / count * (np.arange(count) + 0.5)
    return np.column_stack([*(np.interp(places, along, side) for side in corners.T), np.full(count, radius)])


def clearance(footprint: Array, pose: Array, outlines: Outlines) -> float:
    """Returns the distance in m between a footprint and the nearest obstacle.

    Where they overlap it is minus the penetration depth, the least translation that separates them; it is infinite
    where there is no obstacle.

    Args:
        footprint: Corners in the robot's frame, counter-clockwise, in m, `(n, 2)`.
        pose: x and y of P in m and θ in rad, `(3,)`.
        outlines: The obstacles.
    """
    return gap.compiled(footprint, np.asarray(pose, float), np.empty((len(footprint), 4)), outlines)


def clearances(footprint: Array, poses: Array, times: Array, surroundings: Surroundings) -> Array:
    """Returns the clearance of a robot at each moment of a run.

    Args:
        footprint: Corners in the robot's frame, counter-clockwise, in m, `(n, 2)`.
        poses: x and y of P in m and θ in rad, `(T, 3)`; the clearance of a pose with NaN is NaN.
        times: Times in s, `(T,)`.
        surroundings: The obstacles.

    Returns:
        Clearances in m, as those of `clearance`, `(T,)`.
    """
    scratch, courses = np.empty((len(footprint), 4)), surroundings.poses(np.asarray(times, float))
    outlines, found = surroundings.at(0.0), np.full(len(poses), np.nan)
    for k in np.flatnonzero(np.isfinite(poses).all(axis=1)):
        if surroundings.courses:
            outlines = surroundings.placed(courses[k])
        found[k] = gap.compiled(footprint, poses[k], scratch, outlines)
    return found


@kernel
def gap(footprint: Array, pose: Array, sides: Array, outlines: Outlines) -> float:
    """Returns the distance in m that `clearance` describes; `sides` is scratch, `(n, 4)`."""
    discs, edges, first, rings = outlines
    n, nearest, reach = len(footprint), np.inf, 0.0
    for k in range(n):
        following = (k + 1) % n
        sides[k, 0], sides[k, 1] = moved(pose, footprint[k, 0], footprint[k, 1])
        sides[k, 2], sides[k, 3] = moved(pose, footprint[following, 0], footprint[following, 1])
        reach = max(reach, np.hypot(footprint[k, 0], footprint[k, 1]))
    for k in range(len(discs)):
        x, y, radius = discs[k]
        within = max(radius + reach + nearest, 0.0)  # farther off than this it cannot be the nearest
        if (x - pose[0]) ** 2 + (y - pose[1]) ** 2 < within * within:
            nearest = min(nearest, point_to_polygon(x, y, sides) - radius)
    for k in range(len(rings)):
        x, y, radius = rings[k]
        within = max(radius + reach + nearest, 0.0)  # farther off than this it cannot be the nearest
        if (x - pose[0]) ** 2 + (y - pose[1]) ** 2 >= within * within:
            continue
        polygon = edges[first[k] : first[k + 1]]
        if farthest_outside(pose[0], pose[1], polygon) < reach + nearest:
            nearest = min(nearest, polygon_to_polygon(sides, polygon))
    return nearest


@kernel
def point_to_segment(x: float, y: float, side: Array) -> float:
    """Returns the distance of a point from a segment, x and y of its start and end, `(4,)`; all in m."""
    dx, dy = side[2] - side[0], side[3] - side[1]
    along = ((x - side[0]) * dx + (y - side[1]) * dy) / (dx * dx + dy * dy)
    along = min(max(along, 0.0), 1.0)
    return np.hypot(x - side[0] - along * dx, y - side[1] - along * dy)


@kernel
def outside(x: float, y: float, side: Array) -> float:
    """Returns the signed distance of a point to the right of the line through a side, `(4,)`; all in m."""
    dx, dy = side[2] - side[0], side[3] - side[1]
    return ((x - side[0]) * dy - (y - side[1]) * dx) / np.hypot(dx, dy)


@kernel
def farthest_outside(x: float, y: float, sides: Array) -> float:
    """Returns the largest `outside` of the sides of a convex polygon, `(n, 4)`: no more than its distance, in m."""
    depth = -np.inf
    for k in range(len(sides)):
        depth = max(depth, outside(x, y, sides[k]))
    return depth


@kernel
def point_to_polygon(x: float, y: float, sides: Array) -> float:
    """Returns the distance of a point from a convex polygon, counter-clockwise sides `(n, 4)`; negative inside."""
    depth, distance = -np.inf, np.inf
    for k in range(len(sides)):
        depth = max(depth, outside(x, y, sides[k]))
        distance = min(distance, point_to_segment(x, y, sides[k]))
    return depth if depth <= 0.0 else distance


@kernel
def polygon_to_polygon(a: Array, b: Array) -> float:
    """Returns the distance of two convex polygons, counter-clockwise sides `(n, 4)` and `(m, 4)`; minus the depth of
    penetration where they overlap, by the theorem of separating axes (Ericson, Real-Time Collision Detection, 2005).
    """  # noqa: D205
    separation = max(_separation(a, b), _separation(b, a))
    if separation <= 0.0:
        return separation
    distance = np.inf
    for i in range(len(a)):
        for k in range(len(b)):
            distance = min(distance, point_to_segment(a[i, 0], a[i, 1], b[k]))
            distance = min(distance, point_to_segment(b[k, 0], b[k, 1], a[i]))
    return distance


@kernel
def _separation(a: Array, b: Array) -> float:
    """Returns the largest gap between two polygons along a normal of the first one; negative where none separates."""
    largest = -np.inf
    for i in range(len(a)):
        least = np.inf
        for k in range(len(b)):
            least = min(least, outside(b[k, 0], b[k, 1], a[i]))
        largest = max(largest, least)
    return largest
