"""A watchdog on a learning feedforward: it limits, freezes or replaces what the learner does, and lets it try again.

What it watches, each against a quantity with a meaning: the learner's output against the supply, its weights in volts
against the supply, the share of time in saturation, the distance to the reference, and, as the sign of instability,
oscillation of feedforward or feedback that grows beyond its own running baseline.
"""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from mrctl.kernel import Array, Row, Rows, kernel
from mrctl.record import Record

GUARD_ACTIONS = ("none", "limit", "freeze", "fallback")
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


GUARD = np.dtype(
    [
        # Settings, as in `Guard`
        ("on", "?"),
        ("share", "f8"),
        ("weights", "f8"),  # largest norm of the weights
        ("oscillation", "f8"),
        ("growth", "f8"),
        ("hold", "f8"),  # s
        ("retries", "f8"),
        ("fade", "f8"),  # s
        ("model", "?"),  # whether the fallback is the nominal model, not PID alone
        ("range", "f8", 2),  # what a channel can command: the supply in V, or the largest θ̇ in rad/s
        # Oscillation of four signals, feedforward and feedback of the two channels, as shares of `range`
        ("low_pass", "f8", 4),  # the signal without noise
        ("slow_mean", "f8", 4),  # what of it is slow motion
        ("sign", "f8", 4),  # of the present half-wave
        ("peak", "f8", 4),  # its amplitude
        ("half_wave_time", "f8", 4),  # how long it lasts, s
        ("baseline", "f8", 4),  # mean amplitude of the half-waves before
        ("baseline_time", "f8", 4),  # how long that was averaged, s
        ("waves", "f8", 4),  # consecutive half-waves above the threshold
        ("first", "f8", 4),  # amplitude of the first of them
        # Other quantities that are held against a bound
        ("mean_distance", "f8"),  # to the reference, m
        ("observed", "f8"),  # how long that was averaged, s
        ("limited_share", "f8"),  # of the time in which the output was limited
        ("saturated_share", "f8"),  # of the time in which a voltage was
        ("model_error", "f8", 2),  # mean of what was sent beyond the nominal model, V
        # What it does
        ("action", "f8"),
        ("reason", "f8"),
        ("hold_left", "f8"),  # until learning may resume, s
        ("strikes", "f8"),  # attempts of the learner that failed
        ("gain", "f8"),  # factor on the feedback that the learner is taught with
        ("authority", "f8"),  # share of the learner in the output; the rest is the fallback's
        ("bump", "f8", 2),  # what of the voltage before a fallback has not faded yet, V
        ("forget", "?"),  # whether the learner is to go back to what it began with
        ("frozen", "?"),  # whether it must not learn now
        ("limited", "f8", 2),  # its output after the limit, V
        ("output", "f8", 2),  # the feedforward to apply, V
        ("teaching", "f8", 2),  # the feedback to learn from, V
    ],
    align=True,
)


def fresh(settings: list[Guard], robot: Rows, volts: Array) -> Rows:
    """Records of `GUARD` that have seen nothing yet, `(B,)`.

    Args:
        settings: A robot each.
        robot: The nominal robot, as from `nominal`.
        volts: What weights of norm one make of features of one, V, `(B,)`; 0 if unknown.
    """
    rows = np.zeros(len(settings), GUARD)
    for name in ("on", "share", "oscillation", "growth", "hold", "retries", "fade"):
        rows[name] = [getattr(s, name) for s in settings]
    supply, rotation = float(robot["supply"][0]), float(robot["max_twist"][0, 1])
    with np.errstate(divide="ignore"):
        rows["weights"] = np.array([s.weights for s in settings]) * supply / volts
    rows["model"] = [s.fallback == "model" for s in settings]
    rows["range"] = supply, rotation if robot["rigid"][0] else supply
    rows["gain"] = rows["authority"] = 1.0
    return rows


