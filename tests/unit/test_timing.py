"""Time laws against TOPP-RA, analytic solutions, and every limit of the robot on a fine grid."""

from itertools import product

import numpy as np
import pytest
import toppra
from hypothesis import given, reject, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.optimize import brentq
from toppra.algorithm import TOPPRA
from toppra.constraint import DiscretizationType, LinearConstraint
from toppra.constraint.linear_constraint import canlinear_colloc_to_interpolate

import mrctl
from mrctl.navigation.planning import Query, planned
from mrctl.navigation.tasks import task_of
from mrctl.navigation.vehicle import Vehicle
from mrctl.physics import mjcf
from mrctl.physics.parameters import read_robot
from mrctl.record import InputError
from mrctl.theory.dynamics import inverse_dynamics
from mrctl.theory.references import Waypoints, check, random_spline
from mrctl.theory.robot import GRAVITY
from mrctl.theory.timing import Limits, Path, fastest, sample_path, smooth

CAR = read_robot(mjcf.load())
ROBOTS = {"car": CAR}
for name in ("turtlebot", "racecar"):
    file = mrctl.load_robot(name)
    ROBOTS[name] = read_robot(mjcf.load(steering=mjcf.arrangement(file), robot=file))
NO_VOLTAGE = Limits(inverse=())
KINDS = "doorway", "corridor", "slalom", "warehouse", "cellular"


def loads(motion, robot, limits, speed):
    """Each limited quantity of a motion as a share of its limit, (T, 7)."""
    (v, omega), (v_dot, omega_dot) = motion.twist.T, motion.acceleration.T
    shares = [
        v / speed, omega / limits.rotation, v_dot / limits.acceleration, omega_dot / limits.rotation_acceleration,
        v * omega / limits.lateral_acceleration,
    ]  # fmt: skip
    voltage = inverse_dynamics(motion.twist, motion.acceleration, robot)
    return np.abs(np.column_stack([*shares, voltage / limits.voltage]))


def splines(robot, share, count):
    """Random splines that are driven up to the robot's speed limit."""
    random = np.random.default_rng(4)
    for _ in range(count):
        yield random_spline(random, robot, 1.0, share)


class Judged(LinearConstraint):
    """|a u + b x + c| ≤ 1 and x ≤ cap on a grid; TOPP-RA holds the limits at both ends of every interval."""

    def __init__(self, a, b, c, cap):
        super().__init__()
        bounds = np.stack([np.zeros(len(cap)), cap], -1)
        self.parameters = a, b, c, np.vstack([np.eye(4), -np.eye(4)]), np.ones(8), None, bounds
        self.identical = True
        self.set_discretization_type(DiscretizationType.Interpolation)

    def compute_constraint_params(self, path, gridpoints):
        return canlinear_colloc_to_interpolate(*self.parameters, gridpoints, identical=True)


def judge(s, k, dk, robot, limits, speed, near, start=0.0):
    """Duration of each interval by TOPP-RA from a start speed to rest, and the largest controllable start speed.

    Its limits must be linear in u and x, so √x is linearised at the law `near`. That is its tangent from above: the
    solution keeps upper limits on the voltage, and is the same if and only if the law is optimal.
    """
    zero, one = np.zeros(len(s)), np.ones(len(s))
    along, turn = np.stack([one, k], -1), np.stack([zero, dk], -1)
    # The voltage at unit speed and at twice that gives its terms in √x and in x; signs as in slow motion.
    d = inverse_dynamics(1e-9 * along, 0 * along, robot)
    a = inverse_dynamics(1e-9 * along, along, robot) - d
    single, double = (inverse_dynamics(n * along, n**2 * turn, robot) - d for n in (1, 2))
    b, c = (double - 2 * single) / 2, (4 * single - double) / 2
    root = np.sqrt(np.append(near[1:-1], near[-2] / 2))
    root = np.append(np.sqrt(max(near[0], near[1] / 2)), root)[:, None]
    alpha, volts = limits.rotation_acceleration, limits.voltage
    still = np.maximum(np.abs(k), 1e-9)
    constraint = Judged(
        np.column_stack([one / limits.acceleration, k / alpha, a / volts]),
        np.column_stack([zero, dk / alpha, (b + c / (2 * root)) / volts]),
        np.column_stack([zero, zero, (d + c * root / 2) / volts]),
        np.minimum(speed**2, np.minimum((limits.rotation / still) ** 2, limits.lateral_acceleration / still)),
    )
    line = toppra.SplineInterpolator(s[[0, -1]], s[[0, -1]])
    solver = TOPPRA([constraint], line, gridpoints=s, solver_wrapper="seidel")
    largest = np.sqrt(solver.compute_controllable_sets(0, 0)[0, 1])
    _, found, _ = solver.compute_parameterization(min(start, largest * (1 - 1e-9)), 0)
    return 2 * np.diff(s) / (found[1:] + found[:-1]), largest


