"""What stands in a robot's way: discs, boxes and convex polygons on the plane, still or moving on a given course.

`Obstacles` describes them as data. `Surroundings` holds them as arrays for the kernels of `mrctl.theory.clearance`,
`mrctl.theory.rays` and `mrctl.theory.grid`; `mrctl.physics.obstacles` makes walls of them that a robot collides with.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field, model_validator

from mrctl.kernel import Array, kernel
from mrctl.record import InputError, Record
from mrctl.theory.references import Reference

MAX_OBSTACLES = 20_000  # obstacles in one world; a map with more has a finer resolution than a robot needs
GROUND_HEIGHT = 0.02  # m, height up to which a solid is ground
OVERHEAD_HEIGHT = 1.0  # m, height from which on a solid hangs over robots, as the lintel of a door

Coordinate = Annotated[float, Field(ge=-1e4, le=1e4)]
Size = Annotated[float, Field(ge=1e-3, le=1e4)]
Angle = Annotated[float, Field(ge=-7, le=7)]
Pose = tuple[Coordinate, Coordinate, Angle]
"""x and y in m, θ in rad."""


class Disc(Record):
    """An upright cylinder."""

    kind: Literal["disc"] = "disc"
    """Kind of the obstacle."""
    x: Coordinate = 0.0
    """Position of the centre along x in m."""
    y: Coordinate = 0.0
    """Position of the centre along y in m."""
    radius: Size = 0.1
    """Radius in m."""
    course: Reference | None = None
    """Course on which the obstacle moves; its own coordinates are then relative to the pose of the course."""

    @property
    def vertices(self) -> Array:
        """Corners, of which a disc has none, `(0, 2)`."""
        return np.zeros((0, 2))


class Box(Record):
    """An upright box."""

    kind: Literal["box"] = "box"
    """Kind of the obstacle."""
    x: Coordinate = 0.0
    """Position of the centre along x in m."""
    y: Coordinate = 0.0
    """Position of the centre along y in m."""
    angle: Angle = 0.0
    """Direction of its length in rad, counter-clockwise from +x."""
    length: Size = 1.0
    """Length in m."""
    width: Size = 1.0
    """Width in m, across the length."""
    course: Reference | None = None
    """Course on which the obstacle moves; its own coordinates are then relative to the pose of the course."""

    @property
    def vertices(self) -> Array:
        """Corners, counter-clockwise, `(4, 2)` in m."""
        corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * [self.length / 2, self.width / 2]
        return turned(corners, np.array([self.x, self.y, self.angle]))


class Polygon(Record):
    """An upright prism over a convex polygon."""

    kind: Literal["polygon"] = "polygon"
    """Kind of the obstacle."""
    points: Annotated[tuple[tuple[Coordinate, Coordinate], ...], Field(min_length=3, max_length=64)]
    """Corners in order, as x and y in m; the polygon must be convex."""
    course: Reference | None = None
    """Course on which the obstacle moves; its own coordinates are then relative to the pose of the course."""

    @model_validator(mode="after")
    def _convex(self) -> Polygon:
        sides = np.roll(self.vertices, -1, axis=0) - self.vertices
        turns = np.arctan2(_cross(sides, np.roll(sides, -1, axis=0)), np.sum(sides * np.roll(sides, -1, axis=0), 1))
        if np.any(turns < 1e-9) or abs(turns.sum() - 2 * np.pi) > 1e-6 or np.hypot(*sides.T).min() < 1e-6:
            raise ValueError("points: the polygon is not convex, or has sides on one line or of no length")
        return self

    @property
    def vertices(self) -> Array:
        """Corners, counter-clockwise, `(n, 2)` in m."""
        points = np.array(self.points, float)
        return points if _cross(points, np.roll(points, -1, axis=0)).sum() > 0 else points[::-1]


Obstacle = Annotated[Disc | Box | Polygon, Field(discriminator="kind")]


class Obstacles(Record):
    """The obstacles of a world; a scenario may give the path of a TOML file in place of its content."""

    shapes: Annotated[tuple[Obstacle, ...], Field(max_length=MAX_OBSTACLES)] = ()
    """Obstacles, each with its `kind`: disc, box or polygon."""

    @model_validator(mode="before")
    @classmethod
    def _from_file(cls, values: Any) -> Any:  # noqa: ANN401
        if not isinstance(values, str):
            return values
        if not Path(values).is_file():
            raise ValueError(f"no file {values}")
        return cls.from_toml(values).model_dump()

    @property
    def standing(self) -> tuple[Disc | Box | Polygon, ...]:
        """Obstacles that stand still."""
        return tuple(shape for shape in self.shapes if shape.course is None)

    @property
    def still(self) -> Obstacles:
        """Only the obstacles that stand still."""
        return Obstacles(shapes=self.standing)

    @property
    def moving(self) -> tuple[Disc | Box | Polygon, ...]:
        """Obstacles that move."""
        return tuple(shape for shape in self.shapes if shape.course is not None)

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Lower left and upper right corner of the box around the obstacles that stand still, in m, `(2,)` each.

        Raises:
            InputError: No obstacle stands still.
        """
        if not self.still.shapes:
            raise InputError("obstacles: there are none that stand still, so they have no bounds")
        return Surroundings(self.still).at(0.0).bounds


NO_OBSTACLES = Obstacles()
"""The default world, which is empty."""


def _still(known: Obstacles) -> Obstacles:
    if known.moving:
        raise ValueError("an obstacle on it has a course, but a map does not move")
    return known


Known = Annotated[Obstacles, AfterValidator(_still)]
"""Obstacles on a map, none of which moves."""


