"""Statistics against closed forms, published values and values worked out by hand."""

import re
from itertools import product
from math import comb
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from mrctl.record import InputError
from mrctl.results import comparison


def test_bootstrap_normal():
    """For many normal samples the interval is close to mean ± 1.96 s/√n."""
    samples = np.random.default_rng(1).normal(5, 2, 400)
    found = comparison.mean_interval(samples)
    half = 1.96 * samples.std(ddof=1) / 20
    assert found.value == pytest.approx(samples.mean())
    assert (found.low, found.high) == pytest.approx((samples.mean() - half, samples.mean() + half), abs=0.1 * half)


def test_median():
    """One run that went far wrong moves the mean and not the median, nor its interval."""
    found = comparison.mean_interval([1, 2, 3, 4, 5, 6, 7, 8, 700, np.nan], median=True)
    assert found == (5, 2, 8, 9, 1)


@pytest.mark.parametrize("n", [4, 6, 10, 30])
def test_median_coverage(n):
    """At least 95 % of the intervals hold the median of a skew distribution, of few samples too."""
    draws = np.random.default_rng(5).lognormal(0, 0.6, (1000, n))
    found = [comparison.mean_interval(d, median=True) for d in draws]
    assert np.mean([one.low <= 1 <= one.high for one in found]) >= 0.95
    assert all(np.isfinite([one.low, one.high]).all() == (n > 5) for one in found)


def test_bootstrap_coverage():
    """About 95 % of the intervals of 40 samples hold the true mean."""
    draws = np.random.default_rng(2).normal(3, 1, (200, 40))
    found = (comparison.mean_interval(d, n=500, seed=k) for k, d in enumerate(draws))
    held = [one.low <= 3 <= one.high for one in found]
    assert 0.89 <= np.mean(held) <= 0.99


@pytest.mark.parametrize("n", [2, 4, 9, 20])
def test_few_samples(n):
    """About 95 % of the intervals of few samples hold the true mean, too; they are those of scipy."""
    draws = np.random.default_rng(4).normal(3, 1, (1000, n))
    found = [comparison.mean_interval(d) for d in draws]
    assert 0.93 <= np.mean([one.low <= 3 <= one.high for one in found]) <= 0.97
    expected = stats.t.interval(0.95, n - 1, draws[0].mean(), stats.sem(draws[0]))
    assert (found[0].low, found[0].high) == pytest.approx(expected)


def test_bootstrap_degenerate():
    """Constant samples have no width, one sample has no interval, NaN and inf are counted, and seeds repeat."""
    assert comparison.mean_interval([2, 2, 2]) == (2, 2, 2, 3, 0)
    one = comparison.mean_interval([2, np.nan])
    assert one.value == 2 and np.isnan(one.low) and (one.samples, one.failed) == (1, 1)
    assert comparison.mean_interval([1, 2, 4, np.nan, np.inf])[3:] == (3, 2)
    assert np.isnan(comparison.mean_interval([]).value)
    assert comparison.mean_interval([1, 2, 4], seed=3) == comparison.mean_interval([1, 2, 4], seed=3)


def test_paired_ratio():
    """An exact ratio has no width however much the seeds differ: pairs are resampled together."""
    b = np.random.default_rng(0).lognormal(0, 2, 12)
    found = comparison.paired_ratio(0.5 * b, b)
    assert found[:3] == pytest.approx((0.5, 0.5, 0.5)) and found[3:] == (12, 0, 0)


def test_paired_ratio_failures():
    """A pair with a failure on either side leaves the mean and is counted on its side."""
    found = comparison.paired_ratio([1, 2, np.nan, 4], [2, 4, 6, np.inf])
    assert found.value == pytest.approx(0.5) and (found.pairs, found.failed, found.rival_failed) == (2, 1, 1)
    noisy = comparison.paired_ratio([1.0, 2.2, 2.9, 4.1], [2, 4, 6, 8])
    assert noisy.low < noisy.value < noisy.high


