"""Changing speed: the voltages that the time law foresees, and a stop in which nothing winds up."""

import numpy as np
import pytest

import mrctl
from mrctl import Scenario
from mrctl.experiments.paper import IDEAL
from mrctl.physics import mjcf
from mrctl.physics.parameters import read_robot
from mrctl.theory.references import StopAndGo, random_spline
from mrctl.theory.timing import Limits

ROBOT = read_robot(mjcf.load())


@pytest.mark.parametrize("steering", ["compliant", "rigid"])
def test_no_saturation(steering):
    """With the model as feedforward two laps need at most the voltage that the law allows, and the robot tracks."""
    courses = [random_spline(np.random.default_rng(seed), ROBOT) for seed in range(4)]
    common = {"steering": steering, "prior": "model", "learner": "none", "laps": 2, "initial_spread": (0, 0, 0)}
    for course in courses:
        result = mrctl.simulate([Scenario(**IDEAL, reference=course, **common)], threads=1)
        voltage = np.abs([result["voltage_left"], result["voltage_right"]]).max()
        assert 0.5 * ROBOT.supply < voltage < 1.02 * Limits.of(ROBOT).voltage
        (found,) = mrctl.summary(result).to_dict("records")
        assert not found["failed"] and found["v_rmse"] < 0.02 and found["position_rmse"] < 0.01
        acceleration = course.sample(np.linspace(0, course.period, 1000)).acceleration[:, 0]
        assert acceleration.std() > 0.1  # the mass along x is excited


def test_long_stop():
    """With rigid steering a noisy gyro does not turn the fork of a robot that has stood for half a minute."""
    common = {"learner": "none", "steering": "rigid", "laps": 1, "sensing": {"tier": "field", "estimator": "ekf"}}
    result = mrctl.simulate([Scenario.from_dict(common | {"reference": StopAndGo(pause=30.0), "seed": 1})], threads=1)
    (angle,), time = np.abs(result["steering_command"].values), result["time"].values
    start = int(np.argmax(time >= 33.0))  # when it drives on
    assert angle[start : start + 400].max() < 1.2 * angle[:start].max()
