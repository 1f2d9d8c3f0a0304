"""Nominal model with a disturbance observer on the voltage: the classical answer, which does not learn.

Ohnishi (1987), Umeno and Hori (1991): what was sent beyond what the nominal inverse dynamics takes for the motion that
came of it is a disturbance, and its low-pass is added to what is sent next:

    U = model(command) + d̂,    d̂ = Q (U − model(motion)),    Q = 1/(T s + 1)

The model is affine in the accelerations, and Q V̇ = (V − Q V)/T: nothing is differentiated.

With the IMC rule's PI, C P = 1/(λ s) for the nominal plant P, the loop opened at the voltage behind a delay L is

    (C P + Q)/(1 − Q) e^(−Ls) = (1/(λ s) + 1/(T s) + 1/(λ T s²)) e^(−Ls)

which has two integrators on purpose, and a zero that pays for them. The PID's integral keeps what it holds: handing
half of d̂ over would turn 1 − Q into 1 − Q/2, which does not vanish at s = 0, and take away what the observer is for.
"""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from mrctl.control.features import features
from mrctl.control.feedforward import CompiledFeedforward, InverseDynamics, inverse_dynamics
from mrctl.kernel import Array, Row, kernel
from mrctl.record import Record
from mrctl.theory.dynamics import inverse_coefficients
from mrctl.theory.robot import Robot


class Observer(Record):
    """Settings of the `observer` feedforward."""

    time_constant: Annotated[float, Field(ge=0.02, le=10)] = 0.055
    """Time constant T of Q, s: the shortest, to 5 ms, that keeps the sensitivity below 2 with a delay of 20 ms, a hold
    of half a period and λ = 0.15 s. With that hold the phase margin is 43° there, 72° without delay, 14° with 40 ms."""


OBSERVER = np.dtype(
    [
        ("time_constant", "f8"),  # T of Q, s
        ("twist", "f8", 2),  # Q of the measured V and θ̇, m/s and rad/s
        ("voltage", "f8", 2),  # Q of the voltage less the model at no acceleration, V
        ("sent", "f8", 2),  # voltage of the period that has passed, V
        ("disturbance", "f8", 2),  # d̂ of the two channels, V
        ("started", "?"),  # whether a period has passed
        ("x", "f8", 8),  # features of the measured motion
        ("rate", "f8", 2),  # its acceleration, m/s² and rad/s²
    ],
    align=True,
)


@kernel
def observe(twist: Array, sent: Array, c: Array, ones: Array, half_track: float, period: float, s: Row) -> None:
    """One step of the observer, for the model c · x = c_V V + c_ω ω + c_V̇ V̇ + c_ω̇ ω̇ + ….

        d̂ = Q (U − c · x at no acceleration) − c_V̇ (V − Q V)/T − c_ω̇ (ω − Q ω)/T

    Q is 1/(T s + 1) by implicit Euler, so that Q of the twist's difference quotient is (V − Q V)/T.

    Args:
        twist: Measured V and θ̇ `(2,)`, on which `sent` has not acted yet.
        sent: Voltage from now on, after the limits, in the two channels `(2,)`.
        c: Coefficients of the nominal inverse on features without scale, `(8, 2)`.
        ones: The scale of such features, `(8,)`.
        half_track: D in m.
        period: Control period in s.
        s: In and out: a record of `OBSERVER`, whose `disturbance` is the result.
    """
    share = period / (s.time_constant + period)
    s.rate[0] = s.rate[1] = 0.0
    features(twist, s.rate, half_track, ones, s.x)
    for k in range(2):
        if s.started:
            residual = s.sent[k]
            for j in range(8):
                residual -= c[j, k] * s.x[j]
            s.voltage[k] += share * (residual - s.voltage[k])
            s.twist[k] += share * (twist[k] - s.twist[k])
            s.rate[k] = (twist[k] - s.twist[k]) / s.time_constant
        else:
            s.twist[k] = twist[k]
        s.sent[k] = sent[k]
    for k in range(2):
        s.disturbance[k] = s.voltage[k] - c[2, k] * s.rate[0] - c[3, k] * s.rate[1]
    s.started = True


@kernel
def respond(i: int, command: Array, derivative: Array, robot: Row, arrays: tuple[Any, ...], voltage: Array) -> None:
    """U = model(command) + d̂, with d̂ as last observed."""
    model, rows, _, _ = arrays
    inverse_dynamics(i, command, derivative, robot, model, voltage)
    for k in range(2):
        voltage[k] += rows[i].disturbance[k]


@kernel
def learn(
    i: int, command: Array, feedback: Array, frozen: float, twist: Array, voltage: Array, period: float, robot: Row,
    arrays: tuple[Any, ...], added: Array,
) -> float:  # fmt: skip
    """One step of the observer, whether or not the robot may learn: it has nothing to forget."""
    model, rows, coefficients, sent = arrays
    sent[0], sent[1] = voltage[0], voltage[1]
    if robot.rigid:
        sent[1] += command[1]  # a steering channel corrects what is asked of the geometry
    observe(twist, sent, coefficients, model[2], robot.half_track, period, rows[i])
    added[0] = added[1] = 0.0
    return 0.0


class DisturbanceObserver(CompiledFeedforward):
    """`observer` for B robots.

    Attributes:
        rows: One record of `OBSERVER` a robot.
    """

    respond, learn_one = respond, learn

    def __init__(self, robot: Robot, settings: list[Observer], rigid: bool, period: float) -> None:
        """Takes the nominal robot, settings a row, whether channel two is steering, and the control period in s."""
        super().__init__(robot, len(settings), rigid, period)
        coefficients = inverse_coefficients(robot)
        if rigid:  # the nominal steering makes the rotation that is asked of it
            coefficients[:, 1] = 0.0
            coefficients[1, 1] = 1.0
        self.rows = np.zeros(len(settings), OBSERVER)
        self.rows["time_constant"] = [s.time_constant for s in settings]
        model = InverseDynamics([robot] * len(settings), rigid)
        self.arrays = model.arrays, self.rows, np.ascontiguousarray(coefficients), np.zeros(2)

    def restore(self, rows: NDArray[np.intp]) -> None:
        """Takes robots back to no disturbance."""
        for name in ("twist", "voltage", "sent", "disturbance", "started"):
            self.rows[name][rows] = 0
