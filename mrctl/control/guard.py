"""A watchdog on a learning feedforward: it replaces the learner by the nominal model, and lets it try again.

This is the simplex architecture (Seto, Krogh, Sha and Chutinan 1998): a controller that may be wrong has full authority
as long as a trusted one, here PID and nominal model, can recover from the present state.

**Symbols.** In each channel d = authority · (learner − model) is the deviation, and e the error of the velocity. The
posture error is ρ, and ρ_min the least ρ so far. The region of recovery is |e| ≤ ē and ρ ≤ ρ̄ = 0.15 m. The largest
deviations that cannot take e or ρ out of it are

    D = ē/‖G_e‖₁,    D_ρ = min(D, ρ̄/(√2 ‖G_ρ‖₁))

‖G‖₁ are the peak-to-peak gains of the designed loops from a voltage (`rejection`); √2, as ρ² is the sum of the squares
of what the two channels contribute. With the PIDs of the tiers D_ρ = D.

A learner without a prior begins as PID alone, which lacks the whole voltage U of the model. Its error is no fault of
the learner, so that ρ̄ is then |(‖G_ρ,1‖₁ max |U_1|, ‖G_ρ,2‖₁ max |U_2|)| where that is larger, up to 0.45 m. Where it
is larger, the third guarantee below is not derived.

**Blame.** The guard keeps the peak of |d|, which decays with a time constant of 1 s. The learner is to blame for an
error e if this peak exceeds D, for an error ρ if it exceeds D_ρ, and for an oscillation if it exceeds D/4. The voltage
that learning has taken from the PID's integral counts like a d; the sum of it decays with the same time constant.

| cause of a fallback   | condition                                                                         |
| --------------------- | --------------------------------------------------------------------------------- |
| error                 | |e| > ē, or ρ > max(ρ̄, 3 ρ_min), while the learner is to blame                   |
| sustained oscillation | 16 half-waves of the PID's output in a row beyond D/4 while it is to blame        |
| not finite            | NaN or ∞ from the learner                                                         |

**Return.** After a hold of 1 s the learner resumes with its initial weights, and its authority grows from 0 to 1 in
5 s. Each further hold is three times as long as the one before. After an oscillation, and after each fallback from the
second on, the feedback that teaches is divided by three (`mrac` is not taught by it), and the authority grows three
times as slowly.

**What it guarantees.**

1. While |d| ≤ D_ρ, d cannot take ρ out of the region, however it oscillates or grows, nor e for the same command. The
   guard leaves such a learner alone, unless the loop oscillates. With |d| ≤ D this holds for e. The motion controller
   answers d too, and so changes the command: with that, e is at most 1.3 ē for the default robot.
2. An error that leaves the region while the learner is to blame ends it in the same tick. Until then the errors are
   inside. A learner that has come back within the bounds is no longer to blame once the peak of its |d| has decayed,
   but an error that it has caused may still grow. In the worst case found (by linear programming, for the default
   robot and the same command) e reaches 1.10 ē with the PID of `lab`, 1.13 ē with that of `field`, and with the slow
   one of the paper 1.7 ē, and ρ 0.22 m.
3. After a fallback PID and model act alone. The integral of the PID and the feedforward together start within D of the
   model, and the rest of the step in voltage, which fades, is within D too. From any such state the position error
   stays below a bound that both loops give: 0.23 to 0.27 m for the default robot (`recovery` in
   `tests/system/test_adversaries.py`, which counts the rest of the step as a part of the integral).

The bounds are those of the linear loops that the PID was designed for. The limits of voltage and acceleration, and what
happens within the loop's delay, add to them: under `rigid` steering with the PID of the paper ρ reached 0.22 m with |d|
within D. `tests/system/test_adversaries.py` drives against the worst learners.

The answer to oscillations is no part of the guarantee. A loop with more delay than it was designed for may oscillate
within the region, and tracks better without the learner. `delay` answers faster and smaller oscillations than the guard
does, with slower controllers and a third of the feedback that teaches.
"""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from mrctl.control.oscillation import HALF_WAVES, SWING, count_half_waves, swing
from mrctl.kernel import Array, Row, Rows, kernel
from mrctl.record import Record

