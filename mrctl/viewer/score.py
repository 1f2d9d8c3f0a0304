"""The score of robots while they drive, with the metrics of the tables, and what their motion could teach."""

from __future__ import annotations

import html
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from mrctl.control.features import FEATURE_NAMES, feature_scale
from mrctl.kernel import Array, Rows
from mrctl.loop.goals import arrived
from mrctl.loop.timeline import begun, ends, followed
from mrctl.results.excitation import alone
from mrctl.results.metrics import lap_metrics
from mrctl.scenario import Scenario
from mrctl.theory.robot import Robot
from mrctl.viewer.looks import Look

LAP_SCORES = (
    "error now, mm", "RMS of last lap, mm", "best lap, mm", "feedback in last lap, %", "energy of last lap, J",
)  # fmt: skip
WAY_SCORES = (
    "off the timed plan now, mm", "RMS of that on the way, mm", "feedback on the way, %", "energy on the way, J",
)  # fmt: skip
# s, and a share of a way, by which a robot drives on until its metrics are computed again
FRESH_TIME, FRESH_SHARE = 1.0, 0.02

# A row for each number and a column for each robot: the names of the numbers stay where many robots are scrolled.
HEADING_STYLE = "position:sticky;left:0;background:var(--mantine-color-body);padding-right:0.8em"
NUMBER_STYLE = "font-weight:500;text-align:right;vertical-align:bottom"
EXPONENT_BELOW = 1e-3  # below which a number is written with an exponent


def one_lap(log: Rows, period: float, robot: Robot) -> dict[str, Array]:
    """Returns the metrics `(B,)` of `results.metrics.lap_metrics` of a lap, by name, and `alone`, `(B, 8)`.

    The last is the excitation of each feature alone, as of `results.excitation.alone`.

    Args:
        log: Record of `TICK` of each sample of the lap and of each robot, `(T, B)`.
        period: Time between samples in s.
        robot: The nominal robot.
    """
    data = {name: log[name].T for name in log.dtype.names or ()}
    command = np.stack([data["v_command"], data["omega_command"]], axis=-1)
    size, scale = len(command), feature_scale(robot)
    motion = command, period, np.full(size, robot.half_track), np.tile(scale, (size, 1))
    return lap_metrics(data, data, period) | {"alone": alone(*motion)}


def on_the_way(log: Rows, goals: Array, period: float, robot: Robot) -> tuple[list[dict[str, Array]], bool]:
    """Returns what `one_lap` does of a way to a goal, in a list, and whether it is final.

    There is none of a way that has hardly begun. It is final when each robot has arrived, or has failed.

    Args:
        log: Record of `TICK` of each sample from the start of the way and of each robot, `(T, B)`; the way of a robot
            ends with the first one in which it has arrived.
        goals: Goals in m, m, rad, `(3,)` or `(B, 3)`; NaN for none.
        period: Time between samples in s.
        robot: The nominal robot.
    """
    if len(log) < 2:
        return [], False
    there = arrived(np.stack([log["x"], log["y"], log["theta"]], axis=-1), log["v"], goals)
    found = []
    for row, at in enumerate(there.T):
        samples = max(2, int(at.argmax()) + 1) if at.any() else len(log)
        found.append(one_lap(log[:samples, row : row + 1], period, robot))
    final = bool(np.all(there.any(axis=0) | np.isnan(log["x"][-1])))
    return [{name: np.concatenate([of[name] for of in found]) for name in found[0]}], final


