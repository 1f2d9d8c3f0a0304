"""The held-out cells: courses and plants on which one learner is judged, and on which nothing is ever chosen.

A setting that was chosen on some runs looks better on them than it is (selection bias). These cells were written down
before any tuning; their courses, plants and seeds are used nowhere else. Learners are named, with their settings,
before they drive, and the folder that they are driven into logs each drive, also one that was interrupted.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from mrctl.experiments import suite
from mrctl.experiments.cases import HALF, HELD_OUT_SEEDS, NO_SPREAD, Case, Choice, Laps
from mrctl.experiments.suite_tables import COLUMNS, WINDOWS, interval
from mrctl.experiments.tables import Table, frame, machine, number, output_folder, write_json
from mrctl.kernel import Array
from mrctl.record import InputError
from mrctl.results.comparison import mean_interval
from mrctl.results.dataset import versions
from mrctl.scenario import FEEDFORWARDS, FeedforwardName, Scenario, replicates
from mrctl.theory.perturbation import Perturbation
from mrctl.theory.references import Circle, Reference, RoundedSquare, StopAndGo, Waypoints
from mrctl.theory.timing import Limits

LAPS = 6
RIVALS: tuple[FeedforwardName, ...] = ("model", "true_model", "model+observer")
HALF_STEP_REPLICATES = 5  # replicates of each cell that are also driven with half the physics step
LOG_FILE = "held_out.jsonl"
"""Name of the log, with a line for each time that the cells were begun, and for each time that they were finished."""

PLANTS: dict[str, Perturbation] = {
    "light, weak supply": Perturbation(mass_factor=0.7, supply_factor=0.95),
    "payload 3 kg aside": Perturbation(payload=3.0, payload_x=0.25, payload_y=-0.12),
    "left motor -8 %, friction x2": Perturbation(left_motor_constant_factor=0.92, drive_friction_factor=2.0),
    "supply -10 %, resistance +20 %": Perturbation(supply_factor=0.9, resistance_factor=1.2),
    "slope 4°, mass +20 %": Perturbation(slope=0.07, mass_factor=1.2),
    "sagging battery, dead zone": Perturbation(battery_resistance=0.2, dead_zone=0.5),
    "delay 10 ms, inertia +40 %": Perturbation(control_delay=0.01, inertia_factor=1.4),
    "right wheel -3 %, right friction x3": Perturbation(right_radius_factor=0.97, right_drive_friction_factor=3.0),
}
"""Eight plants that differ from the model, none of them in `PERTURBATIONS`."""


@cache
def courses() -> dict[str, Reference]:
    """Returns five courses; the speed changes along the last three.

    They are no constant, because their timing calls kernels, which are not to be compiled when this module is imported.
    """
    return {
        "circle": Circle(radius=1.3, period=9.0, clockwise=True),
        "square": RoundedSquare(side=2.6, radius=0.6, speed=0.6),
        "stop and go": StopAndGo(distance=3.0, move_time=4.5, pause=0.7, reverse=False),
        "fast spline": Waypoints(
            points=((0, 0), (1.4, -0.3), (2.6, 0.5), (1.9, 1.7), (0.7, 1.1), (-0.9, 1.8), (-1.5, 0.6)),
            speed=1.1,
            timing="limits",
            limits=Limits(acceleration=0.8, rotation=1.8, rotation_acceleration=3.5, lateral_acceleration=0.9),
        ),
        "winding spline": Waypoints(
            points=((0, 0), (-0.6, 1.0), (0.4, 1.9), (2.0, 1.5), (3.2, 1.9), (3.6, 0.6), (2.6, -0.6), (1.2, 0.1)),
            speed=0.9,
            timing="limits",
            limits=Limits(acceleration=0.5, rotation=1.5, rotation_acceleration=3.0, lateral_acceleration=0.6),
        ),
    }


def cells(count: int) -> list[Case]:
    """Returns the 40 cells, each course with each plant, course by course.

    Args:
        count: Number of replicates of each cell; all cells have the same draws.
    """
    found = []
    for course, reference in courses().items():
        for plant, perturbation in PLANTS.items():
            name = f"{course}; {plant}"
            run = Scenario(
                name=name, laps=LAPS, reference=reference, perturbation=perturbation, initial_spread=NO_SPREAD
            )
            found.append(Case(name, "held-out", tuple(replicates(run, count, HELD_OUT_SEEDS.start))))
    return found


def judge(entries: Sequence[str], count: int, workers: int | None, out: Path) -> str:
    """Drives feedforwards and their rivals through the cells; writes `table.md` and `table.json`, and logs it.

    Each feedforward is compared with the rivals alone, so that the others beside it change nothing.

    Args:
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
    if not 1 <= count <= len(HELD_OUT_SEEDS):
        raise InputError(f"seeds: {count} is not between 1 and {len(HELD_OUT_SEEDS):,}")
    known: list[FeedforwardName] = [entry for entry in dict.fromkeys(entries) if entry in FEEDFORWARDS]
    own = [entry for entry in entries if entry not in FEEDFORWARDS]
    choices = suite.by_name((*known, *RIVALS), own)
    judged = dict(zip((name for name in choices if name not in RIVALS), (*known, *own), strict=True))
    chosen = [one for cell in cells(count) for one in (cell, _half(cell))]
    this = {"mrctl": versions()["mrctl"]}
    with output_folder(out):
        rivals_left = any(suite.left(out / "runs" / rival) for rival in RIVALS)
        fresh = [name for name in judged if rivals_left or suite.left(out / "runs" / name)]
        for name in fresh:
            _log(out, {"entry": judged[name]} | this | {"replicates": count, "settings": _settings(choices[name])})
        laps, aside = suite.run(chosen, choices, workers, out / "runs")
    found, rows, shown = suite.runs_of(chosen, laps), {}, []
    for name, entry in judged.items():
        rows[entry] = compare(name, found)
        tables = summarised(name, rows[entry], count)
        shown += [table.markdown for table in tables]
        if name in fresh or not _said(out, entry):
            _log(out, {"entry": entry} | this | {"says": tables[0].says})
    (out / "table.md").write_text("\n".join(shown), "utf-8")
    source = {"versions": versions(), "machine": machine()}
    write_json(out / "table.json", source | {"mode": "held-out", "cells": rows})
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


