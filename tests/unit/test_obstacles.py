"""Obstacles as data, and the geometry of footprints, cells and rectangles; the judge is shapely."""

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from mrctl import Box, Circle, Disc, InputError, Line, Obstacles, Polygon, Scenario
from mrctl.theory.clearance import clearance, clearances, cover, rim
from mrctl.theory.grid import at, distance_field, field_of, near_field, occupancy, rectangles, value
from mrctl.theory.obstacles import Surroundings, turned

FOOTPRINT = np.array([[-0.1, -0.2], [0.4, -0.2], [0.45, 0.0], [0.4, 0.2], [-0.1, 0.2]])
ROUND = 200  # sides for each quarter of shapely's discs


def random_shapes(random, count):
    """Discs, boxes and polygons in a square of 6 m."""
    found = []
    for k in range(count):
        x, y, angle = random.uniform(-3, 3), random.uniform(-3, 3), random.uniform(-3, 3)
        corners = np.sort(random.uniform(0, 2 * np.pi / 5, 5) + 2 * np.pi / 5 * np.arange(5))
        ring = [x, y] + random.uniform(0.1, 0.5) * np.column_stack([np.cos(corners), np.sin(corners)])
        found.append(
            (
                Disc(x=x, y=y, radius=random.uniform(0.05, 0.4)),
                Box(x=x, y=y, angle=angle, length=random.uniform(0.1, 2), width=random.uniform(0.05, 0.5)),
                Polygon(points=ring.tolist()[:: random.choice([-1, 1])]),
            )[k % 3]
        )
    return Obstacles(shapes=tuple(found))


def judged(shape, pose=(0.0, 0.0, 0.0)):
    """An obstacle as a geometry of shapely, at a pose of its course."""
    if isinstance(shape, Disc):
        centre = turned(np.array([[shape.x, shape.y]]), np.array(pose))[0]
        return shapely.Point(centre).buffer(shape.radius, quad_segs=ROUND)
    return shapely.Polygon(turned(shape.vertices, np.array(pose)))


def test_clearance():
    """The clearance is shapely's distance; where that is 0 it is not positive."""
    random = np.random.default_rng(0)
    overlaps = 0
    for _ in range(30):
        obstacles = random_shapes(random, 6)
        outlines, shapes = Surroundings(obstacles).at(0.0), shapely.union_all([judged(s) for s in obstacles.shapes])
        for pose in random.uniform([-3, -3, -4], [3, 3, 4], (20, 3)):
            found = clearance(FOOTPRINT, pose, outlines)
            expected = shapely.Polygon(turned(FOOTPRINT, pose)).distance(shapes)
            overlaps += expected == 0
            assert max(found, 0.0) == pytest.approx(expected, abs=1e-5)
    assert 50 < overlaps < 400
    assert clearance(FOOTPRINT, np.zeros(3), Surroundings(Obstacles()).at(0.0)) == np.inf


def test_depth():
    """Minus the clearance of an overlap is the least translation that ends it."""
    wall = Surroundings(Obstacles(shapes=(Box(x=1.4, length=2, width=6),))).at(0.0)
    assert clearance(FOOTPRINT, np.zeros(3), wall) == pytest.approx(-0.05)
    post = Surroundings(Obstacles(shapes=(Disc(x=0.2, y=0.1, radius=0.05),))).at(0.0)
    assert clearance(FOOTPRINT, np.zeros(3), post) == pytest.approx(-0.15)


