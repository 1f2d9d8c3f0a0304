"""Results for other tools: MCAP with ROS 2 messages, CSV, Parquet, NumPy.

Tables hold every signal of `results.dataset.SIGNALS`; where a run has failed, they end. With several runs there is a
column `run`, or in MCAP a name `/runK` before each topic.

| topic           | message                     | content                                                           |
| --------------- | --------------------------- | ----------------------------------------------------------------- |
| `odom`          | nav_msgs/Odometry           | true posture and twist, V, lateral velocity and θ̇ in `base_link`  |
| `reference`     | nav_msgs/Odometry           | reference posture and twist                                       |
| `cmd_vel`       | geometry_msgs/TwistStamped  | commanded twist                                                   |
| `measured`      | geometry_msgs/TwistStamped  | measured twist                                                    |
| `joint_states`  | sensor_msgs/JointState      | wheels and fork; wheel angles integrated, the fork's rate derived |
| `imu`           | sensor_msgs/Imu             | at P: heading, θ̇ as measured, accelerations derived, gravity      |

Time stamps are simulated time, from zero. Integrals and derivatives are the trapezoid rule and central differences.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import xarray as xr
from numpy.typing import NDArray
from scipy.integrate import cumulative_trapezoid

from mrctl.record import InputError
from mrctl.results.dataset import SIGNALS
from mrctl.theory.robot import GRAVITY

Format = Literal["mcap", "csv", "parquet", "npz"]
Columns = dict[str, NDArray]

# The definitions of ROS 2, without their comments.
TIME = "int32 sec\nuint32 nanosec"
HEADER = "builtin_interfaces/Time stamp\nstring frame_id"
VECTOR = "float64 x\nfloat64 y\nfloat64 z"
QUATERNION = "float64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1"
TWIST = "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular"
MESSAGES: dict[str, tuple[str, dict[str, str]]] = {
    "nav_msgs/msg/Odometry": (
        "std_msgs/Header header\nstring child_frame_id\n"
        "geometry_msgs/PoseWithCovariance pose\ngeometry_msgs/TwistWithCovariance twist",
        {
            "geometry_msgs/PoseWithCovariance": "geometry_msgs/Pose pose\nfloat64[36] covariance",
            "geometry_msgs/Pose": "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation",
            "geometry_msgs/Point": VECTOR,
            "geometry_msgs/Quaternion": QUATERNION,
            "geometry_msgs/TwistWithCovariance": "geometry_msgs/Twist twist\nfloat64[36] covariance",
            "geometry_msgs/Twist": TWIST,
            "geometry_msgs/Vector3": VECTOR,
        },
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
}


def export(result: xr.Dataset, to: Format, out: str | Path, run: int | None = None) -> int:
    """Writes a result for other tools, whole or not at all.

    Args:
        result: What `mrctl.simulate` or `mrctl.open` returned.
        to: Format of the file.
        out: The file to write.
        run: Number of the run to write; by default all runs.

    Returns:
        The number of runs that were written.

    Raises:
        InputError: There is no such format or run, the result has no signals, the file exists or cannot be written, or
            the library for the format is missing.
    """
    if to not in get_args(Format):
        raise InputError(f"to: {to!r} is not {', '.join(get_args(Format))}")
    out = Path(out)
    if not {"x", "time"} <= set(result.variables):
        raise InputError("result: holds metrics only; mrctl run STORE --run K --out DIR makes the signals of one run")
    whole = result if "run" in result.dims else result.expand_dims("run")
    if run is not None:
        if run not in whole["run"]:
            raise InputError(f"run: the result has no run {run}")
        whole = whole.sel(run=[run])
    if out.exists():
        raise InputError(f"{out}: exists already, nothing was overwritten")
    writers: dict[Format, Callable[[xr.Dataset, Path], None]] = {
        "mcap": _mcap, "csv": _csv, "parquet": _parquet, "npz": _npz,
    }  # fmt: skip
    partial = out.with_name(out.name + ".partial")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        writers[to](whole, partial)
        partial.rename(out)
    except OSError as error:
        raise InputError(f"{out}: cannot be written: {error.strerror or error}") from None
    finally:
        with contextlib.suppress(OSError):
            partial.unlink()
    return whole.sizes["run"]


def _runs(whole: xr.Dataset) -> Iterator[tuple[int, Columns]]:
    """Number and signals of each run, with their times, until it ended; one run is in memory at a time."""
    for k, number in enumerate(whole["run"].values):
        one = whole.isel(run=k).load()
        drove = np.isfinite(one["x"].values)
        yield int(number), {name: one[name].values[drove] for name in ("time", *SIGNALS) if name in one}


def _unit(name: str) -> str:
    return "s" if name == "time" else SIGNALS[name][0]


def _table(whole: xr.Dataset) -> Iterator[pa.Table]:
    """A table for each run, with units and meanings in its fields' metadata, scenarios and versions in its schema's."""
    numbered = whole.sizes["run"] > 1
    about = {name: str(value) for name, value in whole.attrs.items()}
    for number, columns in _runs(whole):
        fields = [pa.field("run", pa.int64(), metadata={"units": "1"})] if numbered else []
        arrays: list[Any] = [np.full(len(columns["time"]), number)] if numbered else []
        for name, values in columns.items():
            meaning = "time" if name == "time" else SIGNALS[name][1]
            fields.append(pa.field(name, pa.float64(), metadata={"units": _unit(name), "long_name": meaning}))
            arrays.append(values)
        yield pa.table(arrays, schema=pa.schema(fields, metadata=about))


def _parquet(whole: xr.Dataset, path: Path) -> None:
    writer = None
    for table in _table(whole):
        writer = writer or pq.ParquetWriter(path, table.schema)
        writer.write_table(table)
    if writer:
        writer.close()


def _csv(whole: xr.Dataset, path: Path) -> None:
    """Writes names and units in the first line, as `v [m/s]`, and numbers in full precision."""
    for k, table in enumerate(_table(whole)):
        names = {field.name: f"{field.name} [{field.metadata[b'units'].decode()}]" for field in table.schema}
        names = {name: name if text.endswith("[1]") else text for name, text in names.items()}
        table.to_pandas().rename(columns=names).to_csv(path, index=False, header=k == 0, mode="a" if k else "w")


def _npz(whole: xr.Dataset, path: Path) -> None:
    """Writes `time` (T,), `run` (R,) and each signal (R, T), NaN after a failure; units and scenarios are JSON."""
    whole = whole.load()
    names = [name for name in SIGNALS if name in whole]
    arrays: Columns = {name: whole[name].transpose("run", "time").values for name in names}
    arrays |= {"time": whole["time"].values, "run": whole["run"].values}
    arrays |= {name: np.array([str(text) for text in np.atleast_1d(whole[name])]) for name in ("label", "failure")}
    arrays["units"] = np.array(json.dumps({name: _unit(name) for name in ("time", *names)}))
    arrays |= {name: np.array(str(value)) for name, value in whole.attrs.items()}
    with open(path, "wb") as file:
        np.savez_compressed(file, **arrays)  # type: ignore[arg-type]


def _definition(name: str) -> str:
    """The definition of a message followed by those of its parts, as MCAP requires."""
    own, parts = MESSAGES[name]
    parts = parts | {"std_msgs/Header": HEADER, "builtin_interfaces/Time": TIME}
    return own + "".join(f"\n{'=' * 80}\nMSG: {part}\n{text}" for part, text in parts.items())


def _mcap(whole: xr.Dataset, path: Path) -> None:
    try:
        from mcap_ros2.writer import Writer
    except ImportError:
        raise InputError("to: mcap needs a library, pip install 'mrctl[mcap]'") from None
    several = whole.sizes["run"] > 1
    with open(path, "wb") as file, Writer(file) as writer:
        writer.add_metadata("mrctl", {name: str(value) for name, value in whole.attrs.items()})
        schemas = {name: writer.register_msgdef(name, _definition(name)) for name in MESSAGES}
        for number, columns in _runs(whole):
            before = f"/run{number}/" if several else "/"
            for k, (nanoseconds, messages) in enumerate(_messages(columns)):
                for topic, (name, message) in messages.items():
                    writer.write_message(before + topic, schemas[name], message, nanoseconds, nanoseconds, k)


def _messages(columns: Columns) -> Iterator[tuple[int, dict[str, tuple[str, dict[str, Any]]]]]:
    """The time of each sample in ns, and its messages by topic."""
    if not (size := len(columns["time"])):
        return
    t = columns["time"]
    rate = (lambda y: np.gradient(y, t)) if size > 1 else np.zeros_like
    turned = {side: cumulative_trapezoid(columns[f"wheel_rate_{side}"], t, initial=0) for side in ("left", "right")}
    c = {name: values.tolist() for name, values in columns.items()}
    c |= {f"turned_{side}": values.tolist() for side, values in turned.items()}
    c["fork_rate"] = rate(columns["steering_angle"]).tolist()
    v, lateral, omega = columns["v"], columns["v_lateral"], columns["omega"]
    c["ahead"], c["aside"] = (rate(v) - omega * lateral).tolist(), (rate(lateral) + omega * v).tolist()
    still = [0.0] * size
    joints = ["wheel_left", "wheel_right", "steering"]

    for k, now in enumerate(c["time"]):
        nanoseconds = round(now * 1e9)
        stamp = {"sec": nanoseconds // 10**9, "nanosec": nanoseconds % 10**9}
        body, odom = ({"stamp": stamp, "frame_id": frame} for frame in ("base_link", "odom"))

        def twist(v: str, omega: str, lateral: list[float] = still, k: int = k) -> dict[str, Any]:
            return {"linear": _xyz(c[v][k], lateral[k]), "angular": _xyz(z=c[omega][k])}

        def odometry(after: str, lateral: list[float] = still, k: int = k, header: Any = odom) -> dict[str, Any]:  # noqa: ANN401
            position = _xyz(c["x" + after][k], c["y" + after][k])
            pose = {"position": position, "orientation": _heading(c["theta" + after][k])}
            moves = {"twist": twist("v" + after, "omega" + after, lateral), "covariance": [0.0] * 36}
            posture = {"pose": pose, "covariance": [0.0] * 36}
            return {"header": header, "child_frame_id": "base_link", "pose": posture, "twist": moves}

        yield (
            nanoseconds,
            {
                "odom": ("nav_msgs/msg/Odometry", odometry("", c["v_lateral"])),
                "reference": ("nav_msgs/msg/Odometry", odometry("_ref")),
                "cmd_vel": (
                    "geometry_msgs/msg/TwistStamped",
                    {"header": body, "twist": twist("v_command", "omega_command")},
                ),
                "measured": (
                    "geometry_msgs/msg/TwistStamped",
                    {"header": body, "twist": twist("v_measured", "omega_measured")},
                ),
                "joint_states": (
                    "sensor_msgs/msg/JointState",
                    {
                        "header": body,
                        "name": joints,
                        "position": [c["turned_left"][k], c["turned_right"][k], c["steering_angle"][k]],
                        "velocity": [c["wheel_rate_left"][k], c["wheel_rate_right"][k], c["fork_rate"][k]],
                        "effort": [],
                    },
                ),
                "imu": (
                    "sensor_msgs/msg/Imu",
                    {
                        "header": body,
                        "orientation": _heading(c["theta"][k]),
                        "orientation_covariance": [0.0] * 9,
                        "angular_velocity": _xyz(z=c["omega_measured"][k]),
                        "angular_velocity_covariance": [0.0] * 9,
                        "linear_acceleration": _xyz(c["ahead"][k], c["aside"][k], GRAVITY),
                        "linear_acceleration_covariance": [0.0] * 9,
                    },
                ),
            },
        )


def _xyz(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> dict[str, float]:
    return {"x": x, "y": y, "z": z}


def _heading(theta: float) -> dict[str, float]:
    """A rotation about z as a quaternion."""
    return {"x": 0.0, "y": 0.0, "z": float(np.sin(theta / 2)), "w": float(np.cos(theta / 2))}
