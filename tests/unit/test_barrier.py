"""The barrier filter: the nearest twist by two independent solvers, no collision, idle where clear, and its braking."""

from typing import Any

import numpy as np
import osqp
import pytest
import scipy.sparse
import shapely
from scipy.optimize import nnls
from test_obstacles import judged, random_shapes

from mrctl import Box, Obstacles, RobotFile, Scenario, Sensing, Waypoints
from mrctl.control.design import motion
from mrctl.control.features import feature_matrix
from mrctl.control.kanayama import GAINS, Kanayama, kanayama, posture_error
from mrctl.experiments.learned_limits import PLANTS
from mrctl.loop.simulation import Simulation
from mrctl.navigation.barrier import Barrier, approach, share
from mrctl.navigation.barrier_filter import Avoiding, avoid, nearest
from mrctl.navigation.pacing import CATCH_UP_SPEED, Following, Pacer, Pacing
from mrctl.navigation.replanning import Planner
from mrctl.navigation.vehicle import Vehicle
from mrctl.physics import mjcf
from mrctl.physics.parameters import read_robot
from mrctl.physics.perturb import perturb
from mrctl.theory.clearance import clearance, cover, rim
from mrctl.theory.dynamics import inverse_coefficients
from mrctl.theory.obstacles import Surroundings, turned
from mrctl.theory.rays import Scan

FOOTPRINT = np.array([[-0.1, -0.2], [0.44, -0.2], [0.44, 0.2], [-0.1, 0.2]])
BARRIER = Barrier(cover(FOOTPRINT, 4), margin=0.01, deceleration=1.0, period=0.02, lever=0.3)


def least_distance(request, rows):
    """The nearest point of the half-planes by the method of Lawson and Hanson (Solving Least Squares Problems, 1974,
    chapter 23): with z = p − request, the least |z| with G z ≥ h follows from one non-negative least squares problem.
    """  # noqa: D205
    matrix = np.vstack([rows[:, :2].T, rows[:, 2] - rows[:, :2] @ request])
    solution, _ = nnls(matrix, np.array([0.0, 0.0, 1.0]))
    rest = matrix @ solution - [0, 0, 1]
    return request - rest[:2] / rest[2]


def by_osqp(request, rows):
    """The same point by the operator splitting of OSQP, which has no active set."""
    lengths = np.hypot(rows[:, 0], rows[:, 1])
    solver = osqp.OSQP()
    solver.setup(
        scipy.sparse.identity(2, format="csc"), -request, scipy.sparse.csc_matrix(rows[:, :2] / lengths[:, None]),
        rows[:, 2] / lengths, np.full(len(rows), np.inf), verbose=False, eps_abs=1e-9, eps_rel=1e-9,
        max_iter=2_000_000, scaling=0, rho=10.0, adaptive_rho=False, alpha=1.8,
    )  # fmt: skip
    return solver.solve(raise_error=True).x


def half_planes(random):
    """Up to eleven random half-planes around the origin, of which up to two have it on their border."""
    rows = random.normal(size=(random.integers(1, 12), 3))
    rows[:, 2] = -np.abs(rows[:, 2]) * (random.permutation(len(rows)) >= random.integers(3))
    return rows


@pytest.mark.parametrize(
    ("judge", "count"), [(least_distance, 2000), (by_osqp, 500), pytest.param(by_osqp, 10_000, marks=pytest.mark.full)]
)
def test_nearest(judge, count) -> None:
    """In random half-planes around the origin the point is the judge's to 1e-6."""
    random, changed, worst = np.random.default_rng(0), 0, 0.0
    for _ in range(count):
        rows, request = half_planes(random), 2 * random.normal(size=2)
        found = nearest(request[0], request[1], rows)
        worst = max(worst, np.abs(judge(request, rows) - found).max())
        changed += found != tuple(request)
    print(f"{count} problems, {changed} requests changed, largest difference {worst:.1e}")
    assert worst < 1e-6 and count / 4 < changed < count
    only_rest = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]], float)
    np.testing.assert_allclose(nearest(1.0, 2.0, only_rest), 0.0, atol=1e-12)


