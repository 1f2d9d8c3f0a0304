"""Composite adaptation: the model, and features whose weights follow prediction and tracking errors at once.

Slotine and Li (1989) combine the two errors; Neural-Fly (O'Connell et al. 2022) and MAGIC-VFM (Lupu et al. 2024) adapt
with them the last layer alone of a network that was trained off-line on many plants. Here

    U = model(x) + φ(x) a + d,      φ = 8 physical features, gravity on a slope, 16 tanh units,      a(0) = 0, d(0) = 0

and a and the disturbance d are what a Kalman filter makes of the voltage that acted, at the motion that came of it:

    U_f − model(x_f) = φ(x_f) a + d + noise,      x_f = (V_f, V̇_f)

Voltage and motion pass the same two first-order filters, and V̇_f is the difference of what enters and leaves the second
over its time constant: nothing is differentiated. With one filter V̇_f would carry the noise of V unfiltered, and noise
on a regressor biases its weight toward zero.

The weights are taken to wander as an Ornstein-Uhlenbeck process whose stationary covariance P₀ is how they scatter over
the plants of the training: it tells the filter what plants differ in, and P returns to P₀, no further, where nothing is
excited. d does the same, fast: what is no function of the motion, such as a push, goes there. How noisily the motion is
measured shows in its second differences, which mass keeps small; the noisier, the less a sample counts. The heading
that slope features need is dead reckoning; from where it counts does not matter. The tracking term moves a along P φ(x)
by a share of the feedback voltage, like `rls`.

When the innovations of one channel grow at once, the plant has changed. What was known of it is kept, and P of both
channels begins again. Two such plants are remembered, and predict along (multiple models, Narendra and Balakrishnan,
1997): when one of them predicts again within seconds, for it is back or has never gone, all that was known of it is
taken up. With a noisy measurement none is told from the noise, and the plant is learned anew.

Under `rigid` steering the second channel is treated alike: what is asked of the steering stands for the voltage, its
nominal inverse is the rotation itself, and U is what has to be added to the command.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from numba import float64, guvectorize, njit
from numpy.typing import NDArray
from pydantic import Field

from mrctl.control.chain import ANY, EACH, GIVEN, OWN, one, rows, stamp
from mrctl.control.feedforward import STEERING_SHARE, Array, feature_scale, features
from mrctl.record import InputError, Record
from mrctl.theory.dynamics import inverse_coefficients
from mrctl.theory.robot import Robot

INPUTS, UNITS, CHANNELS = 8, 16, 2
PHYSICAL = INPUTS + 2  # and gravity on a slope
FEATURES = PHYSICAL + UNITS
STEERING_SCALE = 0.1  # rad/s that count on a steering channel as one volt does on the others
STEERING_DISTURBANCE = 0.03  # rad/s of disturbance per volt: less, since the geometry holds without a motor
OUTLIER = 3.0  # standard deviations beyond which a sample pulls no harder: a tyre slips, a wheel lost its load
SLOW = 0.1  # m/s of the faster wheel; below it stiction, not the motion, decides about the voltage
BRIEF, LASTING = 0.25, 4.0  # s over which innovations are averaged, to see a change of the plant
CHANGE = 5.0  # times the lasting mean square of the innovations that the brief one of a changed plant exceeds
NOTHING = 1e-9  # V² or (rad/s)²: features that vary less are none that a feedback could be put down to
# V of noise that a sample is taken to have per m/s by which the measured wheel speed scatters; tuned with sensor noise
# of 10 mm/s and 20 mrad/s behind filters of 0.03 s, at 10 ms.
SCATTER = 300.0
SETTLED = 6.0  # time constants until two filters have forgotten how they began
LEARNED = 12.0  # s of learning that make what is known of a plant worth keeping, and for which a former one is sought
LOOK = 2.0  # s over which what former plants mispredict is averaged, and for which they are watched at least
BACK = 0.2  # variances of `noise`, of both channels together, below whose mean square a former plant is back
SHIPPED = Path(__file__).with_suffix(".safetensors")


class Composite(Record):
    """Settings of the `composite` feedforward; one setting serves every robot, steering and perturbation."""

    noise: Annotated[float, Field(gt=0, le=100)] = 0.2
    """Standard deviation of one sample of the regression, V (a tenth of it in rad/s on a steering channel), where the
    motion is measured without noise; what noise the measured motion shows is added."""
    memory: Annotated[float, Field(ge=1, le=1e6)] = 1000.0
    """Time in which the weights are taken to wander by as much as plants differ, s."""
    disturbance: Annotated[float, Field(ge=0, le=100)] = 0.15
    """Standard deviation of the disturbance, V (as for `noise`)."""
    disturbance_memory: Annotated[float, Field(ge=0.01, le=1e6)] = 0.15
    """Time in which the disturbance wanders by that, s."""
    filter: Annotated[float, Field(ge=0.01, le=2)] = 0.03
    """Time constant of each of the two filters on voltage and motion, s."""
    step: Annotated[float, Field(ge=0, le=1)] = 0.025
    """Share of the feedback that the tracking term moves into the feedforward each control period, as for `rls`."""
    dead_zone: Annotated[float, Field(ge=0, le=5)] = 0.02
    """Feedback below this moves nothing, V (as for `noise`)."""
    weights: str | None = None
    """File of `mrctl train`; by default the one that ships with the package."""


class Training(NamedTuple):
    """What `mrctl train` found.

    Attributes:
        units: Weights and, last, bias of the tanh units on the scaled features, `(16, 9)`.
        priors: Covariance P₀ of the weights of φ, in V² for the common and the differential channel and in (rad/s)² for
            a steering channel, `(3, 26, 26)`.
    """

    units: Array
    priors: Array


def save_training(path: str | Path, training: Training, recipe: dict[str, str]) -> None:
    """Writes a training as a safetensors file with its recipe as metadata.

    Raises:
        InputError: The file cannot be written.
    """
    from safetensors.numpy import save

    data = save({k: np.ascontiguousarray(v) for k, v in training._asdict().items()}, metadata=recipe)
    try:
        Path(path).write_bytes(data)
    except OSError as error:
        raise InputError(f"{path}: cannot write weights: {error.strerror}") from None


def load_training(path: str | Path = SHIPPED) -> Training:
    """Reads a file of `mrctl train`.

    Raises:
        InputError: The file is missing, broken, of another shape, or holds non-finite numbers.
    """
    from safetensors.numpy import load_file

    shapes = {"units": (UNITS, INPUTS + 1), "priors": (3, FEATURES, FEATURES)}
    if not Path(path).is_file():
        raise InputError(f"composite.weights: no file {path}")
    try:
        found = load_file(path)
    except Exception as error:  # the format's own errors are not ours to tell apart
        reason = str(error).partition("\n")[0] or type(error).__name__
        raise InputError(f"composite.weights: {path}: not a weights file: {reason}") from None
    if {name: array.shape for name, array in found.items()} != shapes:
        raise InputError(f"composite.weights: {path}: needs {', '.join(f'{k} {v}' for k, v in shapes.items())}")
    if not all(np.isfinite(array).all() for array in found.values()):
        raise InputError(f"composite.weights: {path}: non-finite weights")
    return Training(**{name: array.astype(float) for name, array in found.items()})


@guvectorize([(float64[:], float64[:, :], float64[:])], "(f),(w,i),(n)", writable_args=("phi",), cache=True)
def basis(x, units, phi):  # noqa: ANN001, ANN201
    """φ for one robot: the physical features, and tanh(W x + b) of the first 8.

    Args:
        x: Scaled features and the cosine and sine of the heading, `(10,)`.
        units: W and b side by side, `(16, 9)`.
        phi: Out, `(26,)`.
    """
    n, m = x.shape[0], units.shape[1] - 1
    for i in range(n):
        phi[i] = x[i]
    for j in range(units.shape[0]):
        z = units[j, m]
        for i in range(m):
            z += units[j, i] * x[i]
        phi[n + j] = z
    for j in range(n, phi.shape[0]):
        phi[j] = 1 - 2 / (np.exp(2 * phi[j]) + 1)  # tanh, in half the time of the library's


@njit
def _times(covariance, vector, out):  # noqa: ANN001, ANN202
    """P x, row by row: P is symmetric, and sums side by side are vector instructions."""
    n = vector.shape[0]
    for i in range(n):
        out[i] = 0.0
    for j in range(n):
        for i in range(n):
            out[i] += covariance[j, i] * vector[j]


@njit
def _give_up(prior, disturbance, weights, covariance):  # noqa: ANN001, ANN202
    """Takes certainty away after a change of the plant: P ← P₀ + a aᵀ; the weights stay.

    Covariance resetting (Goodwin and Sin, 1984). The second term is what would be if the plant changed back.
    """
    n = prior.shape[0]
    for i in range(n):
        covariance[i, n] = covariance[n, i] = 0.0
        for j in range(n):
            covariance[i, j] = prior[i, j] + weights[i] * weights[j]
    covariance[n, n] = disturbance * disturbance


VECTOR, MATRIX = float64[:], float64[:, :]


@guvectorize(
    [(VECTOR, float64, VECTOR, float64, float64, VECTOR, MATRIX, VECTOR, VECTOR, MATRIX)],
    "(n),(),(n),(),(),(s),(n,n),(k),(m),(m,m)",
    writable_args=("usual", "weights", "covariance"),
    cache=True,
)
def adapt(  # noqa: ANN201
    measured, residual, commanded, feedback, noise, settings, prior, usual, weights, covariance  # noqa: ANN001
):  # fmt: skip
    """One composite step for one channel of one robot.

    Prediction: the Kalman filter for residual = φ a + d. Its innovation counts for no more than 3 standard deviations
    (Huber). Between samples a ← f a, P ← f² P + (1 − f²) P₀, likewise for d.
    Tracking: a ← a + P φ_c e · step/(φ_cᵀ P φ_c), which moves φ_c a by `step` times the feedback e.

    Args:
        measured: φ at the filtered motion `(n,)`.
        residual: Filtered voltage less the model's, V.
        commanded: φ_c at the command that the feedback belongs to `(n,)`.
        feedback: V.
        noise: Variance of a sample, V².
        settings: f of a, f of d, standard deviation of d, step, dead zone, weight of a new sample in the brief and the
            lasting mean, `(7,)`.
        prior: P₀ of a, `(n, n)`.
        usual: In and out: brief and lasting mean square of the innovations, V², `(2,)`.
        weights: In and out: a, and d last, `(n + 1,)`.
        covariance: In and out: P of both, `(n + 1, n + 1)`.
    """
    n = measured.shape[0]
    slow, fast, step = settings[0], settings[1], settings[3]
    x, gain = np.empty(n + 1), np.empty(n + 1)
    for i in range(n):
        x[i] = measured[i]
    x[n] = 1.0
    _times(covariance, x, gain)
    total, innovation = noise, residual
    for i in range(n + 1):
        total += x[i] * gain[i]
        innovation -= x[i] * weights[i]
    bound = OUTLIER * np.sqrt(total)
    innovation = max(-bound, min(bound, innovation))
    for i in range(2):
        usual[i] += settings[5 + i] * (innovation * innovation - usual[i])
    innovation /= total
    for i in range(n):
        weights[i] = slow * (weights[i] + gain[i] * innovation)
        for j in range(n):
            posterior = covariance[i, j] - gain[i] * gain[j] / total
            covariance[i, j] = slow * slow * posterior + (1 - slow * slow) * prior[i, j]
        across = slow * fast * (covariance[i, n] - gain[i] * gain[n] / total)
        covariance[i, n] = across
        covariance[n, i] = across
    weights[n] = fast * (weights[n] + gain[n] * innovation)
    posterior = covariance[n, n] - gain[n] * gain[n] / total
    covariance[n, n] = fast * fast * posterior + (1 - fast * fast) * settings[2] * settings[2]
    if abs(feedback) > settings[4]:
        _times(covariance, commanded, gain)
        power = 0.0
        for i in range(n):
            power += commanded[i] * gain[i]
        if power > NOTHING:
            for i in range(n):
                weights[i] += step / power * feedback * gain[i]


_features, _basis, _adapt = one(features), one(basis), one(adapt)

KEPT = 2  # former plants
SIGNALS = 6  # pass the filters: what was sent in the two channels, the twist, cosine and sine of the heading

# What is kept of one robot; `once` and `twice` are the filtered signals, `last` the last two twists, `variance` that of
# their noise, and `noise` what a sample has of its own, V, and per m/s of that. `since` is for how long the plant has
# been learned, s, `place` where what is known of it will be kept, `back` whether it was taken from there, `known`
# whether a former plant is there, `misfit` the mean square of what that one mispredicts, in variances of `noise`.
STATE = np.dtype(
    [
        ("settings", "f8", (CHANNELS, 7)), ("share", "f8"), ("rigid", "f8"),
        ("command", "f8", CHANNELS), ("phi", "f8", FEATURES), ("output", "f8", CHANNELS), ("added", "f8", CHANNELS),
        ("age", "f8"), ("heading", "f8"), ("signals", "f8", SIGNALS), ("once", "f8", SIGNALS), ("twice", "f8", SIGNALS),
        ("last", "f8", (2, CHANNELS)), ("variance", "f8", CHANNELS), ("noise", "f8", (CHANNELS, 2)),
        ("usual", "f8", (CHANNELS, 2)), ("weights", "f8", (CHANNELS, FEATURES + 1)),
        ("covariance", "f8", (CHANNELS, FEATURES + 1, FEATURES + 1)), ("norm", "f8", (1,)),
        ("since", "f8"), ("place", "i8"), ("back", "f8"), ("known", "f8", KEPT), ("misfit", "f8", KEPT),
        ("kept", "f8", (KEPT, CHANNELS, FEATURES + 1)),
        ("kept_covariance", "f8", (KEPT, CHANNELS, FEATURES + 1, FEATURES + 1)),
    ],
    align=True,
)  # fmt: skip


@njit
def _learned(weights, phi):  # noqa: ANN001, ANN202
    """φ a."""
    total = 0.0
    for i in range(phi.shape[0]):
        total += weights[i] * phi[i]
    return total


@njit
def _switch(period, phi, residual, priors, s):  # noqa: ANN001, ANN202
    """Sees whether the plant of one robot has changed, or a former one is back."""
    n, settled, before = FEATURES, SETTLED * period * (1 / s.share - 1), s.since
    s.since += period
    changed = (s.usual[:, 0] > CHANGE * s.usual[:, 1]).any()
    if changed:
        s.usual[:, 1] = np.maximum(s.usual[:, 0], s.usual[:, 1])
        if s.since > LEARNED:
            s.kept[s.place], s.kept_covariance[s.place], s.known[s.place] = s.weights, s.covariance, 1.0
        if s.since > LEARNED or s.back > 0:
            s.place = 1 - s.place
        s.since = s.back = 0.0
    if changed or before < settled <= s.since:  # once more when the filters hold nothing of the plant before
        for k in range(CHANNELS):
            _give_up(priors[k], s.settings[k, 2], s.weights[k], s.covariance[k])
        s.misfit[:] = 0.0
    elif s.back == 0 and s.known.any() and settled < s.since < settled + LEARNED:
        for j in range(KEPT):
            misfit = 0.0
            for k in range(CHANNELS):
                misfit += ((residual[k] - _learned(s.kept[j, k], phi)) / s.noise[k, 0]) ** 2
            s.misfit[j] += period / (period + LOOK) * (misfit - s.misfit[j])
        j = int(s.known[1] > 0 and (s.known[0] == 0 or s.misfit[1] < s.misfit[0]))
        if s.known[j] > 0 and s.misfit[j] < BACK and s.since > settled + LOOK:
            s.place, s.back = j, 1.0
            for k in range(CHANNELS):
                s.weights[k, :n], s.weights[k, n] = s.kept[j, k, :n], 0.0
                s.covariance[k] = s.kept_covariance[j, k]
                s.covariance[k, n, :n] = s.covariance[k, :n, n] = 0.0
                s.covariance[k, n, n] = s.settings[k, 2] ** 2


def _compile(version: int) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """Output and adaptation for all robots; see `chain.stamp` for the version."""

    @njit((GIVEN, GIVEN, float64, EACH, OWN, OWN, rows(STATE)), cache=True)
    def respond(command, derivative, half_track, scale, model, units, state):  # noqa: ANN001, ANN202
        _ = version
        x = np.empty(PHYSICAL)
        for i in range(len(state)):
            s = state[i]
            _features(command[i], derivative[i], half_track, scale, x)
            x[8], x[9] = np.cos(s.heading), np.sin(s.heading)
            _basis(x, units, s.phi)
            for k in range(CHANNELS):
                s.command[k] = command[i, k]
                s.output[k] = _learned(s.weights[k], s.phi) + s.weights[k, FEATURES]
                for j in range(INPUTS):
                    s.output[k] += model[k, j] * x[j]
            s.output[1] -= s.rigid * s.command[1]

    @njit((*[GIVEN] * 3, ANY, float64, float64, EACH, OWN, OWN, float64[:, :, ::1], rows(STATE)), cache=True)
    def teach(  # noqa: ANN202
        feedback, twist, voltage, idle, half_track, period, scale, model, units, priors, state  # noqa: ANN001
    ):  # fmt: skip
        x, phi, rate, residual = np.empty(PHYSICAL), np.empty(FEATURES), np.empty(CHANNELS), np.empty(CHANNELS)
        for i in range(len(state)):
            s = state[i]
            s.heading += period * twist[i, 1]
            s.signals[2], s.signals[3] = twist[i]
            s.signals[4], s.signals[5] = np.cos(s.heading), np.sin(s.heading)
            for j in range(SIGNALS):
                if s.age == 0:
                    s.once[j] = s.twice[j] = s.signals[j]
                s.once[j] += s.share * (s.signals[j] - s.once[j])
                s.twice[j] += s.share * (s.once[j] - s.twice[j])
            for k in range(CHANNELS):
                if s.age == 0:
                    s.last[0, k] = s.last[1, k] = twist[i, k]
                kink = twist[i, k] - 2 * s.last[0, k] + s.last[1, k]  # of independent noise: six times its variance
                s.variance[k] += s.settings[k, 6] * (kink * kink / 6 - s.variance[k])
                s.last[1, k], s.last[0, k] = s.last[0, k], twist[i, k]
                rate[k] = (s.once[2 + k] - s.twice[2 + k]) * s.share / (1 - s.share) / period
                s.signals[k] = voltage[i, k]
            s.signals[1] += s.rigid * s.command[1]
            s.age += s.share
            fast = abs(s.twice[2]) + half_track * abs(s.twice[3]) > SLOW
            if fast and s.age > SETTLED and idle[i] == 0:
                _features(s.twice[2:4], rate, half_track, scale, x)
                x[8], x[9] = s.twice[4], s.twice[5]
                _basis(x, units, phi)
                for k in range(CHANNELS):
                    residual[k] = s.twice[k]
                    for j in range(INPUTS):
                        residual[k] -= model[k, j] * x[j]
                    noise = s.noise[k, 0] ** 2 + s.noise[k, 1] ** 2 * s.variance[k]
                    s.added[k] = _learned(s.weights[k], s.phi)
                    _adapt(
                        phi, residual[k], s.phi, feedback[i, k], noise, s.settings[k], priors[k], s.usual[k],
                        s.weights[k], s.covariance[k],
                    )  # fmt: skip
                _switch(period, phi, residual, priors, s)
                for k in range(CHANNELS):
                    s.added[k] = _learned(s.weights[k], s.phi) - s.added[k]
            else:  # only the disturbance fades
                for k in range(CHANNELS):
                    s.weights[k, FEATURES] *= s.settings[k, 1]
                    s.added[k] = 0.0
            s.norm[0] = np.sqrt((s.weights[:, :FEATURES] ** 2).sum())

    return respond, teach


_respond, _teach = _compile(stamp(features))


class CompositeAdaptation:
    """`composite` for B robots.

    Attributes:
        state: `weights` `(B, 2, 27)`, a and d of both channels, and their `covariance` `(B, 2, 27, 27)`.
        measured_noise: Variance that the measured V and θ̇ are seen to have, (m/s)² and (rad/s)², `(B, 2)`.
        weight_norm: Euclidean norm of a, `(B,)`.
        weight_volts: The weights are in volts.
    """

    weight_volts = 1.0

    def __init__(self, robot: Robot, settings: list[Composite], rigid: bool, period: float) -> None:
        """Takes the nominal robot, settings a row, whether channel two is steering, and the control period in s.

        Raises:
            InputError: The weights file of the first row, which is that of all, is missing, broken or of another shape.
        """
        training = load_training(settings[0].weights or SHIPPED)
        self._units = training.units
        self._priors = np.ascontiguousarray(training.priors[[0, 2 if rigid else 1]])
        self._half_track, self._period = robot.half_track, period
        self._scale = feature_scale(robot)
        self._model = np.ascontiguousarray((inverse_coefficients(robot) * self._scale[:, None]).T)
        if rigid:  # the nominal steering makes the rotation that is asked of it
            self._model[1] = 0.0
            self._model[1, 1] = self._scale[1]
        self._rows = state = np.zeros(len(settings), STATE)
        self.state = {"weights": state["weights"], "covariance": state["covariance"]}
        state["rigid"] = float(rigid)
        state["share"] = [period / (period + s.filter) for s in settings]
        for row, s in enumerate(settings):
            memories = np.exp(-period / np.array([s.memory, s.disturbance_memory]))
            means = period / (period + np.array([BRIEF, LASTING]))
            common = np.array([*memories, s.disturbance, s.step, s.dead_zone, *means])
            second = common * [1, 1, STEERING_DISTURBANCE, STEERING_SHARE, STEERING_SCALE, 1, 1]
            state["settings"][row] = common, second if rigid else common
            scale = STEERING_SCALE if rigid else 1.0
            state["noise"][row] = [s.noise, SCATTER], [scale * s.noise, scale * SCATTER * robot.half_track]
        self._output, self._added, self.weight_norm = state["output"], state["added"], state["norm"][:, 0]
        self.measured_noise = state["variance"]
        self.restore(np.arange(len(settings)))

    def restore(self, rows: NDArray[np.intp]) -> None:
        """Takes robots back to what they knew at the start."""
        state = self._rows
        state["weights"][rows], state["known"][rows], state["back"][rows], self.weight_norm[rows] = 0, 0, 0, 0
        state["since"][rows] = SETTLED * self._period * (1 / state["share"][rows] - 1)
        for row in rows:
            state["covariance"][row] = 0.0
            state["covariance"][row, :, :FEATURES, :FEATURES] = self._priors
            state["covariance"][row, :, FEATURES, FEATURES] = state["settings"][row, :, 2] ** 2
            own, per_speed = state["noise"][row].T ** 2
            state["usual"][row] = (own + per_speed * state["variance"][row])[:, None]

    def output(self, command: Array, derivative: Array) -> Array:
        """The model, what is adapted at the commanded motion, and the disturbance."""
        _respond(command, derivative, self._half_track, self._scale, self._model, self._units, self._rows)
        return self._output

    def learn(self, feedback: Array, saturated: Array, twist: Array, voltage: Array) -> Array:
        """One composite step; where it must not learn the filters run on and the disturbance fades.

        Returns:
            What the weights added to the last output. The disturbance is left out: the PID's integral may keep what it
            holds, as beside `observer`.
        """
        _teach(
            feedback, twist, voltage, saturated, self._half_track, self._period, self._scale, self._model, self._units,
            self._priors, self._rows,
        )  # fmt: skip
        return self._added
