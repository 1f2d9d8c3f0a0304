"""Compiled models: parameters against the data sheet, perturbations, and the state of a standing robot."""

import math
import shutil

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mrctl.physics import mjcf
from mrctl.physics.files import models_folder
from mrctl.physics.parameters import read_robot
from mrctl.physics.perturb import fields, perturb, write
from mrctl.physics.stand import stand
from mrctl.record import InputError
from mrctl.theory.kinematics import scrub_free_angle
from mrctl.theory.perturbation import Perturbation
from mrctl.theory.robot import GRAVITY, Robot

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


def perturbed(**values) -> mujoco.MjModel:
    """Returns a perturbed copy of the nominal model."""
    model = mjcf.clone(NOMINAL)
    perturb(NOMINAL, model, Perturbation(**values))
    return model


def changes(**values) -> dict[str, float]:
    """Returns the parameters that a perturbation changes, as ratios to the nominal ones."""
    after, before = read_robot(perturbed(**values)).model_dump(), BASE.model_dump()
    return {name: after[name] / before[name] for name in before if not math.isclose(after[name], before[name])}


# --- reading --------------------------------------------------------------------------------------------------------


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


@pytest.mark.parametrize("world", ["flat", "slope", "rough", "patch"])
@pytest.mark.parametrize("steering", ["compliant", "caster", "rigid"])
def test_worlds(world, steering):
    """The robot is the same in every world; only trail, centre of mass and yaw inertia depend on the steering."""
    robot = read_robot(mjcf.load(world, steering)).model_dump()
    moved = {"trail", "com_offset", "yaw_inertia"} if steering == "rigid" else set()
    for name, value in BASE.model_dump().items():
        if name not in moved:
            assert robot[name] == pytest.approx(value, rel=1e-12), name
    assert robot["trail"] == (0 if steering == "rigid" else 0.03)


@pytest.mark.parametrize(
    ("steering", "stiffness", "damping"), [("compliant", 2, 0.1), ("caster", 0, 0.02), ("rigid", 40, 1)]
)
def test_steering(steering, stiffness, damping):
    """The fork's servo has the stiffness and damping of its arrangement, by the engine's torque."""
    model = mjcf.load("flat", steering)
    fork, servo = model.joint("steering"), model.actuator("steering")
    inputs = model.actuator_ctrladr[servo.id] + np.arange(2)
    for position, rate, torque in ((0.1, 0, 0.1 * stiffness), (0, 0.5, 0.5 * damping)):
        data = mujoco.MjData(model)
        data.ctrl[inputs] = position, rate
        mujoco.mj_forward(model, data)
        assert data.qfrc_actuator[fork.dofadr[0]] == pytest.approx(torque)
        data = mujoco.MjData(model)
        data.qpos[fork.qposadr[0]], data.qvel[fork.dofadr[0]] = -position, -rate
        mujoco.mj_forward(model, data)
        assert data.qfrc_actuator[fork.dofadr[0]] == pytest.approx(torque)


def test_digest(tmp_path):
    """A digest is the same for a copy of a world elsewhere, and differs with a bump, name, scale or time step."""
    for name in ("rough.xml", "rough.png", "car.xml", "scenery.xml"):
        shutil.copy(models_folder() / name, tmp_path / name)
    text, world = (tmp_path / "rough.xml").read_text(), tmp_path / "another.xml"
    found = [mjcf.digest(mjcf.load("rough")), mjcf.digest(mjcf.load("rough", timestep=5e-4))]
    for old, new in (
        ("0.03 0.05", "0.031 0.05"), ('"rough"', '"bumpy"'), ("<asset>", '<statistic meaninertia="2"/><asset>'),
    ):  # fmt: skip
        world.write_text(text.replace(old, new))
        found.append(mjcf.digest(mjcf.load(str(world))))
    assert len(set(found)) == 5
    assert mjcf.digest(mjcf.load(str(tmp_path / "rough.xml"))) == found[0]


def test_timestep():
    """The time step can be set."""
    assert NOMINAL.opt.timestep == 0.002
    assert mjcf.load("flat", timestep=0.001).opt.timestep == 0.001


