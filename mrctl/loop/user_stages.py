"""A user's own stages: Python objects that are called, and whose answers are checked."""

from __future__ import annotations

import traceback
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mrctl.control.feedforward import Learner, Prior
from mrctl.control.stages import METHODS, Factory, Stages
from mrctl.kernel import Array, Rows
from mrctl.loop.learned import load_arrays, load_learned
from mrctl.record import InputError
from mrctl.scenario import Scenario
from mrctl.sensing.estimators import Estimator
from mrctl.theory.robot import Robot


class StageError(InputError):
    """A user's stage raised or returned something wrong; the message is one line that names the stage."""


class UserStage:
    """One of a user's stages; it receives copies, and what it returns is checked.

    Attributes:
        stage: The user's object.
        name: Name of its factory, without settings.
        title: Names of the stage and of its factory, for messages.
        size: Number of robots B.
    """

    def __init__(self, name: str, factory: Factory[Any], robot: Robot, size: int) -> None:
        """Calls the factory and checks the methods of its object.

        Args:
            name: Name of the stage, such as `feedforward`.
            factory: Factory from the user, which makes the object.
            robot: The nominal robot.
            size: Number of robots B.

        Raises:
            StageError: There is no such stage, the factory cannot be called or raised, or its object lacks a method.
        """
        if name not in METHODS:
            raise StageError(f"{name}: no such stage; there are {', '.join(METHODS)}")
        called = name_of(factory)
        self.name, self.title = called.partition("(")[0], f"{name} {called}"
        if not callable(factory):
            wanted = "a class or a function, to be called with the robot and the number of robots"
            raise StageError(f"{name}: expected {wanted}, not an object of {type(factory).__name__}")
        self.size = size
        try:
            self.stage: Any = factory(robot, size)
        except Exception as error:  # noqa: BLE001 (this is the user's code, here and below)
            raise self._raised(error) from error
        for method in METHODS[name]:
            if not self.has(method):
                raise StageError(f"{self.title}: has no method {method}")

    def has(self, method: str) -> bool:
        """Returns whether the user's object has a method."""
        return callable(getattr(self.stage, method, None))

    def member(self, name: str, default: Any = None) -> Any:  # noqa: ANN401
        """Returns a member of the user's object, or the default where it has none.

        Raises:
            StageError: It is a property that raised.
        """
        try:
            return _plain(getattr(self.stage, name, default))
        except Exception as error:  # noqa: BLE001
            raise self._raised(error) from error

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
        return self.checked(self.call("output", *values), (self.size, 2), "output")

    def checked(self, answer: object, shape: tuple[int, ...], what: str) -> Array:
        """Returns an answer of the user's stage as an array of float64.

        Raises:
            StageError: The answer has another shape, or is not an array of numbers.
        """
        array = self.array(answer)
        if answer is None or array.shape != shape:
            found = "nothing" if answer is None else f"shape {array.shape}"
            raise StageError(f"{self.title}: {what} is {found}, expected shape {shape}")
        return array

    def array(self, answer: object) -> Array:
        """Returns an answer of the user's stage as an array of float64 of any shape.

        Raises:
            StageError: The answer is not an array of numbers.
        """
        try:
            array = np.asarray(answer)
            if array.dtype.kind == "c":
                raise TypeError("the numbers are complex")
            return array if array.dtype == float else np.asarray(answer, float)
        except Exception as error:  # noqa: BLE001
            raise self._raised(error) from error

    def _raised(self, error: Exception) -> StageError:
        frames = traceback.extract_tb(error.__traceback__)[1:2]  # the line of the stage's own method
        place = "".join(f" ({Path(frame.filename).name}, line {frame.lineno})" for frame in frames)
        return StageError(" ".join(f"{self.title}: {type(error).__name__}: {error}{place}".split()))


def named_stages(stages: Stages) -> dict[str, str]:
    """Returns the names of the user's factories by stage."""
    return {stage: name_of(factory) for stage, factory in stages.items() if factory}


def expect_stages(stages: Stages, drove: Mapping[str, str], source: Path) -> None:
    """Refuses other stages than those that drove a saved run, which holds their names alone.

    Args:
        stages: Those that are to drive it again.
        drove: Names of the factories that drove it, by stage.
        source: Where the run was saved, for the message.

    Raises:
        InputError: They differ.
    """
    if named_stages(stages) != drove:
        names = ", ".join(f"{stage}={factory}" for stage, factory in drove.items())
        needed = f"--controller with {names}" if names else "no --controller"
        raise InputError(f"controller: the run in {source} needs {needed}, as when it was saved")


def name_of(factory: object) -> str:
    """Returns the name of a factory; for a `partial` that of its function, with the settings as in a call."""
    if isinstance(factory, partial) and not hasattr(factory, "__name__"):
        settings = [*map(repr, factory.args), *(f"{name}={value!r}" for name, value in factory.keywords.items())]
        return f"{name_of(factory.func)}({', '.join(settings)})"
    return getattr(factory, "__name__", type(factory).__name__)


def _plain(answer: Any) -> Any:  # noqa: ANN401
    """Returns an answer without the gradients of torch."""
    return answer.detach() if hasattr(answer, "detach") else answer


