"""Laws that hold for any robot: energy balance, mirror symmetry, invariance of place, convergence in the time step."""

# pyright: reportAttributeAccessIssue=false
# (mujoco is compiled and ships no stubs)

from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np

from mrctl.checks.comparison import Report, compare
from mrctl.checks.open_loop import HOLD_TIME, Car, is_steered, loss_voltage, rolling_wheels, with_finer_step
from mrctl.physics.mjcf import clone
from mrctl.physics.readout import motor_parameters
from mrctl.theory.robot import GRAVITY, Robot


def winding(robot: Robot) -> Callable[[float], tuple[float, ...]]:
    """Returns a control law that speeds up and slows down, turns both ways, and steers as it turns."""
    lock = min(0.3, 0.6 * robot.steering_limit)
    grip = np.sqrt(
        0.1 * robot.tyre_friction * GRAVITY * abs(robot.wheelbase) / np.tan(lock)
    )  # the speed in m/s that uses a tenth of the grip
    volts = min(0.4 * robot.supply, grip / robot.velocity_gain + loss_voltage(robot))

    def law(t: float) -> tuple[float, ...]:
        common = volts * (1 + 0.25 * np.sin(2.0 * t))
        differential = volts * 0.15 * np.sin(1.7 * t)
        return (
            common - differential,
            common + differential,
            lock * np.sin(1.7 * t - 0.5),
            1.7 * lock * np.cos(1.7 * t - 0.5),
        )

    return law


def _moderate_speed(robot: Robot, law: Callable[[float], tuple[float, ...]]) -> float:
    """Returns a speed in m/s below the one that `winding` holds at first, so that a fast motor shows."""
    return 5 / 6 * robot.velocity_gain * law(0.0)[0]


def _energy_balance(model: mujoco.MjModel, robot: Robot, seconds: float) -> tuple[float, float]:
    """Drives `winding`; returns the energy that is missing in the balance and the energy from the supply, in J.

    The robot starts rolling. From rest its wheels would spin and be braked as they grip, and MuJoCo's Coulomb torques
    would then drive them.

    The supply gives U I, with the current of the nominal motor; R_a I² of it is heat, and the windings hold L_a I²/2.
    The contact forces do work on slipping tyres, the linkages and bearings of the steering take work, and so do the
    nominal Coulomb torques. MuJoCo's mechanical energy accounts for the rest.
    """
    model = clone(model)
    model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
    law = winding(robot)
    car = Car(model, twist=(_moderate_speed(robot, law), 0))
    data = car.data
    dofs = np.array([model.joint(name).dofadr[0] for name in rolling_wheels(model)])
    servos = [model.joint("steering").dofadr[0]] if is_steered(model) else []
    rear = robot.drive_loss + robot.rolling_force * (1 - robot.front_load) / 2 * robot.wheel_radius
    front = robot.rolling_force * robot.front_load * robot.front_wheel_radius
    coulomb = np.array([rear, rear, *([front / max(1, len(dofs) - 2)] * (len(dofs) - 2))])
    h, substeps = model.opt.timestep, max(1, round(HOLD_TIME / model.opt.timestep))
    before = data.energy.sum()
    supplied, balance, current, states = 0.0, 0.0, np.zeros(2), motor_parameters(model)[2]
    for k in range(round(seconds / (h * substeps))):
        control = np.asarray(law(k * h * substeps))
        car.control(control)
        for _ in range(substeps):
            velocity = data.qvel.copy()
            mujoco.mj_step(model, data)
            velocity = (velocity + data.qvel) / 2  # mean over the step: force times it is power, exactly
            current = (
                data.act[states] if states else (control[:2] - robot.back_emf * velocity[dofs[:2]]) / robot.resistance
            )
            rows = np.zeros(data.nefc)
            mujoco.mj_mulJacVec(model, data, rows, velocity)
            coulombs = int(mujoco.mjtConstraint.mjCNSTR_FRICTION_DOF)
            slip = -(data.efc_force * rows)[data.efc_type != coulombs].sum() - data.qfrc_damper[6:] @ velocity[6:]
            servo = data.qfrc_actuator[servos] @ velocity[servos]
            supplied += h * control[:2] @ current
            balance += h * (control[:2] @ current - robot.resistance * current @ current - slip + servo)
            balance -= h * coulomb @ np.abs(velocity[dofs])
    mujoco.mj_forward(model, data)
    car.assert_stable()
    return balance - (data.energy.sum() + robot.inductance / 2 * current @ current - before), supplied


