"""Recursive least squares against the Kalman filter in matrices, and against coefficients that are known."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from mrctl.control.features import FEATURES, REGRESSORS, feature_matrix, feature_scale
from mrctl.control.feedforward import Loop, Prior
from mrctl.control.matching import HOLD_PERIODS
from mrctl.control.rls import RLS, RecursiveLeastSquares, Rls, update
from mrctl.theory.dynamics import inverse_coefficients

PERIOD = 0.01
RNG = np.random.default_rng(5)
N = REGRESSORS


def draw(size):
    """Commands and derivatives (size, 2) of an ordinary robot."""
    return RNG.uniform([-1.5, -3], [1.5, 3], (size, 2)), RNG.uniform([-1.5, -6], [1.5, 6], (size, 2))


def numbers(*shape, bound=3.0):
    return arrays(float, shape, elements=st.floats(-bound, bound))


def record(drift, bound, dead_zone, second, step, covariance, coefficients=0.0):
    """A record of `RLS`, whose second channel takes a share `second` of a step."""
    s = np.zeros(1, RLS)[0]
    s["drift"], s["bound"], s["dead_zone"], s["step"] = drift, bound, dead_zone, step
    s["share"], s["P"], s["theta"] = (1.0, second), covariance, coefficients
    return s


def learn(stage, feedback, saturated=0.0):
    """One step of a stage, which does not read the voltage; the robot does not turn."""
    twist, unused = np.zeros(np.shape(feedback)), np.full(np.shape(feedback), np.nan)
    return stage.learn(np.asarray(feedback, float), np.broadcast_to(saturated, len(feedback)), twist, unused)


def inputs(command, derivative, robot):
    """Scaled features (n, 10) of a robot that has not turned."""
    x = feature_matrix(command, derivative, robot.half_track, feature_scale(robot))
    return np.hstack([x, np.broadcast_to([1.0, 0.0], (len(x), 2))])


def drive(stage, command, derivative):
    """The stage after it has driven one motion for as long as feedback takes to answer."""
    for _ in range(HOLD_PERIODS):
        stage.output(command, derivative)
        learn(stage, np.ones_like(command))
    assert not stage.weight_norm.any()
    return stage


@given(numbers(N), numbers(N, N, bound=1.0), numbers(N, 2), numbers(2), st.floats(0, 0.1), st.floats(0.05, 1))
def test_kalman(x, root, coefficients, feedback, drift, step_size):
    """One step is the Kalman filter of a random walk: K = P x/(R + xᵀP x), θ + K e, (I − K xᵀ) P + Q.

    R is 1, or what makes xᵀK the largest step that is allowed.
    """
    covariance = root @ root.T + 0.01 * np.eye(N)
    covariance = (covariance + covariance.T) / 2
    power = x @ covariance @ x
    noise = max(1.0, power * (1 / step_size - 1))
    gain = covariance @ x / (noise + power)
    posterior = (np.eye(N) - np.outer(gain, x)) @ covariance
    feedback += np.where(feedback < 0, -0.1, 0.1)  # outside the dead zone
    s = record(drift, 1.5, 0.05, 0.3, step_size, covariance, coefficients)
    update(x, feedback, s)
    np.testing.assert_allclose(s["theta"], coefficients + np.outer(gain, feedback * [1, 0.3]), atol=1e-10)
    variance = np.diag(posterior)
    clear = np.abs(variance - 1.5) > 1e-9  # at the bound itself rounding decides who drifts
    expected = posterior + drift * np.diag(variance < 1.5)
    np.testing.assert_allclose(s["P"][:, clear], expected[:, clear], atol=1e-10)
    assert s["norm"] == pytest.approx(np.linalg.norm(s["theta"]))


def test_learns_physics(robot):
    """Taught by what a model has and it lacks, it finds the model's coefficients."""
    teacher = Prior([robot] * 2, rigid=False)
    eager = Rls(step=1, initial_covariance=1000, drift=0, covariance_bound=1e-9, dead_zone=0)
    pupil = RecursiveLeastSquares(Loop(robot, False, PERIOD), [eager] * 2)
    first, driven = None, []
    for _ in range(200):
        driven.append(draw(2))
        pupil.output(*driven[-1])
        answered = driven[-HOLD_PERIODS - 1] if len(driven) > HOLD_PERIODS else driven[0]
        taught = np.einsum("bi,bik->bk", inputs(*answered, robot), pupil.rows["theta"])
        missing = teacher.output(*answered) - taught
        first = np.abs(missing).max() if first is None else first
        learn(pupil, missing)
    assert first > 1
    expected = inverse_coefficients(robot) * feature_scale(robot)[:, None]
    np.testing.assert_allclose(pupil.parameters, [expected] * 2, atol=2e-3)
    np.testing.assert_allclose(pupil.rows["theta"][:, FEATURES:], 0, atol=2e-3)
    np.testing.assert_allclose(pupil.weight_norm, np.linalg.norm(expected), rtol=1e-3)


