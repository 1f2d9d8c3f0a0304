"""Composite adaptation: weights of physical features follow prediction errors and tracking errors.

    U = φ(x)ᵀ a + d,      φ = V, θ̇, V̇, θ̈, V θ̇, θ̇², s_l, s_r, cos θ, sin θ,      a(0) = 0, d(0) = 0

A Kalman filter (`predict`) estimates the weights a and the disturbance d from the voltage that acted and the motion
that followed, both low-passed; the tracking term (`track`) moves a by a share of the feedback voltage e:

    U_f = prior(x_f) + φ(x_f)ᵀ a + d + noise,      x_f = (V_f, V̇_f)
    a ← a + P φ(x_c) · step · e / (φ(x_c)ᵀ P φ(x_c)),      x_c = commanded motion that e answers (`matching.recall`)

s_l and s_r are smoothed signs of the speeds of the wheels. Slotine and Li (1989) combine the two errors; Neural-Fly
(O'Connell et al. 2022) and MAGIC-VFM (Lupu et al. 2024) do so with a Kalman filter. The weights of cosine and sine of
the heading are gravity on a slope of any direction.

Voltage and motion pass the same two first-order filters. V̇_f is the input of the second filter less its output, over
its time constant, so that nothing is differentiated. With only one filter, V̇_f would contain the noise of V unfiltered,
and noise on a regressor biases its weight toward zero.

The weights are modelled as an Ornstein-Uhlenbeck process, whose stationary covariance P₀ (`stationary`) says by how
much plants differ; without excitation P returns to P₀ and does not grow further. d is modelled in the same way with a
short memory; it takes up what is no function of the motion, such as a push, and what the weights have not explained
yet. The noise of the measured motion is estimated from its second differences, which inertia keeps small; the larger
the noise, the less a sample counts. The heading is dead reckoning; its origin does not matter.

When the innovations of one channel grow suddenly, the plant has changed, and P of both channels is reset.

Under `rigid` steering the second channel works in the same way: the rotation that is commanded to the steering takes
the place of the voltage, its nominal inverse is the rotation itself, and U is the correction of the command.
"""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from mrctl.control.algebra import dot, symmetric_product
from mrctl.control.features import CHANNELS, FEATURES, REGRESSORS, dead_reckoned, feature_scale, moves, regressor
from mrctl.control.feedforward import STEERING_SCALE, STEERING_SHARE, Learner, Loop, Shown, explained
from mrctl.control.matching import SETTLING_TIMES, histories, low_pass, recall, sent
from mrctl.kernel import Array, Row, kernel
from mrctl.record import Record
from mrctl.theory.dynamics import inverse_coefficients
from mrctl.theory.robot import Robot

STEERING_DISTURBANCE = 0.03  # rad/s of disturbance per volt; it is smaller, since the geometry needs no motor
OUTLIER_SIGMAS = 3.0  # standard deviations at which an innovation is clipped: a tyre slips, or a wheel lost its load
# s over which squared innovations are averaged, to detect a change of the plant
BRIEF_AVERAGE, LASTING_AVERAGE = 0.25, 4.0
CHANGE_RATIO = 5.0  # ratio of the brief to the lasting mean square of the innovations that shows a changed plant
UNEXCITED = 1e-9  # V² or (rad/s)²; features whose φᵀ P φ is smaller explain no feedback
# V of noise in a sample for each m/s of noise in the measured wheel speed; tuned with noise of 10 mm/s in V and
# 20 mrad/s in θ̇, behind filters of 0.03 s, at a control period of 10 ms.
SCATTER_GAIN = 300.0
UNKNOWN_WEIGHT = 6.0  # V, standard deviation of the weights of the eight features without a model


