"""The watch on the velocity loop: what it takes for an oscillation, and how the controllers are designed after it."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import lfilter

from mrctl import Guard, Kanayama, Scenario
from mrctl.control.delay import (
    DELAY,
    DELAY_STEP,
    FADING_TIME,
    GROWTH,
    LEARNER_MOVES,
    MAX_EXPLAINED,
    MAX_HALF_WAVE,
    MAX_MOVES,
    MIN_AMPLITUDE,
    MIN_MOVE_INTERVAL,
    MISMATCH,
    SUSTAINED_HALF_WAVES,
    watch_delay,
)
from mrctl.control.design import motion
from mrctl.control.oscillation import DRIFT_FILTER, NOISE_FILTER, SWING, swing
from mrctl.control.pid import Pid
from mrctl.loop.hierarchy import Hierarchy
from mrctl.loop.user_hierarchy import UserHierarchy
from mrctl.loop.user_stages import UserStage
from mrctl.sensing.tiers import Sensing

PERIOD = 0.01
SUPPLY = 24.0


def due(feedback, feedforward=None, nominal=None, on=True):
    """Times at which a move is due, for a PID output, a feedforward and a nominal voltage, `(T, 2)`."""
    s = np.zeros(1, DELAY)
    s["on"], s["least"], s["most_explained"] = on, MIN_AMPLITUDE * SUPPLY, MAX_EXPLAINED * SUPPLY
    times, nothing = [], np.zeros_like(feedback)
    others = (nothing if signal is None else signal for signal in (feedforward, nominal))
    for k, values in enumerate(zip(feedback, *others, strict=True)):
        watch_delay(*values, PERIOD, s[0])
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
    a, b = PERIOD / (NOISE_FILTER + PERIOD), PERIOD / (DRIFT_FILTER + PERIOD)
    low = a / (1 - (1 - a) / z)
    return abs(low * (1 - b / (1 - (1 - b) / z)))


def test_swing_is_two_filters():
    """The filters against scipy's recursion of the same two transfer functions."""
    x, s = np.random.default_rng(5).normal(size=500), np.zeros(1, SWING)[0]
    mine = [swing(value, 1, PERIOD, s) for value in x]
    a, b = PERIOD / (NOISE_FILTER + PERIOD), PERIOD / (DRIFT_FILTER + PERIOD)
    low = lfilter([a], [1, a - 1], x)
    np.testing.assert_allclose(mine, low - lfilter([b], [1, b - 1], low), rtol=0, atol=1e-12)


@settings(max_examples=60, deadline=None)
@given(frequency=st.floats(3, 100), ratio=st.floats(0.2, 5), channel=st.integers(0, 1))
def test_an_oscillation_is_fast_and_large(frequency, ratio, channel):
    """A sine counts where its half-wave is short enough and its amplitude, after the filters, above the threshold."""
    found = due(wave(frequency, ratio * MIN_AMPLITUDE * SUPPLY / gain(frequency), channel))
    half = np.pi / frequency
    if half > MAX_HALF_WAVE + PERIOD or ratio < 0.95:
        assert not found
    elif half < MAX_HALF_WAVE - 2 * PERIOD and ratio > 1.3:  # the peak between two samples may be missed
        assert SUSTAINED_HALF_WAVES * half - 0.1 <= found[0] <= (SUSTAINED_HALF_WAVES + 4) * half + 0.1


def test_rest_between_moves():
    """An oscillation that goes on asks for the next move after the rest, not before."""
    found = due(wave(40.0, 5.0, duration=10.0))
    assert len(found) == 5
    assert np.diff(found) == pytest.approx(FADING_TIME, abs=2 * PERIOD)


