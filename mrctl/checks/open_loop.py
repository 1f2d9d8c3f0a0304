"""The test bench of the checks: a robot in MuJoCo that is driven open loop, with voltages and without a controller.

`Car` drives and records. Functions of a `Robot` return the times, voltages and forces by which a check scales its
experiment; functions of a model return variants of it that isolate one law.
"""

# pyright: reportAttributeAccessIssue=false
# (mujoco is compiled and ships no stubs)

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Literal

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from mrctl.kernel import Array, Rows
from mrctl.physics.elements import MOTORS, REAR, bottom, fronts, has, rolling_fronts
from mrctl.physics.mjcf import clone
from mrctl.physics.perturb import perturb
from mrctl.physics.readout import READING, addresses, inputs, read_all
from mrctl.physics.stand import stand
from mrctl.physics.units import loss_torque
from mrctl.theory.perturbation import Perturbation
from mrctl.theory.robot import Robot

Control = Callable[[float], ArrayLike]  # time in s to left V, right V, steering rad, steering rate rad/s

COMPONENTS = {
    "x": ("pose", 0), "y": ("pose", 1), "theta": ("pose", 2), "v": ("twist", 0), "omega": ("twist", 1),
    "wheel_rate_left": ("wheel_rates", 0), "wheel_rate_right": ("wheel_rates", 1),
}  # fmt: skip
"""Signals that are components of a field of `READING`."""
NO_CONTROL = (0.0, 0.0, 0.0, 0.0)  # no voltage, which shorts the motors, and wheels straight on
HOLD_TIME = 0.02  # s for which a control is held
MAX_TIME = 600.0  # s, longest drive; the slowest robot that comes with mrctl needs 20
MAX_STEPS = 1_000_000  # steps in a drive
DIVERGENCE_WARNINGS = (
    mujoco.mjtWarning.mjWARN_BADQPOS,
    mujoco.mjtWarning.mjWARN_BADQVEL,
    mujoco.mjtWarning.mjWARN_BADQACC,
)


class Unstable(Exception):
    """The simulation has diverged."""


class TooLong(Exception):
    """A check would simulate for too long, or its time is up; the message says which."""


_deadline: ContextVar[float] = ContextVar("deadline", default=math.inf)  # s of processor time


@contextlib.contextmanager
def limited(seconds: float) -> Iterator[None]:
    """Limits the processor time in s that what is done within may take; a limit around it stays in force."""
    token = _deadline.set(min(_deadline.get(), time.process_time() + seconds))
    try:
        yield
    finally:
        _deadline.reset(token)


def ended() -> bool:
    """Tells whether the time is up."""
    return time.process_time() > _deadline.get()


@dataclass(frozen=True)
class Log:
    """A drive, sampled at the start and after every hold of the control.

    Attributes:
        time: Time in s, `(T,)`.
        qpos: MuJoCo's positions, `(T, nq)`.
        qvel: MuJoCo's velocities, `(T, nv)`.
        reading: One record of `READING` a sample, `(T,)`.
    """

    time: Array
    qpos: Array
    qvel: Array
    reading: Rows

    def __getitem__(self, signal: str) -> Array:
        """Returns a signal by its name in results, or `upright`, `(T,)`."""
        if signal in COMPONENTS:
            field, k = COMPONENTS[signal]
            return self.reading[field][:, k]
        return self.reading[signal]


