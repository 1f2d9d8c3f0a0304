"""The velocity controller: PID on linear and rotation velocity, and its design from equation (3)."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from mrctl.control.design import design
from mrctl.control.margins import Gains
from mrctl.kernel import Array, Row, kernel
from mrctl.record import InputError, Record
from mrctl.theory.perturbation import LONGEST_DELAY
from mrctl.theory.robot import Robot

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


@kernel
def pid(command: Array, twist: Array, excess: Array, period: float, s: Row, feedback: Array) -> None:
    """PID with filtered derivative and anti-windup by back-calculation, for both channels.

        U = K_p e + ∫ (K_i e + K_i/K_p · excess) dt + K_d ė,    e = command − twist

    The excess is the output after saturation less that before it. It unwinds the integral with the time constant
    K_p/K_i, or within a control period if K_p/K_i is shorter (Åström and Hägglund, Advanced PID Control, 2006, ch. 3).

    Args:
        command: Commanded V in m/s and θ̇ in rad/s, `(2,)`.
        twist: Measured V in m/s and θ̇ in rad/s, `(2,)`.
        excess: Excess of the last period, in the units of `feedback`, `(2,)`.
        period: Control period in s.
        s: In and out: a record of `PID`.
        feedback: Out: U of the two channels in V (rad/s on a steering channel), `(2,)`.
    """
    for k in range(2):
        error = command[k] - twist[k]
        slope = (error - s.error[k]) / period if s.started else 0.0
        s.slope[k] += period / (s.filter[k] + period) * (slope - s.slope[k])
        unwind = s.k_i[k] / max(s.k_p[k], s.k_i[k] * period) * excess[k] if s.k_i[k] > 0 else 0.0
        s.integral[k] += period * (s.k_i[k] * error + unwind)
        s.error[k] = error
        feedback[k] = s.k_p[k] * error + s.integral[k] + s.k_d[k] * s.slope[k]
    s.started = True


class Pid(Record):
    """Design of the velocity controller; the gains follow from the robot's nominal equation (3)."""

    rule: Literal["imc", "designed"] = "imc"
    """Rule for the gains: `imc` from `time_constant` and equation (3), or `designed`, as fast as the delay allows."""
    time_constant: Annotated[float, Field(ge=0.03, le=2)] = 0.15
    """Closed-loop time constant λ of both channels in s; the IMC rule sets K_p = τ/(K λ) and K_i = 1/(K λ)."""
    delay: Annotated[float, Field(ge=0, le=LONGEST_DELAY)] = 0.0
    """Delay from measurement to voltage in s for which the gains are `designed`; that of the hold is not counted."""
    lag: Annotated[float, Field(ge=0, le=0.5)] = 0.0
    """Time constant in s for which the gains are `designed`: that with which the measured velocities follow."""
    derivative_time: Annotated[float, Field(ge=0, le=0.5)] = 0.0
    """Derivative time K_d/K_p in s; the rule for a first-order plant needs no derivative action."""
    derivative_filter: Annotated[float, Field(ge=0.005, le=1)] = 0.03
    """Time constant of the filter on the derivative in s."""
    steering_kp: Annotated[float, Field(ge=0, le=10)] = 0.3
    """Proportional gain of the second channel under `rigid` steering by the rule `imc`, in rad/s per rad/s."""
    steering_ki: Annotated[float, Field(ge=0, le=50)] = 5.0
    """Integral gain of the second channel under `rigid` steering by the rule `imc`, in 1/s."""

    def gains(self, robot: Robot, rigid: bool, period: float = 0.01) -> dict[str, tuple[float, float]]:
        """Returns the settings of the record `PID` by name, each for the common and the second channel.

        The common channel is in V per m/s; the second in V per rad/s, or in rad/s per rad/s if `rigid`.

        Args:
            robot: The nominal robot in its steering arrangement.
            rigid: Whether the second channel is steering.
            period: Control period in s.
        """
        common, second = self.channels(robot, rigid, period)
        return {
            "k_p": (common.k_p, second.k_p),
            "k_i": (common.k_i, second.k_i),
            "k_d": (common.k_p * self.derivative_time, second.k_p * self.derivative_time),
            "filter": (self.derivative_filter, self.derivative_filter),
        }

    def channels(self, robot: Robot, rigid: bool, period: float = 0.01) -> tuple[Gains, Gains]:
        """Returns proportional and integral gains of the two channels, with the arguments and units of `gains`."""
        if self.rule == "designed":
            return design(robot, rigid, self.delay, self.lag, period)
        common, differential = imc(robot, self.time_constant)
        return common, Gains(self.steering_kp, self.steering_ki) if rigid else differential

    def faster(self, factor: float) -> Pid:
        """Returns the design whose gains are all multiplied by `factor`, the closed-loop time constant divided by it.

        Raises:
            InputError: A field is then out of its range, or the gains are `designed`, which leaves no room.
        """
        if self.rule == "designed":
            raise InputError("rule: designed gains are already as large as the delay allows; use imc")
        changed = {
            "time_constant": self.time_constant / factor,
            "steering_kp": self.steering_kp * factor,
            "steering_ki": self.steering_ki * factor,
        }
        return Pid.from_dict(self.model_dump() | changed)


PIDS: dict[str, Pid] = {"normal": Pid(), "fast": Pid().faster(2)}
"""PIDs of the comparisons: the default, and one twice as fast, which leaves less for a feedforward to gain."""


def imc(robot: Robot, time_constant: float) -> tuple[Gains, Gains]:
    """IMC design of PI control of the first-order plant K/(τs + 1), for the common and the differential channel.

        K_p = τ/(K λ),    K_i = 1/(K λ)        (Rivera, Morari and Skogestad 1986)

    The gains are in V/(m/s) and V/m, and in V/(rad/s) and V/rad.

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
