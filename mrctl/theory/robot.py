"""The parameters of a robot in equations (1) to (3), and the file that a robot comes from.

`mrctl.physics.parameters.read_robot` reads a `Robot` from a compiled MJCF.
"""

from __future__ import annotations

import math
from typing import Annotated, Literal, NamedTuple

from pydantic import Field, model_validator

from mrctl.record import Record

GRAVITY = 9.81  # m/s², on Earth
ANY_ANGLE = math.pi / 2  # rad, the steering limit of a robot without a steered wheel
LIMITS = "max_speed", "max_rotation", "max_acceleration", "max_rotation_acceleration"  # fields of `Robot`
Steering = Literal["compliant", "caster", "rigid"]
STEERINGS: tuple[Steering, ...] = ("compliant", "caster", "rigid")

Positive = Annotated[float, Field(ge=1e-9, le=1e9)]
NonNegative = Annotated[float, Field(ge=0, le=1e9)]


class Robot(Record):
    """Parameters of a car-like robot, SI units (symbols of the paper in brackets).

    P is the midpoint of the rear axle; the body's x axis points forward, y to the left.
    """

    mass: Positive
    """Total mass [M] in kg."""
    yaw_inertia: Positive
    """Yaw inertia of the whole robot about its centre of mass [J] in kg·m²."""
    com_offset: float
    """Distance of the centre of mass ahead of P [c] in m."""
    com_height: NonNegative
    """Height of the centre of mass above the ground in m."""
    wheel_radius: Positive
    """Radius of the rear wheels [r] in m."""
    front_wheel_radius: Positive
    """Radius of the front wheel in m."""
    half_track: Positive
    """Half the distance between the rear wheels [D] in m."""
    wheelbase: float
    """Distance of the steering axis ahead of the rear axle [L] in m; if nothing is steered, that of the caster, which
    is negative behind the axle."""
    trail: NonNegative
    """Distance of the front contact point behind the steering axis [t] in m."""
    steering_limit: Annotated[float, Field(gt=0, le=ANY_ANGLE)]
    """Largest steering angle in rad; π/2 for a differential drive, which turns on the spot."""
    steering_stiffness: NonNegative = 0.0
    """Stiffness of the steering servo [k_s] in N·m/rad; 0 where the fork is free or nothing is steered."""
    steering_damping: NonNegative = 0.0
    """Damping of the steering, of servo and bearings together, [d_s] in N·m·s/rad."""
    fork_inertia: NonNegative = 0.0
    """Inertia of what the steering turns about its axis [J_f] in kg·m²; 0 where nothing is steered."""
    fork_moment: float = 0.0
    """Mass of what the steering turns times the distance of its centre behind the axis [m_f e] in kg·m."""
    resistance: Positive
    """Terminal resistance of a motor [R_a] in Ω."""
    inductance: NonNegative
    """Armature inductance of a motor [L_a] in H; 0 where the current follows the voltage at once."""
    torque_constant: Positive
    """Motor constant in N·m/A [k_M] and in V·s/rad [k_E], which in SI are the same number."""
    gear_ratio: Positive
    """Gear ratio [N], motor turns per wheel turn."""
    rotor_inertia: NonNegative
    """Rotor inertia at the motor shaft [J_m] in kg·m²."""
    no_load_current: NonNegative
    """No-load current of a motor [I_0] in A."""
    gear_loss: NonNegative
    """Coulomb friction of one gearbox, at the wheel, in N·m."""
    wheel_damping: NonNegative = 0.0
    """Viscous friction of one drive with its wheel, at the wheel [b] in N·m·s/rad."""
    rolling_coefficient: NonNegative
    """Rolling resistance coefficient, the ratio of resistance to load."""
    wheel_inertia: Positive
    """Spin inertia of one rear wheel [J_w] in kg·m²."""
    front_wheel_inertia: NonNegative
    """Spin inertia of all front wheels together in kg·m²."""
    supply: Positive
    """Supply voltage [U_max] in V."""
    drive_gain: Positive = 1.0
    """Ratio of applied to commanded voltage; below 1 for a PWM drive on a sagging supply."""
    tyre_friction: Positive
    """Coulomb friction coefficient between tyre and floor."""
    gravity: Positive = GRAVITY
    """Gravitational acceleration [g] in m/s², of the world that the robot drives in."""
    max_speed: Positive
    """Limit on |V| for references and commands in m/s."""
    max_rotation: Positive
    """Limit on |θ̇| for references and commands in rad/s."""
    max_acceleration: Positive
    """Limit on |V̇| for references and commands in m/s²."""
    max_rotation_acceleration: Positive
    """Limit on |θ̈| for references and commands in rad/s²."""

    @model_validator(mode="after")
    def _geometry(self) -> Robot:
        if self.wheelbase <= 0 and self.steering_limit < ANY_ANGLE:
            raise ValueError("wheelbase: must be positive, with the steered wheels ahead of the driven ones")
        if self.trail >= abs(self.wheelbase):
            raise ValueError("trail: must be shorter than the wheelbase")
        if not 0 <= self.com_offset / (self.wheelbase - self.trail) < 1:
            raise ValueError("com_offset: the centre of mass must lie between the rear axle and the front contact")
        return self

    @property
    def size(self) -> float:
        """Diagonal of the rectangle of wheelbase and track, √(L² + (2D)²), in m."""
        return math.hypot(self.wheelbase, 2 * self.half_track)

    @property
    def motor_gain(self) -> float:
        """Stall torque of one drive at the wheel per volt, N k_M / R_a, in N·m/V."""
        return self.gear_ratio * self.torque_constant / self.resistance

    @property
    def back_emf(self) -> float:
        """Back-EMF of one drive per wheel rate, N k_E, in V·s/rad."""
        return self.gear_ratio * self.torque_constant

    @property
    def voltage_per_rate(self) -> float:
        """Voltage of one drive per wheel rate without load, N k_E + b R_a/(N k_M), in V·s/rad."""
        return self.back_emf + self.wheel_damping / self.motor_gain

    @property
    def drive_loss(self) -> float:
        """Coulomb torque of one drive at the wheel, τ_loss = N k_M I_0 + gearbox loss, in N·m."""
        return self.back_emf * self.no_load_current + self.gear_loss

    @property
    def rolling_force(self) -> float:
        """Rolling resistance of all wheels on level ground, F_roll, in N."""
        return self.rolling_coefficient * self.mass * self.gravity

    @property
    def front_load(self) -> float:
        """Share of the weight that the front wheel bears at rest, by the lever rule, f = c/(L − t)."""
        return self.com_offset / (self.wheelbase - self.trail)

    @property
    def drive_inertia(self) -> float:
        """Inertia of one rear wheel with its reflected rotor, J_w + N² J_m, in kg·m²."""
        return self.wheel_inertia + self.gear_ratio**2 * self.rotor_inertia

    @property
    def effective_mass(self) -> float:
        """Effective mass M_e in kg: the robot's mass plus the spin inertias of its drives and front wheel."""
        return (
            self.mass
            + 2 * self.drive_inertia / self.wheel_radius**2
            + self.front_wheel_inertia / self.front_wheel_radius**2
        )

    @property
    def effective_inertia(self) -> float:
        """Effective yaw inertia about P, J_e, in kg·m²: the robot's plus the spin inertias of its drives."""
        return (
            self.yaw_inertia
            + self.mass * self.com_offset**2
            + 2 * self.half_track**2 * self.drive_inertia / self.wheel_radius**2
        )

    @property
    def velocity_gain(self) -> float:
        """Static gain of the common channel, V per commanded U_Σ, in m/s/V."""
        return self.drive_gain * self.wheel_radius / self.voltage_per_rate

    @property
    def rotation_gain(self) -> float:
        """Static gain of the differential channel, θ̇ per commanded U_Δ, in rad/s/V.

        It is that of equation (3) at V = 0 with a steering that turns along, right for a feedforward. A feedback, whose
        correction the steering servo resists, sees less; `mrctl tune ROBOT` prints the plant that it sees.
        """
        return self.velocity_gain / self.half_track

    @property
    def velocity_time_constant(self) -> float:
        """Time constant of V under U_Σ in s."""
        return self.effective_mass * self.wheel_radius**2 / (2 * self.motor_gain * self.voltage_per_rate)

    @property
    def rotation_time_constant(self) -> float:
        """Time constant of θ̇ under U_Δ in s, for a feedforward, as `rotation_gain`."""
        damping = 2 * self.half_track**2 * self.motor_gain * self.voltage_per_rate / self.wheel_radius**2
        return self.effective_inertia / damping


