"""`mrctl check` and its pytest plugin: each broken robot fails for its own cause, and the shipped ones pass."""

import json
import os
import re
import shutil
import subprocess
import sys
from types import SimpleNamespace

import mujoco
import pytest

from mrctl.checks import command
from mrctl.checks.catalogue import CHECKS
from mrctl.checks.command import examination
from mrctl.checks.examination import PREREQUISITES, Examination, long_step
from mrctl.checks.inspections import suspects
from mrctl.cli import main
from mrctl.physics.files import models_folder
from mrctl.physics.mjcf import load
from mrctl.scenario import Scenario


def messages(err):
    """Lines on stderr that are not progress."""
    return [line for line in err.replace("\r", "\n").splitlines() if not re.search("check/s|s/check|^$", line)]


def wheel(side, attributes):
    """A rear wheel's contact geom with other attributes."""
    geom = f'<geom name="wheel_{side}" class="contact" '
    return f'{geom}size="0.098"/>', f"{geom}{attributes}/>"


def tyre(side, attributes):
    """Attributes added to a contact pair."""
    pair = f'<pair class="tyre" name="tyre_{side}" '
    return pair, pair + attributes + " "


JOINT = '<joint name="wheel_{}"{}/>'
MOTOR = '<dcmotor name="motor_right" class="motor"'
FRONT_AXLE = '<joint name="front_wheel" axis="0 1 0"'
FRONT = '<geom name="front_wheel" class="contact" size="{}"/>'
FORK = 'name="steering" axis="0 0 {}"'
BOX = '<geom name="belly" type="box" size="0.18 0.12 0.035" pos="0.105 0 -0.0628" contype="1" conaffinity="1"/>'
LYING = 'type="cylinder" size="0.098 0.02" euler="1.5707963 0 0"'

# Faults: passages of the robot's files, each with its replacement.
FAULTS = {
    "cylinders": [wheel("left", LYING), wheel("right", LYING)],
    "off centre": [wheel("left", 'size="0.098" pos="0.003 0 0"')],
    "radii": [wheel("left", 'size="0.1"')],
    "front radius": [(FRONT.format(0.075), FRONT.format(0.06))],
    "one gear": [(MOTOR, MOTOR + ' gear="45"')],
    "gear": [('gear="43"', 'gear="86"')],
    "V/rpm": [('"0.0234 0.0234"', '"0.00245 0.00245"')],
    "no armature": [('armature="1.03e-6"', "")],
    "twice": [('armature="1.03e-6"', 'armature="0.0019"')],
    "step": [('timestep="0.002"', 'timestep="0.005"')],
    "coarse": [('timestep="0.002"', 'timestep="0.01"')],
    "load": [('pos="0.089884 0', 'pos="0.089884 0.02')],
    "belly": [('<camera name="follow"', BOX + '<camera name="follow"')],
    "condim": [tyre("left", 'condim="1"'), tyre("right", 'condim="1"')],
    "no pair": [('<pair class="tyre" name="tyre_front" geom1="floor" geom2="front_wheel"/>', "")],
    "axis": [(JOINT.format("right", ""), JOINT.format("right", ' axis="0 -1 0"'))],
    "damping": [(FRONT_AXLE, FRONT_AXLE + ' damping="0.02"')],
    "damping of one": [(JOINT.format("left", ""), JOINT.format("left", ' damping="0.02"'))],
    "loss": [(JOINT.format("left", ""), JOINT.format("left", ' frictionloss="0.3"'))],
    "default contacts": [('solref="0.01 1" solreffriction="0.004 1"', "")],
    "pyramid": [('cone="elliptic" impratio="10"', "")],
    "g·cm²": [('"0.002 0.0034 0.002"', '"2 3.4 2"')],
    "moon": [("<option ", '<option gravity="0 0 -1.62" ')],
    "ice": [tyre("right", 'friction="0.3 0.3 0.005 0.0001 0.0001"')],
    "track": [('<body name="wheel_left" pos="0 0.188 0"', '<body name="wheel_left" pos="0 0.2 0"')],
    "fork": [(FORK.format(1), FORK.format(-1))],
    "degrees": [('"-1.0471976 1.0471976"', '"-0.018277 0.018277"')],
}
# Of each fault: the checks that fail, the name of the cause, and words that its text contains.
DIAGNOSES = {
    "cylinders": ("rolling mirror", "cylinder scrub", "wheel_right touches the ground along an edge"),
    "off centre": ("rest mirror", "off-centre wheel", "wheel_left is 3 mm off its axle"),
    "radii": ("rest mirror", "rear wheel radii differ", "wheel_left has a radius of 100 mm"),
    "front radius": ("stance", "wheel radius against axle height", "front_wheel ends 15 mm above"),
    "one gear": ("stall mirror", "left and right motors differ", "gear 43 left, 45 right"),
    "gear": ("limits", "wrong gear", "need one of 8 to 59"),
    "V/rpm": ("limits motors", "motor constant in other units", "is it in V/rpm?"),
    "no armature": ("motors", "missing armature", "behind a gear of 43"),
    "twice": ("limits motors", "armature reflected twice", "rotor's own, 1.03e-06"),
    "step": ("convergence", "time step too long", "contacts of 4 ms"),
    "coarse": ("velocity_time_constant", "time step too long", "get 10 ms"),
    "load": ("rest mirror", "centre of mass off the axis", "17.2 mm to the left"),
    "belly": ("cornering", "contact beside the wheels", "belly can touch"),
    "condim": ("limits", "condim of a tyre", "wheel_right has condim 1, which has no friction"),
    "no pair": ("stance", "missing contact pair", "joins front_wheel"),
    "axis": ("limits", "wheel axis", "wheel_right turns about (0, -1, 0)"),
    "damping": ("coast_down", "drag", "front_wheel has damping 0.02"),
    "damping of one": ("mirror", "left and right losses differ", "damping 0.02 left, 0 right"),
    "loss": ("stall", "left and right losses differ", "frictionloss 0.3 left, 0.242462 right"),
    "default contacts": ("scrub_free", "soft contacts", "solref 0.02 s"),
    "pyramid": ("cornering", "soft contacts", "pyramid"),
    "g·cm²": ("inertias", "wheel inertia", "wheel_left is 443 times"),
    "moon": ("rest", "gravity", "(0, 0, -1.62)"),
    "ice": ("traction mirror", "tyres of different grip", "wheel_right has friction 0.3"),
    "track": ("rest stall", "misplaced axle", "wheel_left is at (0, 0.2, 0)"),
    "fork": ("circle", "steering axis", "(0, 0, -1)"),
    "degrees": ("limits", "angles in degrees", "1.05°"),
}


