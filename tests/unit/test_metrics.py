"""Metrics against closed forms on made-up signals."""

import warnings

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from mrctl.control.features import feature_scale
from mrctl.record import InputError
from mrctl.results import metrics, plots
from mrctl.results.dataset import save
from mrctl.theory.references import Circle, Lemniscate
from mrctl.viewer.scatter import in_words

DT, LAP = 0.01, 2.0


def make(runs=1, laps=3, lap=LAP, **signals):
    """A result that is zero except for the given signals, functions of time (T,) or arrays that broadcast to (B, T)."""
    count = int(round(laps * lap / DT))
    time = np.arange(count) * DT
    names = (*metrics.SAMPLED, "theta", "feedforward_left", "feedforward_right")
    zero = np.zeros((runs, count))
    values = {name: signals.get(name, zero) for name in names}
    data = {name: np.broadcast_to(v(time) if callable(v) else v, zero.shape).copy() for name, v in values.items()}
    return xr.Dataset(
        {name: (("run", "time"), value) for name, value in data.items()}
        | {"failed": ("run", np.zeros(runs, bool)), "failure_time": ("run", np.full(runs, np.nan))},
        {"time": time, "run": np.arange(runs), "label": ("run", ["none"] * runs), "lap_time": ("run", [lap] * runs)},
        {"control_period": DT},
    )


def fail(result, run, time):
    """The result with one run failed at a time."""
    result = result.copy(deep=True)
    result["failed"][run], result["failure_time"][run] = True, time
    for name in metrics.SAMPLED:
        result[name][run, result["time"].values >= time] = np.nan
    return result


def lap(result, name, run=0, number=1):
    """One number of `per_lap`."""
    return float(metrics.per_lap(result)[name].isel(run=run).sel(lap=number))


@pytest.mark.parametrize("name", ["longitudinal", "lateral", "heading"])
def test_sinusoid(name):
    """A sinusoid of amplitude a has RMS a/√2 and maximum a."""
    result = make(**{f"{name}_error": lambda t: -0.3 * np.sin(2 * np.pi * t / LAP)})
    assert lap(result, f"{name}_rmse") == pytest.approx(0.3 / np.sqrt(2), rel=1e-12)
    assert lap(result, f"{name}_max") == pytest.approx(0.3, rel=1e-12)


def test_position():
    """A constant offset (3, 4) is a distance of 5."""
    assert lap(make(x=3.0, y_ref=4.0), "position_rmse") == pytest.approx(5)


def test_decimated():
    """The metrics of a result without some of its samples are those of the rest, with a warning."""
    result = make(x=3.0, y_ref=4.0)
    with pytest.warns(UserWarning, match="one of 10 samples"):
        found = metrics.per_lap(result.isel(time=slice(None, None, 10)))
    assert found["position_rmse"].values == pytest.approx(5)


@pytest.mark.parametrize("name", ["v", "omega"])
def test_velocity_errors(name):
    """A constant error e gives RMSE e, IAE e T, ITAE e T²/2 in every lap, against the original reference."""
    result = make(**{name: 0.5, f"{name}_ref": 0.7, f"{name}_command": 0.5})
    for number in (1, 3):
        assert lap(result, f"{name}_rmse", number=number) == pytest.approx(0.2)
        assert lap(result, f"{name}_iae", number=number) == pytest.approx(0.2 * LAP)
        assert lap(result, f"{name}_itae", number=number) == pytest.approx(0.2 * LAP**2 / 2)


def test_itae_of_ramp():
    """An error that grows as t has ITAE ∫t² = T³/3."""
    assert lap(make(v=lambda t: t), "v_itae") == pytest.approx(LAP**3 / 3, rel=0.01)


def test_variation_of_triangle():
    """A triangle of amplitude a and n periods varies by 4 a n; the laps add up to the run."""
    wave = lambda t: 2 * np.abs((3 * t / LAP) % 1 - 0.5) - 0.5  # noqa: E731
    result = make(voltage_left=lambda t: 5 * 2 * wave(t), voltage_right=lambda t: -2 * wave(t))
    whole = np.abs(np.diff(result["voltage_left"])).sum() + np.abs(np.diff(result["voltage_right"])).sum()
    found = metrics.per_lap(result)["voltage_variation"]
    assert float(found.sum()) == pytest.approx(whole, rel=1e-12)
    assert lap(result, "voltage_variation", number=2) == pytest.approx(4 * (5 + 1) * 3, rel=0.02)


