"""Pictures of an episode: the robot on its reference, drawn by MuJoCo through dm_control."""

# pyright: reportAttributeAccessIssue=false
# (mujoco is compiled and ships no stubs)

from __future__ import annotations

import mujoco
import numpy as np
from dm_control.mujoco.engine import MovableCamera
from numpy.typing import NDArray

from mrctl.envs.episodes import Episodes
from mrctl.physics import mjcf
from mrctl.physics.car import CarPhysics
from mrctl.physics.pictures import REFERENCE_COLOUR, SHADOW_PIXELS, draw_line
from mrctl.record import InputError

WIDTH, HEIGHT = 640, 480  # pixels
REFERENCE_POINTS = 200  # number of points of the reference
VIEW_DISTANCE = 5.0  # distance of the camera as a multiple of the size of the robot
AZIMUTH, ELEVATION = 60.0, -35.0  # of the camera's view, in degrees


class Pictures:
    """Draws the robots of episodes with a physics of its own, so that no picture changes a bit of an episode."""

    def __init__(self, episodes: Episodes) -> None:
        """Takes the episodes."""
        self._episodes = episodes
        self._drawn: dict[int, CarPhysics] = {}  # by the identity of the model of a world

    def _physics(self, robot: int) -> CarPhysics:
        """Returns a physics of the world in which a robot drives."""
        model = self._episodes.plant.models[robot]
        if id(model) not in self._drawn:
            physics = self._drawn[id(model)] = CarPhysics.from_compiled(mjcf.clone(model))
            looks = physics.model.ptr.vis
            looks.global_.offwidth, looks.global_.offheight = WIDTH, HEIGHT
            # Larger values take most of the time without a GPU.
            looks.quality.shadowsize, looks.quality.offsamples = SHADOW_PIXELS, 0
        return self._drawn[id(model)]

    def draw(self, robot: int = 0) -> NDArray[np.uint8]:
        """Draws one robot as it is now, from a camera that follows it, with its reference on the floor.

        Returns:
            The picture, `(480, 640, 3)`.

        Raises:
            InputError: MuJoCo cannot draw, because this machine has neither a display nor OpenGL without one.
        """
        plant, physics = self._episodes.plant, self._physics(robot)
        data = physics.data
        now, size = plant.reading[robot], plant.robot.size
        reference = self._episodes.scenarios[robot].reference
        course = reference.sample(np.linspace(0, reference.period, REFERENCE_POINTS)).pose * [1, 1, 0] + [0, 0, 0.004]
        data.qpos[:] = plant.qpos[robot]
        data.mocap_pos[:], data.mocap_quat[:] = (part[robot] for part in plant.mocap)
        physics.forward()
        try:
            _ = physics.contexts  # dm_control makes them when they are first read
        except Exception as error:  # noqa: BLE001 (each backend has errors of its own)
            reason = str(error).split("\n")[0] or type(error).__name__
            advice = "without a display it needs EGL (libegl1) and the variable MUJOCO_GL=egl"
            raise InputError(f"render: MuJoCo cannot draw on this machine; {advice}: {reason}") from None

        def add_course(_: object, scene: mujoco.MjvScene) -> None:
            draw_line(scene, course, size / 40, REFERENCE_COLOUR)

        camera = MovableCamera(physics, HEIGHT, WIDTH, scene_callback=add_course)
        camera.set_pose(np.nan_to_num([*now["pose"][:2], now["z"]]), VIEW_DISTANCE * size, AZIMUTH, ELEVATION)
        return camera.render()
