"""The velocity controller: PID on linear velocity and yaw rate, with gains by `design` or by the IMC rule."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field

from mrctl.control.design import design
from mrctl.control.margins import Gains
from mrctl.kernel import Array, Row, kernel
from mrctl.record import Record
from mrctl.theory.perturbation import MAX_DELAY
from mrctl.theory.robot import Robot

Pair = tuple[float, float]


@kernel
def pid(command: Array, twist: Array, excess: Array, period: float, s: Row, feedback: Array) -> None:
    """PID with filtered derivative and anti-windup by back-calculation, for both channels.

        U = K_p e + ∫ (K_i e + K_i/K_p · excess) dt + K_d ė,    e = command − twist

    The excess is the output after saturation less that before it. It unwinds the integral with the time constant
    K_p/K_i, or within a control period if K_p/K_i is shorter (Åström and Hägglund, Advanced PID Control, 2006, ch. 3).

    Args:
        command: Commanded V in m/s and θ̇ in rad/s, `(2,)`.
        twist: Estimated V in m/s and θ̇ in rad/s, `(2,)`.
        excess: Excess of the last period, in the units of `feedback`, `(2,)`.
        period: Control period in s.
        s: In and out: a record of `PID`.
        feedback: Out: U of the two channels in V (rad/s on a steering channel), `(2,)`.
    """
    for k in range(2):
        error = command[k] - twist[k]
        slope = (error - s.error[k]) / period if s.started else 0.0
        s.slope[k] += period / (s.filter[k] + period) * (slope - s.slope[k])
        # an excess leaves the integral with the time constant K_p/K_i, at least a period
        unwind = s.k_i[k] / max(s.k_p[k], s.k_i[k] * period) * excess[k] if s.k_i[k] > 0 else 0.0
        s.integral[k] += period * (s.k_i[k] * error + unwind)
        s.error[k] = error
        feedback[k] = s.k_p[k] * error + s.integral[k] + s.k_d[k] * s.slope[k]
    s.started = True


PID = np.dtype(
    [
        ("k_p", "f8", 2),  # gains of the two channels: V/(m/s) and V/(rad/s) (rad/s per rad/s on a steering channel)
        ("k_i", "f8", 2),  # the same per second
        ("k_d", "f8", 2),  # the same times seconds
        ("filter", "f8", 2),  # time constant of the derivative's filter, s
        ("integral", "f8", 2),  # integral part of the output, V (rad/s on a steering channel)
        ("slope", "f8", 2),  # filtered derivative of the error, m/s² and rad/s²
        ("error", "f8", 2),  # last error, m/s and rad/s
        ("started", "?"),  # whether there is a last error
    ],
    align=True,
)


class Pid(Record):
    """Settings of the velocity PID; its gains are as large as the delay allows, or follow the IMC rule with a λ."""

    time_constant: Annotated[float, Field(ge=0.03, le=2)] | None = None
    """Closed-loop time constant λ of both channels in s, with which the IMC rule sets K_p = τ/(K λ) and K_i = 1/(K λ)
    for the plant K/(τ s + 1); by default the gains are the largest that the delay allows."""
    delay: Annotated[float, Field(ge=0, le=MAX_DELAY)] | None = None
    """Delay from measurement to voltage in s that the design of the gains assumes; by default `sensing.delay` and,
    except with the estimator `truth`, the largest latency of encoders, gyro and accelerometer and the mean age of the
    samples of slow ones; without effect with `time_constant`."""
    retune: bool = True
    """Whether each oscillation slows the controllers for the rest of the run, as 10 ms more delay would: in turn the
    motion controller with the learner, and the PID; without effect with `time_constant`."""
    lag: Annotated[float, Field(ge=0, le=0.5)] = 0.0
    """Time constant in s by which, as the design assumes, the measured velocities lag behind the true ones; without
    effect with `time_constant`."""
    derivative_time: Annotated[float, Field(ge=0, le=0.5)] = 0.0
    """Derivative time K_d/K_p in s; none by default, as the gains are designed for PI control."""
    derivative_filter: Annotated[float, Field(ge=0.005, le=1)] = 0.03
    """Time constant of the filter on the derivative in s."""
    steering_kp: Annotated[float, Field(ge=0, le=10)] | None = None
    """Proportional gain of the second channel under `rigid` steering in rad/s per rad/s; by default it follows from the
    delay or from λ."""
    steering_ki: Annotated[float, Field(ge=0, le=50)] | None = None
    """Integral gain of the second channel under `rigid` steering in 1/s; by default it follows from the delay or from
    λ."""

    def gains(self, robot: Robot, rigid: bool, delay: float = 0.0, period: float = 0.01) -> dict[str, Pair]:
        """Returns the settings of the record `PID` by name, each for the common and the second channel.

        The common channel is in V per m/s; the second in V per rad/s, or in rad/s per rad/s if `rigid`.

        Args:
            robot: The nominal robot in its steering arrangement.
            rigid: Whether the second channel is steering.
            delay: Delay from measurement to voltage in s, for a record whose field `delay` is not set.
            period: Control period in s.
        """
        common, second = self.channels(robot, rigid, delay, period)
        return {
            "k_p": (common.k_p, second.k_p),
            "k_i": (common.k_i, second.k_i),
            "k_d": (common.k_p * self.derivative_time, second.k_p * self.derivative_time),
            "filter": (self.derivative_filter, self.derivative_filter),
        }

    def channels(self, robot: Robot, rigid: bool, delay: float = 0.0, period: float = 0.01) -> tuple[Gains, Gains]:
        """Returns proportional and integral gains of the two channels, with the arguments and units of `gains`."""
        if self.time_constant is None:
            allowed = delay if self.delay is None else self.delay
            common, second = design(robot, rigid, allowed, self.lag, period)
        else:
            common, second = imc(robot, self.time_constant)
            if rigid:
                faster = STEERING_TIME_CONSTANT / self.time_constant
                second = Gains(STEERING_GAINS.k_p * faster, STEERING_GAINS.k_i * faster)
        if rigid:
            k_p = second.k_p if self.steering_kp is None else self.steering_kp
            k_i = second.k_i if self.steering_ki is None else self.steering_ki
            second = Gains(k_p, k_i)
        return common, second


STEERING_GAINS, STEERING_TIME_CONSTANT = Gains(0.3, 5.0), 0.15
"""Gains of a steering channel, in rad/s per rad/s and 1/s, at this λ in s; they scale with 1/λ. *Chosen*."""


def imc(robot: Robot, time_constant: float) -> tuple[Gains, Gains]:
    """IMC design of PI control of the first-order plant K/(τs + 1), for the common and the differential channel.

        K_p = τ/(K λ),    K_i = 1/(K λ)        (Rivera, Morari and Skogestad 1986)

    K and τ are those of equation (3), without the fork. The gains are in V/(m/s) and V/m, and in V/(rad/s) and V/rad.

    Args:
        robot: The nominal robot.
        time_constant: Closed-loop time constant λ in s.
    """
    plants = (
        (robot.velocity_gain, robot.velocity_time_constant),
        (robot.rotation_gain, robot.rotation_time_constant),
    )
    common, differential = (Gains(tau / (k * time_constant), 1 / (k * time_constant)) for k, tau in plants)
    return common, differential
