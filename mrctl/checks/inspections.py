"""Inspections of a robot's model: each finds one fault that a model can have, and knows how to repair it.

An inspection takes a compiled model and its parameters. It lists the parts that are out of tolerance, each with a
clause that gives the numbers, and the fields that repair such a part; most inspections let `_suspect` make a `Suspect`
of these. `mrctl.checks.examination` finds out whether a suspect is the cause of a failed check.
"""

# pyright: reportAttributeAccessIssue=false
# (mujoco is compiled and ships no stubs)

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mrctl.checks.open_loop import Car, caster_gaps, is_steered, rolling_fronts, rolling_wheels
from mrctl.kernel import Array
from mrctl.physics.elements import MOTORS, PREFIX, REAR, bodies_of, fronts, knuckles, part
from mrctl.physics.mjcf import steerings
from mrctl.physics.parameters import read_robot
from mrctl.physics.units import (
    RPM_PER_RAD_S,
    driven_grip,
    lifting_acceleration,
    reaches_limits,
    sufficient_gears,
    turning_force,
)
from mrctl.theory.robot import GRAVITY, Robot

Part = Any  # the name of an element of a model, or its index
Assignment = tuple[NDArray, ArrayLike]  # a view of a field of a model, and the value that repairs it

EDGED_GEOMS = (mujoco.mjtGeom.mjGEOM_CYLINDER, mujoco.mjtGeom.mjGEOM_BOX)
CONDIM = {1: "has no friction", 4: "also resists spinning", 6: "also resists rolling, which frictionloss does already"}


class Suspect(NamedTuple):
    """A possible fault of a model.

    Attributes:
        cause: Name of the fault.
        text: What is odd, with numbers, and what to do about it.
        repair: Removes the fault from a compiled model.
    """

    cause: str
    text: str
    repair: Callable[[mujoco.MjModel], None]


def suspects(model: mujoco.MjModel) -> list[Suspect]:
    """Lists the possible faults of a model."""
    robot = read_robot(model)
    return [suspect for inspect in INSPECTIONS if (suspect := inspect(model, robot)) is not None]


def _suspect(
    cause: str, odd: dict[Part, str], advice: str, repair: Callable[[mujoco.MjModel, Part], Iterable[Assignment]]
) -> Suspect | None:
    """Makes a suspect if any part is odd. All new values are computed before any of them is written.

    Args:
        cause: Name of the fault.
        odd: Parts that are out of tolerance, each with a clause that describes it.
        advice: What is expected, or what to do.
        repair: Returns the fields of a model that repair a part, with their new values.
    """

    def assign(model: mujoco.MjModel) -> None:
        assignments = [(field, np.array(value)) for part in odd for field, value in repair(model, part)]
        for field, value in assignments:
            field[...] = value

    return Suspect(cause, f"{', '.join(odd.values())}; {advice}", assign) if odd else None


def _differ(left: float, right: float, tolerance: float = 1e-6) -> bool:
    """Tells whether two numbers differ by more than a relative tolerance."""
    return abs(left - right) > tolerance * abs(right)


def _vector(values: NDArray) -> str:
    return f"({', '.join(f'{value:.4g}' for value in values)})"


# Wheels


def _edges(model: mujoco.MjModel, robot: Robot) -> Suspect | None:
    def sphere(m: mujoco.MjModel, wheel: Part) -> list[Assignment]:
        geom, radius = m.geom(wheel), m.geom(wheel).size[0]
        box = (0, 0, 0, radius, radius, radius)
        return [(geom.type, mujoco.mjtGeom.mjGEOM_SPHERE), (geom.rbound, radius), (m.geom_aabb[geom.id], box)]

    edged = [wheel for wheel in rolling_wheels(model) if int(model.geom(wheel).type[0]) in EDGED_GEOMS]
    odd = {wheel: f"{wheel} touches the ground along an edge, which scrubs as it turns" for wheel in edged}
    advice = "use a sphere or an ellipsoid for contact, and a cylinder for looks only"
    return _suspect("cylinder scrub", odd, advice, sphere)


def _centres(model: mujoco.MjModel, robot: Robot) -> Suspect | None:
    odd = {}
    for wheel in rolling_wheels(model):
        offset, axle = model.geom(wheel).pos - model.joint(wheel).pos, model.joint(wheel).axis
        along = offset @ axle
        across = np.linalg.norm(offset - along * axle)
        if np.linalg.norm(offset) > 1e-3 * model.geom(wheel).size[0]:
            odd[wheel] = f"the geom of {wheel} is {1e3 * across:.3g} mm off its axle and {1e3 * along:.3g} mm along it"
    advice = "put geom and joint on the wheel's centre"
    return _suspect("off-centre wheel", odd, advice, lambda m, wheel: [(m.geom(wheel).pos, m.joint(wheel).pos)])


