"""INDI against filters of SciPy, against its closed form on plants of any kind, and its margins."""

import numpy as np
import pytest
from scipy.signal import lfilter, lfilter_zi

from mrctl.control.design import design, plants
from mrctl.control.feedforward import Loop, Prior
from mrctl.control.indi import IncrementalInversion, Indi
from mrctl.theory.dynamics import inverse_coefficients

PERIOD = 0.01
T = Indi().time_constant
RNG = np.random.default_rng(3)


def smooth(signal, first, time_constant=T):
    """1/(T s + 1)² by implicit Euler, which starts at `first`, along the first axis."""
    share = PERIOD / (PERIOD + time_constant)
    for _ in range(2):
        b, a = [share], [1, share - 1]
        signal = lfilter(b, a, signal, axis=0, zi=lfilter_zi(b, a)[:, None] * first)[0]
    return signal


def drive(stage, prior, inputs):
    """Outputs of a stage `(ticks, 2)` for commands, derivatives, predicted twists and voltages, `(ticks, 4, 2)`."""
    log = []
    for command, derivative, twist, voltage in inputs[:, :, None]:
        log.append(stage.output(command, derivative)[0].copy())
        stage.prior = prior
        stage.learn(np.zeros((1, 2)), np.zeros(1), twist, voltage)
    return np.array(log)


@pytest.mark.parametrize("delay", [0, 1, 3])
@pytest.mark.parametrize("rigid", [False, True])
def test_independent(robot, rigid, delay):
    """The output is H (U − M ẋ) less the model at the command; the voltage of a motion is delay + 1 ticks older."""
    n, inputs = 60, RNG.uniform(-1, 1, (60, 4, 2))
    found = drive(IncrementalInversion(Loop(robot, rigid, PERIOD, delay), [Indi()]), Prior([robot], rigid), inputs)
    command, derivative, twist, voltage = inputs.transpose(1, 0, 2)
    ahead = np.array([PERIOD * derivative[max(0, k - delay) : k].sum(0) for k in range(n)])
    x = twist - ahead
    prior, still = Prior([robot], rigid), np.zeros((1, 2))

    def rest(motion):
        return np.array([prior.output(one[None], still)[0] for one in motion])

    mass = np.diag(inverse_coefficients(robot)[2:4])
    sent = voltage + (command * [0, 1] if rigid else 0)
    made = mass * np.diff(x, axis=0) / PERIOD
    if rigid:
        made[:, 1] = x[1:, 1]
    measured = sent[: n - 1 - delay] - made[delay:]  # the motion from tick k − 1 to k, for k = delay + 1 …
    first = rest(x[delay : delay + 1])
    assert not found[: delay + 2].any()
    np.testing.assert_allclose(found[delay + 2 :], smooth(measured, first)[:-1] - rest(command)[delay + 2 :], atol=1e-9)


@pytest.mark.parametrize("delay", [0, 2])
def test_inversion(robot, delay):
    """Whatever the other forces are, ẋ = ν + M⁻¹ (H f − f), with H f as it was delay + 2 periods ago.

    The forces here are no part of the model: a cubic back-EMF, a swing in time and a coupling of the two channels.
    """
    mass = np.diag(inverse_coefficients(robot)[2:4])
    stage, prior = IncrementalInversion(Loop(robot, False, PERIOD, delay), [Indi()]), Prior([robot], False)
    x, nu, f, rate, first = np.array([0.5, 0.3]), [], [], [], None
    waiting = [prior.output(x[None], np.zeros((1, 2)))[0]] * delay
    ahead = [np.zeros(2)] * delay
    for tick in range(400):
        wanted = np.array([0.6 * np.cos(3 * PERIOD * tick), -0.4 * np.sin(5 * PERIOD * tick)])
        seen = x + PERIOD * np.sum(ahead, axis=0)
        voltage = prior.output(seen[None], wanted[None])[0] + stage.output(seen[None], wanted[None])[0]
        stage.prior = prior
        stage.learn(np.zeros((1, 2)), np.zeros(1), seen[None], voltage[None])
        force = np.array([9 * x[0] + 3 * x[0] ** 3 + np.sin(7 * PERIOD * tick), 2 * x[1] - x[0] * x[1] + 0.5])
        waiting.append(voltage)
        ahead = (ahead + [wanted])[1:]
        rate.append((waiting.pop(0) - force) / mass)
        nu.append(wanted)
        f.append(force)
        if tick == delay:
            first = prior.output(x[None], np.zeros((1, 2)))
        x = x + PERIOD * rate[-1]
    nu, f, rate = np.array(nu), np.array(f), np.array(rate)
    followed = smooth(f[delay:], first)
    ticks = np.arange(2 * delay + 2, 400)
    expected = nu[ticks - delay] + (followed[ticks - 2 * delay - 2] - f[ticks]) / mass
    np.testing.assert_allclose(rate[ticks], expected, atol=1e-9)


