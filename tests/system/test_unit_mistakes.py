"""`mrctl check` on robots with a wrong unit: it ends in limited time, fails, and says what cannot be."""

import math
import re
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from test_check import messages

from mrctl import cli
from mrctl.checks import examination
from mrctl.checks.command import examination as examine
from mrctl.experiments import mission, single
from mrctl.experiments.tables import Report
from mrctl.physics.files import models_folder
from mrctl.physics.parameters import read_robot
from mrctl.physics.units import LIMITS, bounds, mistake

ROBOT = """<mujoco><compiler angle="degree"/><worldbody><body name="base" pos="0 0 0.1"><freejoint/>
  <geom type="box" size="0.2 0.1 0.05" pos="0.1 0 0.03" mass="10"/>
  <geom type="sphere" size="0.04" pos="0.3 0 -0.06" mass="0"/>
  <body pos="0 0.2 0"><joint name="a" axis="0 1 0" frictionloss="0.1"/>
    <geom type="cylinder" size="0.1 0.02" euler="90 0 0" mass="2" friction="0.8"/></body>
  <body pos="0 -0.2 0"><joint name="b" axis="0 1 0" frictionloss="0.1"/>
    <geom type="cylinder" size="0.1 0.02" euler="90 0 0" mass="2" friction="0.8"/></body></body></worldbody>
  <actuator>
    <dcmotor joint="a" gear="30" motorconst="0.02 0.02" resistance="2" armature="1e-6" ctrlrange="-12 12"/>
    <dcmotor joint="b" gear="30" motorconst="0.02 0.02" resistance="2" armature="1e-6" ctrlrange="-12 12"/>
  </actuator></mujoco>"""
MISTAKES = {
    "gear of 1": ('gear="30"', 'gear="1"'),
    "motor constant": ('"0.02 0.02"', '"0.00002 0.00002"'),
    "mass in grams": ('mass="10"', 'mass="10000"'),
    "friction": ('friction="0.8"', 'friction="80"'),
    "resistance in mΩ": ('resistance="2"', 'resistance="2000"'),
    "frictionloss": ('frictionloss="0.1"', 'frictionloss="100"'),
}


def numbers(pattern: str, factor: float) -> Callable[[str], str]:
    """Returns a change of a file: all numbers in what a pattern's last group matches, times a factor."""

    def change(text: str) -> str:
        def scaled(match: re.Match) -> str:
            values = " ".join(f"{float(number) * factor:.9g}" for number in match[2].split())
            return match[1] + values + match[3]

        return re.sub(f'({pattern})([-+.e0-9 ]+)(")', scaled, text)

    return change


ELEMENT = r"<(?:geom|body|site|inertial|joint|camera)\b[^<>]*?\b"
TYRES = r'<geom (?:name="wheel_\w+" class="contact"|type="cylinder") size="(?=0\.098"|0\.035 0\.0105|0\.0508 0\.01905)'
UNITS = {
    "masses in g": (numbers(' mass="', 1e3), "the mass of chassis is", "is it in g?"),
    "mass of the chassis in g": (numbers(' mass="(?=17.2|6.06|3.26)', 1e3), "the mass of chassis is", "is it in g?"),
    "mass of the wheels in g": (numbers(' mass="(?=0.8|0.12|0.11)', 1e3), "the mass of wheel_left is", "is it in g?"),
    "constant in mN·m/A": (numbers('motorconst="', 1e3), "motor constant", "is it in mN·m/A?"),
    "constant in V/rpm": (numbers('motorconst="', math.pi / 30), "motor constant", "is it in V/rpm?"),
    "gear left at 1": (lambda text: re.sub('gear="[0-9.]+"', 'gear="1"', text), "gear", "limits need one of"),
    "friction of the tyres": (
        numbers('(?<= )friction="', 1e2),
        "the friction of wheel_left",
        "is it in %?",
    ),
    "friction of the drives": (
        numbers('frictionloss="', 1e2),
        "the frictionloss of wheel_left",
        "is it in N·mm or N·cm?",
    ),
    "limits × 0.001": (numbers('"limits" data="', 1e-3), "the numeric limits are", "are they in km/s?"),
    "limits in mm/s": (numbers('"limits" data="', 1e3), "the numeric limits are", "are they in mm/s?"),
    "lengths in mm": (lambda text: lengths(1e3, text), "the lengths are", "are they in mm?"),
    "lengths in cm": (lambda text: lengths(1e2, text), "the lengths are", "are they in cm?"),
    "radius in mm": (numbers(TYRES, 1e3), "radius", "is it in mm"),
    "resistance in mΩ": (numbers('resistance="', 1e3), "the resistance of motor_left", "is it in mΩ?"),
    "armature in g·cm²": (numbers('armature="', 1e7), "the armature of motor_left", "is it in g·cm²?"),
    "supply in mV": (numbers('ctrlrange="', 1e3), "the supply of motor_left", "is it in mV?"),
}


