"""Finds a number in a robot's file that is in the wrong unit.

A robot with a number in the wrong unit breaks no law, but nobody could build it. `bounds` lists quantities with the
intervals in which they lie for every robot, wide enough for toys and for trucks. Where a robot is outside, `mistake`
tries the usual unit errors on one quantity after the other, and names the one whose conversion makes the robot
possible.
"""

# pyright: reportAttributeAccessIssue=false
# (mujoco is compiled and ships no stubs)

from __future__ import annotations

import contextlib
import math
from typing import NamedTuple

import mujoco
import numpy as np

from mrctl.kernel import Array
from mrctl.physics.elements import REAR, bodies_of, fronts, part, rolling_fronts
from mrctl.record import InputError
from mrctl.theory.robot import ANY_ANGLE, LIMITS, Robot

RPM_PER_RAD_S = 30 / math.pi
"""Rate of one radian per second in rpm."""
GYRATION_RATIOS = 0.05, 1.0  # least and largest radius of gyration over the size of a robot
MAX_LENGTH_RATIO = 20.0  # largest length of a part over the track of a robot
LENGTH_ATTRIBUTES = (
    "com_offset", "com_height", "wheel_radius", "front_wheel_radius", "half_track", "wheelbase", "trail",
)  # fmt: skip


class Bound(NamedTuple):
    """A quantity of a robot, and the interval in which it lies for every robot."""

    quantity: str
    value: float
    low: float
    high: float
    unit: str

    @property
    def margin(self) -> float:
        """Logarithmic distance to the nearer end, as a share of the interval; negative outside."""
        low = max(self.low, 1e-6 * self.high)
        if self.value <= low:
            return 0.5 if self.low == 0 <= self.value else -1.0
        inner = min(math.log(self.value / low), math.log(self.high / self.value)) / math.log(self.high / low)
        return 0.5 if self.low == 0 and self.value < math.sqrt(low * self.high) else inner


class Mistake(NamedTuple):
    """A quantity that is probably in the wrong unit."""

    text: str
    """Element, quantity and number, the unit in which the number probably is, and the right unit."""
    robot: Robot
    """The robot after the conversion."""


def reach(robot: Robot) -> Array:
    """Returns the largest V, θ̇, V̇ and θ̈ that the motors reach by equation (3), `(4,)`, in SI units."""
    per_volt = robot.drive_gain * robot.motor_gain  # torque per commanded volt, N·m/V
    stall = per_volt * robot.supply - loss_torque(robot)
    speed = robot.velocity_gain * stall / per_volt
    force = 2 * stall / robot.wheel_radius
    turning = force * robot.half_track / robot.effective_inertia
    return np.array([speed, speed / robot.half_track, force / robot.effective_mass, turning])


def loss_torque(robot: Robot) -> float:
    """Returns the torque in N·m that all Coulomb losses take at each driven wheel on a straight line."""
    return robot.drive_loss + robot.rolling_force * robot.wheel_radius / 2


def derived_limits(robot: Robot) -> tuple[float, float, float, float]:
    """Returns limits on V, θ̇, V̇ and θ̈, in SI units, for a robot whose file has none, from its motors and its grip.

    The shares are chosen so that the default robot's numbers come out near its own limits: 64 % of the no-load speed,
    a sixth of the acceleration at stall, and of the tyres' grip a fifth along and a half across. The driven tyres alone
    accelerate the robot and, where nothing is steered, turn it on the spot: that takes at most half of their grip.
    At most half of the acceleration that lifts the front wheels or the caster is asked for.
    """
    grip = robot.tyre_friction * robot.gravity
    speed = 0.64 * robot.velocity_gain * robot.supply
    rotation = min(0.4 * speed / robot.half_track, 0.5 * grip / speed)
    if robot.steering_limit < ANY_ANGLE:
        rotation = min(rotation, 0.5 * speed * np.tan(robot.steering_limit) / robot.wheelbase)
    stall = 2 * robot.motor_gain * robot.supply / robot.wheel_radius / robot.effective_mass
    acceleration = min(stall / 6, 0.2 * grip, 0.5 * grip * (1 - robot.front_load), 0.5 * lifting_acceleration(robot))
    turning = 2 * rotation * acceleration / speed
    if robot.steering_limit >= ANY_ANGLE:
        limited = robot.model_copy(update={"max_rotation": rotation, "max_rotation_acceleration": turning})
        share = min(0.5 * driven_grip(robot) / turning_force(limited), 1.0)
        rotation, turning = rotation * share**0.5, turning * share
    return speed, rotation, acceleration, turning


