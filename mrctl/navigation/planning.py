"""Path-finding: hybrid A* on cells of place and heading, with arcs that the robot can drive.

Dolgov, Thrun, Montemerlo and Diebel, "Path planning for autonomous vehicles in unknown semi-structured environments",
IJRR 29(5), 2010. Each cell holds the best pose that was found in it, and six arcs (three without reversing) lead on
from there. From every pose that is expanded a shortest path without obstacles is also tried to the goal; it counts as
one more arc, so that the search ends when no pose that is left can be cheaper. The heuristic is the larger of that
path's length and of the way around the obstacles on the plane. The budget is a number of poses; ties go to the earlier
pose.
"""

from __future__ import annotations

import heapq
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mrctl.kernel import Array, kernel
from mrctl.navigation.steer import PIECES, Curve, advance, sample, shortest, steer
from mrctl.record import InputError
from mrctl.theory.clearance import clearance, cover, gap
from mrctl.theory.grid import Field, at, field_of
from mrctl.theory.obstacles import Outlines
from mrctl.theory.references import Waypoints
from mrctl.theory.timing import Limits

HEADINGS = 72
REVERSE = 1.5  # cost of a metre in reverse
SWITCH = 0.5  # cost of a change of direction, m
CHECK = 0.05  # m, distance of the poses of an arc that are held against the obstacles
DISCS = 4  # that cover the footprint; where one of them touches, the footprint itself is looked at
SHOT = 2.0  # in place of the turn of an arc, a shortest path to the goal
MOST_CELLS = 1_000_000  # of the plane, for a search takes 288 bytes for each, and three times that with reversing
STRAIGHT = 0.92  # least ratio of a straight way to the shortest one over the eight neighbours of a cell


class Space(NamedTuple):
    """What a robot moves in, for planning."""

    outlines: Outlines
    """The obstacles."""
    field: Field
    """Their distance field, whose cells are those of the search."""
    footprint: Array
    """Corners of the robot in its frame in m, counter-clockwise, `(n, 2)`."""
    discs: Array
    """Discs that cover the footprint, `(k, 3)`."""
    margin: float
    """Clearance that a plan keeps in m."""


class Tree(NamedTuple):
    """The poses that a search makes, at most N."""

    poses: Array
    """Poses in m, m, rad, `(N, 3)`."""
    parents: NDArray[np.int64]
    """Pose before each, −1 for the start, `(N,)`."""
    turns: Array
    """Turn of the arc that leads to each, as in `Curve`, or `SHOT` for a shortest path to the goal, `(N,)`."""
    ways: Array
    """Signed length of that arc in m; of a shortest path the direction of its end, `(N,)`."""
    costs: Array
    """Cost of the way to each in m, `(N,)`."""


class Plan(NamedTuple):
    """A way from start to goal."""

    poses: Array
    """x and y in m and θ in rad, `(n, 3)`, at most 5 cm apart."""
    ways: Array
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

    def reference(self, speed: float, limits: Limits, spacing: float = 0.25) -> Waypoints:
        """Returns the plan as a reference: splines of continuous curvature, with the time law under all limits.

        Where the plan changes its direction, a spline ends at rest and without curvature, and another one begins.

        Args:
            speed: Largest speed in m/s.
            limits: Limits of the time law, such as `Limits.of(robot)`.
            spacing: Distance of the points that the spline goes through in m.

        Raises:
            InputError: The speed is not positive, or a spline turns too far from the plan at a change of direction.
        """
        turns = np.flatnonzero(self.ways[2:] * self.ways[1:-1] < 0) + 1
        ends = [0, *turns.tolist(), len(self.poses) - 1]
        legs = [_points(self.poses[a : b + 1], spacing) for a, b in pairwise(ends)]
        points = np.concatenate([legs[0][:1], *(leg[1:] for leg in legs)])
        cusps = np.cumsum([len(leg) - 1 for leg in legs[:-1]], dtype=int).tolist()
        values = {"points": points.tolist(), "closed": False, "timing": "limits", "speed": speed, "limits": limits}
        return Waypoints.from_dict(values | {"cusps": [*([0] if self.ways[1] < 0 else []), *cusps]}, "plan")


