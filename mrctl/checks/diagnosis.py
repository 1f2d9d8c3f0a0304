"""Why does a robot fail a check? Evidence first: what is odd in its model is repaired, and the check runs again.

An oddity (a `Suspect`) is found by inspection of the compiled model: a wheel geom beside its axle, a cylinder, motors
that differ. It is named as a cause of a failed check only if the check passes with all suspects repaired and fails
again when this one alone is left as it was. A model may thus be odd in many ways, and only those that matter for what
was measured are named. Where no oddity explains a failure, a shorter time step is tried; what is left is said to be
unexplained.

The parameters that a check expects are read from the same model, so three kinds of mistakes show: parts of a model
that contradict each other (left and right, geom and axle), physics that departs from equations (1) and (3), and numbers
that are consistent but belong to no robot (no rotor inertia behind a gear, limits that no voltage reaches).
"""

# pyright: reportAttributeAccessIssue=false
# (mujoco is compiled and ships no stubs)

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from mrctl.checks.catalogue import CHECKS, Car, Check, Comparison, Report, rolling_wheels, steered
from mrctl.physics.elements import MOTORS, REAR, fronts
from mrctl.physics.mjcf import steerings
from mrctl.physics.parameters import read_robot
from mrctl.record import InputError
from mrctl.theory.robot import GRAVITY, Robot, Steering

Load = Callable[[Steering | None], mujoco.MjModel]  # None: the robot's own arrangement
FIRST = ("stance", "limits", "inertias")  # a robot that fails these fails others, too, for the same cause
# Checks of whatever is to be a robot, and those of `FIRST` that have to go before them.
BASICS = {"stance": (), "inertias": (), "motors": (), "limits": ("stance",), "turning_limits": ("stance",)}
SIDES = ("left", "right")
FINER = 8  # by which the time step is divided, where nothing else explains a failure


class Suspect(NamedTuple):
    """Something odd in a model.

    Attributes:
        cause: A name for it, in a few words.
        text: What is odd, with numbers, and what to do about it.
        repair: Takes it out of a compiled model.
    """

    cause: str
    text: str
    repair: Callable[[mujoco.MjModel], None]


class Explanation(NamedTuple):
    """A cause of a failed check.

    Attributes:
        cause: Its name.
        text: What is odd in the model, and what to do about it.
        evidence: The worst value of the check, with the causes repaired.
    """

    cause: str
    text: str
    evidence: str


@dataclass(frozen=True)
class Finding:
    """The outcome of one check: `passed`, `failed`, or `skipped` for a reason."""

    check: Check
    report: Report
    causes: tuple[Explanation, ...] = ()
    reason: str = ""

    @property
    def status(self) -> str:
        """In a word or two."""
        if self.reason:
            return "skipped"
        return "passed" if all(c.passed for c in self.report) else "failed"


class Examination:
    """The checks of one robot; what they share is found once.

    Attributes:
        checks: Those that are for a level floor.
        suspects: What is odd in the robot's model.
    """

    checks = tuple(check for check in CHECKS if check.world == "flat")

    def __init__(self, load: Load) -> None:
        """Takes what compiles the robot in a steering arrangement.

        Raises:
            InputError: The robot cannot be loaded.
        """
        self._load = load
        self.suspects = suspects(load(None))
        self._basics: dict[str, Finding] = {}

    def look(self, check: Check) -> Finding:
        """Runs one check, and explains it if it fails.

        A robot that does not stand, or cannot do what it declares, fails all sorts of checks for the same cause: with
        that explained, the others wait.
        """
        if check.name in self._basics:
            return self._basics[check.name]
        for first in (c for c in self.checks if c.name in BASICS.get(check.name, FIRST)):
            if self.look(first).causes:
                return Finding(check, [], reason=f"waits for {first.name}")
        finding = self._run(check)
        if check.name in BASICS:
            self._basics[check.name] = finding
        return finding

    def _run(self, check: Check) -> Finding:
        model = self._load(check.steering)
        if reason := check.unsuited(model):
            return Finding(check, [], reason=reason)
        report = check.measure(model, read_robot(model))
        if all(c.passed for c in report):
            return Finding(check, report)
        return Finding(check, report, tuple(_explain(self._load, check, report, self.suspects)))


