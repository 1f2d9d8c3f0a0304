"""What robots on a mission know and consider: map, scans, the search for a plan, ways ahead, start and goal."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import viser

from mrctl.kernel import Array
from mrctl.physics.obstacles import WALL_HEIGHT, quaternion
from mrctl.physics.pictures import REFERENCE_COLOUR
from mrctl.theory.obstacles import Obstacles, Surroundings
from mrctl.viewer.looks import MAX_MARKED, Colour, Look, pale
from mrctl.viewer.recording import PATH_HEIGHT
from mrctl.viewer.sensors import outline
from mrctl.viewer.shapes import add_mesh, ribbons, sides

GOAL_COLOUR: Colour = (22, 163, 74)
OUTLINE_WIDTH = 0.02  # m, width of the outlines at start and goal
POINT_SIZE, SCAN_HEIGHT = 0.03, WALL_HEIGHT + 0.01  # m, size of the points of a scan, which lie on top of the walls
PARTICLE_SIZE, MAX_PARTICLES = 0.015, 500  # m, size of a particle, and the number from which on only some are drawn
SEARCH_COLOUR: Colour = (148, 163, 184)
MAP_COLOUR: Colour = (30, 41, 59)
MAP_HEIGHT = WALL_HEIGHT + 0.02  # m
FAN_STRIDE, FAN_HEIGHT, MAX_ARCS = 4, 0.03, 5000  # of the drawn steps of a roll-out; m; about the number that is drawn


class Navigation:
    """The drawings of a mission; each is invisible until it is shown."""

    def __init__(
        self,
        scene: viser.SceneApi,
        robots: Sequence[Look],
        footprint: Array,
        height: Callable[[float, float], float],
    ) -> None:
        """Adds the drawings to a scene.

        Args:
            scene: The scene.
            robots: Look of each robot.
            footprint: Least and largest x and y of a robot in its own frame in m, `(2, 2)`.
            height: Returns the height of the ground in m at x and y in m.
        """
        self._scene, self._height = scene, height
        self._outline = ribbons(outline(footprint), OUTLINE_WIDTH)
        self._ends: list[viser.MeshHandle] = []  # start and goal in turn
        self._scans: list[viser.PointCloudHandle] = []
        for row, robot in enumerate(robots[:MAX_MARKED]):
            for kind, size in (("scan", POINT_SIZE), ("particles", PARTICLE_SIZE)):
                self._scans.append(
                    scene.add_point_cloud(
                        f"/world/{kind}/{row}", np.zeros((0, 3)), robot.colour, point_size=size, point_shape="circle",
                        point_shading="flat", precision="float32", visible=False,
                    )
                )  # fmt: skip
        self._fans = [
            [
                self._draw_segments(f"/world/considered/{row}/{name}", colour, width)
                for name, colour, width in (("some", pale(robot.colour), 1.0), ("chosen", robot.colour, 3.0))
            ]
            for row, robot in enumerate(robots[:MAX_MARKED])
        ]
        self._search = self._draw_segments("/world/search", SEARCH_COLOUR, 1.0)
        self._map = self._draw_segments("/world/map", MAP_COLOUR, 3.0)

    def _draw_segments(self, name: str, colour: Colour, width: float) -> viser.LineSegmentsHandle:
        """Adds line segments of a width in pixels, of which there are none yet."""
        return self._scene.add_line_segments(
            name, np.zeros((0, 2, 3)), colour, thickness=width, thickness_units="screen", visible=False
        )

    def show_map(self, known: Obstacles | None) -> None:
        """Draws a map that differs from the world, on top of the obstacles, as the outlines of what it has."""
        _show_segments(self._map, None if known is None else sides(Surroundings(known).at(0.0)), MAP_HEIGHT)

    def show_ends(self, ends: Sequence[Array]) -> None:
        """Draws outlines of a robot at starts and goals, pairs of poses in m, m, rad, `(2, 3)`, each pair once."""
        poses = np.unique(np.reshape(ends, (-1, 2, 3)), axis=0).reshape(-1, 3)
        for k in range(len(self._ends), len(poses)):
            name, colour = ("goal", GOAL_COLOUR) if k % 2 else ("start", REFERENCE_COLOUR)
            self._ends.append(
                add_mesh(self._scene, f"/world/{name}/{k // 2}", *self._outline, color=colour, side="double")
            )
        for k, mark in enumerate(self._ends):
            mark.visible = k < len(poses)
            if mark.visible:
                x, y, theta = poses[k]
                mark.position, mark.wxyz = (x, y, self._height(x, y) + PATH_HEIGHT), quaternion(theta)

    def show_scans(self, scans: Sequence[tuple[Array, Array] | None]) -> None:
        """Draws what `Session.scan` returns, for each of the first robots; no scans hide all points."""
        for row, (met, particles) in enumerate(zip(self._scans[::2], self._scans[1::2], strict=True)):
            found = scans[row] if row < len(scans) else None
            met.visible = particles.visible = found is not None
            if found is not None:
                places = np.pad(found[0], [(0, 0), (0, 1)], constant_values=SCAN_HEIGHT).astype(np.float32)
                if not np.array_equal(met.points, places):  # scans are rarer than pictures
                    some = found[1][:: max(1, len(found[1]) // MAX_PARTICLES), :2]
                    met.points = places
                    particles.points = np.pad(some, [(0, 0), (0, 1)], constant_values=PATH_HEIGHT).astype(np.float32)

    def show_considered(self, ways: Sequence[tuple[Array, Array] | None]) -> None:
        """Draws what `Session.considered` returns, for each of the first robots; no ways hide all."""
        for row, drawn in enumerate(self._fans):
            found = ways[row] if row < len(ways) else None
            for lines, places in zip(drawn, found or (None, None), strict=True):
                _show_segments(lines, None if places is None else _segments(places[..., ::FAN_STRIDE, :]), FAN_HEIGHT)

    def show_search(self, arcs: Array) -> None:
        """Draws the arcs of a search, ends in m, `(k, 2, 2)`; none hide them."""
        some = arcs[:: max(1, len(arcs) // MAX_ARCS)]
        _show_segments(self._search, some if len(some) else None, PATH_HEIGHT)


def _segments(ways: Array) -> Array:
    """Returns the pieces of ways, `(…, n, 2)`, as ends of segments, `(k, 2, 2)`."""
    return np.stack([ways[..., :-1, :], ways[..., 1:, :]], axis=-2).reshape(-1, 2, 2)


def _show_segments(lines: viser.LineSegmentsHandle, ends: Array | None, height: float) -> None:
    """Draws segments between points on the floor in m, `(k, 2, 2)`, at a height in m; None hides them."""
    lines.visible = ends is not None
    if ends is not None:
        lines.points = np.pad(ends, [(0, 0), (0, 0), (0, 1)], constant_values=height).astype(np.float32)
