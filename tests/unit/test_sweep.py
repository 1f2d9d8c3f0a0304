"""What a sweep file means: axes, draws, pairs; what is refused; files that appear whole or not at all."""

import cProfile
import itertools
import tomllib

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from mrctl import PERTURBATIONS, Circle, Event, InputError, Perturbation, RobotFile, Scenario, Sweep, replicates
from mrctl.results.dataset import SIGNALS
from mrctl.sweep import plan
from mrctl.sweep import store as folder

BASE = {"laps": 1, "prior": "none", "learner": "none", "reference": {"kind": "line", "length": 0.4}}
MASS = {"field": "perturbation.mass_factor", "uniform": [0.8, 1.5]}
LAWS = {"field": "learner", "values": ["none", "rls", "fel"]}


def sweep(*axes, **changes):
    return Sweep.from_dict({"base": BASE, "axes": axes, **changes}, "s.toml")


def drawn(one):
    return [one.values(run) for run in range(one.size)]


# --- axes -----------------------------------------------------------------------------------------


def test_product_in_the_order_of_the_file():
    """The first axis is slowest, draws are fastest."""
    slopes = {"field": "perturbation.slope", "grid": {"start": -0.1, "stop": 0.1, "count": 3}}
    one = sweep(LAWS, slopes, runs=2)
    expected = itertools.product(LAWS["values"], [-0.1, 0.0, 0.1], range(2))
    found = [(v["learner"], v["perturbation.slope"]) for v in drawn(one)]
    assert found == [(law, slope) for law, slope, _ in expected] and one.size == 18


def test_scenario_is_the_base_with_the_values():
    """Dotted paths, whole tables, later axes on top of earlier ones; the base is left alone."""
    one = sweep(
        {"field": "perturbation", "values": [{"payload": 2.0}, {"slope": 0.1}]},
        {"field": "perturbation.mass_factor", "values": [1.2]},
        {"field": "reference", "values": [{"kind": "circle", "period": 4, "radius": 0.5}]},
        {"field": "initial_spread.1", "values": [0.0]},
    )
    expected = one.base.model_copy(
        update={
            "perturbation": Perturbation(payload=2, mass_factor=1.2),
            "reference": Circle(period=4, radius=0.5),
            "initial_spread": (0.02, 0.0, 0.03),
            "seed": one.values(0)["seed"],
        }
    )
    assert one.scenario(0) == expected
    assert one.scenario(1).perturbation == Perturbation(slope=0.1, mass_factor=1.2)


def test_name_of_a_record_is_completed_for_later_axes():
    """A perturbation by name has fields like one that is written as a table."""
    one = sweep(
        {"field": "perturbation", "values": ["nominal", "all"]}, {"field": "perturbation.payload", "values": [2.0]}
    )
    found = [one.scenario(run).perturbation for run in range(2)]
    assert found == [PERTURBATIONS[name].replace(payload=2.0) for name in ("nominal", "all")]


def test_zip():
    """Zipped axes move together."""
    one = sweep(
        {"field": "laps", "values": [1, 2], "zip": "a"}, LAWS,
        {"field": "perturbation.slope", "values": [0.0, 0.1], "zip": "a"},
    )  # fmt: skip
    assert one.size == 6
    assert {(v["laps"], v["perturbation.slope"]) for v in drawn(one)} == {(1, 0.0), (2, 0.1)}


def test_worlds_are_those_that_the_runs_combine():
    """Zipped values of robot and steering are no product; the fields of a robot, and tables, are combined with them."""
    robots = {"field": "robot.path", "values": ["car", "turtlebot"], "zip": "a"}
    steering = {"field": "steering", "values": ["compliant", "caster"], "zip": "a"}
    pairs = {("compliant", "car"), ("caster", "turtlebot")}
    assert {(way, robot.path) for _, way, robot in sweep(robots, steering).worlds} == pairs
    tables = {"field": "scenario", "values": [{"world": "rough", "learner": "none"}, {"world": "slope"}]}
    one = sweep(tables, robots, steering, LAWS)
    driven = {(s.world, s.steering, s.robot) for s in map(one.scenario, range(one.size))}
    assert one.worlds == sorted(driven, key=str) and len(driven) == 4


