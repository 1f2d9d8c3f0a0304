"""Each sensor shows what its data sheet would: counts, densities, rates, ages; and what MuJoCo's own sensors show."""

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mrctl import Circle, Perturbation, Scenario, simulate
from mrctl.physics import mjcf
from mrctl.physics.files import models_folder
from mrctl.physics.plant import PLANT, BatchPlant, PhysicsPlant
from mrctl.sensing.sensors import MAX_OUTLIER, SAMPLE, Sensors
from mrctl.sensing.slip import SLIP_FILTER, slip_ratio
from mrctl.sensing.tiers import Sensing
from mrctl.theory.robot import CAR, RobotFile

PERIOD = 0.01
NOISY = {"gyro_noise": 1e-3, "gyro_walk": 1e-3, "gyro_bias": 0.01, "accelerometer_noise": 1e-3,
         "accelerometer_walk": 1e-3, "accelerometer_bias": 0.1, "encoder_counts": 1000, "fix_position_noise": 0.01,
         "fix_heading_noise": 0.02, "fix_lost": 0.2, "fix_outliers": 0.1}  # fmt: skip
STREAMS = [name for name in SAMPLE.names or () if name not in ("grip", "doubt", "twist", "command")]


def ideal(**values):
    """Returns exact sensors but for these values."""
    return Sensing(tier="ideal", **values)


def plants(size=1):
    """Returns robots that rest at the origin, on level ground."""
    plant = np.zeros(size, PLANT)
    plant["gravity"] = 0, 0, -9.81
    return plant


def stream(sensing, ticks, seeds=(0,), plant=None, first=0):
    """Returns the samples of some ticks, `(ticks, B)`, of robots with the same or with their own sensing."""
    seeds = list(seeds)
    sensors = Sensors(sensing if isinstance(sensing, list) else [sensing] * len(seeds), seeds, PERIOD)
    return samples(sensors, ticks, plants(len(seeds)) if plant is None else plant, first)


def samples(sensors, ticks, plant, first=0):
    found = np.zeros((ticks, len(plant)), SAMPLE)
    for k in range(ticks):
        plant["wheel_angles"] += 0.002, 0.003
        sensors.measure(first + k, plant)
        found[k] = sensors.ring[(first + k) % len(sensors.ring)]
    return found


# -- encoders ----------------------------------------------------------------------------------------------------------


@given(
    st.lists(st.floats(-1e3, 1e3), min_size=2, max_size=12), st.integers(1, 10**6), st.integers(0, 2**32 - 1),
    st.sampled_from([0, 50, 25]),
)  # fmt: skip
def test_encoder_counts(angles, counts, seed, rate):
    """An encoder is never more than a count off, whatever its phase; its rate is the difference of two samples.

    The rate of the first sample is that of a wheel that has been rolling, to a count.
    """
    sensors = Sensors([ideal(encoder_counts=counts, encoder_rate=rate)], [seed], PERIOD)
    plant, count, every = plants(), 2 * np.pi / counts, round(100 / rate) if rate else 1
    before = None
    for tick, angle in enumerate(angles):
        plant["wheel_angles"] = angle, -angle
        plant["reading"]["wheel_rates"] = 7.0, 8.0
        sensors.measure(tick, plant)
        now = sensors.ring[tick % len(sensors.ring), 0].copy()
        assert now["encoder_new"] == (tick % every == 0)
        if now["encoder_new"]:
            assert (np.abs(now["encoder"] - [angle, -angle]) <= count + 1e-9).all()
            whole = now["encoder"] / count
            np.testing.assert_allclose(whole, np.round(whole), atol=1e-6)
            step = count / (every * PERIOD)
            if before is None:
                expected = np.round(now["rate"] / step) * step
                assert (np.abs(expected - (7.0, 8.0)) <= step * (1 + 1e-6) + 1e-6).all()
            else:
                expected = (now["encoder"] - before["encoder"]) / (every * PERIOD)
        assert before is None or now["encoder_new"] or (now["encoder"] == before["encoder"]).all()
        np.testing.assert_allclose(now["rate"], expected, rtol=1e-12, atol=1e-9)
        before = now


