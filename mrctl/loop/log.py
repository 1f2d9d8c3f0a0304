"""The log of a run: one record of `TICK` for each robot and control tick."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mrctl.control.kanayama import posture_error
from mrctl.kernel import Array, Rows, kernel
from mrctl.results.dataset import SIGNALS, TICK

MAX_LATERAL_ERROR = 1.0  # m of lateral error, beyond which a run has failed


@kernel
def record(plant: Rows, seen: Rows, reference: Rows, control: Rows, error: Array, ticks: Rows) -> bool:
    """Writes the signals of one control tick of all robots; returns whether all that go on are near their references.

    A sample at time t has the state at t, the commands computed from it, and the currents and the power at the end of
    the control period that begins at t; the commands act after the delay.

    Args:
        plant: Record of `PLANT` of each robot, after the control period.
        seen: Record of `SEEN` of each robot.
        reference: Record of `REFERENCE` of each robot.
        control: Record of `CONTROL` of each robot.
        error: Scratch, `(3,)`.
        ticks: Out: record of `TICK` of each robot.
    """
    near = True
    for i in range(len(ticks)):
        t, p, s, g, c = ticks[i], plant[i], seen[i], reference[i], control[i]
        state = p.before
        t.x, t.y, t.theta = state.pose[0], state.pose[1], state.pose[2]
        t.v, t.omega, t.v_lateral = state.twist[0], state.twist[1], state.v_lateral
        t.wheel_rate_left, t.wheel_rate_right = state.wheel_rates[0], state.wheel_rates[1]
        t.steering_angle = state.steering_angle
        t.x_ref, t.y_ref, t.theta_ref = g.pose[0], g.pose[1], g.pose[2]
        t.v_ref, t.omega_ref = g.twist[0], g.twist[1]
        posture_error(state.pose, g.pose, error)
        t.longitudinal_error, t.lateral_error, t.heading_error = error[0], error[1], error[2]
        e, var = s.estimate, s.variance
        t.x_measured, t.y_measured, t.theta_measured, t.v_measured, t.omega_measured = e[0], e[1], e[2], e[3], e[4]
        t.variance_x, t.covariance_xy, t.variance_y = var[0], var[1], var[2]
        t.variance_theta, t.variance_v, t.variance_omega = var[3], var[4], var[5]
        t.fix_x, t.fix_y, t.fix_theta = s.fix[0], s.fix[1], s.fix[2]
        t.encoder_left, t.encoder_right, t.gyro = s.encoder[0], s.encoder[1], s.gyro
        t.acceleration_x, t.acceleration_y = s.acceleration[0], s.acceleration[1]
        t.slip = s.slip
        t.v_command, t.omega_command = c.limiter.command[0], c.limiter.command[1]
        a = c.allocation
        t.feedback_left, t.feedback_right = a.feedback[0], a.feedback[1]
        t.feedforward_left, t.feedforward_right = a.feedforward[0], a.feedforward[1]
        t.voltage_left, t.voltage_right = a.command[0], a.command[1]
        t.steering_command, t.steering_rate_command = a.command[2], a.command[3]
        t.saturated, t.weight_norm = 1.0 if a.saturated else 0.0, c.weight_norm
        t.current_left, t.current_right = p.current[0], p.current[1]
        t.power = p.applied[0] * p.current[0] + p.applied[1] * p.current[1]
        t.guard, t.guard_reason, t.retunes = c.guard.action, c.guard.reason, c.delay.moves
        t.z, t.roll_angle, t.pitch_angle = state.z, state.roll, state.pitch
        t.feedforward_limited = 1.0 if c.guard.beyond else 0.0
        t.motor_voltage_left, t.motor_voltage_right = p.applied[0], p.applied[1]
        near &= not abs(t.lateral_error) > MAX_LATERAL_ERROR or p.stopped
    return near


class Log:
    """The log of B robots.

    Attributes:
        ticks: Record of `TICK` of each tick and robot, `(length, B)`; after `length` ticks the oldest are overwritten.
        now: The records of the tick that was written last, a view, `(B,)`.
        near: Whether in that tick all robots that had not failed were within `MAX_LATERAL_ERROR` of their references.
    """

    def __init__(self, length: int, size: int) -> None:
        """Takes the number of ticks to keep, and the number of robots."""
        # The records of a tick lie side by side, so that the loop writes one block of memory for any number of robots.
        self.ticks = np.empty((length, size), TICK)
        self.now, self.near = self.ticks[0], True
        self._error = np.zeros(3)
        self._record = record.repeated()

    def at(self, tick: int) -> Rows:
        """Returns the records of one tick, `(B,)`."""
        return self.ticks[tick % len(self.ticks)]

    def blank(self, tick: int, rows: NDArray[np.bool] | slice) -> None:
        """Replaces the records of robots at one tick by NaN."""
        self.now = self.at(tick)
        self.now.view(float).reshape(-1, len(SIGNALS))[rows] = np.nan

    def record(self, tick: int, plant: Rows, seen: Rows, reference: Rows, control: Rows) -> None:
        """Records a tick; the arguments are those of the kernel `record`."""
        self.now = self.at(tick)
        self.near = self._record(plant, seen, reference, control, self._error, self.now)
