"""Model reference adaptive control with a proof: the composite law of Slotine and Li on equation (3).

Slotine and Li (1989), with the regressor at the commanded motion (Sadegh and Horowitz 1990), projection and switching
σ-modification (Ioannou and Sun 1996, sections 4.4 and 8.4). Equation (3) is linear in parameters: each channel k is

    U_k = φ(x, ẋ)ᵀ a_k = m_k ẋ_k + f_k(x),      x = (V, θ̇),  φ = the 8 scaled physical features, cos θ and sin θ

m_k is the parameter of the acceleration of channel k. The last two parameters are gravity on a slope of any direction,
with the heading θ by dead reckoning; without a model as prior they are left out. The commanded motion x_c is the
reference model. The law is

    U_k = φ(x_c, ẋ_c)ᵀ â_k + K_k e_k + K_i,k z_k,       e = x_c − x,  ż = e                        (the PID)
    â̇_k = P [η_k φ(x_c, ẋ_c) e_k − w (wᵀ â_k − H U_k)/ρ² − σ (â_k − a_0)] + projection
    d/dt P⁻¹ = −λ (P⁻¹ − P_0⁻¹) + w wᵀ/ρ²,    P(0) = P_0

- w = H φ(x, ẋ) with H = 1/(T s + 1)², so that H U_k = wᵀ a_k without differentiation: the prediction error.
- P is the gain of least squares with the memory 1/λ. In each direction it returns to P_0 when w no longer excites it,
  and never exceeds it, P ≤ P_0. (Slotine and Li let λ fall to zero as the norm of P reaches a bound. A course that
  leaves some directions without excitation then ends the forgetting in all of them, and adaptation with it.)
- σ = 0 while ‖â_k − a_0‖ ≤ R and grows linearly to σ_0 at 2 R; a_0 are the parameters of the prior, zero for `none`.
- The projection keeps â_k in the ball of radius 2 R about a_0, by the nearest point of the ball in the metric P⁻¹.
- φ_c and w have the same heading, that of the robot, so that gravity cancels in f_k(x_c) − f_k(x).

**Theorem.** Let the robot obey the equation of each channel with constant parameters, ‖a_k − a_0‖ ≤ R, m_k > 0, without
disturbance, saturation and delay, and let the feedback be stronger than what f takes from it: for some ε ≥ 0

    Σ_k η_k e_k (f_k(x_c) − f_k(x)) ≥ −Σ_k η_k (K_k − ε) e_k²                                         (A)

Then, with ã_k = â_k − a_k,

    V = ½ Σ_k [η_k (m_k e_k² + K_i,k z_k²) + ã_kᵀ P⁻¹ ã_k],      V̇ ≤ −Σ_k [ε η_k e_k² + (wᵀ ã_k)²/(2 ρ²)] ≤ 0

so that e, â and, where K_i,k > 0, z are bounded, and wᵀ ã is square integrable. If ε > 0, e is square integrable too,
and e → 0 for bounded x_c and ẋ_c. V̇ also contains −½ λ Σ ã_kᵀ (P⁻¹ − P_0⁻¹) ã_k. If w is persistently exciting, P⁻¹ −
P_0⁻¹ ≥ c P⁻¹ with c > 0, and ã → 0 too.

*Proof.* The equation of the robot less the law is m_k ė_k = −K_k e_k − K_i,k z_k − φ_cᵀ ã_k − (f_k(x_c) − f_k(x)),
because m_k ẋ_c,k + f_k(x_c) = φ_cᵀ a_k. In V̇, η_k e_k φ_cᵀ ã_k cancels with the first term of the adaptation, and e_k
K_i,k z_k with the derivative of the integral; what e and f leave is at most −ε η_k e_k² by (A). The second term of the
adaptation gives −(wᵀ ã_k)²/ρ², of which the derivative of P⁻¹ takes back one half; the rest of that derivative is −½ λ
ã_kᵀ (P⁻¹ − P_0⁻¹) ã_k ≤ 0, as P⁻¹ starts at P_0⁻¹ and cannot fall below it. The leak gives −σ ã_kᵀ (â_k − a_0) ≤ −σ
‖â_k − a_0‖ (‖â_k − a_0‖ − R) ≤ 0, as σ = 0 where the last bracket is negative. The ball contains a_k, and a projection
on a convex set brings â_k no farther from any of its points. ∎

About (A): with η_k in proportion to the back-EMF, as here, Σ η_k e_k U_k is a power. Back-EMF and friction together
dissipate. (Friction alone may do a little work on e, as the front wheel's loss has the mean sign of the rear wheels.)
Of the products V θ̇ and θ̇² remains l (V_c e_ω² − ω_c e_V e_ω), where l, in V s², is minus the coefficient of ω² in
U_Σ. Forward, the feedback is stronger where l |ω_c| < 2 √(K_V D K_ω); for the default robot in `lab` this is 0.7 V
s < 29 V s at the most.

The law is sampled; one period changes V by O(h²) beyond the theorem, which the test measures. As the theorem demands,
learning takes nothing over from the PID's integral; with `hand_over` it does, as the other learners do: the first lap
from the prior `none` is then better, and V may grow.

Beyond the theorem there are noise, delay, the fork and slip. `match` gives the prediction error the voltage that acted.
Nothing is learned while a limit acts or a wheel slips (`frozen`), or near rest, where stiction is no function of the
motion; the filters go on. Under `rigid` steering the second channel is the correction of the commanded rotation, as in
`composite`: its plant is U = θ̇ + φᵀ a, in rad/s, and η_k is smaller by the factor `STEERING_SHARE`.
"""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from mrctl.control.algebra import dot, factor, forward, linear, solve, symmetric_product
from mrctl.control.features import FEATURES, REGRESSORS, V_DOT, dead_reckoned, feature_scale, moves, regressor
from mrctl.control.feedforward import STEERING_SCALE, STEERING_SHARE, Learner, Loop, Shown
from mrctl.control.matching import MATCHED, SETTLING_TIMES, low_pass, match, queues
from mrctl.kernel import Array, Row, Rows, kernel
from mrctl.record import Record
from mrctl.theory.dynamics import inverse_coefficients