def test_encoder_error_does_not_grow():
    """The angle that the rates add up to stays within a count after thousands of ticks: the error is no random walk."""
    counts, ticks = 200, 3000
    sensors, plant = Sensors([ideal(encoder_counts=counts)], [3], PERIOD), plants()
    angle = np.cumsum(0.03 + 0.02 * np.sin(np.arange(ticks) / 50))
    total, worst, first = 0.0, 0.0, None
    for tick in range(ticks):
        plant["wheel_angles"] = angle[tick]
        sensors.measure(tick, plant)
        now = sensors.ring[tick % len(sensors.ring), 0]
        first = now["encoder"][0] if first is None else first
        total += now["rate"][0] * PERIOD if tick else 0.0
        worst = max(worst, abs(first + total - angle[tick]))
    assert 0.3 < worst / (2 * np.pi / counts) < 1 + 1e-9


def test_phases():
    """The phases of the encoders differ from wheel to wheel and from seed to seed, evenly from 0 to 1."""
    phases = Sensors([ideal(encoder_counts=100)] * 500, list(range(500)), PERIOD).sensors["phase"]
    assert phases.min() >= 0 and phases.max() < 1
    np.testing.assert_allclose(
        np.quantile(phases, [0.1, 0.5, 0.9], axis=0), [[0.1] * 2, [0.5] * 2, [0.9] * 2], atol=0.06
    )
    assert abs(np.corrcoef(phases.T)[0, 1]) < 0.15


# -- gyro and accelerometer --------------------------------------------------------------------------------------------


def allan(samples, period, lengths):
    """Returns the overlapping Allan deviation at averaging times of some samples, over robots together, `(n, B)`."""
    angle = np.vstack([np.zeros(samples.shape[1]), np.cumsum(samples, 0)]) * period
    second = [angle[2 * m :] - 2 * angle[m:-m] + angle[: -2 * m] for m in lengths]
    return np.array([np.sqrt((d**2).mean() / 2) / (m * period) for d, m in zip(second, lengths, strict=True)])


def test_allan_deviation():
    """The Allan deviation is N/√τ at short and K√(τ/3) at long averaging times, with slopes −½ and +½."""
    density, walk, ticks, size = 1e-3, 3e-3, 50_000, 48  # the two are equal at √3 N/K = 0.6 s
    noises = {f"{name}_{kind}": value for name in ("gyro", "accelerometer")
              for kind, value in (("noise", density), ("walk", walk))}  # fmt: skip
    rates = [ideal(**noises, gyro_rate=rate, accelerometer_rate=rate) for rate in (0, 50)]
    sensors = Sensors([one for one in rates for _ in range(size)], [*range(size)] * 2, PERIOD)
    plant, found = plants(2 * size), {"gyro": [], "acceleration": []}
    for tick in range(ticks):
        sensors.measure(tick, plant)
        for name, log in found.items():
            log.append(sensors.ring[tick % len(sensors.ring)][name].copy())
    for log in found.values():
        values = np.array(log).reshape(ticks, 2 * size, -1)
        for every, rows in ((1, values[:, :size]), (2, values[::2, size:])):
            rows, period = rows.reshape(len(rows), -1), every * PERIOD
            for lengths, expected, slope in (
                (np.array([1, 2, 3]), lambda tau: density / np.sqrt(tau), -0.5),
                (np.array([6, 12, 20, 30]) * round(1 / period), lambda tau: walk * np.sqrt(tau / 3), 0.5),
            ):
                tau, deviation = lengths * period, allan(rows, period, lengths)
                np.testing.assert_allclose(deviation, expected(tau), rtol=0.1)
                assert np.polyfit(np.log(tau), np.log(deviation), 1)[0] == pytest.approx(slope, rel=0.1)


