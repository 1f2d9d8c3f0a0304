"""`mrctl train`: learns the features and the prior of `composite` off-line on randomised plants.

As in Neural-Fly (O'Connell et al. 2022), a network φ is trained so that its last layer, solved anew for each plant,
predicts the residual of the model. The weights of a plant are the maximum a posteriori of a linear regression on a part
of its data; the loss is the residual on the rest of the same drive and on a drive along another reference. The prior P₀
of the weights is not a ridge chosen by hand but their covariance over the plants, estimated by expectation maximisation
(empirical Bayes; Dempster, Laird and Rubin 1977). It is saved together with φ, and the Kalman filter starts from it.
"""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from scipy.signal import lfilter
from torch import Tensor

from mrctl.control.composite import Composite
from mrctl.control.features import INPUTS, PHYSICAL, UNITS, feature_matrix, feature_scale
from mrctl.control.weights import Training, save_training
from mrctl.experiments.paper import IDEAL
from mrctl.experiments.tables import markdown, number, output_folder
from mrctl.kernel import Array
from mrctl.loop.simulation import simulate
from mrctl.physics import mjcf
from mrctl.physics.parameters import read_robot
from mrctl.record import InputError
from mrctl.results.dataset import versions
from mrctl.scenario import FEEDFORWARDS, Scenario
from mrctl.theory.dynamics import inverse_coefficients
from mrctl.theory.perturbation import Perturbation
from mrctl.theory.references import Circle, Lemniscate, Reference, RoundedSquare, Waypoints, check
from mrctl.theory.robot import STEERINGS, Robot

DRIVE = 24.0  # s along each reference, in one to three laps
EVERY = 20  # control periods between samples of the regression
CORRELATED = 10.0  # samples that count as one, because the error of the features changes slowly
EPOCHS, EVERY_PRIOR, RATE = 150, 50, 0.02
PSEUDO_PLANTS, SCATTER = 10.0, 0.3  # prior of P₀: number of plants, and standard deviation of their weights in V
# Name, channel, steering arrangements, and the unit of its residual in V or rad/s.
GROUPS = (
    ("common", 0, STEERINGS, 1.0),
    ("differential", 1, ("compliant", "caster"), 1.0),
    ("steering", 1, ("rigid",), 0.1),
)


class Drives(NamedTuple):
    """Two drives with each of P plants, after the filters of `composite`.

    Attributes:
        steering: Steering arrangement of each plant, `(P,)`.
        physical: Scaled physical features, `(P, 2, M, 10)`.
        residual: Filtered voltage minus that of the model in V, `(P, 2, M, 2)`; rad/s for rigid steering.
    """

    steering: Array
    physical: Array
    residual: Array


class Moments(NamedTuple):
    """Second moments of a regression: φᵀφ `(…, n, n)`, φᵀy `(…, n)` and yᵀy `(…)`, means over samples."""

    gram: Tensor
    cross: Tensor
    power: Tensor


