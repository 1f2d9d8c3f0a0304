"""What the viewer shows of missions: obstacles that move, plans and goals, clearances, scans, and goals by click."""

import json

import numpy as np
import pytest
import shapely

from mrctl import Box, Circle, Disc, Line, Obstacles, Scenario, save, simulate
from mrctl.navigation.generators import Task
from mrctl.navigation.mission import navigate
from mrctl.physics import mjcf
from mrctl.physics.hull import footprint
from mrctl.viewer.export import _curves
from mrctl.viewer.live import Live
from mrctl.viewer.recording import Library, looks_of
from mrctl.viewer.replay import Replay
from mrctl.viewer.server import Server

TURNING = Box(x=0.1, y=3.0, length=0.3, width=0.2, course=Circle(radius=0.5, period=6.0))
PASSING = Disc(y=-2.0, radius=0.2, course=Line(speed=0.5, length=4.0))
MOVING = Obstacles(shapes=(TURNING, Disc(x=3.0, y=1.5, radius=0.2), PASSING))
DRIVE = Scenario(reference=Line(speed=0.5, length=1.0), laps=1, learner="none", obstacles=MOVING)
PID = Scenario(learner="none")


@pytest.fixture
def server():
    server = Server(port=0)
    yield server
    server.stop()


def on_circle(time):
    """Where the box's course is, by the formula of a circle that begins at the origin along +x."""
    turn = 2 * np.pi * time / 6.0
    return 0.5 * np.sin(turn), 0.5 * (1 - np.cos(turn)), turn


def check_movers(scene, time):
    """The nodes of both obstacles that move are where their courses are, by formula."""
    (x, y, theta), (box, disc) = on_circle(time), scene._movers
    assert box.position == pytest.approx([x, y, 0], abs=1e-9)
    assert 2 * np.arctan2(box.wxyz[3], box.wxyz[0]) == pytest.approx(theta)
    assert disc.position == pytest.approx([0.5 * time, 0, 0], abs=1e-9)


def test_obstacles_move(server, tmp_path):
    """Live and in a replay they are where the physics has them, at the start and later."""
    live = Live([DRIVE], server)
    for tick in (0, 130):
        while live.session.tick < tick:
            live.session.step()
        live.draw()
        check_movers(live._scene, 0.01 * tick)
    positions, _ = live.session.simulations[0][1].plant.mocap
    assert np.allclose([m.position for m in live._scene._movers], positions[0], atol=1e-12)
    save(simulate(DRIVE), tmp_path / "result.zarr")
    replay = Replay(Library(tmp_path / "result.zarr"), [0], server)
    for time in (1.3, 0.0):
        replay._scrub(time)
        replay.draw()
        check_movers(replay._scene, time)


WALLS = Obstacles(shapes=(Box(x=1.0, y=0.8, length=4.0, width=0.2), Box(x=3.0, length=0.2, width=4.0)))
ROOM = Task(obstacles=WALLS, start=(0.0, 0.0, 0.0), goal=(1.5, -0.6, -0.5))


def test_replay_of_a_mission(server, tmp_path):
    """Its plan is the reference, the outlines stand at start and goal, and the clearance is that of the result."""
    mission = navigate(ROOM, PID, compare=["model"])
    save(mission.result, tmp_path / "result.zarr")
    replay = Replay(Library(tmp_path / "result.zarr"), [0, 1], server)
    for time, there in ((0.5, 0), (replay.duration, 2)):
        replay._scrub(time)
        replay.draw()
        replay.refresh()
        assert replay._status.content.count("has arrived") == there
    start, goal = replay._scene._ends
    assert start.visible and start.position[:2] == pytest.approx([0, 0], abs=1e-9)
    assert goal.position[:2] == pytest.approx([1.5, -0.6]) and 2 * np.arcsin(goal.wxyz[3]) == pytest.approx(-0.5)
    titles = {handle.title: handle for handle in replay._plots._handles}
    _, *drawn, _ = titles["clearance, m"].data
    for row, curve in enumerate(drawn):
        known = curve[np.isfinite(curve)]
        assert mission.table["clearance"].iloc[row] <= known.min() < mission.table["clearance"].iloc[row] + 0.01
    written = json.loads(_curves(replay.recordings, looks_of(replay.recordings, [0, 1])))["charts"]
    chart = next(chart for chart in written if chart["title"] == "clearance, m")
    exported = [min(v for v in curve["values"] if v is not None) for curve in chart["curves"]]
    assert exported == pytest.approx(mission.table["clearance"], abs=0.01)


def test_clearance_live(server):
    """Beside a wall it is the distance of the wall less half the robot, less the error; saved, it is the same bits."""
    drive = DRIVE.replace(obstacles=WALLS, reference=Line(speed=0.5, length=1.0), initial_spread=(0, 0, 0))
    live = Live([drive], server)
    for until in (100, 200):  # in parts, as the page asks for it
        while live.session.tick < until:
            live.session.step()
        live.draw()
        live.refresh()
    log, clearance = live.session.log()[:, 0], live.session.clearance()[:, 0]
    half = footprint(mjcf.load())[:, 1].max()
    assert clearance == pytest.approx(0.7 - half - log["y"], abs=2e-3)  # the heading is off by milliradians
    assert clearance.tobytes() == simulate(live.session.saved()[0])["clearance"].values.tobytes()
    handle = next(handle for handle in live._plots._handles if handle.title == "clearance, m")
    assert handle.data[1].size > 40 and set(handle.data[1]) <= set(clearance)
    assert not live._scene._ends[0].visible  # a line has no end


@pytest.mark.parametrize("localisation", ["scan", "particles"])
def test_scan(server, localisation):
    """The points of the last scan are on the walls, and so are those of the picture; the particles are at the robot."""
    own = {"tier": "field", "localisation": localisation, "lidar": {"noise": 0.0, "beams": 60}}
    live = Live([DRIVE.replace(obstacles=WALLS, sensing=own)], server)
    assert live.session.scan(0) is None
    for _ in range(25):
        live.session.step()
    live.draw()
    points, particles = live._scene._scans
    x, y, z = points.points.T
    walls = shapely.union_all([shapely.Polygon(shape.vertices) for shape in WALLS.shapes])
    assert len(x) > 15 and points.visible and (z > 0.5).all()
    assert max(walls.boundary.distance(shapely.Point(*place)) for place in zip(x, y, strict=True)) < 1e-6
    assert len(particles.points) == (500 if localisation == "particles" else 0)
    if localisation == "particles":
        assert particles.points[:, :2].mean(axis=0) == pytest.approx(live.session.qpos(0)[:2], abs=0.1)
