"""Planar quintic splines by arc length, through points or through points and back to the first."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from mrctl.kernel import Array

Plane = NDArray[np.complexfloating]

KEPT = 2048
"""Number of curves that are kept, with 40 kB each: sweeps and comparisons ask for each of theirs repeatedly."""

# Gauss-Legendre quadrature on (0, 1) for the arc length of a piece, exact to rounding.
_PIECE_NODES, _PIECE_WEIGHTS = (np.polynomial.legendre.leggauss(6) + np.array([[1], [0]])) / 2


def plane(points: tuple[tuple[float, float], ...], closed: bool) -> Plane:
    """Returns the points as complex numbers in m, with the first one again at the end of a closed curve."""
    return np.array([complex(*point) for point in (*points, *points[: int(closed)])])


def _end(chord: complex, curvature: float, side: int) -> list[tuple[int, Array]]:
    """Returns the derivatives that determine an open spline at its start (side −1) or end (1), by their order.

    Args:
        chord: From the first point there to the second, x + i y in m.
        curvature: Curvature of the arc over the chord in 1/m; 0 for an end without curvature and sharpness.
        side: Which end.
    """
    if not curvature:
        return [(2, np.zeros(2)), (3, np.zeros(2))]
    half = np.arcsin(curvature * abs(chord) / 2)  # angle between chord and tangent
    tangent = chord / abs(chord) * np.exp(1j * side * half)
    return [(n, np.array([d.real, d.imag])) for n, d in ((1, tangent), (2, 1j * curvature * tangent))]


class Spline:
    """A planar quintic spline by arc length s; its own parameter u is the accumulated chord length, both in m."""

    def __init__(
        self, points: tuple[tuple[float, float], ...], closed: bool, curvatures: tuple[float, float] = (0.0, 0.0)
    ) -> None:
        """Interpolates points.

        An open spline has no curvature and no sharpness at its ends, or the tangent and the curvature of an arc through
        the two points there.

        Args:
            points: Points (x, y) in m in their order, no two neighbours alike.
            closed: Whether the curve goes on from the last point to the first.
            curvatures: Curvatures of the arcs at either end of an open curve in 1/m, positive to the left; 0 for none.
                Each times its chord is less than 2.
        """
        from scipy.interpolate import make_interp_spline  # imported here, so that settings are read without scipy

        p = plane(points, closed)
        knots = np.append(0, np.cumsum(np.abs(np.diff(p))))
        ends = "periodic" if closed else tuple(map(_end, (p[1] - p[0], p[-1] - p[-2]), curvatures, (-1, 1)))
        curve = make_interp_spline(knots, np.stack([p.real, p.imag], -1), k=5, bc_type=ends)  # type: ignore[arg-type]
        self.curves = [curve, *(curve.derivative(n) for n in (1, 2, 3))]
        self.u = np.append(np.linspace(knots[:-1], knots[1:], 64, endpoint=False).T, knots[-1])
        self.s = np.append(0, np.cumsum(self.arc(self.u[:-1], self.u[1:])))
        self.length = float(self.s[-1])
        self.heading = np.unwrap(np.angle(self.derivative(self.u, 1)))
        self.closed = closed

    @cached_property
    def parameter(self) -> Callable[[Array], Array]:
        """Approximation of u(s), whose error falls with the fourth power of the length of a piece."""
        from scipy.interpolate import CubicHermiteSpline

        return CubicHermiteSpline(self.s, self.u, 1 / np.abs(self.derivative(self.u, 1)))

    def derivative(self, u: Array, n: int) -> Plane:
        """Returns the n-th derivative of x + i y with respect to u, for n = 0 to 3."""
        x, y = np.moveaxis(self.curves[n](u), -1, 0)
        return x + 1j * y

    @cached_property
    def slowest(self) -> tuple[float, complex]:
        """The least |dp/du| of the curve, also between the samples, and x + i y in m of the place."""

        def falls(u: Array) -> NDArray[np.bool]:  # the sign of d|dp/du|²/du
            return (np.conj(self.derivative(u, 1)) * self.derivative(u, 2)).real < 0

        falling = falls(self.u)
        (valley,) = np.nonzero(falling[:-1] & ~falling[1:])
        low, high = self.u[valley], self.u[valley + 1]
        for _ in range(12):  # bisections
            middle = (low + high) / 2
            before = falls(middle)
            low, high = np.where(before, middle, low), np.where(before, high, middle)
        u = np.append(self.u, low)
        slow = np.abs(self.derivative(u, 1))
        return float(slow.min()), complex(self.derivative(u, 0)[slow.argmin()])

    def arc(self, start: Array, end: Array) -> Array:
        """Returns the arc length in m from u = start to u = end, shape (T,); both lie within one piece."""
        u = start[:, None] + (end - start)[:, None] * _PIECE_NODES
        return (end - start) * (np.abs(self.derivative(u, 1)) @ _PIECE_WEIGHTS)

    def at(self, s: Array) -> tuple[Plane, Array, Array, Array]:
        """Returns position in m, heading in rad, curvature in 1/m and sharpness in 1/m² at the arc lengths s in m.

        All have the shape (T,).
        """
        lap, s = np.divmod(s, self.length) if self.closed else (np.zeros(s.shape), np.minimum(s, self.length))
        piece = np.clip(np.searchsorted(self.s, s, side="right") - 1, 0, len(self.s) - 2)
        u = self.parameter(s)
        # One step of Newton's method reduces the error of `parameter` to rounding.
        u = u - (self.s[piece] + self.arc(self.u[piece], u) - s) / np.abs(self.derivative(u, 1))
        p, d1, d2, d3 = (self.derivative(u, n) for n in range(4))
        log, step = d2 / d1, np.abs(d1)
        sharpness = ((d3 / d1 - log**2).imag - log.imag * log.real) / step**2
        # The tabulated heading selects the branch of the exact one.
        near, exact = np.interp(u, self.u, self.heading), np.angle(d1)
        heading = exact + 2 * np.pi * np.round((near - exact) / (2 * np.pi))
        return p, heading + lap * (self.heading[-1] - self.heading[0]), log.imag / step, sharpness


spline = lru_cache(maxsize=KEPT)(Spline)
"""The spline through points, as `Spline` makes it; the `KEPT` used last are kept."""
