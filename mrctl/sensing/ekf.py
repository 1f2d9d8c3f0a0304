"""An extended Kalman filter of posture, twist, sensor biases and wheel radii, with posture fixes that arrive late.

    x = (x, y, θ, V, θ̇, b, o, λ_l, λ_r, s_l, s_r)

    (ẋ, ẏ) = V (cos θ, sin θ) + v_y (−sin θ, cos θ),    v_y = −c V θ̇,  c = `SIDE_SLIP_TIME`
    V̇ = a − o,    θ̈ = θ̈_c,    λ̇_l,r = (u_l,r − κ u̇_l,r)/(r (1 + s_l,r ± ρ a_y)),    u_l,r = V ∓ D θ̇
    b, o and s constant;    each plus noise

    encoder_l,r = λ_l,r + quantisation,    gyro = θ̇ + b + noise,    fix = (x, y, θ) + noise

b is the bias of the gyro, and s_l,r are the relative errors of the wheel radii. Bias and radii hardly change. The radii
become uncertain where encoders and gyro contradict each other although no wheel can slip (`find_radius`), and radii,
bias and posture where the fixes contradict dead reckoning (`find_drift`). The accelerometer a, corrected for its place
ahead of the axle, is an input; its offset o is the sum of its bias and a component of gravity. θ̈_c is the commanded
acceleration that acts in the period. κ and ρ are `lag` and `load` of the tyres (`theory.robot.Tyres`), and the
accelerometer measures a_y, too. The wheel angles λ are part of the state, so that the error of an encoder stays bounded
in angle; modelled as noise on V, it would become a random walk of the position. The noise of a and θ̈ moves the
positions of the same period, so that an encoder sees it at once. A fix corrects the state at the time when it was
taken: the filter stores that state, and repeats the periods since then.
"""

from __future__ import annotations

import numpy as np

from mrctl.kernel import Array, Row, Rows, kernel
from mrctl.sensing.prediction import predict, settle, wrapped

N = 11  # number of states
X, Y, THETA, V, OMEGA, BIAS, OFFSET, LEFT, RIGHT, SCALE_LEFT, SCALE_RIGHT = range(N)
MAX_STORED = 5  # largest number of states that are stored for fixes that have not arrived

# Process noise. All values but JOLT_SLIP are chosen, and tests check them by the filter's error (NEES, chi-square).
YAW_NOISE = 0.1  # deviation from the commanded θ̈, rad/s²/√Hz
OFFSET_SETTLING = 1.5  # s, time in which o follows the faster offset of `find_grip`
SLIPPING_NOISE = 0.5  # further noise of V̇ while no wheel grips, m/s²/√Hz
INCLINE_WALK = 0.012  # random walk of the component of gravity in the accelerometer, m/s²/√s
SIDE_SLIP, SKID = 3e-5, 0.02  # lateral motion of the rear axle beyond v_y, while both wheels grip and otherwise, m/√s
JOLT_SLIP = 1e-3  # slip of a tyre while its force jumps, rad/(m/s²); measured where a motor's current jumps by 4.7 A
SLIDE_NOISE = 7e-4  # slip of a wheel that grips and carries all of the force, because the other one slips, m/√s
JUMP_SIGMAS = 3.0  # standard deviations; a jump is the part of a change of the acceleration that exceeds them
# s at the start in which the tyres take up their load, and the jolt that it counts as, m/s²
LOADING_TIME, LOADING_JOLT = 0.1, 2.0
START_RADIUS = 0.01  # standard deviation of the relative error of a wheel's radius at the start
RADIUS_WALK = 5e-6  # random walk of that error, 1/√s
RADIUS_DOUBT = 0.1  # standard deviation of that error where a radius has changed, at most; chosen
CALM_ACCELERATION = 0.5  # m/s², acceleration below which no force makes a wheel slip; chosen
START_OFFSET = 0.2  # standard deviation of the component of gravity in the accelerometer at the start, m/s²
START_TWIST = 0.02, 0.02  # standard deviations of V in m/s and θ̇ in rad/s at the start

