"""The linearised channels: their limits, equation (3) by finite differences, and SciPy's discretisation."""

import numpy as np
import pytest
from scipy import signal

from mrctl.theory import linear
from mrctl.theory.dynamics import accelerations, left_right
from mrctl.theory.robot import Robot

FORK = {"steering_stiffness": 2.0, "steering_damping": 0.1, "fork_inertia": 1.8e-3, "fork_moment": 0.026}
W = np.geomspace(0.1, 300, 200)


def with_fork(robot, **changes):
    return Robot.from_dict(robot.model_dump() | FORK | changes)


@pytest.mark.parametrize("h", [0.01, 0.002])
def test_common_and_yaw_at_rest_are_equation_3(robot, h):
    """Without a fork and at rest the plants are K/(τ s + 1) with K and τ of equation (3), to the last digit."""
    for plant, gain, tau in (
        (linear.common(robot), robot.velocity_gain, robot.velocity_time_constant),
        (linear.yaw(robot, 0.0), robot.rotation_gain, robot.rotation_time_constant),
    ):
        np.testing.assert_allclose([plant.gain, plant.lag], [gain, tau], rtol=1e-14)
        a = np.exp(-h / tau)
        expected = gain * (1 - a) / (np.exp(1j * W * h) - a)
        np.testing.assert_allclose(plant.response(W, h), expected, rtol=1e-12)


def test_a_fork_without_forces_is_no_fork(robot):
    """A fork that neither springs back, resists nor weighs anything leaves equation (3) alone."""
    free = with_fork(robot, steering_stiffness=0, steering_damping=0, fork_inertia=1e-12, fork_moment=0)
    for speed in (0.2, 1.5):
        expected = linear.yaw(robot, speed)
        found = linear.yaw(free, speed)
        np.testing.assert_allclose([found.gain, found.lag], [expected.gain, expected.lag], rtol=1e-6)
        np.testing.assert_allclose(found.response(W, 0.01), expected.response(W, 0.01), rtol=1e-6)


@pytest.mark.parametrize("speed", [0.3, 1.4])
def test_linearised(robot, speed):
    """Without a fork the plants are the derivatives of the non-linear equation (3), driving straight on."""
    step = 1e-5
    for channel, plant in enumerate((linear.common(robot), linear.yaw(robot, speed))):
        unit = np.eye(2)[channel]

        def rate(x, u, unit=unit, channel=channel):
            twist = np.array([speed, 0]) + x * unit
            return accelerations(twist, left_right(np.array([10.0, 0]) + u * unit), robot)[channel]

        slope = (rate(step, 0) - rate(-step, 0)) / (2 * step)
        push = (rate(0, step) - rate(0, -step)) / (2 * step)
        np.testing.assert_allclose([plant.a[0, 0], plant.b[0]], [slope, push], rtol=1e-6)


@pytest.mark.parametrize("speed", [0.3, 0.75, 1.4])
def test_fork_in_a_steady_turn(robot, speed):
    """The moments about P balance: motors, centrifugal force of the masses, and the tyre that the servo holds."""
    fork = with_fork(robot)
    angle = (fork.wheelbase - fork.trail) / speed  # per rad/s
    side = (fork.fork_moment * speed - fork.steering_stiffness * angle) / fork.trail
    drag = fork.effective_inertia / fork.rotation_time_constant
    resisting = drag + fork.mass * fork.com_offset * speed - (fork.wheelbase - fork.trail) * side
    assert linear.yaw(fork, speed).gain == pytest.approx(drag * fork.rotation_gain / resisting, rel=1e-9)
    assert linear.yaw(fork, speed).gain < 0.5 * linear.yaw(robot, speed).gain


def test_stiffer_is_slower(robot):
    """Every further N·m/rad of the fork takes a part of the gain, most of it at low speed."""
    gains = [
        [linear.yaw(with_fork(robot, steering_stiffness=k), v).gain for k in (0, 0.5, 2, 10)] for v in (0.2, 0.6, 1.4)
    ]
    assert (np.diff(gains, axis=1) < 0).all() and (np.diff(gains, axis=0)[:, 2:] > 0).all()


@pytest.mark.parametrize("delivered", ["yaw", "steering"])
def test_response(robot, delivered):
    """The response behind the hold is that of SciPy's discretisation."""
    stiff = with_fork(robot, steering_stiffness=40, steering_damping=1, fork_inertia=1.15e-3)
    plant = linear.yaw(with_fork(robot), 0.8) if delivered == "yaw" else linear.steering(stiff)
    n, h = len(plant.b), 0.01
    discrete = signal.cont2discrete((plant.a, plant.b[:, None], np.eye(n)[:1], np.zeros((1, 1))), h)[:4]
    numerator, denominator = signal.ss2tf(*discrete)
    z = np.exp(1j * W * h)
    expected = np.polyval(numerator[0], z) / np.polyval(denominator, z)
    np.testing.assert_allclose(plant.response(W, h), expected, rtol=1e-7)


def test_steering_is_servo_and_tyre(robot):
    """A stiff servo is k/(J s² + d s + k) and the tyre 1/(T s + 1), which together lag by d/k + T."""
    stiff = with_fork(robot, steering_stiffness=40, steering_damping=1, fork_inertia=1.15e-3)
    plant = linear.steering(stiff)
    assert plant.gain == pytest.approx(1, abs=1e-12)
    assert plant.lag == pytest.approx(1 / 40 + linear.TYRE_LAG, rel=1e-12)
    servo = [40 / 1.15e-3], [1, 1 / 1.15e-3, 40 / 1.15e-3]
    _, expected = signal.freqs(servo[0], np.polymul(servo[1], [linear.TYRE_LAG, 1]), W)
    found = np.linalg.solve(1j * W[:, None, None] * np.eye(3) - plant.a, plant.b[:, None])[:, 0, 0]
    np.testing.assert_allclose(found, expected, rtol=1e-9)
    assert linear.steering(robot).lag == pytest.approx(linear.TYRE_LAG)
