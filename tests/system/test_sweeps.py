"""Sweeps, whatever befalls them: same bytes for any workers and any interruptions, clear refusals, nothing lost."""

import contextlib
import errno
import itertools
import json
import os
import random
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
import warnings
from functools import partial
from pathlib import Path
from unittest import mock

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import victim
import xarray as xr

import mrctl
from mrctl import InputError, Sweep, cli
from mrctl.loop.runs import simulate
from mrctl.physics.files import models_folder
from mrctl.results.dataset import SIGNALS
from mrctl.sweep import jobs
from mrctl.sweep.jobs import compute
from mrctl.sweep.pool import JobOutcome
from mrctl.sweep.store import KIND, Store

HERE = pytest.mark.usefixtures("here")  # where worker processes are not the point
KILLS = [moment if moment < 1 else pytest.param(moment, marks=pytest.mark.full) for moment in range(36)]  # per victim
FILE = """
runs = 12
chunk = 5
record = "decimated"
[base]
laps = 1
learner = "none"
reference = { kind = "line", length = 0.8 }
[[axes]]
field = "learner"
values = ["none", "fel"]
paired = true
[[axes]]
field = "perturbation.mass_factor"
normal = [0.5, 0.3]
"""


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "sweep.toml"
    path.write_text(FILE)
    return path


