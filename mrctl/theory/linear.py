"""Linear plants of the velocity controller's channels about driving straight on, for the design of the PID.

The common channel is equation (3), and so is the differential channel of a robot without a steered wheel. A steered
wheel that trails resists rotation: its tyre turns the fork against the servo, whose torque acts back on the robot. With
the speed V, the yaw rate θ̇ and the fork's angle φ, the yaw model is

    J_e θ̈ + J_c φ̈ = (2 D N k_M/(r R_a)) U_Δ − (2 D² N² k_M k_E/(r² R_a) + m c V) θ̇ + (L − t) F
    J_c θ̈ + J_f φ̈ = m_f e V θ̇ − k_s φ − d_s φ̇ − t F
    (L − t) θ̈ − t φ̈ = −u/T,    u = (L − t) θ̇ − t φ̇ − V φ

F is the side force of the ground on the tyre in N, and u in m/s is the side slip, the sideways velocity of the contact
in the frame of the wheel. MuJoCo lets it decay with the time constant T, but leaves −V φ̇ out of u̇, as its contacts do
not know that their frame turns. J_f is the inertia of fork and wheel about the steering axis, m_f e their mass times
the distance of their centre behind it, J_c = J_f − m_f e L their coupling to the yaw, k_s and d_s the servo's stiffness
and damping. The servo holds the commanded angle, which does not depend on
the feedback. At rates far below V/t the fork follows, φ = (L − t) θ̇/V, and its stiffness acts as a damping k_s (L −
t)²/(t V) of the yaw: at 0.75 m/s it leaves a fifth of the static gain of the default robot's second channel.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mrctl.kernel import Array
from mrctl.theory.robot import Robot

TYRE_LAG = 0.0019
"""Time constant T in s with which a tyre's slip decays: 0.95/2 of the 4 ms of `solreffriction` in models/car.xml."""


class Linear(NamedTuple):
    """A linear plant ẋ = A x + b u, whose output is x[0].

    Attributes:
        a: A, `(n, n)`.
        b: b, `(n,)`.
    """

    a: Array
    b: Array

    @property
    def gain(self) -> float:
        """Static gain, in output units per input unit."""
        return float(np.linalg.solve(-self.a, self.b)[0])

    @property
    def lag(self) -> float:
        """∫ (1 − y(t)/y(∞)) dt of the step response y, in s; the time constant of a first-order plant."""
        return float(np.linalg.solve(self.a, np.linalg.solve(-self.a, self.b))[0] / -self.gain)

    @property
    def stable(self) -> bool:
        """Whether every eigenvalue of A has a negative real part."""
        return bool((np.linalg.eigvals(self.a).real < 0).all())

    def held(self, period: float) -> Linear:
        """The plant behind a zero-order hold, x⁺ = A x + b u from one sample to the next; exact. The period is in s."""
        from scipy.linalg import expm  # imported here, so that settings are read without scipy

        n = len(self.b)
        both = np.zeros((n + 1, n + 1))
        both[:n, :n], both[:n, n] = self.a, self.b
        both = np.asarray(expm(both * period), float)
        return Linear(both[:n, :n], both[:n, n])

    def response(self, frequency: Array, period: float) -> NDArray[np.complex128]:
        """Frequency response behind a zero-order hold, from sample to sample; exact.

        Args:
            frequency: ω in rad/s, below π over the period, `(F,)`.
            period: Period of the hold in s.

        Returns:
            The response at z = e^(jω period), `(F,)`.
        """
        held = self.held(period)
        z = np.exp(1j * frequency * period)[:, None, None]
        return np.asarray(np.linalg.solve(z * np.eye(len(held.b)) - held.a, held.b[:, None])[:, 0, 0], complex)


def first_order(gain: float, time_constant: float) -> Linear:
    """The plant K/(τ s + 1), with K in output units per input unit and τ in s."""
    return Linear(np.array([[-1 / time_constant]]), np.array([gain / time_constant]))


def common(robot: Robot) -> Linear:
    """The plant from U_Σ in V to V in m/s, equation (3) without the losses."""
    return first_order(robot.velocity_gain, robot.velocity_time_constant)


def yaw(robot: Robot, speed: float) -> Linear:
    """The plant from U_Δ in V to θ̇ in rad/s at a speed V in m/s; its states are θ̇ and, with a steered wheel, φ, φ̇."""
    damping = robot.effective_inertia / robot.rotation_time_constant
    force = damping * robot.rotation_gain
    damping += robot.mass * robot.com_offset * speed
    if robot.fork_inertia == 0:
        return first_order(force / damping, robot.effective_inertia / damping)
    length, trail, moment = robot.wheelbase - robot.trail, robot.trail, robot.fork_moment
    coupling = robot.fork_inertia - moment * robot.wheelbase
    inertia = np.array(  # on the left of θ̈, φ̈ and F
        [
            [robot.effective_inertia, coupling, -length],
            [coupling, robot.fork_inertia, trail],
            [length, -trail, 0],
        ]
    )
    right = np.array(  # on the right of θ̇, φ, φ̇ and U_Δ
        [
            [-damping, 0, 0, force],
            [moment * speed, -robot.steering_stiffness, -robot.steering_damping, 0],
            [-length / TYRE_LAG, speed / TYRE_LAG, trail / TYRE_LAG, 0],
        ]
    )
    turned, swung, _ = np.linalg.solve(inertia, right)
    return Linear(np.stack([turned[:3], np.array([0.0, 0.0, 1.0]), swung[:3]]), np.array([turned[3], 0.0, swung[3]]))


def steering(robot: Robot) -> Linear:
    """The plant from u in rad/s, the θ̇ for which a stiff servo is set, to θ̇ in rad/s.

        T θ̈ = δ − θ̇,    J_f δ̈ + d_s δ̇ + k_s δ = k_s u

    δ is the yaw rate at which the wheel rolls without slip, its angle times V over the wheelbase; scaled like this, the
    equations contain neither speed nor wheelbase. If the servo is not known, only the lag T of the tyre is left.
    """
    if robot.steering_stiffness == 0 or robot.fork_inertia == 0:
        return first_order(1.0, TYRE_LAG)
    stiffness = robot.steering_stiffness / robot.fork_inertia
    damping = robot.steering_damping / robot.fork_inertia
    servo = [[-1 / TYRE_LAG, 1 / TYRE_LAG, 0], [0, 0, 1], [0, -stiffness, -damping]]
    return Linear(np.array(servo), np.array([0.0, 0.0, stiffness]))
