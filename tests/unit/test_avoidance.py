"""The barrier filter: the nearest twist by an independent solver, no collision, idle where clear, and its braking."""

import numpy as np
import pytest
from scipy.optimize import nnls
from test_obstacles import random_shapes

from mrctl import Box, Obstacles, Scenario, Sensing
from mrctl.control.kanayama import kanayama, posture_error
from mrctl.loop.hierarchy import Hierarchy
from mrctl.navigation.avoidance import Barrier, Following, avoid, nearest
from mrctl.physics import mjcf
from mrctl.theory.clearance import clearance, cover
from mrctl.theory.obstacles import Surroundings

FOOTPRINT = np.array([[-0.1, -0.2], [0.44, -0.2], [0.44, 0.2], [-0.1, 0.2]])
BARRIER = Barrier(cover(FOOTPRINT, 4), margin=0.01, deceleration=1.0, period=0.02, lever=0.3)


def least_distance(request, rows):
    """The nearest point of the half-planes by the method of Lawson and Hanson (Solving Least Squares Problems, 1974,
    chapter 23): with z = p − request, the least |z| with G z ≥ h follows from one non-negative least squares problem.
    """  # noqa: D205
    matrix = np.vstack([rows[:, :2].T, rows[:, 2] - rows[:, :2] @ request])
    solution, _ = nnls(matrix, np.array([0.0, 0.0, 1.0]))
    rest = matrix @ solution - [0, 0, 1]
    return request - rest[:2] / rest[2]


def test_nearest() -> None:
    """In random half-planes around the origin, of which up to two have it on their border."""
    random = np.random.default_rng(0)
    changed = 0
    for _ in range(2000):
        rows = random.normal(size=(random.integers(1, 12), 3))
        rows[:, 2] = -np.abs(rows[:, 2]) * (random.permutation(len(rows)) >= random.integers(3))
        request = 2 * random.normal(size=2)
        found = nearest(request[0], request[1], rows)
        np.testing.assert_allclose(found, least_distance(request, rows), atol=1e-6)
        changed += found != tuple(request)
    assert 500 < changed < 1999
    only_rest = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]], float)
    np.testing.assert_allclose(nearest(1.0, 2.0, only_rest), 0.0, atol=1e-12)


def test_no_collision() -> None:
    """Among random obstacles, still ones, with requests that change at random and are obeyed at once."""
    random, nearer = np.random.default_rng(1), 0
    for _ in range(30):
        outlines = Surroundings(random_shapes(random, 12)).at(0.0)
        pose = random.uniform([-3, -3, -3], [3, 3, 3])
        if min(clearance(_square(disc), pose, outlines) for disc in BARRIER.discs) <= BARRIER.margin:
            continue
        request = np.zeros(2)
        for step in range(300):
            if step % 50 == 0:
                request = random.uniform([-1.5, -3], [1.5, 3])
            v, omega = avoid(request, pose, outlines, BARRIER)
            nearer += (v, omega) != tuple(request)
            turn = omega * BARRIER.period
            way = v * BARRIER.period * np.sinc(turn / 2 / np.pi)  # chord of the arc
            pose = pose + [way * np.cos(pose[2] + turn / 2), way * np.sin(pose[2] + turn / 2), turn]
            assert clearance(FOOTPRINT, pose, outlines) > 0
    assert nearer > 500


def _square(disc):
    """The square around a disc."""
    return disc[:2] + disc[2] * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])


@pytest.mark.parametrize("heading", [0.0, 0.7, -2.0])
def test_brakes_before_a_wall(heading: float) -> None:
    """Straight at a wall the speed falls by at most the deceleration, from the braking distance on, and ends at 0."""
    ahead = np.array([np.cos(heading), np.sin(heading)])
    x, y = 3 * ahead
    wall = Surroundings(Obstacles(shapes=(Box(x=x, y=y, angle=heading, length=0.2, width=4.0),))).at(0.0)
    way, speeds, gaps = 0.0, [], []
    front = BARRIER.discs[:, 0].max() + BARRIER.discs[0, 2]
    for _ in range(400):
        v, omega = avoid(np.array([1.5, 0.0]), np.array([*(way * ahead), heading]), wall, BARRIER)
        speeds.append(v)
        gaps.append(2.9 - way - front - BARRIER.margin)
        way += v * BARRIER.period
    speeds, gaps = np.array(speeds), np.array(gaps)
    braking = 1.5 * BARRIER.period + 1.5**2 / 2 / BARRIER.deceleration
    assert np.all(speeds[gaps > braking] == 1.5) and np.all(speeds[gaps < braking - 1e-9] < 1.5)
    assert np.diff(speeds).min() >= -BARRIER.deceleration * BARRIER.period * (1 + 1e-6)
    assert -1e-9 < gaps[-1] < 0.01 and speeds[-1] < 0.02


def test_idle_when_clear() -> None:
    """A request from which the robot could stop is not changed by a bit, nor is any in an empty world."""
    random = np.random.default_rng(2)
    far = Surroundings(Obstacles(shapes=(Box(x=6.0), Box(y=-6.0)))).at(0.0)
    for outlines in (far, Surroundings(Obstacles()).at(0.0)):
        for request in random.uniform([-1.5, -3], [1.5, 3], (200, 2)):
            pose = random.uniform([-1, -1, -3], [1, 1, 3])
            assert avoid(request, pose, outlines, BARRIER).tolist() == request.tolist()


@pytest.mark.parametrize("prefilter", [None, 0.3])
def test_following_has_the_gains_of_the_hierarchy(prefilter: float | None) -> None:
    """Beside the filter the robot follows with the gains that it has without, also where the prefilter is given."""
    scenario = Scenario(sensing=Sensing(tier="field"), prefilter=prefilter)
    robot = mjcf.build(scenario.world, scenario.steering)[1]
    pose, reference = np.array([[0.1, 0.2, 0.3]]), np.array([[0.0, 0.0, 0.0, 0.5, 0.2, 0.0, 0.0]])
    error, request = np.empty(3), np.empty(2)
    posture_error.compiled(pose[0], reference[0, :3], error)
    gains = Hierarchy([scenario], robot).state["kanayama"][0]
    kanayama.compiled(error, reference[0, 3:5], gains, request)
    assert np.array_equal(Following(robot, 1, scenario).output(pose, np.zeros((1, 2)), reference)[0], request)
