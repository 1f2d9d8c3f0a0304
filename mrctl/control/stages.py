"""The stages of figure 3 that a user can replace, with the estimator before them, and the methods that each needs.

A stage serves B robots: arrays have a leading axis B, one row for each robot. A factory, called with the nominal robot
and B, makes it. Its two methods receive copies, NumPy arrays of float64, and may return NumPy arrays or torch tensors.
`mrctl.simulate(…, motion=, feedback=, feedforward=, steering=, estimator=)` takes the factories. The limits and the
prefilter of the command, the limits of voltage and steering angle, and the guard on the feedforward still act.

Estimated posture and twist are predicted over the delay of the sensing tier, to the time at which the voltage of the
tick reaches the motors; the reference is that of the same time.

| stage            | `output` returns                                  | other method                                  |
| ---------------- | ------------------------------------------------- | --------------------------------------------- |
| `MotionStage`    | requested twist from posture and reference        | `reset` before the first tick                 |
| `FeedbackStage`  | voltages from commanded and estimated twist       | `reset` to the voltages of the initial motion |
| `Feedforward`    | voltages from commanded twist and its derivative  | `learn` from the feedback and the motion      |
| `SteeringStage`  | angle and rate of the fork from commanded twist   | `reset` to the initial angle                  |
| `EstimatorStage` | posture and twist from the samples of the sensors | `reset` to a first estimate                   |
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, TypedDict, TypeVar

from mrctl.control.feedforward import Feedforward
from mrctl.kernel import Array
from mrctl.theory.robot import Robot


class MotionStage(Protocol):
    """The motion controller: it requests the twist that brings the robot to its reference, once in a motion period.

    It may have a method `assign(scenarios)`, which gets the `mrctl.Scenario` of each robot before all other methods, as
    it is at the start. A scenario also has what a robot cannot know, such as its perturbation; what is on its map is
    `scenario.known`.

    It may have a method `see(row, scan)`, which gets the index of a robot and a `mrctl.theory.rays.Scan` in each tick
    in which the lidar of that robot has scanned, before `output` if that is called in the same tick. The robots have
    lidars, `sensing.lidar`, where there is such a method.

    It may have a method `follow(row, plan)`, which gets the index of a robot and the reference of an event, one of
    `mrctl.theory.references`, before the first `output` that is given this reference. A motion controller with such a
    method may go along its reference at its own pace: the run does not fail where the robot is far from it.

    It may have a method `tune(row, gains)`, which gets the index of a robot and its gains of Kanayama's law, a
    `mrctl.Kanayama` in which all are set, designed where the scenario sets none. It is called once for each robot after
    `assign`, and again when an event changes the gains, which for an event at the start is before `reset`. Without this
    method, events that change the gains are refused.

    It may have a member `followed`, a float64 array `(B, 7)`: the reference that it follows in place of the given one,
    in the same units. The twist of `followed` then passes the prefilter without lag, as that of the given one does
    otherwise, and changes until the next `output` at the rate of the acceleration of `followed`. The member is read
    after each `output`, and None stands for the given one.
    """

    def reset(self, pose: Array, reference: Array, period: float) -> None:
        """Starts a run.

        Args:
            pose: Estimated posture in m, m, rad, `(B, 3)`.
            reference: Reference as for `output`, `(B, 7)`.
            period: Motion period, from one `output` to the next, in s.
        """
        ...

    def output(self, pose: Array, twist: Array, reference: Array) -> Array:
        """Returns the requested twist.

        Args:
            pose: Estimated x, y in m and θ in rad, `(B, 3)`; θ jumps by 2π at ±π, and θ_r, which is continuous, does
                not.
            twist: Estimated V in m/s and θ̇ in rad/s, `(B, 2)`.
            reference: x_r and y_r in m, θ_r in rad, V_r in m/s, θ̇_r in rad/s, V̇_r in m/s², θ̈_r in rad/s², `(B, 7)`.

        Returns:
            Requested V in m/s and θ̇ in rad/s, `(B, 2)`.
        """
        ...


class FeedbackStage(Protocol):
    """The velocity controller without its feedforward; it is called once in a control period.

    It is not told the voltage that is applied, only `excess`. The twist is predicted over the delay with the commanded
    accelerations; `mrctl.control.matching` says how to match it with the output that made it.

    It may have a member `integral`, a float64 array `(B, 2)`. The hierarchy then subtracts from it a share of what a
    learner adds to the feedforward, and the guard sets it at the beginning of a fallback.
    """

    def reset(self, steady: Array, period: float) -> None:
        """Starts a run.

        Args:
            steady: Output that holds the initial motion, for a bumpless start, in the units of `output`, `(B, 2)`.
            period: Control period, from one `output` to the next, in s.
        """
        ...

    def output(self, command: Array, twist: Array, excess: Array) -> Array:
        """Returns the voltages that are added to the feedforward.

        Args:
            command: Commanded V in m/s and θ̇ in rad/s, after limits and prefilter, `(B, 2)`.
            twist: Estimated V in m/s and θ̇ in rad/s, `(B, 2)`.
            excess: Sum of feedback and feedforward in the last period after the limits less that before them, for
                anti-windup, in the units of the output, `(B, 2)`.

        Returns:
            U_Σ and U_Δ in V, `(B, 2)`; under `rigid` steering the second channel is a correction of θ̇ in rad/s.
        """
        ...


class SteeringStage(Protocol):
    """The law of the steered fork, which is called once in a control period."""

    def reset(self, angle: Array, period: float) -> None:
        """Starts a run.

        Args:
            angle: Angles of the forks in rad, `(B,)`.
            period: Control period, from one `output` to the next, in s.
        """
        ...

    def output(self, command: Array, derivative: Array) -> Array:
        """Returns the steering command.

        Args:
            command: Commanded V in m/s and θ̇ in rad/s, `(B, 2)`; under `rigid` steering, θ̇ contains the correction of
                the second channel.
            derivative: Derivatives of the commanded V in m/s² and θ̇ in rad/s², `(B, 2)`.

        Returns:
            Steering angle in rad, positive to the left, and its rate in rad/s, `(B, 2)`.
        """
        ...


class EstimatorStage(Protocol):
    """The estimator of posture and twist, which is called once in a control period.

    Its estimate is predicted to the time at which the voltage of the period acts. If the estimate of a robot is not
    finite, odometry continues from its last estimate; `estimator_fault` of the result names the first such tick.
    """

    def reset(self, pose: Array, twist: Array, period: float) -> None:
        """Starts a run.

        Args:
            pose: First estimate of x and y in m and of θ in rad, `(B, 3)`; `start_position_noise` and
                `start_heading_noise` of `sensing` are its errors, by default those of a fix.
            twist: First estimate of V in m/s and θ̇ in rad/s, `(B, 2)`.
            period: Control period, from one `output` to the next, in s.
        """
        ...

    def output(self, encoders: Array, gyro: Array, acceleration: Array, fix: Array, age: Array) -> Array:
        """Returns the estimate at the moment of the call.

        Args:
            encoders: Angles of the rear wheels in the last samples that arrived, left and right, in rad, `(B, 2)`.
            gyro: θ̇ in the last sample of the gyro that arrived, in rad/s, `(B,)`.
            acceleration: Specific force in the last such sample, forward and to the left, in m/s², `(B, 2)`.
            fix: Posture fix that arrived in this period in m, m, rad, `(B, 3)`, θ between −π and π; zeros where none
                did.
            age: Age of that fix in s, `(B,)`; −1 where none arrived.

        Returns:
            x and y in m, θ in rad, V in m/s and θ̇ in rad/s, `(B, 5)`.
        """
        ...


Stage = TypeVar("Stage", covariant=True)
Factory = Callable[[Robot, int], Stage]


class Stages(TypedDict, total=False):
    """Factories of a user's own stages, by the names of the stages that they replace."""

    motion: Factory[MotionStage] | None
    feedback: Factory[FeedbackStage] | None
    feedforward: Factory[Feedforward] | None
    steering: Factory[SteeringStage] | None
    estimator: Factory[EstimatorStage] | None


METHODS = {name: ("output", "learn" if name == "feedforward" else "reset") for name in Stages.__annotations__}
