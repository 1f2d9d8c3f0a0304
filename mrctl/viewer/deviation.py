"""How far robots are from the reference: a target that runs along it, a line to each robot, and magnified trails."""

from __future__ import annotations

import numpy as np
import viser

from mrctl.kernel import Array, Row, Rows
from mrctl.physics.obstacles import quaternion
from mrctl.viewer.looks import Colour
from mrctl.viewer.shapes import Mesh, add_mesh, ball, bar

CHOICES = ("automatic", "1×", "10×", "100×")
PIN_COLOUR = (75, 85, 99)


def extent(rows: Rows) -> float:
    """Returns the distance from the reference in m that the worst robot exceeds 2 % of the time, or 0.

    Args:
        rows: Record of `TICK` of each sample and robot, `(T, B)`.
    """
    distance = np.nan_to_num(np.hypot(rows["longitudinal_error"], rows["lateral_error"]))
    return float(np.quantile(distance, 0.98, axis=0).max()) if len(distance) else 0.0


def drawn(rows: Rows, magnified: int) -> Array:
    """Returns x and y in m at which robots are drawn, with the shape of `rows` and 2.

    Args:
        rows: Records of `TICK`.
        magnified: Factor on the deviation from the reference.
    """
    reference, true = (np.stack([rows[x], rows[y]], axis=-1) for x, y in (("x_ref", "y_ref"), ("x", "y")))
    return reference + magnified * (true - reference)


class Target:
    """A pin on the reference, where a robot should be, and a line from it to a ball, where the robot is.

    Both hover above the robot, which would hide them. Poses of nodes reach the picture at once, sizes a frame late: so
    the ball is a node of its own, and only the length of the line is late.
    """

    def __init__(self, scene: viser.SceneApi, row: int, height: float, thick: float, colour: Colour) -> None:
        """Adds the target to a scene; it is invisible until `show`.

        Args:
            scene: The scene.
            row: Index of the robot.
            height: Height of the target over the ground in m.
            thick: Thickness of the line in m.
            colour: Colour of the robot.
        """
        name, self._height = f"/world/target/{row}", height
        self._root = scene.add_frame(name, show_axes=False, visible=False)

        def add(part: str, mesh: Mesh, colour: Colour) -> viser.MeshHandle:
            return add_mesh(scene, f"{name}/{part}", *mesh, color=colour, flat_shading=True)

        add("pin", bar(np.array([0, 0, -self._height]), np.zeros(3), thick / 2), PIN_COLOUR)
        add("head", ball(2 * thick), PIN_COLOUR)
        self._line = add("line", bar(np.zeros(3), np.array([1.0, 0, 0]), thick), colour)
        self._ball = add("ball", ball(3 * thick), colour)

    def show(self, now: Row, ground: float, magnified: int) -> None:
        """Moves the target; of a robot that has stopped it is invisible.

        Args:
            now: Record of `TICK`.
            ground: Height of the ground in m.
            magnified: Factor on the deviation.
        """
        x, y = drawn(now, magnified) - (now["x_ref"], now["y_ref"])
        self._root.visible = bool(np.isfinite(x))
        if not self._root.visible:
            return
        self._root.position = now["x_ref"], now["y_ref"], ground + self._height
        self._root.wxyz = quaternion(np.arctan2(y, x))
        length = float(np.hypot(x, y))
        self._ball.position = length, 0.0, 0.0
        self._line.scale = max(length, 1e-6), 1.0, 1.0
