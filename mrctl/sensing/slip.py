"""Slip of the driven wheels, as encoders and the measured motion show it."""

from __future__ import annotations

from mrctl.kernel import Array, kernel

SLIP_FILTER = 0.1  # s
SLIP_SPEED = 0.3  # m/s that a slip is held against at least: noise is no slip of a wheel that stands


@kernel
def slip_ratio(wheel_speeds: Array, twist: Array, half_track: float, period: float, slip: float) -> float:
    """Slip ratio of the driven wheel that slips more, behind a first-order low-pass.

        |v_i − u_i| / max(|v_i|, |u_i|, 0.3 m/s),    u_l,r = V ∓ D θ̇

    where v_i is the speed of a wheel by its encoder and u_i how fast the measured motion carries it over the floor. The
    low-pass keeps a jolt from passing for slip, and lets a slip last until what a learner's filters hold of it is gone.
    Odometry, whose V is the mean of the encoders, shows about half of what one wheel slips. A radius that is wrong by
    some percent is a slip of as much, and noise one of 0.8 of its standard deviation over the speed.

    Args:
        wheel_speeds: v left and right, by the encoders and the nominal wheel radius in m/s, `(2,)`.
        twist: Measured V in m/s and θ̇ in rad/s `(2,)`.
        half_track: D in m.
        period: Control period in s.
        slip: The slip ratio of one period before.
    """
    worst = 0.0
    for k in range(2):
        carried = twist[0] + (2 * k - 1) * half_track * twist[1]
        speed = max(abs(wheel_speeds[k]), abs(carried), SLIP_SPEED)
        worst = max(worst, abs(wheel_speeds[k] - carried) / speed)
    return slip + period / (period + SLIP_FILTER) * (worst - slip)
