"""Persistency of excitation as a signal, and the errors of learned parameters against the true ones.

A motion determines the parameters of a law that is linear in the 8 physical features x as far as their Gram matrix over
a window is far from singular (persistency of excitation: Ioannou and Sun 1996, section 4.3):

    G(t) = 1/n Σ x xᵀ over the last n samples,    λ_min(G) ≥ α > 0 for all t

The eigenvalues say how much is known about each combination of parameters, and 1/(G⁻¹)_ii how much is known about each
parameter alone. This is the mean square of the residual of feature i after least squares on the other seven, and so
zero where they can replace it.
"""

from __future__ import annotations

import numpy as np
import xarray as xr

from mrctl.control.features import FEATURE_NAMES, feature_matrix
from mrctl.kernel import Array
from mrctl.record import InputError
from mrctl.results.dataset import require
from mrctl.results.metrics import as_runs, control_period, warn_if_decimated

ROUNDING = 1e-14  # eigenvalues below this share of the largest are due to rounding; long runs have a larger share
MOTIONS = {"commanded": ("v_command", "omega_command"), "true": ("v", "omega")}
"""Signals of V and θ̇ of the motions whose features can be examined."""


def gram(x: Array, samples: int) -> Array:
    """Returns the Gram matrix of the last samples at each sample.

    Args:
        x: Features, `(…, n, m)`.
        samples: Length of the window in samples.

    Returns:
        Their mean outer products, `(…, n, m, m)`; NaN until the window is full.
    """
    total = np.cumsum(x[..., :, None] * x[..., None, :], axis=-3)
    found = np.full(total.shape, np.nan)
    if samples <= x.shape[-2]:
        found[..., samples - 1 :, :, :] = total[..., samples - 1 :, :, :]
        found[..., samples:, :, :] -= total[..., :-samples, :, :]
    return found / samples


def strength(matrices: Array, rounding: float = ROUNDING) -> tuple[Array, Array]:
    """Returns the eigenvalues of Gram matrices, ascending, and 1/(G⁻¹)_ii of each feature.

    Args:
        matrices: Symmetric positive semidefinite matrices `(…, m, m)`.
        rounding: Eigenvalues below this share of the largest are due to rounding.

    Returns:
        Two arrays `(…, m)`; 0 where only rounding is left, NaN where the matrix is not finite.
    """
    finite = np.asarray(np.isfinite(matrices).all(axis=(-2, -1)))
    values, vectors = np.linalg.eigh(np.where(finite[..., None, None], matrices, 0.0))
    floor = rounding * values[..., -1:]
    kept = np.maximum(values, np.maximum(floor, np.finfo(float).tiny))
    alone = 1 / (vectors**2 / kept[..., None, :]).sum(-1)
    alone = np.where(alone > 10 * floor, alone, 0.0)
    values = np.where(values > floor, values, 0.0)
    return np.where(finite[..., None], values, np.nan), np.where(finite[..., None], alone, np.nan)


def alone(command: Array, period: float, half_track: Array, scale: Array) -> Array:
    """Measures how well a whole motion determines the parameter of each feature alone.

    Args:
        command: Commanded twist in m/s, rad/s, `(…, n, 2)`; its derivative is taken by central differences.
        period: Time between the samples in s.
        half_track: Half track of the nominal robot in m, `(…,)`.
        scale: Scales that the features are divided by, as from `feature_scale`, `(…, 8)`.

    Returns:
        1/(G⁻¹)_ii of the Gram matrix of all samples, `(…, 8)`; NaN where the motion is not finite.
    """
    x = feature_matrix(command, np.gradient(command, period, axis=-2), half_track[..., None], scale[..., None, :])
    return strength(np.swapaxes(x, -1, -2) @ x / x.shape[-2])[1]


def excitation(result: xr.Dataset, window: float = 4.0, motion: str = "commanded") -> xr.Dataset:
    """Measures how well the motion of the last seconds determines the parameters of the physical features.

    Args:
        result: What `simulate` returns, or one run of it.
        window: Length of the sliding window in s.
        motion: Motion whose features are examined: `commanded`, which most learners read, or `true`.

    Returns:
        Variables (run, time, …): `least`, the smallest eigenvalue of G; `eigenvalues`, all of them, ascending, over
        `direction`; `alone`, 1/(G⁻¹)_ii over `feature`. They belong to the scaled features, so they have no unit; NaN
        until the window is full and after a failure.

    Raises:
        InputError: The result lacks a variable, there is no such motion, or the window is not finite or is shorter than
            two samples.
    """
    if motion not in MOTIONS:
        raise InputError(f"motion: {motion!r} is not one of {', '.join(MOTIONS)}")
    names = MOTIONS[motion]
    require(result, ("time", "half_track", "feature_scale", *names))
    runs = as_runs(result)
    period = control_period(runs)
    warn_if_decimated(runs, "the eigenvalues")
    if not np.isfinite(window):
        raise InputError(f"window: {window} s is not finite")
    samples = round(window / period)
    if samples < 2:
        raise InputError(f"window: {window:g} s is shorter than two samples of {period:g} s")
    twist = np.stack([runs[name].transpose("run", "time").values for name in names], axis=-1)
    size, length = twist.shape[:2]
    least, values, each = (np.full((size, length, n), np.nan) for n in (1, 8, 8))
    for row in range(size):  # one at a time, as its Gram matrices take 512 bytes a sample
        half_track, scale = runs["half_track"].values[row], runs["feature_scale"].values[row]
        alive = int(np.isfinite(twist[row]).all(axis=-1).sum())
        if alive < 2:
            continue
        part = twist[row, :alive]
        x = feature_matrix(part, np.gradient(part, period, axis=0), half_track, scale)
        rounding = max(ROUNDING, np.finfo(float).eps * alive / samples)  # rounding of the sums grows with the run
        values[row, :alive], each[row, :alive] = strength(gram(x, samples), rounding)
        least[row] = values[row, :, :1]
    spans = {"units": "1", "window": window}
    return xr.Dataset(
        {
            "least": (("run", "time"), least[..., 0], spans | {"long_name": "smallest eigenvalue of the Gram matrix"}),
            "eigenvalues": (("run", "time", "direction"), values, spans | {"long_name": "eigenvalues, ascending"}),
            "alone": (("run", "time", "feature"), each, spans | {"long_name": "excitation of each feature alone"}),
        },
        {
            "time": runs["time"].values,
            "run": runs["run"].values,
            "label": ("run", [str(label) for label in runs["label"].values]),
            "feature": list(FEATURE_NAMES),
        },
    )


def parameter_error(result: xr.Dataset) -> xr.DataArray:
    """Returns the parameters at the end of a run, of prior and learner together, less those of the true robot.

    The parameters are those of equation (3) and of the scaled features. The equation leaves out fork and slip, so that
    the parameters which drive best are not quite the true ones. What `composite` learns as slope and disturbance is not
    counted.

    Args:
        result: What `simulate` returns, or one run of it.

    Returns:
        Errors in V, dimensions (run, feature, channel); NaN for learners without such parameters, for robots that
        failed, and for the second channel under `rigid` steering.

    Raises:
        InputError: The result has no parameters.
    """
    require(result, ("parameters", "true_parameters"))
    runs = as_runs(result)
    error = (runs["parameters"] - runs["true_parameters"]).transpose("run", "feature", "channel")
    attrs = {"units": "V", "long_name": "error of the parameters at the end"}
    return error.assign_coords(feature=list(FEATURE_NAMES), channel=["common", "differential"]).assign_attrs(attrs)
