"""Analytic reference trajectories: pose, twist and acceleration of the robot at every time.

A position is a complex number p = x + i y. A path with heading θ then has the tangent e^{iθ}, a rotation is a product,
and the logarithmic derivative p''/p' = v̇/v + i θ̇ gives acceleration and rotation at once. No derivative is numerical,
and every sample, its heading included, depends on its own time alone.

A reference starts at the origin along +x, except that a line starts along its heading, a lemniscate at 45°, and a
spline at its first waypoint. A new kind is a `Record` with `kind`, `period` and the method `sample`, and is added to
the union `Reference`.
"""

from __future__ import annotations

import cmath
import contextlib
from functools import lru_cache
from itertools import chain, pairwise, product
from typing import Annotated, Literal, NamedTuple

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import ArrayLike
from pydantic import Field, model_validator

from mrctl.kernel import Array
from mrctl.record import InputError, Record
from mrctl.theory.robot import Robot
from mrctl.theory.spline import KEPT, Plane, Spline, plane, spline
from mrctl.theory.timing import LIMIT_SHARE, Limits, SmoothLaw, sample_path, smooth

Length = Annotated[float, Field(ge=1e-3, le=1000)]
MIN_SPEED = 0.01  # m/s, of a reference with a constant or a largest speed
Speed = Annotated[float, Field(ge=MIN_SPEED, le=20)]
Duration = Annotated[float, Field(ge=0.1, le=3600)]
MAX_COORDINATE = 1000  # m, largest |x| and |y| of a point of a reference
Coordinate = Annotated[float, Field(ge=-MAX_COORDINATE, le=MAX_COORDINATE)]
EndCurvature = Annotated[float, Field(ge=-20, le=20)]

# Polynomials that rise from 0 to 1 on (0, 1); the first 2 (quintic) or 3 (septic) derivatives vanish at both ends.
_QUINTIC = Polynomial([0, 0, 0, 10, -15, 6])
_SEPTIC = Polynomial([0, 0, 0, 0, 35, -84, 70, -20])
# Gauss-Legendre quadrature on (0, 1) for a corner of the square, exact to rounding.
_CORNER_NODES, _CORNER_WEIGHTS = (np.polynomial.legendre.leggauss(24) + np.array([[1], [0]])) / 2


class Motion(NamedTuple):
    """Samples of a reference at T times."""

    pose: Array
    """x in m, y in m and θ in rad of P, with θ continuous in time. Shape (T, 3)."""
    twist: Array
    """V in m/s, negative in reverse, and θ̇ in rad/s. Shape (T, 2)."""
    acceleration: Array
    """V̇ in m/s² and θ̈ in rad/s². Shape (T, 2)."""


def from_curve(p: Plane, d1: Plane, d2: Plane, d3: Plane, heading: Array | None = None) -> Motion:
    """Computes the motion of a robot that drives forward along a regular curve p(t).

    Args:
        p: Position x + i y in m. Shape (T,).
        d1: First derivative in m/s, nowhere zero. Shape (T,).
        d2: Second derivative in m/s². Shape (T,).
        d3: Third derivative in m/s³. Shape (T,).
        heading: θ = arg d1 in rad on a continuous branch; by default the principal branch. Shape (T,).
    """
    log = d2 / d1
    v = np.abs(d1)
    theta = np.angle(d1) if heading is None else heading
    return _motion(p, theta, v, log.imag, v * log.real, (d3 / d1 - log**2).imag)


def along_path(
    p: Plane, heading: ArrayLike, curvature: ArrayLike, sharpness: ArrayLike, speed: ArrayLike, acceleration: ArrayLike
) -> Motion:
    """Computes the motion of a robot that follows a path p(s) by a time law s(t).

    The robot may rest (ṡ = 0) or reverse (ṡ < 0), because θ̇ = κ ṡ and θ̈ = κ s̈ + κ' ṡ² do not divide by the speed.

    Args:
        p: Position x + i y in m. Shape (T,).
        heading: θ in rad, continuous. Shape (T,) or ().
        curvature: κ in 1/m. Shape (T,) or ().
        sharpness: κ' = dκ/ds in 1/m². Shape (T,) or ().
        speed: ṡ in m/s. Shape (T,) or ().
        acceleration: s̈ in m/s². Shape (T,) or ().
    """
    k, dk, v, a = (np.asarray(value, float) for value in (curvature, sharpness, speed, acceleration))
    return _motion(p, heading, v, k * v, a, k * a + dk * v**2)


