"""The feedforward: what the controller knows at the start (prior), and what it learns while driving (learner).

    U_ff = prior(x_c) + learner(x_c),      prior = cᵀ x, the inverse of equation (3),      x_c = commanded motion

| prior        | coefficients c                                                     |
| ------------ | ------------------------------------------------------------------ |
| `none`       | 0: the learner starts from nothing, as in the paper                |
| `model`      | those of the nominal robot                                         |
| `true_model` | the true ones, as means of left and right; for reference only      |
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from mrctl.control.algebra import linear
from mrctl.control.features import features
from mrctl.control.nominal import nominal
from mrctl.control.weights import arrays_by_name
from mrctl.kernel import Array, Kernel, Row, Rows, flat, kernel
from mrctl.theory.dynamics import inverse_coefficients
from mrctl.theory.robot import Robot

STEERING_SCALE = 0.1  # rad/s on a steering channel that correspond to one volt on the others
STEERING_SHARE = 0.1  # factor on the step of a steering channel, whose geometry is nearly right from the start


class Feedforward(Protocol):
    """The stage that learns to turn the commanded motion into voltages: any object with these two methods.

    The voltage of the prior is added to its output.

    A stage serves B robots; its memory belongs in arrays with a leading axis B, so that robots cannot mix. It may have
    further members:

    - `reset(period, delay)` is called before all other methods with the control period and the delay of the loop that
      the controller knows, both in s.
    - `weight_norm`, a float64 array `(B,)`, is recorded in the results.
    - `restore(rows)` resets the robots with these indices to their initial weights, for the guard
      (`mrctl.control.guard`).
    - `guarded` is False where the guard shall not watch it.
    - `rigid` says whether it takes the second channel for steering; where the steering is otherwise it is refused.
    - `adapted()` returns what each robot has learned, a dict of arrays `(B, …)` by name, whose shapes stay the same;
      `mrctl.save_learned` writes those of one robot to a file.
    - `adopt(row, learned)` lets one robot start from such a file, a dict of the same arrays without the axis B. It is
      called after `reset` and after each `restore`, for robots whose scenario names a file in `learned`.
    """

    def output(self, command: Array, derivative: Array) -> Array:
        """Returns the feedforward of the two channels; the first call, before the first tick, serves a bumpless start.

        Args:
            command: Commanded V in m/s and θ̇ in rad/s, `(B, 2)`.
            derivative: Their derivatives in m/s², rad/s², `(B, 2)`.

        Returns:
            U_Σ and U_Δ in V, `(B, 2)`; under `rigid` steering the second channel is a correction of θ̇ in rad/s.
        """
        ...

    def learn(self, feedback: Array, frozen: Array, twist: Array, voltage: Array) -> Array | None:
        """Learns from the feedback that was added to the last `output`, and from the motion of the robot.

        Args:
            feedback: Feedback times the guard's gain, in the channels and units of `output`, `(B, 2)`.
            frozen: 1 where a limit acted, a driven wheel slips, or this robot must not learn, else 0, `(B,)`.
            twist: Estimated V in m/s and θ̇ in rad/s, on which `voltage` has not acted yet, `(B, 2)`.
            voltage: Voltage of the coming period, after the limits, in the channels and units of `output`, `(B, 2)`.

        Returns:
            Change of the output for the same command, `(B, 2)`, of which the PID's integral gives up a part; or None.
        """
        ...


PRIOR = np.dtype(
    [
        ("c", "f8", (8, 2)),  # coefficients of the unscaled features in the two channels, V per unit of the feature
        ("half_track", "f8"),  # D of the robot that they belong to, m
        ("ones", "f8", 8),  # scale of unscaled features
        ("x", "f8", 8),  # scratch: features of a motion
    ],
    align=True,
)

# The loops below pass on parts of records, as the control tick does, so that a law is compiled once for both.
MOTION = np.dtype(
    [
        ("command", "f8", 2),  # V in m/s and θ̇ in rad/s
        ("derivative", "f8", 2),  # V̇ in m/s² and θ̈ in rad/s²
        ("voltage", "f8", 2),  # out: voltage of the two channels, V (rad/s on a steering channel)
    ],
    align=True,
)


@kernel
def prior_voltage(command: Array, derivative: Array, prior: Row, voltage: Array) -> None:
    """Writes cᵀ x, the inverse of equation (3) at a motion.

    Args:
        command: V in m/s and θ̇ in rad/s, `(2,)`.
        derivative: V̇ in m/s² and θ̈ in rad/s², `(2,)`.
        prior: A record of `PRIOR`.
        voltage: Out: U_Σ and U_Δ in V, `(2,)`; the second is 0 under `rigid` steering, where the fork makes θ̇.
    """
    features(command, derivative, prior.half_track, prior.ones, prior.x)
    linear(prior.x, prior.c, voltage)


@kernel
def explained(twist: Array, acceleration: Array, rigid: bool, prior: Row, voltage: Array) -> None:
    """Writes the voltages that the prior's inverse dynamics needs for this motion, `(2,)` in V.

    Under `rigid` steering the second channel is θ̇ itself, in rad/s: the fork makes it without a voltage.
    """
    prior_voltage(twist, acceleration, prior, voltage)
    if rigid:
        voltage[1] = twist[1]


@kernel
def prior_voltages(motion: Rows, prior: Rows) -> None:
    """`prior_voltage` of all robots, for records of `MOTION` and `PRIOR`."""
    for i in range(len(motion)):
        prior_voltage(motion[i].command, motion[i].derivative, prior[i], motion[i].voltage)


class Prior:
    """Prior models of the feedforwards of B robots.

    Attributes:
        rows: One record of `PRIOR` a robot.
    """

    def __init__(self, robots: Sequence[Robot | None], rigid: bool) -> None:
        """Takes for each robot the model that its feedforward starts from, or None; `rigid` is as for `nominal`."""
        self._rigid = rigid
        self.rows = np.zeros(len(robots), PRIOR)
        self.rows["ones"] = 1.0
        for row, robot in enumerate(robots):
            if robot is not None:
                self.set_robot(row, robot)

    def set_robot(self, row: int, robot: Robot) -> None:
        """Replaces the coefficients of one robot."""
        self.rows["half_track"][row] = robot.half_track
        self.rows["c"][row] = inverse_coefficients(robot)
        if self._rigid:
            self.rows["c"][row, :, 1] = 0.0

    def output(self, command: Array, derivative: Array) -> Array:
        """Returns the voltages of the two channels of all robots, `(B, 2)` in V; see `Feedforward.output`."""
        motion = np.zeros(len(self.rows), MOTION)
        motion["command"], motion["derivative"] = command, derivative
        prior_voltages(motion, self.rows)
        return np.ascontiguousarray(motion["voltage"])


class Shown(NamedTuple):
    """What a learner is shown of one robot in a control tick."""

    command: Array
    """Commanded V in m/s and θ̇ in rad/s, `(2,)`."""
    derivative: Array
    """Their derivatives in m/s² and rad/s², `(2,)`."""
    feedback: Array
    """Output of the PID that teaches, in V (rad/s on a steering channel), `(2,)`."""
    frozen: float
    """1 where nothing may be learned from this tick, else 0."""
    twist: Array
    """Predicted V in m/s and θ̇ in rad/s, on which the voltage has not acted yet, `(2,)`."""
    voltage: Array
    """Voltage of the channels in the coming period, after the limits, in V (rad/s on a steering channel), `(2,)`."""
    period: float
    """Control period in s."""


class Loop(NamedTuple):
    """What the learners of a group of robots know of the loop in which they drive."""

    robot: Robot
    """The nominal robot."""
    rigid: bool
    """Whether channel two is steering."""
    period: float
    """Control period in s."""
    delay: int = 0
    """Delay from measurement to voltage in control periods."""
    has_prior: bool = True
    """Whether a model is the prior."""
    seeds: Sequence[int] = ()
    """Seed of each robot, which draws initial weights."""


class Learner(ABC):
    """A learner whose two laws are kernels for one robot, so that a whole control tick is one compiled call.

    `output` and `learn` call the same kernels for all robots, which makes it a `Feedforward` like any other.

    Attributes:
        respond: `(i, command, derivative, robot, arrays, voltage)` writes the output of robot i to `voltage`, `(2,)`.
        learn_one: `(i, shown, robot, prior, arrays, added)` learns from a `Shown`, writes the change of the output of
            robot i to `added`, `(2,)`, and returns the norm of the weights. `prior` is the record of `PRIOR` of
            robot i.
        rows: One record a robot: its memory and its settings.
        arrays: Memory and constants of the kernels, a tuple of arrays.
        prior: The prior that is added to its output; at first nothing.
        guarded: Whether the guard watches it.
        restorable: Whether the guard can reset it, as every learner of mrctl.
        needs_model: Whether it compares the robot with a model, so that the prior must be one.
        record: The dtype of `rows`.
        learned: Fields of `rows` that hold what it has adapted, from which another run can start.
        weight_norm: Norm of the weights, `(B,)`.
    """

    respond: ClassVar[Kernel]
    learn_one: ClassVar[Kernel]
    guarded: ClassVar[bool] = True
    restorable: ClassVar[bool] = True
    needs_model: ClassVar[bool] = False
    record: ClassVar[np.dtype] = np.dtype([])
    learned: ClassVar[tuple[str, ...]] = ()
    arrays: tuple[Any, ...]

    def __init__(self, loop: Loop, settings: Sequence[Any]) -> None:
        """Takes the loop, and the settings of each robot."""
        size = len(settings)
        self.robot, self.period = nominal(loop.robot, loop.rigid), loop.period
        self.prior = Prior([None] * size, loop.rigid)
        self.rows: Rows = np.zeros(size, self.record)
        self.weight_norm = np.zeros(size)
        self._motion, self._added = np.zeros(size, MOTION), np.zeros((size, 2))

    @abstractmethod
    def restore(self, rows: NDArray[np.intp]) -> None:
        """Resets the robots with these indices to their initial memory."""

    @property
    def parameters(self) -> Array | None:
        """Learned coefficients of the 8 scaled features, beside the prior's, `(B, 8, 2)` in V, or None."""
        return None

    @classmethod
    def kept(cls, settings: Any) -> dict[str, tuple[int, ...]]:  # noqa: ANN401
        """Returns names and shapes of what one robot with these settings has learned, in the order of `adapted`."""
        return {name: cls.record[name].shape for name in cls.learned}

    def adapted(self) -> Array:
        """What each robot has learned, flat, `(B, n)`; n is 0 if it keeps nothing."""
        size = len(self.weight_norm)
        return np.concatenate([np.zeros((size, 0)), *(self.rows[name].reshape(size, -1) for name in self.learned)], 1)

    def adopt(self, row: int, learned: Array) -> None:
        """Lets one robot start from what another one has learned, a row of its `adapted`."""
        for name, values in arrays_by_name(learned, {name: self.rows[name].shape[1:] for name in self.learned}).items():
            self.rows[name][row] = values

    def take(self, row: int, other: Learner) -> None:
        """Copies the memory of a learner of the same kind, for one robot, into a row of this one."""
        size = len(self.weight_norm)
        self.weight_norm[row] = other.weight_norm[0]
        for mine, theirs in zip(flat(self.arrays), flat(other.arrays), strict=True):
            if len(mine) == size and len(theirs) == 1:
                mine[row] = theirs[0]

    def output(self, command: Array, derivative: Array) -> Array:
        """Returns the feedforward of all robots; see `Feedforward.output`."""
        motion = self._motion
        motion["command"], motion["derivative"] = command, derivative
        respond_all.calling(respond=self.respond)(motion, self.robot, self.arrays)
        return np.ascontiguousarray(motion["voltage"])

    def learn(self, feedback: Array, frozen: Array, twist: Array, voltage: Array) -> Array:
        """Lets all robots learn; see `Feedforward.learn`."""
        learn_all.calling(learn_one=self.learn_one)(
            self._motion, _own(feedback), _own(frozen), _own(twist), _own(voltage), self.period, self.robot,
            self.prior.rows, self.arrays, self._added, self.weight_norm,
        )  # fmt: skip
        return self._added


