"""The general learner: equal to the compiled one on its network, and at home with other modules."""

import numpy as np
import pytest
import torch
from torch import nn

from mrctl.control.feedforward import Loop
from mrctl.control.fel import FeedbackErrorLearning, Fel
from mrctl.control.fel_torch import ModuleLearning, Network
from mrctl.control.matching import HOLD_PERIODS
from mrctl.control.weights import flatten, initial_weights, unflatten

HIDDEN, SIZE, PERIOD = 5, 3, 0.01
GELU = nn.Sequential(nn.Linear(8, 12), nn.GELU(), nn.Linear(12, 12), nn.GELU(), nn.Linear(12, 2))


def draw(rng, size):
    return rng.uniform([-1.5, -3], [1.5, 3], (size, 2)), rng.uniform([-1.5, -6], [1.5, 6], (size, 2))


def teach(stage, feedback, frozen):
    """One learning step; where and how the robots move does not matter to these stages."""
    return stage.learn(feedback, frozen, *np.zeros((2, len(feedback), 2)))


def rows(state):
    """Flat parameters (B, n) of a torch stage with the layers of `Network`."""
    layers = {name: value.detach().numpy() for name, value in state.items()}
    return np.stack([flatten({name: layer[row] for name, layer in layers.items()}) for row in range(SIZE)])


@pytest.mark.parametrize(
    ("settings", "rigid", "ticks"),
    [
        (Fel(hidden=HIDDEN), False, 150),
        (Fel(hidden=HIDDEN), True, 100),
        (Fel(hidden=HIDDEN, step=0.3, leak=1e-3, weight_bound=0.1), False, 150),
        (Fel(hidden=HIDDEN, step=0.1, dead_zone=1.0), True, 100),
        (Fel(hidden=HIDDEN, frozen=True), False, 20),
        (Fel(hidden=HIDDEN, step=0.0, leak=0.1), False, 20),
    ],
    ids=["default", "rigid", "leak and projection", "dead zone", "frozen", "no step"],
)
def test_twins(robot, settings, rigid, ticks):
    """Over a hundred ticks and more both learners give the same weights and outputs, whatever safeguard acts."""
    rng = np.random.default_rng(2)
    module = Network(HIDDEN)
    module.load_state_dict({k: torch.tensor(v) for k, v in unflatten(initial_weights(HIDDEN, 4)).items()})
    loop = Loop(robot, rigid, PERIOD, 2, has_prior=False, seeds=[4] * SIZE)
    compiled = FeedbackErrorLearning(loop, [settings] * SIZE)
    general = ModuleLearning(module, robot, SIZE, settings, rigid)
    general.reset(PERIOD, 2 * PERIOD)
    largest = 0.0
    for tick in range(ticks):
        if tick == ticks // 2:  # the guard, or an environment, resets one robot
            for stage in (compiled, general):
                stage.restore(np.array([1]))
        command, derivative = draw(rng, SIZE)
        found, expected = general.output(command, derivative), compiled.output(command, derivative)
        np.testing.assert_allclose(found, expected, atol=1e-12)
        feedback = rng.normal(size=(SIZE, 2)) * [1.5, 0.15 if rigid else 1.5] - expected / 3
        saturated = (rng.random(SIZE) < 0.2).astype(float)
        added = [teach(stage, feedback, saturated) for stage in (general, compiled)]
        np.testing.assert_allclose(*added, atol=1e-12)
        np.testing.assert_allclose(rows(general.state), compiled.adapted(), atol=1e-12)
        np.testing.assert_allclose(general.weight_norm, compiled.weight_norm, atol=1e-12)
        largest = max(largest, compiled.weight_norm.max())
    still = settings.frozen or settings.step == 0
    assert (largest == 0) == still
    assert (largest == settings.weight_bound) == (settings.weight_bound < 1)  # where it should, the projection acts


@pytest.mark.parametrize(
    ("module", "message"),
    [
        (nn.Sequential(nn.Linear(8, 2), nn.BatchNorm1d(2)), "buffer"),
        (nn.Linear(8, 3), r"shape \(3,\)"),
        (nn.Sequential(nn.Linear(8, 2), nn.Unflatten(0, (1, 2))), r"shape \(1, 2\)"),
        (nn.Linear(6, 2), "8 features"),
    ],
    ids=["buffers", "outputs", "dimensions", "inputs"],
)
def test_refused(robot, module, message):
    """A module with running state, or of the wrong shape, is refused by name."""
    with pytest.raises(ValueError, match=f"^module: .*{message}"):
        ModuleLearning(module, robot, 2)


def test_any_module(robot):
    """A module of one's own begins as pure PID and learns an inverse from what is missing; the original stays."""
    torch.manual_seed(0)
    module = nn.Sequential(nn.Linear(8, 16), nn.GELU(), nn.Linear(16, 16), nn.GELU(), nn.Linear(16, 2))
    before = {name: value.clone() for name, value in module.state_dict().items()}
    stage = ModuleLearning(module, robot, 8, Fel(step=0.6, dead_zone=0.0, weight_bound=100.0))
    rng, missing, late = np.random.default_rng(0), [], [np.zeros((8, 2))] * HOLD_PERIODS
    for tick in range(450):
        command, derivative = draw(rng, 8)
        given = stage.output(command, derivative)
        if tick == 0:
            np.testing.assert_array_equal(given, np.zeros((8, 2)))
        target = np.stack([5 * command[:, 0] + derivative[:, 0], 2 * command[:, 1] - 0.3 * derivative[:, 1]], -1)
        missing.append(np.sqrt(((target - given) ** 2).mean()))
        late.append(target - given)
        teach(stage, late.pop(0), np.zeros(8))
    assert np.mean(missing[-50:]) < 0.2 * np.mean(missing[:5])
    for name, value in module.state_dict().items():
        assert value.dtype == torch.float32
        assert torch.equal(value, before[name])


def test_copies(robot):
    """Each robot has its own copy: what one learns stays with it, and is what it would learn alone."""
    rng = np.random.default_rng(1)
    together = ModuleLearning(GELU, robot, SIZE)
    alone = [ModuleLearning(GELU, robot, 1) for _ in range(SIZE)]
    for _ in range(30):
        command, derivative = draw(rng, SIZE)
        given = together.output(command, derivative)
        feedback = rng.normal(size=(SIZE, 2)) + [[1, -1], [-2, 0], [0, 0]]
        saturated = np.array([0.0, 0.0, 1.0])
        for row, stage in enumerate(alone):
            cut = slice(row, row + 1)
            np.testing.assert_allclose(stage.output(command[cut], derivative[cut]), given[cut], atol=1e-9)
            teach(stage, feedback[cut], saturated[cut])
        teach(together, feedback, saturated)
    for name, value in together.state.items():
        single = torch.cat([stage.state[name] for stage in alone])
        torch.testing.assert_close(value, single, atol=1e-9, rtol=0)
        assert torch.equal(value[2], together.initial[name][2])  # saturated all along
        assert not torch.equal(value[0], value[1])
    assert together.weight_norm[2] == 0
    assert (together.weight_norm[:2] > 0).all()
