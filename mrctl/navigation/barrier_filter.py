"""A filter that changes a requested twist as little as the barrier of `barrier` asks for.

`avoid` returns the nearest of the twists that are allowed, and `Avoiding` is a motion stage whose requests pass it, by
what the robot knows: its map, and what its lidar sees beside the map (`Sight`). Both are for motion controllers of a
user. A mission with `barrier` follows a plan in time, which `pacing` slows by the same barrier instead.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from mrctl.control.stages import MotionStage
from mrctl.kernel import Array, kernel
from mrctl.navigation.barrier import Barrier, half_planes, scratch
from mrctl.navigation.sight import Sight
from mrctl.scenario import Scenario
from mrctl.theory.obstacles import Outlines
from mrctl.theory.rays import Scan
from mrctl.theory.robot import Robot


def avoid(request: Array, pose: Array, outlines: Outlines, barrier: Barrier) -> Array:
    """Returns the allowed twist that is nearest to a request; the request itself where it is allowed.

    Args:
        request: Requested V in m/s and θ̇ in rad/s, `(2,)`.
        pose: x and y in m and θ in rad, `(3,)`.
        outlines: The obstacles.
        barrier: Discs, margin and braking of the robot.
    """
    found = np.empty(2)
    rows = scratch(outlines, barrier)
    allowed.compiled(np.asarray(request, float), np.asarray(pose, float), outlines, barrier, rows, found)
    return found


class Avoiding:
    """A motion stage whose request passes the filter: `simulate(…, motion=lambda *robots: Avoiding(*robots, …))`.

    Obstacles on the map are known; the others are seen by the lidar, and taken where they are, as if they stood.
    """

    def __init__(self, robot: Robot, size: int, motion: Callable[[Robot, int], MotionStage], barrier: Barrier) -> None:
        """Makes the stage.

        Args:
            robot: Nominal robot.
            size: Number of robots.
            motion: Factory of the motion stage that makes the requests.
            barrier: Discs, margin and braking of the robots.
        """
        self._motion, self._barrier = motion(robot, size), barrier

    def assign(self, scenarios: Sequence[Scenario]) -> None:
        """Takes the scenarios of the robots, with their maps, and hands them on to the motion stage."""
        self._sights = Sight.each(scenarios)
        if take := getattr(self._motion, "assign", None):
            take(scenarios)

    def reset(self, pose: Array, reference: Array, period: float) -> None:
        """Starts a run; the arguments are those of `mrctl.control.stages.MotionStage`."""
        self._motion.reset(pose, reference, period)
        self._time, self._period = 0.0, period
        for sight in self._sights:
            sight.forget()

    def see(self, row: int, scan: Scan) -> None:
        """Takes a scan of one robot, for the filter and for the motion stage, if that takes scans."""
        self._sights[row].see(scan)
        if look := getattr(self._motion, "see", None):
            look(row, scan)

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401
        """Returns the method `follow` or `tune` of the motion stage, which a stage has or has not."""
        if name in ("follow", "tune"):
            return getattr(self._motion, name)
        raise AttributeError(name)

    @property
    def followed(self) -> Array | None:
        """What the robots follow, as in `mrctl.control.stages.MotionStage`."""
        return getattr(self._motion, "followed", None)

    def output(self, pose: Array, twist: Array, reference: Array) -> Array:
        """Returns the allowed twist, `(B, 2)`; the arguments are those of `mrctl.control.stages.MotionStage`."""
        requests = np.asarray(self._motion.output(pose, twist, reference))
        around = [sight.outlines(self._time) for sight in self._sights]
        self._time += self._period
        return np.stack([avoid(*own, self._barrier) for own in zip(requests, pose, around, strict=True)])


@kernel
def allowed(request: Array, pose: Array, outlines: Outlines, barrier: Barrier, rows: Array, found: Array) -> None:
    """Writes what `avoid` returns into `found`; `rows` is scratch with a row for each disc and obstacle, `(m, 3)`."""
    n = half_planes(request, pose, outlines, barrier, rows)
    found[0], found[1] = nearest(request[0], barrier.lever * request[1], rows[:n])
    if found[0] == request[0] and found[1] == barrier.lever * request[1]:
        found[1] = request[1]  # bit for bit
    else:
        found[1] /= barrier.lever


@kernel
def nearest(x: float, y: float, rows: Array) -> tuple[float, float]:
    """Returns the point of an intersection of half-planes that is nearest to (x, y).

    The half-planes are taken one by one. Where the nearest point so far is outside the next one, the new one is on its
    border, and is there the foot of the perpendicular, cut to what the half-planes before leave of it (as in the
    programme in two variables of van den Berg, Guy, Lin and Manocha, "Reciprocal n-body collision avoidance", 2011).

    Args:
        x: First coordinate.
        y: Second coordinate.
        rows: a, b and c of each half-plane a x + b y ≥ c, `(m, 3)`; the origin is in all, so c ≤ 0.
    """
    px, py = x, y
    for k in range(len(rows)):
        a, b, c = rows[k]
        square = a * a + b * b
        if a * px + b * py >= c or square < 1e-18:
            continue
        fx, fy = c * a / square, c * b / square  # the point of the border that is nearest to the origin
        low, high = -np.inf, np.inf  # of s on the border f + s (−b, a)
        for i in range(k):
            slope = rows[i, 1] * a - rows[i, 0] * b
            rest = rows[i, 2] - rows[i, 0] * fx - rows[i, 1] * fy
            if slope > 1e-12:
                low = max(low, rest / slope)
            elif slope < -1e-12:
                high = min(high, rest / slope)
        if low > high + 1e-9:
            return 0.0, 0.0  # by rounding nothing is left but rest
        s = min(max((a * y - b * x) / square, low), high)
        px, py = fx - s * b, fy + s * a
    return px, py
