"""What a robot knows of its surroundings: finds beside the map, their velocities, and what is forgotten."""

import numpy as np
import pytest
import shapely

from mrctl import Box, Disc, Line, Obstacles, Scenario
from mrctl.navigation.chart import PLACE_RADIUS, through
from mrctl.navigation.sight import DISC_SPACING, Sight
from mrctl.sensing.lidar import Lidar
from mrctl.theory.obstacles import Surroundings
from mrctl.theory.rays import Scan

LIDAR = Lidar()
WALLS = tuple(Box(x=x, y=y, length=0.2 + 6 * (x == 0), width=0.2 + 6 * (y == 0)) for x, y in ((3, 0), (-3, 0), (0, 3)))
PILLAR = Disc(x=-1.5, y=1.5, radius=0.2)


def scanned(sight: Sight, world: Obstacles, pose: np.ndarray, time: float, seed: int = 0, error: float = 0.0) -> None:
    """Hands a scan from a pose to one robot, which believes to be `error` metres ahead of where it is along x."""
    ranges = LIDAR.scan(pose, Surroundings(world).at(time), np.random.default_rng([seed, round(10 * time)]))
    sight.see(Scan(ranges, LIDAR.angles, LIDAR.range, LIDAR.place(pose + [error, 0.0, 0.0]), time))


def discs(sight: Sight, time: float) -> np.ndarray:
    return sight.discs(time)


def test_a_map_that_is_right_hides_nothing_and_shows_nothing() -> None:
    """From 40 poses, with the noise of the lidar and 2 cm of error in the estimate, nothing is found beside the map."""
    known, random = Obstacles(shapes=(*WALLS, PILLAR)), np.random.default_rng(1)
    sight = Sight(known)
    for k in range(40):
        pose = np.append(random.uniform(-2.2, 2.2, 2), random.uniform(-3, 3))
        scanned(sight, known, pose, 0.1 * k, error=0.02)
        assert not len(discs(sight, 0.1 * k))


@pytest.mark.parametrize(
    ("shape", "outline"),
    [
        (Disc(x=1.2, y=0.4, radius=0.25), shapely.Point(1.2, 0.4).buffer(0.25, 64)),
        (Box(x=1.2, y=-0.5, angle=0.4, length=0.3, width=1.2), None),
    ],
)
def test_what_the_map_lacks_is_found(shape: Disc | Box, outline: shapely.Polygon | None) -> None:
    """Discs lie along the side of it that beams meet, without gaps, and nowhere else."""
    outline = outline or shapely.Polygon(shape.vertices)
    sight = Sight(Obstacles(shapes=WALLS))
    scanned(sight, Obstacles(shapes=(*WALLS, shape)), np.array([0.0, 0.0, 0.3]), 0.0)
    found = discs(sight, 0.0)
    edge = [shapely.Point(x, y).distance(outline.exterior) for x, y in found[:, :2]]
    assert len(found) >= 4 and max(edge) < 3 * LIDAR.noise and np.all(found[:, 2:4] == 0)
    exact = Lidar(noise=0.0)
    ranges = exact.scan(np.zeros(3), Surroundings(Obstacles(shapes=(shape,))).at(0.0), np.random.default_rng(0))
    met = exact.points(ranges)
    gaps = np.hypot(*(met[:, None] - found[None, :, :2]).transpose(2, 0, 1)).min(axis=1)
    assert gaps.max() < DISC_SPACING + 3 * LIDAR.noise
    assert len(sight.outlines(0.0).discs) == len(found) and not len(sight.moving(0.0).discs)


