"""A robot adopted from another MJCF file is the same whatever the file calls its parts and wherever it puts them."""

import re

import mujoco
import numpy as np
import pytest

import mrctl
from mrctl import InputError, Perturbation, Robot, RobotFile, cli
from mrctl.loop.simulation import Simulation
from mrctl.navigation.mission import navigate
from mrctl.navigation.tasks import task_of
from mrctl.physics import mjcf
from mrctl.physics.elements import fronts, has
from mrctl.physics.files import models_folder
from mrctl.physics.hull import footprint
from mrctl.physics.parameters import read_robot
from mrctl.physics.perturb import perturb
from mrctl.physics.plant import build
from mrctl.physics.readout import READING
from mrctl.physics.stand import front_rates, stand, steer

MOTOR = '<dcmotor name="{0}" joint="{0}" gear="{1}" motorconst="0.02 0.02" resistance="2" ctrlrange="-12 12" {2}/>'
FLOOR = '<light pos="0 0 3"/><geom name="floor" type="plane" size="5 5 .1"/>'


def wheel(joint, at, axis="0 1 0", extra="", loss=0.1):
    """Returns a wheel with its joint: a solid cylinder of radius 0.1 m, width 0.04 m and 2 kg."""
    return f"""<body pos="{at}">
      <joint name="{joint}" axis="{axis}" frictionloss="{loss}"/>
      <geom type="cylinder" size="0.1 0.02" euler="90 0 0" mass="2" friction="0.8"/>{extra}
    </body>"""


def document(body, actuators, pose='pos="0 0 0.1"', extra="", compiler='angle="degree"'):
    return f"""<mujoco><compiler {compiler}/>{extra}
      <worldbody>{FLOOR}<body name="base" {pose}>{body}</body></worldbody>
      <actuator>{actuators}</actuator></mujoco>"""


BOX = '<geom type="box" size="0.2 0.1 0.05" pos="{} 0 0.03" mass="10"/>'
BALL = '<geom name="ball" type="sphere" size="0.04" pos="{} 0 -0.06" mass="0"/>'
DIFF = "<freejoint/>" + BOX.format(0.1) + BALL.format(0.3) + wheel("a", "0 0.2 0") + wheel("b", "0 -0.2 0")
MOTORS = MOTOR.format("a", 30, "") + MOTOR.format("b", 30, "")
KNUCKLE = """<body pos="{1}"><joint name="{0}" axis="0 0 1" range="-30 30"/>
  <geom type="sphere" size="0.01" mass="0.1"/>{2}</body>"""
SERVO = '<position joint="{}" kp="8" kv="0.4"/>'
CAR = (
    "<freejoint/>" + BOX.format(0.15) + wheel("a", "0 0.2 0") + wheel("b", "0 -0.2 0")
    + KNUCKLE.format("s1", "0.5 0.2 0", wheel("c", "0 0 0", loss=0.02))
    + KNUCKLE.format("s2", "0.5 -0.2 0", wheel("d", "0 0 0", loss=0.02))
)  # fmt: skip
TENDONS = """<tendon><fixed name="turn" {}><joint joint="a" coef="-0.5"/><joint joint="b" coef="0.5"/></fixed>
  <fixed><joint joint="a" coef="0.5"/><joint joint="b" coef="0.5"/></fixed></tendon>"""
TRICYCLE = (
    "<freejoint/>" + BOX.format(0.15) + wheel("a", "0 0.2 0") + wheel("b", "0 -0.2 0")
    + KNUCKLE.format("s1", "0.5 0 0", wheel("c", "0 0 0", loss=0.02))
)  # fmt: skip


@pytest.fixture
def file(tmp_path):
    def write(text):
        path = tmp_path / "mine.xml"
        path.write_text(text)
        return str(path)

    return write


def read(path, **names):
    robot = mrctl.load_robot(path, **names)
    model = mjcf.load("flat", mjcf.arrangement(robot), robot=robot)
    return read_robot(model), model


def test_by_hand(file):
    """Every parameter of a box with two solid wheels and a massless caster is that of its file."""
    robot, model = read(file(document(DIFF, MOTORS)))
    spin, yaw = 2 * 0.1**2 / 2, 10 * (0.4**2 + 0.2**2) / 12 + 10 * (0.1 - 10 * 0.1 / 14) ** 2
    across = 2 * (0.1**2 / 4 + 0.04**2 / 12)
    yaw += 2 * (across + 2 * (0.2**2 + (10 * 0.1 / 14) ** 2))
    expected = {
        "mass": 14, "yaw_inertia": yaw, "com_offset": 10 * 0.1 / 14, "com_height": 0.1 + 10 * 0.03 / 14,
        "wheel_radius": 0.1, "front_wheel_radius": 0.04, "half_track": 0.2, "wheelbase": 0.3, "trail": 0,
        "steering_limit": np.pi / 2, "resistance": 2, "torque_constant": 0.02, "gear_ratio": 30, "supply": 12,
        "wheel_inertia": spin, "front_wheel_inertia": 0, "gear_loss": 0.1, "rolling_coefficient": 0,
        "tyre_friction": 0.8,
    }  # fmt: skip
    for name, value in expected.items():
        assert getattr(robot, name) == pytest.approx(value, rel=1e-6, abs=1e-12), name
    assert mjcf.steerings(model) == ("caster",) and mjcf.reverses(model, "caster")


def mirrored(body):
    return body.replace('axis="0 1 0"', 'axis="0 -1 0"')


