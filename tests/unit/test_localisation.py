"""The lidar, scan matching and the particle filter, in rooms with obstacles at random places."""

import numpy as np
import pytest
from test_obstacles import random_shapes

from mrctl import Box, Disc, Obstacles, Sensing
from mrctl.sensing.lidar import Lidar
from mrctl.sensing.localisation import Localiser
from mrctl.sensing.particles import MAX_PARTICLES, MIN_PARTICLES, Particles, is_free
from mrctl.sensing.scan_matching import match
from mrctl.sensing.scanner import Scanner
from mrctl.sensing.sensors import Sensors
from mrctl.theory.clearance import clearance
from mrctl.theory.grid import at, field_of
from mrctl.theory.obstacles import Surroundings, turned

LIDAR = Lidar()
BODY = 0.2 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])


def seen(scan):
    """Points and rays of a scan, for the particle filter."""
    return LIDAR.points(scan, 60), LIDAR.rays(scan, 20)


class Room:
    """A room of 7 m with nine obstacles, its map, and free poses in it."""

    def __init__(self, seed):
        sides = ((3.5, 0), (-3.5, 0), (0, 3.5), (0, -3.5))
        walls = [Box(x=x, y=y, length=0.2 + 7 * (x == 0), width=0.2 + 7 * (y == 0)) for x, y in sides]
        self.random = np.random.default_rng(seed)
        self.outlines = Surroundings(Obstacles(shapes=(*walls, *random_shapes(self.random, 9).shapes))).at(0.0)
        self.field = field_of(self.outlines, np.full(2, -4.0), np.full(2, 4.0), 0.05)

    def free(self):
        while True:
            pose = self.random.uniform([-3, -3, -3], [3, 3, 3])
            if clearance(BODY, pose, self.outlines) > 0.1:
                return pose

    def points(self, pose, most=60):
        return LIDAR.points(LIDAR.scan(pose, self.outlines, self.random), most)

    def seen(self, pose):
        """Points and rays of a scan, for the particle filter."""
        return seen(LIDAR.scan(pose, self.outlines, self.random))

    def drive(self, steps):
        """A random drive at 0.5 m/s with 10 scans a second: poses, and odometry that is 2 % wrong."""
        pose, rate = self.free(), 0.0
        for _ in range(steps):
            for trial in range(40):
                rate = np.clip(rate + self.random.normal(0, 0.5), -1.5, 1.5) if trial < 20 else 1.5
                way, turn = 0.05 * (trial < 30), 0.1 * rate
                middle = pose[2] + turn / 2
                moved = pose + [way * np.cos(middle), way * np.sin(middle), turn]
                if clearance(BODY, moved, self.outlines) > 0.05:
                    break
            pose = moved
            yield pose, 1.02 * way, 1.02 * turn + self.random.normal(0, 0.002)


def errors(found, pose):
    """Errors of position in m and of heading in rad."""
    return np.hypot(*(found - pose)[:2]), (found[2] - pose[2] + np.pi) % (2 * np.pi) - np.pi


def test_lidar():
    """Noise and lost beams have the stated sizes, and the points lie where the beams met the wall."""
    wall = Surroundings(Obstacles(shapes=(Box(x=3, length=1, width=20),))).at(0.0)
    lidar = Lidar(beams=4000, view=1.0, noise=0.03, lost=0.2, x=0.25)
    ranges = lidar.scan(np.array([0.5, 0.3, 0.0]), wall, np.random.default_rng(0))
    met = np.isfinite(ranges)
    assert met.mean() == pytest.approx(0.8, abs=0.03)
    angles = lidar.first + lidar.step * np.arange(4000)
    assert angles[[0, -1]] == pytest.approx([-0.5, 0.5], abs=1e-3)
    error = ranges[met] - 1.75 / np.cos(angles[met])
    assert (error.mean(), error.std()) == (pytest.approx(0, abs=2e-3), pytest.approx(0.03, rel=0.05))
    exact = lidar.replace(noise=0.0)
    points = exact.points(exact.scan(np.array([0.5, 0.3, 0.0]), wall, np.random.default_rng(0)), 100)
    assert 60 < len(points) <= 100 and points[:, 0] == pytest.approx(2.0)
    assert np.isinf(Lidar(range=1.0).scan(np.zeros(3), wall, np.random.default_rng(0))).all()


def test_points_of_a_sparse_scan():
    """The points of a scan that meets little are all of them; of one that meets much they are spread over the view."""
    open_world = Surroundings(Obstacles(shapes=(Disc(x=3, radius=0.3), Disc(x=-2, y=2, radius=0.2)))).at(0.0)
    scan = Lidar().scan(np.zeros(3), open_world, np.random.default_rng(0))
    met = int(np.isfinite(scan).sum())
    assert 10 < met < 30
    np.testing.assert_array_equal(Lidar().points(scan, 60), Lidar().points(scan))
    angles = np.arctan2(*Lidar().points(np.full(360, 5.0), 60).T[::-1])
    assert np.diff(np.sort(angles)) == pytest.approx(2 * np.pi / 60)


