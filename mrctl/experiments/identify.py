"""`mrctl identify`: estimates the constants of equation (3) from voltages, currents, encoders and gyro of two drives.

Robots drive open loop under periodic multisines, always forwards, so that Coulomb friction is constant. They drive
straight on first, then in turns with the front wheel held straight and without grip, as on a sheet of ice, because a
front wheel that steers or trails makes a part of the torque that equation (3) attributes to the motors. The equations

    motors, straight on      φ̇ = U/(N k) − i R_a/(N k)
    straight on              V̇ = [ (N k/r) (i_d + i_s) − F_c ] / M_e,    V = r (φ̇_d + φ̇_s)/2
    turning                  θ̈ = [ (N k D/r) (i_d − i_s) − m c V θ̇ ] / J_e + constant

with F_c = 2 τ_loss/r + F_roll are fitted by least squares to the lowest harmonics of the signals. (The known viscous
friction of a robot that has it is taken from the forces first.) An encoder's error is
bounded in its angle φ and that of a gyro is white in θ̇, so a spectral line at the frequency ω is weighted by 1/ω for
each derivative that was taken of the sample, which amounts to integrating the equation as often. The noisy signal
stands alone on the left, where noise does not bias the estimate: when the robot turns, the gyro gives θ̈, and the
encoders give V θ̇. The gyro's bias is the constant, and its drift is removed as a linear trend.

The motor driver is assumed to measure voltages and currents exactly, and the time of every sample to be known. The
currents give torques, so masses are identified in kg; without current sensors only ratios such as M_e/(N k) would be.

Each robot drives its own signal with its own sensors and gives one estimate. The interval around the mean of all
estimates adds in quadrature Student's t interval, for sensors and signals, and 1.5 % for effects that equation (3)
leaves out and repetition does not show: creep and sinkage of the tyres, and the engine's time step. A constant counts
as identifiable if half of its interval is at most a tenth of its value.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from tqdm import trange

from mrctl.checks.open_loop import loss_voltage, on_skid
from mrctl.experiments.tables import json_text, machine, markdown
from mrctl.kernel import Array
from mrctl.physics import mjcf
from mrctl.physics.elements import is_level
from mrctl.physics.plant import Plant, build
from mrctl.record import InputError
from mrctl.results.dataset import versions
from mrctl.sensing.sensors import Sensors
from mrctl.sensing.tiers import LAB, Sensing
from mrctl.theory.perturbation import Perturbation
from mrctl.theory.robot import CAR, Robot, RobotFile

Lines = NDArray[np.complex128]

PERIOD = 10.0  # s of the excitation
PERIODS = 2  # periods that are averaged, after one in which the robot settles
REPEATS = 8  # number of robots, each under its own signal
HOLD_TIME = 0.005  # s, for which a voltage is held
# physics steps per time constant; the first-order engine adds damping times half a step to the mass
STEPS_PER_TIME_CONSTANT = 100
MODEL_ERROR = 0.015  # relative error that effects outside equation (3) may cause
MAX_HALF_INTERVAL = 0.1  # largest half of the interval of an identifiable constant, as a share of its value; chosen
NOMINAL = Perturbation()
NOT_IDENTIFIABLE = """\
For c, the mass m is taken from a scale, and the viscous friction of the wheels is that of their file. These drives
do not identify m, J_w and J_m, which enter only M_e and J_e; I_0, gear loss and rolling loss, which enter only F_c; N
and k_M, which enter only N k (k_E equals k_M in SI units)."""


class Constant(NamedTuple):
    """An identified constant: its estimate, 95 % interval and true value."""

    name: str
    unit: str
    estimate: float
    low: float
    high: float
    true: float

    @property
    def error(self) -> float:
        """Relative error of the estimate; NaN where the true value is 0."""
        return self.estimate / self.true - 1 if self.true else np.nan

    @property
    def identifiable(self) -> bool:
        """Whether the interval is narrow enough for the constant to be identifiable."""
        return self.high - self.low <= 2 * MAX_HALF_INTERVAL * abs(self.estimate)


class Drive(NamedTuple):
    """Measured signals of one robot: their mean and their harmonics 1 to K, as complex amplitudes.

    Signals are sampled at the ends of ticks.
    """

    wheels: Lines
    """Rates φ̇ of the wheels, left and right, from the encoders, in rad/s, `(K + 1, 2)`."""
    turn: Lines
    """θ̇ of the gyro in rad/s, with its bias but without a linear drift, `(K + 1,)`."""
    voltage: Lines
    """Voltages at the terminals, left and right, in V, constant within a tick, `(K + 1, 2)`."""
    current: Lines
    """Currents, left and right, in A, `(K + 1, 2)`."""


def run(world: str, robot: RobotFile, perturbation: Perturbation, sensing: Sensing, seed: int, json: bool) -> str:
    """Runs the command: drives, identifies, and returns a table or JSON.

    Args:
        world: World to drive in; its ground must be level.
        robot: Robot whose constants are identified.
        perturbation: How the plant differs from its model.
        sensing: Encoders, gyro and motor driver.
        seed: Seed of signals and sensors.
        json: Whether to return JSON instead of a table.

    Raises:
        InputError: The robot cannot drive there, or the sensors are too slow.
    """
    found = identify(world, robot, perturbation, sensing, seed)
    if json:
        rows: list[dict[str, Any]] = [c._asdict() | {"error": c.error, "identifiable": c.identifiable} for c in found]
        source = {"versions": versions(), "machine": machine(), "world": world, "robot": robot.model_dump()}
        source |= {"perturbation": perturbation.model_dump(mode="json"), "sensing": sensing.model_dump(mode="json")}
        return json_text(source | {"seed": seed, "constants": rows})
    return text(found)


def text(constants: Sequence[Constant]) -> str:
    """Returns the constants as a Markdown table, and which others such drives do not show."""
    header = ["constant", "unit", "estimate", "95 % interval", "true", "error", "identifiable"]
    cells = []
    for c in constants:
        estimate, low, high, true = (f"{x:.4g}" for x in (c.estimate, c.low, c.high, c.true))
        identifiable = "yes" if c.identifiable else "no"
        error = f"{100 * c.error:+.2f} %" if c.true else "–"
        cells.append([c.name, c.unit, estimate, f"{low} to {high}", true, error, identifiable])
    parts = [markdown(header, cells), NOT_IDENTIFIABLE]
    if vague := [c.name for c in constants if not c.identifiable]:
        parts.insert(1, f"These sensors cannot tell within {100 * MAX_HALF_INTERVAL:g} %: {', '.join(vague)}.")
    return "\n\n".join(parts)


def identify(
    world: str = "flat",
    robot: RobotFile = CAR,
    perturbation: Perturbation = NOMINAL,
    sensing: Sensing = LAB,
    seed: int = 0,
) -> list[Constant]:
    """Identifies those constants of equation (3) that the drives show.

    Args:
        world: World to drive in; its ground must be level.
        robot: Robot whose constants are identified.
        perturbation: How the plant differs from its model.
        sensing: Encoders, gyro and motor driver; delays, accelerometer, fixes and the estimator play no part.
        seed: Seed of signals and sensors.

    Raises:
        InputError: The ground is not level, the robot fails during a drive, or the encoders or the gyro are too slow
            for the signals.
    """
    if seed < 0:
        raise InputError(f"seed: {seed} is negative")
    own = mjcf.arrangement(robot)
    steering = "rigid" if own == "compliant" else own
    model, nominal = mjcf.build(world, steering, robot=robot)
    if perturbation.slope or not is_level(model):
        raise InputError(f"{'perturbation.slope' if perturbation.slope else 'world'}: the ground must be level")
    tau = min(nominal.velocity_time_constant, nominal.rotation_time_constant)
    substeps = max(5, int(np.ceil(STEPS_PER_TIME_CONSTANT * HOLD_TIME / tau)))
    model = mjcf.load(world, steering, HOLD_TIME / substeps, robot)
    plants = [build([one] * REPEATS, nominal, substeps, threads=1) for one in (model, on_skid(model))]
    for plant in plants:
        for row in range(REPEATS):
            delay = round(perturbation.control_delay / HOLD_TIME)
            plant.perturb(row, perturbation, delay, sensing.driver, sensing.servo)
    random = np.random.default_rng([seed, 3])
    ahead, turning = (excite(plant, nominal, sensing, random, k == 1) for k, plant in enumerate(plants))
    rows, true = [], plants[0].truth[0]
    for straight, turn in zip(ahead, turning, strict=True):
        found = drive_constants(straight, nominal)
        found |= turn_constants(turn, found["R_a"], found["N k"], nominal)
        rows.append(found | {"c": found["m c"] / true.mass})
    facts = {
        "R_a": ("Ω", true.resistance),
        "N k": ("N·m/A", true.back_emf),
        "M_e": ("kg", true.effective_mass),
        "F_c": ("N", 2 * true.drive_loss / true.wheel_radius + true.rolling_force),
        "J_e": ("kg·m²", true.effective_inertia),
        "m c": ("kg·m", true.mass * true.com_offset),
        "c": ("m", true.com_offset),
    }
    return [_constant(name, np.array([row[name] for row in rows]), *fact) for name, fact in facts.items()]


def _constant(name: str, values: Array, unit: str, true: float) -> Constant:
    mean = float(values.mean())
    reach = float(np.hypot(scatter(values), MODEL_ERROR * mean))
    return Constant(name, unit, mean, mean - reach, mean + reach, true)


def scatter(values: Array) -> Array:
    """Returns half of the 95 % interval of the mean along the last axis, by Student's t."""
    count = values.shape[-1]
    return stats.t.ppf(0.975, count - 1) * values.std(ddof=1, axis=-1) / np.sqrt(count)


