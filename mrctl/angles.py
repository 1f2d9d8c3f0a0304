"""Angles and planar frames."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray


def wrap(angle: ArrayLike) -> NDArray[np.float64]:
    """The same angle in (−π, π], elementwise.

    Args:
        angle: Angles of any shape, rad.
    """
    wrapped = np.pi - np.mod(np.pi - np.asarray(angle, float), 2 * np.pi)
    return np.where(wrapped == -np.pi, np.pi, wrapped)[()]  # just beyond π the remainder rounds up to 2π itself


def world_to_body(vector: ArrayLike, heading: ArrayLike) -> NDArray[np.float64]:
    """Rotates planar world vectors `(…, 2)` into the frames with headings `(…)`, rad."""
    x, y = np.moveaxis(np.asarray(vector, float), -1, 0)
    c, s = np.cos(heading), np.sin(heading)
    return np.stack([c * x + s * y, c * y - s * x], axis=-1)


def body_to_world(vector: ArrayLike, heading: ArrayLike) -> NDArray[np.float64]:
    """The inverse of `world_to_body`."""
    return world_to_body(vector, -np.asarray(heading, float))
