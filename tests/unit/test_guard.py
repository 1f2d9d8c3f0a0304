"""The guard's law against cases computed by hand: what it sees, what it does, when, and what it leaves alone."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import toeplitz
from scipy.optimize import linprog

from mrctl import InputError
from mrctl.control import guard as module
from mrctl.control.design import MotionDesign
from mrctl.control.feedforward import Loop
from mrctl.control.fel import FeedbackErrorLearning, Fel
from mrctl.control.fel_torch import ModuleLearning
from mrctl.control.guard import GUARD_ACTIONS, REASONS, Guard, fresh, guard
from mrctl.control.kanayama import Kanayama
from mrctl.control.nominal import NOMINAL
from mrctl.control.oscillation import DRIFT_FILTER, NOISE_FILTER
from mrctl.control.pid import PID, Pid
from mrctl.control.rejection import LinearLoop
from mrctl.control.rls import RecursiveLeastSquares, Rls
from mrctl.theory.linear import common, yaw

PERIOD = 0.01
SUPPLY, ROTATION = 24.0, 3.0
NO_NUMBER = (np.nan, 0.0)
GAINS = (0.1, 0.01), (0.5, 0.01)  # from 1 V to the errors of velocity and position; D is then 4.2 and 1.68 V


class Bench:
    """One robot's guard and what it is connected to, by default in peace."""

    def __init__(self, rigid=False, gains=GAINS, unaided=False, **settings):
        robot = np.zeros(1, NOMINAL)
        robot["supply"], robot["max_twist"], robot["rigid"] = SUPPLY, (1.5, ROTATION), rigid
        self.g = fresh([Guard(**settings)], robot, np.array([gains]), unaided)[0]
        self.rigid, self.pid, self.feedback = rigid, np.zeros(1, PID)[0], np.zeros(2)
        self.integral = self.pid["integral"]
        self.ticks = 0

    def tick(self, feedforward=(0, 0), nominal=(0, 0), feedback=(0, 0), error=0.0, slower=(0, 0), sent=None):
        self.feedback[:] = feedback
        nominal = np.array(nominal, float)
        voltage = nominal if sent is None else np.array(sent, float)
        self.pid["error"] = slower
        guard(
            self.g, np.array(feedforward, float), nominal, np.resize([*np.atleast_1d(error), 0.0, 0.0], 3), voltage,
            PERIOD, self.rigid, self.pid, self.feedback,
        )  # fmt: skip
        self.ticks += 1
        return GUARD_ACTIONS[int(self.g["action"])]

    def until(self, action, longest=100.0, **inputs):
        """Ticks until the guard does this."""
        for k in range(round(longest / PERIOD)):
            if self.tick(**inputs) == action:
                return k + 1
        raise AssertionError(f"never: {action}")

    @property
    def reason(self):
        return REASONS[int(self.g["reason"])]

    def play(self, wave, channel=0, deviation=1.0):
        """Feeds a wave as feedback, beside a learner that deviates by a multiple of D: s to a fallback, or None."""
        feedforward, pair = deviation * self.g["harmless"], np.zeros(2)
        for k, pair[channel] in enumerate(wave):
            if self.tick(feedforward, feedback=pair) == "fallback":
                return k * PERIOD
        return None


def sine(amplitude, frequency, duration=20.0):
    """A sin(2πft)."""
    return amplitude * np.sin(2 * np.pi * frequency * PERIOD * np.arange(round(duration / PERIOD)))


def passed(frequency):
    """Gain of the guard's band-pass, as designed in continuous time."""
    s = 2j * np.pi * frequency
    return abs(s * DRIFT_FILTER / (1 + s * DRIFT_FILTER) / (1 + s * NOISE_FILTER))


small = st.floats(-5, 5)


@given(st.lists(st.tuples(small, small, small, small), min_size=1, max_size=10))
@settings(max_examples=30)
def test_silent(inputs):
    """While nothing is wrong it passes on the same bits: U_ff to the plant, U_fb to the learner."""
    bench = Bench()
    for a, b, c, d in inputs:
        calm = np.array([a, b]) / 5, np.array([c, d]) / 5  # below the amplitude that counts
        assert bench.tick(feedforward=calm[0], feedback=calm[1]) == "none"
        assert np.array_equal(bench.g["output"], calm[0]) and np.array_equal(bench.g["teaching"], calm[1])
        assert np.array_equal(bench.feedback, calm[1]) and not bench.integral.any() and not bench.g["frozen"]


