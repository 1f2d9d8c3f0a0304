"""Figures of a result for print, 88 mm or 180 mm wide, with Okabe and Ito's (2008) colours and units on every axis.

Each function returns a matplotlib `Figure` and shows nothing. Results may hold several runs or one that was squeezed;
runs with the same `label` share a colour and one entry in the legend, which says how many of them failed. A heading
names the plant. Errors are in mm and mrad, as in tables. A cross marks where a run failed. `window` is a pair of times
in s; `lap` is the number of a lap, counted from 1, or from −1 backwards from the end of the run.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import wraps
from itertools import cycle
from pathlib import Path
from typing import Any, NamedTuple, ParamSpec

import matplotlib as mpl
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Polygon
from matplotlib.patheffects import withStroke
from matplotlib.rcsetup import cycler
from matplotlib.ticker import LogFormatterSciNotation, LogLocator
from numpy.typing import ArrayLike, NDArray

from mrctl.kernel import Array
from mrctl.record import InputError
from mrctl.results import excitation as exciting
from mrctl.results.controllers import colours_of
from mrctl.results.dataset import METRICS_ONLY, check_kind, held_scenarios, scenarios_of, unique_runs
from mrctl.results.metrics import METRICS, as_runs, known, laps_of, per_lap, shown_unit
from mrctl.theory.obstacles import Obstacles, turned
from mrctl.theory.perturbation import PERTURBATIONS, Perturbation

__all__ = [
    "compare_errors", "distributions", "errors", "excitation", "feedforward_outputs", "inverse_dynamics",
    "laps_by_case", "learning_curve", "path", "save", "velocities", "voltages",
]  # fmt: skip

COLUMN_WIDTH, PAGE_WIDTH = 88 / 25.4, 180 / 25.4  # inches
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7F6000")
REFERENCE: dict[str, Any] = {"color": "0.25", "lw": 0.8, "ls": (0, (4, 2)), "zorder": 3}
FORMATS = ("png", "pdf")
STYLE: dict[Any, Any] = {
    "font.family": "STIXGeneral",
    "mathtext.fontset": "stix",
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.labelsize": 9,
    "legend.fontsize": 8,
    "legend.title_fontsize": 8,
    "figure.titlesize": 8,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "axes.linewidth": 0.6,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.formatter.limits": (-3, 4),
    "axes.formatter.use_mathtext": True,
    "axes.prop_cycle": cycler(color=COLOURS),
    "grid.color": "0.9",
    "grid.linewidth": 0.5,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "lines.linewidth": 1.0,
    "legend.frameon": False,
    "legend.handlelength": 1.6,
    "figure.dpi": 120,
    "savefig.dpi": 200,
    "pdf.fonttype": 42,
}
ERRORS = {
    "longitudinal_error": "longitudinal\nerror (mm)",
    "lateral_error": "lateral\nerror (mm)",
    "heading_error": "heading\nerror (mrad)",
}
MILLI = 1e3  # errors are drawn in thousandths of the units in a result

P = ParamSpec("P")


def __dir__() -> list[str]:
    """Lists the figures alone, for who explores `mrctl.plots`."""
    return __all__


class Curve(NamedTuple):
    """One run, cut to the part that is shown, with its label and style."""

    data: xr.Dataset
    label: str
    style: dict[str, Any]


def styled(draw: Callable[P, Figure]) -> Callable[P, Figure]:
    """Makes a function draw in the style of this module without changing the user's settings."""

    @wraps(draw)
    def inner(*args: P.args, **kwargs: P.kwargs) -> Figure:
        with mpl.rc_context(STYLE):
            return draw(*map(_literal, args), **{k: _literal(v) for k, v in kwargs.items()})  # type: ignore[arg-type]

    return inner


def _literal(value: Any) -> Any:  # noqa: ANN401
    """Escapes the dollars in the labels of a result, so that none begins a formula; returns other values unchanged."""
    if not isinstance(value, xr.Dataset) or "label" not in value:
        return value
    labels = np.array([str(label).replace("$", r"\$") for label in value["label"].values.flat], object)
    return value.assign_coords(label=(value["label"].dims, labels.reshape(value["label"].shape)))


def files(name: str) -> list[str]:
    """Returns the names of the files that `save` writes for a figure of this name."""
    return [f"{name}.{suffix}" for suffix in FORMATS]


