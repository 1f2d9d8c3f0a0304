"""The robot of a scenario as planners and avoiders see it: its outline, its parameters, and whether it reverses."""

from __future__ import annotations

from mrctl.kernel import Array
from mrctl.physics import mjcf
from mrctl.physics.hull import footprint
from mrctl.scenario import Scenario
from mrctl.theory.robot import Robot


def robot_of(scenario: Scenario) -> tuple[Array, Robot]:
    """Returns the footprint of a scenario's robot, corners in m, `(n, 2)`, and its parameters."""
    model, robot = mjcf.build(scenario.world, scenario.steering, robot=scenario.robot)
    return footprint(model), robot


def reverses(scenario: Scenario) -> bool:
    """Tells whether a scenario's robot can be driven backwards."""
    model, _ = mjcf.build(scenario.world, scenario.steering, robot=scenario.robot)
    return mjcf.reverses(model, scenario.steering)
