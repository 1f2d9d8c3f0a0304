"""Estimators of posture and twist: the truth, odometry, an extended Kalman filter, or the user's.

An estimator receives the samples of the sensors and estimates posture and twist at a control tick. `predict` then
predicts the estimate to the time at which the voltage that is computed in that tick reaches the motors; the controllers
receive this prediction.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mrctl.kernel import Array, Held, Kernel, Row, Rows, held, kernel
from mrctl.sensing.ekf import (
    DRIFT_SIGMAS,
    EKF,
    HELD_NOISE,
    INCLINE_WALK,
    INNOVATION_FIXES,
    START_OFFSET,
    START_RADIUS,
    START_TWIST,
    ekf,
)
from mrctl.sensing.localisation import Localiser
from mrctl.sensing.prediction import SEEN, predict, settle, wrapped
from mrctl.sensing.scanner import Scanner
from mrctl.sensing.sensors import Sensors, command_all, sample_all
from mrctl.sensing.slip import slip_ratio
from mrctl.sensing.tiers import Sensing
from mrctl.theory.obstacles import Obstacles
from mrctl.theory.robot import Robot, Tyres

GEOMETRY = np.dtype(
    [
        ("wheel_radius", "f8"),  # r in m
        ("half_track", "f8"),  # D in m
        ("imu_x", "f8"),  # distance of the accelerometer ahead of the rear axle in m
        ("skew", "f8"),  # time in s by which velocities lag behind positions, see `Estimator`
        ("lag", "f8"),  # slip of the tyres over their acceleration in s, see `Tyres`
        ("load", "f8"),  # growth of the left wheel's radius over the specific force to the left in s²/m, see `Tyres`
    ],
    align=True,
)
SAMPLED_MOTION = np.dtype(
    [
        ("mean", "f8", 5),  # x, y in m, θ in rad, V in m/s, θ̇ in rad/s, when the last samples were taken
        ("answer", "f8", 5),  # estimate of a user's estimator, in the same order
        ("valid", "?"),  # whether all five numbers of `answer` are finite
    ],
    align=True,
)


@kernel
def truth(
    tick: int, true: Row, ring: Rows, i: int, sensor: Row, geometry: Row, period: float, memory: Row, s: Row
) -> None:
    """The estimator `truth`: the true posture and twist.

    Args:
        tick: Control tick.
        true: The robot, a record of `PLANT`.
        ring: Samples and commands, as in `Sensors`, `(N, B)`.
        i: Index of the robot.
        sensor: Its record of `SENSOR`.
        geometry: A record of `GEOMETRY`.
        period: Control period in s.
        memory: In and out: state of the estimator for this robot.
        s: In and out: its record of `SEEN`, of which an estimator writes `estimate` and `variance`. It also writes the
            `twist` of the tick at which its samples were taken to `ring`.
    """
    for k in range(3):
        s.estimate[k] = true.reading.pose[k]
    s.estimate[3], s.estimate[4] = true.reading.twist[0], true.reading.twist[1]
    settle(s.estimate, tick, ring, i)


@kernel
def reckon(tick: int, ring: Rows, i: int, geometry: Row, period: float, m: Array, s: Row) -> None:
    """Dead reckoning from the distance by the encoders and the heading by the gyro.

        Δs = r (Δφ_l + Δφ_r)/2,    Δθ = T (ω_k + ω_{k−1})/2,    V = r (φ̇_l + φ̇_r)/2

    The heading in the middle of the period is the direction of Δs.

    Args:
        tick: Control tick.
        ring: Samples and commands, as in `Sensors`, `(N, B)`.
        i: Index of the robot.
        geometry: A record of `GEOMETRY`.
        period: Control period in s.
        m: In and out: x, y, θ, V and θ̇ when the samples were taken, in m, m, rad, m/s and rad/s, `(5,)`.
        s: In and out: a record of `SEEN`, whose `estimate` is the result.
    """
    now = tick - s.age
    if now > s.start:
        this, last = ring[now % len(ring), i], ring[(now - 1) % len(ring), i]
        way = geometry.wheel_radius * (this.encoder[0] - last.encoder[0] + this.encoder[1] - last.encoder[1]) / 2
        turn = period * (this.gyro + last.gyro) / 2
        m[0] += way * np.cos(m[2] + turn / 2)
        m[1] += way * np.sin(m[2] + turn / 2)
        m[2] += turn
        m[3], m[4] = geometry.wheel_radius * (this.rate[0] + this.rate[1]) / 2, this.gyro
    predict(m, max(now, s.start), tick, ring, i, period, s)
    s.estimate[0], s.estimate[1], s.estimate[2] = s.pose[0], s.pose[1], wrapped(s.pose[2])
    s.estimate[3], s.estimate[4] = s.twist[0], s.twist[1]


@kernel
def odometry(
    tick: int, true: Row, ring: Rows, i: int, sensor: Row, geometry: Row, period: float, memory: Row, s: Row
) -> None:
    """The estimator `odometry`: dead reckoning without any correction; the arguments are those of `truth`."""
    reckon(tick, ring, i, geometry, period, memory.mean, s)
    now = tick - s.age
    settle(memory.mean, now, ring, i)
    if sensor.quantum > 0 and ring[now % len(ring), i].encoder_new:  # V is a mean since the last sample
        for t in range(now + 1 - sensor.encoder_every, now):
            ring[t % len(ring), i].twist[0] = memory.mean[3]


@kernel
def user(
    tick: int, true: Row, ring: Rows, i: int, sensor: Row, geometry: Row, period: float, memory: Row, s: Row
) -> None:
    """The estimate of a user's estimator, or odometry from its last valid one; the arguments are those of `truth`."""
    reckon(tick, ring, i, geometry, period, memory.mean, s)
    if memory.valid:
        for k in range(5):  # the mean is as old as the samples, so that odometry can go on from it
            memory.mean[k] += memory.answer[k] - s.estimate[k]
            s.estimate[k] = memory.answer[k]
        s.estimate[2] = wrapped(s.estimate[2])
        settle(s.estimate, tick, ring, i)
    else:
        settle(memory.mean, tick - s.age, ring, i)


