"""A replay as one HTML file that needs neither server nor network."""

from __future__ import annotations

import contextlib
import html
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mrctl.kernel import Array
from mrctl.record import InputError
from mrctl.viewer.deviation import extent
from mrctl.viewer.looks import Look
from mrctl.viewer.plots import Chart, charts, legend, references_differ
from mrctl.viewer.recording import Recording, event_times, joint_log
from mrctl.viewer.scene import Scene
from mrctl.viewer.sensors import magnification
from mrctl.viewer.server import PHONE, Server
from mrctl.viewer.words import failures

PICTURE_RATE = 25  # pictures for each second of the replay
SAMPLES = 1200  # about the largest number of samples in a curve
PLAYER = Path(__file__).parent / "player.html"


def export(recordings: Sequence[Recording], robots: Sequence[Look], path: Path) -> None:
    """Writes recordings as one HTML file.

    Args:
        recordings: Runs in one world; the first one is solid, the others are ghosts.
        robots: Look of each run.
        path: File to write.

    Raises:
        InputError: The file exists or cannot be written.
    """
    refuse_existing(path)
    try:
        path.write_text(page(recordings, robots), "utf-8")
    except OSError as error:
        with contextlib.suppress(OSError):
            path.unlink()  # half a page would be in the way of the next attempt
        raise InputError(f"export: {path}: {error.strerror or error}") from None


def refuse_existing(path: Path) -> None:
    """Raises `InputError` if a file exists that should be written."""
    if path.exists():
        raise InputError(f"export: {path} exists already; nothing was overwritten")


def page(recordings: Sequence[Recording], robots: Sequence[Look]) -> str:
    """Returns a page in HTML with the 3-D scene and the curves of recordings, and one scrubber for both.

    Args:
        recordings: Runs in one world; the first one is solid, the others are ghosts.
        robots: Look of each run.
    """
    times, log, clearance = joint_log(recordings)
    apart, failed = references_differ(log), failures([robot.label for robot in robots], recordings)
    parts = {
        "legend": legend(robots, apart) + "".join(f"<p>{line}</p>" for line in failed),
        "scene": html.escape(_scene(recordings, robots, magnification(extent(log)))),
        "data": _curves(times, charts(log, robots, recordings[0].period, clearance, apart), event_times(recordings)),
    }
    return re.sub(r"{{(\w+)}}", lambda match: parts[match[1]], PLAYER.read_text("utf-8"))


def _scene(recordings: Sequence[Recording], robots: Sequence[Look], magnified: int) -> str:
    """Returns the scene with its player, as a complete page in HTML; deviations are magnified by a factor."""
    server = Server(port=0)
    try:
        scene = Scene(server, recordings[0].model, robots, recordings[0].scenario.obstacles)
        scene.show_recordings(recordings, magnified)
        duration = max(r.duration for r in recordings)
        serializer = server.get_scene_serializer()
        for time in np.arange(0, duration, 1 / PICTURE_RATE):
            scene.show_moment(recordings, time, magnified)
            scene.flush(follow=False)
            serializer.insert_sleep(1 / PICTURE_RATE)
        return serializer.as_html().replace("</head>", f"{PHONE}</head>", 1)
    finally:
        server.stop()


def _curves(times: Array, found: Sequence[Chart], events: Sequence[float]) -> str:
    """Returns charts over times in s, `(T,)`, and the times of events, as JSON that is safe inside a script element."""
    step = max(1, len(times) // SAMPLES)
    drawn = []
    for chart in found:
        values = [curve.values[::step] for curve in chart.curves]
        known = np.concatenate([*values, chart.least])
        known = known[np.isfinite(known)]
        drawn.append(
            {
                "title": chart.title,
                "range": [float(known.min()), float(known.max())],
                "curves": [
                    {
                        "colour": f"rgb{curve.colour}",
                        "dashed": curve.dashed,
                        "width": curve.width,
                        "values": _rounded(v),
                    }
                    for curve, v in zip(chart.curves, values, strict=True)
                ],
            }
        )
    data: dict[str, Any] = {"time": _rounded(times[::step]), "charts": drawn, "marks": list(events)}
    return json.dumps(data, ensure_ascii=False).replace("<", "\\u003c")


def _rounded(values: Array) -> list[float | None]:
    return [float(f"{v:.5g}") if np.isfinite(v) else None for v in values]