@pytest.mark.parametrize(("speed", "rate"), [(0.3, 10), (0.5, 10), (0.8, 10), (0.5, 5), (0.5, 50), (0.8, 200)])
def test_velocity(speed: float, rate: int) -> None:
    """A disc that crosses 2 m ahead has its velocity after a second, to 0.12 m/s, or 0.25 with a fast lidar.

    Between scans it is where it would be with that.
    """
    course = Line(heading=np.pi / 2, speed=speed, length=20.0)
    world = Obstacles(shapes=(*WALLS[:1], Disc(x=-1.5, y=-2.0, radius=0.15, course=course)))
    sight, errors = Sight(Obstacles(shapes=WALLS[:1])), []
    for k in range(int(2.5 / speed * rate)):
        scanned(sight, world, np.zeros(3), k / rate, seed=k)
        if k >= rate:
            later = (k + 0.5) / rate
            place, now = Surroundings(world).at(later).discs[0], discs(sight, later)
            errors.append(np.abs(now[:, 2:4] - [0.0, speed]).max())
            assert np.hypot(*(now[:, :2] - place[:2]).T).max() < 0.15 + 4 * LIDAR.noise
    assert max(errors) < (0.12 if rate <= 10 else 0.25)


def test_velocity_at_the_end_of_the_view() -> None:
    """What leaves the view of a lidar keeps its velocity while a part of it is still seen, whose centre is slower."""
    narrow, course = Lidar(view=np.pi / 2, beams=180), Line(heading=np.pi / 2, speed=0.6, length=20.0)
    wall = Box(x=4.5, length=0.1, width=12.0)
    around = Surroundings(Obstacles(shapes=(wall, Disc(x=-1.0, y=-3.0, radius=0.4, course=course))))
    sight, random, left = Sight(Obstacles(shapes=(wall,))), np.random.default_rng(0), 0
    for k in range(70):
        pose = np.zeros(3)
        sight.see(Scan(narrow.scan(pose, around.at(k / 10), random), narrow.angles, narrow.range, pose, k / 10))
        if k >= 20:
            place, found = around.at(k / 10).discs[0], discs(sight, k / 10)
            assert np.abs(found[:, 2:4] - [0.0, 0.6]).max() < 0.12
            left += place[1] - 0.4 < place[0] < place[1] + 0.4
    assert left > 8


def test_what_stands_stands() -> None:
    """A robot that drives past a pillar and along a wall at 1 m/s takes neither for something that moves."""
    world = Obstacles(shapes=(PILLAR, Box(x=0.0, y=-1.0, length=4.0, width=0.1)))
    sight = Sight(Obstacles())
    for k in range(30):
        scanned(sight, world, np.array([-3.0 + 0.1 * k, 1.0, 0.0]), 0.1 * k)
        assert np.all(discs(sight, 0.1 * k)[:, 2:4] == 0)


def test_memory() -> None:
    """What something hides is remembered, what has gone is forgotten when it is seen to have gone."""
    pillar, screen = Disc(x=2.0, radius=0.15), Box(x=1.0, length=0.1, width=2.0)
    sight, pose = Sight(Obstacles()), np.zeros(3)

    def near(place: float) -> bool:
        return bool((np.abs(discs(sight, 0.0)[:, 0] - place) < 0.3).any())

    scanned(sight, Obstacles(shapes=(pillar,)), pose, 0.0)
    assert near(2.0)
    scanned(sight, Obstacles(shapes=(pillar, screen)), pose, 0.1)
    assert near(2.0) and near(1.0)
    scanned(sight, Obstacles(shapes=(screen,)), pose, 0.2)
    assert near(2.0)
    scanned(sight, Obstacles(), pose, 0.3)
    assert not near(2.0) and not near(1.0)


def test_end_of_range() -> None:
    """What is out of range is remembered, and what comes into range is not taken for something that moves."""
    short, sight = Lidar(range=3.0), Sight(Obstacles())
    for world, places in (
        (Disc(x=2.0, radius=0.2), [0.0, -3.0]),
        (Box(x=5.0, angle=0.6, length=1.0, width=1.0), 0.1 * np.arange(40.0)),
    ):
        sight.forget()
        around, random = Surroundings(Obstacles(shapes=(world,))).at(0.0), np.random.default_rng(0)
        for k, x in enumerate(places):
            pose = np.array([x, 0.0, 0.0])
            sight.see(Scan(short.scan(pose, around, random), short.angles, short.range, pose, 0.1 * k))
            assert np.all(discs(sight, 0.1 * k)[:, 2:4] == 0)
        assert len(discs(sight, 0.1 * len(places))) >= 4