@settings(max_examples=40, deadline=None)
@given(doubling=st.floats(0.3, 4.0), frequency=st.floats(20, 60))
def test_growth_shortens_the_rest(doubling, frequency):
    """A wave that doubles within the rest is answered once it has doubled, but not sooner than `MIN_MOVE_INTERVAL`."""
    t = PERIOD * np.arange(600)
    swings = np.zeros((600, 2))
    swings[:, 0] = 2.0 * 2 ** (t / doubling) * np.sin(frequency * t)
    gaps = np.diff(due(swings))
    half = np.pi / frequency
    decay = doubling * np.log2(np.e) * half / MAX_HALF_WAVE  # in it the wave grows by what a peak decays in a half-wave
    assert len(gaps) >= 2
    expected = np.clip(doubling * np.log2(GROWTH), MIN_MOVE_INTERVAL, FADING_TIME)
    np.testing.assert_allclose(gaps, expected, atol=2 * PERIOD + 2 * half + decay)
    assert gaps.min() >= MIN_MOVE_INTERVAL - PERIOD / 2


def test_what_is_no_oscillation():
    """A push that rings out, a swing of the feedforward itself, and a watch that is off."""
    t = PERIOD * np.arange(400)
    ring = np.zeros((400, 2))
    ring[:, 0] = 20.0 * np.exp(-0.5 * 40 * t) * np.sin(40 * np.sqrt(0.75) * t)  # ζ = 0.5
    assert not due(ring)
    own = wave(40.0, 3.0)
    assert due(own) and 3.0 * gain(40.0) < MAX_EXPLAINED * SUPPLY
    assert not due(own, -1.0 * own)
    assert due(own, 0.5 * own)
    assert not due(own, None, own / (0.9 * MISMATCH))
    assert due(own, None, own / (3 * MISMATCH))
    assert not due(own, on=False)


@settings(max_examples=30, deadline=None)
@given(frequency=st.floats(20, 60), ratio=st.floats(0.3, 5), by=st.sampled_from(["feedforward", "nominal"]))
def test_explanation_is_bounded(frequency, ratio, by):
    """A swing that goes through feedforward or command as well counts beyond 15 % of the supply and the threshold."""
    bound = (MIN_AMPLITUDE + MAX_EXPLAINED) * SUPPLY / gain(frequency)
    own = wave(frequency, ratio * bound)
    found = due(own, **{by: 3.0 * own})
    if ratio < 0.95:
        assert not found
    elif ratio > 1.3:
        assert found


def move(hierarchy, row=0):
    """Lets one robot make its next move."""
    hierarchy.state["delay"]["due"][row] = True
    hierarchy.answer()
    hierarchy.state["delay"]["due"][row] = False


