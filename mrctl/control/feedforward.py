"""What every feedforward has in common, and the ones that do not learn: `none`, `model`, `oracle`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numba import float64, guvectorize
from numpy.typing import NDArray

from mrctl.theory.dynamics import inverse_coefficients
from mrctl.theory.robot import Robot

Array = NDArray[np.float64]
FEATURES = ("V", "ω", "V̇", "ω̇", "Vω", "ω²", "sgn V_l", "sgn V_r")
SIGN_SPEED = 0.05  # m/s over which the smooth sign of the losses turns
STEERING_SHARE = 0.1  # how much slower a steering channel learns: its geometry is nearly right from the start


class Feedforward(Protocol):
    """The stage that turns the commanded motion into voltages. Any object with these two methods is one.

    A stage serves B robots; what it remembers belongs in arrays with a leading B, so that rows cannot mix. What it may
    have besides helps the guard (`mrctl.control.guard`): `weight_norm`, a float64 array `(B,)`; `weight_volts`, what
    weights of norm one make of features of one, in V, a number or `(B,)`; and `restore(rows)`, which takes the robots
    with these indices back to what they began with.
    """

    def output(self, command: Array, derivative: Array) -> Array:
        """Feedforward of the two channels; asked once before the first tick, too, for a start without a bump.

        Args:
            command: Commanded V in m/s and θ̇ in rad/s, `(B, 2)`.
            derivative: Their derivatives in m/s², rad/s², `(B, 2)`.

        Returns:
            U_Σ and U_Δ in V, `(B, 2)`; under `rigid` steering the second channel is a correction of θ̇ in rad/s.
        """
        ...

    def learn(self, feedback: Array, saturated: Array, twist: Array, voltage: Array) -> Array | None:
        """Learns from what the feedback still had to do after the last `output`, and from how the robot moves.

        Args:
            feedback: Feedback of the two channels `(B, 2)`, units as `output`.
            saturated: 1 where a limit acted, a driven wheel slips, or this robot must not learn, `(B,)`.
            twist: Measured V in m/s and θ̇ in rad/s, on which `voltage` has not acted yet, `(B, 2)`.
            voltage: What is sent from now on, after the limits, in the channels and units of `output`, `(B, 2)`.

        Returns:
            How much this added to the output for the same command, `(B, 2)`, so that the PID can hand it over; or None.
        """
        ...


@guvectorize(
    [(float64[:], float64[:], float64, float64[:], float64[:])],
    "(u),(u),(),(f)->(f)",
    cache=True,
)
def features(command, derivative, half_track, scale, out):  # noqa: ANN001, ANN201
    """The 8 features of the inverse dynamics (physics of equation (3)), divided by `scale`, for one robot."""
    v, omega = command[0], command[1]
    out[0] = v / scale[0]
    out[1] = omega / scale[1]
    out[2] = derivative[0] / scale[2]
    out[3] = derivative[1] / scale[3]
    out[4] = v * omega / scale[4]
    out[5] = omega * omega / scale[5]
    out[6] = np.tanh((v - half_track * omega) / SIGN_SPEED) / scale[6]
    out[7] = np.tanh((v + half_track * omega) / SIGN_SPEED) / scale[7]


def feature_scale(robot: Robot) -> Array:
    """Scales of the 8 features, `(8,)`, chosen so that each moves by about one on an ordinary lap.

    Speeds are divided by the robot's limits; accelerations and products by a third of theirs, where a robot spends its
    time; the signs, which hardly move, by three.
    """
    v, omega = robot.max_speed, robot.max_rotation
    fast = np.array([robot.max_acceleration, robot.max_rotation_acceleration, v * omega, omega**2]) / 3
    return np.array([v, omega, *fast, 3.0, 3.0])


@guvectorize([(float64[:], float64[:, :], float64[:])], "(f),(f,u)->(u)", cache=True)
def linear(x, coefficients, out):  # noqa: ANN001, ANN201
    """Features `(8,)` times coefficients `(8, 2)` for one robot; a plain sum in a fixed order."""
    for k in range(2):
        total = 0.0
        for i in range(x.shape[0]):
            total += x[i] * coefficients[i, k]
        out[k] = total


class NoFeedforward:
    """PID alone, the paper's baseline."""

    def __init__(self, size: int) -> None:
        """Takes the number of robots."""
        self._zero = np.zeros((size, 2))

    def output(self, command: Array, derivative: Array) -> Array:
        """Zero volts."""
        return self._zero

    def learn(self, feedback: Array, saturated: Array, twist: Array, voltage: Array) -> None:
        """Nothing to learn."""


class InverseDynamics:
    """The corrected equation (3) inverted: `model` with nominal parameters, `oracle` with the plant's own.

    Attributes:
        coefficients: Of the features in the two channels, `(B, 8, 2)`.
    """

    def __init__(self, robots: Sequence[Robot], rigid: bool) -> None:
        """Takes a robot a row, and whether the second channel is steering."""
        self._half_track = np.array([robot.half_track for robot in robots])
        self.coefficients = np.zeros((len(robots), 8, 2))
        self._rigid = rigid
        self._scale = np.ones(8)
        self._features, self._output = np.zeros((len(robots), 8)), np.zeros((len(robots), 2))
        for row, robot in enumerate(robots):
            self.set_robot(row, robot)

    def set_robot(self, row: int, robot: Robot) -> None:
        """Replaces the parameters of one row."""
        self._half_track[row] = robot.half_track
        self.coefficients[row] = inverse_coefficients(robot)
        if self._rigid:  # the steering makes θ̇; its inverse is φ_c itself
            self.coefficients[row, :, 1] = 0.0

    def output(self, command: Array, derivative: Array) -> Array:
        """Voltages of the inverse dynamics, before the supply limit."""
        features(command, derivative, self._half_track, self._scale, self._features)
        linear(self._features, self.coefficients, self._output)
        return self._output

    def learn(self, feedback: Array, saturated: Array, twist: Array, voltage: Array) -> None:
        """Knows already."""
