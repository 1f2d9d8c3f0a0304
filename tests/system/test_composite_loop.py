"""`composite` and `observer` in the loop: ahead of the model where it is wrong, not behind where it is right."""

import numpy as np
import pytest

from mrctl import (
    FEEDFORWARDS,
    PERTURBATIONS,
    Event,
    Lemniscate,
    Observer,
    Perturbation,
    Pid,
    Scenario,
    per_lap,
    replicates,
)
from mrctl.experiments.paper import IDEAL
from mrctl.loop.runs import simulate

pytestmark = pytest.mark.xdist_group("composite_loop")  # what its tests share is made once

LAP = 12.0
NAMES = ("model", "true_model", "model+observer", "rls", "model+composite")
METRICS = ("v_rmse", "omega_rmse", "position_rmse")


def scenario(name, case, **changes):
    """Three laps of the benchmark."""
    return Scenario(
        **IDEAL,
        reference=Lemniscate(period=LAP),
        laps=3,
        **FEEDFORWARDS[name],
        perturbation=case,
        initial_spread=(0, 0, 0),
    ).model_copy(update=changes)


@pytest.fixture(scope="module")
def errors():
    """Metrics of the third lap by case and feedforward, `(3,)`."""
    keys = [(case, name) for case in ("nominal", "all") for name in NAMES]
    result = simulate([scenario(name, PERTURBATIONS[case]) for case, name in keys])
    assert not result.failed.any()
    laps = per_lap(result).isel(lap=2)
    return {key: np.array([float(laps[metric][k]) for metric in METRICS]) for k, key in enumerate(keys)}


def test_headline(errors):
    """At most 1.1 times the model where that is right, at most 1.15 times the true one where not, ahead of `rls`.

    After three laps of the eight in the tables.
    """
    assert (errors["nominal", "model+composite"] <= 1.1 * errors["nominal", "model"]).all()
    assert (errors["all", "model+composite"] <= 1.15 * errors["all", "true_model"] + [0, 5e-3, 0]).all()
    assert (errors["all", "model+composite"] < 0.5 * errors["all", "model"]).all()
    assert (errors["all", "model+composite"] < errors["all", "rls"]).all()
    assert (errors["nominal", "model+composite"] < errors["nominal", "rls"]).all()


def test_observer(errors):
    """Without learning it halves the model's position error under `all`, and costs nothing where the model is right."""
    assert (errors["nominal", "model+observer"] <= errors["nominal", "model"]).all()
    assert errors["all", "model+observer"][2] < 0.5 * errors["all", "model"][2]


def test_slope():
    """No function of the motion explains a slope: features of the heading do.

    To half of what the observer leaves, and to a third of what one leaves that has a margin behind 40 ms of delay.
    """
    uphill, slow = Perturbation(slope=0.17), Observer(time_constant=0.15)
    runs = [
        scenario("model+observer", uphill), scenario("model+observer", uphill, observer=slow),
        scenario("model+composite", uphill),
    ]  # fmt: skip
    quick, wary, learned = per_lap(simulate(runs)).isel(lap=2).position_rmse.values
    assert learned < quick / 2 and learned < wary / 3


def test_unknown_delay():
    """It bears 20 ms in `lab` that nobody knows, nearly as the model does; with the paper's settings it oscillates.

    That is so without the watch on the velocity loop, which ends most of it.
    """
    unwatched = Pid(retune=False)
    late = Scenario(laps=3, **FEEDFORWARDS["model"], perturbation=Perturbation(control_delay=0.02), pid=unwatched)
    learning = late.replace(learner="composite")
    eager = learning.replace(composite=IDEAL["composite"])
    cases = late, learning, eager, eager.replace(pid=Pid())
    last = per_lap(simulate([run for case in cases for run in replicates(case, 4)])).isel(lap=-1)
    turn, position = (last[name].values.reshape(4, 4).mean(axis=1) for name in ("omega_rmse", "position_rmse"))
    assert turn[1] < 3 * turn[0] and position[1] < 1.2 * position[0]
    assert turn[2] > 5 * turn[1] and position[2] > 1.3 * position[1]
    assert turn[3] < turn[2] / 2 and position[3] < position[2]


@pytest.fixture(scope="module")
def steps():
    """Errors lap by lap of runs in which something changes in lap 5 and back in lap 9, `(lap, 3)`."""
    names = ("mass +50 %", "supply -20 %", "payload aside", "left tyre on ice")
    runs = []
    for name in names:
        events = (
            Event(time=4 * LAP, perturbation=PERTURBATIONS[name]), Event(time=8 * LAP, perturbation=Perturbation()),
        )  # fmt: skip
        runs.append(scenario("model+composite", Perturbation(), laps=12, events=events))
    laps = per_lap(simulate(runs))
    return dict(zip(names, np.stack([laps[metric].values for metric in METRICS], axis=-1), strict=True))


def test_recovery(steps):
    """Within one lap of a change the errors are near those at which they settle, and on return they are as before."""
    for error in (steps[name] for name in ("mass +50 %", "supply -20 %", "payload aside")):
        assert (error[5] < np.array([1.2, 1.35, 1.15]) * error[7]).all()
        assert error[7, 2] < 1.3 * error[3, 2]
        assert (error[9] < 1.05 * error[3]).all()


def test_slip_teaches_nothing(steps):
    """While a wheel on ice slips the weights stand still; the error is near the model's, and then that of before."""
    ice = (Event(time=2 * LAP, perturbation=PERTURBATIONS["left tyre on ice"]),)
    result = simulate([scenario(name, Perturbation(), laps=4, events=ice) for name in ("model+composite", "model")])
    mine = result.isel(run=0)
    assert float(mine.slip[: 2 * 1200].max()) < 0.05
    slips = mine.slip.values > 0.1
    assert 0.05 < slips[2 * 1200 :].mean() < 0.5
    still = np.diff(mine.weight_norm.values, prepend=np.nan) == 0
    assert still[slips].mean() > 0.99 and still[~slips][1200:].mean() < 0.3  # a norm is logged a tick late
    error = steps["left tyre on ice"]
    assert error[5:8, 2].max() < 1.1 * float(per_lap(result).position_rmse[1, 3])
    assert (error[11] < 1.05 * error[3]).all()


@pytest.mark.parametrize("steering", ["caster", "rigid"])
def test_alone_or_together(steering):
    """A robot of a batch is the same scenario run alone, bit for bit, through a change of the plant and its return."""
    change = Event(time=5.0, perturbation=PERTURBATIONS["all"]), Event(time=7.0, perturbation=Perturbation())
    some = [
        scenario(name, Perturbation(dead_zone=0.2 * seed), steering=steering, laps=1, events=change, seed=seed)
        for name in ("model+composite", "model+observer") for seed in range(2)
    ]  # fmt: skip
    together = simulate(some)
    for i in (1, 2):
        alone = simulate(some[i])
        for name in ("x", "omega", "voltage_left", "steering_angle", "weight_norm"):
            assert np.array_equal(alone[name], together[name][i]), name