SIGNALS = REGRESSORS + 2  # filtered signals: the features, the direction, and the voltage of the two channels
# largest number of steps of the projection; share by which its result may exceed the ball
MAX_NEWTON_STEPS, PROJECTION_TOLERANCE = 100, 1e-6


@kernel
def predict(s: Row) -> None:
    """The prediction error: one step of least squares that forgets towards P₀, the same gain for both channels.

        M ← M − λ h (M − M₀) + w wᵀ h/ρ²,    b_k ← b_k + M⁻¹ w (residual_k − wᵀ b_k) h/ρ²,    M = P⁻¹

    ãᵀ M ã falls in each step, however long the period is.

    Args:
        s: In and out: a record of `MRAC`.
    """
    for i in range(REGRESSORS):
        for j in range(REGRESSORS):
            s.M[i, j] += s.w[i] * s.w[j] / s.r - s.forgetting * s.M[i, j]
        s.M[i, i] += s.forgetting * s.least
    factor(s.M, s.L)
    solve(s.L, s.w, s.product)
    for k in range(2):
        innovation = s.residual[k]
        for i in range(REGRESSORS):
            innovation -= s.w[i] * s.b[i, k]
        for i in range(REGRESSORS):
            s.b[i, k] += s.product[i] * innovation / s.r


@kernel
def track(k: int, s: Row) -> None:
    """The tracking error of channel k: b ← b + h η P φ_c e.

    Args:
        k: Channel.
        s: In and out: a record of `MRAC`.
    """
    solve(s.L, s.phi_c, s.product)
    for i in range(REGRESSORS):
        s.b[i, k] += s.tracking[k] * s.product[i] * s.error[k]


