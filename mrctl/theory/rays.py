"""Ray casting on the plane: how far a beam goes until it meets an obstacle."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mrctl.kernel import Array, kernel
from mrctl.theory.obstacles import Outlines

EDGE_SLACK = 1e-9  # rad, by which a beam may miss the end of an edge and still meet it, so that none slips through


class Scan(NamedTuple):
    """A scan of a planar lidar, as a robot knows it."""

    ranges: Array
    """Ranges in m, `(n,)`; infinite where nothing returned."""
    angles: Array
    """Directions of the beams from straight ahead in rad, evenly spaced, counter-clockwise, `(n,)`."""
    reach: float
    """Largest range in m."""
    place: Array
    """Estimated pose of the lidar in m, m, rad, `(3,)`."""
    time: float
    """Time since the start of the run in s."""

    @property
    def step(self) -> float:
        """Angle from one beam to the next in rad."""
        return float(self.angles[1] - self.angles[0]) if len(self.angles) > 1 else 2 * np.pi

    @property
    def full_turn(self) -> int:
        """Number of beams in a full turn: those of the scan, and those that the view leaves out."""
        return max(len(self.ranges), round(2 * np.pi / self.step))

    @property
    def points(self) -> Array:
        """Where the beams that met something did so, x and y in m, `(k, 2)`."""
        met = np.isfinite(self.ranges)
        direction = self.place[2] + self.angles[met]
        return self.place[:2] + self.ranges[met, None] * np.column_stack([np.cos(direction), np.sin(direction)])


@kernel
def cast(pose: Array, first: float, step: float, reach: float, outlines: Outlines, ranges: Array) -> None:
    """Casts the beams of a planar lidar at obstacles.

    Beam k leaves in the direction θ + first + k step. Each obstacle is intersected only with the beams within the angle
    that it covers as seen from the sensor, so that the cost grows with the obstacles and the beams that meet them.

    Args:
        pose: x and y of the sensor in m and θ in rad, `(3,)`.
        first: Direction of the first beam from θ in rad.
        step: Angle from one beam to the next in rad, positive.
        reach: Largest range in m.
        outlines: The obstacles.
        ranges: Out: ranges in m, `(n,)`; `reach` where nothing is met.
    """
    discs, edges, firsts, rings = outlines
    n = len(ranges)
    ranges[:] = reach
    x, y, turn = pose[0], pose[1], pose[2] + first
    for k in range(len(discs)):
        dx, dy, radius = discs[k, 0] - x, discs[k, 1] - y, discs[k, 2]
        distance = np.sqrt(dx * dx + dy * dy)
        if distance - radius >= reach:
            continue
        half = np.pi if distance <= radius else np.arcsin(radius / distance)
        towards = np.arctan2(dy, dx) - half - turn
        towards -= 2 * np.pi * np.floor(towards / (2 * np.pi))
        for lap in range(2):  # an interval that contains the direction of the first beam also begins a turn before it
            start = towards - 2 * np.pi * lap
            for beam in range(max(0, int(np.ceil((start - EDGE_SLACK) / step))), n):
                angle = beam * step
                if angle > start + 2 * half + EDGE_SLACK:
                    break
                along = dx * np.cos(turn + angle) + dy * np.sin(turn + angle)
                across = dx * np.sin(turn + angle) - dy * np.cos(turn + angle)
                root = radius * radius - across * across
                if root < 0.0:
                    continue
                met = along - np.sqrt(root)
                if met < 0.0:  # the sensor is inside
                    met = along + np.sqrt(root)
                if 0.0 <= met < ranges[beam]:
                    ranges[beam] = met
    for p in range(len(rings)):
        if np.hypot(rings[p, 0] - x, rings[p, 1] - y) - rings[p, 2] >= reach:
            continue
        for k in range(firsts[p], firsts[p + 1]):
            ax, ay, bx, by = edges[k, 0] - x, edges[k, 1] - y, edges[k, 2] - x, edges[k, 3] - y
            ex, ey = bx - ax, by - ay
            area = ax * by - ay * bx  # twice that of the triangle with the sensor; its sign tells the side
            begin = np.arctan2(ay, ax) if area >= 0.0 else np.arctan2(by, bx)
            width = np.arctan2(abs(area), ax * bx + ay * by)
            if width < EDGE_SLACK:  # seen from its end, where rounding decides; its neighbours are met instead
                continue
            towards = begin - turn
            towards -= 2 * np.pi * np.floor(towards / (2 * np.pi))
            for lap in range(2):
                start = towards - 2 * np.pi * lap
                for beam in range(max(0, int(np.ceil((start - EDGE_SLACK) / step))), n):
                    angle = beam * step
                    if angle > start + width + EDGE_SLACK:
                        break
                    across = np.cos(turn + angle) * ey - np.sin(turn + angle) * ex
                    if across != 0.0:
                        met = area / across
                        if 0.0 <= met < ranges[beam]:
                            ranges[beam] = met
