"""The boundary to MuJoCo: one robot through dm_control, or many through `mujoco.batch`, behind one interface.

Every array has a leading batch dimension. Both plants share all code but a few methods, so robot i of a batch gives the
same bits as its scenario alone. The readouts use `qpos`, `qvel` and `act` only, because the sensor data of a batch
is a substep old.
"""

# pyright: reportAttributeAccessIssue=false
# (mujoco is compiled and ships no stubs)

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import defaultdict
from collections.abc import Mapping, Sequence

import mujoco
import numpy as np
from dm_control.rl.control import PhysicsError
from mujoco import batch as mujoco_batch
from numpy.typing import NDArray

from mrctl.kernel import Array, Held, Row, held, kernel
from mrctl.physics import mjcf
from mrctl.physics.car import CarPhysics
from mrctl.physics.contacts import Contacts, contacts
from mrctl.physics.elements import COLLISION, has
from mrctl.physics.obstacles import moving_bodies
from mrctl.physics.parameters import read_robot
from mrctl.physics.perturb import fields, limit_current, perturb, write
from mrctl.physics.readout import READING, addresses, current_limits, imu_motion, inputs, motor_parameters, read
from mrctl.physics.stand import stand
from mrctl.theory.drive import DRIVER, SERVO, Driver, SteeringServo, chop, drive, turn
from mrctl.theory.obstacles import Obstacles, Surroundings
from mrctl.theory.perturbation import MAX_DELAY, Perturbation
from mrctl.theory.robot import Robot

MIN_COS_TILT = float(np.cos(np.radians(30)))  # least cosine of the tilt; a robot that tilts further has failed
IDEAL_DRIVER, IDEAL_SERVO = Driver(), SteeringServo()

PLANT = np.dtype(
    [
        ("delay", "i8"),  # of commands, control periods
        ("driver", DRIVER),
        ("servo", SERVO),
        ("resistance", "f8", 2),  # Ω, left and right
        ("back_emf", "f8", 2),  # V·s/rad at the wheel
        ("emf", "f8", 2),  # back-EMF of the motors, V
        ("before", READING),  # at the beginning of the control period
        ("reading", READING),  # now
        ("sent", "f8", 2),  # voltages of the driver without its current limit, left and right, V
        ("applied", "f8", 2),  # voltages at the terminals, left and right, at the end of the period, V
        ("lost", "f8", 2),  # applied less sent voltage, due to the current limit, as if at the nominal supply, V
        ("current", "f8", 2),  # armature currents, left and right, A
        ("wheel_angles", "f8", 2),  # of the rear wheels, left and right, from the zero of the model, rad
        ("imu_velocity", "f8", 3),  # velocity of the inertial sensor in the world, m/s
        ("imu_axes", "f8", (2, 3)),  # its axes forward and to the left, in the world
        ("specific_force", "f8", 2),  # forward and to the left at the inertial sensor, mean over the period, m/s²
        ("gravity", "f8", 3),  # in the world, m/s²
        ("stopped", "?"),  # whether the robot has stopped
    ],
    align=True,
)


@kernel
def send(command: Array, tick: int, place: int) -> bool:
    """Sends each robot the command of `delay` periods ago; returns whether those of all running robots are finite.

    Args:
        command: Commands of this tick, `(B, 4)`.
        tick: Control tick.
        place: Address of the arrays of the plant (see `Held`).
    """
    plant, queue, ctrl, _, inputs = held(place)[:5]
    finite = True
    for i in range(len(plant)):
        p = plant[i]
        p.before = p.reading
        for k in range(command.shape[1]):
            queue[tick % len(queue), i, k] = command[i, k]
        now = queue[(tick - p.delay) % len(queue), i]
        for k in range(len(inputs)):
            finite &= np.isfinite(now[k]) or p.stopped
        back_emf(p)
        drive(now[:2], p.emf, p.resistance, p.driver, p.sent)
        for k in range(2):
            ctrl[i, inputs[k]] = p.sent[k]
        if len(inputs) > 2:
            ctrl[i, inputs[2]], ctrl[i, inputs[3]] = turn(now[2], now[3], p.servo)
    return finite


