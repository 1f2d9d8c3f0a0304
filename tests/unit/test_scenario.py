"""Scenarios: invalid values, files, what a simulation refuses, and the order and length of its results."""

import json
import tomllib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mrctl import Composite, Event, Fel, Kanayama, Observer, Perturbation, Pid, Rls, Scenario
from mrctl.control.feedforward import Loop, NoLearner
from mrctl.loop.runs import simulate
from mrctl.record import InputError, is_whole
from mrctl.scenario import MAX_TICKS, replicates
from mrctl.sensing.tiers import Sensing
from mrctl.theory.perturbation import REPLICATE_HALF_WIDTHS
from mrctl.theory.references import Circle, LaneChange, Lemniscate, Line, RoundedSquare, StopAndGo, Waypoints

values = (
    st.none() | st.booleans() | st.integers() | st.floats() | st.floats(0, 1) | st.text(max_size=5)
    | st.sampled_from(["flat", "rigid", "fel", "truth", [], {}, [0.1, 0.2, 0.3], [{}], [{"time": 1}]])
)  # fmt: skip
PARTS = {
    "kanayama": Kanayama,
    "pid": Pid,
    "fel": Fel,
    "rls": Rls,
    "observer": Observer,
    "composite": Composite,
    "perturbation": Perturbation,
    "events": Event,
}
parts = st.sampled_from(
    [(name,) for name in Scenario.model_fields]
    + [(part, name) for part, kind in PARTS.items() for name in kind.model_fields]
)


def refused(name: str, source: object) -> None:
    """The source is refused with one line that begins with the field."""
    with pytest.raises(InputError) as error:
        Scenario.from_dict(source)
    message = str(error.value)
    assert message.startswith(name) and "\n" not in message, message


@given(parts, values)
@settings(max_examples=300)
def test_nonsense(path, value):
    """A random value in any field is valid, or is refused with one line that names the field."""
    *where, name = path
    if where == ["events"]:
        source = {"events": [{"time": 0.0, "learning": True, "push": (0, 0, 0), name: value}]}
    elif where:
        source = {where[0]: {name: value}}
    else:
        source = {name: value}
    try:
        scenario = Scenario.from_dict(source)
    except InputError as error:
        message = str(error)
        assert "\n" not in message
        fields = {"control_period": ("motion_period", "control_period"), "physics_step": ("control_period",)}
        expected = ".".join(path).replace("events.", "events.0.")
        assert message.startswith((expected, *(fields.get(name, ())), "laps")), message
    else:
        assert 1 <= scenario.ticks <= MAX_TICKS
        assert Scenario.from_dict(json.loads(scenario.model_dump_json())) == scenario


@given(st.dictionaries(st.text(max_size=8), values, min_size=1, max_size=3))
def test_unknown(source):
    """Unknown fields are refused."""
    if source.keys() <= Scenario.model_fields.keys():
        return
    with pytest.raises(InputError):
        Scenario.from_dict(source)


@pytest.mark.parametrize(
    ("name", "source"),
    [
        ("speed", {"speed": 1}),
        ("reference.circle.size", {"reference": {"kind": "circle", "size": 1}}),
        ("reference", {"reference": {"kind": "ellipse"}}),
        ("reference", {"reference": {"radius": 1}}),
        ("events.1.push", {"events": [{"time": 1, "learning": False}, {"time": 2, "push": [1, 2]}]}),
        ("events.0.what", {"events": [{"time": 1, "what": 2}]}),
        ("perturbation.mass", {"perturbation": {"mass": 2}}),
        ("laps", {"laps": 0}),
        ("seed", {"seed": -1}),
        ("initial_spread.2", {"initial_spread": [0, 0, 9]}),
        ("initial_pose.x", {"initial_pose": [float("nan"), 0, 0]}),
        ("events.0: changes nothing", {"events": [{"time": 1, "push_duration": 5}]}),
        ("perturbation.supply_factor", {"perturbation": {"supply_factor": 1e-3}}),
        ("mrac.noise", {"mrac": {"noise": 1e-200}}),
        ("fel.output_scale", {"fel": {"output_scale": 1e-300}}),
        ("reference.lane_change.length", {"reference": {"kind": "lane_change", "length": 1e-110}}),
        ("laps: a run of", {"reference": {"kind": "line", "length": 1e-3, "speed": 9}, "laps": 1}),
        ("laps: a run of", {"reference": {"kind": "circle", "period": 3600}, "laps": 10_000}),
    ],
)
def test_refused(name, source):
    """An invalid value is refused with the path of its field."""
    refused(name, source)