ELSEWHERE = 'pos="3 -2 0.1" euler="0 0 70"'
VARIANTS = {
    "elsewhere": document(DIFF, MOTORS, ELSEWHERE),
    "wheels turn backwards": document(mirrored(DIFF), MOTORS),
    "a motor is mirrored": document(DIFF, MOTOR.format("a", -30, "") + MOTOR.format("b", 30, "")),
    "right before left": document(DIFF, MOTOR.format("b", 30, "") + MOTOR.format("a", 30, "")),
    "origin elsewhere": document(
        f'<freejoint/><frame pos="0.1 0.3 0.4" euler="0 0 30">{DIFF.removeprefix("<freejoint/>")}</frame>', MOTORS,
        'pos="0 0 -0.3" euler="0 0 -30"'),
    "radian": document(
        DIFF.replace('euler="90 0 0"', 'euler="1.5707963267949 0 0"'), MOTORS, compiler='angle="radian"'),
    "joints in the middle": document(
        re.sub('<body pos="(0 -?0.2 0)">(.*?)euler', r'<body>\2pos="\1" euler', DIFF, flags=re.DOTALL),
        MOTOR.format("b", 30, "") + MOTOR.format("a", 30, "")),
    "a joint beside its wheel": document(
        DIFF.replace('pos="0 0.2 0"', 'pos="0 0.1 0"').replace('euler="90 0 0"', 'euler="90 0 0" pos="0 0.1 0"', 1),
        MOTORS),
    "welded to the world": document(DIFF.removeprefix("<freejoint/>"), MOTORS),
    "names of ours": document(DIFF, MOTORS).replace('"ball"', '"chassis"'),
    "sensors and keys": document(
        DIFF, MOTORS, extra='<sensor><jointpos joint="a"/></sensor><keyframe><key time="1"/></keyframe>'),
}  # fmt: skip


@pytest.mark.parametrize("name", VARIANTS)
def test_the_same_robot(file, name):
    """The same robot written in different ways has the same parameters, and voltages drive it along the same path."""
    ideal, plain = read(file(document(DIFF, MOTORS)))
    robot, model = read(file(VARIANTS[name]))
    assert robot.model_dump() == pytest.approx(ideal.model_dump(), rel=1e-6, abs=1e-9)
    ends = [drive(m, r, (5.0, 6.0)) for m, r in ((plain, ideal), (model, robot))]
    for signal in READING.names:
        np.testing.assert_allclose(ends[0][signal], ends[1][signal], atol=1e-6, err_msg=signal)
    v, omega = ends[1]["twist"]
    assert v > 0.2 and omega > 0.05  # ahead, and to the left


STATED = '<inertial pos="0.02 0 0" mass="3" diaginertia="0.02 0.03 0.02"/>'
WEIGHED = DIFF.replace("<freejoint/>", "<freejoint/>" + STATED).replace('loss="0.1"/>', 'loss="0.1"/>' + STATED)
MAST = '<body pos="0 0 0.2"><geom type="box" size="0.02 0.02 0.1"/></body>'


@pytest.mark.parametrize(
    "setting",
    ['inertiafromgeom="true"', 'inertiafromgeom="false"', 'settotalmass="30"', 'inertiagrouprange="0 0"', ""],
)
@pytest.mark.filterwarnings("ignore:compiler attribute 'settotalmass'")
def test_mass_by_mujoco(file, setting):
    """Mass, centre of mass and yaw inertia are those that MuJoCo gives the file, whatever its compiler counts."""
    text = document(WEIGHED + MAST, MOTORS, compiler=f'angle="degree" {setting}')
    own = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(own)
    mujoco.mj_forward(own, data)
    centre, inertia = data.subtree_com[1], 0.0
    for body in range(1, own.nbody):
        turned, off = data.ximat[body].reshape(3, 3)[2] ** 2, (data.xipos[body] - centre)[:2]
        inertia += turned @ own.body_inertia[body] + own.body_mass[body] * off @ off
    robot, _ = read(file(text))
    expected = own.body_subtreemass[1], inertia, centre[0], centre[2]
    found = robot.mass, robot.yaw_inertia, robot.com_offset, robot.com_height
    assert found == pytest.approx(expected, rel=1e-6)


def drive(model, robot, volts, steering=0.0, seconds=3.0, twist=(0.0, 0.0)):
    """Returns the readings of a robot that starts at the origin, after some seconds of constant voltages in V."""
    plant = build([model], robot, 5)
    plant.reset(np.zeros((1, 3)), np.array([twist]))
    for _ in range(round(100 * seconds)):
        plant.step(np.array([[*volts, steering, 0.0]]))
    assert not plant.stopped.any(), plant.failure
    return plant.reading[0].copy()


def test_caster_behind(file):
    """A caster behind the axle has a negative wheelbase, with the centre of mass on its side."""
    body = DIFF.replace('pos="0.1 0 0.03"', 'pos="-0.1 0 0.03"').replace('pos="0.3 0 -0.06"', 'pos="-0.3 0 -0.06"')
    robot, model = read(file(document(body, MOTORS)))
    assert robot.wheelbase == pytest.approx(-0.3) and robot.com_offset == pytest.approx(-10 * 0.1 / 14)
    assert robot.front_load == pytest.approx(10 * 0.1 / 14 / 0.3)
    plant = build([model], robot, 5)
    plant.reset(np.zeros((1, 3)), np.zeros((1, 2)))
    for _ in range(100):
        plant.step(np.zeros((1, 4)))
    assert abs(plant.reading["twist"][0, 0]) < 1e-5 and plant.reading["upright"][0] > 0.9999  # stands level


