"""Differences between the plant and the model that the controller has of it.

A `Perturbation` is data; `mrctl.physics.perturb` writes it into a compiled model.
"""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
from annotated_types import Ge, Le
from pydantic import Field, model_validator

from mrctl.record import Record, bounds
from mrctl.theory.drive import (
    NO_LIMIT,
    Backlash,
    BatteryResistance,
    CurrentLimit,
    DeadZone,
    Driver,
    Offset,
    PwmSteps,
    SteeringServo,
)

MAX_DELAY = 0.5
"""Longest delay or latency in s; those of sensing and perturbation add, so that a command may take twice as long."""

MAX_SLOPE = 0.5
"""Largest inclination of the ground in rad."""

Factor = Annotated[float, Field(ge=0.05, le=20)]


class Perturbation(Record):
    """Differences of the plant from the model that the controller knows; by default there are none."""

    moved = {
        "velocity_noise": "the noise of the wheel speeds follows from sensing.encoder_counts",
        "rotation_noise": "set sensing.gyro_noise",
        "position_noise": "set sensing.fix_position_noise",
        "heading_noise": "set sensing.fix_heading_noise",
    }

    mass_factor: Factor = 1.0
    """Factor on mass and inertia of every body."""
    inertia_factor: Factor = 1.0
    """Factor on the yaw inertia of the body `chassis`, whose mass stays; bodies welded to it keep theirs."""
    payload: Annotated[float, Field(ge=0, le=200)] = 0.0
    """Payload on the chassis in kg, a point mass."""
    payload_x: Annotated[float, Field(ge=-1, le=1)] = 0.1
    """Position of the payload ahead of the rear axle in m."""
    payload_y: Annotated[float, Field(ge=-1, le=1)] = 0.0
    """Position of the payload to the left of the robot's axis in m."""
    payload_z: Annotated[float, Field(ge=0, le=1)] = 0.2
    """Height of the payload above the ground in m."""
    left_radius_factor: Annotated[float, Field(ge=0.8, le=1.2)] = 1.0
    """Factor on the radius of the rear left wheel."""
    right_radius_factor: Annotated[float, Field(ge=0.8, le=1.2)] = 1.0
    """Factor on the radius of the rear right wheel."""
    drive_friction_factor: Annotated[float, Field(ge=0, le=20)] = 1.0
    """Factor on the friction of gearboxes and motors, τ_loss."""
    resistance_factor: Factor = 1.0
    """Factor on the motors' terminal resistance R_a."""
    motor_constant_factor: Factor = 1.0
    """Factor on the motor constants k_M and k_E together."""
    left_drive_friction_factor: Annotated[float, Field(ge=0, le=20)] = 1.0
    """Further factor on the friction of the left gearbox and motor."""
    right_drive_friction_factor: Annotated[float, Field(ge=0, le=20)] = 1.0
    """Further factor on the friction of the right gearbox and motor."""
    left_resistance_factor: Factor = 1.0
    """Further factor on the resistance of the left motor."""
    right_resistance_factor: Factor = 1.0
    """Further factor on the resistance of the right motor."""
    left_motor_constant_factor: Factor = 1.0
    """Further factor on the constants k_M and k_E of the left motor."""
    right_motor_constant_factor: Factor = 1.0
    """Further factor on the constants k_M and k_E of the right motor."""
    dead_zone: DeadZone = 0.0
    """Voltage in V that is added to the dead zone of the motor driver, below which a command has no effect."""
    pwm_steps: PwmSteps = 0
    """Upper bound on the driver's PWM steps up to the full supply; 0 keeps the driver's own."""
    current_limit: CurrentLimit = NO_LIMIT
    """Current limit of each motor in A, if that of the driver is higher; 1000 A, the default, stands for no limit."""
    battery_resistance: BatteryResistance = 0.0
    """Resistance in Ω that is added to that of the battery, so that the motors' currents lower its voltage further."""
    steering_offset: Offset = 0.0
    """Angle in rad that is added to the constant error of the fork's angle, positive to the left."""
    steering_backlash: Backlash = 0.0
    """Width in rad that is added to the backlash between the steering servo and the fork."""
    supply_factor: Annotated[float, Field(ge=0.05, le=2)] = 1.0
    """Factor on the supply voltage and, since the driver works by PWM, on every applied voltage."""
    tyre_friction_factor: Annotated[float, Field(ge=0.01, le=3)] = 1.0
    """Factor on the friction of every tyre on the floor."""
    left_tyre_friction_factor: Annotated[float, Field(ge=0.01, le=3)] = 1.0
    """Further factor on the friction of the rear left tyre."""
    slope: Annotated[float, Field(ge=-MAX_SLOPE, le=MAX_SLOPE)] = 0.0
    """Inclination of the ground in rad, uphill along the world's +x; gravity is turned, not the floor."""
    control_delay: Annotated[float, Field(ge=0, le=MAX_DELAY)] = 0.0
    """Delay of voltages and steering commands in s beyond that of `sensing`, a multiple of the control period."""

    @model_validator(mode="before")
    @classmethod
    def _named(cls, values: Any) -> Any:  # noqa: ANN401
        """Replaces a name in `PERTURBATIONS` by the fields of that perturbation."""
        if not isinstance(values, str):
            return values
        if values not in PERTURBATIONS:
            raise ValueError(f"no perturbation is called {values!r}; there are {', '.join(PERTURBATIONS)}")
        return PERTURBATIONS[values].model_dump()

    def drawn(self, random: np.random.Generator) -> Perturbation:
        """Returns the perturbation of one robot on one day, with its unknown differences drawn at random.

        Each factor in `REPLICATE_HALF_WIDTHS` is multiplied by a uniform draw from 1 ± w; to the slope a uniform draw
        from ± `REPLICATE_SLOPE` is added. A result beyond the limits of its field becomes the limit.

        Args:
            random: Source of random numbers; each draw takes the same number of values from it.
        """
        changed = {name: getattr(self, name) * (1 + random.uniform(-w, w)) for name, w in REPLICATE_HALF_WIDTHS.items()}
        changed["slope"] = self.slope + random.uniform(-REPLICATE_SLOPE, REPLICATE_SLOPE)
        limits = {name: bounds(type(self).model_fields[name]) for name in changed}
        clipped = {name: min(max(x, limits[name][Ge]), limits[name][Le]) for name, x in changed.items()}
        return self.replace(**clipped)

    def of_driver(self, driver: Driver) -> Driver:
        """Returns the perturbed driver: dead zones and resistances add; the lower limit and number of steps hold."""
        changed = {
            "dead_zone": driver.dead_zone + self.dead_zone,
            "pwm_steps": min(filter(None, (driver.pwm_steps, self.pwm_steps)), default=0),
            "current_limit": min(driver.current_limit, self.current_limit),
            "battery_resistance": driver.battery_resistance + self.battery_resistance,
        }
        return driver.model_copy(update=changed)

    def of_servo(self, servo: SteeringServo) -> SteeringServo:
        """Returns a steering servo with the offset and the backlash of the perturbation added."""
        changed = {"offset": servo.offset + self.steering_offset, "backlash": servo.backlash + self.steering_backlash}
        return servo.model_copy(update=changed)


