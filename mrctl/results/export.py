"""Results for other tools: MCAP with ROS 2 messages, CSV, Parquet, NumPy.

Tables hold every signal of `results.dataset.SIGNALS` and end where a run failed. With several runs a table has the
columns `run` and `label`, its number and its name, and in MCAP the name of each topic begins with `/runK`. A run that
did not drive, such as an impossible one, is left out, and a warning names it.

README.md lists the topics of an MCAP log, and says what their times and covariances are.
"""

from __future__ import annotations

import contextlib
import json
import uuid
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import xarray as xr
from numpy.typing import NDArray
from scipy.integrate import cumulative_trapezoid

from mrctl.record import InputError, reading
from mrctl.results.dataset import ADDED_SIGNALS, FAULTS, METRICS_ONLY, SIGNALS, require, scenarios_of
from mrctl.results.metrics import as_runs
from mrctl.scenario import Scenario
from mrctl.theory.robot import GRAVITY

Format = Literal["mcap", "csv", "parquet", "npz"]
Columns = dict[str, NDArray]
Message = dict[str, Any]

READ_TOGETHER = 16  # number of runs; as many share a chunk of the signals of a sweep, which is read as a whole
UNMEASURED = 1e6  # variance of what a sensor does not measure, as in diff_drive_controller of ros2_controllers

# Message definitions of ROS 2, without their comments.
TIME = "int32 sec\nuint32 nanosec"
HEADER = "builtin_interfaces/Time stamp\nstring frame_id"
VECTOR = "float64 x\nfloat64 y\nfloat64 z"
QUATERNION = "float64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1"
TWIST = "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular"
POSTURE = {
    "geometry_msgs/PoseWithCovariance": "geometry_msgs/Pose pose\nfloat64[36] covariance",
    "geometry_msgs/Pose": "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation",
    "geometry_msgs/Point": VECTOR,
    "geometry_msgs/Quaternion": QUATERNION,
}
MESSAGES: dict[str, tuple[str, dict[str, str]]] = {
    "nav_msgs/msg/Odometry": (
        "std_msgs/Header header\nstring child_frame_id\n"
        "geometry_msgs/PoseWithCovariance pose\ngeometry_msgs/TwistWithCovariance twist",
        POSTURE
        | {
            "geometry_msgs/TwistWithCovariance": "geometry_msgs/Twist twist\nfloat64[36] covariance",
            "geometry_msgs/Twist": TWIST,
            "geometry_msgs/Vector3": VECTOR,
        },
    ),
    "geometry_msgs/msg/PoseWithCovarianceStamped": (
        "std_msgs/Header header\ngeometry_msgs/PoseWithCovariance pose",
        POSTURE,
    ),
    "geometry_msgs/msg/TwistStamped": (
        "std_msgs/Header header\ngeometry_msgs/Twist twist",
        {"geometry_msgs/Twist": TWIST, "geometry_msgs/Vector3": VECTOR},
    ),
    "sensor_msgs/msg/JointState": (
        "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort",
        {},
    ),
    "sensor_msgs/msg/Imu": (
        "std_msgs/Header header\ngeometry_msgs/Quaternion orientation\nfloat64[9] orientation_covariance\n"
        "geometry_msgs/Vector3 angular_velocity\nfloat64[9] angular_velocity_covariance\n"
        "geometry_msgs/Vector3 linear_acceleration\nfloat64[9] linear_acceleration_covariance",
        {"geometry_msgs/Quaternion": QUATERNION, "geometry_msgs/Vector3": VECTOR},
    ),
    "std_msgs/msg/Int64MultiArray": (
        "std_msgs/MultiArrayLayout layout\nint64[] data",
        {
            "std_msgs/MultiArrayLayout": "std_msgs/MultiArrayDimension[] dim\nuint32 data_offset",
            "std_msgs/MultiArrayDimension": "string label\nuint32 size\nuint32 stride",
        },
    ),
}