class Tyres(NamedTuple):
    """Deviation of the nominal robot's driven wheels from pure rolling: λ̇_l,r r (1 ± load a_y) = u_l,r − lag u̇_l,r.

    λ̇ is the rate of a wheel, u_l,r = V ∓ D θ̇ the speed of its axle, and a_y the specific force to the left.
    """

    lag: float = 0.0
    """Slip of the driven tyres over their acceleration, in s; positive where a wheel turns less than its axle moves."""
    load: float = 0.0
    """Relative growth of the left rolling radius, and relative loss of the right one, over a_y, in s²/m."""


class RobotFile(Record):
    """The MJCF file of a robot, and the names of its parts where they are ambiguous in the file.

    Where a scenario has a string in its place, that is the `path`.
    """

    named_by = "path"

    path: str = "car"
    """Robot that drives: `car`, `turtlebot`, `racecar`, or the path of an MJCF file."""
    wheels: tuple[str, ...] = ()
    """Joints of the two driven wheels; by default the two joints with a <dcmotor>."""
    steering: tuple[str, ...] = ()
    """Joints of the steered wheels, at most two; by default the upright joints with an actuator."""
    chassis: str = ""
    """Body that carries the wheels; by default the one at their root."""


CAR = RobotFile()
"""The default: the robot that the world itself has, which is `car` unless the world's file has another."""