@pytest.fixture
def sweep(file):
    return Sweep.from_toml(file)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The store of the sweep, run without incident."""
    folder = tmp_path_factory.mktemp("whole")
    (folder / "sweep.toml").write_text(FILE)
    jobs.run(Sweep.from_toml(folder / "sweep.toml"), folder / "store", workers=1)
    return folder / "store"


@pytest.fixture(scope="module")
def whole(finished):
    """The bytes of the sweep."""
    return content(finished)


@pytest.fixture
def store(finished, tmp_path):
    """A copy of the finished store."""
    return shutil.copytree(finished, tmp_path / "store")


def content(store):
    """Every file of a store, the lock left out."""
    return {str(f.relative_to(store)): f.read_bytes() for f in store.rglob("*") if f.is_file() and f.name != "lock"}


def said(stderr):
    """Lines beside those of a progress bar, which shows run/s or s/run."""
    lines = stderr.replace("\r", "\n").splitlines()
    return [line for line in lines if line.strip() and "run/s" not in line and "s/run" not in line]


def refused(capsys, *arguments, status=2):
    """Returns the one line that a command prints on stderr beside its progress bar."""
    assert cli.main([str(a) for a in arguments]) == status
    lines = said(capsys.readouterr().err)
    assert len(lines) == 1 and "Traceback" not in lines[0], lines
    return lines[0]


# --- what comes out -------------------------------------------------------------------------------


def test_workers_change_nothing(sweep, tmp_path, whole):
    """1, 7 workers: the same files, byte for byte; 2 in `test_shaky` and `test_poison`."""
    report = jobs.run(sweep, tmp_path / "store", 7)
    assert content(tmp_path / "store") == whole
    assert report.runs == 24 and not report.aside and report.failed == len(failures(sweep))


def test_late_worker(finished, tmp_path, whole):
    """A job that ends after the sweep was finished elsewhere leaves the store as it is."""
    shutil.copytree(finished, tmp_path / "store")
    assert not jobs.compute(str(tmp_path / "store"), 1).error
    assert content(tmp_path / "store") == whole


def failures(sweep):
    return [run for run in range(sweep.size) if sweep.valid(run) is None]


def test_open(sweep, finished):
    """One labelled dataset and one table, which hold what `simulate` and `summary` return for the same scenarios."""
    table = pd.read_parquet(finished / "runs.parquet")
    runs, lost = [run for run in range(24) if run not in failures(sweep)], failures(sweep)
    assert 0 < len(lost) < 12 and list(table["run"]) == list(range(24))
    direct = simulate([sweep.scenario(run) for run in runs]).assign_coords(run=runs)
    opened = mrctl.open(finished).load()
    for name in SIGNALS:
        assert opened[name].dims == ("run", "time") and opened[name].attrs["units"] == SIGNALS[name][0]
        np.testing.assert_array_equal(opened[name].sel(run=runs), direct[name][:, ::10])
        assert np.isnan(opened[name].sel(run=lost)).all()
    np.testing.assert_array_equal(opened["time"], direct["time"][::10])
    for name in ("label", "feedforward", "steering", "seed", "lap_time"):
        np.testing.assert_array_equal(opened[name].sel(run=runs), direct[name])
    mass = [sweep.values(run)["perturbation.mass_factor"] for run in range(24)]
    np.testing.assert_array_equal(opened["perturbation.mass_factor"], mass)
    summary = mrctl.summary(direct)
    for name in ("energy", "v_rmse", "lateral_max", "weight_norm", "laps"):
        np.testing.assert_array_equal(table.set_index("run").loc[runs, name], summary[name])
    assert set(table.loc[lost, "failure"]) == {
        "perturbation.mass_factor: Input should be greater than or equal to 0.05"
    }
    assert table.loc[lost, "failed"].all() and (table.loc[lost, "failure_time"] == 0).all()
    with pytest.warns(UserWarning, match="one of 10 samples, so that the metrics are approximate"):
        assert mrctl.summary(opened).attrs["failed"] == len(lost)
    assert opened.attrs["control_period"] == 0.01


@HERE
def test_metrics_only(file, tmp_path):
    """Without signals the dataset has the metrics; runs that differ in control period are welcome."""
    file.write_text(
        'runs = 3\n[base]\nmotion_period = 0.02\nlaps = 1\nreference = { kind = "line", length = 0.8 }\n'
        '[[axes]]\nfield = "control_period"\nvalues = [0.02, 0.01]\n'
    )
    sweep = Sweep.from_toml(file)
    jobs.run(sweep, tmp_path / "store", 1)
    opened = mrctl.open(tmp_path / "store")
    assert opened["energy"].dims == ("run",) and opened["energy"].attrs["units"] == "J" and "time" not in opened.dims
    alone = [float(mrctl.summary(simulate([sweep.scenario(run)]))["energy"].iloc[0]) for run in range(6)]
    np.testing.assert_array_equal(opened["energy"], alone)
    assert not (tmp_path / "store" / "signals.zarr").exists()


@HERE
def test_every_lap(tmp_path):
    """A store of laps opens as what `per_lap` returns, shorter runs ending in NaN; a run of it repeats."""
    axes = [{"field": "laps", "values": [1, 3]}, {"field": "perturbation.mass_factor", "values": [1.0, 1.5]}]
    base = {"prior": "none", "learner": "none", "reference": {"kind": "line", "length": 0.8}}
    sweep = Sweep.from_dict({"base": base, "axes": axes, "record": "laps", "chunk": 2})
    jobs.run(sweep, tmp_path / "store", 1)
    opened = mrctl.open(tmp_path / "store")
    direct = mrctl.per_lap(simulate([sweep.scenario(run) for run in range(4)]))
    for name in mrctl.results.metrics.METRICS:
        np.testing.assert_array_equal(opened[name], direct[name])
        assert opened[name].attrs["units"] == direct[name].attrs["units"]
    assert opened["laps"].values.tolist() == [1, 1, 3, 3] and opened["lap"].values.tolist() == [1, 2, 3]
    pd.testing.assert_frame_equal(mrctl.summary(opened), mrctl.summary(direct), check_dtype=False)
    assert jobs.repeat(tmp_path / "store", 3) == ("bit-identical", True)


@HERE
def test_full_with_runs_of_different_length(tmp_path):
    """Shorter runs end in NaN; a run that diverges says when and why and costs only itself."""
    push = {"time": 0.5, "push": [4000.0, 4000.0, 0.0]}
    axes = [{"field": "laps", "values": [1, 2]}, {"field": "events", "values": [[], [push]]}]
    base = {"prior": "none", "learner": "none", "reference": {"kind": "line", "length": 0.8}}
    sweep = Sweep.from_dict({"base": base, "axes": axes, "record": "full", "chunk": 3})
    report = jobs.run(sweep, tmp_path / "store", 1)
    opened = mrctl.open(tmp_path / "store")
    assert report.failed == 2 and opened["failed"].values.tolist() == [False, True, False, True]
    assert opened["failure"].values.tolist() == ["", "lateral error over 1 m"] * 2
    finite = np.isfinite(opened["x"]).sum("time").values
    assert finite[0] == 100 and finite[2] == 200
    for run in (1, 3):
        assert finite[run] == round(float(opened["failure_time"][run]) * 100) - 1 > 50


@HERE
@pytest.mark.parametrize("record", ["full", "decimated", "metrics", "laps"])
def test_laps_of_runs_that_fail(tmp_path, record):
    """Table and opened store agree on the number of laps, where robots topple and where nothing was driven."""
    push = {"time": 0.5, "push": [4000.0, 4000.0, 0.0]}
    axes = [{"field": "laps", "values": [1, 4]}, {"field": "perturbation.mass_factor", "normal": [0.5, 0.5]}]
    base = {"prior": "none", "learner": "none", "reference": {"kind": "line", "length": 0.8}, "events": [push]}
    period = 100  # samples of a lap
    every = 7 if record == "decimated" else None
    sweep = Sweep.from_dict({"runs": 2, "base": base, "axes": axes, "record": record, "every": every})
    store, idle = tmp_path / "store", [run for run in range(4) if sweep.valid(run) is None]
    assert idle == [1, 3] and jobs.run(sweep, store, 1).failed == 4
    table, opened = pd.read_parquet(store / "runs.parquet"), mrctl.open(store).load()
    kept = [-(-period * laps // (every or 1)) for laps in (1, 0, 4, 0)]
    assert opened["samples"].values.tolist() == table["samples"].tolist() == kept
    if record == "laps":
        assert opened["laps"].values.tolist() == [1, 0, 4, 0]
    if record in ("full", "decimated"):
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "time: holds one of 7 samples")
            laps = mrctl.per_lap(opened)
        assert laps["laps"].values.tolist() == [1, 0, 4, 0] and np.isnan(laps["position_rmse"][1]).all()
        assert laps["failed"].all() and np.isnan(mrctl.results.metrics.over_laps(laps, "v_rmse")[1])


@HERE
def test_times_of_another_control_period(tmp_path):
    """The time axis of a store is that of its runs, whatever the period of the base is."""
    scenario = mrctl.Scenario(
        reference=mrctl.Line(length=0.8), laps=1, learner="none", control_period=0.02, motion_period=0.02
    )
    sweep = Sweep.of([scenario], record="full")
    jobs.run(sweep, tmp_path / "store", 1)
    alone = mrctl.simulate(sweep.scenario(0))
    assert np.array_equal(mrctl.open(tmp_path / "store")["time"], alone["time"])


# --- one run again --------------------------------------------------------------------------------


def test_run_again(sweep, store, tmp_path, capsys):
    """Bit-identical as it is, within tolerance when a bit is off, and where it departs when more is."""
    for run in (0, 14, failures(sweep)[0]):
        assert cli.main(["run", str(store), "--run", str(run)]) == 0
        assert capsys.readouterr().out == f"run {run}: bit-identical\n"
    assert cli.main(["run", str(store), "--run", "0", "--laps", "3"]) == 2
    assert capsys.readouterr().err == f"mrctl: laps: {store} says how its runs are driven; leave --laps out\n"
    array = Store(store)._signals
    column = list(SIGNALS).index("v")
    array[14, 7, column] = np.nextafter(array[14, 7, column], 9)
    assert cli.main(["run", str(store), "--run", "14"]) == 0
    assert "run 14: within tolerance" in capsys.readouterr().out
    array[14, 7, column] = 3.0
    assert "run 14: departs: signal v is" in (line := refused(capsys, "run", store, "--run", 14, status=1))
    assert line.endswith("at t = 0.7 s, in the store 3.0")
    assert "run: 24 is not in 0 to 23" in refused(capsys, "run", store, "--run", 24)
    assert "give its number with --run" in refused(capsys, "run", store)
    assert "not a sweep's store" in refused(capsys, "run", tmp_path, "--run", 1)


@HERE
@pytest.mark.usefixtures("no_figures")
def test_run_again_needs_its_files(tmp_path, capsys):
    """A file that is missing or has changed is no departure; with --out a run is driven once."""
    world, file, store = tmp_path / "flat.xml", tmp_path / "l.safetensors", tmp_path / "store"
    shutil.copytree(models_folder(), tmp_path, dirs_exist_ok=True)
    learned(file, 0)
    base = {"learner": "fel", "laps": 1, "reference": {"kind": "line", "length": 0.4}, "learned": str(file)}
    jobs.run(Sweep.from_dict({"base": base | {"world": str(world)}, "runs": 2}), store, 1)
    with mock.patch("mrctl.experiments.single.simulate", wraps=simulate) as once:
        with mock.patch("mrctl.sweep.jobs.simulate", side_effect=AssertionError):
            assert cli.main(["run", str(store), "--run", "1", "--out", str(tmp_path / "out")]) == 0
    assert once.call_count == 1 and "run 1: bit-identical" in capsys.readouterr().out
    kept = file.read_bytes()
    learned(file, 1)
    assert f"{file}: has changed since {store} was computed" in refused(capsys, "run", store, "--run", 1)
    file.unlink()
    assert f"{file}: No such file" in refused(capsys, "run", store, "--run", 1)
    file.write_bytes(kept)
    world.write_text(world.read_text().replace("<worldbody>", '<option gravity="0 0 -9.7"/>\n  <worldbody>'))
    assert f"{world}: has changed since {store} was computed" in refused(capsys, "run", store, "--run", 1)
    world.unlink()
    assert f"no file {world}" in refused(capsys, "run", store, "--run", 1)


# --- refusals -------------------------------------------------------------------------------------


@HERE
def test_sweep_of_another_processor(file, tmp_path, whole):
    """A sweep goes on where its numbers differ from those of the store by rounding; the store keeps its own."""
    (tmp_path / "begun").mkdir()
    begun = Store.begin(tmp_path / "begun", jobs._manifest(Sweep.from_toml(file)))
    assert not compute(str(begun.path), 0).error
    file.write_text(FILE.replace("0.8", repr(float(np.nextafter(0.8, 1)))))
    assert cli.main(["sweep", str(file), "--out", str(begun.path)]) == 0
    assert content(begun.path) == whole


@HERE
def test_one_run_is_no_runs(file, tmp_path, capsys):
    """The command counts in words."""
    file.write_text('[base]\nlaps = 1\nlearner = "none"\nreference = { kind = "line", length = 0.4 }\n')
    assert cli.main(["sweep", str(file), "--out", str(tmp_path / "store")]) == 0
    assert capsys.readouterr().out.startswith("1 run, 0 failed; table: ")


def test_changed_sweep(file, store, capsys, whole):
    """A store goes on only with the file and the versions that began it."""
    file.write_text(FILE.replace("runs = 12", "runs = 13"))
    assert "begun with another sweep.runs (12, now 13)" in refused(capsys, "sweep", file, "--out", store)
    file.write_text(FILE.replace("0.8", "0.8000000001"))
    assert "reference.length (0.8, now 0.8000000001)" in refused(capsys, "sweep", file, "--out", store)
    file.write_text("# a remark changes nothing\n" + FILE)
    assert cli.main(["sweep", str(file), "--out", str(store)]) == 0
    with mock.patch("mrctl.sweep.jobs.versions", lambda: {**mrctl.results.dataset.versions(), "mujoco": "9"}):
        assert 'versions.mujoco ("3.17.0", now "9")' in refused(capsys, "sweep", file, "--out", store)
    with mock.patch("mrctl.sweep.store.__version__", "9.1"):
        line = refused(capsys, "sweep", file, "--out", store)
    assert f"mrctl {mrctl.__version__} began this sweep and this is mrctl 9.1" in line
    with mock.patch("mrctl.physics.mjcf.digest", lambda model: "another"):
        line = refused(capsys, "sweep", file, "--out", store)
        assert "flat has changed since this sweep was begun; finish it with the former one" in line
    with mock.patch("mrctl.sweep.jobs.code_digest", lambda: "another"):  # a law was edited, the version stays
        assert 'now "another")' in refused(capsys, "sweep", file, "--out", store)
        jobs._agreed.cache_clear()  # as in a worker of its own
        with pytest.raises(InputError, match="has other laws than the process that began the store"):
            jobs._agreed(json.dumps(Store(store).manifest))
    assert content(store) == whole


def learned(path, seed):
    """Writes what `fel` has learned on a short line."""
    scenario = mrctl.Scenario(learner="fel", laps=1, reference=mrctl.Line(length=0.4), seed=seed)
    mrctl.save_learned(path, mrctl.simulate(scenario))


def loses_file(path, job):
    """The file from which the runs start is gone after job 0."""
    outcome = compute(path, job)
    Path(path).parent.joinpath("first.safetensors").unlink(missing_ok=True)
    return outcome


@HERE
@pytest.mark.parametrize(
    "change",
    [
        {"base": {"learned": "first.safetensors"}},
        {"base": {"fel": {"weights": "first.safetensors"}}},
        {"axes": [{"field": "learned", "values": ["first.safetensors"]}]},
        {"axes": [{"field": "fel", "values": [{"weights": "first.safetensors"}]}]},
        {"axes": [{"field": "scenario", "values": [{"learned": "first.safetensors"}, {}]}]},
    ],
    ids=str,
)
def test_files_that_learners_start_from(tmp_path, monkeypatch, capsys, change):
    """They are found from every folder; one that has changed or is gone stops the sweep, and no run fails for it."""
    for seed, name in enumerate(("first.safetensors", "second.safetensors")):
        learned(tmp_path / name, seed)
    base = {"learner": "fel", "laps": 1, "reference": {"kind": "line", "length": 0.4}} | change.get("base", {})
    sweep, store = Sweep.from_dict({"runs": 4, "chunk": 2, **change, "base": base}), tmp_path / "store"
    monkeypatch.chdir(tmp_path)
    other, first = tmp_path / "elsewhere", tmp_path / "first.safetensors"
    other.mkdir()

    def from_elsewhere(path, job, work=compute):
        with contextlib.chdir(other):
            return work(path, job)

    kept = first.read_bytes()
    with pytest.raises(InputError, match=f"^{first}: No such file"):
        jobs.run(sweep, store, 1, work=partial(from_elsewhere, work=loses_file))
    assert Store(store).done() == {0}
    with pytest.raises(InputError, match=f"^{first}: No such file"):
        jobs.run(sweep, store, 1)
    shutil.copy("second.safetensors", "first.safetensors")
    with pytest.raises(InputError, match=f"{first} has changed since this sweep was begun"):
        jobs.run(sweep, store, 1)
    with pytest.raises(InputError, match=f"worker .*: {first} is not the store's"):
        jobs._agreed.cache_clear()
        jobs._agreed(json.dumps(Store(store).manifest))
    first.write_bytes(kept)
    jobs.run(sweep, store, 1, work=from_elsewhere)
    assert not set(pd.read_parquet(store / "runs.parquet")["failure"]) - {""}


def test_digest_of_the_code(tmp_path):
    """It changes with a design that holds no kernel, and not with the viewer."""
    package = Path(mrctl.__file__).parent
    copy = tmp_path / "mrctl"
    shutil.copytree(package, copy, ignore=shutil.ignore_patterns("__pycache__", "*.md"))
    digests = []
    for file in ("viewer/live.py", "control/design.py", "theory/references.py"):
        with mock.patch("mrctl.sweep.jobs.__file__", str(copy / "sweep" / "jobs.py")):
            digests.append(jobs.code_digest.__wrapped__())
        with (copy / file).open("a") as text:
            text.write("\nEDITED = 1\n")
    assert digests[0] == digests[1] == jobs.code_digest() != digests[2]


def aged(store, version="0.1.0", drop=(), **manifest):
    """The store as another version of mrctl might have left it."""
    description = json.loads((store / "sweep.json").read_text())
    description["versions"]["mrctl"] = version
    description = {name: value for name, value in (description | manifest).items() if value is not None}
    (store / "sweep.json").write_text(json.dumps(description))
    table = pq.read_table(store / "runs.parquet")
    pq.write_table(table.drop_columns(list(drop)), store / "runs.parquet")


OLD = {KIND: 1, "signals": None}  # format 1 did not say which signals it kept


@HERE
@pytest.mark.parametrize("record", ["metrics", "laps", "decimated"])
def test_store_of_an_older_version(file, tmp_path, capsys, record):
    """It opens, with NaN for a metric that was not computed then; its runs repeat; it is not gone on with."""
    text, store = FILE.replace("decimated", record).replace("runs = 12", "runs = 2"), tmp_path / "store"
    file.write_text(text)
    jobs.run(Sweep.from_toml(file), store, 1)
    before = mrctl.open(store).load().drop_vars("samples")
    aged(store, drop=["samples", "excitation", *(["excitation_per_lap"] if record == "laps" else [])], **OLD)
    opened = mrctl.open(store)
    if record == "decimated":
        xr.testing.assert_identical(opened.drop_attrs(), before.drop_attrs())
    else:
        assert np.isnan(opened["excitation"]).all() and np.isfinite(before["excitation"]).any()
        names = [name for name in before if name != "excitation"]
        xr.testing.assert_identical(opened[names].drop_attrs(), before[names].drop_attrs())
    assert json.loads(opened.attrs["versions"])["mrctl"] == "0.1.0"
    if record == "laps":
        assert np.isnan(mrctl.summary(opened)["excitation"]).all()
    run = next(run for run in range(4) if run not in failures(Sweep.from_toml(file)))
    assert cli.main(["run", str(store), "--run", str(run)]) == 0
    assert "bit-identical" in capsys.readouterr().out
    line = refused(capsys, "sweep", file, "--out", store)
    assert f"mrctl 0.1.0 began this sweep and this is mrctl {mrctl.__version__}" in line


def test_store_that_cannot_be_read(store, capsys):
    """A newer format, signals without names, an unknown field: one line that names the version that wrote it."""
    aged(store, "9.1", **{KIND: 99})
    with pytest.raises(InputError, match=f"mrctl 9.1 wrote this store in format 99; mrctl {mrctl.__version__} reads"):
        mrctl.open(store)
    aged(store, "0.0.9", **OLD)
    kept = len(SIGNALS)
    with mock.patch.dict("mrctl.sweep.store.SIGNALS", {"new": ("1", "a signal that came later")}):
        with pytest.raises(
            InputError, match=f"mrctl 0.0.9 kept {kept} signals without their names and mrctl .* has {kept + 1}"
        ):
            mrctl.open(store)
    base = {"base": {"former": 1}, "axes": [], "record": "decimated"}
    aged(store, "0.0.9", **OLD, sweep=base)
    line = refused(capsys, "run", store, "--run", 0)
    assert "(written by mrctl 0.0.9): base.former: there is no such field" in line


def test_signals_keep_their_names(store):
    """A store says which signals it holds: one that a later version adds or moves changes no name of the others."""
    before = mrctl.open(store).isel(run=[0, 14]).load()
    later = {"new": ("1", "a signal that came later"), **dict(reversed(SIGNALS.items()))}
    with mock.patch("mrctl.sweep.store.SIGNALS", later):
        xr.testing.assert_identical(mrctl.open(store).isel(run=[0, 14]).load(), before)
    assert np.isfinite(before["v"]).any("time").all()


def test_repeat_names_another_version(store, capsys):
    """Where a run departs from a store that another version began, the line names both versions."""
    Store(store)._signals[14, 7, 3] = 3.0
    aged(store, **{KIND: 2})
    line = refused(capsys, "run", store, "--run", 14, status=1)
    assert line.endswith(f"in the store 3.0 (of mrctl 0.1.0; this is mrctl {mrctl.__version__})")


@pytest.mark.parametrize("name", ["notes.txt", "sweep.json", "signals.zarr"])
def test_foreign_folder(file, tmp_path, capsys, name):
    """Nothing is written into a folder, or over a file, of somebody else's."""
    store = tmp_path / "store"
    store.mkdir()
    (store / name).write_text("mine")
    assert "not a sweep's store" in refused(capsys, "sweep", file, "--out", store)
    assert "not a sweep's store" in refused(capsys, "sweep", file, "--out", store / name)
    assert content(store) == {name: b"mine"} and len(list(store.iterdir())) == 1