# s, side-slip of the rear axle's path over θ̇: m/C, where C in N·s/m is the side force of the rear tyres over their
# lateral velocity, less half the physics step (`physics.mjcf` says why); measured on the models of this package.
SIDE_SLIP_TIME = 0.94e-3
FIX_GATE = 16.27  # 99.9 % of chi-square with 3 degrees of freedom
LOST_FIXES = 10  # the tenth fix in a row outside the gate is accepted
LOST_DEVIATION = 0.5  # m and rad, standard deviation that is added to the posture before
INNOVATION_FIXES = 30  # fixes, time constant of the running mean of their innovations; chosen
DRIFT_SIGMAS = 4.5  # standard deviations of that mean above which dead reckoning drifts; chosen
SLIP_SIGMAS = 6.0  # standard deviations of the innovation of an encoder, above which its wheel has slipped; chosen
SLIPPING_SPEED = 0.08  # m/s, difference of encoder and inertial speed of a wheel above which it slips
GRIP_DIFFERENCE = 2e-3  # m/s, difference of the slip of two wheels that grip
RADIUS_AVERAGE = 1.0  # s, time constant of the mean of the wheels' difference, by which another radius is found; chosen
# m/s² and rad/s², standard deviations of V̇ and of the mean θ̈ from where the last sample of a slow sensor was taken to
# where it is used; chosen
HELD_NOISE = 0.5, 1.0
MISS_AVERAGE = 1.0  # s, time constant of the mean square by which predictions over the latency miss; chosen
OBSERVER_BANDWIDTH = 5.0  # rad/s, bandwidth of the observer that compares encoders with the accelerometer

EKF = np.dtype(
    [
        ("mean", "f8", N),  # estimate of x, in the order and units above
        ("P", "f8", (N, N)),  # its covariance
        ("kept_mean", "f8", (MAX_STORED, N)),  # estimates at the ticks of fixes that have not arrived
        ("kept_P", "f8", (MAX_STORED, N, N)),  # their covariances, in the squared units above
        ("kept_tick", "i8", MAX_STORED),  # these ticks
        ("g", "f8", N),  # scratch: covariance of the state with a measurement, or its derivative by an input
        ("encoder_variance", "f8"),  # rad²
        ("gyro_variance", "f8"),  # (rad/s)²
        ("bias_variance", "f8"),  # of the gyro at the start, (rad/s)²
        ("bias_walk", "f8"),  # of the gyro, rad/s/√s
        ("acceleration_variance", "f8"),  # of a sample, (m/s²)²
        ("offset_walk", "f8"),  # of o, m/s²/√s
        ("fix_variance", "f8", 3),  # m², m², rad²
        ("inertial", "f8"),  # V from accelerometer and the wheels that grip, m/s
        ("offset", "f8"),  # offset o of the accelerometer as the observer of `find_grip` estimates it, m/s²
        ("since", "f8", 3),  # number of ticks since the last encoder sample, sums of V in m/s and θ̇ in rad/s over them
        ("grip", "u1", 2),  # whether the wheels gripped at the last encoder sample, left and right
        ("difference", "f8"),  # mean of left less right wheel's speed by its encoder, less that by the gyro, m/s
        ("drift", "f8", 2),  # running means for `find_drift`: of the position along the heading, and of the heading
        ("drift_bound", "f8"),  # on these means; infinite where the fixes are not independent of encoders and gyro
        ("refused", "i8"),  # number of fixes rejected in a row
        ("nis", "f8"),  # normalised innovation squared of the last fix, chi-square with 3 degrees of freedom
        ("missed", "f8", 2),  # mean square by which predictions over the latency miss V and θ̇, (m/s)² and (rad/s)²
        ("ahead", "f8", (5, 5)),  # scratch: covariance of posture and twist after the latency
        ("innovations", "f8", 3),  # normalised, of the last encoder samples, at most `SLIP_SIGMAS`, and gyro sample
    ],
    align=True,
)


@kernel
def excite(variance: float, s: Row) -> None:
    """Adds the noise of an input: P ← P + g gᵀ σ², where `s.g` is the derivative of the new state by the input."""
    g, P = s.g, s.P
    for i in range(N):
        if g[i] != 0.0:
            for j in range(N):
                P[i, j] += variance * g[i] * g[j]


