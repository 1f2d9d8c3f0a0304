"""The curves in live pages, replays and exported files: tracking, and the shares of feedback and feedforward."""

from __future__ import annotations

import html
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import viser
from viser import uplot

from mrctl.kernel import Array, Rows
from mrctl.physics.pictures import REFERENCE_COLOUR
from mrctl.results.dataset import blank
from mrctl.viewer.looks import EVENT_COLOUR, Colour, Look, pale
from mrctl.viewer.score import Metrics, lessons, table

SHARE_WINDOW = 1.0  # s over which the share of the feedback is averaged
CURSOR_COLOUR: Colour = (107, 114, 128)
# The values under the mouse stand over a chart, and in the others, whose cursors follow; the marks of events have none.
HOVER = """<style>
.uplot-container .u-legend { display: none; position: absolute; top: 1.5em; right: 0.5em; z-index: 9; margin: 0;
    padding: 0.2em 0.5em; text-align: left; background: var(--mantine-color-body); opacity: 0.9; pointer-events: none }
.uplot-container:hover .u-legend { display: block }
.uplot-container .u-legend .u-series { display: block }
.uplot-container .u-legend .u-series:last-child, .u-over .u-cursor-pt:last-child { display: none }
</style>"""
# A click on a curve writes its time into the number field above the charts, as a visitor would type it; viser has no
# event for it. What began as a drag zooms in. The charts are where viser shows them to tests of pages.
GO_TO = """<style onload="
if (!window.mrctlGoTo) {
    let down = 0;
    window.addEventListener('pointerdown', (event) => { down = event.clientX; }, true);
    window.addEventListener('click', window.mrctlGoTo = (event) => {
        const over = event.target.closest && event.target.closest('.u-over');
        if (!over || Math.abs(event.clientX - down) > 3) return;
        const chart = Object.values(window.__viserTestpoints.uplots).map((u) => u.chart).find((c) => c.over === over);
        const label = [...document.querySelectorAll('label')].find((l) => l.textContent === 'GOTO');
        if (!chart || !label) return;
        const field = document.getElementById(label.htmlFor), at = event.clientX - over.getBoundingClientRect().left;
        const set = Object.getOwnPropertyDescriptor(HTMLInputElement.prototype, 'value').set;
        set.call(field, Math.max(0, chart.posToVal(at, 'x')).toFixed(2));
        field.dispatchEvent(new Event('input', { bubbles: true }));
    }, true);
}"></style>""".replace("GOTO", TIME := "Go to, s")
LAST_PLACE = 1e12  # place of what stands below the charts, which are added later; viser numbers elements from 1 on
MAX_ROBOTS = 4  # number of robots whose curves are drawn


class Curve(NamedTuple):
    """One line of a chart."""

    label: str
    colour: Colour
    dashed: bool
    values: Array
    width: float = 1.5  # pixels


class Chart(NamedTuple):
    """Curves with one axis, which shows at least an interval: a curve of zeros is flat, at any scale."""

    title: str
    curves: list[Curve]
    least: tuple[float, float]


def references_differ(log: Rows) -> bool:
    """Tells whether the robots whose curves are drawn from a log, `(T, B)`, follow different references."""
    drawn = log[:, :MAX_ROBOTS]
    return any((np.abs(drawn[name] - drawn[name][:, :1]) > 0).any() for name in ("v_ref", "omega_ref"))


