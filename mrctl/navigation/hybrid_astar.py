"""Path-finding: hybrid A* on cells of place and heading, with arcs that the robot can drive.

Dolgov, Thrun, Montemerlo and Diebel, "Path planning for autonomous vehicles in unknown semi-structured environments",
IJRR 29(5), 2010. Each cell holds the best pose that was found in it, and six arcs (three without reversing) lead on
from there. From a pose the search also tries the shortest path to the goal that ignores obstacles, as one more arc (the
analytic expansion). If an obstacle blocks it after d metres, the poses that follow try again once they are d/2 further;
those that were skipped are tried when no pose is left. The heuristic is the larger of that path's length and of the way
around the obstacles on the plane, times `HEURISTIC_WEIGHT` (Pohl, "Heuristic search viewed as path finding in a graph",
Artificial Intelligence 1, 1970). The budget is a number of poses; ties go to the earlier pose.
"""

from __future__ import annotations

import contextlib
import heapq
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mrctl.kernel import Array, kernel
from mrctl.navigation.plan import Plan
from mrctl.navigation.steer import CHECK_SPACING, MAX_PIECES, SWITCH_COST, Curve, advance, sample, shortest, steer
from mrctl.record import InputError
from mrctl.theory.clearance import clearance, cover, gap, point_to_polygon
from mrctl.theory.grid import Field, near_field, value
from mrctl.theory.obstacles import Outlines

HEADINGS = 72
REVERSE_COST = 1.5  # cost of a metre in reverse
SHORTCUT_STRIDE = 5  # of these poses, between those to which shortcuts are looked for
FOOTPRINT_DISCS = 4  # that cover the footprint; where one of them touches, the footprint itself is looked at
SHORTEST_PATH = 2.0  # in place of the turn of an arc, a shortest path to the goal
HEURISTIC_WEIGHT = 1.04  # of the heuristic, and so about the most by which a plan costs more than the cheapest; chosen
# share of the free part of a shortest path that hits something, after which another one is tried; chosen
RETRY_SHARE = 0.5
HEURISTIC_SLACK = 2.0  # cells, by which the way around the obstacles may be too long
NEAR_WAY = 0.9  # share of that way below which shortcuts are not tried; in narrow bends the way is 4 % too long
LONGEST_SKIP = 1.0  # m, about the longest part of an arc in the open on which no pose is looked at; chosen
MAX_CELLS = 1_000_000  # of the plane, for a search takes 288 bytes for each, and three times that with reversing


class NoWay(InputError):
    """The search has found no way to the goal.

    Attributes:
        at_border: Whether it came to the border of the area in which P may be, so that there may be a way beyond it.
    """

    def __init__(self, message: str, at_border: bool = True) -> None:
        """Takes the message, and the attribute."""
        super().__init__(message)
        self.at_border = at_border


class Space(NamedTuple):
    """Free space in which a robot plans."""

    outlines: Outlines
    """The obstacles."""
    field: Field
    """Their distance field, whose cells are those of the search."""
    footprint: Array
    """Corners of the robot in its frame in m, counter-clockwise, `(n, 2)`."""
    discs: Array
    """Discs that cover the footprint, `(k, 3)`."""
    depths: Array
    """Distance of each disc's centre from the nearest side of the footprint in m, `(k,)`."""
    reach: float
    """Distance of the farthest corner from P in m."""
    margin: float
    """Clearance that a plan keeps in m."""

    @property
    def area(self) -> tuple[Array, Array]:
        """Lower left and upper right corner of the rectangle in which P may be, in m, `(2,)` each."""
        low, cells = self.field.origin, np.array(self.field.distance.shape)[::-1]
        return low, low + self.field.resolution * cells


class Tree(NamedTuple):
    """The poses that a search makes, at most N."""

    poses: Array
    """Poses in m, m, rad, `(N, 3)`."""
    parents: NDArray[np.int64]
    """Pose before each, −1 for the start, `(N,)`."""
    turns: Array
    """Turn of the arc that leads to each, as in `Curve`, or `SHORTEST_PATH` for a shortest path to the goal, `(N,)`."""
    lengths: Array
    """Signed length of that arc in m; of a shortest path the direction of its end, `(N,)`."""
    costs: Array
    """Cost of the way to each in m, `(N,)`."""
    direct: Array
    """Length of the shortest path from each to the goal without obstacles in m, `(N,)`."""
    again: Array
    """Least cost in m at which that path is tried, `(N,)`."""


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
    if cells > MAX_CELLS:
        raise InputError(f"map: {cells:,.0f} cells of {cell:.3g} m are more than {MAX_CELLS:,}, which a search takes")
    discs, sides = cover(footprint, FOOTPRINT_DISCS), np.hstack([footprint, np.roll(footprint, -1, axis=0)])
    depths = np.array([-point_to_polygon.compiled(x, y, sides) for x, y, _ in discs])
    reach = float(np.hypot(*footprint.T).max())
    far = reach + margin + 2 * cell + LONGEST_SKIP  # beyond which nothing asks how far an obstacle is
    return Space(outlines, near_field(outlines, low, high, cell, far), footprint, discs, depths, reach, margin)


