"""The off-line training of `composite`, reduced: the same seed gives the same file, and the units are worth having."""

import json

import numpy as np
import pytest
from safetensors import safe_open

from mrctl import cli
from mrctl.control.composite import Composite
from mrctl.control.weights import SHIPPED, load_training
from mrctl.experiments import train
from mrctl.physics import mjcf
from mrctl.physics.parameters import read_robot


def test_reduced(monkeypatch):
    """On plants not seen less is left than by the physical features alone; the same seed trains the same units."""
    monkeypatch.setattr(train, "EPOCHS", 40)
    robot = read_robot(mjcf.load("flat"))
    seen, unseen = (train.drive(train.draw(robot, plants, [3, plants]), robot) for plants in (24, 8))
    units = train.fit(seen, 3)
    np.testing.assert_array_equal(units, train.fit(seen, 3))
    assert train.draw(robot, 24, [3, 24]) == train.draw(robot, 24, [3, 24]) != train.draw(robot, 24, [4, 24])
    plain, found = (train.held_out(seen, unseen, network) for network in (np.zeros((0, 9)), units))
    where = "rest of the drive"
    assert np.exp(np.mean([np.log(found[name][where] / plain[name][where]) for name in plain])) < 0.8


def test_command(monkeypatch, tmp_path, capsys):
    """The command writes a file that `composite` reads, with the recipe beside the numbers."""
    monkeypatch.setattr(train, "EPOCHS", 3)
    monkeypatch.setattr(train, "DRIVE", 12.0)
    file = tmp_path / "new" / "own.safetensors"
    assert cli.main(["train", "--plants", "12", "--out", str(file), "--seed", "3"]) == 0
    assert "and 16 units" in capsys.readouterr().out
    assert np.abs(load_training(file).units - load_training(SHIPPED).units).max() > 0.1
    with safe_open(file, "numpy") as opened:
        recipe = opened.metadata()
    assert recipe["command"] == "mrctl train --plants 12 --seed 3" and "mujoco" in json.loads(recipe["versions"])


def test_shipped():
    """The file in the package says how it was made, and that the units help: later in a drive on every channel, and on
    another drive in the mean of the channels."""
    with safe_open(SHIPPED, "numpy") as file:
        recipe = file.metadata()
    assert recipe["command"].startswith("mrctl train")
    left = json.loads(recipe["held_out"])
    assert recipe["filter"] == str(Composite().filter)
    ratio = {
        where: [left["with_units"][name][where] / left["physical"][name][where] for name in left["physical"]]
        for where in ("rest of the drive", "another drive")
    }
    assert max(ratio["rest of the drive"]) < 0.9
    assert np.exp(np.log(ratio["another drive"]).mean()) < 0.95


@pytest.mark.parametrize(("arguments", "field"), [(["--plants", "3"], "plants"), (["--out", "."], "out")])
def test_refused(arguments, field, capsys):
    """Bad input is one line that names the field, before anything is computed."""
    assert cli.main(["train", *arguments]) == 2
    assert capsys.readouterr().err.startswith(f"mrctl: {field}: ")