def _axis(model: mujoco.MjModel, joint: Part) -> Array:
    """Returns the axis of a joint in the frame of its body's parent, a unit vector `(3,)`."""
    rotated = np.zeros(3)
    mujoco.mju_rotVecQuat(rotated, model.joint(joint).axis, model.body(model.jnt_bodyid[model.joint(joint).id]).quat)
    return rotated


def _axles(model: mujoco.MjModel, robot: Robot) -> Suspect | None:
    def align(m: mujoco.MjModel, wheel: Part) -> list[Assignment]:
        joint, body = m.joint(wheel), m.body(m.jnt_bodyid[m.joint(wheel).id])
        sign = -1.0 if _axis(m, wheel)[1] < 0 else 1.0
        axle, turn, quat = sign * _axis(m, wheel), np.zeros(4), np.zeros(4)
        turn[0], turn[1:] = 1 + axle[1], np.cross(axle, (0.0, 1.0, 0.0))
        mujoco.mju_mulQuat(quat, turn / np.linalg.norm(turn), body.quat)
        return [(joint.axis, sign * joint.axis), (body.quat, quat)]

    axes = {wheel: _axis(model, wheel) for wheel in rolling_wheels(model)}
    odd = {wheel: f"{wheel} turns about {_vector(axis)}" for wheel, axis in axes.items() if axis[1] < 0.99999}
    return _suspect("wheel axis", odd, "forwards is a positive turn about y, (0, 1, 0)", align)


def _places(model: mujoco.MjModel, robot: Robot) -> Suspect | None:
    def place(m: mujoco.MjModel, body: Part) -> list[Assignment]:
        position = m.body(body).pos
        sides = {REAR[0]: robot.half_track, REAR[1]: -robot.half_track}
        return [(position, (0, sides[body], 0) if body in sides else (position[0], 0, position[2]))]

    positions = {wheel: model.body(wheel).pos for wheel in REAR}
    uneven = abs(sum(position[1] for position in positions.values())) > 1e-4
    odd = [wheel for wheel, position in positions.items() if uneven or np.abs(position[[0, 2]]).max() > 1e-4]
    if "front_wheel" in fronts(model):
        odd += [body for body in ("fork", "front_wheel") if abs(model.body(body).pos[1]) > 1e-4]
    clauses = {body: f"{body} is at {_vector(model.body(body).pos)} m" for body in odd}
    advice = "the chassis' origin must be the midpoint of the rear axle, and the front wheel on its x axis"
    return _suspect("misplaced axle", clauses, advice, place)


def _heights(model: mujoco.MjModel, robot: Robot) -> Suspect | None:
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    bottoms = {wheel: data.geom(wheel).xpos[2] - model.geom(wheel).size[0] for wheel in (*REAR, *fronts(model))}
    rear = np.mean([bottoms[wheel] for wheel in REAR])
    gaps = {wheel: bottoms[wheel] - rear for wheel in fronts(model)}

    def level(m: mujoco.MjModel, wheel: Part) -> list[Assignment]:
        body, chassis = m.geom(wheel).bodyid[0], m.body("chassis").id
        height = m.geom(wheel).pos[2:]
        while body != chassis:  # up to the branch that the chassis carries
            height, body = m.body_pos[body, 2:], m.body_parentid[body]
        return [(height, height - gaps[wheel])]

    odd = {
        wheel: f"{wheel} ends {1e3 * abs(gap):.3g} mm {'above' if gap > 0 else 'below'} the rear wheels"
        for wheel, gap in gaps.items()
        if abs(gap) > 1e-2 * robot.wheel_radius
    }
    return _suspect("wheel radius against axle height", odd, "correct a radius or the height of an axle", level)


def _casters(model: mujoco.MjModel, robot: Robot) -> Suspect | None:
    def move(m: mujoco.MjModel, caster: Part) -> list[Assignment]:
        data, down = mujoco.MjData(m), np.array((0.0, 0.0, -gaps[caster]))
        mujoco.mj_kinematics(m, data)
        position = m.geom_pos[caster]
        return [(position, position + data.xmat[m.geom_bodyid[caster]].reshape(3, 3).T @ down)]

    gaps = caster_gaps(model)
    odd = {
        caster: f"{part(model, caster)} ends {1e3 * abs(gap):.3g} mm {'above' if gap > 0 else 'below'} the rear wheels"
        for caster, gap in gaps.items()
        if abs(gap) > 1e-2 * robot.wheel_radius
    }
    return _suspect("caster off the floor", odd, "correct its height or its size, or the height of the axle", move)


