"""Slip of the driven wheels, from encoders and the estimated motion."""

from __future__ import annotations

from mrctl.kernel import Array, kernel

SLIP_FILTER = 0.1  # s, time constant of the low-pass
SLIP_SPEED = 0.3  # m/s, least divisor of a slip, so that noise does not count as slip at rest


@kernel
def slip_ratio(
    rates: Array, v: float, omega: float, wheel_radius: float, half_track: float, period: float, slip: float
) -> float:
    """Slip ratio of the driven wheel that slips more, behind a first-order low-pass.

        |v_i − u_i| / max(|v_i|, |u_i|, 0.3 m/s),    v_i = r φ̇_i,    u_l,r = V ∓ D θ̇

    where v_i is the circumferential speed of a wheel from its encoder, and u_i the speed of its axle over the floor by
    the motion that is estimated for the same time. The low-pass prevents a jolt from counting as slip, and prolongs a
    slip until it has left the filters of a learner. Odometry, whose V is the mean of the encoders, shows about half of
    the slip of one wheel. A relative error of the wheel radius appears as a slip ratio of the same size, and noise of
    one wheel, of V or of D θ̇ as one of 0.8 of its standard deviation over the speed; the same noise of both wheels
    gives 1.1, and that of V and D θ̇ 1.6 of it, as the larger ratio counts.

    Args:
        rates: φ̇ left and right from the encoders in rad/s, `(2,)`.
        v: Estimated V in m/s.
        omega: Estimated θ̇ in rad/s.
        wheel_radius: Nominal r in m.
        half_track: D in m.
        period: Control period in s.
        slip: Slip ratio of the last period.

    Returns:
        Slip ratio of this period, dimensionless.
    """
    worst = 0.0
    for k in range(2):
        rolled, carried = wheel_radius * rates[k], v + (2 * k - 1) * half_track * omega
        worst = max(worst, abs(rolled - carried) / max(abs(rolled), abs(carried), SLIP_SPEED))
    return slip + period / (period + SLIP_FILTER) * (worst - slip)
