"""Figures hold the data they are given, carry units, and reach the disk."""

import colorsys
import json
import re
from itertools import pairwise

import matplotlib as mpl
import numpy as np
import pytest
import xarray as xr
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.image import imread

from mrctl.record import InputError
from mrctl.results import drawings, metrics, plots
from mrctl.results.controllers import CONTROLLERS, colours_of
from mrctl.scenario import FEEDFORWARDS, Scenario
from mrctl.theory.obstacles import Box, Disc, Obstacles
from mrctl.theory.perturbation import PERTURBATIONS, Perturbation
from mrctl.theory.references import Waypoints
from mrctl.viewer.looks import looks

LAP = 2.0


def make(labels=("none", "fel")):
    """Runs on a circle, every signal different, so that a curve can be told by its data."""
    time = np.arange(0, 3 * LAP, 0.02)
    count = len(labels)
    rng = np.random.default_rng(0)
    names = (*metrics.SAMPLED, "feedforward_left", "feedforward_right")
    data = {name: rng.uniform(0.1, 1, (count, len(time))) for name in names}
    data["x"], data["y"] = (np.outer(np.linspace(1, 1.2, count), f(np.pi * time)) for f in (np.cos, np.sin))
    for name in ("x_ref", "y_ref", "v_ref", "omega_ref"):
        data[name] = np.broadcast_to(data[name][:1], data[name].shape).copy()
    return xr.Dataset(
        {name: (("run", "time"), value) for name, value in data.items()}
        | {"failed": ("run", np.zeros(count, bool)), "failure_time": ("run", np.full(count, np.nan))},
        {
            "time": time,
            "run": np.arange(count),
            "label": ("run", list(labels)),
            "lap_time": ("run", [LAP] * count),
        },
        {"control_period": 0.02},
    )


def fail(result, run, time):
    """The result with one run failed."""
    result = result.copy(deep=True)
    result["failed"][run], result["failure_time"][run] = True, time
    for name in metrics.SAMPLED:
        result[name][run, result["time"].values >= time] = np.nan
    return result


def drawn(axes, x, y):
    """Whether the axes hold a line through exactly these points."""
    return any(np.array_equal(line.get_xydata(), np.column_stack([x, y]), equal_nan=True) for line in axes.lines)


def legend(figure):
    """The texts of the figure's legend."""
    return [text.get_text() for text in figure.legends[0].get_texts()]


SIGNALS = {
    plots.velocities: [["v", "v_ref"], ["omega", "omega_ref"]],
    plots.errors: [["longitudinal_error"], ["lateral_error"], ["heading_error"]],
    plots.feedforward_outputs: [["feedforward_left"], ["feedforward_right"]],
}


@pytest.mark.parametrize("plot", SIGNALS, ids=lambda plot: plot.__name__)
@pytest.mark.parametrize("cut", [{}, {"window": (1.0, 3.0)}, {"lap": 2}, {"lap": -1}], ids=str)
def test_time_series(plot, cut):
    """Each panel holds the samples of its signals, of every run, within the window or the lap."""
    result = make()
    start, end = cut.get("window", {2: (2.0, 3.99), -1: (4.0, 5.99)}.get(cut.get("lap"), (0, 9)))
    seen = result.sel(time=slice(start - 1e-9, end + 1e-9))
    figure = plot(result, **cut)
    assert len(figure.axes) == len(SIGNALS[plot])
    for axes, names in zip(figure.axes, SIGNALS[plot], strict=True):
        for name in names:
            scale = 1e3 if name.endswith("error") else 1.0  # errors in mm and mrad, as in tables
            for run in (0, 1):
                assert drawn(axes, seen["time"], scale * seen[name].isel(run=run)), name
    assert legend(figure)[-2:] == ["none", "fel"]


