"""The way that a robot came, on which it goes back out of a place from which no plan leads on.

It steers by pure pursuit: along the arc to a place on that way, whose curvature is 2 y / (x² + y²) with x and y of the
place in the frame of the robot (Coulter, "Implementation of the pure pursuit path tracking algorithm", Carnegie Mellon
University, 1992).
"""

from __future__ import annotations

from collections import deque

import numpy as np

from mrctl.kernel import Array
from mrctl.navigation.barrier import approach
from mrctl.navigation.planning import REACTION_TIME
from mrctl.theory.clearance import clearance
from mrctl.theory.obstacles import Outlines

# All values are chosen.
# number of places that are remembered, and the least distance of two of them in m
MAX_PLACES, PLACE_SPACING = 200, 0.02
LOOKAHEAD = 0.2  # distance in m of the place behind the robot to which it steers
CHECKED_BEHIND = 0.1  # distance in m by which it looks ahead on its way back whether it would touch an obstacle


class Trail:
    """The way that one robot came."""

    def __init__(self, footprint: Array, curvature: float, acceleration: float) -> None:
        """Begins an empty trail.

        Args:
            footprint: Corners of the robot in its frame in m, `(n, 2)`.
            curvature: Largest |θ̇| / |V| in 1/m.
            acceleration: Largest |V̇| in m/s², with which the robot brakes.
        """
        self._footprint, self._curvature = footprint, curvature
        self._fastest = float(approach(CHECKED_BEHIND, acceleration, REACTION_TIME))
        self._places = deque[Array](maxlen=MAX_PLACES)

    def add(self, pose: Array) -> None:
        """Remembers where the robot is, x and y in m and θ in rad, `(3,)`."""
        if not self._places or np.hypot(*(pose[:2] - self._places[-1])) > PLACE_SPACING:
            self._places.append(pose[:2].copy())

    def back(self, pose: Array, speed: float, outlines: Outlines) -> Array | None:
        """Returns the twist with which the robot goes back, V in m/s and θ̇ in rad/s, `(2,)`.

        Args:
            pose: x and y in m and θ in rad, `(3,)`.
            speed: Speed in m/s with which it goes back, if it can stop from that within `CHECKED_BEHIND`.
            outlines: The obstacles.

        Returns:
            The twist, or None at the beginning of the trail, or where the robot would touch an obstacle.
        """
        while self._places and np.hypot(*(pose[:2] - self._places[-1])) < LOOKAHEAD:
            self._places.pop()
        if not self._places:
            return None
        c, s = np.cos(pose[2]), np.sin(pose[2])
        x, y = np.array([[c, s], [-s, c]]) @ (self._places[-1] - pose[:2])
        curvature = np.clip(2 * y / (x * x + y * y), -self._curvature, self._curvature)
        if clearance(self._footprint, pose - CHECKED_BEHIND * np.array([c, s, curvature]), outlines) <= 0:
            return None
        return -min(speed, self._fastest) * np.array([1.0, curvature])
