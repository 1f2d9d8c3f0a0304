"""Robots and obstacles in physics: hulls, collisions, and that nothing changes where there are none."""

import mujoco
import numpy as np
import pytest
import shapely

from mrctl import Box, Circle, Disc, InputError, Line, Obstacles, Polygon, Scenario, load_robot, simulate
from mrctl.loop import user_files
from mrctl.loop.simulation import Simulation
from mrctl.navigation.generators import warehouse
from mrctl.navigation.tasks import obstacles_of
from mrctl.physics import mjcf
from mrctl.physics.elements import COLLISION
from mrctl.physics.files import models_folder
from mrctl.physics.hull import footprint
from mrctl.physics.obstacles import CONTACT_BIT, HULL_HEIGHT, read_mjcf, to_mjcf
from mrctl.physics.parameters import read_robot
from mrctl.theory.clearance import clearance
from mrctl.theory.obstacles import Surroundings, turned

ROBOTS = {
    "car": {"steering": "compliant"},
    "turtlebot": {"steering": "caster", "robot": load_robot("turtlebot")},
    "racecar": {"steering": "rigid", "robot": load_robot("racecar")},
}
MIXED = Obstacles(
    shapes=(
        Disc(x=1.0, y=0.9, radius=0.3), Box(x=-0.5, y=-1.0, angle=0.4, length=1.5, width=0.2),
        Polygon(points=((0.5, -0.5), (1.5, -0.9), (1.2, -0.2))), Disc(x=-1, y=1, radius=0.05),
        Box(length=0.3, width=0.1, course=Circle(radius=0.7, period=5.0)),
    )
)  # fmt: skip


def test_footprints():
    """The footprint is what is known of each robot: the data sheet's circle, or the outermost parts with the wheels."""
    car, rigid = (footprint(mjcf.load(steering=steering)) for steering in ("compliant", "rigid"))
    # Rear tyres: radius 98 mm, outer face at 188 + 22.5 mm; front wheel: 400 − 30 + 75 mm, without trail 400 + 75 mm.
    assert (car.min(axis=0), car.max(axis=0)) == (pytest.approx([-0.098, -0.2105]), pytest.approx([0.445, 0.2105]))
    assert rigid.max(axis=0)[0] == pytest.approx(0.475)
    turtlebot = footprint(mjcf.load(**ROBOTS["turtlebot"]))
    assert np.hypot(*turtlebot.T) == pytest.approx(0.177, rel=0.01)  # the bumper
    racecar = footprint(mjcf.load(**ROBOTS["racecar"]))
    straight = 0.12065 + 0.01905  # outer face of a front wheel
    limit = mjcf.load(**ROBOTS["racecar"]).joint("steering_front_left").range[1]
    assert racecar.max(axis=0)[1] > straight and limit > 0
    for corners in (car, rigid, turtlebot, racecar):
        sides = np.roll(corners, -1, axis=0) - corners
        assert np.all(sides[:, 0] * np.roll(sides[:, 1], -1) > sides[:, 1] * np.roll(sides[:, 0], -1))


@pytest.mark.parametrize("name", ROBOTS)
def test_hull_weighs_nothing(name):
    """With an obstacle far away a run has the same bits; the robot's parameters are the same."""
    far = Obstacles(shapes=(Disc(x=40),))
    assert read_robot(mjcf.load(**ROBOTS[name], obstacles=far)) == read_robot(mjcf.load(**ROBOTS[name]))
    run = Scenario(**ROBOTS[name], reference=Line(length=0.6, speed=0.3), laps=1)
    alone, beside = simulate(run), simulate(run.replace(obstacles=far))
    assert "clearance" not in alone and beside["clearance"].min() > 30
    for signal in ("x", "y", "theta", "voltage_left", "gyro"):
        assert np.array_equal(alone[signal], beside[signal])


