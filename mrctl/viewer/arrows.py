"""Pushes on the robots, and what they touch, as arrows."""

# pyright: reportAttributeAccessIssue=false
# (mujoco is compiled and ships no stubs)

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
import viser

from mrctl.kernel import Array
from mrctl.physics.contacts import NO_CONTACTS, Contacts
from mrctl.theory.robot import Robot
from mrctl.viewer.looks import MAX_MARKED, Colour
from mrctl.viewer.robots import Robots, name_of

PUSH_OF_LENGTH = 3.0  # N/kg, a push whose arrow is as long as the robot
SLIP_OF_LENGTH = 0.1  # share of the robot's largest speed, a slip whose arrow is as long as the robot
MIN_ARROW = 0.03  # robot lengths; shorter ones are not drawn
PUSH_COLOUR: Colour = (217, 119, 6)
FORCE_COLOUR: Colour = (37, 99, 235)
SLIP_COLOUR: Colour = (220, 38, 38)


class Arrows:
    """The arrows at the robots; each is added when it is shown for the first time."""

    def __init__(self, scene: viser.SceneApi, robots: Robots, robot: Robot) -> None:
        """Takes the scene, the robots in it, and the parameters of the nominal robot."""
        self._scene, self._robots = scene, robots
        self._mass, self._weight, self._max_speed = robot.mass, robot.mass * robot.gravity, robot.max_speed
        self._forces: list[viser.ArrowsHandle | None] = [None] * robots.size
        self._touches: list[list[viser.ArrowsHandle]] = []  # of each robot: forces and slips

    def show_force(self, row: int, force: Array | None) -> None:
        """Draws a push on a robot, along the world's x and y in N, `(2,)`: a robot's length for 3 N/kg.

        None hides it.
        """
        arrow = self._forces[row]
        if force is None:
            if arrow is not None:
                arrow.visible = False
            return
        way = np.append(self._robots.length * force / (PUSH_OF_LENGTH * self._mass), 0.0)
        if arrow is None:
            arrow = self._forces[row] = self._draw_arrows(f"/world/force/{row}", PUSH_COLOUR, 0.03)
        arrow.points = np.stack([np.zeros(3), way])[None]
        arrow.position, arrow.visible = self._robots.positions[row] + [0, 0, self._robots.top / 2], True

    def show_contacts(self, touches: Sequence[Contacts]) -> None:
        """Draws what the first robots touch, as arrows that move with them; no contacts hide all arrows.

        The force on a robot is as long as the robot where it is its weight, and the velocity with which it slides where
        that is a tenth of its largest speed.
        """
        length = self._robots.length
        if touches and not self._touches:
            for row in range(min(self._robots.size, MAX_MARKED)):
                name = f"{name_of(row)}/chassis"
                named = ("force", FORCE_COLOUR), ("slip", SLIP_COLOUR)
                self._touches.append([self._draw_arrows(f"{name}/{kind}", colour, 0.02) for kind, colour in named])
        for row, arrows in enumerate(self._touches):
            touch = touches[row] if row < len(touches) else NO_CONTACTS
            turn = np.empty(9)
            mujoco.mju_quat2Mat(turn, self._robots.quaternions[row])
            places = (touch.places - self._robots.positions[row]) @ turn.reshape(3, 3)
            lengths = touch.forces / self._weight, touch.slips / (SLIP_OF_LENGTH * self._max_speed)
            for drawn, ways in zip(arrows, lengths, strict=True):
                seen = np.linalg.norm(ways, axis=1) > MIN_ARROW
                drawn.visible = bool(seen.any())
                if drawn.visible:
                    start = places[seen]
                    drawn.points = np.stack([start, start + length * ways[seen] @ turn.reshape(3, 3)], axis=1)

    def _draw_arrows(self, name: str, colour: Colour, thick: float) -> viser.ArrowsHandle:
        """Adds arrows with shafts of a radius in robot lengths, of which there are none yet."""
        radius = thick * self._robots.length
        return self._scene.add_arrows(
            name, np.zeros((1, 2, 3)), colour, shaft_radius=radius, head_radius=2.5 * radius, head_length=5 * radius,
            visible=False,
        )  # fmt: skip
