"""Sustained oscillations: half-waves of a voltage in a row, which `guard` and `delay` both look for.

The loops are designed with damping ratios of at least 0.5: after a push a half-wave has at most a sixth of the
amplitude of the one before it. Many in a row are fed by something.
"""

from __future__ import annotations

import numpy as np

from mrctl.kernel import Row, kernel

NOISE_FILTER, DRIFT_FILTER = 0.01, 0.3  # s, time constants of the filters that remove noise and slow motion

SWING = np.dtype(
    [
        ("low_pass", "f8", 2),  # the signal without noise, V (rad/s on a steering channel)
        ("slow_mean", "f8", 2),  # its slow mean, V (rad/s)
    ],
    align=True,
)
HALF_WAVES = np.dtype(
    [
        ("sign", "f8", 2),  # of the present half-wave
        ("peak", "f8", 2),  # its amplitude, V (rad/s)
        ("duration", "f8", 2),  # its duration so far, s
        ("count", "f8", 2),  # consecutive half-waves above the threshold
    ],
    align=True,
)


@kernel
def swing(value: float, k: int, period: float, s: Row) -> float:
    """Returns a signal of channel k without noise and slow motion; `s` is a record of `SWING`, in and out."""
    s.low_pass[k] += period / (NOISE_FILTER + period) * (value - s.low_pass[k])
    s.slow_mean[k] += period / (DRIFT_FILTER + period) * (s.low_pass[k] - s.slow_mean[k])
    return s.low_pass[k] - s.slow_mean[k]


@kernel
def count_half_waves(wave: float, k: int, least: float, slowest: float, period: float, s: Row) -> None:
    """Counts the half-waves in a row that are larger than `least`, and not longer than `slowest` in s.

    Args:
        wave: A signal of channel k, as from `swing`.
        k: Index of the channel.
        least: Least amplitude, in the units of `wave`.
        slowest: Longest duration of a half-wave in s.
        period: Control period in s.
        s: In and out: a record of `HALF_WAVES`.
    """
    sign = 1.0 if wave >= 0 else -1.0
    if sign != s.sign[k] or s.duration[k] > slowest:
        counts = s.duration[k] <= slowest and s.peak[k] > least
        s.count[k] = s.count[k] + 1.0 if counts else 0.0
        s.sign[k], s.peak[k], s.duration[k] = sign, 0.0, 0.0
    s.peak[k] = max(s.peak[k], abs(wave))
    s.duration[k] += period