GUARD_ACTIONS = ("none", "fallback")
NONE, FALLBACK = range(2)
REASONS = ("", "sustained oscillation", "far from the reference", "velocity far from the command", "output not finite")
_, OSCILLATION, FAR, FAST, BROKEN = range(5)

MAX_HALF_WAVE = 1.0  # s, longest half-wave of an oscillation; what a lap asks for is slower
SUSTAINED_HALF_WAVES = 16  # half-waves in a row that make an oscillation
PEAK_DECAY = 1.0  # s, time constant with which the peak of a deviation decays
# s over which voltages are averaged before the integral takes them over; a few periods of an oscillation
AVERAGING_TIME = 0.5
RESUME_TIME = 5.0  # s in which a learner that resumes at full gain gets its authority back
TOLERATED_POSTURE = 0.15  # ρ̄: posture error in m that is always tolerated; a run fails at a lateral one of 1 m
MAX_TOLERATED_POSTURE = 0.45  # m, ρ̄ at most of a learner without a prior; chosen
# m/s and rad/s, errors of V and θ̇ that are always tolerated; slow robots start with them
TOLERATED_VELOCITIES = (0.27, 0.75)
HEADING_ARM = 0.75  # m ahead of the robot at which a heading error counts as a position error
BACK_OFF = 3.0  # factor by which each attempt learns more slowly, and waits longer
NO_RESET_FACTOR = 0.1  # further factor on the learning gain of a stage that cannot be reset to its initial weights


@kernel
def guard(
    g: Row, feedforward: Array, nominal: Array, posture_error: Array, voltage: Array, period: float, rigid: bool,
    pid: Row, feedback: Array,
) -> None:  # fmt: skip
    """One tick of the guard of one robot, between the feedforward stage and the allocation.

    - fallback: the nominal inverse dynamics, or nothing, replaces the learner. The integral starts from the mean error
      of the model, so that the step in voltage is small; the rest of the step fades. The learner is reset to its
      initial weights.
    - resume: the learner returns after the hold, once nothing is wrong; from the second time on with less gain and
      after a longer hold. Its share of the output, the authority, grows from 0 to 1 as slowly as it learns; the rest is
      the fallback's. After `retries` the fallback stays.

    Args:
        g: In and out: a record of `GUARD`, whose `output`, `teaching`, `frozen` and `forget` are the result.
        feedforward: Output of the feedforward stage in V (rad/s on a steering channel), `(2,)`.
        nominal: Output of the nominal inverse dynamics in the same units, `(2,)`.
        posture_error: Posture error in m, m, rad, `(3,)`.
        voltage: Voltage of the last tick in the two channels, after the limits, `(2,)`.
        period: Control period in s.
        rigid: Whether the second channel is steering.
        pid: In and out: a record of `PID`, whose `error` is that of V and θ̇, and whose `integral` takes over.
        feedback: In and out: output of the PID, `(2,)`.
    """
    g.forget = False
    if g.on:
        limit_learner(g, feedforward, rigid)
        mix(g, nominal, voltage, feedback, period)
        trouble = worst_trouble(g, posture_error, pid.error)
        g.broken = False
        g.hold_left -= period
        if g.action != FALLBACK and trouble > 0:
            fall_back(g, trouble, nominal, pid.integral, feedback)
        elif trouble > 0:
            g.hold_left = max(g.hold_left, g.hold)
        elif g.hold_left <= 0:
            g.action, g.reason = NONE, 0.0
        if g.action != FALLBACK:
            g.authority = min(1.0, g.authority + period * g.gain / RESUME_TIME)
        g.frozen = g.action == FALLBACK
    for k in range(2):
        if not g.on:
            g.output[k] = feedforward[k]
        g.teaching[k] = g.gain * feedback[k]