def _points(poses: Array, spacing: float) -> Array:
    """Returns points at equal distances of about the spacing in m along poses, `(n, 2)`, with two more at the ends."""
    way = np.append(0, np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T)))
    places = np.linspace(0, way[-1], max(2, round(way[-1] / spacing) + 1))
    if places[1] > 2 * CHECK:  # one more point near either end holds the heading there
        places = np.concatenate([places[:1], [CHECK], places[1:-1], [way[-1] - CHECK], places[-1:]])
    return np.column_stack([np.interp(places, way, poses[:, k]) for k in range(2)])


def space(
    outlines: Outlines, footprint: Array, low: Array, high: Array, cell: float = 0.1, margin: float = 0.05
) -> Space:
    """Prepares obstacles for planning.

    Args:
        outlines: The obstacles.
        footprint: Corners of the robot in its frame in m, counter-clockwise, `(n, 2)`.
        low: Lower left corner of the rectangle in which P may be in m, `(2,)`.
        high: Its upper right corner in m, `(2,)`.
        cell: Side of a cell in m.
        margin: Clearance that a plan keeps in m.

    Raises:
        InputError: The rectangle is empty, or has too many cells.
    """
    cells = float(np.prod(np.ceil((np.asarray(high) - low) / cell)))
    if cells > MOST_CELLS:
        raise InputError(f"map: {cells:,.0f} cells of {cell:.3g} m are more than {MOST_CELLS:,}, which a search takes")
    return Space(outlines, field_of(outlines, low, high, cell), footprint, cover(footprint, DISCS), margin)


def plan(where: Space, start: Array, goal: Array, radius: float, reverse: bool, most: int = 500_000) -> Plan:
    """Plans a way from pose to pose.

    Args:
        where: Obstacles and footprint.
        start: x and y in m and θ in rad, `(3,)`.
        goal: x and y in m and θ in rad, `(3,)`.
        radius: Least turning radius in m.
        reverse: Whether the robot may reverse.
        most: Largest number of poses that the search makes.

    Raises:
        InputError: The start or the goal is in an obstacle or off the map, or no way was found.
    """
    start, goal = np.asarray(start, float), np.asarray(goal, float)
    low, high = (
        where.field.origin,
        where.field.origin + where.field.resolution * np.array(where.field.distance.shape)[::-1],
    )
    for name, pose in (("start", start), ("goal", goal)):
        place = f"({pose[0]:.2f}, {pose[1]:.2f})"
        if np.any(pose[:2] < low) or np.any(pose[:2] >= high):
            raise InputError(f"{name}: {place} is off the map, which goes from {low.round(2)} to {high.round(2)}")
        if (free := clearance(where.footprint, pose, where.outlines)) <= where.margin:
            found = "is in an obstacle" if free <= 0 else f"is {free:.3f} m from an obstacle, within the margin"
            raise InputError(f"{name}: the robot {found} at {place}")
    ahead = around(where, goal)
    step = max(1.5 * where.field.resolution, radius * 2 * np.pi / HEADINGS)
    tree = Tree(np.empty((most, 3)), np.full(most, -1), *np.empty((3, most)))
    found, expanded = search.compiled(start, goal, float(radius), step, reverse, ahead, where, tree)
    if found < 0:
        why = "there is none" if found == -1 else f"{most:,} poses were not enough"
        raise InputError(f"goal: no way to ({goal[0]:.2f}, {goal[1]:.2f}) was found; {why}")
    return _traced(tree, int(found), radius, step, reverse, int(expanded))


