"""The nominal robot for the compiled laws: one record of parameters of equations (1) to (3)."""

from __future__ import annotations

import numpy as np

from mrctl.kernel import Rows
from mrctl.theory.robot import Robot

NOMINAL = np.dtype(
    [
        ("wheelbase", "f8"),  # L, m
        ("trail", "f8"),  # t, m
        ("half_track", "f8"),  # D, m
        ("steering_limit", "f8"),  # φ_max, rad
        ("supply", "f8"),  # U_max, V
        ("voltage_per_speed", "f8"),  # of back-EMF and viscous friction, (N k_E + b R_a/(N k_M))/r, V/(m/s)
        ("loss", "f8"),  # voltage that overcomes the friction of one drive, τ_loss R_a / (N k_M), V
        ("max_twist", "f8", 2),  # largest |V| and |θ̇|, m/s and rad/s
        ("max_acceleration", "f8", 2),  # largest |V̇| and |θ̈|, m/s² and rad/s²
        ("rigid", "?"),  # whether the second channel is steering
        ("motors_steer", "?"),  # whether only the difference of the motors' voltages turns the robot
    ],
    align=True,
)


def nominal(robot: Robot, rigid: bool) -> Rows:
    """Returns the record of `NOMINAL` of a robot, as an array of one element, `(1,)`.

    Args:
        robot: The nominal robot.
        rigid: Whether the steering arrangement is `rigid`, so that the second channel is steering.
    """
    record = np.zeros(1, NOMINAL)
    record["wheelbase"], record["trail"], record["half_track"] = robot.wheelbase, robot.trail, robot.half_track
    record["steering_limit"], record["supply"] = robot.steering_limit, robot.supply
    record["voltage_per_speed"] = robot.voltage_per_rate / robot.wheel_radius
    record["loss"] = robot.drive_loss / robot.motor_gain
    record["max_twist"] = robot.max_speed, robot.max_rotation
    record["max_acceleration"] = robot.max_acceleration, robot.max_rotation_acceleration
    record["rigid"], record["motors_steer"] = rigid, not rigid and robot.steering_stiffness == 0
    return record
