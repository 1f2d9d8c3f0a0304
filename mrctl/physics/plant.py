"""The physics boundary: one robot through dm_control, many through `mujoco.batch`, behind one interface.

Every array has a leading batch dimension. Both plants share the code below but for two methods, so robot i of a batch
is the same scenario run alone, bit for bit. Only `qpos` and `qvel` are read: a batch's sensor data is a substep old.
"""

# pyright: reportAttributeAccessIssue=false
# (mujoco is compiled and ships no stubs)

from __future__ import annotations

import warnings
from abc import ABC, abstractmethod

import mujoco
import numpy as np
from mujoco import batch as mujoco_batch
from numba import float64, guvectorize, int64, njit
from numpy.typing import NDArray

from mrctl.control.chain import GIVEN, one, rows
from mrctl.physics import mjcf
from mrctl.physics.elements import MOTORS, has
from mrctl.physics.parameters import read_robot
from mrctl.physics.perturb import fields, perturb, write
from mrctl.physics.stand import stand
from mrctl.theory.perturbation import LONGEST_DELAY, Perturbation
from mrctl.theory.robot import CAR, Robot, RobotFile, Steering

with warnings.catch_warnings():  # on a machine without a display dm_control tries GLFW first, which complains
    warnings.simplefilter("ignore")
    from dm_control import mujoco as dm_mujoco
    from dm_control.mujoco import wrapper
    from dm_control.rl.control import PhysicsError

Array = NDArray[np.float64]

# Columns of a reading: what `read` computes from one state.
X, Y, THETA, V, OMEGA, V_LATERAL, RATE_LEFT, RATE_RIGHT, STEERING, STEERING_RATE, UPRIGHT = range(11)
HUGE = 1e10  # MuJoCo's own bound (mjMAXVAL) on a sane state
TILT = float(np.cos(np.radians(30)))
JOINTS = ("chassis", "wheel_left", "wheel_right")


@guvectorize(
    [(float64[:], float64[:], int64[:], float64[:])], "(q),(v),(a),(r)", writable_args=("reading",), cache=True
)
def read(qpos, qvel, address, reading):  # noqa: ANN001, ANN201
    """State to reading: posture, twist in the body frame, wheel rates, steering, cosine of the tilt (NaN: blown up).

    `address` holds qpos and dof addresses of chassis, left wheel, right wheel and, unless nothing is steered, steering
    joint in turn.
    """
    q, d = address[0], address[1]
    w, i, j, k = qpos[q + 3], qpos[q + 4], qpos[q + 5], qpos[q + 6]
    # Body x and y axes in the world.
    xx, xy, xz = 1 - 2 * (j * j + k * k), 2 * (i * j + w * k), 2 * (i * k - w * j)
    yx, yy, yz = 2 * (i * j - w * k), 1 - 2 * (i * i + k * k), 2 * (j * k + w * i)
    reading[0] = qpos[q]
    reading[1] = qpos[q + 1]
    reading[2] = np.arctan2(xy, xx)
    reading[3] = xx * qvel[d] + xy * qvel[d + 1] + xz * qvel[d + 2]
    reading[4] = qvel[d + 5]
    reading[5] = yx * qvel[d] + yy * qvel[d + 1] + yz * qvel[d + 2]
    reading[6] = qvel[address[3]]
    reading[7] = qvel[address[5]]
    reading[8] = reading[9] = 0.0
    if address.shape[0] > 6:
        reading[8] = qpos[address[6]]
        reading[9] = qvel[address[7]]
    reading[10] = 1 - 2 * (i * i + j * j)
    for value in qpos:
        if not abs(value) < HUGE:
            reading[10] = np.nan
    for value in qvel:
        if not abs(value) < HUGE:
            reading[10] = np.nan


_read = one(read)
_FIELD = float64[:, :]  # an array of the engine's


# What the plant keeps of one robot beside the engine's state.
STATE = np.dtype(
    [
        ("delay", "i8"), ("drive_gain", "f8"), ("resistance", "f8", 2), ("back_emf", "f8", 2),
        ("reading", "f8", UPRIGHT + 1), ("applied", "f8", 2), ("current", "f8", 2), ("failed", "?"),
    ],
    align=True,
)  # fmt: skip


