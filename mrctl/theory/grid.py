"""Grids: which cells obstacles occupy, and the distance of every cell from the obstacles."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mrctl.kernel import Array, kernel
from mrctl.record import InputError
from mrctl.theory.clearance import point_to_polygon
from mrctl.theory.obstacles import Obstacles, Outlines

MAX_CELLS = 20_000_000
SQUARE_CELLS = 16  # cells along a side of the squares in which a field is measured
MAP_CELL, MAP_MARGIN = 0.05, 1.0  # m, side of a cell of the field of a map, which extends so far beyond its obstacles


class Grid(NamedTuple):
    """Which cells of a rectangle are occupied."""

    occupied: NDArray[np.bool]
    """Whether an obstacle may touch the cell, `(rows, columns)`; y grows with the row, x with the column."""
    origin: Array
    """Lower left corner of the first cell in m, `(2,)`."""
    resolution: float
    """Side of a cell in m."""


class Field(NamedTuple):
    """Signed distance from the nearest obstacle or occupied cell; `at` interpolates it."""

    distance: Array
    """Distance of each cell's centre in m, negative inside, `(rows, columns)`."""
    origin: Array
    """Lower left corner of the first cell in m, `(2,)`."""
    resolution: float
    """Side of a cell in m."""


def check_size(rows: int, columns: int, name: str) -> None:
    """Refuses a grid of more than 20 million cells.

    Raises:
        InputError: It has more; the message begins with the name.
    """
    if rows * columns > MAX_CELLS:
        raise InputError(f"{name}: {columns} by {rows} cells are more than {MAX_CELLS:,}")


def occupancy(outlines: Outlines, low: Array, high: Array, resolution: float) -> Grid:
    """Rasterises obstacles: a cell is occupied if an obstacle comes within half its diagonal of its centre.

    No cell that an obstacle touches is therefore free.

    Args:
        outlines: The obstacles.
        low: Lower left corner of the rectangle in m, `(2,)`.
        high: Its upper right corner in m, `(2,)`.
        resolution: Side of a cell in m.

    Raises:
        InputError: The rectangle is empty, or has too many cells.
    """
    reach = resolution / np.sqrt(2.0)
    field = near_field(outlines, low, high, resolution, 2 * reach)
    return Grid(field.distance <= reach, field.origin, field.resolution)


def _empty(low: Array, high: Array, resolution: float) -> Grid:
    """Returns a grid with nothing in it; the arguments and errors are those of `occupancy`."""
    columns, rows = (int(n) for n in np.ceil((np.asarray(high) - low) / resolution - 1e-9))
    if rows < 1 or columns < 1:
        raise InputError("grid: the rectangle is empty")
    check_size(rows, columns, "grid")
    return Grid(np.zeros((rows, columns), bool), np.array(low, float), float(resolution))


def distance_field(grid: Grid) -> Field:
    """Returns the distance field of a grid; where nothing is occupied it is the diagonal of the grid.

    The border between an occupied and a free cell has distance 0 (Maurer, Qi and Raghavan, IEEE PAMI 25(2), 2003, for
    the transform, which is that of SciPy).
    """
    occupied = grid.occupied
    if not occupied.any():
        distance = np.full(occupied.shape, float(np.hypot(*occupied.shape)))
    else:
        distance = _transform(~occupied) - 0.5
        if not occupied.all():
            distance = np.where(occupied, 0.5 - _transform(occupied), distance)
    return Field(np.ascontiguousarray(distance * grid.resolution), grid.origin, grid.resolution)


def field_of(outlines: Outlines, low: Array, high: Array, resolution: float) -> Field:
    """Returns the distance of each cell's centre from the obstacles themselves, without cells in between.

    The arguments and errors are those of `occupancy`.
    """
    grid = _empty(low, high, resolution)
    field = Field(np.empty(grid.occupied.shape), grid.origin, grid.resolution)
    measure.compiled(outlines, field)
    return field


def map_area(known: Obstacles) -> tuple[Array, Array, float]:
    """Returns the rectangle of the field of a map, lower left and upper right corner, `(2,)`, and its cell, in m."""
    low, high = (corner + side * MAP_MARGIN for corner, side in zip(known.bounds, (-1, 1), strict=True))
    return low, high, max(MAP_CELL, float(np.sqrt(np.prod(high - low) / MAX_CELLS)) * 1.01)


