"""PID on linear and rotation velocity, and its design from equation (3)."""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np
from numba import float64, guvectorize
from numpy.typing import NDArray
from pydantic import Field

from mrctl.record import Record
from mrctl.robot import Robot


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


class Margins(NamedTuple):
    """How robust one velocity loop is, and where feedback-error learning converges in it.

    Attributes:
        crossover: Gain crossover in rad/s.
        phase: Phase margin in degrees.
        gain: Gain margin as a factor.
        delay: Delay margin in s.
        ratio: K_p (B + b K_p) / (M K_i) of the delay-free loop; learning converges above 1 (Gomi and Kawato 1993).
        positive_to: Frequency in rad/s up to which Re T(jω) > 0 with delay and hold; learning is safe below it.
    """

    crossover: float
    phase: float
    gain: float
    delay: float
    ratio: float
    positive_to: float


def margins(gain: float, time_constant: float, gains: Gains, delay: float) -> Margins:
    """Margins of PI control of K/(τs + 1) behind a delay, on a fine frequency grid.

    Args:
        gain: K.
        time_constant: τ in s.
        gains: PI gains.
        delay: Loop delay in s: half a control period of hold, plus what the plant adds.
    """
    w = np.geomspace(1e-2, 1e4, 400_001)
    loop = (gains.k_p + gains.k_i / (1j * w)) * gain / (1j * w * time_constant + 1) * np.exp(-1j * w * delay)
    magnitude, phase = np.abs(loop), np.unwrap(np.angle(loop))
    crossing = int(np.argmax(magnitude < 1))
    phase_margin = np.pi + phase[crossing]
    inverted = np.flatnonzero(phase < -np.pi)
    sensitivity = (loop / (1 + loop)).real
    negative = np.flatnonzero(sensitivity <= 0)
    return Margins(
        crossover=float(w[crossing]),
        phase=float(np.degrees(phase_margin)),
        gain=float(1 / magnitude[inverted[0]]) if inverted.size else float("inf"),
        delay=float(phase_margin / w[crossing]),
        # The plant K/(τs + 1) is M V̇ + B V = b U with M = τ, B = 1, b = K.
        ratio=gains.k_p * (1 + gain * gains.k_p) / (time_constant * gains.k_i),
        positive_to=float(w[negative[0]]) if negative.size else float("inf"),
    )
