"""Worlds with a start and a goal, made by rule from a seed; the same arguments give the same world."""

from __future__ import annotations

from collections.abc import Sequence
from numbers import Integral, Real

import numpy as np
from numpy.typing import NDArray

from mrctl.kernel import Array
from mrctl.record import InputError, Record
from mrctl.theory.obstacles import Box, Disc, Known, Obstacle, Obstacles, Polygon, Pose
from mrctl.theory.spline import Plane

WALL_THICKNESS = 0.1  # m, thickness of walls


class Task(Record):
    """A world, and where a robot has to go in it."""

    obstacles: Obstacles
    """Obstacles of the world."""
    map: Known | None = None
    """Obstacles on the map of the robot; by default those that stand still."""
    start: Pose
    """Pose at the start: x and y in m, θ in rad."""
    goal: Pose
    """Pose at which the robot has to arrive: x and y in m, θ in rad."""

    @property
    def known(self) -> Obstacles:
        """Obstacles on the map."""
        return self.obstacles.still if self.map is None else self.map


def cellular(seed: int, fill: float = 0.2, steps: int = 3, cell: float = 0.15, cells: int = 30) -> Task:
    """Makes a field of cylinders with a cellular automaton, as BARN does, between two walls along y.

    Each cell is filled at random. In each step a cell is filled if at least 5 of its 8 neighbours are, and emptied if
    at most 1 is (Perille, Truong, Xiao and Stone, "Benchmarking metric ground navigation", IEEE SSRR 2020). Each filled
    cell with a free neighbour is a cylinder as wide as the cell. Nothing ensures that there is a way through.

    Args:
        seed: Seed of the field.
        fill: Share of the cells that are filled at first, between 0 and 1.
        steps: Number of steps.
        cell: Side of a cell in m.
        cells: Number of cells along each side of the field.

    Raises:
        InputError: The share is out of range, a size is not positive, or the seed or a number is not whole.
    """
    _positive(cell=cell)
    _whole(0, seed=seed, steps=steps)
    _whole(1, cells=cells)
    if not (isinstance(fill, Real) and 0 <= fill <= 1):
        raise InputError(f"fill: must be between 0 and 1, not {fill!r}")
    filled = np.random.default_rng(seed).random((cells, cells)) < fill
    for _ in range(steps):
        neighbours = _neighbours(filled)
        filled = (filled | (neighbours >= 5)) & (neighbours > 1)
    filled &= _neighbours(filled) < 8  # drops cells that are surrounded on all sides
    half = cells * cell / 2
    rows, columns = np.nonzero(filled)
    at = (np.column_stack([columns, rows]) + 0.5) * cell - half
    discs = [Disc(x=x, y=y, radius=cell / 2) for x, y in at.tolist()]
    ahead = half + 8 * cell  # free space before and behind the field
    walls = [
        Box(x=side * (half + WALL_THICKNESS / 2), length=WALL_THICKNESS, width=2 * ahead + 8 * cell) for side in (-1, 1)
    ]
    return _task([*discs, *walls], (0.0, -ahead, np.pi / 2), (0.0, ahead, np.pi / 2))


def _neighbours(filled: NDArray[np.bool]) -> NDArray[np.int64]:
    """Counts the filled cells among the 8 neighbours of each cell; beyond the border there are none."""
    padded = np.pad(filled.astype(int), 1)
    rows, columns = filled.shape
    return sum(padded[1 + i : 1 + i + rows, 1 + k : 1 + k + columns] for i in (-1, 0, 1) for k in (-1, 0, 1)) - filled


def corridor(width: float, seed: int = 0, pieces: int = 4, length: float = 3.0, turn: float = np.pi / 4) -> Task:
    """Makes a corridor of a width that bends at random.

    Args:
        width: Width between its walls in m.
        seed: Seed of the bends.
        pieces: Number of straight pieces.
        length: Length of the middle line of a piece in m.
        turn: Largest bend between two pieces in rad, below π/2.

    Raises:
        InputError: A wall would fold over itself, a size is not positive, or the seed or the number is not whole.
    """
    _positive(width=width, length=length)
    _whole(0, seed=seed)
    _whole(1, pieces=pieces)
    if not (isinstance(turn, Real) and 0 <= turn < np.pi / 2):
        raise InputError(f"turn: must be between 0 and π/2 rad, not {turn!r}")
    if (width / 2 + WALL_THICKNESS) * np.tan(turn / 2) >= length / 2:
        raise InputError(f"turn: pieces of {length:g} m that are {width:g} m wide cannot bend by {turn:g} rad")
    headings, middle, mitre = bent_line(seed, pieces, length, turn)
    walls = []
    for side in (-1, 1):
        near, far = (middle + side * offset * mitre for offset in (width / 2, width / 2 + WALL_THICKNESS))
        for k in range(pieces):
            corners = [complex(corner) for corner in (near[k], near[k + 1], far[k + 1], far[k])]
            walls.append(Polygon(points=tuple((corner.real, corner.imag) for corner in corners)))
    inward = min(0.5, length / 4)
    first, last = middle[0] + inward, middle[-1] - inward * np.exp(1j * headings[-1])
    return _task(walls, (first.real, first.imag, 0.0), (last.real, last.imag, headings[-1]))


