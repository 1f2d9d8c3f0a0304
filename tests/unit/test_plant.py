"""The physics boundary: readouts against the engine's own sensors, voltages on their way, pushes, failures."""

import math
import shutil

import mujoco
import numpy as np
import pytest

from mrctl import Circle, Scenario
from mrctl.loop.runs import simulate
from mrctl.physics import mjcf
from mrctl.physics.car import CarPhysics
from mrctl.physics.files import models_folder
from mrctl.physics.perturb import limit_current
from mrctl.physics.plant import BatchPlant, PhysicsPlant, build
from mrctl.physics.readout import READING, addresses, read
from mrctl.physics.stand import stand
from mrctl.theory.perturbation import Perturbation

MODEL, ROBOT = mjcf.build()
SUBSTEPS = 5


def plants(size=3, model=MODEL, robot=ROBOT):
    """Yields a plant of each kind, at rest at the origin."""
    for plant in (PhysicsPlant([model], robot, SUBSTEPS), BatchPlant([model] * size, robot, SUBSTEPS)):
        plant.reset(np.zeros((plant.size, 3)), np.zeros((plant.size, 2)))
        yield plant


def volts(plant, left, right=None, angle=0.0):
    """Returns the same command for every robot."""
    return np.tile([left, left if right is None else right, angle, 0.0], (plant.size, 1))


def test_build():
    """One robot runs on dm_control, and several on the batch engine."""
    assert isinstance(build([MODEL], ROBOT, SUBSTEPS), PhysicsPlant)
    assert isinstance(build([MODEL] * 2, ROBOT, SUBSTEPS), BatchPlant)


@pytest.mark.parametrize("world", ["flat", "slope", "rough"])
def test_readouts(world):
    """Posture, twist, wheel rates and steering are what the engine's sensors measure at P, on a wild drive."""
    physics = CarPhysics.from_world(world)
    state = stand(physics.model.ptr, np.array([0.1, 0.2, 2.5]), np.array([0.4, 0.8]))
    with physics.reset_context():
        physics.data.qpos[:], physics.data.qvel[:] = state
    rng = np.random.default_rng(0)
    for _ in range(20):
        physics.data.ctrl[:] = rng.uniform([-10, -10, -0.5, 0], [20, 20, 0.5, 0])
        physics.step(20)
        physics.forward()  # sensors are a step old
        sensor = physics.named.data.sensordata
        assert physics.pose()[:2] == pytest.approx(sensor["position"][:2], abs=1e-12)
        frame = np.zeros(9)
        mujoco.mju_quat2Mat(frame, sensor["orientation"])
        assert physics.pose()[2] == pytest.approx(math.atan2(frame[3], frame[0]), abs=1e-12)
        assert physics.upright() == pytest.approx(frame[8], abs=1e-12)
        reading, turned = physics.reading(), np.zeros(4)
        mujoco.mju_euler2Quat(turned, np.array([reading["pose"][2], reading["pitch"], reading["roll"]]), "zyx")
        assert abs(turned @ sensor["orientation"]) == pytest.approx(1, abs=1e-12)
        assert reading["z"] == pytest.approx(sensor["position"][2], abs=1e-12)
        assert physics.twist()[0] == pytest.approx(sensor["velocity"][0], abs=1e-12)
        assert physics.reading()["v_lateral"] == pytest.approx(sensor["velocity"][1], abs=1e-12)
        assert physics.twist()[1] == pytest.approx(sensor["gyro"][2], abs=1e-12)
        rates = [sensor["encoder_rate_left"].item(), sensor["encoder_rate_right"].item()]
        assert physics.wheel_rates() == pytest.approx(rates, abs=1e-12)
        assert physics.steering_angle() == pytest.approx(sensor["steering_angle"].item(), abs=1e-12)
        torque = [sensor["motor_torque_left"].item(), sensor["motor_torque_right"].item()]
        assert ROBOT.torque_constant * physics.motor_current() == pytest.approx(torque, abs=1e-9)