def lengths(factor: float, text: str) -> str:
    """Returns the file with all positions and sizes of its robot times a factor."""
    for attribute in ("pos", "size", "fromto"):
        text = numbers(f'{ELEMENT}{attribute}="', factor)(text)
    return text


@pytest.mark.parametrize("robot", ["car", "turtlebot", "racecar"])
@pytest.mark.parametrize("mistake", UNITS)
def test_names_the_unit(
    mistake: str, robot: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    """A number in a wrong unit is named with its element and the unit, whether the robot can be loaded or not.

    The checks up to that of the motors, whose constant is possible on a turtlebot in V/rpm too, find all of them.
    """
    checks = examination.Examination.checks
    names = [check.name for check in checks]
    monkeypatch.setattr(examination.Examination, "checks", checks[: names.index("motors") + 1])
    change, *said = UNITS[mistake]
    text = (models_folder() / f"{robot}.xml").read_text()
    (tmp_path / "mine.xml").write_text(change(text))
    assert change(text) != text
    assert cli.main(["check", str(tmp_path / "mine.xml")]) in (1, 2)
    out, err = capsys.readouterr()
    (line,) = [line for line in (*out.splitlines(), *err.splitlines()) if said[1] in line]
    assert said[0] in line and len(messages(err)) == 1


DECK = 'type="box" size="0.2 0.1 0.05" pos="0.1 0 0.03" mass="10"'


@pytest.mark.parametrize(
    ("deck", "unit"),
    [
        ('type="box" size="200 0.1 0.05" pos="0.1 0 0.03" mass="10"', "the box of {} is 400 m long.* is it in mm?"),
        ('type="box" size="200 100 0.05" pos="0.1 0 0.03"', "the box of {} is 400 m long.* is it in mm?"),
        ('name="deck" type="box" size="20 0.1 0.05" pos="0.1 0 0.03" mass="10"', "deck is 40 m long.* is it in cm?"),
        ('type="box" size="200 100 50" pos="100 0 30" mass="10"', "the box of {} is 400 m long.* is it in mm?"),
    ],
)
def test_a_part_too_long(deck: str, unit: str, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """It is named and measured, and no mass that follows from it; also where the robot would tip over."""
    (tmp_path / "mine.xml").write_text(ROBOT.replace(DECK, deck))
    assert DECK in ROBOT and cli.main(["check", str(tmp_path / "mine.xml")]) in (1, 2)
    captured = capsys.readouterr()
    said = captured.out + messages(captured.err)[0]
    assert re.search(unit.format("chassis"), said) and "the mass of" not in said


def test_impossible_number(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """Where no single unit is wrong, the impossible number is the cause, and what depends on it is not measured."""
    text = (models_folder() / "turtlebot.xml").read_text()
    (tmp_path / "mine.xml").write_text(re.sub('mass="[0-9.]+"', 'mass="3e7"', text))
    assert cli.main(["check", str(tmp_path / "mine.xml")]) == 1
    out = capsys.readouterr().out
    assert "- impossible number: mass over the cube of the size is 5.29e+09 kg/m³, that of a robot" in out
    assert "time step" not in out and "waits for units: stance" in out and "1 failed, 23 skipped" in out


@pytest.mark.parametrize("command", [["run", "--laps", "1"], ["navigate", "doorway:3"]])
def test_an_impossible_robot_drives_with_a_warning(
    command: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    """One line on stderr points at `mrctl check`; for robots of mrctl nothing is even examined."""
    text, file, examined = (models_folder() / "turtlebot.xml").read_text(), tmp_path / "mine.xml", []
    impossible = examination.impossible
    monkeypatch.setattr(examination, "impossible", lambda model: examined.append(model) or impossible(model))
    monkeypatch.setattr(single, "run", lambda *_: Report("", "", lambda: None))
    monkeypatch.setattr(mission, "run", lambda *_: Report("", "arrived", lambda: None))
    for change in ("turtlebot", text, re.sub('mass="[0-9.]+"', 'mass="3e7"', text)):
        file.write_text(change)
        robot = "turtlebot" if change == "turtlebot" else str(file)
        assert cli.main([*command, "--robot", robot]) == 0
    assert len(examined) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and said.startswith(
        f"mrctl: warning: {file}: impossible number: mass over the cube of the size"
    )
    assert said.endswith(f"; see mrctl check {file}\n")


@pytest.mark.parametrize("factor", [0.3, 1.0, 3.0])
@pytest.mark.parametrize("robot", ["flat", "turtlebot", "racecar"])
def test_other_robots_are_possible(robot: str, factor: float) -> None:
    """Nothing is said of the shipped robots, nor of robots that differ from them by a factor of three in one number."""
    model = examine(robot)._load(None)
    true = read_robot(model)
    for name in ("mass", "wheel_radius", "resistance", "torque_constant", "gear_ratio", "supply", "gear_loss", *LIMITS):
        other = true.model_copy(update={name: factor * getattr(true, name)})
        assert mistake(model, other) is None and min(bound.margin for bound in bounds(other)) > 0, name


@pytest.mark.parametrize(
    ("mistake", "said"),
    [
        *zip(
            MISTAKES,
            (
                "needs at least 3.2",
                "in kV·s/rad?",
                "10,000 kg",
                "80, which no robot has; is it in %?",
                "in mΩ?",
                "in N·mm",
            ),
            strict=True,
        )
    ],
)
def test_names_the_unit_where_no_limits_are_declared(
    mistake: str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    """Limits that follow from a wrong number are wrong too, and do not hide it."""
    (tmp_path / "mine.xml").write_text(ROBOT.replace(*MISTAKES[mistake]))
    assert cli.main(["check", str(tmp_path / "mine.xml")]) == 1
    assert re.search(f"- wrong unit: .*{re.escape(said)}", capsys.readouterr().out)


@pytest.mark.parametrize("mistake", ["gear of 1", "mass in grams", "friction"])
def test_ends_in_time(
    mistake: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    """The whole takes little more than its limit, even if no unit is suspected; no error of a check ends it."""
    monkeypatch.setattr(examination, "MAX_SECONDS", 0.1)
    monkeypatch.setattr(examination, "_impossible", lambda model, report: ())
    (tmp_path / "mine.xml").write_text(ROBOT.replace(*MISTAKES[mistake]))
    start = time.process_time()
    status = cli.main(["check", str(tmp_path / "mine.xml")])
    assert status == 1 and time.process_time() - start < 8
    captured = capsys.readouterr()
    assert "FAIL" in captured.out and "checks failed" in captured.err and "Traceback" not in captured.err


def test_an_error_in_a_check_is_its_failure(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    """The other checks go on, and the text of the error stands in the report."""

    def raises(model: object, robot: object) -> None:
        raise ZeroDivisionError("a wheel without mass")

    first, *others = examination.Examination.checks
    monkeypatch.setattr(examination.Examination, "checks", (first._replace(function=raises), *others[3:5]))
    assert cli.main(["check", str(models_folder() / "car.xml")]) == 1
    captured = capsys.readouterr()
    assert "ZeroDivisionError: a wheel without mass" in captured.out and "1 failed" in captured.out
