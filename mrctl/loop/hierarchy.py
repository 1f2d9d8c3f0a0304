"""The paper's figure 3: motion controller over velocity controller, wired for B robots."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numba import boolean, float64, njit
from numpy.typing import NDArray

from mrctl.control import steering
from mrctl.control.chain import ANY, EACH, GIVEN, OWN, one, rows, stamp
from mrctl.control.composite import CompositeAdaptation
from mrctl.control.feedforward import Feedforward, InverseDynamics, NoFeedforward, features, linear
from mrctl.control.fel import FeedbackErrorLearning
from mrctl.control.guard import UNSURE, WATCH, guard, watches
from mrctl.control.kanayama import Kanayama, kanayama, posture_error
from mrctl.control.limiter import limit
from mrctl.control.observer import DisturbanceObserver
from mrctl.control.pid import Pid, pid
from mrctl.control.rls import RecursiveLeastSquares
from mrctl.control.stages import Own
from mrctl.control.steering import allocate
from mrctl.scenario import Scenario
from mrctl.theory.robot import Robot

Array = NDArray[np.float64]

_kanayama, _limit, _pid, _allocate = one(kanayama), one(limit), one(pid), one(allocate)
SLIPS = 0.1  # slip ratio beyond which a wheel's voltage says nothing about the motion
HALF_TRACK = 4  # where it is in `steering.parameters`
_features, _linear, _guard = one(features), one(linear), one(guard)


# All that the hierarchy keeps of one robot: settings, memory, and what it computed last; shapes as in the laws.
# One array of these is one argument of a compiled loop, and a call costs by the argument.
STATE = np.dtype(
    [
        ("kanayama", "f8", 3), ("prefilter", "f8"), ("pid_gains", "f8", (2, 4)), ("frozen", "f8"), ("slips", "f8"),
        ("correction", "f8", 2), ("limiter", "f8", 4), ("pid", "f8", 7), ("steering", "f8", 2), ("excess", "f8", 2),
        ("error", "f8", 3), ("request", "f8", 2), ("command", "f8", 2), ("derivative", "f8", 2),
        ("feedback", "f8", 2), ("parts", "f8", 4), ("output", "f8", 4), ("voltage", "f8", 2),
        ("saturated", "f8", (1,)), ("idle", "f8"), ("guard", WATCH),
    ],
    align=True,
)  # fmt: skip


def _compile(version: int) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """The laws before and after the feedforward, each chained for all robots; see `chain.stamp` for the version."""

    @njit((boolean, *[GIVEN] * 3, EACH, float64, rows(STATE)), cache=True)
    def lead(moves, pose, twist, reference, limits, period, state):  # noqa: ANN001, ANN202
        """Posture to commanded motion and feedback: motion controller (where it moves), limiter, PID."""
        _ = version
        wish = np.empty(2)
        for i in range(len(state)):
            s, v, acceleration = state[i], reference[i, 3:5], reference[i, 5:]
            if moves:
                _kanayama(pose[i], reference[i, :3], v, s.kanayama, s.error, s.request)
                for k in range(2):
                    s.correction[k] = s.request[k] - v[k]
            for k in range(2):
                wish[k] = v[k] + s.correction[k]
            _limit(wish, v, acceleration, limits, s.prefilter, period, s.limiter, s.command, s.derivative)
            _pid(s.command, twist[i], s.pid_gains, period, s.excess, s.pid, s.feedback)

    @njit((GIVEN, ANY, ANY, EACH, OWN, float64, rows(STATE)), cache=True)
    def follow(feedforward, norm, slip, robot, inverse, period, state):  # noqa: ANN001, ANN202
        """Feedback and feedforward to voltages and steering.

        Returns whether all of them are finite, and whether a guard wants a learner to forget.
        """
        _ = version
        finite, restore = True, False
        ones, x, nominal = np.ones(8), np.empty(8), np.empty(2)
        for i in range(len(state)):
            s = state[i]
            if s.guard.on > 0:
                _features(s.command, s.derivative, robot[HALF_TRACK], ones, x)
                _linear(x, inverse, nominal)
            _guard(
                s.guard, feedforward[i], nominal, s.error, norm[i], s.saturated[0], s.voltage, period, s.pid, s.feedback
            )
            restore |= s.guard.restore > 0
            _allocate(
                s.command, s.derivative, s.feedback, s.guard.output, robot, period,
                s.steering, s.output, s.parts, s.excess, s.saturated,
            )  # fmt: skip
            for k in range(2):
                s.voltage[k] = s.feedback[k] + s.guard.output[k] + s.excess[k]
            s.slips = 0.0 if slip[i] <= SLIPS else 1.0  # NaN is no rolling
            s.idle = max(s.saturated[0], s.frozen, s.guard.idle, s.slips)
            for k in range(4):
                finite &= np.isfinite(s.parts[k])
        return finite, restore

    return lead, follow


_lead, _follow = _compile(stamp(kanayama, limit, pid, features, guard, allocate))


def feedforward_of(scenarios: Sequence[Scenario], robot: Robot) -> Feedforward:
    """The named feedforward of a uniform group of scenarios."""
    first = scenarios[0]
    rigid = first.steering == "rigid"
    if first.feedforward == "none":
        return NoFeedforward(len(scenarios))
    if first.feedforward in ("model", "oracle"):  # the loop tells the oracle the truth
        return InverseDynamics([robot] * len(scenarios), rigid)
    if first.feedforward == "observer":
        return DisturbanceObserver(robot, [s.observer for s in scenarios], rigid, first.control_period)
    if first.feedforward == "composite":
        return CompositeAdaptation(robot, [s.composite for s in scenarios], rigid, first.control_period)
    if first.feedforward == "rls":
        return RecursiveLeastSquares(robot, [s.rls for s in scenarios], rigid)
    return FeedbackErrorLearning(robot, [s.fel for s in scenarios], [s.seed for s in scenarios], rigid)


# Share of what learning adds to the feedforward that the PID's integral gives up at once. With none, both hold the same
# voltage until the error has unwound the integral: the first lap overshoots, and the loop has one fast integrator too
# many. With all of it, learning has no integral action of its own, and tracks the position less well.
TAKE_OVER = 0.5


@njit((GIVEN, rows(STATE)), cache=True)
def _hand_over(taken, state):  # noqa: ANN001, ANN202
    for i in range(len(state)):
        for k in range(2):
            state[i].pid[k] -= TAKE_OVER * state[i].guard.authority * taken[i, k]


def _take(mine: dict[str, Any], theirs: dict[str, Any], row: int, size: int) -> None:
    """Copies what a stage for one robot keeps into a row of the same stage for several."""
    for name, value in mine.items():
        if isinstance(value, dict):
            _take(value, theirs[name], row, size)
        elif isinstance(value, np.ndarray) and value.shape[:1] == (size,) and theirs[name].shape[:1] == (1,):
            value[row] = theirs[name][0]


class Hierarchy:
    """Both controllers for B robots that share steering arrangement and rates.

    Attributes:
        feedforward: The feedforward stage.
        state: Everything else that is kept, one `STATE` a robot; what follows are views of it.
        error: Measured posture error in the robot's frame, as of the motion controller's last tick, `(B, 3)`.
        command: Prefiltered twist command `(B, 2)`.
        derivative: Its derivative `(B, 2)`.
        feedback: Output of the PID for the two channels `(B, 2)`.
        parts: Feedback left and right, feedforward left and right in V, before the limit, `(B, 4)`.
        output: Voltages left and right in V, steering angle in rad and rate in rad/s, `(B, 4)`.
        finite: Whether all `parts` are finite numbers.
        saturated: 1 where a limit acted, `(B,)`.
        faults: Which robots somebody's own stage gave no finite number for in the last tick, and what to say of it.
    """

    def __init__(
        self,
        scenarios: Sequence[Scenario],
        robot: Robot,
        feedforward: Feedforward | None = None,
        own: Mapping[str, Own] | None = None,
    ) -> None:
        """Wires the stages.

        Args:
            scenarios: A uniform group.
            robot: The nominal robot.
            feedforward: Instead of the named one, and trusted.
            own: Somebody's own stages by name, which are not; they run in Python around the compiled loops.
        """
        first, size = scenarios[0], len(scenarios)
        self._own = dict(own or {})
        self._motion, self._feedback, self._steering = map(self._own.get, ("motion", "feedback", "steering"))
        self._feedforward = self._own.get("feedforward")
        if self._feedforward:
            feedforward = self._feedforward.stage
        self.feedforward = feedforward = feedforward or feedforward_of(scenarios, robot)
        self.faults: dict[int, str] = {}
        self._robot = robot
        self._rigid = first.steering == "rigid"
        self._period = first.control_period
        self._every = round(first.motion_period / first.control_period)
        self._tick = 0
        self._limits = np.array(
            [robot.max_speed, robot.max_rotation, robot.max_acceleration, robot.max_rotation_acceleration]
        )
        self._parameters = steering.parameters(robot, self._rigid)
        self._nominal = InverseDynamics([robot] * size, self._rigid)
        self.state = state = np.zeros(size, STATE)
        state["prefilter"] = [max(s.prefilter, s.control_period) for s in scenarios]
        for row, scenario in enumerate(scenarios):
            self.set_kanayama(row, scenario.kanayama)
            self.set_pid(row, scenario.pid)
        volts = np.broadcast_to(getattr(feedforward, "weight_volts", 0.0), size)
        state["guard"] = watches([s.guard for s in scenarios], robot.supply, robot.max_rotation, volts, self._rigid)
        if type(feedforward) in (NoFeedforward, InverseDynamics):
            state["guard"]["on"] = 0.0
        self.error, self.command, self.derivative = state["error"], state["command"], state["derivative"]
        self.feedback, self.parts, self.output = state["feedback"], state["parts"], state["output"]
        self.saturated, self._idle, self._voltage = state["saturated"][:, 0], state["idle"], state["voltage"]
        self._teaching = state["guard"]["teaching"]
        self.finite = True
        self._no_weights = np.zeros(size)

    def set_kanayama(self, row: int, gains: Kanayama) -> None:
        """Changes the motion controller of one robot."""
        self.state["kanayama"][row] = gains.k_x, gains.k_y, gains.k_theta

    def set_pid(self, row: int, design: Pid) -> None:
        """Changes the velocity feedback of one robot."""
        self.state["pid_gains"][row] = design.gains(self._robot, self._rigid)

    def set_learning(self, row: int, on: bool) -> None:
        """Lets the feedforward of one robot learn, or not."""
        self.state["frozen"][row] = float(not on)

    def renew(self, row: int, scenario: Scenario) -> None:
        """Gives one robot the settings and the memory of a new one, before `reset`; stages must be built in.

        Args:
            row: Which.
            scenario: One that fits the group.
        """
        fresh = Hierarchy([scenario], self._robot)
        self.state[row] = fresh.state[0]
        _take(vars(self.feedforward), vars(fresh.feedforward), row, len(self.state))

    def restart_clock(self) -> None:
        """Counts the motion controller's periods from here on."""
        self._tick = 0

    def reset(self, twist: Array, acceleration: Array, steering_angle: Array, rows: int | slice = slice(None)) -> None:
        """Starts without a bump, as if the nominal robot had been driven here steadily.

        Args:
            twist: What the robots already do, `(B, 2)`.
            acceleration: Its derivative along the reference, `(B, 2)`.
            steering_angle: Angles of the forks in rad, `(B,)`.
            rows: Which of them start.
        """
        self.state["limiter"][rows, 2:] = twist[rows]
        self.state["steering"][rows, 0] = steering_angle[rows]
        # The integral holds what the nominal robot takes here, less what the feedforward brings by itself.
        integral = self._nominal.output(twist, acceleration) - self._forward(twist, acceleration)
        self.state["pid"][rows, :2] = integral[rows]
        if self._feedback:
            self._feedback.tell("reset", integral, self._period)
        if self._steering:
            self._steering.tell("reset", steering_angle, self._period)

    def update(self, pose: Array, twist: Array, reference: Array, slip: Array) -> Array:
        """One control tick.

        Args:
            pose: Measured posture `(B, 3)`.
            twist: Measured twist `(B, 2)`.
            reference: Reference posture, twist and its derivative side by side, `(B, 7)`.
            slip: Slip ratio of the driven wheels `(B,)`; see `measurement.watch_slip`.

        Returns:
            `output`, `(B, 4)`.
        """
        state, stage = self.state, self.feedforward
        moves = self._tick % self._every == 0
        if self._own:
            self.faults.clear()
        if self._motion and moves:
            self._move(self._motion, pose, twist, reference)
        _lead(moves and not self._motion, pose, twist, reference, self._limits, self._period, state)
        if self._feedback:
            self._feed_back(self._feedback, twist)
        self._tick += 1
        feedforward = self._forward(self.command, self.derivative)
        self.finite, forget = _follow(
            feedforward, self.weight_norm, slip, self._parameters, self._nominal.coefficients[0], self._period, state
        )
        if self._steering:
            self._steer(self._steering)
        # A robot that must not learn is treated as one whose voltage did not act.
        if not self._feedforward:
            taken = stage.learn(self._teaching, self._idle, twist, self._voltage)
        else:
            taken = self._feedforward.tell("learn", self._teaching, self._idle, twist, self._voltage)
            if taken is not None:
                taken = self._feedforward.fitting(taken, self.feedback.shape, "what `learn` returns")
                taken = self._sound(self._feedforward, taken)
        if taken is not None:
            _hand_over(taken, state)
        if self._feedback and (integral := getattr(self._feedback.stage, "integral", None)) is not None:
            integral[:] = state["pid"][:, :2]
        if forget:
            self._forget()
        return self.output

    def _forward(self, command: Array, derivative: Array) -> Array:
        """The feedforward's output."""
        if not self._feedforward:
            return self.feedforward.output(command, derivative)
        return self._sound(self._feedforward, self._feedforward.ask("output", command, derivative))

    def _move(self, own: Own, pose: Array, twist: Array, reference: Array) -> None:
        """Asks somebody's own motion controller."""
        if self._tick == 0:
            own.tell("reset", pose, reference, self._period * self._every)
        state = self.state
        posture_error(pose, reference[:, :3], state["error"])
        state["request"] = self._sound(own, own.ask("output", pose, twist, reference))
        state["correction"] = state["request"] - reference[:, 3:5]

    def _feed_back(self, own: Own, twist: Array) -> None:
        """Asks somebody's own feedback, and shows its integral to guard and hand-over."""
        state = self.state
        self.feedback[:] = self._sound(own, own.ask("output", self.command, twist, state["excess"]))
        integral = getattr(own.stage, "integral", None)
        state["pid"][:, :2] = 0.0 if integral is None else own.fitting(integral, self.feedback.shape, "`integral`")

    def _steer(self, own: Own) -> None:
        """Asks somebody's own law of the fork, and limits it as `steering.allocate` does."""
        state, wish, limit = self.state, self.command.copy(), self._robot.steering_limit
        if self._rigid:
            wish[:, 1] += self.feedback[:, 1] + state["guard"]["output"][:, 1]
        answer = self._sound(own, own.ask("output", wish, self.derivative))
        angle = np.clip(answer[:, 0], -limit, limit)
        beyond = angle != answer[:, 0]
        rate = np.where(beyond, 0.0, answer[:, 1])
        self.output[:, 2], self.output[:, 3] = np.clip(angle + rate * self._period / 2, -limit, limit), rate
        if self._rigid:  # the fork is what makes θ̇, so its limit is one of the second channel
            clipped = (self.output[:, :2] != self.parts[:, :2] + self.parts[:, 2:]).any(axis=1)
            made = wish[:, 0] * np.tan(angle) / self._robot.wheelbase
            state["excess"][:, 1] = np.where(beyond, made - wish[:, 1], 0.0)
            self.saturated[:] = beyond | clipped
            self._voltage[:, 1] = wish[:, 1] - self.command[:, 1] + state["excess"][:, 1]
            self._idle[:] = np.max([self.saturated, state["frozen"], state["guard"]["idle"], state["slips"]], axis=0)

    def _sound(self, own: Own, answer: Array) -> Array:
        """An answer without the rows that are not finite, which are noted."""
        broken = np.any(~np.isfinite(answer), axis=1)
        for row in np.flatnonzero(broken):
            self.faults.setdefault(int(row), f"{own.title}: not finite")
        return np.where(broken[:, None], 0.0, answer) if broken.any() else answer

    def _forget(self) -> None:
        """Takes learners that failed back to what they began with; one that cannot has to go on more slowly."""
        rows = np.flatnonzero(self.state["guard"]["restore"])
        if getattr(self.feedforward, "restore", None):
            self._feedforward.tell("restore", rows) if self._feedforward else self.feedforward.restore(rows)  # type: ignore
        else:
            self.state["guard"]["gain"][rows] *= UNSURE

    @property
    def weight_norm(self) -> Array:
        """Size of what the feedforward has learned, `(B,)`."""
        norm = getattr(self.feedforward, "weight_norm", self._no_weights)
        return self._feedforward.fitting(norm, self._no_weights.shape, "`weight_norm`") if self._feedforward else norm
