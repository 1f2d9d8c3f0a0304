"""The paper's claim in the loop: the network takes work off the feedback, keeps what it learned, can be any module."""

import numpy as np
import pytest

from mrctl import PERTURBATIONS, Fel, InputError, Lemniscate, Perturbation, Scenario, per_lap, save_weights
from mrctl.control.features import FEATURES, REGRESSORS
from mrctl.control.fel import HEADING_GAIN
from mrctl.control.weights import initial_weights, unflatten
from mrctl.experiments.paper import IDEAL
from mrctl.loop.runs import simulate
from mrctl.loop.simulation import Simulation

pytestmark = pytest.mark.xdist_group("learning")  # what its tests share is made once

BASE = Scenario(
    **IDEAL,
    reference=Lemniscate(),
    laps=3,
    learner="fel",
    initial_spread=(0, 0, 0),
    perturbation=PERTURBATIONS["all"],
)
TICKS = round(BASE.reference.period / BASE.control_period)


def variant(**changes):
    """The base scenario with changes."""
    return BASE.model_copy(update=changes)


def lap(run, number):
    """One lap of a run."""
    return run.isel(time=slice(number * TICKS, (number + 1) * TICKS))


def rms(values):
    """Root mean square over a lap."""
    return float(np.sqrt((values**2).mean()))


def position(part):
    """RMS distance from the reference, m."""
    return rms(np.hypot(part.x - part.x_ref, part.y - part.y_ref))


@pytest.fixture(scope="module")
def runs():
    """Learning, and the PID alone."""
    return simulate([BASE, variant(learner="none")])


def test_beats_pid(runs):
    """By the third lap the velocity errors are a fraction of the PID's, and the path is nearer to the reference."""
    fel, pid = (lap(runs.isel(run=run), 2) for run in range(2))
    assert not runs.failed.any()
    assert rms(fel.omega - fel.omega_ref) < 0.5 * rms(pid.omega - pid.omega_ref)
    assert rms(fel.v - fel.v_ref) < 0.6 * rms(pid.v - pid.v_ref)
    assert position(fel) < 0.5 * position(pid)


def test_work_moves(runs):
    """The feedback does less of the work each lap; without a learner it does all of it, every lap."""
    share = []
    for number in range(3):
        part = lap(runs.isel(run=0), number)
        share.append(rms(part.feedback_left) / rms(part.voltage_left))
    assert share[0] > share[1] > share[2] and share[2] < 0.35
    assert (runs.feedforward_left[1] == 0).all() and (runs.weight_norm[1] == 0).all()
    assert float(runs.weight_norm[0, -1]) > 0.1


def test_weights_are_kept(runs, tmp_path):
    """What one run learned serves the next from its first lap on, frozen, to the bit what was saved."""
    file = tmp_path / "learned.safetensors"
    save_weights(file, runs.weights.values[0])
    frozen = Fel(weights=str(file), frozen=True)
    trained, untrained = (
        simulate([variant(laps=1, fel=fel), variant(laps=1, fel=fel, seed=1)]) for fel in (frozen, Fel())
    )
    for seed in range(2):
        first, fresh = (lap(run.isel(run=seed), 0) for run in (trained, untrained))
        assert position(first) < 0.5 * position(fresh)
        assert rms(first.omega - first.omega_ref) < rms(fresh.omega - fresh.omega_ref)
    assert np.array_equal(trained.weights, np.tile(runs.weights[0], (2, 1)))
    assert (trained.weight_norm == 0).all()


def test_torch_weights(runs, tmp_path):
    """The same weights as a torch state dict give the same run."""
    torch = pytest.importorskip("torch")
    from mrctl.control.fel_torch import Network

    module = Network()
    module.load_state_dict({name: torch.tensor(layer) for name, layer in unflatten(runs.weights.values[0]).items()})
    torch.save(module.state_dict(), tmp_path / "learned.pt")
    save_weights(tmp_path / "learned.safetensors", runs.weights.values[0])
    one, other = (
        simulate(variant(laps=1, fel=Fel(weights=str(tmp_path / name), frozen=True)))
        for name in ("learned.pt", "learned.safetensors")
    )
    assert np.array_equal(one.x, other.x) and np.array_equal(one.feedforward_left, other.feedforward_left)


