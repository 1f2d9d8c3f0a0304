"""What the robots know of their postures: the estimate beside the truth, its 3σ ellipse, and the last fixes."""

from __future__ import annotations

import numpy as np
import viser

from mrctl.kernel import Array, Row, Rows
from mrctl.physics.obstacles import quaternion
from mrctl.theory.kinematics import UP
from mrctl.viewer.looks import Colour
from mrctl.viewer.shapes import add_mesh, disc, ribbons

SIGMAS = 3.0  # size of the ellipse in standard deviations
ELLIPSE_SHARE = 1 - np.exp(-(SIGMAS**2) / 2)  # of a normal distribution on the plane, which the ellipse holds
FIX_AGE = 2.0  # s, after which a fix has faded
MAX_FIXES = 20  # number of fixes that are shown of a robot
MAGNIFICATIONS = (1, 10, 100)
MAX_MAGNIFIED = 0.5  # m, to which errors are magnified at the beginning
RIM_WIDTH = 0.06  # width of the rim of an ellipse, as a share of its half axes
CIRCLE_ANGLES = np.linspace(0, 2 * np.pi, 49)
# Height in m of the first robot's marks over the ground, above the trails, and from one robot's marks to the next, and
# from one kind of mark to the next; at the same height they would flicker.
MARK_HEIGHT, NEXT_ROBOT, NEXT_MARK = 0.012, 0.004, 0.001


def magnification(spread: float) -> int:
    """Returns the largest of `MAGNIFICATIONS` with which errors of `spread` in m stay in the picture."""
    return max(m for m in MAGNIFICATIONS if m == 1 or m * spread <= MAX_MAGNIFIED)


def ellipse(estimate: Row) -> tuple[Array, float]:
    """Returns the half axes of the 3σ ellipse of the estimated x and y in m, `(2,)`, and its angle in rad.

    Args:
        estimate: Record of `TICK`.

    Returns:
        The half axes, the shorter one first, and the angle from the world's x axis to the shorter one.
    """
    mixed = estimate["covariance_xy"]
    variances, axes = np.linalg.eigh([[estimate["variance_x"], mixed], [mixed, estimate["variance_y"]]])
    return SIGMAS * np.sqrt(np.maximum(variances, 0)), float(np.arctan2(axes[1, 0], axes[0, 0]))


def error(log: Rows) -> Array:
    """Returns the estimated less the true x and y in m, `(..., 2)`."""
    return np.stack([log["x_measured"] - log["x"], log["y_measured"] - log["y"]], axis=-1)


class Marks:
    """The marks of one robot: outline of the estimated posture, true position, ellipse, and fixes.

    Errors of x and y are magnified about the true position, that of a fix about the position at which it was taken. The
    heading is not magnified.
    """

    def __init__(self, scene: viser.SceneApi, row: int, footprint: Array, colour: Colour) -> None:
        """Adds the marks to a scene; they are invisible until `show`.

        Args:
            scene: The scene.
            row: Index of the robot.
            footprint: Least and largest x and y of the robot in its own frame in m, `(2, 2)`.
            colour: Colour of the robot.
        """
        name, self._level = f"/world/sensors/{row}", MARK_HEIGHT + NEXT_ROBOT * row
        self._root = scene.add_frame(name, show_axes=False, visible=False)
        arrow = ribbons(outline(footprint), 0.014)
        self._estimate = add_mesh(scene, f"{name}/estimate", *arrow, color=colour, side="double")
        circle = np.column_stack([np.cos(CIRCLE_ANGLES), np.sin(CIRCLE_ANGLES)])
        point = disc(0.016 * circle)
        self._truth = add_mesh(scene, f"{name}/truth", *point, color=(20, 20, 20), side="double")
        self._ellipse = scene.add_frame(f"{name}/ellipse", show_axes=False)
        area, rim = disc(circle), ribbons(np.pad((1 - RIM_WIDTH / 2) * circle, [(0, 0), (0, 1)])[None], RIM_WIDTH)
        self._area = add_mesh(scene, f"{name}/ellipse/area", *area, color=colour, opacity=0.5, side="double")
        self._rim = add_mesh(scene, f"{name}/ellipse/rim", *rim, color=colour, side="double")
        dark = np.tile(np.array(colour, np.uint8) // 2, (MAX_FIXES, 1))
        self._fixes = scene.add_batched_meshes_simple(
            f"{name}/fixes", *point, np.tile([1.0, 0, 0, 0], (MAX_FIXES, 1)), np.zeros((MAX_FIXES, 3)),
            batched_colors=dark, batched_opacities=np.zeros(MAX_FIXES), lod="off",
            side="double", cast_shadow=False, receive_shadow=False,
        )  # fmt: skip

    def show(self, here: Array, log: Rows, period: float, latency: int, magnified: int) -> None:
        """Moves the marks; without an estimate, as in the results of earlier versions, they are invisible.

        Args:
            here: True position on the ground in m, `(3,)`.
            log: Record of `TICK` of the last samples of the robot, `(T,)`, at least of `FIX_AGE`.
            period: Time between samples in s.
            latency: Number of samples between the moment of a fix and its arrival.
            magnified: Factor on errors.
        """
        self._root.visible = bool(len(log) and np.isfinite(log["x_measured"][-1]))
        if not self._root.visible:
            return
        last = log[-1]
        middle = here + self._level * UP
        estimate = middle + [*magnified * error(last), 0]  # the robot may be drawn a moment after the sample
        self._estimate.position, self._estimate.wxyz = estimate + NEXT_MARK * UP, quaternion(last["theta_measured"])
        self._truth.position = middle + 3 * NEXT_MARK * UP
        self._ellipse.visible = bool(last["variance_x"] > 0)
        if self._ellipse.visible:
            (a, b), angle = ellipse(last)
            self._ellipse.position, self._ellipse.wxyz = estimate, quaternion(angle)
            self._area.scale = self._rim.scale = (magnified * a, magnified * b, 1.0)
        arrived = np.flatnonzero(np.isfinite(log["fix_x"]))
        age = (len(log) - 1 - arrived) * period
        recent = np.flatnonzero((age < FIX_AGE) & (arrived >= latency))[-MAX_FIXES:]
        fixes, taken = log[arrived[recent]], log[arrived[recent] - latency]
        true = np.stack([taken["x"], taken["y"]], axis=-1)
        places, opacities = np.tile(here, (MAX_FIXES, 1)), np.zeros(MAX_FIXES, np.float32)
        places[: len(recent), :2] = true + magnified * (np.stack([fixes["fix_x"], fixes["fix_y"]], axis=-1) - true)
        places[:, 2] += self._level + 2 * NEXT_MARK
        opacities[: len(recent)] = 1 - age[recent] / FIX_AGE
        self._fixes.batched_positions, self._fixes.batched_opacities = places.astype(np.float32), opacities


def outline(footprint: Array) -> Array:
    """Returns lines in a robot's frame, `(2, n, 3)`: its outline with a pointed front, and one from P to the point."""
    (back, right), (front, left) = footprint
    tip = [front + 0.25 * (left - right), 0.0]
    corners = np.array([tip, [front, left], [back, left], [back, right], [front, right], tip])
    along, at = np.arange(len(corners)), np.linspace(0, len(corners) - 1, 101)
    around = np.stack([np.interp(at, along, corners[:, k]) for k in range(2)], axis=-1)
    axis = np.linspace(0, 1, len(at))[:, None] * tip
    lines = np.zeros((2, len(at), 3))
    lines[:, :, :2] = around, axis
    return lines
