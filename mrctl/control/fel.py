"""Feedback-error learning of the inverse dynamics with a small network: the paper's feedforward.

Kawato, Furukawa and Suzuki (1987), Gomi and Kawato (1993): Ẇ = γ (∂U_ff/∂W)ᵀ U_fb. The feedback voltage is the teaching
signal, so the network takes over exactly the work that the feedback still does. `fel_torch` is the general form for
any stateless torch module.
"""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from mrctl.control.features import INPUTS, OUTPUTS, feature_scale, features
from mrctl.control.feedforward import STEERING_SCALE, STEERING_SHARE, CompiledFeedforward
from mrctl.control.weights import initial_weights, load_weights
from mrctl.kernel import Array, Row, Rows, kernel
from mrctl.record import Record
from mrctl.theory.robot import Robot

# Gains of hidden units and bias beside the direct links. A normalised step is shared out by squared regressor, so these
# give most of it to the eight features. With gains of one, two dozen nearly constant units act as an integrator: slow
# to learn what changes during a lap, quick to oscillate.
HIDDEN_GAIN, BIAS_GAIN = 0.15, 0.1
REGULARISATION = 1e-3  # ε: keeps the normalised step finite at rest, where the regressor vanishes


class Fel(Record):
    """Settings of the `fel` feedforward; one setting serves every robot, steering arrangement and perturbation."""

    hidden: Annotated[int, Field(ge=1, le=256)] = 24
    """Hidden tanh units."""
    step: Annotated[float, Field(ge=0, le=1)] = 0.1
    """Normalised step μ: the share of the feedback voltage that one control period moves into the feedforward."""
    dead_zone: Annotated[float, Field(ge=0, le=5)] = 0.03
    """Feedback below this teaches nothing, V (a tenth of it in rad/s on a steering channel)."""
    leak: Annotated[float, Field(ge=0, le=0.1)] = 1e-6
    """Share of the distance to the prior weights that is given back each control period."""
    weight_bound: Annotated[float, Field(gt=0, le=1e4)] = 30.0
    """Largest Euclidean distance of the weights from the prior; beyond it they are projected back."""
    output_scale: Annotated[float, Field(gt=0, le=100)] = 6.0
    """Volts for a network output of one (a tenth of it in rad/s on a steering channel)."""
    weights: str | None = None
    """File to start from, `.safetensors` or a torch state dict; by default random hidden and zero output layers."""
    frozen: bool = False
    """Use the weights, do not change them."""


FEL = np.dtype(
    [
        ("scale", "f8", OUTPUTS),  # output for a network output of one, V (rad/s on a steering channel)
        ("dead_zone", "f8", OUTPUTS),  # feedback below this teaches nothing, V (rad/s)
        ("share", "f8", OUTPUTS),  # of the step in the two channels
        ("step", "f8"),  # μ; 0 keeps the weights as they are
        ("leak", "f8"),  # share of the distance to the prior that is given back each period
        ("bound", "f8"),  # largest distance from the prior
        ("x", "f8", INPUTS),  # scaled features of the commanded motion
        ("output", "f8", OUTPUTS),  # feedforward at x, V (rad/s)
        ("error", "f8", OUTPUTS),  # e: feedback in units of the network's output
        ("norm", "f8"),  # distance of the weights from the prior
    ],
    align=True,
)


def fresh(settings: list[Fel], rigid: bool) -> Rows:
    """Records of `FEL` at the start of a run, a robot each; `rigid` says whether channel two is steering."""
    rows = np.zeros(len(settings), FEL)
    second = STEERING_SCALE if rigid else 1.0
    rows["scale"] = [(s.output_scale, s.output_scale * second) for s in settings]
    rows["dead_zone"] = [(s.dead_zone, s.dead_zone * second) for s in settings]
    rows["share"] = 1.0, STEERING_SHARE if rigid else 1.0
    rows["step"] = [0.0 if s.frozen else s.step for s in settings]
    rows["leak"], rows["bound"] = [0.0 if s.frozen else s.leak for s in settings], [s.weight_bound for s in settings]
    return rows