def test_bias():
    """The biases at the start have the deviation of the data sheet, and are added to the truth."""
    plant = plants(2000)
    plant["reading"]["twist"][:, 1], plant["specific_force"] = 0.4, (1.0, -2.0)
    first = stream(ideal(gyro_bias=0.03, accelerometer_bias=0.2), 1, range(2000), plant)[0]
    assert first["gyro"].std() == pytest.approx(0.03, rel=0.06)
    assert first["gyro"].mean() == pytest.approx(0.4, abs=0.003)
    np.testing.assert_allclose(first["acceleration"].std(0), 0.2, rtol=0.06)
    np.testing.assert_allclose(first["acceleration"].mean(0), [1, -2], atol=0.02)


@pytest.mark.parametrize("heading", [0.0, 0.7, np.pi / 2])
def test_gravity(heading):
    """On a slope of 10° that climbs along the world's x, a resting accelerometer feels g sin 10° towards the summit."""
    model, robot = mjcf.build()
    slope = np.radians(10)
    for plant in (PhysicsPlant([model], robot, 5), BatchPlant([model] * 2, robot, 5)):
        for row in range(plant.size):
            plant.perturb(row, Perturbation(slope=slope), 0)
        plant.reset(np.tile([0, 0, heading], (plant.size, 1)), np.zeros((plant.size, 2)))
        sensors = Sensors([ideal()] * plant.size, range(plant.size), PERIOD)
        sensors.measure(0, plant.state)
        expected = 9.81 * np.sin(slope) * np.array([np.cos(heading), -np.sin(heading)])
        np.testing.assert_allclose(sensors.ring[0]["acceleration"], np.tile(expected, (plant.size, 1)), atol=1e-9)


def chassis_acceleration(model, data):
    """Returns the specific force at the site `imu` as MuJoCo's accelerometer computes it, `(3,)`."""
    mujoco.mj_rnePostConstraint(model, data)
    found = np.zeros(6)
    mujoco.mj_objectAcceleration(model, data, mujoco.mjtObj.mjOBJ_SITE, model.site("imu").id, found, 1)
    return found[3:]


@pytest.mark.parametrize("name", ["car", "turtlebot", "racecar"])
def test_engine(name):
    """In a driven run encoders, gyro and accelerometer show what MuJoCo's own sensors at the wheels and `imu` show."""
    chosen = CAR if name == "car" else RobotFile(path=name)
    model, robot = mjcf.build("flat", mjcf.arrangement(chosen), 0.001, chosen)
    plant, substeps = PhysicsPlant([model], robot, 10), 10
    plant.reset(np.zeros((1, 3)), np.array([[0.2, 0.3]]))
    counts, data = 2000, mujoco.MjData(model)
    sensors = Sensors([ideal(encoder_counts=counts)], [0], PERIOD)
    rng = np.random.default_rng(4)
    ours, engine = [], []
    for tick in range(150):
        if tick % 15 == 0:
            command = np.array([[*rng.uniform(0.1, 0.5, 2) * robot.supply, 0.1, 0.0]])
        data.qpos[:], data.qvel[:], data.act[:] = plant.qpos[0], plant.qvel[0], plant.act[0]
        plant.step(command)
        data.ctrl[:] = plant.ctrl[0]
        force = np.zeros(3)
        for _ in range(substeps):
            mujoco.mj_forward(model, data)
            felt = chassis_acceleration(model, data)
            if name == "car":
                np.testing.assert_allclose(felt, data.sensor("accelerometer").data, atol=1e-9)
            force += felt / substeps
            mujoco.mj_step(model, data)
        mujoco.mj_forward(model, data)
        sensors.measure(tick, plant.state)
        now = sensors.ring[tick % len(sensors.ring), 0]
        wheels = [data.joint(f"wheel_{side}").qpos[0] for side in ("left", "right")]
        spin = np.zeros(6)
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_SITE, model.site("imu").id, spin, 1)
        if name == "car":
            assert wheels == [data.sensor(f"encoder_{side}").data[0] for side in ("left", "right")]
            assert spin[2] == pytest.approx(data.sensor("gyro").data[2], abs=1e-12)
        assert (np.abs(now["encoder"] - wheels) <= 2 * np.pi / counts).all()
        assert now["gyro"] == pytest.approx(spin[2], abs=1e-9)
        ours.append(now["acceleration"].copy())
        engine.append(force[:2])
    ours, engine = np.array(ours), np.array(engine)
    for k in range(2):
        assert np.sqrt(np.mean((ours - engine)[:, k] ** 2)) < 0.01 * np.sqrt(np.mean(engine[:, k] ** 2))