def charts(
    log: Rows, robots: Sequence[Look], period: float, clearance: Array | None = None, own_references: bool = False
) -> list[Chart]:
    """Returns the charts of a log.

    Args:
        log: Record of `results.dataset.TICK` for each sample and robot, `(T, B)`.
        robots: Look of each robot.
        period: Time between samples in s.
        clearance: Distance of each robot from the nearest obstacle in m, `(T, B)`; None where there are no obstacles.
        own_references: Whether each robot has a reference of its own, which is then drawn in its colour.
    """
    shown = range(min(len(robots), MAX_ROBOTS))

    def signal(name: str, row: int) -> Array:
        return log[name][:, row]

    def each(quantity: str, values: Sequence[Array], dashed: bool = False) -> list[Curve]:
        return [Curve(f"{robots[r].label} {quantity}", robots[r].colour, dashed, values[r]) for r in shown]

    def tracked(title: str, name: str, least: tuple[float, float]) -> Chart:
        if own_references:
            references = each(f"{name} reference", [signal(f"{name}_ref", r) for r in shown], dashed=True)
        else:
            references = [Curve("reference", REFERENCE_COLOUR, False, signal(f"{name}_ref", 0))]
        estimated = [
            Curve(
                f"{robots[r].label} {name} estimated",
                pale(robots[r].colour),
                False,
                signal(f"{name}_measured", r),
                4.5,
            )
            for r in shown
        ]
        return Chart(title, [*references, *estimated, *each(name, [signal(name, r) for r in shown])], least)

    def voltages(title: str, sign: float) -> Chart:
        parts = {
            part: [(signal(f"{part}_right", r) + sign * signal(f"{part}_left", r)) / 2 for r in shown]
            for part in ("feedback", "feedforward")
        }
        curves = each("feedback", parts["feedback"]) + each("feedforward", parts["feedforward"], dashed=True)
        return Chart(title, curves, (-1.0, 1.0))

    def squares(part: str, row: int) -> Array:
        both = signal(f"{part}_left", row) ** 2 + signal(f"{part}_right", row) ** 2
        return np.where(np.isfinite(both), _moving_mean(both, round(SHARE_WINDOW / period)), np.nan)

    with np.errstate(invalid="ignore", divide="ignore"):
        shares = [np.sqrt(squares("feedback", r) / squares("voltage", r)) for r in shown]
    position = [1e3 * np.hypot(signal("longitudinal_error", r), signal("lateral_error", r)) for r in shown]
    near = [] if clearance is None else [each("clearance", [clearance[:, r] for r in shown])]
    return [
        Chart("position error, mm", each("position error", position), (0.0, 1.0)),
        tracked("V, m/s", "v", (0.0, 0.1)),
        tracked("θ̇, rad/s", "omega", (-0.1, 0.1)),
        *(Chart("clearance, m", curves, (0.0, 0.1)) for curves in near),
        Chart("share of the voltage that is feedback, last second", each("share", shares), (0.0, 1.0)),
        voltages("Σ, mean of left and right, V; feedforward dashed", 1.0),
        voltages("Δ, half of right less left, V; feedforward dashed", -1.0),
        Chart(
            "norm of the learned weights, ‖W‖",
            each("weight norm", [signal("weight_norm", r) for r in shown]),
            (0.0, 0.1),
        ),
        Chart(
            "saturated; guard dashed",
            each("saturated", [signal("saturated", r) for r in shown])
            + each("guard", [signal("guard", r) for r in shown], dashed=True),
            (0.0, 1.0),
        ),
    ]


def _moving_mean(values: Array, window: int) -> Array:
    """Returns the mean of the last `window` values, or of fewer at the beginning; a NaN counts as 0."""
    total = np.concatenate([[0.0], np.cumsum(np.nan_to_num(values))])
    end = np.arange(1, len(values) + 1)
    first = np.maximum(end - window, 0)
    return (total[end] - total[first]) / (end - first)


class Plots:
    """The uPlot charts of a page.

    There is a set of charts for each number of robots so far, with and without obstacles and references of their own,
    of which one is visible; as in `Controls`, nothing is removed.

    Attributes:
        time: Input of a time in s to go to, which a click on a curve sets, too.
    """

    def __init__(self, gui: viser.GuiApi, tab: viser.GuiTabHandle, zoom: bool = True) -> None:
        """Takes the GUI of the page and the tab for the charts; `zoom` lets a visitor zoom in along the time."""
        self._gui, self._tab, self._zoom = gui, tab, zoom
        self._sets: dict[tuple[int, bool, bool], list[viser.GuiUplotHandle]] = {}
        with tab:
            self._legend = gui.add_html("")
            self._score = gui.add_html("")
            self._cursor = gui.add_html("")
            gui.add_html(HOVER + GO_TO)
            self._lessons = gui.add_html("", order=LAST_PLACE)
            self.time = gui.add_number(TIME, 0.0, min=0.0, step=0.01, hint="A click on a curve sets it, too.")

    def set_robots(self, robots: Sequence[Look], period: float, obstacles: bool, own_references: bool = False) -> None:
        """Sets the robots whose curves `show` will draw.

        Args:
            robots: Look of each robot.
            period: Time between samples in s.
            obstacles: Whether there are obstacles, so that the clearance is drawn.
            own_references: As in `charts`.
        """
        self._robots, self._period, self._obstacles, self._own_references = robots, period, obstacles, own_references
        self._legend.content = legend(robots, own_references)
        size = min(len(robots), MAX_ROBOTS)
        drawn = charts(blank(2, size), robots[:size], period, self._nowhere(), own_references)
        chosen = size, obstacles, own_references
        if chosen not in self._sets:
            with self._tab:
                self._sets[chosen] = [_add(self._gui, chart, self._zoom) for chart in drawn]
        for key, handles in self._sets.items():
            for handle in handles:
                handle.visible = key == chosen
        self._handles = self._sets[chosen]
        for handle, chart in zip(self._handles, drawn, strict=True):
            if handle.series != (series := _series(chart)):
                handle.series = series

    def _nowhere(self) -> Array | None:
        """Returns a clearance of two samples that is not drawn, `(2, B)`, or None without obstacles."""
        return np.full((2, len(self._robots)), np.nan) if self._obstacles else None

    def show(
        self,
        time: Array,
        log: Rows,
        clearance: Array | None,
        step: int,
        events: Sequence[float] = (),
        within: slice = slice(None),
    ) -> None:
        """Draws a log.

        Args:
            time: Times of the samples in s, `(T,)`.
            log: Record of `TICK` for each sample and robot, `(T, B)`.
            clearance: As in `charts`, `(T, B)`.
            step: Number of samples from one drawn sample to the next.
            events: Times of events in s.
            within: Samples that are drawn.
        """
        drawn = time[within][::step]
        marks = np.full(len(drawn), -1, np.int8)  # below or above the chart: a line that crosses it marks an event
        for first in np.unique(np.searchsorted(drawn, events)):
            if first > 0:
                marks[first:] *= -1
        found = charts(log, self._robots, self._period, clearance, self._own_references)
        for handle, chart in zip(self._handles, found, strict=True):
            values = [time, *(curve.values for curve in chart.curves)]
            _send(handle, (*(v[within][::step].astype(np.float32) for v in values), marks))

    def score(self, now: Rows, metrics: Metrics, error: Array | None, when: str) -> None:
        """Writes the score above the charts, as `score.table` does, and below them what `score.lessons` says."""
        self._score.content = table(self._robots, now, metrics.laps, metrics.way)
        self._lessons.content = lessons(self._robots, metrics.laps, metrics.way, error, when)

    def clear(self, span: float, metrics: Metrics) -> None:
        """Draws empty charts of `span` s, and a score without present errors."""
        nothing = blank(2, len(self._robots))
        self.show(np.array([0.0, span]), nothing, self._nowhere(), 1)
        self.score(nothing[0], metrics, None, "")

    def point(self, share: float | None) -> None:
        """Draws a vertical line in all charts at a share of their time, or none; their data need not be sent again."""
        if share is None:
            self._cursor.content = ""
            return
        left = f"{100 * share:.3f}%"
        line = f"content:'';position:absolute;top:0;bottom:0;left:{left};border-left:1px solid rgb{CURSOR_COLOUR}"
        over = ".uplot:has(.u-legend) .u-over"  # charts over time, which have legends
        self._cursor.content = f"<style>{over}{{overflow:hidden}}{over}::after{{{line}}}</style>"


