"""Identification against equation (3) itself, written out here: a drive is integrated, measured and identified."""

import json

import numpy as np
import pytest

from mrctl.experiments import identify
from mrctl.experiments.identify import HOLD_TIME, Drive, derivative, drive_constants, lines, signals, turn_constants
from mrctl.sensing.tiers import Sensing
from mrctl.theory.perturbation import Perturbation
from mrctl.theory.robot import CAR, Robot, RobotFile


def integrate(robot: Robot, volts, start):
    """V, θ̇, distance and heading at the ticks `(N + 1, B, 4)` under voltages `(N, B, 2)`, wheels turning forwards."""
    r, d, k, b = robot.wheel_radius, robot.half_track, robot.back_emf, robot.wheel_damping
    lever, loss = robot.mass * robot.com_offset, 2 * robot.drive_loss / r + robot.rolling_force

    def rate(state, left, right):
        v, omega = state[:2]
        pull = k / r / robot.resistance * (left + right - 2 * k * v / r) - 2 * b * v / r**2
        twist = d * k / r / robot.resistance * (right - left - 2 * k * d * omega / r) - 2 * b * d**2 * omega / r**2
        v_dot = (pull + lever * omega**2 - loss) / robot.effective_mass
        return np.stack([v_dot, (twist - lever * v * omega) / robot.effective_inertia, v, omega])

    state = np.array(start).T
    state = np.concatenate([state, 0 * state])
    out = [state.T]
    for left, right in np.moveaxis(volts, -1, 1):
        k1 = rate(state, left, right)
        k2 = rate(state + HOLD_TIME / 2 * k1, left, right)
        k3 = rate(state + HOLD_TIME / 2 * k2, left, right)
        k4 = rate(state + HOLD_TIME * k3, left, right)
        state = state + HOLD_TIME / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        out.append(state.T)
    return np.array(out)


def both(robot, mean, turn):
    """Left and right wheel from the motion of the axle, `(…, 2)`."""
    return (mean[..., None] + [-robot.half_track, robot.half_track] * turn[..., None]) / robot.wheel_radius


def drives(robot, count, random, turns, quantum=0.0, noise=0.0):
    """Drives of several robots, the second period of two; encoders with counts, and a noisy gyro that drifts."""
    common, differential = np.moveaxis(np.stack([signals(robot, random, turns) for _ in range(count)], 1), -1, 0)
    volts = np.tile(np.stack([common - differential, common + differential], -1), (2, 1, 1))
    v, omega, way, heading = integrate(robot, volts, np.tile([robot.max_speed / 2, 0.0], (count, 1)))[1:].T
    current = (volts - robot.back_emf * both(robot, v, omega).swapaxes(0, 1)) / robot.resistance
    encoders = both(robot, way, heading).swapaxes(0, 1)
    if quantum:
        encoders = quantum * np.floor(encoders / quantum + random.random((count, 2)))
    time = HOLD_TIME * np.arange(1, len(volts) + 1)
    gyro = omega.T + noise * (random.standard_normal(omega.T.shape) + 0.1 * time[:, None])
    whole, highest = len(volts) // 2, 2 * round(identify._bandwidth(robot) * identify.PERIOD)
    seen = [lines(time[whole:], signal[whole:], highest) for signal in (encoders, gyro, volts, current)]
    parts = derivative(*seen[0]), *(part for part, _ in seen[1:])
    return [Drive(*(part[:, b] for part in parts)) for b in range(count)]


def truths(robot):
    return {
        "R_a": robot.resistance, "N k": robot.back_emf, "M_e": robot.effective_mass,
        "F_c": 2 * robot.drive_loss / robot.wheel_radius + robot.rolling_force,
        "J_e": robot.effective_inertia, "m c": robot.mass * robot.com_offset,
    }  # fmt: skip


def constants(robot, straight, turn):
    found = drive_constants(straight, robot)
    return found | turn_constants(turn, found["R_a"], found["N k"], robot)


def test_lines():
    """Mean, harmonics and trend of a signal that is written down, from samples of which every third is missing."""
    time = 0.05 * np.array([k for k in range(400) if k % 3])
    turn = 2 * np.pi / identify.PERIOD * time
    values = 3.0 + 0.5 * (time - time.mean()) + 2.0 * np.cos(turn) - 0.4 * np.sin(5 * turn)
    found, trend = lines(time, np.stack([values, 2 * values], axis=1), 7)
    expected = np.zeros(8, complex)
    expected[[0, 1, 5]] = 3.0, 1.0, 0.2j
    np.testing.assert_allclose(found, np.outer(expected, [1, 2]), atol=1e-12)
    assert trend == pytest.approx([0.5, 1.0])
    slope = derivative(found, trend)[:, 0]
    omega = 2 * np.pi / identify.PERIOD
    assert slope[[0, 1, 5]] == pytest.approx([0.5, 1j * omega, -omega]) and np.abs(slope[[2, 3, 4, 6, 7]]).max() < 1e-12


def test_average_and_product():
    """The mean over a tick against an integral, and the product of two signals against that of their samples."""
    random = np.random.default_rng(0)
    first, second = random.standard_normal((2, 6)) + 1j * np.pad(random.standard_normal((2, 5)), ((0, 0), (1, 0)))

    def at(of, time):
        return of[0].real + 2 * (of[1:, None] * np.exp(1j * np.outer(identify.frequencies(6)[1:], time))).real.sum(0)

    fine = 3.0 - HOLD_TIME + HOLD_TIME * (np.arange(1000) + 0.5) / 1000
    assert at(identify.average(first), 3.0)[0] == pytest.approx(at(first, fine).mean(), rel=1e-6)
    time = identify.PERIOD * np.arange(40) / 40
    expected = np.fft.rfft(at(first, time) * at(second, time))[:6] / 40
    np.testing.assert_allclose(identify.product(first, second), expected, atol=1e-12)