def test_end_of_range_moves() -> None:
    """A robot that goes back along a wall remembers all of it, though the place where its range ends moves along."""
    short, sight, wall = Lidar(range=1.5), Sight(Obstacles()), Obstacles(shapes=(Box(y=0.5, length=10.0, width=0.1),))
    for k, x in enumerate(np.arange(3.0, -1.5, -0.03)):
        pose = np.array([x, 0.0, 0.0])
        ranges = short.scan(pose, Surroundings(wall).at(0.0), np.random.default_rng(k))
        sight.see(Scan(ranges, short.angles, short.range, pose, 0.1 * k))
    along = np.sort(discs(sight, 0.0)[:, 0])
    assert along[0] < -2.0 and along[-1] > 4.0 and np.diff(along).max() < 3 * DISC_SPACING
    assert len(along) < 2 * np.ptp(along) / DISC_SPACING


def test_end_of_range_stays() -> None:
    """A robot that stands before a wall that reaches beyond its range does not remember more and more of it."""
    short, sight, wall = Lidar(range=1.5), Sight(Obstacles()), Obstacles(shapes=(Box(y=0.5, length=10.0, width=0.1),))
    for k in range(500):
        ranges = short.scan(np.zeros(3), Surroundings(wall).at(0.0), np.random.default_rng(k))
        sight.see(Scan(ranges, short.angles, short.range, np.zeros(3), 0.1 * k))
    found = discs(sight, 0.0)
    assert len(found) < 2 * np.ptp(found[:, 0]) / DISC_SPACING


def test_shadow_moves() -> None:
    """A robot that drives past a post remembers all of the wall behind it, though the post's shadow moves along."""
    wall, post = Box(y=3.0, length=4.0, width=0.1), Disc(y=1.0, radius=0.1)
    sight = Sight(Obstacles())
    for k, x in enumerate(np.arange(-1.5, 1.5, 0.03)):
        scanned(sight, Obstacles(shapes=(wall, post)), np.array([x, 0.0, 0.0]), 0.1 * k)
        found = discs(sight, 0.1 * k)
        along = np.sort(found[found[:, 1] > 2.0, 0])
        assert k == 0 or (along[0] < -1.6 and along[-1] > 1.6 and np.diff(along).max() < 3 * DISC_SPACING)
    assert len(along) < 2 * np.ptp(along) / DISC_SPACING


def test_seen_through() -> None:
    """A place is seen through if every beam that would meet the disc around it goes on beyond, by geometry."""
    random = np.random.default_rng(2)
    wall = Obstacles(shapes=(Box(x=2.0, y=0.5, length=0.1, width=1.0),))
    exact, verdicts = Lidar(noise=0.0), []
    ranges = exact.scan(np.zeros(3), Surroundings(wall).at(0.0), random)
    points = np.column_stack([random.uniform(0.3, 5.0, 400), random.uniform(-2.0, 3.0, 400)])
    seen = through(points, Scan(ranges, exact.angles, 4.0, np.zeros(3), 0.0))
    shape = shapely.box(1.95, 0.0, 2.05, 1.0)
    for point, clear in zip(points, seen, strict=True):
        away = np.hypot(*point)
        behind = point * (1 + (0.1 + 0.02 * away) / away)
        swept = shapely.LineString([(0, 0), behind]).buffer(PLACE_RADIUS, cap_style="flat")
        narrow = shapely.LineString([(0, 0), behind]).buffer(0.2 * PLACE_RADIUS, cap_style="flat")
        if np.hypot(*behind) > 4.0:  # beyond the largest range
            assert not clear
        elif not swept.buffer(0.05).intersects(shape):
            assert clear
        if narrow.intersects(shape):
            assert not clear
        verdicts.append(clear)
    assert 0.2 < np.mean(verdicts) < 0.95


def test_robots_do_not_mix() -> None:
    """A scan of one robot changes nothing for another with the same map; one that begins again knows its map alone."""
    sight, other = Sight.each([Scenario(obstacles=Obstacles(shapes=WALLS))] * 2)
    scanned(sight, Obstacles(shapes=(*WALLS, PILLAR)), np.zeros(3), 0.0)
    assert len(sight.discs(0.0)) and not len(other.discs(0.0))
    sight.forget()
    assert not len(sight.discs(0.0))
