"""What a robot's tyres and hull touch: where, with what force, and how fast they slide there."""

# pyright: reportAttributeAccessIssue=false
# (mujoco is compiled and ships no stubs)

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np

from mrctl.kernel import Array


class Contacts(NamedTuple):
    """The contacts of a robot with its world, n of them.

    Attributes:
        places: Positions in the world in m, `(n, 3)`.
        forces: Forces of the world on the robot along the world's axes in N, `(n, 3)`.
        slips: Velocities of the robot's surface along the other one, in the world in m/s, `(n, 3)`; a tyre
            that rolls creeps at some mm/s.
    """

    places: Array
    forces: Array
    slips: Array


def contacts(model: mujoco.MjModel, data: mujoco.MjData) -> Contacts:
    """Returns the contacts of the robot of a model with its surroundings, which are taken to stand still.

    A contact of MuJoCo has a frame with its normal first, and the force is that of its first geom on its second.

    Args:
        model: Compiled world with one robot.
        data: Its data after `mj_forward`.
    """
    chassis, found = model.body("chassis").id, []
    for k in range(data.ncon):
        contact = data.contact[k]
        bodies = model.geom_bodyid[contact.geom]
        own = model.body_rootid[bodies] == chassis
        if own.all() or not own.any() or contact.efc_address < 0:
            continue
        frame, wrench, motion = contact.frame.reshape(3, 3), np.zeros(6), np.zeros((3, model.nv))
        mujoco.mj_contactForce(model, data, k, wrench)
        force = frame.T @ wrench[:3]
        mujoco.mj_jac(model, data, motion, None, contact.pos, bodies[own.argmax()])
        velocity = motion @ data.qvel
        slip = velocity - frame[0] * (frame[0] @ velocity)
        found.append((contact.pos.copy(), force if own[1] else -force, slip))
    return Contacts(*(np.array(part).reshape(-1, 3) for part in zip(*found, strict=True))) if found else NO_CONTACTS


NO_CONTACTS = Contacts(*(np.zeros((0, 3)) for _ in range(3)))