def test_seed_may_be_an_axis():
    """Then it is not drawn."""
    assert [sweep({"field": "seed", "values": [7, 8]}).scenario(run).seed for run in range(2)] == [7, 8]


def test_controllers():
    """A value is a feedforward of mrctl, a controller of the user, or both; a stage alone leaves prior and learner."""
    values = [
        "none",
        "model+fel",
        "a.py:A(gain=2)",
        "model+a.py:A",
        "motion=b/a.py:B(ahead=0.3)",
        "motion=b/a.py:B,a.py:C",
        "model+composite+motion=b/a.py:B",
    ]
    laps = {"field": "laps", "values": [1, 2]}
    one = sweep(
        laps, {"field": "controller", "values": values, "paired": True}, runs=2, base={**BASE, "learner": "rls"}
    )
    own = [None, None, "a.py:A(gain=2)", "a.py:A", *values[4:6], "motion=b/a.py:B"]
    pairs = ["none", "model+fel", "none", "model", "rls", "none", "model+composite"]
    for laps in range(2):
        for place, value in enumerate(values):
            for draw in range(2):
                run = (laps * len(values) + place) * 2 + draw
                assert one.values(run)["controller"] == value
                assert (one.driven_by(run), one.scenario(run).feedforward) == (own[place], pairs[place])
                assert one.values(run)["seed"] == one.values(laps * len(values) * 2 + draw)["seed"]
    titles = ["none", "model+fel", "A(gain=2)", "model+A", "B(ahead=0.3)", "B+C", "model+composite+B"]
    assert [one.axes[1].cell(value) for value in values] == titles
    assert one.drivers == {None: [0, 1, 2, 3]} | {name: [2 * k, 2 * k + 1] for k, name in enumerate(own) if name}
    assert [one.base_of(2 * place).feedforward for place in range(len(values))] == pairs
    assert Sweep.from_dict(one.model_dump(mode="json")) == one
    assert sweep(runs=3, controller="a.py:A").drivers == {"a.py:A": [0, 1, 2]}


# --- draws ----------------------------------------------------------------------------------------


@given(seed=st.integers(0, 2**63 - 1), run=st.integers(0, 9_999_999))
def test_run_is_a_function_of_file_and_number(seed, run):
    """Two readings of one file agree, whatever was asked before."""
    one, other = (sweep(MASS, LAWS, runs=5_000_000, seed=seed) for _ in range(2))
    other.values(0)
    assert one.values(run) == other.values(run) and one.scenario(run) == other.scenario(run)


def test_draws_differ():
    """No two runs, seeds or axes share a stream."""
    other = {"field": "perturbation.resistance_factor", "uniform": [0.8, 1.5]}
    values = [tuple(v.values()) for one in (sweep(MASS, other, runs=200, seed=s) for s in (0, 1)) for v in drawn(one)]
    for column in zip(*values, strict=True):
        assert len(set(column)) == 400
    assert all(mass != resistance for _, mass, resistance in values)


def test_more_runs_of_a_sweep_without_lists_begin_with_the_same():
    """The number of draws does not enter the draws."""
    assert drawn(sweep(MASS, runs=5)) == drawn(sweep(MASS, runs=9))[:5]


@pytest.mark.parametrize("paired", [True, False])
def test_paired(paired):
    """Paired values see the same seeds and draws; others see their own; combinations of other axes see their own."""
    slopes = {"field": "perturbation.slope", "values": [0.0, 0.1]}
    rows = drawn(sweep({**LAWS, "paired": paired}, slopes, MASS, runs=4))
    seen = {law: [(v["seed"], v[MASS["field"]]) for v in rows if v["learner"] == law] for law in LAWS["values"]}
    assert (seen["none"] == seen["fel"] == seen["rls"]) is paired
    assert len(set(itertools.chain(*seen.values()))) == (8 if paired else 24)


def test_one_value_of_a_paired_axis_draws_the_same():
    """So the sweep of a user's controller is comparable with that of built-in learners."""
    found = []
    for values in (["none", "fel"], ["none"]):
        rows = drawn(sweep({**LAWS, "values": values, "paired": True}, MASS, runs=4))
        found.append([(row["seed"], row[MASS["field"]]) for row in rows])
    both, one = found
    assert one == both[:4] == both[4:]


