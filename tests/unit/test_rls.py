"""Recursive least squares against the Kalman filter in matrices, and against coefficients that are known."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from mrctl.control.feedforward import InverseDynamics, feature_scale, features
from mrctl.control.rls import RecursiveLeastSquares, Rls, update
from mrctl.theory.dynamics import inverse_coefficients

RNG = np.random.default_rng(5)


def draw(size):
    """Commands and derivatives (size, 2) of an ordinary robot."""
    return RNG.uniform([-1.5, -3], [1.5, 3], (size, 2)), RNG.uniform([-1.5, -6], [1.5, 6], (size, 2))


def numbers(*shape, bound=3.0):
    return arrays(float, shape, elements=st.floats(-bound, bound))


def step(x, feedback, saturated=0.0, settings=(0.0, 0.05, 0.0, 1.0, 1.0), coefficients=None, covariance=None):
    """Coefficients, covariance and norm after one step of one robot."""
    coefficients = np.zeros((8, 2)) if coefficients is None else coefficients.copy()
    covariance = 0.05 * np.eye(8) if covariance is None else covariance.copy()
    norm = np.zeros(1)
    update(x, np.asarray(feedback, float), saturated, np.array(settings), coefficients, covariance, norm)
    return coefficients, covariance, norm[0]


@given(numbers(8), numbers(8, 8, bound=1.0), numbers(8, 2), numbers(2), st.floats(0, 0.1), st.floats(0.05, 1))
def test_kalman(x, root, coefficients, feedback, drift, step_size):
    """One step is the Kalman filter of a random walk: K = P x/(R + xᵀP x), θ + K e, (I − K xᵀ) P + Q.

    R is 1, or what makes xᵀK the largest step that is allowed.
    """
    covariance = root @ root.T + 0.01 * np.eye(8)
    covariance = (covariance + covariance.T) / 2
    power = x @ covariance @ x
    noise = max(1.0, power * (1 / step_size - 1))
    gain = covariance @ x / (noise + power)
    posterior = (np.eye(8) - np.outer(gain, x)) @ covariance
    feedback += np.where(feedback < 0, -0.1, 0.1)  # outside the dead zone
    found = step(x, feedback, 0.0, (drift, 1.5, 0.05, 0.3, step_size), coefficients, covariance)
    np.testing.assert_allclose(found[0], coefficients + np.outer(gain, feedback * [1, 0.3]), atol=1e-10)
    variance = np.diag(posterior)
    clear = np.abs(variance - 1.5) > 1e-9  # at the bound itself rounding decides who drifts
    expected = posterior + drift * np.diag(variance < 1.5)
    np.testing.assert_allclose(found[1][:, clear], expected[:, clear], atol=1e-10)
    assert found[2] == pytest.approx(np.linalg.norm(found[0]))


def test_learns_physics(robot):
    """Taught by what an oracle has and it lacks, it finds the oracle's coefficients."""
    teacher = InverseDynamics([robot] * 2, rigid=False)
    eager = Rls(step=1, initial_covariance=1000, drift=0, covariance_bound=1e-9, dead_zone=0)
    pupil = RecursiveLeastSquares(robot, [eager] * 2, rigid=False)
    first = None
    for _ in range(200):
        command, derivative = draw(2)
        missing = teacher.output(command, derivative) - pupil.output(command, derivative)
        first = np.abs(missing).max() if first is None else first
        pupil.learn(missing, np.zeros(2), None, None)
    assert first > 1
    expected = inverse_coefficients(robot) * feature_scale(robot)[:, None]
    np.testing.assert_allclose(pupil.state["coefficients"], [expected] * 2, atol=2e-3)
    np.testing.assert_allclose(pupil.weight_norm, np.linalg.norm(expected), rtol=1e-3)


def test_output(robot):
    """It begins with nothing; later it is the features times the coefficients."""
    stage, (command, derivative) = RecursiveLeastSquares(robot, [Rls()] * 3, rigid=False), draw(3)
    assert not stage.output(command, derivative).any()
    stage.state["coefficients"][:] = RNG.normal(size=(3, 8, 2))
    x = features(command, derivative, robot.half_track, feature_scale(robot))
    expected = np.einsum("bi,bik->bk", x, stage.state["coefficients"])
    np.testing.assert_allclose(stage.output(command, derivative), expected, atol=1e-12)


