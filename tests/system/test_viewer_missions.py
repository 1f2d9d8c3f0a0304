"""What the viewer shows of missions: obstacles that move, plans and goals, clearances, scans, and goals by click."""

import io
import json
import re
import runpy

import numpy as np
import pandas as pd
import pytest
import shapely
from test_viewer import CHROMIUM, DRAG_ERROR, PATIENCE, ROBOT, SOFTWARE, node, serving, until, visit

from mrctl import Box, Circle, Disc, Event, InputError, Line, Obstacles, Scenario, save, simulate
from mrctl.cli import main
from mrctl.loop.goals import arrived
from mrctl.loop.timeline import ends
from mrctl.navigation.avoiders import avoiding
from mrctl.navigation.generators import Task
from mrctl.navigation.mission import navigate
from mrctl.navigation.planning import prepared
from mrctl.navigation.tasks import task_of
from mrctl.physics import mjcf
from mrctl.physics.hull import footprint
from mrctl.results.dataset import SIGNALS
from mrctl.results.metrics import per_lap
from mrctl.sensing.lidar import Lidar
from mrctl.theory.obstacles import turned
from mrctl.viewer import view as viewing
from mrctl.viewer.cameras import FILLED_SHARE
from mrctl.viewer.export import _curves
from mrctl.viewer.live import SAMPLES, WINDOW, Live
from mrctl.viewer.plots import charts
from mrctl.viewer.recording import Library, joint_log, looks_of
from mrctl.viewer.replay import ReplayPage
from mrctl.viewer.server import Server
from mrctl.viewer.session import Session
from mrctl.viewer.words import arrivals

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


def test_map(server):
    """A map that differs from the world is drawn as the outlines of what it has; without one nothing is."""
    known = Obstacles(shapes=(Box(x=3.0, y=1.5, length=0.4, width=0.2), Disc(x=1.0, y=-1.0, radius=0.3)))
    live = Live([DRIVE.replace(map=known)], server)
    drawn = live._scene.navigation._map
    rims = [
        shapely.box(2.8, 1.4, 3.2, 1.6).exterior,
        shapely.Point(1.0, -1.0).buffer(0.3, 256).exterior,
    ]
    points = drawn.points.reshape(-1, 3)
    away = np.array([[rim.distance(shapely.Point(*point[:2])) for rim in rims] for point in points])
    assert drawn.visible and away.min(axis=1).max() < 1e-3 and set(away.argmin(axis=1)) == {0, 1}
    assert shapely.unary_union([shapely.LineString(ends) for ends in drawn.points[..., :2]]).length == pytest.approx(
        sum(rim.length for rim in rims), rel=0.01
    )
    assert not Live([DRIVE], server)._scene.navigation._map.visible


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
    replay = ReplayPage(Library(tmp_path / "result.zarr"), [0], server)
    for time in (1.3, 0.0):
        replay._scrub(time)
        replay.draw()
        check_movers(replay._scene, time)


WALLS = Obstacles(shapes=(Box(x=1.0, y=0.8, length=4.0, width=0.2), Box(x=3.0, length=0.2, width=4.0)))
SIDES = (1.0, -2.0, 4.2, 0.2), (-1.0, -0.5, 0.2, 3.0)  # x, y, length and width of two more, which close the room
ROOM = Task(obstacles=WALLS, start=(0.0, 0.0, 0.0), goal=(1.5, -0.6, -0.5))


def test_replay_of_a_mission(server, tmp_path):
    """Its plan is the reference, the outlines stand at start and goal, and the clearance is that of the result."""
    mission = navigate(ROOM, PID, compare=["model"])
    save(mission.result, tmp_path / "result.zarr")
    replay = ReplayPage(Library(tmp_path / "result.zarr"), [0, 1], server)
    for time, there in ((0.5, 0), (replay.duration, 2)):
        replay._scrub(time)
        replay.draw()
        replay.refresh()
        assert replay._status.content.count("has arrived") == there
    assert re.search(
        r"<b>PID alone, metrics of its whole way:</b>.*total variation of the voltage, both wheels: [\d.]+ V<",
        replay._status.content,
    )
    start, goal = replay._scene.navigation._ends
    assert start.visible and start.position[:2] == pytest.approx([0, 0], abs=1e-9)
    assert goal.position[:2] == pytest.approx([1.5, -0.6]) and 2 * np.arcsin(goal.wxyz[3]) == pytest.approx(-0.5)
    titles = {handle.title: handle for handle in replay._plots._handles}
    _, *drawn, _ = titles["clearance, m"].data
    for row, curve in enumerate(drawn):
        known = curve[np.isfinite(curve)]
        least = np.float32(mission.table["clearance"].iloc[row])  # as numbers of curves are
        assert least <= known.min() < least + 0.01
    times, log, clearance = joint_log(replay.recordings)
    found = charts(log, looks_of(replay.recordings, [0, 1]), replay.recordings[0].period, clearance)
    written = json.loads(_curves(times, found, []))["charts"]
    chart = next(chart for chart in written if chart["title"] == "clearance, m")
    exported = [min(v for v in curve["values"] if v is not None) for curve in chart["curves"]]
    assert exported == pytest.approx(mission.table["clearance"], abs=0.01)


