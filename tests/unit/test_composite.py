"""Composite adaptation against a Kalman filter in matrices, and against equation (3) itself."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from mrctl.control.composite import (
    COMPOSITE,
    SCATTER_GAIN,
    STEERING_DISTURBANCE,
    Composite,
    CompositeAdaptation,
    predict,
    track,
)
from mrctl.control.features import REGRESSORS, feature_scale, regressor
from mrctl.control.feedforward import STEERING_SCALE, Loop, NoLearner, Prior
from mrctl.theory import dynamics
from mrctl.theory.dynamics import accelerations, inverse_coefficients, left_right

RNG = np.random.default_rng(8)
PERIOD = 0.01
N = REGRESSORS


def numbers(*shape, bound=3.0):
    return arrays(float, shape, elements=st.floats(-bound, bound))


def many(*shape, bound=3.0):
    """More numbers than Hypothesis draws one by one: from a seed, in a range that it chooses."""
    return st.builds(
        lambda seed, size: size * np.random.default_rng(seed).uniform(-1, 1, shape),
        st.integers(0, 2**32 - 1), st.floats(0, bound),
    )  # fmt: skip


def spd(root):
    """A covariance from any square matrix."""
    found = root @ root.T + 0.01 * np.eye(len(root))
    return (found + found.T) / 2


def channel(variance, forgetting, noise, step=0.0, dead_zone=0.0):
    """A record with weights of this variance, and a disturbance of 0.5 V."""
    s = np.zeros(1, COMPOSITE)[0]
    s["f"], s["f"][:, N], s["stationary"] = forgetting, 0.9, np.diag([*variance, 0.25])
    s["noise"], s["step"], s["dead_zone"], s["power"] = noise, step, dead_zone, 1.0
    s["P"] = s["stationary"]
    return s


def adapt(k, x, residual, command, feedback, s):
    """One composite step of one channel at these features of measured and commanded motion."""
    s["phi"], s["past"], s["residual"][k] = np.append(x, 1), np.append(command, 1), residual
    predict(k, s)
    track(k, feedback, s)


@given(
    many(N), many(N), many(N + 1), many(N + 1, N + 1, bound=1), numbers(N),
    st.floats(-20, 20), st.floats(-3, 3), st.floats(0.1, 2), st.floats(0, 1), st.integers(0, 1),
)  # fmt: skip
def test_one_step(x, command, weights, root, spread, residual, feedback, noise, step, k):
    """Correction, prediction to the stationary prior, tracking: each as in the books, in matrices."""
    covariance, stationary = spd(root), np.diag([*spread**2, 0.25])
    h, f = np.append(x, 1), np.append(np.full(N, 0.99), 0.9)
    total = h @ covariance @ h + noise**2
    innovation = np.clip(residual - h @ weights, -3 * np.sqrt(total), 3 * np.sqrt(total))
    gain = covariance @ h / total
    expected = f * (weights + gain * innovation)
    joseph = np.eye(N + 1) - np.outer(gain, h)
    posterior = joseph @ covariance @ joseph.T + noise**2 * np.outer(gain, gain)
    predicted = np.diag(f) @ posterior @ np.diag(f) + stationary - np.diag(f) @ stationary @ np.diag(f)
    direction = predicted[:N, :N] @ command
    if abs(feedback) > 0.1 and command @ direction > 1e-9:
        expected[:N] += step * feedback * direction / (command @ direction)
    s = channel(spread**2, 0.99, noise, step, dead_zone=0.1)
    s["a"][k], s["P"][k] = weights, covariance
    adapt(k, x, residual, command, feedback, s)
    np.testing.assert_allclose(s["P"][k], predicted, atol=1e-9)
    np.testing.assert_allclose(s["a"][k], expected, atol=1e-7, rtol=1e-7)


@given(many(40, N), numbers(N).map(lambda x: x**2 + 0.01), st.floats(0.5, 0.9999))
def test_covariance(inputs, variance, forgetting):
    """From the prior on, it stays symmetric, positive and below the prior: nothing that is not excited blows up."""
    s = channel(variance, forgetting, noise=0.5, step=0.02)
    stationary = s["P"][0].copy()
    for x in inputs:
        adapt(0, x, 1.0, x, 1.0, s)
        covariance = s["P"][0]
        np.testing.assert_array_equal(covariance, covariance.T)
        assert np.linalg.eigvalsh(covariance).min() > 0
        assert np.linalg.eigvalsh(stationary - covariance).min() > -1e-9


def test_outlier():
    """A sample a thousand times too large moves the weights as far as one of three standard deviations."""
    moved = []
    for residual in (3 * np.sqrt(1.25 + N), 1e4):
        s = channel(np.ones(N), 1.0, noise=1.0)
        adapt(0, np.ones(N), residual, np.zeros(N), 0.0, s)
        moved.append(s["a"][0])
    np.testing.assert_allclose(moved[0], moved[1], rtol=1e-12)
    assert moved[0].any()


@given(numbers(2), numbers(2), st.floats(-10, 10))
def test_regressor(robot, twist, rate, heading):
    """φ is the regressor of equation (3) over its scales, and the direction of the heading."""
    scale, phi = feature_scale(robot), np.empty(N)
    direction = np.array([np.cos(heading), np.sin(heading)])
    regressor(twist, rate, direction, robot.half_track, scale, phi)
    expected = dynamics.regressor(twist, rate, robot, sign_speed=0.05) / scale
    np.testing.assert_allclose(phi, [*expected, *direction], atol=1e-14)


def stage(robot, size=1, rigid=False, **settings):
    """Learners whose prior is the nominal model."""
    pupil = CompositeAdaptation(Loop(robot, rigid, PERIOD), [Composite(**settings)] * size)
    pupil.prior = Prior([robot] * size, rigid)
    return pupil


def total(pupil, command, derivative):
    """The voltage of prior and learner."""
    return pupil.prior.output(command, derivative) + pupil.output(command, derivative)


@pytest.mark.parametrize("rigid", [False, True])
def test_begins_as_model(robot, rigid):
    """Before it has seen anything it adds nothing to the model, nor while it may not learn."""
    pupil = stage(robot, 3, rigid)
    for _ in range(100):
        command, derivative = RNG.uniform(-1, 1, (2, 3, 2))
        assert not pupil.output(command, derivative).any()
        added = pupil.learn(RNG.normal(size=(3, 2)), np.ones(3), command, RNG.normal(size=(3, 2)))
        assert not added.any()
    assert not pupil.weight_norm.any()


def drive(pupil, plant, seconds, disturbance=0.0, watch=None):
    """Equation (3) under the stage and a proportional feedback along a rich motion; returns its feedback.

    The time goes on from where the last drive of this pupil ended.
    """
    start, twist = getattr(pupil, "driven", (0, np.array([0.8, 0.0])))
    log = []
    for tick in range(start, start + round(seconds / PERIOD)):
        t = PERIOD * tick
        w = np.array([[0.9, 2.3], [1.3, 3.1]])
        a = np.array([[0.25, 0.15], [0.8, 0.4]])
        command = np.array([0.8, 0.0]) + (a * np.sin(w * t)).sum(1)
        derivative = (a * w * np.cos(w * t)).sum(1)
        feedforward = total(pupil, command[None], derivative[None])[0]
        feedback = np.array([10.0, 2.0]) * (command - twist)
        voltage = feedback + feedforward
        pupil.learn(feedback[None], np.zeros(1), twist[None], voltage[None])
        if watch:
            watch(tick)
        log.append(feedback)
        sides = left_right(voltage - disturbance)
        for _ in range(4):
            twist = twist + PERIOD / 4 * accelerations(twist, sides, plant, sign_speed=0.05)
    pupil.driven = tick + 1, twist
    return np.array(log)


def openness(pupil):
    """How much of what plants differ in is still open in the two channels, `(2,)`."""
    return np.trace(pupil.rows["P"][0], axis1=1, axis2=2)


@pytest.mark.parametrize("changed", [{}, {"resistance": 3.0}, {"com_offset": 0.2}])
def test_change_of_the_plant(robot, changed):
    """Certainty grows with what is seen; both channels give it up when the plant changes, in whichever it shows."""
    pupil = stage(robot)
    plant = robot.model_copy(update={"supply": 1e3})
    drive(pupil, plant, 20)
    settled, spread, learned = openness(pupil), [], []

    def watch(_):
        spread.append(openness(pupil))
        learned.append((pupil.rows["a"][0, :, :REGRESSORS] ** 2).sum(1))

    assert (settled < 0.5 * openness(stage(robot))).all()
    drive(pupil, plant.model_copy(update=changed), 3, watch=watch)
    if changed:
        jumps = [1 + np.flatnonzero(np.diff(one) > one[0]) for one in np.transpose(spread)]
        first = jumps[0][0]
        assert first == jumps[1][0] < 100
        # As open as at the start, and beyond it what was learned: it may be undone. The trace of a aᵀ is |a|².
        np.testing.assert_allclose(spread[first] - openness(stage(robot)), learned[first], rtol=1e-6)
    else:
        assert (np.array(spread) <= settled * 1.01).all()


def test_push(robot):
    """What looks like another plant for a moment, and is none, takes nothing of what was known."""
    pupil, plant = stage(robot), robot.model_copy(update={"mass": 30.0, "supply": 1e3})
    drive(pupil, plant, 30)
    weights, certain = pupil.rows["a"][0, :, :REGRESSORS].copy(), openness(pupil)
    drive(pupil, plant, 0.3, disturbance=0.3)
    assert (openness(pupil) > 5 * certain).all()
    drive(pupil, plant, 5)
    assert np.linalg.norm(pupil.rows["a"][0, :, :REGRESSORS] - weights) < 0.2 * np.linalg.norm(weights)


@pytest.mark.parametrize("rigid", [False, True])
@pytest.mark.parametrize("channel", [0, 1])
def test_noise_counts(robot, channel, rigid):
    """Noise of the measurement is found from second differences alone; a sample counts less by as much.

    That of V counts as it is, that of θ̇ by the wheels' speed, D θ̇. With nothing open but the disturbance, a step of a
    Kalman filter takes its variance from p to p r/(p + r).
    """
    random = np.random.default_rng(3)
    pupil = stage(robot, rigid=rigid)
    sigma = np.array([0.02, 0.0]) if channel == 0 else np.array([0.0, 0.1])
    start = np.array([[0.8, 0.0]])
    voltage = total(pupil, start, np.zeros((1, 2)))
    for _ in range(3000):
        pupil.learn(np.zeros((1, 2)), np.ones(1), start + sigma * random.standard_normal(2), voltage)
    assert np.sqrt(pupil.rows["variance"][0, channel]) == pytest.approx(sigma[channel], rel=0.2)
    assert pupil.rows["variance"][0, 1 - channel] == 0
    settings = Composite()
    scale = np.array([1.0, STEERING_SCALE if rigid else 1.0])
    per_speed = scale * SCATTER_GAIN * [1.0, robot.half_track]
    noise = (scale * settings.noise) ** 2 + per_speed**2 * pupil.rows["variance"][0]
    pupil.rows["P"][:] = 0.0
    pupil.rows["P"][0, :, REGRESSORS, REGRESSORS] = before = 0.01
    pupil.learn(np.zeros((1, 2)), np.zeros(1), start, voltage)
    fading = np.exp(-2 * PERIOD / settings.disturbance_memory)
    deviation = settings.disturbance * np.array([1.0, STEERING_DISTURBANCE if rigid else 1.0])
    found = (pupil.rows["P"][0, :, REGRESSORS, REGRESSORS] - (1 - fading) * deviation**2) / fading
    variance = found * before / (before - found)
    np.testing.assert_allclose(variance, noise, rtol=0.05)


def test_finds_the_plant(robot):
    """Driving a plant that is not the model, the weights become what the coefficients of equation (3) differ by."""
    plant = robot.model_copy(update={"mass": 28.0, "yaw_inertia": 0.9, "resistance": 3.0, "supply": 1e3})
    pupil = stage(robot, noise=0.05, disturbance=0, step=0.002, memory=1e6)
    model = NoLearner(Loop(robot, False, PERIOD), [None])
    model.prior = Prior([robot], False)
    feedback, untaught = drive(pupil, plant, 40), drive(model, plant, 40)
    assert np.sqrt((feedback[-1000:] ** 2).mean()) < 0.06 * np.sqrt((untaught[-1000:] ** 2).mean())
    missing = ((inverse_coefficients(plant) - inverse_coefficients(robot)) * feature_scale(robot)[:, None]).T
    found = pupil.rows["a"][0]
    # The signs hardly move at these speeds and share a constant with V.
    for channel, feature in ((0, 2), (1, 3), (1, 4), (0, 5)):
        assert found[channel, feature] == pytest.approx(missing[channel, feature], rel=0.12, abs=0.02)
    assert abs(missing[0, 2]) > 0.5 and abs(missing[1, 3]) > 0.5


@pytest.mark.parametrize("period", [0.01, 0.05])
def test_finds_the_inertia(robot, period):
    """The inertia found is that of the plant to 0.2 %, although a sampled voltage acts during a whole period.

    The plant is the common channel with three times the mass and without friction; its motion between two samples is
    exact. With the speed at the end of the period the inertia would be too small by c_V h/2, 0.7 and 3.7 % here.
    """
    frictionless = {"no_load_current": 0.0, "gear_loss": 0.0, "rolling_coefficient": 0.0}
    plant = robot.model_copy(update=frictionless | {"mass": 3 * robot.mass})
    pupil = CompositeAdaptation(Loop(robot, False, period), [Composite(step=0, disturbance=0, memory=1e6)])
    pupil.prior = Prior([robot.model_copy(update=frictionless)], False)
    speed, inertia = inverse_coefficients(plant)[[0, 2], 0]
    v = 0.8
    for tick in range(round(60.0 / period)):
        w, a = np.array([0.9, 2.3, 5.1]), np.array([3.0, 2.0, 2.0])
        voltage = 12.0 + (a * np.sin(w * period * tick)).sum()
        total(pupil, np.array([[v, 0.0]]), np.zeros((1, 2)))
        pupil.learn(np.zeros((1, 2)), np.zeros(1), np.array([[v, 0.0]]), np.array([[voltage, 0.0]]))
        v = voltage / speed + (v - voltage / speed) * np.exp(-speed * period / inertia)
    found = pupil.prior.rows["c"][0, 2, 0] + pupil.parameters[0, 2, 0] / feature_scale(robot)[2]
    assert found == pytest.approx(inertia, rel=2e-3)


def test_disturbance(robot):
    """A constant voltage that goes astray is found by weights and disturbance together."""
    lost = np.array([1.0, -0.5])
    pupil = stage(robot)
    feedback = drive(pupil, robot.model_copy(update={"supply": 1e3}), 12, lost)
    start, end = np.abs(feedback[:200].mean(0)), np.abs(feedback[-500:].mean(0))
    assert (end < 0.1 * start).all()


def test_gates(robot):
    """At rest and while it may not learn the weights keep still, and the disturbance fades with its own time."""
    pupil = stage(robot)
    drive(pupil, robot.model_copy(update={"mass": 30.0, "supply": 1e3}), 3)
    for twist, idle in ((np.zeros((1, 2)), 0.0), (np.ones((1, 2)), 1.0)):
        for _ in range(100):  # until the filters are at rest too
            pupil.learn(np.ones((1, 2)), np.full(1, idle), twist, np.ones((1, 2)))
        kept = pupil.rows["a"].copy()
        assert kept[..., :REGRESSORS].any()
        kept[..., REGRESSORS] = 0.2
        pupil.rows["a"][:] = kept
        for _ in range(50):
            assert not pupil.learn(np.ones((1, 2)), np.full(1, idle), twist, np.ones((1, 2))).any()
        np.testing.assert_array_equal(pupil.rows["a"][..., :REGRESSORS], kept[..., :REGRESSORS])
        faded = 0.2 * np.exp(-50 * PERIOD / Composite().disturbance_memory)
        np.testing.assert_allclose(pupil.rows["a"][..., REGRESSORS], faded, rtol=1e-9)


def test_what_it_added(robot):
    """It reports what its weights added to the output for the same command, and leaves the disturbance out."""
    pupil = stage(robot)
    drive(pupil, robot.model_copy(update={"mass": 30.0, "supply": 1e3}), 3)
    command, derivative = np.array([[0.9, 0.4]]), np.array([[0.3, -0.5]])

    def learned():
        return pupil.output(command, derivative) - pupil.rows["a"][..., REGRESSORS]

    before = learned().copy()
    straight = np.array([[0.9, 0.0]])  # the output also turns with the heading
    added = pupil.learn(np.array([[0.5, -0.2]]), np.zeros(1), straight, np.array([[9.0, 1.0]])).copy()
    assert np.abs(added).min() > 1e-4
    np.testing.assert_allclose(learned() - before, added, atol=1e-12)


@pytest.mark.parametrize("rigid", [False, True])
def test_rows(robot, rigid):
    """Robots do not mix: a row has the same bits alone and beside others, one of which is lost."""
    inputs = RNG.uniform(-1, 1, (80, 5, 4, 2)) + [0.7, 0.0]

    def answer(rows, lost=()):
        pupil, log = stage(robot, len(inputs[0, 0, rows]), rigid), []
        for command, derivative, feedback, twist, voltage in inputs[:, :, rows].copy():
            twist[list(lost)] = np.nan
            log.append(pupil.output(command, derivative).copy())
            log.append(pupil.learn(feedback, np.zeros(len(command)), twist, voltage).copy())
        return np.array(log), pupil.rows["P"]

    together, covariance = answer(slice(None), lost=[2])
    for i in (0, 1, 3):
        alone, own = answer(slice(i, i + 1))
        assert together[:, i].tobytes() == alone[:, 0].tobytes()
        assert covariance[i].tobytes() == own[0].tobytes()