def save(figure: Figure, folder: str | Path, name: str) -> list[Path]:
    """Writes a figure as PNG (200 dpi) and PDF.

    Args:
        figure: Any figure.
        folder: Folder to write to; it is created if it does not exist.
        name: File name without suffix.

    Returns:
        The paths of both files.

    Raises:
        InputError: The folder cannot be created or written to.
    """
    paths = [Path(folder) / file for file in files(name)]
    try:
        Path(folder).mkdir(parents=True, exist_ok=True)
        with mpl.rc_context({"pdf.fonttype": STYLE["pdf.fonttype"]}):
            figure.savefig(paths[0], dpi=STYLE["savefig.dpi"])
            figure.savefig(paths[1], metadata={"CreationDate": None})  # the same figure gives the same file
    except OSError as error:
        raise InputError(f"{folder}: cannot write figures there: {error.strerror or error}") from None
    return paths


@styled
def path(result: xr.Dataset, window: tuple[float, float] | None = None, lap: int | None = None) -> Figure:
    """Draws the path of P over that of the reference; a dot marks the start, a star the goal.

    Obstacles are grey; one that moves is drawn as an outline where it is at the end, with a dotted line from where it
    was at the beginning.

    Raises:
        InputError: Runs drove among different obstacles, so they cannot share a figure.
    """
    figure, (axes,) = _figure(COLUMN_WIDTH, COLUMN_WIDTH * 0.95)
    curves = _curves(result, window, lap)
    if "scenarios" in result.attrs:
        times = max((data["time"].values[np.isfinite(data["x"].values)] for data, *_ in curves), key=len)
        scenarios = scenarios_of(result)
        for scenario, curve in zip(scenarios, curves, strict=True):
            if scenario.obstacles != scenarios[0].obstacles:
                other, first = (int(one.data["run"]) for one in (curve, curves[0]))
                raise InputError(
                    f"result: run {other} drove among other obstacles than run {first}; draw one world at a time, such "
                    "as result.isel(run=[0])"
                )
        _surroundings(axes, scenarios[0].obstacles, times)
        for x, y, _ in dict.fromkeys(scenario.goal for scenario in scenarios if scenario.goal is not None):
            axes.plot(x, y, "*", ms=7, color="0.25", zorder=4)
    _references(axes, curves, "x_ref", "y_ref")
    for data, _, style in curves:
        x, y = data["x"].values, data["y"].values
        axes.plot(x, y, **style)
        axes.plot(x[:1], y[:1], "o", ms=3.5, color=style["color"], zorder=4)
        _cross(axes, data, x, y)
    axes.set(xlabel="$x$ (m)", ylabel="$y$ (m)", aspect="equal")
    axes.set_adjustable("datalim")
    _legend(figure, curves, _plant(result), reference=True)
    return figure


@styled
def velocities(
    result: xr.Dataset,
    signals: Sequence[str] = ("v", "omega"),
    window: tuple[float, float] | None = None,
    lap: int | None = None,
) -> Figure:
    """Draws linear velocity and yaw rate, or one of them, over time with the original reference (paper's figure 4).

    Raises:
        InputError: `signals` is empty or holds another name than `v` and `omega`.
    """
    texts = {"v": r"$V_{AV}$ (m/s)", "omega": r"$\dot\theta$ (rad/s)"}
    if not signals or not set(signals) <= set(texts):
        raise InputError(f"signals: {', '.join(signals) or 'nothing'} is not one or both of {', '.join(texts)}")
    figure, axes = _figure(COLUMN_WIDTH, (0.1 + 0.4 * len(signals)) * COLUMN_WIDTH, rows=len(signals))
    curves = _curves(result, window, lap)
    for one, name in zip(axes, signals, strict=True):
        _references(one, curves, "time", f"{name}_ref")
        _signals(one, curves, name, texts[name])
    _legend(figure, curves, _plant(result), reference=True)
    return figure


@styled
def errors(result: xr.Dataset, window: tuple[float, float] | None = None, lap: int | None = None) -> Figure:
    """Draws longitudinal, lateral and heading error over time."""
    return _errors(_curves(result, window, lap), _plant(result))


