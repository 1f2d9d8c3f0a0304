"""Contacts of a robot: the forces obey Newton's law, and what slides slides as fast as kinematics says."""

import mujoco
import numpy as np
import pytest

from mrctl.physics import mjcf
from mrctl.physics.plant import build
from mrctl.theory.obstacles import Obstacles
from mrctl.theory.robot import GRAVITY

MODEL, ROBOT = mjcf.build()


def driven(size, volts, periods=150, model=MODEL, twist=(0.5, 0.0)):
    """Plant whose robots have driven with constant voltages in V, left and right."""
    plant = build([model] * size, ROBOT, 1)
    plant.reset(np.zeros((size, 3)), np.tile(twist, (size, 1)))
    for _ in range(periods):
        plant.step(np.tile([*volts, 0.0, 0.0], (size, 1)))
    return plant


@pytest.mark.parametrize("size", [1, 2])
def test_newton(size):
    """In a fast turn the forces sum to the change of the momentum, which the engine measures, less the weight."""
    plant = driven(size, (12.0, 16.0))
    data, row = mujoco.MjData(MODEL), size - 1

    def momentum():
        data.qpos[:], data.qvel[:] = plant.qpos[row], plant.qvel[row]
        mujoco.mj_forward(MODEL, data)
        mujoco.mj_subtreeVel(MODEL, data)
        return ROBOT.mass * data.subtree_linvel[MODEL.body("chassis").id]

    places, forces, slips = plant.contacts(row)
    assert places.shape == forces.shape == slips.shape == (3, 3)
    before = momentum()
    plant.step(np.tile([12.0, 16.0, 0.0, 0.0], (size, 1)))
    change = (momentum() - before) / MODEL.opt.timestep
    assert np.hypot(*change[:2]) > 10  # N
    assert forces.sum(axis=0) == pytest.approx(change + [0, 0, ROBOT.mass * GRAVITY], abs=0.05)
    assert (forces[:, 2] > 0.1 * ROBOT.mass * GRAVITY).all()
    assert places[:, 2] == pytest.approx(0, abs=1e-3)
    assert np.hypot(*slips[:, :2].T).max() < 0.01 * plant.reading["twist"][row, 0]  # tyres creep a little


def test_slip():
    """A wheel that stands while the robot glides slides with the speed of the robot, and friction brakes it."""
    plant = driven(1, (0.0, 0.0), periods=1)
    plant.qvel[0] = 0.0
    plant.qvel[0, 0] = 0.7  # m/s along x
    places, forces, slips = plant.contacts(0)
    assert slips == pytest.approx(np.tile([0.7, 0, 0], (3, 1)), abs=1e-12)
    rear = forces[abs(places[:, 1]) > 0.1]  # a front wheel that is free to turn is not braked
    assert len(rear) == 2
    assert rear[:, :2] == pytest.approx(rear[:, 2:] * [-ROBOT.tyre_friction, 0], rel=0.03, abs=0.5)


def test_wall():
    """A robot that drives into a wall is pushed back by it."""
    wall = Obstacles.from_dict({"shapes": [{"kind": "box", "x": 1.0, "length": 0.2, "width": 2.0}]})
    model, _ = mjcf.build(obstacles=wall)
    plant = build([model], ROBOT, 1, obstacles=[wall])
    plant.reset(np.zeros((1, 3)), np.array([[0.5, 0.0]]))
    for _ in range(1000):
        if not plant.stopped[0]:
            plant.step(np.array([[12.0, 12.0, 0.0, 0.0]]))
    assert plant.failure[0] == "collision"
    places, forces, _ = plant.contacts(0)
    hull = places[:, 2] > 0.02
    assert hull.any() and (forces[hull, 0] < 0).any() and (forces[~hull, 2] > 0).all()
