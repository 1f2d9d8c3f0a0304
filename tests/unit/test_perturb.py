"""Perturbations of the compiled model: each changes the parameters that it names and no others."""

import math

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mrctl.physics import mjcf
from mrctl.physics.elements import MOTORS
from mrctl.physics.parameters import read_robot
from mrctl.physics.perturb import fields, limit_current, perturb, write
from mrctl.physics.readout import current_limits, motor_parameters
from mrctl.record import InputError
from mrctl.theory.drive import NO_LIMIT
from mrctl.theory.perturbation import Perturbation
from mrctl.theory.robot import GRAVITY, Robot

NOMINAL = mjcf.load()
BASE = read_robot(NOMINAL)


def perturbed(**values) -> mujoco.MjModel:
    """Returns a perturbed copy of the nominal model."""
    model = mjcf.clone(NOMINAL)
    perturb(NOMINAL, model, Perturbation(**values))
    return model


def changes(**values) -> dict[str, float]:
    """Returns the parameters that a perturbation changes, as ratios to the nominal ones."""
    after, before = read_robot(perturbed(**values)).model_dump(), BASE.model_dump()
    return {name: after[name] / before[name] for name in before if not math.isclose(after[name], before[name])}


def test_no_perturbation():
    """The default perturbation gives the nominal model to the bit, also after another perturbation."""
    model = perturbed(mass_factor=1.7, payload=3, left_radius_factor=1.1, motor_constant_factor=0.8, slope=0.2)
    for candidate in (perturbed(), model):
        perturb(NOMINAL, candidate, Perturbation())
        for name, value in fields(NOMINAL).items():
            assert np.array_equal(fields(candidate)[name], value), name
        for name in ("body_invweight0", "dof_invweight0", "body_subtreemass", "actuator_acc0", "dof_M0"):
            assert np.array_equal(getattr(candidate, name), getattr(NOMINAL, name)), name


def test_every_changed_field_is_listed():
    """Outside `PERTURBED` only constants that the engine derives change."""
    model = perturbed(
        mass_factor=1.5, inertia_factor=1.2, payload=2, payload_y=0.05, left_radius_factor=1.02,
        right_radius_factor=0.98, drive_friction_factor=3, resistance_factor=1.3, motor_constant_factor=0.85,
        supply_factor=1.2, tyre_friction_factor=0.5, slope=0.1, left_resistance_factor=1.1,
        right_motor_constant_factor=0.9, left_drive_friction_factor=1.3,
    )  # fmt: skip
    limit_current(NOMINAL, model, 3.0)
    copied = mjcf.clone(NOMINAL)
    write(copied, fields(model), mujoco.MjData(copied))
    names = [n for n in dir(model) if not n.startswith("_") and isinstance(getattr(model, n), np.ndarray)]
    assert len(names) > 300
    for name in names:
        one, other = getattr(model, name), getattr(copied, name)
        assert np.array_equal(one, other, equal_nan=one.dtype.kind == "f"), name
    assert np.array_equal(model.opt.gravity, copied.opt.gravity)
    assert model.stat.meaninertia == copied.stat.meaninertia


MASSES = ("mass", "yaw_inertia", "fork_inertia", "fork_moment", "wheel_inertia", "front_wheel_inertia")


@pytest.mark.parametrize(
    ("perturbation", "expected"),
    [
        ({"mass_factor": 1.5}, {name: 1.5 for name in MASSES}),
        ({"drive_friction_factor": 3.0}, {"no_load_current": 3.0, "gear_loss": 3.0}),
        ({"resistance_factor": 1.3}, {"resistance": 1.3}),
        ({"motor_constant_factor": 0.85}, {"torque_constant": 0.85, "no_load_current": 1 / 0.85}),
        ({"left_drive_friction_factor": 2.0}, {"no_load_current": 1.5, "gear_loss": 1.5}),
        ({"right_resistance_factor": 1.2}, {"resistance": 1.1}),
        ({"left_motor_constant_factor": 0.8}, {"torque_constant": 0.9, "no_load_current": 1 / 0.9}),
        ({"tyre_friction_factor": 0.5}, {"tyre_friction": 0.5}),
        ({"slope": 0.1}, {}),
        ({"control_delay": 0.02, "dead_zone": 0.1}, {}),
    ],
)
def test_factor(perturbation, expected):
    """A perturbation changes the parameters it names and no others; the no-load torque is a loss."""
    assert changes(**perturbation) == pytest.approx(expected)


