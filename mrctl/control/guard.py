"""A watchdog on a learning feedforward: it limits, freezes or replaces what the learner does, and lets it try again.

What it watches, each against a quantity with a meaning: the learner's output against the supply, its weights in volts
against the supply, the share of time in saturation, the distance to the reference, and, as the sign of instability,
oscillation of feedforward or feedback that grows beyond its own running baseline.
"""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from numba import njit
from pydantic import Field

from mrctl.record import Record

ACTIONS = ("none", "limit", "freeze", "fallback")
NONE, LIMIT, FREEZE, FALLBACK = range(4)
REASONS = (
    "",
    "output beyond its share of the supply",
    "output beyond its share of the supply for most of a second",
    "weights beyond what the supply can mean",
    "saturated for most of two seconds",
    "growing oscillation",
    "far from the reference",
    "output not finite",
)
_, CLIPPED, OVERDONE, WEIGHTS, SATURATION, OSCILLATION, FAR, BROKEN = range(8)

# An oscillation of the loop changes its sign at least once a second about its own slow mean. A step or a push is over
# after one or two half-waves, and what a lap asks for is slower.
SMOOTH, DRIFT = 0.02, 0.3  # s, time constants that take noise and slow motion out of a signal
SLOWEST = 1.0  # s, longest half-wave
SUSTAINED = 3  # half-waves above the threshold, the last not below the first; two, if it is twice the first
LARGEST = 0.1  # share of the supply beyond which an oscillation is no baseline to compare with
MEMORY = 10.0  # s over which the baselines run
MEAN = 0.5  # s over which voltages are averaged for the integral to take over; a few periods of an oscillation
BUSY, STUCK = 1.0, 2.0  # s over which limit and saturation are averaged
RETURN = 5.0  # s over which a learner that resumes would get its authority back at full gain
APART = 0.15  # m to the reference that are always tolerated; a run fails at 1 m
BACK_OFF = 3.0  # each attempt learns that much more slowly, and waits that much longer
UNSURE = 0.1  # further factor on the learning gain of a stage that cannot forget what it learned


class Guard(Record):
    """The watchdog on every learner."""

    on: bool = True
    """Watch."""
    share: Annotated[float, Field(gt=0, le=1)] = 1.0
    """Largest share of the supply that the feedforward alone may command on a wheel (on a steering channel, of the
    largest rotation velocity)."""
    weights: Annotated[float, Field(gt=0, le=1e3)] = 2.5
    """Largest norm of the weights: what they make of features of one, over the supply."""
    oscillation: Annotated[float, Field(gt=0, le=1)] = 0.05
    """Amplitude of a loop oscillation, as a share of the supply, below which it is none."""
    growth: Annotated[float, Field(ge=1, le=100)] = 3.0
    """How far oscillation and distance to the reference may grow beyond their running baselines, as a factor."""
    hold: Annotated[float, Field(gt=0, le=100)] = 1.0
    """How long the first freeze or fallback lasts at least, s; each later one lasts three times as long."""
    retries: Annotated[int, Field(ge=0, le=20)] = 4
    """How often learning may resume, each time with a third of the gain; the next time it ends in the fallback."""
    fade: Annotated[float, Field(gt=0, le=2)] = 0.1
    """Time constant with which a voltage that the fallback does not explain fades, s."""
    fallback: Literal["model", "none"] = "model"
    """Feedforward while the learner's is not used: nominal inverse dynamics, or PID alone."""


# Settings and memory of the guard of one robot. Oscillation is watched in four signals: feedforward and feedback of the
# two channels.
WATCH = np.dtype(
    [
        ("on", "f8"), ("share", "f8"), ("weights", "f8"), ("oscillation", "f8"), ("growth", "f8"), ("hold", "f8"),
        ("retries", "f8"), ("fade", "f8"), ("model", "f8"), ("rigid", "f8"), ("range", "f8", 2),
        ("smooth", "f8", 4), ("drift", "f8", 4), ("sign", "f8", 4), ("peak", "f8", 4), ("lasted", "f8", 4),
        ("baseline", "f8", 4), ("seen", "f8", 4), ("waves", "f8", 4), ("first", "f8", 4),
        ("distance", "f8"), ("watched", "f8"), ("clipped", "f8"), ("saturated", "f8"), ("lacking", "f8", 2),
        ("bump", "f8", 2), ("action", "f8"), ("reason", "f8"), ("left", "f8"), ("strikes", "f8"), ("gain", "f8"),
        ("authority", "f8"), ("restore", "f8"), ("idle", "f8"), ("own", "f8", 2), ("output", "f8", 2),
        ("teaching", "f8", 2),
    ],
    align=True,
)  # fmt: skip