@njit((GIVEN, int64, float64[:, :, ::1], int64[::1], rows(STATE), _FIELD), cache=True)
def _drive(command, tick, queue, inputs, state, ctrl):  # noqa: ANN001, ANN202
    """Sends each robot the command of `delay` periods ago; returns whether all commands are finite."""
    finite = True
    for i in range(len(state)):
        s = state[i]
        queue[tick % len(queue), i] = command[i]
        now = queue[(tick - s.delay) % len(queue), i]
        for k in range(len(inputs)):
            ctrl[i, inputs[k]] = now[k] * s.drive_gain if k < 2 else now[k]
            finite &= np.isfinite(now[k]) or s.failed
        for k in range(2):
            s.applied[k] = now[k] * s.drive_gain
    return finite


@njit((*[_FIELD] * 3, int64[::1], int64[::1], rows(STATE)), cache=True)
def _look(qpos, qvel, act, address, acts, state):  # noqa: ANN001, ANN202
    """Readings and armature currents after a period; returns whether all robots are upright and sane."""
    upright = True
    for i in range(len(state)):
        s = state[i]
        _read(qpos[i], qvel[i], address, s.reading)
        for k in range(2):
            if len(acts):
                s.current[k] = act[i, acts[k]]
            else:
                s.current[k] = (s.applied[k] - s.back_emf[k] * s.reading[RATE_LEFT + k]) / s.resistance[k]
        upright &= s.reading[UPRIGHT] > TILT or s.failed
    return upright


def addresses(model: mujoco.MjModel) -> NDArray[np.int64]:
    """Addresses in qpos and qvel of each joint in `JOINTS` and of `steering`, if there is one, alternating, `(8,)`."""
    joints = (*JOINTS, "steering") if has(model, "joint", "steering") else JOINTS
    return np.array([a for name in joints for a in (model.joint(name).qposadr[0], model.joint(name).dofadr[0])], int)


class CarPhysics(dm_mujoco.Physics):
    """A `dm_control` physics of a world with the car, with named readouts.

    Readouts are current after every step, because they are computed from `qpos` and `qvel`.
    """

    @classmethod
    def from_world(
        cls, world: str = "flat", steering: Steering = "compliant", robot: RobotFile = CAR
    ) -> CarPhysics:
        """Loads a world by name or path with a robot (see `mrctl.physics.mjcf.load`)."""
        return cls.from_compiled(mjcf.load(world, steering, robot=robot))

    @classmethod
    def from_compiled(cls, model: mujoco.MjModel) -> CarPhysics:
        """Wraps a compiled model that stays the caller's to edit."""
        physics = cls.from_model(wrapper.MjModel(model))
        physics.legacy_step = False  # plain mj_step, as the batch does
        return physics

    def reading(self) -> Array:
        """All readouts at once, `(11,)`."""
        reading = np.zeros(11)
        read(self.data.qpos, self.data.qvel, addresses(self.model.ptr), reading)
        return reading

    def pose(self) -> Array:
        """Posture of P: x, y in m and heading in rad, `(3,)`."""
        return self.reading()[[X, Y, THETA]]

    def twist(self) -> Array:
        """V in m/s and θ̇ in rad/s in the body frame, `(2,)`."""
        return self.reading()[[V, OMEGA]]

    def wheel_rates(self) -> Array:
        """Rates of the left and right rear wheel in rad/s, `(2,)`."""
        return self.reading()[[RATE_LEFT, RATE_RIGHT]]

    def steering_angle(self) -> float:
        """Angle of the fork in rad, positive to the left."""
        return float(self.reading()[STEERING])

    def upright(self) -> float:
        """Cosine of the tilt from the vertical."""
        return float(self.reading()[UPRIGHT])

    def motor_current(self) -> Array:
        """Armature currents left and right in A, `(2,)`: (U − k_E N ω)/R_a, or the current state with inductance."""
        model = self.model.ptr
        return motor_current(
            self.data.ctrl[None, inputs(model)[:2]],
            self.wheel_rates()[None],
            np.ascontiguousarray(self.data.act)[None],
            *_motor_parameters(model),
        )[0]