@pytest.mark.parametrize(("feedback", "saturated"), [([2.0, -3.0], 1.0), ([0.02, -0.02], 0.0)])
def test_frozen(feedback, saturated):
    """A voltage that did not act, or feedback within the dead zone, teaches nothing."""
    coefficients = RNG.normal(size=(8, 2))
    found = step(np.ones(8), feedback, saturated, (1e-3, 0.5, 0.02, 1.0, 0.05), coefficients)
    np.testing.assert_array_equal(found[0], coefficients)
    np.testing.assert_array_equal(found[1], 0.05 * np.eye(8))


def test_dead_zone_of_a_channel():
    """A channel within the dead zone keeps its coefficients while the other learns."""
    found, _, _ = step(np.ones(8), [0.01, 1.0], settings=(0.0, 0.05, 0.02, 1.0, 0.05))
    assert not found[:, 0].any()
    assert found[:, 1].all()


def test_steering_learns_slower(robot):
    """Under rigid steering the second channel takes a tenth of the step, the first all of it."""
    found = []
    command, derivative = draw(1)
    for rigid in (False, True):
        stage = RecursiveLeastSquares(robot, [Rls()], rigid)
        stage.output(command, derivative)
        stage.learn(np.array([[1.0, 2.0]]), np.zeros(1), None, None)
        found.append(stage.output(command, derivative)[0])
    np.testing.assert_allclose(found[1], found[0] * [1, 0.1], rtol=1e-12)
    assert (found[0] > 0).all()


@given(numbers(1, 2, bound=1.5), numbers(1, 2, bound=1.5), st.floats(0.01, 1), st.floats(1e-3, 1e3))
def test_step(robot, command, derivative, share, initial):
    """However uncertain it is, one step moves the feedforward by no more than its share of the feedback."""
    stage = RecursiveLeastSquares(robot, [Rls(step=share, initial_covariance=initial)], rigid=False)
    stage.output(command, derivative)
    stage.learn(np.array([[4.0, -2.0]]), np.zeros(1), None, None)
    moved = stage.output(command, derivative)[0] / [4, -2]
    assert (moved >= 0).all()
    assert (moved <= share * (1 + 1e-9)).all()


@given(numbers(60, 8), st.floats(0, 1e-2), st.floats(1e-3, 1), st.floats(1e-3, 1e3))
def test_covariance(inputs, drift, bound, initial):
    """Through any inputs the covariance stays symmetric, positive definite and bounded."""
    coefficients, covariance, norm = np.zeros((8, 2)), initial * np.eye(8), np.zeros(1)
    for x in inputs:
        update(x, np.ones(2), 0.0, np.array([drift, bound, 0.0, 1.0, 0.05]), coefficients, covariance, norm)
    np.testing.assert_array_equal(covariance, covariance.T)
    assert np.linalg.eigvalsh(covariance).min() > 0
    assert np.diag(covariance).max() <= max(initial, bound + drift) * (1 + 1e-12)


def test_no_excitation():
    """At rest, where the regressor vanishes, the covariance grows to its bound and no further."""
    coefficients, covariance, norm = np.zeros((8, 2)), 0.01 * np.eye(8), np.zeros(1)
    for _ in range(500):
        update(np.zeros(8), np.ones(2), 0.0, np.array([1e-3, 0.05, 0.0, 1.0, 0.05]), coefficients, covariance, norm)
    np.testing.assert_allclose(covariance, np.diag(np.diag(covariance)))
    assert (np.diag(covariance) >= 0.05).all()
    assert (np.diag(covariance) <= 0.051).all()
    assert not coefficients.any()


@pytest.mark.filterwarnings("ignore:invalid value")
@given(numbers(4, 8), numbers(4, 2), arrays(float, 4, elements=st.sampled_from([0.0, 1.0])), numbers(4, 8, 2))
def test_rows(x, feedback, saturated, coefficients):
    """Robots do not mix: a row has the same bits alone and beside others, one of which is lost."""
    settings = np.array([1e-3, 0.05, 0.02, 0.1, 0.05])

    def answer(rows, lost=()):
        inputs, theta = x[rows].copy(), coefficients[rows].copy()
        inputs[list(lost)] = np.nan
        covariance, norm = np.tile(0.05 * np.eye(8), (len(theta), 1, 1)), np.zeros(len(theta))
        update(inputs, feedback[rows], saturated[rows], settings, theta, covariance, norm)
        return [part.tobytes() for part in (theta, covariance, norm)], theta, covariance, norm

    _, theta, covariance, norm = answer(slice(None), lost=[2])
    for i in (0, 1, 3):
        assert [theta[i].tobytes(), covariance[i].tobytes(), norm[i].tobytes()] == answer(slice(i, i + 1))[0]