def _explain(load: Load, check: Check, report: Report, found: list[Suspect]) -> Iterator[Explanation]:
    """Those suspects without whose repair the check still fails, when all others are repaired."""

    def repaired(those: Sequence[Suspect]) -> Report:
        model = load(check.steering)
        for suspect in those:
            suspect.repair(model)
        try:
            mujoco.mj_setConst(model, mujoco.MjData(model))
            return check.measure(model, read_robot(model))
        except (InputError, mujoco.FatalError):
            return []

    def passes(report: Report) -> bool:
        return bool(report) and all(c.passed for c in report)

    worst = max((c for c in report if not c.passed), key=excess)
    whole = repaired(found) if found else []
    if not passes(whole):
        finer = [_finer(load(None), factor) for factor in (2, FINER)]
        half, whole = (repaired([*found, suspect]) for suspect in finer)
        if not passes(whole) or not _excess_of(worst.quantity, half) < excess(worst):
            return
        found = [*found, finer[-1]]
    without = [repaired([s for s in found if s is not suspect]) for suspect in found] if len(found) > 1 else [[]]
    needed = [s for s, rest in zip(found, without, strict=True) if not passes(rest)]
    if not needed:  # each of several does
        needed = [s for s in found if passes(repaired([s]))]
    after = next((c for c in whole if c.quantity == worst.quantity), whole[0])
    for suspect in needed:
        yield Explanation(suspect.cause, suspect.text, str(after))


def excess(comparison: Comparison) -> float:
    """How many tolerances a value is off."""
    excess = abs(comparison.measured - comparison.expected) / max(comparison.tolerance, 1e-12)
    return excess if np.isfinite(excess) else np.inf


def _excess_of(quantity: str, report: Report) -> float:
    return next((excess(c) for c in report if c.quantity == quantity), np.inf)


def suspects(model: mujoco.MjModel) -> list[Suspect]:
    """All that is odd in a model."""
    robot = read_robot(model)
    return [suspect for inspect in INSPECTIONS if (suspect := inspect(model, robot)) is not None]


def _finer(model: mujoco.MjModel, factor: float) -> Suspect:
    """The time step, which can be too long without anything to be seen."""
    h = 1e3 * model.opt.timestep

    def repair(m: mujoco.MjModel) -> None:
        m.opt.timestep /= factor

    text = f"the result changes with the time step: at {h / factor:g} ms instead of {h:g} ms it is right; shorten it"
    return Suspect("time step too long", text, repair)


# Wheels


def _standing(model: mujoco.MjModel) -> list[str]:
    """Geoms that the robot stands on."""
    return [*REAR, *fronts(model)]


def _axle(model: mujoco.MjModel, joint: str) -> NDArray[np.float64]:
    """Axis of a wheel's joint in the frame of the body that carries the wheel, `(3,)`."""
    axis, rotated = model.joint(joint).axis, np.zeros(3)
    mujoco.mju_rotVecQuat(rotated, axis, model.body(model.jnt_bodyid[model.joint(joint).id]).quat)
    return rotated


def _shape(model: mujoco.MjModel, robot: Robot) -> Suspect | None:
    edged = (int(mujoco.mjtGeom.mjGEOM_CYLINDER), int(mujoco.mjtGeom.mjGEOM_BOX))
    names = [w for w in rolling_wheels(model) if int(model.geom(w).type[0]) in edged]
    if not names:
        return None

    def repair(m: mujoco.MjModel) -> None:
        for name in names:
            geom, radius = m.geom(name), m.geom(name).size[0]
            m.geom_type[geom.id] = mujoco.mjtGeom.mjGEOM_SPHERE
            m.geom_rbound[geom.id] = radius
            m.geom_aabb[geom.id] = 0, 0, 0, radius, radius, radius

    text = f"{_join(names)}: a cylinder touches the ground along an edge and scrubs as it turns; use a sphere"
    return Suspect("cylinder scrub", f"{text} or an ellipsoid for contact, and the cylinder for looks only", repair)


