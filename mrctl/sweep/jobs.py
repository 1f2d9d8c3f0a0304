"""Runs a sweep job by job, and repeats single runs of it."""

from __future__ import annotations

import hashlib
import json
import os
import sys
from collections.abc import Callable, Iterable, Sequence
from functools import cache, lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import xarray as xr
from numpy.typing import NDArray
from tqdm import tqdm

from mrctl import __version__
from mrctl.control.stages import METHODS, Stages
from mrctl.control.weights import MAX_BYTES
from mrctl.loop import user_files
from mrctl.loop.groups import arranged, cores
from mrctl.loop.hindsight import best_fixed
from mrctl.loop.outcome import titles
from mrctl.loop.runs import simulate
from mrctl.loop.simulation import Simulation
from mrctl.physics import mjcf
from mrctl.physics.files import robot_path, world_path
from mrctl.record import InputError, printable, read_file
from mrctl.results import metrics
from mrctl.results.dataset import FAULTS, SIGNALS, versions
from mrctl.scenario import Scenario
from mrctl.sweep.axes import CONTROLLER_FIELD
from mrctl.sweep.plan import Sweep
from mrctl.sweep.pool import Cluster, JobOutcome, Pool, Processes, Work, carry_out, check_address
from mrctl.sweep.store import Store
from mrctl.theory.robot import CAR, RobotFile

# rooms on which no stored run depends
SHOWING_ROOMS = ("checks", "envs", "experiments", "viewer", "cli", "__main__.py")
TOLERANCE = 1e-9  # relative difference within which a repeated run agrees
SET_ASIDE = "set aside: "


class SweepReport(NamedTuple):
    """How a sweep ended."""

    runs: int
    failed: int
    """Number of runs that failed, including those of jobs that were set aside."""
    aside: dict[range, str]
    """Why a job could not be done, by the runs of the job."""


def run(
    sweep: Sweep,
    out: str | Path,
    workers: int | None = None,
    scheduler: str | None = None,
    progress: bool = False,
    work: Work | None = None,
) -> SweepReport:
    """Runs a sweep, or those jobs of it that are not done yet.

    The store holds the same values for any number of workers and any interruptions. In a script, call this function
    under `if __name__ == "__main__":`, because the workers import the script.

    Args:
        sweep: The sweep to run.
        out: Folder of the store.
        workers: Number of processes on this machine, one core each; by default the number of cores.
        scheduler: Address of a Dask scheduler to use instead.
        progress: Whether to show a progress bar.
        work: Function that a worker calls to compute a job; by default `compute`.

    Raises:
        InputError: The sweep is invalid; the folder belongs to another sweep or version of mrctl, is in use or cannot
            be written; or no scheduler answers.
    """
    if workers is not None and (scheduler or workers < 1):
        raise InputError("workers: not together with a scheduler" if scheduler else f"workers: {workers} is below 1")
    if scheduler is not None:
        check_address(scheduler)
    sweep.check_draws()
    sweep = _absolute(sweep)
    work, path = work or compute, Path(out).absolute()
    try:
        manifest = _manifest(sweep)  # first, so that a refused sweep leaves nothing behind
        Store.prepare(path)
        with Store.locked(path):
            store = Store.begin(path, manifest)
            sweep = Sweep.from_dict(store.manifest["sweep"], "sweep")  # whose numbers may be rounded differently
            pending = sorted(set(range(store.jobs)) - store.done())
            aside = {}
            if pending:
                count = workers or cores()
                pool = Cluster(work, str(path), scheduler) if scheduler else Processes(work, str(path), count)
                try:
                    aside = _drive(store, pending, pool, progress)
                finally:
                    pool.close()
            if pending or not store.complete:
                lost = {job: [_row(sweep, k, SET_ASIDE + why) for k in store.runs(job)] for job, why in aside.items()}
                rows = (
                    _table(sweep, lost[job]) if job in lost else store.rows(job, sweep.columns)
                    for job in range(store.jobs)
                )
                store.finish(sweep.columns, rows, complete=not aside)
            failed = _failed([store.table])
            return SweepReport(store.size, failed, {store.runs(job): why for job, why in sorted(aside.items())})
    except OSError as error:
        done = any([*path.glob("parts/[0-9]*.parquet"), *path.glob("runs.parquet")])
        kept = "; what was done is kept" if done else ""
        raise InputError(f"{out}: {error.strerror or error}{kept}") from None


