"""The camera of an overview: everything is in the picture, and fills it."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mrctl import Scenario
from mrctl.navigation.planning import prepared
from mrctl.navigation.tasks import task_of
from mrctl.physics import mjcf
from mrctl.physics.obstacles import WALL_HEIGHT
from mrctl.viewer.cameras import FILLED_SHARE, OVERVIEW, TOP, fitted
from mrctl.viewer.video import _overview

FOV = np.radians(75)


def picture(points, position, target, aspect, fov=FOV):
    """Places of points in a picture, from −1 at one edge to 1 at the other, x to the right and y up, `(n, 2)`."""
    ahead = (target - position) / np.linalg.norm(target - position)
    right = np.cross(ahead, [0, 0, 1]) / np.hypot(*ahead[:2])
    up = np.cross(right, ahead)
    away = points - position
    assert (away @ ahead > 0).all()
    return np.column_stack([away @ right / aspect, away @ up]) / (away @ ahead)[:, None] / np.tan(fov / 2)


@given(st.integers(0, 10**6), st.floats(0.05, 20.0), st.sampled_from([OVERVIEW, TOP]), st.booleans())
def test_full_picture(seed, aspect, side, flat):
    """No point is outside of the margins, the points reach two opposite ones, and are in the middle."""
    random = np.random.default_rng(seed)
    box = np.array(list(itertools.product(*[(-1, 1)] * 3))) * random.uniform(0.1, 20, 3)
    points = np.concatenate([box, random.uniform(-1, 1, (30, 3)) * box[-1]]) + 50 * random.normal(size=3)
    points[:, 2] *= not flat
    position, target = fitted(points, side, FOV, aspect)
    seen = picture(points, position, target, aspect)
    assert np.abs(seen).max() == pytest.approx(FILLED_SHARE, abs=1e-6)
    assert seen.min(axis=0) == pytest.approx(-seen.max(axis=0), abs=1e-6)
    assert target[2] == pytest.approx(points[:, 2].min())
    assert np.cross(target - position, side) == pytest.approx([0, 0, 0], abs=1e-6 * np.linalg.norm(target - position))


def test_video_of_a_mission():
    """A video of a mission shows the slalom, up to the tops of its posts, and where the robot went beside its plan."""
    scenario = prepared(task_of("slalom:3", Scenario()), Scenario())[1]
    model = mjcf.load(scenario.world, obstacles=scenario.obstacles)
    course = scenario.reference.sample(np.linspace(0, scenario.reference.period, 50)).pose * [1, 1, 0]
    beside = np.array([[2.0, 3.0, 0.0]])
    camera = _overview(model, scenario, np.concatenate([course, beside]), 16 / 9)
    turn, rise = np.radians([camera.azimuth, camera.elevation])
    ahead = np.array([np.cos(rise) * np.cos(turn), np.cos(rise) * np.sin(turn), np.sin(rise)])
    around = np.linspace(0, 2 * np.pi, 40)
    posts = [
        [d.x + d.radius * np.cos(a), d.y + d.radius * np.sin(a), z]
        for d, a, z in itertools.product(scenario.obstacles.shapes, around, (0.0, WALL_HEIGHT))
    ]
    fov = np.radians(model.vis.global_.fovy)
    position = camera.lookat - camera.distance * ahead
    seen = np.abs(picture(np.vstack([course, posts, beside]), position, camera.lookat, 16 / 9, fov)).max(axis=0)
    assert 0.75 < seen.max() <= FILLED_SHARE + 1e-6  # the robot at the ends takes the rest
