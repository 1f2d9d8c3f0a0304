"""Time laws: how fast a robot may drive along a path, under all its limits.

A path is given by its curvature κ(s) and its sharpness κ'(s) over the arc length s. With x = ṡ² and u = s̈ = x'/2 the
motion along it has

    V = √x,   V̇ = u,   θ̇ = κ √x,   θ̈ = κ u + κ' x,   V θ̇ = κ x,   θ̇² = κ² x,

so that every limit is |a u + b x + c √x + d| ≤ 1 with coefficients that depend on s alone. That includes the motor
voltages, because the inverse of equation (3) is linear in the features of `mrctl.theory.dynamics.regressor`; c is their
back-EMF and d their friction. V is not negative here: a curve with cusps is several paths, each with a law of its own.
Where the robot drives one in reverse, its law keeps `Limits.in_reverse`, and `mrctl.theory.references` changes the
signs of V and V̇.

`fastest` finds the law that takes the least time: a backward pass finds at each place the largest x from which the
limits can be kept up to the end, and a forward pass accelerates as hard as this bound and the limits allow (Pham and
Pham, "A new approach to time-optimal path parameterization based on reachability analysis", IEEE Transactions on
Robotics 34(3), 2018). Its acceleration has steps. `smooth` returns the moving average over time of a law that is a
little slower. Its acceleration is continuous, and it keeps the same limits.

On an open path both end at rest, and begin at rest or at a start speed. Where the limits do not allow that speed, they
begin at the largest one from which they can be kept (the largest controllable one, in the words of Pham and Pham). The
averaged law is continuous there, too: it begins with the start speed and without acceleration, because the law that is
averaged keeps its speed for half a window at first.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import Field, model_validator

from mrctl.kernel import Array, kernel
from mrctl.record import InputError, Record
from mrctl.theory.dynamics import inverse_coefficients
from mrctl.theory.robot import Robot

LIMIT_SHARE = 0.9
"""Share of the robot's limits that a reference may use; the rest is for the feedback. Chosen."""

INTERVALS_PER_RADIAN = 40  # least number of intervals for each rad of a curve; chosen
MAX_INTERVALS = 20_000
MAX_PASSES = 1000  # largest number of passes, until the speed at the end of a closed path is that at its start

Limit = Annotated[float, Field(ge=1e-3, le=1e4)]
Coefficient = Annotated[float, Field(ge=-1e6, le=1e6)]


class Limits(Record):
    """Limits that a time law keeps; by default 0.9 of those of the default robot, whatever robot drives; see `of`."""

    acceleration: Limit = 1.35
    """Limit on |V̇| in m/s²."""
    rotation: Limit = 2.7
    """Limit on |θ̇| in rad/s."""
    rotation_acceleration: Limit = 5.4
    """Limit on |θ̈| in rad/s²."""
    lateral_acceleration: Limit = 7.946
    """Limit on |V θ̇| in m/s², the grip of the tyres times gravity."""
    voltage: Limit = 21.6
    """Limit on the voltage of each motor in V."""
    inverse: tuple[tuple[Coefficient, Coefficient], ...] = (
        (10.26735, 0.0), (0.0, 1.930261), (2.404477, 0.0), (0.0, 0.5042269),
        (0.0, 1.201913), (-0.2259596, 0.0), (0.3244548, -0.2795229), (0.3244548, 0.2795229),
    )  # fmt: skip
    """Common and differential voltage in V per unit of V, θ̇, V̇, θ̈, V θ̇, θ̇², sgn V_l and sgn V_r; empty for no limit."""
    smoothing: Annotated[float, Field(ge=0.05, le=2)] = 0.2
    """Duration in s over which the acceleration is averaged, so that it has no steps."""

    @model_validator(mode="after")
    def _complete(self) -> Limits:
        if len(self.inverse) not in (0, 8):
            raise ValueError(f"inverse: has {len(self.inverse)} rows, but there are 8 features")
        return self

    @classmethod
    def of(cls, robot: Robot, share: float = LIMIT_SHARE) -> Limits:
        """Returns the limits of a robot.

        Args:
            robot: The robot.
            share: Share of each limit that is used, between 0 and 1.
        """
        return cls(
            acceleration=share * robot.max_acceleration,
            rotation=share * robot.max_rotation,
            rotation_acceleration=share * robot.max_rotation_acceleration,
            lateral_acceleration=share * robot.tyre_friction * robot.gravity,
            voltage=share * robot.supply,
            inverse=tuple((float(common), float(other)) for common, other in inverse_coefficients(robot)),
        )

    @property
    def in_reverse(self) -> Limits:
        """The same limits for a way that is driven backwards.

        V and V̇ change their sign and θ̇ keeps it, so that V θ̇ changes its own in the differential voltage, and θ̇² does
        against the other features in the common voltage.
        """
        signs = (1, 1, 1, 1, -1, -1, 1, 1)
        return self.replace(inverse=[[sign * c for c in row] for sign, row in zip(signs, self.inverse, strict=False)])


