"""The parameters of a robot as read from its compiled MJCF, against the numbers of its data sheet."""

import math
import shutil

import mujoco
import numpy as np
import pytest

from mrctl.physics import mjcf
from mrctl.physics.files import models_folder
from mrctl.physics.parameters import read_robot
from mrctl.physics.perturb import perturb
from mrctl.record import InputError
from mrctl.theory.perturbation import Perturbation
from mrctl.theory.references import Circle, check
from mrctl.theory.robot import RobotFile
from mrctl.theory.timing import Limits

NOMINAL = mjcf.load()
BASE = read_robot(NOMINAL)

PUBLISHED = {
    "mass": 20,
    "yaw_inertia": 0.60,
    "com_offset": 0.10,
    "com_height": 0.12,
    "wheel_radius": 0.098,
    "front_wheel_radius": 0.075,
    "half_track": 0.188,
    "wheelbase": 0.40,
    "trail": 0.03,
    "steering_limit": math.radians(60),
    "steering_stiffness": 2.0,
    "steering_damping": 0.1,
    "fork_inertia": 0.5e-3 + 0.5 * 0.01**2 + 0.6e-3 + 0.7 * 0.03**2,
    "fork_moment": 0.5 * 0.01 + 0.7 * 0.03,
    "resistance": 2.32,
    "inductance": 0.0,
    "torque_constant": 0.0234,
    "gear_ratio": 43,
    "rotor_inertia": 1.03e-6,
    "no_load_current": 0.037,
    "gear_loss": 0.10,
    "rolling_coefficient": 0.015,
    "wheel_inertia": 3.4e-3,
    "supply": 24,
    "drive_gain": 1,
    "tyre_friction": 0.9,
    "max_speed": 1.5,
    "max_rotation": 3,
    "max_acceleration": 1.5,
    "max_rotation_acceleration": 6,
    "effective_mass": 21.1,
    "effective_inertia": 0.84,
    "velocity_time_constant": 0.23,
    "rotation_time_constant": 0.26,
    "velocity_gain": 0.0974,
    "rotation_gain": 0.518,
}


@pytest.mark.parametrize(("name", "value"), PUBLISHED.items())
def test_published(name, value):
    """The MJCF has the documented parameters."""
    assert getattr(BASE, name) == pytest.approx(value, rel=0.02)


def test_exact():
    """Parameters that the file states are read exactly, and those derived from it to six digits."""
    for name in ("mass", "wheel_radius", "half_track", "resistance", "torque_constant", "rotor_inertia", "supply"):
        assert getattr(BASE, name) == pytest.approx(PUBLISHED[name], rel=1e-12)
    for name in ("yaw_inertia", "com_offset", "com_height", "gear_loss", "rolling_coefficient"):
        assert getattr(BASE, name) == pytest.approx(PUBLISHED[name], rel=2e-5)


def test_too_little_friction():
    """A rear wheel with the front wheel's frictionloss has less than rolls away under its larger load."""
    model = mjcf.clone(NOMINAL)
    for side in ("left", "right"):
        model.joint(f"wheel_{side}").frictionloss[:] = 0.059655
    rolling, no_load = 0.015 * 20 * 9.81 * (1 - 0.1 / 0.37) / 2 * 0.098, 43 * 0.0234 * 0.037
    with pytest.raises(InputError, match=rf"0\.0597 N·m, is smaller than .* losses of {rolling + no_load:.3g} N·m"):
        read_robot(model)


def test_viscous_friction():
    """The damping of a joint adds to its motor's, times gear²; a lifted wheel runs free at N k U/(N² k² + b R_a)."""
    model = mjcf.clone(NOMINAL)
    motors = [model.actuator(f"motor_{side}").id for side in ("left", "right")]
    wheels = [model.joint(f"wheel_{side}").dofadr[0] for side in ("left", "right")]
    model.dof_damping[wheels], model.actuator_damping[motors] = [0.05, 0.07], 0.04 / 43**2
    model.dof_frictionloss[:], model.numeric("no_load_current").data[:], model.opt.gravity[:] = 0, 0, 0
    data = mujoco.MjData(model)
    data.ctrl[model.actuator_ctrladr[motors]] = 24, 24
    while data.time < 3:
        mujoco.mj_step(model, data)
    model.opt.gravity[2] = -9.81
    robot = read_robot(model)
    assert robot.wheel_damping == pytest.approx(0.10, rel=1e-12)
    constant = 43 * 0.0234
    free = [constant * 24 / (constant**2 + b * 2.32) for b in (0.09, 0.11)]
    np.testing.assert_allclose(data.qvel[wheels], free, rtol=1e-6)
    assert robot.voltage_per_rate == pytest.approx(constant + 0.10 * 2.32 / constant, rel=1e-12)
    assert (BASE.wheel_damping, BASE.voltage_per_rate) == (0, BASE.back_emf)


