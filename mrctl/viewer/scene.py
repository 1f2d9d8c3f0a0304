"""The world, its robots and their paths in three dimensions."""

# pyright: reportAttributeAccessIssue=false
# (mujoco is compiled and ships no stubs)

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Callable, Coroutine, Sequence
from typing import Any

import mujoco
import numpy as np
import trimesh
import viser
from mjviser.conversions import merge_geoms

from mrctl.kernel import Array, Rows
from mrctl.physics import mjcf
from mrctl.physics.contacts import NOTHING, Contacts
from mrctl.physics.obstacles import HEIGHT, quaternion
from mrctl.physics.parameters import read_robot
from mrctl.physics.pictures import REFERENCE_COLOUR
from mrctl.physics.stand import ground
from mrctl.record import InputError
from mrctl.scenario import Scenario
from mrctl.theory.obstacles import NO_OBSTACLES, Obstacles, Surroundings
from mrctl.theory.perturbation import Perturbation
from mrctl.theory.references import Reference
from mrctl.theory.robot import GRAVITY
from mrctl.viewer.deviation import Target
from mrctl.viewer.looks import Colour, Look, pale
from mrctl.viewer.recording import ABOVE, Recording, event_times, joint_log, path
from mrctl.viewer.sensors import Marks, outline
from mrctl.viewer.server import Server
from mrctl.viewer.shapes import add_mesh, bar, disc, ribbons, sides

EVENT_COLOUR: Colour = (217, 119, 6)
# Colours of the floor: its thin lines, its thick lines, its surface.
LIGHT_FLOOR = (214, 217, 221), (190, 194, 200), (238, 240, 242)
DARK_FLOOR = (52, 55, 60), (70, 74, 80), (36, 38, 42)
HORIZON = 2.0, 9.0  # distances at which things begin to fade and are gone, in widths of the view
GLASS: Colour = (150, 155, 160)  # of the first robot while marks are drawn, which have its colour
TRAIL_POINTS = 240  # number of points in the trail of a robot
TRAIL_POINTS_OF_ALL = 1600  # largest number of points in the trails of all robots
PATH_POINTS = 600  # number of points in the path of a finished run
# Relative to the diagonal of the robot's outline: distance of robots that have one label, its height over the robot,
# and that of targets.
TOGETHER, LABEL_ABOVE, TARGET_ABOVE = 0.7, 0.4, 0.15
CLEARANCE = 0.05  # m, least height of a camera above the floor
# Initial camera, relative to the middle of the reference and in units of its size.
CAMERA_POSITION, CAMERA_TARGET = np.array([0.0, -1.23, 0.9]), np.array([0.0, 0.1, 0.0])
GHOST_OPACITY, GLASS_OPACITY = 0.5, 0.55
THICK = 0.012  # thickness of the lines from targets to robots, in diagonals of the robot's outline
HALO = 1.04  # size of a ghost, of which only the far side is drawn: a rim around a robot that stands in it
MAX_MARKED = 4  # number of robots whose estimates and targets are drawn
NEXT_TRAIL = 0.001  # m, from the height of the trails of one colour to that of the next; equal ones would flicker
LINE_WIDTH = 0.004  # of the reference, as a share of the width of the view; trails, which are below, are twice as wide
REACH = 0.03  # distance from a trail of clicks on it, as a share of the width of the view
LEAST_VIEW = 1.2  # m, least width of the view
SEEN = 2  # last visible geom group, as in MuJoCo's own viewer
GOAL_COLOUR: Colour = (22, 163, 74)
OUTLINE = 0.02  # m, width of the outlines at start and goal
SCAN_POINT, SCAN_HEIGHT = 0.03, HEIGHT + 0.01  # m, size of the points of a scan, which lie on top of the walls
PARTICLE, MAX_PARTICLES = 0.015, 500  # m, size of a particle, and the number from which on only some are drawn

SEARCH_COLOUR: Colour = (148, 163, 184)
MAP_COLOUR: Colour = (30, 41, 59)
MAP_HEIGHT = HEIGHT + 0.02  # m
COARSE, FAN_HEIGHT, MAX_ARCS = 4, 0.03, 5000  # of the drawn steps of a roll-out; m; about the number that is drawn

