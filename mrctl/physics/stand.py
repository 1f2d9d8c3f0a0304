"""Stands a robot on the ground, rolling, and turns what is steered."""

# pyright: reportAttributeAccessIssue=false
# (mujoco is compiled and ships no stubs)

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from mrctl.physics.elements import centres, fronts, has
from mrctl.physics.parameters import read_robot
from mrctl.record import InputError
from mrctl.theory.kinematics import scrub_free_angle
from mrctl.theory.robot import Robot


class State(NamedTuple):
    """Generalised positions `(nq,)` and velocities `(nv,)` of one robot."""

    qpos: NDArray[np.float64]
    qvel: NDArray[np.float64]



def stand(model: mujoco.MjModel, pose: NDArray, twist: NDArray, robot: Robot | None = None) -> State:
    """Stands the robot with its wheels on the ground, rolling with a given twist.

    Rays find the ground under the driven wheels and in the middle under the others; the plane through those three
    points decides height, roll and pitch.

    Args:
        model: Compiled world.
        pose: Posture `(3,)` of P in m, m, rad.
        twist: V in m/s and θ̇ in rad/s, `(2,)`.
        robot: What `read_robot` makes of the model, where that is known.

    Raises:
        InputError: There is no ground below the pose.
    """
    robot = robot or read_robot(model)
    data = mujoco.MjData(model)
    x, y, theta = pose
    ahead, left = np.array([np.cos(theta), np.sin(theta)]), np.array([-np.sin(theta), np.cos(theta)])
    steering = float(np.clip(scrub_free_angle(twist, robot), -robot.steering_limit, robot.steering_limit))
    reach = robot.wheelbase - robot.trail * np.cos(steering)
    aside = -robot.trail * np.sin(steering)
    floor = np.array(
        [
            ground(model, data, *(np.array([x, y]) + offset))
            for offset in (robot.half_track * left, -robot.half_track * left, reach * ahead + aside * left)
        ]
    )
    normal = np.cross(floor[1] - floor[0], floor[2] - floor[0])
    normal /= np.linalg.norm(normal) * np.sign(normal[2])
    # Distances from that plane: each wheel's centre at its radius. In the body frame the rear centres are (0, ±D, 0).
    radius_left, radius_right = model.geom("wheel_left").size[0], model.geom("wheel_right").size[0]
    height = (radius_left + radius_right) / 2
    up = np.array([0.0, (radius_left - radius_right) / (2 * robot.half_track), 1.0])
    mujoco.mj_kinematics(model, data)
    front = fronts(model)
    centre = np.array([reach, aside, centres(model, data, front)[:, 2].mean()])
    for _ in range(8):
        up[2] = np.sqrt(1 - up[0] ** 2 - up[1] ** 2)
        up[0] = (robot.front_wheel_radius - height - up[1:] @ centre[1:]) / centre[0]
    # World from body: `up` becomes `normal`, and body x rises so that it lies over the heading.
    slope = normal[:2] @ ahead
    rise = np.arcsin(up[0] / np.hypot(slope, normal[2])) - np.arctan2(slope, normal[2])
    body_x = np.append(np.cos(rise) * ahead, np.sin(rise))
    frame = _frame(normal, body_x) @ _frame(up, np.array([1.0, 0.0, 0.0])).T
    point = floor[:2].mean(axis=0)
    origin_z = (height - normal[:2] @ (np.array([x, y]) - point[:2])) / normal[2] + point[2]
    data.qpos[:3] = x, y, origin_z
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
    if data.ncon:
        data.qpos[2] -= min(0.0, data.contact.dist.min())  # bumps between the three points
    return State(data.qpos.copy(), data.qvel.copy())



def _knuckles(model: mujoco.MjModel) -> list[str]:
    """Joints of two steered wheels, which an equality couples to the joint `steering`."""
    return [f"steering_{wheel}" for wheel in fronts(model) if has(model, "joint", f"steering_{wheel}")]



def _linkage(model: mujoco.MjModel, knuckle: str, angle: NDArray) -> NDArray:
    """Angle of a knuckle in rad at a steering angle."""
    return np.polynomial.polynomial.polyval(angle, model.equality(knuckle).data[:5])



def steer(model: mujoco.MjModel, qpos: NDArray, angle: float) -> None:
    """Turns what is steered to a steering angle in rad, in `qpos` `(nq,)`."""
    if has(model, "joint", "steering"):
        qpos[model.joint("steering").qposadr[0]] = angle
    for knuckle in _knuckles(model):
        qpos[model.joint(knuckle).qposadr[0]] = _linkage(model, knuckle, np.array(angle))



def front_rates(
    model: mujoco.MjModel, robot: Robot, v: NDArray, omega: NDArray, steering: NDArray
) -> dict[str, NDArray]:
    """Rates in rad/s of the steered wheels that roll without slip, by name; shapes as those of the arguments.

    Args:
        model: Compiled world.
        robot: The robot.
        v: V in m/s.
        omega: θ̇ in rad/s.
        steering: φ in rad.
    """
    if not has(model, "joint", "steering"):
        return {}
    along = v * np.cos(steering) + robot.wheelbase * omega * np.sin(steering)  # of the middle of the front axle
    rates = {wheel: along / robot.front_wheel_radius for wheel in fronts(model)}
    for knuckle in _knuckles(model):  # seen from the turning point a wheel is as fast as it is far away
        angle, wheel = _linkage(model, knuckle, steering), knuckle.removeprefix("steering_")
        far = np.where(np.abs(steering) > 1e-6, np.sin(steering), 1.0) / np.where(
            np.abs(angle) > 1e-6, np.sin(angle), 1.0
        )
        rates[wheel] = rates[wheel] * far
    return rates



def _frame(up: NDArray, ahead: NDArray) -> NDArray:
    """Rotation matrix `(3, 3)` whose z axis is `up` and whose x axis is nearest to `ahead`."""
    side = np.cross(up, ahead)
    side /= np.linalg.norm(side)
    return np.column_stack([np.cross(side, up), side, up])



def ground(model: mujoco.MjModel, data: mujoco.MjData, x: float, y: float) -> NDArray:
    """The ground point below (x, y); the robot itself (geom groups above 0) is transparent to the ray."""
    mujoco.mj_kinematics(model, data)
    groups = np.array([1, 0, 0, 0, 0, 0], np.uint8)
    start = np.array([x, y, 50.0])
    distance = mujoco.mj_ray(model, data, start, np.array([0.0, 0.0, -1.0]), groups, 1, -1, np.zeros(1, np.int32))
    if distance < 0:
        raise InputError(f"initial_pose: there is no ground below ({x:.2f}, {y:.2f})")
    return np.array([x, y, 50.0 - distance])
