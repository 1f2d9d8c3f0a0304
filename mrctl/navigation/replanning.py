"""Plans that a robot makes on its way, around what it knows; the motion stages of missions share them."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from mrctl.kernel import Array
from mrctl.navigation.hybrid_astar import NoWay
from mrctl.navigation.sight import Sight
from mrctl.navigation.steer import CHECK_SPACING
from mrctl.navigation.vehicle import Vehicle
from mrctl.record import InputError
from mrctl.scenario import Scenario
from mrctl.theory.clearance import clearance
from mrctl.theory.obstacles import Outlines, Pose
from mrctl.theory.rays import Scan
from mrctl.theory.references import Reference, Waypoints

# m and rad: a robot that has moved by no more than that is where it was when there was no way; more than the noise.
# SAME_OBSTACLE is the distance in m for obstacles, more than half that of the discs that a scan shows. Chosen.
SAME_PLACE, SAME_HEADING, SAME_OBSTACLE = 0.02, 0.05, 0.06
FAILED_RETRY = 3.0  # s, after which a search that found no way is repeated in any case
BLOCKED_TIME = 0.3  # s for which a plan must be blocked by what stands: what moves seems to stand at first; chosen
HEADWAY_TIME = 1.0  # s without headway, after which a robot makes another plan; chosen
BLOCKED_RETRY = 1.0  # s, least time between two searches for a way around what blocks a plan; chosen
# a plan since the map has changed is taken if it needs less than this share of the time that is left
SHORTER_SHARE = 0.9

Replan = Callable[[Scenario, Vehicle, Array, Array, Outlines, Waypoints | None], Waypoints | None]
"""Plans for the mission of a scenario with its robot, from a pose in m, m, rad, `(3,)`, and a twist in m/s and rad/s,
`(2,)`, among obstacles as they are now, to the end of a plan that an event brought, or else to the goal of the mission;
raises `NoWay` where a search has found none, and returns None where there was none for another reason."""


def open_waypoints(reference: Reference) -> Waypoints:
    """Returns the reference of an event if it is a way with an end, such as a plan.

    Raises:
        InputError: It is another one, which robots with an avoider do not follow.
    """
    if not isinstance(reference, Waypoints) or reference.closed:
        raise InputError("reference: robots with an avoider follow open waypoints alone")
    return reference


def blocked_at(footprint: Array, poses: Array, way: Array, outlines: Outlines) -> int | None:
    """Returns the index of the first pose on a plan at which a robot would touch obstacles, or None.

    Args:
        footprint: Corners of the robot in its frame in m, `(n, 2)`.
        poses: Poses on the plan, x and y in m and θ in rad, `(k, 3)`.
        way: Length in m of the way up to each pose, `(k,)`; poses about 5 cm apart are looked at.
        outlines: The obstacles.
    """
    for k in np.searchsorted(way, np.arange(0.0, way[-1], CHECK_SPACING)):
        if clearance(footprint, poses[k], outlines) <= 0:
            return int(k)
    return None


class Planner:
    """Mission and knowledge of one robot, why it may need another plan, and the plans that it makes.

    Attributes:
        scenario: The mission.
        plans: The plan of the mission, and those that its events bring.
        first: The plan of the mission.
        sight: What the robot knows of its surroundings.
        vehicle: What its plans need to know of the robot itself.
        looked: Whether a scan came since this was last set to False; a robot that has failed gets none.
        map_changed: Whether the map has changed since a plan was last looked for, so that a shorter way may be free.
        blocked: Time in s since when its plan leads through something that stands and is not on the map; infinite where
            it does not.
        got_on: Time in s from which its waiting counts: when it last made headway, had no reason to, or looked for
            another plan because it had waited.
        tried: Time in s of the last search from which `BLOCKED_RETRY` counts; −∞ where the next one need not wait.
    """

    def __init__(self, replan: Replan, scenario: Scenario, sight: Sight, vehicle: Vehicle) -> None:
        """Takes what makes plans, and the attributes.

        Raises:
            InputError: The reference of the scenario, or of one of its events, is no plan.
        """
        self.scenario = scenario
        given = [event.reference for event in scenario.events if event.reference is not None]
        self.plans = [open_waypoints(plan) for plan in (scenario.reference, *given)]
        self.first = self.plans[0]
        self.sight, self.vehicle, self._replan = sight, vehicle, replan
        self.reset()

    @classmethod
    def each(cls, replan: Replan, scenarios: Sequence[Scenario]) -> list[Planner]:
        """Makes the planner of each robot of a batch, in which all are of the same kind."""
        vehicle, sights = Vehicle.of(scenarios[0]), Sight.each(scenarios)
        return [cls(replan, *own, vehicle) for own in zip(scenarios, sights, strict=True)]

    def reset(self) -> None:
        """Starts a run: forgets the plan that was taken, and all that scans have shown."""
        self._given: Waypoints | None = None  # the plan that came since the start
        # When, where, and among what, a search last found no way.
        self._hopeless: tuple[float, Array, Outlines] | None = None
        self.looked = self.map_changed = False
        self.blocked, self.got_on, self.tried = np.inf, 0.0, -np.inf
        self.sight.forget()

    def take(self, plan: Reference, now: float) -> Waypoints:
        """Takes the plan of an event at a time in s, to whose end all later plans lead; returns it.

        The robot may have waited at its goal until then, and is not stuck.

        Raises:
            InputError: It is no plan.
        """
        self._given, self._hopeless = open_waypoints(plan), None
        self.map_changed, self.got_on, self.tried = False, now, -np.inf
        return self._given

    def see(self, scan: Scan) -> bool:
        """Takes a scan; returns whether the map has changed."""
        changed = self.sight.see(scan)
        self.looked, self.map_changed = True, self.map_changed or changed
        return changed

    def look_ahead(self, poses: Array, way: Array, time: float) -> int | None:
        """Looks whether the rest of its plan is free of what stands beside the map, in a scan of a time in s.

        Returns:
            Index of the first pose that is blocked, or None; the other arguments are those of `blocked_at`.
        """
        place = None
        if len(self.sight.standing.discs) and len(poses) > 1:
            place = blocked_at(self.vehicle.footprint, poses, way, self.sight.standing)
        self.blocked = np.inf if place is None else min(self.blocked, time)
        return place

    def is_blocked(self, now: float) -> bool:
        """Tells whether its plan has been blocked for so long, at a time in s, that it is no passing finding."""
        return now - self.blocked >= BLOCKED_TIME

    @property
    def hopeless(self) -> bool:
        """Whether the last search found no way."""
        return self._hopeless is not None

    @property
    def goal(self) -> Pose | None:
        """Goal of the mission, x and y in m and θ in rad; None if there is none, or a plan came since."""
        return self.scenario.goal if self._given is None else None

    def plan(self, pose: Array, twist: Array, time: float, ahead: bool = False) -> Waypoints | None:
        """Makes a plan that keeps off what is not on the map, or else one that only does not touch it.

        Args:
            pose: x and y in m and θ in rad, from which it leads, `(3,)`.
            twist: V in m/s and θ̇ in rad/s with which it begins if the robot drives forward, `(2,)`; what the robot was
                asked for last, which has no noise.
            time: Time in s.
            ahead: Whether the robot asks while it drives on, because its plan is blocked farther ahead.

        Returns:
            The plan, or None where there is no way. A search that finds none takes far longer than one that does. It
            is repeated only after 3 s, or when the robot or an obstacle is elsewhere, and never while `ahead`.
        """
        if ahead and self._hopeless:
            return None
        self.map_changed = False
        near, far = self.sight.outlines(time), self.sight.around(time, self.vehicle.footprint, pose)
        if self._hopeless:
            since, there, known = self._hopeless
            if time - since < FAILED_RETRY and _same(there, known, pose, near):
                return None
        for outlines in (near,) if np.array_equal(near.discs, far.discs) else (far, near):
            try:
                if plan := self._replan(self.scenario, self.vehicle, pose, twist, outlines, self._given):
                    self._hopeless = None
                    return plan
            except NoWay:
                if outlines is near:
                    self._hopeless = time, pose.copy(), near
        return None


def _same(there: Array, before: Outlines, here: Array, now: Outlines) -> bool:
    """Tells whether pose and obstacles are the earlier ones but for noise, the radii of discs included."""
    turn = np.angle(np.exp(1j * (here[2] - there[2])))
    if (
        np.hypot(*(here[:2] - there[:2])) > SAME_PLACE
        or abs(turn) > SAME_HEADING
        or not np.array_equal(before.edges, now.edges)
    ):
        return False
    if not (len(before.discs) and len(now.discs)):
        return len(before.discs) == len(now.discs)
    away = np.linalg.norm(before.discs[:, None] - now.discs, axis=2)
    return bool(max(away.min(axis=0).max(), away.min(axis=1).max()) <= SAME_OBSTACLE)
