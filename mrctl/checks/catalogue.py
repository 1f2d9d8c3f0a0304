"""The list of all physics checks, and how one of them is applied to a robot.

A check takes a compiled model and the parameters that it ought to have, usually drives it, and returns measured values
beside expected ones. The expected values follow from those parameters, a `Robot`, and from the laws of `mrctl.theory`,
never from the model, so a model with another gear, mass or friction than it claims fails. Voltages, speeds and times
scale with the robot: any robot that `mrctl.physics.mjcf.load` accepts can be checked.
"""

# pyright: reportAttributeAccessIssue=false
# (mujoco is compiled and ships no stubs)

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, NamedTuple

import mujoco
import numpy as np

from mrctl.checks import drive, invariants, plausibility, wheels, worlds
from mrctl.checks.comparison import CheckFailed, Report, compare
from mrctl.checks.open_loop import Unstable, is_steered
from mrctl.physics.mjcf import steerings
from mrctl.physics.parameters import read_robot
from mrctl.theory.robot import Robot, Steering


class Check(NamedTuple):
    """A check, and the robots that it suits.

    Attributes:
        function: Measures a model against a robot's parameters.
        world: World that it needs; `flat` stands for any level floor.
        steering: Steering arrangement in which it drives a robot that offers several.
        front: Kind of front wheel or caster that it needs; "load ahead" of the driven axle has the centre of mass, too.
        unless: Tells from a robot's parameters why it does not suit the robot, if that is so, or else returns "".
    """

    function: Callable[[mujoco.MjModel, Robot], Report]
    world: str
    steering: Steering
    front: Literal["any", "steered", "without trail", "following", "trailing fork", "load ahead"] = "any"
    unless: Callable[[Robot], str] | None = None

    @property
    def name(self) -> str:
        """Name of the function."""
        return getattr(self.function, "__name__", str(self.function))

    def unsuited(self, model: mujoco.MjModel) -> str:
        """Returns why the check does not suit a robot, or "" if it does."""
        if self.front in ("steered", "without trail") and not is_steered(model):
            return "nothing is steered"
        if self.front == "without trail" and read_robot(model).trail > 1e-6:
            return "the steered wheel trails its axis, which equation (1) leaves out"
        if self.front == "following" and steerings(model) == ("rigid",):
            return "servos hold the front wheels, which leaves the motors one degree of freedom"
        if self.front == "trailing fork" and "compliant" not in steerings(model):
            return "no trailing fork"
        if self.front == "load ahead" and read_robot(model).com_offset < 0:
            return "the centre of mass is behind the driven axle, where free rolling is unstable"
        return self.unless(read_robot(model)) if self.unless else ""

    def measure(self, model: mujoco.MjModel, robot: Robot) -> Report:
        """Measures all values, and returns them whether they pass or not."""
        try:
            with np.errstate(all="ignore"):  # 0/0 is NaN, which never passes
                return self.function(model, robot)
        except (Unstable, np.linalg.LinAlgError):
            return [compare("the simulation stays finite (1: yes)", 0.0, 1.0)]
        except Exception as error:  # noqa: BLE001 (a robot that breaks a check fails it)
            text = " ".join(f"{type(error).__name__}: {error}".split())
            return [compare(f"the check can be done (1: yes), {text}", 0.0, 1.0)]

    def run(self, model: mujoco.MjModel, robot: Robot) -> Report:
        """Measures all values, and returns them if all pass.

        Raises:
            CheckFailed: A value is out of tolerance; the first such value is named.
        """
        report = self.measure(model, robot)
        for comparison in report:
            if not comparison.passed:
                raise CheckFailed(comparison)
        return report


CHECKS = (
    Check(plausibility.units, "flat", "compliant"),
    Check(plausibility.stance, "flat", "compliant"),
    Check(plausibility.limits, "flat", "compliant"),
    Check(plausibility.turning_limits, "flat", "rigid"),
    Check(plausibility.motors, "flat", "compliant"),
    Check(plausibility.inertias, "flat", "compliant"),
    Check(wheels.rest, "flat", "compliant"),
    Check(drive.hold_on_slope, "flat", "compliant", unless=drive.holds_on_all_slopes),
    Check(drive.top_speed, "flat", "compliant"),
    Check(drive.stall, "flat", "rigid"),
    Check(drive.velocity_time_constant, "flat", "compliant"),
    Check(drive.rotation_time_constant, "flat", "rigid"),
    Check(drive.coast_down, "flat", "compliant", "load ahead", unless=drive.rolls_freely),
    Check(wheels.circle, "flat", "rigid", "steered"),
    Check(wheels.rolling, "flat", "rigid", "without trail"),
    Check(wheels.traction, "flat", "compliant", unless=wheels.hardly_spins),
    Check(wheels.cornering, "flat", "rigid", "steered"),
    Check(drive.centre_of_mass, "flat", "rigid", "load ahead"),
    Check(drive.prediction, "flat", "caster", "following"),
    Check(wheels.scrub_free, "flat", "caster", "trailing fork"),
    Check(invariants.energy, "flat", "compliant"),
    Check(invariants.mirror, "flat", "compliant"),
    Check(invariants.invariance, "flat", "compliant"),
    Check(invariants.convergence, "flat", "compliant"),
    Check(worlds.slope, "slope", "compliant"),
    Check(worlds.tilted_gravity, "slope", "compliant"),
    Check(worlds.patch, "patch", "compliant"),
    Check(worlds.rough, "rough", "compliant"),
)
"""All checks. Those with the world `flat` run on any level floor; the others need the shipped worlds."""
