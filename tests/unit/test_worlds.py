"""Worlds from files of other tools, and from generators."""

import struct

import numpy as np
import pytest
import shapely
from PIL import Image
from test_obstacles import judged

from mrctl import InputError
from mrctl.navigation import generators
from mrctl.navigation.maps import read_map
from mrctl.navigation.sdf import read_sdf
from mrctl.theory.clearance import clearance
from mrctl.theory.obstacles import Surroundings

YAML = """image: {image}
resolution: 0.5
origin: [1.0, 2.0, {yaw}]
negate: {negate}
occupied_thresh: 0.65
free_thresh: 0.196
mode: {mode}
"""
# Rows of the image from the top; by the default thresholds 0 is occupied, 255 free, and 120 between.
PICTURE = np.array([[0, 0, 255, 255], [255, 255, 120, 0], [0, 255, 255, 0]], np.uint8)


def written(folder, image="map.pgm", mode="trinary", yaw=0.0, negate=0, pixels=PICTURE):
    Image.fromarray(pixels).save(folder / image)
    (folder / "map.yaml").write_text(YAML.format(image=image, mode=mode, yaw=yaw, negate=negate))
    return folder / "map.yaml"


@pytest.mark.parametrize("image", ["map.pgm", "map.png"])
def test_map(tmp_path, image):
    """Rows go up from the lower left corner; between the thresholds a cell is unknown, or has a probability."""
    found = read_map(written(tmp_path, image))
    assert found.occupancy.tolist() == [[100, 0, 0, 100], [0, 0, -1, 100], [100, 100, 0, 0]]
    # (255 − 120)/255 = 0.529, which is 0.734 of the way between the thresholds.
    assert read_map(written(tmp_path, image, "scale")).occupancy[1, 2] == int(1 + 98 * 0.734)
    inverse = read_map(written(tmp_path, image, negate=1)).occupancy
    assert inverse.tolist() == [[0, 100, 100, 0], [100, 100, -1, 0], [0, 0, 100, 100]]


def test_transparency(tmp_path):
    """In the mode `scale` a transparent pixel is unknown."""
    pixels = np.dstack([np.full((1, 2), 120, np.uint8)] * 3 + [np.array([[255, 0]], np.uint8)])
    assert read_map(written(tmp_path, "map.png", "scale", pixels=pixels)).occupancy.tolist() == [[72, -1]]


def test_grey_with_transparency(tmp_path):
    """A map in grey with an alpha channel has the walls that it has in colours with one."""
    path = written(tmp_path, "map.png")
    Image.fromarray(PICTURE).convert("LA").save(tmp_path / "map.png")
    found = read_map(path).occupancy
    assert found.tolist() == [[100, 0, 0, 100], [0, 0, -1, 100], [100, 100, 0, 0]]
    Image.fromarray(PICTURE).convert("RGBA").save(tmp_path / "map.png")
    assert np.array_equal(read_map(path).occupancy, found)


def test_palette(tmp_path):
    """An image with a palette, as many programs save one, has no transparency that would brighten it."""
    grey = np.array([[80, 205, 255]], np.uint8)  # of which 80 is occupied, and 205 unknown
    path = written(tmp_path, "map.png", pixels=grey)
    Image.fromarray(grey).convert("P").save(tmp_path / "map.png")
    assert read_map(path).occupancy.tolist() == [[100, -1, 0]]


def test_map_obstacles(tmp_path):
    """The rectangles are the occupied pixels, where the origin with its yaw puts them."""
    yaw = 0.6
    obstacles = read_map(written(tmp_path, yaw=yaw)).obstacles()
    assert len(obstacles.shapes) == 3
    cells = [(0, 0), (3, 0), (3, 1), (0, 2), (1, 2)]  # column and row
    pixels = shapely.union_all([shapely.box(0.5 * c, 0.5 * r, 0.5 * c + 0.5, 0.5 * r + 0.5) for c, r in cells])
    expected = shapely.affinity.translate(shapely.affinity.rotate(pixels, yaw, (0, 0), use_radians=True), 1.0, 2.0)
    found = shapely.union_all([judged(shape) for shape in obstacles.shapes])
    assert found.symmetric_difference(expected).area < 1e-9