def watches(settings: list[Guard], supply: float, rotation: float, volts: np.ndarray, rigid: bool) -> np.ndarray:
    """Guards that have seen nothing yet, `WATCH` a robot, `(B,)`.

    Args:
        settings: A robot each.
        supply: U_max in V.
        rotation: Largest rotation velocity in rad/s, the range of a steering channel.
        volts: What weights of norm one make of features of one, V, `(B,)`; 0 if unknown.
        rigid: Whether channel two is steering.
    """
    state = np.zeros(len(settings), WATCH)
    for name in ("on", "share", "oscillation", "growth", "hold", "retries", "fade"):
        state[name] = [getattr(s, name) for s in settings]
    with np.errstate(divide="ignore"):
        state["weights"] = np.array([s.weights for s in settings]) * supply / volts
    state["model"] = [s.fallback == "model" for s in settings]
    state["rigid"], state["range"] = rigid, (supply, rotation if rigid else supply)
    state["gain"], state["authority"] = 1.0, 1.0
    return state


@njit
def _grows(g, k, value, period):  # noqa: ANN001, ANN202
    """Amplitude of signal k, a share of its range, if for `SUSTAINED` half-waves it is above its baseline; or 0."""
    g.smooth[k] += period / (SMOOTH + period) * (value - g.smooth[k])
    g.drift[k] += period / (DRIFT + period) * (g.smooth[k] - g.drift[k])
    wave = g.smooth[k] - g.drift[k]
    sign = 1.0 if wave >= 0 else -1.0
    grown = 0.0
    if sign != g.sign[k] or g.lasted[k] > SLOWEST:
        peak, lasted = g.peak[k], g.lasted[k]
        if lasted <= SLOWEST and peak > max(g.oscillation, g.growth * g.baseline[k]):
            g.waves[k] += 1.0
            if g.waves[k] == 1.0:
                g.first[k] = peak
            if peak >= (g.first[k] if g.waves[k] >= SUSTAINED else 2.0 * g.first[k]):
                grown = peak
                g.waves[k] = 0.0
        else:
            g.waves[k] = 0.0
        if lasted > 0:  # a mean over all that was seen, later over `MEMORY`
            g.seen[k] = min(g.seen[k] + lasted, MEMORY)
            g.baseline[k] += min(1.0, lasted / g.seen[k]) * (min(peak, LARGEST) - g.baseline[k])
        g.sign[k], g.peak[k], g.lasted[k] = sign, 0.0, 0.0
    g.peak[k] = max(g.peak[k], abs(wave))
    g.lasted[k] += period
    return grown


@njit
def _trouble(g, broken, growing, distance, norm):  # noqa: ANN001, ANN202
    """The worst that is wrong now, or 0."""
    if broken:
        return BROKEN
    if not norm <= g.weights:
        return WEIGHTS
    if distance > max(APART, g.growth * g.distance):
        return FAR
    if growing > 0:
        return OSCILLATION
    if g.clipped > 0.5:
        return OVERDONE
    if g.saturated > 0.5:
        return SATURATION
    return 0


@njit
def _limit(g, values):  # noqa: ANN001, ANN202
    """Shrinks the two channels to their share of the supply; returns whether that was needed."""
    if g.rigid > 0:
        acted = False
        for k in range(2):
            bound = g.share * g.range[k]
            if abs(values[k]) > bound:
                values[k] = bound if values[k] > 0 else -bound
                acted = True
        return acted
    wheel = abs(values[0]) + abs(values[1])  # U_r,l = U_Σ ± U_Δ
    bound = g.share * g.range[0]
    if wheel <= bound:
        return False
    for k in range(2):
        values[k] *= bound / wheel
    return True


@njit
def _quiet(g):  # noqa: ANN001, ANN202
    """Whether no signal is above its threshold for longer than a step takes."""
    for k in range(4):
        if g.waves[k] > 1:
            return False
    return True