def test_motor_limits():
    """The no-load speed is 2.34 m/s and the stall torque 10.4 N·m."""
    assert BASE.supply * BASE.velocity_gain == pytest.approx(2.34, abs=5e-3)
    assert BASE.supply * BASE.motor_gain == pytest.approx(10.4, abs=0.05)


def test_inertia_by_physics():
    """Mass and J_z + m c² about P are those of the engine's own mass matrix."""
    model, data = mjcf.clone(NOMINAL), mujoco.MjData(NOMINAL)
    mujoco.mj_forward(model, data)
    matrix = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, matrix)
    yaw = np.zeros(model.nv)
    yaw[5] = 1
    assert matrix[0, 0] == pytest.approx(BASE.mass)
    assert yaw @ matrix @ yaw == pytest.approx(BASE.yaw_inertia + BASE.mass * BASE.com_offset**2)


@pytest.mark.parametrize("robot", ["car", "racecar"])
def test_steering_by_physics(robot):
    """What the steering turns has the inertia, and a fork the coupling to the yaw, of the engine's mass matrix."""
    model = mjcf.load(steering="compliant" if robot == "car" else "rigid", robot=RobotFile(path=robot))
    data, found = mujoco.MjData(model), read_robot(model)
    mujoco.mj_forward(model, data)
    matrix = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, matrix)
    turn, yaw = np.zeros(model.nv), np.eye(model.nv)[5]
    turn[model.joint("steering").dofadr[0]] = 1
    for knuckle in ("steering_front_left", "steering_front_right") if robot == "racecar" else ():
        turn[model.joint(knuckle).dofadr[0]] = model.equality(knuckle).data[1]
    assert turn @ matrix @ turn == pytest.approx(found.fork_inertia)
    if robot == "car":
        assert turn @ matrix @ yaw == pytest.approx(found.fork_inertia - found.fork_moment * found.wheelbase)


def test_steering_of_the_arrangements():
    """A free fork has no stiffness; a rigid one is 20 times as stiff, and its wheel is under the axis."""
    caster, rigid = (mjcf.build(steering=name)[1] for name in ("caster", "rigid"))
    assert (caster.steering_stiffness, caster.steering_damping) == (0, 0.02)
    assert (rigid.steering_stiffness, rigid.steering_damping) == (40, 1)
    assert rigid.fork_moment == pytest.approx(0.005) and caster.fork_moment == BASE.fork_moment
    turtlebot = mjcf.build(steering="caster", robot=RobotFile(path="turtlebot"))[1]
    assert (turtlebot.steering_stiffness, turtlebot.fork_inertia, turtlebot.fork_moment) == (0, 0, 0)


def test_gravity(tmp_path):
    """The robot has the gravity of its world; its friction torques are those of the file, and a slope changes none."""
    folder = shutil.copytree(models_folder(), tmp_path / "models")
    text = (folder / "flat.xml").read_text()
    assert text.count('<include file="car.xml"/>') == 1
    include = '<include file="car.xml"/><option gravity="0 0 {}"/>'
    for name, value in (("moon", -1.62), ("nowhere", 0)):
        (folder / f"{name}.xml").write_text(text.replace('<include file="car.xml"/>', include.format(value)))
    model, robot = mjcf.build(str(folder / "moon.xml"))
    assert (BASE.gravity, robot.gravity) == (9.81, 1.62)
    assert robot.rolling_force == pytest.approx(BASE.rolling_force)
    assert robot.gear_loss == pytest.approx(BASE.gear_loss)
    assert Limits.of(robot).lateral_acceleration == pytest.approx(0.9 * robot.tyre_friction * 1.62)
    with pytest.raises(InputError, match=r"lateral acceleration 2.08 m/s² .* 1.46 m/s²"):
        check(Circle(radius=0.8, period=3.9), robot, reverse=False)
    with pytest.raises(InputError, match="gravity: is zero"):
        mjcf.build(str(folder / "nowhere.xml"))
    sloped = mjcf.clone(model)
    perturb(model, sloped, Perturbation(slope=0.3))
    assert read_robot(sloped).gravity == 1.62


def test_inductance(tmp_path):
    """The inductance is read from the file, and does not change with the resistance."""
    folder = shutil.copytree(models_folder(), tmp_path / "models")
    text = (folder / "car.xml").read_text()
    assert 'resistance="2.32"' in text
    (folder / "car.xml").write_text(text.replace('resistance="2.32"', 'resistance="2.32" inductance="2.4e-4 0"'))
    nominal = mjcf.load(str(folder / "flat.xml"))
    model = mjcf.clone(nominal)
    perturb(nominal, model, Perturbation(resistance_factor=1.5))
    for candidate, resistance in ((nominal, 2.32), (model, 3.48)):
        robot = read_robot(candidate)
        assert robot.inductance == pytest.approx(2.4e-4)
        assert robot.resistance == pytest.approx(resistance)
