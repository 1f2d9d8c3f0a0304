"""What visitors do in the scene with the mouse: they push the robots, set goals, draw ways, and click on trails."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Literal

import numpy as np
import viser

from mrctl.kernel import Array
from mrctl.record import InputError
from mrctl.theory.obstacles import Pose
from mrctl.viewer.arrows import PUSH_OF_LENGTH
from mrctl.viewer.page import Page
from mrctl.viewer.scene import Scene
from mrctl.viewer.session import Session
from mrctl.viewer.words import block

GOAL_HINT = "Drag on the floor from where the robots shall go to where they shall look there; or click twice."
WAY_HINT = "Click on the floor to draw a new reference from where the first robot is; the session pauses."
PUSH_HINT = "A drag from the first robot pushes all robots that way, a robot's length as hard as the button."
ENDINGS = "drive it", "as a loop", "cancel"  # of the drawing of a way


def rounded(*values: float) -> list[float]:
    """Returns numbers to two digits, as somebody would type them."""
    return [float(f"{value:.2g}") for value in values]


class Hands:
    """The inputs for the mouse in the scene, and what it does there.

    Attributes:
        pull: Push that a visitor draws, along the world's x and y in N; None while nobody does.
        trail: Ticks of the points of the trails, `(n,)`, and where they are drawn in m, `(n, B, 2)`.
    """

    def __init__(
        self,
        page: Page,
        command: Callable[[str], None],
        go_on: Callable[[], None],
        apply: Callable[..., None],
        head_for: Callable[[Pose], None],
        look_back: Callable[[float], None],
    ) -> None:
        """Adds the inputs, in the present context of the GUI.

        Args:
            page: The page.
            command: Plays or pauses.
            go_on: Lets the session go on from the moment that is shown.
            apply: Applies an event, whose fields are the keywords.
            head_for: Sets a goal.
            look_back: Shows the session at an earlier time in s.
        """
        self._page, self._command, self._go_on = page, command, go_on
        self._apply, self._head_for, self._look_back = apply, head_for, look_back
        gui = page.server.gui
        self._pushes = gui.add_checkbox("Push by dragging", False, hint=PUSH_HINT)
        page.on(self._pushes, lambda _: self._show_grips())
        page.on(gui.add_button("Set a goal", icon=viser.Icon.FLAG, hint=GOAL_HINT), lambda _: self.await_goal())
        self._draw = gui.add_button("Draw a way", icon=viser.Icon.ROUTE, hint=WAY_HINT)
        page.on(self._draw, lambda _: self.draw_way())
        self._picking = gui.add_html("")
        self._endings = gui.add_button_group("Way", ENDINGS, visible=False)
        page.on(self._endings, self._end_way)
        self.pull: tuple[float, float] | None = None
        self.trail = np.zeros(0, int), np.zeros((0, 1, 2))
        self._waits: Literal["", "goal", "way"] = ""  # what clicks on the floor are for
        self._points: list[Array] = []  # that were picked, in m
        self._grabbed: int | None = None  # index of the point that is dragged

        @page.server.scene.on_click()
        def _(event: viser.SceneClickEvent) -> None:
            page.ask(self.click, np.array(event.ray_origin), np.array(event.ray_direction))

    def begin(self, scene: Scene, session: Session) -> None:
        """Acts on another scene and session from now on."""
        self._scene, self._session = scene, session
        self.trail = np.zeros(0, int), np.zeros((0, session.size, 2))
        self._draw.visible = session.avoid == "none"
        self.forget()

    def await_goal(self) -> None:
        """Waits for a drag on the floor, from the place of a goal to where a robot looks there, or for two clicks."""
        self._wait("goal", "Drag on the floor, or click, where the robots shall go.")

    def draw_way(self) -> None:
        """Pauses, and waits for clicks on the floor, each of which adds a point to a way; refuses with an avoider."""
        self._session.check_way()
        self._wait("way", "Click on the floor to add a point; drag a point to move it.")
        self._command("pause")

    def _wait(self, what: Literal["goal", "way"], text: str) -> None:
        self._go_on()
        self.forget()
        self._waits, self._endings.visible = what, what == "way"
        self._show_grips()
        self._picking.content = block("picking", text)

    def forget(self) -> None:
        """Waits for nothing any longer."""
        self._waits, self._points, self._grabbed, self._endings.visible = "", [], None, False
        self._scene.show_way([], None)
        self._show_grips()
        self._picking.content = ""

    def _show_grips(self) -> None:
        """Lets visitors drag what they may drag at present."""
        floor = {"": None, "goal": self._drag_goal, "way": self._drag_point}[self._waits]
        self._scene.hold_floor(floor and partial(self._dragged, floor))
        self._scene.robots.hold(partial(self._dragged, self._drag_push) if self._pushes.value else None)

    def _dragged(self, action: Callable[[str, Array, Array], None], event: viser.SceneNodeDragEvent) -> None:
        """Queues an action with the places on the floor in m, `(2,)`, from and to which a visitor drags."""
        eye = np.array(event.client.camera.position)
        ends = [np.array(place) - eye for place in (event.start_position, event.end_position)]

        def act() -> None:
            start, end = (self._scene.on_floor(eye, ray) for ray in ends)
            if start is not None and end is not None:
                action(event.phase, start, end)

        self._page.ask(act)

    def _drag_goal(self, phase: str, start: Array, end: Array) -> None:
        """Shows, and at the end sets, the goal at the start of a drag."""
        if self._waits == "goal":
            goal = (float(start[0]), float(start[1]), float(np.arctan2(*(end - start)[::-1])))
            self._scene.navigation.show_ends([np.array([goal, goal])])
            if phase == "end":
                self._finish(goal)

    def _drag_point(self, phase: str, start: Array, end: Array) -> None:
        """Moves the point of a way from which a drag begins, if there is one."""
        if self._grabbed is None and self._points:
            away = np.linalg.norm(np.array(self._points) - start, axis=1)
            self._grabbed = int(away.argmin()) if away.min() < self._scene.reach else None
        if self._grabbed is not None and self._waits == "way":
            self._points[self._grabbed] = end
            self._show_way()
        if phase == "end":
            self._grabbed = None

    def _drag_push(self, phase: str, start: Array, end: Array) -> None:  # noqa: ARG002 (the robot may have moved)
        """Pushes all robots at the end of a drag from the first one; before, the page draws an arrow."""
        robot = self._session.robot
        fx, fy = PUSH_OF_LENGTH * robot.mass * (end - self._scene.robots.positions[0, :2]) / self._scene.length
        self.pull = None if phase == "end" else (float(fx), float(fy))
        if phase == "end":
            self._apply(push=(*rounded(fx, fy), 0.0))

    def click(self, origin: Array, direction: Array) -> None:
        """Takes a click, a ray from `origin` in m, `(3,)`: for a goal, for a way, or on a trail, to look back."""
        point = self._scene.on_floor(origin, direction)
        if not self._waits:
            return self._click_on_trail(point)
        if point is None:
            raise InputError(f"{self._waits}: there is no floor where you clicked")
        if self._waits == "way":
            self._points.append(point)
            return self._show_way()
        place = self._points[0] if self._points else point
        ahead = point - (place if self._points else self._scene.robots.positions[0, :2])
        goal = (float(place[0]), float(place[1]), float(np.arctan2(ahead[1], ahead[0])))
        if self._points:
            return self._finish(goal)
        self._points.append(point)
        self._scene.navigation.show_ends([np.array([goal, goal])])
        self._picking.content = block("picking", "Click on the floor towards where they shall look there.")

    def _finish(self, goal: Pose) -> None:
        self.forget()
        self._head_for(goal)

    def _show_way(self) -> None:
        """Draws the points of the way, and the way itself if the robot can follow it; else the page says why not."""
        self._scene.show_way(self._points, None)
        self._scene.show_way(self._points, self._session.way(self._points, closed=False))

    def _end_way(self, ending: str) -> None:
        if ending not in ENDINGS:
            raise InputError(f"{ending}: not one of the choices")
        if ending == "cancel" or self._waits != "way":
            return self.forget()
        if not self._points:
            raise InputError("way: click on the floor to add a point first")
        self._apply(reference=self._session.way(self._points, closed=ending == ENDINGS[1]))
        self.forget()
        self._command("play")

    def _click_on_trail(self, point: Array | None) -> None:
        """Looks back to when a robot last was at a point of the floor in m, `(2,)`, if a trail is there."""
        if point is None:
            return
        ticks, drawn = self.trail
        away = np.nan_to_num(np.hypot(*np.moveaxis(drawn - point, -1, 0)), nan=np.inf).min(axis=1)
        near = np.flatnonzero(away < self._scene.reach)
        if near.size:
            passage = np.split(near, np.flatnonzero(np.diff(near) > 1) + 1)[-1]  # laps lie one on the other
            self._look_back(int(ticks[passage[away[passage].argmin()]]) * self._session.period)