@pytest.mark.parametrize("name", ROBOTS)
def test_contact_is_overlap(name):
    """MuJoCo has a contact of the hull where the footprint overlaps an obstacle, at all but 2 mm."""
    model = mjcf.load(**ROBOTS[name], obstacles=MIXED)
    data, corners, outlines = mujoco.MjData(model), footprint(model), Surroundings(MIXED).at(0.0)
    hits = 0
    for pose in np.random.default_rng(0).uniform([-2, -2, -4], [2, 2, 4], (400, 3)):
        data.qpos[:7] = *pose[:2], model.body("chassis").pos[2], np.cos(pose[2] / 2), 0, 0, np.sin(pose[2] / 2)
        mujoco.mj_forward(model, data)
        touches, gap = data.sensor(COLLISION).data[0] > 0, clearance(corners, pose, outlines)
        hits += touches
        assert abs(gap) < 1e-3 or touches == (gap < 0)
        assert not touches_floor(model, data)
    assert 50 < hits < 350


def touches_floor(model, data):
    """Whether MuJoCo has a contact of the hull with a plane."""
    planes = {g for g in range(model.ngeom) if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_PLANE}
    assert planes
    return any(model.geom("hull").id in pair and planes & set(pair) for pair in data.contact.geom.tolist())


@pytest.mark.parametrize("name", ROBOTS)
def test_hull_passes_through_the_floor(name):
    """A robot that is put into the floor, its hull across the surface, has contacts there, but none of the hull."""
    model = mjcf.load(**ROBOTS[name], obstacles=wall(1.5))
    data, middle = mujoco.MjData(model), HULL_HEIGHT / 2
    data.qpos[:7] = 0, 0, -middle, 1, 0, 0, 0  # the hull reaches from the axle up to `HULL_HEIGHT`
    mujoco.mj_forward(model, data)
    floor = next(g for g in range(model.ngeom) if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_PLANE)
    assert data.ncon > 0 and any(floor in pair for pair in data.contact.geom.tolist())
    assert not touches_floor(model, data) and data.sensor(COLLISION).data[0] == 0
    model.geom_contype[floor] = model.geom_conaffinity[floor] = CONTACT_BIT  # so that the check above can fail
    mujoco.mj_forward(model, data)
    assert touches_floor(model, data) and data.sensor(COLLISION).data[0] > 0


def outline(shape, pose):
    """An obstacle as a geometry of shapely, at a pose of its course."""
    if isinstance(shape, Disc):
        return shapely.Point(turned(np.array([[shape.x, shape.y]]), pose)[0]).buffer(shape.radius, quad_segs=200)
    return shapely.Polygon(turned(shape.vertices, pose))


@pytest.mark.parametrize("size", [1, 4])
@pytest.mark.parametrize("count", [6, pytest.param(60, marks=pytest.mark.full)])
def test_verdict_of_driven_runs(count, size):
    """At every tick of driven runs MuJoCo's verdict is shapely's distance, at all but 2 mm; some runs collide.

    Runs drive alone and in fours, beside a box and every other time towards a disc that moves.
    """
    random, ticks, decided, ends = np.random.default_rng(2), 0, 0, []
    for k in range(count):
        x, y, angle, heading = random.uniform([0.9, -1.0, -3, -0.5], [1.2, 1.0, 3, 0.5])
        box = Box(x=x, y=y, angle=angle, length=0.4, width=0.2)
        mover = Disc(x=-1.0, y=0.45, radius=0.1, course=Line(heading=heading, speed=0.3))
        shapes = (box, mover)[: 1 + k % 2]
        own = Scenario(
            **list(ROBOTS.values())[k % 3], reference=Line(length=1.2, speed=0.5), laps=1, prior="model",
            learner="none", obstacles=Obstacles(shapes=shapes), initial_spread=(0.01, 0.1, 0.1),
        )  # fmt: skip
        simulation = Simulation([own.replace(seed=size * k + row) for row in range(size)])
        corners, plant = footprint(mjcf.load(**list(ROBOTS.values())[k % 3])), simulation.plant
        while plant.running and simulation.tick < simulation.ticks:
            running = np.flatnonzero(~plant.stopped)
            simulation.step()
            time = np.array([simulation.tick * own.control_period])
            poses = [s.course.sample(time).pose[0] if s.course else np.zeros(3) for s in shapes]
            walls = shapely.union_all([outline(shape, pose) for shape, pose in zip(shapes, poses, strict=True)])
            for row in running:
                assert plant.failure[row] in ("", "collision")
                robot = shapely.Polygon(turned(corners, plant.reading["pose"][row]))
                ticks += 1
                gap = robot.distance(walls)
                if gap > 2e-3 or (gap == 0 and robot.buffer(-2e-3).intersects(walls)):
                    decided += 1
                    assert (plant.failure[row] == "collision") == (gap == 0)
        ends += plant.failure
    hits = ends.count("collision")
    print(f"{len(ends)} runs, {hits} collisions, {ticks} ticks, {ticks - decided} of them within 2 mm")
    assert 0.2 * len(ends) < hits < 0.8 * len(ends) and decided > 0.97 * ticks


