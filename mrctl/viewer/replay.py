"""The replay of a result or a sweep in the browser, with a scrubber."""

from __future__ import annotations

import html
from collections.abc import Sequence
from math import ceil, floor, log10
from typing import Any

import numpy as np
import viser
from pandas.api.types import is_bool_dtype, is_numeric_dtype
from typing_extensions import override

from mrctl.physics.parameters import read_robot
from mrctl.record import InputError
from mrctl.results.controllers import CONTROLLER, title_of
from mrctl.results.metrics import METRICS
from mrctl.viewer.looks import Colour, looks
from mrctl.viewer.page import SPEEDS, Page, arrivals, block, warning, write
from mrctl.viewer.plots import Plots
from mrctl.viewer.recording import MAX_SHOWN, Library, Recording, event_times, joint_log, looks_of
from mrctl.viewer.scene import Scene
from mrctl.viewer.score import whole_laps
from mrctl.viewer.sensors import FIX_AGE, error
from mrctl.viewer.server import Server
from mrctl.viewer.session import ends, pushed

SAMPLES = 800  # about the largest number of samples in a curve
TICKS = 4  # about the number of ticks of an axis of the scatter plot, between its ends
MARGIN = 0.08  # share of an axis, next to its ends, where a tick's number would run into that of the end
DOT = 0.035  # size of a run in the scatter plot, as a share of its height
DROVE, FAILED, CHOSEN, GRID = (71, 85, 105), (185, 28, 28), (17, 24, 39), (150, 155, 160)
# Unit and words of the columns of a table that are not in `METRICS`.
KNOWN = {"lap_time": ("s", "time of a lap"), "failure_time": ("s", "failed after"), "laps": ("1", "laps")}
DECADES, TINY = 30.0, 1e-300  # ratio of largest to least beyond which an axis is logarithmic; what stands for 0 there


