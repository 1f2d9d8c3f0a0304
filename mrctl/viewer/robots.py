"""The robots in the scene: the first one is solid, the others are ghosts; with their labels and payloads."""

# pyright: reportAttributeAccessIssue=false
# (mujoco is compiled and ships no stubs)

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Coroutine, Sequence
from typing import Any

import mujoco
import numpy as np
import trimesh
import viser
from mjviser.conversions import merge_geoms

from mrctl.kernel import Array
from mrctl.theory.perturbation import Perturbation
from mrctl.viewer.looks import Colour, Look
from mrctl.viewer.shapes import add_mesh

GLASS: Colour = (150, 155, 160)  # of the first robot while marks are drawn, which have its colour
GHOST_OPACITY, GLASS_OPACITY = 0.5, 0.55
GHOST_SIZE = 1.04  # size of a ghost, of which only the far side is drawn: a rim around a robot that stands in it
LAST_VISIBLE_GROUP = 2  # last visible geom group, as in MuJoCo's own viewer
# robot lengths: distance of robots that have one label; its height over the robot
LABEL_DISTANCE, LABEL_HEIGHT = 0.7, 0.4
Dragged = Callable[[viser.SceneNodeDragEvent], None]


def name_of(row: int) -> str:
    """Returns the name of the node of a robot."""
    return f"/world/ghosts/{row}" if row else "/world/robot"