def _swivels(model: mujoco.MjModel, robot: Robot) -> Suspect | None:
    def swivel_of(wheel: str) -> int | None:
        """Returns the joint that turns the body that carries a caster's wheel; None if there is none."""
        body = model.body_parentid[model.geom(wheel).bodyid[0]]
        joint = model.body_jntadr[body]
        return None if body == model.body("chassis").id or joint < 0 else int(joint)

    def hold(m: mujoco.MjModel, wheel: Part) -> list[Assignment]:
        dof, pairs = m.jnt_dofadr[swivels[wheel]], [pair for pair, tyre in _tyres(m).items() if tyre == wheel]
        return [(m.dof_damping[dof : dof + 1], 1e3), *((m.pair_dim[pair : pair + 1], 1) for pair in pairs)]

    if is_steered(model):
        return None
    swivels = {wheel: joint for wheel in rolling_fronts(model) if (joint := swivel_of(wheel)) is not None}
    names = {wheel: model.joint(joint).name.removeprefix(PREFIX) for wheel, joint in swivels.items()}
    odd = {wheel: f"joint {name} lets the fork of {wheel} swing" for wheel, name in names.items()}
    advice = "the equations do not know how it pushes the robot aside as it swings out; a sphere slides instead"
    return _suspect("swivelling caster", odd, advice, hold)


def _radii(model: mujoco.MjModel, robot: Robot) -> Suspect | None:
    def resize(m: mujoco.MjModel, wheel: Part) -> list[Assignment]:
        geom = m.geom(wheel)
        factor = robot.wheel_radius / geom.size[0]
        return [(field, field * factor) for field in (geom.size, geom.rbound, m.geom_aabb[geom.id])]

    radii = {wheel: model.geom(wheel).size[0] for wheel in REAR}
    odd = {w: f"{w} has a radius of {1e3 * r:.4g} mm" for w, r in radii.items() if _differ(*radii.values())}
    return _suspect("rear wheel radii differ", odd, "equation (3) has one radius for both, so make them equal", resize)


# Motors and losses


def _motors(model: mujoco.MjModel, robot: Robot) -> Suspect | None:
    def equalise(m: mujoco.MjModel, name: Part) -> Iterable[Assignment]:
        left, right = (m.actuator(motor).id for motor in MOTORS)
        for field in (m.actuator_gear, m.actuator_gainprm, m.actuator_dynprm, m.actuator_armature[:, None]):
            yield field[right], field[left]
        left, right = m.actuator_ctrladr[[left, right]]
        yield m.actuator_ctrlrange[right], m.actuator_ctrlrange[left]

    motors = [model.actuator(name).id for name in MOTORS]
    fields = {
        "gear": model.actuator_gear[motors, 0],
        "resistance": model.actuator_gainprm[motors, 0],
        "motorconst": model.actuator_gainprm[motors, 1],
        "armature": model.actuator_armature[motors],
        "inductance over resistance": model.actuator_dynprm[motors, 0],
        "ctrlrange": model.actuator_ctrlrange[model.actuator_ctrladr[motors], 1],
    }
    odd = {name: f"{name} {left:g} left, {r:g} right" for name, (left, r) in fields.items() if _differ(left, r, 1e-5)}
    return _suspect(
        "left and right motors differ", odd, "equation (3) has one motor for both, so make them equal", equalise
    )


def _armature(model: mujoco.MjModel, robot: Robot) -> Suspect | None:
    """Judges the rotor's inertia by the time constant J_m R_a/k² (see `mrctl.checks.plausibility.motors`)."""
    inertia = robot.rotor_inertia + model.joint(REAR[0]).armature[0] / robot.gear_ratio**2
    once = robot.rotor_inertia / robot.gear_ratio**2
    per_second = robot.torque_constant**2 / robot.resistance
    clause = f"the rotor's inertia is {inertia:g} kg·m²"
    if inertia < 0.5e-3 * per_second and robot.gear_ratio > 3:
        cause, right = "missing armature", 5e-3 * per_second
        clause += f" behind a gear of {robot.gear_ratio:g}"
        advice = "reflected by gear² it is often the largest inertia at the wheel: give the <dcmotor> its armature"
    elif once >= 0.5e-3 * per_second and inertia > 0.2 * per_second:
        cause, right = "armature reflected twice", once
        advice = f"a <dcmotor> itself reflects it by gear² = {robot.gear_ratio**2:g}: give the rotor's own, {once:.3g}"
    else:
        return None

    def correct(m: mujoco.MjModel, motors: Part) -> list[Assignment]:
        return [(m.actuator_armature[m.actuator(name).id :][:1], right) for name in motors]

    return _suspect(cause, {MOTORS: clause}, advice, correct)


