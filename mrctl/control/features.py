"""The 8 physical features in which the inverse of equation (3) is linear, their scales, and the heading."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from mrctl.kernel import Array, kernel
from mrctl.theory.robot import Robot

FEATURE_NAMES = ("V", "ω", "V̇", "ω̇", "Vω", "ω²", "sgn V_l", "sgn V_r")
# Kernels are compiled with these sizes, so they must stand in a file that holds kernels; see `mrctl.kernel`.
# The physical features, the same with cosine and sine of the heading, and the channels of the velocity controller
FEATURES, REGRESSORS, CHANNELS = 8, 10, 2
SIGN_SPEED = 0.05  # m/s, width of the smooth sign function of the friction
STICTION_SPEED = 0.1  # m/s of the faster wheel; below it the voltage depends on stiction, not on the motion
V_DOT, OMEGA_DOT = 2, 3  # the features that are accelerations; their coefficients are the inertia M


@kernel
def features(command: Array, derivative: Array, half_track: float, scale: Array, x: Array) -> None:
    """The 8 features of the inverse dynamics, the inverse of equation (3), divided by their scales.

        x = (V, ω, V̇, ω̇, V ω, ω², tanh(V_l/0.05), tanh(V_r/0.05)) / scale,    V_l,r = V ∓ D ω

    Args:
        command: V in m/s and ω in rad/s, `(2,)`.
        derivative: V̇ in m/s² and ω̇ in rad/s², `(2,)`.
        half_track: D in m.
        scale: Scales, as from `feature_scale`, or ones, `(8,)`.
        x: Out: the features, `(8,)`.
    """
    v, omega = command[0], command[1]
    x[0] = v / scale[0]
    x[1] = omega / scale[1]
    x[2] = derivative[0] / scale[2]
    x[3] = derivative[1] / scale[3]
    x[4] = v * omega / scale[4]
    x[5] = omega * omega / scale[5]
    x[6] = np.tanh((v - half_track * omega) / SIGN_SPEED) / scale[6]
    x[7] = np.tanh((v + half_track * omega) / SIGN_SPEED) / scale[7]


@kernel
def regressor(command: Array, derivative: Array, direction: Array, half_track: float, scale: Array, phi: Array) -> None:
    """The 8 features, and cosine and sine of the heading, in which gravity on a slope of any direction is linear.

    Args:
        command: V in m/s and ω in rad/s, `(2,)`.
        derivative: V̇ in m/s² and ω̇ in rad/s², `(2,)`.
        direction: Cosine and sine of the heading, `(2,)`.
        half_track: D in m.
        scale: Scales of the 8 features, as from `feature_scale`, `(8,)`.
        phi: Out: features and direction, `(10,)` or longer.
    """
    features(command, derivative, half_track, scale, phi[:FEATURES])
    phi[FEATURES], phi[FEATURES + 1] = direction[0], direction[1]


@kernel
def moves(twist: Array, half_track: float) -> bool:
    """Tells whether the faster wheel is faster than `STICTION_SPEED`: V in m/s and ω in rad/s, `(2,)`, and D in m."""
    return abs(twist[0]) + half_track * abs(twist[1]) > STICTION_SPEED


@kernel
def dead_reckoned(heading: float, rate: float, period: float, direction: Array) -> float:
    """Turns a heading on by `period` in s at `rate` in rad/s, and writes its cosine and sine to `direction`, `(2,)`.

    Its origin does not matter to a law that learns the weights of both.
    """
    heading += period * rate
    direction[0], direction[1] = np.cos(heading), np.sin(heading)
    return heading


@kernel
def features_of_rows(command: Array, derivative: Array, half_track: Array, scale: Array, x: Array) -> None:
    """`features` of many motions: `(n, 2)`, `(n, 2)`, `(n,)` and `(n, 8)` in, `(n, 8)` out."""
    for i in range(len(x)):
        features(command[i], derivative[i], half_track[i], scale[i], x[i])


def feature_matrix(command: Array, derivative: Array, half_track: ArrayLike, scale: Array) -> Array:
    """`features` of motions with any leading axes, which broadcast: `(…, 2)`, `(…, 2)`, `(…)`, `(…, 8)` to `(…, 8)`."""
    shape = np.broadcast_shapes(command.shape[:-1], np.shape(half_track), scale.shape[:-1])
    size = int(np.prod(shape))
    x = np.empty((size, 8))
    rows = [
        np.array(np.broadcast_to(values, shape + tail)).reshape(size, *tail)
        for values, tail in ((command, (2,)), (derivative, (2,)), (half_track, ()), (scale, (8,)))
    ]
    features_of_rows(rows[0], rows[1], rows[2], rows[3], x)
    return x.reshape(*shape, 8)


def feature_scale(robot: Robot) -> Array:
    """Scales of the 8 features, `(8,)`, chosen so that each feature varies by about one on an ordinary lap.

    Speeds are divided by the robot's limits, accelerations and products by a third of theirs, because a robot is seldom
    near them, and the signs, which hardly vary, by three.
    """
    v, omega = robot.max_speed, robot.max_rotation
    products = np.array([robot.max_acceleration, robot.max_rotation_acceleration, v * omega, omega**2]) / 3
    return np.array([v, omega, *products, 3.0, 3.0])
