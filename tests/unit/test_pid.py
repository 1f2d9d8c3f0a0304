"""The velocity feedback: its design, its closed loop, its safeguards, its margins."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy import signal
from scipy.optimize import brentq, minimize_scalar

from mrctl.control import design
from mrctl.control.margins import Gains, learning_ratio, margins, sampled_loop
from mrctl.control.pid import PID, Pid, imc, pid
from mrctl.kernel import over_rows
from mrctl.theory.linear import first_order

CLOSED = 0.15  # λ


def controllers(gains, size=1):
    """Records of `PID` with gains by name, as from `Pid.gains`."""
    s = np.zeros(size, PID)
    for name, values in gains.items():
        s[name] = values
    return s


def table(gains):
    """Gains by name as an array, a row a channel, a column a name."""
    return np.transpose(list(gains.values()))


def loop(gain, tau, gains, command, period, limit=np.inf, unwinding=True):
    """Twist and voltage (T, 2) of two plants K/(τs + 1) under the PID, exact between ticks."""
    s, voltage, excess, twist = controllers(gains)[0], np.zeros(2), np.zeros(2), np.zeros(2)
    decay = np.exp(-period / np.asarray(tau))
    twists, voltages = [], []
    for wanted in command:
        pid(wanted, twist, excess, period, s, voltage)
        applied = np.clip(voltage, -limit, limit)
        excess = applied - voltage if unwinding else excess
        twists.append(twist)
        voltages.append(applied)
        twist = decay * twist + (1 - decay) * np.asarray(gain) * applied
    return np.array(twists), np.array(voltages)


def plants(robot):
    return (
        np.array([robot.velocity_gain, robot.rotation_gain]),
        np.array([robot.velocity_time_constant, robot.rotation_time_constant]),
    )


def test_published_gains(robot):
    """The IMC gains of the default robot are the documented ones (to the digits given), and those of its numbers."""
    found = np.array(imc(robot, CLOSED))
    # M_e is published without the front wheel, 0.8 %.
    assert (np.abs(found - [[15.9, 68], [3.4, 12.9]]) < [[0.15, 0.5], [0.05, 0.05]]).all()
    # K_i = N k_M/(r λ) and K_p = M_e r R_a/(2 N k_M λ); about the yaw axis D K_i and J_e in place of M_e D.
    emf, drive = 43 * 0.0234, 3.4e-3 + 43**2 * 1.03e-6
    m_e = 20 + 2 * drive / 0.098**2 + 1e-3 / 0.075**2
    j_e = 0.6 + 20 * 0.1**2 + 2 * 0.188**2 * drive / 0.098**2
    half = 0.098 * 2.32 / (2 * emf * CLOSED)
    integral = emf / 0.098 / CLOSED
    np.testing.assert_allclose(found, [[m_e * half, integral], [j_e / 0.188 * half, 0.188 * integral]], rtol=1e-12)
    gains = Pid(time_constant=CLOSED, derivative_time=0.02, derivative_filter=0.04).gains(robot, rigid=False)
    assert list(gains) == ["k_p", "k_i", "k_d", "filter"]
    expected = np.hstack([found, 0.02 * found[:, :1], [[0.04], [0.04]]])
    np.testing.assert_allclose(table(gains), expected, rtol=1e-12)
    assert table(Pid(time_constant=0.15).gains(robot, rigid=True))[1].tolist() == [0.3, 5.0, 0.0, 0.03]


@pytest.mark.parametrize("closed", [0.05, 0.15, 0.4])
def test_closed_loop(robot, closed):
    """On its own design plant the loop answers a step as 1/(λs + 1)."""
    gain, tau = plants(robot)
    h = 2e-4
    t = h * np.arange(4000)
    gains = Pid(time_constant=closed).gains(robot, rigid=False)
    twists, _ = loop(gain, tau, gains, np.ones((4000, 2)), h)
    np.testing.assert_allclose(twists, np.tile(1 - np.exp(-t / closed), (2, 1)).T, atol=h / closed)


def test_antiwindup(robot):
    """After three seconds of asking for more than the supply can give, the loop recovers; without, it overshoots."""
    gain, tau = plants(robot)
    command = np.repeat([[3.0, 15.0], [1.0, 5.0]], 300, axis=0)
    gains = Pid(time_constant=CLOSED).gains(robot, rigid=False)
    outside = []
    for unwinding in (True, False):
        twists, voltages = loop(gain, tau, gains, command, 0.01, 24.0, unwinding)
        assert (voltages[290] == 24).all()
        late = np.abs(twists[300:] - command[300:]) > 0.05 * command[300:]
        outside.append(300 - np.argmax(late[::-1], axis=0))  # ticks until it stays within 5 %
    assert (outside[0] < 1.0 / 0.01).all()
    assert (outside[1] > 2 * outside[0]).all()


def test_derivative_filter():
    """The derivative is K_d s/(T_f s + 1) of the error by backward differences."""
    h, k_d, lag = 0.01, 0.7, 0.04
    error = np.append([0, 0], np.random.default_rng(0).normal(size=200))
    numerator, denominator, _ = signal.cont2discrete(([k_d, 0], [lag, 1]), h, method="backward_diff")
    expected = signal.lfilter(numerator.ravel(), denominator, error)
    s, output = controllers({"k_p": [0, 2], "k_d": [k_d, 0], "filter": lag})[0], np.zeros(2)
    for e, want in zip(error, expected, strict=True):
        pid(np.full(2, e), np.zeros(2), np.zeros(2), h, s, output)
        np.testing.assert_allclose(output, [want, 2 * e], atol=1e-12)


def test_no_kick_at_the_start():
    """A loop that starts with an error does not take it for a rate."""
    s, output = controllers({"k_p": 1, "k_d": 5, "filter": 0.01})[0], np.zeros(2)
    pid(np.ones(2), np.zeros(2), np.zeros(2), 0.01, s, output)
    np.testing.assert_array_equal(output, 1)


@pytest.mark.parametrize("k_i", [5.0, 50.0])
@pytest.mark.parametrize("k_p", [0.0, 0.01, 0.3])
def test_antiwindup_of_any_gains(k_p, k_i):
    """At its limit the integral stays beside it, also where K_p/K_i is shorter than a period."""
    s = controllers({"k_p": k_p, "k_i": k_i, "filter": 0.03})[0]
    output, excess = np.zeros(2), np.zeros(2)
    for _ in range(1000):
        pid(np.ones(2), np.zeros(2), excess, 0.01, s, output)
        excess = np.clip(output, -0.5, 0.5) - output
    assert (np.abs(s["integral"]) < 0.5 + 3 * max(k_p, 0.01 * k_i)).all()


GRID = np.geomspace(1e-2, 1e3, 200_001)


@pytest.mark.parametrize("delay", [0.005, 0.02, 0.04])
@pytest.mark.parametrize("closed", [0.1, 0.15])
def test_margins(closed, delay):
    """L = e^(−sT)/(λs) has margins in closed form; |1 + jλω e^(jωT)| = √2 ends its bandwidth."""
    found = margins(GRID, np.exp(-1j * GRID * delay) / (1j * GRID * closed))
    # |1 + L|² = 1 − 2 sin(ωT)/(λω) + 1/(λω)² is least a little before the phase turns over.
    least = minimize_scalar(
        lambda w: 1 - 2 * np.sin(w * delay) / (closed * w) + (closed * w) ** -2, bounds=(1, np.pi / delay)
    )
    expected = {
        "crossover": 1 / closed,
        "phase": 90 - np.degrees(delay / closed),
        "gain": np.pi * closed / (2 * delay),
        "delay": np.pi / 2 * closed - delay,
        "bandwidth": brentq(lambda w: abs(1 + 1j * closed * w * np.exp(1j * w * delay)) ** 2 - 2, 1, 4 / closed),
        "sensitivity": least.fun**-0.5,
    }
    assert found._asdict() == pytest.approx(expected, rel=1e-3)


def test_margins_of_other_gains():
    """A PI that cancels nothing, against the roots of its magnitude and phase."""
    gain, tau, gains, delay = 0.1, 0.25, Gains(20.0, 200.0), 0.01

    def phase(w):
        return np.arctan(w * gains.k_p / gains.k_i) - np.pi / 2 - np.arctan(w * tau) - w * delay

    def size(w):
        return gain * np.hypot(gains.k_p, gains.k_i / w) / np.hypot(1, w * tau)

    crossover = brentq(lambda w: size(w) - 1, 0.1, 100)
    inversion = brentq(lambda w: phase(w) + np.pi, 20, 1000)
    loop = size(GRID) * np.exp(1j * phase(GRID))
    found = margins(GRID, loop)
    assert found.crossover == pytest.approx(crossover, rel=1e-4)
    assert found.phase == pytest.approx(180 + np.degrees(phase(crossover)), rel=1e-3)
    assert found.gain == pytest.approx(1 / size(inversion), rel=1e-3)
    # Delayed by its delay margin the loop is on the brink.
    assert margins(GRID, loop * np.exp(-1j * GRID * found.delay)).phase == pytest.approx(0, abs=0.05)


@pytest.mark.parametrize("k_p", [40.0, 200.0, 1000.0])
def test_margins_of_unstable_loops(robot, k_p):
    """Multiplied by its gain margin, which is below one if the loop is unstable, the loop runs through −1."""
    plant, h, gains = design.plants(robot, False, 0)[0], 0.01, Gains(k_p, 300.0)
    frequency = np.geomspace(1, 0.999 * np.pi / h, 4000)
    found = margins(frequency, sampled_loop(frequency, plant, gains, h, 0.02))
    dense = np.linspace(40, 100, 400_001)
    loop = sampled_loop(dense, plant, gains, h, 0.02)
    through = np.argmin(np.abs(loop.imag))
    assert found.gain == pytest.approx(-1 / loop.real[through], rel=1e-4)
    assert np.abs(1 + found.gain * loop).min() < 1e-4
    assert (found.gain < 1) == (k_p > 100)
    assert not (found.phase > 0) == (k_p > 100)  # NaN where the gain never falls to one


def test_smallest_margins():
    """A resonance beyond the first crossover makes three of them; the smallest margins count, wherever they are."""
    w, resonance = GRID, 40.0
    loop = 10 / (1j * w) * resonance**2 / (resonance**2 - w**2 + 0.04j * resonance * w)
    found = margins(w, loop)
    magnitude, phase = np.abs(loop), np.angle(loop) % (-2 * np.pi)
    crossed = np.flatnonzero(np.diff(np.sign(magnitude - 1)))
    assert len(crossed) == 3
    assert found.phase == pytest.approx(180 + np.degrees(phase[crossed].min()), abs=0.05)
    assert found.crossover == pytest.approx(w[crossed[-1]], rel=1e-4)
    assert found.delay == pytest.approx(((np.pi + phase[crossed]) / w[crossed]).min(), rel=1e-3)
    assert found.gain == pytest.approx(0.04 * resonance / 10, rel=1e-3)  # at the resonance L is −10/(0.04 · 40)


def test_margins_of_a_stable_resonance():
    """Beyond −180° the margins count from −540°: with its delay margin added the closed loop has a pole on the axis."""
    w = GRID
    loop = 100 * np.exp(-0.25j * w) / (1j * w * (100 - w**2 + 0.2j * w))
    found = margins(w, loop)
    assert found.sensitivity < 1.5 and found.gain > 1
    crossed = np.flatnonzero(np.diff(np.sign(np.abs(loop) - 1)))
    angles = np.abs(np.degrees(np.angle(-loop[crossed])))
    assert len(crossed) == 3
    assert found.phase == pytest.approx(angles.min(), abs=0.1)
    assert found.crossover == pytest.approx(w[crossed[angles.argmin()]], rel=1e-4)
    # The least delay that moves a pole onto the axis: L(jω) e^(−jωT) = −1 at the last crossover.
    assert found.delay == pytest.approx((np.angle(-loop[crossed]) % (2 * np.pi) / w[crossed]).min(), rel=1e-3)
    brink, beyond = (margins(w, loop * np.exp(-1j * w * found.delay * factor)) for factor in (0.98, 1.02))
    assert brink.phase > 0 > beyond.phase and brink.gain > 1 > beyond.gain
    assert beyond.delay == pytest.approx(-0.02 * found.delay, rel=0.01)


def test_no_margins():
    """A loop that is never above one has no crossover and no bandwidth to speak of, and its gain margin is infinite."""
    found = margins(GRID, 0.5 / (1 + 1j * GRID))
    assert np.isnan([found.crossover, found.phase, found.delay, found.bandwidth]).all()
    assert found.gain == np.inf


def test_learning_ratio(robot):
    """K_p (B + b K_p) > M K_i with M = τ, B = 1, b = K; under the IMC rule 1 + τ/λ, the documented 2.6 and 2.7."""
    assert learning_ratio(0.1, 0.25, Gains(20.0, 200.0)) == pytest.approx(20 * (1 + 0.1 * 20) / (0.25 * 200))
    designs = zip(np.transpose(plants(robot)), imc(robot, CLOSED), strict=True)
    ratios = [learning_ratio(gain, tau, gains) for (gain, tau), gains in designs]
    np.testing.assert_allclose(ratios, 1 + plants(robot)[1] / CLOSED, rtol=1e-12)
    np.testing.assert_allclose(ratios, [2.6, 2.7], atol=0.06)


@pytest.mark.parametrize("delay", [0, 3])
def test_sampled_loop(robot, delay):
    """The loop on paper is that of the law itself: the response to a sine of the compiled PID on exact plants."""
    gain, tau = plants(robot)
    gains, h, ticks = Pid(time_constant=CLOSED).gains(robot, rigid=False), 0.01, 4000
    for harmonic in (1, 7, 40, 190):
        w = 2 * np.pi * harmonic / 400 / h
        command = np.repeat(np.sin(w * h * np.arange(ticks))[:, None], 2, axis=1)
        s, feedback, twist, decay = controllers(gains)[0], np.zeros(2), np.zeros(2), np.exp(-h / tau)
        answer, sent = [], [np.zeros(2)] * delay
        for wanted in command:
            pid(wanted, twist, np.zeros(2), h, s, feedback)
            answer.append(twist)
            sent.append(feedback.copy())
            twist = decay * twist + (1 - decay) * gain * sent[len(answer) - 1]
        found = np.fft.rfft(answer[-400:], axis=0)[harmonic] / np.fft.rfft(command[-400:], axis=0)[harmonic]
        loops = [
            sampled_loop(np.array([w]), first_order(k, t), Gains(k_p, k_i), h, delay * h)[0]
            for k, t, k_p, k_i in zip(gain, tau, gains["k_p"], gains["k_i"], strict=True)
        ]
        np.testing.assert_allclose(found, [loop / (1 + loop) for loop in loops], rtol=1e-9)


@pytest.mark.parametrize("rigid", [False, True])
def test_twice_as_fast(robot, rigid):
    """Half the time constant is twice every gain, in both channels of every steering arrangement."""
    normal, fast = (table(Pid(time_constant=closed).gains(robot, rigid)) for closed in (CLOSED, CLOSED / 2))
    np.testing.assert_allclose(fast[:, :3], 2 * normal[:, :3], rtol=1e-12)
    own = table(Pid(time_constant=CLOSED, steering_kp=0.7, steering_ki=0.0).gains(robot, rigid))
    np.testing.assert_array_equal(own[1, :2], [0.7, 0.0] if rigid else normal[1, :2])


def numbers(*shape, low=-5.0, high=5.0):
    return arrays(float, shape, elements=st.floats(low, high))


@given(numbers(4, 2), numbers(4, 2), numbers(4, 2, 4, low=0.01), numbers(4, 2), numbers(4, 7, low=0.0))
def test_rows(command, twist, gains, excess, state):
    """Robots do not mix: a row has the same bits alone and beside others, one of which is lost."""

    def answer(rows, lost=()):
        wanted, measured, design, cut, memory = (a[rows].copy() for a in (command, twist, gains, excess, state))
        measured[list(lost)] = np.nan
        names = "k_p", "k_i", "k_d", "filter"
        s = controllers({name: design[..., k] for k, name in enumerate(names)}, len(wanted))
        s["integral"], s["slope"], s["error"] = memory[:, :2], memory[:, 2:4], memory[:, 4:6]
        s["started"] = memory[:, 6] > 0
        output = np.zeros((len(wanted), 2))
        over_rows(pid, wanted, measured, cut, 0.01, s, output)
        return [volts.tobytes() + kept.tobytes() for volts, kept in zip(output, s, strict=True)]

    together = answer(slice(None), lost=[0])
    for i in (1, 2, 3):
        assert together[i] == answer(slice(i, i + 1))[0]
