"""Missions: a robot gets a goal in a world, plans a path, drives it, and reports the outcome."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Sequence
from functools import partial
from math import pi, remainder
from pathlib import Path
from time import perf_counter
from typing import Any, Literal, NamedTuple

import numpy as np
import pandas as pd
import xarray as xr

from mrctl.kernel import Array
from mrctl.loop.goals import RESTING, arrived
from mrctl.loop.simulation import simulate
from mrctl.navigation import generators
from mrctl.navigation.generators import Task
from mrctl.navigation.maps import read_map
from mrctl.navigation.mppi import Mppi
from mrctl.navigation.pacing import Pacing
from mrctl.navigation.plan import Plan, least_clearance, run_out
from mrctl.navigation.planning import NoWay, plan, shortcut, space, wider
from mrctl.navigation.replanning import open_waypoints
from mrctl.navigation.sdf import read_sdf
from mrctl.navigation.vehicle import Vehicle
from mrctl.navigation.window import Window
from mrctl.physics.obstacles import read_mjcf
from mrctl.record import InputError, Record, read_file
from mrctl.results.metrics import as_runs, control_period
from mrctl.scenario import FEEDFORWARDS, FeedforwardName, Scenario
from mrctl.theory.clearance import clearance
from mrctl.theory.obstacles import Obstacles, Outlines, Pose, Surroundings
from mrctl.theory.references import SLOWEST, Waypoints, check
from mrctl.theory.robot import ANY_ANGLE, Robot
from mrctl.theory.timing import RESERVE, Limits

READERS: dict[str, Callable[[str], Obstacles]] = {
    ".toml": Obstacles.from_toml,
    ".yaml": lambda path: read_map(path).obstacles(),
    ".yml": lambda path: read_map(path).obstacles(),
    ".sdf": read_sdf,
    ".world": read_sdf,
    ".xml": read_mjcf,
}
# Openings are twice as wide as the robot; aisles, in which it also turns, are 2.5 times as wide as it is long. A bay,
# into which some robots go back and forth, is 2.5 times as long as the robot and 1.5 times as wide.
GENERATORS: dict[str, Callable[[float, float, int], Task]] = {
    "cellular": lambda length, width, seed: generators.cellular(seed),
    "corridor": lambda length, width, seed: generators.corridor(2 * width, seed),
    "slalom": lambda length, width, seed: generators.slalom(2 * width, seed),
    "doorway": lambda length, width, seed: generators.doorway(2 * width, seed),
    "warehouse": lambda length, width, seed: generators.warehouse(2.5 * length, seed),
    "parking_bay": lambda length, width, seed: generators.parking_bay(2.5 * length, 1.5 * width, seed),
}
ROOM = 1.4  # turning radius of the plan over the robot's least one, for a spline turns tighter where an arc begins
TIGHTEST = 0.25  # m, turning radius of the plan where a robot could turn on the spot
GENTLER = 1.2  # factor on that radius, for a second plan where the spline of the first steers beyond the limit
WIDER = 2.0  # factor on it where a plan may reverse; chosen when splines were straight at changes of direction
CELLS = 4  # of the search in the width of the robot
PATIENCE, WAITING = 2, 4  # time of a mission over that of its plan; WAITING where something keeps it from obstacles
MARGIN = 0.05  # m, margin of a plan
SLIM = 0.02  # m, margin of a plan that is made on the way, for the robot may be near an obstacle
PERIOD = 0.05  # s, motion period of `window` and `mppi`, or the multiple of the control period nearest to it

JERKED = 0.1  # s, step of the differences whose third is the jerk; chosen
LARGEST = 64 * 2**20  # bytes of a `mission.json`, which holds the obstacles of its world

Avoid = Literal["none", "barrier", "window", "mppi"]
REACTIVE = "window", "mppi"
"""Motion stages that go along a plan at their own pace; their plans never reverse."""


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
    """All that a mission is a function of, but for the files that it names, such as that of a robot.

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
    margin: float = MARGIN
    """Clearance that the plan keeps in m."""
    avoid: Avoid = "none"
    """Law that keeps the robot from obstacles that its map does not have."""

    def drive(self, progress: bool = False) -> Mission:
        """Drives the mission; see `navigate`."""
        return navigate(**{name: getattr(self, name) for name in type(self).model_fields}, progress=progress)


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
        values = json.loads(read_file(path, LARGEST))
    except ValueError:
        raise InputError(f"{path}: is not JSON") from None
    known = values if isinstance(values, dict) else {}
    return Order.from_dict({name: known[name] for name in Order.model_fields if name in known}, str(path))


