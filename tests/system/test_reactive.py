"""Reactive missions: robots that go along their plans in their own time, around what moves and what no map shows."""

import numpy as np
import pytest
from test_batch_equals_single import equal

import mrctl
from mrctl import Box, Disc, Event, InputError, Obstacles, Scenario, simulate
from mrctl.loop.groups import arranged, uniform
from mrctl.navigation import avoiders
from mrctl.navigation.avoiders import avoiding
from mrctl.navigation.generators import Task
from mrctl.navigation.mission import navigate
from mrctl.navigation.mppi import Mppi, twists_along
from mrctl.navigation.planning import Avoid, Query, planned, prepared, speed_in_horizon
from mrctl.navigation.replanning import Planner
from mrctl.navigation.rollouts import KNOTS, STEPS, Bounds, Scene, roll_out
from mrctl.navigation.tasks import task_of
from mrctl.navigation.vehicle import Vehicle
from mrctl.sensing.lidar import Lidar
from mrctl.theory.clearance import clearance, cover
from mrctl.theory.grid import field_of
from mrctl.theory.obstacles import Surroundings
from mrctl.theory.rays import Scan
from mrctl.theory.references import Waypoints
from mrctl.theory.robot import RobotFile

PLANNED = Scenario(prior="model", learner="none")
REACTIVE: tuple[Avoid, ...] = ("window", "mppi")
AVOIDERS: tuple[Avoid, ...] = ("barrier", *REACTIVE)
FOOTPRINT = np.array([[-0.1, -0.2], [0.44, -0.2], [0.44, 0.2], [-0.1, 0.2]])
BOUNDS = Bounds(1.3, 2.7, 3.9, 1.35, 5.4)


