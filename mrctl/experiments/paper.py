"""`mrctl reproduce`: the paper's figures in real physics, and the numbers behind them."""

from __future__ import annotations

import math
import time
from collections import defaultdict
from collections.abc import Hashable, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

import pandas as pd
import xarray as xr

from mrctl.control.composite import Composite
from mrctl.control.fel import Fel
from mrctl.control.kanayama import Kanayama
from mrctl.control.l1 import L1
from mrctl.control.observer import Observer
from mrctl.control.pid import Pid
from mrctl.experiments import kanayama
from mrctl.experiments.tables import machine, markdown, number, output_folder, write_json
from mrctl.loop.hindsight import best_fixed
from mrctl.loop.runs import simulate
from mrctl.results import drawings, metrics, plots
from mrctl.results.dataset import versions
from mrctl.scenario import COMPARED, FEEDFORWARDS, FeedforwardName, Scenario, replicates
from mrctl.sensing.tiers import TIERS, Sensing, Tier
from mrctl.theory.perturbation import PERTURBATIONS
from mrctl.theory.references import Lemniscate

CASE = "all"  # plant of the figures, with another mass, supply, drive friction and resistance than the model
LATE_CASE = "delay 20 ms"  # plant whose motors act later than the controllers know
PAPER: tuple[FeedforwardName, ...] = (
    "none", "model", "true_model", "model+observer", "fel", "model+fel", "model+rls", "model+composite",
)  # fmt: skip
FAST, SLOW = 12.0, 20.0  # s a lap
DRAWS = 4  # number of replicates in each sensing tier
MANY_LAPS = 60  # number of laps that shows whether learning stays stable
IDEAL: dict[str, Any] = {
    "sensing": Sensing(tier="ideal"),
    "pid": Pid(time_constant=0.15),
    "kanayama": Kanayama(k_x=3.0, k_y=25.0, k_theta=10.0),
    "prefilter": 0.05,
    "fel": Fel(step=0.1),
    "observer": Observer(time_constant=0.055),
    "composite": Composite(noise=0.07, disturbance=0.15, step=0.025),
}
"""The world of the paper: exact measurements without delay, ideal motors, and a PID that is not tuned to its limit.

Learners and observer have settings for that PID; their defaults are for a PID that is ten times as fast. The samples of
`composite` are exact, so that they have less noise than by default; 0.07 V was chosen on the cases of this benchmark.
"""
REAL: dict[str, dict[str, Any]] = {
    **{name: dict(FEEDFORWARDS[name]) for name in COMPARED},
    "model+observer, 0.06 s": FEEDFORWARDS["model+observer"] | {"observer": Observer(time_constant=0.06)},
    "model+l1, 15 rad/s": FEEDFORWARDS["model+l1"] | {"l1": L1(bandwidth=15.0)},
}
"""What drives in the sensing tiers: the feedforwards with their defaults, and two that react faster by default.

The faster two are more exact where the delay is known, and oscillate for a while where it is longer.
"""
METRICS = ("v_rmse", "omega_rmse", "position_rmse")


def scenario(feedforward: FeedforwardName, case: str, period: float = FAST, **changes: Any) -> Scenario:  # noqa: ANN401
    """Returns a run of the benchmark in the world of the paper: the lemniscate, on the plant of a named perturbation.

    The run has the name of its plant.
    """
    fields: dict[str, Any] = FEEDFORWARDS[feedforward] | {"perturbation": PERTURBATIONS[case]}
    return Scenario(name=case, reference=Lemniscate(period=period), **fields | IDEAL | changes)


def real(tier: Tier) -> list[tuple[str, Scenario]]:
    """Returns runs of eight laps with the sensors and motors of a tier and the controllers designed for it.

    Every feedforward drives the same replicates. A run has the name of its plant.

    Returns:
        The names of the feedforwards in the table, with their runs.
    """
    found = []
    for case in ("nominal", CASE, LATE_CASE):
        for name, feedforward in REAL.items():
            fields = {"sensing": Sensing(tier=tier), "perturbation": PERTURBATIONS[case], **feedforward}
            found += [(name, one) for one in replicates(Scenario(name=case, **fields), DRAWS)]
    return found


def benchmark() -> list[Scenario]:
    """Returns runs of eight laps: every feedforward, fast and slow, and in the other steering arrangements."""
    compliant = [scenario(f, case, period) for period in (FAST, SLOW) for case in ("nominal", CASE) for f in PAPER]
    others = [
        scenario(f, case, steering=steering)
        for steering in ("caster", "rigid")
        for case in ("nominal", CASE)
        for f in PAPER
    ]
    return [*compliant, *others]