class Path(NamedTuple):
    """A path that is sampled at the ends and in the middles of N intervals of its arc length."""

    s: Array
    """Arc lengths in m, from 0 to the length of the path, shape (2N + 1,)."""
    curvature: Array
    """κ in 1/m, shape (2N + 1,)."""
    sharpness: Array
    """κ' in 1/m², shape (2N + 1,)."""
    closed: bool
    """Whether the end is the start; the law is then periodic, otherwise it ends at rest."""

    @property
    def length(self) -> float:
        """Length in m."""
        return float(self.s[-1])


Shape = Callable[[Array], tuple[Array, Array]]
"""κ in 1/m and κ' in 1/m² at arc lengths in m, all of shape (T,)."""


def sample_path(shape: Shape, s: Array, closed: bool, limits: Limits, speed: float, start: float = 0.0) -> Path:
    """Samples a path in intervals that are shorter where it turns and where the robot is slow.

    An interval of an open path ends where `smooth` lets the robot begin to change its start speed.

    Args:
        shape: The path.
        s: Arc lengths in m, from 0 to the length, dense enough to show every curve. Shape (T,).
        closed: Whether the end of the path is its start.
        limits: Limits of the time law that the path is sampled for.
        speed: Limit on V in m/s.
        start: Speed at the start of an open path in m/s.
    """
    length, a = s[-1], limits.acceleration
    step = min(np.diff(s).max(), speed**2 / (2 * a) / 16)
    slow = 0.0
    if not closed:
        # From rest to the full speed, or to the middle of the path, the intervals take equal times.
        distance = min(speed**2 / (2 * a), length / 2)
        times = np.ceil(np.sqrt(2 * distance / a) * max(8 / limits.smoothing, 64 * a / speed))
        near = distance * np.linspace(0, 1, int(min(times, MAX_INTERVALS)) + 1) ** 2
        s = np.union1d(s, np.concatenate([near, length - near]))
        slow = times * (1 + np.sqrt(np.minimum(s / distance, 1)) - np.sqrt(np.minimum((length - s) / distance, 1)))
    k, dk = shape(s)
    turning = np.maximum(np.abs(k), np.sqrt(np.abs(dk)))  # inverse of the length over which the path turns, 1/m
    density = np.maximum(1 / step, INTERVALS_PER_RADIAN * turning)
    count = np.append(0, np.cumsum(np.diff(s) * (density[1:] + density[:-1]) / 2)) + slow
    intervals = int(np.clip(np.ceil(count[-1]), 2, MAX_INTERVALS))
    ends = np.interp(np.linspace(0, count[-1], intervals + 1), count, s)
    if 0 < (held := start * limits.smoothing / 2) < ends[-2]:
        ends[max(1, np.abs(ends - held).argmin())] = held
    every = np.empty(2 * len(ends) - 1)
    every[::2], every[1::2] = ends, (ends[1:] + ends[:-1]) / 2
    return Path(every, *shape(every), closed)