@pytest.mark.parametrize(
    ("name", "share", "count"), [("car", 1, 15), ("car", 0.5, 15), ("turtlebot", 0.5, 10), ("racecar", 0.25, 10)]
)
def test_toppra(name, share, count):
    """On 50 paths the time-optimal law takes at most 1.02 of the time that TOPP-RA takes; the supply may be weak."""
    robot = ROBOTS[name].model_copy(update={"supply": share * ROBOTS[name].supply})
    bound = 0
    for course in splines(robot, 0.9, count):
        open_course = course.model_copy(update={"closed": False})
        path, limits = open_course._law.law.path, course.limits
        law = fastest(path, limits, course.speed)
        _, _, v, _ = law.at(law.times)
        judged, _ = judge(path.s[::2], path.curvature[::2], path.sharpness[::2], robot, limits, course.speed, v**2)
        assert 0.98 < law.duration / judged.sum() < 1.02
        free = fastest(path, limits.model_copy(update={"inverse": ()}), course.speed)
        bound += free.duration < 0.99 * law.duration
    assert share == 1 or bound > count / 2  # the voltage is what limits the speed


@pytest.mark.parametrize(("name", "share"), [("car", 1), ("car", 0.5), ("racecar", 0.25)])
def test_toppra_start_speed(name, share):
    """From a start speed, too; one that is too large becomes the largest one that TOPP-RA finds to be controllable."""
    robot = ROBOTS[name].model_copy(update={"supply": share * ROBOTS[name].supply})
    refused = 0
    for course in splines(robot, 0.9, 6):
        for part in (0.2, 0.6, 2.0):
            start = min(20.0, part * course.speed)
            path = course.model_copy(update={"closed": False, "start_speed": start})._law.law.path
            law = fastest(path, course.limits, course.speed, start)
            _, _, v, _ = law.at(law.times)
            shape = path.s[::2], path.curvature[::2], path.sharpness[::2]
            judged, largest = judge(*shape, robot, course.limits, course.speed, v**2, start)
            assert 0.98 < law.duration / judged.sum() < 1.02
            assert v[0] == law.start == pytest.approx(min(start, largest), rel=0.02)
            refused += law.start < start
    assert 6 <= refused < 18


def test_toppra_laps():
    """The periodic law of a closed path takes as long as the second of three laps by TOPP-RA."""
    for course in splines(CAR, 0.9, 4):
        path = course._law.law.path
        law = fastest(path, course.limits, course.speed)
        _, _, v, _ = law.at(law.times)
        s = np.concatenate([path.s[:-1:2], path.s[:-1:2] + path.length, path.s[::2] + 2 * path.length])
        k, dk = (np.append(np.tile(shape[:-1:2], 3), shape[-1]) for shape in (path.curvature, path.sharpness))
        near = np.append(np.tile(v[:-1], 3), v[-1]) ** 2
        judged = judge(s, k, dk, CAR, course.limits, course.speed, near)[0].reshape(3, -1)
        assert law.duration == pytest.approx(judged[1].sum(), rel=0.002)
        assert v[0] == pytest.approx(v[-1], rel=1e-9) and v.min() > 0


