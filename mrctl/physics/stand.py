"""Computes the state of a robot that stands on the ground and rolls, with its steered wheels turned.

The plant starts a run in that state, and the viewer draws results in it that lack height and tilt.
"""

# pyright: reportAttributeAccessIssue=false
# (mujoco is compiled and ships no stubs)

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from mrctl.kernel import Array
from mrctl.physics.elements import COLLISION, centres, fronts, has, knuckles
from mrctl.physics.parameters import read_robot
from mrctl.record import InputError
from mrctl.theory.kinematics import scrub_free_angle
from mrctl.theory.robot import Robot


class State(NamedTuple):
    """Generalised positions `(nq,)` and velocities `(nv,)` of one model, as MuJoCo orders them."""

    qpos: Array
    qvel: Array


def stand(model: mujoco.MjModel, pose: NDArray, twist: NDArray, robot: Robot | None = None) -> State:
    """Computes the state of a robot that stands on the ground and rolls without slip.

    Rays find the ground below each driven wheel, and below the middle of the other wheels. The plane through these
    three points decides height, roll and pitch. Steered wheels are at the angle at which they do not scrub.

    Args:
        model: Compiled world with the robot.
        pose: x and y of P in m, and θ in rad, `(3,)`.
        twist: V in m/s and θ̇ in rad/s, `(2,)`.
        robot: The parameters of the model, if known; by default they are read from it.

    Returns:
        The state, in which no wheel is below the ground.

    Raises:
        InputError: There is no ground below the pose, or an obstacle is in the way.
    """
    robot = robot or read_robot(model)
    data = mujoco.MjData(model)
    x, y, theta = pose
    ahead, left = np.array([np.cos(theta), np.sin(theta)]), np.array([-np.sin(theta), np.cos(theta)])
    steering = float(np.clip(scrub_free_angle(twist, robot), -robot.steering_limit, robot.steering_limit))
    # Position of the front contact point relative to P, along the body's x and y axes.
    contact_x = robot.wheelbase - robot.trail * np.cos(steering)
    contact_y = -robot.trail * np.sin(steering)
    floor = np.array(
        [
            ground(model, data, *(np.array([x, y]) + offset))
            for offset in (robot.half_track * left, -robot.half_track * left, contact_x * ahead + contact_y * left)
        ]
    )
    normal = np.cross(floor[1] - floor[0], floor[2] - floor[0])
    normal /= np.linalg.norm(normal) * np.sign(normal[2])
    # `up` is the plane's normal in the body frame, where the rear centres are (0, ±D, 0). Each wheel's centre is its
    # radius away from the plane, which is linear in `up`; the iteration keeps |up| = 1.
    radius_left, radius_right = model.geom("wheel_left").size[0], model.geom("wheel_right").size[0]
    height = (radius_left + radius_right) / 2
    up = np.array([0.0, (radius_left - radius_right) / (2 * robot.half_track), 1.0])
    mujoco.mj_kinematics(model, data)
    centre = np.array([contact_x, contact_y, centres(model, data, fronts(model))[:, 2].mean()])
    for _ in range(8):
        up[2] = np.sqrt(1 - up[0] ** 2 - up[1] ** 2)
        up[0] = (robot.front_wheel_radius - height - up[1:] @ centre[1:]) / centre[0]
    # The rotation from body to world takes `up` to `normal`, and the body's x axis into the vertical plane of the
    # heading.
    slope = normal[:2] @ ahead
    rise = np.arcsin(up[0] / np.hypot(slope, normal[2])) - np.arctan2(slope, normal[2])
    body_x = np.append(np.cos(rise) * ahead, np.sin(rise))
    frame = _frame(normal, body_x) @ _frame(up, np.array([1.0, 0.0, 0.0])).T
    middle = floor[:2].mean(axis=0)
    z = (height - normal[:2] @ (np.array([x, y]) - middle[:2])) / normal[2] + middle[2]
    data.qpos[:3] = x, y, z
    mujoco.mju_mat2Quat(data.qpos[3:7], frame.ravel())
    steer(model, data.qpos, steering)
    v, omega = twist
    data.qvel[:3] = frame[:, 0] * v
    data.qvel[3:6] = 0.0, 0.0, omega
    rates = {"wheel_left": (v - robot.half_track * omega) / radius_left}
    rates["wheel_right"] = (v + robot.half_track * omega) / radius_right
    for wheel, rate in (rates | front_rates(model, robot, v, omega, np.array(steering))).items():
        data.qvel[model.joint(wheel).dofadr[0]] = rate
    mujoco.mj_forward(model, data)
    if has(model, "sensor", COLLISION) and data.sensor(COLLISION).data[0]:
        raise InputError(f"initial_pose: the robot would stand in an obstacle at ({x:.2f}, {y:.2f})")
    if data.ncon:
        data.qpos[2] -= min(0.0, data.contact.dist.min())  # lifts it off bumps between the three points
    return State(data.qpos.copy(), data.qvel.copy())


