"""References against finite differences, analytic values and the non-holonomic constraint, also from lap to lap."""

import re
import tomllib

import numpy as np
import pytest
from hypothesis import assume, given, reject, settings
from hypothesis import strategies as st
from pydantic import TypeAdapter, ValidationError

from mrctl.record import InputError, describe
from mrctl.theory.references import (
    Circle,
    LaneChange,
    Lemniscate,
    Line,
    Reference,
    RoundedSquare,
    StopAndGo,
    Waypoints,
    check,
    from_curve,
)
from mrctl.theory.robot import Robot

ROBOT = Robot(
    mass=20, yaw_inertia=0.6, com_offset=0.1, com_height=0.12, wheel_radius=0.098, front_wheel_radius=0.075,
    half_track=0.188, wheelbase=0.4, trail=0.03, steering_limit=1.0472, resistance=2.32, inductance=0,
    torque_constant=0.02346, gear_ratio=43, rotor_inertia=1.03e-6, no_load_current=0.037, gear_loss=0.1,
    rolling_coefficient=0.015, wheel_inertia=3.4e-3, front_wheel_inertia=7e-4, supply=24, tyre_friction=0.9,
    max_speed=1.5, max_rotation=3, max_acceleration=1.5, max_rotation_acceleration=6,
)  # fmt: skip
OPEN = ((0, 0), (2, 0.3), (4, -0.2), (6, 1))
DEFAULTS = [
    Line(heading=2.5), Circle(), Circle(clockwise=True), Lemniscate(), LaneChange(), LaneChange(shift=-1),
    RoundedSquare(), StopAndGo(), StopAndGo(reverse=False), Waypoints(), Waypoints(points=OPEN, closed=False),
    Waypoints(speed=1.4, timing="limits"), Waypoints(points=OPEN, closed=False, speed=1.4, timing="limits"),
]  # fmt: skip
CLOSED = [
    Circle(), Circle(clockwise=True), Lemniscate(), RoundedSquare(), StopAndGo(), Waypoints(),
    Waypoints(speed=1.4, timing="limits"),
]  # fmt: skip
KINDS = TypeAdapter(Reference)
each = pytest.mark.parametrize("reference", DEFAULTS, ids=lambda r: r.kind)


def hold(reference, t, h=1e-4, tolerance=1e-6):
    """Checks twist and acceleration at the times t by central differences, and the direction of motion."""
    before, now, after = (reference.sample(t + step) for step in (-h, 0, h))
    rate = (after.pose - before.pose) / (2 * h)
    theta, (v, omega) = now.pose[:, 2], now.twist.T
    scale = 1 + np.abs(now.twist).max() + np.abs(now.acceleration).max()
    expected = np.stack([v * np.cos(theta), v * np.sin(theta), omega], -1)
    np.testing.assert_allclose(rate, expected, atol=tolerance * scale)
    acceleration = (after.twist - before.twist) / (2 * h)
    np.testing.assert_allclose(acceleration, now.acceleration, atol=30 * tolerance * scale)
    np.testing.assert_allclose(rate[:, 0] * np.sin(theta), rate[:, 1] * np.cos(theta), atol=tolerance * scale)


@each
def test_derivatives(reference):
    """Twist and acceleration are the derivatives of the pose, over two laps with their seams."""
    hold(reference, np.linspace(0.01, 2.2 * reference.period, 1500))


size, duration, speed = st.floats(0.3, 5), st.floats(4, 30), st.floats(0.1, 2)


@settings(max_examples=60, deadline=None)
@given(
    st.one_of(
        st.builds(Line, speed=speed, heading=st.floats(-3, 3)),
        st.builds(Circle, radius=size, period=duration, clockwise=st.booleans()),
        st.builds(Lemniscate, size=size, period=duration),
        st.builds(LaneChange, length=st.floats(2, 9), shift=st.floats(-2, 2), speed=speed),
        st.builds(RoundedSquare, side=st.floats(2, 9), radius=st.floats(0.3, 0.5), speed=speed),
        st.builds(StopAndGo, distance=size, move_time=duration, pause=st.floats(0, 2), reverse=st.booleans()),
    )
)
def test_derivatives_anywhere(reference):
    """They are so for random parameters too."""
    hold(reference, np.linspace(0.01, 1.5 * reference.period, 200), tolerance=1e-5)