def test_colours():
    """A controller has its colour in every figure and in the viewer, whatever it is compared with."""
    alone = "#D55E00"
    for labels in (("none", "fel"), ("fel", "none")):
        lines = plots.learning_curve(make(labels), ["v_rmse"]).axes[0].lines
        assert lines[labels.index("none")].get_color() == alone
        by_case = plots.laps_by_case({"one": metrics.per_lap(make(labels))}, "v_rmse")
        shares = plots.distributions(dict.fromkeys(labels, np.array([1.0, 2.0])), "ratio")
        for figure in (by_case, shares):
            entries = [line.get_color() for line in figure.legends[0].get_lines()]
            assert entries == [line.get_color() for line in figure.axes[0].lines[:2]] == colours_of(labels)
    both = plots.compare_errors(make().isel(run=[0]), make().isel(run=[1])).axes[0].lines
    assert alone in {line.get_color() for line in both}
    (pid, net, own, again) = looks("abcd", ["none", "fel", "mine", "none"])
    assert pid == ("a", (0xD5, 0x5E, 0x00)) and len({pid.colour, net.colour, own.colour, again.colour}) == 4
    hue = lambda look: colorsys.rgb_to_hsv(*(c / 255 for c in look.colour))[0]  # noqa: E731
    assert hue(again) == pytest.approx(hue(pid), abs=0.01) and abs(hue(own) - hue(pid)) > 0.02
    assert len({look.colour for look in looks("abcde", ["fel"] * 5)}) == 5
    for controllers in (["fel", "fel"], ["mine", "none", "mine", "model+rls", "none"], ["fel"] * 5):
        colours = colours_of(controllers)
        assert [f"#{bytes(look.colour).hex().upper()}" for look in looks(controllers, controllers)] == colours
        others = {colour for name, (_, colour) in CONTROLLERS.items() if name not in controllers}
        assert controllers[0] == "mine" or not others & set(colours)
    assert set(CONTROLLERS) == set(FEEDFORWARDS) and len(set(CONTROLLERS.values())) == len(FEEDFORWARDS)


def test_plant_is_named():
    """Every figure of runs names robot, perturbation and tier, or says that the runs differ in them."""
    kinds = [
        {"robot": {"path": path}, "perturbation": change.model_dump(), "events": [], "sensing": {"tier": "lab"}}
        for path, change in (("car", PERTURBATIONS["all"]), ("a/b.xml", Perturbation(mass_factor=1.2)))
    ]
    result = make()
    result.attrs["scenarios"] = json.dumps(kinds)
    for name, plot in ALL.items():
        figure = plot(result.isel(run=[1]))
        titles = [one.get_title().get_text() for one in figure.legends] + [figure.get_suptitle()]
        assert "plant: b, perturbed, lab" in titles, name
    both = "plant: different robots, different perturbations, lab"
    assert plots.path(result).legends[0].get_title().get_text() == both
    assert plots.compare_errors(result.isel(run=0), result.isel(run=1)).legends[0].get_title().get_text() == both
    two = xr.concat([result, result.assign(lateral_error=result["lateral_error"] + 1)], "run")
    assert plots.learning_curve(two).get_suptitle() == ""  # which has the scenarios of one alone
    with pytest.raises(InputError, match=r"^run: the selection has lost the number of its run; .*$"):
        plots.errors(result.isel(run=1, drop=True))
    with pytest.raises(InputError, match=r"^run: the selection has lost the number of its run; .*$"):
        plots.learning_curve(result.isel(run=1, drop=True))
    result.attrs["scenarios"] = json.dumps(kinds[1:])
    alone = plots.errors(result.isel(run=0, drop=True))
    assert alone.legends[0].get_title().get_text() == "plant: b, perturbed, lab"


def test_names():
    """Who explores the module finds the figures, and all of them."""
    assert set(dir(plots)) == set(plots.__all__) >= {*ALL}


def test_path():
    """The path of each run and the reference, once, with equal axes and the start marked."""
    result = make()
    (axes,) = plots.path(result).axes
    for run in (0, 1):
        one = result.isel(run=run)
        assert drawn(axes, one["x"], one["y"]) and drawn(axes, one["x"][:1], one["y"][:1])
    assert drawn(axes, result["x_ref"][0], result["y_ref"][0]) and axes.get_aspect() == 1
    assert len(axes.lines) == 5


def test_voltages():
    """Feedback, feedforward and total for each wheel, a column per run."""
    result = make()
    figure = plots.voltages(result)
    assert [axes.get_title() for axes in figure.axes] == ["none", "fel", "", ""]
    for number, axes in enumerate(figure.axes):
        for part in ("feedback", "feedforward", "voltage"):
            signal = result[f"{part}_{('left', 'right')[number // 2]}"].isel(run=number % 2)
            assert drawn(axes, result["time"], signal)