class Robots:
    """One solid robot and any number of translucent ones.

    Attributes:
        size: Number of robots.
        footprint: Least and largest x and y of a robot in its own frame in m, `(2, 2)`.
        length: Diagonal of the footprint in m.
        top: Height of a robot in m.
        held: The parts of the first robot, solid and translucent.
    """

    def __init__(
        self, scene: viser.SceneApi, model: mujoco.MjModel, data: mujoco.MjData, looks: Sequence[Look], radius: float
    ) -> None:
        """Draws the robots.

        Args:
            scene: The scene.
            model: Compiled world; it is not changed.
            data: Its data at the pose of the model; `show` changes them.
            looks: Look of each robot.
            radius: Radius of the wheels in m.
        """
        self.size, self._robots = len(looks), list(looks)
        self._scene, self._model, self._data, self._radius = scene, model, data, radius
        self._back = np.zeros(4)  # scratch
        chassis = model.body("chassis").id
        self._bodies = [b for b in range(model.nbody) if model.body_rootid[b] == chassis]
        self._chassis = self._bodies.index(chassis)
        self._positions = np.zeros((self.size, len(self._bodies), 3))
        self._quaternions = np.tile([1.0, 0.0, 0.0, 0.0], (self.size, len(self._bodies), 1))
        self._looks: list[tuple[viser.FrameHandle, viser.MeshHandle]] = []  # of each body, solid and translucent
        self.held: list[viser.MeshHandle | viser.GlbHandle] = []
        self.top = 0.0
        self.footprint = np.array([[np.inf, np.inf], [-np.inf, -np.inf]])
        self._parts = self._draw_bodies()
        self.length = float(np.hypot(*(self.footprint[1] - self.footprint[0])))
        self._frames = [self._draw_robot(row) for row in range(self.size)]
        self._labels = [
            scene.add_label(f"/world/label{row}", look.label, font_screen_scale=0.8, anchor="bottom-center")
            for row, look in enumerate(looks)
            if self.size > 1
        ]
        self._payloads = [
            scene.add_box(
                f"{name_of(row)}/chassis/payload", (120, 72, 40), (0.1, 0.1, 0.1), cast_shadow=False, visible=False,
                opacity=GHOST_OPACITY if row else None,
            )
            for row in range(self.size)
        ]  # fmt: skip
        self._perturbations: list[Perturbation | None] = [None] * self.size  # as drawn

    def _draw_bodies(self) -> list[trimesh.Trimesh | None]:
        """Draws the bodies of the solid robot; returns the rough shape of each, which ghosts have."""
        model, parts = self._model, []
        for body in self._bodies:
            geoms = [
                g for g in range(model.ngeom)
                if model.geom_bodyid[g] == body
                and model.geom_group[g] <= LAST_VISIBLE_GROUP
                and model.geom_rgba[g, 3] > 0
            ]  # fmt: skip
            parts.append(_rough(model, geoms) if geoms else None)
            if geoms:
                mesh, name = merge_geoms(model, geoms), self._node(0, body)
                solid = self._draw_solid(f"{name}/mesh", geoms)
                glass = add_mesh(
                    self._scene, f"{name}/glass", parts[-1].vertices, parts[-1].faces,
                    color=GLASS, opacity=GLASS_OPACITY, flat_shading=True, visible=False,
                )  # fmt: skip
                self._looks.append((solid, glass))
                self.held.append(glass)
                corners = mesh.vertices @ self._data.xmat[body].reshape(3, 3).T
                corners = corners + self._data.xpos[body] - self._data.xpos[self._bodies[self._chassis]]
                self.top = max(self.top, float(corners[:, 2].max()) + self._radius)
                low, high = self.footprint
                self.footprint = np.array(
                    [np.minimum(low, corners.min(axis=0)[:2]), np.maximum(high, corners.max(axis=0)[:2])]
                )
        return parts

    def _draw_solid(self, name: str, geoms: Sequence[int]) -> viser.FrameHandle:
        """Draws geoms of a body in the colours of the MJCF; a mesh of several colours would shine as a dark metal."""
        model, groups = self._model, defaultdict(list)
        for geom in geoms:
            material = model.geom_matid[geom]
            colour = model.geom_rgba[geom] if material < 0 else model.mat_rgba[material]
            textured = material >= 0 and model.mat_texid[material].max() >= 0
            groups[None if textured else tuple((255 * colour[:3]).astype(int).tolist())].append(geom)
        root = self._scene.add_frame(name, show_axes=False)
        for k, (colour, same) in enumerate(groups.items()):
            mesh = merge_geoms(model, same)
            if colour is None:
                drawn = self._scene.add_mesh_trimesh(f"{name}/{k}", mesh, cast_shadow=False, receive_shadow=False)
            else:
                drawn = add_mesh(self._scene, f"{name}/{k}", mesh.vertices, mesh.faces, color=colour, flat_shading=True)
            self.held.append(drawn)
        return root

    def _draw_robot(self, row: int) -> list[viser.FrameHandle]:
        """Draws a robot, with a frame for each body.

        Each frame is a node of its own: the poses of viser's batched meshes reach the picture a frame late.
        """
        frames = []
        for body, part in zip(self._bodies, self._parts, strict=True):
            name = self._node(row, body)
            frames.append(self._scene.add_frame(name, show_axes=False))
            if row and part is not None:
                middle = part.bounds.mean(axis=0)
                add_mesh(
                    self._scene, f"{name}/mesh", middle + GHOST_SIZE * (part.vertices - middle), part.faces,
                    side="back", color=self._robots[row].colour, opacity=GHOST_OPACITY, flat_shading=True,
                )  # fmt: skip
        return frames

    def _node(self, row: int, body: int) -> str:
        """Returns the name of the node of a body, below that of its parent."""
        parent = int(self._model.body_parentid[body])
        before = self._node(row, parent) if parent in self._bodies else name_of(row)
        return f"{before}/{self._model.body(body).name}"

    @property
    def positions(self) -> Array:
        """Positions of the chassis in m, `(B, 3)`."""
        return self._positions[:, self._chassis]

    @property
    def quaternions(self) -> Array:
        """Orientations of the chassis, `(B, 4)`."""
        return self._quaternions[:, self._chassis]

    @property
    def ground(self) -> Array:
        """Places on the ground on which the robots stand in m, `(B, 3)`."""
        return self.positions - [0, 0, self._radius]

    def show(self, row: int, qpos: Array) -> None:
        """Moves a robot; browsers receive the motion with `flush`.

        Args:
            row: Index of the robot.
            qpos: Generalised position of the robot, `(nq,)`.
        """
        model, data = self._model, self._data
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        for k, body in enumerate(self._bodies):
            parent = model.body_parentid[body]
            if parent not in self._bodies:
                self._positions[row, k], self._quaternions[row, k] = data.xpos[body], data.xquat[body]
                continue
            mujoco.mju_negQuat(self._back, data.xquat[parent])
            mujoco.mju_rotVecQuat(self._positions[row, k], data.xpos[body] - data.xpos[parent], self._back)
            mujoco.mju_mulQuat(self._quaternions[row, k], self._back, data.xquat[body])

    def flush(self) -> None:
        """Sends the positions of all robots to the browsers."""
        for row, frames in enumerate(self._frames):
            for k, frame in enumerate(frames):
                frame.wxyz = self._quaternions[row, k]
                if abs(frame.position - self._positions[row, k]).max() > 1e-6:  # wheels stay, but for rounding
                    frame.position = self._positions[row, k]
        self._show_labels()

    def _show_labels(self) -> None:
        """Moves the labels; robots that are close together have one label, of at most three lines."""
        here, near = self.positions, {}
        for row in range(len(self._labels)):
            first = next((r for r in near if np.hypot(*(here[r] - here[row])[:2]) < LABEL_DISTANCE * self.length), row)
            near.setdefault(first, []).append(self._robots[row].label)
        for row, label in enumerate(self._labels):
            label.visible = row in near
            if row in near:
                names = near[row]
                if len(names) > 3:
                    names = [*names[:2], f"and {len(names) - 2} more"]
                label.text = "\n".join(names)  # in one line they are cut off at an edge
                label.position = here[row] + [0, 0, self.top - self._radius + LABEL_HEIGHT * self.length]

    def show_payload(self, row: int, perturbation: Perturbation) -> None:
        """Draws the payload of a robot as a cube with the density of water at its place; if there is none, nothing."""
        p, box = perturbation, self._payloads[row]
        if p == self._perturbations[row]:
            return
        self._perturbations[row] = p
        box.visible = p.payload > 0
        if box.visible:
            side = (p.payload / 1000) ** (1 / 3)
            box.dimensions = (side, side, side)
            box.position = (p.payload_x, p.payload_y, p.payload_z - self._radius)

    def show_glass(self, on: bool) -> None:
        """Makes the first robot translucent, or solid."""
        for solid, glass in self._looks:
            solid.visible, glass.visible = not on, on

    def hold(self, dragged: Dragged | None) -> None:
        """Calls a function while a visitor drags the first robot, or with None no longer."""
        for part in self.held:
            part.remove_drag_callback()
            if dragged is not None:
                part.on_drag(in_order(dragged))