@settings(max_examples=25, deadline=None)
@given(st.lists(st.floats(0.8, 1.5), min_size=3, max_size=9), speed, st.booleans())
def test_spline_anywhere(radii, speed, closed):
    """A random star-shaped spline has the right derivatives, constant speed, and passes all its points."""
    angles = 2 * np.pi * np.arange(len(radii)) / len(radii)
    points = tuple((r * np.cos(a), r * np.sin(a)) for r, a in zip(radii, angles, strict=True))
    try:
        reference = Waypoints(points=points, speed=speed, closed=closed)
    except InputError:
        reject()
    t = np.linspace(0, reference.period, 20001)
    motion = reference.sample(t)
    assume(np.abs(motion.acceleration).max() < 100)
    hold(reference, t[1::100], tolerance=1e-5)
    gaps = np.abs(motion.pose[:, None, :2] - np.array(points)[None]).max(-1).min(0)
    assert gaps.max() < reference.period / 20000 * speed
    if closed:
        np.testing.assert_allclose(motion.twist[:, 0], speed)


@each
def test_continuity(reference):
    """Pose, twist and acceleration have no jumps: halving the step halves the largest change."""
    fine = reference.sample(np.linspace(0, 2.5 * reference.period, 40001))
    for part in fine:
        jump, coarse = np.abs(np.diff(part, axis=0)).max(0), np.abs(np.diff(part[::4], axis=0)).max(0)
        assert (jump <= 0.3 * coarse + 1e-9).all()


@pytest.mark.parametrize("reference", CLOSED, ids=lambda r: r.kind)
def test_closure(reference):
    """Everything repeats a lap later, the heading up to whole turns."""
    t = np.linspace(0, reference.period, 301)
    now, later = reference.sample(t), reference.sample(t + reference.period)
    np.testing.assert_allclose(later.pose[:, :2], now.pose[:, :2], atol=1e-9)
    turns = (later.pose[:, 2] - now.pose[:, 2]) / (2 * np.pi)
    np.testing.assert_allclose(turns, np.full(t.shape, np.round(turns[0])), atol=1e-9)
    np.testing.assert_allclose(later.twist, now.twist, atol=1e-9)
    np.testing.assert_allclose(later.acceleration, now.acceleration, atol=1e-8)


@each
def test_pointwise(reference):
    """A sample depends on its own time alone: no heading is unwrapped along the array."""
    t = np.random.default_rng(0).uniform(0, 3 * reference.period, 40)
    together = reference.sample(t)
    for i in range(len(t)):
        for whole, alone in zip(together, reference.sample(t[i : i + 1]), strict=True):
            np.testing.assert_allclose(whole[i], alone[0], atol=1e-12)
    assert [part.shape for part in together] == [(40, 3), (40, 2), (40, 2)]


def test_line():
    """A line at 30° goes on along its direction after its length."""
    motion = Line(speed=0.5, length=2, heading=np.pi / 6).sample(np.array([0.0, 4, 8]))
    s = np.array([0, 2, 4])
    expected = np.stack([s * np.sqrt(3) / 2, s / 2, np.full(3, np.pi / 6)], -1)
    np.testing.assert_allclose(motion.pose, expected, atol=1e-12)
    np.testing.assert_array_equal(motion.twist, [[0.5, 0]] * 3)


@pytest.mark.parametrize("sign", [1, -1])
def test_circle(sign):
    """After a quarter of its period a circle about (0, ±R) is a quarter turn on."""
    motion = Circle(radius=2, period=8, clockwise=sign < 0).sample(np.array([0.0, 2, 4, 10]))
    expected = np.array([(0, 0, 0), (2, 2, np.pi / 2), (0, 4, np.pi), (2, 2, 2.5 * np.pi)]) * (1, sign, sign)
    np.testing.assert_allclose(motion.pose, expected, atol=1e-12)
    np.testing.assert_allclose(motion.twist, [[np.pi / 2, sign * np.pi / 4]] * 4)
    np.testing.assert_array_equal(motion.acceleration, np.zeros((4, 2)))


