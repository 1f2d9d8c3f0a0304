"""The sensors show the controller the truth to the bit, or odometry that integrates as it should, and slip."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from mrctl.kernel import over_rows
from mrctl.physics.plant import PLANT
from mrctl.sensing.sensors import SEEN, Sensors, observe
from mrctl.sensing.slip import SLIP_FILTER, slip_ratio


def numbers(*shape, bound=5.0):
    return arrays(float, shape, elements=st.floats(-bound, bound))


def records(size, **fields):
    """Returns `size` records of `SEEN` with these fields; `speed` in m/s is what the encoders show of V, `(B,)`."""
    seen = np.zeros(size, SEEN)
    if "speed" in fields:
        seen["wheel_speeds"] = np.reshape(fields.pop("speed"), (-1, 1))
    for name, value in fields.items():
        seen[name] = value
    return seen


def circle(start, v, omega, time):
    """Returns the pose after `time` at a constant twist, computed with complex numbers."""
    p = complex(*start[:2]) + v / (1j * omega) * np.exp(1j * start[2]) * (np.exp(1j * omega * time) - 1)
    return np.array([p.real, p.imag, start[2] + omega * time])


def dead_reckoning(start, v, omega, duration, period, noise=(0, 0, 0, 0, 0), shown=None):
    """Returns odometry's last pose at a constant twist for which the encoders show the speed `shown`."""
    shown = v if shown is None else shown
    twist = shown + noise[3], omega + noise[4]
    s = records(1, pose=start, twist=twist, odometry=True, noise=noise, speed=shown, elapsed=period)[0]
    lost = np.full(3, np.nan)  # odometry never looks at the true pose
    for _ in range(round(duration / period)):
        observe(lost, np.array([v, omega]), s)
    return s["pose"]


@given(numbers(4, 3), numbers(4, 2), numbers(4, 3))
def test_truth(true_pose, true_twist, before):
    """Without noise the truth passes to the bit, whatever was measured before and whatever the encoders show."""
    seen = records(4, pose=before, twist=1.0, speed=99.0, elapsed=0.01)
    over_rows(observe, true_pose, true_twist, seen)
    np.testing.assert_array_equal(seen["pose"], true_pose)
    np.testing.assert_array_equal(seen["twist"], true_twist)


@given(numbers(4, 3), numbers(4, 2), numbers(4, 5, bound=0.1))
def test_noise(true_pose, true_twist, noise):
    """Each sample of the noise is added to its own signal."""
    seen = records(4, noise=noise, elapsed=0.01)
    over_rows(observe, true_pose, true_twist, seen)
    measured = np.hstack([seen["pose"], seen["twist"]])
    np.testing.assert_array_equal(measured, np.hstack([true_pose, true_twist]) + noise)


def test_odometry_order():
    """At a constant twist the heading is exact, and half the period makes the position error a quarter."""
    start, exact = [0.3, -0.2, 0.5], circle([0.3, -0.2, 0.5], 0.8, 1.3, 2.0)
    errors = [dead_reckoning(start, 0.8, 1.3, 2.0, h) - exact for h in (0.2, 0.1, 0.05, 0.01)]
    sizes = [np.hypot(*error[:2]) for error in errors]
    assert sizes[0] / sizes[1] == pytest.approx(4, rel=0.02)
    assert sizes[1] / sizes[2] == pytest.approx(4, rel=0.01)
    assert sizes[-1] < 1e-4
    np.testing.assert_allclose([error[2] for error in errors], 0, atol=1e-12)


def test_odometry_of_a_varying_twist():
    """Odometry takes a changing twist at the middle of the period, so it is of second order there too."""

    def end(h):
        s = records(1, twist=(0.5, 0.0), odometry=True, elapsed=h)[0]
        for t in h * np.arange(1, round(2 / h) + 1):
            v, omega = 0.5 + 0.4 * np.sin(2 * t), np.sin(3 * t)
            s["wheel_speeds"] = v
            observe(np.zeros(3), np.array([9.0, omega]), s)
        return s["pose"]

    exact = end(1e-4)
    errors = [np.abs(end(h) - exact).max() for h in (0.1, 0.05)]
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.1)
    assert exact[2] == pytest.approx((1 - np.cos(6)) / 3, abs=1e-7)


