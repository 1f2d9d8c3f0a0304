"""The record that an estimator fills, and the prediction of posture and twist from commanded accelerations."""

from __future__ import annotations

import numpy as np

from mrctl.kernel import Array, Row, Rows, kernel

SEEN = np.dtype(
    [
        ("pose", "f8", 3),  # x and y in m, θ in rad, when the voltage of this tick acts
        ("twist", "f8", 2),  # V in m/s and θ̇ in rad/s, when the voltage of this tick acts
        ("slip", "f8"),  # low-passed slip ratio of the driven wheel that slips more
        ("wheel_speeds", "f8", 2),  # wheel speeds left and right, from encoders and nominal wheel radius, m/s
        ("lost", "f8", 2),  # change of the voltage by the driver's current limit in the last period, left and right, V
        ("encoder", "f8", 2),  # angles of the rear wheels that arrived last, left and right, rad
        ("gyro", "f8"),  # θ̇ of the gyro that arrived last, rad/s
        ("acceleration", "f8", 2),  # specific force that arrived last, forward and to the left, m/s²
        ("estimate", "f8", 5),  # x, y in m, θ in rad, V in m/s, θ̇ in rad/s now
        ("variance", "f8", 6),  # of `estimate`: var x, cov (x, y), var y, var θ, var V, var θ̇; 0 where it is not known
        ("fix", "f8", 3),  # posture fix that arrived in this tick, m, m, rad; NaN where none did
        ("delay", "i8"),  # control periods from the measurement to the voltage
        ("age", "i8"),  # control periods by which the samples are old from which the estimate is made
        ("start", "i8"),  # tick at which the run of this robot began
    ],
    align=True,
)


@kernel
def advance(
    x: float, y: float, theta: float, v: float, omega: float, v_dot: float, omega_dot: float, period: float
) -> tuple[float, float, float, float, float]:
    """Integrates posture and twist over one period, to second order.

        ẋ = V cos θ,  ẏ = V sin θ,    V̇ and θ̈ given and constant

    The position moves with the mean of V, in the direction that the robot has after half of its turn.

    Args:
        x: x in m.
        y: y in m.
        theta: θ in rad.
        v: V in m/s.
        omega: θ̇ in rad/s.
        v_dot: V̇ in m/s².
        omega_dot: θ̈ in rad/s².
        period: Duration in s.

    Returns:
        x, y, θ, V and θ̇ at the end.
    """
    middle_v, middle_omega = v + v_dot * period / 2, omega + omega_dot * period / 2
    heading = theta + middle_omega * period / 2
    x += period * middle_v * np.cos(heading)
    y += period * middle_v * np.sin(heading)
    return x, y, theta + period * middle_omega, v + period * v_dot, omega + period * omega_dot


@kernel
def predict(state: Array, first: int, last: int, ring: Rows, i: int, period: float, s: Row) -> None:
    """Predicts posture and twist from the beginning of period `first` to that of `last`, with commanded accelerations.

    The commanded acceleration that acts in a period was computed `delay` periods earlier; before the run it is zero.

    Args:
        state: x, y in m, θ in rad, V in m/s, θ̇ in rad/s at the beginning, `(5,)`.
        first: First control period.
        last: Control period at whose beginning the prediction ends.
        ring: Samples and commands, as in `Sensors`, `(N, B)`.
        i: Index of the robot.
        period: Control period in s.
        s: Its record of `SEEN`, whose `pose` and `twist` are the result.
    """
    x, y, theta, v, omega = state[0], state[1], state[2], state[3], state[4]
    for p in range(first - s.delay, last - s.delay):
        v_dot, omega_dot = 0.0, 0.0
        if p >= s.start:
            command = ring[p % len(ring), i].command
            v_dot, omega_dot = command[0], command[1]
        x, y, theta, v, omega = advance(x, y, theta, v, omega, v_dot, omega_dot, period)
    s.pose[0], s.pose[1], s.pose[2], s.twist[0], s.twist[1] = x, y, theta, v, omega


@kernel
def settle(state: Array, tick: int, ring: Rows, i: int) -> None:
    """Writes V and θ̇ of the state of a tick, x, y, θ, V, θ̇, to the samples of that tick; see `predict` for units."""
    twist = ring[tick % len(ring), i].twist
    twist[0], twist[1] = state[3], state[4]


@kernel
def wrapped(angle: float) -> float:
    """Returns an angle in rad in (−π, π]."""
    return np.pi - (np.pi - angle) % (2 * np.pi)