@pytest.fixture(autouse=True)
def fewer(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """`mppi` has a quarter of its samples, which makes it harder, but where its smoothness or nearness is judged."""
    if request.function not in (test_smooth, test_crossing):
        monkeypatch.setattr("mrctl.navigation.mppi.SAMPLES", 500)


def crossing(speed: float, side: int = 1) -> Disc:
    """A disc that crosses x = 2 m along ±y, from y = ∓1.5 m on; its own x axis is that of its course."""
    return Disc(x=-1.5, y=-2.0 * side, radius=0.2, course=mrctl.Line(heading=side * np.pi / 2, speed=speed))


def test_roll_out() -> None:
    """Twists stay within the bounds, their roll-outs touch what their poses touch, and detours cost more."""
    random = np.random.default_rng(0)
    still = Obstacles(shapes=(Disc(x=1.2, y=0.7, radius=0.3), Box(x=0.5, y=-1.0, length=1.0, width=0.2)))
    around = Surroundings(still).at(0.0)
    field = field_of(around, np.array([-2.0, -3.0]), np.array([5.0, 3.0]), 0.02)
    ahead = 0.05 * np.arange(1.0, STEPS + 1)
    targets = np.column_stack([ahead, np.zeros(STEPS), np.ones(STEPS), np.zeros(STEPS)])
    discs = cover(FOOTPRINT, 4)
    mover = np.array([[2.0, -1.5, 0.0, 0.6, 0.2]])
    knots = random.normal(size=(200, KNOTS, 2)) * [0.5, 1.5]
    knots[0] = 0.0
    twists, costs = np.empty((200, STEPS, 2)), np.empty(200)
    start, last = np.zeros(3), np.array([1.0, 0.0])
    scene = Scene(targets, discs, field, mover)
    roll_out(knots, np.tile(last, (STEPS, 1)), start, last, last, 0.0, 0.05, BOUNDS, scene, np.inf, twists, costs)
    v, omega = twists[..., 0], twists[..., 1]
    assert v.min() >= 0 and v.max() <= BOUNDS.speed and np.abs(omega).max() <= BOUNDS.rotation
    assert np.all(np.abs(omega) <= BOUNDS.curvature * v + 1e-12)
    assert np.abs(np.diff(v, axis=1, prepend=1.0)).max() <= BOUNDS.acceleration * 0.05 * (1 + 1e-9)
    verdicts = []
    for sample, cost in zip(twists, costs, strict=True):
        pose, free = np.zeros(3), np.inf
        for k, (speed, turn) in enumerate((sample + np.vstack([last, sample[:-1]])) / 2):  # means over the steps
            middle = pose[2] + turn * 0.025
            pose = pose + 0.05 * np.array([speed * np.cos(middle), speed * np.sin(middle), turn])
            moved = Surroundings(
                Obstacles(shapes=(*still.shapes, Disc(x=2.0, y=-1.5 + 0.03 * (k + 1), radius=0.2)))
            ).at(0.0)
            c, s = np.cos(pose[2]), np.sin(pose[2])
            for x, y, radius in discs:
                point = np.array([[1e-6, 0], [0, 1e-6], [-1e-6, 0]])
                centre = np.array([pose[0] + c * x - s * y, pose[1] + s * x + c * y, 0.0])
                free = min(free, clearance(point, centre, moved) - radius)
        if abs(free) > 0.03:  # of the interpolated field
            verdicts.append(free < 0)
            assert (cost >= 1000) == (free < 0)
    assert 20 < sum(verdicts) < len(verdicts) - 20
    judged, same = costs.copy(), twists.copy()
    roll_out(knots, np.tile(last, (STEPS, 1)), start, last, last, 0.0, 0.05, BOUNDS, scene, 20.0, twists, costs)
    np.testing.assert_array_equal(twists, same)
    cheapest = np.minimum.accumulate(np.concatenate([[np.inf], judged[:-1]]))  # before each
    worth = judged <= cheapest + 20.0
    np.testing.assert_array_equal(costs[worth], judged[worth])
    assert np.all((cheapest + 20.0 < costs)[~worth] & (costs <= judged)[~worth])
    assert worth.sum() > 10 and (costs < judged).sum() > 10


def test_rotation_falls_no_faster_than_it_can() -> None:
    """A robot that brakes in its tightest curve creeps on until its θ̇ has fallen, instead of turning on at rest."""
    bounds, knots = Bounds(0.6, 2.8, 20.0, 0.5, 0.4), np.zeros((2, KNOTS, 2))
    knots[1, :, 1] = 0.5
    field = field_of(Surroundings(Obstacles()).at(0.0), np.array([-3.0, -3.0]), np.array([3.0, 3.0]), 0.1)
    scene = Scene(np.tile([1.0, 0.0, 1.0, 0.0], (STEPS, 1)), cover(FOOTPRINT, 4), field, np.empty((0, 5)))
    twists, costs, last = np.empty((2, STEPS, 2)), np.empty(2), np.array([0.03, 0.6])
    state = np.zeros(3), last, last, 0.0, 0.05, bounds, scene
    roll_out(knots, np.zeros((STEPS, 2)), *state, np.inf, twists, costs)
    v, omega = twists[0].T
    np.testing.assert_allclose(omega, np.maximum(0.6 - 0.4 * 0.05 * np.arange(1, STEPS + 1), 0.0), atol=1e-12)
    np.testing.assert_allclose(v, omega / bounds.curvature, atol=1e-12)  # 0.03 m/s is the V of 0.6 rad/s
    assert np.abs(np.diff(twists[..., 1], axis=1)).max() <= 0.4 * 0.05 + 1e-12


def test_touching_already() -> None:
    """A robot whose discs touch something already may go on beside it or away, and not deeper; it may stand."""
    empty = field_of(Surroundings(Obstacles()).at(0.0), np.array([-3.0, -3.0]), np.array([3.0, 3.0]), 0.1)
    targets, body = np.tile([1.0, 0.0, 1.0, 0.0], (STEPS, 1)), np.array([[0.0, 0.0, 0.3]])
    twists, costs = np.empty((2, STEPS, 2)), np.empty(2)
    knots = np.zeros((2, KNOTS, 2))
    knots[1, :, 0] = -1.0  # stands
    for x, y, deeper in ((-0.25, 0.0, False), (0.25, 0.0, True)):  # 5 cm into the robot, behind it and ahead of it
        scene = Scene(targets, body, empty, np.array([[x, y, 0.0, 0.0, 0.0]]))
        last = np.array([0.5, 0.0])
        state = np.zeros(3), last, last, 0.0, 0.05, BOUNDS, scene
        roll_out(knots, np.tile(last, (STEPS, 1)), *state, np.inf, twists, costs)
        assert (costs[0] >= 1000) == deeper
    for depth, step in ((0.002, 0.004), (0.008, 0.001), (0.05, -1e-4)):  # it may end up to 1 cm deep, if it is not yet
        scene = Scene(targets, body, empty, np.array([[0.3 - depth, 0.0, 0.0, 0.0, 0.0]]))
        for far, touches in ((step, False), (step + 0.002, True)):
            request = np.zeros((STEPS, 2))
            request[0, 0] = far / 0.05  # m/s; it drives half of it in the first step, and half in the second
            state = np.zeros(3), np.zeros(2), np.zeros(2), 0.0, 0.05, BOUNDS._replace(acceleration=100.0), scene
            roll_out(np.zeros((1, KNOTS, 2)), request, *state, np.inf, twists[:1], costs[:1])
            assert (costs[0] >= 1000) == touches, (depth, far)


def test_lag() -> None:
    """A roll-out with a lag goes where a fine integration of the lag and the unicycle goes, and not where none goes."""
    lag, start, began, last = 0.15, np.array([0.3, -0.2, 0.5]), np.array([0.4, 0.0]), np.array([1.0, 0.6])
    parts, request = 500, np.tile(last, (STEPS, 1))
    request[20:] = 0.7, -0.8
    request[20:28] = np.linspace(last, request[-1], 9)[1:]  # as fast as the bounds allow
    pose, twist, targets = start.copy(), began.copy(), np.empty((STEPS, 4))
    for k in range(STEPS):
        for share in (np.arange(parts) + 0.5) / parts:  # of the way from one request to the next
            h, before = 0.05 / parts, request[k - 1] if k else last
            pose += h * np.array([twist[0] * np.cos(pose[2]), twist[0] * np.sin(pose[2]), twist[1]])
            twist += h * (before + share * (request[k] - before) - twist) / lag
        targets[k] = *pose[:2], np.cos(pose[2]), np.sin(pose[2])
    field = field_of(Surroundings(Obstacles()).at(0.0), np.array([-3.0, -3.0]), np.array([3.0, 3.0]), 0.1)
    scene = Scene(targets, cover(FOOTPRINT, 4), field, np.empty((0, 5)))
    twists, costs, found = np.empty((1, STEPS, 2)), np.empty(1), []
    for tried in (lag, 0.0, 0.5 * lag):
        state = start, began, last, tried, 0.05, BOUNDS, scene
        roll_out(np.zeros((1, KNOTS, 2)), request, *state, np.inf, twists, costs)
        np.testing.assert_allclose(twists[0], request, atol=1e-12)
        found.append(costs[0])
    assert found[0] < 1e-5 and found[1] > 0.1 and found[2] > 0.01
    with pytest.raises(mrctl.InputError, match="^lag: "):
        Mppi(mrctl.load_robot("car"), 1, lambda *_: None, lag=-0.1)


@pytest.mark.parametrize("avoid", ["window", "mppi"])
def test_smooth(avoid: Avoid) -> None:
    """An avoider needs less energy than following the plan in time, and its voltage changes but a few times as much."""
    base = mrctl.Scenario.from_dict({"prior": "model", "learner": "composite"})
    task, used = task_of("doorway:11", base), {}
    for way in ("none", avoid):
        mission = navigate(task, base, avoid=way)
        steps = np.diff(mission.result["voltage_left"].values[0])
        used[way] = float(mission.table["energy"].iloc[0]), float(np.sqrt(np.nanmean(steps**2)))
    assert used[avoid][0] < used["none"][0]
    assert used[avoid][1] < 3 * used["none"][1]  # V from tick to tick


def test_crossing() -> None:
    """A disc that crosses is hit by a robot in track mode, and passed in reactive mode."""
    shapes = (Disc(x=2.0, y=1.6, radius=0.2), crossing(0.6))
    task = Task(obstacles=Obstacles(shapes=shapes), start=(0.0, 0.0, 0.0), goal=(4.0, 0.0, 0.0))
    assert navigate(task, PLANNED).table["outcome"].tolist() == ["collided"]
    for avoid in REACTIVE:
        table = navigate(task, PLANNED, avoid=avoid).table
        assert table["outcome"].tolist() == ["arrived"] and table["clearance"].iloc[0] > 0.03, avoid


def test_what_the_map_lacks() -> None:
    """A box that the map lacks is hit by a robot that looks at its map alone; the lidar shows it to the others."""
    wall, box = Box(x=2.0, y=1.5, length=5.0, width=0.2), Box(x=2.0, y=0.1, length=0.3, width=0.8)
    task = Task(obstacles=Obstacles(shapes=(wall, box)), map=Obstacles(shapes=(wall,)), start=(0, 0, 0), goal=(4, 0, 0))
    assert navigate(task, PLANNED).table["outcome"].tolist() == ["collided"]
    for avoid in AVOIDERS:
        driven = navigate(task, PLANNED, avoid=avoid)
        assert np.abs(driven.plan.poses[:, 1]).max() < 0.01  # straight through the box
        assert driven.table["outcome"].tolist() == ["arrived"] and driven.table["clearance"].iloc[0] > 0.03, avoid


@pytest.mark.parametrize("start", [1.5, 1.8, 2.0])
def test_keeps_off(start: float) -> None:
    """`window` keeps a distance from a box that the map lacks, whose far side the robot sees late."""
    box = Box(x=2.3, y=2.2, length=0.5, width=0.5)
    task = Task(obstacles=Obstacles(shapes=(box,)), map=Obstacles(), start=(start, 0.0, 0.0), goal=(2.3, 3.8, 1.5))
    driven = navigate(task, PLANNED, avoid="window")
    assert driven.table["outcome"].tolist() == ["arrived"] and driven.table["clearance"].iloc[0] > 0.03


@pytest.mark.parametrize("avoid", ["window", "mppi"])
def test_slow(avoid: Avoid, monkeypatch: pytest.MonkeyPatch) -> None:
    """A robot whose largest speed is 2 cm/s drives at about that speed, and needs no other plan as one that waits."""
    searches = []
    monkeypatch.setattr(avoiders, "planned", lambda *query, **how: searches.append(query) or planned(*query, **how))
    task = Task(obstacles=Obstacles(shapes=(Disc(x=0.3, y=0.5),)), start=(0, 0, 0), goal=(0.22, 0.0, 0.0))
    driven = navigate(task, PLANNED, speed=0.02, avoid=avoid)
    (row,) = driven.table.itertuples()
    assert row.outcome == "arrived" and row.time < 1.3 * row.length / 0.02 and float(driven.result["v"].min()) > -0.01
    assert not searches


def test_control_period() -> None:
    """The motion period is 0.05 s, or the multiple of another control period next to that."""
    task = Task(obstacles=Obstacles(), start=(0, 0, 0), goal=(1, 0, 0))
    assert prepared(task, PLANNED, avoid="mppi")[1].motion_period == 0.05
    slow = PLANNED.replace(control_period=0.02, motion_period=0.02)
    assert prepared(task, slow, avoid="mppi")[1].motion_period == 0.04
    assert navigate(task, slow, avoid="window").table["outcome"].tolist() == ["arrived"]


def test_pace_between_calls() -> None:
    """With a motion period of five control periods the pace changes linearly: V exceeds neither the plan nor zero."""
    wall = Obstacles(shapes=(Box(x=2.9, length=0.1, width=3.0),))
    task = Task(obstacles=wall, map=Obstacles(), start=(0, 0, 0), goal=(5, 0, 0))
    driven = navigate(task, PLANNED.replace(motion_period=0.05), avoid="barrier")
    command = driven.result["v_command"].values[0]
    assert 1.353 > np.nanmax(command) > 1 and np.nanmin(command) > -0.01  # m/s; the plan has 1.35
    assert driven.table["clearance"].iloc[0] > 0.03


def test_backs_off() -> None:
    """A robot with rigid steering that stands close before a box that the map lacks reverses to go around it."""
    box = Box(x=0.8, y=0.0, length=0.3, width=1.0)
    task = Task(obstacles=Obstacles(shapes=(box,)), map=Obstacles(), start=(0, 0, 0), goal=(3, 0, 0))
    driven = navigate(task, PLANNED.replace(steering="rigid"), avoid="barrier")
    assert driven.table["outcome"].tolist() == ["arrived"] and float(driven.result["v"].min()) < -0.1


@pytest.mark.parametrize(("robot", "avoid"), [("turtlebot", "window"), ("turtlebot", "mppi"), ("car", "window")])
def test_dead_end(robot: str, avoid: Avoid) -> None:
    """A robot that can reverse leaves a dead end which its map lacks, and in which it cannot turn; the car cannot.

    They see no farther than 1.2 m, and so are in it when they see its end.
    """
    wide = 0.7 if robot == "turtlebot" else 0.8
    sides = [Box(x=1.5, y=side * (wide / 2 + 0.05), length=1.6, width=0.1) for side in (-1, 1)]
    task = Task(
        obstacles=Obstacles(shapes=(*sides, Box(x=2.35, length=0.1, width=wide + 0.2))),
        map=Obstacles(),
        start=(0, 0, 0),
        goal=(3.15, 0, 0),
    )
    short = {"lidar": {"range": 1.2}}
    own = Scenario.from_dict({"prior": "model", "learner": "none", "robot": {"path": robot}, "sensing": short})
    driven = navigate(task, own, avoid=avoid)
    run, found = driven.result.isel(run=0), driven.table.iloc[0]
    went_back = int(np.argmax(run["v"].values < -0.1)) or run.sizes["time"]  # a sample, from which on it goes back
    way_in = run.isel(time=slice(went_back))
    assert float(way_in["x"].max()) > 1.1 and float(abs(way_in["y"]).max()) < wide / 2 and found["clearance"] > 0.03
    back = -own.control_period * float(run["v"].where(run["v"] < 0, 0.0).sum())
    assert (found["outcome"], back > 0.3) == (("arrived", True) if robot == "turtlebot" else ("stuck", False))


@pytest.mark.parametrize("avoid", AVOIDERS)
def test_short_sight(avoid: Avoid) -> None:
    """A car that sees no farther than 0.8 m stops before a wall that its map lacks."""
    wall = Obstacles(shapes=(Box(x=2.8, length=0.1, width=20.0),))
    task = Task(obstacles=wall, map=Obstacles(), start=(0, 0, 0), goal=(3.5, 0, 0))
    driven = navigate(task, PLANNED.replace(sensing={"lidar": {"range": 0.8}}), avoid=avoid)
    assert float(driven.result["x"].max()) > 2 and driven.table["outcome"].tolist() == ["stuck"]


@pytest.mark.parametrize("seen", [0.6, 0.9, 1.3])
def test_speed_in_sight(seen: float) -> None:
    """A mission is so slow that the robot can stop within the range of its lidar."""
    empty = Task(obstacles=Obstacles(), start=(0, 0, 0), goal=(3, 0, 0))
    near = PLANNED.replace(sensing={"lidar": {"range": seen}})
    plan = prepared(empty, near, avoid="window")[1].reference
    robot, nose = Vehicle.of(near).robot, float(Vehicle.of(near).footprint[:, 0].max())
    assert plan.speed * (0.1 + 0.15) + plan.speed**2 / (2 * 0.9 * robot.max_acceleration) == pytest.approx(
        seen - nose - 0.02
    )
    far = prepared(empty, PLANNED, avoid="window")[1].reference
    assert plan.speed < far.speed == pytest.approx(0.9 * robot.max_speed)
    assert prepared(empty, near, avoid="none")[1].reference.speed == far.speed
    assert prepared(empty, near, avoid="barrier")[1].reference.speed == plan.speed
    assert prepared(empty, near, 0.1, avoid="mppi")[1].reference.speed == 0.1
    with pytest.raises(InputError, match="^sensing.lidar: with a range of 0.4 m and a rate of 10 Hz the robot cannot"):
        prepared(empty, PLANNED.replace(sensing={"lidar": {"range": 0.4}}), avoid="mppi")


def test_speed_in_horizon() -> None:
    """A robot with weak brakes is so slow that it can stop within a roll-out, with `window` and `mppi`."""
    vehicle = Vehicle.of(PLANNED)
    weak = vehicle._replace(robot=vehicle.robot.replace(max_acceleration=0.2))
    assert 0.15 + speed_in_horizon(weak) / (0.9 * 0.2) == pytest.approx(STEPS * 0.05)


@pytest.mark.parametrize(("avoid", "seconds"), [("window", 16.0), ("mppi", 13.0)])
def test_no_way_on(avoid: Avoid, seconds: float) -> None:
    """A car before a wall that its map lacks, with no way around it, stands there; it does not creep into it."""
    sides = Box(x=2, y=0.6, length=8, width=0.2), Box(x=2, y=-0.6, length=8, width=0.2)
    ends = Box(x=-2, length=0.2, width=1.4), Box(x=6, length=0.2, width=1.4)
    world = Obstacles(shapes=(*sides, *ends, Box(x=2.5, length=0.2, width=1.0)))
    task = Task(obstacles=world, map=Obstacles(shapes=(*sides, *ends)), start=(0, 0, 0), goal=(4, 0, 0))
    own = prepared(task, PLANNED, avoid=avoid)[1]
    own = own.replace(goal=None, laps=int(np.ceil(seconds / own.reference.period)))
    run = simulate([own], motion=avoiding(avoid)).isel(run=0)
    assert run["failure"] == "" and float(run["time"].max()) > seconds
    assert float(run["clearance"][-1]) > 0.14 and float(abs(run["v"][-500:]).max()) < 0.01


def test_starts_before_a_wall() -> None:
    """Robots that stand 5 cm before a wall that their maps lack do not touch it."""
    for robot in ("car", "turtlebot"):
        scenario = PLANNED.replace(robot=RobotFile(path=robot))
        wall = Box(x=Vehicle.of(scenario).footprint[:, 0].max() + 0.2, length=0.3, width=2.0)
        known = Obstacles(shapes=(Box(x=2, y=3.0, length=6, width=0.2),))
        task = Task(obstacles=Obstacles(shapes=(*known.shapes, wall)), map=known, start=(0, 0, 0), goal=(5, 0, 0))
        (row,) = navigate(task, scenario, avoid="window").table.itertuples()
        assert row.outcome == "stuck" and row.clearance > 0.02


@pytest.mark.parametrize("goal", [(0.03, -0.12, -0.73), (-0.43, 0.0, -1.67)])
def test_goal_beside(goal: tuple[float, float, float]) -> None:
    """With `mppi` a car drives the loop to a goal beside or behind it, about as fast as its plan."""
    task = Task(obstacles=Obstacles(), start=(0.0, 0.0, 0.0), goal=goal)
    driven = navigate(task, PLANNED, avoid="mppi")
    (row,), period = driven.table.itertuples(), prepared(task, PLANNED, avoid="mppi")[1].reference.period
    assert row.outcome == "arrived" and row.time < period + 0.3


def test_twists_along() -> None:
    """The twists from target to target of a circle are its V and θ̇, across ±π too."""
    angles = 2.5 + 0.04 * np.arange(STEPS)
    targets = np.column_stack([0.8 * np.sin(angles), -0.8 * np.cos(angles), np.cos(angles), np.sin(angles)])
    chord = 2 * 0.8 * np.sin(0.02)
    np.testing.assert_allclose(twists_along(targets, 0.05), np.tile([chord / 0.05, 0.8], (STEPS, 1)), rtol=1e-9)


@pytest.mark.parametrize("avoid", REACTIVE)
def test_loop_from_where_it_rests(avoid: Avoid) -> None:
    """A robot that rests at the end of its plan drives another one that ends there."""
    task = Task(obstacles=Obstacles(), start=(0.0, 0.0, 0.0), goal=(1.0, 0.0, 0.0))
    own = prepared(task, PLANNED, avoid=avoid)[1]
    points = ((1.0, 0.0), (1.7, 0.0), (2.2, 0.5), (1.7, 1.0), (1.0, 1.0), (0.3, 0.5), (0.6, 0.03), (1.0, 0.0))
    loop = Waypoints(points=points, closed=False, timing="limits", speed=0.8)
    rests = Event(time=own.reference.period + 3.0, reference=loop)
    laps = int(np.ceil((rests.time + 2.5) / own.reference.period))
    run = simulate([own.replace(goal=None, laps=laps, events=(rests,))], motion=avoiding(avoid)).isel(run=0)
    assert run["failure"] == "" and float(run["x"].max()) > 1.8


@pytest.mark.parametrize(("turned", "plans"), [(0.15, 0), (0.25, 2)])
def test_turned_at_goal(turned: float, plans: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """A robot that rests at its goal, but turned by more than 0.2 rad, plans again each second; by less, it stays."""
    task = Task(obstacles=Obstacles(shapes=(Box(x=6.0, length=0.2, width=12.0),)), start=(0, 0, 0), goal=(3, 0, 0))
    own, tries = prepared(task, PLANNED, avoid="window")[1], []
    stage = avoiding("window")(Vehicle.of(own).robot, 1)
    stage.assign([own])
    reference = np.hstack(own.reference.sample(np.zeros(1)))
    stage.reset(np.zeros((1, 3)), reference, 0.05)
    monkeypatch.setattr(Planner, "plan", lambda *_, ahead: tries.append(None))
    lidar, around, random = Lidar(), Surroundings(task.obstacles).at(0.0), np.random.default_rng(0)
    way = np.append(np.arange(0.0, 3.0, 0.05), np.full(50, 3.0))  # it stands for 2.5 s at the end
    for k, x in enumerate(way):
        pose = np.array([x, 0.0, turned * (x == 3.0)])
        ranges = lidar.scan(pose, around, random)
        stage.see(0, Scan(ranges, lidar.angles, lidar.range, lidar.place(pose), 0.05 * k))
        stage.output(pose[None], np.array([[float(x < 3.0), 0.0]]), reference)
    assert len(tries) == plans


@pytest.mark.parametrize("avoid", ["window", "mppi"])
def test_waits(avoid: Avoid) -> None:
    """A robot at the end of its plan whose run goes on, as in the viewer, waits there, after a second try at most."""
    task = Task(obstacles=Obstacles(shapes=(Box(x=1.0, y=3.0),)), start=(0, 0, 0), goal=(1.5, 0, 0))
    turtlebot = Scenario.from_dict({"prior": "model", "learner": "none", "robot": {"path": "turtlebot"}})
    own = prepared(task, turtlebot, avoid=avoid)[1].replace(laps=8)
    run = simulate([own.replace(goal=None)], motion=avoiding(avoid)).isel(run=0)
    after = run.isel(time=run["time"] > 0.7 * own.ticks * own.control_period)
    assert len(after["time"]) > 200
    assert float(np.hypot(after["x"] - 1.5, after["y"]).max()) < 0.12 and float(np.abs(after["v"]).max()) < 0.05
    assert float(np.hypot(np.ptp(after["x"].values), np.ptp(after["y"].values))) < 0.005  # it does not creep


@pytest.mark.parametrize(("robot", "avoid"), [("car", "window"), ("racecar", "mppi")])
def test_far_door(robot: str, avoid: Avoid) -> None:
    """Where the plan leads past a blocked door, the robot takes another one, 8 m off, beyond the area of its plan."""
    spans = (-3.0, -1.5), (-0.8, 6.65), (7.35, 12.0)
    walls = [Box(x=2.0, y=(low + high) / 2, length=0.1, width=high - low) for low, high in spans]
    known = Obstacles(shapes=(*walls, *(Box(x=2.0, y=y, length=6.0, width=0.1) for y in (-3.0, 12.0))))
    plug = Box(x=2.0, y=-1.15, length=0.2, width=0.7)
    world = Obstacles(shapes=(*known.shapes, plug))
    task = Task(obstacles=world, map=known, start=(0.0, -0.4, 0.0), goal=(4.0, -0.4, 0.0))
    own = prepared(task, PLANNED.replace(robot=RobotFile(path=robot)), avoid=avoid)[1].replace(laps=8)
    run = simulate([own], motion=avoiding(avoid)).isel(run=0)
    assert run["failure"].item() == "" and float(run["y"].max()) > 6.0
    assert np.hypot(float(run["x"].dropna("time")[-1]) - 4.0, float(run["y"].dropna("time")[-1]) + 0.4) < 0.1


def test_blocked_door() -> None:
    """A door of two is blocked, and the map shows it open: the robot sees it, plans again, and takes the other one."""
    walls = [Box(x=2.0, y=y, length=0.1, width=width) for y, width in ((-2.3, 1.4), (0.0, 1.4), (2.3, 1.4))]
    outer = [Box(x=2.0, y=side * 3.0, length=6.0, width=0.1) for side in (-1, 1)]
    known, plug = Obstacles(shapes=(*walls, *outer)), Box(x=2.0, y=-1.15, length=0.2, width=0.7)
    task = Task(
        obstacles=Obstacles(shapes=(*known.shapes, plug)), map=known, start=(0.0, -0.4, 0.0), goal=(4.0, -0.4, 0.0)
    )
    assert navigate(task, PLANNED, speed=0.8).table["outcome"].tolist() == ["collided"]
    driven = navigate(task, PLANNED, speed=0.8, avoid="mppi")
    run = driven.result.isel(run=0)
    assert driven.table["outcome"].tolist() == ["arrived"]
    assert float(run["y"].values[np.argmax(run["x"].values > 2)]) > 0.7 and driven.plan.poses[:, 1].max() < 0.7


@pytest.mark.parametrize(("robot", "avoid"), [("car", "barrier"), ("racecar", "window"), ("turtlebot", "mppi")])
def test_open_door(robot: str, avoid: Avoid) -> None:
    """Of two doors the map has the wrong one closed: the robot sees both, and takes the one that is open."""
    walls = [Box(x=2.0, y=y, length=0.1, width=1.4) for y in (-2.3, 0.0, 2.3)]
    outer = [Box(x=2.0, y=side * 3.0, length=6.0, width=0.1) for side in (-1, 1)]
    shapes, (left, right) = (*walls, *outer), (Box(x=2.0, y=side * 1.15, length=0.2, width=0.7) for side in (1, -1))
    task = Task(
        obstacles=Obstacles(shapes=(*shapes, left)),
        map=Obstacles(shapes=(*shapes, right)),
        start=(0.0, 0.0, 0.0),
        goal=(4.0, -0.4, 0.0),
    )
    own = Scenario.from_dict({"prior": "model", "learner": "none", "robot": {"path": robot}})
    driven = navigate(task, own, speed=0.6, avoid=avoid)
    run = driven.result.isel(run=0)
    assert driven.table["outcome"].tolist() == ["arrived"] and driven.table["clearance"].iloc[0] > 0.01
    assert float(run["y"].values[np.argmax(run["x"].values > 2)]) < -0.7 and driven.plan.poses[:, 1].max() > 0.7


@pytest.mark.parametrize(("robot", "avoid"), [("racecar", "barrier"), ("car", "window"), ("turtlebot", "mppi")])
def test_wall_in_the_open(robot: str, avoid: Avoid) -> None:
    """A wall of 3 m across the way, which the map lacks and which is wider than it, is gone around.

    The robot makes another plan as soon as a scan shows the wall, and does not stop before it.
    The TurtleBot then comes to its goal on an arc. It was turned there by 0.21 rad, time and again, while the heading
    cost as little at the end of the plan as on the way.
    """
    post, wall = Disc(x=2.0, y=-0.6), Box(x=2.0, length=0.1, width=3.0)
    task = Task(obstacles=Obstacles(shapes=(wall,)), map=Obstacles(shapes=(post,)), start=(0, 0, 0), goal=(4, 0, 0))
    own = Scenario.from_dict({"prior": "model", "learner": "none", "robot": {"path": robot}})
    driven = navigate(task, own, avoid=avoid)
    assert driven.table["outcome"].tolist() == ["arrived"] and driven.table["clearance"].iloc[0] > 0.02
    assert float(np.abs(driven.result["y"]).max()) > 1.5 > np.abs(driven.plan.poses[:, 1]).max()
    run = driven.result.isel(run=0)
    on_the_way = (run["time"] > 1) & (np.hypot(run["x"] - 4, run["y"]) > 1)
    assert float(run["v"].where(on_the_way).min()) > 0.2


@pytest.mark.parametrize("avoid", ["window", "barrier"])
def test_shorter(avoid: Avoid) -> None:
    """Where the wall that its plan goes around has gone, a robot drives straight on."""
    wall, post = Box(x=2.0, y=0.3, length=0.1, width=1.8), Disc(x=2.0, y=4.0)
    known = Obstacles(shapes=(wall, post))
    task = Task(obstacles=Obstacles(shapes=(post,)), map=known, start=(0.0, 0.0, 0.0), goal=(4.0, 0.0, 0.0))
    driven = navigate(task, PLANNED, avoid=avoid)
    assert driven.table["outcome"].tolist() == ["arrived"]
    assert float(np.abs(driven.result["y"]).max()) < 0.3 < 0.8 < np.abs(driven.plan.poses[:, 1]).max()
    v = driven.result["v"].isel(run=0)
    first = int(np.argmax(v.values > 0.3))
    slowest = float(v[first : int(np.argmax(driven.result["x"].isel(run=0).values > 3))].min())
    again = navigate(task, PLANNED, avoid=avoid).result
    for name in ("x", "theta", "voltage_left"):
        assert again[name].values.tobytes() == driven.result[name].values.tobytes()
    if avoid == "barrier" and 0.25 < slowest <= 0.3:
        pytest.xfail("the new plan begins on an arc, on which the robot slows down to 0.286 m/s")
    assert slowest > 0.3  # it does not stop


@pytest.mark.parametrize("avoid", ["barrier", "window", "mppi"])
def test_several_missions(avoid: Avoid, monkeypatch: pytest.MonkeyPatch) -> None:
    """Robots in different worlds, with different goals, maps and speeds, drive in one batch as each drives alone.

    A disc crosses the way of each. How many roll-outs the mean is taken of does not matter here.
    """
    monkeypatch.setattr("mrctl.navigation.mppi.SAMPLES", 400)
    drives = []
    for side, end, speed in ((1, 4.0, 0.8), (-1, 3.6, 0.5)):
        known = Obstacles(shapes=(Box(x=1.4, y=0.7 * side, length=0.3, width=0.6), Disc(x=1.0, y=-1.2 * side)))
        unknown = Disc(x=2.0, y=-0.1 * side, radius=0.12)
        world = Obstacles(shapes=(*known.shapes, unknown, crossing(0.3, side)))
        task = Task(obstacles=world, map=known, start=(0.0, 0.0, 0.0), goal=(end, 0.3 * side, 0.0))
        drives.append(prepared(task, PLANNED, speed, avoid=avoid)[1])
    assert len(uniform([arranged(own) for own in drives])) == 1
    together = simulate(drives, motion=avoiding(avoid))
    assert together["clearance"].min() > 0.0 and not together["failed"].any()
    for row, own in enumerate(drives):
        equal(simulate(own, motion=avoiding(avoid)), together, row)


@pytest.mark.parametrize("avoid", ["window", "mppi"])
@pytest.mark.parametrize("robot", ["car", *(pytest.param(r, marks=pytest.mark.full) for r in ("racecar", "turtlebot"))])
def test_goal_before_a_wall(robot: str, avoid: Avoid) -> None:
    """A robot arrives at a goal with a wall 6 cm ahead of its nose; the plan keeps 5 cm."""
    scenario = PLANNED.replace(robot=RobotFile(path=robot))
    wall = Box(x=3.05 + Vehicle.of(scenario).footprint[:, 0].max() + 0.06, length=0.1, width=6.0)
    task = Task(obstacles=Obstacles(shapes=(wall,)), start=(0.0, 0.0, 0.0), goal=(3.0, 0.0, 0.0))
    (row,) = navigate(task, scenario, avoid=avoid).table.itertuples()
    assert row.outcome == "arrived" and row.length < 3.1


def test_limits() -> None:
    """What the stages ask for is within the bounds at every tick, also where the robot is thrown about."""
    task = Task(obstacles=Obstacles(shapes=(crossing(0.4),)), start=(0.0, 0.0, 0.0), goal=(4.0, 0.0, 0.0))
    plan = planned(Query(task, Vehicle.of(PLANNED)))[1]
    own = PLANNED.replace(obstacles=task.obstacles, reference=plan, goal=task.goal)
    robot, random = Vehicle.of(own).robot, np.random.default_rng(1)
    for avoid in ("window", "mppi"):
        make = avoiding(avoid)
        assert make is not None
        stage, pose = make(robot, 1), np.zeros((1, 3))
        stage.assign([own])
        stage.reset(pose, np.zeros((1, 7)), 0.05)
        for _ in range(40):
            ((v, omega),) = stage.output(pose, np.zeros((1, 2)), np.zeros((1, 7)))
            assert 0 <= v <= robot.max_speed and abs(omega) <= robot.max_rotation
            assert abs(omega) <= v * np.tan(robot.steering_limit) / robot.wheelbase + 1e-12
            pose = pose + [[0.05 * v, 0.0, 0.05 * omega]] + random.normal(size=(1, 3)) * 0.05


@pytest.mark.parametrize(("first", "second"), [(0.3, 0.9), (0.9, 0.3)])
@pytest.mark.parametrize("avoid", ["window", "mppi"])
def test_speed_of_another_way(avoid: Avoid, first: float, second: float) -> None:
    """On another way a robot is as fast as that way, not as the plan of its mission; it changes its speed slowly."""
    task = Task(obstacles=Obstacles(shapes=(Disc(x=5.0, y=3.0),)), start=(0.0, 0.0, 0.0), goal=(9.0, 0.0, 0.0))
    _, drive = prepared(task, PLANNED, first, avoid=avoid)
    made, robot = avoiding(avoid), Vehicle.of(drive).robot
    assert made is not None
    stage, period, speeds = made(robot, 1), drive.motion_period, []
    stage.assign([drive])
    pose, twist = np.zeros((1, 3)), np.zeros((1, 2))
    stage.reset(pose, np.zeros((1, 7)), period)
    for k in range(120):  # a unicycle that obeys at once
        if k == 50:
            x, y = pose[0, :2].tolist()
            points = tuple((x + ahead, y) for ahead in range(9))
            way = Waypoints(points=points, closed=False, timing="limits", speed=second, start_speed=min(first, second))
            stage.follow(0, way)
        twist = stage.output(pose, twist, np.zeros((1, 7)))
        (v, omega), theta = twist[0], pose[0, 2]
        pose = pose + period * np.array([v * np.cos(theta), v * np.sin(theta), omega])
        speeds.append(v)
    assert np.mean(speeds[40:50]) == pytest.approx(first, rel=0.1)
    assert np.mean(speeds[-20:]) == pytest.approx(second, rel=0.1)
    assert np.abs(np.diff(speeds)).max() <= robot.max_acceleration * period


@pytest.mark.parametrize("avoid", AVOIDERS)
def test_a_way_that_reverses(avoid: Avoid) -> None:
    """The barrier follows a way with a cusp; `window` and `mppi`, whose roll-outs drive forward alone, refuse it."""
    points = ((0.0, 0.0), (0.5, 0.0), (1.0, 0.0), (0.5, 0.02), (0.0, 0.08))
    back = Waypoints(points=points, closed=False, timing="limits", cusps=(2,), speed=0.4)
    task = Task(obstacles=Obstacles(shapes=(Disc(x=3.0, y=2.0, radius=0.2),)), start=(0.0,) * 3, goal=(2.0, 0.0, 0.0))
    own = prepared(task, PLANNED.replace(steering="rigid"), avoid=avoid)[1]
    if avoid == "barrier":
        result = simulate(own.with_event(Event(time=0.2, reference=back)), motion=avoiding(avoid))
        assert result["failure"] == "" and result["v"].min() < -0.1
        return
    says = "follow plans that drive forward alone, without cusps"
    with pytest.raises(InputError, match=says):  # before anything is driven
        simulate(own.with_event(Event(time=0.2, reference=back)), motion=avoiding(avoid))
    simulation = mrctl.Simulation([own], motion=avoiding(avoid))
    for _ in range(20):
        simulation.step()
    simulation.add(Event(time=0.25, reference=back))  # known too late for that
    while simulation.running:
        simulation.step()
    result = simulation.result()
    assert says in result.failure.item() and result["time"].max() > 0.1  # what was driven is kept


@pytest.mark.parametrize("avoid", AVOIDERS)
def test_a_way_without_an_end(avoid: Avoid) -> None:
    """An event that brings a reference that is no plan is refused before anything is driven."""
    task = Task(obstacles=Obstacles(), start=(0.0, 0.0, 0.0), goal=(1.0, 0.0, 0.0))
    own = prepared(task, PLANNED, avoid=avoid)[1].with_event(Event(time=1.0, reference=mrctl.Circle()))
    with pytest.raises(InputError, match="robots with an avoider follow open waypoints alone"):
        simulate([own], motion=avoiding(avoid))
