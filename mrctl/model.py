"""MJCF in, compiled model out; reads a `Robot` from it, applies a `Perturbation` to it, stands it on the ground."""

# pyright: reportAttributeAccessIssue=false
# (mujoco is compiled and ships no stubs)

from __future__ import annotations

import copy
import hashlib
from collections.abc import Mapping, Sequence
from inspect import getmembers
from pathlib import Path
from typing import Literal, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from mrctl import adopt
from mrctl.adopt import FRONTS, MOTORS, REAR, SHIPPED, find, has, models_folder
from mrctl.kinematics import scrub_free_angle
from mrctl.record import InputError
from mrctl.robot import ANY_ANGLE, CAR, GRAVITY, Perturbation, Robot, RobotFile

Steering = Literal["compliant", "caster", "rigid"]
Fields = dict[str, NDArray]

STEERINGS: tuple[Steering, ...] = ("compliant", "caster", "rigid")
# Elements that the robot of a world must name; `load_robot` names those of any other.
REQUIRED = {
    "body": ("chassis", "wheel_left", "wheel_right", "fork", "front_wheel"),
    "joint": ("chassis", "wheel_left", "wheel_right", "steering", "front_wheel"),
    "geom": ("wheel_left", "wheel_right", "front_wheel"),
    "actuator": (*MOTORS, "steering"),
}
NUMERICS = {"no_load_current": 1, "limits": 4}  # and how many values they hold


def world_path(world: str) -> Path:
    """The file of a world: one of the shipped names, or a path that ends in `.xml`.

    Raises:
        InputError: No such file; the message lists the shipped worlds.
    """
    if world in SHIPPED:
        raise InputError(f"world: {world} is a robot; name it as robot.path")
    path = find(world)
    if not path.is_file():
        others = (*SHIPPED, "scenery")
        shipped = ", ".join(sorted(p.stem for p in models_folder().glob("*.xml") if p.stem not in others))
        raise InputError(f"world: no file {path}; shipped worlds: {shipped}")
    return path


def load(
    world: str = "flat",
    steering: Steering = "compliant",
    timestep: float | None = None,
    robot: RobotFile = CAR,
) -> mujoco.MjModel:
    """Compiles a world with the robot in one of the three steering arrangements.

    Args:
        world: `flat`, `slope`, `rough`, `patch`, or the path of an MJCF file.
        steering: `compliant` is the MJCF as it stands; `caster` and `rigid` take their stiffness, damping and trail
            from the model's numerics `steering_caster` and `steering_rigid`. A robot that is not the world's own has
            one arrangement: see `steerings`.
        timestep: Time step of the physics in s; by default the file's own.
        robot: Whose robot drives there; by default the world's own.

    Raises:
        InputError: The file is missing, does not compile, lacks a named element, or holds a robot that makes no sense.
    """
    path = world_path(world)
    foreign = None if robot == CAR else adopt.compiled(robot, path)
    source = path if foreign is None else adopt.robot_path(robot)
    try:
        model = foreign or mujoco.MjModel.from_xml_path(str(path))
        offered = steerings(model)
        if foreign and steering not in offered:
            raise InputError(f"steering: {robot.path} is driven with {' or '.join(offered)}, not {steering}")
        _complete(model, steering)
        if foreign:
            _limit(model)
        nominal = read_robot(model)
        if steering != "compliant" and len(offered) > 1:
            _rearrange(model, nominal, steering)
    except ValueError as error:
        raise InputError(f"{source}: {' '.join(str(error).split())}") from None
    if timestep is not None:
        model.opt.timestep = timestep
    return model