@pytest.mark.parametrize(
    ("kind", "parameters", "expected"),
    [
        ("uniform", [0.8, 1.5], stats.uniform(0.8, 0.7)),
        ("normal", [1.0, 0.1], stats.norm(1.0, 0.1)),
        ("loguniform", [0.5, 2.0], stats.loguniform(0.5, 2.0)),
    ],
)
def test_distributions(kind, parameters, expected):
    """Draws follow the distribution (Kolmogorov and Smirnov)."""
    one = sweep({"field": MASS["field"], kind: parameters}, runs=1000)
    assert stats.kstest([v[MASS["field"]] for v in drawn(one)], expected.cdf).pvalue > 0.01


@pytest.mark.parametrize(
    "base",
    [{"perturbation": "all"}, {"perturbation": "nominal", "events": [{"time": 0.1, "perturbation": {"payload": 3.0}}]}],
)
def test_replicates(base):
    """They are those of `mrctl.replicates` for the seeds of the runs, pairs where an axis is paired."""
    seeds = {"field": "seed", "values": [4, 5, 6]}
    one = sweep(seeds, LAWS, base=BASE | base, replicates=True)
    learners = [one.base.replace(learner=name) for name in LAWS["values"]]
    expected = [replicates(scenario, 1, seed)[0] for seed in seeds["values"] for scenario in learners]
    assert [one.scenario(run) for run in range(one.size)] == expected
    assert expected[::3] == replicates(learners[0], 3, first=4) and Sweep.from_dict(one.model_dump(mode="json")) == one
    pairs = sweep({**LAWS, "paired": True}, runs=2, base=BASE | base, replicates=True)
    drawn = [pairs.scenario(run).perturbation for run in range(6)]
    assert drawn[:2] == drawn[2:4] == drawn[4:] and drawn[0] != drawn[1]
    assert drawn[1] == replicates(one.base, 1, pairs.scenario(1).seed)[0].perturbation


# --- what is refused ------------------------------------------------------------------------------


def axis(field, **kind):
    return {"field": field, **kind}


def grid(start, stop, count):
    return {"start": start, "stop": stop, "count": count}