@kernel
def confine(k: int, s: Row) -> None:
    """Switching σ-modification and projection of the parameters of channel k.

        b ← b − s P b,    s = min(h σ, ‖b‖ (‖b‖ − R)/(bᵀ P b)),    σ = σ_0 min(‖b‖/R − 1, 1) where ‖b‖ > R

    A very fast leak ends where gᵀ b = R, with g = b/‖b‖ before the step.

    Args:
        k: Channel.
        s: In and out: a record of `MRAC`.
    """
    radius, b = s.radius[k], s.b[:, k]
    size = np.sqrt(dot(b, b))
    if size <= radius:
        return
    solve(s.L, b, s.product)
    share = min(s.leak * min(size / radius - 1, 1.0), (size - radius) * size / dot(b, s.product))
    for i in range(REGRESSORS):
        b[i] -= share * s.product[i]
    project(s.M, b, 2 * radius, s.shifted, s.product)


@kernel
def project(M: Array, b: Array, radius: float, shifted: Array, q: Array) -> None:
    """Moves a vector to the point of a ball about the origin that is nearest to it in a metric.

        min (x − b)ᵀ M (x − b)  subject to  ‖x‖ ≤ r:    (M + μ 1) x = M b,    ‖x‖ = r,    μ ≥ 0

    μ is found by Newton's method on 1/‖x‖ − 1/r, from 0 on, which converges from below: Moré and Sorensen, "Computing a
    trust region step", SIAM J. Sci. Stat. Comput. 4(3), 1983.

    Args:
        M: Metric, symmetric and positive definite, `(n, n)`.
        b: In and out: the vector, `(n,)`.
        radius: Radius r of the ball.
        shifted: Scratch, `(n, n)`.
        q: Scratch, `(n,)`.
    """
    n, mu = b.shape[0], 0.0
    size = np.sqrt(dot(b, b))
    if size <= radius:
        return
    target = np.empty(n)
    symmetric_product(M, b, target)
    for _ in range(MAX_NEWTON_STEPS):
        for i in range(n):
            for j in range(n):
                shifted[i, j] = M[i, j]
            shifted[i, i] += mu
        factor(shifted, shifted)
        solve(shifted, target, b)
        size = np.sqrt(dot(b, b))
        if size <= radius * (1 + PROJECTION_TOLERANCE):
            return
        forward(shifted, b, q)
        mu += size * size / dot(q, q) * (size / radius - 1)


@kernel
def filter_motion(shown: Shown, queue: Rows, scale: Array, robot: Row, s: Row) -> bool:
    """Passes the mean features of the period that ends now, and the voltage that acted in it, through the two filters.

    Args:
        shown: What this tick shows of the robot.
        queue: In and out: that of `match`, `(d + 1,)`.
        scale: Scales of the features, `(8,)`.
        robot: The nominal robot.
        s: In and out: a record of `MRAC`, whose `w` and `twice` are the result.

    Returns:
        Whether the filters have forgotten how they began.
    """
    known = match(shown, robot.rigid, queue, s.matched)
    for j in range(REGRESSORS):
        s.before[j] = s.x[j]
    if s.has_heading > 0:
        s.heading = dead_reckoned(s.heading, s.matched.twist[1], shown.period, s.direction)
    regressor(s.matched.twist, s.zero, s.direction, robot.half_track, scale, s.x)
    if not known:
        return False
    for j in range(SIGNALS):
        if V_DOT <= j < V_DOT + 2:
            signal = s.matched.rate[j - V_DOT] / scale[j]
        elif j < REGRESSORS:
            signal = (s.x[j] + s.before[j]) / 2
        else:
            signal = s.matched.acted[j - REGRESSORS]
        if s.age == 0:
            s.once[j] = s.twice[j] = signal
        low_pass(signal, j, s.share, s.once, s.twice)
        if j < REGRESSORS:
            s.w[j] = s.twice[j]
    s.age += s.share
    return s.age > SETTLING_TIMES


@kernel
def respond(i: int, command: Array, derivative: Array, robot: Row, arrays: tuple[Any, ...], voltage: Array) -> None:
    """U = φ(x_c, ẋ_c)ᵀ (â − a_0); the prior adds φ(x_c, ẋ_c)ᵀ a_0."""
    rows, scale, _ = arrays
    s = rows[i]
    regressor(command, derivative, s.direction, robot.half_track, scale, s.phi_c)
    linear(s.phi_c, s.b, voltage)