def test_unequal_motors():
    """Each motor has its own constant, resistance and loss; the rolling loss stays, and the robot has the means."""
    model = perturbed(
        motor_constant_factor=0.9, left_motor_constant_factor=1.1, resistance_factor=1.3, right_resistance_factor=1.2,
        drive_friction_factor=2.0, left_drive_friction_factor=0.5, right_drive_friction_factor=1.5,
    )  # fmt: skip
    resistance, back_emf, _ = motor_parameters(model)
    assert resistance == pytest.approx(2.32 * 1.3 * np.array([1.0, 1.2]))
    assert back_emf == pytest.approx(43 * 0.0234 * 0.9 * np.array([1.1, 1.0]))
    rolling = NOMINAL.joint("wheel_left").frictionloss[0] - BASE.drive_loss
    losses = [model.joint(wheel).frictionloss[0] - rolling for wheel in ("wheel_left", "wheel_right")]
    assert losses == pytest.approx([BASE.drive_loss, 3 * BASE.drive_loss])
    robot = read_robot(model)
    assert robot.drive_loss == pytest.approx(2 * BASE.drive_loss)
    assert robot.resistance == pytest.approx(2.32 * 1.3 * 1.1)
    assert robot.torque_constant == pytest.approx(0.0234 * 0.9 * 1.05)


def test_current_limit():
    """The limit on the current is one on the torque of each motor, k_M I; a lower one in the file counts."""
    model = perturbed(left_motor_constant_factor=0.8)
    limit_current(NOMINAL, model, 3.0)
    assert current_limits(model) == pytest.approx([3, 3])
    motors = [model.actuator(name).id for name in MOTORS]
    assert model.actuator_forcerange[motors] == pytest.approx(0.0234 * 3 * np.array([[-0.8, 0.8], [-1, 1]]))
    limit_current(NOMINAL, model, NO_LIMIT)
    assert np.isinf(current_limits(model)).all() and not model.actuator_forcelimited.any()
    own = mjcf.clone(NOMINAL)
    own.actuator_forcelimited[motors[0]], own.actuator_forcerange[motors[0]] = True, (-0.0468, 0.0468)
    for limit, expected in ((NO_LIMIT, [2, np.inf]), (3.0, [2, 3]), (1.0, [1, 1])):
        limit_current(own, model, limit)
        assert current_limits(model) == pytest.approx(expected)


def test_one_tyre_on_ice():
    """The factor of the left tyre acts on every floor and multiplies that of all tyres."""
    nominal = mjcf.load("patch")
    pairs = [nominal.pair(k).name or "tyre" for k in range(nominal.npair)]
    left = [nominal.geom("wheel_left").id in (nominal.pair_geom1[k], nominal.pair_geom2[k]) for k in range(len(pairs))]
    assert sum(left) == 5
    model = mjcf.clone(nominal)
    perturb(nominal, model, Perturbation(left_tyre_friction_factor=0.2, tyre_friction_factor=0.5))
    expected = nominal.pair_friction[:, :2] * np.where(left, 0.1, 0.5)[:, None]
    assert model.pair_friction[:, :2] == pytest.approx(expected)
    assert np.array_equal(model.pair_friction[:, 2:], nominal.pair_friction[:, 2:])


def test_drive_friction():
    """Drive friction scales τ_loss alone; at factor 0 only the rolling loss is left."""
    for factor in (0.0, 3.0, 20.0):
        robot = read_robot(perturbed(drive_friction_factor=factor))
        assert robot.drive_loss == pytest.approx(factor * BASE.drive_loss, abs=1e-12)
        assert robot.rolling_force == pytest.approx(BASE.rolling_force)


def test_drive_friction_of_unequal_wheels():
    """Each drive's own loss is scaled: what is left at factor 0 is the rolling loss of the load on the wheel."""
    own = mjcf.clone(NOMINAL)
    rolling = BASE.rolling_coefficient * BASE.wheel_radius * (1 - BASE.front_load) / 2 * BASE.mass * GRAVITY
    wheels, losses = ("wheel_left", "wheel_right"), rolling + np.array([0.037, 0.137])
    for wheel, loss in zip(wheels, losses, strict=True):
        own.joint(wheel).frictionloss[0] = loss
    own.numeric("no_load_current").data[:] = 0.08 / BASE.back_emf
    for left, right in ((0.0, 0.0), (1.0, 1.0), (3.0, 0.5), (20.0, 0.0), (0.0, 20.0)):
        model = mjcf.clone(own)
        perturb(own, model, Perturbation(left_drive_friction_factor=left, right_drive_friction_factor=right))
        expected = rolling + np.array([0.037 * left, 0.137 * right])
        assert [model.joint(wheel).frictionloss[0] for wheel in wheels] == pytest.approx(expected)
        assert read_robot(model).drive_loss == pytest.approx(expected.mean() - rolling, abs=1e-12)


