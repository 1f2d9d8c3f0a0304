"""How narrow in reactive mode, of `mrctl navigate --suite`: corridors through which the dynamic window leads robots.

A robot that follows its plan in time does not see walls, so that one run shows how wide its corridor must be
(`mission_suite`). The dynamic window sees the walls on the map, and what it does depends on them. Here each draw is
therefore driven in corridors of several widths around the same plan, which keeps as far from the walls of a roomy
corridor as it can. A draw is a corridor, and a robot on one day (`mrctl.scenario.replicates`); all controllers have the
same draws. A robot passes if it arrives within `PATIENCE` times the time of its plan. The width that a draw needs is
the least of those in `ROOMS` that it passes, found by bisection: it takes for granted that who does not pass does not
pass what is narrower.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from functools import partial
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from mrctl.control.stages import Stages
from mrctl.experiments.journal import Computation, Journal
from mrctl.experiments.mission_suite import (
    CRITICAL_SHARE,
    PLAN_MARGINS,
    PLANTS,
    RIVALS,
    ROOMY_FACTOR,
    SHAPE,
    Contender,
    Mode,
    against,
    drawn,
    finite_text,
)
from mrctl.experiments.suite_tables import titled
from mrctl.experiments.tables import Table, frame, share_cell, wins_cell
from mrctl.kernel import Array
from mrctl.loop.runs import simulate
from mrctl.navigation.avoiders import avoiding
from mrctl.navigation.generators import corridor
from mrctl.navigation.mission import reached
from mrctl.navigation.planning import PATIENCE, prepared
from mrctl.navigation.vehicle import Vehicle
from mrctl.record import InputError
from mrctl.results.comparison import quantile_interval, superiority
from mrctl.scenario import Scenario, replicates
from mrctl.theory.perturbation import Perturbation

ROOMS = (0.06, 0.09, 0.12, 0.15, 0.18, 0.24, 0.3)  # m, by which a corridor is wider than the robot; chosen
TRIES = 3  # runs in which the bisection finds one of them, or none
DRAWS = {"quick": 4, "core": 80}  # with fewer than 72 the interval of a critical width has no upper end
SIMULATED_PER_SECOND = 5  # simulated s in a s of one core
PLANNED_TIMES = 1.3  # time of a run over that of its plan, on average


class Draw(NamedTuple):
    """A corridor, and the mission through it."""

    seed: int
    scenario: Scenario
    """The mission, in the corridor that is roomy."""
    width: float
    """Width of the robot in m."""


class Found(NamedTuple):
    """What was found."""

    needed: Array
    """Widths that the draws need in m, infinite where even the widest is too narrow, `(controllers, plants, draws)`."""
    width: float
    """Width of the robot in m."""
    controllers: Sequence[str]
    """Names of the controllers, among them `none` and `model`."""


def drive(base: Scenario, mode: Mode, compared: Sequence[Contender], journal: Journal) -> Found:
    """Drives all draws with all controllers on all plants; says first how long that takes.

    Args:
        base: Robot, steering, sensing and all else that is the same for all.
        mode: Which suite.
        compared: The controllers; those with a motion controller of the user, in whose place the dynamic window drives,
            are left out.
        journal: What was driven already, by controller and plant, which is kept there.

    Raises:
        InputError: The robot does not fit most corridors.
    """
    complaint = f"suite: {base.robot.path} finds no way through most corridors"
    draws = drawn(partial(draw, base), DRAWS[mode], complaint)
    for one in (one for one in compared if "motion" in one.stages()):
        print(f"{one.name} is left out, because the dynamic window is the motion controller here", flush=True)
    compared = [one for one in compared if "motion" not in one.stages()]
    cases = list(product(compared, PLANTS))
    left = sum([one.key, plant] not in journal for one, plant in cases)
    simulated = left * TRIES * PLANNED_TIMES * sum(one.scenario.reference.period for one in draws)
    expected = journal.expected(simulated / SIMULATED_PER_SECOND, len(cases))
    print(f"{left * TRIES * len(draws):,} runs with the dynamic window, {expected}", flush=True)
    drives = [Computation([one.key, plant], partial(_driven, draws, one, PLANTS[plant])) for one, plant in cases]
    needed = np.array(list(journal.results(drives)), float)
    names = [one.name for one in compared]
    return Found(needed.reshape(len(compared), len(PLANTS), -1), draws[0].width, names)


def draw(base: Scenario, seed: int) -> Draw | None:
    """Plans a draw with the largest margin that there is a plan for.

    Args:
        base: Robot, steering, sensing and all else that is the same for all.
        seed: Seed of the corridor, and of the robot on that day.

    Returns:
        The draw, or None where no plan goes through the corridor.
    """
    width = Vehicle.of(base).width
    roomy = corridor(ROOMY_FACTOR * width, seed, **SHAPE)
    for share in PLAN_MARGINS:
        try:
            _, own = prepared(roomy, base, margin=share * (ROOMY_FACTOR - 1) * width / 2, avoid="window")
        except InputError:
            continue
        return Draw(seed, own.replace(laps=PATIENCE, initial_spread=(0.0, 0.0, 0.0)), width)
    return None


def _driven(draws: Sequence[Draw], contender: Contender, plant: Perturbation) -> list[float]:
    """Drives all draws with one controller on one plant; returns the widths that they need in m, as in `Found`."""
    changes, stages = {**contender.choice.pair, "perturbation": plant}, contender.stages()

    def needed(one: Draw) -> float:
        first = bisect_left(ROOMS, True, key=lambda room: passes(one, one.width + room, changes, stages))
        return one.width + ROOMS[first] if first < len(ROOMS) else np.inf

    return [needed(one) for one in draws]


def passes(one: Draw, width: float, changes: dict[str, Any], stages: Stages) -> bool:
    """Tells whether a robot arrives through a corridor.

    Args:
        one: The draw.
        width: Width of the corridor in m.
        changes: What replaces the velocity controller and the robot of its scenario.
        stages: The user's stages, but for a motion controller.
    """
    walls, goal = corridor(width, one.seed, **SHAPE).obstacles, one.scenario.goal
    assert goal is not None
    (own,) = replicates(one.scenario.replace(obstacles=walls, **changes), 1, one.seed)
    drives: Stages = {**stages, "motion": avoiding("window")}
    run = simulate([own], threads=1, **drives).isel(run=0)
    return reached(run.dropna("time", subset=["x"]), goal)


def values(found: Found) -> dict[str, Any]:
    """Returns what was found for JSON."""
    return {"controllers": found.controllers, "plants": list(PLANTS), "rooms": ROOMS} | {
        "robot_width": found.width,
        "widths": found.needed.tolist(),
    }


def tables(found: Found, shown: str) -> list[Table]:
    """Returns the table of the critical widths in reactive mode; its title says what is `shown`."""
    rows = []
    for plant, own in zip(PLANTS, found.needed.swapaxes(0, 1), strict=True):
        for name, one in zip(found.controllers, own, strict=True):
            through = [int((one <= found.width + room + 1e-9).sum()) for room in ROOMS]
            shares = " / ".join(f"{count / len(one):.2f}" for count in through)
            rows.append(
                [plant, titled(name), share_cell(through[-1], len(one)), critical_cell(found.width, one), shares]
            )
            for rival in RIVALS:
                wins = superiority(one, own[found.controllers.index(rival)])
                rows[-1].append("" if rival == name else wins_cell(wins))
    header = ["plant", "controller", "through the widest", "critical width, mm", "success at each width"]
    header += ["needs less than PID", "less than model"]
    widths = ", ".join(f"{1e3 * (found.width + room):.0f}" for room in ROOMS)
    says = (
        f"With the dynamic window, which sees the walls on its map, a robot of {1e3 * found.width:.0f} mm drives "
        f"corridors of {widths} mm. The interval of a critical width reaches down to the width tried before. In paired "
        f"draws, with 95 % confidence: {against(found.controllers, found.needed, 0)}."
    )
    return [Table(f"Critical width of a corridor in reactive mode ({shown})", says, frame(rows, header))]


def critical_cell(width: float, needed: Array) -> str:
    """Returns the critical width in mm with its 95 % interval, which allows for the widths that were not tried.

    Args:
        width: Width of the robot in m.
        needed: Widths that the draws need, as in `Found`, `(draws,)`.
    """
    tried = width + np.array([0.0, *ROOMS])
    too_narrow = tried[np.searchsorted(tried, needed - 1e-9) - 1]
    value, _, high, *_ = quantile_interval(needed, CRITICAL_SHARE)
    low = quantile_interval(too_narrow, CRITICAL_SHARE).low
    return f"{finite_text(1e3 * value)} [{finite_text(1e3 * low)}, {finite_text(1e3 * high)}]"
