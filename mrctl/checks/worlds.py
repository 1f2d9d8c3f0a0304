"""Checks whether the ground of the worlds `slope`, `patch` and `rough` acts on a robot by its geometry and friction."""

# pyright: reportAttributeAccessIssue=false
# (mujoco is compiled and ships no stubs)

from __future__ import annotations

import mujoco
import numpy as np

from mrctl.checks.comparison import Report, compare
from mrctl.checks.invariants import winding
from mrctl.checks.open_loop import NO_CONTROL, Car, holding_force, loss_voltage, open_circuit, perturbed
from mrctl.checks.wheels import spinning_wheels
from mrctl.physics.mjcf import clone
from mrctl.theory.perturbation import Perturbation
from mrctl.theory.robot import GRAVITY, Robot


def slope(model: mujoco.MjModel, robot: Robot) -> Report:
    """On the 10° slope a robot with its motors disconnected rolls down with (m g sin 10° − losses)/M_e.

    The tolerance is 0.3 %, as in `coast_down`; the Coulomb losses do not change, although the load is 1.5 % smaller on
    the slope.
    """
    expected = (robot.mass * GRAVITY * np.sin(np.radians(10)) - holding_force(robot)) / robot.effective_mass
    log = Car(open_circuit(model)).drive(1.0, NO_CONTROL)
    moving = log.time > 0.2
    measured = -np.polyfit(log.time[moving], log["v"][moving], 1)[0]
    return [compare("acceleration downhill", measured, expected, "m/s²", relative=3e-3)]


def tilted_gravity(model: mujoco.MjModel, robot: Robot) -> Report:
    """`Perturbation.slope`, which tilts gravity, moves the robot as the tilted plane does.

    Both robots start 1 µm deep in the ground: if they just touched it, rounding could let one of them fall for a step.
    The tolerance is 1e-5 m on a path of 1.5 m; measured 1e-7, as the world file rounds its angle to 3e-8 rad.
    """
    level = clone(model)
    level.geom_quat[level.geom("floor").id] = 1, 0, 0, 0
    level = perturbed(level, Perturbation(slope=float(np.radians(10))))
    logs = []
    for car in (Car(model), Car(level)):
        frame = car.data.geom("floor").xmat.reshape(3, 3)
        car.data.qpos[:3] -= 1e-6 * frame[:, 2]
        log = car.drive(3.0, winding(robot))
        logs.append((log.qpos[:, :3] - log.qpos[0, :3]) @ frame)  # in the axes of the ground
    gap = np.abs(logs[0] - logs[1]).max()
    return [compare("departure from the real slope", gap, 0.0, "m", absolute=1e-5)]


def patch(model: mujoco.MjModel, robot: Robot) -> Report:
    """On the icy patch, μ = 0.1, full voltage spins the wheels; law and tolerance are those of `traction`."""
    return spinning_wheels(model, robot, 0.1, x=0.85)


def rough(model: mujoco.MjModel, robot: Robot) -> Report:
    """On rough ground the robot keeps driving and tilts no more than the bumps can tilt it.

    Bumps of 3 cm under one end of wheelbase and track tilt it by at most atan √((3/37)² + (3/38)²) ≈ 6.5°. Its speed is
    that of level ground, as ascents and descents cancel; the tolerance is 5 %, for tyres that slip and a path that is
    longer than its projection.
    """
    bump = 0.03
    volts = robot.supply / 3
    log = Car(model, pose=(-4, 0, 0)).drive(8.0, (volts, volts, 0, 0))
    tilt = np.arccos(log["upright"].min())
    bound = np.arctan(np.hypot(bump / (robot.wheelbase - robot.trail), bump / (2 * robot.half_track)))
    moving = log.time > 1.0
    v = robot.velocity_gain * (volts - loss_voltage(robot))
    return [
        compare("largest tilt", tilt, bound / 2, "rad", absolute=bound / 2),
        compare("mean speed", log["v"][moving].mean(), v, "m/s", relative=5e-2),
    ]