@pytest.mark.parametrize("name", ["car", "turtlebot", "racecar"])
def test_models(name):
    """Every robot's file has encoders, gyro and accelerometer, at the place that `Plant.imu` names."""
    model = mujoco.MjModel.from_xml_path(str(models_folder() / f"{name}.xml"))
    chosen = CAR if name == "car" else RobotFile(path=name)
    world, robot = mjcf.build("flat", mjcf.arrangement(chosen), 0.002, chosen)
    plant = PhysicsPlant([world], robot, 5)
    assert plant.imu[0] > 0 and np.array_equal(plant.imu, model.site("imu").pos)  # P is the origin of all three files
    data = mujoco.MjData(model)
    data.qpos[7:], data.qvel[3:6] = np.arange(1, model.nq - 6), (0, 0, 0.7)
    mujoco.mj_forward(model, data)
    assert data.sensor("gyro").data[2] == pytest.approx(0.7)
    for side, motor in zip(("left", "right"), range(2), strict=True):
        driven = model.joint(model.actuator_trnid[motor, 0])
        assert side in driven.name and data.sensor(f"encoder_{side}").data[0] == data.qpos[driven.qposadr[0]]
    mujoco.mj_resetData(model, data)
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.sensor("accelerometer").data, 0, atol=1e-9)  # these files have no floor: free fall


# -- fixes -------------------------------------------------------------------------------------------------------------


def test_fixes():
    """The errors of fixes have the deviations of the data sheet, and the stated shares are lost and wrong."""
    plant = plants(50)
    plant["reading"]["pose"] = 1.0, -2.0, 0.5
    sensing = ideal(fix_position_noise=0.01, fix_heading_noise=0.02, fix_lost=0.3, fix_outliers=0.2)
    found = stream(sensing, 2000, range(50), plant)
    assert found["fix_taken"].all()
    assert found["fix_arrives"].mean() == pytest.approx(0.7, abs=0.01)
    error = found["fix"] - (1.0, -2.0, 0.5)
    wrong = (np.abs(error[..., :2]) > 0.06).any(-1)
    assert wrong.mean() == pytest.approx(0.2, abs=0.01)  # of which hardly one in 250 is smaller than six deviations
    np.testing.assert_allclose(error[~wrong].std(0), [0.01, 0.01, 0.02], rtol=0.02)
    np.testing.assert_allclose(error[~wrong].mean(0), 0, atol=3e-4)
    assert np.abs(np.corrcoef(error[~wrong].T) - np.eye(3)).max() < 0.02
    outliers = error[wrong][:, :2]
    assert np.abs(outliers).max() < MAX_OUTLIER + 0.05
    np.testing.assert_allclose(outliers.std(0), MAX_OUTLIER / np.sqrt(3), rtol=0.03)
    assert error[wrong][:, 2].std() == pytest.approx(0.02, rel=0.03)
    lost = ~found["fix_arrives"]
    assert abs(np.corrcoef(lost.ravel(), wrong.ravel())[0, 1]) < 0.02