def energy(model: mujoco.MjModel, robot: Robot) -> Report:
    """Electrical energy in = heat of the windings + tyre slip + Coulomb friction + mechanical energy.

    The tolerance of 2 % is far above the 0.05 % measured at 2 ms. The missing energy halves as the time step is halved
    (the integrator is of first order); the tolerance of that ratio is 0.2. Where its errors of first order cancel,
    0.0005 % of the energy need not halve, and with inductance, whose currents first set in, 0.01 %.
    """
    report, missing, supplied = [], [], 0.0
    for halvings in range(3):
        fine = with_finer_step(model, halvings)
        lost, supplied = _energy_balance(fine, robot, 2.0)
        missing.append(abs(lost))
        share = f"missing share at {1e3 * fine.opt.timestep:g} ms"
        report.append(compare(share, lost / supplied, 0.0, absolute=0.02))
    rest = (1e-4 if robot.inductance else 5e-6) * supplied
    first, second = (max(0.2, rest / lost) for lost in missing[:2])
    return report + [
        compare("missing at half the time step", missing[1] / missing[0], 0.5, absolute=first),
        compare("missing at a quarter, to that at half", missing[2] / missing[1], 0.5, absolute=second),
    ]


def mirror(model: mujoco.MjModel, robot: Robot) -> Report:
    """With left and right exchanged the robot drives the mirrored path.

    The tolerance of 1e-9 m and rad after 4 s is for rounding, as sums run in another order; the motion does not amplify
    it.
    """
    law = winding(robot)
    other = Car(model).drive(4.0, lambda t: np.array(law(t))[[1, 0, 2, 3]] * (1, 1, -1, -1))
    log = Car(model).drive(4.0, law)
    gap = log.reading["pose"] - other.reading["pose"] * (1, -1, -1)
    return [compare("departure from the mirrored path", np.abs(gap).max(), 0.0, "m, rad", absolute=1e-9)]


def invariance(model: mujoco.MjModel, robot: Robot) -> Report:
    """From another place and heading the robot drives the same path, moved and turned.

    The tolerance is 1e-9 m after 4 s, as in `mirror`.
    """
    law, (x, y, theta) = winding(robot), (0.7, -0.4, 1.1)
    log = Car(model).drive(4.0, law)
    other = Car(model, pose=(x, y, theta)).drive(4.0, law)
    c, s = np.cos(theta), np.sin(theta)
    moved = log.reading["pose"][:, :2] @ np.array([[c, s], [-s, c]]) + (x, y)
    gap = np.abs(moved - other.reading["pose"][:, :2]).max()
    return [compare("departure from the moved path", gap, 0.0, "m", absolute=1e-9)]


def convergence(model: mujoco.MjModel, robot: Robot) -> Report:
    """The path converges with the time step, at first order: halving the step halves the change of the end point.

    `implicitfast` is a method of first order, so the ratio of changes is 1/2 but for the next term; measured 0.4998.
    The tolerance is 0.15, as stiff servos and linkages come to it at shorter steps only. The robot starts rolling,
    because the instant at which Coulomb friction gives way jumps between steps. The first change, which is also the
    error at 1 ms, is below 0.5 mm per metre of path.
    """
    ends, path = [], 0.0
    law = winding(robot)
    speed = _moderate_speed(robot, law)
    for halvings in range(4):
        fine = with_finer_step(model, halvings)
        log = Car(fine, twist=(speed, 0)).drive(4.0, law)
        ends.append(log.reading["pose"][-1, :2])
        path = np.abs(log["v"]).mean() * log.time[-1]
    changes = np.hypot(*np.diff(ends, axis=0).T)
    return [
        compare("second change of the end point over the first", changes[1] / changes[0], 0.5, absolute=0.15),
        compare("third over the second", changes[2] / changes[1], 0.5, absolute=0.15),
        compare("change as the time step is halved", changes[0], 0.0, "m", absolute=5e-4 * path),
    ]