def inputs(model: mujoco.MjModel) -> list[int]:
    """Positions in ctrl of left voltage, right voltage and, unless nothing is steered, steering angle and rate."""
    found = [int(model.actuator_ctrladr[model.actuator(name).id]) for name in MOTORS]
    if has(model, "actuator", "steering"):
        steering = int(model.actuator_ctrladr[model.actuator("steering").id])
        found += [steering, steering + 1]
    return found


def _motor_parameters(model: mujoco.MjModel) -> tuple[Array, Array, list[int]]:
    """Resistance `(1, 2)`, back-EMF per wheel rate `(1, 2)`, and addresses of the current states, empty without."""
    motors = [model.actuator(name).id for name in ("motor_left", "motor_right")]
    resistance = model.actuator_gainprm[motors, 0]
    back_emf = model.actuator_gainprm[motors, 1] * model.actuator_gear[motors, 0]
    acts = [int(a) for a in model.actuator_actadr[motors] if a >= 0]
    return resistance[None], back_emf[None], acts


def motor_current(
    voltage: Array, rates: Array, act: Array, resistance: Array, back_emf: Array, acts: list[int]
) -> Array:
    """Armature currents `(B, 2)` in A from applied voltages, wheel rates and activations."""
    return act[:, acts] if acts else (voltage - back_emf * rates) / resistance


