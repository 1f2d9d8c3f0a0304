"""The world, its robots and their paths in three dimensions, and the cameras."""

# pyright: reportAttributeAccessIssue=false
# (mujoco is compiled and ships no stubs)

from __future__ import annotations

import itertools
from collections.abc import Sequence

import mujoco
import numpy as np
import viser
from mjviser.conversions import merge_geoms

from mrctl.kernel import Array, Rows
from mrctl.loop.timeline import ends
from mrctl.physics import mjcf
from mrctl.physics.obstacles import quaternion
from mrctl.physics.parameters import read_robot
from mrctl.physics.pictures import REFERENCE_COLOUR
from mrctl.physics.stand import ground
from mrctl.record import InputError
from mrctl.scenario import Scenario
from mrctl.theory.obstacles import NO_OBSTACLES, Obstacles, Surroundings
from mrctl.theory.references import Reference
from mrctl.viewer.arrows import Arrows
from mrctl.viewer.cameras import OVERVIEW, TOP, fitted, to_see
from mrctl.viewer.deviation import Target
from mrctl.viewer.looks import EVENT_COLOUR, MAX_MARKED, Colour, Look
from mrctl.viewer.navigation import GOAL_COLOUR, Navigation
from mrctl.viewer.recording import PATH_HEIGHT, Recording, event_times, joint_log, path, references_of
from mrctl.viewer.robots import LAST_VISIBLE_GROUP, Dragged, Robots, in_order
from mrctl.viewer.sensors import Marks
from mrctl.viewer.server import Server
from mrctl.viewer.session import pushed
from mrctl.viewer.shapes import add_mesh, bar, disc, ribbons

# Colours of the floor: its thin lines, its thick lines, its surface.
LIGHT_FLOOR = (214, 217, 221), (190, 194, 200), (238, 240, 242)
DARK_FLOOR = (52, 55, 60), (70, 74, 80), (36, 38, 42)
FADING_DISTANCES = 2.0, 9.0  # distances at which things begin to fade and are gone, in widths of the view
TRAIL_POINTS = 240  # number of points in the trail of a robot
TRAIL_POINTS_OF_ALL = 1600  # largest number of points in the trails of all robots
PATH_POINTS = 600  # number of points in the path of a finished run
TARGET_ABOVE = 0.15  # height of targets over the robot, in diagonals of its outline
MIN_CAMERA_HEIGHT = 0.05  # m, least height of a camera above the floor
DEFAULT_ASPECT = 0.9  # of width to height of the picture in a page of which more is not known
TARGET_LINE_WIDTH = 0.012  # thickness of the lines from targets to robots, in diagonals of the robot's outline
TRAIL_STEP = 0.001  # m, from the height of the trails of one colour to that of the next; equal ones would flicker
LINE_WIDTH = 0.004  # of the reference, as a share of the width of the view; trails, which are below, are twice as wide
CLICK_REACH = 0.03  # distance from a trail of clicks on it, as a share of the width of the view
FLOOR_WIDTH = 80.0  # m, width of the floor that is drawn, of which the horizon hides what is far
SHADOW_OPACITY = 0.35  # opacity of shadows on the floor
# m, half the side of the floor that can be dragged on, and its depth below the floor
GRIP_SIZE, GRIP_BELOW = 50.0, 0.02
SQUARE = (-1, -1), (1, -1), (1, 1), (-1, 1)

_NUMBERS = itertools.count()  # of scenes


