"""Design of the velocity PID, and of the motion controller around it, for a given plant and delay.

The PI controller K_p (1 + 1/(T_i s)) gets the largest integral gain K_i = K_p/T_i with which the loop L keeps these
bounds at its own gain and at every smaller one:

    max |S| ≤ M_s,    max |T| ≤ M_t,    S = 1/(1 + k L),    T = k L/(1 + k L),    0 < k ≤ 1

The largest K_i has the least integrated error after a disturbance (Åström, Panagopoulos and Hägglund 1998, Design of PI
controllers based on non-convex optimization). M_s bounds how close L comes to −1: the gain may grow by M_s/(M_s − 1),
2.7 for 1.6, before the loop is unstable. M_t bounds the overshoot. Smaller gains count because a sagging supply or a
limit of the voltage reduces the gain of the loop.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mrctl.control.kanayama import Kanayama
from mrctl.control.margins import Gains, sampled_loop
from mrctl.kernel import Array
from mrctl.record import InputError
from mrctl.theory import linear
from mrctl.theory.linear import Linear
from mrctl.theory.robot import Robot

M_S, M_T = 1.6, 1.1
"""Largest |S| and |T|: 1.2 to 2 and 1 to 1.5 are usual (Åström and Hägglund, Advanced PID Control, 2006, ch. 4)."""
SPEED_SHARES = 0.5, 0.2, 1.0
"""Shares of the robot's largest speed at which its loops keep the bounds, *chosen*; `mrctl tune` uses the first one."""
MOTION_PEAK_FACTOR = 1.15
"""Largest |S| under the motion controller over the larger one of `M_S` and that of the PID alone, *chosen* in random
worlds: 1.1 makes the position error of PID alone 8 % larger in `field`; 1.2 does not change the gains of `lab`."""
DAMPING = 0.5
"""Damping ratio of the motion controller's loops at the largest speed, *chosen*; it is higher at a lower speed."""
CORRECTED_ERROR = 0.05
"""Longitudinal or lateral error in m whose correction stays within the robot's limits on acceleration, *chosen*."""
PUBLISHED_K_X, PUBLISHED_K_THETA = 10.0, 16.0
"""Gains K_x in 1/s and K_θ in 1/m of Kanayama et al. (1990); upper bounds of the designed ones."""


def points(robot: Robot, rigid: bool, channel: int) -> list[tuple[float, Linear]]:
    """Returns the speeds in m/s at which a channel is designed, and its plant at each.

    They are `SPEED_SHARES`, or only the first in the common channel, where the speed does not matter. The yaw of a
    robot with its centre of mass behind the axle is unstable above some speed. Speeds at which it is unstable are left
    out; if none is left, the slowest has the plant at rest.

    Args:
        robot: The nominal robot in its steering arrangement.
        rigid: Whether the second channel is steering.
        channel: 0 for the common channel, 1 for the second.
    """
    speeds = [share * robot.max_speed for share in SPEED_SHARES]
    if channel == 0:
        return [(speeds[0], linear.common(robot))]
    if rigid:
        return [(speed, linear.steering(robot)) for speed in speeds]
    stable = [(speed, plant) for speed in speeds if (plant := linear.yaw(robot, speed)).stable]
    return stable or [(min(speeds), linear.yaw(robot, 0.0))]


def plants(robot: Robot, rigid: bool, channel: int) -> list[Linear]:
    """Returns the plants of the `points` of a channel; where the speed does not matter, it is one."""
    found = [plant for _, plant in points(robot, rigid, channel)]
    return found[:1] if rigid or channel == 0 else found


@lru_cache(maxsize=256)
def design(robot: Robot, rigid: bool, delay: float, lag: float = 0.0, period: float = 0.01) -> tuple[Gains, Gains]:
    """Designs the PI gains of both channels, in V/(m/s) and V/m and in V/(rad/s) and V/rad, or 1 and 1/s if rigid.

    A design takes about 50 ms; the last 256 are cached.

    Args:
        robot: The nominal robot in its steering arrangement.
        rigid: Whether the second channel is steering.
        delay: Delay from measurement to voltage in s, without that of the hold.
        lag: Time constant in s with which the measured twist follows the true one.
        period: Control period in s.
    """
    electric = robot.inductance / robot.resistance  # s, time constant of the armature, which counts as a lag
    common = fastest_pi(plants(robot, rigid, 0), period, delay, lag + electric)
    second = fastest_pi(plants(robot, rigid, 1), period, delay, lag if rigid else lag + electric)
    return common, second


