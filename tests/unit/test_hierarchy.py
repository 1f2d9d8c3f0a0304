"""The two levels wired together: rates, memory a robot, switches, and what comes out when nothing is wrong."""

import numpy as np
import pytest

from mrctl.control.composite import CompositeAdaptation
from mrctl.control.features import REGRESSORS
from mrctl.control.feedforward import NoLearner, Prior
from mrctl.control.fel import FeedbackErrorLearning, Fel
from mrctl.control.guard import Guard
from mrctl.control.kanayama import GAINS, Kanayama, kanayama, posture_error
from mrctl.control.observer import DisturbanceObserver
from mrctl.control.pid import Pid
from mrctl.control.rls import RecursiveLeastSquares
from mrctl.experiments.paper import IDEAL
from mrctl.kernel import over_rows
from mrctl.loop.courses import REFERENCE
from mrctl.loop.hierarchy import HAND_OVER_SHARE, Hierarchy
from mrctl.loop.user_hierarchy import UserHierarchy
from mrctl.loop.user_stages import UserFeedforward, UserStage
from mrctl.record import InputError
from mrctl.scenario import FEEDFORWARDS, Scenario
from mrctl.sensing.prediction import SEEN
from mrctl.theory.dynamics import inverse_dynamics
from mrctl.theory.robot import STEERINGS, Robot


def build(robot: Robot, size=1, **settings):
    """A hierarchy for B robots that differ in their seeds."""
    scenarios = [Scenario(seed=seed, **settings) for seed in range(size)]
    return Hierarchy(scenarios, robot)


def signals(size, ticks, seed=0):
    """Something to track that starts at rest: postures, twists, reference and its derivatives, (ticks, B, …)."""
    rng = np.random.default_rng(seed)
    t = 0.01 * np.arange(ticks)[:, None]
    phase, ones = rng.uniform(0, 1, size), np.ones(size)
    v, v_dot = 0.4 * (1 - np.cos(t)) * ones, 0.4 * np.sin(t) * ones
    omega, omega_dot = 0.5 * (1 - np.cos(2 * t)) * phase, np.sin(2 * t) * phase
    reference = np.stack([t * ones, np.sin(t) * ones, t * phase], -1)
    pose = reference + 0.05 * rng.normal(size=reference.shape)
    twist = np.stack([v, omega], -1)
    motion = np.concatenate([reference, twist, np.stack([v_dot, omega_dot], -1)], axis=-1)
    return pose, twist + 0.1 * rng.normal(size=twist.shape), motion, np.zeros((ticks, size))


def tick(hierarchy, pose, twist, motion, slip=0.0):
    """One control tick with these measurements and references, `(B, …)`; its output."""
    seen, reference = np.zeros(len(pose), SEEN), np.zeros(len(pose), REFERENCE)
    seen["pose"], seen["twist"], seen["slip"] = pose, twist, slip
    reference["pose"], reference["twist"], reference["acceleration"] = np.split(motion, [3, 5], axis=-1)
    return hierarchy.update(seen, reference)


def drive(hierarchy, inputs):
    """Outputs, errors, commands and flags of every tick, side by side."""
    log = []
    for arguments in zip(*inputs, strict=True):
        output = tick(hierarchy, *arguments)
        error = hierarchy.state["error"]
        log.append(np.hstack([output, error, hierarchy.command, hierarchy.derivative, hierarchy.feedback]))
    return np.array(log)


def weights(hierarchy):
    """What a learner knows of its robots, `(B, …)`; a disturbance, which fades while nothing is learned, is no part."""
    stage = hierarchy.learner
    if isinstance(stage, CompositeAdaptation):
        return stage.rows["a"][..., :REGRESSORS]
    return stage.rows["theta"] if isinstance(stage, RecursiveLeastSquares) else stage.weights


@pytest.mark.parametrize(
    ("learner", "kind"),
    [
        ("none", NoLearner), ("observer", DisturbanceObserver), ("fel", FeedbackErrorLearning),
        ("rls", RecursiveLeastSquares), ("composite", CompositeAdaptation),
    ],
)  # fmt: skip
def test_feedforwards(robot, learner, kind):
    """Each name is its law; before anything is learned the feedforward is the prior."""
    motion = np.ones((2, 2))
    for prior in ("model", "true_model", "none")[: 2 if learner == "observer" else 3]:
        hierarchy = build(robot, 2, prior=prior, learner=learner)
        assert type(hierarchy.learner) is kind
        known = Prior([robot] * 2, rigid=False).output(motion, motion)
        expected = 0.0 * known if prior == "none" else known
        np.testing.assert_array_equal(hierarchy.feedforward(motion, motion), expected)