def _no_load_rpm(robot: Robot) -> float:
    """Returns the no-load speed of a motor at its own shaft in rpm."""
    return robot.supply / robot.torque_constant * RPM_PER_RAD_S


def _constant(model: mujoco.MjModel, robot: Robot) -> Suspect | None:
    rpm = _no_load_rpm(robot)
    if 100 <= rpm <= 60e3:
        return None
    factor = next((f for f in (RPM_PER_RAD_S, np.sqrt(RPM_PER_RAD_S), 1e-3) if 1e3 <= rpm / f <= 3e4), 1.0)
    unit = "mN·m/A" if factor == 1e-3 else "V/rpm"
    speed = f"{robot.supply:g} V is a no-load speed of {rpm:,.0f} rpm at its own shaft"

    def correct(m: mujoco.MjModel, motors: Part) -> list[Assignment]:
        constants = [m.actuator(name).gainprm[1:2] for name in motors]
        return [(constant, constant * factor) for constant in constants]

    odd = {MOTORS: f"{robot.torque_constant:.4g} V·s/rad at {speed}"}
    return _suspect(
        "motor constant in other units", odd, f"is it in {unit}? It must be in V·s/rad, which is N·m/A", correct
    )


def _gear(model: mujoco.MjModel, robot: Robot) -> Suspect | None:
    if not 100 <= _no_load_rpm(robot) <= 60e3 or reaches_limits(robot):
        return None  # a wrong motor constant is another fault
    sufficient = sufficient_gears(robot)
    if not sufficient:
        return None
    lowest, highest = sufficient
    motor = f"a motor of {_no_load_rpm(robot):,.0f} rpm and wheels of {1e3 * robot.wheel_radius:.3g} mm"
    need = f"the declared limits need one of {lowest:.2g} to {highest:.2g}"
    return _suspect(
        "wrong gear",
        {MOTORS: f"gear {robot.gear_ratio:g}: with {motor} {need}"},
        "correct the gear, or the limits",
        lambda m, motors: [(m.actuator(name).gear[:1], np.sqrt(lowest * highest)) for name in motors],
    )


def _grip_of_limits(model: mujoco.MjModel, robot: Robot) -> Suspect | None:
    """Compares the force that turning on the spot at both limits asks of a driven tyre with its grip."""
    if is_steered(model):
        return None  # the steered wheels turn it
    force, grip = turning_force(robot), driven_grip(robot)
    if force <= grip:
        return None
    share = 0.5 * grip / force

    def lower(m: mujoco.MjModel, limits: Part) -> list[Assignment]:
        values = m.numeric(limits).data
        return [(values[1:2], values[1] * share**0.5), (values[3:4], values[3] * share)]

    clause = (
        f"to turn at {robot.max_rotation:.3g} rad/s and {robot.max_rotation_acceleration:.3g} rad/s² each driven tyre "
        f"needs {force:.3g} N along and across, and grips {grip:.3g} N"
    )
    advice = 'put more of the load on the driven wheels, or give lower <numeric name="limits">'
    return _suspect("limits beyond the grip", {"limits": clause}, advice, lower)


def _drag(model: mujoco.MjModel, robot: Robot) -> Suspect | None:
    joints = [j for j in ("chassis", *rolling_fronts(model)) if model.joint(j).damping.any()]
    air = [field for field in ("density", "viscosity") if getattr(model.opt, field)]
    if not (joints or air):
        return None

    def repair(faulty: mujoco.MjModel) -> None:
        for joint in joints:
            faulty.joint(joint).damping[:] = 0
        faulty.opt.density = faulty.opt.viscosity = 0

    clauses = [f"joint {j} has damping {model.joint(j).damping.max():g}" for j in joints]
    clauses += [f"the air has {field} {getattr(model.opt, field):g}" for field in air]
    advice = (
        "in equation (3) only the driven wheels have viscous friction, so write this as their damping or frictionloss"
    )
    return Suspect("drag", f"{', '.join(clauses)}; {advice}", repair)