@pytest.mark.parametrize("factor", [0.95, 1.05])
def test_wrong_wheel_radius(factor):
    """With encoders that show 5 % too much, odometry has the same turns and a path that is 5 % too large."""
    start = np.array([1.0, 2.0, 0.4])
    true = dead_reckoning(start, 0.8, 1.3, 3.0, 0.01)
    seen = dead_reckoning(start, 0.8, 1.3, 3.0, 0.01, shown=0.8 * factor)
    np.testing.assert_allclose(seen[:2] - start[:2], factor * (true - start)[:2], atol=1e-12)
    assert seen[2] == true[2]


def test_odometry_noise():
    """Only the noise of encoders and gyro reaches odometry, which integrates it."""
    biased = dead_reckoning([0, 0, 0], 0.8, 1.3, 1.0, 0.01, noise=(9, 9, 9, 0.05, -0.1))
    np.testing.assert_allclose(biased, dead_reckoning([0, 0, 0], 0.85, 1.2, 1.0, 0.01), atol=1e-12)


@given(
    numbers(4, 3), numbers(4, 2), numbers(4, 5), arrays(bool, 4), numbers(4), numbers(4, 3), numbers(4, 2),
)  # fmt: skip
def test_rows(true_pose, true_twist, noise, odometry, speed, pose, twist):
    """Robots do not mix: a row has the same bits alone and beside others, one of which has no finite twist."""

    def answer(rows, lost=()):
        fields = {"noise": noise, "odometry": odometry, "speed": speed, "pose": pose, "twist": twist}
        chosen = {name: values[rows] for name, values in fields.items()}
        seen = records(len(chosen["pose"]), elapsed=0.01, **chosen)
        true = true_twist[rows].copy()
        true[list(lost)] = np.nan
        over_rows(observe, true_pose[rows], true, seen)
        return np.hstack([seen["pose"], seen["twist"]])

    together = answer(slice(None), lost=[1])
    for i in (0, 2, 3):
        assert together[i].tobytes() == answer(slice(i, i + 1))[0].tobytes()


def test_start(robot):
    """The first measurement is the true posture for odometry too, which integrates from the second one on."""
    start, v, omega, period = np.array([0.3, -0.2, 0.5]), 0.8, 1.3, 0.01
    plant = np.zeros(2, PLANT)
    reading = plant["reading"]
    reading["pose"], reading["twist"] = start, (v, omega)
    reading["wheel_rates"] = (v + np.array([-1, 1]) * robot.half_track * omega) / robot.wheel_radius
    sensors = Sensors([True, False], [0, 1], robot, period)
    sensors.start(reading)
    assert np.array_equal(sensors.measure(plant)["pose"], [start, start])
    seen = sensors.measure(plant)
    np.testing.assert_allclose(seen["pose"], [circle(start, v, omega, period), start], atol=1e-6)
    np.testing.assert_allclose(seen["twist"], [(v, omega)] * 2, atol=1e-12)
    sensors.restart(0, 0, reading)
    assert np.array_equal(sensors.measure(plant)["pose"], [start, start])


def slip_of(wheels, twist, ticks=400):
    """Returns the slip ratio after a slip has lasted for some ticks."""
    slip = 0.0
    for _ in range(ticks):
        slip = slip_ratio(np.array(wheels, float), np.array(twist, float), 0.2, 0.01, slip)
    return slip


@given(numbers(2))
def test_rolling_is_no_slip(twist):
    """Wheels that turn as fast as the floor passes below them do not slip, at any twist."""
    v, omega = twist
    assert slip_of([v - 0.2 * omega, v + 0.2 * omega], twist) == pytest.approx(0, abs=1e-12)


def test_slip_ratio():
    """The slip ratio shows driving and braking of either wheel in both directions, and hardly shows noise at rest."""
    for sign in (1, -1):
        assert slip_of([sign * 1.0, sign * 1.25], [sign * 1.0, 0.0]) == pytest.approx(0.2)
        assert slip_of([sign * 0.8, sign * 1.0], [sign * 1.0, 0.0]) == pytest.approx(0.2)
    assert slip_of([0.8, 1.2], [1.0, 0.0]) == pytest.approx(0.2)  # a robot that does not turn as its wheels do
    assert slip_of([0.015, 0.0], [0.0, 0.0]) == pytest.approx(0.05)


def test_slip_lasts():
    """A slip that has ended fades with the filter's time constant."""
    slip = 1.0
    for _ in range(round(SLIP_FILTER / 0.001)):
        slip = slip_ratio(np.ones(2), np.array([1.0, 0.0]), 0.2, 0.001, slip)
    assert slip == pytest.approx(np.exp(-1), rel=0.01)