def test_fields_of_tools(tmp_path):
    """Fields that other tools have added are passed over, whatever their type."""
    path = written(tmp_path)
    expected = read_map(path).occupancy
    path.write_text(f"{path.read_text()}1: 2\non: saved\nname: hall\n")
    assert np.array_equal(read_map(path).occupancy, expected)


def test_no_map(tmp_path):
    """What is no map is refused with one line that says why; an image of 10⁹ pixels before it is decoded."""
    path = written(tmp_path)
    text, cases = path.read_text(), {}
    cases["No such file"] = None
    cases["no map"] = "42"
    cases["resolution: "] = text.replace("0.5", "-1")
    cases["free_thresh: must be below"] = text.replace("0.196", "0.7")
    cases["no image that can be read"] = text.replace("map.pgm", "map.yaml")
    cases["mode: "] = text.replace("trinary", "guess")
    cases["no yaml: month must be in"] = f"{text}made: 2025-19-01\n"
    cases["no yaml: 'NoneType'"] = f"{text}made: !!timestamp today\n"
    cases["nowhere.pgm"] = text.replace("map.pgm", "nowhere.pgm")
    (tmp_path / "huge.pgm").write_bytes(b"P5 40000 25000 255\n")
    cases["huge.pgm: "] = text.replace("map.pgm", "huge.pgm")
    (tmp_path / "large.pgm").write_bytes(b"P5 10000 10000 255\n")
    cases["10000 by 10000 cells are more than"] = text.replace("map.pgm", "large.pgm")
    head = struct.pack("<7I", 124, 0x1007, 4, 4, 8, 0, 1) + bytes(44) + struct.pack("<2I4s", 32, 4, b"none")
    (tmp_path / "other.dds").write_bytes(b"DDS " + head + bytes(40))
    cases["other.dds: no image that can be read: Unimplemented"] = text.replace("map.pgm", "other.dds")
    for message, content in cases.items():
        path.unlink(missing_ok=True)
        if content is not None:
            path.write_text(content)
        with pytest.raises(InputError) as error:
            read_map(path)
        assert message in str(error.value) and "\n" not in str(error.value), message


SDF = """<?xml version="1.0"?>
<sdf version="1.6"><world name="default">
  <include><uri>model://ground_plane</uri></include>
  <model name="unit_cylinder_0"><static>1</static><pose>1 2 0.5 0 0 0</pose>
    <link name="link"><collision name="c"><geometry>
      <cylinder><radius>0.075</radius><length>1</length></cylinder></geometry></collision></link></model>
  <model name="unit_cylinder_1"><static>1</static><pose>9 9 0.5 0 0 0</pose>
    <link name="link"><collision name="c"><geometry>
      <cylinder><radius>0.075</radius><length>1</length></cylinder></geometry></collision></link></model>
  <model name="wall"><pose>0 1 0 0 0 1.5707963267948966</pose>
    <link name="link"><pose>1 0 0 0 0 0</pose><collision name="c"><pose>0.5 0 0.5 0 0 0</pose><geometry>
      <box><size>2 0.2 1</size></box></geometry></collision></link></model>
  <model name="floor"><link name="link"><collision name="c"><geometry>
      <box><size>20 20 0.01</size></box></geometry></collision></link></model>
  <state world_name="default"><model name="unit_cylinder_1"><scale>1 1 1</scale>
    <pose>-3 4 0.5 0 0 0</pose></model></state>
</world></sdf>
"""


def test_sdf(tmp_path):
    """Poses of model, link and collision add up, and the state of the world counts; floors are no obstacles."""
    (tmp_path / "a.world").write_text(SDF)
    first, second, wall = read_sdf(tmp_path / "a.world").shapes
    assert (first.x, first.y, first.radius) == (1, 2, 0.075)
    assert (second.x, second.y) == (-3, 4)
    assert (wall.x, wall.y, wall.angle, wall.length) == pytest.approx((0, 2.5, np.pi / 2, 2))


