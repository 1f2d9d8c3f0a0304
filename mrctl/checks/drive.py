"""From voltages to motion: equation (3) and its constants, on straight lines and in turns."""

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
    braking,
    crisp,
    cruise,
    holding_force,
    lag,
    loss_voltage,
    on_skid,
    on_skid_robot,
    open_circuit,
    perturbed,
    settling_time,
    towing,
)
from mrctl.physics.elements import REAR
from mrctl.physics.readout import motor_parameters
from mrctl.theory.dynamics import accelerations
from mrctl.theory.kinematics import wheel_rates
from mrctl.theory.perturbation import MAX_SLOPE, Perturbation
from mrctl.theory.robot import GRAVITY, Robot


def hold_on_slope(model: mujoco.MjModel, robot: Robot) -> Report:
    """Coulomb friction, not its shorted motors, holds a robot on a slope, up to m g sin α = 2 τ_loss/r + F_roll.

    At half of that force the robot stands, but MuJoCo's friction is soft and creeps in proportion to its load: the
    tolerance is a tenth of the speed without friction. At twice the force, or less if the tyres would slip, it rolls,
    and back-EMF and viscous friction b brake it to (m g sin α − losses)/B with B = 2 (N² k²/R_a + b)/r². The tolerance
    is 0.25 % of the force, of which slip and sinking tyres take 0.05 % each.
    """
    force, weight = holding_force(robot), robot.mass * GRAVITY
    steepest = _steepest(robot)
    slopes = [Perturbation(slope=-float(np.arcsin(ratio * force / weight))) for ratio in (0.5, steepest)]
    fine = crisp(model, robot, np.inf)
    standing, rolling = (
        Car(perturbed(fine, slope)).drive(settling_time(robot), NO_CONTROL)["v"][-1] for slope in slopes
    )
    terminal = (steepest - 1) * force / braking(robot)
    tolerance = 2.5e-3 * steepest * force / braking(robot)
    return [
        compare("creep at half the holding force", standing, 0.0, "m/s", absolute=0.1 * force / 2 / braking(robot)),
        compare(f"speed at {steepest:.3g} times the holding force", rolling, terminal, "m/s", absolute=tolerance),
    ]


def rolls_freely(robot: Robot) -> str:
    """Returns why a robot without Coulomb losses cannot be judged by them, or "" for another."""
    return "" if holding_force(robot) else "the robot has no Coulomb losses"


def holds_on_all_slopes(robot: Robot) -> str:
    """Returns why a robot that holds on all slopes cannot be judged by the steepest one, or "" for another."""
    if _steepest(robot) * holding_force(robot) > robot.mass * GRAVITY * np.sin(MAX_SLOPE):
        return f"its losses hold the robot on all slopes up to {MAX_SLOPE:g} rad"
    return rolls_freely(robot)


def _steepest(robot: Robot) -> float:
    """Returns the largest ratio, up to 2, of downhill to holding force that takes at most half of the rear grip."""
    for ratio in np.linspace(2.0, 1.1, 10):
        sine = ratio * holding_force(robot) / (robot.mass * GRAVITY)
        cosine, base = np.sqrt(max(0.0, 1 - sine**2)), robot.wheelbase - robot.trail
        front = (robot.com_offset * cosine + robot.com_height * sine) / base
        if sine < 0.5 * robot.tyre_friction * (cosine - front) and front > 0:
            return float(ratio)
    return 1.1


def top_speed(model: mujoco.MjModel, robot: Robot) -> Report:
    """Driving straight on, V settles at (r/e) (U − U_loss), with e = N k_E + b R_a/(N k_M) and Coulomb losses.

    Two voltages separate the no-load speed r U/e from U_loss. The tolerance of the speed is 0.2 %, as the tyres
    sink in by 0.05 % of the radius; that of the loss is 1 %, as it is a small difference of large numbers.
    """
    high, low = robot.supply, robot.supply / 2
    fine = crisp(model, robot, np.inf)
    fast, slow = (cruise(fine, robot, u)[1]["v"][-1] for u in (high, low))
    gain = (fast - slow) / (high - low)
    loss = high - fast / gain
    return [
        compare("no-load speed", gain * high, robot.velocity_gain * high, "m/s", relative=2e-3),
        compare("voltage lost to friction", loss, loss_voltage(robot), "V", relative=1e-2, absolute=1e-6 * high),
    ]