@kernel
def propagate(
    v_dot: float, omega_dot: float, growth: float, jolt: float, grip: Array, geometry: Row, period: float, s: Row
) -> None:
    """Predicts the state over one period: P ← F P Fᵀ + Q + g_a g_aᵀ σ_a² + g_θ g_θᵀ σ_θ².

    g_a and g_θ are the derivatives of the new state by the accelerations V̇ and θ̈.

    Args:
        v_dot: V̇ in m/s².
        omega_dot: θ̈ in rad/s².
        growth: Relative growth of the left wheel's radius by the load, and shrinking of the right one's.
        jolt: Jump of the measured acceleration in m/s².
        grip: Whether the wheels grip, `(2,)`.
        geometry: As for the estimator `truth`.
        period: Control period in s.
        s: In and out: a record of `EKF`.
    """
    m, P, T = s.mean, s.P, period
    r, D = geometry.wheel_radius, geometry.half_track
    middle = T / 2 + geometry.skew  # of the period as positions count it; velocities lag behind them
    v, omega = m[V] + v_dot * middle, m[OMEGA] + omega_dot * middle
    heading = m[THETA] + omega * (T / 2 - SIDE_SLIP_TIME)  # direction of the motion, which v_y turns outwards
    c, sn = T * np.cos(heading), T * np.sin(heading)
    grow_left, grow_right = 1 + m[SCALE_LEFT] + growth, 1 + m[SCALE_RIGHT] - growth
    b_left, b_right = T / (r * grow_left), T / (r * grow_right)
    rolled = middle - geometry.lag  # the same for the wheels, which lag behind their axles
    v_wheel, omega_wheel = m[V] + v_dot * rolled, m[OMEGA] + omega_dot * rolled
    turn_left, turn_right = b_left * (v_wheel - D * omega_wheel), b_right * (v_wheel + D * omega_wheel)
    m[X] += v * c
    m[Y] += v * sn
    m[THETA] += T * omega
    m[V] += T * v_dot
    m[OMEGA] += T * omega_dot
    m[LEFT] += turn_left
    m[RIGHT] += turn_right
    # F is the identity except in the rows of x, y, λ, θ and V. Those of θ and V come last, as the others use the old.
    for transposed in range(2):
        Q = P.T if transposed else P
        for j in range(N):
            speed, wheels = Q[V, j] - middle * Q[OFFSET, j], Q[V, j] - rolled * Q[OFFSET, j]
            direction = v * (Q[THETA, j] + (T / 2 - SIDE_SLIP_TIME) * Q[OMEGA, j])
            Q[X, j] += c * speed - sn * direction
            Q[Y, j] += sn * speed + c * direction
            Q[LEFT, j] += b_left * (wheels - D * Q[OMEGA, j]) - turn_left / grow_left * Q[SCALE_LEFT, j]
            Q[RIGHT, j] += b_right * (wheels + D * Q[OMEGA, j]) - turn_right / grow_right * Q[SCALE_RIGHT, j]
            Q[THETA, j] += T * Q[OMEGA, j]
            Q[V, j] -= T * Q[OFFSET, j]
    gripping = grip[0] + grip[1]
    side = (SIDE_SLIP if gripping == 2 else SKID) ** 2 / T
    P[X, X] += side * sn * sn
    P[X, Y] -= side * sn * c
    P[Y, X] -= side * sn * c
    P[Y, Y] += side * c * c
    g = s.g
    for i in range(N):
        g[i] = 0.0
    g[X], g[Y], g[V] = c * middle, sn * middle, T
    g[LEFT], g[RIGHT] = b_left * rolled, b_right * rolled
    excite(s.acceleration_variance, s)
    across = v * (T / 2 - SIDE_SLIP_TIME) * middle  # by the change of heading
    g[X], g[Y], g[THETA], g[V], g[OMEGA] = -sn * across, c * across, T * middle, 0.0, T
    g[LEFT], g[RIGHT] = -b_left * D * rolled, b_right * D * rolled
    excite(YAW_NOISE**2 / T, s)
    P[V, V] += T * SLIPPING_NOISE**2 if gripping == 0 else 0.0
    P[BIAS, BIAS] += T * s.bias_walk**2
    P[OFFSET, OFFSET] += T * (s.offset_walk**2 + (s.offset - m[OFFSET]) ** 2 / OFFSET_SETTLING)
    slip = JOLT_SLIP**2 * jolt**2 + (T * (SLIDE_NOISE / r) ** 2 if gripping == 1 else 0.0)
    P[LEFT, LEFT] += slip
    P[RIGHT, RIGHT] += slip
    P[SCALE_LEFT, SCALE_LEFT] += T * RADIUS_WALK**2
    P[SCALE_RIGHT, SCALE_RIGHT] += T * RADIUS_WALK**2


