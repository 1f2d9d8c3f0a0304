"""Equations (1) and (2) of the paper: how the robot moves while its wheels roll without slipping.

Every function but the kernel works on arrays with any leading batch dimensions; the last axis holds the components.
A twist is (V_AV, θ̇) of P, the midpoint of the rear axle, in (m/s, rad/s). Angles are counter-clockwise.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from mrctl.kernel import Array, kernel
from mrctl.theory.robot import Robot

UP = np.array([0.0, 0.0, 1.0])
"""Unit vector against gravity."""


def split(array: ArrayLike) -> Array:
    """Moves the last axis to the front, so that the components along it can be unpacked."""
    found = np.asarray(array, float)
    return found if found.ndim == 1 else np.moveaxis(found, -1, 0)


def stack(*components: ArrayLike) -> Array:
    """Broadcasts components against each other and stacks them along a new last axis: the inverse of `split`."""
    if not any(map(np.ndim, components)):
        return np.array(components)
    return np.stack(np.broadcast_arrays(*components), axis=-1)


def state_rates(state: ArrayLike, u: ArrayLike, robot: Robot) -> Array:
    """Equation (1), corrected: the rate of the kinematic state.

    The printed equation is corrected in two respects: ẏ and the two rear wheels take counter-clockwise angles, and the
    front wheel has its own radius. It holds for a front wheel without trail, whose contact point lies below the
    steering axis.

    Args:
        state: (x, y, θ, φ, φ_c, φ_s, φ_d), shape (…, 7): pose, steering angle, and rotation angles of the front, left
            and right wheel, in m and rad.
        u: Ground speed of the front wheel in m/s and steering rate in rad/s, shape (…, 2).
        robot: The robot.

    Returns:
        d(state)/dt, shape (…, 7).
    """
    _, _, theta, phi, _, _, _ = split(state)
    u1, u2 = split(u)
    twist = twist_from_front_wheel(u1, phi, robot)
    x, y, heading = split(pose_rates(stack(0.0, 0.0, theta), twist))
    left, right = split(wheel_rates(twist, robot))
    return stack(x, y, heading, u2, u1 / robot.front_wheel_radius, left, right)


def state_rates_as_printed(state: ArrayLike, u: ArrayLike, robot: Robot) -> Array:
    """Equation (1) as printed: `state_rates` with θ and φ counted clockwise, and one radius r for all wheels.

    It is kept for comparison. It contradicts (2) and (3), which are counter-clockwise: in a positive turn y decreases
    and the left wheel is the faster one. Arguments and result are those of `state_rates`.
    """
    _, _, theta, phi, _, _, _ = split(state)
    u1, u2 = split(u)
    forward, turn = np.cos(phi) * u1, np.sin(phi) * u1 / robot.wheelbase
    across = robot.half_track * turn
    front, left, right = (speed / robot.wheel_radius for speed in (u1, forward + across, forward - across))
    return stack(np.cos(theta) * forward, -np.sin(theta) * forward, turn, u2, front, left, right)


def pose_rates(pose: ArrayLike, twist: ArrayLike) -> Array:
    """Equation (2), S(θ) η: the rate of the pose.

    Args:
        pose: (x, y, θ), shape (…, 3), m and rad.
        twist: (V, θ̇), shape (…, 2).

    Returns:
        d(pose)/dt, shape (…, 3).
    """
    _, _, theta = split(pose)
    v, omega = split(twist)
    return stack(v * np.cos(theta), v * np.sin(theta), omega)


def twist_from_front_wheel(u1: ArrayLike, phi: ArrayLike, robot: Robot) -> Array:
    """The twist that a rolling front wheel without trail enforces: V = u₁ cos φ, θ̇ = u₁ sin φ / L.

    Args:
        u1: Ground speed of the front wheel, m/s.
        phi: Steering angle, rad.
        robot: The robot.

    Returns:
        Twist, shape (…, 2).
    """
    u1 = np.asarray(u1, float)
    return stack(u1 * np.cos(phi), u1 * np.sin(phi) / robot.wheelbase)


def wheel_rates(twist: ArrayLike, robot: Robot) -> Array:
    """Rates (left, right) of the rolling rear wheels, (V ∓ D θ̇) / r, in rad/s.

    Args:
        twist: (V, θ̇), shape (…, 2).
        robot: The robot.

    Returns:
        (left, right), rad/s, shape (…, 2).
    """
    v, omega = split(twist)
    across = robot.half_track * omega
    return stack(v - across, v + across) / robot.wheel_radius


def steering_angle(twist: ArrayLike, robot: Robot) -> Array:
    """The textbook steering angle atan(L θ̇ / V), for either sign of V, without trail.

    The angle is 0 at rest, where the control law in `mrctl.control.steering` holds the last angle, and ±π/2 for a turn
    on the spot, which is the limit from V > 0. The steering limit is not applied.

    Args:
        twist: (V, θ̇), shape (…, 2).
        robot: The robot.

    Returns:
        Angle in [−π/2, π/2], rad, shape (…).
    """
    v, omega = split(twist)
    return np.arctan2(robot.wheelbase * np.where(v < 0, -omega, omega), np.abs(v))


def scrub_free_angle(twist: ArrayLike, robot: Robot) -> Array:
    """The steering angle at which a contact point with trail t behind the steering axis is not dragged sideways.

    At constant φ the lateral velocity of the contact point, L θ̇ cos φ − V sin φ − t θ̇, vanishes at
    φ = atan(L θ̇ / V) − sgn(V) asin(t θ̇ / √(V² + L² θ̇²)). Of the two roots this is the one near straight ahead,
    which is an unstable equilibrium of a caster for V < 0.

    Args:
        twist: (V, θ̇), shape (…, 2).
        robot: The robot; without trail this is `steering_angle`.

    Returns:
        Angle, rad, shape (…); 0 at rest.
    """
    v, omega = split(twist)
    speed = np.hypot(v, robot.wheelbase * omega)
    swing = np.arcsin(robot.trail * omega / np.where(speed > 0, speed, 1.0))
    return steering_angle(twist, robot) - np.where(v < 0, -swing, swing)


@kernel
def scrub_free_rotation(v: float, angle: float, wheelbase: float, trail: float) -> float:
    """The θ̇ in rad/s at which a front wheel held at φ is not dragged sideways: V sin φ/(L cos φ − t).

    It is the inverse of `scrub_free_angle`; at V = 1 m/s it is the curvature of the circle that P drives, in 1/m.

    Args:
        v: V in m/s.
        angle: Steering angle φ in rad.
        wheelbase: L in m.
        trail: Trail t in m.
    """
    return v * np.tan(angle) / (wheelbase - trail / np.cos(angle))