def _centre(model: mujoco.MjModel, robot: Robot) -> Suspect | None:
    odd = {}
    for name in rolling_wheels(model):
        apart = model.geom(name).pos - model.joint(name).pos
        if np.linalg.norm(apart) > 1e-3 * model.geom(name).size[0]:
            along = apart @ model.joint(name).axis
            odd[name] = np.linalg.norm(apart - along * model.joint(name).axis), along
    if not odd:
        return None

    def repair(m: mujoco.MjModel) -> None:
        for name in odd:
            m.geom(name).pos[:] = m.joint(name).pos

    where = [
        f"{name} is {1e3 * out:.3g} mm off and {1e3 * along:.3g} mm along its axle"
        for name, (out, along) in odd.items()
    ]
    return Suspect(
        "off-centre wheel", f"the contact geom of {_join(where)}; put geom and joint on the wheel's centre", repair
    )


def _direction(model: mujoco.MjModel, robot: Robot) -> Suspect | None:
    odd = {name: axis for name in rolling_wheels(model) if (axis := _axle(model, name))[1] < 0.99999}
    if not odd:
        return None

    def repair(m: mujoco.MjModel) -> None:
        for name in odd:
            axis, body = m.joint(name).axis, m.body(m.jnt_bodyid[m.joint(name).id])
            if _axle(m, name)[1] < 0:
                axis *= -1
            off, turn, quat = _axle(m, name), np.zeros(4), body.quat.copy()
            sine = np.cross(off, (0.0, 1.0, 0.0))
            turn[0], turn[1:] = 1 + off[1], sine
            mujoco.mju_mulQuat(body.quat, turn / np.linalg.norm(turn), quat)

    where = [f"{name} turns about {_vector(axis)}" for name, axis in odd.items()]
    return Suspect("wheel axis", f"{_join(where)}; forwards is a positive turn about y, (0, 1, 0)", repair)


def _place(model: mujoco.MjModel, robot: Robot) -> Suspect | None:
    left, right = (model.body(w).pos for w in REAR)
    odd = [f"{w} at {_vector(model.body(w).pos)}" for w in REAR if np.abs(model.body(w).pos[[0, 2]]).max() > 1e-4]
    if abs(left[1] + right[1]) > 1e-4:
        odd = [f"{w} at {_vector(model.body(w).pos)}" for w in REAR]
    middle = ("fork", "front_wheel") if "front_wheel" in fronts(model) else ()
    odd += [f"{w} at y = {model.body(w).pos[1]:g}" for w in middle if abs(model.body(w).pos[1]) > 1e-4]
    if not odd:
        return None

    def repair(m: mujoco.MjModel) -> None:
        for name, sign in zip(REAR, (1, -1), strict=True):
            m.body(name).pos[:] = 0, sign * robot.half_track, 0
        for name in middle:
            m.body(name).pos[1] = 0

    text = (
        f"{_join(odd)} in m: the chassis' origin must be the midpoint of the rear axle, the front wheel on its x axis"
    )
    return Suspect("misplaced axle", text, repair)