@kernel
def absorb(residual: float, variance: float, s: Row) -> None:
    """Kalman update by a scalar measurement: g = P Hᵀ is in `s.g`.

        x ← x + g e/S,    P ← P − g gᵀ/S,    S = H g + r

    Args:
        residual: Innovation e.
        variance: Its variance S.
        s: In and out: a record of `EKF`.
    """
    g, P = s.g, s.P
    for i in range(N):
        gain = g[i] / variance
        s.mean[i] += gain * residual
        for j in range(N):
            P[i, j] -= gain * g[j]


@kernel
def measure(now: Row, s: Row) -> None:
    """Updates by encoders and gyro; the encoder of a wheel that slips only resets the angle of that wheel.

    A wheel that is braked hard slips by a fraction of a millimetre in one tick, which `find_grip` does not see, and
    which is many times what an encoder resolves. Where the innovation is above `SLIP_SIGMAS`, the variance of the
    wheel's angle is therefore raised until it is not: the angle takes the slip, and the larger the slip is, the less it
    changes the other states.
    """
    P = s.P
    if now.encoder_new:
        for k in range(2):
            wheel = LEFT + k
            if now.grip[k] == 1:
                residual = now.encoder[k] - s.mean[wheel]
                P[wheel, wheel] += max(0.0, residual * residual / SLIP_SIGMAS**2 - P[wheel, wheel] - s.encoder_variance)
                for i in range(N):
                    s.g[i] = P[wheel, i]
                variance = s.g[wheel] + s.encoder_variance
                s.innovations[k] = residual / np.sqrt(variance)
                absorb(residual, variance, s)
            else:
                for i in range(N):
                    P[wheel, i] = P[i, wheel] = 0.0
                P[wheel, wheel], s.mean[wheel] = s.encoder_variance, now.encoder[k]
    if now.gyro_new:
        for i in range(N):
            s.g[i] = P[OMEGA, i] + P[BIAS, i]
        variance = s.g[OMEGA] + s.g[BIAS] + s.gyro_variance
        residual = now.gyro - s.mean[OMEGA] - s.mean[BIAS]
        s.innovations[2] = residual / np.sqrt(variance)
        absorb(residual, variance, s)


@kernel
def find_drift(along: float, turned: float, s: Row) -> None:
    """Decides by a test of bias of the innovations whether dead reckoning drifts, as after a puncture.

    The innovations of a filter whose model is right are white, with mean 0. Their running mean,

        m ← m + (z − m)/n,    n = `INNOVATION_FIXES`,

    where z is an innovation in its own standard deviations, then has the variance 1/(2n − 1). Where m leaves
    `DRIFT_SIGMAS` standard deviations, dead reckoning is wrong; the filter takes that for another radius of a wheel.
    Until it was found out, the error has gone into the bias of the gyro and into the posture, too: the standard
    deviations of the radii are raised to `RADIUS_DOUBT`, that of the bias to that of the start, and the variances of
    the posture by those of a fix. Then the mean begins again at 0, so that another error that lasts is found again and
    again. Fixes by particles, which encoders and gyro move, have no white innovations; there the bound is infinite.

    Args:
        along: Innovation of the position along the heading, in its standard deviation.
        turned: Innovation of the heading, in its standard deviation.
        s: In and out: a record of `EKF`.
    """
    s.drift[0] += (along - s.drift[0]) / INNOVATION_FIXES
    s.drift[1] += (turned - s.drift[1]) / INNOVATION_FIXES
    if max(abs(s.drift[0]), abs(s.drift[1])) > s.drift_bound:
        P = s.P
        for k in range(SCALE_LEFT, N):
            P[k, k] = max(P[k, k], RADIUS_DOUBT**2)
        P[BIAS, BIAS] = max(P[BIAS, BIAS], s.bias_variance)
        for k in range(3):
            P[k, k] += s.fix_variance[k]
        s.drift[0] = s.drift[1] = 0.0


