"""Results on disk: what is saved comes back, nothing is overwritten or left behind, and a result can be run again."""

import json
import os
import tomllib
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import xarray as xr

import mrctl
from mrctl import Circle, Event, Fel, Perturbation, Pid, Scenario
from mrctl.control.design import motion
from mrctl.loop.groups import arranged
from mrctl.loop.runs import simulate
from mrctl.physics import mjcf
from mrctl.record import InputError
from mrctl.results.dataset import GAIN_VARIABLES, SIGNALS, open_result, save, scenarios_of, versions
from mrctl.results.metrics import as_runs
from mrctl.sensing.tiers import Sensing
from mrctl.viewer.recording import Library

CIRCLE = Circle(period=4, radius=0.5)
SCENARIOS = [
    Scenario(
        reference=CIRCLE, laps=1, learner="fel", fel=Fel(hidden=4), name="gelernt ✓", sensing=Sensing(tier="ideal")
    ),
    Scenario(
        reference=Circle(period=5, radius=0.5),
        laps=1,
        learner="none",
        seed=3,
        sensing=Sensing(estimator="odometry"),
    ),
    Scenario(
        reference=CIRCLE,
        laps=1,
        learner="rls",
        steering="rigid",
        perturbation=Perturbation(payload=2, dead_zone=0.1, control_delay=0.01),
        events=(Event(time=1, push=(1e4, 1e4, 0)),),
    ),
]


@pytest.fixture(scope="module")
def result():
    """Three runs of different kinds, the last of which fails."""
    return simulate(SCENARIOS)


@pytest.fixture(scope="module")
def small(result):
    """One of its variables, where only folders and files matter."""
    return result[["x"]]


@pytest.fixture(scope="module")
def saved(result, tmp_path_factory):
    """The folders of all runs and of the first alone."""
    folder = tmp_path_factory.mktemp("results") / "new"
    save(result, folder / "all.zarr")
    save(result.isel(run=0), folder / "one.zarr")
    return folder / "all.zarr", folder / "one.zarr"


def test_labels(result):
    """Dimensions, units, coordinates and attributes that everything else relies on."""
    assert result.sizes == {"run": 3, "time": 500, "weight": 120, "feature": 8, "channel": 2}
    for name, (unit, meaning) in SIGNALS.items():
        assert result[name].dims == ("run", "time") and result[name].attrs == {"units": unit, "long_name": meaning}
    assert result.time.attrs == {"units": "s"} and np.array_equal(result.time, 0.01 * np.arange(500))
    assert {"label", "feedforward", "steering", "seed", "lap_time"} <= set(result.coords)
    assert json.loads(result.attrs["versions"]) == versions() and result.attrs["control_period"] == 0.01
    assert result.failed.values.tolist() == [False, False, True]
    assert list(result.failure.values[:2]) == ["", ""] and result.failure.values[2]
    assert np.isnan(result.failure_time[:2]).all() and 1 < result.failure_time[2] < 2


def test_gains(result):
    """A result has the gains of each run before any event, as the scenario's records design them."""
    for run, scenario in enumerate(map(arranged, SCENARIOS)):
        _, robot = mjcf.build(scenario.world, scenario.steering, robot=scenario.robot)
        design = robot, scenario.steering == "rigid"
        delay = scenario.sensing.loop_delay(0.01) * 0.01
        gains, both = scenario.pid.gains(*design, delay), scenario.pid.channels(*design, delay)
        around = motion(*design, both, delay)
        expected = {"k_p": gains["k_p"], "k_i": gains["k_i"], "prefilter": around.prefilter}
        expected |= {name: getattr(around.kanayama, name) for name in ("k_x", "k_y", "k_theta")}
        assert set(expected) == set(GAIN_VARIABLES)
        for name, value in expected.items():
            found = result[name].isel(run=run)
            assert found.values.tolist() == np.array(value).tolist(), (run, name)
            assert (found.attrs["units"], found.attrs["long_name"]) == GAIN_VARIABLES[name]
    assert len(np.unique(result.k_p.values, axis=0)) == 3  # three delays or arrangements
    assert result.k_i.dims == ("run", "channel")
    given = Scenario(reference=CIRCLE, laps=1, pid={"time_constant": 0.2}, kanayama={"k_x": 3.0}, prefilter=0.05)
    changed = given.replace(events=(Event(time=0.5, pid=Pid(time_constant=0.3)),))
    runs = simulate([given, changed])
    assert np.ptp(runs.k_p.values, axis=0).tolist() == [0, 0] and runs.k_x.values.tolist() == [3, 3]
    assert simulate(given).k_p.values.tolist() == runs.k_p[0].values.tolist()
    assert runs.prefilter.values.tolist() == [0.05, 0.05]