def test_compare_errors():
    """Both controllers in the same axes, with their RMS."""
    result = make()
    pid, nn = result.isel(run=0), result.isel(run=[1])
    figure = plots.compare_errors(pid, nn)
    for axes, name in zip(figure.axes, plots.ERRORS, strict=True):
        assert drawn(axes, result["time"], 1e3 * pid[name]) and drawn(axes, result["time"], 1e3 * nn[name][0])
        rms = [1e3 * np.sqrt(np.mean(one[name].values ** 2)) for one in (pid, nn)]
        assert [text.get_text() for text in axes.texts] == [f"RMS {value:.0f}" for value in rms]
    same = plots.compare_errors(pid, nn, labels=("PID", "PID"))
    assert [[t.get_text() for t in one.texts] for one in same.axes] == [
        [t.get_text() for t in one.texts] for one in figure.axes
    ]
    failed = plots.compare_errors(pid, fail(nn, 0, 3.0))
    assert failed.axes[0].texts[1].get_text() == "failed" and legend(failed)[1].endswith("(failed)")


def test_compare_errors_of_shorter_runs():
    """A run that arrived, or that is shorter, has the RMS of its samples; only one that failed in view is said to."""
    result = make()
    result["lateral_error"][:] = 0.002
    padded = result.copy(deep=True)
    for name in metrics.SAMPLED:
        padded[name][1, 200:] = np.nan
    pid, nn = padded.isel(run=[0]), padded.isel(run=[1])
    texts = lambda figure: [text.get_text() for text in figure.axes[1].texts]  # noqa: E731
    assert texts(plots.compare_errors(pid, nn)) == ["RMS 2", "RMS 2"]
    assert texts(plots.compare_errors(pid, nn, window=(5, 6))) == ["RMS 2", "RMS –"]
    assert texts(plots.compare_errors(pid, nn.drop_vars("failed"))) == ["RMS 2", "failed"]
    both = fail(padded, 1, 3.0)
    assert texts(plots.compare_errors(pid, both, window=(0, 2))) == ["RMS 2", "RMS 2"]  # before it failed
    assert texts(plots.compare_errors(pid, both)) == ["RMS 2", "failed"]
    far = pid.assign(lateral_error=pid["lateral_error"] * 306.25)
    assert texts(plots.compare_errors(far, pid)) == ["RMS 612", "RMS 2"]  # without an exponent


def test_learning_curve():
    """The metric of each run lap by lap, its mean by label, on a log axis if positive, each line named at its end."""
    result = make(("fel", "none", "fel"))
    laps = metrics.per_lap(result)
    for source in (result, laps):
        left, right = plots.learning_curve(source, ["v_rmse", "energy"]).axes
        assert left.get_yscale() == "log" and "(mm/s)" in left.get_title() and "(J)" in right.get_title()
        value = 1e3 * laps["v_rmse"].values
        for line in (value[0], value[2], (value[0] + value[2]) / 2, value[1]):
            assert drawn(left, [1, 2, 3], line)
        assert sorted(text.get_text() for text in left.texts) == ["fel", "none"]


@pytest.mark.filterwarnings("error")
def test_metrics_that_are_zero():
    """A metric that is zero has a linear axis, on which its lines are drawn and named."""
    result = make()
    result["saturated"][:] = np.array([0.0, 1.0])[:, None]
    laps = metrics.per_lap(result)
    zero, some, positive = plots.learning_curve(laps, ["guard_actions", "saturation_time", "energy"]).axes[:3]
    zero.figure.canvas.draw()
    assert [axes.get_yscale() for axes in (zero, some, positive)] == ["log", "linear", "log"]
    laps["guard_actions"][:] = 0.0
    zero, some, positive = plots.learning_curve(laps, ["guard_actions", "saturation_time", "energy"]).axes[:3]
    zero.figure.canvas.draw()
    assert [axes.get_yscale() for axes in (zero, some, positive)] == ["linear", "linear", "log"]
    for axes in (zero, some):
        assert sorted(text.get_text() for text in axes.texts) == ["fel", "none"]
        heights = [text.xyann[1] for text in axes.texts]
        assert min(heights) > 0 and max(heights) < 1 and abs(np.diff(heights)) > 0.07
    figure = plots.laps_by_case({"one": laps, "other": metrics.per_lap(result)}, "saturation_time")
    figure.canvas.draw()
    assert [axes.get_yscale() for axes in figure.axes] == ["linear", "linear"]