def reproduce(out: Path) -> str:
    """Writes figures 2 to 6 of the paper, a learning curve, and `table.json`.

    Args:
        out: Folder to write to.

    Returns:
        The results as Markdown.

    Raises:
        InputError: The folder cannot be written.
    """
    began = time.monotonic()
    with output_folder(out):
        scenarios = benchmark()
        result = simulate(scenarios, progress=True)
    endurance = [scenario("fel", case, laps=MANY_LAPS) for case in ("nominal", CASE)]
    endured = simulate(endurance, progress=True)
    figures(result, scenarios, out)
    lateral = kanayama.table()
    rows, long_rows = compare(summary(result), scenarios), endure(endured, endurance)
    names, tiers = map(list, zip(*(one for tier in TIERS for one in real(tier)), strict=True))
    bound = [one for one in tiers if one.feedforward == "none"]
    found = pd.concat([summary(simulate(tiers, progress=True)), summary(best_fixed(bound))])
    tier_rows = compare(found, [*tiers, *bound])
    for row, name in zip(tier_rows, [*names, *["hindsight"] * len(bound)], strict=True):
        row["feedforward"] = name
    write_json(
        out / "table.json",
        {
            "versions": versions(),
            "machine": machine(),
            "seconds": time.monotonic() - began,
            "kanayama": lateral,
            "last_lap": rows,
            "tiers": tier_rows,
            "endurance": long_rows,
            "scenarios": [s.model_dump(mode="json") for s in (*scenarios, *endurance, *tiers, *bound)],
        },
    )
    parts = [text(rows), endurance_text(long_rows), tiers_text(tier_rows), kanayama_text(lateral)]
    return "\n\n".join([*parts, f"Figures and table.json are in {out}."])


def figures(result: xr.Dataset, scenarios: Sequence[Scenario], out: Path) -> None:
    """Draws and writes every figure."""
    pair = [scenarios.index(scenario(name, CASE)) for name in ("none", "fel")]
    both = result.isel(run=pair).assign_coords(label=("run", ["PID", "PID + network"]))
    both = both.isel(time=slice(scenarios[pair[0]].ticks))
    pid, network = both.isel(run=0), both.isel(run=1)
    last, lap = scenarios[0].laps, FAST
    drawn = {
        "figure2_posture": drawings.posture_definition(),
        "figure3_structure": drawings.control_structure(),
        "figure4a_linear_velocity": plots.velocities(network, ("v",), lap=last),
        "figure4b_rotation_velocity": plots.velocities(network, ("omega",), lap=last),
        "figure4c_tracking_errors": plots.errors(network, window=(0.0, last * lap)),
        "figure5_pid_against_network": plots.compare_errors(pid, network, lap=last),
        "figure6_feedforward_outputs": plots.feedforward_outputs(network, window=(0.0, 3 * lap)),
        "path": plots.path(both, lap=last),
        "voltages": plots.voltages(both, lap=last),
        "learning_curve": plots.learning_curve(both, ("v_rmse", "omega_rmse", "position_rmse", "feedback_share")),
    }
    for name, figure in drawn.items():
        plots.save(figure, out, name)


def summary(result: xr.Dataset) -> pd.DataFrame:
    """Returns the metrics of the last lap of every run, the position error over all laps, and why it failed, or ""."""
    laps = metrics.per_lap(result)
    over_all = metrics.over_laps(laps, "position_rmse")
    return metrics.summary(laps).assign(failure=result["failure"].values, position_all=over_all)


def compare(table: pd.DataFrame, scenarios: Sequence[Scenario]) -> list[dict[str, Any]]:
    """Computes the RMSE in the last lap of every run, and its ratio to PID alone on the same plant, reference and seed.

    Args:
        table: What `summary` returns, a row for each scenario.
        scenarios: The runs, PID alone among them; of several runs of a scenario the first one is meant.
    """

    def world(one: Scenario) -> Hashable:
        return one.name, one.steering, one.sensing, one.reference, one.seed

    alone: dict[Hashable, int] = {}
    for k, one in enumerate(scenarios):
        if one.feedforward == "none":
            alone.setdefault(world(one), k)  # not that of `hindsight`, whose scenarios are the same and come later
    rows = []
    for k, one in enumerate(scenarios):
        bare = alone[world(one)]
        row: dict[str, Any] = {
            "steering": table["steering"].iloc[k],
            "plant": one.name,
            "sensing": one.sensing.tier,
            "estimator": one.sensing.source,
            "lap_time": one.reference.period,
            "feedforward": one.feedforward,
            "seed": one.seed,
            "failure": str(table["failure"].iloc[k]),
        }
        for metric in METRICS:
            row[metric] = float(table[metric].iloc[k])
            row[f"{metric}_to_pid"] = float(table[metric].iloc[k] / table[metric].iloc[bare])
        row["position_all"] = float(table["position_all"].iloc[k])
        rows.append(row)
    return rows


