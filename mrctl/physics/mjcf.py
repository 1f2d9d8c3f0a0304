"""Compiles a world with a robot in one of its steering arrangements, and refuses a model that cannot be driven.

`files` finds files and bounds their size; `adopt` and `obstacles` change a world before it is compiled. The other files
of this folder work on the compiled model: `elements` names its parts, `parameters` reads the constants of equations (1)
to (3) from it, `perturb` changes them, `stand` places the robot, and `plant` steps it.
"""

# pyright: reportAttributeAccessIssue=false
# (mujoco is compiled and ships no stubs)

from __future__ import annotations

import copy
import hashlib
import re
import warnings
from collections.abc import Sequence
from functools import lru_cache
from inspect import getmembers
from pathlib import Path

import mujoco
import numpy as np

from mrctl.physics import adopt
from mrctl.physics import obstacles as walls
from mrctl.physics.bounds import compiling
from mrctl.physics.elements import MOTORS, NUMERICS, RIGID, UNPAIRED, driven_through, fronts, has, left_tyre_pairs
from mrctl.physics.files import is_shipped, robot_path, shipped_digest, world_path
from mrctl.physics.hull import footprint
from mrctl.physics.parameters import load_torques, read_robot
from mrctl.physics.units import derived_limits
from mrctl.record import InputError
from mrctl.theory.obstacles import NO_OBSTACLES, Obstacles
from mrctl.theory.robot import CAR, STEERINGS, Robot, RobotFile, Steering

# MuJoCo would print a line for each warning, and write it to MUJOCO_LOG.TXT in the user's folder. Who drives a robot
# looks at its state and says why a run failed; what MjSpec warns of is a warning of Python, too.
mujoco.set_mju_user_warning(lambda _: None)

INCLUDED = f'<include file="{CAR.path}.xml"/>'
"""The line with which a world includes the default robot."""

REQUIRED = {
    "body": ("chassis", "wheel_left", "wheel_right", "fork", "front_wheel"),
    "joint": ("chassis", "wheel_left", "wheel_right", "steering", "front_wheel"),
    "geom": ("wheel_left", "wheel_right", "front_wheel"),
    "actuator": (*MOTORS, "steering"),
}
"""Names that the parts of a world's own robot must have, by kind; `mrctl.physics.adopt` renames those of others."""

Compiled = tuple[mujoco.MjModel, Robot, list[Warning | str]]
"""A model, the parameters of its robot, and the warnings of its compiler."""


def build(
    world: str = "flat",
    steering: Steering | None = None,
    timestep: float | None = None,
    robot: RobotFile = CAR,
    obstacles: Obstacles = NO_OBSTACLES,
    idle: int = 0,
) -> tuple[mujoco.MjModel, Robot]:
    """Compiles a world with a robot in one of its steering arrangements.

    Args:
        world: `flat`, `slope`, `rough`, `patch`, or the path of an MJCF file.
        steering: Steering arrangement, one of `steerings`, by default the first. The default robot is `compliant` as
            its MJCF stands; `caster` and `rigid` take stiffness (N·m/rad), damping (N·m·s/rad) and trail (m) of the
            fork from the numerics `steering_caster` and `steering_rigid`.
        timestep: Time step of the physics in s; by default the file's own.
        robot: The robot that drives there; by default the world's own.
        obstacles: Obstacles in the world. With any, the robot gets a massless hull that collides with them.
        idle: Number of further geoms that collide with nothing; robots in worlds with the same number of geoms can be
            simulated in one batch.

    Returns:
        The compiled model, and the parameters of its robot.

    Raises:
        InputError: A file is missing or does not compile, an element is missing, the robot is not driven with this
            steering, or a parameter of the robot is out of range.
    """
    if not obstacles.shapes and is_shipped(world) and is_shipped(robot.path):
        model, nominal, said = _compiled_once(world, steering, robot, shipped_digest())
        model = clone(model)
    else:
        model, nominal, said = _compiled(world, steering, robot, obstacles, idle)
    for warning in said:
        warnings.warn(warning, stacklevel=2)
    if timestep is not None:
        _set_timestep(model, timestep)
    return model, nominal


@lru_cache(maxsize=64)
def _compiled_once(world: str, steering: Steering | None, robot: RobotFile, digest: str) -> Compiled:
    """Returns what `_compiled` does for shipped files, which takes 5 to 50 ms, once for each state of these files.

    Args:
        world: The name of a shipped world.
        steering: As for `build`.
        robot: A shipped robot.
        digest: `shipped_digest`.
    """
    del digest  # part of the key alone
    return _compiled(world, steering, robot, NO_OBSTACLES, 0)