def _held_wheels(model: mujoco.MjModel, robot: Robot) -> Suspect | None:
    def clauses(wheel: str) -> list[str]:
        joint = model.joint(wheel)
        held = [f"a stiffness of {joint.stiffness[0]:g} N·m/rad"] if joint.stiffness.any() else []
        held += ["a range"] if model.jnt_limited[joint.id] else []
        torque = model.jnt_actfrcrange[joint.id, 1]
        return held + ([f"an actuatorfrcrange of {torque:g} N·m"] if model.jnt_actfrclimited[joint.id] else [])

    def free(m: mujoco.MjModel, wheel: Part) -> list[Assignment]:
        joint = m.joint(wheel)
        return [(field[joint.id :][:1], 0) for field in (m.jnt_stiffness, m.jnt_limited, m.jnt_actfrclimited)]

    held = {wheel: clauses(wheel) for wheel in rolling_wheels(model)}
    odd = {wheel: f"joint {wheel} has {' and '.join(found)}" for wheel, found in held.items() if found}
    advice = "only its motor and its losses turn a wheel in equation (3), so remove it"
    return _suspect("wheel held by its joint", odd, advice, free)


def _losses(model: mujoco.MjModel, robot: Robot) -> Suspect | None:
    def sides(m: mujoco.MjModel, name: Part) -> list[Array]:
        motors = [m.actuator(motor).id for motor in MOTORS]
        return {
            "frictionloss": [m.joint(wheel).frictionloss for wheel in REAR],
            "damping": [m.joint(wheel).damping for wheel in REAR],
            "motor damping": [m.actuator_damping[motor : motor + 1] for motor in motors],
        }[name]

    def equalise(m: mujoco.MjModel, name: Part) -> Iterable[Assignment]:
        return [(side, np.mean(sides(m, name))) for side in sides(m, name)]

    values = {name: np.ravel(sides(model, name)) for name in ("frictionloss", "damping", "motor damping")}
    odd = {
        name: f"{name} {left:g} left, {right:g} right" for name, (left, right) in values.items() if _differ(left, right)
    }
    return _suspect(
        "left and right losses differ", odd, "equation (3) has one loss for both, so make them equal", equalise
    )


def _creep(model: mujoco.MjModel, robot: Robot) -> Suspect | None:
    def impedance(m: mujoco.MjModel, wheel: Part) -> Array:
        return m.dof_solimp[m.joint(wheel).dofadr[0], :2]

    lowest = {wheel: impedance(model, wheel).min() for wheel in rolling_wheels(model)}
    odd = {wheel: f"{wheel} has solimpfriction {d:g}" for wheel, d in lowest.items() if d < 0.98}
    advice = 'soft Coulomb friction creeps in proportion to 1 − that: set solimpfriction="0.99 0.99"'
    return _suspect("creeping friction loss", odd, advice, lambda m, wheel: [(impedance(m, wheel), 0.99)])


# Masses