def bent_line(seed: int, pieces: int, length: float, turn: float) -> tuple[Array, Plane, Plane]:
    """Returns the middle line of a corridor; the arguments are those of `corridor`.

    Returns:
        Heading of each piece in rad, `(pieces,)`; and as x + i y the ends of the pieces in m and what has to be added
        to them for each metre to the left, along the bisectors of the bends, `(pieces + 1,)` each.
    """
    bends = np.random.default_rng(seed).uniform(-turn, turn, pieces - 1)
    headings = np.clip(np.concatenate([[0.0], np.cumsum(bends)]), -np.pi / 2, np.pi / 2)  # it never comes back
    half = np.concatenate([[0.0], np.diff(headings) / 2, [0.0]])
    middle = np.concatenate([[0], np.cumsum(length * np.exp(1j * headings))])
    # At a bend the walls meet on the bisector, farther from the middle line by 1/cos of half the bend.
    return headings, middle, 1j * np.exp(1j * (np.append(headings, headings[-1]) - half)) / np.cos(half)


def corridor_width(
    footprint: Array, poses: Array, seed: int, pieces: int, length: float, turn: float, aside: float = 0.0
) -> float:
    """Returns the width in m of the narrowest corridor in which a robot touches no wall.

    A wall at the offset h from the middle line is touched where a corner of the robot, or one of its sides at the
    bisector of a bend, is at the offset h from the piece of the line beside it.

    Args:
        footprint: Corners of the robot in its frame in m, counter-clockwise, `(n, 2)`.
        poses: x and y in m and θ in rad, `(T, 3)`.
        seed: Seed, pieces, length and turn are those of `corridor`.
        pieces: See there.
        length: See there.
        turn: See there.
        aside: Offset in m of the middle of the corridor from the middle line of its map, to the left.
    """
    headings, middle, mitre = bent_line(seed, pieces, length, turn)
    corners = (poses[:, 0] + 1j * poses[:, 1])[:, None] + np.exp(1j * poses[:, 2:]) * (footprint @ [1, 1j])
    following = np.roll(corners, -1, axis=1)
    points = [corners]
    for bend, left in zip(middle[1:-1], mitre[1:-1], strict=True):
        here, there = (((p - bend) * left.conjugate()).imag for p in (corners, following))  # below 0 ahead of the bend
        crosses = here * there < 0
        points.append(
            np.where(crosses, corners + (following - corners) * here / np.where(crosses, here - there, 1), corners)
        )
    every = np.concatenate(points, axis=1)
    passed = [
        ((every - bend) * left.conjugate()).imag < 0 for bend, left in zip(middle[1:-1], mitre[1:-1], strict=True)
    ]
    piece = np.sum(passed, axis=0, initial=0).astype(int)
    return 2 * float(np.abs(((every - middle[piece]) * np.exp(-1j * headings[piece])).imag - aside).max())


def slalom(gap: float, seed: int = 0, gates: int = 5, spacing: float = 2.0, radius: float = 0.15) -> Task:
    """Makes a row of pairs of cylinders along x, whose gaps are shifted to either side in turn.

    Args:
        gap: Free width between the two cylinders of a pair in m.
        seed: Seed of the shifts.
        gates: Number of pairs.
        spacing: Distance of two pairs in m.
        radius: Radius of a cylinder in m.

    Raises:
        InputError: A size is not positive, or the seed or the number is not whole.
    """
    _positive(gap=gap, spacing=spacing, radius=radius)
    _whole(0, seed=seed)
    _whole(1, gates=gates)
    shifts = np.random.default_rng(seed).uniform(0.1, 0.3, gates) * spacing * (-1.0) ** np.arange(gates)
    discs = [
        Disc(x=spacing * (k + 1), y=shift + side * (gap / 2 + radius), radius=radius)
        for k, shift in enumerate(shifts.tolist())
        for side in (-1, 1)
    ]
    return _task(discs, (0.0, 0.0, 0.0), (spacing * (gates + 1), 0.0, 0.0))


def doorway(width: float, seed: int = 0, room: float = 4.0) -> Task:
    """Makes two square rooms with a door in the wall between them.

    Args:
        width: Width of the door in m.
        seed: Seed of the door's place and of the start and the goal.
        room: Side of a room in m, from middle to middle of its walls.

    Raises:
        InputError: The door is wider than half a room, a size is not positive, or the seed is not whole.
    """
    _positive(width=width, room=room)
    _whole(0, seed=seed)
    if width > room / 2:
        raise InputError(f"width: a door of {width:g} m is wider than half a room of {room:g} m")
    door, first, last = (float(y) for y in np.random.default_rng(seed).uniform(-room / 4, room / 4, 3))
    half = room / 2
    corners = [(-room, -half), (room, -half), (room, half), (-room, half), (-room, -half)]
    points = [complex(*corner) for corner in corners]
    walls = [_wall(a, b) for a, b in zip(points[:-1], points[1:], strict=True)]
    jamb = (width + WALL_THICKNESS) / 2
    walls += [_wall(complex(0, -half), complex(0, door - jamb)), _wall(complex(0, door + jamb), complex(0, half))]
    return _task(walls, (-half, first, 0.0), (half, last, 0.0))