@pytest.mark.parametrize("starts", [25, pytest.param(10_000, marks=pytest.mark.full)])
def test_no_collision(starts) -> None:
    """Among random obstacles, still ones, with requests that change at random and are obeyed at once."""
    random, nearer, driven = np.random.default_rng(1), 0, 0
    while driven < starts:
        outlines = Surroundings(random_shapes(random, 12)).at(0.0)
        pose = random.uniform([-3, -3, -3], [3, 3, 3])
        if min(clearance(_square(disc), pose, outlines) for disc in BARRIER.discs) <= BARRIER.margin:
            continue
        driven += 1
        request = np.zeros(2)
        for step in range(300):
            if step % 50 == 0:
                request = random.uniform([-1.5, -3], [1.5, 3])
            v, omega = avoid(request, pose, outlines, BARRIER)
            nearer += (v, omega) != tuple(request)
            turn = omega * BARRIER.period
            way = v * BARRIER.period * np.sinc(turn / 2 / np.pi)  # chord of the arc
            pose = pose + [way * np.cos(pose[2] + turn / 2), way * np.sin(pose[2] + turn / 2), turn]
            assert clearance(FOOTPRINT, pose, outlines) > 0
    print(f"{starts} starts, {300 * starts} ticks, {nearer} requests changed, no collision")
    assert nearer > 20 * starts


@pytest.mark.parametrize("worlds", [30, pytest.param(1000, marks=pytest.mark.full)])
def test_idle_where_it_could_stop(worlds) -> None:
    """Among obstacles a request is left as it is, to the bit, if every disc could stop by shapely's distance."""
    random, clear, near = np.random.default_rng(3), 0, 0
    for _ in range(worlds):
        obstacles = random_shapes(random, 8)
        outlines, shapes = Surroundings(obstacles).at(0.0), shapely.union_all([judged(s) for s in obstacles.shapes])
        poses = random.uniform([-3, -3, -3], [3, 3, 3], (30, 3))
        for pose, (v, omega) in zip(poses, random.uniform([-1.5, -3], [1.5, 3], (30, 2)), strict=True):
            speeds = np.hypot(v - omega * BARRIER.discs[:, 1], omega * BARRIER.discs[:, 0])  # of the discs' centres
            away = shapely.distance(shapely.points(turned(BARRIER.discs[:, :2], pose)), shapes) - BARRIER.discs[:, 2]
            braking = speeds * BARRIER.period + speeds**2 / 2 / BARRIER.deceleration
            if np.all(away - BARRIER.margin > braking + 1e-4):
                clear += 1
                near += away.min() < 0.3
                assert avoid(np.array([v, omega]), pose, outlines, BARRIER).tolist() == [v, omega]
    print(f"{clear} requests from which the robot could stop, {near} of them within 0.3 m of an obstacle")
    assert clear > 3 * worlds and near > worlds / 3


def _square(disc):
    """The square around a disc."""
    return disc[:2] + disc[2] * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])


@pytest.mark.parametrize("heading", [0.0, 0.7, -2.0])
def test_brakes_before_a_wall(heading: float) -> None:
    """Straight at a wall the speed falls by at most the deceleration, from the braking distance on, and ends at 0."""
    ahead = np.array([np.cos(heading), np.sin(heading)])
    x, y = 3 * ahead
    wall = Surroundings(Obstacles(shapes=(Box(x=x, y=y, angle=heading, length=0.2, width=4.0),))).at(0.0)
    way, speeds, gaps = 0.0, [], []
    front = BARRIER.discs[:, 0].max() + BARRIER.discs[0, 2]
    for _ in range(400):
        v, omega = avoid(np.array([1.5, 0.0]), np.array([*(way * ahead), heading]), wall, BARRIER)
        speeds.append(v)
        gaps.append(2.9 - way - front - BARRIER.margin)
        way += v * BARRIER.period
    speeds, gaps = np.array(speeds), np.array(gaps)
    braking = 1.5 * BARRIER.period + 1.5**2 / 2 / BARRIER.deceleration
    assert np.all(speeds[gaps > braking] == 1.5) and np.all(speeds[gaps < braking - 1e-9] < 1.5)
    assert np.diff(speeds).min() >= -BARRIER.deceleration * BARRIER.period * (1 + 1e-6)
    assert -1e-9 < gaps[-1] < 0.01 and speeds[-1] < 0.02


def test_idle_when_clear() -> None:
    """A request from which the robot could stop is not changed by a bit, nor is any in an empty world."""
    random = np.random.default_rng(2)
    far = Surroundings(Obstacles(shapes=(Box(x=6.0), Box(y=-6.0)))).at(0.0)
    for outlines in (far, Surroundings(Obstacles()).at(0.0)):
        for request in random.uniform([-1.5, -3], [1.5, 3], (200, 2)):
            pose = random.uniform([-1, -1, -3], [1, 1, 3])
            assert avoid(request, pose, outlines, BARRIER).tolist() == request.tolist()


class Rests:
    """A motion stage that asks for no motion."""

    def reset(self, pose, reference, period):
        pass

    def output(self, pose, twist, reference):
        return np.zeros((len(pose), 2))