def test_limited_current():
    """A driver's limit bounds the current that is read, as the engine bounds the torque."""
    nominal = mjcf.load()
    model = mjcf.clone(nominal)
    limit_current(nominal, model, 2.0)
    physics = CarPhysics.from_compiled(model)
    physics.data.ctrl[:2] = 20.0, 1.0  # 8.6 A and 0.43 A at rest
    physics.step()
    physics.forward()
    sensor = physics.named.data.sensordata
    torque = [sensor["motor_torque_left"].item(), sensor["motor_torque_right"].item()]
    assert ROBOT.torque_constant * physics.motor_current() == pytest.approx(torque, abs=1e-9)
    assert physics.motor_current()[0] == pytest.approx(2.0)


def test_current_beyond_the_supply():
    """More voltage than the supply has is clipped in the current that is read, as in the engine's torque."""
    physics = CarPhysics.from_world()
    physics.set_control([40.0, -40.0, 0, 0])
    physics.step()
    physics.forward()
    sensor = physics.named.data.sensordata
    torque = [sensor["motor_torque_left"].item(), sensor["motor_torque_right"].item()]
    assert ROBOT.torque_constant * physics.motor_current() == pytest.approx(torque, abs=1e-9)


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e11])
def test_blown_up(value):
    """A value that is not finite, or huge, anywhere in the state makes the cosine of the tilt NaN."""
    physics = CarPhysics.from_world()
    address = addresses(physics.model.ptr)
    assert list(address) == [0, 0, 7, 6, 8, 7, 9, 8]
    for field in ("qpos", "qvel"):
        for i in range(getattr(physics.data, field).size):
            state = {"qpos": physics.data.qpos.copy(), "qvel": physics.data.qvel.copy()}
            reading = np.zeros(1, READING)[0]
            read(state["qpos"], state["qvel"], address, reading)
            assert reading["upright"] == 1
            state[field][i] = value
            with np.errstate(invalid="ignore"):
                read(state["qpos"], state["qvel"], address, reading)
            assert np.isnan(reading["upright"])


def test_views():
    """The arrays of both plants are views of the engine's own memory, which a step changes without copying."""
    for plant in plants():
        before = plant.qpos.copy()
        plant.step(volts(plant, 12.0))
        assert (plant.qpos[:, 0] > before[:, 0]).all() and (plant.ctrl[:, 0] == 12).all()
        assert plant.reading["pose"][:, 0] == pytest.approx(plant.qpos[:, 0])


@pytest.mark.parametrize("delay", [1, 3, 50])
def test_delay(delay):
    """Voltages and steering come exactly d periods late; before that, the back-EMF and the angle at the start."""
    for plant in plants():
        plant.perturb(plant.size - 1, Perturbation(), delay)
        plant.reset(np.zeros((plant.size, 3)), np.tile([0.5, 0.4], (plant.size, 1)))
        angle, coasting = plant.reading["steering_angle"][0], ROBOT.back_emf * plant.reading["wheel_rates"][-1]
        commands = np.random.default_rng(1).uniform(0, 12, (delay + 20, 4)) * (1, 1, 0.02, 0)
        for tick, command in enumerate(commands):
            plant.step(np.tile(command, (plant.size, 1)))
            expected = commands[tick - delay] if tick >= delay else (*coasting, angle, 0)
            if tick >= delay:
                assert np.array_equal(plant.ctrl[-1], expected)
            else:
                np.testing.assert_allclose(plant.ctrl[-1], expected, rtol=1e-12)
            assert np.array_equal(plant.applied[-1], plant.ctrl[-1, :2])
            if tick < min(delay, 3):  # 0 V would brake with more than 2 A
                assert np.abs(plant.current[-1]).max() < 0.05
            if plant.size > 1:
                assert np.array_equal(plant.ctrl[0], command)


def test_delay_changes():
    """A delay that begins in the middle of a run repeats what was commanded, and one that ends skips it."""
    for plant in plants():
        seen = []
        for tick in range(12):
            if tick in (4, 9):
                plant.perturb(0, Perturbation(), 3 if tick == 4 else 0)
            plant.step(volts(plant, float(tick)))
            seen.append(plant.applied[0, 0])
        assert seen == [0, 1, 2, 3, 1, 2, 3, 4, 5, 9, 10, 11]


