"""Reads the parameters of equations (1) to (3), and the load on each wheel, out of a compiled model."""

# pyright: reportAttributeAccessIssue=false
# (mujoco is compiled and ships no stubs)

from __future__ import annotations

import mujoco
import numpy as np

from mrctl.kernel import Array
from mrctl.physics.elements import (
    MOTORS,
    REAR,
    bodies_of,
    centres,
    fronts,
    has,
    knuckles,
    left_tyre_pairs,
    rolling_fronts,
    rounded,
)
from mrctl.physics.units import mistake, too_long
from mrctl.record import InputError
from mrctl.theory.robot import ANY_ANGLE, Robot

MAX_TRAIL_NOISE = 1e-6  # m; a smaller trail is that of vertices of a mesh, which are single precision


def read_robot(model: mujoco.MjModel, drive_gain: float = 1.0, scratch: mujoco.MjData | None = None) -> Robot:
    """Reads the parameters of equations (1) to (3) out of a compiled model, by element name; it takes a millisecond.

    The front wheel's frictionloss is rolling loss alone and gives the rolling coefficient, which is 0 for a caster that
    slides. A rear wheel's frictionloss is the sum of rolling loss, no-load loss and gearbox loss, and gives the gearbox
    loss. Its joint's damping and its motor's, times gear², add to the viscous friction. Equation (3) has one motor:
    where the two differ, their mean constant, resistance, loss and viscous friction stand for both, as do the left
    one's gear, rotor inertia, inductance and supply, and the left wheel's inertia.

    Args:
        model: Compiled model.
        drive_gain: Applied volts per commanded volt. A model holds only the range of the applied volts, which `perturb`
            widens by a gain above one.
        scratch: As for `at_rest`.

    Raises:
        InputError: A parameter is out of range, there is no gravity, the centre of mass lies outside the wheels, or a
            rear wheel's frictionloss is smaller than its rolling and no-load losses.
    """
    if gravity(model) == 0:
        raise InputError("gravity: is zero, so that the wheels bear no load")
    data, com = at_rest(model, scratch)
    bodies = bodies_of(model)
    masses, positions = model.body_mass[bodies], data.xipos[bodies, :2]
    inertia = np.sum(masses[:, None] * (positions - np.average(positions, axis=0, weights=masses)) ** 2)
    for body in bodies:
        up = data.ximat[body].reshape(3, 3)[2]
        inertia += up**2 @ model.body_inertia[body]
    radius = np.mean([model.geom(wheel).size[0] for wheel in REAR])
    half_track, wheelbase, trail = _layout(model, data)
    front_wheels = rolling_fronts(model)
    motor = model.actuator("motor_left")
    resistance, constant = model.actuator_gainprm[[model.actuator(name).id for name in MOTORS], :2].mean(axis=0)
    gear = motor.gear[0]
    viscous = model.dof_damping[[model.joint(wheel).dofadr[0] for wheel in REAR]]
    viscous = viscous + gear**2 * model.actuator_damping[[model.actuator(name).id for name in MOTORS]]
    no_load = model.numeric("no_load_current").data[0]
    load = load_torques(model, data)
    if min(load.values()) <= 0:
        found = (
            f"com_offset: the centre of mass must lie over the triangle of the wheels; it lies {1e3 * com[0]:.4g} mm "
            f"ahead of the driven axle and {1e3 * com[1]:.4g} mm to the left, and the front wheel or caster touches "
            f"the ground {1e3 * (wheelbase - trail):.4g} mm ahead"
        )
        raise InputError("; ".join(filter(None, (found, too_long(model, half_track)))))
    rolling = 0.0
    if front_wheels:
        losses = sum(model.joint(wheel).frictionloss[0] for wheel in front_wheels)
        rolling = losses / sum(load[wheel] for wheel in front_wheels)
    drives = [model.joint(wheel).frictionloss[0] - rolling * load[wheel] for wheel in REAR]
    gear_loss = np.mean(drives) - gear * constant * no_load
    limits = model.numeric("limits").data
    parameters = {
        "mass": masses.sum(),
        "yaw_inertia": inertia,
        "com_offset": com[0],
        "com_height": com[2] + radius,
        "wheel_radius": radius,
        "front_wheel_radius": model.geom(fronts(model)[0]).size[0],
        "half_track": half_track,
        "wheelbase": wheelbase,
        "trail": trail,
        "steering_limit": model.joint("steering").range[1] if has(model, "joint", "steering") else ANY_ANGLE,
        **_steering(model, data),
        "resistance": resistance,
        "inductance": _inductance(model),
        "torque_constant": constant,
        "gear_ratio": gear,
        "rotor_inertia": model.actuator_armature[motor.id],
        "no_load_current": no_load,
        "gear_loss": max(0.0, gear_loss),
        "wheel_damping": viscous.mean(),
        "rolling_coefficient": rolling,
        "wheel_inertia": _spin_inertia(model, "wheel_left"),
        "front_wheel_inertia": sum(_spin_inertia(model, wheel) for wheel in front_wheels),
        "supply": model.actuator_ctrlrange[model.actuator_ctrladr[motor.id], 1] / max(1.0, drive_gain),
        "drive_gain": drive_gain,
        "tyre_friction": model.pair_friction[left_tyre_pairs(model)[0], 0],
        "gravity": gravity(model),
        "max_speed": limits[0],
        "max_rotation": limits[1],
        "max_acceleration": limits[2],
        "max_rotation_acceleration": limits[3],
    }
    try:
        robot = Robot.from_dict(parameters, "robot")
    except InputError as error:
        raise InputError("; ".join(filter(None, (str(error), too_long(model, half_track))))) from None
    if gear_loss < -1e-9:
        wrong = mistake(model, robot)
        reason = f"; {wrong.text}" if wrong else ""
        has_loss = np.mean([model.joint(wheel).frictionloss[0] for wheel in REAR])
        raise InputError(
            f"frictionloss: a rear wheel's, {has_loss:.3g} N·m, is smaller than its rolling and no-load losses of "
            f"{has_loss - gear_loss:.3g} N·m; the rolling loss follows from the frictionloss and the load of the front "
            f"wheels{reason}"
        )
    return robot


