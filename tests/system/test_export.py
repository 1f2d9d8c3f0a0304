"""Exports read back by tools that know nothing of mrctl: the result's numbers, at the result's times."""

import csv
import json
import os
import shutil
import sys
from itertools import islice
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
import xarray as xr
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

import mrctl
from mrctl import Circle, Event, InputError, Scenario, Sweep, save
from mrctl.cli import main
from mrctl.loop.runs import simulate
from mrctl.results.dataset import SIGNALS
from mrctl.results.export import UNMEASURED, export
from mrctl.sensing.tiers import Sensing
from mrctl.sweep import jobs

pytestmark = pytest.mark.xdist_group("export")  # what its tests share is made once

IDEAL, FIELD = Sensing(tier="ideal"), Sensing(tier="field", fix_lost=0.2, encoder_rate=50, encoder_latency=0.01)
SHORT = Scenario(reference=Circle(period=3, radius=0.4), laps=1, learner="none", sensing=IDEAL)
FAILS = SHORT.model_copy(update={"seed": 1, "events": (Event(time=1.0, push=(1e12, 0.0, 1e15)),)})
ROS = get_typestore(Stores.ROS2_HUMBLE)


@pytest.fixture(scope="module")
def result():
    return simulate([SHORT, FAILS.replace(name="pushed, hard")])


