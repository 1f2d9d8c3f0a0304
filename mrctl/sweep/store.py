"""The store of a sweep: a folder that stays valid when its process is killed at any moment.

    STORE/sweep.json        the sweep, versions, digests of worlds and files; written first, whole or not at all
    STORE/runs.parquet      the table of runs, one row each, in order; written when no job is left
    STORE/parts/000012.parquet   rows of job 12; folded into the table, and removed once every job is in it
    STORE/signals.zarr      (run, time, signal), NaN where nothing was recorded; shard 12 is the record of job 12
    STORE/lock              held, through the operating system, by the one process that runs the sweep

`mrctl.open` reads a store that another version of mrctl wrote, in this format or an older one: a metric that the
old version did not compute is NaN. Only the version that began a sweep continues it. Format 1 did not list its signals;
formats 1 and 2 had checksums of the signals alone, format 3 has them in every file. What the `zarr.json` of its signals
must hold follows from `sweep.json`, with which it is compared.

One job owns one shard and one part. Each file is written under a temporary name, synchronised and renamed, the part
last: the existence of a part says that its job is done. A job that is computed twice writes the same bytes twice.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import shutil
import socket
import uuid
import warnings
from collections.abc import Iterable, Iterator
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, BinaryIO

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import xarray as xr
import zarr
from numpy.typing import NDArray
from pydantic import ConfigDict, Field
from zarr.codecs import BloscCodec, Crc32cCodec
from zarr.core.buffer import default_buffer_prototype
from zarr.storage import MemoryStore

from mrctl import __version__
from mrctl.kernel import Array
from mrctl.record import InputError, Record, read_file, reading
from mrctl.results.dataset import (
    FAULTS,
    SIGNALS,
    check_codecs,
    check_declared,
    checksum,
    only_files,
    open_result,
    reading_chunks,
)
from mrctl.results.metrics import METRICS
from mrctl.scenario import MAX_TICKS
from mrctl.sweep.signals import DIMENSIONS, lazily

MAX_PLAN_BYTES = 2**28  # largest size of sweep.json in bytes
KIND, FORMAT = "mrctl sweep", 3
ROUNDING = 1e-12
"""Largest relative difference between a number of a sweep and that of its store that counts as rounding; the store
keeps its own number. Drawn references are computed with functions that another processor rounds differently."""
CHECKSUM = "checksum"  # key in sweep.json: the checksum of all others
ROW_GROUP = 16384  # number of rows of the table that are written at once
INNER_RUNS = 16  # runs that are compressed together, signal by signal
COMPLETE = b"complete"  # key in the metadata of the table; b"1" if it holds every job


class _Axis(Record):
    model_config = ConfigDict(extra="ignore")
    field: str


class _Described(Record):
    model_config = ConfigDict(extra="ignore")
    axes: tuple[_Axis, ...]
    record: str
    controller: str | None = None


class _Manifest(Record):
    """Fields that every manifest must hold, whichever version wrote it."""

    model_config = ConfigDict(extra="ignore")
    sweep: _Described
    models: dict[str, str]
    size: Annotated[int, Field(ge=0, le=100_000_000)]
    chunk: Annotated[int, Field(ge=1, le=100_000_000)]
    samples: Annotated[int, Field(ge=0, le=MAX_TICKS)]
    stride: Annotated[int, Field(ge=1)]
    control_period: Annotated[float, Field(gt=0)]
    signals: tuple[str, ...] = ()


class Store:
    """The folder of one sweep.

    Attributes:
        path: The folder.
        writer: The version of mrctl that began it.
        manifest: What `sweep.json` holds: `sweep`, `versions`, `code` (a digest), `models`, `size`, `chunk`, `samples`,
            `stride` (control periods between samples), `control_period` in s, `signals` (names of the signals kept).
    """

    def __init__(self, path: str | Path) -> None:
        """Opens a store that exists.

        Raises:
            InputError: There is none, its `sweep.json` is damaged, or its format is newer than this version knows.
        """
        self.path = Path(path).absolute()
        try:
            self.manifest: dict[str, Any] = json.loads(read_file(self.path / "sweep.json", MAX_PLAN_BYTES))
            found, self.writer = self.manifest[KIND], str(self.manifest["versions"]["mrctl"])
        except (ValueError, KeyError, TypeError, RecursionError):
            raise InputError(f"{path}: not a sweep's store") from None
        _Manifest.from_dict(self.manifest, f"{path}/sweep.json")
        if found not in range(1, FORMAT + 1):
            raise InputError(
                f"{path}: mrctl {self.writer} wrote this store in format {found}; "
                f"mrctl {__version__} reads formats up to {FORMAT}"
            )
        if self.manifest.pop(CHECKSUM, None) != checksum(self.manifest) and found > 2:
            raise InputError(f"{path}/sweep.json: damaged: its checksum is that of another text")

    @staticmethod
    def prepare(path: Path) -> None:
        """Makes the folder of a store unless it exists.

        Raises:
            InputError: There is something else at this path, which is left untouched, or the path is not UTF-8.
        """
        try:
            str(path).encode()
        except UnicodeEncodeError:
            raise InputError(f"{path}: the name is not UTF-8") from None
        if not path.exists():
            path.mkdir(parents=True)
        elif not path.is_dir():
            raise InputError(f"{path}: a file, not a sweep's store")
        elif not (path / "sweep.json").is_file():
            # A sweep that was killed before it wrote sweep.json has left nothing but these files.
            if foreign := sorted(e.name for e in path.iterdir() if e.name != "lock" and not _temporary(e)):
                raise InputError(f"{path}: holds {foreign[0]} and is not a sweep's store; nothing was touched")
        else:
            Store(path)

    @classmethod
    def begin(cls, path: Path, manifest: dict[str, Any]) -> Store:
        """Starts or continues a sweep in a folder whose lock is held.

        Raises:
            InputError: The folder belongs to another sweep, or was begun with other versions.
        """
        manifest = json.loads(json.dumps({KIND: FORMAT, **manifest}))
        if not (path / "sweep.json").exists():
            with _whole(path / "sweep.json") as file:
                file.write(json.dumps(manifest | {CHECKSUM: checksum(manifest)}, indent=1).encode())
        store = cls(path)
        if store.writer != __version__:
            raise InputError(
                f"{path}: mrctl {store.writer} began this sweep and this is mrctl {__version__}, whose results may "
                f"differ; finish it with mrctl {store.writer} or choose another folder"
            )
        began = store.manifest["models"]
        if changed := [name for name, digest in manifest["models"].items() if began.get(name, digest) != digest]:
            raise InputError(
                f"{path}: {changed[0]} has changed since this sweep was begun; finish it with the former one or choose "
                "another folder"
            )
        if difference := _difference(store.manifest, manifest):
            raise InputError(f"{path}: begun with another {difference}; finish it as it was or choose another folder")
        for left in [*path.glob(".*.tmp"), *path.glob("parts/.*.tmp"), *path.glob("signals.zarr/**/*.partial")]:
            left.unlink(missing_ok=True)
        if store.samples and not (path / "signals.zarr" / "signals" / "zarr.json").exists():
            store._array(path / "signals.zarr", len(store.signal_names))
        return store

    @staticmethod
    @contextlib.contextmanager
    def locked(path: Path) -> Iterator[None]:
        """Locks the folder; the system unlocks it when this process ends, however it ends.

        Raises:
            InputError: Another process has locked it.
        """
        import fcntl  # not on Windows

        with (path / "lock").open("a+b") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                file.seek(0)
                holder = file.read(200).decode(errors="replace").strip() or "another process"
                raise InputError(f"{path}: {holder} is running this sweep") from None
            file.truncate(0)
            file.write(f"process {os.getpid()} on {socket.gethostname()}".encode())
            file.flush()
            yield

    @property
    def size(self) -> int:
        """Number of runs."""
        return self.manifest["size"]

    @property
    def samples(self) -> int:
        """Number of samples of each signal in a run."""
        return self.manifest["samples"]

    @property
    def signal_names(self) -> list[str]:
        """Names of the signals, in the order of the record.

        Raises:
            InputError: An older version of mrctl kept another number of signals without their names.
        """
        if "signals" not in self.manifest and (count := self._signals.shape[2]) != len(SIGNALS):
            raise InputError(
                f"{self.path}: mrctl {self.writer} kept {count} signals without their names and mrctl {__version__} "
                f"has {len(SIGNALS)}; open the store with mrctl {self.writer}"
            )
        return self.manifest.get("signals", list(SIGNALS))

    @property
    def times(self) -> Array:
        """Times of the samples in s."""
        return self.manifest["control_period"] * (self.manifest["stride"] * np.arange(self.samples))

    @property
    def jobs(self) -> int:
        """Number of jobs."""
        return math.ceil(self.size / self.manifest["chunk"])

    def runs(self, job: int) -> range:
        """Returns the numbers of the runs of a job."""
        chunk = self.manifest["chunk"]
        return range(job * chunk, min((job + 1) * chunk, self.size))

    @property
    def table(self) -> Path:
        """Path of the table of runs."""
        return self.path / "runs.parquet"

    @property
    def complete(self) -> bool:
        """Whether the table holds every job."""
        with reading(self.table):
            return self.table.exists() and pq.read_schema(self.table).metadata.get(COMPLETE) == b"1"

    def done(self) -> set[int]:
        """Returns the numbers of the jobs that are done; one whose signals are missing has to be done again."""
        jobs, parts = range(self.jobs), (self.path / "parts").glob("[0-9]*.parquet")
        numbers = {int(part.stem) for part in parts if part.stem.isdecimal()}  # "000012 (copy)" is no part
        found = set(jobs) if self.complete else {job for job in numbers if job in jobs and self._part(job).exists()}
        return {job for job in found if not self._lost(job)}

    def _lost(self, job: int) -> bool:
        """Tells whether the signals of a job are missing though one of its runs drove."""
        if not self.samples or self._shard(job).exists():
            return False
        return bool(_drove(self.rows(job).select(["failed", "failure_time"]).to_pandas()).any())

    def _part(self, job: int) -> Path:
        return self.path / "parts" / f"{job:06d}.parquet"

    def write(self, job: int, rows: pa.Table, signals: Array | None) -> None:
        """Writes the results of a job: signals `(runs, samples, signals)`, then rows, which show that it is done.

        Dask cannot stop a job that runs: it may end after another machine has finished the sweep.
        """
        if self.complete and not self._lost(job):
            return
        if signals is not None:
            runs = self.runs(job)
            self._signals[runs.start : runs.stop] = signals  # zarr renames a whole shard
            if (shard := self._shard(job)).exists():
                _synchronise(shard)  # zarr keeps no shard that is all NaN
        self._part(job).parent.mkdir(exist_ok=True)
        buffer = pa.BufferOutputStream()
        pq.write_table(rows, buffer, write_page_checksum=True)
        with _whole(self._part(job)) as file:
            file.write(buffer.getvalue())

    def _shard(self, job: int) -> Path:
        return self.path / "signals.zarr" / "signals" / "c" / str(job) / "0" / "0"

    def lost(self, frame: pd.DataFrame) -> dict[Path, list[int]]:
        """Returns the missing shards of jobs with a run that drove, each with the runs of its job in the table."""
        if not self.samples:
            return {}
        _ = self._signals  # raises an error where there are none at all
        jobs = frame["run"] // self.manifest["chunk"]
        found = ((job, self._shard(job)) for job in sorted(set(jobs[_drove(frame)])))
        return {shard: frame["run"][jobs == job].tolist() for job, shard in found if not shard.exists()}

    def rows(self, job: int, columns: pa.Schema | None = None) -> pa.Table:
        """Returns the rows of a job that is done.

        Args:
            job: Number of the job.
            columns: Columns that its file must have; by default those that it has.

        Raises:
            InputError: The file is damaged, or holds other runs or columns.
        """
        source, runs = self._part(job) if self._part(job).exists() else self.table, self.runs(job)
        filters = [("run", ">=", runs.start), ("run", "<", runs.stop)] if source == self.table else None
        with reading(source):
            found = pq.read_table(source, filters=filters, page_checksum_verification=True)
            if found["run"].to_pylist() != [*runs]:
                raise InputError(f"{source}: damaged: it does not hold runs {runs[0]} to {runs[-1]}")
            return found if columns is None else found.cast(columns)

    def row(self, run: int) -> dict[str, Any] | None:
        """Returns the row of one run, or None if the run is not done."""
        job = run // self.manifest["chunk"]
        source = self._part(job) if self._part(job).exists() else self.table
        self._check_size([source] if source.exists() else [])
        with reading(source):
            if not source.exists():
                return None
            found = pq.read_table(source, filters=[("run", "=", run)], page_checksum_verification=True).to_pylist()
        return found[0] if found else None

    def signals(self, run: int) -> Array:
        """Returns the signals of one run `(samples, signals)`, if the store keeps them.

        Raises:
            InputError: The file with them is missing or damaged.
        """
        job = run // self.manifest["chunk"]
        if self._lost(job):
            raise InputError(f"{self._shard(job)}: missing; the command that began the sweep makes it again")
        with reading_chunks(self._shard(job)):
            return np.asarray(self._signals[run])

    def finish(self, schema: pa.Schema, rows: Iterable[pa.Table], complete: bool) -> None:
        """Writes the rows of all jobs to the table, with a bounded number of rows in memory.

        Args:
            schema: Columns of the table.
            rows: Rows of each job in turn.
            complete: Whether all jobs are done; their parts are then removed.
        """
        schema = schema.with_metadata({COMPLETE: b"1" if complete else b"0"})
        with _whole(self.table) as file, pq.ParquetWriter(file, schema, write_page_checksum=True) as writer:
            for group in _regroup(rows):
                writer.write_table(group.cast(schema), ROW_GROUP)
        if complete:
            shutil.rmtree(self.path / "parts")

    @cached_property
    def _signals(self) -> zarr.Array:
        path = self.path / "signals.zarr" / "signals"
        check_codecs(path)
        with reading(self.path / "signals.zarr"):
            found = zarr.open_array(path, mode="r+", zarr_format=3)
            signals = len(self.manifest.get("signals", ())) or (found.shape[-1] if found.shape else 0)
            expected = self._array(MemoryStore(), signals)
        if (found.shape, found.shards, found.chunks) != self._layout(signals):
            raise InputError(f"{path}: of shape {found.shape}, which is not that of the sweep")
        if self.manifest[KIND] > 2 and _written(found) != _written(expected):
            raise InputError(f"{path}/zarr.json: damaged: it does not describe the signals of this sweep")
        return found

    def _layout(self, signals: int) -> tuple[tuple[int, ...], ...]:
        """Returns the shapes of the array of all signals, of a shard, and of a chunk of it."""
        chunk = self.manifest["chunk"]
        return (
            (self.size, self.samples, signals),
            (chunk, self.samples, signals),
            (math.gcd(chunk, INNER_RUNS), self.samples, 1),
        )

    def _check_size(self, tables: Iterable[Path], samples: int = 0) -> None:
        """Refuses tables of rows, or samples of all signals, that take far more memory than the store on the disk.

        Raises:
            InputError: They would, or a file of the store is a pipe or a device.
        """
        stored, values = only_files(self.path), samples * len(self.signal_names) if samples else 0
        for table in tables:
            with reading(table):
                about = pq.read_metadata(table)
                groups = (about.row_group(k) for k in range(about.num_row_groups))
                values += sum(group.column(k).num_values for group in groups for k in range(group.num_columns))
        check_declared(self.path, 8 * values, stored)

    def _array(self, place: Path | MemoryStore, signals: int) -> zarr.Array:
        """Creates the array of all signals `(runs, samples, signals)` in a folder, or in memory to compare with it."""
        shape, shards, chunks = self._layout(signals)
        return zarr.open_group(place, mode="a").create_array(
            "signals",
            shape=shape,
            shards=shards,
            chunks=chunks,
            dtype="float64",
            fill_value=np.nan,
            compressors=[BloscCodec(cname="zstd", clevel=3, shuffle="shuffle"), Crc32cCodec()],
            dimension_names=DIMENSIONS,
        )

    def frame(self) -> pd.DataFrame:
        """Reads the table of the runs that are done.

        Raises:
            InputError: No run is done.
        """
        old = []
        if self.table.exists():
            self._check_size([self.table])
            with reading(self.table):
                old = [pq.read_table(self.table, page_checksum_verification=True).to_pandas()]
        jobs = [] if self.complete else sorted(self.done())
        if not (jobs or old):
            raise InputError(f"{self.path}: no job is done yet")
        self._check_size(map(self._part, jobs))
        found = pd.concat([self.rows(job).to_pandas() for job in jobs] + old, ignore_index=True)
        return found.drop_duplicates("run").sort_values("run", ignore_index=True)  # of a job done since, the new rows

    def dataset(self) -> xr.Dataset:
        """Opens the runs that are done as one dataset, labelled as by `mrctl.simulate`; signals are read when used.

        Runs whose signals are missing are left out, with a warning.

        Raises:
            InputError: No run is done, an older version kept signals without their names, or a file is damaged; the
                message names it.
        """
        with reading(self.path):
            return self._dataset(self.frame())

    def _dataset(self, frame: pd.DataFrame) -> xr.Dataset:
        for shard, runs in self.lost(frame).items():
            warnings.warn(f"{shard}: missing; runs {runs[0]} to {runs[-1]} are left out", stacklevel=4)
            frame = frame.loc[~frame["run"].isin(runs)]
        frame[[name for name in METRICS if name not in frame]] = np.nan
        units = {"lap_time": "s", "failure_time": "s"} | {name: unit for name, (unit, _) in METRICS.items()}

        def columns(names: Iterable[str]) -> dict[str, Any]:
            attrs = {name: {"units": unit} for name, unit in units.items()}
            return {name: ("run", _plain(frame, name), attrs.get(name, {})) for name in names}

        axes = [axis["field"] for axis in self.manifest["sweep"]["axes"]]
        coords = columns(["run", *axes, "label", "feedforward", "steering", "seed", "lap_time"])
        coords |= columns(["samples"] if "samples" in frame else [])  # older versions did not write it
        outcome = columns(["failed", "failure", "failure_time", *(name for name in FAULTS if name in frame)])
        attrs = {name: json.dumps(self.manifest[name]) for name in ("sweep", "versions")}
        attrs |= {"control_period": self.manifest["control_period"], "unfinished": self.size - len(frame)}
        if self.manifest["sweep"]["record"] == "laps":
            number, found = _by_lap(frame)
            coords.pop("laps", None)  # `laps` may be an axis too
            return xr.Dataset(outcome | found, coords | {"lap": number}, attrs)
        if not self.samples:
            return xr.Dataset(outcome | columns(METRICS), coords, attrs)
        self._check_size([], len(frame) * self.samples)
        whole = lazily(self.path / "signals.zarr" / "signals", self._shard).assign_coords(signal=self.signal_names)
        signals = whole.isel(run=frame["run"].to_numpy()).to_dataset("signal")
        for name, (unit, meaning) in SIGNALS.items():
            if name in signals:
                signals[name].attrs = {"units": unit, "long_name": meaning}
        coords["time"] = ("time", self.times, {"units": "s"})
        return signals.assign(outcome).assign_coords(coords).assign_attrs(attrs)


def open(path: str | Path) -> xr.Dataset:
    """Opens a result or a store that `mrctl sweep`, `mrctl run --out` or `mrctl.save` wrote.

    A sweep opens as one dataset of the runs that are done, with its axes as coordinates of `run`. The dataset holds
    the signals (run, time) if they were recorded, what `per_lap` returns (run, lap) if laps were, and otherwise the
    metrics of the last lap (run,). The table of runs is `runs.parquet` in the folder.

    Raises:
        InputError: There is neither at this path, or another version of mrctl, which the message names, wrote a store
            that this one cannot read.
    """
    path = Path(path)
    if (path / "sweep.json").is_file():
        return Store(path).dataset()
    return open_result(path / "result.zarr" if (path / "result.zarr").exists() else path)


def _drove(frame: pd.DataFrame) -> NDArray[np.bool]:
    """Tells of each row of the table whether its run drove at all, so that it has signals."""
    return ~(frame["failed"].to_numpy(bool) & ~(frame["failure_time"].to_numpy(float) > 0))


def _by_lap(frame: pd.DataFrame) -> tuple[NDArray[np.intp], dict[str, Any]]:
    """Returns the numbers of the laps, `(laps,)`, and as variables how many each run has, and the metrics of every lap.

    Metrics are NaN beyond the laps of a run, and where an older version of mrctl did not compute them.
    """
    one = next(name for name in frame if str(name).endswith("_per_lap"))
    counts = frame[one].map(len).to_numpy(np.int64)  # the column `laps` may be that of an axis
    number = np.arange(1, counts.max(initial=0) + 1)
    found: dict[str, Any] = {"laps": ("run", counts)}
    for name, (unit, _) in METRICS.items():
        values = np.full((len(frame), len(number)), np.nan)
        column = f"{name}_per_lap"
        for row, laps in enumerate(frame[column] if column in frame else ()):
            values[row, : len(laps)] = laps
        found[name] = (("run", "lap"), values, {"units": unit})
    return number, found


def _plain(frame: pd.DataFrame, name: str) -> NDArray:
    """Returns a column as a NumPy array, with text as objects."""
    column = frame[name].to_numpy()
    return column if column.dtype.kind in "bif" else column.astype(object)


@contextlib.contextmanager
def _whole(path: Path) -> Iterator[BinaryIO]:
    """Opens a file for writing that appears on the disk whole or not at all."""
    partial = path.with_name(f".{path.name}.{uuid.uuid4().hex}.tmp")
    try:
        with partial.open("xb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)
    _synchronise(path.parent)


def _synchronise(path: Path) -> None:
    """Makes sure that a file or folder has reached the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _written(array: zarr.Array) -> object:
    """Returns what this version of zarr would write to the `zarr.json` of an array."""
    return json.loads(array.metadata.to_buffer_dict(default_buffer_prototype())["zarr.json"].to_bytes())


