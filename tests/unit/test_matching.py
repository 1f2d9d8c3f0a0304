"""Which output a feedback voltage answers: the queue, and the phase that the learner owes to the closed loop."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mrctl.control.design import plants
from mrctl.control.margins import sampled_loop
from mrctl.control.matching import HOLD_PERIODS, histories, recall
from mrctl.control.pid import Pid

PERIOD = 0.01


@given(st.integers(0, 5), st.integers(1, 40), st.sampled_from([8, 11]))
def test_recall(delay, ticks, width):
    """The queue gives back what it was given d + 2 ticks ago, and says when that is nothing yet."""
    queue, given_before = histories(1, delay, width)[0], []
    s = np.zeros(1, [("tick", "i8"), ("past", "f8", (width,))])[0]
    for tick in range(ticks):
        x = np.random.default_rng(tick).normal(size=width)
        answered = recall(x, queue, s)
        given_before.append(x)
        assert answered == (tick >= delay + HOLD_PERIODS)
        if answered:
            np.testing.assert_array_equal(s["past"], given_before[tick - delay - HOLD_PERIODS])


@pytest.mark.parametrize("delay", [1, 2], ids=["lab", "field"])
@pytest.mark.parametrize("channel", [0, 1])
def test_phase(robot, channel, delay):
    """With twice the loop gain, features of the same tick are wrong at the resonance, and those of d + 2 ticks are not.

    What a learner adds is answered by ½ (1 + T), T = L/(1 + L): half of it leaves the PID's integral at once.
    """
    frequency = np.linspace(0.5, 0.99 * np.pi / PERIOD, 3000)
    gains = Pid().channels(robot, False, delay * PERIOD, PERIOD)[channel]
    loop = sampled_loop(frequency, plants(robot, False, channel)[0], gains, PERIOD, delay * PERIOD)

    def wrong(stronger, late):
        """Where learning goes the wrong way, and |T|."""
        answer = stronger * loop / (1 + stronger * loop)
        return ((1 + answer) * np.exp(1j * frequency * PERIOD * late)).real < 0, np.abs(answer)

    bare, size = wrong(2.0, 0)
    peak = frequency[size.argmax()]
    assert size.max() > 1.9 and bare[np.abs(frequency - peak) < 1].all()
    matched, _ = wrong(2.0, delay + HOLD_PERIODS)
    assert not matched[frequency < 1.25 * peak].any()
    assert not wrong(1.0, delay + HOLD_PERIODS)[0][frequency < 0.75 * peak].any()  # the nominal robot has no resonance
