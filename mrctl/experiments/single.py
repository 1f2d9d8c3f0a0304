"""`mrctl run`: runs one scenario, prints its metrics and saves its result."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path

import numpy as np
import xarray as xr

from mrctl.control.stages import Stages
from mrctl.experiments.tables import Report, json_text, markdown, number, output_folder
from mrctl.loop import user_files
from mrctl.loop.goals import arrived
from mrctl.loop.hierarchy import MAX_LEARNING_SLIP
from mrctl.loop.hindsight import best_fixed
from mrctl.loop.learned import LEARNED, save_if_learned
from mrctl.loop.runs import simulate
from mrctl.loop.user_stages import expect_stages
from mrctl.record import InputError
from mrctl.results import metrics
from mrctl.results.dataset import departure, faults_of, save, scenarios_of, versions
from mrctl.scenario import MODEL_BASED, Scenario
from mrctl.sweep import store
from mrctl.theory.perturbation import Perturbation

COLUMNS = {
    "longitudinal_rmse": ("longitudinal, mm", 1e3),
    "lateral_rmse": ("lateral, mm", 1e3),
    "heading_rmse": ("heading, mrad", 1e3),
    "position_rmse": ("position, mm", 1e3),
    "v_rmse": ("V, mm/s", 1e3),
    "omega_rmse": ("θ̇, mrad/s", 1e3),
    "feedback_share": ("RMS(U_fb)/RMS(U)", 1.0),
    "saturation_time": ("saturated, s", 1.0),
    "energy": ("energy, J", 1.0),
    "guard_actions": ("guard acted, times", 1.0),
}

FIGURES = {  # file: function of `results.plots`
    "path": "path",
    "velocities": "velocities",
    "errors": "errors",
    "voltages": "voltages",
    "learning": "learning_curve",
}


def run(scenario: Scenario, out: Path | None, as_json: bool, own: str | None = None, hindsight: bool = False) -> Report:
    """Runs a scenario.

    Args:
        scenario: The run.
        out: Folder for `result.zarr`, figures and learned weights; None saves nothing.
        as_json: Whether to return JSON instead of a table.
        own: Stages of the user; see `mrctl.loop.user_files`.
        hindsight: Whether the best fixed feedforward in hindsight drives, in place of the scenario's.

    Returns:
        The report, with a row of metrics for each lap that was driven to its end, and what a stage of the user answered
        that is not finite; it `ended` with when and why the run failed, or "".

    Raises:
        InputError: The scenario or a stage is invalid, or the folder cannot be written or holds a result already.
    """
    with output_folder(out, () if out is None else _written()):
        stages: Stages = user_files.load(own) if own else {}
        result = best_fixed([scenario]) if hindsight else simulate([scenario], progress=True, **stages)
    return _report(scenario, result, out, as_json, own)


def repeat(folder: Path, out: Path | None, as_json: bool, own: str | None = None) -> tuple[Report, str]:
    """Runs a saved run again, and compares it with what was saved.

    Args:
        folder: What `run` wrote as `out`, or a saved result of one run.
        out: As for `run`.
        as_json: As for `run`.
        own: The stages of the user that drove it; a result holds only their names.

    Returns:
        The report of `run`; and in which signal the run departs from the saved one, or "".

    Raises:
        InputError: There is no result of one run, other stages drove it, or `run` refuses something.
    """
    with output_folder(out, () if out is None else _written()):
        saved = metrics.as_runs(store.open(folder))
        scenarios = scenarios_of(saved)
        if len(scenarios) != 1:
            raise InputError(f"{folder}: holds {len(scenarios)} runs; mrctl run repeats a single one")
        stages: Stages = user_files.load(own) if own else {}
        expect_stages(stages, json.loads(saved.attrs.get("stages", "{}")), folder)
        result = simulate(scenarios, progress=True, **stages)
    return _report(scenarios[0], result, out, as_json, own), departure(result, saved)


def _report(scenario: Scenario, result: xr.Dataset, out: Path | None, as_json: bool, own: str | None) -> Report:
    """Returns what `run` returns."""
    laps, run = metrics.per_lap(result), result.isel(run=0)
    reason = str(run["failure"].values)
    failure = f"after {float(run['failure_time']):.2f} s: {reason}" if reason else ""
    text = (_as_json if as_json else _as_text)(scenario, run, laps.isel(run=0), own, failure)
    return Report(text, failure, partial(_save, result, laps, out), result)


def _as_json(scenario: Scenario, run: xr.Dataset, laps: xr.Dataset, own: str | None, failure: str) -> str:
    """Returns the report as JSON; the arguments are those of `_as_text`."""
    values = {
        "scenario": scenario.model_dump(mode="json"),
        "controller": own,
        "versions": versions(),
        "failed": bool(failure),
        "failure": str(run["failure"].values),
        "failure_time": float(run["failure_time"]),  # NaN if it did not fail
        "laps": [{name: float(laps[name].values[k]) for name in metrics.METRICS} for k in range(laps.sizes["lap"])],
        "faults": faults_of(run),
        "guard": metrics.guard_events(run).drop(columns="run").to_dict("records"),
        "retuned": _retuned(run),
        "feedforward_limited": _limited(run),
        "notes": _notes(scenario, run),
    }
    return json_text(values)


def _as_text(scenario: Scenario, run: xr.Dataset, laps: xr.Dataset, own: str | None, failure: str) -> str:
    """Returns the report as text.

    Args:
        scenario: The run.
        run: Its result.
        laps: Its metrics, lap by lap.
        own: Stages of the user, or None.
        failure: When and why it failed, or "".
    """
    name = str(run["feedforward"].values) + (f", own stages {own}" if own else "")
    course = scenario.reference
    lines = [
        f"RMSE per lap against the reference ({course.kind}, {course.period:.3g} s a lap); feedforward {name}, "
        f"steering {run['steering'].values}"
    ]
    lines += [f"failed {failure}"] if failure else []
    lines += faults_of(run) + _limited(run) + _notes(scenario, run)
    rows = [
        [str(k + 1), *(_cell(name, scale * float(laps[name].values[k])) for name, (_, scale) in COLUMNS.items())]
        for k in np.flatnonzero(np.isfinite(laps["position_rmse"].values))
    ]
    if rows:
        lines.append(markdown(["lap", *(title for title, _ in COLUMNS.values())], rows))
    for _, time, action, why in metrics.guard_events(run).itertuples(index=False):
        lines.append(f"guard at {time:.2f} s: {action}, {why}".removesuffix(", "))
    return "\n".join(lines + _retuned(run))


def _cell(name: str, value: float) -> str:
    """Returns a metric as text; what is counted is a whole number."""
    return f"{value:.0f}" if name == "guard_actions" else number(value)


def _notes(scenario: Scenario, run: xr.Dataset) -> list[str]:
    """Says what a user may not have meant: an event or a goal without effect, and what kept a learner from learning."""
    return _unreached(scenario, run) + _taken_back(scenario, run) + _slipped(scenario, run)


def _taken_back(scenario: Scenario, run: xr.Dataset) -> list[str]:
    """Says which differences of the plant an event takes back as it brings others, because it replaces them all."""
    plain, before, lines = Perturbation(), scenario.perturbation, []
    end = float(run["time"].where(np.isfinite(run["x"])).max())
    for event in scenario.schedule:
        if (now := event.perturbation) is None or not event.time <= end:
            continue
        names = [
            name for name in Perturbation.model_fields
            if getattr(before, name) != getattr(now, name) == getattr(plain, name)
            and not (name.startswith("payload_") and now.payload == 0)
        ]  # fmt: skip
        if names and now != plain:
            back = ", ".join(f"{name} goes back to {getattr(plain, name):g}" for name in names)
            lines.append(f"event at {event.time:g} s: {back}")
        before = now
    return lines


def _slipped(scenario: Scenario, run: xr.Dataset) -> list[str]:
    """Says for how long slip kept a learner of mrctl from learning, if that was more than half of the run."""
    learns = scenario.learner not in ("none", *MODEL_BASED)
    if not learns or "feedforward" in json.loads(run.attrs.get("stages", "{}")):
        return []
    drove = np.isfinite(run["x"].values)
    slips = drove & ~(run["slip"].values <= MAX_LEARNING_SLIP)
    if 2 * slips.sum() <= drove.sum():
        return []
    period = scenario.control_period
    times = f"{period * slips.sum():.3g} of {period * drove.sum():.3g} s"
    return [f"nothing was learned for {times}: slip above {MAX_LEARNING_SLIP:g}"]


def _retuned(run: xr.Dataset) -> list[str]:
    """Says when the controllers were slowed down, because the PID oscillated."""
    moves, time = np.nan_to_num(run["retunes"].values), run["time"].values
    return [
        f"oscillation at {time[k]:.2f} s: slower {'motion controller' if moves[k] % 2 else 'PID'} from now on"
        for k in np.flatnonzero(np.diff(moves, prepend=0.0) > 0)
    ]


def _limited(run: xr.Dataset) -> list[str]:
    """Says for how long the guard limited the feedforward, which is not counted as saturation."""
    beyond = run["feedforward_limited"].values == 1
    if not beyond.any():
        return []
    time, first = run.attrs["control_period"] * beyond.sum(), float(run["time"][beyond.argmax()])
    bound = "the supply" + " or the largest yaw rate" * (run["steering"].item() == "rigid")
    return [f"feedforward beyond {bound} for {time:.2f} s, from {first:.2f} s on: the guard limited it to {bound}"]


def _unreached(scenario: Scenario, run: xr.Dataset) -> list[str]:
    """Says which events of a scenario come after its end, and whether the robot stands at the goal, if it has one."""
    period, end = scenario.control_period, scenario.ticks * scenario.control_period
    last = run.dropna("time", subset=["x"]).isel(time=slice(-1, None))
    stands = []
    if scenario.goal is not None and last.sizes["time"]:
        pose = np.stack([last[name].values for name in ("x", "y", "theta")], axis=-1)
        there = arrived(pose, last["v"].values, np.array(scenario.goal))[0]
        stands = [f"goal: {'reached' if there else 'not reached'}, {float(last['time'][0]):.2f} s"]
        end = end if run["failure"].item() else float(last["time"][0]) + period  # a run ends where it arrives
    late = [one.time for one in scenario.events if one.time >= end]
    return [f"event at {time:g} s: after the end of the run at {end:g} s" for time in late] + stands


def _written() -> list[str]:
    from mrctl.results import plots  # imported here because a run that draws nothing needs no matplotlib

    return ["result.zarr", LEARNED, *(file for name in FIGURES for file in plots.files(name))]


def _save(result: xr.Dataset, laps: xr.Dataset, out: Path | None) -> None:
    """Writes the result, what was learned and the figures to a folder, if there is one."""
    if out is None:
        return
    save(result, out / "result.zarr")
    save_if_learned(out / LEARNED, result)
    from mrctl.results import plots

    for name, function in FIGURES.items():
        plots.save(getattr(plots, function)(laps if name == "learning" else result), out, name)
