"""The delay that the velocity loop shows: when the PID's output oscillates, the controllers are designed anew.

The PID is as fast as the delay of its loop allows (`design`). Where the motors act later than the controller knows, or
the plant has several times the nominal gain, the loop oscillates. Each oscillation is answered by one move; odd and
even moves differ:

1. The motion controller is designed for `DELAY_STEP` more delay, and the learner is taught with a third of the
   feedback, at most `LEARNER_MOVES` times. Both close further loops through the same delay, and a PID that is stable
   alone may oscillate because of them. So they give way first.
2. The PID is designed for `DELAY_STEP` more delay too.

A user's motion controller cannot be designed for more delay. Beside one, each oscillation is answered by two moves at
once: they slow the PID and, as often as `LEARNER_MOVES` says, the learner.

The next move follows after `FADING_TIME`, in which the oscillation may fade, or after `MIN_MOVE_INTERVAL` if the
oscillation has grown by the factor `GROWTH`. The moves are not taken back during a run. To lower a gain on an
oscillation is the idea of adaptive augmenting control (Orr and VanZwieten 2012, Robust, practical adaptive control for
launch vehicles); here the design of the gains replaces its factor.

An oscillation is `SUSTAINED_HALF_WAVES` half-waves of the PID's output in a row that are shorter than `MAX_HALF_WAVE`,
and larger than the sum of `MIN_AMPLITUDE` of the supply and the recent peak of what explains them without an
oscillating loop: the swing of the feedforward, or `MISMATCH` times the swing of the voltage that the nominal robot
needs for the command. A loop that oscillates moves command and feedforward too, so that they explain at most
`MAX_EXPLAINED` of the supply.
"""

from __future__ import annotations

import numpy as np

from mrctl.control.oscillation import HALF_WAVES, SWING, count_half_waves, swing
from mrctl.kernel import Array, Row, kernel

DELAY_STEP = 0.01
"""Delay in s that two moves add, rounded to whole control periods, *chosen*."""
MAX_MOVES = 20
"""Largest number of moves, *chosen*."""
LEARNER_MOVES = 2
"""Number of moves that slow the learner, *chosen*; after that it would hardly learn."""
MIN_AMPLITUDE = 0.02
"""Least amplitude of a half-wave as a share of the supply (of the largest θ̇ on a steering channel), *chosen*. In 222
random worlds in `lab` without unknown delay, the largest level that 8 half-waves in a row exceed is 0.013 of the
supply; in the two of them in which the loop oscillates it is 0.1."""
SUSTAINED_HALF_WAVES = 8
"""Half-waves in a row that make an oscillation, *chosen*."""
MAX_HALF_WAVE = 0.3
"""Longest half-wave in s, *chosen*."""
MISMATCH = 2.0
"""Factor by which the robot may need more voltage than the nominal one, *chosen*."""
MAX_EXPLAINED = 0.15
"""Largest amplitude that command and feedforward explain, as a share of the supply (of the largest θ̇ on a steering
channel), *chosen*."""
FADING_TIME = 2.0
"""Least time in s between two moves while the oscillation does not grow, in which it may fade, *chosen*."""
GROWTH = 2.0
"""Factor by which an oscillation must have grown since the last move to be answered before `FADING_TIME` is over,
*chosen*."""
MIN_MOVE_INTERVAL = 0.5
"""Least time in s between two moves while the oscillation grows, *chosen*."""
PEAK_DECAY = 1.0
"""Time constant in s with which the peak of an explained swing decays."""


@kernel
def watch_delay(feedback: Array, feedforward: Array, nominal: Array, period: float, s: Row) -> None:
    """One tick of the watch on the velocity loop, which sets `due` when an oscillation asks for the next move.

    Args:
        feedback: Output of the PID in V (rad/s on a steering channel), `(2,)`.
        feedforward: Feedforward that was applied in the last tick, after the guard, in the same units, `(2,)`.
        nominal: Output of the nominal inverse dynamics at the command, `(2,)`.
        period: Control period in s.
        s: In and out: a record of `DELAY`.
    """
    s.due = False
    if not s.on:
        return
    s.rest -= period
    for k in range(2):
        known = MISMATCH * abs(swing(nominal[k], k, period, s.nominal))
        known = max(known, abs(swing(feedforward[k], k, period, s.feedforward)))
        known = min(known, s.most_explained[k])
        s.explained[k] = max(known, PEAK_DECAY / (PEAK_DECAY + period) * s.explained[k])
        wave = swing(feedback[k], k, period, s.feedback)
        count_half_waves(wave, k, s.least[k] + s.explained[k], MAX_HALF_WAVE, period, s.half_waves)
        s.amplitude[k] = max(abs(wave), MAX_HALF_WAVE / (MAX_HALF_WAVE + period) * s.amplitude[k])
        grows = s.amplitude[k] > GROWTH * s.answered[k] and s.rest <= FADING_TIME - MIN_MOVE_INTERVAL
        s.due |= s.half_waves.count[k] >= SUSTAINED_HALF_WAVES and (s.rest <= 0.0 or grows)
    if s.due:
        s.rest = FADING_TIME
        for k in range(2):
            s.answered[k] = s.amplitude[k]


DELAY = np.dtype(
    [
        ("on", "?"),  # whether the watch acts
        ("moves", "f8"),  # number of moves so far
        ("least", "f8", 2),  # least amplitude of a half-wave, V (rad/s); infinite on a channel that is not watched
        ("most_explained", "f8", 2),  # largest amplitude that is explained without an oscillating loop, V (rad/s)
        ("feedback", SWING),  # swing of the PID's output
        ("feedforward", SWING),  # swing of the feedforward
        ("nominal", SWING),  # swing of the nominal voltage
        ("explained", "f8", 2),  # peak of what explains a swing of the PID's output, which decays, V (rad/s)
        ("half_waves", HALF_WAVES),  # of the PID's output
        ("amplitude", "f8", 2),  # peak of the swing of the PID's output, which decays, V (rad/s)
        ("answered", "f8", 2),  # the same when the last move was due
        ("rest", "f8"),  # time until the next move may be due, s
        ("due", "?"),  # whether the next move is due
    ],
    align=True,
)
