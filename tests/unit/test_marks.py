"""What the viewer draws of an estimate, and of the deviation from the reference."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import chi2

from mrctl.results.dataset import TICK
from mrctl.viewer.deviation import drawn, extent
from mrctl.viewer.sensors import ELLIPSE_SHARE, SIGMAS, ellipse, magnification

SPREAD = st.floats(1e-4, 1.0)


@given(SPREAD, SPREAD, st.floats(-0.99, 0.99), st.floats(0, 6.28))
def test_ellipse(first, second, correlation, turn):
    """A point of the ellipse is three standard deviations away, by the covariance that it was made from."""
    estimate = np.zeros((), TICK)
    mixed = correlation * first * second
    estimate["variance_x"], estimate["covariance_xy"], estimate["variance_y"] = first**2, mixed, second**2
    (a, b), angle = ellipse(estimate)
    at = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]) @ [
        a * np.cos(turn),
        b * np.sin(turn),
    ]
    inverse = np.linalg.inv([[first**2, mixed], [mixed, second**2]])
    assert at @ inverse @ at == pytest.approx(9, rel=1e-4)
    assert a <= b


def test_share():
    """The share of estimates within the ellipse that the page states."""
    assert chi2(2).cdf(SIGMAS**2) == pytest.approx(ELLIPSE_SHARE) == pytest.approx(0.989, abs=5e-4)


def test_magnification():
    """Errors of a motion-capture system are drawn 100 times, of a map 10 times, of dead reckoning as they are."""
    assert [magnification(spread) for spread in (0.003, 0.02, 0.3, np.inf, 0.0)] == [100, 10, 1, 1, 100]


def test_deviation():
    """Robots 20 mm and 1 mm beside the reference are drawn 200 mm and 10 mm beside it, which the view has room for."""
    rows = np.zeros((100, 2), TICK)
    rows["x_ref"] = rows["x"] = np.linspace(0, 1, 100)[:, None]
    rows["y"] = rows["lateral_error"] = [0.020, 0.001]
    rows[-1] = np.nan  # both have stopped
    factor = magnification(extent(rows))
    assert factor == 10
    away = drawn(rows[:-1], factor) - drawn(rows[:-1], 0)
    np.testing.assert_allclose(away, np.broadcast_to([[0, 0.2], [0, 0.01]], (99, 2, 2)), atol=1e-12)
    assert extent(rows[:0]) == extent(rows[-1:]) == 0