def legend(robots: Sequence[Look], own_references: bool) -> str:
    """Returns the legend of robots and their colours in HTML; `own_references` is as in `charts`."""
    whole = "display:inline-block;color:rgb"  # a line ends between keys
    keys = []
    if len(robots) > MAX_ROBOTS:  # first, because a long legend is cut off
        keys += [f"Curves are of the first {MAX_ROBOTS} of {len(robots)} robots."]
    keys += [f'<span style="{whole}{colour}">■ {html.escape(label)}</span>' for label, colour in robots]
    keys += [f'<span style="{whole}{REFERENCE_COLOUR}">■ reference</span>']
    keys += ["V, θ̇: reference of each robot dashed."] * own_references
    keys += [f'<span style="{whole}{pale(robots[0].colour)}">■ pale: estimated V, θ̇</span>']
    keys += ["Time in s."]
    return f'<p style="margin:0.3em 1em;max-height:9em;overflow:auto">{" &nbsp; ".join(keys)}</p>'


def _series(chart: Chart) -> tuple[uplot.Series, ...]:
    """Returns the series of a chart: the time, its curves, and the marks of events."""
    points: uplot.Series_Points = {"show": False}
    curves = [
        uplot.Series(
            label=c.label, stroke=f"rgb{c.colour}", width=c.width, dash=(5, 4) if c.dashed else (), points=points
        )
        for c in chart.curves
    ]
    marks = uplot.Series(
        label="event", scale="event", stroke=f"rgb{EVENT_COLOUR}", width=1.5, dash=(5, 4), points=points
    )
    return uplot.Series(label="s"), *curves, marks


def _send(handle: viser.GuiUplotHandle, data: tuple[np.ndarray, ...]) -> None:
    """Sends data to a chart as they are; viser would make each number eight bytes long, twice what a curve needs."""
    props: Any = handle._impl.props
    props.data = data
    handle._queue_update("data", data)


def _add(gui: viser.GuiApi, chart: Chart, zoom: bool) -> viser.GuiUplotHandle:
    series = _series(chart)
    low, high = ({"pad": 0.1, "soft": soft, "mode": 1} for soft in chart.least)
    return gui.add_uplot(
        tuple(np.zeros(2) for _ in series),
        series,
        title=chart.title,
        scales={"x": {"time": False}, "y": {"range": {"min": low, "max": high}}, "event": {"range": (-0.5, 0.5)}},
        axes=({"size": 24, "ticks": {"size": 4}}, {"size": 56, "ticks": {"size": 4}, "space": 16}),  # px
        height=112,
        padding=(8, 18, 0, 0),  # to the right for half of the last time
        cursor={"sync": {"key": "mrctl"}, "drag": {"x": zoom, "y": False}},
    )
