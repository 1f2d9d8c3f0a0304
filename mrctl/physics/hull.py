"""The footprint of a robot: the convex hull of all its parts, as seen from above."""

# pyright: reportAttributeAccessIssue=false
# (mujoco is compiled and ships no stubs)

from __future__ import annotations

import mujoco
import numpy as np

from mrctl.kernel import Array
from mrctl.physics.elements import REAR, bodies_of, fronts, has, vertices
from mrctl.physics.stand import steer
from mrctl.record import InputError

SUPPORT_ANGLES = np.arange(32) * (2 * np.pi / 32)  # rad, in which supports are taken; a disc loses half a per cent
SUPPORT_DIRECTIONS = np.column_stack([np.cos(SUPPORT_ANGLES), np.sin(SUPPORT_ANGLES), 0 * SUPPORT_ANGLES])
BOX_CORNERS = np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1).T  # of a box, in half of its sides


def footprint(model: mujoco.MjModel) -> Array:
    """Finds the footprint of a compiled robot in its frame, with its wheels steered to either side and straight on.

    The spheres on which the wheels roll are left out, because the tyres that they stand for are narrower.

    Args:
        model: Compiled world with the robot.

    Returns:
        Corners in m from P, counter-clockwise, `(n, 2)`.

    Raises:
        InputError: The robot has no geom but its wheels.
    """
    bodies, contacts = bodies_of(model), [model.geom(name).id for name in (*REAR, *fronts(model))]
    geoms = [g for g in range(model.ngeom) if model.geom_bodyid[g] in bodies and g not in contacts]
    if not geoms:
        raise InputError("footprint: the robot has no geom beside its wheels")
    limit = model.joint("steering").range[1] if has(model, "joint", "steering") else 0.0
    data, points, known = mujoco.MjData(model), [], dict[tuple[int, bytes], Array]()
    for angle in {-limit, 0.0, limit}:
        mujoco.mj_resetData(model, data)
        steer(model, data.qpos, angle)
        mujoco.mj_kinematics(model, data)
        chassis = data.body("chassis")
        for geom in geoms:
            own = geom, data.geom_xpos[geom].tobytes() + data.geom_xmat[geom].tobytes()
            if own not in known:  # most do not move when the wheels are steered
                known[own] = (_extremes(model, data, geom) - chassis.xpos) @ chassis.xmat.reshape(3, 3)
            points.append(known[own])
    plane = np.concatenate(points)[:, :2].round(9)
    return convex(plane)


def convex(points: Array) -> Array:
    """Returns the vertices of the convex hull of points in the plane, in m, `(n, 2)`, counter-clockwise."""
    from scipy.spatial import ConvexHull  # imported here because robots without obstacles need no scipy

    return points[ConvexHull(points).vertices]


def _extremes(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> Array:
    """Returns the farthest points of a geom in level directions of the world in m, or all corners of a mesh, `(n, 3)`.

    The farthest point of a set in a direction is its support (Ericson, Real-Time Collision Detection, 2005).
    """
    kind, size, shape = model.geom_type[geom], model.geom_size[geom], mujoco.mjtGeom
    frame, centre = data.geom_xmat[geom].reshape(3, 3), data.geom_xpos[geom]
    ahead = (SUPPORT_DIRECTIONS @ frame).round(12)  # the directions in the frame of the geom
    if kind == shape.mjGEOM_MESH:
        own = vertices(model, geom)
    elif kind == shape.mjGEOM_BOX:
        own = size * BOX_CORNERS
    elif kind == shape.mjGEOM_ELLIPSOID:
        own = size**2 * ahead / np.linalg.norm(size * ahead, axis=1, keepdims=True)
    else:  # spheres, and the two ends of capsules and cylinders
        flat = ahead * [1, 1, kind != shape.mjGEOM_CYLINDER]
        length = np.linalg.norm(flat, axis=1, keepdims=True)
        round_part = size[0] * np.divide(flat, length, out=np.zeros_like(flat), where=length > 1e-9)
        end = 0.0 if kind == shape.mjGEOM_SPHERE else size[1]
        own = np.concatenate([round_part + [0, 0, end], round_part - [0, 0, end]])
    return centre + own @ frame.T