def _linkage(model: mujoco.MjModel, knuckle: str, angle: NDArray) -> NDArray:
    """Returns the angles of a knuckle at steering angles, both in rad and of the same shape."""
    return np.polynomial.polynomial.polyval(angle, model.equality(knuckle).data[:5])


def steer(model: mujoco.MjModel, qpos: NDArray, angle: float) -> None:
    """Writes a steering angle in rad into `qpos`, `(nq,)`: the joint of the fork or rack, and those of the knuckles."""
    if has(model, "joint", "steering"):
        qpos[model.joint("steering").qposadr[0]] = angle
    for knuckle in knuckles(model):
        qpos[model.joint(knuckle).qposadr[0]] = _linkage(model, knuckle, np.array(angle))


def front_rates(
    model: mujoco.MjModel, robot: Robot, v: NDArray, omega: NDArray, steering: NDArray
) -> dict[str, NDArray]:
    """Computes the rates at which the steered wheels roll without slip.

    Args:
        model: Compiled world with the robot.
        robot: The parameters of the model.
        v: V in m/s, of any shape.
        omega: θ̇ in rad/s, of the same shape.
        steering: Steering angle φ in rad, of the same shape.

    Returns:
        Rates in rad/s of that shape by wheel; empty for a robot without a steered wheel.
    """
    if not has(model, "joint", "steering"):
        return {}
    along = v * np.cos(steering) + robot.wheelbase * omega * np.sin(steering)  # speed of the middle of the front axle
    rates = {wheel: along / robot.front_wheel_radius for wheel in fronts(model)}
    # A wheel's speed is proportional to its distance from the instantaneous centre, which is L over the sine of its
    # angle.
    for knuckle in knuckles(model):
        angle, wheel = _linkage(model, knuckle, steering), knuckle.removeprefix("steering_")
        distance = np.where(np.abs(steering) > 1e-6, np.sin(steering), 1.0) / np.where(
            np.abs(angle) > 1e-6, np.sin(angle), 1.0
        )  # relative to that of the middle of the axle
        rates[wheel] = rates[wheel] * distance
    return rates


def _frame(up: NDArray, ahead: NDArray) -> NDArray:
    """Returns the rotation `(3, 3)` whose z axis is the unit vector `up` and whose x axis is nearest to `ahead`."""
    side = np.cross(up, ahead)
    side /= np.linalg.norm(side)
    return np.column_stack([np.cross(side, up), side, up])


def ground(model: mujoco.MjModel, data: mujoco.MjData, x: float, y: float) -> NDArray:
    """Finds the ground below a point of the plane; the ray passes through the robot, whose geoms are not in group 0.

    Args:
        model: Compiled world.
        data: Its data, whose kinematics are computed anew.
        x: World coordinate in m.
        y: World coordinate in m.

    Returns:
        The point on the ground in m, `(3,)`.

    Raises:
        InputError: There is no ground below (x, y).
    """
    mujoco.mj_kinematics(model, data)
    groups = np.array([1, 0, 0, 0, 0, 0], np.uint8)
    start = np.array([x, y, 50.0])
    distance = mujoco.mj_ray(model, data, start, np.array([0.0, 0.0, -1.0]), groups, 1, -1, np.zeros(1, np.int32))
    if distance < 0:
        raise InputError(f"initial_pose: there is no ground below ({x:.2f}, {y:.2f})")
    return np.array([x, y, 50.0 - distance])