def load_robot(
    path: str | Path, wheels: Sequence[str] = (), steering: str | Sequence[str] = (), chassis: str = ""
) -> RobotFile:
    """Names the robot of any MJCF file for `Scenario.robot`, after trying it on a level floor.

    Two wheels must be driven by a `<dcmotor>` each, whose `ctrlrange` is the supply. One wheel may be steered, or two
    by Ackermann's geometry, by a `<position>` or `<pid>` actuator; without, it is a differential drive, and what else
    touches the floor is its caster, without friction unless it rolls. The file's own floor is left out, and wheels roll
    on spheres of their radius.

    Args:
        path: `turtlebot`, `racecar`, or an MJCF file.
        wheels: Joints of the two driven wheels; by default the two with a `<dcmotor>`.
        steering: Joint or joints of what is steered; by default the upright ones with an actuator.
        chassis: The body that carries them; by default the root.

    Raises:
        InputError: One line that says what is missing or ambiguous, or cannot be.
    """
    steered = (steering,) if isinstance(steering, str) else tuple(steering)
    values = {"path": str(path), "wheels": tuple(wheels), "steering": steered, "chassis": chassis}
    robot = RobotFile.from_dict(values, "robot")
    load(steering=arrangement(robot), robot=robot)
    return robot


def arrangement(robot: RobotFile) -> Steering:
    """The steering arrangement that a robot is driven with unless one asks for another.

    Raises:
        InputError: As `load`.
    """
    return "compliant" if robot == CAR else steerings(adopt.compiled(robot, world_path("flat")))[0]


def steerings(model: mujoco.MjModel) -> tuple[Steering, ...]:
    """The arrangements that a compiled robot can be driven with, its own first.

    A differential drive is `caster`: the torque difference alone makes θ̇. An adopted robot whose wheels are held by
    servos is `rigid`. The default robot has all three.
    """
    if not has(model, "joint", "steering"):
        return ("caster",)
    return ("rigid",) if has(model, "text", adopt.RIGID) else STEERINGS


def reverses(model: mujoco.MjModel, steering: Steering) -> bool:
    """Whether a robot can be driven backwards: a trailing fork would jackknife."""
    return steering == "rigid" or not has(model, "joint", "steering")


def _limit(model: mujoco.MjModel) -> None:
    """Gives a robot whose file has no numeric `limits` some, from its motors and its grip.

    With the default robot's numbers they come out near its own: 64 % of the no-load speed, a sixth of the acceleration
    at stall, a fifth (along) and half (across) of the tyres' grip.
    """
    if np.any(model.numeric("limits").data):
        return
    model.numeric("limits").data[:] = 1.0
    robot = read_robot(model)
    grip = robot.tyre_friction * GRAVITY
    speed = 0.64 * robot.velocity_gain * robot.supply
    rotation = min(0.4 * speed / robot.half_track, 0.5 * grip / speed)
    if robot.steering_limit < ANY_ANGLE:
        rotation = min(rotation, 0.5 * speed * np.tan(robot.steering_limit) / robot.wheelbase)
    stall = 2 * robot.motor_gain * robot.supply / robot.wheel_radius / robot.effective_mass
    acceleration = min(stall / 6, 0.2 * grip)
    model.numeric("limits").data[:] = speed, rotation, acceleration, 2 * rotation * acceleration / speed


def _complete(model: mujoco.MjModel, steering: Steering) -> None:
    """Refuses a model without the elements that the rest of this module reads by name.

    Raises:
        InputError: The first that is missing or of another kind.
    """
    arranged = steering == "compliant" or len(steerings(model)) == 1
    numerics = NUMERICS if arranged else NUMERICS | {f"steering_{steering}": 3}
    required = REQUIRED if not fronts(model) or has(model, "geom", "front_wheel") else {}
    for kind, names in (*required.items(), ("numeric", numerics)):
        for name in names:
            try:
                getattr(model, kind)(name)
            except KeyError:
                raise InputError(f"no {kind} named {name!r}") from None
    for name, count in numerics.items():
        if model.numeric(name).data.shape != (count,):
            raise InputError(f"numeric {name} needs {count} value{'s' * (count > 1)}")
    for name in MOTORS:
        if model.actuator(name).gaintype != mujoco.mjtGain.mjGAIN_DCMOTOR:
            raise InputError(f"actuator {name} must be a <dcmotor>")
    if required and model.actuator_ctrlnum[model.actuator("steering").id] != 2:
        raise InputError("actuator steering must be a <pid> with position and velocity inputs")
    if not _tyre_pairs(model):
        raise InputError("no contact pair between the wheels and a floor")


