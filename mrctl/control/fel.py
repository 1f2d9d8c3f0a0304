"""Feedback-error learning of the inverse dynamics with a small network: the paper's feedforward.

    U_ff = scale · (g_h W₂ tanh(W₁ x + b₁) + g_b b₂ + W₃ x + W₄ h),      Ẇ = γ (∂U_ff/∂W)ᵀ U_fb

x are the features of the commanded motion, and h = g_θ (cos θ, sin θ) is the heading, in which gravity along the robot
is linear on a slope of any direction. The paper does not have it, and the network has it only on top of a model: where
it has everything to learn, the heading would take a share of each step from what matters more. The heading is dead
reckoning, so that W₄, unlike the other weights, belongs to one run; no file holds it.

The feedback voltage U_fb is the teaching signal, so the network takes over the work that the feedback still does
(Kawato, Furukawa and Suzuki 1987, Gomi and Kawato 1993). `update` is the normalised discrete step. Its gradient is
taken at the delayed features, those of the output that the feedback answers (`matching.recall`); with those of the same
tick, learning oscillates if the robot is light and its motors are strong. `fel_torch` has the same law for any
stateless torch module.
"""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from mrctl.control.features import CHANNELS, FEATURES, dead_reckoned, feature_scale, features
from mrctl.control.feedforward import STEERING_SCALE, STEERING_SHARE, Learner, Loop, Shown
from mrctl.control.matching import histories, recall
from mrctl.control.weights import hidden_units, initial_weights, load_weights, shapes
from mrctl.kernel import Array, Row, Rows, kernel
from mrctl.record import Record

# Gains of hidden units and bias, relative to the direct links W₃. A normalised step is divided among the weights in
# proportion to their squared regressors, so these gains give most of it to the eight features. With gains of one, two
# dozen nearly constant units act as an integrator, which learns slowly what changes during a lap, and soon oscillates.
HIDDEN_GAIN, BIAS_GAIN = 0.15, 0.1
HEADING_GAIN = 0.4  # g_θ on top of a model; with a small one gravity is learned slowly, with 1 everything else is
INPUTS = FEATURES + 2  # x and h
SLOPES = CHANNELS * 2  # numbers in W₄
REGULARISATION = 1e-3  # ε: keeps the normalised step finite at rest, where the regressor vanishes


@kernel
def places(units: int) -> tuple[int, int, int, int, int]:
    """Returns where b₁ `(units,)`, W₂ `(2, units)`, b₂ `(2,)`, W₃ `(2, 8)`, W₄ `(2, 2)` begin, after W₁ᵀ `(8, units)`.

    The laws index the flat weights: to make views of the six layers would take as long as the network itself.
    """
    b1 = units * FEATURES
    W2 = b1 + units
    b2 = W2 + CHANNELS * units
    W3 = b2 + CHANNELS
    return b1, W2, b2, W3, W3 + CHANNELS * FEATURES


def by_columns(weights: Array) -> Array:
    """Returns flat weights of files and results, `(…, n)`, as those of kernels, with W₁ᵀ and W₄ = 0, `(…, n + 4)`."""
    level = np.zeros((*weights.shape[:-1], SLOPES))
    return np.concatenate([_transposed(weights, rows=-1, columns=FEATURES), level], axis=-1)


def by_rows(weights: Array) -> Array:
    """Returns flat weights of kernels, `(…, n + 4)`, as those of files, which begin with W₁ and lack W₄, `(…, n)`."""
    return _transposed(weights[..., :-SLOPES], rows=FEATURES, columns=-1)


def _transposed(weights: Array, rows: int, columns: int) -> Array:
    size = hidden_units(weights.shape[-1])[0] * FEATURES
    first = weights[..., :size].reshape(*weights.shape[:-1], rows, columns)
    return np.concatenate([np.swapaxes(first, -2, -1).reshape(*weights.shape[:-1], size), weights[..., size:]], axis=-1)


@kernel
def tanh(z: float) -> float:
    """Returns tanh z = 1 − 2/(e²ᶻ + 1) to 2e-14, with e²ᶻ = (e^(2z/256))²⁵⁶ and a series for the root.

    Unlike the exponential function of the library it has no branches, so that a loop takes four units at once.
    """
    u = z / 128
    u = -1.0 if u < -1 else u  # there the result is −1, but the series would turn round
    e = 1 + u * (1 + u * (1 / 2 + u * (1 / 6 + u * (1 / 24 + u * (1 / 120 + u / 720)))))
    e = e * e
    e = e * e
    e = e * e
    e = e * e
    e = e * e
    e = e * e
    e = e * e
    e = e * e
    return 1 - 2 / (e + 1)