@kernel
def learn(i: int, shown: Shown, robot: Row, prior: Row, arrays: tuple[Any, ...], added: Array) -> float:
    """One step of the law, unless the robot must not learn; the feedback teaches through x_c − x, not as a voltage."""
    rows, scale, queue = arrays
    s = rows[i]
    settled = filter_motion(shown, queue[i], scale, robot, s)
    added[0] = added[1] = 0.0
    if settled and moves(s.matched.twist, robot.half_track) and shown.frozen == 0:
        for k in range(2):
            s.error[k] = shown.command[k] - shown.twist[k]
            s.residual[k] = s.twice[REGRESSORS + k]
            for j in range(FEATURES):
                s.residual[k] -= s.w[j] * scale[j] * prior.c[j, k]
        if robot.rigid:
            s.residual[1] -= s.w[1] * scale[1]
        linear(s.phi_c, s.b, added)
        predict(s)
        for k in range(2):
            track(k, s)
            confine(k, s)
        linear(s.phi_c, s.b, s.output)
        for k in range(2):
            added[k] = s.hand_over * (s.output[k] - added[k])
    s.norm = np.sqrt((s.b**2).sum())
    return s.norm


class Mrac(Record):
    """Settings of the learner `mrac`; one setting serves every robot, steering and perturbation.

    They were chosen on a circle, a rounded square, the lemniscate and three random splines, in `lab`. On the circle and
    the lemniscate, under `all`, the position error of the last of three laps changes by at most 1 % when one of
    `noise`, `memory`, `spread`, `tracking` and `filter` is changed by a factor of 2 or 5.
    """

    noise: Annotated[float, Field(ge=1e-4, le=10)] = 0.02
    """Noise density ρ of the prediction error in V √s; the smaller, the faster the prediction error is followed."""
    memory: Annotated[float, Field(ge=0.1, le=1e6)] = 20.0
    """Memory 1/λ of least squares in s."""
    spread: Annotated[float, Field(ge=1e-6, le=100)] = 3.0
    """Standard deviation of the parameters at the start in V; its square is the diagonal of P₀."""
    tracking: Annotated[float, Field(ge=0, le=1e3)] = 2.0
    """Weight η of the tracking error in 1/(V² s), per volt of back-EMF of that error."""
    radius: Annotated[float, Field(ge=1e-6, le=10)] = 1.0
    """Distance R of the scaled parameters of a channel from those of the prior, beyond which they leak back, as a share
    of the supply (of a tenth of that number in rad/s on a steering channel); the projection acts at twice that
    distance."""
    leak: Annotated[float, Field(ge=0, le=1e3)] = 0.1
    """Leak rate σ₀ in 1/(V² s) of parameters at a distance of 2 `radius` from the prior's; it rises linearly from 0 at
    `radius`."""
    filter: Annotated[float, Field(ge=0.005, le=2)] = 0.03
    """Time constant T in s of each of the two filters on voltage and motion."""
    hand_over: bool = False
    """Whether the PID's integral gives up a part of what learning adds, as with the other learners; the theorem does
    not cover it."""


