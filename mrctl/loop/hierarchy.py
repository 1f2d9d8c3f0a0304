"""The hierarchy of the paper's figure 3: motion controller over velocity controller, for B robots.

    reference, posture → Kanayama → limiter, prefilter → PID + feedforward → guard → allocation → voltages, steering

With built-in stages a control tick of all robots is one compiled call.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mrctl.control import delay as late
from mrctl.control import guard as guarding
from mrctl.control.delay import DELAY, watch_delay
from mrctl.control.design import MotionDesign, motion
from mrctl.control.feedforward import Learner, Loop, Prior, Shown, learn_nothing, nothing, prior_voltage
from mrctl.control.guard import BACK_OFF, GUARD, NO_RESET_FACTOR, guard
from mrctl.control.kanayama import GAINS, Kanayama, kanayama, posture_error
from mrctl.control.learners import LEARNERS
from mrctl.control.limiter import LIMITER, limit
from mrctl.control.nominal import nominal
from mrctl.control.pid import PID, Pid, pid
from mrctl.control.rejection import Peaks, rejection
from mrctl.control.steering import ALLOCATION, allocate, steer, take_loss
from mrctl.kernel import Array, Held, Row, Rows, held, kernel
from mrctl.loop.learned import load_learned
from mrctl.loop.user_stages import UserFeedforward, UserStage
from mrctl.scenario import Scenario
from mrctl.sensing.scanner import Scanner
from mrctl.theory.references import Reference
from mrctl.theory.robot import Robot

MAX_LEARNING_SLIP = 0.1  # slip ratio above which the voltage does not explain the motion, and nothing is learned
# Share of the change of the feedforward by learning that the PID's integral gives up at once. With 0, both contain the
# same voltage until the error has unwound the integral: the first lap overshoots, and the loop has one fast integrator
# too many. With 1, learning has no integral action of its own, and the position is tracked less well.
HAND_OVER_SHARE = 0.5

CONTROL = np.dtype(
    [
        ("kanayama", GAINS),
        ("error", "f8", 3),  # posture error in the robot's frame, as of the motion controller's last tick, m, m, rad
        ("request", "f8", 2),  # twist that the motion controller requests, m/s and rad/s
        ("correction", "f8", 2),  # requested twist less the reference twist, m/s and rad/s
        ("limiter", LIMITER),
        ("pid", PID),
        ("feedback", "f8", 2),  # output of the PID, V (rad/s on a steering channel)
        ("prior", "f8", 2),  # scratch of `update`: feedforward of the prior, V
        ("feedforward", "f8", 2),  # feedforward of prior and learner, V (rad/s on a steering channel)
        ("nominal", "f8", 2),  # output of the nominal inverse dynamics, if guard or delay watch is on, V (rad/s)
        ("delay", DELAY),
        ("guard", GUARD),
        ("allocation", ALLOCATION),
        ("voltage", "f8", 2),  # voltage of the two channels after the limits, V (rad/s)
        ("learning_off", "?"),  # whether an event has switched learning off
        ("slips", "?"),  # whether a driven wheel slips
        ("frozen", "f8"),  # 1 where nothing may be learned from this tick, else 0
        ("added", "f8", 2),  # change of the feedforward by learning in this tick, V (rad/s)
        ("weight_norm", "f8"),  # norm of the learner's weights
    ],
    align=True,
)

respond, learn_one = nothing, learn_nothing  # the learner of `update`, which `Kernel.calling` replaces


@kernel
def request_motion(seen: Row, reference: Row, s: Row) -> None:
    """The motion controller: from posture error to requested twist."""
    posture_error(seen.pose, reference.pose, s.error)
    kanayama(s.error, reference.twist, s.kanayama, s.request)
    for k in range(2):
        s.correction[k] = s.request[k] - reference.twist[k]


@kernel
def command_motion(reference: Row, robot: Row, period: float, s: Row) -> None:
    """Limiter and prefilter: from requested to commanded twist; the correction is held between two motion periods."""
    for k in range(2):
        s.request[k] = reference.twist[k] + s.correction[k]
    limit(
        s.request, reference.twist, reference.acceleration, robot.max_twist, robot.max_acceleration, period, s.limiter
    )


@kernel
def watch(model: Row, robot: Row, period: float, s: Row) -> None:
    """The watch on the velocity loop, and the guard, which limits the feedforward or replaces it."""
    if s.guard.on or s.delay.on:
        prior_voltage(s.limiter.command, s.limiter.derivative, model, s.nominal)
    watch_delay(s.feedback, s.guard.output, s.nominal, period, s.delay)
    guard(s.guard, s.feedforward, s.nominal, s.error, s.voltage, period, robot.rigid, s.pid, s.feedback)


@kernel
def apply_voltages(seen: Row, robot: Row, period: float, s: Row) -> bool:
    """Allocation: from feedback, feedforward and the fork's angle to commands; returns whether they are finite."""
    a = s.allocation
    allocate(s.limiter.command, s.feedback, s.guard.output, period, robot, a)
    take_loss(seen.lost, robot.rigid, a)
    s.slips = not seen.slip <= MAX_LEARNING_SLIP  # NaN counts as slip
    s.frozen = 1.0 if a.saturated or s.learning_off or s.guard.frozen or s.slips else 0.0
    finite = True
    for k in range(2):
        s.voltage[k] = s.feedback[k] + s.guard.output[k] + a.excess[k]
        finite &= np.isfinite(a.feedback[k]) and np.isfinite(a.feedforward[k])
    return finite