def test_names():
    """Each name of a pair is that of its scenario; an observer without a model is refused in one line."""
    for name, pair in FEEDFORWARDS.items():
        assert Scenario(**pair).feedforward == name
    with pytest.raises(
        InputError, match="^prior: the learner observer compares the robot with a model; set prior to model$"
    ):
        Scenario.from_dict({"learner": "observer"})


@pytest.mark.parametrize("name", ["model", "true_model"])
def test_nothing_wrong(robot, name):
    """Where posture and twist are the reference's, the voltages are the inverse dynamics and the feedback is silent."""
    _, _, motion, slip = signals(1, 300)
    reference, twist, acceleration = np.split(motion, [3, 5], axis=-1)
    hierarchy = build(robot, **FEEDFORWARDS[name])
    log = drive(hierarchy, (reference, twist, motion, slip))[:, 0]
    expected = inverse_dynamics(twist[:, 0], acceleration[:, 0], robot, sign_speed=0.05)
    np.testing.assert_allclose(log[:, :2], expected, atol=1e-9)
    np.testing.assert_allclose(log[:, 7:11], np.hstack([twist[:, 0], acceleration[:, 0]]), atol=1e-12)
    np.testing.assert_allclose(log[:, 11:], 0, atol=1e-9)


def test_slow_motion_controller(robot):
    """A motion controller of 50 ms answers every fifth tick; between, its correction rides on the live reference."""
    hierarchy = build(
        robot, 2, learner="none", motion_period=0.05, prefilter=0.01, kanayama=Kanayama(k_x=3, k_y=25, k_theta=10)
    )
    inputs = pose, _, motion, _ = signals(2, 43)
    reference, twist = motion[..., :3], motion[..., 3:5]
    log = drive(hierarchy, inputs)
    errors, requests = np.zeros((9, 2, 3)), np.zeros((9, 2, 2))
    gains = np.array([(3.0, 25.0, 10.0)] * 2, GAINS)
    for k in range(9):
        over_rows(posture_error, pose[5 * k], reference[5 * k], errors[k])
        over_rows(kanayama, errors[k], twist[5 * k], gains, requests[k])
    np.testing.assert_array_equal(log[:, :, 4:7], np.repeat(errors, 5, axis=0)[:43])
    # Held for the five ticks, the prefilter (here one period) passes it wherever no limit acts.
    correction = np.repeat(requests - twist[::5], 5, axis=0)[:43]
    wish, command = twist + correction, log[:, :, 7:9]
    settled = np.arange(43) % 5 == 4
    close = np.isclose(command, wish, atol=1e-12)
    assert close[settled].mean() > 0.3
    step = np.abs(np.diff(command, axis=0)) / 0.01
    limited = np.isclose(step, [1.5, 6.0])
    assert (close[1:] | limited).all()


@pytest.mark.parametrize("every", [1, 5])
def test_motion_rate(robot, every):
    """The motion controller looks at the posture at its own rate alone."""
    hierarchy = build(robot, learner="none", motion_period=0.01 * every)
    inputs = signals(1, 21)
    log = drive(hierarchy, inputs)
    changed = np.flatnonzero((np.diff(log[:, 0, 4:7], axis=0) != 0).any(axis=1)) + 1
    assert changed.tolist() == list(range(every, 21, every))


@pytest.mark.parametrize("steering", STEERINGS)
@pytest.mark.parametrize("name", FEEDFORWARDS)
def test_rows(robot, name, steering):
    """Through the whole hierarchy robots keep to themselves: each has the same bits alone and among others."""
    body = robot.model_copy(update={"trail": 0.0}) if steering == "rigid" else robot
    inputs = signals(3, 120)
    off = Guard(on=False)  # the inputs are those of no robot, and the guard would reset the learners
    scenarios = [Scenario(**IDEAL, **FEEDFORWARDS[name], steering=steering, seed=seed, guard=off) for seed in range(3)]

    def answer(rows):
        chosen = scenarios[rows]
        hierarchy = Hierarchy(chosen, body)
        log = drive(hierarchy, [signal[:, rows] for signal in inputs])
        return log, hierarchy

    together, hierarchy = answer(slice(0, 3))
    for i in range(3):
        alone, _ = answer(slice(i, i + 1))
        assert together[:, i].tobytes() == alone[:, 0].tobytes()
    stage = hierarchy.learner
    for array in (hierarchy.state, *(getattr(stage, name) for name in ("rows", "weights") if hasattr(stage, name))):
        assert array.shape[0] == 3  # what is remembered has a leading B
    for array in (hierarchy.output, hierarchy.weight_norm, hierarchy.saturated):
        assert array.shape[0] == 3
    assert (hierarchy.weight_norm > 0).all() == (FEEDFORWARDS[name]["learner"] in ("fel", "rls", "composite", "mrac"))