def _motion(p: Plane, *rest: ArrayLike) -> Motion:
    """Stacks position, θ, V, θ̇, V̇ and θ̈, each of shape (T,) or (), into a `Motion`."""
    columns = np.stack([np.broadcast_to(column, p.shape) for column in (p.real, p.imag, *rest)], -1)
    return Motion(columns[:, :3], columns[:, 3:5], columns[:, 5:])


class Line(Record):
    """A straight line at constant speed. `length` sets the length of a lap; the line itself goes on."""

    kind: Literal["line"] = "line"
    """Kind of the reference."""
    speed: Speed = 0.8
    """Speed along the line in m/s."""
    length: Length = 8.0
    """Length of a lap in m."""
    heading: Annotated[float, Field(ge=-np.pi, le=np.pi)] = 0.0
    """Direction of the line in rad, counter-clockwise from +x."""

    @property
    def period(self) -> float:
        """Time of a lap in s."""
        return self.length / self.speed

    def sample(self, t: Array) -> Motion:
        """Samples the line at the times t in s, shape (T,)."""
        return along_path(cmath.rect(self.speed, self.heading) * t, self.heading, 0, 0, self.speed, 0)


class Circle(Record):
    """A circle at constant speed, counter-clockwise unless `clockwise` is set."""

    kind: Literal["circle"] = "circle"
    """Kind of the reference."""
    radius: Length = 1.0
    """Radius of the circle in m."""
    period: Duration = 8.0
    """Time of one lap in s."""
    clockwise: bool = False
    """Drive clockwise, to the right."""

    def sample(self, t: Array) -> Motion:
        """Samples the circle at the times t in s, shape (T,)."""
        turn = -1.0 if self.clockwise else 1.0
        theta = turn * 2 * np.pi / self.period * t
        p = turn * 1j * self.radius * (1 - np.exp(1j * theta))
        return along_path(p, theta, turn / self.radius, 0, 2 * np.pi * self.radius / self.period, 0)


class Lemniscate(Record):
    """The figure of eight of Gerono, x = a sin s, y = a sin s cos s, s = 2πt/period; it starts at 45°."""

    kind: Literal["lemniscate"] = "lemniscate"
    """Kind of the reference."""
    size: Length = 1.5
    """Half the length of the figure [a] in m, which is also its whole width."""
    period: Duration = 12.0
    """Time of one lap in s."""

    def sample(self, t: Array) -> Motion:
        """Samples the lemniscate at the times t in s, shape (T,)."""
        a, w = self.size, 2 * np.pi / self.period
        s = w * t
        p, d1, d2, d3 = (
            a * w**n * (np.sin(s + n * np.pi / 2) + 0.5j * 2**n * np.sin(2 * s + n * np.pi / 2)) for n in range(4)
        )
        # θ swings between 45° and -225°, so the branch that is cut along +y is continuous.
        return from_curve(p, d1, d2, d3, np.angle(1j * d1) - np.pi / 2)


class LaneChange(Record):
    """A lane change to the left at constant speed along x, and straight on afterwards; θ̈ is continuous."""

    kind: Literal["lane_change"] = "lane_change"
    """Kind of the reference."""
    length: Length = 4.0
    """Length of the lane change along x in m."""
    shift: Annotated[float, Field(ge=-1000, le=1000)] = 1.0
    """Shift to the left in m; a negative shift is to the right."""
    speed: Speed = 0.8
    """Speed along x in m/s; the speed along the path is higher during the change."""

    @property
    def period(self) -> float:
        """Time of the change in s."""
        return self.length / self.speed

    def sample(self, t: Array) -> Motion:
        """Samples the lane change at the times t in s, shape (T,)."""
        u = np.clip(t / self.period, 0, 1)
        y, y1, y2, y3 = (self.shift * _SEPTIC.deriv(n)(u) / self.period**n for n in range(4))
        return from_curve(self.speed * t + 1j * y, self.speed + 1j * y1, 1j * y2, 1j * y3)


