"""Equations (1) and (2) against rigid-body geometry: the velocity of each wheel's contact point on the floor."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mrctl.theory import kinematics as k

RNG = np.random.default_rng(0)
STATES = RNG.uniform(-1.3, 1.3, (40, 7))
INPUTS = RNG.uniform(-2, 2, (40, 2))
TWISTS = RNG.uniform([-2, -3], [2, 3], (40, 2))


def contact_velocity(twist, point):
    """Velocity of a point of the chassis, in the body frame, as a complex number: V + iω(x + iy)."""
    v, omega = np.moveaxis(twist, -1, 0)
    return v + 1j * omega * point


def test_pose_rates_agree(robot):
    """The pose in (1) moves as (2) says for the twist of the front wheel."""
    twist = k.twist_from_front_wheel(INPUTS[:, 0], STATES[:, 3], robot)
    rates = k.pose_rates(STATES[:, :3], twist)
    np.testing.assert_allclose(k.state_rates(STATES, INPUTS, robot)[:, :3], rates, atol=1e-14)
    velocity = twist[:, 0] * np.exp(1j * STATES[:, 2])
    np.testing.assert_allclose(rates[:, 0] + 1j * rates[:, 1], velocity, atol=1e-14)


@pytest.mark.parametrize("wheel", ["front", "left", "right"])
def test_rolling(robot, wheel):
    """Under (1) no wheel slips: across it the contact is still, along it the wheel's rate covers the ground."""
    phi = STATES[:, 3]
    point, direction, radius, index = {
        "front": (robot.wheelbase, np.exp(1j * phi), robot.front_wheel_radius, 4),
        "left": (1j * robot.half_track, 1.0, robot.wheel_radius, 5),
        "right": (-1j * robot.half_track, 1.0, robot.wheel_radius, 6),
    }[wheel]
    rates = k.state_rates(STATES, INPUTS, robot)
    body = (rates[:, 0] + 1j * rates[:, 1]) * np.exp(-1j * STATES[:, 2])
    along = (body + 1j * rates[:, 2] * point) / direction
    np.testing.assert_allclose(along.imag, 0, atol=1e-13)
    np.testing.assert_allclose(along.real, radius * rates[:, index], atol=1e-13)


def test_steering_input(robot):
    """u₂ turns the front wheel and nothing else; u₁ is its ground speed."""
    turned = k.state_rates(STATES, INPUTS + [0, 1], robot) - k.state_rates(STATES, INPUTS, robot)
    np.testing.assert_allclose(turned, np.eye(7)[3] * np.ones((40, 1)), atol=1e-14)