def test_casters_ahead_and_behind(file):
    """They are refused with a remedy, which gives the robot that has the one on the side of its load alone."""
    other = BALL.format(-0.3).replace("ball", "other")
    with pytest.raises(InputError, match='both behind, not .* give the others contype="0" conaffinity="0"'):
        read(file(document(DIFF + other, MOTORS)))
    mended = read(file(document(DIFF + other.replace("/>", ' contype="0" conaffinity="0"/>'), MOTORS)))[0]
    assert mended == read(file(document(DIFF, MOTORS)))[0]


@pytest.mark.parametrize("body", [CAR, TRICYCLE], ids=["two wheels", "one wheel"])
def test_steered(file, body):
    """With an electronic differential the robot drives a circle of radius L/tan φ; the inner wheel turns farther."""
    servos = SERVO.format("s1") + (SERVO.format("s2") if "s2" in body else "")
    robot, model = read(file(document(body, MOTORS + servos)))
    assert mjcf.steerings(model) == ("rigid",) and robot.wheelbase == 0.5 and robot.trail == 0
    inner = np.radians(30)
    limit = np.arctan(0.5 / (0.5 / np.tan(inner) + 0.2)) if body is CAR else inner
    assert robot.steering_limit == pytest.approx(limit)
    phi = 0.3
    omega = 0.4 * np.tan(phi) / 0.5
    differential = robot.back_emf * robot.half_track * omega / robot.wheel_radius
    v, omega = drive(model, robot, (5 - differential, 5 + differential), phi, 4.0, (0.4, omega))["twist"]
    assert v / omega == pytest.approx(0.5 / np.tan(phi), rel=0.01)
    if body is CAR:
        qpos = np.zeros(model.nq)
        steer(model, qpos, phi)
        left, right = (qpos[model.joint(f"steering_front_{s}").qposadr[0]] for s in ("left", "right"))
        assert 1 / np.tan(right) - 1 / np.tan(left) == pytest.approx(0.4 / 0.5, rel=2e-3) and left > phi > right


@pytest.mark.parametrize("radius", [0.1, 0.104])
def test_look_of_a_wheel(file, radius):
    """Radius and friction of a wheel are those of the geom that collides, not those of one for the eye before it."""
    look = f'<geom type="cylinder" size="{radius} 0.02" euler="90 0 0" mass="0" contype="0" conaffinity="0"/>'
    dressed = re.sub('(<joint name="[ab]".*>)', r"\1" + look, DIFF)
    assert dressed.count("contype") == 2
    assert read(file(document(dressed, MOTORS)))[0] == read(file(document(DIFF, MOTORS)))[0]


def test_mirrored_steering(file):
    """A steering axis that points down, with mirrored range, zero and spring, is the same one: the paths are equal."""
    up = 'axis="0 0 1" range="-20 30" ref="10" springref="4" stiffness="1"'
    down = 'axis="0 0 -1" range="-30 20" ref="-10" springref="-4" stiffness="1"'
    poses = []
    for joint in (up, down):
        body = TRICYCLE.replace('axis="0 0 1" range="-30 30"', joint)
        robot, model = read(file(document(body, MOTORS + SERVO.format("s1"))))
        poses.append(drive(model, robot, (5.0, 5.0))["pose"])
    np.testing.assert_allclose(*poses, atol=1e-9)


@pytest.mark.parametrize("body", [CAR, TRICYCLE], ids=["two wheels", "one wheel"])
def test_steering_that_counts_from_elsewhere(file, body):
    """A joint that calls straight on 10° is the same one as without: so are the limit and, at 0, the straight path."""
    servos = SERVO.format("s1") + (SERVO.format("s2") if "s2" in body else "")
    plain, shifted = (f'range="{r}" stiffness="1"' for r in ("-20 30", '-10 40" ref="10" springref="10'))
    (robot, model), (same, other) = (
        read(file(document(body.replace('range="-30 30"', joint), MOTORS + servos))) for joint in (plain, shifted)
    )
    assert same == robot and 0 < robot.steering_limit <= np.radians(20)
    np.testing.assert_array_equal(*(drive(one, robot, (5.0, 5.0), 0.1)["pose"] for one in (model, other)))


def test_geared_servo(file):
    """A servo behind a gear is as stiff, and as strong, at the steered joint as in its own file."""
    text = document(TRICYCLE, MOTORS + SERVO.format("s1").replace("/>", ' gear="-3" forcerange="-0.5 0.5"/>'))
    robot, model = read(file(text))
    own = mujoco.MjModel.from_xml_string(text)
    data, dof = mujoco.MjData(own), own.joint("s1").dofadr[0]
    data.qpos[own.joint("s1").qposadr[0]] = angle = 0.01
    mujoco.mj_forward(own, data)
    assert robot.steering_stiffness == pytest.approx(-data.qfrc_actuator[dof] / angle)
    data.ctrl[own.actuator_ctrladr[2]] = 10.0
    mujoco.mj_forward(own, data)
    strongest = abs(data.qfrc_actuator[dof])
    data = mujoco.MjData(model)
    data.ctrl[model.actuator_ctrladr[model.actuator("steering").id]] = 10.0
    mujoco.mj_forward(model, data)
    assert data.qfrc_actuator[model.joint("steering").dofadr[0]] == pytest.approx(strongest)


PAN = """<body pos="0.1 0 0.1"><joint name="pan" axis="0 0 1"/><geom size="0.02" mass="0.1"/>
  <body><joint name="tilt" axis="0 1 0"/><geom type="box" size="0.01 0.01 0.01" mass="0.05"/></body></body>"""


