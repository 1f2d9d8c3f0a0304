"""Disturbance rejection of the feedback: peak-to-peak gains from a voltage to the errors of the closed loops.

A disturbance d of a channel's voltage that never exceeds D causes an error e that never exceeds ‖G‖₁ D, where ‖G‖₁ is
the sum of |g| over the response g of the error to a pulse of one period. No smaller bound holds for all d: sign(g),
reversed in time, reaches it (Boyd and Barratt 1991, Linear Controller Design, section 5.2). The loops are those that
`design` designs: PI control of the linear plants, with delay and hold, around it the motion controller with its
prefilter, and the prediction of the motion over the delay, linearised about driving straight on,

    ẋ_e = −v,    ẏ_e = v_r θ_e,    θ̇_e = −ω        with v, ω beyond the reference.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from mrctl.control.design import MotionDesign, points
from mrctl.control.guard import HEADING_ARM
from mrctl.control.kanayama import Kanayama
from mrctl.control.margins import Gains
from mrctl.kernel import Array
from mrctl.theory.linear import Linear
from mrctl.theory.robot import Robot

DIRECTIONS = 32  # combinations of two errors in which the peak of their length is looked for
RESPONSE_TIME = 10.0  # s over which responses are added up at least, rounded up to 2ⁿ periods
# Share of a sum that the second half of the response may have, and periods (2ⁿ) after which a sum that has not settled
# so is infinite.
SETTLED, MAX_DOUBLINGS = 1e-3, 17


class Peaks(NamedTuple):
    """Peak-to-peak gains of a channel.

    Attributes:
        velocity: From a disturbance in V (rad/s on a steering channel) to the error of the velocity for the same
            command, in m/s or rad/s.
        posture: From that disturbance to what it contributes to the posture error of the guard in m: the longitudinal
            error, or the length of lateral error and `HEADING_ARM` times the heading error. Both are infinite where the
            loop is unstable.
    """

    velocity: float
    posture: float


@lru_cache(maxsize=1024)
def rejection(
    robot: Robot, rigid: bool, gains: tuple[Gains, Gains], motion: MotionDesign, delay: float, period: float
) -> tuple[Peaks, Peaks]:
    """Returns the peak-to-peak gains from a disturbance voltage of each channel, the largest of several speeds.

    It takes about 0.1 s; the last 1024 are cached.

    Args:
        robot: The nominal robot in its steering arrangement.
        rigid: Whether the second channel is steering.
        gains: PI gains of both channels.
        motion: The motion controller.
        delay: Delay from measurement to voltage in s.
        period: Control period in s.
    """
    found = []
    alone = motion._replace(kanayama=Kanayama(k_x=0.0, k_y=0.0, k_theta=0.0))
    for channel in range(2):
        velocity = posture = 0.0
        for speed, plant in points(robot, rigid, channel):
            parts = robot, rigid, channel, plant, gains[channel]
            velocity = max(velocity, LinearLoop(*parts, alone, speed, delay, period).sums()[0])
            posture = max(posture, LinearLoop(*parts, motion, speed, delay, period).sums()[1])
        found.append(Peaks(velocity, posture))
    return found[0], found[1]


class LinearLoop:
    """The linear closed loop of one channel under the motion controller.

    Attributes:
        step: Matrix from the state of one tick to that of the next; the state is that of the plant, the integral, the
            filtered correction, the position and heading errors, the voltages that have not acted yet, and the rates of
            the correction over which the motion is predicted.
        pulse: State after a disturbance of one unit that lasts one period.
        errors: Rows that give the velocity error, the position error and `HEADING_ARM` times the heading error of a
            state.
        state: Index of the velocity, the integral, the filtered correction, the position error and the heading error in
            the state, by name.
    """

    def __init__(
        self, robot: Robot, rigid: bool, channel: int, plant: Linear, gains: Gains, motion: MotionDesign, speed: float,
        delay: float, period: float,
    ) -> None:  # fmt: skip
        """Wires the loop of one channel; the arguments are as for `rejection`, at a speed in m/s."""
        n, late, held = len(plant.b), round(delay / period), plant.held(period)
        k = motion.kanayama
        k_x, k_y, k_theta = float(k.k_x or 0), float(k.k_y or 0), float(k.k_theta or 0)
        time_constant = max(motion.prefilter, period)
        gain, lag = (
            (robot.velocity_gain, robot.velocity_time_constant),
            (robot.rotation_gain, robot.rotation_time_constant),
        )[channel]
        i, c, p, h, u, r = n, n + 1, n + 2, n + 3, n + 4, n + 4 + late
        size = n + 4 + 2 * late  # plant, integral, correction, position, heading, voltages, rates

        def moved(begins: float, ends: float, position: float, heading: float) -> tuple[float, float]:
            """Position and heading error after a period in which the velocity changes uniformly."""
            step = period * (begins + ends) / 2
            if channel == 0:
                return position - step, 0.0
            return position + period * speed * (2 * heading - step) / 2, heading - step

        def after(s: Array, disturbance: float) -> Array:
            new, v, position, heading = s.copy(), s[0], s[p], s[h]
            for rate in s[r:]:  # predicted over the delay
                position, heading = moved(v, v + period * rate, position, heading)
                v += period * rate
            request = k_x * position if channel == 0 else speed * (k_y * position + k_theta * heading)
            rate = (request - s[c]) / time_constant
            new[c] = s[c] + period * rate
            new[i] = s[i] + period * gains.k_i * (new[c] - v)
            forward = new[c] if rigid and channel == 1 else (new[c] + lag * rate) / gain
            voltage = gains.k_p * (new[c] - v) + new[i] + forward + disturbance
            queue = np.append(s[u:r], voltage)
            new[u:r], new[r:] = queue[1:], np.append(s[r:], rate)[1:]
            new[:n] = held.a @ s[:n] + held.b * queue[0]
            new[p], new[h] = moved(s[0], new[0], s[p], s[h])
            return new

        self.step = np.stack([after(column, 0.0) for column in np.eye(size)], axis=1)
        self.pulse = after(np.zeros(size), 1.0)
        self.errors = np.zeros((3, size))
        self.errors[0, c], self.errors[0, 0], self.errors[1, p], self.errors[2, h] = 1.0, -1.0, 1.0, HEADING_ARM
        self.state = {"velocity": 0, "integral": i, "correction": c, "position": p, "heading": h}
        self._doublings = int(np.ceil(np.log2(RESPONSE_TIME / period)))
        self._holds_posture = k_x > 0 if channel == 0 else k_y > 0 and k_theta > 0

    def response(self, state: Array, doublings: int = 0) -> Array:
        """Velocity error, position error and `HEADING_ARM` times the heading error after a state, `(3, n)`.

        Args:
            state: The state.
            doublings: n is 2 to this power; 0 for what `RESPONSE_TIME` is.
        """
        states, power = state[:, None], self.step
        for _ in range(doublings or self._doublings):  # x(n … 2n) = Aⁿ x(0 … n)
            states, power = np.hstack([states, power @ states]), power @ power
        return self.errors @ states

    def sums(self) -> tuple[float, float]:
        """‖G‖₁ of the velocity error and of the posture error; infinite where they do not settle.

        The length of two errors never exceeds L if no combination cos φ e₁ + sin φ e₂ does.
        """
        if np.abs(np.linalg.eigvals(self.step)).max() > 1 + 1e-9:
            return np.inf, np.inf
        angles = np.pi / DIRECTIONS * np.arange(DIRECTIONS)
        directions = np.zeros((1 + DIRECTIONS, 3))
        directions[0, 0], directions[1:, 1], directions[1:, 2] = 1.0, np.cos(angles), np.sin(angles)
        doublings = self._doublings
        while True:
            errors = np.abs(directions @ self.response(self.pulse, doublings))
            sums, late = errors.sum(axis=1), errors[:, errors.shape[1] // 2 :].sum(axis=1)
            settled = late <= SETTLED * sums
            if doublings >= MAX_DOUBLINGS or settled[0] and (settled[1:].all() or not self._holds_posture):
                break
            doublings += 1
        velocity, posture = sums[0] if settled[0] else np.inf, sums[1:].max() if settled[1:].all() else np.inf
        between = np.cos(np.pi / (2 * DIRECTIONS))  # of the worst combination with the next one that is looked at
        return float(velocity), float(posture / between)
