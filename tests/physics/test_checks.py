"""The checks pass for the shipped robot and for variants of it, and its file holds the documented numbers."""

import math
import shutil

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mrctl.checks.catalogue import CHECKS, Check
from mrctl.checks.comparison import CheckFailed, Comparison, between, compare
from mrctl.physics.files import models_folder
from mrctl.physics.mjcf import clone, load, load_robot
from mrctl.physics.parameters import read_robot
from mrctl.physics.perturb import perturb
from mrctl.theory.perturbation import Perturbation

ON_LEVEL = [c for c in CHECKS if c.world == "flat"]


@pytest.mark.parametrize("check", CHECKS, ids=lambda c: c.name)
def test_shipped_robot(check):
    """Every check passes, compares at least one value, and leaves the model as it was."""
    model = load(check.world, check.steering)
    before = np.concatenate([model.body_mass, model.dof_damping, *model.pair_friction, *model.actuator_gainprm])
    assert check.run(model, read_robot(model))
    after = np.concatenate([model.body_mass, model.dof_damping, *model.pair_friction, *model.actuator_gainprm])
    assert np.array_equal(before, after)  # variants are made on copies


# Values of the design table and its data sheets, and results by hand such as 24/(0.0234 · 43) · 0.098 m/s. The checks
# take their expectations from the model's file; this holds the file to the design, to the digits of that table.
DOCUMENTED = {
    "mass": (20.0, 0.05),
    "yaw_inertia": (0.60, 0.005),
    "com_offset": (0.10, 0.005),
    "com_height": (0.12, 0.005),
    "wheel_radius": (0.098, 0.0005),
    "half_track": (0.188, 0.0005),
    "wheelbase": (0.40, 0.005),
    "trail": (0.03, 0.0005),
    "resistance": (2.32, 0.005),
    "torque_constant": (0.0234, 0.00005),
    "gear_ratio": (43.0, 0.5),
    "rotor_inertia": (1.03e-6, 0.005e-6),
    "wheel_inertia": (3.4e-3, 0.05e-3),
    "gear_loss": (0.10, 0.005),
    "rolling_coefficient": (0.015, 0.0005),
    "tyre_friction": (0.9, 0.05),
    "supply": (24.0, 0.5),
    "effective_inertia": (0.84, 0.005),
    "velocity_time_constant": (0.23, 0.005),
    "rotation_time_constant": (0.26, 0.005),
    "velocity_gain": (0.0974, 0.00005),
    "rotation_gain": (0.518, 0.0005),
}


@pytest.mark.parametrize("name", DOCUMENTED)
def test_documented(name):
    """The file holds the documented value."""
    value, digits = DOCUMENTED[name]
    assert getattr(read_robot(load()), name) == pytest.approx(value, abs=digits)


def test_documented_limits():
    """No-load speed and stall torque of the design."""
    robot = read_robot(load())
    assert robot.velocity_gain * robot.supply == pytest.approx(2.34, abs=0.005)
    assert robot.motor_gain * robot.supply == pytest.approx(10.4, abs=0.05)


def heavy(model):
    perturb(clone(model), model, Perturbation(mass_factor=1.5, drive_friction_factor=2.0))


def weak(model):
    perturb(clone(model), model, Perturbation(resistance_factor=1.3, motor_constant_factor=0.8))


def large(model):
    """Makes the robot longer and wider, on larger wheels with the same loads."""
    model.body("fork").pos[0] *= 1.2
    for wheel in ("wheel_left", "wheel_right"):
        model.body(wheel).pos[1] *= 1.2
        model.geom(wheel).size[0] *= 1.1
    model.body("fork").pos[2] -= 0.1 * 0.098
    mujoco.mj_setConst(model, mujoco.MjData(model))


def viscous(model):
    """Adds viscous friction at both wheels and in both motors, together a quarter of the back-EMF's braking."""
    for side in ("left", "right"):
        model.joint(f"wheel_{side}").damping[:] = 0.06
        model.actuator_damping[model.actuator(f"motor_{side}").id] = 0.05 / 43**2