def keeps_limits(course, robot, top):
    """The course keeps every limit between the samples too, and its jerk is bounded.

    Returns the largest share of a limit, and how much longer the course takes than by the time-optimal law.
    """
    limits, smoothing = course.limits, course.limits.smoothing
    motion = course.sample(np.linspace(0, course.period, 20001))
    share = loads(motion, robot, limits, top).max()
    assert share <= 1.01
    assert motion.twist[:, 0].min() >= -1e-12
    jerk = np.abs(np.diff(motion.acceleration[:, 0])) / (course.period / 20000)
    assert jerk.max() <= 2 * limits.acceleration / smoothing * (1 + 1e-6)
    start = course._law.law.start
    if not course.closed:
        ends = motion.pose[[0, -1], :2] - np.array(course.points)[[0, -1]]
        np.testing.assert_allclose(ends, 0, atol=1e-9)
        np.testing.assert_allclose(motion.twist[-1], 0, atol=1e-9)
        assert motion.twist[0, 0] == pytest.approx(start, abs=1e-9)
        np.testing.assert_allclose(motion.acceleration[[0, -1], 0], 0, atol=1e-6)
        driven = np.cumsum(np.hypot(*np.diff(motion.pose[:, :2], axis=0).T))
        advanced = np.cumsum((motion.twist[1:, 0] + motion.twist[:-1, 0]) / 2) * course.period / 20000
        np.testing.assert_allclose(driven, advanced, atol=1e-5)
        smoothing /= 1 if start == 0 else 2  # by which it lasts longer
    least = fastest(course._law.law.path, limits, top, 0.0 if course.closed else start).duration
    assert least <= (course.period - (0 if course.closed else smoothing)) * (1 + 1e-9)
    return share, course.period / least


def polygon(name, radii, closed, speed, supply, smoothing):
    """A curve through the corners of a polygon, the robot with its weak supply, and the largest speed."""
    robot = ROBOTS[name]
    robot = robot.model_copy(update={"supply": supply * robot.supply})
    p = np.array(radii) * np.exp(2j * np.pi * np.arange(len(radii)) / len(radii))
    limits, top = Limits.of(robot).model_copy(update={"smoothing": smoothing}), speed * robot.max_speed
    points = tuple((z.real, z.imag) for z in p)
    return Waypoints(points=points, closed=closed, speed=top, timing="limits", limits=limits), robot, top


@settings(max_examples=30)
@given(
    st.sampled_from(sorted(ROBOTS)), st.lists(st.floats(0.2, 2), min_size=3, max_size=8), st.booleans(),
    st.floats(0.2, 1), st.floats(0.2, 1), st.floats(0.05, 2.0),
)  # fmt: skip
def test_every_limit_holds(name, radii, closed, speed, supply, smoothing):
    """Between the samples too, and on curves that no wheelbase could follow; the law begins and ends on the path."""
    try:
        drawn = polygon(name, radii, closed, speed, supply, smoothing)
    except InputError:
        reject()
    keeps_limits(*drawn)


@settings(max_examples=30)
@given(
    st.sampled_from(sorted(ROBOTS)), st.lists(st.floats(0.2, 2), min_size=3, max_size=8), st.floats(0.2, 1),
    st.floats(0.2, 1), st.floats(0.05, 0.5), st.floats(1e-3, 1.5), st.floats(-1, 1),
)  # fmt: skip
def test_every_limit_holds_from_a_start_speed(name, radii, speed, supply, smoothing, start, curvature):
    """So they do from every speed and curvature; position and speed are continuous, and it begins with that speed.

    It is no less than what the limits allow at the start, or the largest from which they can be kept: a little more is
    not held there.
    """
    try:
        course, robot, top = polygon(name, radii, False, speed, supply, smoothing)
        course = course.replace(start_speed=start * top, start_curvature=curvature)
    except InputError:
        reject()
    keeps_limits(course, robot, top)
    first = course._law.law.start
    assert first <= course.start_speed
    if first < course.start_speed:
        again = course.replace(start_speed=(first + course.start_speed) / 2)
        assert again._law.law.start == pytest.approx(first, rel=0.02, abs=1e-3)


@settings(max_examples=20)
@given(st.lists(st.floats(0.2, 2), min_size=3, max_size=8), st.floats(0.2, 1), st.floats(0.2, 1), st.floats(-0.3, 0.3))
def test_every_limit_holds_in_reverse(radii, speed, supply, com_offset):
    """So they do backwards, where the centre of mass is on the other side of the axle, as seen from the motion."""
    robot = CAR.model_copy(update={"com_offset": com_offset, "supply": supply * CAR.supply})
    p = np.array(radii) * np.exp(2j * np.pi * np.arange(len(radii)) / len(radii))
    limits, top = Limits.of(robot), speed * robot.max_speed
    fixed = {
        "points": [(z.real, z.imag) for z in p],
        "closed": False,
        "timing": "limits",
        "limits": limits.model_dump(),
    }
    try:
        course = Waypoints.from_dict({**fixed, "speed": top, "cusps": [0]})
    except InputError:
        reject()
    motion = course.sample(np.linspace(0, course.period, 5001))
    assert motion.twist[:, 0].max() < 1e-12 and loads(motion, robot, limits, top).max() <= 1.01