@kernel
def hand_over(s: Row) -> None:
    """The PID's integral gives up a share of what learning added: ∫ ← ∫ − `HAND_OVER_SHARE` · authority · added.

    Where that is not finite, nothing is taken, and the guard, if it is on, replaces the learner in the next tick.
    """
    for k in range(2):
        if not np.isfinite(s.added[k]):
            s.guard.broken, s.added[k] = True, 0.0
        taken = HAND_OVER_SHARE * s.guard.authority * s.added[k]
        s.pid.integral[k] -= taken
        if s.guard.hands_over:
            s.guard.handed[k] += taken


@kernel
def update(motion_due: bool, seen: Rows, reference: Rows, period: float, place: int) -> tuple[bool, bool]:
    """One control tick of all robots, with the learner `respond` and `learn_one`.

    Args:
        motion_due: Whether the motion controller acts in this tick.
        seen: Record of `SEEN` of each robot.
        reference: Record of `REFERENCE` of each robot.
        period: Control period in s.
        place: Address (see `Held`) of the nominal robot, one record of `NOMINAL`; its inverse dynamics, records of
            `PRIOR`, of which the first is read; a record of `PRIOR` and one of `CONTROL` of each robot; and a tuple of
            what the learner keeps.

    Returns:
        Whether all voltages are finite, and whether a robot asks for what `answer` does.
    """
    robot, model, prior, control, arrays = held(place)
    finite, asks = True, False
    for i in range(len(control)):
        s, measured, wanted = control[i], seen[i], reference[i]
        if motion_due:
            request_motion(measured, wanted, s)
        command_motion(wanted, robot[0], period, s)
        command, derivative = s.limiter.command, s.limiter.derivative
        pid(command, measured.twist, s.allocation.excess, period, s.pid, s.feedback)
        prior_voltage(command, derivative, prior[i], s.prior)
        respond(i, command, derivative, robot[0], arrays, s.feedforward)
        for k in range(2):
            s.feedforward[k] += s.prior[k]
        watch(model[0], robot[0], period, s)
        steer(command, derivative, s.feedback, s.guard.output, period, robot[0], s.allocation)
        finite &= apply_voltages(measured, robot[0], period, s)
        shown = Shown(command, derivative, s.guard.teaching, s.frozen, measured.twist, s.voltage, period)
        s.weight_norm = learn_one(i, shown, robot[0], prior[i], arrays, s.added)
        hand_over(s)
        asks |= s.guard.forget | s.delay.due
    return finite, asks


