"""Identification against equation (3) itself, written out here: a drive is integrated, measured and told apart."""

import numpy as np
import pytest

from mrctl.experiments import identify
from mrctl.experiments.identify import TICK, Drive, drive_constants, signals, turn_constants
from mrctl.theory.robot import Robot


def integrate(robot: Robot, volts, start):
    """Twist at the ticks `(N + 1, B, 2)` under voltages `(N, B, 2)` left and right, both wheels turning forwards."""
    r, d, k = robot.wheel_radius, robot.half_track, robot.back_emf
    lever, loss = robot.mass * robot.com_offset, 2 * robot.drive_loss / r + robot.rolling_force

    def rate(state, left, right):
        v, omega = state
        pull = k / r / robot.resistance * (left + right - 2 * k * v / r)
        twist = d * k / r / robot.resistance * (right - left - 2 * k * d * omega / r)
        return np.stack([
            (pull + lever * omega**2 - loss) / robot.effective_mass,
            (twist - lever * v * omega) / robot.effective_inertia,
        ])  # fmt: skip

    state, out = np.array(start).T, [np.array(start)]
    for left, right in np.moveaxis(volts, -1, 1):
        k1 = rate(state, left, right)
        k2 = rate(state + TICK / 2 * k1, left, right)
        k3 = rate(state + TICK / 2 * k2, left, right)
        k4 = rate(state + TICK * k3, left, right)
        state = state + TICK / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        out.append(state.T)
    return np.array(out)


def drives(robot, count, random, turns, noise=(0.0, 0.0)):
    """Drives of several robots, the second period of two."""
    common, apart = np.moveaxis(np.stack([signals(robot, random, turns) for _ in range(count)], 1), -1, 0)
    volts = np.stack([common - apart, common + apart], -1)
    twist = integrate(robot, np.tile(volts, (2, 1, 1)), np.tile([robot.max_speed / 2, 0.0], (count, 1)))[len(volts) :]
    rates = (twist[1:, :, :1] + [-robot.half_track, robot.half_track] * twist[1:, :, 1:]) / robot.wheel_radius
    current = (volts - robot.back_emf * rates) / robot.resistance
    seen = twist + random.standard_normal(twist.shape) * noise
    first, last = seen[:-1], seen[1:]
    parts = ((first + last) / 2, (last - first) / TICK, last, volts, current)
    return [Drive(*(part[:, b] for part in parts)) for b in range(count)]


def truths(robot):
    return {
        "R_a": robot.resistance, "N k": robot.back_emf, "M_e": robot.effective_mass,
        "F_c": 2 * robot.drive_loss / robot.wheel_radius + robot.rolling_force,
        "J_e": robot.effective_inertia, "m c": robot.mass * robot.com_offset,
    }  # fmt: skip


def constants(robot, straight, turn, highest=60):
    found = drive_constants(straight, robot.wheel_radius, highest)
    return found | turn_constants(turn, found["R_a"], found["N k"], robot, highest)


def test_exact(robot):
    """Without noise every constant comes back; 0.2 % is what straight lines for currents within a tick cost."""
    random = np.random.default_rng(1)
    ahead, turning = (drives(robot, 2, random, turns) for turns in (False, True))
    for pair in zip(ahead, turning, strict=True):
        assert constants(robot, *pair) == pytest.approx(truths(robot), rel=2e-3)


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
def test_tells_apart(robot, field, factor, moves):
    """A change of the robot shows in the constants that hold it and in no other."""
    changed = robot.model_copy(update={field: factor * getattr(robot, field)})
    rows = []
    for one in (robot, changed):
        random = np.random.default_rng(2)
        rows.append(constants(robot, drives(one, 1, random, False)[0], drives(one, 1, random, True)[0]))
    assert {name for name in rows[0] if rows[1][name] != pytest.approx(rows[0][name], rel=0.01)} == moves


def test_intervals_cover(robot):
    """Of 180 intervals, each from 8 noisy drives and without the share for the model, some 95 % hold the truth."""
    random, noise, repeats, groups = np.random.default_rng(3), (0.02, 0.04), identify.REPEATS, 30
    ahead, turning = (drives(robot, repeats * groups, random, turns, noise) for turns in (False, True))
    rows = [constants(robot, *pair) for pair in zip(ahead, turning, strict=True)]
    covered = 0
    for name, true in truths(robot).items():
        values = np.array([row[name] for row in rows]).reshape(groups, repeats)
        reach = identify.scatter(values)
        covered += int(np.sum(np.abs(values.mean(axis=1) - true) <= reach))
    assert 160 <= covered <= 179, covered


def test_signals(robot):
    """Predicted from equation (3), the drive keeps to the robot's limits, and both wheels turn forwards."""
    for turns in (False, True):
        random = np.random.default_rng(4)
        for drive in drives(robot, 3, random, turns):
            v, omega = drive.twist.T
            assert v.min() > robot.half_track * np.abs(omega).max() and v.max() < robot.max_speed
            assert np.abs(drive.rate[:, 0]).max() < robot.max_acceleration
            assert np.abs(drive.rate[:, 1]).max() < robot.max_rotation_acceleration
            assert np.abs(drive.voltage).max() < robot.supply
            assert (np.abs(omega).max() > 0.05) == turns