@kernel
def limit_learner(g: Row, feedforward: Array, rigid: bool) -> None:
    """Limits the output of the learner to the supply, as the voltage of each motor is limited: U_r,l = U_Σ ± U_Δ.

    Of one that is not finite `limited` keeps its last values, from which the fallback starts.
    """
    g.beyond = False
    for k in range(2):
        if not np.isfinite(feedforward[k]):
            g.broken = True
    for k in range(2):
        demand = abs(feedforward[k]) if rigid else abs(feedforward[0]) + abs(feedforward[1])
        if demand > g.range[k]:
            g.beyond = True
        if not g.broken:
            g.limited[k] = feedforward[k] * (g.range[k] / max(g.range[k], demand))


@kernel
def mix(g: Row, nominal: Array, voltage: Array, feedback: Array, period: float) -> None:
    """Mixes the learner with the fallback, and measures what `worst_trouble` compares with bounds.

        output = fallback + authority (learner − fallback) + bump

    The bump is the step in voltage at the beginning of a fallback, as far as it has not faded yet.
    """
    decay = PEAK_DECAY / (PEAK_DECAY + period)
    for k in range(2):
        fallback = nominal[k] if g.model else 0.0
        deviation = g.authority * (g.limited[k] - fallback)
        g.output[k] = g.limited[k]
        if g.authority < 1.0:
            g.bump[k] *= g.fade / (g.fade + period)
            g.output[k] = fallback + deviation + g.bump[k]
        wave = swing(feedback[k], k, period, g.feedback)
        count_half_waves(wave, k, g.oscillation * g.harmless[k], MAX_HALF_WAVE, period, g.half_waves)
        g.needed[k] = max(g.needed[k], abs(nominal[k]))
        g.handed[k] *= decay
        g.deviation[k] = max(abs(deviation), abs(g.handed[k]), decay * g.deviation[k])
        g.model_error[k] += period / (AVERAGING_TIME + period) * (voltage[k] - nominal[k] - g.model_error[k])


@kernel
def worst_trouble(g: Row, posture_error: Array, velocity_error: Array) -> int:
    """Returns the reason of the worst trouble now, an index into `REASONS`; 0 if nothing is wrong.

    While the learner acts, trouble counts only if the learner deviated so far that it may have caused it.
    """
    posture = np.hypot(np.hypot(posture_error[0], posture_error[1]), HEADING_ARM * posture_error[2])
    g.nearest = min(g.nearest, posture)
    if g.broken:
        return BROKEN
    for k in range(2):
        deviation = np.inf if g.action == FALLBACK else g.deviation[k]
        if deviation > g.harmless_to_posture[k] and posture > max(tolerated_posture(g), g.growth * g.nearest):
            return FAR
        if deviation > g.harmless[k] and abs(velocity_error[k]) > g.region[k]:
            return FAST
        if deviation > g.oscillation * g.harmless[k] and g.half_waves.count[k] >= SUSTAINED_HALF_WAVES:
            return OSCILLATION
    return 0


@kernel
def tolerated_posture(g: Row) -> float:
    """Returns ρ̄ in m, of a learner without a prior at least the error that the lack of the model can cause."""
    if not g.unaided:
        return TOLERATED_POSTURE
    alone = 0.0
    for k in range(2):
        if g.needed[k] > 0:
            alone = np.hypot(alone, g.to_posture[k] * g.needed[k])
    return min(max(TOLERATED_POSTURE, alone), MAX_TOLERATED_POSTURE)