@kernel
def layers(w: Array, units: int) -> tuple[Array, Array, Array, Array, Array]:
    """W₁ `(units, 8)`, b₁ `(units,)`, W₂ `(2, units)`, b₂ `(2,)` and W₃ `(2, 8)` as views of the flat weights."""
    a = units * INPUTS
    b = a + units
    c = b + OUTPUTS * units
    d = c + OUTPUTS
    return w[:a].reshape((units, INPUTS)), w[a:b], w[b:c].reshape((OUTPUTS, units)), w[c:d], w[d:].reshape((2, INPUTS))


@kernel
def network(x: Array, w: Array, hidden: Array, scale: Array, output: Array) -> None:
    """The network: output = scale · (g_h W₂ tanh(W₁ x + b₁) + g_b b₂ + W₃ x).

    Args:
        x: Scaled features `(8,)`.
        w: Flat weights, in the order of `layers`.
        hidden: Out: tanh(W₁ x + b₁), `(units,)`.
        scale: `(2,)`.
        output: Out: feedforward of the two channels, `(2,)`.
    """
    units = hidden.shape[0]
    W1, b1, W2, b2, W3 = layers(w, units)
    for j in range(units):
        z = b1[j]
        for i in range(INPUTS):
            z += W1[j, i] * x[i]
        hidden[j] = z
    for j in range(units):
        hidden[j] = 1 - 2 / (np.exp(2 * hidden[j]) + 1)  # tanh, in half the time of the library's
    for k in range(OUTPUTS):
        y = BIAS_GAIN * b2[k]
        for i in range(INPUTS):
            y += W3[k, i] * x[i]
        for j in range(units):
            y += W2[k, j] * (HIDDEN_GAIN * hidden[j])
        output[k] = scale[k] * y


@kernel
def backpropagate(x: Array, w: Array, hidden: Array, error: Array, gradient: Array) -> None:
    """Jᵀe: the gradient of the network's output times e with respect to the weights, in their order.

    Args:
        x: Scaled features `(8,)`.
        w: Flat weights.
        hidden: As from `network`, `(units,)`.
        error: e, `(2,)`.
        gradient: Out, as long as the weights.
    """
    units = hidden.shape[0]
    _, _, W2, _, _ = layers(w, units)
    G1, g1, G2, g2, G3 = layers(gradient, units)
    for k in range(OUTPUTS):
        g2[k] = BIAS_GAIN * error[k]
        for i in range(INPUTS):
            G3[k, i] = error[k] * x[i]
    for j in range(units):
        back = 0.0
        for k in range(OUTPUTS):
            G2[k, j] = HIDDEN_GAIN * error[k] * hidden[j]
            back += error[k] * W2[k, j]
        back *= HIDDEN_GAIN * (1 - hidden[j] * hidden[j])
        g1[j] = back
        for i in range(INPUTS):
            G1[j, i] = back * x[i]


@kernel
def squared_norm(vector: Array) -> float:
    """‖v‖²; four sums side by side, since each addition waits for the one before."""
    a = b = c = d = 0.0
    whole = vector.shape[0] // 4 * 4
    for w in range(0, whole, 4):
        a += vector[w] * vector[w]
        b += vector[w + 1] * vector[w + 1]
        c += vector[w + 2] * vector[w + 2]
        d += vector[w + 3] * vector[w + 3]
    for w in range(whole, vector.shape[0]):
        a += vector[w] * vector[w]
    return (a + b) + (c + d)


