"""The motion stage that `window` and `mppi` share: it follows a plan, makes another one, and goes back where stuck."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Hashable, Sequence

import numpy as np

from mrctl.kernel import Array
from mrctl.loop.goals import arrived
from mrctl.navigation.chart import PLACE_RADIUS
from mrctl.navigation.replanning import BLOCKED_RETRY, HEADWAY_TIME, SHORTER_SHARE, Planner, Replan
from mrctl.navigation.rollouts import NEAR_DISTANCE, STEPS, Bounds, Considered, Scene
from mrctl.navigation.sight import Sight
from mrctl.navigation.trail import Trail
from mrctl.record import InputError
from mrctl.scenario import Scenario
from mrctl.theory.clearance import cover
from mrctl.theory.grid import Field, near_field
from mrctl.theory.rays import Scan
from mrctl.theory.references import Reference, Waypoints
from mrctl.theory.robot import Robot

FIELD_CELL = 0.04  # m, of the distance field
FIELD_MARGIN = 3.0  # m around the plan, which the field covers
BODY_DISCS = 4, 2  # in a row, and rows, that cover the robot, and reach 4 to 6 cm beyond its nose
SEARCHED_SAMPLES = 100  # samples of the plan, 20 motion periods, among which its nearest place is looked for
SAMPLES_PER_PERIOD = 5  # samples of the plan in a motion period
MAX_PLAN_DISTANCE = 0.6  # m from its plan, beyond which a robot makes another one; chosen
# m, and share of the way at full speed in the time HEADWAY_TIME: a robot makes headway if it covers the smaller one;
# chosen
MIN_HEADWAY, MIN_HEADWAY_SHARE = 0.05, 0.5
# s at the end of its plan, after which a robot without a goal at which its run ends stays there; chosen
STAY_TIME = 1.0
# How a robot goes back from where there is no way forward; chosen, as all that follows.
BACK_PIECE = 0.4  # m, length of a piece of the way back, after which it looks for another plan
BACK_SPEED = 0.4  # m/s, at most
MAX_BACK_PIECES = 10  # largest number of pieces, as far as the `Trail` reaches
BACK_CLEARANCE = 0.02  # m, clearance from what is not on the map while it goes back


class Agent:
    """One robot on its plan: how far it has come, when it needs another plan, and how it goes back where it is stuck.

    Attributes:
        planner: Its mission, and what it knows.
        bounds: What twists it can drive; the largest V is that of the way that it was given last.
        last: The twist that it was last asked for, V in m/s and θ̇ in rad/s, `(2,)`.
        passes: Whether the twists that were chosen last lead around what blocks its plan.
    """

    def __init__(
        self, planner: Planner, bounds: Bounds, discs: Array, field: Field, start: Array, period: float
    ) -> None:
        """Starts a run.

        Args:
            planner: Its mission, and what it knows.
            bounds: What twists it can drive.
            discs: Discs that cover it, as in `Scene`.
            field: Distance from the map around its first plan.
            start: x and y in m where it is, `(2,)`.
            period: Motion period in s.
        """
        self.planner, self.bounds, self._discs = planner, bounds, discs
        self._field, self._reach, self._period = field, reach(discs), period
        self.last, self.passes = np.zeros(2), False
        self._table, self._place, self._away = self._sampled(planner.first), 0, 0.0  # its plan, and its place on that
        self._anchor = start.copy()  # where it last was when it had got on
        self._replanned = False  # whether it has made another plan since
        self._arrived = np.inf  # when it arrived at the end of its plan
        self._trail = Trail(planner.vehicle.footprint, bounds.curvature, bounds.acceleration)
        self._pieces = 0  # of the way back from `_anchor`, while it goes back
        self._approached = False  # whether it has gone back from a goal at which it did not arrive

    def _sampled(self, plan: Waypoints) -> Array:
        """Returns a plan as rows of `Scene.targets`, `SAMPLES_PER_PERIOD` in a motion period.

        Raises:
            InputError: The plan reverses.
        """
        _refuse_reverse(plan)
        count = int(np.ceil(plan.period / self._period)) * SAMPLES_PER_PERIOD + 1
        poses = plan.sample(self._period / SAMPLES_PER_PERIOD * np.arange(count + 1.0)).pose
        return np.column_stack([poses[:, :2], np.cos(poses[:, 2]), np.sin(poses[:, 2])])

    def follow(self, plan: Reference, now: float) -> None:
        """Takes a plan to another goal at a time in s."""
        taken = self.planner.take(plan, now)
        self.bounds = self.bounds._replace(speed=taken.speed)
        self._take(taken)
        self._replanned = self._approached = False
        self._pieces, self._arrived = 0, np.inf

    def _take(self, plan: Waypoints) -> None:
        """Goes along a plan from now on; where the distance field ends before the plan does, makes another field."""
        self._table, self._place, self.planner.blocked = self._sampled(plan), 0, np.inf
        low, high = self._table[:, :2].min(axis=0), self._table[:, :2].max(axis=0)
        distance, origin, resolution = self._field
        end = origin + resolution * np.array(distance.shape[::-1])
        if (low - self._reach < origin).any() or (high + self._reach > end).any():
            self._field = field_around(self._table[:, :2], self.planner.sight, self._reach)

    def see(self, scan: Scan) -> None:
        """Takes a scan, and looks whether its plan is free."""
        if self.planner.see(scan):
            self._field = field_around(self._table[:, :2], self.planner.sight, self._reach)
        rest = self._table[self._place :]
        poses = np.column_stack([rest[:, :2], np.arctan2(rest[:, 3], rest[:, 2])])
        way = np.append(0.0, np.cumsum(np.hypot(*np.diff(rest[:, :2], axis=0).T)))
        self.planner.look_ahead(poses, way, scan.time)

    def locate(self, pose: Array) -> None:
        """Finds the place on the plan that is nearest to a pose in m, m, rad, `(3,)`, of those not far ahead."""
        away = np.hypot(*(self._table[self._place : self._place + SEARCHED_SAMPLES, :2] - pose[:2]).T)
        self._place, self._away = self._place + int(away.argmin()), float(away.min())

    def scene(self, pose: Array, now: float) -> Scene:
        """Returns what roll-outs from a pose in m, m, rad, `(3,)`, are judged by at a time in s."""
        last = len(self._table) - 1
        places = self._place + SAMPLES_PER_PERIOD * np.arange(1, STEPS + 1)
        targets, end = self._table[np.minimum(places, last)], 1 + int(np.searchsorted(places, last))
        return Scene(targets, self._discs, self._field, self._near(pose, now), end)

    def _near(self, pose: Array, now: float) -> Array:
        """Returns the discs beside the map that the robot could meet on its roll-outs, `(M, 5)` as of `Sight.discs`."""
        found, horizon = self.planner.sight.discs(now), self._period * STEPS
        far = self._reach + horizon * (self.bounds.speed + np.hypot(found[:, 2], found[:, 3])) + found[:, 4]
        return found[np.hypot(*(found[:, :2] - pose[:2]).T) < far]

    def stands(self, pose: Array, speed: float, now: float) -> bool:
        """Tells whether it arrived at the end of its plan a while ago; then it rests there until something moves it.

        Roll-outs never go back, so that their mean would let it creep on and come round again. Where the run ends at a
        goal, a robot that drives on is not there yet, whatever it believes, and does not stay.

        Args:
            pose: x and y in m and θ in rad, `(3,)`.
            speed: V in m/s.
            now: Time in s.
        """
        if self.planner.scenario.goal is not None or not self._at_end(pose):
            self._arrived = np.inf
        elif self._at_end(pose, speed):
            self._arrived = min(self._arrived, now)
        if stands := now - self._arrived > STAY_TIME:
            self.last = np.zeros(2)
        return stands

    def _at_end(self, pose: Array, speed: float = 0.0) -> bool:
        """Tells whether a pose is where the plan leads, at a speed in m/s at which the robot has arrived.

        That is the goal of the mission, unless another plan came since.
        """
        x, y, c, s = self._table[-1]
        return bool(arrived(pose, speed, np.array(self.planner.goal or (x, y, np.arctan2(s, c)))))

    def goes_back(self, pose: Array, now: float) -> bool:
        """Looks for another plan where it needs one; tells whether it goes back instead, with the twist `last`.

        Args:
            pose: x and y in m and θ in rad, `(3,)`.
            now: Time in s.
        """
        if not np.isfinite(pose).all():
            return False
        if self._pieces:
            if self._gone(pose) < self._pieces * BACK_PIECE and self._back(pose, now):
                return True
            self.last = np.zeros(2)
        else:
            self._trail.add(pose)
            if not self.needs_plan(pose, now):
                self._shorten(pose, now)
                return False
        near, waits = self._away <= MAX_PLAN_DISTANCE, self._waits(now)
        other = self.planner.plan(pose, self.last, now, ahead=near and not waits and not self._pieces)
        # Before it goes back, it is stuck also where the plan that it got here did not help it.
        stuck = other is None if self._pieces else near and waits and (other is None or self._replanned)
        self._replanned = near and waits
        if stuck and self._may_go_back(pose, now):
            self._approached |= self._near_end
            self._pieces = self._pieces + 1 if self._back(pose, now) else 0
        else:
            self._pieces = 0
            if other:
                self._take(other)
        return self._pieces > 0

    def has_no_way(self, pose: Array, now: float) -> bool:
        """Tells whether it stands, with `last` zero: what stands blocks its plan, and a search has found no other.

        Else it would creep towards that, since with the noise of the lidar a small step forward looks free now and
        then, and no twist leads back.

        Args:
            pose: x and y in m and θ in rad, `(3,)`.
            now: Time in s.
        """
        blocked = self.planner.hopeless and self.planner.is_blocked(now) and self._waits(now)
        if stands := blocked and not self._near(pose, now)[:, 2:4].any():
            self.last = np.zeros(2)
        return stands

    def needs_plan(self, pose: Array, now: float) -> bool:
        """Notes how far it has come, at a time in s; tells whether it needs another plan, and can make one.

        It needs one where its twists do not lead around what blocks its plan, where it is off its plan, or where it has
        hardly moved for a while; at the end of its plan it needs none.
        """
        if self._at_end(pose):
            self.planner.got_on, self.planner.blocked = now, np.inf
        if self._gone(pose) > min(MIN_HEADWAY, MIN_HEADWAY_SHARE * HEADWAY_TIME * self.bounds.speed):
            self._anchor, self.planner.got_on, self._replanned = pose[:2].copy(), now, False
        blocked = self.planner.is_blocked(now) and not self.passes
        needs = blocked or self._away > MAX_PLAN_DISTANCE or self._waits(now)
        can = self.planner.looked and now - self.planner.tried > BLOCKED_RETRY
        self.planner.looked = False
        if needs and can:
            self.planner.tried = now
        return needs and can

    def _waits(self, now: float) -> bool:
        """Tells whether it has hardly moved for a while."""
        return now - self.planner.got_on > HEADWAY_TIME

    def _gone(self, pose: Array) -> float:
        """Returns the distance in m from where it last was when it had got on."""
        return float(np.hypot(*(pose[:2] - self._anchor)))

    @property
    def _near_end(self) -> bool:
        """Whether its place on the plan is the last one."""
        return self._place > len(self._table) - 1 - SAMPLES_PER_PERIOD

    def _may_go_back(self, pose: Array, now: float) -> bool:
        """Tells whether it could go back a piece: not where what moves near it may give way, nor twice from a goal."""
        can = self.planner.vehicle.reverses and not self._near(pose, now)[:, 2:4].any()
        return can and self._pieces < MAX_BACK_PIECES and not (self._near_end and self._approached)

    def _back(self, pose: Array, now: float) -> bool:
        """Lets `last` be the twist with which it goes back; returns whether it can."""
        outlines = self.planner.sight.outlines(now, BACK_CLEARANCE - PLACE_RADIUS)
        twist = self._trail.back(pose, min(BACK_SPEED, self.bounds.speed / 2), outlines)
        if twist is not None:
            self.last = twist
        return twist is not None

    def _shorten(self, pose: Array, now: float) -> None:
        """Takes another plan where the map has changed, if that takes less time than the rest of its own."""
        left = self._period / SAMPLES_PER_PERIOD * (len(self._table) - 1 - self._place)
        if self.planner.map_changed and now - self.planner.tried > BLOCKED_RETRY:
            self.planner.tried = now
            if (other := self.planner.plan(pose, self.last, now)) and other.period < SHORTER_SHARE * left:
                self._take(other)


def _refuse_reverse(plan: Waypoints) -> None:
    if plan.cusps:
        raise InputError("reference: `window` and `mppi` follow plans that drive forward alone, without cusps")


def reach(discs: Array) -> float:
    """Returns how far from the origin of a robot's frame obstacles matter to discs that cover it, `(k, 3)`, in m."""
    return float((np.hypot(discs[:, 0], discs[:, 1]) + discs[:, 2]).max()) + NEAR_DISTANCE