@kernel
def absorb_fix(fix: Array, s: Row) -> None:
    """Updates by a posture fix, unless it lies outside the gate; the tenth such fix in a row is accepted.

    A fix within the gate also counts for `find_drift`. A robot that is found again after ten fixes may have been moved,
    which says nothing about its wheels.
    """
    P, m = s.P, s.mean
    e0, e1 = fix[0] - m[X], fix[1] - m[Y]
    e2 = wrapped(fix[2] - m[THETA])
    a, b, c = P[X, X] + s.fix_variance[0], P[X, Y], P[X, THETA]
    d, e, f = P[Y, Y] + s.fix_variance[1], P[Y, THETA], P[THETA, THETA] + s.fix_variance[2]
    # S⁻¹ by its adjugate
    A, B, C = d * f - e * e, c * e - b * f, b * e - c * d
    determinant = a * A + b * B + c * C
    s.nis = (
        A * e0 * e0 + (a * f - c * c) * e1 * e1 + (a * d - b * b) * e2 * e2
        + 2 * (B * e0 * e1 + C * e0 * e2 + (b * c - a * e) * e1 * e2)
    ) / determinant  # fmt: skip
    if s.nis > FIX_GATE:
        s.refused += 1
        if s.refused < LOST_FIXES:
            return
        for k in range(3):
            P[k, k] += LOST_DEVIATION**2
        s.drift[0] = s.drift[1] = 0.0
    else:
        u, w = np.cos(m[THETA]), np.sin(m[THETA])
        find_drift((u * e0 + w * e1) / np.sqrt(u * u * a + 2 * u * w * b + w * w * d), e2 / np.sqrt(f), s)
    s.refused = 0
    for k in range(3):
        for i in range(N):
            s.g[i] = P[k, i]
        residual = fix[k] - m[k]
        if k == THETA:
            residual = wrapped(fix[2] - m[THETA])
        absorb(residual, s.g[k] + s.fix_variance[k], s)


@kernel
def find_radius(difference: float, now: Row, geometry: Row, period: float, sensor: Row, s: Row) -> None:
    """Decides whether a wheel has another radius than before, as after a puncture, and writes it into the samples.

    While both wheels grip and the acceleration is below `CALM_ACCELERATION`, no wheel can slip much, and encoders and
    gyro agree in the mean: with v_l,r = r (1 + s_l,r) φ̇_l,r

        d ← d + (T/τ) (v_l − v_r + 2 D (θ̇_gyro − b) − d),    τ = `RADIUS_AVERAGE`

    is within four standard deviations of counts, gyro, b and s, plus `GRIP_DIFFERENCE`. The noise of a slow gyro is the
    same until its next sample, in which time θ̇ changes too (`HELD_NOISE`). Where d is larger, a wheel has another
    radius, and the standard deviations of s_l and s_r are raised to |d|/V, at most `RADIUS_DOUBT`. The gyro then tells
    their difference, and the fixes tell their sum.

    Args:
        difference: v_l − v_r + 2 D (θ̇_gyro − b) in m/s.
        now: In and out: a record of `SAMPLE`, whose `doubt` is the result.
        geometry: As for the estimator `truth`.
        period: Time T since the last samples of the encoders in s.
        sensor: A record of `SENSOR`.
        s: In and out: a record of `EKF`.
    """
    if np.hypot(now.acceleration[0] - s.offset, now.acceleration[1]) > CALM_ACCELERATION:
        return
    s.difference += period / RADIUS_AVERAGE * (difference - s.difference)
    P, u, D = s.P, s.inertial, geometry.half_track
    variance = 2 * (geometry.wheel_radius / RADIUS_AVERAGE) ** 2 * s.encoder_variance
    held = max(1.0, sensor.gyro_every / sensor.encoder_every)
    variance += 4 * D * D * (s.gyro_variance * held * period / (2 * RADIUS_AVERAGE) + P[BIAS, BIAS])
    variance += u * u * (P[SCALE_LEFT, SCALE_LEFT] + P[SCALE_RIGHT, SCALE_RIGHT] - 2 * P[SCALE_LEFT, SCALE_RIGHT])
    variance -= 4 * D * u * (P[BIAS, SCALE_LEFT] - P[BIAS, SCALE_RIGHT])
    turn = 2 * D * HELD_NOISE[1] * period * (sensor.gyro_every - 1) / sensor.encoder_every
    if abs(s.difference) > 4 * np.sqrt(variance) + GRIP_DIFFERENCE + turn:
        now.doubt = min(abs(s.difference) / max(abs(u), GRIP_DIFFERENCE), RADIUS_DOUBT)
        s.difference = 0.0


