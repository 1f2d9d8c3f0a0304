"""The motion stage that `window` and `mppi` share: it follows a plan, makes another one, and goes back where stuck."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Sequence

import numpy as np

from mrctl.kernel import Array
from mrctl.loop.goals import arrived
from mrctl.navigation.chart import RADIUS
from mrctl.navigation.rollouts import KEPT, STEPS, Bounds, Considered, Scene
from mrctl.navigation.sight import Sight
from mrctl.navigation.trail import Trail
from mrctl.navigation.vehicle import reverses, robot_of
from mrctl.record import InputError
from mrctl.scenario import Scenario
from mrctl.theory.clearance import cover
from mrctl.theory.grid import Field, near_field
from mrctl.theory.obstacles import Outlines
from mrctl.theory.rays import Scan
from mrctl.theory.references import Reference, Waypoints
from mrctl.theory.robot import Robot

CELL = 0.04  # m, of the distance field
AROUND = 3.0  # m around the plan, which the field covers
DISCS = 4  # that cover the robot
AHEAD = 100  # samples of the plan, 20 motion periods, among which its nearest place is looked for
FINE = 5  # samples of the plan in a motion period
OFF = 0.6  # m from its plan, beyond which a robot makes another one; chosen, like the next two
WAITED = 1.0, 0.05  # s and m: so does one that within this time gets no farther than this
RETRY = 1.0  # s, least time between two plans
STAYS = 1.0  # s at the end of its plan, after which a robot without a goal at which its run ends stays there; chosen
# How a robot goes back from where there is no way forward; chosen, as all that follows.
BACK = 0.4, 0.4  # m, length of a piece of the way back, after which it looks for another plan; m/s, its speed there
PIECES = 5  # largest number of pieces
FREE = 0.02  # m, clearance from what is not on the map while it goes back
SHORTER = 0.9  # a plan since the map has changed is taken if it needs less than this share of the time that is left

Replan = Callable[[Scenario, Array, Outlines, Waypoints | None], Waypoints | None]
"""Plans for the mission of a scenario, from a pose in m, m, rad, `(3,)`, among obstacles as they are now, to the end of
a plan that an event brought, or else to the goal of the mission; None where there is no way."""


def open_waypoints(reference: Reference) -> Waypoints:
    """Returns the reference of an event if it is a way with an end, such as a plan.

    Raises:
        InputError: It is another one, which robots with an avoider do not follow.
    """
    if not isinstance(reference, Waypoints) or reference.closed:
        raise InputError("reference: robots with an avoider follow open waypoints alone")
    return reference


def plan_around(
    replan: Replan,
    scenario: Scenario,
    sight: Sight,
    time: float,
    footprint: Array,
    pose: Array,
    given: Waypoints | None,
) -> Waypoints | None:
    """Makes a plan that keeps off what is not on the map, or else one that only does not touch it.

    Args:
        replan: Makes a plan to the goal.
        scenario: The mission.
        sight: What the robot knows.
        time: Time in s.
        footprint: Its corners in its frame in m, `(n, 2)`.
        pose: x and y in m and θ in rad, from which it plans, `(3,)`.
        given: The plan that came since the start, or None.
    """
    far = replan(scenario, pose, sight.around(time, footprint, pose), given)
    return far or replan(scenario, pose, sight.outlines(time), given)


class Reactive(ABC):
    """A motion stage that asks for twists along a plan, and makes another plan when it is off this one or waits.

    Where a robot waits that can reverse, and another plan is not found or does not help, it goes back a little on its
    `Trail`, and plans again.

    Attributes:
        bounds: What twists each robot can drive.
        last: The last twist of each robot, `(B, 2)`.
        considered: What led to it, for each robot; None before the first one, and while the robot goes back.
    """

    def __init__(self, robot: Robot, size: int, replan: Replan) -> None:
        """Makes the stage.

        Args:
            robot: Nominal robot.
            size: Number of robots B.
            replan: Makes a plan to the goal.
        """
        self._robot, self._size, self._replan = robot, size, replan

    def assign(self, scenarios: Sequence[Scenario]) -> None:
        """Takes the missions of the robots, with their maps and with their plans as references."""
        self._scenarios, self._own = scenarios, [open_waypoints(scenario.reference) for scenario in scenarios]
        self._sights = Sight.each(scenarios)
        self._footprint, self._reverses = robot_of(scenarios[0])[0], reverses(scenarios[0])
        self.bounds = [Bounds.of(self._robot, plan.speed) for plan in self._own]
        self._discs = cover(self._footprint, DISCS)
        self._body = float((np.hypot(self._discs[:, 0], self._discs[:, 1]) + self._discs[:, 2]).max())

    def _field_around(self, places: Array, row: int) -> Field:
        """Returns the distance from the map of one robot around places on a plan, `(n, 2)` in m."""
        low, high = places.min(axis=0) - AROUND, places.max(axis=0) + AROUND
        return near_field(self._sights[row].map, low, high, CELL, self._body + KEPT + 2 * CELL)

    def reset(self, pose: Array, reference: Array, period: float) -> None:
        """Starts a run; the arguments are those of `mrctl.control.stages.Motion`."""
        self._period, self._tick, self._place = period, 0, np.zeros(self._size, int)
        for sight in self._sights:
            sight.forget()
        self._tables, self._fields = [self._sampled(plan) for plan in self._own], []
        fields: dict[Hashable, Field] = {}
        for row, own in enumerate(zip(self._own, (scenario.known for scenario in self._scenarios), strict=True)):
            if own not in fields:
                places = own[0].sample(np.linspace(0, own[0].period, 200)).pose[:, :2]
                fields[own] = self._field_around(places, row)
            self._fields.append(fields[own])
        self._given: list[Waypoints | None] = [None] * self._size  # plans that came since the start
        self._anchor, self._since = pose[:, :2].copy(), np.zeros(self._size)
        self._tried = np.full(self._size, -np.inf)  # when they last looked for another plan
        self._arrived = np.full(self._size, np.inf)  # when they arrived at the ends of their plans
        self._waited = np.zeros(self._size, bool)  # which have made another plan where they are
        self._approached = np.zeros(self._size, bool)  # which have gone back from a goal at which they did not arrive
        self._pieces = np.zeros(self._size, int)  # of the way back from `_anchor`, for robots that go back
        self._trails = [Trail(self._footprint, min(BACK[1], own.speed / 2), own.curvature) for own in self.bounds]
        self.last = np.zeros((self._size, 2))
        self._map_changed = np.zeros(self._size, bool)  # so that a shorter way may be free
        self._looked = np.zeros(self._size, bool)  # which robots have a scan that is new; those that failed have none
        self.considered: list[Considered | None] = [None] * self._size

    def _sampled(self, plan: Waypoints) -> Array:
        """Returns a plan as rows of `Scene.targets`, `FINE` in a motion period."""
        count = int(np.ceil(plan.period / self._period)) * FINE + 1
        poses = plan.sample(self._period / FINE * np.arange(count + 1.0)).pose
        return np.column_stack([poses[:, :2], np.cos(poses[:, 2]), np.sin(poses[:, 2])])

    def follow(self, row: int, plan: Reference) -> None:
        """Takes another plan for one robot, which is a way to another goal."""
        self._given[row] = plan = open_waypoints(plan)
        self._take(row, plan)
        self._since[row] = self._period * self._tick  # it may have waited at its goal, and is not stuck
        self._waited[row] = self._approached[row] = self._map_changed[row] = False
        self._pieces[row] = 0

    def _take(self, row: int, plan: Waypoints) -> None:
        """Lets a robot go along a plan, with a field that reaches as far."""
        self._tables[row] = table = self._sampled(plan)
        self._place[row] = 0
        low, high = table[:, :2].min(axis=0), table[:, :2].max(axis=0)
        distance, origin, resolution = self._fields[row]
        end, room = origin + resolution * np.array(distance.shape[::-1]), self._body + KEPT
        if (low - room < origin).any() or (high + room > end).any():
            self._fields[row] = self._field_around(table[:, :2], row)

    def see(self, row: int, scan: Scan) -> None:
        """Takes a scan of one robot; the arguments are those of `mrctl.control.stages.Motion`."""
        self._looked[row] = True
        if self._sights[row].see(scan):
            self._fields[row] = self._field_around(self._tables[row][:, :2], row)
            self._map_changed[row] = True

    def output(self, pose: Array, twist: Array, reference: Array) -> Array:
        """Returns twists that the robots can drive, `(B, 2)`; arguments are those of `mrctl.control.stages.Motion`."""
        self.begin(self._tick)
        for row in range(self._size):
            table, first = self._tables[row], self._place[row]
            away = np.hypot(*(table[first : first + AHEAD, :2] - pose[row, :2]).T)
            self._place[row] = first + int(away.argmin())
            if self._stands(row, pose[row], float(twist[row, 0])):
                self.last[row] = 0.0
                self.considered[row] = None
                continue
            if self._goes_back(row, pose[row], float(away.min())):
                self.considered[row] = None
                continue
            table = self._tables[row]
            targets = table[np.minimum(self._place[row] + FINE * np.arange(1, STEPS + 1), len(table) - 1)]
            scene = Scene(targets, self._discs, self._fields[row], self._near(row, pose[row]))
            self.last[row] = self.choose(row, pose[row], twist[row], self.last[row], self._period, scene)
        self._tick += 1
        return self.last.copy()

    def _at_end(self, row: int, pose: Array, speed: float = 0.0) -> bool:
        """Tells whether a robot is at the end of its plan, at a speed in m/s at which it has arrived."""
        x, y, c, s = self._tables[row][-1]
        return bool(arrived(pose, speed, np.array([x, y, np.arctan2(s, c)])))

    def _stands(self, row: int, pose: Array, speed: float) -> bool:
        """Tells whether a robot has arrived at the end of its plan a while ago, and stays until something moves it.

        Roll-outs never go back, so that their mean would let it creep on and come round again. Where the run ends at a
        goal, a robot that drives on is not there yet, whatever it believes, and does not stay.
        """
        now = self._period * self._tick
        if self._scenarios[row].goal is not None or not self._at_end(row, pose):
            self._arrived[row] = np.inf
        elif self._at_end(row, pose, speed):
            self._arrived[row] = min(self._arrived[row], now)
        return now - self._arrived[row] > STAYS

    def _needs_plan(self, row: int, pose: Array, away: float) -> bool:
        """Notes how far a robot has come; tells whether it needs another plan.

        It does where it is `away` m off its own, or has hardly moved for a while; at the end of its plan it needs none.
        """
        now = self._period * self._tick
        if self._at_end(row, pose):
            self._since[row] = now
        if np.hypot(*(pose[:2] - self._anchor[row])) > WAITED[1]:
            self._anchor[row], self._since[row], self._waited[row] = pose[:2], now, False
        lost = (away > OFF or now - self._since[row] > WAITED[0]) and now - self._tried[row] > RETRY
        lost, self._looked[row] = lost and self._looked[row], False
        if lost:
            self._tried[row] = now
        return lost

    def _goes_back(self, row: int, pose: Array, away: float) -> bool:
        """Gives a robot another plan if it needs one; tells whether it goes back instead, with the twist `last`."""
        if not np.isfinite(pose).all():
            return False
        pieces = self._pieces[row]
        if pieces:
            gone = float(np.hypot(*(pose[:2] - self._anchor[row])))
            if gone < pieces * BACK[0] and self._back(row, pose):
                return True
            self.last[row] = 0.0
        else:
            self._trails[row].add(pose)
            if not self._needs_plan(row, pose, away):
                self._shorten(row, pose)
                return False
        other = self._planned(row, pose)
        in_vain = not pieces and self._waited[row]  # what it got where it waits did not help it
        self._waited[row], self._pieces[row] = away <= OFF, 0
        alone = not len(self._sights[row].moving(self._period * self._tick).discs)  # what moves may let it pass
        stuck = alone and (pieces or away <= OFF) and (in_vain or not other)
        at_end = self._place[row] > len(self._tables[row]) - 1 - FINE
        if self._reverses and stuck and pieces < PIECES and not (at_end and self._approached[row]):
            self._pieces[row] = (pieces + 1) * self._back(row, pose)
            self._approached[row] |= at_end
        elif other:
            self._take(row, other)
        return self._pieces[row] > 0

    def _shorten(self, row: int, pose: Array) -> None:
        """Gives a robot whose map has changed another plan, if that takes less time than the rest of its own."""
        now, left = self._period * self._tick, self._period / FINE * (len(self._tables[row]) - 1 - self._place[row])
        if self._map_changed[row] and now - self._tried[row] > RETRY:
            self._tried[row] = now
            if (other := self._planned(row, pose)) and other.period < SHORTER * left:
                self._take(row, other)

    def _back(self, row: int, pose: Array) -> bool:
        """Lets `last` be the twist with which a robot goes back; returns whether it can."""
        twist = self._trails[row].back(pose, self._sights[row].outlines(self._period * self._tick, FREE - RADIUS))
        if twist is not None:
            self.last[row] = twist
        return twist is not None

    def _planned(self, row: int, pose: Array) -> Waypoints | None:
        """Makes a plan from where a robot is, around what it knows."""
        self._map_changed[row] = False
        own, now = (self._scenarios[row], self._sights[row]), self._period * self._tick
        return plan_around(self._replan, *own, now, self._footprint, pose, self._given[row])

    def begin(self, tick: int) -> None:  # noqa: B027 (most have nothing to do)
        """Is called once in a motion period, before `choose` for each robot."""

    @abstractmethod
    def choose(self, row: int, pose: Array, twist: Array, last: Array, period: float, scene: Scene) -> Array:
        """Returns the twist of one robot.

        Args:
            row: Which robot.
            pose: x and y in m and θ in rad, `(3,)`.
            twist: The twist that it drives, as measured, V in m/s and θ̇ in rad/s, `(2,)`.
            last: The twist that was requested in the last period, V in m/s and θ̇ in rad/s, `(2,)`.
            period: Motion period in s, which is also a step of a roll-out.
            scene: What it sees.
        """

    def _near(self, row: int, pose: Array) -> Array:
        """Returns the discs that a robot has found and could meet within a roll-out, as in `Scene.movers`."""
        found, horizon = self._sights[row].discs(self._period * self._tick), self._period * STEPS
        reach = (self._body + KEPT) + horizon * (self.bounds[row].speed + np.hypot(found[:, 2], found[:, 3]))
        return found[np.hypot(*(found[:, :2] - pose[:2]).T) < reach + found[:, 4]]