@pytest.mark.parametrize("change", [heavy, weak, large, viscous], ids=lambda f: f.__name__)
@pytest.mark.parametrize("check", ON_LEVEL, ids=lambda c: c.name)
def test_other_robots(check, change):
    """Another robot, read from its own model, obeys the same laws: no check is tuned to the shipped one."""
    model = load(check.world, check.steering)
    change(model)
    check.run(model, read_robot(model))


DRIVE = """<mujoco><worldbody><body name="base" pos="0 0 {r}"><freejoint/>
  <geom type="box" size="{a} {b} {h}" pos="{c} 0 {h}" mass="{mass}"/>
  <geom type="sphere" size="{ball}" pos="{front} 0 -{h}"/>
  <body name="w1" pos="0 {y} 0"><joint name="left" axis="0 1 0" frictionloss="{loss}" solimpfriction=".99 .99"/>
    <geom type="cylinder" size="{r} {w}" zaxis="0 1 0" mass="{wheel}"/></body>
  <body name="w2" pos="0 -{y} 0"><joint name="right" axis="0 1 0" frictionloss="{loss}" solimpfriction=".99 .99"/>
    <geom type="cylinder" size="{r} {w}" zaxis="0 1 0" mass="{wheel}"/></body>
  </body></worldbody><actuator><dcmotor joint="left" {motor}/><dcmotor joint="right" {motor}/></actuator></mujoco>"""
DRIVE_SIZES = {
    "a": 0.15, "b": 0.08, "h": 0.03, "c": 0.06, "ball": 0.02, "front": 0.16, "y": 0.1, "r": 0.05, "w": 0.01,
}  # fmt: skip
MOTORS = {
    "tiny": 'gear="20" motorconst="0.002 0.002" resistance="10" armature="1e-9" ctrlrange="-3 3"',
    "truck": 'gear="40" motorconst="0.5 0.5" resistance="0.05" armature="0.05" ctrlrange="-96 96"',
    "direct": 'motorconst="1 1" resistance="0.5" armature="1e-3" ctrlrange="-24 24"',
}
SCALES = {  # size, mass in kg, frictionloss in N·m
    "tiny": (0.2, 0.05, 2e-4), "truck": (10.0, 1500.0, 30.0), "direct": (1.7, 15.0, 0.1),
}  # fmt: skip
MEASURED = (
    "hold_on_slope", "top_speed", "stall", "coast_down", "centre_of_mass", "velocity_time_constant",
    "rotation_time_constant", "energy",
)  # fmt: skip


@pytest.mark.parametrize("name", MEASURED)
@pytest.mark.parametrize("size", SCALES)
def test_robots_of_any_size(tmp_path, size, name):
    """Drives of 50 g on wheels of 1 cm, of 1.5 t on wheels of half a metre, and without a gear obey equation (3)."""
    scale, mass, loss = SCALES[size]
    lengths = {key: scale * value for key, value in DRIVE_SIZES.items()}
    (tmp_path / "robot.xml").write_text(
        DRIVE.format(**lengths, mass=mass, wheel=mass / 15, loss=loss, motor=MOTORS[size])
    )
    (check,) = (check for check in CHECKS if check.name == name)
    model = load(robot=load_robot(tmp_path / "robot.xml"))
    check.run(model, read_robot(model))


@pytest.mark.parametrize("name", ["hold_on_slope", "coast_down", "top_speed"])
def test_no_losses(name):
    """A robot without Coulomb losses has no voltage that they take; what measures their force does not suit it."""
    (check,) = (check for check in CHECKS if check.name == name)
    model = load(check.world, check.steering)
    model.dof_frictionloss[:] = 0
    model.numeric("no_load_current").data[:] = 0
    if name == "top_speed":
        assert check.unsuited(model) == "" and check.run(model, read_robot(model))
    else:
        assert check.unsuited(model) == "the robot has no Coulomb losses" and not check.unsuited(load())