def test_bad_input(file, tmp_path, capsys):
    """What cannot be run is refused before a folder is filled."""
    store = tmp_path / "store"
    assert "no such file" in refused(capsys, "sweep", tmp_path / "none.toml", "--out", store).lower()
    assert "workers: 0" in refused(capsys, "sweep", file, "--out", store, "--workers", 0)
    assert refused(capsys, "sweep", file, "--out", "/proc/zz") == "mrctl: /proc/zz: No such file or directory"
    assert "workers: not together" in refused(
        capsys, "sweep", file, "--out", store, "--workers", 1, "--scheduler", "tcp://127.0.0.1:1"
    )
    file.write_text('[base.reference]\nkind = "line"\nspeed = 9\n')
    assert "max_speed" in refused(capsys, "sweep", file, "--out", store)
    file.write_text('[base]\nworld = "moon"\n')
    assert "world" in refused(capsys, "sweep", file, "--out", store)
    assert not (store / "sweep.json").exists()


def test_two_at_once(file, sweep, store, capsys):
    """The second is told who is first; a killed process leaves no lock behind."""
    with Store.locked(store):
        message = refused(capsys, "sweep", file, "--out", store)
    assert f"process {os.getpid()} on" in message and "is running this sweep" in message
    code = f"""
import os, pathlib
from mrctl.sweep.store import Store
with Store.locked(pathlib.Path({str(store)!r})):
    os.kill(os.getpid(), 9)
"""
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == -9
    assert jobs.run(sweep, store, 1).runs == 24


