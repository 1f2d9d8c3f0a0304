"""Plans of missions: a way by hybrid A*, shortened, smoothed, timed, and checked for the robot that drives it."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from functools import partial
from typing import Literal, NamedTuple, get_args

import numpy as np

from mrctl.kernel import Array
from mrctl.loop.goals import ARRIVAL_SPEED, arrived
from mrctl.navigation.generators import Task
from mrctl.navigation.hybrid_astar import NoWay, plan, shortcut, space, wider
from mrctl.navigation.plan import Plan, least_clearance, run_out
from mrctl.navigation.rollouts import STEPS
from mrctl.navigation.vehicle import Vehicle
from mrctl.record import InputError
from mrctl.scenario import Scenario
from mrctl.sensing.lidar import Lidar
from mrctl.theory.clearance import clearance
from mrctl.theory.obstacles import Outlines, Surroundings
from mrctl.theory.references import MAX_COORDINATE, MIN_SPEED, Waypoints, check
from mrctl.theory.robot import ANY_ANGLE
from mrctl.theory.timing import LIMIT_SHARE, Limits

# turning radius of the plan over the robot's least one, for a spline turns tighter where an arc begins
RADIUS_FACTOR = 1.4
MIN_RADIUS = 0.25  # m, turning radius of the plan where a robot could turn on the spot
GENTLER_FACTOR = 1.2  # factor on that radius, for a second plan where the spline of the first steers beyond the limit
# factor on it where a plan may reverse; chosen when splines were straight at changes of direction
REVERSING_FACTOR = 2.0
CELLS_PER_WIDTH = 4  # of the search in the width of the robot
# time of a mission over that of its plan; WAITING_PATIENCE where something keeps it from obstacles
PATIENCE, WAITING_PATIENCE = 2, 4
PLAN_MARGIN = 0.05  # m, margin of a plan
REPLAN_MARGIN = 0.02  # m, margin of a plan that is made on the way, for the robot may be near an obstacle
REACTIVE_PERIOD = 0.05  # s, motion period of `window` and `mppi`, or the multiple of the control period nearest to it
MAX_BARRIER_PERIOD = 0.2  # s, longest motion period with `barrier`, a little above `REACTION_TIME`; chosen
# s from a scan until a robot brakes, for all avoiders: with `window` and `mppi` the wait for the next motion period,
# the change of the request over that period, and the lag of the robot
REACTION_TIME = 3 * REACTIVE_PERIOD

Avoid = Literal["none", "barrier", "window", "mppi"]
REACTIVE = "window", "mppi"
"""Motion stages that go along a plan at their own pace; their plans never reverse."""


def check_avoid(avoid: str) -> None:
    """Refuses what is none of the names in `Avoid`.

    Raises:
        InputError: It is none; the message lists them.
    """
    if avoid not in get_args(Avoid):
        raise InputError(f"avoid: {avoid!r} is none of {', '.join(get_args(Avoid))}")


class Query(NamedTuple):
    """A robot that asks for a way from a start to a goal."""

    task: Task
    """World, start and goal."""
    vehicle: Vehicle
    """The robot."""
    speed: float | None = None
    """Largest speed in m/s; by default 0.9 of the robot's."""
    margin: float = PLAN_MARGIN
    """Clearance that the plan keeps in m."""
    outlines: Outlines | None = None
    """The obstacles; by default those on the map."""
    twist: tuple[float, float] = (0.0, 0.0)
    """V in m/s and θ̇ in rad/s at the start."""
    keeps: bool = True
    """Whether the robot keeps the plan in time, and does not go along it at its own pace."""

    def check(self) -> None:
        """Refuses a margin, a speed or a place that is out of range, and a robot that is at its goal.

        Raises:
            InputError: The message says which.
        """
        for name, (x, y, _) in (("start", self.task.start), ("goal", self.task.goal)):
            if max(abs(x), abs(y)) > MAX_COORDINATE:
                raise InputError(f"{name}: x and y must be between ±{MAX_COORDINATE:,} m, not {x:g} and {y:g}")
        if arrived(np.array(self.task.start), 0.0, np.array(self.task.goal)):
            raise InputError("goal: the robot starts there")
        if not 0 <= self.margin <= 10:
            raise InputError(f"margin: must be between 0 and 10 m, not {self.margin:g}")
        fastest = self.vehicle.robot.max_speed
        if self.speed is not None and not MIN_SPEED <= self.speed <= fastest:
            raise InputError(f"speed: must be between {MIN_SPEED:g} and {fastest:g} m/s, not {self.speed:g}")