def _heights(model: mujoco.MjModel, robot: Robot) -> Suspect | None:
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    low = {w: data.geom(w).xpos[2] - model.geom(w).size[0] for w in _standing(model)}
    rear = np.mean([low[w] for w in REAR])
    odd = {w: low[w] - rear for w in fronts(model) if abs(low[w] - rear) > 1e-2 * robot.wheel_radius}
    if not odd:
        return None

    def repair(m: mujoco.MjModel) -> None:
        for name, gap in odd.items():
            body, chassis = m.geom(name).bodyid[0], m.body("chassis").id
            if body == chassis:
                m.geom(name).pos[2] -= gap
            while body != chassis:
                body, branch = m.body_parentid[body], body
                if body == chassis:
                    m.body_pos[branch, 2] -= gap

    where = [
        f"{w} ends {1e3 * abs(gap):.3g} mm {'above' if gap > 0 else 'below'} the rear wheels" for w, gap in odd.items()
    ]
    text = f"{_join(where)}; correct a radius or the height of an axle"
    return Suspect("wheel radius against axle height", text, repair)


def _radii(model: mujoco.MjModel, robot: Robot) -> Suspect | None:
    radii = [model.geom(w).size[0] for w in REAR]
    if np.isclose(*radii, rtol=1e-6):
        return None

    def repair(m: mujoco.MjModel) -> None:
        for name in REAR:
            geom = m.geom(name).id
            for field in (m.geom_size, m.geom_rbound, m.geom_aabb):
                field[geom] *= robot.wheel_radius / model.geom(name).size[0]

    text = f"left {1e3 * radii[0]:.4g} mm, right {1e3 * radii[1]:.4g} mm: equation (3) has one radius for both"
    return Suspect("rear wheel radii differ", text, repair)


# Motors and losses


def _motor(model: mujoco.MjModel, name: str) -> dict[str, float]:
    motor = model.actuator(name)
    return {
        "gear": motor.gear[0],
        "resistance": motor.gainprm[0],
        "motorconst": motor.gainprm[1],
        "armature": model.actuator_armature[motor.id],
        "inductance over resistance": model.actuator_dynprm[motor.id, 0],
        "ctrlrange": model.actuator_ctrlrange[model.actuator_ctrladr[motor.id], 1],
    }


def _motors_differ(model: mujoco.MjModel, robot: Robot) -> Suspect | None:
    left, right = (_motor(model, name) for name in MOTORS)
    odd = [
        f"{key} {left[key]:g} left, {right[key]:g} right"
        for key in left
        if not np.isclose(left[key], right[key], atol=0)
    ]
    if not odd:
        return None

    def repair(m: mujoco.MjModel) -> None:
        one, other = (m.actuator(name).id for name in MOTORS)
        for field in (m.actuator_gear, m.actuator_gainprm, m.actuator_dynprm, m.actuator_armature):
            field[other] = field[one]
        one, other = m.actuator_ctrladr[[one, other]]
        m.actuator_ctrlrange[other] = m.actuator_ctrlrange[one]

    return Suspect("left and right motors differ", f"{_join(odd)}; equation (3) has one motor for both", repair)


def _armature(model: mujoco.MjModel, robot: Robot) -> Suspect | None:
    """Against the mechanical time constant of usual motors, see `mrctl.checks.catalogue.motors`."""
    gear, scale = robot.gear_ratio, robot.torque_constant**2 / robot.resistance
    own = robot.rotor_inertia + model.joint(REAR[0]).armature[0] / gear**2
    if own < 0.5e-3 * scale and gear > 3:
        cause, to = "missing armature", 5e-3 * scale
        text = f"rotor inertia {own:g} kg·m² behind a gear of {gear:g}: reflected by gear² it is often the largest"
        text += " inertia at the wheel; give the <dcmotor> its armature, the rotor's own"
    elif 0.5e-3 * scale <= robot.rotor_inertia / gear**2 and own > 0.2 * scale:
        cause, to = "armature reflected twice", robot.rotor_inertia / gear**2
        text = f"rotor inertia {own:g} kg·m²: a <dcmotor> reflects its armature by gear² = {gear**2:g}; give it the"
        text += f" rotor's own, {to:.3g}"
    else:
        return None

    def repair(m: mujoco.MjModel) -> None:
        m.actuator_armature[[m.actuator(name).id for name in MOTORS]] = to

    return Suspect(cause, text, repair)


