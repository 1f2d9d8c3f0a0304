"""Metrics of a result: errors lap by lap, learning, and recovery after a change.

They are pure functions of the dataset that `simulate` returns. Errors are against the ORIGINAL reference. A run that
failed is never dropped: its metrics are NaN from the lap in which it failed on. Laps are numbered from 1. A sample is
held for one control period, so an integral over time is a sum times that period.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import NDArray

from mrctl.control.features import feature_matrix
from mrctl.control.guard import GUARD_ACTIONS, NONE, REASONS
from mrctl.kernel import Array
from mrctl.record import InputError
from mrctl.results.dataset import FAULTS, check_kind, require

METRICS: dict[str, tuple[str, str]] = {
    "longitudinal_rmse": ("m", "RMS longitudinal error"),
    "longitudinal_max": ("m", "largest longitudinal error"),
    "lateral_rmse": ("m", "RMS lateral error"),
    "lateral_max": ("m", "largest lateral error"),
    "heading_rmse": ("rad", "RMS heading error"),
    "heading_max": ("rad", "largest heading error"),
    "position_rmse": ("m", "RMS distance to the reference"),
    "v_rmse": ("m/s", "RMS error of the linear velocity"),
    "omega_rmse": ("rad/s", "RMS error of the yaw rate"),
    "v_iae": ("m", "integral of the absolute error of the linear velocity"),
    "omega_iae": ("rad", "integral of the absolute error of the yaw rate"),
    "v_itae": ("m s", "integral of the absolute error of the linear velocity times the time since the lap began"),
    "omega_itae": ("rad s", "integral of the absolute yaw rate error times the time since the lap began"),
    "feedback_share": ("1", "RMS feedback voltage over RMS voltage"),
    "voltage_variation": ("V", "total variation of the voltage, both wheels"),
    "saturation_time": ("s", "time in which a limit acts on the sum of feedback and feedforward; see `saturated`"),
    "energy": ("J", "electrical energy"),
    "weight_norm": ("1", "norm of the learner's weights at the end of the lap"),
    "guard_actions": ("1", "times the guard on the learner stepped in"),
    "excitation": ("1", "smallest eigenvalue of the Gram matrix of the physical features at the commanded motion"),
}
"""Unit and description of each metric, by name."""

ROUNDING = 1e-10  # singular values of the features below this share of the largest are due to rounding
PER_RUN = ("label", "feedforward", "steering", "seed", "lap_time")
SAMPLED = (
    "x", "y", "x_ref", "y_ref", "v", "omega", "v_ref", "omega_ref", "longitudinal_error", "lateral_error",
    "heading_error", "v_command", "omega_command", "feedback_left", "feedback_right", "voltage_left", "voltage_right",
    "saturated", "power", "weight_norm", "guard",
)  # fmt: skip


class Laps(NamedTuple):
    """The laps of one run."""

    edges: NDArray[np.intp]
    """First sample of each lap, and the end of the last one (laps + 1,)."""
    failed: int | None
    """Index of the lap in which the run failed, or None."""


def as_runs(result: xr.Dataset) -> xr.Dataset:
    """Returns the dataset with a `run` dimension and per-run coordinates, also for a single run that was squeezed.

    Raises:
        InputError: It is no dataset.
    """
    check_kind(result)
    if "run" not in result.dims:
        single = result.expand_dims("run")  # without a coordinate where the run has lost its number
        result = single.assign_coords(
            {name: ("run", [result[name].item()]) for name in (*PER_RUN, "samples") if name in result.coords}
        )
    if "label" not in result.coords:
        result = result.assign_coords(label=("run", [f"run {run}" for run in result["run"].values]))
    return result


def control_period(result: xr.Dataset) -> float:
    """Returns the time between the samples of a result in s.

    Raises:
        InputError: The result has neither two samples nor the attribute `control_period`.
    """
    time = result["time"].values
    if len(time) > 1:
        return float((time[-1] - time[0]) / (len(time) - 1))
    if "control_period" not in result.attrs:
        raise InputError("control_period: a result with fewer than two samples must give it")
    return float(result.attrs["control_period"])


def laps_of(run: xr.Dataset) -> Laps:
    """Divides one run (no `run` dimension) into whole laps; a run to a goal, or one shorter than a lap, counts as one.

    A run of a sweep that did not drive has none.

    Samples after the last whole lap are left out, but a failure among them counts as one in that lap.

    Raises:
        InputError: `lap_time` is shorter than the control period.
    """
    period = control_period(run)
    alive = np.isfinite(run["x"].values)
    failed, samples = _failed(run), _end(run)
    if "samples" in run.coords and not int(run["samples"]):  # a run of a sweep that did not drive
        return Laps(np.zeros(1, np.intp), 0 if failed else None)
    lap = float(run["lap_time"]) / period if "lap_time" in run.coords else np.inf
    if lap < 1:
        raise InputError(f"lap_time: {lap * period:g} s is shorter than the control period of {period:g} s")
    # A run has a whole number of samples, up to half a sample less than its laps.
    count = int((samples + 0.5) / lap + 1e-6) if np.isfinite(lap) else 0
    edges = np.rint(np.arange(count + 1) * lap).clip(max=samples).astype(np.intp) if count else np.array([0, samples])
    if not failed:
        return Laps(edges, None)
    dead = len(alive) if alive.all() else int(np.argmin(alive))
    time = float(run["failure_time"]) if "failure_time" in run else np.nan
    if np.isfinite(time):
        dead = min(dead, int((time - float(run["time"][0])) / period + 1e-6))
    return Laps(edges, int(np.clip(np.searchsorted(edges, dead, side="right") - 1, 0, len(edges) - 2)))


def _failed(run: xr.Dataset) -> bool:
    """Tells whether one run failed."""
    return bool(run["failed"]) if "failed" in run else not bool(np.isfinite(run["x"]).all())


def _end(run: xr.Dataset) -> int:
    """Returns the number of samples of one run: NaN that pad a shorter run do not count, NaN after a failure do."""
    alive, size = np.flatnonzero(np.isfinite(run["x"].values)), len(run["time"])
    if not _failed(run) and len(alive):
        return int(alive[-1]) + 1
    if "samples" not in run.coords or not size:  # an older version wrote the result
        return size
    left = int(run["samples"]) - round(float(run["time"][0]) / control_period(run))  # in an interval of a run
    return min(size, left) if left > 0 else size


def per_lap(result: xr.Dataset) -> xr.Dataset:
    """Computes the metrics of every lap of every run.

    Those of a result that holds only some of the samples, as of a decimated sweep, are approximate; a warning says so.

    Args:
        result: What `simulate` returns, variables (run, time), or one run of it.

    Returns:
        `METRICS` with dims (run, lap), NaN beyond the laps of a run, and units in attrs; `laps`, the number of laps of
        each run; `failed`, `failure` and `failure_time` as in the result. Coordinate `lap` counts from 1.

    Raises:
        InputError: The result lacks a variable or has no sample, or a lap is shorter than the control period.
    """
    require(result, ("time", *SAMPLED))
    runs = as_runs(result)
    if not runs.sizes.get("time"):
        raise InputError("result: no samples")
    size = runs.sizes["run"]
    period = control_period(runs)
    warn_if_decimated(runs, "the metrics")
    narrow = runs[[name for name in ("x", "failed", "failure_time") if name in runs]]
    divisions = [laps_of(narrow.isel(run=row)) for row in range(size)]
    counts = [len(laps.edges) - 1 for laps in divisions]
    values = _values(runs, divisions, period)
    variables: dict[str, tuple] = {
        name: (("run", "lap"), values[name], {"units": unit, "long_name": text})
        for name, (unit, text) in METRICS.items()
    }
    variables["laps"] = ("run", counts, {"units": "1", "long_name": "whole laps"})
    variables["failed"] = ("run", [laps.failed is not None for laps in divisions])
    nan = np.full(size, np.nan)
    if "failure" in runs:
        variables["failure"] = ("run", runs["failure"].values)
    variables["failure_time"] = ("run", runs["failure_time"].values if "failure_time" in runs else nan, {"units": "s"})
    coords = {name: ("run", runs[name].values) for name in ("run", *PER_RUN) if name in runs.coords}
    return xr.Dataset(variables, {**coords, "lap": np.arange(1, max(counts, default=0) + 1)}, dict(result.attrs))


def _values(runs: xr.Dataset, divisions: Sequence[Laps], period: float) -> dict[str, Array]:
    """Computes the metrics of every lap of every run, those of runs with the same laps together.

    Args:
        runs: Signals (run, time).
        divisions: The laps of each run.
        period: Seconds between the samples.

    Returns:
        The metrics of `METRICS` by name, `(runs, laps)`; NaN beyond the laps of a run, and from a failure on.
    """
    scaled = {"half_track", "feature_scale"} <= set(runs.variables)
    data = {name: runs[name].transpose("run", "time").values.astype(float) for name in SAMPLED}
    most = max((len(laps.edges) - 1 for laps in divisions), default=0)
    values = {name: np.full((len(divisions), most), np.nan) for name in METRICS}
    begins = not runs["time"].values[:1].any()
    groups: dict[tuple[int, ...], list[int]] = {}
    for row, laps in enumerate(divisions):
        groups.setdefault(tuple(laps.edges), []).append(row)
    for edges, rows in groups.items():
        for lap, (start, end) in enumerate(zip(edges[:-1], edges[1:], strict=True)):
            rates = {name: data[name][rows, start:end] for name in SAMPLED}
            # The step into a lap belongs to it, so that the variation of all laps adds up to that of the run.
            stepping = ("voltage_left", "voltage_right", "guard")
            steps = {name: data[name][rows, max(start - 1, 0) : end] for name in stepping}
            if start == 0 and begins:  # before a run the guard has not acted
                steps["guard"] = np.pad(steps["guard"], [(0, 0), (1, 0)])
            for name, value in lap_metrics(rates, steps, period).items():
                values[name][rows, lap] = value
            if scaled and end - start > 1:
                command = np.stack([rates["v_command"], rates["omega_command"]], axis=-1)
                half_track, scale = runs["half_track"].values[rows], runs["feature_scale"].values[rows]
                values["excitation"][rows, lap] = excitation(command, period, half_track, scale)
    for row, laps in enumerate(divisions):
        if laps.failed is not None:
            for value in values.values():
                value[row, laps.failed :] = np.nan
    return values


def lap_metrics(data: dict[str, Array], steps: dict[str, Array], period: float) -> dict[str, Array]:
    """Computes the metrics of one lap of several robots, all but the excitation.

    Args:
        data: Signals of the lap by name, `(rows, n)`.
        steps: The signals of voltages and `guard`, preceded by the sample before the lap if there is one.
        period: Seconds between the samples.

    Returns:
        The metrics of `METRICS` by name, `(rows,)`.
    """
    found: dict[str, Array] = {}
    for name in ("longitudinal", "lateral", "heading"):
        error = data[f"{name}_error"]
        found[f"{name}_rmse"] = _rms(error)
        found[f"{name}_max"] = np.abs(error).max(-1)
    found["position_rmse"] = np.hypot(_rms(data["x_ref"] - data["x"]), _rms(data["y_ref"] - data["y"]))
    for name in ("v", "omega"):
        error = np.abs(data[name] - data[f"{name}_ref"])
        middle = (np.arange(error.shape[-1]) + 0.5) * period
        found[f"{name}_rmse"] = _rms(error)
        found[f"{name}_iae"] = error.sum(-1) * period
        found[f"{name}_itae"] = (error * middle).sum(-1) * period
    feedback = np.hypot(_rms(data["feedback_left"]), _rms(data["feedback_right"]))
    voltage = np.hypot(_rms(data["voltage_left"]), _rms(data["voltage_right"]))
    with np.errstate(divide="ignore", invalid="ignore"):
        found["feedback_share"] = np.where(feedback == 0, 0.0, feedback / voltage)  # 0 at rest, where both are 0
    variations = [np.abs(np.diff(steps[name])).sum(-1) for name in ("voltage_left", "voltage_right")]
    found["voltage_variation"] = variations[0] + variations[1]
    found["saturation_time"] = data["saturated"].sum(-1) * period
    found["energy"] = data["power"].sum(-1) * period
    found["weight_norm"] = data["weight_norm"][:, -1]
    found["guard_actions"] = (np.diff(steps["guard"]) > 0).sum(-1).astype(float)
    return found


def excitation(command: Array, period: float, half_track: Array, scale: Array) -> Array:
    """Computes the smallest eigenvalue of the Gram matrix XᵀX/n of the 8 physical features X `(n, 8)` of n samples.

    It says how well the motion determines the least excited combination of coefficients: where it is zero, the motion
    says nothing about that combination (persistency of excitation; Ioannou and Sun 1996, section 4.3).

    Args:
        command: Commanded twist in m/s, rad/s, `(…, n, 2)`; its derivative is taken by central differences.
        period: Seconds between the samples.
        half_track: Half track of the nominal robot in m, `(…,)`.
        scale: Scales that the features are divided by, as from `feature_scale`, `(…, 8)`.

    Returns:
        The eigenvalue, `(…,)`; NaN where the motion is not finite.
    """
    n = command.shape[-2]
    x = feature_matrix(command, np.gradient(command, period, axis=-2), half_track[..., None], scale[..., None, :])
    finite = np.asarray(np.isfinite(x).all(axis=(-2, -1)))
    # Eigenvalues of XᵀX are rounded to 1e-16 of the largest; squared singular values of X resolve smaller ones.
    triangle = np.linalg.qr(np.where(finite[..., None, None], x, 0.0), mode="r")
    sizes = np.linalg.svd(triangle, compute_uv=False)
    least, largest = sizes[..., -1], sizes[..., 0]
    least = np.where((least > ROUNDING * largest) & (n >= x.shape[-1]), least, 0.0)
    return np.where(finite, np.square(least) / n, np.nan)


def warn_if_decimated(runs: xr.Dataset, what: str) -> None:
    """Warns that something is approximate where a result holds only some of the samples; tells the caller's caller."""
    period = control_period(runs)
    if (every := round(period / runs.attrs.get("control_period", period))) > 1:
        warnings.warn(f"time: holds one of {every} samples, so that {what} are approximate", stacklevel=3)