def test_constant_force(robot):
    """Where f does not change, ẋ = ν exactly, however wrong the model of f is."""
    mass = np.diag(inverse_coefficients(robot)[2:4])
    stage, prior = IncrementalInversion(Loop(robot, False, PERIOD), [Indi()]), Prior([robot], False)
    x = np.zeros(2)
    for tick in range(300):
        wanted = np.array([0.5 * np.cos(0.1 * tick), 0.3 * np.sin(0.2 * tick)])
        voltage = prior.output(x[None], wanted[None])[0] + stage.output(x[None], wanted[None])[0]
        stage.prior = prior
        stage.learn(np.zeros((1, 2)), np.zeros(1), x[None], voltage[None])
        rate = (voltage - [4.0, -3.0]) / mass
        x = x + PERIOD * rate
    np.testing.assert_allclose(rate, wanted, atol=1e-12)


def sensitivity(robot, channel, delay, time_constant, matched=True):
    """Peak of |1/(1 + L)| at the voltage, over the plants for which the PID is designed."""
    w = np.geomspace(1e-3, 1, 3000) * np.pi / PERIOD * (1 - 1e-9)
    z = np.exp(1j * w * PERIOD)
    gains = design(robot, False, delay * PERIOD)[channel]
    control = gains.k_p + gains.k_i * PERIOD * z / (z - 1)
    share = PERIOD / (PERIOD + time_constant)
    h = (share * z / (z - 1 + share)) ** 2
    mass = inverse_coefficients(robot)[2 + channel, channel]
    peaks = []
    for plant in plants(robot, False, channel):
        motion = plant.response(w, PERIOD) * z**-delay
        loop = control * motion + h / z * mass * (1 - 1 / z) / PERIOD * motion  # a stage answers one tick late
        peaks.append(np.abs(1 / (1 + loop / (1 - h * z ** -((delay if matched else 0) + 2)))).max())
    return max(peaks)


@pytest.mark.parametrize("channel", [0, 1])
def test_margins(robot, channel):
    """With the PID of 10 ms of delay the sensitivity stays below 2; it does not with filters of 10 ms."""
    assert sensitivity(robot, channel, 0, T) < 1.7
    assert sensitivity(robot, channel, 1, T) < 1.9
    assert sensitivity(robot, channel, 2, T) < 2.1
    assert sensitivity(robot, 0, 1, 0.01) > 2.3
    assert sensitivity(robot, 0, 2, T, matched=False) > sensitivity(robot, 0, 2, T) + 0.2


def test_identity():
    """1/(1 + loop) = (1 − H e^(−L's))/(1 + C P e^(−Ls)) for P = 1/(M s): the filter cannot make the loop unstable."""
    s = 1j * np.geomspace(0.1, 300, 1000)
    mass, late, later = 2.4, np.exp(-0.02 * s), np.exp(-0.03 * s)
    control, h, plant = 70 + 500 / s, 1 / (T * s + 1) ** 2, 1 / (mass * s)
    loop = (control * late + h * mass * s * later) * plant / (1 - h * later)
    np.testing.assert_allclose(1 / (1 + loop), (1 - h * later) / (1 + control * plant * late), rtol=1e-9)


def test_steering(robot):
    """Under rigid steering it adds the rotation that is asked for and does not come."""
    stage, prior = IncrementalInversion(Loop(robot, True, PERIOD, 1), [Indi()]), Prior([robot], True)
    command = np.array([[0.8, 0.5]])
    for _ in range(300):
        found = stage.output(command, np.zeros((1, 2))).copy()
        stage.prior = prior
        stage.learn(np.zeros((1, 2)), np.zeros(1), np.array([[0.8, 0.45]]), np.array([[9.0, 0.02]]))
    assert found[0, 1] == pytest.approx(0.5 + 0.02 - 0.45, rel=1e-6)
