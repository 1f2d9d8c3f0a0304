"""Missions among obstacles that the map lacks, and that move: who arrives, by the scans of the lidar alone."""

from collections import Counter
from itertools import product

import numpy as np
import pytest

from mrctl import Box, Disc, InputError, Line, Obstacles, Scenario, simulate
from mrctl.experiments.mission_suite import PLANTS
from mrctl.experiments.three_mppis import ended, world
from mrctl.navigation.avoiders import avoiding
from mrctl.navigation.generators import Task
from mrctl.navigation.mission import outcomes
from mrctl.navigation.mppi import LAG
from mrctl.navigation.planning import Avoid, prepared
from mrctl.navigation.tasks import task_of
from mrctl.navigation.vehicle import Vehicle
from mrctl.scenario import replicates
from mrctl.theory.timing import LIMIT_SHARE

FIRST = 300_000  # seed, from which on nothing was chosen
KINDS = "cellular", "corridor", "slalom", "doorway", "warehouse"
ROBOTS = "car", "racecar", "turtlebot"
AVOIDERS: tuple[Avoid, ...] = ("barrier", "window", "mppi")


def unmapped(base: Scenario, seed: int) -> Task:
    """Makes a field of eight discs with a ninth on the plan among them, which the map lacks and one can go around."""
    random, known = np.random.default_rng([seed, 7]), []
    goal = 6.0, float(random.uniform(-1, 1)), 0.0
    while len(known) < 8:
        x, y, radius = random.uniform(1.0, 5.2), random.uniform(-2.5, 2.5), random.uniform(0.1, 0.35)
        if min(np.hypot(x, y), np.hypot(x - goal[0], y - goal[1])) > radius + 1.0:
            known.append(Disc(x=x, y=y, radius=radius))
    chart = Obstacles(shapes=tuple(known))
    plan = prepared(Task(obstacles=chart, start=(0, 0, 0), goal=goal), base)[1].reference
    x, y, _ = plan.sample(np.array([random.uniform(0.4, 0.6) * plan.period])).pose[0].tolist()
    ninth = Disc(x=x, y=y + random.uniform(-0.1, 0.1), radius=0.2)
    task = Task(obstacles=Obstacles(shapes=(*known, ninth)), map=chart, start=(0, 0, 0), goal=goal)
    prepared(task.replace(map=None), base)
    return task


def crossed(base: Scenario, seed: int) -> Task:
    """Makes a straight way that two discs cross at about the time at which a robot is there."""
    robot, random, discs = Vehicle.of(base).robot, np.random.default_rng([seed, 8]), []
    most = min(0.8, LIMIT_SHARE * robot.max_speed)
    for way in (2.0, 3.5):
        heading = random.choice([-1, 1]) * np.pi / 2 + random.uniform(-0.4, 0.4)
        speed = random.uniform(0.4 * most, most)
        behind = speed * (way / (LIMIT_SHARE * robot.max_speed) + random.uniform(-0.5, 0.5))
        at = way * np.exp(-1j * heading) - behind  # as the disc counts, from the pose of its course
        discs.append(Disc(x=at.real, y=at.imag, radius=0.15, course=Line(heading=heading, speed=speed, length=30.0)))
    return Task(obstacles=Obstacles(shapes=tuple(discs)), start=(0, 0, 0), goal=(5, 0, 0))


def still(base: Scenario, seed: int) -> Task:
    """Makes one of the generated worlds, of which the map has all."""
    return task_of(f"{KINDS[seed % len(KINDS)]}:{seed}", base)


def walled(base: Scenario, seed: int) -> Task:
    """Makes a flat wall of 3 m across the way, of which the map has no more than a disc beside the way."""
    post, wall = Disc(x=2.0, y=-0.6), Box(x=2.0, length=0.1, width=3.0)
    return Task(obstacles=Obstacles(shapes=(wall,)), map=Obstacles(shapes=(post,)), start=(0, 0, 0), goal=(4, 0, 0))


WORLDS = {"unmapped": unmapped, "crossed": crossed, "still": still, "walled": walled}


def driven(world: str, robot: str, avoid: Avoid, count: int) -> tuple[Counter[str], list[float]]:
    """Drives nominal robots with the estimate of `lab`; returns the outcomes, and times of arrival over the plans'."""
    found, times = Counter(), []
    for seed in range(FIRST, FIRST + count):
        own = {"prior": "model", "learner": "composite", "robot": {"path": robot}, "seed": seed}
        scenario = Scenario.from_dict(own)
        try:
            task = WORLDS[world](scenario, seed)
            plan, drive = prepared(task, scenario, avoid=avoid)
        except InputError:
            continue
        row = outcomes(simulate([drive], motion=avoiding(avoid)), task.goal, plan).iloc[0]
        found[row["outcome"]] += 1
        if row["outcome"] == "arrived":
            times.append(row["time"] / drive.reference.period)
    late = f"; time over that of the plan {np.mean(times):.2f}, at most {max(times):.2f}" if times else ""
    print(f"\n{world}, {robot}, {avoid}: {dict(found)}{late}")
    return found, times


