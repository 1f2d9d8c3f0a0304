"""The motion controller of Kanayama, Kimura, Miyazaki and Noguchi (1990)."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from numba import float64, guvectorize, njit
from pydantic import Field

from mrctl.record import Record


class Kanayama(Record):
    """Gains of the motion controller."""

    k_x: Annotated[float, Field(ge=0, le=100)] = 3.0
    """Longitudinal gain in 1/s."""
    k_y: Annotated[float, Field(ge=0, le=1000)] = 25.0
    """Lateral gain in 1/m²."""
    k_theta: Annotated[float, Field(ge=0, le=100)] = 10.0
    """Heading gain in 1/m; 2√k_y is critical damping."""


@njit(cache=True)
def _error(pose, reference, error):  # noqa: ANN001, ANN202
    c, s = np.cos(pose[2]), np.sin(pose[2])
    dx, dy = reference[0] - pose[0], reference[1] - pose[1]
    error[0] = c * dx + s * dy
    error[1] = c * dy - s * dx
    error[2] = np.pi - (np.pi - reference[2] + pose[2]) % (2 * np.pi)


@guvectorize([(float64[:], float64[:], float64[:])], "(p),(p)->(p)", cache=True)
def posture_error(pose, reference, error):  # noqa: ANN001, ANN201
    """Posture error of one robot in its own frame: longitudinal, lateral in m, heading in (−π, π] rad.

    Kanayama et al. 1990, equation (5).
    """
    _error(pose, reference, error)


@guvectorize(
    [(float64[:], float64[:], float64[:], float64[:], float64[:], float64[:])],
    "(p),(p),(u),(p)->(p),(u)",
    cache=True,
)
def kanayama(pose, reference, reference_twist, gains, error, request):  # noqa: ANN001, ANN201
    """Tracking law, Kanayama et al. 1990, equations (5) and (8), for one robot.

    In reverse |v_r| multiplies the K_θ term: with v_r itself the heading error would be amplified.

    Args:
        pose: Measured posture `(3,)`, m and rad.
        reference: Reference posture `(3,)`.
        reference_twist: v_r in m/s and ω_r in rad/s, `(2,)`.
        gains: K_x, K_y, K_θ, `(3,)`.
        error: Out: longitudinal, lateral in m and heading error in rad, in the robot's frame.
        request: Out: requested v in m/s and ω in rad/s.
    """
    _error(pose, reference, error)
    v, omega = reference_twist[0], reference_twist[1]
    request[0] = v * np.cos(error[2]) + gains[0] * error[0]
    request[1] = omega + v * gains[1] * error[1] + abs(v) * gains[2] * np.sin(error[2])