@kernel
def predict(k: int, s: Row) -> None:
    """One Kalman step of channel k for residual = φᵀ a + d + noise; below, a stands for (a, d) and φ for (φ, 1).

        S = φᵀ P φ + r,    e = residual − φᵀ a,    K = P φ / S
        a ← F (a + K e),    P ← F (P − K S Kᵀ) F + Q,    Q = P₀ − F P₀ F

    With this Q, the covariance returns to P₀ without excitation (Ornstein-Uhlenbeck process). An innovation beyond 3 √S
    is clipped to 3 √S (Huber). The variance r of a sample grows with the noise of the measured twist.

    Args:
        k: Channel.
        s: In and out: a record of `COMPOSITE`.
    """
    a, P, f, Pphi = s.a[k], s.P[k], s.f[k], s.Pphi
    symmetric_product(P, s.phi, Pphi)
    S = s.noise[k] ** 2 + s.scatter[k] ** 2 * s.variance[k]
    e = s.residual[k]
    for i in range(REGRESSORS + 1):
        S += s.phi[i] * Pphi[i]
        e -= s.phi[i] * a[i]
    e = max(-OUTLIER_SIGMAS * np.sqrt(S), min(OUTLIER_SIGMAS * np.sqrt(S), e))
    s.power[k, 0] += s.brief * (e * e - s.power[k, 0])
    s.power[k, 1] += s.lasting * (e * e - s.power[k, 1])
    e /= S
    for i in range(REGRESSORS + 1):
        a[i] = f[i] * (a[i] + Pphi[i] * e)
        for j in range(REGRESSORS + 1):
            P[i, j] = f[i] * f[j] * (P[i, j] - Pphi[i] * Pphi[j] / S) + (1 - f[i] * f[j]) * s.stationary[k, i, j]


@kernel
def track(k: int, feedback: float, s: Row) -> None:
    """The tracking term of channel k moves φ_cᵀ a by `step` times the feedback voltage e, along P φ_c.

        a ← a + P φ_c · step · e / (φ_cᵀ P φ_c),    φ_c = φ at the command that e answers; d is left out

    Args:
        k: Channel.
        feedback: e in V (rad/s on a steering channel).
        s: In and out: a record of `COMPOSITE`.
    """
    if not abs(feedback) > s.dead_zone[k]:
        return
    a, P, phi, Pphi = s.a[k], s.P[k], s.past, s.Pphi
    symmetric_product(P, phi[:REGRESSORS], Pphi)
    power = dot(phi[:REGRESSORS], Pphi[:REGRESSORS])
    if power > UNEXCITED:
        for i in range(REGRESSORS):
            a[i] += s.step[k] / power * feedback * Pphi[i]


@kernel
def reset_covariance(k: int, s: Row) -> None:
    """P ← P₀ + a aᵀ after a change of the plant; the weights stay.

    This is covariance resetting (Goodwin and Sin, 1984). The second term is the step of the weights back to zero, in
    case the plant returns to the nominal one.
    """
    for i in range(REGRESSORS + 1):
        for j in range(REGRESSORS + 1):
            s.P[k, i, j] = s.stationary[k, i, j]
    for i in range(REGRESSORS):
        for j in range(REGRESSORS):
            s.P[k, i, j] += s.a[k, i] * s.a[k, j]


@kernel
def detect_change(period: float, s: Row) -> None:
    """Resets the covariance where the plant has changed, and again when the filters have forgotten the former plant."""
    settled, before = SETTLING_TIMES * period * (1 / s.share - 1), s.since
    s.since += period
    if s.power[0, 0] > CHANGE_RATIO * s.power[0, 1] or s.power[1, 0] > CHANGE_RATIO * s.power[1, 1]:
        for k in range(CHANNELS):
            s.power[k, 1] = max(s.power[k, 0], s.power[k, 1])
        before = s.since = 0.0
    if s.since == 0.0 or before < settled <= s.since:
        for k in range(CHANNELS):
            reset_covariance(k, s)


@kernel
def filter_twice(signal: Array, once: Array, twice: Array, share: float, begins: bool) -> None:
    """Passes a signal of two components through the two filters of `low_pass`, which begin at its first value."""
    for k in range(2):
        if begins:
            once[k] = twice[k] = signal[k]
        low_pass(signal[k], k, share, once, twice)


