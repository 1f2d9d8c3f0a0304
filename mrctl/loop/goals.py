"""The ends of missions: a run with a goal ends when the robot stands at the goal, or when it is stuck."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mrctl.kernel import Array, Rows
from mrctl.scenario import Scenario

NEAR, TURNED, RESTING = 0.1, 0.2, 0.05  # m, rad and m/s, within which a robot has arrived
HEADWAY, STUCK = 0.05, 5.0  # m and s: a robot that moves no farther than that within this time is stuck


def arrived(pose: Array, v: ArrayLike, goal: Array) -> NDArray[np.bool]:
    """Tells which robots stand at their goals: within 0.1 m and 0.2 rad, and slower than 0.05 m/s.

    Args:
        pose: x and y in m and θ in rad, `(…, 3)`.
        v: Linear velocities in m/s, `(…)`.
        goal: Goals in m, m, rad, `(…, 3)`; NaN for none.
    """
    away = pose - goal
    turned = np.abs(np.angle(np.exp(1j * away[..., 2])))
    return (np.hypot(away[..., 0], away[..., 1]) < NEAR) & (turned < TURNED) & (np.abs(v) < RESTING)


class Goals:
    """The goals of a group of runs."""

    def __init__(self, scenarios: Sequence[Scenario], timed: bool = True) -> None:
        """Takes the scenario of each robot, and whether a run that is shorter than the longest one ends by itself."""
        none = (np.nan, np.nan, np.nan)
        self._goals = np.array([none if s.goal is None else s.goal for s in scenarios])
        self.any = bool(np.isfinite(self._goals).any())
        ticks = np.array([s.ticks for s in scenarios])
        self._ticks = np.where(timed & (ticks < ticks.max()), ticks, np.inf)  # of runs that end before the group does
        self._patience = round(STUCK / scenarios[0].control_period)
        self._place = np.full((len(scenarios), 2), np.inf)  # m, where each robot last made headway
        self._start = np.zeros(len(scenarios), int)
        self._since = np.zeros(len(scenarios), int)

    def restart(self, row: int, tick: int) -> None:
        """Begins the run of one robot again at a control tick."""
        self._place[row], self._start[row] = np.inf, tick

    def ended(self, tick: int, now: Rows) -> dict[int, str]:
        """Returns the robots whose runs end, each with the reason of its failure: `stuck`, or "" where it did not fail.

        Args:
            tick: The control tick.
            now: Record of `TICK` of each robot at this tick, `(B,)`; NaN for a robot whose run has ended.
        """
        x, y = now["x"], now["y"]
        farther = np.hypot(x - self._place[:, 0], y - self._place[:, 1]) > HEADWAY
        self._place[farther, 0], self._place[farther, 1], self._since[farther] = x[farther], y[farther], tick
        there = arrived(np.stack([x, y, now["theta"]], -1), now["v"], self._goals)
        stuck = np.isfinite(x + self._goals[:, 0]) & (tick - self._since >= self._patience)
        over = there | (tick + 1 - self._start >= self._ticks)
        return {int(row): "" if over[row] else "stuck" for row in np.flatnonzero(over | stuck)}
