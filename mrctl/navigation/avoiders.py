"""The motion stages of missions by the names of `--avoid`."""

from __future__ import annotations

from collections.abc import Callable
from math import pi, remainder
from typing import Any

import numpy as np

from mrctl.kernel import Array
from mrctl.navigation.generators import Task
from mrctl.navigation.hybrid_astar import NoWay
from mrctl.navigation.mppi import LAG, Mppi
from mrctl.navigation.pacing import Pacing
from mrctl.navigation.planning import REACTIVE, REPLAN_MARGIN, Avoid, Query, check_avoid, planned
from mrctl.navigation.replanning import open_waypoints
from mrctl.navigation.vehicle import Vehicle
from mrctl.navigation.window import Window
from mrctl.record import InputError
from mrctl.scenario import Scenario
from mrctl.theory.obstacles import Outlines, Pose
from mrctl.theory.references import Waypoints
from mrctl.theory.robot import Robot


def avoiding(avoid: Avoid, *, lag: float = LAG) -> Callable[[Robot, int], Any] | None:
    """Returns the factory of the motion stage of missions, which bears the name in tables; None for that of mrctl.

    The scenarios that it drives are those that `prepared` returns for the same `avoid`; their missions may differ.

    Args:
        avoid: What keeps the robots from obstacles.
        lag: Time constant of the roll-outs of `mppi` in s; see `Mppi`.

    Raises:
        InputError: There is no such name.
    """
    check_avoid(avoid)
    if avoid == "none":
        return None

    def replan(
        scenario: Scenario, vehicle: Vehicle, pose: Array, twist: Array, outlines: Outlines, given: Waypoints | None
    ) -> Waypoints | None:
        plan = given or open_waypoints(scenario.reference)
        goal = scenario.goal if scenario.goal and given is None else end_of(plan)
        x, y, theta = pose.tolist()
        here = x, y, remainder(theta, 2 * pi)
        start = Task.from_dict({"obstacles": scenario.known, "start": here, "goal": goal})
        keeps, now = avoid not in REACTIVE, (float(twist[0]), float(twist[1]))
        try:
            query = Query(start, vehicle, plan.speed, REPLAN_MARGIN, outlines, now, keeps)
            return planned(query, reverse=keeps and vehicle.reverses, beyond=True)[1]
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