@pytest.mark.full
def test_every_limit_holds_full():
    """So for 9,700 curves, which with the plans of missions are 10⁴."""
    random, shares, refused = np.random.default_rng(0), [], 0
    while len(shares) < 9700:
        name, closed = str(random.choice(sorted(ROBOTS))), bool(random.integers(2))
        radii = random.uniform(0.2, 2, random.integers(3, 9))
        try:
            drawn = polygon(name, radii, closed, *random.uniform([0.2, 0.2, 0.05], [1, 1, 0.5]))
        except InputError:
            refused += 1
            continue
        shares.append(keeps_limits(*drawn)[0])
        if len(shares) % 1000 == 0:
            print(f"{len(shares)} curves, {refused} refused, largest share of a limit {max(shares):.5f}", flush=True)


@pytest.mark.parametrize(("kinds", "seeds"), [(KINDS[:1], 1), pytest.param(KINDS, 20, marks=pytest.mark.full)])
def test_plans_of_missions(kinds, seeds):
    """The reference of every plan keeps all limits, and takes little longer than by the time-optimal law."""
    for name, robot in ROBOTS.items():
        scenario, shares, longer = mrctl.Scenario.from_dict({"robot": {"path": name}}), [], []
        for kind, seed in product(kinds, range(1, seeds + 1)):
            try:
                reference = planned(Query(task_of(f"{kind}:{seed}", scenario), Vehicle.of(scenario)))[1]
            except InputError as error:  # worlds without a way
                print(name, kind, seed, error)
                continue
            share, factor = keeps_limits(reference, robot, reference.speed)
            shares.append(share)
            longer.append(factor)
        print(f"{name}: {len(shares)} plans, largest share of a limit {max(shares):.5f};", end=" ")
        print(f"time over the least: mean {np.mean(longer):.3f}, largest {max(longer):.3f}")
        assert len(shares) > 0.9 * len(kinds) * seeds and max(longer) < 1.15


@pytest.mark.parametrize("seeds", [12, pytest.param(500, marks=pytest.mark.full)])
@pytest.mark.parametrize("name", ROBOTS)
def test_random_spline(name, seeds):
    """It is a function of its seed, keeps all limits and changes its speed; smoothing costs some per cent."""
    robot, spread, longer = ROBOTS[name], [], []
    for seed in range(seeds):
        course = random_spline(np.random.default_rng(seed), robot)
        assert course == random_spline(np.random.default_rng(seed), robot)
        check(course, robot, reverse=False)
        motion = course.sample(np.linspace(0, course.period, 5001))
        assert loads(motion, robot, Limits.of(robot), 0.95 * robot.max_speed).max() <= 1.001
        spread.append(motion.twist[:, 0].min() / motion.twist[:, 0].max())
        longer.append(course.period / fastest(course._law.law.path, course.limits, course.speed).duration)
    print(f"{name}: time over the least: mean {np.mean(longer):.3f}, 99 % {np.quantile(longer, 0.99):.3f},", end=" ")
    print(f"largest {max(longer):.3f}")
    assert np.mean(spread) < 0.75 and max(spread) < 0.95
    assert np.mean(longer) < 1.04 and np.quantile(longer, 0.98) < 1.07
    assert max(longer) < (1.07 if seeds == 12 else 1.11)


def test_speed_stays_real_where_the_limits_ask_for_acceleration():
    """On a narrow way back under much smoothing, limits may ask for more acceleration than leads there from rest."""
    hairpin = ((1.851, 0.656), (-0.756, -0.859), (1.325, 0.742))
    limits = Limits(smoothing=2.0)
    course = Waypoints(points=hairpin, closed=False, timing="limits", limits=limits, speed=1.237266906362581)
    assert np.isfinite(course.period)
    assert np.isfinite(course.sample(np.linspace(0, course.period, 1000)).twist).all()