class Car:
    """A compiled robot on its wheels, driven open loop.

    Attributes:
        model: The model.
        data: Its state.
    """

    def __init__(self, model: mujoco.MjModel, pose: ArrayLike = (0, 0, 0), twist: ArrayLike = (0, 0)) -> None:
        """Stands the robot at a posture `(3,)` in m, m, rad, rolling with a twist `(2,)` in m/s, rad/s."""
        self.model, self.data = model, mujoco.MjData(model)
        self.data.qpos[:], self.data.qvel[:] = stand(model, np.asarray(pose, float), np.asarray(twist, float))
        self._inputs = inputs(model)
        self._address = addresses(model)
        mujoco.mj_forward(model, self.data)

    def control(self, control: ArrayLike) -> None:
        """Sets voltages left and right in V, steering angle in rad and rate in rad/s, `(4,)`."""
        self.data.ctrl[self._inputs] = np.asarray(control)[: len(self._inputs)]

    def drive(self, seconds: float, control: ArrayLike | Control, hold: float = HOLD_TIME) -> Log:
        """Drives with a constant control, or with a function of the time since the call that is held for `hold` s.

        Raises:
            Unstable: The simulation has diverged.
            TooLong: The drive would last longer than `MAX_TIME` or take more than `MAX_STEPS` steps, or the time is up.
        """
        if not (0 <= seconds <= MAX_TIME and seconds <= MAX_STEPS * self.model.opt.timestep):
            step = self.model.opt.timestep
            raise TooLong(f"it would drive for {seconds:.3g} s in steps of {step:.3g} s; look for a wrong unit")
        law = control if callable(control) else lambda _: control
        substeps = max(1, round(hold / self.model.opt.timestep))
        hold = substeps * self.model.opt.timestep  # in whole steps
        ticks = max(1, round(seconds / hold))
        qpos, qvel = np.empty((ticks + 1, self.model.nq)), np.empty((ticks + 1, self.model.nv))
        qpos[0], qvel[0] = self.data.qpos, self.data.qvel
        for k in range(ticks):
            if ended():
                raise TooLong("its time is up")
            self.control(law(k * hold))
            mujoco.mj_step(self.model, self.data, substeps)
            qpos[k + 1], qvel[k + 1] = self.data.qpos, self.data.qvel
        reading = np.zeros(ticks + 1, READING)
        read_all(qpos, qvel, self._address, reading)
        self.assert_stable()
        return Log(hold * np.arange(ticks + 1.0), qpos, qvel, reading)

    def assert_stable(self) -> None:
        """Refuses a state that is not finite, and one that MuJoCo has silently reset after it diverged.

        Raises:
            Unstable: The simulation has diverged.
        """
        if any(self.data.warning[w].number for w in DIVERGENCE_WARNINGS) or not np.isfinite(self.data.qvel).all():
            raise Unstable

    def tyre_forces(self) -> Array:
        """Returns the forces of the ground on left wheel, right wheel and front, in N in the world frame, `(3, 3)`."""
        mujoco.mj_forward(self.model, self.data)
        forces, force = np.zeros((3, 3)), np.zeros(6)
        row = {self.model.geom(name).id: k for k, name in enumerate(REAR)}
        row |= {self.model.geom(name).id: 2 for name in fronts(self.model)}
        for i in range(self.data.ncon):
            contact = self.data.contact[i]
            mujoco.mj_contactForce(self.model, self.data, i, force)
            for side, sign in ((0, -1), (1, 1)):  # the frame's first axis points from geom 0 to geom 1
                if (geom := int(contact.geom[side])) in row:
                    forces[row[geom]] += sign * contact.frame.reshape(3, 3).T @ force[:3]
        return forces


def cruise(model: mujoco.MjModel, robot: Robot, volts: float) -> tuple[Car, Log]:
    """Drives straight on with the same voltage on both motors until V has settled, starting near that speed."""
    car = Car(model, twist=(robot.velocity_gain * max(0.0, volts - loss_voltage(robot)), 0))
    return car, car.drive(settling_time(robot), (volts, volts, 0, 0))


def lag(log: Log, signal: Literal["v", "omega"]) -> float:
    """Returns ∫ (y(T) − y) dt/(y(T) − y(0)) in s for a signal y that settles within the log: that of 1/(τ s + 1) is τ.

    ∫ y dt comes from the pose, which MuJoCo moves by the speeds at the ends of its steps. As back-EMF also brakes with
    these, the step does not change the lag; a fit to the samples would find τ + h/2.
    """
    x, y, theta = log.reading["pose"].T
    moved = np.hypot(np.diff(x), np.diff(y)).sum() if signal == "v" else np.diff(np.unwrap(theta)).sum()
    first, last = log[signal][[0, -1]]
    return float((last * log.time[-1] - moved) / (last - first))


# Times, voltages and forces that follow from a robot's parameters


def settling_time(robot: Robot) -> float:
    """Returns the time in s after which e^−12 of a transient of equation (3) remains."""
    return 12 * max(robot.velocity_time_constant, robot.rotation_time_constant)


def loss_voltage(robot: Robot) -> float:
    """Returns the voltage in V that overcomes all Coulomb losses while the robot drives straight on."""
    return loss_torque(robot) / robot.motor_gain


def holding_force(robot: Robot) -> float:
    """Returns all Coulomb losses as a force on the robot, 2 τ_loss/r + F_roll, in N."""
    return 2 * robot.drive_loss / robot.wheel_radius + robot.rolling_force


def braking(robot: Robot) -> float:
    """Returns the braking force of back-EMF and viscous friction per speed, 2 (N² k²/R_a + b)/r², in N·s/m."""
    return 2 * robot.motor_gain * robot.voltage_per_rate / robot.wheel_radius**2