@kernel
def find_grip(now: Row, geometry: Row, period: float, sensor: Row, s: Row) -> None:
    """Decides which wheels grip, from encoders, gyro and accelerometer, and writes the result into the samples.

    An observer follows the wheels' speed, with the accelerometer as its input:

        V ← V + T (a − o) + 2 ω₀ T e,    o ← o − ω₀² T e,    e = mean of v_l,r − (V ∓ D ω) over the wheels that grip

    It has the bandwidth ω₀ = `OBSERVER_BANDWIDTH`, and its offset o is faster than that of the filter. A wheel slips if
    its own difference is larger than `SLIPPING_SPEED` (or four standard deviations of the observer's V, if that is
    more) plus one count, or if it is the larger one and the two together contradict the gyro. Between two samples of a
    slow accelerometer or gyro the last one is used, which may be wrong by three times `HELD_NOISE` then. Between two
    samples of slow encoders e is unknown, and what was decided last holds. The rate of an encoder that counts is a mean
    since its last sample; V and ω are then means over the same ticks.

    Args:
        now: In and out: a record of `SAMPLE`, whose `grip` and `doubt` are the result.
        geometry: As for the estimator `truth`.
        period: Control period in s.
        sensor: A record of `SENSOR`.
        s: In and out: a record of `EKF`.
    """
    r, D, P, gap = geometry.wheel_radius, geometry.half_track, s.P, period * sensor.encoder_every
    omega = now.gyro - s.mean[BIAS]
    ahead = s.inertial + period * (now.acceleration[0] + geometry.imu_x * omega * omega - s.offset)
    if sensor.quantum == 0:
        s.since[:] = 0.0
    s.since[0] += 1
    s.since[1] += ahead
    s.since[2] += omega
    if not now.encoder_new:
        now.grip[0], now.grip[1], s.inertial = s.grip[0], s.grip[1], ahead
        return
    v, omega = s.since[1] / s.since[0], s.since[2] / s.since[0]
    s.since[:] = 0.0
    waits, turn = period * (sensor.accelerometer_every - 1), HELD_NOISE[1] * period * (sensor.gyro_every - 1)
    bound = SLIPPING_SPEED + r * sensor.quantum / gap + 3 * (HELD_NOISE[0] * waits + D * turn)
    # White noise of density N moves V of the observer by N/(2 √ω₀), also in samples that are held; `SLIPPING_SPEED`
    # covers that of the tiers.
    bandwidth = min(OBSERVER_BANDWIDTH, 0.5 / gap)  # V is corrected by e at most
    density = sensor.accelerometer_sigma * np.sqrt(period * sensor.accelerometer_every)
    bound += max(0.0, 4 * density / (2 * np.sqrt(bandwidth)) - SLIPPING_SPEED)
    left = r * (1 + s.mean[SCALE_LEFT]) * now.rate[0] - (v - D * omega)
    right = r * (1 + s.mean[SCALE_RIGHT]) * now.rate[1] - (v + D * omega)
    now.grip[0], now.grip[1] = abs(left) < bound, abs(right) < bound
    if now.grip[0] + now.grip[1] == 2:
        find_radius(left - right, now, geometry, gap, sensor, s)
    spread = 4 * (r / gap) ** 2 * s.encoder_variance
    spread += 4 * D * D * (s.gyro_variance + turn * turn + P[BIAS, BIAS])
    spread += s.inertial**2 * (P[SCALE_LEFT, SCALE_LEFT] + P[SCALE_RIGHT, SCALE_RIGHT])
    if abs(left - right) > 4 * np.sqrt(spread) + GRIP_DIFFERENCE:  # by the gyro, one of them slips
        wheel = 0 if abs(left) > abs(right) else 1
        now.grip[wheel] = 0
    s.grip[0], s.grip[1] = now.grip[0], now.grip[1]
    count = now.grip[0] + now.grip[1]
    if count > 0:
        mean = (now.grip[0] * left + now.grip[1] * right) / count
        ahead += 2 * bandwidth * gap * mean
        s.offset -= bandwidth**2 * gap * mean
    s.inertial = ahead