def prepared(
    task: Task,
    scenario: Scenario,
    speed: float | None = None,
    margin: float = PLAN_MARGIN,
    avoid: Avoid = "none",
    twist: tuple[float, float] = (0.0, 0.0),
) -> tuple[Plan, Scenario]:
    """Returns a plan, and the scenario that drives it.

    Args:
        task: World, map, start and goal.
        scenario: As for `mrctl.navigation.mission.navigate`.
        speed: Largest speed in m/s; by default 0.9 of the robot's. With an avoider it is at most
            `speed_in_sight`, and with `window` and `mppi` at most `speed_in_horizon`.
        margin: Clearance that the plan keeps in m.
        avoid: What keeps the robot from obstacles that its map does not have.
        twist: V in m/s and θ̇ in rad/s with which the robot drives at its start.

    Raises:
        InputError: As `planned`; or there is no such `avoid`, it reacts too late with that motion period or those
            brakes, or it never plans in reverse and forward there is no way.
    """
    check_avoid(avoid)
    reactive, vehicle = avoid in REACTIVE, Vehicle.of(scenario)
    query = Query(task, vehicle, speed, margin, twist=twist, keeps=not reactive)
    query.check()
    if avoid == "barrier" and scenario.motion_period > MAX_BARRIER_PERIOD:
        raise InputError(f"motion_period: barrier needs at most {MAX_BARRIER_PERIOD} s, not {scenario.motion_period:g}")
    if avoid != "none":
        fastest = LIMIT_SHARE * vehicle.robot.max_speed if speed is None else speed
        fastest = min(fastest, speed_in_sight(vehicle, scenario.sensing.lidar))
        query = query._replace(speed=min(fastest, speed_in_horizon(vehicle)) if reactive else fastest)
    try:
        found, reference = planned(query, reverse=vehicle.reverses and not reactive, beyond=True)
    except NoWay:
        if not (reactive and vehicle.reverses):
            raise
        _or_beyond(partial(_planned, query._replace(twist=(0.0, 0.0)), True))  # raises, too, if there is none
        raise InputError(f"avoid: {avoid} never plans in reverse, and forward there is no way; barrier may") from None
    laps = PATIENCE if avoid == "none" else WAITING_PATIENCE
    own = {"obstacles": task.obstacles, "map": task.map, "reference": reference, "laps": laps}
    if reactive:  # their request passes the prefilter without lag, unless a limit has acted
        tick = scenario.control_period
        shortest = max(tick, 0.01)  # s, that a scenario takes
        own |= {
            "motion_period": max(1, round(REACTIVE_PERIOD / tick)) * tick,
            "prefilter": scenario.prefilter or shortest,
        }
    return found, scenario.replace(**own, initial_pose=task.start, goal=task.goal)


def speed_in_sight(vehicle: Vehicle, lidar: Lidar) -> float:
    """Returns the largest speed in m/s from which a robot can stop before what stands where its lidar's range ends.

    It drives on for t, the time between two scans and `REACTION_TIME`, and brakes: V t + V²/(2 a) = d. The distance d
    is that from `REPLAN_MARGIN` before its front to the end of the range, and a is 0.9 of its largest acceleration.

    Raises:
        InputError: That speed is less than a plan can have.
    """
    front = float(vehicle.footprint[:, 0].max()) + REPLAN_MARGIN
    way, late = lidar.x + lidar.range - front, 1 / lidar.rate + REACTION_TIME
    brakes = LIMIT_SHARE * vehicle.robot.max_acceleration
    speed = brakes * (np.sqrt(late**2 + 2 * max(way, 0.0) / brakes) - late)
    if speed < MIN_SPEED:
        sees = f"with a range of {lidar.range:g} m and a rate of {lidar.rate:g} Hz"
        raise InputError(f"sensing.lidar: {sees} the robot cannot stop within what it sees")
    return float(speed)