def test_titles_fit_their_panels():
    """The name of each metric is as wide as its panel at most, and the numbers of the axis are plain."""
    figure = plots.learning_curve(make(("fel", "none")), ["position_rmse", "v_rmse", "omega_rmse"])
    renderer = FigureCanvasAgg(figure).get_renderer()
    figure.draw(renderer)
    numbers = set()
    for axes in figure.axes:
        assert axes.title.get_window_extent(renderer).width < axes.get_window_extent(renderer).width
        numbers |= {label.get_text() for label in axes.get_yticklabels(which="both")} - {""}
    assert numbers and all(float(number) > 0 for number in numbers)
    assert [axes.get_xlabel() for axes in figure.axes] == ["", "lap", "lap"]


def test_names_do_not_overlap():
    """Names at the ends of lines that end together are spread."""
    result = make(tuple("abcdefg"))
    result["lateral_error"][:] = 1.0
    (axes,) = plots.learning_curve(result, ["lateral_rmse"]).axes
    heights = sorted(text.xyann[1] for text in axes.texts)
    assert len(heights) == 7 and min(np.diff(heights)) > 0.07


def test_surroundings():
    """A path shows what stands and what moves, at the end of the time that is drawn, and the goal."""
    course = Waypoints(points=((0, 2), (6, 2)), speed=0.5, closed=False)
    shapes = Disc(x=1, y=1, radius=0.3), Box(x=0, y=0.5, length=0.4, width=0.2, course=course)
    scenario = Scenario(obstacles=Obstacles(shapes=shapes), goal=(3, 0, 0))
    result = make()
    result.attrs["scenarios"] = json.dumps([scenario.model_dump(mode="json")] * 2)
    (axes,) = plots.path(result.isel(time=slice(0, 100))).axes
    disc, box = axes.patches
    assert tuple(disc.center) == (1, 1) and disc.radius == 0.3 and disc.get_facecolor() != box.get_facecolor()
    end = course.sample(np.array([result.time.values[99]])).pose[0]
    assert np.ptp(box.get_xy()[:, 0]) == pytest.approx(0.4) and end[2] == pytest.approx(0, abs=1e-9)
    assert box.get_xy()[:4].mean(axis=0) == pytest.approx(end[:2] + [0, 0.5])
    dots, star = (
        next(line for line in axes.lines if wanted(line))
        for wanted in (lambda line: line.get_linestyle() == ":", lambda line: line.get_marker() == "*")
    )
    assert dots.get_xydata()[[0, -1]] == pytest.approx(np.array([[0, 2.5], end[:2] + [0, 0.5]]))
    assert star.get_xydata().tolist() == [[3, 0]]


def test_worlds_of_a_path():
    """Runs in the same world share a figure, with the goal of each; runs in different ones are refused in one line."""
    disc, other = (Obstacles(shapes=(Disc(x=x, y=1, radius=0.3),)) for x in (1, 2))
    result = make()

    def driven(*scenarios: Scenario) -> xr.Dataset:
        return result.assign_attrs(scenarios=json.dumps([one.model_dump(mode="json") for one in scenarios]))

    (axes,) = plots.path(driven(Scenario(obstacles=disc, goal=(3, 0, 0)), Scenario(obstacles=disc))).axes
    stars = lambda axes: [line.get_xydata().tolist() for line in axes.lines if line.get_marker() == "*"]  # noqa: E731
    assert len(axes.patches) == 1 and stars(axes) == [[[3, 0]]]
    goals = [Scenario(obstacles=disc, goal=(x, 0, 0)) for x in (3, 4)]
    assert stars(plots.path(driven(*goals)).axes[0]) == [[[3, 0]], [[4, 0]]]
    different = driven(Scenario(obstacles=disc), Scenario(obstacles=other))
    with pytest.raises(InputError, match=r"^result: run 1 drove among other obstacles than run 0; draw one world .*$"):
        plots.path(different)
    (axes,) = plots.path(different.isel(run=[1])).axes
    assert tuple(axes.patches[0].center) == (2, 1)


