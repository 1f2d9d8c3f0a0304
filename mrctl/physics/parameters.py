"""Reads the parameters of equations (1) to (3) out of a compiled model."""

# pyright: reportAttributeAccessIssue=false
# (mujoco is compiled and ships no stubs)

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from mrctl.physics.elements import REAR, bodies_of, centres, fronts, has, rolling_fronts, rounded, tyre_pairs
from mrctl.record import InputError
from mrctl.theory.robot import ANY_ANGLE, GRAVITY, Robot


def read_robot(model: mujoco.MjModel, drive_gain: float = 1.0) -> Robot:
    """Reads the parameters of equations (1) to (3) out of a compiled model, by element name.

    The rolling coefficient follows from the front wheel's frictionloss (nothing else brakes that wheel; a caster that
    slides has none); what is left of a rear wheel's frictionloss after rolling and no-load loss is the gearbox.

    Raises:
        InputError: A value that `Robot` refuses, or a rear frictionloss below rolling and no-load loss.
    """
    data, com = at_rest(model)
    bodies = bodies_of(model)
    masses, centres = model.body_mass[bodies], data.xipos[bodies, :2]
    inertia = np.sum(masses[:, None] * (centres - np.average(centres, axis=0, weights=masses)) ** 2)
    for body in bodies:
        up = data.ximat[body].reshape(3, 3)[2]
        inertia += up**2 @ model.body_inertia[body]
    radius = np.mean([model.geom(wheel).size[0] for wheel in REAR])
    half_track, wheelbase, trail = _layout(model, data)
    front = fronts(model)
    turning = rolling_fronts(model)
    motor = model.actuator("motor_left")
    gear, constant = motor.gear[0], motor.gainprm[1]
    no_load = model.numeric("no_load_current").data[0]
    load = load_torques(model)
    if min(load.values()) <= 0:
        raise InputError("com_offset: the centre of mass must lie over the triangle of the wheels")
    rolling = 0.0
    if turning:
        rolling = sum(model.joint(f).frictionloss[0] for f in turning) / sum(load[f] for f in turning)
    drives = [model.joint(wheel).frictionloss[0] - rolling * load[wheel] for wheel in REAR]
    gear_loss = np.mean(drives) - gear * constant * no_load
    if gear_loss < -1e-9:
        raise InputError("frictionloss: a rear wheel's is smaller than its rolling and no-load losses")
    limits = model.numeric("limits").data
    return Robot.from_dict(
        {
            "mass": masses.sum(),
            "yaw_inertia": inertia,
            "com_offset": com[0],
            "com_height": com[2] + radius,
            "wheel_radius": radius,
            "front_wheel_radius": model.geom(front[0]).size[0],
            "half_track": half_track,
            "wheelbase": wheelbase,
            "trail": trail,
            "steering_limit": model.joint("steering").range[1] if has(model, "joint", "steering") else ANY_ANGLE,
            "resistance": motor.gainprm[0],
            "inductance": _inductance(model),
            "torque_constant": constant,
            "gear_ratio": gear,
            "rotor_inertia": model.actuator_armature[motor.id],
            "no_load_current": no_load,
            "gear_loss": max(0.0, gear_loss),
            "rolling_coefficient": rolling,
            "wheel_inertia": _spin_inertia(model, "wheel_left"),
            "front_wheel_inertia": sum(_spin_inertia(model, wheel) for wheel in turning),
            "supply": model.actuator_ctrlrange[model.actuator_ctrladr[motor.id], 1],
            "drive_gain": drive_gain,
            "tyre_friction": model.pair_friction[tyre_pairs(model)[0], 0],
            "max_speed": limits[0],
            "max_rotation": limits[1],
            "max_acceleration": limits[2],
            "max_rotation_acceleration": limits[3],
        },
        "robot",
    )



def at_rest(model: mujoco.MjModel) -> tuple[mujoco.MjData, NDArray[np.float64]]:
    """Kinematics as the file places the robot, and its centre of mass from P in the chassis' frame, `(3,)` in m."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    bodies, chassis = bodies_of(model), data.body("chassis")
    com = np.average(data.xipos[bodies], axis=0, weights=model.body_mass[bodies])
    return data, chassis.xmat.reshape(3, 3).T @ (com - chassis.xpos)



def _layout(model: mujoco.MjModel, data: mujoco.MjData) -> tuple[float, float, float]:
    """Half track, wheelbase and trail in m."""
    (left, right), front = centres(model, data, REAR)[:, 1], centres(model, data, fronts(model))[:, 0].mean()
    axis = front
    if has(model, "joint", "steering"):
        chassis = data.body("chassis")
        axis = rounded(chassis.xmat.reshape(3, 3).T @ (data.joint("steering").xanchor - chassis.xpos))[0]
    return (left - right) / 2, float(axis), float(rounded(axis - front))



def load_torques(model: mujoco.MjModel) -> dict[str, float]:
    """Static load on each wheel times its radius in N·m, by the lever rule on level ground."""
    data, com = at_rest(model)
    half_track, wheelbase, trail = _layout(model, data)
    front, side = com[0] / (wheelbase - trail), com[1] / (2 * half_track)
    shares = {"wheel_left": (1 - front) / 2 + side, "wheel_right": (1 - front) / 2 - side}
    shares |= {wheel: front / len(fronts(model)) for wheel in fronts(model)}
    weight = GRAVITY * model.body_mass[bodies_of(model)].sum()
    return {wheel: float(weight * share * model.geom(wheel).size[0]) for wheel, share in shares.items()}



def _spin_inertia(model: mujoco.MjModel, wheel: str) -> float:
    """Inertia of a wheel about its own axle, with the joint's armature but not the motor's."""
    body, joint = model.body(wheel), model.joint(wheel)
    frame = np.zeros(9)
    mujoco.mju_quat2Mat(frame, body.iquat)
    axis = frame.reshape(3, 3).T @ joint.axis
    return float(axis**2 @ body.inertia + joint.armature[0])



def _inductance(model: mujoco.MjModel) -> float:
    """Armature inductance; MuJoCo keeps the electrical time constant L/R as the first dynamics parameter."""
    motor = model.actuator("motor_left")
    return float(model.actuator_dynprm[motor.id, 0] * motor.gainprm[0])