def wider(where: Space, goal: Array, room: float) -> Space:
    """Returns a space that extends the area, and the box around all obstacles, on each side.

    Args:
        where: The space.
        goal: x and y in m and θ in rad, `(3,)`.
        room: By how much it extends them, besides the reach of the robot, in m.

    Raises:
        NoWay: The robot cannot leave the area from the goal, or the wider one has too many cells.
    """
    (inner_low, inner_high), outlines, cell = where.area, where.outlines, where.field.resolution
    around = outlines.bounds if len(outlines.discs) or len(outlines.edges) else ()
    corners = np.array([inner_low, inner_high, *around])
    low, high = corners.min(axis=0) - room - where.reach, corners.max(axis=0) + room + where.reach
    with contextlib.suppress(InputError):
        wide = space(outlines, where.footprint, low, high, cell, where.margin)
        rows, columns = np.nonzero(np.isfinite(cost_to_go(wide, goal)))
        reached = low + cell * np.column_stack([columns, rows])
        if np.any((reached < inner_low - cell) | (reached > inner_high)):
            return wide
    raise NoWay(f"goal: there is no way to ({goal[0]:.2f}, {goal[1]:.2f}) with a margin of {where.margin:g} m")


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
        InputError: The start or the goal is not three finite numbers, or in an obstacle or off the map.
        NoWay: No way was found.
    """
    start, goal = np.asarray(start, float), np.asarray(goal, float)
    for name, pose in (("start", start), ("goal", goal)):
        if pose.shape != (3,) or not np.isfinite(pose).all():
            raise InputError(f"{name}: must be three finite numbers, not {tuple(pose.tolist())}")
        place = f"({pose[0]:.2f}, {pose[1]:.2f})"
        if cell_of.compiled(pose, where)[0] < 0:
            low, high = where.area
            raise InputError(f"{name}: {place} is off the map, which goes from {low.round(2)} to {high.round(2)}")
        if (free := clearance(where.footprint, pose, where.outlines)) <= where.margin:
            near = f"is {free:.3f} m from an obstacle, within the margin of {where.margin:g} m"
            raise InputError(f"{name}: the robot {'is in an obstacle' if free <= 0 else near} at {place}")
    ahead = cost_to_go(where, goal)
    step = max(1.5 * where.field.resolution, radius * 2 * np.pi / HEADINGS)
    tree = Tree(np.empty((most, 3)), np.empty(most, np.int64), *np.empty((5, most)))
    best = np.zeros((*ahead.shape, HEADINGS, 3 if reverse else 1), np.int32)  # here memory is taken when it is written
    found, made, expanded, left = search.compiled(start, goal, float(radius), step, reverse, ahead, where, best, tree)
    if found < 0:
        place = f"({goal[0]:.2f}, {goal[1]:.2f})"
        kept = f" with a margin of {where.margin:g} m"
        few = f"no way to {place}{kept} was found with {most:,} poses"
        # Where the way around the obstacles does not lead to the start, the search has not begun.
        at_border = bool(left) or not np.isfinite(ahead[cell_of.compiled(start, where)[:2]])
        raise NoWay(f"goal: {f'there is no way to {place}{kept}' if found == -1 else few}", at_border)
    return _traced(tree, int(made), int(found), radius, reverse, int(expanded))


def shortcut(where: Space, whole: Plan, radius: float, reverse: bool) -> Plan:
    """Replaces detours of a plan, which the arcs of the search leave, by shortest paths that are free.

    From each pose the path goes to the farthest one to which there is a cheaper one, of those every 0.25 m. The result
    is shortened once more, from its own poses. A path that is shorter than the way around the obstacles hits one; to
    look where would take by far the most time of a long plan.

    Args:
        where: Obstacles and footprint, as the plan was made with.
        whole: The plan.
        radius: Least turning radius in m.
        reverse: Whether the robot may reverse.
    """
    ahead = cost_to_go(where, whole.poses[-1])
    for _ in range(2):
        whole = _shortcut(where, whole, ahead, radius, reverse)
    return whole


def _shortcut(where: Space, whole: Plan, ahead: Array, radius: float, reverse: bool) -> Plan:
    """Does what `shortcut` describes, once; `ahead` is what `cost_to_go` returns."""
    steps = np.hypot(*np.diff(whole.poses[:, :2], axis=0, prepend=whole.poses[:1, :2]).T) * whole.directions
    poses, directions, total, now, last = [whole.poses[:1]], [np.zeros(1)], 0.0, 0, 0.0
    cost = np.empty(len(steps))
    while now < len(steps) - 1:
        other, found = farthest.compiled(whole.poses, steps, now, radius, reverse, last, where, ahead, cost)
        if other > now:
            curve = steer(whole.poses[now], whole.poses[other], radius, reverse)
            piece, direction = (column[1:] for column in sample(whole.poses[now], curve, radius, CHECK_SPACING))
        else:
            other, found = now + 1, cost[now + 1]
            piece, direction = whole.poses[other : other + 1], whole.directions[other : other + 1]
        poses.append(piece)
        directions.append(direction)
        now, last, total = other, float(direction[-1]) if len(direction) else last, total + found
    return Plan(np.concatenate(poses), np.concatenate(directions), float(total), whole.expanded, whole.searched)


@kernel
def farthest(
    poses: Array, steps: Array, now: int, radius: float, reverse: bool, last: float, where: Space, ahead: Array,
    cost: Array,
) -> tuple[int, float]:  # fmt: skip
    """Looks for the farthest pose of a plan to which a shortest path is free and cheaper than the plan.

    Args:
        poses: Poses of the plan in m, m, rad, `(n, 3)`.
        steps: Signed distance of each from the one before in m, `(n,)`.
        now: Index of the pose where the path begins.
        radius: Least turning radius in m.
        reverse: Whether the robot may reverse.
        last: Direction in which the robot came to that pose, as in `analytic_expansion`.
        where: Obstacles and footprint.
        ahead: Way around the obstacles from each cell to the last pose in m, `(rows, columns)`.
        cost: Out: cost of the plan from that pose to each later one in m, `(n,)`.

    Returns:
        Its index and the cost of the path in m; the index `now` if there is none.
    """
    n, direction = len(poses), last
    cost[now] = 0.0
    for k in range(now + 1, n):
        cost[k] = cost[k - 1]
        if steps[k] != 0:
            cost[k] += cost_of(steps[k], direction)
            direction = np.sign(steps[k])
    sides, end = np.empty((len(where.footprint), 4)), np.empty(3)
    row, column, _ = cell_of(poses[now], where)
    for k in range(n - 1, now, -SHORTCUT_STRIDE):
        i, j, _ = cell_of(poses[k], where)
        least = NEAR_WAY * abs(ahead[row, column] - ahead[i, j]) - HEURISTIC_SLACK * where.field.resolution
        after = steps[k + 1] if k + 1 < n else 0.0  # the plan goes on with its first step after the path
        most = cost[k + 1] - cost_of(after, 0.0) if k + 1 < n else cost[k]
        found, direction, _ = analytic_expansion(
            poses[now], poses[k], radius, reverse, last, least, most - 1e-6, where, sides, end
        )
        if found + cost_of(after, direction) - cost_of(after, 0.0) < most - 1e-6:
            return k, found
    return now, 0.0


def cost_to_go(where: Space, goal: Array) -> Array:
    """Returns the length of the shortest way from each cell to the goal's around the obstacles in m, `(rows, columns)`.

    A cell is blocked where, with P anywhere in it, an obstacle is nearer to P than the nearest side of the footprint
    and the margin together, so that no heading is free. The length solves the eikonal equation |∇T| = 1 on the cells to
    first order (Sethian, "A fast marching level set method for monotonically advancing fronts", PNAS 93(4), 1996): in
    the open it is at most 1.7 cells too long 200 cells away. It is infinite where there is no way.
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
    """Writes what `cost_to_go` returns, from a row and a column; `found` is infinite at first.

    The front advances in bands that are a cell wide (Kim, "An O(N) level set method for eikonal equations", SIAM J.
    Scientific Computing 22(6), 2001); the cells of a band are looked at again until none changes.
    """
    rows, columns = free.shape
    found[row, column] = 0.0
    band, beyond, limit = [row * columns + column], [0 for _ in range(0)], 0.0
    while len(band) > 0:
        limit, done = limit + cell, 0
        while done < len(band):
            i, k = divmod(band[done], columns)
            done += 1
            for a, b in ((i - 1, k), (i + 1, k), (i, k - 1), (i, k + 1)):
                if not (0 <= a < rows and 0 <= b < columns) or not free[a, b]:
                    continue
                p = min(found[max(a - 1, 0), b], found[min(a + 1, rows - 1), b])
                q = min(found[a, max(b - 1, 0)], found[a, min(b + 1, columns - 1)])
                new = min(p, q) + cell
                if abs(p - q) < cell:
                    new = (p + q + np.sqrt(2 * cell * cell - (p - q) * (p - q))) / 2
                if new < found[a, b] - 1e-9 * cell:
                    found[a, b] = new
                    (band if new < limit else beyond).append(a * columns + b)
        band = [place for place in beyond if found[place // columns, place % columns] < limit + cell]
        beyond = [place for place in beyond if found[place // columns, place % columns] >= limit + cell]


@kernel
def is_free(pose: Array, where: Space, sides: Array) -> bool:
    """Tells whether a pose keeps the margin from all obstacles, by the discs, and where these leave it open, by `gap`.

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
        distance = value(field.distance, field.origin[0], field.origin[1], field.resolution, x, y)
        # On the map a field that is interpolated is off by at most 1/√2 cells. It is too large by more than half a cell
        # amid four centres alone, where the margin may be a fifth of a cell less.
        known = on_map(x, y, field)
        clear &= known and distance - field.resolution / 2 > radius + where.margin
        if known and distance + field.resolution / np.sqrt(2) < where.depths[k] + where.margin:
            return False
    if clear:
        return True
    return gap(where.footprint, pose, sides, where.outlines) > where.margin


@kernel
def on_map(x: float, y: float, field: Field) -> bool:
    """Tells whether a place, x and y in m, is in one of the cells of a field."""
    rows, columns = field.distance.shape
    row, column = (y - field.origin[1]) / field.resolution, (x - field.origin[0]) / field.resolution
    return 0.0 <= row < rows and 0.0 <= column < columns


@kernel
def cell_of(pose: Array, where: Space) -> tuple[int, int, int]:
    """Returns row, column and heading of the cell of a pose; the row is −1 off the map."""
    field = where.field
    if not on_map(pose[0], pose[1], field):
        return -1, 0, 0
    row, column = (pose[1] - field.origin[1]) / field.resolution, (pose[0] - field.origin[0]) / field.resolution
    return int(row), int(column), int(np.floor(pose[2] * HEADINGS / (2 * np.pi) + 0.5)) % HEADINGS


@kernel
def free_length(pose: Array, turn: float, radius: float, way: float, where: Space, sides: Array, end: Array) -> float:
    """Drives along an arc, as `advance` does, and returns how far it is free in m, |way| where it is to its end.

    Poses are looked at every `CHECK_SPACING`, but for those that are so near one before that P has not left a circle
    about it in which the robot is free.

    Args:
        pose: Pose at its start in m, m, rad, `(3,)`.
        turn: As for `advance`, like the next two.
        radius: Turning radius in m.
        way: Signed length in m.
        where: Obstacles and footprint.
        sides: Scratch, `(n, 4)`.
        end: Out: the last pose that was looked at, `(3,)`.
    """
    field, count, k = where.field, int(np.ceil(abs(way) / CHECK_SPACING)), 0
    rows, columns = field.distance.shape
    while k < count:
        k += 1
        advance(pose, turn, radius, way * k / count, end)
        if cell_of(end, where)[0] < 0:
            return abs(way) * (k - 1) / count
        free = value(field.distance, field.origin[0], field.origin[1], field.resolution, end[0], end[1])
        free -= field.resolution / 2 + where.reach + where.margin
        if free <= 0.0:
            if not is_free(end, where, sides):
                return abs(way) * (k - 1) / count
            continue
        x, y = end[0] - field.origin[0], end[1] - field.origin[1]
        free = min(free, x, y, columns * field.resolution - x, rows * field.resolution - y)
        k = max(k, min(k + int(free / CHECK_SPACING), count - 1))
    return abs(way)


@kernel
def copy_pose(source: Array, target: Array) -> None:
    """Copies a pose, `(3,)`."""
    for k in range(3):
        target[k] = source[k]


@kernel
def cost_of(way: float, last: float) -> float:
    """Returns the cost of a way in m, negative in reverse, after one in the direction `last`, 0 at the start."""
    switch = SWITCH_COST if way * last < 0 else 0.0
    return switch + (way if way >= 0 else -REVERSE_COST * way)


@kernel
def analytic_expansion(
    start: Array, goal: Array, radius: float, reverse: bool, last: float, least: float, most: float, where: Space,
    sides: Array, end: Array,
) -> tuple[float, float, float]:  # fmt: skip
    """Tries the shortest path without obstacles from pose to pose.

    Args:
        start: Pose in m, m, rad, `(3,)`.
        goal: Pose in m, m, rad, `(3,)`.
        radius: Least turning radius in m.
        reverse: Whether the robot may reverse.
        last: Direction in which the robot came to the start: 1, −1, or 0 where it begins.
        least: Length in m of the way around the obstacles: a shorter path hits one.
        most: Cost in m that it has to be below.
        where: Obstacles and footprint.
        sides: Scratch, `(n, 4)`.
        end: Scratch, `(3,)`.

    Returns:
        Its cost in m, infinite if it hits something or costs too much, the direction of its end, and how far it is free
        in m.
    """
    turns, lengths = np.zeros(MAX_PIECES), np.zeros(MAX_PIECES)
    shortest(start, goal, radius, reverse, turns, lengths)
    cost, direction, free, whole = 0.0, last, 0.0, 0.0
    for length in lengths:
        if length != 0.0:
            cost += cost_of(length, direction)
            direction, whole = np.sign(length), whole + abs(length)
    if cost >= most or whole < least:
        return np.inf, direction, free
    now = start.copy()
    for k in range(MAX_PIECES):
        if lengths[k] == 0.0:
            continue
        driven = free_length(now, turns[k], radius, lengths[k], where, sides, end)
        free += driven
        if driven < abs(lengths[k]):
            return np.inf, direction, free
        copy_pose(end, now)
    return cost, direction, free


@kernel
def room_before(goal: Array, radius: float, where: Space, sides: Array, end: Array, room: Array) -> None:
    """Writes how long the last piece of a path to the goal may be, by direction and turn, before it hits something.

    Args:
        goal: Pose in m, m, rad, `(3,)`.
        radius: Turning radius in m.
        where: Obstacles and footprint.
        sides: Scratch, `(n, 4)`.
        end: Scratch, `(3,)`.
        room: Out: length in m, in reverse and forward, to the right, straight and to the left, `(2, 3)`.
    """
    rows, columns = where.field.distance.shape
    longest = max(2 * np.pi * radius, np.hypot(rows, columns) * where.field.resolution)
    for direction in range(2):
        for turn in range(3):
            way = -longest if direction == 1 else longest  # from the goal back
            room[direction, turn] = free_length(goal, turn - 1.0, radius, way, where, sides, end)


@kernel
def search(
    start: Array, goal: Array, radius: float, step: float, reverse: bool, ahead: Array, where: Space,
    best: NDArray[np.int32], tree: Tree,
) -> tuple[int, int, int, bool]:  # fmt: skip
    """Searches for a way.

    Args:
        start: Pose in m, m, rad, `(3,)`.
        goal: Pose in m, m, rad, `(3,)`.
        radius: Least turning radius in m.
        step: Length of an arc in m.
        reverse: Whether the robot may reverse.
        ahead: Way around the obstacles from each cell to the goal in m, `(rows, columns)`; zeros for no heuristic.
        where: Obstacles and footprint.
        best: Out: pose in each cell and direction, plus one, `(rows, columns, HEADINGS, 1)`, or 3 directions where the
            robot may reverse; zeros at first.
        tree: Out: the poses that the search made.

    Returns:
        Index of the goal's pose (−1: there is no way, −2: there are too few poses), numbers of poses that were made and
        expanded, and whether an arc led out of the area.
    """
    most, n, cell = len(tree.poses), 1, where.field.resolution
    weight, gears = HEURISTIC_WEIGHT if ahead.any() else 0.0, best.shape[3]
    sides, end = np.empty((len(where.footprint), 4)), np.empty(3)
    turns, lengths = np.zeros(MAX_PIECES), np.zeros(MAX_PIECES)
    copy_pose(start, tree.poses[0])
    tree.parents[0], tree.turns[0], tree.lengths[0], tree.costs[0] = -1, 0.0, 0.0, 0.0
    tree.direct[0], tree.again[0] = shortest(start, goal, radius, reverse, turns, lengths), 0.0
    checks = int(np.ceil(step / CHECK_SPACING))  # of an arc, as `free_length` makes them, to the last bit of its end
    queue, late, expanded, left = [(0.0, 0)], [0 for _ in range(0)], 0, False
    room = np.full((2, 3), -1.0)
    while len(queue) + len(late) > 0:
        delayed = len(queue) == 0  # there is no way but by a shortest path that was not tried
        now = late.pop() if delayed else heapq.heappop(queue)[1]
        if tree.turns[now] == SHORTEST_PATH:
            return now, n, expanded, left
        pose, last = tree.poses[now], np.sign(tree.lengths[now])
        if delayed:  # most of these paths hit something near the goal
            if room[0, 0] < 0:
                room_before(goal, radius, where, sides, end, room)
            shortest(pose, goal, radius, reverse, turns, lengths)
            k = int(np.flatnonzero(lengths)[-1]) if lengths.any() else 0
            if abs(lengths[k]) > room[int(lengths[k] > 0), int(turns[k]) + 1] + CHECK_SPACING:
                continue
        row, column, heading = cell_of(pose, where)
        if now > 0 and best[row, column, heading, int(last + 1) % gears] != now + 1:
            continue  # a cheaper pose has taken the cell
        expanded += not delayed
        if n + 7 > most:
            return -2, n, expanded, left
        # A path that is shorter than the way around the obstacles hits one.
        if tree.direct[now] >= ahead[row, column] - HEURISTIC_SLACK * cell:
            if not delayed and tree.costs[now] < tree.again[now]:
                late.append(now)
            else:
                cost, direction, free = analytic_expansion(
                    pose, goal, radius, reverse, last, 0.0, np.inf, where, sides, end
                )
                tree.again[now] = tree.costs[now] + RETRY_SHARE * free
                if cost < np.inf:
                    copy_pose(goal, tree.poses[n])
                    tree.parents[n], tree.turns[n], tree.lengths[n] = now, SHORTEST_PATH, direction
                    tree.costs[n] = tree.costs[now] + cost
                    heapq.heappush(queue, (tree.costs[n], n))
                    n += 1
        if delayed:
            continue
        for choice in range(6 if reverse else 3):
            turn, way = float(choice % 3 - 1), step if choice < 3 else -step
            advance(pose, turn, radius, way * checks / checks, end)
            row, column, heading = cell_of(end, where)
            gear = int(np.sign(way) + 1) % gears
            cost = tree.costs[now] + cost_of(way, last)
            left |= row < 0
            rival = best[row, column, heading, gear]
            if row < 0 or ahead[row, column] == np.inf or (rival and tree.costs[rival - 1] <= cost):
                continue
            if free_length(pose, turn, radius, way, where, sides, end) < step:  # which takes most of the time
                continue
            tree.direct[n] = shortest(end, goal, radius, reverse, turns, lengths)
            estimate = weight * max(ahead[row, column] - HEURISTIC_SLACK * cell, tree.direct[n])
            copy_pose(end, tree.poses[n])
            tree.parents[n], tree.turns[n], tree.lengths[n], tree.costs[n] = now, turn, way, cost
            tree.again[n], best[row, column, heading, gear] = tree.again[now], n + 1
            heapq.heappush(queue, (cost + estimate, n))
            n += 1
    return -1, n, expanded, left


def _traced(tree: Tree, count: int, last: int, radius: float, reverse: bool, expanded: int) -> Plan:
    """Returns the plan that ends at a pose of a tree of `count` poses; its last arc is a shortest path."""
    chain = [last]
    while tree.parents[chain[-1]] >= 0:
        chain.append(int(tree.parents[chain[-1]]))
    arcs = np.array(chain[-2:0:-1], int)
    final = steer(tree.poses[tree.parents[last]], tree.poses[last], radius, reverse)
    curve = Curve(np.append(tree.turns[arcs], final.turns), np.append(tree.lengths[arcs], final.lengths))
    poses, directions = sample(tree.poses[0], curve, radius, CHECK_SPACING)
    made = np.flatnonzero((tree.parents[:count] >= 0) & (tree.turns[:count] != SHORTEST_PATH))
    searched = np.stack([tree.poses[tree.parents[made], :2], tree.poses[made, :2]], axis=1)
    return Plan(poses, directions, float(tree.costs[last]), expanded, searched)