class Plant(ABC):
    """B robots in physics. Robots that fail stop alone; their state stays as it was found.

    Attributes:
        state: One `STATE` a robot; `reading`, `applied` and `failed` are views of it.
        robot: The nominal robot, which is all that a controller may know.
        truth: The robots as perturbed, for the oracle.
        reading: Readouts `(B, 11)`, current after `reset` and `step`; columns as named in this module.
        applied: Voltages at the terminals, left and right, `(B, 2)` in V.
        failed: Which robots have stopped, `(B,)`.
        failure: Why, one string a robot.
        running: How many have not.
    """

    size: int
    qpos: Array
    qvel: Array
    act: Array
    ctrl: Array
    wrench: Array

    def __init__(self, model: mujoco.MjModel, size: int, substeps: int) -> None:
        """Takes the nominal compiled model, the number of robots and the physics steps in a control period."""
        self.size, self.substeps = size, substeps
        self.robot: Robot = read_robot(model)
        self.truth = [self.robot] * size
        self.state = state = np.zeros(size, STATE)
        self.reading, self.applied, self.failed = state["reading"], state["applied"], state["failed"]
        self.failure = [""] * size
        self.running = size
        self._nominal = model
        self._scratch = mjcf.clone(model)
        self._address = addresses(model)
        self._inputs = np.array(inputs(model), int)
        resistance, back_emf, acts = _motor_parameters(model)
        self._acts = np.array(acts, int)
        state["resistance"], state["back_emf"], state["drive_gain"] = resistance, back_emf, 1.0
        # As long as any delay, so that a robot's past does not depend on the delays of the others.
        self._queue = np.zeros((1 + round(LONGEST_DELAY / (substeps * model.opt.timestep)), size, 4))
        self._tick = 0
        self._pushes: dict[int, int] = {}
        self._chassis = model.body("chassis").id

    @abstractmethod
    def _write(self, robot: int, model: mujoco.MjModel) -> None:
        """Gives one robot the parameters of `model`."""

    @abstractmethod
    def _advance(self) -> dict[int, str]:
        """Runs the physics steps of one control period; returns the engine's complaints by robot."""

    def perturb(self, robot: int, perturbation: Perturbation, delay: int) -> None:
        """Replaces the perturbation of one robot, from now on.

        Args:
            robot: Its row.
            perturbation: The complete perturbation.
            delay: `control_delay` in control periods.

        Raises:
            InputError: The perturbed robot could not stand.
        """
        perturb(self._nominal, self._scratch, perturbation)
        self._write(robot, self._scratch)
        self.truth[robot] = read_robot(self._scratch, perturbation.supply_factor)
        resistance, back_emf, _ = _motor_parameters(self._scratch)
        self.state["resistance"][robot], self.state["back_emf"][robot] = resistance[0], back_emf[0]
        self.state["drive_gain"][robot], self.state["delay"][robot] = perturbation.supply_factor, delay

    def check(self, perturbation: Perturbation) -> None:
        """Refuses a perturbation with which a robot could not stand.

        Raises:
            InputError: Why.
        """
        perturb(self._nominal, self._scratch, perturbation)

    def reset(self, pose: Array, twist: Array) -> None:
        """Stands every robot on the ground, rolling.

        Args:
            pose: `(B, 3)` in m, m, rad.
            twist: `(B, 2)` in m/s, rad/s.

        Raises:
            InputError: There is no ground below a pose.
        """
        for i in range(self.size):
            state = stand(self._model_of(i), pose[i], twist[i])
            self.qpos[i], self.qvel[i] = state
        self._look()
        self._queue[..., 2] = self.reading[:, STEERING]

    def restart(self, robot: int, pose: Array, twist: Array) -> None:
        """Stands one robot on the ground again, as `reset` does all of them; what happened to it is forgotten.

        Args:
            robot: Its row.
            pose: `(3,)` in m, m, rad.
            twist: `(2,)` in m/s, rad/s.

        Raises:
            InputError: There is no ground below the pose.
        """
        if self.failed[robot]:
            self.failed[robot], self.failure[robot] = False, ""
            self.running += 1
        self._pushes.pop(robot, None)
        self._clear(robot)
        self.qpos[robot], self.qvel[robot] = stand(self._model_of(robot), pose, twist, self.truth[robot])
        self.applied[robot] = 0.0
        self._look()
        self._queue[:, robot] = 0.0
        self._queue[:, robot, 2] = self.reading[robot, STEERING]

    @abstractmethod
    def _clear(self, robot: int) -> None:
        """Takes the engine's state of one robot back to the model's default."""

    @abstractmethod
    def _model_of(self, robot: int) -> mujoco.MjModel:
        """The compiled model of one robot, for `stand`."""

    def push(self, robot: int, force: Array, periods: int) -> None:
        """Pushes the chassis of one robot.

        Args:
            robot: Its row.
            force: Forces along the world's x and y in N at the chassis' centre of mass, torque about z in N·m, `(3,)`.
            periods: For how many control periods.
        """
        self.wrench[robot, self._chassis] = force[0], force[1], 0.0, 0.0, 0.0, force[2]
        self._pushes[robot] = self._tick + periods

    def step(self, command: Array) -> None:
        """Holds a command for one control period: `send`, `advance`, `look`."""
        self.send(command)
        self.advance()
        self.look()

    def send(self, command: Array) -> None:
        """Hands a command to the actuators, or to the queue where it is delayed.

        Args:
            command: Commanded voltages left and right in V, steering angle in rad and rate in rad/s, `(B, 4)`.
        """
        if command.shape != (self.size, 4):
            raise ValueError(f"command: shape {command.shape}, expected {(self.size, 4)}")
        # The engine would silently take zero volts instead of what is no number.
        if not _drive(command, self._tick, self._queue, self._inputs, self.state, self.ctrl):
            sent = self._queue[(self._tick - self.state["delay"]) % len(self._queue), np.arange(self.size)]
            for robot in np.flatnonzero(~np.isfinite(sent).all(axis=1)):
                self.fail(int(robot), "non-finite command")

    def advance(self) -> None:
        """The physics of one control period."""
        if self.running:
            for robot, reason in self._advance().items():
                self.fail(robot, reason)

    def look(self) -> None:
        """Readouts after the physics; judges whether robots are still what they should be."""
        self._tick += 1
        if self._pushes:
            for robot in [r for r, end in self._pushes.items() if end == self._tick]:
                self.wrench[robot, self._chassis] = 0.0
                del self._pushes[robot]
        if not self._look():
            upright = self.reading[:, UPRIGHT]
            for robot in np.flatnonzero(~(upright > TILT)):
                self.fail(int(robot), "tilt over 30°" if np.isfinite(upright[robot]) else "non-finite state")

    def fail(self, robot: int, reason: str) -> None:
        """Stops one robot for good; the first reason counts."""
        if not self.failed[robot]:
            self.failed[robot], self.failure[robot] = True, reason
            self.running -= 1

    def current(self) -> Array:
        """Armature currents left and right at the end of the last control period in A, `(B, 2)`."""
        return self.state["current"]

    def _look(self) -> bool:
        return _look(self.qpos, self.qvel, self.act, self._address, self._acts, self.state)