def cases(few: list[tuple[str, Avoid]], avoiders: tuple[Avoid, ...], count: int, usual: int = 2) -> list:
    """Returns a few cases of the `usual` number of worlds, and all of `count` worlds for `pytest -m full -s`."""
    every = [pytest.param(robot, avoid, count, marks=pytest.mark.full) for robot in ROBOTS for avoid in avoiders]
    return [*((*case, usual) for case in few), *every]


@pytest.mark.parametrize(
    ("robot", "avoid", "count"), cases([("car", "none"), ("turtlebot", "barrier")], ("none", *AVOIDERS), 30)
)
def test_unmapped(robot: str, avoid: Avoid, count: int) -> None:
    """Every robot that looks at its map alone hits what the map lacks; of those that look around 80 % arrive."""
    found, _ = driven("unmapped", robot, avoid, count)
    total = sum(found.values())
    assert total >= 0.9 * count
    if avoid == "none":
        assert found == {"collided": total}
    else:
        assert found["arrived"] >= 0.8 * total and found["collided"] <= 0.05 * total


@pytest.mark.parametrize(("robot", "avoid", "count"), cases([("car", "mppi")], ("none", *AVOIDERS), 30))
def test_crossed(robot: str, avoid: Avoid, count: int) -> None:
    """Robots that look wait for what crosses their way, or go around it, and arrive; most of the others are hit."""
    found, _ = driven("crossed", robot, avoid, count)
    if avoid == "none":
        assert found["collided"] > 0.7 * count
    else:
        assert found["arrived"] >= 0.9 * count


@pytest.mark.parametrize(("robot", "avoid", "count"), cases([("racecar", "barrier")], ("barrier",), 60))
def test_still(robot: str, avoid: Avoid, count: int) -> None:
    """Where the map is right the filter only slows the robots, and all arrive."""
    found, times = driven("still", robot, avoid, count)
    assert found == {"arrived": sum(found.values())} and np.mean(times) < 2


@pytest.mark.full
@pytest.mark.parametrize(("robot", "plant"), [("turtlebot", "all"), ("racecar", "sagging battery")])
def test_still_with_weak_motors(robot: str, plant: str) -> None:
    """A plan waits for motors that are too weak for it: all arrive, and few run past the goal by more than 10 cm."""
    past = []
    for seed in range(FIRST, FIRST + 20):
        own = {"prior": "model", "learner": "composite", "robot": {"path": robot}, "seed": seed}
        scenario = Scenario.from_dict(own)
        try:
            task = still(scenario, seed)
            plan, drive = prepared(task, scenario, avoid="barrier")
        except InputError:
            continue
        result = simulate(replicates(drive.replace(perturbation=PLANTS[plant]), 1, seed), motion=avoiding("barrier"))
        assert outcomes(result, task.goal, plan)["outcome"].tolist() == ["arrived"]
        (x, y, theta), run = task.goal, result.isel(run=0)
        ahead = (run["x"] - x) * np.cos(theta) + (run["y"] - y) * np.sin(theta)
        past.append(float(ahead.where(np.hypot(run["x"] - x, run["y"] - y) < 0.6).max()))
    median, most = np.quantile(past, (0.5, 0.9))
    print(f"\nstill, {robot}, {plant}: {len(past)} arrive; {median:.3f} m past the goal, at most {max(past):.3f} m")
    assert len(past) > 15 and median < 0.08 and most < 0.12


@pytest.mark.parametrize(
    ("robot", "avoid", "count"),
    cases([("car", "barrier"), ("racecar", "window"), ("racecar", "mppi")], AVOIDERS, 24, 1),
)
def test_walled(robot: str, avoid: Avoid, count: int) -> None:
    """Every robot sees from afar that the wall blocks its plan, and goes around it."""
    found, _ = driven("walled", robot, avoid, count)
    assert found == {"arrived": count}


@pytest.mark.full
def test_lag_of_roll_outs() -> None:
    """In slaloms that two discs cross, on seeds on which it was not chosen, the lag does not matter for who is hit."""
    base, hit = Scenario.from_dict({"robot": {"path": "racecar"}}), dict.fromkeys((LAG, 0.0), 0)
    worlds = [found for seed in range(2000, 2160) if (found := world(base, seed))]
    for one, lag in product(worlds, hit):
        (drive,) = replicates(one.scenario.with_feedforward("model+composite"), 1, one.seed)
        hit[lag] += ended(simulate([drive], motion=avoiding("mppi", lag=lag)), one).outcome == "collided"
    print(f"\nof {len(worlds)} racing cars with mppi collide, by the lag of its roll-outs in s: {hit}")
    assert len(worlds) > 150 and max(hit.values()) < 0.05 * len(worlds)
