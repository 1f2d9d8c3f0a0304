"""Roll-outs of twists, by which the reactive controllers choose.

A roll-out integrates the unicycle from the pose of the robot over a horizon, and has a cost: squared distance and
heading error from the plan, nearness to obstacles, and collision. Its twists are limited to what the robot can drive:
forward, below its largest speed, rotation and curvature, and within its acceleration. The requested twist changes
linearly over each step. The robot obeys it at once, or with a first-order lag, τ dV/dt = V_requested − V, and the same
for θ̇.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mrctl.kernel import Array, kernel
from mrctl.theory.grid import Field, value
from mrctl.theory.robot import Robot
from mrctl.theory.timing import LIMIT_SHARE

STEPS = 56  # of a roll-out, each a motion period
KNOTS = 8  # of a roll-out, between which what is added to its twists changes linearly
# costs in 1/(m² s), 1/s, 1/s and for a collision; chosen
PLACE_COST, HEADING_COST, NEAR_COST, TOUCH_COST = 10.0, 1.0, 5.0, 1000.0
END_HEADING_COST = 5.0  # 1/s, where the plan has ended: 0.2 rad cost what 0.1 m do, as by `arrived`
NEAR_DISTANCE = 0.1  # m from obstacles, below which it costs
# m, by which discs that touch an obstacle already may come nearer, and how deep at most; else a robot would come nearer
# in each period, for the discs reach 1 to 6 cm beyond it
MAX_DEEPER, DEEPEST = 0.005, 0.01
ROUNDING = 1e-9  # m, so that staying is not deeper
WIDER = 1.001  # factor on the squared distance up to which a mover is looked at closely, for rounding


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
    """Largest |θ̈| in rad/s²."""

    @classmethod
    def of(cls, robot: Robot, speed: float) -> Bounds:
        """Returns 0.9 of the limits of a robot; that of the curvature is at 0.9 of the steering limit.

        Args:
            robot: The robot.
            speed: Largest V in m/s, which stays as it is.
        """
        curvature = float(np.tan(LIMIT_SHARE * robot.steering_limit)) / abs(robot.wheelbase)
        rates = robot.max_rotation, curvature / LIMIT_SHARE, robot.max_acceleration, robot.max_rotation_acceleration
        return cls(speed, *(LIMIT_SHARE * limit for limit in rates))


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
    end: int = STEPS
    """Number of targets up to the end of the plan; all later ones are that end, at which the heading costs more."""
    near: float = NEAR_COST
    """Cost in 1/s of touching an obstacle; it falls to zero at `NEAR_DISTANCE`."""


class Considered(NamedTuple):
    """Roll-outs that a stage considered in a motion period."""

    pose: Array
    """Where the robot was by its estimate, x and y in m and θ in rad, `(3,)`."""
    twists: Array
    """Some of the roll-outs, V in m/s and θ̇ in rad/s at the ends of their steps, `(k, n, 2)`."""
    chosen: Array
    """The one whose first twist is requested for the end of the period, `(n, 2)`."""
    last: Array
    """Requested twist at the start of the period, `(2,)`."""

    def paths(self, step: float) -> tuple[Array, Array]:
        """Returns the places on the ways of the roll-outs in m, `(k, n + 1, 2)`, and on the chosen one, `(n + 1, 2)`.

        Args:
            step: Duration of a step in s.
        """
        ways = [_path(self.pose, self.last, twists, step) for twists in (self.twists, self.chosen[None])]
        return ways[0], ways[1][0]


def _path(pose: Array, last: Array, ends: Array, step: float) -> Array:
    """Returns the places, `(k, n + 1, 2)`, of unicycles that obey at once; `ends` as `Considered.twists`."""
    starts = np.concatenate([np.broadcast_to(last, ends[:, :1].shape), ends[:, :-1]], axis=1)
    twists = (starts + ends) / 2
    turned = step * np.cumsum(twists[..., 1], axis=-1)
    heading = pose[2] + turned - step * twists[..., 1] / 2  # half-way through each step
    moves = step * twists[..., :1] * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    return pose[:2] + np.pad(np.cumsum(moves, axis=-2), [(0, 0), (1, 0), (0, 0)])


@kernel
def body_clearance(
    x: float, y: float, c: float, s: float, k: int, circle: tuple[float, float, float], discs: Array,
    distance: Array, left: float, low: float, resolution: float, movers: Array, places: Array,
) -> float:  # fmt: skip
    """Returns the distance in m of the discs of a robot from all that it knows, or `NEAR_DISTANCE` where it is larger.

    Args:
        x: x of the robot in m.
        y: y of the robot in m.
        c: Cosine of its heading.
        s: Sine of its heading.
        k: How many steps from now on it is there.
        circle: x and y of the centre in the robot's frame and radius in m of a circle that holds all its discs.
        discs: `Scene.discs`.
        distance: Distances of `Scene.field`, which is taken apart as for `value`.
        left: x of its origin in m.
        low: y of its origin in m.
        resolution: Side of its cells in m.
        movers: `Scene.movers`.
        places: x and y in m where they are after each step, if they go on as they do now, `(steps + 1, M, 2)`.
    """
    free, far = NEAR_DISTANCE, circle[2] + NEAR_DISTANCE
    cx, cy = x + c * circle[0] - s * circle[1], y + s * circle[0] + c * circle[1]
    if value(distance, left, low, resolution, cx, cy) < far:  # else no disc can be nearer than NEAR_DISTANCE
        for d in range(len(discs)):
            px, py = x + c * discs[d, 0] - s * discs[d, 1], y + s * discs[d, 0] + c * discs[d, 1]
            free = min(free, value(distance, left, low, resolution, px, py) - discs[d, 2])
    for m in range(len(movers)):
        mx, my = places[k, m, 0], places[k, m, 1]
        if (mx - cx) ** 2 + (my - cy) ** 2 > WIDER * (movers[m, 4] + far) ** 2:
            continue
        mx, my = c * (mx - x) + s * (my - y), c * (my - y) - s * (mx - x)
        if (mx - circle[0]) ** 2 + (my - circle[1]) ** 2 < (movers[m, 4] + far) ** 2:
            for d in range(len(discs)):
                ahead, aside = mx - discs[d, 0], my - discs[d, 1]
                free = min(free, np.sqrt(ahead * ahead + aside * aside) - movers[m, 4] - discs[d, 2])
    return free


@kernel
def enclosing_circle(discs: Array) -> tuple[float, float, float]:
    """Returns x and y of the centre and the radius in m of a circle that holds discs, `(k, 3)`."""
    x = (np.min(discs[:, 0] - discs[:, 2]) + np.max(discs[:, 0] + discs[:, 2])) / 2
    y = (np.min(discs[:, 1] - discs[:, 2]) + np.max(discs[:, 1] + discs[:, 2])) / 2
    return x, y, np.max(np.hypot(discs[:, 0] - x, discs[:, 1] - y) + discs[:, 2])


@kernel
def lagged(start: float, end: float, now: float, share: float, rest: float) -> tuple[float, float]:
    """Returns the mean velocity over a step, and that at its end, of a robot that follows a ramp with a lag.

    From v₀ on, the response to a request u + a t is u + a (t − τ) + (v₀ − u + a τ) exp(−t/τ). All velocities are V in
    m/s, or θ̇ in rad/s.

    Args:
        start: Request at the start of the step.
        end: Request at its end.
        now: v₀, the velocity at the start of the step.
        share: τ over the duration of the step; 0: the request is obeyed at once.
        rest: The exponential at the end of the step.
    """
    late = share * (end - start)
    differs = now - start + late
    return (start + end) / 2 - late + (1 - rest) * share * differs, end - late + rest * differs


@kernel
def roll_out(
    knots: Array, nominal: Array, pose: Array, twist: Array, last: Array, lag: float, step: float, bounds: Bounds,
    scene: Scene, worth: float, twists: Array, costs: Array,
) -> None:  # fmt: skip
    """Adds knots to nominal twists, limits the sums to what the robot can drive, and writes twists and costs.

    Args:
        knots: What is added to V in m/s and θ̇ in rad/s, at equal distances over the horizon, `(K, KNOTS, 2)`.
        nominal: Nominal twists, `(n, 2)`.
        pose: x and y in m and θ in rad, `(3,)`.
        twist: The twist that the robot drives, `(2,)`; matters only with a lag.
        last: Requested twist at the start of the first step, `(2,)`.
        lag: Time constant with which the robot follows the requested twist in s; 0: at once.
        step: Duration of a step in s.
        bounds: What twists the robot can drive.
        scene: Plan and obstacles.
        worth: What a roll-out may cost more than the cheapest before it; one that costs more is not judged to its end,
            and its cost is what it was until then.
        twists: Out: the requested twists at the ends of the n steps of K roll-outs, `(K, n, 2)`.
        costs: Out: their costs, `(K,)`.
    """
    targets, discs, field, movers, end, near = scene
    distance, left, low, resolution = field.distance, field.origin[0], field.origin[1], field.resolution
    steps, circle = len(nominal), enclosing_circle(discs)
    # The discs reach beyond the robot, and what it finds is noisy: where they touch already, deeper is a collision.
    x, y, c, s = pose[0], pose[1], np.cos(pose[2]), np.sin(pose[2])
    places = np.empty((steps + 1, len(movers), 2))
    for k in range(steps + 1):
        for m in range(len(movers)):
            for i in range(2):
                places[k, m, i] = movers[m, i] + k * step * movers[m, 2 + i]
    now = body_clearance(x, y, c, s, 0, circle, discs, distance, left, low, resolution, movers, places)
    least = min(now - ROUNDING, max(now - MAX_DEEPER, -DEEPEST)) if now <= 0 else 0.0
    rest = np.exp(-step / lag) if lag > 0 else 0.0
    before, shares = np.empty(steps, np.int64), np.empty(steps)  # knot before each step, and share of the one after it
    for k in range(steps):
        along = k * (knots.shape[1] - 1) / (steps - 1)
        before[k] = min(int(along), knots.shape[1] - 2)
        shares[k] = along - before[k]
    cheapest = np.inf
    for n in range(len(knots)):
        x, y, c, s, v, omega, cost = pose[0], pose[1], np.cos(pose[2]), np.sin(pose[2]), last[0], last[1], 0.0
        drives, turns, judged, free = twist[0], twist[1], False, NEAR_DISTANCE
        for k in range(steps):
            i, share = before[k], shares[k]
            wanted = nominal[k, 0] + (1 - share) * knots[n, i, 0] + share * knots[n, i + 1, 0]
            turning = nominal[k, 1] + (1 - share) * knots[n, i, 1] + share * knots[n, i + 1, 1]
            from_v, from_omega = v, omega
            change, turn_change = bounds.acceleration * step, bounds.rotation_acceleration * step
            slowest = (abs(omega) - turn_change) / bounds.curvature  # V at which θ̇ has fallen as fast as it can
            fastest = max(bounds.speed, v - change, slowest)  # a robot on a slower way than before brakes
            v = min(max(wanted, v - change, slowest, 0.0), v + change, fastest)
            omega = min(max(turning, omega - turn_change), omega + turn_change)
            most = min(bounds.rotation, bounds.curvature * v)
            omega = min(max(omega, -most), most)
            twists[n, k, 0], twists[n, k, 1] = v, omega
            if judged:
                continue
            speed, drives = lagged(from_v, v, drives, lag / step, rest)
            rotation, turns = lagged(from_omega, omega, turns, lag / step, rest)
            # Half of the turn, the way, and the other half; the cosine of so small an angle is that of its series.
            half = rotation * step / 2
            ch, sh = 1 - half * half / 2 * (1 - half * half / 12), half * (1 - half * half / 6 * (1 - half * half / 20))
            c, s = c * ch - s * sh, s * ch + c * sh
            x, y = x + speed * step * c, y + speed * step * s
            c, s = c * ch - s * sh, s * ch + c * sh
            dx, dy = targets[k, 0] - x, targets[k, 1] - y
            turned = (HEADING_COST if k < end else END_HEADING_COST) * (1 - c * targets[k, 2] - s * targets[k, 3])
            cost += step * (PLACE_COST * (dx * dx + dy * dy) + turned)
            if k == 0 or speed != 0.0 or rotation != 0.0 or len(movers) > 0:  # else it rests, and so does all around it
                free = body_clearance(x, y, c, s, k + 1, circle, discs, distance, left, low, resolution, movers, places)
            if free <= least:
                judged = True
                cost += TOUCH_COST * (1 + (steps - k) / steps)  # the earlier, the worse
            elif free < NEAR_DISTANCE:
                cost += step * near * (1 - free / NEAR_DISTANCE) ** 2
            judged |= cost > cheapest + worth
        costs[n] = cost
        cheapest = min(cheapest, cost)