def test_lemniscate():
    """The lemniscate is Gerono's curve x⁴ = a²(x² - y²), with its tips, and its speed a w √2 in the middle."""
    reference = Lemniscate()
    motion = reference.sample(np.linspace(0, 24, 500))
    x, y, theta = motion.pose.T
    np.testing.assert_allclose(x**4, 1.5**2 * (x**2 - y**2), atol=1e-12)
    assert theta.max() <= np.pi / 4 + 1e-12 and theta.min() >= -5 * np.pi / 4 - 1e-12
    tip = reference.sample(np.array([0.0, 3, 6, 9]))
    np.testing.assert_allclose(tip.pose[:, :2], [(0, 0), (1.5, 0), (0, 0), (-1.5, 0)], atol=1e-12)
    np.testing.assert_allclose(tip.pose[:, 2], np.pi * np.array([0.25, -0.5, -1.25, -0.5]), atol=1e-12)
    np.testing.assert_allclose(tip.twist[0, 0], 1.5 * np.pi / 6 * np.sqrt(2))


def test_lane_change():
    """A lane change is symmetric about its middle and straight afterwards."""
    reference = LaneChange(length=4, shift=1, speed=0.8)
    motion = reference.sample(np.array([0, 2.5, 5, 9]))
    np.testing.assert_allclose(motion.pose[:, :2], [(0, 0), (2, 0.5), (4, 1), (7.2, 1)], atol=1e-12)
    np.testing.assert_allclose(motion.pose[[0, 2, 3], 2], 0, atol=1e-12)
    np.testing.assert_allclose(motion.twist[[0, 2, 3]], [[0.8, 0]] * 3, atol=1e-12)


def test_rounded_square():
    """The square touches all four sides, turns no tighter than its radius, and takes as long as its path."""
    reference = RoundedSquare(side=3, radius=0.5, speed=0.5)
    t = np.linspace(0, reference.period, 20001)
    motion = reference.sample(t)
    x, y, theta = motion.pose.T
    np.testing.assert_allclose([x.min(), x.max(), y.min(), y.max()], [-1.5, 1.5, 0, 3], atol=1e-9)
    np.testing.assert_allclose(np.max(motion.twist[:, 1]) / 0.5, 1 / 0.5, rtol=1e-5)
    np.testing.assert_allclose(np.hypot(np.diff(x), np.diff(y)).sum(), 0.5 * reference.period, rtol=1e-6)
    np.testing.assert_allclose(theta[-1], 2 * np.pi)
    np.testing.assert_array_equal(motion.twist[:, 0], 0.5)


