"""Feedback-error learning: its gradient, its step, its safeguards, and its files."""

import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from safetensors import safe_open
from safetensors.numpy import load_file, save_file

import mrctl
from mrctl.control.features import FEATURES, feature_matrix, feature_scale
from mrctl.control.feedforward import Loop
from mrctl.control.fel import (
    BIAS_GAIN,
    HEADING_GAIN,
    HIDDEN_GAIN,
    REGULARISATION,
    FeedbackErrorLearning,
    Fel,
    by_columns,
    by_rows,
    fresh,
    inner,
    network,
    tanh,
    update,
)
from mrctl.control.fel_torch import Network
from mrctl.control.matching import HOLD_PERIODS
from mrctl.control.weights import flatten, initial_weights, load_weights, save_weights, shapes, unflatten
from mrctl.record import InputError

RNG = np.random.default_rng(7)
HIDDEN = 6
PERIOD = 0.01


def trained(hidden=HIDDEN):
    """Weights with nothing zero in them, flat."""
    return np.random.default_rng(hidden).normal(0, 0.5, 11 * hidden + 18)


def torch_network(weights):
    """The torch twin of flat weights."""
    twin = Network(len(unflatten(weights)["hidden.bias"]))
    twin.load_state_dict({name: torch.tensor(layer) for name, layer in unflatten(weights).items()})
    return twin


def whole(hidden=HIDDEN):
    """All weights of the network, with W₄ at the end, flat."""
    return np.append(trained(hidden), np.random.default_rng(1).normal(0, 0.5, 4))


def compiled(weights):
    """The same weights in the order of the kernels."""
    return np.append(by_columns(weights[:-4])[:-4], weights[-4:])


def answer(x, weights, scale):
    """Output of the network `(2,)` at features and heading, with W₄ at the end of the weights."""
    output = np.zeros(2)
    network(x, compiled(weights), np.zeros(HIDDEN), np.array(scale, float), output)
    return output


def one_step(x, feedback, weights, rigid=False, prior=None, **settings):
    """Weights and norm after one step of one robot, without leak and far within the bound by default.

    Their last four are W₄, whose prior is zero.
    """
    s = fresh([Fel(**{"step": 0.05, "leak": 0.0, "weight_bound": 1e4} | settings)], rigid)[0]
    after, hidden, initial = compiled(weights), np.zeros(HIDDEN), by_columns((weights if prior is None else prior)[:-4])
    s["x"] = s["past"] = x
    network(s["x"], after, hidden, s["scale"], s["output"])
    update(np.array(feedback, float), s, after, initial, hidden, np.zeros(len(initial)))
    return np.append(by_rows(after), after[-4:]), float(s["norm"])


def teach(stage, feedback, frozen=0.0):
    """One learning step of every robot; where and how they move does not matter to this stage."""
    size = len(feedback)
    return stage.learn(np.array(feedback, float), np.broadcast_to(frozen, size), *np.zeros((2, size, 2)))


def taught(robot, settings=None, rigid=False, size=1):
    """A stage that has driven one motion for as long as feedback takes to answer, with its command and derivative."""
    stage = FeedbackErrorLearning(
        Loop(robot, rigid, PERIOD, seeds=list(range(size))), [settings or Fel(hidden=HIDDEN)] * size
    )
    command = RNG.uniform([-1.5, -3], [1.5, 3], (size, 2))
    derivative = RNG.uniform([-1.5, -6], [1.5, 6], (size, 2))
    for _ in range(HOLD_PERIODS):
        stage.output(command, derivative)
        teach(stage, np.ones((size, 2)))
    assert not stage.weight_norm.any()
    return stage, command, derivative


def power(stage):
    """Squared norm of the gradient of one channel at the first step, when only what is behind tanh can move."""
    layers, x = unflatten(stage.adapted()[0]), stage.rows["x"][0]
    hidden = np.tanh(layers["hidden.weight"] @ x[:FEATURES] + layers["hidden.bias"])
    return HIDDEN_GAIN**2 * hidden @ hidden + BIAS_GAIN**2 + x @ x


@given(st.floats(-1e6, 1e6) | st.floats(-25, 25))
def test_tanh(z):
    """The tanh of the kernels, which compiles to vector instructions, is that of the library."""
    assert tanh(z) == pytest.approx(np.tanh(z), rel=0, abs=3e-14)