def shortcut(where: Space, whole: Plan, radius: float, reverse: bool) -> Plan:
    """Replaces detours of a plan, which the arcs of the search leave, by shortest paths that are free.

    From each pose the path goes to the farthest one to which there is a cheaper one, of those every 0.25 m.

    Args:
        where: Obstacles and footprint, as the plan was made with.
        whole: The plan.
        radius: Least turning radius in m.
        reverse: Whether the robot may reverse.
    """
    sides, end = np.empty((len(where.footprint), 4)), np.empty(3)
    steps = np.hypot(*np.diff(whole.poses[:, :2], axis=0, prepend=whole.poses[:1, :2]).T) * whole.ways
    poses, ways, total, now, last = [whole.poses[:1]], [np.zeros(1)], 0.0, 0, 0.0
    while now < len(steps) - 1:
        cost, direction = np.zeros(len(steps)), last
        for k in range(now + 1, len(steps)):
            if steps[k] != 0:
                cost[k] = cost[k - 1] + price.compiled(steps[k], direction)
                direction = float(np.sign(steps[k]))
            else:
                cost[k] = cost[k - 1]
        for other in range(len(steps) - 1, now, -max(1, round(0.25 / CHECK))):
            found, _ = shot.compiled(whole.poses[now], whole.poses[other], radius, reverse, last, where, sides, end)
            if found < cost[other] - 1e-6:
                piece, direction = sample(
                    whole.poses[now], steer(whole.poses[now], whole.poses[other], radius, reverse), radius, CHECK
                )
                piece, direction, total = piece[1:], direction[1:], total + found
                break
        else:
            other = now + 1
            piece, direction, total = whole.poses[other : other + 1], whole.ways[other : other + 1], total + cost[other]
        poses.append(piece)
        ways.append(direction)
        now, last = other, float(direction[-1]) if len(direction) else last
    return Plan(np.concatenate(poses), np.concatenate(ways), float(total), whole.expanded, whole.searched)


def around(where: Space, goal: Array) -> Array:
    """Returns the length of the shortest way from each cell to the goal's around the obstacles in m, `(rows, columns)`.

    A cell is free where P keeps its distance from the nearest side of the footprint; the way goes over eight neighbours
    (Dijkstra 1959). It is infinite where there is none.
    """
    sides = np.roll(where.footprint, -1, axis=0) - where.footprint
    across = where.footprint[:, 0] * sides[:, 1] - where.footprint[:, 1] * sides[:, 0]
    inner = max(0.0, float((across / np.hypot(*sides.T)).min()))
    cell = where.field.resolution
    free = where.field.distance > inner + where.margin - cell / np.sqrt(2)
    column, row = ((goal[:2] - where.field.origin) / cell).astype(int)
    found = np.full(free.shape, np.inf)
    spread.compiled(free, int(row), int(column), cell, found)
    return found


@kernel
def spread(free: NDArray[np.bool], row: int, column: int, cell: float, found: Array) -> None:
    """Writes what `around` returns, from a row and a column; `found` is infinite at first."""
    rows, columns = free.shape
    found[row, column] = 0.0
    queue = [(0.0, row, column)]
    while len(queue) > 0:
        so_far, i, k = heapq.heappop(queue)
        if so_far > found[i, k]:
            continue
        for di in range(-1, 2):
            for dk in range(-1, 2):
                a, b = i + di, k + dk
                if not (0 <= a < rows and 0 <= b < columns) or not free[a, b]:
                    continue
                new = so_far + cell * np.sqrt(float(di * di + dk * dk))
                if new < found[a, b]:
                    found[a, b] = new
                    heapq.heappush(queue, (new, a, b))


