"""The map of a robot, without those obstacles on it that its scans have shown to be gone.

Some places inside each obstacle are looked at. It is gone when beams have passed through 90 % of them, through each in
at least five scans. One scan proves little, because the pose from which it seems to be taken is estimated. An obstacle
is back when points of a scan lie on it again. What is gone is gone as a whole: a wall with a new door stays. A point
that may be of two obstacles shows neither. From far away a thing may therefore be taken for gone where the error of the
estimate moves its points to a wall behind it, until a scan from nearby shows it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mrctl.kernel import Array, kernel
from mrctl.theory.clearance import point_to_polygon
from mrctl.theory.obstacles import Obstacles, Outlines, Surroundings
from mrctl.theory.rays import Scan

PLACE_RADIUS = 0.05  # m, of a disc around a place, through which beams pass or not
# m, and share of the range: how far a point may lie beside the place to which it belongs; chosen
MAX_OFFSET, MAX_OFFSET_SHARE = 0.1, 0.02
MAX_FAR_OFFSET = 0.5  # m, at most
MIN_POINTS = 2  # least number of points of a scan that show something
# least and greatest number of places on a ring inside an obstacle, and m between; chosen
MIN_RING_PLACES, MAX_RING_PLACES, RING_SPACING = 8, 32, 0.2
RING_SIZES = 0.8, 0.4  # sizes of the two rings over that of the outline
# scans that pass through a place, and share of the places, at which an obstacle is gone; chosen
GONE_SCANS, GONE_SHARE = 5, 0.9


class Chart:
    """The map of a robot.

    Attributes:
        known: Outlines of all that was on the map at the start.
        outlines: Outlines of what is on it now.
    """

    def __init__(self, known: Obstacles) -> None:
        """Takes the obstacles on the map."""
        self.known = Surroundings(known).at(0.0)
        discs, _, _, rings = self.known
        self._middles = np.concatenate([discs[:, :2], rings[:, :2]])
        self._radii = np.concatenate([discs[:, 2], rings[:, 2]])
        self._places: dict[int, tuple[Array, float]] = {}  # what `_inside` has returned
        self.forget()

    def forget(self) -> None:
        """Forgets what scans have shown."""
        self._gone = np.zeros(len(self._middles), bool)
        self.outlines = self.known
        self._passed: dict[int, NDArray[np.int64]] = {}  # scans that have passed through the places of an obstacle

    def see(self, scan: Scan) -> bool:
        """Takes a scan; returns whether the map has changed."""
        points, passed, before = scan.points, self._passed, self._gone.copy()
        if not len(points):  # nothing says that the lidar sees at all
            return False
        away = np.hypot(*(points - scan.place[:2]).T)
        margin = largest_offset(away)
        for shape in np.flatnonzero(through(self._middles, scan)).tolist():
            places, depth = self._places[shape] = self._places.get(shape) or self._inside(shape)
            dense = scan.step * np.hypot(*(places - scan.place[:2]).T) < depth  # a beam would have met the obstacle
            passed[shape] = passed.get(shape, np.zeros(len(places), int)) + (dense & through(places, scan))
        for shape, scans in list(passed.items()):
            if self._shown(shape, points, margin):
                del passed[shape]
                self._gone[shape] = False
            elif np.mean(scans >= GONE_SCANS) >= GONE_SHARE:
                self._gone[shape] = True
        if changed := not np.array_equal(self._gone, before):
            self.outlines = _without(self.known, self._gone)
        return changed

    def _distances(self, shape: int, points: Array) -> Array:
        """Returns the distances of points, `(k, 2)`, from an obstacle in m, negative inside, `(k,)`."""
        discs, edges, first, _ = self.known
        if (ring := shape - len(discs)) < 0:
            return np.hypot(*(points - discs[shape, :2]).T) - discs[shape, 2]
        found = np.empty(len(points))
        distances_from.compiled(np.ascontiguousarray(points), edges[first[ring] : first[ring + 1]], found)
        return found

    def _inside(self, shape: int) -> tuple[Array, float]:
        """Returns places inside an obstacle, `(k, 2)`, and how deep its middle lies in it; all in m."""
        discs, edges, first, _ = self.known
        middle = self._middles[shape]
        if (ring := shape - len(discs)) >= 0:
            corners = edges[first[ring] : first[ring + 1], :2]
        else:
            turn = np.linspace(0.0, 2 * np.pi, MAX_RING_PLACES, endpoint=False)
            corners = middle + discs[shape, 2] * np.column_stack([np.cos(turn), np.sin(turn)])
        around = np.vstack([corners, corners[:1]])
        along = np.append(0.0, np.cumsum(np.hypot(*np.diff(around, axis=0).T)))
        count = int(np.clip(np.ceil(along[-1] / RING_SPACING), MIN_RING_PLACES, MAX_RING_PLACES))
        outline = np.column_stack([np.interp(along[-1] / count * np.arange(count), along, side) for side in around.T])
        places = np.concatenate([[middle], *(middle + share * (outline - middle) for share in RING_SIZES)])
        return places, -float(self._distances(shape, middle[None])[0])

    def _shown(self, shape: int, points: Array, margin: Array) -> bool:
        """Tells whether points of a scan, `(k, 2)`, lie on an obstacle, or within margins in m, `(k,)`, of it.

        Points within the margin of another obstacle on the map do not count: where two walls meet, a scan shows points
        of both, also if one of them is gone.
        """
        middle, radius = self._middles[shape], self._radii[shape]
        near = np.hypot(*(points - middle).T) < radius + margin
        if np.sum(near) < MIN_POINTS:
            return False
        points, margin = points[near], margin[near]
        on = self._distances(shape, points) < margin
        others = ~self._gone & (np.hypot(*(self._middles - middle).T) < radius + self._radii + MAX_FAR_OFFSET)
        others[shape] = False
        for other in np.flatnonzero(others).tolist():
            points, margin = points[on], margin[on]
            if len(points) < MIN_POINTS:
                return False
            on = self._distances(other, points) >= margin
        return int(on.sum()) >= MIN_POINTS


@kernel
def distances_from(points: Array, sides: Array, found: Array) -> None:
    """Writes the distances of points, `(k, 2)`, from a polygon with sides `(n, 4)` in m, negative inside, `(k,)`."""
    for k in range(len(points)):
        found[k] = point_to_polygon(points[k, 0], points[k, 1], sides)


def _without(known: Outlines, gone: NDArray[np.bool]) -> Outlines:
    """Returns outlines without the discs and polygons that are gone, in this order, `(C + P,)`."""
    discs, edges, first, rings = known
    left, sides = ~gone[len(discs) :], np.diff(first)
    return Outlines(
        discs[~gone[: len(discs)]], edges[np.repeat(left, sides)], np.cumsum([0, *sides[left]]), rings[left]
    )


def largest_offset(ranges: Array) -> Array:
    """Returns how far points at these ranges may lie beside what they belong to; all in m and of the same shape."""
    return np.minimum(MAX_OFFSET + MAX_OFFSET_SHARE * ranges, MAX_FAR_OFFSET)


def through(points: Array, scan: Scan) -> NDArray[np.bool]:
    """Tells for which points, `(k, 2)` in m, all beams pass that would meet a disc of `PLACE_RADIUS` there, `(k,)`.

    A beam passes if what it meets is farther away than the point by more than `MAX_OFFSET` and `MAX_OFFSET_SHARE`.
    """
    found = np.empty(len(points), bool)
    beams = scan.ranges, scan.full_turn, float(scan.angles[0]), scan.step, scan.reach
    pass_through.compiled(np.ascontiguousarray(points), *beams, scan.place, found)
    return found


def in_view(points: Array, scan: Scan, margin: float) -> NDArray[np.bool]:
    """Tells which points, `(k, 2)` in m, are in view and not beyond what their beam met by a margin in m, `(k,)`.

    The beam of a point is the one nearest in direction. A beam that met nothing reaches to the largest range.
    """
    dx, dy = (points - scan.place[:2]).T
    away, turned = np.hypot(dx, dy), np.arctan2(dy, dx) - scan.place[2] - scan.angles[0]
    # From half a step before the first beam; a turn need not be a whole number of steps.
    beam = ((turned + scan.step / 2) % (2 * np.pi) / scan.step).astype(int)
    beam = np.minimum(beam, int(np.ceil(2 * np.pi / scan.step - 1e-9)) - 1)  # despite rounding at the end of the turn
    seen = beam < len(scan.ranges)
    return seen & (away <= scan.reach) & (away < scan.ranges[np.where(seen, beam, 0)] + margin)


@kernel
def pass_through(
    points: Array, ranges: Array, turn: int, first: float, step: float, most: float, place: Array,
    found: NDArray[np.bool],
) -> None:  # fmt: skip
    """Writes what `through` returns into `found`.

    Args:
        points: The points in m, `(k, 2)`.
        ranges: Ranges in m, `(n,)`; infinite where nothing returned.
        turn: Number of beams in a full turn, n or more.
        first: Direction of the first beam from straight ahead in rad.
        step: Angle from one beam to the next in rad.
        most: Largest range in m, beyond which nothing is seen.
        place: Pose of the lidar in m, m, rad, `(3,)`.
        found: Out: whether the beams pass, `(k,)`.
    """
    n = len(ranges)
    for k in range(len(points)):
        dx, dy = points[k, 0] - place[0], points[k, 1] - place[1]
        away = np.hypot(dx, dy)
        half = np.arctan2(PLACE_RADIUS, away)
        beam = ((np.arctan2(dy, dx) - place[2] - first + step / 2) % (2 * np.pi)) / step
        reach, wide = away + MAX_OFFSET + MAX_OFFSET_SHARE * away, half / step
        found[k] = reach <= most
        for i in range(int(np.floor(beam - wide)), int(np.floor(beam + wide)) + 1):
            around = i % turn
            found[k] &= around < n and ranges[min(around, n - 1)] > reach