def test_energy_saturation_weights():
    """Constant power p is p T joules; half the lap saturated is T/2; the weight norm is that at the lap's end."""
    result = make(power=7.0, saturated=lambda t: (t % LAP) < LAP / 2 - DT / 2, weight_norm=lambda t: t)
    assert lap(result, "energy") == pytest.approx(7 * LAP)
    assert lap(result, "saturation_time") == pytest.approx(LAP / 2)
    assert lap(result, "weight_norm", number=2) == pytest.approx(2 * LAP - DT)


@pytest.mark.parametrize("period", [2.0, 3.0])
def test_excitation(robot, period):
    """The smallest eigenvalue of the Gram matrix, against numpy on features written out with analytic derivatives."""
    lap, w = 2.0, 2 * np.pi / period
    result = make(
        laps=1,
        v_command=lambda t: 0.3 + 0.3 * np.sin(w * t),
        omega_command=lambda t: 1.5 * np.cos(2 * w * t),
    ).assign(half_track=("run", [robot.half_track]), feature_scale=(("run", "feature"), [feature_scale(robot)]))
    t = np.arange(int(lap / DT)) * DT
    v, omega = 0.3 + 0.3 * np.sin(w * t), 1.5 * np.cos(2 * w * t)
    d = robot.half_track
    rows = [v, omega, 0.3 * w * np.cos(w * t), -3 * w * np.sin(2 * w * t), v * omega, omega**2]
    rows += [np.tanh((v - d * omega) / 0.05), np.tanh((v + d * omega) / 0.05)]
    x = np.array(rows) / feature_scale(robot)[:, None]
    expected = np.linalg.eigvalsh(x @ x.T / len(t))[0]
    assert expected > 1e-5
    found = metrics.per_lap(result)["excitation"].values[0, 0]
    assert found == pytest.approx(expected, rel=0.02)  # the derivative is a difference quotient
    assert np.isnan(metrics.per_lap(result.drop_vars("feature_scale"))["excitation"]).all()


def test_excitation_of_references(robot):
    """A circle at constant speed excites one direction of eight, the eight all of them; too few samples none."""

    def excited(reference, n):
        command = reference.sample(DT * np.arange(n)).twist
        return metrics.excitation(command[None], DT, np.array([robot.half_track]), feature_scale(robot)[None])[0]

    assert excited(Circle(), 800) == 0
    assert excited(Lemniscate(), 1200) > 1e-12
    assert excited(Lemniscate(period=20.0), 2000) > excited(Lemniscate(), 1200)  # the inner wheel slows more
    assert excited(Lemniscate(), 7) == 0


def test_feedback_share():
    """A feedback of a quarter of the voltage is a share of 1/4; at rest nobody works."""
    sine = lambda t: np.sin(t)  # noqa: E731
    result = make(feedback_left=lambda t: sine(t) / 4, voltage_left=sine, feedback_right=-0.25, voltage_right=1.0)
    assert lap(result, "feedback_share") == pytest.approx(0.25)
    assert lap(make(), "feedback_share") == 0


@given(
    scale=st.floats(0.01, 100),
    signal=st.lists(st.floats(-10, 10, allow_subnormal=False), min_size=30, max_size=30),
)
@settings(max_examples=30, deadline=None)
def test_scaling(scale, signal):
    """RMSE, maximum, IAE and ITAE scale with the error; RMSE never exceeds the maximum."""
    one, other = (
        metrics.per_lap(make(laps=1, lap=0.3, v=factor * np.array(signal), lateral_error=factor * np.array(signal)))
        for factor in (1, scale)
    )
    for name in ("v_rmse", "v_iae", "v_itae", "lateral_rmse", "lateral_max"):
        assert float(other[name][0, 0]) == pytest.approx(scale * float(one[name][0, 0]))
    assert one["lateral_rmse"][0, 0] <= one["lateral_max"][0, 0] + 1e-12