def _check_factor(factor: float) -> None:
    """Raises `InputError` if a factor on an error that a run is to come back to is below 1."""
    if not factor >= 1:
        raise InputError(f"factor: {factor} is below 1")


def _rms(signal: Array) -> Array:
    """Returns the root mean square along the last axis."""
    return np.sqrt(np.mean(np.square(signal), axis=-1))


def guard_events(result: xr.Dataset) -> pd.DataFrame:
    """Lists the actions of the guard on the learner, run by run in order of time.

    Args:
        result: What `simulate` returns, or one run of it.

    Returns:
        A row for each action: run, time in s, action (fallback or resume), and the reason in words.

    Raises:
        InputError: The result has no record of the guard.
    """
    require(result, ("time", "guard", "guard_reason"))
    runs = as_runs(result)
    whole = runs.sizes["time"] > 0 and runs["time"].values[0] == 0.0  # an interval may begin after an action
    rows = []
    for row, number in enumerate(runs["run"].values):
        action, reason = (np.nan_to_num(runs[name].values[row]).astype(int) for name in ("guard", "guard_reason"))
        for k in np.flatnonzero(np.diff(action, prepend=0 if whole else action[:1])):
            if np.isnan(runs["guard"].values[row, k]):
                continue  # the NaN after a failure are no actions
            name = GUARD_ACTIONS[action[k]] if action[k] != NONE else "resume"
            rows.append((number, float(runs["time"][k]), name, REASONS[reason[k]]))
    return pd.DataFrame(rows, columns=["run", "time", "action", "reason"])


