"""Velocity and acceleration limits on the command, and the prefilter that yields its derivative."""

from __future__ import annotations

import numpy as np

from mrctl.kernel import Array, Row, kernel

LIMITER = np.dtype(
    [
        ("time_constant", "f8"),  # of the filter on the correction, at least the control period, s
        ("correction", "f8", 2),  # filtered part of the request beyond the reference twist, m/s and rad/s
        ("command", "f8", 2),  # commanded V and θ̇, m/s and rad/s
        ("derivative", "f8", 2),  # their derivatives, m/s² and rad/s²
    ],
    align=True,
)


@kernel
def limit(
    request: Array, twist: Array, acceleration: Array, max_twist: Array, max_acceleration: Array, period: float, s: Row
) -> None:
    """Limits a requested twist as Kanayama et al. (1990), each of v, ω, v̇, ω̇ by itself.

    Only what the request adds to the reference is low-pass filtered: the reference brings its own derivative, so it
    passes without lag. With a zero reference and `time_constant` = `period` this is his limiter alone.

    Args:
        request: Requested v, ω, `(2,)` in m/s, rad/s.
        twist: Reference twist `(2,)`.
        acceleration: Its derivative `(2,)`.
        max_twist: Largest |v| and |ω|, `(2,)`.
        max_acceleration: Largest |v̇| and |ω̇|, `(2,)`.
        period: Control period, s.
        s: In and out: a record of `LIMITER`, whose `command` and `derivative` are the result.
    """
    for k in range(2):
        rate = (request[k] - twist[k] - s.correction[k]) / s.time_constant
        wish = twist[k] + s.correction[k] + period * rate
        reach = max_acceleration[k] * period
        bounded = max(-max_twist[k], min(max_twist[k], max(s.command[k] - reach, min(s.command[k] + reach, wish))))
        if bounded == wish:
            s.derivative[k] = max(-max_acceleration[k], min(max_acceleration[k], acceleration[k] + rate))
        else:
            s.derivative[k] = (bounded - s.command[k]) / period
        s.correction[k] = bounded - twist[k]
        s.command[k] = bounded