MRAC = np.dtype(
    [
        ("r", "f8"),  # variance ρ²/h of a sample, V²
        ("forgetting", "f8"),  # λ h
        ("least", "f8"),  # diagonal of M₀, 1/V²
        ("tracking", "f8", 2),  # η_k h of the two channels, 1/V per m/s (1/V² on a steering channel)
        ("leak", "f8"),  # σ₀ h, 1/V²
        ("radius", "f8", 2),  # R of the two channels, V (rad/s on a steering channel)
        ("share", "f8"),  # weight of a new sample in the two filters
        ("hand_over", "f8"),  # 1 where the PID's integral gives up a part of what learning adds, else 0
        ("matched", MATCHED),
        ("zero", "f8", 2),  # no acceleration, m/s² and rad/s²
        ("output", "f8", 2),  # φ(x_c, ẋ_c)ᵀ b after a step, V
        ("has_heading", "f8"),  # 1 where a model is the prior, else 0
        ("heading", "f8"),  # by dead reckoning, rad
        ("direction", "f8", 2),  # its cosine and sine; zero without a model
        ("x", "f8", REGRESSORS),  # scaled features of the measured twist without acceleration, and the direction
        ("before", "f8", REGRESSORS),  # the same one period ago
        ("once", "f8", SIGNALS),  # features and voltages after the first filter
        ("twice", "f8", SIGNALS),  # H of features and voltages
        ("age", "f8"),  # time since the filters began over T + h
        ("w", "f8", REGRESSORS),  # filtered features
        ("phi_c", "f8", REGRESSORS),  # scaled features of the commanded motion
        ("residual", "f8", 2),  # filtered voltage less that of the prior, V
        ("error", "f8", 2),  # x_c − x, m/s and rad/s
        ("b", "f8", (REGRESSORS, 2)),  # â − a_0, V
        ("M", "f8", (REGRESSORS, REGRESSORS)),  # P⁻¹, the inverse of the gain of least squares, 1/V²
        ("L", "f8", (REGRESSORS, REGRESSORS)),  # its factor, M = L Lᵀ, 1/V
        ("shifted", "f8", (REGRESSORS, REGRESSORS)),  # scratch of the projection, 1/V²
        ("product", "f8", REGRESSORS),  # scratch: P times a vector, V² and V
        ("norm", "f8"),  # ‖â − a_0‖ of both channels, V
    ],
    align=True,
)


class ModelReferenceAdaptive(Learner):
    """The learner `mrac` for B robots.

    Attributes:
        rows: One record of `MRAC` a robot.
    """

    respond, learn_one, record, learned = respond, learn, MRAC, ("b", "M")

    def __init__(self, loop: Loop, settings: list[Mrac]) -> None:
        """Takes the loop, and the settings of each robot."""
        super().__init__(loop, settings)
        rows, (robot, rigid, period, *_) = self.rows, loop
        per_speed = inverse_coefficients(robot)[[0, 1], [0, 1]]  # V per m/s and per rad/s
        unit = np.array([1.0, STEERING_SCALE if rigid else 1.0])
        weight = np.array([per_speed[0], STEERING_SHARE if rigid else per_speed[1]])
        for row, s in zip(rows, settings, strict=True):
            row["r"], row["forgetting"] = s.noise**2 / period, min(period / s.memory, 0.5)
            row["least"], row["M"] = s.spread**-2, s.spread**-2 * np.eye(REGRESSORS)
            row["tracking"] = s.tracking * period * weight
            row["leak"], row["radius"] = s.leak * period, s.radius * robot.supply * unit
            row["share"], row["hand_over"] = period / (period + s.filter), s.hand_over
        rows["has_heading"] = rows["direction"][:, 0] = loop.has_prior
        self._start = rows.copy()
        self.arrays = rows, feature_scale(robot), queues(len(settings), loop.delay)

    @property
    def parameters(self) -> Array:
        """Learned coefficients of the scaled features, `(B, 8, 2)` in V."""
        return self.rows["b"][:, :FEATURES].copy()

    def adopt(self, row: int, learned: Array) -> None:
        """Does as `Learner.adopt`, but leaves out the slope, which belongs to another place."""
        super().adopt(row, learned)
        s, slope = self.rows[row], slice(FEATURES, None)
        P = np.linalg.inv(s["M"])
        s["b"][slope] = P[slope] = P[:, slope] = 0.0
        P[range(FEATURES, REGRESSORS), range(FEATURES, REGRESSORS)] = 1 / s["least"]
        s["M"] = np.linalg.inv(P)

    def restore(self, rows: NDArray[np.intp]) -> None:
        """Resets robots to the parameters of the prior and P₀."""
        self.rows[rows], self.weight_norm[rows] = self._start[rows], 0.0
        self.arrays[2][rows] = 0.0