def test_off():
    """Switched off it passes on everything; the learner is taught with the share that the watch on the delay leaves."""
    bench = Bench(on=False)
    for values in ((100.0, -200.0), (np.nan, np.inf)):
        assert bench.tick(feedforward=values, feedback=(50, 60), error=9.0, slower=(9, 9)) == "none"
        np.testing.assert_array_equal(bench.g["output"], values)
        np.testing.assert_array_equal(bench.g["teaching"], (50, 60))
    bench.g["gain"] = 1 / 3
    bench.tick(feedback=(60, 30))
    assert bench.g["teaching"] == pytest.approx([20, 10])


@pytest.mark.parametrize(("rigid", "output"), [(False, (16.0, -8.0)), (True, (24.0, -3.0))])
def test_limit(rigid, output):
    """U_r,l = 32 ∓ 16 V shrinks to the supply, as the voltage does, a steering channel by itself; that is all."""
    bench = Bench(rigid=rigid)
    for _ in range(1000):
        assert bench.tick(feedforward=(32, -16)) == "none" and not bench.g["frozen"]
        np.testing.assert_allclose(bench.g["output"], output)


@pytest.mark.parametrize("channel", [0, 1])
@pytest.mark.parametrize("frequency", [0.7, 3.0, 6.0])
def test_oscillation(channel, frequency):
    """Eight periods beyond a quarter of D, and a learner that deviates as much, end in the fallback; less does not."""
    threshold = Bench().g["harmless"][channel] / 4 / passed(frequency)
    bench = Bench()
    time = bench.play(sine(1.2 * threshold, frequency), channel)
    assert bench.reason == "sustained oscillation" and 8 < time * frequency < 9
    assert Bench().play(sine(1.2 * threshold, frequency), channel, deviation=0.26) is not None
    assert Bench().play(sine(1.2 * threshold, frequency), channel, deviation=0.24) is None
    assert Bench().play(sine(0.8 * threshold, frequency), channel) is None


@given(st.floats(1, 20), st.floats(0.05, 0.49))
@settings(max_examples=20)
def test_slow(amplitude, frequency):
    """What a lap asks for is no oscillation of the loop, however large."""
    assert Bench().play(sine(amplitude, frequency)) is None


@pytest.mark.parametrize("step", [2.0, 10.0, -15.0])
def test_step_and_push(step):
    """A step, a pulse, and the ringing of a badly damped loop (ζ = 0.3) after either are not sustained."""
    t = PERIOD * np.arange(1000)
    quiet = sine(0.2, 2.0, duration=5)
    w = 2 * np.pi * 2
    ringing = np.exp(-0.3 * w * t) * np.sin(w * t)
    for event in (np.ones(1000), (t < 0.1) * 1.0, ringing, 1 - ringing):
        assert Bench().play(np.concatenate([quiet, quiet[-1] + step * event])) is None


def test_noise():
    """White noise of a fifth of D, five times that of the tier `field`, is not an oscillation."""
    for wave in np.random.default_rng(0).normal(size=(20, 2000)):
        assert Bench().play(0.2 * Bench().g["harmless"][0] * wave) is None


@pytest.mark.parametrize("rigid", [False, True])
@pytest.mark.parametrize("channel", [0, 1])
def test_region(channel, rigid):
    """A velocity error beyond the region ends what deviates by more than D; what deviates by less is not to blame."""
    deviation, slower = np.zeros(2), np.zeros(2)
    bench = Bench(rigid=rigid)
    bound, region = bench.g["harmless"][channel], bench.g["region"][channel]
    assert region == pytest.approx(0.28 * (1.5, ROTATION)[channel])
    assert bound == pytest.approx(region / GAINS[channel][0])
    deviation[channel], slower[channel] = bound, region
    nominal = np.array([10.0, 0.5])
    for sign in (1, -1):
        assert bench.tick(feedforward=nominal + 0.999 * deviation, nominal=nominal, slower=2 * sign * slower) == "none"
        assert bench.tick(feedforward=nominal + 1.001 * deviation, nominal=nominal, slower=slower * sign) == "none"
    assert bench.tick(feedforward=nominal + 1.001 * deviation, nominal=nominal, slower=1.001 * slower) == "fallback"
    assert bench.reason == "velocity far from the command"