def _sideways(model: mujoco.MjModel) -> float:
    """Returns the distance of the whole robot's centre of mass to the left of its axis in m."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    chassis = data.body("chassis")
    return float((chassis.xmat.reshape(3, 3).T @ (data.subtree_com[chassis.id] - chassis.xpos))[1])


def _balance(model: mujoco.MjModel, robot: Robot) -> Suspect | None:
    def balance(m: mujoco.MjModel, chassis: Part) -> list[Assignment]:
        body = m.body(chassis)
        return [(body.ipos[1:2], body.ipos[1] - _sideways(m) * robot.mass / body.mass[0])]

    y = _sideways(model)
    clause = f"it lies {1e3 * abs(y):.3g} mm to the {'left' if y >= 0 else 'right'} of the axis"
    odd = {"chassis": clause} if abs(y) >= 1e-5 * robot.half_track else {}
    return _suspect(
        "centre of mass off the axis", odd, "equation (3) has an offset ahead only, so move it to the middle", balance
    )


def _tipping(model: mujoco.MjModel, robot: Robot) -> Suspect | None:
    """Compares the acceleration that lifts a caster, or the front wheels, with the largest one that the checks ask for.

    A caster ahead lifts where the robot accelerates, one behind where it brakes (`lifting_acceleration`). The checks
    accelerate to the limit, and by a fifth of the tyres' grip (`traction`).
    """
    lever, base, height = abs(robot.com_offset), abs(robot.wheelbase - robot.trail), robot.com_height
    hardest = max(robot.max_acceleration, 0.2 * robot.tyre_friction * robot.gravity)
    needed = hardest * height / robot.gravity
    if needed <= lever:
        return None
    lifting = lifting_acceleration(robot)
    ahead = min(2 * needed, 0.5 * base)  # where that is not enough, also lower

    def move(m: mujoco.MjModel, chassis: Part) -> list[Assignment]:
        body = m.body(chassis)
        shift = np.array((np.sign(robot.com_offset) * (ahead - lever), 0, (0.5 * ahead / needed - 1) * height))
        return [(body.ipos, body.ipos + shift * robot.mass / body.mass[0])]

    moves = "accelerating" if robot.wheelbase > 0 else "braking"
    front = "front wheels" if is_steered(model) else "caster"
    load, limit = robot.front_load * robot.mass * robot.gravity, robot.max_acceleration
    clause = (
        f"{moves} by more than {lifting:.3g} m/s² lifts the {front}, with {load:.3g} N at rest, {1e3 * base:.3g} mm "
        f"from the axle, and the centre of mass {1e3 * height:.3g} mm high; "
    )
    advice = f"move the centre of mass {1e3 * (needed - lever):.3g} mm towards the {front}"
    if limit > lifting:
        clause += f"the limit is {limit:.3g} m/s²"
        advice += f', or give a limit below {lifting:.3g} m/s² in <numeric name="limits">'
    else:
        clause += f"full voltage does so, the limit of {limit:.3g} m/s² does not"
    return _suspect("tips over", {"chassis": clause}, advice, move)


def _wheel_masses(model: mujoco.MjModel, robot: Robot) -> Suspect | None:
    def equalise(m: mujoco.MjModel, quantity: Part) -> Iterable[Assignment]:
        left, right = (m.body(wheel) for wheel in REAR)
        return [(getattr(right, name), getattr(left, name)) for name in ("mass", "inertia", "iquat")]

    left, right = (model.body(wheel) for wheel in REAR)
    values = {
        "mass": (left.mass[0], right.mass[0], "kg"),
        "largest inertia": (left.inertia.max(), right.inertia.max(), "kg·m²"),
    }
    odd = {name: f"{name} {a:.4g} {unit} left, {b:.4g} right" for name, (a, b, unit) in values.items() if _differ(a, b)}
    advice = "equation (3) has one wheel for both, so make them equal"
    return _suspect("left and right wheels differ", odd, advice, equalise)


def _wheel_inertia(model: mujoco.MjModel, robot: Robot) -> Suspect | None:
    wheels = {wheel: (model.body(wheel), model.geom(wheel).size[0]) for wheel in rolling_wheels(model)}
    ratios = {wheel: body.inertia.max() / (body.mass[0] * radius**2) for wheel, (body, radius) in wheels.items()}
    odd = {w: f"that of {w} is {ratio:.3g} times the inertia of a hoop" for w, ratio in ratios.items() if ratio > 1}

    def shrink(m: mujoco.MjModel, wheel: Part) -> list[Assignment]:
        return [(m.body(wheel).inertia, m.body(wheel).inertia * (0.5 / ratios[wheel]))]

    return _suspect(
        "wheel inertia", odd, "is it in kg·m²? A hoop of the same mass and radius has the largest inertia", shrink
    )


def _gravity(model: mujoco.MjModel, robot: Robot) -> Suspect | None:
    right = np.array((0, 0, -GRAVITY))
    clause = f"it is {_vector(model.opt.gravity)} m/s², not (0, 0, −{GRAVITY})"
    odd = {} if np.allclose(model.opt.gravity, right, atol=1e-3 * GRAVITY) else {"world": clause}
    return _suspect("gravity", odd, "use SI units", lambda m, _: [(m.opt.gravity, right)])


def _weightless(model: mujoco.MjModel, robot: Robot) -> Suspect | None:
    bodies = [body for body in bodies_of(model) if model.body_gravcomp[body]]
    odd = {body: f"{model.body(body).name or 'a body'} has gravcomp {model.body_gravcomp[body]:g}" for body in bodies}
    advice = "a force from outside then carries it, and the wheels bear less than its weight; remove it"
    return _suspect("weight carried from outside", odd, advice, lambda m, body: [(m.body_gravcomp[body:][:1], 0)])


# Contacts


def _tyres(model: mujoco.MjModel) -> dict[int, str]:
    """Returns the contact pairs of the wheels that roll, by index, with the name of the wheel."""
    wheels = {model.geom(w).id: w for w in rolling_wheels(model)}
    pairs = ((p, {model.pair_geom1[p], model.pair_geom2[p]} & wheels.keys()) for p in range(model.npair))
    return {p: wheels[geoms.pop()] for p, geoms in pairs if geoms}


def _missing_contacts(model: mujoco.MjModel, robot: Robot) -> Suspect | None:
    wheels = {model.geom(w).id: w for w in rolling_wheels(model)}
    touching = {geom for contact in Car(model).data.contact for geom in contact.geom}
    lost = [w for geom, w in wheels.items() if geom not in touching and w not in _tyres(model).values()]
    if not lost:
        return None
    pair = next(iter(_tyres(model)))
    floor = ({model.pair_geom1[pair], model.pair_geom2[pair]} - wheels.keys()).pop()

    def repair(faulty: mujoco.MjModel) -> None:
        for geom in (floor, *(faulty.geom(wheel).id for wheel in lost)):
            faulty.geom_contype[geom] = faulty.geom_conaffinity[geom] = 1
            faulty.geom_condim[geom], faulty.geom_priority[geom] = faulty.pair_dim[pair], 1
            faulty.geom_friction[geom, 0] = faulty.pair_friction[pair, 0]
            faulty.geom_solref[geom], faulty.geom_solimp[geom] = faulty.pair_solref[pair], faulty.pair_solimp[pair]

    text = f"no contact pair joins {', '.join(lost)} to the floor, into which it sinks; add a <pair>"
    return Suspect("missing contact pair", text, repair)


def _other_contacts(model: mujoco.MjModel, robot: Robot) -> Suspect | None:
    wheels = {model.geom(w).id for w in (*REAR, *fronts(model))}
    body, contype, conaffinity = model.geom_bodyid, model.geom_contype, model.geom_conaffinity
    chassis = model.body("chassis").id
    own = [g for g in range(model.ngeom) if model.body_rootid[body[g]] == chassis and g not in wheels]
    paired = {*model.pair_geom1, *model.pair_geom2}
    meets = ((contype[:, None] & conaffinity) | (conaffinity[:, None] & contype)) & (body[:, None] != body)
    colliding = [g for g in own if meets[g].any() or g in paired]
    if not colliding:
        return None

    def repair(faulty: mujoco.MjModel) -> None:
        faulty.geom_contype[colliding] = faulty.geom_conaffinity[colliding] = 0
        pairs = np.isin(faulty.pair_geom1, colliding) | np.isin(faulty.pair_geom2, colliding)
        faulty.pair_margin[pairs] = -1e3  # never near enough to touch

    names = [model.geom(g).name or f"a geom of {model.body(body[g]).name or 'the world'}" for g in colliding]
    advice = "give it contype and conaffinity 0 if it is for looks only, else raise it"
    return Suspect(
        "contact beside the wheels", f"{', '.join(names)} can touch the floor or the wheels; {advice}", repair
    )


def _condim(model: mujoco.MjModel, robot: Robot) -> Suspect | None:
    dims = {pair: int(model.pair_dim[pair]) for pair in _tyres(model)}
    odd = {p: f"{_tyres(model)[p]} has condim {dim}, which {CONDIM[dim]}" for p, dim in dims.items() if dim != 3}
    return _suspect("condim of a tyre", odd, "use condim 3", lambda m, pair: [(m.pair_dim[pair : pair + 1], 3)])


def _grip(model: mujoco.MjModel, robot: Robot) -> Suspect | None:
    tyres = {pair: (wheel, *model.pair_friction[pair, :2]) for pair, wheel in _tyres(model).items()}
    different = any(_differ(mu, robot.tyre_friction) for _, *frictions in tyres.values() for mu in frictions)
    odd = {pair: f"{wheel} has friction {a:g} and {b:g}" for pair, (wheel, a, b) in tyres.items() if different}
    return _suspect(
        "tyres of different grip",
        odd,
        "the laws have one coefficient for all tyres, so make them equal",
        lambda m, pair: [(m.pair_friction[pair, :2], robot.tyre_friction)],
    )


def _slip_times(model: mujoco.MjModel) -> Array:
    """Returns the time constants with which the tyres' contacts damp slip, in s; a solreffriction of 0 means solref."""
    pairs = list(_tyres(model))
    own = model.pair_solreffriction[pairs, 0]
    return np.where(own > 0, own, model.pair_solref[pairs, 0])


