"""Missions in worlds on which nothing was chosen: nearly every robot arrives, and hardly any collides."""

from collections import Counter

import pytest

from mrctl import InputError, Scenario, Sensing, simulate
from mrctl.experiments.cases import HELD_OUT_SEEDS
from mrctl.navigation import planning
from mrctl.navigation.mission import outcomes
from mrctl.navigation.planning import prepared
from mrctl.navigation.tasks import task_of
from mrctl.results.comparison import wilson

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
            plan, drive = prepared(task, scenario)
        except InputError as error:
            if "there is no way" in str(error) or "the robot is" in str(error):  # no way, or no room to stand
                continue
            print(robot, kind, seed, error)
            for tier in TIERS:
                found[tier]["no plan"] += 1
            solvable += 1
            continue
        solvable += 1
        for tier in TIERS:
            run = simulate([drive.replace(sensing=Sensing(tier=tier))])
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


@pytest.mark.parametrize("world", ["doorway:3", pytest.param("slalom:11", marks=pytest.mark.full)])
def test_tight_spline(world: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the spline of the first plan steers beyond the limit, a plan of wider arcs is driven, if there is one.

    The plans keep the arcs of the search here, since no world is known in which shortcuts leave such a spline.
    """
    monkeypatch.setattr(planning, "shortcut", lambda where, found, *_: found)
    scenario = Scenario(prior="model", learner="composite")
    task = task_of(world, scenario)
    for factor in (1.0, 30.0):  # the same plan again, and one of arcs for which there is no room
        with monkeypatch.context() as patch, pytest.raises(InputError, match="steering angle .* exceeds"):
            patch.setattr(planning, "GENTLER_FACTOR", factor)
            prepared(task, scenario)
    plan, drive = prepared(task, scenario)
    assert outcomes(simulate([drive]), task.goal, plan)["outcome"].tolist() == ["arrived"]


def test_other_refusals_are_final(monkeypatch: pytest.MonkeyPatch) -> None:
    """Wider arcs are no remedy for what does not turn the wheel; a speed beyond the robot's needs no plan at all."""
    scenario, searches = Scenario(), []
    task, search = task_of("doorway:3", scenario), planning.plan
    monkeypatch.setattr(planning, "plan", lambda *arguments: searches.append(arguments) or search(*arguments))
    with pytest.raises(InputError, match=r"^speed: must be between 0.01 and 1.5 m/s, not 9$"):
        prepared(task, scenario, speed=9)
    assert not searches

    def refuses(*_: object) -> None:
        raise InputError("reference: rotation 4 rad/s exceeds the robot's max_rotation")

    monkeypatch.setattr(planning, "check", refuses)
    with pytest.raises(InputError, match="exceeds the robot's max_rotation"):
        prepared(task, scenario)
    assert len(searches) == 1


def test_second_plan_reverses(monkeypatch: pytest.MonkeyPatch) -> None:
    """A robot that reverses plans again where it cannot drive the plan forward; bad settings are never planned with."""
    scenario, tried = Scenario.from_dict({"robot": {"path": "turtlebot"}}), []
    task = task_of("doorway:3", scenario)

    def refuses(reference: object, robot: object, reverse: bool) -> None:
        tried.append(reverse)
        if not reverse:
            raise InputError("reference: rotation 4 rad/s exceeds the robot's max_rotation")

    monkeypatch.setattr(planning, "check", refuses)
    prepared(task, scenario)
    assert tried == [False, False, True]  # the second time without its steering limit
    with pytest.raises(InputError, match="exceeds the robot's max_rotation"):
        prepared(task, scenario, avoid="mppi")  # which never plans in reverse; but there is a way forward
    searches = []
    monkeypatch.setattr(planning, "plan", lambda *arguments: searches.append(arguments))
    for bad in ({"margin": -1.0}, {"speed": 9.0}):
        with pytest.raises(InputError, match=f"^{next(iter(bad))}: must be "):
            prepared(task, scenario, **bad)
    assert not searches


@pytest.mark.parametrize("seed", [3, pytest.param(4, marks=pytest.mark.full)])
@pytest.mark.parametrize("robot", ["", "turtlebot", pytest.param("racecar", marks=pytest.mark.full)])
def test_parks(robot: str, seed: int) -> None:
    """Every robot parks in a bay of its size; all but the default car, which cannot reverse, go back and forth."""
    scenario = Scenario.from_dict({"prior": "model", "learner": "composite", "robot": {"path": robot or "car"}})
    task = task_of(f"parking_bay:{seed}", scenario)
    plan, drive = prepared(task, scenario)
    assert outcomes(simulate([drive]), task.goal, plan)["outcome"].tolist() == ["arrived"]
    assert (plan.directions.min() < 0) == bool(robot)