@pytest.fixture
def robot(tmp_path):
    """Returns a function that writes a world whose robot has some faults."""

    def write(*names):
        folder = shutil.copytree(models_folder(), tmp_path / "models")
        text = {name: (folder / name).read_text() for name in ("car.xml", "flat.xml")}
        for old, new in (edit for name in names for edit in FAULTS[name]):
            assert any(old in t for t in text.values()), old
            text = {name: t.replace(old, new) for name, t in text.items()}
        for name, content in text.items():
            (folder / name).write_text(content)
        return folder / "flat.xml"

    return write


def examine(path, *names):
    """Findings of some checks, by name."""
    robot = examination(str(path))
    return {check.name: robot.examine(check) for check in robot.checks if check.name in names}


def causes(finding):
    """Names of the causes of a finding."""
    return {cause.cause for cause in finding.causes}


@pytest.mark.parametrize("name", FAULTS)
def test_broken(robot, name):
    """The check fails, and the only cause that is named is the fault, with the numbers of this robot."""
    checks, cause, said = DIAGNOSES[name]
    findings = examine(robot(name), *PREREQUISITES, *checks.split())
    for check in checks.split():
        assert findings[check].status == "failed" and causes(findings[check]) == {cause}
        assert said in findings[check].causes[0].text
        assert not all(c.passed for c in findings[check].report)
    assert set().union(*map(causes, findings.values())) == {cause}


@pytest.mark.parametrize("name", ["flat", "turtlebot", "racecar"])
def test_good(name, capsys):
    """The shipped robots, of which `flat` is the default, pass all checks that suit them; a reason skips the others."""
    status = main(["check", *([] if name == "flat" else [name]), "--json"])
    report = json.loads(capsys.readouterr().out)
    checks = report["checks"]
    failed = {c["check"]: [v for v in c["values"] if not v["passed"]] for c in checks if c["status"] == "failed"}
    assert failed == {} and (status, report["failed"], report["robot"]) == (0, 0, name)
    assert [c["check"] for c in checks] == [check.name for check in Examination.checks]
    assert all(c["values"] and all(v["passed"] for v in c["values"]) for c in checks if c["status"] == "passed")
    skipped = {c["check"]: c["reason"] for c in checks if c["status"] == "skipped"}
    nothing, fork = "nothing is steered", "no trailing fork"
    servos = "servos hold the front wheels, which leaves the motors one degree of freedom"
    assert (
        skipped
        == {
            "flat": {},
            "turtlebot": {"circle": nothing, "rolling": nothing, "cornering": nothing, "scrub_free": fork},
            "racecar": {"prediction": servos, "scrub_free": fork},
        }[name]
    )