@kernel
def is_free(pose: Array, where: Space, sides: Array) -> bool:
    """Tells whether a pose keeps the margin from all obstacles, by the discs, and where these touch, by the footprint.

    Args:
        pose: Pose in m, m, rad, `(3,)`.
        where: Obstacles and footprint.
        sides: Scratch, `(n, 4)`.
    """
    field = where.field
    c, s = np.cos(pose[2]), np.sin(pose[2])
    clear = True
    for k in range(len(where.discs)):
        ahead, aside, radius = where.discs[k]
        x, y = pose[0] + c * ahead - s * aside, pose[1] + s * ahead + c * aside
        # A field that is interpolated may be too large by half a cell at most.
        free = at(field, x, y)[0] - field.resolution / 2
        clear &= free > radius + where.margin
    if clear:
        return True
    return gap(where.footprint, pose, sides, where.outlines) > where.margin


@kernel
def cell_of(pose: Array, where: Space) -> tuple[int, int, int]:
    """Returns row, column and heading of the cell of a pose; the row is −1 off the map."""
    field = where.field
    rows, columns = field.distance.shape
    row, column = (pose[1] - field.origin[1]) / field.resolution, (pose[0] - field.origin[0]) / field.resolution
    if not (0.0 <= row < rows and 0.0 <= column < columns):
        return -1, 0, 0
    return int(row), int(column), int(np.floor(pose[2] * HEADINGS / (2 * np.pi) + 0.5)) % HEADINGS


@kernel
def drives(pose: Array, turn: float, radius: float, way: float, where: Space, sides: Array, end: Array) -> bool:
    """Drives along an arc, as `advance` does, and tells whether it is free; `end` is where it ends."""
    count = int(np.ceil(abs(way) / CHECK))
    for k in range(1, count + 1):
        advance(pose, turn, radius, way * k / count, end)
        if cell_of(end, where)[0] < 0 or not is_free(end, where, sides):
            return False
    return True


@kernel
def price(way: float, last: float) -> float:
    """Returns the cost of a way in m, negative in reverse, after one in the direction `last`, 0 at the start."""
    switch = SWITCH if way * last < 0 else 0.0
    return switch + (way if way >= 0 else -REVERSE * way)


@kernel
def shot(
    start: Array, goal: Array, radius: float, reverse: bool, last: float, where: Space, sides: Array, end: Array
) -> tuple[float, float]:
    """Tries the shortest path without obstacles from pose to pose.

    Args:
        start: Pose in m, m, rad, `(3,)`.
        goal: Pose in m, m, rad, `(3,)`.
        radius: Least turning radius in m.
        reverse: Whether the robot may reverse.
        last: Direction in which the robot came to the start: 1, −1, or 0 where it begins.
        where: Obstacles and footprint.
        sides: Scratch, `(n, 4)`.
        end: Out: where the path ends, or where it hits something, `(3,)`.

    Returns:
        Its cost in m, infinite if it hits something, and the direction of its end.
    """
    turns, lengths = np.zeros(PIECES), np.zeros(PIECES)
    shortest(start, goal, radius, reverse, turns, lengths)
    end[:] = start
    cost, direction = 0.0, last
    for k in range(PIECES):
        if lengths[k] == 0.0:
            continue
        cost += price(lengths[k], direction)
        direction = np.sign(lengths[k])
        if not drives(end.copy(), turns[k], radius, lengths[k], where, sides, end):
            return np.inf, direction
    return cost, direction


