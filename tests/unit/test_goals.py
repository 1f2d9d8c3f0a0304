"""The compiled end of a mission is that of the formulas in NumPy, to the bit, whatever the robots do."""

import numpy as np
import pytest

from mrctl import Event, Line, Scenario, simulate
from mrctl.loop.goals import ARRIVAL_ANGLE, ARRIVAL_DISTANCE, ARRIVAL_SPEED, STUCK_DISTANCE, STUCK_TIME, Goals, arrived
from mrctl.results.dataset import TICK

GOAL = (0.3, -0.2, 3.1)
TASK = Scenario(reference=Line(length=0.8), goal=GOAL)
SIZE = 40


def judged(tick, now, goals, memory, ticks, patience):
    """The formulas on arrays; `memory` is where and when each robot last made headway."""
    x, y, (place, since) = now["x"], now["y"], memory
    farther = np.hypot(x - place[:, 0], y - place[:, 1]) > STUCK_DISTANCE
    place[farther, 0], place[farther, 1], since[farther] = x[farther], y[farther], tick
    over = arrived(np.stack([x, y, now["theta"]], -1), now["v"], goals) | (tick + 1 >= ticks)
    stuck = np.isfinite(x + goals[:, 0]) & (tick - since >= patience)
    return {int(row): "" if over[row] else "stuck" for row in np.flatnonzero(over | stuck)}


@pytest.mark.parametrize("timed", [True, False])
def test_ends(timed):
    """Robots about the edges of arrival, some at rest, some turned by laps, some without goals or at their ends."""
    random = np.random.default_rng(0)
    scenarios = [TASK.replace(laps=1 + row % 3, goal=None if row % 7 == 0 else GOAL) for row in range(SIZE)]
    goals = np.array([s.goal or (np.nan,) * 3 for s in scenarios])
    length = np.array([s.ticks for s in scenarios])
    ticks = np.where(timed & (length < length.max()), length, np.inf)
    group, patience = Goals(scenarios, timed), round(STUCK_TIME / TASK.control_period)
    memory = np.full((SIZE, 2), np.inf), np.zeros(SIZE, int)
    now, found = np.zeros(SIZE, TICK), []
    for tick in range(700):
        moves = np.arange(SIZE) % 4 != 0  # the others stand still, away from their goals
        away = ARRIVAL_DISTANCE * random.uniform(0.99, 1.01, SIZE) * random.choice([1, 30], SIZE, p=[0.5, 0.5])
        angle = random.uniform(-4, 4, SIZE)
        now["x"] = np.where(moves, GOAL[0] + away * np.cos(angle), 2.0)
        now["y"] = np.where(moves, GOAL[1] + away * np.sin(angle), 2.0)
        turn = ARRIVAL_ANGLE * random.choice([-1, 1], SIZE) * random.choice([0.5, 1, 1 + 1e-15, 1 - 1e-15, 1.5], SIZE)
        now["theta"] = GOAL[2] + turn + 2 * np.pi * random.integers(-3, 4, SIZE)
        now["v"] = ARRIVAL_SPEED * random.choice([-0.9, 0, 0.9, 1, 1.1], SIZE)
        for name in ("x", "y", "theta", "v"):
            now[name][tick % 5 == np.arange(SIZE) % 11] = np.nan
        there = arrived(np.stack([now["x"], now["y"], now["theta"]], -1), now["v"], goals)
        assert group.ended(tick, now) == judged(tick, now, goals, memory, ticks, patience)
        assert np.array_equal(group.there, there)
        found += there.tolist()
    assert 500 < sum(found) < 20_000
    if timed:
        group.restart(1, 700)
        assert 1 not in group.ended(700, now) or group.there[1]


@pytest.mark.parametrize("learner", ["observer", "fel", "rls", "mrac", "l1", "composite"])
def test_what_was_learned_when_a_run_failed(learner):
    """A robot that fails before its batch keeps the weights of its own end too."""
    long = Scenario(laps=1, reference=Line(length=2.4), prior="model", learner=learner)
    short = long.replace(events=(Event(time=0.5, push=(0.0, 900.0, 0.0)),))
    both, alone = simulate([short, long]), simulate(short)
    assert alone.failed and np.array_equal(both.weights[0], alone.weights)
    assert not np.array_equal(both.weights[1], alone.weights)


def test_what_was_learned_when_a_run_ended():
    """A run that ends before its batch keeps weights and coefficients of its own end, as when it runs alone."""
    short = TASK.replace(goal=(0.8, 0.0, 0.0), learner="rls", laps=1)
    long = short.replace(reference=Line(length=2.4), goal=(2.4, 0.0, 0.0))
    both, alone = simulate([short, long]), simulate(short)
    assert np.array_equal(both.weights[0], alone.weights) and not np.array_equal(both.weights[1], alone.weights)
    for name in ("parameters", "true_parameters"):
        assert np.isfinite(alone[name]).all() and np.array_equal(both[name][0], alone[name])
