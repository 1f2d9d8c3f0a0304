"""A watchdog on a learning feedforward: it limits, freezes or replaces the learner, and later lets it try again.

| action   | cause                                                   | effect                                         |
| -------- | ------------------------------------------------------- | ---------------------------------------------- |
| limit    | output beyond its share of the supply                   | output scaled to that share, no learning       |
| freeze   | saturated for most of 2 s, or a growing oscillation     | no learning                                    |
| fallback | an oscillation that is large or grows while frozen,     | nominal model or PID alone in place of the     |
|          | weights beyond the supply, far from the reference,      | learner, which is reset to its initial weights |
|          | output not finite, or limited for most of 1 s           |                                                |

After a hold the learner resumes, each time with a third of the gain, and the next hold is three times as long. An
oscillation and the distance to the reference are compared with their own running means.
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
# after one or two half-waves, and the motion of a lap is slower.
SMOOTH, DRIFT = 0.02, 0.3  # s, time constants of the filters that remove noise and slow motion from a signal
SLOWEST = 1.0  # s, longest half-wave
SUSTAINED = 3  # half-waves above the threshold, the last not below the first; two suffice if it is twice the first
LARGEST = 0.1  # share of the supply at which the baseline of an oscillation is clipped
MEMORY = 10.0  # s over which the baselines are averaged
MEAN = 0.5  # s over which voltages are averaged before the integral takes them over; a few periods of an oscillation
BUSY, STUCK = 1.0, 2.0  # s over which limit and saturation are averaged
RETURN = 5.0  # s in which a learner that resumes at full gain gets its authority back
APART = 0.15  # m of distance to the reference that are always tolerated; a run fails at 1 m
BACK_OFF = 3.0  # factor by which each attempt learns more slowly, and waits longer
UNSURE = 0.1  # further factor on the learning gain of a stage that cannot be reset to its initial weights


class Guard(Record):
    """Settings of the guard, the watchdog on every learner."""

    on: bool = True
    """Whether the guard watches the learner, and may limit, freeze or replace it."""
    share: Annotated[float, Field(gt=0, le=1)] = 1.0
    """Largest share of the supply voltage that the feedforward alone may command on a wheel; on a steering channel, of
    the largest rotation velocity."""
    weights: Annotated[float, Field(gt=0, le=1e3)] = 2.5
    """Largest norm of the weights, as a ratio: the voltage that they give for features of size one, over the supply."""
    oscillation: Annotated[float, Field(gt=0, le=1)] = 0.05
    """Amplitude, as a share of the supply, below which an oscillation of the loop is ignored."""
    growth: Annotated[float, Field(ge=1, le=100)] = 3.0
    """Factor by which oscillation and distance to the reference may exceed their running means."""
    hold: Annotated[float, Field(gt=0, le=100)] = 1.0
    """Shortest duration of the first freeze or fallback in s; each later one lasts three times as long as the last."""
    retries: Annotated[int, Field(ge=0, le=20)] = 4
    """Number of times that learning may resume, each time with a third of the gain; after that the fallback stays."""
    fade: Annotated[float, Field(gt=0, le=2)] = 0.1
    """Time constant in s with which the step in voltage at the beginning of a fallback fades."""
    fallback: Literal["model", "none"] = "model"
    """Feedforward during a fallback: the nominal inverse dynamics (`model`), or PID alone (`none`)."""


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
        ("range", "f8", 2),  # largest command of a channel: the supply in V, or the largest θ̇ in rad/s
        # Oscillation of four signals, feedforward and feedback of the two channels, as shares of `range`
        ("low_pass", "f8", 4),  # the signal without noise
        ("slow_mean", "f8", 4),  # its slow mean
        ("sign", "f8", 4),  # of the present half-wave
        ("peak", "f8", 4),  # its amplitude
        ("half_wave_time", "f8", 4),  # its duration so far, s
        ("baseline", "f8", 4),  # mean amplitude of earlier half-waves
        ("baseline_time", "f8", 4),  # time over which that was averaged, s
        ("waves", "f8", 4),  # consecutive half-waves above the threshold
        ("first", "f8", 4),  # amplitude of the first of them
        # Other quantities that are compared with a bound
        ("mean_distance", "f8"),  # mean distance to the reference, m
        ("observed", "f8"),  # time over which that was averaged, s
        ("limited_share", "f8"),  # recent share of time in which the output was limited
        ("saturated_share", "f8"),  # recent share of time in which a limit acted on voltage or steering angle
        ("model_error", "f8", 2),  # mean of the voltage sent less that of the nominal model, V
        # Decisions
        ("action", "f8"),  # index into `GUARD_ACTIONS`
        ("reason", "f8"),  # index into `REASONS`
        ("hold_left", "f8"),  # time until learning may resume, s
        ("strikes", "f8"),  # number of failed attempts of the learner
        ("gain", "f8"),  # factor on the feedback that the learner is taught with
        ("authority", "f8"),  # share of the learner in the output; the rest is the fallback's
        ("bump", "f8", 2),  # step in voltage at the beginning of a fallback, as far as it has not faded yet, V
        ("forget", "?"),  # whether the learner is to be reset to its initial weights
        ("frozen", "?"),  # whether the learner must not learn now
        ("limited", "f8", 2),  # output of the learner after the limit, V
        ("output", "f8", 2),  # the feedforward to apply, V
        ("teaching", "f8", 2),  # the feedback to learn from, V
    ],
    align=True,
)


def fresh(settings: list[Guard], robot: Rows, volts: Array) -> Rows:
    """Returns records of `GUARD` at the start of a run, `(B,)`.

    Args:
        settings: Settings of each robot.
        robot: The nominal robot, as from `nominal`.
        volts: Voltage in V that weights of norm one give for features of size one; 0 if unknown, `(B,)`.
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

    - limit: the output is scaled to its share of the supply; meanwhile nothing is learned.
    - freeze: nothing is learned, while an oscillation begins to grow and in saturation.
    - fallback: the nominal inverse dynamics replaces the learner, after trouble that freezing does not end. The
      integral starts from the mean error of the model, so that the step in voltage is small; what is left of it fades.
      The learner is reset to its initial weights.
    - resume: the learner returns after the hold, once nothing is wrong, each time with less gain and after a longer
      hold. After a fallback its share of the output, the authority, grows from 0 to 1 as slowly as it learns; the rest
      is the fallback's. After `retries` the fallback stays.

        output = fallback + authority (learner − fallback) + bump

    Args:
        g: In and out: a record of `GUARD`, whose `output`, `teaching`, `frozen` and `forget` are the result.
        feedforward: Output of the feedforward stage in V (rad/s on a steering channel), `(2,)`.
        nominal: Output of the nominal inverse dynamics in the same units, `(2,)`.
        error: Posture error in m, m, rad, `(3,)`.
        norm: Norm of the learner's weights.
        saturated: Whether a limit acted in the last tick.
        voltage: Voltage of the last tick in the two channels, after the limits, `(2,)`.
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
    if not broken:  # otherwise the last output remains, from which the fallback starts
        for k in range(2):
            g.limited[k] = feedforward[k]
        clipped = limit_output(g, rigid, g.limited)
    for k in range(2):
        g.output[k] = g.limited[k]
        if g.authority < 1.0:
            fallback = nominal[k] if g.model else 0.0
            g.bump[k] *= g.fade / (g.fade + period)
            g.output[k] = fallback + g.authority * (g.limited[k] - fallback) + g.bump[k]
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
    """Returns the amplitude of signal k, as a share of its range, if it is an oscillation that grows; otherwise 0.

    A half-wave counts if it is shorter than `SLOWEST` and its peak exceeds both `oscillation` and `growth` times the
    baseline. The oscillation grows if `SUSTAINED` half-waves in a row count and the last is not below the first, or if
    the second is twice the first.
    """
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
        if lasted > 0:  # a mean over the whole past, and later over `MEMORY`
            g.baseline_time[k] = min(g.baseline_time[k] + lasted, MEMORY)
            g.baseline[k] += min(1.0, lasted / g.baseline_time[k]) * (min(peak, LARGEST) - g.baseline[k])
        g.sign[k], g.peak[k], g.half_wave_time[k] = sign, 0.0, 0.0
    g.peak[k] = max(g.peak[k], abs(wave))
    g.half_wave_time[k] += period
    return grown


@kernel
def worst_trouble(g: Row, broken: bool, growing: float, distance: float, norm: float) -> int:
    """Returns the reason of the worst trouble now, an index into `REASONS`; 0 if nothing is wrong."""
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
    """Limits the channels to their share of the supply or of the largest rotation; returns whether a limit acted."""
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
    """Returns whether no signal has had more than one half-wave in a row above its threshold."""
    for k in range(4):
        if g.waves[k] > 1:
            return False
    return True


@kernel
def step_in(g: Row, trouble: int, large: bool, nominal: Array, integral: Array, feedback: Array) -> None:
    """Freezes the learner, or replaces it by the fallback if freezing is not enough or did not help."""
    frozen = g.action == FREEZE
    if frozen and trouble == SATURATION:
        return
    if trouble != SATURATION and not (frozen and g.reason == OSCILLATION):  # otherwise it is still the same attempt
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
        fallback = nominal[k] if g.model else 0.0
        target = g.model_error[k] + nominal[k] - fallback
        g.bump[k] = g.output[k] + integral[k] - target - fallback
        g.output[k] = fallback + g.bump[k]
        feedback[k] += target - integral[k]  # the feedback contains the old integral
        integral[k] = target
