"""MJCF in, compiled model out: a world, the robot that drives in it, and its steering arrangement."""

# pyright: reportAttributeAccessIssue=false
# (mujoco is compiled and ships no stubs)

from __future__ import annotations

import copy
import hashlib
from collections.abc import Sequence
from inspect import getmembers
from pathlib import Path

import mujoco
import numpy as np

from mrctl.physics import adopt
from mrctl.physics.elements import MOTORS, RIGID, fronts, has, tyre_pairs
from mrctl.physics.files import robot_path, world_path
from mrctl.physics.parameters import load_torques, read_robot
from mrctl.record import InputError
from mrctl.theory.robot import ANY_ANGLE, CAR, GRAVITY, STEERINGS, Robot, RobotFile, Steering

# Elements that the robot of a world must name; `load_robot` names those of any other.
REQUIRED = {
    "body": ("chassis", "wheel_left", "wheel_right", "fork", "front_wheel"),
    "joint": ("chassis", "wheel_left", "wheel_right", "steering", "front_wheel"),
    "geom": ("wheel_left", "wheel_right", "front_wheel"),
    "actuator": (*MOTORS, "steering"),
}

NUMERICS = {"no_load_current": 1, "limits": 4}  # and how many values they hold



def build(
    world: str = "flat",
    steering: Steering = "compliant",
    timestep: float | None = None,
    robot: RobotFile = CAR,
) -> tuple[mujoco.MjModel, Robot]:
    """Compiles a world with the robot in one of the three steering arrangements.

    Args:
        world: `flat`, `slope`, `rough`, `patch`, or the path of an MJCF file.
        steering: `compliant` is the MJCF as it stands; `caster` and `rigid` take their stiffness, damping and trail
            from the model's numerics `steering_caster` and `steering_rigid`. A robot that is not the world's own has
            one arrangement: see `steerings`.
        timestep: Time step of the physics in s; by default the file's own.
        robot: Whose robot drives there; by default the world's own.

    Returns:
        The compiled model, and the parameters of its robot.

    Raises:
        InputError: The file is missing, does not compile, lacks a named element, or holds a robot that makes no sense.
    """
    path = world_path(world)
    foreign = None if robot == CAR else adopt.compiled(robot, path)
    source = path if foreign is None else robot_path(robot)
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
            nominal = read_robot(model)
    except ValueError as error:
        raise InputError(f"{source}: {' '.join(str(error).split())}") from None
    if timestep is not None:
        model.opt.timestep = timestep
    return model, nominal



def load(
    world: str = "flat",
    steering: Steering = "compliant",
    timestep: float | None = None,
    robot: RobotFile = CAR,
) -> mujoco.MjModel:
    """The compiled model alone; see `build` for the arguments and errors."""
    return build(world, steering, timestep, robot)[0]


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
    return ("rigid",) if has(model, "text", RIGID) else STEERINGS



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
    if not tyre_pairs(model):
        raise InputError("no contact pair between the wheels and a floor")



def _rearrange(model: mujoco.MjModel, robot: Robot, steering: Steering) -> None:
    """Gives the fork another stiffness, damping and trail; rolling losses follow the load that the trail moves."""
    before = load_torques(model)
    stiffness, damping, trail = model.numeric(f"steering_{steering}").data
    model.actuator("steering").biasprm[1:3] = -stiffness, -damping
    model.body("front_wheel").pos[0] = -trail
    for wheel, torque in load_torques(model).items():
        model.joint(wheel).frictionloss[0] += robot.rolling_coefficient * (torque - before[wheel])
    mujoco.mj_setConst(model, mujoco.MjData(model))



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