class RoundedSquare(Record):
    """A square with rounded corners at constant speed, counter-clockwise from the middle of its lower side."""

    kind: Literal["rounded_square"] = "rounded_square"
    """Kind of the reference."""
    side: Length = 2.0
    """Side of the square in m."""
    radius: Length = 0.4
    """Smallest radius of curvature of a corner in m; a corner takes up 1.73 times as much of each side."""
    speed: Speed = 0.5
    """Speed along the path in m/s."""

    @model_validator(mode="after")
    def _fits(self) -> RoundedSquare:
        if self._reach > self.side / 2:
            most = self.radius * self.side / 2 / self._reach
            raise ValueError(f"radius: corners do not fit a side of {self.side:g} m; at most {most:.4g} m")
        return self

    @property
    def _corner(self) -> float:
        """Arc length of a corner in m, from κ_max = (π/2) S'(1/2) / length."""
        return np.pi / 2 * self.radius * float(_QUINTIC.deriv()(0.5))

    @property
    def _reach(self) -> float:
        """Length that one corner takes up of each of its sides in m."""
        return self._corner * float(_turn(np.ones(1))[0].real)

    @property
    def period(self) -> float:
        """Time of one lap in s."""
        return 4 * (self.side - 2 * self._reach + self._corner) / self.speed

    def sample(self, t: Array) -> Motion:
        """Samples the square at the times t in s, shape (T,).

        Along a corner θ is a quintic step of arc length, so that curvature rises from zero and returns smoothly, and θ̈
        is continuous. The position is the integral of e^{iθ}, by Gauss quadrature to machine precision.
        """
        corner, straight = self._corner, self.side / 2 - self._reach
        quarter, s = np.divmod(self.speed * t, 2 * straight + corner)
        u = np.clip((s - straight) / corner, 0, 1)
        p = np.minimum(s, straight) + corner * _turn(u) + 1j * np.maximum(s - straight - corner, 0)
        centre, turn = 1j * self.side / 2, np.pi / 2
        return along_path(
            centre + (p - centre) * 1j**quarter,
            turn * (quarter + _QUINTIC(u)),
            turn * _QUINTIC.deriv()(u) / corner,
            turn * _QUINTIC.deriv(2)(u) / corner**2,
            self.speed,
            0,
        )


def _turn(u: Array) -> Plane:
    """Position along a left corner of unit arc length, ∫ exp(i π/2 S(w)) dw from 0 to u; u and result of shape (T,)."""
    theta = np.pi / 2 * _QUINTIC(np.multiply.outer(u, _CORNER_NODES))
    return u * (np.cos(theta) @ _CORNER_WEIGHTS + 1j * (np.sin(theta) @ _CORNER_WEIGHTS))


class StopAndGo(Record):
    """Moves from rest to rest along a straight line, forward and back or always forward; V̇ is continuous."""

    kind: Literal["stop_and_go"] = "stop_and_go"
    """Kind of the reference."""
    distance: Length = 2.0
    """Distance between stops in m."""
    move_time: Duration = 3.0
    """Duration of a move in s; the largest speed is 1.875 distance / move_time."""
    pause: Annotated[float, Field(ge=0, le=3600)] = 1.0
    """Duration of the rest after each move in s."""
    reverse: bool = True
    """Drive every second move backwards to the start."""

    @property
    def period(self) -> float:
        """Time of one cycle in s: a move and a rest, or two of each where it reverses."""
        return (2 if self.reverse else 1) * (self.move_time + self.pause)

    def sample(self, t: Array) -> Motion:
        """Samples the moves at the times t in s, shape (T,)."""
        move, since = np.divmod(t, self.move_time + self.pause)
        u = np.clip(since / self.move_time, 0, 1)
        back = (move % 2 == 1) if self.reverse else np.zeros(t.shape, bool)
        start, sign = np.where(back, 1, 0 if self.reverse else move), np.where(back, -1, 1)
        x, v, a = (sign * self.distance * _QUINTIC.deriv(n)(u) / self.move_time**n for n in range(3))
        return along_path(start * self.distance + x + 0j, 0, 0, 0, v, a)


