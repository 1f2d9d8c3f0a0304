"""Pictures of an episode: the robot on its reference, drawn by MuJoCo through dm_control."""

# pyright: reportAttributeAccessIssue=false
# (mujoco is compiled and ships no stubs)

from __future__ import annotations

import mujoco
import numpy as np
from dm_control.mujoco.engine import MovableCamera
from numpy.typing import NDArray

from mrctl.envs.episodes import Episodes
from mrctl.physics.pictures import REFERENCE_COLOUR, draw_line
from mrctl.physics.plant import PhysicsPlant
from mrctl.record import InputError

WIDTH, HEIGHT = 640, 480  # pixels
SHADOW = 1024  # pixels along each side of the shadow map
POINTS = 200  # number of points of the reference
VIEW = 5.0  # distance of the camera as a multiple of the size of the robot
AZIMUTH, ELEVATION = 60.0, -35.0  # of the camera's view, in degrees


def picture(episodes: Episodes) -> NDArray[np.uint8]:
    """Draws one robot as it is now, from a camera that follows it, with its reference on the floor.

    Returns:
        The picture, `(480, 640, 3)`.

    Raises:
        InputError: MuJoCo cannot draw, because this machine has neither a display nor OpenGL without one.
    """
    (scenario,), plant = episodes.scenarios, episodes.plant
    assert isinstance(plant, PhysicsPlant)
    now = plant.reading[0]
    size = np.hypot(plant.robot.wheelbase, 2 * plant.robot.half_track)
    times = np.linspace(0, scenario.reference.period, POINTS)
    course = scenario.reference.sample(times).pose * [1, 1, 0] + [0, 0, 0.004]
    looks = plant.physics.model.ptr.vis
    looks.global_.offwidth, looks.global_.offheight = WIDTH, HEIGHT
    looks.quality.shadowsize, looks.quality.offsamples = SHADOW, 0  # larger values take most of the time without a GPU

    try:
        _ = plant.physics.contexts  # dm_control makes them when they are first read
    except Exception as error:  # noqa: BLE001 (each backend has errors of its own)
        reason = str(error).split("\n")[0] or type(error).__name__
        advice = "without a display it needs EGL (libegl1) and the variable MUJOCO_GL=egl"
        raise InputError(f"render: MuJoCo cannot draw on this machine; {advice}: {reason}") from None

    def add_course(_: object, scene: mujoco.MjvScene) -> None:
        draw_line(scene, course, size / 40, REFERENCE_COLOUR)

    camera = MovableCamera(plant.physics, HEIGHT, WIDTH, scene_callback=add_course)
    camera.set_pose(np.nan_to_num([*now["pose"][:2], now["z"]]), VIEW * size, AZIMUTH, ELEVATION)
    return camera.render()
