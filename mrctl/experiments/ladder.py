"""The ladder of feedforwards side by side: steering arrangements × perturbations × paired seeds."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd
from tqdm import tqdm

from mrctl import metrics
from mrctl.experiments.tables import markdown, number, output_folder, write_json
from mrctl.metrics import bootstrap_interval, paired_ratio
from mrctl.record import InputError
from mrctl.result import versions
from mrctl.robot import PERTURBATIONS
from mrctl.scenario import STEERINGS, FeedforwardName, Scenario
from mrctl.simulate import simulate

COLUMNS = {"v_rmse": "V, mm/s", "omega_rmse": "θ̇, mrad/s", "position_rmse": "position, mm"}


def last_lap(feedforwards: Sequence[FeedforwardName], seeds: int, scenario: Scenario | None = None) -> pd.DataFrame:
    """Runs every combination, one feedforward and steering arrangement at a time to bound memory.

    Args:
        feedforwards: Which to compare.
        seeds: Seeds 0 to `seeds` − 1, the same for everyone.
        scenario: What the runs have in common.

    Returns:
        A row a run: steering, perturbation, feedforward, seed, failed, failure and the metrics of the last lap; NaN
        where the run failed.
    """
    base = scenario or Scenario()
    tables = []
    groups = [(steering, name) for steering in STEERINGS for name in feedforwards]
    for steering, feedforward in tqdm(groups, unit="group"):
        keys = [(case, seed) for case in PERTURBATIONS for seed in range(seeds)]
        result = simulate(
            [
                base.model_copy(
                    update={
                        "steering": steering,
                        "feedforward": feedforward,
                        "seed": seed,
                        "perturbation": PERTURBATIONS[case],
                    }
                )
                for case, seed in keys
            ]
        )
        table = metrics.summary(result).assign(perturbation=[case for case, _ in keys])
        tables.append(table.assign(failure=result["failure"].values))
    return pd.concat(tables, ignore_index=True)


def compare(runs: pd.DataFrame) -> pd.DataFrame:
    """Means with 95 % bootstrap intervals and paired ratios to PID alone, a row a combination.

    Args:
        runs: As from `last_lap`.
    """
    keys = ["steering", "perturbation", "feedforward"]
    groups = {tuple(key): own for key, own in runs.groupby(keys, sort=False)}  # type: ignore[arg-type]
    names = [list(dict.fromkeys(runs[key])) for key in keys]
    rows = []
    for steering, case, feedforward in product(*names):
        own = groups[steering, case, feedforward]
        row: dict[str, object] = dict(zip(keys, (steering, case, feedforward), strict=True))
        row |= {"runs": len(own), "failed": int(np.sum(own["failed"]))}
        bare = groups.get((steering, case, "none"))
        for metric in COLUMNS:
            samples = np.asarray(own[metric])
            row[metric] = bootstrap_interval(samples)._asdict()
            if bare is not None:
                row[f"{metric}_to_pid"] = paired_ratio(samples, np.asarray(bare[metric]))._asdict()
        rows.append(row)
    return pd.DataFrame(rows)


def suite(feedforwards: Sequence[FeedforwardName], seeds: int, out: Path) -> str:
    """Runs the comparison and writes it as `table.md` and `table.json`.

    Raises:
        InputError: No feedforward, no seed, or a folder that cannot be written.
    """
    if seeds < 1 or not feedforwards:
        raise InputError("seeds: at least one run of at least one feedforward")
    output_folder(out)
    runs = last_lap(feedforwards, seeds)
    table = compare(runs)
    text = as_markdown(table)
    (out / "table.md").write_text(text + "\n")
    values = {"versions": versions(), "rows": table.to_dict("records"), "runs": runs.to_dict("records")}
    write_json(out / "table.json", values)
    return text


def as_markdown(table: pd.DataFrame) -> str:
    """The comparison as a Markdown table: mean [95 % interval] of the last lap's RMSE."""
    header = ["steering", "plant", "feedforward", "failed", *COLUMNS.values()]
    rows = []
    for row in table.to_dict("records"):
        cells = [str(row[key]) for key in ("steering", "perturbation", "feedforward")]
        cells.append(f"{row['failed']}/{row['runs']}")
        for metric in COLUMNS:
            mean = row[metric]
            value, low, high = (number(1e3 * mean[key]) for key in ("value", "low", "high"))
            cells.append(f"{value} [{low}, {high}]" if mean["samples"] else "–")
        rows.append(cells)
    return markdown(header, rows)