def test_failures_are_shown():
    """A failed run keeps its place in the legend and is marked where it ended."""
    result = fail(make(("none", "fel", "fel")), 1, 3.0)
    figure = plots.path(result)
    assert legend(figure) == ["reference", "none", "fel (1 of 2 failed)"]
    crosses = [line for line in figure.axes[0].lines if line.get_marker() == "X"]
    last = result.isel(run=1).sel(time=2.98, method="nearest")
    assert len(crosses) == 1 and crosses[0].get_xydata().tolist() == [[float(last["x"]), float(last["y"])]]
    (axes,) = plots.learning_curve(result, ["v_rmse"]).axes
    assert "fel (1 of 2 failed)" in [text.get_text() for text in axes.texts]
    (axes,) = plots.learning_curve(fail(make(), 1, 0.0), ["v_rmse"]).axes
    assert "fel (failed)" in [text.get_text() for text in axes.texts]


ALL = {
    "path": plots.path,
    "velocities": plots.velocities,
    "errors": plots.errors,
    "voltages": plots.voltages,
    "feedforward_outputs": plots.feedforward_outputs,
    "learning_curve": plots.learning_curve,
    "compare_errors": lambda result: plots.compare_errors(result, result),
}


@pytest.mark.parametrize("name", ALL)
def test_no_runs(name):
    """An empty selection, as of runs that failed where none did, is refused in one line."""
    with pytest.raises(InputError, match="^result: no (runs|samples)$"):
        ALL[name](make().isel(run=slice(0, 0)))


@pytest.mark.parametrize("name", ALL)
def test_units_on_axes(name):
    """A single run draws too, and every labelled axis but the lap number has a unit in brackets."""
    figure = ALL[name](make().isel(run=1))
    labels = [text for axes in figure.axes for text in (axes.get_xlabel(), axes.get_ylabel()) if text]
    assert labels and all(text == "lap" or re.search(r"\(((m?m|m?rad)(/s)?|s|V)\)$", text) for text in labels)


@pytest.mark.parametrize(
    ("draw", "words"),
    [
        (drawings.posture_definition, ["x_0", "O_0", "y_0", "x_r", "P", "y_r", "theta", "phi", "L", "2D", "V_{AV}"]),
        (
            drawings.control_structure,
            ["Kanayama", "PID", "Neural network", "Robot", "eta_c", "U_{ff}", "U_{fb}", "U_l"],
        ),
    ],
)
def test_drawings(draw, words):
    """The paper's symbols are there, inside the sheet, and no two texts overlap."""
    figure = draw()
    figure.draw_without_rendering()
    (axes,) = figure.axes
    text = " ".join(t.get_text() for t in axes.texts)
    assert all(word in text for word in words)
    boxes = [t.get_window_extent() for t in axes.texts]
    for number, box in enumerate(boxes):
        assert figure.bbox.x0 < box.x0 and box.x1 < figure.bbox.x1 and figure.bbox.y0 < box.y0 < figure.bbox.y1
        for other in range(number):
            assert not box.overlaps(boxes[other]), (axes.texts[number].get_text(), axes.texts[other].get_text())


def test_laps_by_case():
    """A panel a case, a line a label through the means of its runs, their range behind it; dots where things change."""
    laps = {title: metrics.per_lap(make(["none", "fel", "fel"])) for title in ("nominal", "all", "ice")}
    laps["ice"]["energy"][:] = np.nan
    figure = plots.laps_by_case(laps, "energy", changes=(2,))
    assert [axes.get_title() for axes in figure.axes] == [*laps] and legend(figure) == ["none", "fel"]
    first, _, empty = figure.axes
    energy = laps["nominal"]["energy"].values
    assert drawn(first, [1, 2, 3], energy[0]) and drawn(first, [1, 2, 3], energy[1:].mean(0))
    band = first.collections[1].get_paths()[0].vertices[:, 1]
    assert (band.min(), band.max()) == (energy[1:].min(), energy[1:].max())
    assert [line.get_xdata() for line in empty.lines] == [[1.5, 1.5]]
    assert "(J)" in first.get_ylabel()


