"""Runs the checks on a robot, and finds the cause of a failure by experiment.

Inspections list what may be wrong with the model (see `mrctl.checks.inspections`). Where a check fails, these suspects
are repaired in a copy and the check runs again. A suspect is named as a cause if the check passes with all of them
repaired and fails with this one left as it was; where each of several repairs is enough, all of these are named. So a
model may be odd in many ways, and only the oddities that change the measurement are named. Where the repairs are not
enough, a shorter time step is tried, too; any other failure stays unexplained. A number in a wrong unit is found by
arithmetic before anything is driven (see `mrctl.physics.units`).

The parameters that a check expects are read from the same model, so three kinds of mistakes show: parts of a model
that contradict each other (left and right, geom and axle), physics that departs from equations (1) and (3), and numbers
that are consistent but that no robot has (no rotor inertia behind a gear, limits that no voltage reaches).
"""

# pyright: reportAttributeAccessIssue=false
# (mujoco is compiled and ships no stubs)

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import numpy as np

from mrctl.checks.catalogue import CHECKS, Check
from mrctl.checks.comparison import Comparison, Report, compare
from mrctl.checks.inspections import Suspect, suspects
from mrctl.checks.open_loop import ended, limited
from mrctl.checks.plausibility import units
from mrctl.physics.parameters import read_robot
from mrctl.physics.units import bounds, mistake
from mrctl.record import InputError
from mrctl.theory.robot import Steering

Load = Callable[[Steering | None], mujoco.MjModel]  # None: the robot's own arrangement

# Checks that run before others: the others are skipped if one fails with a known cause, as they would fail for it too.
PREREQUISITES = {
    "units": (), "stance": ("units",), "inertias": ("units",), "motors": ("units",), "limits": ("units", "stance"),
    "turning_limits": ("units", "stance"),
}  # fmt: skip
PREREQUISITES_OF_OTHERS = ("units", "stance", "limits", "inertias")
MAX_SECONDS = 20.0  # s of processor time for all checks and explanations of a robot; the default robot takes 4
MAX_SECONDS_OF_ONE = 5.0  # s of processor time for one run of a check
STEP_DIVISOR = 8  # by which the time step is divided where no repair explains a failure


class Explanation(NamedTuple):
    """A cause of a failed check.

    Attributes:
        cause: Name of the fault.
        text: What is odd in the model, and what to do about it.
        evidence: The quantity that was farthest out of tolerance, with all faults repaired; "" where none can be.
    """

    cause: str
    text: str
    evidence: str


@dataclass(frozen=True)
class Finding:
    """The outcome of one check.

    Attributes:
        check: The check.
        report: Its values, empty if it is skipped.
        causes: Causes of its failure, empty if it passes or nothing explains the failure.
        reason: Why it is skipped, or "" if it is not.
    """

    check: Check
    report: Report
    causes: tuple[Explanation, ...] = ()
    reason: str = ""

    @property
    def status(self) -> str:
        """`passed`, `failed` or `skipped`."""
        if self.reason:
            return "skipped"
        return "passed" if _passes(self.report) else "failed"


