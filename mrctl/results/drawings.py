"""Drawings of the paper, which show no result: the posture of the robot and the structure of its control.

Each function returns a matplotlib `Figure` in the style of `mrctl.results.plots` and shows nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Arc, Circle, FancyArrowPatch, FancyBboxPatch, Polygon

from mrctl.results.plots import COLOURS, COLUMN_WIDTH, PAGE_WIDTH, styled

Point = Sequence[float] | np.ndarray


def _canvas(width: float, height: float, limits: tuple[float, float, float, float]) -> tuple[Figure, Axes]:
    """Makes an empty figure with equal axes and the given limits (x0, x1, y0, y1); its size is in inches."""
    figure = Figure(figsize=(width, height))
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set(xlim=limits[:2], ylim=limits[2:], aspect="equal")
    axes.set_axis_off()
    return figure, axes


def _arrow(axes: Axes, start: Point, end: Point, style: str = "-|>", **options: object) -> None:
    """Draws an arrow between two points."""
    look: dict[str, Any] = {"mutation_scale": 8, "lw": 0.8, "color": "black", "shrinkA": 0, "shrinkB": 0, **options}
    axes.add_patch(FancyArrowPatch((start[0], start[1]), (end[0], end[1]), arrowstyle=style, **look))


@styled
def posture_definition() -> Figure:
    """Draws the definition of the car-like robot's posture in the world frame (the paper's figure 2)."""
    figure, axes = _canvas(COLUMN_WIDTH, 0.82 * COLUMN_WIDTH, (-0.75, 6.35, -0.7, 5.122))
    theta, phi, wheelbase, half_track = np.deg2rad(28), np.deg2rad(30), 2.4, 0.8
    p = np.array([1.9, 1.75])

    def along(angle: float) -> np.ndarray:
        return np.array([np.cos(angle), np.sin(angle)])

    forward, left = along(theta), along(theta + np.pi / 2)

    def at(x: float, y: float) -> np.ndarray:
        return p + x * forward + y * left

    def wheel(centre: np.ndarray, angle: float) -> None:
        a, b = 0.36 * along(angle), 0.11 * along(angle + np.pi / 2)
        corners = [centre + a + b, centre + a - b, centre - a - b, centre - a + b]
        axes.add_patch(Polygon(corners, fc="0.3", ec="black", lw=0.6, joinstyle="round", zorder=3))

    def text(place: Point, string: str, colour: str = "black") -> None:
        axes.text(place[0], place[1], string, ha="center", va="center", fontsize=10, color=colour, zorder=6)

    thin = {"color": "0.45", "lw": 0.6}
    dashed = {**thin, "ls": (0, (4, 2.5))}
    # World frame
    _arrow(axes, (0, 0), (5.9, 0))
    _arrow(axes, (0, 0), (0, 4.75))
    text((5.95, -0.28), "$x_0$")
    text((-0.28, 4.65), "$y_0$")
    text((-0.28, -0.28), "$O_0$")
    axes.plot([p[0], p[0], 0], [0, p[1], p[1]], **dashed)
    text((p[0], -0.28), "$x$")
    text((-0.28, p[1]), "$y$")
    # Body, wheels
    outline = [at(-0.55, 0.55), at(3.0, 0.55), at(3.0, -0.55), at(-0.55, -0.55)]
    axes.add_patch(Polygon(outline, fc="#E3EEF6", ec="0.4", lw=0.8, joinstyle="round", zorder=1))
    axes.plot(*np.array([at(0, half_track), at(0, -half_track)]).T, color="black", lw=1.4, zorder=2)
    wheel(at(0, half_track), theta)
    wheel(at(0, -half_track), theta)
    front = at(wheelbase, 0)
    # Body frame and angles
    axes.plot(*np.array([p, at(4.05, 0)]).T, color="black", lw=0.7, zorder=2)
    _arrow(axes, at(3.9, 0), at(4.3, 0))
    _arrow(axes, p, at(0, 2.35), zorder=4)
    text(at(4.22, -0.27), "$x_r$")
    text(at(0.27, 2.25), "$y_r$")
    axes.plot([p[0], p[0] + 2.9], [p[1], p[1]], **dashed, zorder=2)
    axes.add_patch(Arc((p[0], p[1]), 3.5, 3.5, theta1=0, theta2=np.rad2deg(theta), lw=0.8, zorder=4))
    text(p + 2.0 * along(theta / 2), r"$\theta$")
    wheel(front, theta + phi)
    axes.plot(*np.array([front, front + 1.5 * along(theta + phi)]).T, **dashed, zorder=2)
    angles = np.rad2deg([theta, theta + phi])
    axes.add_patch(Arc((front[0], front[1]), 2.3, 2.3, theta1=angles[0], theta2=angles[1], lw=0.8, zorder=4))
    text(front + 1.36 * along(theta + phi / 2), r"$\phi$")
    # Dimensions
    axes.plot(*np.array([at(0, -half_track - 0.2), at(0, -1.52)]).T, **thin)
    axes.plot(*np.array([at(wheelbase, -0.65), at(wheelbase, -1.52)]).T, **thin)
    _arrow(axes, at(0, -1.42), at(wheelbase, -1.42), "<|-|>", lw=0.6, mutation_scale=6)
    text(at(wheelbase / 2, -1.65), "$L$")
    for side in (half_track, -half_track):
        axes.plot(*np.array([at(-0.45, side), at(-1.02, side)]).T, **thin)
    _arrow(axes, at(-0.92, half_track), at(-0.92, -half_track), "<|-|>", lw=0.6, mutation_scale=6)
    text(at(-1.2, 0), "$2D$")
    # Velocities
    _arrow(axes, p, at(1.45, 0), color=COLOURS[1], lw=1.8, mutation_scale=11, zorder=5)
    text(at(0.95, 0.29), "$V_{AV}$", colour=COLOURS[1])
    turn = theta + np.deg2rad(115)
    _arrow(axes, p + 1.25 * along(turn - 0.55), p + 1.25 * along(turn + 0.25), color=COLOURS[1], lw=1.2,
           connectionstyle="arc3,rad=0.2", zorder=5)  # fmt: skip
    text(p + 1.52 * along(turn + 0.2), r"$\dot\theta$", colour=COLOURS[1])
    axes.add_patch(Circle(tuple(p), 0.07, fc="white", ec="black", lw=0.8, zorder=6))
    text(at(-0.27, -0.27), "$P$")
    return figure


@styled
def control_structure() -> Figure:
    """Draws the two-level hierarchy of motion and velocity control (the paper's figure 3)."""
    figure, axes = _canvas(PAGE_WIDTH, PAGE_WIDTH * 82 / 180, (0, 180, 2, 84))  # data in mm
    middle, top = 40, 66

    def rounded(x: float, y: float, width: float, height: float, radius: float, **options: object) -> None:
        """Draws a rounded rectangle whose lower left corner is (x, y)."""
        look: dict[str, Any] = {"boxstyle": f"round,pad=0,rounding_size={radius}", **options}
        axes.add_patch(FancyBboxPatch((x, y), width, height, **look))

    def box(x: float, y: float, width: float, height: float, string: str, colour: str = "white") -> None:
        rounded(x, y - height / 2, width, height, 1.2, fc=colour, ec="black", lw=0.9, zorder=3)
        axes.text(x + width / 2, y, string, ha="center", va="center", zorder=4, linespacing=1.25)

    def text(x: float, y: float, string: str, **options: object) -> None:
        look: dict[str, Any] = {"ha": "center", "va": "bottom", **options}
        axes.text(x, y, string, **look)

    def wire(*points: tuple[float, float], **options: object) -> None:
        """Draws a line through the points, with an arrow head at its end."""
        xs, ys = zip(*points, strict=True)
        look: dict[str, Any] = {"color": "black", "lw": 0.9, **options}
        axes.plot(xs, ys, solid_joinstyle="miter", zorder=2, **look)
        (x0, y0), (x1, y1) = points[-2:]
        step = 2.5 / np.hypot(x1 - x0, y1 - y0)
        start = (x1 - step * (x1 - x0), y1 - step * (y1 - y0))
        _arrow(axes, start, (x1, y1), color=look["color"], lw=0.9, zorder=2)

    def node(x: float, y: float) -> None:
        axes.add_patch(Circle((x, y), 0.75, fc="black", zorder=4))

    def adder(x: float, y: float) -> None:
        axes.add_patch(Circle((x, y), 3, fc="white", ec="black", lw=0.9, zorder=3))
        axes.text(x, y - 0.15, r"$\Sigma$", ha="center", va="center", zorder=4)

    def level(x: float, y: float, width: float, height: float, name: str) -> None:
        rounded(x, y, width, height, 1.5, fc="0.97", ec="0.55", lw=0.7, ls=(0, (4, 2.5)), zorder=0)
        text(x + 1.5, y + height - 1.2, name, ha="left", va="top", color="0.35", style="italic")

    level(30.5, 27, 27, 29.5, "Motion control")
    level(60.5, 27, 73.5, 54, "Velocity control")
    box(2, middle, 18, 14, "Reference\ntrajectory")
    box(33, middle, 22, 16, "Tracking law\n(Kanayama)")
    box(84, middle, 25, 14, "PID\n(feedback)", "#E3EEF6")
    box(84, top, 25, 16, "Neural network\n(feedforward)", "#FBE9DC")
    box(147, middle, 14, 16, "DC\nmotors")
    box(166, middle, 12, 16, "Robot")
    adder(74, middle)
    adder(127, middle)
    # Forward
    wire((20, middle), (33, middle))
    text(25.2, middle + 0.8, r"$\xi_r,\,\eta_r$")
    wire((55, middle), (71, middle))
    text(62.6, middle + 0.8, r"$\eta_c$")
    node(66.5, middle)
    wire((66.5, middle), (66.5, top), (84, top))
    wire((77, middle), (84, middle))
    wire((109, middle), (124, middle))
    text(119.3, middle + 0.8, "$U_{fb}$")
    wire((109, top), (127, top), (127, middle + 3))
    text(118, top + 0.8, "$U_{ff}$")
    wire((130, middle), (147, middle))
    text(140.5, middle + 0.8, "$U_l,\\,U_r$")
    wire((161, middle), (166, middle))
    # Learning: the feedback voltage is the teaching signal
    node(113.5, middle)
    wire((113.5, middle), (113.5, 51.5), (96.5, 51.5), (96.5, top - 8), color=COLOURS[1], ls=(0, (4, 2)))
    text(105.2, 52.2, "learning", color=COLOURS[1], fontsize=8)
    # Back
    wire((170, middle - 8), (170, 18), (74, 18), (74, middle - 3))
    text(122, 18.8, r"velocities $\eta=(V_{AV},\,\dot\theta)$")
    wire((174, middle - 8), (174, 7), (44, 7), (44, middle - 8))
    text(122, 7.8, r"posture $\xi=(x,\,y,\,\theta)$")
    for x, y, sign in ((69.2, 36.5, "+"), (71.9, 34.2, "$-$"), (122.2, 36.5, "+"), (124.9, 44.2, "+")):
        text(x, y, sign, va="center", fontsize=8)
    return figure
