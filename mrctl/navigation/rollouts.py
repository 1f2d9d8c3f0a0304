"""What the reactive controllers share: what they see of the plan and the obstacles, and roll-outs of twists.

A roll-out integrates the unicycle from the pose of the robot over a horizon, and has a cost: squared distance and
heading error from the plan, nearness to obstacles, and collision. Its twists are limited to what the robot can drive:
forward, below its largest speed, rotation and curvature, and within its acceleration. They are obeyed at once, or with
a first-order lag, τ dV/dt = V_requested − V, and the same for θ̇.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Sequence
from typing import NamedTuple

import numpy as np

from mrctl.kernel import Array, kernel
from mrctl.loop.goals import arrived
from mrctl.navigation.chart import RADIUS
from mrctl.navigation.sight import Sight
from mrctl.navigation.trail import Trail
from mrctl.navigation.vehicle import reverses, robot_of
from mrctl.record import InputError
from mrctl.scenario import Scenario
from mrctl.theory.clearance import cover
from mrctl.theory.grid import Field, near_field, value
from mrctl.theory.obstacles import Outlines
from mrctl.theory.rays import Scan
from mrctl.theory.references import Reference, Waypoints
from mrctl.theory.robot import Robot
from mrctl.theory.timing import RESERVE

STEPS = 56  # of a roll-out, each a motion period
KNOTS = 8  # of a roll-out, between which what is added to its twists changes linearly
PLACE, HEADING, NEAR, TOUCH = 10.0, 1.0, 5.0, 1000.0  # costs in 1/(m² s), 1/s, 1/s and for a collision; chosen
KEPT = 0.1  # m from obstacles, below which it costs
DEEPER = 0.005  # m, by which discs that touch an obstacle already may come nearer
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


class Bounds(NamedTuple):
    """Limits on the twists of a robot."""

    speed: float
    """Largest V in m/s."""
    rotation: float
    """Largest |θ̇| in rad/s."""
    curvature: float
    """Largest |θ̇| / V in 1/m."""
    acceleration: float
    """Largest |V̇| in m/s²."""
    rotation_acceleration: float
    """Largest |θ̈| in rad/s², which braking in the tightest curve may exceed."""

    @classmethod
    def of(cls, robot: Robot, speed: float) -> Bounds:
        """Returns 0.9 of the limits of a robot; that of the curvature is at 0.9 of the steering limit.

        Args:
            robot: The robot.
            speed: Largest V in m/s, which stays as it is.
        """
        curvature = float(np.tan(RESERVE * robot.steering_limit)) / abs(robot.wheelbase)
        rates = robot.max_rotation, curvature / RESERVE, robot.max_acceleration, robot.max_rotation_acceleration
        return cls(speed, *(RESERVE * limit for limit in rates))


class Scene(NamedTuple):
    """Targets and obstacles by which roll-outs are judged."""

    targets: Array
    """Where the plan is after each of n steps, counted from its place nearest to the robot: x and y in m, cos θ, sin θ,
    `(n, 4)`."""
    discs: Array
    """Discs that cover the robot, as of `cover`, `(k, 3)`."""
    field: Field
    """Distance from the obstacles on the map."""
    movers: Array
    """Discs around the others that it has seen: x and y in m, their velocities in m/s, radius in m, `(M, 5)`."""


class Considered(NamedTuple):
    """Roll-outs that a stage considered in a motion period."""

    pose: Array
    """Where the robot was by its estimate, x and y in m and θ in rad, `(3,)`."""
    twists: Array
    """Some of the roll-outs, V in m/s and θ̇ in rad/s, `(k, n, 2)`."""
    chosen: Array
    """The one whose first twist was asked for, `(n, 2)`."""

    def paths(self, step: float) -> tuple[Array, Array]:
        """Returns the places on the ways of the roll-outs in m, `(k, n + 1, 2)`, and on the chosen one, `(n + 1, 2)`.

        Args:
            step: Duration of a step in s.
        """
        ways = [_path(self.pose, twists, step) for twists in (self.twists, self.chosen[None])]
        return ways[0], ways[1][0]


def _path(pose: Array, twists: Array, step: float) -> Array:
    """Returns the places, `(k, n + 1, 2)`, of unicycles that obey twists `(k, n, 2)` at once, as roll-outs do."""
    turned = step * np.cumsum(twists[..., 1], axis=-1)
    heading = pose[2] + turned - step * twists[..., 1] / 2  # half-way through each step
    moves = step * twists[..., :1] * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    return pose[:2] + np.pad(np.cumsum(moves, axis=-2), [(0, 0), (1, 0), (0, 0)])


Replan = Callable[[Scenario, Array, Outlines, Waypoints | None], Waypoints | None]
"""Plans for the mission of a scenario, from a pose in m, m, rad, `(3,)`, among obstacles as they are now, to the end of
a plan that an event brought, or else to the goal of the mission; None where there is no way."""


def opened(reference: Reference) -> Waypoints:
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
        self._scenarios, self._own = scenarios, [opened(scenario.reference) for scenario in scenarios]
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
        self._given[row] = plan = opened(plan)
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

    def _lost(self, row: int, pose: Array, away: float) -> bool:
        """Tells whether a robot needs another plan: it is `away` m off its own, or has hardly moved for a while.

        One that is at the end of its plan needs none.
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
            if not self._lost(row, pose, away):
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


