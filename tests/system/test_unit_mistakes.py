"""`mrctl check` on robots with a wrong unit: it ends in limited time, fails, and says what cannot be."""

import time
from pathlib import Path

import pytest

from mrctl import cli
from mrctl.checks import examination
from mrctl.physics.files import models_folder

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


@pytest.mark.parametrize("mistake", MISTAKES)
def test_ends_in_time(
    mistake: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    """The whole takes little more than its limit, however slow the robot; no error of a check ends it."""
    monkeypatch.setattr(examination, "SECONDS", 1.0)
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