def wall(x):
    """A wall across the line that the robots drive along."""
    return Obstacles(shapes=(Box(x=x, length=0.1, width=2.0),))


def test_collision_ends_the_run():
    """The run ends in the tick in which the footprint reaches the wall, with the reason."""
    run = Scenario(reference=Line(length=1.0, speed=0.5), laps=1, obstacles=wall(1.0), initial_spread=(0, 0, 0))
    result = simulate(run)
    assert bool(result["failed"]) and str(result["failure"].values) == "collision"
    before = float(result["clearance"].dropna("time")[-1])
    assert 0 < before < 0.5 * 0.02  # a tick earlier it was at most two ticks' way off
    front = 0.95 - footprint(mjcf.load())[:, 0].max()
    assert float(result["failure_time"]) == pytest.approx(front / 0.5, abs=0.05)
    assert not simulate(run.replace(obstacles=wall(1.6)))["failed"]


@pytest.mark.parametrize("size", [1, 2])
def test_mocap_body_of_the_world(size, tmp_path):
    """A mocap body that a world has of its own stays, and moving obstacles go on their courses, one as two."""
    marker = '<body name="marker" mocap="true" pos="5 5 0.5"><geom type="sphere" size="0.1"/></body>'
    world = (models_folder() / "flat.xml").read_text().replace("<worldbody>", f"<worldbody>{marker}")
    (tmp_path / "mine.xml").write_text(world.replace('file="', f'file="{models_folder()}/'))
    movers = [Disc(x=k - 3.0, y=2.0, radius=0.1, course=Line(heading=0.0, speed=0.3)) for k in range(2)]
    for count in (1, 2):
        obstacles = Obstacles(shapes=tuple(movers[:count]))
        own = Scenario(world=str(tmp_path / "mine.xml"), obstacles=obstacles, laps=1, reference=Line(length=0.3))
        simulation = Simulation([own] * size)
        while simulation.running:
            simulation.step()
        model, places = simulation.plant.models[0], simulation.plant.mocap[0]
        assert np.all(places[:, model.body("marker").mocapid[0]] == (5, 5, 0.5))
        ids = [model.body(f"obstacle {k}").mocapid[0] for k in range(count)]
        along = 0.3 * simulation.tick * simulation.period  # of the frames of their courses
        assert np.allclose(places[:, ids, 0], along, atol=1e-9) and np.all(places[:, ids, 1] == 0)


def test_start_in_an_obstacle():
    """A robot that would start in a collision is refused with one line."""
    with pytest.raises(InputError, match=r"initial_pose: the robot would stand in an obstacle at \("):
        simulate(Scenario(reference=Line(), laps=1, obstacles=wall(0.3)))


OWN = """
class Nothing:
    def __init__(self, robot, size): pass
    def output(self, command, derivative): return 0 * command
    def learn(self, feedback, frozen, twist, voltage): pass
"""


def test_collision_in_a_trial(tmp_path):
    """A controller that is tried is not blamed for what hits the robot meanwhile."""
    (tmp_path / "own.py").write_text(OWN)
    cart = Disc(x=-0.65, radius=0.2, course=Line(heading=np.pi, speed=2.0))  # from (0.65, 0) towards the robot
    scenario = Scenario(reference=Line(), laps=1, obstacles=Obstacles(shapes=(cart,)))
    simulation = Simulation([scenario])
    simulation.step()
    assert simulation.plant.failure == ["collision"]
    user_files.trial(f"{tmp_path / 'own.py'}:Nothing", scenario)


