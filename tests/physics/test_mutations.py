"""Every check fails when the law that it tests is broken on purpose."""

import mujoco
import numpy as np
import pytest

from mrctl.checks.catalogue import CHECKS
from mrctl.checks.comparison import CheckFailed
from mrctl.physics.mjcf import load
from mrctl.physics.parameters import read_robot

MOTORS = ("motor_left", "motor_right")
REAR = ("wheel_left", "wheel_right")
CHECK = {check.name: check for check in CHECKS}


def gear(m, factor):
    for name in MOTORS:
        m.actuator(name).gear[0] *= factor


def motor_constant(m, factor):
    for name in MOTORS:
        m.actuator(name).gainprm[1] *= factor


def resistance(m, factor):
    for name in MOTORS:
        m.actuator(name).gainprm[0] *= factor


def rotor(m, factor):
    for name in MOTORS:
        m.actuator_armature[m.actuator(name).id] *= factor


def radius(m, factor):
    for name in REAR:
        m.geom(name).size[0] *= factor


def left_radius(m, factor):
    m.geom("wheel_left").size[0] *= factor


def front_radius(m, factor):
    m.geom("front_wheel").size[0] *= factor
    m.body("fork").pos[2] += 0.075 * (factor - 1)


def wheel_inertia(m, factor):
    m.body("wheel_left").inertia[:] *= factor


def small_front(m, factor):
    m.geom("front_wheel").size[0] *= factor


def frictionloss(m, factor):
    for name in REAR:
        m.joint(name).frictionloss[0] *= factor


def front_frictionloss(m, factor):
    m.joint("front_wheel").frictionloss[0] *= factor


def left_frictionloss(m, factor):
    m.joint("wheel_left").frictionloss[0] *= factor


def grip(m, factor):
    m.pair_friction[:, :2] *= factor


def front_grip(m, factor):
    m.pair("tyre_front").friction[:2] *= factor


def mass(m, factor):
    m.body("chassis").mass[0] *= factor


def inertia(m, factor):
    m.body("chassis").inertia[2] *= factor


def com_ahead(m, metres):
    m.body("chassis").ipos[0] += metres


def com_aside(m, metres):
    m.body("chassis").ipos[1] += metres


def com_up(m, metres):
    m.body("chassis").ipos[2] += metres


def wheelbase(m, factor):
    m.body("fork").pos[0] *= factor


def trail(m, metres):
    m.body("front_wheel").pos[0] = -metres


def track(m, factor):
    for name in REAR:
        m.body(name).pos[1] *= factor


def gravity(m, factor):
    m.opt.gravity *= factor


def level(m, radians):
    """Tilts the floor, uphill to the left."""
    m.opt.gravity[1] = -9.81 * np.sin(radians)


def steering_axis(m, sign):
    m.joint("steering").axis[2] = sign


def fork_stiffness(m, stiffness):
    m.actuator("steering").biasprm[1] = -stiffness


def air(m, damping):
    """Adds drag along x."""
    m.dof_damping[0] = damping


def contact_time(m, seconds):
    """Makes contacts soft, or shorter than the step resolves: MuJoCo softens those, depending on the step."""
    m.pair_solref[:, 0] = seconds
    m.pair_solreffriction[:] = 0  # as solref


def incline(m, degrees):
    mujoco.mju_euler2Quat(m.geom("floor").quat, np.array([0, -np.radians(degrees), 0]), "xyz")


def bumps(m, factor):
    m.hfield_size[0, 2] *= factor