def test_stop_and_go():
    """It moves, rests, and moves back with V < 0 and the same heading; the peak speed is 1.875 d / T."""
    reference = StopAndGo(distance=2, move_time=3, pause=1)
    motion = reference.sample(np.array([0, 1.5, 3, 3.5, 5.5, 7, 7.5, 8, 9.5]))
    np.testing.assert_allclose(motion.pose[:, 0], [0, 1, 2, 2, 1, 0, 0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(motion.twist[:, 0], 1.25 * np.array([0, 1, 0, 0, -1, 0, 0, 0, 1]), atol=1e-12)
    np.testing.assert_array_equal(motion.pose[:, 1:], 0)
    onward = StopAndGo(distance=2, move_time=3, pause=1, reverse=False).sample(np.linspace(0, 16, 400))
    assert onward.twist.min() >= 0
    np.testing.assert_allclose(onward.pose[-1, 0], 8)


def test_spline_comes_to_rest():
    """An open spline leaves at its speed, stops on its last point and stays there."""
    reference = Waypoints(points=OPEN, closed=False)
    motion = reference.sample(reference.period + np.array([0.0, 0.1, 100]))
    np.testing.assert_allclose(motion.pose[:, :2], [OPEN[-1]] * 3, atol=1e-9)
    np.testing.assert_array_equal(motion.twist[1:], 0)
    np.testing.assert_array_equal(motion.acceleration[1:], 0)
    np.testing.assert_allclose(reference.sample(np.zeros(1)).twist, [[0.6, 0]], atol=1e-9)
    pair = Waypoints(points=((0, 0), (3, 4)), closed=False)
    assert pair.period == pytest.approx(5 / 0.6 + 1)


@each
def test_finite_at_rest(reference):
    """Every sample is finite, also at rest."""
    assert all(np.isfinite(part).all() for part in reference.sample(np.linspace(0, 3 * reference.period, 1000)))


def test_from_curve():
    """The accelerating spiral p = t² e^{it} has its analytic speed and θ = t + atan(t/2)."""
    t = np.linspace(0.5, 2, 50)
    spin = np.exp(1j * t)
    d = [t**2, 2 * t + 1j * t**2, 2 + 4j * t - t**2, 6j - 6 * t - 1j * t**2]
    motion = from_curve(*(factor * spin for factor in d))
    np.testing.assert_allclose(motion.pose[:, 2], t + np.arctan(t / 2))
    np.testing.assert_allclose(motion.twist, np.stack([t * np.sqrt(4 + t**2), 1 + 2 / (4 + t**2)], -1))
    v_dot = (4 + 2 * t**2) / np.sqrt(4 + t**2)
    np.testing.assert_allclose(motion.acceleration, np.stack([v_dot, -4 * t / (4 + t**2) ** 2], -1))


@pytest.mark.parametrize("kind", [Line, Circle, Lemniscate, LaneChange, RoundedSquare, StopAndGo, Waypoints])
def test_defaults_pass(kind):
    """The default robot can follow the default reference of every kind."""
    check(kind(), ROBOT, reverse=True)


@pytest.mark.parametrize(
    ("reference", "change", "words"),
    [
        (Lemniscate(), {"max_speed": 1.0}, "lemniscate: speed 1.11 m/s at t = 0.00 s .*max_speed 1 m/s"),
        (Circle(), {"max_rotation": 0.5}, "circle: rotation 0.785 rad/s .*max_rotation 0.5 rad/s"),
        (StopAndGo(), {"max_acceleration": 1.0}, "stop_and_go: acceleration 1.28 m/s² .*max_acceleration 1 m/s²"),
        (RoundedSquare(), {"max_rotation_acceleration": 1.0}, "rotation acceleration .*max_rotation_acceleration"),
        (Circle(radius=0.2), {}, "circle: steering angle 1.11 rad .*steering_limit 1.05 rad"),
        (Circle(radius=0.2, period=100), {}, "circle: steering angle 1.11 rad .*steering_limit 1.05 rad"),
        (Circle(), {"tyre_friction": 0.05}, "circle: lateral acceleration 0.617 m/s² .*tyre_friction .* 0.491 m/s²"),
        (StopAndGo(move_time=2, pause=3000), {}, "stop_and_go: speed 1.87"),
        (Circle(), {"max_speed": 0.785}, "circle: speed 0.7854 m/s .*max_speed 0.785 m/s"),  # not 0.785 over 0.785
    ],
)
def test_check_refuses(reference, change, words):
    """A reference beyond a limit is refused with the limit and the peak."""
    with pytest.raises(InputError, match=words) as refusal:
        check(reference, ROBOT.model_copy(update=change), reverse=True)
    assert "\n" not in str(refusal.value)


def test_check_refuses_nan():
    """What cannot be told from numbers is no reference to drive: a derivative that overflows."""
    steep = LaneChange.model_construct(**LaneChange().model_dump() | {"length": 1e-110, "shift": 0.0, "speed": 0.1})
    with np.errstate(all="ignore"), pytest.raises(InputError, match="lane_change: .* nan "):
        check(steep, ROBOT, reverse=True)


def test_check_reverse():
    """Only a stop-and-go with reverse needs a steering that can reverse."""
    with pytest.raises(InputError, match=r"stop_and_go: reverses at t = 4.0\d s, .* use rigid"):
        check(StopAndGo(), ROBOT, reverse=False)
    for reference in (*DEFAULTS[:7], *DEFAULTS[8:]):
        check(reference, ROBOT, reverse=False)


@each
def test_round_trip(reference):
    """A reference survives plain data and JSON."""
    assert KINDS.validate_python(reference.model_dump()) == reference
    assert KINDS.validate_json(reference.model_dump_json()) == reference


def test_toml():
    """A reference is read from TOML by its kind."""
    text = 'kind = "waypoints"\npoints = [[0, 0], [2, 0], [1.0, 2]]\nspeed = 0.4'
    assert KINDS.validate_python(tomllib.loads(text)) == Waypoints(points=((0, 0), (2, 0), (1, 2)), speed=0.4)


NARROW = [
    [0.561, 0.0], [0.68, 0.68], [0.0, 1.265], [-0.555, 0.555], [-1.594, 0.0], [-0.368, -0.368], [0.0, -1.137],
    [0.972, -0.972],
]  # fmt: skip


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"kind": "spiral"}, "'kind'"),
        ({"kind": "circle", "radius": -1}, "circle.radius: .*greater than or equal to 0.001"),
        ({"kind": "line", "speed": float("inf")}, "line.speed: "),
        ({"kind": "circle", "size": 1}, "circle.size: there is no such field"),
        ({"kind": "rounded_square", "side": 1, "radius": 0.4}, "radius: corners do not fit .*at most 0.2885 m"),
        ({"kind": "waypoints", "points": [[0, 0], [1, 0]]}, "points: a closed curve needs at least 3"),
        ({"kind": "waypoints", "points": [[0, 0]], "closed": False}, "points: an open curve needs at least 2"),
        ({"kind": "waypoints", "points": [[0, 0], [1, 0], [1, 0], [0, 1]]}, "points: 1 and 2 coincide"),
        (
            {"kind": "waypoints", "points": [[0, 0], [1, 0], [0, 1], [0, 0]]},
            "points: 3 and 0 coincide; a closed curve returns",
        ),
        ({"kind": "waypoints", "points": [[0, 0], [1, 0], [2, 0]]}, "points: the curve turns on the spot near"),
        # Here |dp/du| is above the least value at the 64 samples between two points, and below it between these.
        ({"kind": "waypoints", "points": NARROW}, r"points: the curve turns on the spot near \(-1.60, -0.00\)"),
        ({"kind": "waypoints", "points": [[0, 0], [0.2, 0]], "closed": False}, "stop_time: too long to stop"),
    ],
)
def test_bad_field(values, words):
    """An invalid value is refused with one line that names the field."""
    with pytest.raises(ValidationError) as refusal:
        KINDS.validate_python(values)
    message = describe(refusal.value)
    assert "\n" not in message
    assert re.search(words, message), message


