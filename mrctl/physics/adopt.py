"""Somebody's robot on one of our floors: any MJCF with two driven wheels, under the names of `physics.elements`.

The file is taken apart, not changed: its robot moves into the world with P at the origin of `chassis`, x ahead and z
up; driven wheels turn forwards under positive voltage and touch the floor with spheres of their own radius, because
cylinders scrub on their edges; a caster that does not roll is without friction, because a contact that slides hops;
no other geom collides.
"""

# pyright: reportAttributeAccessIssue=false
# (mujoco is compiled and ships no stubs)

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from mrctl.physics.elements import FRONTS, MOTORS, REAR, RIGID, has
from mrctl.physics.files import robot_path
from mrctl.record import InputError
from mrctl.theory.robot import RobotFile

Array = NDArray[np.float64]

PREFIX = "robot/"  # of whatever keeps its name
UP = np.array([0.0, 0.0, 1.0])
LEVEL = 0.1  # of the wheel radius: how near to the floor a caster reaches
HINGE = mujoco.mjtJoint.mjJNT_HINGE
DCMOTOR = '<dcmotor joint="{}" gear="N" motorconst="k k" resistance="R" armature="J" ctrlrange="-U U"/>'






class Wheel(NamedTuple):
    """Something on the floor: where it touches, in the world of the file as it stands."""

    body: str
    joint: str  # that it rolls on; empty if it slides, without friction
    centre: Array
    radius: float
    friction: float


def compiled(robot: RobotFile, world: Path) -> mujoco.MjModel:
    """Compiles a world with another robot than its own.

    Raises:
        InputError: The file is no MJCF, the robot has not what it needs, or more than one of it and no name; one line.
    """
    path = robot_path(robot)
    try:
        return _Adoption(robot, path).into(world)
    except ValueError as error:
        raise InputError(f"{path}: {' '.join(str(error).split())}") from None


