"""L1 adaptation against the matrix exponential, against the closed form of the scalar example, and its margins."""

import numpy as np
import pytest
from scipy.linalg import expm

from mrctl.control.design import design, plants
from mrctl.control.feedforward import Loop, Prior
from mrctl.control.l1 import L1, L1Adaptive
from mrctl.theory.dynamics import inverse_coefficients
from mrctl.theory.linear import steering

PERIOD = 0.01
A, W = L1().predictor, L1().bandwidth
RNG = np.random.default_rng(4)


@pytest.mark.parametrize("delay", [0, 1, 3])
@pytest.mark.parametrize("rigid", [False, True])
def test_independent(robot, rigid, delay):
    """Predictor and adaptation as in the book, in matrices: σ̂ = −B⁻¹ Φ⁻¹ e^(A h) x̃, integrated by `expm`."""
    n, inputs = 50, RNG.uniform(-1, 1, (50, 4, 2))
    settings = L1(bandwidth=W, predictor=25.0)
    stage, prior = L1Adaptive(Loop(robot, rigid, PERIOD, delay), [settings]), Prior([robot], rigid)
    c = inverse_coefficients(robot)
    mass = np.diag([c[2, 0], max(steering(robot).lag, PERIOD) if rigid else c[3, 1]])
    am, b = -25.0 * np.eye(2), np.linalg.inv(mass)
    phi = np.linalg.inv(am) @ (expm(am * PERIOD) - np.eye(2))
    # d/dt (x̂, x, ẋ, u) = (A (x̂ − x) + B u, ẋ, 0, 0): the measured motion is a straight line, the input is held.
    system = np.zeros((8, 8))
    system[:2, :2], system[:2, 2:4], system[:2, 6:], system[2:4, 4:6] = am, -am, b, np.eye(2)
    period = expm(system * PERIOD)
    predicted, sigma, filtered, last = None, np.zeros(2), np.zeros(2), None
    for tick in range(n):
        command, derivative, twist, voltage = inputs[tick]
        np.testing.assert_allclose(stage.output(command[None], derivative[None])[0], -filtered, atol=1e-9)
        stage.prior = prior
        stage.learn(np.zeros((1, 2)), np.zeros(1), twist[None], voltage[None])
        x = twist - PERIOD * inputs[max(0, tick - delay) : tick, 1].sum(0)
        if tick > delay:
            before = inputs[tick - 1 - delay]
            rest = prior.output(last[None], np.zeros((1, 2)))[0]
            u = before[3].copy()
            if rigid:
                rest, u = np.array([rest[0], last[1]]), u + before[0] * [0, 1]
            state = np.concatenate([predicted, last, (x - last) / PERIOD, u - rest + sigma])
            predicted = (period @ state)[:2]
            sigma = -np.linalg.inv(b) @ np.linalg.inv(phi) @ expm(am * PERIOD) @ (predicted - x)
            filtered = filtered + (1 - np.exp(-W * PERIOD)) * (sigma - filtered)
        else:
            predicted = x
        last = x
    np.testing.assert_allclose(stage.rows["sigma"][0], sigma, rtol=1e-9)


def test_closed_form(robot):
    """A constant voltage σ on M ẋ = U + σ: σ̂ = e^(−a h) σ after one period, and the closed loop in closed form.

    U = −C σ̂ then leaves σ_n = σ − e^(−a h) σ (1 − e^(−ω h (n−1))) at tick n ≥ 1, whose sum over M is the motion.
    """
    plain = robot.model_copy(
        update={"com_offset": 0.0, "gear_loss": 0.0, "no_load_current": 0.0, "rolling_coefficient": 0}
    )
    prior = Prior([plain], False)
    prior.rows["c"][:, [0, 1, 4, 5, 6, 7]] = 0  # no other force than inertia
    mass = np.diag(prior.rows["c"][0, 2:4])
    stage, x, lost = L1Adaptive(Loop(plain, False, PERIOD), [L1()]), np.zeros(2), np.array([1.5, -0.7])
    decay, left = np.exp(-A * PERIOD), []
    for tick in range(200):
        voltage = stage.output(np.zeros((1, 2)), np.zeros((1, 2)))[0].copy()
        stage.prior = prior
        stage.learn(np.zeros((1, 2)), np.zeros(1), x[None], voltage[None])
        if tick:
            np.testing.assert_allclose(stage.rows["sigma"][0], decay * lost, rtol=1e-9)
        left.append(voltage + lost)
        x = x + PERIOD * (voltage + lost) / mass
    n = np.arange(1, 200)
    closed = np.outer(1 - decay * (1 - np.exp(-W * PERIOD * (n - 1))), lost)
    np.testing.assert_allclose(left[1:], closed, atol=1e-9)
    np.testing.assert_allclose(x, PERIOD * (lost + closed.sum(0)) / mass, rtol=1e-9)


def sensitivity(robot, channel, delay, bandwidth):
    """Peak of |1/(1 + L)| at the voltage, over the plants for which the PID is designed."""
    w = np.geomspace(1e-3, 1, 3000) * np.pi / PERIOD * (1 - 1e-9)
    z = np.exp(1j * w * PERIOD)
    gains = design(robot, False, delay * PERIOD)[channel]
    control = gains.k_p + gains.k_i * PERIOD * z / (z - 1)
    share = 1 - np.exp(-bandwidth * PERIOD)
    q = share * z / (z - 1 + share) * np.exp(-A * PERIOD)
    c = inverse_coefficients(robot)
    peaks = []
    for plant in plants(robot, False, channel):
        motion = plant.response(w, PERIOD) * z**-delay
        explained = c[2 + channel, channel] * (1 - 1 / z) / PERIOD + c[channel, channel] / z
        loop = (control + q / z * explained) * motion / (1 - q * z ** -(delay + 2))  # a stage answers one tick late
        peaks.append(np.abs(1 / (1 + loop)).max())
    return max(peaks)


@pytest.mark.parametrize("channel", [0, 1])
def test_margins(robot, channel):
    """With the PID of 10 ms of delay the sensitivity stays below 2; it does not with a bandwidth of 50 rad/s."""
    assert sensitivity(robot, channel, 0, W) < 1.8
    assert sensitivity(robot, channel, 1, W) < 1.9
    assert sensitivity(robot, channel, 2, W) < 2.0
    assert sensitivity(robot, 0, 1, 50.0) > 2.3


def test_steering(robot):
    """Under rigid steering σ is the rotation that comes without being asked for."""
    stage, prior = L1Adaptive(Loop(robot, True, PERIOD, 1), [L1()]), Prior([robot], True)
    command = np.array([[0.8, 0.5]])
    for _ in range(500):
        found = stage.output(command, np.zeros((1, 2))).copy()
        stage.prior = prior
        stage.learn(np.zeros((1, 2)), np.zeros(1), np.array([[0.8, 0.45]]), np.array([[9.0, 0.02]]))
    assert found[0, 1] == pytest.approx(np.exp(-A * PERIOD) * (0.5 + 0.02 - 0.45), rel=1e-6)