def test_batch_equals_single():
    """Moving obstacles are at the same places for one robot and for many, and robots collide at the same tick."""
    chaser = Box(x=-0.9, y=-0.4, length=0.3, width=0.3, course=Line(heading=1.5707963, speed=0.5))
    sides = Disc(x=0.5, y=2, radius=0.2), Disc(x=1.5, radius=0.3, y=0.5)
    runs = [
        Scenario(
            reference=Line(length=1.2, speed=0.4), laps=1, seed=seed, obstacles=Obstacles(shapes=(*sides[:k], chaser)),
            perturbation={"mass_factor": 1.0 + 0.2 * seed, "payload": 1.0 * k},
        )
        for k in (1, 2) for seed in range(3)
    ]  # fmt: skip
    together = simulate(runs)
    assert together["failed"].all()
    for row in (0, 5):
        alone = simulate(runs[row])
        for name in ("x", "voltage_left", "clearance"):
            size = alone.sizes["time"]
            assert np.array_equal(alone[name], together[name][row, :size], equal_nan=True)
        assert alone["failure_time"] == together["failure_time"][row]
    assert together["failure_time"].values[0] < 2.0  # the box comes from the right, and meets the robot's side


def test_mjcf_lintel(tmp_path):
    """A geom whose lower end is above every robot is no obstacle."""
    geom = '<geom type="box" size="0.5 0.1 0.1" pos="{} 0 {}"/>'
    text = geom.format(1, 1.15) + geom.format(2, 1.05) + geom.format(3, 0.1)
    (tmp_path / "door.xml").write_text(f"<mujoco><worldbody>{text}</worldbody></mujoco>")
    assert [shape.x for shape in read_mjcf(tmp_path / "door.xml").shapes] == [2, 3]
    for post in ('type="capsule" size="0.1 1.0" pos="1 0 1.1"', 'type="sphere" size="0.9" pos="0 0 1"'):
        (tmp_path / "post.xml").write_text(f"<mujoco><worldbody><geom {post}/></worldbody></mujoco>")
        with pytest.raises(InputError, match="not an upright box or cylinder"):  # they stand on the floor
            read_mjcf(tmp_path / "post.xml")


@pytest.mark.parametrize("post", ['type="sphere" size="0.3"', 'type="capsule" size="0.2 0.1" pos="1 0 -0.15"'])
def test_mjcf_half_sunk(tmp_path, post):
    """A sphere or capsule whose middle is in the ground is no floor, because it ends above 2 cm."""
    (tmp_path / "post.xml").write_text(f"<mujoco><worldbody><geom {post}/></worldbody></mujoco>")
    with pytest.raises(InputError, match="not an upright box or cylinder"):
        read_mjcf(tmp_path / "post.xml")


def test_mjcf(tmp_path):
    """Obstacles come back from MJCF as they were, with their courses; a floor is none."""
    (tmp_path / "a.xml").write_text(to_mjcf(MIXED))
    found = read_mjcf(tmp_path / "a.xml")
    assert [shape.kind for shape in found.shapes] == [shape.kind for shape in MIXED.shapes]
    before, after = (Surroundings(obstacles).at(1.3) for obstacles in (MIXED, found))
    assert np.allclose(before.discs, after.discs, atol=1e-6)
    assert np.allclose(sorted(before.edges.tolist()), sorted(after.edges.tolist()), atol=2e-6)
    assert obstacles_of(str(tmp_path / "a.xml"), "world") == found  # as of a mission
    assert read_mjcf(models_folder() / "patch.xml").shapes == ()
    (tmp_path / "b.xml").write_text(
        '<mujoco><worldbody><geom name="log" type="capsule" size="1 1" zaxis="1 0 0"/></worldbody></mujoco>'
    )
    with pytest.raises(InputError, match="geom log: not an upright box or cylinder, nor a mesh"):
        read_mjcf(tmp_path / "b.xml")


def test_world_of_a_generator():
    """A generated world compiles with every robot."""
    task = warehouse(1.2)
    model = mjcf.load(**ROBOTS["turtlebot"], obstacles=task.obstacles)
    names = [model.geom(k).name for k in range(model.ngeom)]
    assert sum(name.startswith("obstacle") for name in names) == len(task.obstacles.shapes)