def _absolute(sweep: Sweep) -> Sweep:
    """Returns the sweep with absolute paths of what learners start from and of the user's controllers.

    Raises:
        InputError: A file is missing.
    """
    sweep = sweep.with_files({file: str(Path(file).absolute()) for file in sweep.files})
    if sweep.controller:
        return sweep.model_copy(update={"controller": user_files.absolute(sweep.controller)})
    axes = list(sweep.axes)
    for place, axis in enumerate(axes):
        if axis.field == CONTROLLER_FIELD:
            own = {value: one.own for value, one in axis.chosen.items() if one.own}
            whole = {value: value.removesuffix(name) + user_files.absolute(name) for value, name in own.items()}
            axes[place] = axis.replace(values=[whole.get(value, value) for value in axis.listed])
    return sweep.replace(axes=axes) if axes != list(sweep.axes) else sweep


def _drive(store: Store, pending: Sequence[int], pool: Pool, progress: bool) -> dict[int, str]:
    """Lets the pool compute jobs, with a progress bar; returns why some were set aside, by job."""
    kept = store.size - sum(len(store.runs(job)) for job in pending)
    failed = _failed(store.path.glob("parts/[0-9]*.parquet")) if kept and progress else 0
    with tqdm(total=store.size, initial=kept, unit="run", disable=not progress) as bar:
        bar.set_postfix(failed=failed)

        def ended(outcome: JobOutcome) -> None:
            nonlocal failed
            size = len(store.runs(outcome.job))
            failed += size if outcome.error else outcome.failed
            bar.set_postfix(failed=failed, refresh=False)
            bar.update(size)

        try:
            return carry_out(pool, pending, ended)
        except KeyboardInterrupt:
            pool.close()  # otherwise a worker would finish another job while the jobs are counted
            done = sum(len(store.runs(job)) for job in store.done())
            raise KeyboardInterrupt(f"{done} of {store.size} runs are done; the same command goes on") from None


def _failed(tables: Iterable[Path]) -> int:
    """Counts the runs in tables that failed."""
    return sum(int(pq.read_table(table, columns=["failed"])["failed"].to_numpy().sum()) for table in tables)


def _manifest(sweep: Sweep) -> dict[str, Any]:
    """Describes a sweep; a store can only continue a sweep with the same description.

    Raises:
        InputError: A world does not compile, or the robot cannot follow the reference.
    """
    models = _models(sweep)
    for own, runs in sweep.drivers.items():
        _try(sweep, own, runs)
    return {
        "sweep": sweep.model_dump(mode="json"),
        "versions": versions(),
        "code": code_digest(),
        "models": models,
        "size": sweep.size,
        "chunk": sweep.chunk_size,
        "samples": sweep.samples,
        "stride": sweep.stride,
        "control_period": sweep.control_period,
        "signals": list(SIGNALS),
    }


def _try(sweep: Sweep, own: str | None, runs: Sequence[int]) -> None:
    """Builds the first of some runs that can be built, and tries the user's controller that drives it.

    Raises:
        InputError: None of these runs that are valid can be built, or the controller fails.
    """
    refusals: list[InputError] = []
    for scenario in filter(None, map(sweep.valid, runs)):
        try:
            Simulation([user_files.without_learned(own, scenario) if own else scenario])
        except InputError as error:  # the draws of one run say nothing about the others
            refusals.append(error)
            continue
        if own:
            user_files.trial(own, scenario)
        return
    if refusals:
        raise refusals[0]


@cache
def code_digest(but: tuple[str, ...] = SHOWING_ROOMS) -> str:
    """Returns a digest of all files but those of some rooms; by default of those on which the runs of a sweep depend.

    The version of mrctl stays the same between two commits; this digest does not, so that a sweep that was begun before
    a law was changed is not finished after it.
    """
    package = Path(__file__).parents[1]
    found = hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        if path.relative_to(package).parts[0] not in but:
            found.update(path.read_bytes())
    return found.hexdigest()


def _models(sweep: Sweep) -> dict[str, str]:
    """Returns digests of the compiled worlds with their robots, of the user's stages, and of `files`, by name."""
    worlds = {_model(*one): mjcf.digest(mjcf.load(one[0], one[1], robot=one[2])) for one in sweep.worlds}
    return worlds | {own: user_files.digest(own) for own in sweep.drivers if own} | _digests(sweep.files)


