"""`mrctl identify`: the constants of equation (3) from two drives, from voltages, currents and the measured twist.

Robots drive open loop under periodic multisines, always forwards, so that Coulomb friction is constant. They drive
straight on first, then in turns with the front wheel held straight and without grip, as on a sheet of ice, because a
front wheel that steers or trails makes a part of the torque that equation (3) attributes to the motors. The constants
are fitted by least squares to signals averaged over periods and low-pass filtered to their lowest harmonics:

    motors, straight on      ω = U/(N k) − i R_a/(N k),    ω = V/r
    straight on              V̇ = [ (N k/r) (i_d + i_s) − F_c ] / M_e
    turning                  θ̈ = [ (N k D/r) (i_d − i_s) − m c V θ̇ ] / J_e + constant

with F_c = 2 τ_loss/r + F_roll. The currents give torques, so masses are identified in kg; without current sensors only
ratios such as M_e/(N k) are. V̇ is the difference of two samples over a tick and thus its mean in between, as is the
current beside it. The noisy signal stands alone on the left, where noise does not bias the estimate.

Each robot drives its own signal and gives one estimate. The interval around their mean is that of Student's t for noise
and signals, and in quadrature 1.5 % for effects that equation (3) leaves out and repetition does not show: creep and
sinkage of the tyres, and the engine's time step.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from mrctl.checks.open_loop import on_skid
from mrctl.experiments.tables import json_text, machine, markdown
from mrctl.physics import mjcf
from mrctl.physics.parameters import read_robot
from mrctl.physics.plant import Plant, build
from mrctl.record import InputError
from mrctl.results.dataset import versions
from mrctl.theory.perturbation import PERTURBATIONS, Perturbation
from mrctl.theory.robot import CAR, Robot, RobotFile

Array = NDArray[np.float64]

PERIOD = 10.0  # s of the excitation
PERIODS = 2  # periods that are averaged, after one in which the robot settles
REPEATS = 8  # number of robots, each under its own signal
TICK = 0.005  # s, for which a voltage is held
FINE = 100  # physics steps in a time constant; the first-order engine adds the damping over half a step to the mass
MODEL = 0.015  # relative error that effects outside equation (3) may cause
NOISE = PERTURBATIONS["sensor noise"]
NOT_IDENTIFIABLE = """\
For c, the mass m is taken from a scale. These drives do not identify m, J_w and J_m, which enter only M_e and J_e;
I_0, gear loss and rolling loss, which enter only F_c; N and k_M, which enter only N k (k_E equals k_M in SI units)."""


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
        """Relative error of the estimate."""
        return self.estimate / self.true - 1


class Drive(NamedTuple):
    """Measured signals of one robot over one period, averaged over periods; each is `(N, 2)`, a row for each tick.

    The columns are left and right, or V and θ̇. A signal is the mean over a tick or the value at its end.
    """

    twist: Array
    """Mean V in m/s and θ̇ in rad/s."""
    rate: Array
    """Mean V̇ in m/s² and θ̈ in rad/s²."""
    end: Array
    """V in m/s and θ̇ in rad/s at the end of the tick."""
    voltage: Array
    """Voltage at the terminals in V, constant within a tick."""
    current: Array
    """Current at the end of the tick in A."""


def run(world: str, robot: RobotFile, perturbation: Perturbation, seed: int, json: bool) -> str:
    """The command: drives, identifies, and prints a table or JSON.

    Args:
        world: World to drive in; its ground must be level.
        robot: Robot whose constants are identified.
        perturbation: How the plant differs from its model, and the noise of its sensors.
        seed: Seed of signals and noise.
        json: Whether to return JSON instead of a table.

    Raises:
        InputError: The robot cannot drive there.
    """
    found = identify(world, robot, perturbation, seed)
    if json:
        rows: list[dict[str, Any]] = [c._asdict() | {"error": c.error} for c in found]
        source = {"versions": versions(), "machine": machine(), "world": world, "robot": robot.model_dump()}
        return json_text(source | {"constants": rows})
    return text(found)


def text(constants: Sequence[Constant]) -> str:
    """The constants as a Markdown table, and which others such drives do not show."""
    header = ["constant", "unit", "estimate", "95 % interval", "true", "error"]
    numbers = [[f"{x:.4g}" for x in (c.estimate, c.low, c.high, c.true)] for c in constants]
    cells = [
        [c.name, c.unit, estimate, f"{low} to {high}", true, f"{100 * c.error:+.2f} %"]
        for c, (estimate, low, high, true) in zip(constants, numbers, strict=True)
    ]
    return f"{markdown(header, cells)}\n\n{NOT_IDENTIFIABLE}"


def identify(
    world: str = "flat", robot: RobotFile = CAR, perturbation: Perturbation = NOISE, seed: int = 0
) -> list[Constant]:
    """Identifies those constants of equation (3) that the drives show.

    Args:
        world: World to drive in; its ground must be level.
        robot: Robot whose constants are identified.
        perturbation: How the plant differs from its model, and the noise of its sensors.
        seed: Seed of signals and noise.

    Raises:
        InputError: The robot fails during a drive.
    """
    own = mjcf.arrangement(robot)
    steering = "rigid" if own == "compliant" else own
    nominal = read_robot(mjcf.load(world, steering, robot=robot))
    tau = min(nominal.velocity_time_constant, nominal.rotation_time_constant)
    substeps = max(5, int(np.ceil(FINE * TICK / tau)))
    model = mjcf.load(world, steering, TICK / substeps, robot)
    plants = [build(one, nominal, REPEATS, substeps, threads=1) for one in (model, on_skid(model))]
    random = np.random.default_rng([seed, 3])
    ahead, true = excite(plants[0], nominal, perturbation, random, turns=False)
    turning, _ = excite(plants[1], nominal, perturbation, random, turns=True)
    highest = round(2 * _bandwidth(nominal) * PERIOD)
    rows = []
    for straight, turn in zip(ahead, turning, strict=True):
        found = drive_constants(straight, nominal.wheel_radius, highest)
        found |= turn_constants(turn, found["R_a"], found["N k"], nominal, highest)
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
    reach = float(np.hypot(scatter(values), MODEL * mean))
    return Constant(name, unit, mean, mean - reach, mean + reach, true)


def scatter(values: Array) -> Array:
    """Half of the 95 % interval of a mean by Student's t, for values along the last axis."""
    count = values.shape[-1]
    return stats.t.ppf(0.975, count - 1) * values.std(ddof=1, axis=-1) / np.sqrt(count)