def in_order(dragged: Dragged) -> Callable[[viser.SceneNodeDragEvent], Coroutine[Any, Any, None]]:
    """Returns a coroutine; viser runs them in order, unlike functions."""

    async def called(event: viser.SceneNodeDragEvent) -> None:
        dragged(event)

    return called


def _rough(model: mujoco.MjModel, geoms: Sequence[int]) -> trimesh.Trimesh:
    """Returns the geoms of one body as one mesh without colours; round ones are coarse, since ghosts may be many."""
    sphere, ellipsoid = int(mujoco.mjtGeom.mjGEOM_SPHERE), int(mujoco.mjtGeom.mjGEOM_ELLIPSOID)
    parts = []
    for geom in geoms:
        if model.geom_type[geom] not in (sphere, ellipsoid):
            shape = merge_geoms(model, [geom])
            parts.append(trimesh.Trimesh(shape.vertices, shape.faces, process=False))
            continue
        ball, size = trimesh.creation.icosphere(subdivisions=1), model.geom_size[geom]
        place = trimesh.transformations.quaternion_matrix(model.geom_quat[geom])
        place[:3, 3] = model.geom_pos[geom]
        ball.apply_scale(size if model.geom_type[geom] == ellipsoid else size[0])
        parts.append(ball.apply_transform(place))
    whole = trimesh.util.concatenate(parts)
    assert isinstance(whole, trimesh.Trimesh)  # the types of trimesh allow any geometry
    return whole