def test_lap_count():
    """Whole laps only; a run shorter than one lap is one lap; an open path without lap time is one lap."""
    assert metrics.per_lap(make(laps=3.7)).sizes["lap"] == 3
    assert metrics.per_lap(make(laps=0.5)).sizes["lap"] == 1
    assert metrics.per_lap(make().drop_vars("lap_time")).sizes["lap"] == 1
    assert metrics.per_lap(make(lap=0.1, laps=10)).sizes["lap"] == 10  # 0.1 is not a binary fraction


@given(ticks=st.floats(20, 2000), laps=st.integers(1, 40))
def test_every_lap_counts(ticks, laps):
    """A run of so many laps has as many, also where a lap is no whole number of samples."""
    assume(abs(laps * ticks % 1 - 0.5) > 1e-6)  # half a tick more or less is rounded either way
    samples = round(laps * ticks)
    run = make(laps=samples, lap=DT).isel(run=0).assign_coords(lap_time=ticks * DT)
    edges = metrics.laps_of(run).edges
    assert len(edges) == laps + 1 and edges[-1] == samples and np.abs(np.diff(edges) - ticks).max() <= 1


def test_mixed_lap_times():
    """Runs with different lap times are padded with NaN, not failed; each keeps its own last lap."""
    result = make(runs=2, laps=4, v=lambda t: t).assign_coords(lap_time=("run", [LAP, 2 * LAP]))
    laps = metrics.per_lap(result)
    assert laps["laps"].values.tolist() == [4, 2] and not laps["failed"].any()
    assert np.isnan(laps["v_rmse"].values[1]).tolist() == [False, False, True, True]
    for run, (a, b) in enumerate([(3 * LAP, 4 * LAP), (2 * LAP, 4 * LAP)]):
        exact = np.sqrt((b**3 - a**3) / 3 / (b - a))
        assert metrics.summary(result)["v_rmse"][run] == pytest.approx(exact, rel=2e-3)


def test_padded_run():
    """A run that ended early without failing counts the laps it has."""
    result = make(runs=2, laps=4, v=1.0)
    for name in metrics.SAMPLED:
        result[name][1, int(2 * LAP / DT) :] = np.nan
    laps = metrics.per_lap(result)
    assert laps["laps"].values.tolist() == [4, 2] and metrics.summary(result)["v_rmse"][1] == 1


def test_guard_from_the_start():
    """A fallback in the first tick counts as an action of the first lap, and in an interval of a run does not."""
    result = make(laps=2, guard=lambda t: t < LAP / 2)
    assert metrics.per_lap(result)["guard_actions"].values.tolist() == [[1.0, 0.0]]
    later = result.assign_coords(time=result["time"] + LAP)
    assert metrics.per_lap(later)["guard_actions"].values.tolist() == [[0.0, 0.0]]


def test_single_run():
    """A squeezed run gives the same numbers as the run in its batch, and keeps its label."""
    result = make(runs=2, v=np.array([[1.0], [2.0]]))
    single = metrics.per_lap(result.isel(run=1))
    both = metrics.per_lap(result)
    xr.testing.assert_identical(single, both.isel(run=[1]))
    pd.testing.assert_frame_equal(metrics.summary(both.isel(run=1)), metrics.summary(both.isel(run=[1])))


@pytest.mark.parametrize(("time", "good"), [(0.0, 0), (2.5, 1), (4.0, 2), (5.99, 2), (6.5, 2)])
def test_failed_run(time, good):
    """NaN from the lap of the failure on, also when it fails on the edge of a lap or after the last whole one."""
    laps = metrics.per_lap(fail(make(runs=2, laps=3.4, v=1.0), 1, time))
    assert np.isfinite(laps["v_rmse"].values[1]).tolist() == [True] * good + [False] * (3 - good)
    assert np.isfinite(laps["v_rmse"].values[0]).all()
    assert laps["failed"].values.tolist() == [False, True]


def test_failure_without_nan():
    """The flag alone is believed: a run that tipped over on its last sample has no last lap."""
    result = make(v=1.0)
    result["failed"][0] = True
    assert np.isnan(metrics.per_lap(result)["v_rmse"].values[0]).tolist() == [False, False, True]


