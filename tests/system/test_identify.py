"""`mrctl identify` on the physics: within 5 %, with intervals that hold the truth, for the default robot and others."""

import json

import pytest

from mrctl import Perturbation, RobotFile, cli
from mrctl.experiments.identify import NOISE, identify


def test_default_robot(capsys):
    """All constants within 1 % with the noise of ordinary sensors, and inside of their intervals; the table says so."""
    assert cli.main(["identify", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["constants"]
    assert [row["name"] for row in rows] == ["R_a", "N k", "M_e", "F_c", "J_e", "m c"]
    for row in rows:
        assert abs(row["error"]) < 0.01, row
        assert row["low"] < row["true"] < row["high"], row
        assert row["high"] - row["low"] < 0.05 * row["true"], row


def test_another_than_modelled():
    """It is the plant that is identified, not its model: heavier, weaker motors, more friction, a sagging supply."""
    change = {"mass_factor": 1.5, "resistance_factor": 1.3, "drive_friction_factor": 2.0, "supply_factor": 0.9}
    for c in identify(perturbation=NOISE.model_copy(update=change), seed=1):
        assert abs(c.error) < 0.02 and c.low < c.true < c.high, c
        if c.name == "M_e":
            assert c.true == pytest.approx(31.7, rel=0.01)  # half as much again as 21.3, but for the rotors


def test_racing_car():
    """Steered wheels are held straight: the motors make θ̇ there, too."""
    for c in identify(robot=RobotFile(path="racecar"), perturbation=Perturbation()):
        assert abs(c.error) < 0.02 and c.low < c.true < c.high, c


def test_refused(capsys):
    """One line for a robot that is not there."""
    assert cli.main(["identify", "--robot.path", "none.xml"]) == 2
    assert capsys.readouterr().err.count("\n") == 1