def test_sdf_inner(tmp_path):
    """Models in models count, from the pose of the outer one, and so do angles in degrees."""
    pose, turned = "<pose>0 1 0 0 0 1.5707963267948966</pose>", '<pose degrees="true">0 1 0 0 0 90</pose>'
    inner = f'<model name="outer"><pose>2 0 0 0 0 0</pose><model name="wall">{turned}'
    world = SDF.replace(f'<model name="wall">{pose}', inner).replace('<model name="f', '</model><model name="f')
    (tmp_path / "a.world").write_text(world)
    wall = read_sdf(tmp_path / "a.world").shapes[2]
    assert (wall.x, wall.y, wall.angle, wall.length) == pytest.approx((2, 2.5, np.pi / 2, 2))


def test_sdf_lintel(tmp_path):
    """What hangs above every robot, as the lintel of a door, is no obstacle; what hangs lower is one."""
    for height, count in ((2.2, 2), (1.4, 3)):  # of the centre of a box of 1 m
        (tmp_path / "a.world").write_text(
            SDF.replace("<pose>0.5 0 0.5 0 0 0</pose>", f"<pose>0.5 0 {height} 0 0 0</pose>")
        )
        assert len(read_sdf(tmp_path / "a.world").shapes) == count
    lying = SDF.replace("<pose>0.5 0 0.5 0 0 0</pose>", "<pose>0.5 0 1.6 0 1.57 0</pose>")  # it reaches down to 0.6 m
    (tmp_path / "a.world").write_text(lying)
    with pytest.raises(InputError, match="is not upright"):
        read_sdf(tmp_path / "a.world")


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ("<world", "<word", "mismatched tag"),
        ("cylinder>", "mesh>", "model unit_cylinder_0: its shape is a mesh"),
        ("0.5 0 0 0", "0.5 1 0 0", "unit_cylinder_0: is not upright"),
        ("0.5 0 0 0", "0.5", "is not six numbers"),
        ("<pose>0.5", '<pose relative_to="door">0.5', "c: pose: is relative to door"),
        ('name="wall">', 'name="wall" placement_frame="link">', "model wall: is placed by its frame link"),
        ("<scale>1 1 1", "<scale>2 1 1", "model unit_cylinder_1: its state scales it by 2 1 1"),
        ("</world>", '<population name="trees"/></world>', "has a <population>"),
        ("<radius>0.075</radius>", "", "cylinder has no valid radius"),
        ("<length>1</length>", "<length>1 m</length>", "cylinder has no valid length"),
        ("<length>1</length>", "", "cylinder has no valid length"),
        ("<length>1</length>", "<length>nan</length>", "cylinder has no valid length"),
        ("0.5 0 0 0", "nan 0 0 0", "is not six numbers"),
        ('version="1.0"', 'version="1.0" encoding="none"', "no SDF file, as it is not XML: unknown encoding: none"),
        ('version="1.0"', 'version="1.0" encoding="shift_jis"', "no SDF file, as it is not XML: multi-byte encodings"),
    ],
)
def test_no_sdf(tmp_path, before, after, message):
    """A world that cannot be read is refused with one line."""
    (tmp_path / "a.world").write_text(SDF.replace(before, after))
    with pytest.raises(InputError) as error:
        read_sdf(tmp_path / "a.world")
    assert message in str(error.value) and "\n" not in str(error.value)


SQUARE = np.array([[-0.15, -0.15], [0.15, -0.15], [0.15, 0.15], [-0.15, 0.15]])
TASKS = {
    "cellular": generators.cellular,
    "corridor": lambda seed: generators.corridor(1.0, seed),
    "slalom": lambda seed: generators.slalom(0.8, seed),
    "doorway": lambda seed: generators.doorway(0.8, seed),
    "parking_bay": lambda seed: generators.parking_bay(1.2, 0.6, seed),
    "warehouse": lambda seed: generators.warehouse(1.0, seed),
}