def coefficients(path: Path, limits: Limits) -> Array:
    """Coefficients (a, b, c, d) of the limits |a u + b x + c √x + d| ≤ 1 along a path.

    Args:
        path: The path, with N intervals.
        limits: The limits.

    Returns:
        Shape (2N + 1, R, 4) for R limits: on V̇, on θ̈, and on the voltages of the left and the right motor.
    """
    k, dk = path.curvature, path.sharpness
    zero, one = np.zeros(k.shape), np.ones(k.shape)
    rows = [np.array([one, zero, zero, zero]) / limits.acceleration]
    rows += [np.array([k, dk, zero, zero]) / limits.rotation_acceleration]
    if limits.inverse:
        common, differential = np.array(limits.inverse).T
        left, right = common - differential, common + differential
        # The speed of a wheel has the sign of its back-EMF.
        signs = [np.sign(side[0] + side[1] * k) for side in (left, right)]
        for side in (left, right):
            u, x = side[2] + side[3] * k, side[3] * dk + side[4] * k + side[5] * k**2
            rows.append(np.array([u, x, side[0] + side[1] * k, side[6:] @ signs]) / limits.voltage)
    return np.moveaxis(np.array(rows), -1, 0)


def speed_caps(path: Path, limits: Limits, speed: float) -> Array:
    """Largest x = ṡ² in m²/s² that the limits on V, θ̇ and V θ̇ allow along a path, shape (2N + 1,)."""
    k = np.maximum(np.abs(path.curvature), 1e-12)
    return np.minimum(speed**2, np.minimum((limits.rotation / k) ** 2, limits.lateral_acceleration / k))


@kernel
def acceleration_range(rows: Array, x: float) -> tuple[float, float]:
    """Smallest and largest u = s̈ in m/s² that keep all limits at x = ṡ²; the first is the larger one where none does.

    A limit is −1 ≤ a u + b x + c √x + d ≤ 1 for all coefficients between a lower and an upper bound. As x and √x are
    not negative, the upper bounds of b, c and d determine the upper limit and their lower bounds the lower limit; u
    must keep both with either bound of a.

    Args:
        rows: Lower and upper bounds of the coefficients of each limit, shape (2, R, 4).
        x: ṡ² in m²/s², not negative.
    """
    low, high, v = -np.inf, np.inf, np.sqrt(x)
    for i in range(rows.shape[1]):
        least, most = rows[0, i], rows[1, i]
        above = 1 - most[1] * x - most[2] * v - most[3]  # upper limit on a u
        below = -1 - least[1] * x - least[2] * v - least[3]  # lower limit on a u
        for a in (least[0], most[0]):
            if a > 0:
                low, high = max(low, below / a), min(high, above / a)
            elif a < 0:
                low, high = max(low, above / a), min(high, below / a)
            elif above < 0 or below > 0:
                return np.inf, -np.inf
    return low, high


@kernel
def controllable(rows: Array, caps: Array, step: Array, end: float, largest: Array) -> None:
    """Backward pass: the largest x at each end of an interval from which the limits can be kept up to the end.

    In an interval u is constant, and x in its middle, for which the limits hold, is the mean of x at its ends.

    Args:
        rows: Bounds of the coefficients in each interval, shape (N, 2, R, 4).
        caps: Limits on x itself, shape (N + 1,).
        step: Length of each interval in m, shape (N,).
        end: Largest x at the end in m²/s².
        largest: Out: largest x in m²/s², shape (N + 1,).
    """
    n = len(rows)
    largest[n] = min(end, caps[n])
    for k in range(n - 1, -1, -1):
        good, bad = 0.0, (caps[k] + largest[k + 1]) / 2
        middle = bad
        for _ in range(50):
            low, high = acceleration_range(rows[k], middle)
            low = max(low, -middle / step[k])
            high = min(high, middle / step[k], (largest[k + 1] - middle) / step[k])  # x ≥ 0 at both ends
            if low <= high:
                good = middle
            else:
                bad = middle
            if good == bad:
                break
            middle = (good + bad) / 2
        low, _ = acceleration_range(rows[k], good)
        largest[k] = min(caps[k], good - step[k] * max(low, -good / step[k]))