@styled
def compare_errors(
    result_pid: xr.Dataset,
    result_nn: xr.Dataset,
    labels: tuple[str, str] = ("PID", "PID + neural feedforward"),
    window: tuple[float, float] | None = None,
    lap: int | None = None,
) -> Figure:
    """Draws tracking errors of two controllers in the same axes, with their RMS values (the paper's figure 5).

    The RMS is over the samples that are drawn of all runs; it gives way to a word where one of them failed in view.

    Args:
        result_pid: Runs of the first controller, in the paper conventional PID.
        result_nn: Runs of the second controller, in the paper PID with neural feedforward.
        labels: Names of the two controllers in the legend.
        window: Times to show in s.
        lap: Number of the lap to show instead of a window.
    """
    colours = colours_of(("none", "fel"))
    each = [
        [Curve(data, label, {**style, "color": colour}) for data, _, style in _curves(result, window, lap)]
        for result, label, colour in zip((result_pid, result_nn), labels, colours, strict=True)
    ]
    figure = _errors([curve for curves in each for curve in curves], _plant(result_pid, result_nn))
    for axes, name in zip(figure.axes, ERRORS, strict=True):
        for row, (curves, colour) in enumerate(zip(each, colours, strict=True)):
            text = _rms([data for data, _, _ in curves], name)
            axes.text(1 - 0.26 * (1 - row), 1.0, text, color=colour, fontsize=8, ha="right", va="bottom",
                      transform=axes.transAxes)  # fmt: skip
    return figure


@styled
def voltages(result: xr.Dataset, window: tuple[float, float] | None = None, lap: int | None = None) -> Figure:
    """Draws feedback, feedforward and total voltage of each wheel over time, in a column for each run."""
    curves = _curves(result, window, lap)
    count = len(curves)
    width = COLUMN_WIDTH if count == 1 else max(PAGE_WIDTH, 60 / 25.4 * count)
    figure, axes = _figure(width, 0.95 * COLUMN_WIDTH, rows=2, columns=count, sharey=True)
    # The total is wide and pale, and lies under its parts.
    parts = (("voltage", "0.75", 3.0), ("feedback", COLOURS[1], 1.0), ("feedforward", COLOURS[2], 1.0))
    for column, (data, label, _) in enumerate(curves):
        for row, wheel in enumerate(("left", "right")):
            one = axes[row * count + column]
            for name, colour, line in parts:
                signal = data[f"{name}_{wheel}"].values
                one.plot(data["time"].values, signal, color=colour, lw=line)
                _cross(one, data, data["time"].values, signal)
            if column == 0:
                one.set_ylabel(f"$U_{wheel[0]}$ (V)")
            if row == 0 and count > 1:
                one.set_title(label)
            if row == 1:
                one.set_xlabel("time (s)")
    handles = [Line2D([], [], color=colour, lw=line) for _, colour, line in parts]
    names = ["total", "feedback", "feedforward"]
    figure.legend(handles, names, loc="outside upper center", ncols=3, title=_plant(result))
    return figure


@styled
def feedforward_outputs(
    result: xr.Dataset, window: tuple[float, float] | None = None, lap: int | None = None
) -> Figure:
    """Draws the feedforward voltage of the left and the right motor over time (the paper's figure 6)."""
    figure, axes = _figure(COLUMN_WIDTH, 0.9 * COLUMN_WIDTH, rows=2, sharey=True)
    curves = _curves(result, window, lap)
    for one, wheel in zip(axes, ("left", "right"), strict=True):
        _signals(one, curves, f"feedforward_{wheel}", rf"$U_{{ff,{wheel[0]}}}$ (V)")
    _legend(figure, curves, _plant(result))
    return figure


