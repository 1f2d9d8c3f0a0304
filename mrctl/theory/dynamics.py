"""Equation (3) of the paper, as printed and corrected, and its inverse, which the network has to discover.

Every function works on arrays with any leading batch dimensions. A twist is (V, θ̇) of P in (m/s, rad/s), an
acceleration is (V̇, θ̈), voltages and torques are (left, right) as commanded and at the wheel, in V and N·m.

The corrected model, with the centre of mass c ahead of P and the front wheel free to follow:

    M_e V̇ = (P_d + P_s)/r + m c θ̇² − F_roll (s_d + s_s)/2
    J_e θ̈ = (D/r)(P_d − P_s) − m c V θ̇ − τ_f,     τ_f = D (1 − f) F_roll (s_d − s_s)/2
    P_i   = (N k_M/R_a)(g U_i − k_E N ω_i) − τ_loss s_i,     ω_i = V_i/r,  V_d,s = V ± D θ̇

where g is `drive_gain`, U is limited to ±`supply`, and the losses follow one convention that keeps the inverse linear:
s_i is the sign of V_i, rear wheel by rear wheel, so that no loss drives a robot at rest (sgn 0 = 0). A rear wheel bears
(1 − f)/2 of the load, and its rolling loss acts on it like the gear's; the front wheel bears the rest, f, and the mean
of the two signs stands for its own. So F_roll is the full force wherever both wheels turn the same way, and the turning
resistance τ_f has no parameter of its own: it is the rolling loss of wheels that turn against each other. The scrub of
the contact patches, which would need one, is left out.

The signs may be smoothed to tanh(V_i/`sign_speed`), which a controller needs near rest.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mrctl.theory.kinematics import split, stack, wheel_rates
from mrctl.theory.robot import Robot

RPM = 2 * np.pi / 60  # rad/s


def common_differential(voltage: ArrayLike) -> NDArray[np.float64]:
    """(left, right) to (U_Σ, U_Δ), U_r,l = U_Σ ± U_Δ; both of shape (…, 2)."""
    left, right = split(voltage)
    return stack((right + left) / 2, (right - left) / 2)


def left_right(mixed: ArrayLike) -> NDArray[np.float64]:
    """(U_Σ, U_Δ) to (left, right), the inverse of `common_differential`."""
    common, differential = split(mixed)
    return stack(common - differential, common + differential)


def wheel_signs(twist: ArrayLike, robot: Robot, sign_speed: float = 0.0) -> NDArray[np.float64]:
    """Direction of travel of the rear wheels (left, right), shape (…, 2).

    Args:
        twist: (V, θ̇), shape (…, 2).
        robot: The robot.
        sign_speed: 0 for sgn V_i with sgn 0 = 0, else tanh(V_i/sign_speed), m/s.
    """
    speeds = robot.wheel_radius * wheel_rates(twist, robot)
    return np.tanh(speeds / sign_speed) if sign_speed > 0 else np.sign(speeds)


def wheel_torques(voltage: ArrayLike, twist: ArrayLike, robot: Robot, sign_speed: float = 0.0) -> NDArray[np.float64]:
    """Torques P of the two drives at their wheels, losses of motor and gear taken off.

    Args:
        voltage: Commanded (left, right), V, shape (…, 2); limited to the supply.
        twist: (V, θ̇), shape (…, 2).
        robot: The robot.
        sign_speed: See `wheel_signs`.

    Returns:
        (left, right), N·m, shape (…, 2).
    """
    applied = robot.drive_gain * np.clip(np.asarray(voltage, float), -robot.supply, robot.supply)
    electric = robot.motor_gain * (applied - robot.back_emf * wheel_rates(twist, robot))
    return electric - robot.drive_loss * wheel_signs(twist, robot, sign_speed)


def rolling_losses(twist: ArrayLike, robot: Robot, sign_speed: float = 0.0) -> NDArray[np.float64]:
    """Rolling resistance as (force along x in N, turning resistance τ_f about P in N·m), shape (…, 2).

    Arguments as in `wheel_signs`; both oppose the motion and are subtracted.
    """
    mean, difference = split(common_differential(wheel_signs(twist, robot, sign_speed)))
    return robot.rolling_force * stack(mean, robot.half_track * (1 - robot.front_load) * difference)


def accelerations(twist: ArrayLike, voltage: ArrayLike, robot: Robot, sign_speed: float = 0.0) -> NDArray[np.float64]:
    """Equation (3), corrected: the forward model.

    Args:
        twist: (V, θ̇), shape (…, 2).
        voltage: Commanded (left, right), V, shape (…, 2); limited to the supply.
        robot: The robot.
        sign_speed: See `wheel_signs`.

    Returns:
        (V̇, θ̈), m/s² and rad/s², shape (…, 2).
    """
    v, omega = split(twist)
    left, right = split(wheel_torques(voltage, twist, robot, sign_speed))
    rolling, turning = split(rolling_losses(twist, robot, sign_speed))
    lever = robot.mass * robot.com_offset
    force = (right + left) / robot.wheel_radius + lever * omega**2 - rolling
    torque = robot.half_track / robot.wheel_radius * (right - left) - lever * v * omega - turning
    return stack(force / robot.effective_mass, torque / robot.effective_inertia)


def inverse_dynamics(
    twist: ArrayLike, acceleration: ArrayLike, robot: Robot, sign_speed: float = 0.0
) -> NDArray[np.float64]:
    """The commanded voltages that give the acceleration: `accelerations` solved for them, before the supply limit.

    Args:
        twist: (V, θ̇), shape (…, 2).
        acceleration: (V̇, θ̈), shape (…, 2).
        robot: The robot.
        sign_speed: See `wheel_signs`.

    Returns:
        (left, right), V, shape (…, 2).
    """
    v, omega = split(twist)
    v_dot, omega_dot = split(acceleration)
    rolling, turning = split(rolling_losses(twist, robot, sign_speed))
    lever = robot.mass * robot.com_offset
    force = robot.effective_mass * v_dot - lever * omega**2 + rolling
    torque = robot.effective_inertia * omega_dot + lever * v * omega + turning
    wheels = robot.wheel_radius * left_right(stack(force / 2, torque / (2 * robot.half_track)))
    wheels += robot.drive_loss * wheel_signs(twist, robot, sign_speed)
    return (wheels / robot.motor_gain + robot.back_emf * wheel_rates(twist, robot)) / robot.drive_gain


def regressor(twist: ArrayLike, acceleration: ArrayLike, robot: Robot, sign_speed: float = 0.0) -> NDArray[np.float64]:
    """The 8 features in which the inverse dynamics is linear: V, θ̇, V̇, θ̈, V θ̇, θ̇², s_l, s_r; shape (…, 8).

    Arguments as in `inverse_dynamics`. Of the robot only the half track is used.
    """
    v, omega = split(twist)
    v_dot, omega_dot = split(acceleration)
    left, right = split(wheel_signs(twist, robot, sign_speed))
    return stack(v, omega, v_dot, omega_dot, v * omega, omega**2, left, right)


def inverse_coefficients(robot: Robot) -> NDArray[np.float64]:
    """Coefficients (8, 2) with regressor @ coefficients = (U_Σ, U_Δ) of `inverse_dynamics`."""
    r, d = robot.wheel_radius, robot.half_track
    volts = r / (2 * robot.motor_gain)  # per newton on both wheels together
    lever = volts * robot.mass * robot.com_offset
    loss = robot.drive_loss / (2 * robot.motor_gain)
    rolling = volts * robot.rolling_force / 2
    along, across = loss + rolling, loss + rolling * (1 - robot.front_load)
    emf = robot.back_emf / r
    common = [emf, 0, volts * robot.effective_mass, 0, 0, -lever, along, along]
    differential = [0, emf * d, 0, volts * robot.effective_inertia / d, lever / d, 0, -across, across]
    return np.array([common, differential]).T / robot.drive_gain


def wheel_torques_as_printed(
    voltage: ArrayLike, wheel_speed: ArrayLike, robot: Robot, back_emf_constant: float
) -> NDArray[np.float64]:
    """The third line of equation (3) as printed: P = N (k_M U/R_a − k_M k_E/R_a · 60 N V/(2 π r) − k_M I₀).

    60 N V/(2πr) is the motor's speed in rpm, so the term is right only with k_E in V/rpm. The no-load current has no
    sign: a resting robot is driven backwards. Neither supply limit nor gear loss.

    Args:
        voltage: Terminal voltages (left, right), V, shape (…, 2).
        wheel_speed: Ground speeds of the rear wheels (left, right), m/s, shape (…, 2).
        robot: The robot.
        back_emf_constant: k_E, V/rpm.

    Returns:
        (left, right), N·m, shape (…, 2).
    """
    k_m, r_a, n = robot.torque_constant, robot.resistance, robot.gear_ratio
    motor_speed = 60 * n / (2 * np.pi * robot.wheel_radius) * np.asarray(wheel_speed, float)
    emf = k_m * back_emf_constant / r_a * motor_speed
    return n * (k_m / r_a * np.asarray(voltage, float) - emf - k_m * robot.no_load_current)


def accelerations_as_printed(twist: ArrayLike, voltage: ArrayLike, robot: Robot) -> NDArray[np.float64]:
    """Equation (3) as printed, solved for its two left-hand derivatives; kept for comparison, wrong in seven ways.

    1. The first is printed V̈, though M V̈ = (P_d + P_s)/(2r) has the dimension of M V̇: the value is an acceleration.
    2. 1/(2r) halves it: 1/r is right.
    3. r/(2D) is the factor of kinematics: that of torques is D/r.
    4. I₀ has no sign (see `wheel_torques_as_printed`).
    5. P_s,d and P_l,r name one pair, (left, right) here, and the text calls the torques the inputs: the voltages are.
    6. No rotor or wheel inertia, offset c, rolling loss, gear loss or supply limit; J is the `yaw_inertia`.
    7. k_E must be in V/rpm; it is converted here from SI.

    Args:
        twist: (V, θ̇), shape (…, 2).
        voltage: (left, right), V, shape (…, 2).
        robot: The robot.

    Returns:
        (printed V̈, θ̈), shape (…, 2).
    """
    wheel_speed = robot.wheel_radius * wheel_rates(twist, robot)
    left, right = split(wheel_torques_as_printed(voltage, wheel_speed, robot, robot.torque_constant * RPM))
    r, d = robot.wheel_radius, robot.half_track
    return stack((right + left) / (2 * r * robot.mass), r / (2 * d) * (right - left) / robot.yaw_inertia)