def test_rolling_follows_load():
    """A payload adds its rolling loss to the frictionloss of each wheel."""
    model = perturbed(mass_factor=1.5)
    rear = BASE.rolling_coefficient * (1 - BASE.front_load) / 2 * 10 * GRAVITY * BASE.wheel_radius
    front = BASE.rolling_coefficient * BASE.front_load * 10 * GRAVITY * BASE.front_wheel_radius
    for wheel, more in (("wheel_left", rear), ("wheel_right", rear), ("front_wheel", front)):
        before = NOMINAL.joint(wheel).frictionloss[0]
        assert model.joint(wheel).frictionloss[0] - before == pytest.approx(more)
    model = perturbed(payload=5, payload_y=0.1)
    left, right = (model.joint(wheel).frictionloss[0] for wheel in ("wheel_left", "wheel_right"))
    share = 5 * GRAVITY * 0.1 / (2 * BASE.half_track)  # moment about the robot's axis, borne by the two wheels
    assert left - right == pytest.approx(2 * share * BASE.rolling_coefficient * BASE.wheel_radius)


@pytest.mark.parametrize("factor", [0.05, 1.5])
def test_inertia_factor_of_tilted_axes(factor):
    """The factor scales the chassis' yaw inertia itself, also where its principal axes are tilted."""
    nominal = mjcf.load()
    chassis, tilt = nominal.body("chassis").id, 0.5
    mujoco.mju_axisAngle2Quat(nominal.body_iquat[chassis], np.array([0.0, 1.0, 0.0]), tilt)
    mujoco.mj_setConst(nominal, mujoco.MjData(nominal))
    own = nominal.body_inertia[chassis] @ np.array([np.sin(tilt), 0, np.cos(tilt)]) ** 2
    model = mjcf.clone(nominal)
    perturb(nominal, model, Perturbation(inertia_factor=factor))
    found = read_robot(model).yaw_inertia - read_robot(nominal).yaw_inertia
    assert found == pytest.approx((factor - 1) * own, rel=1e-9)
    assert model.body_inertia[chassis].min() > 0


def test_inertia_factor():
    """The inertia factor scales the chassis' own 0.4275 kg·m² about the vertical and nothing else."""
    robot = read_robot(perturbed(inertia_factor=1.5))
    assert robot.yaw_inertia - BASE.yaw_inertia == pytest.approx(0.5 * 0.427509)
    assert changes(inertia_factor=1.5).keys() == {"yaw_inertia"}


@given(
    st.floats(0.1, 20), st.floats(0, 0.3), st.floats(-0.1, 0.1), st.floats(0.05, 0.6), st.sampled_from([1.0, 1.5]),
)  # fmt: skip
@settings(max_examples=20)
def test_payload(payload, x, y, z, factor):
    """A payload adds to mass, centre of mass and yaw inertia as a point mass does."""
    model = perturbed(payload=payload, payload_x=x, payload_y=y, payload_z=z, mass_factor=factor)
    robot, mass = read_robot(model), factor * BASE.mass
    total = mass + payload
    com = (mass * np.array([BASE.com_offset, 0, BASE.com_height]) + payload * np.array([x, y, z])) / total
    assert robot.mass == pytest.approx(total)
    assert robot.com_offset == pytest.approx(com[0]) and robot.com_height == pytest.approx(com[2])
    inertia = factor * BASE.yaw_inertia + mass * ((BASE.com_offset - com[0]) ** 2 + com[1] ** 2)
    inertia += payload * ((x - com[0]) ** 2 + (y - com[1]) ** 2)
    assert robot.yaw_inertia == pytest.approx(inertia)
    assert robot.drive_loss == pytest.approx(BASE.drive_loss)
    assert robot.rolling_coefficient == pytest.approx(BASE.rolling_coefficient)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    chassis = model.body("chassis").id
    assert data.subtree_com[chassis] - data.xpos[chassis] == pytest.approx(com - (0, 0, BASE.wheel_radius), abs=1e-12)


