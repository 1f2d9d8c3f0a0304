"""`mrctl check`: the physics checks on a robot, as a table or as JSON, with the causes of what fails."""

from __future__ import annotations

import json as jsonlib
import math
import unicodedata

from mrctl.checks import Comparison
from mrctl.diagnosis import Examination, Finding, excess
from mrctl.model import load

UNEXPLAINED = "nothing odd in the model explains this, nor does a shorter time step"


def examination(robot: str) -> Examination:
    """Gets a robot ready to be checked.

    Args:
        robot: World or MJCF file with the robot.

    Raises:
        InputError: It cannot be loaded.
    """
    return Examination(lambda steering: load(robot, steering or "compliant"))


def run(robot: str, json: bool = False) -> tuple[str, str]:
    """Runs all checks that suit a robot.

    Args:
        robot: World or MJCF file with the robot.
        json: Return JSON.

    Returns:
        The report, and "3 of 22 checks failed", empty if none did.

    Raises:
        InputError: The robot cannot be loaded.
    """
    patient = examination(robot)
    findings = [patient.look(check) for check in patient.checks]
    failed = sum(finding.status == "failed" for finding in findings)
    verdict = f"{failed} of {len(findings)} checks failed" if failed else ""
    if json:
        report = {"robot": robot, "failed": failed, "checks": [as_data(finding) for finding in findings]}
        return jsonlib.dumps(report, indent=2, ensure_ascii=False, allow_nan=False), verdict
    return table(findings), verdict


def as_data(finding: Finding) -> dict[str, object]:
    """A finding for machines; what is no number is null."""

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
    """A line for each check with the value that is nearest to its tolerance, one for each that failed, and causes."""
    rows = [("check", "value", "measured", "expected", "")]
    for finding in (f for f in findings if not f.reason):
        name = finding.check.name
        shown = [c for c in finding.report if not c.passed] or [max(finding.report, key=excess)]
        rows += [(name, *_cells(c)) for c in shown[:1]] + [("", *_cells(c)) for c in shown[1:]]
        if finding.status == "failed":
            rows += [("", line, "", "", "") for line in because(finding)]
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


def because(finding: Finding) -> list[str]:
    """Lines that say why a check failed."""
    if not finding.causes:
        return [UNEXPLAINED]
    return [f"because of {', '.join(c.cause for c in finding.causes)}; repaired, {finding.causes[0].evidence}"]


def _width(cell: str) -> int:
    """Columns that a cell takes: the dot of θ̇ takes none."""
    return sum(not unicodedata.combining(letter) for letter in cell)


def _cells(c: Comparison) -> tuple[str, str, str, str]:
    expected = f"{c.expected:.4g} ± {c.tolerance:.2g} {c.unit}".strip()
    return c.quantity, f"{c.measured:.4g}", expected, "pass" if c.passed else "FAIL"