@kernel
def inner(a: Array, start: int, b: Array) -> float:
    """Returns aᵀb, with a from an index on, from four sums side by side: in one each addition awaits the one before."""
    p = q = r = s = 0.0
    whole = b.shape[0] // 4 * 4
    for n in range(0, whole, 4):
        p += a[start + n] * b[n]
        q += a[start + n + 1] * b[n + 1]
        r += a[start + n + 2] * b[n + 2]
        s += a[start + n + 3] * b[n + 3]
    for n in range(whole, b.shape[0]):
        p += a[start + n] * b[n]
    return (p + q) + (r + s)


@kernel
def network(inputs: Array, w: Array, hidden: Array, scale: Array, output: Array) -> None:
    """The network: output = scale · (g_h W₂ tanh(W₁ x + b₁) + g_b b₂ + W₃ x + W₄ h).

    Args:
        inputs: Scaled features x and heading h, `(10,)`.
        w: Flat weights, W₁ᵀ and then the layers at their `places`.
        hidden: Out: tanh(W₁ x + b₁), `(units,)`.
        scale: Output for a network output of one, V (rad/s on a steering channel), `(2,)`.
        output: Out: feedforward of the two channels in the same units, `(2,)`.
    """
    units, x = hidden.shape[0], inputs[:FEATURES]
    b1, W2, b2, W3, W4 = places(units)
    for j in range(units):
        z = w[b1 + j]
        for i in range(FEATURES):
            z += w[i * units + j] * x[i]
        hidden[j] = tanh(z)
    for k in range(CHANNELS):
        direct = inner(w, W3 + k * FEATURES, x)
        direct += w[W4 + 2 * k] * inputs[FEATURES] + w[W4 + 2 * k + 1] * inputs[FEATURES + 1]
        output[k] = scale[k] * (HIDDEN_GAIN * inner(w, W2 + k * units, hidden) + BIAS_GAIN * w[b2 + k] + direct)


@kernel
def backpropagate(inputs: Array, w: Array, hidden: Array, error: Array, gradient: Array) -> float:
    """Writes Jᵀe, with J = ∂(output/scale)/∂W of the network, in the order of the weights.

        Jᵀe = (δ xᵀ, δ, g_h e aᵀ, g_b e, e xᵀ, e hᵀ),    δ = g_h (1 − a²) ∘ W₂ᵀe,    a = tanh(W₁ x + b₁)

    Args:
        inputs: Scaled features x and heading h, `(10,)`.
        w: Flat weights, `(n,)`.
        hidden: Activations a at x, as from `network`, `(units,)`.
        error: e, `(2,)`.
        gradient: Out: Jᵀe, `(n,)`.

    Returns:
        ‖Jᵀe‖²; the squared norm of an outer product is the product of those of its factors.
    """
    units, x = hidden.shape[0], inputs[:FEATURES]
    b1, W2, b2, W3, W4 = places(units)
    for k in range(CHANNELS):
        gradient[b2 + k] = BIAS_GAIN * error[k]
        for i in range(FEATURES):
            gradient[W3 + k * FEATURES + i] = error[k] * x[i]
        for j in range(2):
            gradient[W4 + 2 * k + j] = error[k] * inputs[FEATURES + j]
        for j in range(units):
            gradient[W2 + k * units + j] = HIDDEN_GAIN * error[k] * hidden[j]
    for j in range(units):
        back = error[0] * w[W2 + j] + error[1] * w[W2 + units + j]
        gradient[b1 + j] = HIDDEN_GAIN * (1 - hidden[j] * hidden[j]) * back
    for i in range(FEATURES):
        for j in range(units):
            gradient[i * units + j] = gradient[b1 + j] * x[i]
    delta = gradient[b1 : b1 + units]
    outer = BIAS_GAIN * BIAS_GAIN + inner(inputs, 0, inputs) + HIDDEN_GAIN * HIDDEN_GAIN * inner(hidden, 0, hidden)
    return inner(error, 0, error) * outer + inner(delta, 0, delta) * (1 + inner(x, 0, x))