def test_laps_of_a_result():
    """What `simulate` returns is drawn as its metrics of each lap are."""
    result = make()
    drawn = [plots.laps_by_case({"one": case}, "energy").axes[0].lines for case in (result, metrics.per_lap(result))]
    for left, right in zip(*drawn, strict=True):
        np.testing.assert_array_equal(left.get_xydata(), right.get_xydata())


@pytest.mark.parametrize("count", [1, 2, 3])
def test_numbers_of_laps(count):
    """Laps are whole, also where there is one alone."""
    laps = metrics.per_lap(make()).isel(lap=slice(count)).assign(laps=("run", [count] * 2))
    for figure in (plots.learning_curve(laps), plots.laps_by_case({"nominal": laps}, "v_rmse")):
        FigureCanvasAgg(figure).draw()
        for axes in figure.axes:
            low, high = axes.get_xlim()
            assert [x for x in axes.get_xticks() if low <= x <= high] == [*range(1, count + 1)]


def test_mean_of_the_runs_that_finished():
    """A mean does not fall where the worst run fails, and the legend counts the failures of all panels."""
    result = make(["fel", "fel", "none", "none"])
    result["lateral_error"][:] = np.array([1.0, 9.0, 2.0, 3.0])[:, None]
    laps = metrics.per_lap(fail(fail(fail(result, 1, 2.5), 2, 4.5), 3, 2.5))
    figure = plots.laps_by_case({"ice": laps, "dry": metrics.per_lap(result)}, "lateral_rmse")
    assert legend(figure) == ["fel (1 of 4 failed)", "none (2 of 4 failed)"]
    icy, dry = figure.axes
    np.testing.assert_allclose(icy.lines[0].get_xydata(), [[1, 1e3], [2, 1e3], [3, 1e3]])
    np.testing.assert_allclose(icy.lines[1].get_xydata(), [[1, 2500]])  # no run finished: the laps that both drove
    np.testing.assert_allclose(dry.lines[0].get_ydata(), [5e3] * 3)
    (axes,) = plots.learning_curve(laps, ["lateral_rmse"]).axes
    thick = [line for line in axes.lines if line.get_marker() == "o"]
    np.testing.assert_allclose(thick[0].get_ydata(), [1e3] * 3)
    np.testing.assert_allclose(thick[1].get_ydata(), [2500])


def test_legend_fits_the_page():
    """The names of twelve controllers with the counts of their failures are within the figure."""
    laps = metrics.per_lap(make([name for name in list(FEEDFORWARDS)[-12:] for _ in range(10)]))
    laps["failed"][:] = True
    figure = plots.laps_by_case({"one": laps, "other": laps}, "energy")
    figure.draw_without_rendering()
    box = figure.legends[0].get_window_extent()
    assert figure.bbox.x0 <= box.x0 and box.x1 <= figure.bbox.x1


def test_distributions():
    """The share of all runs, so that one that failed keeps its line below one."""
    figure = plots.distributions({"fel": np.array([3.0, np.nan, 1.0, 2.0])}, "ratio")
    (axes,) = figure.axes
    np.testing.assert_array_equal(axes.lines[0].get_xydata(), [[1, 0.25], [2, 0.5], [3, 0.75]])
    assert legend(figure) == ["fel"] and len(axes.lines) == 1
    (marked,) = plots.distributions({"fel": [3.0, 2.0]}, "ratio", mark=1).axes
    assert list(marked.lines[1].get_xdata()) == [1, 1]


@pytest.mark.parametrize(("low", "high"), [(0.13, 2.0), (0.9, 1.2), (0.01, 40.0)])
def test_numbers_of_distributions(low, high):
    """The numbers of the axis are plain, lie apart, and there are at least two, whatever its range."""
    figure = plots.distributions({"fel": np.geomspace(low, high, 20)}, "ratio")
    figure.canvas.draw()
    (axes,) = figure.axes
    texts = [text for text in axes.get_xticklabels() + axes.get_xticklabels(minor=True) if text.get_text()]
    texts = [text for text in texts if axes.get_xlim()[0] <= text.get_position()[0] <= axes.get_xlim()[1]]
    boxes = sorted((text.get_window_extent() for text in texts), key=lambda box: box.x0)
    assert len(boxes) >= 2 and all(one.x1 < other.x0 for one, other in pairwise(boxes))
    assert all(float(text.get_text()) == pytest.approx(text.get_position()[0], rel=1e-3) for text in texts)