@pytest.mark.parametrize(("body", "servos", "steered"), [(DIFF, "", ()), (TRICYCLE, SERVO.format("s1"), ("s1",))])
def test_camera_that_pans(file, body, servos, steered):
    """An upright joint with a servo that carries a camera steers nothing."""
    text = document(body + PAN, MOTORS + servos + SERVO.format("pan"))
    found, model = read(file(text))
    assert found == read(file(text), steering=steered)[0] and has(model, "joint", "robot/pan")


def test_camera_that_looks_at_a_body(file):
    """A camera of the robot may look at a body that gets another name."""
    camera = '<camera pos="-1 0 1" mode="targetbody" target="base"/>'
    _, model = read(file(document(DIFF + camera, MOTORS)))
    assert model.cam_targetbodyid.tolist() == [model.body("chassis").id]


def test_idle_tendons(file):
    """Tendons over the wheels that nothing pulls, as those of MuJoCo's sample car, change nothing."""
    own, without = (read(file(document(DIFF, MOTORS, extra=extra))) for extra in (TENDONS.format(""), ""))
    assert own[0] == without[0] and (own[1].ntendon, own[1].nv) == (0, without[1].nv)


def test_linkage_with_one_servo(file):
    """Of two steered wheels that an equality couples, one servo steers both."""
    couple = '<equality><joint joint1="s2" joint2="s1"/></equality>'
    coupled, model = read(file(document(CAR, MOTORS + SERVO.format("s1"), extra=couple)))
    own, _ = read(file(document(CAR, MOTORS + SERVO.format("s1") + SERVO.format("s2"))))
    assert fronts(model) == ["front_left", "front_right"]
    assert coupled.steering_stiffness == pytest.approx(8) and own.steering_stiffness == pytest.approx(16)
    same = {"steering_stiffness": 0, "steering_damping": 0, "fork_inertia": 0}  # the rack's inertia follows the servo's
    assert coupled.replace(**same) == own.replace(**same)


def test_front_rates(file):
    """Steered wheels roll at rates proportional to their distances from the turning point."""
    robot, model = read(file(document(CAR, MOTORS + SERVO.format("s1") + SERVO.format("s2"))))
    phi, v = 0.25, 0.6
    turn = 0.5 / np.tan(phi)
    rates = front_rates(model, robot, np.array(v), np.array(v / turn), np.array(phi))
    for name, y in (("front_left", 0.2), ("front_right", -0.2)):
        assert rates[name] == pytest.approx(v / turn * np.hypot(turn - y, 0.5) / 0.1, rel=1e-3)


def test_copy_of_the_default_robot(file):
    """A copy of the default robot's file is that robot, bit for bit, in every world and arrangement, until edited."""
    text = (models_folder() / "car.xml").read_text()
    copy = mrctl.load_robot(file(text))
    for world in ("flat", "slope", "rough", "patch"):
        for steering in ("compliant", "caster", "rigid"):
            assert mjcf.digest(mjcf.load(world, steering, robot=copy)) == mjcf.digest(mjcf.load(world, steering))
    file(text.replace('mass="17.2"', 'mass="27.2"'))
    heavy, own = (mjcf.build(robot=robot)[1] for robot in (copy, RobotFile()))
    assert heavy.mass == pytest.approx(own.mass + 10) and heavy.steering_stiffness == own.steering_stiffness > 0


@pytest.mark.parametrize("world", ["flat", "rough"])
def test_copy_with_files_of_its_own(tmp_path, world):
    """What a copy of the default robot's file includes, and its meshes, lie beside it, and not beside the world."""
    text = (models_folder() / "car.xml").read_text()
    looks = text[text.index("<asset>") : text.index("</asset>") + len("</asset>")]
    (tmp_path / "meshes").mkdir()
    places = [f"v {x} {y} {z}" for x in (0, 0.1) for y in (0, 0.1) for z in (0, 0.1)]
    (tmp_path / "meshes" / "deck.obj").write_text("\n".join([*places, "f 1 2 3", "f 6 5 8", "f 4 7 2"]))
    meshes = looks.replace("<asset>", '<asset><mesh file="deck.obj"/>')
    (tmp_path / "looks.xml").write_text(f"<mujoco>{meshes}</mujoco>")
    text = text.replace(looks, '<include file="looks.xml"/>').replace("<compiler ", '<compiler meshdir="meshes" ')
    text = text.replace('<site name="imu"', '<geom type="mesh" mesh="deck" pos="0 0 0.1"/><site name="imu"')
    (tmp_path / "mine.xml").write_text(text)
    model = mjcf.load(world, robot=mrctl.load_robot(tmp_path / "mine.xml"))
    assert model.nmesh == 1 and read_robot(model) == read_robot(mjcf.load(world))


def test_file_that_includes_the_default_robot(tmp_path):
    """What a file adds to a file called car.xml that it includes is there, and so is what that one has."""
    (tmp_path / "car.xml").write_text((models_folder() / "car.xml").read_text().replace('mass="17.2"', 'mass="27.2"'))
    bigger = '<mujoco><include file="{}"/><custom><numeric name="mine" data="1"/></custom></mujoco>'
    for name in ("car.xml", tmp_path / "car.xml"):
        (tmp_path / "mine.xml").write_text(bigger.format(name))
        model, robot = mjcf.build(robot=mrctl.load_robot(tmp_path / "mine.xml"))
        assert has(model, "numeric", "mine") and robot.mass == pytest.approx(mjcf.build()[1].mass + 10)


