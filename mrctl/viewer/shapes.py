"""Simple shapes, as vertices and triangles, and how they are added to a scene."""

from __future__ import annotations

from typing import Any

import numpy as np
import trimesh
import viser
from numpy.typing import NDArray

from mrctl.kernel import Array
from mrctl.theory.obstacles import Outlines

CIRCLE_SIDES = 24  # sides of a circle that is drawn with segments
Mesh = tuple[NDArray[np.float32], NDArray[np.uint32]]


def ribbons(lines: Array, width: float) -> Mesh:
    """Returns vertices `(2Bn, 3)` and triangles `(2B(n − 1), 3)` of level ribbons along lines `(B, n, 3)`."""
    along = np.gradient(lines[..., :2], axis=1)
    length = np.linalg.norm(along, axis=-1, keepdims=True)
    across = np.stack([-along[..., 1], along[..., 0]], axis=-1) / np.where(length > 0, length, 1)
    half = np.zeros_like(lines)
    half[..., :2] = width / 2 * across
    vertices = np.stack([lines - half, lines + half], axis=2).reshape(-1, 3)
    right = 2 * np.arange(lines.shape[0] * lines.shape[1]).reshape(lines.shape[:2])[:, :-1].ravel()
    faces = np.concatenate(
        [np.stack([right, right + 2, right + 1], -1), np.stack([right + 1, right + 2, right + 3], -1)]
    )
    return vertices.astype(np.float32), faces.astype(np.uint32)


def disc(around: Array) -> Mesh:
    """Returns vertices `(n + 1, 3)` and triangles `(n − 1, 3)` of the level area around the origin.

    Args:
        around: Closed line around the origin in m, `(n, 2)`.
    """
    vertices = np.zeros((len(around) + 1, 3), np.float32)
    vertices[1:, :2] = around
    corner = np.arange(1, len(around), dtype=np.uint32)
    return vertices, np.stack([np.zeros_like(corner), corner, corner + 1], axis=-1)


def ball(radius: float) -> Mesh:
    """Returns vertices `(12, 3)` and triangles `(20, 3)` of a ball around the origin."""
    shape = trimesh.creation.icosphere(subdivisions=0, radius=radius)
    return shape.vertices.astype(np.float32), shape.faces.astype(np.uint32)


def bar(start: Array, end: Array, thickness: float) -> Mesh:
    """Returns vertices `(8, 3)` and triangles `(12, 3)` of a bar along one of the axes between two points `(3,)`."""
    across = np.where(start == end, thickness / 2, 0.0)
    low, high = np.minimum(start, end) - across, np.maximum(start, end) + across
    shape = trimesh.creation.box(bounds=[low, high])
    return shape.vertices.astype(np.float32), shape.faces.astype(np.uint32)


def sides(outlines: Outlines) -> Array:
    """Returns the sides of obstacles as segments, those of circles as polygons, ends in m, `(k, 2, 2)`."""
    turn = np.linspace(0, 2 * np.pi, CIRCLE_SIDES + 1)
    rims = outlines.discs[:, None, :2] + outlines.discs[:, None, 2:] * np.column_stack([np.cos(turn), np.sin(turn)])
    round_ones = np.stack([rims[:, :-1], rims[:, 1:]], axis=2).reshape(-1, 2, 2)
    return np.concatenate([round_ones, outlines.edges.reshape(-1, 2, 2)])


def add_mesh(scene: viser.SceneApi, name: str, vertices: NDArray, faces: NDArray, **options: Any) -> viser.MeshHandle:  # noqa: ANN401
    """Adds a mesh that neither casts nor receives shadows; the options are those of `add_mesh_simple`."""
    return scene.add_mesh_simple(name, vertices, faces, cast_shadow=False, receive_shadow=False, **options)