def export(
    result: xr.Dataset,
    to: Format,
    out: str | Path,
    run: int | None = None,
    scenario: Callable[[int], Scenario] | None = None,
) -> int:
    """Writes a result for other tools, whole or not at all.

    Args:
        result: What `mrctl.simulate` or `mrctl.open` returned.
        to: Format of the file.
        out: The file to write.
        run: Number of the run to write; by default all runs.
        scenario: Returns the scenario of a run from its number, which `mcap` needs for the sensors; by default the
            scenario in the result is used. The dataset of a sweep holds none.

    Returns:
        The number of runs that were written: those that drove.

    Raises:
        InputError: There is no such format or run, no run drove, the result has no signals or no scenarios, the file
            exists or cannot be written, or the library for the format is missing.
    """
    if to not in get_args(Format):
        raise InputError(f"to: {to!r} is not {', '.join(get_args(Format))}")
    out = Path(out)
    if not {"x", "time"} <= set(result.variables):
        raise InputError(METRICS_ONLY)
    whole = as_runs(result)
    numbers, counts = np.unique(whole["run"].values, return_counts=True)
    if (counts > 1).any():
        raise InputError(
            f"run: two runs have the number {numbers[counts > 1][0]}, as after xr.concat; number them anew, as in "
            f"result.assign_coords(run=range({counts.sum()}))"
        )
    if run is not None:
        if run not in whole["run"]:
            raise InputError(f"run: the result has no run {run}")
        whole = whole.sel(run=[run])
    writers: dict[Format, Callable[[xr.Dataset, bool, Path], None]] = {
        "mcap": partial(_mcap, scenario), "csv": _csv, "parquet": _parquet, "npz": _npz,
    }  # fmt: skip
    unfinished = out.with_name(f".{out.name}.{uuid.uuid4().hex}.partial")
    try:
        if out.exists():
            raise InputError(f"{out}: exists already, nothing was overwritten")
        several, whole = whole.sizes["run"] > 1, _that_drove(whole)
        out.parent.mkdir(parents=True, exist_ok=True)
        writers[to](whole, several, unfinished)
        unfinished.rename(out)
    except OSError as error:
        raise InputError(f"{out}: cannot be written: {error.strerror or error}") from None
    finally:
        with contextlib.suppress(OSError):
            unfinished.unlink()
    return whole.sizes["run"]


def _that_drove(whole: xr.Dataset) -> xr.Dataset:
    """Returns the runs that drove at all, with a warning that names the others.

    Raises:
        InputError: There is none.
    """
    drove = np.array([np.isfinite(columns["x"]).any() for columns in _columns(whole, ["x"])], bool)
    idle = whole["run"].values[~drove].tolist()
    if not drove.any():
        reason = str(whole["failure"].values[0]) if idle and "failure" in whole else ""
        why = f"; run {idle[0]}: {reason}" if reason else ""
        raise InputError(f"result: holds no run that drove{why}" if idle else "result: holds no run")
    if idle:
        more = f" and {len(idle) - 10} more" if len(idle) > 10 else ""
        warnings.warn(f"run: {', '.join(map(str, idle[:10]))}{more} did not drive; left out", stacklevel=3)
    return whole.isel(run=drove)


def _columns(whole: xr.Dataset, names: Sequence[str]) -> Iterator[Columns]:
    """Yields variables of each run, of which only `READ_TOGETHER` are in memory."""
    numbers = whole["run"].values
    for first in range(0, len(numbers), READ_TOGETHER):
        rows = slice(first, first + READ_TOGETHER)
        with reading(f"signals of run {int(numbers[first])} or one after it"):
            several = [whole[name].transpose("run", ...)[rows].values for name in names]
        for one in zip(*several, strict=True):
            yield dict(zip(names, one, strict=True))


def _runs(whole: xr.Dataset) -> Iterator[tuple[int, Columns]]:
    """Yields number and signals of each run, with their times, until it ended."""
    time, names = whole["time"].values, [name for name in SIGNALS if name in whole]
    for number, columns in zip(whole["run"].values, _columns(whole, names), strict=True):
        drove = np.isfinite(columns["x"])
        yield int(number), {"time": time[drove]} | {name: values[drove] for name, values in columns.items()}


