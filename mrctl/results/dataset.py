"""Labelled results: datasets of signals with their units, and how they are saved and opened."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import json
import os
import shutil
import uuid
from collections.abc import Collection, Iterator, Sequence
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from mrctl import __version__
from mrctl.kernel import Array
from mrctl.record import InputError, printable, read_file, reading
from mrctl.scenario import Scenario

MAX_SMALL_BYTES = 2**30  # bytes of signals that any result may have
MAX_EXPANSION = 1000  # bytes of signals that a larger result may have for each byte in its files
MAX_ABOUT_BYTES = 2**30  # largest zarr.json in bytes; that of a result holds the scenarios, 3 kB or more for each run

# Name: (unit, meaning). A sample at time t holds the state at t, the commands computed from it, and the currents and
# power at the end of the control period that begins at t; the commands act after the delay.
SIGNALS: dict[str, tuple[str, str]] = {
    "x": ("m", "position of P along the world's x axis"),
    "y": ("m", "position of P along the world's y axis"),
    "theta": ("rad", "heading"),
    "v": ("m/s", "linear velocity"),
    "omega": ("rad/s", "yaw rate"),
    "v_lateral": ("m/s", "lateral velocity of P (slip)"),
    "wheel_rate_left": ("rad/s", "left wheel rate"),
    "wheel_rate_right": ("rad/s", "right wheel rate"),
    "steering_angle": ("rad", "steering angle"),
    "x_ref": ("m", "reference x"),
    "y_ref": ("m", "reference y"),
    "theta_ref": ("rad", "reference heading"),
    "v_ref": ("m/s", "reference linear velocity"),
    "omega_ref": ("rad/s", "reference yaw rate"),
    "longitudinal_error": ("m", "longitudinal error, reference minus true posture in the body frame"),
    "lateral_error": ("m", "lateral error, reference minus true posture in the body frame"),
    "heading_error": ("rad", "heading error, reference minus true posture in the body frame"),
    "x_measured": ("m", "estimated x"),
    "y_measured": ("m", "estimated y"),
    "theta_measured": ("rad", "estimated heading"),
    "v_measured": ("m/s", "estimated linear velocity"),
    "omega_measured": ("rad/s", "estimated yaw rate"),
    "variance_x": ("m2", "variance of the estimated x; 0 where the estimator has none, here and below"),
    "covariance_xy": ("m2", "covariance of the estimated x and y"),
    "variance_y": ("m2", "variance of the estimated y"),
    "variance_theta": ("rad2", "variance of the estimated heading"),
    "variance_v": ("m2/s2", "variance of the estimated linear velocity"),
    "variance_omega": ("rad2/s2", "variance of the estimated yaw rate"),
    "fix_x": ("m", "x of the posture fix that arrived, NaN where none did, here and below"),
    "fix_y": ("m", "y of the posture fix that arrived"),
    "fix_theta": ("rad", "heading of the posture fix that arrived"),
    "encoder_left": ("rad", "angle of the left wheel by its encoder"),
    "encoder_right": ("rad", "angle of the right wheel by its encoder"),
    "gyro": ("rad/s", "yaw rate by the gyro"),
    "acceleration_x": ("m/s2", "specific force forward by the accelerometer"),
    "acceleration_y": ("m/s2", "specific force to the left by the accelerometer"),
    "slip": ("1", "slip ratio of the driven wheel that slips more, as sensors show it; above 0.1 nothing is learned"),
    "v_command": ("m/s", "commanded linear velocity"),
    "omega_command": ("rad/s", "commanded yaw rate"),
    "feedback_left": ("V", "left feedback voltage"),
    "feedback_right": ("V", "right feedback voltage"),
    "feedforward_left": ("V", "left feedforward voltage"),
    "feedforward_right": ("V", "right feedforward voltage"),
    "voltage_left": ("V", "left commanded voltage"),
    "voltage_right": ("V", "right commanded voltage"),
    "steering_command": ("rad", "commanded steering angle"),
    "steering_rate_command": ("rad/s", "commanded steering rate"),
    "saturated": (
        "1", "whether a limit acted on the sum of feedback and feedforward: that of the supply, of the driver's "
        "current or, with `rigid` steering, of the steering angle, which is held at rest",
    ),
    "weight_norm": ("1", "size of what the feedforward has learned"),
    "current_left": ("A", "left motor current"),
    "current_right": ("A", "right motor current"),
    "power": ("W", "electrical power"),
    "guard": ("1", "what the guard does: 0 nothing, 1 fallback"),
    "guard_reason": ("1", "why, as an index into `mrctl.control.guard.REASONS`"),
    "retunes": ("1", "moves that slowed the controllers as the PID oscillated; see `mrctl.control.delay`"),
    "z": ("m", "height of the middle between the driven wheels"),
    "roll_angle": ("rad", "roll, positive to the right; after heading and pitch, about the robot's own axis"),
    "pitch_angle": ("rad", "pitch, positive nose down; after the heading"),
    "feedforward_limited": (
        "1", "whether prior and learner ask for more than the supply (or, with `rigid` steering, than the largest "
        "yaw rate), to which the guard limits them before the feedback is added",
    ),
    "motor_voltage_left": ("V", "voltage at the left motor, after delay, dead zone, driver, battery and current limit"),
    "motor_voltage_right": ("V", "voltage at the right motor"),
}  # fmt: skip

# Variables with the gains of each run at its start, before any event: name: (unit, meaning). `k_p` and `k_i` have the
# dimensions run and channel, common and second; a steering channel (`rigid`) has K_p without unit and K_i in 1/s.
GAIN_VARIABLES: dict[str, tuple[str, str]] = {
    "k_p": ("V/(m/s), V/(rad/s)", "K_p of the PID for the common and the second channel; 1 on a steering channel"),
    "k_i": ("V/m, V/rad", "K_i of the PID for the common and the second channel; 1/s on a steering channel"),
    "k_x": ("1/s", "K_x of the motion controller"),
    "k_y": ("1/m2", "K_y of the motion controller"),
    "k_theta": ("1/m", "K_θ of the motion controller"),
    "prefilter": ("s", "time constant of the prefilter on the velocities that the motion controller adds"),
}

# Variables that hold the first tick at which the user's stage returned NaN or infinity ("" if it never did), and what
# drives the robot from then on.
FAULTS = {
    "estimator_fault": "the robot coasts on odometry",
    "feedforward_fault": "the guard lets PID and nominal model drive it",
}

# Attribute of a saved result: its variables, each of whose files holds all chunks, even with only NaN.
VARIABLE_NAMES = "variables"
ALL_CHUNKS_BEFORE_0_10_2 = "all_chunks"  # the same without their names
CHECKSUMS = "checksums"  # attribute of a saved result: what `_checksums` returns; older results lack it
CODECS = {"bytes", "vlen-utf8", "zstd", "blosc", "crc32c", "sharding_indexed"}  # all that mrctl ever wrote
ADDED_SIGNALS = (  # signals that results of older versions lack
    "z", "roll_angle", "pitch_angle", "retunes", "feedforward_limited", "motor_voltage_left", "motor_voltage_right",
)  # fmt: skip

TICK = np.dtype([(name, "f8") for name in SIGNALS])  # the signals of one robot at one control tick


def blank(*shape: int) -> NDArray[np.void]:
    """Returns records of `TICK` in which everything is NaN."""
    return np.full((*shape, len(SIGNALS)), np.nan).view(TICK)[..., 0]


def versions() -> dict[str, str]:
    """Returns the versions of the packages that simulate, control and learn."""
    others = ("mujoco", "dm-control", "numpy", "numba", "torch")
    return {"mrctl": __version__} | {name: _installed(name) for name in others}


@cache
def _installed(name: str) -> str:
    """Returns the version of a package; it is cached, because reading it takes a millisecond."""
    return metadata.version(name)


def faults_of(run: xr.Dataset) -> list[str]:
    """Returns what happened to the stages of the user in one run that drove on, a sentence for each fault."""
    found = {name: str(run[name].values) for name in FAULTS if name in run}
    return [f"{text}; {FAULTS[name]}" for name, text in found.items() if text]


def written_by(result: xr.Dataset) -> str:
    """Returns the version of mrctl that made a result, such as `0.2.0`; "" if the dataset does not say."""
    return json.loads(result.attrs.get("versions", "{}")).get("mrctl", "")


JOINED = (
    "run: two different runs have one number, as results of different simulate calls have; these cannot be joined; use "
    "plots.compare_errors(a, b), drive all scenarios in one call of simulate, or sweep over the axis controller"
)
"""What is wrong with a result after xr.concat, which keeps the scenarios of one result alone."""

NEEDED_ATTRIBUTES = {"scenarios", "versions", "control_period"}
"""Attributes of a result that can be saved."""


def check_kind(result: object) -> None:
    """Refuses what is no dataset.

    Raises:
        InputError: It is something else.
    """
    if not isinstance(result, xr.Dataset):
        raise InputError(f"result: must be an xarray.Dataset, as from simulate, not of type {type(result).__name__}")


METRICS_ONLY = (
    "result: holds metrics only, which are in the table STORE/runs.parquet, for pandas.read_parquet; mrctl run STORE "
    "--run K --out DIR makes the signals of one run"
)


def require(result: xr.Dataset, names: Collection[str]) -> None:
    """Checks that a result has the variables that are about to be read.

    Raises:
        InputError: One is missing, as may happen with a result of an older mrctl; the message names that version. Or
            the result holds metrics only.
    """
    check_kind(result)
    if "time" in names and "time" not in result.variables:
        raise InputError(METRICS_ONLY)
    for name in names:
        if name not in result.variables:
            writer = f", which mrctl {version} wrote" if (version := written_by(result)) else ""
            raise InputError(f"{name}: not a variable of this result{writer}")


def dataset(
    scenarios: Sequence[Scenario],
    labels: Sequence[str],
    feedforwards: Sequence[str],
    log: NDArray[np.void],
    failure: Sequence[str],
    failure_time: Array,
    weights: Array | None,
) -> xr.Dataset:
    """Labels the record of a batch of runs.

    Args:
        scenarios: The scenario of each run.
        labels: Label of each run that has no name.
        feedforwards: Name of the feedforward of each run.
        log: One record of `TICK` for each tick and run, `(ticks, B)`.
        failure: For each run why it stopped early, or "".
        failure_time: For each run when it stopped in s, or NaN, `(B,)`.
        weights: Flattened weights of each run's learner at the end, `(B, n)`, or None.

    Returns:
        Variables (run, time) by signal, `failed`, `failure`, `failure_time` and `weights`; coordinates label,
        feedforward, steering, seed, lap_time and samples.
    """
    period = scenarios[0].control_period
    variables: dict[str, tuple] = {
        name: (("run", "time"), log[name].T, {"units": unit, "long_name": meaning})
        for name, (unit, meaning) in SIGNALS.items()
    }
    variables["failed"] = ("run", np.array([bool(reason) for reason in failure]))
    variables["failure"] = ("run", np.array(failure, dtype=object))
    variables["failure_time"] = ("run", failure_time, {"units": "s"})
    coords: dict[str, object] = {
        "time": ("time", period * np.arange(len(log)), {"units": "s"}),
        "run": np.arange(len(scenarios)),
        "label": ("run", np.array([s.name or label for s, label in zip(scenarios, labels, strict=True)], object)),
        "feedforward": ("run", np.array(feedforwards, object)),
        "steering": ("run", np.array([s.steering for s in scenarios], object)),
        "seed": ("run", np.array([s.seed for s in scenarios])),
        "lap_time": ("run", np.array([lap_time(s) for s in scenarios]), {"units": "s"}),
        "samples": ("run", np.array([s.ticks for s in scenarios]), {"long_name": "samples of the run if it lasts"}),
    }
    if weights is not None:
        variables["weights"] = (("run", "weight"), weights, {"long_name": "what was learned, flat"})
        coords["weight"] = np.arange(weights.shape[1])  # networks of different sizes align on it
    return xr.Dataset(variables, coords)


def lap_time(scenario: Scenario) -> float:
    """Returns the time of a lap in s; NaN for a run to a goal, all of which counts as one lap."""
    return scenario.reference.period if scenario.goal is None else np.nan


def combine(groups: Sequence[tuple[Sequence[int], xr.Dataset]], scenarios: Sequence[Scenario]) -> xr.Dataset:
    """Combines batches into one result, runs in the order of the scenarios; shorter runs are padded with NaN."""
    parts = [part.assign_coords(run=list(rows)) for rows, part in groups]
    whole = parts[0]  # one is not copied
    if len(parts) > 1:
        whole = xr.concat(parts, "run", join="outer", data_vars="minimal", coords="minimal").sortby("run")
        whole = whole.assign({k: v.fillna("") for k, v in whole.data_vars.items() if v.dtype == object})  # some lack it
    whole.attrs = {
        "scenarios": json.dumps([s.model_dump(mode="json") for s in scenarios]),
        "versions": json.dumps(versions()),
        "control_period": scenarios[0].control_period,
    }
    return whole


def scenarios_of(result: xr.Dataset) -> list[Scenario]:
    """Returns the resolved scenarios of the runs in a result, or in a selection of them, to run again.

    Raises:
        InputError: Another version of mrctl, which the message names, wrote a scenario that this one does not know; or
            as `held_scenarios`.
    """
    source = f"scenario of a result of mrctl {written_by(result)}"
    return [Scenario.from_dict(one, source) for one in held_scenarios(result)]


def held_scenarios(result: xr.Dataset) -> list[dict[str, Any]]:
    """Returns the fields of the scenarios of the runs in a result, or in a selection of them.

    Raises:
        InputError: A selection has lost the numbers of its runs, or has other ones, or two runs have one number, so
            that nothing tells which scenario is whose.
    """
    every = json.loads(result.attrs["scenarios"])
    if "run" in result.coords:
        numbers = np.atleast_1d(result["run"]).tolist()
        if foreign := set(numbers) - set(range(len(every))):
            raise InputError(f"run: {min(foreign)} is the number of none of the {len(every)} scenarios in the result")
        if not unique_runs(result):
            raise InputError(JOINED)
        return [every[run] for run in numbers]
    if len(every) != result.sizes.get("run", 1):
        raise InputError("run: the selection has lost the number of its run; select it without drop=True")
    return every


def unique_runs(result: xr.Dataset) -> bool:
    """Tells whether runs with the same number are the same run, as in a selection with repetition."""
    if "run" not in result.coords:
        return True
    places = dict[int, int]()
    return all(
        (first := places.setdefault(run, place)) == place or result.isel(run=first).equals(result.isel(run=place))
        for place, run in enumerate(np.atleast_1d(result["run"]).tolist())
    )


def save(result: xr.Dataset, path: str | Path) -> None:
    """Writes a result as a zarr store, whole or not at all.

    Raises:
        InputError: The dataset, such as an opened sweep or results that were joined, is none that `open` could read, or
            the path exists, cannot be written, or is that of a file in another format.
    """
    check_kind(result)
    if missing := NEEDED_ATTRIBUTES - set(result.attrs):
        raise InputError(
            f"result: lacks the attribute {min(missing)}, without which mrctl could not open it; result.to_zarr(path) "
            "writes any dataset"
        )
    if not unique_runs(result):
        raise InputError(JOINED)
    from zarr.codecs import Crc32cCodec, ZstdCodec  # imported here because a run that saves nothing needs no zarr

    path = Path(path)
    if path.suffix in (".nc", ".h5"):
        raise InputError(f"{path}: a result is saved as a folder in Zarr; result.to_netcdf(path) writes NetCDF")
    partial = path.with_name(f".{path.name}.{uuid.uuid4().hex}.partial")
    try:
        if path.exists():
            raise InputError(f"{path}: exists already, nothing was overwritten")
        partial.parent.mkdir(parents=True, exist_ok=True)
        checked = {str(name): {"compressors": (ZstdCodec(), Crc32cCodec())} for name in result.variables}
        result = result.assign_attrs({VARIABLE_NAMES: sorted(map(str, result.variables))})
        result.to_zarr(partial, mode="w", zarr_format=3, consolidated=False, encoding=checked, write_empty_chunks=True)
        _seal(partial)
        partial.rename(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror or error}") from None
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _seal(folder: Path) -> None:
    """Adds the checksums of its metadata to a result; its chunks have checksums of their own."""
    about = json.loads((folder / "zarr.json").read_bytes())
    about["attributes"][CHECKSUMS] = _checksums(folder)
    (folder / "zarr.json").write_text(json.dumps(about, indent=2), "utf-8")


def checksum(values: dict[str, object]) -> str:
    """Returns the SHA-256 of plain data, as JSON with sorted keys."""
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


def _checksums(folder: Path) -> dict[str, str]:
    """Returns the checksum of each `zarr.json` of a result, by its path in the folder.

    The checksums in the root are left out.
    """
    found = {}
    for file in sorted([folder / "zarr.json", *folder.glob("*/zarr.json")]):
        about = json.loads(read_file(file, MAX_ABOUT_BYTES))
        if file.parent == folder:
            about["attributes"].pop(CHECKSUMS, None)
        found[file.relative_to(folder).as_posix()] = checksum(about)
    return found


def _refuse_changed(folder: Path, saved: dict[str, str]) -> None:
    """Compares the metadata of a result with the checksums that were saved; other functions look for missing files.

    Raises:
        InputError: A file holds something else than what was saved; the message names it.
    """
    for name, checksum in _checksums(folder).items():
        if saved.get(name) != checksum:
            raise InputError(f"{folder / name}: damaged: its checksum is that of another text")


def only_files(folder: Path) -> int:
    """Returns the size of all files in a folder in bytes.

    Raises:
        InputError: One of them is a pipe or a device, whose reading would never end.
    """
    total = 0
    for inside, _, names in os.walk(folder):
        for file in (Path(inside) / name for name in names):
            if file.exists() and not file.is_file():
                raise InputError(f"{file}: a pipe or a device, not a file")
            total += file.stat().st_size if file.exists() else 0
    return total


def check_declared(path: Path, declared: int, stored: int) -> None:
    """Refuses a folder whose files unpack to far more than they hold, before they are read.

    Args:
        path: The folder.
        declared: Size of its data in memory in bytes.
        stored: Size of its files in bytes.

    Raises:
        InputError: The data would take too much memory.
    """
    if declared > max(MAX_SMALL_BYTES, MAX_EXPANSION * stored):
        raise InputError(f"{path}: declares {declared / 1e9:,.0f} GB of data and holds {stored / 1e6:,.3g} MB")


@contextlib.contextmanager
def reading_chunks(path: str | Path) -> Iterator[None]:
    """Reads chunks of zarr arrays as `reading` reads files; after an error it stops zarr, which would read on.

    Otherwise Python prints, when the process ends, a traceback for each chunk that was still being read.

    Raises:
        InputError: The file cannot be read.
    """
    from zarr.core.sync import sync

    async def stop() -> None:
        tasks = asyncio.all_tasks() - {asyncio.current_task()}
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    try:
        with reading(path):
            yield
    except InputError:
        sync(stop())
        raise


def check_codecs(path: Path) -> None:
    """Refuses a zarr array that is not encoded as mrctl writes it: a codec is code, and some unpickle what they read.

    Raises:
        InputError: It has another codec, or its metadata are damaged.
    """
    names = set[str]()
    with reading(path):
        waiting = list(json.loads(read_file(path / "zarr.json"))["codecs"])
        while waiting:
            codec = waiting.pop()
            names.add(str(codec["name"]))
            inner = codec.get("configuration", {})
            waiting += [*inner.get("codecs", ()), *inner.get("index_codecs", ())]
    if foreign := names - CODECS:
        raise InputError(f"{path}: has the codec {printable(min(foreign))}, which mrctl does not write")


def departure(result: xr.Dataset, saved: xr.Dataset) -> str:
    """Returns which variable of a saved result has other bits in a result of the same runs, and from when on; or "".

    Of several variables it is the one that departs first. Where other versions of the packages have made the saved
    result, they are named too.
    """
    found: list[tuple[float, str]] = []
    for name, old in saved.data_vars.items():
        new = result.get(name)
        if new is None or new.dims != old.dims or new.shape != old.shape:
            found.append((-np.inf, str(name)))
            continue
        off = np.asarray(_bits(new) != _bits(old))
        if off.any():
            axes = tuple(axis for axis, dim in enumerate(old.dims) if dim != "time")
            timed = "time" in old.dims
            found.append((float(saved["time"].values[off.any(axes).argmax()]) if timed else np.inf, str(name)))
    if not found:
        return ""
    time, name = min(found)
    return f"{name}{f' from t = {time:g} s on' if np.isfinite(time) else ''}{_other_versions(saved)}"


def _bits(values: xr.DataArray) -> NDArray:
    """Returns the bits of numbers as whole numbers; texts as they are."""
    plain = values.values
    if plain.dtype.kind not in "fiub":
        return plain.astype(object)
    return np.frombuffer(plain.tobytes(), f"u{plain.itemsize}").reshape(plain.shape)


def _other_versions(saved: xr.Dataset) -> str:
    """Says which packages had other versions when a result was saved, in parentheses, or nothing."""
    now, then = versions(), json.loads(saved.attrs.get("versions", "{}"))
    others = [f"{name} {old}, not {now.get(name)}" for name, old in then.items() if now.get(name) != old]
    return f" (saved with {'; '.join(others)})" if others else ""


def open_result(path: str | Path) -> xr.Dataset:
    """Opens a saved result, whichever version of mrctl wrote it: a result names its variables, with their units.

    A function that needs a variable or a field of a scenario that the result lacks raises an `InputError`, which names
    the version that wrote it.

    Raises:
        InputError: There is no result at this path, or a file of it is damaged or missing.
    """
    import zarr

    if not (Path(path) / "zarr.json").is_file():
        raise InputError(f"{path}: not a saved result, nor a sweep's store: no zarr.json")
    stored = only_files(Path(path))
    arrays: dict[Path, zarr.Array] = {}
    folders = sorted(file.parent for file in Path(path).glob("*/zarr.json"))
    for folder in folders:
        check_codecs(folder)
    with contextlib.suppress(InputError), reading_chunks(path):  # all at once is faster; what is damaged is named below
        found = zarr.open_group(path, mode="r", zarr_format=3, use_consolidated=False).arrays()
        arrays = {Path(path) / name: array for name, array in found}
    for folder in folders:
        if folder not in arrays:
            with reading(folder):
                arrays[folder] = zarr.open_array(folder, mode="r", zarr_format=3)
    check_declared(Path(path), sum(array.nbytes for array in arrays.values()), stored)
    with reading(f"{path}: not a saved result"):
        result = xr.open_zarr(path, chunks=None, consolidated=False, zarr_format=3)
        if CHECKSUMS in result.attrs:
            _refuse_changed(Path(path), dict(result.attrs.pop(CHECKSUMS)))
    if gone := set(result.attrs.get(VARIABLE_NAMES, ())) - set(result.variables):
        raise InputError(f"{Path(path) / min(gone)}: missing")
    for folder, array in arrays.items():
        whole = {VARIABLE_NAMES, ALL_CHUNKS_BEFORE_0_10_2} & set(result.attrs)
        keys = map(array.metadata.encode_chunk_key, np.ndindex(array.cdata_shape) if whole else ())
        if lost := sum(not (folder / key).is_file() for key in keys):
            raise InputError(f"{folder}: {lost} chunks are missing")
    for name in result.variables:
        with reading_chunks(f"{path}/{name}"):
            result.variables[name].load()  # alone, without its coordinates
    for name in (VARIABLE_NAMES, ALL_CHUNKS_BEFORE_0_10_2):
        result.attrs.pop(name, None)
    if missing := NEEDED_ATTRIBUTES - set(result.attrs):
        raise InputError(f"{path}: not a saved result: no {min(missing)}")
    return result