def stall(model: mujoco.MjModel, robot: Robot) -> Report:
    """The torque of a blocked wheel is N k_M U/R_a, and reaches the ground as P/r with P = N k_M U/R_a − τ_loss.

    The torque of the resting motor is exact but for rounding. Then the robot, held in its heading, tows a load so heavy
    that it crawls at 5 % of its no-load speed (fully blocked, Coulomb friction would be undetermined): it pulls with
    (P_d + P_s)/r and twists with (D/r)(P_d − P_s). The front tyre carries no force, the rear ones half of their grip.
    The tolerance is 0.5 %: the tyres sink in by 0.05 % of their radius and creep a little under load; measured 0.02 %.
    """
    car = Car(model)
    car.control((robot.supply, robot.supply, 0, 0))
    car.data.act[motor_parameters(model)[2]] = robot.supply / robot.resistance  # what flows once it does not change
    mujoco.mj_forward(model, car.data)
    shaft = [car.data.qfrc_actuator[model.joint(name).dofadr[0]] for name in REAR]
    report = [
        compare(f"stall torque {side}", torque, robot.motor_gain * robot.supply, "N·m", relative=1e-6)
        for side, torque in zip(("left", "right"), shaft, strict=True)
    ]
    skid = on_skid_robot(robot)
    grip = robot.tyre_friction * robot.mass * GRAVITY * (1 - robot.front_load) / 2
    right = min(robot.supply, grip / 2 * robot.wheel_radius / robot.motor_gain)
    left = 0.7 * right
    ratio = 0.95  # of the pull to that of blocked wheels
    car = Car(towing(on_skid(model), ratio / (1 - ratio) * braking(robot)))
    car.drive(2.0, (left, right, 0, 0))
    mujoco.mj_forward(car.model, car.data)
    dof = model.joint("chassis").dofadr[0]
    pull, _, twist = -car.data.qfrc_passive[[dof, dof + 1, dof + 5]]
    force = (robot.motor_gain * (right + left) - 2 * skid.drive_loss) / robot.wheel_radius
    couple = robot.half_track / robot.wheel_radius * robot.motor_gain * (right - left)
    return report + [
        compare("pull", pull, ratio * force, "N", relative=5e-3),
        compare("twist", twist, couple, "N·m", relative=5e-3),
    ]


def velocity_time_constant(model: mujoco.MjModel, robot: Robot) -> Report:
    """V answers a step of U_Σ with the gain r/(N k_E + b R_a/(N k_M)) and the time constant M_e r²/(2 (N² k²/R_a + b)).

    The robot already moves, so the Coulomb losses are constant and drop out. The lag of the step response is that time
    constant whatever inductance the windings have. The tolerance of 0.5 % is well under the 1.9 % that the rotors
    contribute to M_e; the tyres, which sink in and give, take 0.2 %.
    """
    volts = robot.supply / 3
    step = robot.supply / 24
    tau = robot.velocity_time_constant
    car, _ = cruise(crisp(model, robot, tau), robot, volts)
    log = car.drive(settling_time(robot), (volts + step, volts + step, 0, 0), min(HOLD_TIME, tau / 10))
    gain = (log["v"][-1] - log["v"][0]) / step
    return [
        compare("gain of V", gain, robot.velocity_gain, "m/s/V", relative=5e-3),
        compare("time constant of V", lag(log, "v"), tau, "s", relative=5e-3),
    ]


def rotation_time_constant(model: mujoco.MjModel, robot: Robot) -> Report:
    """A small step of U_Δ while driving straight on gives J_e θ̈ = 2 (D/r) (N k_M/R_a) U_Δ − (B + m c V) θ̇.

    B = 2 (D/r)² (N² k²/R_a + b) is the braking of both motors and of viscous friction. Both wheels turn forwards, so
    the Coulomb losses are constant and drop out, and to first order V does not change. The front tyre carries no force,
    so that equation (3) holds as it stands. The lag of the response is (J_e + m c V L_a/R_a)/(B + m c V). The tolerance
    of 1 % is under the 1.6 % that the rotors contribute to J_e: the sideways give of the tyres takes up to 0.5 %, at
    half the contact times of the other checks.
    """
    skid = on_skid_robot(robot)
    common, step = robot.supply / 3, robot.supply / 240
    arm = robot.half_track / robot.wheel_radius
    v = robot.velocity_gain * (common - loss_voltage(skid))
    offset = robot.mass * robot.com_offset * v
    damping = 2 * arm**2 * robot.motor_gain * robot.voltage_per_rate + offset
    tau = (skid.effective_inertia + offset * robot.inductance / robot.resistance) / damping
    car, _ = cruise(on_skid(crisp(model, robot, tau / 2)), robot, common)
    log = car.drive(settling_time(robot), (common - step, common + step, 0, 0), min(HOLD_TIME, tau / 10))
    gain = (log["omega"][-1] - log["omega"][0]) / step
    return [
        compare("gain of θ̇", gain, 2 * arm * robot.motor_gain / damping, "rad/s/V", relative=1e-2),
        compare("time constant of θ̇", lag(log, "omega"), tau, "s", relative=1e-2),
    ]


def coast_down(model: mujoco.MjModel, robot: Robot) -> Report:
    """Without motors and viscous friction V falls at the constant rate (2 τ_loss/r + F_roll)/M_e.

    The tolerance is 0.3 %, of which sinking tyres take 0.05 %; the residual of the fit shows that the rate is constant.
    """
    deceleration = holding_force(robot) / robot.effective_mass
    speed = robot.max_speed
    log = Car(open_circuit(crisp(model, robot, np.inf)), twist=(speed, 0)).drive(0.8 * speed / deceleration, NO_CONTROL)
    moving = log.time > 0.1  # the tyres take up their load
    slope, start = np.polyfit(log.time[moving], log["v"][moving], 1)
    bend = np.abs(log["v"] - start - slope * log.time)[moving].max()
    return [
        compare("deceleration", -slope, deceleration, "m/s²", relative=3e-3),
        compare("departure from a straight line", bend, 0.0, "m/s", absolute=1e-3 * speed),
    ]