@pytest.mark.parametrize("given", [{}, {"prefilter": 0.3}, {"kanayama": Kanayama(k_y=4.0)}])
def test_following_has_the_gains_of_the_hierarchy(given: dict[str, Any]) -> None:
    """Beside the filter the robot follows with the gains that it has without, also where a part of them is given."""
    scenario = Scenario(sensing=Sensing(tier="field"), **given)
    robot = mjcf.build(scenario.world, scenario.steering)[1]
    pose, reference = np.array([[0.1, 0.2, 0.3]]), np.array([[0.0, 0.0, 0.0, 0.5, 0.2, 0.0, 0.0]])
    error, request = np.empty(3), np.empty(2)
    posture_error.compiled(pose[0], reference[0, :3], error)
    period = scenario.control_period
    latency = scenario.sensing.loop_delay(period) * period
    loops = scenario.pid.channels(robot, False, latency, period)
    own = scenario.kanayama.completed(motion(robot, False, loops, latency, period, scenario.prefilter).kanayama)
    gains = np.array([(own.k_x, own.k_y, own.k_theta)], GAINS)
    kanayama.compiled(error, reference[0, 3:5], gains[0], request)
    law = Following(1)
    Simulation([scenario], motion=lambda *_: Told(law))
    assert np.array_equal(law.output(pose, reference)[0], request)


class Told(Rests):
    """Rests, and tells a law its gains."""

    def __init__(self, law: Following) -> None:
        self.tune = law.tune


def test_share() -> None:
    """The largest share of a request keeps every half-plane of finite differences, one of them just, or is 1 or 0."""
    random, partly = np.random.default_rng(3), 0
    barrier, h = BARRIER._replace(discs=rim(FOOTPRINT, 0.03), margin=0.02), 1e-6
    for _ in range(60):
        obstacles = random_shapes(random, 10)
        alone = [Surroundings(Obstacles(shapes=(shape,))).at(0.0) for shape in obstacles.shapes]
        pose, request = random.uniform([-3, -3, -3], [3, 3, 3]), random.uniform([-1.5, -3], [1.5, 3])
        found = share(request, pose, Surroundings(obstacles).at(0.0), barrier)
        later = pose + h * np.array([request[0] * np.cos(pose[2]), request[0] * np.sin(pose[2]), request[1]])
        rests = []
        for disc in barrier.discs:
            point = disc[:2] + np.array([[1e-9, 0], [0, 1e-9], [-1e-9, 0]])
            for outlines in alone:
                near, then = (clearance(point, p, outlines) for p in (pose, later))
                braked = approach(near - disc[2] - barrier.margin, barrier.deceleration, barrier.period)
                if near > 0:  # inside, the distance is that from the nearest side
                    rests.append(found * (then - near) / h + braked)
        assert min(rests) > -2e-3
        if 0 < found < 1:
            assert min(rests) < 2e-3
            partly += 1
    assert partly > 15


def test_paced_plan_is_driven_whole() -> None:
    """Robots that obey at once drive the plan itself, more slowly, pass what it passes narrowly, and end at its end."""
    wall = [Box(x=2.0, y=side * 0.985, length=0.3, width=1.5) for side in (-1, 1)]  # about 2 cm beside the plan
    plan = Waypoints(
        points=(*((x / 2, 0) for x in range(7)), (4, 0.5), (5, 1)), closed=False, timing="limits", speed=1.2
    )
    robot = mjcf.build()[1]
    scenario = Scenario(reference=plan, obstacles=Obstacles(shapes=(*wall,)), prior="model")
    footprint = Vehicle.of(scenario).footprint
    outlines, pose, period = Surroundings(scenario.obstacles).at(0.0), np.zeros((2, 3)), 0.01
    pose[:] = plan.sample(np.zeros(1)).pose
    stage = Pacing(robot, 2, lambda *_: None)
    stage.assign([scenario] * 2)
    for row in range(2):
        stage.tune(row, Kanayama(k_x=1.5, k_y=12.0, k_theta=4.0))
    stage.reset(pose, np.zeros((2, 7)), period)
    way, ticks = plan.sample(np.linspace(0, plan.period, 4000)).pose, 0
    least = min(clearance(footprint, place, outlines) for place in way)
    assert 0 < least < 0.025
    while np.hypot(*(pose[0, :2] - way[-1, :2])) > 0.01:
        requests = stage.output(pose, np.zeros((2, 2)), np.zeros((2, 7)))
        assert np.array_equal(requests[0], requests[1])
        middle = pose[:, 2] + period / 2 * requests[:, 1]
        ahead = requests[:, :1] * np.column_stack([np.cos(middle), np.sin(middle)])
        pose = pose + period * np.column_stack([ahead, requests[:, 1]])
        assert np.hypot(*(way[:, :2] - pose[0, :2]).T).min() < 2e-3
        assert clearance(footprint, pose[0], outlines) > least - 2e-3
        ticks += 1
        assert ticks < 3 * plan.period / period
    assert ticks > 1.02 * plan.period / period


