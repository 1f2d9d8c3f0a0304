"""A user's own stages in the hierarchy: Python objects that are called, and checked, between the compiled laws."""

from __future__ import annotations

import traceback
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mrctl.control.feedforward import Learner
from mrctl.control.kanayama import posture_error
from mrctl.control.pid import pid
from mrctl.control.stages import METHODS, Factory
from mrctl.kernel import Array, Rows, kernel, over_rows
from mrctl.loop.hierarchy import Hierarchy, apply_voltages, command_motion, hand_over, request_motion
from mrctl.loop.learned import load_arrays
from mrctl.record import InputError
from mrctl.scenario import Scenario
from mrctl.sensing.estimators import Estimator
from mrctl.theory.rays import Scan
from mrctl.theory.references import Reference
from mrctl.theory.robot import Robot

REPLACED = {"motion": ("k_x", "k_y", "k_theta"), "feedback": ("k_p", "k_i")}
"""Gains of `dataset.GAINS` that have no effect where the user has a stage of this name; a result has NaN for them."""


class StageError(InputError):
    """A user's stage raised or returned something wrong; the message is one line that names the stage."""


class UserStage:
    """One of a user's stages; it receives copies, and what it returns is checked.

    Attributes:
        stage: The user's object.
        name: Name of its factory, without settings.
        title: Names of the stage and of its factory, for messages.
    """

    def __init__(self, name: str, factory: Factory[Any], robot: Robot, size: int) -> None:
        """Calls the factory and checks the methods of its object.

        Args:
            name: Name of the stage, such as `feedforward`.
            factory: Factory from the user, which makes the object.
            robot: The nominal robot.
            size: Number of robots B.

        Raises:
            StageError: There is no such stage, the factory raised, or its object lacks a method.
        """
        if name not in METHODS:
            raise StageError(f"{name}: no such stage; there are {', '.join(METHODS)}")
        called = getattr(factory, "__name__", type(factory).__name__)
        self.name, self.title = called.partition("(")[0], f"{name} {called}"
        self._size = size
        try:
            self.stage: Any = factory(robot, size)
        except Exception as error:  # noqa: BLE001 (this is the user's code, here and below)
            raise self._raised(error) from error
        for method in METHODS[name]:
            if not callable(getattr(self.stage, method, None)):
                raise StageError(f"{self.title}: has no method {method}")

    def call(self, method: str, *values: Any) -> Any:  # noqa: ANN401
        """Calls a method with copies of the arrays, in which zeros replace numbers that are not finite.

        Raises:
            StageError: The method raised.
        """
        floats = [isinstance(v, np.ndarray) and v.dtype.kind == "f" for v in values]
        copies = [np.where(np.isfinite(v), v, 0.0) if real else v for v, real in zip(values, floats, strict=True)]
        return self.ask(method, *copies)

    def ask(self, method: str, *values: Any) -> Any:  # noqa: ANN401
        """Calls a method with values that are the stage's own.

        Raises:
            StageError: The method raised.
        """
        try:
            return _plain(getattr(self.stage, method)(*values))
        except Exception as error:  # noqa: BLE001
            raise self._raised(error) from error

    def output(self, *values: Array) -> Array:
        """Calls the method `output`, which must return two numbers for each robot, `(B, 2)`.

        Raises:
            StageError: The method raised, or returned another shape.
        """
        return self.checked(self.call("output", *values), (self._size, 2), "output")

    def adapted(self) -> dict[str, Array]:
        """Calls the method `adapted`, which returns arrays by name, with one row for each robot; nothing without it.

        Raises:
            StageError: The method raised, or returned something else.
        """
        if not callable(getattr(self.stage, "adapted", None)):
            return {}
        answer = self.ask("adapted")
        if not isinstance(answer, Mapping) or not all(isinstance(name, str) for name in answer):
            raise StageError(f"{self.title}: `adapted` returns {type(answer).__name__}, not a dict of arrays by name")
        found = {name: self._array(_plain(array)) for name, array in answer.items()}
        for name, array in found.items():
            if array.shape[:1] != (self._size,):
                rows = f"expected one row for each of {self._size} robots"
                raise StageError(f"{self.title}: {name} of `adapted` is shape {array.shape}, {rows}")
        return found

    def checked(self, answer: object, shape: tuple[int, ...], what: str) -> Array:
        """Returns an answer of the user's stage as an array of float64.

        Raises:
            StageError: The answer has another shape, or is not an array of numbers.
        """
        array = self._array(answer)
        if answer is None or array.shape != shape:
            found = "nothing" if answer is None else f"shape {array.shape}"
            raise StageError(f"{self.title}: {what} is {found}, expected shape {shape}")
        return array

    def _array(self, answer: object) -> Array:
        try:
            return np.asarray(answer, float)
        except Exception as error:  # noqa: BLE001
            raise self._raised(error) from error

    def _raised(self, error: Exception) -> StageError:
        frames = traceback.extract_tb(error.__traceback__)[1:2]  # the line of the stage's own method
        place = "".join(f" ({Path(frame.filename).name}, line {frame.lineno})" for frame in frames)
        return StageError(" ".join(f"{self.title}: {type(error).__name__}: {error}{place}".split()))


