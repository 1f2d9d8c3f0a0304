"""`mrctl check`: runs the checks on a robot, and reports values and causes of failures as a table or as JSON."""

# pyright: reportAttributeAccessIssue=false
# (mujoco is compiled and ships no stubs)

from __future__ import annotations

import json as jsonlib
import math
import unicodedata
from collections.abc import Sequence

import mujoco
from tqdm import tqdm

from mrctl.checks.comparison import Comparison
from mrctl.checks.examination import Examination, Finding, excess
from mrctl.checks.open_loop import limited
from mrctl.physics.bounds import compiling
from mrctl.physics.elements import has
from mrctl.physics.files import SHIPPED, world_path
from mrctl.physics.mjcf import REQUIRED, arrangement, load, load_robot, steerings

MAX_SECONDS = 28.0  # s of processor time for loading, all checks and explanations; those that are left then fail
UNEXPLAINED = "no inspection explains this, nor does a shorter time step"


def examination(
    path: str = "flat", wheels: Sequence[str] = (), steering: Sequence[str] = (), chassis: str = ""
) -> Examination:
    """Loads a robot to be checked.

    Args:
        path: A world with its robot, or a robot, which gets a level floor (see `mrctl.physics.mjcf.load_robot`).
        wheels: Joints of the two driven wheels of a robot without a world.
        steering: Joints of its steered wheels.
        chassis: Body that carries the wheels.

    Raises:
        InputError: The robot cannot be loaded.
    """
    if not (wheels or steering or chassis) and _is_world(path):
        return Examination(lambda arranged: load(path, arranged or "compliant"))
    robot = load_robot(path, wheels, steering, chassis)
    own = arrangement(robot)
    offered = steerings(load(steering=own, robot=robot))
    return Examination(lambda arranged: load(steering=arranged if arranged in offered else own, robot=robot))


def _is_world(path: str) -> bool:
    """Tells whether a file has its own floor, and on it a robot with the names of `mrctl.physics.elements`."""
    if path in SHIPPED:
        return False
    world = world_path(path)
    with compiling(path):
        model = mujoco.MjModel.from_xml_path(str(world))
    parts = all(has(model, kind, name) for kind, names in REQUIRED.items() for name in names)
    return has(model, "geom", "wheel_left") and (model.npair > 0 or (parts and has(model, "geom", "floor")))


def run(
    path: str = "flat",
    wheels: Sequence[str] = (),
    steering: Sequence[str] = (),
    chassis: str = "",
    json: bool = False,
) -> tuple[str, str]:
    """Runs the checks on a robot.

    Args:
        path: A world with its robot, or a robot, as in `examination`.
        wheels: Joints of the two driven wheels.
        steering: Joints of the steered wheels.
        chassis: Body that carries the wheels.
        json: Whether the report is JSON instead of a table.

    Returns:
        The report, and a verdict such as "3 of 24 checks failed", or "" if none failed.

    Raises:
        InputError: The robot cannot be loaded.
    """
    with limited(MAX_SECONDS):
        robot = examination(path, wheels, steering, chassis)
        findings = [robot.examine(check) for check in tqdm(robot.checks, unit="check")]
    failed = sum(finding.status == "failed" for finding in findings)
    verdict = f"{failed} of {len(findings)} checks failed" if failed else ""
    if json:
        report = {"robot": path, "failed": failed, "checks": [as_data(finding) for finding in findings]}
        return jsonlib.dumps(report, indent=2, ensure_ascii=False, allow_nan=False), verdict
    return table(findings), verdict


def as_data(finding: Finding) -> dict[str, object]:
    """Returns a finding as JSON data, in which NaN and infinity become null."""

    def number(value: float) -> float | None:
        return value if math.isfinite(value) else None

    return {
        "check": finding.check.name,
        "status": finding.status,
        "reason": finding.reason,
        "values": [
            {k: number(v) if isinstance(v, float) else v for k, v in c._asdict().items()} | {"passed": c.passed}
            for c in finding.report
        ],
        "causes": [cause._asdict() for cause in finding.causes],
    }


def table(findings: list[Finding]) -> str:
    """Returns a table: the tightest value of each passed check, all failed values of the others, and their causes."""
    rows = [("check", "value", "measured", "expected", "")]
    for finding in (f for f in findings if not f.reason):
        name = finding.check.name
        values = [c for c in finding.report if not c.passed] or [max(finding.report, key=excess)]
        rows += [(name, *_cells(c)) for c in values[:1]] + [("", *_cells(c)) for c in values[1:]]
        if finding.status == "failed":
            rows.append(("", cause_line(finding), "", "", ""))
    widths = [max(_width(row[k]) for row in rows if row[2]) for k in range(4)]
    lines = [
        "  ".join(c + " " * (w - _width(c)) for c, w in zip(row, [*widths, 0], strict=True)).rstrip() for row in rows
    ]
    for reason in dict.fromkeys(f.reason for f in findings if f.reason):
        lines.append(f"skipped, {reason}: {', '.join(f.check.name for f in findings if f.reason == reason)}")
    texts = {cause.cause: cause.text for finding in findings for cause in finding.causes}
    if texts:
        lines += ["", "Likely causes in the model:", *(f"- {cause}: {text}" for cause, text in texts.items())]
    counts = [(sum(f.status == s for f in findings), s) for s in ("passed", "failed", "skipped")]
    return "\n".join([*lines, "", ", ".join(f"{count} {status}" for count, status in counts if count)])


def cause_line(finding: Finding) -> str:
    """Returns the causes of a failed check, and its worst value after their repair, in one line."""
    if not finding.causes:
        return UNEXPLAINED
    evidence = finding.causes[0].evidence
    return f"cause: {', '.join(c.cause for c in finding.causes)}" + (f"; once repaired, {evidence}" if evidence else "")


def _width(cell: str) -> int:
    """Returns the width of a cell in characters on the screen; the dot of θ̇ takes none."""
    return sum(not unicodedata.combining(letter) for letter in cell)


def _cells(c: Comparison) -> tuple[str, str, str, str]:
    expected = f"{c.expected:.4g} ± {c.tolerance:.2g} {c.unit}".strip()
    return c.quantity, f"{c.measured:.4g}", expected, "pass" if c.passed else "FAIL"
