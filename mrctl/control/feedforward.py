"""What every feedforward has in common, and the ones that do not learn: `none`, `model`, `oracle`."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from functools import cache
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from mrctl.control.features import features, linear
from mrctl.control.nominal import nominal
from mrctl.kernel import Array, Kernel, Row, Rows, kernel
from mrctl.theory.dynamics import inverse_coefficients
from mrctl.theory.robot import Robot

STEERING_SCALE = 0.1  # rad/s on a steering channel that count as one volt does on the others
STEERING_SHARE = 0.1  # how much slower a steering channel learns: its geometry is nearly right from the start


class Feedforward(Protocol):
    """The stage that turns the commanded motion into voltages. Any object with these two methods is one.

    A stage serves B robots; what it remembers belongs in arrays with a leading B, so that rows cannot mix. What it may
    have besides helps the guard (`mrctl.control.guard`): `weight_norm`, a float64 array `(B,)`; `weight_volts`, what
    weights of norm one make of features of one, in V, a number or `(B,)`; and `restore(rows)`, which takes the robots
    with these indices back to what they began with.
    """

    def output(self, command: Array, derivative: Array) -> Array:
        """Feedforward of the two channels; asked once before the first tick, too, for a start without a bump.

        Args:
            command: Commanded V in m/s and θ̇ in rad/s, `(B, 2)`.
            derivative: Their derivatives in m/s², rad/s², `(B, 2)`.

        Returns:
            U_Σ and U_Δ in V, `(B, 2)`; under `rigid` steering the second channel is a correction of θ̇ in rad/s.
        """
        ...

    def learn(self, feedback: Array, saturated: Array, twist: Array, voltage: Array) -> Array | None:
        """Learns from what the feedback still had to do after the last `output`, and from how the robot moves.

        Args:
            feedback: Feedback of the two channels `(B, 2)`, units as `output`.
            saturated: 1 where a limit acted, a driven wheel slips, or this robot must not learn, `(B,)`.
            twist: Measured V in m/s and θ̇ in rad/s, on which `voltage` has not acted yet, `(B, 2)`.
            voltage: What is sent from now on, after the limits, in the channels and units of `output`, `(B, 2)`.

        Returns:
            How much this added to the output for the same command, `(B, 2)`, so that the PID can hand it over; or None.
        """
        ...


class CompiledFeedforward(ABC):
    """A feedforward whose two laws are kernels for one robot, so that a whole control tick is one compiled call.

    `output` and `learn` call the same kernels for all robots, which makes it a `Feedforward` like any other.

    Attributes:
        respond: `(i, command, derivative, robot, arrays, voltage)` writes the output of robot i to `voltage`, `(2,)`.
        learn_one: `(i, command, feedback, frozen, twist, voltage, period, robot, arrays, added)` learns, writes what
            that added to the output of robot i to `added`, `(2,)`, and returns the norm of what it has learned.
        arrays: What the kernels keep and share, a plain tuple of arrays.
        guarded: Whether the guard has anything to watch.
        weight_norm: Norm of what was learned, `(B,)`.
        weight_volts: What weights of norm one make of features of one, in V; 0 where there are no weights.
    """

    respond: ClassVar[Kernel]
    learn_one: ClassVar[Kernel]
    guarded: ClassVar[bool] = True
    arrays: tuple[Any, ...]
    weight_volts: Array | float = 0.0

    def __init__(self, robot: Robot, size: int, rigid: bool, period: float) -> None:
        """Takes the nominal robot, the number of robots, whether channel two is steering, and the period in s."""
        self.robot, self.period = nominal(robot, rigid), period
        self.weight_norm = np.zeros(size)
        self._command, self._voltage, self._added = np.zeros((3, size, 2))

    @abstractmethod
    def restore(self, rows: NDArray[np.intp]) -> None:
        """Takes the robots with these indices back to what they knew at the start."""

    def take(self, row: int, other: CompiledFeedforward) -> None:
        """Copies what the same stage for one robot keeps into a row of this one."""
        size = len(self.weight_norm)
        self.weight_norm[row] = other.weight_norm[0]
        for mine, theirs in zip(_flat(self.arrays), _flat(other.arrays), strict=True):
            if len(mine) == size and len(theirs) == 1:
                mine[row] = theirs[0]

    def output(self, command: Array, derivative: Array) -> Array:
        """See `Feedforward.output`."""
        self._command[:] = command
        _respond_all(type(self))(self._command, _own(derivative), self.robot, self.arrays, self._voltage)
        return self._voltage

    def learn(self, feedback: Array, saturated: Array, twist: Array, voltage: Array) -> Array:
        """See `Feedforward.learn`."""
        _learn_all(type(self))(
            self._command, _own(feedback), _own(saturated), _own(twist), _own(voltage), self.period, self.robot,
            self.arrays, self._added, self.weight_norm,
        )  # fmt: skip
        return self._added


def _flat(arrays: tuple[Any, ...]) -> list[NDArray[Any]]:
    """The arrays in a tuple of arrays and such tuples."""
    return [a for entry in arrays for a in (_flat(entry) if isinstance(entry, tuple) else [entry])]


def _own(values: Array) -> Array:
    """Contiguous float64, so that the loops below are compiled once."""
    return np.ascontiguousarray(values, float)


@cache
def _respond_all(stage: type[CompiledFeedforward]) -> Kernel:
    return respond_all.calling(respond=stage.respond)


@cache
def _learn_all(stage: type[CompiledFeedforward]) -> Kernel:
    return learn_all.calling(learn_one=stage.learn_one)


@kernel
def nothing(i: int, command: Array, derivative: Array, robot: Row, arrays: tuple[Any, ...], voltage: Array) -> None:
    """Zero volts."""
    voltage[0] = voltage[1] = 0.0


@kernel
def learn_nothing(
    i: int, command: Array, feedback: Array, frozen: float, twist: Array, voltage: Array, period: float, robot: Row,
    arrays: tuple[Any, ...], added: Array,
) -> float:  # fmt: skip
    """Adds nothing."""
    added[0] = added[1] = 0.0
    return 0.0


respond, learn_one = nothing, learn_nothing  # what the loops below call, until `Kernel.calling` says otherwise


@kernel
def respond_all(command: Array, derivative: Array, robot: Rows, arrays: tuple[Any, ...], voltage: Array) -> None:
    """The output of all robots."""
    for i in range(len(voltage)):
        respond(i, command[i], derivative[i], robot[0], arrays, voltage[i])


@kernel
def learn_all(
    command: Array, feedback: Array, frozen: Array, twist: Array, voltage: Array, period: float, robot: Rows,
    arrays: tuple[Any, ...], added: Array, norm: Array,
) -> None:  # fmt: skip
    """One learning step of all robots."""
    for i in range(len(added)):
        norm[i] = learn_one(
            i, command[i], feedback[i], frozen[i], twist[i], voltage[i], period, robot[0], arrays, added[i]
        )


class NoFeedforward(CompiledFeedforward):
    """`none`: PID alone, the paper's baseline."""

    respond, learn_one, guarded = nothing, learn_nothing, False
    arrays = ()

    def restore(self, rows: NDArray[np.intp]) -> None:
        """Has nothing to forget."""