def _rearrange(model: mujoco.MjModel, robot: Robot, steering: Steering) -> None:
    """Gives the fork another stiffness, damping and trail; rolling losses follow the load that the trail moves."""
    before = _load_torques(model)
    stiffness, damping, trail = model.numeric(f"steering_{steering}").data
    model.actuator("steering").biasprm[1:3] = -stiffness, -damping
    model.body("front_wheel").pos[0] = -trail
    for wheel, torque in _load_torques(model).items():
        model.joint(wheel).frictionloss[0] += robot.rolling_coefficient * (torque - before[wheel])
    mujoco.mj_setConst(model, mujoco.MjData(model))


def read_robot(model: mujoco.MjModel, drive_gain: float = 1.0) -> Robot:
    """Reads the parameters of equations (1) to (3) out of a compiled model, by element name.

    The rolling coefficient follows from the front wheel's frictionloss (nothing else brakes that wheel; a caster that
    slides has none); what is left of a rear wheel's frictionloss after rolling and no-load loss is the gearbox.

    Raises:
        InputError: A value that `Robot` refuses, or a rear frictionloss below rolling and no-load loss.
    """
    data, com = _at_rest(model)
    bodies = _bodies(model)
    masses, centres = model.body_mass[bodies], data.xipos[bodies, :2]
    inertia = np.sum(masses[:, None] * (centres - np.average(centres, axis=0, weights=masses)) ** 2)
    for body in bodies:
        up = data.ximat[body].reshape(3, 3)[2]
        inertia += up**2 @ model.body_inertia[body]
    radius = np.mean([model.geom(wheel).size[0] for wheel in REAR])
    half_track, wheelbase, trail = _layout(model, data)
    front = fronts(model)
    rolling_fronts = _rolling(model)
    motor = model.actuator("motor_left")
    gear, constant = motor.gear[0], motor.gainprm[1]
    no_load = model.numeric("no_load_current").data[0]
    load = _load_torques(model)
    if min(load.values()) <= 0:
        raise InputError("com_offset: the centre of mass must lie over the triangle of the wheels")
    rolling = 0.0
    if rolling_fronts:
        rolling = sum(model.joint(f).frictionloss[0] for f in rolling_fronts) / sum(load[f] for f in rolling_fronts)
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
            "front_wheel_inertia": sum(_spin_inertia(model, wheel) for wheel in rolling_fronts),
            "supply": model.actuator_ctrlrange[model.actuator_ctrladr[motor.id], 1],
            "drive_gain": drive_gain,
            "tyre_friction": model.pair_friction[_tyre_pairs(model)[0], 0],
            "max_speed": limits[0],
            "max_rotation": limits[1],
            "max_acceleration": limits[2],
            "max_rotation_acceleration": limits[3],
        },
        "robot",
    )


def _bodies(model: mujoco.MjModel) -> list[int]:
    """The bodies of the robot."""
    chassis = model.body("chassis").id
    return [body for body in range(model.nbody) if model.body_rootid[body] == chassis]


def _at_rest(model: mujoco.MjModel) -> tuple[mujoco.MjData, NDArray[np.float64]]:
    """Kinematics as the file places the robot, and its centre of mass from P in the chassis' frame, `(3,)` in m."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    bodies, chassis = _bodies(model), data.body("chassis")
    com = np.average(data.xipos[bodies], axis=0, weights=model.body_mass[bodies])
    return data, chassis.xmat.reshape(3, 3).T @ (com - chassis.xpos)


def fronts(model: mujoco.MjModel) -> list[str]:
    """What else the robot stands on: geoms of one front wheel, of two, or of casters."""
    return [name for name in FRONTS if has(model, "geom", name)]


def _rolling(model: mujoco.MjModel) -> list[str]:
    """Those of `fronts` that roll instead of sliding."""
    return [name for name in fronts(model) if has(model, "joint", name)]


def centres(model: mujoco.MjModel, data: mujoco.MjData, wheels: Sequence[str]) -> NDArray[np.float64]:
    """Centres of wheels from P in the chassis' frame, `(n, 3)` in m, to the picometre."""
    chassis = data.body("chassis")
    return np.array([_round(chassis.xmat.reshape(3, 3).T @ (data.geom(w).xpos - chassis.xpos)) for w in wheels])


