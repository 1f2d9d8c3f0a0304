"""Equation (3) of the paper, as printed and corrected, and its inverse, which the neural feedforward learns.

Every function works on arrays with any leading batch dimensions. A twist is (V, θ̇) of P in (m/s, rad/s), an
acceleration is (V̇, θ̈) in (m/s², rad/s²). Voltages are those commanded, (left, right) in V, and torques those at the
wheels, (left, right) in N·m.

The corrected model, with the centre of mass c ahead of P and the front wheel free to follow:

    M_e V̇ = (P_d + P_s)/r + m c θ̇² − F_roll (s_d + s_s)/2
    J_e θ̈ = (D/r)(P_d − P_s) − m c V θ̇ − τ_f,     τ_f = D (1 − f) F_roll (s_d − s_s)/2
    P_i   = (N k_M/R_a)(g U_i − k_E N ω_i) − b ω_i − τ_loss s_i,     ω_i = V_i/r,  V_d,s = V ± D θ̇

where the subscripts d and s are the right and the left wheel, g is `drive_gain` and U is limited to ±`supply`. The
viscous friction b, which the paper does not have, adds its volts per wheel rate to N k_E. The Coulomb losses are
modelled so that the inverse is linear in its parameters. s_i is the sign of the speed V_i of a rear wheel, and sgn 0 =
0, so that no loss drives a robot at rest. A rear wheel bears (1 − f)/2 of the load, and its rolling loss acts on it as
the gearbox loss does. The front wheel bears the share f, and its sign is taken as the mean of the two others. The
rolling force is therefore F_roll where both wheels turn the same way, and the turning resistance τ_f, the rolling loss
of wheels that turn against each other, needs no parameter of its own. The scrub of the contact patches, which would
need one, is left out.

A controller near rest needs the signs smoothed to tanh(V_i/`sign_speed`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from mrctl.kernel import Array
from mrctl.theory.kinematics import split, stack, wheel_rates
from mrctl.theory.robot import Robot

RAD_S_PER_RPM = 2 * np.pi / 60
"""Rate of one revolution per minute in rad/s."""


def common_differential(voltage: ArrayLike) -> Array:
    """Common and differential voltage (U_Σ, U_Δ) from (left, right), by U_r,l = U_Σ ± U_Δ; both in V, shape (…, 2)."""
    left, right = split(voltage)
    return stack((right + left) / 2, (right - left) / 2)


def left_right(mixed: ArrayLike) -> Array:
    """Voltages (left, right) from (U_Σ, U_Δ), the inverse of `common_differential`; both in V, shape (…, 2)."""
    common, differential = split(mixed)
    return stack(common - differential, common + differential)


def wheel_signs(twist: ArrayLike, robot: Robot, sign_speed: float = 0.0) -> Array:
    """Signs s_i of the rear wheels' speeds V_i.

    Args:
        twist: (V, θ̇), shape (…, 2).
        robot: The robot.
        sign_speed: 0 for sgn V_i with sgn 0 = 0; a positive speed in m/s for tanh(V_i/sign_speed).

    Returns:
        (left, right), dimensionless, shape (…, 2).
    """
    speeds = robot.wheel_radius * wheel_rates(twist, robot)
    return np.tanh(speeds / sign_speed) if sign_speed > 0 else np.sign(speeds)


def wheel_torques(voltage: ArrayLike, twist: ArrayLike, robot: Robot, sign_speed: float = 0.0) -> Array:
    """Torques P of the two drives at their wheels, less the losses of motor and gearbox.

    Args:
        voltage: Commanded (left, right), V, shape (…, 2); limited to the supply.
        twist: (V, θ̇), shape (…, 2).
        robot: The robot.
        sign_speed: See `wheel_signs`.

    Returns:
        (left, right), N·m, shape (…, 2).
    """
    applied = robot.drive_gain * np.clip(np.asarray(voltage, float), -robot.supply, robot.supply)
    electric = robot.motor_gain * (applied - robot.voltage_per_rate * wheel_rates(twist, robot))
    return electric - robot.drive_loss * wheel_signs(twist, robot, sign_speed)


def rolling_losses(twist: ArrayLike, robot: Robot, sign_speed: float = 0.0) -> Array:
    """Rolling resistance against the motion.

    Args:
        twist: (V, θ̇), shape (…, 2).
        robot: The robot.
        sign_speed: See `wheel_signs`.

    Returns:
        Force along x in N and turning resistance τ_f about P in N·m, shape (…, 2); both are subtracted in (3).
    """
    mean, difference = split(common_differential(wheel_signs(twist, robot, sign_speed)))
    return robot.rolling_force * stack(mean, robot.half_track * (1 - robot.front_load) * difference)


def accelerations(twist: ArrayLike, voltage: ArrayLike, robot: Robot, sign_speed: float = 0.0) -> Array:
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


def inverse_dynamics(twist: ArrayLike, acceleration: ArrayLike, robot: Robot, sign_speed: float = 0.0) -> Array:
    """Commanded voltages that give an acceleration: `accelerations` solved for the voltages, without the supply limit.

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
    return (wheels / robot.motor_gain + robot.voltage_per_rate * wheel_rates(twist, robot)) / robot.drive_gain


