"""The sensors of the robot: wheel encoders, gyro, accelerometer and posture fixes, each with its rate and latency."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mrctl.kernel import Array, Row, Rows, kernel
from mrctl.sensing.tiers import Sensing

NOISE_BLOCK = 256  # control ticks whose noise is drawn at once
MAX_OUTLIER = 1.0  # m, largest error of an outlying fix in x and y

SENSOR = np.dtype(
    [
        ("quantum", "f8"),  # angle of one encoder count, rad; 0 for an exact encoder
        ("phase", "f8", 2),  # place within its count that each encoder has at the angle 0, in counts from 0 to 1
        ("encoder_every", "i8"),  # time from one encoder sample to the next, control periods
        ("encoder_latency", "i8"),  # age of an encoder sample at its arrival, control periods
        ("gyro_sigma", "f8"),  # standard deviation of the noise of a sample, rad/s
        ("gyro_bias", "f8"),  # bias now, rad/s
        ("gyro_step", "f8"),  # standard deviation of the change of the bias in a control period, rad/s
        ("gyro_every", "i8"),  # time from one gyro sample to the next, control periods
        ("gyro_latency", "i8"),  # age of a gyro sample at its arrival, control periods
        ("accelerometer_sigma", "f8"),  # standard deviation of the noise of a sample, m/s²
        ("accelerometer_bias", "f8", 2),  # biases now, forward and to the left, m/s²
        ("accelerometer_step", "f8"),  # standard deviation of the change of a bias in a control period, m/s²
        ("accelerometer_every", "i8"),  # time from one accelerometer sample to the next, control periods
        ("accelerometer_latency", "i8"),  # age of an accelerometer sample at its arrival, control periods
        ("fix_sigma", "f8", 2),  # standard deviations of the noise of position in m and heading in rad
        ("fix_every", "i8"),  # time from one fix to the next, control periods
        ("fix_latency", "i8"),  # age of a fix at its arrival, control periods
        ("fix_lost", "f8"),  # share of fixes that never arrive
        ("fix_outliers", "f8"),  # share of fixes that are outliers
        ("start", "i8"),  # tick at which the run of this robot began
    ],
    align=True,
)

NOISE = np.dtype([("gyro", "f8", 2), ("accelerometer", "f8", 4), ("fix", "f8", 3), ("chance", "f8", 4)])
# Standard normal numbers of one tick: noise of the gyro and step of its bias; noise of the accelerometer's two axes and
# steps of their biases; noise of a fix. `chance` is uniform in [0, 1): loss of a fix, outlier, its errors in x and y.

RANDOM = (
    "gyro_noise", "gyro_walk", "accelerometer_noise", "accelerometer_walk", "fix_position_noise", "fix_heading_noise",
    "fix_lost", "fix_outliers",
)  # fmt: skip
"""Settings of `Sensing` with which a tick needs random numbers."""

SAMPLE = np.dtype(
    [
        ("encoder", "f8", 2),  # measured angles of the rear wheels, left and right, rad
        ("rate", "f8", 2),  # their measured rates, rad/s; of an encoder that counts, a difference quotient
        ("encoder_new", "?"),  # whether the encoders were sampled in this tick; else the last sample is repeated
        ("gyro", "f8"),  # measured θ̇, rad/s
        ("gyro_new", "?"),  # whether the gyro was sampled in this tick; else the last sample is repeated
        ("acceleration", "f8", 2),  # measured specific force, forward and to the left, m/s²
        ("fix", "f8", 3),  # measured posture, m, m, rad
        ("fix_taken", "?"),  # whether a fix was taken in this tick
        ("fix_arrives", "?"),  # whether it arrives
        ("grip", "u1", 2),  # whether the wheels grip, left and right; an estimator writes it
        ("doubt", "f8"),  # standard deviation that the wheel radii' relative errors have at least; likewise
        ("twist", "f8", 2),  # V in m/s and θ̇ in rad/s of this tick, as they are estimated by now; likewise
        ("command", "f8", 2),  # derivative of the commanded twist that was computed in this tick, m/s² and rad/s²
    ],
    align=True,
)


@kernel
def sample(tick: int, true: Row, noise: Row, period: float, s: Row, last: Row, now: Row) -> None:
    """Samples the sensors of one robot.

        encoder   q ⌊φ/q + phase⌋ with the angle q of one count, so that the error is bounded in angle
        gyro      θ̇ + b + n,    b ← b + w          accelerometer likewise
        fix       (x, y, θ) + n; an outlier is up to 1 m off in x and in y

    Args:
        tick: Control tick.
        true: The robot, a record of `PLANT`.
        noise: Random numbers of the tick, a record of `NOISE`.
        period: Control period in s.
        s: In and out: its sensors, a record of `SENSOR`.
        last: Samples of the last tick, a record of `SAMPLE`.
        now: Out: samples of this tick.
    """
    since = tick - s.start
    reading = true.reading
    now.encoder_new = since % s.encoder_every == 0
    for k in range(2):
        if not now.encoder_new:
            now.encoder[k], now.rate[k] = last.encoder[k], last.rate[k]
        elif s.quantum == 0:
            now.encoder[k], now.rate[k] = true.wheel_angles[k], reading.wheel_rates[k]
        else:
            now.encoder[k] = s.quantum * np.floor(true.wheel_angles[k] / s.quantum + s.phase[k])
            gap, before = period * s.encoder_every, last.encoder[k]
            if since == 0:  # the robot has been rolling
                earlier = true.wheel_angles[k] - gap * reading.wheel_rates[k]
                before = s.quantum * np.floor(earlier / s.quantum + s.phase[k])
            now.rate[k] = (now.encoder[k] - before) / gap
    now.gyro_new = since % s.gyro_every == 0
    s.gyro_bias += s.gyro_step * noise.gyro[1]
    now.gyro = reading.twist[1] + s.gyro_bias + s.gyro_sigma * noise.gyro[0] if now.gyro_new else last.gyro
    for k in range(2):
        s.accelerometer_bias[k] += s.accelerometer_step * noise.accelerometer[2 + k]
        force = true.specific_force[k] + s.accelerometer_bias[k] + s.accelerometer_sigma * noise.accelerometer[k]
        now.acceleration[k] = force if since % s.accelerometer_every == 0 else last.acceleration[k]
    now.fix_taken = since % s.fix_every == 0
    now.fix_arrives = now.fix_taken and noise.chance[0] >= s.fix_lost
    wrong = noise.chance[1] < s.fix_outliers
    for k in range(3):
        now.fix[k] = reading.pose[k] + s.fix_sigma[k // 2] * noise.fix[k]
        if wrong and k < 2:
            now.fix[k] += MAX_OUTLIER * (2 * noise.chance[2 + k] - 1)
    for k in range(2):
        now.grip[k], now.command[k] = 1, 0.0
    now.doubt = 0.0


@kernel
def sample_all(tick: int, plant: Rows, noise: Rows, period: float, sensors: Rows, ring: Rows) -> None:
    """Samples the sensors of all robots into the row of this tick in `ring`, `(N, B)`, with its row of `noise`."""
    now, last, errors = ring[tick % len(ring)], ring[(tick - 1) % len(ring)], noise[tick % len(noise)]
    for i in range(len(sensors)):
        sample(tick, plant[i], errors[i], period, sensors[i], last[i], now[i])


@kernel
def command_all(tick: int, derivative: Array, ring: Rows) -> None:
    """Stores the derivatives of the commanded twists that were computed in a tick, in m/s² and rad/s², `(B, 2)`."""
    computed = ring[tick % len(ring)]
    for i in range(len(computed)):
        computed[i].command[0], computed[i].command[1] = derivative[i, 0], derivative[i, 1]


class Sensors:
    """The sensors of B robots.

    Attributes:
        period: Control period in s.
        noise: Random numbers of a block of ticks, records of `NOISE`, `(NOISE_BLOCK, B)`; `(1, B)` zeros if none are
            needed.
        ring: Samples of the last N ticks, records of `SAMPLE`, `(N, B)`; row tick % N holds those of a tick.
        sensors: Constants and biases of each robot's sensors, a record of `SENSOR`, `(B,)`.
    """

    def __init__(self, sensing: Sequence[Sensing], seeds: Sequence[int], period: float) -> None:
        """Builds the sensors.

        Args:
            sensing: Sensing of each robot.
            seeds: Seed of the noise of each robot.
            period: Control period in s.
        """
        size = len(sensing)
        self.period, self._sensing = period, list(sensing)
        self.sensors = np.zeros(size, SENSOR)
        waits = [
            max(s.periods(f"{name}_latency", period) for name in ("encoder", "gyro", "accelerometer", "fix"))
            + s.periods("delay", period)
            + 2 * s.periods("encoder_rate", period)
            for s in sensing
        ]
        self.ring = np.zeros((max(waits), size), SAMPLE)
        self._noisy = [any(s[name] for name in RANDOM) for s in sensing]
        self.noise = np.zeros((NOISE_BLOCK if any(self._noisy) else 1, size), NOISE)
        self._random: list[dict[str, np.random.Generator]] = [{} for _ in range(size)]
        for row, seed in enumerate(seeds):
            self.restart(row, seed, 0)

    def restart(self, row: int, seed: int, tick: int) -> None:
        """Switches the sensors of one robot on: draws phases and biases, and starts their clocks.

        Args:
            row: Index of the robot.
            seed: Seed of its noise.
            tick: The coming control tick.
        """
        sensing, period, s = self._sensing[row], self.period, self.sensors[row]
        random = {name: np.random.default_rng([seed, 2, k]) for k, name in enumerate(("encoder", *(NOISE.names or ())))}
        for name in ("encoder", "gyro", "accelerometer", "fix"):
            s[f"{name}_every"] = sensing.periods(f"{name}_rate", period)
            s[f"{name}_latency"] = sensing.periods(f"{name}_latency", period)
        counts = sensing["encoder_counts"]
        s["quantum"], s["phase"] = 2 * np.pi / counts if counts else 0.0, random["encoder"].uniform(size=2)
        for name in ("gyro", "accelerometer"):
            # Its noise is that of a mean since the last sample, N/√duration; the motion is that of the tick alone.
            s[f"{name}_sigma"] = sensing[f"{name}_noise"] / np.sqrt(period * s[f"{name}_every"])
            s[f"{name}_step"] = sensing[f"{name}_walk"] * np.sqrt(period)
            axes = random[name].standard_normal(2)
            s[f"{name}_bias"] = sensing[f"{name}_bias"] * (axes[0] if name == "gyro" else axes)
        s["fix_sigma"] = sensing["fix_position_noise"], sensing["fix_heading_noise"]
        s["fix_lost"], s["fix_outliers"], s["start"] = sensing["fix_lost"], sensing["fix_outliers"], tick
        self._random[row] = random
        self.ring[:, row] = np.zeros(1, SAMPLE)
        if tick % NOISE_BLOCK:
            self._draw(row, tick % NOISE_BLOCK, tick)

    def _draw(self, row: int, first: int, tick: int) -> None:
        """Draws the noise of one robot for the rest of a block, from index `first` on, which belongs to `tick`."""
        if not self._noisy[row]:
            return
        s, random, noise = self.sensors[row], self._random[row], self.noise
        count = NOISE_BLOCK - first
        for name in ("gyro", "accelerometer"):
            noise[name][first:, row] = random[name].standard_normal((count, noise[name].shape[-1]))
        taken = first + (-(tick - s["start"]) % s["fix_every"]) + s["fix_every"] * np.arange(count)
        taken = taken[taken < NOISE_BLOCK]
        noise["fix"][taken, row] = random["fix"].standard_normal((len(taken), 3))
        noise["chance"][taken, row] = random["chance"].uniform(size=(len(taken), 4))

    def measure(self, tick: int, plant: Rows) -> None:
        """Samples the sensors of all robots in a control tick.

        Args:
            tick: The control tick.
            plant: Record of `PLANT` of each robot, `(B,)`.
        """
        self.draw(tick)
        sample_all.compiled(tick, plant, self.noise, self.period, self.sensors, self.ring)

    def draw(self, tick: int) -> None:
        """Draws the noise of a block of ticks, if the tick is the first one of it."""
        if tick % NOISE_BLOCK == 0:
            for row in range(len(self.sensors)):
                self._draw(row, 0, tick)

    def command(self, tick: int, derivative: Array) -> None:
        """Stores the derivative of the commanded twist that was computed in a tick, in m/s² and rad/s², `(B, 2)`."""
        command_all.compiled(tick, derivative, self.ring)