class UserFeedforward:
    """A user's feedforward, with the members of `Learner` that the hierarchy uses.

    Attributes:
        stage: The stage, whose calls are checked.
        learner: The user's object if it is a `Learner`, which then keeps what it has adapted as it does for mrctl.
        guarded: Whether the guard watches it.
        restorable: Whether the guard can reset it.
        shapes: Names of what a user's object of another kind keeps, and their shapes for one robot.
    """

    def __init__(self, stage: UserStage, prior: Prior, rigid: bool, period: float, delay: float) -> None:
        """Tells the user's object its loop.

        Args:
            stage: The stage.
            prior: The prior that is added to its output.
            rigid: Whether the second channel is steering.
            period: Control period in s.
            delay: Delay of the loop that the controllers know, in s.

        Raises:
            StageError: The stage raised, says what it keeps in another form, or was made for another second channel.
        """
        self.stage, own = stage, stage.stage
        if (made_for := stage.member("rigid", rigid)) != rigid:
            raise StageError(f"{stage.title}: it was made with rigid={made_for}, the steering asks for rigid={rigid}")
        self.guarded, self.restorable = bool(stage.member("guarded", True)), stage.has("restore")
        self.learner = own if isinstance(own, Learner) else None
        if self.learner:
            self.learner.prior = prior
        if stage.has("reset"):
            stage.ask("reset", period, delay)
        self.shapes = {name: array.shape[1:] for name, array in self._kept().items()}

    @property
    def weight_norm(self) -> Array | None:
        """Norm of its weights, `(B,)`, or None if it has none."""
        norm = self.stage.member("weight_norm")
        return None if norm is None else self.stage.checked(norm, (self.stage.size,), "`weight_norm`")

    @property
    def parameters(self) -> Array | None:
        """Learned coefficients, as those of a `Learner`."""
        return self.learner.parameters if self.learner else None

    def output(self, command: Array, derivative: Array) -> Array:
        """Returns the feedforward of all robots; see `Feedforward.output`."""
        return self.stage.output(command, derivative)

    def learn(self, feedback: Array, frozen: Array, twist: Array, voltage: Array) -> Array | None:
        """Lets all robots learn; see `Feedforward.learn`."""
        added = self.stage.call("learn", feedback, frozen, twist, voltage)
        return None if added is None else self.stage.checked(added, feedback.shape, "what `learn` returns")

    def restore(self, rows: NDArray[np.intp]) -> None:
        """Resets the robots with these indices."""
        self.stage.call("restore", rows.copy())

    def adapted(self) -> Array:
        """Returns what each robot has learned, flat, `(B, n)`; n is 0 if it keeps nothing.

        Raises:
            StageError: The stage raised, or returned other names or shapes than at the start.
        """
        if self.learner:
            return self.learner.adapted()
        arrays, size = self._kept(), self.stage.size
        if (shapes := {name: array.shape[1:] for name, array in arrays.items()}) != self.shapes:
            raise StageError(f"{self.stage.title}: `adapted` has shapes {shapes} a robot, at the start {self.shapes}")
        return np.concatenate([np.zeros((size, 0)), *(arrays[name].reshape(size, -1) for name in self.shapes)], axis=1)

    def _kept(self) -> dict[str, Array]:
        """Returns what a user's object that is no `Learner` keeps: arrays by name, with one row for each robot."""
        stage, size = self.stage, self.stage.size
        if self.learner or not stage.has("adapted"):
            return {}
        answer = stage.ask("adapted")
        if not isinstance(answer, Mapping) or not all(isinstance(name, str) for name in answer):
            raise StageError(f"{stage.title}: `adapted` returns {type(answer).__name__}, not a dict of arrays by name")
        found = {name: stage.array(_plain(array)) for name, array in answer.items()}
        for name, array in found.items():
            if array.shape[:1] != (size,):
                rows = f"expected one row for each of {size} robots"
                raise StageError(f"{stage.title}: {name} of `adapted` is shape {array.shape}, {rows}")
        return found

    def load(self, scenario: Scenario) -> Any:  # noqa: ANN401
        """Reads what one robot starts from, which `adopt` takes.

        Raises:
            InputError: The file is missing, broken or of another learner, or the user's object cannot start from one.
        """
        if self.learner:
            return load_learned(scenario)
        if not self.shapes or not self.stage.has("adopt"):
            name = self.stage.name
            raise InputError(f"learned: {name} cannot start from a file without the methods adapted and adopt")
        return load_arrays(scenario, self.stage.name, self.shapes)

    def adopt(self, row: int, learned: Any) -> None:  # noqa: ANN401
        """Lets one robot start from what `load` returned."""
        if self.learner:
            self.learner.adopt(row, learned)
        else:
            self.stage.ask("adopt", row, {name: array.copy() for name, array in learned.items()})


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
        memory, seen, period = self.memory, self.seen, self.sensors.period
        if not self._started:
            self._stage.call("reset", memory["mean"][:, :3], memory["mean"][:, 3:], period)
            self._started = True
        self.receive(tick, plant)
        new = ~np.all(np.isnan(seen["fix"]), axis=1)
        fix = np.where(new[:, None], seen["fix"], 0.0)
        age = np.where(new, self.sensors.sensors["fix_latency"] * period, -1.0)
        answer = self._stage.call("output", seen["encoder"], seen["gyro"], seen["acceleration"], fix, age)
        memory["answer"] = self._stage.checked(answer, (len(memory), 5), "output")
        memory["valid"] = np.isfinite(memory["answer"]).all(axis=1)
        for row in np.flatnonzero(~memory["valid"]):
            self.faults[row] = self.faults[row] or f"{self._stage.title}: not finite, tick {tick}"
        super().estimate(tick, plant)