CUSPS = {
    "points": ((0, 0), (0.6, 0.1), (1.2, 0.5), (0.7, 0.35), (0.1, 0.5), (0.6, 0.4), (1.2, 0.4)),
    "closed": False,
    "timing": "limits",
    "speed": 0.6,
}


@pytest.mark.parametrize("cusps", [(2, 4), (0, 2, 4)])
def test_cusps(cusps: tuple[int, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    """At each cusp the robot rests and changes its direction; twist and acceleration are derivatives of the pose."""
    monkeypatch.setattr("mrctl.theory.references.MAX_CUSP_KINK", 1.0)  # these points were not made with care
    reference = Waypoints(**CUSPS, cusps=cusps)
    t = np.linspace(0, reference.period, 20_001)
    pose, twist, acceleration = reference.sample(t)
    step = t[1]
    rests = np.abs(twist[:, 0]) < 1e-6
    turns = np.flatnonzero(np.diff(np.sign(twist[~rests, 0])))
    assert len(turns) == 2 and np.sign(twist[~rests, 0][0]) == (-1 if 0 in cusps else 1)
    at = [np.argmin(np.hypot(*(pose[:, :2] - CUSPS["points"][k]).T)) for k in (2, 4)]
    assert np.abs(twist[at]).max() < 1e-3 and np.hypot(*(pose[-1, :2] - CUSPS["points"][-1])) < 1e-9
    smooth = np.ones(len(t), bool)
    for k in at:
        smooth[max(0, k - 3) : k + 4] = False  # where the heading may jump by the kink
    rate = np.gradient(pose, step, axis=0)
    along = rate[:, 0] * np.cos(pose[:, 2]) + rate[:, 1] * np.sin(pose[:, 2])
    inner = slice(2, -2)
    np.testing.assert_allclose(along[smooth][inner], twist[smooth, 0][inner], atol=1e-4)
    np.testing.assert_allclose(rate[smooth, 2][inner], twist[smooth, 1][inner], atol=2e-3)
    change = np.gradient(twist, step, axis=0)
    np.testing.assert_allclose(change[smooth][inner], acceleration[smooth][inner], atol=2e-2)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"closed": True}, "cusps: only an open curve"),
        ({"cusps": (4, 2)}, "cusps: must increase"),
        ({"cusps": (6,)}, "cusps: must increase"),
        ({"cusps": (1,)}, "cusps: the curve turns"),
        ({"points": ((0, 0), (1, 0), (0.5, 0), (1.2, 0), (0.4, 0)), "cusps": (1,)}, "points: the curve turns on the"),
    ],
)
def test_bad_cusps(changes: dict, words: str) -> None:
    """Cusps that no robot can drive are refused."""
    with pytest.raises(InputError, match=words):
        Waypoints.from_dict(CUSPS | {"cusps": (2, 4)} | changes)


