"""Obstacles in MuJoCo: walls, the hull of a robot that collides with them, and obstacles read back from MJCF.

The hull and the walls have a bit of `contype` and `conaffinity` to themselves, so that a hull collides with walls only,
and with no floor, wheel or other hull.
"""

# pyright: reportAttributeAccessIssue=false
# (mujoco is compiled and ships no stubs)

from __future__ import annotations

import json
from collections.abc import Callable, Hashable
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from mrctl.kernel import Array
from mrctl.physics.bounds import check_bounds, compiling
from mrctl.physics.elements import COLLISION, bottom, vertices
from mrctl.physics.hull import convex
from mrctl.record import InputError
from mrctl.theory.obstacles import GROUND_HEIGHT, OVERHEAD_HEIGHT, Box, Disc, Obstacles, Polygon

HULL = "hull"  # name of the hull's geom
CONTACT_BIT = 2  # of contype and conaffinity; MuJoCo's default, which floors have, is 1
IDLE_BIT = 4  # of conaffinity; no geom has it in its contype, and one with no bit at all is left out of MuJoCo's trees
WALL_GROUP = 2  # of walls: rays that look for the ground see only group 0
WALL_HEIGHT = 0.5  # m, by which walls reach above and below the origin, because floors need not be level
HULL_HEIGHT = 0.1  # m, height of the hull above the axle
IDLE_DEPTH = 10.0  # m below the origin, where idle geoms lie


def layout(obstacles: Obstacles) -> Hashable:
    """Returns what worlds must share so that robots in them can be simulated in one batch.

    The batch engine needs models whose data have the same layout. It depends on the number of geoms, which `add` fills
    up, on the hull, on the number of moving bodies, and on the faces of the meshes.
    """
    corners = sorted(len(shape.points) for shape in obstacles.shapes if isinstance(shape, Polygon))
    return bool(obstacles.shapes), len(obstacles.moving), tuple(corners)


def add(spec: mujoco.MjSpec, obstacles: Obstacles, footprint: Array, idle: int = 0) -> None:
    """Puts obstacles into a world, and a massless hull on its robot.

    Args:
        spec: World with the body `chassis`; it is changed.
        obstacles: The obstacles.
        footprint: Corners of the hull in the frame of the chassis in m, `(n, 2)`.
        idle: Number of geoms in addition that collide with nothing.
    """
    add_walls(spec, obstacles)
    for _ in range(idle):
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.001, 0, 0], pos=[0, 0, -IDLE_DEPTH], contype=0,
            conaffinity=IDLE_BIT, group=4,
        )  # fmt: skip
    chassis = spec.body("chassis")
    _prism(spec, HULL, footprint, 0.0, HULL_HEIGHT)
    chassis.add_geom(
        name=HULL, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=HULL, mass=0, contype=CONTACT_BIT, conaffinity=0, group=4,
        rgba=[0.2, 0.5, 1, 0.3],
    )  # fmt: skip
    spec.add_sensor(
        name=COLLISION, type=mujoco.mjtSensor.mjSENS_CONTACT, objtype=mujoco.mjtObj.mjOBJ_GEOM, objname=HULL,
        intprm=[1, 0, 1],  # the number of contacts, of any kind, in one slot
    )  # fmt: skip


def add_walls(spec: mujoco.MjSpec, obstacles: Obstacles) -> None:
    """Puts obstacles into a world in order; those that move are mocap bodies at the start of their courses."""
    for k, shape in enumerate(obstacles.shapes):
        body, name = spec.worldbody, f"obstacle {k}"
        if shape.course is not None:
            x, y, theta = shape.course.sample(np.zeros(1)).pose[0]
            body = body.add_body(name=name, mocap=True, pos=[x, y, 0], quat=quaternion(theta))
            spec.add_text(name=name, data=json.dumps(shape.course.model_dump(mode="json")))
        common = {
            "name": name,
            "contype": 0,
            "conaffinity": CONTACT_BIT,
            "group": WALL_GROUP,
            "rgba": [0.45, 0.43, 0.41, 1],
        }
        if isinstance(shape, Disc):
            body.add_geom(
                type=mujoco.mjtGeom.mjGEOM_CYLINDER,
                size=[shape.radius, WALL_HEIGHT, 0],
                pos=[shape.x, shape.y, 0],
                **common,
            )
        elif isinstance(shape, Box):
            size, place = [shape.length / 2, shape.width / 2, WALL_HEIGHT], [shape.x, shape.y, 0]
            body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=size, pos=place, quat=quaternion(shape.angle), **common)
        else:
            _prism(spec, name, shape.vertices, -WALL_HEIGHT, WALL_HEIGHT)
            body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, **common)


def moving_bodies(model: mujoco.MjModel, obstacles: Obstacles) -> NDArray[np.intp]:
    """Returns the mocap index of each moving obstacle in a world, `(M,)`; a world may have mocap bodies of its own."""
    names = [f"obstacle {k}" for k, shape in enumerate(obstacles.shapes) if shape.course is not None]
    return np.array([model.body(name).mocapid[0] for name in names])