def _round(position: NDArray) -> NDArray:
    return np.round(position, 12)  # 0.40 − 0.37 is 0.03


def _layout(model: mujoco.MjModel, data: mujoco.MjData) -> tuple[float, float, float]:
    """Half track, wheelbase and trail in m."""
    (left, right), front = centres(model, data, REAR)[:, 1], centres(model, data, fronts(model))[:, 0].mean()
    axis = front
    if has(model, "joint", "steering"):
        chassis = data.body("chassis")
        axis = _round(chassis.xmat.reshape(3, 3).T @ (data.joint("steering").xanchor - chassis.xpos))[0]
    return (left - right) / 2, float(axis), float(_round(axis - front))


def _load_torques(model: mujoco.MjModel) -> dict[str, float]:
    """Static load on each wheel times its radius in N·m, by the lever rule on level ground."""
    data, com = _at_rest(model)
    half_track, wheelbase, trail = _layout(model, data)
    front, side = com[0] / (wheelbase - trail), com[1] / (2 * half_track)
    shares = {"wheel_left": (1 - front) / 2 + side, "wheel_right": (1 - front) / 2 - side}
    shares |= {wheel: front / len(fronts(model)) for wheel in fronts(model)}
    weight = GRAVITY * model.body_mass[_bodies(model)].sum()
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


def _tyre_pairs(model: mujoco.MjModel) -> list[int]:
    """The contact pairs of the rear left wheel, the named tyre pair first."""
    wheel = model.geom("wheel_left").id
    pairs = [p for p in range(model.npair) if wheel in (model.pair_geom1[p], model.pair_geom2[p])]
    return sorted(pairs, key=lambda p: model.pair(p).name != "tyre_left")


