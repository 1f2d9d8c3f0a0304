"""The lidars of B robots, whose scans serve localisation, motion controllers that avoid obstacles, and agents."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mrctl.kernel import Array
from mrctl.record import InputError
from mrctl.sensing.tiers import Sensing
from mrctl.theory.obstacles import Obstacles, Surroundings


class Scanner:
    """Lidars that scan from the true poses of their robots, at the first tick of a run and then at their own rates.

    Attributes:
        lidars: Lidar of each robot.
        scans: Last scan of each robot, ranges in m, `(beams,)`; None before the first one.
        taken: Control tick at which each of them was taken, `(B,)`; −1 before the first one.
    """

    def __init__(self, sensing: Sequence[Sensing], period: float, obstacles: Sequence[Obstacles]) -> None:
        """Takes what the lidars need.

        Args:
            sensing: Sensing of each robot.
            period: Control period in s.
            obstacles: Obstacles that the beams of each robot meet.

        Raises:
            InputError: The time between two scans is not a whole number of control periods.
        """
        self.lidars, self._period = [s.lidar for s in sensing], period
        made = {world: Surroundings(world) for world in set(obstacles)}
        self._surroundings = [made[world] for world in obstacles]
        try:
            self._every = [lidar.every(period) for lidar in self.lidars]
        except ValueError as error:
            raise InputError(str(error)) from None
        size = len(self.lidars)
        self.scans: list[Array | None] = [None] * size
        self.taken, self._start = np.full(size, -1), np.zeros(size, int)
        self._random = [np.random.default_rng()] * size

    def start(self, row: int, seed: int, tick: int) -> None:
        """Starts the lidar of one robot; the seed determines its noise, and its first scan is at the coming tick."""
        self._random[row], self._start[row] = np.random.default_rng([seed, 6]), tick
        self.scans[row], self.taken[row] = None, -1

    def scan(self, tick: int, poses: Array, failed: NDArray[np.number]) -> None:
        """Takes the scans that are due in a tick, once.

        Args:
            tick: Control tick.
            poses: True x and y of P in m and θ in rad of each robot, `(B, 3)`.
            failed: Whether each robot has failed, `(B,)`; one that has does not scan.
        """
        for row, lidar in enumerate(self.lidars):
            since = int(tick - self._start[row])
            if since % self._every[row] == 0 and self.taken[row] != tick and not failed[row]:
                around = self._surroundings[row].at(since * self._period)
                self.scans[row] = lidar.scan(poses[row], around, self._random[row])
                self.taken[row] = tick