@pytest.mark.parametrize(
    ("message", "axes", "changes"),
    [
        (
            "perturbation.mas: no 'mas' in perturbation; did you mean mass_factor\\?",
            [axis("perturbation.mas", values=[1])],
            {},
        ),
        ("events.0.time: no '0' in events", [axis("events.0.time", values=[1])], {}),
        ("laps.x: no 'x' in laps", [axis("laps.x", values=[1])], {}),
        ("perturbation.mass_factor: .* greater than", [axis(MASS["field"], uniform=[0, 1])], {}),
        ("perturbation.mass_factor: .* less than", [axis(MASS["field"], grid=grid(1, 99, 3))], {}),
        ("learner: Input should be 'none', 'observer'", [axis("learner", values=["none", "magic"])], {}),
        (
            "run 0: perturbation.control_delay: .* whole multiple",
            [axis("perturbation.control_delay", uniform=[0.02, 0.04])],
            {},
        ),
        ("needs exactly one of values, grid, uniform", [{**MASS, "values": [1]}], {}),
        ("needs exactly one of values, grid, uniform", [axis("laps")], {}),
        ("1.5 is not below 0.8", [axis(MASS["field"], uniform=[1.5, 0.8])], {}),
        ("axes.0.normal.1: .* greater than 0", [axis(MASS["field"], normal=[1, 0])], {}),
        ("only values and grids can be paired", [{**MASS, "paired": True}], {}),
        ("laps is there twice", [axis("laps", values=[1]), axis("laps", values=[2])], {}),
        ("learner, laps are zipped, but differ", [{**LAWS, "zip": "a"}, axis("laps", values=[1], zip="a")], {}),
        ("axes.0.values: .* at least 1", [axis("laps", values=[])], {}),
        ("axes.0.stdev: there is no such field", [{**MASS, "stdev": 1}], {}),
        ("every: only where record", [], {"every": 5}),
        ("laps: is a field of a scenario, which `mrctl run FILE` drives", [], {"laps": 5}),
        ("runs: .* at most 100,000,000", [axis("laps", grid=grid(1, 10000, 10000))], {"runs": 99999999}),
        (
            "control_period: signals share",
            [axis("control_period", values=[0.01, 0.02])],
            {"record": "full", "base": {**BASE, "motion_period": 0.02}},
        ),
        ("base.laps", [], {"base": {"laps": 0}}),
        (
            "controller: 'feel' is neither my_file.py:MyController nor none, model",
            [axis("controller", values=["feel"])],
            {},
        ),
        ("controller: 'a.py:A.2.' is not of the form", [axis("controller", values=["a.py:A(2)"])], {}),
        ("controller: .* two feedforwards", [axis("controller", values=["fel+a.py:A,motion=a.py:B"])], {}),
        ("controller: needs values that are names", [axis("controller", values=[1])], {}),
        ("controller: needs values that are names", [axis("controller", uniform=[0, 1])], {}),
        ("scenario: needs values that are tables", [axis("scenario", values=["heavy"])], {}),
        ("scenario: needs values that are tables", [axis("scenario", uniform=[0, 1])], {}),
        ("controller: two values have the name A", [axis("controller", values=["fel", "a.py:A", "b/a.py:A"])], {}),
        ("controller: leave it out beside an axis", [axis("controller", values=["fel"])], {"controller": "a.py:A"}),
        ("hindsight: leave it out beside an axis", [axis("controller", values=["fel"])], {"hindsight": True}),
        ("learner: the axis controller sets learner", [axis("controller", values=["fel"]), LAWS], {}),
        (
            "scenario: the axis controller sets prior",
            [axis("controller", values=["fel"]), axis("scenario", values=[{}, {"prior": "model"}])],
            {},
        ),
        ("record: Input should be", [], {"record": "some"}),
    ],
)
def test_refused(message, axes, changes):
    """One line that names the file and the field."""
    with pytest.raises(InputError, match=f"^s.toml: .*{message}") as error:
        sweep(*axes, **changes)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("message", "axes", "changes"),
    [
        ("base.seed: has no effect", [LAWS], {"base": {**BASE, "seed": 5}}),
        (
            "runs: the axis seed sets the seed, so that all 4 draws are copies",
            [axis("seed", values=[1, 2])],
            {"runs": 4},
        ),
        ("runs: the axis scenario sets", [axis("scenario", values=[{"seed": 1}, {"seed": 2}])], {"runs": 2}),
        ("seed: a value is there twice, 1$", [axis("seed", values=[1, 2, 1])], {}),
        ("laps: a value is there twice", [axis("laps", values=[1, 1])], {}),
        ("perturbation.slope: a value is there twice", [axis("perturbation.slope", grid=grid(0.1, 0.1, 2))], {}),
        (
            "laps, learner: a value is there twice",
            [axis("laps", values=[1, 1], zip="a"), axis("learner", values=["fel", "fel"], zip="a")],
            {},
        ),
        (
            r"perturbation.mass_factor: the axis perturbation comes later and replaces it; put the axis perturbation f",
            [MASS, axis("perturbation", values=["nominal", "all"])],
            {},
        ),
        (
            "laps: the axis scenario comes later and replaces it; give it once$",
            [axis("laps", values=[1, 2]), axis("scenario", values=[{}, {"laps": 4}])],
            {},
        ),
        (
            "laps: the axis laps comes later",
            [axis("scenario", values=[{}, {"laps": 4}]), axis("laps", values=[1, 2])],
            {},
        ),
    ],
)
def test_copies(message, axes, changes):
    """Runs that are exact copies, and a seed or values that no run has, are refused before a sweep begins."""
    with pytest.raises(InputError, match=f"^{message}"):
        sweep(*axes, **changes).check_draws()


def test_no_copies():
    """Draws, and zipped axes, make runs that differ; a list of scenarios may have one twice."""
    sweep(axis("seed", values=[1, 2]), MASS, runs=2).check_draws()
    zipped = [axis("laps", values=[1, 1, 2], zip="a"), axis("perturbation.slope", values=[0.0, 0.1, 0.0], zip="a")]
    sweep(*zipped, runs=2, seed=3).check_draws()
    Sweep.of([Scenario(seed=seed) for seed in (0, 1, 0)]).check_draws()
    sweep(axis("scenario", values=[{"laps": 4}, {"perturbation": {"payload": 2.0}}]), MASS).check_draws()


