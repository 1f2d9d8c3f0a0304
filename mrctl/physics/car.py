"""One robot as a `dm_control` physics, with named readouts."""

# pyright: reportAttributeAccessIssue=false
# (mujoco is compiled and ships no stubs)

from __future__ import annotations

import warnings

import mujoco
import numpy as np

from mrctl.kernel import Array, Row
from mrctl.physics import mjcf
from mrctl.physics.readout import READING, addresses, current_limits, inputs, motor_parameters, read
from mrctl.theory.robot import CAR, RobotFile, Steering

with warnings.catch_warnings():  # without a display dm_control tries GLFW first, which warns
    warnings.simplefilter("ignore")
    from dm_control import mujoco as dm_mujoco
    from dm_control.mujoco import wrapper


class CarPhysics(dm_mujoco.Physics):
    """A `dm_control` physics of a world with the car, with named readouts.

    Readouts are current after every step, because they are computed from `qpos` and `qvel`.
    """

    @classmethod
    def from_world(cls, world: str = "flat", steering: Steering = "compliant", robot: RobotFile = CAR) -> CarPhysics:
        """Loads a world by name or path with a robot (see `physics.mjcf.load`)."""
        return cls.from_compiled(mjcf.load(world, steering, robot=robot))

    @classmethod
    def from_compiled(cls, model: mujoco.MjModel) -> CarPhysics:
        """Wraps a compiled model without copying it, so that the caller may still edit it."""
        physics = cls.from_model(wrapper.MjModel(model))
        physics.legacy_step = False  # plain mj_step, as the batch does
        return physics

    def reading(self) -> Row:
        """Returns all readouts at once, as a record of `READING`."""
        reading = np.zeros(1, READING)[0]
        read(self.data.qpos, self.data.qvel, addresses(self.model.ptr), reading)
        return reading

    def pose(self) -> Array:
        """Returns the pose of P: x, y in m and heading in rad, `(3,)`."""
        return self.reading()["pose"]

    def twist(self) -> Array:
        """Returns V in m/s and θ̇ in rad/s in the body frame, `(2,)`."""
        return self.reading()["twist"]

    def wheel_rates(self) -> Array:
        """Returns the rates of the left and right rear wheel in rad/s, `(2,)`."""
        return self.reading()["wheel_rates"]

    def steering_angle(self) -> float:
        """Returns the angle of the fork in rad, positive to the left."""
        return float(self.reading()["steering_angle"])

    def upright(self) -> float:
        """Returns the cosine of the tilt from the vertical; NaN once the state has blown up."""
        return float(self.reading()["upright"])

    def motor_current(self) -> Array:
        """Returns the armature currents left and right in A, `(2,)`.

        They are (U − k_E N ω)/R_a with the voltages U within the supply, or the current states of motors with
        inductance, within the limit of the drivers.
        """
        model, data = self.model.ptr, self.data
        resistance, back_emf, states = motor_parameters(model)
        motors = inputs(model)[:2]
        voltage = np.clip(data.ctrl[motors], *model.actuator_ctrlrange[motors].T)
        free = (voltage - back_emf * self.wheel_rates()) / resistance
        limit = current_limits(model)
        return np.clip(data.act[states] if states else free, -limit, limit)