def test_nothing_odd():
    """No inspection finds a fault in the shipped robots."""
    for name in ("flat", "turtlebot", "racecar"):
        assert [suspect.cause for suspect in examination(name).suspects] == []


HUB = '<joint name="rear_left_wheel_joint"{}/>'
ONE_MOTOR = '<dcmotor name="left_motor" class="motor"'
KNUCKLE = '<default class="knuckle"><joint'
AXLE, HELD = '<joint axis="0 1 0"', ' range="-9 9" stiffness="1" actuatorfrcrange="-0.3 0.3"'
LIFTED = '<body gravcomp="1"><geom size="0.01" mass="0.1"/></body>'
LEFT = 'name="wheel_left_joint"/>\n        <inertial pos="0 0 0" mass="0.12" diaginertia="4.1e-5 {}e-5 4.1e-5"'
CASTER = '<geom name="caster_front" type="sphere" size="0.0176" pos="0.115 0 -0.0174" material="nylon"/>'
FORK = """<body pos="0.13 0 0"><joint name="swivel" axis="0 0 1"/><geom size="0.02" mass="0.3" contype="0"
  conaffinity="0"/><body pos="-0.015 0 -0.0174"><joint axis="0 1 0"/><geom size="0.0176" mass="0.1"/></body></body>"""
ADOPTED = {
    "turtlebot": ('armature="7e-7"', "", "motors", "missing armature"),
    "turtlebot ice": ('friction="0.8"', 'friction="0.04"', "turning_limits", "limits beyond the grip"),
    "turtlebot tips": ('pos="0.0312 0 0.105"', 'pos="0.002 0 0.105"', "limits", "tips over"),
    "turtlebot tips at full voltage": ('pos="0.0312 0 0.105"', 'pos="0.01 0 0.105"', "traction", "tips over"),
    "turtlebot held": (AXLE, AXLE + HELD, "limits", "wheel held by its joint"),
    "turtlebot wheel": (LEFT.format(7.4), LEFT.format(8), "mirror", "left and right wheels differ"),
    "turtlebot swivel": (CASTER, FORK, "centre_of_mass", "swivelling caster"),
    "turtlebot gravcomp": ("<freejoint/>", "<freejoint/>" + LIFTED, "rest", "weight carried from outside"),
    "racecar": (HUB.format(""), HUB.format(' damping="0.001"'), "mirror", "left and right losses differ"),
    "racecar spring": (KNUCKLE, KNUCKLE + ' stiffness="1"', "circle", "spring at the steering"),
    # Under another name the fork of the default robot is one that is steered by a servo, for which its own is too soft.
    "racecar motor": (ONE_MOTOR, ONE_MOTOR + ' damping="1e-5"', "mirror", "left and right losses differ"),
    "car": ('<body name="fork"', '<body name="pivot"', "circle", "soft steering servo"),
}


@pytest.mark.parametrize("name", ADOPTED)
def test_broken_adopted(name, tmp_path):
    """Faults of robots under other names and of other kinds."""
    old, new, check, cause = ADOPTED[name]
    text = (models_folder() / f"{name.split()[0]}.xml").read_text()
    assert old in text
    (tmp_path / "mine.xml").write_text(text.replace(old, new))
    finding = examine(tmp_path / "mine.xml", check)[check]
    assert finding.status == "failed" and causes(finding) == {cause}


CASTERS = {
    "sinks": ('size="0.0176"', 'size="0.0376"', "caster_front ends 20 mm below the rear wheels"),
    "floats": ("0.115 0 -0.0174", "0.115 0 -0.0144", "caster_front ends 3 mm above the rear wheels"),
}


@pytest.mark.parametrize("name", CASTERS)
def test_caster_off_the_floor(name, tmp_path, capsys):
    """A caster that mrctl makes reach the floor is named with its number; nothing else is measured of such a robot."""
    old, new, says = CASTERS[name]
    text = (models_folder() / "turtlebot.xml").read_text()
    assert old in text
    (tmp_path / "mine.xml").write_text(text.replace(old, new))
    assert main(["check", str(tmp_path / "mine.xml")]) == 1
    out = capsys.readouterr().out
    assert f"- caster off the floor: {says}" in out and "nothing is steered" not in out and "waits for stance: " in out