class _Adoption:
    """A robot's file, what was found in it, and how it is changed; left and right are as the robot drives."""

    def __init__(self, robot: RobotFile, path: Path) -> None:
        self.spec = mujoco.MjSpec.from_file(str(path))
        for k, body in enumerate(self.spec.bodies):
            body.name = body.name or f"body_{k}"
        self.model = self.spec.compile()
        self.data = mujoco.MjData(self.model)
        mujoco.mj_kinematics(self.model, self.data)
        wheels, steered = self._driven(robot.wheels), self._steered(robot.steering)
        self.chassis = self._carrier(robot.chassis, wheels)
        self.ahead, self.left = self._directions(wheels, steered)
        self.origin = np.mean([self.data.joint(name).xanchor for name in wheels], axis=0)
        self.wheels = sorted(wheels, key=self._side)
        self.steered = sorted(steered, key=self._side)
        self.rear = [self._wheel(name) for name in self.wheels]
        self.radius = float(np.mean([wheel.radius for wheel in self.rear]))
        self.motors = [self._motor(name) for name in self.wheels]
        self.front = [self._steered_wheel(name) for name in self.steered] or self._casters()

    # -- what the file holds ----------------------------------------------------------------------------------------

    def _driven(self, names: Sequence[str]) -> list[str]:
        found = list(names) or [
            a.target for a in self.spec.actuators if a.gaintype == mujoco.mjtGain.mjGAIN_DCMOTOR and self._is_hinge(a)
        ]
        if len(set(found)) != 2:
            hinges = [j for j in self._hinges() if abs(self._axis(j)[2]) < 0.5]
            raise InputError(
                f"wheels: {len(found)} joints have a <dcmotor>; name the joints of the two driven wheels, "
                f"of {_listed(hinges)}, and give each {DCMOTOR.format('JOINT')}"
            )
        return [self._hinge(name, "wheels") for name in found]

    def _steered(self, names: Sequence[str]) -> list[str]:
        moved = {a.target for a in self.spec.actuators if self._is_hinge(a)}
        upright = [name for name in self._hinges() if abs(self._axis(name)[2]) > 0.9 and name in moved]
        found = list(names) or upright
        if len(found) > 2:
            raise InputError(f"steering: {_listed(found)} are upright joints with an actuator; name one or two of them")
        return [self._hinge(name, "steering") for name in found]

    def _carrier(self, name: str, wheels: Sequence[str]) -> str:
        bodies = [body.name for body in self.spec.bodies]
        if name and name not in bodies:
            raise InputError(f"chassis: no body {name!r}, but {_listed(bodies[1:])}")
        roots = {self._lineage(joint)[-1] for joint in wheels}
        found = name or roots.pop()
        if any(found not in self._lineage(joint) for joint in wheels):
            raise InputError(f"chassis: the wheels {_listed(wheels)} do not both hang on {found!r}")
        if found in (self._lineage(joint)[0] for joint in wheels):
            raise InputError(f"chassis: the wheel {_listed(wheels)} is a body without a chassis")
        return found

    def _directions(self, wheels: Sequence[str], steered: Sequence[str]) -> tuple[Array, Array]:
        """Where ahead and left are, level unit vectors: to what is steered, or along the chassis' x axis."""
        axle = self._axis(wheels[0])
        if abs(axle @ self._axis(wheels[1])) < 0.99 or abs(axle[2]) > 0.1:
            raise InputError(f"wheels: the axes of {_listed(wheels)} are not one level axle")
        ahead = np.cross(axle, UP) / np.linalg.norm(np.cross(axle, UP))
        if steered:
            anchors = [np.mean([self.data.joint(n).xanchor for n in names], axis=0) for names in (steered, wheels)]
            there = anchors[0] - anchors[1]
        else:
            there = self.data.body(self.chassis).xmat.reshape(3, 3)[:, 0]
        if there @ ahead < -1e-6:
            ahead = -ahead
        return ahead, np.cross(UP, ahead)

    def _wheel(self, joint: str) -> Wheel:
        """A wheel by the lowest of its body's geoms."""
        body = self._lineage(joint)[0]
        geoms = [g for g in range(self.model.ngeom) if self.model.geom_bodyid[g] == self.model.body(body).id]
        if not geoms:
            raise InputError(f"wheels: body {body!r} of joint {joint!r} has no geom to roll on")
        return self._contact(min(geoms, key=self._bottom), body, joint)

    def _steered_wheel(self, steering: str) -> Wheel:
        """The wheel that rolls below a steered joint."""
        fork = self._lineage(steering)[0]
        rolling = [
            name for name in self._hinges() if fork in self._lineage(name) and abs(self._axis(name) @ self.left) > 0.9
        ]
        if len(rolling) != 1:
            raise InputError(f"steering: below joint {steering!r} are {len(rolling)} joints to roll on, not one")
        return self._wheel(rolling[0])

    def _casters(self) -> list[Wheel]:
        """What else reaches the floor: colliding geoms, or any if there are none; one where several share a place."""
        floor = np.mean([wheel.centre[2] - wheel.radius for wheel in self.rear])
        own = {wheel.body for wheel in self.rear}
        low = [
            g for g in range(self.model.ngeom)
            if self.chassis in (line := self._line(self.model.geom_bodyid[g])) and not own & set(line)
            and self._bottom(g) - floor < LEVEL * self.radius
        ]  # fmt: skip
        found: list[Wheel] = []
        colliding = [g for g in low if self.model.geom_contype[g] or self.model.geom_conaffinity[g]]
        for g in colliding or low:
            body = self.model.body(self.model.geom_bodyid[g])
            at = self.data.geom_xpos[g]
            if all(np.hypot(*(at - other.centre)[:2]) > LEVEL * self.radius for other in found):
                caster = self._contact(g, body.name, self._roller(body.name))
                found.append(caster._replace(radius=at[2] - floor))  # wherever its own lowest point is
        across = [(w.centre - self.origin) @ self.ahead for w in found]
        if not found:
            raise InputError("caster: beside the driven wheels nothing reaches the floor, and nothing is steered")
        if len(found) > 2 or min(across) * max(across) < 0:
            names = _listed([w.body for w in found])
            raise InputError(f"caster: at most two, both ahead of the axle or both behind, not on {names}")
        return sorted(found, key=lambda w: -(w.centre @ self.left))

    def _roller(self, body: str) -> str:
        """The joint on which a caster's body rolls, a ball or a level hinge; empty if it only slides."""
        joints = [j for j in range(self.model.njnt) if self.model.jnt_bodyid[j] == self.model.body(body).id]
        if body == self.chassis or len(joints) != 1 or not self.model.joint(joints[0]).name:
            return ""
        kind, level = self.model.jnt_type[joints[0]], abs(self.data.xaxis[joints[0]][2]) < 0.1
        ball = kind == mujoco.mjtJoint.mjJNT_BALL
        return self.model.joint(joints[0]).name if ball or (kind == HINGE and level) else ""

    def _contact(self, geom: int, body: str, joint: str) -> Wheel:
        centre = self.data.geom_xpos[geom].copy()
        return Wheel(body, joint, centre, centre[2] - self._bottom(geom), float(self.model.geom_friction[geom, 0]))

    def _motor(self, joint: str) -> str:
        moved = [a for a in self.spec.actuators if self._is_hinge(a) and a.target == joint]
        if len(moved) != 1 or moved[0].gaintype != mujoco.mjtGain.mjGAIN_DCMOTOR:
            what = (
                "has no actuator" if not moved else f"is driven by {_listed([a.name or 'an actuator' for a in moved])}"
            )
            raise InputError(
                f"motor: wheel {joint!r} {what}, not by one <dcmotor>; mrctl commands volts: {DCMOTOR.format(joint)}"
            )
        moved[0].name = moved[0].name or f"motor of {joint}"
        index = moved[0].id
        resistance, constant = self.model.actuator_gainprm[index, :2]
        supply = self.model.actuator_ctrlrange[self.model.actuator_ctrladr[index], 1]
        for name, value in (("resistance", resistance), ("motorconst", constant), ("ctrlrange", supply)):
            if not value > 0:
                raise InputError(f"motor: {moved[0].name!r} has no {name}: {DCMOTOR.format(joint)}")
        return moved[0].name

    def _is_hinge(self, actuator: Any) -> bool:  # noqa: ANN401
        return actuator.trntype == mujoco.mjtTrn.mjTRN_JOINT and actuator.target in self._hinges()

    def _hinges(self) -> list[str]:
        joints = (self.model.joint(j) for j in range(self.model.njnt))
        return [joint.name for joint in joints if joint.type[0] == HINGE]

    def _hinge(self, name: str, field: str) -> str:
        if name not in self._hinges():
            raise InputError(f"{field}: no hinge joint {name!r}, but {_listed(self._hinges())}")
        return name

    def _axis(self, joint: str) -> Array:
        return self.data.joint(joint).xaxis

    def _side(self, joint: str) -> float:
        return -float((self.data.joint(joint).xanchor - self.origin) @ self.left)

    def _line(self, body: int) -> list[str]:
        line = []
        while body:
            line.append(self.model.body(body).name)
            body = self.model.body_parentid[body]
        return line

    def _lineage(self, joint: str) -> list[str]:
        """The body of a joint and those that carry it, up to the root."""
        return self._line(self.model.joint(joint).bodyid[0])

    def _bottom(self, geom: int) -> float:
        """Height of the lowest point of a geom."""
        size, up = self.model.geom_size[geom], np.round(self.data.geom_xmat[geom].reshape(3, 3)[2], 6)
        height, kind, shape = self.data.geom_xpos[geom][2], self.model.geom_type[geom], mujoco.mjtGeom
        if kind == shape.mjGEOM_SPHERE:
            return height - size[0]
        if kind == shape.mjGEOM_CAPSULE:
            return height - size[0] - size[1] * abs(up[2])
        if kind == shape.mjGEOM_CYLINDER:
            return height - size[0] * np.sqrt(max(0.0, 1 - up[2] ** 2)) - size[1] * abs(up[2])
        if kind == shape.mjGEOM_ELLIPSOID:
            return height - np.linalg.norm(up * size)
        if kind == shape.mjGEOM_MESH:
            mesh = self.model.mesh(self.model.geom_dataid[geom])
            points = self.model.mesh_vert[mesh.vertadr[0] : mesh.vertadr[0] + mesh.vertnum[0]]
            return height + (points @ up).min()
        if kind == shape.mjGEOM_BOX:
            return height - np.abs(up) @ size
        return np.inf

    # -- how it is changed ------------------------------------------------------------------------------------------

    def into(self, world: Path) -> mujoco.MjModel:
        """The world with this robot instead of its own."""
        spec = mujoco.MjSpec.from_file(str(world))
        if (own := spec.body("chassis")) is None:
            raise InputError(f"world: {world} has no body 'chassis' whose place another robot could take")
        floors = [(p.geomname1, p.name, np.array(p.friction)) for p in spec.pairs if p.geomname2 == "wheel_left"]
        pattern = next(p for p in spec.pairs if p.geomname2 == "wheel_left")
        tyre = {n: np.array(getattr(pattern, n)) for n in ("solref", "solreffriction", "solimp")}
        usual = next(friction[0] for _, name, friction in floors if name == "tyre_left")
        spec.delete(own)
        for numeric in list(spec.numerics):
            spec.delete(numeric)
        self._strip()
        self._turn()
        names = self._names()
        spec.worldbody.add_frame().attach_body(self.spec.body(self.chassis), PREFIX, "")
        for kind, old, new in names:
            element = getattr(spec, kind)(PREFIX + old)
            element.name = new
        for motor, wheel in zip(MOTORS, REAR, strict=True):
            spec.actuator(motor).target = wheel
        spec.body("chassis").add_freejoint(name="chassis")
        if self.steered:
            self._add_steering(spec)
        # Friction is a tyre's own on an ordinary floor; what the world says is slippery stays so in proportion.
        for geom, wheel in (*zip(REAR, self.rear, strict=True), *zip(self._front_names(), self.front, strict=True)):
            for floor, name, friction in floors:
                mu = wheel.friction * friction[0] / usual
                pair = spec.add_pair(geomname1=floor, geomname2=geom, condim=3 if wheel.joint else 1, **tyre)
                pair.friction[:] = mu, mu, *friction[2:]
                pair.name = name.replace("left", geom.removeprefix("wheel_")) if name else ""
        self._add_numbers(spec)
        flags = mujoco.mjtDisableBit
        spec.option.disableflags &= ~int(flags.mjDSBL_EQUALITY | flags.mjDSBL_SPRING)
        if not spec.equalities:
            spec.option.disableflags |= int(flags.mjDSBL_EQUALITY)
        return spec.compile()

    def _strip(self) -> None:
        """Leaves out what belongs to the file's own world, or names what gets another name."""
        spec = self.spec
        steering = [a for a in spec.actuators if a.target in self.steered]
        coupled = [e for e in spec.equalities if {e.name1, e.name2} & {*self.steered, *self.wheels}]
        for element in [*spec.sensors, *spec.keys, *spec.pairs, *spec.excludes, *steering, *coupled]:
            spec.delete(element)
        spec.compiler.inertiafromgeom = 2  # auto: inertias that were found once stay
        for geom in spec.geoms:
            geom.contype = geom.conaffinity = 0
            geom.group = geom.group or 1  # rays that look for the ground see group 0

    def _turn(self) -> None:
        """Moves the chassis' frame to P, x ahead, z up; positive turns of wheels and fork are ahead and left."""
        chassis, model = self.spec.body(self.chassis), self.model
        for name in (*self.wheels, *self.steered, *(w.joint for w in self.front if w.joint)):
            joint = self.spec.joint(name)
            if joint.type == HINGE and self._axis(name) @ (UP if name in self.steered else self.left) < 0:
                joint.axis = -np.array(joint.axis)
                joint.range = -np.array(joint.range)[::-1]
        for name in self.motors:
            motor = self.spec.actuator(name)
            motor.gear = np.abs(motor.gear)
        place, turn = self._in_chassis(), np.zeros(4)
        mujoco.mju_mat2Quat(turn, place.T.ravel())
        body, data = model.body(self.chassis), self.data.body(self.chassis)
        shift = place @ (data.xpos - self.origin)  # of the old frame in the new one
        turned = place @ data.xmat.reshape(3, 3)
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
            chassis.ipos = shift + turned @ body.ipos
            inertial = np.zeros(4)
            mujoco.mju_mulQuat(inertial, quat, body.iquat)
            chassis.iquat, chassis.mass, chassis.inertia = inertial, body.mass[0], body.inertia
            chassis.ialt.type, chassis.fullinertia[0] = mujoco.mjtOrientation.mjORIENTATION_QUAT, np.nan
            chassis.explicitinertial = True
        chassis.pos, chassis.quat = (0.0, 0.0, self.radius), (1.0, 0.0, 0.0, 0.0)
        chassis.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
        for joint in list(chassis.joints):
            self.spec.delete(joint)

    def _in_chassis(self) -> Array:
        """Rotation from the file's world to the chassis' new frame, `(3, 3)`."""
        return np.stack([self.ahead, self.left, UP])

    def _add_contact(self, name: str, wheel: Wheel) -> None:
        body = self.data.body(wheel.body)
        at = body.xmat.reshape(3, 3).T @ (wheel.centre - body.xpos)
        self.spec.body(wheel.body).add_geom(
            name=f"contact {name}", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[wheel.radius, 0, 0], pos=at, mass=0,
            contype=0, conaffinity=0, group=3, rgba=[1, 0.5, 0, 0.3],
        )  # fmt: skip

    def _front_names(self) -> tuple[str, ...]:
        if self.steered:
            return FRONTS[:1] if len(self.steered) == 1 else FRONTS[1:3]
        return FRONTS[3 : 3 + len(self.front)]

    def _names(self) -> Iterable[tuple[str, str, str]]:
        """What gets another name: kind, old and new."""
        yield "body", self.chassis, "chassis"
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
        """A servo with position and rate set-points; two wheels hang on it by a linkage of Ackermann's geometry.

        With the middle of the front axle at φ, a wheel at y to the left is at atan(L tan φ/(L − y tan φ)).
        """
        servos = [k for k in range(len(self.model.actuator_trntype)) if self._trains(k)]
        kp, kv = (sum(-self.model.actuator_biasprm[k, i] for k in servos) for i in (1, 2))
        if not kp > 0:
            raise InputError(f"steering: {_listed(self.steered)} needs a <position> or <pid> actuator with a kp")
        ranges = [self.model.joint(name).range for name in self.steered]
        limit = min(float(np.abs(r).min()) for r in ranges)
        if not 0 < limit < np.pi / 2:
            raise InputError(f"steering: {_listed(self.steered)} needs a range on both sides of straight on, below 90°")
        anchors = [self._in_chassis() @ (self.data.joint(name).xanchor - self.origin) for name in self.steered]
        if len(anchors) == 2:
            length, track = float(np.mean([a[0] for a in anchors])), float(anchors[0][1] - anchors[1][1])
            limit = float(np.arctan(length / (length / np.tan(limit) + track / 2)))
            inertia = sum(self.model.dof_M0[self.model.joint(name).dofadr[0]] for name in self.steered)
            fork = spec.body("chassis").add_body(
                name="fork", pos=(length, 0.0, float(np.mean([a[2] for a in anchors])))
            )
            fork.mass, fork.inertia, fork.explicitinertial = 1e-6, np.full(3, 1e-9), True
            # A rack as heavy as what it moves, and slower than the 2 ms in which the engine damps implicitly.
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
        joint = spec.joint("steering")
        joint.limited = 1
        joint.range = np.array([-limit, limit]) * (180 / np.pi if self._in_degrees(len(anchors)) else 1.0)
        servo = spec.add_actuator(name="steering", target="steering", trntype=mujoco.mjtTrn.mjTRN_JOINT)
        servo.set_to_pid(kp=kp, kv=kv)
        spec.add_text(name=RIGID, data="the wheels go where the servo says")

    def _in_degrees(self, steered: int) -> bool:
        """Whether the joint `steering` is one of the file's own, and the file counts in degrees."""
        return steered == 1 and bool(self.spec.compiler.degree)

    def _trains(self, actuator: int) -> bool:
        joints = [self.model.joint(name).id for name in self.steered]
        joint = self.model.actuator_trntype[actuator] == mujoco.mjtTrn.mjTRN_JOINT
        return bool(joint) and self.model.actuator_trnid[actuator, 0] in joints

    def _add_numbers(self, spec: mujoco.MjSpec) -> None:
        """What an MJCF does not know by itself, from its numerics, or nothing."""
        for name, count in (("no_load_current", 1), ("limits", 4)):
            values = self.model.numeric(name).data if has(self.model, "numeric", name) else np.zeros(count)
            if len(values) != count:
                raise InputError(f"numeric {name} needs {count} value{'s' * (count > 1)}")
            spec.add_numeric(name=name, data=values, size=count)


def _listed(names: Iterable[str]) -> str:
    return ", ".join(repr(name) for name in names) or "none"