@kernel
def back_emf(p: Row) -> None:
    """Computes the back-EMF of the motors of one robot, k_E N ω."""
    for k in range(2):
        p.emf[k] = p.back_emf[k] * p.reading.wheel_rates[k]


@kernel
def look(first: int, last: int, period: float, place: int) -> bool:
    """Updates the readouts after a period; returns whether all running robots are upright and finite.

    The specific force is the mean acceleration in the period less gravity.

    Args:
        first: The first robot to look at.
        last: The robot behind the last one.
        period: Control period in s.
        place: Address of the arrays of the plant (see `Held`).
    """
    plant, _, _, acts, _, qpos, qvel, act, address, imu = held(place)
    upright, velocity, axes = True, np.empty(3), np.empty((2, 3))
    for i in range(first, last):
        p = plant[i]
        read(qpos[i], qvel[i], address, p.reading)
        imu_motion(qpos[i], qvel[i], address, imu, velocity, axes)
        for k in range(2):
            p.wheel_angles[k] = qpos[i, address[2 + 2 * k]]
            p.specific_force[k] = 0.0
            for n in range(3):
                axis = (p.imu_axes[k, n] + axes[k, n]) / 2
                p.specific_force[k] += axis * ((velocity[n] - p.imu_velocity[n]) / period - p.gravity[n])
        for n in range(3):
            p.imu_velocity[n], p.imu_axes[0, n], p.imu_axes[1, n] = velocity[n], axes[0, n], axes[1, n]
        back_emf(p)
        for k in range(2):
            limit = p.driver.current_limit[k]
            p.applied[k] = chop(p.sent[k], p.emf[k], p.resistance[k], limit)
            p.lost[k] = (p.applied[k] - p.sent[k]) / p.driver.scale if p.driver.scale > 0 else 0.0
            if len(acts):
                p.current[k] = max(-limit, min(limit, act[i, acts[k]]))
            else:
                p.current[k] = (p.applied[k] - p.emf[k]) / p.resistance[k]
        upright &= p.reading.upright > MIN_COS_TILT or p.stopped
    return upright


class Tracks:
    """The moving obstacles of one world."""

    def __init__(self, obstacles: Obstacles, period: float) -> None:
        """Takes the obstacles, and the control period in s."""
        self._surroundings, self._period = Surroundings(obstacles), period
        self._poses = self._surroundings.poses(np.zeros(0))

    def at(self, ticks: NDArray[np.intp]) -> Array:
        """Returns the poses of M obstacles at control ticks, `(n,)`, of a run: `(n, M, 3)` in m, m, rad."""
        if ticks.max() >= len(self._poses):
            self._poses = self._surroundings.poses(self._period * np.arange(2.0 * ticks.max() + 100))
        return self._poses[ticks]