# --- files ----------------------------------------------------------------------------------------------------------


@pytest.fixture
def folder(tmp_path):
    """Returns a copy of the shipped models, which a test may break."""
    return shutil.copytree(models_folder(), tmp_path / "models")


def broken(folder, old, new, file="car.xml"):
    """Returns the flat world with one passage of a file replaced."""
    text = (folder / file).read_text()
    assert old in text
    (folder / file).write_text(text.replace(old, new))
    return str(folder / "flat.xml")


def refuses(world, *words, steering="compliant"):
    """Checks that a world is refused with one line that names the file and has these words."""
    with pytest.raises(InputError) as error:
        mjcf.load(world, steering)
    message = str(error.value)
    assert "\n" not in message and "flat" in message
    for word in words:
        assert word in message, message


def test_found():
    """The shipped worlds come with the checkout."""
    assert {"car", "flat", "slope", "rough", "patch"} <= {path.stem for path in models_folder().glob("*.xml")}


def test_missing_file(tmp_path):
    """An unknown name and a missing path are refused; the message lists the shipped worlds."""
    for world in ("flatt", str(tmp_path / "flat.xml"), ""):
        with pytest.raises(InputError, match=r"^world: no file .*shipped worlds: flat, patch, rough, slope$"):
            mjcf.load(world)


def test_broken_xml(folder):
    """Files that are not XML, not MJCF, or miss an include are refused."""
    world = folder / "flat.xml"
    for text in (
        "<mujoco",
        "hello",
        "",
        "<robot/>",
        '<mujoco><include file="none.xml"/></mujoco>',
        "<mujoco><geom/></mujoco>",
    ):
        world.write_text(text)
        refuses(str(world))
    world.write_bytes(bytes(range(256)))
    refuses(str(world))


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('numeric name="limits"', 'numeric name="limitz"', ("numeric", "limits")),
        ('data="1.5 3 1.5 6"', 'data="1.5 3"', ("limits", "4 values")),
        ('numeric name="no_load_current"', 'numeric name="no_load"', ("numeric", "no_load_current")),
        ('joint name="front_wheel"', 'joint name="castor"', ("joint", "front_wheel")),
        ('motor_left"', 'motor_1"', ("actuator", "motor_left")),
        ('body name="fork"', 'body name="head"', ("body", "fork")),
        ('frictionloss="0.242462"', 'frictionloss="0.01"', ("frictionloss",)),
        ('ctrlrange="-24 24"', "", ("supply",)),
        ('pos="0.089884 0 0.025733"', 'pos="-0.2 0 0.025733"', ("com_offset",)),
        (
            '<pid name="steering" joint="steering" kp="2" kv="0.1"/>',
            '<position name="steering" joint="steering"/>',
            ("steering",),
        ),
        ('<dcmotor name="motor_left" class="motor"', '<motor name="motor_left"', ("motor_left", "dcmotor")),
    ],
)
def test_missing_element(folder, old, new, words):
    """A missing or wrong element is refused by its name."""
    refuses(broken(folder, old, new), *words)


def test_missing_steering(folder):
    """A steering arrangement that the file does not describe is refused when it is asked for."""
    world = broken(
        folder, '<numeric name="steering_rigid" data="40 1 0"/>', '<numeric name="steering_caster_" data="1"/>'
    )
    mjcf.load(world, "compliant")
    refuses(world, "steering_rigid", steering="rigid")
    refuses(broken(folder, 'data="0 0.02 0.03"', 'data="0 0.02"'), "steering_caster", "3 values", steering="caster")


def test_no_pair(folder):
    """A world without contact pairs is refused, as the robot would fall through the floor."""
    text = (folder / "flat.xml").read_text()
    (folder / "flat.xml").write_text(text[: text.index("<contact>")] + "</mujoco>")
    refuses(str(folder / "flat.xml"), "pair")


