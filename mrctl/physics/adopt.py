"""Brings the robot of any MJCF file with two driven wheels into a world, under the names of `mrctl.physics.elements`.

The robot of the world is replaced; both files stay as they are. In the compiled model P is the origin of the body
`chassis`, with x ahead and z up, and the driven wheels turn forwards under positive voltage. The wheels touch the floor
with spheres of their own radius, because cylinders scrub on their edges. A caster that does not roll is frictionless,
because a contact that slides hops. No other geom of the robot collides.
"""

# pyright: reportAttributeAccessIssue=false
# (mujoco is compiled and ships no stubs)

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np

from mrctl.kernel import Array
from mrctl.physics.bounds import compiling
from mrctl.physics.elements import FRONTS, MOTORS, NUMERICS, PREFIX, REAR, RIGID, UNPAIRED, bottom, has, part, vertices
from mrctl.physics.files import robot_path
from mrctl.record import InputError
from mrctl.theory.kinematics import UP
from mrctl.theory.robot import RobotFile

# share of the wheel radius: a caster this near to the floor touches it, and two this close are one
FLOOR_TOLERANCE = 0.1
HINGE = mujoco.mjtJoint.mjJNT_HINGE
ROUND = int(mujoco.mjtGeom.mjGEOM_CYLINDER), int(mujoco.mjtGeom.mjGEOM_CAPSULE)  # shapes with an axis, their z axis
DCMOTOR = '<dcmotor joint="{}" gear="N" motorconst="k k" resistance="R" armature="J" ctrlrange="-U U"/>'


class Wheel(NamedTuple):
    """A wheel or caster of the robot's file."""

    body: str
    """Name of its body."""
    joint: str
    """Name of the joint on which it rolls; empty for a caster that slides."""
    centre: Array
    """Its centre in the file's world in m, `(3,)`."""
    radius: float
    """Height of the centre above the floor in m."""
    friction: float
    """Coulomb coefficient of its geom."""


def adopted(robot: RobotFile, world: Path) -> mujoco.MjSpec:
    """Returns a world in which the robot of another file replaces the world's own.

    Args:
        robot: The robot's file, and the names of those parts that are ambiguous in it.
        world: Path of the world's MJCF file.

    Raises:
        InputError: A file is no MJCF, or a part of the robot is missing, ambiguous or impossible.
    """
    path = robot_path(robot)
    with compiling(path, world):
        return _Adoption(robot, path).into(world)


