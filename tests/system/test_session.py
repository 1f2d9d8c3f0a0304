"""A session under way: what is done to it is kept, and the saved session runs again headless to the bit."""

import io

import numpy as np
import pandas as pd
import pytest

from mrctl import FEEDFORWARDS, Circle, Event, InputError, Perturbation, RoundedSquare, Scenario
from mrctl.control.features import FEATURE_NAMES
from mrctl.loop.runs import simulate
from mrctl.results.dataset import SIGNALS
from mrctl.results.excitation import alone, parameter_error
from mrctl.results.metrics import per_lap
from mrctl.sensing.tiers import Sensing
from mrctl.viewer.looks import Look
from mrctl.viewer.requests import changed
from mrctl.viewer.score import Metrics, lessons, one_lap
from mrctl.viewer.session import Session, pushed

BASE = Scenario(reference=Circle(period=4, radius=0.5), seed=3)


def drive(session, ticks):
    for _ in range(ticks):
        session.step()


def same(session, results):
    """Whether a session's record is that of results, as far as it goes."""
    log = session.log()
    for row, run in enumerate(results):
        again = np.array([run[name].values for name in SIGNALS]).T[: session.tick]
        assert again.tobytes() == np.ascontiguousarray(log[:, row]).tobytes()


@pytest.mark.parametrize("reference", [BASE.reference, RoundedSquare()], ids=lambda r: r.kind)
def test_saved_session(reference, tmp_path):
    """Payload, noise, delay, gains, push and the switch, at odd ticks, for three controllers; through a file."""
    scenarios = [
        BASE.model_copy(update={**FEEDFORWARDS[name], "reference": reference}) for name in ("fel", "none", "true_model")
    ]
    session = Session(scenarios)
    drive(session, 37)
    session.apply(perturbation=Perturbation(payload=6, payload_x=0.05, dead_zone=0.3))
    session.apply(push=(0.0, 30.0, 0.0))
    drive(session, 101)
    session.apply(learning=False)
    session.apply(kanayama=changed(session.state()["kanayama"], ["k_y"], 10.0))
    drive(session, 1)
    session.apply(perturbation=changed(session.state()["perturbation"], ["control_delay"], 0.02))
    session.apply(pid=changed(session.state()["pid"], ["time_constant"], 0.25))
    drive(session, 363)
    again = []
    for k, scenario in enumerate(session.saved()):
        path = tmp_path / f"{k}.toml"
        path.write_text(scenario.to_toml())
        again.append(Scenario.from_toml(path))
        assert again[-1] == scenario
    assert again[0].laps == np.ceil(5.02 / reference.period)
    results = simulate(again)  # the three of them; one alone goes through dm_control
    same(session, [results.isel(run=k) for k in range(3)])
    single = Session(scenarios[:1])
    drive(single, 20)
    single.apply(push=(20.0, 0.0, 0.0))
    drive(single, 60)
    same(single, [simulate(single.saved()[0])])


def test_refused_change():
    """What the robot or the scenario cannot do is refused in one line, and neither happens nor is kept."""
    session = Session([BASE])
    drive(session, 5)
    with pytest.raises(InputError, match="tip over"):
        session.apply(perturbation=Perturbation(payload=150, payload_x=-1))
    with pytest.raises(InputError, match="control_delay"):
        session.apply(perturbation=Perturbation(control_delay=0.0123))
    with pytest.raises(InputError, match="has passed"):
        session.simulations[0][1].add(_event(0.01))
    assert session.saved()[0].events == ()
    drive(session, 20)
    same(session, [simulate(session.saved()[0])])


def _event(time):
    return Event(time=time, push=(1.0, 0.0, 0.0))


def test_events_of_the_file():
    """What a scenario brings along happens too, and counts for what holds now."""
    base = BASE.model_copy(update={"events": (_event(0.1), Event(time=0.2, perturbation=Perturbation(payload=3)))})
    session = Session([base])
    drive(session, 15)
    session.apply(perturbation=Perturbation(supply_factor=0.8))
    assert session.state()["perturbation"].payload == 0
    drive(session, 10)
    assert session.state()["perturbation"].payload == 3
    same(session, [simulate(session.saved()[0])])


def test_stopped_robot():
    """A robot that has stopped leaves the others driving; its record ends in NaN."""
    weak = BASE.model_copy(
        update={"prior": "none", "learner": "none", "perturbation": Perturbation(supply_factor=0.05)}
    )
    session = Session([BASE, weak])
    drive(session, 1500)
    assert "lateral error" in session.failure(1) and session.failure(0) == ""
    log = session.log(1400)
    assert session.running
    for name in SIGNALS:
        assert np.isnan(log[name][:, 1]).all(), name
        assert name.startswith("fix_") or np.isfinite(log[name][:, 0]).all(), name  # no fix is NaN
    session.apply(push=(0.0, 5.0, 0.0))
    session.step()


def test_must_share():
    with pytest.raises(InputError, match="world"):
        Session([BASE, BASE.model_copy(update={"world": "patch"})])


