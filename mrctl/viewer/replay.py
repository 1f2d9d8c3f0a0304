"""The replay of a result or a sweep in the browser, with a scrubber."""

from __future__ import annotations

import html
from collections.abc import Sequence

import numpy as np
from typing_extensions import override

from mrctl.loop.timeline import ends
from mrctl.physics.parameters import read_robot
from mrctl.record import InputError
from mrctl.viewer.looks import MAX_MARKED
from mrctl.viewer.page import SPEEDS, Page, not_before_the_start
from mrctl.viewer.plots import Plots, references_differ
from mrctl.viewer.recording import MAX_SHOWN, Library, Recording, event_times, joint_log, looks_of
from mrctl.viewer.scatter import Scatter, meaning, numbers_of
from mrctl.viewer.scene import Scene
from mrctl.viewer.score import Metrics
from mrctl.viewer.sensors import FIX_AGE, error
from mrctl.viewer.server import Server
from mrctl.viewer.words import arrivals, block, failures

SAMPLES = 800  # about the largest number of samples in a curve


class ReplayPage(Page):
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
        self._plotted: tuple[float, bool] | None = None
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
            # Without marks: the page cuts off the last one, and the scrubber has the same.
            self._interval = gui.add_multi_slider("Curves, s", 0.0, 1.0, 0.01, (0.0, 1.0), marks=())
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
        self.add_key("N", "Forward by 0.1 s", lambda: self._scrub(self.time + 0.1))
        self.add_key("R", "Start", lambda: self._command("start"))
        self.add_key("F", "Camera follows", lambda: setattr(self._follow, "value", not self._follow.value))
        self._scatter: Scatter | None = None
        if len(table) > MAX_SHOWN and numbers_of(table):
            with tabs.add_tab("All runs"):
                self._scatter = Scatter(gui, table, self.on, run)
            self.on(self._scatter.run, lambda run: self._choose(int(run)))

    def _choose(self, run: int) -> None:
        """Shows a run beside the kept ones, each once.

        Raises:
            InputError: There is no such run, or it cannot share the scene; the page goes on with the one before.
        """
        try:
            self._show(list(dict.fromkeys([run, *self._kept])))
        except InputError:
            self._mark_chosen()
            raise

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
        self._scene = Scene(self.server, recordings[0].model, robots, obstacles)
        times, self._log, self._clearance = joint_log(recordings)
        walls, apart = self._clearance is not None, references_differ(self._log)
        self._plots.set_robots(robots, recordings[0].period, walls, apart)
        self._deviation = self.magnified_deviation(self._log)
        self._scene.show_recordings(recordings, self._deviation)
        self._times, self._events = times, event_times(recordings)
        self._metrics = Metrics(read_robot(recordings[0].model), recordings[0].period)
        learned = [np.full((8, 2), np.nan) if r.parameter_error is None else r.parameter_error for r in recordings]
        self._parameter_error = None if np.isnan(learned).all() else np.stack(learned)
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
        self._mark_chosen()
        self._scrub(self.time, pause=False)

    def _mark_chosen(self) -> None:
        """Shows in the inputs which run is shown."""
        self._chosen.value = float(self.runs[0])
        if self._scatter is not None:
            self._scatter.show(self.runs[0])

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
        self.time = min(not_before_the_start(time), self.duration)
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
        period, logs, scans = self.recordings[0].period, [], []
        if marked:
            met = [recording.scan(recording.index(self.time)) for recording in self.recordings[:MAX_MARKED]]
            scans = [None if places is None else (places, np.zeros((0, 3))) for places in met]
            ticks = round(FIX_AGE / period)
            for recording, latency in zip(self.recordings, self._latencies, strict=True):
                index = recording.index(self.time)
                logs.append(recording.log[max(0, index + 1 - ticks - latency) : index + 1])
        with self.server.atomic():
            self._scene.show_moment(self.recordings, self.time, self._deviation)
            self._scene.show_sensors(logs, period, self._latencies, magnified)
            self._scene.navigation.show_scans(scans)
            self._scene.flush(self._follow.value)
        self.chase()

    @override
    def refresh(self) -> None:
        state = "playing" if self.playing else "paused"
        lines = [f"<b>{self.time:.2f} s</b> of {self.duration:.2f} s · {state}"]
        lines += failures(self._labels, self.recordings)
        last = np.stack([r.log[r.index(self.time)] for r in self.recordings])
        bounds = [ends(recording.scenario, recording.start + self.time) for recording in self.recordings]
        lines += arrivals(self._labels, last, bounds)
        part = "the run's last lap" if self.recordings[0].scenario.goal is None else "its whole way"
        lines.append(f"<b>{html.escape(self._labels[0])}, metrics of {part}:</b>")
        row = self.library.table.loc[self.runs[0]]
        known = [_stated(str(column), value) for column, value in row.items() if isinstance(value, int | float)]
        lines += [line for line in known if line]
        if self._kept:
            lines.append(f"kept as ghosts: runs {', '.join(map(str, sorted(self._kept)))}")
        self._status.content = block("status", *lines)
        self.describe_estimates(self._labels, last)
        if (self.time, self.playing) != self._plotted:  # what is playing may be shown a little late
            self._plotted = self.time, self.playing
            self.scrubber.value = self._plots.time.value = self.time  # a click there again changes it again
            tick = min(round(self.time / self.recordings[0].period), len(self._log) - 1)
            scenarios, first = [r.scenario for r in self.recordings], self.recordings[0]
            begun = round(first.start / first.period)
            self._metrics.update(scenarios, lambda a, b: self._log[a:b], tick + 1, begun, exact=not self.playing)
            self._plots.score(self._log[tick], self._metrics, self._parameter_error, "at the end")
            start, end = self._interval.value
            self._plots.point((self.time - start) / (end - start) if end > start else 0.0)


def _stated(column: str, value: float) -> str:
    """Returns a number of a run in words with its unit as HTML; "" for what is not known or not worth a line."""
    if isinstance(value, bool) or not np.isfinite(value):
        return ""
    factor, text, unit = meaning(column)
    number = f"{value:d}" if isinstance(value, int) else f"{factor * value:.4g}"
    return html.escape(f"{text}: {number} {unit}".rstrip())