def _compiled(world: str, steering: Steering | None, robot: RobotFile, obstacles: Obstacles, idle: int) -> Compiled:
    """Returns the compiled model with the file's time step, its robot, and what MjSpec warned of; see `build`."""
    path = world_path(world)
    source = path if robot == CAR else robot_path(robot)
    # A robot that is refused gets one line, without warnings.
    with compiling(source, path), warnings.catch_warnings(record=True) as held:
        spec = _assembled(path, robot)
        model = spec.compile()
        nominal = _arranged(model, steering, robot)
        if geoms := driven_through(model):
            how = 'give each wheel a pair with it, or the geom contype="0" conaffinity="0"'
            text = f"{path}: no contact pair with the wheels, which pass through: {', '.join(geoms)}; {how}"
            warnings.warn(text, stacklevel=1)
        if obstacles.shapes:
            spec = _assembled(path, robot)
            walls.add(spec, obstacles, footprint(model), idle)
            model = spec.compile()
            nominal = _arranged(model, steering, robot)
    return model, nominal, [warning.message for warning in held]


def build_each(
    obstacles: Sequence[Obstacles], world: str, steering: Steering | None, timestep: float, robot: RobotFile
) -> tuple[list[mujoco.MjModel], Robot]:
    """Compiles a world once with each of several sets of obstacles, so that all models have the same number of geoms.

    Args:
        obstacles: The sets of obstacles, with the same `mrctl.physics.obstacles.layout`.
        world: As for `build`, like the other arguments.
        steering: As for `build`.
        timestep: As for `build`.
        robot: As for `build`.

    Returns:
        A model for each set, the same object for equal ones, and the robot.

    Raises:
        InputError: As `build`.
    """
    most = max(len(own.shapes) for own in obstacles)
    idle = {own: most - len(own.shapes) for own in obstacles}
    made = {own: build(world, steering, timestep, robot, own, count) for own, count in idle.items()}
    return [made[own][0] for own in obstacles], made[obstacles[0]][1]


def _assembled(world: Path, robot: RobotFile) -> mujoco.MjSpec:
    """Returns a world with a robot, ready to compile.

    A file with the names of the default robot's parts takes the place of `car.xml` in a world that includes it, and so
    keeps its servo and its steering arrangements. The robot of any other file is adopted.
    """
    if robot != CAR and robot == RobotFile(path=robot.path) and INCLUDED in world.read_text("utf-8", "replace"):
        own = mujoco.MjSpec.from_file(str(robot_path(robot)))
        if _has_names_of_car(own):
            return _in_place_of_car(world, robot_path(robot), own)
    return mujoco.MjSpec.from_file(str(world)) if robot == CAR else adopt.adopted(robot, world)


def _in_place_of_car(world: Path, path: Path, own: mujoco.MjSpec) -> mujoco.MjSpec:
    """Returns a world with a robot's file, which is parsed already, in the place of `car.xml`.

    MuJoCo would look beside the world for the files that the robot's file includes, and for its meshes and images.
    """
    texts, files = {}, [path]
    for number, file in enumerate(files, start=1):  # which grows meanwhile

        def renamed(include: re.Match, here: Path = file.parent) -> str:
            """Gives an included file a name of its own: MuJoCo drops folders, and one may be called car.xml."""
            found = next((one for one in (path.parent / include[2], here / include[2]) if one.is_file()), None)
            if found is None or found in files:
                return include[0]
            files.append(found)
            return f"{include[1]}included_{len(files)}.xml"

        text = re.sub(r"""(<include\s+file\s*=\s*["'])([^"']+)""", renamed, file.read_text("utf-8", "replace"))
        texts[f"{CAR.path}.xml" if file == path else f"included_{number}.xml"] = text.encode()
    spec = mujoco.MjSpec.from_file(str(world), include=texts)
    assets = (("mesh", own.meshes, own.meshdir), ("texture", own.textures, own.texturedir))
    for kind, asset, folder in ((kind, asset, folder) for kind, found, folder in assets for asset in found):
        file = next((f for f in (path.parent / folder / asset.file, path.parent / asset.file) if f.is_file()), None)
        if file:
            getattr(spec, kind)(asset.name).file = str(file.resolve())
    if (own.meshdir, own.texturedir) == (spec.meshdir, spec.texturedir):  # not those of the world's own files
        spec.meshdir = spec.texturedir = ""
    return spec