def test_paired_ratio_of_nothing():
    """An error of 0 on either side has no ratio; its pair is left out, and not counted as one that was used."""
    ratio = comparison.paired_ratio([0.0, 2.0, 2.0, 0.0], [1.0, 1.0, 0.0, 0.0])
    assert (ratio.value, ratio.pairs, ratio.failed, ratio.rival_failed) == (2.0, 1, 0, 0)


@given(st.lists(st.tuples(*[st.floats(1e-6, 1e6)] * 2), min_size=2, max_size=6))
def test_paired_ratio_is_even_handed(pairs):
    """It is the n-th root of the product of the ratios; turned round it is one over it, which a mean is not."""
    a, b = np.array(pairs).T
    found = comparison.paired_ratio(a, b, n=50).value
    assert found == pytest.approx(np.prod((a / b) ** (1 / len(a))), rel=1e-9)
    assert comparison.paired_ratio(b, a, n=50).value == pytest.approx(1 / found, rel=1e-9)


def test_superiority():
    """Wins count one, ties half; a failure loses, and two failures are a tie."""
    a = [1.0, 2.0, 5.0, 4.0, np.nan, np.inf]
    b = [2.0, 2.0, 4.0, np.nan, 1.0, np.nan]
    found = comparison.superiority(a, b)
    assert (found.wins, found.ties, found.losses) == (2, 2, 2) and found.value == 0.5
    assert comparison.superiority([1, 1, 1], [2, 2, 3]).value == 1
    assert np.isnan(comparison.superiority([], []).value)


@pytest.mark.parametrize(
    ("count", "n", "wilson", "exact"),
    [
        (81, 263, (0.2553, 0.3662), (0.2527, 0.3676)),
        (15, 148, (0.0624, 0.1605), (0.0578, 0.1617)),
        (0, 20, (0.0, 0.1611), (0.0, 0.1684)),
        (1, 29, (0.0061, 0.1718), (0.0009, 0.1776)),
    ],
)
def test_share_intervals(count, n, wilson, exact):
    """The examples of Newcombe (1998), table I, methods 3 and 5."""
    assert comparison.wilson(count / n, n) == pytest.approx(wilson, abs=6e-5)
    assert comparison.clopper_pearson(count, n) == pytest.approx(exact, abs=6e-5)


@pytest.mark.parametrize("level", [0.9, 0.95])
def test_superiority_is_the_sign_test(level):
    """The interval leaves out ½ where the exact sign test of the pairs that are not ties, by hand, says so."""
    for wins, ties, losses in product(range(0, 16, 3), (0, 1, 12, 40), range(9)):
        if not wins + ties + losses:
            continue
        found = comparison.superiority([0] * wins + [1] * ties + [2] * losses, [1] * (wins + ties + losses), level)
        n = wins + losses
        tail = sum(comb(n, k) for k in range(max(wins, losses), n + 1)) / 2**n
        assert (found.low > 0.5 or found.high < 0.5) == (2 * tail < 1 - level)
        assert found.low <= found.value <= found.high and found.high - found.low > 1e-3


@given(st.lists(st.tuples(*[st.floats(0, 10) | st.just(float("nan"))] * 2), min_size=1))
def test_superiority_is_even_handed(pairs):
    """What A wins, B loses, and the intervals mirror."""
    a, b = np.array(pairs).T
    one, other = comparison.superiority(a, b), comparison.superiority(b, a)
    assert one.value == pytest.approx(1 - other.value) and one.low == pytest.approx(1 - other.high)
    assert one.low <= one.value <= one.high


def test_cvar_of_a_distribution():
    """The worst 5 % of many uniform samples on (0, 1) average 0.975; of exponential ones, 1 + ln 20."""
    random = np.random.default_rng(0)
    assert comparison.cvar(random.random(200_000)) == pytest.approx(0.975, abs=1e-3)
    assert comparison.cvar(random.exponential(size=200_000)) == pytest.approx(1 + np.log(20), abs=0.05)