# -- rates, latencies, seeds -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("sensing", "periods"),
    [
        ({"estimator": "odometry"}, 0),
        ({"estimator": "odometry", "encoder_rate": 10}, 9),  # a mean over 10 periods, held for 9: 4.5 + 4.5
        ({"estimator": "odometry", "encoder_rate": 10, "encoder_counts": 0}, 5),
        ({"estimator": "odometry", "gyro_rate": 5}, 10),
        ({"estimator": "ekf", "encoder_rate": 10}, 0),
        ({"estimator": "ekf", "encoder_rate": 10, "accelerometer_rate": 20}, 2),
        ({"estimator": "truth", "encoder_rate": 10}, 0),
    ],
)
def test_age_of_slow_samples(sensing, periods):
    """How many control periods of 10 ms the samples are old on average, to the next whole one."""
    one = Sensing(tier="lab", **sensing)
    assert one.hold(one.source, 0.01) == periods
    assert one.loop_delay(0.01) == one.periods("delay", 0.01) + one.latency(one.source, 0.01) + periods


def test_rates_and_latencies():
    """Every sensor has its own rate and latency: a slow run shows the signals of a quick one, later and held."""
    base = Scenario(reference=Circle(period=4, radius=0.6), laps=1, learner="none", seed=2)
    own = {"encoder": (50, 0.03), "gyro": (25, 0.01), "accelerometer": (20, 0.02), "fix": (10, 0.05)}
    values = {f"{name}_rate": rate for name, (rate, _) in own.items()}
    values |= {f"{name}_latency": latency for name, (_, latency) in own.items()}
    quick = simulate(base.model_copy(update={"sensing": ideal()}))
    slow = simulate(base.model_copy(update={"sensing": ideal(**values)}))
    signals = {
        "encoder": ("encoder_left", "encoder_right"), "gyro": ("gyro",), "fix": ("fix_x", "fix_y", "fix_theta"),
        "accelerometer": ("acceleration_x", "acceleration_y"),
    }  # fmt: skip
    ticks = np.arange(quick.sizes["time"])
    assert np.array_equal(quick.v, slow.v)
    for name, (rate, latency) in own.items():
        every, late = round(100 / rate), round(latency / PERIOD)
        taken = np.maximum(ticks - late, 0) // every * every
        for signal in signals[name]:
            expected = quick[signal].values[taken]
            if name == "fix":
                expected = np.where(
                    (ticks >= late) & ((ticks - late) % every == 0), quick[signal].values[taken], np.nan
                )
            assert np.array_equal(slow[signal].values, expected, equal_nan=True), signal
    for signal, true in (("gyro", "omega"), ("fix_x", "x"), ("fix_y", "y"), ("fix_theta", "theta")):
        assert np.array_equal(quick[signal], quick[true])


def test_company():
    """The same seed gives the same bits, alone, and beside other robots with other sensors; another seed, others."""
    sensing = ideal(**NOISY)
    alone = stream(sensing, 600, [7])
    beside = stream([Sensing(tier="field"), sensing, sensing, ideal()], 600, [1, 7, 8, 9])
    assert alone[:, 0].tobytes() == stream(sensing, 600, [7])[:, 0].tobytes()
    for name in STREAMS:
        assert np.array_equal(beside[name][:, 1], alone[name][:, 0]), name
        if not name.endswith("_new") and name != "fix_taken":
            assert not np.array_equal(beside[name][:, 2], alone[name][:, 0]), name


@pytest.mark.parametrize("off", ["gyro", "accelerometer", "encoder", "fix", "fix_lost", "fix_outliers"])
def test_streams(off):
    """A sensor that loses its noise changes no number of the others."""
    quiet = {name: value for name, value in NOISY.items() if not name.startswith(off)}
    one, other = stream(ideal(**NOISY), 600), stream(ideal(**quiet), 600)
    changed = {name for name in STREAMS if not np.array_equal(one[name], other[name])}
    expected = {
        "gyro": {"gyro"}, "accelerometer": {"acceleration"}, "encoder": {"encoder", "rate"},
        "fix": {"fix", "fix_arrives"}, "fix_lost": {"fix_arrives"}, "fix_outliers": {"fix"},
    }[off]  # fmt: skip
    assert changed == expected
    if off == "fix_outliers":
        same = (one["fix"] == other["fix"]).all(-1)
        assert same.mean() == pytest.approx(0.9, abs=0.05)


