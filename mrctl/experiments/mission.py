"""`mrctl navigate`: drives one mission, prints how it ended and saves its result."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import Any

from mrctl.control.stages import Stages
from mrctl.experiments.tables import Report, json_text, markdown, number, output_folder, write_json
from mrctl.loop import user_files
from mrctl.navigation.mission import Mission, Order, order_of
from mrctl.results import plots
from mrctl.results.dataset import departure, faults_of, open_result, save, versions

COLUMNS = {
    "time": ("time, s", 1.0),
    "length": ("path, m", 1.0),
    "spl": ("SPL", 1.0),
    "clearance": ("least clearance, mm", 1e3),
    "position_rmse": ("position error, mm", 1e3),
    "jerk": ("jerk, m/s³", 1.0),
    "energy": ("energy, J", 1.0),
    "planning_time": ("planning, s", 1.0),
}


FIGURES = plots.path, plots.velocities, plots.errors
FILES = ["result.zarr", "mission.json", *(file for draw in FIGURES for file in plots.files(draw.__name__))]
"""Names of the files that a mission is saved in."""


def run(world: str, order: Order, out: Path | None, as_json: bool, own: str | None = None) -> Report:
    """Drives a mission.

    Args:
        world: Name of its world, for the report.
        order: The mission.
        out: Folder for `result.zarr`, `mission.json` and figures; None saves nothing.
        as_json: Whether to return JSON instead of a table.
        own: Stages of the user that drive the first robot; see `mrctl.loop.user_files`.

    Returns:
        The report, with a row for each robot; it `ended` with the outcome of the first robot.

    Raises:
        InputError: As `navigate`, or the folder cannot be written or holds a result already.
    """
    with output_folder(out, FILES):
        stages: Stages = user_files.load(own) if own else {}
        driven = order.drive(progress=True, **stages)
    return _report(world, order, driven, out, as_json, own)


def repeat(folder: Path, out: Path | None, as_json: bool, own: str | None = None) -> tuple[Report, str]:
    """Drives a saved mission again, and compares it with what was saved.

    Args:
        folder: What `run` wrote as `out`.
        out: As for `run`.
        as_json: As for `run`.
        own: The stages of the user that drove it; what is saved holds only their names.

    Returns:
        What `run` returns; and in which signal the mission departs from the saved one, or "".

    Raises:
        InputError: As `mrctl.navigation.mission.again`; or the folder has no result, or other stages drove it; or `out`
            cannot be written or holds one already.
    """
    with output_folder(out, FILES):
        order, saved = order_of(folder), open_result(folder / "result.zarr")
        drove = json.loads(saved.attrs.get("stages", "{}"))
        if order.avoid != "none":
            drove.pop("motion", None)  # the avoider, which the order names
        driven = order.drive(progress=True, **user_files.load_same(own, drove, folder))
    return _report(str(folder), order, driven, out, as_json, own), departure(driven.result, saved)


def _report(world: str, order: Order, driven: Mission, out: Path | None, as_json: bool, own: str | None) -> Report:
    """Returns what `run` returns; what is saved holds all that the mission is a function of."""
    table, faults = driven.table, faults_of(driven.result.isel(run=0))
    values = {
        "world": world,
        "start": order.task.start,
        "goal": order.task.goal,
        **order.model_dump(mode="json"),
        "controller": own,
        "plan": {"length": driven.plan.length, "expanded": driven.plan.expanded, "poses": driven.plan.poses.tolist()},
        "versions": versions(),
        "faults": faults,
        "robots": table.reset_index().assign(planning_time=driven.planning_time).to_dict("records"),
    }
    outcome, write = str(table["outcome"].iloc[0]), partial(_save, driven, values, out)
    if as_json:
        return Report(json_text(values), outcome, write)
    # A robot that avoids is not where the plan is in time, to which its position error would be.
    unsaid = {"position_rmse"} if order.avoid != "none" else set()
    rows = [
        [
            robot["label"],
            robot["outcome"],
            *("–" if name in unsaid else number(scale * robot[name]) for name, (_, scale) in COLUMNS.items()),
        ]
        for robot in values["robots"]
    ]
    title = f"plan of {driven.plan.length:.2f} m; number of poses that the search expanded: {driven.plan.expanded:,}"
    text = "\n".join([title, *faults, markdown(["robot", "outcome", *(title for title, _ in COLUMNS.values())], rows)])
    return Report(text, outcome, write)


def _save(driven: Mission, values: dict[str, Any], out: Path | None) -> None:
    """Writes the result, what it is a function of, and the figures to a folder, if there is one."""
    if out is None:
        return
    save(driven.result, out / "result.zarr")
    write_json(out / "mission.json", values)
    for draw in FIGURES:
        plots.save(draw(driven.result), out, draw.__name__)