MAX_CUSP_KINK = 0.15  # rad, largest change of the heading at a cusp
_LOOP = ((0.0, 0.0), (1.5, 0.0), (3.0, 0.8), (2.5, 2.2), (1.0, 1.6), (-0.8, 2.0), (-1.2, 0.6))


class Waypoints(Record):
    """A quintic spline through points, at constant or changing speed; an open one ends at rest on its last point."""

    kind: Literal["waypoints"] = "waypoints"
    """Kind of the reference."""
    points: tuple[tuple[Coordinate, Coordinate], ...] = _LOOP
    """Points (x, y) in m in their order; a closed curve returns to the first by itself."""
    speed: Speed = 0.6
    """Speed along the path in m/s; with `timing` = `limits` the largest one."""
    closed: bool = True
    """Close the curve from the last point to the first."""
    stop_time: Duration = 2.0
    """Duration in s of the braking at the end of an open curve, whose speed is constant before."""
    timing: Literal["constant", "limits"] = "constant"
    """Keep the speed all along the path (`constant`), or drive nearly as fast as the `limits` allow, on an open curve
    from `start_speed`; `mrctl.theory.timing.smooth` says how much time the continuous acceleration costs."""
    limits: Limits = Limits()
    """Limits that `timing` = `limits` keeps, besides the speed; by default those of the default car, whatever robot
    drives. `Limits.of(robot)` are those of another one."""
    cusps: tuple[Annotated[int, Field(ge=0)], ...] = ()
    """Indices of the points at which the robot stops and drives on in the other direction, with 0 for a start in
    reverse; only for an open curve with `timing` = `limits`."""
    start_speed: Annotated[float, Field(ge=0, le=20)] = 0.0
    """Speed along the path at the beginning in m/s, or the largest from which the limits can be kept, if that is less;
    only for an open curve with `timing` = `limits`. Less than 1 mm/s counts as rest."""
    start_curvature: EndCurvature = 0.0
    """Curvature in 1/m of the arc through the first two points with which an open curve begins, positive to the left; 0
    for a beginning without curvature and sharpness."""
    end_curvature: EndCurvature = 0.0
    """Curvature in 1/m of the arc through the last two points with which an open curve ends, likewise."""
    cusp_curvatures: tuple[tuple[EndCurvature, EndCurvature], ...] = ()
    """Curvatures in 1/m with which the curve comes to each cusp between its ends and leaves it, positive to the left of
    the way, as at the ends; empty where all are 0."""

    @model_validator(mode="after")
    def _regular(self) -> Waypoints:
        if self.start_speed and (self.closed or self.timing != "limits"):
            raise ValueError("start_speed: only an open curve with timing = limits has one")
        for name in ("start_curvature", "end_curvature"):
            if getattr(self, name) and self.closed:
                raise ValueError(f"{name}: only an open curve has one")
        if len(self.cusp_curvatures) not in (0, between := sum(cusp > 0 for cusp in self.cusps)):
            raise ValueError(f"cusp_curvatures: must be {between} pairs, one for each cusp between the ends")
        if self.cusps:
            return self._turning()
        least = 3 if self.closed else 2
        if len(self.points) < least:
            raise ValueError(f"points: {'a closed' if self.closed else 'an open'} curve needs at least {least} points")
        self._check_gaps(1e-3, "start_curvature", "end_curvature")
        self._check_turns()
        if self.timing == "limits":
            _ = self._law  # raises for limits with which the robot cannot move
        elif not self.closed and self.speed * self.stop_time / 2 > self._path.length:
            raise ValueError(f"stop_time: too long to stop from {self.speed:g} m/s within {self._path.length:.2f} m")
        return self

    def _check_turns(self) -> None:
        """Refuses a curve that turns on the spot; a regular one has |dp/du| near 1, as u is the length of chords."""
        slow, where = self._path.slowest
        if slow < 0.02:
            raise ValueError(f"points: the curve turns on the spot near ({where.real:.2f}, {where.imag:.2f})")

    def _check_gaps(self, least: float, first: str, last: str) -> None:
        """Refuses neighbours that are nearer than so many m, and ends that are no arcs; takes the names of these."""
        gaps = np.abs(np.diff(plane(self.points, self.closed)))
        if gaps.min() < least:
            k = int(gaps.argmin())
            returns = "; a closed curve returns to the first by itself" if k + 1 == len(self.points) else ""
            raise ValueError(f"points: {k} and {(k + 1) % len(self.points)} coincide{returns}")
        for name, curvature, gap in ((first, self.start_curvature, gaps[0]), (last, self.end_curvature, gaps[-1])):
            if abs(curvature) * gap >= 2:
                raise ValueError(f"{name}: no arc through two points that are {gap:.2f} m apart has so much")

    def _turning(self) -> Waypoints:
        """Checks a curve with cusps, each part of it as a curve of its own."""
        if self.closed or self.timing != "limits":
            raise ValueError("cusps: only an open curve with timing = limits has them")
        if list(self.cusps) != sorted(set(self.cusps)) or self.cusps[-1] >= len(self.points) - 1:
            raise ValueError(f"cusps: must increase, and be before the last point, {len(self.points) - 1}")
        heading = None
        parts = self._parts
        for k, (part, back) in enumerate(parts):
            first = "cusp_curvatures" if k else "start_curvature"
            part._check_gaps(1e-9, first, "cusp_curvatures" if k < len(parts) - 1 else "end_curvature")
            part._check_turns()
            ends = part._path.heading[[0, -1]] + np.pi * back
            if heading is not None and abs(cmath.phase(cmath.exp(1j * (ends[0] - heading)))) > MAX_CUSP_KINK:
                raise ValueError(f"cusps: the curve turns by more than {MAX_CUSP_KINK:g} rad at a cusp")
            heading = ends[1]
        return self

    @property
    def _parts(self) -> list[tuple[Waypoints, bool]]:
        """The curves between the cusps, and whether each is driven in reverse."""
        places = [0, *(cusp for cusp in self.cusps if cusp), len(self.points) - 1]
        first, between = 0 in self.cusps, self.cusp_curvatures or ((0.0, 0.0),) * (len(places) - 2)
        curvatures = [self.start_curvature, *chain.from_iterable(between), self.end_curvature]
        whole = self.model_copy(update={"cusps": (), "cusp_curvatures": ()})
        parts = []
        for k, (a, b) in enumerate(pairwise(places)):
            ends = {"start_curvature": curvatures[2 * k], "end_curvature": curvatures[2 * k + 1]}
            rest = {"start_speed": 0.0} if k else {}
            back = (k + first) % 2 == 1
            limits = self.limits.in_reverse if back else self.limits
            part = whole.model_copy(update={"points": self.points[a : b + 1], "limits": limits, **ends, **rest})
            parts.append((part, back))
        return parts

    def _sample_parts(self, t: Array) -> Motion:
        """Samples a curve with cusps at the times t in s, shape (T,); V is negative in reverse."""
        samples, since, heading = np.empty((len(t), 7)), 0.0, 0.0
        for part, back in self._parts:
            path = part._path
            s, v, a = part._law.at(np.maximum(t - since, 0.0))
            p, theta, k, dk = path.at(s)
            sign = -1.0 if back else 1.0
            start = path.heading[0] + np.pi * back
            turn = 2 * np.pi * round((heading - start) / (2 * np.pi))
            moved = along_path(p, theta + np.pi * back + turn, sign * k, dk, sign * v, sign * a)
            now = (t >= since) | (since == 0)
            samples[now] = np.hstack(moved)[now]
            since, heading = since + part._law.duration, path.heading[-1] + np.pi * back + turn
        return Motion(samples[:, :3], samples[:, 3:5], samples[:, 5:])

    @property
    def _path(self) -> Spline:
        return spline(self.points, self.closed, (self.start_curvature, self.end_curvature))

    @property
    def _law(self) -> SmoothLaw:
        start = self.start_speed if self.start_speed >= 1e-3 else 0.0
        curvatures = self.start_curvature, self.end_curvature
        return _time_law(self.points, self.closed, curvatures, self.speed, self.limits, start)  # type: ignore[arg-type]

    @property
    def period(self) -> float:
        """Time of one lap, or until rest, in s."""
        if self.cusps:
            return sum(part.period for part, _ in self._parts)
        if self.timing == "limits":
            return self._law.duration
        return self._path.length / self.speed + (0 if self.closed else self.stop_time / 2)

    def sample(self, t: Array) -> Motion:
        """Samples the spline at the times t in s, shape (T,).

        A closed spline is periodic with four continuous derivatives. An open one has the given curvatures at its ends.
        """
        if self.cusps:
            return self._sample_parts(t)
        if self.timing == "limits":
            s, v, a = self._law.at(t)
            return along_path(*self._path.at(s), v, a)
        s, v, a = self.speed * t, np.full(t.shape, self.speed), np.zeros(t.shape)
        if not self.closed:
            brake = self.period - self.stop_time
            u = np.clip((t - brake) / self.stop_time, 0, 1)
            s = self.speed * (np.minimum(t, brake) + self.stop_time * (u - _QUINTIC.integ()(u)))
            v, a = self.speed * (1 - _QUINTIC(u)), -self.speed * _QUINTIC.deriv()(u) / self.stop_time
        return along_path(*self._path.at(s), v, a)