def _bandwidth(robot: Robot) -> float:
    """Highest frequency of the excitation in Hz: twice the corner of the slower channel, from 1 to 4."""
    slower = max(robot.velocity_time_constant, robot.rotation_time_constant)
    return float(np.clip(2 / (2 * np.pi * slower), 1.0, 4.0))


def signals(robot: Robot, random: np.random.Generator, turns: bool) -> Array:
    """One period of U_Σ and U_Δ in V, `(N, 2)`, with random phases and the largest amplitudes that the limits allow.

    The common channel has the even harmonics, the differential one the odd ones. Predicted from the nominal robot, V
    stays within half of its mean, which is half of the limit, and θ̇ within half of its limit and of what keeps both
    wheels turning forwards; accelerations stay within two thirds of their limits.
    """
    samples = round(PERIOD / TICK)
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
    loss = (robot.drive_loss + robot.rolling_force * robot.wheel_radius / 2) / robot.motor_gain
    return found + [speed / robot.velocity_gain + loss, 0.0]


def excite(
    plant: Plant, robot: Robot, perturbation: Perturbation, random: np.random.Generator, turns: bool
) -> tuple[list[Drive], Robot]:
    """Drives `REPEATS` robots open loop; returns the measured signals of each, and the true parameters."""
    period = np.stack([signals(robot, random, turns) for _ in range(REPEATS)], axis=1)  # (N, B, 2)
    samples = len(period)
    for row in range(REPEATS):
        plant.perturb(row, perturbation, round(perturbation.control_delay / TICK))
    plant.reset(np.zeros((REPEATS, 3)), np.tile([robot.max_speed / 2, 0.0], (REPEATS, 1)))
    ticks = (1 + PERIODS) * samples
    twist, voltage, current = np.zeros((ticks + 1, REPEATS, 2)), *np.zeros((2, ticks, REPEATS, 2))
    command = np.zeros((REPEATS, 4))
    for k in range(ticks):
        common, differential = period[k % samples].T
        command[:, 0], command[:, 1] = common - differential, common + differential
        twist[k] = plant.reading["twist"]
        plant.step(command)
        voltage[k], current[k] = plant.applied, plant.current()
    twist[ticks] = plant.reading["twist"]
    if plant.failed.any():
        raise InputError(f"identify: a robot failed during the drive: {next(filter(None, plant.failure))}")
    twist += random.standard_normal(twist.shape) * [perturbation.velocity_noise, perturbation.rotation_noise]

    def mean(values: Array) -> Array:
        return values[-PERIODS * samples :].reshape(PERIODS, samples, REPEATS, 2).mean(axis=0).transpose(1, 0, 2)

    first, last = twist[:-1], twist[1:]
    measured = map(mean, ((first + last) / 2, (last - first) / TICK, last, voltage, current))
    return [Drive(*row) for row in zip(*measured, strict=True)], plant.truth[0]