def laps_to_converge(laps: xr.Dataset, metric: str, factor: float = 1.2) -> xr.DataArray:
    """Finds the first lap from which on the metric stays within `factor` times its value in the run's last lap.

    Args:
        laps: What `per_lap` returns.
        metric: One of `METRICS`.
        factor: Largest ratio to the final value that counts as converged, at least 1.

    Returns:
        Number of the lap, counted from 1, `(run,)`; NaN for a run that failed.

    Raises:
        InputError: There is no such metric, or the factor is below 1.
    """
    known(metric)
    _check_factor(factor)
    number = np.full(laps.sizes["run"], np.nan)
    for row, count in enumerate(laps["laps"].values):
        value = laps[metric].values[row, :count]
        if count and np.isfinite(value[-1]):
            outside = np.flatnonzero(~(value <= factor * value[-1]))
            number[row] = 1 if not len(outside) else outside[-1] + 2
    attrs = {"units": "1", "long_name": f"laps to {factor:g}× the final {METRICS[metric][1]}"}
    return xr.DataArray(number, {"run": laps["run"].values}, ("run",), "laps_to_converge", attrs)


def recovery_laps(laps: xr.Dataset, metric: str, change: int, until: int, factor: float = 1.2) -> xr.DataArray:
    """Counts the laps after a change until the metric is back, to stay, within `factor` times its value before it.

    Args:
        laps: What `per_lap` returns.
        metric: One of `METRICS`.
        change: Number of the lap, from 2, at whose beginning the change came.
        until: Number of the last lap before the next change.
        factor: Largest ratio to the lap before the change that counts as recovered, at least 1.

    Returns:
        Number of laps `(run,)`: 0 if no lap is outside, infinite if the last lap is, NaN if the run failed.

    Raises:
        InputError: There is no such metric, or no such lap, or the factor is below 1.
    """
    known(metric)
    _check_factor(factor)
    if not 2 <= change <= until <= laps.sizes["lap"]:
        raise InputError(f"change: lap {change} and lap {until} are not in order within 2 to {laps.sizes['lap']}")
    values = laps[metric].transpose("run", "lap").values[:, change - 2 : until]
    outside = ~(values[:, 1:] <= factor * values[:, :1])
    last = outside.shape[1] - np.argmax(outside[:, ::-1], axis=1)
    back = np.where(outside[:, -1], np.inf, np.where(outside.any(axis=1), last, 0))
    number = np.where(np.isfinite(values).all(axis=1), back, np.nan)
    attrs = {"units": "1", "long_name": f"laps until {METRICS[metric][1]} is back within {factor:g}×"}
    return xr.DataArray(number, {"run": laps["run"].values}, ("run",), "recovery_laps", attrs)


