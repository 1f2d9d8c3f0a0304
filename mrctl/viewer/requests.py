"""What visitors ask for with buttons and inputs, as changes of scenarios."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np

from mrctl.loop.groups import suited
from mrctl.record import InputError, Record
from mrctl.scenario import Scenario
from mrctl.sensing.tiers import Sensing
from mrctl.theory.robot import Robot, RobotFile
from mrctl.viewer.arrows import PUSH_OF_LENGTH
from mrctl.viewer.controls import WORLDS
from mrctl.viewer.hands import rounded

KEPT_FIELDS = ("prior", "learner", "seed")  # fields that stay when the robot changes, as the tier of the sensors does

AnyRecord = TypeVar("AnyRecord", bound=Record)


def buttons(robot: Robot) -> dict[str, dict[str, dict[str, Any]]]:
    """Returns the groups of buttons: label, buttons, and the change of the perturbation or the push that each makes.

    Payload and push are in proportion to the robot: the payload is half of its mass.
    """
    mass, half_track = robot.mass, robot.half_track
    load = rounded(mass / 2, robot.com_offset / 2, 0.32 * half_track, 5 / 3 * robot.com_height)
    push, spin = rounded(PUSH_OF_LENGTH * mass, 4 * mass * half_track)  # N and N·m
    return {
        "Payload": {
            "drop payload": dict(zip(("payload", "payload_x", "payload_y", "payload_z"), load, strict=True)),
            "remove": {"payload": 0.0},
        },
        "Supply": {"sag supply": {"supply_factor": 0.7}, "restore": {"supply_factor": 1.0}},
        "Floor": {"slippery patch": {"tyre_friction_factor": 0.15}, "dry": {"tyre_friction_factor": 1.0}},
        "Push": {"push": {"push": (0.0, push, 0.0)}, "spin": {"push": (0.0, 0.0, spin)}},
    }


def asked(path: tuple[str, ...], value: Any, period: float) -> tuple[tuple[str, ...], Any]:  # noqa: ANN401
    """Returns the field of a scenario that an input stands for, and the value that it asks for.

    Times and rates are rounded to whole control periods of `period` in s.
    """
    match path:
        case ("reference",):
            return path, {"kind": value}
        case ("sensing", "tier"):  # with all values of the tier
            return ("sensing",), {"tier": value}
        case ("pid", "time_constant"):
            return path, value or None  # the input of the design shows 0
        case ("perturbation", "control_delay") | ("sensing", _) if _is_number(value):
            return path, _in_periods(path[-1], value, period)
    return path, value


def _is_number(value: object) -> bool:
    """Tells whether a value is a finite number; the record refuses others."""
    return isinstance(value, int | float) and bool(np.isfinite(value))


def _in_periods(name: str, value: float, period: float) -> float:
    """Returns a number, a time or a rate rounded to whole periods, by the name of its field."""
    if name.endswith(("_latency", "delay")):
        return round(value / period) * period
    if name.endswith("_rate") and value > 0:
        return 1 / (max(1, round(1 / (value * period))) * period)
    return value


def changed(record: AnyRecord, path: Sequence[str], value: object) -> AnyRecord:
    """Returns a copy of the record in which the field at a path has another value.

    Raises:
        InputError: The record refuses the value, or has no such field, as its kind has changed meanwhile.
    """
    name, *rest = path
    if name not in type(record).model_fields:
        raise InputError(f"{name}: not a field of {type(record).__name__}")
    if rest:
        value = changed(getattr(record, name), rest, value)
    fields = {field: getattr(record, field) for field in type(record).model_fields}
    return type(record).from_dict(fields | {name: value})


def with_robot(scenario: Scenario, robot: RobotFile) -> Scenario:
    """Returns a scenario for another robot: with the same controller, seed and tier, and a reference that suits it."""
    kept: dict[str, Any] = {name: getattr(scenario, name) for name in KEPT_FIELDS}
    world = scenario.world if scenario.world in WORLDS else "flat"
    return suited(Scenario(**kept, world=world, robot=robot, sensing=Sensing(tier=scenario.sensing.tier)))