def again(folder: str | Path, progress: bool = False) -> Mission:
    """Drives a saved mission again, with the same bits; arguments and errors are those of `order_of` and `navigate`."""
    return order_of(folder).drive(progress)


def task_of(
    world: str,
    scenario: Scenario,
    start: Pose | None = None,
    goal: Pose | None = None,
    known: str | None = None,
) -> Task:
    """Reads or makes a world.

    Args:
        world: TOML file of obstacles, yaml file of a ROS map, world in SDF or MJCF, or a generator with its seed, as
            `doorway:3`.
        scenario: Scenario with the robot, whose size sets the openings of all generators but `cellular`.
        start: x and y in m and θ in rad; by default that of the generator, or the origin.
        goal: x and y in m and θ in rad; by default that of the generator.
        known: File of the obstacles on the robot's map, as for a world; by default those that stand still.

    Raises:
        InputError: The world or the map cannot be read, no generator has that name, or there is no goal.
    """
    chart = None if known is None else obstacles_of(known, "map")
    name, colon, seed = world.partition(":")
    if colon and name in GENERATORS:
        if not (seed.isdecimal() and len(seed) < 10):
            raise InputError(f"world: {world}: the seed must be a whole number from 0 to 999999999, as in {name}:3")
        vehicle = Vehicle.of(scenario)
        made = GENERATORS[name](vehicle.length, vehicle.width, int(seed))
        return made.replace(start=start or made.start, goal=goal or made.goal, map=chart)
    obstacles = obstacles_of(world, "world", f" nor a generator with a seed, such as {':3, '.join(GENERATORS)}:3")
    if goal is None:
        raise InputError("goal: a world from a file needs one: x and y in m, θ in rad")
    return Task.from_dict({"obstacles": obstacles, "start": start or (0.0, 0.0, 0.0), "goal": goal, "map": chart})


def obstacles_of(path: str, what: str, other: str = "") -> Obstacles:
    """Reads obstacles from a file of one of the `READERS`.

    Args:
        path: The file.
        what: Name of the argument, for messages.
        other: What else the argument may be, for the message.

    Raises:
        InputError: The file cannot be read, or its name has another ending.
    """
    if not (read := READERS.get(Path(path).suffix.lower())):
        neither = "neither" if other else "not"
        raise InputError(f"{what}: {path} is {neither} a file that ends in {', '.join(READERS)}{other}")
    if not Path(path).is_file():
        raise InputError(f"{what}: no file {path}")
    return read(path)


