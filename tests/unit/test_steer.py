"""Dubins' and Reeds and Shepp's paths: they end at the goal, and are as short as those of OMPL."""

import numpy as np
import pytest

from mrctl.navigation.steer import advance, sample, steer

RADIUS = 0.7


def pairs(count, seed=0):
    random = np.random.default_rng(seed)
    return random.uniform([-3, -3, -3.1], [3, 3, 3.1], (count, 2, 3))


def goes_there(start, goal, reverse):
    """The path ends at the goal, in steps and arcs as stated; returns its length."""
    curve = steer(start, goal, RADIUS, reverse)
    poses, ways = sample(start, curve, RADIUS, 0.1)
    error = poses[-1] - goal
    assert np.abs([*error[:2], (error[2] + np.pi) % (2 * np.pi) - np.pi]).max() < 1e-8
    assert reverse or ways.min() >= 0
    steps = np.diff(poses, axis=0)
    assert np.hypot(*steps.T[:2]).max() < 0.1 + 1e-9
    assert np.abs(steps[:, 2]).max() < 0.1 / RADIUS + 1e-9
    return curve.length


def test_ends():
    """So for poses at random; a path with reversing is never longer."""
    for start, goal in pairs(500):
        assert goes_there(start, goal, True) <= goes_there(start, goal, False) + 1e-9


def test_known():
    """Straight on, back, a turn, and a car that turns round where it stands."""
    ahead, back, origin = np.array([2.0, 0, 0]), np.array([-2.0, 0, 0]), np.zeros(3)
    assert steer(origin, ahead, RADIUS, False).length == pytest.approx(2)
    assert steer(origin, back, RADIUS, True).length == pytest.approx(2)
    quarter = np.array([RADIUS, RADIUS, np.pi / 2])
    assert steer(origin, quarter, RADIUS, False).length == pytest.approx(RADIUS * np.pi / 2)
    assert steer(origin, origin, RADIUS, True).length == steer(origin, origin, RADIUS, False).length == 0
    about = steer(origin, np.array([0, 0, np.pi]), RADIUS, True)
    assert about.length == pytest.approx(RADIUS * np.pi)  # three arcs of 60°


@pytest.mark.parametrize("reverse", [False, True])
def test_few_pieces(reverse):
    """A path to where one to three pieces lead is at most as long as these, although rounding shifts its goal."""
    random = np.random.default_rng(3)
    for start in random.uniform([-3, -3, -3.1], [3, 3, 3.1], (2000, 3)):
        goal, driven = start.copy(), 0.0
        for way in random.uniform(-1.5 if reverse else 0.0, 1.5, random.integers(1, 4)):
            advance.compiled(goal, float(random.integers(-1, 2)), RADIUS, way, goal)
            driven += abs(way)
        assert goes_there(start, goal, reverse) < driven + 1e-9


def judged(count):
    """Largest difference from OMPL's lengths."""
    base = pytest.importorskip("ompl.base")
    worst = 0.0
    for reverse, kind in ((False, base.DubinsStateSpace), (True, base.ReedsSheppStateSpace)):
        space = kind(RADIUS)
        states = space.allocState(), space.allocState()
        for poses in pairs(count, 1):
            for state, (x, y, theta) in zip(states, poses, strict=True):
                state.setX(x)
                state.setY(y)
                state.setYaw(theta)
            worst = max(worst, abs(space.distance(*states) - steer(*poses, RADIUS, reverse).length))
    print(f"largest difference {worst:.1e} m")
    return worst


def test_ompl():
    """The lengths are those of OMPL to a nanometre."""
    assert judged(500) < 1e-9


@pytest.mark.full
def test_ompl_full():
    """So for 10⁴ pairs."""
    assert judged(10_000) < 1e-9