def on_skid_robot(robot: Robot) -> Robot:
    """Returns the parameters of a robot `on_skid`: rear rolling loss counts as gear loss, and the front has none."""
    rear = robot.rolling_force * (1 - robot.front_load) / 2 * robot.wheel_radius
    return robot.model_copy(
        update={"gear_loss": robot.gear_loss + rear, "rolling_coefficient": 0.0, "front_wheel_inertia": 0.0}
    )


# Names of wheels, and variants of a model


def is_steered(model: mujoco.MjModel) -> bool:
    """Tells whether the robot has a steered wheel."""
    return has(model, "joint", "steering")


def rolling_wheels(model: mujoco.MjModel) -> list[str]:
    """Returns the names of all wheels that turn on a joint: the two driven ones, and those in front that roll."""
    return [*REAR, *rolling_fronts(model)]


def caster_gaps(model: mujoco.MjModel) -> dict[int, float]:
    """Returns how high casters end above the floor of the driven wheels in m, by the index of the file's own geom.

    The robot stands on another geom at the same place, which `mrctl.physics.adopt` made to reach the floor.
    """
    data, found = mujoco.MjData(model), {}
    mujoco.mj_kinematics(model, data)
    floor = float(np.mean([data.geom(wheel).xpos[2] - model.geom(wheel).size[0] for wheel in REAR]))
    for caster in (model.geom(name).id for name in fronts(model) if name.startswith("caster")):
        near = np.linalg.norm(data.geom_xpos - data.geom_xpos[caster], axis=1) < 1e-6
        near &= model.geom_bodyid == model.geom_bodyid[caster]
        near[caster] = False
        if near.any():
            own = min(map(int, np.flatnonzero(near)), key=lambda geom: bottom(model, data, geom))
            found[own] = float(bottom(model, data, own)) - floor
    return found


def open_circuit(model: mujoco.MjModel) -> mujoco.MjModel:
    """Returns a copy without motor torque and viscous friction; the rotors' inertia and Coulomb losses stay."""
    model = clone(model)
    motors = [model.actuator(name).id for name in MOTORS]
    model.actuator_gainprm[motors, 1] = 1e-9
    model.actuator_damping[motors] = 0
    model.dof_damping[[model.joint(wheel).dofadr[0] for wheel in REAR]] = 0
    return model


def on_skid(model: mujoco.MjModel) -> mujoco.MjModel:
    """Returns a copy whose front tyre has no friction: it follows where equation (3) sends it, and brakes nothing."""
    model = clone(model)
    for wheel in (model.geom(name).id for name in fronts(model)):
        model.pair_friction[(model.pair_geom1 == wheel) | (model.pair_geom2 == wheel)] = 1e-5
    return model


def crisp(model: mujoco.MjModel, robot: Robot, tau: float) -> mujoco.MjModel:
    """Returns a copy whose contacts and time step are as short against τ and the wheel radius as the default robot's.

    Slip grows with a contact's time constant, and the sinking of a tyre with its square: in such a copy both matter no
    more than in the default robot, for which the tolerances are stated. At a constant speed only the radius matters,
    and τ is infinite. MuJoCo computes currents in windings from the speeds of the step before, which takes up to a step
    h from the lag; with inductance the step is therefore a fifth, and h/τ 0.2 %.
    """
    factor = min(1.0, tau / 0.18, np.sqrt(robot.wheel_radius / 0.098))
    model = clone(model)
    model.opt.timestep *= factor / 5 if robot.inductance else factor
    model.pair_solref[:, 0] *= factor
    model.pair_solreffriction[:, 0] *= factor
    return model


def with_finer_step(model: mujoco.MjModel, halvings: int) -> mujoco.MjModel:
    """Returns a copy whose time step is halved a number of times."""
    model = clone(model)
    model.opt.timestep /= 2**halvings
    return model


def towing(model: mujoco.MjModel, damping: float) -> mujoco.MjModel:
    """Returns a copy that tows a load of `damping` N·s/m at P, on a rail that keeps it from turning and side-slip."""
    model = clone(model)
    dof, rail = model.joint("chassis").dofadr[0], max(1e6, 1e3 * damping)
    model.dof_damping[[dof, dof + 1, dof + 5]] = damping, rail, rail
    return model


def perturbed(model: mujoco.MjModel, perturbation: Perturbation) -> mujoco.MjModel:
    """Returns a copy to which a perturbation is applied."""
    copy = clone(model)
    perturb(model, copy, perturbation)
    return copy