def navigate(
    task: Task,
    scenario: Scenario,
    compare: Sequence[FeedforwardName] = (),
    speed: float | None = None,
    margin: float = MARGIN,
    avoid: Avoid = "none",
    progress: bool = False,
) -> Mission:
    """Plans a way among the obstacles on the map, and drives it with the hierarchy.

    The plan of a robot that can be driven backwards reverses where there is no way forward, but not with `window` and
    `mppi`, which go back only from where they are stuck.

    Args:
        task: World, map, start and goal.
        scenario: The robot and all else. Reference, laps, goal, obstacles, map and initial pose are those of the
            mission; with `window` and `mppi` the motion period is the multiple of the control period that is
            nearest to 0.05 s, and the prefilter, unless set, the shortest.
        compare: Feedforwards of further robots, which drive the same plan, each alone.
        speed: Largest speed in m/s; by default 0.9 of the robot's.
        margin: Clearance that the plan keeps in m.
        avoid: What keeps the robot from obstacles that are not on the map, or move, and which its lidar sees: nothing,
            so that it follows the plan in time (`none`), a filter that slows the time of the plan (`barrier`), or a
            motion stage that goes along the plan at its own pace (`window`, `mppi`).
        progress: Whether to show a progress bar.

    Raises:
        InputError: The task is none, there is no such feedforward, the margin is out of range, start or goal is within
            it of an obstacle or off the map, the robot is at its goal, there is no way, or the robot cannot drive the
            plan or would touch an obstacle on it.
    """
    if not isinstance(task, Task):
        raise InputError(f"task: must be a world with start and goal, such as `task_of` makes, not {task!r:.60}")
    for name in compare:
        if name not in FEEDFORWARDS:
            raise InputError(f"compare: {name!r} is none of {', '.join(FEEDFORWARDS)}")
    began = perf_counter()
    found, own = prepared(task, scenario, speed, margin, avoid)
    planning_time = perf_counter() - began
    others = [own.replace(name="", **FEEDFORWARDS[name]) for name in compare]
    result = simulate([own, *others], progress=progress, motion=avoiding(avoid))
    driven = np.flatnonzero(np.isfinite(result["x"].values).any(axis=0))
    result = result.isel(time=slice(int(driven[-1]) + 1))
    return Mission(found, result, outcomes(result, task.goal, found), planning_time)


def prepared(
    task: Task,
    scenario: Scenario,
    speed: float | None = None,
    margin: float = MARGIN,
    avoid: Avoid = "none",
    twist: tuple[float, float] = (0.0, 0.0),
) -> tuple[Plan, Scenario]:
    """Returns a plan, and the scenario that drives it; arguments and errors are those of `navigate`.

    The plan is made for a robot that drives with a twist at its start, V in m/s and θ̇ in rad/s; see `planned`.
    """
    reactive, vehicle = avoid in REACTIVE, Vehicle.of(scenario)
    backwards = vehicle.reverses and not reactive
    try:
        found, reference = planned(task, vehicle, speed, margin, None, backwards, twist, not reactive, beyond=True)
    except NoWay:
        if not (reactive and vehicle.reverses):
            raise
        in_reverse = partial(_planned, task, vehicle, speed, margin, None, True, (0.0, 0.0), True)
        _or_beyond(in_reverse)  # raises, too, if there is none
        raise InputError(f"avoid: {avoid} never plans in reverse, and forward there is no way; barrier may") from None
    laps = PATIENCE if avoid == "none" else WAITING
    own = {"obstacles": task.obstacles, "map": task.map, "reference": reference, "laps": laps}
    if reactive:  # the designed prefilter is that of Kanayama's controller, whose loop is faster
        tick = scenario.control_period
        shortest = max(tick, 0.01)  # s, that a scenario takes
        own |= {"motion_period": max(1, round(PERIOD / tick)) * tick, "prefilter": scenario.prefilter or shortest}
    return found, scenario.replace(**own, initial_pose=task.start, goal=task.goal)


def avoiding(avoid: Avoid, *, lag: float = 0.0) -> Callable[[Robot, int], Any] | None:
    """Returns the factory of the motion stage of missions, which bears the name in tables; None for that of mrctl.

    The scenarios that it drives are those that `prepared` returns for the same `avoid`; their missions may differ.

    Args:
        avoid: What keeps the robots from obstacles.
        lag: Time constant of the roll-outs of `mppi` in s; see `Mppi`.
    """
    if avoid == "none":
        return None

    def replan(
        scenario: Scenario, vehicle: Vehicle, pose: Array, twist: Array, outlines: Outlines, given: Waypoints | None
    ) -> Waypoints | None:
        plan = open_waypoints(scenario.reference)
        goal = scenario.goal if scenario.goal and given is None else end_of(given or plan)
        start = Task.from_dict({"obstacles": scenario.known, "start": pose.tolist(), "goal": goal})
        keeps, now = avoid not in REACTIVE, (float(twist[0]), float(twist[1]))
        back = keeps and vehicle.reverses
        try:
            return planned(start, vehicle, plan.speed, SLIM, outlines, back, now, keeps, beyond=True)[1]
        except NoWay:
            raise
        except InputError:  # it waits, and tries again
            return None

    def made(robot: Robot, size: int) -> Pacing | Window | Mppi:
        if avoid == "barrier":
            return Pacing(robot, size, replan)
        return Window(robot, size, replan) if avoid == "window" else Mppi(robot, size, replan, lag)

    made.__name__ = avoid
    return made