def fastest_pi(plants: list[Linear], period: float, delay: float, lag: float) -> Gains:
    """Returns the PI gains with the largest K_i that keep `M_S` and `M_T` with every one of some stable plants.

    Args:
        plants: The plants, of positive static gain.
        period: Control period in s.
        delay: Loop delay in s, without that of the hold.
        lag: Time constant of the measurement in s.

    Raises:
        InputError: Every gain keeps the bounds with a loop, as with a steering servo without damping, so that there is
            no largest one.
    """
    from scipy.optimize import minimize_scalar  # imported here, so that settings are read without scipy

    frequency = np.geomspace(1e-4, 1, 500) * np.pi / period * (1 - 1e-9)
    loops = [sampled_loop(frequency, plant, Gains(1.0, 0.0), period, delay, lag) for plant in plants]
    z = np.exp(1j * frequency * period)

    def k_p(logarithm: float) -> float:
        """Returns the largest K_p for the T_i with this natural logarithm."""
        control = 1 + period * z / (z - 1) / np.exp(logarithm)
        return min(_largest_gain(control * loop) for loop in loops)

    longest = 10 * max(period, *(plant.lag for plant in plants))
    with np.errstate(invalid="ignore"):  # where k_p is infinite
        found: Any = minimize_scalar(  # 1/K_i has one minimum
            lambda x: x - np.log(k_p(x)), bounds=(np.log(period / 10), np.log(longest)), method="bounded"
        )
    gain = k_p(found.x)
    if not np.isfinite(gain):
        raise InputError(
            "pid: no PI gains can be designed, because no gain is too large for the model of a loop; a steering servo "
            "without damping, MJCF's default, causes this: give it kv or dampratio"
        )
    return Gains(gain, gain / float(np.exp(found.x)))


def _largest_gain(loop: NDArray[np.complex128]) -> float:
    """Returns the least k at which |S| or |T| of the loop k L reaches its bound at one of the frequencies.

    |1 + k L| = 1/M_s and |k L| = M_t |1 + k L| are quadratic equations in k. A loop that is stable at a small gain is
    stable up to that k, because |S| is infinite where it becomes unstable.
    """
    real, square = loop.real, np.abs(loop) ** 2
    gains = [_least_root(square, 2 * real, 1 - M_S**-2), _least_root((1 - M_T**-2) * square, 2 * real, 1.0)]
    return float(min(gains))


def _least_root(a: Array, b: Array, c: float) -> float:
    """Returns the least positive root of any of the equations a k² + b k + c = 0 with a and c positive."""
    square = b**2 - 4 * a * c
    touching = (square >= 0) & (b < 0)
    return float((2 * c / (np.sqrt(square[touching]) - b[touching])).min(initial=np.inf))


class MotionDesign(NamedTuple):
    """A design of the motion controller.

    Attributes:
        kanayama: Its gains.
        prefilter: Time constant in s of the filter on the velocities that it adds to the reference.
        lag: Lags in s of V and θ̇ behind the velocities that it requests, without the prefilter.
    """

    kanayama: Kanayama
    prefilter: float
    lag: tuple[float, float]