def test_blame_fades():
    """What a learner did is to blame for an error soon after, and not for ever."""
    for pause, action in ((0.5, "fallback"), (1.0, "none")):
        bench = Bench()
        bench.tick(feedforward=(2 * bench.g["harmless"][0], 0))
        for _ in range(round(pause / PERIOD)):
            bench.tick()
        assert bench.tick(slower=(1, 0)) == action


@pytest.mark.parametrize("channel", [0, 1])
def test_slow_motion_controller(robot, channel):
    """The response of the posture to a voltage is summed to its end, and without a motion controller it has none."""
    gains, plant = Pid(time_constant=0.15).channels(robot, False), (common(robot), yaw(robot, 0.75))[channel]

    def loop(*k):
        over = MotionDesign(Kanayama(k_x=k[0], k_y=k[1], k_theta=k[2]), 0.05, (0.0, 0.0))
        return LinearLoop(robot, False, channel, plant, gains[channel], over, 0.75, 0.0, PERIOD)

    slow = loop(0.03, 0.02, 0.3)  # in some 30 s
    state, total = slow.pulse, np.zeros(2)
    for _ in range(40_000):
        velocity, position, heading = slow.errors @ state
        total, state = total + (abs(velocity), abs(position if channel == 0 else heading)), slow.step @ state
    velocity, posture = slow.sums()
    assert velocity == pytest.approx(total[0], rel=2e-3)
    assert posture == pytest.approx(total[1], rel=5e-3) if channel == 0 else posture > total[1]
    assert slow.sums()[1] > 1.05 * np.abs(slow.response(slow.pulse, 10)[1 + channel]).sum()  # of 10 s
    # The integral of the PI takes position and heading back, but not the lateral position.
    assert np.isfinite(loop(0, 0, 0).sums()).tolist() == [True, channel == 0]


@pytest.mark.parametrize(("unaided", "acts"), [(False, True), (True, False)])
def test_posture_without_a_prior(unaided, acts):
    """A learner without a prior may be where the lack of the model can take the robot, up to 0.45 m, and no farther.

    From 1 V a position error of 0.03 m can follow; the model asks for 8 V, so that 0.24 m may be its lack.
    """
    for posture, ends in ((0.2, acts), (0.3, True)):
        bench = Bench(gains=((0.1, 0.03), (0.5, 0.03)), unaided=unaided)
        bench.tick()
        assert (bench.tick(nominal=(8, 0), error=posture) == "fallback") == ends
    for posture, ends in ((0.44, acts), (0.46, True)):
        bench = Bench(gains=((0.1, 0.3), (0.5, 0.3)), unaided=unaided)
        bench.tick()
        assert (bench.tick(nominal=(8, 0), error=posture) == "fallback") == ends


@pytest.mark.parametrize("channel", [0, 1])
def test_forgotten(robot, channel):
    """What a learner did before the peak of its deviation decayed can leave a velocity error that nobody answers.

    A linear program finds the deviation, in steps of 4 ticks, that keeps the error within the region as long as it is
    to blame, 2.4 s, and then leaves the largest error with the slow PID of the paper. The guard does nothing.
    """
    gains, held, before = Pid(time_constant=0.15).channels(robot, False), 4, 60
    motion = MotionDesign(Kanayama(k_x=0.0, k_y=0.0, k_theta=0.0), 0.05, (0.0, 0.0))
    plant = common(robot) if channel == 0 else yaw(robot, 0.75)
    loop = LinearLoop(robot, False, channel, plant, gains[channel], motion, 0.75, 0.0, PERIOD)
    pulse = np.convolve(loop.response(loop.pulse)[0], np.ones(held))
    bench = Bench(gains=np.tile([loop.sums()[0], 1e-9], (2, 1)))
    within, region = bench.g["harmless"][channel], bench.g["region"][channel]
    largest, worst = 0.0, np.zeros(0)
    for after in (1, 2, 4, 8, 15):
        number = np.arange(before + after)
        step = toeplitz(pulse[held - 1 :: held][: len(number)], np.zeros(len(number)))
        bound = within * (1 + PERIOD / module.PEAK_DECAY) ** (held * np.maximum(before - 1 - number, 0))
        ends = np.minimum(bound, SUPPLY)[:, None] * (-1, 1)
        rows = np.vstack([step[:before], -step[:before]])
        found = linprog(-step[-1], rows, np.full(2 * before, 0.98 * region), bounds=ends, method="highs")
        if -found.fun > largest:
            largest, worst = -found.fun, np.repeat(0.995 * found.x, held)
    error = np.convolve(loop.response(loop.pulse)[0], worst)[: len(worst)]
    on = np.arange(2) == channel
    assert all(bench.tick(d * on, slower=e * on) == "none" for d, e in zip(worst, error, strict=True))
    assert 1.2 < np.abs(error).max() / region < 1.5


