"""Recursive least squares on the 8 physical features, taught by the feedback voltage."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from numba import float64, guvectorize
from numpy.typing import NDArray
from pydantic import Field

from mrctl.control.feedforward import STEERING_SHARE, Array, feature_scale, features, linear
from mrctl.record import Record
from mrctl.theory.robot import Robot


class Rls(Record):
    """Settings of the `rls` feedforward."""

    step: Annotated[float, Field(gt=0, le=1)] = 0.02
    """Largest share of the feedback that one control period moves into the feedforward, as for `fel`: beyond it the
    adaptation is a second integral action fast enough to shake the loop."""
    initial_covariance: Annotated[float, Field(gt=0, le=1e3)] = 0.2
    """Diagonal of the initial covariance of the coefficients, relative to the variance of the feedback."""
    drift: Annotated[float, Field(ge=0, le=1)] = 3e-5
    """Variance that every coefficient gains each control period: how fast the truth may wander."""
    covariance_bound: Annotated[float, Field(gt=0, le=1e3)] = 0.2
    """A diagonal element above this gains no more; without excitation it would grow for ever."""
    dead_zone: Annotated[float, Field(ge=0, le=5)] = 0.02
    """Feedback below this teaches nothing, V (rad/s on a steering channel)."""


@guvectorize(
    [(float64[:], float64[:], float64, float64[:], float64[:, :], float64[:, :], float64[:])],
    "(f),(u),(),(s),(f,u),(f,f),()",
    writable_args=("coefficients", "covariance", "norm"),
    cache=True,
)
def update(x, feedback, saturated, settings, coefficients, covariance, norm):  # noqa: ANN001, ANN201
    """One recursive step whose innovation is the feedback voltage, for one robot.

    Recursive least squares for drifting coefficients (Ljung 1999, section 11.2): the Kalman filter of a random walk.
    Exponential forgetting would inflate the directions that a lap never excites and starve the others at the bound.

    Args:
        x: Scaled features `(8,)`.
        feedback: `(2,)`.
        saturated: 1 freezes everything.
        settings: Drift, covariance bound, dead zone, share of channel two, step, `(5,)`.
        coefficients: In and out, `(8, 2)`.
        covariance: In and out, `(8, 8)`.
        norm: Out: Euclidean norm of the coefficients.
    """
    drift, bound, dead_zone = settings[0], settings[1], settings[2]
    if saturated > 0 or (abs(feedback[0]) <= dead_zone and abs(feedback[1]) <= dead_zone):
        return
    n = x.shape[0]
    gain = np.empty(n)
    power = 0.0
    for i in range(n):
        gain[i] = 0.0
        for j in range(n):
            gain[i] += covariance[i, j] * x[j]
        power += x[i] * gain[i]
    total = max(1.0 + power, power / settings[4])  # the measurement is taken to be as noisy as the step asks
    for i in range(n):
        for j in range(n):
            covariance[i, j] -= gain[i] * gain[j] / total
        if covariance[i, i] < bound:
            covariance[i, i] += drift
        for k in range(2):
            if abs(feedback[k]) > dead_zone:
                share = settings[3] if k == 1 else 1.0
                coefficients[i, k] += share * gain[i] / total * feedback[k]
    norm[0] = np.sqrt((coefficients**2).sum())


class RecursiveLeastSquares:
    """`rls` for B robots: U_ff = θᵀ features, θ from zero.

    Attributes:
        state: `coefficients` `(B, 8, 2)` and `covariance` `(B, 8, 8)`.
        weight_norm: Euclidean norm of the coefficients, `(B,)`.
        weight_volts: The coefficients are in volts.
    """

    weight_volts = 1.0

    def __init__(self, robot: Robot, settings: list[Rls], rigid: bool) -> None:
        """Takes the nominal robot (for the scales alone), settings a row, and whether channel two is steering."""
        size = len(settings)
        self._half_track = robot.half_track
        self._scale = feature_scale(robot)
        share = STEERING_SHARE if rigid else 1.0
        self._settings = np.array([[s.drift, s.covariance_bound, s.dead_zone, share, s.step] for s in settings])
        self._features, self._output = np.zeros((size, 8)), np.zeros((size, 2))
        self.weight_norm = np.zeros(size)
        self._covariance = np.array([s.initial_covariance * np.eye(8) for s in settings])
        self.state = {
            "coefficients": np.zeros((size, 8, 2)),
            "covariance": self._covariance.copy(),
        }

    def restore(self, rows: NDArray[np.intp]) -> None:
        """Takes robots back to the start."""
        self.state["coefficients"][rows], self.weight_norm[rows] = 0.0, 0.0
        self.state["covariance"][rows] = self._covariance[rows]

    def output(self, command: Array, derivative: Array) -> Array:
        """θᵀ features of the commanded motion."""
        features(command, derivative, self._half_track, self._scale, self._features)
        linear(self._features, self.state["coefficients"], self._output)
        return self._output

    def learn(self, feedback: Array, saturated: Array, twist: Array, voltage: Array) -> Array:
        """One recursive step; returns what it added to the last output."""
        state = self.state
        update(
            self._features, feedback, saturated, self._settings, state["coefficients"], state["covariance"],
            self.weight_norm,
        )  # fmt: skip
        before = self._output.copy()
        linear(self._features, state["coefficients"], self._output)
        return self._output - before