def _has_names_of_car(spec: mujoco.MjSpec) -> bool:
    """Tells whether a file has the elements of the default robot, and no floor."""
    elements = {"body": spec.bodies, "joint": spec.joints, "geom": spec.geoms, "actuator": spec.actuators}
    named = all({*REQUIRED[kind]} <= {element.name for element in found} for kind, found in elements.items())
    numerics = {*NUMERICS, *(f"steering_{steering}" for steering in STEERINGS[1:])}
    return named and numerics <= {numeric.name for numeric in spec.numerics} and not spec.pairs


def _arranged(model: mujoco.MjModel, steering: Steering | None, robot: RobotFile) -> Robot:
    """Checks a compiled model, gives it its steering arrangement, and returns the parameters of its robot.

    Raises:
        InputError: An element is missing, or the robot is not driven with this steering.
    """
    offered = steerings(model)
    steering = steering or offered[0]
    if robot != CAR and steering not in offered:
        raise InputError(f"steering: {robot.path} is driven with {' or '.join(offered)}, not {steering}")
    _check_elements(model, steering)
    if robot != CAR and not np.any(model.numeric("limits").data):
        _derive_limits(model)
    nominal = read_robot(model)
    if steering != "compliant" and len(offered) > 1:
        _rearrange(model, nominal, steering)
        nominal = read_robot(model)
    return nominal


def load(
    world: str = "flat",
    steering: Steering | None = None,
    timestep: float | None = None,
    robot: RobotFile = CAR,
    obstacles: Obstacles = NO_OBSTACLES,
) -> mujoco.MjModel:
    """Returns the compiled model alone; see `build` for the arguments and errors."""
    return build(world, steering, timestep, robot, obstacles)[0]


def load_robot(
    path: str | Path, wheels: Sequence[str] = (), steering: str | Sequence[str] = (), chassis: str = ""
) -> RobotFile:
    """Describes the robot of an MJCF file for `Scenario.robot`, and compiles it on a level floor as a check.

    Two wheels must be driven by one `<dcmotor>` each, whose `ctrlrange` is the supply. One wheel may be steered by a
    `<position>` or `<pid>` actuator, or two by Ackermann's geometry. A robot without a steered wheel is a differential
    drive, and whatever else touches the floor is its caster, which is frictionless unless it rolls. The file's own
    floor is left out, and the wheels roll on spheres of their radius.

    Args:
        path: `turtlebot`, `racecar`, or the path of an MJCF file.
        wheels: Joints of the two driven wheels; by default the two with a `<dcmotor>`.
        steering: Joint or joints of the steered wheels; by default the upright joints with an actuator that carry
            something which reaches the floor.
        chassis: Body that carries the wheels; by default the root of the wheels.

    Raises:
        InputError: The file has no such robot; the message says which part is missing, ambiguous or impossible.
    """
    driven, steered = ((names,) if isinstance(names, str) else tuple(names) for names in (wheels, steering))
    values = {"path": str(path), "wheels": driven, "steering": steered, "chassis": chassis}
    robot = RobotFile.from_dict(values, "robot")
    load(robot=robot)
    return robot


def arrangement(robot: RobotFile) -> Steering:
    """Returns the steering arrangement that a robot is driven with by default.

    Raises:
        InputError: The file has no robot that can be driven.
    """
    return STEERINGS[0] if robot == CAR else steerings(load(robot=robot))[0]


def steerings(model: mujoco.MjModel) -> tuple[Steering, ...]:
    """Lists the steering arrangements that a compiled robot can be driven with, the default one first.

    A differential drive is `caster`, because the torque difference alone turns it. An adopted robot whose wheels are
    steered by servos is `rigid`. The default robot has all three.
    """
    if not has(model, "joint", "steering"):
        return ("caster",)
    return ("rigid",) if has(model, "text", RIGID) else STEERINGS


def reverses(model: mujoco.MjModel, steering: Steering | None) -> bool:
    """Tells whether a robot can be driven backwards; a trailing fork would jackknife."""
    return (steering or steerings(model)[0]) == "rigid" or not has(model, "joint", "steering")


