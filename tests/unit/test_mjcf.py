"""Compiled worlds: robot and steering in each of them, digests, and files that are refused."""

import os
import shutil
from functools import partial

import mujoco
import numpy as np
import pytest

from mrctl import Circle, Scenario, per_lap, simulate
from mrctl.checks.command import examination
from mrctl.physics import files, mjcf
from mrctl.physics.files import SHIPPED, models_folder
from mrctl.physics.parameters import read_robot
from mrctl.record import InputError
from mrctl.sensing.tiers import Sensing
from mrctl.theory.robot import RobotFile

NOMINAL = mjcf.load()
BASE = read_robot(NOMINAL)


@pytest.mark.parametrize("world", ["flat", "slope", "rough", "patch"])
@pytest.mark.parametrize("steering", ["compliant", "caster", "rigid"])
def test_worlds(world, steering):
    """The robot is the same in every world; only trail, centre of mass and yaw inertia depend on the steering."""
    robot = read_robot(mjcf.load(world, steering)).model_dump()
    moved = {"trail", "com_offset", "yaw_inertia"} if steering == "rigid" else set()
    if steering != "compliant":
        moved |= {"steering_stiffness", "steering_damping", "fork_inertia", "fork_moment"}
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
    far = shutil.copytree(tmp_path, tmp_path / ("far" * 50))  # which the model's buffer has to hold
    assert mjcf.digest(mjcf.load(str(far / "rough.xml"))) == found[0]


@pytest.mark.parametrize("step", [0.002, 0.001, 0.0005, 0.00025])
def test_timestep(step):
    """In a circle the path leaves the heading by (d τ/2 − h/2) θ̇ of the file's τ and h, whatever the time step is."""
    assert NOMINAL.opt.timestep == 0.002
    assert mjcf.load("flat", timestep=step).opt.timestep == step
    circle = Scenario(
        sensing=Sensing(tier="ideal"), reference=Circle(radius=0.7, period=6), laps=1, prior="model", learner="none",
        initial_spread=(0, 0, 0), physics_step=step,
    )  # fmt: skip
    run = simulate(circle).isel(time=slice(200, None))
    x, y, theta = run.x.values, run.y.values, np.unwrap(run.theta.values)
    course = np.unwrap(np.arctan2(np.diff(y), np.diff(x)))
    slip = (theta[1:] + theta[:-1]) / 2 - course
    slip -= 2 * np.pi * np.round(slip / (2 * np.pi))
    path_slip = NOMINAL.pair_solimp[0, 1] * NOMINAL.pair_solreffriction[0, 0] / 2 - NOMINAL.opt.timestep / 2
    np.testing.assert_allclose(slip.mean() / (np.diff(theta).mean() / 0.01), path_slip, rtol=0.05)


def test_errors_converge():
    """Half the step moves the position error of 0.34 mm by 1 %; with the file's contacts it would move it by 55 %."""
    lap = Scenario(sensing=Sensing(tier="ideal"), laps=2, prior="model", learner="none", initial_spread=(0, 0, 0))
    usual, half = (per_lap(simulate(lap.replace(physics_step=h))).position_rmse[..., -1].item() for h in (0.002, 0.001))
    assert usual == pytest.approx(0.34e-3, rel=0.02) and half == pytest.approx(usual, rel=0.02)


@pytest.mark.parametrize(("own", "friction"), [((0.004, 1), (0, 0)), ((0.02, 1), (-100, -50)), ((0.01, 1), (0.003, 1))])
def test_timestep_of_any_contact(own, friction):
    """Without a solreffriction it is that of solref; damping that is given directly stays; none is below two steps."""
    model = mjcf.load()
    model.pair_solref[:], model.pair_solreffriction[:] = own, friction
    mjcf._set_timestep(model, 0.0001)
    expected = {-100: -100, 0: 0.004 - 0.0019 / 0.95, 0.003: 0.003 - 0.0019 / 0.95}[friction[0]]
    d = model.pair_solimp[0, 1]
    assert d == pytest.approx(0.95)
    np.testing.assert_allclose(model.pair_solreffriction[:, 0], max(expected, 0.0002) if expected > 0 else expected)
    np.testing.assert_array_equal(model.pair_solref[:, 0], own[0])
    mjcf._set_timestep(model, 1e-5)
    assert (model.pair_solreffriction[:, 0] > 0).all() or friction[0] < 0


@pytest.fixture
def folder(tmp_path):
    """Returns a copy of the shipped models, which a test may break."""
    return shutil.copytree(models_folder(), tmp_path / "models")