@kernel
def step(t: int, ring: Rows, i: int, geometry: Row, period: float, delay: int, start: int, s: Row) -> None:
    """Runs the filter from tick t − 1 to t."""
    now, p = ring[t % len(ring), i], t - 1 - delay
    omega_dot = ring[p % len(ring), i].command[1] if p >= start else 0.0
    forward = now.acceleration[0] + geometry.imu_x * s.mean[OMEGA] ** 2  # the accelerometer is ahead of the rear axle
    jolt = abs(now.acceleration[0] - ring[(t - 1) % len(ring), i].acceleration[0])
    jolt = max(0.0, jolt - JUMP_SIGMAS * np.sqrt(2 * s.acceleration_variance))
    if (t - start) * period < LOADING_TIME:
        jolt = max(jolt, LOADING_JOLT)
    if now.grip[0] + now.grip[1] == 0:  # o is not observed, and its last correction would be integrated
        for n in range(N):
            s.P[OFFSET, n] = s.P[n, OFFSET] = 0.0
        s.mean[OFFSET], s.P[OFFSET, OFFSET] = s.offset, START_OFFSET**2
    growth = geometry.load * now.acceleration[1]
    propagate(forward - s.mean[OFFSET], omega_dot, growth, jolt, now.grip, geometry, period, s)
    for k in range(SCALE_LEFT, N):
        s.P[k, k] = max(s.P[k, k], now.doubt**2)
    measure(now, s)


@kernel
def keep(t: int, s: Row) -> None:
    """Stores the state of a tick in which a fix was taken, in place of the oldest one."""
    oldest = 0
    for k in range(MAX_STORED):
        if s.kept_tick[k] == t:
            oldest = k
            break
        if s.kept_tick[k] < s.kept_tick[oldest]:
            oldest = k
    s.kept_tick[oldest] = t
    for i in range(N):
        s.kept_mean[oldest, i] = s.mean[i]
        for j in range(N):
            s.kept_P[oldest, i, j] = s.P[i, j]


@kernel
def go_back(k: int, s: Row) -> None:
    """Takes up the state that is stored in place k."""
    for i in range(N):
        s.mean[i] = s.kept_mean[k, i]
        for j in range(N):
            s.P[i, j] = s.kept_P[k, i, j]


@kernel
def find_misses(now: int, ring: Rows, i: int, period: float, f: Row, s: Row) -> None:
    """Compares V and θ̇ of a tick with what was predicted for it when its samples had not arrived.

    The robot does not accelerate as commanded, and by how much depends on controllers, loads and motors that the filter
    does not know. Therefore the variance of the prediction is the running mean square of what it has missed.

    Args:
        now: The last tick whose samples have arrived.
        ring: As for the estimator `truth`, and so are `i` and `period`; its `twist` is the prediction.
        i: Index of the robot.
        period: Control period in s.
        f: In and out: a record of `EKF`.
        s: A record of `SEEN`.
    """
    count = now - s.start - s.age  # number of predictions over the whole latency until now
    if s.age > 0 and count > 0:
        for k in range(2):
            miss = f.mean[V + k] - ring[now % len(ring), i].twist[k]
            f.missed[k] += max(period / MISS_AVERAGE, 1 / count) * (miss * miss - f.missed[k])


