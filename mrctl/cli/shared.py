"""What several commands do: they refuse what can be seen before slow imports, and report how they ended."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from mrctl.cli.arguments import fields_set
from mrctl.record import InputError, printable, reading
from mrctl.scenario import FeedforwardName, Scenario
from mrctl.theory.robot import CAR, RobotFile

if TYPE_CHECKING:
    from mrctl.experiments.tables import Report

BEST: FeedforwardName = "model+composite"
"""Feedforward that is best, or level with the best, in more cases of the suite than any other (31 of 34).

`navigate` drives with it, and `view` shows it beside PID alone.
"""


def check_world(world: str, robot: RobotFile = CAR) -> None:
    """Refuses a world or a robot without a file that can be read, before physics is imported, which takes seconds."""
    from mrctl.physics.files import robot_path, world_path

    world_path(world)
    if robot != CAR:
        robot_path(robot)


def warn_if_impossible(scenario: Scenario) -> None:
    """Says on stderr before a run if no robot could have a number of its file; mrctl's own robots need no check."""
    from mrctl.physics.files import SHIPPED

    file = scenario.robot.path if scenario.robot != CAR else scenario.world
    if file in SHIPPED or not file.endswith(".xml"):
        return
    from mrctl.checks.examination import impossible
    from mrctl.loop.groups import arranged
    from mrctl.physics.mjcf import load

    scenario = arranged(scenario)
    for cause in impossible(load(scenario.world, scenario.steering, robot=scenario.robot)):
        text = printable(f"{file}: {cause.cause}: {cause.text}; see mrctl check {file}")
        print(f"mrctl: warning: {text}", file=sys.stderr)


def check_exists(file: Path) -> None:
    """Refuses a file or folder that does not exist, before what reads it is imported."""
    with reading(file):
        if not file.exists():
            raise InputError(f"{file}: no such file or folder")


def check_workers(workers: int | None) -> None:
    """Refuses a number of processes below 1."""
    if workers is not None and workers < 1:
        raise InputError(f"workers: {workers} is below 1")


def suited(scenario: Scenario, arguments: Sequence[str], scenario_file: str | None) -> Scenario:
    """Adapts the reference of a scenario to its robot, if the command line names a robot and no reference."""
    given = fields_set(arguments)
    if scenario_file or "robot" not in given or "reference" in given:
        return scenario
    from mrctl.loop.groups import suited

    return suited(scenario)


def show(found: Report, out: Path | None, json: bool) -> None:
    """Prints a report, writes its files, and prints where they are; JSON stays alone on stdout."""
    try:
        print(found.text, flush=True)
    finally:  # also where nobody reads what is printed
        found.save()
    if out is not None:
        print(f"The files are in {out}.", file=sys.stderr if json else sys.stdout)


def expect_same(folder: Path, departs: str, json: bool) -> None:
    """Says that a repeated run has the bits of the saved one, or fails the command."""
    if departs:
        raise Incomplete(f"{folder}: departs in {departs}, from what was saved there")
    print(f"{folder}: bit-identical", file=sys.stderr if json else sys.stdout)


def expect_all(aside: str) -> None:
    """Fails the command if runs were set aside; the text says which."""
    if aside:
        raise Incomplete(f"{aside}; the same command tries them again")


class Incomplete(Exception):
    """A command has ended, but a part of its work failed; the message says which part."""