# --- perturbations --------------------------------------------------------------------------------------------------


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
        supply_factor=1.2, tyre_friction_factor=0.5, slope=0.1,
    )  # fmt: skip
    copied = mjcf.clone(NOMINAL)
    write(copied, fields(model))
    names = [n for n in dir(model) if not n.startswith("_") and isinstance(getattr(model, n), np.ndarray)]
    assert len(names) > 300
    for name in names:
        one, other = getattr(model, name), getattr(copied, name)
        assert np.array_equal(one, other, equal_nan=one.dtype.kind == "f"), name
    assert np.array_equal(model.opt.gravity, copied.opt.gravity)
    assert model.stat.meaninertia == copied.stat.meaninertia


@pytest.mark.parametrize(
    ("perturbation", "expected"),
    [
        ({"mass_factor": 1.5}, {"mass": 1.5, "yaw_inertia": 1.5, "wheel_inertia": 1.5, "front_wheel_inertia": 1.5}),
        ({"drive_friction_factor": 3.0}, {"no_load_current": 3.0, "gear_loss": 3.0}),
        ({"resistance_factor": 1.3}, {"resistance": 1.3}),
        ({"motor_constant_factor": 0.85}, {"torque_constant": 0.85, "no_load_current": 1 / 0.85}),
        ({"tyre_friction_factor": 0.5}, {"tyre_friction": 0.5}),
        ({"slope": 0.1}, {}),
        ({"control_delay": 0.02, "velocity_noise": 0.1}, {}),
    ],
)
def test_factor(perturbation, expected):
    """A perturbation changes the parameters it names and no others; the no-load torque is a loss."""
    assert changes(**perturbation) == pytest.approx(expected)


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
    """A stronger supply raises the motors' voltage range; a weaker one leaves it."""
    assert read_robot(NOMINAL, 0.8).drive_gain == 0.8
    assert read_robot(perturbed(supply_factor=0.8)).supply == 24
    assert read_robot(perturbed(supply_factor=1.25)).supply == pytest.approx(30)