def lifting_acceleration(robot: Robot) -> float:
    """Returns the acceleration in m/s² that lifts the front wheels or the caster, by statics.

    With the centre of mass c from the axle and h above the floor they bear (m g c − m a h)/base, which is 0 at g c/h.
    """
    return robot.gravity * abs(robot.com_offset) / robot.com_height if robot.com_height else math.inf


def turning_force(robot: Robot) -> float:
    """Returns the force in N, along and across, on each driven tyre that turns the robot on the spot at its limits."""
    lever = robot.mass * abs(robot.com_offset)
    inertia = robot.yaw_inertia + robot.mass * robot.com_offset**2
    along = inertia * robot.max_rotation_acceleration / robot.half_track + lever * robot.max_rotation**2
    return math.hypot(along, lever * robot.max_rotation_acceleration) / 2


def driven_grip(robot: Robot) -> float:
    """Returns the largest force in N that one driven tyre can carry at rest, μ M g (1 − front load)/2."""
    return robot.tyre_friction * robot.mass * robot.gravity * (1 - robot.front_load) / 2


def bounds(robot: Robot) -> list[Bound]:
    """Lists quantities and their bounds, which are chosen: 5000 kg/m³, motors of 10⁶ rpm, tyres with μ = 3."""
    size = robot.size
    stall = robot.motor_gain * robot.supply
    found = [
        Bound("mass over the cube of the size", robot.mass / size**3, 0.5, 5000, "kg/m³"),
        Bound("size, of wheelbase and track", size, 0.01, 15, "m"),
        Bound("wheel radius over the size", robot.wheel_radius / size, 0.005, 1, ""),
        Bound("friction of the tyres", robot.tyre_friction, 0.01, 3, ""),
        Bound("rolling resistance over the load", robot.rolling_coefficient, 0, 0.5, ""),
        Bound("no-load speed of the motors", robot.supply / robot.torque_constant * RPM_PER_RAD_S, 10, 1e6, "rpm"),
        Bound("stall current of the motors", robot.supply / robot.resistance, 0.01, 5000, "A"),
        Bound("losses over the stall torque", loss_torque(robot) / stall, 0, 0.9, ""),
    ]
    if found[-1].margin > 0:
        shares = [getattr(robot, name) for name in LIMITS] / reach(robot)
        names = ("V", "θ̇", "V̇", "θ̈")
        found += [
            Bound(f"limit on {name} over what the motors reach", float(share), 0.002, 10, "")
            for name, share in zip(names, shares, strict=True)
        ]
    return found


def extent(model: mujoco.MjModel, robot: Robot) -> Bound:
    """Returns the bound on the longest part beside the wheels, whose length is no parameter of equations (1) to (3)."""
    name, length = _longest(model)
    return Bound(f"length of {name} over the track", length / (2 * robot.half_track), 0, MAX_LENGTH_RATIO, "")


def too_long(model: mujoco.MjModel, half_track: float) -> str:
    """Returns which part is too long for a robot, and the unit in which its size probably is; "" where none is.

    Args:
        model: The compiled model.
        half_track: Half of its track in m. The wheelbase does not count, as such a part may be taken for a caster.
    """
    (name, length), track = _longest(model), 2 * half_track
    if not length > MAX_LENGTH_RATIO * track > 0:
        return ""
    unit = min(("mm", 1e3), ("cm", 1e2), key=lambda unit: abs(math.log(length / unit[1] / track)))[0]
    return f"{name} is {length:,.4g} m long, which no part of such a robot is; is it in {unit}? It must be in m"


def _longest(model: mujoco.MjModel) -> tuple[str, float]:
    """Returns the name of the longest geom of a robot beside those of its wheels, and its length in m."""
    wheels = {model.geom(wheel).bodyid[0] for wheel in (*REAR, *rolling_fronts(model))}
    bodies, contacts = {*bodies_of(model)} - wheels, {model.geom(name).id for name in fronts(model)}
    lengths = {
        geom: 2 * float(model.geom_aabb[geom, 3:].max())
        for geom in range(model.ngeom)
        if model.geom_bodyid[geom] in bodies and geom not in contacts
    }
    if not lengths:
        return "chassis", 0.0
    longest = max(lengths, key=lambda geom: lengths[geom])
    return part(model, longest), lengths[longest]


