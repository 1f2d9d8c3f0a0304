"""What the controller is shown of the robot: the truth, or odometry from encoders and gyro; with noise."""

from __future__ import annotations

import numpy as np
from numba import float64, guvectorize


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