def test_tanh_of_nan():
    """A motion that is not a number is not hidden by the limits of the series."""
    assert np.isnan(tanh(np.nan)) and tanh(np.inf) == 1 == -tanh(-np.inf)


@given(st.integers(0, 13), st.integers(0, 3), st.data())
def test_inner(size, start, data):
    """The inner product in four sums is NumPy's, whatever the length."""
    a = data.draw(arrays(float, start + size, elements=st.floats(-10, 10)))
    b = data.draw(arrays(float, size, elements=st.floats(-10, 10)))
    assert inner(a, start, b) == pytest.approx(a[start:] @ b, abs=1e-11)


def test_network():
    """The compiled network is its formula, and its torch twin, which has no heading."""
    inputs, weights = RNG.normal(size=10), whole()
    x, heading = inputs[:8], inputs[8:]
    layer = unflatten(weights[:-4])
    hidden = np.tanh(layer["hidden.weight"] @ x + layer["hidden.bias"])
    expected = HIDDEN_GAIN * layer["output.weight"] @ hidden + BIAS_GAIN * layer["output.bias"]
    scale, incline = np.array([6.0, 0.6]), weights[-4:].reshape(2, 2) @ heading
    expected = scale * (expected + layer["direct.weight"] @ x + incline)
    found = answer(inputs, weights, scale)
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-14)
    twin = torch_network(weights[:-4])(torch.tensor(x)).detach().numpy()
    np.testing.assert_allclose(found, scale * (twin + incline), rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("rigid", [False, True])
def test_gradient(rigid):
    """The step goes along Jᵀe with the documented length, J by central differences and by autograd."""
    x, weights, feedback = RNG.normal(size=10), whole(), np.array([1.3, -0.4])
    h = 1e-5
    nudges = h * np.eye(len(weights))
    numeric = [(answer(x, weights + nudge, [1, 1]) - answer(x, weights - nudge, [1, 1])) / (2 * h) for nudge in nudges]
    numeric = np.transpose(numeric)
    twin = torch_network(weights[:-4])
    by_name = torch.func.jacrev(lambda p: torch.func.functional_call(twin, p, (torch.tensor(x[:8]),)))(
        dict(twin.named_parameters())
    )
    auto = np.hstack([by_name[name].detach().numpy().reshape(2, -1) for name in shapes(HIDDEN)])
    auto = np.hstack([auto, np.kron(np.eye(2), x[8:])])
    np.testing.assert_allclose(numeric, auto, atol=1e-8)
    # The steering channel learns a tenth as fast, and 0.6 rad/s count as 6 V.
    error = np.array([1.0, 0.1 if rigid else 1.0]) * feedback / [6.0, 0.6 if rigid else 6.0]
    gradient = auto.T @ error
    expected = 0.05 * gradient / (gradient @ gradient / (error @ error) + REGULARISATION)
    after, norm = one_step(x, feedback, weights, rigid)
    np.testing.assert_allclose(after - weights, expected, atol=1e-14)
    assert norm == pytest.approx(np.linalg.norm([*expected[:-4], *after[-4:]]))  # W₄ began at zero


@pytest.mark.parametrize("rigid", [False, True])
@pytest.mark.parametrize("feedback", [[0.7, 0.0], [0.0, -0.4], [0.9, -1.4]])
def test_normalised_step(robot, rigid, feedback):
    """The first step moves the feedforward at its input by μ times the feedback; steering by a tenth of it."""
    stage, command, derivative = taught(robot, Fel(hidden=HIDDEN, step=0.05, leak=0.0), rigid)
    assert not stage.output(command, derivative).any()
    size = power(stage)
    taken = teach(stage, [feedback])
    moved = stage.output(command, derivative)[0]
    np.testing.assert_allclose(taken[0], moved, atol=1e-14)  # what it says it added is what it added
    share = [1, 0.1 if rigid else 1]
    expected = 0.05 * np.multiply(share, feedback) * size / (size + REGULARISATION)
    np.testing.assert_allclose(moved, expected, atol=1e-12)


def test_learns(robot):
    """Taught by what was missing to an inverse two periods ago, the network finds it."""
    stage = FeedbackErrorLearning(Loop(robot, False, PERIOD, seeds=list(range(8))), [Fel(step=0.2, dead_zone=0.0)] * 8)
    gains = np.array([[6.0, 1.0, 3.0, 0.5, -1.0, 0.4, 1.0, 1.0], [0.2, 5.0, 0.1, 4.0, 2.0, 0.0, -1.0, 1.0]]).T
    rng, missing, late = np.random.default_rng(0), [], [np.zeros((8, 2))] * HOLD_PERIODS
    for _ in range(600):
        command, derivative = rng.uniform([0.2, -2], [1.2, 2], (8, 2)), rng.uniform([-1, -4], [1, 4], (8, 2))
        given = stage.output(command, derivative)
        error = feature_matrix(command, derivative, robot.half_track, feature_scale(robot)) @ gains - given
        late.append(error)
        teach(stage, late.pop(0))
        missing.append(np.sqrt((error**2).mean()))
    assert np.mean(missing[-50:]) < 0.1 * np.mean(missing[:5])


def test_frozen_while_saturated(robot):
    """What saturated teaches nothing, and its neighbour learns on."""
    stage, command, derivative = taught(robot, size=2)
    stage.output(command, derivative)
    before = stage.weights.copy()
    teach(stage, np.ones((2, 2)), [1.0, 0.0])
    np.testing.assert_array_equal(stage.weights[0], before[0])
    assert (stage.weights[1] != before[1]).any()
    assert stage.weight_norm[0] == 0 < stage.weight_norm[1]


@pytest.mark.parametrize("rigid", [False, True])
def test_dead_zone(robot, rigid):
    """Feedback at the dead zone teaches nothing, just beyond it does; a tenth of it on a steering channel."""
    stage, command, derivative = taught(robot, rigid=rigid)
    stage.output(command, derivative)
    before = stage.weights.copy()
    edge = np.array([[0.03, 0.003 if rigid else 0.03]])
    teach(stage, edge)
    np.testing.assert_array_equal(stage.weights, before)
    for channel in range(2):
        teach(stage, edge * (1 + 1e-6 * (np.arange(2) == channel)))
        moved = unflatten(stage.adapted()[0])["direct.weight"].any(axis=1)
        assert moved.tolist() == [True, channel == 1]


def test_frozen_settings(robot):
    """`frozen` changes nothing, not even by the leak."""
    settings = Fel(hidden=HIDDEN, frozen=True, leak=0.1)
    stage, command, derivative = taught(robot, settings)
    stage.weights += 0.1
    before, given = stage.weights.copy(), stage.output(command, derivative).copy()
    for _ in range(20):
        teach(stage, np.full((1, 2), 3.0))
    np.testing.assert_array_equal(stage.weights, before)
    np.testing.assert_array_equal(stage.output(command, derivative), given)


def test_leak():
    """Each step gives back its share of the distance to the prior."""
    x, weights = RNG.normal(size=10), whole()
    prior = np.append(weights[-5::-1], np.zeros(4))
    plain, _ = one_step(x, [1.0, 1.0], weights, prior=prior)
    leaky, _ = one_step(x, [1.0, 1.0], weights, prior=prior, leak=0.01)
    np.testing.assert_allclose(leaky - plain, -0.01 * (weights - prior), atol=1e-14)


@given(arrays(float, (10, 10), elements=st.floats(-2, 2)), st.floats(0.01, 3), st.floats(0.01, 1))
def test_projection(inputs, bound, rate):
    """However long and wrongly it is taught, the weights stay within the bound of the prior."""
    weights = prior = np.append(trained(), np.zeros(4))
    for x in inputs:
        weights, norm = one_step(x, [50.0, -80.0], weights, prior=prior, step=rate, weight_bound=bound)
        distance = np.linalg.norm(weights - prior)
        assert distance <= bound * (1 + 1e-12)
        assert norm == pytest.approx(distance, rel=1e-9, abs=1e-12)


def test_projection_keeps_direction():
    """Beyond the bound the step is shortened, not turned."""
    x, weights = RNG.normal(size=10), np.append(trained(), np.zeros(4))
    free, norm = one_step(x, [5.0, 5.0], weights)
    short, bounded = one_step(x, [5.0, 5.0], weights, weight_bound=norm / 4)
    np.testing.assert_allclose(short - weights, (free - weights) / 4, atol=1e-15)
    assert bounded == norm / 4


@given(arrays(float, (2, 4, 2), elements=st.floats(-5, 5)), arrays(float, (4, 2), elements=st.floats(-5, 5)), st.data())
def test_rows(robot, motion, feedback, data):
    """Robots do not mix: a row has the same bits alone and beside others, one of which is lost."""
    frozen = data.draw(arrays(float, 4, elements=st.sampled_from([0.0, 1.0])))
    prior = np.stack([np.random.default_rng(i).normal(0, 0.5, 88) for i in range(4)])
    settings = Fel(hidden=HIDDEN, step=0.1, leak=1e-3, weight_bound=0.2)

    def after(rows, lost=()):
        command, derivative = motion[:, rows].copy()
        command[list(lost)] = np.nan
        stage = FeedbackErrorLearning(Loop(robot, False, PERIOD, seeds=[0] * len(command)), [settings] * len(command))
        for _ in range(HOLD_PERIODS):
            stage.output(command, derivative)
            teach(stage, feedback[rows])
        stage.initial[:], stage.weights[:] = prior[rows], prior[rows] + 0.01
        output = stage.output(command, derivative).copy()
        added = teach(stage, feedback[rows], frozen[rows])
        return np.hstack([stage.weights, stage.weight_norm[:, None], output, added, stage.rows["output"]])

    together = after(slice(None), lost=[2])
    for i in (0, 1, 3):
        assert together[i].tobytes() == after(slice(i, i + 1))[0].tobytes()


@pytest.mark.parametrize("hidden", [1, 6, 24])
def test_flat_weights(hidden):
    """Named and flat weights are each other's inverse, in size and order those of the torch network."""
    weights = trained(hidden)
    layers = unflatten(weights)
    np.testing.assert_array_equal(flatten(layers), weights)
    for several in (weights, np.stack([weights, -weights])):  # of one robot and of two
        np.testing.assert_array_equal(by_rows(by_columns(several)), several)
    columns = by_columns(weights)[: hidden * FEATURES]
    np.testing.assert_array_equal(columns, layers["hidden.weight"].T.ravel())
    theirs = {name: tuple(value.shape) for name, value in Network(hidden).state_dict().items()}
    assert {name: layer.shape for name, layer in layers.items()} == theirs == shapes(hidden)


def test_initial_weights():
    """The seed makes the hidden layer and nothing else; what is behind it is zero."""
    layers = unflatten(initial_weights(24, 3))
    assert layers["hidden.weight"].std() == pytest.approx(0.5, rel=0.15)
    assert not any(layers[name].any() for name in ("output.weight", "output.bias", "direct.weight"))
    np.testing.assert_array_equal(initial_weights(24, 3), initial_weights(24, 3))
    assert (initial_weights(24, 3) != initial_weights(24, 4)).any()


@pytest.mark.parametrize("suffix", [".safetensors", ".pt"])
def test_files(robot, tmp_path, suffix):
    """Weights come back to the bit from either kind of file, and a stage starts from them."""
    path, weights = tmp_path / f"weights{suffix}", trained()
    if suffix == ".pt":
        torch.save(torch_network(weights).state_dict(), path)
    else:
        save_weights(path, weights)
    np.testing.assert_array_equal(load_weights(path, HIDDEN), weights)
    stage, command, derivative = taught(robot, Fel(hidden=HIDDEN, weights=str(path)))
    x = np.append(feature_matrix(command, derivative, robot.half_track, feature_scale(robot)), [HEADING_GAIN, 0.0])
    np.testing.assert_array_equal(stage.output(command, derivative)[0], answer(x, np.append(weights, [0] * 4), [6, 6]))
    np.testing.assert_array_equal(stage.adapted(), weights[None])


def test_single_precision(tmp_path):
    """Weights of single precision are taken as they are."""
    layers = {name: layer.astype(np.float32) for name, layer in unflatten(trained()).items()}
    save_file(layers, tmp_path / "single.safetensors")
    found = load_weights(tmp_path / "single.safetensors", HIDDEN)
    assert found.dtype == float
    np.testing.assert_array_equal(found, flatten(layers))


def refused(path, hidden=HIDDEN):
    """The one line with which a file is refused."""
    with pytest.raises(InputError) as caught:
        load_weights(path, hidden)
    message = str(caught.value)
    assert message.startswith("fel.weights: ")
    assert str(path) in message
    assert len(message.splitlines()) == 1
    return message


@pytest.mark.parametrize("suffix", [".safetensors", ".pt"])
def test_bad_files(tmp_path, suffix):
    """A file that is not what it should be is refused in one line that names the setting and the file."""
    good = {name: layer.copy() for name, layer in unflatten(trained()).items()}

    def write(name, layers):
        path = tmp_path / f"{name}{suffix}"
        if suffix == ".pt":
            torch.save({key: torch.tensor(layer) for key, layer in layers.items()}, path)
        else:
            save_file(layers, path)
        return path

    path = write("good", good)
    assert "hidden.weight is (6, 8), it must have shape (7, 8)" in refused(path, 7)
    assert "unknown entry 'extra.weight'" in refused(write("extra", good | {"extra.weight": np.ones(2)}))
    assert "output.bias is missing" in refused(write("less", {k: v for k, v in good.items() if k != "output.bias"}))
    for value in (np.nan, np.inf):
        assert "non-finite" in refused(write("broken", good | {"output.bias": np.array([1.0, value])}))
    data = path.read_bytes()
    for length in (0, 1, 7, 8, 9, 100, len(data) // 2, len(data) - 1):
        short = tmp_path / f"short{length}{suffix}"
        short.write_bytes(data[:length])
        assert "not a weights file" in refused(short)
    assert "no file" in refused(tmp_path / f"absent{suffix}")
    (tmp_path / f"folder{suffix}").mkdir()
    assert "no file" in refused(tmp_path / f"folder{suffix}")


def test_writer(tmp_path):
    """A file says which version wrote it; if it has another shape, so does its error, unless that is this version."""
    path = tmp_path / "weights.safetensors"
    save_weights(path, trained())
    with safe_open(path, "numpy") as file:
        assert file.metadata()["mrctl"] == mrctl.__version__
    assert "written by" not in refused(path, 7)
    save_file({name: layer.copy() for name, layer in unflatten(trained()).items()}, path, {"mrctl": "0.0.9"})
    assert "(written by mrctl 0.0.9): hidden.weight is (6, 8)" in refused(path, 7)


@pytest.mark.parametrize("content", [torch.ones(3), [1, 2], {"hidden.weight": "text"}, {"hidden.weight": [1.0]}, None])
def test_not_a_state_dict(tmp_path, content):
    """A torch file that holds something else is refused."""
    torch.save(content, tmp_path / "other.pt")
    assert "not a weights file" in refused(tmp_path / "other.pt")


class Evil:
    """Makes a file when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (Path(self.path),)


@pytest.mark.filterwarnings("ignore:Detected pickle protocol")
@pytest.mark.parametrize("writer", ["torch", "pickle"])
def test_no_code_from_files(tmp_path, writer):
    """A pickle that would run code is refused, and runs nothing."""
    path, mark = tmp_path / "evil.pt", tmp_path / "mark"
    layers = {"hidden.weight": Evil(str(mark))}
    if writer == "torch":
        torch.save(layers, path)
    else:
        path.write_bytes(pickle.dumps(layers))
    refused(path)
    assert not mark.exists()
    pickle.loads(pickle.dumps(layers))  # the trap does work
    assert mark.exists()


def test_save_refused(tmp_path):
    """A place that cannot be written is named, and so is a name under which no run could read the weights."""
    with pytest.raises(InputError, match="nowhere.*cannot write weights"):
        save_weights(tmp_path / "nowhere" / "weights.safetensors", trained())
    with pytest.raises(InputError, match=r"w\.st: a file of weights must end in \.safetensors"):
        save_weights(tmp_path / "w.st", trained())
    assert not (tmp_path / "w.st").exists()


@pytest.mark.parametrize(
    ("given", "kind"),
    [
        (np.zeros((1, 62)), r"shape \(1, 62\)"), (np.zeros(61), r"shape \(61,\)"), (np.zeros(18), r"shape \(18,\)"),
        (1.0, r"shape \(\)"), ("weights", "type str"), ({"hidden.bias": np.zeros(4)}, "type dict"),
    ],
)  # fmt: skip
def test_no_weights(tmp_path, given, kind):
    """What is no flat vector of weights, such as that of a batch or of another learner, is one line and no file."""
    with pytest.raises(InputError, match=f"^weights: {kind} is not the flat weights of fel") as refused:
        save_weights(tmp_path / "w.safetensors", given)
    assert "\n" not in str(refused.value) and not (tmp_path / "w.safetensors").exists()


def test_safetensors_names(tmp_path):
    """The file holds the layers by their torch names, for others to read."""
    save_weights(tmp_path / "w.safetensors", trained())
    found = load_file(tmp_path / "w.safetensors")
    assert {name: layer.shape for name, layer in found.items()} == shapes(HIDDEN)
