"""Statistics over runs: means with confidence intervals, paired comparisons, the worst runs.

A sample is an error, so the smaller one is better; NaN or infinite stands for a run that failed. Failed runs are
counted and lose every comparison.
"""

from __future__ import annotations

import warnings
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from mrctl.kernel import Array
from mrctl.record import InputError

# samples; with fewer the bootstrap of a mean is too narrow: its 95 % interval holds that of 20 normal samples in 92 %
MIN_BOOTSTRAP = 40
TIE = {"v_rmse": 1.98e-4, "omega_rmse": 9.95e-4, "position_rmse": 7.64e-5}
"""Largest differences of two errors of a run in m/s, rad/s and m that the integrator does not resolve, by metric.

As the `floor` of `superiority` they are the ties of `mrctl suite` (RESULTS.md, "What the integrator resolves"), the
largest of lap 1, all laps and the last lap. They were measured by halving the step of the default robot at 12 s a lap;
a robot or course of another kind needs its own."""


class Interval(NamedTuple):
    """A mean, median or other quantile with its confidence interval; `samples` is the number of finite ones."""

    value: float
    low: float
    high: float
    samples: int
    failed: int
    """Number of samples that are NaN or infinite: runs that failed, or never recovered."""


class Ratio(NamedTuple):
    """A mean of paired ratios with its confidence interval, over the `pairs` finite and not 0 on both sides."""

    value: float
    low: float
    high: float
    pairs: int
    failed: int
    """Number of runs of A that failed."""
    rival_failed: int
    """Number of runs of B that failed."""


class Superiority(NamedTuple):
    """The probability that A beats B in the same run, ties as half over all pairs, and its interval given the ties."""

    value: float
    low: float
    high: float
    wins: int
    ties: int
    losses: int


def mean_interval(
    samples: ArrayLike, level: float = 0.95, n: int = 10_000, seed: int = 0, *, median: bool = False
) -> Interval:
    """Returns the mean of the finite samples with its confidence interval.

    It is the bias-corrected, accelerated bootstrap interval (Efron, 1987), or for the mean of fewer than 40 samples
    Student's, because the bootstrap would be too narrow. Both hold the mean of skew samples less often than they say:
    Student's in 93 % for 20 lognormal samples with σ = 0.5, and the bootstrap in 91 %. That of the median is between
    two order statistics, as in `quantile_interval`, because the bootstrap would be too narrow for any number.

    Args:
        samples: One number a run (n,); NaN or infinite where it failed.
        level: Confidence level, between 0 and 1.
        n: Number of resamples.
        seed: Seed of the resampling.
        median: Whether to take the median instead, which no single sample dominates.

    Returns:
        The interval; the ends of a mean are NaN where fewer than two samples are finite, because one run does not show
        the spread, and those of a median are infinite where there are too few: at 95 % with fewer than six.

    Raises:
        InputError: The level is not between 0 and 1, or there is no resample.
    """
    if n < 1:
        raise InputError(f"n: {n} is below 1")
    values = np.asarray(samples, float).ravel()
    finite = values[np.isfinite(values)]
    value = float((np.median if median else np.mean)(finite)) if len(finite) else np.nan
    if median:
        low, high = quantile_interval(finite, 0.5, level)[1:3]
    elif len(finite) >= MIN_BOOTSTRAP:
        low, high = _bootstrapped(finite, level, n, seed)
    else:
        low, high = _student(finite, level)
    return Interval(value, low, high, len(finite), len(values) - len(finite))