def learner_of(scenarios: Sequence[Scenario], robot: Robot, delay: int) -> Learner:
    """Returns the learner that a uniform group of scenarios names; `delay` is that of the loop in control periods."""
    first, seeds = scenarios[0], [s.seed for s in scenarios]
    loop = Loop(robot, first.steering == "rigid", first.control_period, delay, first.prior != "none", seeds)
    return LEARNERS[first.learner](loop, [getattr(s, s.learner, None) for s in scenarios])


@dataclass
class Settings:
    """What the controllers of one robot are designed from, and the design of its motion controller.

    Attributes:
        pid: Settings of the PID.
        kanayama: Gains of the motion controller; those that are not set are designed.
        prefilter: Time constant of the prefilter in s; by default it is designed.
        delay: Delay of the loop that the controllers know from the start, in s.
        learned: What its learner starts from; by default nothing.
        design: Design of its motion controller.
    """

    pid: Pid
    kanayama: Kanayama
    prefilter: float | None
    delay: float
    learned: Any
    design: MotionDesign = field(init=False)

    @property
    def motion(self) -> MotionDesign:
        """The motion controller: its design, in which gains that are set replace the designed ones."""
        return self.design._replace(kanayama=self.kanayama.completed(self.design.kanayama))


class Hierarchy:
    """Both controllers for the B robots of a uniform group (`groups.group_of`).

    Attributes:
        stages: The user's stages by name, which `UserHierarchy` calls in place of the built-in ones, and the user's
            estimator, for whose latency the controllers are designed.
        learner: The learner, or a user's feedforward in its place.
        prior: The prior of the feedforward, whose output is added to that of the learner.
        settings: Settings and design of each robot.
        state: Record of `CONTROL` of each robot, `(B,)`; the following arrays are views of it.
        command: Commanded V in m/s and θ̇ in rad/s, after prefilter and limits, `(B, 2)`.
        derivative: Its derivative in m/s² and rad/s², `(B, 2)`.
        feedback: Output of the PID for the two channels in V (rad/s on a steering channel), `(B, 2)`.
        output: Voltages left and right in V, steering angle in rad and rate in rad/s, `(B, 4)`.
        saturated: Whether a limit acted, `(B,)`.
        weight_norm: Norm of the learner's weights, `(B,)`.
        faults: For each robot whose commands of the last tick cannot be used, the reason why it fails.
        scanner: The lidars, for stages that take their scans, or None.
        tick: Number of control ticks done.
        started: Tick at which the clock of the motion controller was last started.
        robot: The nominal robot.
        rigid: Whether its steering is `rigid`, so that the second channel is steering.
        nominal: Its parameters for the kernels, one record of `NOMINAL`, `(1,)`.
        model: Its inverse dynamics for each robot.
        period: Control period in s.
        looks: Whether the motion controller takes the scans of a lidar, as only a user's may.
        tunable: Whether it takes gains of Kanayama's law, which a user's need not.
        roams: Whether it goes along the reference at its own pace or leaves it, as only a user's may.
        gains: Gains of each robot before any event, by the names and in the units of `dataset.GAIN_VARIABLES`: `(B, 2)`
            for `k_p` and `k_i`, `(B,)` for the others.
    """

    def __init__(
        self, scenarios: Sequence[Scenario], robot: Robot, stages: Mapping[str, UserStage] | None = None
    ) -> None:
        """Wires the stages.

        Args:
            scenarios: A uniform group of scenarios.
            robot: The nominal robot.
            stages: The user's stages, by name.

        Raises:
            InputError: What was learned or the weights cannot be read, or do not suit the learner, or the user's
                feedforward was made for another steering.
        """
        first, size = scenarios[0], len(scenarios)
        self.robot, self.rigid, self.stages = robot, first.steering == "rigid", stages or {}
        self.period, self.tick, self.started = first.control_period, 0, 0
        self._every = round(first.motion_period / first.control_period)
        self.nominal = nominal(robot, self.rigid)
        self.model = Prior([robot] * size, self.rigid)
        self.prior = Prior([None if first.prior == "none" else robot] * size, self.rigid)  # `set_truth` follows
        self._knows_truth = first.prior == "true_model"
        estimator = "user" if "estimator" in self.stages else None
        delays = [s.sensing.loop_delay(self.period, estimator) for s in scenarios]
        if own := self.stages.get("feedforward"):
            self.learner = UserFeedforward(own, self.prior, self.rigid, self.period, delays[0] * self.period)
            load = self.learner.load
        else:
            self.learner, load = learner_of(scenarios, robot, delays[0]), load_learned
            self.learner.prior = self.prior
        self.settings = [
            Settings(s.pid, s.kanayama, s.prefilter, delay * self.period, load(s) if s.learned else None)
            for s, delay in zip(scenarios, delays, strict=True)
        ]
        self._adopt(range(size))
        self.state = state = np.zeros(size, CONTROL)
        self.command, self.derivative = state["limiter"]["command"], state["limiter"]["derivative"]
        self.feedback, self.weight_norm = state["feedback"], state["weight_norm"]
        self.output, self.saturated = state["allocation"]["command"], state["allocation"]["saturated"]
        for row in range(size):
            self._set_watch(row)
            self._design_pid(row)
            self._design_motion(row)
        rejected = np.array([self._rejection(row) for row in range(size)])
        unaided = first.prior == "none"
        state["guard"] = guarding.fresh([s.guard for s in scenarios], self.nominal, rejected, unaided)
        state["guard"]["on"] &= self.learner.guarded
        self.gains: dict[str, Array] = {name: state["pid"][name].copy() for name in ("k_p", "k_i")}
        self.gains |= {name: state["kanayama"][name].copy() for name in ("k_x", "k_y", "k_theta")}
        self.gains["prefilter"] = state["limiter"]["time_constant"].copy()
        if isinstance(self.learner, Learner):
            self._held = Held(self.nominal, self.model.rows, self.prior.rows, state, self.learner.arrays)
            laws = {"respond": self.learner.respond, "learn_one": self.learner.learn_one}
            self._update = update.calling(**laws, held=self._held.reader).repeated()
        self.faults: dict[int, str] = {}
        self.scanner: Scanner | None = None
        mover = self.stages.get("motion")
        self.looks, self.roams = bool(mover and mover.has("see")), bool(mover and mover.has("follow"))
        self.tunable = not mover or mover.has("tune")

    def set_kanayama(self, row: int, gains: Kanayama) -> None:
        """Changes the motion controller of one robot; gains that are not set are those of its last design."""
        self.settings[row].kanayama = gains
        self._set_motion(row)
        self._tolerate(row)

    def _set_motion(self, row: int) -> None:
        """Writes the gains and the prefilter of one robot into its record."""
        gains, prefilter, _ = self.settings[row].motion
        self.state["kanayama"][row] = gains.k_x, gains.k_y, gains.k_theta
        self.state["limiter"]["time_constant"][row] = prefilter

    def set_pid(self, row: int, design: Pid) -> None:
        """Changes the PID of one robot; what an oscillation has shown of its loop stays, unless it is not watched."""
        self.settings[row].pid = design
        self._set_watch(row)
        self._design_pid(row)
        self._tolerate(row)

    def _set_watch(self, row: int) -> None:
        """Decides whether the loop of one robot is watched for oscillations; only that of the built-in PID can be."""
        design, watch = self.settings[row].pid, self.state["delay"]
        watched = design.retune and design.time_constant is None and "feedback" not in self.stages
        if not watched:
            watch["moves"][row] = 0.0
        watch["on"][row] = watched and watch["moves"][row] < late.MAX_MOVES
        supply, second = guarding.ranges(self.nominal)
        own = self.rigid and (design.steering_kp is not None or design.steering_ki is not None)
        watch["least"][row] = late.MIN_AMPLITUDE * supply, np.inf if own else late.MIN_AMPLITUDE * second
        watch["most_explained"][row] = late.MAX_EXPLAINED * supply, late.MAX_EXPLAINED * second

    def _design_pid(self, row: int) -> None:
        """Computes the gains of the PID of one robot."""
        pid, delay = self.lengthened(row, self.settings[row].pid)
        for name, value in pid.gains(self.robot, self.rigid, delay, self.period).items():
            self.state["pid"][name][row] = value

    def lengthened(self, row: int, pid: Pid, ahead: int = 0) -> tuple[Pid, float]:
        """Returns a PID for one robot and the delay of its loop in s, both with the delay that the moves have added.

        Args:
            row: Index of the robot.
            pid: The settings.
            ahead: Number of further moves to count.
        """
        steps = (int(self.state["delay"]["moves"][row]) + ahead) // 2
        added = steps * max(1, round(late.DELAY_STEP / self.period)) * self.period
        if pid.delay is not None:
            pid = pid.model_copy(update={"delay": pid.delay + added})
        return pid, self.settings[row].delay + added

    def _move(self, row: int) -> None:
        """Makes the next move of `mrctl.control.delay` for one robot; a user's motion controller is not slowed down."""
        watch, slows_motion = self.state["delay"], "motion" not in self.stages
        watch["moves"][row] += 1 if slows_motion else 2
        moves = watch["moves"][row]
        watch["on"][row] = moves < late.MAX_MOVES
        if moves <= 2 * late.LEARNER_MOVES and (moves % 2 or not slows_motion):
            self.state["guard"]["gain"][row] /= BACK_OFF
        self._design_pid(row)
        if slows_motion:
            self._design_motion(row)
        self._tolerate(row)

    def _design_motion(self, row: int) -> None:
        """Designs the motion controller of one robot; after odd moves it has one step of delay more than the PID."""
        own = self.settings[row]
        pid, delay = self.lengthened(row, own.pid, ahead=1)
        gains = pid.channels(self.robot, self.rigid, delay, self.period)
        own.design = motion(self.robot, self.rigid, gains, delay, self.period, own.prefilter)
        self._set_motion(row)

    def _tolerate(self, row: int) -> None:
        """Computes anew the deviation D that the guard of one robot tolerates, which depends on both controllers."""
        guard = self.state["guard"]
        gains = np.array(self._rejection(row))
        guard["harmless"][row], guard["harmless_to_posture"][row] = guarding.harmless(guard["region"][row], gains)
        guard["to_posture"][row] = gains[:, 1]

    def _rejection(self, row: int) -> tuple[Peaks, Peaks]:
        """Returns the peak-to-peak gains from a voltage to the errors of one robot under its controllers."""
        own = self.settings[row]
        pid, delay = self.lengthened(row, own.pid)
        gains = pid.channels(self.robot, self.rigid, delay, self.period)
        return rejection(self.robot, self.rigid, gains, own.motion, delay, self.period)

    def set_reference(self, row: int, reference: Reference) -> None:
        """Does nothing: the built-in law reads the reference in each tick. `UserHierarchy` tells the user's stage."""

    def set_learning(self, row: int, on: bool) -> None:
        """Switches learning of one robot on or off."""
        self.state["learning_off"][row] = not on

    def set_truth(self, row: int, robot: Robot) -> None:
        """Gives the prior `true_model` the true parameters of one robot; other priors ignore them."""
        if self._knows_truth:
            self.prior.set_robot(row, robot)

    def renew(self, row: int, scenario: Scenario) -> None:
        """Gives one robot the settings and the initial memory of a scenario, before `reset`.

        Args:
            row: Index of the robot.
            scenario: A scenario that fits the group.
        """
        renewed = Hierarchy([scenario], self.robot, self.stages)
        self.state[row] = renewed.state[0]
        self.prior.rows[row] = renewed.prior.rows[0]
        self.settings[row] = renewed.settings[0]
        for name, values in self.gains.items():
            values[row] = renewed.gains[name][0]
        mine, other = self.learner, renewed.learner
        assert isinstance(mine, Learner) and isinstance(other, Learner)
        mine.take(row, other)

    def restart_clock(self) -> None:
        """Starts a motion period at the coming tick."""
        self.started = self.tick

    @property
    def motion_period(self) -> float:
        """Time between two requests of the motion controller in s."""
        return self.period * self._every

    @property
    def motion_due(self) -> bool:
        """Whether the motion controller acts in the coming tick."""
        return (self.tick - self.started) % self._every == 0

    def reset(self, twist: Array, acceleration: Array, steering_angle: Array, rows: int | slice = slice(None)) -> None:
        """Bumpless start: the integral holds the voltage that the nominal robot needs for its initial motion.

        Where the feedforward knows the robot, from a file or because the prior is `true_model`, the integral holds
        nothing: it would cancel what is known.

        Args:
            twist: Initial twist of the robots in m/s and rad/s, `(B, 2)`.
            acceleration: Its derivative along the reference in m/s² and rad/s², `(B, 2)`.
            steering_angle: Angles of the forks in rad, `(B,)`.
            rows: Indices of the robots that start.
        """
        self.command[rows] = twist[rows]
        self.state["allocation"]["angle"][rows] = steering_angle[rows]
        knows = np.array([self._knows_truth or own.learned is not None for own in self.settings])
        self.state["pid"]["integral"][rows] = np.where(knows[:, None], 0.0, self.steady(twist, acceleration))[rows]

    def steady(self, twist: Array, acceleration: Array) -> Array:
        """Returns the voltage that the nominal robot needs for a motion, less that of the feedforward, `(B, 2)`."""
        return self.model.output(twist, acceleration) - self.feedforward(twist, acceleration)

    def feedforward(self, command: Array, derivative: Array) -> Array:
        """Returns the feedforward of prior and learner at a motion, `(B, 2)`."""
        return self.prior.output(command, derivative) + self.learner.output(command, derivative)

    def update(self, seen: Rows, reference: Rows) -> Array:
        """Computes the commands of one control tick.

        Args:
            seen: Estimate of each robot, a record of `SEEN`, `(B,)`.
            reference: Reference of each robot at the time when the voltage acts, a record of `REFERENCE`, `(B,)`.

        Returns:
            `output`, `(B, 4)`.
        """
        finite, asks = self._update(self.motion_due, seen, reference, self.period, self._held.place)
        if asks:
            self.answer()
        self.faults = {} if finite else self.non_finite()  # the voltage limit would turn NaN into the full voltage
        self.tick += 1
        return self.output

    def non_finite(self) -> dict[int, str]:
        """Returns the faults of the robots whose voltages of the last tick are not finite."""
        a = self.state["allocation"]
        finite = np.isfinite(a["feedback"]).all(axis=1) & np.isfinite(a["feedforward"]).all(axis=1)
        return dict.fromkeys(np.flatnonzero(~finite).tolist(), "non-finite voltage")

    def answer(self) -> None:
        """Does what the tick asked for: designs controllers for more delay, and resets the learners of some guards.

        A learner that cannot be reset learns more slowly instead.
        """
        for row in np.flatnonzero(self.state["delay"]["due"]):
            self._move(int(row))
        rows = np.flatnonzero(self.state["guard"]["forget"])
        if rows.size and not self.restore(rows):
            self.state["guard"]["gain"][rows] *= NO_RESET_FACTOR

    def restore(self, rows: NDArray[np.intp]) -> bool:
        """Resets the learners of these robots; returns whether the stage can be reset."""
        if not self.learner.restorable:
            return False
        self.learner.restore(rows)
        self._adopt(rows.tolist())
        self.weight_norm[rows] = 0.0
        return True

    def _adopt(self, rows: Iterable[int]) -> None:
        """Lets the learners of these robots start from the files that their scenarios name."""
        for row in rows:
            if (learned := self.settings[row].learned) is not None:
                self.learner.adopt(row, learned)