class Plant(ABC):
    """B robots in physics. One that is stopped, as it failed or its run has ended, keeps its state; the others go on.

    Attributes:
        state: One record of `PLANT` for each robot; `reading`, `applied`, `current` and `stopped` are views of it.
        models: The world of each robot with the nominal robot; where the obstacles are the same, so is the object.
        robot: The nominal robot, which is all that a controller may know.
        truth: The perturbed robots, for the prior `true_model`.
        reading: One record of `READING` for each robot, current after `reset` and `step`.
        applied: Voltages at the terminals, left and right, `(B, 2)` in V.
        current: Armature currents left and right at the end of the last control period, `(B, 2)` in A.
        stopped: Whether each robot has stopped, `(B,)`.
        failure: Why each robot failed, or "".
        running: Number of robots that have not stopped.
        imu: Position of the inertial sensor in the frame of the chassis in m, `(3,)`.
    """

    size: int
    qpos: Array
    qvel: Array
    act: Array
    ctrl: Array
    wrench: Array
    sensors: Array
    mocap: tuple[Array, Array]

    def __init__(
        self, models: Sequence[mujoco.MjModel], robot: Robot, substeps: int, obstacles: Sequence[Obstacles]
    ) -> None:
        """Takes the arguments of `build`."""
        model, size = models[0], len(models)
        self.size, self.substeps = size, substeps
        self.robot = robot
        self.truth = [robot] * size
        self.state = state = np.zeros(size, PLANT)
        self.reading, self.stopped = state["reading"], state["stopped"]
        self.applied, self.current = state["applied"], state["current"]
        self.failure = [""] * size
        self.running = size
        self.models = list(models)
        self._scratch, self._scratch_data = mjcf.clone(model), mujoco.MjData(model)
        self._nominal_robots = np.ones(size, bool)
        self._address = addresses(model)
        self._inputs = np.array(inputs(model), int)
        resistance, back_emf, acts = motor_parameters(model)
        self._acts = np.array(acts, int)
        self.imu = model.site("imu").pos.copy() if has(model, "site", "imu") else np.zeros(3)
        self._period = substeps * model.opt.timestep
        state["resistance"], state["back_emf"], state["gravity"] = resistance, back_emf, model.opt.gravity
        state["driver"]["supply"], state["driver"]["gain"], state["driver"]["scale"] = robot.supply, 1.0, 1.0
        state["driver"]["current_limit"] = current_limits(model)
        # Long enough for the largest possible delays of sensing and perturbation, because those may change.
        self._queue = np.zeros((1 + round(2 * MAX_DELAY / self._period), size, 4))
        self._tick = 0
        self._pushes: dict[int, list[tuple[int, Array]]] = {}  # wrenches on each robot, and the ticks at which they end
        self._chassis = model.body("chassis").id
        self._collision = model.sensor(COLLISION).adr[0] if has(model, "sensor", COLLISION) else -1
        self._began = np.zeros(size, int)  # tick at which each robot was placed on the ground
        worlds: dict[Obstacles, list[int]] = defaultdict(list)
        for row, own in enumerate(obstacles):
            if own.moving:
                worlds[own].append(row)
        self._moving = [
            (Tracks(own, self._period), np.array(rows)[:, None], moving_bodies(models[rows[0]], own))
            for own, rows in worlds.items()
        ]

    def _hold(self) -> None:
        """Lets the compiled calls of each tick find the arrays of the plant, which from then on stay where they are."""
        own, engine = (self.state, self._queue, self.ctrl, self._acts, self._inputs), (self.qpos, self.qvel, self.act)
        self._held = Held(*own, *engine, self._address, self.imu)
        self._send = send.calling(held=self._held.reader).compiled  # of commands in any memory layout
        self._look = look.calling(held=self._held.reader).repeated()

    @abstractmethod
    def _write(self, robot: int, model: mujoco.MjModel) -> None:
        """Gives one robot the parameters of `model`."""

    @abstractmethod
    def _advance(self) -> dict[int, str]:
        """Runs the physics steps of one control period; returns error messages of the engine by robot."""

    def perturb(
        self,
        robot: int,
        perturbation: Perturbation,
        delay: int,
        driver: Driver = IDEAL_DRIVER,
        servo: SteeringServo = IDEAL_SERVO,
    ) -> None:
        """Replaces the perturbation of one robot, and its driver and servo, from now on.

        Args:
            robot: Index of the robot.
            perturbation: The complete perturbation.
            delay: Delay of commands in control periods.
            driver: Motor driver and battery, to which the perturbation adds.
            servo: Servo of the fork, to which the perturbation adds.

        Raises:
            InputError: The perturbed robot could not stand.
        """
        driver, servo = perturbation.of_driver(driver), perturbation.of_servo(servo)
        ideal = driver == IDEAL_DRIVER and servo == IDEAL_SERVO and delay == 0
        if self._nominal_robots[robot] and ideal and perturbation == Perturbation():
            return
        self._nominal_robots[robot] = False
        nominal, model = self.models[robot], self._scratch
        if nominal is not self.models[0]:
            model = mjcf.clone(nominal)
        perturb(nominal, model, perturbation, self.robot, self._scratch_data)
        limit_current(nominal, model, driver.current_limit)
        self._write(robot, model)
        self.truth[robot] = read_robot(model, perturbation.supply_factor, self._scratch_data)
        resistance, back_emf, _ = motor_parameters(model)
        self.state["resistance"][robot], self.state["back_emf"][robot] = resistance, back_emf
        self.state["delay"][robot] = delay
        rows = self.state["driver"]
        for name in ("dead_zone", "pwm_steps", "battery_resistance"):
            rows[name][robot] = getattr(driver, name)
        rows["gain"][robot] = rows["scale"][robot] = perturbation.supply_factor
        rows["current_limit"][robot] = current_limits(model)
        self.state["servo"]["offset"][robot], self.state["servo"]["backlash"][robot] = servo.offset, servo.backlash
        self.state["gravity"][robot] = model.opt.gravity

    def check(self, perturbation: Perturbation) -> None:
        """Refuses a perturbation with which a robot could not stand.

        Raises:
            InputError: The robot could not stand; the message says why.
        """
        perturb(self.models[0], self._scratch, perturbation, self.robot, self._scratch_data)

    def reset(self, pose: Array, twist: Array) -> None:
        """Places every robot on the ground, rolling.

        Args:
            pose: x and y of P and heading, `(B, 3)` in m, m, rad.
            twist: V and θ̇, `(B, 2)` in m/s, rad/s.

        Raises:
            InputError: There is no ground below a pose, or an obstacle is in the way.
        """
        for i in range(self.size):
            self.qpos[i], self.qvel[i] = stand(self._model_of(i), pose[i], twist[i], self.truth[i])
        self._begin(slice(0, self.size))

    def restart(self, robot: int, pose: Array, twist: Array) -> None:
        """Places one robot on the ground again, as `reset` does with all; clears its failure, push and commands.

        Args:
            robot: Index of the robot.
            pose: x and y of P and heading, `(3,)` in m, m, rad.
            twist: V and θ̇, `(2,)` in m/s, rad/s.

        Raises:
            InputError: There is no ground below the pose, or an obstacle is in the way.
        """
        if self.stopped[robot]:
            self.stopped[robot], self.failure[robot] = False, ""
            self.running += 1
        self._pushes.pop(robot, None)
        self._clear(robot)
        self._began[robot] = self._tick
        self.qpos[robot], self.qvel[robot] = stand(self._model_of(robot), pose, twist, self.truth[robot])
        self.state["sent"][robot] = 0.0
        self._begin(slice(robot, robot + 1))

    @abstractmethod
    def _clear(self, robot: int) -> None:
        """Resets the engine's state of one robot to the model's default."""

    @abstractmethod
    def _model_of(self, robot: int) -> mujoco.MjModel:
        """Returns the compiled model of one robot, for `stand`."""

    def push(self, robot: int, force: Array, periods: int) -> None:
        """Pushes the chassis of one robot; pushes that overlap add up.

        Args:
            robot: Index of the robot.
            force: Forces along the world's x and y in N at the chassis' centre of mass, torque about z in N·m, `(3,)`.
            periods: Duration in control periods.
        """
        wrench = np.array([force[0], force[1], 0.0, 0.0, 0.0, force[2]])
        self._pushes.setdefault(robot, []).append((self._tick + periods, wrench))
        self._press(robot)

    def _press(self, robot: int) -> None:
        """Applies the sum of the pushes on one robot that have not ended."""
        lasting = [(end, wrench) for end, wrench in self._pushes.pop(robot) if end > self._tick]
        self.wrench[robot, self._chassis] = 0.0
        if lasting:
            self._pushes[robot] = lasting
            self.wrench[robot, self._chassis] = sum((wrench for _, wrench in lasting[1:]), start=lasting[0][1])

    def step(self, command: Array, faults: Mapping[int, str] | None = None) -> None:
        """Holds a command for one control period: `send`, `advance`, `look`."""
        self.send(command, faults)
        self.advance()
        self.look()

    def send(self, command: Array, faults: Mapping[int, str] | None = None) -> None:
        """Queues a command, and sends the actuators the one whose delay is over.

        Args:
            command: Commanded voltages left and right in V, steering angle in rad and rate in rad/s, `(B, 4)`.
            faults: Robots that fail because their command cannot be used, each with the reason.
        """
        if faults:
            for robot, reason in faults.items():
                self.stop(robot, reason)
        if command.shape != (self.size, 4):
            raise ValueError(f"command: shape {command.shape}, expected {(self.size, 4)}")
        # The engine would silently replace NaN by 0 V.
        if not self._send(command, self._tick, self._held.place):
            sent = self._queue[(self._tick - self.state["delay"]) % len(self._queue), np.arange(self.size)]
            for robot in np.flatnonzero(~np.isfinite(sent).all(axis=1)):
                self.stop(int(robot), "non-finite command")

    def advance(self) -> None:
        """Advances physics by one control period; others that do so call `move_obstacles` before, `collide` after."""
        if self.running:
            self.move_obstacles(1)
            for robot, reason in self._advance().items():
                self.stop(robot, reason)
            self.collide()

    def move_obstacles(self, ahead: int) -> None:
        """Moves the moving obstacles to their poses `ahead` ticks from now."""
        position, turn = self.mocap
        for tracks, rows, bodies in self._moving:
            now = tracks.at(self._tick + ahead - self._began[rows[:, 0]])
            position[rows, bodies, :2] = now[..., :2]
            turn[rows, bodies, 0], turn[rows, bodies, 3] = np.cos(now[..., 2] / 2), np.sin(now[..., 2] / 2)

    def collide(self) -> None:
        """Fails robots whose hull has touched an obstacle in the last physics step."""
        if self._collision >= 0:
            for robot in np.flatnonzero(self.sensors[:, self._collision]):
                self.stop(int(robot), "collision")

    def look(self) -> None:
        """Updates the readouts after the physics; fails robots that have tilted or whose state is not finite."""
        self._tick += 1
        for robot in list(self._pushes):
            self._press(robot)
        if not self._look(0, self.size, self._period, self._held.place):
            upright = self.reading["upright"]
            for robot in np.flatnonzero(~(upright > MIN_COS_TILT)):
                self.stop(int(robot), "tilt over 30°" if np.isfinite(upright[robot]) else "non-finite state")

    def stop(self, robot: int, reason: str) -> None:
        """Stops one robot until it restarts, because it failed for a reason or, with "", because its run has ended.

        Of several calls the first counts.
        """
        if not self.stopped[robot]:
            self.stopped[robot], self.failure[robot] = True, reason
            self.running -= 1

    def contacts(self, robot: int) -> Contacts:
        """Returns the contacts of one robot in its present state; the engine's own data remain as they are."""
        model = self._model_of(robot)
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:], data.act[:] = self.qpos[robot], self.qvel[robot], self.act[robot]
        data.ctrl[:], data.xfrc_applied[:] = self.ctrl[robot], self.wrench[robot]
        data.mocap_pos[:], data.mocap_quat[:] = (part[robot] for part in self.mocap)
        mujoco.mj_forward(model, data)
        return contacts(model, data)

    def _begin(self, rows: slice) -> None:
        """Reads robots that were just placed on the ground; the second look makes their initial acceleration zero.

        Until the first command of a delayed robot arrives, its motors get their nominal back-EMF, and the robot coasts.
        At 0 V they would brake it hard.
        """
        self.move_obstacles(0)
        state, queue = self.state[rows], self._queue[:, rows]
        for _ in range(2):
            self._look(rows.start, rows.stop, self._period, self._held.place)
        state["lost"] = queue[...] = 0.0
        queue[..., :2] = self.robot.back_emf * state["reading"]["wheel_rates"]
        queue[..., 2] = state["servo"]["play"] = state["reading"]["steering_angle"]