def test_position_bounds_the_deviation():
    """Where the posture is the weaker, its bound follows from it: both channels at once reach 0.15 m."""
    g = Bench(gains=((0.001, 0.05), (0.5, 0.01))).g
    found = g["harmless_to_posture"]
    assert found[0] * 0.05 == pytest.approx(module.TOLERATED_POSTURE / np.sqrt(2)) and found[0] < g["harmless"][0]
    assert found[1] == g["harmless"][1] == pytest.approx(g["region"][1] / 0.5)


def test_unstable_loop():
    """A loop that rejects nothing leaves no deviation harmless."""
    bench = Bench(gains=((np.inf, np.inf), (np.inf, np.inf)))
    assert bench.tick(feedforward=(1e-6, 0), slower=(1, 0)) == "fallback"


@pytest.mark.parametrize("fallback", ["model", "none"])
def test_fallback(fallback):
    """Nominal inverse dynamics or nothing in place of the learner; the voltage goes there without a jump.

    The integral takes what the nominal model lacked on average, 2 V here; what is left fades.
    """
    bench = Bench(fallback=fallback, fade=0.1)
    for _ in range(1000):
        bench.tick(feedforward=(7, 1), nominal=(5, 1), sent=(7, 1))
    bench.integral[:] = 0.5, -0.5
    feedback = np.array([0.6, -0.4])  # of which the integral is all but 0.1 V
    assert bench.tick(feedforward=(10, 2), nominal=(5, 1), feedback=feedback, sent=(7, 1), slower=(2, 0)) == "fallback"
    assert bench.g["forget"]
    np.testing.assert_allclose(bench.g["output"] + bench.feedback, (10.6, 1.6))  # 10 + 0.6, 2 − 0.4: no jump
    given = np.array([5.0, 1.0]) if fallback == "model" else np.zeros(2)
    np.testing.assert_allclose(bench.integral, np.array([7.0, 1.0]) - given, atol=1e-3)
    np.testing.assert_allclose(bench.feedback, bench.integral + 0.1)
    bump = bench.g["output"] - given
    for k in range(1, 30):
        integral = bench.integral.copy()
        bench.tick(feedforward=(-9, -9), nominal=(5, 1), feedback=(1, 1))
        np.testing.assert_allclose(bench.g["output"], given + bump * (0.1 / 0.11) ** k)
        np.testing.assert_array_equal(bench.integral, integral)
        assert not bench.g["forget"] and bench.g["frozen"]


def test_large_step():
    """Of a step in voltage beyond D, D fades; the rest is gone at once, as it would be one more disturbance."""
    bench = Bench()
    bounds = bench.g["harmless"].copy()
    assert bench.tick(feedforward=(12, -12), slower=(2, 0)) == "fallback"
    np.testing.assert_allclose(bench.g["output"], bounds * (1, -1))


def test_return():
    """After the first fallback the learner's share of the output grows from none to all over 5 s."""
    bench = Bench(hold=0.5)
    assert bench.tick(NO_NUMBER) == "fallback"
    assert bench.until("none", nominal=(4, 2)) == pytest.approx(50, abs=1)
    for k in range(0, 500, 100):
        np.testing.assert_allclose(bench.g["output"], (4 + k / 500 * 2, 2 - k / 500 * 2), atol=0.01)
        assert not bench.g["frozen"]
        for _ in range(100):
            bench.tick(feedforward=(6, 0), nominal=(4, 2))
    bench.tick(feedforward=(6, 0.7), nominal=(4, 2))
    np.testing.assert_array_equal(bench.g["output"], (6, 0.7))  # to the bit again


def test_back_off():
    """Each attempt waits three times as long, from the second on with a third of the gain; the last one ends it."""
    bench = Bench(hold=0.2, retries=3)
    for k in range(3):
        assert bench.tick(NO_NUMBER) == "fallback"
        bench.tick()
        assert bench.until("none") == pytest.approx(20 * 3**k, abs=2)
        bench.tick(feedback=(27, 27))
        np.testing.assert_allclose(bench.g["teaching"], 27 / 3**k)
    assert bench.tick(NO_NUMBER) == "fallback"
    with pytest.raises(AssertionError, match="never"):
        bench.until("none", longest=200)


