"""PID on linear and rotation velocity, and its design from equation (3)."""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np
from numba import float64, guvectorize
from numpy.typing import NDArray
from pydantic import Field

from mrctl.record import Record
from mrctl.theory.robot import Robot


class Pid(Record):
    """Design of the velocity controller; the gains follow from the robot's nominal equation (3)."""

    time_constant: Annotated[float, Field(ge=0.03, le=2)] = 0.15
    """Closed-loop time constant λ of both channels in s (IMC rule: K_p = τ/(K λ), K_i = 1/(K λ))."""
    derivative_time: Annotated[float, Field(ge=0, le=0.5)] = 0.0
    """K_d / K_p in s; the rule for a first-order plant asks for none."""
    derivative_filter: Annotated[float, Field(ge=0.005, le=1)] = 0.03
    """Time constant of the derivative's filter in s."""
    steering_kp: Annotated[float, Field(ge=0, le=10)] = 0.3
    """Proportional gain of the second channel under `rigid` steering, rad/s per rad/s."""
    steering_ki: Annotated[float, Field(ge=0, le=50)] = 5.0
    """Its integral gain in 1/s."""

    def gains(self, robot: Robot, rigid: bool) -> NDArray[np.float64]:
        """Gains `(2, 4)`: a row a channel of K_p, K_i, K_d and the derivative filter's time constant.

        The common channel is in volts per m/s; the second in volts per rad/s, or in rad/s per rad/s if `rigid`.
        """
        common, differential = imc(robot, self.time_constant)
        second = Gains(self.steering_kp, self.steering_ki) if rigid else differential
        derivative = self.derivative_time, self.derivative_filter
        return np.array([[g.k_p, g.k_i, g.k_p * derivative[0], derivative[1]] for g in (common, second)])

    def faster(self, factor: float) -> Pid:
        """The same rule with the closed-loop time constant divided: every gain is multiplied by `factor`.

        Raises:
            InputError: This leaves the range of a field.
        """
        changed = {
            "time_constant": self.time_constant / factor,
            "steering_kp": self.steering_kp * factor,
            "steering_ki": self.steering_ki * factor,
        }
        return Pid.from_dict(self.model_dump() | changed)


PIDS: dict[str, Pid] = {"normal": Pid(), "fast": Pid().faster(2)}
"""The feedback of every comparison: everyone's, and one twice as fast, which leaves less for a feedforward to gain."""


class Gains(NamedTuple):
    """Proportional and integral gain of one channel."""

    k_p: float
    k_i: float


def imc(robot: Robot, time_constant: float) -> tuple[Gains, Gains]:
    """IMC design for the common (V/(m/s), V/m) and the differential channel (V/(rad/s), V/rad).

    Rivera, Morari and Skogestad (1986) for a first-order plant K/(τs + 1): K_p = τ/(K λ), K_i = 1/(K λ).

    Args:
        robot: Nominal parameters.
        time_constant: λ in s.
    """
    plants = (
        (robot.velocity_gain, robot.velocity_time_constant),
        (robot.rotation_gain, robot.rotation_time_constant),
    )
    common, differential = (Gains(tau / (k * time_constant), 1 / (k * time_constant)) for k, tau in plants)
    return common, differential