def mistake(model: mujoco.MjModel, robot: Robot) -> Mistake | None:
    """Finds the quantity whose conversion to another unit makes an impossible robot possible.

    A part that is too long comes first, as inertia and mass follow from it. Of several other candidates a gear of 1
    that was left out comes first, then the one with the largest sum of margins in the `bounds`.

    Args:
        model: The compiled model, for the names of its elements.
        robot: Its parameters.

    Returns:
        The mistake; None if the robot is possible, or if no conversion makes it so.
    """
    if long := too_long(model, robot.half_track):
        return Mistake(long, robot.replace(**_inertias(robot, robot.mass, 1.0, 1.0)))
    if _least(robot) > 0:
        return None
    able = [one for one in _candidates(model, robot) if _least(one.robot) > 0]
    if robot.gear_ratio == 1 and able and able[0].robot.gear_ratio != 1:
        return able[0]  # the gear that was left out
    return max(able, key=lambda one: sum(bound.margin for bound in bounds(one.robot)), default=None)


def _least(robot: Robot) -> float:
    """Returns the least margin of a robot in the `bounds`."""
    return min(bound.margin for bound in bounds(robot))


def _candidates(model: mujoco.MjModel, robot: Robot) -> list[Mistake]:
    """Lists the usual unit errors of one quantity each, where the corrected robot is valid."""
    masses = model.body_mass[(bodies := bodies_of(model))]
    heaviest, heavy = model.body(bodies[int(np.argmax(masses))]), masses[masses > masses.max() / 2].sum()
    motors, wheels = "of motor_left and motor_right", "of wheel_left and wheel_right"
    si = "m/s, rad/s, m/s² and rad/s²"
    rows: list[tuple[str, str, str, dict[str, float]]] = []
    found = []

    k, of_constant = robot.torque_constant, f"the motor constant {motors} is {robot.torque_constant:,.4g} V·s/rad"
    for unit, value in (
        ("mN·m/A", k / 1e3), ("V/rpm", k * RPM_PER_RAD_S), ("V/krpm", k * RPM_PER_RAD_S / 1e3),
        ("rpm/V", RPM_PER_RAD_S / k), ("kV·s/rad", k * 1e3),
    ):  # fmt: skip
        rows.append((of_constant, unit, "V·s/rad, which is N·m/A", {"torque_constant": value}))
    of_mass = f"the mass of {heaviest.name or 'a body'} is {heaviest.mass[0]:,.6g} kg"
    for unit, factor in (("g", 1e-3), ("t", 1e3)):
        for share in (robot.mass, heavy):
            rows.append((of_mass, unit, "kg", _of_mass(robot, robot.mass + (factor - 1) * share, factor)))
    of_lengths = f"the lengths are those of a track of {2 * robot.half_track:,.4g} m"
    of_radius = f"the radius {wheels} is {robot.wheel_radius:,.4g} m"
    of_loss = f"the frictionloss {wheels} leaves {robot.drive_loss:,.4g} N·m of losses in each drive"
    losses = ("gear_loss", "rolling_coefficient")
    of_limits = f"the numeric limits are {', '.join(f'{getattr(robot, name):g}' for name in LIMITS)}"
    of_resistance = f"the resistance {motors} is {robot.resistance:,.4g} Ω"
    of_rotor = f"the armature {motors} is {robot.rotor_inertia:,.4g} kg·m²"
    rows += [
        (of_lengths, "mm", "m", _of_lengths(robot, 1e-3)),
        (of_lengths, "cm", "m", _of_lengths(robot, 1e-2)),
        (of_radius, "mm", "m", _scaled(robot, ("wheel_radius",), 1e-3)),
        (of_radius, "cm", "m", _scaled(robot, ("wheel_radius",), 1e-2)),
        (f"the friction {wheels} is {robot.tyre_friction:g}", "%", "N/N", _scaled(robot, ("tyre_friction",), 1e-2)),
        (of_loss, "N·mm or N·cm", "N·m", _scaled(robot, losses, 1e-2)),
        (of_loss, "N·mm or N·cm", "N·m", _scaled(robot, losses, 1e-3)),
        (of_limits, "mm/s", si, _scaled(robot, LIMITS, 1e-3)),
        (of_limits, "km/s", si, _scaled(robot, LIMITS, 1e3)),
        (of_limits, "°/s", si, _scaled(robot, LIMITS[1::2], math.pi / 180)),
        (of_resistance, "mΩ", "Ω", _scaled(robot, ("resistance",), 1e-3)),
        (of_resistance, "kΩ", "Ω", _scaled(robot, ("resistance",), 1e3)),
        (of_rotor, "g·cm²", "kg·m²", _scaled(robot, ("rotor_inertia",), 1e-7)),
        (f"the supply {motors} is {robot.supply:,.6g} V", "mV", "V", _scaled(robot, ("supply",), 1e-3)),
    ]
    derived = np.allclose([getattr(robot, name) for name in LIMITS], derived_limits(robot), rtol=1e-9, atol=0)
    ends = (_possible_gears if derived else sufficient_gears)(robot) if robot.gear_ratio == 1 else None
    if ends:
        limits = f"The declared limits need one of {ends[0]:.2g} to {ends[1]:.2g}"
        needed = f"Such a robot needs at least {ends[0]:.2g}" if derived else limits
        text = f"the gear {motors} is 1: was it left out? {needed}"
        found.append(Mistake(text, robot.model_copy(update={"gear_ratio": math.sqrt(ends[0] * ends[1])})))
    for number, unit, right, changes in rows:
        is_it, it = ("are they", "They") if number.startswith(("the lengths", "the numeric")) else ("is it", "It")
        with contextlib.suppress(InputError):
            text = f"{number}, which no robot has; {is_it} in {unit}? {it} must be in {right}"
            found.append(Mistake(text, robot.replace(**changes)))
    return [one._replace(robot=_limited(one.robot)) for one in found] if derived else found