@lru_cache(maxsize=KEPT)
def _time_law(
    points: tuple[tuple[float, float], ...],
    closed: bool,
    curvatures: tuple[float, float],
    speed: float,
    limits: Limits,
    start: float,
) -> SmoothLaw:
    """The time law along the spline through the points."""
    curve = spline(points, closed, curvatures)
    path = sample_path(lambda s: curve.at(s)[2:], curve.s, closed, limits, speed, start)
    return smooth(path, limits, speed, start)


def random_spline(
    random: np.random.Generator, robot: Robot, speed: float = 0.95, share: float = LIMIT_SHARE
) -> Waypoints:
    """A random closed spline around the origin, driven at changing speed under the limits of a robot.

    The lateral acceleration is limited further, so that the robot takes the tightest curve at 0.3 to 0.8 of its largest
    speed; otherwise a robot that no other limit slows down would drive at constant speed.

    Args:
        random: Source of the draws.
        robot: The robot.
        speed: Largest V as a share of the robot's limit, between 0 and 1.
        share: Share of its other limits that the spline uses, between 0 and 1.
    """
    limits, top = Limits.of(robot, share), speed * robot.max_speed
    while True:
        count = int(random.integers(4, 9))
        angles = 2 * np.pi * (np.arange(count) + random.uniform(-0.25, 0.25, count)) / count
        p = np.round(random.uniform(0.9, 2.0, count) * np.exp(random.choice([-1j, 1j]) * angles), 3)
        slow = top * random.uniform(0.3, 0.8)
        try:
            loop = Waypoints(points=tuple((float(z.real), float(z.imag)) for z in p), speed=top)
        except ValueError:  # the spline turns on the spot
            continue
        curve = spline(loop.points, loop.closed)
        tightest = float(np.abs(curve.at(curve.s)[2]).max())
        if np.arctan(abs(robot.wheelbase) * tightest) > share * robot.steering_limit:
            continue
        grip = {"lateral_acceleration": min(limits.lateral_acceleration, slow**2 * tightest)}
        return loop.model_copy(update={"timing": "limits", "limits": limits.model_copy(update=grip)})