@kernel
def receive(tick: int, true: Row, ring: Rows, i: int, sensor: Row, geometry: Row, s: Row) -> None:
    """Writes to the record of `SEEN` what has arrived from the sensors; the arguments are those of `truth`."""
    wheels = ring[max(s.start, tick - sensor.encoder_latency) % len(ring), i]
    force = ring[max(s.start, tick - sensor.accelerometer_latency) % len(ring), i]
    s.gyro = ring[max(s.start, tick - sensor.gyro_latency) % len(ring), i].gyro
    for k in range(2):
        s.encoder[k], s.acceleration[k] = wheels.encoder[k], force.acceleration[k]
        s.lost[k] = true.lost[k]
        s.wheel_speeds[k] = geometry.wheel_radius * wheels.rate[k]
    taken = ring[(tick - sensor.fix_latency) % len(ring), i]
    arrives = taken.fix_arrives and tick - sensor.fix_latency >= s.start
    for k in range(3):
        s.fix[k] = taken.fix[k] if arrives else np.nan


@kernel
def receive_all(tick: int, plant: Rows, ring: Rows, sensors: Rows, geometry: Row, seen: Rows) -> None:
    """Calls `receive` for all robots."""
    for i in range(len(seen)):
        receive(tick, plant[i], ring, i, sensors[i], geometry, seen[i])


@kernel
def find_slip(tick: int, ring: Rows, i: int, sensor: Row, geometry: Row, period: float, s: Row) -> None:
    """Updates the slip ratio in the record of `SEEN` from the last tick whose encoder samples and twist are known.

    Encoders of now and a twist of then would differ by an acceleration, which is no slip. The rate of an encoder that
    counts is the mean since its last sample, and is compared with the mean twist. The arguments are those of `truth`.
    """
    known = tick - max(s.age, sensor.encoder_latency)
    if known >= s.start:
        taken = known - (known - s.start) % sensor.encoder_every  # when the encoders were sampled
        first = max(s.start, taken + 1 - sensor.encoder_every) if sensor.quantum > 0 else taken
        v, omega = 0.0, 0.0
        for t in range(first, taken + 1):
            then = ring[t % len(ring), i].twist
            v += then[0] / (taken + 1 - first)
            omega += then[1] / (taken + 1 - first)
        rates, r, D = ring[taken % len(ring), i].rate, geometry.wheel_radius, geometry.half_track
        s.slip = slip_ratio(rates, v, omega, r, D, period, s.slip)


observe = truth  # the estimator of `estimate`, which `Kernel.calling` replaces


