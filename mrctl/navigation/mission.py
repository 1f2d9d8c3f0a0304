"""Missions: a robot gets a goal in a world, plans a path, drives it, and reports the outcome."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from time import perf_counter
from typing import NamedTuple, Unpack

import numpy as np
import pandas as pd
import xarray as xr

from mrctl.control.stages import Stages
from mrctl.kernel import Array
from mrctl.loop.goals import arrived
from mrctl.loop.runs import simulate
from mrctl.loop.user_stages import expect_stages
from mrctl.navigation.avoiders import avoiding
from mrctl.navigation.generators import Task
from mrctl.navigation.plan import Plan
from mrctl.navigation.planning import PLAN_MARGIN, Avoid, prepared
from mrctl.record import InputError, Record, read_file
from mrctl.results.dataset import combine, open_result
from mrctl.results.metrics import as_runs, control_period
from mrctl.scenario import FEEDFORWARDS, FeedforwardName, Scenario
from mrctl.theory.obstacles import Pose

JERK_STEP = 0.1  # s, step of the differences whose third is the jerk; chosen
MAX_BYTES = 64 * 2**20  # bytes of a `mission.json`, which holds the obstacles of its world


class Mission(NamedTuple):
    """A mission that was driven."""

    plan: Plan
    """Way from start to goal."""
    result: xr.Dataset
    """Result of one robot or several, until the last of them has ended; NaN after the end of each."""
    table: pd.DataFrame
    """Outcomes of missions, as `outcomes` returns them."""
    planning_time: float
    """Wall time of the first plan, its checks and its time law in s; unlike all else, it differs from call to call."""


class Order(Record):
    """All that a mission is a function of, but for the files that it names, such as that of a robot, and own stages.

    With the same files and versions of the packages, the same order gives the same bits.

    The fields are the arguments of `navigate`. `mission.json`, which `mrctl navigate … --out` writes, contains them.
    """

    task: Task
    """World, start and goal."""
    scenario: Scenario
    """The robot and all else."""
    compare: tuple[FeedforwardName, ...] = ()
    """Feedforwards of further robots."""
    speed: float | None = None
    """Largest speed in m/s; by default 0.9 of the robot's."""
    margin: float = PLAN_MARGIN
    """Clearance that the plan keeps in m."""
    avoid: Avoid = "none"
    """Law that keeps the robot from obstacles that its map does not have."""

    def drive(self, progress: bool = False, **stages: Unpack[Stages]) -> Mission:
        """Drives the mission; see `navigate`."""
        return navigate(**{name: getattr(self, name) for name in type(self).model_fields}, progress=progress, **stages)


def order_of(folder: str | Path) -> Order:
    """Reads the order of a mission that was driven.

    Args:
        folder: What `mrctl navigate … --out` wrote.

    Raises:
        InputError: There is no mission in the folder, or one of an older version, which was not saved whole.
    """
    path = Path(folder) / "mission.json"
    if Path(folder).is_dir() and not path.exists():
        raise InputError(f"{folder}: holds no mission, as there is no mission.json in it")
    try:
        values = json.loads(read_file(path, MAX_BYTES))
    except (ValueError, RecursionError):
        raise InputError(f"{path}: is not JSON") from None
    known = values if isinstance(values, dict) else {}
    return Order.from_dict({name: known[name] for name in Order.model_fields if name in known}, str(path))


def again(folder: str | Path, progress: bool = False, **stages: Unpack[Stages]) -> Mission:
    """Drives a saved mission again, with the same bits, if the stages of the user that drove it are the same.

    Args:
        folder: What `mrctl navigate … --out` wrote.
        progress: Whether to show a progress bar.
        stages: The stages of the user that drove its first robot.

    Raises:
        InputError: Other stages drove it, or as `order_of` and `navigate`.
    """
    order = order_of(folder)
    expect_stages(stages, drove(folder, order), Path(folder))
    return order.drive(progress, **stages)


def drove(folder: str | Path, order: Order) -> dict[str, str]:
    """Returns the names of the stages of the user that drove a saved mission, by stage.

    Args:
        folder: Where it was saved.
        order: Its order.

    Raises:
        InputError: Its result is not there.
    """
    found = json.loads(open_result(Path(folder) / "result.zarr").attrs.get("stages", "{}"))
    return {stage: name for stage, name in found.items() if order.avoid == "none" or stage != "motion"}


