"""All runs of a sweep as a scatter plot of two columns of its table."""

from __future__ import annotations

import html
from collections.abc import Callable
from typing import Any

import numpy as np
import pandas as pd
import viser
from pandas.api.types import is_bool_dtype, is_numeric_dtype
from viser import uplot

from mrctl.record import InputError
from mrctl.results.controllers import CONTROLLER_FIELDS, title_of
from mrctl.results.metrics import METRICS, shown_unit
from mrctl.viewer.looks import Colour, looks
from mrctl.viewer.plots import CURSOR_COLOUR
from mrctl.viewer.words import block

DROVE_COLOUR, FAILED_COLOUR = (71, 85, 105), (185, 28, 28)
DOT_SIZE, RING_SIZE = 9.0, 20.0  # pixels, diameters of the dot of a run and of the ring around the one that is shown
# Unit and words of the columns of a table that are not in `METRICS`.
KNOWN_COLUMNS = {"lap_time": ("s", "time of a lap"), "failure_time": ("s", "failed after"), "laps": ("1", "laps")}
LOGARITHMIC_RATIO = 30.0  # ratio of largest to least beyond which an axis is logarithmic
AXIS_MARGIN = 0.06  # share of an axis that is left free at its ends
RUN = "Run to show"  # label of a number field
# A click near a run writes its number into that field; see `plots.GO_TO`.
OPEN = """<style onload="
if (!window.mrctlOpen) window.addEventListener('click', window.mrctlOpen = (event) => {
    const over = event.target.closest && event.target.closest('.u-over');
    if (!over) return;
    const chart = Object.values(window.__viserTestpoints.uplots).map((u) => u.chart).find((c) => c.over === over);
    if (!chart || chart.series[1].label !== 'run') return;
    const box = over.getBoundingClientRect(), [x, runs, y] = chart.data;
    let best = 400, run = null; // within 20 pixels
    for (let k = 0; k < runs.length; k++) {
        const left = chart.valToPos(x[k], 'x') - event.clientX + box.left;
        const top = chart.valToPos(y[k], 'y') - event.clientY + box.top;
        if (left * left + top * top < best) { best = left * left + top * top; run = runs[k]; }
    }
    if (run === null) return;
    const label = [...document.querySelectorAll('label')].find((l) => l.textContent === 'RUN');
    const field = document.getElementById(label.htmlFor);
    const set = Object.getOwnPropertyDescriptor(HTMLInputElement.prototype, 'value').set;
    set.call(field, run);
    field.dispatchEvent(new Event('input', { bubbles: true }));
}, true);"></style>""".replace("RUN", RUN)


