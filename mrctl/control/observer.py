"""A disturbance observer on the voltage beside a model as prior: the classical method, which does not learn.

Ohnishi (1987), Umeno and Hori (1991): the voltage that was sent, less the voltage that the nominal inverse dynamics
needs for the measured motion, is the disturbance. The next voltage contains its low-pass:

    U = model(command) + d̂,    d̂ = Q (U − model(motion)),    Q = 1/(T s + 1)

The model is affine in the accelerations, and Q V̇ = (V − Q V)/T: nothing is differentiated.

With the IMC rule's PI, C P = 1/(λ s) for the nominal plant P, the loop opened at the voltage behind a delay L is

    (C P + Q)/(1 − Q) e^(−Ls) = (1/(λ s) + 1/(T s) + 1/(λ T s²)) e^(−Ls)

which has two integrators on purpose, and a zero that restores the phase. The observer takes nothing out of the PID's
integral: if half of d̂ were handed over, 1 − Q would become 1 − Q/2, which does not vanish at s = 0, and a constant
disturbance would no longer be rejected by the observer.
"""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from mrctl.control.features import OMEGA_DOT, V_DOT
from mrctl.control.feedforward import Learner, Loop, Shown, explained
from mrctl.control.matching import sent
from mrctl.kernel import Array, Row, kernel
from mrctl.record import Record


@kernel
def observe(shown: Shown, rigid: bool, prior: Row, s: Row) -> None:
    """One step of the observer, for the model c · x = c_V V + c_ω ω + c_V̇ V̇ + c_ω̇ ω̇ + ….

        d̂ = Q (U − c · x|V̇=ω̇=0) − c_V̇ (V − Q V)/T − c_ω̇ (ω − Q ω)/T

    Q = 1/(T s + 1) is discretised by implicit Euler, for which Q of the difference quotient of V is (V − Q V)/T. U and
    the quotient belong to the period that ends now, and so does c · x, of which the mean of its two ends is taken: with
    the end alone, d̂ would contain c_V V̇ h/2.

    Args:
        shown: What this tick shows of the robot.
        rigid: Whether the second channel is steering.
        prior: The model, a record of `PRIOR`.
        s: In and out: a record of `OBSERVER`, whose `disturbance` is the result.
    """
    twist, share = shown.twist, shown.period / (s.time_constant + shown.period)
    s.rate[0] = s.rate[1] = 0.0
    for k in range(2):
        s.before[k] = s.steady[k]
    explained(twist, s.rate, rigid, prior, s.steady)
    for k in range(2):
        if s.started:
            s.voltage[k] += share * (s.sent[k] - (s.before[k] + s.steady[k]) / 2 - s.voltage[k])
            s.twist[k] += share * (twist[k] - s.twist[k])
            s.rate[k] = (twist[k] - s.twist[k]) / s.time_constant
        else:
            s.twist[k] = twist[k]
        s.sent[k] = sent(k, shown, rigid)
    for k in range(2):
        s.disturbance[k] = s.voltage[k] - prior.c[V_DOT, k] * s.rate[0] - prior.c[OMEGA_DOT, k] * s.rate[1]
    s.started = True


@kernel
def respond(i: int, command: Array, derivative: Array, robot: Row, arrays: tuple[Any, ...], voltage: Array) -> None:
    """U = d̂, the latest."""
    for k in range(2):
        voltage[k] = arrays[0][i].disturbance[k]


@kernel
def learn(i: int, shown: Shown, robot: Row, prior: Row, arrays: tuple[Any, ...], added: Array) -> float:
    """One step of the observer, which also runs while the robot must not learn; it hands nothing over to the PID."""
    observe(shown, robot.rigid, prior, arrays[0][i])
    added[0] = added[1] = 0.0
    return 0.0


class Observer(Record):
    """Settings of the learner `observer`."""

    time_constant: Annotated[float, Field(ge=0.02, le=10)] = 0.35
    """Time constant T of the filter Q in s. `mrctl tune --search` found that in `lab` all values from 0.35 s on are
    equal within 1 %; the default is the shortest of them. With λ = 0.15 s and exact measurements 0.055 s would do: that
    keeps the sensitivity below 2 with a delay of 20 ms."""


OBSERVER = np.dtype(
    [
        ("time_constant", "f8"),  # T of Q, s
        ("twist", "f8", 2),  # Q of the measured V and θ̇, m/s and rad/s
        ("voltage", "f8", 2),  # Q of the voltage less the model's at zero acceleration, V
        ("sent", "f8", 2),  # voltage that was applied in the last period, V
        ("disturbance", "f8", 2),  # d̂ of the two channels, V
        ("started", "?"),  # whether there was a last period
        ("steady", "f8", 2),  # voltage of the model at the measured twist, without acceleration, V
        ("before", "f8", 2),  # the same one period ago, V
        ("rate", "f8", 2),  # Q of its acceleration, m/s² and rad/s²
    ],
    align=True,
)


class DisturbanceObserver(Learner):
    """The learner `observer` for B robots, whose prior is a model.

    Attributes:
        rows: One record of `OBSERVER` a robot.
    """

    respond, learn_one, record, learned = respond, learn, OBSERVER, ("voltage", "disturbance")
    guarded, needs_model = False, True

    def __init__(self, loop: Loop, settings: list[Observer]) -> None:
        """Takes the loop, and the settings of each robot."""
        super().__init__(loop, settings)
        self.rows["time_constant"] = [s.time_constant for s in settings]
        self.arrays = (self.rows,)

    def restore(self, rows: NDArray[np.intp]) -> None:
        """Resets the observers of the robots with these indices."""
        for name in ("twist", "voltage", "sent", "disturbance", "started"):
            self.rows[name][rows] = 0