def test_three_pillars():
    """In the open, from 0.3 m and 0.2 rad beside the truth, one scan of three pillars tells where the robot is."""
    pillars = Obstacles(shapes=tuple(Disc(x=x, y=y, radius=0.25) for x, y in ((2.0, 0.7), (3.5, -0.6), (-1.5, 1.2))))
    outlines = Surroundings(pillars).at(0.0)
    field, away = field_of(outlines, np.full(2, -5.0), np.full(2, 5.0), 0.05), []
    for seed in range(20):
        random = np.random.default_rng(seed)
        spread = np.array([0.3, 0.3, 0.2])
        filters = Particles(field, seed, spread * random.standard_normal(3), spread)
        found = filters.update(0.0, 0.0, *seen(LIDAR.scan(np.zeros(3), outlines, random)))
        away.append(errors(found, np.zeros(3)))
    position, heading = np.abs(away).T
    assert position.max() < 0.02 and np.sqrt(np.mean(position**2)) < 0.012 and np.sqrt(np.mean(heading**2)) < 0.005


def test_field():
    """The field of shapes is their distance, up to the interpolation between cells."""
    room = Room(0)
    for x, y in room.random.uniform(-3.9, 3.9, (100, 2)):
        speck = np.array([[-1e-6, -1e-6], [1e-6, -1e-6], [0, 1e-6]])
        found = at(room.field, x, y)[0]
        assert found == pytest.approx(clearance(speck, np.array([x, y, 0]), room.outlines), abs=0.02)


def test_match():
    """From 0.3 m and 0.2 rad beside the truth, with a fifth of the beams on things that the map lacks."""
    found = []
    for seed in range(40):
        room = Room(seed)
        pose = room.free()
        points = room.points(pose, 120)
        points[::5] *= room.random.uniform(0.3, 0.9, (len(points[::5]), 1))
        result, share = match(points, pose + room.random.uniform(-1, 1, 3) * [0.21, 0.21, 0.2], room.field)
        found.append((*errors(result, pose), share))
    position, heading, share = np.array(found).T
    near = position < 0.05
    print(f"{near.sum()} of 40, {1e3 * np.sqrt(np.mean(position[near] ** 2)):.1f} mm")
    assert near.sum() >= 38
    assert np.sqrt(np.mean(position[near] ** 2)) < 0.01 and np.sqrt(np.mean(heading[near] ** 2)) < 0.005
    assert share[near].min() > 0.7


def test_corridor():
    """In a corridor the scan tells the place across it, and the guess the place along it."""
    walls = Obstacles(shapes=tuple(Box(y=y, length=100, width=0.2) for y in (-1, 1)))
    field = field_of(Surroundings(walls).at(0.0), np.array([-8.0, -2.0]), np.array([8.0, 2.0]), 0.05)
    points = Lidar(range=6, noise=0).points(
        Lidar(range=6, noise=0).scan(np.array([0.0, 0.2, 0.1]), Surroundings(walls).at(0.0), np.random.default_rng(0))
    )
    found, _ = match(points, np.array([1.3, 0.0, 0.0]), field)
    assert found == pytest.approx([1.3, 0.2, 0.1], abs=0.01)


def particles(rooms):
    """Errors of the particle filter on drives in rooms, from 0.1 m beside the truth, and how often it recovers."""
    found, recovered = [], 0
    for seed in range(rooms):
        room, track = Room(seed), None
        for part in range(2):  # at the second drive the robot is somewhere else
            for k, (pose, way, turn) in enumerate(room.drive(40 if part == 0 else 80)):
                if track is None:
                    track = Particles(room.field, seed, pose + [0.1, -0.1, 0.1])
                error = errors(track.update(way, turn, *room.seen(pose)), pose)
                if part == 0 and k >= 10:
                    found.append(error)
        recovered += error[0] < 0.2
    position, heading = np.sqrt(np.mean(np.square(found), axis=0))
    print(f"{1e3 * position:.1f} mm, {np.degrees(heading):.2f}°, recovered {recovered} of {rooms}")
    return position, np.degrees(heading), recovered / rooms


def test_particles():
    """The filter errs by less than 20 mm and 0.5°, and finds the robot again after it was carried elsewhere."""
    position, heading, recovered = particles(8)
    assert position < 0.02 and heading < 0.5 and recovered >= 7 / 8


@pytest.mark.full
def test_particles_full():
    """So in 200 rooms, with at least 95 % recovered."""
    position, heading, recovered = particles(200)
    assert position < 0.02 and heading < 0.5 and recovered >= 0.95


def test_unknown_start():
    """From anywhere in the room, with many particles at first and few when the robot is found; seeds repeat."""
    room = Room(3)
    drive = [(pose, way, turn, room.seen(pose)) for pose, way, turn in room.drive(25)]
    filters = [Particles(room.field, seed, None) for seed in (0, 0, 1)]
    assert len(filters[0].particles) == MAX_PARTICLES
    for _, way, turn, scanned in drive:
        same, again, other = (f.update(way, turn, *scanned).copy() for f in filters)
        assert np.array_equal(same, again)
    assert not np.array_equal(same, other)
    assert errors(same, drive[-1][0])[0] < 0.05 and len(filters[0].particles) < 2 * MIN_PARTICLES