Reference = Annotated[
    Line | Circle | Lemniscate | LaneChange | RoundedSquare | StopAndGo | Waypoints, Field(discriminator="kind")
]


@lru_cache(KEPT)
def check(reference: Reference, robot: Robot, reverse: bool) -> None:
    """Refuses a reference that the robot cannot follow; one that passed is not sampled again.

    Args:
        reference: The reference.
        robot: The robot, whose limits on speed, acceleration, steering angle and grip the reference must keep.
        reverse: Whether the robot can drive backwards with its steering.

    Raises:
        InputError: The reference reverses or exceeds a limit; the message has the quantity, its peak, the time of the
            peak and the limit.
    """
    if fault := _fault(reference, robot, reverse):
        raise InputError(f"reference {reference.kind}: {fault}{_remedy(reference, robot, reverse)}")


def _fault(reference: Reference, robot: Robot, reverse: bool) -> str:
    """Returns the first reason why a robot cannot follow a reference, or ""."""
    # Samples are at most 10 ms apart up to a period of 5000 s, so that short moves between long rests are seen.
    t = np.linspace(0, reference.period, int(np.clip(100 * reference.period, 2000, 500_000)) + 1)
    _, (v, omega), (v_dot, omega_dot) = (part.T for part in reference.sample(t))
    if not reverse and v.min() < -1e-9:
        when = t[np.argmax(v < -1e-9)]
        return f"reverses at t = {when:.2f} s, which compliant and caster steering cannot do; use rigid"
    # atan2 depends on θ̇/V alone as the robot comes to rest, and is zero at rest, which needs no steering angle.
    steering = np.arctan2(abs(robot.wheelbase) * np.abs(omega), np.abs(v))
    grip = robot.tyre_friction * robot.gravity
    for name, values, unit, limit, bound in (
        ("speed", v, "m/s", "max_speed", robot.max_speed),
        ("rotation", omega, "rad/s", "max_rotation", robot.max_rotation),
        ("acceleration", v_dot, "m/s²", "max_acceleration", robot.max_acceleration),
        ("rotation acceleration", omega_dot, "rad/s²", "max_rotation_acceleration", robot.max_rotation_acceleration),
        ("steering angle", steering, "rad", "steering_limit", robot.steering_limit),
        ("lateral acceleration", v * omega, "m/s²", "tyre_friction times gravity,", grip),
    ):
        worst = int(np.argmax(np.abs(values)))
        if not (peak := abs(values[worst])) <= bound * (1 + 1e-9):  # NaN is refused, too
            digits = next(n for n in range(3, 18) if f"{peak:.{n}g}" != f"{bound:.{n}g}")  # that tell them apart
            most = f"{limit} {bound:.{digits}g} {unit}"
            return f"{name} {peak:.{digits}g} {unit} at t = {t[worst]:.2f} s exceeds the robot's {most}"
    return ""