@kernel
def filter_motion(shown: Shown, robot: Row, s: Row) -> None:
    """Passes voltage, twist and heading through the two filters, and estimates the noise of the twist.

        V̇_f = (once − twice)/T,    V_f = twice − V̇_f h/2,    var V = mean (V_n − 2 V_n−1 + V_n−2)²/6

    The voltage acts in the period that ends now, over which V̇_f is the difference quotient of the second filter's
    output, and V_f the mean. With V at its end the inertia found would be too small by c_V h/2. The second difference
    of independent noise has six times the variance of that noise.
    """
    twist, now, once, twice = shown.twist, s.now, s.once, s.twice
    now.twist[0], now.twist[1] = twist[0], twist[1]
    s.heading = dead_reckoned(s.heading, twist[1], shown.period, now.direction)
    filter_twice(now.voltage, once.voltage, twice.voltage, s.share, s.age == 0)
    filter_twice(now.twist, once.twist, twice.twist, s.share, s.age == 0)
    filter_twice(now.direction, once.direction, twice.direction, s.share, s.age == 0)
    for k in range(CHANNELS):
        if s.age == 0:
            s.last[0, k] = s.last[1, k] = twist[k]
        difference = twist[k] - 2 * s.last[0, k] + s.last[1, k]
        s.variance[k] += s.lasting * (difference * difference / 6 - s.variance[k])
        s.last[1, k], s.last[0, k] = s.last[0, k], twist[k]
        s.rate[k] = (once.twist[k] - twice.twist[k]) * s.share / (1 - s.share) / shown.period
        s.motion[k] = twice.twist[k] - s.rate[k] * shown.period / 2
        now.voltage[k] = sent(k, shown, robot.rigid)
    s.age += s.share


@kernel
def respond(i: int, command: Array, derivative: Array, robot: Row, arrays: tuple[Any, ...], voltage: Array) -> None:
    """U = φ(x_c)ᵀ a + d at the commanded motion x_c."""
    rows, scale, _ = arrays
    s = rows[i]
    regressor(command, derivative, s.now.direction, robot.half_track, scale, s.phi_c)
    s.phi_c[REGRESSORS] = 1.0
    for k in range(CHANNELS):
        voltage[k] = dot(s.a[k, :REGRESSORS], s.phi_c[:REGRESSORS]) + s.a[k, REGRESSORS]


@kernel
def learn(i: int, shown: Shown, robot: Row, prior: Row, arrays: tuple[Any, ...], added: Array) -> float:
    """One step of prediction and tracking; while the robot must not learn, the disturbance decays.

    `added` leaves the disturbance out, so that the PID's integral keeps its part of it, as with `observer`.
    """
    rows, scale, queue = arrays
    s = rows[i]
    answered = recall(s.phi_c, queue[i], s)
    filter_motion(shown, robot, s)
    added[0] = added[1] = 0.0
    if moves(s.motion, robot.half_track) and s.age > SETTLING_TIMES and shown.frozen == 0:
        regressor(s.motion, s.rate, s.twice.direction, robot.half_track, scale, s.phi)
        s.phi[REGRESSORS] = 1.0
        explained(s.motion, s.rate, robot.rigid, prior, s.residual)
        for k in range(CHANNELS):
            s.residual[k] = s.twice.voltage[k] - s.residual[k]
            added[k] = dot(s.a[k, :REGRESSORS], s.phi_c[:REGRESSORS])
            predict(k, s)
            if answered:
                track(k, shown.feedback[k], s)
        detect_change(shown.period, s)
        for k in range(CHANNELS):
            added[k] = dot(s.a[k, :REGRESSORS], s.phi_c[:REGRESSORS]) - added[k]
    else:
        for k in range(CHANNELS):
            s.a[k, REGRESSORS] *= s.f[k, REGRESSORS]
    s.norm = np.sqrt((s.a[:, :REGRESSORS] ** 2).sum())
    return s.norm