def endure(result: xr.Dataset, scenarios: Sequence[Scenario]) -> list[dict[str, Any]]:
    """Returns the RMSE of the long runs in lap 8 and in the last lap; the two agree if learning stays stable."""
    laps = metrics.per_lap(result)
    rows = []
    for k, one in enumerate(scenarios):
        row: dict[str, Any] = {"run": f"{one.feedforward}, {one.name}, {one.reference.period:g} s", "laps": one.laps}
        for metric in METRICS:
            values = laps[metric].values[k]
            row[metric] = {"lap_8": float(values[7]), "last": float(values[-1])}
        rows.append(row)
    return rows


def endurance_text(rows: Sequence[dict[str, Any]]) -> str:
    """Returns the table of the long runs as Markdown."""
    header = ["run", *(f"{name}, lap 8 → {MANY_LAPS}" for name in ("V, mm/s", "θ̇, mrad/s", "position, mm"))]
    cells = [
        [r["run"], *(" → ".join(number(1e3 * r[m][lap]) for lap in ("lap_8", "last")) for m in METRICS)] for r in rows
    ]
    return f"The same after {MANY_LAPS} laps:\n\n" + markdown(header, cells)


def text(rows: Sequence[dict[str, Any]]) -> str:
    """Returns the comparison as Markdown."""
    header = ["steering", "plant", "lap", "feedforward", "V, mm/s", "θ̇, mrad/s", "position, mm"]
    header += ["to PID: V", "θ̇", "position"]
    cells = []
    for row in rows:
        if row["failure"]:
            values = [row["failure"], *[""] * 5]
        else:
            ratios = [row[f"{m}_to_pid"] for m in METRICS]
            values = [number(1e3 * row[m]) for m in METRICS]
            values += [f"{r:.2f}" if math.isfinite(r) else "PID fails" for r in ratios]
        cells.append([row["steering"], row["plant"], f"{row['lap_time']:g} s", row["feedforward"], *values])
    title = "RMSE of the last of 8 laps against the reference, with exact measurements and a PID of λ = 0.15 s:"
    return f"{title}\n\n{markdown(header, cells)}"


def tiers_text(rows: Sequence[dict[str, Any]]) -> str:
    """Returns the table of the runs in each tier as Markdown: means over the replicates."""
    header = ["sensing", "plant", "feedforward", "V, mm/s", "θ̇, mrad/s", "position, mm", "to PID", "all laps, mm"]
    groups: dict[tuple[str, str, str], list[dict[str, Any]]] = defaultdict(list)
    for row in rows:
        groups[row["sensing"], row["plant"], row["feedforward"]].append(row)
    columns = *METRICS, "position_all"
    means = {key: {m: fmean(row[m] for row in group) for m in columns} for key, group in groups.items()}
    cells = []
    for key, group in groups.items():
        if lost := sum(bool(row["failure"]) for row in group):
            cells.append([*key, f"{lost} of {len(group)} fail", *[""] * 4])
            continue
        ratio = means[key]["position_rmse"] / means[*key[:2], "none"]["position_rmse"]
        relative = f"{ratio:.2f}" if math.isfinite(ratio) else "PID fails"
        *last, over_all = (number(1e3 * means[key][m]) for m in columns)
        cells.append([*key, *last, relative, over_all])
    title = (
        "The 12 s lap with the sensors, motors and controllers of each tier, RMSE of the last of 8 laps and, of "
        f"position, over all of them, mean of {DRAWS} replicates:"
    )
    return f"{title}\n\n{markdown(header, cells)}"


def kanayama_text(rows: Sequence[dict[str, Any]]) -> str:
    """Returns Kanayama's table as Markdown."""
    cells = [
        [str(r["case"]), f"{r['target']:.4g} {r['unit']}", f"{r['value']:.2f}", f"{r['value_10ms']:.2f}"] for r in rows
    ]
    return "Kanayama's controller on the kinematic plant:\n\n" + markdown(
        ["case", "target", "at 0.1 ms", "at T_s = 10 ms"], cells
    )