def speed_in_horizon(vehicle: Vehicle) -> float:
    """Returns the V in m/s from which a robot can stop within a roll-out, else `window` and `mppi` would see too late.

    It drives on for `REACTION_TIME`, and brakes with 0.9 of its largest acceleration.

    Raises:
        InputError: That speed is less than a plan can have.
    """
    speed = LIMIT_SHARE * vehicle.robot.max_acceleration * (STEPS * REACTIVE_PERIOD - REACTION_TIME)
    if speed < MIN_SPEED:
        raise InputError(f"avoid: the brakes of the robot are too weak to stop within {STEPS * REACTIVE_PERIOD:.1f} s")
    return speed


def planned(query: Query, *, reverse: bool = False, beyond: bool = False) -> tuple[Plan, Waypoints]:
    """Returns the plan and its reference.

    The plan reverses only if it may, and where there is none forward that the robot can drive. It stays in the box
    around the map, with room to turn about start and goal. Where there is no way in it, in reverse neither, a plan that
    may go beyond goes around what stands at its border.

    The twist is that of the robot at the start, V in m/s and θ̇ in rad/s. If it drives forward, the plan begins with
    this twist: first the arc on which it drives, for as far as it needs to come to rest, and on from there, so that it
    can drive the plan whatever follows. Where that arc is within the margin of an obstacle, or no way leads on from it,
    the plan begins at the robot, straight and with the largest speed from which the limits can be kept; the robot is
    off it until it is as slow. A plan for a robot that goes along it at its own pace begins in this way, too.
    A plan for a robot that stands or reverses begins at rest.

    Args:
        query: Robot, start and goal, and what the plan keeps.
        reverse: Whether the plan may reverse.
        beyond: Whether the plan may go beyond the box around the map.

    Raises:
        NoWay: There is no way.
        InputError: The margin or the speed is out of range, start or goal is within the margin of an obstacle, off the
            map or out of range, the robot is at its goal, or it cannot drive the plan, or would touch an
            obstacle on it.
    """
    query.check()

    def either_way(around: bool) -> tuple[Plan, Waypoints]:
        try:
            return _planned(query, False, around)
        except InputError as fault:  # there is no way, or none that the robot can drive
            if not reverse:
                raise
            try:
                return _planned(query, True, around)
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


def _planned(query: Query, reverse: bool, around: bool) -> tuple[Plan, Waypoints]:
    """Returns a plan that only drives forward, or one that reverses wherever that is cheaper, and its reference.

    Args:
        query: What is asked for.
        reverse: Whether the plan may reverse.
        around: Whether the plan may go around what stands at the border of the box around the map.

    Raises:
        NoWay: There is no way; if it may go around, also where all ways from the goal stay in the box.
        InputError: Start or goal is within the margin of an obstacle, or the robot cannot drive the plan, or would
            touch an obstacle on it.
    """
    task, vehicle, speed, margin, outlines, twist, keeps = query
    known, (corners, robot, _) = task.known, vehicle
    speed = LIMIT_SHARE * robot.max_speed if speed is None else speed
    outlines = Surroundings(known).at(0.0) if outlines is None else outlines
    radius = max(MIN_RADIUS, RADIUS_FACTOR * abs(robot.wheelbase) / float(np.tan(robot.steering_limit))) * (
        REVERSING_FACTOR if reverse else 1
    )
    start, goal, limits = np.array(task.start), np.array(task.goal), Limits.of(robot)
    velocity, turn = twist if twist[0] > ARRIVAL_SPEED else (0.0, 0.0)
    arc, curvature = start[None], 0.0  # on which it comes to rest
    if velocity and keeps:
        curvature = float(np.clip(turn / velocity, -1 / radius, 1 / radius))
        arc = run_out(start, velocity, curvature, limits)
    ends = np.array([start[:2], arc[-1, :2], goal[:2]])
    low, high = ends.min(axis=0) - 3 * radius, ends.max(axis=0) + 3 * radius  # room to turn
    if known.shapes:
        low, high = np.minimum(low, known.bounds[0]), np.maximum(high, known.bounds[1])
    where = space(outlines, corners, low, high, cell=vehicle.width / CELLS_PER_WIDTH, margin=margin)
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
                found, reference = attempt(GENTLER_FACTOR * radius, arc, curvature)
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