def _plain(answer: Any) -> Any:  # noqa: ANN401
    """Returns an answer without the gradients of torch."""
    return answer.detach() if hasattr(answer, "detach") else answer


@kernel
def request_all(seen: Rows, goal: Rows, control: Rows) -> None:
    """Calls `request_motion` for all robots."""
    for i in range(len(control)):
        request_motion(seen[i], goal[i], control[i])


@kernel
def command_all(seen: Rows, goal: Rows, robot: Rows, period: float, control: Rows) -> None:
    """Calls limiter, prefilter and PID for all robots."""
    for i in range(len(control)):
        s = control[i]
        command_motion(goal[i], robot[0], period, s)
        pid(s.limiter.command, seen[i].twist, s.allocation.excess, period, s.pid, s.feedback)


@kernel
def apply_all(seen: Rows, model: Rows, robot: Rows, period: float, control: Rows) -> tuple[bool, bool]:
    """Calls `apply_voltages` for all robots; returns whether all are finite, and whether one asks for `answer`."""
    finite, asks = True, False
    for i in range(len(control)):
        finite &= apply_voltages(seen[i], model[0], robot[0], period, control[i])
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
        shapes: Names of what the user's feedforward keeps, and their shapes for one robot.
    """

    def __init__(self, scenarios: Sequence[Scenario], robot: Robot, stages: dict[str, UserStage]) -> None:
        """Wires the user's stages, by name, and for the others those of the scenarios."""
        self._stages = stages
        self._feedforward_stage = stages.get("feedforward")
        self._wanted: Rows | None = None  # reference of the user's motion controller, until its next call
        self._new: dict[int, Reference] = {}  # references that it has not been told yet, by robot
        super().__init__(scenarios, robot, self._feedforward_stage.stage if self._feedforward_stage else None)
        stage, delay = self._feedforward_stage, scenarios[0].sensing.loop_delay(self.period) * self.period
        if stage and callable(getattr(stage.stage, "reset", None)):
            stage.ask("reset", self.period, delay)
        if self._has("assign"):
            stages["motion"].ask("assign", tuple(scenarios))
        for name in (name for stage in stages for name in REPLACED.get(stage, ())):
            self.gains[name][:] = np.nan
        self.feedforward_faults = [""] * len(scenarios)
        self.shapes: dict[str, tuple[int, ...]] = {}
        if keeper := self._keeper:
            self.shapes = {name: array.shape[1:] for name, array in keeper.adapted().items()}
            self._learned = {row: self._load(keeper, s) for row, s in enumerate(scenarios) if s.learned}
            self._adopt(range(len(scenarios)))

    def reset(self, twist: Array, acceleration: Array, steering_angle: Array, rows: int | slice = slice(None)) -> None:
        """Bumpless start; see `Hierarchy.reset`."""
        self.command[rows] = twist[rows]
        self.state["allocation"]["angle"][rows] = steering_angle[rows]
        integral = self.steady(twist, acceleration)
        self.state["pid"]["integral"][rows] = integral[rows]
        if stage := self._stages.get("feedback"):
            stage.call("reset", integral, self.period)
        if stage := self._stages.get("steering"):
            stage.call("reset", steering_angle, self.period)

    def update(self, seen: Rows, goal: Rows) -> Array:
        """Computes the commands of one control tick; see `Hierarchy.update`.

        Raises:
            StageError: A stage raised, or returned something of another shape.
        """
        self.faults = {}
        state, constants = self.state, (self.nominal, self.period)
        if stage := self._stages.get("motion"):
            if self.tick == self.started:
                stage.call("reset", seen["pose"], _numbers(goal), self.motion_period)
            for row, reference in self._new.items():
                stage.ask("follow", row, reference)
            self._new = {}
            self._show(stage, seen["estimate"])
            if self.moves:
                self._wanted = self._request(stage, seen, goal)
        elif self.moves:
            request_all(seen, goal, state)
        command_all(seen, goal if self._wanted is None else self._wanted, *constants, state)
        feedback = self._stages.get("feedback")
        if feedback:
            self._feed_back(feedback, seen["twist"])
        state["feedforward"] = self.feedforward(self.command, self.derivative)
        self._read_weight_norm()
        finite, asks = apply_all(seen, self.model.rows, *constants, state)
        if stage := self._stages.get("steering"):
            self._steer(stage, seen["lost"].any(axis=1))
        if (added := self._learn(seen["twist"])) is not None:
            state["added"] = added
            hand_over_all(state)
        if feedback and (integral := getattr(feedback.stage, "integral", None)) is not None:
            integral[:] = state["pid"]["integral"]
        if asks:
            self.answer()
        self._read_weight_norm()
        if not finite:
            self.faults = self.non_finite() | self.faults
        self.tick += 1
        return self.output

    def set_reference(self, row: int, reference: Reference) -> None:
        """Tells the user's motion controller, if it asks for that, that one robot has another reference."""
        if self.roams:
            self._new[row] = reference

    @property
    def watches(self) -> bool:
        """Whether the feedback is the built-in PID."""
        return "feedback" not in self._stages

    @property
    def _moves_motion(self) -> bool:
        """Whether the motion controller is the built-in one; the gains of another one are its own."""
        return "motion" not in self._stages

    @property
    def looks(self) -> bool:
        """Whether the user's motion controller takes the scans of a lidar."""
        return self._has("see")

    @property
    def roams(self) -> bool:
        """Whether the user's motion controller goes along the reference at its own pace, or leaves it."""
        return self._has("follow")

    def _has(self, method: str) -> bool:
        """Tells whether there is a motion controller of the user's with this method."""
        stage = self._stages.get("motion")
        return stage is not None and callable(getattr(stage.stage, method, None))

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

    def _request(self, stage: UserStage, seen: Rows, goal: Rows) -> Rows | None:
        """Calls the user's motion controller; returns the reference that it follows, if it has one of its own."""
        state, reference = self.state, _numbers(goal)
        request = self._finite_rows(stage, stage.output(seen["pose"], seen["twist"], reference))
        own = getattr(stage.stage, "followed", None)
        if own is not None:
            own = self._finite_rows(stage, stage.checked(own, reference.shape, "`followed`"))
            own = goal = np.ascontiguousarray(own).view(goal.dtype)[:, 0]
        over_rows(posture_error, seen["pose"], goal["pose"], state["error"])
        state["correction"] = request - goal["twist"]
        return own

    def _feed_back(self, stage: UserStage, twist: Array) -> None:
        """Calls the user's feedback, and copies its integral for guard and hand-over."""
        state = self.state
        self.feedback[:] = self._finite_rows(stage, stage.output(self.command, twist, state["allocation"]["excess"]))
        integral = getattr(stage.stage, "integral", None)
        known = 0.0 if integral is None else stage.checked(integral, self.feedback.shape, "`integral`")
        state["pid"]["integral"] = known
        state["guard"]["hands_over"] = integral is not None

    def feedforward(self, command: Array, derivative: Array) -> Array:
        """Returns the feedforward of the prior and of the learner, the user's or a built-in one."""
        stage = self._feedforward_stage
        if not stage:
            return super().feedforward(command, derivative)
        learned = self._finite_rows(stage, self._left_to_guard(stage, stage.output(command, derivative)))
        return self.prior.output(command, derivative) + learned

    def _left_to_guard(self, stage: UserStage, answer: Array) -> Array:
        """Returns an answer of the feedforward, and leaves each row that is not finite to its guard, if that is on."""
        guard = self.state["guard"]
        broken = ~np.isfinite(answer).all(axis=1) & guard["on"]
        if not broken.any():
            return answer
        guard["broken"] |= broken
        for row in np.flatnonzero(broken):
            fault = f"{stage.title}: not finite, tick {self.tick}"
            self.feedforward_faults[row] = self.feedforward_faults[row] or fault
        return np.where(broken[:, None], 0.0, answer)

    def _steer(self, stage: UserStage, lost: NDArray[np.bool]) -> None:
        """Calls the user's steering, and limits it as `allocate` does; `lost` are the robots with a limited current."""
        state, limit = self.state, self.robot.steering_limit
        allocation, command = state["allocation"], self.command.copy()
        if self.rigid:
            command[:, 1] += self.feedback[:, 1] + state["guard"]["output"][:, 1]
        answer = self._finite_rows(stage, stage.output(command, self.derivative))
        angle = np.clip(answer[:, 0], -limit, limit)
        beyond = angle != answer[:, 0]
        rate = np.where(beyond, 0.0, answer[:, 1])
        self.output[:, 2], self.output[:, 3] = np.clip(angle + rate * self.period / 2, -limit, limit), rate
        if self.rigid:  # the fork makes θ̇, so its limit acts on the second channel
            clipped = (self.output[:, :2] != allocation["feedback"] + allocation["feedforward"]).any(axis=1)
            made = command[:, 0] * np.tan(angle) / self.robot.wheelbase
            allocation["excess"][:, 1] = np.where(beyond, made - command[:, 1], 0.0)
            allocation["saturated"] = beyond | clipped | lost
            state["voltage"][:, 1] = command[:, 1] - self.command[:, 1] + allocation["excess"][:, 1]
            state["frozen"] = np.any(
                [allocation["saturated"], state["learning_off"], state["guard"]["frozen"], state["slips"]], axis=0
            )

    def _learn(self, twist: Array) -> Array | None:
        """Lets the feedforward learn, the user's or a built-in one; returns the change of its output."""
        state, stage = self.state, self._feedforward_stage
        values = state["guard"]["teaching"], state["frozen"], twist, state["voltage"]
        if not stage:
            return self.learner.learn(*values)
        added = stage.call("learn", *values)
        if added is None:
            return None
        added = self._left_to_guard(stage, stage.checked(added, self.feedback.shape, "what `learn` returns"))
        return self._finite_rows(stage, added)

    def _read_weight_norm(self) -> None:
        """Reads the norm of the learner's weights, if the feedforward has it."""
        norm = getattr(self.learner, "weight_norm", None)
        if norm is None:
            return
        stage = self._feedforward_stage
        self.weight_norm[:] = stage.checked(norm, self.weight_norm.shape, "`weight_norm`") if stage else norm

    def restore(self, rows: NDArray[np.intp]) -> bool:
        """Resets the learners of these robots, see `Hierarchy.restore`, or the user's feedforward.

        Raises:
            StageError: The stage raised.
        """
        if not getattr(self.learner, "restore", None):
            return False
        if self._feedforward_stage is None:
            return super().restore(rows)
        self._feedforward_stage.call("restore", rows)
        self._adopt(rows.tolist())
        return True

    @property
    def _keeper(self) -> UserStage | None:
        """The user's feedforward, if it is no learner of mrctl, whose own methods keep what it adapts."""
        return None if isinstance(self.learner, Learner) else self._feedforward_stage

    @property
    def own_learner(self) -> str:
        """Name of the user's feedforward if it keeps what it learns, else ""."""
        return self._keeper.name if self._keeper and self.shapes else ""

    def adapted(self) -> Array:
        """Returns what the learner of each robot has adapted, see `Hierarchy.adapted`, or the user's feedforward.

        Raises:
            StageError: The stage raised, or returned other names or shapes than at the start.
        """
        stage, size = self._keeper, len(self.state)
        if stage is None:
            return super().adapted()
        arrays = stage.adapted()
        if (shapes := {name: array.shape[1:] for name, array in arrays.items()}) != self.shapes:
            raise StageError(f"{stage.title}: `adapted` has shapes {shapes} a robot, at the start {self.shapes}")
        return np.concatenate([np.zeros((size, 0)), *(arrays[name].reshape(size, -1) for name in self.shapes)], axis=1)

    def _load(self, stage: UserStage, scenario: Scenario) -> dict[str, Array]:
        """Reads what the user's feedforward starts from for one robot."""
        if not self.shapes or not callable(getattr(stage.stage, "adopt", None)):
            raise InputError(f"learned: {stage.name} cannot start from a file without the methods adapted and adopt")
        return load_arrays(scenario, stage.name, self.shapes)

    def _adopt(self, rows: Iterable[int]) -> None:
        """Lets the learners of these robots, or the user's feedforward, start from the files of their scenarios."""
        stage = self._keeper
        if stage is None:
            super()._adopt(rows)
            return
        for row in rows:
            if row in self._learned:
                stage.ask("adopt", row, {name: array.copy() for name, array in self._learned[row].items()})

    def _finite_rows(self, stage: UserStage, answer: Array) -> Array:
        """Returns an answer with zeros in the rows that are not finite, and notes these robots in `faults`."""
        broken = np.any(~np.isfinite(answer), axis=1)
        for row in np.flatnonzero(broken):
            self.faults.setdefault(int(row), f"{stage.title}: not finite, tick {self.tick}")
        return np.where(broken[:, None], 0.0, answer) if broken.any() else answer


