"""Where a camera has to be, so that its picture is full of what it should show."""

from __future__ import annotations

import numpy as np

from mrctl.kernel import Array

FULL = 0.92  # share of width or height of a picture that is filled
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

    largest = FULL * np.tan(fov / 2) * np.array([aspect, 1.0])
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