def _unit(name: str) -> str:
    return "s" if name == "time" else SIGNALS[name][0]


def _table(whole: xr.Dataset, several: bool) -> Iterator[pa.Table]:
    """Yields a table for each run, with units and meanings in its fields, and scenarios and versions in its schema."""
    kinds = (("run", pa.int64()), ("label", pa.string())) if several else ()
    fields = [pa.field(name, kind, metadata={"units": "1"}) for name, kind in kinds]
    for name in ("time", *(name for name in SIGNALS if name in whole)):
        meaning = "time" if name == "time" else SIGNALS[name][1]
        fields.append(pa.field(name, pa.float64(), metadata={"units": _unit(name), "long_name": meaning}))
    # Made once, because it holds the scenarios of all runs.
    schema = pa.schema(fields, metadata={name: str(value) for name, value in whole.attrs.items()})
    for label, (number, columns) in zip(np.atleast_1d(whole["label"]), _runs(whole), strict=True):
        whose = [[value] * len(columns["time"]) for value in (number, str(label))] if several else []
        yield pa.table([*whose, *columns.values()], schema=schema)


def _parquet(whole: xr.Dataset, several: bool, path: Path) -> None:
    with contextlib.ExitStack() as opened:
        file, writer = opened.enter_context(open(path, "wb")), None  # Arrow opens no name that is not UTF-8
        for table in _table(whole, several):
            writer = writer or opened.enter_context(pq.ParquetWriter(file, table.schema))
            writer.write_table(table)


def _csv(whole: xr.Dataset, several: bool, path: Path) -> None:
    """Writes names and units in the first line, as `v [m/s]`, and numbers in full precision."""
    for k, table in enumerate(_table(whole, several)):
        names = {field.name: f"{field.name} [{field.metadata[b'units'].decode()}]" for field in table.schema}
        names = {name: name if text.endswith("[1]") else text for name, text in names.items()}
        table.to_pandas().rename(columns=names).to_csv(path, index=False, header=k == 0, mode="a" if k else "w")


def _npz(whole: xr.Dataset, _several: bool, path: Path) -> None:
    """Writes `time` (T,), `run` (R,) and each signal (R, T), NaN after a failure; units and scenarios are JSON."""
    with reading("signals"):
        whole = whole.load()
    names = [name for name in SIGNALS if name in whole]
    arrays: Columns = {name: whole[name].transpose("run", "time").values for name in names}
    arrays |= {"time": whole["time"].values, "run": whole["run"].values}
    texts = ("label", "failure", *(name for name in FAULTS if name in whole))
    arrays |= {name: np.array([str(text) for text in np.atleast_1d(whole[name])]) for name in texts}
    arrays["units"] = np.array(json.dumps({name: _unit(name) for name in ("time", *names)}))
    arrays |= {name: np.array(str(value)) for name, value in whole.attrs.items()}
    with open(path, "wb") as file:
        np.savez_compressed(file, **arrays)  # type: ignore[arg-type]


def _definition(name: str) -> str:
    """Returns the definition of a message followed by those of its parts, as MCAP requires."""
    own, parts = MESSAGES[name]
    parts = parts | {"std_msgs/Header": HEADER, "builtin_interfaces/Time": TIME}
    return own + "".join(f"\n{'=' * 80}\nMSG: {part}\n{text}" for part, text in parts.items())


