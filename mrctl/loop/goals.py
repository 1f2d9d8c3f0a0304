"""The ends of missions: a run with a goal ends when the robot stands at the goal, or when it is stuck."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mrctl.kernel import Array, Rows, kernel
from mrctl.scenario import Scenario

ARRIVAL_DISTANCE, ARRIVAL_ANGLE, ARRIVAL_SPEED = 0.1, 0.2, 0.05  # m, rad and m/s, within which a robot has arrived
STUCK_DISTANCE, STUCK_TIME = 0.05, 5.0  # m and s: a robot that moves no farther than that within this time is stuck

ENDING = np.dtype(
    [
        ("goal", "f8", 3),  # x and y in m, θ in rad; NaN for none
        ("ticks", "f8"),  # number of control ticks after which the run ends by itself; infinite where it does not
        ("start", "i8"),  # tick at which the run began
        ("place", "f8", 2),  # where the robot last made headway, x and y in m
        ("since", "i8"),  # tick at which it did so
        ("there", "?"),  # whether it stands at its goal, see `arrived`
        ("over", "?"),  # whether the run ends without failure: it stands at its goal, or all its ticks are done
        ("stuck", "?"),  # whether it has a goal, and has made no headway for too long
    ],
    align=True,
)


@kernel
def stands_at(x: float, y: float, turn: float, v: float) -> bool:
    """Tells whether a robot that is x and y in m and a turn in rad from its goal, with V in m/s, has arrived there."""
    return (
        np.hypot(x, y) < ARRIVAL_DISTANCE
        and abs(np.arctan2(np.sin(turn), np.cos(turn))) < ARRIVAL_ANGLE
        and abs(v) < ARRIVAL_SPEED
    )


@kernel
def end(tick: int, patience: int, now: Rows, endings: Rows) -> bool:
    """Judges which runs end at a control tick; returns whether any does.

    Args:
        tick: The control tick.
        patience: Number of control ticks without headway after which a robot is stuck.
        now: Record of `TICK` of each robot at this tick; NaN for a robot whose run has ended.
        endings: In and out: record of `ENDING` of each robot.
    """
    found = False
    for i in range(len(endings)):
        t, s = now[i], endings[i]
        if np.hypot(t.x - s.place[0], t.y - s.place[1]) > STUCK_DISTANCE:
            s.place[0], s.place[1], s.since = t.x, t.y, tick
        s.there = stands_at(t.x - s.goal[0], t.y - s.goal[1], t.theta - s.goal[2], t.v)
        s.over = s.there or tick + 1 - s.start >= s.ticks
        s.stuck = np.isfinite(t.x + s.goal[0]) and tick - s.since >= patience
        found |= s.over or s.stuck
    return found


def arrived(pose: Array, v: ArrayLike, goal: Array) -> NDArray[np.bool]:
    """Tells which robots stand at their goals, within `ARRIVAL_DISTANCE`, `ARRIVAL_ANGLE` and `ARRIVAL_SPEED`.

    Args:
        pose: x and y in m and θ in rad, `(…, 3)`.
        v: Linear velocities in m/s, `(…)`.
        goal: Goals in m, m, rad, `(…, 3)`; NaN for none.
    """
    away = np.asarray(pose - goal, float)
    found = np.empty(away.shape[:-1], bool)
    speeds = np.array(np.broadcast_to(v, found.shape), float)
    judge.compiled(away.reshape(-1, 3), speeds.reshape(-1), found.reshape(-1))
    return found


@kernel
def judge(away: Array, speeds: Array, found: NDArray[np.bool]) -> None:
    """Writes what `arrived` returns into `found`, `(n,)`, for pose less goal, `(n, 3)`, and speeds in m/s, `(n,)`."""
    for i in range(len(away)):
        found[i] = stands_at(away[i, 0], away[i, 1], away[i, 2], speeds[i])


class Goals:
    """The goals of a group of runs.

    Attributes:
        any: Whether a robot has a goal.
        there: Which robots stood at their goals when `ended` was last called, `(B,)`.
    """

    def __init__(self, scenarios: Sequence[Scenario], timed: bool = True) -> None:
        """Takes the scenario of each robot, and whether a run that is shorter than the longest one ends by itself."""
        none = (np.nan, np.nan, np.nan)
        self._endings = endings = np.zeros(len(scenarios), ENDING)
        endings["goal"] = [none if s.goal is None else s.goal for s in scenarios]
        ticks = np.array([s.ticks for s in scenarios])
        endings["ticks"] = np.where(timed & (ticks < ticks.max()), ticks, np.inf)  # of runs that end before the group
        endings["place"] = np.inf
        self.any, self.there = bool(np.isfinite(endings["goal"]).any()), endings["there"]
        self._patience = round(STUCK_TIME / scenarios[0].control_period)
        self._end = end.repeated()

    def restart(self, row: int, tick: int) -> None:
        """Begins the run of one robot again at a control tick."""
        self._endings["place"][row], self._endings["start"][row] = np.inf, tick

    def ended(self, tick: int, now: Rows) -> dict[int, str]:
        """Returns the robots whose runs end, each with the reason of its failure: `stuck`, or "" where it did not fail.

        A robot whose own ticks are done is among them in each tick from then on.

        Args:
            tick: The control tick.
            now: Record of `TICK` of each robot at this tick, `(B,)`; NaN for a robot whose run has ended.
        """
        endings = self._endings
        if not self._end(tick, self._patience, now, endings):
            return {}
        over = endings["over"]
        return {int(row): "" if over[row] else "stuck" for row in np.flatnonzero(over | endings["stuck"])}
