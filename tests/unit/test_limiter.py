"""The limiter: bounds that hold, a reference that passes, a first-order correction, an honest derivative."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from mrctl.control.limiter import LIMITER, limit
from mrctl.kernel import over_rows
from mrctl.theory.references import Lemniscate

LIMITS = np.array([1.5, 3.0, 1.5, 6.0])


def numbers(shape, bound):
    return arrays(float, shape, elements=st.floats(-bound, bound))


def run(requests, twists, accelerations, time_constant=0.05, period=0.01, limits=LIMITS, last=None):
    """Commands and derivatives (T, 2) of one robot."""
    s = np.zeros(1, LIMITER)
    s["time_constant"], s["command"] = time_constant, twists[0] if last is None else last
    commands, derivatives = [], []
    for request, twist, acceleration in zip(requests, twists, accelerations, strict=True):
        limit(request, twist, acceleration, limits[:2], limits[2:], period, s[0])
        commands.append(s["command"][0].copy())
        derivatives.append(s["derivative"][0].copy())
    return np.array(commands), np.array(derivatives)


@given(numbers((12, 2), 20.0), numbers((12, 2), 5.0), numbers((12, 2), 20.0), st.floats(1, 20), numbers(2, 1.0))
def test_bounds(requests, twists, accelerations, ratio, start):
    """Whatever is asked, |v|, |ω|, |v̇|, |ω̇| stay within the limits."""
    last = start * LIMITS[:2]
    commands, derivatives = run(requests, twists, accelerations, 0.01 * ratio, last=last)
    assert (np.abs(commands) <= LIMITS[:2]).all()
    steps = np.diff(commands, axis=0, prepend=last[None])
    assert (np.abs(steps) <= LIMITS[2:] * 0.01 + 1e-14).all()
    assert (np.abs(derivatives) <= LIMITS[2:] * (1 + 1e-12)).all()


def test_reference_passes():
    """What the reference itself asks for arrives at once, with its own derivative, to the bit."""
    _, twist, acceleration = Lemniscate().sample(0.01 * np.arange(1200))
    commands, derivatives = run(twist, twist, acceleration, time_constant=0.2)
    np.testing.assert_array_equal(commands, twist)
    np.testing.assert_array_equal(derivatives, acceleration)


def test_correction_is_first_order():
    """A step in what is added to a moving reference answers as 1 − exp(−t/T), and its derivative likewise."""
    h, lag, step = 1e-4, 0.1, np.array([0.05, -0.2])
    t = h * np.arange(4000)
    _, twist, acceleration = Lemniscate().sample(t)
    commands, derivatives = run(twist + step, twist, acceleration, lag, h)
    rise = (1 - np.exp(-(t + h) / lag))[:, None]
    np.testing.assert_allclose(commands - twist, step * rise, atol=1e-3 * np.abs(step).max())
    fall = np.exp(-t / lag)[:, None] / lag
    np.testing.assert_allclose(derivatives - acceleration, step * fall, atol=1e-3 * np.abs(step).max() / lag)


def test_derivative():
    """Without limits the derivative is that of the command; under a limit it is the limit's own slope."""
    h = 1e-3
    t = h * np.arange(3000)
    _, twist, acceleration = Lemniscate().sample(t)
    wave = np.stack([0.05 * np.sin(2 * t), 0.1 * np.sin(3 * t)], -1)
    commands, derivatives = run(twist + wave, twist, acceleration, 0.05, h)
    np.testing.assert_allclose(derivatives[1:-1], (commands[2:] - commands[:-2]) / (2 * h), atol=3e-3)
    zero = np.zeros((50, 2))
    commands, derivatives = run(zero + [1.0, -2.0], zero, zero)
    slope = np.diff(commands, axis=0, prepend=0) / 0.01
    limited = np.isclose(np.abs(slope), LIMITS[2:])
    assert limited[:20].all()
    np.testing.assert_allclose(derivatives[limited], slope[limited])


@given(numbers((20, 2), 3.0), st.sampled_from([0.01, 0.002]))
def test_kanayamas_limiter(requests, period):
    """Without reference and filter it is his: clip each velocity, then each change of it."""
    limits = np.array([0.4, 0.8, 0.5, 5.0])
    v = np.array([0.3, 0.0])
    expected = []
    for request in requests:
        v = v + np.clip(np.clip(request, -limits[:2], limits[:2]) - v, -limits[2:] * period, limits[2:] * period)
        expected.append(v)
    zero = np.zeros((20, 2))
    commands, _ = run(requests, zero, zero, period, period, limits, last=np.array([0.3, 0.0]))
    np.testing.assert_allclose(commands, expected, atol=1e-12)


@pytest.mark.parametrize("channel", [0, 1])
def test_no_windup(channel):
    """A wish that was out of reach for long is forgotten as soon as it ends."""
    asked = np.zeros((300, 2))
    asked[:200, channel] = 50.0
    commands, _ = run(asked, np.zeros((300, 2)), np.zeros((300, 2)))
    assert commands[199, channel] == pytest.approx(LIMITS[channel])
    assert commands[200, channel] == pytest.approx(LIMITS[channel] - 0.01 * LIMITS[2 + channel])


@pytest.mark.filterwarnings("ignore:invalid value")
@given(
    numbers((4, 2), 3.0), numbers((4, 2), 1.0), numbers((4, 2), 2.0), arrays(float, 4, elements=st.floats(0.01, 1)),
    numbers((4, 4), 1.0),
)  # fmt: skip
def test_rows(request, twist, acceleration, lag, state):
    """Robots do not mix: a row has the same bits alone and beside others, one of which is lost."""

    def answer(rows, lost=()):
        asked, target, slope = (a[rows].copy() for a in (request, twist, acceleration))
        asked[list(lost)] = np.nan
        s = np.zeros(len(asked), LIMITER)
        s["time_constant"], s["correction"], s["command"] = lag[rows], state[rows, :2], state[rows, 2:]
        bounds = np.tile(LIMITS, (len(asked), 1))
        over_rows(limit, asked, target, slope, bounds[:, :2], bounds[:, 2:], 0.01, s)
        return s

    together = answer(slice(None), lost=[1])
    for i in (0, 2, 3):
        assert together[i].tobytes() == answer(slice(i, i + 1))[0].tobytes()
