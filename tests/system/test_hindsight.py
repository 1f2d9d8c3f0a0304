"""The best fixed feedforward in hindsight, against the true inverse dynamics and other feedforwards."""

import json
from functools import cache

import numpy as np
import pytest
import xarray as xr

from mrctl import (
    FEEDFORWARDS,
    PERTURBATIONS,
    Circle,
    Lemniscate,
    Perturbation,
    Pid,
    Scenario,
    Sensing,
    Sweep,
    cli,
    per_lap,
    replicates,
    simulate,
)
from mrctl.control.features import feature_matrix
from mrctl.loop.hindsight import REPETITIONS, best_fixed, drive
from mrctl.loop.simulation import Simulation
from mrctl.results.metrics import over_laps
from mrctl.sweep import jobs
from mrctl.sweep.store import Store

pytestmark = pytest.mark.xdist_group("hindsight")  # what its tests share is made once

IDEAL = Sensing(tier="ideal")
BASE = Scenario(sensing=IDEAL, reference=Lemniscate(period=12), laps=2, perturbation=PERTURBATIONS["all"])


@cache
def first(*group: Scenario) -> tuple[xr.Dataset, np.ndarray]:
    """The first drive of a group, which several tests share: that of `simulate`."""
    return drive(group, None)


def test_finds_the_true_inverse_dynamics():
    """Along the lap its voltage is that of the robot as it is, of which it was told nothing, to 2 % of the swing."""
    group = [BASE.model_copy(update=FEEDFORWARDS["model"])]
    _, found = drive(group, first(*group)[1])
    truth = Simulation([BASE.model_copy(update=FEEDFORWARDS["true_model"])]).hierarchy.prior.rows
    _, twist, acceleration = BASE.reference.sample(np.linspace(0, 12, 400))
    x = feature_matrix(twist, acceleration, truth["half_track"], np.ones((1, 8)))
    mine, true = x @ found[0], x @ truth["c"][0]
    assert (np.sqrt(np.mean((mine - true) ** 2, axis=0)) < 0.02 * np.ptp(true, axis=0)).all()


def test_nothing_left_to_explain():
    """Driven again, the feedback is uncorrelated with the features: another repetition changes hardly a voltage."""
    group = [BASE.model_copy(update=FEEDFORWARDS["model"])]
    once = first(*group)[1]
    twice = drive(group, once)[1]
    again = drive(group, twice)[1]
    x = feature_matrix(*BASE.reference.sample(np.linspace(0, 12, 400))[1:], np.array([0.188]), np.ones((1, 8)))
    assert np.abs(x @ (again - twice)[0]).max() < 0.1 * np.abs(x @ (twice - once)[0]).max() + 0.02


def test_run_of_a_sweep_again(tmp_path, here, capsys):
    """`mrctl run STORE --run K` shows the run of the store, not a run with the feedforward of the scenario."""
    base = {"sensing": {"tier": "ideal"}, "reference": {"kind": "line", "length": 0.8}, "laps": 1, "learner": "none"}
    jobs.run(Sweep.from_dict({"base": base, "hindsight": True}), tmp_path / "store", 1)
    assert cli.main(["run", str(tmp_path / "store"), "--run", "0", "--json"]) == 0
    shown, stored = json.loads(capsys.readouterr().out)["laps"][-1], Store(tmp_path / "store").row(0)
    assert stored is not None and shown["position_rmse"] == stored["position_rmse"]


@pytest.mark.parametrize("steering", ["compliant", "rigid"])
def test_fit(steering):
    """The fit leaves the feedback less to do than the model and the true one.

    What is left of the position error is the side-slip of the tyres, the same for all, which errors may cancel.
    """
    for reference in (BASE.reference, Circle(radius=1.0, period=8.0)):
        group = [BASE.model_copy(update={"steering": steering, "reference": reference} | FEEDFORWARDS["model"])]
        true = [s.model_copy(update=FEEDFORWARDS["true_model"]) for s in group]
        drives = twice_fitted(group), first(*group)[0], simulate(true)
        fitted, model, known = (per_lap(one).isel(lap=1) for one in drives)
        for other in (model, known):
            assert (fitted.feedback_share.values < other.feedback_share.values).all()
            assert (fitted.position_rmse.values < 1.1 * other.position_rmse.values).all()


def test_starts_as_good_as_it_goes_on():
    """Whoever knows the robot knows it from the first second on: no integral of the nominal robot is in the way."""
    group = [BASE.replace(**FEEDFORWARDS["model"], initial_spread=(0, 0, 0))]
    true = simulate(group[0].replace(prior="true_model"))
    second = slice(0, round(1 / group[0].control_period))
    start, whole, model = (
        np.hypot(run.x - run.x_ref, run.y - run.y_ref).values.ravel()[part]
        for run, part in ((true, second), (true, slice(None)), (first(*group)[0], second))
    )
    assert start.max() < 1.05 * whole[second.stop :].max() and start.max() < model.max() / 4
    fitted = twice_fitted(group)
    assert np.hypot(fitted.x - fitted.x_ref, fitted.y - fitted.y_ref).values.ravel()[second].max() < model.max() / 4


def test_best_of_its_drives(monkeypatch):
    """Of the model and what is fitted each run has the better one; runs of two kinds keep their order.

    With 20 ms more delay than the controller knows the loop oscillates with the fitted coefficients.
    """
    plain = Scenario(sensing=Sensing(tier="lab"), reference=BASE.reference, laps=2, pid=Pid(retune=False))
    plants = Perturbation(control_delay=0.02), Perturbation(control_delay=0.02), BASE.perturbation
    runs = [
        s.replace(**FEEDFORWARDS["model"], perturbation=p) for s, p in zip(replicates(plain, 3), plants, strict=True)
    ]
    made = []
    with monkeypatch.context() as patch:
        patch.setattr("mrctl.loop.hindsight.drive", lambda *given: made.append(drive(*given)) or made[-1])
        chosen = best_fixed(runs)
    assert len(made) == 1 + REPETITIONS == 3
    drives = chosen, made[0][0], made[-1][0]
    assert np.array_equal(made[0][0].x, simulate(runs).x)
    best, model, fitted = (over_laps(per_lap(one), "position_rmse").values for one in drives)
    assert (model < 0.8 * fitted).tolist() == [True, True, False]
    assert (fitted < model).tolist() == [False, False, True]
    assert (best <= np.minimum(model, fitted)).all()
    two = [BASE, BASE.model_copy(update={"reference": Circle(radius=1.0, period=8.0)})]
    assert per_lap(best_fixed(two)).lap_time.values.tolist() == [12.0, 8.0]


def twice_fitted(group: list[Scenario]) -> xr.Dataset:
    """Returns the last of the drives that `best_fixed` chooses from."""
    return drive(group, drive(group, first(*group)[1])[1])[0]