@kernel
def update(feedback: Array, s: Row, w: Array, initial: Array, hidden: Array, gradient: Array) -> None:
    """One normalised step of feedback-error learning, with leak, dead zone and projection.

        ΔW = μ Jᵀe / (‖Jᵀe‖²/‖e‖² + ε) − leak (W − W₀),    ‖W − W₀‖ ≤ bound

    e = share · feedback/scale, 0 in the dead zone, and J = ∂(output/scale)/∂W at the delayed features. With one output
    this is normalised LMS: the feedforward at that input moves by about μ times the feedback, whatever the size of the
    regressor.

    Args:
        feedback: Feedback of the two channels in V (rad/s on a steering channel), `(2,)`.
        s: In and out: a record of `FEL` with the inputs `x` of this tick, the network's `output` there, which is
            renewed, and the delayed inputs `past`.
        w: In and out: flat weights W, `(n,)`.
        initial: Initial weights W₀, `(n,)`.
        hidden: Scratch, `(units,)`.
        gradient: Scratch, `(n,)`.
    """
    power = 0.0
    for k in range(CHANNELS):
        s.error[k] = s.share[k] * feedback[k] / s.scale[k] if abs(feedback[k]) > s.dead_zone[k] else 0.0
        power += s.error[k] * s.error[k]
    if power == 0:
        return
    network(s.past, w, hidden, s.scale, s.output)
    square = backpropagate(s.past, w, hidden, s.error, gradient)
    rate, leak = s.step / (square / power + REGULARISATION), s.leak
    distance = gradient  # from here on W − W₀, in the same memory
    for n in range(w.shape[0]):
        w[n] += rate * gradient[n] - leak * (w[n] - initial[n])
        distance[n] = w[n] - initial[n]
    s.norm = np.sqrt(inner(distance, 0, distance))
    if s.norm > s.bound:
        for n in range(w.shape[0]):
            w[n] = initial[n] + (w[n] - initial[n]) * s.bound / s.norm
        s.norm = s.bound
    network(s.x, w, hidden, s.scale, s.output)


@kernel
def respond(i: int, command: Array, derivative: Array, robot: Row, arrays: tuple[Any, ...], voltage: Array) -> None:
    """U_ff of the network at the commanded motion, not at the measured one."""
    rows, scale, weights, _, hidden, _, _ = arrays
    s = rows[i]
    features(command, derivative, robot.half_track, scale, s.x)
    network(s.x, weights[i], hidden[i], s.scale, s.output)
    voltage[0], voltage[1] = s.output[0], s.output[1]


@kernel
def learn(i: int, shown: Shown, robot: Row, prior: Row, arrays: tuple[Any, ...], added: Array) -> float:
    """One step of `update`, unless the robot must not learn.

    `added` is by how much that changes the output in V (rad/s on a steering channel), `(2,)`, and the result ‖W − W₀‖.
    At the bound `added` is zero, so that the integral hands nothing over: there the projection undoes the step.
    """
    rows, _, weights, initial, hidden, gradient, queue = arrays
    s = rows[i]
    added[0] = added[1] = 0.0
    answered = recall(s.x, queue[i], s)
    if shown.frozen == 0 and s.step > 0 and answered:
        before, before_second = s.output[0], s.output[1]
        update(shown.feedback, s, weights[i], initial[i], hidden[i], gradient)
        if s.norm < s.bound:
            added[0], added[1] = s.output[0] - before, s.output[1] - before_second
    if s.heading_gain > 0:
        s.heading = dead_reckoned(s.heading, shown.twist[1], shown.period, s.x[FEATURES:])
        for j in range(FEATURES, INPUTS):
            s.x[j] *= s.heading_gain
    return s.norm


class Fel(Record):
    """Settings of the learner `fel`; one setting serves every robot, steering arrangement and perturbation."""

    hidden: Annotated[int, Field(ge=1, le=256)] = 24
    """Number of hidden tanh units."""
    step: Annotated[float, Field(ge=0, le=1)] = 0.01
    """Normalised step μ: share of the feedback voltage that the feedforward takes over in each control period; for
    `rigid` steering a tenth of this number. The default is what `mrctl tune --search` found in `lab`, with and without
    the model as prior."""
    dead_zone: Annotated[float, Field(ge=0, le=5)] = 0.03
    """Feedback in V below which nothing is learned; on a steering channel, a tenth of this number in rad/s."""
    leak: Annotated[float, Field(ge=0, le=0.1)] = 1e-6
    """Share of the distance to the initial weights that the weights go back with each step of learning."""
    weight_bound: Annotated[float, Field(gt=0, le=1e4)] = 30.0
    """Largest Euclidean distance of the weights from the initial ones, dimensionless; a projection keeps it."""
    output_scale: Annotated[float, Field(ge=1e-3, le=100)] = 6.0
    """Feedforward in V for a network output of one; on a steering channel, a tenth of this number in rad/s."""
    weights: str | None = None
    """File of initial weights, `.safetensors` or a torch state dict; by default the hidden layer is random, the rest
    zero."""
    frozen: bool = False
    """Whether the weights stay as they are, so that nothing is learned."""