def test_nested_includes(tmp_path):
    """Quotes of either kind, a file beside the one that includes it, and a comment that names the file itself."""
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "inner.xml").write_text('<mujoco><custom><numeric name="mine" data="1"/></custom></mujoco>')
    (tmp_path / "parts" / "outer.xml").write_text("<mujoco><include file='inner.xml'/></mujoco>")
    text = (models_folder() / "car.xml").read_text()
    includes = '<!-- <include file="mine.xml"/> --><include file = "parts/outer.xml"/></mujoco>'
    (tmp_path / "mine.xml").write_text(text.replace("</mujoco>", includes))
    assert has(mjcf.build(robot=mrctl.load_robot(tmp_path / "mine.xml"))[0], "numeric", "mine")


@pytest.mark.parametrize(("name", "steering"), [("turtlebot", "caster"), ("racecar", "rigid"), ("car", "compliant")])
def test_robot_brings_its_steering(name, steering):
    """A scenario that names a robot and no steering drives with that robot's, and its result says which."""
    slow = mrctl.Circle(radius=1.5, period=30.0)
    simulation = Simulation([mrctl.Scenario(robot=RobotFile(path=name), reference=slow)])
    assert simulation.scenarios[0].steering == steering


@pytest.mark.parametrize(("name", "limit"), [("turtlebot", "max_speed"), ("racecar", "steering_limit")])
def test_refused_reference_says_what_would_do(name, limit):
    """The refusal of the default reference names a size and a period with which the robot can follow, and it can."""
    scenario = mrctl.Scenario(robot=RobotFile(path=name))
    with pytest.raises(InputError, match=limit) as refusal:
        Simulation([scenario])
    found = re.search(r"; size (\S+) m with period (\S+) s would do", str(refusal.value))
    assert found
    Simulation([scenario.replace(reference=mrctl.Lemniscate(size=float(found[1]), period=float(found[2])))])


def test_caster_that_swivels_on_a_joint_without_a_name(file):
    """Joints need no names but those of the driven wheels, and a caster may swivel and roll."""
    fork = """<body pos="0.3 0 -0.02"><joint axis="0 0 1"/><geom type="sphere" size="0.01" mass="0.1"/>
      <body pos="-0.02 0 -0.04"><joint axis="0 1 0"/><geom type="sphere" size="0.04" mass="0.1"/></body></body>"""
    _, model = read(file(document(DIFF.replace(BALL.format(0.3), fork), MOTORS)))
    assert mjcf.steerings(model) == ("caster",) and fronts(model) == ["caster_left"]


def test_default_robot_adopted(file):
    """The default robot, adopted from a file of other names, has its parameters but the tyres' friction."""
    text = (models_folder() / "car.xml").read_text().replace("steering_rigid", "another")
    robot = mrctl.load_robot(file(text))
    found = read_robot(mjcf.load("flat", "rigid", robot=robot))
    own = read_robot(mjcf.load("flat"))
    different = {n for n in Robot.model_fields if getattr(found, n) != pytest.approx(getattr(own, n), rel=1e-9)}
    assert different == {"tyre_friction"}  # which the world says, not the robot's file


@pytest.mark.parametrize("world", ["flat", "slope", "rough", "patch"])
@pytest.mark.parametrize("name", ["turtlebot", "racecar"])
def test_every_world(name, world):
    """Adopted robots stand on all their wheels in every world, and roll."""
    robot = RobotFile(path=name)
    model = mjcf.load(world, mjcf.arrangement(robot), robot=robot)
    expected = read_robot(mjcf.load("flat", mjcf.arrangement(robot), robot=robot))
    assert read_robot(model).model_dump() == pytest.approx(expected.model_dump(), rel=1e-9)
    state = stand(model, np.array([-2.0, 0.3, 0.4]), np.array([0.3, 0.0]))
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = state
    start = data.qpos[:3].copy()
    mujoco.mj_step(model, data, 50)
    touching = {model.geom(g).name for pair in data.contact.geom for g in pair} - {"floor"}
    assert np.abs(data.qpos[:3] - start).max() < 0.1  # rolled on a little, and did not fall
    if world != "rough":
        assert {"wheel_left", "wheel_right", *fronts(model)} <= touching


def test_slippery_in_proportion():
    """The friction on the icy patch falls by the same factor for the tyres of an adopted robot."""
    model = mjcf.load("patch", "rigid", robot=RobotFile(path="racecar"))
    friction = {model.pair(p).name: model.pair_friction[p, 0] for p in range(model.npair)}
    assert friction["tyre_left"] == pytest.approx(1.0489) and friction["ice_left"] == pytest.approx(1.0489 / 9)


def test_published():
    """The TurtleBot and the racing car have the numbers of their published sources."""
    turtle, _ = read("turtlebot")
    assert (turtle.mass, turtle.wheel_radius, 2 * turtle.half_track) == pytest.approx((6.3, 0.035, 0.23))
    # Kobuki: 0.7 m/s at most; no-load speed of the motor 9960 rpm ± 15 %, 6545/132.
    no_load = (12 - turtle.no_load_current * turtle.resistance) / turtle.torque_constant
    assert no_load * 60 / 2 / np.pi == pytest.approx(9960, rel=0.15)
    car, model = read("racecar")
    assert (car.mass, car.yaw_inertia, car.com_offset) == pytest.approx((3.74, 0.04712, 0.17145), rel=1e-3)
    assert (car.com_height, car.wheelbase, car.steering_limit) == pytest.approx((0.074, 0.3302, 0.4189), rel=1e-3)
    assert model.opt.timestep == 0.002


