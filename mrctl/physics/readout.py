"""Readouts of a robot in physics, from `qpos` and `qvel` alone: posture, twist, wheel rates, steering and tilt."""

# pyright: reportAttributeAccessIssue=false
# (mujoco is compiled and ships no stubs)

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from mrctl.kernel import Array, Row, Rows, kernel
from mrctl.physics.elements import MOTORS, has

JOINTS = ("chassis", "wheel_left", "wheel_right")
MAX_VALUE = 1e10  # MuJoCo's own bound (mjMAXVAL) on a valid state

READING = np.dtype(
    [
        ("pose", "f8", 3),  # x and y of P in m, heading in rad
        ("twist", "f8", 2),  # V in m/s and θ̇ in rad/s in the body frame
        ("v_lateral", "f8"),  # lateral velocity of P, m/s
        ("wheel_rates", "f8", 2),  # of the rear wheels, left and right, rad/s
        ("steering_angle", "f8"),  # rad, positive to the left; 0 where nothing is steered
        ("steering_rate", "f8"),  # rad/s
        ("z", "f8"),  # height of the middle between the driven wheels, m
        ("roll", "f8"),  # rad, positive to the right; heading, pitch and roll turn about z, y and x in this order
        ("pitch", "f8"),  # rad, positive nose down
        ("upright", "f8"),  # cosine of the tilt from the vertical; NaN once the state has blown up
    ]
)


@kernel
def read(qpos: Array, qvel: Array, address: NDArray[np.int64], r: Row) -> None:
    """Reads a robot from its state.

    Args:
        qpos: Generalised positions, `(nq,)`.
        qvel: Generalised velocities, `(nv,)`.
        address: As from `addresses`.
        r: Out: a record of `READING`.
    """
    q, d = address[0], address[1]
    w, i, j, k = qpos[q + 3], qpos[q + 4], qpos[q + 5], qpos[q + 6]
    # Body x and y axes in the world.
    xx, xy, xz = 1 - 2 * (j * j + k * k), 2 * (i * j + w * k), 2 * (i * k - w * j)
    yx, yy, yz = 2 * (i * j - w * k), 1 - 2 * (i * i + k * k), 2 * (j * k + w * i)
    r.pose[0], r.pose[1], r.pose[2] = qpos[q], qpos[q + 1], np.arctan2(xy, xx)
    r.twist[0] = xx * qvel[d] + xy * qvel[d + 1] + xz * qvel[d + 2]
    r.twist[1] = qvel[d + 5]
    r.v_lateral = yx * qvel[d] + yy * qvel[d + 1] + yz * qvel[d + 2]
    r.wheel_rates[0], r.wheel_rates[1] = qvel[address[3]], qvel[address[5]]
    r.steering_angle = r.steering_rate = 0.0
    if address.shape[0] > 6:
        r.steering_angle, r.steering_rate = qpos[address[6]], qvel[address[7]]
    r.upright = 1 - 2 * (i * i + j * j)
    r.z, r.roll, r.pitch = qpos[q + 2], np.arctan2(yz, r.upright), np.arctan2(-xz, np.hypot(xx, xy))
    for value in qpos:
        if not abs(value) < MAX_VALUE:
            r.upright = np.nan
    for value in qvel:
        if not abs(value) < MAX_VALUE:
            r.upright = np.nan


@kernel
def imu_motion(qpos: Array, qvel: Array, address: NDArray[np.int64], imu: Array, velocity: Array, axes: Array) -> None:
    """Computes the velocity of the inertial sensor, and the axes along which it measures.

    Args:
        qpos: Generalised positions, `(nq,)`.
        qvel: Generalised velocities, `(nv,)`; those of a free joint are linear in the world and angular in the body.
        address: As from `addresses`.
        imu: Position of the sensor in the chassis' frame in m, `(3,)`.
        velocity: Out: its velocity in the world in m/s, `(3,)`.
        axes: Out: the chassis' x and y axes in the world, `(2, 3)`.
    """
    q, d = address[0], address[1]
    w, i, j, k = qpos[q + 3], qpos[q + 4], qpos[q + 5], qpos[q + 6]
    p, r, s = qvel[d + 3], qvel[d + 4], qvel[d + 5]
    x, y, z = r * imu[2] - s * imu[1], s * imu[0] - p * imu[2], p * imu[1] - r * imu[0]
    axes[0, 0], axes[0, 1], axes[0, 2] = 1 - 2 * (j * j + k * k), 2 * (i * j + w * k), 2 * (i * k - w * j)
    axes[1, 0], axes[1, 1], axes[1, 2] = 2 * (i * j - w * k), 1 - 2 * (i * i + k * k), 2 * (j * k + w * i)
    up = 2 * (i * k + w * j), 2 * (j * k - w * i), 1 - 2 * (i * i + j * j)
    for n in range(3):
        velocity[n] = qvel[d + n] + axes[0, n] * x + axes[1, n] * y + up[n] * z


@kernel
def read_all(qpos: Array, qvel: Array, address: NDArray[np.int64], rows: Rows) -> None:
    """Reads a trajectory or a batch: `qpos` `(n, nq)` and `qvel` `(n, nv)` into n records of `READING`."""
    for i in range(len(rows)):
        read(qpos[i], qvel[i], address, rows[i])


def addresses(model: mujoco.MjModel) -> NDArray[np.int64]:
    """Returns the addresses in qpos and qvel, alternating, of `JOINTS` `(6,)`, or of these and `steering` `(8,)`."""
    joints = (*JOINTS, "steering") if has(model, "joint", "steering") else JOINTS
    return np.array([a for name in joints for a in (model.joint(name).qposadr[0], model.joint(name).dofadr[0])], int)


def inputs(model: mujoco.MjModel) -> list[int]:
    """Returns the indices in ctrl of left and right voltage and, of a steered robot, of steering angle and rate."""
    found = [int(model.actuator_ctrladr[model.actuator(name).id]) for name in MOTORS]
    if has(model, "actuator", "steering"):
        steering = int(model.actuator_ctrladr[model.actuator("steering").id])
        found += [steering, steering + 1]
    return found


def motor_parameters(model: mujoco.MjModel) -> tuple[Array, Array, list[int]]:
    """Returns resistance `(2,)` in Ω, back-EMF per wheel rate `(2,)` in V·s/rad, addresses of current states."""
    motors = [model.actuator(name).id for name in MOTORS]
    resistance = model.actuator_gainprm[motors, 0]
    back_emf = model.actuator_gainprm[motors, 1] * model.actuator_gear[motors, 0]
    acts = [int(a) for a in model.actuator_actadr[motors] if a >= 0]
    return resistance, back_emf, acts


def current_limits(model: mujoco.MjModel) -> Array:
    """Returns the current limits left and right in A, `(2,)`, from the motors' torque limits; infinite without one."""
    motors = [model.actuator(name).id for name in MOTORS]
    torque = np.where(model.actuator_forcelimited[motors], model.actuator_forcerange[motors, 1], np.inf)
    return torque / model.actuator_gainprm[motors, 1]