@kernel
def inverse_dynamics(
    i: int, command: Array, derivative: Array, robot: Row, arrays: tuple[Any, ...], voltage: Array
) -> None:
    """Equation (3) inverted, on features without scale."""
    half_track, coefficients, ones, x = arrays
    features(command, derivative, half_track[i], ones, x)
    linear(x, coefficients[i], voltage)


class InverseDynamics(CompiledFeedforward):
    """The corrected equation (3) inverted: `model` with nominal parameters, `oracle` with the plant's own.

    Attributes:
        coefficients: Of the features in the two channels, `(B, 8, 2)`.
    """

    respond, learn_one, guarded = inverse_dynamics, learn_nothing, False

    def __init__(self, robots: Sequence[Robot], rigid: bool) -> None:
        """Takes a robot a row, and whether the second channel is steering."""
        super().__init__(robots[0], len(robots), rigid, 0.0)
        self._half_track, self.coefficients = np.zeros(len(robots)), np.zeros((len(robots), 8, 2))
        self.arrays = self._half_track, self.coefficients, np.ones(8), np.zeros(8)
        for row, robot in enumerate(robots):
            self.set_robot(row, robot)

    def set_robot(self, row: int, robot: Robot) -> None:
        """Replaces the parameters of one row."""
        self._half_track[row] = robot.half_track
        self.coefficients[row] = inverse_coefficients(robot)
        if self.robot["rigid"][0]:  # the steering makes θ̇; its inverse is φ_c itself
            self.coefficients[row, :, 1] = 0.0

    def restore(self, rows: NDArray[np.intp]) -> None:
        """Has nothing to forget."""