def _no_load_rpm(robot: Robot) -> float:
    return robot.supply / robot.torque_constant * 30 / np.pi


def _constant(model: mujoco.MjModel, robot: Robot) -> Suspect | None:
    rpm = _no_load_rpm(robot)
    if 100 <= rpm <= 60e3:
        return None
    factor = next((f for f in (30 / np.pi, np.sqrt(30 / np.pi), 1e-3) if 1e3 <= rpm / f <= 3e4), 1.0)
    unit = "mN·m/A" if factor == 1e-3 else "V/rpm"

    def repair(m: mujoco.MjModel) -> None:
        motors = [m.actuator(name).id for name in MOTORS]
        m.actuator_gainprm[motors, 1] *= factor

    text = (
        f"{robot.torque_constant:.4g} V·s/rad at {robot.supply:g} V is a no-load speed of {rpm:,.0f} rpm on the motor's"
    )
    return Suspect(
        "motor constant in other units", f"{text} shaft: is it in {unit}? N·m/A and V·s/rad are meant", repair
    )


def _gear(model: mujoco.MjModel, robot: Robot) -> Suspect | None:
    if not 100 <= _no_load_rpm(robot) <= 60e3:
        return None  # the motor is what is wrong
    gears = robot.gear_ratio * np.geomspace(1e-3, 1e3, 601)
    fit = [gear for gear in gears if _reaches(robot.model_copy(update={"gear_ratio": gear}))]
    if not fit or _reaches(robot):
        return None
    best = float(np.sqrt(fit[0] * fit[-1]))

    def repair(m: mujoco.MjModel) -> None:
        for name in MOTORS:
            m.actuator(name).gear[0] = best

    text = f"gear {robot.gear_ratio:g}: with a motor of {_no_load_rpm(robot):,.0f} rpm and wheels of"
    text += f" {1e3 * robot.wheel_radius:.3g} mm the declared limits need one of {fit[0]:.2g} to {fit[-1]:.2g}"
    return Suspect("wrong gear", f"{text}; correct the gear, or the limits", repair)


def _reaches(robot: Robot) -> bool:
    """Whether motors, by equation (3), reach the declared limits, with 10 % to spare."""
    loss = robot.drive_loss + robot.rolling_force * robot.wheel_radius / 2
    stall = robot.motor_gain * robot.supply - loss
    speed = robot.velocity_gain * stall / robot.motor_gain
    force = 2 * stall / robot.wheel_radius
    return (
        speed > 1.1 * robot.max_speed
        and speed / robot.half_track > 1.1 * robot.max_rotation
        and force / robot.effective_mass > 1.1 * robot.max_acceleration
        and force * robot.half_track / robot.effective_inertia > 1.1 * robot.max_rotation_acceleration
    )


def _drag(model: mujoco.MjModel, robot: Robot) -> Suspect | None:
    joints = ("chassis", *rolling_wheels(model))
    odd = [f"joint {j} has damping {model.joint(j).damping.max():g}" for j in joints if model.joint(j).damping.any()]
    odd += [f"the air has {k} {getattr(model.opt, k):g}" for k in ("density", "viscosity") if getattr(model.opt, k)]
    if not odd:
        return None

    def repair(m: mujoco.MjModel) -> None:
        for name in joints:
            m.joint(name).damping[:] = 0
        m.opt.density = m.opt.viscosity = 0

    return Suspect(
        "drag", f"{_join(odd)}: in equation (3) only back-EMF brakes with speed; losses are frictionloss", repair
    )


def _losses_differ(model: mujoco.MjModel, robot: Robot) -> Suspect | None:
    left, right = (model.joint(w).frictionloss[0] for w in REAR)
    if np.isclose(left, right, rtol=1e-6):
        return None

    def repair(m: mujoco.MjModel) -> None:
        for name in REAR:
            m.joint(name).frictionloss[0] = (left + right) / 2

    text = f"frictionloss {left:g} N·m left, {right:g} N·m right: equation (3) has one loss for both"
    return Suspect("left and right losses differ", text, repair)