def test_meaning(result):
    """Signals are what their names say: power is the sum of U i, the reference is the reference, errors are errors."""
    run = result.isel(run=0)
    motion = CIRCLE.sample(run.time.values[:400])
    assert np.array_equal(run.x_ref[:400], motion.pose[:, 0])
    assert np.array_equal(run.omega_ref[:400], motion.twist[:, 1])
    power = run.voltage_left * run.current_left + run.voltage_right * run.current_right
    assert np.allclose(run.power, power, equal_nan=True)
    for side in ("left", "right"):
        total = run[f"feedback_{side}"] + run[f"feedforward_{side}"]
        assert np.allclose(run[f"voltage_{side}"], total.clip(-24, 24), equal_nan=True)
    back = np.hypot(run.longitudinal_error, run.lateral_error)
    assert np.allclose(back, np.hypot(run.x_ref - run.x, run.y_ref - run.y), equal_nan=True)


@pytest.mark.parametrize("single", [False, True])
def test_round_trip(result, saved, single, tmp_path):
    """Values to the bit, texts, coordinates, attributes; a single run too, and once more from what was opened."""
    result = result.isel(run=0) if single else result
    opened = mrctl.open(saved[single])
    assert opened.identical(result)
    for name in SIGNALS:
        assert np.array_equal(opened[name], result[name], equal_nan=True)
    assert opened.attrs == result.attrs and list(np.atleast_1d(opened.label)) == list(np.atleast_1d(result.label))
    save(opened, str(tmp_path / "b.zarr"))
    assert open_result(str(tmp_path / "b.zarr")).identical(result)
    assert sorted(p.name for p in [*tmp_path.rglob("*.partial"), *saved[0].parent.rglob("*.partial")]) == []


def test_single_run_in_the_viewer(result, saved, tmp_path):
    """The viewer opens the saved result of one scenario, whose label and seed have no dimension, like that of many."""
    save(result.isel(run=[0]), tmp_path / "list")
    one, listed = Library(saved[True]), Library(tmp_path / "list")
    pd.testing.assert_frame_equal(one.table, listed.table, check_dtype=False)
    assert one.recording(0).label == "gelernt ✓" and one.recording(0).scenario == SCENARIOS[0]
    assert one.recording(0).log.tobytes() == listed.recording(0).log.tobytes()


def test_run_again(result, saved):
    """A run is a pure function of its scenario: from the file, every bit again."""
    again = scenarios_of(open_result(saved[False]))
    assert again == SCENARIOS
    assert simulate(again).identical(result)


def test_selection(result, tmp_path):
    """The scenarios of a selection are those of its runs."""
    assert scenarios_of(result.isel(run=[2, 0])) == [SCENARIOS[2], SCENARIOS[0]]
    assert scenarios_of(result.isel(run=1)) == [SCENARIOS[1]]
    assert scenarios_of(simulate(SCENARIOS[1])) == [SCENARIOS[1]]
    lost = as_runs(result.isel(run=1, drop=True))
    assert "run" in lost.dims
    refused("run: the selection has lost the number of its run; select it without drop=True", scenarios_of, lost)
    renumbered = result.assign_coords(run=result["run"] + 1)
    count = len(SCENARIOS)
    refused(f"run: {count} is the number of none of the {count} scenarios in the result", scenarios_of, renumbered)
    assert scenarios_of(result.isel(run=[1, 0, 1])) == [SCENARIOS[1], SCENARIOS[0], SCENARIOS[1]]
    others = xr.concat([simulate(SCENARIOS[1]), simulate(SCENARIOS[0])], "run", join="outer")
    joined = "run: two different runs have one number, as results of different simulate calls have; .*compare_errors"
    refused(joined, scenarios_of, others)
    refused(joined, save, others, tmp_path / "joined.zarr")


