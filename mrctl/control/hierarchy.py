"""The paper's figure 3: motion controller over velocity controller, wired for B robots."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numba import boolean, float64, njit
from numpy.typing import NDArray

from mrctl.control import steering
from mrctl.control.chain import EACH, GIVEN, OWN, one, stamp
from mrctl.control.feedforward import Feedforward, InverseDynamics, NoFeedforward
from mrctl.control.fel import FeedbackErrorLearning
from mrctl.control.kanayama import Kanayama, kanayama
from mrctl.control.limiter import limit
from mrctl.control.pid import Pid, pid
from mrctl.control.rls import RecursiveLeastSquares
from mrctl.control.steering import allocate
from mrctl.robot import Robot
from mrctl.scenario import Scenario

Array = NDArray[np.float64]

_kanayama, _limit, _pid, _allocate = one(kanayama), one(limit), one(pid), one(allocate)


def _compile(version: int) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """The laws before and after the feedforward, each chained for all robots; see `chain.stamp` for the version."""

    @njit((boolean, *[GIVEN] * 5, OWN, EACH, EACH, float64, float64[:, :, ::1], *[OWN] * 9), cache=True)
    def lead(  # noqa: ANN202
        moves, pose, twist, reference, reference_twist, acceleration, kanayama_gains, limits,  # noqa: ANN001
        prefilter, period, pid_gains, excess, error, request, correction, limiter, integrals,  # noqa: ANN001
        command, derivative, feedback,  # noqa: ANN001
    ):  # fmt: skip
        """Posture to commanded motion and feedback: motion controller (where it moves), limiter, PID."""
        _ = version
        wish = np.empty(2)
        for i in range(len(pose)):
            v = reference_twist[i]
            if moves:
                _kanayama(pose[i], reference[i], v, kanayama_gains[i], error[i], request[i])
                for k in range(2):
                    correction[i, k] = request[i, k] - v[k]
            for k in range(2):
                wish[k] = v[k] + correction[i, k]
            _limit(wish, v, acceleration[i], limits, prefilter[i], period, limiter[i], command[i], derivative[i])
            _pid(command[i], twist[i], pid_gains[i], period, excess[i], integrals[i], feedback[i])

    @njit((*[OWN] * 3, GIVEN, EACH, float64, EACH, *[OWN] * 4, EACH, EACH), cache=True)
    def follow(  # noqa: ANN202
        command, derivative, feedback, feedforward, robot, period, frozen,  # noqa: ANN001
        fork, output, parts, excess, saturated, idle,  # noqa: ANN001
    ):  # fmt: skip
        """Feedback and feedforward to voltages and steering; returns whether all of them are finite."""
        _ = version
        finite = True
        for i in range(len(command)):
            _allocate(
                command[i], derivative[i], feedback[i], feedforward[i], robot, period,
                fork[i], output[i], parts[i], excess[i], saturated[i : i + 1],
            )  # fmt: skip
            idle[i] = max(saturated[i], frozen[i])
            for k in range(4):
                finite &= np.isfinite(parts[i, k])
        return finite

    return lead, follow


_lead, _follow = _compile(stamp(kanayama, limit, pid, allocate))


def feedforward_of(scenarios: Sequence[Scenario], robot: Robot) -> Feedforward:
    """The named feedforward of a uniform group of scenarios."""
    first = scenarios[0]
    rigid = first.steering == "rigid"
    if first.feedforward == "none":
        return NoFeedforward(len(scenarios))
    if first.feedforward in ("model", "oracle"):  # the loop tells the oracle the truth
        return InverseDynamics([robot] * len(scenarios), rigid)
    if first.feedforward == "rls":
        return RecursiveLeastSquares(robot, [s.rls for s in scenarios], rigid)
    return FeedbackErrorLearning(robot, [s.fel for s in scenarios], [s.seed for s in scenarios], rigid)


# Share of what learning adds to the feedforward that the PID's integral gives up at once. With none, both hold the same
# voltage until the error has unwound the integral: the first lap overshoots, and the loop has one fast integrator too
# many. With all of it, learning has no integral action of its own, and tracks the position less well.
TAKE_OVER = 0.5


@njit((GIVEN, OWN), cache=True)
def _hand_over(taken, integrals):  # noqa: ANN001, ANN202
    for i in range(len(integrals)):
        for k in range(2):
            integrals[i, k] -= TAKE_OVER * taken[i, k]


def _rows(values: Array, like: Array) -> Array:
    """What somebody's own stage returned, in the shape and type that compiled loops rely on."""
    fits = isinstance(values, np.ndarray) and values.shape == like.shape and values.dtype == like.dtype
    return values if fits else np.broadcast_to(np.asarray(values, float), like.shape)