def _cross(a: Array, b: Array) -> Array:
    """Returns the cross products of plane vectors, `(n, 2)` each."""
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def turned(points: Array, pose: Array) -> Array:
    """Transforms points from the frame of a body to the world.

    Args:
        points: Points in the body's frame in m, `(n, 2)`.
        pose: x and y of the body in m and θ in rad, `(3,)`.
    """
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return points @ np.array([[c, s], [-s, c]]) + pose[:2]


class Outlines(NamedTuple):
    """Outlines of C discs and P convex polygons at one moment, for kernels."""

    discs: Array
    """x and y of the centre and radius in m, `(C, 3)`."""
    edges: Array
    """Sides of all polygons, each counter-clockwise: x and y of start and end in m, `(E, 4)`."""
    first: NDArray[np.int64]
    """The sides of polygon p are `first[p]` to `first[p + 1]` − 1, `(P + 1,)`."""
    rings: Array
    """A circle around each polygon: x and y of its centre and its radius in m, `(P, 3)`."""

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Lower left and upper right corner of the box around all of them, of which there are some, in m, `(2,)`."""
        points = [self.edges[:, :2], *(self.discs[:, :2] + side * self.discs[:, 2:] for side in (-1, 1))]
        whole = np.concatenate(points)
        return whole.min(axis=0), whole.max(axis=0)


class Movers(NamedTuple):
    """The course on which each part of some outlines moves; below 0 where it stands still."""

    discs: NDArray[np.int64]
    """Course of each disc, `(C,)`."""
    edges: NDArray[np.int64]
    """Course of each side, `(E,)`."""
    rings: NDArray[np.int64]
    """Course of each polygon, `(P,)`."""


class Surroundings:
    """Obstacles as arrays; those that move come last.

    Attributes:
        courses: Course of each of the M obstacles that move.
    """

    def __init__(self, obstacles: Obstacles) -> None:
        """Takes the obstacles."""
        shapes = sorted(obstacles.shapes, key=lambda shape: shape.course is not None)
        self.courses = [shape.course for shape in shapes if shape.course is not None]
        discs = [(k, s) for k, s in enumerate(shapes) if isinstance(s, Disc)]
        corners = [(k, s.vertices) for k, s in enumerate(shapes) if not isinstance(s, Disc)]
        edges = [np.hstack([v, np.roll(v, -1, axis=0)]) for _, v in corners]
        middles = [v.mean(axis=0) for _, v in corners]
        rings = [(*m, np.hypot(*(v - m).T).max()) for m, (_, v) in zip(middles, corners, strict=True)]
        self._own = Outlines(
            np.array([(s.x, s.y, s.radius) for _, s in discs]).reshape(-1, 3),
            np.concatenate(edges) if edges else np.zeros((0, 4)),
            np.cumsum([0, *map(len, edges)]),
            np.array(rings).reshape(-1, 3),
        )
        still = len(shapes) - len(self.courses)  # obstacle k moves on course k − still
        of_discs = np.array([k - still for k, _ in discs], int)
        of_rings = np.array([k - still for k, _ in corners], int)
        self._movers = Movers(of_discs, np.repeat(of_rings, np.diff(self._own.first)), of_rings)

    def poses(self, times: Array) -> Array:
        """Returns the poses of the courses at times in s, `(T,)`, as `(T, M, 3)` in m, m, rad."""
        return (
            np.stack([c.sample(times).pose for c in self.courses], 1) if self.courses else np.zeros((len(times), 0, 3))
        )

    def at(self, time: float) -> Outlines:
        """Returns the outlines at a time in s."""
        if not self.courses:
            return self._own
        return self.placed(self.poses(np.array([float(time)]))[0])

    def placed(self, poses: Array) -> Outlines:
        """Returns the outlines where the courses have these poses, `(M, 3)` in m, m, rad."""
        own = self._own
        found = Outlines(own.discs.copy(), own.edges.copy(), own.first, own.rings.copy())
        place.compiled(own, self._movers, poses, found)
        return found


@kernel
def place(own: Outlines, movers: Movers, poses: Array, found: Outlines) -> None:
    """Places the outlines of the obstacles that move; the others, whose mover is below 0, stay.

    Args:
        own: Outlines relative to the courses.
        movers: Index of the course of each part of the outlines.
        poses: Pose of each course in m, m, rad, `(M, 3)`.
        found: In and out: the outlines in the world.
    """
    own_discs, own_edges, _, own_rings = own
    of_discs, of_edges, of_rings = movers
    discs, edges, _, rings = found
    for k in range(len(discs)):
        if of_discs[k] >= 0:
            discs[k, 0], discs[k, 1] = moved(poses[of_discs[k]], own_discs[k, 0], own_discs[k, 1])
    for k in range(len(edges)):
        if of_edges[k] >= 0:
            edges[k, 0], edges[k, 1] = moved(poses[of_edges[k]], own_edges[k, 0], own_edges[k, 1])
            edges[k, 2], edges[k, 3] = moved(poses[of_edges[k]], own_edges[k, 2], own_edges[k, 3])
    for k in range(len(rings)):
        if of_rings[k] >= 0:
            rings[k, 0], rings[k, 1] = moved(poses[of_rings[k]], own_rings[k, 0], own_rings[k, 1])


@kernel
def moved(pose: Array, x: float, y: float) -> tuple[float, float]:
    """Transforms a point, x and y in m, from the frame of a body at a pose in m, m, rad, `(3,)`, to the world."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return pose[0] + c * x - s * y, pose[1] + s * x + c * y