@pytest.mark.parametrize("curvature", [-1.5, 0.7])
def test_start_of_a_turning_robot(curvature: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """A spline that begins on an arc has its heading, curvature and speed there; with cusps only its first part has."""
    s = np.array([0.0, 0.05, 0.25, 0.5, 0.75, 1.0, 1.25])
    p = (np.exp(1j * curvature * s) - 1) / (1j * curvature)
    points = [(z.real, z.imag) for z in p]
    course = Waypoints(
        points=points, closed=False, timing="limits", speed=0.7, start_speed=0.5, start_curvature=curvature
    )
    pose, (v, omega), _ = (part[0] for part in course.sample(np.zeros(1)))
    assert np.allclose(pose, 0, atol=1e-3) and v == pytest.approx(0.5) and omega == pytest.approx(0.5 * curvature, 2e-3)
    near = course.sample(np.linspace(0, 0.6, 50))
    assert np.allclose(near.twist[:, 1] / near.twist[:, 0], curvature, atol=0.06 * abs(curvature))
    monkeypatch.setattr("mrctl.theory.references.MAX_CUSP_KINK", 1.0)
    turning = Waypoints.from_dict(CUSPS | {"cusps": (2, 4), "start_speed": 0.3, "start_curvature": 0.01})
    (first, _), *others = turning._parts
    assert (first.start_speed, first.start_curvature) == (0.3, 0.01)
    assert all(part.start_speed == part.start_curvature == part.end_curvature == 0 for part, _ in others)
    assert turning.sample(np.zeros(1)).twist[0, 0] == pytest.approx(0.3, rel=0.01)
    assert Waypoints.from_dict(turning.model_dump(mode="json")) == turning


@given(first=st.floats(-2, 2), last=st.floats(-2, 2), heading=st.floats(-1, 1))
def test_ends_on_arcs(first: float, last: float, heading: float) -> None:
    """An open curve has the headings and curvatures of the arcs at its ends."""
    assume(min(abs(first), abs(last)) > 1e-3)

    def arc(curvature: float, s: float) -> complex:
        return (np.exp(1j * curvature * s) - 1) / (1j * curvature)

    points = [arc(first, s) for s in (0.0, 0.05, 0.25)]
    points += [2 + 0.5j + np.exp(1j * heading) * arc(last, s) for s in (-0.25, -0.05, 0.0)]
    plane = [(z.real, z.imag) for z in points]
    course = Waypoints(
        points=plane, closed=False, timing="limits", speed=0.5, start_curvature=first, end_curvature=last
    )
    (_, theta, curvature, _) = course._path.at(np.array([0.0, course._path.length]))
    assert np.allclose(theta, (0, heading), atol=1e-4) and np.allclose(curvature, (first, last), atol=1e-9)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"start_speed": 0.5}, "start_speed: only an open curve"),
        ({"start_speed": 0.5, "closed": False}, "start_speed: only an open curve"),
        ({"start_speed": -0.5}, "start_speed"),
        ({"start_curvature": 0.5}, "start_curvature: only an open curve"),
        ({"start_curvature": 50.0, "closed": False}, "start_curvature"),
        ({"end_curvature": -0.5}, "end_curvature: only an open curve"),
        ({"end_curvature": -2, "closed": False, "points": ((0, 0), (1, 0))}, "end_curvature: no arc through two"),
        ({"cusp_curvatures": [(0.1, 0.2)], "closed": False}, "cusp_curvatures: must be 0 pairs"),
        (CUSPS | {"cusps": (0, 2), "cusp_curvatures": [(0, 0)] * 2}, "cusp_curvatures: must be 1 pairs"),
        (CUSPS | {"cusps": (2,), "cusp_curvatures": [(0, 9)]}, "cusp_curvatures: no arc through two points"),
        (CUSPS | {"cusps": (1, 2), "points": ((0, 0), (1, 0), (1, 0), (0, 0))}, "points: 0 and 1 coincide"),
    ],
)
def test_bad_ends(changes: dict, words: str) -> None:
    """A start speed without a time law that keeps limits, the ends of a closed curve, and wrong cusps are refused."""
    with pytest.raises(InputError, match=f"^{words}"):
        Waypoints.from_dict(changes)
