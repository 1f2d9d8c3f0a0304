"""What the controller is shown of the robot: the truth, or odometry from encoders and gyro, with noise; and slip."""

from __future__ import annotations

import numpy as np
from numba import float64, guvectorize

SLIP_FILTER = 0.1  # s
SLIP_SPEED = 0.3  # m/s that a slip is held against at least: noise is no slip of a wheel that stands


@guvectorize(
    [(float64[:], float64[:], float64[:], float64, float64, float64, float64[:], float64[:])],
    "(p),(u),(n),(),(),(),(p),(u)",
    writable_args=("pose", "twist"),
    cache=True,
)
def observe(true_pose, true_twist, noise, odometry, slip_free_speed, period, pose, twist):  # noqa: ANN001, ANN201
    """Measured posture and twist of one robot.

    Odometry takes V from the encoders and θ̇ from the gyro and integrates them at the control rate, the heading at its
    midpoint (second-order Runge-Kutta); it starts from the true posture.

    Args:
        true_pose: `(3,)` in m, m, rad.
        true_twist: `(2,)` in m/s, rad/s.
        noise: Samples for x, y, θ, V, θ̇ in their units, `(5,)`.
        odometry: 1 for odometry, 0 for truth.
        slip_free_speed: V by the encoders and the nominal wheel radius in m/s.
        period: Control period in s.
        pose: In and out: measured posture `(3,)`; odometry continues from what it holds.
        twist: In and out: measured twist `(2,)`.
    """
    if odometry > 0:
        v, omega = slip_free_speed + noise[3], true_twist[1] + noise[4]
        mean_v, mean_omega = (v + twist[0]) / 2, (omega + twist[1]) / 2
        heading = pose[2] + period * mean_omega / 2
        pose[0] += period * mean_v * np.cos(heading)
        pose[1] += period * mean_v * np.sin(heading)
        pose[2] += period * mean_omega
        twist[0], twist[1] = v, omega
    else:
        for i in range(3):
            pose[i] = true_pose[i] + noise[i]
        twist[0], twist[1] = true_twist[0] + noise[3], true_twist[1] + noise[4]


@guvectorize(
    [(float64[:], float64[:], float64, float64, float64[:])],
    "(w),(u),(),(),()",
    writable_args=("slip",),
    cache=True,
)
def watch_slip(wheel_speeds, twist, half_track, period, slip):  # noqa: ANN001, ANN201
    """Slip ratio of the driven wheels of one robot, of the one that slips more.

    |v_i − u_i| over the larger of |v_i| and |u_i|, where u = V ∓ D θ̇ is how fast the measured motion carries the wheel
    over the floor; behind a first-order low-pass, so that a jolt does not pass for slip, and a slip lasts until what a
    learner's filters hold of it is gone. Odometry, whose V is the mean of the encoders, shows about half of what one
    wheel slips. A radius that is wrong by some percent is a slip of as much, and noise one of 0.8 of its standard
    deviation over the speed.

    Args:
        wheel_speeds: v left and right, by the encoders and the nominal wheel radius in m/s, `(2,)`.
        twist: Measured V in m/s and θ̇ in rad/s `(2,)`.
        half_track: D in m.
        period: Control period in s.
        slip: In and out.
    """
    worst = 0.0
    for k in range(2):
        carried = twist[0] + (2 * k - 1) * half_track * twist[1]
        speed = max(abs(wheel_speeds[k]), abs(carried), SLIP_SPEED)
        worst = max(worst, abs(wheel_speeds[k] - carried) / speed)
    slip[0] += period / (period + SLIP_FILTER) * (worst - slip[0])
