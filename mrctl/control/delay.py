"""The delay that the velocity loop shows: when the PID's output oscillates, the controllers are designed anew.

The PID is as fast as the delay of its loop allows (`design`). Where the motors act later than the controller knows, or
the plant has several times the nominal gain, the loop oscillates. The delay for which the controllers are designed
then grows by `STEP`, in two moves that take turns:

1. The motion controller is designed for the longer delay, and the learner is taught with a third of the feedback: both
   are feedbacks around the PID, through the same delay, and may be what takes the margin of a PID that is stable alone.
2. The PID is designed for it too.

The controllers are never made faster again. To lower a gain on an oscillation is the idea of adaptive augmenting
control (Orr and VanZwieten 2012, Robust, practical adaptive control for launch vehicles); here the design of the gains
replaces its factor.

An oscillation is a number of half-waves of the PID's output in a row that are

- shorter than `FASTEST_COMMAND`, because a slower wave may be what the reference asks for, and
- larger than `LEAST` of the supply and the swing of the feedforward together: if the feedforward swings more than the
  PID, it makes the oscillation itself, which is a matter for the guard.
"""

from __future__ import annotations

import numpy as np

from mrctl.control.oscillation import HALF_WAVES, SWING, count_half_waves, swing
from mrctl.kernel import Array, Row, kernel

STEP = 0.01
"""Delay in s that is added at a time, *chosen*."""
LONGEST = 0.1
"""Largest delay in s that is added in all, *chosen*."""
LEAST = 0.02
"""Least amplitude of a half-wave as a share of the supply (of the largest θ̇ on a steering channel), *chosen*. In 222
random worlds without delay in `lab`, 8 half-waves in a row reach 0.013 at most, or 0.1 in the two that oscillate."""
SUSTAINED = 8
"""Half-waves in a row that make an oscillation, *chosen*."""
FASTEST_COMMAND = 0.3
"""Longest half-wave in s, *chosen*: an oscillation of at least 10 rad/s, which no reference asks for."""
REST = 2.0
"""Least time in s between two moves, in which an oscillation may fade, *chosen*."""
RECENT = 1.0
"""Time constant in s with which the peak of the feedforward's swing decays."""


@kernel
def watch_delay(feedback: Array, feedforward: Array, scale: Array, period: float, s: Row) -> None:
    """One tick of the watch on the velocity loop, which sets `due` when an oscillation asks for the next move.

    Args:
        feedback: Output of the PID in V (rad/s on a steering channel), `(2,)`.
        feedforward: Output of prior and learner in the same units, `(2,)`.
        scale: Largest command of a channel: the supply in V, or the largest θ̇ in rad/s, `(2,)`.
        period: Control period in s.
        s: In and out: a record of `DELAY`.
    """
    s.due = False
    if not s.on:
        return
    s.rest -= period
    for k in range(2):
        other = abs(swing(feedforward[k], k, period, s.feedforward))
        s.other[k] = max(other, RECENT / (RECENT + period) * s.other[k])
        wave = swing(feedback[k], k, period, s.feedback)
        count_half_waves(wave, k, LEAST * scale[k] + s.other[k], FASTEST_COMMAND, period, s.half_waves)
        s.due |= s.half_waves.count[k] >= SUSTAINED
    s.due &= s.rest <= 0.0
    if s.due:
        s.rest = REST


DELAY = np.dtype(
    [
        ("on", "?"),  # whether the PID is designed for a delay, which may still grow
        ("added", "f8"),  # delay for which the PID is designed beyond that of the sensing, s
        ("ahead", "?"),  # whether the motion controller is designed for one `STEP` more
        ("feedback", SWING),  # swing of the PID's output
        ("feedforward", SWING),  # swing of the feedforward
        ("other", "f8", 2),  # its peak, which decays, V (rad/s)
        ("half_waves", HALF_WAVES),  # of the PID's output
        ("rest", "f8"),  # time until the next move may be due, s
        ("due", "?"),  # whether the next move is due
    ],
    align=True,
)