def perturb(nominal: mujoco.MjModel, model: mujoco.MjModel, perturbation: Perturbation) -> None:
    """Writes `nominal` changed by `perturbation` into `model`, a copy of it, and the constants that follow.

    Rolling losses follow the load: a wheel's share of frictionloss that is rolling grows with the static load on it.
    Supply, delay and noise are no fields of a model; `mrctl.plant` and `mrctl.measurement` apply them.

    Raises:
        InputError: The perturbed robot could not stand (centre of mass outside its wheels or below the ground).
    """
    p = perturbation
    base = read_robot(nominal)
    chassis, bodies = nominal.body("chassis").id, _bodies(nominal)
    model.body_mass[:] = nominal.body_mass
    model.body_inertia[:] = nominal.body_inertia
    model.body_mass[bodies] *= p.mass_factor
    model.body_inertia[bodies] *= p.mass_factor
    model.body_inertia[chassis, _upright_axis(nominal, chassis)] *= p.inertia_factor
    model.body_ipos[chassis] = nominal.body_ipos[chassis]
    model.body_iquat[chassis] = nominal.body_iquat[chassis]
    if p.payload > 0:
        at = np.array([p.payload_x, p.payload_y, p.payload_z - base.wheel_radius])
        _add_point_mass(model, chassis, p.payload, at)
    for wheel, factor in (("wheel_left", p.left_radius_factor), ("wheel_right", p.right_radius_factor)):
        geom = nominal.geom(wheel).id
        model.geom_size[geom] = nominal.geom_size[geom] * factor
        model.geom_rbound[geom] = nominal.geom_rbound[geom] * factor
        model.geom_aabb[geom] = nominal.geom_aabb[geom] * factor
    motors = [nominal.actuator(name).id for name in MOTORS]
    model.actuator_gainprm[motors] = nominal.actuator_gainprm[motors]
    model.actuator_gainprm[motors, 0] *= p.resistance_factor
    model.actuator_gainprm[motors, 1] *= p.motor_constant_factor
    # A dcmotor keeps L/R: the winding's inductance is the same behind another resistance.
    model.actuator_dynprm[motors] = nominal.actuator_dynprm[motors]
    model.actuator_dynprm[motors, 0] /= p.resistance_factor
    inputs = nominal.actuator_ctrladr[motors]
    model.actuator_ctrlrange[inputs] = nominal.actuator_ctrlrange[inputs] * max(1.0, p.supply_factor)
    # The no-load torque k_M I_0 is part of the losses: it grows with them, not with the motor constant.
    no_load = nominal.numeric("no_load_current").data * p.drive_friction_factor / p.motor_constant_factor
    model.numeric("no_load_current").data[:] = no_load
    model.pair_friction[:] = nominal.pair_friction
    model.pair_friction[:, :2] *= p.tyre_friction_factor
    model.pair_friction[_tyre_pairs(nominal), :2] *= p.left_tyre_friction_factor
    gx, gy, gz = nominal.opt.gravity
    c, s = np.cos(p.slope), np.sin(p.slope)
    model.opt.gravity[:] = c * gx + s * gz, gy, c * gz - s * gx
    before, after = _load_torques(nominal), _load_torques(model)
    if min(after.values()) <= 0:
        raise InputError("perturbation.payload: the centre of mass lies outside the wheels, the robot would tip over")
    height = _at_rest(model)[1][2] + np.mean([model.geom(wheel).size[0] for wheel in REAR])
    if height < 0:
        raise InputError("perturbation.payload_z: the centre of mass lies below the ground")
    for wheel in (*REAR, *_rolling(nominal)):
        dof = nominal.joint(wheel).dofadr[0] + np.arange(len(nominal.joint(wheel).frictionloss))
        drive = 0.0 if wheel not in REAR else base.drive_loss * (p.drive_friction_factor - 1)
        rolling = base.rolling_coefficient * (after[wheel] - before[wheel])
        model.dof_frictionloss[dof] = nominal.dof_frictionloss[dof] + drive + rolling
    mujoco.mj_setConst(model, mujoco.MjData(model))


def _upright_axis(model: mujoco.MjModel, body: int) -> int:
    """Which principal axis of a body is nearest to its frame's vertical."""
    frame = np.zeros(9)
    mujoco.mju_quat2Mat(frame, model.body_iquat[body])
    return int(np.argmax(np.abs(frame[6:])))


def _add_point_mass(model: mujoco.MjModel, body: int, mass: float, at: NDArray) -> None:
    """Adds a point mass to a body's inertial frame: parallel axes, then principal axes again."""
    own = model.body_mass[body]
    frame = np.zeros(9)
    mujoco.mju_quat2Mat(frame, model.body_iquat[body])
    frame = frame.reshape(3, 3)
    centre = model.body_ipos[body].copy()
    total = own + mass
    joint = (own * centre + mass * at) / total
    tensor = frame * model.body_inertia[body] @ frame.T
    for m, position in ((own, centre), (mass, at)):
        d = position - joint
        tensor = tensor + m * (d @ d * np.eye(3) - np.outer(d, d))
    principal, axes = np.linalg.eigh(tensor)
    if np.linalg.det(axes) < 0:
        axes[:, 0] *= -1
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, axes.ravel())
    model.body_mass[body] = total
    model.body_ipos[body] = joint
    model.body_inertia[body] = principal
    model.body_iquat[body] = quat


# Everything that `perturb` and the constants after it can change, as `mujoco.batch` names the fields.
PERTURBED = (
    "body_mass",
    "body_inertia",
    "body_ipos",
    "body_iquat",
    "geom_size",
    "geom_rbound",
    "geom_aabb",
    "actuator_gainprm",
    "actuator_dynprm",
    "actuator_ctrlrange",
    "pair_friction",
    "dof_frictionloss",
    "numeric_data",
    "opt.gravity",
)


def fields(model: mujoco.MjModel) -> Fields:
    """Copies of the fields named in `PERTURBED`."""
    return {name: np.array(_get(model, name)) for name in PERTURBED}


