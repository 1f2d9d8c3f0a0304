"""`mrctl suite`: every feedforward over every case, with paired seeds; tables, figures and a report of it."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import NDArray

from mrctl.experiments import report
from mrctl.experiments.cases import BAND, FLOOR, HINDSIGHT, PARTS, REFERENCES, Case, Choices, Laps, Outcome, cases
from mrctl.experiments.hindsight import best_fixed
from mrctl.experiments.tables import machine, markdown, number, output_folder, write_json
from mrctl.loop import user_files
from mrctl.record import InputError
from mrctl.results import metrics
from mrctl.results.comparison import bootstrap_interval, cvar, paired_ratio, superiority
from mrctl.results.dataset import versions
from mrctl.scenario import FEEDFORWARDS, FeedforwardName, Scenario
from mrctl.sweep import jobs, store
from mrctl.sweep.plan import Sweep

Entry = FeedforwardName | Literal["hindsight"]
COLUMNS = {"v_rmse": "V, mm/s", "omega_rmse": "θ̇, mrad/s", "position_rmse": "position, mm"}
TITLES = {"none": "PID"}  # names of feedforwards in the tables, where they differ
YARDSTICKS = ("none", "model")  # feedforwards that the tables compare all others with
LEADING = {
    "V": ("v_rmse", "last"),
    "θ̇": ("omega_rmse", "last"),
    "position": ("position_rmse", "last"),
    "position in lap 1": ("position_rmse", "first"),
    "position in all laps": ("position_rmse", "all"),
}
UNCHANGED = ("steady", "steering")  # parts in whose runs nothing changes from the first lap to the last
CHUNK = 32  # runs in a job: enough for a fast batch, and few enough that no worker idles for long at the end


def suite(
    feedforwards: Sequence[Entry],
    controllers: Sequence[str],
    seeds: int,
    random: int,
    quick: bool,
    workers: int | None,
    out: Path,
) -> Outcome:
    """Runs those runs of the suite that are not done yet; writes `table.md`, `table.json`, figures and `report.html`.

    Args:
        feedforwards: Names of the feedforwards to compare; `hindsight` is the best fixed one for each run.
        controllers: Feedforwards of the user, each as `my_file.py:MyController`; see `mrctl.loop.user_files`.
        seeds: Number of replicates of each case; every feedforward drives the same.
        random: Number of random scenarios.
        quick: Whether to run a selection of the cases with fewer laps.
        workers: Number of processes; by default one for each core.
        out: Folder for the results; the runs of each feedforward are a store under `runs` in it.

    Returns:
        What was run and measured.

    Raises:
        InputError: There is no feedforward or no seed, a controller is bad, or the folder cannot be written or holds
            other runs.
    """
    if seeds < 1 or random < 0 or not (feedforwards or controllers):
        raise InputError("seeds: the suite needs at least one run of at least one feedforward")
    choices: dict[str, dict[str, Any]] = {name: {"feedforward": name} for name in feedforwards}
    for stages in controllers:
        name = "+".join(part.title for part in user_files.parts(stages))
        if name in choices:
            raise InputError(f"controller: the name {name} is taken")
        choices[name] = {"controller": user_files.absolute(stages)}
        user_files.trial(choices[name]["controller"], Scenario(laps=1))
    output_folder(out)
    chosen = cases(seeds, random, quick)
    laps, aside = run(chosen, choices, workers, out / "runs")
    runs = runs_of(chosen, laps)
    rows = compare(chosen, runs)
    outcome = Outcome(quick, chosen, laps, runs, rows, aside)
    shown = tables(rows)
    texts = [f"## {title}\n\n{markdown(list(table), table.to_numpy().tolist())}\n" for title, table in shown.items()]
    (out / "table.md").write_text("\n".join(texts))
    write_json(out / "table.json", {"versions": versions(), "machine": machine(), "rows": rows, "runs": each_run(runs)})
    report.write(outcome, choices, shown, out)
    return outcome


def run(chosen: Sequence[Case], choices: Choices, workers: int | None, out: Path) -> tuple[Laps, str]:
    """Runs every case under every feedforward, as far as it is not done yet; each feedforward has a store of its own.

    Returns:
        Metrics lap by lap, by feedforward; and a sentence on the runs that could not be done, or "".
    """
    laps, aside = {}, []
    for place, (name, choice) in enumerate(choices.items(), 1):
        fields = FEEDFORWARDS[choice["feedforward"] if choice.get("feedforward") in FEEDFORWARDS else "none"]
        work = partial(jobs.compute, drive=best_fixed) if name == HINDSIGHT else None
        scenarios = [s.model_copy(update=fields) for case in chosen for s in case.scenarios]
        chunk = min(CHUNK, -(-len(scenarios) // 4))
        sweep = Sweep.of(scenarios, record="laps", chunk=chunk, controller=choice.get("controller"))
        print(f"{name} ({place} of {len(choices)})", file=sys.stderr)
        ended = jobs.run(sweep, out / name, workers, progress=True, work=work)
        laps[name] = store.open(out / name)
        if ended.aside:
            lost, why = sum(map(len, ended.aside)), next(iter(ended.aside.values()))
            aside.append(f"{lost} runs of {name} could not be done ({why})")
    return laps, "; ".join(aside)


def runs_of(chosen: Sequence[Case], laps: Laps) -> dict[str, Laps]:
    """The runs of each case, by feedforward; the laps of a run that could not be done are NaN."""
    found: dict[str, Laps] = {}
    end = 0
    for case in chosen:
        start, end, count = end, end + len(case.scenarios), case.scenarios[0].laps
        number, counts = np.arange(1, count + 1), ("run", [count] * len(case.scenarios))
        own = {name: one.isel(run=slice(start, end)).reindex(lap=number) for name, one in laps.items()}
        found[case.name] = {name: one.assign(laps=counts) for name, one in own.items()}
    return found


def compare(chosen: Sequence[Case], found: Mapping[str, Laps]) -> list[dict[str, Any]]:
    """Statistics that the tables show: a row for each case and feedforward, in the order of `PARTS`.

    A row holds for the last lap the mean with its 95 % bootstrap interval, the mean of the worst 5 % (infinite where a
    run failed), the ratio to PID and to `model`, and the probability of beating each of the others in the same run; for
    lap 1 and for all laps together it holds the mean and the probabilities. Two errors that differ by less than the
    floor are a tie: see `floors`. `excess` is the error beyond that of the last lap (after a step: of the lap before
    the return), integrated from the start or the step on. Where nothing changes on the way, a row holds the laps until
    the error stays within `BAND` times its final value; for a step it holds what `_step` returns.
    """
    rows, floor = [], floors(found)
    for case in sorted(chosen, key=lambda case: [*PARTS].index(case.part)):
        ends = {name: metrics.summary(own) for name, own in found[case.name].items()}
        for name, own in ends.items():
            failed = own["failed"].to_numpy(bool)
            row: dict[str, Any] = {"part": case.part, "case": case.name, "feedforward": name}
            row |= {"runs": len(own), "failed": int(failed.sum())}
            if "guard_actions" in metrics.METRICS:
                row["guard_events"] = float(found[case.name][name]["guard_actions"].sum("lap").mean())
            if "none" in ends:
                row["failed_where_pid_did_not"] = int((failed & ~ends["none"]["failed"].to_numpy(bool)).sum())
            for metric in COLUMNS:
                samples = own[metric].to_numpy(float)
                row[metric] = {"floor": floor[metric], "worst": cvar(samples)}
                for window, select in WINDOWS.items():
                    mine = select(found[case.name][name], metric)
                    stated = bootstrap_interval(mine)._asdict()
                    for rival in (one for one in ends if one != name):
                        theirs = select(found[case.name][rival], metric)
                        beaten = superiority(mine, theirs, floor=floor[metric])
                        stated[f"beats_{TITLES.get(rival, rival)}"] = beaten._asdict()
                    row[metric] |= stated if window == "last" else {window: stated}
                for rival in YARDSTICKS:
                    if rival in ends and rival != name:
                        ratio = paired_ratio(samples, ends[rival][metric].to_numpy(float))
                        row[metric][f"to_{TITLES.get(rival, rival)}"] = ratio._asdict()
                until = case.back - 1 if case.back else case.scenarios[0].laps
                integral = metrics.excess(found[case.name][name], metric, case.change or 1, until).values
                row[metric]["excess"] = bootstrap_interval(integral)._asdict()
                if case.part in UNCHANGED:
                    laps = metrics.laps_to_converge(found[case.name][name], metric, BAND).values
                    row[metric]["laps_to_converge"] = bootstrap_interval(laps)._asdict()
                if case.back:
                    row[metric] |= _step(found[case.name][name], metric, case)
            rows.append(row)
    return rows


def floors(found: Mapping[str, Laps]) -> dict[str, float]:
    """What the integrator does not resolve: the largest change of a mean when the physics step is halved.

    Returns:
        For each metric the largest over the plants of `FLOOR` and all feedforwards that lost no run; 0 without such
        cases.
    """
    found_floors = dict.fromkeys(COLUMNS, 0.0)
    for plant in FLOOR:
        whole, half = found.get(plant, {}), found.get(f"{plant}, half the step", {})
        for metric in COLUMNS:
            moved = [abs(float(np.mean(last_lap(half[n], metric) - last_lap(whole[n], metric)))) for n in half]
            found_floors[metric] = max([found_floors[metric], *(m for m in moved if np.isfinite(m))])
    return found_floors


def last_lap(laps: xr.Dataset, metric: str) -> NDArray[np.float64]:
    """The metric in the last lap of each run, NaN where it failed."""
    return metrics.summary(laps)[metric].to_numpy(float)


def first_lap(laps: xr.Dataset, metric: str) -> NDArray[np.float64]:
    """The metric in the first lap of each run."""
    return metrics.summary(laps, 1)[metric].to_numpy(float)


def all_laps(laps: xr.Dataset, metric: str) -> NDArray[np.float64]:
    """The root mean square over all laps of each run, NaN where it failed."""
    return metrics.over_laps(laps, metric).values


WINDOWS = {"first": first_lap, "all": all_laps, "last": last_lap}


def _step(laps: xr.Dataset, metric: str, case: Case) -> dict[str, Any]:
    """Recovery and forgetting: errors run by run over that in the lap before the change, and the error that settles."""
    error = laps[metric].values
    before, settled = error[:, case.change - 2], error[:, case.back - 2]
    after = {"in_first_lap": case.change, "after_one_lap": case.change + 1}
    after |= {"return_first_lap": case.back, "return_after_one_lap": case.back + 1}
    found: dict[str, Any] = {name: paired_ratio(error[:, lap - 1], before)._asdict() for name, lap in after.items()}
    needed = metrics.recovery_laps(laps, metric, case.change, case.back - 1, BAND).values
    worst = {f"{name}_worst": cvar(error[:, lap - 1] / before) for name, lap in after.items()}
    found["after_one_lap_to_settled"] = paired_ratio(error[:, case.change], settled)._asdict()
    found["during"] = bootstrap_interval(settled)._asdict()
    return found | worst | {"recovery_laps": needed.tolist(), "recovered_within_one_lap": float(np.mean(needed <= 1))}


def each_run(found: Mapping[str, Laps]) -> list[dict[str, Any]]:
    """How each run ended, and its errors lap by lap: a row for each run, for statistics of the user."""
    rows = []
    for case, runs in found.items():
        for name, own in runs.items():
            reasons = zip(own["failure"].values, own["failure_time"].values, strict=True)
            for k, (reason, time) in enumerate(reasons):
                row = {"case": case, "feedforward": name, "seed": int(own["seed"][k]), "run": int(own["run"][k])}
                row |= {"failure": reason, "failure_time": float(time) if reason else None}
                rows.append(row | {metric: own[metric].values[k].tolist() for metric in COLUMNS})
    return rows


def tables(rows: Sequence[dict[str, Any]]) -> dict[str, pd.DataFrame]:
    """Tables of text by title: the last lap of each part, who is best, then the recovery after the steps."""
    found = {}
    guarded = any("guard_events" in row for row in rows)
    header = ["case", "feedforward", "failed", *(f"{title}; worst 5 %" for title in COLUMNS.values())]
    header += ["beats PID in V / θ̇ / position", "beats model", *(["guard acted"] if guarded else [])]
    for part, title in PARTS.items():
        own = [row for row in rows if row["part"] == part]
        unchanged = part in UNCHANGED
        cells = [
            [
                row["case"], row["feedforward"], f"{row['failed']}/{row['runs']}", *(_mean(row[m]) for m in COLUMNS),
                *(_wins(row, TITLES.get(one, one)) for one in YARDSTICKS),
                *([number(row["guard_events"])] if guarded else []), *([_converged(row)] if unchanged else []),
            ]
            for row in own
        ]  # fmt: skip
        if own:
            laps = [f"laps to {BAND:g}× the final V / θ̇ / position"] if unchanged else []
            found[title] = pd.DataFrame(cells, columns=[*header, *laps])
    found["Position error in mm: lap 1, all laps, last lap"] = windows(rows)
    if any(row["feedforward"] not in REFERENCES for row in rows):
        best = pd.DataFrame(leaders(rows), columns=["case", *LEADING])
        found["Best in each case, and who is level with it"] = best
    header = ["case", "feedforward", "failed", "first lap", "one lap later; worst 5 %", "recovered in V / θ̇ / position"]
    header += ["one lap later over settled", "return: first lap", "one lap later; worst 5 %"]
    cells = []
    for row in rows:
        if row["part"] == "step":
            error = row["position_rmse"]
            names = ("in_first_lap", "after_one_lap", "return_first_lap", "return_after_one_lap")
            first, later, back, settled = (f"{number(error[name]['value'])}×" for name in names)
            within = " / ".join(f"{100 * row[m]['recovered_within_one_lap']:.0f} %" for m in COLUMNS)
            later, settled = (
                f"{text}; {number(error[f'{name}_worst'])}×" for text, name in ((later, names[1]), (settled, names[3]))
            )
            cells.append([row["case"], row["feedforward"], f"{row['failed']}/{row['runs']}", first, later, within])
            cells[-1] += [f"{number(error['after_one_lap_to_settled']['value'])}×", back, settled]
    if cells:
        title = "Recovery and forgetting: position error over that before the step"
        found[title] = pd.DataFrame(cells, columns=header)
    return found


def leaders(rows: Sequence[dict[str, Any]]) -> list[list[str]]:
    """For each case and column of `LEADING` the feedforward with the least mean, and those that are level with it.

    A feedforward is level if the best does not beat it with 95 % confidence in the same runs. One with a failed run is
    left out, and so are `REFERENCES`, which know the plant.
    """
    lines = []
    for case in dict.fromkeys(row["case"] for row in rows):
        own = {str(r["feedforward"]): r for r in rows if r["case"] == case and r["feedforward"] not in REFERENCES}
        fine = [name for name, row in own.items() if not row["failed"]] or list(own)
        cells = []
        for metric, window in LEADING.values():
            stated = {name: own[name][metric] if window == "last" else own[name][metric][window] for name in fine}
            best, *others = sorted(fine, key=lambda name: float(stated[name]["value"]))
            level = [o for o in others if stated[best][f"beats_{TITLES.get(o, o)}"]["low"] <= 0.5]
            cells.append(", ".join(TITLES.get(name, name) for name in (best, *level)))
        lines.append([case, *cells])
    return lines


def windows(rows: Sequence[dict[str, Any]]) -> pd.DataFrame:
    """The position error of each case and feedforward in lap 1, all laps and the last lap, and what it costs to learn.

    Regret is the error over all laps less that of `hindsight`, in mm.
    """
    header = ["case", "feedforward", *(f"{title}, mm" for title in ("lap 1", "all laps", "last lap")), "regret, mm"]
    known = {row["case"]: row["position_rmse"]["all"]["value"] for row in rows if row["feedforward"] == HINDSIGHT}
    cells = []
    for row in rows:
        error = row["position_rmse"]
        stated = [_interval(error["first"]), _interval(error["all"]), _interval(error)]
        regret = 1e3 * (error["all"]["value"] - known.get(row["case"], np.nan))
        cells.append([row["case"], row["feedforward"], *stated, f"{regret:.2f}" if np.isfinite(regret) else ""])
        cells[-1].append(f"{1e3 * error['excess']['value']:.1f}" if error["excess"]["samples"] else "–")
    floor = max((1e3 * row["position_rmse"]["floor"] for row in rows), default=0.0)
    return pd.DataFrame(cells, columns=[*header, f"excess, mm s (floor of all: {number(floor)} mm)"])


def _interval(error: dict[str, Any]) -> str:
    """A mean in thousandths with its interval, if it has one."""
    if not error["samples"]:
        return "–"
    value, low, high = (1e3 * error[key] for key in ("value", "low", "high"))
    return number(value) + (f" [{number(low)}, {number(high)}]" if high > low else "")


def _mean(error: dict[str, Any]) -> str:
    return f"{_interval(error)}; {number(1e3 * error['worst'])}" if error["samples"] else "–"


def _converged(row: dict[str, Any]) -> str:
    laps = [row[metric]["laps_to_converge"] for metric in COLUMNS]
    return " / ".join(f"{one['value']:.1f}" if one["samples"] else "–" for one in laps)


def _wins(row: dict[str, Any], rival: str) -> str:
    if f"beats_{rival}" not in row["position_rmse"]:
        return ""
    values = [row[metric][f"beats_{rival}"] for metric in COLUMNS]
    last = values[-1]
    return " / ".join(f"{one['value']:.2f}" for one in values) + f" [{last['low']:.2f}, {last['high']:.2f}]"