def near_field(outlines: Outlines, low: Array, high: Array, resolution: float, reach: float) -> Field:
    """Returns `field_of` up to a distance `reach` in m, which stands for every larger one.

    The time is that of the cells near each obstacle, and not that of all cells with all obstacles.
    """
    grid = _empty(low, high, resolution)
    field = Field(np.full(grid.occupied.shape, float(reach)), grid.origin, grid.resolution)
    measure_near.compiled(outlines, reach, field)
    return field


@kernel
def measure_near(outlines: Outlines, reach: float, field: Field) -> None:
    """Lowers the distances of the field to those of `near_field`."""
    discs, edges, first, rings = outlines
    distance, origin, resolution = field
    rows, columns = distance.shape
    for shape in range(len(discs) + len(rings)):
        ring = shape - len(discs)
        x, y, radius = discs[shape] if ring < 0 else rings[ring]
        west, east, south, north, sides = x - radius, x + radius, y - radius, y + radius, edges[:0]
        if ring >= 0:
            sides = edges[first[ring] : first[ring + 1]]
            west, east, south, north = sides[:, 0].min(), sides[:, 0].max(), sides[:, 1].min(), sides[:, 1].max()
        left, right = (west - reach - origin[0]) / resolution - 0.5, (east + reach - origin[0]) / resolution - 0.5
        bottom, top = (south - reach - origin[1]) / resolution - 0.5, (north + reach - origin[1]) / resolution - 0.5
        for i in range(max(0, int(np.ceil(bottom))), min(rows - 1, int(np.floor(top))) + 1):
            for k in range(max(0, int(np.ceil(left))), min(columns - 1, int(np.floor(right))) + 1):
                px, py = origin[0] + (k + 0.5) * resolution, origin[1] + (i + 0.5) * resolution
                if ring < 0:
                    away = np.hypot(x - px, y - py) - radius
                else:
                    away = point_to_polygon(px, py, sides)
                distance[i, k] = min(distance[i, k], away)


@kernel
def measure(outlines: Outlines, field: Field) -> None:
    """Writes the distances of `field_of` into the field.

    Only obstacles that may be the nearest one somewhere in a square of cells are held against these cells.
    """
    discs, edges, first, rings = outlines
    distance, origin, resolution = field
    rows, columns = distance.shape
    least = np.empty(len(discs) + len(rings))  # what each obstacle is away from the middle of a square, at least
    reach = SQUARE_CELLS / np.sqrt(2.0) * resolution
    for low in range(0, rows, SQUARE_CELLS):
        for left in range(0, columns, SQUARE_CELLS):
            x, y = origin[0] + (left + SQUARE_CELLS / 2) * resolution, origin[1] + (low + SQUARE_CELLS / 2) * resolution
            away = np.inf
            for n in range(len(discs)):
                least[n] = np.hypot(discs[n, 0] - x, discs[n, 1] - y) - discs[n, 2]
                away = min(away, least[n])
            for p in range(len(rings)):
                least[len(discs) + p] = np.hypot(rings[p, 0] - x, rings[p, 1] - y) - rings[p, 2]
                if least[len(discs) + p] < away:
                    away = min(away, point_to_polygon(x, y, edges[first[p] : first[p + 1]]))
            near = np.flatnonzero(least <= away + 2 * reach)
            for i in range(low, min(low + SQUARE_CELLS, rows)):
                for k in range(left, min(left + SQUARE_CELLS, columns)):
                    x, y = origin[0] + (k + 0.5) * resolution, origin[1] + (i + 0.5) * resolution
                    nearest = resolution * np.hypot(rows, columns)
                    for n in near:
                        p = n - len(discs)
                        if p < 0:
                            nearest = min(nearest, np.hypot(discs[n, 0] - x, discs[n, 1] - y) - discs[n, 2])
                        elif np.hypot(rings[p, 0] - x, rings[p, 1] - y) - rings[p, 2] < nearest:
                            nearest = min(nearest, point_to_polygon(x, y, edges[first[p] : first[p + 1]]))
                    distance[i, k] = nearest