def centre_of_mass(model: mujoco.MjModel, robot: Robot) -> Report:
    """An offset centre of mass pushes forward with m c θ̇² and resists turning with m c V θ̇.

    In a steady turn both balance the part of the motors' torques, known from voltages and speeds, that nothing else
    takes: m c θ̇² = F_loss − (P_d + P_s)/r − m v θ̇ and m c V θ̇ = (D/r)(P_d − P_s), with v the sideways drift of the
    rear tyres (see `scrub_free`). The front tyre carries no force. Then a payload behind the axle leaves a tenth of c,
    and of both terms. The tolerance is 2 % of the whole term: both are differences of voltage and back-EMF, which are
    ten times larger, and to which the sinking of the tyres adds 0.05 %.
    """
    back, remaining = min(0.5, robot.size), 0.1  # m behind P, and the share of c that remains
    ballast = robot.mass * robot.com_offset * (1 - remaining) / (back + remaining * robot.com_offset)
    laden = {"payload": ballast, "payload_x": -back, "payload_z": robot.wheel_radius}
    payload = Perturbation().model_copy(update=laden)  # whatever its mass
    changed = {"mass": robot.mass + ballast, "com_offset": remaining * robot.com_offset}
    loss = on_skid_robot(robot).drive_loss / robot.motor_gain
    drive = np.array([0.1, 0.5]) * robot.supply - loss
    v, omega = robot.velocity_gain * drive.mean(), robot.rotation_gain * (drive[1] - drive[0]) / 2
    volts = loss + drive * min(1.0, np.sqrt(0.2 * robot.tyre_friction * GRAVITY / abs(v * omega)))
    report = []
    whole = robot.mass * robot.com_offset
    other = perturbed(model, payload), robot.model_copy(update=changed)
    for name, car, true in (("", model, robot), (" with c/10", *other)):
        crispy = crisp(on_skid(car), true, min(true.velocity_time_constant, true.rotation_time_constant))
        start = Car(crispy, twist=(robot.velocity_gain * (volts.mean() - loss), 0))
        log = start.drive(2 * settling_time(true), (*volts, 0, 0))
        v, omega, sideways = log["v"][-1], log["omega"][-1], log["v_lateral"][-1]
        torques = true.motor_gain * (volts - true.voltage_per_rate * wheel_rates((v, omega), true))
        friction = 2 * on_skid_robot(true).drive_loss
        push = (friction - torques.sum()) / true.wheel_radius - true.mass * sideways * omega
        drag = true.half_track / true.wheel_radius * (torques[1] - torques[0])
        lever = true.mass * true.com_offset
        report += [
            compare(f"m c θ̇²{name}", push, lever * omega**2, "N", absolute=0.02 * whole * omega**2),
            compare(f"m c V θ̇{name}", drag, lever * v * omega, "N·m", absolute=0.02 * whole * v * omega),
        ]
    return report


def prediction(model: mujoco.MjModel, robot: Robot) -> Report:
    """Equation (3), corrected, predicts V and θ̇ of a caster-steered robot from its voltages alone.

    Both voltages vary for 20 s with periods of 2 to 7 s, from about the speed that they hold; the law is integrated by
    the classical Runge-Kutta method. The tolerances are shares of the root mean squares, 1 % of V and 6 % of θ̇: the
    fork, with the mass, damping and rolling loss of its wheel, adds to θ̇ what the equation leaves out.
    """

    def law(t: float) -> tuple[float, ...]:
        common = robot.supply * (0.35 + 0.08 * np.sin(0.9 * t) + 0.05 * np.sin(2.3 * t))
        differential = robot.supply * (0.05 * np.sin(1.3 * t) + 0.04 * np.sin(3.1 * t))
        return common - differential, common + differential, 0.0, 0.0

    rolling = robot.velocity_gain * (0.35 * robot.supply - loss_voltage(robot)), 0.0
    log = Car(model, twist=rolling).drive(20.0, law)
    twist = np.zeros((len(log.time), 2))
    twist[0] = rolling
    for k, t in enumerate(log.time[:-1]):
        volts = law(t)[:2]
        s, h = twist[k], log.time[1]
        k1 = accelerations(s, volts, robot)
        k2 = accelerations(s + h / 2 * k1, volts, robot)
        k3 = accelerations(s + h / 2 * k2, volts, robot)
        k4 = accelerations(s + h * k3, volts, robot)
        twist[k + 1] = s + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    error = np.sqrt(np.mean((twist - log.reading["twist"]) ** 2, axis=0) / np.mean(twist**2, axis=0))
    return [
        compare("error of V", error[0], 0.0, absolute=1e-2),
        compare("error of θ̇", error[1], 0.0, absolute=6e-2),
    ]