def test_says_how_far_to_move(tmp_path):
    """Of a caster that lifts: at which acceleration, g c/h, and how far ahead a fifth of the grip does not lift it."""
    text = (models_folder() / "turtlebot.xml").read_text()
    (tmp_path / "mine.xml").write_text(text.replace('pos="0.0312 0 0.105"', 'pos="0.002 0 0.105"'))
    (tips,) = examination(str(tmp_path / "mine.xml")).suspects
    c, h, hardest = 6.06 * 0.002 / 6.3, 0.035 + 6.06 * 0.105 / 6.3, 0.2 * 0.8 * 9.81
    assert f"by more than {9.81 * c / h:.3g} m/s² lifts the caster, with {6.3 * 9.81 * c / 0.115:.3g} N" in tips.text
    assert f"move the centre of mass {1e3 * (hardest * h / 9.81 - c):.3g} mm towards the caster" in tips.text


def test_two_faults(robot):
    """Each check is explained by the fault that it shows, and by both where either is enough to fail it."""
    findings = examine(robot("off centre", "damping"), "mirror", "top_speed", "stall")
    assert causes(findings["mirror"]) == {"off-centre wheel"}
    assert causes(findings["top_speed"]) == {"off-centre wheel", "drag"}


def test_harmless(robot):
    """A fault that does no harm is not named."""
    path = robot()
    text = (path.parent / "car.xml").read_text().replace(' solimpfriction="0.99 0.99"', "")
    (path.parent / "car.xml").write_text(text)
    assert [suspect.cause for suspect in suspects(load(str(path)))] == ["creeping friction loss"]
    findings = examine(path, *PREREQUISITES, "hold_on_slope", "top_speed")
    assert {finding.status for finding in findings.values()} == {"passed"}


@pytest.mark.parametrize("bits", ['contype="1" conaffinity="0"', 'contype="0" conaffinity="1"'])
def test_one_sided_contact(robot, bits):
    """A belly in the floor is named where MuJoCo makes contacts, whichever of the two geoms asks for them."""
    path = robot("belly")
    text = (path.parent / "car.xml").read_text().replace('contype="1" conaffinity="1"', bits)
    (path.parent / "car.xml").write_text(text.replace("0 -0.0628", "0 -0.0728"))
    model = load(str(path))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    belly = model.geom("belly").id
    assert sum(belly in contact.geom for contact in data.contact) == 4
    assert [suspect.cause for suspect in suspects(model)] == ["contact beside the wheels"]


def test_unexplained(robot):
    """A fault that no inspection knows fails a check, and no cause is invented."""
    path = robot()
    text = (
        (path.parent / "car.xml").read_text().replace('name="steering" axis', 'name="steering" frictionloss="2" axis')
    )
    (path.parent / "car.xml").write_text(text)
    finding = examine(path, "prediction")["prediction"]
    assert finding.status == "failed" and not finding.causes


def test_others_wait(robot):
    """A robot that does not stand is not driven."""
    findings = examine(robot("no pair"), "stance", "rest", "mirror")
    assert [f.status for f in findings.values()] == ["failed", "skipped", "skipped"]
    assert findings["rest"].reason == "waits for stance"


def test_command(robot, capsys):
    """A table, the cause below it, and exit status 1; as JSON the same."""
    path = str(robot("gear"))
    assert main(["check", path]) == 1
    out, err = capsys.readouterr()
    assert "cause: wrong gear; once repaired, V at its limit" in out
    assert "- wrong gear: gear 86" in out and "skipped, waits for limits" in out
    said = messages(err)
    assert said == [f"mrctl: {path}: 1 of {len(Examination.checks)} checks failed"]
    assert main(["check", path, "--json"]) == 1
    report = json.loads(capsys.readouterr().out)
    failed = [check for check in report["checks"] if check["status"] == "failed"]
    assert report["failed"] == 1 and [c["check"] for c in failed] == ["limits"]
    assert failed[0]["causes"][0]["cause"] == "wrong gear"
    assert [v["passed"] for v in failed[0]["values"]].count(False) == 1


def test_bad_input(tmp_path, capsys):
    """A file that holds no robot gives exit status 2 and one line."""
    (tmp_path / "stone.xml").write_text("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>")
    for path in (tmp_path / "stone.xml", tmp_path / "none.xml"):
        assert main(["check", str(path)]) == 2
        out, err = capsys.readouterr()
        assert not out and err.count("\n") == 1 and path.name in err


def pytest_in(folder, *arguments, **environment):
    """Runs pytest as a user would, outside of this repository."""
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", *arguments]
    return subprocess.run(command, cwd=folder, env=os.environ | environment, capture_output=True, text=True)