def test_many_values_are_checked_fast(capsys, monkeypatch):
    """Checking a value calls hardly more functions than validating its scenario; a long check shows a bar."""

    def calls(function, *arguments):
        profile = cProfile.Profile()
        profile.runcall(function, *arguments)
        return sum(entry.callcount for entry in profile.getstats())

    base = Scenario.from_dict(BASE).model_dump(mode="json")
    one = calls(Scenario.from_dict, base)
    assert calls(sweep, axis(MASS["field"], values=np.linspace(1, 2, 500).tolist())) < 2 * 500 * one
    assert capsys.readouterr().err == ""
    monkeypatch.setattr(plan, "QUIET_TIME", 0.0)
    sweep(axis(MASS["field"], values=[1, 2]))
    assert "checks the values" in capsys.readouterr().err


def test_no_such_run():
    """Runs have numbers from 0."""
    for run in (-1, 3):
        with pytest.raises(InputError, match="not in 0 to 2"):
            sweep(LAWS).scenario(run)


def test_draws_beyond_the_range_are_that_run_s_own():
    """A normal distribution has tails; the sweep is not refused for them, and the other runs are as they are."""
    one = sweep({"field": MASS["field"], "normal": [0.3, 0.2]}, runs=100)
    bad = [run for run in range(100) if one.valid(run) is None]
    assert 3 < len(bad) < 30 and all(one.values(run)[MASS["field"]] < 0.05 for run in bad)


# --- jobs and columns -----------------------------------------------------------------------------


def test_chunk_is_a_function_of_the_file():
    """64 of many runs, fewer of few or where their signals would not fit in memory, or what the file says."""
    assert [sweep(runs=n).chunk_size for n in (1, 20, 127, 128, 300, 1023, 1024, 10**6)] == [4, 4, 4, 8, 16, 32, 64, 64]
    assert sweep(runs=10**6, base={**BASE, "laps": 4000}).chunk_size < 4
    assert sweep(chunk=5).chunk_size == 5
    long = sweep(base={"laps": 100}, runs=10**6)
    assert long.chunk_size * long.base.ticks * len(SIGNALS) * 8 <= 2**27
    varied = sweep({"field": "laps", "values": [1, 200]}, runs=1500, record="full")
    assert varied.chunk_size * varied.samples * len(SIGNALS) * 8 <= 2**27


@pytest.mark.parametrize(
    ("record", "samples"), [({}, 0), ({"record": "full"}, 100), ({"record": "decimated", "every": 30}, 4)]
)
def test_samples(record, samples):
    """As many as the longest run needs, the first one included."""
    assert sweep({"field": "laps", "values": [2, 1]}, **record).samples == samples


def test_columns():
    """An axis keeps its kind in the table; tables are JSON."""
    one = sweep(
        {"field": "laps", "values": [1, 2]}, {"field": "perturbation.slope", "values": [0, 0.1]}, LAWS, MASS,
        {"field": "perturbation", "values": [{"slope": 0.1}]},
    )  # fmt: skip
    kinds = [one.columns.field(name).type for name in ("laps", "perturbation.slope", "learner", MASS["field"])]
    assert kinds == [pa.int64(), pa.float64(), pa.string(), pa.float64()]
    assert one.axes[-1].cell({"slope": 0.1}) == '{"slope": 0.1}' and one.axes[2].cell("fel") == "fel"
    assert one.columns.names.count("laps") == 1 and one.columns.field("energy").metadata == {b"units": b"J"}


def test_list_of_scenarios():
    """Run i of a list is its i-th scenario, whatever it changes, seed and events included."""
    step = Event(time=0.2, perturbation=Perturbation(payload=3), reference=Circle(period=9))
    scenarios = [
        Scenario(), Scenario(seed=7, laps=2, name="a", learner="rls"), Scenario(reference=Circle(), events=(step,)),
        Scenario(world="rough", steering="rigid", control_period=0.02, motion_period=0.02, prefilter=0.1),
    ]  # fmt: skip
    one = Sweep.of(scenarios, record="laps", chunk=3)
    assert [one.scenario(run) for run in range(one.size)] == scenarios
    own = RobotFile()
    assert one.worlds == [("flat", None, own), ("rough", "rigid", own)] and one.samples == 0
    assert Sweep.from_dict(one.model_dump(mode="json")) == one


