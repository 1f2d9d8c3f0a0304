"""The judgement of learners on a set of held-out cells.

Learners are named, with their settings, before they drive, and the folder that they are driven into logs each drive,
also one that was interrupted.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from mrctl.experiments import suite
from mrctl.experiments.cases import HALF, Case, Choice, Laps
from mrctl.experiments.held_out_cells import Which, cells
from mrctl.experiments.suite_tables import COLUMNS, WINDOWS, interval
from mrctl.experiments.tables import Table, frame, machine, number, output_folder, write_json
from mrctl.kernel import Array
from mrctl.record import InputError
from mrctl.results.comparison import mean_interval
from mrctl.results.dataset import versions
from mrctl.scenario import FEEDFORWARDS, FeedforwardName, Scenario

RIVALS: tuple[FeedforwardName, ...] = ("model", "true_model", "model+observer")
HALF_STEP_REPLICATES = 5  # replicates of each cell that are also driven with half the physics step
LOG_FILE = "held_out.jsonl"
"""Name of the log, with a line for each time that the cells were begun, and for each time that they were finished."""


def judge(which: Which, entries: Sequence[str], count: int, workers: int | None, out: Path) -> str:
    """Drives feedforwards and their rivals through a set of cells; writes `table.md` and `table.json`, and logs it.

    Each feedforward is compared with the rivals alone, so that the others beside it change nothing.

    Args:
        which: The set of cells.
        entries: Names of feedforwards, or of the user's, as for `suite.by_name`.
        count: Number of replicates of each cell.
        workers: Number of processes; by default one for each core.
        out: Folder for the results.

    Returns:
        A sentence on the runs that could not be done, or "".

    Raises:
        InputError: There is no such feedforward, it is a rival, or the folder cannot be written or holds other runs.
    """
    if not entries:
        raise InputError("held_out: name at least one feedforward")
    for entry in entries:
        if entry in RIVALS or (entry not in FEEDFORWARDS and ".py:" not in entry):
            names = ", ".join(name for name in FEEDFORWARDS if name not in RIVALS)
            raise InputError(
                f"held_out: {entry!r} is neither one of {names} nor of the form my_file.py:MyController, with or "
                "without a feedforward in front, as in model+my_file.py:MyController"
            )
    if not 1 <= count <= (most := len(cells(which).seeds)):
        raise InputError(f"seeds: {count} is not between 1 and {most:,}")
    known: list[FeedforwardName] = [entry for entry in dict.fromkeys(entries) if entry in FEEDFORWARDS]
    own = [entry for entry in entries if entry not in FEEDFORWARDS]
    choices = suite.by_name((*known, *RIVALS), own)
    judged = dict(zip((name for name in choices if name not in RIVALS), (*known, *own), strict=True))
    chosen = [one for cell in cells(which).cases(count) for one in (cell, _half(cell))]
    this = {"mrctl": versions()["mrctl"]}
    with output_folder(out):
        rivals_left = any(suite.left(out / "runs" / rival) for rival in RIVALS)
        fresh = [name for name in judged if rivals_left or suite.left(out / "runs" / name)]
        for name in fresh:
            _log(out, {"entry": judged[name]} | this | {"replicates": count, "settings": _settings(choices[name])})
        laps, aside = suite.run(chosen, choices, workers, out / "runs")
    found, rows, shown = suite.runs_of(chosen, laps), {}, []
    for name, entry in judged.items():
        rows[entry] = compare(which, name, found)
        tables = summarised(which, name, rows[entry], count)
        shown += [table.markdown for table in tables]
        if name in fresh or not _said(out, entry):
            _log(out, {"entry": entry} | this | {"says": tables[0].says})
    (out / "table.md").write_text("\n".join(shown), "utf-8")
    source = {"versions": versions(), "machine": machine()}
    write_json(out / "table.json", source | {"mode": "held-out", "set": which, "cells": rows})
    return aside


def _log(out: Path, values: Mapping[str, Any]) -> None:
    """Adds a line to the log, so that a drive that was begun is on record even without a result."""
    log = out / LOG_FILE
    torn = log.exists() and not log.read_text("utf-8").endswith("\n")
    with log.open("a", encoding="utf-8") as file:
        line = json.dumps({"time": datetime.now(UTC).isoformat(timespec="seconds"), **values})
        file.write("\n" * torn + line + "\n")


def logged(log: str) -> list[dict[str, Any]]:
    """Returns the lines of a log, without those that a killed process wrote in part."""
    found = []
    for line in log.splitlines():
        with suppress(json.JSONDecodeError):
            found.append(json.loads(line))
    return found


def _said(out: Path, entry: str) -> bool:
    """Tells whether the last line of the log on a feedforward has its result, and not only that a drive was begun."""
    log = out / LOG_FILE
    own = [line for line in logged(log.read_text("utf-8") if log.exists() else "") if line["entry"] == entry]
    return bool(own) and "says" in own[-1]


def _half(cell: Case) -> Case:
    """Returns the first replicates of a cell with half the physics step."""
    halved = {"physics_step": Scenario().physics_step / 2, "name": cell.name + HALF}
    return Case(
        cell.name + HALF, cell.part, tuple(s.model_copy(update=halved) for s in cell.scenarios[:HALF_STEP_REPLICATES])
    )


def _settings(choice: Choice) -> dict[str, Any] | None:
    """Returns the settings of the learner of mrctl; those of a controller of the user are not known."""
    if choice.learner == "none":
        return None if choice.controller else {}
    return getattr(Scenario(), choice.learner).model_dump(mode="json")


def compare(which: Which, name: str, found: Mapping[str, Laps]) -> list[dict[str, Any]]:
    """Compares a feedforward with each rival in each cell of a set, metric and window: a row for each.

    Of the feedforwards in `found` others than these do not count.

    It is at or below a rival if it lost fewer runs; or as many, and its mean over the runs that both finished exceeds
    the rival's by no more than the floor. The floor is that of the course: the largest change of a difference between
    two means, on any of its plants, when the physics step is halved.
    """
    rows, (courses, plants, _) = [], cells(which)
    these = {cell: {one: own[one] for one in (name, *RIVALS)} for cell, own in found.items()}
    for course in courses:
        whole = {plant: these[f"{course}; {plant}"] for plant in plants}
        pairs = [
            (
                {one: laps.isel(run=slice(HALF_STEP_REPLICATES)) for one, laps in own.items()},
                these[f"{course}; {plant}{HALF}"],
            )
            for plant, own in whole.items()
        ]
        for metric in COLUMNS:
            floors = suite.floors(pairs, metric)
            for plant, own in whole.items():
                errors = {one: suite.windows(laps, metric) for one, laps in own.items()}
                for window in WINDOWS:
                    for rival in RIVALS:
                        mine, theirs = errors[name][window], errors[rival][window]
                        row = {"course": course, "plant": plant, "metric": metric, "window": window, "rival": rival}
                        rows.append(row | _standing(mine, theirs, floors[window]))
    return rows


def _standing(mine: Array, theirs: Array, floor: suite.Floor) -> dict[str, Any]:
    lost, lost_by_rival = (int((~np.isfinite(one)).sum()) for one in (mine, theirs))
    both = np.isfinite(mine) & np.isfinite(theirs)
    difference = mean_interval((mine - theirs)[both])._asdict()
    close = not both.any() or difference["value"] <= floor.difference
    means = {"mine": float(mine[both].mean()), "theirs": float(theirs[both].mean())} if both.any() else {}
    return {
        **means, "difference": difference, "floor": floor._asdict(), "failed": lost, "rival_failed": lost_by_rival,
        "at_or_below": bool(lost < lost_by_rival or (lost == lost_by_rival and close)),
        "tie": bool(lost == lost_by_rival and both.any() and abs(difference["value"]) <= floor.difference),
    }  # fmt: skip


def summarised(which: Which, name: str, rows: Sequence[dict[str, Any]], count: int) -> list[Table]:
    """Counts the cells in which a feedforward is at or below each rival; a second table names the others, if any."""
    size = len({(row["course"], row["plant"]) for row in rows})
    lines, fewest = [], {}
    for metric, title in COLUMNS.items():
        error = title.split(",")[0]
        for window, called in WINDOWS.items():
            line = [error, called]
            for rival in RIVALS:
                asked = {"metric": metric, "window": window, "rival": rival}
                own = [row for row in rows if asked.items() <= row.items()]
                fine, ties = sum(row["at_or_below"] for row in own), sum(row["tie"] for row in own)
                line.append(f"{fine}/{len(own)}, {ties} of them ties")
            lines.append(line)
            asked = {"metric": metric, "window": window}
            own = [row for row in rows if asked.items() <= row.items()]
            above = {(row["course"], row["plant"]) for row in own if not row["at_or_below"]}
            fewest[error] = min(fewest.get(error, size), size - len(above))
    counted = ", ".join(f"in {error} at least {least}" for error, least in fewest.items())
    says = (
        f"Of the {size} cells of the {which} set, with {count} replicates, `{name}` is at or below all of `model`, "
        f"`true_model` and `model+observer` in so many, in the worst of lap 1, all laps and the last lap: {counted}."
    )
    header = ["error", "window", *(f"at or below {rival}" for rival in RIVALS)]
    found = [Table(f"Held-out cells, {name} (held-out)", says, frame(lines, header))]
    if not all(row["at_or_below"] for row in rows):
        found.append(_above(name, rows))
    return found


def _above(name: str, rows: Sequence[dict[str, Any]]) -> Table:
    """Lists where a feedforward is above a rival, by how much, with the floor of the course."""
    listed = pd.DataFrame(
        [
            {
                "error": COLUMNS[row["metric"]],
                "cell": f"{row['course']}; {row['plant']}",
                "window": WINDOWS[row["window"]],
                "rival": row["rival"],
                "above it by": interval(row["difference"])
                + (f", {row['failed']} runs failed against {row['rival_failed']}" if row["failed"] else ""),
                "floor": number(1e3 * row["floor"]["difference"]),
            }
            for row in rows
            if not row["at_or_below"]
        ]
    )
    says = (
        f"In {len(listed)} of {len(rows)} comparisons `{name}` is above the rival: its mean error exceeds that of the "
        "rival by more than the floor, or it has lost more runs. Differences of means with 95 % intervals."
    )
    return Table(f"Held-out cells in which {name} is above a rival (held-out)", says, listed)