def drive_constants(drive: Drive, wheel_radius: float, highest: int) -> dict[str, float]:
    """R_a, N k, M_e and F_c from a drive straight on.

    Args:
        drive: Measured signals.
        wheel_radius: Radius of the driven wheels in m.
        highest: Highest harmonic that the low-pass filter keeps.
    """
    rate = np.repeat(drive.end[:, :1] / wheel_radius, 2, axis=1)  # of both wheels: their motors are alike
    speed_per_volt, fall = _fit(highest, rate.T, drive.voltage.T, -drive.current.T)
    resistance, constant = fall / speed_per_volt, 1 / speed_per_volt
    force = constant / wheel_radius * _mean_current(drive, resistance).sum(axis=1)
    lighter, loss = _fit(highest, drive.rate[:, 0], force, -np.ones_like(force))
    found = {"R_a": resistance, "N k": constant, "M_e": 1 / lighter, "F_c": loss / lighter}
    return {name: float(value) for name, value in found.items()}


def turn_constants(drive: Drive, resistance: float, constant: float, robot: Robot, highest: int) -> dict[str, float]:
    """J_e and m c from a drive in turns.

    Args:
        drive: Measured signals.
        resistance: R_a in Ω.
        constant: N k in N·m/A.
        robot: Robot whose wheel radius and half track are used, which a ruler measures.
        highest: Highest harmonic that the low-pass filter keeps.
    """
    current = _mean_current(drive, resistance)
    torque = constant * robot.half_track / robot.wheel_radius * (current[:, 1] - current[:, 0])
    v, omega = drive.twist.T
    nimbler, drag, _ = _fit(highest, drive.rate[:, 1], torque, -v * omega, np.ones_like(v))
    return {"J_e": float(1 / nimbler), "m c": float(drag / nimbler)}


def _mean_current(drive: Drive, resistance: float) -> Array:
    """Mean current of each tick: at its beginning the current jumps with the voltage, then it runs on to its end."""
    jump = (drive.voltage - np.roll(drive.voltage, 1, axis=0)) / resistance
    return (np.roll(drive.current, 1, axis=0) + jump + drive.current) / 2


def _fit(highest: int, left: Array, *right: Array) -> Array:
    """Least-squares coefficients of signals `(…, N)` over whole periods, low-pass filtered to the lowest harmonics."""

    def low(signal: Array) -> Array:
        spectrum = np.fft.rfft(signal)
        spectrum[..., highest + 1 :] = 0
        return np.fft.irfft(spectrum, signal.shape[-1]).ravel()

    found = np.linalg.lstsq(np.stack([low(r) for r in right], axis=1), low(left), rcond=None)[0]
    return np.asarray(found, float)
