"""Bandwidth and stability margins of a velocity loop, and the convergence condition of feedback-error learning."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mrctl.kernel import Array
from mrctl.theory.linear import Linear


class Gains(NamedTuple):
    """Proportional and integral gain of one channel."""

    k_p: float
    k_i: float


def sampled_loop(
    frequency: Array, plant: Linear, gains: Gains, period: float, delay: float, lag: float = 0.0
) -> NDArray[np.complex128]:
    """Frequency response of the open velocity loop: PI control, zero-order hold, plant P, delay and lag.

        L = (K_p + K_i h z/(z − 1)) · P(z) · e^(−jωT_d)/(1 + jωT_l),    z = e^(jωh)

    The first factor is the integration of `pid`, the second the plant behind the hold.

    Args:
        frequency: ω in rad/s, below π/h, `(F,)`.
        plant: The plant.
        gains: PI gains K_p and K_i.
        period: Control period h in s.
        delay: Loop delay T_d in s, without that of the hold.
        lag: Time constant T_l of the measurement in s.

    Returns:
        L(e^(jωh)), dimensionless, `(F,)`.
    """
    z = np.exp(1j * frequency * period)
    control = gains.k_p + gains.k_i * period * z / (z - 1)
    late = np.exp(-1j * frequency * delay) / (1 + 1j * frequency * lag)
    return np.asarray(control * plant.response(frequency, period) * late, complex)


class Margins(NamedTuple):
    """Bandwidth and margins of one loop.

    Attributes:
        crossover: Frequency in rad/s at which the loop gain passes through one; of several, that of the phase margin.
            It is NaN, as phase and delay, where there is none.
        phase: Phase margin in degrees, the least angle between L and −1 at all such frequencies; negative if the closed
            loop is unstable.
        gain: Gain margin as a factor, the smallest of all frequencies at which the phase falls through an odd multiple
            of −180°; below one if the loop is unstable, and infinite if the phase never reaches −180°.
        delay: Delay margin in s, the least delay that turns L into −1 at one of the crossovers; if the closed loop is
            unstable, the least delay whose removal does so, as a negative number.
        bandwidth: Frequency in rad/s at which the gain of the closed loop falls through 1/√2; NaN where it does not.
        sensitivity: M_s = max |S| with S = 1/(1 + L), the reciprocal of the least distance of L from −1.
    """

    crossover: float
    phase: float
    gain: float
    delay: float
    bandwidth: float
    sensitivity: float


def margins(frequency: Array, loop: NDArray[np.complex128]) -> Margins:
    """Margins of an open loop on a fine grid of frequencies.

    The closed loop is unstable if the phase falls through an odd multiple of −180° more often than it rises through one
    where the loop gain is above one (Nyquist's criterion for a stable open loop, which may integrate).

    Args:
        frequency: ω in rad/s, ascending, `(F,)`.
        loop: Frequency response of the open loop at these frequencies, `(F,)`.
    """
    magnitude, phase = np.abs(loop), np.unwrap(np.angle(loop))
    phase -= 2 * np.pi * np.round((phase[0] + np.pi / 2) / (2 * np.pi))  # PI control starts between 0 and −180°
    crossover, phase_margin, delay, bandwidth = np.nan, np.nan, np.nan, np.nan
    turns = (phase + np.pi) / (2 * np.pi)  # whole where L is negative
    falls, rises = _inversions(magnitude, turns), _inversions(magnitude, -turns)
    sign = -1.0 if (falls > 1).sum() > (rises > 1).sum() else 1.0
    above = magnitude > 1
    if (k := np.flatnonzero(above[:-1] != above[1:])).size:
        share = (1 - magnitude[k]) / (magnitude[k + 1] - magnitude[k])
        crossovers, left = _between(frequency, k, share), 2 * np.pi * _between(turns, k, share)
        distances = np.abs(left - 2 * np.pi * np.round(left / (2 * np.pi)))
        crossover, phase_margin = crossovers[distances.argmin()], sign * distances.min()
        delay = sign * (sign * left % (2 * np.pi) / crossovers).min()
    passed = np.abs(loop / (1 + loop)) < np.sqrt(0.5)
    if passed.any() and not passed[0]:
        bandwidth = frequency[int(np.argmax(passed))]
    return Margins(
        crossover=float(crossover),
        phase=float(np.degrees(phase_margin)),
        gain=float((1 / falls).min(initial=np.inf)),
        delay=float(delay),
        bandwidth=float(bandwidth),
        sensitivity=float(np.abs(1 / (1 + loop)).max()),
    )


def _inversions(magnitude: Array, turns: Array) -> Array:
    """Returns the loop gains where L is negative and its phase falls; the number of turns, `(F,)`, is whole there."""
    k = np.flatnonzero(np.floor(turns[1:]) < np.floor(turns[:-1]))
    return _between(magnitude, k, (np.floor(turns[k]) - turns[k]) / (turns[k + 1] - turns[k]))


def _between(values: Array, k: NDArray[np.intp], share: Array) -> Array:
    """Interpolates linearly: what lies at these shares of the ways from values k to values k + 1."""
    return values[k] + share * (values[k + 1] - values[k])


def learning_ratio(gain: float, time_constant: float, gains: Gains) -> float:
    """Ratio K_p (1 + K K_p)/(τ K_i); above 1, feedback-error learning converges with PI control of K/(τs + 1).

    This is the condition of Gomi and Kawato (1993), that the complementary sensitivity T be strictly positive real, for
    a plant M V̇ + B V = b U without delay: K_p (B + b K_p) > M K_i, here with M = τ, B = 1 and b = K. It is sufficient
    in mrctl, but not necessary: the PID's integral hands over half of what is learned, so that without delay Re T > −1
    is enough (`mrctl.control.matching`).

    Args:
        gain: K of the plant, in output units per V.
        time_constant: τ in s.
        gains: PI gains K_p and K_i.
    """
    return gains.k_p * (1 + gain * gains.k_p) / (time_constant * gains.k_i)