def paired_ratio(a: ArrayLike, b: ArrayLike, level: float = 0.95, n: int = 10_000, seed: int = 0) -> Ratio:
    """Returns the geometric mean of a / b over pairs (same seed, same perturbation), with its interval.

    The interval is that of `mean_interval` for the mean logarithm of the ratio. Every pair has the same weight,
    however large its errors, and the ratio of b to a is the inverse of that of a to b. A pair with an error of 0 has no
    such ratio and is left out.

    Args:
        a: One number a run (n,); NaN or infinite where it failed.
        b: The same runs under the other controller (n,).
        level: Confidence level, between 0 and 1.
        n: Number of resamples.
        seed: Seed of the resampling.

    Raises:
        InputError: `a` and `b` differ in length, or as `mean_interval`.
    """
    first, second = _pairs(a, b)
    fine = np.isfinite(first), np.isfinite(second)
    both = fine[0] & fine[1]
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = mean_interval(np.log(first[both] / second[both]), level, n, seed)
    value, low, high = np.exp(mean[:3]).tolist()
    return Ratio(value, low, high, mean.samples, int((~fine[0]).sum()), int((~fine[1]).sum()))


def superiority(a: ArrayLike, b: ArrayLike, level: float = 0.95, floor: float = 0.0) -> Superiority:
    """Estimates the probability that A has a smaller error than B in the same run; ties count half, failures as inf.

    The interval holds ½ only if the two-sided sign test, which leaves out ties, does not tell A and B apart: it is the
    exact interval (Clopper and Pearson 1934) of the share of wins among the pairs that are not ties, whose number is
    taken as given. So with ties it is no interval of the probability itself, as it leaves out that their number varies.
    Where all pairs are ties, it allows for the largest share of other pairs that may remain unseen.

    Args:
        a: One number a run (n,); NaN or infinite where it failed.
        b: The same runs under the other controller (n,).
        level: Confidence level, between 0 and 1.
        floor: Largest difference that counts as a tie, in the unit of the errors: what the integrator cannot resolve,
            such as `TIE["position_rmse"]`. With 0, differences that half the time step reverses count as wins.

    Raises:
        InputError: `a` and `b` differ in length, the level is not between 0 and 1, or the floor is negative or NaN.
    """
    _check_level(level)
    if not floor >= 0:
        raise InputError(f"floor: {floor} is not 0 or more")
    first, second = (np.where(np.isfinite(one), one, np.inf) for one in _pairs(a, b))
    tied = first == second
    with np.errstate(invalid="ignore"):  # inf − inf of two failures, which tie already
        tied |= np.abs(first - second) <= floor
    wins, ties, n = int(((first < second) & ~tied).sum()), int(tied.sum()), len(first)
    if not n:
        return Superiority(np.nan, np.nan, np.nan, 0, 0, 0)
    if ties == n:
        unseen = clopper_pearson(0, n, level)[1]
        low, high = (1 - unseen) / 2, (1 + unseen) / 2
    else:
        low, high = ((ties / 2 + (n - ties) * end) / n for end in clopper_pearson(wins, n - ties, level))
    return Superiority((wins + ties / 2) / n, low, high, wins, ties, n - wins - ties)


def clopper_pearson(count: int, n: int, level: float = 0.95) -> tuple[float, float]:
    """Returns the exact interval of the share of `count` in n trials (Clopper and Pearson, Biometrika 26(4), 1934)."""
    from scipy.special import betaincinv

    half = (1 - level) / 2
    low = float(betaincinv(count, n - count + 1, half)) if count else 0.0
    high = float(betaincinv(count + 1, n - count, 1 - half)) if count < n else 1.0
    return low, high


def wilson(share: float, n: int, level: float = 0.95) -> tuple[float, float]:
    """Returns Wilson's (1927) score interval of a share of n trials, which without any is from 0 to 1."""
    _check_level(level)
    if not 0 <= share <= 1:
        raise InputError(f"share: {share} is not between 0 and 1")
    if not n:
        return 0.0, 1.0
    z = NormalDist().inv_cdf((1 + level) / 2)
    centre, half = share + z * z / (2 * n), z * np.sqrt(share * (1 - share) / n + (z / (2 * n)) ** 2)
    low, high = (float(np.clip((centre + sign * half) / (1 + z * z / n), 0, 1)) for sign in (-1, 1))
    return low, high