SHADE = 0.35  # opacity of shadows on the floor
GRIP, GRIP_BELOW = 50.0, 0.02  # m, half the side of the floor that can be dragged on, and its depth below the floor
SQUARE = (-1, -1), (1, -1), (1, 1), (-1, 1)
HARD = 3.0  # N/kg, a push whose arrow is as long as the robot
SLIDING = 0.1  # share of the robot's largest speed, a slip whose arrow is as long as the robot
LEAST_ARROW = 0.03  # robot lengths; shorter ones are not drawn
FORCE_COLOUR: Colour = (37, 99, 235)
SLIP_COLOUR: Colour = (220, 38, 38)
Dragged = Callable[[viser.SceneNodeDragEvent], None]

_NUMBERS = itertools.count()  # of scenes


def name_of(row: int) -> str:
    """Returns the name of the node of a robot."""
    return f"/world/ghosts/{row}" if row else "/world/robot"


class Scene:
    """One world with one solid robot and any number of translucent ones.

    Everything is below the node `/world`: to follow a robot, that node moves instead of the cameras.
    """

    def __init__(
        self,
        server: Server,
        model: mujoco.MjModel,
        robots: Sequence[Look],
        obstacles: Obstacles = NO_OBSTACLES,
    ) -> None:
        """Draws the world and its robots.

        Args:
            server: Server of the page.
            model: Compiled world; it is not changed.
            robots: Look of each robot.
            obstacles: The obstacles that the world was compiled with, of which some may move.
        """
        self.size, self._robots = len(robots), list(robots)
        self._scene, self._number = server.scene, next(_NUMBERS)
        self._server = server
        self._model, self._data = mjcf.clone(model), mujoco.MjData(model)
        round_ends = self._model.geom_type == mujoco.mjtGeom.mjGEOM_CAPSULE
        self._model.geom_type[round_ends] = mujoco.mjtGeom.mjGEOM_CYLINDER  # a capsule takes thousands of triangles
        robot = read_robot(model)
        self._radius, self._mass, self._max_speed = robot.wheel_radius, robot.mass, robot.max_speed
        self._back = np.zeros(4)  # scratch
        self._root = self._scene.add_frame("/world", show_axes=False)
        chassis = model.body("chassis").id
        self._bodies = [b for b in range(model.nbody) if model.body_rootid[b] == chassis]
        self._chassis = self._bodies.index(chassis)
        self._positions = np.zeros((self.size, len(self._bodies), 3))
        self._quaternions = np.tile([1.0, 0.0, 0.0, 0.0], (self.size, len(self._bodies), 1))
        self._surroundings = Surroundings(obstacles)
        self._walls: list[viser.MeshHandle] = []
        self._movers: list[viser.MeshHandle] = []  # in the order of `Surroundings.courses`
        self._draw_world()
        self._looks: list[tuple[viser.FrameHandle, viser.MeshHandle]] = []  # of each body, solid and translucent
        self._held: list[viser.MeshHandle | viser.GlbHandle] = []  # parts of the first robot
        self._top = 0.0  # height of the robot in m
        self._footprint = np.array([[np.inf, np.inf], [-np.inf, -np.inf]])
        self._parts = self._draw_bodies()
        self.length = float(np.hypot(*(self._footprint[1] - self._footprint[0])))
        self._frames = [self._draw_robot(row) for row in range(self.size)]
        self._labels = [
            self._scene.add_label(f"/world/label{row}", robot.label, font_screen_scale=0.8)
            for row, robot in enumerate(robots)
            if self.size > 1
        ]
        self._payloads = [
            self._scene.add_box(
                f"{name_of(row)}/chassis/payload", (120, 72, 40), (0.1, 0.1, 0.1), cast_shadow=False, visible=False,
                opacity=GHOST_OPACITY if row else None,
            )
            for row in range(self.size)
        ]  # fmt: skip
        self._sensors = self._scene.add_frame("/world/sensors", show_axes=False, visible=False)
        self._marks = [
            Marks(self._scene, row, self._footprint, robot.colour) for row, robot in enumerate(robots[:MAX_MARKED])
        ]
        self._targets = [
            Target(self._scene, row, self._top + TARGET_ABOVE * self.length, THICK * self.length, robot.colour)
            for row, robot in enumerate(robots[:MAX_MARKED])
        ]
        self._ends = [
            add_mesh(
                self._scene, f"/world/{name}", *ribbons(outline(self._footprint), OUTLINE),
                color=colour, side="double", visible=False,
            )
            for name, colour in (("start", REFERENCE_COLOUR), ("goal", GOAL_COLOUR))
        ]  # fmt: skip
        self._scans: list[viser.PointCloudHandle] = []
        for row, robot in enumerate(robots[:MAX_MARKED]):
            for kind, size in (("scan", SCAN_POINT), ("particles", PARTICLE)):
                self._scans.append(
                    self._scene.add_point_cloud(
                        f"/world/{kind}/{row}", np.zeros((0, 3)), robot.colour, point_size=size, point_shape="circle",
                        point_shading="flat", precision="float32", visible=False,
                    )
                )  # fmt: skip
        self._fans = [
            [
                self._draw_segments(f"/world/considered/{row}/{name}", colour, width)
                for name, colour, width in (("some", pale(robot.colour), 1.0), ("chosen", robot.colour, 3.0))
            ]
            for row, robot in enumerate(robots[:MAX_MARKED])
        ]
        self._forces: list[viser.ArrowsHandle | None] = [None] * self.size
        self._grip: viser.MeshHandle | None = None
        self._search = self._draw_segments("/world/search", SEARCH_COLOUR, 1.0)
        self._map = self._draw_segments("/world/map", MAP_COLOUR, 3.0)
        self._touches: list[list[viser.ArrowsHandle]] = []  # of each robot: forces and slips
        self._way: list[viser.MeshHandle] = []  # that a visitor draws: its points and the way
        self._factor = self._scene.add_label("/world/deviation", "", visible=False, font_screen_scale=0.8)
        self._perturbations: list[Perturbation | None] = [None] * self.size  # as drawn
        self._ribbons: list[viser.MeshHandle] = []
        self._posts: viser.MeshHandle | None = None

    def _draw_world(self) -> None:
        model, data = self._model, self._data
        mujoco.mj_kinematics(model, data)
        self._floor = np.array([0.0, 0.0, 1.0]), np.zeros(3)  # its normal and a point of it
        self._floors: list[viser.GridHandle] = []
        for geom in range(model.ngeom):
            body = model.geom_bodyid[geom]
            still = model.body_weldid[body] == 0 or model.body_mocapid[body] >= 0  # obstacles on courses, too
            if not still or model.geom_group[geom] > SEEN:
                continue
            # A page gives a node the pose of the one that it replaces, if both have the same name.
            name, turn = f"/world/fixed/{self._number}/{geom}", np.zeros(4)
            mujoco.mju_mat2Quat(turn, data.geom_xmat[geom])
            if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_PLANE:
                self._floor = data.geom_xmat[geom].reshape(3, 3)[:, 2].copy(), data.geom_xpos[geom].copy()
                self._floors.append(
                    self._scene.add_grid(
                        name, 24, 24, cell_size=0.5, section_size=1, plane_opacity=1.0, shadow_opacity=0.0,
                        wxyz=turn, position=data.geom_xpos[geom],
                    )
                )  # fmt: skip
            else:
                mesh = merge_geoms(model, [geom])
                colour = 255 * model.mat_rgba[model.geom_matid[geom], :3] if model.geom_matid[geom] >= 0 else 200
                drawn = add_mesh(
                    self._scene, name, mesh.vertices, mesh.faces, flat_shading=True,
                    color=np.broadcast_to(0.92 * colour, 3).astype(np.uint8),
                    wxyz=data.xquat[body], position=data.xpos[body],
                )  # fmt: skip
                self._walls.append(drawn)
                if model.body_mocapid[body] >= 0:
                    self._movers.append(drawn)

    def _draw_bodies(self) -> list[trimesh.Trimesh | None]:
        """Draws the bodies of the solid robot; returns the rough shape of each, which ghosts have."""
        model, parts = self._model, []
        for body in self._bodies:
            geoms = [
                g for g in range(model.ngeom)
                if model.geom_bodyid[g] == body and model.geom_group[g] <= SEEN and model.geom_rgba[g, 3] > 0
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
                self._held.append(glass)
                corners = mesh.vertices @ self._data.xmat[body].reshape(3, 3).T
                corners = corners + self._data.xpos[body] - self._data.xpos[self._bodies[self._chassis]]
                self._top = max(self._top, float(corners[:, 2].max()) + self._radius)
                low, high = self._footprint
                self._footprint = np.array(
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
            self._held.append(drawn)
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
                    self._scene, f"{name}/mesh", middle + HALO * (part.vertices - middle), part.faces, side="back",
                    color=self._robots[row].colour, opacity=GHOST_OPACITY, flat_shading=True,
                )  # fmt: skip
        return frames

    def _node(self, row: int, body: int) -> str:
        """Returns the name of the node of a body, below that of its parent."""
        parent = int(self._model.body_parentid[body])
        before = self._node(row, parent) if parent in self._bodies else name_of(row)
        return f"{before}/{self._model.body(body).name}"

    def show_reference(self, scenario: Scenario) -> None:
        """Draws a lap of each reference of a scenario on the ground, and turns the cameras to show them.

        A map that differs from the world is drawn on top of the obstacles, as the outlines of what it has.
        """
        known = None if scenario.map is None else sides(Surroundings(scenario.map).at(0.0))
        _show_segments(self._map, known, MAP_HEIGHT)
        references = [scenario.reference, *(e.reference for e in scenario.events if e.reference)]
        lines = self._lines(references)
        low, high = np.min(lines, axis=(0, 1)), np.max(lines, axis=(0, 1))
        self._view = max(LEAST_VIEW, *(high - low)) + self.length
        self.draw_references(references)
        self._factor.position = [(low[0] + high[0]) / 2, low[1] - self.length / 2, low[2]]  # in front of the robots
        middle = (low + high) / 2
        self._look(middle + self._view * CAMERA_POSITION, middle + self._view * CAMERA_TARGET)
        self.paint()

    def draw_references(self, references: Sequence[Reference]) -> None:
        """Draws a lap of each reference on the ground, in place of those before; the cameras stay."""
        lines = self._lines(references)
        colours = len({robot.colour for robot in self._robots})
        lines[..., 2] += NEXT_TRAIL * (colours + 1)  # above all trails, which are wider
        self._draw_lines("/world/reference", lines, LINE_WIDTH * self._view, REFERENCE_COLOUR)

    def _lines(self, references: Sequence[Reference]) -> Array:
        """Returns a lap of each of n references, a little above the ground, in m, `(n, 401, 3)`."""
        lines = []
        for reference in references:
            pose = reference.sample(np.linspace(0, reference.period, 401)).pose
            heights = [self._height(x, y) + ABOVE for x, y in pose[:, :2]]
            lines.append(np.column_stack([pose[:, :2], heights]))
        return np.stack(lines)

    def _look(self, position: Array, target: Array) -> None:
        """Sets the camera of pages to come, and of open ones if it is another than before."""
        initial = self._server.initial_camera
        if np.allclose(initial.position, position):
            return
        initial.position, initial.look_at = position, target
        for client in self._server.get_clients().values():
            self.turn(client, position, target)

    def turn(self, client: viser.ClientHandle, position: Array, target: Array) -> None:
        """Places a visitor's camera, in m, `(3,)` each."""
        client.camera.position, client.camera.look_at = position, target

    def camera(self, top: bool) -> tuple[Array, Array]:
        """Returns the position of a camera that sees the whole reference, and what it looks at, in m, `(3,)` each."""
        initial = self._server.initial_camera
        if not top:
            return np.array(initial.position), np.array(initial.look_at)
        middle = np.array(initial.look_at) - self._view * CAMERA_TARGET
        return middle + self._view * np.array([0.0, -0.01, 1.6]), middle  # a camera cannot look straight down

    def behind(self) -> tuple[Array, Array]:
        """Returns the position of a camera behind the first robot, and what it looks at, in m, `(3,)` each."""
        here, turn = self._positions[0, self._chassis] + self._root.position, self._quaternions[0, self._chassis]
        ahead = np.zeros(3)
        mujoco.mju_rotVecQuat(ahead, np.array([1.0, 0, 0]), turn)
        ahead = np.array([ahead[0], ahead[1], 0.0]) / max(1e-9, np.hypot(ahead[0], ahead[1]))
        return here + self.length * (np.array([0.0, 0, 1.2]) - 2.5 * ahead), here + self.length * ahead

    def paint(self) -> None:
        """Gives floor and horizon the colours of a dark or a light page, and, in soft light, shadows to what stands."""
        dark, soft = self._server.dark, self._server.soft
        for floor in self._floors:
            floor.shadow_opacity = SHADE if soft else 0.0
        for part in (*self._held, *self._walls):
            part.cast_shadow = soft
        colours = DARK_FLOOR if dark else LIGHT_FLOOR
        for floor in self._floors:
            floor.cell_color, floor.section_color, floor.plane_color = colours
        near, far = HORIZON[0] * self._view, HORIZON[1] * self._view
        colour = (20, 20, 20) if dark else (255, 255, 255)
        self._scene.configure_fog(near, far, color=colour, enabled=True)

    def show_events(self, rows: Rows) -> None:
        """Marks the events of a run with posts on the reference.

        Args:
            rows: Record of `TICK` at the time of each event, `(n,)`.
        """
        if self._posts is not None:
            self._posts.remove()
            self._posts = None
        thick, posts = THICK * self.length, []
        for x, y in zip(rows["x_ref"], rows["y_ref"], strict=True):
            if np.isfinite(x):
                foot = np.array([x, y, self._height(x, y)])
                posts.append(bar(foot, foot + [0, 0, self.length / 2], thick))
        if posts:
            vertices, faces = zip(*posts, strict=True)
            moved = [face + 8 * k for k, face in enumerate(faces)]
            self._posts = add_mesh(
                self._scene, "/world/events", np.concatenate(vertices), np.concatenate(moved), color=EVENT_COLOUR
            )

    def above_floor(self, position: Array) -> Array:
        """Returns the nearest position to one in m, `(3,)`, from which a camera sees the floor from above."""
        normal, point = self._floor
        return position + normal * max(0.0, CLEARANCE - normal @ (position - point - self._root.position))

    def on_floor(self, origin: Array, direction: Array) -> Array | None:
        """Returns where a ray in a visitor's view meets the floor, x and y in m, `(2,)`; None where it does not."""
        normal, point = self._floor
        start, falls = origin - self._root.position, normal @ direction
        if falls >= 0:
            return None
        return (start + direction * (normal @ (point - start)) / falls)[:2]

    def _draw_lines(self, name: str, lines: Array, width: float, colour: Colour) -> viser.MeshHandle:
        """Draws lines `(B, n, 3)` as one mesh; each segment of a thick line of viser's costs about as much."""
        return add_mesh(self._scene, name, *ribbons(lines, width), color=colour, side="double")

    def show_recordings(self, recordings: Sequence[Recording], magnified: int) -> None:
        """Draws the references and the paths of finished runs, with deviations `magnified` times."""
        self.show_reference(recordings[0].scenario)
        for row, recording in enumerate(recordings):
            self.show(row, recording.qpos(len(recording.log) - 1))
        _, log, _ = joint_log(recordings)
        self.show_trails(log[np.linspace(0, len(log) - 1, PATH_POINTS).astype(int)], magnified)
        self.show_events(log[[recordings[0].index(time) for time in event_times(recordings)], 0])

    def _height(self, x: float, y: float) -> float:
        try:
            return float(ground(self._model, self._data, x, y)[2])
        except InputError:
            return 0.0

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

    def show_obstacles(self, time: float) -> None:
        """Moves the obstacles that move to where they are at a time in s of the run."""
        poses = self._surroundings.poses(np.array([time]))[0]
        for mover, (x, y, theta) in zip(self._movers, poses, strict=True):
            mover.position, mover.wxyz = (x, y, 0.0), quaternion(theta)

    def flush(self, follow: bool) -> None:
        """Sends the positions of all robots to the browsers.

        Args:
            follow: Whether the first robot stays in the middle of the screen, and the world moves.
        """
        self._root.position = -self._positions[0, self._chassis] * [1, 1, 0] if follow else np.zeros(3)
        for row, frames in enumerate(self._frames):
            for k, frame in enumerate(frames):
                frame.wxyz = self._quaternions[row, k]
                if abs(frame.position - self._positions[row, k]).max() > 1e-6:  # wheels stay, but for rounding
                    frame.position = self._positions[row, k]
        self._show_labels()

    def _show_labels(self) -> None:
        """Moves the labels; robots that are close together have one label, which names at most three of them."""
        here, near = self._positions[:, self._chassis], {}
        for row in range(len(self._labels)):
            first = next((r for r in near if np.hypot(*(here[r] - here[row])[:2]) < TOGETHER * self.length), row)
            near.setdefault(first, []).append(self._robots[row].label)
        for row, label in enumerate(self._labels):
            label.visible = row in near
            if row in near:
                names = near[row]
                more = f" + {len(names) - 2}" if len(names) > 3 else ""
                text = ", ".join(names[: 2 if more else 3]) + more
                label.text = text
                label.position = here[row] + [0, 0, self._top - self._radius + LABEL_ABOVE * self.length]

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

    def show_sensors(self, logs: Sequence[Rows], period: float, latencies: Sequence[int], magnified: int) -> None:
        """Draws what the robots know of their postures; the first robot becomes translucent, or it would hide that.

        Args:
            logs: For each robot that has it, a record of `TICK` of each of its last samples, `(T,)`; none hides it all.
            period: Time between samples in s.
            latencies: For each of them the number of samples between the moment of a fix and its arrival.
            magnified: Factor on errors of position.
        """
        self._sensors.visible = bool(logs)
        for solid, glass in self._looks:
            solid.visible, glass.visible = not logs, bool(logs)
        ground = self._positions[:, self._chassis] - [0, 0, self._radius]
        for marks, here, log, latency in zip(self._marks, ground, logs, latencies, strict=False):
            marks.show(here, log, period, latency, magnified)

    def show_ends(self, ends: Array | None) -> None:
        """Draws outlines of a robot at its start and its goal, poses in m, m, rad, `(2, 3)`; None hides them."""
        for k, mark in enumerate(self._ends):
            mark.visible = ends is not None
            if ends is not None:
                x, y, theta = ends[k]
                mark.position, mark.wxyz = (x, y, self._height(x, y) + ABOVE), quaternion(theta)

    def show_scans(self, scans: Sequence[tuple[Array, Array] | None]) -> None:
        """Draws what `Session.scan` returns, for each of the first robots; no scans hide all points."""
        for row, (met, particles) in enumerate(zip(self._scans[::2], self._scans[1::2], strict=True)):
            found = scans[row] if row < len(scans) else None
            met.visible = particles.visible = found is not None
            if found is not None:
                places = np.pad(found[0], [(0, 0), (0, 1)], constant_values=SCAN_HEIGHT).astype(np.float32)
                if not np.array_equal(met.points, places):  # scans are rarer than pictures
                    some = found[1][:: max(1, len(found[1]) // MAX_PARTICLES), :2]
                    met.points = places
                    particles.points = np.pad(some, [(0, 0), (0, 1)], constant_values=ABOVE).astype(np.float32)

    def show_force(self, row: int, force: Array | None) -> None:
        """Draws a push on a robot, along the world's x and y in N, `(2,)`: a robot's length for 3 N/kg.

        None hides it.
        """
        arrow = self._forces[row]
        if force is None:
            if arrow is not None:
                arrow.visible = False
            return
        way = np.append(self.length * force / (HARD * self._mass), 0.0)
        if arrow is None:
            arrow = self._forces[row] = self._draw_arrows(f"/world/force/{row}", EVENT_COLOUR, 0.03)
        arrow.points = np.stack([np.zeros(3), way])[None]
        arrow.position, arrow.visible = self._positions[row, self._chassis] + [0, 0, self._top / 2], True

    def _draw_arrows(self, name: str, colour: Colour, thick: float) -> viser.ArrowsHandle:
        """Adds arrows with shafts of a radius in robot lengths, of which there are none yet."""
        radius = thick * self.length
        return self._scene.add_arrows(
            name, np.zeros((1, 2, 3)), colour, shaft_radius=radius, head_radius=2.5 * radius, head_length=5 * radius,
            visible=False,
        )  # fmt: skip

    def show_contacts(self, touches: Sequence[Contacts]) -> None:
        """Draws what the first robots touch, as arrows that move with them; no contacts hide all arrows.

        The force on a robot is as long as the robot where it is its weight, and the velocity with which it slides where
        that is a tenth of its largest speed.
        """
        if touches and not self._touches:
            for row in range(min(self.size, MAX_MARKED)):
                name = f"{name_of(row)}/chassis"
                named = ("force", FORCE_COLOUR), ("slip", SLIP_COLOUR)
                self._touches.append([self._draw_arrows(f"{name}/{kind}", colour, 0.02) for kind, colour in named])
        for row, arrows in enumerate(self._touches):
            touch = touches[row] if row < len(touches) else NOTHING
            turn = np.empty(9)
            mujoco.mju_quat2Mat(turn, self._quaternions[row, self._chassis])
            places = (touch.places - self._positions[row, self._chassis]) @ turn.reshape(3, 3)
            lengths = touch.forces / (self._mass * GRAVITY), touch.slips / (SLIDING * self._max_speed)
            for drawn, ways in zip(arrows, lengths, strict=True):
                seen = np.linalg.norm(ways, axis=1) > LEAST_ARROW
                drawn.visible = bool(seen.any())
                if drawn.visible:
                    start = places[seen]
                    drawn.points = np.stack([start, start + self.length * ways[seen] @ turn.reshape(3, 3)], axis=1)

    def place(self, row: int) -> Array:
        """Returns x and y in m, `(2,)`, at which a robot is drawn."""
        return self._positions[row, self._chassis, :2].copy()

    def show_way(self, points: Sequence[Array], way: Reference | None) -> None:
        """Draws points on the floor in m, `(2,)` each, and a way through them, in place of those before."""
        for part in self._way:
            part.remove()
        self._way = []
        radius, turn = self.reach / 2, np.linspace(0, 2 * np.pi, 25)
        for k, (x, y) in enumerate(points):
            mesh = disc(radius * np.column_stack([np.cos(turn), np.sin(turn)]))
            self._way.append(
                add_mesh(
                    self._scene, f"/world/way/{k}", *mesh, color=GOAL_COLOUR, side="double",
                    position=(x, y, self._height(x, y) + 2 * ABOVE),
                )
            )  # fmt: skip
        if way is not None:
            self._way.append(
                self._draw_lines("/world/way/line", self._lines([way]), LINE_WIDTH * self._view, GOAL_COLOUR)
            )

    def hold_floor(self, dragged: Dragged | None) -> None:
        """Calls a function while a visitor drags on the floor, or with None no longer."""
        if dragged is None:
            if self._grip is not None:
                self._grip.remove()
            self._grip = None
            return
        if self._grip is None:
            normal, point = self._floor
            along, across = np.cross([0.0, 1, 0], normal), np.cross(normal, [1.0, 0, 0])
            corners = [point - GRIP_BELOW * normal + GRIP * (a * along + b * across) for a, b in SQUARE]
            self._grip = add_mesh(
                self._scene, "/world/grip", np.array(corners), np.array([[0, 1, 2], [0, 2, 3]]), side="double"
            )
            self._grip.on_drag(_in_order(dragged))

    def hold_robot(self, dragged: Dragged | None) -> None:
        """Calls a function while a visitor drags the first robot, or with None no longer."""
        for part in self._held:
            part.remove_drag_callback()
            if dragged is not None:
                part.on_drag(_in_order(dragged))

    def _draw_segments(self, name: str, colour: Colour, width: float) -> viser.LineSegmentsHandle:
        """Adds line segments of a width in pixels, of which there are none yet."""
        return self._scene.add_line_segments(
            name, np.zeros((0, 2, 3)), colour, thickness=width, thickness_units="screen", visible=False
        )

    def show_considered(self, ways: Sequence[tuple[Array, Array] | None]) -> None:
        """Draws what `Session.considered` returns, for each of the first robots; no ways hide all."""
        for row, drawn in enumerate(self._fans):
            found = ways[row] if row < len(ways) else None
            for lines, places in zip(drawn, found or (None, None), strict=True):
                _show_segments(lines, None if places is None else _segments(places[..., ::COARSE, :]), FAN_HEIGHT)

    def show_search(self, arcs: Array) -> None:
        """Draws the arcs of a search, ends in m, `(k, 2, 2)`; none hide them."""
        some = arcs[:: max(1, len(arcs) // MAX_ARCS)]
        _show_segments(self._search, some if len(some) else None, ABOVE)

    @property
    def reach(self) -> float:
        """Distance in m from a trail within which a click on the floor is a click on it."""
        return REACH * self._view

    @property
    def trail_points(self) -> int:
        """Number of points in the trail of a robot."""
        return min(TRAIL_POINTS, TRAIL_POINTS_OF_ALL // self.size)

    def show_targets(self, now: Rows, magnified: int) -> None:
        """Draws where the robots should be, and a line from there to where they are.

        Args:
            now: Record of `TICK` of each robot, `(B,)`.
            magnified: Factor on the deviation from the reference, as in `show_trails`.
        """
        heights = self._positions[:, self._chassis, 2] - self._radius
        for target, row, height in zip(self._targets, now, heights, strict=False):
            target.show(row, height, magnified)

    def show_trails(self, rows: Rows, magnified: int) -> None:
        """Draws where the robots were, and says how many times their deviation from the reference is magnified.

        Args:
            rows: Record of `TICK` at any number of times, always the same number, `(n, B)`. A robot that has stopped
                remains where it is.
            magnified: Factor on the deviation.
        """
        here = self._positions[:, self._chassis]
        paths = path(rows, self._radius, here[0, 2], magnified)
        last = here - [0, 0, self._radius - ABOVE]
        for row, line in enumerate(paths.swapaxes(0, 1)):
            known = np.isfinite(line).all(axis=-1)
            line[~known] = line[known][-1] if known.any() else last[row]
        colours = list(dict.fromkeys(robot.colour for robot in self._robots))
        groups = [
            paths[:, [robot.colour == colour for robot in self._robots]].swapaxes(0, 1) + [0, 0, NEXT_TRAIL * k]
            for k, colour in enumerate(colours)
        ]
        width = 2 * LINE_WIDTH * self._view
        self._factor.visible = magnified > 1
        if magnified > 1:
            self._factor.text = f"deviation from the reference × {magnified}"
        if not self._ribbons:
            self._ribbons = [
                self._draw_lines(f"/world/trail/{k}", group, width, colours[k]) for k, group in enumerate(groups)
            ]
            return
        for ribbon, group in zip(self._ribbons, groups, strict=True):
            ribbon.vertices = ribbons(group, width)[0]

    def forget_trails(self) -> None:
        """Removes the trails."""
        for ribbon in self._ribbons:
            ribbon.remove()
        self._ribbons = []

    def remove(self) -> None:
        """Removes the world with everything in it."""
        self._root.remove()


def _in_order(dragged: Dragged) -> Callable[[viser.SceneNodeDragEvent], Coroutine[Any, Any, None]]:
    """Returns a coroutine; viser runs them in order, unlike functions."""

    async def called(event: viser.SceneNodeDragEvent) -> None:
        dragged(event)

    return called


def _segments(ways: Array) -> Array:
    """Returns the pieces of ways, `(…, n, 2)`, as ends of segments, `(k, 2, 2)`."""
    return np.stack([ways[..., :-1, :], ways[..., 1:, :]], axis=-2).reshape(-1, 2, 2)


def _show_segments(lines: viser.LineSegmentsHandle, ends: Array | None, height: float) -> None:
    """Draws segments between points on the floor in m, `(k, 2, 2)`, at a height in m; None hides them."""
    lines.visible = ends is not None
    if ends is not None:
        lines.points = np.pad(ends, [(0, 0), (0, 0), (0, 1)], constant_values=height)


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