# --- workers that die, disks that fill ------------------------------------------------------------


def poisoned(path, job):
    """Job 1 kills its worker, in one of three ways."""
    if job == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return compute(path, job)


def shaky(path, job):
    """Every job kills its first worker and raises in its second."""
    marks = [Path(path).parent / f"{job}.{k}" for k in range(2)]
    for mark, harm in zip(marks, (lambda: os._exit(3), lambda: [][1]), strict=True):
        if not mark.exists():
            mark.touch()
            harm()
    return compute(path, job)


def test_poison(file, sweep, tmp_path, finished, whole, capsys):
    """A job that kills its worker is set aside and reported; its runs count as failed; the others are as ever."""
    store = tmp_path / "store"
    report = jobs.run(sweep, store, 2, work=poisoned)
    assert report.aside == {range(5, 10): "its worker died (signal 9)"}
    assert report.failed == len({*failures(sweep), *range(5, 10)})
    with mock.patch("mrctl.sweep.jobs.compute", poisoned):
        message = refused(capsys, "sweep", file, "--out", store, status=1)
    assert "1 job set aside: runs 5 to 9 (its worker died (signal 9))" in message
    table = pd.read_parquet(store / "runs.parquet")
    assert set(table["failure"][5:10]) == {"set aside: its worker died (signal 9)"} and table["failed"][5:10].all()
    opened = mrctl.open(store)
    assert opened.sizes["run"] == 24 and np.isnan(opened["x"][5:10]).all()
    assert "set aside" in refused(capsys, "run", store, "--run", 7)
    assert not compute(str(store), 1).error  # as if the same command were stopped after that job
    pd.testing.assert_frame_equal(Store(store).frame(), Store(finished).frame())
    assert not jobs.run(sweep, store, 2).aside, "the cause is gone: the same command does what is left"
    assert content(store) == whole