@njit
def _step_in(g, trouble, large, nominal, integral, feedback):  # noqa: ANN001, ANN202
    """Freezes, or falls back where freezing is not enough or was tried."""
    frozen = g.action == FREEZE
    if frozen and trouble == SATURATION:
        return
    if trouble != SATURATION and not (frozen and g.reason == OSCILLATION):  # else the same attempt still
        g.strikes += 1.0
        g.gain /= BACK_OFF
    hopeless = g.strikes > g.retries
    mild = trouble == SATURATION or (trouble == OSCILLATION and not (frozen or large))
    g.left = np.inf if hopeless else g.hold * BACK_OFF ** max(g.strikes - 1.0, 0.0)
    g.reason = trouble
    if mild and not hopeless:
        g.action = FREEZE
        return
    g.action, g.authority, g.restore, g.clipped = FALLBACK, 0.0, 1.0, 0.0
    for k in range(2):
        given = nominal[k] if g.model > 0 else 0.0
        target = g.lacking[k] + nominal[k] - given
        g.bump[k] = g.output[k] + integral[k] - target - given
        g.output[k] = given + g.bump[k]
        feedback[k] += target - integral[k]  # it holds the old one
        integral[k] = target


@njit(cache=True)
def guard(g, feedforward, nominal, error, norm, saturated, voltage, period, integral, feedback):  # noqa: ANN001, ANN201
    """One tick of the guard of one robot, between the feedforward stage and the allocation.

    - limit: the output is scaled to its share of the supply; no learning while it is.
    - freeze: no learning, for oscillation that begins to grow, and in saturation.
    - fallback: nominal inverse dynamics instead of the learner, for trouble that freezing did not end. The integral
      starts from what the model lacked on average, what is left of the old voltage fades, and the learner goes back to
      what it began with (`restore`).
    - resume: after the hold, once nothing is wrong, with less gain each time and after a longer hold. After a fallback
      the learner's share of the output grows from 0 to 1 as slowly as it learns, with the fallback to lean on; after
      `retries` the fallback stays.

    Args:
        g: In and out: a record of `WATCH`. `output` and `teaching` are the feedforward to apply and the feedback to
            learn from; `idle` is 1 where nothing may be learned; `restore` is 1 when the learner is to forget.
        feedforward: The stage's output `(2,)`.
        nominal: That of the nominal inverse dynamics `(2,)`.
        error: Posture error `(3,)` in m, m, rad.
        norm: Norm of the learner's weights.
        saturated: 1 if a limit acted in the last tick.
        voltage: What was sent in the last tick, in the channels, `(2,)`.
        period: Control period in s.
        integral: In and out: integrals of the PID, `(2,)`.
        feedback: In and out: its output, `(2,)`.
    """
    g.restore = 0.0
    if g.on == 0:
        for k in range(2):
            g.output[k], g.teaching[k] = feedforward[k], feedback[k]
        return
    broken = False
    for k in range(2):
        broken |= not np.isfinite(feedforward[k])
    growing = 0.0
    clipped = False
    if not broken:  # else the last output, for the fallback to start from
        for k in range(2):
            g.own[k] = feedforward[k]
        clipped = _limit(g, g.own)
    for k in range(2):
        g.output[k] = g.own[k]
        if g.authority < 1.0:
            given = nominal[k] if g.model > 0 else 0.0
            g.bump[k] *= g.fade / (g.fade + period)
            g.output[k] = given + g.authority * (g.own[k] - given) + g.bump[k]
        g.lacking[k] += period / (MEAN + period) * (voltage[k] - nominal[k] - g.lacking[k])
        growing = max(growing, _grows(g, k, g.own[k] / g.range[k], period))
        growing = max(growing, _grows(g, 2 + k, feedback[k] / g.range[k], period))
    g.clipped += period / (BUSY + period) * ((1.0 if clipped else 0.0) - g.clipped)
    g.saturated += period / (STUCK + period) * (saturated - g.saturated)
    distance = np.hypot(error[0], error[1])
    g.watched = min(g.watched + period, MEMORY)
    g.distance += period / g.watched * (distance - g.distance)
    trouble = _trouble(g, broken, growing, distance, norm)

    g.left -= period
    if g.action == FALLBACK:
        if trouble > 0:
            g.left = max(g.left, g.hold)
        elif g.left <= 0 and _quiet(g):
            g.action, g.reason = NONE, 0.0
    elif trouble > 0:
        _step_in(g, trouble, growing > LARGEST * g.growth, nominal, integral, feedback)
    elif g.left <= 0 and _quiet(g):
        g.action, g.reason = NONE, 0.0
    if clipped and g.action <= LIMIT:
        g.action, g.reason, g.left = LIMIT, CLIPPED, BUSY

    if g.action != FALLBACK:
        g.authority = min(1.0, g.authority + period * g.gain / RETURN)
    g.idle = 1.0 if clipped or g.action >= FREEZE else 0.0
    for k in range(2):
        g.teaching[k] = g.gain * feedback[k]