def _model(world: str, steering: str | None, robot: RobotFile) -> str:
    """Returns the name of a world with a robot in it among the digests."""
    return ", ".join(filter(None, (world, steering))) + (f", {robot.path}" if robot != CAR else "")


def _digests(files: Iterable[str]) -> dict[str, str]:
    """Returns the SHA-256 of files from which learners start, by name.

    Raises:
        InputError: A file cannot be read.
    """
    return {file: hashlib.sha256(read_file(file, MAX_BYTES)).hexdigest() for file in files}


def compute(path: str, job: int) -> JobOutcome:
    """Computes the runs of a job in a worker and writes them to the store.

    Args:
        path: Folder of the store.
        job: Number of the job.
    """
    try:
        store = Store(path)
        sweep = _agreed(json.dumps(store.manifest))
        rows, signals = _compute(sweep, store.runs(job), store.samples)
        _check_alike(_digests(sweep.files), store.manifest)  # again: a file may have changed or gone meanwhile
        store.write(job, _table(sweep, rows), signals)
        return JobOutcome(job, failed=sum(row["failed"] for row in rows))
    except InputError as error:
        return JobOutcome(job, error=str(error), fatal=True)
    except OSError as error:
        return JobOutcome(job, error=f"{path}: {error.strerror or error}", fatal=True)
    except Exception as error:  # noqa: BLE001 (whatever the error is, the other jobs go on)
        return JobOutcome(job, error=" ".join(f"{type(error).__name__}: {error}".split()))


@lru_cache(1)
def _agreed(manifest: str) -> Sweep:
    """Returns the sweep of a store, after a check that this worker computes the same.

    Raises:
        InputError: This worker has other versions or other worlds than the process that began the store.
    """
    agreed, worker = json.loads(manifest), _worker()
    for name, version in versions().items():
        if version != (begun := agreed["versions"].get(name)):
            raise InputError(f"{worker}: has {name} {version}, but the store was begun with {name} {begun}")
    if agreed.get("code") != code_digest():
        raise InputError(f"{worker}: has other laws than the process that began the store")
    sweep = Sweep.from_dict(agreed["sweep"], "sweep")
    _check_alike(_models(sweep), agreed)
    return sweep


def _check_alike(models: dict[str, str], agreed: dict[str, Any]) -> None:
    """Raises `InputError` if this worker has other worlds or files than those of a manifest."""
    if unlike := [name for name, digest in models.items() if digest != agreed["models"].get(name)]:
        raise InputError(f"{_worker()}: {unlike[0]} is not the store's")


def _worker() -> str:
    return f"worker {os.getpid()} on {os.uname().nodename}"


def driver(sweep: Sweep, stages: Stages) -> Callable[..., xr.Dataset]:
    """Returns what drives the scenarios of a sweep, with the user's stages: `simulate`, or `best_fixed`."""
    return best_fixed if sweep.hindsight else partial(simulate, **stages)


def _compute(
    sweep: Sweep, runs: Sequence[int], samples: int, driven: xr.Dataset | None = None
) -> tuple[list[dict[str, Any]], NDArray | None]:
    """Drives runs; returns their rows of the table, and signals `(runs, samples, signals)` if the store keeps them.

    Args:
        sweep: The sweep.
        runs: Numbers of the runs.
        samples: Number of samples of a run that the store keeps.
        driven: Result of a single run, which is then not driven again.
    """
    rows: dict[int, dict[str, Any]] = {}
    signals = np.full((len(runs), samples, len(SIGNALS)), np.nan) if samples else None
    batches: dict[tuple[str | None, float], dict[int, Scenario]] = {}
    for run in runs:
        try:
            scenario = sweep.scenario(run)
            batches.setdefault((sweep.driven_by(run), scenario.control_period), {})[run] = scenario
        except InputError as error:  # a drawn value is out of range
            rows[run] = _row(sweep, run, str(error).removeprefix(f"run {run}: "))
    queue = [(own, batch) for (own, _), batch in batches.items()]
    for own, batch in queue:
        drive = driver(sweep, user_files.load(own) if own else {})
        try:
            result = drive(list(batch.values()), threads=1) if driven is None else driven
        except InputError as error:
            if len(batch) == 1:
                rows |= {run: _row(sweep, run, str(error)) for run in batch}
            else:  # a run that is impossible must not prevent the others
                queue.extend((own, {run: scenario}) for run, scenario in batch.items())
            continue
        raised = any(str(why).startswith((*METHODS,)) for why in result["failure"].values)
        if own and len(batch) > 1 and raised:
            # A stage that raises ends its whole batch; computed alone, a run does not depend on the others.
            queue.extend((own, {run: scenario}) for run, scenario in batch.items())
            continue
        rows |= _measured(sweep, batch, result)
        if signals is not None:
            kept = np.stack([result[name].values[:, :: sweep.stride] for name in SIGNALS], axis=-1)
            signals[[run - runs[0] for run in batch], : kept.shape[1]] = kept
    return [rows[run] for run in runs], signals


