"""Missions in worlds on which nothing was chosen: nearly every robot arrives, and hardly any collides."""

from collections import Counter

import pytest

from mrctl import InputError, Scenario, Sensing, simulate
from mrctl.experiments.cases import HELD_OUT_SEEDS
from mrctl.navigation.mission import outcomes, prepared, robot_of, task_of
from mrctl.results.comparison import wilson
from mrctl.theory.references import check

TIERS = "ideal", "lab"  # with the true posture, and with the estimate
KINDS = "cellular", "corridor", "slalom", "doorway", "warehouse"


def driven(robot: str, seeds: range) -> tuple[dict[str, Counter[str]], int]:
    """Returns the outcomes of a nominal robot by tier, and the number of worlds that have a way at all.

    The search finds one wherever an exhaustive search does (`test_planning.test_exhaustive`).
    """
    found: dict[str, Counter[str]] = {tier: Counter() for tier in TIERS}
    solvable = 0
    for seed in seeds:
        own = {"prior": "model", "learner": "composite", "seed": seed} | ({"robot": {"path": robot}} if robot else {})
        scenario, kind = Scenario.from_dict(own), KINDS[seed % len(KINDS)]
        task = task_of(f"{kind}:{seed}", scenario)
        try:
            plan, mission = prepared(task, scenario)
        except InputError as error:
            if "there is none" in str(error) or "the robot is" in str(error):  # no way, or no room to stand
                continue
            print(robot, kind, seed, error)
            for tier in TIERS:
                found[tier]["no plan"] += 1
            solvable += 1
            continue
        solvable += 1
        for tier in TIERS:
            run = simulate([mission.replace(sensing=Sensing(tier=tier))])
            outcome = str(outcomes(run, task.goal, plan)["outcome"].iloc[0])
            found[tier][outcome] += 1
            if outcome != "arrived":
                print(robot, kind, seed, tier, outcome)
    return found, solvable


@pytest.mark.parametrize(
    ("robot", "count"),
    [("", 5), *(pytest.param(robot, 2000, marks=pytest.mark.full) for robot in ("", "racecar", "turtlebot"))],
)
def test_arrives(robot: str, count: int) -> None:
    """With the true posture 99 % arrive and at most 0.2 % collide; with the estimate 97 % arrive."""
    found, solvable = driven(robot, HELD_OUT_SEEDS[:count])
    share = {tier: outcomes["arrived"] / solvable for tier, outcomes in found.items()}
    print(robot, f"{solvable} of {count} worlds have a way")
    for tier in TIERS:
        print(tier, dict(found[tier]), "95 %:", wilson(share[tier], solvable))
    assert solvable >= 0.9 * count
    assert share["ideal"] >= 0.99 and share["lab"] >= 0.97
    assert found["ideal"]["collided"] <= 0.002 * solvable


@pytest.mark.parametrize("world", ["slalom:200942", "slalom:200962", "cellular:201140"])
def test_tight_spline(world: str) -> None:
    """Where the spline of the first plan steers beyond the limit, a plan of wider arcs is driven."""
    scenario = Scenario(prior="model", learner="composite")
    task = task_of(world, scenario)
    plan, mission = prepared(task, scenario)
    check(mission.reference, robot_of(scenario)[1], False)
    assert outcomes(simulate([mission]), task.goal, plan)["outcome"].tolist() == ["arrived"]


@pytest.mark.parametrize("robot", ["", "racecar", "turtlebot"])
def test_parks(robot: str) -> None:
    """Every robot parks in a bay of its size; all but the default car, which cannot reverse, go back and forth."""
    own = {"prior": "model", "learner": "composite", "robot": {"path": robot}} if robot else {"learner": "none"}
    scenario = Scenario.from_dict(own)
    task = task_of("parking_bay:3", scenario)
    plan, mission = prepared(task, scenario)
    assert outcomes(simulate([mission]), task.goal, plan)["outcome"].tolist() == ["arrived"]
    assert (plan.ways.min() < 0) == bool(robot)