@pytest.mark.parametrize("name", ["fel", "rls", "model+fel", "model+rls", "model+composite"])
def test_learning_switch(robot, name):
    """Switched off, a robot keeps its weights while its neighbour learns; switched on again, it goes on."""
    hierarchy = build(robot, 2, **FEEDFORWARDS[name], guard=Guard(on=False))  # the inputs are those of no robot
    inputs = signals(2, 360)
    early, middle, late = ([signal[part] for signal in inputs] for part in np.split(np.arange(360), 3))
    drive(hierarchy, early)
    learned = weights(hierarchy).copy()
    norm = hierarchy.weight_norm.copy()
    hierarchy.set_learning(0, False)
    drive(hierarchy, middle)
    np.testing.assert_array_equal(weights(hierarchy)[0], learned[0])
    assert (weights(hierarchy)[1] != learned[1]).any()
    assert hierarchy.weight_norm[0] == norm[0] != hierarchy.weight_norm[1]
    hierarchy.set_learning(0, True)
    drive(hierarchy, late)
    assert (weights(hierarchy)[0] != learned[0]).any()


@pytest.mark.parametrize("name", ["fel", "rls", "model+fel", "model+rls", "model+composite"])
def test_slip_freezes(robot, name):
    """The voltage of a wheel that slips says nothing about the motion: nobody learns from it, the neighbour goes on."""
    hierarchy = build(robot, 2, **FEEDFORWARDS[name])
    early, late = ([signal[part] for signal in signals(2, 240)] for part in np.split(np.arange(240), 2))
    drive(hierarchy, early)
    learned = weights(hierarchy).copy()
    late[-1][:] = [0.11, 0.09]
    drive(hierarchy, late)
    np.testing.assert_array_equal(weights(hierarchy)[0], learned[0])
    assert (weights(hierarchy)[1] != learned[1]).any()


def test_saturation_freezes(robot):
    """A voltage that cannot act teaches nothing, and does not wind the integral up."""
    weak = robot.model_copy(update={"supply": 0.5})
    hierarchy = build(weak, 1, learner="fel", guard=Guard(on=False))
    still, pose, ahead, wanted = np.zeros((1, 2)), np.zeros((1, 3)), np.array([[0.5, 0, 0]]), np.array([[0.5, 0]])
    for _ in range(10):  # until the command has risen beyond reach
        tick(hierarchy, pose, still, np.hstack([ahead, wanted, still]))
    before = weights(hierarchy).copy()
    for _ in range(400):
        output = tick(hierarchy, pose, still, np.hstack([ahead, wanted, still]))
        assert hierarchy.saturated[0]
    np.testing.assert_array_equal(output[0, :2], 0.5)
    np.testing.assert_array_equal(weights(hierarchy), before)
    # Unwinding stops where it balances the error, K_p e beyond the limit: the integral is the limit itself.
    assert hierarchy.state["pid"]["integral"][0, 0] == pytest.approx(0.5, abs=0.02)


def test_switching_one_robot(robot):
    """New gains reach one robot, and both kinds of gains reach it."""
    inputs = signals(2, 10)
    plain = drive(build(robot, 2, learner="none"), inputs)
    hierarchy = build(robot, 2, learner="none")
    hierarchy.set_kanayama(0, Kanayama(k_x=1.0))
    moved = drive(hierarchy, inputs)
    np.testing.assert_array_equal(moved[:, 1], plain[:, 1])
    assert (moved[:, 0, 7] != plain[:, 0, 7]).any()
    hierarchy = build(robot, 2, learner="none")
    hierarchy.set_pid(1, Pid(time_constant=0.4))
    slower = drive(hierarchy, inputs)
    np.testing.assert_array_equal(slower[:, 0], plain[:, 0])
    np.testing.assert_array_equal(slower[:, 1, 7:11], plain[:, 1, 7:11])  # its commands stay
    assert (slower[1:, 1, 11:] != plain[1:, 1, 11:]).all()


