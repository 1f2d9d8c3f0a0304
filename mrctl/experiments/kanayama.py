"""Kanayama's table: his motion controller on the kinematic plant, with target values to compare.

The plant is equation (2) with ideal velocity tracking, integrated at 0.1 ms with a second-order step. The reference
runs along the x axis at v_r = 0.30 m/s; the robot starts beside it with v(0) = v_r. Gains and limits are those of
Kanayama et al. (1990); the limiter clips each of v, ω, v̇ and ω̇ separately. A residual is y over Δy when the robot has
come 50 cm along x, and an overshoot is the largest excursion to the other side over Δy.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mrctl.control.kanayama import GAINS, kanayama, posture_error
from mrctl.control.limiter import LIMITER, limit
from mrctl.kernel import Array, Rows, kernel

STEP = 1e-4  # s
SPEED = 0.30  # m/s
K_X, K_Y, K_THETA = 10.0, 64.0, 16.0
LIMITS = np.array([0.40, 0.8, 0.5, 5.0])  # m/s, rad/s, m/s², rad/s²
DISTANCE = 0.50  # m
DURATION = 5.0  # s


class Case(NamedTuple):
    """One entry of the table.

    Attributes:
        name: What is measured.
        unit: `%` of Δy, or `cm`.
        target: Expected value, computed independently at 0.1 ms; the 1990 paper does not print it.
        offset: Initial Δy in m.
        turn: Initial Δθ in rad.
        k_theta: K_θ in 1/m.
        limited: Whether the limiter acts.
        measure: `residual`, `overshoot` or `excursion`.
    """

    name: str
    unit: str
    target: float
    offset: float
    turn: float
    k_theta: float
    limited: bool
    measure: str


def _cases() -> list[Case]:
    table = [
        Case(f"Δy = 5 cm, residual at 50 cm, K_θ = {k:g}", "%", target, 0.05, 0.0, k, False, "residual")
        for k, target in ((12.0, -1.8), (16.0, 9.1), (20.0, 17.9))
    ]
    table.append(Case("Δy = 5 cm, overshoot, ζ = 0.75", "%", 2.87, 0.05, 0.0, 12.0, False, "overshoot"))
    for limited, residuals in ((True, (10.5, 12.1, 16.1, 30.7)), (False, (9.1, 8.8, 7.8, 4.7))):
        how = "with the limiter" if limited else "without"
        for offset, target in zip((0.05, 0.10, 0.20, 0.40), residuals, strict=True):
            name = f"Δy = {100 * offset:g} cm, residual at 50 cm, {how}"
            table.append(Case(name, "%", target, offset, 0.0, K_THETA, limited, "residual"))
    for limited, excursions in ((False, (3.4, 5.9, 7.2)), (True, (12.3, 25.8, 16.3))):
        how = "with the limiter" if limited else "without"
        for degrees, target in zip((45, 90, 135), excursions, strict=True):
            name = f"Δθ = {degrees}°, largest lateral excursion, {how}"
            table.append(Case(name, "cm", target, 0.0, np.radians(degrees), K_THETA, limited, "excursion"))
    return table


CASES = _cases()


CASE = np.dtype(
    [
        ("pose", "f8", 3),  # m, m, rad
        ("period", "f8"),  # control period, s
        ("hold", "i8"),  # number of steps in it
        ("limited", "?"),  # whether the limiter acts
        ("k", GAINS),
        ("error", "f8", 3),  # m, m, rad
        ("request", "f8", 2),  # m/s, rad/s
        ("limiter", LIMITER),
    ],
    align=True,
)


@kernel
def drive(
    reference: Array, twist: Array, zero: Array, max_twist: Array, max_acceleration: Array, rows: Rows, record: Array
) -> None:
    """Drives all cases.

    Args:
        reference: Reference posture at the start in m, m, rad, `(3,)`; it is moved.
        twist: Reference twist in m/s and rad/s, `(2,)`, without rotation.
        zero: Two zeros.
        max_twist: Limits on v and ω in m/s and rad/s, `(2,)`.
        max_acceleration: Limits on v̇ and ω̇ in m/s² and rad/s², `(2,)`.
        rows: The B cases, records of `CASE`.
        record: Out: postures `(steps, B, 3)` in m, m, rad, before each step.
    """
    for k in range(len(record)):
        reference[0] = SPEED * STEP * k
        for i in range(len(rows)):
            s = rows[i]
            for axis in range(3):
                record[k, i, axis] = s.pose[axis]
            if k % s.hold == 0:
                posture_error(s.pose, reference, s.error)
                kanayama(s.error, twist, s.k, s.request)
                limit(s.request, zero, zero, max_twist, max_acceleration, s.period, s.limiter)
            v, omega = s.limiter.command if s.limited else s.request
            middle = s.pose[2] + STEP / 2 * omega
            s.pose[0] += STEP * (v * np.cos(middle))
            s.pose[1] += STEP * (v * np.sin(middle))
            s.pose[2] += STEP * omega


def paths(cases: list[Case], period: float = STEP) -> Array:
    """Simulates every case; returns the postures over time.

    Args:
        cases: The B cases.
        period: Control period in s, a multiple of `STEP`.

    Returns:
        Postures `(steps, B, 3)` in m, m, rad, `STEP` apart in time.
    """
    rows = np.zeros(len(cases), CASE)
    for row, case in zip(rows, cases, strict=True):
        row["pose"], row["limited"], row["k"] = (0.0, case.offset, case.turn), case.limited, (K_X, K_Y, case.k_theta)
    rows["period"], rows["hold"] = period, round(period / STEP)
    rows["limiter"]["time_constant"], rows["limiter"]["command"] = period, (SPEED, 0.0)
    record = np.empty((round(DURATION / STEP), len(cases), 3))
    drive(np.zeros(3), np.array([SPEED, 0.0]), np.zeros(2), LIMITS[:2], LIMITS[2:], rows, record)
    return record


def measure(case: Case, path: Array) -> float:
    """Returns the value of one case in its unit, from its postures `(steps, 3)` in m, m, rad."""
    x, y = path[:, 0], path[:, 1]
    if case.measure == "residual":
        k = int(np.argmax(x >= DISTANCE))
        at = np.interp(DISTANCE, x[k - 1 : k + 1], y[k - 1 : k + 1])
        return float(100 * at / case.offset)
    if case.measure == "overshoot":
        return float(100 * np.max(-y) / case.offset)
    return float(100 * np.abs(y).max())


def table() -> list[dict[str, float | str]]:
    """Returns every case with its target, its value at 0.1 ms (the convention of the targets), and at T_s = 10 ms."""
    fine, coarse = paths(CASES), paths(CASES, 0.01)
    return [
        {
            "case": case.name,
            "unit": case.unit,
            "target": case.target,
            "value": measure(case, fine[:, i]),
            "value_10ms": measure(case, coarse[:, i]),
        }
        for i, case in enumerate(CASES)
    ]