@pytest.fixture(scope="module")
def path(result, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("result") / "result.zarr"
    save(result, path)
    return path


@pytest.fixture(scope="module")
def alone(result, tmp_path_factory) -> Path:
    """The first run, as a result of one scenario, which has no dimension for runs."""
    path = tmp_path_factory.mktemp("alone") / "alone.zarr"
    save(result.isel(run=0), path)
    return path


def messages(file: Path):
    """Topic to type, times in ns and messages, decoded by the definitions of ROS and not by those in the file."""
    found = {}
    with AnyReader([file]) as reader:
        for connection, time, raw in reader.messages():
            times, decoded = found.setdefault(connection.topic, (connection.msgtype, [], []))[1:]
            times.append(time)
            decoded.append(ROS.deserialize_cdr(raw, connection.msgtype))
    return found


def stamps(some):
    return [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for m in some]


def twist(message):
    return message.twist if hasattr(message.twist, "linear") else message.twist.twist


def heading(pose):
    return 2 * np.arctan2(pose.orientation.z, pose.orientation.w)


KINDS = {
    "/odom": "nav_msgs/msg/Odometry", "/reference": "nav_msgs/msg/Odometry", "/estimate": "nav_msgs/msg/Odometry",
    "/cmd_vel": "geometry_msgs/msg/TwistStamped", "/fix": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "/joint_states": "sensor_msgs/msg/JointState", "/encoders": "sensor_msgs/msg/JointState",
    "/imu": "sensor_msgs/msg/Imu",
}  # fmt: skip


def test_mcap(result, path, tmp_path):
    """Odometry, twists, joints and ideal sensors: values to the bit, stamps to the nanosecond."""
    out = tmp_path / "run.mcap"
    assert export(mrctl.open(path), "mcap", out, 0) == 1
    found = messages(out)
    assert {topic: kind for topic, (kind, _, _) in found.items()} == KINDS
    run = result.isel(run=0)
    for _, times, some in found.values():
        assert times == stamps(some) == [10_000_000 * k for k in range(300)]

    def same(topic, read, name):
        assert np.array_equal([read(m) for m in found[topic][2]], run[name].values), (topic, name)

    for topic, after in (("/odom", ""), ("/reference", "_ref"), ("/estimate", "_measured")):
        same(topic, lambda m: m.pose.pose.position.x, "x" + after)
        same(topic, lambda m: m.pose.pose.position.y, "y" + after)
        turned = [heading(m.pose.pose) for m in found[topic][2]]
        apart = np.angle(np.exp(1j * (np.array(turned) - run["theta" + after].values)))
        np.testing.assert_allclose(apart, 0, atol=1e-12)
    for topic, after in (("/odom", ""), ("/reference", "_ref"), ("/estimate", "_measured"), ("/cmd_vel", "_command")):
        same(topic, lambda m: twist(m).linear.x, "v" + after)
        same(topic, lambda m: twist(m).angular.z, "omega" + after)
    same("/odom", lambda m: m.twist.twist.linear.y, "v_lateral")
    for k, side in enumerate(("left", "right")):
        same("/joint_states", lambda m, k=k: m.velocity[k], f"wheel_rate_{side}")
        same("/encoders", lambda m, k=k: m.position[k], f"encoder_{side}")
    same("/joint_states", lambda m: m.position[2], "steering_angle")
    same("/imu", lambda m: m.angular_velocity.z, "omega")
    same("/fix", lambda m: m.pose.pose.position.x, "x")
    assert found["/odom"][2][0].header.frame_id == "odom" and found["/odom"][2][0].child_frame_id == "base_link"
    assert found["/joint_states"][2][0].name == ["wheel_left", "wheel_right", "steering"]
    assert found["/encoders"][2][0].name == ["wheel_left", "wheel_right"]


def test_sensors(tmp_path):
    """Cheap sensors: each sample once, logged when it arrived and stamped when it was taken, with its noise."""
    scenario = SHORT.model_copy(update={"sensing": FIELD})
    run = simulate(scenario)
    save(run, tmp_path / "field.zarr")
    export(mrctl.open(tmp_path / "field.zarr"), "mcap", tmp_path / "field.mcap")
    found = messages(tmp_path / "field.mcap")
    assert {topic: kind for topic, (kind, _, _) in found.items()} == KINDS | {
        "/encoder_counts": "std_msgs/msg/Int64MultiArray"
    }

    _, times, fixes = found["/fix"]
    arrived = np.flatnonzero(np.isfinite(run.fix_x))
    assert times == [10_000_000 * k for k in arrived] and 15 < len(times) < 30  # of 30, a fifth is lost
    assert stamps(fixes) == [time - 50_000_000 for time in times]
    truth = run.isel(time=np.array(stamps(fixes)) // 10_000_000)  # where the robot was when the fix was taken
    for read, name, sigma in (
        (lambda m: m.pose.pose.position.x, "x", 0.02),
        (lambda m: m.pose.pose.position.y, "y", 0.02),
        (lambda m: heading(m.pose.pose), "theta", 0.01),
    ):
        off = np.array([read(m) for m in fixes]) - truth[name].values
        off = np.angle(np.exp(1j * off)) if name == "theta" else off
        assert 0.6 * sigma < off.std() < 1.4 * sigma and abs(off.mean()) < 0.8 * sigma
    covariance = fixes[0].pose.covariance.reshape(6, 6)
    np.testing.assert_allclose(covariance, np.diag([4e-4, 4e-4, 0, 0, 0, 1e-4]), rtol=1e-12)

    _, times, angles = found["/encoders"]
    assert times == [0, *(10_000_000 * k for k in range(3, 300, 2))]  # 50 Hz, and the sample is 10 ms old
    assert stamps(angles) == [10_000_000 * k for k in range(0, 300, 2)]
    _, logged, counts = found["/encoder_counts"]
    assert logged == times and all(m.data.dtype == np.int64 for m in counts)
    position = np.array([m.position for m in angles])
    np.testing.assert_allclose(position, 2 * np.pi / 2578 * np.array([m.data for m in counts]), rtol=1e-12)
    rolled = np.array([m.position[:2] for m in found["/joint_states"][2]])[np.array(stamps(angles)) // 10_000_000]
    assert np.abs((position - position[0]) - rolled).max() < 0.01  # in 10 ms they turn by 0.2 rad

    _, times, imu = found["/imu"]
    assert times == stamps(imu) == [10_000_000 * k for k in range(300)]
    assert np.array_equal([m.angular_velocity.z for m in imu], run.gyro)
    assert np.array_equal([m.linear_acceleration.x for m in imu], run.acceleration_x)
    assert np.array_equal([m.linear_acceleration.y for m in imu], run.acceleration_y)
    assert {m.linear_acceleration.z for m in imu} == {9.81} and {m.header.frame_id for m in imu} == {"imu_link"}
    one = imu[0]
    assert one.orientation_covariance[0] == -1 and one.angular_velocity_covariance[0] == UNMEASURED
    noise = run.gyro - run.omega
    assert one.angular_velocity_covariance[8] == pytest.approx(0.005**2)  # of 5e-4 rad/s/√Hz in 10 ms
    assert one.angular_velocity_covariance[8] == pytest.approx(float(noise.var()), rel=0.3)
    assert one.linear_acceleration_covariance[4] == pytest.approx(0.022**2)

    estimate = found["/estimate"][2][200]
    covariance, at = estimate.pose.covariance.reshape(6, 6), run.isel(time=200)
    assert covariance[1, 0] == covariance[0, 1] == at.covariance_xy
    assert covariance.diagonal().tolist() == [at.variance_x, at.variance_y, 0, 0, 0, at.variance_theta]
    covariance = estimate.twist.covariance.reshape(6, 6)
    assert covariance.diagonal().tolist() == [at.variance_v, 0, 0, 0, 0, at.variance_omega]
    assert (covariance > 0).sum() == 2 and at.variance_x > 0


def test_derived(result, path, tmp_path):
    """What is not recorded but follows: a wheel has rolled as far as P has come."""
    out = tmp_path / "run.mcap"
    export(mrctl.open(path), "mcap", out, 0)
    found, run = messages(out), result.isel(run=0)
    rolled = np.mean([m.position[:2] for m in found["/joint_states"][2]], axis=1) * 0.098
    np.testing.assert_allclose(rolled[-1], np.trapezoid(run.v, run.time), rtol=0.01)


def test_definitions(tmp_path):
    """The definitions in the file are those of ROS: read by them alone, the messages are the same."""
    out = tmp_path / "run.mcap"
    export(simulate(SHORT.model_copy(update={"sensing": FIELD})), "mcap", out)
    theirs, seen = messages(out), set()
    with open(out, "rb") as file:
        decoded = make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages()
        for _, channel, message, mine in islice(decoded, 300):
            other = theirs[channel.topic][2][message.sequence]
            seen.add(channel.topic)
            if channel.topic == "/imu":
                assert mine.linear_acceleration.x == other.linear_acceleration.x
            elif channel.topic in ("/joint_states", "/encoders"):
                assert list(mine.position) == list(other.position) and list(mine.velocity) == list(other.velocity)
            elif channel.topic == "/encoder_counts":
                assert list(mine.data) == list(other.data) and mine.layout.dim[0].label == "wheel"
            elif channel.topic == "/fix":
                assert list(mine.pose.covariance) == list(other.pose.covariance)
            else:
                a, b = twist(mine), twist(other)
                assert a.linear.x == b.linear.x and a.angular.z == b.angular.z
    assert seen == set(theirs)
    with AnyReader([out]) as reader:
        for connection in reader.connections:
            embedded = reader.typestore.fielddefs[connection.msgtype]
            assert embedded == ROS.fielddefs[connection.msgtype], connection.msgtype


def test_several(result, path, tmp_path):
    """All runs of a result: a name before each topic, and a run that failed ends where it failed."""
    out = tmp_path / "runs.mcap"
    assert export(mrctl.open(path), "mcap", out) == 2
    found = messages(out)
    assert {topic.split("/")[1] for topic in found} == {"run0", "run1"} and len(found) == 16
    driven = int(np.isfinite(result.x[1]).sum())
    assert len(found["/run0/odom"][1]) == 300 and len(found["/run1/odom"][1]) == driven < 110


def long(result):
    """The result as a table, a row a run and sample, without what comes after a failure."""
    frame = result[list(SIGNALS)].to_dataframe().reset_index()[["run", "label", "time", *SIGNALS]]
    return frame[np.isfinite(frame["x"])].sort_values(["run", "time"]).reset_index(drop=True)


def test_csv(result, path, tmp_path):
    """Every number in full, with its unit in the first line."""
    out = tmp_path / "runs.csv"
    export(mrctl.open(path), "csv", out)
    with open(out, newline="") as file:
        header = next(csv.reader(file))
        table = [[cell if k == 1 else float(cell) for k, cell in enumerate(row)] for row in csv.reader(file)]
    assert header[:5] == ["run", "label", "time [s]", "x [m]", "y [m]"]
    assert "power [W]" in header and "saturated" in header
    assert [name.split(" ")[0] for name in header] == list(long(result).columns)
    assert np.array_equal(np.array(table, object), long(result).to_numpy())
    assert {row[1] for row in table} == {"none", "pushed, hard"}  # the controller, where a scenario has no name
    export(mrctl.open(path), "csv", tmp_path / "one.csv", 1)
    one = pd.read_csv(tmp_path / "one.csv")
    assert not {"run", "label"} & {*one} and len(one) == (long(result)["run"] == 1).sum()


def test_parquet(result, path, tmp_path):
    """The same with units on the columns, and what was run beside them."""
    out = tmp_path / "runs.parquet"
    export(mrctl.open(path), "parquet", out)
    table = pq.read_table(out)
    pd.testing.assert_frame_equal(table.to_pandas(), long(result), check_exact=True)
    for name, (unit, meaning) in SIGNALS.items():
        assert table.schema.field(name).metadata == {b"units": unit.encode(), b"long_name": meaning.encode()}
    scenarios = json.loads(table.schema.metadata[b"scenarios"])
    assert [Scenario.from_dict(one) for one in scenarios] == [SHORT, FAILS.replace(name="pushed, hard")]


def test_npz(result, path, tmp_path):
    """Arrays a run and sample, read without pickle."""
    out = tmp_path / "runs.npz"
    export(mrctl.open(path), "npz", out)
    with np.load(out, allow_pickle=False) as arrays:
        units = json.loads(str(arrays["units"]))
        for name, (unit, _) in SIGNALS.items():
            assert np.array_equal(arrays[name], result[name].values, equal_nan=True) and units[name] == unit
        assert np.array_equal(arrays["time"], result.time) and arrays["run"].tolist() == [0, 1]
        assert arrays["failure"].tolist() == ["", "non-finite state"]


@pytest.mark.parametrize("kind", ["mcap", "csv", "parquet", "npz"])
def test_run_alone(result, path, alone, tmp_path, kind):
    """A result of one scenario gives what the run gives from a result of several."""
    out, other = tmp_path / f"alone.{kind}", tmp_path / f"first.{kind}"
    assert export(mrctl.open(alone), kind, out) == 1
    if kind == "npz":
        with np.load(out) as arrays:
            assert np.array_equal(arrays["v"], result["v"].values[:1]) and arrays["label"].tolist() == ["none"]
    else:
        export(mrctl.open(path), kind, other, 0)
        assert out.read_bytes() == other.read_bytes()


def test_run_without_its_number(result, tmp_path):
    """Its signals are its own; its scenario is not known, so that MCAP is refused, as are two runs of one number."""
    lost = result.isel(run=1, drop=True)
    export(lost, "csv", tmp_path / "lost.csv")
    export(result, "csv", tmp_path / "own.csv", 1)
    assert (tmp_path / "lost.csv").read_bytes() == (tmp_path / "own.csv").read_bytes()
    with pytest.raises(InputError, match="^run: the selection has lost the number of its run"):
        export(lost, "mcap", tmp_path / "lost.mcap")
    with pytest.raises(InputError, match=r"^run: two runs have the number 0, .*assign_coords\(run=range\(4\)\)$"):
        export(xr.concat([result, result], "run"), "csv", tmp_path / "twice.csv")


@pytest.mark.usefixtures("here")
def test_sweep(tmp_path):
    """Of a sweep with signals, the runs that are asked for; one with metrics alone says what to do."""
    sweep = {"base": SHORT.model_dump(), "runs": 3}
    for record in ("decimated", "metrics"):
        jobs.run(Sweep.from_dict(sweep | {"record": record}), tmp_path / record, workers=1)
    out = tmp_path / "sweep.parquet"
    assert export(mrctl.open(tmp_path / "decimated"), "parquet", out) == 3
    table, signals = pd.read_parquet(out), mrctl.open(tmp_path / "decimated")
    assert table["run"].value_counts().to_dict() == {0: 30, 1: 30, 2: 30}
    assert np.array_equal(table["omega"].to_numpy().reshape(3, 30), signals.omega.values)
    assert main(["export", str(tmp_path / "decimated"), "--to", "mcap", "--out", str(tmp_path / "sweep.mcap")]) == 0
    found = messages(tmp_path / "sweep.mcap")
    assert len(found) == 3 * 8 and found["/run1/imu"][1] == [100_000_000 * k for k in range(30)]
    assert np.array_equal([m.angular_velocity.z for m in found["/run2/imu"][2]], signals.gyro[2])
    with pytest.raises(InputError, match="does not hold its scenarios"):
        export(signals, "mcap", tmp_path / "none.mcap")
    with pytest.raises(InputError, match=r"^result: holds no run that drove$"):  # in no time
        export(signals.isel(time=[]), "csv", tmp_path / "none.csv")
    with pytest.raises(InputError, match=r"holds metrics only, .* STORE/runs\.parquet"):
        export(mrctl.open(tmp_path / "metrics"), "csv", tmp_path / "none.csv")


@pytest.mark.usefixtures("here")
@pytest.mark.parametrize("kind", ["mcap", "csv", "parquet", "npz"])
def test_sweep_with_impossible_draws(tmp_path, capsys, kind):
    """A run that did not drive is left out of what is written and counted, and is named; alone it says why."""
    mass = {"field": "perturbation.mass_factor", "normal": [0.5, 0.5]}
    sweep = {"base": SHORT.model_dump(), "runs": 4, "axes": [mass], "record": "decimated"}
    one, store, out = Sweep.from_dict(sweep), str(tmp_path / "store"), tmp_path / f"out.{kind}"
    assert [run for run in range(4) if one.valid(run) is None] == [1]
    jobs.run(one, store, workers=1)
    words = ["export", store, "--to", kind, "--out", str(out)]
    assert main(words) == 0
    said = capsys.readouterr()
    assert said.out == f"{out}: 3 runs\n" and said.err == "mrctl: warning: run: 1 did not drive; left out\n"
    if kind == "mcap":
        assert {topic.split("/")[1] for topic in messages(out)} == {"run0", "run2", "run3"}
    elif kind == "parquet":
        assert set(pd.read_parquet(out)["run"]) == {0, 2, 3}
    out.unlink()
    assert main([*words, "--run", "1"]) == 2
    assert "result: holds no run that drove; run 1: perturbation.mass_factor: Input" in capsys.readouterr().err
    shutil.rmtree(tmp_path / "store" / "signals.zarr" / "signals" / "c")
    with pytest.warns(UserWarning, match="missing; runs 0 to 3 are left out"):
        lost = mrctl.open(store)
    with pytest.raises(InputError, match=r"^result: holds no run$"):
        export(lost, kind, out)
    assert not out.exists()


def test_older(result, tmp_path):
    """A result of an older mrctl, which lacks what a topic needs: one line that names it; tables need nothing."""
    older = result.drop_vars("gyro").assign_attrs(versions='{"mrctl": "0.1.0"}')
    with pytest.raises(InputError, match="gyro: not a variable of this result, which mrctl 0.1.0 wrote"):
        export(older, "mcap", tmp_path / "run.mcap")
    assert export(older, "csv", tmp_path / "run.csv") == 2
    later = ["z", "roll_angle", "pitch_angle", "retunes"]
    assert export(result.isel(run=[0]).drop_vars(later), "mcap", tmp_path / "run.mcap") == 1


def test_command(path, tmp_path, capsys):
    """From the shell: what `mrctl run --out` wrote is exported; bad input is one line."""
    out = tmp_path / "out.csv"
    assert main(["export", str(path.parent), "--to", "csv", "--out", str(out), "--run", "1"]) == 0
    assert capsys.readouterr().out == f"{out}: 1 run\n"
    for words, message in (
        ((str(path), "--to", "csv", "--out", str(out)), "exists already"),
        ((str(path), "--to", "csv", "--out", str(tmp_path / "b"), "--run", "7"), "has no run 7"),
        ((str(path), "--to", "bag", "--out", str(tmp_path / "b")), "bag"),
        ((str(tmp_path / "none"), "--to", "npz", "--out", str(tmp_path / "b")), "none: no such file or folder"),
        ((str(path), "--to", "npz", "--out", str(out / "b")), "cannot be written"),
    ):
        assert main(["export", *words]) == 2
        error = capsys.readouterr().err
        assert error.count("\n") == 1 and message in error, error
    assert sorted(p.name for p in tmp_path.iterdir()) == ["out.csv"]


@pytest.mark.parametrize("kind", ["csv", "parquet", "npz", "mcap"])
def test_odd_names(result, tmp_path, kind):
    """A name that is not UTF-8 is one like others, and one that is too long gets a line that says so."""
    alone = tmp_path / os.fsdecode(b"\xff.out")
    export(result, kind, alone, run=0)
    assert alone.stat().st_size > 0
    with pytest.raises(InputError, match="too long"):
        export(result, kind, tmp_path / ("n" * 300))
    assert list(tmp_path.iterdir()) == [alone]


def test_without_library(path, tmp_path, monkeypatch):
    """Without the library for MCAP one line says which to install, and the others work."""
    monkeypatch.setitem(sys.modules, "mcap_ros2.writer", None)
    with pytest.raises(InputError, match=r"mrctl\[mcap\]"):
        export(mrctl.open(path), "mcap", tmp_path / "run.mcap")
    assert not list(tmp_path.iterdir())