@lru_cache(maxsize=256)
def motion(
    robot: Robot, rigid: bool, gains: tuple[Gains, Gains], delay: float = 0.0, period: float = 0.01,
    prefilter: float | None = None,
) -> MotionDesign:  # fmt: skip
    """Designs the motion controller over the velocity loops: gains and prefilter.

        x:  τ s² + s + K_x = 0,                         ζ = 1/(2 √(K_x τ))
        y:  τ s³ + s² + v_r K_θ s + v_r² K_y = 0,       K_θ = 2 √K_y

    τ is the sum of the lags of the velocity loop and of the prefilter. A velocity loop follows a slow command with the
    lag 1/(K K_i). The steering is commanded to the angle at which the wheel does not scrub, so that the fork makes no
    torque when the robot turns as commanded, and K is that of equation (3) without the fork. A stiff servo (`rigid`)
    follows angle and rate of the command, which leaves the delay and the lag of the tyre.

    For a given time constant T of the prefilter, K_x and √K_y are each the largest within four bounds:

    - The damping ratio ζ is at least `DAMPING` up to the largest speed. K_θ makes the lateral error critically damped
      where τ = 0. With p = τ s and κ = τ v_r √K_y the second equation is p³ + (p + κ)² = 0; its root r e^(jψ) with
      cos ψ = −ζ has √r = −sin ψ/cos(3ψ/2) and κ = r^(3/2) sin(3ψ/2) − r cos ψ.
    - An error e = `CORRECTED_ERROR` does not request more than the limits on acceleration, because a rate limit in the
      loop makes it oscillate: K_x² e ≤ V̇_max, and v² K_y^(3/2) e ≤ θ̈_max, as the loops have the time constants 1/K_x
      and 1/(v √K_y).
    - They are at most those of Kanayama et al. (1990).
    - max |S| of the channel is at most `MOTION_PEAK_FACTOR` · max(M_s, max |S| of the PID alone), for this K_x or √K_y
      and for smaller ones, with and without the model as feedforward (`sensitivity`). The motion controller makes the
      command follow the motion, which is a second feedback with the same delay; the model as feedforward makes it
      stronger.

    T starts at the control period, or at half the lag of the slower velocity loop where that is more, *chosen*, and
    grows in steps of 10 %; the T with the largest K_x √K_y is taken. A slower prefilter lowers max |S| as long as the
    motion loops are well damped, and it lowers the gains that damping allows.

    A design takes 0.03 s, at most 0.2 s; the last 256 are cached. If the PID alone is unstable, the bound on max |S|
    means nothing.

    Args:
        robot: The nominal robot in its steering arrangement.
        rigid: Whether the second channel is steering.
        gains: PI gains of both channels.
        delay: Delay from measurement to voltage in s.
        period: Control period in s.
        prefilter: Time constant of the prefilter in s, if it is given; it is at least the control period.
    """
    _, free = max(points(robot.model_copy(update={"fork_inertia": 0.0}), False, 1), key=lambda point: point[0])
    v_lag = 1 / (linear.common(robot).gain * gains[0].k_i)
    omega_lag = linear.TYRE_LAG + delay if rigid else 1 / (free.gain * gains[1].k_i)
    angle = np.pi - np.arccos(DAMPING)
    root = (np.sin(angle) / np.cos(1.5 * angle)) ** 2
    kappa = root**1.5 * np.sin(1.5 * angle) - root * np.cos(angle)
    turned = robot.max_rotation_acceleration / robot.max_speed**2
    reached = (robot.max_acceleration / CORRECTED_ERROR) ** (1 / 2), (turned / CORRECTED_ERROR) ** (1 / 3)
    shares = np.linspace(0, 1, 21)
    tried = max(period, v_lag / 2, omega_lag / 2) if prefilter is None else max(period, prefilter)
    best, chosen = 0.0, (0.0, 0.0, tried)
    while True:
        damped = 1 / (4 * DAMPING**2 * (v_lag + tried)), kappa / ((omega_lag + tried) * robot.max_speed)
        k_x = min(damped[0], reached[0], PUBLISHED_K_X)
        lateral = min(damped[1], reached[1], PUBLISHED_K_THETA / 2)
        if k_x * lateral <= best:  # by the first three bounds no slower prefilter is better
            break
        kanayama = np.array([shares * k_x, (shares * lateral) ** 2, 2 * shares * lateral])
        peaks = sensitivity(robot, rigid, gains, kanayama, tried, delay, period)
        k_x, lateral = k_x * _kept(shares, peaks[0]), lateral * _kept(shares, peaks[1])
        if k_x * lateral > best:
            best, chosen = k_x * lateral, (k_x, lateral, tried)
        if prefilter is not None:
            break
        tried *= 1.1
    k_x, lateral, found = chosen
    return MotionDesign(Kanayama(k_x=k_x, k_y=lateral**2, k_theta=2 * lateral), found, (v_lag, omega_lag))


def _kept(shares: Array, peaks: Array) -> float:
    """Returns the largest share up to which the peaks keep the bound; the first peak is that of the PID alone."""
    bound = MOTION_PEAK_FACTOR * max(M_S, peaks[0])
    beyond = np.flatnonzero(peaks > bound)
    if beyond.size == 0:
        return float(shares[-1])
    i = beyond[0]
    return float(np.interp(bound, peaks[i - 1 : i + 1], shares[i - 1 : i + 1]))


def sensitivity(
    robot: Robot, rigid: bool, gains: tuple[Gains, Gains], kanayama: Array, prefilter: float,
    delay: float = 0.0, period: float = 0.01,
) -> Array:  # fmt: skip
    """Returns max |S| of both channels under the motion controller, with and without the nominal model as feedforward.

    Each is the largest over the speeds of `points`, dimensionless. The prior `none` is without the model until the
    learner has found it. Lags of armature and measurement (`pid.lag`) are left out.

    Args:
        robot: The nominal robot in its steering arrangement.
        rigid: Whether the second channel is steering.
        gains: PI gains of both channels.
        kanayama: K_x in 1/s, K_y in 1/m² and K_θ in 1/m of one or of several motion controllers, `(3,)` or `(3, N)`.
        prefilter: Time constant of the prefilter in s.
        delay: Delay from measurement to voltage in s, over which the motion is predicted.
        period: Control period in s.

    Returns:
        max |S| of the common and of the second channel, `(2,)` or `(2, N)`.
    """
    share = np.concatenate([np.geomspace(1e-5, 1e-3, 60, endpoint=False), np.geomspace(1e-3, 1, 200)])
    frequency = share * np.pi / period * (1 - 1e-9)
    peaks = []
    for channel in (0, 1):
        own = robot, rigid, channel, gains[channel]
        both = whole_loop(frequency, *own, kanayama, prefilter, delay, period)
        peaks.append(np.max([np.max(np.abs(1 / (1 + loops)), axis=(-2, -1)) for loops in both], axis=0))
    return np.array(peaks)


