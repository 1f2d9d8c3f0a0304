"""Recursive least squares on the 8 physical features and the heading, taught by the feedback voltage.

The weights of cosine and sine of the heading are gravity on a slope of any direction. As in `fel`, they are there on
top of a model alone: where everything has to be learned, they would take a share of each step from what matters more.
"""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from mrctl.control.algebra import dot, linear, symmetric_product
from mrctl.control.features import FEATURES, REGRESSORS, dead_reckoned, feature_scale, regressor
from mrctl.control.feedforward import STEERING_SHARE, Learner, Loop, Shown
from mrctl.control.matching import histories, recall
from mrctl.kernel import Array, Row, kernel
from mrctl.record import Record


@kernel
def update(x: Array, feedback: Array, s: Row) -> None:
    """One step of recursive least squares whose innovation is the feedback voltage e.

        K = P x / max(1 + xᵀ P x, xᵀ P x / step),    θ ← θ + K eᵀ,    P ← P − K (P x)ᵀ + drift · 1

    This is recursive least squares for drifting coefficients (Ljung 1999, section 11.2), the Kalman filter of a random
    walk. Exponential forgetting would inflate P in the directions that a lap never excites and starve the others at the
    bound. The second denominator limits xᵀ K, the share of e that moves into the output at x, to `step`.

    Args:
        x: Scaled features, and the heading, `(10,)`.
        feedback: e in V (rad/s on a steering channel), `(2,)`.
        s: In and out: a record of `RLS`.
    """
    if abs(feedback[0]) <= s.dead_zone and abs(feedback[1]) <= s.dead_zone:
        return
    symmetric_product(s.P, x, s.gain)
    power = dot(x, s.gain)
    total = max(1.0 + power, power / s.step)
    for i in range(REGRESSORS):
        for j in range(REGRESSORS):
            s.P[i, j] -= s.gain[i] * s.gain[j] / total
        if s.P[i, i] < s.bound:
            s.P[i, i] += s.drift
        for k in range(2):
            if abs(feedback[k]) > s.dead_zone:
                s.theta[i, k] += s.share[k] * s.gain[i] / total * feedback[k]
    s.norm = np.sqrt((s.theta**2).sum())


@kernel
def respond(i: int, command: Array, derivative: Array, robot: Row, arrays: tuple[Any, ...], voltage: Array) -> None:
    """U = θᵀ x at the commanded motion."""
    rows, scale, _ = arrays
    s = rows[i]
    regressor(command, derivative, s.direction, robot.half_track, scale, s.x)
    linear(s.x, s.theta, voltage)


@kernel
def learn(i: int, shown: Shown, robot: Row, prior: Row, arrays: tuple[Any, ...], added: Array) -> float:
    """One step of `update` on the features of the output that the feedback answers, unless it must not learn."""
    s = arrays[0][i]
    linear(s.x, s.theta, added)
    before, before_second = added[0], added[1]
    answered = recall(s.x, arrays[2][i], s)
    if shown.frozen == 0 and answered:
        update(s.past, shown.feedback, s)
        linear(s.x, s.theta, added)
    added[0] -= before
    added[1] -= before_second
    if s.has_heading > 0:
        s.heading = dead_reckoned(s.heading, shown.twist[1], shown.period, s.direction)
    return s.norm


