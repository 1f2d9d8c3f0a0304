"""What a robot knows of its surroundings: its map, and what the scans of its lidar show beside the map.

Points of a scan that lie too far from the map to belong to it are joined to clusters, as they follow each other in the
scan. A cluster is followed from scan to scan by its centre c, and an α–β filter with α = 1 estimates its velocity:

    v ← v + β (c − ĉ) / Δt,    ĉ = c_before + v Δt

The centre of what is seen also shifts while a robot drives past something that stands, or sees it come out from behind
something else. A cluster therefore counts as moving only from when on it is where beams passed a moment ago, and until
it is slow; and its velocity stays as it is while something hides a part of it, or all for a moment.

A cluster becomes a row of small discs along its points, which go on with its velocity until the next scan. Discs that a
scan does not show are remembered as long as something may hide them, those that move for a moment.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mrctl.kernel import Array, kernel
from mrctl.theory.grid import MOST_CELLS, Field, at, field_of
from mrctl.theory.obstacles import Obstacles, Outlines, Surroundings

CELL = 0.05  # m, of the distance field of the map
MARGIN = 1.0  # m, by which it extends beyond the obstacles
BESIDE = 0.1, 0.02  # m, and share of the range: distance beyond which a point does not belong to a place; chosen
GAP = 0.3  # m between two points of a cluster, at most
LEAST = 2  # points of a cluster
SPACING, RADIUS = 0.1, 0.05  # m, of the discs along a cluster; RADIUS covers the noise of the lidar
GATE = 0.5  # m between the centre of a cluster and where it was expected, at most
GAIN = 0.4  # β
PAST = 10  # scans, in one of which the place of a cluster must have been empty if it moves
EMPTY = 0.3  # share of its points at which it must have been
SLOW = 0.1  # m/s, below which a cluster stands
HIDDEN = 1.0  # s, for which a cluster, and a disc that moves, is remembered
NOTHING = Surroundings(Obstacles()).at(0.0)


class Cluster(NamedTuple):
    """Points of a scan beside the map that belong together."""

    centre: Array
    """Mean of the points in m, `(2,)`."""
    velocity: Array
    """Velocity of the centre along x and y in m/s, `(2,)`."""
    time: float
    """Time of the scan in s."""
    moves: bool
    """Whether it moves."""
    whole: bool
    """Whether nothing hides a part of it."""


class Sight:
    """Map and finds of B robots; a motion stage hands its scans to `see`.

    Attributes:
        map: Outlines of the obstacles on the map.
    """

    def __init__(self, known: Obstacles, size: int) -> None:
        """Takes the obstacles on the map, and the number of robots."""
        self.map, self._field, self._size = Surroundings(known).at(0.0), None, size
        if known.shapes:
            low, high = (corner + side * MARGIN for corner, side in zip(known.bounds, (-1, 1), strict=True))
            cell = max(CELL, float(np.sqrt(np.prod(high - low) / MOST_CELLS)) * 1.01)
            self._field: Field | None = field_of(self.map, low, high, cell)
        self.forget()

    def forget(self) -> None:
        """Forgets all that scans have shown."""
        self._found = [np.zeros((0, 5))] * self._size  # discs: x, y, their velocities, and when they were seen
        self._clusters: list[list[Cluster]] = [[] for _ in range(self._size)]
        self._scans: list[list[tuple[Array, Array, Array]]] = [[] for _ in range(self._size)]  # arguments of `through`

    def see(self, row: int, ranges: Array, angles: Array, place: Array, time: float) -> None:
        """Takes a scan of one robot.

        Args:
            row: Index of the robot.
            ranges: Ranges in m, `(n,)`; infinite where nothing returned.
            angles: Directions of the beams from straight ahead in rad, evenly spaced, counter-clockwise, `(n,)`.
            place: Estimated pose of the lidar in m, m, rad, `(3,)`.
            time: Time of the scan in s.
        """
        scan, before, now, discs = (ranges, angles, place), list(self._clusters[row]), [], [np.zeros((0, 5))]
        self._scans[row] = [*self._scans[row][-PAST:], scan]
        for points, whole in self._unknown(*scan):
            centre, velocity = points.mean(axis=0), np.zeros(2)
            was_empty = np.any([through(points, *past) for past in self._scans[row]], axis=0)
            moves = bool(was_empty.mean() >= EMPTY)
            expected = [c.centre + (time - c.time) * c.velocity for c in before]
            away = [float(np.hypot(*(centre - there))) for there in expected]
            if away and min(away) < GATE:
                same = int(np.argmin(away))
                old = before.pop(same)  # one cluster goes on in one
                velocity = old.velocity
                if whole and old.whole:
                    velocity = velocity + GAIN * (centre - expected[same]) / (time - old.time)
                moves |= old.moves
            moves &= bool(np.hypot(*velocity) >= SLOW)
            now.append(Cluster(centre, velocity, time, moves, whole))
            own = velocity if moves else np.zeros(2)
            discs.append(np.array([(*point, *own, time) for point in _thinned(points)]))
        new = np.concatenate(discs)
        self._clusters[row] = now + [cluster for cluster in before if time - cluster.time < HIDDEN]
        self._found[row] = np.concatenate([new, self._hidden(self._found[row], new, scan, time)])

    def discs(self, row: int, time: float) -> Array:
        """Returns discs around what one robot has found beside the map.

        Args:
            row: Index of the robot.
            time: Time in s at which they are where they would be by their velocities.

        Returns:
            x and y in m, velocities along x and y in m/s and radius in m, `(M, 5)`.
        """
        found = self._found[row]
        return np.column_stack([_placed(found, time), found[:, 2:4], np.full(len(found), RADIUS)])

    def standing(self, row: int) -> Outlines:
        """Returns what one robot has found beside the map that stands."""
        found = self.discs(row, 0.0)
        return _outlines(found[~_moves(found)])

    def moving(self, row: int, time: float) -> Outlines:
        """Returns what one robot has found that moves, where it would be at a time in s."""
        found = self.discs(row, time)
        return _outlines(found[_moves(found)])

    def outlines(self, row: int, time: float, margin: float = 0.0) -> Outlines:
        """Returns the map with what one robot has found, at a time in s, the latter with a margin in m around it."""
        found = _outlines(self.discs(row, time)).discs + [0.0, 0.0, margin]
        return self.map._replace(discs=np.concatenate([self.map.discs, found]))

    def _unknown(self, ranges: Array, angles: Array, place: Array) -> list[tuple[Array, bool]]:
        """Returns the points of each cluster beside the map in m, `(k, 2)`, and whether nothing hides a part of it.

        The arguments are those of `see`.
        """
        met = np.flatnonzero(np.isfinite(ranges))
        direction = place[2] + angles[met]
        points = place[:2] + ranges[met, None] * np.column_stack([np.cos(direction), np.sin(direction)])
        if self._field is not None:
            away = np.empty(len(points))
            from_map.compiled(self._field, points, away)
            beside = away > BESIDE[0] + BESIDE[1] * ranges[met]
            met, points = met[beside], points[beside]
        if not len(met):
            return []
        near = np.hypot(*(points - np.roll(points, 1, axis=0)).T) < GAP + 2 * _step(angles) * ranges[met]
        joined = near & ((met - np.roll(met, 1)) % len(ranges) <= 2)  # with the point before; the first with the last
        first = np.flatnonzero(~joined)
        if len(first):
            met, points = np.roll(met, -first[0]), np.roll(points, -first[0], axis=0)
        found = []
        for part in np.split(np.arange(len(met)), first[1:] - first[0] if len(first) else []):
            ends = met[part[[0, -1]]]
            beyond = ranges[(ends + [-1, 1]) % len(ranges)]
            found.append((points[part], bool(np.all(beyond > ranges[ends] - GAP))))
        return [(part, whole) for part, whole in found if len(part) >= LEAST]

    def _hidden(self, old: Array, new: Array, scan: tuple[Array, Array, Array], time: float) -> Array:
        """Returns the discs of before, `(k, 5)`, that the scan neither shows nor sees through."""
        if not len(old):
            return old
        places = _placed(old, time)
        gone = through(places, *scan) | (_moves(old) & (time - old[:, 4] > HIDDEN))
        if len(new):
            gone |= np.hypot(*(places[:, None] - new[None, :, :2]).transpose(2, 0, 1)).min(axis=1) < 2 * SPACING
        return old[~gone]


def through(points: Array, ranges: Array, angles: Array, place: Array) -> NDArray[np.bool]:
    """Tells for which points, `(k, 2)` in m, all beams pass that would meet a disc of `RADIUS` around them, `(k,)`.

    The other arguments are those of `Sight.see`.
    """
    found = np.empty(len(points), bool)
    pass_through.compiled(np.ascontiguousarray(points), ranges, angles[0], _step(angles), place, found)
    return found


@kernel
def pass_through(
    points: Array, ranges: Array, first: float, step: float, place: Array, found: NDArray[np.bool]
) -> None:
    """Writes what `through` returns into `found`; the beams begin at `first` and are `step` apart, in rad."""
    n = len(ranges)
    for k in range(len(points)):
        dx, dy = points[k, 0] - place[0], points[k, 1] - place[1]
        away = np.hypot(dx, dy)
        half = np.arctan2(RADIUS, away)
        beam = ((np.arctan2(dy, dx) - place[2] - first + step / 2) % (2 * np.pi)) / step
        reach, wide = away + BESIDE[0] + BESIDE[1] * away, half / step
        found[k] = True
        for i in range(int(np.floor(beam - wide)), int(np.floor(beam + wide)) + 1):
            around = i % max(n, int(np.round(2 * np.pi / step)))
            found[k] &= around < n and ranges[min(around, n - 1)] > reach


@kernel
def from_map(field: Field, points: Array, found: Array) -> None:
    """Writes the distances of points, `(n, 2)` in m, from the obstacles of a map into `found`, `(n,)` in m."""
    for k in range(len(points)):
        found[k] = at(field, points[k, 0], points[k, 1])[0]


def _step(angles: Array) -> float:
    """Returns the angle from one beam to the next in rad."""
    return float(angles[1] - angles[0]) if len(angles) > 1 else 2 * np.pi


def _placed(found: Array, time: float) -> Array:
    """Returns the places of discs that were found, with velocities and times as in `Sight`, at a time, `(M, 2)`."""
    return found[:, :2] + (time - found[:, 4:]) * found[:, 2:4]


def _moves(discs: Array) -> NDArray[np.bool]:
    """Tells which discs, x, y and their velocities first, `(M, 4 or more)`, move."""
    return (discs[:, 2:4] != 0).any(axis=1)


def _outlines(discs: Array) -> Outlines:
    """Returns discs, as `Sight.discs` returns them, as outlines."""
    return NOTHING._replace(discs=np.ascontiguousarray(discs[:, [0, 1, 4]]))


def _thinned(points: Array) -> Array:
    """Returns points of a row of them, `(n, 2)` in m, that are at least `SPACING` apart, beginning with the first."""
    kept = [0]
    for k in range(1, len(points)):
        if np.hypot(*(points[k] - points[kept[-1]])) >= SPACING:
            kept.append(k)
    return points[kept]
