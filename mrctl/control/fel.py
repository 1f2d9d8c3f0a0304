"""Feedback-error learning of the inverse dynamics with a small network: the paper's feedforward.

Kawato, Furukawa and Suzuki (1987), Gomi and Kawato (1993): Ẇ = γ (∂U_ff/∂W)ᵀ U_fb. The feedback voltage is the teaching
signal, so the network takes over exactly the work that the feedback still does. `fel_torch` is the general form for
any stateless torch module.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numba import float64, guvectorize, njit
from numpy.typing import NDArray
from pydantic import Field

from mrctl.control.chain import ANY, EACH, GIVEN, OWN, one, rows, stamp
from mrctl.control.feedforward import STEERING_SHARE, Array, feature_scale, features
from mrctl.record import InputError, Record
from mrctl.theory.robot import Robot

INPUTS, OUTPUTS = 8, 2
# Gains of hidden units and bias beside the direct links. A normalised step is shared out by squared regressor, so these
# give most of it to the eight features. With gains of one, two dozen nearly constant units act as an integrator: slow
# to learn what changes during a lap, quick to oscillate.
HIDDEN_GAIN, BIAS_GAIN = 0.15, 0.1
REGULARISATION = 1e-3  # keeps the normalised step finite at rest, where the regressor vanishes
STEERING_SCALE = 0.1  # rad/s that a steering channel corrects, per volt of the other arrangements


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

    def targets(self, rigid: bool) -> Array:
        """Output scale, dead zone and share of the step for the two channels, `(3, 2)`."""
        second = (self.output_scale * STEERING_SCALE, self.dead_zone * STEERING_SCALE, STEERING_SHARE)
        first = (self.output_scale, self.dead_zone, 1.0)
        return np.array([first, second if rigid else first]).T

    def steps(self) -> Array:
        """Step, leak and weight bound, `(3,)`; zeros keep the weights as they are."""
        return np.array([0.0 if self.frozen else self.step, 0.0 if self.frozen else self.leak, self.weight_bound])


def shapes(hidden: int) -> dict[str, tuple[int, ...]]:
    """Names and shapes of the weights, in the order of the flat vector; they are those of `fel_torch.Network`."""
    return {
        "hidden.weight": (hidden, INPUTS),
        "hidden.bias": (hidden,),
        "output.weight": (OUTPUTS, hidden),
        "output.bias": (OUTPUTS,),
        "direct.weight": (OUTPUTS, INPUTS),
    }


def initial_weights(hidden: int, seed: int) -> Array:
    """Random hidden layer, everything behind it zero: learning begins as pure PID.

    Returns:
        Flat weights, `(11 hidden + 18,)`.
    """
    rng = np.random.default_rng([seed, 1])
    layers = {name: np.zeros(shape) for name, shape in shapes(hidden).items()}
    for name in ("hidden.weight", "hidden.bias"):
        layers[name] = rng.normal(0.0, 0.5, layers[name].shape)
    return flatten(layers)


def flatten(layers: dict[str, Array]) -> Array:
    """Named weights to the flat vector of the compiled network."""
    hidden = len(layers["hidden.bias"])
    return np.concatenate([np.ravel(layers[name]) for name in shapes(hidden)])


def unflatten(weights: Array) -> dict[str, Array]:
    """The flat vector to named weights."""
    hidden = (len(weights) - OUTPUTS * (INPUTS + 1)) // (INPUTS + 1 + OUTPUTS)
    layers, start = {}, 0
    for name, shape in shapes(hidden).items():
        stop = start + int(np.prod(shape))
        layers[name], start = weights[start:stop].reshape(shape), stop
    return layers


def save_weights(path: str | Path, weights: Array) -> None:
    """Writes flat weights `(n,)` as a safetensors file.

    Raises:
        InputError: The file cannot be written.
    """
    from safetensors.numpy import save

    data = save({name: np.ascontiguousarray(layer) for name, layer in unflatten(weights).items()})
    try:
        Path(path).write_bytes(data)
    except OSError as error:
        raise InputError(f"{path}: cannot write weights: {error.strerror}") from None


def load_weights(path: str | Path, hidden: int) -> Array:
    """Reads weights from a safetensors file or a torch state dict.

    Args:
        path: `.safetensors`, else a file of `torch.save(module.state_dict())`, read with `weights_only`.
        hidden: Hidden units that the file must hold.

    Raises:
        InputError: The file is missing, broken, of another shape, or holds non-finite numbers.
    """
    if not Path(path).is_file():
        raise InputError(f"fel.weights: no file {path}")
    try:
        if Path(path).suffix == ".safetensors":
            from safetensors.numpy import load_file

            layers = load_file(path)
        else:
            import torch

            layers = {k: v.double().numpy() for k, v in torch.load(path, map_location="cpu", weights_only=True).items()}
    except Exception as error:  # each format has its own errors; none of them is ours to tell apart
        reason = str(error).partition("\n")[0] or type(error).__name__
        raise InputError(f"fel.weights: {path}: not a weights file: {reason}") from None
    expected = shapes(hidden)
    for name, shape in expected.items():
        if name not in layers or layers[name].shape != shape:
            found = layers[name].shape if name in layers else "nothing"
            raise InputError(f"fel.weights: {path}: {name} is {found}, {hidden} hidden units need {shape}")
    if unknown := set(layers) - set(expected):
        raise InputError(f"fel.weights: {path}: unknown entry {min(unknown)!r}")
    weights = flatten(layers).astype(float)
    if not np.isfinite(weights).all():
        raise InputError(f"fel.weights: {path}: non-finite weights")
    return weights


@njit
def _sizes(weights, x, m):  # noqa: ANN001, ANN202
    """Hidden units, and where b₁, W₂, b₂ and W₃ begin in the flat weights."""
    n = x.shape[0]
    h = (weights.shape[0] - m * (n + 1)) // (n + 1 + m)
    return h, h * n, h * (n + 1), h * (n + 1 + m), h * (n + 1 + m) + m


@njit
def _activate(x, weights, m, hidden):  # noqa: ANN001, ANN202
    """tanh(W₁ x + b₁)."""
    h, b1, _, _, _ = _sizes(weights, x, m)
    for j in range(h):
        z = weights[b1 + j]
        for i in range(x.shape[0]):
            z += weights[j * x.shape[0] + i] * x[i]
        hidden[j] = z
    for j in range(h):
        hidden[j] = 1 - 2 / (np.exp(2 * hidden[j]) + 1)  # tanh, in half the time of the library's


@njit
def _square(vector):  # noqa: ANN001, ANN202
    """Squared length; four sums side by side, since each addition waits for the one before."""
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


@njit
def _network(x, hidden, weights, targets, out):  # noqa: ANN001, ANN202
    n, m = x.shape[0], targets.shape[1]
    h, _, w2, b2, w3 = _sizes(weights, x, m)
    for k in range(m):
        out[k] = BIAS_GAIN * weights[b2 + k]
        for i in range(n):
            out[k] += weights[w3 + k * n + i] * x[i]
    for j in range(h):
        z = HIDDEN_GAIN * hidden[j]
        for k in range(m):
            out[k] += weights[w2 + k * h + j] * z
    for k in range(m):
        out[k] *= targets[0, k]


@guvectorize([(float64[:], float64[:], float64[:, :], float64[:])], "(f),(w),(t,u)->(u)", cache=True)
def network(x, weights, targets, out):  # noqa: ANN001, ANN201
    """Scale · (g_h W₂ tanh(W₁ x + b₁) + g_b b₂ + W₃ x) for one robot.

    Args:
        x: Scaled features `(8,)`.
        weights: Flat weights, in the order of `shapes`.
        targets: As from `Fel.targets`; the first row is the scale.
        out: Out: feedforward of the two channels, `(2,)`.
    """
    hidden = np.empty(weights.shape[0])
    _activate(x, weights, targets.shape[1], hidden)
    _network(x, hidden, weights, targets, out)


@njit
def _update(  # noqa: ANN202
    x, hidden, feedback, saturated, targets, steps, prior, error, gradient, weights, norm, output  # noqa: ANN001
):  # fmt: skip
    step, leak, bound = steps[0], steps[1], steps[2]
    if saturated > 0 or step == 0:
        return
    n, m = x.shape[0], targets.shape[1]
    power = 0.0
    for k in range(m):
        error[k] = targets[2, k] * feedback[k] / targets[0, k] if abs(feedback[k]) > targets[1, k] else 0.0
        power += error[k] * error[k]
    if power == 0:
        return
    h, b1, w2, b2, w3 = _sizes(weights, x, m)
    for k in range(m):
        gradient[b2 + k] = BIAS_GAIN * error[k]
        for i in range(n):
            gradient[w3 + k * n + i] = error[k] * x[i]
    for j in range(h):
        z = hidden[j]
        back = 0.0
        for k in range(m):
            gradient[w2 + k * h + j] = HIDDEN_GAIN * error[k] * z
            back += error[k] * weights[w2 + k * h + j]
        back *= HIDDEN_GAIN * (1 - z * z)
        gradient[b1 + j] = back
        for i in range(n):
            gradient[j * n + i] = back * x[i]
    rate = step / (_square(gradient) / power + REGULARISATION)
    for w in range(weights.shape[0]):
        weights[w] += rate * gradient[w] - leak * (weights[w] - prior[w])
        gradient[w] = weights[w] - prior[w]  # from here on the way from the prior
    distance = np.sqrt(_square(gradient))
    if distance > bound:
        for w in range(weights.shape[0]):
            weights[w] = prior[w] + (weights[w] - prior[w]) * bound / distance
    norm[0] = min(distance, bound)
    _activate(x, weights, m, hidden)
    _network(x, hidden, weights, targets, output)


@guvectorize(
    [(float64[:], float64[:], float64, float64[:, :], float64[:], float64[:], float64[:], float64[:], float64[:])],
    "(f),(u),(),(t,u),(s),(w),(w),(),(u)",
    writable_args=("weights", "norm", "output"),
    cache=True,
)
def update(x, feedback, saturated, targets, steps, prior, weights, norm, output):  # noqa: ANN001, ANN201
    """One normalised step of feedback-error learning for one robot, with its safeguards.

    ΔW = μ Jᵀe / (‖Jᵀe‖²/‖e‖² + ε), e the scaled feedback and J = ∂f/∂W: with one output this is normalised LMS, and the
    feedforward at this input moves by about μ times the feedback whatever the size of the regressor.

    Args:
        x: Scaled features that the last output was computed from, `(8,)`.
        feedback: Feedback of the two channels `(2,)`.
        saturated: 1 freezes: the voltage that was asked for is not the one that acted.
        targets: As from `Fel.targets`, `(3, 2)`.
        steps: As from `Fel.steps`, `(3,)`.
        prior: Weights that the leak and the projection refer to.
        weights: In and out.
        norm: Out: Euclidean distance of the weights from the prior.
        output: In and out: feedforward at these features, `(2,)`.
    """
    m, size = targets.shape[1], weights.shape[0]
    hidden = np.empty(size)
    _activate(x, weights, m, hidden)
    error, gradient = np.empty(m), np.empty(size)
    _update(x, hidden, feedback, saturated, targets, steps, prior, error, gradient, weights, norm, output)


_features = one(features)

# What is kept of one robot beside its weights; shapes as in `update`.
STATE = np.dtype(
    [("targets", "f8", (3, OUTPUTS)), ("steps", "f8", 3), ("features", "f8", INPUTS), ("output", "f8", OUTPUTS),
     ("added", "f8", OUTPUTS), ("norm", "f8", (1,))],
    align=True,
)  # fmt: skip


def _compile(version: int) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """Output and learning step for all robots, sharing the hidden layer; see `chain.stamp` for the version."""

    @njit((GIVEN, GIVEN, float64, EACH, rows(STATE), OWN, OWN), cache=True)
    def respond(command, derivative, half_track, scale, state, weights, hidden):  # noqa: ANN001, ANN202
        _ = version
        for i in range(len(state)):
            s = state[i]
            _features(command[i], derivative[i], half_track, scale, s.features)
            _activate(s.features, weights[i], OUTPUTS, hidden[i])
            _network(s.features, hidden[i], weights[i], s.targets, s.output)

    @njit((GIVEN, ANY, rows(STATE), *[OWN] * 3), cache=True)
    def teach(feedback, saturated, state, prior, weights, hidden):  # noqa: ANN001, ANN202
        error, gradient = np.empty(OUTPUTS), np.empty(weights.shape[1])
        for i in range(len(state)):
            s = state[i]
            for k in range(OUTPUTS):
                s.added[k] = s.output[k]
            _update(
                s.features, hidden[i], feedback[i], saturated[i], s.targets, s.steps, prior[i], error, gradient,
                weights[i], s.norm, s.output,
            )  # fmt: skip
            held = s.norm[0] >= s.steps[2]  # at the bound: what is gained here is lost elsewhere
            for k in range(OUTPUTS):
                s.added[k] = 0.0 if held else s.output[k] - s.added[k]

    return respond, teach


_respond, _teach = _compile(stamp(features))


class FeedbackErrorLearning:
    """`fel` for B robots.

    Attributes:
        state: `weights` `(B, n)`, flat.
        prior: What leak and projection refer to, `(B, n)`.
        weight_norm: Euclidean distance between the two, `(B,)`.
        weight_volts: Output scale, `(B,)`.
    """

    def __init__(self, robot: Robot, settings: list[Fel], seeds: list[int], rigid: bool) -> None:
        """Takes the nominal robot (for scales alone), settings and seed a row, and whether channel two is steering.

        Raises:
            InputError: A weights file is missing, broken or of another shape.
        """
        self._half_track = robot.half_track
        self._scale = feature_scale(robot)
        self._rows = np.zeros(len(settings), STATE)
        self._rows["targets"] = [s.targets(rigid) for s in settings]
        self._rows["steps"] = [s.steps() for s in settings]
        self._hidden = np.zeros((len(settings), settings[0].hidden))
        self._output, self._added = self._rows["output"], self._rows["added"]
        self.prior = np.array(
            [
                load_weights(s.weights, s.hidden) if s.weights else initial_weights(s.hidden, seed)
                for s, seed in zip(settings, seeds, strict=True)
            ]
        )
        self.state = {"weights": self.prior.copy()}
        self.weight_norm = self._rows["norm"][:, 0]
        self.weight_volts = np.array([s.output_scale for s in settings])

    def restore(self, rows: NDArray[np.intp]) -> None:
        """Takes robots back to their prior weights."""
        self.state["weights"][rows] = self.prior[rows]
        self.weight_norm[rows] = 0.0

    def output(self, command: Array, derivative: Array) -> Array:
        """The network at the commanded motion; never at the measured one."""
        _respond(
            command, derivative, self._half_track, self._scale, self._rows, self.state["weights"], self._hidden
        )  # fmt: skip
        return self._output

    def learn(self, feedback: Array, saturated: Array, twist: Array, voltage: Array) -> Array:
        """One step on the features of the last output.

        Returns:
            What it added to that output; nothing at the bound of the weights, where the PID must keep what it holds.
        """
        _teach(feedback, saturated, self._rows, self.prior, self.state["weights"], self._hidden)
        return self._added
