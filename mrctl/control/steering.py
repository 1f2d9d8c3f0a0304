"""Allocation: from the two channels of the velocity controller to motor voltages and steering angle."""

from __future__ import annotations

import numpy as np

from mrctl.control.features import SIGN_SPEED
from mrctl.kernel import Array, Row, kernel
from mrctl.theory.kinematics import scrub_free_rotation

HOLD_SPEED = 0.02  # m/s; below it the fork holds its angle

ALLOCATION = np.dtype(
    [
        ("angle", "f8"),  # steering angle φ_c of the fork at the end of the last period, rad
        ("rate", "f8"),  # its rate, rad/s
        ("lag", "f8"),  # lag of the fork at the end of the last period, s
        ("feedback", "f8", 2),  # part of the voltages left and right that comes from feedback, V
        ("feedforward", "f8", 2),  # part from feedforward, V; it includes the differential of `rigid` steering
        ("command", "f8", 4),  # voltages left and right in V, steering angle in rad, steering rate in rad/s
        ("excess", "f8", 2),  # the two channels after the limits less before them, V (rad/s on a steering channel)
        ("saturated", "?"),  # whether voltage or current, or under `rigid` steering the fork, could not follow
    ],
    align=True,
)


@kernel
def scrub_free(v: float, omega: float, v_dot: float, omega_dot: float, period: float, robot: Row, s: Row) -> None:
    """Angle φ at which a trailing front wheel rolls without scrub, and its rate; the fork's own motion is included.

        speed · sin(direction − φ) = t (θ̇ + φ̇),    speed² = V² + (L θ̇)²,    tan direction = L θ̇ / V

    The contact of the front wheel trails the steering axis by t and swings with the fork. Therefore φ follows the
    quasi-static angle φ_c = atan(L θ̇/V) − asin(t θ̇/speed) with a lag of t/speed. At rest the angle is held.

    In reverse φ_c = atan(L θ̇/V) + asin(t θ̇/speed), and the contact would roll with a lead of t/speed. The lag is kept
    there: with a trail the contact is dragged sideways where φ_c changes, and θ̇ answers as (1 − s t/speed)/(1 + s
    t/speed), like a delay of 2 t/speed. Robots that come with mrctl have no trail where they can reverse.

    The rate r is the derivative of φ_c behind the same lag, d/dt (lag r) + r = φ̇_c. It therefore leaves out how the
    fork catches up where φ_c jumps: when a robot leaves rest on an arc, the rate is that of the angle only some lags
    later.

    Args:
        v: V in m/s.
        omega: θ̇ in rad/s.
        v_dot: V̇ in m/s².
        omega_dot: θ̈ in rad/s².
        period: Control period in s.
        robot: The nominal robot, a record of `NOMINAL`.
        s: In and out: a record of `ALLOCATION`, whose `angle` and `rate` are the result, without limits.
    """
    sense = 1.0 if v >= 0 else -1.0
    forward, side = sense * v, sense * robot.wheelbase * omega
    if not forward > HOLD_SPEED:
        s.rate = 0.0
        return
    speed = np.hypot(forward, side)
    forward_dot, side_dot = sense * v_dot, sense * robot.wheelbase * omega_dot
    sine = sense * robot.trail * omega / speed  # the trail is shorter than the wheelbase, so the arcsine exists
    static = np.arctan2(side, forward) - np.arcsin(sine)
    speed_dot = (forward * forward_dot + side * side_dot) / speed
    static_dot = (forward * side_dot - side * forward_dot) / speed**2
    static_dot -= (sense * robot.trail * omega_dot - sine * speed_dot) / speed / np.sqrt(1 - sine * sine)
    lag = robot.trail / speed
    s.angle = (lag * s.angle + period * static) / (lag + period)  # implicit Euler: exact on a ramp
    s.rate = (s.lag * s.rate + period * static_dot) / (lag + period)
    s.lag = lag


@kernel
def steer(
    twist: Array, acceleration: Array, feedback: Array, feedforward: Array, period: float, robot: Row, s: Row
) -> None:
    """Angle and rate of the fork: `scrub_free` at the commanded V and θ̇, and if rigid the second channel beside θ̇.

    Args:
        twist: Commanded V in m/s and θ̇ in rad/s, `(2,)`.
        acceleration: Their derivatives in m/s² and rad/s², `(2,)`.
        feedback: Channels of the feedback, U_Σ in V, and U_Δ in V or, if rigid, a correction of θ̇ in rad/s, `(2,)`.
        feedforward: Channels of the feedforward in the same units, `(2,)`.
        period: Control period in s.
        robot: The nominal robot, a record of `NOMINAL`.
        s: In and out: a record of `ALLOCATION`, whose `angle` and `rate` are the result, without limits.
    """
    omega = twist[1]
    if robot.rigid:
        omega += feedback[1] + feedforward[1]
    scrub_free(twist[0], omega, acceleration[0], acceleration[1], period, robot, s)


