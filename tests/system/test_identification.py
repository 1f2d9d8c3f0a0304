"""`mrctl identify` on the physics, in all tiers: intervals hold the truth, for the default robot and others."""

import json
import shutil

import pytest

from mrctl import InputError, Perturbation, cli
from mrctl.experiments.identify import identify
from mrctl.physics.files import models_folder
from mrctl.sensing.tiers import Sensing

LAB, FIELD = Sensing(tier="lab"), Sensing(tier="field")


@pytest.fixture
def one_period(monkeypatch):
    """The drives are averaged over one period instead of two, which leaves more of the noise."""
    monkeypatch.setattr("mrctl.experiments.identify.PERIODS", 1)


def test_default_robot(capsys):
    """All constants within 1 % from the sensors of the lab, and inside of their intervals; the table says so."""
    assert cli.main(["identify", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["sensing"]["tier"] == "lab"
    assert [row["name"] for row in found["constants"]] == ["R_a", "N k", "M_e", "F_c", "J_e", "m c", "c"]
    for row in found["constants"]:
        assert abs(row["error"]) < 0.01 and row["identifiable"], row
        assert row["low"] < row["true"] < row["high"], row
        assert row["high"] - row["low"] < 0.05 * row["true"], row


@pytest.mark.usefixtures("one_period")
@pytest.mark.parametrize("tier", ["ideal", "field"])
def test_another_than_modelled(tier):
    """It is the plant that is identified, not its model: heavier, weaker motors, more friction, a sagging supply."""
    change = Perturbation(mass_factor=1.5, resistance_factor=1.3, drive_friction_factor=2.0, supply_factor=0.9)
    for c in identify(perturbation=change, sensing=Sensing(tier=tier), seed=1):
        assert abs(c.error) < 0.02 and c.low < c.true < c.high and c.identifiable, c
        if c.name == "M_e":
            assert c.true == pytest.approx(31.7, rel=0.01)  # half as much again as 21.3, but for the rotors


@pytest.mark.usefixtures("one_period")
def test_racing_car(capsys):
    """Steered wheels are held straight: the motors make θ̇ there, too. The car is heavier than its file says."""
    words = "racecar --perturbation.mass-factor 1.5 --sensing.tier field --json".split()
    assert cli.main(["identify", *words]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["sensing"]["tier"] == "field"
    for row in found["constants"]:
        assert abs(row["error"]) < 0.02 and row["low"] < row["true"] < row["high"], row


@pytest.mark.usefixtures("one_period")
def test_viscous_friction(tmp_path):
    """The viscous friction that a robot's file states is part of no other constant."""
    folder = shutil.copytree(models_folder(), tmp_path / "models")
    text = (folder / "car.xml").read_text()
    (folder / "car.xml").write_text(text.replace('<joint axis="0 1 0" f', '<joint axis="0 1 0" damping="0.05" f'))
    for c in identify(str(folder / "flat.xml")):
        assert abs(c.error) < 0.015 and c.low < c.true < c.high, c


@pytest.mark.usefixtures("one_period")
def test_what_sensors_cannot_tell():
    """A gyro a thousand times as noisy tells nothing of turns, but encoders of a count in 15° tell the rest; at rates
    and latencies of their own."""
    bad = FIELD.model_copy(
        update={"gyro_noise": 0.5, "encoder_counts": 24, "encoder_rate": 50, "encoder_latency": 0.02}
    )
    found = {c.name: c for c in identify(sensing=bad)}
    assert {name for name, c in found.items() if not c.identifiable} == {"J_e", "m c", "c"}
    for c in found.values():
        assert c.low < c.true < c.high, c
        assert not c.identifiable or abs(c.error) < 0.01, c


def test_refused(capsys):
    """One line for a robot that is not there, and for sensors that do not fit the signals."""
    for words, says in (
        (["--robot.path", "none.xml"], "no file none.xml"),
        (["none.xml"], "no file none.xml"),
        (["racecar", "--robot", "turtlebot"], "either a file or --robot"),
    ):
        assert cli.main(["identify", *words]) == 2
        said = capsys.readouterr().err
        assert said.count("\n") == 1 and says in said
    for change, message in (
        ({"gyro_rate": 4}, "gyro_rate: 4 Hz, but"),
        ({"encoder_rate": 30}, "encoder_rate: 30 Hz is no"),
    ):
        with pytest.raises(InputError, match=message):
            identify(sensing=LAB.model_copy(update=change))