class _Adoption:
    """A robot's MJCF file, the parts that were identified in it, and the changes that bring it into a world.

    Left and right are those of the robot as it drives ahead.
    """

    def __init__(self, robot: RobotFile, path: Path) -> None:
        self.spec = mujoco.MjSpec.from_file(str(path))
        for kind, elements in (("body", self.spec.bodies), ("joint", self.spec.joints)):
            for k, element in enumerate(elements):  # looked up by name below
                element.name = element.name or f"{kind}_{k}"
        self.model = self.spec.compile()
        self.data = mujoco.MjData(self.model)
        mujoco.mj_kinematics(self.model, self.data)
        wheels = self._driven(robot.wheels)
        found = [self._wheel(name) for name in wheels]
        self.radius = float(np.mean([wheel.radius for wheel in found]))
        self.floor = float(np.mean([wheel.centre[2] - wheel.radius for wheel in found]))
        steered = self._steered(robot.steering)
        self.chassis = self._carrier(robot.chassis, wheels)
        self.ahead, self.left = self._directions(wheels, steered)
        places = {name: self._on_axle(name) for name in wheels}
        between = places[wheels[1]] - places[wheels[0]]
        if abs(between @ self.left) <= 0.5 * np.linalg.norm(between):
            raise InputError(
                f"wheels: the axes of the joints {_listed(wheels)} must point along the line through the two wheels"
            )
        self.origin = np.mean([*places.values()], axis=0)
        self.wheels = sorted(wheels, key=lambda name: -float((places[name] - self.origin) @ self.left))
        self.steered = sorted(steered, key=self._side)
        self.rear = [self._wheel(name) for name in self.wheels]
        self.motors = [self._motor(name) for name in self.wheels]
        self.front = [self._steered_wheel(name) for name in self.steered] or self._casters()
        for name, wheel in zip(self.steered, self.front, strict=False):
            if wheel.joint in self.wheels:
                raise InputError(f"wheels: the driven wheel {wheel.joint!r} is steered by {name!r}; it must not be")
            if self._lineage(name)[0] == wheel.body:
                raise InputError(
                    f"steering: the joints {_listed([name, wheel.joint])} are on one body; give the wheel a body of "
                    "its own inside the one that is steered"
                )

    # -- identification of the parts -----------------------------------------------------------------------------------

    def _driven(self, names: Sequence[str]) -> list[str]:
        """Returns the joints of the two driven wheels: those named, or those with a `<dcmotor>`."""
        joints = list(names) or [
            a.target for a in self.spec.actuators if a.gaintype == mujoco.mjtGain.mjGAIN_DCMOTOR and self._is_hinge(a)
        ]
        if len(joints) != 2 or len(set(joints)) != 2:
            level = [j for j in self._hinges() if abs(self._axis(j)[2]) < 0.5]
            raise InputError(
                f"wheels: {len(joints)} joints, {_listed(joints)}, not two with a <dcmotor>; name those of the wheels, "
                f"of {_listed(level)}, and give each {DCMOTOR.format('JOINT')}"
            )
        return [self._hinge(name, "wheels") for name in joints]

    def _steered(self, names: Sequence[str]) -> list[str]:
        """Returns the joints of the steered wheels, at most two: those named, or the upright ones that are moved.

        A joint is moved by an actuator of its own, or by an equality that couples it to a joint with an actuator. Where
        nothing that it carries reaches the floor, as with a camera that pans, it steers nothing.
        """
        moved = {a.target for a in self.spec.actuators if self._is_hinge(a)}
        couplings = [{e.name1, e.name2} for e in self.spec.equalities if e.type == mujoco.mjtEq.mjEQ_JOINT]
        moved = moved.union(*(coupling for coupling in couplings if coupling & moved))
        upright = [
            name for name in self._hinges()
            if abs(self._axis(name)[2]) > 0.9 and name in moved and self._low(self._lineage(name)[0])
        ]  # fmt: skip
        joints = list(names) or upright
        if len(joints) > 2 or len(set(joints)) < len(joints):
            raise InputError(f"steering: {_listed(joints)}; name one or two upright joints with an actuator")
        for name in joints:
            if abs(self._axis(self._hinge(name, "steering"))[2]) < 0.5:
                raise InputError(f"steering: the joint {name!r} is not upright; {_listed(upright)} could be steered")
        return joints

    def _carrier(self, name: str, wheels: Sequence[str]) -> str:
        """Returns the body that carries both wheels: the one named, or their root."""
        bodies = [body.name for body in self.spec.bodies]
        if name and name not in bodies:
            raise InputError(f"chassis: no body {name!r}; the file has {_listed(bodies[1:])}")
        roots = {self._lineage(joint)[-1] for joint in wheels}
        chassis = name or roots.pop()
        if any(chassis not in self._lineage(joint) for joint in wheels):
            raise InputError(f"chassis: the body {chassis!r} does not carry both wheels, {_listed(wheels)}")
        lines = [self._lineage(joint)[1:] for joint in wheels]
        carrier = next((body for body in lines[0] if body in lines[1]), chassis)
        for body in self._ancestry(self.model.body(carrier).id):
            if body == chassis:
                break
            for j in range(self.model.njnt):
                kind, upright = self.model.jnt_type[j], abs(self.data.xaxis[j][2]) > 0.5
                if self.model.jnt_bodyid[j] == self.model.body(body).id and upright == (kind == HINGE):
                    raise InputError(
                        f"chassis: the joint {self.model.joint(j).name!r} moves the wheels in the plane beneath "
                        f"{chassis!r}; name the body that carries them, such as {carrier!r}"
                    )
        if chassis in (self._lineage(joint)[0] for joint in wheels):
            raise InputError(f"chassis: the body {chassis!r} is itself moved by one of {_listed(wheels)}")
        return chassis

    def _directions(self, wheels: Sequence[str], steered: Sequence[str]) -> tuple[Array, Array]:
        """Returns the level unit vectors ahead and to the left in the file's world, `(3,)` each.

        Ahead is the side of the steered wheels, or that of the chassis' x axis where nothing is steered.
        """
        axle = self._axis(wheels[0])
        if abs(axle @ self._axis(wheels[1])) < 0.99 or abs(axle[2]) > 0.1:
            raise InputError(f"wheels: the axes of {_listed(wheels)} are not one level axle")
        ahead = np.cross(axle, UP) / np.linalg.norm(np.cross(axle, UP))
        if steered:
            anchors = [np.mean([self.data.joint(n).xanchor for n in names], axis=0) for names in (steered, wheels)]
            front = anchors[0] - anchors[1]
        else:
            front = self.data.body(self.chassis).xmat.reshape(3, 3)[:, 0]
        if front @ ahead < -1e-6:
            ahead = -ahead
        return ahead, np.cross(UP, ahead)

    def _wheel(self, joint: str) -> Wheel:
        """Describes a wheel, whose radius and friction are those of the lowest geom of its body.

        Geoms that collide are preferred to those that do not.
        """
        body = self._lineage(joint)[0]
        geoms = [g for g in range(self.model.ngeom) if self.model.geom_bodyid[g] == self.model.body(body).id]
        if not geoms:
            raise InputError(f"wheels: body {body!r} of joint {joint!r} has no geom to roll on")
        lowest = min(self._colliding(geoms) or geoms, key=self._bottom)
        if self.model.geom_type[lowest] in ROUND and abs(self.data.geom_xmat[lowest][8]) > 0.9:
            raise InputError(
                f"wheels: {part(self.model, lowest)}, the wheel of joint {joint!r}, lies flat, with its axis upright; "
                "turn it, for example by euler"
            )
        return self._contact(lowest, body, joint)

    def _on_axle(self, joint: str) -> Array:
        """Returns the place on a wheel's axle that is nearest to its centre, in the file's world in m, `(3,)`."""
        anchor, axis = self.data.joint(joint).xanchor, self._axis(joint)
        return anchor + axis * ((self._wheel(joint).centre - anchor) @ axis)

    def _colliding(self, geoms: Iterable[int]) -> list[int]:
        """Returns those of some geoms that collide with anything."""
        return [g for g in geoms if self.model.geom_contype[g] or self.model.geom_conaffinity[g]]

    def _steered_wheel(self, steering: str) -> Wheel:
        """Describes the wheel that rolls below a steered joint."""
        fork = self._lineage(steering)[0]
        rolling = [
            name for name in self._hinges() if fork in self._lineage(name) and abs(self._axis(name) @ self.left) > 0.9
        ]
        if len(rolling) != 1:
            raise InputError(f"steering: joint {steering!r} carries {len(rolling)} rolling joints, not one")
        return self._wheel(rolling[0])

    def _casters(self) -> list[Wheel]:
        """Describes the one or two casters: geoms beside the wheels that reach the floor.

        Geoms that collide are preferred to those that do not, and geoms at the same place count as one.
        """
        wheels = {wheel.body for wheel in self.rear}
        low = [g for g in self._low(self.chassis) if not wheels & set(self._ancestry(self.model.geom_bodyid[g]))]
        casters: list[Wheel] = []
        names: list[str] = []
        for g in self._colliding(low) or low:
            body = self.model.body(self.model.geom_bodyid[g])
            centre = self.data.geom_xpos[g]
            if all(np.hypot(*(centre - other.centre)[:2]) > FLOOR_TOLERANCE * self.radius for other in casters):
                caster, radius = self._contact(g, body.name, self._roller(body.name)), centre[2] - self.floor
                if radius <= 0:
                    depth = self.floor - self._bottom(g)
                    raise InputError(
                        f"caster: {part(self.model, g)} ends {1e3 * depth:.4g} mm below the floor of the wheels, and "
                        "its centre is not above it; correct its height, or that of the wheels"
                    )
                self._refuse_wheel_that_nothing_turns(caster)
                casters.append(caster._replace(radius=radius))  # so that it touches the wheels' floor
                names.append(part(self.model, g))
        if not casters:
            track = np.linalg.norm(self.rear[0].centre - self.rear[1].centre)
            unit = f"; their radius is {self.radius:.4g} m: is it in mm or cm?" if self.radius > track else ""
            raise InputError(
                "caster: beside the driven wheels nothing reaches the floor, and nothing is steered"
                + (unit or self._gaps())
            )
        distances = [(caster.centre - self.origin) @ self.ahead for caster in casters]
        if len(casters) > 2 or min(distances) * max(distances) < 0:
            raise InputError(
                f"caster: at most two, both ahead of the axle or both behind, not {_listed(names)}; keep those on the "
                'side of the load, and give the others contype="0" conaffinity="0", as models/turtlebot.xml does'
            )
        return sorted(casters, key=lambda caster: -(caster.centre @ self.left))

    def _refuse_wheel_that_nothing_turns(self, caster: Wheel) -> None:
        """Refuses a wheel on a fixed axle, or on an upright joint that has neither a servo nor a trail."""
        line = self._ancestry(self.model.body(caster.body).id)
        swivels = [name for name in self._hinges() if abs(self._axis(name)[2]) > 0.9 and self._lineage(name)[0] in line]
        if caster.joint in self._hinges() and not any(self.chassis in self._lineage(name)[1:] for name in swivels):
            raise InputError(
                f"caster: the wheel of joint {caster.joint!r} rolls on a fixed axle, and would slide aside in a turn; "
                "give it an upright joint with a trail, a ball joint in place of its own, or no joint"
            )
        for name in self._hinges() if caster.joint in self._hinges() else ():
            carried = self._lineage(name)[0] in self._ancestry(self.model.body(caster.body).id)
            trail = np.hypot(*(caster.centre - self.data.joint(name).xanchor)[:2])
            if carried and abs(self._axis(name)[2]) > 0.9 and trail < FLOOR_TOLERANCE * caster.radius:
                raise InputError(
                    f"steering: the joint {name!r} has no actuator, and its wheel no trail, which a caster needs; "
                    f'if it is steered, add <position joint="{name}" kp="K" kv="D"/>'
                )

    def _gaps(self) -> str:
        """Returns a clause on how far above the floor of the driven wheels the lowest other part ends."""
        wheels = {wheel.body for wheel in self.rear}
        others = [
            g for g in range(self.model.ngeom)
            if self.chassis in (line := self._ancestry(self.model.geom_bodyid[g])) and not wheels & set(line)
        ]  # fmt: skip
        lowest = min(others, key=self._bottom, default=None)
        if lowest is None or not np.isfinite(gap := self._bottom(lowest) - self.floor):
            return ""
        text = f"; {part(self.model, lowest)} ends {1e3 * gap:.4g} mm above the floor of the wheels"
        left, right = (wheel.centre[2] - wheel.radius for wheel in self.rear)
        if abs(left - right) > 1e-6:
            lower = self.wheels[int(right < left)]
            text += f", of which that of joint {lower!r} is {1e3 * abs(left - right):.4g} mm lower than the other"
        return text

    def _low(self, body: str) -> list[int]:
        """Returns the geoms that a body carries and that reach the floor of the driven wheels."""
        return [
            g for g in range(self.model.ngeom)
            if body in self._ancestry(self.model.geom_bodyid[g])
            and self._bottom(g) - self.floor < FLOOR_TOLERANCE * self.radius
        ]  # fmt: skip

    def _roller(self, body: str) -> str:
        """Returns the joint on which a caster's body rolls, a ball or a level hinge; empty where it slides."""
        joints = [j for j in range(self.model.njnt) if self.model.jnt_bodyid[j] == self.model.body(body).id]
        if body == self.chassis or len(joints) != 1:
            return ""
        kind, level = self.model.jnt_type[joints[0]], abs(self.data.xaxis[joints[0]][2]) < 0.1
        ball = kind == mujoco.mjtJoint.mjJNT_BALL
        return self.model.joint(joints[0]).name if ball or (kind == HINGE and level) else ""

    def _contact(self, geom: int, body: str, joint: str) -> Wheel:
        """Describes a wheel by one of its geoms; the radius is the height of its centre above its lowest point.

        MuJoCo puts the centre of a mesh into its centroid. A mesh on a hinge is centred on the axle instead, and its
        radius is the largest distance of a vertex from it.
        """
        centre = self.data.geom_xpos[geom].copy()
        if self.model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH and joint in self._hinges():
            anchor, axis = self.data.joint(joint).xanchor, self._axis(joint)
            away = centre + vertices(self.model, geom) @ self.data.geom_xmat[geom].reshape(3, 3).T - anchor
            centre = anchor + axis * ((centre - anchor) @ axis)
            radius = float(np.linalg.norm(away - np.outer(away @ axis, axis), axis=1).max())
            return Wheel(body, joint, centre, radius, float(self.model.geom_friction[geom, 0]))
        return Wheel(body, joint, centre, centre[2] - self._bottom(geom), float(self.model.geom_friction[geom, 0]))

    def _motor(self, joint: str) -> str:
        """Returns the name of the one `<dcmotor>` that drives a wheel."""
        actuators = [a for a in self.spec.actuators if self._is_hinge(a) and a.target == joint]
        if len(actuators) != 1 or actuators[0].gaintype != mujoco.mjtGain.mjGAIN_DCMOTOR:
            names = _listed([a.name or "an actuator" for a in actuators])
            drive = f"is driven by {names}, not by one <dcmotor>" if actuators else "has no actuator"
            raise InputError(f"motor: wheel {joint!r} {drive}; mrctl commands volts: {DCMOTOR.format(joint)}")
        motor = actuators[0]
        motor.name = motor.name or f"motor of {joint}"
        index = motor.id
        resistance, constant = self.model.actuator_gainprm[index, :2]
        supply = self.model.actuator_ctrlrange[self.model.actuator_ctrladr[index], 1]
        for name, value in (("resistance", resistance), ("motorconst", constant), ("ctrlrange", supply)):
            if not value > 0:
                raise InputError(f"motor: {motor.name!r} has no {name}: {DCMOTOR.format(joint)}")
        return motor.name

    def _is_hinge(self, actuator: Any) -> bool:  # noqa: ANN401
        """Tells whether an actuator moves a hinge joint with a name."""
        return actuator.trntype == mujoco.mjtTrn.mjTRN_JOINT and actuator.target in self._hinges()

    def _hinges(self) -> list[str]:
        """Names all hinge joints of the file."""
        joints = (self.model.joint(j) for j in range(self.model.njnt))
        return [joint.name for joint in joints if joint.type[0] == HINGE]

    def _hinge(self, name: str, field: str) -> str:
        """Returns the name of a hinge joint, or refuses the field that holds it."""
        if name not in self._hinges():
            raise InputError(f"{field}: no hinge joint {name!r}; the file has {_listed(self._hinges())}")
        return name

    def _axis(self, joint: str) -> Array:
        """Returns the axis of a hinge in the file's world, a unit vector `(3,)`."""
        return self.data.joint(joint).xaxis

    def _side(self, joint: str) -> float:
        """Returns the distance of a joint to the right of P in m, a key that sorts joints from left to right."""
        return -float((self.data.joint(joint).xanchor - self.origin) @ self.left)

    def _ancestry(self, body: int) -> list[str]:
        """Names a body and those that carry it, up to the root."""
        line = []
        while body:
            line.append(self.model.body(body).name)
            body = self.model.body_parentid[body]
        return line

    def _lineage(self, joint: str) -> list[str]:
        """Names the body of a joint and those that carry it, up to the root."""
        return self._ancestry(self.model.joint(joint).bodyid[0])

    def _bottom(self, geom: int) -> float:
        """Returns the height of the lowest point of a geom in m; infinite for one that cannot be a wheel."""
        return bottom(self.model, self.data, geom)

    # -- changes -------------------------------------------------------------------------------------------------------

    def into(self, world: Path) -> mujoco.MjSpec:
        """Returns a world in which this robot replaces the world's own, ready to compile."""
        with compiling(world):
            spec = mujoco.MjSpec.from_file(str(world))
        if (own := spec.body("chassis")) is None:
            raise InputError(f"world: {world} has no body 'chassis' that another robot could replace")
        pairs = [p for p in spec.pairs if "wheel_left" in (p.geomname1, p.geomname2)]
        if not pairs:
            raise InputError(f"{world}: {UNPAIRED}")
        floors = [
            (p.geomname2 if p.geomname1 == "wheel_left" else p.geomname1, p.name, np.array(p.friction)) for p in pairs
        ]
        solver = {n: np.array(getattr(pairs[0], n)) for n in ("solref", "solreffriction", "solimp")}
        ordinary = min(pairs, key=lambda p: p.name != "tyre_left").friction[0]  # the first where none has this name
        spec.delete(own)
        for numeric in list(spec.numerics):
            spec.delete(numeric)
        self._strip()
        self._align()
        names = self._renamed()
        spec.worldbody.add_frame().attach_body(self.spec.body(self.chassis), PREFIX, "")
        for kind, old, new in names:
            element = getattr(spec, kind)(PREFIX + old)
            element.name = new
            if kind == "body":
                for looking in (*spec.cameras, *spec.lights):
                    if looking.targetbody == PREFIX + old:
                        looking.targetbody = new
        for motor, wheel in zip(MOTORS, REAR, strict=True):
            spec.actuator(motor).target = wheel
        spec.body("chassis").add_freejoint(name="chassis")
        if self.steered:
            self._add_steering(spec)
        # A tyre has its file's friction on the ordinary floor, and proportionally less on a slippery one.
        for geom, wheel in (*zip(REAR, self.rear, strict=True), *zip(self._front_names(), self.front, strict=True)):
            for floor, name, friction in floors:
                mu = wheel.friction * friction[0] / ordinary
                pair = spec.add_pair(geomname1=floor, geomname2=geom, condim=3 if wheel.joint else 1, **solver)
                pair.friction[:] = mu, mu, *friction[2:]
                pair.name = name.replace("left", geom.removeprefix("wheel_")) if name else ""
        self._add_numbers(spec)
        flags = mujoco.mjtDisableBit
        spec.option.disableflags &= ~int(flags.mjDSBL_EQUALITY | flags.mjDSBL_SPRING)
        if not spec.equalities:
            spec.option.disableflags |= int(flags.mjDSBL_EQUALITY)
        return spec

    def _strip(self) -> None:
        """Removes what the robot does not need: sensors, key frames, contacts, and its own steering actuators.

        Couplings of steered or driven wheels go too, as the linkage and the floor replace them.
        """
        spec = self.spec
        renamed = {old for kind, old, _ in self._renamed() if kind == "body"}
        for e in spec.equalities:  # whose anchors are in the frames of bodies, which change
            if e.objtype == mujoco.mjtObj.mjOBJ_BODY and (joined := renamed & {e.name1, e.name2}):
                raise InputError(
                    f"equality: joins the body {min(joined)!r}, which mrctl moves; give it site1 and site2 instead"
                )
            if e.type == mujoco.mjtEq.mjEQ_JOINT and {e.name1, e.name2} == {*self.wheels}:
                raise InputError(
                    f"equality: couples {_listed(self.wheels)}; mrctl drives the wheels apart from each other, with "
                    "different speeds in a turn, so take it out"
                )
        self._strip_tendons()
        steering = [a for a in spec.actuators if a.target in self.steered]
        coupled = [e for e in spec.equalities if {e.name1, e.name2} & {*self.steered, *self.wheels}]
        for element in [*spec.sensors, *spec.keys, *spec.pairs, *spec.excludes, *steering, *coupled]:
            spec.delete(element)
        compiler = spec.compiler  # whose settings the world's compiler does not have; geoms change their groups below
        every_group = [*compiler.inertiagrouprange] == [0, mujoco.mjNGROUP - 1]
        if compiler.inertiafromgeom != 2 or compiler.settotalmass > 0 or not every_group:
            for body in spec.bodies[1:]:
                self._state_inertia(body)
        compiler.inertiafromgeom = 2  # auto: keeps the explicit inertials, such as that of the moved chassis
        for geom in spec.geoms:
            geom.contype = geom.conaffinity = 0
            geom.group = geom.group or 1  # rays that look for the ground see only group 0

    def _strip_tendons(self) -> None:
        """Removes tendons over driven or steered wheels that do nothing, and refuses those that move the wheels.

        MuJoCo's own sample car has two, over which it drives its wheels, and which do nothing once the wheels have
        motors of their own.
        """
        model, spec = self.model, self.spec
        wheels = {model.joint(name).id: name for name in (*self.steered, *self.wheels)}
        for index, tendon in enumerate(list(spec.tendons)):
            wraps = slice(model.tendon_adr[index], model.tendon_adr[index] + model.tendon_num[index])
            on_joints = model.wrap_type[wraps] == mujoco.mjtWrap.mjWRAP_JOINT
            over = [wheels[joint] for joint in model.wrap_objid[wraps][on_joints] if joint in wheels]
            if not over:
                continue
            pulled = {a.target for a in spec.actuators if a.trntype == mujoco.mjtTrn.mjTRN_TENDON}
            held = {n for e in spec.equalities if e.type == mujoco.mjtEq.mjEQ_TENDON for n in (e.name1, e.name2)} - {""}
            fields = ("stiffness", "damping", "frictionloss", "armature", "limited", "actfrclimited")
            if tendon.name in pulled | held or any(getattr(model, f"tendon_{field}")[index].any() for field in fields):
                raise InputError(
                    f"tendon: {tendon.name!r} moves {_listed(over)}; mrctl drives each wheel by a <dcmotor> of its "
                    "own, so take the tendon out"
                )
            spec.delete(tendon)

    def _align(self) -> None:
        """Moves the chassis' frame to P, with x ahead and z up.

        Wheels then turn forwards, and a fork turns to the left, in the positive direction of their joints, a fork from
        straight on.
        """
        chassis, model = self.spec.body(self.chassis), self.model
        for name in (*self.wheels, *self.steered, *(w.joint for w in self.front if w.joint)):
            joint = self.spec.joint(name)
            if joint.type == HINGE and self._axis(name) @ (UP if name in self.steered else self.left) < 0:
                joint.axis = -np.array(joint.axis)
                joint.range = -np.array(joint.range)[::-1]
                joint.ref, joint.springref = -joint.ref, -joint.springref
        for joint in map(self.spec.joint, self.steered):  # straight on is 0, also where the file counts from elsewhere
            joint.range = np.array(joint.range) - joint.ref
            joint.ref, joint.springref = 0.0, joint.springref - joint.ref
        for name in self.motors:
            motor = self.spec.actuator(name)
            motor.gear = np.abs(motor.gear)
        rotation = self._rotation()
        body, data = model.body(self.chassis), self.data.body(self.chassis)
        shift = rotation @ (data.xpos - self.origin)  # origin of the old frame in the new one
        turned = rotation @ data.xmat.reshape(3, 3)
        quat = np.zeros(4)
        mujoco.mju_mat2Quat(quat, turned.ravel())
        for name, wheel in (*zip(REAR, self.rear, strict=True), *zip(self._front_names(), self.front, strict=True)):
            self._add_contact(name, wheel)
        if np.any(np.abs(shift) > 1e-12) or np.any(np.abs(turned - np.eye(3)) > 1e-12):
            frame = chassis.add_frame(pos=shift, quat=quat)
            for element in (*chassis.bodies, *chassis.geoms, *chassis.sites, *chassis.cameras, *chassis.lights):
                if element.frame is None:
                    element.set_frame(frame)
            for other in chassis.frames:
                if other.frame is None and other != frame:
                    other.set_frame(frame)
            self._state_inertia(chassis)
            inertial = np.zeros(4)
            mujoco.mju_mulQuat(inertial, quat, body.iquat)
            chassis.ipos, chassis.iquat = shift + turned @ body.ipos, inertial
        chassis.pos, chassis.quat = (0.0, 0.0, self.radius), (1.0, 0.0, 0.0, 0.0)
        chassis.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
        for joint in list(chassis.joints):
            self.spec.delete(joint)

    def _state_inertia(self, body: Any) -> None:  # noqa: ANN401
        """Writes the mass and the inertia that a body of the file has after compilation into the body itself."""
        own = self.model.body(body.name)
        body.mass, body.ipos, body.iquat, body.inertia = own.mass[0], own.ipos, own.iquat, own.inertia
        body.ialt.type, body.fullinertia[0] = mujoco.mjtOrientation.mjORIENTATION_QUAT, np.nan
        body.explicitinertial = True

    def _rotation(self) -> Array:
        """Returns the rotation from the file's world to the chassis' new frame, `(3, 3)`."""
        return np.stack([self.ahead, self.left, UP])

    def _add_contact(self, name: str, wheel: Wheel) -> None:
        """Adds the sphere with which a wheel touches the floor."""
        body = self.data.body(wheel.body)
        position = body.xmat.reshape(3, 3).T @ (wheel.centre - body.xpos)
        self.spec.body(wheel.body).add_geom(
            name=f"contact {name}", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[wheel.radius, 0, 0], pos=position, mass=0,
            contype=0, conaffinity=0, group=3, rgba=[1, 0.5, 0, 0.3],
        )  # fmt: skip

    def _front_names(self) -> tuple[str, ...]:
        """Returns the names, of `FRONTS`, that the steered wheels or casters get."""
        if self.steered:
            return FRONTS[:1] if len(self.steered) == 1 else FRONTS[1:3]
        return FRONTS[3 : 3 + len(self.front)]

    def _renamed(self) -> Iterable[tuple[str, str, str]]:
        """Yields kind, old name and new name of each element that is renamed."""
        yield "body", self.chassis, "chassis"
        if has(self.model, "site", "imu") and self.model.site("imu").bodyid[0] == self.model.body(self.chassis).id:
            yield "site", "imu", "imu"
        wheels = (*zip(REAR, self.rear, strict=True), *zip(self._front_names(), self.front, strict=True))
        for name, wheel in wheels:
            yield "geom", f"contact {name}", name
            if wheel.joint:
                yield "joint", wheel.joint, name
                yield "body", wheel.body, name
        for name, motor in zip(MOTORS, self.motors, strict=True):
            yield "actuator", motor, name
        if len(self.steered) == 1:
            yield "joint", self.steered[0], "steering"
            yield "body", self._lineage(self.steered[0])[0], "fork"
        for joint, name in zip(self.steered, FRONTS[1:3] if len(self.steered) == 2 else (), strict=False):
            yield "joint", joint, f"steering_{name}"

    def _add_steering(self, spec: mujoco.MjSpec) -> None:
        """Adds a servo with set-points of angle and rate, and the linkage of two steered wheels."""
        servos = [k for k in range(len(self.model.actuator_trntype)) if self._turns_steering(k)]
        gears = self.model.actuator_gear[:, 0]
        kp, kv = (sum(-self.model.actuator_biasprm[k, i] * gears[k] ** 2 for k in servos) for i in (1, 2))
        if not kp > 0:
            raise InputError(f"steering: {_listed(self.steered)} needs a <position> or <pid> actuator with a kp")
        filters = int(mujoco.mjtDyn.mjDYN_FILTER), int(mujoco.mjtDyn.mjDYN_FILTEREXACT)
        if any(self.model.actuator_dyntype[k] in filters for k in servos):
            raise InputError(
                f"steering: the servo of {_listed(self.steered)} has a timeconst, which mrctl leaves out; leave it out"
            )
        joints = [self.model.joint(name) for name in self.steered]
        limit = float(min(np.min((j.qpos0 - j.range[0], j.range[1] - j.qpos0)) for j in joints))
        if not 0 < limit < np.pi / 2:
            raise InputError(f"steering: {_listed(self.steered)} needs a range below 90° on either side of straight on")
        anchors = [self._rotation() @ (self.data.joint(name).xanchor - self.origin) for name in self.steered]
        unit = 180 / np.pi if self.spec.compiler.degree else 1.0  # in which the file gives the range of its own joint
        if len(anchors) == 2:
            limit, unit = self._add_linkage(spec, anchors, limit, kv), 1.0
        joint = spec.joint("steering")
        joint.limited = 1
        joint.range = np.array([-limit, limit]) * unit
        servo = spec.add_actuator(name="steering", target="steering", trntype=mujoco.mjtTrn.mjTRN_JOINT)
        servo.set_to_pid(kp=kp, kv=kv)
        if self.model.actuator_forcelimited[servos].all():
            torques = np.abs(gears[servos, None] * self.model.actuator_forcerange[servos]).min(axis=1)
            servo.forcelimited, servo.forcerange = 1, torques.sum() * np.array([-1.0, 1.0])
        spec.add_text(name=RIGID, data="the wheels go where the servo says")

    def _add_linkage(self, spec: mujoco.MjSpec, anchors: Sequence[Array], limit: float, kv: float) -> float:
        """Adds a rack, with the joint `steering`, that turns two wheels; returns its limit in rad.

        Ackermann's geometry turns a wheel at y to the left by atan(L tan φ/(L − y tan φ)), where φ is the steering
        angle of the middle of the front axle and L the wheelbase.

        Args:
            spec: The world.
            anchors: Places of the axes of the wheels in the frame of the chassis in m, `(3,)` each.
            limit: Limit of the wheels in rad.
            kv: Gain of the servo on the rate in N·m·s/rad.
        """
        length, track = float(np.mean([a[0] for a in anchors])), float(anchors[0][1] - anchors[1][1])
        limit = float(np.arctan(length / (length / np.tan(limit) + track / 2)))
        inertia = sum(self.model.dof_M0[self.model.joint(name).dofadr[0]] for name in self.steered)
        fork = spec.body("chassis").add_body(name="fork", pos=(length, 0.0, float(np.mean([a[2] for a in anchors]))))
        fork.mass, fork.inertia, fork.explicitinertial = 1e-6, np.full(3, 1e-9), True
        # The rack has the inertia of the wheels that it turns. The second term keeps its time constant J/k_v above
        # the 2 ms of the default physics step.
        fork.add_joint(name="steering", type=HINGE, axis=UP, armature=inertia + 0.002 * kv)
        for name, anchor in zip(FRONTS[1:3], anchors, strict=True):
            phi = np.linspace(-limit, limit, 201)
            angle = np.arctan(length * np.tan(phi) / (length - anchor[1] * np.tan(phi)))
            powers = np.linalg.lstsq(phi[:, None] ** np.arange(1, 5), angle, rcond=None)[0]
            linkage = spec.add_equality(name=f"steering_{name}", type=mujoco.mjtEq.mjEQ_JOINT)
            linkage.objtype = mujoco.mjtObj.mjOBJ_JOINT
            linkage.name1, linkage.name2 = f"steering_{name}", "steering"
            linkage.data[:5] = 0.0, *powers
            linkage.solref[:] = 0.01, 1.0
            spec.joint(f"steering_{name}").limited = 0  # the rack has the stops
        return limit

    def _turns_steering(self, actuator: int) -> bool:
        """Tells whether an actuator moves a steered joint."""
        joints = [self.model.joint(name).id for name in self.steered]
        on_joint = self.model.actuator_trntype[actuator] == mujoco.mjtTrn.mjTRN_JOINT
        return bool(on_joint) and self.model.actuator_trnid[actuator, 0] in joints

    def _add_numbers(self, spec: mujoco.MjSpec) -> None:
        """Copies the file's numerics for what MJCF has no element for, with zeros where the file has none."""
        for name, count in NUMERICS.items():
            values = self.model.numeric(name).data if has(self.model, "numeric", name) else np.zeros(count)
            if len(values) != count:
                raise InputError(f"numeric {name} needs {count} value{'s' * (count > 1)}")
            spec.add_numeric(name=name, data=values, size=count)


def _listed(names: Iterable[str]) -> str:
    """Returns the names in quotes for a message, or `none`."""
    return ", ".join(repr(name) for name in names) or "none"
