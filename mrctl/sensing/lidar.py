"""A planar lidar: beams in a fan about the heading, with noise and beams that are lost."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from mrctl.kernel import Array
from mrctl.record import Record, is_whole
from mrctl.theory.obstacles import Outlines, turned
from mrctl.theory.rays import cast

MIN_RATE = 1e-3  # Hz, lowest rate of a sensor that is not 0; memory is needed for two periods of the encoders
FREE_MARGIN = 0.2  # m before what a beam met, up to which there is nothing for sure


class Lidar(Record):
    """A planar lidar; the defaults are about the values of an RPLIDAR A1."""

    rate: Annotated[float, Field(ge=MIN_RATE, le=1000)] = 10.0
    """Rate of the scans in Hz; all beams of a scan are taken at the same time."""
    beams: Annotated[int, Field(ge=1, le=10_000)] = 360
    """Number of beams of a scan."""
    view: Annotated[float, Field(ge=0.01, le=2 * np.pi)] = 2 * np.pi
    """Field of view in rad, half of it to either side of straight ahead."""
    range: Annotated[float, Field(ge=0.1, le=1000)] = 12.0
    """Largest range in m, beyond which a beam returns nothing."""
    noise: Annotated[float, Field(ge=0, le=1)] = 0.02
    """Standard deviation of a range in m."""
    lost: Annotated[float, Field(ge=0, le=1)] = 0.0
    """Share of the beams that return nothing though they meet an obstacle."""
    x: Annotated[float, Field(ge=-10, le=10)] = 0.0
    """Distance of the lidar ahead of P in m."""

    @property
    def step(self) -> float:
        """Angle from one beam to the next in rad; the beams are in the middles of equal parts of the view."""
        return self.view / self.beams

    @property
    def first(self) -> float:
        """Direction of the first beam from straight ahead in rad."""
        return (self.step - self.view) / 2

    @property
    def angles(self) -> Array:
        """Directions of the beams from straight ahead in rad, counter-clockwise, `(beams,)`."""
        return self.first + self.step * np.arange(float(self.beams))

    def every(self, period: float) -> int:
        """Returns the time between two scans in control periods of this duration in s.

        Raises:
            ValueError: It is not a whole number of them.
        """
        count = 1 / (self.rate * period)
        if round(count) < 1 or not is_whole(count):
            raise ValueError(f"sensing.lidar.rate: {self.rate:g} Hz is no whole fraction of the control rate")
        return round(count)

    def place(self, pose: Array) -> Array:
        """Returns the pose of the lidar in m, m, rad, `(3,)`, where P is at this pose."""
        return np.append(turned(np.array([[self.x, 0.0]]), pose)[0], pose[2])

    def scan(self, pose: Array, outlines: Outlines, random: np.random.Generator) -> Array:
        """Takes a scan.

        Args:
            pose: x and y of P in m and θ in rad, `(3,)`.
            outlines: The obstacles.
            random: Source of noise and lost beams; each scan takes the same number of values from it.

        Returns:
            Ranges in m, `(beams,)`; infinite where nothing returns, as in ROS (REP 117).
        """
        ranges = np.empty(self.beams)
        cast.compiled(self.place(pose), self.first, self.step, self.range, outlines, ranges)
        noise, chance = random.standard_normal(self.beams), random.uniform(size=self.beams)
        ranges[(ranges >= self.range) | (chance < self.lost)] = np.inf
        return np.maximum(ranges + self.noise * noise, 0.0)

    def points(self, ranges: Array, most: int = 10_000) -> Array:
        """Returns the points that beams of a scan met.

        Args:
            ranges: Ranges of a scan in m, `(beams,)`.
            most: Largest number of points, evenly spread over the beams that met something.

        Returns:
            x and y in the robot's frame in m, `(n, 2)`.
        """
        used = thinned(np.flatnonzero(np.isfinite(ranges)), most)
        return self._ends(used, ranges[used])

    def rays(self, ranges: Array, most: int) -> Array:
        """Returns the parts of beams of a scan on which there is nothing.

        They end `FREE_MARGIN` before what the beam met, or at the largest range. A beam that returns nothing though it
        meets an obstacle is not told from one that meets none.

        Args:
            ranges: Ranges of a scan in m, `(beams,)`.
            most: Largest number of beams to use, evenly spread over the view.

        Returns:
            x and y of start and end in the robot's frame in m, `(n, 4)`.
        """
        used = thinned(np.arange(self.beams), most)
        free = np.where(np.isfinite(ranges[used]), ranges[used] - FREE_MARGIN, self.range)
        ends = self._ends(used[free > 0], free[free > 0])
        return np.column_stack([np.full(len(ends), self.x), np.zeros(len(ends)), ends])

    def _ends(self, beams: NDArray[np.intp], ranges: Array) -> Array:
        """Returns the points at these ranges in m on some beams, x and y in the robot's frame in m, `(n, 2)`."""
        angles = self.first + self.step * beams
        return ranges[:, None] * np.column_stack([np.cos(angles), np.sin(angles)]) + [self.x, 0.0]


def thinned(beams: NDArray[np.intp], most: int) -> NDArray[np.intp]:
    """Returns at most so many of some beams, evenly spread over them."""
    return beams[:: max(1, -(-len(beams) // most))]