@kernel
def search(
    start: Array, goal: Array, radius: float, step: float, reverse: bool, ahead: Array, where: Space, tree: Tree
) -> tuple[int, int]:
    """Searches for a way.

    Args:
        start: Pose in m, m, rad, `(3,)`.
        goal: Pose in m, m, rad, `(3,)`.
        radius: Least turning radius in m.
        step: Length of an arc in m.
        reverse: Whether the robot may reverse.
        ahead: Way around the obstacles from each cell to the goal in m, `(rows, columns)`; zeros for no heuristic.
        where: Obstacles and footprint.
        tree: Out: the poses that the search made.

    Returns:
        Index of the goal's pose (−1: there is no way, −2: there are too few poses), and number of expanded poses.
    """
    most, n, cell = len(tree.poses), 1, where.field.resolution
    rows, columns = ahead.shape
    blind, gears = not ahead.any(), 3 if reverse else 1
    best = np.zeros((rows, columns, HEADINGS, gears), np.int32)  # pose in each cell and direction, plus one
    sides, end = np.empty((len(where.footprint), 4)), np.empty(3)
    turns, lengths = np.zeros(PIECES), np.zeros(PIECES)
    tree.poses[0], tree.parents[0], tree.turns[0], tree.ways[0], tree.costs[0] = start, -1, 0.0, 0.0, 0.0
    queue, expanded = [(0.0, 0)], 0
    while len(queue) > 0:
        _, now = heapq.heappop(queue)
        if tree.turns[now] == SHOT:
            return now, expanded
        pose, last = tree.poses[now], np.sign(tree.ways[now])
        row, column, heading = cell_of(pose, where)
        if now > 0 and best[row, column, heading, int(last + 1) % gears] != now + 1:
            continue  # a cheaper pose has taken the cell
        expanded += 1
        if n + 7 > most:
            return -2, expanded
        # A path that is shorter than the way around the obstacles hits one.
        if shortest(pose, goal, radius, reverse, turns, lengths) >= STRAIGHT * ahead[row, column] - cell:
            cost, direction = shot(pose, goal, radius, reverse, last, where, sides, end)
            if cost < np.inf:
                tree.poses[n], tree.parents[n], tree.turns[n], tree.ways[n] = goal, now, SHOT, direction
                tree.costs[n] = tree.costs[now] + cost
                heapq.heappush(queue, (tree.costs[n], n))
                n += 1
        for choice in range(6 if reverse else 3):
            turn, way = float(choice % 3 - 1), step if choice < 3 else -step
            if not drives(pose, turn, radius, way, where, sides, end):
                continue
            row, column, heading = cell_of(end, where)
            gear = int(np.sign(way) + 1) % gears
            cost = tree.costs[now] + price(way, last)
            rival = best[row, column, heading, gear]
            if ahead[row, column] == np.inf or (rival and tree.costs[rival - 1] <= cost):
                continue
            estimate = 0.0
            if not blind:
                estimate = max(
                    STRAIGHT * ahead[row, column] - cell, shortest(end, goal, radius, reverse, turns, lengths)
                )
            tree.poses[n], tree.parents[n], tree.turns[n], tree.ways[n], tree.costs[n] = end, now, turn, way, cost
            best[row, column, heading, gear] = n + 1
            heapq.heappush(queue, (cost + estimate, n))
            n += 1
    return -1, expanded


def _traced(tree: Tree, last: int, radius: float, step: float, reverse: bool, expanded: int) -> Plan:
    """Returns the plan that ends at a pose of the tree; its last arc is a shortest path."""
    chain = [last]
    while tree.parents[chain[-1]] >= 0:
        chain.append(int(tree.parents[chain[-1]]))
    now = tree.poses[chain[-1]]
    poses, ways = [now[None]], [np.zeros(1)]
    for index in chain[-2::-1]:
        if tree.turns[index] == SHOT:
            curve = steer(now, tree.poses[index], radius, reverse)
        else:
            curve = Curve(np.zeros(PIECES), np.zeros(PIECES))
            curve.turns[0], curve.lengths[0] = tree.turns[index], tree.ways[index]
        piece, directions = sample(now, curve, radius, CHECK)
        poses.append(piece[1:])
        ways.append(directions[1:])
        now = piece[-1]
    made = np.flatnonzero(tree.parents >= 0)
    arcs = made[tree.turns[made] != SHOT]
    searched = np.stack([tree.poses[tree.parents[arcs], :2], tree.poses[arcs, :2]], axis=1)
    return Plan(np.concatenate(poses), np.concatenate(ways), float(tree.costs[last]), expanded, searched)