@kernel
def clearance(
    x: float, y: float, c: float, s: float, time: float, circle: tuple[float, float, float], discs: Array,
    distance: Array, left: float, low: float, resolution: float, movers: Array,
) -> float:  # fmt: skip
    """Returns the distance in m of the discs of a robot from all that it knows, or `KEPT` where it is larger.

    Args:
        x: x of the robot in m.
        y: y of the robot in m.
        c: Cosine of its heading.
        s: Sine of its heading.
        time: Time in s, from now on, for which what moves goes on as it does now.
        circle: x and y of the centre in the robot's frame and radius in m of a circle that holds all its discs.
        discs: `Scene.discs`.
        distance: Distances of `Scene.field`, which is taken apart as for `value`.
        left: x of its origin in m.
        low: y of its origin in m.
        resolution: Side of its cells in m.
        movers: `Scene.movers`.
    """
    free, far = KEPT, circle[2] + KEPT
    px, py = x + c * circle[0] - s * circle[1], y + s * circle[0] + c * circle[1]
    if value(distance, left, low, resolution, px, py) < far:  # else no disc can be nearer than KEPT
        for d in range(len(discs)):
            px, py = x + c * discs[d, 0] - s * discs[d, 1], y + s * discs[d, 0] + c * discs[d, 1]
            free = min(free, value(distance, left, low, resolution, px, py) - discs[d, 2])
    for m in range(len(movers)):
        mx, my = movers[m, 0] + time * movers[m, 2] - x, movers[m, 1] + time * movers[m, 3] - y
        mx, my = c * mx + s * my, c * my - s * mx
        if (mx - circle[0]) ** 2 + (my - circle[1]) ** 2 < (movers[m, 4] + far) ** 2:
            for d in range(len(discs)):
                ahead, aside = mx - discs[d, 0], my - discs[d, 1]
                free = min(free, np.sqrt(ahead * ahead + aside * aside) - movers[m, 4] - discs[d, 2])
    return free


@kernel
def around(discs: Array) -> tuple[float, float, float]:
    """Returns x and y of the centre and the radius in m of a circle that holds discs, `(k, 3)`."""
    x = (np.min(discs[:, 0] - discs[:, 2]) + np.max(discs[:, 0] + discs[:, 2])) / 2
    y = (np.min(discs[:, 1] - discs[:, 2]) + np.max(discs[:, 1] + discs[:, 2])) / 2
    return x, y, np.max(np.hypot(discs[:, 0] - x, discs[:, 1] - y) + discs[:, 2])