def test_supply():
    """A drive on another supply applies that share of the commanded voltage, above the nominal limit too."""
    for factor in (0.8, 1.25):
        for plant in plants():
            plant.perturb(0, Perturbation(supply_factor=factor), 0)
            weak = plant.truth[0]
            assert weak.drive_gain == factor and plant.robot.drive_gain == 1
            for _ in range(300):
                plant.step(volts(plant, 24.0))
            assert plant.applied[0] == pytest.approx([24 * factor] * 2)
            load = ROBOT.resistance * ROBOT.rolling_force * ROBOT.wheel_radius / 2
            drag = (ROBOT.drive_loss / ROBOT.motor_gain) + load / ROBOT.back_emf
            assert plant.reading["twist"][0, 0] == pytest.approx(ROBOT.velocity_gain * (24 * factor - drag), rel=0.02)


def test_current():
    """(U − k_E N ω)/R_a with each robot's own winding and constant; the torque on the wheel is N k_M I."""
    for plant in plants():
        row = plant.size - 1
        plant.perturb(row, Perturbation(resistance_factor=1.5, motor_constant_factor=0.8), 0)
        for _ in range(30):
            plant.step(volts(plant, 8.0, 6.0))
        emf = 43 * 0.0234 * 0.8 * plant.reading["wheel_rates"][row]
        assert plant.current[row] == pytest.approx((np.array([8.0, 6.0]) - emf) / (2.32 * 1.5))
        if plant.size > 1:
            emf = 43 * 0.0234 * plant.reading["wheel_rates"][0]
            assert plant.current[0] == pytest.approx((np.array([8.0, 6.0]) - emf) / 2.32)


def test_push():
    """An impulse of F t on a robot that coasts: Δv = F t / M_e, and a torque turns it; afterwards nothing pushes."""
    coasting = Perturbation(drive_friction_factor=0, resistance_factor=20)  # windings nearly open: nothing brakes
    model, nominal = mjcf.build("flat", "caster")  # whose fork does not resist turning
    for plant in plants(model=model, robot=nominal):
        row = plant.size - 1
        for robot in range(plant.size):
            plant.perturb(robot, coasting, 0)
        plant.reset(np.zeros((plant.size, 3)), np.tile([0.6, 0.0], (plant.size, 1)))
        free = ROBOT.effective_mass
        plant.push(row, np.array([50.0, 0.0, 0.0]), 10)
        before = plant.reading["twist"][row, 0]
        for _ in range(10):
            assert plant.wrench[row].any()
            plant.step(volts(plant, 6.0))
        assert not plant.wrench.any()
        jump = plant.reading["twist"][row, 0] - before
        assert jump == pytest.approx((50 - ROBOT.rolling_force) * 0.1 / free, rel=0.05)
        after = plant.reading["twist"][row, 0]
        for _ in range(5):
            plant.step(volts(plant, 6.0))
        assert plant.reading["twist"][row, 0] == pytest.approx(after, abs=0.02)
        if plant.size > 1:
            assert abs(plant.reading["twist"][0, 0] - before) < 0.05
        turning = plant.reading["twist"][row, 1]
        plant.push(row, np.array([0.0, 0.0, 4.0]), 2)
        plant.step(volts(plant, 6.0))
        plant.step(volts(plant, 6.0))
        assert plant.reading["twist"][row, 1] - turning == pytest.approx(4 * 0.02 / ROBOT.effective_inertia, rel=0.15)


def test_overlapping_pushes():
    """Pushes add up while each lasts, in whatever order they end."""
    for plant in plants():
        chassis = plant.wrench[0, MODEL.body("chassis").id]
        plant.push(0, np.array([10.0, 0, 0]), 4)
        plant.step(volts(plant, 0.0))
        plant.push(0, np.array([0.0, 7.0, 1.0]), 2)
        plant.push(0, np.array([2.0, 0.0, 0.0]), 5)
        felt = []
        for _ in range(6):
            felt.append(chassis.tolist())
            plant.step(volts(plant, 0.0))
        assert felt == [[12, 7, 0, 0, 0, 1]] * 2 + [[12, 0, 0, 0, 0, 0]] + [[2, 0, 0, 0, 0, 0]] * 2 + [[0] * 6]