@kernel
def held_start(rows: Array, largest: Array, step: Array, start: float, time: float) -> tuple[float, int]:
    """The largest speed at the start, up to a wanted one, that can be kept for a time, and the limits from there on.

    The speeds that an interval allows lie between rest and a largest one, because with u = 0 and the bounds of the
    coefficients that `smooth` takes each limit is convex in √x, and rest keeps all.

    Args:
        rows: Bounds of the coefficients in each interval, shape (N, 2, R, 4).
        largest: Largest x by `controllable`, shape (N + 1,).
        step: Length of each interval in m, shape (N,).
        start: The wanted speed in m/s.
        time: The time in s.

    Returns:
        The speed in m/s, and the number of intervals until the end of which it is kept.
    """
    v, s = min(start, np.sqrt(largest[0])), 0.0
    for k in range(len(rows)):
        if s >= v * time * (1 - 1e-9):
            return v, k
        good, bad = 0.0, min(v * v, largest[k + 1])
        middle = bad
        for _ in range(50):
            low, high = acceleration_range(rows[k], middle)
            if low <= 0 <= high:
                good = middle
            else:
                bad = middle
            if good == bad:
                break
            middle = (good + bad) / 2
        if good < v * v:
            if good * time * time < s * s:
                return s / time, k  # as slow as it is kept only up to here
            v = np.sqrt(good)
        s += step[k]
    return 0.0, 0


@kernel
def greedy(rows: Array, largest: Array, step: Array, start: float, held: int, x: Array) -> None:
    """Forward pass: from the start the largest x at the end of each interval that the limits allow.

    Args:
        rows: Bounds of the coefficients in each interval, shape (N, 2, R, 4).
        largest: Largest x by `controllable`, shape (N + 1,).
        step: Length of each interval in m, shape (N,).
        start: x at the start in m²/s².
        held: Number of intervals at the start in which x does not change.
        x: Out: x in m²/s², shape (N + 1,).
    """
    x[: held + 1] = start
    for k in range(held, len(rows)):
        good, bad = x[k] / 2, (x[k] + largest[k + 1]) / 2
        middle = bad
        for _ in range(50):
            low, high = acceleration_range(rows[k], middle)
            if low <= high and middle - x[k] <= step[k] * high:
                good = middle
            else:
                bad = middle
            if good == bad:
                break
            middle = (good + bad) / 2
        x[k + 1] = 2 * good - x[k]


@kernel
def bounds(rows: Array, first: Array, last: Array, found: Array) -> None:
    """Smallest and largest of each coefficient over ranges of samples.

    Args:
        rows: Coefficients, shape (N, C).
        first: First sample of each range, shape (M,); samples from N on are those from 0 on again.
        last: Last sample of each range, shape (M,).
        found: Out: smallest and largest coefficients, shape (M, 2, C).
    """
    n = len(rows)
    for k in range(len(first)):
        for i in range(rows.shape[1]):
            found[k, 0, i] = found[k, 1, i] = rows[first[k] % n, i]
        for j in range(first[k] + 1, last[k] + 1):
            row = rows[j % n]
            for i in range(len(row)):
                found[k, 0, i] = min(found[k, 0, i], row[i])
                found[k, 1, i] = max(found[k, 1, i], row[i])