def test_guard_knows_both_controllers(robot):
    """What the guard of a robot tolerates after new gains is what it tolerates of a robot that has had them always."""
    gains, design = Kanayama(k_x=0.02, k_y=0.02, k_theta=0.1), Pid(time_constant=0.4)  # so slow that the posture counts

    def tolerated(hierarchy):
        return hierarchy.state["guard"]["harmless_to_posture"]

    start = build(robot)
    prefilter = float(start.state["limiter"]["time_constant"][0])  # which an event does not change
    for changes in ({"kanayama": gains}, {"kanayama": gains, "pid": design}):
        switched, renewed = build(robot, 2), build(robot, 2)
        switched.set_kanayama(1, gains)
        if "pid" in changes:
            switched.set_pid(1, design)
        always = Scenario(**changes)
        renewed.renew(1, always)
        for hierarchy, expected in ((switched, Scenario(**changes, prefilter=prefilter)), (renewed, always)):
            np.testing.assert_array_equal(tolerated(hierarchy)[0], tolerated(start)[0])
            np.testing.assert_allclose(tolerated(hierarchy)[1], tolerated(Hierarchy([expected], robot))[0], rtol=1e-12)
            assert not np.allclose(*tolerated(hierarchy), rtol=0.01)
        renewed.set_kanayama(1, Kanayama())  # the design for its own PID, not for that of the robot before
        np.testing.assert_array_equal(renewed.state["kanayama"][1], build(robot, pid=always.pid).state["kanayama"][0])


@pytest.mark.parametrize("name", FEEDFORWARDS)
def test_rolling_start(robot, name):
    """Reset to a motion that goes on, the first command is that motion and the voltage what the model takes for it."""
    twist, acceleration = np.array([[0.8, 0.5]]), np.array([[0.2, -0.3]])
    hierarchy = build(robot, **FEEDFORWARDS[name])
    hierarchy.reset(twist, acceleration, np.array([0.2]))
    pose = np.array([[1.0, 2.0, 0.5]])
    output = tick(hierarchy, pose, twist, np.hstack([pose, twist, acceleration]))
    np.testing.assert_allclose(hierarchy.command, twist, atol=1e-12)
    np.testing.assert_allclose(hierarchy.derivative, acceleration, atol=1e-12)
    steady = inverse_dynamics(twist, acceleration, robot, sign_speed=0.05)
    np.testing.assert_allclose(output[:, :2], steady, atol=1e-9)


def test_take_over(robot):
    """What learning adds to the feedforward, the integral gives up in part; a stage that does not say is left alone."""

    taken = np.array([[0.6, -0.2]])

    class Learner:
        def __init__(self, added):
            self.added = added

        def output(self, command, derivative):
            return np.zeros((1, 2))

        def learn(self, feedback, frozen, twist, voltage):
            return self.added

    integrals = []
    for added in (taken, None):
        stage = UserStage("feedforward", lambda robot, size, added=added: Learner(added), robot, 1)
        hierarchy = UserHierarchy([Scenario(learner="none")], robot, {"feedforward": stage})
        tick(hierarchy, np.zeros((1, 3)), np.zeros((1, 2)), np.array([[0, 0, 0, 1.0, 1.0, 0, 0]]))
        integrals.append(hierarchy.state["pid"]["integral"].copy())
    np.testing.assert_allclose(integrals[1] - integrals[0], HAND_OVER_SHARE * taken, atol=1e-14)


def test_lag_of_the_fork(robot):
    """The fork starts from the angle it has and does not jump to another."""
    hierarchy = build(robot, learner="none")
    twist, still, pose = np.array([[0.8, 0.5]]), np.zeros((1, 2)), np.zeros((1, 3))
    hierarchy.reset(twist, still, np.array([0.4]))
    first = tick(hierarchy, pose, twist, np.hstack([pose, twist, still]))[0, 2]
    settled = first
    for _ in range(200):
        settled = tick(hierarchy, pose, twist, np.hstack([pose, twist, still]))[0, 2]
    assert settled < first < 0.4
    assert first > settled + 0.5 * (0.4 - settled)


def test_other_settings(robot):
    """Every robot has settings of its own."""
    scenarios = [Scenario(fel=Fel(step=step), prefilter=lag) for step, lag in ((0.0, 0.05), (0.05, 0.2))]
    hierarchy = Hierarchy(scenarios, robot)
    inputs = [np.repeat(signal, 2, axis=1) for signal in signals(1, 40)]
    log = drive(hierarchy, inputs)
    assert hierarchy.weight_norm[0] == 0 < hierarchy.weight_norm[1]
    spread = np.abs(np.diff(log[:, :, 7], axis=0)).sum(axis=0)
    assert spread[1] < spread[0]  # the slower prefilter is the calmer one


def test_a_stage_cannot_change_which_robots_are_reset(robot):
    """A user's stage that writes into the indices of `restore` does not move what the hierarchy does with them next."""

    class Writing:
        def __init__(self, robot, size):
            self.size = size

        def output(self, command, derivative):
            return np.zeros((self.size, 2))

        def learn(self, feedback, frozen, twist, voltage):
            pass

        def restore(self, rows):
            rows += 1

    own = UserFeedforward(UserStage("feedforward", Writing, robot, 2), Prior([None] * 2, False), False, 0.01, 0.0)
    rows = np.array([0])
    own.restore(rows)
    assert rows.tolist() == [0]