@pytest.mark.parametrize("tier", ["ideal", "lab", "field"])
@pytest.mark.parametrize("own", [None, 1 / 30])
@pytest.mark.parametrize("period", [0.01, 0.02])
def test_moves(robot, tier, own, period):
    """Motion controller and PID take turns; each has the gains of a robot that is designed for that delay."""
    scenario = Scenario(
        sensing=Sensing(tier=tier, delay=period), pid=Pid(delay=own), learner="fel", kanayama=Kanayama(k_x=1.5),
        control_period=period, motion_period=period,
    )  # fmt: skip
    h = Hierarchy([scenario], robot)
    known, step = scenario.sensing.loop_delay(period) * period, max(DELAY_STEP, period)
    start = known if own is None else own
    for done in range(6):
        pid, ahead = done // 2 * step, (done + 1) // 2 * step
        expected = Pid(delay=start + pid).gains(robot, False, known, period)
        np.testing.assert_allclose(h.state["pid"]["k_p"][0], expected["k_p"], rtol=1e-9)
        np.testing.assert_allclose(h.state["pid"]["k_i"][0], expected["k_i"], rtol=1e-9)
        channels = Pid(delay=start + ahead).channels(robot, False, known, period)
        designed = motion(robot, False, channels, known + ahead, period)
        k = h.state["kanayama"][0]
        assert k["k_x"] == 1.5  # which the scenario gives
        assert (k["k_y"], k["k_theta"]) == pytest.approx((designed.kanayama.k_y, designed.kanayama.k_theta))
        assert h.state["limiter"]["time_constant"][0] == pytest.approx(designed.prefilter)
        assert h.state["guard"]["gain"][0] == pytest.approx(3.0 ** -min(LEARNER_MOVES, (done + 1) // 2))
        assert h.state["delay"]["moves"][0] == done
        move(h)


def test_settings_during_a_run(robot):
    """After some moves new settings keep what the loop has shown, unless it is no longer watched; a new run forgets."""
    h = Hierarchy([Scenario()] * 2, robot)
    first = h.state.copy()
    for _ in range(3):
        move(h)
    assert np.all(h.state["pid"]["k_p"][0] < first["pid"]["k_p"][0])
    np.testing.assert_array_equal(h.state[1]["pid"], first[1]["pid"])
    slow, motions = h.state["pid"]["k_p"][0].copy(), h.state["kanayama"][0].copy()
    h.set_pid(0, Pid(derivative_time=0.01))
    np.testing.assert_array_equal(h.state["pid"]["k_p"][0], slow)
    h.set_kanayama(0, Kanayama())
    assert h.state["kanayama"][0] == motions
    move(h)
    assert np.all(h.state["pid"]["k_p"][0] < slow) and h.state["kanayama"]["k_y"][0] == motions["k_y"]
    h.set_pid(0, Pid(retune=False))
    np.testing.assert_array_equal(h.state[0]["pid"], first[0]["pid"])
    assert not h.state["delay"]["on"][0]
    h.renew(0, Scenario())
    assert h.state[0]["kanayama"] == first[0]["kanayama"] and h.state[0]["delay"] == first[0]["delay"]


def test_end_of_the_moves(robot):
    """After the last move the watch is off."""
    h = Hierarchy([Scenario()], robot)
    for _ in range(MAX_MOVES):
        assert h.state["delay"]["on"][0]
        move(h)
    assert not h.state["delay"]["on"][0]


@pytest.mark.parametrize("pid", [Pid(retune=False), Pid(time_constant=0.15)])
def test_gains_that_are_left_alone(robot, pid):
    """Switched off, or with gains that follow from λ and not from a delay, nothing watches."""
    assert not Hierarchy([Scenario(pid=pid, guard=Guard(on=False))], robot).state["delay"]["on"].any()


def test_steering_gains_of_ones_own(robot):
    """A steering channel whose gains are given is not watched, since they would not change."""
    rigid = Hierarchy([Scenario(steering="rigid", pid=Pid(steering_kp=p)) for p in (None, 0.3)], robot)
    least = rigid.state["delay"]["least"]
    assert least[0] == pytest.approx((MIN_AMPLITUDE * robot.supply, MIN_AMPLITUDE * robot.max_rotation))
    assert np.isinf(least[1, 1]) and least[1, 0] == least[0, 0]


def test_stages_of_ones_own(robot):
    """A feedback of the user's is never watched; beside a motion controller of the user's the PID alone gets slower."""

    class Still:
        def __init__(self, robot, size):
            self.size = size

        def reset(self, *_):
            pass

        def output(self, *_):
            return np.zeros((self.size, 2))

    def build(name):
        return UserHierarchy([Scenario()], robot, {name: UserStage(name, Still, robot, 1)})

    feedback, moved = build("feedback"), build("motion")
    assert not feedback.state["delay"]["on"][0]
    feedback.set_pid(0, Pid())
    assert not feedback.state["delay"]["on"][0]
    start = moved.state.copy()
    move(moved)
    assert moved.state["delay"]["moves"][0] == 2
    assert np.all(moved.state["pid"]["k_p"][0] < start["pid"]["k_p"][0])
    assert moved.state["limiter"]["time_constant"][0] == start["limiter"]["time_constant"][0]