def test_summary_counts_failures():
    """A row per run, failures among them, and how many there are."""
    result = fail(make(runs=3, v=np.array([[1.0], [2.0], [3.0]])), 2, 3.0)
    table = metrics.summary(result)
    assert len(table) == 3 and table.attrs["failed"] == 1 and table["failed"].tolist() == [False, False, True]
    assert table.attrs["units"]["energy"] == "J" and "failure" not in table
    why = metrics.summary(result.assign(failure=("run", ["", "", "tilt over 30°"])))["failure"]
    assert why.tolist() == ["", "", "tilt over 30°"]
    assert metrics.summary(result, lap=1)["v_rmse"].tolist() == [1, 2, 3]


def test_units():
    """Every metric is there with its unit."""
    laps = metrics.per_lap(make())
    for name, (unit, text) in metrics.METRICS.items():
        assert laps[name].attrs == {"units": unit, "long_name": text} and laps[name].dims == ("run", "lap")


@pytest.mark.parametrize("decay", [0.3, 0.5, 0.8])
def test_laps_to_converge(decay):
    """An error c + aᵏ is within 1.2 c' of its last value c' from the lap that the logarithm says."""
    count, floor = 20, 0.1
    amplitude = np.repeat(floor + decay ** np.arange(count), int(LAP / DT))
    laps = metrics.per_lap(make(runs=2, laps=count, lateral_error=amplitude * [[1], [0]]))
    bound = 1.2 * (floor + decay ** (count - 1)) - floor
    exact = 1 + int(np.ceil(np.log(bound) / np.log(decay)))
    assert metrics.laps_to_converge(laps, "lateral_rmse").values.tolist() == [exact, 1]


def test_laps_to_converge_relapse():
    """A relapse counts, and a failed run does not converge."""
    error = np.repeat([5.0, 1.0, 5.0, 1.0, 1.0], int(LAP / DT))
    result = fail(make(runs=2, laps=5, lateral_error=error), 1, 9.0)
    found = metrics.laps_to_converge(metrics.per_lap(result), "lateral_rmse").values
    assert found[0] == 4 and np.isnan(found[1])


def test_summary_shows_laps_to_converge():
    """That of the position error, whichever lap is asked for; a run without a lap has not converged."""
    error = np.repeat([5.0, 3.0, 1.1, 1.0], int(LAP / DT))
    laps = metrics.per_lap(fail(make(runs=2, laps=4, x=error), 1, 7.0))
    for lap in (-1, 1):
        table = metrics.summary(laps, lap)
        assert table["laps_to_converge"][0] == 3 and np.isnan(table["laps_to_converge"][1])
    assert table.attrs["units"]["laps_to_converge"] == "1"
    laps["laps"][1] = 0
    assert np.isnan(metrics.summary(laps)["laps_to_converge"][1])


def test_recovery_laps():
    """The first lap from which on all are within the band; a relapse counts, a failure is NaN, never is infinite."""
    laps = np.array(
        [
            [9, 1.0, 1.1, 1.2, 1.0, 9],  # never left
            [9, 1.0, 5.0, 1.2, 1.0, 9],
            [9, 1.0, 1.0, 5.0, 1.1, 9],  # late
            [9, 1.0, 5.0, 1.0, 1.3, 9],  # relapsed, and still is
            [9, 1.0, 5.0, np.nan, np.nan, np.nan],
        ]
    )
    table = xr.Dataset({"v_rmse": (("run", "lap"), laps)}, {"run": np.arange(5), "lap": np.arange(1, 7)})
    found = metrics.recovery_laps(table, "v_rmse", change=3, until=5)
    np.testing.assert_array_equal(found, [0, 1, 2, np.inf, np.nan])
    assert metrics.recovery_laps(table, "v_rmse", 3, 5, factor=1.3).values[3] == 1
    with pytest.raises(InputError, match="^factor: 0.9 is below 1"):
        metrics.recovery_laps(table, "v_rmse", 3, 5, factor=0.9)
    for change, until in ((1, 3), (4, 3), (3, 7)):
        with pytest.raises(InputError, match="^change: "):
            metrics.recovery_laps(table, "v_rmse", change, until)