@kernel
def estimate(
    tick: int, plant: Rows, ring: Rows, sensors: Rows, geometry: Row, period: float, memory: Rows, seen: Rows
) -> None:
    """Estimates posture and twist of all robots with `observe`, and predicts them to the moment when the voltage acts.

    Args:
        tick: Control tick.
        plant: Record of `PLANT` of each robot; only the estimator `truth` reads its motion, and the loss that the
            driver reports is copied.
        ring: Samples and commands, as in `Sensors`, `(N, B)`.
        sensors: Record of `SENSOR` of each robot.
        geometry: As for `truth`.
        period: Control period in s.
        memory: State of the estimator for each robot.
        seen: Out: record of `SEEN` of each robot.
    """
    for i in range(len(seen)):
        s, sensor = seen[i], sensors[i]
        receive(tick, plant[i], ring, i, sensor, geometry, s)
        observe(tick, plant[i], ring, i, sensor, geometry, period, memory[i], s)
        predict(s.estimate, tick, tick + s.delay, ring, i, period, s)
        find_slip(tick, ring, i, sensor, geometry, period, s)


@kernel
def sense(tick: int, plant: Rows, derivative: Array, period: float, place: int) -> None:
    """Stores the commands of the last tick, samples the sensors and estimates, for all robots.

    Args:
        tick: Control tick.
        plant: Record of `PLANT` of each robot.
        derivative: Derivative of the twist that was commanded in the last tick, in m/s² and rad/s², `(B, 2)`.
        period: Control period in s.
        place: Address of the other arrays that `sample_all` and `estimate` take (see `Held`).
    """
    noise, ring, sensors, geometry, memory, seen = held(place)
    command_all(tick - 1, derivative, ring)
    sample_all(tick, plant, noise, period, sensors, ring)
    estimate(tick, plant, ring, sensors, geometry[0], period, memory, seen)


ESTIMATORS: dict[str, tuple[Kernel, np.dtype]] = {
    "truth": (truth, SAMPLED_MOTION),
    "odometry": (odometry, SAMPLED_MOTION),
    "ekf": (ekf, EKF),
    "user": (user, SAMPLED_MOTION),
}
"""Kernel and state of each estimator; `user` passes on the estimate of a user's estimator."""