@guvectorize(
    [(float64[:], float64[:], float64[:, :], float64, float64[:], float64[:], float64[:])],
    "(u),(u),(u,g),(),(u),(m),(u)",
    writable_args=("state", "output"),
    cache=True,
)
def pid(command, twist, gains, period, excess, state, output):  # noqa: ANN001, ANN201
    """PID with filtered derivative and anti-windup by back-calculation, for one robot and both channels.

    Args:
        command: Commanded twist `(2,)` in m/s, rad/s.
        twist: Measured twist `(2,)`.
        gains: `(2, 4)` as from `Pid.gains`.
        period: Control period, s.
        excess: What saturation took from the last output, `(2,)`; it unwinds the integral over K_p/K_i, or a period.
        state: In and out: integrals `(2,)`, filtered derivative of the error `(2,)`, last error `(2,)`, started `(1,)`.
        output: Out: feedback in volts, `(2,)`.
    """
    for i in range(2):
        k_p, k_i, k_d, filtering = gains[i, 0], gains[i, 1], gains[i, 2], gains[i, 3]
        error = command[i] - twist[i]
        slope = (error - state[4 + i]) / period if state[6] > 0 else 0.0
        state[2 + i] += period / (filtering + period) * (slope - state[2 + i])
        unwind = k_i / max(k_p, k_i * period) * excess[i] if k_i > 0 else 0.0
        state[i] += period * (k_i * error + unwind)
        state[4 + i] = error
        output[i] = k_p * error + state[i] + k_d * state[2 + i]
    state[6] = 1.0


def sampled_loop(
    frequency: NDArray[np.float64], gain: float, time_constant: float, gains: Gains, period: float, delay: float
) -> NDArray[np.complex128]:
    """The open velocity loop L(e^(jωh)) of PI control, as `pid` computes it, of a held K/(τs + 1) behind a delay.

    Args:
        frequency: ω in rad/s, below π/h, `(F,)`.
        gain: K.
        time_constant: τ in s; 0 for a plant that follows within a period.
        gains: PI gains.
        period: Control period h in s.
        delay: Loop delay in s beside the hold.
    """
    z = np.exp(1j * frequency * period)
    decay = np.exp(-period / time_constant) if time_constant > 0 else 0.0
    plant = gain * (1 - decay) / (z - decay)
    control = gains.k_p + gains.k_i * period * z / (z - 1)
    return np.asarray(control * plant * np.exp(-1j * frequency * delay), complex)


class Margins(NamedTuple):
    """How fast and how robust one loop is; NaN where its size is below one from the lowest frequency on.

    Attributes:
        crossover: Gain crossover in rad/s.
        phase: Phase margin in degrees.
        gain: Gain margin as a factor.
        delay: Delay margin in s.
        bandwidth: Frequency in rad/s from which on the closed loop passes less than 1/√2.
    """

    crossover: float
    phase: float
    gain: float
    delay: float
    bandwidth: float


def margins(frequency: NDArray[np.float64], loop: NDArray[np.complex128]) -> Margins:
    """Margins of an open loop on a fine grid of frequencies.

    Args:
        frequency: ω in rad/s, ascending, `(F,)`.
        loop: L(jω), `(F,)`.
    """
    magnitude, phase = np.abs(loop), np.unwrap(np.angle(loop))
    phase -= 2 * np.pi * np.round((phase[0] + np.pi / 2) / (2 * np.pi))  # PI control starts between 0 and −180°
    crossover, phase_margin, bandwidth = np.nan, np.nan, np.nan
    if magnitude[0] > 1 > magnitude[-1]:
        crossing = int(np.argmax(magnitude < 1))
        crossover, phase_margin = frequency[crossing], np.pi + phase[crossing]
    passed = np.abs(loop / (1 + loop)) < np.sqrt(0.5)
    if passed.any() and not passed[0]:
        bandwidth = frequency[int(np.argmax(passed))]
    inverted = np.flatnonzero((phase < -np.pi) & (magnitude < 1))
    return Margins(
        crossover=float(crossover),
        phase=float(np.degrees(phase_margin)),
        gain=float(1 / magnitude[inverted[0]]) if inverted.size else float("inf"),
        delay=float(phase_margin / crossover),
        bandwidth=float(bandwidth),
    )


def learning_ratio(gain: float, time_constant: float, gains: Gains) -> float:
    """K_p (B + b K_p) / (M K_i) of PI control of K/(τs + 1); above 1, feedback-error learning converges without delay.

    Gomi and Kawato (1993) for M V̇ + B V = b U; here M = τ, B = 1, b = K.
    """
    return gains.k_p * (1 + gain * gains.k_p) / (time_constant * gains.k_i)