def end_of(plan: Waypoints) -> Pose:
    """Returns the pose at the end of a plan, x and y in m and θ in rad."""
    x, y, theta = plan.sample(np.array([plan.period])).pose[0].tolist()
    return x, y, remainder(theta, 2 * pi)


def planned(
    task: Task,
    vehicle: Vehicle,
    speed: float | None,
    margin: float,
    outlines: Outlines | None = None,
    reverse: bool = False,
    twist: tuple[float, float] = (0.0, 0.0),
    keeps: bool = True,
    beyond: bool = False,
) -> tuple[Plan, Waypoints]:
    """Returns the plan and its reference; arguments and errors are those of `navigate`.

    The outlines are by default those of the obstacles on the map. The plan reverses only if it may, and where there is
    none forward that the robot can drive. It stays in the box around the map, with room to turn about start and goal.
    Where there is no way in it, in reverse neither, a plan that may go beyond goes around what stands at its border.

    The twist is that of the robot at the start, V in m/s and θ̇ in rad/s. If it drives forward, the plan begins with
    this twist: first the arc on which it drives, for as far as it needs to come to rest, and on from there, so that it
    can drive the plan whatever follows. Where that arc is within the margin of an obstacle, or no way leads on from it,
    the plan begins at the robot, straight and with the largest speed from which the limits can be kept; the robot is
    off it until it is as slow. So does a plan for a robot that goes along it at its own pace, which it need not keep.
    A plan for a robot that stands or reverses begins at rest.
    """
    if arrived(np.array(task.start), 0.0, np.array(task.goal)):
        raise InputError("goal: the robot starts there")
    if not 0 <= margin <= 10:
        raise InputError(f"margin: must be between 0 and 10 m, not {margin:g}")
    fastest = vehicle.robot.max_speed
    if speed is not None and not SLOWEST <= speed <= fastest:
        raise InputError(f"speed: must be between {SLOWEST:g} and {fastest:g} m/s, not {speed:g}")

    def either_way(around: bool) -> tuple[Plan, Waypoints]:
        try:
            return _planned(task, vehicle, speed, margin, outlines, False, twist, keeps, around)
        except InputError as fault:  # there is no way, or none that the robot can drive
            if not reverse:
                raise
            try:
                return _planned(task, vehicle, speed, margin, outlines, True, twist, keeps, around)
            except NoWay:
                if isinstance(fault, NoWay):
                    raise
                raise fault from None  # a search has found a way, forward

    return _or_beyond(either_way) if beyond else either_way(False)


def _or_beyond(search: Callable[[bool], tuple[Plan, Waypoints]]) -> tuple[Plan, Waypoints]:
    """Searches in the box around the map, and where there is no way in it, around what stands at its border.

    Raises:
        NoWay: There is no way in the box, and none around either that the robot can drive.
    """
    try:
        return search(False)
    except NoWay as fault:
        if fault.at_border:
            with contextlib.suppress(InputError):
                return search(True)
        raise