class Estimator:
    """An estimator for B robots.

    Attributes:
        seen: Estimates and samples that the controllers receive, a record of `SEEN` of each robot, `(B,)`.
        memory: State of the estimator, a record of each robot, `(B,)`.
        sensors: The sensors whose samples it receives.
        scanner: The lidars, or None.
        localiser: Localisation that makes posture fixes from a lidar, or None.
    """

    def __init__(
        self,
        name: str,
        sensing: Sequence[Sensing],
        robot: Robot,
        sensors: Sensors,
        imu: Array,
        skew: float,
        tyres: Tyres,
        scanner: Scanner | None = None,
        known: Sequence[Obstacles] = (),
    ) -> None:
        """Builds the estimator.

        Args:
            name: Name of the estimator, a key of `ESTIMATORS`.
            sensing: Sensing of each robot.
            robot: The nominal robot.
            sensors: The sensors.
            imu: Position of the accelerometer in the frame of the chassis in m, `(3,)`.
            skew: Time in s by which velocities lag behind positions: half a physics step, because the engine integrates
                positions with the velocities at the end of the step.
            tyres: The tyres of the nominal robot.
            scanner: The lidars, which localisation needs; None if there are none.
            known: Obstacles on the map that the localisation of each robot uses.

        Raises:
            InputError: Localisation needs a map, and there is none, or it is too large.
        """
        law = estimate.calling(observe=ESTIMATORS[name][0])
        self._estimate = law.repeated()
        self._name, self._sensing, self.sensors = name, list(sensing), sensors
        self._geometry = np.array([(robot.wheel_radius, robot.half_track, imu[0], skew, *tyres)], GEOMETRY)
        self.seen = np.zeros(len(sensing), SEEN)
        self.memory = np.zeros(len(sensing), ESTIMATORS[name][1])
        self.scanner, self.localiser = scanner, None
        if scanner and any(s.localisation != "fixes" for s in sensing):
            self.localiser = Localiser(sensing, sensors, scanner, robot.wheel_radius, known)
        arrays = sensors.noise, sensors.ring, sensors.sensors, self._geometry, self.memory, self.seen
        self._held = Held(*arrays)
        self._sense = sense.calling(estimate=law, held=self._held.reader).repeated()
        self._compiled = scanner is None and name != "user"  # else Python comes between the samples and the estimate

    def start(self, row: int, reading: Row, seed: int, tick: int) -> None:
        """Starts the estimate of one robot from a first posture and an uncertain twist.

        Args:
            row: Index of the robot.
            reading: Its true state, a record of `READING`.
            seed: Seed of the errors of the first fix and twist.
            tick: The coming control tick.
        """
        sensing, sensor, period = self._sensing[row], self.sensors.sensors[row], self.sensors.period
        random, seen = np.random.default_rng([seed, 3]), self.seen[row]
        self.seen[row], self.memory[row] = np.zeros((), SEEN), np.zeros((), self.memory.dtype)
        seen["start"], seen["delay"] = tick, sensing.periods("delay", period)
        seen["age"] = sensing.latency(self._name, period)
        deviation = np.zeros(5)
        if self._name != "truth":
            position, heading = sensing["start_position_noise"], sensing["start_heading_noise"]
            deviation[:3] = position, position, heading
            deviation[3] = START_TWIST[0] if sensor["quantum"] else 0.0
            deviation[4] = START_TWIST[1] if sensor["gyro_sigma"] else 0.0
        memory = self.memory[row]
        memory["mean"][:5] = np.append(reading["pose"], reading["twist"]) + deviation * random.standard_normal(5)
        if self.scanner:
            self.scanner.start(row, seed, tick)
        if self.localiser:
            started = self.localiser.start(row, memory["mean"][:3], deviation[:3], seed)
            memory["mean"][:3], deviation[:3] = started
        if self._name == "ekf":
            self._start_filter(row, deviation)

    def _start_filter(self, row: int, deviation: Array) -> None:
        """Sets covariance and noise of the filter of one robot.

        Args:
            row: Index of the robot.
            deviation: Standard deviations of its first posture and twist, `(5,)`.
        """
        sensing, sensor, memory = self._sensing[row], self.sensors.sensors[row], self.memory[row]
        offset = sensing["accelerometer_bias"] ** 2 + START_OFFSET**2
        count = sensor["quantum"] ** 2 / 12
        variances = [*deviation**2, sensing["gyro_bias"] ** 2, offset, count, count, START_RADIUS**2, START_RADIUS**2]
        held = HELD_NOISE[0] if sensor["accelerometer_every"] > 1 else 0.0
        memory["acceleration_variance"] = sensor["accelerometer_sigma"] ** 2 + held**2
        memory["offset_walk"] = np.hypot(sensing["accelerometer_walk"], INCLINE_WALK)
        memory["P"][:] = np.diag(np.maximum(variances, 1e-12))
        memory["encoder_variance"], memory["gyro_variance"] = count, sensor["gyro_sigma"] ** 2
        memory["bias_variance"], memory["bias_walk"] = sensing["gyro_bias"] ** 2, sensing["gyro_walk"]
        memory["kept_tick"] = -1
        own = sensing.localisation == "particles"  # moved by encoders and gyro, so that errors of fixes last
        memory["drift_bound"] = np.inf if own else DRIFT_SIGMAS / np.sqrt(2 * INNOVATION_FIXES - 1)
        memory["fix_variance"] = np.maximum(sensor["fix_sigma"][[0, 0, 1]] ** 2, 1e-12)
        memory["inertial"], memory["grip"] = memory["mean"][3], 1

    def measure(self, tick: int, plant: Rows, derivative: Array) -> None:
        """Samples the sensors and estimates, and writes the result to `seen`.

        Args:
            tick: Control tick.
            plant: Record of `PLANT` of each robot, `(B,)`.
            derivative: Derivative of the twist that was commanded in the last tick, in m/s² and rad/s², `(B, 2)`, with
                which estimates are predicted.
        """
        sensors = self.sensors
        if self._compiled:
            sensors.draw(tick)
            self._sense(tick, plant, derivative, sensors.period, self._held.place)
        else:
            sensors.command(tick - 1, derivative)
            sensors.measure(tick, plant)
            self._locate(tick, plant)
            self.estimate(tick, plant)

    def _locate(self, tick: int, plant: Rows) -> None:
        """Scans, and makes fixes from the scans, where there are lidars."""
        if self.scanner:
            self.scanner.scan(tick, plant["reading"]["pose"], plant["stopped"])
        if self.localiser:
            self.localiser.locate(tick, self.seen["estimate"])

    def receive(self, tick: int, plant: Rows) -> None:
        """Writes what has arrived from the sensors of all robots to `seen`, which `estimate` does too."""
        sensors = self.sensors
        receive_all(tick, plant, sensors.ring, sensors.sensors, self._geometry[0], self.seen)

    def estimate(self, tick: int, plant: Rows) -> None:
        """Estimates posture and twist of all robots from what the sensors have sampled, and writes them to `seen`.

        Args:
            tick: Control tick.
            plant: Record of `PLANT` of each robot, `(B,)`.
        """
        sensors = self.sensors
        self._estimate(
            tick, plant, sensors.ring, sensors.sensors, self._geometry[0], sensors.period, self.memory, self.seen
        )
