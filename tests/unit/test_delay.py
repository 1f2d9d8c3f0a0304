"""The watch on the velocity loop: what it takes for an oscillation, and how the controllers are designed after it."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import lfilter

from mrctl import Guard, Kanayama, Scenario
from mrctl.control.delay import DELAY, FASTEST_COMMAND, LEAST, LONGEST, REST, STEP, SUSTAINED, watch_delay
from mrctl.control.design import motion
from mrctl.control.oscillation import DRIFT, SMOOTH, SWING, swing
from mrctl.control.pid import Pid
from mrctl.loop.hierarchy import Hierarchy
from mrctl.sensing.tiers import Sensing

PERIOD = 0.01
SCALE = np.array([24.0, 24.0])


def due(feedback, feedforward=None, scale=SCALE, on=True):
    """Times at which a move is due, for a PID output and a feedforward of two channels, `(T, 2)`."""
    s = np.zeros(1, DELAY)
    s["on"] = on
    times = []
    for k, value in enumerate(feedback):
        other = np.zeros(2) if feedforward is None else feedforward[k]
        watch_delay(value, other, scale, PERIOD, s[0])
        if s["due"][0]:
            times.append(k * PERIOD)
    return times


def wave(frequency, amplitude, channel=0, duration=4.0):
    """A sine of this frequency in rad/s on one channel, `(T, 2)`."""
    t = PERIOD * np.arange(round(duration / PERIOD))
    signal = np.zeros((len(t), 2))
    signal[:, channel] = amplitude * np.sin(frequency * t)
    return signal


def gain(frequency):
    """Amplitude that a sine of amplitude 1 has behind the two filters, from their transfer functions."""
    z = np.exp(1j * frequency * PERIOD)
    a, b = PERIOD / (SMOOTH + PERIOD), PERIOD / (DRIFT + PERIOD)
    low = a / (1 - (1 - a) / z)
    return abs(low * (1 - b / (1 - (1 - b) / z)))


def test_swing_is_two_filters():
    """The filters against scipy's recursion of the same two transfer functions."""
    x, s = np.random.default_rng(5).normal(size=500), np.zeros(1, SWING)[0]
    mine = [swing(value, 1, PERIOD, s) for value in x]
    a, b = PERIOD / (SMOOTH + PERIOD), PERIOD / (DRIFT + PERIOD)
    low = lfilter([a], [1, a - 1], x)
    np.testing.assert_allclose(mine, low - lfilter([b], [1, b - 1], low), rtol=0, atol=1e-12)


@settings(max_examples=60, deadline=None)
@given(frequency=st.floats(3, 100), ratio=st.floats(0.2, 5), channel=st.integers(0, 1))
def test_an_oscillation_is_fast_and_large(frequency, ratio, channel):
    """A sine counts where its half-wave is short enough and its amplitude, after the filters, above the threshold."""
    found = due(wave(frequency, ratio * LEAST * SCALE[0] / gain(frequency), channel))
    half = np.pi / frequency
    if half > FASTEST_COMMAND + PERIOD or ratio < 0.95:
        assert not found
    elif half < FASTEST_COMMAND - 2 * PERIOD and ratio > 1.3:  # the peak between two samples may be missed
        assert SUSTAINED * half - 0.1 <= found[0] <= (SUSTAINED + 4) * half + 0.1


def test_rest_between_moves():
    """An oscillation that goes on asks for the next move after the rest, not before."""
    found = due(wave(40.0, 5.0, duration=10.0))
    assert len(found) == 5
    assert np.diff(found) == pytest.approx(REST, abs=2 * PERIOD)


def test_what_is_no_oscillation():
    """A push that rings out, a swing of the feedforward itself, and a watch that is off."""
    t = PERIOD * np.arange(400)
    ring = np.zeros((400, 2))
    ring[:, 0] = 20.0 * np.exp(-0.5 * 40 * t) * np.sin(40 * np.sqrt(0.75) * t)  # ζ = 0.5
    assert not due(ring)
    own = wave(40.0, 3.0)
    assert due(own)
    assert not due(own, -1.0 * own)
    assert due(own, 0.5 * own)
    assert not due(own, on=False)


@pytest.mark.parametrize("tier", ["ideal", "lab", "field"])
@pytest.mark.parametrize("own", [None, 0.03])
def test_moves(robot, tier, own):
    """Motion controller and PID take turns; each has the gains of a robot that is designed for that delay."""
    scenario = Scenario(sensing=Sensing(tier=tier), pid=Pid(delay=own), learner="fel", kanayama=Kanayama(k_x=1.5))
    h = Hierarchy([scenario], robot)
    known = scenario.sensing.loop_delay(PERIOD) * PERIOD
    start = known if own is None else own

    def gains(delay):
        return Pid(delay=delay).gains(robot, False)

    for move in range(1, 5):
        h.state["delay"]["due"] = True
        h.answer()
        h.state["delay"]["due"] = False
        added, ahead = move // 2 * STEP, (move + 1) // 2 * STEP
        np.testing.assert_allclose(h.state["pid"]["k_p"][0], gains(start + added)["k_p"], rtol=1e-9)
        np.testing.assert_allclose(h.state["pid"]["k_i"][0], gains(start + added)["k_i"], rtol=1e-9)
        channels = Pid().channels(robot, False, start + ahead)
        designed = motion(robot, False, channels, known + ahead, PERIOD)
        k = h.state["kanayama"][0]
        assert k["k_x"] == 1.5  # which the scenario gives
        assert (k["k_y"], k["k_theta"]) == pytest.approx((designed.kanayama.k_y, designed.kanayama.k_theta))
        assert h.state["limiter"]["time_constant"][0] == pytest.approx(designed.prefilter)
        assert h.state["guard"]["gain"][0] == pytest.approx(3.0 ** -((move + 1) // 2))
        assert h.state["delay"]["added"][0] == pytest.approx(added)


def test_end_of_the_moves(robot):
    """After `LONGEST` nothing is added; new settings of the PID, and a new run, begin at the delay of the sensing."""
    h = Hierarchy([Scenario()] * 2, robot)
    first = h.state.copy()
    for _ in range(2 * round(LONGEST / STEP)):
        assert h.state["delay"]["on"][0]
        h.state["delay"]["due"][0] = True
        h.answer()
    assert not h.state["delay"]["on"][0] and h.state["delay"]["on"][1]
    assert h.state["delay"]["added"][0] == pytest.approx(LONGEST)
    assert np.all(h.state["pid"]["k_p"][0] < 0.5 * first["pid"]["k_p"][0])
    np.testing.assert_array_equal(h.state[1]["pid"], first[1]["pid"])
    h.set_pid(0, Pid())
    np.testing.assert_array_equal(h.state[0]["pid"], first[0]["pid"])
    h.renew(0, Scenario())
    assert h.state[0]["kanayama"] == first[0]["kanayama"] and h.state[0]["delay"] == first[0]["delay"]


@pytest.mark.parametrize("pid", [Pid(retune=False), Pid(time_constant=0.15)])
def test_gains_that_are_left_alone(robot, pid):
    """Switched off, or with gains that follow from λ and not from a delay, nothing watches."""
    assert not Hierarchy([Scenario(pid=pid, guard=Guard(on=False))], robot).state["delay"]["on"].any()