def test_result_of_an_older_version(result, tmp_path):
    """It opens; what it lacks is named together with the version that wrote it, in one line."""
    scenarios = json.loads(result.attrs["scenarios"])
    scenarios[0] |= {"former": 1}
    old = result.drop_vars(["energy", "guard"], errors="ignore").assign_attrs(
        versions=json.dumps({**versions(), "mrctl": "0.0.9"}), scenarios=json.dumps(scenarios)
    )
    save(old, tmp_path / "a")
    opened = mrctl.open(tmp_path / "a")
    assert opened.identical(old)
    refused("guard: not a variable of this result, which mrctl 0.0.9 wrote", mrctl.summary, opened)
    refused("guard: not a variable of this result, which mrctl 0.0.9 wrote", mrctl.guard_events, opened)
    refused("scenario of a result of mrctl 0.0.9: former: there is no such field", scenarios_of, opened)
    assert scenarios_of(opened.isel(run=[1])) == [SCENARIOS[1]]


def test_version():
    """Results carry the version of the code that runs, not that of some earlier installation."""
    assert versions()["mrctl"] == mrctl.__version__
    with open(Path(mrctl.__file__).parent.parent / "pyproject.toml", "rb") as file:
        project = tomllib.load(file)
    assert project["project"]["dynamic"] == ["version"]
    assert project["tool"]["hatch"]["version"] == {"path": "mrctl/__init__.py"}


def refused(message: str, call, *arguments) -> None:
    """One line with the path."""
    with pytest.raises(InputError, match=message) as error:
        call(*arguments)
    assert "\n" not in str(error.value)


def test_no_overwriting(small, tmp_path):
    """Not a result, not a file, not an empty folder."""
    save(small, tmp_path / "a")
    (tmp_path / "b").write_text("mine")
    (tmp_path / "c").mkdir()
    for name in "abc":
        refused(f"{name}: exists already", save, small.isel(run=0), tmp_path / name)
    refused(r"d.nc: .*to_netcdf", save, small, tmp_path / "d.nc")
    assert open_result(tmp_path / "a").identical(small)
    assert (tmp_path / "b").read_text() == "mine" and not list((tmp_path / "c").iterdir())


def test_stale_partial(small, tmp_path):
    """What a killed run left half written is no obstacle, and no part of the result."""
    (tmp_path / "a.partial").mkdir()
    (tmp_path / "a.partial" / "rubbish").write_text("")
    save(small, tmp_path / "a")
    assert open_result(tmp_path / "a").identical(small) and not (tmp_path / "a" / "rubbish").exists()


def test_what_cannot_be_opened_is_not_saved(small, tmp_path):
    """An opened sweep has no scenarios; a copy of it that `open` refuses would be lost."""
    sweep = small.drop_attrs().assign_attrs({name: small.attrs[name] for name in ("versions", "control_period")})
    refused("result: lacks the attribute scenarios", save, sweep, tmp_path / "a")
    assert not list(tmp_path.iterdir())


def test_not_a_folder(small, tmp_path):
    """A file where the folder should be."""
    (tmp_path / "file").write_text("")
    refused("cannot be written", save, small, tmp_path / "file" / "a")
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def test_too_long_a_name(small, tmp_path):
    with pytest.raises(InputError, match="too long"):
        save(small, tmp_path / ("n" * 300))


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_read_only(small, tmp_path):
    """A folder without permission."""
    tmp_path.chmod(0o500)
    refused("cannot be written: Permission denied", save, small, tmp_path / "a")
    assert not list(tmp_path.iterdir())


def test_thousands_of_scenarios(small, tmp_path):
    """They take more space than any file of settings may have."""
    many = small.assign_attrs(scenarios=json.dumps(json.loads(small.attrs["scenarios"]) * 600))
    save(many, tmp_path / "a")
    assert open_result(tmp_path / "a").identical(many)


def test_disk_full(small, tmp_path, monkeypatch):
    """Nothing is left behind when writing fails in the middle."""
    write = xr.Dataset.to_zarr

    def fail(*args, **kwargs):
        write(*args, **kwargs)
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(xr.Dataset, "to_zarr", fail)
    refused("a: cannot be written: No space left on device", save, small, tmp_path / "a")
    assert not list(tmp_path.iterdir())


def test_open_nothing(small, tmp_path):
    """Neither a missing path, nor an empty folder, a file, another store, or a broken one."""
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").write_text("hello")
    small.drop_attrs().to_zarr(tmp_path / "other", zarr_format=3, consolidated=False)
    save(small, tmp_path / "broken")
    (tmp_path / "broken" / "zarr.json").write_text("{")
    for name in ("missing", "empty", "file", "other", "broken"):
        refused(f"{name}: not a saved result", open_result, tmp_path / name)
