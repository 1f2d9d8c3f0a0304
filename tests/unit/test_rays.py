"""Ray casting: against the formulas for a wall and a disc, and against MuJoCo's rays."""

import mujoco
import numpy as np
import pytest
from test_obstacles import random_shapes

from mrctl import Box, Circle, Disc, Obstacles
from mrctl.physics.obstacles import add_walls
from mrctl.theory.obstacles import Surroundings
from mrctl.theory.rays import cast

REACH = 12.0


def scan(obstacles, pose, beams=360, view=2 * np.pi, time=0.0):
    ranges = np.empty(beams)
    outlines = Surroundings(obstacles).at(time)
    cast(np.array(pose, float), -view / 2, view / beams, REACH, outlines, ranges)
    return ranges


def test_wall_and_disc():
    """The range to a wall is d/cos of the angle; that to a disc follows from the law of cosines."""
    angles = -np.pi + 2 * np.pi / 360 * np.arange(360) + 0.1
    wall = scan(Obstacles(shapes=(Box(x=2.5, length=1.0, width=8.0),)), (0.5, 0, 0.1))
    ahead = np.abs(np.tan(angles) * 1.5) < 4
    ahead &= np.cos(angles) > 0
    assert wall[ahead] == pytest.approx(1.5 / np.cos(angles[ahead]), rel=1e-12)
    assert np.all(wall[~ahead & (np.cos(angles) < 0)] == REACH)
    disc = scan(Obstacles(shapes=(Disc(x=3.0, radius=0.5),)), (0, 0, 0.1))
    inside = np.abs(np.sin(angles)) < 0.5 / 3
    inside &= np.cos(angles) > 0
    root = np.sqrt(0.25 - 9 * np.sin(angles[inside]) ** 2)
    assert disc[inside] == pytest.approx(3 * np.cos(angles[inside]) - root, rel=1e-12)
    assert np.all(disc[~inside] == REACH)


def test_around():
    """In a closed room no beam is lost, wherever the sensor looks and however few or many beams there are."""
    walls = [
        Box(x=x, y=y, length=1 + 4 * (x == 0), width=1 + 4 * (y == 0)) for x, y in ((3, 0), (-3, 0), (0, 3), (0, -3))
    ]
    corners = [Disc(x=2.5 * i, y=2.5 * k, radius=0.1) for i in (-1, 1) for k in (-1, 1)]
    random = np.random.default_rng(0)
    for beams in (1, 7, 360, 1081):
        for view in (0.5, 4.7, 2 * np.pi):
            for pose in random.uniform([-2, -2, -20], [2, 2, 20], (10, 3)):
                assert scan(Obstacles(shapes=(*walls, *corners)), pose, beams, view).max() < 7
    aligned = scan(Obstacles(shapes=tuple(walls)), (0, 0, 0), 8)  # four beams meet the walls' ends
    assert aligned == pytest.approx(2.5 * np.array([1, 2**0.5] * 4))


def test_edge_on():
    """A beam along the line of a side, where rounding tells neither its side nor its distance, meets the next side."""
    obstacles = Obstacles(shapes=(Box(x=2.0, y=-0.5, length=1.0, width=1.0),))  # one side from (2.5, 0) to (1.5, 0)
    assert scan(obstacles, (4, 0, np.pi), 2)[1] == pytest.approx(1.5)
    assert scan(obstacles, (1.5, 2, -np.pi / 2), 2)[1] == pytest.approx(2.0)


def test_moving():
    """A beam meets an obstacle where its course has taken it."""
    course = Circle(radius=1.0, period=4.0)
    obstacles = Obstacles(shapes=(Disc(radius=0.2, course=course),))
    x, y, _ = course.sample(np.array([1.0])).pose[0]  # (1, 1), a quarter of the circle
    assert (x, y) == pytest.approx((1, 1))
    assert scan(obstacles, (-2, 1, np.pi), 360, time=1.0)[0] == pytest.approx(2.8)


def judged(count, kinds=("disc", "box")):
    """Largest difference from MuJoCo's rays over a number of poses, and how many beams met something."""
    random, worst, met = np.random.default_rng(1), 0.0, 0
    for _ in range(count // 50):
        obstacles = random_shapes(random, 24)
        obstacles = Obstacles(shapes=tuple(shape for shape in obstacles.shapes if shape.kind in kinds))
        spec = mujoco.MjSpec()
        add_walls(spec, obstacles)
        model = spec.compile()
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        outlines = Surroundings(obstacles).at(0.0)
        for pose in random.uniform([-4, -4, -4], [4, 4, 4], (50, 3)):
            ranges, expected = np.empty(72), np.empty(72)
            cast(pose, -np.pi, np.pi / 36, REACH, outlines, ranges)
            angles = pose[2] - np.pi + np.pi / 36 * np.arange(72)
            beams = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(72)])
            mujoco.mj_multiRay(
                model, data, np.append(pose[:2], 0.0), beams.ravel(), None, 1, -1, np.empty(72, np.int32), expected,
                None, 72, REACH,
            )  # fmt: skip
            expected[expected < 0] = REACH
            difference = np.abs(ranges - np.minimum(expected, REACH))
            if any(shape_contains(obstacles, pose)):
                continue  # a sensor inside an obstacle sees nothing that matters
            worst, met = max(worst, difference.max()), met + np.sum(ranges < REACH)
    return worst, met


def shape_contains(obstacles, pose):
    """Tells for each obstacle whether the sensor is inside."""
    for k in range(len(obstacles.shapes)):
        single = scan(Obstacles(shapes=obstacles.shapes[k : k + 1]), pose, 16)
        yield single.max() < REACH


def test_mujoco():
    """MuJoCo's rays are as long to a micrometre."""
    worst, met = judged(400)
    assert worst < 1e-6 and met > 5000
    worst, met = judged(200, ("polygon",))  # MuJoCo keeps the corners of meshes in single precision
    assert worst < 1e-5 and met > 1000


@pytest.mark.full
def test_mujoco_full():
    """So in 10⁴ poses."""
    worst, met = judged(10_000)
    print(f"largest difference {worst:.2e} m over {met} beams that met something")
    assert worst < 1e-6