@pytest.mark.parametrize("robot", SHIPPED)
def test_compiled_once(folder, monkeypatch, robot):
    """A shipped model is compiled once, and a caller who changes it changes no other; other files are, each time."""
    robot, assembled = RobotFile(path=robot), []
    elsewhere = shutil.copytree(folder, folder.with_name("elsewhere"))
    monkeypatch.setattr(files, "models_folder", lambda: folder)
    monkeypatch.setattr(mjcf, "_assembled", lambda *p, of=mjcf._assembled: assembled.append(p) or of(*p))
    build = partial(mjcf.build, steering=mjcf.arrangement(robot), timestep=1e-3, robot=robot)
    assembled.clear()
    model, nominal = build("rough")
    digest = mjcf.digest(model)
    model.body_mass *= 2
    model.numeric("limits").data[:] = 0
    again, same = build("rough")
    assert mjcf.digest(again) == digest != mjcf.digest(model) and same == nominal == read_robot(again)
    assert mjcf.load("rough", robot=robot).opt.timestep == 0.002
    assert len(assembled) <= 2  # with the steering by its name, and as the default
    assembled.clear()
    for world in ("rough", "rough.xml"):
        assert all(mjcf.digest(build(str(elsewhere / world))[0]) == digest for _ in range(2))
    assert len(assembled) == 4


@pytest.mark.parametrize("shipped", [True, False])
def test_changed_file(folder, monkeypatch, shipped):
    """A model is that of its files as they are, even if size and times of a file stay; it warns each time."""
    if shipped:
        monkeypatch.setattr(files, "models_folder", lambda: folder)
    world, robot = ("flat", "racecar") if shipped else (str(folder / "flat.xml"), str(folder / "racecar.xml"))

    def change(file, old, new):
        path = folder / file
        text, found = path.read_text(), path.stat()
        assert old in text
        path.write_text(text.replace(old, new))
        os.utime(path, ns=(found.st_atime_ns, found.st_mtime_ns))

    masses = [mjcf.build(world, robot=RobotFile(path=robot))[1].mass]
    change("racecar.xml", 'mass="3.26"', 'mass="3.76"')
    masses.append(mjcf.build(world, robot=RobotFile(path=robot))[1].mass)
    assert np.diff(masses) == pytest.approx(0.5)
    steps = [mjcf.load(world).opt.timestep]
    change("car.xml", 'timestep="0.002"', 'timestep="0.001"')
    steps.append(mjcf.load(world).opt.timestep)
    assert steps == [0.002, 0.001]
    change("car.xml", "<compiler ", '<compiler settotalmass="20" ')
    for _ in range(2):
        with pytest.warns(UserWarning, match="settotalmass"):
            mjcf.load(world)


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


def test_latin_1(folder):
    """MuJoCo reads a world in any encoding, and so does a robot that drives in it."""
    world = folder / "flat.xml"
    world.write_bytes("<!-- café -->\n".encode("latin-1") + world.read_bytes())
    assert mjcf.load(str(world), robot=RobotFile(path="turtlebot")).nu == 2


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
    line = f"^{folder / 'flat.xml'}: no contact pair between the wheels and a floor$"
    with pytest.raises(InputError, match=line):
        mjcf.load(str(folder / "flat.xml"), robot=RobotFile(path="turtlebot"))
    with pytest.raises(InputError, match=line):
        examination(str(folder / "flat.xml"))


def test_floor_without_pairs(folder):
    """A geom of a world that the wheels pass through is named, unless it is decoration; pairs are found either way."""
    text = (folder / "flat.xml").read_text()
    bump = '<geom name="bump" type="box" size="0.3 0.3 0.005"/>'
    look = bump.replace("bump", "look").replace("/>", ' contype="0" conaffinity="0"/>')
    kerb = f'<body name="fixed">{bump.replace("bump", "kerb")}</body>'
    (folder / "flat.xml").write_text(text.replace("<worldbody>", f"<worldbody>{bump}{kerb}{look}"))
    for robot in (RobotFile(), RobotFile(path="turtlebot")):
        with pytest.warns(
            UserWarning, match="no contact pair with the wheels, which pass through: bump, kerb; give"
        ) as said:
            mjcf.load(str(folder / "flat.xml"), robot=robot)
        assert len(said) == 1
    world = folder / "flat.xml"
    world.write_text(
        text.replace('name="tyre_left" geom1="floor" geom2="wheel_left"', 'geom1="wheel_left" geom2="floor"')
    )
    turtlebot = [mjcf.load(path, robot=RobotFile(path="turtlebot")) for path in ("flat", str(world))]
    assert np.array_equal(*(model.pair_friction for model in turtlebot))