@pytest.mark.parametrize("damping", [0.0, 0.08])
def test_exact(robot, damping):
    """Without noise every constant comes back; 0.2 % is what straight lines for currents within a tick cost."""
    random, robot = np.random.default_rng(1), robot.model_copy(update={"wheel_damping": damping})
    ahead, turning = (drives(robot, 2, random, turns) for turns in (False, True))
    for pair in zip(ahead, turning, strict=True):
        assert constants(robot, *pair) == pytest.approx(truths(robot), rel=2e-3)


@pytest.fixture(scope="module")
def unchanged(robot):
    """The constants of the robot as it is, from the draws of `test_tells_apart`."""
    return from_draws(robot, robot)


def from_draws(driven, robot):
    """The constants of a robot that is driven, identified as those of another one."""
    random = np.random.default_rng(2)
    return constants(robot, drives(driven, 1, random, False)[0], drives(driven, 1, random, True)[0])


@pytest.mark.xdist_group("tells_apart")  # whose unchanged robot is driven once
@pytest.mark.parametrize(
    ("field", "factor", "moves"),
    [
        ("mass", 1.4, {"M_e", "J_e", "m c", "F_c"}),
        ("yaw_inertia", 1.5, {"J_e"}),
        ("resistance", 1.3, {"R_a"}),
        ("rotor_inertia", 5.0, {"M_e", "J_e"}),
        ("gear_loss", 3.0, {"F_c"}),
        ("com_offset", 0.5, {"m c", "J_e"}),
    ],
)
def test_tells_apart(robot, unchanged, field, factor, moves):
    """A change of the robot shows in the constants that hold it and in no other."""
    changed = from_draws(robot.model_copy(update={field: factor * getattr(robot, field)}), robot)
    assert {name for name in unchanged if changed[name] != pytest.approx(unchanged[name], rel=0.01)} == moves


def test_intervals_cover(robot):
    """Of 120 intervals, each from 8 noisy drives and without the share for the model, some 95 % hold the truth.

    The sensors are bad enough for their errors to exceed the 0.2 % that currents within a tick cost.
    """
    random, repeats, groups = np.random.default_rng(3), identify.REPEATS, 20
    ahead, turning = (drives(robot, repeats * groups, random, turns, 0.5, 0.5) for turns in (False, True))
    rows = [constants(robot, *pair) for pair in zip(ahead, turning, strict=True)]
    covered = 0
    for name, true in truths(robot).items():
        values = np.array([row[name] for row in rows]).reshape(groups, repeats)
        reach = identify.scatter(values)
        covered += int(np.sum(np.abs(values.mean(axis=1) - true) <= reach))
    assert 106 <= covered <= 119, covered


def test_identifiable():
    """A constant is identifiable if half of its interval is at most a tenth of it; the table says which are not."""
    good = identify.Constant("M_e", "kg", 20.0, 18.1, 21.9, 20.5)
    bad = identify.Constant("m c", "kg·m", 2.0, 1.7, 2.3, 2.1)
    assert good.identifiable and not bad.identifiable
    text = identify.text([good, bad])
    assert "within 10 %: m c." in text and "cannot tell" not in identify.text([good])


def test_signals(robot):
    """Predicted from equation (3), the drive keeps to the robot's limits, and both wheels turn forwards."""
    for turns in (False, True):
        period = np.stack([signals(robot, np.random.default_rng([4, k]), turns) for k in range(3)], axis=1)
        common, differential = np.moveaxis(period, -1, 0)
        volts = np.tile(np.stack([common - differential, common + differential], -1), (2, 1, 1))
        path = integrate(robot, volts, np.tile([robot.max_speed / 2, 0.0], (3, 1)))[len(period) :]
        v, omega = path[..., 0], path[..., 1]
        v_dot, omega_dot = (np.diff(one, axis=0) / HOLD_TIME for one in (v, omega))
        assert v.min() > robot.half_track * np.abs(omega).max() and v.max() < robot.max_speed
        assert np.abs(v_dot).max() < robot.max_acceleration
        assert np.abs(omega_dot).max() < robot.max_rotation_acceleration
        assert np.abs(volts).max() < robot.supply
        assert (np.abs(omega).max() > 0.05) == turns


def test_json_says_what_was_identified(monkeypatch):
    """All arguments can be read back: the true values are those of the perturbed robot."""
    asked = []
    monkeypatch.setattr(identify, "identify", lambda *arguments: asked.append(arguments) or [])
    given = "flat", CAR, Perturbation(mass_factor=1.5), Sensing(tier="field"), 7
    found = json.loads(identify.run(*given, json=True))
    kinds = {"robot": RobotFile, "perturbation": Perturbation, "sensing": Sensing}
    back = {name: kind.model_validate(found[name]) for name, kind in kinds.items()}
    assert asked == [(found["world"], *back.values(), found["seed"])] == [given]


def test_error_of_a_constant_that_is_zero() -> None:
    """A robot without a loss has no relative error of it, and the table shows that there is none."""
    found = identify.Constant("I_0", "A", estimate=0.01, low=-0.02, high=0.04, true=0.0)
    assert np.isnan(found.error)