@kernel
def fall_back(g: Row, trouble: int, nominal: Array, integral: Array, feedback: Array) -> None:
    """Replaces the learner by the fallback; the integral of the feedback takes over what the model lacked, up to D.

    What is left of the step in voltage fades; beyond D it would be one more disturbance that leaves the region. Where
    the feedback has no integral, all of the step fades.
    """
    g.strikes += 1.0
    if g.strikes > 1 or trouble == OSCILLATION:  # the first error may be no more than a bad start
        g.gain /= BACK_OFF
    g.hold_left = np.inf if g.strikes > g.retries else g.hold * BACK_OFF ** (g.strikes - 1.0)
    g.action, g.reason, g.authority, g.forget = FALLBACK, trouble, 0.0, True
    for k in range(2):
        fallback = nominal[k] if g.model else 0.0
        bound = g.harmless[k]
        lacked = max(-bound, min(bound, g.model_error[k]))
        target = lacked + nominal[k] - fallback if g.hands_over else integral[k]
        g.bump[k] = max(-bound, min(bound, g.output[k] + integral[k] - target - fallback))
        g.output[k] = fallback + g.bump[k]
        feedback[k] += target - integral[k]  # the feedback contains the old integral
        integral[k] = target


class Guard(Record):
    """Settings of the guard, the watchdog on every learner."""

    moved = {
        "share": "the learner's output is limited to the supply alone",
        "weights": "the bound on the errors limits the learner; norms of weights are no longer looked at",
    }

    on: bool = True
    """Whether the guard watches the learner, and may replace it."""
    velocity: Annotated[float, Field(gt=0, le=10)] = 0.28
    """Largest errors of V and θ̇ with which a learner may go on, as a share of the robot's largest V and θ̇; at least
    0.27 m/s and 0.75 rad/s."""
    oscillation: Annotated[float, Field(gt=0, le=1)] = 0.25
    """Share of D, by more than which the PID's output must swing, and the learner deviate from the fallback, for an
    oscillation to count. D, in V (rad/s on a steering channel), is the largest deviation of the learner that cannot
    take the error of the velocity out of its bound, however it changes."""
    growth: Annotated[float, Field(ge=1, le=100)] = 3.0
    """Factor by which the posture error may exceed the smallest one so far; 0.15 m are tolerated in any case."""
    hold: Annotated[float, Field(gt=0, le=100)] = 1.0
    """Shortest duration of the first fallback in s; each later one lasts three times as long as the last."""
    retries: Annotated[int, Field(ge=0, le=20)] = 4
    """Number of times that the learner may resume, from the second on with a third of the gain each time; then the
    fallback stays."""
    fade: Annotated[float, Field(gt=0, le=2)] = 0.1
    """Time constant in s with which the step in voltage at the beginning of a fallback fades. The step is limited to
    the largest deviation from the fallback that cannot take the error of the velocity out of its bound."""
    fallback: Literal["model", "none"] = "model"
    """Feedforward during a fallback: the nominal inverse dynamics (`model`), or PID alone (`none`)."""