def multi_ray(obstacles: Obstacles) -> Callable[[Array, Array, float], Array]:
    """Returns a function that casts MuJoCo's rays at obstacles, a judge of `mrctl.theory.rays.cast`.

    Its arguments are x and y of the sensor in m, `(2,)`, the directions of the rays in rad, `(n,)`, and the largest
    range in m; it returns the ranges in m, `(n,)`.
    """
    spec = mujoco.MjSpec()
    add_walls(spec, obstacles)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)

    def ranges(place: Array, directions: Array, reach: float) -> Array:
        n, found = len(directions), np.empty(len(directions))
        rays, ids = np.column_stack([np.cos(directions), np.sin(directions), np.zeros(n)]), np.empty(n, np.int32)
        mujoco.mj_multiRay(model, data, np.append(place, 0.0), rays.ravel(), None, 1, -1, ids, found, None, n, reach)
        return np.where(found < 0, reach, np.minimum(found, reach))

    return ranges


def quaternion(angle: float) -> Array:
    """Returns the quaternion of a rotation by an angle in rad about the vertical, `(4,)`."""
    return np.array([np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)])


def _prism(spec: mujoco.MjSpec, name: str, corners: Array, low: float, high: float) -> None:
    """Adds the mesh of an upright prism between two heights in m; its corners are in m, `(n, 2)`."""
    rings = [np.column_stack([corners, np.full(len(corners), z)]) for z in (low, high)]
    spec.add_mesh(
        name=name, uservert=np.concatenate(rings).ravel(), inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
    )


def to_mjcf(obstacles: Obstacles) -> str:
    """Returns obstacles as the text of an MJCF file without robot and floor."""
    spec = mujoco.MjSpec()
    add_walls(spec, obstacles)
    spec.compile()
    return spec.to_xml()


def read_mjcf(path: str | Path) -> Obstacles:
    """Reads the obstacles of an MJCF file: fixed upright boxes and cylinders, and the outlines of meshes from above.

    Obstacles that `to_mjcf` wrote with a course keep it. Geoms that end at 2 cm or lower are floors and those that
    begin at 1 m or higher lintels, not obstacles; planes, height fields, and geoms that collide with nothing are no
    obstacles either.

    Args:
        path: The MJCF file.

    Raises:
        InputError: The file is no MJCF, or one of its obstacles is neither an upright box or cylinder nor a mesh.
    """
    check_bounds(Path(path))
    with compiling(path):
        spec = mujoco.MjSpec.from_file(str(path))
        model = spec.compile()
    data, shapes, texts = mujoco.MjData(model), [], {text.name: text.data for text in spec.texts}
    mujoco.mj_kinematics(model, data)
    for geom in range(model.ngeom):
        body = model.geom_bodyid[geom]
        fixed = model.body_weldid[body] == 0 or model.body_mocapid[body] >= 0
        if not fixed or not (model.geom_contype[geom] or model.geom_conaffinity[geom]):
            continue
        values = _outline(model, data, geom)
        if values is None:
            continue
        name = model.body(body).name
        if model.body_mocapid[body] >= 0 and name in texts:
            values["course"] = json.loads(texts[name])
        shapes.append(values)
    return Obstacles.from_dict({"shapes": shapes}, str(path))


def _outline(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> dict | None:
    """Returns the fields of a geom's obstacle, in the frame of its body if that moves; None for a floor or lintel.

    Raises:
        InputError: The geom is not upright, or is no box, cylinder or mesh.
    """
    kind, size, shape = model.geom_type[geom], model.geom_size[geom], mujoco.mjtGeom
    if kind == shape.mjGEOM_PLANE or kind == shape.mjGEOM_HFIELD:
        return None
    frame, place = data.geom_xmat[geom].reshape(3, 3), data.geom_xpos[geom]
    mesh = model.mesh(model.geom_dataid[geom]) if kind == shape.mjGEOM_MESH else None
    if mesh is not None:
        points = vertices(model, geom) @ frame.T + place
    else:
        half = abs(place[2] - bottom(model, data, geom))  # infinite for a shape that is refused below
        points = place + half * np.array([[0, 0, -1.0], [0, 0, 1]])
    low, high = points[:, 2].min(), points[:, 2].max()
    if high <= GROUND_HEIGHT:
        return None
    name = model.geom(geom).name or f"number {geom}"
    body = model.geom_bodyid[geom]
    if model.body_mocapid[body] >= 0:  # in the frame of its course
        turn = data.body(body).xmat.reshape(3, 3)
        frame, place, points = (
            turn.T @ frame,
            turn.T @ (place - data.body(body).xpos),
            (points - data.body(body).xpos) @ turn,
        )
    upright = abs(frame[2, 2]) >= 1 - 1e-9 and (kind == shape.mjGEOM_BOX or kind == shape.mjGEOM_CYLINDER)
    if mesh is None and not upright:
        raise InputError(f"geom {name}: not an upright box or cylinder, nor a mesh")
    if low >= OVERHEAD_HEIGHT:
        return None
    if mesh is not None:
        return {"kind": "polygon", "points": convex(points[:, :2].round(6)).tolist()}
    values = {"x": float(place[0]), "y": float(place[1])}
    if kind == shape.mjGEOM_CYLINDER:
        return {"kind": "disc", "radius": float(size[0]), **values}
    angle = float(np.arctan2(frame[1, 0], frame[0, 0]))
    return {"kind": "box", "angle": angle, "length": 2 * float(size[0]), "width": 2 * float(size[1]), **values}