class TimeLaw:
    """A motion s(t) along a path whose acceleration is constant in each interval of s.

    Attributes:
        path: The path.
        times: Times at which the intervals end in s, from 0, shape (N + 1,).
        duration: Time to the end of the path in s.
        start: Speed at the start in m/s.
    """

    def __init__(self, path: Path, x: Array) -> None:
        """Takes the path, and x = ṡ² in m²/s² at the ends of its intervals, shape (N + 1,)."""
        self.path = path
        self._s, self._v = path.s[::2], np.sqrt(x)
        self.start = float(self._v[0])
        steps = 2 * np.diff(self._s) / (self._v[1:] + self._v[:-1])
        self._a = np.diff(self._v) / steps
        self.times = np.append(0, np.cumsum(steps))
        self.duration = float(self.times[-1])
        pieces = steps * (self._s[:-1] + steps * (self._v[:-1] / 2 + steps * self._a / 6))
        self._integral = np.append(0, np.cumsum(pieces))

    def at(self, t: Array) -> tuple[Array, Array, Array, Array]:
        """Returns ∫ s dt in m·s, s in m, ṡ in m/s and s̈ in m/s² at the times t in s, each of shape (T,).

        A closed path goes on from lap to lap. Before the start of an open one the robot comes at the start speed, and
        after the end it rests.
        """
        lap, since = np.divmod(t, self.duration) if self.path.closed else (0.0, np.clip(t, 0, self.duration))
        k = np.clip(np.searchsorted(self.times, since, side="right") - 1, 0, len(self._a) - 1)
        d, s, v, a = since - self.times[k], self._s[k], self._v[k], self._a[k]
        integral = self._integral[k] + d * (s + d * (v / 2 + d * a / 6))
        s, v = s + d * (v + d * a / 2), v + d * a
        length = self.path.length
        if self.path.closed:
            laps = lap * (self._integral[-1] + (lap - 1) / 2 * length * self.duration + length * since)
            return laps + integral, s + lap * length, v, a
        integral, before = integral + np.maximum(t - self.duration, 0) * length, np.minimum(t, 0)
        come = before * self._v[0]
        return integral + before / 2 * come, s + come, v, np.where(since == t, a, 0.0)

    def average(self, t: Array, window: float) -> tuple[Array, Array, Array]:
        """Returns the moving averages of s in m, ṡ in m/s and s̈ in m/s² over a window in s around t, shape (T,)."""
        before, after = self.at(t - window / 2), self.at(t + window / 2)
        s, v, a = ((after[i] - before[i]) / window for i in range(3))
        return s, v, a


class SmoothLaw:
    """The moving average of a time law; it begins where the path begins.

    Its acceleration is continuous, and its jerk is at most twice the limit on the acceleration over the window. A
    closed path takes as long as by the law itself. An open one takes a window longer, or half a window where it begins
    with a speed, which the law must keep for the other half.

    Attributes:
        law: The law that is averaged.
        duration: Time to the end of the path in s.
    """

    def __init__(self, law: TimeLaw, window: float) -> None:
        """Takes the law and the duration of the average in s."""
        self.law, self._window, self._start = law, window, -window / 2
        self.duration = law.duration
        if law.path.closed:
            from scipy.optimize import brentq  # imported here, so that settings are read without scipy

            root = brentq(lambda t: law.average(np.array([t]), window)[0].item(), -window / 2, window / 2)
            self._start = float(root)  # type: ignore[arg-type]
        elif law.start > 0:
            self._start = 0.0
            self.duration += window / 2
        else:
            self.duration += window

    def at(self, t: Array) -> tuple[Array, Array, Array]:
        """Returns s in m, ṡ in m/s and s̈ in m/s² at the times t in s from the start, each of shape (T,)."""
        path = self.law.path
        lap, since = np.divmod(t, self.duration) if path.closed else (0.0, t)
        s, v, a = self.law.average(since + self._start, self._window)
        return s + lap * path.length, v, a


def fastest(path: Path, limits: Limits, speed: float, start: float = 0.0) -> TimeLaw:
    """The law that takes the least time.

    The limits on V, θ̇ and V θ̇ hold at the ends of the intervals of the path, and the others in their middles.

    Args:
        path: The path.
        limits: The limits.
        speed: Limit on V in m/s.
        start: Speed at the start of an open path in m/s; where it is too large, the largest possible one is taken.

    Raises:
        InputError: The voltage does not overcome the friction.
    """
    rows = coefficients(path, limits)[1::2]
    return _solved(path, np.stack([rows, rows], 1), speed_caps(path, limits, speed)[::2], start, 0.0)