def compare(name: str, found: Mapping[str, Laps]) -> list[dict[str, Any]]:
    """Compares a feedforward with each rival in each cell, metric and window: a row for each.

    Of the feedforwards in `found` others than these do not count.

    It is at or below a rival if it lost fewer runs; or as many, and its mean over the runs that both finished exceeds
    the rival's by no more than the floor. The floor is that of the course: the largest change of a difference between
    two means, on any of its plants, when the physics step is halved.
    """
    rows = []
    these = {cell: {one: own[one] for one in (name, *RIVALS)} for cell, own in found.items()}
    for course in courses():
        whole = {plant: these[f"{course}; {plant}"] for plant in PLANTS}
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


def summarised(name: str, rows: Sequence[dict[str, Any]], count: int) -> list[Table]:
    """Counts the cells in which a feedforward is at or below each rival; a second table names the others, if any."""
    size = len(courses()) * len(PLANTS)
    cells, fewest = [], {}
    for metric, title in COLUMNS.items():
        error = title.split(",")[0]
        for window, called in WINDOWS.items():
            line = [error, called]
            for rival in RIVALS:
                asked = {"metric": metric, "window": window, "rival": rival}
                own = [row for row in rows if asked.items() <= row.items()]
                fine, ties = sum(row["at_or_below"] for row in own), sum(row["tie"] for row in own)
                line.append(f"{fine}/{len(own)}, {ties} of them ties")
            cells.append(line)
            asked = {"metric": metric, "window": window}
            own = [row for row in rows if asked.items() <= row.items()]
            above = {(row["course"], row["plant"]) for row in own if not row["at_or_below"]}
            fewest[error] = min(fewest.get(error, size), size - len(above))
    counted = ", ".join(f"in {error} at least {least}" for error, least in fewest.items())
    says = (
        f"Of the {size} cells with {count} replicates, `{name}` is at or below all of `model`, `true_model` and "
        f"`model+observer` in so many, in the worst of lap 1, all laps and the last lap: {counted}."
    )
    header = ["error", "window", *(f"at or below {rival}" for rival in RIVALS)]
    found = [Table(f"Held-out cells, {name} (held-out)", says, frame(cells, header))]
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