def test_limits(file):
    """The limits derived for a robot without a numeric `limits` are near the default robot's own."""
    text = (models_folder() / "car.xml").read_text().replace('<numeric name="limits" data="1.5 3 1.5 6"/>', "")
    robot, _ = read(file(text))
    found = robot.max_speed, robot.max_rotation, robot.max_acceleration, robot.max_rotation_acceleration
    assert found == pytest.approx((1.5, 3, 1.5, 6), rel=0.2)


def test_limits_keep_the_caster_down(file):
    """With its load nearly over the axle a robot gets half of the acceleration that lifts its caster, and drives."""
    text = (models_folder() / "turtlebot.xml").read_text()
    text = re.sub(r'<numeric name="limits"[^>]*>', "", text).replace('pos="0.0312 0 0.105"', 'pos="0.005 0 0.105"')
    source = file(text)
    robot, _ = read(source)
    lifting, course = 9.81 * robot.com_offset / robot.com_height, mrctl.Line(length=1.0, speed=0.3)
    assert robot.max_acceleration == pytest.approx(lifting / 2) and lifting < 0.1 * robot.tyre_friction * 9.81
    assert not mrctl.simulate(mrctl.Scenario(robot=source, reference=course, laps=1, learner="none"))["failed"]


def test_limits_within_the_grip_of_the_driven_wheels(file):
    """Derived limits ask no more of the driven tyres than their share of the loads that MuJoCo finds at rest."""
    boxes = "<freejoint/>" + BOX.format(0.24).replace('mass="10"', 'mass="60"') + BALL.format(0.3)
    strong = MOTORS.replace('resistance="2"', 'resistance="0.3"')
    text = document(boxes + wheel("a", "0 0.2 0") + wheel("b", "0 -0.2 0"), strong)
    robot, model = read(file(text))
    data = mujoco.MjData(model)
    while data.time < 1:
        mujoco.mj_step(model, data)
    driven = {model.body(name).id for name in ("wheel_left", "wheel_right")}
    load, force = 0.0, np.zeros(6)
    for k, contact in enumerate(data.contact[: data.ncon]):
        if driven & set(model.geom_bodyid[contact.geom]):
            mujoco.mj_contactForce(model, data, k, force)
            load += force[0]
    assert load == pytest.approx((1 - robot.front_load) * robot.mass * 9.81, rel=0.01) and load < 0.4 * 64 * 9.81
    assert robot.max_acceleration == pytest.approx(0.5 * robot.tyre_friction * load / robot.mass, rel=0.01)
    # on the spot at both limits: the yaw moment from the two tyres, and across them the force on the centre of mass
    inertia = robot.yaw_inertia + robot.mass * robot.com_offset**2
    along = inertia * robot.max_rotation_acceleration / robot.half_track
    along += robot.mass * robot.com_offset * robot.max_rotation**2
    across = robot.mass * robot.com_offset * robot.max_rotation_acceleration
    assert np.hypot(along, across) <= 0.5 * robot.tyre_friction * load * 1.01


def test_perturbed(file):
    """A perturbation changes mass, motor, wheel and losses of an adopted robot."""
    _, model = read(file(document(DIFF, MOTORS)))
    changed = mjcf.clone(model)
    p = Perturbation(
        mass_factor=1.5, resistance_factor=1.3, left_radius_factor=1.04, drive_friction_factor=3, payload=2
    )
    perturb(model, changed, p)
    robot = read_robot(changed)
    assert robot.mass == pytest.approx(1.5 * 14 + 2) and robot.resistance == pytest.approx(2.6)
    assert robot.wheel_radius == pytest.approx(0.102) and robot.drive_loss == pytest.approx(0.3)


def test_load_behind(file, capsys):
    """A robot whose caster and load are behind the driven axle runs without a reference of its own, and is checked."""
    wheels = wheel("a", "0 0.2 0") + wheel("b", "0 -0.2 0")
    path = file(document("<freejoint/>" + BOX.format(-0.05) + BALL.format(-0.3) + wheels, MOTORS))
    robot = read_robot(mjcf.load(robot=mrctl.load_robot(path)))
    assert robot.wheelbase < 0 and robot.com_offset < 0
    assert cli.main(["run", "--robot.path", str(path), "--laps", "1"]) == 0
    cli.main(["check", str(path)])
    said = capsys.readouterr().out
    assert "the centre of mass is behind the driven axle" in said and "Error" not in said


def test_hull(file):
    """A robot of somebody's own gets the hull of its parts, collides with a wall, and arrives behind a door."""
    robot = mrctl.load_robot(file(document(DIFF, MOTORS)))
    # The box reaches from −0.1 to 0.3 m; the wheels of radius 0.1 m are 0.04 m wide, at ±0.2 m.
    corners = footprint(mjcf.load("flat", "caster", robot=robot))
    assert (corners.min(axis=0), corners.max(axis=0)) == (pytest.approx([-0.1, -0.22]), pytest.approx([0.34, 0.22]))
    own = mrctl.Scenario(robot=robot, prior="model", learner="none", initial_spread=(0, 0, 0))
    wall = mrctl.Obstacles(shapes=(mrctl.Box(x=1.0, length=0.1, width=2.0),))
    run = mrctl.simulate(own.replace(reference=mrctl.Line(length=1.0, speed=0.4), laps=1, obstacles=wall))
    assert run["failure"] == "collision" and 0 < float(run["clearance"].dropna("time")[-1]) < 0.4 * 0.02
    assert float(run["x"].dropna("time")[-1]) == pytest.approx(0.95 - 0.34, abs=0.01)
    mission = navigate(task_of("doorway:3", own), own)
    assert mission.table["outcome"].tolist() == ["arrived"] and float(mission.table["clearance"].iloc[0]) > 0.02


