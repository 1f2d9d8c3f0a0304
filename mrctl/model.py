"""MJCF in, compiled model out; reads a `Robot` from it, applies a `Perturbation` to it, stands it on the ground."""

# pyright: reportAttributeAccessIssue=false
# (mujoco is compiled and ships no stubs)

from __future__ import annotations

import copy
import hashlib
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Literal, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from mrctl.kinematics import scrub_free_angle
from mrctl.record import InputError
from mrctl.robot import GRAVITY, Perturbation, Robot

Steering = Literal["compliant", "caster", "rigid"]
Fields = dict[str, NDArray]

REAR = ("wheel_left", "wheel_right")
MOTORS = ("motor_left", "motor_right")
# Elements that a robot's MJCF must name (README: bring your own robot).
REQUIRED = {
    "body": ("chassis", "wheel_left", "wheel_right", "fork", "front_wheel"),
    "joint": ("chassis", "wheel_left", "wheel_right", "steering", "front_wheel"),
    "geom": ("wheel_left", "wheel_right", "front_wheel"),
    "actuator": (*MOTORS, "steering"),
}
NUMERICS = {"no_load_current": 1, "limits": 4}  # and how many values they hold


def models_folder() -> Path:
    """The folder of the shipped MJCF files, in a checkout and in an installed wheel."""
    inside = Path(str(resources.files("mrctl"))) / "models"
    return inside if inside.is_dir() else Path(__file__).resolve().parent.parent / "models"


def world_path(world: str) -> Path:
    """The file of a world: one of the shipped names, or a path that ends in `.xml`.

    Raises:
        InputError: No such file; the message lists the shipped worlds.
    """
    path = Path(world) if world.endswith(".xml") else models_folder() / f"{world}.xml"
    if not path.is_file():
        shipped = ", ".join(sorted(p.stem for p in models_folder().glob("*.xml") if p.stem not in ("car", "scenery")))
        raise InputError(f"world: no file {path}; shipped worlds: {shipped}")
    return path


def load(world: str = "flat", steering: Steering = "compliant", timestep: float | None = None) -> mujoco.MjModel:
    """Compiles a world with the robot in one of the three steering arrangements.

    Args:
        world: `flat`, `slope`, `rough`, `patch`, or the path of an MJCF file.
        steering: `compliant` is the MJCF as it stands; `caster` and `rigid` take their stiffness, damping and trail
            from the model's numerics `steering_caster` and `steering_rigid`.
        timestep: Time step of the physics in s; by default the file's own.

    Raises:
        InputError: The file is missing, does not compile, lacks a named element, or holds a robot that makes no sense.
    """
    path = world_path(world)
    try:
        model = mujoco.MjModel.from_xml_path(str(path))
        _complete(model, steering)
        robot = read_robot(model)
        if steering != "compliant":
            _rearrange(model, robot, steering)
    except ValueError as error:
        raise InputError(f"{path}: {' '.join(str(error).split())}") from None
    if timestep is not None:
        model.opt.timestep = timestep
    return model


def _complete(model: mujoco.MjModel, steering: Steering) -> None:
    """Refuses a model without the elements that the rest of this module reads by name.

    Raises:
        InputError: The first that is missing or of another kind.
    """
    numerics = NUMERICS if steering == "compliant" else NUMERICS | {f"steering_{steering}": 3}
    for kind, names in (*REQUIRED.items(), ("numeric", numerics)):
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
    if model.actuator_ctrlnum[model.actuator("steering").id] != 2:
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

    The rolling coefficient follows from the front wheel's frictionloss (nothing else brakes that wheel); what is left
    of a rear wheel's frictionloss after rolling and no-load loss is the gearbox.

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
    half_track, wheelbase, trail = _layout(model)
    motor = model.actuator("motor_left")
    gear, constant = motor.gear[0], motor.gainprm[1]
    no_load = model.numeric("no_load_current").data[0]
    load = _load_torques(model)
    if min(load.values()) <= 0:
        raise InputError("com_offset: the centre of mass must lie over the triangle of the wheels")
    rolling = model.joint("front_wheel").frictionloss[0] / load["front_wheel"]
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
            "front_wheel_radius": model.geom("front_wheel").size[0],
            "half_track": half_track,
            "wheelbase": wheelbase,
            "trail": trail,
            "steering_limit": model.joint("steering").range[1],
            "resistance": motor.gainprm[0],
            "inductance": _inductance(model),
            "torque_constant": constant,
            "gear_ratio": gear,
            "rotor_inertia": model.actuator_armature[motor.id],
            "no_load_current": no_load,
            "gear_loss": max(0.0, gear_loss),
            "rolling_coefficient": rolling,
            "wheel_inertia": _spin_inertia(model, "wheel_left"),
            "front_wheel_inertia": _spin_inertia(model, "front_wheel"),
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


def _layout(model: mujoco.MjModel) -> tuple[float, float, float]:
    """Half track, wheelbase and trail in m."""
    left, right = (model.body(wheel).pos[1] for wheel in REAR)
    return (left - right) / 2, model.body("fork").pos[0], -model.body("front_wheel").pos[0]


def _load_torques(model: mujoco.MjModel) -> dict[str, float]:
    """Static load on each wheel times its radius in N·m, by the lever rule on level ground."""
    half_track, wheelbase, trail = _layout(model)
    _, com = _at_rest(model)
    front, side = com[0] / (wheelbase - trail), com[1] / (2 * half_track)
    shares = {"wheel_left": (1 - front) / 2 + side, "wheel_right": (1 - front) / 2 - side, "front_wheel": front}
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
    for wheel in after:
        dof = nominal.joint(wheel).dofadr[0]
        drive = 0.0 if wheel == "front_wheel" else base.drive_loss * (p.drive_friction_factor - 1)
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
    """Stands the robot with its three wheels on the ground, rolling with a given twist.

    Rays find the ground under the wheels; the plane through those three points decides height, roll and pitch.

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
    centre = np.array([reach, aside, model.body("fork").pos[2] + model.body("front_wheel").pos[2]])
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
    data.qpos[model.joint("steering").qposadr[0]] = steering
    v, omega = twist
    data.qvel[:3] = frame[:, 0] * v
    data.qvel[3:6] = 0.0, 0.0, omega
    for wheel, rate in (
        ("wheel_left", (v - robot.half_track * omega) / radius_left),
        ("wheel_right", (v + robot.half_track * omega) / radius_right),
        (
            "front_wheel",
            (v * np.cos(steering) + robot.wheelbase * omega * np.sin(steering)) / robot.front_wheel_radius,
        ),
    ):
        data.qvel[model.joint(wheel).dofadr[0]] = rate
    mujoco.mj_forward(model, data)
    if data.ncon:
        data.qpos[2] -= min(0.0, data.contact.dist.min())  # bumps between the three points
    return State(data.qpos.copy(), data.qvel.copy())


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
    """Tells whether two compiled models are the same, byte for byte."""
    buffer = np.zeros(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return hashlib.sha256(buffer.tobytes()).hexdigest()