def _mcap(scenario: Callable[[int], Scenario] | None, whole: xr.Dataset, several: bool, path: Path) -> None:
    try:
        from mcap_ros2.writer import Writer
    except ImportError:
        raise InputError("to: mcap needs a library, pip install 'mrctl[mcap]'") from None
    require(whole, [name for name in SIGNALS if name not in ADDED_SIGNALS])  # no message needs these
    if scenario is None and "scenarios" not in whole.attrs:
        raise InputError("result: does not hold its scenarios; mrctl export STORE --to mcap finds those of a sweep")
    held = dict(zip(whole["run"].values.tolist(), scenarios_of(whole), strict=True)) if scenario is None else {}
    with open(path, "wb") as file, Writer(file) as writer:
        writer.add_metadata("mrctl", {name: str(value) for name, value in whole.attrs.items()})
        schemas = {name: writer.register_msgdef(name, _definition(name)) for name in MESSAGES}
        for number, columns in _runs(whole):
            before, count = f"/run{number}/" if several else "/", Counter[str]()
            for nanoseconds, topic, name, message in _messages(columns, scenario(number) if scenario else held[number]):
                writer.write_message(before + topic, schemas[name], message, nanoseconds, nanoseconds, count[topic])
                count[topic] += 1


def _messages(columns: Columns, scenario: Scenario) -> Iterator[tuple[int, str, str, Message]]:
    """Yields the log time in ns, topic, type and content of each message of a run."""
    t, sensing, period = columns["time"], scenario.sensing, scenario.control_period
    turned = {side: cumulative_trapezoid(columns[f"wheel_rate_{side}"], t, initial=0) for side in ("left", "right")}
    c = {name: values.tolist() for name, values in columns.items()}
    c |= {f"turned_{side}": values.tolist() for side, values in turned.items()}
    c["fork_rate"] = np.gradient(columns["steering_angle"], t).tolist() if len(t) > 1 else [0.0] * len(t)
    wheels = ["wheel_left", "wheel_right"]
    counts = sensing["encoder_counts"]
    gyro, force = (
        sensing[f"{name}_noise"] ** 2 / (period * sensing.periods(f"{name}_rate", period))
        for name in ("gyro", "accelerometer")
    )
    position, heading = sensing["fix_position_noise"] ** 2, sensing["fix_heading_noise"] ** 2
    taken = {name: _taken(scenario, name, t) for name in ("encoder", "gyro", "fix")}
    new = {name: np.diff(times, prepend=-1) > 0 for name, times in taken.items()} | {"fix": ~np.isnan(columns["fix_x"])}

    for k, now in enumerate(c["time"]):
        logged = round(now * 1e9)
        body, odom = _header(logged, "base_link"), _header(logged, "odom")

        for topic, after in (("odom", ""), ("reference", "_ref"), ("estimate", "_measured")):
            yield logged, topic, "nav_msgs/msg/Odometry", _odometry(c, k, after, odom)
        command = {"linear": _xyz(c["v_command"][k]), "angular": _xyz(z=c["omega_command"][k])}
        yield logged, "cmd_vel", "geometry_msgs/msg/TwistStamped", {"header": body, "twist": command}
        joints = {
            "header": body,
            "name": [*wheels, "steering"],
            "position": [c["turned_left"][k], c["turned_right"][k], c["steering_angle"][k]],
            "velocity": [c["wheel_rate_left"][k], c["wheel_rate_right"][k], c["fork_rate"][k]],
            "effort": [],
        }
        yield logged, "joint_states", "sensor_msgs/msg/JointState", joints
        if new["fix"][k]:
            pose = _posture(c["fix_x"][k], c["fix_y"][k], c["fix_theta"][k], _planar(position, 0.0, position, heading))
            message = {"header": _header(taken["fix"][k], "odom"), "pose": pose}
            yield logged, "fix", "geometry_msgs/msg/PoseWithCovarianceStamped", message
        if new["gyro"][k]:
            yield logged, "imu", "sensor_msgs/msg/Imu", _imu(c, k, _header(taken["gyro"][k], "imu_link"), gyro, force)
        if new["encoder"][k]:
            angles = [c["encoder_left"][k], c["encoder_right"][k]]
            joints = {"name": wheels, "position": angles, "velocity": [], "effort": []}
            header = _header(taken["encoder"][k], "base_link")
            yield logged, "encoders", "sensor_msgs/msg/JointState", {"header": header} | joints
            if counts:
                layout = {"dim": [{"label": "wheel", "size": 2, "stride": 2}], "data_offset": 0}
                message = {"layout": layout, "data": [round(angle * counts / (2 * np.pi)) for angle in angles]}
                yield logged, "encoder_counts", "std_msgs/msg/Int64MultiArray", message