@pytest.mark.parametrize(
    ("name", "source"),
    [
        ("control_period", {"control_period": 0.011}),
        ("control_period", {"control_period": 0.01, "physics_step": 0.003}),
        ("control_period", {"control_period": 0.001, "physics_step": 0.002}),
        ("motion_period", {"motion_period": 0.015}),
        ("motion_period", {"motion_period": 0.005}),
        ("perturbation.control_delay", {"perturbation": {"control_delay": 0.015}}),
        (
            "events.1.perturbation.control_delay",
            {"events": [{"time": 0, "learning": True}, {"time": 1, "perturbation": {"control_delay": 0.004}}]},
        ),
    ],
)
def test_multiples(name, source):
    """A period that is not a whole multiple of the shorter one is refused by its name."""
    refused(name, source)


@given(st.integers(0, 10**6), st.floats(1e-5, 1))
def test_whole(count, unit):
    """`is_whole` takes multiples despite rounding, and refuses halves."""
    assert is_whole(count * unit / unit) and is_whole(count * unit * (1 / unit))
    assert not is_whole((count + 0.5) * unit / unit)


def test_one_rule_of_whole_periods():
    """A delay that is a whole number of periods to 1 ppm is one in the sensing and in a perturbation."""
    for value, fine in ((0.010000005, True), (0.0101, False)):
        for source in ({"sensing": {"delay": value}}, {"perturbation": {"control_delay": value}}):
            if fine:
                Scenario.from_dict(source)
            else:
                with pytest.raises(InputError, match="0.0101 s is not a whole multiple of control_period"):
                    Scenario.from_dict(source)


def test_rates():
    """Periods that are multiples up to the rounding of decimal fractions are accepted."""
    late = Perturbation(control_delay=0.021)
    scenario = Scenario(physics_step=0.001, control_period=0.007, motion_period=0.049, perturbation=late)
    assert scenario.ticks == round(96 / 0.007)


# --- files ----------------------------------------------------------------------------------------------------------