def quantile_interval(samples: ArrayLike, share: float, level: float = 0.95) -> Interval:
    """Returns a quantile and the interval between two order statistics, valid for any distribution (Conover 1999, 3.2).

    Args:
        samples: One number a run (n,); NaN or infinite where it failed, which counts as infinite.
        share: Share of the samples that are at most the quantile, above 0 and at most 1.
        level: Confidence level, between 0 and 1.

    Returns:
        The least sample that is not exceeded by this share of the samples. An end of the interval is infinite where
        there are too few samples for it. `samples` counts the finite ones.

    Raises:
        InputError: `share` or `level` is out of range.
    """
    from scipy.stats import binom  # the import takes 0.4 s

    _check_share(share)
    _check_level(level)
    values = np.asarray(samples, float).ravel()
    fine = np.isfinite(values)
    ordered, n = np.sort(np.where(fine, values, np.inf)), len(values)
    low, high = (int(rank) for rank in binom.ppf([(1 - level) / 2, (1 + level) / 2], n, share))
    ends = np.concatenate([[-np.inf], ordered, [np.inf]])  # the number of samples up to the quantile is binomial
    value = float(ordered[max(int(np.ceil(share * n - 1e-9)), 1) - 1]) if n else np.nan
    return Interval(value, float(ends[low]), float(ends[high + 1]), int(fine.sum()), int((~fine).sum()))


def cvar(samples: ArrayLike, share: float = 0.05) -> float:
    """Returns the conditional value at risk: the mean of the worst share of the runs, infinite if one of them failed.

    Rockafellar and Uryasev (2002): of n samples the worst `share` · n count, the last of them in part. With fewer than
    1 / `share` samples it is the worst sample.

    Args:
        samples: One number a run (n,); NaN or infinite where it failed.
        share: Share of the samples that count, above 0 and at most 1.

    Returns:
        The mean; NaN without samples.

    Raises:
        InputError: `share` is out of range.
    """
    _check_share(share)
    values = np.asarray(samples, float).ravel()
    worst = np.sort(np.where(np.isfinite(values), values, np.inf))[::-1]
    if not len(worst):
        return np.nan
    weights = np.clip(share * len(worst) - np.arange(len(worst)), 0, 1)
    return float(np.average(worst[weights > 0], weights=weights[weights > 0]))


def _pairs(a: ArrayLike, b: ArrayLike) -> tuple[Array, Array]:
    """Returns both sequences of samples as vectors of the same length.

    Raises:
        InputError: They differ in length.
    """
    first, second = np.asarray(a, float).ravel(), np.asarray(b, float).ravel()
    if len(first) != len(second):
        raise InputError(f"b: {len(second)} samples cannot be paired with {len(first)}")
    return first, second


def _student(samples: Array, level: float) -> tuple[float, float]:
    """Returns Student's (1908) interval of a mean."""
    from scipy.special import stdtrit

    _check_level(level)
    n = len(samples)
    if n < 2:
        return np.nan, np.nan
    half = float(stdtrit(n - 1, (1 + level) / 2) * samples.std(ddof=1) / np.sqrt(n))
    return float(samples.mean()) - half, float(samples.mean()) + half


def _check_level(level: float) -> None:
    """Raises `InputError` if a confidence level is not between 0 and 1."""
    if not 0 < level < 1:
        raise InputError(f"level: {level} is not between 0 and 1")


def _check_share(share: float) -> None:
    """Raises `InputError` if a share is not above 0 and at most 1."""
    if not 0 < share <= 1:
        raise InputError(f"share: {share} is not above 0 and at most 1")


def _bootstrapped(samples: Array, level: float, n: int, seed: int) -> tuple[float, float]:
    """Returns the BCa bootstrap interval of a mean; percentiles where the samples are too alike for BCa."""
    from scipy.stats import bootstrap  # the import takes 0.4 s

    _check_level(level)
    low = high = np.nan
    for method in ("BCa", "percentile"):
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            found = bootstrap(
                (samples,), np.mean, n_resamples=n, batch=1000, vectorized=True, confidence_level=level,
                method=method, rng=np.random.default_rng(seed),
            ).confidence_interval  # fmt: skip
        low, high = float(found.low), float(found.high)
        if np.isfinite([low, high]).all():
            break
    return low, high