GUARD = np.dtype(
    [
        # Settings, as in `Guard`
        ("on", "?"),  # whether the guard watches the learner
        ("oscillation", "f8"),  # share of D beyond which a half-wave and a deviation count, 1
        ("growth", "f8"),  # factor by which the posture error may exceed the smallest one so far, 1
        ("hold", "f8"),  # duration of the first fallback, s
        ("retries", "f8"),  # number of times that the learner may resume, 1
        ("fade", "f8"),  # time constant with which the step in voltage at the beginning of a fallback fades, s
        ("model", "?"),  # whether the fallback is the nominal model, not PID alone
        ("hands_over", "?"),  # whether the feedback has an integral, which takes over what the fallback lacks
        ("range", "f8", 2),  # largest command of a channel: the supply in V, or the largest θ̇ in rad/s
        ("region", "f8", 2),  # ē: largest errors of V and θ̇ with which a learner may go on, m/s and rad/s
        ("harmless", "f8", 2),  # D: deviation of a channel that cannot take its velocity out of that region, V (rad/s)
        ("harmless_to_posture", "f8", 2),  # D_ρ: deviation that cannot take the posture out of it either, V (rad/s)
        ("to_posture", "f8", 2),  # ‖G_ρ‖₁ of each channel, m/V (m s/rad)
        ("unaided", "?"),  # whether the learner has no prior
        # Oscillation of the PID's output in the two channels
        ("feedback", SWING),
        ("half_waves", HALF_WAVES),
        # What is compared with a bound
        ("deviation", "f8", 2),  # peak of the deviation from the fallback, which decays, V (rad/s)
        ("handed", "f8", 2),  # sum of what learning took from the PID's integral, which decays, V (rad/s)
        ("nearest", "f8"),  # smallest posture error so far, m
        ("needed", "f8", 2),  # largest output of the nominal model so far, V (rad/s)
        ("model_error", "f8", 2),  # mean of the voltage sent less that of the nominal model, V (rad/s)
        # Decisions
        ("action", "f8"),  # index into `GUARD_ACTIONS`
        ("reason", "f8"),  # index into `REASONS`
        ("hold_left", "f8"),  # time until the learner may resume, s
        ("strikes", "f8"),  # number of failed attempts of the learner
        ("gain", "f8"),  # factor on the feedback that the learner is taught with
        ("authority", "f8"),  # share of the learner in the output; the rest is the fallback's
        ("bump", "f8", 2),  # step in voltage at the beginning of a fallback, as far as it has not faded yet, V (rad/s)
        ("broken", "?"),  # whether the learner is not finite, as the guard or its caller has found
        ("beyond", "?"),  # whether the learner asks for more than `range`
        ("forget", "?"),  # whether the learner is to be reset to its initial weights
        ("frozen", "?"),  # whether the learner must not learn now
        ("limited", "f8", 2),  # output of the learner, limited to the supply, V (rad/s)
        ("output", "f8", 2),  # the feedforward to apply, V (rad/s)
        ("teaching", "f8", 2),  # the feedback to learn from, V (rad/s)
    ],
    align=True,
)


def fresh(settings: list[Guard], robot: Rows, gains: Array, unaided: bool) -> Rows:
    """Returns records of `GUARD` at the start of a run, `(B,)`.

    Args:
        settings: Settings of each robot.
        robot: The nominal robot, as from `nominal`.
        gains: Peak-to-peak gains from a voltage of each channel to its velocity error and to the posture error,
            `(B, 2, 2)`.
        unaided: Whether the learners have no prior.
    """
    rows = np.zeros(len(settings), GUARD)
    for name in ("on", "oscillation", "growth", "hold", "retries", "fade"):
        rows[name] = [getattr(s, name) for s in settings]
    rows["model"] = [s.fallback == "model" for s in settings]
    rows["hands_over"] = True
    rows["range"] = ranges(robot)
    rows["region"] = np.maximum(np.array([[s.velocity] for s in settings]) * robot["max_twist"], TOLERATED_VELOCITIES)
    rows["harmless"], rows["harmless_to_posture"] = harmless(rows["region"], gains)
    rows["to_posture"], rows["unaided"] = gains[..., 1], unaided
    rows["nearest"] = np.inf
    rows["gain"] = rows["authority"] = 1.0
    return rows


def ranges(robot: Rows) -> tuple[float, float]:
    """Returns the largest command of each channel: the supply in V, or the largest θ̇ of a steering channel in rad/s.

    Args:
        robot: The nominal robot, as from `nominal`.
    """
    supply, rotation = float(robot["supply"][0]), float(robot["max_twist"][0, 1])
    return supply, rotation if robot["rigid"][0] else supply


def harmless(region: Array, gains: Array) -> tuple[Array, Array]:
    """Returns the deviations D of each channel that cannot leave the region.

    Args:
        region: ē in m/s and rad/s, `(…, 2)`.
        gains: ‖G_e‖₁ and ‖G_ρ‖₁ of each channel, `(…, 2, 2)`.

    Returns:
        D = ē/‖G_e‖₁ and D_ρ = min(D, ρ̄/(√2 ‖G_ρ‖₁)), `(…, 2)`.
    """
    velocity = region / gains[..., 0]
    return velocity, np.minimum(velocity, TOLERATED_POSTURE / (np.sqrt(2.0) * gains[..., 1]))
