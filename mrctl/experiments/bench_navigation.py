"""The speed of navigation, for `mrctl bench`: lidar, particle filter, path-finding, MPPI and whole missions.

Each time is a median. What takes turns with a judge in one process is divided by it turn by turn.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Any, get_args
from unittest import mock

import numpy as np

from mrctl.experiments.tables import markdown, number
from mrctl.loop.runs import simulate
from mrctl.navigation import planning
from mrctl.navigation.avoiders import avoiding
from mrctl.navigation.hybrid_astar import cost_to_go, plan, space
from mrctl.navigation.mppi import MAX_COST_DIFFERENCE, SAMPLE_DEVIATIONS, SAMPLES, TEMPERATURE, Mppi
from mrctl.navigation.planning import Avoid, prepared
from mrctl.navigation.rollouts import KNOTS, STEPS, roll_out
from mrctl.navigation.tasks import task_of
from mrctl.navigation.vehicle import Vehicle
from mrctl.physics.obstacles import multi_ray
from mrctl.record import InputError
from mrctl.scenario import Scenario
from mrctl.sensing.lidar import Lidar
from mrctl.sensing.localisation import MAX_POINTS, MAX_RAYS
from mrctl.sensing.particles import HIT_DEVIATION, MIN_PARTICLES, Particles, weigh
from mrctl.theory.clearance import clearance
from mrctl.theory.grid import field_of
from mrctl.theory.obstacles import Box, Disc, Obstacles, Surroundings
from mrctl.theory.rays import cast

WORLDS = 40  # of either kind, in which plans are made
SIDES = (6.0, 0.0), (-6.0, 0.0), (0.0, 6.0), (0.0, -6.0)  # m, middles of the walls around the particle filter
CYLINDERS = 300  # that the lidar sees
SIDE, CELL, DISCS = 38.4, 0.1, 100  # m, m; side of the worlds of random discs and of their 147,456 cells, and discs
RADIUS = 0.5  # m, turning radius of plans there
KINDS = "cellular", "corridor", "slalom", "doorway", "warehouse"
MISSION = "doorway:3"
MAX_TURNS = 5  # of the missions
SCENARIO = Scenario(prior="model", learner="none")


def run(repetitions: int, worlds: int = WORLDS) -> dict[str, Any]:
    """Measures navigation, in about a minute.

    Args:
        repetitions: Number of turns of each.
        worlds: Number of worlds of either kind, in which plans are made.

    Returns:
        `pairs`, a row for each pair of what is measured and its judge: their names, medians in µs and the median of
        their ratios; `plans`, a row for the worlds of random discs and one for those of the generators; and `missions`,
        × real time on one core for each way to avoid obstacles.
    """
    return {
        "pairs": [_lidar(repetitions), _particles(repetitions), _mppi(repetitions)],
        "plans": [_random_discs(worlds), _generated(worlds)],
        "missions": _missions(min(repetitions, MAX_TURNS)),
    }


def text(figures: dict[str, Any]) -> str:
    """Returns the figures of `run` as Markdown."""
    pairs = [
        [r["name"], number(r["us"]), r["judge"], number(r["judge_us"]), number(r["ratio"])] for r in figures["pairs"]
    ]
    plans = [
        [
            r["name"], f"{r['found']} of {r['worlds']}", f"{r['cells']:,.0f}", number(r["ms"]), number(r["ms_95"]),
            number(r["around_ms"]), f"{r['expanded']:,.0f}",
        ]
        for r in figures["plans"]
    ]  # fmt: skip
    header = ("worlds", "plans", "cells", "ms", "ms, 95 %", "heuristic alone, ms", "poses expanded")
    return "\n\n".join(
        [
            "Navigation, medians on one thread. Ratio: of the two times, turn by turn.",
            markdown(("what", "µs", "beside", "µs", "ratio"), pairs),
            "Hybrid A* with 72 headings, where there is a way. Each row: medians over worlds, and the 95th percentile.",
            markdown(header, plans),
            f"The mission {MISSION} on one core, by what keeps the robot from obstacles:",
            markdown(
                ("avoid", "× real time"), [[name, number(factor)] for name, factor in figures["missions"].items()]
            ),
        ]
    )


def _pair(name: str, ours: Callable[[], Any], judge: str, theirs: Callable[[], Any], turns: int) -> dict[str, Any]:
    """Returns a row of `pairs`, for two functions that take turns; the first call of each, which compiles, is left out.

    The ratio is that of the time of the judge to ours.
    """
    ours()
    theirs()
    times = np.array([(_seconds(ours), _seconds(theirs)) for _ in range(turns)])
    middle, other = 1e6 * np.median(times, axis=0)
    ratio = float(np.median(times[:, 1] / times[:, 0]))
    return {"name": name, "us": float(middle), "judge": judge, "judge_us": float(other), "ratio": ratio}


def _seconds(function: Callable[[], Any]) -> float:
    """Returns the time that a call takes in s."""
    start = time.perf_counter()
    function()
    return time.perf_counter() - start


def _discs(random: np.random.Generator, count: int, side: float, least: float, most: float) -> Obstacles:
    """Returns discs at random places of a square around the origin with that side, and random radii; all in m."""
    places, radii = random.uniform(-side / 2, side / 2, (count, 2)), random.uniform(least, most, count)
    return Obstacles(shapes=tuple(Disc(x=x, y=y, radius=r) for (x, y), r in zip(places.tolist(), radii, strict=True)))


def _lidar(turns: int) -> dict[str, Any]:
    """Measures a scan of 360 beams among cylinders, and the same rays of MuJoCo."""
    lidar, obstacles = Lidar(), _discs(np.random.default_rng(0), CYLINDERS, 24.0, 0.05, 0.3)
    outlines, ranges, pose = Surroundings(obstacles).at(0.0), np.empty(lidar.beams), np.zeros(3)
    ours = partial(cast.compiled, pose, lidar.first, lidar.step, lidar.range, outlines, ranges)
    directions = pose[2] + lidar.first + lidar.step * np.arange(lidar.beams)
    theirs = partial(multi_ray(obstacles), pose[:2], directions, lidar.range)
    name = f"lidar, {lidar.beams} beams at {CYLINDERS} cylinders"
    return _pair(name, ours, "mujoco.mj_multiRay", theirs, turns)


def _particles(turns: int) -> dict[str, Any]:
    """Measures an update of the particle filter, and its likelihoods alone."""
    lidar, random = Lidar(), np.random.default_rng(0)
    walls = (Box(x=x, y=y, length=0.2 + 12 * (x == 0), width=0.2 + 12 * (y == 0)) for x, y in SIDES)
    inside = _discs(random, 30, 10.0, 0.05, 0.3).shapes
    outlines = Surroundings(Obstacles(shapes=(*walls, *inside))).at(0.0)
    field = field_of(outlines, np.full(2, -7.0), np.full(2, 7.0), 0.05)
    pose = np.zeros(3)
    scan = lidar.scan(pose, outlines, random)
    points, rays = lidar.points(scan, MAX_POINTS["particles"]), lidar.rays(scan, MAX_RAYS)
    filtered, weights = Particles(field, 0, pose, np.full(3, 0.02)), np.empty(MIN_PARTICLES)
    first = filtered.particles.copy()
    likelihoods = partial(weigh.compiled, first, points, rays[:0], field, HIT_DEVIATION, weights)

    def update() -> None:
        filtered.particles = first.copy()
        filtered.update(0.0, 0.0, points, rays)

    name = f"particle filter, {MIN_PARTICLES} particles, {len(points)} beams"
    return _pair(name, update, "its likelihoods alone", likelihoods, turns)


def _mppi(turns: int) -> dict[str, Any]:
    """Measures the choice of a twist by MPPI, and its roll-outs alone."""
    own = prepared(task_of(MISSION, SCENARIO), SCENARIO, avoid="mppi")[1]
    make = avoiding("mppi")
    assert make is not None
    stage: Mppi = make(Vehicle.of(own).robot, 1)
    stage.assign([own])
    pose, twist = np.array([own.initial_pose], float), np.array([[0.5, 0.0]])
    stage.reset(pose, np.zeros((1, 7)), own.motion_period)
    with mock.patch.object(stage, "choose", wraps=stage.choose) as watched:
        stage.output(pose, twist, np.zeros((1, 7)))
    arguments = watched.call_args.args
    (bounds,) = stage.bounds
    spread = np.array(SAMPLE_DEVIATIONS) * (bounds.speed, bounds.rotation)
    knots = np.random.default_rng(0).standard_normal((SAMPLES, KNOTS, 2)) * spread
    nominal, period, scene = np.zeros((STEPS, 2)), own.motion_period, arguments[-1]
    twists, costs = np.empty((SAMPLES, STEPS, 2)), np.empty(SAMPLES)
    state = pose[0], twist[0], twist[0], 0.0, period, bounds, scene
    bare = partial(roll_out.compiled, knots, nominal, *state, MAX_COST_DIFFERENCE * TEMPERATURE, twists, costs)
    name = f"MPPI, {SAMPLES:,} samples of {STEPS} steps"
    return _pair(name, partial(stage.choose, *arguments), "its roll-outs alone", bare, turns)


def _random_discs(worlds: int) -> dict[str, Any]:
    """Measures plans of the car, forward, among random discs, between poses that are half the side apart or more."""
    footprint, tried = Vehicle.of(SCENARIO).footprint, []
    for seed in range(worlds):
        random = np.random.default_rng(seed)
        outlines = Surroundings(_discs(random, DISCS, SIDE, 0.2, 1.0)).at(0.0)
        where = space(outlines, footprint, np.full(2, -SIDE / 2), np.full(2, SIDE / 2), CELL)
        free, ends = partial(clearance, footprint, outlines=outlines), np.zeros((2, 3))
        while np.hypot(*(ends[1] - ends[0])[:2]) < SIDE / 2 or min(map(free, ends)) < 2 * where.margin:
            ends = random.uniform([1 - SIDE / 2, 1 - SIDE / 2, -np.pi], [SIDE / 2 - 1, SIDE / 2 - 1, np.pi], (2, 3))
        tried.append((where, *ends, RADIUS, False))
    return _planned(f"{DISCS} random discs", tried)


def _generated(worlds: int) -> dict[str, Any]:
    """Measures plans of missions of the car in generated worlds, whose cells are a quarter as wide as the robot."""
    tried = []
    for seed in range(worlds):
        with mock.patch.object(planning, "plan", wraps=plan) as watched:
            try:
                prepared(task_of(f"{KINDS[seed % len(KINDS)]}:{seed}", SCENARIO), SCENARIO)
            except InputError:  # no way, or no room to stand
                continue
        tried.append(watched.call_args_list[0].args)
    return _planned("generated, as in missions", tried)


def _planned(name: str, tried: list[tuple[Any, ...]]) -> dict[str, Any]:
    """Returns a row of `plans`, for the arguments of `plan` in each world."""
    seconds, alone, expanded, cells = [], [], [], []
    with suppress(InputError):
        plan(*tried[0])  # the first search compiles
    for arguments in tried:
        start = time.perf_counter()
        try:
            found = plan(*arguments)
        except InputError:
            continue
        seconds.append(time.perf_counter() - start)
        alone.append(_seconds(partial(cost_to_go, arguments[0], arguments[2])))
        expanded.append(found.expanded)
        cells.append(arguments[0].field.distance.size)
    return {
        "name": name,
        "worlds": len(tried),
        "found": len(seconds),
        "cells": statistics.median(cells),
        "ms": 1e3 * statistics.median(seconds),
        "ms_95": 1e3 * float(np.percentile(seconds, 95)),
        "around_ms": 1e3 * statistics.median(alone),
        "expanded": statistics.median(expanded),
    }


def _missions(turns: int) -> dict[str, float]:
    """Returns × real time of a mission for each way to avoid obstacles, without the time of its plan; they take turns.

    A first turn, in which laws are compiled, is left out.
    """
    task, factors = task_of(MISSION, SCENARIO), {}
    drives = {avoid: prepared(task, SCENARIO, avoid=avoid)[1] for avoid in get_args(Avoid)}
    for turn in range(turns + 1):
        for avoid, own in drives.items():
            start = time.perf_counter()
            result = simulate([own], motion=avoiding(avoid))
            spent = time.perf_counter() - start
            if turn:
                driven = int(np.isfinite(result["x"].values).sum()) * own.control_period
                factors.setdefault(avoid, []).append(driven / spent)
    return {avoid: statistics.median(every) for avoid, every in factors.items()}
