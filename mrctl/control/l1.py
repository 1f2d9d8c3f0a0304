"""L1 adaptive control with the piecewise-constant law of adaptation, beside a model as prior.

Cao and Hovakimyan (2006); the piecewise-constant law: Hovakimyan and Cao (2010), L1 Adaptive Control Theory, section
3.3; as an augmentation of another controller: Xargay, Hovakimyan and Cao (2010). The robot is M ẋ = U − f(x) + σ, with
M and f of the model and an unknown voltage σ. Three parts:

    predictor    M x̂̇ = U − f(x) + σ̂ − M a (x̂ − x)
    adaptation   σ̂ = −M Φ⁻¹ e^(−a h) (x̂ − x) at each tick, held for a period h,    Φ = (1 − e^(−a h))/a
    control      U = model(x_c) + PID − C σ̂,    C = ω/(s + ω)

The predictor is driven by the voltage that acted (`match`), which the delay of the sensing tier has made older, and by
the measured motion, a straight line between two samples, so that its steps are exact. The law cancels what the
prediction error would still be after a period, so that a constant σ is found in one period, up to the factor e^(−a h),
the price of the sampling. The adaptation may be this fast because C alone sets the bandwidth of what the motors see.

Put together, the law and the predictor say σ̂ = e^(−a h) [M (x_n − x_(n−1))/h − (U − f)]: the predictor has no memory
of its own, and the whole is a disturbance observer with Q = C e^(−a h), as is known of this law.

The loop opened at the voltage, with a PID C_p that acts L later, the nominal plant P = 1/(M s + B), and L' of two
periods and the delay of the sensing tier, as in `indi`, is (C_p P e^(−Ls) + Q e^(−L's))/(1 − Q e^(−L's)), and 1/(1 +
loop) = (1 − Q e^(−L's))/(1 + C_p P e^(−Ls)): the adaptation cannot make the nominal loop unstable.

Under `rigid` steering the second channel is the rotation: f is θ̇ itself, σ is in rad/s, and M is the lag of
servo and tyre.
"""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from mrctl.control.features import V_DOT
from mrctl.control.feedforward import Learner, Loop, Shown, explained
from mrctl.control.matching import MATCHED, match, queues
from mrctl.kernel import Array, Row, Rows, kernel
from mrctl.record import Record
from mrctl.theory.linear import steering


@kernel
def step(shown: Shown, rigid: bool, prior: Row, queue: Rows, s: Row) -> None:
    """One period of the predictor, the adaptation and the low-pass.

        x̂ ← e^(−a h) x̂ + (1 − e^(−a h)) x_n−1 + (1 − Φ/h) (x_n − x_n−1) + Φ M⁻¹ (U − f̂ + σ̂)
        σ̂ ← −M Φ⁻¹ e^(−a h) (x̂ − x_n),    C σ̂ ← C σ̂ + share (σ̂ − C σ̂)

    Args:
        shown: What this tick shows of the robot.
        rigid: Whether the second channel is steering.
        prior: The model, a record of `PRIOR`.
        queue: In and out: that of `match`, `(d + 1,)`.
        s: In and out: a record of `PREDICTOR`, whose `filtered` is the result.
    """
    m = s.matched
    known = match(shown, rigid, queue, m)
    explained(m.last, s.zero, rigid, prior, s.rest)
    for k in range(2):
        if not known:
            s.predicted[k] = m.twist[k]
            continue
        inertia = s.lag if rigid and k == 1 else prior.c[V_DOT + k, k]
        pushed = s.phi * (m.acted[k] - s.rest[k] + s.sigma[k]) / inertia
        drawn = (1 - s.decay) * m.last[k] + (1 - s.phi / shown.period) * (m.twist[k] - m.last[k])
        s.predicted[k] = s.decay * s.predicted[k] + drawn + pushed
        s.sigma[k] = -inertia * s.decay / s.phi * (s.predicted[k] - m.twist[k])
        s.filtered[k] += s.share * (s.sigma[k] - s.filtered[k])


@kernel
def respond(i: int, command: Array, derivative: Array, robot: Row, arrays: tuple[Any, ...], voltage: Array) -> None:
    """U = −C σ̂, the latest."""
    for k in range(2):
        voltage[k] = -arrays[0][i].filtered[k]


@kernel
def learn(i: int, shown: Shown, robot: Row, prior: Row, arrays: tuple[Any, ...], added: Array) -> float:
    """One step, which goes on while the robot must not learn: the voltage is the one after the limits."""
    rows, queue = arrays
    step(shown, robot.rigid, prior, queue[i], rows[i])
    added[0] = added[1] = 0.0
    return 0.0


class L1(Record):
    """Settings of the learner `l1`."""

    bandwidth: Annotated[float, Field(gt=0, le=200)] = 4.0
    """Bandwidth of the low-pass C in rad/s. `mrctl tune --search` found that in `lab` all bandwidths up to 4 rad/s are
    equal within 1 %; the default is the largest of them."""
    predictor: Annotated[float, Field(gt=0, le=200)] = 5.0
    """Rate a in 1/s with which the predictor's error decays by itself."""


PREDICTOR = np.dtype(
    [
        ("decay", "f8"),  # e^(−a h)
        ("phi", "f8"),  # Φ, s
        ("share", "f8"),  # weight of a new sample in C
        ("lag", "f8"),  # lag of the steering under `rigid`, at least a period, s
        ("matched", MATCHED),
        ("zero", "f8", 2),  # no acceleration, m/s² and rad/s²
        ("rest", "f8", 2),  # f of the model at the measured motion, V
        ("predicted", "f8", 2),  # x̂, m/s and rad/s
        ("sigma", "f8", 2),  # σ̂, V
        ("filtered", "f8", 2),  # C σ̂, V
    ],
    align=True,
)


class L1Adaptive(Learner):
    """The learner `l1` for B robots, whose prior is a model.

    Attributes:
        rows: One record of `PREDICTOR` a robot.
    """

    respond, learn_one, record, learned = respond, learn, PREDICTOR, ("sigma", "filtered")
    guarded, needs_model = False, True

    def __init__(self, loop: Loop, settings: list[L1]) -> None:
        """Takes the loop, and the settings of each robot."""
        super().__init__(loop, settings)
        rows, period = self.rows, loop.period
        rates, bandwidths = (np.array([getattr(s, name) for s in settings]) for name in ("predictor", "bandwidth"))
        rows["decay"], rows["phi"] = np.exp(-rates * period), -np.expm1(-rates * period) / rates
        rows["share"] = -np.expm1(-bandwidths * period)
        rows["lag"] = max(steering(loop.robot).lag, period)
        self.arrays = rows, queues(len(settings), loop.delay)

    def restore(self, rows: NDArray[np.intp]) -> None:
        """Resets predictor, adaptation and queues of the robots with these indices."""
        for name in ("matched", "predicted", "sigma", "filtered"):
            self.rows[name][rows] = np.zeros((), PREDICTOR[name])
        self.arrays[1][rows] = 0.0