FEL = np.dtype(
    [
        ("scale", "f8", CHANNELS),  # feedforward for a network output of one, V (rad/s on a steering channel)
        ("dead_zone", "f8", CHANNELS),  # feedback below which nothing is learned, V (rad/s)
        ("share", "f8", CHANNELS),  # factor on the step in the two channels; a steering channel learns more slowly
        ("step", "f8"),  # μ; 0 keeps the weights as they are
        ("leak", "f8"),  # share of W − W₀ that is subtracted with each step
        ("bound", "f8"),  # largest ‖W − W₀‖
        ("x", "f8", INPUTS),  # scaled features of the commanded motion, and h
        ("output", "f8", CHANNELS),  # feedforward at x, V (rad/s)
        ("tick", "i8"),  # number of ticks so far
        ("past", "f8", INPUTS),  # delayed inputs: those of the output that the feedback answers
        ("error", "f8", CHANNELS),  # e: feedback in units of the network's output
        ("norm", "f8"),  # ‖W − W₀‖
        ("heading", "f8"),  # θ by dead reckoning from the start, rad
        ("heading_gain", "f8"),  # g_θ; 0 without a model
    ],
    align=True,
)


def fresh(settings: list[Fel], rigid: bool, has_prior: bool = False) -> Rows:
    """Returns a record of `FEL` for each robot; `rigid` says whether channel two is steering."""
    rows = np.zeros(len(settings), FEL)
    second = STEERING_SCALE if rigid else 1.0
    rows["scale"] = [(s.output_scale, s.output_scale * second) for s in settings]
    rows["dead_zone"] = [(s.dead_zone, s.dead_zone * second) for s in settings]
    rows["share"] = 1.0, STEERING_SHARE if rigid else 1.0
    rows["step"] = [0.0 if s.frozen else s.step for s in settings]
    rows["heading_gain"] = rows["x"][:, FEATURES] = HEADING_GAIN if has_prior else 0.0
    rows["leak"], rows["bound"] = [0.0 if s.frozen else s.leak for s in settings], [s.weight_bound for s in settings]
    return rows


class FeedbackErrorLearning(Learner):
    """The learner `fel` for B robots.

    Attributes:
        weights: Flat weights W, in the order of the kernels, `(B, n)`.
        initial: Initial weights W₀, to which leak and projection refer, in the same order, `(B, n)`.
        weight_norm: ‖W − W₀‖, `(B,)`.
    """

    respond, learn_one, record = respond, learn, FEL

    def __init__(self, loop: Loop, settings: list[Fel]) -> None:
        """Takes the loop, and the settings of each robot, of which `hidden` must be the same for all.

        Raises:
            InputError: A weights file is missing, broken or of another shape.
        """
        super().__init__(loop, settings)
        given = [
            load_weights(s.weights, s.hidden) if s.weights else initial_weights(s.hidden, seed)
            for s, seed in zip(settings, loop.seeds, strict=True)
        ]
        self.initial = by_columns(np.array(given))
        self.weights = self.initial.copy()
        self.rows = fresh(settings, loop.rigid, loop.has_prior)
        hidden, gradient = np.zeros((len(settings), settings[0].hidden)), np.zeros(self.initial.shape[1])
        queue = histories(len(settings), loop.delay, INPUTS)
        self.arrays = self.rows, feature_scale(loop.robot), self.weights, self.initial, hidden, gradient, queue

    @classmethod
    def kept(cls, settings: Fel) -> dict[str, tuple[int, ...]]:
        """Returns names and shapes of the weights of one robot, in the order of files."""
        return shapes(settings.hidden)

    def adapted(self) -> Array:
        """The weights but for W₄, in the order of files, `(B, n − 4)`."""
        return by_rows(self.weights)

    def adopt(self, row: int, learned: Array) -> None:
        """Starts one robot from other weights, to which leak and projection then refer, and without W₄."""
        self.weights[row] = self.initial[row] = by_columns(learned)

    def restore(self, rows: NDArray[np.intp]) -> None:
        """Resets robots to their initial weights."""
        self.weights[rows] = self.initial[rows]
        self.rows["tick"][rows], self.rows["norm"][rows], self.weight_norm[rows] = 0, 0.0, 0.0