class Examination:
    """The checks of one robot.

    Attributes:
        checks: All checks for a level floor.
        suspects: Possible faults of the robot's model.
    """

    checks = tuple(check for check in CHECKS if check.world == "flat")

    def __init__(self, load: Load) -> None:
        """Takes a function that compiles the robot in a steering arrangement.

        Raises:
            InputError: The robot cannot be loaded.
        """
        self._load = load
        self.suspects = suspects(load(None))
        self._left = MAX_SECONDS
        self._findings: dict[str, Finding] = {}

    def examine(self, check: Check) -> Finding:
        """Runs a check, and explains it if it fails; it is skipped while the cause of an earlier failure remains."""
        if check.name not in self._findings:
            self._findings[check.name] = self._examine(check)
        return self._findings[check.name]

    def _examine(self, check: Check) -> Finding:
        earlier = PREREQUISITES.get(check.name, PREREQUISITES_OF_OTHERS)
        for prerequisite in (c for c in self.checks if c.name in earlier):
            if self.examine(prerequisite).causes:
                return Finding(check, [], reason=f"waits for {prerequisite.name}")
        if ended():
            return Finding(check, [compare("the check can be done (1: yes), TooLong: its time is up", 0.0, 1.0)])
        model = self._load(check.steering)
        if reason := check.unsuited(model):
            return Finding(check, [], reason=reason)
        report = self._measure(check, model)
        if _passes(report):
            return Finding(check, report)
        causes = _impossible(model, report) if check.name == "units" else self._explain(check, report)
        return Finding(check, report, causes)

    def _measure(self, check: Check, model: mujoco.MjModel) -> Report:
        """Measures the values of a check within the time that is left."""
        start = time.process_time()
        try:
            with limited(min(MAX_SECONDS_OF_ONE, self._left)):
                return check.measure(model, read_robot(model))
        finally:
            self._left -= time.process_time() - start

    def _explain(self, check: Check, report: Report) -> tuple[Explanation, ...]:
        """Returns the suspects whose repair is necessary, or else those whose repair alone is enough."""
        if self._left <= 0 or ended():
            return ()
        worst = max((c for c in report if not c.passed), key=excess)
        suspected = self.suspects
        repaired = self._repaired(check, suspected) if suspected else []
        if not _passes(repaired):
            halved, finer = (long_step(self._load(None), divisor) for divisor in (2, STEP_DIVISOR))
            suspected = [*self.suspects, finer]
            repaired = self._repaired(check, suspected)
            improved = _excess_of(worst, self._repaired(check, [*self.suspects, halved])) < excess(worst)
            if not (_passes(repaired) and improved):
                return ()
        causes = [s for s in suspected if not _passes(self._repaired(check, [o for o in suspected if o is not s]))]
        if not causes:  # each of several repairs is enough
            causes = [s for s in suspected if _passes(self._repaired(check, [s]))]
        evidence = next((c for c in repaired if c.quantity == worst.quantity), repaired[0])
        return tuple(Explanation(suspect.cause, suspect.text, str(evidence)) for suspect in causes)

    def _repaired(self, check: Check, repairs: list[Suspect]) -> Report:
        """Measures a check after some repairs; returns nothing if the robot is then not valid, or the time is up."""
        if ended():
            return []
        model = self._load(check.steering)
        for suspect in repairs:
            suspect.repair(model)
        try:
            mujoco.mj_setConst(model, mujoco.MjData(model))
            return self._measure(check, model)
        except (InputError, mujoco.FatalError):
            return []


def impossible(model: mujoco.MjModel) -> tuple[Explanation, ...]:
    """Returns the cause for which a robot fails the check `units`, by arithmetic; nothing for one that passes it."""
    report = units(model, read_robot(model))
    return () if _passes(report) else _impossible(model, report)


def _impossible(model: mujoco.MjModel, report: Report) -> tuple[Explanation, ...]:
    """Names what makes a robot impossible, or the quantity in a wrong unit, by arithmetic instead of a drive."""
    found = mistake(model, read_robot(model))
    if found is None:
        worst = max((c for c in report if not c.passed), key=excess)
        low, high = worst.expected - worst.tolerance, worst.expected + worst.tolerance
        value = f"{worst.quantity} is {worst.measured:.3g} {worst.unit}".strip()
        text = f"{value}, that of a robot {low:.3g} to {high:.3g}"
        return (Explanation("impossible number", text, ""),)
    worst = min(bounds(found.robot), key=lambda bound: bound.margin)
    evidence = f"{worst.quantity}: {worst.value:.3g} {worst.unit}".strip() if worst.margin > 0 else ""
    return (Explanation("wrong unit", found.text, evidence),)


def excess(comparison: Comparison) -> float:
    """Returns the departure from the expected value as a multiple of the tolerance."""
    excess = abs(comparison.measured - comparison.expected) / max(comparison.tolerance, 1e-12)
    return excess if np.isfinite(excess) else np.inf


def _excess_of(comparison: Comparison, report: Report) -> float:
    """Returns the excess of the same quantity in another report."""
    return next((excess(c) for c in report if c.quantity == comparison.quantity), np.inf)


def _passes(report: Report) -> bool:
    return bool(report) and all(c.passed for c in report)


def long_step(model: mujoco.MjModel, divisor: float) -> Suspect:
    """Makes a suspect of a time step that is too long, which no inspection can see."""
    h = 1e3 * model.opt.timestep

    def repair(faulty: mujoco.MjModel) -> None:
        faulty.opt.timestep /= divisor

    text = (
        f"the result changes with the time step and is right at {h / divisor:g} ms instead of {h:g} ms; shorten it, as "
        f"with mrctl run --physics-step {h / divisor / 1e3:g}"
    )
    return Suspect("time step too long", text, repair)
