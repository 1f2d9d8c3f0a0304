"""Kanayama's table against theory: the linear equation of the lateral error, and the arc that the limits allow."""

import numpy as np
import pytest

from mrctl.experiments.kanayama import K_Y, SPEED, STEP, Case, measure, paths


def case(k_theta: float, offset: float = 1e-4) -> Case:
    return Case("", "%", 0.0, offset, 0.0, k_theta, False, "overshoot")


@pytest.mark.parametrize("zeta", [0.6, 0.75])
def test_small_overshoot_is_that_of_a_second_order_system(zeta: float) -> None:
    """exp(−πζ/√(1 − ζ²)), for an offset so small that the law is linear."""
    one = case(2 * zeta * np.sqrt(K_Y))
    path = paths([one])[:, 0]
    assert measure(one, path) / 100 == pytest.approx(np.exp(-np.pi * zeta / np.sqrt(1 - zeta**2)), rel=2e-3)


def test_critical_damping_is_the_analytic_curve() -> None:
    """y(t) = y₀ (1 + ξt) exp(−ξt) with ξ = v_r √K_y."""
    one = case(16.0)
    y = paths([one])[:, 0, 1] / one.offset
    t = STEP * np.arange(len(y))
    xi = SPEED * np.sqrt(K_Y)
    np.testing.assert_allclose(y, (1 + xi * t) * np.exp(-xi * t), atol=1e-3)


def test_limited_path_keeps_the_limits() -> None:
    """Speed and rotation never exceed 0.40 m/s and 0.8 rad/s, and reach the latter."""
    limited = Case("", "cm", 0.0, 0.0, np.pi / 2, 16.0, True, "excursion")
    path = paths([limited])[:, 0]
    speed = np.hypot(*np.diff(path[:, :2], axis=0).T) / STEP
    rate = np.abs(np.diff(path[:, 2])) / STEP
    assert speed.max() <= 0.40 + 1e-6
    assert rate.max() == pytest.approx(0.8, rel=1e-6)
