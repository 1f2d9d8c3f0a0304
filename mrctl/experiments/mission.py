"""`mrctl navigate`: drives one mission, prints how it ended and saves its result."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from mrctl.experiments.tables import json_text, markdown, number, output_folder, write_json
from mrctl.navigation.mission import Avoid, navigate, task_of
from mrctl.record import InputError
from mrctl.results import plots
from mrctl.results.dataset import save, versions
from mrctl.scenario import FeedforwardName, Scenario
from mrctl.theory.obstacles import Pose

COLUMNS = {
    "time": ("time, s", 1.0),
    "length": ("path, m", 1.0),
    "spl": ("SPL", 1.0),
    "clearance": ("least clearance, mm", 1e3),
    "position_rmse": ("position error, mm", 1e3),
    "energy": ("energy, J", 1.0),
}


def run(
    world: str,
    scenario: Scenario,
    goal: Pose | None,
    start: Pose | None,
    compare: Sequence[FeedforwardName],
    speed: float | None,
    margin: float,
    avoid: Avoid,
    out: Path | None,
    as_json: bool,
) -> tuple[str, str]:
    """Drives a mission.

    Args:
        world: World of the mission; see `mrctl.navigation.mission.task_of`, also for start and goal.
        scenario: Scenario of the robots; see `mrctl.navigation.mission.navigate`, also for `compare` to `avoid`.
        goal: Pose of the goal in m, m, rad, or None.
        start: Pose of the start in m, m, rad, or None.
        compare: Further feedforwards.
        speed: Largest speed in m/s, or None.
        margin: Clearance of the plan in m.
        avoid: What keeps the robot from obstacles.
        out: Folder for `result.zarr`, `mission.json` and figures; None saves nothing.
        as_json: Whether to return JSON instead of a table.

    Returns:
        The report, with a row for each robot; and the outcome of the first robot.

    Raises:
        InputError: As `task_of` and `navigate`, or the folder cannot be written or holds a result already.
    """
    task = task_of(world, scenario, start, goal)
    if out is not None and (output_folder(out) / "result.zarr").exists():
        raise InputError(f"out: {out} holds a result already; nothing was overwritten")
    driven = navigate(task, scenario, compare, speed, margin, avoid, progress=True)
    table = driven.table
    values = {
        "world": world,
        "start": task.start,
        "goal": task.goal,
        "plan": {"length": driven.plan.length, "expanded": driven.plan.expanded, "poses": driven.plan.poses.tolist()},
        "scenario": scenario.model_dump(mode="json"),
        "versions": versions(),
        "robots": table.reset_index().to_dict("records"),
    }
    if out is not None:
        save(driven.result, out / "result.zarr")
        write_json(out / "mission.json", values)
        for draw in (plots.path, plots.velocities, plots.errors):
            plots.save(draw(driven.result), out, draw.__name__)
    outcome = str(table["outcome"].iloc[0])
    if as_json:
        return json_text(values), outcome
    rows = [
        [robot["label"], robot["outcome"], *(number(scale * robot[name]) for name, (_, scale) in COLUMNS.items())]
        for robot in values["robots"]
    ]
    title = f"plan of {driven.plan.length:.2f} m, for which {driven.plan.expanded:,} poses were expanded"
    return "\n".join([title, markdown(["robot", "outcome", *(title for title, _ in COLUMNS.values())], rows)]), outcome