def whole_loop(
    frequency: Array, robot: Robot, rigid: bool, channel: int, gains: Gains,
    kanayama: Array, prefilter: float, delay: float, period: float,
) -> NDArray[np.complex128]:  # fmt: skip
    """Frequency responses of the loop of one channel under the motion controller, without and with the nominal model.

        L = [C + (C (G − D) + F) Q] P z^(−d),    z = e^(jωh)

    - C is the PI controller, P the plant behind the hold, z^(−d) the delay.
    - Q is the correction that the motion controller requests after a deviation of the velocity, G the prefilter and R
      its rate: G = a z/(z − 1 + a), a = h/T, R = (1 − G/z)/T.
    - F is 0 without the model; with it F = (G + τ R)/K, K and τ of equation (3), or G if the channel is steering.
    - D = h R Σ z^(−p), p = 1 … d, is by how much the predicted velocity is ahead because of the commanded acceleration;
      E and E₂ are the same for its first and its second integral.

    With the integration I = h/2 · (z + 1)/(z − 1), the predicted integrals I₁ = I + d h and I₂ = I² + d h I + (d h)²/2,
    and driving straight on at the speed v,

        common:  Q = K_x I₁/(1 + K_x E);    second:  Q = (v K_θ I₁ + v² K_y I₂)/(1 + v K_θ E + v² K_y E₂)

    Args:
        frequency: ω in rad/s, below π/h, `(F,)`.
        robot: The nominal robot in its steering arrangement.
        rigid: Whether the second channel is steering.
        channel: 0 for the common channel, 1 for the second.
        gains: PI gains.
        kanayama: K_x in 1/s, K_y in 1/m² and K_θ in 1/m, `(3,)` or `(3, N)`.
        prefilter: Time constant T of the prefilter in s.
        delay: Delay d h from measurement to voltage in s.
        period: Control period h in s.

    Returns:
        L(e^(jωh)) without and with the model, at each of the `points`, dimensionless, `(2, points, frequencies)` or
        `(2, N, points, frequencies)`.
    """
    z, late = np.exp(1j * frequency * period), round(delay / period)
    pi = gains.k_p + gains.k_i * period * z / (z - 1)
    a = min(1.0, period / prefilter)
    filtered = a * z / (z - 1 + a)
    rate = (1 - filtered / z) * a / period
    ahead = moved = drifted = np.zeros_like(z)  # D, E and E₂
    for p in range(late, 0, -1):
        middle = ahead + period * rate * z**-p / 2
        drifted = drifted + period * (moved + period * middle / 2)
        moved = moved + period * middle
        ahead = ahead + period * rate * z**-p
    once, horizon = period / 2 * (z + 1) / (z - 1), late * period
    position, drift = once + horizon, once**2 + horizon * once + horizon**2 / 2
    k_x, k_y, k_theta = np.asarray(kanayama, float)[..., None, None]
    if channel == 0:
        request = k_x * position / (1 + k_x * moved)
        static, lag = robot.velocity_gain, robot.velocity_time_constant
    else:
        speed = np.array([speed for speed, _ in points(robot, rigid, channel)])[:, None]
        heading, lateral = speed * k_theta, speed**2 * k_y
        request = (heading * position + lateral * drift) / (1 + heading * moved + lateral * drifted)
        static, lag = robot.rotation_gain, robot.rotation_time_constant
    model = filtered if rigid and channel == 1 else (filtered + lag * rate) / static
    response = _responses(robot, rigid, channel, period, tuple(frequency.tolist())) * z**-late
    parts = [pi + (pi * (filtered - ahead) + forward) * request for forward in (0, model)]
    return np.asarray(response * np.array(parts), complex)


@lru_cache(maxsize=16)  # every prefilter that is tried has the same plants
def _responses(
    robot: Robot, rigid: bool, channel: int, period: float, frequency: tuple[float, ...]
) -> NDArray[np.complex128]:
    """Returns the frequency response of the plant behind the hold at each of the `points`, `(points, frequencies)`."""
    grid = np.array(frequency)
    return np.array([plant.response(grid, period) for _, plant in points(robot, rigid, channel)])