def _planned(
    task: Task,
    vehicle: Vehicle,
    speed: float | None,
    margin: float,
    outlines: Outlines | None,
    reverse: bool,
    twist: tuple[float, float],
    keeps: bool,
    around: bool,
) -> tuple[Plan, Waypoints]:
    """Returns a plan that only drives forward, or one that reverses wherever that is cheaper, and its reference.

    Args:
        task: World, start and goal.
        vehicle: The robot.
        speed: Largest speed in m/s; by default 0.9 of the robot's.
        margin: Clearance that the plan keeps in m.
        outlines: The obstacles; by default those on the map.
        reverse: Whether the plan may reverse.
        twist: V in m/s and θ̇ in rad/s at the start.
        keeps: Whether the robot keeps the plan in time.
        around: Whether the plan may go around what stands at the border of the box around the map.

    Raises:
        NoWay: There is no way; if it may go around, also where all ways from the goal stay in the box.
        InputError: Start or goal is within the margin of an obstacle, or the robot cannot drive the plan, or would
            touch an obstacle on it.
    """
    known, (corners, robot, _) = task.known, vehicle
    speed = RESERVE * robot.max_speed if speed is None else speed
    outlines = Surroundings(known).at(0.0) if outlines is None else outlines
    radius = max(TIGHTEST, ROOM * abs(robot.wheelbase) / float(np.tan(robot.steering_limit))) * (
        WIDER if reverse else 1
    )
    start, goal, limits = np.array(task.start), np.array(task.goal), Limits.of(robot)
    velocity, turn = twist if twist[0] > RESTING else (0.0, 0.0)
    arc, curvature = start[None], 0.0  # on which it comes to rest
    if velocity and keeps:
        curvature = float(np.clip(turn / velocity, -1 / radius, 1 / radius))
        arc = run_out(start, velocity, curvature, limits)
    ends = np.array([start[:2], arc[-1, :2], goal[:2]])
    low, high = ends.min(axis=0) - 3 * radius, ends.max(axis=0) + 3 * radius  # room to turn
    if known.shapes:
        low, high = np.minimum(low, known.bounds[0]), np.maximum(high, known.bounds[1])
    where = space(outlines, corners, low, high, cell=vehicle.width / CELLS, margin=margin)
    if around:
        where = wider(where, goal, 3 * radius)

    def attempt(radius: float, arc: Array, curvature: float) -> tuple[Plan, Waypoints]:
        found = plan(where, arc[-1], goal, radius, reverse)
        found = shortcut(where, found, radius, reverse).after(arc)
        return found, found.reference(speed, limits, velocity=velocity, curvature=curvature)

    def after(arc: Array, curvature: float) -> tuple[Plan, Waypoints]:
        found, reference = attempt(radius, arc, curvature)
        try:
            check(reference, robot, reverse)
        except InputError as fault:
            check(reference, robot.replace(steering_limit=ANY_ANGLE), reverse)  # wider arcs help the steering alone
            try:
                found, reference = attempt(GENTLER * radius, arc, curvature)
                check(reference, robot, reverse)
            except InputError:
                raise fault from None
        if least_clearance(corners, reference, outlines) <= 0:
            raise InputError(
                f"plan: its smooth path touches an obstacle in spite of the margin of {margin:g} m; set more"
            )
        return found, reference

    if len(arc) > 1 and min(clearance(corners, pose, outlines) for pose in arc) > margin:
        with contextlib.suppress(InputError):  # no way leads on from it
            return after(arc, curvature)
    return after(start[None], 0.0)


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
        `clearance` in m (0 after a collision), `position_rmse` in m, `jerk` in m/s³ (`jerk_of`), `energy` in J, and
        `expanded`, the number of poses that the search expanded.
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

    It is the third difference of the position over steps of `JERKED`, so that the vibration of single ticks, which says
    nothing about the ride, does not count; NaN for a run that is shorter than three of them.

    Args:
        places: x and y at each tick in m, `(T, 2)`.
        period: Control period in s.
    """
    n = max(1, round(JERKED / period))
    p, q, r, s = (places[k * n : len(places) - (3 - k) * n] for k in range(4))
    jerks = (s - 3 * r + 3 * q - p) / (n * period) ** 3
    return float(np.sqrt(np.mean(np.sum(jerks**2, axis=1)))) if len(jerks) else np.nan