def test_default_limits():
    """The defaults are those of the default robot, times the share that is used."""
    expected = Limits.of(CAR)
    for name in Limits.model_fields:
        np.testing.assert_allclose(getattr(Limits(), name), getattr(expected, name), rtol=1e-4)


@pytest.mark.parametrize("length", [0.5, 5.0, 500.0])
def test_straight_line(length):
    """On a straight line the time-optimal law is a trapezoid, or a triangle on a short one."""
    line = Waypoints(points=((0, 0), (0.6 * length, 0.8 * length)), closed=False, speed=1.2, timing="limits")
    v, a = 1.2, line.limits.acceleration
    expected = length / v + v / a if length > v**2 / a else 2 * np.sqrt(length / a)
    law = fastest(line._law.law.path, line.limits, v)
    assert law.duration == pytest.approx(expected, rel=1e-3)
    assert line.period == pytest.approx(expected + line.limits.smoothing, rel=1e-3)
    t = np.array([0.1, 0.3])
    np.testing.assert_allclose(law.at(t)[1:], [a * t**2 / 2, a * t, [a, a]], rtol=1e-6)
    peak = min(v, a * expected / 2)
    assert law.at(np.array([expected / 2]))[2] == pytest.approx(peak, rel=0.02)


@pytest.mark.parametrize("length", [0.05, 0.2, 1.0])
def test_start_speed_on_a_straight_line(length):
    """It is kept for half the smoothing, and is at most that from which the robot can brake to rest on the line."""
    line = Waypoints(
        points=((0, 0), (length, 0)), closed=False, speed=1.2, timing="limits", limits=NO_VOLTAGE, start_speed=0.9
    )
    half, a = NO_VOLTAGE.smoothing / 2, NO_VOLTAGE.acceleration
    largest = a * (np.sqrt(half**2 + 2 * length / a) - half)  # v half + v²/(2 a) = length
    motion = line.sample(np.array([0.0, line.period]))
    assert motion.twist[0, 0] == pytest.approx(min(0.9, largest), rel=5e-3)
    assert abs(motion.acceleration[0, 0]) < 1e-9 and motion.pose[1, 0] == pytest.approx(length)
    if largest > 0.9:  # it speeds up and brakes
        way = length - 0.9 * half
        top = np.sqrt(a * way + 0.9**2 / 2)
        expected = (2 * top - 0.9) / a if top < 1.2 else 2.1 / a - 0.6 / a + (way - (2.88 - 0.81) / (2 * a)) / 1.2
        assert line.period == pytest.approx(expected + 2 * half, rel=2e-3)


def test_no_start_speed():
    """Without one, or with one that counts as rest, the law is the same to the last bit; a small one changes little."""
    line = Waypoints(points=((0, 0), (1, 0.5), (2, 0)), closed=False, timing="limits")
    t = np.linspace(0, line.period, 500)
    rest = np.hstack(line.sample(t))
    for start in (0.0, 1e-200, 9e-4):
        same = line.replace(start_speed=start, start_curvature=0.0)
        assert np.hstack(same.sample(t)).tobytes() == rest.tobytes()
    np.testing.assert_allclose(line.replace(start_speed=1e-3).sample(t).twist, line.sample(t).twist, atol=5e-3)


def test_straight_line_at_low_voltage():
    """Where the voltage limits both ways, the speed rises and falls by the exponentials of the motor."""
    limits = Limits.of(CAR).model_copy(update={"voltage": 6.0, "acceleration": 100.0})
    (emf, _), _, (inertia, _), *_, (loss, _), _ = limits.inverse
    rise = lambda v: (6.0 - 2 * loss - emf * v) / inertia  # noqa: E731
    fall = lambda v: (6.0 + 2 * loss + emf * v) / inertia  # noqa: E731

    def both(integrand, v):
        return quad(lambda w: integrand(w) / rise(w), 0, v)[0] + quad(lambda w: integrand(w) / fall(w), 0, v)[0]

    top = brentq(lambda v: both(lambda w: w, v) - 0.3, 0, 0.999 * (6.0 - 2 * loss) / emf)
    s = np.linspace(0, 0.3, 2001)
    law = fastest(Path(s, 0 * s, 0 * s, False), limits, 1.5)
    assert law.duration == pytest.approx(both(lambda w: 1.0, top), rel=1e-3)
    assert law.at(law.times)[2].max() == pytest.approx(top, rel=1e-3)


