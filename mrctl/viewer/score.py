"""The score of robots while they drive, with the metrics of the tables, and what their last lap could teach."""

from __future__ import annotations

import html
from collections.abc import Iterable, Sequence

import numpy as np

from mrctl.control.features import NAMES, feature_scale
from mrctl.kernel import Array, Rows
from mrctl.results.excitation import alone
from mrctl.results.metrics import excitation, lap_metrics
from mrctl.theory.robot import Robot
from mrctl.viewer.looks import Look

HEADINGS = (
    "error now, mm", "RMS of last lap, mm", "best lap, mm", "feedback in last lap, %", "energy of last lap, J",
    "excitation in last lap",
)  # fmt: skip

# A row for each number and a column for each robot: the names of the numbers stay where many robots are scrolled.
HEADING = "position:sticky;left:0;background:var(--mantine-color-body);padding-right:0.8em"
NUMBER = "font-weight:500;text-align:right;vertical-align:bottom"
SMALL = 1e-3  # below which a number is written with an exponent


def whole_laps(log: Rows, ticks: int, period: float, robot: Robot) -> list[dict[str, Array]]:
    """Returns the metrics `(B,)` of `results.metrics.METRICS` of each whole lap, by name, and `alone`, `(B, 8)`.

    The last is the excitation of each feature alone, as of `results.excitation.alone`.

    Args:
        log: Record of `TICK` of each sample from the start of a lap and of each robot, `(T, B)`.
        ticks: Number of samples in a lap.
        period: Time between samples in s.
        robot: The nominal robot.
    """
    laps = []
    for start in range(0, len(log) - ticks + 1, ticks):
        data = {name: log[name][start : start + ticks].T for name in log.dtype.names or ()}
        command = np.stack([data["v_command"], data["omega_command"]], axis=-1)
        size, scale = len(command), feature_scale(robot)
        motion = command, period, np.full(size, robot.half_track), np.tile(scale, (size, 1))
        laps.append(lap_metrics(data, data, period) | {"excitation": excitation(*motion), "alone": alone(*motion)})
    return laps


def table(robots: Sequence[Look], now: Rows, laps: Sequence[dict[str, Array]]) -> str:
    """Returns the score in HTML.

    Args:
        robots: Look of each robot.
        now: Record of `TICK` of each robot, `(B,)`.
        laps: As from `whole_laps`, of the laps until now.
    """
    nothing = np.full(len(robots), np.nan)
    errors = np.array([lap["position_rmse"] for lap in laps] or [nothing])
    last = laps[-1] if laps else dict.fromkeys(("feedback_share", "energy", "excitation"), nothing)
    best = np.where(np.isnan(errors), np.inf, errors).min(axis=0)
    columns = [
        1e3 * np.hypot(now["longitudinal_error"], now["lateral_error"]),
        1e3 * errors[-1],
        1e3 * np.where(np.isfinite(best), best, np.nan),
        100 * last["feedback_share"],
        last["energy"],
        last["excitation"],
    ]
    return _table("mrctl-score", "", robots, HEADINGS, columns)


def lessons(robots: Sequence[Look], laps: Sequence[dict[str, Array]], error: Array | None, when: str) -> str:
    """Returns what the last lap could teach about each feature, and what has been learned, in HTML.

    Args:
        robots: Look of each robot.
        laps: As from `whole_laps`, of the laps until now.
        error: Learned less true coefficients of the features in V, `(B, 8, 2)`, NaN where there are none; None if no
            robot has any.
        when: When this error holds.
    """
    excited = laps[-1]["alone"].T if laps else np.full((len(NAMES), len(robots)), np.nan)
    found = _table("mrctl-excitation", "excitation alone, last lap", robots, NAMES, excited)
    if error is not None:
        for k, channel in enumerate("ΣΔ"):
            title = f"error of coefficient {channel}, prior and learner, V, {when}"
            found += _table(f"mrctl-coefficients-{k}", title, robots, NAMES, error[:, :, k].T)
    return found


def _table(
    name: str, title: str, robots: Sequence[Look], headings: Sequence[str], rows: Iterable[Sequence[float]]
) -> str:
    """Returns a table in HTML with a row for each heading and a column for each robot."""
    names = "".join(f'<th style="{NUMBER};color:rgb{r.colour}">{html.escape(r.label)}</th>' for r in robots)
    lines = "".join(
        f'<tr><td style="{HEADING}">{heading}</td>{_cells(values)}</tr>'
        for heading, values in zip(headings, rows, strict=True)
    )
    return (
        f'<div style="margin:0.3em 1em;overflow-x:auto"><table id="{name}" style="font-size:0.75em">'
        f'<tr><td style="{HEADING}">{title}</td>{names}</tr>{lines}</table></div>'
    )


def _cells(values: Sequence[float]) -> str:
    """Returns the cells of numbers to three digits; what is not known yet, or not any more, is a dash."""
    texts = [f"{v:.2g}" if 0 < abs(v) < SMALL else _positional(v) if np.isfinite(v) else "–" for v in values]
    return "".join(f'<td style="{NUMBER}">{text}</td>' for text in texts)


def _positional(value: float) -> str:
    return np.format_float_positional(value, 3, fractional=False, trim="-")
