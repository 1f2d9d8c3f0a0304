"""Allocation: how the velocity controller's two channels reach motors and fork, for each steering arrangement."""

from __future__ import annotations

import numpy as np
from numba import float64, guvectorize
from numpy.typing import NDArray

from mrctl.theory.robot import Robot

REST = 0.02  # m/s; below it the fork holds its angle
SIGN_SPEED = 0.05  # m/s over which the smooth sign of the losses turns


def parameters(robot: Robot, rigid: bool) -> NDArray[np.float64]:
    """What `allocate` needs of the robot, `(8,)`: L, t, φ_max, U_max, D, k_E N/r, loss voltage, rigid."""
    return np.array(
        [
            robot.wheelbase,
            robot.trail,
            robot.steering_limit,
            robot.supply,
            robot.half_track,
            robot.back_emf / robot.wheel_radius,
            robot.drive_loss / robot.motor_gain,
            float(rigid),
        ]
    )


@guvectorize(
    [(*[float64[:]] * 5, float64, *[float64[:]] * 5)],
    "(u),(u),(u),(u),(k),(),(m),(c),(c),(u),()",
    writable_args=("state", "command", "parts", "excess", "saturated"),
    cache=True,
)
def allocate(twist, acceleration, feedback, feedforward, robot, period, state, command, parts, excess, saturated):  # noqa: ANN001, ANN201
    """Voltages and steering from feedback plus feedforward, for one robot.

    `compliant` and `caster`: U_r,l = U_Σ ± U_Δ, and the fork goes where its wheel rolls without scrub, with
    φ_c = atan(L θ̇/V) − asin(t θ̇/√(V² + L²θ̇²)) of the commanded twist and the derivative of that as velocity set-point.
    `rigid`: the second channel is a correction of θ̇ inside φ_c, and U_Δ is the electronic differential
    k_E N D θ̇/r plus half the difference of the loss terms.

    Args:
        twist: Commanded V, θ̇, `(2,)`.
        acceleration: Their derivatives `(2,)`.
        feedback: `(2,)`, volts (second channel rad/s if rigid).
        feedforward: `(2,)`, the same units.
        robot: As from `parameters`.
        period: Control period in s.
        state: In and out: steering angle and rate, `(2,)`; held at rest.
        command: Out: voltages left and right in V, steering angle in rad and rate in rad/s, `(4,)`.
        parts: Out: feedback left and right, feedforward left and right in V, `(4,)`; the differential of `rigid`
            steering comes from the model and counts as feedforward.
        excess: Out: what the limits took from the two channels, `(2,)`.
        saturated: Out: 1 where a limit acted, else 0.
    """
    wheelbase, trail, steering_max, supply, half_track, emf, loss, rigid = robot
    v, omega, v_dot, omega_dot = twist[0], twist[1], acceleration[0], acceleration[1]
    excess[1] = 0.0
    saturated[0] = 0.0
    if rigid > 0:
        omega += feedback[1] + feedforward[1]
        left, right = v - half_track * twist[1], v + half_track * twist[1]
        apart = emf * half_track * twist[1] + loss / 2 * (np.tanh(right / SIGN_SPEED) - np.tanh(left / SIGN_SPEED))
        parts[0], parts[1] = feedback[0], feedback[0]
    else:
        apart = feedforward[1]
        parts[0], parts[1] = feedback[0] - feedback[1], feedback[0] + feedback[1]
    parts[2], parts[3] = feedforward[0] - apart, feedforward[0] + apart
    # The front contact trails the axis by t and swings with the fork, so it rolls without scrub where
    # speed · sin(direction − φ) = t (θ̇ + φ̇): the quasi-static angle behind a lag of t/speed.
    sense = 1.0 if v >= 0 else -1.0
    forward, side = sense * v, sense * wheelbase * omega
    speed = np.hypot(forward, side)
    angle, rate = state[0], 0.0
    if forward > REST:
        forward_dot, side_dot = sense * v_dot, sense * wheelbase * omega_dot
        s = sense * trail * omega / speed  # trail < wheelbase, so the arcsine exists
        static = np.arctan2(side, forward) - np.arcsin(s)
        speed_dot = (forward * forward_dot + side * side_dot) / speed
        static_rate = (forward * side_dot - side * forward_dot) / speed**2
        static_rate -= (sense * trail * omega_dot - s * speed_dot) / speed / np.sqrt(1 - s * s)
        lag = trail / speed
        angle = (lag * state[0] + period * static) / (lag + period)  # implicit Euler: exact on a ramp
        rate = (lag * state[1] + period * static_rate) / (lag + period * (1 - lag * speed_dot / speed))
        if abs(angle) > steering_max:
            angle = steering_max if angle > 0 else -steering_max
            rate = 0.0
            if rigid > 0:
                excess[1] = v * np.tan(angle) / wheelbase - omega
                saturated[0] = 1.0
    state[0], state[1] = angle, rate
    left, right = parts[0] + parts[2], parts[1] + parts[3]
    command[0] = max(-supply, min(supply, left))
    command[1] = max(-supply, min(supply, right))
    middle = angle + rate * period / 2  # the set-point is held for a period
    command[2], command[3] = max(-steering_max, min(steering_max, middle)), rate
    lost_left, lost_right = command[0] - left, command[1] - right
    excess[0] = (lost_left + lost_right) / 2
    if not rigid > 0:
        excess[1] = (lost_right - lost_left) / 2
    if lost_left != 0 or lost_right != 0:
        saturated[0] = 1.0