def navigate(
    task: Task,
    scenario: Scenario,
    compare: Sequence[FeedforwardName] = (),
    speed: float | None = None,
    margin: float = PLAN_MARGIN,
    avoid: Avoid = "none",
    progress: bool = False,
    **stages: Unpack[Stages],
) -> Mission:
    """Plans a way among the obstacles on the map, and drives it with the hierarchy.

    The plan of a robot that can be driven backwards reverses where there is no way forward, but not with `window` and
    `mppi`, which go back only from where they are stuck.

    Args:
        task: World, map, start and goal.
        scenario: The robot and all else. Reference, laps, goal, obstacles, map and initial pose are those of the
            mission; with `window` and `mppi` the motion period is the multiple of the control period that is
            nearest to 0.05 s, and the prefilter, unless set, the shortest.
        compare: Feedforwards of further robots, which drive the same plan, each alone, without `stages`.
        speed: Largest speed in m/s; by default 0.9 of the robot's. With an avoider it is at most that
            from which it can stop within sight (`mrctl.navigation.planning.prepared`).
        margin: Clearance that the plan keeps in m.
        avoid: What keeps the robot from obstacles that are not on the map, or move, and which its lidar sees: nothing,
            so that it follows the plan in time (`none`), a filter that slows the time of the plan (`barrier`), or a
            motion stage that goes along the plan at its own pace (`window`, `mppi`).
        progress: Whether to show a progress bar.
        stages: The user's stages, as in `simulate`, of the first robot. A motion controller of the user is in the place
            of an avoider, so that it drives with `none` alone.

    Raises:
        InputError: The task is none, there is no such feedforward or avoider, the margin or the speed is out of range,
            start or goal is within the margin of an obstacle or off the map, the robot is at its goal, there is no way,
            the robot cannot drive the plan or would touch an obstacle on it, or a stage is refused, as in `simulate`.
    """
    if not isinstance(task, Task):
        raise InputError(f"task: must be a world with start and goal, such as `task_of` makes, not {task!r:.60}")
    for name in compare:
        if name not in FEEDFORWARDS:
            raise InputError(f"compare: {name!r} is none of {', '.join(FEEDFORWARDS)}")
    if avoid != "none" and stages.get("motion"):
        raise InputError(
            f"motion: your own motion controller cannot drive beside {avoid}, which is one; set avoid to none"
        )
    began = perf_counter()
    found, own = prepared(task, scenario, speed, margin, avoid)
    planning_time = perf_counter() - began
    others = [own.with_feedforward(name) for name in compare]
    result = _driven(own, others, avoid, progress, stages)
    driven = np.flatnonzero(np.isfinite(result["x"].values).any(axis=0))
    result = result.isel(time=slice(int(driven.max(initial=0)) + 1))
    return Mission(found, result, outcomes(result, task.goal, found), planning_time)


def _driven(own: Scenario, others: list[Scenario], avoid: Avoid, progress: bool, stages: Stages) -> xr.Dataset:
    """Drives the first robot, with the user's stages, and the others, without them."""
    avoider: Stages = {"motion": avoiding(avoid)} if avoid != "none" else {}
    if not any(stages.values()):
        return simulate([own, *others], progress=progress, **avoider)
    first = simulate([own], progress=progress, **(stages | avoider))
    if not others:
        return first
    rest = simulate(others, progress=progress, **avoider)
    whole = combine([([0], first), (range(1, 1 + len(others)), rest)], [own, *others])
    whole.attrs["stages"] = first.attrs["stages"]
    return whole


def outcomes(result: xr.Dataset, goal: Pose, found: Plan) -> pd.DataFrame:
    """Returns how each robot of a result fared, until it arrived, failed or was out of time.

    A robot has arrived when it is within 0.1 m and 0.2 rad of the goal and slower than 0.05 m/s (`arrived`).

    Args:
        result: What `simulate` returns.
        goal: x and y in m and θ in rad.
        found: The plan.

    Returns:
        A row for each robot: `outcome` (arrived, collided, stuck, out of time, or why it failed), `time` in s, `length`
        of its path in m, `spl`, success weighted by path length, ℓ / max(ℓ, length) or 0 unless it arrived, with the
        length ℓ of the plan (Anderson et al., "On evaluation of embodied navigation agents", 2018), the smallest
        `clearance` in m (0 after a collision), `position_rmse` in m to the plan in time, which says nothing of a robot
        that avoids, `jerk` in m/s³ (`jerk_of`), `energy` in J, and `expanded`, the number of poses that the search
        expanded.
    """
    runs, period, rows = as_runs(result), control_period(result), []
    for row in range(runs.sizes["run"]):
        driven = runs.isel(run=row).dropna("time", subset=["x"])
        there, failure = reached(driven, goal), driven["failure"].item()
        length = float(np.hypot(np.diff(driven["x"]), np.diff(driven["y"])).sum())
        away = driven["clearance"].values if "clearance" in driven else np.zeros(0)
        clearance = float(np.fmin.reduce(away, initial=np.inf))
        errors = driven["longitudinal_error"] ** 2 + driven["lateral_error"] ** 2
        rows.append({
            "outcome": "arrived" if there else {"": "out of time", "collision": "collided"}.get(failure, failure),
            "time": float(driven["failure_time"] if failure else driven["time"][-1]),
            "length": length,
            "spl": there * found.length / max(found.length, length),
            "clearance": 0.0 if failure == "collision" else clearance,  # the tick of the contact is not recorded
            "position_rmse": float(np.sqrt(errors.mean())) if len(errors) else np.nan,
            "jerk": jerk_of(np.column_stack([driven["x"].values, driven["y"].values]), period),
            "energy": float(driven["power"].sum()) * period,
            "expanded": found.expanded,
        })  # fmt: skip
    return pd.DataFrame(rows, index=pd.Index(runs["label"].values, name="label"))


def reached(run: xr.Dataset, goal: Pose) -> bool:
    """Returns whether a robot that did not fail has arrived at its goal when its run ends; `run` ends without NaN."""
    if run["failure"].item():
        return False  # perhaps in the first tick, so that there is no sample
    end = run.isel(time=-1)
    pose = np.array([float(end[name]) for name in ("x", "y", "theta")])
    return bool(arrived(pose, float(end["v"]), np.array(goal)))


def jerk_of(places: Array, period: float) -> float:
    """Returns the RMS of the jerk of a robot in m/s³: of the third derivative of its position in the world.

    It is the third difference of the position over steps of `JERK_STEP`, so that the vibration of single ticks, which
    says nothing about the ride, does not count; NaN for a run that is shorter than three of them.

    Args:
        places: x and y at each tick in m, `(T, 2)`.
        period: Control period in s.
    """
    n = max(1, round(JERK_STEP / period))
    count = max(0, len(places) - 3 * n)
    p, q, r, s = (places[k * n : k * n + count] for k in range(4))
    jerks = (s - 3 * r + 3 * q - p) / (n * period) ** 3
    return float(np.sqrt(np.mean(np.sum(jerks**2, axis=1)))) if len(jerks) else np.nan
