"""Excitation: Gram matrices against NumPy and against sinusoids whose matrix is known."""

import numpy as np
import pytest
import xarray as xr

from mrctl.control.features import feature_matrix, feature_scale
from mrctl.record import InputError
from mrctl.results import plots
from mrctl.results.controllers import CONTROLLERS
from mrctl.results.excitation import alone, excitation, gram, parameter_error, strength

PERIOD = 0.01
RNG = np.random.default_rng(2)


def result(robot, twists, dead=None):
    """Runs with these commanded twists `(B, n, 2)`."""
    data = {name: (("run", "time"), twists[..., k]) for k, name in enumerate(("v_command", "omega_command"))}
    data |= {name: (("run", "time"), twists[..., k].copy()) for k, name in enumerate(("v", "omega"))}
    if dead is not None:
        for name in ("v_command", "omega_command"):
            data[name][1][0, dead:] = np.nan
    size, n = twists.shape[:2]
    data["failed"] = ("run", np.zeros(size, bool))
    data["half_track"] = ("run", np.full(size, robot.half_track))
    data["feature_scale"] = (("run", "feature"), np.tile(feature_scale(robot), (size, 1)))
    coords = {"time": PERIOD * np.arange(n), "run": np.arange(size), "label": ("run", ["a"] * size)}
    return xr.Dataset(data, coords, {"control_period": PERIOD})


def test_sliding():
    """The matrices of a window are those of its samples alone."""
    x = RNG.uniform(-1, 1, (2, 50, 3))
    found = gram(x, 20)
    assert np.isnan(found[:, :19]).all()
    for end in (20, 33, 50):
        part = x[1, end - 20 : end]
        np.testing.assert_allclose(found[1, end - 1], part.T @ part / 20, atol=1e-13)
    assert np.isnan(gram(x, 51)).all()


def test_strength():
    """Eigenvalues as NumPy's; 1/(G⁻¹)_ii is what remains of a feature after regression on the others."""
    x = RNG.uniform(-1, 1, (200, 4)) @ RNG.uniform(-1, 1, (4, 4))
    G = x.T @ x / 200
    values, alone = strength(G)
    np.testing.assert_allclose(values, np.linalg.eigvalsh(G), rtol=1e-9)
    np.testing.assert_allclose(alone, 1 / np.diag(np.linalg.inv(G)), rtol=1e-9)
    others = x[:, 1:]
    left = x[:, 0] - others @ np.linalg.lstsq(others, x[:, 0], rcond=None)[0]
    assert alone[0] == pytest.approx(np.mean(left**2), rel=1e-9)


def test_replaceable():
    """A feature that the others can replace has no excitation of its own; one that they cannot keeps it."""
    a, b = RNG.uniform(-1, 1, (2, 500))
    x = np.stack([a, b, 0 * a, a + b], axis=1)
    values, alone = strength(x.T @ x / 500)
    assert values[0] == values[1] == 0 and (alone[[0, 1, 2, 3]] == 0).all()
    x = np.stack([a, b, a], axis=1)
    values, alone = strength(x.T @ x / 500)
    assert values[0] == 0 and alone[0] == alone[2] == 0
    left = b - a * (a @ b) / (a @ a)
    assert alone[1] == pytest.approx(np.mean(left**2), rel=1e-6)


def test_alone(robot):
    """Over a whole motion, each feature has the mean square that regression on the seven others leaves of it."""
    twist, scale = RNG.uniform(0.1, 1, (2, 300, 2)), np.tile(feature_scale(robot), (2, 1))
    twist[1, 200:] = np.nan
    found = alone(twist, PERIOD, np.full(2, robot.half_track), scale)
    x = feature_matrix(twist[0], np.gradient(twist[0], PERIOD, axis=0), robot.half_track, scale[0])
    for k in range(8):
        others = np.delete(x, k, axis=1)
        left = x[:, k] - others @ np.linalg.lstsq(others, x[:, k], rcond=None)[0]
        assert found[0, k] == pytest.approx(np.mean(left**2), rel=1e-6)
    assert np.isnan(found[1]).all()


