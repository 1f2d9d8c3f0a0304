"""The best fixed feedforward for each run: the nominal model, or coefficients fitted to that run afterwards.

    U_ff = cᵀ φ_c,    c ← c + argmin_Δ Σ |U_fb − Δᵀ φ_c|²,    φ_c = the 8 features of equation (3) at the command

The inverse dynamics of the nominal robot is the first guess. A run shows which voltage the feedback had to add; least
squares finds the coefficients that would have given this voltage, and the run is repeated with them. Ticks in which
learning is frozen do not count. After one repetition the coefficients hardly change any more.

Least squares makes the feedback voltage small and not the error, which grows where the loop oscillates with the
coefficients found. Of the drives of a run, that with the nominal model included, the one with the least position error
over all laps is therefore taken, so that the nominal model never has less error than it. By analogy with on-line
learning (Cesa-Bianchi and Lugosi, 2006), the regret of a learner is its RMS position error over all laps less that of
this drive. It can be negative, because a learner is not fixed, and because another fixed feedforward may have less.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr

from mrctl.control.features import feature_matrix
from mrctl.kernel import Array
from mrctl.loop.groups import uniform
from mrctl.loop.simulation import Simulation
from mrctl.results import dataset
from mrctl.results.metrics import over_laps, per_lap
from mrctl.scenario import Scenario

REPETITIONS = 2
RIDGE = 1e-6  # share of a feature's sum of squares; keeps coefficients that were never excited at their first guess


def best_fixed(scenarios: Sequence[Scenario], *, threads: int = 0) -> xr.Dataset:
    """Drives every scenario with the nominal model, then twice more; returns the best drives, as `simulate` does.

    Args:
        scenarios: Scenarios, whose priors and learners are replaced.
        threads: Number of threads; 0 for all cores.

    Raises:
        InputError: As `mrctl.simulate`.
    """
    scenarios = [s.with_feedforward("model").model_copy(update={"name": s.name or "hindsight"}) for s in scenarios]
    parts = []
    for rows in uniform(scenarios):
        group, coefficients, drives = [scenarios[row] for row in rows], None, []
        for _ in range(1 + REPETITIONS):
            result, coefficients = drive(group, coefficients, threads)
            drives.append(result)
        errors = np.array([over_laps(per_lap(result), "position_rmse") for result in drives])
        best = np.argmin(np.where(np.isnan(errors), np.inf, errors), axis=0)  # NaN: a robot that was lost
        for k in np.unique(best).tolist():
            chosen = np.flatnonzero(best == k)
            parts.append(([rows[row] for row in chosen], drives[k].isel(run=chosen)))
    return dataset.combine(parts, scenarios)


def drive(scenarios: Sequence[Scenario], coefficients: Array | None, threads: int = 0) -> tuple[xr.Dataset, Array]:
    """Drives once with fixed coefficients `(B, 8, 2)`, by default the model's; returns the result and the next ones."""
    simulation = Simulation(scenarios, threads=threads)
    hierarchy = simulation.hierarchy
    prior = hierarchy.prior.rows
    if coefficients is not None:
        prior["c"] = coefficients  # the PID's integral is zero, because the simulation was built with the nominal prior
    gram, seen = np.zeros((len(scenarios), 8, 8)), np.zeros((len(scenarios), 8, 2))
    while simulation.running:
        simulation.step()
        control = hierarchy.state
        x = feature_matrix(hierarchy.command, hierarchy.derivative, prior["half_track"], prior["ones"])
        x = np.where((control["frozen"][:, None] == 0) & np.isfinite(x), x, 0.0)
        gram += x[:, :, None] * x[:, None, :]
        seen += x[:, :, None] * np.nan_to_num(hierarchy.feedback)[:, None, :]
    scale = np.sqrt(np.einsum("bii->bi", gram)).clip(min=1e-12)
    scaled = gram / (scale[:, :, None] * scale[:, None, :]) + RIDGE * np.eye(8)
    found = np.linalg.solve(scaled, seen / scale[:, :, None]) / scale[:, :, None]
    return simulation.result(), prior["c"] + found