def test_plugin(robot):
    """There is a test for each check beside the given ones; a failure shows values and cause, and no traceback."""
    folder = robot("gear").parent
    (folder / "test_mine.py").write_text("def test_mine():\n    pass\n")
    run = pytest_in(folder, "--mrctl-robot", "flat.xml", "test_mine.py", "-rs")
    assert run.returncode == 1, run.stdout + run.stderr
    others = len(Examination.checks) - len(PREREQUISITES)
    assert f"1 failed, {len(PREREQUISITES)} passed, {others} skipped" in run.stdout
    assert "V at its limit: 1." in run.stdout and "wrong gear: gear 86" in run.stdout
    assert "waits for limits" in run.stdout and "Traceback" not in run.stdout


def test_plugin_bad_input(tmp_path):
    """A file that holds no robot is an error of collection, in one line, and no other file is collected."""
    (tmp_path / "test_mine.py").write_text("def test_mine():\n    pass\n")
    run = pytest_in(tmp_path, "--mrctl-robot", "none.xml")
    assert run.returncode == 4 and "none.xml" in run.stderr and "passed" not in run.stdout


def test_plugin_sleeps(tmp_path):
    """Without the option the plugin imports nothing heavy, and collects no MJCF file."""
    heavy = {"numpy", "mujoco", "numba", "torch", "pydantic", "mrctl.physics", "mrctl.checks.catalogue"}
    code = f"import sys\ndef test_light():\n    assert not {heavy} & sys.modules.keys()\n"
    code += "    assert 'mrctl.checks.pytest_plugin' in sys.modules\n"
    (tmp_path / "test_light.py").write_text(code)
    (tmp_path / "test_robot.xml").write_text("<mujoco/>")
    # Plugins of other packages may import NumPy: only that of the entry point `mrctl` is loaded.
    run = pytest_in(tmp_path, "-p", "mrctl", PYTEST_DISABLE_PLUGIN_AUTOLOAD="1")
    assert run.returncode == 0 and "1 passed" in run.stdout, run.stdout
    assert "plugins: mrctl" in run.stdout
    assert "mrctl" in pytest_in(tmp_path, "--co").stdout.partition("plugins: ")[2].partition("\n")[0]  # by default


def test_all_checks():
    """An examination has all checks but those of the shipped worlds."""
    assert {check.name for check in CHECKS} - {check.name for check in Examination.checks} == {
        "slope", "tilted_gravity", "patch", "rough",
    }  # fmt: skip


def test_the_whole_ends(monkeypatch, capsys):
    """Checks that are left after 28 s of processor time fail with their text; a busy machine takes nothing from it."""
    used = iter(range(0, 10_000_000, 5))  # every look at the processor's time takes 5 s
    clock = SimpleNamespace(process_time=lambda: float(next(used)), monotonic=None)
    monkeypatch.setattr("mrctl.checks.open_loop.time", clock)
    text, verdict = command.run("flat", json=True)
    checks = json.loads(text)["checks"]
    late = [check for check in checks if any("its time is up" in value["quantity"] for value in check["values"])]
    assert late[-1] == checks[-1] and len(late) > 15 and verdict.startswith(f"{len(late)} of")
    assert all(check["status"] == "failed" and not check["causes"] for check in late)
    monkeypatch.undo()
    with pytest.raises(SystemExit):
        main(["check", "--help"])
    assert "at most 30 s of processor time" in " ".join(capsys.readouterr().out.replace("│", " ").split())


def test_a_warning_is_said_once(tmp_path, monkeypatch, capfd):
    """Of a robot file with options of its own, MuJoCo warns at each of 28 compilations: one line, and no log file."""
    text = (models_folder() / "turtlebot.xml").read_text()
    (tmp_path / "b1.xml").write_text(text.replace('<option timestep="0.002"', '<option timestep="0.02"'))
    monkeypatch.chdir(tmp_path)
    assert main(["check", "b1.xml"]) == 0
    (said,) = messages(capfd.readouterr().err)
    assert said.startswith("mrctl: warning: Attach conflict") and [file.name for file in tmp_path.iterdir()] == [
        "b1.xml"
    ]
    model = load("flat")
    data = mujoco.MjData(model)
    data.qacc_warmstart[:] = data.qvel[:] = 1e30
    mujoco.mj_step(model, data)
    assert data.warning.number.any() and not capfd.readouterr().err and len(list(tmp_path.iterdir())) == 1


def test_advice_about_the_time_step():
    """The flag of the advice sets the step at which the check passes; the robot's own file may not set it."""
    model = load("flat")
    suspect = long_step(model, 8)
    suspect.repair(model)
    flag, value = re.search(r"mrctl run --(\S+) (\S+)$", suspect.text).groups()
    assert Scenario(**{flag.replace("-", "_"): value}).physics_step == model.opt.timestep