PLAIN = '<velocity name="drive" joint="a"/>' + MOTOR.format("b", 30, "")
WARM = 'inductance="1e-4 0" thermal="1 10 20 20 0.004 0.1"'
TRIPLE = MOTORS + MOTOR.format("c", 30, "")
ERRORS = {
    "axes across": (document(DIFF.replace("0 1 0", "1 0 0"), MOTORS), {}, ("'a', 'b' must point along",)),
    "no motors": (document(DIFF, ""), {}, ("wheels", "dcmotor", "'a', 'b'")),
    "three motors": (document(TRICYCLE, TRIPLE + SERVO.format("s1")), {}, ("wheels", "3 joints")),
    "another motor": (document(DIFF, PLAIN), {"wheels": ("a", "b")}, ("motor", "'a'", "'drive'", "<dcmotor joint=")),
    "no supply": (document(DIFF, MOTORS.replace('ctrlrange="-12 12"', "")), {}, ("motor", "ctrlrange")),
    "no volts": (document(DIFF, MOTORS.replace("ctrlrange", 'input="vel" ctrlrange')), {}, ("motor_left", "voltage")),
    "warm": (document(DIFF, MOTORS.replace("ctrlrange", f"{WARM} ctrlrange")), {}, ("motor_left", "thermal")),
    "one-sided": (document(DIFF, MOTORS.replace("-12 12", "0 12")), {}, ("motor_left", "ctrlrange 0 to 12 V")),
    "no such wheel": (document(DIFF, MOTORS), {"wheels": ("a", "z")}, ("wheels", "'z'", "'a', 'b'")),
    "wheels as one text": (document(DIFF, MOTORS), {"wheels": "ab"}, ("wheels: 1 joints, 'ab'",)),
    "wheel named twice": (document(DIFF, MOTORS), {"wheels": ("a", "a")}, ("wheels", "'a', 'a'")),
    "wheel named three times": (document(DIFF, MOTORS), {"wheels": ("a", "b", "a")}, ("wheels", "'a', 'b', 'a'")),
    "a wheel as steering": (document(DIFF, MOTORS), {"steering": ("a",)}, ("steering", "'a' is not upright")),
    "steering named twice": (document(TRICYCLE, MOTORS), {"steering": ("s1", "s1")}, ("steering", "'s1', 's1'")),
    "wheel joint in the chassis": (
        document(DIFF.replace("<freejoint/>", '<joint name="z" axis="0 1 0"/>'), MOTORS.replace('"a"', '"z"')), {},
        ("chassis", "'base'")),
    "no such chassis": (document(DIFF, MOTORS), {"chassis": "z"}, ("chassis", "'z'", "'base'")),
    "no caster": (document(DIFF.replace(BALL.format(0.3), ""), MOTORS), {}, ("caster",)),
    "caster below": (document(DIFF.replace("-0.06", "-0.12"), MOTORS), {}, ("caster", "ball ends 60 mm below the fl")),
    "caster above": (document(DIFF.replace("-0.06", "-0.04"), MOTORS), {}, ("caster", "ball ends 20 mm above the fl")),
    "casters around": (document(DIFF + BALL.format(-0.3).replace("ball", "o"), MOTORS), {}, ("caster", "'ball', 'o'")),
    "axles at an angle": (
        document(DIFF.replace('name="b" axis="0 1 0"', 'name="b" axis="1 1 0"'), MOTORS), {}, ("wheels", "axle")),
    "no servo": (document(TRICYCLE, MOTORS), {"steering": ("s1",)}, ("steering", "'s1'", "kp")),
    "no servo, and no names": (document(TRICYCLE, MOTORS), {}, ("steering", "no trail", '<position joint="s1"')),
    "range beside straight on": (
        document(TRICYCLE.replace('"-30', '"10'), MOTORS + SERVO.format("s1")), {}, ("steering", "'s1'", "range"),
    ),
    "no servos": (document(CAR, MOTORS), {}, ("steering", "no trail", '<position joint="s1"')),
    "no stops": (
        document(TRICYCLE.replace('range="-30 30"', ""), MOTORS + SERVO.format("s1")), {}, ("steering", "range")),
    "nothing to roll on": (
        document(TRICYCLE.replace('name="c" axis="0 1 0"', 'name="c" axis="0 0 1"'), MOTORS + SERVO.format("s1")), {},
        ("steering", "'s1'", "roll")),
    "a loop closed at a wheel": (
        document(TRICYCLE.replace('<body pos="0.5', '<body name="f" pos="0.5'), MOTORS + SERVO.format("s1")).replace(
            "</mujoco>", '<equality><connect body1="f" body2="base" anchor="0 0 0"/></equality></mujoco>'), {},
        ("equality", "'base'", "site1")),
    "cogging": (
        document(DIFF, MOTORS.replace("ctrlrange", 'cogging="0.01 12 0" ctrlrange')), {}, ("motor_left has cogging",)),
    "late motor": (
        document(DIFF, MOTORS.replace("ctrlrange", 'delay="0.01" nsample="8" ctrlrange')), {},
        ("motor_left has delay",)),
    "coupled wheels": (
        document(DIFF, MOTORS).replace(
            "</mujoco>", '<equality><joint joint1="a" joint2="b"/></equality></mujoco>'), {},
        ("equality", "'a', 'b'", "apart")),
    "stretched tendon": (document(DIFF, MOTORS).replace("</mujoco>", TENDONS.format('stiffness="1"') + "</mujoco>"), {},
        ("tendon", "'turn'", "'a', 'b'", "take the tendon out")),
    "pulled tendon": (document(DIFF, MOTORS + '<motor tendon="turn"/>').replace(
            "</mujoco>", TENDONS.format("") + "</mujoco>"), {},
        ("tendon", "'turn'", "'a', 'b'", "take the tendon out")),
    "wheels that lie": (document(DIFF.replace('euler="90 0 0"', ""), MOTORS), {}, ("wheels", "joint 'a'", "lies flat")),
    "third wheel on a fixed axle": (
        document(DIFF.replace(BALL.format(0.3), wheel("f", "0.3 0 0")), MOTORS), {}, ("caster", "'f'", "fixed axle")),
    "driven and steered": (
        document(CAR, MOTORS.replace('"a"', '"c"').replace('"b"', '"d"') + SERVO.format("s1") + SERVO.format("s2")), {},
        ("driven wheel 'c' is steered by 's1'",)),
    "fork and wheel in one": (
        document(TRICYCLE.replace('<joint name="c"', "").replace(
            'range="-30 30"/>', 'range="-30 30"/><joint name="c" axis="0 1 0"/>'), MOTORS + SERVO.format("s1")), {},
        ("steering", "'s1', 'c'", "one body")),
    "servo with a filter": (
        document(TRICYCLE, MOTORS + SERVO.format("s1").replace("kp", 'timeconst="0.1" kp')), {},
        ("steering", "timeconst")),
    "planar base": (
        document('<joint name="px" type="slide" axis="1 0 0"/><geom size="0.01" mass="0.1"/><body name="own">'
                 + DIFF.replace("<freejoint/>", '<joint name="pz" axis="0 0 1"/>') + "</body>", MOTORS), {},
        ("chassis", "'pz'", "'own'")),
    "wheel ahead of its axis": (
        document(TRICYCLE.replace(wheel("c", "0 0 0", loss=0.02), wheel("c", "0.01 0 0", loss=0.02)),
                 MOTORS + SERVO.format("s1")), {}, ("steering", "10 mm ahead")),
    "tips over": (document(DIFF.replace('pos="0.1 0 0.03"', 'pos="-0.1 0 0.03"'), MOTORS), {},
        ("com_offset", f"{-1000 * 10 * 0.1 / 14:.4g} mm ahead of the driven axle and 0 mm", "ground 300 mm ahead")),
    "not MJCF": ("<urdf/>", {}, ("mine.xml",)),
    "limits": (
        document(DIFF, MOTORS, extra='<custom><numeric name="limits" data="1 2"/></custom>'), {}, ("limits", "4")),
}  # fmt: skip


