"""`mrctl navigate`: drives one mission, prints how it ended and saves its result."""

from __future__ import annotations

import json
import shlex
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from mrctl.control.stages import Stages
from mrctl.experiments.tables import Report, json_text, markdown, number, output_folder, write_json
from mrctl.loop import user_files
from mrctl.loop.learned import LEARNED, save_if_learned
from mrctl.loop.user_stages import named_stages
from mrctl.navigation.mission import Mission, Order, drove, order_of
from mrctl.record import InputError
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


MAX_OUTCOME = 40  # characters of an outcome in the table; a longer one, of a stage that raised, stands above it
FIGURES = plots.path, plots.velocities, plots.errors
FILES = ["result.zarr", "mission.json", LEARNED, *(file for draw in FIGURES for file in plots.files(draw.__name__))]
"""Names of the files that a mission is saved in."""


def run(world: str, order: Order, out: Path | None, as_json: bool, controller: str | None = None) -> Report:
    """Drives a mission.

    Args:
        world: Name of its world, for the report.
        order: The mission.
        out: Folder for `result.zarr`, `mission.json` and figures; None saves nothing.
        as_json: Whether to return JSON instead of a table.
        controller: Controller of the user that drives the first robot, as for `user_files.behind`, whose feedforward in
            front is that of the scenario.

    Returns:
        The report, with a row for each robot; it `ended` with the outcome of the first robot.

    Raises:
        InputError: As `navigate`, or the folder cannot be written or holds a result already.
    """
    with output_folder(out, FILES):
        stages: Stages = user_files.load(user_files.behind(controller)[1]) if controller else {}
        driven = order.drive(progress=True, **stages)
    return _report(world, order, driven, out, as_json, controller)


def repeat(folder: Path, out: Path | None, as_json: bool, controller: str | None = None) -> tuple[Report, str]:
    """Drives a saved mission again, and compares it with what was saved.

    Args:
        folder: What `run` wrote as `out`.
        out: As for `run`.
        as_json: As for `run`.
        controller: The controller of the user that drove it; what is saved holds only its name.

    Returns:
        What `run` returns; and in which signal the mission departs from the saved one, or "".

    Raises:
        InputError: As `mrctl.navigation.mission.again`, or `out` cannot be written or holds a result already.
    """
    with output_folder(out, FILES):
        order, saved = order_of(folder), open_result(folder / "result.zarr")
        stages = _expected(folder, order, controller)
        driven = order.drive(progress=True, **stages)
    departs = departure(driven.result, saved)
    if departs and controller and _read(folder).get("controller_digest", "") != _digest(controller):
        departs += f"; the code of {controller} has changed since"
    return _report(str(folder), order, driven, out, as_json, controller), departs


def _read(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "mission.json").read_text("utf-8"))


def _digest(controller: str) -> str:
    return user_files.digest(user_files.behind(controller)[1])


def _expected(folder: Path, order: Order, controller: str | None) -> Stages:
    """Returns the stages of the user that drive a saved mission again.

    Raises:
        InputError: The controller is not the one that drove it, or is refused, as by `user_files.load`.
    """
    saved = str(_read(folder).get("controller") or "")
    needed = f"--controller {shlex.quote(saved)}" if saved else "no --controller"
    stages: Stages = user_files.load(user_files.behind(controller)[1]) if controller else {}
    fronts = [user_files.behind(name)[0] if name else None for name in (controller, saved)]
    if fronts[0] != fronts[1] or named_stages(stages) != drove(folder, order):
        raise InputError(f"controller: {folder} needs {needed}, as when it was saved")
    return stages


def _report(
    world: str, order: Order, driven: Mission, out: Path | None, as_json: bool, controller: str | None
) -> Report:
    """Returns what `run` returns; what is saved holds all that the mission is a function of."""
    table, faults = driven.table, faults_of(driven.result.isel(run=0))
    values = {
        "world": world,
        "start": order.task.start,
        "goal": order.task.goal,
        **order.model_dump(mode="json"),
        "controller": controller,
        "controller_digest": controller and _digest(controller),
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
            robot["outcome"] if len(robot["outcome"]) <= MAX_OUTCOME else "failed",
            *(
                "–" if name in unsaid or not np.isfinite(robot[name]) else number(scale * robot[name])
                for name, (_, scale) in COLUMNS.items()
            ),
        ]
        for robot in values["robots"]
    ]
    faults += [f"{one['label']}: {one['outcome']}" for one in values["robots"] if len(one["outcome"]) > MAX_OUTCOME]
    title = f"plan of {driven.plan.length:.2f} m; number of poses that the search expanded: {driven.plan.expanded:,}"
    text = "\n".join([title, *faults, markdown(["robot", "outcome", *(title for title, _ in COLUMNS.values())], rows)])
    return Report(text, outcome, write)


def _save(driven: Mission, values: dict[str, Any], out: Path | None) -> None:
    """Writes the result, what it is a function of, and the figures to a folder, if there is one."""
    if out is None:
        return
    save(driven.result, out / "result.zarr")
    write_json(out / "mission.json", values)
    save_if_learned(out / LEARNED, driven.result.isel(run=0))
    for draw in FIGURES:
        plots.save(draw(driven.result), out, draw.__name__)
