"""`mrctl suite`: drives every feedforward through every case with paired seeds, and writes tables and a report."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping, Sequence
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from mrctl.experiments import report
from mrctl.experiments.cases import (
    FLOOR,
    HALF,
    HINDSIGHT,
    MUCH_WORSE,
    NO_WORSE,
    PARTS,
    RECOVERED_RATIO,
    SUITE_SEEDS,
    UNCHANGED,
    Case,
    Choices,
    Entry,
    Laps,
    Mode,
    Outcome,
    by_name,
    cases,
)
from mrctl.experiments.suite_tables import COLUMNS, WINDOWS, YARDSTICKS, tables, titled
from mrctl.experiments.tables import MIN_PAIRS, machine, output_folder, write_json
from mrctl.kernel import Array
from mrctl.loop.groups import cores
from mrctl.loop.hindsight import REPETITIONS
from mrctl.loop.runs import simulate
from mrctl.record import InputError
from mrctl.results import metrics
from mrctl.results.comparison import TIE, cvar, mean_interval, paired_ratio, superiority, wilson
from mrctl.results.dataset import versions
from mrctl.scenario import Scenario, replicates
from mrctl.sweep import jobs, store
from mrctl.sweep.plan import Sweep
from mrctl.sweep.store import Store
from mrctl.theory.references import Circle

Errors = Mapping[str, Mapping[str, Array]]
RUNS_PER_JOB = 40  # runs in a job: enough for a fast batch, and few enough that no worker idles for long at the end
# s for the start of a feedforward's workers, and for a row of the tables; measured
START_SECONDS, ROW_SECONDS = 3.0, 0.15


def suite(
    mode: Mode,
    feedforwards: Sequence[Entry],
    controllers: Sequence[str],
    seeds: int,
    random: int,
    workers: int | None,
    out: Path,
) -> Outcome:
    """Drives the runs of the suite that are not done yet; writes `table.md`, `table.json`, figures and `report.html`.

    Args:
        mode: Size of the suite; see `cases`.
        feedforwards: Names of the feedforwards to compare; `hindsight` is the best fixed one for each run.
        controllers: Controllers of the user, as for `by_name`.
        seeds: Number of replicates of each case, which are the same for every feedforward.
        random: Number of random scenarios.
        workers: Number of processes; by default one for each core.
        out: Folder for the results; its folder `runs` holds a store for each feedforward.

    Returns:
        The results.

    Raises:
        InputError: There is no feedforward or no seed, a controller is bad, or the folder cannot be written or holds
            other runs.
    """
    if not (feedforwards or controllers):
        raise InputError("feedforward: the suite needs at least one, or a controller")
    for name, count, least in (("seeds", seeds, 1), ("random", random, 0)):
        if count < least:
            raise InputError(f"{name}: {count} is below {least}")
        if count > len(SUITE_SEEDS):
            most = f"{len(SUITE_SEEDS):,}"
            raise InputError(f"{name}: the suite has the first {most} seeds; the others are for tuning and held out")
    choices = by_name(feedforwards, controllers)
    with output_folder(out):
        chosen = cases(mode, seeds, random)
        laps, aside = run(chosen, choices, workers, out / "runs")
    runs = runs_of(chosen, laps)
    rows = compare(chosen, runs)
    outcome = Outcome(mode, chosen, laps, runs, rows, aside)
    shown = tables(rows, mode)
    (out / "table.md").write_text("\n".join(one.markdown for one in shown), "utf-8")
    found = {"versions": versions(), "machine": machine(), "mode": mode, "controllers": report.controllers(choices)}
    write_json(out / "table.json", found | {"rows": rows, "runs": each_run(runs)})
    report.write(outcome, choices, shown, out)
    return outcome


def run(chosen: Sequence[Case], choices: Choices, workers: int | None, out: Path) -> tuple[Laps, str]:
    """Drives every case with every feedforward, unless that is done already; each feedforward has its own store.

    Before it starts, it prints how long that will take.

    Returns:
        Metrics lap by lap, by feedforward; and a sentence on the runs that could not be done, or "".
    """
    print(expectation(chosen, choices, workers or cores(), out), file=sys.stderr, flush=True)
    laps, aside = {}, []
    for place, (name, choice) in enumerate(choices.items(), 1):
        scenarios = [s.model_copy(update=choice.pair) for case in chosen for s in case.scenarios]
        chunk = min(RUNS_PER_JOB, -(-len(scenarios) // 4))
        own = {"controller": choice.controller, "hindsight": name == HINDSIGHT}
        sweep = Sweep.of(scenarios, record="laps", chunk=chunk, **own)
        print(f"{name} ({place} of {len(choices)})", file=sys.stderr)
        ended = jobs.run(sweep, out / name, workers, progress=True)
        laps[name] = store.open(out / name)
        if ended.aside:
            lost, why = sum(map(len, ended.aside)), next(iter(ended.aside.values()))
            aside.append(f"{lost} runs of {name} could not be done ({why})")
    return laps, "; ".join(aside)


def expectation(chosen: Sequence[Case], choices: Choices, workers: int, out: Path) -> str:
    """Returns a sentence on how long the remaining runs will take, from a short drive on this machine."""
    scenarios = [s for case in chosen for s in case.scenarios]
    usual = Scenario().physics_step
    seconds = sum(s.duration * usual / s.physics_step for s in scenarios)
    shares = {name: left(out / name) for name in choices}
    drives = sum((1 + REPETITIONS if name == HINDSIGHT else 1) * share for name, share in shares.items())
    wait = drives * seconds / pace() / workers + START_SECONDS * sum(share > 0 for share in shares.values())
    wait += ROW_SECONDS * len(chosen) * len(choices)
    done = 1 - sum(shares.values()) / len(shares)
    return (
        f"{len(scenarios) * len(choices):,} runs, {done:.0%} of them done; "
        f"about {max(wait / 60, 1):.0f} min with {workers} worker{'s' * (workers > 1)}"
    )


def left(path: Path) -> float:
    """Returns the share of the jobs of a store that are not done yet; 1 if there is no store."""
    try:
        kept = Store(path)
    except InputError:
        return 1.0
    return 1 - len(kept.done()) / kept.jobs


def pace() -> float:
    """Measures the simulated seconds that one core drives in a second, metrics included, on a short drive."""
    batch = replicates(Scenario(laps=1, reference=Circle(period=4.0, radius=0.5), prior="model"), RUNS_PER_JOB)
    metrics.per_lap(simulate(batch[:1], threads=1))  # compiles or loads the kernels
    began = time.perf_counter()
    metrics.per_lap(simulate(batch, threads=1))
    return sum(s.duration for s in batch) / (time.perf_counter() - began)


def runs_of(chosen: Sequence[Case], laps: Laps) -> dict[str, Laps]:
    """Returns the runs of each case, by feedforward; the laps of a run that could not be done are NaN."""
    found: dict[str, Laps] = {}
    end = 0
    for case in chosen:
        start, end, count = end, end + len(case.scenarios), case.scenarios[0].laps
        number, counts = np.arange(1, count + 1), ("run", [count] * len(case.scenarios))
        own = {name: one.isel(run=slice(start, end)).reindex(lap=number) for name, one in laps.items()}
        found[case.name] = {name: one.assign(laps=counts) for name, one in own.items()}
    return found


def compare(chosen: Sequence[Case], found: Mapping[str, Laps]) -> list[dict[str, Any]]:
    """Computes the statistics of the tables: a row for each case and feedforward, in the order of `PARTS`.

    A row holds for lap 1, all laps and the last lap: the mean with its 95 % confidence interval; the floor; the mean
    difference from PID and from `model` in the same run; and the probability of beating each of the others in the same
    run, where two errors are a tie if they differ by no more than `Floor.tie`. In `random`, where one world
    would dominate a mean, medians replace the means. For the last lap a row also holds the mean of the worst 5 %
    (infinite where a run failed) and the ratios to PID and to `model`. `excess` is the error beyond that of the last
    lap (after a step: of the lap before the return), integrated from the start or the step on; it has no meaning where
    the course changes. Where nothing changes during a run, a row holds the number of laps until the error stays within
    `RECOVERED_RATIO` times its final value; for a step it holds what `_step` returns.
    """
    pairs = [(found[plant], found[plant + HALF]) for plant in FLOOR if {plant, plant + HALF} <= found.keys()]
    limits = {metric: floors(pairs, metric) for metric in COLUMNS}
    rows = []
    for case in sorted(chosen, key=lambda case: [*PARTS].index(case.part)):
        ends = found[case.name]
        errors = {metric: {name: windows(own, metric) for name, own in ends.items()} for metric in COLUMNS}
        rows += [_row(case, name, ends, errors, limits) for name in ends]
    return rows


def _row(
    case: Case, name: str, ends: Laps, errors: Mapping[str, Errors], limits: Mapping[str, Mapping[str, Floor]]
) -> dict[str, Any]:
    """Computes the row of a feedforward in a case; `errors` and `limits` are those of `_statistics` by metric."""
    own, lost = ends[name], ends[name]["failed"].values.astype(bool)
    row: dict[str, Any] = {"part": case.part, "case": case.name, "feedforward": name}
    row |= {"runs": len(lost), "failed": int(lost.sum())}
    row["guard_events"] = float(own["guard_actions"].sum("lap", skipna=False).mean())  # of the runs that finished
    if "none" in ends:
        row["failed_where_pid_did_not"] = int((lost & ~ends["none"]["failed"].values.astype(bool)).sum())
    for metric in COLUMNS:
        row[metric] = _statistics(case, name, own, metric, errors[metric], limits[metric])
    return row


def _statistics(
    case: Case, name: str, own: xr.Dataset, metric: str, errors: Errors, limits: Mapping[str, Floor]
) -> dict[str, Any]:
    """Computes the statistics of one metric of a row.

    Args:
        case: The case.
        name: Name of the feedforward.
        own: The runs of this feedforward, lap by lap.
        metric: Name of the metric.
        errors: What `windows` returns, by feedforward.
        limits: The floors of the metric by window.
    """
    found: dict[str, Any] = {
        window: standing(name, {one: e[window] for one, e in errors.items()}, floor, case.part == "random")
        for window, floor in limits.items()
    }
    found |= found.pop("last")
    last = {one: e["last"] for one, e in errors.items()}
    if case.part == "random" and "none" in last and name != "none":
        found["no_worse"] = no_worse(last[name], last["none"])
    found["worst"] = cvar(last[name])
    for rival in YARDSTICKS:
        if rival in last and rival != name:
            found[f"to_{titled(rival)}"] = paired_ratio(last[name], last[rival])._asdict()
    if not any(event.reference for event in case.scenarios[0].events):
        until = case.back - 1 if case.back else case.scenarios[0].laps
        integral = metrics.excess(own, metric, case.change or 1, until).values
        found["excess"] = mean_interval(integral)._asdict()
    if case.part in UNCHANGED:
        laps = metrics.laps_to_converge(own, metric, RECOVERED_RATIO).values
        found["laps_to_converge"] = mean_interval(laps)._asdict()
    if case.back:
        found |= _step(own, metric, case)
    return found


def windows(laps: xr.Dataset, metric: str) -> dict[str, Array]:
    """Returns the errors of each run in lap 1, over all laps (RMS), and in the last lap; NaN if the run failed."""
    error = laps[metric].transpose("run", "lap").values
    return {"first": error[:, 0], "all": np.sqrt(np.mean(error**2, axis=1)), "last": error[:, -1]}


def standing(name: str, errors: Mapping[str, Array], floor: Floor, median: bool) -> dict[str, Any]:
    """Returns the mean or median of one feedforward in a case, and compares it with the others in the same runs."""
    found: dict[str, Any] = mean_interval(errors[name], median=median)._asdict() | {"floor": floor._asdict()}
    for rival, theirs in errors.items():
        if rival != name:
            beaten = superiority(errors[name], theirs, floor=floor.tie)
            found[f"beats_{titled(rival)}"] = beaten._asdict()
            if rival in YARDSTICKS:
                paired = (errors[name] - theirs)[np.isfinite(errors[name] - theirs)]
                centre = np.median if median else np.mean
                found[f"less_{titled(rival)}"] = float(centre(paired)) if len(paired) else np.nan
    return found


def no_worse(error: Array, pid: Array) -> dict[str, float | int]:
    """Returns the share of runs whose error is at most `NO_WORSE` times that of PID alone, with Wilson's 95 % interval.

    With it come the 99 % quantile of that ratio, and the number of runs in which it is above `MUCH_WORSE`. The ratio of
    a failed run, whose error is NaN, is infinite, and 0 where PID alone failed.
    """
    ratio = np.where(np.isnan(pid), 0.0, np.where(np.isnan(error), np.inf, error) / pid)
    share = float(np.mean(ratio <= NO_WORSE))
    low, high = wilson(share, len(ratio))
    quantile = float(np.quantile(ratio, 0.99, method="higher"))
    return {"value": share, "low": low, "high": high, "quantile_99": quantile, "much": int((ratio > MUCH_WORSE).sum())}


class Floor(NamedTuple):
    """Differences that the integrator does not resolve."""

    mean: float
    """Largest change of a mean when the physics step is halved."""
    difference: float
    """Largest change of a difference between two means, in which a change that all means share cancels."""
    tie: float
    """Largest difference of two errors in a run that counts as a tie: at least `difference`, and so much that the
    paired test finds no change of any difference when the step is halved. So few runs that the test could find none
    have the `TIE` of `mrctl.results.comparison`."""


def floors(pairs: Sequence[tuple[Laps, Laps]], metric: str) -> dict[str, Floor]:
    """Returns the floors of lap 1, of all laps and of the last lap.

    Args:
        pairs: The same runs with the physics step and with half of it, by feedforward; a feedforward that lost a run
            does not count.
        metric: Name of the metric.

    Returns:
        The largest over the pairs; 0 without any.
    """
    found = {window: Floor(0.0, 0.0, 0.0) for window in WINDOWS}
    for whole, half in pairs:
        fine = [name for name in whole if not (whole[name]["failed"].any() or half[name]["failed"].any())]
        before, after = ({name: windows(one[name], metric) for name in fine} for one in (whole, half))
        for window, floor in found.items():
            if changes := [after[name][window] - before[name][window] for name in fine]:
                means = np.mean(changes, axis=1)
                difference = max(floor.difference, float(np.ptp(means)))
                ties = [unnoticed(one - other) for one, other in combinations(changes, 2)]
                ties += [TIE[metric]] if len(changes[0]) < MIN_PAIRS else []
                mean = max(floor.mean, float(np.abs(means).max()))
                found[window] = Floor(mean, difference, max(floor.tie, difference, *ties))
    return found


def unnoticed(change: Array) -> float:
    """Returns the least tie from which on the paired test does not tell numbers `(n,)`, one a run, from zero."""
    ties = np.append(0.0, np.sort(np.abs(change)))
    for least, tie in pairwise(ties[::-1]):
        test = superiority(change, np.zeros_like(change), floor=tie)
        if not test.low <= 0.5 <= test.high:
            return float(least)
    return 0.0


def _step(laps: xr.Dataset, metric: str, case: Case) -> dict[str, Any]:
    """Measures recovery and forgetting: errors over that before the change, run by run, and the settled error."""
    error = laps[metric].values
    before, settled = error[:, case.change - 2], error[:, case.back - 2]
    after = {"in_first_lap": case.change, "after_one_lap": case.change + 1}
    after |= {"return_first_lap": case.back, "return_after_one_lap": case.back + 1}
    found: dict[str, Any] = {name: paired_ratio(error[:, lap - 1], before)._asdict() for name, lap in after.items()}
    needed = metrics.recovery_laps(laps, metric, case.change, case.back - 1, RECOVERED_RATIO).values
    worst = {f"{name}_worst": cvar(error[:, lap - 1] / before) for name, lap in after.items()}
    found["after_one_lap_to_settled"] = paired_ratio(error[:, case.change], settled)._asdict()
    found["during"] = mean_interval(settled)._asdict()
    return found | worst | {"recovery_laps": needed.tolist(), "recovered_within_one_lap": float(np.mean(needed <= 1))}


def each_run(found: Mapping[str, Laps]) -> list[dict[str, Any]]:
    """Lists how each run ended, and its errors lap by lap: a row for each run, for the user's own statistics."""
    rows = []
    for case, runs in found.items():
        for name, own in runs.items():
            reasons = zip(own["failure"].values, own["failure_time"].values, strict=True)
            for k, (reason, when) in enumerate(reasons):
                row = {"case": case, "feedforward": name, "seed": int(own["seed"][k]), "run": int(own["run"][k])}
                row |= {"failure": reason, "failure_time": float(when) if reason else None}
                rows.append(row | {metric: own[metric].values[k].tolist() for metric in COLUMNS})
    return rows