def test_inverse_dynamics():
    """True, learned and their difference for both channels, each in its panel."""
    v, omega = np.linspace(0, 1, 4), np.linspace(-1, 1, 5)
    learned, true = np.random.default_rng(0).normal(size=(2, 5, 4, 2))
    figure = plots.inverse_dynamics({"fel": plots.InverseMap(v, omega, learned, true, np.zeros((9, 2)))})
    shown = [axes.collections[0].get_array().reshape(5, 4) for axes in figure.axes[:6]]
    for channel in range(2):
        expected = (true[..., channel], learned[..., channel], learned[..., channel] - true[..., channel])
        for panel, values in zip(shown[3 * channel :], expected, strict=False):
            np.testing.assert_array_equal(panel, values)
    assert all("(V)" in axes.get_title() for axes in figure.axes[:6])
    assert all(axes.get_xlabel() == "$V$ (m/s)" for axes in figure.axes[:6])


def test_the_way_is_seen_where_there_is_no_error():
    """An error of zero is white, as the line of where the robot drove."""
    v, omega, true = np.linspace(0, 1, 4), np.linspace(-1, 1, 5), np.ones((5, 4, 2))
    way = np.array([[0.2, -0.5], [0.8, 0.5]])
    figure = plots.inverse_dynamics({"fel": plots.InverseMap(v, omega, true, true, way)})
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    panel = figure.axes[2]
    (left, low), (right, high) = panel.transData.transform(way).astype(int)
    picture = np.asarray(canvas.buffer_rgba())[::-1, :, :3]
    assert picture[low:high, left:right].min() < 150


def test_save(tmp_path):
    """PNG and PDF are written into a new folder; the PNG is not blank, and 180 mm at 200 dpi."""
    png, pdf = plots.save(drawings.control_structure(), tmp_path / "new" / "folder", "figure3")
    assert (png.name, pdf.name) == ("figure3.png", "figure3.pdf") and pdf.read_bytes().startswith(b"%PDF")
    image = imread(png)
    assert image.shape[1] == pytest.approx(180 / 25.4 * 200, abs=1) and image[..., :3].std() > 0.05


def test_save_unwritable(tmp_path):
    """A folder that cannot be is named in one line."""
    blocker = tmp_path / "file"
    blocker.write_text("")
    for folder in (blocker, blocker / "below"):
        with pytest.raises(InputError, match=rf"^{re.escape(str(folder))}: cannot write") as caught:
            plots.save(drawings.posture_definition(), folder, "figure2")
        assert "\n" not in str(caught.value)


def test_leaves_settings_alone():
    """Drawing does not change the user's matplotlib."""
    before = dict(mpl.rcParams)
    plots.path(make())
    assert dict(mpl.rcParams) == before


@pytest.mark.parametrize(
    ("call", "field"),
    [
        (lambda r: plots.path(r, lap=0), "lap"),
        (lambda r: plots.path(r, lap=4), "lap"),
        (lambda r: plots.velocities(r, ("v", "power")), "signals"),
        (lambda r: plots.velocities(r, ()), "signals"),
        (lambda r: plots.errors(r, window=(3, 1)), "window"),
        (lambda r: plots.errors(r, window=(90, 91)), "window"),
        (lambda r: plots.errors(r, window=(0, 1), lap=1), "window"),
        (lambda r: plots.path(metrics.per_lap(r)), "result"),
        (lambda r: plots.learning_curve(r, ["speed"]), "metric"),
        (lambda r: plots.learning_curve(r, []), "metrics"),
        (lambda r: plots.learning_curve(metrics.per_lap(r).isel(lap=slice(0))), "result"),
        (lambda r: plots.laps_by_case({"a": r}, "speed"), "metric"),
        (lambda r: plots.laps_by_case({}, "energy"), "cases"),
        (lambda r: plots.inverse_dynamics({}), "maps"),
    ],
)
def test_bad_input(call, field):
    """One line that begins with the field."""
    with pytest.raises(InputError, match=rf"^{field}: .+"):
        call(make())
