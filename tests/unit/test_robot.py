"""The default robot's derived parameters, and invalid values in `Robot` and `Perturbation`."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mrctl.checks.open_loop import Car
from mrctl.physics import mjcf
from mrctl.physics.parameters import read_robot
from mrctl.record import InputError, Record
from mrctl.theory.drive import NO_LIMIT
from mrctl.theory.dynamics import accelerations, left_right
from mrctl.theory.perturbation import PERTURBATIONS, Perturbation
from mrctl.theory.robot import GRAVITY, Robot

numbers = st.floats() | st.floats(-2, 2) | st.integers() | st.sampled_from([None, True, "", "x", "1\n", "nan", [1.0]])


@pytest.mark.parametrize(
    ("name", "value", "tolerance"),
    [
        ("velocity_gain", 0.0974, 5e-5),
        ("rotation_gain", 0.518, 5e-4),
        ("velocity_time_constant", 0.23, 5e-3),
        ("rotation_time_constant", 0.26, 5e-3),
        ("effective_mass", 21.1, 0.2),  # published without the front wheel's 0.18 kg
        ("effective_inertia", 0.84, 5e-3),
        ("front_load", 0.27, 5e-3),
    ],
)
def test_published(robot, name, value, tolerance):
    """The derived parameters are those stated for the default robot."""
    assert getattr(robot, name) == pytest.approx(value, abs=tolerance)


@pytest.mark.parametrize("drive_gain", [1.0, 0.8])
def test_gains_settle(robot, drive_gain):
    """A robot without losses and lever settles, by equation (3), at the static gains times the commanded voltages."""
    free = {"no_load_current": 0.0, "gear_loss": 0.0, "rolling_coefficient": 0.0, "com_offset": 0.0}
    robot = robot.model_copy(update={"drive_gain": drive_gain, **free})
    twist, step = np.zeros(2), 0.01
    for _ in range(1000):
        twist = twist + step * accelerations(twist, left_right([6.0, 2.0]), robot)
    assert twist == pytest.approx([6.0 * robot.velocity_gain, 2.0 * robot.rotation_gain])


def test_gain_of_a_weak_supply():
    """In MuJoCo 0.8 V more for each volt commanded change the settled speed by the gain of the robot on that supply."""
    model = mjcf.load()
    speeds = []
    for volts in (6.0, 12.0):
        car = Car(model)
        car.drive(3.0, (0.8 * volts, 0.8 * volts, 0.0, 0.0))
        speeds.append(car.drive(0.1, (0.8 * volts, 0.8 * volts, 0.0, 0.0))["v"][-1])
    assert np.diff(speeds)[0] / 6.0 == pytest.approx(read_robot(model, 0.8).velocity_gain, rel=5e-3)


def test_motor_limits(robot):
    """The no-load speed is 2.34 m/s, and the stall torque 10.4 N·m before losses."""
    assert robot.supply * robot.velocity_gain == pytest.approx(2.34, abs=5e-3)
    assert robot.supply * robot.motor_gain == pytest.approx(10.4, abs=0.05)


def test_data_sheet(robot):
    """k_E of the data sheet, 407 rpm/V, is k_M in SI within its rounding."""
    assert 60 / (2 * np.pi * 407) == pytest.approx(robot.torque_constant, rel=5e-3)


def test_lever_rule(robot):
    """Front and rear axle loads balance about the centre of mass and bear the weight."""
    contact = robot.wheelbase - robot.trail
    front = robot.front_load * robot.mass * GRAVITY
    rear = robot.mass * GRAVITY - front
    assert front * (contact - robot.com_offset) == pytest.approx(rear * robot.com_offset)
    assert robot.rolling_force == pytest.approx(robot.rolling_coefficient * (front + rear))


def replaced(robot: Robot, **values: object) -> dict[str, object]:
    """Returns the robot as a dictionary with some values replaced."""
    return robot.model_dump() | values


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("trail", 0.4),
        ("com_offset", -0.01),
        ("com_offset", 0.37),
        ("mass", 0),
        ("mass", -1),
        ("supply", math.nan),
        ("gear_ratio", math.inf),
        ("steering_limit", 1.6),
        ("wheels", 4),
    ],
)
def test_robot_refuses(robot, field, value):
    """A value out of range is refused by the name of its field."""
    with pytest.raises(InputError, match=rf"^robot: {field}: [^\n]+$"):
        Robot.from_dict(replaced(robot, **{field: value}), "robot")


def check(record: type[Record], values: dict[str, object], changed: set[str]) -> None:
    """Checks that values make a valid record, which survives a round trip, or are refused by the name of a field."""
    try:
        made = record.from_dict(values)
    except InputError as error:
        assert str(error).split(":")[0] in changed and len(str(error).splitlines()) == 1
    else:
        assert all(math.isfinite(value) for value in made.model_dump().values())
        assert record.from_dict(made.model_dump()) == made


@given(data=st.data())
def test_robot_random(robot, data):
    """Random values in up to three fields of a robot are valid, or refused by name."""
    values = data.draw(st.dictionaries(st.sampled_from(list(Robot.model_fields)), numbers, max_size=3))
    # the two rules that join fields may be broken through one and reported under the other
    joined = {"trail", "com_offset"} if values.keys() & {"trail", "com_offset", "wheelbase"} else set()
    check(Robot, replaced(robot, **values), values.keys() | joined)


@given(values=st.dictionaries(st.sampled_from([*Perturbation.model_fields, "unknown"]), numbers, max_size=5))
def test_perturbation_random(values):
    """Random values in any fields of a perturbation are valid, or refused by name."""
    check(Perturbation, values, set(values))


def test_robot_needs_everything(robot):
    """A missing parameter is refused by name, but for those with a default: what few robots have, and gravity."""
    fork = {"steering_stiffness", "steering_damping", "fork_inertia", "fork_moment"}
    for field in Robot.model_fields.keys() - {"drive_gain", "gravity", "wheel_damping"} - fork:
        values = robot.model_dump()
        del values[field]
        with pytest.raises(InputError, match=rf"^{field}: "):
            Robot.from_dict(values)


def test_robot_toml(robot, tmp_path):
    """A robot written to TOML comes back."""
    path = tmp_path / "robot.toml"
    path.write_text("".join(f"{name} = {value!r}\n" for name, value in robot.model_dump().items()))
    assert Robot.from_toml(path) == robot


def test_named_perturbations():
    """`all` is the published combination; `nominal` has factors of 1, and no payload, slope, delay or noise."""
    assert PERTURBATIONS["all"].model_dump(exclude_defaults=True) == {
        "mass_factor": 1.5, "supply_factor": 0.8, "drive_friction_factor": 3.0, "resistance_factor": 1.3,
    }  # fmt: skip
    tyres = read_robot(mjcf.load()).tyre_friction
    assert tyres * PERTURBATIONS["tyre friction 0.2"].tyre_friction_factor == pytest.approx(0.2)
    assert tyres * PERTURBATIONS["left tyre on ice"].left_tyre_friction_factor == pytest.approx(0.1)
    nominal = PERTURBATIONS["nominal"].model_dump(exclude={"payload_x", "payload_y", "payload_z"})
    assert nominal.pop("current_limit") == NO_LIMIT
    assert all(value == (1 if name.endswith("_factor") else 0) for name, value in nominal.items())