@pytest.mark.parametrize(
    ("call", "field"),
    [
        (lambda r: metrics.per_lap(r.drop_vars("power")), "power"),
        (lambda r: metrics.per_lap(r.assign_coords(lap_time=("run", [1e-3]))), "lap_time"),
        (lambda r: metrics.per_lap(r.isel(time=[0]).assign_attrs({}).drop_attrs()), "control_period"),
        (lambda r: metrics.per_lap(r.sel(time=slice(90, 91))), "result"),
        (lambda r: metrics.summary(r, lap=0), "lap"),
        (lambda r: metrics.summary(r, lap=9), "lap"),
        (lambda r: metrics.summary(r.isel(run=[])), "result"),
        (lambda r: metrics.laps_to_converge(metrics.per_lap(r), "speed"), "metric"),
        (lambda r: metrics.laps_to_converge(metrics.per_lap(r), "v_rmse", 0.5), "factor"),
        (lambda _: metrics.summary(3), "result"),  # type: ignore[arg-type]
        (lambda _: metrics.per_lap("runs.zarr"), "result"),  # type: ignore[arg-type]
        (lambda _: plots.errors(None), "result"),  # type: ignore[arg-type]
        (lambda _: plots.learning_curve([]), "result"),  # type: ignore[arg-type]
        (lambda _: save(3, "a.zarr"), "result"),  # type: ignore[arg-type]
    ],
)
def test_bad_input(call, field):
    """One line that begins with the field."""
    with pytest.raises(InputError, match=rf"^{field}: .+") as caught:
        call(make())
    assert "\n" not in str(caught.value)


def test_run_that_did_not_drive():
    """Of a run of a sweep that drove nothing there are no laps, and no metric over all of them."""
    result = make(runs=2, laps=2, v=1.0).assign_coords(samples=("run", [round(2 * LAP / DT), 0]))
    for name in metrics.SAMPLED:
        result[name][1] = np.nan
    laps = metrics.per_lap(result.assign(failed=("run", [False, True])))
    assert laps["laps"].values.tolist() == [2, 0] and laps["failed"].values.tolist() == [False, True]
    with warnings.catch_warnings(action="error"):
        over = metrics.over_laps(laps, "v_rmse")
    assert over[0] == pytest.approx(1) and np.isnan(over[1])
    table = metrics.summary(laps)
    assert table["laps"].tolist() == [2, 0] and np.isnan(table["v_rmse"][1])


def test_over_laps_and_excess():
    """The RMS over all laps is that of all samples; the excess is the area above the error that settles."""
    error = np.array([[3.0, 2.0, 1.0, 4.0, 2.0, 1.0], [2.0, 2.0, 2.0, np.nan, np.nan, np.nan], [1.0] * 6])
    laps = xr.Dataset(
        {"position_rmse": (("run", "lap"), error), "laps": ("run", [6, 6, 3])},
        {"run": [0, 1, 2], "lap": np.arange(1, 7), "lap_time": ("run", [12.0, 12.0, 10.0])},
    )
    found = metrics.over_laps(laps, "position_rmse").values
    assert found[0] == pytest.approx(np.sqrt(np.mean(error[0] ** 2))) and found[2] == 1.0 and np.isnan(found[1])
    after = metrics.excess(laps, "position_rmse", 4, 6).values
    assert after[0] == pytest.approx(12 * ((4 - 1) + (2 - 1))) and np.isnan(after[1]) and after[2] == 0.0
    with pytest.raises(InputError, match="^metric: 'energy' is not a root mean square"):
        metrics.over_laps(laps, "energy")
    with pytest.raises(InputError, match="^change: lap 5 and lap 4"):
        metrics.excess(laps, "position_rmse", 5, 4)


@pytest.mark.parametrize(
    ("unit", "factor", "shown"),
    [("m", 1e3, "mm"), ("rad/s", 1e3, "mrad/s"), ("m s", 1e3, "mm s"), ("V", 1.0, "V"), ("1", 1.0, "")],
)
def test_shown_units(unit, factor, shown):
    """Lengths and angles are shown in thousandths, by figures and pages alike; a number without a unit as it is."""
    assert metrics.shown_unit(unit) == (factor, shown)
    name = next(name for name, (own, _) in metrics.METRICS.items() if own == unit)
    text = metrics.METRICS[name][1]
    assert plots._shown(name) == (factor, f"{text} ({shown})" if shown else text)
    assert in_words(name) == (factor, f"{text}, {shown}" if shown else text)
