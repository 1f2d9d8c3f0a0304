"""Draws lines, such as the reference, into MuJoCo's pictures."""

# pyright: reportAttributeAccessIssue=false
# (mujoco is compiled and ships no stubs)

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from mrctl.kernel import Array

REFERENCE_COLOUR = 110, 115, 122
"""Colour of the reference in every view, as red, green and blue."""
SHADOW_PIXELS = 1024
"""Number of pixels along each side of the shadow map; a larger one takes most of the time without a GPU."""


def draw_line(scene: mujoco.MjvScene, points: Array, width: float, colour: Sequence[int]) -> None:
    """Adds a line through points in m, `(n, 3)`, to a scene, with a width in m and a colour of red, green and blue."""
    rgba = np.array([*np.array(colour) / 255, 1.0], np.float32)
    for start, end in zip(points[:-1], points[1:], strict=True):
        if scene.ngeom >= scene.maxgeom or not np.isfinite([start, end]).all():
            continue
        scene.ngeom += 1  # first, because dm_control shows no others
        geom = scene.geoms[scene.ngeom - 1]
        kind = mujoco.mjtGeom.mjGEOM_CAPSULE
        mujoco.mjv_initGeom(geom, kind, np.zeros(3), np.zeros(3), np.zeros(9), rgba)
        mujoco.mjv_connector(geom, kind, width / 2, start, end)