def field_around(places: Array, sight: Sight, reach: float) -> Field:
    """Returns the distance from a robot's map, up to its `reach` in m, around places on a plan, `(n, 2)` in m."""
    low, high = places.min(axis=0) - FIELD_MARGIN, places.max(axis=0) + FIELD_MARGIN
    return near_field(sight.map, low, high, FIELD_CELL, reach + 2 * FIELD_CELL)


class Reactive(ABC):
    """A motion stage that asks for twists along a plan.

    It makes another plan when scans show that the plan is blocked and the twists do not pass (`passes`), or when the
    robot is off its plan or waits. Where a robot waits that can reverse, and another plan is not found or does not
    help, it goes back a little on its `Trail`, and plans again.

    It chooses the twist at the end of a motion period, and the request changes linearly up to it. The limiter would
    turn a step into the largest acceleration, which costs energy.

    Attributes:
        followed: What the robots follow, as in `mrctl.control.stages.MotionStage`, `(B, 7)`: the estimated pose, since
            there is no reference pose in time, so that the guard sees no error of the posture; the requested twist at
            the start of the period; and its rate of change over the period.
        considered: What led to the last twist of each robot; None before the first one, and while it stands or goes
            back.
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
        """Takes the missions of the robots, with their maps and with their plans as references.

        Raises:
            InputError: A plan, or that of an event, reverses.
        """
        self._planners = Planner.each(self._replan, scenarios)
        for planner in self._planners:
            for plan in planner.plans:
                _refuse_reverse(plan)

    def reset(self, pose: Array, reference: Array, period: float) -> None:
        """Starts a run; the arguments are those of `mrctl.control.stages.MotionStage`."""
        self._period, self._tick, self._agents = period, 0, []
        self.considered: list[Considered | None] = [None] * self._size
        discs, fields = cover(self._planners[0].vehicle.footprint, *BODY_DISCS), dict[Hashable, Field]()
        for planner, start in zip(self._planners, pose, strict=True):
            planner.reset()
            if (own := (planner.first, planner.scenario.known)) not in fields:
                places = planner.first.sample(np.linspace(0, planner.first.period, 200)).pose[:, :2]
                fields[own] = field_around(places, planner.sight, reach(discs))
            bounds = Bounds.of(self._robot, planner.first.speed)
            self._agents.append(Agent(planner, bounds, discs, fields[own], start[:2], period))

    def follow(self, row: int, plan: Reference) -> None:
        """Takes another plan for one robot, which is a way to another goal."""
        self._agents[row].follow(plan, self._period * self._tick)

    def see(self, row: int, scan: Scan) -> None:
        """Takes a scan of one robot; the arguments are those of `mrctl.control.stages.MotionStage`."""
        self._agents[row].see(scan)

    @property
    def bounds(self) -> list[Bounds]:
        """What twists each robot can drive."""
        return [agent.bounds for agent in self._agents]

    @property
    def last(self) -> Array:
        """The last twist of each robot, V in m/s and θ̇ in rad/s, `(B, 2)`."""
        return np.stack([agent.last for agent in self._agents])

    def output(self, pose: Array, twist: Array, reference: Array) -> Array:
        """Returns the requested twists at the start of the period, `(B, 2)`; `followed` leads to those just chosen.

        These are within the bounds of the robots, except where a robot begins or ends its way back or comes to stand:
        there the limiter acts. The arguments are those of `mrctl.control.stages.MotionStage`.
        """
        self.begin(self._tick)
        now, last = self._period * self._tick, self.last
        for row, (agent, place) in enumerate(zip(self._agents, pose, strict=True)):
            agent.locate(place)
            stands = agent.stands(place, float(twist[row, 0]), now)
            if stands or agent.goes_back(place, now) or agent.has_no_way(place, now):
                self.considered[row] = None
            else:
                scene = agent.scene(place, now)
                agent.last = self.choose(row, place, twist[row], agent.last, self._period, scene).copy()
                agent.passes = bool(np.isfinite(agent.planner.blocked)) and self.passes(row, self._period, scene)
        self._tick += 1
        self.followed = np.column_stack([pose, last, (self.last - last) / self._period])
        return last

    def begin(self, tick: int) -> None:  # noqa: B027 (most have nothing to do)
        """Is called once in a motion period, before `choose` for each robot."""

    def passes(self, row: int, period: float, scene: Scene) -> bool:
        """Tells whether the last twists of a robot lead around what blocks its plan; by default they do not.

        The arguments are those of `choose`.
        """
        return False

    @abstractmethod
    def choose(self, row: int, pose: Array, twist: Array, last: Array, period: float, scene: Scene) -> Array:
        """Returns the twist of one robot.

        Args:
            row: Which robot.
            pose: x and y in m and θ in rad, `(3,)`.
            twist: The twist that it drives, as measured, V in m/s and θ̇ in rad/s, `(2,)`.
            last: The requested twist at the start of the period, V in m/s and θ̇ in rad/s, `(2,)`.
            period: Motion period in s, which is also a step of a roll-out.
            scene: What it sees.
        """