@pytest.mark.parametrize(("limit", "cusps"), [(0.9, ()), (0.5, ()), (0.5, (0,))])
def test_plan_waits_for_a_slow_robot(limit: float, cusps: tuple[int, ...]) -> None:
    """The clock goes at the rate of a robot slower than its plan, forward and in reverse, whose lag is as derived.

    In the steady state the clock has the rate λ = V_max / V_r, and the request is λ (V_r + k_x e) = V_r + v.
    """
    plan = Waypoints(points=((0, 0), (8, 0)), closed=False, timing="limits", speed=1.2, cusps=cusps)
    scenario, k_x, period, pose = Scenario(reference=plan, prior="model"), 8.0, 0.01, np.zeros((1, 3))
    pose[0] = plan.sample(np.zeros(1)).pose[0]
    stage = Pacing(mjcf.build()[1], 1, lambda *_: None)
    stage.assign([scenario])
    stage.tune(0, Kanayama(k_x=k_x, k_y=12.0, k_theta=4.0))
    stage.reset(pose, np.zeros((1, 7)), period)
    lags, rates, ticks = [], [], 0
    while pose[0, 0] < 7.99:
        request = stage.output(pose, np.zeros((1, 2)), np.zeros((1, 7)))[0]
        lags.append(stage.followed[0, 0] - pose[0, 0])
        rates.append(abs(stage.followed[0, 3]))
        pose[0, 0] += period * np.cos(pose[0, 2]) * np.clip(request[0], -limit, limit)
        ticks += 1
        assert ticks < 2000
    middle = slice(ticks // 3, ticks // 2)
    np.testing.assert_allclose(rates[middle], limit, rtol=2e-3)
    np.testing.assert_allclose(lags[middle], ((1.2 + CATCH_UP_SPEED) * 1.2 / limit - 1.2) / k_x, rtol=0.02)


def test_stop_for_a_shorter_way() -> None:
    """A robot that stops does so also where its plan is blocked far ahead."""
    plan = Waypoints(points=((0, 0), (4, 0), (8, 0)), closed=False, timing="limits", speed=1.2)
    scenario = Scenario(reference=plan, prior="model")
    pacer = Pacer(Planner.each(lambda *_: None, [scenario])[0], mjcf.build()[1], 0.01)
    request, pose = np.array([1.0, 0.0]), np.zeros(3)
    pacer._place = 500.0
    assert pacer._share(request, pose, request, 0.0) == 1
    pacer._stops = True
    assert pacer._share(request, pose, request, 0.0) == 0


def test_wrapped_stage_sees() -> None:
    """The filter hands scans on to the stage that it wraps, and says what that one follows."""

    class Looks(Rests):
        followed, seen = np.zeros((1, 7)), 0

        def see(self, row, scan):
            self.seen += 1

    made = []
    stage = Avoiding(mjcf.build()[1], 1, lambda *robots: made.append(Looks()) or made[0], BARRIER)
    stage.assign([Scenario()])
    stage.reset(np.zeros((1, 3)), np.zeros((1, 7)), 0.02)
    stage.see(0, Scan(np.full(8, np.inf), np.arange(8) * np.pi / 4, 5.0, np.zeros(3), 0.0))
    assert made[0].seen == 1 and stage.followed is Looks.followed


@pytest.mark.parametrize("path", ["car", "racecar", "turtlebot"])
def test_every_plant_brakes(path):
    """On no plant of the suite is the supply too weak to brake as the filter counts on."""
    robot_file = RobotFile(path=path)
    nominal, robot = mjcf.build(robot=robot_file)
    for name, perturbation in PLANTS.items():
        model = mjcf.clone(nominal)
        perturb(nominal, model, perturbation, robot)
        true = read_robot(model, perturbation.supply_factor)
        speeds = np.linspace(0.05, 0.9, 18)[:, None] * [robot.max_speed, 0.0]
        steady, braked = (
            feature_matrix(speeds, np.full((18, 2), [a, 0.0]), robot.half_track, np.ones(8))
            @ inverse_coefficients(true)
            for a in (0.0, -1.0)
        )
        hardest = (0.9 * robot.supply + steady[:, 0]) / (steady - braked)[:, 0]  # m/s²
        assert hardest.min() > 2.7 * robot.max_acceleration, name