def test_cvar_by_hand():
    """Of 30 samples one and a half count; of ten, the worst; a failure is worse than any number."""
    assert comparison.cvar(np.arange(30)) == pytest.approx((29 + 0.5 * 28) / 1.5)
    assert comparison.cvar(np.arange(10)) == 9
    assert comparison.cvar([1, 2, 3, 4], share=1) == pytest.approx(2.5)
    assert comparison.cvar([*range(99), np.nan]) == np.inf
    assert np.isnan(comparison.cvar([]))


@pytest.mark.parametrize(
    ("call", "field"),
    [
        (lambda: comparison.mean_interval([1, 2], level=95), "level"),
        (lambda: comparison.superiority([1, 2], [1, 2], level=0), "level"),
        (lambda: comparison.mean_interval(range(20), n=0), "n"),
        (lambda: comparison.paired_ratio([1, 2], [1]), "b"),
        (lambda: comparison.superiority([1], [1, 2]), "b"),
        (lambda: comparison.cvar([1], share=0), "share"),
        (lambda: comparison.quantile_interval([1, 2, 3], 1.5), "share"),
        (lambda: comparison.quantile_interval([1, 2, 3], 0.0), "share"),
        (lambda: comparison.quantile_interval([1, 2, 3], 0.5, level=95), "level"),
        (lambda: comparison.wilson(0.5, 10, level=1), "level"),
    ],
)
def test_bad_input(call, field):
    """One line that begins with the field."""
    with pytest.raises(InputError, match=rf"^{field}: .+"):
        call()


def test_floor():
    """Errors that differ by no more than the floor are a tie; one that failed loses at any floor."""
    found = comparison.superiority([1.0, 2.0, 3.0, np.nan, 1.0], [1.05, 1.0, 3.5, 9.0, np.nan], floor=0.1)
    assert (found.wins, found.ties, found.losses) == (2, 1, 2) and found.value == pytest.approx(0.5)


def test_ties_are_those_of_the_suite():
    """`TIE` is what RESULTS.md states, in mm/s, mrad/s and mm."""
    text = (Path(__file__).parents[2] / "mrctl" / "experiments" / "RESULTS.md").read_text()
    stated = re.findall(r"a tie in single runs ([\d.]+)\)", text)[:3]
    assert [f"{1e3 * tie:.3g}" for tie in comparison.TIE.values()] == [f"{float(one):.3g}" for one in stated]


def test_quantile_interval():
    """The interval holds the true quantile as often as it says, and has no end where the samples are too few."""
    random = np.random.default_rng(3)
    found = [comparison.quantile_interval(random.exponential(size=80), 0.95) for _ in range(500)]
    held = [one.low <= -np.log(0.05) <= one.high for one in found]
    assert 0.94 <= np.mean(held) <= 0.99
    assert comparison.quantile_interval([3, 1, 2], 1e-12).value == 1 and comparison.wilson(0.0, 0) == (0.0, 1.0)
    few = comparison.quantile_interval([3, 1, np.nan, 2], 0.75)
    assert few == (3, 1, np.inf, 3, 1)
    assert comparison.quantile_interval(np.arange(71.0), 0.95).high == np.inf > 71  # 0.95⁷¹ > 0.025
    assert comparison.quantile_interval(np.arange(72.0), 0.95).high == 71


def test_refused_floors_and_shares():
    """A tie is no negative number and no NaN, and a share lies between 0 and 1."""
    for floor in (-1.0, np.nan):
        with pytest.raises(InputError, match="^floor: "):
            comparison.superiority([1.0], [2.0], floor=floor)
    with pytest.raises(InputError, match="^share: 1.2 is not"):
        comparison.wilson(1.2, 10)