def test_wheel_that_is_a_mesh(file):
    """The contact sphere lies on the axle with the mesh's radius, also where the centroid of the mesh does not."""
    corners = [(0.1 * np.cos(a), y, 0.1 * np.sin(a)) for a in np.arange(48) * np.pi / 24 for y in (-0.02, 0.02)]
    vertices = " ".join(f"{x:.9f}" for corner in [*corners, (0.06, 0.1, 0.03)] for x in corner)
    mesh = f'<asset><mesh name="tyre" vertex="{vertices}"/></asset>'
    geom = '<geom type="cylinder" size="0.1 0.02" euler="90 0 0" mass="2" friction="0.8"/>'
    body = DIFF.replace(geom, '<geom type="mesh" mesh="tyre" mass="2"/>')
    robot, model = read(file(document(body, MOTORS, extra=mesh)))
    assert robot.wheel_radius == pytest.approx(0.1, rel=1e-6) and robot.half_track == pytest.approx(0.2, abs=0.03)
    for name in ("wheel_left", "wheel_right"):
        place = model.geom(name).pos
        assert np.hypot(place[0], place[2]) < 1e-9 and model.geom(name).size[0] == pytest.approx(0.1, rel=1e-6)


def test_servo_without_damping(file):
    """A servo that nothing damps, for which no gain is too large, is refused with what to do."""
    own = mrctl.load_robot(file(document(TRICYCLE, MOTORS + SERVO.format("s1").replace('kv="0.4"', ""))))
    with pytest.raises(InputError, match="give it kv or dampratio"):
        mrctl.simulate(mrctl.Scenario(robot=own, laps=1, reference=mrctl.Line(), sensing={"tier": "ideal"}))


@pytest.mark.parametrize("name", ERRORS)
def test_refused(file, name):
    """A robot that cannot be adopted is refused with one line that names the file and the part."""
    text, names, words = ERRORS[name]
    with pytest.raises(InputError) as refusal:
        mrctl.load_robot(file(text), **names)
    assert "\n" not in str(refusal.value) and "mine.xml" in str(refusal.value)
    for word in words:
        assert word in str(refusal.value), refusal.value


def test_refused_elsewhere():
    """A missing file, a robot named as a world, and a steering that a robot does not have are refused."""
    for scenario, words in (
        (mrctl.Scenario(robot=RobotFile(path="none.xml")), ("robot.path", "turtlebot")),
        (mrctl.Scenario(robot=RobotFile(path="flat")), ("robot.path", "turtlebot")),
        (mrctl.Scenario(world="racecar"), ("world", "robot.path")),
        (mrctl.Scenario(robot=RobotFile(path="turtlebot"), steering="rigid"), ("steering", "caster")),
    ):
        with pytest.raises(InputError) as refusal:
            mrctl.simulate(scenario)
        assert all(word in str(refusal.value) for word in words), refusal.value