def test_circle(robot):
    """With the front wheel held, P drives round a circle of radius L / tan φ and comes back (RK4)."""
    phi, u = 0.4, np.array([0.5, 0.0])
    state = np.array([0, 0, 0, phi, 0, 0, 0.0])
    steps = 400
    h = 2 * np.pi * robot.wheelbase / (np.sin(phi) * u[0]) / steps
    path = [state]
    for _ in range(steps):
        a = k.state_rates(state, u, robot)
        b = k.state_rates(state + h / 2 * a, u, robot)
        c = k.state_rates(state + h / 2 * b, u, robot)
        state = state + h / 6 * (a + 2 * b + 2 * c + k.state_rates(state + h * c, u, robot))
        path.append(state)
    path, radius = np.array(path), robot.wheelbase / np.tan(phi)
    np.testing.assert_allclose(np.hypot(path[:, 0], path[:, 1] - radius), radius, rtol=1e-8)
    np.testing.assert_allclose(path[-1, :3], [0, 0, 2 * np.pi], atol=1e-8)
    assert path[steps // 4, 1] > 0 and path[-1, 6] > path[-1, 5]  # to the left, on the right wheel


def test_printed_is_mirrored(robot):
    """The printed (1) is the corrected one in clockwise θ and φ, apart from the front wheel's radius."""
    clockwise = np.array([1, 1, -1, -1, 1, 1, 1])
    printed = k.state_rates_as_printed(clockwise * STATES, [1, -1] * INPUTS, robot)
    corrected = clockwise * k.state_rates(STATES, INPUTS, robot)
    corrected[:, 4] *= robot.front_wheel_radius / robot.wheel_radius
    np.testing.assert_allclose(printed, corrected, atol=1e-14)


def test_printed_contradicts_2(robot):
    """Taken counter-clockwise, as (2) and (3) are, the printed (1) drives y and the rear wheels the wrong way."""
    state, u = np.array([0, 0, 0.5, 0.3, 0, 0, 0]), [1.0, 0.0]
    printed, corrected = k.state_rates_as_printed(state, u, robot), k.state_rates(state, u, robot)
    assert printed[1] == pytest.approx(-corrected[1]) and corrected[1] > 0
    np.testing.assert_allclose(printed[[5, 6]], corrected[[6, 5]])
    assert printed[2] == corrected[2] > 0


def test_wheel_rates(robot):
    """The rear wheels cover the ground under them."""
    rates = k.wheel_rates(TWISTS, robot)
    points = 1j * robot.half_track * np.array([1, -1])
    ground = np.stack([contact_velocity(TWISTS, point).real for point in points], axis=-1)
    np.testing.assert_allclose(robot.wheel_radius * rates, ground, atol=1e-14)


def test_steering_angle(robot):
    """The front axle does not move across the wheel, forward and in reverse; it undoes `twist_from_front_wheel`."""
    phi = k.steering_angle(TWISTS, robot)
    across = contact_velocity(TWISTS, robot.wheelbase) * np.exp(-1j * phi)
    np.testing.assert_allclose(across.imag, 0, atol=1e-13)
    assert np.all(np.sign(across.real) == np.sign(TWISTS[:, 0]))
    np.testing.assert_allclose(k.twist_from_front_wheel(across.real, phi, robot), TWISTS, atol=1e-13)


def test_scrub_free_angle(robot):
    """The contact behind the steering axis does not move across the wheel, forward and in reverse."""
    phi = k.scrub_free_angle(TWISTS, robot)
    wheel = np.exp(1j * phi)
    across = contact_velocity(TWISTS, robot.wheelbase - robot.trail * wheel) / wheel
    np.testing.assert_allclose(across.imag, 0, atol=1e-13)
    assert np.all(np.sign(across.real) == np.sign(TWISTS[:, 0]))


def test_scrub_free_no_trail(robot):
    """Without trail it is the textbook angle; with 3 cm, L / tan φ is 8 to 10 % off at R = 0.5 to 2 m."""
    bare = robot.model_copy(update={"trail": 0.0})
    np.testing.assert_array_equal(k.scrub_free_angle(TWISTS, bare), k.steering_angle(TWISTS, bare))
    radius = np.array([0.5, 2.0])
    printed = robot.wheelbase / np.tan(k.scrub_free_angle(k.stack(1.0, 1 / radius), robot))
    np.testing.assert_allclose(printed / radius - 1, [0.10, 0.08], atol=0.005)


@given(st.floats(0.1, 2), st.sampled_from([-1, 1]), st.floats(-1, 1), st.floats(0, 0.05))
def test_scrub_free_rotation(robot, speed, sense, angle, trail):
    """At the θ̇ of a held wheel the contact behind the steering axis moves along the wheel only."""
    twist = sense * speed, k.scrub_free_rotation(sense * speed, angle, robot.wheelbase, trail)
    velocity = contact_velocity(twist, robot.wheelbase - trail * np.exp(1j * angle)) / np.exp(1j * angle)
    assert velocity.imag == pytest.approx(0, abs=1e-12)
    trailing = robot.model_copy(update={"trail": trail})
    assert k.scrub_free_angle(twist, trailing) == pytest.approx(angle, abs=1e-9)


@given(st.floats(-1e3, 1e3), st.floats(-1e3, 1e3))
def test_angles_finite(robot, v, omega):
    """The angles are never NaN, and a turn the other way mirrors them."""
    for law in (k.steering_angle, k.scrub_free_angle):
        angle = law([v, omega], robot)
        assert abs(angle) <= np.pi / 2
        assert law([v, -omega], robot) == -angle


def test_angles_at_rest(robot):
    """At rest, also with a negative zero, both angles are 0."""
    rest = np.array([[0.0, 0.0], [-0.0, 0.0], [0.0, -0.0], [-0.0, -0.0]])
    for law in (k.steering_angle, k.scrub_free_angle):
        np.testing.assert_array_equal(law(rest, robot), 0)


def test_batches(robot):
    """Any leading dimensions, and one input for many states, give the rows one by one."""
    states = STATES.reshape(5, 8, 7)
    assert k.state_rates(states, INPUTS.reshape(5, 8, 2), robot).shape == (5, 8, 7)
    for rates in (k.state_rates, k.state_rates_as_printed):
        np.testing.assert_array_equal(rates(states, [1.0, 0.2], robot)[3, 4], rates(states[3, 4], [1.0, 0.2], robot))
    np.testing.assert_array_equal(k.pose_rates(states[..., :3], [1, 2])[1, 2], k.pose_rates(states[1, 2, :3], [1, 2]))