def test_new_reference():
    """Another course from a moment on, added under way and brought along by the file, over a boundary of blocks."""
    session = Session([BASE, BASE.model_copy(update={"prior": "none", "learner": "none"})])
    drive(session, 200)
    event = Event(time=2.5, reference=Circle(radius=0.5, period=5.0, clockwise=True))
    for _, simulation in session.simulations:
        simulation.add(event)
    drive(session, 300)
    results = simulate(session.saved())
    same(session, [results.isel(run=k) for k in range(2)])
    assert abs(results.omega_ref.values[0, 240] - 2 * np.pi / 4) < 1e-9
    assert abs(results.omega_ref.values[0, 260] + 2 * np.pi / 5) < 1e-9


def test_reference_within_the_delay():
    """The controllers are told the reference of the time at which their voltage acts: it cannot change before that."""
    session = Session([BASE, BASE.model_copy(update={"sensing": Sensing(tier="field")})])
    drive(session, 10)
    late, other = session.simulations[1][1], Circle(radius=0.6, period=5.0)
    assert late.preview == session.preview > session.simulations[0][1].preview > 0
    with pytest.raises(InputError, match=r"time: a reference must be known 0.0\d s before"):
        late.add(Event(time=0.1, reference=other))
    session.apply(reference=other)
    assert [s.events[0].tick(0.01) for s in session.saved()] == [10 + session.preview] * 2
    drive(session, 100)
    results = simulate(session.saved())
    same(session, [results.isel(run=k) for k in range(2)])


def test_blocks(monkeypatch):
    """References sampled in blocks of any length are the same."""
    event = Event(time=1.3, reference=Circle(radius=0.5, period=5.0))
    scenarios = [
        BASE.model_copy(update={"events": (event,)}),
        BASE.model_copy(update={"reference": Circle(radius=0.6, period=4)}),
    ]
    whole = simulate(scenarios)
    monkeypatch.setattr("mrctl.loop.courses.SAMPLED_TICKS", 97)
    parts = simulate(scenarios)
    for name in ("x_ref", "omega_ref", "x", "voltage_left"):
        assert parts[name].values.tobytes() == whole[name].values.tobytes()


def test_what_is_learned():
    """What a session says of coefficients and of a lap is what a result of the same run says; the network has none."""
    scenarios = [
        Scenario(laps=1, prior="model", learner="rls", perturbation=Perturbation(mass_factor=1.5)),
        Scenario(laps=1, learner="fel"),
    ]
    session, single = Session(scenarios), simulate(scenarios[:1])
    drive(session, single.sizes["time"])
    error, expected = session.parameter_error(), parameter_error(single).values[0]
    assert error is not None and np.array_equal(error[0], expected) and np.isnan(error[1]).all()
    assert abs(expected).max() > 0.1 and Session(scenarios[1:]).parameter_error() is None
    laps = [one_lap(session.log(), session.period, session.robot)]
    robots = [Look("A & B", (1, 2, 3)), Look("fel", (4, 5, 6))]
    excited, common, difference = pd.read_html(
        io.StringIO(lessons(robots, laps, False, error, "now")), header=0, index_col=0
    )
    assert [*excited.index] == [*common.index] == [*FEATURE_NAMES] and [*excited.columns] == ["A & B", "fel"]
    motion = single.isel(run=0)
    twist = np.stack([motion.v_command.values, motion.omega_command.values], -1)
    there = alone(twist, session.period, motion.half_track.values, motion.feature_scale.values)
    assert excited["A & B"].values == pytest.approx(there, rel=0.06)
    for table, k in ((common, 0), (difference, 1)):
        assert table["A & B"].astype(float).values == pytest.approx(expected[:, k], rel=0.06)
        assert (table["fel"] == "–").all()


def test_laps_of_a_score():
    """They are those of a result, also where a lap is no whole number of control periods."""
    scenario = Scenario(learner="none", laps=4, reference=Circle(period=3.0066, radius=0.4))
    result = simulate(scenario)
    session = Session([scenario])
    drive(session, result.sizes["time"])
    metrics = Metrics(session.robot, session.period)
    metrics.update(session.saved(), session.log, session.tick)
    found = [lap["position_rmse"][0] for lap in metrics.laps]
    assert np.array_equal(found, per_lap(result)["position_rmse"].values[0])


def test_arrow_of_overlapping_pushes():
    """The arrow shows the force that the plant applies: the sum of the pushes that act."""
    pushes = [
        Event(time=0.5, push=(10.0, 0.0, 0.0), push_duration=2.0),
        Event(time=1.0, push=(0.0, 5.0, 1.0), push_duration=1.0),
    ]
    scenario = BASE.replace(events=tuple(pushes))
    session = Session([scenario])
    drive(session, 130)
    ((_, sim),) = session.simulations
    assert np.array_equal(pushed(scenario, session.time), [10.0, 5.0])
    assert np.array_equal(sim.plant.wrench[0].sum(axis=0)[:2], [10.0, 5.0])
    assert pushed(scenario, 0.4) is None and np.array_equal(pushed(scenario, 2.4), [10.0, 0.0])