@styled
def learning_curve(result: xr.Dataset, metrics: Sequence[str] = ("v_rmse", "omega_rmse")) -> Figure:
    """Draws metrics lap by lap, with a thin line for each run and a thick one for the mean of each label.

    The axis is logarithmic where all values are positive. The mean is over the runs that finished, so that it is over
    the same runs in each lap; where none of a label finished, it is over the laps that all of them drove.

    Args:
        result: What `simulate` or `metrics.per_lap` returns.
        metrics: Names in `METRICS`; each has a panel.

    Raises:
        InputError: A metric is unknown, or none is given, or the result has no run or no lap.
    """
    if not metrics:
        raise InputError("metrics: at least one is needed")
    names = [known(name) for name in metrics]
    laps = _laps(result, "result")
    columns = min(2, len(names))
    rows = -(-len(names) // columns)
    figure, axes = _figure(
        COLUMN_WIDTH if columns == 1 else PAGE_WIDTH, 0.75 * rows * COLUMN_WIDTH, rows=rows, columns=columns
    )
    number = laps["lap"].values
    labels = [str(label) for label in laps["label"].values]
    for unused in axes[len(names) :]:
        unused.remove()
    figure.suptitle(_plant(laps))
    for one, name in zip(axes, names, strict=False):
        scale, text = _shown(name)
        ends: list[tuple[float, float, str, str]] = []
        for label, colour in _colours(laps).items():
            own = [row for row, other in enumerate(labels) if other == label]
            values, failed = scale * laps[name].values[own], laps["failed"].values[own].astype(bool)
            kept, whole = _finished(values, failed)
            mean = kept[:, whole].mean(axis=0)
            if len(own) > 1:
                one.plot(number, values.T, color=colour, lw=0.5, alpha=0.4)
            one.plot(number[whole], mean, "o-", ms=2.5, lw=1.2, color=colour)
            at = (number[whole][-1], mean[-1]) if whole.any() else (number[0], np.nan)
            ends.append((float(at[0]), float(at[1]), _counted(label, int(failed.sum()), len(own)), colour))
        one.set_title(text)
        one.xaxis.get_major_locator().set_params(integer=True, min_n_ticks=1)
        _scale(one, laps[name].values)
        _label_ends(one, ends)
    for one in axes[max(0, len(names) - columns) : len(names)]:  # the lowest of each column
        one.set_xlabel("lap")
        one.tick_params(labelbottom=True)
    return figure


@styled
def laps_by_case(cases: Mapping[str, xr.Dataset], metric: str, changes: Sequence[int] = ()) -> Figure:
    """Draws a metric lap by lap, in a panel for each case: mean and range of the runs that share a label.

    The axis is logarithmic where all values are positive. Mean and range are over the runs that finished, so that they
    are over the same runs in each lap; where none of a label finished, they are over the laps that all of them drove.
    The legend says how many failed, in all cases.

    Args:
        cases: What `simulate` or `metrics.per_lap` returns, by title.
        metric: One of `METRICS`.
        changes: Numbers of laps at whose beginning something changes; dotted lines mark them.

    Raises:
        InputError: The metric is unknown, there is no case, or one has no run or no lap.
    """
    scale, text = _shown(known(metric))
    if not cases:
        raise InputError("cases: at least one is needed")
    cases = {title: _laps(case, f"cases: {title}") for title, case in cases.items()}
    columns = 2 if len(cases) in (2, 4) else min(3, len(cases))
    rows = -(-len(cases) // columns)
    figure, axes = _figure(PAGE_WIDTH, (0.12 + 0.55 * rows) * COLUMN_WIDTH, rows=rows, columns=columns, sharey=True)
    lost: dict[str, list[bool]] = {}  # whether each run failed, by label
    lines = _lines(_colours(*cases.values()))
    for one, (title, laps) in zip(axes, cases.items(), strict=False):
        number, labels = laps["lap"].values, [str(label) for label in laps["label"].values]
        for label in dict.fromkeys(labels):
            own = [row for row, other in enumerate(labels) if other == label]
            failed = laps["failed"].values[own].astype(bool)
            lost.setdefault(label, []).extend(failed.tolist())
            values, whole = _finished(scale * laps[metric].values[own], failed)
            if whole.any():
                low, mean, high = (f(values[:, whole], axis=0) for f in (np.min, np.mean, np.max))
                one.fill_between(number[whole], low, high, color=lines[label]["color"], alpha=0.15, lw=0)
                one.plot(number[whole], mean, marker=".", ms=3, **lines[label])
        for lap in changes:
            one.axvline(lap - 0.5, color="0.4", lw=0.8, ls=":")
        one.set_title(title)
        one.xaxis.get_major_locator().set_params(integer=True, min_n_ticks=1)
        _scale(one, np.concatenate([laps[metric].values.ravel() for laps in cases.values()]))
    for place, one in enumerate(axes):
        one.set_xlabel("lap" if place + columns >= len(cases) else "")
        one.tick_params(labelbottom=place + columns >= len(cases))
        if place % columns == 0:
            one.set_ylabel(text, fontsize=8)
    for unused in axes[len(cases) :]:
        unused.remove()
    handles = [Line2D([], [], **lines[label]) for label in lost]
    names = [_counted(label, sum(failed), len(failed)) for label, failed in lost.items()]
    columns = 3 if any(map(any, lost.values())) else 4  # the counts make the names longer
    figure.legend(handles, names, loc="outside upper center", ncols=min(columns, len(names)))
    return figure


@styled
def distributions(samples: Mapping[str, ArrayLike], label: str, mark: float | None = None) -> Figure:
    """Draws the share of runs below each value, on a log axis; a failed run, whose value is not finite, is below none.

    Args:
        samples: A positive number for each run, by name; a controller of this name gives the colour.
        label: Quantity and unit for the axis.
        mark: Value at which a dotted line is drawn, such as 1 for ratios.
    """
    figure, (axes,) = _figure(COLUMN_WIDTH, 0.8 * COLUMN_WIDTH)
    lines = _lines(dict(zip(samples, colours_of(samples), strict=True)))
    for name, given in samples.items():
        values = np.asarray(given, float)
        finite = np.sort(values[np.isfinite(values)])
        axes.step(finite, np.arange(1, len(finite) + 1) / max(1, len(values)), where="post", **lines[name])
    if mark is not None:
        axes.axvline(mark, color="0.4", lw=0.8, ls=":")
    axes.set(xlabel=label, ylabel="share of runs", xscale="log", ylim=(0, 1.02))
    low, high = axes.get_xlim()
    axes.xaxis.set_minor_locator(LogLocator(subs=(2, 5) if high < 40 * low else ()))  # more numbers would overlap
    for formatted in (axes.xaxis.set_major_formatter, axes.xaxis.set_minor_formatter):
        formatted("{x:g}")
    handles = [Line2D([], [], **lines[name]) for name in samples]
    figure.legend(handles, list(samples), loc="outside upper center", ncols=2)
    return figure


@styled
def excitation(result: xr.Dataset, span: float = 4.0, motion: str = "commanded", run: int = 0) -> Figure:
    """Draws persistency of excitation over time on log axes: the least eigenvalue of each run, and the features of one.

    Args:
        result: What `simulate` returns, or one run of it.
        span: Length of the sliding window in s.
        motion: As for `mrctl.results.excitation.excitation`.
        run: Index of the run whose features are drawn, one line each; from −1 backwards it counts from the last run.

    Raises:
        InputError: There is no such run; else as `mrctl.results.excitation.excitation`, where `span` is its `window`.
    """
    found, runs = exciting.excitation(result, span, motion), as_runs(result)
    if not -runs.sizes["run"] <= run < runs.sizes["run"]:
        raise InputError(f"run: {run} is not the index of one of {runs.sizes['run']} runs")
    kept = {name: ("run", runs[name].values) for name in ("feedforward", "failed") if name in runs.variables}
    found = found.assign_coords(kept)  # for the colours, and for the failures in the legend
    figure, axes = _figure(COLUMN_WIDTH, 1.2 * COLUMN_WIDTH, rows=2)
    curves = _curves(found, None, None)
    _signals(axes[0], curves, "least", r"$\lambda_{\min}$ (1)")
    lines = _lines(dict(zip(PARAMETERS, cycle(COLOURS), strict=False)))
    for symbol, name in zip(PARAMETERS, found["feature"].values, strict=True):
        signal = found["alone"].isel(run=run).sel(feature=name).values
        axes[1].plot(found["time"].values, signal, label=symbol, **lines[symbol])
    whose = f", {runs['label'].values[run]}" if runs.sizes["run"] > 1 else ""
    axes[1].set(xlabel="time (s)", ylabel=f"excitation alone (1){whose}")
    for one in axes:
        if any((np.asarray(line.get_ydata(), float) > 0).any() for line in one.lines):  # on a circle every value is 0
            one.set_yscale("log", nonpositive="mask")
    axes[1].legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=4)
    _legend(figure, curves, _plant(result))
    return figure


PARAMETERS = (
    "$V$", r"$\dot\theta$", r"$\dot V$", r"$\ddot\theta$", r"$V\dot\theta$", r"$\dot\theta^2$", r"sgn $V_l$",
    r"sgn $V_r$",
)  # fmt: skip
"""Symbols of the 8 physical features in figures."""


class InverseMap(NamedTuple):
    """The output of a feedforward in steady motion, with the true inverse dynamics to compare."""

    v: np.ndarray
    """Speeds in m/s (n,)."""
    omega: np.ndarray
    """Yaw rates in rad/s (m,)."""
    learned: np.ndarray
    """U_Σ and U_Δ in V (m, n, 2)."""
    true: np.ndarray
    """U_Σ and U_Δ of the true inverse dynamics in V (m, n, 2)."""
    path: np.ndarray
    """Commanded twists of the lap in which it was trained last, in m/s and rad/s, (T, 2)."""


@styled
def inverse_dynamics(maps: Mapping[str, InverseMap]) -> Figure:
    """Draws heat maps of the inverse dynamics over the twist, a row for each learner: true, learned, and error, in V.

    The white line, with a dark edge because an error of zero is white, shows where the robot drove while it learned.

    Raises:
        InputError: There is no map.
    """
    if not maps:
        raise InputError("maps: at least one is needed")
    figure, axes = _figure(PAGE_WIDTH, (0.1 + 0.36 * len(maps)) * PAGE_WIDTH, rows=len(maps), columns=6, sharey=True)
    true = np.stack([one.true for one in maps.values()])
    edge = [withStroke(linewidth=1.5, foreground="0.3")]
    for row, (name, one) in enumerate(maps.items()):
        for channel, symbol in enumerate((r"\Sigma", r"\Delta")):
            bound = float(np.abs(true[..., channel]).max())
            error = one.learned[..., channel] - one.true[..., channel]
            columns = ((one.true[..., channel], "true", "RdBu_r"), (one.learned[..., channel], "learned", "RdBu_r"),
                       (error, "error", "PuOr_r"))  # fmt: skip
            for column, (values, what, colours) in enumerate(columns):
                panel = axes[6 * row + 3 * channel + column]
                limit = bound / (4 if what == "error" else 1)
                look: dict[str, Any] = {"cmap": colours, "vmin": -limit, "vmax": limit, "rasterized": True}
                image = panel.pcolormesh(one.v, one.omega, values, **look)
                panel.plot(*one.path.T, color="white", lw=0.7, path_effects=edge)
                panel.grid(False)
                panel.set(xlim=one.v[[0, -1]], ylim=one.omega[[0, -1]])
                if row == 0:
                    panel.set_title(f"$U_{symbol}$ {what} (V)", fontsize=8)
                if row == len(maps) - 1:
                    panel.set_xlabel("$V$ (m/s)")
                    below = {"orientation": "horizontal", "aspect": 12, "pad": 0.05 / len(maps)}
                    figure.colorbar(image, ax=axes[3 * channel + column :: 6], **below)
                if column == channel == 0:
                    panel.set_ylabel(f"{name}\n$\\dot\\theta$ (rad/s)")
    return figure


def _rms(runs: Sequence[xr.Dataset], name: str) -> str:
    """Returns in words the RMS of an error over runs, or that one failed; NaN that pad a shorter run do not count."""
    errors = [run[name].values for run in runs]
    finite = [np.isfinite(one) for one in errors]
    if any(run.get("failed", True) and not fine.all() for run, fine in zip(runs, finite, strict=True)):
        return "failed"
    squares = np.concatenate([np.square(one[fine]) for one, fine in zip(errors, finite, strict=True)])
    if not len(squares):
        return "RMS –"
    rms = MILLI * np.sqrt(squares.mean())
    return f"RMS {rms:.2g}" if rms < 99.5 else f"RMS {rms:.0f}"


def _finished(values: Array, failed: NDArray[np.bool_]) -> tuple[Array, NDArray[np.bool_]]:
    """Returns the values (runs, laps) of the runs that finished, or of all if none did, and which laps all these have.

    A mean of the runs that are still alive would fall where a bad one fails.
    """
    kept = values if failed.all() else values[~failed]
    return kept, np.asarray(np.isfinite(kept).all(axis=0))


def _lines(colours: Mapping[str, str]) -> dict[str, dict[str, Any]]:
    """Returns colour and dashes by label; lines beyond the seventh, whose colours repeat or are near, have others."""
    dashes = [dash for dash in ("-", "--", ":") for _ in COLOURS]
    return {label: {"color": c, "ls": dash} for (label, c), dash in zip(colours.items(), cycle(dashes), strict=False)}


def _figure(width: float, height: float, rows: int = 1, columns: int = 1, sharey: bool = False) -> tuple[Figure, list]:
    """Makes a figure and its axes, row by row; without pyplot it need not be closed, and a notebook shows it once."""
    figure = Figure(figsize=(width, height), layout="constrained")
    axes = figure.subplots(rows, columns, sharex=rows > 1, sharey=sharey, squeeze=False)
    return figure, list(axes.flat)


def _surroundings(axes: Axes, obstacles: Obstacles, times: Array) -> None:
    """Draws obstacles where they are at times in s."""
    for shape in obstacles.shapes:
        disc = shape.kind == "disc"
        corners = np.array([(shape.x, shape.y)] if disc else shape.vertices)
        if shape.course is None:
            patch = Circle(corners[0], shape.radius) if disc else Polygon(corners)
            axes.add_patch(patch).set(color="0.75", lw=0)
        elif len(times):
            places = np.stack([turned(corners, pose) for pose in shape.course.sample(times).pose])
            patch = Circle(places[-1, 0], shape.radius) if disc else Polygon(places[-1])
            axes.add_patch(patch).set(facecolor="none", edgecolor="0.6", lw=0.8)
            axes.plot(*places.mean(axis=1).T, ":", color="0.6", lw=0.8)


def _curves(result: xr.Dataset, window: tuple[float, float] | None, lap: int | None) -> list[Curve]:
    """Returns the runs of a result, cut to a window or a lap, with their labels and colours."""
    if window is not None and lap is not None:
        raise InputError("window: give a window or a lap, not both")
    runs = as_runs(result)
    if "time" not in runs.dims:
        raise InputError(METRICS_ONLY)
    labels = [str(label) for label in runs["label"].values]
    colours, curves = _colours(runs), []
    for row, label in enumerate(labels):
        many = labels.count(label) > 1
        style: dict[str, Any] = {"color": colours[label], "lw": 0.7 if many else 1.0}
        if many:
            style["alpha"] = 0.7
        curves.append(Curve(_cut(runs.isel(run=row), window, lap), label, style))
    if not any(curve.data.sizes["time"] for curve in curves):
        raise InputError(f"window: no samples in {window}" if window else "result: no samples")
    return curves


def _colours(*results: xr.Dataset) -> dict[str, str]:
    """Returns the colour of each label: that of its first run's controller, or another shade of it."""
    first: dict[str, str] = {}
    for runs in results:
        controllers = runs["feedforward" if "feedforward" in runs.coords else "label"].values
        for label, controller in zip(runs["label"].values, controllers, strict=True):
            first.setdefault(str(label), str(controller))
    return dict(zip(first, colours_of(first.values()), strict=True))


def _cut(run: xr.Dataset, window: tuple[float, float] | None, lap: int | None) -> xr.Dataset:
    """Returns the samples of one run within a window or a lap."""
    if window is not None:
        start, end = window
        if not start < end:
            raise InputError(f"window: {start:g} s is not before {end:g} s")
        time = run["time"].values
        return run.isel(time=(time >= start) & (time <= end))
    if lap is None:
        return run
    edges = laps_of(run).edges
    index = lap - 1 if lap > 0 else len(edges) - 1 + lap
    if lap == 0 or not 0 <= index < len(edges) - 1:
        raise InputError(f"lap: {lap} is not in 1 to {len(edges) - 1}, nor counted from the end by −1, −2, …")
    return run.isel(time=slice(edges[index], edges[index + 1]))


def _shown(metric: str) -> tuple[float, str]:
    """Returns the factor by which a metric is drawn, and its description with the unit."""
    unit, text = METRICS[metric]
    factor, unit = shown_unit(unit)
    return factor, f"{text} ({unit})" if unit else text


def _laps(result: xr.Dataset, title: str) -> xr.Dataset:
    """Returns the metrics of each lap of what `simulate` or `metrics.per_lap` returns.

    Raises:
        InputError: It is no dataset, or it has no run or no lap.
    """
    check_kind(result)
    laps = as_runs(result if "lap" in result.dims else per_lap(result))
    if not (laps.sizes["run"] and laps.sizes["lap"]):
        raise InputError(f"{title}: no laps" if laps.sizes["run"] else f"{title}: no runs")
    return laps


def _plant(*results: xr.Dataset) -> str:
    """Names robot, perturbation and sensing tier of the runs, or says which differ; "" where they are not known.

    They are not after `xr.concat` of two results, which keeps the scenarios of one alone.
    """
    if any("scenarios" not in result.attrs or not unique_runs(result) for result in results):
        return ""
    names = [(name, perturbation.model_dump(mode="json")) for name, perturbation in PERTURBATIONS.items()]
    found: dict[str, set[str]] = {"robots": set(), "perturbations": set(), "sensing tiers": set()}
    for result in results:
        for one in held_scenarios(result):
            change = Perturbation().model_dump(mode="json") | one["perturbation"]
            name = next((name for name, fields in names if fields == change), "perturbed")
            parts = Path(one["robot"]["path"]).stem, name + " with events" * bool(one["events"]), one["sensing"]["tier"]
            for kind, part in zip(found, parts, strict=True):
                found[kind].add(part)
    return "plant: " + ", ".join(f"different {k}" if len(parts) > 1 else parts.pop() for k, parts in found.items())


def _signals(axes: Axes, curves: Iterable[Curve], name: str, label: str, scale: float = 1.0) -> None:
    """Draws one variable of every run over time."""
    for data, _, style in curves:
        time, signal = data["time"].values, scale * data[name].values
        axes.plot(time, signal, **style)
        _cross(axes, data, time, signal)
    axes.set_ylabel(label)
    place = axes.get_subplotspec()
    if place is not None and place.is_last_row():
        axes.set_xlabel("time (s)")


def _references(axes: Axes, curves: Iterable[Curve], x: str, y: str) -> None:
    """Draws the references; one that several runs share is drawn once."""
    seen = set()
    for data, _, _ in curves:
        points = np.column_stack([data[x].values, data[y].values])
        if (key := points.tobytes()) not in seen:
            seen.add(key)
            axes.plot(*points.T, **REFERENCE)


def _cross(axes: Axes, data: xr.Dataset, x: np.ndarray, y: np.ndarray) -> None:
    """Marks the last sample of a run that fails within view."""
    alive = np.flatnonzero(np.isfinite(x + y))
    if "failed" in data and bool(data["failed"]) and len(alive) and alive[-1] < len(x) - 1:
        axes.plot(x[alive[-1]], y[alive[-1]], "X", ms=5, color="black", mec="white", mew=0.5, zorder=5)


def _counted(label: str, failed: int, count: int) -> str:
    """Returns a label that says how many of its runs failed."""
    if not failed:
        return label
    return f"{label} (failed)" if count == 1 else f"{label} ({failed} of {count} failed)"


def _legend(figure: Figure, curves: Sequence[Curve], title: str, reference: bool = False) -> None:
    """Draws a legend with a title above the axes, with an entry for each label and its number of failures."""
    entries: dict[str, list[Curve]] = {}
    for curve in curves:
        entries.setdefault(curve.label, []).append(curve)
    handles = [Line2D([], [], color=group[0].style["color"]) for group in entries.values()]
    failed = [sum(bool(data["failed"]) for data, _, _ in group if "failed" in data) for group in entries.values()]
    names = [_counted(name, lost, len(entries[name])) for name, lost in zip(entries, failed, strict=True)]
    if reference:
        dashes = {key: value for key, value in REFERENCE.items() if key != "zorder"}
        handles, names = [Line2D([], [], **dashes), *handles], ["reference", *names]
    columns = 2 if sum(map(len, names)) > 36 and figure.get_figwidth() < PAGE_WIDTH else 4
    figure.legend(handles, names, loc="outside upper center", ncols=min(len(names), columns), title=title)


def _errors(curves: Sequence[Curve], plant: str) -> Figure:
    """Draws the three errors, each in a panel."""
    figure, axes = _figure(COLUMN_WIDTH, 1.15 * COLUMN_WIDTH, rows=3)
    for one, (name, label) in zip(axes, ERRORS.items(), strict=True):
        one.axhline(0, color="0.6", lw=0.6)
        _signals(one, curves, name, label, MILLI)
    figure.align_ylabels()
    _legend(figure, curves, plant)
    return figure


class _Plain(LogFormatterSciNotation):
    """Writes the numbers of a log axis as `0.3` or `20`, where Matplotlib would write powers of ten."""

    def __call__(self, x: float, pos: int | None = None) -> str:
        return f"{x:g}" if super().__call__(x, pos) else ""


def _scale(axes: Axes, values: Array) -> None:
    """Makes the vertical axis logarithmic, with plain numbers, unless a value is zero or negative."""
    if (values <= 0).any():
        return
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter(_Plain())
    axes.yaxis.set_minor_formatter(_Plain(minor_thresholds=(2, 0.5)))


def _label_ends(axes: Axes, ends: Sequence[tuple[float, float, str, str]]) -> None:
    """Names each line at its end, spread so that no two names overlap."""
    scaled = axes.yaxis.get_transform().transform
    low, high = scaled(np.array(axes.get_ylim()))
    gap = 0.075  # share of the axis that a line of 8 pt takes in a panel of 50 mm
    shown = sorted((e for e in ends if np.isfinite(e[1])), key=lambda end: end[1])
    heights = (scaled(np.array([y for _, y, _, _ in shown])) - low) / (high - low)
    places = heights.copy()
    for _ in range(200):
        short = gap - np.diff(places)
        if not (short > 1e-3).any():
            break
        push = np.where(short > 0, short / 2, 0)
        places[:-1] -= push
        places[1:] += push
    for (x, y, label, colour), place in zip(shown, places, strict=True):
        axes.annotate(
            label, (x, y), xytext=(1.03, place), textcoords="axes fraction", color=colour, fontsize=8, va="center",
            annotation_clip=False, arrowprops={"arrowstyle": "-", "color": colour, "lw": 0.4, "shrinkB": 2},
        )  # fmt: skip
    lost = [label for _, y, label, _ in ends if not np.isfinite(y)]
    if lost:
        axes.text(0.02, 0.02, ", ".join(lost), fontsize=8, transform=axes.transAxes)