def test_shaky(sweep, tmp_path, whole):
    """Two deaths or errors are forgiven."""
    assert not jobs.run(sweep, tmp_path / "store", 2, work=shaky).aside
    assert content(tmp_path / "store") == whole


def filling_disk(path, job, moment):
    """Of two writes of each job, nothing reaches the disk from a moment on, counted in writes."""
    write, writes = os.fsync, itertools.count(2 * job)

    def fills(descriptor):
        if next(writes) >= moment:
            raise OSError(errno.ENOSPC, "No space left on device")
        write(descriptor)

    with mock.patch("mrctl.sweep.store.os.fsync", fills):
        return compute(path, job)


def small_files(path, job):
    """The system itself cuts what is written."""
    if job >= 2:
        resource.setrlimit(resource.RLIMIT_FSIZE, (500, resource.RLIM_INFINITY))
    return compute(path, job)


FULL = partial(filling_disk, moment=4), "No space left on device"  # from job 2 on


@pytest.mark.parametrize(("work", "reason"), [FULL, (small_files, "File too large")])
def test_disk_full(file, sweep, tmp_path, whole, capsys, work, reason):
    """One line; what was done is kept, nothing half-written counts, and the sweep goes on when there is space."""
    store = tmp_path / "store"
    with mock.patch("mrctl.sweep.jobs.compute", work):
        assert f"{reason}; what was done is kept" in refused(capsys, "sweep", file, "--out", store, "--workers", 1)
    assert Store(store).done() == {0, 1}
    assert mrctl.open(store).sizes["run"] == 10 and mrctl.open(store).attrs["unfinished"] == 14
    with mock.patch("mrctl.sweep.store.os.fsync", side_effect=OSError(errno.ENOSPC, "No space left on device")):
        refused(capsys, "sweep", file, "--out", store, "--workers", 1)
    jobs.run(sweep, store, 1)
    assert content(store) == whole