class PhysicsPlant(Plant):
    """One robot through dm_control's physics API.

    Attributes:
        physics: The `CarPhysics`, for rendering and inspection.
    """

    def __init__(self, model: mujoco.MjModel, substeps: int) -> None:
        """Takes a compiled world and the physics steps in a control period."""
        super().__init__(model, 1, substeps)
        self.physics = CarPhysics.from_compiled(mjcf.clone(model))
        data = self.physics.data
        # Views of the engine's own memory, with the batch dimension in front.
        self.qpos, self.qvel, self.act, self.ctrl = data.qpos[None], data.qvel[None], data.act[None], data.ctrl[None]
        self.wrench = data.xfrc_applied[None]

    def _model_of(self, robot: int) -> mujoco.MjModel:
        return self.physics.model.ptr

    def _write(self, robot: int, model: mujoco.MjModel) -> None:
        write(self.physics.model.ptr, fields(model))

    def _clear(self, robot: int) -> None:
        mujoco.mj_resetData(self.physics.model.ptr, self.physics.data.ptr)

    def _advance(self) -> dict[int, str]:
        try:
            self.physics.step(self.substeps)
        except PhysicsError:
            pass  # raised after the steps, on a warning; `step` judges the state itself, as it does for a batch
        except mujoco.FatalError as error:
            return {0: str(error)}
        return {}


class BatchPlant(Plant):
    """Many robots on MuJoCo's own batch engine; parameters differ per robot through `expand` and `set_const`."""

    def __init__(self, model: mujoco.MjModel, size: int, substeps: int, threads: int = 0) -> None:
        """Takes a compiled world, the number of robots, physics steps in a control period, threads (0: all cores)."""
        super().__init__(model, size, substeps)
        quiet = mjcf.clone(model)
        quiet.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_SENSOR  # nobody reads them here
        self.batch = mujoco_batch.Batch(quiet, size, threads)
        self._held = mjcf.clone(quiet)  # for `_model_of` to write into
        self.qpos, self.qvel = self.batch.bind("qpos"), self.batch.bind("qvel")
        self.act, self.ctrl = self.batch.bind("act"), self.batch.bind("ctrl")
        self.wrench = self.batch.bind("xfrc_applied")
        self._fields = fields(model)
        self._expanded: set[str] = set()

    def _model_of(self, robot: int) -> mujoco.MjModel:
        return self.batch.get_model(robot, self._held)

    def _write(self, robot: int, model: mujoco.MjModel) -> None:
        for name, value in fields(model).items():
            if name in self._expanded or not np.array_equal(value, self._fields[name]):
                self._expanded.add(name)
                self.batch.expand(name)[robot] = value
        self.batch.set_const(np.array([robot]))

    def _clear(self, robot: int) -> None:
        self.batch.reset(np.array([robot]), stage=mujoco.mjtStage.mjSTAGE_NONE)

    def _advance(self) -> dict[int, str]:
        ids = None if self.running == self.size else np.flatnonzero(~self.failed)
        try:
            self.batch.step(ids, self.substeps)
        except mujoco_batch.SimulationError as error:
            return {int(i): self.batch.error(int(i)) for i in error.ids}
        return {}


def build(model: mujoco.MjModel, size: int, substeps: int, threads: int = 0) -> Plant:
    """The plant for a number of robots: dm_control for one, the batch engine for more."""
    return PhysicsPlant(model, substeps) if size == 1 else BatchPlant(model, size, substeps, threads)
