"""What the controller is shown: the truth to the bit, or odometry that integrates as it should."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from mrctl.sensing.sensors import SLIP_FILTER, observe, watch_slip


def numbers(*shape, bound=5.0):
    return arrays(float, shape, elements=st.floats(-bound, bound))


def circle(start, v, omega, time):
    """The pose after `time` at a constant twist, in complex numbers."""
    p = complex(*start[:2]) + v / (1j * omega) * np.exp(1j * start[2]) * (np.exp(1j * omega * time) - 1)
    return np.array([p.real, p.imag, start[2] + omega * time])


def dead_reckoning(start, v, omega, duration, period, noise=(0, 0, 0, 0, 0), shown=None):
    """Odometry's last pose at a constant twist whose encoders show the speed `shown`."""
    shown = v if shown is None else shown
    pose, twist = np.array(start, float), np.array([shown + noise[3], omega + noise[4]])
    lost = np.full(3, np.nan)  # odometry never looks at the true pose
    for _ in range(round(duration / period)):
        observe(lost, np.array([v, omega]), np.array(noise, float), 1.0, shown, period, pose, twist)
    return pose


@given(numbers(4, 3), numbers(4, 2), numbers(4, 3))
def test_truth(true_pose, true_twist, before):
    """Without noise the truth passes to the bit, whatever was measured before and the encoders say."""
    pose, twist = before.copy(), np.ones((4, 2))
    observe(true_pose, true_twist, np.zeros((4, 5)), 0.0, 99.0, 0.01, pose, twist)
    np.testing.assert_array_equal(pose, true_pose)
    np.testing.assert_array_equal(twist, true_twist)


@given(numbers(4, 3), numbers(4, 2), numbers(4, 5, bound=0.1))
def test_noise(true_pose, true_twist, noise):
    """Noise is added, each sample to its own signal."""
    pose, twist = np.zeros((4, 3)), np.zeros((4, 2))
    observe(true_pose, true_twist, noise, 0.0, 0.0, 0.01, pose, twist)
    np.testing.assert_array_equal(np.hstack([pose, twist]), np.hstack([true_pose, true_twist]) + noise)


def test_odometry_order():
    """At a constant twist the heading is exact and the position wrong by a quarter as much at half the period."""
    start, exact = [0.3, -0.2, 0.5], circle([0.3, -0.2, 0.5], 0.8, 1.3, 2.0)
    errors = [dead_reckoning(start, 0.8, 1.3, 2.0, h) - exact for h in (0.2, 0.1, 0.05, 0.01)]
    sizes = [np.hypot(*error[:2]) for error in errors]
    assert sizes[0] / sizes[1] == pytest.approx(4, rel=0.02)
    assert sizes[1] / sizes[2] == pytest.approx(4, rel=0.01)
    assert sizes[-1] < 1e-4
    np.testing.assert_allclose([error[2] for error in errors], 0, atol=1e-12)


def test_odometry_of_a_varying_twist():
    """A twist that changes is taken at the middle of the period: second order too."""

    def end(h):
        pose, twist = np.zeros(3), np.array([0.5, 0.0])
        for t in h * np.arange(1, round(2 / h) + 1):
            v, omega = 0.5 + 0.4 * np.sin(2 * t), np.sin(3 * t)
            observe(np.zeros(3), np.array([9.0, omega]), np.zeros(5), 1.0, v, h, pose, twist)
        return pose

    exact = end(1e-4)
    errors = [np.abs(end(h) - exact).max() for h in (0.1, 0.05)]
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.1)
    assert exact[2] == pytest.approx((1 - np.cos(6)) / 3, abs=1e-7)


@pytest.mark.parametrize("factor", [0.95, 1.05])
def test_wrong_wheel_radius(factor):
    """Encoders that show 5 % too much see the same turns on a path that is 5 % too large."""
    start = np.array([1.0, 2.0, 0.4])
    true = dead_reckoning(start, 0.8, 1.3, 3.0, 0.01)
    seen = dead_reckoning(start, 0.8, 1.3, 3.0, 0.01, shown=0.8 * factor)
    np.testing.assert_allclose(seen[:2] - start[:2], factor * (true - start)[:2], atol=1e-12)
    assert seen[2] == true[2]


def test_odometry_noise():
    """Of the noise only that on encoders and gyro reaches odometry, and it integrates."""
    biased = dead_reckoning([0, 0, 0], 0.8, 1.3, 1.0, 0.01, noise=(9, 9, 9, 0.05, -0.1))
    np.testing.assert_allclose(biased, dead_reckoning([0, 0, 0], 0.85, 1.2, 1.0, 0.01), atol=1e-12)


@given(
    numbers(4, 3), numbers(4, 2), numbers(4, 5), arrays(float, 4, elements=st.sampled_from([0.0, 1.0])), numbers(4),
    numbers(4, 3), numbers(4, 2),
)  # fmt: skip
def test_rows(true_pose, true_twist, noise, odometry, speed, pose, twist):
    """Robots do not mix: a row has the same bits alone and beside others, one of which is lost."""

    def answer(rows, lost=()):
        inputs = [a[rows].copy() for a in (true_pose, true_twist, noise, odometry, speed)]
        shown = [a[rows].copy() for a in (pose, twist)]
        inputs[1][list(lost)] = np.nan
        observe(*inputs, 0.01, *shown)
        return np.hstack(shown)

    together = answer(slice(None), lost=[1])
    for i in (0, 2, 3):
        assert together[i].tobytes() == answer(slice(i, i + 1))[0].tobytes()


def slip_of(wheels, twist, ticks=400):
    """What is seen of a slip that lasts."""
    seen = np.zeros(1)
    for _ in range(ticks):
        watch_slip(np.array(wheels, float), np.array(twist, float), 0.2, 0.01, seen)
    return seen[0]


@given(numbers(2))
def test_rolling_is_no_slip(twist):
    """Wheels that turn as the motion carries them do not slip, whichever way it goes."""
    v, omega = twist
    assert slip_of([v - 0.2 * omega, v + 0.2 * omega], twist) == pytest.approx(0, abs=1e-12)


def test_slip_ratio():
    """The field's slip ratio, driving and braking, of either wheel, forwards and backwards; not of noise at rest."""
    for sign in (1, -1):
        assert slip_of([sign * 1.0, sign * 1.25], [sign * 1.0, 0.0]) == pytest.approx(0.2)
        assert slip_of([sign * 0.8, sign * 1.0], [sign * 1.0, 0.0]) == pytest.approx(0.2)
    assert slip_of([0.8, 1.2], [1.0, 0.0]) == pytest.approx(0.2)  # a robot that does not turn as its wheels do
    assert slip_of([0.015, 0.0], [0.0, 0.0]) == pytest.approx(0.05)


def test_slip_lasts():
    """A slip that has ended fades with the filter's time constant."""
    seen = np.array([1.0])
    for _ in range(round(SLIP_FILTER / 0.001)):
        watch_slip(np.ones(2), np.array([1.0, 0.0]), 0.2, 0.001, seen)
    assert seen[0] == pytest.approx(np.exp(-1), rel=0.01)