class Scatter:
    """A scatter plot of two columns, which a visitor chooses; a click on a run opens it.

    Attributes:
        axes: Inputs of the columns across and up.
        run: Input of the number of the run that is shown, which a click sets.
        data: What is drawn, sorted by the first of them: the values across, the numbers of the runs, the values up, and
            again the values up in each colour, of failed runs, and of the run that is shown, NaN elsewhere.
        logarithmic: Which of the two axes are.
    """

    def __init__(
        self, gui: viser.GuiApi, table: pd.DataFrame, on: Callable[[Any, Callable[[Any], None]], None], run: int
    ) -> None:
        """Adds the plot in the present context of the GUI.

        Args:
            gui: GUI of the page.
            table: Table of the runs; at least one column of numbers has more than one value.
            on: `Page.on`.
            run: The run that is shown.
        """
        self._table = table
        numbers = numbers_of(table)
        self._columns = {in_words(name)[1]: name for name in numbers}
        last = "position_rmse" if "position_rmse" in numbers else numbers[-1]
        gui.add_html(block("scatter", *self._explained()) + OPEN)
        self.axes = [
            gui.add_dropdown(label, tuple(self._columns), initial_value=in_words(value)[1])
            for label, value in (("across", next((n for n in numbers if n != "run"), "run")), ("up", last))
        ]
        for axis in self.axes:
            on(axis, lambda _: self.draw())
        self.run = gui.add_number(RUN, run, min=int(table.index[0]), max=int(table.index[-1]), step=1)
        scales = self._prepare()
        self._chart = gui.add_uplot(
            self.data, self._series(), scales=scales, axes=self._labels(), height=300, padding=(12, 12, 0, 0),
            legend={"show": False}, cursor={"show": False},
        )  # fmt: skip

    def _explained(self) -> list[str]:
        """Returns lines of HTML that say what the plot shows, and what its colours mean."""
        text = "Each dot is a run; failed ones are red, and the one with a ring is shown. Click on another."
        column, own = self.colours()
        keys = [f'<span style="color:rgb{c}">■ {html.escape(title_of(name))}</span>' for name, c in own.items()]
        kind = "controller" if column == "feedforward" else in_words(column)[1]
        return [text, *([f"{html.escape(kind)}: {' &nbsp; '.join(keys)}"] if keys else [])]

    def colours(self) -> tuple[str, dict[str, Colour]]:
        """Returns by which column runs are coloured, and the colours of its values; none where all are the same.

        It is that of the first axis of a sweep that is no number, such as the world, or else the controller.
        """
        table = self._table
        columns = [str(name) for name in table.columns]
        axes = columns[: columns.index("label")] if "label" in columns else []
        words = [name for name in axes if not is_numeric_dtype(table[name]) or is_bool_dtype(table[name])]
        chosen = next((name for name in words if len(set(table[name])) > 1), "feedforward")
        chosen = "feedforward" if chosen in CONTROLLER_FIELDS else chosen  # which has a colour everywhere
        names = [str(name) for name in table[chosen].unique()] if chosen in table else []
        own = {name: look.colour for name, look in zip(names, looks(names, names), strict=True)} if names[1:] else {}
        return chosen, own

    def _prepare(self) -> dict[str, uplot.Scale]:
        """Sets `data` and `logarithmic`, and returns the scales of the axes.

        An axis of positive numbers that differ by more than a factor of `LOGARITHMIC_RATIO` is logarithmic.

        Raises:
            InputError: No run has both numbers.
        """
        columns = [self._columns[axis.value] for axis in self.axes]
        values = self._table[columns].to_numpy(float) * [in_words(column)[0] for column in columns]
        known = np.flatnonzero(np.isfinite(values).all(axis=1))
        if not len(known):
            raise InputError(f"{self.axes[0].value}, {self.axes[1].value}: no run has both numbers")
        order = known[np.argsort(values[known, 0], kind="stable")]
        (across, up), runs = values[order].T, self._table.index.to_numpy()[order]
        failed = self._table["failed"].to_numpy(bool)[order]
        column, own = self.colours()
        kinds = self._table[column].astype(str).to_numpy()[order] if own else np.zeros(len(order))
        classes = [~failed & (kinds == name) for name in own or [0.0]]
        drawn = [np.where(mask, up, np.nan) for mask in (*classes, failed, runs == self.run.value)]
        self.data = tuple(np.array(part, float) for part in (across, runs, up, *drawn))
        self.logarithmic, scales = [], dict[str, uplot.Scale](run={"range": (0.0, 1.0)})
        for name, numbers in (("x", across), ("y", up)):
            low, high = float(numbers.min()), float(numbers.max())
            logarithmic = bool(0 < LOGARITHMIC_RATIO * low < high)
            if logarithmic:
                ends = low * (low / high) ** AXIS_MARGIN, high * (high / low) ** AXIS_MARGIN
            else:
                free = AXIS_MARGIN * (high - low) or 0.5 * abs(high) or 0.5
                ends = low - free, high + free
            scales[name] = {"time": False, "distr": 3 if logarithmic else 1, "range": ends}
            self.logarithmic.append(logarithmic)
        return scales

    def _series(self) -> tuple[uplot.Series, ...]:
        """Returns the series of `data`."""
        dots = [*(self.colours()[1].values() or [DROVE_COLOUR]), FAILED_COLOUR]
        points: list[uplot.Series_Points] = [
            {"show": True, "size": DOT_SIZE, "width": 0, "fill": f"rgb{colour}"} for colour in dots
        ]
        points.append(
            {"show": True, "size": RING_SIZE, "width": 3, "stroke": f"rgb{CURSOR_COLOUR}", "fill": "transparent"}
        )
        hidden: uplot.Series_Points = {"show": False}
        return (
            uplot.Series(label="across"),
            uplot.Series(label="run", scale="run", width=0, points=hidden),
            uplot.Series(label="up", width=0, points=hidden),
            *(uplot.Series(label=f"{k}", width=0, points=kind) for k, kind in enumerate(points)),
        )

    def _labels(self) -> tuple[uplot.Axis, ...]:
        """Returns the axes, which say what they show."""
        words = [
            f"{axis.value}, logarithmic" if logarithmic else axis.value
            for axis, logarithmic in zip(self.axes, self.logarithmic, strict=True)
        ]
        small: uplot.Axis_Ticks = {"size": 4}
        across = uplot.Axis(label=words[0], labelSize=20, size=24, ticks=small)
        return across, uplot.Axis(label=words[1], labelSize=20, size=52, ticks=small)

    def draw(self) -> None:
        """Draws the chosen columns.

        Raises:
            InputError: No run has both numbers.
        """
        scales, chart = self._prepare(), self._chart
        chart.data, chart.scales, chart.axes = self.data, scales, self._labels()

    def show(self, run: int) -> None:
        """Marks the run that is shown."""
        self.run.value = run
        self._prepare()
        self._chart.data = self.data


def numbers_of(table: pd.DataFrame) -> list[str]:
    """Returns the columns of numbers that are not the same in all runs."""
    return [str(name) for name, values in table.select_dtypes("number").nunique().items() if values > 1]


def meaning(column: str) -> tuple[float, str, str]:
    """Returns the factor on a column's values, its name in words, and the unit; errors are in mm, as in figures."""
    unit, text = METRICS.get(column, KNOWN_COLUMNS.get(column, ("1", column.replace(".", ", ").replace("_", " "))))
    factor, unit = shown_unit(unit)
    return factor, text, unit


def in_words(column: str) -> tuple[float, str]:
    """Returns the factor of `meaning`, and the name with the unit."""
    factor, text, unit = meaning(column)
    return factor, f"{text}, {unit}" if unit else text