def test_payload_tips():
    """A payload that would tip the robot over is refused."""
    for where in ({"payload_x": -1.0}, {"payload_x": 1.0}, {"payload_y": 1.0}):
        with pytest.raises(InputError, match=r"^perturbation.payload: .*tip over$"):
            perturbed(payload=20, **where)


def test_payload_below_ground():
    """A centre of mass below the ground is refused: smaller wheels lower a payload at the floor's height."""
    with pytest.raises(InputError, match=r"^perturbation.payload_z: .*below the ground$"):
        perturbed(mass_factor=0.5, payload=121, payload_z=0, right_radius_factor=0.8125)


def test_radii():
    """A radius factor changes one wheel's geom and its bounds, and the mean radius of the two."""
    model = perturbed(left_radius_factor=1.05)
    left, right = model.geom("wheel_left"), model.geom("wheel_right")
    assert left.size[0] == left.rbound[0] == pytest.approx(0.098 * 1.05)
    assert model.geom_aabb[left.id, 3:] == pytest.approx([left.size[0]] * 3)
    assert right.size[0] == right.rbound[0] == 0.098
    assert changes(left_radius_factor=1.05, right_radius_factor=1.05).keys() == {"wheel_radius", "com_height"}
    robot = read_robot(model)
    assert robot.wheel_radius == pytest.approx(0.098 * 1.025) and robot.front_wheel_radius == 0.075


def test_slope():
    """A slope turns gravity about y, uphill along +x, and keeps its norm."""
    gravity = perturbed(slope=0.1).opt.gravity
    assert gravity == pytest.approx(GRAVITY * np.array([-math.sin(0.1), 0, -math.cos(0.1)]))
    assert np.linalg.norm(perturbed(slope=-0.5).opt.gravity) == pytest.approx(GRAVITY)


def test_known_robot(monkeypatch):
    """Where the nominal robot is known it is not read again, and the perturbed model is the same to the bit."""
    expected = perturbed(payload=5, drive_friction_factor=2)
    model = mjcf.clone(NOMINAL)
    monkeypatch.setattr("mrctl.physics.perturb.read_robot", None)
    perturb(NOMINAL, model, Perturbation(payload=5, drive_friction_factor=2), BASE)
    for name, value in fields(expected).items():
        assert np.array_equal(fields(model)[name], value), name
    with pytest.raises(TypeError):
        perturb(NOMINAL, model, Perturbation())


def test_supply():
    """A stronger supply raises the motors' voltage range; a weaker one leaves it. The range of commands stays."""
    assert read_robot(NOMINAL, 0.8).drive_gain == 0.8
    for factor, volts in ((0.8, 24), (1.25, 30)):
        model = perturbed(supply_factor=factor)
        assert read_robot(model).supply == pytest.approx(volts)
        assert read_robot(model, factor).supply == pytest.approx(24)


FIELDS = {
    "mass_factor": (0.05, 20), "inertia_factor": (0.05, 20), "payload": (0, 200), "payload_x": (-1, 1),
    "payload_y": (-1, 1), "payload_z": (0, 1), "left_radius_factor": (0.8, 1.2), "right_radius_factor": (0.8, 1.2),
    "drive_friction_factor": (0, 20), "resistance_factor": (0.05, 20), "motor_constant_factor": (0.05, 20),
    "supply_factor": (0.05, 2), "tyre_friction_factor": (0.01, 3), "slope": (-0.5, 0.5),
    "left_drive_friction_factor": (0, 20), "right_drive_friction_factor": (0, 20),
    "left_motor_constant_factor": (0.05, 20), "right_resistance_factor": (0.05, 20),
}  # fmt: skip


@given(st.fixed_dictionaries({}, optional={name: st.floats(*bounds) for name, bounds in FIELDS.items()}))
@settings(max_examples=60)
def test_any_perturbation(values):
    """A random perturbation gives a valid robot, or is refused because the robot could not stand."""
    try:
        model = perturbed(**values)
    except InputError as error:
        assert "tip over" in str(error) or "below the ground" in str(error)
        return
    robot = read_robot(model, values.get("supply_factor", 1.0))
    assert isinstance(robot, Robot)
    sides = [values.get(f"{side}_drive_friction_factor", 1) for side in ("left", "right")]
    friction = values.get("drive_friction_factor", 1) * sum(sides) / 2
    assert robot.drive_loss == pytest.approx(friction * BASE.drive_loss, abs=1e-9)
    assert robot.rolling_coefficient == pytest.approx(BASE.rolling_coefficient)