@kernel
def guard(
    g: Row, feedforward: Array, nominal: Array, error: Array, norm: float, saturated: bool, voltage: Array,
    period: float, rigid: bool, integral: Array, feedback: Array,
) -> None:  # fmt: skip
    """One tick of the guard of one robot, between the feedforward stage and the allocation.

    - limit: the output is scaled to its share of the supply; no learning while it is.
    - freeze: no learning, for oscillation that begins to grow, and in saturation.
    - fallback: nominal inverse dynamics instead of the learner, for trouble that freezing did not end. The integral
      starts from what the model lacked on average, what is left of the old voltage fades, and the learner goes back to
      what it began with.
    - resume: after the hold, once nothing is wrong, with less gain each time and after a longer hold. After a fallback
      the learner's share of the output grows from 0 to 1 as slowly as it learns, with the fallback to lean on; after
      `retries` the fallback stays.

    Args:
        g: In and out: a record of `GUARD`; its last four fields are the result.
        feedforward: Output of the feedforward stage in V (rad/s on a steering channel), `(2,)`.
        nominal: Output of the nominal inverse dynamics, `(2,)`.
        error: Posture error `(3,)` in m, m, rad.
        norm: Norm of the learner's weights.
        saturated: Whether a limit acted in the last tick.
        voltage: What was sent in the last tick, in the channels, `(2,)`.
        period: Control period in s.
        rigid: Whether the second channel is steering.
        integral: In and out: integrals of the PID, `(2,)`.
        feedback: In and out: output of the PID, `(2,)`.
    """
    g.forget = False
    if not g.on:
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
            g.limited[k] = feedforward[k]
        clipped = limit_output(g, rigid, g.limited)
    for k in range(2):
        g.output[k] = g.limited[k]
        if g.authority < 1.0:
            given = nominal[k] if g.model else 0.0
            g.bump[k] *= g.fade / (g.fade + period)
            g.output[k] = given + g.authority * (g.limited[k] - given) + g.bump[k]
        g.model_error[k] += period / (MEAN + period) * (voltage[k] - nominal[k] - g.model_error[k])
        growing = max(growing, growing_oscillation(g, k, g.limited[k] / g.range[k], period))
        growing = max(growing, growing_oscillation(g, 2 + k, feedback[k] / g.range[k], period))
    g.limited_share += period / (BUSY + period) * ((1.0 if clipped else 0.0) - g.limited_share)
    g.saturated_share += period / (STUCK + period) * ((1.0 if saturated else 0.0) - g.saturated_share)
    distance = np.hypot(error[0], error[1])
    g.observed = min(g.observed + period, MEMORY)
    g.mean_distance += period / g.observed * (distance - g.mean_distance)
    trouble = worst_trouble(g, broken, growing, distance, norm)

    g.hold_left -= period
    if g.action == FALLBACK:
        if trouble > 0:
            g.hold_left = max(g.hold_left, g.hold)
        elif g.hold_left <= 0 and is_quiet(g):
            g.action, g.reason = NONE, 0.0
    elif trouble > 0:
        step_in(g, trouble, growing > LARGEST * g.growth, nominal, integral, feedback)
    elif g.hold_left <= 0 and is_quiet(g):
        g.action, g.reason = NONE, 0.0
    if clipped and g.action <= LIMIT:
        g.action, g.reason, g.hold_left = LIMIT, CLIPPED, BUSY

    if g.action != FALLBACK:
        g.authority = min(1.0, g.authority + period * g.gain / RETURN)
    g.frozen = clipped or g.action >= FREEZE
    for k in range(2):
        g.teaching[k] = g.gain * feedback[k]


@kernel
def growing_oscillation(g: Row, k: int, value: float, period: float) -> float:
    """Amplitude of signal k, a share of its range, if for `SUSTAINED` half-waves it is above its baseline; or 0."""
    g.low_pass[k] += period / (SMOOTH + period) * (value - g.low_pass[k])
    g.slow_mean[k] += period / (DRIFT + period) * (g.low_pass[k] - g.slow_mean[k])
    wave = g.low_pass[k] - g.slow_mean[k]
    sign = 1.0 if wave >= 0 else -1.0
    grown = 0.0
    if sign != g.sign[k] or g.half_wave_time[k] > SLOWEST:
        peak, lasted = g.peak[k], g.half_wave_time[k]
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
            g.baseline_time[k] = min(g.baseline_time[k] + lasted, MEMORY)
            g.baseline[k] += min(1.0, lasted / g.baseline_time[k]) * (min(peak, LARGEST) - g.baseline[k])
        g.sign[k], g.peak[k], g.half_wave_time[k] = sign, 0.0, 0.0
    g.peak[k] = max(g.peak[k], abs(wave))
    g.half_wave_time[k] += period
    return grown


@kernel
def worst_trouble(g: Row, broken: bool, growing: float, distance: float, norm: float) -> int:
    """The worst that is wrong now, or 0."""
    if broken:
        return BROKEN
    if not norm <= g.weights:
        return WEIGHTS
    if distance > max(APART, g.growth * g.mean_distance):
        return FAR
    if growing > 0:
        return OSCILLATION
    if g.limited_share > 0.5:
        return OVERDONE
    if g.saturated_share > 0.5:
        return SATURATION
    return 0


@kernel
def limit_output(g: Row, rigid: bool, values: Array) -> bool:
    """Shrinks the two channels to their share of the supply; returns whether that was needed."""
    if rigid:
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


@kernel
def is_quiet(g: Row) -> bool:
    """Whether no signal is above its threshold for longer than a step takes."""
    for k in range(4):
        if g.waves[k] > 1:
            return False
    return True


@kernel
def step_in(g: Row, trouble: int, large: bool, nominal: Array, integral: Array, feedback: Array) -> None:
    """Freezes, or falls back where freezing is not enough or was tried."""
    frozen = g.action == FREEZE
    if frozen and trouble == SATURATION:
        return
    if trouble != SATURATION and not (frozen and g.reason == OSCILLATION):  # else the same attempt still
        g.strikes += 1.0
        g.gain /= BACK_OFF
    hopeless = g.strikes > g.retries
    mild = trouble == SATURATION or (trouble == OSCILLATION and not (frozen or large))
    g.hold_left = np.inf if hopeless else g.hold * BACK_OFF ** max(g.strikes - 1.0, 0.0)
    g.reason = trouble
    if mild and not hopeless:
        g.action = FREEZE
        return
    g.action, g.authority, g.forget, g.limited_share = FALLBACK, 0.0, True, 0.0
    for k in range(2):
        given = nominal[k] if g.model else 0.0
        target = g.model_error[k] + nominal[k] - given
        g.bump[k] = g.output[k] + integral[k] - target - given
        g.output[k] = given + g.bump[k]
        feedback[k] += target - integral[k]  # it holds the old one
        integral[k] = target
