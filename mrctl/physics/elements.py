"""The names that bodies, joints, geoms and actuators of a compiled robot have, and look-ups by these names."""

# pyright: reportAttributeAccessIssue=false
# (mujoco is compiled and ships no stubs)

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from mrctl.kernel import Array

REAR = ("wheel_left", "wheel_right")
"""Names of the driven wheels: of body, joint and geom alike."""

MOTORS = ("motor_left", "motor_right")
"""Names of the actuators of the driven wheels."""

FRONTS = ("front_wheel", "front_left", "front_right", "caster_left", "caster_right")
"""Names of the geoms on which a robot may stand beside its driven wheels: one or two steered wheels, or casters."""

NUMERICS = {"no_load_current": 1, "limits": 4}
"""Numerics that every model holds, with their lengths: the no-load current in A, and the robot's limits on V in m/s, on
θ̇ in rad/s, on V̇ in m/s² and on θ̈ in rad/s²."""

COLLISION = "collision"
"""Name of the sensor that counts the contacts of a robot's hull with obstacles; only worlds with obstacles have it."""

PREFIX = "robot/"
"""Put before each name of the file of an adopted robot that is not replaced."""

RIGID = "servo_steering"
"""Name of the text element in an adopted model whose steered wheels are held by servos."""

UNPAIRED = "no contact pair between the wheels and a floor"
"""What is wrong with a world in which the robot would sink."""


def has(model: mujoco.MjModel, kind: str, name: str) -> bool:
    """Tells whether a model has an element of this kind (`body`, `joint`, `geom`, …) and name."""
    return mujoco.mj_name2id(model, getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}"), name) >= 0


def fronts(model: mujoco.MjModel) -> list[str]:
    """Names those geoms of `FRONTS` that the model has."""
    return [name for name in FRONTS if has(model, "geom", name)]


def rolling_fronts(model: mujoco.MjModel) -> list[str]:
    """Names those geoms of `fronts` that roll on a joint of the same name; a caster without one slides."""
    return [name for name in fronts(model) if has(model, "joint", name)]


def knuckles(model: mujoco.MjModel) -> list[str]:
    """Names the joints of two steered wheels, each of which an equality couples to the joint `steering`."""
    return [f"steering_{wheel}" for wheel in fronts(model) if has(model, "joint", f"steering_{wheel}")]


def bodies_of(model: mujoco.MjModel) -> list[int]:
    """Lists the indices of the robot's bodies: the chassis and all that it carries."""
    chassis = model.body("chassis").id
    return [body for body in range(model.nbody) if model.body_rootid[body] == chassis]


def centres(model: mujoco.MjModel, data: mujoco.MjData, wheels: Sequence[str]) -> Array:
    """Returns the positions of wheel centres relative to P in the chassis' frame, rounded to the picometre.

    Args:
        model: Compiled model.
        data: Its data, with kinematics computed.
        wheels: Names of n geoms.

    Returns:
        Positions in m, `(n, 3)`.
    """
    chassis = data.body("chassis")
    return np.array([rounded(chassis.xmat.reshape(3, 3).T @ (data.geom(w).xpos - chassis.xpos)) for w in wheels])


def part(model: mujoco.MjModel, geom: int) -> str:
    """Returns the name that a geom has in its file, or its shape and its body where it has none."""
    kind = mujoco.mjtGeom(int(model.geom_type[geom])).name.removeprefix("mjGEOM_").lower()
    body = model.body(model.geom_bodyid[geom]).name.removeprefix(PREFIX) or "a body without a name"
    return model.geom(geom).name.removeprefix(PREFIX) or f"the {kind} of {body}"


def vertices(model: mujoco.MjModel, geom: int) -> Array:
    """Returns the vertices of a mesh in the frame of its geom in m, `(n, 3)`."""
    mesh = model.mesh(model.geom_dataid[geom])
    return model.mesh_vert[mesh.vertadr[0] : mesh.vertadr[0] + mesh.vertnum[0]].astype(float)


def bottom(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> float:
    """Returns the height of the lowest point of a geom in m; infinite for one that cannot be a wheel or a caster.

    Args:
        model: Compiled model.
        data: Its data, with kinematics computed.
        geom: Index of the geom.
    """
    size, up = model.geom_size[geom], np.round(data.geom_xmat[geom].reshape(3, 3)[2], 6)
    height, kind, shape = data.geom_xpos[geom][2], model.geom_type[geom], mujoco.mjtGeom
    if kind == shape.mjGEOM_SPHERE:
        return height - size[0]
    if kind == shape.mjGEOM_CAPSULE:
        return height - size[0] - size[1] * abs(up[2])
    if kind == shape.mjGEOM_CYLINDER:
        return height - size[0] * np.sqrt(max(0.0, 1 - up[2] ** 2)) - size[1] * abs(up[2])
    if kind == shape.mjGEOM_ELLIPSOID:
        return height - np.linalg.norm(up * size)
    if kind == shape.mjGEOM_MESH:
        return height + (vertices(model, geom) @ up).min()
    if kind == shape.mjGEOM_BOX:
        return height - np.abs(up) @ size
    return np.inf


def rounded(length: Array) -> Array:
    """Rounds lengths in m, of any shape, to the picometre, so that an MJCF's 0.40 − 0.37 gives 0.03."""
    return np.round(length, 12)


def left_tyre_pairs(model: mujoco.MjModel) -> list[int]:
    """Lists the indices of the rear left wheel's contact pairs with the floors.

    The pair `tyre_left`, which is the one with the ordinary floor, comes first.
    """
    wheel = model.geom("wheel_left").id
    pairs = [p for p in range(model.npair) if wheel in (model.pair_geom1[p], model.pair_geom2[p])]
    return sorted(pairs, key=lambda p: model.pair(p).name != "tyre_left")


def driven_through(model: mujoco.MjModel) -> list[str]:
    """Names the fixed geoms of the world that could collide, but not with the rear left wheel: they have no pair."""
    wheel, kind, others = model.geom("wheel_left").id, model.geom_contype, model.geom_conaffinity
    paired = {int(g) for p in left_tyre_pairs(model) for g in (model.pair_geom1[p], model.pair_geom2[p])} - {wheel}
    meets = (kind & others[wheel]) | (kind[wheel] & others)  # without a pair
    fixed = model.body_weldid[model.geom_bodyid] == 0
    return [
        part(model, int(g)) for g in np.flatnonzero(fixed & ((kind | others) != 0) & (meets == 0)) if g not in paired
    ]


def is_level(model: mujoco.MjModel) -> bool:
    """Tells whether gravity is vertical and every floor below the left wheel is a plane that lies flat."""
    pairs = left_tyre_pairs(model)
    floors = {int(g) for p in pairs for g in (model.pair_geom1[p], model.pair_geom2[p])} - {model.geom("wheel_left").id}
    flat = all(
        model.geom_type[g] == mujoco.mjtGeom.mjGEOM_PLANE and np.abs(model.geom_quat[g, 1:3]).max() < 1e-9
        for g in floors
    )
    return flat and not model.opt.gravity[:2].any()