def over_laps(laps: xr.Dataset, metric: str) -> xr.DataArray:
    """Returns an RMS metric, such as `position_rmse`, over all laps of each run together; NaN if the run failed.

    Args:
        laps: What `per_lap` returns; all laps of a run have the same duration.
        metric: Name of an RMS metric.

    Raises:
        InputError: There is no such metric, or it is no RMS.
    """
    if not known(metric).endswith("_rmse"):
        raise InputError(f"metric: {metric!r} is not a root mean square")
    count = laps["laps"].values
    values = laps[metric].transpose("run", "lap").values
    there = np.arange(values.shape[1]) < count[:, None]
    total = np.square(np.where(there, values, 0.0)).sum(axis=1)
    mean = np.divide(total, count, out=np.full(len(count), np.nan), where=count > 0)  # none of a run that did not drive
    attrs = {"units": METRICS[metric][0], "long_name": f"{METRICS[metric][1]} over all laps"}
    return xr.DataArray(np.sqrt(mean), {"run": laps["run"].values}, ("run",), metric, attrs)


def excess(laps: xr.Dataset, metric: str, change: int, until: int) -> xr.DataArray:
    """Returns the error above its settled value, integrated over time from a change on: T Σ (e_k − e_until).

    Args:
        laps: What `per_lap` returns, with the lap time T.
        metric: Name of the metric e.
        change: Number of the lap, from 1, at whose beginning the change came; 1 for the transient of the start.
        until: Number of the lap whose error counts as settled.

    Returns:
        Integral in the metric's unit times s, `(run,)`; NaN if the run failed by then.

    Raises:
        InputError: There is no such metric or lap.
    """
    known(metric)
    if not 1 <= change <= until <= laps.sizes["lap"]:
        raise InputError(f"change: lap {change} and lap {until} are not in order within 1 to {laps.sizes['lap']}")
    error = laps[metric].transpose("run", "lap").values[:, change - 1 : until]
    total = laps["lap_time"].values * (error - error[:, -1:]).sum(axis=1)
    attrs = {"units": f"{METRICS[metric][0]} s", "long_name": f"excess of the {METRICS[metric][1]}"}
    return xr.DataArray(total, {"run": laps["run"].values}, ("run",), "excess", attrs)


