"""Damaged stores and results, and stores that name code: one line names the file, and what is whole still opens."""

import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from unittest import mock

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from test_commands import refused

import mrctl
from mrctl import InputError, cli
from mrctl.cli.shared import show
from mrctl.experiments.tables import Report
from mrctl.sweep import jobs
from mrctl.sweep.plan import Sweep
from mrctl.viewer.recording import Library

BASE = {"laps": 1, "learner": "none", "reference": {"kind": "circle", "radius": 0.5, "period": 4.0}}
MASSES = {"field": "perturbation.mass_factor", "values": [1.0, 1.2, 1.4, 1.6]}
SWEEP = {"record": "full", "chunk": 2, "base": BASE, "axes": [MASSES]}
OWN = """
class Half:
    def __init__(self, robot, size):
        self.gain = 0.5 / robot.velocity_gain, 0.5 / robot.rotation_gain
    def output(self, command, derivative):
        return command * self.gain
    def learn(self, feedback, frozen, twist, voltage):
        pass
"""


@pytest.fixture(scope="module")
def whole(here_throughout: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sweep of two jobs with all signals, one with the user's controller, and a result."""
    folder = tmp_path_factory.mktemp("whole")
    (folder / "own.py").write_text(OWN)
    jobs.run(Sweep.from_dict(SWEEP), folder / "store", 1)
    jobs.run(Sweep.from_dict(SWEEP | {"controller": f"{folder}/own.py:Half"}), folder / "own", 1)
    mrctl.save(mrctl.simulate([mrctl.Scenario.from_dict(BASE)]), folder / "out" / "result.zarr")
    return folder


def flipped(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 3] ^= 0x10
    path.write_bytes(data)


def recoded(path: Path) -> None:
    """Names another codec, as a file from elsewhere may."""
    text = path.read_text()
    path.write_text(re.sub(r'"name": "(zstd|blosc)",', '"name": "gzip",', text))
    assert path.read_text() != text


def corrupt(path: Path) -> None:
    """Changes a number in a table, which without a checksum would be read as another."""
    value = pq.read_table(path)["position_rmse"].to_numpy()[1]
    assert value.tobytes() in path.read_bytes()
    path.write_bytes(path.read_bytes().replace(value.tobytes(), (2 * value).tobytes()))


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def edited(sign: bool = True, **changes: object) -> Callable[[Path], None]:
    """Changes keys of a JSON file; `sweep.json` gets the checksum of what it then holds, unless told otherwise."""

    def damage(path: Path) -> None:
        found = json.loads(path.read_text()) | changes
        if sign and found.pop("checksum", ""):
            text = json.dumps(found, sort_keys=True)
            found["checksum"] = hashlib.sha256(text.encode()).hexdigest()
        path.write_text(json.dumps(found))

    return damage


def replaced(old: str, new: str) -> Callable[[Path], None]:
    """Changes a passage of a file by hand."""

    def replaced(path: Path) -> None:
        assert old in path.read_text()
        path.write_text(path.read_text().replace(old, new, 1))

    return replaced


def cleared(path: Path) -> None:
    path.write_text("{")


SHARD = "store/signals.zarr/signals/c/1/0/0"
ROOT = "result.zarr/zarr.json: damaged: its checksum"
DAMAGES: list[tuple[str, Callable[[Path], None], str]] = [
    (SHARD, flipped, "signals/c/1/0/0"),
    (SHARD, cut, "signals/c/1/0/0"),
    ("store/runs.parquet", cut, "runs.parquet"),
    ("store/runs.parquet", cleared, "runs.parquet"),
    ("store/runs.parquet", Path.unlink, "no job is done"),
    ("store/signals.zarr/signals/zarr.json", cleared, "store"),
    ("store/signals.zarr", shutil.rmtree, "signals.zarr"),
    ("store/sweep.json", cleared, "not a saved result, nor a sweep"),
    ("store/sweep.json", edited(size="x"), "sweep.json: size"),
    ("store/sweep.json", edited(samples=None), "sweep.json: samples"),
    ("store/sweep.json", edited(chunk=0), "sweep.json: chunk"),
    ("store/sweep.json", edited(sweep={}), "sweep.json: sweep.axes"),
    ("store/sweep.json", edited(samples=10**12), "sweep.json: samples"),
    ("store/sweep.json", edited(sign=False, control_period=0.02), "sweep.json: damaged: its checksum"),
    ("store/runs.parquet", corrupt, "runs.parquet"),
    ("out/result.zarr/voltage_left", shutil.rmtree, "result.zarr/voltage_left: missing"),
    ("out/result.zarr/x/zarr.json", recoded, "result.zarr/x: has the codec gzip, which mrctl does not write"),
    ("store/signals.zarr/signals/zarr.json", recoded, "signals.zarr/signals: has the codec gzip"),
    ("out/result.zarr/seed/c/0", cut, "result.zarr/seed: damaged"),
    ("out/result.zarr/x/c", shutil.rmtree, "result.zarr/x: 1 chunks are missing"),
    ("out/result.zarr/x/c/0/0", flipped, "result.zarr/x"),
    ("out/result.zarr/x/zarr.json", cleared, "result.zarr"),
    ("out/result.zarr/zarr.json", cleared, "result.zarr: not a saved result"),
    ("out/result.zarr/zarr.json", replaced('"control_period": 0.01', '"control_period": 0.03'), f"out/{ROOT}"),
    ("out/result.zarr/zarr.json", replaced(r"\"seed\": 0", r"\"seed\": 1"), f"out/{ROOT}"),
    ("out/result.zarr/zarr.json", replaced(r"\"radius\": 0.5", r"\"radius\": 0.6"), f"out/{ROOT}"),
    ("out/result.zarr/x/zarr.json", replaced("little", "big"), "out/result.zarr/x/zarr.json: damaged: its checksum"),
    ("out/result.zarr/x/zarr.json", replaced('"units": "m"', '"units": "mm"'), "result.zarr/x/zarr.json: damaged"),
    ("store/signals.zarr/signals/zarr.json", replaced("little", "big"), "signals/zarr.json: damaged: it does not"),
    ("store/signals.zarr/signals/zarr.json", replaced('"NaN"', "0.0"), "signals/zarr.json: damaged: it does not"),
]


@pytest.mark.parametrize(("file", "damage", "says"), DAMAGES, ids=lambda part: getattr(part, "__name__", str(part)))
def test_damage_is_one_line(
    whole: Path, tmp_path: Path, file: str, damage: Callable[[Path], None], says: str, capsys: pytest.CaptureFixture
) -> None:
    """A damaged file is never read as numbers, and one line names it."""
    name = file.partition("/")[0]
    shutil.copytree(whole / name, tmp_path / name)
    damage(tmp_path / file)
    assert cli.main(["export", str(tmp_path / name), "--to", "csv", "--out", str(tmp_path / "x.csv")]) == 2
    said = capsys.readouterr().err
    assert says in said.replace("not a sweep's store", "not a saved result, nor a sweep") and said.count("\n") == 1
    assert sorted(p.name for p in tmp_path.iterdir()) == [name]


def test_older_results_open(whole: Path, tmp_path: Path) -> None:
    """A result of mrctl 0.10.2 or older, whose metadata have no checksums, opens as before; so does a resaved one."""
    shutil.copytree(whole / "out", tmp_path / "out")
    root = tmp_path / "out/result.zarr/zarr.json"
    about = json.loads(root.read_text())
    assert sorted(about["attributes"].pop("checksums")) == sorted(
        str(file.relative_to(root.parent)) for file in root.parent.rglob("zarr.json")
    )
    root.write_text(json.dumps(about))
    found = mrctl.open(tmp_path / "out")
    assert found.identical(mrctl.open(whole / "out"))
    mrctl.save(found, tmp_path / "again.zarr")
    assert mrctl.open(tmp_path / "again.zarr").identical(found)


def test_damaged_shard_is_named_when_it_is_used(whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """In a notebook a store with a damaged shard opens, and gives what is whole, in any order that is asked for."""
    shutil.copytree(whole / "store", tmp_path / "store")
    found, undamaged = mrctl.open(tmp_path / "store"), mrctl.open(whole / "store")
    for pick in ([3, 0, 2], [], slice(None, None, -1), 2):
        np.testing.assert_array_equal(found["x"][pick, 5:9], undamaged["x"].values[pick, 5:9])
    flipped(tmp_path / SHARD)
    found = mrctl.open(tmp_path / "store")
    np.testing.assert_array_equal(found["x"][[1, 0]], undamaged["x"].values[[1, 0]])
    with pytest.raises(InputError, match="signals/c/1/0/0: damaged"):
        found.load()
    command = [sys.executable, "-m", "mrctl", "export", str(tmp_path / "store"), "--to", "csv", "--out", "x.csv"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 2 and done.stderr.count("\n") == 1, done.stderr  # zarr's other readers say nothing
    assert "damaged" in refused(capsys, "run", str(tmp_path / "store"), "--run", "2")


def test_missing_shard_leaves_its_runs_out(whole: Path, tmp_path: Path) -> None:
    """The runs of a shard that is gone are not NaN without failure: they are left out, and a warning names the file."""
    shutil.copytree(whole / "store", tmp_path / "store")
    shutil.rmtree(tmp_path / "store/signals.zarr/signals/c/1")
    with pytest.warns(UserWarning, match="signals/c/1/0/0: missing; runs 2 to 3 are left out"):
        found = mrctl.open(tmp_path / "store")
    assert found["run"].values.tolist() == [0, 1] and found.attrs["unfinished"] == 2
    np.testing.assert_array_equal(found["x"], mrctl.open(whole / "store")["x"][:2])


def test_missing_shard_is_computed_again(whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """The command that began a sweep makes the signals that are gone again, with the same bytes."""
    shutil.copytree(whole / "store", tmp_path / "store")
    shutil.rmtree(tmp_path / "store/signals.zarr/signals/c/1")
    assert cli.main(["run", str(tmp_path / "store"), "--run", "2"]) == 2
    assert "signals/c/1/0/0: missing; the command" in capsys.readouterr().err
    jobs.run(Sweep.from_dict(SWEEP), tmp_path / "store", 1)
    for file in ("runs.parquet", "signals.zarr/signals/c/0/0/0", "signals.zarr/signals/c/1/0/0"):
        assert (tmp_path / "store" / file).read_bytes() == (whole / "store" / file).read_bytes(), file


def swapped(parts: Path) -> None:
    shutil.copy(parts / "000000.parquet", parts / "000001.parquet")


def renamed(parts: Path) -> None:
    """Gives a column another name, as one bit that flips in the description of the table does."""
    table = pq.read_table(file := parts / "000001.parquet")
    pq.write_table(table.rename_columns({"v_rmse": "v_rmsd"}), file)


def copied(parts: Path) -> None:
    shutil.copy(parts / "000001.parquet", parts / "000001 (copy).parquet")


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (swapped, "000001.parquet: damaged: it does not hold runs 2 to 3"),
        (renamed, "000001.parquet: damaged.* names"),
        (copied, ""),
    ],
)
def test_a_part_is_that_of_its_job(whole: Path, tmp_path: Path, damage: Callable[[Path], None], says: str) -> None:
    """No table is made of rows of other runs or columns; a copy beside a part does no harm."""
    store = shutil.copytree(whole / "store", tmp_path / "store")
    (parts := store / "parts").mkdir()
    for job in range(2):
        pq.write_table(pq.read_table(store / "runs.parquet").slice(2 * job, 2), parts / f"{job:06d}.parquet")
    (store / "runs.parquet").unlink()
    damage(parts)
    if says:
        with pytest.raises(InputError, match=says):
            jobs.run(Sweep.from_dict(SWEEP), store, 1)
        assert not (store / "runs.parquet").exists()
    else:
        assert jobs.run(Sweep.from_dict(SWEEP), store, 1).runs == 4


def test_refused_before_anything_is_driven(whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """A run that is not there, a file that is, a store whose code may not run: one line, and nothing is simulated."""
    (tmp_path / "x.html").write_text("mine")
    store = str(whole / "store")
    with mock.patch("mrctl.sweep.jobs.simulate", side_effect=AssertionError("drives")):
        for words, says in (
            (["view", store, "--run", "99"], "has no run 99"),
            (["view", str(whole / "out"), "--run", "-1"], "has no run -1"),
            (["view", store, "--export", str(tmp_path / "x.html")], "x.html exists already"),
            (["record", store, "--out", str(tmp_path / "none" / "x.gif")], "none is no folder"),
            (["record", str(whole / "own"), "--no-code", "--out", str(tmp_path / "x.gif")], "code: "),
        ):
            assert cli.main(words) == 2
            said = capsys.readouterr().err
            assert says in said and said.count("\n") == 1, said
    assert [file.name for file in tmp_path.iterdir()] == ["x.html"]


def zarr_of(store: Path, **changes: object) -> None:
    """Changes what the signals of a store declare."""
    edited(**changes)(store / "signals.zarr" / "signals" / "zarr.json")


def larger(store: Path) -> None:
    """Signals of 10 TB, though the sweep has 4 runs."""
    zarr_of(store, shape=[1_000_000, 1_250_000, 1])


def longer(store: Path) -> None:
    """Runs of 28 hours, in all files of the store."""
    about = json.loads((store / "signals.zarr/signals/zarr.json").read_text())
    (runs, _, signals), (codec,) = about["shape"], about["codecs"]
    codec["configuration"]["chunk_shape"][1] = 10_000_000
    grid = {"name": "regular", "configuration": {"chunk_shape": [2, 10_000_000, signals]}}
    zarr_of(store, shape=[runs, 10_000_000, signals], chunk_grid=grid, codecs=[codec])
    edited(samples=10_000_000)(store / "sweep.json")


def taller(store: Path) -> None:
    """A table of 140 million equal values."""
    column = pa.repeat(0.0, 1_000_000)
    pq.write_table(pa.table({f"c{k}": column for k in range(140)}), store / "runs.parquet")


def piped(store: Path) -> None:
    """A table that nobody ever writes."""
    (store / "runs.parquet").unlink()
    os.mkfifo(store / "runs.parquet")


@pytest.mark.parametrize(
    ("made", "says"),
    [(larger, "not that of the sweep"), (longer, "declares 20 GB"), (taller, "declares 1 GB"), (piped, "a pipe")],
)
def test_foreign_store_is_bounded(
    whole: Path, tmp_path: Path, made: Callable[[Path], None], says: str, capsys: pytest.CaptureFixture
) -> None:
    """Whatever somebody else's small store declares, every command that opens it refuses it at once, in one line."""
    shutil.copytree(whole / "store", tmp_path / "store")
    made(tmp_path / "store")
    store, commands = str(tmp_path / "store"), [["export", "--to", "npz", "--out", "x.npz"]]
    commands += [["view", "--export", "x.html"], ["run", "--run", "2"]] if made in (taller, piped) else []
    for name, *flags in commands:
        assert cli.main([name, store, *flags]) == 2
        said = capsys.readouterr().err
        assert says in said and said.count("\n") == 1


def test_view_drives_the_controller_of_the_sweep(whole: Path) -> None:
    """A run of a sweep with the user's controller is shown with it, with the bits that are stored."""
    shown = Library(whole / "own").recording(1)
    np.testing.assert_array_equal(shown.log["v"], mrctl.open(whole / "own")["v"].values[1])
    assert shown.controller == "Half"


def test_code_of_a_store(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    """A store names its file absolutely, says so before it runs it, runs no other, and none where that is refused."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "own.py").write_text("raise RuntimeError")
    assert cli.main(["run", str(whole / "own"), "--run", "1"]) == 0
    assert f"mrctl: runs {whole}/own.py:Half, which {whole}/own names" in capsys.readouterr().err
    for command in (["run", "--run", "1"], ["view", "--export", "x.html"]):
        assert cli.main([command[0], str(whole / "own"), *command[1:], "--no-code"]) == 2
        assert f"code: {whole}/own names {whole}/own.py:Half" in capsys.readouterr().err
    own = jobs.user_files.digest(f"{whole}/own.py:Half")
    monkeypatch.setattr(jobs.user_files, "digest", lambda name, beside=True: "of more files" if beside else own)
    assert jobs.stages_of(whole / "own", 1)  # as of a store from before 0.29.0
    monkeypatch.setattr(jobs.user_files, "digest", lambda name, beside=True: "of another file")
    with pytest.raises(InputError, match="has changed since"):
        jobs.stages_of(whole / "own", 1)


BLIND = """
import numpy as np

class Blind:
    def __init__(self, robot, size):
        self.ticks = 0
    def reset(self, pose, twist, period):
        self.start = np.hstack([pose, twist])
    def output(self, encoders, gyro, acceleration, fix, age):
        self.ticks += 1
        return self.start if self.ticks < 3 else np.full((len(gyro), 5), np.nan)
"""


@pytest.mark.usefixtures("no_figures")
def test_a_fault_is_told_wherever_the_run_is_shown(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """A robot whose estimator answers NaN drives on: table, JSON, sweep, its export and the replay say so."""
    (tmp_path / "own.py").write_text(BLIND)
    own, told = f"estimator={tmp_path}/own.py:Blind", "estimator Blind: not finite, tick 2"
    (tmp_path / "short.toml").write_text('laps = 1\nlearner = "none"\nreference = {kind = "circle", period = 6.0}\n')
    command = ["run", str(tmp_path / "short.toml"), "--controller", own]
    assert cli.main([*command, "--out", str(tmp_path / "out")]) == 0
    assert f"\n{told}; the robot coasts on odometry\n" in capsys.readouterr().out
    assert Library(tmp_path / "out").recording(0).faults == [f"{told}; the robot coasts on odometry"]
    assert cli.main([*command, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["faults"] == [f"{told}; the robot coasts on odometry"]
    sweep = {"record": "metrics", "base": BASE, "axes": [MASSES], "controller": own}
    jobs.run(Sweep.from_dict(sweep), tmp_path / "store", 1)
    found = mrctl.open(tmp_path / "store")
    assert found["estimator_fault"].values.tolist() == [told] * 4
    assert found["feedforward_fault"].values.tolist() == [""] * 4 and not found["failed"].any()
    assert cli.main(["export", str(tmp_path / "out"), "--to", "npz", "--out", str(tmp_path / "x.npz")]) == 0
    assert np.load(tmp_path / "x.npz")["estimator_fault"].tolist() == [told]


@pytest.mark.parametrize(
    ("command", "shown"),
    [
        (["run", "--laps", "1", "--learner", "none", "reference:circle"], "| lap | "),
        (["navigate", "doorway:3", "--learner", "none"], "| arrived | "),
    ],
)
def test_full_disk_costs_no_table(
    command: list[str], shown: str, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    """What was driven is printed before its files are written, which may fail."""
    with mock.patch("mrctl.results.plots.save", side_effect=OSError(28, "No space left on device")):
        assert cli.main([command[0], "--out", str(tmp_path / "out"), *command[1:]]) == 2
    told = capsys.readouterr()
    assert shown in told.out
    assert told.err.splitlines()[-1] == "mrctl: No space left on device"


def test_closed_pipe_costs_no_file() -> None:
    """What was driven is saved where nobody reads what is printed."""
    saved = mock.Mock()
    with mock.patch("builtins.print", side_effect=BrokenPipeError), pytest.raises(BrokenPipeError):
        show(Report("table", "", saved), None, False)
    saved.assert_called_once()
