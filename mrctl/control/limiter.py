"""Velocity and acceleration limits on the command, and the prefilter that yields its derivative."""

from __future__ import annotations

from numba import float64, guvectorize

CORRECTION, COMMAND = slice(0, 2), slice(2, 4)  # parts of the state


@guvectorize(
    [(float64[:], float64[:], float64[:], float64[:], float64, float64, float64[:], float64[:], float64[:])],
    "(u),(u),(u),(l),(),(),(m),(u),(u)",
    writable_args=("state", "command", "derivative"),
    cache=True,
)
def limit(request, twist, acceleration, limits, time_constant, period, state, command, derivative):  # noqa: ANN001, ANN201
    """Limits a requested twist as Kanayama et al. (1990), each of v, ω, v̇, ω̇ by itself.

    Only what the request adds to the reference is low-pass filtered: the reference brings its own derivative, so it
    passes without lag. With a zero reference and `time_constant` = `period` this is his limiter alone.

    Args:
        request: Requested v, ω, `(2,)` in m/s, rad/s.
        twist: Reference twist `(2,)`.
        acceleration: Its derivative `(2,)`.
        limits: Largest |v|, |ω|, |v̇|, |ω̇|, `(4,)`.
        time_constant: Of the filter on the correction, s, at least `period`.
        period: Control period, s.
        state: In and out: filtered correction `(2,)` and last command `(2,)`.
        command: Out: limited twist `(2,)`.
        derivative: Out: its derivative `(2,)`.
    """
    for i in range(2):
        rate = (request[i] - twist[i] - state[i]) / time_constant
        wish = twist[i] + state[i] + period * rate
        reach = limits[2 + i] * period
        bounded = max(-limits[i], min(limits[i], max(state[2 + i] - reach, min(state[2 + i] + reach, wish))))
        if bounded == wish:
            derivative[i] = max(-limits[2 + i], min(limits[2 + i], acceleration[i] + rate))
        else:
            derivative[i] = (bounded - state[2 + i]) / period
        state[i] = bounded - twist[i]
        state[2 + i] = bounded
        command[i] = bounded