@pytest.mark.parametrize("radius", [0.3, 1.0, 20.0])
@pytest.mark.parametrize(
    "change", [{}, {"lateral_acceleration": 0.3}, {"rotation": 0.5}, {"voltage": 6.0}], ids=lambda c: "".join(c)
)
def test_circle(radius, change):
    """A circle is driven at the constant speed that its tightest limit allows, averaged or not."""
    limits = Limits.of(CAR).model_copy(update=change)

    def excess(v):
        voltage = inverse_dynamics([v, v / radius], [0, 0], CAR)
        return np.abs(voltage).max() - limits.voltage

    expected = min(1.4, limits.rotation * radius, np.sqrt(limits.lateral_acceleration * radius))
    if excess(expected) > 0:
        expected = brentq(excess, 1e-3, expected)
    s = np.linspace(0, 2 * np.pi * radius, 401)
    path = Path(s, np.full(401, 1 / radius), np.zeros(401), True)
    for law in (fastest(path, limits, 1.4), smooth(path, limits, 1.4)):
        assert law.duration == pytest.approx(2 * np.pi * radius / expected, rel=1e-6)
        *_, v, a = law.at(np.linspace(0, 2 * law.duration, 50))
        np.testing.assert_allclose(v, expected, rtol=1e-6)
        np.testing.assert_allclose(a, 0, atol=1e-6)


def test_grip_is_the_robots():
    """On a tight circle with a fast rotation the tyres of the racing car limit the speed."""
    racer = ROBOTS["racecar"]
    limits = Limits.of(racer, 1.0).model_copy(update={"rotation": 100.0, "inverse": ()})
    s = np.linspace(0, 2 * np.pi * 0.5, 101)
    law = fastest(Path(s, np.full(101, 2.0), np.zeros(101), True), limits, 20.0)
    assert 2 * np.pi * 0.5 / law.duration == pytest.approx(np.sqrt(racer.tyre_friction * GRAVITY * 0.5), rel=1e-6)


def test_laps():
    """A closed course repeats after its period, also after ten thousand laps, and begins at its first point."""
    course = random_spline(np.random.default_rng(5), CAR)
    t = np.linspace(0, course.period, 500, endpoint=False)
    now = course.sample(t)
    np.testing.assert_allclose(now.pose[0, :2], course.points[0], atol=1e-9)
    for laps, tolerance in ((1, 1e-9), (10_000, 1e-7)):
        later = course.sample(t + laps * course.period)
        np.testing.assert_allclose(later.pose[:, :2], now.pose[:, :2], atol=tolerance)
        np.testing.assert_allclose(later.twist, now.twist, atol=tolerance)
        np.testing.assert_allclose(later.acceleration, now.acceleration, atol=100 * tolerance)


def test_intervals_follow_the_curve():
    """A sharp bend of a long path and the way from rest are sampled finely, and the number of intervals is bounded."""

    def shape(s):
        u = (s - 50) / 0.05
        return 20 * np.exp(-(u**2)), -20 * 2 * u / 0.05 * np.exp(-(u**2))

    s = np.append(np.linspace(0, 49, 20), np.append(np.linspace(49.5, 50.5, 201), np.linspace(51, 100, 20)))
    path = sample_path(shape, s, False, NO_VOLTAGE, 10.0)
    assert 50 < np.sum(np.abs(path.s - 50) < 0.1) < len(path.s) / 5
    assert path.s[2] < 0.01 and path.s[-1] - path.s[-3] < 0.01
    assert np.trapezoid(path.curvature, path.s) == pytest.approx(np.sqrt(np.pi), rel=1e-3)
    assert len(sample_path(shape, s, False, NO_VOLTAGE, 0.01).s) == 40_001


@pytest.mark.parametrize(
    ("limits", "words"),
    [
        ({"voltage": 0.5}, "limits.voltage: too low"),
        ({"inverse": [[1.0, 0.0]]}, "inverse: has 1 rows"),
        ({"acceleration": 0.0}, "limits.acceleration"),
        ({"smoothing": 0.0}, "limits.smoothing"),
    ],
)
def test_bad_limits(limits, words):
    """Limits with which no robot can move are refused with the name of the field."""
    with pytest.raises(InputError, match=words):
        Waypoints.from_dict({"timing": "limits", "limits": limits})
