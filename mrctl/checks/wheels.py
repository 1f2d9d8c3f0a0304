"""Wheels on the ground: their loads, rolling without slip by equation (1), and their grip."""

# pyright: reportAttributeAccessIssue=false
# (mujoco is compiled and ships no stubs)

from __future__ import annotations

import mujoco
import numpy as np

from mrctl.checks.comparison import Report, compare
from mrctl.checks.open_loop import (
    HOLD_TIME,
    NO_CONTROL,
    Car,
    crisp,
    loss_voltage,
    on_skid_robot,
    perturbed,
    settling_time,
)
from mrctl.physics.elements import fronts
from mrctl.theory.kinematics import scrub_free_angle, scrub_free_rotation, twist_from_front_wheel, wheel_rates
from mrctl.theory.perturbation import Perturbation
from mrctl.theory.robot import GRAVITY, Robot


def rest(model: mujoco.MjModel, robot: Robot) -> Report:
    """At rest the wheels bear the weight, split by the lever rule about the rear axle, and nothing moves.

    The front load is m g c/(L − t), as the contact trails the fork's axis. The tolerance is 0.1 % of the weight: the
    tyres sink in by some 50 µm, which tilts the robot by 1e-4 rad. That of the speed is 1e-6 m/s: a contact is a
    critically damped spring of 10 ms and nothing pushes, so only the end of the settling and the solver's tolerance
    remain.
    """
    car = Car(model)
    car.drive(2.0, NO_CONTROL)
    log = car.drive(3.0, NO_CONTROL)
    loads = car.tyre_forces()[:, 2]
    weight = robot.mass * GRAVITY
    rear = (1 - robot.front_load) / 2 * weight
    moved = np.abs(log.qpos[-1, :7] - log.qpos[0, :7]).max() / 3.0
    return [
        compare("sum of the wheel loads", loads.sum(), weight, "N", absolute=1e-3 * weight),
        compare("front load", loads[2], robot.front_load * weight, "N", absolute=1e-3 * weight),
        compare("left load", loads[0], rear, "N", absolute=1e-3 * weight),
        compare("right load", loads[1], rear, "N", absolute=1e-3 * weight),
        compare("drift at rest", moved, 0.0, "m/s", absolute=1e-6),
    ]


def _electronic_differential(robot: Robot, volts: float, angle: float, rate: float = 0.0) -> tuple[float, ...]:
    """Returns a control whose rear wheels turn as fast as the circle of a rigidly steered front wheel demands."""
    v = robot.velocity_gain * (volts - loss_voltage(robot))
    omega = scrub_free_rotation(v, angle, robot.wheelbase, robot.trail)
    differential = robot.voltage_per_rate * robot.half_track * omega / robot.wheel_radius
    return volts - differential, volts + differential, angle, rate


def circle(model: mujoco.MjModel, robot: Robot) -> Report:
    """With a rigidly steered wheel P drives a circle of radius L/tan φ, with trail (L cos φ − t)/sin φ.

    The robot uses a tenth of the tyres' grip. The tolerance is 0.5 %: the tyres drift outwards (see `scrub_free`),
    which turns the robot on the circle but hardly changes the radius, and the servo gives; measured 0.03 %.
    """
    angle = 0.5 * robot.steering_limit
    radius = 1 / scrub_free_rotation(1.0, angle, robot.wheelbase, robot.trail)
    v = np.sqrt(0.1 * robot.tyre_friction * GRAVITY * radius)
    volts = v / robot.velocity_gain + loss_voltage(robot)
    report = []
    for side, sign in (("left", 1), ("right", -1)):
        car = Car(model)
        car.drive(settling_time(robot), _electronic_differential(robot, volts, sign * angle))
        log = car.drive(2 * np.pi * radius / v, _electronic_differential(robot, volts, sign * angle))
        x, y = log["x"], log["y"]
        # (x − a)² + (y − b)² = R², linear in a, b and R² − a² − b².
        a, b, rest = np.linalg.lstsq(np.stack([2 * x, 2 * y, np.ones_like(x)], 1), x**2 + y**2, rcond=None)[0]
        report.append(compare(f"radius {side}", np.sqrt(rest + a**2 + b**2), radius, "m", relative=5e-3))
        report.append(compare(f"sense {side}", np.sign(log["omega"]).mean(), sign, absolute=0))
    return report