@HERE
@pytest.mark.parametrize("moment", [5, *(pytest.param(moment, marks=pytest.mark.full) for moment in range(10))])
def test_disk_fills(file, sweep, tmp_path, whole, capsys, moment):
    """Whichever write fails first, what was done before is kept, and once there is space the same command goes on."""
    store = tmp_path / "store"
    with mock.patch("mrctl.sweep.jobs.compute", partial(filling_disk, moment=moment)):
        line = refused(capsys, "sweep", file, "--out", store, "--workers", 1)
    assert "No space left on device; what was done is kept" in line
    assert Store(store).done() == set(range(moment // 2))
    jobs.run(sweep, store, 1)
    assert content(store) == whole


@HERE
def test_disk_full_at_the_start_and_the_end(file, sweep, tmp_path, whole, capsys):
    """Neither a store that could not be begun nor a table that could not be written is in the way later."""
    store, full = tmp_path / "store", OSError(errno.ENOSPC, "No space left on device")
    with mock.patch("mrctl.sweep.store.os.fsync", side_effect=full):
        assert "No space left" in refused(capsys, "sweep", file, "--out", store)
    with mock.patch("mrctl.sweep.store.pq.ParquetWriter", side_effect=full):
        assert "No space left" in refused(capsys, "sweep", file, "--out", store)
    assert len(Store(store).done()) == 5 and not Store(store).table.exists()
    jobs.run(sweep, store, 1)
    assert content(store) == whole


# --- interruptions --------------------------------------------------------------------------------

LONG = FILE.replace("chunk = 5", "chunk = 2").replace("length = 0.8", "length = 1.6")
LONG_SWEEP = pytest.mark.xdist_group("long_sweep")  # whose tests share one


@pytest.fixture(scope="module")
def long(tmp_path_factory):
    """A file of a sweep of 12 jobs, and the bytes of its store."""
    folder = tmp_path_factory.mktemp("long")
    (folder / "sweep.toml").write_text(LONG)
    jobs.run(Sweep.from_toml(folder / "sweep.toml"), folder / "store", 1)
    return folder / "sweep.toml", content(folder / "store")


def start(file, store):
    """A sweep whose second half waits for a file `go` beside its store."""
    command = [sys.executable, victim.__file__, "sweep", str(file), "--out", str(store), "--workers", "2"]
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True)


def children(pid):
    """Processes that one has started and that live."""
    found = []
    for status in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            state, parent = status.read_text().rpartition(")")[2].split()[:2]
            if int(parent) == pid and state != "Z":
                found.append(int(status.parent.name))
    return found


def fork_servers(pid):
    """Those of them that fork the workers of a sweep."""
    found = []
    for child in children(pid):
        with contextlib.suppress(OSError):  # a child may end meanwhile
            found += [child] * ("forkserver" in Path(f"/proc/{child}/cmdline").read_text())
    return found


def until(condition, seconds=60.0):
    end = time.monotonic() + seconds
    while not (value := condition()) and time.monotonic() < end:
        time.sleep(0.01)
    assert value
    return value


@LONG_SWEEP
@HERE
@pytest.mark.parametrize("moment", KILLS)
@pytest.mark.parametrize("hit", ["sweep", "worker"])
def test_kill(long, tmp_path, moment, hit):
    """Kill −9 at a random moment of the first half: all runs are there in the end, with the same bytes.

    Before a worker, the process that forks the workers is killed; it is replaced, as it has not forked one yet.
    """
    file, expected = long
    store, chance = tmp_path / "store", random.Random(f"{hit} {moment}")
    process, enough = start(file, store), chance.randrange(7)
    if hit == "worker":
        (server,) = until(lambda: fork_servers(process.pid))
        os.kill(server, signal.SIGKILL)
    until(lambda: (store / "parts").exists() and len(Store(store).done()) >= enough)
    time.sleep(chance.uniform(0, 0.1))
    done = len(Store(store).done())
    if hit == "sweep":
        below = [pid for one in children(process.pid) for pid in (one, *children(one))]
        process.kill()
        process.communicate()
        until(lambda: not any(Path(f"/proc/{pid}").exists() for pid in below), 10)  # nobody works on for a dead sweep
        jobs.run(Sweep.from_toml(file), store, 1)
    else:
        (other,) = until(lambda: {*fork_servers(process.pid)} - {server})
        os.kill(chance.choice(until(lambda: children(other))), signal.SIGKILL)
        (tmp_path / "go").touch()
        _, stderr = process.communicate(timeout=120)
        assert process.returncode == 0 and "Traceback" not in stderr, stderr
    assert content(store) == expected
    print(f"killed the {hit} after {done} of 12 jobs")


@LONG_SWEEP
@HERE
def test_ctrl_c(long, tmp_path):
    """One line, status 130, and the same command goes on."""
    file, expected = long
    store = tmp_path / "store"
    process = start(file, store)
    until(lambda: len(list(store.glob("parts/*.parquet"))) > 2)
    os.killpg(process.pid, signal.SIGINT)
    _, stderr = process.communicate(timeout=20)
    assert process.returncode == 130 and "Traceback" not in stderr
    done = len(Store(store).done())
    last = stderr.strip().splitlines()[-1]
    assert last == f"mrctl: interrupted: {2 * done} of 24 runs are done; the same command goes on", stderr
    assert mrctl.open(store).sizes["run"] == 2 * done < 24
    kept = content(store)
    jobs.run(Sweep.from_toml(file), store, 1)
    assert content(store) == expected
    assert {k: v for k, v in kept.items() if "signals" in k} == {k: expected[k] for k in kept if "signals" in k}


@pytest.mark.parametrize("moment", [0.6, 1.9])
def test_early_ctrl_c(tmp_path, moment):
    """In the first two seconds too, while modules are imported and workers begin: one line and status 130."""
    (tmp_path / "sweep.toml").write_text('runs = 4000\n[base]\nlaps = 2\nlearner = "none"\n')
    command = [sys.executable, "-m", "mrctl", "sweep", str(tmp_path / "sweep.toml"), "--out", str(tmp_path / "store")]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True)
    time.sleep(moment)
    os.killpg(process.pid, signal.SIGINT)
    _, stderr = process.communicate(timeout=60)
    # A process that glfw starts for a moment, to find its library, is interrupted too, and has its own words for that.
    ours = re.sub(r"(?s)Traceback.*?File \"<string>\".*?\nKeyboardInterrupt\n", "", stderr)
    lines = [line for line in said(ours) if "compiling the laws" not in line]
    assert process.returncode == 130 and len(lines) == 1 and lines[0].startswith("mrctl: interrupted"), stderr