def toml(value: object) -> str:
    """Writes a value as inline TOML."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key} = {toml(item)}" for key, item in value.items() if item is not None) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(toml(item) for item in value) + "]"
    return json.dumps(value)


FULL = Scenario(
    name="grünes Licht",
    world="patch",
    steering="rigid",
    reference=Waypoints(points=((0, 0), (1, 0), (1, 1))),
    laps=3,
    learner="rls",
    sensing=Sensing(tier="field", estimator="odometry", gyro_noise=1e-3),
    kanayama=Kanayama(k_x=2.5),
    pid=Pid(time_constant=0.3),
    fel=Fel(hidden=3, weights="w.safetensors", frozen=True),
    rls=Rls(drift=0),
    perturbation=Perturbation(mass_factor=1.1, control_delay=0.03),
    events=(
        Event(time=1.25, perturbation=Perturbation(payload=3.3)),
        Event(time=2, push=(1, 2.5, -3), push_duration=0.25),
        Event(time=3, kanayama=Kanayama(), pid=Pid(), learning=False),
    ),
    initial_pose=(0.1, 0.2, 0.3),
    initial_spread=(0, 0, 0),
    seed=7,
    prefilter=0.07,
    physics_step=0.001,
    motion_period=0.02,
)
KINDS = (
    Line(),
    Circle(clockwise=True),
    Lemniscate(size=2),
    LaneChange(),
    RoundedSquare(),
    StopAndGo(pause=0),
    Waypoints(),
)


@pytest.mark.parametrize("reference", KINDS, ids=lambda reference: reference.kind)
@pytest.mark.parametrize("base", [Scenario(), FULL], ids=["default", "full"])
def test_toml(base, reference, tmp_path):
    """A scenario with events and any reference survives TOML and JSON, to the last bit."""
    scenario = base.model_copy(update={"reference": reference})
    file = tmp_path / "scenario.toml"
    values = scenario.model_dump(mode="json", exclude_none=True)
    file.write_text("\n".join(f"{name} = {toml(value)}" for name, value in values.items()))
    assert tomllib.loads(file.read_text())["laps"] == scenario.laps
    assert Scenario.from_toml(file) == scenario
    assert Scenario.from_dict(json.loads(scenario.model_dump_json())) == scenario


def test_bad_file(tmp_path):
    """A bad file is refused with one line that names the file and the field."""
    file = tmp_path / "scenario.toml"
    for text, words in (("laps = 0", "laps"), ("laps = ", "not TOML"), ("[[events]]\ntime = -1", "events.0.time")):
        file.write_text(text)
        with pytest.raises(InputError) as error:
            Scenario.from_toml(file)
        assert str(error.value).startswith(str(file)) and words in str(error.value) and "\n" not in str(error.value)


# --- what a simulation refuses --------------------------------------------------------------------------------------


def test_nothing():
    """A simulation without scenarios is refused."""
    with pytest.raises(InputError, match="^scenarios: none"):
        simulate([])


FAR_AWAY = Waypoints(points=((8, 0), (10, 0), (9, 2)))


@pytest.mark.parametrize(
    ("words", "changes"),
    [
        ("^world: no file", {"world": "moon"}),
        ("^initial_pose: 5.00 m from the start", {"initial_pose": (3.0, 4.0, 0.0)}),
        ("^initial_spread: 0.89 m from the start", {"initial_spread": (0.2, 0.2, 0.0), "seed": 755}),
        ("^initial_pose: there is no ground", {"world": "rough", "reference": FAR_AWAY}),
        ("^reference line: speed 2 m/s .*max_speed", {"reference": Line(speed=2)}),
        ("^reference circle: rotation", {"reference": Circle(period=1.9, radius=0.2)}),
        ("^reference circle: steering angle", {"reference": Circle(period=9, radius=0.1)}),
        ("^reference stop_and_go: reverses .*rigid", {"reference": StopAndGo(reverse=True)}),
        ("^reference stop_and_go: reverses .*rigid", {"reference": StopAndGo(reverse=True), "steering": "caster"}),
        ("^fel.weights: no file none.safetensors", {"fel": Fel(weights="none.safetensors")}),
        ("^perturbation.payload: .*tip over", {"perturbation": Perturbation(payload=30, payload_x=-1)}),
    ],
)
def test_simulation_refuses(words, changes):
    """A scenario that cannot run is refused before anything is computed, also as the last of several."""
    good = Scenario(reference=Circle(period=4, radius=0.5), laps=200, initial_spread=(0, 0, 0))
    bad = Scenario.from_dict(good.model_dump() | {"laps": 1} | changes)
    for scenarios in (bad, [good, bad]):
        with pytest.raises(InputError, match=words) as error:
            simulate(scenarios)
        assert "\n" not in str(error.value)


def test_simulation_validates():
    """A copy that was not validated is refused before anything runs."""
    with pytest.raises(InputError, match="^learner: "):
        simulate(Scenario().model_copy(update={"learner": "pid"}))


def test_mixed_rates():
    """Runs of one result need the same control period."""
    with pytest.raises(InputError, match="^control_period"):
        simulate([Scenario(), Scenario(control_period=0.02, motion_period=0.02)])


def test_reverse_if_rigid():
    """The rigid steering drives backwards."""
    run = simulate(Scenario(reference=StopAndGo(distance=0.3, move_time=1.5, pause=0.2), laps=1, steering="rigid"))
    assert run.v.min() < -0.1 and not run.failed


# --- results --------------------------------------------------------------------------------------------------------


def test_order():
    """Runs of different kinds and lengths keep the order of their scenarios; shorter ones end in NaN."""
    kinds = (
        ("fel", "rigid", 4), ("none", "compliant", 5), ("rls", "compliant", 4), ("none", "compliant", 4),
        ("fel", "rigid", 4),
    )  # fmt: skip
    scenarios = [
        Scenario(
            name=f"run {seed}",
            reference=Circle(period=period, radius=0.5),
            laps=1,
            learner=kind,
            steering=steering,
            seed=seed,
        )
        for seed, (kind, steering, period) in enumerate(kinds)
    ]
    whole_result = simulate(scenarios)
    assert whole_result.sizes == {"run": 5, "time": 500, "weight": 282, "feature": 8, "channel": 2}
    assert list(whole_result.seed) == list(range(5)) == list(whole_result.run)
    assert list(whole_result.label.values) == [s.name for s in scenarios]
    assert list(whole_result.feedforward.values) == [s.feedforward for s in scenarios]
    assert list(whole_result.lap_time.values) == [4, 5, 4, 4, 4]
    for row, scenario in enumerate(scenarios):
        run = whole_result.isel(run=row)
        assert np.isfinite(run.v[: scenario.ticks]).all() and np.isnan(run.v[scenario.ticks :]).all()
        assert np.array_equal(run.x[: scenario.ticks], simulate(scenario).x)
        assert np.isfinite(run.weights).all() == (scenario.feedforward == "fel")


def test_networks_of_different_sizes():
    """The weights of networks of two sizes share a table; those of the smaller end in NaN."""
    scenarios = [Scenario(reference=Circle(period=4, radius=0.5), laps=1, fel=Fel(hidden=n)) for n in (4, 8)]
    weights = simulate(scenarios).weights
    assert weights.notnull().sum("weight").values.tolist() == [11 * 4 + 18, 11 * 8 + 18]
    assert np.array_equal(weights[0, : 11 * 4 + 18], simulate(scenarios[0]).weights)


def test_label():
    """A run's label is its name, or that of the feedforward, which for a user's stage is that of its function."""
    scenario = Scenario(reference=Circle(period=4, radius=0.5), laps=1, learner="none")

    def mine(robot, size):
        return NoLearner(Loop(robot, False, scenario.control_period), [None] * size)

    assert str(simulate(scenario).label.item()) == "none"
    assert (
        str(simulate(scenario, feedforward=mine).label.item())
        == str(simulate(scenario, feedforward=mine).feedforward.item())
        == "mine"
    )
    assert str(simulate(scenario.model_copy(update={"name": "x"})).label.item()) == "x"


def test_replicates():
    """Draws of what nobody knows are uniform, paired over scenarios, and those of a run's start in its events."""
    heavy = Scenario(perturbation=Perturbation(mass_factor=1.5), events=(Event(time=1, perturbation=Perturbation()),))
    runs, plain = replicates(heavy, 400), replicates(Scenario(learner="none"), 400)
    for name, width in REPLICATE_HALF_WIDTHS.items():
        start, later, other = (
            np.array([getattr(p, name) for p in found])
            for found in (
                [r.perturbation for r in runs],
                [r.events[0].perturbation for r in runs],
                [r.perturbation for r in plain],
            )
        )
        np.testing.assert_array_equal(later, other)
        np.testing.assert_allclose(start, other * getattr(heavy.perturbation, name), rtol=1e-12)
        assert np.abs(other - 1).max() <= width
        assert other.std() == pytest.approx(width / np.sqrt(3), rel=0.1) and abs(other.mean() - 1) < 0.2 * width
    assert [r.seed for r in runs] == list(range(400)) and replicates(heavy, 3, first=7) == runs[7:10]
    factors = np.array([[getattr(r.perturbation, name) for name in REPLICATE_HALF_WIDTHS] for r in plain])
    assert np.abs(np.corrcoef(factors.T) - np.eye(len(REPLICATE_HALF_WIDTHS))).max() < 0.15
    with pytest.raises(InputError, match="^first: -1 "):
        replicates(heavy, 2, first=-1)
    extreme = replicates(Scenario(perturbation=Perturbation(left_radius_factor=1.2, slope=-0.5)), 20)
    assert all(0.8 <= r.perturbation.left_radius_factor <= 1.2 and r.perturbation.slope >= -0.5 for r in extreme)
    assert {r.perturbation.left_radius_factor for r in extreme} > {1.2}
    assert replicates(heavy, 1, first=2**32 - 1)[0].seed == 2**32 - 1
    with pytest.raises(InputError, match="^first: 4294967295 to 4294967296 are not"):
        replicates(heavy, 2, first=2**32 - 1)
    with pytest.raises(InputError, match="^count: -3 is below 1"):
        replicates(heavy, -3)