class Composite(Record):
    """Settings of the learner `composite`; one setting serves every robot, steering and perturbation."""

    moved = {"weights": "features are no longer trained; save_learned and `learned` keep what a run has adapted"}

    noise: Annotated[float, Field(ge=1e-6, le=100)] = 0.2
    """Standard deviation of one sample of the regression in V, if the motion is measured without noise; the noise that
    the measured motion shows is added. On a steering channel it is a tenth of this number in rad/s."""
    gain: Annotated[float, Field(ge=0, le=100)] = 0.3
    """Standard deviation over plants of a factor on the whole model, as from supply, motor constant or resistance."""
    spread: Annotated[float, Field(ge=0, le=1e3)] = 1.0
    """Standard deviation of each weight over plants in V; on a steering channel a tenth of this number in rad/s."""
    memory: Annotated[float, Field(ge=1, le=1e6)] = 1000.0
    """Correlation time of the weights in s, in which they wander by as much as plants differ."""
    disturbance: Annotated[float, Field(ge=0, le=100)] = 0.05
    """Standard deviation of the disturbance in V; on a steering channel it is 3 % of this number in rad/s."""
    disturbance_memory: Annotated[float, Field(ge=0.01, le=1e6)] = 0.15
    """Correlation time of the disturbance in s, in which it wanders by its standard deviation."""
    filter: Annotated[float, Field(ge=0.01, le=2)] = 0.03
    """Time constant in s of each of the two filters on voltage and motion."""
    step: Annotated[float, Field(ge=0, le=1)] = 0.005
    """Share of the feedback that the tracking term moves into the feedforward in each control period; on a steering
    channel a tenth of this number."""
    dead_zone: Annotated[float, Field(ge=0, le=5)] = 0.02
    """Feedback in V below which the tracking term is zero; on a steering channel, a tenth of this number in rad/s."""


FILTERED = np.dtype(
    [
        ("voltage", "f8", CHANNELS),  # of the two channels, V (rad/s on a steering channel)
        ("twist", "f8", CHANNELS),  # measured, m/s and rad/s
        ("direction", "f8", 2),  # cosine and sine of the heading
    ],
    align=True,
)

COMPOSITE = np.dtype(
    [
        # Settings, for the two channels; the second is in rad/s where it is steering.
        ("f", "f8", (CHANNELS, REGRESSORS + 1)),  # diagonal of F: decay of a and, last, of d in a period
        ("stationary", "f8", (CHANNELS, REGRESSORS + 1, REGRESSORS + 1)),  # P₀, V²
        ("step", "f8", CHANNELS),  # share of the feedback that the tracking term moves into the feedforward
        ("dead_zone", "f8", CHANNELS),  # feedback below which the tracking term is zero, V
        ("noise", "f8", CHANNELS),  # standard deviation of a sample, V
        ("scatter", "f8", CHANNELS),  # further noise of a sample for each m/s or rad/s of noise in the twist, V
        ("brief", "f8"),  # weight of a new sample in the brief mean square of the innovations
        ("lasting", "f8"),  # weight of a new sample in the lasting mean square, and in the variance of the twist
        ("share", "f8"),  # weight of a new sample in the two filters
        # Motion
        ("age", "f8"),  # time since the start over T + h, with the time constant T of a filter and the period h
        ("heading", "f8"),  # by dead reckoning, rad
        ("now", FILTERED),  # input of the first filter
        ("once", FILTERED),  # output of the first filter
        ("twice", FILTERED),  # output of the second filter
        ("last", "f8", (2, CHANNELS)),  # the last two measured twists, m/s and rad/s
        ("variance", "f8", CHANNELS),  # variance of the noise of the measured twist, (m/s)² and (rad/s)²
        ("rate", "f8", CHANNELS),  # filtered acceleration V̇_f, m/s² and rad/s²
        ("motion", "f8", CHANNELS),  # mean V_f of the filtered twist over the last period, m/s and rad/s
        ("phi", "f8", REGRESSORS + 1),  # (φ, 1) at the filtered motion
        ("phi_c", "f8", REGRESSORS + 1),  # (φ, 1) at the command
        ("tick", "i8"),  # number of ticks so far
        ("past", "f8", REGRESSORS + 1),  # φ_c of the output that the feedback answers
        ("residual", "f8", CHANNELS),  # filtered voltage less the prior's, V
        # What is learned
        ("a", "f8", (CHANNELS, REGRESSORS + 1)),  # weights of φ and, last, the disturbance d, V
        ("P", "f8", (CHANNELS, REGRESSORS + 1, REGRESSORS + 1)),  # their covariance, V²
        ("Pphi", "f8", REGRESSORS + 1),  # P φ
        ("power", "f8", (CHANNELS, 2)),  # brief and lasting mean square of the innovations, V²
        ("since", "f8"),  # time since the plant was found to have changed, s
        ("norm", "f8"),  # ‖a‖ of both channels, V
    ],
    align=True,
)