def test_replay_of_different_goals(server, tmp_path):
    """Each run has its own reference, start and goal, at which it arrives; an overview shows all of them."""
    places = (
        ((0.0, 0.0, 0.0), (1.5, -0.6, -0.5)),
        ((0.0, -1.5, 0.0), (2.0, -1.5, 0.0)),
        ((0.0, 0.0, 0.0), (2.0, 0.3, 0.0)),
    )
    tasks = [Task(obstacles=WALLS, start=start, goal=goal) for start, goal in places]
    drives = [prepared(task, PID)[1].replace(name=f"{k}") for k, task in enumerate(tasks)]
    save(result := simulate(drives), tmp_path / "result.zarr")
    replay = ReplayPage(Library(tmp_path / "result.zarr"), [0, 1, 2], server)
    replay._scrub(replay.duration)
    replay.draw()
    replay.refresh()
    assert replay._status.content.count("has arrived") == 3
    marks = replay._scene.navigation._ends
    drawn = [tuple(np.round(mark.position[:2], 3).tolist()) for mark in marks if mark.visible]
    expected = [pose[:2] for pair in places for pose in pair]
    assert sorted(drawn) == sorted(expected)
    seen = shapely.MultiPoint(replay._scene._seen[:, :2]).convex_hull
    assert all(seen.covers(shapely.Point(place)) for place in expected)
    assert {label.anchor for label in replay._scene.robots._labels} == {
        "bottom-center"
    }  # above the robot, not beside it
    chart = replay._plots._handles[1]
    curves = dict(zip([series["label"] for series in chart.series], chart.data, strict=True))
    assert "reference" not in curves and "reference of each robot dashed" in replay._plots._legend.content
    for k in range(3):
        planned = result["v_ref"][k].interp(time=curves["s"]).values
        driven = np.isfinite(planned)
        assert driven.sum() > 30
        np.testing.assert_allclose(curves[f"{k} v reference"][driven], planned[driven], atol=1e-3)
    replay._show([1])
    replay.draw()
    assert [mark.position[1] for mark in replay._scene.navigation._ends if mark.visible] == pytest.approx([-1.5, -1.5])
    assert "reference" in [series["label"] for series in replay._plots._handles[1].series]


def numbers(page):
    """The numbers of the score, by heading and robot, NaN for a dash."""
    (found,) = pd.read_html(io.StringIO(page._plots._score.content), header=0, index_col=0, na_values=["–"])
    return found


ON_THE_WAY = ["off the timed plan now, mm", "RMS of that on the way, mm", "feedback on the way, %"]
ON_THE_WAY += ["energy on the way, J"]


def test_score_of_a_mission(server, tmp_path):
    """A mission has no laps: the numbers are those of its table at the goal, live and in replays, and stay so there."""
    mission = navigate(ROOM, PID, compare=["model"])
    of = per_lap(mission.result).isel(lap=0)
    expected = np.stack([1e3 * of.position_rmse, 100 * of.feedback_share, of.energy])
    assert expected[0] == pytest.approx(1e3 * mission.table["position_rmse"])
    save(mission.result, tmp_path / "result.zarr")
    replay = ReplayPage(Library(tmp_path / "result.zarr"), [0, 1], server)
    half = replay.duration / 2
    for time in (replay.duration, half):
        replay._scrub(time)
        replay.refresh()
        assert [*numbers(replay).index] == ON_THE_WAY
        assert (numbers(replay).values[1:4] == pytest.approx(expected, rel=6e-3)) == (time > half)
    assert numbers(replay).notna().all(axis=None)
    assert "excitation alone, on the way" in replay._plots._lessons.content
    _, own = prepared(ROOM, PID)
    live = Live([own.replace(goal=None), own.replace(goal=None, prior="model")], server)
    seen = {}
    for seconds in (0.5, 1.5, 2 * half + 1, 2 * half + 4):
        while live.session.time < seconds:
            live.session.step()
        live.refresh()
        seen[seconds] = numbers(live).values[1:4].astype(float)
    assert [*numbers(live).index] == ON_THE_WAY
    first, second, there, later = seen.values()
    assert np.isnan(first).all() and np.isfinite(second).all()
    assert there == pytest.approx(expected, rel=6e-3) and np.array_equal(there, later)
    live._look_back(half)
    live.refresh()
    energy = live.session.log(0, round(half / live.session.period))["power"].sum(axis=0) * live.session.period
    assert numbers(live).loc["energy on the way, J"].values == pytest.approx(energy, rel=6e-3)
    live._look_back(live.session.time)
    live._head_for((0.5, -1.2, np.pi))
    begun = live.session.tick
    for _ in range(300):
        live.session.step()
    live.refresh()
    energy = live.session.log(begun)["power"].sum(axis=0) * live.session.period
    assert numbers(live).loc["energy on the way, J"].values == pytest.approx(energy, rel=0.06)  # of this way alone