def _short_contacts(model: mujoco.MjModel, robot: Robot) -> Suspect | None:
    h = model.opt.timestep
    shortest = min(model.pair_solref[list(_tyres(model)), 0].min(), _slip_times(model).min())
    if not 0 < shortest < 2 * h * (1 - 1e-9):
        return None

    def repair(faulty: mujoco.MjModel) -> None:
        faulty.opt.timestep = shortest / 2

    text = (
        f"contacts of {1e3 * shortest:g} ms need a time step of half of that, and get {1e3 * h:g} ms, which softens "
        "them; shorten the step"
    )
    return Suspect("time step too long", text, repair)


def _soft_contacts(model: mujoco.MjModel, robot: Robot) -> Suspect | None:
    pairs = list(_tyres(model))
    contact, slip = model.pair_solref[pairs, 0].max(), _slip_times(model).max()
    clauses = []
    if contact > 0.011:
        clauses.append(f"solref {contact:g} s lets the tyres sink in")
    if slip > 0.0051:
        clauses.append(f"solreffriction {slip:g} s lets them drift outwards by V·θ̇ times half of that")
    if model.opt.cone != mujoco.mjtCone.mjCONE_ELLIPTIC:
        clauses.append("the friction cone is a pyramid")
    if model.opt.impratio < 10:
        clauses.append(f"impratio {model.opt.impratio:g} lets them creep under load")
    if not clauses:
        return None

    def repair(faulty: mujoco.MjModel) -> None:
        shortest = 2 * faulty.opt.timestep
        faulty.pair_solref[pairs] = max(0.01, shortest), 1
        faulty.pair_solreffriction[pairs] = max(0.004, shortest), 1
        faulty.opt.cone, faulty.opt.impratio = mujoco.mjtCone.mjCONE_ELLIPTIC, max(10, faulty.opt.impratio)

    advice = "take solref 0.01, solreffriction 0.004, an elliptic cone and impratio 10"
    return Suspect("soft contacts", f"{', '.join(clauses)}; {advice}", repair)