class PhysicsPlant(Plant):
    """One robot through dm_control's physics API.

    Attributes:
        physics: The `CarPhysics`, for rendering and inspection.
    """

    def __init__(
        self, models: Sequence[mujoco.MjModel], robot: Robot, substeps: int, obstacles: Sequence[Obstacles] = ()
    ) -> None:
        """Takes the arguments of `build`, for one robot."""
        super().__init__(models, robot, substeps, obstacles)
        (model,) = models
        self.physics = CarPhysics.from_compiled(mjcf.clone(model))
        data = self.physics.data
        # Views of the engine's own memory, with the batch dimension in front.
        self.qpos, self.qvel, self.act, self.ctrl = data.qpos[None], data.qvel[None], data.act[None], data.ctrl[None]
        self.wrench, self.sensors = data.xfrc_applied[None], data.sensordata[None]
        self.mocap = data.mocap_pos[None], data.mocap_quat[None]
        self._hold()

    def _model_of(self, robot: int) -> mujoco.MjModel:
        return self.physics.model.ptr

    def _write(self, robot: int, model: mujoco.MjModel) -> None:
        write(self.physics.model.ptr, fields(model), self._scratch_data)

    def _clear(self, robot: int) -> None:
        mujoco.mj_resetData(self.physics.model.ptr, self.physics.data.ptr)

    def _advance(self) -> dict[int, str]:
        try:
            self.physics.step(self.substeps)
        except PhysicsError:
            pass  # raised after the steps, on a warning; `look` judges the state itself, as it does for a batch
        except mujoco.FatalError as error:
            return {0: str(error)}
        return {}


