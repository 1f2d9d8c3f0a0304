"""`mrctl record`: a video of a result, drawn by MuJoCo."""

# pyright: reportAttributeAccessIssue=false
# (mujoco is compiled and ships no stubs)

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing
from importlib.util import find_spec
from itertools import chain
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from tqdm import tqdm

from mrctl.kernel import Array
from mrctl.physics import mjcf
from mrctl.physics.elements import bodies_of
from mrctl.physics.hull import footprint
from mrctl.physics.obstacles import quaternion
from mrctl.physics.parameters import read_robot
from mrctl.physics.pictures import REFERENCE_COLOUR, SHADOW_PIXELS, draw_line
from mrctl.record import InputError
from mrctl.scenario import Scenario
from mrctl.theory.obstacles import Surroundings
from mrctl.viewer.cameras import MIN_VIEW, OVERVIEW, fitted, to_see
from mrctl.viewer.deviation import extent
from mrctl.viewer.looks import Look
from mrctl.viewer.recording import Library, Recording, joint_log, looks_of, path, references_of
from mrctl.viewer.sensors import magnification

Picture = NDArray[np.uint8]

SIZES = {".mp4": (1280, 720), ".gif": (640, 360)}  # pixels
RATES = {".mp4": 25.0, ".gif": 12.5}  # pictures a second
LINE_POINTS, TRAIL_POINTS = 200, 100
TRAIL_TIME = 12.0  # s that a trail shows
GHOST_OPACITY = 0.25
# Keeps the colours of thin trails, where the median cut keeps shades of the floor.
PALETTE_METHOD = Image.Quantize.FASTOCTREE
TRAIL_WIDTH = 0.003  # of trails, as a share of the width of the view; the reference is twice as wide


def record(folder: Path, run: int | None, out: Path, code: bool = True) -> str:
    """Writes a video of a result: the first run solid, the others as ghosts, with the reference and their trails.

    Args:
        folder: Folder of a result or a sweep.
        run: Number of the one run to show; by default those that `mrctl view` shows first.
        out: File to write, whose name ends in `.mp4` or `.gif`; MP4 needs the extra `video`.
        code: Whether a sweep may run the Python files that it names.

    Returns:
        A sentence on the runs that the video leaves out, or "".

    Raises:
        InputError: The file exists, has another ending or cannot be written; there is no such run; MuJoCo cannot draw
            on this machine; or the extra `video` is missing, or its ffmpeg fails.
    """
    if out.suffix not in SIZES:
        raise InputError(f"out: {out} ends neither in .mp4 nor in .gif")
    if out.exists():
        raise InputError(f"out: {out} exists already; nothing was overwritten")
    if out.suffix == ".mp4" and find_spec("imageio_ffmpeg") is None:
        raise InputError("out: an MP4 needs pip install 'mrctl[video]'; a name in .gif needs nothing")
    if not os.access(out.parent, os.W_OK):  # before all pictures are drawn
        raise InputError(f"out: {out.parent} is no folder in which a file can be written")
    library = Library(folder, code)
    shown = library.first_shown(run)
    recordings = [library.recording(k) for k in shown]
    period = 1 / RATES[out.suffix]
    times = np.arange(0, max(period, *(r.duration for r in recordings)), period)  # one picture of a single sample
    pictures = _pictures(recordings, looks_of(recordings, shown), times, *SIZES[out.suffix])
    progress = tqdm(pictures, total=len(times), unit="picture")
    try:
        (_write_gif if out.suffix == ".gif" else _write_mp4)(progress, out)
    except OSError as error:
        raise InputError(f"out: {out}: {error.strerror or error}") from None
    if run is not None or len(shown) == len(library.table):
        return ""
    numbers = ", ".join(map(str, shown))
    return f"run{'s' * (len(shown) > 1)} {numbers}, {len(shown)} of {len(library.table)}; --run chooses another"


def _write_gif(pictures: Iterable[Picture], out: Path) -> None:
    first, *others = (Image.fromarray(picture).quantize(64, PALETTE_METHOD) for picture in pictures)
    first.save(out, save_all=True, append_images=others, duration=round(1000 / RATES[".gif"]), loop=0)


def _write_mp4(pictures: Iterable[Picture], out: Path) -> None:
    import imageio_ffmpeg  # here, for it comes with the extra `video`

    pictures = iter(pictures)
    first = next(pictures)  # before the file is made, which stays away where MuJoCo cannot draw
    writer = imageio_ffmpeg.write_frames(
        str(out), SIZES[".mp4"], fps=round(RATES[".mp4"]), ffmpeg_log_level="error",
        output_params=["-movflags", "+faststart"],
    )  # fmt: skip
    with closing(writer):
        writer.send(None)
        for picture in chain([first], pictures):
            writer.send(picture)