def train(out: Path, plants: int, seed: int) -> str:
    """Trains on `plants` randomised plants and writes the file.

    Args:
        out: File for the weights, in the safetensors format.
        plants: Number of plants to train on; a third as many more are held out for the table.
        seed: Seed of plants, references and initial network.

    Returns:
        A table of the residual on the plants that were held out.

    Raises:
        InputError: There are too few or too many plants, or the file cannot be written.
    """
    if not 12 <= plants <= 100_000:
        raise InputError("plants: must be between 12 and 100,000")
    if out.is_dir():
        raise InputError(f"out: {out} is a folder, not a file")
    output_folder(out.parent)
    start = time.perf_counter()
    robot = read_robot(mjcf.load("flat"))
    seen, unseen = (drive(draw(robot, n, [seed, k]), robot) for k, n in enumerate((plants, plants // 3)))
    units = fit(seen, seed)
    training = Training(units, priors(seen, units))
    without = np.zeros((0, INPUTS + 1))
    plain = held_out(seen, unseen, without)
    found = held_out(seen, unseen, units)
    recipe = {
        "command": f"mrctl train --plants {plants} --seed {seed}", "versions": json.dumps(versions()),
        "filter": str(Composite().filter), "held_out": json.dumps({"physical": plain, "with_units": found}),
    }  # fmt: skip
    save_training(out, training, recipe)
    rows = [
        [f"{name}, {where}", *(number(1e3 * table[name][where]) for table in (plain, found))]
        for name in plain for where in plain[name]
    ]  # fmt: skip
    lines = (
        f"Residual on {len(unseen.steering)} plants held out, mV (mrad/s for steering), geometric mean of the RMS",
        markdown(["channel, predicted", "physical features", f"and {UNITS} units"], rows),
        f"{len(seen.steering)} of {plants} plants kept in training, {time.perf_counter() - start:.0f} s; {out}",
    )
    return "\n".join(lines)


def draw(robot: Robot, plants: int, seed: Sequence[int]) -> list[Scenario]:
    """Two drives along random references with each of some random plants, in turn under each steering arrangement."""
    rng = np.random.default_rng([*seed, 3])
    scenarios = []
    for plant in range(plants):
        perturbation = _perturbation(rng)
        for _ in range(2):
            reference, laps = _reference(rng, robot)
            scenarios.append(
                Scenario(
                    **IDEAL,
                    **FEEDFORWARDS["model"],
                    steering=STEERINGS[plant % len(STEERINGS)], reference=reference, laps=laps,
                    perturbation=perturbation, seed=int(rng.integers(2**32)),
                )
            )  # fmt: skip
    return scenarios


def _perturbation(rng: np.random.Generator) -> Perturbation:
    def factor(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    return Perturbation(
        mass_factor=factor(0.6, 1.6), inertia_factor=factor(0.7, 1.5),
        payload=float(rng.choice([0.0, rng.uniform(0, 8)])), payload_x=rng.uniform(0, 0.2),
        payload_y=rng.uniform(-0.1, 0.1),
        left_radius_factor=rng.uniform(0.96, 1.04), right_radius_factor=rng.uniform(0.96, 1.04),
        drive_friction_factor=factor(0.4, 4), resistance_factor=factor(0.75, 1.4),
        motor_constant_factor=factor(0.85, 1.15), supply_factor=factor(0.75, 1.1),
        tyre_friction_factor=factor(0.25, 1.3), slope=float(rng.choice([0.0, rng.uniform(-0.17, 0.17)])),
        control_delay=0.01 * max(0, int(rng.integers(-3, 4))),
    )  # fmt: skip


def _reference(rng: np.random.Generator, robot: Robot) -> tuple[Reference, int]:
    """A random reference that the robot can follow, and its number of laps in `DRIVE` seconds."""
    while True:
        laps = int(rng.integers(1, 4))
        period = DRIVE / laps
        kind = rng.choice(4, p=[0.35, 0.1, 0.2, 0.35])
        try:
            if kind == 0:
                found = Lemniscate(size=rng.uniform(0.5, 2), period=period)
            elif kind == 1:
                found = Circle(radius=rng.uniform(0.5, 2), period=period, clockwise=bool(rng.random() < 0.5))
            elif kind == 2:
                found = _timed(RoundedSquare(side=rng.uniform(1, 3), radius=rng.uniform(0.2, 0.6)), period)
            else:
                corners = int(rng.integers(4, 8))
                around = 2 * np.pi * (np.arange(corners) + rng.uniform(-0.35, 0.35, corners)) / corners
                p = rng.uniform(0.6, 2, corners) * np.exp(rng.choice([-1j, 1j]) * around)
                found = _timed(Waypoints(points=tuple((float(z.real), float(z.imag)) for z in p)), period)
            check(found, robot, reverse=False)
        except (InputError, ValueError):
            continue
        if found.sample(np.linspace(0, period, 200)).twist[:, 0].max() > 0.2:
            return found, laps


def _timed(reference: RoundedSquare | Waypoints, period: float) -> RoundedSquare | Waypoints:
    """The same path, driven in another lap time in s."""
    return type(reference).model_validate(
        reference.model_dump() | {"speed": reference.speed * reference.period / period}
    )


def drive(scenarios: Sequence[Scenario], robot: Robot) -> Drives:
    """Drives with the model as feedforward and filters as `composite` does; plants that failed are left out."""
    result = simulate(scenarios, progress=True)
    kept = np.logical_not(np.asarray(result["failed"]).reshape(-1, 2).any(axis=1))
    period, time_constant = scenarios[0].control_period, Composite().filter

    def column(name: str) -> Array:
        return result[name].values.reshape(len(kept), 2, -1)[kept].astype(float)

    steering = result["steering"].values[::2][kept].astype(str)
    rigid = (steering == "rigid")[:, None, None]
    v, omega, left, right = (column(n) for n in ("v_measured", "omega_measured", "voltage_left", "voltage_right"))
    angle = column("steering_command") - column("steering_rate_command") * period / 2
    asked = column("v_command") * np.tan(angle) / robot.wheelbase  # yaw rate that the commanded steering angle gives
    sent = np.stack([(left + right) / 2, np.where(rigid, asked, (right - left) / 2)])
    sent = np.concatenate([sent[..., :1], sent[..., :-1]], -1)  # a command acts on the motion of the next sample
    # The direction of a slope is unknown, so each plant gets another heading.
    heading = column("theta") + 2 * np.pi * np.arange(len(steering))[:, None, None] * 0.618
    share = period / (period + time_constant)
    signals = np.stack([*sent, v, omega, np.cos(heading), np.sin(heading)])
    once = np.asarray(lfilter([share], [1, share - 1], signals))
    twice = np.asarray(lfilter([share], [1, share - 1], once))
    rate = (once[2:4] - twice[2:4]) / time_constant
    settled = slice(round(1 / period), None, EVERY)
    signals, rate = twice[..., settled], rate[..., settled]
    scale = feature_scale(robot)
    twist, rate = np.moveaxis(signals[2:4], 0, -1), np.moveaxis(rate, 0, -1)
    x = feature_matrix(twist, rate, robot.half_track, scale)
    model = inverse_coefficients(robot) * scale[:, None]
    steers = model.copy()
    steers[:, 1] = 0.0
    steers[1, 1] = scale[1]
    predicted = np.where(rigid[..., None], x @ steers, x @ model)
    physical = np.concatenate([x, np.moveaxis(signals[4:], 0, -1)], -1)
    return Drives(steering, physical, np.moveaxis(signals[:2], 0, -1) - predicted)


def _basis(physical: Tensor, units: Tensor) -> Tensor:
    """The features φ, as `composite.basis` computes them."""
    return torch.cat([physical, torch.tanh(physical[..., :INPUTS] @ units[:, :INPUTS].T + units[:, INPUTS])], -1)


def _moments(drives: Drives, units: Tensor) -> dict[str, Moments]:
    """Moments of each group, for each plant, drive and half of the drive, `(P, 2, 2, …)`."""
    found = {}
    for name, channel, where, _ in GROUPS:
        rows = np.isin(drives.steering, where)
        half = drives.physical.shape[2] // 2
        x, y = drives.physical[rows][:, :, : 2 * half], drives.residual[rows][:, :, : 2 * half, channel]
        phi = _basis(torch.tensor(x.reshape(*x.shape[:2], 2, half, PHYSICAL)), units)
        y = torch.tensor(y.reshape(*y.shape[:2], 2, half))
        found[name] = Moments(
            phi.transpose(-1, -2) @ phi / half, (y[..., None, :] @ phi)[..., 0, :] / half, (y**2).mean(-1)
        )
    return found


def _mean(m: Moments, *dimensions: int) -> Moments:
    return Moments(*(part.mean(dimensions) for part in m))


def _solve(m: Moments, samples: float, precision: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    """Maximum a posteriori weights and their covariance, for moments over a number of independent samples."""
    covariance = torch.linalg.inv(m.gram * samples / noise + precision)
    return (covariance @ m.cross[..., None] * samples / noise)[..., 0], covariance


def _residual(m: Moments, weights: Tensor) -> Tensor:
    """Mean square of y − φ a."""
    return (
        m.power - 2 * (weights * m.cross).sum(-1) + (weights * (m.gram @ weights[..., None])[..., 0]).sum(-1)
    ).clamp(min=0)


def _scatter(m: Moments, samples: float, unit: float, iterations: int = 30) -> tuple[Tensor, Tensor]:
    """Expectation maximisation of P₀ and of the noise's variance: weights a ~ N(0, P₀) a plant, y = φ a + noise.

    The noise is the geometric mean over plants, on which a few plants that slip have little influence.
    """
    plants, n = m.cross.shape
    start = (SCATTER * unit) ** 2 * torch.eye(n, dtype=torch.float64)
    prior, noise = start, torch.tensor((0.1 * unit) ** 2, dtype=torch.float64)
    for _ in range(iterations):
        weights, covariance = _solve(m, samples, torch.linalg.inv(prior), noise)
        prior = (weights.T @ weights + covariance.sum(0) + PSEUDO_PLANTS * start) / (plants + PSEUDO_PLANTS)
        prior = (prior + prior.T) / 2
        unsure = (m.gram * covariance).sum((-1, -2)).mean()
        noise = torch.exp(torch.log(_residual(m, weights) + (1e-3 * unit) ** 2).mean()) + unsure
    return prior, noise


def _samples(drives: Drives) -> float:
    """Number of independent samples in half a drive."""
    return drives.physical.shape[2] / 2 / CORRELATED


def _scatters(drives: Drives, units: Tensor) -> dict[str, tuple[Tensor, Tensor]]:
    moments = _moments(drives, units)
    samples = 4 * _samples(drives)
    return {name: _scatter(_mean(moments[name], 1, 2), samples, unit) for name, _, _, unit in GROUPS}


def priors(drives: Drives, units: Array) -> Array:
    """P₀ of the three groups, `(3, n, n)`."""
    return np.stack([prior.numpy() for prior, _ in _scatters(drives, torch.tensor(units)).values()])


def _queries(
    drives: Drives, units: Tensor, scatters: dict[str, tuple[Tensor, Tensor]]
) -> dict[str, tuple[Tensor, Tensor]]:
    """Mean square residual of each drive: of its second half by its first, and of all by the other drive, `(P, 2)`."""
    samples = _samples(drives)
    found = {}
    for name, m in _moments(drives, units).items():
        precision, noise = torch.linalg.inv(scatters[name][0]), scatters[name][1]
        first, second, whole = Moments(*(p[:, :, 0] for p in m)), Moments(*(p[:, :, 1] for p in m)), _mean(m, 2)
        rest = _residual(second, _solve(first, samples, precision, noise)[0])
        other = _residual(whole, _solve(whole, 2 * samples, precision, noise)[0].flip(1))
        found[name] = rest, other
    return found


def fit(drives: Drives, seed: int) -> Array:
    """Trains the units, `(16, 9)`; the priors are estimated anew every `EVERY_PRIOR` epochs."""
    torch.set_num_threads(1)  # the matrices are small, and one thread adds up in one order
    rng = np.random.default_rng([seed, 4])
    units = torch.tensor(0.7 * rng.normal(size=(UNITS, INPUTS + 1)), requires_grad=True)
    optimiser = torch.optim.Adam([units], lr=RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, EPOCHS)
    scatters = {}
    for epoch in range(EPOCHS):
        if epoch % EVERY_PRIOR == 0:
            scatters = _scatters(drives, units.detach())
        losses = [
            torch.log(square + (0.01 * unit) ** 2).mean()
            for (_, _, _, unit), pair in zip(GROUPS, _queries(drives, units, scatters).values(), strict=True)
            for square in pair
        ]
        optimiser.zero_grad()
        torch.stack(losses).sum().backward()
        optimiser.step()
        schedule.step()
    return units.detach().numpy()


def held_out(seen: Drives, unseen: Drives, units: Array) -> dict[str, dict[str, float]]:
    """Geometric mean of the RMS residual on unseen plants, with the prior of those seen, by channel and prediction."""
    network = torch.tensor(units)
    queries = _queries(unseen, network, _scatters(seen, network))
    return {
        name: {
            where: float(torch.exp(torch.log(square).mean() / 2))
            for where, square in zip(("rest of the drive", "another drive"), pair, strict=True)
        }
        for name, pair in queries.items()
    }