class Hierarchy:
    """Both controllers for B robots that share steering arrangement and rates.

    Attributes:
        feedforward: The feedforward stage.
        error: Measured posture error in the robot's frame, as of the motion controller's last tick, `(B, 3)`.
        command: Prefiltered twist command `(B, 2)`.
        derivative: Its derivative `(B, 2)`.
        feedback: Output of the PID for the two channels `(B, 2)`.
        parts: Feedback left and right, feedforward left and right in V, before the limit, `(B, 4)`.
        output: Voltages left and right in V, steering angle in rad and rate in rad/s, `(B, 4)`.
        finite: Whether all `parts` are finite numbers.
        saturated: 1 where a limit acted, `(B,)`.
    """

    def __init__(self, scenarios: Sequence[Scenario], robot: Robot, feedforward: Feedforward) -> None:
        """Takes a uniform group of scenarios, the nominal robot and a feedforward stage."""
        first, size = scenarios[0], len(scenarios)
        self.feedforward = feedforward
        self._robot = robot
        self._rigid = first.steering == "rigid"
        self._period = first.control_period
        self._every = round(first.motion_period / first.control_period)
        self._tick = 0
        self._prefilter = np.array([max(s.prefilter, s.control_period) for s in scenarios])
        self._limits = np.array(
            [robot.max_speed, robot.max_rotation, robot.max_acceleration, robot.max_rotation_acceleration]
        )
        self._parameters = steering.parameters(robot, self._rigid)
        self._kanayama = np.zeros((size, 3))
        self._pid = np.zeros((size, 2, 4))
        self._frozen = np.zeros(size)
        for row, scenario in enumerate(scenarios):
            self.set_kanayama(row, scenario.kanayama)
            self.set_pid(row, scenario.pid)
        self.state = {"limiter": np.zeros((size, 4)), "pid": np.zeros((size, 7)), "steering": np.zeros((size, 2))}
        self._request, self._correction = np.zeros((size, 2)), np.zeros((size, 2))
        self._excess, self._idle = np.zeros((size, 2)), np.zeros(size)
        self.error = np.zeros((size, 3))
        self.command, self.derivative = np.zeros((size, 2)), np.zeros((size, 2))
        self.feedback, self.parts = np.zeros((size, 2)), np.zeros((size, 4))
        self.output, self.saturated = np.zeros((size, 4)), np.zeros(size)
        self.finite = True
        self._no_weights = np.zeros(size)

    def set_kanayama(self, row: int, gains: Kanayama) -> None:
        """Changes the motion controller of one robot."""
        self._kanayama[row] = gains.k_x, gains.k_y, gains.k_theta

    def set_pid(self, row: int, design: Pid) -> None:
        """Changes the velocity feedback of one robot."""
        self._pid[row] = design.gains(self._robot, self._rigid)

    def set_learning(self, row: int, on: bool) -> None:
        """Lets the feedforward of one robot learn, or not."""
        self._frozen[row] = float(not on)

    def reset(self, twist: Array, acceleration: Array, steering_angle: Array) -> None:
        """Starts without a bump, as if the nominal robot had been driven here steadily.

        Args:
            twist: What the robots already do, `(B, 2)`.
            acceleration: Its derivative along the reference, `(B, 2)`.
            steering_angle: Angles of the forks in rad, `(B,)`.
        """
        self.state["limiter"][:, 2:] = twist
        self.state["steering"][:, 0] = steering_angle
        # The integral holds what the nominal robot takes here, less what the feedforward brings by itself.
        nominal = InverseDynamics([self._robot] * len(twist), self._rigid)
        integral = nominal.output(twist, acceleration) - self.feedforward.output(twist, acceleration)
        self.state["pid"][:, :2] = integral

    def update(self, pose: Array, twist: Array, reference: Array, reference_twist: Array, acceleration: Array) -> Array:
        """One control tick.

        Args:
            pose: Measured posture `(B, 3)`.
            twist: Measured twist `(B, 2)`.
            reference: Reference posture `(B, 3)`.
            reference_twist: Reference twist `(B, 2)`.
            acceleration: Its derivative `(B, 2)`.

        Returns:
            `output`, `(B, 4)`.
        """
        state = self.state
        _lead(
            self._tick % self._every == 0, pose, twist, reference, reference_twist, acceleration, self._kanayama,
            self._limits, self._prefilter, self._period, self._pid, self._excess, self.error, self._request,
            self._correction, state["limiter"], state["pid"], self.command, self.derivative, self.feedback,
        )  # fmt: skip
        self._tick += 1
        feedforward = _rows(self.feedforward.output(self.command, self.derivative), self.feedback)
        self.finite = _follow(
            self.command, self.derivative, self.feedback, feedforward, self._parameters, self._period, self._frozen,
            state["steering"], self.output, self.parts, self._excess, self.saturated, self._idle,
        )  # fmt: skip
        # A robot that must not learn is treated as one whose voltage did not act.
        taken = self.feedforward.learn(self.feedback, self._idle)
        if taken is not None:
            _hand_over(_rows(taken, self.feedback), state["pid"])
        return self.output

    @property
    def weight_norm(self) -> Array:
        """Size of what the feedforward has learned, `(B,)`."""
        return getattr(self.feedforward, "weight_norm", self._no_weights)