def test_rays():
    """A beam is free up to what it met, and not beyond: the scan is cast on the shapes, the map is a grid."""
    exact, blocked = Lidar(noise=0.0), []
    for seed in range(10):
        room = Room(seed)
        pose = room.free()
        scan = exact.scan(pose, room.outlines, room.random)
        rays = exact.rays(scan, 60)
        ranges = np.hypot(*(rays[:, 2:] - rays[:, :2]).T) + 0.2
        beyond = np.column_stack([rays[:, :2], rays[:, 2:] * ((ranges + 0.06) / (ranges - 0.2))[:, None]])
        assert ranges == pytest.approx(scan[::6][scan[::6] > 0.2])
        for kind, ends in (("free", rays), ("beyond", beyond)):
            places = [turned(ends[:, k : k + 2], pose) / room.field.resolution + 80 for k in (0, 2)]
            free = [is_free.compiled(room.field.distance, 0.05, *a, *b) for a, b in zip(*places, strict=True)]
            blocked.append((kind, 1 - np.mean(free)))
    assert np.mean([share for kind, share in blocked if kind == "free"]) < 0.02  # but for beams that graze a corner
    assert np.mean([share for kind, share in blocked if kind == "beyond"]) > 0.9


def test_turned_half_way_round():
    """In a room that looks nearly the same after half a turn, one disc tells which way the robot looks."""
    sides = ((4.25, 0, 0.5, 7), (-4.25, 0, 0.5, 7), (0, 3.25, 9, 0.5), (0, -3.25, 9, 0.5))
    walls = [Box(x=x, y=y, length=length, width=width) for x, y, length, width in sides]
    known = Obstacles(shapes=(*walls, Disc(x=-2.5, y=2.0, radius=0.3)))
    outlines, random = Surroundings(known).at(0.0), np.random.default_rng(0)
    field = field_of(outlines, np.array([-5.5, -4.5]), np.array([5.5, 4.5]), 0.05)
    found = []
    for seed in range(40):
        pose = random.uniform([-1, -1, -np.pi], [1, 1, np.pi])
        track = Particles(field, seed, None)
        for _ in range(2):
            estimate = track.update(0.0, 0.0, *seen(LIDAR.scan(pose, outlines, random)))
        found.append(errors(estimate, pose))
    position, heading = np.abs(found).T
    assert (position < 0.05).all() and (heading < 0.05).all()


def test_moving_things():
    """A passer-by whom the map lacks does not pull the estimate away."""
    room = Room(5)
    pose = room.free()
    track = Particles(room.field, 0, pose)
    for k in range(20):
        x, y = turned(np.array([[0.6, 1.0 - 0.1 * k]]), pose)[0]
        passer = Surroundings(Obstacles(shapes=(Disc(x=x, y=y, radius=0.2),))).at(0.0)
        ranges = LIDAR.scan(pose, room.outlines, room.random)
        ranges = np.minimum(ranges, LIDAR.scan(pose, passer, room.random))
        found = track.update(0.0, 0.0, *seen(ranges))
    assert errors(found, pose)[0] < 0.04


def test_search_outlasts_scans_that_show_nothing():
    """A robot that starts where its lidar sees nothing still looks for its place when the lidar sees the room."""
    sides = ((3.5, 0), (-3.5, 0), (0, 3.5), (0, -3.5))
    walls = [Box(x=x, y=y, length=0.2 + 7 * (x == 0), width=0.2 + 7 * (y == 0)) for x, y in sides]
    known = Obstacles(shapes=(*walls, Disc(x=-2.5, y=2.0, radius=0.4), Box(x=2, y=2.5, length=1.5, width=0.5)))
    sensing = [Sensing(localisation="scan", start_position_noise=0.3, start_heading_noise=1.0)]
    pose, wrong = np.array([0.5, -1.0, 0.2]), np.array([[0.2, -0.7, -1.0, 0.0, 0.0]])
    for seed in range(5):
        sensors, scanner = Sensors(sensing, [seed], 0.01), Scanner(sensing, 0.01, [known])
        localiser = Localiser(sensing, sensors, scanner, 0.1, [known])
        localiser.start(0, wrong[0, :3], np.array([0.3, 0.3, 1.0]), seed)
        for tick in range(0, 60, 10):
            sees = tick >= 30
            ranges = LIDAR.scan(pose, Surroundings(known).at(0.0), np.random.default_rng(tick))
            scanner.scans[0], scanner.taken[0] = ranges if sees else np.full(LIDAR.beams, np.inf), tick
            now = sensors.ring[tick % len(sensors.ring)]
            now["fix_arrives"] = True
            localiser.locate(tick, wrong)
            assert now["fix_arrives"][0] == sees
        assert errors(now["fix"][0], pose) == pytest.approx([0.0, 0.0], abs=0.05)