def _get(model: mujoco.MjModel, name: str) -> NDArray:
    return getattr(model.opt, name[4:]) if name.startswith("opt.") else getattr(model, name)


def write(model: mujoco.MjModel, values: Mapping[str, NDArray]) -> None:
    """Writes `fields` back and recomputes the constants that follow from them."""
    for name, value in values.items():
        _get(model, name)[...] = value
    mujoco.mj_setConst(model, mujoco.MjData(model))


class State(NamedTuple):
    """Generalised positions `(nq,)` and velocities `(nv,)` of one robot."""

    qpos: NDArray[np.float64]
    qvel: NDArray[np.float64]


def stand(model: mujoco.MjModel, pose: NDArray, twist: NDArray, robot: Robot | None = None) -> State:
    """Stands the robot with its wheels on the ground, rolling with a given twist.

    Rays find the ground under the driven wheels and in the middle under the others; the plane through those three
    points decides height, roll and pitch.

    Args:
        model: Compiled world.
        pose: Posture `(3,)` of P in m, m, rad.
        twist: V in m/s and θ̇ in rad/s, `(2,)`.
        robot: What `read_robot` makes of the model, where that is known.

    Raises:
        InputError: There is no ground below the pose.
    """
    robot = robot or read_robot(model)
    data = mujoco.MjData(model)
    x, y, theta = pose
    ahead, left = np.array([np.cos(theta), np.sin(theta)]), np.array([-np.sin(theta), np.cos(theta)])
    steering = float(np.clip(scrub_free_angle(twist, robot), -robot.steering_limit, robot.steering_limit))
    reach = robot.wheelbase - robot.trail * np.cos(steering)
    aside = -robot.trail * np.sin(steering)
    floor = np.array(
        [
            ground(model, data, *(np.array([x, y]) + offset))
            for offset in (robot.half_track * left, -robot.half_track * left, reach * ahead + aside * left)
        ]
    )
    normal = np.cross(floor[1] - floor[0], floor[2] - floor[0])
    normal /= np.linalg.norm(normal) * np.sign(normal[2])
    # Distances from that plane: each wheel's centre at its radius. In the body frame the rear centres are (0, ±D, 0).
    radius_left, radius_right = model.geom("wheel_left").size[0], model.geom("wheel_right").size[0]
    height = (radius_left + radius_right) / 2
    up = np.array([0.0, (radius_left - radius_right) / (2 * robot.half_track), 1.0])
    mujoco.mj_kinematics(model, data)
    front = fronts(model)
    centre = np.array([reach, aside, centres(model, data, front)[:, 2].mean()])
    for _ in range(8):
        up[2] = np.sqrt(1 - up[0] ** 2 - up[1] ** 2)
        up[0] = (robot.front_wheel_radius - height - up[1:] @ centre[1:]) / centre[0]
    # World from body: `up` becomes `normal`, and body x rises so that it lies over the heading.
    slope = normal[:2] @ ahead
    rise = np.arcsin(up[0] / np.hypot(slope, normal[2])) - np.arctan2(slope, normal[2])
    body_x = np.append(np.cos(rise) * ahead, np.sin(rise))
    frame = _frame(normal, body_x) @ _frame(up, np.array([1.0, 0.0, 0.0])).T
    point = floor[:2].mean(axis=0)
    origin_z = (height - normal[:2] @ (np.array([x, y]) - point[:2])) / normal[2] + point[2]
    data.qpos[:3] = x, y, origin_z
    mujoco.mju_mat2Quat(data.qpos[3:7], frame.ravel())
    steer(model, data.qpos, steering)
    v, omega = twist
    data.qvel[:3] = frame[:, 0] * v
    data.qvel[3:6] = 0.0, 0.0, omega
    rates = {"wheel_left": (v - robot.half_track * omega) / radius_left}
    rates["wheel_right"] = (v + robot.half_track * omega) / radius_right
    for wheel, rate in (rates | front_rates(model, robot, v, omega, np.array(steering))).items():
        data.qvel[model.joint(wheel).dofadr[0]] = rate
    mujoco.mj_forward(model, data)
    if data.ncon:
        data.qpos[2] -= min(0.0, data.contact.dist.min())  # bumps between the three points
    return State(data.qpos.copy(), data.qvel.copy())


