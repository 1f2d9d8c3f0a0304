"""What holds for every learner, whatever its law."""

import numpy as np
import pytest

from mrctl import InputError, Scenario
from mrctl.control.feedforward import Loop, Prior
from mrctl.control.learners import LEARNERS

RNG = np.random.default_rng(9)
LAWS = [name for name in LEARNERS if name != "none"]
WITHOUT_WEIGHTS = [name for name in LAWS if LEARNERS[name].needs_model]


def learner(robot, name, size=1, rigid=False, delay=0):
    """Learners with their default settings, whose prior is the nominal model."""
    loop = Loop(robot, rigid, period=0.01, delay=delay, seeds=[7] * size)
    stage = LEARNERS[name](loop, [getattr(Scenario(), name)] * size)
    stage.prior = Prior([robot] * size, rigid)
    return stage


@pytest.mark.parametrize("rigid", [False, True])
@pytest.mark.parametrize("name", LAWS)
def test_rows(robot, name, rigid):
    """Robots do not mix: a row has the same bits alone and beside one that is lost."""
    inputs = RNG.uniform(-1, 1, (80, 4, 3, 2)) + [0.7, 0.0]

    def answer(rows, lost=()):
        stage, log = learner(robot, name, len(inputs[0, 0, rows]), rigid, delay=2), []
        for command, feedback, twist, voltage in inputs[:, :, rows].copy():
            twist[list(lost)] = np.nan
            log.append(stage.output(command, command).copy())
            log.append(stage.learn(feedback, np.zeros(len(command)), twist, voltage).copy())
        return np.array(log)

    together = answer(slice(None), lost=[1])
    for i in (0, 2):
        assert together[:, i].tobytes() == answer(slice(i, i + 1))[:, 0].tobytes()
        assert together[-2, i].any()


@pytest.mark.parametrize("name", WITHOUT_WEIGHTS)
def test_frozen(robot, name):
    """What has no weights goes on while nothing may be learned, hands nothing over, and forgets on `restore`."""
    stage, ones = learner(robot, name), np.ones((1, 2))
    for _ in range(20):
        stage.output(ones, ones)
        assert not stage.learn(ones, np.ones(1), ones, np.full((1, 2), 3.0)).any()
    assert stage.output(ones, ones).any()
    assert not stage.guarded and not stage.weight_norm.any()
    stage.restore(np.array([0]))
    assert not stage.output(ones, ones).any()


@pytest.mark.parametrize("name", WITHOUT_WEIGHTS)
def test_needs_a_model(name):
    """What compares the robot with a model is refused without one."""
    with pytest.raises(InputError, match=f"prior: the learner {name} compares the robot with a model; set prior to"):
        Scenario.from_dict({"prior": "none", "learner": name})
