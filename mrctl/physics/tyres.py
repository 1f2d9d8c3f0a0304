"""Measures how the tyres of the nominal robot depart from rolling without slip, as one would on a test bench.

MuJoCo's tyres are soft and creep a little, so the wheels do not turn by exactly the distance over the radius. A part of
the difference, 0.05 % of the radius, is constant, and an estimator finds it by itself. The rest depends on the motion;
an estimator that knows it has less error, and a consistent covariance.
"""

# pyright: reportAttributeAccessIssue=false
# (mujoco is compiled and ships no stubs)

from __future__ import annotations

import hashlib

import mujoco
import numpy as np

from mrctl.physics import mjcf
from mrctl.physics.elements import REAR
from mrctl.physics.parameters import read_robot
from mrctl.physics.readout import inputs
from mrctl.physics.stand import stand
from mrctl.theory.robot import Tyres

PUSH_ACCELERATION = 1.0  # m/s², specific force to the left while the load of the wheels is measured
PUSH_TIME = 0.5  # s, duration of the push, after which nothing moves any more
# initial speed of the measured acceleration and gain of speed, as shares of the largest speed
START_SPEED, SPEED_GAIN = 0.3, 0.2
RAMP_TIME = 1.0  # s, duration of the acceleration; the first third, in which the motors settle, is left out
_known: dict[bytes, Tyres] = {}  # measured tyres by the hash of the model


def measure(model: mujoco.MjModel) -> Tyres:
    """Measures the tyres of a robot that stands and drives on a level floor, without obstacles.

    It takes two experiments. Gravity is tilted to the side, and the depths of both contacts are read at rest. Then the
    voltage of both motors rises linearly, and the lag of the wheels is regressed on the distance and the speed.

    Args:
        model: Compiled world with the nominal robot, whose floor is level.

    Returns:
        The two constants; a model that was measured before is not measured again.
    """
    buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    key = hashlib.sha256(buffer.tobytes()).digest()  # `mjcf.digest` takes fifty times as long
    if key not in _known:
        _known[key] = _measured(mjcf.clone(model))
    return _known[key]


def _measured(model: mujoco.MjModel) -> Tyres:
    """Performs both experiments on a model, which is changed."""
    robot = read_robot(model)
    step = model.opt.timestep

    def begin(speed: float) -> mujoco.MjData:
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = stand(model, np.zeros(3), np.array([speed, 0.0]), robot)
        return data

    data = begin(0.0)
    model.opt.gravity[1] = -PUSH_ACCELERATION
    for _ in range(round(PUSH_TIME / step)):
        mujoco.mj_step(model, data)
    model.opt.gravity[1] = 0.0
    wheels = [model.geom(wheel).id for wheel in REAR]
    left, right = (data.contact.dist[(data.contact.geom == wheel).any(axis=1)].min(initial=0.0) for wheel in wheels)
    # A tyre that has sunk in by d rolls on the radius r − d/2, because the contact is in the middle of the overlap.
    load = (left - right) / 4 / robot.wheel_radius / PUSH_ACCELERATION

    data, motors = begin(START_SPEED * robot.max_speed), inputs(model)[:2]
    angles = [model.joint(wheel).qposadr[0] for wheel in REAR]
    count = round(RAMP_TIME / step)
    rows = np.empty((count, 3))
    for k in range(count):
        data.ctrl[motors] = (START_SPEED + SPEED_GAIN * k / count) * robot.max_speed / robot.velocity_gain
        mujoco.mj_step(model, data)
        rows[k] = data.qpos[0], data.qvel[0], robot.wheel_radius * data.qpos[angles].mean()
    way, speed, rolled = rows[count // 3 :].T
    terms = np.column_stack([np.ones_like(way), way, speed])
    lag = -np.linalg.lstsq(terms, rolled - way, rcond=None)[0][2]
    return Tyres(lag=float(lag), load=float(load))