RLS = np.dtype(
    [
        ("step", "f8"),  # largest share of the feedback that one period moves into the feedforward
        ("drift", "f8"),  # variance that a coefficient gains with each step
        ("bound", "f8"),  # diagonal element of P above which it gains no more
        ("dead_zone", "f8"),  # feedback below which nothing is learned, V (rad/s on a steering channel)
        ("share", "f8", 2),  # factor on the gain in the two channels; a steering channel learns more slowly
        ("has_heading", "f8"),  # 1 where a model is the prior, else 0
        ("heading", "f8"),  # by dead reckoning, rad
        ("direction", "f8", 2),  # its cosine and sine; zero without a model
        ("x", "f8", REGRESSORS),  # scaled features of the commanded motion, and the direction
        ("tick", "i8"),  # number of ticks so far
        ("past", "f8", REGRESSORS),  # x of the output that the feedback answers
        ("theta", "f8", (REGRESSORS, 2)),  # θ: coefficients of x in the two channels, V
        ("P", "f8", (REGRESSORS, REGRESSORS)),  # covariance of θ over the variance of the feedback
        ("gain", "f8", REGRESSORS),  # P x
        ("norm", "f8"),  # ‖θ‖, V
    ],
    align=True,
)


class Rls(Record):
    """Settings of the learner `rls`."""

    step: Annotated[float, Field(gt=0, le=1)] = 0.02
    """Largest share of the feedback that one control period moves into the feedforward; on a steering channel a tenth
    of this number. With a larger share, the adaptation is a second integral action that is fast enough to make the loop
    oscillate."""
    initial_covariance: Annotated[float, Field(gt=0, le=1e3)] = 0.2
    """Diagonal of the initial covariance of the coefficients, as a ratio to the variance of the feedback."""
    drift: Annotated[float, Field(ge=0, le=1)] = 3e-5
    """Variance that every coefficient gains with each step of learning, as a ratio to the variance of the feedback; it
    states how fast the true coefficients wander."""
    covariance_bound: Annotated[float, Field(gt=0, le=1e3)] = 0.2
    """Ratio of a diagonal element of the covariance to the variance of the feedback, above which that element gains no
    more; without excitation it would grow for ever."""
    dead_zone: Annotated[float, Field(ge=0, le=5)] = 0.02
    """Feedback in V (rad/s on a steering channel) below which nothing is learned."""


class RecursiveLeastSquares(Learner):
    """The learner `rls` for B robots: U_ff = θᵀ x, with θ = 0 at the start.

    Attributes:
        rows: One record of `RLS` a robot.
    """

    respond, learn_one, record, learned = respond, learn, RLS, ("theta", "P")

    def __init__(self, loop: Loop, settings: list[Rls]) -> None:
        """Takes the loop, and the settings of each robot."""
        super().__init__(loop, settings)
        rows = self.rows
        rows["step"], rows["drift"] = [s.step for s in settings], [s.drift for s in settings]
        rows["bound"], rows["dead_zone"] = [s.covariance_bound for s in settings], [s.dead_zone for s in settings]
        rows["share"] = 1.0, STEERING_SHARE if loop.rigid else 1.0
        self._covariance = np.array([s.initial_covariance * np.eye(REGRESSORS) for s in settings])
        rows["P"] = self._covariance
        rows["has_heading"] = rows["direction"][:, 0] = loop.has_prior
        self.arrays = rows, feature_scale(loop.robot), histories(len(settings), loop.delay, REGRESSORS)

    @property
    def parameters(self) -> Array:
        """Learned coefficients of the scaled features, `(B, 8, 2)` in V."""
        return self.rows["theta"][:, :FEATURES].copy()

    def adopt(self, row: int, learned: Array) -> None:
        """Does as `Learner.adopt`, but leaves out the slope, which belongs to another place."""
        super().adopt(row, learned)
        s, slope = self.rows[row], slice(FEATURES, None)
        s["theta"][slope] = s["P"][slope] = s["P"][:, slope] = 0.0
        s["P"][slope] = self._covariance[row, slope]
        s["norm"] = np.linalg.norm(s["theta"])

    def restore(self, rows: NDArray[np.intp]) -> None:
        """Resets robots to zero coefficients and the initial covariance."""
        self.rows["theta"][rows], self.rows["norm"][rows], self.weight_norm[rows] = 0.0, 0.0, 0.0
        self.rows["tick"][rows], self.rows["P"][rows] = 0, self._covariance[rows]
