"""The way that a robot came, on which it goes back."""

import numpy as np

from mrctl import Box, Obstacles
from mrctl.navigation.trail import CHECKED_BEHIND, Trail
from mrctl.theory.obstacles import Surroundings

FOOTPRINT = np.array([[-0.1, -0.2], [0.4, -0.2], [0.4, 0.2], [-0.1, 0.2]])
NOTHING = Surroundings(Obstacles()).at(0.0)


def arc(radius: float, length: float) -> np.ndarray:
    """Poses on an arc from the origin, 1 cm apart, `(n, 3)`."""
    turned = np.arange(0.0, length, 0.01) / radius
    return np.column_stack([radius * np.sin(turned), radius * (1 - np.cos(turned)), turned])


def test_goes_back_as_it_came() -> None:
    """A unicycle that came along an arc goes back along it, to its beginning, and not farther."""
    way, trail = arc(1.0, 2.0), Trail(FOOTPRINT, 2.0, 1.0)
    for pose in way:
        trail.add(pose)
    pose, aside = way[-1].copy(), []
    while (twist := trail.back(pose, 0.3, NOTHING)) is not None:
        v, omega = twist
        assert v == -0.3
        pose += 0.05 * np.array([v * np.cos(pose[2]), v * np.sin(pose[2]), omega])
        aside.append(abs(np.hypot(pose[0], pose[1] - 1.0) - 1.0))
    assert max(aside) < 0.01 and np.hypot(*pose[:2]) < 0.21 and len(aside) * 0.015 > 1.7


def test_stops_before_what_is_behind() -> None:
    """It goes back so slowly that it can brake before a wall that stands on its way back, however weak its brakes."""
    wall = Surroundings(Obstacles(shapes=(Box(x=0.5, length=0.1, width=2.0),))).at(0.0)
    for acceleration in (0.05, 0.2, 2.0):
        trail = Trail(FOOTPRINT, 2.0, acceleration)
        for x in np.arange(0.0, 2.0, 0.01):
            trail.add(np.array([x, 0.0, 0.0]))
        x, speed = 2.0, 0.0
        while (twist := trail.back(np.array([x, 0.0, 0.0]), 0.4, wall)) is not None:
            speed = -twist[0]
            x -= 0.05 * speed  # in a motion period
        left = x - 0.1 - 0.55 - 0.1 * speed  # of its tail to the wall, where it begins to brake, after 0.1 s of lag
        assert 0 < speed <= 0.4 and speed**2 / (2 * acceleration) <= left <= CHECKED_BEHIND
