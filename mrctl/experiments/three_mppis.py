"""Three MPPIs, of `mrctl navigate --suite`: does an adaptive velocity loop make the simplest roll-out model right?

MPPI predicts what the robot does with a twist that it asks for. Here the same MPPI drives in the same worlds (1) with
roll-outs that obey at once, over PID alone; (2) over the same PID, with roll-outs that obey with a first-order lag; (3)
with roll-outs that obey at once, over `model+composite`. The lag is the one that fits V of PID on the nominal plant in
the runs of (1). A world is a slalom with two discs that cross it, and a robot on one day (`mrctl.scenario.replicates`);
all three have the same worlds and draws.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import product
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from scipy.optimize import fminbound

from mrctl.experiments.journal import Computation, Journal
from mrctl.experiments.mission_suite import PLANTS, Mode, drawn
from mrctl.experiments.tables import Table, centre_cell, frame, share_cell, wins_cell, word_of
from mrctl.kernel import Array
from mrctl.loop.runs import simulate
from mrctl.navigation.avoiders import avoiding
from mrctl.navigation.generators import Task, slalom
from mrctl.navigation.mission import outcomes
from mrctl.navigation.plan import Plan
from mrctl.navigation.planning import PATIENCE, REACTIVE_PERIOD, prepared
from mrctl.navigation.vehicle import Vehicle
from mrctl.record import InputError
from mrctl.results.comparison import quantile_interval, superiority
from mrctl.results.metrics import control_period
from mrctl.scenario import FEEDFORWARDS, FeedforwardName, Scenario, replicates
from mrctl.theory.obstacles import Disc, Obstacles
from mrctl.theory.references import Line
from mrctl.theory.timing import LIMIT_SHARE


class Entry(NamedTuple):
    """One compared MPPI: the model of its roll-outs, and the velocity controller below."""

    feedforward: FeedforwardName
    lagging: bool
    """Whether its roll-outs have the lag."""


ENTRIES = {
    "PID, ideal roll-outs": Entry("none", False),
    "PID, lagging roll-outs": Entry("none", True),
    "model+composite, ideal roll-outs": Entry("model+composite", False),
}
FIRST, SECOND, THIRD = ENTRIES
WORLDS = {"quick": 4, "core": 30}
GATES, SPACING = 2, 2.0  # of the slalom; m
CROSSINGS = (3.0, 5.0)  # m, where the discs cross the way, on average
DISC_RADIUS = 0.2  # m, of the discs
MAX_FITTED_LAG = 1.0  # s
SIMULATED_PER_SECOND = 2  # simulated s of plans in a s of one core; the runs take longer than their plans
TIE = REACTIVE_PERIOD


class World(NamedTuple):
    """A world, and the plan through it."""

    seed: int
    plan: Plan
    scenario: Scenario


class Run(NamedTuple):
    """How a run ended."""

    outcome: str
    """Outcome, one of those of `mrctl.navigation.mission.outcomes`."""
    lateness: float
    """Time at which the robot arrived beyond that of the plan in s; infinite where it did not arrive."""
    clearance: float
    """Smallest clearance in m."""


class Found(NamedTuple):
    """What was found."""

    lag: float
    """Lag of the roll-outs in s."""
    runs: dict[str, dict[str, list[Run]]]
    """Runs by entry and plant, in the order of the worlds."""


def drive(base: Scenario, mode: Mode, journal: Journal) -> Found:
    """Drives all worlds with all three on all plants; says first how long that takes.

    Args:
        base: Robot, steering, sensing and all else that is the same for all.
        mode: Which suite.
        journal: What was driven already, by entry and plant, which is kept there.

    Raises:
        InputError: The robot finds no way through most worlds.
    """
    count = WORLDS[mode]
    complaint = f"suite: {base.robot.path} finds no way through most slaloms"
    worlds = drawn(partial(world, base), count, complaint)
    left = sum([name, plant] not in journal for name in ENTRIES for plant in PLANTS)
    seconds = left * sum(one.scenario.reference.period for one in worlds) / SIMULATED_PER_SECOND
    print(f"{left * count} runs with MPPI, {journal.expected(seconds, 2 * len(PLANTS))}", flush=True)
    lag, driven = 0.0, {}
    for entries in (FIRST, THIRD), (SECOND,):  # the second needs the lag that fits the first
        parts = []
        for name, plant in product(entries, PLANTS):
            changes = {**FEEDFORWARDS[ENTRIES[name].feedforward], "perturbation": PLANTS[plant]}
            own = partial(_driven, worlds, changes, lag * ENTRIES[name].lagging)
            parts.append(Computation([name, plant], own))
        driven |= dict(zip(product(entries, PLANTS), journal.results(parts), strict=True))
        lag = driven[FIRST, "nominal"]["lag"]
    runs = {name: {plant: [Run(*run) for run in driven[name, plant]["runs"]] for plant in PLANTS} for name in ENTRIES}
    return Found(lag, runs)


def _driven(worlds: Sequence[World], changes: dict[str, Any], lag: float) -> dict[str, Any]:
    """Drives all worlds.

    Args:
        worlds: The worlds.
        changes: What replaces the velocity controller and the robot of their scenarios.
        lag: Lag of the roll-outs in s.

    Returns:
        `runs`, and the `lag` in s that fits them, `fitted`.
    """

    def driven(one: World) -> xr.Dataset:
        (scenario,) = replicates(one.scenario.replace(**changes), 1, one.seed)
        return simulate([scenario], threads=1, motion=avoiding("mppi", lag=lag))

    results = [driven(one) for one in worlds]
    return {"runs": [ended(*case) for case in zip(results, worlds, strict=True)], "lag": fitted(results)}


def world(base: Scenario, seed: int) -> World | None:
    """Makes a world and plans a way through it without the discs that move; None where there is no way.

    A disc crosses the middle line of the slalom at about the time at which a robot is there that drives along it at 0.9
    of its largest speed.
    """
    vehicle = Vehicle.of(base)
    still, random = slalom(2 * vehicle.width, seed, GATES, SPACING), np.random.default_rng([seed, 1])
    movers = []
    for way in CROSSINGS:
        x, late = way + random.uniform(-0.5, 0.5), random.uniform(-0.5, 0.5)
        speed, heading = random.uniform(0.3, 0.9), random.choice([-1, 1]) * np.pi / 2 + random.uniform(-0.5, 0.5)
        behind = speed * (x / (LIMIT_SHARE * vehicle.robot.max_speed) + late)
        at = x * np.exp(-1j * heading) - behind  # as the disc counts, from the pose of its course
        movers.append(Disc(x=at.real, y=at.imag, radius=DISC_RADIUS, course=Line(heading=heading, speed=speed)))
    task = Task(obstacles=Obstacles(shapes=(*still.obstacles.shapes, *movers)), start=still.start, goal=still.goal)
    try:
        plan, own = prepared(task, base, avoid="mppi")
    except InputError:
        return None
    changes = {"laps": PATIENCE, "initial_spread": (0.0, 0.0, 0.0)}
    return World(seed, plan, own.replace(**changes))


def fitted(results: Sequence[xr.Dataset]) -> float:
    """Returns the time constant in s with which V follows its command in runs best, by least squares."""
    period = control_period(results[0])
    driven = [result.isel(run=0).dropna("time", subset=["v"]) for result in results]
    pairs = [(one["v_command"].values, one["v"].values) for one in driven if one.sizes["time"]]

    def missed(lag: float) -> float:
        left, total = np.exp(-period / lag), 0.0
        for command, v in pairs:
            now = v[0]
            for wanted, there in zip(command, v, strict=True):
                total += (now - there) ** 2
                now = wanted + left * (now - wanted)
        return total

    return float(fminbound(missed, 1e-3, MAX_FITTED_LAG))  # pyright: ignore[reportArgumentType] (without full_output one number)


def ended(result: xr.Dataset, one: World) -> Run:
    """Returns how a run ended."""
    goal, plan = one.scenario.goal, one.scenario.reference
    assert goal is not None
    row = outcomes(result, goal, one.plan).iloc[0]
    there = row["outcome"] == "arrived"
    return Run(row["outcome"], row["time"] - plan.period if there else np.inf, row["clearance"])


def values(found: Found) -> dict[str, Any]:
    """Returns what was found for JSON."""
    rows = {
        entry: {plant: [run._asdict() for run in own] for plant, own in of.items()} for entry, of in found.runs.items()
    }
    return {"lag": found.lag, "runs": rows}


def tables(found: Found, shown: str) -> list[Table]:
    """Returns the table of the three MPPIs on each plant, with a sentence that sums it up and `shown` in its title."""
    (lag, runs), rows, verdicts = found, [], {SECOND: [], FIRST: []}
    for plant in PLANTS:
        late = {name: np.array([run.lateness for run in of[plant]]) for name, of in runs.items()}
        for name, of in runs.items():
            own = of[plant]
            counts = [sum(run.outcome == outcome for run in own) for outcome in ("arrived", "collided")]
            cells = [share_cell(count, len(own)) for count in counts]
            near = np.array([run.clearance for run in own])
            rows.append([plant, name, *cells, median_cell(late[name]), centre_cell(1e3 * near, 0)])
            for rival in (FIRST, SECOND):
                wins = superiority(late[name], late[rival], floor=TIE)
                rows[-1].append("" if rival == name else wins_cell(wins))
        for rival, parts in verdicts.items():
            both = np.isfinite(late[THIRD]) & np.isfinite(late[rival])
            wins = superiority(late[THIRD], late[rival], floor=TIE)
            later = centre_cell(late[THIRD][both] - late[rival][both], 2)
            word = word_of(wins, "faster", "slower")
            parts.append(
                f"{word} ({plant}: arrives first in {wins_cell(wins)} of the pairs; mean difference {later} s)"
            )
    header = ["plant", "MPPI", "arrived", "collided", "later than the plan, s", "least clearance, mm"]
    header += ["arrives before the first", "before the second"]
    says = (
        f"The lag that fits PID on the nominal plant is {1e3 * lag:.0f} ms. In paired draws, with 95 % confidence, "
        f"differences up to {1e3 * TIE:.0f} ms as ties and who does not arrive as last, the third is, against the "
        f"second: {', '.join(verdicts[SECOND])}; against the first: {', '.join(verdicts[FIRST])}. The words follow "
        "from the share of the pairs, whose interval is given the ties. The differences, negative where the third is "
        "earlier, are over the pairs in which both arrive. Times in the table are medians, with who does not arrive as "
        "last, and clearances means."
    )
    return [Table(f"Three MPPIs ({shown})", says, frame(rows, header))]


def median_cell(times: Array) -> str:
    """Returns the median of times in s with its 95 % interval; ∞ where it is of robots that do not arrive."""
    value, low, high = quantile_interval(times, 0.5)[:3]
    text, *ends = (f"{one:.2f}" if np.isfinite(one) else "∞" if one > 0 else "–" for one in (value, low, high))
    return f"{text} [{', '.join(ends)}]"