def summary(result: xr.Dataset, lap: int = -1) -> pd.DataFrame:
    """Makes a table with a row for each run: its description, whether it failed, and its metrics in one lap.

    Args:
        result: What `simulate` or `per_lap` returns, or one run of it.
        lap: Number of the lap, counted from 1, or from −1 backwards from the end of the run. A run without such a lap
            has NaN.

    Returns:
        Columns label, feedforward, steering, seed (those there are), laps, failed, failure_time, `METRICS` in that lap,
        and laps_to_converge, the first lap from which on the position error stays within 1.2 times its final value; for
        what `simulate` returns also failure, which says why a run failed, and those of `dataset.FAULTS` that a run has.
        `attrs["failed"]` is the number of failed runs, `attrs["units"]` the units by column.

    Raises:
        InputError: There is no run, or none has that lap.
    """
    check_kind(result)
    laps = as_runs(result) if "lap" in result.dims else per_lap(result)
    counts = laps["laps"].values
    if not len(counts):
        raise InputError("result: holds no run")
    index = np.where(lap > 0, lap - 1, counts + lap)
    there = (index >= 0) & (index < counts)
    if lap == 0 or not there.any():
        raise InputError(
            f"lap: {lap} is not in 1 to {counts.max(initial=0):.0f}, nor counted from the end by −1, −2, …"
        )
    rows = np.arange(len(counts))
    columns = {name: laps[name].values for name in PER_RUN[:-1] if name in laps.coords}
    columns |= {name: laps[name].values for name in ("laps", "failed", "failure_time")}
    columns |= {"failure": np.atleast_1d(result["failure"].values)} if "failure" in result else {}
    columns |= {name: np.where(there, laps[name].values[rows, np.where(there, index, 0)], np.nan) for name in METRICS}
    columns["laps_to_converge"] = laps_to_converge(laps, "position_rmse").values
    faults = {name: np.atleast_1d(result[name].values) for name in FAULTS if name in result}
    columns |= {name: texts for name, texts in faults.items() if texts.any()}
    table = pd.DataFrame(columns, index=pd.Index(laps["run"].values, name="run"))
    units = {name: unit for name, (unit, _) in METRICS.items()} | {"laps_to_converge": "1"}
    table.attrs = {"failed": int(laps["failed"].sum()), "units": units}
    return table


def shown_unit(unit: str) -> tuple[float, str]:
    """Returns the factor by which figures and pages show a quantity with a unit, and the unit that they show.

    What is in m or rad, as errors are, is shown in thousandths; "" stands for no unit.
    """
    if unit == "1":
        return 1.0, ""
    return (1e3, f"m{unit}") if unit.startswith(("m", "rad")) else (1.0, unit)


def known(metric: str) -> str:
    """Returns the name if it is one of `METRICS`.

    Raises:
        InputError: It is not; the message lists all metrics.
    """
    if metric not in METRICS:
        raise InputError(f"metric: {metric!r} is not one of {', '.join(METRICS)}")
    return metric