# Each check, with changes that break its law.
MUTATIONS = [
    ("units", grip, 100.0),
    ("units", mass, 1000.0),
    ("units", motor_constant, 1e-3),
    ("stance", small_front, 0.9),
    ("stance", radius, 1.1),
    ("limits", gear, 2.2),
    ("limits", resistance, 20.0),
    ("limits", grip, 1e-3),
    ("turning_limits", track, 3.0),
    ("turning_limits", inertia, 100.0),
    ("motors", rotor, 0.0),
    ("motors", motor_constant, 0.1),
    ("inertias", wheel_inertia, 100.0),
    ("rest", com_ahead, 0.01),
    ("rest", com_aside, 0.01),
    ("rest", mass, 1.01),
    ("rest", wheelbase, 1.03),
    ("rest", trail, 0.0),
    ("rest", level, 0.2),
    ("hold_on_slope", frictionloss, 0.7),
    ("hold_on_slope", gravity, 2.5),
    ("hold_on_slope", frictionloss, 2.0),
    ("hold_on_slope", resistance, 1.1),
    ("hold_on_slope", mass, 1.1),
    ("top_speed", gear, 1.02),
    ("top_speed", motor_constant, 0.98),
    ("top_speed", radius, 1.01),
    ("top_speed", frictionloss, 2.0),
    ("top_speed", front_frictionloss, 1.2),
    ("top_speed", resistance, 1.1),
    ("stall", gear, 1.02),
    ("stall", resistance, 1.02),
    ("stall", radius, 1.02),
    ("stall", track, 1.05),
    ("stall", frictionloss, 2.0),
    ("stall", grip, 1e-4),
    ("velocity_time_constant", rotor, 0.0),
    ("velocity_time_constant", mass, 1.03),
    ("velocity_time_constant", resistance, 1.03),
    ("velocity_time_constant", gear, 1.03),
    ("rotation_time_constant", rotor, 0.0),
    ("rotation_time_constant", inertia, 1.1),
    ("rotation_time_constant", com_ahead, 0.01),
    ("rotation_time_constant", track, 1.03),
    ("coast_down", frictionloss, 2.0),
    ("coast_down", front_frictionloss, 0.0),
    ("coast_down", rotor, 0.0),
    ("coast_down", mass, 1.02),
    ("coast_down", air, 0.5),
    ("circle", wheelbase, 1.02),
    ("circle", trail, 0.03),
    ("circle", grip, 1e-4),
    ("circle", fork_stiffness, 1.0),
    ("circle", steering_axis, -1.0),
    ("rolling", wheelbase, 1.1),
    ("rolling", radius, 1.03),
    ("rolling", left_radius, 1.03),
    ("rolling", front_radius, 0.97),
    ("rolling", track, 1.1),
    ("rolling", grip, 0.01),
    ("rolling", contact_time, 0.05),
    ("traction", grip, 1.1),
    ("traction", grip, 1e-4),
    ("traction", resistance, 20.0),
    ("traction", com_up, 0.06),
    ("traction", com_ahead, 0.03),
    ("cornering", grip, 1.1),
    ("cornering", grip, 0.8),
    ("cornering", grip, 5.0),
    ("cornering", wheelbase, 1.02),
    ("centre_of_mass", com_ahead, 0.01),
    ("centre_of_mass", com_ahead, -0.005),
    ("centre_of_mass", mass, 1.1),
    ("centre_of_mass", track, 1.1),
    ("prediction", mass, 1.3),
    ("prediction", inertia, 2.0),
    ("prediction", com_ahead, 0.03),
    ("prediction", gear, 1.05),
    ("prediction", frictionloss, 2.0),
    ("prediction", fork_stiffness, 2.0),
    ("scrub_free", trail, 0.005),
    ("scrub_free", wheelbase, 1.1),
    ("scrub_free", front_grip, 1e-4),
    ("energy", resistance, 1.2),
    ("energy", gear, 1.1),
    ("energy", frictionloss, 2.0),
    ("energy", air, 1.0),
    ("mirror", com_aside, 0.001),
    ("mirror", left_radius, 1.001),
    ("mirror", left_frictionloss, 1.1),
    ("mirror", level, 0.01),
    ("invariance", level, 0.01),
    ("invariance", air, 0.1),
    ("convergence", contact_time, 0.003),
    ("convergence", contact_time, 0.0015),
    ("convergence", resistance, 0.03),
    ("slope", incline, 9.8),
    ("slope", gravity, 0.98),
    ("slope", frictionloss, 2.0),
    ("slope", rotor, 0.0),
    ("tilted_gravity", incline, 9.8),
    ("patch", grip, 2.0),
    ("patch", resistance, 30.0),
    ("patch", com_ahead, 0.03),
    ("rough", bumps, 5.0),
    ("rough", grip, 1e-4),
    ("rough", radius, 1.1),
]


@pytest.mark.parametrize(("name", "mutate", "amount"), MUTATIONS, ids=lambda v: getattr(v, "__name__", None) or str(v))
def test_mutation(name, mutate, amount):
    """The check fails by a comparison, and not by another error."""
    check = CHECK[name]
    model = load(check.world, check.steering)
    robot = read_robot(model)
    mutate(model, amount)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    with pytest.raises(CheckFailed):
        check.run(model, robot)


def test_every_check_has_a_mutation():
    """Every check is failed by some change."""
    assert {name for name, _, _ in MUTATIONS} == set(CHECK)
