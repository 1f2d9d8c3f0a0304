"""The hierarchy with a user's own stages, which are called between the compiled laws."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mrctl.control.feedforward import Learner
from mrctl.control.kanayama import Kanayama, posture_error
from mrctl.control.pid import pid
from mrctl.control.steering import steer
from mrctl.kernel import Array, Rows, kernel
from mrctl.loop.hierarchy import Hierarchy, apply_voltages, command_motion, hand_over, request_motion, watch
from mrctl.loop.user_stages import StageError, UserStage
from mrctl.scenario import Scenario
from mrctl.theory.rays import Scan
from mrctl.theory.references import Reference
from mrctl.theory.robot import Robot

REPLACED = {"motion": ("k_x", "k_y", "k_theta"), "feedback": ("k_p", "k_i")}
"""Gains of `GAIN_VARIABLES` whose law a stage of the user with this name replaces; a result has NaN for them."""


@kernel
def request_all(seen: Rows, reference: Rows, control: Rows) -> None:
    """Calls `request_motion` for all robots."""
    for i in range(len(control)):
        request_motion(seen[i], reference[i], control[i])


@kernel
def errors_of_all(seen: Rows, reference: Rows, control: Rows) -> None:
    """Calls `posture_error` for all robots."""
    for i in range(len(control)):
        posture_error(seen[i].pose, reference[i].pose, control[i].error)


@kernel
def command_all(seen: Rows, reference: Rows, robot: Rows, period: float, control: Rows) -> None:
    """Calls limiter, prefilter and PID for all robots."""
    for i in range(len(control)):
        s = control[i]
        command_motion(reference[i], robot[0], period, s)
        pid(s.limiter.command, seen[i].twist, s.allocation.excess, period, s.pid, s.feedback)


@kernel
def watch_all(model: Rows, robot: Rows, period: float, control: Rows) -> None:
    """Calls `watch` for all robots."""
    for i in range(len(control)):
        watch(model[0], robot[0], period, control[i])


@kernel
def steer_all(robot: Rows, period: float, control: Rows) -> None:
    """Calls `steer` for all robots."""
    for i in range(len(control)):
        s = control[i]
        steer(s.limiter.command, s.limiter.derivative, s.feedback, s.guard.output, period, robot[0], s.allocation)


@kernel
def apply_all(seen: Rows, robot: Rows, period: float, control: Rows) -> tuple[bool, bool]:
    """Calls `apply_voltages` for all robots; returns whether all are finite, and whether one asks for `answer`."""
    finite, asks = True, False
    for i in range(len(control)):
        finite &= apply_voltages(seen[i], robot[0], period, control[i])
        asks |= control[i].guard.forget | control[i].delay.due
    return finite, asks


@kernel
def hand_over_all(control: Rows) -> None:
    """Calls `hand_over` for all robots."""
    for i in range(len(control)):
        hand_over(control[i])


class UserHierarchy(Hierarchy):
    """The hierarchy with stages of a user; a tick calls them between compiled loops over the built-in laws.

    Attributes:
        faults: As for `Hierarchy`, and a message for each robot for which a stage returned a number that is not finite,
            except for those whose guard replaces the feedforward.
        feedforward_faults: For each robot the message of the first tick at which its guard did so, or "".
    """

    def __init__(self, scenarios: Sequence[Scenario], robot: Robot, stages: dict[str, UserStage]) -> None:
        """Wires the user's stages, by name, and for the others those of the scenarios."""
        super().__init__(scenarios, robot, stages)
        self.feedforward_faults = [""] * len(scenarios)
        self._wanted: Rows | None = None  # reference of the user's motion controller
        self._new: dict[int, Reference] = {}  # references that it has not been told yet, by robot
        if (stage := stages.get("motion")) and stage.has("assign"):
            stage.ask("assign", tuple(scenarios))
        for row in range(len(scenarios)):
            self._tune_motion(row)
        for name in (name for stage in stages for name in REPLACED.get(stage, ())):
            self.gains[name][:] = np.nan

    def reset(self, twist: Array, acceleration: Array, steering_angle: Array, rows: int | slice = slice(None)) -> None:
        """Bumpless start; see `Hierarchy.reset`."""
        super().reset(twist, acceleration, steering_angle, rows)
        if stage := self.stages.get("feedback"):
            stage.call("reset", self.state["pid"]["integral"], self.period)
        if stage := self.stages.get("steering"):
            stage.call("reset", steering_angle, self.period)

    def update(self, seen: Rows, reference: Rows) -> Array:
        """Computes the commands of one control tick; see `Hierarchy.update`.

        Raises:
            StageError: A stage raised, or returned something of another shape.
        """
        self.faults = {}
        state, constants = self.state, (self.nominal, self.period)
        if stage := self.stages.get("motion"):
            if self.tick == self.started:
                stage.call("reset", seen["pose"], _numbers(reference), self.motion_period)
            for row, plan in self._new.items():
                stage.ask("follow", row, plan)
            self._new = {}
            self._show(stage, seen["estimate"])
            if self.motion_due:
                self._wanted = self._request(stage, seen, reference)
        elif self.motion_due:
            request_all(seen, reference, state)
        command_all(seen, reference if self._wanted is None else self._wanted, *constants, state)
        if self._wanted is not None:
            self._wanted["twist"] += self.period * self._wanted["acceleration"]  # of the next tick
        feedback = self.stages.get("feedback")
        if feedback:
            self._feed_back(feedback, seen["twist"])
        state["feedforward"] = self.feedforward(self.command, self.derivative)
        self._read_weight_norm()
        watch_all(self.model.rows, *constants, state)
        if stage := self.stages.get("steering"):
            self._steer(stage)
        else:
            steer_all(*constants, state)
        finite, asks = apply_all(seen, *constants, state)
        taught = state["guard"]["teaching"], state["frozen"], seen["twist"], state["voltage"]
        if (added := self.learner.learn(*taught)) is not None:
            state["added"] = self._sound(added)
            hand_over_all(state)
        if feedback and (integral := self._integral(feedback)) is not None:
            integral[:] = state["pid"]["integral"]
        if asks:
            self.answer()
        self._read_weight_norm()
        if not finite:
            self.faults = self.non_finite() | self.faults
        self.tick += 1
        return self.output

    def set_kanayama(self, row: int, gains: Kanayama) -> None:
        """Changes the gains of one robot; see `Hierarchy.set_kanayama`. A user's motion controller is told."""
        super().set_kanayama(row, gains)
        self._tune_motion(row)

    def renew(self, row: int, scenario: Scenario) -> None:
        """Gives one robot a new scenario; see `Hierarchy.renew`. A user's motion controller is told its gains."""
        super().renew(row, scenario)
        self._tune_motion(row)

    def _tune_motion(self, row: int) -> None:
        """Tells the user's motion controller, if it asks for that, the gains of one robot."""
        if (stage := self.stages.get("motion")) and stage.has("tune"):
            stage.ask("tune", row, self.settings[row].motion.kanayama)

    def set_reference(self, row: int, reference: Reference) -> None:
        """Tells the user's motion controller, if it asks for that, that one robot has another reference."""
        if self.roams:
            self._new[row] = reference

    def _show(self, stage: UserStage, estimate: Array) -> None:
        """Hands the scans of this tick to the user's motion controller, with the poses that are estimated for it."""
        scanner = self.scanner
        if scanner is None or not self.looks:
            return
        for row in np.flatnonzero(scanner.taken == self.tick).tolist():
            lidar, ranges = scanner.lidars[row], scanner.scans[row]
            assert ranges is not None
            place, time = lidar.place(estimate[row, :3]), (self.tick - self.started) * self.period
            stage.ask("see", row, Scan(ranges.copy(), lidar.angles, lidar.range, place, time))

    def _request(self, stage: UserStage, seen: Rows, reference: Rows) -> Rows | None:
        """Calls the user's motion controller; returns the reference that it follows, if it has one of its own."""
        state = self.state
        request = self._finite_rows(stage, stage.output(seen["pose"], seen["twist"], _numbers(reference)))
        own = stage.member("followed")
        if own is not None:
            own = self._finite_rows(stage, stage.checked(own, (len(state), 7), "`followed`"))
            own = reference = own.copy(order="C").view(reference.dtype)[:, 0]
        errors_of_all(seen, reference, state)
        state["correction"] = request - reference["twist"]
        return own

    def _feed_back(self, stage: UserStage, twist: Array) -> None:
        """Calls the user's feedback, and copies its integral for guard and hand-over."""
        state = self.state
        self.feedback[:] = self._finite_rows(stage, stage.output(self.command, twist, state["allocation"]["excess"]))
        integral = self._integral(stage)
        state["pid"]["integral"] = 0.0 if integral is None else integral
        state["guard"]["hands_over"] = integral is not None

    def _integral(self, stage: UserStage) -> Array | None:
        """Returns the user's own array of the integrals of a feedback, to which the hand-over writes, if it has one."""
        if (own := stage.member("integral")) is None:
            return None
        found = stage.checked(own, self.feedback.shape, "`integral`")
        if found is not own or not found.flags.writeable:
            raise StageError(f"{stage.title}: `integral` is not a float64 array of NumPy that can be written")
        return found

    def feedforward(self, command: Array, derivative: Array) -> Array:
        """Returns the feedforward of the prior and of the learner, the user's or a built-in one."""
        return self.prior.output(command, derivative) + self._sound(self.learner.output(command, derivative))

    def _sound(self, answer: Array) -> Array:
        """Returns an answer of the feedforward, with zeros in the rows of a user's that are not finite.

        Each of these is left to its guard, if that is on; otherwise the robot fails.
        """
        if isinstance(self.learner, Learner) or np.isfinite(answer).all():
            return answer
        stage, guard = self.learner.stage, self.state["guard"]
        broken = ~np.isfinite(answer).all(axis=1) & guard["on"]
        guard["broken"] |= broken
        for row in np.flatnonzero(broken):
            fault = f"{stage.title}: not finite, tick {self.tick}"
            self.feedforward_faults[row] = self.feedforward_faults[row] or fault
        return self._finite_rows(stage, np.where(broken[:, None], 0.0, answer))

    def _steer(self, stage: UserStage) -> None:
        """Calls the user's steering, whose angle and rate `allocate` limits."""
        state, command = self.state, self.command.copy()
        if self.rigid:
            command[:, 1] += self.feedback[:, 1] + state["guard"]["output"][:, 1]
        answer = self._finite_rows(stage, stage.output(command, self.derivative))
        state["allocation"]["angle"], state["allocation"]["rate"] = answer.T

    def _read_weight_norm(self) -> None:
        """Reads the norm of the learner's weights, if the feedforward has it."""
        if (norm := self.learner.weight_norm) is not None:
            self.weight_norm[:] = norm

    def _finite_rows(self, stage: UserStage, answer: Array) -> Array:
        """Returns an answer with zeros in the rows that are not finite, and notes these robots in `faults`."""
        if np.isfinite(answer).all():
            return answer
        broken = np.any(~np.isfinite(answer), axis=1)
        for row in np.flatnonzero(broken):
            self.faults.setdefault(int(row), f"{stage.title}: not finite, tick {self.tick}")
        return np.where(broken[:, None], 0.0, answer)


def _numbers(reference: Rows) -> Array:
    """Returns records of `REFERENCE` as the reference of `mrctl.control.stages.MotionStage`, `(B, 7)`."""
    return reference.view(float).reshape(len(reference), -1)
