"""The score of robots while they drive: the error now, and the metrics of their laps, which are those of the tables."""

from __future__ import annotations

import html
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mrctl.kernel import Rows
from mrctl.results.metrics import lap_metrics
from mrctl.viewer.looks import Look

Array = NDArray[np.float64]

HEADINGS = (
    "error now, mm", "RMS of last lap, mm", "best lap, mm", "feedback in last lap, %", "energy of last lap, J",
)  # fmt: skip


def whole_laps(log: Rows, ticks: int, period: float) -> list[dict[str, Array]]:
    """Returns the metrics `(B,)` of `results.metrics.METRICS` of each whole lap, by name.

    Args:
        log: Record of `TICK` of each sample from the start of a lap and of each robot, `(T, B)`.
        ticks: Number of samples in a lap.
        period: Time between samples in s.
    """
    laps = []
    for start in range(0, len(log) - ticks + 1, ticks):
        data = {name: log[name][start : start + ticks].T for name in log.dtype.names or ()}
        laps.append(lap_metrics(data, data, period))
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
    last = laps[-1] if laps else {"feedback_share": nothing, "energy": nothing}
    best = np.where(np.isnan(errors), np.inf, errors).min(axis=0)
    columns = [
        1e3 * np.hypot(now["longitudinal_error"], now["lateral_error"]),
        1e3 * errors[-1],
        1e3 * np.where(np.isfinite(best), best, np.nan),
        100 * last["feedback_share"],
        last["energy"],
    ]
    head = "".join(f'<th style="font-weight:500;text-align:right">{text}</th>' for text in ("", *HEADINGS))
    rows = "".join(
        f'<tr><td style="color:rgb{robot.colour}">{html.escape(robot.label)}</td>{_cells([c[k] for c in columns])}</tr>'
        for k, robot in enumerate(robots)
    )
    return f'<table id="mrctl-score" style="margin:0.3em 1em;font-size:0.75em"><tr>{head}</tr>{rows}</table>'


def _cells(values: Sequence[float]) -> str:
    """Returns the cells of numbers to three digits; what is not known yet, or not any more, is a dash."""
    texts = [np.format_float_positional(v, 3, fractional=False, trim="-") if np.isfinite(v) else "–" for v in values]
    return "".join(f'<td style="text-align:right">{text}</td>' for text in texts)
