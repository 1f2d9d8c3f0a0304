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

from typing import Annotated

import numpy as np
from numba import float64, guvectorize
from numpy.typing import NDArray
from pydantic import Field

from mrctl.control.chain import one
from mrctl.control.feedforward import Array, InverseDynamics, features
from mrctl.record import Record
from mrctl.theory.dynamics import inverse_coefficients
from mrctl.theory.robot import Robot


class Observer(Record):
    """Settings of the `observer` feedforward."""

    time_constant: Annotated[float, Field(ge=0.02, le=10)] = 0.055
    """Time constant T of Q, s: the shortest, to 5 ms, that keeps the sensitivity below 2 with a delay of 20 ms, a hold
    of half a period and λ = 0.15 s. With that hold the phase margin is 43° there, 72° without delay, 14° with 40 ms."""


_features, _ONES = one(features), np.ones(8)


@guvectorize(
    [(float64[:], float64[:], float64[:, :], float64, float64, float64, float64[:], float64[:])],
    "(u),(u),(f,u),(),(),(),(m),(u)",
    writable_args=("state", "disturbance"),
    cache=True,
)
def observe(twist, sent, coefficients, half_track, time_constant, period, state, disturbance):  # noqa: ANN001, ANN201
    """One step of the observer, for one robot.

    Q is 1/(T s + 1) by implicit Euler, so that Q of the twist's difference quotient is its own.

    Args:
        twist: Measured V and θ̇ `(2,)`, on which `sent` has not acted yet.
        sent: Voltage from now on, after the limits, in the two channels `(2,)`.
        coefficients: Of the nominal inverse on features without scale, `(8, 2)`.
        half_track: D in m.
        time_constant: T in s.
        period: Control period in s.
        state: In and out: Q of the twist `(2,)`, Q of the voltage less the model at no acceleration `(2,)`, voltage
            that was sent last `(2,)`, started `(1,)`.
        disturbance: Out: d̂ of the two channels `(2,)`.
    """
    x, rate = np.empty(8), np.zeros(2)
    share = period / (time_constant + period)
    _features(twist, rate, half_track, _ONES, x)
    for k in range(2):
        if state[6] == 0:
            state[k] = twist[k]
        else:
            residual = state[4 + k]
            for j in range(8):
                residual -= coefficients[j, k] * x[j]
            state[2 + k] += share * (residual - state[2 + k])
            state[k] += share * (twist[k] - state[k])
        state[4 + k] = sent[k]
    if state[6] > 0:
        for k in range(2):
            rate[k] = (twist[k] - state[k]) / time_constant
        for k in range(2):
            disturbance[k] = state[2 + k] - coefficients[2, k] * rate[0] - coefficients[3, k] * rate[1]
    state[6] = 1.0


class DisturbanceObserver:
    """`observer` for B robots.

    Attributes:
        state: `filters` `(B, 7)`, as in `observe`, and `disturbance` `(B, 2)`.
    """

    def __init__(self, robot: Robot, settings: list[Observer], rigid: bool, period: float) -> None:
        """Takes the nominal robot, settings a row, whether channel two is steering, and the control period in s."""
        size = len(settings)
        self._model = InverseDynamics([robot] * size, rigid)
        self._half_track, self._period = robot.half_track, period
        self._time_constant = np.array([s.time_constant for s in settings])
        self._coefficients = inverse_coefficients(robot)
        self._steers = float(rigid)
        if rigid:  # the nominal steering makes the rotation that is asked of it
            self._coefficients[:, 1] = 0.0
            self._coefficients[1, 1] = 1.0
        self._sent = np.zeros((size, 2))
        self._asked = np.zeros(size)
        self.state = {"filters": np.zeros((size, 7)), "disturbance": np.zeros((size, 2))}

    def restore(self, rows: NDArray[np.intp]) -> None:
        """Takes robots back to no disturbance."""
        for array in self.state.values():
            array[rows] = 0.0

    def output(self, command: Array, derivative: Array) -> Array:
        """Voltages of the nominal inverse dynamics, and the disturbance as last observed."""
        self._asked[:] = command[:, 1]
        return self._model.output(command, derivative) + self.state["disturbance"]

    def learn(self, feedback: Array, saturated: Array, twist: Array, voltage: Array) -> None:
        """One step of the observer, whether or not robots may learn: it has nothing to forget."""
        self._sent[:] = voltage
        self._sent[:, 1] += self._steers * self._asked  # a steering channel corrects what is asked of the geometry
        state = self.state
        observe(
            twist, self._sent, self._coefficients, self._half_track, self._time_constant, self._period,
            state["filters"], state["disturbance"],
        )  # fmt: skip