def test_weak_motors_and_strong_losses():
    """Checks that drive a robot to what it cannot do do not suit it, up to where it can."""
    slope, traction = (next(c for c in CHECKS if c.name == name) for name in ("hold_on_slope", "traction"))
    model, resistance = load(), 2.32
    stall = 2 * (24 * 43 * 0.0234 / resistance - 0.23) / 0.098  # N, with rolling loss
    grip = 0.2 * 0.9 * 20 * 9.81 * (1 - 0.1 / 0.37)
    for factor, said in ((0.9, ""), (1.2, "the motors hardly spin the wheels on a fifth of their grip")):
        model.actuator_gainprm[[model.actuator(f"motor_{side}").id for side in ("left", "right")], 0] = (
            factor * resistance * 0.3 * stall / grip
        )
        assert traction.unsuited(model) == said
    held = 20 * 9.81 * np.sin(0.5) / 1.1  # N; a tenth more is the least that `hold_on_slope` lets pull the robot down
    for factor, said in ((0.95, ""), (1.05, "its losses hold the robot on all slopes up to 0.5 rad")):
        for side in ("left", "right"):
            model.joint(f"wheel_{side}").frictionloss[:] = factor * held / 2 * 0.098
        assert slope.unsuited(model) == said


@pytest.mark.parametrize("name", ["stall", "energy", "velocity_time_constant", "rotation_time_constant"])
def test_inductance(tmp_path, name):
    """The current of a winding follows within L/R, here 2 ms, which changes neither stall torque, balance nor lag."""
    folder = shutil.copytree(models_folder(), tmp_path / "models")
    text = (folder / "car.xml").read_text()
    (folder / "car.xml").write_text(text.replace('resistance="2.32"', 'resistance="2.32" inductance="4.64e-3 0"'))
    (check,) = (check for check in CHECKS if check.name == name)
    model = load(str(folder / "flat.xml"), check.steering)
    check.run(model, read_robot(model))


def test_energy_of_which_nothing_is_missing():
    """With 1.42 times the drive friction, errors of first order cancel, and what is left need not halve."""
    (check,) = (check for check in CHECKS if check.name == "energy")
    nominal = load("flat", "compliant")
    model = clone(nominal)
    perturb(nominal, model, Perturbation(drive_friction_factor=1.42))
    check.run(model, read_robot(model))


def test_energy_in_a_spring():
    """A spring at a steered wheel holds energy, which is in the balance once."""
    (check,) = (check for check in CHECKS if check.name == "energy")
    model = load(robot=load_robot("racecar"))
    model.joint("steering_front_left").stiffness[0] = 1.0
    check.run(model, read_robot(model))


@pytest.mark.parametrize("measured", [1.02, 0.98, math.nan, math.inf])
def test_compare_refuses(measured):
    """A value that is out of tolerance or not finite fails the check."""

    def speed(model, robot):
        return [compare("length", 1.0, 1.0, "m"), compare("speed", measured, 1.0, "m/s", relative=0.01)]

    check = Check(speed, "flat", "compliant")
    model = load()
    assert [c.passed for c in check.measure(model, read_robot(model))] == [True, False]
    with pytest.raises(CheckFailed, match="speed") as caught:
        check.run(model, read_robot(model))
    assert isinstance(caught.value, AssertionError)
    assert caught.value.comparison.expected == 1.0


def test_compare_accepts():
    """A value within the tolerance passes, bounds included."""
    comparison = compare("speed", 1.5, 1.0, "m/s", absolute=0.5)
    assert comparison == Comparison("speed", 1.5, 1.0, 0.5, "m/s") and comparison.passed
    assert between("speed", 2.0, 0.0, 2.0).passed and not between("speed", 2.1, 0.0, 2.0).passed


@given(st.floats(-1e9, 1e9), st.floats(-1e9, 1e9))
def test_between(one, other):
    """Both ends of any interval pass, and what lies outside by a millionth of its width and of its ends does not."""
    low, high = sorted((one, other))
    assert between("speed", low, low, high).passed and between("speed", high, low, high).passed
    beyond = 1e-6 * (high - low + abs(low) + abs(high)) + 1e-300
    assert not between("speed", low - beyond, low, high).passed
    assert not between("speed", high + beyond, low, high).passed