@pytest.mark.parametrize("command", [np.nan, np.inf, -np.inf])
def test_non_finite_command(command):
    """No command, no motion: the robot stops where it is, and others go on."""
    for plant in plants():
        commands = volts(plant, 6.0)
        commands[-1, 1] = command
        before = plant.qpos[-1].copy()
        for _ in range(3):
            plant.step(commands)
        assert plant.stopped[-1] and plant.failure[-1] == "non-finite command"
        assert np.array_equal(plant.qpos[-1], before)
        if plant.size > 1:
            assert not plant.stopped[:-1].any() and (plant.qpos[:-1, 0] > 0).all()


def test_tilt():
    """On its side is a failure; the first reason counts."""
    for plant in plants():
        plant.qpos[-1, 3:7] = math.cos(0.3), math.sin(0.3), 0, 0
        plant.qpos[-1, 2] = 0.5
        plant.step(volts(plant, 0.0))
        assert plant.failure[-1] == "tilt over 30°" and plant.stopped.sum() == 1
        plant.stop(plant.size - 1, "something else")
        assert plant.failure[-1] == "tilt over 30°"


def test_same_bits():
    """Both plants, and `mj_step` by itself, agree to the last bit on a wild drive with perturbations on the way."""
    single, batch = plants()
    data = mujoco.MjData(MODEL)
    data.qpos[:] = single.qpos[0]
    rng = np.random.default_rng(2)
    for tick in range(100):
        command = rng.uniform([-5, -5, -0.5, 0], [20, 20, 0.5, 0])
        for plant in (single, batch):
            if tick == 50:
                plant.perturb(0, Perturbation(mass_factor=1.3, payload=2, left_radius_factor=1.03), 0)
            plant.step(np.tile(command, (plant.size, 1)))
        data.ctrl[:] = command
        mujoco.mj_step(MODEL, data, SUBSTEPS)
        assert np.array_equal(single.qpos[0], batch.qpos[0]) and np.array_equal(single.qvel[0], batch.qvel[0])
        assert np.array_equal(batch.qpos[1], data.qpos) and np.array_equal(batch.qvel[1], data.qvel)
    assert not np.array_equal(batch.qpos[0], batch.qpos[1])


@pytest.fixture
def inductive(tmp_path):
    """The flat world with the winding's 0.24 mH."""
    folder = shutil.copytree(models_folder(), tmp_path / "models")
    text = (folder / "car.xml").read_text()
    (folder / "car.xml").write_text(text.replace('resistance="2.32"', 'resistance="2.32" inductance="2.4e-4 0"'))
    return str(folder / "flat.xml")


def test_inductance(inductive):
    """With a winding the current is a state: L di/dt = U − R i − k_E N ω, 0.1 ms behind the voltage."""
    model = mjcf.load(inductive, timestep=1e-5)
    physics = CarPhysics.from_compiled(model)
    assert physics.data.act.size == 2
    physics.data.qpos[:], physics.data.qvel[:] = stand(model, np.zeros(3), np.zeros(2))
    physics.data.ctrl[:2] = 6.0, 3.0
    for _ in range(40):
        physics.step()
        current = np.array([6.0, 3.0]) / 2.32 * (1 - math.exp(-physics.data.time * 2.32 / 2.4e-4))
        assert physics.motor_current() == pytest.approx(current, rel=0.08)
        assert np.array_equal(physics.motor_current(), physics.data.act)


def test_inductance_in_the_loop(inductive):
    """It runs, alone and in a batch with the same bits, and hardly differs from a winding without."""
    scenarios = [
        Scenario(world=world, reference=Circle(period=4, radius=0.5), laps=1, prior="model", learner="none", seed=seed)
        for seed, world in ((0, inductive), (1, inductive), (0, "flat"))
    ]
    runs = simulate(scenarios)
    with_winding, _, without = (runs.isel(run=run) for run in range(3))
    assert np.array_equal(with_winding.current_left, simulate(scenarios[0]).current_left)
    assert not with_winding.failed and not np.array_equal(with_winding.v, without.v)
    assert np.abs(with_winding.v - without.v).max() < 0.01
    emf = 43 * 0.0234 * with_winding.wheel_rate_left
    static = (with_winding.voltage_left - emf) / 2.32
    assert np.median(np.abs(with_winding.current_left[:-1] - static[:-1])) < 0.1