@HERE
def test_finished_jobs_are_kept(sweep, tmp_path, whole):
    """A job that is done is not computed again, nor is a sweep."""
    store = tmp_path / "store"
    with pytest.raises(InputError, match="worker 3 is tired"):
        jobs.run(sweep, store, 1, work=tired)
    parts = {part: part.stat().st_mtime_ns for part in store.glob("parts/*")}
    assert len(parts) == 3
    with pytest.raises(InputError, match="worker 4 is tired"):
        jobs.run(sweep, store, 1, work=only_rest)
    assert {part: part.stat().st_mtime_ns for part in parts} == parts
    jobs.run(sweep, store, 1)
    assert content(store) == whole
    jobs.run(sweep, store, 1, work=only_rest)


def tired(path, job):
    return JobOutcome(job, error=f"worker {job} is tired", fatal=True) if job == 3 else compute(path, job)


@HERE
def test_a_small_sweep_keeps_what_it_has_done(file, tmp_path, whole):
    """Without a `chunk` in its file, a sweep of 24 runs that ends early has kept most; it goes on to the same runs."""
    file.write_text(FILE.replace("chunk = 5\n", ""))
    with pytest.raises(InputError, match="worker 3 is tired"):
        jobs.run(Sweep.from_toml(file), tmp_path / "store", 1, work=tired)
    assert mrctl.open(tmp_path / "store").sizes["run"] == 12
    jobs.run(Sweep.from_toml(file), tmp_path / "store", 2)
    assert content(tmp_path / "store")["runs.parquet"] == whole["runs.parquet"]


