"""Matching of voltage and motion: a law that compares the two must know which voltage made which motion.

A voltage acts d control periods after it was computed, d being `Sensing.loop_delay`, and it is held for one period. The
controllers receive the motion predicted to the moment when the coming voltage acts (`mrctl.sensing`):

    x̂_n = x_n + h Σ ẋ_c,p,   p = n − d … n − 1,      h = control period, ẋ_c,p = acceleration that was commanded then

`match` takes the commanded accelerations out again. The rest, x_n, was measured at tick n, and its mean acceleration in
the period before, (x_n − x_(n−1))/h, is exactly what the voltage u_(n−1−d) made, together with all other forces. The
`control_delay` of a perturbation is not matched, because nobody knows it.

A law that is taught by the feedback voltage must know which output that voltage answers: `recall` returns the delayed
features, those of τ = (d + 2) h ago. With the loop L of PID and plant, ∂U_fb/∂U_ff = −T_a, T_a = ½ (1 + T) and T =
L/(1 + L), as the hand-over takes half of what is learned from the PID's integral. A gradient step descends at the
frequencies where Re [T_a e^(jωτ)] > 0 (Morgan 1980; by averaging: Anderson et al. 1986). On the nominal robot that
holds at all frequencies without τ, and with τ up to 76 rad/s in `lab` and 51 in `field`, above what a command holds.
But if the loop gain is twice the nominal one, as with a light robot or strong motors, T has a resonance with Re T <
−1 at 80 to 120 rad/s in `lab` and 48 to 71 in `field`, where learning with the features of the same tick oscillates;
with the delayed ones the resonance is safe (`tests/unit/test_matching.py`).
"""

from __future__ import annotations

import numpy as np

from mrctl.control.feedforward import Shown
from mrctl.kernel import Array, Row, Rows, kernel

SETTLING_TIMES = 6.0  # time constants until the two filters of `low_pass` have forgotten their initial state
HOLD_PERIODS = 2  # periods, hold and sampling, *chosen*; with one the worst robots in `field` do worse
MATCHED = np.dtype(
    [
        ("tick", "i8"),  # number of control ticks so far
        ("twist", "f8", 2),  # measured V and θ̇, not predicted, m/s and rad/s
        ("last", "f8", 2),  # the same one period ago
        ("rate", "f8", 2),  # mean acceleration in the period between, m/s² and rad/s²
        ("acted", "f8", 2),  # voltage that acted in that period, V (rad/s on a steering channel)
    ],
    align=True,
)


SENT = np.dtype(
    [
        ("voltage", "f8", 2),  # that was computed in a tick, after the limits, V (rad/s on a steering channel)
        ("acceleration", "f8", 2),  # that was commanded in it, m/s² and rad/s²
    ],
    align=True,
)


@kernel
def sent(k: int, shown: Shown, rigid: bool) -> float:
    """Returns what channel k makes in the coming period: its voltage in V or, if it is steering, θ̇ in rad/s.

    A steering channel (the second one, if `rigid`) adds a correction to the commanded rotation.
    """
    return shown.voltage[k] + shown.command[k] if rigid and k == 1 else shown.voltage[k]


def queues(size: int, delay: int) -> Rows:
    """Returns empty queues for `match`, records of `SENT`, `(B, delay + 1)`; the delay is in control periods."""
    return np.zeros((size, delay + 1), SENT)


@kernel
def match(shown: Shown, rigid: bool, queue: Rows, s: Row) -> bool:
    """Finds the voltage that acted in the period that ends now, and the motion that it made.

    Args:
        shown: What this tick shows of the robot; its voltage goes into the queue.
        rigid: Whether the second channel is steering.
        queue: In and out: records of `SENT` of the last d + 1 ticks, `(d + 1,)`.
        s: In and out: a record of `MATCHED`, whose `twist`, `last`, `rate` and `acted` are the result.

    Returns:
        Whether the voltage that acted in that period is known; in the first d + 1 ticks it is not.
    """
    size = len(queue)
    oldest = s.tick % size
    for k in range(2):
        now = shown.twist[k]
        for p in range(size):
            if p != oldest:
                now -= shown.period * queue[p].acceleration[k]
        s.last[k] = s.twist[k] if s.tick > 0 else now
        s.twist[k], s.rate[k] = now, (now - s.last[k]) / shown.period
        s.acted[k] = queue[oldest].voltage[k]
        queue[oldest].voltage[k], queue[oldest].acceleration[k] = sent(k, shown, rigid), shown.derivative[k]
    s.tick += 1
    return s.tick > size


@kernel
def low_pass(signal: float, k: int, share: float, once: Array, twice: Array) -> None:
    """One step of H = 1/(T s + 1)², two equal filters by implicit Euler with share = h/(T + h).

    Args:
        signal: Input.
        k: Index of the signal in `once` and `twice`.
        share: Weight of a new sample.
        once: In and out: outputs of the first filter.
        twice: In and out: outputs of the second filter, which are H of the inputs.
    """
    once[k] += share * (signal - once[k])
    twice[k] += share * (once[k] - twice[k])


def histories(size: int, delay: int, width: int) -> Array:
    """Returns empty queues for `recall`, `(B, delay + 2, width)`; the delay is in control periods."""
    return np.zeros((size, delay + HOLD_PERIODS, width))


@kernel
def recall(x: Array, queue: Array, s: Row) -> bool:
    """Reads the features of d + 2 ticks ago, whose output this feedback answers, and stores the present ones.

    Args:
        x: Features of the commanded motion of this tick, `(n,)`.
        queue: In and out: x of the last d + 2 ticks, `(d + 2, n)`.
        s: In and out: a record with the number of ticks so far, `tick`, and the delayed features, `past`, `(n,)`.

    Returns:
        Whether `past` is valid; in the first d + 2 ticks it is not.
    """
    oldest = s.tick % len(queue)
    for j in range(len(x)):
        s.past[j] = queue[oldest, j]
        queue[oldest, j] = x[j]
    s.tick += 1
    return s.tick > len(queue)
