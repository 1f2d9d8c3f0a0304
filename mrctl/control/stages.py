"""The stages of figure 3, and what an object of your own must have to be one.

A stage serves B robots: arrays have a leading B, so that rows cannot mix. It is made by a factory, which is called with
the nominal robot and the number of robots, and has two methods. What goes in are copies, NumPy arrays of float64; what
comes out may be NumPy or torch. Any of these is replaced by `mrctl.simulate(…, motion=, feedback=, feedforward=,
steering=)`; the limits and the prefilter of the command, the limits of voltage and steering angle, and the guard on the
feedforward stay what they are.

| stage         | asked for                                    | other method                                        |
| ------------- | -------------------------------------------- | --------------------------------------------------- |
| `Motion`      | requested twist from posture and reference   | `reset` before the first tick                       |
| `Feedback`    | volts from commanded and measured twist      | `reset`, to what holds the motion at the start      |
| `Feedforward` | volts from commanded twist and its rate      | `learn` from what the feedback still had to do      |
| `Steering`    | angle and rate of the fork from the same     | `reset`, to the angle at the start                  |
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, TypedDict, TypeVar

from mrctl.control.feedforward import Feedforward
from mrctl.kernel import Array
from mrctl.theory.robot import Robot


class Motion(Protocol):
    """The motion controller: how to move so that the reference is reached. Asked once a motion period."""

    def reset(self, pose: Array, reference: Array, period: float) -> None:
        """Begins.

        Args:
            pose: Posture in m, m, rad, `(B, 3)`.
            reference: As for `output`, `(B, 7)`.
            period: From one `output` to the next in s.
        """
        ...

    def output(self, pose: Array, twist: Array, reference: Array) -> Array:
        """The twist to ask for.

        Args:
            pose: Measured x, y in m and θ in rad, `(B, 3)`.
            twist: Measured V in m/s and θ̇ in rad/s, `(B, 2)`.
            reference: x_r, y_r, θ_r, V_r, θ̇_r and the derivatives of the last two, side by side, `(B, 7)`.

        Returns:
            Requested V in m/s and θ̇ in rad/s, `(B, 2)`.
        """
        ...


class Feedback(Protocol):
    """The velocity controller without its feedforward. Asked once a control period.

    It may have `integral`, a float64 array `(B, 2)`: what a learner takes over, and what the guard hands back, is then
    moved out of it and into it.
    """

    def reset(self, steady: Array, period: float) -> None:
        """Begins.

        Args:
            steady: What the feedback has to hold for a start without a bump, in the units of `output`, `(B, 2)`.
            period: From one `output` to the next in s.
        """
        ...

    def output(self, command: Array, twist: Array, excess: Array) -> Array:
        """What is added to the feedforward.

        Args:
            command: Commanded V in m/s and θ̇ in rad/s, after limits and prefilter, `(B, 2)`.
            twist: Measured V and θ̇, `(B, 2)`.
            excess: What the limits took from the last output, in its units, for anti-windup, `(B, 2)`.

        Returns:
            U_Σ and U_Δ in V, `(B, 2)`; under `rigid` steering the second channel is a correction of θ̇ in rad/s.
        """
        ...


class Steering(Protocol):
    """The law of the fork. Asked once a control period."""

    def reset(self, angle: Array, period: float) -> None:
        """Begins.

        Args:
            angle: Angles of the forks in rad, `(B,)`.
            period: From one `output` to the next in s.
        """
        ...

    def output(self, command: Array, derivative: Array) -> Array:
        """Where the fork goes.

        Args:
            command: Commanded V in m/s and θ̇ in rad/s, `(B, 2)`; under `rigid` steering with what the second channel
                adds to θ̇.
            derivative: Derivatives of the commanded V and θ̇ in m/s², rad/s², `(B, 2)`.

        Returns:
            Angle in rad, positive to the left, and its rate in rad/s, `(B, 2)`.
        """
        ...


Stage = TypeVar("Stage", covariant=True)
Factory = Callable[[Robot, int], Stage]


class Stages(TypedDict, total=False):
    """Factories of stages of your own, by the stage that they replace."""

    motion: Factory[Motion] | None
    feedback: Factory[Feedback] | None
    feedforward: Factory[Feedforward] | None
    steering: Factory[Steering] | None


METHODS = {name: ("output", "learn" if name == "feedforward" else "reset") for name in Stages.__annotations__}