def smooth(path: Path, limits: Limits, speed: float, start: float = 0.0) -> SmoothLaw:
    """A law with continuous acceleration that keeps the limits, between the samples to within 2 %.

    It is the average of a law s*(t) over a window, s(t) = mean s*(t + τ). A limit that is convex in ṡ and s̈ holds for
    the average of the motions s*(t + τ) if it holds for each of them with the coefficients of the place s(t). The law
    s* must therefore keep its limits with the coefficients of all places that the average can be at meanwhile. These
    lie on the stretch that the time-optimal law covers in that time, because no other law overtakes it. Only b x = b ṡ²
    is not convex where it relaxes the limit (b < 0 in an upper limit, b > 0 in a lower one); there it counts as zero.

    From a start speed the law s* comes at that speed from before the path, and keeps it for half a window. The average
    around t = 0 is then the start of the path, with that speed and without acceleration. As the start speed falls to
    zero, so does the stretch on which it is kept, and the law becomes that from rest.

    So the law takes longer than the time-optimal one: on random splines 2 to 3 % on average and at most 10 %, and on
    the plans of missions 2 to 9 % on average and at most 13 %, most where the plan is short, because an open path
    takes the window longer in any case (`tests/unit/test_timing.py`, three robots).

    Args:
        path: The path.
        limits: The limits; `limits.smoothing` is the window.
        speed: Limit on V in m/s.
        start: Speed at the start of an open path in m/s; where it is too large, the largest possible one is taken.

    Raises:
        InputError: The voltage does not overcome the friction.
    """
    law, window = fastest(path, limits, speed, start), limits.smoothing
    before, after = (law.average(law.times + shift, window)[0] for shift in (-window / 2, window / 2))
    rows, caps = coefficients(path, limits), speed_caps(path, limits, speed)
    over = _bounds(rows.reshape(len(rows), -1), before[:-1], after[1:], path).reshape(-1, 2, *rows.shape[1:])
    over[:, 0, :, 1], over[:, 1, :, 1] = np.minimum(over[:, 0, :, 1], 0), np.maximum(over[:, 1, :, 1], 0)
    within = _bounds(caps[:, None], before, after, path)[:, 0, 0]
    return SmoothLaw(_solved(path, over, within, start, window / 2), window)


def _bounds(rows: Array, start: Array, end: Array, path: Path) -> Array:
    """Bounds of coefficients over stretches of a path.

    Args:
        rows: Coefficients along the path, shape (2N + 1, C).
        start: Start of each stretch in m, shape (M,).
        end: End of each stretch in m, shape (M,).
        path: The path; the stretches of a closed one go on before its start and after its end.

    Returns:
        Lower and upper bounds, which include the coefficients next to the stretch on either side. Shape (M, 2, C).
    """
    s = path.s
    if path.closed:
        rows, s = rows[:-1], np.concatenate([s[:-1] + lap * path.length for lap in (-1, 0, 1)])
    first = np.maximum(np.searchsorted(s, start, side="right") - 1, 0)
    last = np.minimum(np.searchsorted(s, end), len(s) - 1)
    found = np.empty((len(first), 2, rows.shape[1]))
    # In one layout, so that it is compiled once.
    bounds(np.ascontiguousarray(rows), first, np.minimum(last, first + len(rows) - 1), found)
    return found


def _solved(path: Path, rows: Array, caps: Array, start: float, kept: float) -> TimeLaw:
    """The law of least time under limits with bounds of their coefficients.

    Args:
        path: The path.
        rows: Bounds of the coefficients in each interval, shape (N, 2, R, 4).
        caps: Limits on x in m²/s², shape (N + 1,).
        start: Largest speed at the start of an open path in m/s.
        kept: Time in s for which an open path keeps it.
    """
    rows, caps = np.ascontiguousarray(rows), np.ascontiguousarray(caps)  # in one layout, as in `_bounds`
    if np.abs(rows[..., 3]).max() >= 1:
        raise InputError("limits.voltage: too low to overcome the friction of the drives")
    step, largest, x = np.diff(path.s[::2]), np.empty(len(caps)), np.empty(len(caps))
    end = caps[-1] if path.closed else 0.0
    for _ in range(MAX_PASSES):  # of a closed path, until a lap ends as it starts
        controllable(rows, caps, step, end, largest)
        if not path.closed or largest[0] >= end:
            break
        end = largest[0]
    if not path.closed:
        held, first = 0, min(start * start, largest[0])
        if start > 0 and kept > 0:
            v, held = held_start(rows, largest, step, start, kept)
            first = v * v
        greedy(rows, largest, step, first, held, x)
        return TimeLaw(path, x)
    first = end
    for _ in range(MAX_PASSES):
        greedy(rows, largest, step, first, 0, x)
        if x[-1] >= first:
            break
        first = x[-1]
    return TimeLaw(path, x)