def test_laps_of_another_course(server):
    """Laps are those of the course that the robots follow: a new one begins with lap 1, of its own period."""
    live = Live([PID.replace(reference=Circle(radius=0.6, period=4.0))], server)
    for _ in range(450):
        live.session.step()
    live.refresh()
    assert " · lap 2 · " in live._status.content and numbers(live).loc["RMS of last lap, mm"].notna().all()
    live._apply_event(reference=Circle(radius=0.8, period=6.0))
    since = live.session.tick + live.session.preview
    for seconds, lap in ((5.9, 1), (6.5, 2)):
        while live.session.tick < since + round(seconds / live.session.period):
            live.session.step()
        live.refresh()
        assert f" · lap {lap} · " in live._status.content
    error = live.session.log(since, since + 600)
    off = 1e3 * np.sqrt(np.mean((error["x"] - error["x_ref"]) ** 2 + (error["y"] - error["y_ref"]) ** 2))
    assert numbers(live).loc["RMS of last lap, mm"].values == pytest.approx([off], rel=6e-3)


def test_clearance_live(server):
    """Beside a wall it is the distance of the wall less half the robot, less the error; saved, it is the same bits."""
    drive = DRIVE.replace(obstacles=WALLS, reference=Line(speed=0.5, length=1.0), initial_spread=(0, 0, 0))
    live = Live([drive], server)
    for tick in (100, 200):  # in parts, as the page asks for it
        while live.session.tick < tick:
            live.session.step()
        live.draw()
        live.refresh()
    known = live.session.clearance()
    assert known is not None
    log, clearance = live.session.log()[:, 0], known[:, 0]
    half = footprint(mjcf.load())[:, 1].max()
    assert clearance == pytest.approx(0.7 - half - log["y"], abs=2e-3)  # the heading is off by milliradians
    assert clearance.tobytes() == simulate(live.session.saved()[0])["clearance"].values.tobytes()
    handle = next(handle for handle in live._plots._handles if handle.title == "clearance, m")
    step = max(1, round(WINDOW / live.session.period) // SAMPLES)
    assert np.array_equal(handle.data[1], clearance[::step].astype(np.float32))
    assert not any(mark.visible for mark in live._scene.navigation._ends)  # a line has no end


@pytest.mark.parametrize("localisation", ["scan", "particles"])
def test_scan(server, localisation):
    """The points of the last scan are on the walls, and so are those of the picture; the particles are at the robot."""
    own = {"tier": "field", "localisation": localisation, "lidar": {"noise": 0.0, "beams": 60}}
    live = Live([DRIVE.replace(obstacles=WALLS, sensing=own)], server)
    assert live.session.scan(0) is None
    for _ in range(25):
        live.session.step()
    live.draw()
    points, particles = live._scene.navigation._scans
    x, y, z = points.points.T
    walls = shapely.union_all([shapely.Polygon(shape.vertices) for shape in WALLS.shapes])
    assert len(x) > 15 and points.visible and (z > 0.5).all()
    assert max(walls.boundary.distance(shapely.Point(*place)) for place in zip(x, y, strict=True)) < 1e-6
    assert len(particles.points) == (500 if localisation == "particles" else 0)
    if localisation == "particles":
        assert particles.points[:, :2].mean(axis=0) == pytest.approx(live.session.qpos(0)[:2], abs=0.1)


@pytest.mark.parametrize("who", ["particles", "window"])
def test_scans_of_a_replay(who, server, tmp_path, monkeypatch):
    """A replay, also of an interval, shows the scans that a localisation or an avoider got, to the last bit."""
    taken, scan = [], Lidar.scan

    def spy(lidar, pose, outlines, random):
        ranges = scan(lidar, pose, outlines, random)
        taken.append(turned(lidar.points(ranges), pose))
        return ranges

    with monkeypatch.context() as patch:
        patch.setattr(Lidar, "scan", spy)
        if who == "particles":
            sensing = {"tier": "field", "localisation": who, "lidar": {"beams": 60, "lost": 0.1}}
            result = simulate(DRIVE.replace(sensing=sensing, obstacles=Obstacles(shapes=(*WALLS.shapes, PASSING))))
        else:
            result = navigate(ROOM, PID, avoid="window").result
    scans, ticks = taken.copy(), result.sizes["time"]
    assert len(scans) == -(-ticks // 10) > 10 and sum(map(len, scans)) > 300  # ten a second
    for part in (result, result.isel(time=slice(77, 161))):
        save(part, folder := tmp_path / f"from_{float(part.time[0])}.zarr")
        library = Library(folder)
        recording = library.recording(int(library.table.index[0]))
        first = round(recording.start / recording.period)
        for index in range(len(recording.log)):
            last, found = (first + index) // 10, recording.scan(index)
            if 10 * last < first:
                assert found is None  # it was taken before the interval
            else:
                assert np.array_equal(found, scans[last])
    replay = ReplayPage(library, [int(library.table.index[0])], server)
    assert replay.recordings[0].label == {"particles": "PID alone", "window": "PID alone + window"}[who]
    replay.sensors.value = True
    replay._scrub(0.5)
    replay.draw()
    points = replay._scene.navigation._scans[0]
    assert points.visible and points.points[:, :2] == pytest.approx(scans[12], abs=1e-6)  # 1.27 s
    replay.sensors.value = False
    replay.draw()
    assert not points.visible
    other = simulate(DRIVE)  # nobody has a lidar
    save(other, tmp_path / "other.zarr")
    assert Library(tmp_path / "other.zarr").recording(0).scan(5) is None


@pytest.fixture(scope="module")
def driven():
    """A session in which the second goal was set on the way to the first one, and both robots drove on."""
    _, first = prepared(ROOM, PID)
    session = Session([first.replace(goal=None), first.replace(goal=None, prior="model")])
    for goal in ((2.0, -1.0, 0.0), (-0.5, -1.0, np.pi)):
        for _ in range(150):
            session.step()
        session.head_for(goal)
    for _ in range(900):
        session.step()
    return session


def test_goals_of_a_session(driven):
    """Both robots get one plan, which the first one is on from the beginning, and stand at the last goal in the end."""
    log, (first, other) = driven.log(), driven.saved()
    assert [e.time for e in first.events] == pytest.approx([1.51, 3.01]) and first.events == other.events
    for event in first.events:
        start = event.reference.sample(np.zeros(1))
        here = log[round(event.time / 0.01), 0]
        assert start.pose[0] == pytest.approx([here["x"], here["y"], here["theta"]], abs=1e-2)
        assert here["v"] > 0.3 and start.twist[0] == pytest.approx([here["v"], here["omega"]], abs=0.15)
    goal = np.array([-0.5, -1.0, np.pi])
    bound = ends(first, driven.time)
    assert bound is not None
    away = bound[1] - goal
    assert away[:2] == pytest.approx([0, 0], abs=1e-9)
    assert abs(np.angle(np.exp(1j * away[2]))) < 0.1  # the spline may turn a little at its end
    now = log[-1]
    assert arrived(np.stack([now["x"], now["y"], now["theta"]], -1), now["v"], goal).all()
    assert arrivals(["PID", "model"], now, 2 * [ends(first, driven.time)]) == ["PID has arrived", "model has arrived"]
    assert driven.clearance().min() > 0.0 and not driven.failure(0)


@pytest.mark.parametrize(("robot", "speed"), [("car", 0.7), ("racecar", 1.5)])
@pytest.mark.parametrize("goal", [(7.0, 0.5, 0.0), (4.0, -3.0, -1.57), (-1.0, 2.0, 3.1)])
def test_goal_on_the_way(robot, speed, goal):
    """A robot that gets a goal while it drives stays within 1 cm of the new plan in time: it does not have to brake.

    From rest the plans led to 11 cm for the car and 30 to 40 cm for the racing car.
    """
    own = Scenario.from_dict({"prior": "model", "learner": "none", "robot": {"path": robot}})
    far = Obstacles(shapes=(Disc(x=3.0, y=-8.0, radius=0.2),))
    task = Task(obstacles=far, start=(0.0, 0.0, 0.0), goal=(6.0, 1.0, 0.0))
    session = Session([prepared(task, own, speed)[1].replace(goal=None)])
    while session.time < session.start[0].reference.period / 2:
        session.step()
    assert session.log(session.tick - 1)["v"][0, 0] == pytest.approx(speed, abs=0.02)
    session.head_for(goal)
    (event,) = session.saved()[0].events
    while session.time < event.time + event.reference.period + 1:
        session.step()
    log = session.log(event.tick(session.period))[:, 0]
    assert np.hypot(log["longitudinal_error"], log["lateral_error"]).max() < 0.01
    now = log[-1]
    assert arrived(np.array([now["x"], now["y"], now["theta"]]), now["v"], np.array(goal))


def test_session_with_goals_runs_again(driven, tmp_path):
    """Saved, through a file, it gives the same bits."""
    again = []
    for k, scenario in enumerate(driven.saved()):
        (tmp_path / f"{k}.toml").write_text(scenario.to_toml())
        again.append(Scenario.from_toml(tmp_path / f"{k}.toml"))
    result, log = simulate(again), driven.log()
    for name in SIGNALS:
        assert result[name].values[:, : driven.tick].tobytes() == np.ascontiguousarray(log[name].T).tobytes(), name


CROSSING = Disc(x=-1.5, y=-2.0, radius=0.2, course=Line(heading=np.pi / 2, speed=0.6))  # from (2, −1.5) along +y


@pytest.mark.parametrize("avoid", ["window", "mppi"])
def test_avoiders(server, tmp_path, avoid):
    """Live they keep clear of what crosses their way; the page shows what they consider, and saves what repeats it."""
    task = Task(obstacles=Obstacles(shapes=(CROSSING,)), start=(0.0, 0.0, 0.0), goal=(2.5, 0.0, 0.0))
    plan, own = prepared(task, PID.replace(prior="model"), avoid=avoid)
    live = Live([own], server, avoid, plan.searched)
    session = live.session
    assert session.considered(0) is None and live._fan.visible and live._fan.value
    for _ in range(81):  # the last one decides
        session.step()
    live.draw()
    some, chosen = session.considered(0)
    stage, now = session._stages[0], session.log()[80, 0]
    assert np.allclose(some[:, 0], [now["x_measured"], now["y_measured"]], atol=0.02)  # it is predicted over the delay
    pose, sampled, best, last = stage.considered[0]
    for way, twists in zip([*some[::10], chosen], [*sampled[::10], best], strict=True):
        x, y, theta = pose
        steps, times = np.arange(len(twists) + 1.0), (np.arange(50.0 * len(twists)) + 0.5) / 50
        requested = [np.interp(times, steps, ends) for ends in np.vstack([last, twists]).T]  # linear over each step
        for v, omega in zip(*requested, strict=True):  # Euler, a millisecond each
            x, y, theta = x + 1e-3 * v * np.cos(theta), y + 1e-3 * v * np.sin(theta), theta + 1e-3 * omega
        assert way[-1] == pytest.approx([x, y], abs=3e-3)
    assert np.hypot(*(chosen[1] - chosen[0])) == pytest.approx(0.05 * (last[0] + stage.last[0, 0]) / 2)
    assert np.ptp(some[:, -1, 1]) > {"window": 0.3, "mppi": 0.5}[avoid]  # over 0.6 s, and 2.8
    lines = live._scene.navigation._fans[0]
    assert all(drawn.visible for drawn in lines) and np.allclose(lines[1].points[0, 0, :2], chosen[0], atol=1e-6)
    live._fan.value = False
    live.draw()
    assert not any(drawn.visible for drawn in lines)
    live._note_input(("reference",), "circle")
    live._apply_inputs()
    assert f"--avoid {avoid}" in live.message
    while session.running and session.time < 12:
        session.step()
    assert session.clearance().min() > 0
    live.refresh()
    assert "has arrived" in live._status.content
    for name, content in live.saved().items():
        (tmp_path / name).write_text(content)
    stage = runpy.run_path(str(tmp_path / f"{avoid}.py"))[avoid]  # as `mrctl run --controller` does
    again = simulate(Scenario.from_toml(tmp_path / "session-model.toml"), motion=stage)
    for name in ("x", "theta", "voltage_left"):
        assert again[name].values[: session.tick].tobytes() == session.log()[name][:, 0].tobytes()


@pytest.mark.parametrize("avoid", ["barrier", "window", "mppi"])
def test_another_goal(avoid, tmp_path):
    """With an avoider too, robots wait at their goal, and drive to another one, around a box that the map lacks."""
    wall, box = Box(x=3.0, y=-2.0, length=0.2, width=1.0), Box(x=2.3, y=2.2, length=0.3, width=0.3)
    known, goals = Obstacles(shapes=(wall,)), ((2.0, 0.0, 0.0), (2.3, 3.6, 1.5))
    shapes = (wall,) if avoid == "window" else (wall, box)  # whose corners the window may graze
    task = Task(obstacles=Obstacles(shapes=shapes), map=known, start=(0.0, 0.0, 0.0), goal=goals[0])
    base = PID.replace(prior="model", steering="rigid" if avoid == "barrier" else "compliant")
    own = prepared(task, base, avoid=avoid)[1].replace(goal=None)
    session = Session([own], avoid)

    def waits(goal, limit):
        while session.time < limit:
            for _ in range(10):
                session.step()
            now = session.log(session.tick - 1)[0]
            poses = np.stack([now[name] for name in ("x", "y", "theta")], axis=-1)
            if arrived(poses, now["v"], np.array(goal)).all():
                return True
        return False

    assert waits(goals[0], 15.0), (avoid, session.log(session.tick - 1)[0][["x", "y"]])
    session.head_for(goals[1])
    assert waits(goals[1], session.time + 40.0), (avoid, session.log(session.tick - 1)[0][["x", "y"]])
    assert session.running and session.clearance().min() > 0
    (saved,) = session.saved()
    laps = int(np.ceil(session.time / saved.reference.period))
    again = simulate(saved.replace(laps=laps), motion=avoiding(avoid))
    for name in ("x", "theta", "voltage_left"):
        driven = session.log()[name][:, 0]
        assert again[name].values[: len(driven)].tobytes() == np.ascontiguousarray(driven).tobytes(), name
    closed = saved.with_event(Event(time=0.5, reference=Circle())).replace(laps=1)
    says = f"^motion {avoid}: InputError: reference: robots with an avoider follow open waypoints"
    with pytest.raises(InputError, match=says):
        simulate(closed, motion=avoiding(avoid))
    if avoid == "mppi":
        with pytest.raises(InputError, match="^way: with --avoid mppi"):
            session.way([np.array([0.0, 0.0])], closed=False)


@pytest.mark.parametrize("avoid", ["none", "barrier", "window", "mppi"])
def test_inputs_with_an_avoider(server, avoid):
    """There are inputs for what can change alone: no gains where another law drives than Kanayama's, and no new way."""
    task = Task(obstacles=Obstacles(shapes=(CROSSING,)), start=(0.0, 0.0, 0.0), goal=(2.5, 0.0, 0.0))
    live = Live([prepared(task, PID, avoid=avoid)[1].replace(goal=None)], server, avoid)
    inputs, folders = live._controls._inputs, live._controls._records

    def shown():
        parts = {name: folders[name].visible for name in ("kanayama", "pid", "reference", "perturbation")}
        parts |= {name: inputs[name,].visible for name in ("world", "steering", "prefilter", "seed")}
        return {name for name, visible in parts.items() if visible} | ({"draw"} if live._hands._draw.visible else set())

    every = {"kanayama", "pid", "reference", "perturbation", "world", "steering", "prefilter", "seed", "draw"}
    planned = {"reference", "world", "steering", "draw"}
    gone = {"none": set(), "barrier": planned}.get(avoid, planned | {"kanayama"})
    assert shown() == every - gone
    if avoid != "none":
        with pytest.raises(InputError, match=f"^way: with --avoid {avoid}"):
            live._hands.draw_way()
        assert live.playing
    live._apply_event(pid={"time_constant": 0.3})
    assert shown() == every - gone
    if avoid != "window":
        live._note_input(("kanayama", "k_y"), 9.0)
        live._apply_inputs()
        assert bool(live.message) == (avoid == "mppi")
    live._begin([PID])  # which has no avoider
    assert shown() == every


@pytest.mark.parametrize("avoid", ["none", "window"])
def test_oscillations(avoid):
    """Each oscillation counts once, also beside an avoider, where two moves answer it."""
    task = Task(obstacles=Obstacles(shapes=(CROSSING,)), start=(0.0, 0.0, 0.0), goal=(2.5, 0.0, 0.0))
    session = Session([prepared(task, PID, avoid=avoid)[1]], avoid)
    ((_, sim),) = session.simulations
    for count in (1, 2):
        sim.hierarchy._move(0)
        assert session.oscillations == count


def test_search(server):
    """Its arcs hang together, come from the start, and are free; the page draws those of a goal that is set."""
    behind = Task(obstacles=Obstacles(shapes=(Box(x=1.5, length=0.2, width=1.0),)), start=(0, 0, 0), goal=(3, 0, 0))
    plan, own = prepared(behind, PID)
    ends = {tuple(end) for end in plan.searched[:, 1]} | {tuple(plan.poses[0, :2])}
    assert len(plan.searched) > plan.expanded / 2 > 5 and all(tuple(start) in ends for start in plan.searched[:, 0])
    walls = shapely.union_all([shapely.Polygon(shape.vertices) for shape in behind.obstacles.shapes])
    assert shapely.MultiPoint(plan.searched[:, 1]).distance(walls) > footprint(mjcf.load())[:, 1].max()
    live = Live([own.replace(goal=None)], server, "none", plan.searched)
    live._tree.value = True
    live._show_search()
    drawn = live._scene.navigation._search
    assert drawn.visible and np.allclose(drawn.points[..., :2], plan.searched, atol=1e-6)
    live._searched = live.session.head_for((3.0, -1.0, 0.0)).searched
    live._show_search()
    assert np.allclose(drawn.points[0, 0, :2], live.session.qpos(0)[:2], atol=1e-6) and len(drawn.points) == len(
        live._searched
    )
    live._tree.value = False
    live._show_search()
    assert not drawn.visible


def test_flags(server, monkeypatch):
    """`mrctl navigate --view` shows the mission's plan with robot and ghosts, and no run that ends at the goal."""
    shown = []
    monkeypatch.setattr(viewing, "_serve", lambda page, *address: shown.append((page(server), *address)))
    flags = ["--view", "--compare", "none", "--speed", "0.4", "--port", "8081"]
    assert main(["navigate", "doorway:3", *flags]) == 0
    ((live, host, port),) = shown
    scenario, other = live.session.start
    task = task_of("doorway:3", Scenario())
    assert (other.feedforward, host, port) == ("none", "127.0.0.1", 8081) and len(live._searched) > 10
    assert scenario.feedforward == "model+composite" and scenario.obstacles == task.obstacles
    assert scenario.reference.speed == 0.4 and scenario.initial_pose == task.start and scenario.goal is None
    bound = ends(scenario, 0.0)
    assert bound is not None and bound[:, :2] == pytest.approx(np.array([task.start, task.goal])[:, :2])


@pytest.mark.parametrize(
    ("goal", "says"),
    [
        ((3.0, 0.0, 0.0), "goal: the robot is in an obstacle"),
        ((2.0, 0.46, 0.0), "goal: the robot is 0.03"),
        ((9.0, 0.0, 0.0), "goal: there is no way"),
        ((2e4, 0.0, 0.0), "goal.x: "),
    ],
)
def test_no_way(goal, says):
    """What cannot be reached is said in one line, and the session goes on as it was."""
    closed = Obstacles(shapes=(*WALLS.shapes, *(Box(x=x, y=y, length=a, width=b) for x, y, a, b in SIDES)))
    session = Session([PID.replace(obstacles=closed, reference=Line(speed=0.2, length=1.0))])
    session.step()
    with pytest.raises(InputError, match=f"^{re.escape(says)}[^\n]*$"):
        session.head_for(goal)
    assert session.saved()[0].events == ()


@pytest.mark.parametrize("closed", [False, True])
def test_way(closed):
    """The robots leave their reference for a way through points, from where the first one is and looks."""
    slow = PID.replace(reference=Circle(radius=0.8, period=12.0))
    session = Session([slow, slow.replace(prior="model")])
    for _ in range(200):
        session.step()
    x, y, theta = session.qpos(0)[:2].tolist() + [session.log()["theta"][-1, 0]]
    turn = np.array([[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]])
    points = [turn @ point + [x, y] for point in ((1.5, 0.5), (1.0, 1.5), (-0.5, 0.8))]
    way = session.way(points, closed)
    session.apply(reference=way)
    for _ in range(round(1.2 * way.period / session.period)):
        session.step()
    driven = session.log(200)
    path = shapely.LineString(np.stack([driven["x"][:, 0], driven["y"][:, 0]], axis=1))
    assert max(path.distance(shapely.Point(point)) for point in points) < 0.02
    off = np.hypot(driven["longitudinal_error"], driven["lateral_error"])
    assert off[round(2 / session.period) :].max() < 0.02 and abs(driven["theta"][:60] - theta).max() < 0.4
    assert session.failure(0) == session.failure(1) == ""
    if not closed:
        assert np.hypot(*(session.qpos(0)[:2] - points[-1])) < 0.01 and driven["v"][-1, 0] < 0.01


@pytest.mark.parametrize(
    ("points", "says"),
    [
        ([(4.0, 0.0)], r"way: meets an obstacle near \((2|1)\.\d+, -?0\.\d+\) m"),
        ([(1.0, 0.02), (0.9, 0.0)], "reference waypoints: steering angle"),
        ([(1.0, 0.0), (1.0, 0.0)], "points: 2 and 3 coincide"),
    ],
)
def test_no_such_way(points, says):
    """A way through a wall, or one that is too narrow for the robot, is refused before it drives."""
    session = Session([PID.replace(obstacles=WALLS, reference=Line(speed=0.2, length=1.0))])
    session.step()
    with pytest.raises(InputError, match=f"^{says}[^\n]*$"):
        session.way([np.array(point) for point in points], closed=False)


def test_clicks(server):
    """Two clicks on the floor are place and direction of a goal, also where the camera follows; the sky is refused."""
    live = Live([PID.replace(reference=Line(speed=0.2, length=1.0))], server)
    live.session.step()
    live._follow.value = True
    live.draw()
    live._hands.await_goal()
    with pytest.raises(InputError, match="no floor"):
        live._hands.click(np.array([0.0, 0, 1]), np.array([1.0, 0, 0.1]))
    here = live._scene._root.position
    for x, y in ((2.0, 1.0), (2.0, 2.0)):
        live._hands.click(np.array([x - 3, y, 3.0]) + here, np.array([1.0, 0, -1]))
    (event,) = live.session.saved()[0].events
    bound = ends(live.session.saved()[0], 1.0)
    assert bound is not None and bound[1] == pytest.approx([2, 1, np.pi / 2], abs=0.1)
    assert "way to (2.00, 1.00) m" in live._timeline.content and live._hands._picking.content == ""
    live.refresh()
    goal = live._scene.navigation._ends[1]
    assert goal.visible and goal.position[:2] == pytest.approx([2, 1])
    assert event.time == 0.01 * (1 + live.session.preview)


TO_SCREEN = """([x, y]) => {
    const m = window.__viserMutable, point = new m.camera.position.constructor(x, y, 0);
    m.nodeRefFromName['/world'].localToWorld(point).project(m.camera);
    const r = m.canvas.getBoundingClientRect();
    return [r.left + (point.x + 1) / 2 * r.width, r.top + (1 - point.y) / 2 * r.height];
}"""


IN_PICTURE = """(points) => {
    const m = window.__viserMutable;
    return points.map((point) => {
        const place = m.nodeRefFromName['/world'].localToWorld(new m.camera.position.constructor(...point));
        const { x, y } = place.project(m.camera);
        return [x, y];
    });
}"""


@pytest.mark.parametrize("goal", [(8.0, 0.5, 0.0), (0.5, 6.0, 1.5), (1.0, 0.2, 0.3)])
def test_to_see(server, goal):
    """An overview shows start, goal, obstacles and where they go; of what is far off, a plan's size around it."""
    passing = Disc(x=0.5, y=-1.0, radius=0.2, course=Line(speed=0.4, length=1.0))
    far = Box(x=60.0, length=0.2, width=90.0)
    task = Task(obstacles=Obstacles(shapes=(*WALLS.shapes[:1], passing, far)), start=(0, 0, 0), goal=goal)
    live = Live([prepared(task, PID)[1]], server)
    seen, hull = shapely.MultiPoint(live._scene._seen[:, :2]).convex_hull.buffer(1e-6), footprint(mjcf.load())
    for x, y, theta in (task.start, task.goal):
        turn = np.array([[np.cos(theta), np.sin(theta)], [-np.sin(theta), np.cos(theta)]])
        assert seen.covers(shapely.Polygon(hull @ turn + [x, y]))
    for y in (-1.0, 0.0):  # of the course
        assert seen.buffer(0.01).covers(shapely.Point(0.5, y).buffer(0.2))
    size = max(1.2, goal[0], goal[1])
    assert seen.bounds[2] < goal[0] + 1.5 * size and live._scene._seen[:, 2].max() == pytest.approx(0.5)
    near = task.replace(obstacles=Obstacles(shapes=task.obstacles.shapes[:-1]))
    alone = Live([prepared(near, PID)[1].replace(reference=live.session.start[0].reference)], server)
    assert np.array_equal(alone._scene._seen, live._scene._seen)


@pytest.mark.skipif(CHROMIUM is None, reason="needs chromium")
def test_goal_by_click(tmp_path):
    """A visitor clicks twice on the floor: robot and ghost go there and look there; a goal in a wall is refused."""
    from playwright.sync_api import sync_playwright

    _, first = prepared(ROOM, PID)
    scenarios = [first.replace(goal=None), first.replace(goal=None, prior="model")]

    def place(page, name):
        found = node(page, name)
        return None if found is None else found[:2]

    def click(page, *places):
        page.get_by_text("Set a goal", exact=True).click()
        for place, says in zip(places, ("shall go", "shall look"), strict=True):
            until(lambda says=says: says in page.inner_text("#mrctl-picking"), says)
            page.mouse.click(*page.evaluate(TO_SCREEN, list(place)))

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=SOFTWARE)
        known = [DRAG_ERROR]
        with serving(lambda server: Live(scenarios, server)) as (live, url), visit(browser, url, known=known) as page:
            until(lambda: node(page, ROBOT) is not None, "the scene")
            page.locator(".mantine-Notification-closeButton").click()  # that rendering is in software

            def edges():
                places = np.array(page.evaluate(IN_PICTURE, live._scene._seen.tolist()))
                return places.min(axis=0), places.max(axis=0)

            for width in (1280, 1500):  # the overview fits into the picture, whatever its shape is
                page.set_viewport_size({"width": width, "height": 800})
                until(lambda: np.abs(edges()).max() == pytest.approx(FILLED_SHARE, abs=1e-3), "a full picture")
                assert edges()[0] == pytest.approx(-edges()[1], abs=2e-3)
            click(page, (0.9, -0.5), (0.9, -1.2))
            until(lambda: len(live.session.saved()[0].events) == 1, "the plan")
            set_at = live.session.saved()[0].events[0].time
            until(lambda: place(page, "/world/goal/0") == pytest.approx([0.9, -0.5], abs=0.03), "the goal in sight")
            page.set_viewport_size({"width": 1280, "height": 800})
            until(
                lambda: np.abs(edges()).max() == pytest.approx(FILLED_SHARE, abs=1e-3), "a full picture of the new way"
            )
            live.ask(live.choose_speed, "as fast as it goes")
            until(lambda: live.session.time > set_at + 2, "the robots to drive")
            until(lambda: page.inner_text("#mrctl-status").count("has arrived") == 2, "the robots at the goal")
            live.ask(live._command, "pause")
            until(lambda: "paused" in page.inner_text("#mrctl-status"), "the pause")
            x, y, theta = (live.session.log()[-1][name] for name in ("x", "y", "theta"))
            assert np.hypot(x - 0.9, y + 0.5).max() < 0.1 and np.abs(theta + np.pi / 2).max() < 0.2
            click(page, (1.0, 0.72), (2.0, 0.72))
            until(lambda: "in an obstacle" in page.inner_text("#mrctl-message"), "the refusal")
            assert [len(saved.events) for saved in live.session.saved()] == [1, 1]
            page.screenshot(path=tmp_path / "goal.png", timeout=PATIENCE)
        browser.close()
