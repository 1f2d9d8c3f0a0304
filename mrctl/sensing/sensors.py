"""The measurement that the controller receives: true motion or odometry from encoders and gyro, noise, and slip."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mrctl.kernel import Array, Row, Rows, kernel
from mrctl.sensing.slip import slip_ratio
from mrctl.theory.perturbation import Perturbation
from mrctl.theory.robot import Robot

SEEN = np.dtype(
    [
        ("pose", "f8", 3),  # measured x and y in m, θ in rad
        ("twist", "f8", 2),  # measured V in m/s and θ̇ in rad/s
        ("slip", "f8"),  # slip ratio of the driven wheel that slips more
        ("odometry", "?"),  # whether posture and twist come from encoders and gyro
        ("noise_scale", "f8", 5),  # standard deviations of the noise of x, y, θ, V, θ̇
        ("noise", "f8", 5),  # samples of that noise in this period
        ("wheel_speeds", "f8", 2),  # wheel speeds left and right, from encoders and nominal wheel radius, m/s
        ("lost", "f8", 2),  # voltage applied less commanded by a driver at its current limit, in the last period, V
        ("elapsed", "f8"),  # time since the last measurement, s; 0 at the start
    ],
    align=True,
)


@kernel
def observe(true_pose: Array, true_twist: Array, s: Row) -> None:
    """Measured posture and twist of one robot: the truth plus noise, or odometry.

        V = (v_l + v_r)/2,  θ̇ from the gyro;    ẋ = V cos θ,  ẏ = V sin θ

    Odometry takes V from the encoders, adds noise to V and θ̇, and integrates them from the true initial posture, with
    mean velocities and the heading at the middle of the period (second-order Runge-Kutta).

    Args:
        true_pose: x and y in m, θ in rad, `(3,)`.
        true_twist: V in m/s and θ̇ in rad/s, `(2,)`.
        s: In and out: a record of `SEEN`.
    """
    if not s.odometry:
        for k in range(3):
            s.pose[k] = true_pose[k] + s.noise[k]
        s.twist[0], s.twist[1] = true_twist[0] + s.noise[3], true_twist[1] + s.noise[4]
        return
    v = (s.wheel_speeds[0] + s.wheel_speeds[1]) / 2 + s.noise[3]
    omega = true_twist[1] + s.noise[4]
    mean_v, mean_omega = (v + s.twist[0]) / 2, (omega + s.twist[1]) / 2
    heading = s.pose[2] + s.elapsed * mean_omega / 2
    s.pose[0] += s.elapsed * mean_v * np.cos(heading)
    s.pose[1] += s.elapsed * mean_v * np.sin(heading)
    s.pose[2] += s.elapsed * mean_omega
    s.twist[0], s.twist[1] = v, omega


@kernel
def measure(plant: Rows, wheel_radius: float, half_track: float, period: float, seen: Rows) -> None:
    """Measures all robots: from a record of `PLANT` to one of `SEEN` for each."""
    for i in range(len(seen)):
        true, s = plant[i].reading, seen[i]
        for k in range(2):
            s.wheel_speeds[k] = wheel_radius * true.wheel_rates[k]
            s.lost[k] = plant[i].lost[k]
        observe(true.pose, true.twist, s)
        s.slip = slip_ratio(s.wheel_speeds, s.twist, half_track, period, s.slip)
        s.elapsed = period


class Sensors:
    """The sensors of B robots.

    Attributes:
        seen: Last measurement of each robot, a record of `SEEN`, `(B,)`.
    """

    def __init__(self, odometry: Sequence[bool], seeds: Sequence[int], robot: Robot, period: float) -> None:
        """Builds the sensors.

        Args:
            odometry: For each robot, whether posture and twist come from encoders and gyro.
            seeds: Seed of the noise of each robot.
            robot: The nominal robot.
            period: Control period in s.
        """
        self.seen = np.zeros(len(seeds), SEEN)
        self.seen["odometry"] = odometry
        self._constants = robot.wheel_radius, robot.half_track, period
        self._random = [np.random.default_rng([seed, 2]) for seed in seeds]
        self._noisy: list[int] = []

    def set_noise(self, row: int, perturbation: Perturbation) -> None:
        """Gives the sensors of one robot the noise of a perturbation."""
        p = perturbation
        scale = p.position_noise, p.position_noise, p.heading_noise, p.velocity_noise, p.rotation_noise
        self.seen["noise_scale"][row], self.seen["noise"][row] = scale, 0.0
        self._noisy = np.flatnonzero(self.seen["noise_scale"].any(axis=1)).tolist()

    def start(self, reading: Rows, rows: int | slice = slice(None)) -> None:
        """Starts odometry of robots from their true posture and twist, a record of `READING` for each."""
        for name in ("pose", "twist"):
            self.seen[name][rows] = reading[name][rows]
        self.seen["elapsed"][rows] = self.seen["slip"][rows] = 0.0

    def restart(self, row: int, seed: int, reading: Rows) -> None:
        """Starts the sensors of one robot again, with the noise of another seed."""
        self._random[row] = np.random.default_rng([seed, 2])
        self.seen["noise"][row] = 0.0
        self.start(reading, row)

    def measure(self, plant: Rows) -> Rows:
        """Measures all robots.

        Args:
            plant: Record of `PLANT` of each robot, `(B,)`.

        Returns:
            `seen`, `(B,)`.
        """
        for row in self._noisy:
            self.seen["noise"][row] = self.seen["noise_scale"][row] * self._random[row].standard_normal(5)
        measure.compiled(plant, *self._constants, self.seen)
        return self.seen