# Steering


def _fork(model: mujoco.MjModel, robot: Robot) -> Suspect | None:
    if not is_steered(model) or (axis := _axis(model, "steering"))[2] > 0.99999:
        return None
    odd = {"steering": f"the fork turns about {_vector(axis)}"}
    advice = "left is a positive turn about z, (0, 0, 1)"
    return _suspect("steering axis", odd, advice, lambda m, joint: [(m.joint(joint).axis, (0, 0, 1))])


def _servo(model: mujoco.MjModel, robot: Robot) -> Suspect | None:
    if steerings(model) != ("rigid",):
        return None  # other arrangements have a stiffness of their own
    stiffness = -model.actuator("steering").biasprm[1]
    torque = robot.trail * robot.tyre_friction * robot.front_load * robot.mass * GRAVITY

    def stiffen(m: mujoco.MjModel, name: Part) -> list[Assignment]:
        servo, factor = m.actuator(name), 300 * torque / stiffness
        factors = factor, factor**0.5  # the same damping ratio
        return [(gains[1:3], gains[1:3] * factors) for gains in (servo.gainprm, servo.biasprm)]

    clause = f"{stiffness:g} N·m/rad hold the fork, which a tyre that trails its axis turns with {torque:.2g} N·m"
    odd = {"steering": clause} if torque > 0.05 * stiffness else {}
    return _suspect("soft steering servo", odd, "raise kp", stiffen)


def _spring(model: mujoco.MjModel, robot: Robot) -> Suspect | None:
    if not is_steered(model):
        return None
    stiffness = {joint: model.joint(joint).stiffness for joint in ("steering", *knuckles(model))}
    odd = {
        joint: f"joint {joint} has a stiffness of {float(k[0]):g} N·m/rad" for joint, k in stiffness.items() if k.any()
    }
    advice = "the spring turns the wheels back from the angle that is commanded, so remove it"
    return _suspect("spring at the steering", odd, advice, lambda m, joint: [(m.joint(joint).stiffness, 0)])


def _degrees(model: mujoco.MjModel, robot: Robot) -> Suspect | None:
    limit = robot.steering_limit
    clause = f"the fork turns by {limit:.3g} rad at most, which is {np.degrees(limit):.3g}°"
    odd = {"steering": clause} if limit < 0.1 and is_steered(model) else {}
    advice = 'MJCF counts in degrees unless <compiler angle="radian"/> says otherwise'
    return _suspect(
        "angles in degrees",
        odd,
        advice,
        lambda m, joint: [(m.joint(joint).range, m.joint(joint).range * (180 / np.pi))],
    )


INSPECTIONS = (
    _edges, _centres, _axles, _places, _heights, _casters, _swivels, _radii,
    _motors, _armature, _constant, _gear, _grip_of_limits, _drag, _held_wheels, _losses, _creep,
    _wheel_masses, _balance, _tipping, _wheel_inertia, _gravity, _weightless,
    _missing_contacts, _other_contacts, _condim, _grip, _short_contacts, _soft_contacts,
    _fork, _servo, _spring, _degrees,
)  # fmt: skip
"""All inspections, in the order in which their repairs are applied."""