def regressor(twist: ArrayLike, acceleration: ArrayLike, robot: Robot, sign_speed: float = 0.0) -> Array:
    """The 8 features in which the inverse dynamics is linear: V, θ̇, V̇, θ̈, V θ̇, θ̇², s_l, s_r.

    Args:
        twist: (V, θ̇), shape (…, 2).
        acceleration: (V̇, θ̈), shape (…, 2).
        robot: The robot, of which only the half track matters, for the signs.
        sign_speed: See `wheel_signs`.

    Returns:
        Features in SI units, shape (…, 8).
    """
    v, omega = split(twist)
    v_dot, omega_dot = split(acceleration)
    left, right = split(wheel_signs(twist, robot, sign_speed))
    return stack(v, omega, v_dot, omega_dot, v * omega, omega**2, left, right)


def inverse_coefficients(robot: Robot) -> Array:
    """Coefficients, shape (8, 2), with `regressor` @ coefficients = (U_Σ, U_Δ) of `inverse_dynamics` in V."""
    r, d = robot.wheel_radius, robot.half_track
    volts = r / (2 * robot.motor_gain)  # U_Σ per newton along x
    lever = volts * robot.mass * robot.com_offset
    loss = robot.drive_loss / (2 * robot.motor_gain)
    rolling = volts * robot.rolling_force / 2
    along, across = loss + rolling, loss + rolling * (1 - robot.front_load)
    per_speed = robot.voltage_per_rate / r
    common = [per_speed, 0, volts * robot.effective_mass, 0, 0, -lever, along, along]
    differential = [0, per_speed * d, 0, volts * robot.effective_inertia / d, lever / d, 0, -across, across]
    return np.array([common, differential]).T / robot.drive_gain


def wheel_torques_as_printed(
    voltage: ArrayLike, wheel_speed: ArrayLike, robot: Robot, back_emf_constant: float
) -> Array:
    """The third line of equation (3) as printed: P = N (k_M U/R_a − k_M k_E/R_a · 60 N V/(2 π r) − k_M I₀).

    60 N V/(2πr) is the motor's speed in rpm, so the term is right only with k_E in V/rpm. The no-load current has no
    sign, so that it drives a resting robot backwards. The equation has neither supply limit nor gearbox loss.

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


def accelerations_as_printed(twist: ArrayLike, voltage: ArrayLike, robot: Robot) -> Array:
    """Equation (3) as printed, solved for its two derivatives and kept for comparison. It has seven errors.

    1. The first derivative is printed V̈, but (P_d + P_s)/(2r) has the dimension of M V̇; the value is an acceleration.
    2. The factor 1/(2r) of the force is half of the right one, 1/r.
    3. The factor r/(2D) of the torque belongs to kinematics; the right one is D/r.
    4. I₀ has no sign (see `wheel_torques_as_printed`).
    5. P_s,d and P_l,r are the same pair, (left, right) here; the text calls the torques inputs, but the voltages are.
    6. Rotor and wheel inertia, offset c, rolling and gearbox loss and supply limit are missing; J is `yaw_inertia`.
    7. k_E must be in V/rpm, and is converted from SI here.

    Args:
        twist: (V, θ̇), shape (…, 2).
        voltage: (left, right), V, shape (…, 2).
        robot: The robot.

    Returns:
        (printed V̈, θ̈), m/s² and rad/s², shape (…, 2).
    """
    wheel_speed = robot.wheel_radius * wheel_rates(twist, robot)
    left, right = split(wheel_torques_as_printed(voltage, wheel_speed, robot, robot.torque_constant * RAD_S_PER_RPM))
    r, d = robot.wheel_radius, robot.half_track
    return stack((right + left) / (2 * r * robot.mass), r / (2 * d) * (right - left) / robot.yaw_inertia)
