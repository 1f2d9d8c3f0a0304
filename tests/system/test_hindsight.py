"""The best fixed feedforward in hindsight, against the true inverse dynamics and other feedforwards."""

import numpy as np
import pytest

from mrctl import FEEDFORWARDS, PERTURBATIONS, Circle, Lemniscate, Scenario, Sensing, per_lap, simulate
from mrctl.control.features import feature_matrix
from mrctl.experiments.hindsight import best_fixed, drive
from mrctl.loop.simulation import Simulation

IDEAL = Sensing(tier="ideal")
BASE = Scenario(sensing=IDEAL, reference=Lemniscate(period=12), laps=2, perturbation=PERTURBATIONS["all"])


def test_finds_the_true_inverse_dynamics():
    """Along the lap its voltage is that of the robot as it is, of which it was told nothing, to 2 % of the swing."""
    group = [BASE.model_copy(update=FEEDFORWARDS["model"])]
    _, found = drive(group, drive(group, None)[1])
    truth = Simulation([BASE.model_copy(update=FEEDFORWARDS["true_model"])]).hierarchy.prior.rows
    _, twist, acceleration = BASE.reference.sample(np.linspace(0, 12, 400))
    x = feature_matrix(twist, acceleration, truth["half_track"], np.ones((1, 8)))
    mine, true = x @ found[0], x @ truth["c"][0]
    assert (np.sqrt(np.mean((mine - true) ** 2, axis=0)) < 0.02 * np.ptp(true, axis=0)).all()


def test_nothing_left_to_explain():
    """Driven again, the feedback is uncorrelated with the features: another repetition changes hardly a voltage."""
    group = [BASE.model_copy(update=FEEDFORWARDS["model"])]
    once = drive(group, None)[1]
    twice = drive(group, once)[1]
    again = drive(group, twice)[1]
    x = feature_matrix(*BASE.reference.sample(np.linspace(0, 12, 400))[1:], np.array([0.188]), np.ones((1, 8)))
    assert np.abs(x @ (again - twice)[0]).max() < 0.1 * np.abs(x @ (twice - once)[0]).max() + 0.02


@pytest.mark.parametrize("steering", ["compliant", "rigid"])
def test_bound(steering):
    """It leaves the feedback less to do than the model and the true one; runs of two kinds keep their order.

    What is left of the position error is the side-slip of the tyres, the same for all, which errors may cancel.
    """
    runs = [
        BASE.model_copy(update={"steering": steering}),
        BASE.model_copy(update={"steering": steering, "reference": Circle(radius=1.0, period=8.0)}),
    ]
    best, model, true = (
        per_lap(result).isel(lap=1)
        for result in (
            best_fixed(runs),
            *(simulate([s.model_copy(update=FEEDFORWARDS[f]) for s in runs]) for f in ("model", "true_model")),
        )
    )
    for other in (model, true):
        assert (best.feedback_share.values < other.feedback_share.values).all()
        assert (best.position_rmse.values < 1.1 * other.position_rmse.values).all()
    assert best.lap_time.values.tolist() == [12.0, 8.0]