def _creep(model: mujoco.MjModel, robot: Robot) -> Suspect | None:
    odd = {w: model.dof_solimp[model.joint(w).dofadr[0], :2].min() for w in rolling_wheels(model)}
    odd = {w: d for w, d in odd.items() if d < 0.98}
    if not odd:
        return None

    def repair(m: mujoco.MjModel) -> None:
        for name in odd:
            m.dof_solimp[m.joint(name).dofadr[0], :2] = 0.99

    text = f"solimpfriction {min(odd.values()):g} of {_join(list(odd))}: soft Coulomb friction creeps in proportion to"
    return Suspect("creeping friction loss", f'{text} 1 − that; set solimpfriction="0.99 0.99"', repair)


# Masses


def _aside(model: mujoco.MjModel) -> float:
    """Centre of mass of the whole robot to the left of its axis in m."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    chassis = data.body("chassis")
    return float((chassis.xmat.reshape(3, 3).T @ (data.subtree_com[chassis.id] - chassis.xpos))[1])


def _balance(model: mujoco.MjModel, robot: Robot) -> Suspect | None:
    side = _aside(model)
    if abs(side) < 1e-5 * robot.half_track:
        return None

    def repair(m: mujoco.MjModel) -> None:
        body = m.body("chassis")
        body.ipos[1] -= _aside(m) * robot.mass / body.mass[0]

    text = f"it lies {1e3 * abs(side):.3g} mm to the {SIDES[side < 0]} of the axis:"
    return Suspect("centre of mass off the axis", f"{text} equation (3) knows only an offset ahead", repair)


def _wheel_inertia(model: mujoco.MjModel, robot: Robot) -> Suspect | None:
    odd = {}
    for name in rolling_wheels(model):
        body = model.body(name)
        hoop = body.mass[0] * model.geom(name).size[0] ** 2
        if body.inertia.max() > hoop:
            odd[name] = body.inertia.max() / hoop
    if not odd:
        return None

    def repair(m: mujoco.MjModel) -> None:
        for name, ratio in odd.items():
            m.body(name).inertia[:] *= 0.5 / ratio

    where = [f"that of {name} is {ratio:.3g} times a hoop's of its mass and radius" for name, ratio in odd.items()]
    return Suspect("wheel inertia", f"{_join(where)}; kg·m² are meant", repair)


def _gravity(model: mujoco.MjModel, robot: Robot) -> Suspect | None:
    if np.allclose(model.opt.gravity, (0, 0, -GRAVITY), atol=1e-3 * GRAVITY):
        return None

    def repair(m: mujoco.MjModel) -> None:
        m.opt.gravity[:] = 0, 0, -GRAVITY

    return Suspect(
        "gravity", f"it is {_vector(model.opt.gravity)} m/s², not (0, 0, −{GRAVITY}); SI units are meant", repair
    )


# Contacts


def _tyres(model: mujoco.MjModel) -> dict[int, str]:
    """Contact pairs of what rolls, and whose they are."""
    wheels = {model.geom(w).id: w for w in rolling_wheels(model)}
    pairs = ((p, {model.pair_geom1[p], model.pair_geom2[p]} & wheels.keys()) for p in range(model.npair))
    return {p: wheels[geoms.pop()] for p, geoms in pairs if geoms}


def _missing(model: mujoco.MjModel, robot: Robot) -> Suspect | None:
    wheels = {model.geom(w).id: w for w in rolling_wheels(model)}
    data = Car(model).data
    touching = {g for c in data.contact for g in c.geom}
    odd = [name for geom, name in wheels.items() if geom not in touching and name not in _tyres(model).values()]
    if not odd:
        return None
    pair = next(iter(_tyres(model)))
    floor = ({model.pair_geom1[pair], model.pair_geom2[pair]} - wheels.keys()).pop()

    def repair(m: mujoco.MjModel) -> None:
        for geom in (floor, *(m.geom(name).id for name in odd)):
            m.geom_contype[geom] = m.geom_conaffinity[geom] = 1
            m.geom_condim[geom], m.geom_priority[geom] = m.pair_dim[pair], 1
            m.geom_friction[geom, 0] = m.pair_friction[pair, 0]
            m.geom_solref[geom], m.geom_solimp[geom] = m.pair_solref[pair], m.pair_solimp[pair]

    return Suspect("missing contact pair", f"nothing pairs {_join(odd)} with the floor: it sinks through", repair)


def _strangers(model: mujoco.MjModel, robot: Robot) -> Suspect | None:
    wheels = {model.geom(w).id for w in _standing(model)}
    body, give, take = model.geom_bodyid, model.geom_contype, model.geom_conaffinity
    own = [g for g in range(model.ngeom) if model.body_rootid[body[g]] == model.body("chassis").id and g not in wheels]
    paired = {*model.pair_geom1, *model.pair_geom2}
    meets = ((give[:, None] & take) | (give & take[:, None])) & (body[:, None] != body)
    odd = [g for g in own if meets[g].any() or g in paired]
    if not odd:
        return None

    def repair(m: mujoco.MjModel) -> None:
        m.geom_contype[odd] = m.geom_conaffinity[odd] = 0
        m.pair_margin[np.isin(m.pair_geom1, odd) | np.isin(m.pair_geom2, odd)] = -1e3  # never near enough

    text = f"{_join([_geom(model, g) for g in odd])} can touch the floor or the wheels; give what is for looks contype"
    return Suspect("contact beside the wheels", f"{text} and conaffinity 0, or raise it", repair)


def _condim(model: mujoco.MjModel, robot: Robot) -> Suspect | None:
    odd = {p: w for p, w in _tyres(model).items() if model.pair_dim[p] != 3}
    if not odd:
        return None
    kind = {
        1: "has no friction",
        4: "also resists spinning",
        6: "also resists rolling, which frictionloss does already",
    }

    def repair(m: mujoco.MjModel) -> None:
        m.pair_dim[list(odd)] = 3

    where = [f"{w} has condim {model.pair_dim[p]}, which {kind[int(model.pair_dim[p])]}" for p, w in odd.items()]
    return Suspect("condim of a tyre", f"{_join(where)}; use condim 3", repair)


def _grip(model: mujoco.MjModel, robot: Robot) -> Suspect | None:
    pairs = list(_tyres(model))
    frictions = model.pair_friction[pairs, :2]
    if np.allclose(frictions, robot.tyre_friction, rtol=1e-6):
        return None

    def repair(m: mujoco.MjModel) -> None:
        m.pair_friction[pairs, :2] = robot.tyre_friction

    where = [
        f"{w} has friction {model.pair_friction[p, 0]:g} and {model.pair_friction[p, 1]:g}"
        for p, w in _tyres(model).items()
    ]
    return Suspect("tyres of different grip", f"{_join(where)}: the robot has one coefficient", repair)


def _soft(model: mujoco.MjModel, robot: Robot) -> Suspect | None:
    pairs = list(_tyres(model))
    contact, slip = model.pair_solref[pairs, 0].max(), _slip_times(model, pairs).max()
    odd = []
    if contact > 0.011:
        odd.append(f"solref {contact:g} s lets the tyres sink in")
    if slip > 0.0051:
        odd.append(f"solreffriction {slip:g} s lets them drift outwards by V·θ̇ times half of that")
    if model.opt.cone != mujoco.mjtCone.mjCONE_ELLIPTIC:
        odd.append("the friction cone is a pyramid")
    if model.opt.impratio < 10:
        odd.append(f"impratio {model.opt.impratio:g} lets them creep under load")
    if not odd:
        return None

    def repair(m: mujoco.MjModel) -> None:
        h = 2 * m.opt.timestep
        m.pair_solref[pairs] = max(0.01, h), 1
        m.pair_solreffriction[pairs] = max(0.004, h), 1
        m.opt.cone, m.opt.impratio = mujoco.mjtCone.mjCONE_ELLIPTIC, max(10, m.opt.impratio)

    text = f"{_join(odd)}; take solref 0.01, solreffriction 0.004, an elliptic cone and impratio 10"
    return Suspect("soft contacts", text, repair)


def _slip_times(model: mujoco.MjModel, pairs: list[int]) -> NDArray[np.float64]:
    """Time constants with which contacts damp slip, in s; 0 in solreffriction stands for that of solref."""
    own = model.pair_solreffriction[pairs, 0]
    return np.where(own > 0, own, model.pair_solref[pairs, 0])


def _step(model: mujoco.MjModel, robot: Robot) -> Suspect | None:
    pairs, h = list(_tyres(model)), model.opt.timestep
    shortest = min(model.pair_solref[pairs, 0].min(), _slip_times(model, pairs).min())
    if not 0 < shortest < 2 * h * (1 - 1e-9):
        return None

    def repair(m: mujoco.MjModel) -> None:
        m.opt.timestep = shortest / 2

    text = f"contacts of {1e3 * shortest:g} ms need steps of half of that, and get {1e3 * h:g} ms, which softens them"
    return Suspect("time step too long", f"{text}; shorten the step", repair)


# Steering


def _fork(model: mujoco.MjModel, robot: Robot) -> Suspect | None:
    if not steered(model) or (axis := _axle(model, "steering"))[2] > 0.99999:
        return None

    def repair(m: mujoco.MjModel) -> None:
        m.joint("steering").axis[:] = 0, 0, 1

    return Suspect(
        "steering axis", f"the fork turns about {_vector(axis)}; left is a positive turn about z, (0, 0, 1)", repair
    )


def _servo(model: mujoco.MjModel, robot: Robot) -> Suspect | None:
    if steerings(model) != ("rigid",):
        return None  # other arrangements have stiffness of their own
    stiffness = -model.actuator("steering").biasprm[1]
    torque = robot.trail * robot.tyre_friction * robot.front_load * robot.mass * GRAVITY
    if torque <= 0.05 * stiffness:
        return None

    def repair(m: mujoco.MjModel) -> None:
        servo = m.actuator("steering")
        for k, power in ((1, 1.0), (2, 0.5)):
            for gains in (servo.gainprm, servo.biasprm):
                gains[k] *= (300 * torque / stiffness) ** power

    text = (
        f"{stiffness:g} N·m/rad against the {torque:.2g} N·m with which the tyre, trailing its axis, can turn the fork:"
    )
    return Suspect("soft steering servo", f"{text} raise kp", repair)


def _degrees(model: mujoco.MjModel, robot: Robot) -> Suspect | None:
    limit = robot.steering_limit
    if limit >= 0.1 or not steered(model):
        return None

    def repair(m: mujoco.MjModel) -> None:
        m.joint("steering").range[:] *= 180 / np.pi

    text = (
        f"the fork turns by {limit:.3g} rad at most, which is {np.degrees(limit):.3g}°: MJCF counts in degrees unless"
    )
    return Suspect("angles in degrees", f'{text} <compiler angle="radian"/> says otherwise', repair)


INSPECTIONS = (
    _shape, _centre, _direction, _place, _heights, _radii,
    _motors_differ, _armature, _constant, _gear, _drag, _losses_differ, _creep,
    _balance, _wheel_inertia, _gravity,
    _missing, _strangers, _condim, _grip, _step, _soft,
    _fork, _servo, _degrees,
)  # fmt: skip


def _join(words: list[str]) -> str:
    return ", ".join(words)


def _vector(values: NDArray) -> str:
    return f"({', '.join(f'{value:.4g}' for value in values)})"


def _geom(model: mujoco.MjModel, geom: int) -> str:
    return model.geom(geom).name or f"a geom of {model.body(model.geom_bodyid[geom]).name or 'the world'}"