def test_moving():
    """Obstacles on a course are where the pose of the course puts them, at each moment."""
    course = Circle(radius=2.0, period=7.0)
    obstacles = Obstacles(
        shapes=(
            Disc(x=0.3, y=0.1, radius=0.2, course=course), Box(x=5), Disc(y=4),
            Polygon(points=((0, 0), (1, 0), (0, 1)), course=Line(speed=0.5)),
        )
    )  # fmt: skip
    around, times = Surroundings(obstacles), np.array([0.0, 1.3, 6.2])
    poses = np.array([[0.0, -1, 0.3], [np.nan, 0, 0], [1.0, 2, 0.1]])
    found = clearances(FOOTPRINT, poses, times, around)
    assert np.isnan(found[1])
    for k in (0, 2):
        places = [s.course.sample(times[k : k + 1]).pose[0] if s.course else np.zeros(3) for s in obstacles.shapes]
        shapes = shapely.union_all([judged(s, p) for s, p in zip(obstacles.shapes, places, strict=True)])
        expected = shapely.Polygon(turned(FOOTPRINT, poses[k])).distance(shapes)
        assert max(found[k], 0) == pytest.approx(expected, abs=1e-5)
    assert around.at(0.0) is not around.at(0.0) and len(obstacles.moving) == 2
    low, high = obstacles.bounds  # of those that stand still
    assert low == pytest.approx([-0.1, -0.5]) and high == pytest.approx([5.5, 4.1])


@given(st.integers(1, 6), st.integers(1, 3))
def test_cover(count, rows):
    """The discs of a footprint cover it, and reach beyond it by their radius less half a side of a disc's part."""
    discs, shape = cover(FOOTPRINT, count, rows), shapely.Polygon(FOOTPRINT)
    covered = shapely.union_all([shapely.Point(x, y).buffer(r, quad_segs=ROUND) for x, y, r in discs])
    assert covered.buffer(1e-3).contains(shape)
    assert len(discs) == count * rows
    low, high = FOOTPRINT.min(axis=0), FOOTPRINT.max(axis=0)
    beyond = discs[0, 2] - (high - low) / (2 * np.array([count, rows]))
    assert covered.bounds == pytest.approx([*(low - beyond), *(high + beyond)], abs=1e-3)


@pytest.mark.parametrize("radius", [0.02, 0.1, 1.0])
def test_rim(radius):
    """The discs of an outline cover it, are no larger than asked for, and have their centres on it."""
    edge, discs = shapely.Polygon(FOOTPRINT).exterior, rim(FOOTPRINT, radius)
    places = [shapely.Point(x, y) for x, y, _ in discs]
    covered = shapely.union_all([p.buffer(radius, quad_segs=ROUND) for p in places])
    assert covered.buffer(1e-4).contains(edge) and np.all(discs[:, 2] == radius)
    assert max(edge.distance(p) for p in places) < 1e-12 and len(discs) == np.ceil(edge.length / 2 / radius)


def test_grid():
    """A cell is free only where no obstacle touches it, and occupied only within its diagonal of one."""
    random = np.random.default_rng(1)
    obstacles = random_shapes(random, 12)
    union, resolution = shapely.union_all([judged(s) for s in obstacles.shapes]), 0.1
    grid = occupancy(Surroundings(obstacles).at(0.0), np.array([-2.0, -1.5]), np.array([2.03, 1.5]), resolution)
    assert grid.occupied.shape == (30, 41) and 0.1 < grid.occupied.mean() < 0.9
    for row, column in np.ndindex(grid.occupied.shape):
        low = grid.origin + resolution * np.array([column, row])
        cell = shapely.box(*low, *(low + resolution))
        if cell.buffer(-1e-4).intersects(union):
            assert grid.occupied[row, column]
        if grid.occupied[row, column]:
            assert cell.distance(union) < resolution / np.sqrt(2)


def test_near_field():
    """Up to its reach the field is that of all cells and all obstacles, bit for bit; beyond it is the reach."""
    random = np.random.default_rng(5)
    outlines = Surroundings(random_shapes(random, 40)).at(0.0)
    low, high = np.array([-4.0, -3.0]), np.array([4.0, 5.0])
    whole = field_of(outlines, low, high, 0.05).distance
    near = near_field(outlines, low, high, 0.05, 0.4).distance
    assert np.array_equal(near, np.minimum(whole, 0.4)) and 0.1 < np.mean(near < 0.4) < 0.99
    assert np.array_equal(near_field(outlines, low, high, 0.05, 50.0).distance, whole)