def test_sinusoids(robot):
    """Whole periods of V = V₀ + A sin ωt, θ̇ = B cos ωt: entries of the Gram matrix in closed form.

    Of V, θ̇, V̇ and θ̈, only θ̇ and V̇ are parallel: their means are A²/2 and so on, and one of their combinations is zero.
    """
    w, base, a, b = 2 * np.pi / 2.0, 0.8, 0.2, 0.5
    t = PERIOD * np.arange(800)
    twist = np.stack([base + a * np.sin(w * t), b * np.cos(w * t)], axis=-1)[None]
    found = excitation(result(robot, twist), window=4.0)
    assert np.isnan(found["least"].values[0, :399]).all() and np.isfinite(found["least"].values[0, 399:]).all()
    scale = feature_scale(robot)
    x = np.stack([twist[0, :, 0], twist[0, :, 1], a * w * np.cos(w * t), -b * w * np.sin(w * t)], axis=1) / scale[:4]
    part = x[200:600]
    closed = np.diag([base**2 + a**2 / 2, b**2 / 2, (a * w) ** 2 / 2, (b * w) ** 2 / 2])
    closed[1, 2] = closed[2, 1] = a * b * w / 2
    closed[0, 3] = closed[3, 0] = -a * b * w / 2
    np.testing.assert_allclose(part.T @ part / 400, closed / np.outer(scale[:4], scale[:4]), atol=1e-12)
    # θ̇ and V̇ are parallel, so neither has an excitation of its own; so the least eigenvalue is zero as well.
    inner = found.isel(run=0, time=600)
    assert inner["least"] < 1e-6
    assert (inner["alone"].sel(feature=["ω", "V̇"]) < 1e-6).all()
    assert inner["alone"].sel(feature="Vω") > 1e-6
    np.testing.assert_array_equal(inner["eigenvalues"].values[0], inner["least"].values)


def test_failure(robot):
    """A run that failed has NaN from there on, and the other run does not."""
    twist = RNG.uniform(0.1, 1, (2, 600, 2))
    found = excitation(result(robot, twist, dead=500), window=1.0)
    assert np.isfinite(found["least"].values[0, 99:500]).all() and np.isnan(found["least"].values[0, 500:]).all()
    assert np.isfinite(found["least"].values[1, 99:]).all()
    true = excitation(result(robot, twist), 1.0, "true")
    np.testing.assert_allclose(true["alone"].values[1], found["alone"].values[1])


def test_refused(robot):
    runs = result(robot, RNG.uniform(0.1, 1, (1, 50, 2)))
    with pytest.raises(InputError, match="window: 0.01 s is shorter"):
        excitation(runs, 0.01)
    for window in (np.nan, np.inf):
        with pytest.raises(InputError, match=f"^window: {window} s is not finite$"):
            excitation(runs, window)
    with pytest.raises(InputError, match="motion: 'seen' is not one of commanded, true"):
        excitation(runs, 0.1, "seen")
    with pytest.raises(InputError, match="parameters: not a variable"):
        parameter_error(runs)


def test_plot(robot, tmp_path):
    """Two panels with logarithmic axes; the lines hold the data."""
    runs = result(robot, RNG.uniform(0.1, 1, (2, 300, 2)))
    figure = plots.excitation(runs, span=1.0)
    first, second = figure.axes
    np.testing.assert_allclose(first.lines[1].get_ydata(), excitation(runs, 1.0)["least"].values[1])
    assert len(second.lines) == 8 and first.get_yscale() == second.get_yscale() == "log"
    for run in (2, -3):
        with pytest.raises(InputError, match=f"^run: {run} is not the index of one of 2 runs$"):
            plots.excitation(runs, span=1.0, run=run)
    plots.save(figure, tmp_path, "excitation")
    assert (tmp_path / "excitation.png").stat().st_size > 5000


def test_plot_of_a_failure(robot):
    """Runs have the colours of their controllers; who failed is counted in the legend, with a cross where it did."""
    runs = result(robot, RNG.uniform(0.1, 1, (2, 300, 2)), dead=200).assign(failed=("run", [True, False]))
    runs = runs.assign_coords(label=("run", ["heavy", "light"]), feedforward=("run", ["none", "model"]))
    figure = plots.excitation(runs, span=1.0, run=1)
    first, second = figure.axes
    assert second.get_ylabel() == "excitation alone (1), light"  # whose, where there are several
    colours = [line.get_color() for line in first.lines if line.get_marker() == "None"]
    assert colours == [CONTROLLERS[name][1] for name in ("none", "model")]
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["heavy (failed)", "light"]
    (cross,) = (line for line in first.lines if line.get_marker() == "X")
    assert cross.get_xdata() == [PERIOD * 199]
