"""Feeding up, of `mrctl navigate --suite`: plans whose limits know what the learner knows.

The time law of a plan keeps the motors below nine tenths of the supply, by the inverse dynamics of the nominal robot. A
heavier robot, or one whose supply is weak, needs more voltage than that, and is left behind where the motors saturate.
Here a robot with `model+composite` drives a plan with nominal limits. The coefficients that it adapts on the way take
the place of the nominal ones in the limits of a second plan along the same path. Then the robot, which keeps what it
has learned, drives both. A draw is a corridor, and a robot on one day (`mrctl.scenario.replicates`).
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from mrctl.control.features import FEATURES, feature_scale
from mrctl.experiments.journal import Computation, Journal
from mrctl.experiments.mission_suite import PLANTS as SHARED
from mrctl.experiments.mission_suite import ROOMY_FACTOR, SHAPE, TIE, Mode, drawn
from mrctl.experiments.tables import Table, centre_cell, frame, share_cell, wins_cell, word_of
from mrctl.loop.groups import arranged
from mrctl.loop.learned import kept, save_learned
from mrctl.loop.runs import simulate
from mrctl.navigation.generators import corridor
from mrctl.navigation.mission import reached
from mrctl.navigation.plan import Plan
from mrctl.navigation.planning import PATIENCE, REPLAN_MARGIN, Query, planned
from mrctl.navigation.vehicle import Vehicle
from mrctl.record import InputError
from mrctl.results.comparison import superiority
from mrctl.results.dataset import scenarios_of
from mrctl.scenario import FEEDFORWARDS, Scenario, replicates
from mrctl.theory.dynamics import inverse_coefficients
from mrctl.theory.obstacles import Pose
from mrctl.theory.perturbation import PERTURBATIONS, Perturbation
from mrctl.theory.references import Waypoints
from mrctl.theory.robot import Robot
from mrctl.theory.timing import LIMIT_SHARE, Limits

PLANTS: dict[str, Perturbation] = {**SHARED, "mass +50 %": PERTURBATIONS["mass +50 %"]}
DRAWS = {"quick": 6, "core": 40}
SIMULATED_PER_SECOND = 50  # simulated s in a s of one core, planning included
LIMITS = ("nominal", "learned")


class Draw(NamedTuple):
    """A corridor, and the plan through it with nominal limits."""

    seed: int
    plan: Plan
    reference: Waypoints
    goal: Pose


class Run(NamedTuple):
    """How a robot followed a plan."""

    arrived: bool
    plan: float
    """Time of the plan in s."""
    error: float
    """Largest distance from the reference in m; infinite where it did not arrive."""


Found = dict[str, dict[str, list[Run]]]
"""Runs by plant and limits."""


def drive(base: Scenario, mode: Mode, journal: Journal) -> Found:
    """Drives all draws on all plants; says first how long that takes.

    Args:
        base: Robot, steering, sensing and all else that is the same for all.
        mode: Which suite.
        journal: What was driven already, by plant, which is kept there.

    Raises:
        InputError: The robot does not fit most corridors.
    """
    count = DRAWS[mode]
    vehicle = Vehicle.of(base)
    width, speed = ROOMY_FACTOR * vehicle.width, LIMIT_SHARE * vehicle.robot.max_speed
    complaint = f"suite: {base.robot.path} finds no way through most corridors of {width:.2f} m"
    draws = drawn(partial(draw, vehicle, width, speed), count, complaint)
    left = sum(plant not in journal for plant in PLANTS) * (1 + len(LIMITS))
    expected = journal.expected(
        left * sum(one.reference.period for one in draws) / SIMULATED_PER_SECOND, left // (1 + len(LIMITS))
    )
    print(f"{left * count} runs with nominal and with learned limits, {expected}", flush=True)
    own = base.replace(**FEEDFORWARDS["model+composite"], laps=PATIENCE, initial_spread=(0.0, 0.0, 0.0))
    parts = [
        Computation(plant, partial(_fed, own.replace(perturbation=perturbation), draws, vehicle.robot, speed))
        for plant, perturbation in PLANTS.items()
    ]
    return {
        plant: {name: [Run(*run) for run in driven] for name, driven in found.items()}
        for plant, found in zip(PLANTS, journal.results(parts), strict=True)
    }


def draw(vehicle: Vehicle, width: float, speed: float, seed: int) -> Draw | None:
    """Makes a corridor and plans a way through it; None where there is no way."""
    task = corridor(width, seed, **SHAPE)
    with suppress(InputError):
        return Draw(seed, *planned(Query(task, vehicle, speed, REPLAN_MARGIN)), task.goal)


def _fed(perturbed: Scenario, draws: Sequence[Draw], robot: Robot, speed: float) -> dict[str, list[Run]]:
    """Drives all draws, then plans with what was learned and drives both plans of each; returns the runs by limits.

    Args:
        perturbed: The robot as it is, with its velocity controller.
        draws: The draws.
        robot: The nominal robot.
        speed: Largest speed of the plans in m/s.
    """
    first = simulate([_replicate(perturbed, one, one.reference) for one in draws], threads=1)
    with TemporaryDirectory() as folder:
        files, references = [], []
        for k, one in enumerate(draws):
            run, path, limits = first.isel(run=k), str(Path(folder) / f"{k}.safetensors"), Limits.of(robot)
            if learns := not run["failed"]:  # a run that failed teaches nothing
                save_learned(path, run)
                with suppress(InputError):  # no robot has such coefficients, and it plans with the nominal ones
                    limits = limits_of(run, robot)
            files.append(path if learns else None)
            references.append(one.plan.reference(speed, limits))
        ways = {"nominal": [one.reference for one in draws], "learned": references}
        return {name: _driven(perturbed, draws, way, files) for name, way in ways.items()}


def limits_of(run: xr.Dataset, robot: Robot) -> Limits:
    """Returns the limits of a robot with the coefficients that `composite` has adapted at the end of a run.

    With rigid steering the second channel is no voltage, so its coefficients stay nominal.

    Args:
        run: One run of a result, with the prior `model`.
        robot: The nominal robot.
    """
    (scenario,) = scenarios_of(run)
    ((name, shape), *_) = kept(scenario).items()
    assert name == "a" and scenario.prior == "model"
    weights = run["weights"].values[: int(np.prod(shape))].reshape(shape)[:, :FEATURES]
    adapted = inverse_coefficients(robot)
    channels = 1 if arranged(scenario).steering == "rigid" else 2
    adapted[:, :channels] += (weights[:channels] / feature_scale(robot)).T
    return Limits.of(robot).replace(inverse=tuple((float(common), float(other)) for common, other in adapted))


def _replicate(scenario: Scenario, one: Draw, reference: Waypoints, learned: str | None = None) -> Scenario:
    own = scenario.replace(reference=reference, goal=one.goal, learned=learned)
    return replicates(own, 1, one.seed)[0]


def _driven(
    perturbed: Scenario, draws: Sequence[Draw], references: Sequence[Waypoints], files: Sequence[str | None]
) -> list[Run]:
    """Drives plans with what was learned."""
    cases = zip(draws, references, files, strict=True)
    result, found = simulate([_replicate(perturbed, *case) for case in cases], threads=1), []
    for k, (one, reference) in enumerate(zip(draws, references, strict=True)):
        run = result.isel(run=k).dropna("time", subset=["x"])
        there = reached(run, one.goal)
        errors = np.hypot(run["longitudinal_error"].values, run["lateral_error"].values)
        found.append(Run(there, reference.period, float(errors.max()) if there else np.inf))
    return found


def values(runs: Found) -> dict[str, Any]:
    """Returns what was found for JSON."""
    rows = {plant: {name: [run._asdict() for run in own] for name, own in of.items()} for plant, of in runs.items()}
    return {"limits": rows}


def tables(runs: Found, shown: str) -> list[Table]:
    """Returns the table of the tracking of the plans on each plant, with a sentence that sums it up."""
    rows, verdicts = [], []
    for plant, of in runs.items():
        errors = {name: np.array([run.error for run in own]) for name, own in of.items()}
        for name, own in of.items():
            there = sum(run.arrived for run in own)
            times = np.array([run.plan for run in own])
            cells = [centre_cell(times, 2, median=True), centre_cell(1e3 * errors[name], 1, median=True)]
            rows.append([plant, name, share_cell(there, len(own)), *cells])
        wins = superiority(errors["learned"], errors["nominal"], floor=TIE)
        verdicts.append(f"{word_of(wins, 'smaller', 'larger')} on {plant} ({wins_cell(wins)})")
    says = (
        f"In paired draws, with 95 % confidence and differences up to {1e3 * TIE:.0f} mm as ties, the largest error "
        f"with learned limits is, against nominal ones: {', '.join(verdicts)}. Times and errors are medians; errors "
        "are of the robots that arrive."
    )
    header = ["plant", "limits of the plan", "arrived", "time of the plan, s", "largest error, mm"]
    return [Table(f"Feeding up ({shown})", says, frame(rows, header))]