class Metrics:
    """Metrics of what robots have driven on their present reference: of each whole lap, or of the way to its end.

    Attributes:
        laps: Of each lap what `one_lap` returns, or, of a way, at most one, from `on_the_way`.
        way: Whether they are of a way.
    """

    def __init__(self, robot: Robot, period: float) -> None:
        """Takes the nominal robot and the time between samples in s."""
        self._robot, self._period = robot, period
        self._all: list[dict[str, Array]] = []
        self._of: tuple[int, bool] | None = None  # first sample of what `_all` is of, and whether that is a way
        self._until = 0  # number of samples at which the metrics of a way were computed
        self._final = False  # whether they do not change any more
        self.laps, self.way = self._all, False

    def update(
        self, scenarios: Sequence[Scenario], log: Callable[[int, int], Rows], until: int, first: int = 0,
        exact: bool = True,
    ) -> None:  # fmt: skip
        """Computes what is not known yet.

        Laps of a recording that begins in the middle of a run begin with its first sample.

        Args:
            scenarios: Scenario of each robot with its events until now, or one of all robots.
            log: Returns a record of `TICK` of the samples from one to another one, without it, `(T, B)`.
            until: Number of samples until now.
            first: Control tick of the first sample.
            exact: Whether the metrics of a way are those until now, or may be a little older.
        """
        now = (first + until) * self._period
        bounds = [ends(scenario, now) for scenario in scenarios]
        begin, way = max(0, round(begun(scenarios[0], now) / self._period) - first), bounds[0] is not None
        if (begin, way) != self._of or until < self._until:
            self._of, self._all, self._until, self._final = (begin, way), [], begin, False
        if way:
            old = until - self._until >= max(FRESH_TIME / self._period, FRESH_SHARE * (until - begin))
            if not self._final and (old or (exact and until != self._until)):
                goals = np.stack([np.full(3, np.nan) if found is None else found[1] for found in bounds])
                self._all, self._final = on_the_way(log(begin, until), goals, self._period, self._robot)
                self._until = until
            self.laps = self._all
        else:
            lap = followed(scenarios[0], now).period / self._period  # samples, as of `results.metrics.laps_of`
            done = int((until - begin + 0.5) / lap + 1e-6)
            for k in range(len(self._all), done):
                start, end = (begin + round(number * lap) for number in (k, k + 1))
                self._all.append(one_lap(log(start, min(end, until)), self._period, self._robot))
            self.laps = self._all[:done]
        self.way = way


def table(robots: Sequence[Look], now: Rows, laps: Sequence[dict[str, Array]], way: bool) -> str:
    """Returns the score in HTML.

    Args:
        robots: Look of each robot.
        now: Record of `TICK` of each robot, `(B,)`.
        laps: As in `Metrics`.
        way: As in `Metrics`.
    """
    nothing = np.full(len(robots), np.nan)
    errors = np.array([lap["position_rmse"] for lap in laps] or [nothing])
    last = laps[-1] if laps else dict.fromkeys(("feedback_share", "energy"), nothing)
    best = np.where(np.isnan(errors), np.inf, errors).min(axis=0)
    columns = [
        1e3 * np.hypot(now["longitudinal_error"], now["lateral_error"]),
        1e3 * errors[-1],
        *([] if way else [1e3 * np.where(np.isfinite(best), best, np.nan)]),
        100 * last["feedback_share"],
        last["energy"],
    ]
    return _table("mrctl-score", "", robots, WAY_SCORES if way else LAP_SCORES, columns)


def lessons(robots: Sequence[Look], laps: Sequence[dict[str, Array]], way: bool, error: Array | None, when: str) -> str:
    """Returns what the last lap or the way could teach about each feature, and what has been learned, in HTML.

    Args:
        robots: Look of each robot.
        laps: As in `Metrics`.
        way: As in `Metrics`.
        error: Learned less true coefficients of the features in V, `(B, 8, 2)`, NaN where there are none; None if no
            robot has any.
        when: When this error holds.
    """
    excited = laps[-1]["alone"].T if laps else np.full((len(FEATURE_NAMES), len(robots)), np.nan)
    title = f"excitation alone, {'on the way' if way else 'last lap'}"
    found = _table("mrctl-excitation", title, robots, FEATURE_NAMES, excited)
    if error is not None:
        for k, channel in enumerate("ΣΔ"):
            title = f"error of coefficient {channel}, prior and learner, V, {when}"
            found += _table(f"mrctl-coefficients-{k}", title, robots, FEATURE_NAMES, error[:, :, k].T)
    return found


def _table(
    name: str, title: str, robots: Sequence[Look], headings: Sequence[str], rows: Iterable[Sequence[float]]
) -> str:
    """Returns a table in HTML with a row for each heading and a column for each robot."""
    names = "".join(f'<th style="{NUMBER_STYLE};color:rgb{r.colour}">{html.escape(r.label)}</th>' for r in robots)
    lines = "".join(
        f'<tr><td style="{HEADING_STYLE};white-space:nowrap">{heading}</td>{_cells(values)}</tr>'
        for heading, values in zip(headings, rows, strict=True)
    )
    return (
        f'<div style="margin:0.3em 1em;overflow-x:auto"><table id="{name}" style="font-size:0.75em">'
        f'<tr><td style="{HEADING_STYLE}">{title}</td>{names}</tr>{lines}</table></div>'
    )


def _cells(values: Sequence[float]) -> str:
    """Returns the cells of numbers to three digits; what is not known yet, or not any more, is a dash."""
    texts = [f"{v:.2g}" if 0 < abs(v) < EXPONENT_BELOW else _positional(v) if np.isfinite(v) else "–" for v in values]
    return "".join(f'<td style="{NUMBER_STYLE}">{text}</td>' for text in texts)


def _positional(value: float) -> str:
    return np.format_float_positional(value, 3, fractional=False, trim="-")