class Replay(Page):
    """The page of finished runs."""

    def __init__(self, library: Library, runs: Sequence[int], server: Server) -> None:
        """Builds the page.

        Args:
            library: The runs to choose from.
            runs: Numbers of the runs to show; the first one is solid, the others are ghosts.
            server: Server of the page.

        Raises:
            InputError: A run does not exist, or runs differ in world, obstacles, robot or control period.
        """
        super().__init__(server)
        self.library = library
        self.time = 0.0
        self.recordings: list[Recording] = []
        self.runs: list[int] = []
        self._drawn: tuple[object, ...] | None = None
        self._plotted: float | None = None
        self._kept = list(runs[1:])  # the ghosts
        self._build(runs[0])
        self._show(runs)

    def _build(self, run: int) -> None:
        gui, table = self.server.gui, self.library.table
        self._plots = Plots(gui, self.curves, zoom=False)
        self.on(self._plots.time, self._scrub)
        tabs = gui.add_tab_group()
        with tabs.add_tab("Replay"):
            self._status = gui.add_html("")
            self.on(gui.add_button_group("", ("play", "pause", "start")), self._command)
            self.scrubber = gui.add_slider("Time, s", 0.0, 1.0, 0.01, 0.0)
            self.on(self.scrubber, self._scrub)
            self._interval = gui.add_multi_slider("Curves, s", 0.0, 1.0, 0.01, (0.0, 1.0))
            self.on(self._interval, lambda _: self._draw_curves())
            speeds = tuple(name for name, speed in SPEEDS.items() if np.isfinite(speed))
            self.on(gui.add_dropdown("Speed", speeds, initial_value="1×"), self.choose_speed)
            self.add_cameras()
            self._follow = gui.add_checkbox("Camera follows", False)
            self.add_drawing()
            self.on(self.deviation, lambda _: self._show(self.runs))
            self._chosen = gui.add_number(
                "Run", float(run), min=float(table.index[0]), max=float(table.index[-1]), step=1.0
            )
            self.on(self._chosen, lambda run: self._choose(int(run)))
            self.on(gui.add_button("Keep this run as a ghost"), lambda _: self._keep())
            self.on(gui.add_button("Only this run"), lambda _: self._only())
            self.add_download()
        self.add_key("space", "Play or pause", lambda: self._command("pause" if self.playing else "play"))
        self.add_key("arrowright", "Forward by 0.1 s", lambda: self._scrub(self.time + 0.1))
        self.add_key("R", "Start", lambda: self._command("start"))
        self.add_key("F", "Camera follows", lambda: setattr(self._follow, "value", not self._follow.value))
        numbers = [str(name) for name, values in table.select_dtypes("number").nunique().items() if values > 1]
        self._board: list[Any] = []
        self._axes: list[viser.GuiDropdownHandle[str]] = []
        self._area: tuple[np.ndarray, np.ndarray] | None = None  # of the scatter plot
        if len(table) > MAX_SHOWN and numbers:
            with tabs.add_tab("All runs"):
                gui.add_html(block("scatter", *self._explained()))
                last = "position_rmse" if "position_rmse" in numbers else numbers[-1]
                self._columns = {_in_words(name)[1]: name for name in numbers}
                self._axes = [
                    gui.add_dropdown(label, tuple(self._columns), initial_value=_in_words(value)[1])
                    for label, value in (("across", next((n for n in numbers if n != "run"), "run")), ("up", last))
                ]
                for axis in self._axes:
                    self.on(axis, lambda _: self._scatter())

    def _explained(self) -> list[str]:
        """Returns lines of HTML that say what the board shows, and what its colours mean."""
        text = "Each sphere behind the track is a run; failed ones are red, the large one is shown. Click on another."
        column, own = self._colours()
        keys = [f'<span style="color:rgb{c}">■ {html.escape(title_of(name))}</span>' for name, c in own.items()]
        kind = "controller" if column == "feedforward" else _in_words(column)[1]
        return [text, *([f"{html.escape(kind)}: {' &nbsp; '.join(keys)}"] if keys else [])]

    def _colours(self) -> tuple[str, dict[str, Colour]]:
        """Returns by which column runs are coloured, and the colours of its values; none where all are the same.

        It is that of the first axis of a sweep that is no number, such as the world, or else the controller.
        """
        table = self.library.table
        columns = [str(name) for name in table.columns]
        axes = columns[: columns.index("label")] if "label" in columns else []
        words = [name for name in axes if not is_numeric_dtype(table[name]) or is_bool_dtype(table[name])]
        chosen = next((name for name in words if len(set(table[name])) > 1), "feedforward")
        chosen = "feedforward" if chosen in CONTROLLER else chosen  # which has a colour everywhere
        names = [str(name) for name in table[chosen].unique()] if chosen in table else []
        own = {name: look.colour for name, look in zip(names, looks(names, names), strict=True)} if names[1:] else {}
        return chosen, own

    def _scatter(self) -> None:
        """Draws all runs as a scatter plot of two columns of the table, on a board behind the track.

        An axis of positive numbers that differ by more than a factor of `DECADES` is logarithmic.
        """
        scene, table = self.server.scene, self.library.table
        for node in self._board:
            node.remove()
        fields = [axis.value for axis in self._axes]
        columns = [self._columns[field] for field in fields]
        values = table[columns].to_numpy(float) * [_in_words(column)[0] for column in columns]
        known = np.isfinite(values).all(axis=1)
        if not known.any():
            self._board = []
            raise InputError(f"{fields[0]}, {fields[1]}: no run has both numbers")
        low, high = values[known].min(axis=0), values[known].max(axis=0)
        logarithmic = (low > 0) & (high > DECADES * np.abs(low))

        def share(numbers: np.ndarray) -> np.ndarray:
            """Returns how far numbers `(n, 2)` are along the axes."""
            first, last, at = (np.where(logarithmic, np.log(np.maximum(v, TINY)), v) for v in (low, high, numbers))
            return (at - first) / np.where(last > first, last - first, 1.0)

        corner, size = self._area = self._scene.board()
        where = corner + share(values[known])[:, [0, 0, 1]] * size
        failed = table["failed"].to_numpy(bool)[known]
        column, own = self._colours()
        colours = [own[str(name)] for name in table[column][known]] if own else DROVE
        sphere = _sphere(DOT * size[2])
        points = scene.add_batched_meshes_simple(
            "/board/runs", *sphere, np.tile([1.0, 0, 0, 0], (len(where), 1)), where,
            batched_colors=np.where(failed[:, None], FAILED, colours).astype(np.uint8),
            lod="off", cast_shadow=False, receive_shadow=False,
        )  # fmt: skip
        runs = table.index.to_numpy()[known]
        self._places = dict(zip(runs.tolist(), where, strict=True))
        fields = [f"{field}, logarithmic" if scale else field for field, scale in zip(fields, logarithmic, strict=True)]

        @points.on_click
        async def _(event: viser.SceneNodePointerEvent) -> None:
            if event.instance_index is not None:
                self.ask(self._open, int(runs[event.instance_index]))

        frame = np.array([[0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1], [0, 0, 0]], float)
        lines = [np.stack([frame[:-1], frame[1:]], axis=1)]
        labels = {"across": (fields[0], [0.5, 0, -0.2]), "up": (fields[1], [0.2, 0, 1.12])}
        for axis in (0, 1):
            inner = ticks(low[axis], high[axis], bool(logarithmic[axis]))
            for k, number in enumerate([low[axis], *inner, high[axis]]):
                at = share(np.where([axis == 0, axis == 1], number, low))[axis]
                if not 0 < k <= len(inner) or MARGIN < at < 1 - MARGIN:
                    labels[f"{axis}/{k}"] = f"{number:.3g}", [at, 0, -0.08] if axis == 0 else [-0.05, 0, at]
                    lines.append(np.array([[[at, 0, 0], [at, 0, 1]] if axis == 0 else [[0, 0, at], [1, 0, at]]]))
        ring = scene.add_mesh_simple("/board/chosen", 2 * sphere[0], sphere[1], color=CHOSEN, opacity=0.5)
        thick = DOT * size[2] / 4
        self._board = [
            points,
            ring,
            scene.add_line_segments("/board/frame", corner + np.concatenate(lines) * size, GRID, thickness=thick),
            *(
                scene.add_label(f"/board/{key}", text, position=corner + size * at, font_screen_scale=0.8)
                for key, (text, at) in labels.items()
            ),
        ]
        self._mark_chosen()

    def _mark_chosen(self) -> None:
        """Marks the first run that is shown on the board, if it is there."""
        place = self._places.get(self.runs[0]) if self._board and self.runs else None
        if self._board:
            self._board[1].visible = place is not None
        if place is not None:
            self._board[1].position = place

    def _open(self, run: int) -> None:
        self._choose(run)
        self._chosen.value = float(run)

    def _choose(self, run: int) -> None:
        """Shows a run beside the kept ones, each once."""
        self._show(list(dict.fromkeys([run, *self._kept])))

    def _keep(self) -> None:
        if self.runs[0] not in self._kept:
            self._kept.append(self.runs[0])

    def _only(self) -> None:
        self._kept = []
        self._show(self.runs[:1])

    def _show(self, runs: Sequence[int]) -> None:
        """Shows runs in the scene and in the plots."""
        recordings = [self.library.recording(run) for run in runs]
        robots = looks_of(recordings, runs)
        if self.recordings:
            self._scene.remove()
        self.runs, self.recordings = list(runs), recordings
        obstacles = recordings[0].scenario.obstacles
        self._scene = Scene(self.server, recordings[0].model, robots, obstacles, fog=not self._axes)
        times, self._log, self._clearance = joint_log(recordings)
        self._plots.set_robots(robots, recordings[0].period, self._clearance is not None)
        self._deviation = self.magnified_deviation(self._log)
        self._scene.show_recordings(recordings, self._deviation)
        self._times, self._events = times, event_times(recordings)
        self._lap = round(recordings[0].scenario.reference.period / recordings[0].period)
        self._laps = whole_laps(self._log, self._lap, recordings[0].period, read_robot(recordings[0].model))
        self._labels, sensing = [robot.label for robot in robots], [r.scenario.sensing for r in recordings]
        self._latencies = [s.periods("fix_latency", r.period) for s, r in zip(sensing, recordings, strict=True)]
        off = np.nan_to_num(np.hypot(*np.moveaxis(error(self._log), -1, 0)))
        estimated = np.isfinite(self._log["x_measured"][0])
        self.set_marks(
            any(estimated & [s.source != "truth" for s in sensing]),
            max(np.sqrt(np.mean(off**2, axis=0)).max(), *(s["fix_position_noise"] for s in sensing)),
        )
        self.duration = float(times[-1])
        self.scrubber.max = self._interval.max = self._plots.time.max = self.duration
        self._interval.value = (0.0, self.duration)
        self._draw_curves()
        if self._axes and (self._area is None or not np.allclose(self._area, self._scene.board())):
            self._scatter()
        self._mark_chosen()
        self._scrub(self.time, pause=False)

    def _draw_curves(self) -> None:
        """Draws the curves in the chosen interval, the finer the shorter it is."""
        first, last = np.searchsorted(self._times, self._interval.value)
        within = slice(max(0, min(first, len(self._times) - 2)), max(last, first + 1) + 1)
        count = len(self._times[within])
        step = max(1, count // SAMPLES)
        self._plots.show(self._times, self._log, self._clearance, step, self._events, within)
        self._plotted = None

    @override
    def shown(self) -> list[Recording]:
        return self.recordings

    def _command(self, name: str) -> None:
        self.playing = name == "play"
        if name == "start" or (self.playing and self.time >= self.duration):
            self._scrub(0.0, pause=name == "start")

    def _scrub(self, time: float, pause: bool = True) -> None:
        self.time = min(time, self.duration)
        self.playing = self.playing and not pause
        self._drawn = self._plotted = None

    @override
    def advance(self, elapsed: float, until: float) -> None:
        self.time = min(self.time + elapsed * self.speed, self.duration)
        if self.time >= self.duration:
            self.playing = False

    @override
    def idle_time(self) -> float:
        return 1.0  # longer than the time to the next picture, which limits it

    @override
    def draw(self) -> None:
        marked, magnified = self.marks
        now = self.time, self._follow.value, marked, magnified
        if now == self._drawn:
            return
        self._drawn = now
        for row, recording in enumerate(self.recordings):
            self._scene.show(row, recording.qpos(recording.index(self.time)))
            self._scene.show_payload(row, recording.perturbation(self.time))
            self._scene.show_force(row, pushed(recording.scenario, recording.start + self.time))
        self._scene.show_ends(ends(self.recordings[0].scenario, self.recordings[0].start + self.time))
        period, logs = self.recordings[0].period, []
        if marked:
            ticks = round(FIX_AGE / period)
            for recording, latency in zip(self.recordings, self._latencies, strict=True):
                index = recording.index(self.time)
                logs.append(recording.log[max(0, index + 1 - ticks - latency) : index + 1])
        now = np.stack([recording.log[recording.index(self.time)] for recording in self.recordings])
        with self.server.atomic():
            self._scene.show_targets(now, self._deviation)
            self._scene.show_obstacles(self.recordings[0].start + self.time)
            self._scene.show_sensors(logs, period, self._latencies, magnified)
            self._scene.flush(self._follow.value)
        self.chase()

    @override
    def refresh(self) -> None:
        state = "playing" if self.playing else "paused"
        lines = [f"<b>{self.time:.2f} s</b> of {self.duration:.2f} s · {state}"]
        for r in self.recordings:
            if r.failure:
                lines.append(warning(f"{r.label} stopped after {r.duration:.2f} s: {r.failure}"))
            lines += [warning(f"{r.label}: {fault}") for fault in r.faults]
        last = np.stack([r.log[r.index(self.time)] for r in self.recordings])
        lines += arrivals(self._labels, last, ends(self.recordings[0].scenario, self.recordings[0].start + self.time))
        row = self.library.table.loc[self.runs[0]]
        known = [_stated(str(column), value) for column, value in row.items() if isinstance(value, int | float)]
        lines += [line for line in known if line]
        if self._kept:
            lines.append(f"kept as ghosts: runs {', '.join(map(str, sorted(self._kept)))}")
        write(self._status, block("status", *lines))
        self.describe_estimates(self._labels, last)
        if self.time != self._plotted:
            self._plotted = self.time
            self.scrubber.value = self._plots.time.value = self.time  # a click there again changes it again
            tick = min(round(self.time / self.recordings[0].period), len(self._log) - 1)
            self._plots.score(self._log[tick], self._laps[: (tick + 1) // self._lap])
            start, end = self._interval.value
            self._plots.point((self.time - start) / (end - start) if end > start else 0.0)


def _in_words(column: str) -> tuple[float, str]:
    """Returns the factor on a column's values, and its name in words with the unit; errors are in mm, as in figures."""
    unit, text = METRICS.get(column, KNOWN.get(column, ("1", column.replace(".", ", ").replace("_", " "))))
    if unit == "1":
        return 1.0, text
    milli = unit.startswith(("m", "rad"))
    return (1e3 if milli else 1.0), f"{text}, {'m' * milli}{unit}"


def _stated(column: str, value: float) -> str:
    """Returns a number of a run in words with its unit as HTML; "" for what is not known or not worth a line."""
    if isinstance(value, bool) or not np.isfinite(value):
        return ""
    factor, words = _in_words(column)
    text, _, unit = words.partition(", ") if column in METRICS or column in KNOWN else (words, "", "")
    number = f"{value:d}" if isinstance(value, int) else f"{factor * value:.4g}"
    return html.escape(f"{text}: {number} {unit}".rstrip())


def ticks(low: float, high: float, logarithmic: bool) -> list[float]:
    """Returns about `TICKS` round numbers between two: on a logarithmic axis powers of ten."""
    if not low < high:
        return []
    if logarithmic:
        first, last = ceil(log10(low)), floor(log10(high))
        return [10.0**k for k in range(first, last + 1, max(1, round((last - first) / TICKS))) if low < 10.0**k < high]
    rough = (high - low) / TICKS
    power = 10.0 ** floor(log10(rough))
    step = next(power * s for s in (1, 2, 5, 10) if s * power >= rough * (1 - 1e-9))
    return [step * k for k in range(ceil(low / step), floor(high / step) + 1) if low < step * k < high]


def _sphere(radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns vertices and faces of an octahedron of a radius in m, which looks like a sphere at this size."""
    corners = radius * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], float)
    faces = [[a, b, c] for a in (0, 1) for b in (2, 3) for c in (4, 5)]
    faces = [f if np.linalg.det(corners[f]) > 0 else f[::-1] for f in faces]
    return corners, np.array(faces)
