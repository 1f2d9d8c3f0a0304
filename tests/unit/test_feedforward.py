"""The features and the feedforwards that do not learn, against equation (3)."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from mrctl.control.algebra import linear
from mrctl.control.features import FEATURE_NAMES, SIGN_SPEED, feature_matrix, feature_scale
from mrctl.control.feedforward import Loop, NoLearner, Prior
from mrctl.kernel import over_rows
from mrctl.theory import dynamics
from mrctl.theory.references import Lemniscate

RNG = np.random.default_rng(3)
COMMANDS, DERIVATIVES = RNG.uniform([-1.5, -3], [1.5, 3], (50, 2)), RNG.uniform([-1.5, -6], [1.5, 6], (50, 2))

UNUSED = np.full((50, 2), np.nan)  # measured twist and voltage, which these stages do not read


def numbers(*shape, bound=3.0):
    return arrays(float, shape, elements=st.floats(-bound, bound))


def test_features(robot):
    """The features are the regressor of the inverse dynamics over their scales."""
    scale = feature_scale(robot)
    found = feature_matrix(COMMANDS, DERIVATIVES, robot.half_track, scale) * scale
    expected = dynamics.regressor(COMMANDS, DERIVATIVES, robot, SIGN_SPEED)
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)
    assert len(FEATURE_NAMES) == expected.shape[-1]


def test_scales(robot):
    """On an ordinary lap every feature reaches a fair part of one, and none is far beyond."""
    _, twist, acceleration = Lemniscate().sample(np.linspace(0, 12, 600))
    peaks = np.abs(feature_matrix(twist, acceleration, robot.half_track, feature_scale(robot))).max(axis=0)
    assert (peaks > 0.2).all()
    assert (peaks < 2).all()


def test_inverse_dynamics(robot):
    """Priors are the corrected equation (3) solved for (U_Σ, U_Δ), a robot a row."""
    others = [robot.model_copy(update={"mass": 20.0 + i, "half_track": 0.15 + 0.001 * i}) for i in range(50)]
    others[7] = robot.model_copy(update={"drive_gain": 0.8, "resistance": 3.0, "gear_loss": 0.3})
    found = Prior(others, rigid=False).output(COMMANDS, DERIVATIVES)
    for row, other in enumerate(others):
        volts = dynamics.inverse_dynamics(COMMANDS[row], DERIVATIVES[row], other, sign_speed=SIGN_SPEED)
        np.testing.assert_allclose(found[row], dynamics.common_differential(volts), rtol=1e-12, atol=1e-12)


def test_rigid(robot):
    """Under rigid steering the second channel is the steering's, which needs no correction from the model."""
    free, rigid = (Prior([robot] * 50, r).output(COMMANDS, DERIVATIVES) for r in (False, True))
    np.testing.assert_array_equal(rigid[:, 0], free[:, 0])
    assert not rigid[:, 1].any()
    assert free[:, 1].all()


def test_set_robot(robot):
    """Changing one row changes that row alone, and to what it would have been from the start."""
    heavy = robot.model_copy(update={"mass": 30.0, "half_track": 0.2})
    stage = Prior([robot] * 4, rigid=False)
    slow, derivative = 0.05 * COMMANDS[:4], DERIVATIVES[:4]  # where the half track shows in the smooth signs
    before = stage.output(slow, derivative).copy()
    stage.set_robot(2, heavy)
    after = stage.output(slow, derivative)
    np.testing.assert_array_equal(np.delete(after, 2, 0), np.delete(before, 2, 0))
    alone = Prior([heavy], rigid=False).output(slow[2:3], derivative[2:3])
    np.testing.assert_array_equal(after[2], alone[0])
    assert (after[2] != before[2]).all()


def test_none(robot):
    """`none` gives nothing and learns nothing."""
    stage = NoLearner(Loop(robot, False, 0.01), [None] * 50)
    stage.learn(np.ones((50, 2)), np.zeros(50), UNUSED, UNUSED)
    np.testing.assert_array_equal(stage.output(COMMANDS, DERIVATIVES), np.zeros((50, 2)))


@given(numbers(4, 2), numbers(4, 2), arrays(float, 4, elements=st.floats(0.1, 0.4)), numbers(4, 8, 2))
def test_rows(command, derivative, half_track, coefficients):
    """Robots do not mix: a row has the same bits alone and beside others, one of which is lost."""
    scale = np.arange(1.0, 9)

    def answer(rows, lost=()):
        wanted = command[rows].copy()
        wanted[list(lost)] = np.nan
        x = feature_matrix(wanted, derivative[rows], half_track[rows], scale)
        voltage = np.zeros((len(x), 2))
        over_rows(linear, x, coefficients[rows], voltage)
        return np.hstack([x, voltage])

    together = answer(slice(None), lost=[0])
    for i in (1, 2, 3):
        assert together[i].tobytes() == answer(slice(i, i + 1))[0].tobytes()