def _knuckles(model: mujoco.MjModel) -> list[str]:
    """Joints of two steered wheels, which an equality couples to the joint `steering`."""
    return [f"steering_{wheel}" for wheel in fronts(model) if has(model, "joint", f"steering_{wheel}")]


def _linkage(model: mujoco.MjModel, knuckle: str, angle: NDArray) -> NDArray:
    """Angle of a knuckle in rad at a steering angle."""
    return np.polynomial.polynomial.polyval(angle, model.equality(knuckle).data[:5])


def steer(model: mujoco.MjModel, qpos: NDArray, angle: float) -> None:
    """Turns what is steered to a steering angle in rad, in `qpos` `(nq,)`."""
    if has(model, "joint", "steering"):
        qpos[model.joint("steering").qposadr[0]] = angle
    for knuckle in _knuckles(model):
        qpos[model.joint(knuckle).qposadr[0]] = _linkage(model, knuckle, np.array(angle))


def front_rates(
    model: mujoco.MjModel, robot: Robot, v: NDArray, omega: NDArray, steering: NDArray
) -> dict[str, NDArray]:
    """Rates in rad/s of the steered wheels that roll without slip, by name; shapes as those of the arguments.

    Args:
        model: Compiled world.
        robot: The robot.
        v: V in m/s.
        omega: θ̇ in rad/s.
        steering: φ in rad.
    """
    if not has(model, "joint", "steering"):
        return {}
    along = v * np.cos(steering) + robot.wheelbase * omega * np.sin(steering)  # of the middle of the front axle
    rates = {wheel: along / robot.front_wheel_radius for wheel in fronts(model)}
    for knuckle in _knuckles(model):  # seen from the turning point a wheel is as fast as it is far away
        angle, wheel = _linkage(model, knuckle, steering), knuckle.removeprefix("steering_")
        far = np.where(np.abs(steering) > 1e-6, np.sin(steering), 1.0) / np.where(
            np.abs(angle) > 1e-6, np.sin(angle), 1.0
        )
        rates[wheel] = rates[wheel] * far
    return rates


def _frame(up: NDArray, ahead: NDArray) -> NDArray:
    """Rotation matrix `(3, 3)` whose z axis is `up` and whose x axis is nearest to `ahead`."""
    side = np.cross(up, ahead)
    side /= np.linalg.norm(side)
    return np.column_stack([np.cross(side, up), side, up])


def ground(model: mujoco.MjModel, data: mujoco.MjData, x: float, y: float) -> NDArray:
    """The ground point below (x, y); the robot itself (geom groups above 0) is transparent to the ray."""
    mujoco.mj_kinematics(model, data)
    groups = np.array([1, 0, 0, 0, 0, 0], np.uint8)
    start = np.array([x, y, 50.0])
    distance = mujoco.mj_ray(model, data, start, np.array([0.0, 0.0, -1.0]), groups, 1, -1, np.zeros(1, np.int32))
    if distance < 0:
        raise InputError(f"initial_pose: there is no ground below ({x:.2f}, {y:.2f})")
    return np.array([x, y, 50.0 - distance])


def clone(model: mujoco.MjModel) -> mujoco.MjModel:
    """A copy that can be perturbed."""
    return copy.copy(model)


def digest(model: mujoco.MjModel) -> str:
    """Tells whether two compiled models are the same, byte for byte, wherever the files lie that they came from."""
    found = hashlib.sha256()
    for part in (model, model.opt, model.stat):
        for name, value in getmembers(part):
            # Names of files, how long they are, and where the model lies in memory.
            if name.startswith("_") or name in ("paths", "npaths") or name.endswith("pathadr"):
                continue
            if isinstance(value, (np.ndarray, int, float, bytes)):
                array = np.asarray(value)
                found.update(f"{name} {array.dtype} {array.shape} ".encode() + array.tobytes())
    return found.hexdigest()