def only_rest(path, job):
    assert job >= 3
    return JobOutcome(job, error=f"worker {job} is tired", fatal=True) if job == 4 else compute(path, job)


# --- memory ---------------------------------------------------------------------------------------


def instantly(path, job):
    """Rows without runs, so that there can be many."""
    store = Store(path)
    runs = store.runs(job)
    columns = jobs._agreed((store.path / "sweep.json").read_text()).columns
    empty = pa.Table.from_pylist([{"failed": False}] * len(runs), columns)
    store.write(job, empty.set_column(0, columns.field(0), pa.array(runs)), None)
    return JobOutcome(job)


def resident():
    """Memory of this process in MB, without what Arrow's pool holds in reserve."""
    pa.default_memory_pool().release_unused()
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


def test_memory_of_the_sweep_is_flat(tmp_path):
    """A million rows, 130 MB of numbers, are not kept by the process that gathers them."""
    used = []
    for runs in (10_000, 10_000, 1_000_000):
        jobs.run(Sweep.from_dict({"runs": runs, "chunk": 10_000}), tmp_path / str(len(used)), 1, work=instantly)
        used.append(resident())
    assert used[2] - used[1] < 30, used
    assert pq.read_metadata(tmp_path / "2" / "runs.parquet").num_rows == 1_000_000


def test_memory_of_a_worker_is_flat(file, tmp_path):
    """Three times the runs take no more memory."""
    file.write_text(FILE.replace("runs = 12", "runs = 45"))
    sweep = Sweep.from_toml(file)
    used = []
    store = Store.begin(tmp_path, jobs._manifest(sweep))
    first = [*range(3), *range(9, 12)]  # with either learner, whose laws are loaded once
    for some in (first, sorted({*range(18)} - {*first})):
        for job in some:
            assert not compute(str(store.path), job).error
        used.append(resident())
    assert used[1] - used[0] < 2.5, used