REPLICATE_HALF_WIDTHS = {
    "mass_factor": 0.03,
    "drive_friction_factor": 0.2,
    "resistance_factor": 0.05,
    "left_motor_constant_factor": 0.03,
    "right_motor_constant_factor": 0.03,
    "left_radius_factor": 0.005,
    "right_radius_factor": 0.005,
}
"""Half widths of the factors in which two robots of one kind differ (chosen: tolerances of bought parts)."""
REPLICATE_SLOPE = 0.01  # rad, 0.6°: a floor that passes for level

PERTURBATIONS: dict[str, Perturbation] = {
    "nominal": Perturbation(),
    "mass +50 %": Perturbation(mass_factor=1.5),
    "mass -50 %": Perturbation(mass_factor=0.5),
    "payload ahead": Perturbation(payload=5.0, payload_x=0.35),  # moves the centre of mass by 5 cm
    "payload behind": Perturbation(payload=5.0, payload_x=-0.15),
    "payload aside": Perturbation(payload=5.0, payload_x=0.1, payload_y=0.15),
    "left wheel +5 %": Perturbation(left_radius_factor=1.05),
    "left wheel -5 %": Perturbation(left_radius_factor=0.95),
    "drive friction x3": Perturbation(drive_friction_factor=3.0),
    "resistance +30 %": Perturbation(resistance_factor=1.3),
    "motor constant -15 %": Perturbation(motor_constant_factor=0.85),
    "supply -20 %": Perturbation(supply_factor=0.8),
    "delay 20 ms": Perturbation(control_delay=0.02),
    "delay 40 ms": Perturbation(control_delay=0.04),
    "tyre friction 0.2": Perturbation(tyre_friction_factor=0.2 / 0.9),
    "left tyre on ice": Perturbation(left_tyre_friction_factor=0.1 / 0.9),
    "slope 10°": Perturbation(slope=0.1745),
    "all": Perturbation(mass_factor=1.5, supply_factor=0.8, drive_friction_factor=3.0, resistance_factor=1.3),
}
"""Named perturbations of the default robot, each of one kind; `all` combines four of them."""