@kernel
def allocate(twist: Array, feedback: Array, feedforward: Array, period: float, robot: Row, s: Row) -> None:
    """Voltages and steering command within their limits, from feedback plus feedforward and the fork's angle.

        U_r,l = λ (U_Σ ± U_Δ)

    - `compliant` and `caster`: U_Δ is the second channel.
    - `rigid`: the second channel is a θ̇ that the fork makes, and U_Δ is the electronic differential k_E N D θ̇/r plus
      half the difference of the friction terms of the two drives.

    A steered wheel turns the robot also where the motors saturate. Then λ is 1, and each voltage is cut at the supply
    U_max by itself, which keeps the most of V. Where the motors alone turn it, λ = U_max / max(U_max, |U_Σ| + |U_Δ|): a
    robot that cannot be as fast as commanded keeps about the commanded curvature, because the steady speed of a motor
    is nearly proportional to its voltage. Cut one by one, two saturated motors would get the same voltage, and the
    robot would go straight on, whatever θ̇ is commanded.

    Args:
        twist: Commanded V in m/s and θ̇ in rad/s, `(2,)`.
        feedback: Channels of the feedback, as for `steer`, `(2,)`.
        feedforward: Channels of the feedforward in the same units, `(2,)`.
        period: Control period in s.
        robot: The nominal robot, a record of `NOMINAL`.
        s: In and out: a record of `ALLOCATION` with the fork's `angle` and `rate`, all of whose fields are the result.
    """
    v, omega = twist[0], twist[1]
    s.excess[1], s.saturated = 0.0, False
    if robot.rigid:
        left, right = v - robot.half_track * omega, v + robot.half_track * omega
        losses = np.tanh(right / SIGN_SPEED) - np.tanh(left / SIGN_SPEED)
        differential = robot.voltage_per_speed * robot.half_track * omega + robot.loss / 2 * losses
        s.feedback[0], s.feedback[1] = feedback[0], feedback[0]
        omega += feedback[1] + feedforward[1]
    else:
        differential = feedforward[1]
        s.feedback[0], s.feedback[1] = feedback[0] - feedback[1], feedback[0] + feedback[1]
    s.feedforward[0], s.feedforward[1] = feedforward[0] - differential, feedforward[0] + differential

    limited = abs(s.angle) > robot.steering_limit
    if limited:
        s.angle = robot.steering_limit if s.angle > 0 else -robot.steering_limit
        s.rate = 0.0
    if robot.rigid and (limited or not abs(v) > HOLD_SPEED):  # at rest the fork is held and makes no θ̇
        s.excess[1] = scrub_free_rotation(v, s.angle, robot.wheelbase, robot.trail) - omega
        s.saturated = limited or s.excess[1] != 0.0
    middle = s.angle + s.rate * period / 2  # the middle of the period for which the set-point is held
    s.command[2], s.command[3] = max(-robot.steering_limit, min(robot.steering_limit, middle)), s.rate

    left, right = s.feedback[0] + s.feedforward[0], s.feedback[1] + s.feedforward[1]
    share = robot.supply / max(robot.supply, abs(left), abs(right)) if robot.motors_steer else 1.0
    s.command[0] = max(-robot.supply, min(robot.supply, share * left))  # the product may round up
    s.command[1] = max(-robot.supply, min(robot.supply, share * right))
    lost_left, lost_right = s.command[0] - left, s.command[1] - right
    s.excess[0] = (lost_left + lost_right) / 2
    if not robot.rigid:
        s.excess[1] = (lost_right - lost_left) / 2
    if lost_left != 0 or lost_right != 0:
        s.saturated = True


@kernel
def take_loss(lost: Array, rigid: bool, s: Row) -> None:
    """Adds the voltage that the drivers' current limits took in the last period to the excess of this one.

    A driver reports its limit one period late. Back-calculation then unwinds the integral of the PID, and a learner
    does not learn.

    Args:
        lost: Voltages left and right at the terminals less those that were commanded, in commanded V, `(2,)`.
        rigid: Whether the second channel is steering.
        s: In and out: a record of `ALLOCATION`.
    """
    if lost[0] == 0 and lost[1] == 0:
        return
    s.excess[0] += (lost[0] + lost[1]) / 2
    if not rigid:
        s.excess[1] += (lost[1] - lost[0]) / 2
    s.saturated = True
