"""Incremental nonlinear dynamic inversion (INDI): the next voltage is the last one and an increment.

Sieberling, Chu and Mulder (2010); Smeur, Chu and de Croon (2016). The robot is M ẋ + f = U, with x = (V, θ̇). Of its
model the law needs only M, the voltage that an acceleration takes; f is never computed but measured:

    U = U_f + M (ν − ẋ_f),      U_f = H U,  ẋ_f = H ẋ,  H = 1/(T s + 1)²

ν is the acceleration that is wanted. Voltage and acceleration pass the same filter H, and the voltage is as old as the
acceleration that it made (`match`), so that U_f − M ẋ_f = H f exactly. Therefore

    ẋ = ν + M⁻¹ (H f e^(−L's) − f),      L' = two periods and the delay of the sensing tier

The mean acceleration over a period takes one of the two periods; the other one passes because `output` of a tick comes
before its `learn`. The transfer function from ν to ẋ is 1, whatever f is; T only says how fast a change of f is
followed.

Here ν = ẋ_c + M⁻¹ · PID(x_c − x): the prior gives M ẋ_c, the PID gives the rest of M ν, and this stage replaces what
the prior says about f at the commanded motion by what was measured,

    U = [M ẋ_c + f̂(x_c)] + PID + [H (U − M ẋ) − f̂(x_c)]

The first bracket is the prior, the last one is this stage. `observer` keeps f̂ of the model and adds the measured
difference from it; INDI drops f̂, so that a wrong model of back-EMF, friction or coupling has no effect, and its price
is a lag of about 2 T + L' in f, which the PID must correct. With a slow PID (λ = 0.15 s, `lab`, nominal robot) the
position error is 13 mm with INDI and 2.5 mm with the model alone. The PID stays as it is: for a plant ẋ = ν, PI control
gives e a second-order response, M ë + K_p ė + K_i e = 0, whose integral holds what a wrong M leaves.

For P = 1/(M s), a plant without f, and a PID C that acts L later, the loop opened at the voltage is

    (C e^(−Ls) + H M s e^(−L's)) P/(1 − H e^(−L's)),      1/(1 + loop) = (1 − H e^(−L's))/(1 + C P e^(−Ls))

so that INDI is stable wherever the PID alone is. That is owed to the matched delay: with 1 − H in the denominator the
loop would lose phase. A wrong M leaves a part of H e^(−L's) in the loop.

Under `rigid` steering the fork makes θ̇ without a voltage. In the second channel INDI then increments the rotation, in
rad/s: U = U_f + (θ̇_d − θ̇_f), where θ̇_d is the commanded θ̇ and what the PID adds.
"""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from mrctl.control.features import FEATURES, OMEGA_DOT, V_DOT
from mrctl.control.feedforward import PRIOR, Learner, Loop, Prior, Shown, explained, prior_voltage
from mrctl.control.matching import MATCHED, low_pass, match, queues
from mrctl.kernel import Array, Row, Rows, kernel
from mrctl.record import Record


@kernel
def measure(shown: Shown, rigid: bool, queue: Rows, s: Row) -> None:
    """Measures U_f − M ẋ_f; until a voltage has acted, it is f̂ of the model, so that the law starts without a bump.

    Args:
        shown: What this tick shows of the robot.
        rigid: Whether the second channel is steering.
        queue: In and out: that of `match`, `(d + 1,)`.
        s: In and out: a record of `INDI`, whose `twice` is the result.
    """
    m, c = s.matched, s.prior.c
    s.started = match(shown, rigid, queue, m)
    explained(m.twist, s.zero, rigid, s.prior, s.rest)
    for k in range(2):
        if rigid and k == 1:
            made, rest = m.twist[1], 0.0  # the rotation that came, and no other force
        else:
            made, rest = c[V_DOT, k] * m.rate[0] + c[OMEGA_DOT, k] * m.rate[1], s.rest[k]
        if s.started:
            low_pass(m.acted[k] - made, k, s.share, s.once, s.twice)
        else:
            s.once[k] = s.twice[k] = rest


@kernel
def respond(i: int, command: Array, derivative: Array, robot: Row, arrays: tuple[Any, ...], voltage: Array) -> None:
    """U = U_f − M ẋ_f − f̂(x_c); the prior adds M ẋ_c + f̂(x_c)."""
    s = arrays[0][i]
    prior_voltage(command, s.zero, s.prior, s.rest)
    for k in range(2):
        voltage[k] = s.twice[k] - s.rest[k] if s.started else 0.0


@kernel
def learn(i: int, shown: Shown, robot: Row, prior: Row, arrays: tuple[Any, ...], added: Array) -> float:
    """One measurement, which goes on while the robot must not learn: the voltage is the one after the limits."""
    rows, queue = arrays
    s = rows[i]
    for j in range(FEATURES):
        s.prior.c[j, 0], s.prior.c[j, 1] = prior.c[j, 0], prior.c[j, 1]
    measure(shown, robot.rigid, queue[i], s)
    added[0] = added[1] = 0.0
    return 0.0


class Indi(Record):
    """Settings of the learner `indi`."""

    time_constant: Annotated[float, Field(ge=0.005, le=2)] = 0.03
    """Time constant T in s of each of the two filters on voltage and acceleration. With the default PID the sensitivity
    at the voltage is at most 1.9 in `lab`, where 0.01 s give 2.4; a robot of half the mass then oscillates."""


INDI = np.dtype(
    [
        ("share", "f8"),  # weight of a new sample in the two filters
        ("matched", MATCHED),
        ("prior", PRIOR),  # the model; its coefficients of the accelerations are M
        ("zero", "f8", 2),  # no acceleration, m/s² and rad/s²
        ("rest", "f8", 2),  # f̂ at the measured or the commanded motion, V
        ("once", "f8", 2),  # U − M ẋ after the first filter, V
        ("twice", "f8", 2),  # U_f − M ẋ_f, V
        ("started", "?"),  # whether a voltage has acted whose motion is known
    ],
    align=True,
)


class IncrementalInversion(Learner):
    """The learner `indi` for B robots, whose prior is a model.

    Attributes:
        rows: One record of `INDI` a robot.
    """

    respond, learn_one, record = respond, learn, INDI
    guarded, needs_model = False, True

    def __init__(self, loop: Loop, settings: list[Indi]) -> None:
        """Takes the loop, and the settings of each robot."""
        super().__init__(loop, settings)
        self.rows["share"] = [loop.period / (loop.period + s.time_constant) for s in settings]
        self.rows["prior"] = Prior([loop.robot] * len(settings), loop.rigid).rows
        self.arrays = self.rows, queues(len(settings), loop.delay)

    def restore(self, rows: NDArray[np.intp]) -> None:
        """Resets the filters and queues of the robots with these indices."""
        for name in ("matched", "once", "twice", "started"):
            self.rows[name][rows] = np.zeros((), INDI[name])
        self.arrays[1][rows] = 0.0