def at_rest(model: mujoco.MjModel, scratch: mujoco.MjData | None = None) -> tuple[mujoco.MjData, Array]:
    """Computes the kinematics of the robot as its file places it.

    Args:
        model: Compiled model.
        scratch: Data of a model of the same size, which is overwritten; new data would take longer than all the rest.

    Returns:
        The model's data at that state, and the robot's centre of mass relative to P in the chassis' frame in m, `(3,)`.
    """
    data = scratch or mujoco.MjData(model)
    data.qpos[:] = model.qpos0
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    bodies, chassis = bodies_of(model), data.body("chassis")
    com = np.average(data.xipos[bodies], axis=0, weights=model.body_mass[bodies])
    return data, chassis.xmat.reshape(3, 3).T @ (com - chassis.xpos)


def gravity(model: mujoco.MjModel) -> float:
    """Returns the gravitational acceleration in m/s²; rounded, because a slope turns its vector."""
    return float(np.round(np.linalg.norm(model.opt.gravity), 12))


def _layout(model: mujoco.MjModel, data: mujoco.MjData) -> tuple[float, float, float]:
    """Returns half track, wheelbase and trail in m; the data holds the kinematics of the robot at rest."""
    (left, right), front = centres(model, data, REAR)[:, 1], centres(model, data, fronts(model))[:, 0].mean()
    axis = front
    if has(model, "joint", "steering"):
        chassis = data.body("chassis")
        axis = rounded(chassis.xmat.reshape(3, 3).T @ (data.joint("steering").xanchor - chassis.xpos))[0]
    trail = 0.0 if abs(axis - front) < MAX_TRAIL_NOISE else float(rounded(axis - front))
    if trail < 0:
        raise InputError(
            f"steering: the wheel stands {-1e3 * trail:.4g} mm ahead of its steering axis, which gives it no trail; "
            "move it onto the axis or behind it"
        )
    return (left - right) / 2, float(axis), trail


def _steering(model: mujoco.MjModel, data: mujoco.MjData) -> dict[str, float]:
    """Returns those parameters of a `Robot` that describe its steering; the data holds the kinematics at rest.

    Two steered wheels are referred to the rack by the ratios of the linkage near straight on, and their inertias add to
    its own.
    """
    if not has(model, "joint", "steering"):
        return {}
    rack = model.joint("steering")
    ratios = {rack.id: 1.0}
    for knuckle in knuckles(model):
        ratios[model.joint(knuckle).id] = model.equality(knuckle).data[1]
    stiffness, damping = -model.actuator("steering").biasprm[1:3]
    inertia, moment = 0.0, np.zeros(())
    for joint, ratio in ratios.items():
        dof, carrier = model.jnt_dofadr[joint], model.jnt_bodyid[joint]
        damping += ratio**2 * model.dof_damping[dof]
        inertia += ratio**2 * model.dof_M0[dof]
        behind = (data.xanchor[joint] - data.subtree_com[carrier]) @ data.body("chassis").xmat.reshape(3, 3)[:, 0]
        moment += ratio * model.body_subtreemass[carrier] * behind
    return {
        "steering_stiffness": stiffness,
        "steering_damping": damping,
        "fork_inertia": inertia,
        "fork_moment": float(rounded(moment)),
    }


def load_torques(model: mujoco.MjModel, scratch: mujoco.MjData | None = None) -> dict[str, float]:
    """Returns the static load on each wheel times its radius in N·m, by geom name.

    The load follows from the lever rule on level ground. It is not positive where the robot would tip over.

    Args:
        model: Compiled model.
        scratch: As for `at_rest`.
    """
    data, com = at_rest(model, scratch)
    half_track, wheelbase, trail = _layout(model, data)
    front, side = com[0] / (wheelbase - trail), com[1] / (2 * half_track)
    shares = {"wheel_left": (1 - front) / 2 + side, "wheel_right": (1 - front) / 2 - side}
    shares |= {wheel: front / len(fronts(model)) for wheel in fronts(model)}
    weight = gravity(model) * model.body_mass[bodies_of(model)].sum()
    return {wheel: float(weight * share * model.geom(wheel).size[0]) for wheel, share in shares.items()}


def _spin_inertia(model: mujoco.MjModel, wheel: str) -> float:
    """Returns the inertia of a wheel about its axle in kg·m², with the joint's armature but without the motor's."""
    body, joint = model.body(wheel), model.joint(wheel)
    frame = np.zeros(9)
    mujoco.mju_quat2Mat(frame, body.iquat)
    axis = frame.reshape(3, 3).T @ joint.axis
    return float(axis**2 @ body.inertia + joint.armature[0])


def _inductance(model: mujoco.MjModel) -> float:
    """Returns the armature inductance in H; MuJoCo stores L/R in s as a motor's first dynamics parameter."""
    motor = model.actuator("motor_left")
    return float(model.actuator_dynprm[motor.id, 0] * motor.gainprm[0])