class BatchPlant(Plant):
    """Many robots on MuJoCo's batch engine.

    Robots in one world share its model, and each has its own parameters through `expand` and `set_const`. If the worlds
    differ, each robot has a model of its own, through `set_models`, which excludes `expand`.
    """

    def __init__(
        self,
        models: Sequence[mujoco.MjModel],
        robot: Robot,
        substeps: int,
        threads: int = 0,
        obstacles: Sequence[Obstacles] = (),
    ) -> None:
        """Takes the arguments of `build`."""
        super().__init__(models, robot, substeps, obstacles)
        model, size = models[0], len(models)
        quiet = mjcf.clone(model)
        if self._collision < 0:
            quiet.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_SENSOR  # nothing reads them without obstacles
        self.batch = mujoco_batch.Batch(quiet, size, threads)
        self._own: list[mujoco.MjModel] = [] if all(one is model for one in models) else list(models)
        self._changed = bool(self._own)  # whether the batch has to be told of models
        self._model = mjcf.clone(quiet)  # overwritten by `_model_of`
        self.qpos, self.qvel = self.batch.bind("qpos"), self.batch.bind("qvel")
        self.act, self.ctrl = self.batch.bind("act"), self.batch.bind("ctrl")
        self.wrench, self.sensors = self.batch.bind("xfrc_applied"), self.batch.bind("sensordata")
        self.mocap = self.batch.bind("mocap_pos"), self.batch.bind("mocap_quat")
        self._hold()
        self._fields = fields(model)
        self._expanded: set[str] = set()

    def _model_of(self, robot: int) -> mujoco.MjModel:
        return self._own[robot] if self._own else self.batch.get_model(robot, self._model)

    def _write(self, robot: int, model: mujoco.MjModel) -> None:
        if self._own:
            self._own[robot], self._changed = mjcf.clone(model), True
            return
        for name, value in fields(model).items():
            if name in self._expanded or not np.array_equal(value, self._fields[name]):
                self._expanded.add(name)
                self.batch.expand(name)[robot] = value
        self.batch.set_const(np.array([robot]))

    def _clear(self, robot: int) -> None:
        self._tell()
        self.batch.reset(np.array([robot]), stage=mujoco.mjtStage.mjSTAGE_NONE)

    def _advance(self) -> dict[int, str]:
        ids = None if self.running == self.size else np.flatnonzero(~self.stopped)
        self._tell()
        try:
            self.batch.step(ids, self.substeps)
        except mujoco_batch.SimulationError as error:
            return {int(i): self.batch.error(int(i)) for i in error.ids}
        return {}

    def _tell(self) -> None:
        """Tells the batch of the robots' own models, if they have changed."""
        if self._changed:
            self.batch.set_models(self._own)
            self._changed = False


def build(
    models: Sequence[mujoco.MjModel],
    robot: Robot,
    substeps: int,
    threads: int = 0,
    obstacles: Sequence[Obstacles] = (),
) -> Plant:
    """Builds the plant for B robots: dm_control for one, the batch engine for more.

    Args:
        models: The compiled world of each robot, with the nominal robot, one object for robots in the same world;
            different worlds have the same layout (`obstacles.layout`) and number of geoms.
        robot: The nominal robot.
        substeps: Physics steps in a control period.
        threads: Number of threads of the batch engine; 0 for all cores.
        obstacles: The obstacles in the world of each robot; none by default.
    """
    if len(models) == 1:
        return PhysicsPlant(models, robot, substeps, obstacles)
    return BatchPlant(models, robot, substeps, threads, obstacles)