def rolling(model: mujoco.MjModel, robot: Robot) -> Report:
    """By equation (1) the front wheel's rate and φ give V, θ̇ and both rear wheel rates, without sideways slip.

    The robot, rigidly steered and without trail, winds left and right. The tolerances are 1 % of the mean speed (of V/L
    for θ̇); most of it is taken by the sideways drift that `scrub_free` explains.
    """
    volts, w = robot.supply / 4, 2 * np.pi / 2.0

    def law(t: float) -> tuple[float, ...]:
        middle = t + HOLD_TIME / 2
        return _electronic_differential(robot, volts, 0.35 * np.sin(w * middle), 0.35 * w * np.cos(w * middle))

    car = Car(model)
    car.drive(settling_time(robot), _electronic_differential(robot, volts, 0.0))
    log = car.drive(6.0, law)
    front = np.mean([log.qvel[:, model.joint(f).dofadr[0]] for f in fronts(model)], axis=0) * robot.front_wheel_radius
    twist = twist_from_front_wheel(front, log["steering_angle"], robot)
    rates = wheel_rates(twist, robot)
    rows = (
        ("V", log["v"], twist[:, 0], 1.0, "m/s"),
        ("θ̇", log["omega"], twist[:, 1], robot.wheelbase, "rad/s"),
        ("left wheel rate", log["wheel_rate_left"], rates[:, 0], robot.wheel_radius, "rad/s"),
        ("right wheel rate", log["wheel_rate_right"], rates[:, 1], robot.wheel_radius, "rad/s"),
        ("sideways speed", log["v_lateral"], 0.0, 1.0, "m/s"),
    )
    speed = robot.velocity_gain * (volts - loss_voltage(robot))
    return [
        compare(
            f"{name}: departure from equation (1)",
            np.abs(measured - ideal).max(),
            0.0,
            unit,
            absolute=0.01 * speed / arm,
        )
        for name, measured, ideal, arm, unit in rows
    ]


def spinning_wheels(model: mujoco.MjModel, robot: Robot, friction: float, x: float = 0.0) -> Report:
    """At full voltage from rest the wheels spin on a floor of friction coefficient μ, which sets the acceleration.

    The acceleration a solves N_f (L − t) = m g c − m a h and (m + J_f/r_f²) a = μ (m g − N_f) − front rolling loss.
    `traction` explains the tolerance.

    Args:
        model: Compiled world with the robot.
        robot: The parameters that it should have.
        friction: Friction coefficient μ of driven tyres and floor.
        x: Position at which the robot starts along the world's x axis, in m.
    """
    front = robot.front_load
    inert = robot.mass + robot.front_wheel_inertia / robot.front_wheel_radius**2
    inert -= friction * robot.mass * robot.com_height / (robot.wheelbase - robot.trail)
    expected = (friction * robot.mass * GRAVITY * (1 - front) - front * robot.rolling_force) / inert
    seconds = min(0.8, 0.5 * robot.velocity_gain * robot.supply / expected)  # faster, the wheels would catch up
    car = Car(crisp(model, robot, robot.velocity_time_constant), pose=(x, 0, 0))
    log = car.drive(seconds, (robot.supply, robot.supply, 0, 0), min(HOLD_TIME, seconds / 40))
    steady = log.time > seconds / 4  # the wheels have reached their speed
    acceleration = np.polyfit(log.time[steady], log["v"][steady], 1)[0]
    slip = ((log["wheel_rate_left"] + log["wheel_rate_right"]) / 2 * robot.wheel_radius - log["v"])[steady].min()
    return [
        compare("acceleration while wheels spin", acceleration, expected, "m/s²", relative=2e-2),
        compare("the wheels spin (1: yes)", float(slip > 0.1 * robot.max_speed), 1.0),
    ]


def traction(model: mujoco.MjModel, robot: Robot) -> Report:
    """On a slippery floor full voltage spins the rear wheels, and only μ times their load accelerates the robot.

    Their load includes the transfer m a h/(L − t), which is 6 % of the acceleration. The tolerance is 2 %: MuJoCo's
    soft friction cone lifts a tyre that slides at 1 m/s by some 0.2 mm, so that it hops; the acceleration is averaged.
    """
    slippery = perturbed(model, Perturbation(tyre_friction_factor=0.2))
    return spinning_wheels(slippery, robot, 0.2 * robot.tyre_friction)