def _numbers(goal: Rows) -> Array:
    """Returns records of `GOAL` as the reference of `mrctl.control.stages.Motion`, `(B, 7)`."""
    return goal.view(float).reshape(len(goal), -1)


class UserEstimator(Estimator):
    """A user's estimator, with odometry in place of an estimate that is not finite.

    Attributes:
        faults: For each robot the message of the first tick at which the estimate was not finite, or "".
    """

    def __init__(self, stage: UserStage, *arguments: Any) -> None:  # noqa: ANN401
        """Takes the user's stage, and the arguments of `Estimator` after the name."""
        super().__init__("user", *arguments)
        self._stage = stage
        self._started = False
        self.faults = [""] * len(self.seen)

    def estimate(self, tick: int, plant: Rows) -> None:
        """Estimates posture and twist of all robots; see `Estimator.estimate`."""
        memory, sensors = self.memory, self.sensors
        if not self._started:
            self._stage.call("reset", memory["mean"][:, :3], memory["mean"][:, 3:], sensors.period)
            self._started = True
        rows = np.arange(len(memory))

        def arrived(name: str) -> Rows:
            latency = sensors.sensors[f"{name}_latency"]
            return sensors.ring[np.maximum(tick - latency, self.seen["start"]) % len(sensors.ring), rows]

        latency = sensors.sensors["fix_latency"]
        fixes = sensors.ring[(tick - latency) % len(sensors.ring), rows]
        new = fixes["fix_arrives"] & (tick - latency >= self.seen["start"])
        fix = np.where(new[:, None], fixes["fix"], 0.0)
        age = np.where(new, latency * sensors.period, -1.0)
        samples = arrived("encoder")["encoder"], arrived("gyro")["gyro"], arrived("accelerometer")["acceleration"]
        answer = self._stage.call("output", *samples, fix, age)
        memory["answer"] = self._stage.checked(answer, (len(memory), 5), "output")
        memory["valid"] = np.isfinite(memory["answer"]).all(axis=1)
        for row in np.flatnonzero(~memory["valid"]):
            self.faults[row] = self.faults[row] or f"{self._stage.title}: not finite, tick {tick}"
        super().estimate(tick, plant)