def enlarged(reference: Reference, robot: Robot, reverse: bool) -> Circle | Lemniscate | None:
    """Returns a circle or lemniscate slowed so that a robot can follow it, and enlarged where no period is enough.

    Args:
        reference: The reference.
        robot: The robot.
        reverse: Whether the robot can drive backwards with its steering.

    Returns:
        The reference; None if no such reference is found, or for one of another kind.
    """
    if not isinstance(reference, (Circle, Lemniscate)):
        return None
    name = "radius" if isinstance(reference, Circle) else "size"
    for larger, slower in product(range(12), range(12)):
        size, period = getattr(reference, name) * 2 ** (larger / 4), reference.period * 2 ** (slower / 4)
        with contextlib.suppress(InputError):  # beyond the bounds of the fields
            found = reference.replace(**{name: round(size, 2), "period": round(period, 1)})
            if not _fault(found, robot, reverse):
                return found
    return None


def _remedy(reference: Reference, robot: Robot, reverse: bool) -> str:
    """Returns the end of an error message, a circle or lemniscate that the robot can follow, or ""."""
    found = enlarged(reference, robot, reverse)
    if found is None:
        return ""
    size = f"radius {found.radius:g}" if isinstance(found, Circle) else f"size {found.size:g}"
    return f"; {size} m with period {found.period:g} s would do"