def test_wrong_weights(tmp_path):
    """A file for another size is refused by name."""
    save_weights(tmp_path / "small.safetensors", initial_weights(4, 0))
    with pytest.raises(InputError, match=r"^fel\.weights: .*hidden\.weight is \(4, 8\), it must have shape \(24, 8\)"):
        simulate(variant(fel=Fel(weights=str(tmp_path / "small.safetensors"))))


def test_torch_module(runs):
    """Any stateless module is a stage: the twin of the built-in network gives its run, another one learns too."""
    torch = pytest.importorskip("torch")
    from mrctl.control.fel_torch import ModuleLearning, Network

    def begun(scenarios, module, ticks):
        """The first ticks of runs that a module learns in."""
        stage = lambda robot, size: ModuleLearning(module, robot, size, BASE.fel)  # noqa: E731
        simulation = Simulation(scenarios, feedforward=stage)
        for _ in range(ticks):
            simulation.step()
        return simulation.result().isel(time=slice(ticks))

    twin = Network()
    start = unflatten(initial_weights(24, BASE.seed))
    twin.load_state_dict({name: torch.tensor(layer) for name, layer in start.items()})
    start = begun([BASE], twin, 400)
    for name in ("x", "omega", "feedforward_left"):
        assert np.allclose(start[name][0], runs[name][0, :400], atol=1e-6), name

    torch.manual_seed(0)
    own = torch.nn.Sequential(torch.nn.Linear(8, 16), torch.nn.Tanh(), torch.nn.Linear(16, 2))
    learned = begun([BASE, variant(seed=1)], own, 600)
    assert not learned.failed.any() and float(learned.weight_norm[0, -1]) > 0
    assert rms(learned.feedback_left[0, 300:]) < rms(runs.feedback_left[1, 300:600])


INCLINES = {
    "fel": lambda learner: HEADING_GAIN * learner.rows["scale"][0, 0] * learner.weights[0, -4:-2],
    "rls": lambda learner: learner.rows["theta"][0, FEATURES:, 0],
    "mrac": lambda learner: learner.rows["b"][0, FEATURES:, 0],
    "composite": lambda learner: learner.rows["a"][0, 0, FEATURES:REGRESSORS],
}
"""Voltage that a learner has for the cosine and the sine of the heading."""


SLOPE = Scenario(laps=8, prior="model", perturbation=Perturbation(slope=0.1), initial_spread=(0, 0, 0))


@pytest.fixture(scope="module")
def sloping():
    """The model alone on the slope."""
    return simulate([SLOPE.replace(learner="none")])


@pytest.mark.parametrize("learner", INCLINES)
def test_slope(learner, sloping):
    """On a slope it finds gravity along the robot, and the errors fall below those of the model, which has no slope.

    The lemniscate begins at 45°, from which the heading of a learner counts: the voltage of gravity at an angle θ
    from there is M g sin α r/(2 K_m) cos(θ + 45°), with the stall torque K_m of a drive per volt.
    """
    simulation = Simulation([SLOPE.replace(learner=learner)])
    while simulation.running:
        simulation.step()
    robot, found = simulation.plant.robot, INCLINES[learner](simulation.hierarchy.learner)
    gravity = robot.mass * robot.gravity * np.sin(0.1) * robot.wheel_radius / 2 / robot.motor_gain
    np.testing.assert_allclose(found, gravity * np.sqrt(0.5) * np.array([1, -1]), rtol=0.1)
    learning, without = (
        per_lap(run)[["v_rmse", "position_rmse"]].isel(run=0, lap=-1).to_array().values
        for run in (simulation.result(), sloping)
    )
    assert (learning < np.multiply([0.8, 0.9], without)).all(), (learning, without)


def test_too_small_a_bound():
    """A network at the bound of its weights helps less, but does not talk the PID out of what it holds."""
    fel = Fel(step=0.1, weight_bound=7.0, output_scale=0.76)
    small = Scenario(**IDEAL | {"fel": fel}, laps=2, initial_spread=(0, 0, 0))
    bound, alone = per_lap(
        simulate([small, small.model_copy(update={"prior": "none", "learner": "none"})])
    ).position_rmse[:, 1]
    assert bound < alone
