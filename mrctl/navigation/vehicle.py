"""The robot of a scenario as planners and avoiders see it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mrctl.kernel import Array
from mrctl.physics import mjcf
from mrctl.physics.hull import footprint
from mrctl.scenario import Scenario
from mrctl.theory.robot import Robot


class Vehicle(NamedTuple):
    """A robot on the plane."""

    footprint: Array
    """Corners of its outline in its frame in m, counter-clockwise, `(n, 2)`."""
    robot: Robot
    """Its nominal parameters."""
    reverses: bool
    """Whether it can be driven backwards."""

    @property
    def length(self) -> float:
        """Length in m."""
        return float(np.ptp(self.footprint[:, 0]))

    @property
    def width(self) -> float:
        """Width in m."""
        return float(np.ptp(self.footprint[:, 1]))

    @classmethod
    def of(cls, scenario: Scenario) -> Vehicle:
        """Returns the robot of a scenario."""
        model, robot = mjcf.build(scenario.world, scenario.steering, robot=scenario.robot)
        return cls(footprint(model), robot, mjcf.reverses(model, scenario.steering))