FIELDS = {
    "mass_factor": (0.05, 20), "inertia_factor": (0.05, 20), "payload": (0, 200), "payload_x": (-1, 1),
    "payload_y": (-1, 1), "payload_z": (0, 1), "left_radius_factor": (0.8, 1.2), "right_radius_factor": (0.8, 1.2),
    "drive_friction_factor": (0, 20), "resistance_factor": (0.05, 20), "motor_constant_factor": (0.05, 20),
    "supply_factor": (0.01, 2), "tyre_friction_factor": (0.01, 3), "slope": (-0.5, 0.5),
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
    assert robot.drive_loss == pytest.approx(values.get("drive_friction_factor", 1) * BASE.drive_loss, abs=1e-9)
    assert robot.rolling_coefficient == pytest.approx(BASE.rolling_coefficient)


# --- inductance -----------------------------------------------------------------------------------------------------


@pytest.fixture
def inductive(folder):
    """Returns the flat world with motors of 0.24 mH."""
    return broken(folder, 'resistance="2.32"', 'resistance="2.32" inductance="2.4e-4 0"')


def test_inductance(inductive):
    """The inductance is read from the file, and does not change with the resistance."""
    nominal = mjcf.load(inductive)
    model = mjcf.clone(nominal)
    perturb(nominal, model, Perturbation(resistance_factor=1.5))
    for candidate, resistance in ((nominal, 2.32), (model, 3.48)):
        robot = read_robot(candidate)
        assert robot.inductance == pytest.approx(2.4e-4)
        assert robot.resistance == pytest.approx(resistance)


# --- standing -------------------------------------------------------------------------------------------------------

WHEELS = ("wheel_left", "wheel_right", "front_wheel")


def gaps(model, state):
    """Returns the signed distance of each wheel from the ground in m, from the engine's own collision."""
    loose = mjcf.clone(model)
    loose.pair_margin[:] = 0.1
    data = mujoco.MjData(loose)
    data.qpos[:] = state.qpos
    mujoco.mj_forward(loose, data)
    found = {wheel: np.inf for wheel in WHEELS}
    for contact in data.contact:
        for geom in contact.geom:
            name = loose.geom(geom).name
            if name in found:
                found[name] = min(found[name], contact.dist)
    return np.array(list(found.values()))


def heading(state):
    """Returns the heading of the body's x axis in rad."""
    frame = np.zeros(9)
    mujoco.mju_quat2Mat(frame, state.qpos[3:7])
    return math.atan2(frame[3], frame[0])


@pytest.mark.parametrize("radii", [(1.0, 1.0), (1.05, 0.97)])
@pytest.mark.parametrize("world", ["flat", "slope", "patch"])
@given(st.floats(-1.5, 1.5), st.floats(-1.5, 1.5), st.floats(-3.1, 3.1), st.floats(0.1, 1), st.floats(-1, 1))
@settings(max_examples=8)
def test_stands_on_planes(world, radii, x, y, theta, v, omega):
    """On a plane three wheels of any radii touch to a nanometre, at the requested pose."""
    nominal = WORLDS[world]
    model = mjcf.clone(nominal)
    perturb(nominal, model, Perturbation(left_radius_factor=radii[0], right_radius_factor=radii[1]))
    state = stand(model, np.array([x, y, theta]), np.array([v, omega]))
    assert gaps(model, state) == pytest.approx(0, abs=1e-9)
    assert tuple(state.qpos[:2]) == (x, y)
    assert math.remainder(heading(state) - theta, 2 * math.pi) == pytest.approx(0, abs=1e-9)


WORLDS = {world: mjcf.load(world) for world in ("flat", "slope", "rough", "patch")}


@given(st.floats(-3, 3), st.floats(-3, 3), st.floats(-3.1, 3.1))
@settings(max_examples=30)
def test_stands_on_bumps(x, y, theta):
    """On uneven ground no wheel penetrates, one touches, and the others are no higher than the bumps."""
    state = stand(WORLDS["rough"], np.array([x, y, theta]), np.array([0.5, 0.0]))
    gap = gaps(WORLDS["rough"], state)
    assert gap.min() > -1e-6 and gap.min() < 2e-3 and gap.max() < 0.01
    assert math.remainder(heading(state) - theta, 2 * math.pi) == pytest.approx(0, abs=1e-9)


@given(st.floats(0, 1.5), st.floats(-2, 2), st.floats(0.9, 1.1), st.floats(0.9, 1.1))
@settings(max_examples=30)
def test_rolls(v, omega, left, right):
    """The wheels have the rates of equation (1) with their own radii, and the front wheel does not scrub."""
    model = perturbed(left_radius_factor=left, right_radius_factor=right)
    state = stand(model, np.zeros(3), np.array([v, omega]))
    steering = state.qpos[model.joint("steering").qposadr[0]]
    free = float(scrub_free_angle(np.array([v, omega]), BASE))
    assert steering == pytest.approx(np.clip(free, -BASE.steering_limit, BASE.steering_limit))
    front = math.cos(steering) * v + BASE.wheelbase * math.sin(steering) * omega
    expected = ((v - 0.188 * omega) / (0.098 * left), (v + 0.188 * omega) / (0.098 * right), front / 0.075)
    for wheel, rate in zip(WHEELS, expected, strict=True):
        assert state.qvel[model.joint(wheel).dofadr[0]] == pytest.approx(rate, abs=1e-9)
    # No rear contact point slides along the body's x axis, by the engine's own Jacobian.
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = state
    mujoco.mj_forward(model, data)
    assert np.linalg.norm(data.qvel[:3]) == pytest.approx(v) and data.qvel[5] == omega
    for wheel in ("wheel_left", "wheel_right"):
        jacobian = np.zeros((3, model.nv))
        point = data.geom(wheel).xpos - model.geom(wheel).size[0] * data.body("chassis").xmat.reshape(3, 3)[:, 2]
        mujoco.mj_jac(model, data, jacobian, None, point, model.body(wheel).id)
        assert data.body("chassis").xmat.reshape(3, 3)[:, 0] @ jacobian @ data.qvel == pytest.approx(0, abs=1e-9)


def test_no_ground():
    """A pose beyond the edge of the height field is refused."""
    with pytest.raises(InputError, match=r"^initial_pose: there is no ground below \(20\.\d\d, "):
        stand(WORLDS["rough"], np.array([20.0, 0.0, 0.0]), np.zeros(2))