def test_scenario_axis_combines_with_others():
    """What a table leaves out is the base's or another axis's; what it says replaces the whole field."""
    tables = [{"perturbation": {"slope": 0.1}}, {"laps": 3}]
    one = sweep({"field": "scenario", "values": tables}, LAWS, base={**BASE, "perturbation": {"payload": 2.0}})
    found = [one.scenario(run) for run in range(one.size)]
    assert [s.feedforward for s in found] == ["none", "rls", "fel"] * 2
    assert {(s.perturbation.slope, s.perturbation.payload, s.laps) for s in found} == {(0.1, 0.0, 1), (0.0, 2.0, 3)}
    with pytest.raises(InputError, match="laps"):
        sweep({"field": "scenario", "values": [{"laps": 0}]})


def test_toml(tmp_path):
    """A file, and what is written in a store, read back as the same sweep."""
    text = '[base]\nlaps = 2\n[[axes]]\nfield = "perturbation.slope"\ngrid = {start = -0.1, stop = 0.1, count = 5}\n'
    (tmp_path / "s.toml").write_text(text)
    one = Sweep.from_toml(tmp_path / "s.toml")
    assert one == Sweep.from_dict(tomllib.loads(text)) == Sweep.from_dict(one.model_dump(mode="json"))
    assert one.base == Scenario(laps=2)


# --- files ----------------------------------------------------------------------------------------


def test_a_file_is_whole_or_absent(tmp_path):
    """What fails half-way leaves the old file and nothing else."""
    path = tmp_path / "file"
    path.write_bytes(b"old")
    with pytest.raises(OSError), folder._whole(path) as file:
        file.write(b"half")
        raise OSError
    assert path.read_bytes() == b"old" and list(tmp_path.iterdir()) == [path]
    with folder._whole(path) as file:
        file.write(b"new")
    assert path.read_bytes() == b"new" and list(tmp_path.iterdir()) == [path]


@given(st.lists(st.integers(0, 7), max_size=20))
def test_regroup(sizes):
    """The same rows in the same order, in groups that do not depend on the jobs."""
    column = np.arange(sum(sizes))
    tables = [pa.table({"a": part}) for part in np.split(column, np.cumsum(sizes))[:-1]]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(folder, "ROW_GROUP", 4)
        groups = [group["a"].to_pylist() for group in folder._regroup(tables)]
    assert list(itertools.chain(*groups)) == column.tolist()
    assert all(len(group) == 4 for group in groups[:-1])


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ({"a": {"b": [1, 2]}}, {"a": {"b": [1, 2]}}, ""),
        ({"a": {"b": [1, 2]}}, {"a": {"b": [1, 3]}}, "a.b.1 (2, now 3)"),
        ({"a": 1}, {"a": 1, "b": 2}, "b (null, now 2)"),
        ({"a": [1]}, {"a": [1, 2]}, "a ([1], now [1, 2])"),
    ],
)
def test_difference(old, new, expected):
    """The first place where two descriptions differ."""
    assert folder._difference(old, new) == expected


def test_toml_without_none(tmp_path):
    """A field of a scenario that is not set is left out; a None that means something is refused, and not dropped."""
    sweep = Sweep.of([Scenario(laps=1, events=(Event(time=0.5, learning=False),)), Scenario(laps=1)])
    path = tmp_path / "sweep.toml"
    path.write_text(sweep.to_toml())
    again = Sweep.from_toml(path)
    assert [again.scenario(run) for run in range(2)] == [sweep.scenario(run) for run in range(2)]
    for field, values in (("steering", [None, "rigid"]), ("scenario", [{"steering": None}, {}])):
        with pytest.raises(InputError, match="TOML cannot say None"):
            Sweep.from_dict({"base": {"steering": "rigid"}, "axes": [{"field": field, "values": values}]}).to_toml()


def test_grid_of_one_value():
    """A grid of one value cannot hold two ends."""
    sweep = {"axes": [{"field": "perturbation.slope", "grid": {"start": 0.0, "stop": 0.1, "count": 1}}]}
    with pytest.raises(InputError, match="^perturbation.slope: a grid of one value cannot hold both 0 and 0.1"):
        Sweep.from_dict(sweep).check_draws()