def hardly_spins(robot: Robot) -> str:
    """Returns why full voltage does not spin the wheels well enough for `traction`, or "".

    Against the grip the wheels reach a share 1 − F_grip/F_stall of their free speed, and the robot, in `traction`, half
    of it.
    """
    stall = 2 * (robot.motor_gain * robot.supply - on_skid_robot(robot).drive_loss) / robot.wheel_radius
    grip = 0.2 * robot.tyre_friction * robot.mass * GRAVITY * (1 - robot.front_load)
    return "" if grip < 0.3 * stall else "the motors hardly spin the wheels on a fifth of their grip"


def cornering(model: mujoco.MjModel, robot: Robot) -> Report:
    """All tyres together bend the path with μ g at most: a robot keeps its circle at half of that, and slides at twice.

    The robot, rigidly steered on a slippery floor, starts on the circle. The tolerance of the radius is 0.5 %, as in
    `circle`. That of the limit is 3 %: sliding tyres hop, so the acceleration, and its peak with it, is averaged over
    0.1 s; it was measured 1.1 % below the limit, and 0.3 % with averages over 0.04 s.
    """
    angle = 0.3
    limit = 0.2 * robot.tyre_friction * GRAVITY
    slippery = perturbed(model, Perturbation(tyre_friction_factor=0.2))
    radius = 1 / scrub_free_rotation(1.0, angle, robot.wheelbase, robot.trail)
    logs = []
    for ratio in (0.5, 2.0):
        v = np.sqrt(ratio * limit * radius)
        volts = v / robot.velocity_gain + loss_voltage(robot)
        car = Car(slippery, twist=(v, v / radius))
        logs.append(car.drive(1.5, _electronic_differential(robot, volts, angle)))
    slow, fast = logs
    ahead = np.stack([np.cos(fast["theta"]), np.sin(fast["theta"])], axis=1)
    centre = fast.reading["pose"][:, :2] + robot.com_offset * ahead
    k = round(0.1 / fast.time[1])  # second difference over 0.1 s: no vibration
    bend = np.hypot(*(centre[2 * k :] - 2 * centre[k:-k] + centre[: -2 * k]).T) / fast.time[k] ** 2
    return [
        compare("radius below the limit", slow["v"][-1] / slow["omega"][-1], radius, "m", relative=5e-3),
        compare("largest acceleration above it", bend.max(), limit, "m/s²", relative=3e-2),
        compare("it slides (1: yes)", float(np.abs(fast["v_lateral"]).max() > 0.1 * fast["v"][0]), 1.0),
    ]


def scrub_free(model: mujoco.MjModel, robot: Robot) -> Report:
    """A fork without stiffness takes the angle at which its wheel rolls without scrub.

    In a steady turn φ = atan(L θ̇/V) − asin(t θ̇/√(V² + L² θ̇²)); in a changing one sin(direction − φ) = t (θ̇ +
    φ̇)/speed, with the direction and the speed at which the fork's axis moves. The tolerance of the steady angle is 5
    mrad; measured 0.03, as P and the fork drift alike. That of the changing one is a sideslip of 7 ms · θ̇: MuJoCo's
    contacts (time constant T, impedance d) damp the slip velocity in a frame that turns, which they do not take into
    account, so a tyre drifts outwards with V θ̇ d T/2 whatever its friction; here d T/2 = 1.9 ms.
    """
    common, differential = robot.supply / 3, robot.supply / 12
    car = Car(model)
    log = car.drive(settling_time(robot) + 2.0, (common - differential, common + differential, 0, 0))
    steady = float(scrub_free_angle(log.reading["twist"][-1], robot))
    report = [compare("angle in a steady turn", log["steering_angle"][-1], steady, "rad", absolute=5e-3)]

    def law(t: float) -> tuple[float, ...]:
        swing = differential * np.cos(2.0 * t)
        return common - swing, common + swing, 0.0, 0.0

    log = car.drive(8.0, law)
    rate = log.qvel[:, model.joint("steering").dofadr[0]]
    side = robot.wheelbase * log["omega"] + log["v_lateral"]
    scrub = np.sin(np.arctan2(side, log["v"]) - log["steering_angle"])
    ideal = robot.trail * (log["omega"] + rate) / np.hypot(log["v"], side)
    drift = 7e-3 * np.abs(log["omega"]).max()
    return report + [compare("scrub in a changing turn", np.abs(scrub - ideal).max(), 0.0, "rad", absolute=drift)]
