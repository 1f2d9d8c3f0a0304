"""A sweep on a Dask cluster: a real scheduler and two worker processes on loopback, some of which are killed."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import tomllib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import victim
from test_sweeps import FILE, children, content, failures, poisoned, refused, until

from mrctl import InputError, Scenario, Sweep, cli
from mrctl.experiments import (
    journal,
    learned_limits,
    mission_suite,
    navigation_suite,
    reactive_corridors,
    three_mppis,
)
from mrctl.sweep import jobs
from mrctl.sweep.store import Store

pytestmark = pytest.mark.xdist_group("sweep_dask")  # what its tests share is made once

pytest.importorskip("distributed")
DASK = {
    "DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "1",
    "DASK_DISTRIBUTED__WORKER__MULTIPROCESSING_METHOD": "forkserver",
}
LONG = FILE.replace("chunk = 5", "chunk = 2")  # 12 jobs

# Not imported: in a test process it would start the fork server that the pool of a sweep shares, without its imports.
WORKERS = "--nworkers", "2", "--nthreads", "1", "--preload-nanny", str(Path(__file__).with_name("forking.py"))


def dask(*arguments):
    """A Dask command, on loopback, in a process group of its own; workers find the tests' functions.

    A job may kill two workers, and not four, before the scheduler gives it up: a new worker takes a moment to begin.
    """
    paths = os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "PYTHONPATH": paths, **DASK}
    command = [sys.executable, "-m", "dask", *arguments, "--host", "127.0.0.1", "--no-dashboard"]
    silent = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    return subprocess.Popen(command, start_new_session=True, env=environment, **silent)


def address_in(file):
    """The address of a scheduler in its file, or nothing while it is being written."""
    try:
        return json.loads(file.read_text())["address"]
    except (OSError, json.JSONDecodeError):
        return ""


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    """Address of a scheduler, the process that starts its two workers, and its own."""
    file = tmp_path_factory.mktemp("dask") / "scheduler.json"
    processes = [dask("scheduler", "--port", "0", "--scheduler-file", str(file))]
    where = "--scheduler-file", str(file), "--local-directory", str(file.parent)
    try:
        until(lambda: address_in(file))
        processes.append(dask("worker", *where, *WORKERS))
        yield address_in(file), processes[1], processes[0]
    finally:
        for process in reversed(processes):
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def sent(file, store, address):
    """`mrctl sweep` on a cluster; its second half waits for a file `go` beside the store."""
    command = [sys.executable, victim.__file__, "sweep", str(file), "--out", str(store), "--scheduler", address]
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True)


def worker_of(starter):
    """One of the processes that compute."""
    return until(lambda: [pid for server in children(starter.pid) for pid in children(server)])[0]


def test_killed_worker(cluster, tmp_path):
    """The scheduler gives the job to the other worker; the store is the one that local processes make."""
    address, workers, _ = cluster
    assert address.startswith("tcp://127.0.0.1:")
    sweep, store = Sweep.from_dict(tomllib.loads(LONG)), tmp_path / "store"

    def kill():
        try:
            until(lambda: len(list(store.glob("parts/*.parquet"))) > 3)
            done, worker = len(Store(store).done()), worker_of(workers)
            os.kill(worker, signal.SIGKILL)
            return done, worker
        finally:
            (tmp_path / "go").touch()

    with ThreadPoolExecutor(1) as thread:
        killing = thread.submit(kill)
        assert not jobs.run(sweep, store, scheduler=address, work=victim.held).aside
    done, worker = killing.result()
    assert done < 12 and not Path(f"/proc/{worker}").exists()
    jobs.run(sweep, tmp_path / "local", 1)
    assert content(store) == content(tmp_path / "local")


def test_interrupted_on_a_cluster_resumed_at_home(cluster, tmp_path):
    """Ctrl-C keeps what was done, leaves the cluster alone, and the sweep goes on anywhere."""
    address, *_ = cluster
    file, store = tmp_path / "sweep.toml", tmp_path / "store"
    file.write_text(LONG)
    process = sent(file, store, address)
    until(lambda: len(list(store.glob("parts/*.parquet"))) > 3)
    process.send_signal(signal.SIGINT)
    _, stderr = process.communicate(timeout=30)
    assert process.returncode == 130 and "Traceback" not in stderr, stderr
    assert "the same command goes on" in stderr.strip().splitlines()[-1]
    assert 4 <= len(Store(store).done()) < 12
    (tmp_path / "go").touch()
    assert not jobs.run(Sweep.from_toml(file), store, 1).aside
    assert cli.main(["sweep", str(file), "--out", str(tmp_path / "cluster"), "--scheduler", address]) == 0
    assert content(store) == content(tmp_path / "cluster")


def test_poison(cluster, tmp_path):
    """A job that kills every worker that takes it is set aside; the others finish."""
    address, *_ = cluster
    sweep = Sweep.from_dict(tomllib.loads(FILE))
    report = jobs.run(sweep, tmp_path / "store", scheduler=address, work=poisoned)
    assert report.aside == {range(5, 10): "its worker died repeatedly"}
    assert report.failed == len({*failures(sweep), *range(5, 10)})


def test_suite_of_missions(cluster, tmp_path, monkeypatch):
    """`mrctl navigate --suite` computes the same on a cluster as here, but says where it was computed."""
    for part in (mission_suite, reactive_corridors, learned_limits):
        monkeypatch.setattr(part, "DRAWS", {"quick": 1})
    monkeypatch.setattr(mission_suite, "SPEEDS", (0.6,))
    monkeypatch.setattr(mission_suite, "CONTROLLERS", ("none", "model"))
    for part in (mission_suite, reactive_corridors):
        monkeypatch.setattr(part, "PLANTS", {"nominal": part.PLANTS["nominal"]})
    monkeypatch.setattr(learned_limits, "PLANTS", {name: learned_limits.PLANTS[name] for name in ("nominal", "all")})
    monkeypatch.setattr(three_mppis, "WORLDS", {"quick": 1})
    monkeypatch.setattr(three_mppis, "PLANTS", {"nominal": three_mppis.PLANTS["nominal"]})
    folders = tmp_path / "there", tmp_path / "here"
    assert list(navigation_suite.suite(Scenario(), "quick", folders[0], cluster[0])) == list(
        navigation_suite.suite(Scenario(), "quick", folders[1])
    )
    for part in ("table", "reactive", "mppi", "limits"):
        kept = [sorted((folder / f"{part}.jsonl").read_text().splitlines()) for folder in folders]
        assert len(kept[0]) > 2 and kept[0] == kept[1]
        there, here = (json.loads((folder / f"{part}.json").read_text()) for folder in folders)
        assert there.pop("machine")["processor"] == "a Dask cluster" != here.pop("machine")["processor"]
        assert there == here


@pytest.mark.parametrize("what", ["code", "robot"])
def test_other_workers(what, cluster, tmp_path, monkeypatch):
    """Workers with other code, or with another robot in the same file, are refused, and nothing is kept of them."""
    monkeypatch.setattr(learned_limits, "DRAWS", {"quick": 1})
    monkeypatch.setattr(navigation_suite, "PARTS", navigation_suite.PARTS[-1:])
    if what == "code":
        monkeypatch.setattr(journal, "code_digest", lambda but: "another")
    else:
        monkeypatch.setattr(navigation_suite.mjcf, "digest", lambda model: "another")
    with pytest.raises(InputError, match=f"^worker .* has another {what} than this process"):
        list(navigation_suite.suite(Scenario(), "quick", tmp_path / "out", cluster[0]))
    assert len((tmp_path / "out" / "limits.jsonl").read_text().splitlines()) == 1


def test_no_scheduler(tmp_path, capsys, monkeypatch):
    """One line that names the address."""
    monkeypatch.setattr("mrctl.sweep.pool.SCHEDULER_PATIENCE", 1.0)
    file = tmp_path / "sweep.toml"
    file.write_text(FILE)
    for address in ("tcp://127.0.0.1:1", "nonsense://x"):
        assert address in refused(capsys, "sweep", file, "--out", tmp_path / "store", "--scheduler", address)
        suite = "navigate", "--suite", "--quick", "--out", tmp_path / "suite"
        assert address in refused(capsys, *suite, "--scheduler", address) and not (tmp_path / "suite").exists()
    assert cli.main(["sweep", str(file), "--out", str(tmp_path / "store"), "--workers", "1"]) == 0


def test_lost_scheduler(cluster, tmp_path):
    """One line, what was done is kept, and the sweep goes on without; no test after this one has the cluster."""
    address, _, scheduler = cluster
    file, store = tmp_path / "sweep.toml", tmp_path / "store"
    file.write_text(LONG)
    process = sent(file, store, address)
    until(lambda: len(list(store.glob("parts/*.parquet"))) > 3)
    os.killpg(scheduler.pid, signal.SIGKILL)
    _, stderr = process.communicate(timeout=60)
    assert process.returncode == 2 and "Traceback" not in stderr, stderr
    assert "scheduler: tcp://127.0.0.1" in stderr and "what was done is kept" in stderr.splitlines()[-1]
    assert 4 <= len(Store(store).done()) < 12
    assert jobs.run(Sweep.from_toml(file), store, 1).runs == 24 and Store(store).complete