@pytest.mark.parametrize("name", TASKS)
def test_generators(name):
    """The seed decides; start and goal are free."""
    tasks = [TASKS[name](seed) for seed in range(5)]
    assert tasks[3] == TASKS[name](3) and len(set(tasks)) == 5
    for task in tasks:
        outlines = Surroundings(task.obstacles).at(0.0)
        for pose in (task.start, task.goal):
            assert clearance(SQUARE, np.array(pose), outlines) > 0.05


def free(task, line):
    """Length of the part of a line that is free."""
    return line.difference(shapely.union_all([judged(shape) for shape in task.obstacles.shapes])).length


def test_widths():
    """Doors, gaps and bays are as wide as asked for, and a corridor is nowhere narrower."""
    door = generators.doorway(0.83, 4)
    assert free(door, shapely.LineString([(0, -2), (0, 2)])) == pytest.approx(0.83)
    bay = generators.parking_bay(1.3, 0.7)
    assert free(bay, shapely.LineString([(-1.5, -0.3), (1.5, -0.3)])) == pytest.approx(1.3)
    gate = generators.slalom(0.6, 2).obstacles.shapes[:2]
    assert abs(gate[1].y - gate[0].y) - gate[0].radius - gate[1].radius == pytest.approx(0.6)
    for seed in range(5):
        walls = shapely.union_all([judged(s) for s in generators.corridor(0.9, seed).obstacles.shapes])
        left, right = walls.geoms
        assert left.distance(right) == pytest.approx(0.9)
    hall = generators.warehouse(0.9, 1)
    aisles = shapely.union_all([judged(s) for s in hall.obstacles.shapes])
    assert free(hall, shapely.LineString([(0, -0.45), (0, 20)])) > 4 and not aisles.is_empty


def test_automaton():
    """A filled cell without filled neighbours goes, and a hole in a block closes, as in BARN."""
    full, empty = generators.cellular(0, fill=1.0), generators.cellular(0, fill=0.0)
    assert len(empty.obstacles.shapes) == 2  # the walls
    assert len(full.obstacles.shapes) == 2 + 4 * 29  # of a full field nobody touches more than the border
    few = generators.cellular(1, fill=0.02, steps=3).obstacles.shapes
    assert len(few) < 0.5 * 0.02 * 900


@pytest.mark.parametrize(
    "make",
    [
        lambda: generators.corridor(-1.0),
        lambda: generators.corridor(8.0),
        lambda: generators.doorway(3.0),
        lambda: generators.cellular(1, fill=20.0),
    ],
)
def test_impossible_worlds(make):
    """Sizes and shares that make no world are refused."""
    with pytest.raises(InputError, match="width|turn|fill"):
        make()


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda: generators.doorway("a"), "width"),
        (lambda: generators.doorway(0.8, room=float("inf")), "room"),
        (lambda: generators.parking_bay(float("nan"), 0.6), "length"),
        (lambda: generators.slalom(None), "gap"),
        (lambda: generators.corridor(1.0, turn="right"), "turn"),
        (lambda: generators.cellular(1, fill="half"), "fill"),
        (lambda: generators.warehouse(1.0, shelf=(2.0,)), "shelf"),
        (lambda: generators.warehouse(1.0, shelf=2.0), "shelf"),
        (lambda: generators.warehouse(1.0, shelf=(2.0, -0.5)), "width"),
    ],
)
def test_sizes_that_are_no_sizes(make, name):
    """What is not a positive number, or a pair of them, is refused by its name."""
    with pytest.raises(InputError, match=f"^{name}: must be"):
        make()


@pytest.mark.parametrize(
    ("make", "name"),
    [
        *((make, "seed") for make in TASKS.values()),
        (lambda _: generators.cellular(1, steps=-1), "steps"),
        (lambda _: generators.cellular(1, cells=4.5), "cells"),
        (lambda _: generators.corridor(1.0, pieces=2.5), "pieces"),
        (lambda _: generators.slalom(0.8, gates=2.5), "gates"),
        (lambda _: generators.warehouse(1.0, rows=2.5), "rows"),
    ],
)
def test_numbers_that_are_not_whole(make, name):
    """Seeds and numbers that are not whole, or too small, are refused by their names."""
    with pytest.raises(InputError, match=f"^{name}: must be a whole number"):
        make(-1)