def stationary(settings: Composite, robot: Robot, rigid: bool, has_prior: bool) -> Array:
    """P₀ of weights and disturbance, `(2, 11, 11)` in V²; c are the coefficients of the nominal inverse dynamics.

        P₀ = gain² c cᵀ + spread² I

    A supply, motor constant or resistance that differs from the model changes all coefficients in one proportion, so
    that a few samples tell much about all of them; the second term covers all other differences.

    Args:
        settings: The settings.
        robot: The nominal robot.
        rigid: Whether channel two is steering.
        has_prior: Whether a model is the prior; otherwise the weights are as large as those of a model.
    """
    c, scale = np.zeros((CHANNELS, REGRESSORS)), feature_scale(robot)
    c[:, :FEATURES] = inverse_coefficients(robot).T * scale
    if rigid:
        c[1], c[1, 1] = 0.0, scale[1]  # the rotation itself
    P = np.zeros((CHANNELS, REGRESSORS + 1, REGRESSORS + 1))
    unit = np.array([1.0, STEERING_SCALE if rigid else 1.0])
    P[:, :REGRESSORS, :REGRESSORS] = settings.gain**2 * c[:, :, None] * c[:, None, :]
    P[:, range(REGRESSORS), range(REGRESSORS)] += (settings.spread * unit[:, None]) ** 2
    if not has_prior:  # the geometry of a steering channel is known in any case
        P[: 1 if rigid else 2, range(FEATURES), range(FEATURES)] += UNKNOWN_WEIGHT**2
    P[:, REGRESSORS, REGRESSORS] = (settings.disturbance * np.array([1.0, STEERING_DISTURBANCE if rigid else 1.0])) ** 2
    return P


class CompositeAdaptation(Learner):
    """The learner `composite` for B robots.

    Attributes:
        rows: One record of `COMPOSITE` a robot.
        weight_norm: Euclidean norm of a, `(B,)`.
    """

    respond, learn_one, record, learned = respond, learn, COMPOSITE, ("a", "P")

    def __init__(self, loop: Loop, settings: list[Composite]) -> None:
        """Takes the loop, and the settings of each robot; without a prior, P₀ allows weights as large as a model's."""
        super().__init__(loop, settings)
        rows, (robot, rigid, period, *_) = self.rows, loop
        unit = np.array([1.0, STEERING_SCALE if rigid else 1.0])
        for row, s in zip(rows, settings, strict=True):
            memory, brief_memory = np.exp(-period / np.array([s.memory, s.disturbance_memory]))
            row["f"][:, :REGRESSORS], row["f"][:, REGRESSORS] = memory, brief_memory
            row["stationary"] = stationary(s, robot, rigid, loop.has_prior)
            row["step"] = s.step * np.array([1.0, STEERING_SHARE if rigid else 1.0])
            row["dead_zone"] = s.dead_zone * unit
            row["noise"] = s.noise * unit
            row["scatter"] = SCATTER_GAIN * unit * (1.0, robot.half_track)
            row["brief"], row["lasting"] = period / (period + BRIEF_AVERAGE), period / (period + LASTING_AVERAGE)
            row["share"] = period / (period + s.filter)
        self.arrays = rows, feature_scale(robot), histories(len(settings), loop.delay, REGRESSORS + 1)
        self.restore(np.arange(len(settings)))

    @property
    def parameters(self) -> Array:
        """Learned coefficients of the scaled features, `(B, 8, 2)` in V."""
        return self.rows["a"][:, :, :FEATURES].swapaxes(1, 2).copy()

    def adopt(self, row: int, learned: Array) -> None:
        """Does as `Learner.adopt`, but leaves out slope and disturbance, which belong to another place and moment."""
        super().adopt(row, learned)
        s = self.rows[row]
        local = [*range(FEATURES, REGRESSORS + 1)]
        s["a"][:, local] = 0.0
        s["P"][:, local, :] = s["P"][:, :, local] = 0.0
        s["P"][:, local, local] = s["stationary"][:, local, local]

    def restore(self, rows: NDArray[np.intp]) -> None:
        """Resets robots to their initial weights and covariance."""
        self.weight_norm[rows] = 0.0
        for i in rows:
            s = self.rows[i]
            s["a"], s["norm"], s["P"], s["tick"] = 0.0, 0.0, s["stationary"], 0
            s["power"] = (s["noise"] ** 2 + s["scatter"] ** 2 * s["variance"])[:, None]
            s["since"] = SETTLING_TIMES * self.period * (1 / s["share"] - 1)
