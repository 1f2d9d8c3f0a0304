"""A robot that drives a plan: from a generated world to an arrival without a touch."""

import numpy as np

from mrctl import Limits, Scenario, simulate
from mrctl.navigation.generators import doorway
from mrctl.navigation.planning import plan, shortcut, space
from mrctl.physics import mjcf
from mrctl.physics.hull import footprint
from mrctl.sensing.tiers import Sensing
from mrctl.theory.obstacles import Surroundings


def test_through_a_door():
    """The car drives from room to room through a door of 0.8 m, with a lidar as its only fix, and stops at the goal."""
    task = doorway(0.8, seed=2)
    low, high = task.obstacles.bounds
    model, robot = mjcf.build()
    where = space(Surroundings(task.obstacles).at(0.0), footprint(model), low, high)
    found = shortcut(where, plan(where, task.start, task.goal, 0.7, False), 0.7, False)
    scenario = Scenario(
        obstacles=task.obstacles, reference=found.reference(0.6, Limits.of(robot)), laps=1, learner="none",
        sensing=Sensing(tier="lab", localisation="scan"), initial_spread=(0.01, 0.01, 0.01),
    )  # fmt: skip
    result = simulate(scenario)
    assert not result["failed"] and float(result["clearance"].min()) > 0.02
    end = result.isel(time=-1)
    assert np.hypot(end["x"] - task.goal[0], end["y"] - task.goal[1]) < 0.05
    assert abs(float(end["theta"]) - task.goal[2]) < 0.1 and abs(float(end["v"])) < 0.05