def _odometry(c: Mapping[str, list[float]], k: int, after: str, header: Message) -> Message:
    """Returns posture and twist of a sample.

    Args:
        c: The signals, by name.
        k: Index of the sample.
        after: End of the names: "" for the true motion, `_ref` for the reference, `_measured` for the estimate, which
            alone has covariances.
        header: Header of the message.
    """
    seen, lateral = after == "_measured", 0.0 if after else c["v_lateral"][k]
    names = "variance_x", "covariance_xy", "variance_y", "variance_theta", "variance_v", "variance_omega"
    x, xy, y, theta, v, omega = (c[name][k] if seen else 0.0 for name in names)
    at = c["x" + after][k], c["y" + after][k], c["theta" + after][k]
    moves = {"linear": _xyz(c["v" + after][k], lateral), "angular": _xyz(z=c["omega" + after][k])}
    return {
        "header": header,
        "child_frame_id": "base_link",
        "pose": _posture(*at, _planar(x, xy, y, theta)),
        "twist": {"twist": moves, "covariance": _planar(v, 0.0, 0.0, omega)},
    }


def _imu(c: Mapping[str, list[float]], k: int, header: Message, gyro: float, force: float) -> Message:
    """Returns the samples of gyro and accelerometer.

    Args:
        c: The signals, by name.
        k: Index of the sample.
        header: Header of the message.
        gyro: Variance of the gyro in (rad/s)².
        force: Variance of the accelerometer in (m/s²)².
    """
    return {
        "header": header,
        "orientation": _heading(0.0),
        "orientation_covariance": [-1.0] + [0.0] * 8,
        "angular_velocity": _xyz(z=c["gyro"][k]),
        "angular_velocity_covariance": _diagonal(UNMEASURED, UNMEASURED, gyro),
        "linear_acceleration": _xyz(c["acceleration_x"][k], c["acceleration_y"][k], GRAVITY),
        "linear_acceleration_covariance": _diagonal(force, force, UNMEASURED),
    }


def _taken(scenario: Scenario, sensor: str, t: NDArray) -> NDArray[np.int64]:
    """Returns when the last sample of a sensor that had arrived at each time `t` (s) was taken, in ns."""
    sensing, period = scenario.sensing, scenario.control_period
    every, latency = (sensing.periods(f"{sensor}_{name}", period) for name in ("rate", "latency"))
    ticks = np.maximum(np.rint(t / period).astype(int) - latency, 0)
    return np.rint(ticks // every * every * period * 1e9).astype(int)


def _header(nanoseconds: int, frame: str) -> Message:
    stamp = {"sec": int(nanoseconds // 10**9), "nanosec": int(nanoseconds % 10**9)}
    return {"stamp": stamp, "frame_id": frame}


def _xyz(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Message:
    return {"x": x, "y": y, "z": z}


def _heading(theta: float) -> Message:
    """Returns the quaternion of a rotation about z."""
    return {"x": 0.0, "y": 0.0, "z": float(np.sin(theta / 2)), "w": float(np.cos(theta / 2))}


def _posture(x: float, y: float, theta: float, covariance: list[float]) -> Message:
    return {"pose": {"position": _xyz(x, y), "orientation": _heading(theta)}, "covariance": covariance}


def _planar(x: float, xy: float, y: float, turn: float) -> list[float]:
    """Returns the covariance of x, y, z, roll, pitch and yaw, 6 by 6, row by row, zero but for the planar entries."""
    found = np.zeros((6, 6))
    found[0, :2], found[1, :2], found[5, 5] = (x, xy), (xy, y), turn
    return found.ravel().tolist()


def _diagonal(*variances: float) -> list[float]:
    return np.diag(variances).ravel().tolist()