def _measured(sweep: Sweep, runs: Iterable[int], result: xr.Dataset) -> dict[int, dict[str, Any]]:
    """Returns the rows of runs of a sweep that were driven, by run, with the metrics of their result."""
    laps = metrics.per_lap(result)
    texts = {name: result[name].values for name in ("failure", *FAULTS)}
    samples = -(-result["samples"].values // sweep.stride)  # that are kept if the run lasts
    table = metrics.summary(laps).assign(lap_time=laps["lap_time"].values, samples=samples, **texts)
    if sweep.record == "laps":
        for name in metrics.METRICS:
            table[f"{name}_per_lap"] = [v[:n] for v, n in zip(laps[name].values, laps["laps"].values, strict=True)]
    found = zip(runs, table.to_dict("records"), strict=True)
    return {run: _row(sweep, run, **{str(name): value for name, value in row.items()}) for run, row in found}


def _row(sweep: Sweep, run: int, failure: str = "", **found: object) -> dict[str, Any]:
    """Makes a row of the table: the description of a run, and its metrics, which are NaN unless they are `found`."""
    values, valid = sweep.values(run), sweep.valid(run)
    scenario = valid or sweep.base_of(run)
    row: dict[str, Any] = {name: np.nan for name in (*metrics.METRICS, "lap_time")}
    row |= {name: [] for name in sweep.columns.names if name.endswith("_per_lap")} | dict.fromkeys(FAULTS, "")
    own = sweep.driven_by(run)
    label, feedforward = titles(scenario, {part.stage: part.title for part in user_files.split(own)} if own else {})
    row |= {"run": run, "label": scenario.name or label, "feedforward": feedforward}
    row |= {
        "steering": found.get("steering") or arranged(scenario).steering,
        "seed": valid.seed if valid else values["seed"],
        "laps": 0,
        "samples": 0,
    }
    row |= {"failed": bool(failure), "failure": failure, "failure_time": 0.0 if failure else np.nan}
    return row | found | {axis.field: axis.cell(values[axis.field]) for axis in sweep.axes}


def _table(sweep: Sweep, rows: Sequence[dict[str, Any]]) -> pa.Table:
    return pa.Table.from_pylist(list(rows), schema=sweep.columns)


class Repeat(NamedTuple):
    """The comparison of a repeated run with the store."""

    verdict: str
    """`bit-identical`, `within tolerance`, or `departs` and where, with the versions of mrctl if they differ."""
    same: bool
    """Whether the run agrees with the store."""


def scenario_of(out: str | Path, run: int) -> Scenario:
    """Returns the scenario of one run of a stored sweep.

    Raises:
        InputError: There is no store or no such run, a value that was drawn for it is out of range, or another version
            of mrctl, which the message names, wrote a field that this one does not know.
    """
    return sweep_of(Store(out)).scenario(run)


def stages_of(out: str | Path, run: int, code: bool = True) -> Stages:
    """Loads the user's stages of one run, as arguments of `simulate`; names on stderr the files that it runs.

    Args:
        out: The store.
        run: Number of the run.
        code: Whether the store may run the Python files that it names.

    Raises:
        InputError: There is no such run, or the store names files that it may not run, or that are missing or have
            changed since.
    """
    store = Store(out)
    if not (controller := sweep_of(store).driven_by(run)):
        return {}
    if not code:
        raise InputError(f"code: {out} names {printable(controller)}, which --no-code does not allow")
    # Stores of versions before 0.29.0 have the digest without the files beside the controller.
    if store.manifest["models"].get(controller) not in [
        user_files.digest(controller, beside) for beside in (True, False)
    ]:
        raise InputError(
            f"controller: {printable(controller)}, or a file beside it that it imports, has changed since {out} was "
            "computed"
        )
    print(f"mrctl: runs {printable(controller)}, which {out} names", file=sys.stderr)
    return user_files.load(controller)


def sweep_of(store: Store) -> Sweep:
    """Returns the sweep of a store that any version of mrctl may have written."""
    return Sweep.from_dict(store.manifest["sweep"], f"{store.path} (written by mrctl {store.writer})")


def check_files(out: str | Path, run: int) -> None:
    """Refuses one run of a stored sweep if its world, its robot or what its learner starts from is not as it was.

    Raises:
        InputError: A file is missing or has changed; the message names it, or the world with steering and robot.
    """
    store = Store(out)
    if (scenario := sweep_of(store).valid(run)) is None:
        return
    world_path(scenario.world)
    if scenario.robot != CAR:
        robot_path(scenario.robot)
    files = _digests(filter(None, (scenario.learned, scenario.fel.weights)))
    if store.manifest["versions"] == versions():  # others may compile the same files to another model
        model = mjcf.load(scenario.world, scenario.steering, robot=scenario.robot)
        files[_model(scenario.world, scenario.steering, scenario.robot)] = mjcf.digest(model)
    for file, digest in files.items():
        if store.manifest["models"].get(file, digest) != digest:
            raise InputError(f"{file}: has changed since {out} was computed")


def repeat(out: str | Path, run: int, driven: xr.Dataset | None = None) -> Repeat:
    """Repeats one run of a sweep alone and compares it with the store.

    Args:
        out: The store.
        run: Number of the run.
        driven: Result of this run, where it has been driven already.

    Raises:
        InputError: As `scenario_of` and `check_files`, or the run is not done yet or was set aside.
    """
    check_files(out, run)
    store = Store(out)
    sweep = sweep_of(store)
    sweep.values(run)  # raises an error if there is no such run
    if (stored := store.row(run)) is None:
        raise InputError(f"run: {run} is not done yet")
    if stored["failure"].startswith(SET_ASIDE):
        raise InputError(f"run: {run} was {stored['failure']}; there is nothing to compare with")
    (row,), signals = _compute(sweep, [run], store.samples, driven)
    reasons = [one["failure"] or "it finished" for one in (row, stored)]
    writers = "" if store.writer == __version__ else f" (of mrctl {store.writer}; this is mrctl {__version__})"
    if reasons[0] != reasons[1]:
        return Repeat(f"departs: {reasons[0]}, in the store {reasons[1]}{writers}", False)
    names = [*metrics.METRICS, "failure_time", *(name for name in row if name.endswith("_per_lap"))]
    names = [name for name in names if name in stored]  # an older version computed fewer
    pairs = {name: (np.array(row[name], float, ndmin=1), np.array(stored[name], float, ndmin=1)) for name in names}
    if signals is not None:
        kept = store.signals(run)
        recorded = dict(zip(store.signal_names, kept.T, strict=True))
        pairs |= {
            f"signal {name}": (signals[0, :, k], recorded[name]) for k, name in enumerate(SIGNALS) if name in recorded
        }
    if all(new.tobytes() == old.tobytes() for new, old in pairs.values()):
        return Repeat("bit-identical", True)
    scale = {name: TOLERANCE * np.abs(old).max(initial=0, where=np.isfinite(old)) for name, (_, old) in pairs.items()}
    for name, (new, old) in pairs.items():
        if new.shape != old.shape:
            return Repeat(f"departs: {name} has {new.size} values, in the store {old.size}{writers}", False)
    off = {name: ~np.isclose(*pair, rtol=0, atol=scale[name], equal_nan=True) for name, pair in pairs.items()}
    if not any(one.any() for one in off.values()):
        return Repeat(f"within tolerance ({TOLERANCE:g} of each signal's and metric's size)", True)
    name = min((name for name in off if off[name].any()), key=lambda name: (len(off[name]) == 1, off[name].argmax()))
    place = int(off[name].argmax())
    when = f" at t = {store.times[place]:g} s" if name.startswith("signal") else ""
    new, old = (float(one[place]) for one in pairs[name])
    return Repeat(f"departs: {name} is {new!r}{when}, in the store {old!r}{writers}", False)
