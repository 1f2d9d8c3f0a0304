"""Checks whether such a robot could exist: stance, units, motors and inertias, and the declared limits.

The parameters that the other checks expect are read from the robot's own file, so a wrong number that is used
consistently breaks no law. These checks find numbers that no robot has.
"""

# pyright: reportAttributeAccessIssue=false
# (mujoco is compiled and ships no stubs)

from __future__ import annotations

import mujoco
import numpy as np

from mrctl.checks.comparison import Report, between, compare
from mrctl.checks.open_loop import HOLD_TIME, NO_CONTROL, Car, Log, caster_gaps, on_skid, rolling_wheels
from mrctl.physics.elements import MOTORS, REAR, part
from mrctl.physics.parameters import read_robot
from mrctl.physics.units import GYRATION_RATIOS, RPM_PER_RAD_S, bounds, extent
from mrctl.theory.dynamics import inverse_dynamics
from mrctl.theory.robot import Robot


def units(model: mujoco.MjModel, robot: Robot) -> Report:
    """No number is off by the orders of magnitude of a wrong unit; the bounds are those of `mrctl.physics.units`."""
    true = read_robot(model)
    return [between(b.quantity, b.value, b.low, b.high, b.unit) for b in (*bounds(true), extent(model, true))]


def stance(model: mujoco.MjModel, robot: Robot) -> Report:
    """On level ground the robot stands level: the radii of its wheels and casters fit the heights of their centres.

    The tolerance of 0.5° is more than sinking tyres can cause, and less than a wrong radius causes. A caster, which
    mrctl makes reach the floor, may be off it by what tilts the robot by as much.
    """
    car = Car(model)
    car.drive(1.0, NO_CONTROL)
    frame = car.data.body("chassis").xmat.reshape(3, 3)
    nose, side = np.degrees(np.arcsin(frame[2, :2]))
    return [
        compare("nose up", nose, 0.0, "°", absolute=0.5),
        compare("left side up", side, 0.0, "°", absolute=0.5),
        *(
            compare(f"{part(model, caster)} above the floor", 1e3 * gap, 0.0, "mm", absolute=1e3 * _tilted(robot))
            for caster, gap in caster_gaps(model).items()
        ),
    ]


def _tilted(robot: Robot) -> float:
    """Returns how far off the floor a caster is in m where the robot that stands on it is tilted by 0.5°."""
    return abs(robot.wheelbase) * float(np.tan(np.radians(0.5)))


def _to_its_limit(
    model: mujoco.MjModel, robot: Robot, direction: tuple[float, float], limit: float, rate: float
) -> Log:
    """Drives from rest to a limit at the limit on its rate, with the voltages of equation (3) within the supply.

    Args:
        model: The robot.
        robot: Its parameters.
        direction: Unit vector of the twist, (1, 0) for V or (0, 1) for θ̇.
        limit: Final value of V or θ̇ in m/s or rad/s.
        rate: Its rate in m/s² or rad/s².
    """
    hold = min(HOLD_TIME, limit / rate / 50)
    unit = np.array(direction)

    def law(t: float) -> tuple[float, ...]:
        volts = inverse_dynamics(unit * rate * (t + hold / 2), unit * rate, robot)
        left, right = np.clip(volts, -robot.supply, robot.supply)
        return left, right, 0.0, 0.0

    return Car(model).drive(limit / rate, law, hold)


def limits(model: mujoco.MjModel, robot: Robot) -> Report:
    """Motors, gear, supply and grip reach the declared limits on V and V̇, and the steering limit is plausible.

    The tolerance is 10 %: the voltages are those of equation (3), and nothing corrects slip.
    """
    log = _to_its_limit(model, robot, (1, 0), robot.max_speed, robot.max_acceleration)
    return [
        compare("V at its limit", log["v"][-1], robot.max_speed, "m/s", relative=0.1),
        between("largest steering angle", robot.steering_limit, 0.1, np.pi / 2, "rad"),
    ]


def turning_limits(model: mujoco.MjModel, robot: Robot) -> Report:
    """Turning on the spot, with a front tyre without friction, the robot reaches the declared limits on θ̇ and θ̈."""
    log = _to_its_limit(on_skid(model), robot, (0, 1), robot.max_rotation, robot.max_rotation_acceleration)
    return [compare("θ̇ at its limit", log["omega"][-1], robot.max_rotation, "rad/s", relative=0.1)]


def motors(model: mujoco.MjModel, robot: Robot) -> Report:
    """The no-load speed U/k_E and time constant J_m R_a/k² of each motor, at its own shaft, are those of real motors.

    Hub motors turn at some 100 rpm, model racing motors at 50,000. Coreless motors have time constants of 0.5 ms, cheap
    ones up to 200 ms. The rotor's inertia may also be written at the wheel's joint; without a gear it may be part of
    the wheel's.
    """
    report = []
    for motor, wheel in zip(MOTORS, REAR, strict=True):
        actuator = model.actuator(motor)
        gear, (resistance, constant) = actuator.gear[0], actuator.gainprm[:2]
        inertia = model.actuator_armature[actuator.id] + model.joint(wheel).armature[0] / gear**2
        volts = model.actuator_ctrlrange[model.actuator_ctrladr[actuator.id], 1]
        report += [
            between(f"no-load speed of {motor}", volts / constant * RPM_PER_RAD_S, 100, 60e3, "rpm"),
            between(f"time constant of {motor}", inertia * resistance / constant**2, 0.5e-3 * (gear > 3), 0.2, "s"),
        ]
    return report


def inertias(model: mujoco.MjModel, robot: Robot) -> Report:
    """The inertia of a wheel is at most that of a hoop, and the yaw inertia fits the size of the robot."""
    report = []
    for name in rolling_wheels(model):
        body, radius = model.body(name), model.geom(name).size[0]
        spin = body.inertia.max()  # a disc's own axis
        report.append(between(f"inertia of {name} over m r²", spin / (body.mass[0] * radius**2), 0.01, 1))
    gyration = np.sqrt(robot.yaw_inertia / robot.mass)
    return report + [between("radius of gyration over the size", gyration / robot.size, *GYRATION_RATIOS)]