@kernel
def roll_out(
    knots: Array, nominal: Array, pose: Array, twist: Array, last: Array, lag: float, step: float, bounds: Bounds,
    scene: Scene, worth: float, twists: Array, costs: Array,
) -> None:  # fmt: skip
    """Adds knots to nominal twists, limits the sums to what the robot can drive, and returns the cost of each roll-out.

    Args:
        knots: What is added to V in m/s and θ̇ in rad/s, at equal distances over the horizon, `(K, KNOTS, 2)`.
        nominal: Nominal twists, `(n, 2)`.
        pose: x and y in m and θ in rad, `(3,)`.
        twist: The twist that the robot drives, `(2,)`; matters only with a lag.
        last: The twist that was requested in the last period, `(2,)`.
        lag: Time constant with which the robot follows the requested twist in s; 0: at once.
        step: Duration of a step in s.
        bounds: What twists the robot can drive.
        scene: Plan and obstacles.
        worth: What a roll-out may cost more than the cheapest before it; one that costs more is not judged to its end,
            and its cost is what it was until then.
        twists: Out: the twists of K roll-outs of n steps, `(K, n, 2)`.
        costs: Out: their costs, `(K,)`.
    """
    targets, discs, field, movers = scene
    distance, left, low, resolution = field.distance, field.origin[0], field.origin[1], field.resolution
    steps, circle = len(nominal), around(discs)
    # The discs reach beyond the robot, and what it finds is noisy: where they touch it already, deeper is a collision.
    x, y, c, s = pose[0], pose[1], np.cos(pose[2]), np.sin(pose[2])
    least = clearance(x, y, c, s, 0.0, circle, discs, distance, left, low, resolution, movers)
    least = least - DEEPER if least <= 0 else 0.0
    # While a request is held, what is missing of it decays: to `rest` at the end of a step, to `mean` on its average.
    rest = np.exp(-step / lag) if lag > 0 else 0.0
    mean = (1 - rest) * lag / step
    before, shares = np.empty(steps, np.int64), np.empty(steps)  # knot before each step, and share of the one after it
    for k in range(steps):
        along = k * (knots.shape[1] - 1) / (steps - 1)
        before[k] = min(int(along), knots.shape[1] - 2)
        shares[k] = along - before[k]
    cheapest = np.inf
    for n in range(len(knots)):
        x, y, c, s, v, omega, cost = pose[0], pose[1], np.cos(pose[2]), np.sin(pose[2]), last[0], last[1], 0.0
        drives, turns, judged = twist[0], twist[1], False
        for k in range(steps):
            i, share = before[k], shares[k]
            wanted = nominal[k, 0] + (1 - share) * knots[n, i, 0] + share * knots[n, i + 1, 0]
            turning = nominal[k, 1] + (1 - share) * knots[n, i, 1] + share * knots[n, i + 1, 1]
            change = bounds.acceleration * step
            v = min(max(min(max(wanted, v - change), v + change), 0.0), bounds.speed)
            change = bounds.rotation_acceleration * step
            omega = min(max(turning, omega - change), omega + change)
            most = min(bounds.rotation, bounds.curvature * v)
            omega = min(max(omega, -most), most)
            twists[n, k, 0], twists[n, k, 1] = v, omega
            if judged:
                continue
            speed, rotation = v + mean * (drives - v), omega + mean * (turns - omega)
            drives, turns = v + rest * (drives - v), omega + rest * (turns - omega)
            # Half of the turn, the way, and the other half; the cosine of so small an angle is that of its series.
            half = rotation * step / 2
            ch, sh = 1 - half * half / 2 * (1 - half * half / 12), half * (1 - half * half / 6 * (1 - half * half / 20))
            c, s = c * ch - s * sh, s * ch + c * sh
            x, y = x + speed * step * c, y + speed * step * s
            c, s = c * ch - s * sh, s * ch + c * sh
            dx, dy = targets[k, 0] - x, targets[k, 1] - y
            cost += step * (PLACE * (dx * dx + dy * dy) + HEADING * (1 - c * targets[k, 2] - s * targets[k, 3]))
            free = clearance(x, y, c, s, (k + 1) * step, circle, discs, distance, left, low, resolution, movers)
            if free <= least:
                judged = True
                cost += TOUCH * (1 + (steps - k) / steps)  # the earlier, the worse
            elif free < KEPT:
                cost += step * NEAR * (1 - free / KEPT) ** 2
            judged |= cost > cheapest + worth
        costs[n] = cost
        cheapest = min(cheapest, cost)