def test_output(robot):
    """It begins with nothing; later it is the features times the coefficients."""
    stage, (command, derivative) = RecursiveLeastSquares(Loop(robot, False, PERIOD), [Rls()] * 3), draw(3)
    assert not stage.output(command, derivative).any()
    stage.rows["theta"][:] = RNG.normal(size=(3, N, 2))
    expected = np.einsum("bi,bik->bk", inputs(command, derivative, robot), stage.rows["theta"])
    np.testing.assert_allclose(stage.output(command, derivative), expected, atol=1e-12)


@pytest.mark.parametrize(("feedback", "saturated"), [([2.0, -3.0], 1.0), ([0.02, -0.02], 0.0)])
def test_frozen(robot, feedback, saturated):
    """A voltage that did not act, or feedback within the dead zone, teaches nothing."""
    settings = Rls(step=0.05, initial_covariance=0.05, drift=1e-3, covariance_bound=0.5, dead_zone=0.02)
    stage, coefficients = RecursiveLeastSquares(Loop(robot, False, PERIOD), [settings]), RNG.normal(size=(N, 2))
    drive(stage, *draw(1))
    stage.rows["theta"] = coefficients
    assert not learn(stage, [feedback], saturated).any()
    np.testing.assert_array_equal(stage.rows["theta"][0], coefficients)
    np.testing.assert_array_equal(stage.rows["P"][0], 0.05 * np.eye(N))
    assert learn(stage, [[2.0, -3.0]]).all()  # else it learns


def test_dead_zone_of_a_channel():
    """A channel within the dead zone keeps its coefficients while the other learns."""
    s = record(0.0, 0.05, 0.02, 1.0, 0.05, 0.05 * np.eye(N))
    update(np.ones(N), np.array([0.01, 1.0]), s)
    assert not s["theta"][:, 0].any()
    assert s["theta"][:, 1].all()


def test_steering_learns_slower(robot):
    """Under rigid steering the second channel takes a tenth of the step, the first all of it."""
    found = []
    command, derivative = draw(1)
    for rigid in (False, True):
        stage = drive(RecursiveLeastSquares(Loop(robot, rigid, PERIOD), [Rls()]), command, derivative)
        stage.output(command, derivative)
        learn(stage, [[1.0, 2.0]])
        found.append(stage.output(command, derivative)[0])
    np.testing.assert_allclose(found[1], found[0] * [1, 0.1], rtol=1e-12)
    assert (found[0] > 0).all()


@given(numbers(1, 2, bound=1.5), numbers(1, 2, bound=1.5), st.floats(0.01, 1), st.floats(1e-3, 1e3))
def test_step(robot, command, derivative, share, initial):
    """However uncertain it is, one step moves the feedforward by no more than its share of the feedback."""
    stage = RecursiveLeastSquares(Loop(robot, False, PERIOD), [Rls(step=share, initial_covariance=initial)])
    drive(stage, command, derivative).output(command, derivative)
    learn(stage, [[4.0, -2.0]])
    moved = stage.output(command, derivative)[0] / [4, -2]
    assert (moved >= 0).all()
    assert (moved <= share * (1 + 1e-9)).all()


@given(numbers(60, N), st.floats(0, 1e-2), st.floats(1e-3, 1), st.floats(1e-3, 1e3))
def test_covariance(inputs, drift, bound, initial):
    """Through any inputs the covariance stays symmetric, positive definite and bounded."""
    s = record(drift, bound, 0.0, 1.0, 0.05, initial * np.eye(N))
    for x in inputs:
        update(x, np.ones(2), s)
    covariance = s["P"]
    np.testing.assert_array_equal(covariance, covariance.T)
    assert np.linalg.eigvalsh(covariance).min() > 0
    assert np.diag(covariance).max() <= max(initial, bound + drift) * (1 + 1e-12)


def test_no_excitation():
    """At rest, where the regressor vanishes, the covariance grows to its bound and no further."""
    s = record(1e-3, 0.05, 0.0, 1.0, 0.05, 0.01 * np.eye(N))
    for _ in range(500):
        update(np.zeros(N), np.ones(2), s)
    covariance = s["P"]
    np.testing.assert_allclose(covariance, np.diag(np.diag(covariance)))
    assert (np.diag(covariance) >= 0.05).all()
    assert (np.diag(covariance) <= 0.051).all()
    assert not s["theta"].any()


@pytest.mark.filterwarnings("ignore:invalid value")
@given(numbers(4, N), numbers(4, 2), arrays(float, 4, elements=st.sampled_from([0.0, 1.0])), numbers(4, N, 2))
def test_rows(robot, x, feedback, saturated, coefficients):
    """Robots do not mix: a row has the same bits alone and beside others, one of which is lost."""
    settings = Rls(step=0.05, initial_covariance=0.05, drift=1e-3, covariance_bound=0.05, dead_zone=0.02)

    def answer(rows, lost=()):
        stage = RecursiveLeastSquares(Loop(robot, True, PERIOD), [settings] * len(x[rows]))
        stage.rows["x"], stage.rows["theta"] = x[rows], coefficients[rows]
        stage.rows["x"][list(lost)] = np.nan
        added = learn(stage, feedback[rows], saturated[rows])
        parts = zip(stage.rows, stage.weight_norm, added, strict=True)
        return [b"".join(part.tobytes() for part in row) for row in parts]

    together = answer(slice(None), lost=[2])
    for i in (0, 1, 3):
        assert together[i] == answer(slice(i, i + 1))[0]