def _temporary(path: Path) -> bool:
    return path.name.startswith(".sweep.json.") and path.name.endswith(".tmp")


def _regroup(tables: Iterable[pa.Table]) -> Iterator[pa.Table]:
    """Yields the same rows in tables of `ROW_GROUP` rows."""
    held: list[pa.Table] = []
    for table in tables:
        held.append(table)
        while sum(map(len, held)) >= ROW_GROUP:
            whole = pa.concat_tables(held)
            yield whole.slice(0, ROW_GROUP)
            held = [whole.slice(ROW_GROUP)]
    if held:
        yield pa.concat_tables(held)


def _difference(old: object, new: object, where: str = "") -> str:
    """Returns the first place where two trees of plain data differ, with both values, or "" if they are equal.

    Floats count as equal up to the relative difference `ROUNDING`.
    """
    if isinstance(old, dict) and isinstance(new, dict):
        pairs = [(str(key), old.get(key), new.get(key)) for key in {**old, **new}]
    elif isinstance(old, list) and isinstance(new, list) and len(old) == len(new):
        pairs = [(str(k), *pair) for k, pair in enumerate(zip(old, new, strict=True))]
    elif isinstance(old, float) and isinstance(new, float) and math.isclose(old, new, rel_tol=ROUNDING):
        return ""
    else:
        return "" if old == new else f"{where} ({_short(old)}, now {_short(new)})"
    return next(filter(None, (_difference(a, b, f"{where}.{key}".strip(".")) for key, a, b in pairs)), "")


def _short(value: object) -> str:
    text = json.dumps(value)
    return text if len(text) < 40 else f"{text[:16]} ... {text[-19:]}"  # of a controller, its settings are at the end