def parking_bay(length: float, width: float, seed: int = 0, lane: float = 1.5) -> Task:
    """Makes a bay along a lane, between two parked cars and a kerb, into which a robot parks in parallel.

    Args:
        length: Free length of the bay in m.
        width: Width of the bay, from the lane to the kerb, in m.
        seed: Seed of the start.
        lane: Width of the lane in m; beyond it is a wall.

    Raises:
        InputError: A size is not positive, or the seed is not whole.
    """
    _positive(length=length, width=width, lane=lane)
    _whole(0, seed=seed)
    along, offset = np.random.default_rng(seed).uniform(-0.1, 0.1, 2) * (length, lane)
    cars = [Box(x=side * length, y=-width / 2, length=length, width=width) for side in (-1, 1)]
    ends = 2 * length
    walls = [
        _wall(complex(-ends, y), complex(ends, y)) for y in (-width - WALL_THICKNESS / 2, lane + WALL_THICKNESS / 2)
    ]
    return _task([*cars, *walls], (float(-length + along), float(lane / 2 + offset), 0.0), (0.0, -width / 2, 0.0))


def warehouse(
    aisle: float, seed: int = 0, rows: int = 4, columns: int = 3, shelf: tuple[float, float] = (2.0, 0.5)
) -> Task:
    """Makes rows of shelves with aisles all around them, in a hall with walls; a shelf is missing with probability 0.1.

    Args:
        aisle: Width of the aisles between the shelves in m; along the walls it ends in the middle of the wall.
        seed: Seed of the missing shelves, and of the aisles of start and goal.
        rows: Number of rows of shelves, one beside another along y.
        columns: Number of shelves in a row, which goes along x.
        shelf: Length along x and width of a shelf in m.

    Raises:
        InputError: A size is not positive, or the seed or a number is not whole.
    """
    if not (isinstance(shelf, Sequence) and len(shelf) == 2):
        raise InputError(f"shelf: must be a length and a width in m, not {shelf!r}")
    _positive(aisle=aisle, length=shelf[0], width=shelf[1])
    _whole(0, seed=seed)
    _whole(1, rows=rows, columns=columns)
    random = np.random.default_rng(seed)
    dx, dy = shelf[0] + aisle, shelf[1] + aisle
    kept = random.random((rows, columns)) >= 0.1
    shelves = [
        Box(x=float((k + 0.5) * dx), y=float((i + 0.5) * dy), length=shelf[0], width=shelf[1])
        for i, k in zip(*np.nonzero(kept), strict=True)
    ]
    low, high = complex(-aisle / 2, -aisle / 2), complex(columns * dx + aisle / 2, rows * dy + aisle / 2)
    points = [low, complex(high.real, low.imag), high, complex(low.real, high.imag), low]
    walls = [_wall(a, b) for a, b in zip(points[:-1], points[1:], strict=True)]
    first, last = random.integers(rows + 1, size=2) * dy
    return _task([*shelves, *walls], (0.0, float(first), 0.0), (float(columns * dx), float(last), 0.0))


def _wall(start: complex, end: complex) -> Box:
    """Returns a wall along a line from x + i y to x + i y in m, which reaches half its thickness beyond either end."""
    middle, along = (start + end) / 2, end - start
    angle = float(np.angle(along))
    return Box(x=middle.real, y=middle.imag, angle=angle, length=abs(along) + WALL_THICKNESS, width=WALL_THICKNESS)


def _task(shapes: Sequence[Obstacle], start: Sequence[float], goal: Sequence[float]) -> Task:
    """Returns a task; poses are in m, m, rad."""
    return Task.from_dict({"obstacles": {"shapes": tuple(shapes)}, "start": tuple(start), "goal": tuple(goal)})


def _positive(**values: float) -> None:
    """Refuses values that are not positive and finite.

    Raises:
        InputError: One is not; the message names it.
    """
    for name, value in values.items():
        if not (isinstance(value, Real) and 0 < value < np.inf):
            raise InputError(f"{name}: must be a positive number, not {value!r}")


def _whole(least: int, **values: int) -> None:
    """Refuses values that are no whole numbers, or smaller than the least.

    Raises:
        InputError: One is; the message names it.
    """
    for name, value in values.items():
        if not (isinstance(value, Integral) and value >= least):
            raise InputError(f"{name}: must be a whole number, at least {least}, not {value}")