def test_not_finite():
    """What is no number never reaches the plant, and does not come back while it is none."""
    bench = Bench(hold=0.3)
    bench.tick(feedforward=(2, 1), nominal=(3, 0))
    assert bench.tick(feedforward=(np.nan, 1), nominal=(3, 0)) == "fallback" and "finite" in bench.reason
    assert np.isfinite(bench.g["output"]).all() and np.isfinite(bench.integral).all()
    for _ in range(100):
        assert bench.tick(feedforward=(np.inf, 1), nominal=(3, 0)) == "fallback"
    np.testing.assert_allclose(bench.g["output"], (3, 0), atol=1e-3)
    assert bench.until("none", feedforward=(1, 1), nominal=(3, 0)) == pytest.approx(30, abs=1)


def test_far():
    """0.15 m is always tolerated, and so is a start half a metre off; growth to three times the least is not."""
    off = (6.0, 0.0)  # a learner that may be to blame
    bench = Bench()
    for _ in range(1000):
        assert bench.tick(off, error=0.05) == "none"
    assert bench.tick(off, error=0.149) == "none"
    assert bench.tick((0, 0), error=(0, 0, 0.19)) == "none"
    assert bench.tick(off, error=0.151) == "fallback" and bench.reason == "far from the reference"
    bench = Bench()
    for k in range(1000):
        assert bench.tick(off, error=0.5 * np.exp(-k / 200)) == "none"
    assert bench.tick(off, error=(0.0, 0.0, 0.21)) == "fallback" and bench.reason == "far from the reference"


def test_slow_growth():
    """An error that grows as slowly as it likes drags no bound along."""
    bench = Bench()
    for k in range(100_000):
        error = 0.02 * np.exp(k / 20_000)
        action = bench.tick((6.0, 0.0), error=error * np.sin(2 * np.pi * 0.05 * k * PERIOD))
        if action == "fallback":
            break
    assert 0.15 < error < 0.16


def test_broken_learner():
    """What its caller finds in the learner counts like an output that is not finite, for one tick."""
    bench = Bench(hold=0.3)
    bench.g["broken"] = True
    assert bench.tick((1, 1)) == "fallback" and "finite" in bench.reason and not bench.g["broken"]
    assert bench.until("none", feedforward=(1, 1)) == pytest.approx(30, abs=1)


@pytest.mark.parametrize("bad", [{"velocity": 0}, {"growth": 0.5}, {"fallback": "oracle"}, {"retries": -1}])
def test_bad_settings(bad):
    """Refused by name."""
    with pytest.raises(InputError, match=next(iter(bad))):
        Guard.from_dict(bad)


def stages(robot):
    """The stages that can forget."""
    torch.manual_seed(0)
    return {
        "fel": FeedbackErrorLearning(Loop(robot, False, PERIOD, seeds=[3, 4]), [Fel()] * 2),
        "rls": RecursiveLeastSquares(Loop(robot, False, PERIOD), [Rls()] * 2),
        "torch": ModuleLearning(torch.nn.Linear(8, 2), robot, 2),
    }


@pytest.mark.parametrize("name", ["fel", "rls", "torch"])
def test_restore(robot, name):
    """A robot that forgets goes on as one that never learned; the other keeps what it knows."""
    rng = np.random.default_rng(0)
    used, fresh, kept = (stages(robot)[name] for _ in range(3))

    def lesson(stage):
        for command, derivative, feedback in rng.normal(size=(20, 3, 2, 2)):
            stage.output(command, derivative)
            stage.learn(feedback, np.zeros(2), np.zeros((2, 2)), np.zeros((2, 2)))

    lesson(used)
    rng = np.random.default_rng(0)
    lesson(kept)
    assert (used.weight_norm > 0).all()
    used.restore(np.array([1]))
    assert used.weight_norm[1] == 0 and used.weight_norm[0] == kept.weight_norm[0]
    for _ in range(2):  # before and after it learns again
        command = np.array([[0.7, 0.3], [0.5, -1.0]])
        out, new, old = (np.array(stage.output(command, command)) for stage in (used, fresh, kept))
        assert np.array_equal(out[1], new[1]) and np.array_equal(out[0], old[0])
        assert not np.array_equal(old[1], new[1])
        seed = rng.integers(1000)
        for stage in (used, fresh, kept):
            rng = np.random.default_rng(seed)
            lesson(stage)