def test_distance_field():
    """The field is the distance from a wall, linear between cells; its gradient points away from it."""
    wall = Surroundings(Obstacles(shapes=(Box(x=-0.5, y=1, length=1, width=10),))).at(0.0)
    field = distance_field(occupancy(wall, np.array([-0.5, -1.0]), np.array([3.0, 3.0]), 0.05))
    for x, y in ((0.3, 0.4), (1.02, -0.3), (2.5, 2.1), (-0.2, 1.0)):
        distance, dx, dy = at(field, x, y)
        assert distance == pytest.approx(x - 0.05, abs=0.051)  # the border is on that of a cell
        assert distance == value(field.distance, *field.origin, field.resolution, x, y)
        assert (dx, dy) == pytest.approx((1, 0), abs=1e-9)
    far = at(field, 50.0, 1.0)
    assert far == (pytest.approx(2.95, abs=0.05), 0, 0)
    empty = distance_field(occupancy(wall, np.array([5.0, 5.0]), np.array([6.0, 6.0]), 0.1))
    assert empty.distance.min() > 1.4


@given(st.integers(0, 2**32 - 1), st.floats(0.05, 0.95))
def test_rectangles(seed, share):
    """They cover the occupied cells and no other, and none can grow on any side."""
    occupied = np.random.default_rng(seed).random((9, 13)) < share
    covered = np.zeros_like(occupied)
    for left, low, right, high in rectangles(occupied):
        assert occupied[low:high, left:right].all()
        covered[low:high, left:right] = True
        assert left == 0 or not occupied[low:high, left - 1].all()
        assert right == 13 or not occupied[low:high, right].all()
        assert low == 0 or not occupied[low - 1, left:right].all()
        assert high == 9 or not occupied[high, left:right].all()
    assert np.array_equal(covered, occupied)


def test_file(tmp_path):
    """Obstacles are read from TOML; in a scenario the path of a file stands for what is in it."""
    obstacles = random_shapes(np.random.default_rng(2), 6)
    moving = Obstacles(shapes=(*obstacles.shapes, Disc(course=Circle())))
    path = tmp_path / "yard.toml"
    path.write_text(moving.to_toml())
    assert Obstacles.from_toml(path) == moving
    scenario = Scenario.from_dict({"obstacles": str(path)})
    assert scenario.obstacles == moving and Scenario.from_dict({"obstacles": moving.model_dump()}) == scenario


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ("nowhere.toml", "obstacles: no file nowhere.toml"),
        ({"shapes": [{"kind": "disc", "radius": -1}]}, "obstacles.shapes.0.disc.radius: "),
        ({"shapes": [{"kind": "cone"}]}, "obstacles.shapes.0: "),
        ({"shapes": [{"kind": "polygon", "points": [(0, 0), (1, 0), (0.2, 0.2), (0, 1)]}]}, "is not convex"),
        ({"shapes": [{"kind": "polygon", "points": [(0, 0), (1, 0), (2, 0)]}]}, "is not convex"),
        ({"shapes": [{"kind": "polygon", "points": [(0, 0), (1, 1), (1, 0), (0, 1)]}]}, "is not convex"),
    ],
)
def test_refused(values, message):
    """Bad obstacles are refused with one line that names the field."""
    with pytest.raises(InputError) as error:
        Scenario.from_dict({"obstacles": values})
    assert message in str(error.value) and "\n" not in str(error.value)


def test_large_grid():
    """A grid of too many cells is refused before memory is taken."""
    outlines = Surroundings(Obstacles()).at(0.0)
    with pytest.raises(InputError, match=r"grid: 100000 by 100000 cells are more than 20,000,000"):
        occupancy(outlines, np.zeros(2), np.full(2, 1e4), 0.1)
    with pytest.raises(InputError, match="empty"):
        occupancy(outlines, np.zeros(2), np.array([1.0, 0.0]), 0.1)
    with pytest.raises(InputError, match="none that stand still"):
        _ = Obstacles(shapes=(Disc(course=Circle()),)).bounds