def _own(values: Array) -> Array:
    """Returns the values as contiguous float64, so that the loops below are compiled once."""
    return np.ascontiguousarray(values, float)


@kernel
def nothing(i: int, command: Array, derivative: Array, robot: Row, arrays: tuple[Any, ...], voltage: Array) -> None:
    """Writes zero volts."""
    voltage[0] = voltage[1] = 0.0


@kernel
def learn_nothing(i: int, shown: Shown, robot: Row, prior: Row, arrays: tuple[Any, ...], added: Array) -> float:
    """Learns nothing."""
    added[0] = added[1] = 0.0
    return 0.0


respond, learn_one = nothing, learn_nothing  # the kernels that the loops below call; `Kernel.calling` replaces them


@kernel
def respond_all(motion: Rows, robot: Rows, arrays: tuple[Any, ...]) -> None:
    """Writes the outputs of all robots, to records of `MOTION`."""
    for i in range(len(motion)):
        respond(i, motion[i].command, motion[i].derivative, robot[0], arrays, motion[i].voltage)


@kernel
def learn_all(
    motion: Rows, feedback: Array, frozen: Array, twist: Array, voltage: Array, period: float, robot: Rows,
    prior: Rows, arrays: tuple[Any, ...], added: Array, norm: Array,
) -> None:  # fmt: skip
    """Does one learning step of all robots."""
    for i in range(len(added)):
        command, derivative = motion[i].command, motion[i].derivative
        shown = Shown(command, derivative, feedback[i], frozen[i], twist[i], voltage[i], period)
        norm[i] = learn_one(i, shown, robot[0], prior[i], arrays, added[i])


class NoLearner(Learner):
    """The learner `none`: the prior alone or, with the prior `none`, PID alone, which is the paper's baseline."""

    respond, learn_one, guarded = nothing, learn_nothing, False
    arrays = ()

    @property
    def parameters(self) -> Array:
        """Zeros."""
        return np.zeros((len(self.weight_norm), 8, 2))

    def restore(self, rows: NDArray[np.intp]) -> None:
        """Does nothing, since nothing is learned."""
