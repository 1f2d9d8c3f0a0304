"""Velocity and acceleration limits on the requested twist, and the prefilter that gives the command a derivative."""

from __future__ import annotations

import numpy as np

from mrctl.kernel import Array, Row, kernel

LIMITER = np.dtype(
    [
        ("time_constant", "f8"),  # T of the filter on the correction, at least the control period, s
        ("correction", "f8", 2),  # c: filtered part of the request beyond the reference twist, m/s and rad/s
        ("command", "f8", 2),  # commanded V and θ̇, m/s and rad/s
        ("derivative", "f8", 2),  # their derivatives, m/s² and rad/s²
    ],
    align=True,
)


@kernel
def limit(
    request: Array, twist: Array, acceleration: Array, max_twist: Array, max_acceleration: Array, period: float, s: Row
) -> None:
    """Filters and limits a requested twist; v and ω are treated separately, as by Kanayama et al. (1990).

        ċ = (u − u_r − c)/T,    u_c = u_r + c,    u̇_c = u̇_r + ċ,    |u_c| ≤ u_max,    |u̇_c| ≤ a_max

    with the request u, the reference u_r and the command u_c. The filter acts only on the correction c, which the
    request adds to the reference: the derivative of the reference is known, so the reference passes without lag. Where
    a limit acts, c becomes u_c − u_r, and u̇_c the difference quotient of the command. With a zero reference and T equal
    to the control period, this is Kanayama's limiter alone.

    Args:
        request: Requested v in m/s and ω in rad/s, `(2,)`.
        twist: Reference twist in m/s and rad/s, `(2,)`.
        acceleration: Its derivative in m/s² and rad/s², `(2,)`.
        max_twist: Largest |v| in m/s and |ω| in rad/s, `(2,)`.
        max_acceleration: Largest |v̇| in m/s² and |ω̇| in rad/s², `(2,)`.
        period: Control period in s.
        s: In and out: a record of `LIMITER`, whose `command` and `derivative` are the result.
    """
    for k in range(2):
        rate = (request[k] - twist[k] - s.correction[k]) / s.time_constant
        wanted = twist[k] + s.correction[k] + period * rate
        step = max_acceleration[k] * period
        bounded = max(-max_twist[k], min(max_twist[k], max(s.command[k] - step, min(s.command[k] + step, wanted))))
        if bounded == wanted:
            s.derivative[k] = max(-max_acceleration[k], min(max_acceleration[k], acceleration[k] + rate))
        else:
            s.derivative[k] = (bounded - s.command[k]) / period
        s.correction[k] = bounded - twist[k]
        s.command[k] = bounded