def _scaled(robot: Robot, names: tuple[str, ...], factor: float) -> dict[str, float]:
    """Returns fields times a factor."""
    return {name: getattr(robot, name) * factor for name in names}


def _of_mass(robot: Robot, mass: float, factor: float) -> dict[str, float]:
    """Returns the fields for another mass: rolling loss does not grow, and inertias in the wrong unit change too."""
    changed = {"mass": mass, "rolling_coefficient": robot.rolling_coefficient * min(1.0, robot.mass / mass)}
    return changed | _inertias(robot, mass, 1.0, factor)


def _of_lengths(robot: Robot, factor: float) -> dict[str, float]:
    """Returns all lengths times a factor, and the inertias times its square where they were in the wrong unit too."""
    return _scaled(robot, LENGTH_ATTRIBUTES, factor) | _inertias(robot, robot.mass, factor, factor**2)


def _inertias(robot: Robot, mass: float, length: float, factor: float) -> dict[str, float]:
    """Returns wheel inertias times a factor and a typical yaw inertia, if the radius of gyration is out of bounds."""
    size = length * robot.size
    if GYRATION_RATIOS[0] <= math.sqrt(robot.yaw_inertia / mass) / size <= GYRATION_RATIOS[1]:
        return {}
    of_wheels = _scaled(robot, ("wheel_inertia", "front_wheel_inertia", "fork_inertia"), factor)
    of_wheels["wheel_inertia"] = max(1e-9, of_wheels["wheel_inertia"])
    return of_wheels | {"yaw_inertia": mass * (0.4 * size) ** 2}


def sufficient_gears(robot: Robot) -> tuple[float, float] | None:
    """Returns the lowest and the highest gear with which the motors reach the limits with 10 % to spare, or None."""
    gears = robot.gear_ratio * np.geomspace(1e-3, 1e3, 601)
    found = [float(gear) for gear in gears if reaches_limits(robot.model_copy(update={"gear_ratio": gear}))]
    return (found[0], found[-1]) if found else None


def _possible_gears(robot: Robot) -> tuple[float, float] | None:
    """Returns the lowest and the highest gear with which a robot that declares no limits is possible, or None."""
    gears = np.geomspace(1, 1e3, 301)
    found = [float(gear) for gear in gears if _least(_limited(robot.model_copy(update={"gear_ratio": gear}))) > 0]
    return (found[0], found[-1]) if found else None


def _limited(robot: Robot) -> Robot:
    """Returns the robot with the limits that follow from its motors and its grip."""
    return robot.model_copy(update=dict(zip(LIMITS, derived_limits(robot), strict=True)))


def reaches_limits(robot: Robot) -> bool:
    """Tells whether the motors, by equation (3), reach the declared limits with 10 % to spare."""
    return bool((reach(robot) > 1.1 * np.array([getattr(robot, name) for name in LIMITS])).all())