def _transform(cells: NDArray[np.bool]) -> Array:
    """Returns the distance of each cell that is set from the nearest one that is not, in cells, and 0 elsewhere."""
    from scipy.ndimage import distance_transform_edt  # imported here, since robots without a map need no scipy

    return np.asarray(distance_transform_edt(cells), float)


@kernel
def at(field: Field, x: float, y: float) -> tuple[float, float, float]:
    """Returns the distance in m at a point and its gradient, interpolated between the centres of four cells.

    Beyond the outermost centres the distance is that of the nearest point between them, and the gradient is 0.

    Args:
        field: The field.
        x: x of the point in m.
        y: y of the point in m.
    """
    distance, origin, resolution = field
    a, b, c, d, u, v, inside = around(distance, origin[0], origin[1], resolution, x, y)
    value = (1 - v) * ((1 - u) * a + u * b) + v * ((1 - u) * c + u * d)
    if not inside:
        return value, 0.0, 0.0
    return value, ((1 - v) * (b - a) + v * (d - c)) / resolution, ((1 - u) * (c - a) + u * (d - b)) / resolution


@kernel
def value(distance: Array, left: float, low: float, resolution: float, x: float, y: float) -> float:
    """Returns the distance in m of `at` alone, of a field that is taken apart, for loops that look up many.

    A kernel that takes a record apart itself counts the references to its arrays, which takes longer than the rest.

    Args:
        distance: Distances of the field in m, `(rows, columns)`.
        left: x of its origin in m.
        low: y of its origin in m.
        resolution: Side of a cell in m.
        x: x of the point in m.
        y: y of the point in m.
    """
    a, b, c, d, u, v, _ = around(distance, left, low, resolution, x, y)
    return (1 - v) * ((1 - u) * a + u * b) + v * ((1 - u) * c + u * d)


@kernel
def around(
    distance: Array, left: float, low: float, resolution: float, x: float, y: float
) -> tuple[float, float, float, float, float, float, bool]:
    """Returns the distances of the four cells whose centres are around a point, and where it is between them.

    The arguments are those of `value`.

    Returns:
        The distances in m, row by row; the shares of the way to the next column and to the next row, 0 to 1; and
        whether the point is between the outermost centres. If not, the nearest point that is takes its place.
    """
    rows, columns = distance.shape
    column, row = (x - left) / resolution - 0.5, (y - low) / resolution - 0.5
    inside = 0.0 <= column <= columns - 1 and 0.0 <= row <= rows - 1
    column, row = min(max(column, 0.0), columns - 1.0), min(max(row, 0.0), rows - 1.0)
    k, i = min(int(column), max(columns - 2, 0)), min(int(row), max(rows - 2, 0))
    k1, i1 = min(k + 1, columns - 1), min(i + 1, rows - 1)
    return distance[i, k], distance[i, k1], distance[i1, k], distance[i1, k1], column - k, row - i, inside


def rectangles(occupied: NDArray[np.bool]) -> NDArray[np.int64]:
    """Covers the occupied cells with rectangles, none of which can grow; they may overlap.

    Each begins at the first cell that is not covered yet, row by row, and grows right, up, left and down.

    Args:
        occupied: Whether each cell is occupied, `(rows, columns)`.

    Returns:
        First column, first row, and the column and row after the last ones of each rectangle, `(n, 4)`.
    """
    found = np.empty((int(np.count_nonzero(occupied)), 4), np.int64)
    return found[: cover_cells.compiled(occupied, np.zeros(occupied.shape, np.bool_), found)].copy()


@kernel
def cover_cells(occupied: NDArray[np.bool], covered: NDArray[np.bool], found: NDArray[np.int64]) -> int:
    """Writes the rectangles to `found`, one row for each occupied cell, and returns n; `covered` is scratch."""
    rows, columns = occupied.shape
    n = 0
    for i in range(rows):
        for k in range(columns):
            if not occupied[i, k] or covered[i, k]:
                continue
            left, low, right, high = k, i, k + 1, i + 1
            while right < columns and occupied[i, right]:
                right += 1
            while high < rows and occupied[high, left:right].all():
                high += 1
            while left > 0 and occupied[low:high, left - 1].all():
                left -= 1
            while low > 0 and occupied[low - 1, left:right].all():
                low -= 1
            covered[low:high, left:right] = True
            found[n, 0], found[n, 1], found[n, 2], found[n, 3] = left, low, right, high
            n += 1
    return n