def _pictures(
    recordings: Sequence[Recording], robots: Sequence[Look], times: Array, width: int, height: int
) -> Iterator[Picture]:
    """Draws recordings at some times in s, each picture `(height, width, 3)`.

    Raises:
        InputError: There is no OpenGL on this machine that draws without a display.
    """
    model = mjcf.clone(recordings[0].model)
    model.vis.global_.offwidth, model.vis.global_.offheight = width, height
    # Without a GPU shadows and samples take most of the time.
    model.vis.quality.shadowsize, model.vis.quality.offsamples = SHADOW_PIXELS, 0
    try:
        renderer = mujoco.Renderer(model, height, width)
    except Exception as error:  # each backend has errors of its own
        reason = str(error).split("\n")[0] or type(error).__name__
        raise InputError(f"record: MuJoCo cannot draw on this machine; is EGL (libegl1) installed? {reason}") from None
    with renderer:
        first = recordings[0].scenario
        references = references_of([recording.scenario for recording in recordings])
        courses = [one.sample(np.linspace(0, one.period, LINE_POINTS)).pose * [1, 1, 0] for one in references]
        view = max(MIN_VIEW, *np.ptp(np.concatenate(courses), axis=0))
        camera = _overview(model, first, np.concatenate([*courses, *map(_driven, recordings)]), width / height)
        data, option, nothing = mujoco.MjData(model), mujoco.MjvOption(), mujoco.MjvPerturb()
        moving = Surroundings(recordings[0].scenario.obstacles)
        radius, magnified = read_robot(model).wheel_radius, magnification(extent(joint_log(recordings)[1]))
        for time in times:
            for mover, (x, y, theta) in enumerate(moving.poses(np.array([recordings[0].start + time]))[0]):
                data.mocap_pos[mover], data.mocap_quat[mover] = (x, y, 0.0), quaternion(theta)
            for row, (recording, robot) in enumerate(zip(recordings, robots, strict=True)):
                data.qpos[:] = recording.qpos(recording.index(time))
                mujoco.mj_forward(model, data)
                scene = renderer.scene
                if row == 0:
                    renderer.update_scene(data, camera)
                    for course in courses:
                        draw_line(scene, course + [0, 0, 0.004], 2 * TRAIL_WIDTH * view, REFERENCE_COLOUR)
                else:
                    before = scene.ngeom
                    mujoco.mjv_addGeoms(model, data, option, nothing, mujoco.mjtCatBit.mjCAT_DYNAMIC, scene)
                    for geom in scene.geoms[before : scene.ngeom]:
                        geom.rgba = [*np.array(robot.colour) / 255, GHOST_OPACITY]
                        geom.matid = -1
                since, last = recording.index(time - TRAIL_TIME), recording.index(time)
                rows = recording.log[np.linspace(since, last, TRAIL_POINTS).astype(int)]
                draw_line(
                    scene, path(rows, radius, data.body("chassis").xpos[2], magnified), TRAIL_WIDTH * view, robot.colour
                )
            yield _labelled(renderer.render(), f"{time:.1f} s, deviation of trails {magnified} times", robots)


def _driven(recording: Recording) -> Array:
    """Returns places where a robot was, on the floor in m, `(n, 3)`."""
    rows = recording.log[np.linspace(0, len(recording.log) - 1, LINE_POINTS).astype(int)]
    return np.column_stack([rows["x"], rows["y"], np.zeros(LINE_POINTS)])[np.isfinite(rows["x"])]


def _overview(model: mujoco.MjModel, scenario: Scenario, places: Array, aspect: float) -> mujoco.MjvCamera:
    """Returns a camera that sees robots at places in m, `(n, 3)`, and the obstacles around, as large as possible."""
    data, robot = mujoco.MjData(model), np.isin(model.geom_bodyid, bodies_of(model))
    mujoco.mj_kinematics(model, data)
    up, (centre, half) = data.geom_xmat[robot, 6:], np.moveaxis(model.geom_aabb[robot].reshape(-1, 2, 3), 1, 0)
    top = float((data.geom_xpos[robot, 2] + (up * centre).sum(axis=1) + (abs(up) * half).sum(axis=1)).max())
    reach = float(np.hypot(*footprint(model).T).max())
    seen = to_see(places, scenario.reference.period, reach, top, scenario.obstacles)
    position, target = fitted(seen, OVERVIEW, float(np.radians(model.vis.global_.fovy)), aspect)
    back = target - position
    camera = mujoco.MjvCamera()
    camera.lookat, camera.distance = target, float(np.linalg.norm(back))
    camera.azimuth = np.degrees(np.arctan2(back[1], back[0]))
    camera.elevation = np.degrees(np.arcsin(back[2] / camera.distance))
    return camera


def _labelled(picture: Picture, text: str, robots: Sequence[Look]) -> Picture:
    """Writes a text and the names of the robots in their colours into the upper left corner of a picture."""
    image = Image.fromarray(picture)
    draw, size = ImageDraw.Draw(image), len(picture) / 25
    for k, (line, colour) in enumerate([(text, (31, 41, 55)), *robots]):
        draw.text((size, size * (0.6 + 1.3 * k)), line, colour, font_size=size)
    return np.asarray(image)