def _bandwidth(robot: Robot) -> float:
    """Returns the highest frequency of the excitation in Hz: twice the corner of the slower channel, from 1 to 4 Hz."""
    slower = max(robot.velocity_time_constant, robot.rotation_time_constant)
    return float(np.clip(2 / (2 * np.pi * slower), 1.0, 4.0))


def signals(robot: Robot, random: np.random.Generator, turns: bool) -> Array:
    """Draws one period of U_Σ and U_Δ in V, `(N, 2)`, with random phases and the largest amplitudes that are safe.

    The common channel has the even harmonics, the differential one the odd ones. As predicted for the nominal robot, V
    differs from its mean, half of its limit, by at most half of this mean; θ̇ stays within half of its limit and low
    enough that both wheels turn forwards; accelerations stay within two thirds of their limits.
    """
    samples = round(PERIOD / HOLD_TIME)
    lines = np.arange(1, round(PERIOD * _bandwidth(robot)) + 1)
    speed = robot.max_speed / 2
    turn = min(robot.max_rotation / 2, speed / 4 / robot.half_track)
    channels = (
        (lines[1::2], robot.velocity_gain, robot.velocity_time_constant, speed / 2, robot.max_acceleration),
        (lines[::2], robot.rotation_gain, robot.rotation_time_constant, turn, robot.max_rotation_acceleration),
    )
    omega = 2 * np.pi / PERIOD * np.arange(samples // 2 + 1)
    found = np.zeros((samples, 2))
    for k, (harmonics, gain, tau, reach, acceleration) in enumerate(channels[: 1 + turns]):
        spectrum = np.zeros(len(omega), complex)
        spectrum[harmonics] = np.exp(2j * np.pi * random.random(len(harmonics)))
        answer = spectrum * gain / (1 + 1j * omega * tau)
        peaks = [np.abs(np.fft.irfft(part, samples)).max() for part in (answer, 1j * omega * answer)]
        found[:, k] = np.fft.irfft(spectrum, samples) * min(reach / peaks[0], acceleration / 1.5 / peaks[1])
    return found + [speed / robot.velocity_gain + loss_voltage(robot), 0.0]


def excite(plant: Plant, robot: Robot, sensing: Sensing, random: np.random.Generator, turns: bool) -> list[Drive]:
    """Drives `REPEATS` robots open loop; returns the measured signals of each.

    Raises:
        InputError: A robot fails, or encoders or gyro are too slow for the signals.
    """
    period = np.stack([signals(robot, random, turns) for _ in range(REPEATS)], axis=1)  # (N, B, 2)
    highest, ticks = 2 * round(_bandwidth(robot) * PERIOD), (1 + PERIODS) * len(period)
    try:
        sensing.check(HOLD_TIME, ticks * HOLD_TIME)
    except ValueError as error:
        raise InputError(str(error)) from None
    for name in ("encoder_rate", "gyro_rate"):
        if (rate := 1 / (HOLD_TIME * sensing.periods(name, HOLD_TIME))) <= 2 * highest / PERIOD:
            raise InputError(f"sensing.{name}: {rate:g} Hz, but the signals need more than {2 * highest / PERIOD:g} Hz")
    plant.reset(np.zeros((REPEATS, 3)), np.tile([robot.max_speed / 2, 0.0], (REPEATS, 1)))
    sensors = Sensors([sensing] * REPEATS, random.integers(2**31, size=REPEATS).tolist(), HOLD_TIME)
    samples = np.zeros((ticks + 1, REPEATS), sensors.ring.dtype)
    voltage, current = np.zeros((2, ticks + 1, REPEATS, 2))
    command = np.zeros((REPEATS, 4))
    for k in trange(ticks + 1, unit="tick", unit_scale=True, desc="turning" if turns else "straight on"):
        sensors.measure(k, plant.state)
        samples[k] = sensors.ring[k % len(sensors.ring)]
        voltage[k], current[k] = plant.applied, plant.current  # of the tick that ends
        common, differential = period[k % len(period)].T
        command[:, 0], command[:, 1] = common - differential, common + differential
        plant.step(command)
    if plant.stopped.any():
        raise InputError(f"identify: a robot failed during the drive: {next(filter(None, plant.failure))}")

    time = HOLD_TIME * np.arange(ticks + 1)[-PERIODS * len(period) :]

    def seen(values: Array, new: NDArray[np.bool] | slice = slice(None)) -> tuple[Lines, Array]:
        return lines(time[new], values[-len(time) :][new], highest)

    fresh = {name: samples[f"{name}_new"][-len(time) :, 0] for name in ("encoder", "gyro")}
    wheels = derivative(*seen(samples["encoder"], fresh["encoder"]))
    measured = wheels, seen(samples["gyro"], fresh["gyro"])[0], seen(voltage)[0], seen(current)[0]
    return [Drive(*(values[:, row] for values in measured)) for row in range(REPEATS)]


def lines(time: NDArray, values: NDArray, highest: int) -> tuple[Lines, Array]:
    """Fits mean and harmonics to signals that are periodic but for a linear trend, by least squares.

    Args:
        time: Times of the samples in s, over whole periods, `(n,)`.
        values: Samples, `(n, …)`.
        highest: Highest harmonic K, below half of the number of samples in a period.

    Returns:
        Mean and complex amplitudes c of c e^{jωt} + conjugate, `(K + 1, …)`, and the trend per second, `(…)`.
    """
    angle = 2 * np.pi / PERIOD * np.outer(time, np.arange(1, highest + 1))
    slope = (time - time.mean()) / PERIOD
    basis = np.column_stack([np.ones_like(time), slope, 2 * np.cos(angle), -2 * np.sin(angle)])
    # The columns are nearly orthogonal, so that the normal equations lose nothing.
    found = np.linalg.solve(basis.T @ basis, basis.T @ values.reshape(len(time), -1))
    found = found.reshape(-1, *values.shape[1:])
    mean, trend, real, imaginary = found[:1], found[1] / PERIOD, *np.split(found[2:], 2)
    return np.asarray(np.concatenate([mean + 0j, real + 1j * imaginary]), complex), np.asarray(trend, float)


def derivative(of: Lines, trend: Array | float = 0.0) -> Lines:
    """Returns the lines of the derivative of a signal with these lines and this trend per second."""
    found = _shaped(1j * frequencies(len(of)), of) * of
    found[0] = trend
    return found


def frequencies(count: int) -> Array:
    """Returns the angular frequencies of the mean and the harmonics in rad/s, `(count,)`."""
    return np.asarray(2 * np.pi / PERIOD * np.arange(count), float)


def _shaped(factors: NDArray, like: Lines) -> NDArray:
    return factors.reshape(-1, *[1] * (like.ndim - 1))


def average(of: Lines) -> Lines:
    """Returns the lines of a signal's mean over each tick, from its lines at the ends of ticks."""
    shift = 1j * HOLD_TIME * frequencies(len(of))[1:]
    return _shaped(np.append(1.0, (1 - np.exp(-shift)) / shift), of) * of


def product(first: Lines, second: Lines) -> Lines:
    """Returns the lines of the product of two signals up to harmonic K, `(K + 1,)`."""
    count = 4 * len(first)
    values = [np.fft.irfft(one, count) * count for one in (first, second)]
    return np.fft.rfft(values[0] * values[1])[: len(first)] / count


def drive_constants(drive: Drive, robot: Robot) -> dict[str, float]:
    """Estimates R_a, N k, M_e and F_c from a drive straight on.

    Args:
        drive: Measured signals.
        robot: Robot whose wheel radius and viscous friction are taken as known.
    """
    omega = frequencies(len(drive.turn))
    omega[0] = omega[1]  # for the weight of the means; both motors are alike
    speed_per_volt, fall = _fit(omega**-1, drive.wheels.T, drive.voltage.T, -drive.current.T)
    resistance, constant = fall / speed_per_volt, 1 / speed_per_volt
    v = robot.wheel_radius * drive.wheels.mean(axis=1)
    force = constant / robot.wheel_radius * _mean_current(drive, resistance).sum(axis=1)
    force -= 2 * robot.wheel_damping / robot.wheel_radius**2 * average(v)
    loss = force[0].real  # the motion is periodic, so that V̇ is zero in the mean
    (lighter,) = _fit(omega[1:] ** -2, average(derivative(v))[1:], force[1:])
    return {"R_a": float(resistance), "N k": float(constant), "M_e": float(1 / lighter), "F_c": float(loss)}


def turn_constants(drive: Drive, resistance: float, constant: float, robot: Robot) -> dict[str, float]:
    """Estimates J_e and m c from a drive in turns.

    Args:
        drive: Measured signals.
        resistance: R_a in Ω.
        constant: N k in N·m/A.
        robot: Robot whose wheel radius, half track and viscous friction are taken as known.
    """
    current = _mean_current(drive, resistance)
    torque = constant * robot.half_track / robot.wheel_radius * (current[:, 1] - current[:, 0])
    left, right = robot.wheel_radius * drive.wheels.T
    torque -= 2 * robot.wheel_damping * (robot.half_track / robot.wheel_radius) ** 2 * average(drive.turn)
    bend = average(product((left + right) / 2, (right - left) / (2 * robot.half_track)))
    nimbler, drag = _fit(1 / frequencies(len(bend))[1:], average(derivative(drive.turn))[1:], torque[1:], -bend[1:])
    return {"J_e": float(1 / nimbler), "m c": float(drag / nimbler)}


def _mean_current(drive: Drive, resistance: float) -> Lines:
    """Returns lines of the mean current of each tick, which jumps with the voltage and then changes linearly."""
    before = np.exp(-1j * HOLD_TIME * frequencies(len(drive.current)))[:, None]
    jump = (1 - before) * drive.voltage / resistance
    return (before * drive.current + jump + drive.current) / 2


def _fit(weight: Array, left: Lines, *right: Lines) -> Array:
    """Returns real least-squares coefficients of lines `(…, n)` with weights `(n,)`."""

    def real(of: Lines) -> Array:
        return (of * weight).ravel().view(float)

    found = np.linalg.lstsq(np.stack([real(r) for r in right], axis=1), real(left), rcond=None)[0]
    return np.asarray(found, float)