def _set_timestep(model: mujoco.MjModel, timestep: float) -> None:
    """Sets the physics step h in s, and adapts the contacts so that the tyres' side-slip in a curve stays the same.

    MuJoCo's contacts decelerate a side-slip v_y by v_y/c, with c = d τ/2 (impedance d, time constant τ), and neglect
    that they turn with the robot: a tyre slips by v_y = −c V θ̇. The integrator, semi-implicit Euler, moves the robot
    along its heading at the end of a step, which is a slip of (h/2) V θ̇ against the heading in the middle. The path
    shows the sum, −(c − h/2) V θ̇. With the τ of the file at every step, errors of 0.3 mm would double as h → 0.
    Therefore τ changes by the change of h over d. MuJoCo takes 2 h if that is longer, so longer steps slip more.
    """
    longer = timestep - model.opt.timestep
    if longer == 0:
        return
    slip = model.pair_solreffriction
    slip[:] = np.where(slip.any(axis=1, keepdims=True), slip, model.pair_solref)  # zeros stand for solref
    standard = slip[:, 0] > 0  # negative numbers are stiffness and damping
    slip[standard, 0] = np.maximum(slip[standard, 0] + longer / model.pair_solimp[standard, 1], 2 * timestep)
    model.opt.timestep = timestep


def _derive_limits(model: mujoco.MjModel) -> None:
    """Sets the numeric `limits` of a robot whose file has none."""
    model.numeric("limits").data[:] = 1.0  # so that the robot is valid and can be read
    model.numeric("limits").data[:] = derived_limits(read_robot(model))


def _check_elements(model: mujoco.MjModel, steering: Steering) -> None:
    """Refuses a model without the elements that the other files of this folder read by name.

    Raises:
        InputError: An element is missing or of the wrong type; the message names the first one.
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
        _check_motor(model, name)
    if required and model.actuator_ctrlnum[model.actuator("steering").id] != 2:
        raise InputError("actuator steering must be a <pid> with position and velocity inputs")
    if not left_tyre_pairs(model):
        raise InputError(UNPAIRED)


def _check_motor(model: mujoco.MjModel, name: str) -> None:
    """Refuses a motor whose command is no voltage, or whose current does not follow from voltage and speed.

    Raises:
        InputError: The actuator is no such motor; the message says why.
    """
    motor = model.actuator(name)
    if motor.gaintype != mujoco.mjtGain.mjGAIN_DCMOTOR:
        raise InputError(f"actuator {name} must be a <dcmotor>")
    if int(model.actuator_ctrlspec[motor.id]) != mujoco.mjtCtrlInput.mjINPUT_VOLTAGE:
        raise InputError(f"actuator {name} has another input than the voltage, which mrctl commands; leave it out")
    if model.actuator_actnum[motor.id] > (motor.dynprm[0] > 0):  # more states than the current in an inductance
        raise InputError(f"actuator {name} has thermal or lugre, which equation (3) leaves out; leave them out")
    for what, value in (("cogging", motor.biasprm[0]), ("delay", model.actuator_delay[motor.id])):
        if value:
            raise InputError(f"actuator {name} has {what}, which equation (3) leaves out; leave it out")
    low, high = model.actuator_ctrlrange[model.actuator_ctrladr[motor.id]]
    if low != -high:
        raise InputError(f"actuator {name} has the ctrlrange {low:g} to {high:g} V; it must be -U to U, U the supply")


def _rearrange(model: mujoco.MjModel, robot: Robot, steering: Steering) -> None:
    """Gives the fork the stiffness, damping and trail of another steering arrangement.

    The trail moves load between the wheels, and the rolling losses in their frictionloss follow the load.
    """
    before = load_torques(model)
    stiffness, damping, trail = model.numeric(f"steering_{steering}").data
    model.actuator("steering").biasprm[1:3] = -stiffness, -damping
    model.body("front_wheel").pos[0] = -trail
    for wheel, torque in load_torques(model).items():
        model.joint(wheel).frictionloss[0] += robot.rolling_coefficient * (torque - before[wheel])
    mujoco.mj_setConst(model, mujoco.MjData(model))


def clone(model: mujoco.MjModel) -> mujoco.MjModel:
    """Returns a copy of a model, which can be perturbed while the original stays nominal."""
    return copy.copy(model)


def digest(model: mujoco.MjModel) -> str:
    """Returns a SHA-256 digest of a compiled model; models that hold the same bytes have the same digest.

    Names and paths of the files that the model was compiled from are left out.
    """
    sha256 = hashlib.sha256()
    for part in (model, model.opt, model.stat):
        for name, value in getmembers(part):
            # Skips private attributes, and paths of files with their lengths, addresses and place in the buffer: equal
            # models differ in them.
            if name.startswith("_") or name in ("paths", "npaths", "nbuffer") or name.endswith("pathadr"):
                continue
            if isinstance(value, (np.ndarray, int, float, bytes)):
                array = np.asarray(value)
                sha256.update(f"{name} {array.dtype} {array.shape} ".encode() + array.tobytes())
    return sha256.hexdigest()
