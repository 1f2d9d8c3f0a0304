"""Motor driver, battery and steering servo in the loop: the controller is told of the current limit; events; bits."""

import numpy as np
import pytest

from mrctl import FEEDFORWARDS, PERTURBATIONS, Circle, Event, Guard, Lemniscate, Perturbation, Scenario, simulate
from mrctl.experiments.paper import IDEAL
from mrctl.loop.simulation import Simulation
from mrctl.results.dataset import SIGNALS

ROUGH = Perturbation(
    dead_zone=0.4, pwm_steps=200, current_limit=2.5, battery_resistance=0.2, steering_offset=0.01,
    steering_backlash=0.02, left_motor_constant_factor=0.95, right_resistance_factor=1.1,
    left_drive_friction_factor=1.4, control_delay=0.02,
)  # fmt: skip
BASE = Scenario(**IDEAL, reference=Circle(period=4, radius=0.6), laps=1)


def limited(feedforward, amperes, period, laps, seeds, told, guard=False):
    """Runs the perturbation `all` with a current limit; where the controller is not told, its sensors show no loss.

    Returns:
        The position errors of the last lap in mm, infinite for a robot that is lost, and the shares of time in which
        the guard acts, one a seed.
    """
    perturbation = PERTURBATIONS["all"].model_copy(update={"current_limit": amperes})
    scenario = Scenario(
        **IDEAL, reference=Lemniscate(period=period), laps=laps, **FEEDFORWARDS[feedforward], perturbation=perturbation,
        guard=Guard(on=guard),
    )  # fmt: skip
    simulation = Simulation([scenario.model_copy(update={"seed": seed}) for seed in seeds])
    while simulation.running:
        simulation.step()
        if not told:
            simulation.plant.state["lost"] = 0.0
    result = simulation.result()
    last = result.isel(time=slice(-round(period / 0.01), None))
    error = 1e3 * np.sqrt(((last.x - last.x_ref) ** 2 + (last.y - last.y_ref) ** 2).mean("time").values)
    current = np.maximum(np.abs(result.current_left), np.abs(result.current_right)).max("time")
    assert guard or (np.abs(current - amperes) < 1e-9).all()  # the limit is reached, and holds
    return np.where(result.failed, np.inf, error), (result.guard > 0).mean("time").values


def test_least_squares_under_a_limit():
    """2.2 A are too few for the first lap of `rls`. Not told, it learns from voltages that never acted, and is lost."""
    untold, _ = limited("rls", 2.2, 10.0, 4, range(5), told=False)
    assert untold.max() > 15
    told, _ = limited("rls", 2.2, 10.0, 4, range(5), told=True)
    assert told.max() < 1.5
    _, guarded = limited("rls", 2.2, 10.0, 4, range(5), told=True, guard=True)
    assert guarded.max() < 0.05


@pytest.mark.parametrize("feedforward", ["none", "fel"])
def test_hard_limit(feedforward):
    """A lap that needs 1.5 A with 1.3 A: who is told tracks twice as well in the end, and is left alone."""
    untold, _ = limited(feedforward, 1.3, 12.0, 3, [0], told=False)
    told, _ = limited(feedforward, 1.3, 12.0, 3, [0], told=True)
    assert told < untold / 2
    assert limited(feedforward, 1.3, 12.0, 3, [0], told=True, guard=True) == (told, 0)


def test_hard_limit_with_predictions():
    """`composite` need not be told: the median error is the same within a tenth, and the guard leaves it alone.

    Of six robots, because the error of a single one differs by up to a fifth between seeds where it is not told.
    """
    untold, _ = limited("model+composite", 1.3, 12.0, 3, range(6), told=False)
    told, guarded = limited("model+composite", 1.3, 12.0, 3, range(6), told=True, guard=True)
    assert np.median(told) == pytest.approx(np.median(untold), rel=0.1) and told.max() < 3.5
    assert not guarded.any()


def same(one, other):
    """Whether two runs have the same bits in every signal."""
    return all(np.array_equal(one[name].values, other[name].values, equal_nan=True) for name in SIGNALS)


@pytest.mark.parametrize("steering", ["compliant", "caster", "rigid"])
def test_alone_and_in_a_batch(steering):
    """With every effect on, a robot has the same bits alone, beside others, and where the effects begin as an event."""
    base = BASE.model_copy(update={"steering": steering})
    rough = base.model_copy(update={"perturbation": ROUGH})
    late = base.model_copy(
        update={"events": (Event(time=1.0, perturbation=ROUGH), Event(time=2.5, perturbation=Perturbation()))}
    )
    at_once = base.model_copy(update={"events": (Event(time=0.0, perturbation=ROUGH),)})
    runs = simulate([base, rough, late, at_once, rough.model_copy(update={"seed": 1})])
    for row, scenario in enumerate((base, rough, late, at_once)):
        assert same(simulate(scenario), runs.isel(run=row))
    plain, rough, late, at_once = (runs.isel(run=row) for row in range(4))
    assert same(rough, at_once)
    before = slice(0, 100)
    assert same(late.isel(time=before), plain.isel(time=before))
    assert not np.array_equal(late.v[110:], plain.v[110:])


def test_event_in_the_driver():
    """A limit that comes and goes as an event acts from its tick to its end, on the motors of that robot alone."""
    hard = PERTURBATIONS["all"].model_copy(update={"current_limit": 1.0})
    events = (Event(time=1.0, perturbation=hard), Event(time=2.0, perturbation=PERTURBATIONS["all"]))
    base = BASE.model_copy(update={"perturbation": PERTURBATIONS["all"], "prior": "model", "learner": "none"})
    runs = simulate([base, base.model_copy(update={"events": events})])
    plain, changed = (
        np.maximum(abs(run.current_left), abs(run.current_right)).values for run in (runs[{"run": 0}], runs[{"run": 1}])
    )
    assert plain.max() > 1.1 and np.array_equal(plain[:100], changed[:100])
    assert changed[100:200].max() == pytest.approx(1.0) and changed[200:].max() > 1.1


def test_power():
    """The power of a result is that at the terminals, after the limit: what the shafts get, k_E N ω i, and heat."""
    perturbation = Perturbation(current_limit=0.6, battery_resistance=0.2)
    result = simulate(BASE.model_copy(update={"perturbation": perturbation, "prior": "none", "learner": "none"}))
    assert float(np.abs(result.current_left).max()) == pytest.approx(0.6)
    rates = result.wheel_rate_left.values[1:], result.wheel_rate_right.values[1:]
    currents = result.current_left.values[:-1], result.current_right.values[:-1]
    shaft = sum(43 * 0.0234 * rate * i for rate, i in zip(rates, currents, strict=True))
    heat = sum(2.32 * i**2 for i in currents)
    assert result.power.values[:-1] == pytest.approx(shaft + heat, rel=1e-9, abs=1e-9)
