"""Kanayama's table against theory: the linear equation of the lateral error, and the arc that the limits allow."""

import numpy as np
import pytest

from mrctl.experiments.kanayama import K_Y, SPEED, STEP, Case, measure, paths

pytestmark = pytest.mark.xdist_group("kanayama_table")  # what its tests share is made once


def case(k_theta: float, offset: float = 1e-4) -> Case:
    return Case("", "%", 0.0, offset, 0.0, k_theta, False, "overshoot")


SMALL = {zeta: case(2 * zeta * np.sqrt(K_Y)) for zeta in (0.6, 0.75)}
CRITICAL = case(16.0)
LIMITED = Case("", "cm", 0.0, 0.0, np.pi / 2, 16.0, True, "excursion")


@pytest.fixture(scope="module")
def driven() -> dict[Case, np.ndarray]:
    """The postures of every case, which are independent rows of one computation."""
    cases = [*SMALL.values(), CRITICAL, LIMITED]
    return dict(zip(cases, paths(cases).swapaxes(0, 1), strict=True))


@pytest.mark.parametrize("zeta", SMALL)
def test_small_overshoot_is_that_of_a_second_order_system(zeta: float, driven: dict[Case, np.ndarray]) -> None:
    """exp(−πζ/√(1 − ζ²)), for an offset so small that the law is linear."""
    one = SMALL[zeta]
    assert measure(one, driven[one]) / 100 == pytest.approx(np.exp(-np.pi * zeta / np.sqrt(1 - zeta**2)), rel=2e-3)


def test_critical_damping_is_the_analytic_curve(driven: dict[Case, np.ndarray]) -> None:
    """y(t) = y₀ (1 + ξt) exp(−ξt) with ξ = v_r √K_y."""
    y = driven[CRITICAL][:, 1] / CRITICAL.offset
    t = STEP * np.arange(len(y))
    xi = SPEED * np.sqrt(K_Y)
    np.testing.assert_allclose(y, (1 + xi * t) * np.exp(-xi * t), atol=1e-3)


def test_limited_path_keeps_the_limits(driven: dict[Case, np.ndarray]) -> None:
    """Speed and rotation never exceed 0.40 m/s and 0.8 rad/s, and reach the latter."""
    path = driven[LIMITED]
    speed = np.hypot(*np.diff(path[:, :2], axis=0).T) / STEP
    rate = np.abs(np.diff(path[:, 2])) / STEP
    assert speed.max() <= 0.40 + 1e-6
    assert rate.max() == pytest.approx(0.8, rel=1e-6)
