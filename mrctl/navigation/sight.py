"""What a robot knows of its surroundings: its map, and what the scans of its lidar show beside the map.

Points of a scan that lie too far from the map to belong to it are joined to clusters, as they follow each other in the
scan. A cluster is followed from scan to scan by its centre c, and an α–β filter with α = 1 estimates its velocity:

    v ← v + β (c − ĉ) / Δt,    ĉ = c_before + v Δt,    β = Δt / (τ + Δt)

The centre of what is seen also shifts while a robot drives past something that stands, or sees it come out from behind
something else. A cluster therefore begins to count as moving when it occupies a place through which beams passed a
moment ago, and stops when it is slow. Its velocity is kept while something, or the end of the view, hides a part of
it, or for a moment all of it.

A cluster becomes a row of small discs along its points, which go on with its velocity until the next scan. Discs that a
scan does not show are remembered as long as something may hide them, those that move for a moment.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mrctl.kernel import Array, kernel
from mrctl.navigation.chart import MAX_FAR_OFFSET, MIN_POINTS, PLACE_RADIUS, Chart, in_view, largest_offset, through
from mrctl.scenario import Scenario
from mrctl.theory.clearance import clearance
from mrctl.theory.grid import Field, at, map_area, near_field
from mrctl.theory.obstacles import Obstacles, Outlines, Surroundings
from mrctl.theory.rays import Scan

CLUSTER_GAP = 0.3  # m between two points of a cluster, at most
DISC_SPACING = 0.1  # m, of the discs along a cluster; their PLACE_RADIUS covers the noise of the lidar
MATCHING_DISTANCE = 0.5  # m between the centre of a cluster and where it was expected, at most
SMOOTHING_TIME = 0.15  # s, τ; chosen
# s, in which the place of a cluster must have been empty if it moves; between two such scans
EMPTY_TIME, EMPTY_INTERVAL = 1.0, 0.1
EMPTY_SHARE = 0.3  # share of its points at which it must have been
STANDING_SPEED = 0.1  # m/s, below which a cluster stands
MEMORY = 1.0  # s, for which a cluster, and a disc that moves, is remembered
# m: extra margin of a new plan around what is not on the map. Where the robot is nearer already, the margin is its
# clearance less KEPT_CLEARANCE. Chosen.
UNMAPPED_PLAN_MARGIN, KEPT_CLEARANCE = 0.13, 0.03
NOTHING_SEEN = Surroundings(Obstacles()).at(0.0)


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
    """Whether nothing hides a part of it, and all of it is in the view of the lidar."""


class Sight:
    """Map and finds of one robot; a motion stage hands its scans to `see`.

    Attributes:
        standing: Outlines of those finds that stand.
    """

    def __init__(self, known: Obstacles, field: Field | None = None) -> None:
        """Takes the obstacles on the map, and the distance field around them, if that is known."""
        self._chart, self._field = Chart(known), field
        if field is None and known.shapes:
            low, high, cell = map_area(known)
            self._field = near_field(self._chart.known, low, high, cell, MAX_FAR_OFFSET + 2 * cell)
        self.forget()

    @classmethod
    def each(cls, scenarios: Sequence[Scenario]) -> list[Sight]:
        """Makes the sight of each robot; robots with the same map share its distance field."""
        found: dict[Obstacles, Sight] = {}
        for known in (scenario.known for scenario in scenarios):
            if known not in found:
                found[known] = cls(known)
        return [cls(scenario.known, found[scenario.known]._field) for scenario in scenarios]

    def forget(self) -> None:
        """Forgets all that scans have shown."""
        self._found = np.zeros((0, 5))  # discs: x, y, their velocities, and when they were seen
        self._clusters: list[Cluster] = []
        self._scans: list[Scan] = []
        self.standing = NOTHING_SEEN
        self._chart.forget()

    @property
    def map(self) -> Outlines:
        """What is on the map, without what has turned out to be gone."""
        return self._chart.outlines

    def see(self, scan: Scan) -> bool:
        """Takes a scan; returns whether the map has changed."""
        time, past = scan.time, [other for other in self._scans if scan.time - other.time < EMPTY_TIME + 1e-9]
        if not past or time - past[-1].time > EMPTY_INTERVAL - 1e-9:
            past.append(scan)
        self._scans = past
        before, now, discs = list(self._clusters), [], [np.zeros((0, 5))]
        for points, whole in self._unknown(scan):
            centre, velocity = points.mean(axis=0), np.zeros(2)
            was_empty = np.any([through(points, other) for other in past], axis=0)
            moves = bool(was_empty.mean() >= EMPTY_SHARE)
            expected = [c.centre + (time - c.time) * c.velocity for c in before]
            away = [float(np.hypot(*(centre - there))) for there in expected]
            if away and min(away) < MATCHING_DISTANCE:
                same = int(np.argmin(away))
                old = before.pop(same)  # each is found again at most once
                velocity = old.velocity
                if whole and old.whole:
                    velocity = velocity + (centre - expected[same]) / (SMOOTHING_TIME + time - old.time)
                moves |= old.moves
            moves &= bool(np.hypot(velocity[0], velocity[1]) >= STANDING_SPEED)
            now.append(Cluster(centre, velocity, time, moves, whole))
            own = velocity if moves else np.zeros(2)
            discs.append(np.array([(*point, *own, time) for point in _thinned(points)]))
        new = np.concatenate(discs)
        self._clusters = now + [cluster for cluster in before if time - cluster.time < MEMORY]
        self._found = found = np.concatenate([new, self._hidden(self._found, new, scan)])
        self.standing = _outlines(found[~_moves(found)])
        return self._chart.see(scan)

    def discs(self, time: float) -> Array:
        """Returns discs around what the robot has found beside the map.

        Args:
            time: Time in s at which they are where they would be by their velocities.

        Returns:
            x and y in m, velocities along x and y in m/s and radius in m, `(M, 5)`.
        """
        found = self._found
        return np.column_stack([_placed(found, time), found[:, 2:4], np.full(len(found), PLACE_RADIUS)])

    def moving(self, time: float) -> Outlines:
        """Returns those finds that move, where they would be at a time in s."""
        moving = self._found[_moves(self._found)]
        return _outlines(_placed(moving, time)) if len(moving) else NOTHING_SEEN

    def outlines(self, time: float, margin: float = 0.0) -> Outlines:
        """Returns the map and the finds at a time in s; the finds are enlarged by a margin in m."""
        found, known = _outlines(_placed(self._found, time)).discs + [0.0, 0.0, margin], self.map
        return known._replace(discs=np.concatenate([known.discs, found]))

    def around(self, time: float, footprint: Array, pose: Array) -> Outlines:
        """Returns what a new plan has to go around: the map and the finds, with a margin around these.

        Args:
            time: Time in s.
            footprint: Corners of the robot in its frame in m, `(n, 2)`.
            pose: x and y in m and θ in rad, from which it plans, `(3,)`.
        """
        left = clearance(footprint, pose, self.standing) - KEPT_CLEARANCE
        return self.outlines(time, min(UNMAPPED_PLAN_MARGIN, max(0.0, left)))

    def _unknown(self, scan: Scan) -> list[tuple[Array, bool]]:
        """Returns the points of each cluster beside the map in m, `(k, 2)`, and whether the lidar sees its whole front.

        It does not where something nearer hides a part, or where the view of the lidar ends.
        """
        ranges = scan.ranges
        met, points = np.flatnonzero(np.isfinite(ranges)), scan.points
        ranges = np.append(ranges, np.zeros(scan.full_turn - len(ranges)))
        if self._field is not None:
            away = np.empty(len(points))
            from_map.compiled(self._field, points, away)
            beside = away > largest_offset(ranges[met])
            met, points = met[beside], points[beside]
        if not len(met):
            return []
        near = np.hypot(*(points - np.roll(points, 1, axis=0)).T) < CLUSTER_GAP + 2 * scan.step * ranges[met]
        joined = near & ((met - np.roll(met, 1)) % len(ranges) <= 2)  # with the point before; the first with the last
        first = np.flatnonzero(~joined)
        if len(first):
            met, points = np.roll(met, -first[0]), np.roll(points, -first[0], axis=0)
        found = []
        for part in np.split(np.arange(len(met)), first[1:] - first[0] if len(first) else []):
            ends = met[part[[0, -1]]]
            beyond = ranges[(ends + [-1, 1]) % len(ranges)]
            found.append((points[part], bool(np.all(beyond > ranges[ends] - CLUSTER_GAP))))
        return [(part, whole) for part, whole in found if len(part) >= MIN_POINTS]

    def _hidden(self, old: Array, new: Array, scan: Scan) -> Array:
        """Returns the old discs, `(k, 5)`, that the scan neither shows nor sees through.

        An old disc near a new one counts as shown, unless it is out of range, or something else hides it.
        """
        if not len(old):
            return old
        places, moves = _placed(old, scan.time), _moves(old)
        gone = through(places, scan) | (moves & (scan.time - old[:, 4] > MEMORY))
        if len(new):
            near = np.hypot(*(places[:, None] - new[None, :, :2]).transpose(2, 0, 1)).min(axis=1) < 2 * DISC_SPACING
            gone |= near & (moves | in_view(places, scan, 2 * DISC_SPACING))
        return _apart(old[~gone])


@kernel
def from_map(field: Field, points: Array, found: Array) -> None:
    """Writes the distances of points, `(n, 2)` in m, from the obstacles of a map into `found`, `(n,)` in m."""
    for k in range(len(points)):
        found[k] = at(field, points[k, 0], points[k, 1])[0]


def _placed(found: Array, time: float) -> Array:
    """Returns the places of discs that were found, with velocities and times as in `Sight`, at a time, `(M, 2)`."""
    return found[:, :2] + (time - found[:, 4:]) * found[:, 2:4]


def _moves(discs: Array) -> NDArray[np.bool]:
    """Tells which discs, x, y and their velocities first, `(M, 4 or more)`, move."""
    return (discs[:, 2:4] != 0).any(axis=1)


def _outlines(places: Array) -> Outlines:
    """Returns discs around places, x and y in m first, as outlines."""
    return NOTHING_SEEN._replace(discs=np.column_stack([places[:, :2], np.full(len(places), PLACE_RADIUS)]))


def _apart(discs: Array) -> Array:
    """Returns discs, `(k, 5)`, without those within half of `DISC_SPACING` of one that is kept and was seen earlier."""
    kept = np.zeros(len(discs), bool)
    for k in np.argsort(discs[:, 4], kind="stable"):
        kept[k] = not kept.any() or np.hypot(*(discs[kept, :2] - discs[k, :2]).T).min() >= DISC_SPACING / 2
    return discs[kept]


def _thinned(points: Array) -> Array:
    """Returns points of a row of them, `(n, 2)` in m, at least `DISC_SPACING` apart, beginning with the first."""
    kept = [0]
    for k in range(1, len(points)):
        if np.hypot(*(points[k] - points[kept[-1]])) >= DISC_SPACING:
            kept.append(k)
    return points[kept]