@kernel
def predict_covariance(count: int, period: float, f: Row, s: Row) -> None:
    """Predicts the covariance of posture and twist over the latency L into `ahead`.

        P ← F P Fᵀ + g_a g_aᵀ m_V + g_θ g_θᵀ m_θ̇

    F, g_a and g_θ are those of `propagate` for one step of the duration L, in which V and θ̇ miss by 1 with a constant
    acceleration; m is their mean square, `missed`.

    Args:
        count: L in control periods.
        period: Control period in s.
        f: In and out: a record of `EKF`.
        s: A record of `SEEN`, with the estimate after L.
    """
    P, L = f.ahead, count * period
    for i in range(5):
        for j in range(5):
            P[i, j] = f.P[i, j]
    if count == 0:
        return
    v, heading = (f.mean[V] + s.twist[0]) / 2, (f.mean[THETA] + s.pose[2]) / 2
    c, sn = L * np.cos(heading), L * np.sin(heading)
    for transposed in range(2):
        Q = P.T if transposed else P
        for j in range(5):
            direction = v * (Q[THETA, j] + L / 2 * Q[OMEGA, j])
            Q[X, j] += c * Q[V, j] - sn * direction
            Q[Y, j] += sn * Q[V, j] + c * direction
            Q[THETA, j] += L * Q[OMEGA, j]
    g_a, g_theta = (c / 2, sn / 2, 0.0, 1.0, 0.0), (-sn * v * L / 4, c * v * L / 4, L / 2, 0.0, 1.0)
    for i in range(5):
        for j in range(5):
            P[i, j] += f.missed[0] * g_a[i] * g_a[j] + f.missed[1] * g_theta[i] * g_theta[j]


@kernel
def ekf(
    tick: int, true: Row, ring: Rows, i: int, sensor: Row, geometry: Row, period: float, memory: Row, s: Row
) -> None:
    """The estimator `ekf`; the arguments are those of `truth`, and `true` is not read."""
    f, now = memory, tick - s.age
    taken = tick - sensor.fix_latency  # when the fix that arrives now was taken
    if s.start <= taken < now and ring[taken % len(ring), i].fix_arrives:
        for k in range(MAX_STORED):
            if f.kept_tick[k] == taken:
                go_back(k, f)
                absorb_fix(ring[taken % len(ring), i].fix, f)
                for t in range(taken + 1, now):
                    step(t, ring, i, geometry, period, s.delay, s.start, f)
                    if ring[t % len(ring), i].fix_taken:
                        keep(t, f)
                break
    if now >= s.start:
        sample = ring[now % len(ring), i]
        if now > s.start:
            find_grip(sample, geometry, period, sensor, f)
            step(now, ring, i, geometry, period, s.delay, s.start, f)
            if sample.grip[0] + sample.grip[1] < 2:
                f.inertial = f.mean[V]
        else:
            f.mean[LEFT], f.mean[RIGHT] = sample.encoder[0], sample.encoder[1]
        if sample.fix_taken and now - s.start > 0:
            if sensor.fix_latency <= tick - now:
                if sample.fix_arrives:
                    absorb_fix(sample.fix, f)
            else:
                keep(now, f)
    find_misses(now, ring, i, period, f, s)
    settle(f.mean, now, ring, i)
    predict(f.mean, max(now, s.start), tick, ring, i, period, s)
    s.estimate[0], s.estimate[1], s.estimate[2] = s.pose[0], s.pose[1], wrapped(s.pose[2])
    s.estimate[3], s.estimate[4] = s.twist[0], s.twist[1]
    settle(s.estimate, tick, ring, i)
    predict_covariance(tick - max(now, s.start), period, f, s)
    P = f.ahead
    s.variance[0], s.variance[1], s.variance[2] = P[X, X], P[X, Y], P[Y, Y]
    s.variance[3], s.variance[4], s.variance[5] = P[THETA, THETA], P[V, V], P[OMEGA, OMEGA]