class Scene:
    """One world with one solid robot and any number of translucent ones.

    Everything is below the node `/world`: to follow a robot, that node moves instead of the cameras.

    Attributes:
        robots: The robots.
        length: Diagonal of the outline of a robot in m.
        arrows: Pushes on the robots, and what they touch.
        navigation: What robots on a mission know and consider.
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
        self._server, self._scene, self._looks = server, server.scene, list(robots)
        self._number = next(_NUMBERS)
        self._model, self._data = mjcf.clone(model), mujoco.MjData(model)
        round_ends = self._model.geom_type == mujoco.mjtGeom.mjGEOM_CAPSULE
        self._model.geom_type[round_ends] = mujoco.mjtGeom.mjGEOM_CYLINDER  # a capsule takes thousands of triangles
        robot = read_robot(model)
        self._radius = robot.wheel_radius
        self._root = self._scene.add_frame("/world", show_axes=False)
        self._surroundings, self._obstacles = Surroundings(obstacles), obstacles
        # Shape of each visitor's picture, whether the camera is above, and where it was placed.
        self._overviews: dict[int, tuple[float, bool, Array]] = {}
        self._walls: list[viser.MeshHandle] = []
        self._movers: list[viser.MeshHandle] = []  # in the order of `Surroundings.courses`
        self._draw_world()
        self.robots = Robots(self._scene, self._model, self._data, robots, robot.wheel_radius)
        self.arrows = Arrows(self._scene, self.robots, robot)
        self._sensors = self._scene.add_frame("/world/sensors", show_axes=False, visible=False)
        footprint, top, self.length = self.robots.footprint, self.robots.top, self.robots.length
        marked = list(enumerate(robots[:MAX_MARKED]))
        self._marks = [Marks(self._scene, row, footprint, look.colour) for row, look in marked]
        self._targets = [
            Target(self._scene, row, top + TARGET_ABOVE * self.length, TARGET_LINE_WIDTH * self.length, look.colour)
            for row, look in marked
        ]
        self.navigation = Navigation(self._scene, robots, footprint, self._height)
        self._grip: viser.MeshHandle | None = None
        self._way: list[viser.MeshHandle] = []  # that a visitor draws: its points and the way
        self._factor = self._scene.add_label("/world/deviation", "", visible=False, anchor="top-center")
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
            if not still or model.geom_group[geom] > LAST_VISIBLE_GROUP:
                continue
            # A page gives a node the pose of the one that it replaces, if both have the same name.
            name, turn = f"/world/fixed/{self._number}/{geom}", np.zeros(4)
            mujoco.mju_mat2Quat(turn, data.geom_xmat[geom])
            if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_PLANE:
                self._floor = data.geom_xmat[geom].reshape(3, 3)[:, 2].copy(), data.geom_xpos[geom].copy()
                self._floors.append(
                    self._scene.add_grid(
                        name, FLOOR_WIDTH, FLOOR_WIDTH, cell_size=0.5, section_size=1, plane_opacity=1.0,
                        shadow_opacity=0.0, wxyz=turn, position=data.geom_xpos[geom],
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

    def show_references(self, scenarios: Sequence[Scenario]) -> None:
        """Draws the first one's map, and a lap of each reference on the ground; turns the cameras to show them."""
        self.navigation.show_map(scenarios[0].map)
        references = references_of(scenarios)
        lines = self._lines(references)
        low, high = np.min(lines, axis=(0, 1)), np.max(lines, axis=(0, 1))
        self.draw_references(references)
        self._factor.position = [(low[0] + high[0]) / 2, low[1] - self.length / 2, low[2]]  # in front of the robots
        self._look()
        self.paint()

    def draw_references(self, references: Sequence[Reference]) -> None:
        """Draws a lap of each reference on the ground, in place of those before; the cameras stay.

        From now on an overview shows these.
        """
        lines = self._lines(references)
        duration = max(reference.period for reference in references)
        reach = float(np.hypot(*abs(self.robots.footprint).max(axis=0)))
        self._seen = to_see(lines.reshape(-1, 3), duration, reach, self.robots.top, self._obstacles)
        self._view = max(np.ptp(self._seen[:, :2], axis=0))
        self._middle = (self._seen.min(axis=0) + self._seen.max(axis=0)) / 2 * [1, 1, 0]
        colours = len({look.colour for look in self._looks})
        lines[..., 2] += TRAIL_STEP * (colours + 1)  # above all trails, which are wider
        self._draw_lines("/world/reference", lines, LINE_WIDTH * self._view, REFERENCE_COLOUR)

    def _lines(self, references: Sequence[Reference]) -> Array:
        """Returns a lap of each of n references, a little above the ground, in m, `(n, 401, 3)`."""
        lines = []
        for reference in references:
            pose = reference.sample(np.linspace(0, reference.period, 401)).pose
            heights = [self._height(x, y) + PATH_HEIGHT for x, y in pose[:, :2]]
            lines.append(np.column_stack([pose[:, :2], heights]))
        return np.stack(lines)

    def _look(self) -> None:
        """Sets the camera of pages to come, and of open ones if it is another than before."""
        initial, (position, target) = self._server.initial_camera, self.camera(False, DEFAULT_ASPECT)
        if np.allclose(initial.position, position):
            return
        initial.position, initial.look_at = position, target
        for client in self._server.get_clients().values():
            self.overlook(client)

    def overlook(self, client: viser.ClientHandle, top: bool = False) -> None:
        """Places a visitor's camera so that all is in its picture, from the side or from above."""
        camera = client.camera
        if camera.image_width and camera.image_height:  # a page that is hidden has no picture
            position, target = self.camera(top, camera.aspect)
            self.turn(client, position, target)
            self._overviews[client.client_id] = camera.aspect, top, position

    def fit(self, client: viser.ClientHandle) -> None:
        """Places a visitor's camera again when its picture has got another shape, until the visitor moves it."""
        camera = client.camera
        shape, top, place = self._overviews.get(client.client_id, (0.0, False, self._server.initial_camera.position))
        if camera.image_height and camera.aspect != shape and np.allclose(camera.position, place, atol=1e-3):
            self.overlook(client, top)

    def turn(self, client: viser.ClientHandle, position: Array, target: Array) -> None:
        """Places a visitor's camera, in m, `(3,)` each."""
        client.camera.position, client.camera.look_at = position, target

    def camera(self, top: bool, aspect: float) -> tuple[Array, Array]:
        """Returns a camera that sees the whole reference, and the obstacles around it, as large as possible.

        Args:
            top: Whether it is above it.
            aspect: Ratio of width to height of the picture.

        Returns:
            The position, and what the camera looks at, in m, `(3,)` each.
        """
        return fitted(self._seen, TOP if top else OVERVIEW, self._server.initial_camera.fov, aspect)

    def behind(self) -> tuple[Array, Array]:
        """Returns the position of a camera behind the first robot, and what it looks at, in m, `(3,)` each."""
        here = self.robots.positions[0] + self._root.position
        ahead = np.zeros(3)
        mujoco.mju_rotVecQuat(ahead, np.array([1.0, 0, 0]), self.robots.quaternions[0])
        ahead = np.array([ahead[0], ahead[1], 0.0]) / max(1e-9, np.hypot(ahead[0], ahead[1]))
        return here + self.length * (np.array([0.0, 0, 1.2]) - 2.5 * ahead), here + self.length * ahead

    def paint(self) -> None:
        """Gives floor and horizon the colours of a dark or a light page, and, in soft light, shadows to what stands."""
        dark, soft = self._server.dark, self._server.soft
        for floor in self._floors:
            floor.shadow_opacity = SHADOW_OPACITY if soft else 0.0
        for part in (*self.robots.held, *self._walls):
            part.cast_shadow = soft
        colours = DARK_FLOOR if dark else LIGHT_FLOOR
        for floor in self._floors:
            floor.cell_color, floor.section_color, floor.plane_color = colours
        near, far = FADING_DISTANCES[0] * self._view, FADING_DISTANCES[1] * self._view
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
        thick, posts = TARGET_LINE_WIDTH * self.length, []
        for x, y in sorted(set(zip(rows["x_ref"].tolist(), rows["y_ref"].tolist(), strict=True))):
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
        return position + normal * max(0.0, MIN_CAMERA_HEIGHT - normal @ (position - point - self._root.position))

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
        self.show_references([recording.scenario for recording in recordings])
        for row, recording in enumerate(recordings):
            self.robots.show(row, recording.qpos(len(recording.log) - 1))
        _, log, _ = joint_log(recordings)
        self.show_trails(log[np.linspace(0, len(log) - 1, PATH_POINTS).astype(int)], magnified)
        marked = [(r.index(time), row) for row, r in enumerate(recordings) for time in event_times([r])]
        self.show_events(log[tuple(np.array(marked, int).reshape(-1, 2).T)])

    def show_moment(self, recordings: Sequence[Recording], time: float, magnified: int) -> None:
        """Shows finished runs at a time in s from their first samples, with deviations `magnified` times."""
        for row, recording in enumerate(recordings):
            self.robots.show(row, recording.qpos(recording.index(time)))
            self.robots.show_payload(row, recording.perturbation(time))
            self.arrows.show_force(row, pushed(recording.scenario, recording.start + time))
        self.show_obstacles(recordings[0].start + time)
        found = [ends(recording.scenario, recording.start + time) for recording in recordings]
        self.navigation.show_ends([bounds for bounds in found if bounds is not None])
        self.show_targets(np.stack([r.log[r.index(time)] for r in recordings]), magnified)

    def _height(self, x: float, y: float) -> float:
        try:
            return float(ground(self._model, self._data, x, y)[2])
        except InputError:
            return 0.0

    def show_obstacles(self, time: float) -> None:
        """Moves the obstacles that move to where they are at a time in s of the run."""
        poses = self._surroundings.poses(np.array([time]))[0]
        for mover, (x, y, theta) in zip(self._movers, poses, strict=True):
            mover.position, mover.wxyz = (x, y, 0.0), quaternion(theta)

    def flush(self, follow: bool) -> None:
        """Sends the positions of all robots to the browsers.

        Args:
            follow: Whether the first robot stays in the middle of the overview, and the world moves.
        """
        self._root.position = self._middle - self.robots.positions[0] * [1, 1, 0] if follow else np.zeros(3)
        self.robots.flush()

    def show_sensors(self, logs: Sequence[Rows], period: float, latencies: Sequence[int], magnified: int) -> None:
        """Draws what the robots know of their postures; the first robot becomes translucent, or it would hide that.

        Args:
            logs: For each robot that has it, a record of `TICK` of each of its last samples, `(T,)`; none hides it all.
            period: Time between samples in s.
            latencies: For each of them the number of samples between the moment of a fix and its arrival.
            magnified: Factor on errors of position.
        """
        self._sensors.visible = bool(logs)
        self.robots.show_glass(bool(logs))
        for marks, here, log, latency in zip(self._marks, self.robots.ground, logs, latencies, strict=False):
            marks.show(here, log, period, latency, magnified)

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
                    position=(x, y, self._height(x, y) + 2 * PATH_HEIGHT),
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
            corners = [point - GRIP_BELOW * normal + GRIP_SIZE * (a * along + b * across) for a, b in SQUARE]
            self._grip = add_mesh(
                self._scene, "/world/grip", np.array(corners), np.array([[0, 1, 2], [0, 2, 3]]), side="double"
            )
            self._grip.on_drag(in_order(dragged))

    @property
    def reach(self) -> float:
        """Distance in m from a trail within which a click on the floor is a click on it."""
        return CLICK_REACH * self._view

    @property
    def trail_points(self) -> int:
        """Number of points in the trail of a robot."""
        return min(TRAIL_POINTS, TRAIL_POINTS_OF_ALL // len(self._looks))

    def show_targets(self, now: Rows, magnified: int) -> None:
        """Draws where the robots should be, and a line from there to where they are.

        Args:
            now: Record of `TICK` of each robot, `(B,)`.
            magnified: Factor on the deviation from the reference, as in `show_trails`.
        """
        heights = self.robots.ground[:, 2]
        for target, row, height in zip(self._targets, now, heights, strict=False):
            target.show(row, height, magnified)

    def show_trails(self, rows: Rows, magnified: int) -> None:
        """Draws where the robots were, and says how many times their deviation from the reference is magnified.

        Args:
            rows: Record of `TICK` at any number of times, always the same number, `(n, B)`. A robot that has stopped
                remains where it is.
            magnified: Factor on the deviation.
        """
        here = self.robots.positions
        paths = path(rows, self._radius, here[0, 2], magnified)
        last = here - [0, 0, self._radius - PATH_HEIGHT]
        for row, line in enumerate(paths.swapaxes(0, 1)):
            known = np.isfinite(line).all(axis=-1)
            line[~known] = line[known][-1] if known.any() else last[row]
        colours = list(dict.fromkeys(look.colour for look in self._looks))
        groups = [
            paths[:, [look.colour == colour for look in self._looks]].swapaxes(0, 1) + [0, 0, TRAIL_STEP * k]
            for k, colour in enumerate(colours)
        ]
        width = 2 * LINE_WIDTH * self._view
        self._factor.visible = magnified > 1
        if magnified > 1:
            self._factor.text = f"robots: where they are\ntrails and balls: deviation × {magnified}"
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