@given(st.integers(0, 600), st.integers(0, 100))
@settings(max_examples=25)
def test_restart(tick, seed):
    """Sensors that are switched on in the middle of a run of others give the bits of a run from the beginning."""
    sensing = ideal(**NOISY, gyro_rate=50, fix_rate=20)
    fresh = stream(sensing, 300, [seed])
    sensors = Sensors([sensing, sensing], [1, 2], PERIOD)
    sensors.measure(max(tick - 1, 0) // 256 * 256, plants(2))  # draws the block in which the restart falls
    sensors.restart(1, seed, tick)
    later = samples(sensors, 300, plants(2), tick)
    for name in STREAMS:
        taken = fresh["fix_taken"][:, 0] if name == "fix" else slice(None)
        assert np.array_equal(later[name][taken, 1], fresh[name][taken, 0]), name


# -- slip --------------------------------------------------------------------------------------------------------------


def slip_of(wheels, v, omega, ticks=400):
    """Returns the slip ratio after a slip has lasted for some ticks."""
    slip = 0.0
    for _ in range(ticks):
        slip = slip_ratio(np.array(wheels, float) / 0.1, float(v), float(omega), 0.1, 0.2, PERIOD, slip)
    return slip


@given(st.floats(-5, 5), st.floats(-5, 5))
def test_rolling_is_no_slip(v, omega):
    """Wheels that turn as fast as the floor passes below them do not slip, at any twist."""
    assert slip_of([v - 0.2 * omega, v + 0.2 * omega], v, omega) == pytest.approx(0, abs=1e-12)


def test_slip_ratio():
    """The slip ratio shows driving and braking of either wheel in both directions, and hardly shows noise at rest."""
    for sign in (1, -1):
        assert slip_of([sign * 1.0, sign * 1.25], sign * 1.0, 0.0) == pytest.approx(0.2)
        assert slip_of([sign * 0.8, sign * 1.0], sign * 1.0, 0.0) == pytest.approx(0.2)
    assert slip_of([0.8, 1.2], 1.0, 0.0) == pytest.approx(0.2)  # a robot that does not turn as its wheels do
    assert slip_of([0.015, 0.0], 0.0, 0.0) == pytest.approx(0.05)


def test_slip_of_noise():
    """Noise shows as the mean of the larger |n| of both wheels: √(2/π) of one wheel or V, √2 times that, and twice."""
    own, other = 0.02 * np.random.default_rng(0).standard_normal((2, 5000)) / 0.1
    none = np.zeros_like(own)
    for wheels, v, turn, factor in (
        ((own, none), none, none, 0.8),
        ((none, none), own, none, 0.8),
        ((own, other), none, none, 1.1),
        ((none, none), own, other, 1.6),
    ):
        slip, total = 0.0, 0.0
        for left, right, ahead, around in zip(*wheels, v, turn, strict=True):
            rates = np.array([20.0 + left, 20.0 + right])
            slip = slip_ratio(rates, 2.0 + 0.1 * ahead, 0.1 * around / 0.2, 0.1, 0.2, PERIOD, slip)
            total += slip / len(own)
        assert total == pytest.approx(factor * 0.02 / 2.0, rel=0.05)


def test_slip_lasts():
    """A slip that has ended fades with the filter's time constant."""
    slip = 1.0
    for _ in range(round(SLIP_FILTER / 0.001)):
        slip = slip_ratio(np.ones(2), 1.0, 0.0, 1.0, 0.2, 0.001, slip)
    assert slip == pytest.approx(np.exp(-1), rel=0.01)