@kernel
def update(feedback: Array, s: Row, w: Array, prior: Array, hidden: Array, gradient: Array) -> None:
    """One normalised step of feedback-error learning, with its safeguards.

        ΔW = μ Jᵀe / (‖Jᵀe‖²/‖e‖² + ε) − leak (W − W₀),    ‖W − W₀‖ ≤ bound

    e is the scaled feedback and J = ∂f/∂W: with one output this is normalised LMS, and the feedforward at this input
    moves by about μ times the feedback whatever the size of the regressor.

    Args:
        feedback: Feedback of the two channels in V (rad/s on a steering channel), `(2,)`.
        s: In and out: a record of `FEL`, whose `x` and `output` are those of the last output.
        w: In and out: flat weights W.
        prior: W₀, as long.
        hidden: In and out: activations at `x`, `(units,)`.
        gradient: Scratch, as long as the weights.
    """
    power = 0.0
    for k in range(OUTPUTS):
        s.error[k] = s.share[k] * feedback[k] / s.scale[k] if abs(feedback[k]) > s.dead_zone[k] else 0.0
        power += s.error[k] * s.error[k]
    if power == 0:
        return
    backpropagate(s.x, w, hidden, s.error, gradient)
    rate = s.step / (squared_norm(gradient) / power + REGULARISATION)
    distance = gradient  # from here on W − W₀, in the same memory
    for n in range(w.shape[0]):
        w[n] += rate * gradient[n] - s.leak * (w[n] - prior[n])
        distance[n] = w[n] - prior[n]
    s.norm = np.sqrt(squared_norm(distance))
    if s.norm > s.bound:
        for n in range(w.shape[0]):
            w[n] = prior[n] + (w[n] - prior[n]) * s.bound / s.norm
        s.norm = s.bound
    network(s.x, w, hidden, s.scale, s.output)


@kernel
def respond(i: int, command: Array, derivative: Array, robot: Row, arrays: tuple[Any, ...], voltage: Array) -> None:
    """The network at the commanded motion; never at the measured one."""
    rows, scale, weights, _, hidden, _ = arrays
    s = rows[i]
    features(command, derivative, robot.half_track, scale, s.x)
    network(s.x, weights[i], hidden[i], s.scale, s.output)
    voltage[0], voltage[1] = s.output[0], s.output[1]


@kernel
def learn(
    i: int, command: Array, feedback: Array, frozen: float, twist: Array, voltage: Array, period: float, robot: Row,
    arrays: tuple[Any, ...], added: Array,
) -> float:  # fmt: skip
    """One step on the features of the last output, unless the robot must not learn.

    At the bound of the weights it adds nothing that the PID may hand over: what is gained here is lost elsewhere.
    """
    rows, _, weights, prior, hidden, gradient = arrays
    s = rows[i]
    added[0] = added[1] = 0.0
    if frozen == 0 and s.step > 0:
        before, before_second = s.output[0], s.output[1]
        update(feedback, s, weights[i], prior[i], hidden[i], gradient)
        if s.norm < s.bound:
            added[0], added[1] = s.output[0] - before, s.output[1] - before_second
    return s.norm


class FeedbackErrorLearning(CompiledFeedforward):
    """`fel` for B robots.

    Attributes:
        weights: `(B, n)`, flat.
        prior: What leak and projection refer to, `(B, n)`.
        weight_norm: Euclidean distance between the two, `(B,)`.
        weight_volts: Output scale, `(B,)`.
    """

    respond, learn_one = respond, learn

    def __init__(self, robot: Robot, settings: list[Fel], seeds: list[int], rigid: bool, period: float) -> None:
        """Builds the networks.

        Args:
            robot: Nominal robot, for the scales alone.
            settings: Settings of each robot; `hidden` must be the same for all.
            seeds: Seed of the initial weights of each robot.
            rigid: Whether channel two is steering.
            period: Control period in s.

        Raises:
            InputError: A weights file is missing, broken or of another shape.
        """
        super().__init__(robot, len(settings), rigid, period)
        self.prior = np.array(
            [
                load_weights(s.weights, s.hidden) if s.weights else initial_weights(s.hidden, seed)
                for s, seed in zip(settings, seeds, strict=True)
            ]
        )
        self.weights = self.prior.copy()
        self.weight_volts = np.array([s.output_scale for s in settings])
        self.rows = fresh(settings, rigid)
        hidden = np.zeros((len(settings), settings[0].hidden))
        self.arrays = self.rows, feature_scale(robot), self.weights, self.prior, hidden, np.zeros(self.prior.shape[1])

    def restore(self, rows: NDArray[np.intp]) -> None:
        """Takes robots back to their prior weights."""
        self.weights[rows] = self.prior[rows]
        self.rows["norm"][rows] = self.weight_norm[rows] = 0.0
