"""Ranges of the sliders: the interval of each number that suits a robot."""

from __future__ import annotations

from pydantic.fields import FieldInfo

from mrctl.theory.robot import Robot

Interval = tuple[float, float]

RANGE_FACTOR = 5.0  # a slider shows a fifth to five times the default of a number of which nothing else is known
MIN_DEFAULT = 1e-3  # a default below which a number does not fit into the box beside a slider
LENGTH_FIELDS = ("length", "radius", "size", "side", "distance")  # of references


def slider_range(path: tuple[str, ...], field: FieldInfo, limits: Interval, robot: Robot) -> Interval | None:
    """Returns the ends of the slider of a number for a robot, in the unit of the field, within its limits.

    Args:
        path: Names of the fields that lead to the number.
        field: The field.
        limits: Least and largest number that the record accepts.
        robot: Parameters of the robot.

    Returns:
        The ends, or None where the default is too small for the box beside a slider, or stands for no limit.
    """
    low, high = limits
    name = path[-1].removeprefix("left_").removeprefix("right_")
    known = {"perturbation": _perturbation_ranges, "reference": _reference_ranges}.get(path[0])
    default = field.default
    if known and (ends := known(robot).get(name)):
        first, last = ends
    elif not isinstance(default, int | float) or default <= 0:
        return limits
    elif not MIN_DEFAULT <= default < high:
        return None
    else:
        first, last = default / RANGE_FACTOR if low > 0 else low, RANGE_FACTOR * default
    digits = "{:.0f}" if field.annotation is int else "{:.2g}"
    return max(low, float(digits.format(first))), min(high, float(digits.format(last)))


def _perturbation_ranges(robot: Robot) -> dict[str, Interval]:
    """Returns the ranges of the fields of a perturbation, by name without the prefix `left_` or `right_`."""
    length = abs(robot.wheelbase)
    return {
        "mass_factor": (0.5, 3.0),
        "inertia_factor": (0.5, 3.0),
        "payload": (0.0, robot.mass),
        "payload_x": (-length, length),
        "payload_y": (-robot.half_track, robot.half_track),
        "payload_z": (0.0, 5 * robot.com_height),
        "radius_factor": (0.9, 1.1),
        "drive_friction_factor": (0.0, 5.0),
        "resistance_factor": (0.5, 3.0),
        "motor_constant_factor": (0.5, 1.5),
        "dead_zone": (0.0, robot.supply / 10),
        "pwm_steps": (0.0, 1024.0),
        "battery_resistance": (0.0, 0.5),
        "steering_offset": (-0.1, 0.1),
        "steering_backlash": (0.0, 0.1),
        "supply_factor": (0.5, 1.2),
        "tyre_friction_factor": (0.05, 1.5),
        "slope": (-0.15, 0.15),
        "control_delay": (0.0, 0.1),
    }


def _reference_ranges(robot: Robot) -> dict[str, Interval]:
    """Returns the ranges of the fields of references, by name."""
    size = robot.size
    return {
        **dict.fromkeys(LENGTH_FIELDS, (size / 2, 20 * size)),
        "shift": (-10 * size, 10 * size),
        "speed": (robot.max_speed / 20, robot.max_speed),
        "period": (1.0, 60.0),
        **dict.fromkeys(("move_time", "stop_time", "pause"), (0.0, 10.0)),
        "acceleration": (robot.max_acceleration / 20, robot.max_acceleration),
        "lateral_acceleration": (robot.max_acceleration / 20, 10.0),
        "rotation": (robot.max_rotation / 20, robot.max_rotation),
        "rotation_acceleration": (robot.max_rotation_acceleration / 20, robot.max_rotation_acceleration),
        "voltage": (robot.supply / 20, robot.supply),
    }
