"""The motion controller of Kanayama, Kimura, Miyazaki and Noguchi (1990): posture error to requested twist."""

from __future__ import annotations

from math import sqrt
from typing import Annotated

import numpy as np
from pydantic import Field

from mrctl.kernel import Array, Row, kernel
from mrctl.record import Record


class Kanayama(Record):
    """Gains of Kanayama's motion controller; by default `design.motion` finds them for the velocity loops."""

    k_x: Annotated[float, Field(ge=0, le=100)] | None = None
    """Longitudinal gain K_x in 1/s; by default the largest that damping, the limit on V̇ and max |S| allow."""
    k_y: Annotated[float, Field(ge=0, le=1000)] | None = None
    """Lateral gain K_y in 1/m²; by default the largest that damping, the limit on θ̈ and max |S| allow."""
    k_theta: Annotated[float, Field(ge=0, le=100)] | None = None
    """Heading gain K_θ in 1/m; by default 2√K_y, critical damping of the lateral error where θ̇ has no lag."""

    def completed(self, designed: Kanayama) -> Kanayama:
        """Returns all gains: those that are not set are the designed ones, but K_θ is 2√K_y where K_y is set.

        Args:
            designed: Gains that `design.motion` found.
        """
        own = self.model_dump(exclude_none=True)
        if self.k_y is not None:
            own = {"k_theta": 2 * sqrt(self.k_y)} | own
        return designed.model_copy(update=own)


GAINS = np.dtype([("k_x", "f8"), ("k_y", "f8"), ("k_theta", "f8")])  # 1/s, 1/m², 1/m


@kernel
def posture_error(pose: Array, reference: Array, error: Array) -> None:
    """Posture error in the robot's frame, Kanayama et al. 1990, equation (5).

        (x_e, y_e) = R(θ)ᵀ (reference − pose),    θ_e = θ_r − θ in (−π, π]

    Args:
        pose: Posture x, y, θ in m, m, rad, `(3,)`.
        reference: Reference posture in the same units, `(3,)`.
        error: Out: x_e and y_e in m, θ_e in rad, `(3,)`.
    """
    c, s = np.cos(pose[2]), np.sin(pose[2])
    dx, dy = reference[0] - pose[0], reference[1] - pose[1]
    error[0] = c * dx + s * dy
    error[1] = c * dy - s * dx
    error[2] = np.pi - (np.pi - reference[2] + pose[2]) % (2 * np.pi)


@kernel
def kanayama(error: Array, twist: Array, k: Row, request: Array) -> None:
    """Tracking law, Kanayama et al. 1990, equation (8).

        v = v_r cos θ_e + K_x x_e,    ω = ω_r + v_r K_y y_e + |v_r| K_θ sin θ_e

    The paper has v_r in place of |v_r|; in reverse that would amplify the heading error.

    Args:
        error: Posture error x_e, y_e, θ_e in m, m, rad, `(3,)`.
        twist: Reference v_r in m/s and ω_r in rad/s, `(2,)`.
        k: Gains, a record of `GAINS`.
        request: Out: requested v in m/s and ω in rad/s, `(2,)`.
    """
    v, omega = twist[0], twist[1]
    request[0] = v * np.cos(error[2]) + k.k_x * error[0]
    request[1] = omega + v * k.k_y * error[1] + abs(v) * k.k_theta * np.sin(error[2])
