"""What an overview should show, and where a camera has to be so that this fills its picture."""

from __future__ import annotations

import itertools

import numpy as np
from scipy.spatial import ConvexHull

from mrctl.kernel import Array
from mrctl.physics.obstacles import WALL_HEIGHT
from mrctl.theory.obstacles import Obstacles, Surroundings
from mrctl.viewer.shapes import sides

OVERVIEW, TOP = np.array([0.0, -0.7, 0.7]), np.array([0.0, -0.01, 1.0])  # directions to cameras; no camera looks down
MIN_VIEW = 1.2  # m, least width of the view
COURSE_TIMES = 9  # at which obstacles that move are to be seen in an overview
FILLED_SHARE = 0.92  # share of width or height of a picture that is filled
HALVINGS = 40  # of intervals of slopes


def fitted(points: Array, side: Array, fov: float, aspect: float) -> tuple[Array, Array]:
    """Returns the position of a camera that sees points as large as possible, and what it looks at, in m, `(3,)` each.

    The margins of the picture are equal to the left and to the right of the points, and above and below them. What the
    camera looks at is as high as the lowest point, for a floor.

    Args:
        points: Points in m, not all of them the same, `(n, 3)`.
        side: Direction from the points to the camera, `(3,)`; upwards, but not straight up.
        fov: Angle of view from the lower to the upper edge of the picture in rad.
        aspect: Ratio of width to height of the picture, positive.
    """
    ahead = -np.asarray(side) / np.linalg.norm(side)
    right = np.cross(ahead, [0.0, 0, 1])
    axes = np.stack([right, np.cross(right, ahead)]) / np.linalg.norm(right)
    across, depth = points @ axes.T, (points @ ahead)[:, None]

    def extents(slopes: Array) -> Array:
        """Least coordinates of a camera at depth 0 that sees all points within slopes: along each axis and against it.

        A camera at c sees a point p within a slope if |axis·(p − c)| ≤ slope · ahead·(p − c).
        """
        return np.stack([(sign * across - slopes * depth).max(axis=0) for sign in (1, -1)])

    largest = FILLED_SHARE * np.tan(fov / 2) * np.array([aspect, 1.0])
    back = (-extents(largest).sum(axis=0) / (2 * largest)).min()
    depth -= back
    low, high = np.zeros(2), largest
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        seen = extents(middle).sum(axis=0) <= 0
        low, high = np.where(seen, low, middle), np.where(seen, middle, high)
    along, against = extents(high)
    position = (along - against) / 2 @ axes + back * ahead
    return position, position + (points[:, 2].min() - position[2]) / ahead[2] * ahead


def to_see(lines: Array, duration: float, reach: float, top: float, obstacles: Obstacles) -> Array:
    """Returns points around all that an overview shows: robots on lines, and the obstacles around these.

    Args:
        lines: Places on the lines in m, `(n, 3)`.
        duration: Time in s in which obstacles move.
        reach: Distance of the farthest corner of a robot from P in m.
        top: Height of a robot in m.
        obstacles: The obstacles.

    Returns:
        Corners of a convex body in m, `(k, 3)`: a camera that sees these sees all.
    """
    low, high = lines.min(axis=0), lines.max(axis=0)
    size = max(MIN_VIEW, *(high - low)[:2])
    found = [lines + np.array(corner) for corner in itertools.product((-reach, reach), (-reach, reach), (0.0, top))]
    square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * MIN_VIEW / 2
    least = (low + high) / 2 + np.column_stack([square, np.zeros(4)])
    moving = Surroundings(Obstacles(shapes=obstacles.moving))
    outlines = [moving.at(time) for time in np.linspace(0, duration, COURSE_TIMES) if moving.courses]
    segments = np.concatenate([sides(one) for one in (Surroundings(obstacles.still).at(0.0), *outlines)])
    left, right = low[:2] - size, high[:2] + size  # what is farther away would make all else too small
    around = (segments.max(axis=1) >= left) & (segments.min(axis=1) <= right)
    near = segments[around.all(axis=1)].reshape(-1, 2).clip(left, right)
    found += [np.column_stack([near, np.full(len(near), z)]) for z in (low[2], WALL_HEIGHT)]
    points = np.concatenate([*found, least])
    return points[ConvexHull(points).vertices]
