"""A robot that drives a plan: from a generated world to an arrival without a touch."""

import numpy as np

from mrctl import Limits, Scenario, simulate
from mrctl.navigation.generators import doorway, parking_bay
from mrctl.navigation.hybrid_astar import plan, shortcut, space
from mrctl.navigation.mission import navigate
from mrctl.physics import mjcf
from mrctl.physics.hull import footprint
from mrctl.results.dataset import scenarios_of
from mrctl.sensing.tiers import Sensing
from mrctl.theory.obstacles import Surroundings


def test_parks():
    """The racing car, which has no way forward into a bay, goes back and forth, rests at every cusp, and parks."""
    scenario = Scenario(robot={"path": "racecar"}, steering="rigid", prior="model", learner="none")
    parked = navigate(parking_bay(1.5, 0.8, 1), scenario, margin=0.03)
    (own,) = scenarios_of(parked.result)
    assert parked.table["outcome"].tolist() == ["arrived"] and own.reference.cusps
    run = parked.result.isel(run=0)
    assert float(run["v"].min()) < -0.3 and float(run["v"].max()) > 0.3
    assert np.abs(run["v"].values[np.isclose(run["v_ref"], 0, atol=1e-3)]).max() < 0.05
    assert parked.plan.directions.min() < 0 and float(run["clearance"].min()) > 0.02


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
