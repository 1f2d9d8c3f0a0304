"""What can be wrong with a robot that the controller is not told.

A `Perturbation` is data; `mrctl.physics.perturb` writes it into a compiled model.
"""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from mrctl.record import Record

LONGEST_DELAY = 0.5  # s, of a command on its way to the motors

Factor = Annotated[float, Field(ge=0.05, le=20)]


class Perturbation(Record):
    """What the plant does that the controller is not told. The default changes nothing.

    Factors multiply the nominal value; the rest is added to it.
    """

    mass_factor: Factor = 1.0
    """Every body denser: mass and inertia of chassis, wheels and fork."""
    inertia_factor: Factor = 1.0
    """Yaw inertia of the chassis alone."""
    payload: Annotated[float, Field(ge=0, le=200)] = 0.0
    """Point mass on the chassis in kg."""
    payload_x: Annotated[float, Field(ge=-1, le=1)] = 0.1
    """Payload ahead of P in m."""
    payload_y: Annotated[float, Field(ge=-1, le=1)] = 0.0
    """Payload to the left of the robot's axis in m."""
    payload_z: Annotated[float, Field(ge=0, le=1)] = 0.2
    """Payload above the ground in m."""
    left_radius_factor: Annotated[float, Field(ge=0.8, le=1.2)] = 1.0
    """Rear left wheel radius."""
    right_radius_factor: Annotated[float, Field(ge=0.8, le=1.2)] = 1.0
    """Rear right wheel radius."""
    drive_friction_factor: Annotated[float, Field(ge=0, le=20)] = 1.0
    """Loss of gearboxes and motors, τ_loss."""
    resistance_factor: Factor = 1.0
    """Terminal resistance R_a."""
    motor_constant_factor: Factor = 1.0
    """Motor constant, k_M and k_E together."""
    supply_factor: Annotated[float, Field(gt=0, le=2)] = 1.0
    """Applied over commanded voltage: a PWM drive on another supply."""
    tyre_friction_factor: Annotated[float, Field(ge=0.01, le=3)] = 1.0
    """Friction of every tyre on the floor."""
    left_tyre_friction_factor: Annotated[float, Field(ge=0.01, le=3)] = 1.0
    """Friction of the rear left tyre on the floor, beside the factor of all."""
    slope: Annotated[float, Field(ge=-0.5, le=0.5)] = 0.0
    """Inclination in rad, uphill along the world's +x, as gravity seen in the slope's own frame."""
    control_delay: Annotated[float, Field(ge=0, le=LONGEST_DELAY)] = 0.0
    """Delay of voltages and steering in s, in whole control periods."""
    velocity_noise: Annotated[float, Field(ge=0, le=1)] = 0.0
    """Standard deviation of the measured V in m/s."""
    rotation_noise: Annotated[float, Field(ge=0, le=1)] = 0.0
    """Standard deviation of the measured θ̇ in rad/s."""
    position_noise: Annotated[float, Field(ge=0, le=1)] = 0.0
    """Standard deviation of the measured x and y in m (`truth` only: odometry integrates its own)."""
    heading_noise: Annotated[float, Field(ge=0, le=1)] = 0.0
    """Standard deviation of the measured θ in rad (`truth` only)."""


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
    "sensor noise": Perturbation(velocity_noise=0.01, rotation_noise=0.02, position_noise=0.002, heading_noise=0.002),
    "all": Perturbation(mass_factor=1.5, supply_factor=0.8, drive_friction_factor=3.0, resistance_factor=1.3),
}
"""What can be wrong with the default robot, one thing at a time; `all` is the combination of the published targets."""
