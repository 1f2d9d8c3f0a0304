"""Navigation as an environment: the loop's bits, scans and rewards by geometry, and what the makers' checkers ask."""

import warnings

import gymnasium
import numpy as np
import pytest
from absl.testing import absltest
from dm_env import test_utils
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import SyncVectorEnv
from gymnasium.wrappers.vector import RecordEpisodeStatistics

from mrctl import Box, Disc, InputError, Line, Obstacles, Scenario
from mrctl.envs.dm_env import SUITE, Environment, Navigation
from mrctl.envs.gym import NavigationEnv, NavigationVectorEnv
from mrctl.loop.runs import simulate
from mrctl.results.dataset import SIGNALS

CROSSING = Disc(x=-1.0, y=2.0, radius=0.2, course=Line(speed=0.8))
WALL = Box(x=3.0, length=0.2, width=4.0)
LIDAR = {"beams": 61, "range": 4.0, "noise": 0.0}  # the middle one of which looks straight ahead
TASK = Scenario(
    obstacles=Obstacles(shapes=(WALL, CROSSING)), goal=(1.2, 0.0, 0.0), reference=Line(speed=0.4, length=1.2), laps=2,
    prior="model", learner="none", initial_spread=(0, 0, 0), sensing={"tier": "ideal", "lidar": LIDAR},
)  # fmt: skip
NOISY = TASK.replace(
    obstacles=Obstacles(shapes=(WALL, CROSSING.replace(course=Line(speed=0.4)))),
    initial_spread=(0.02, 0.02, 0.03), learner="composite",
    sensing={"tier": "lab", "localisation": "scan", "lidar": {"beams": 61, "range": 4.0}},
)  # fmt: skip


NAMES = list(SIGNALS)
SHARE = np.array([0.3, 0.1])  # of the bound


def drive(env, policy, seed=0):
    """Drives an episode with actions of -1 to 1; returns observations, rewards, how it ended, and all signals."""
    seen, rewards, signals = [env.reset(seed=seed)[0]], [], []
    while True:
        observation, reward, terminated, truncated, info = env.step(policy(seen[-1]))
        loop = env.episodes
        seen.append(observation)
        rewards.append(reward)
        signals.append(np.array(loop.log.at(loop.tick - 1)[0].item()))
        if terminated or truncated:
            return np.array(seen), np.array(rewards), terminated, info, np.array(signals)


def test_arrival():
    """The scan is the distance of the wall, and the rewards are the way that was gained, and one for the arrival."""
    env = NavigationEnv(TASK)
    slower = lambda seen: np.array([min(0.4, 0.8 * seen[0]), 0.0]) / env.episodes.bound  # noqa: E731 (as it comes near)
    seen, rewards, terminated, info, signals = drive(env, slower)
    x = signals[:, NAMES.index("x")]
    assert terminated and info == {"failure": ""}
    assert seen[0][:5] == pytest.approx([1.2, 0.0, 0.0, 0.4, 0.0], abs=1e-6)
    ahead = seen[:-1, 5 + 30]
    assert ahead[::10] == pytest.approx(2.9 - x[::10], abs=1e-4)  # a scan each tenth tick, from where the robot is
    assert (np.ptp(ahead[: len(ahead) // 10 * 10].reshape(-1, 10), axis=1) == 0).all()  # and kept until the next
    assert rewards.sum() == pytest.approx(1 + 1.2 - seen[-1][0], abs=1e-4)
    assert rewards[:-1] == pytest.approx(0.004, abs=0.0045) and abs(seen[-1][0]) < 0.1
    side = seen[:, 5 + 30 + 15]  # the beam at a quarter turn to the left, less half a degree
    assert side[0] == 4.0 and 1.8 < side.min() < 1.85  # nothing, and later the disc that passes
    assert np.array_equal(drive(env, slower)[1], rewards)  # nor does the next episode remember where this one ended


@pytest.mark.parametrize(
    ("action", "laps", "failure"), [([0.8, 0.0], 4, "collision"), ([0.0, 0.0], 4, "stuck"), ([0.0, 0.0], 1, None)]
)
def test_ends(action, laps, failure):
    """A collision and a robot that is stuck cost one; at the end of its time an episode is cut off at no cost."""
    _, rewards, terminated, info, signals = drive(NavigationEnv(TASK.replace(laps=laps)), lambda _: np.array(action))
    away = np.abs(1.2 - signals[:, NAMES.index("x")])
    assert terminated == (failure is not None) and info.get("failure") == failure
    expected = away[0] - away[-2] - terminated
    assert rewards.sum() == pytest.approx(expected, abs=0.03)
    assert len(rewards) == 300 or terminated


class Constant:
    """A motion stage that always asks for one twist."""

    def __init__(self, robot, size):
        self.twist = np.tile(SHARE * (robot.max_speed, robot.max_rotation), (size, 1))

    def reset(self, pose, reference, period):
        pass

    def output(self, pose, twist, reference):
        return self.twist


def test_bits():
    """An episode is `simulate` with a stage that asks for the same twists; the scans are those of the localisation."""
    env = NavigationEnv(NOISY)
    expected = simulate(NOISY.model_copy(update={"seed": 7}), motion=Constant)
    for _ in range(2):  # the second time it begins again
        seen, _, _, info, signals = drive(env, lambda _: SHARE, seed=7)
        assert info == {"failure": "collision"} and len(signals) > 200
        for k, name in enumerate(NAMES):
            assert np.array_equal(signals[:, k], expected[name].values[: len(signals)], equal_nan=True), name
        scan = env.episodes.loop.estimator.scanner.scans[0]
        assert np.array_equal(seen[-1, 5:], np.minimum(scan, 4.0))


def test_vector_is_single():
    """Robots with goals, lengths and worlds of their own: as Gymnasium's vector of single ones, autoreset and all."""
    other = Obstacles(shapes=(Disc(x=2.6, radius=0.3), WALL.replace(y=-1.5), *NOISY.obstacles.moving, Box(y=-2)))
    scenarios = [
        NOISY.replace(laps=1),
        NOISY.replace(goal=(0.5, 0.0, 0.0), laps=2),
        NOISY.replace(laps=3, obstacles=other),
    ]
    mine = NavigationVectorEnv(3, scenarios, threads=1)
    theirs = SyncVectorEnv([lambda s=s: NavigationEnv(s) for s in scenarios])
    assert mine.observation_space == theirs.observation_space and mine.action_space == theirs.action_space
    random, ended = np.random.default_rng(0), np.zeros((2, 3))
    one, other = mine.reset(seed=4)[0], theirs.reset(seed=4)[0]
    assert np.array_equal(one, other)
    for tick in range(900):
        toward = np.column_stack([np.minimum(0.6, 0.8 * one[:, 0]), 0.5 * one[:, 1]]) / mine.episodes.bound
        actions = np.clip(toward if tick < 600 else random.uniform(0, 1, (3, 2)), -1, 1)
        found, expected = mine.step(actions), theirs.step(actions)
        assert mine.observation_space.contains(found[0])
        for a, b in zip(found[:4], expected[:4], strict=True):
            assert a.dtype == b.dtype and np.array_equal(a, b), tick
        assert found[4].keys() == expected[4].keys()
        one = found[0]
        ended += found[2], found[3]
    assert (ended.sum(axis=0) >= [2, 2, 1]).all() and (ended.sum(axis=1) >= 2).all()  # by goals, and by their time


def test_makers():
    """Registered, fit for the wrappers, and what the checker says is only that an estimate has no bounds."""
    env = gymnasium.make("mrctl/Navigation-v0", scenario=TASK)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*Box observation space (minimum|maximum) value is .*infinity")
        check_env(env.unwrapped, skip_render_check=True)
    many = gymnasium.make_vec("mrctl/Navigation-v0", 2, vectorization_mode="vector_entry_point", scenario=TASK)
    many = RecordEpisodeStatistics(many)
    many.reset(seed=0)
    lengths = []
    for _ in range(320):
        info = many.step(np.zeros((2, 2)))[4]
        lengths += info["episode"]["l"][info["_episode"]].tolist() if "episode" in info else []
    assert lengths == []  # neither arrived nor stuck within 3.2 s


def test_default():
    """Without a scenario it is a mission through a door; the suite of `dm_env` names the parts."""
    first = SUITE["navigation"]().reset().observation
    assert {name: len(value) for name, value in first.items()} == {"goal": 3, "twist": 2, "scan": 360}
    assert np.hypot(*first["goal"][:2]) > 3 and 0.2 < first["scan"].min() < first["scan"].max() <= 12


def test_dm_env_collides():
    """An obstacle that moves also comes and hits the robot where dm_control steps the physics."""
    coming = Disc(x=-1.0, radius=0.2, course=Line(speed=0.8, heading=np.pi))
    hit = TASK.replace(obstacles=Obstacles(shapes=(coming,)))
    single, env, ticks = NavigationEnv(hit), Environment(Navigation(hit)), 0
    length = len(drive(single, lambda _: np.zeros(2), seed=hit.seed)[1])
    step = env.reset()
    while not step.last():
        step, ticks = env.step([0.0, 0.0]), ticks + 1
    assert env.task.episodes.failure(0) == single.episodes.failure(0) == "collision"
    assert (ticks, step.discount) == (length, 0.0)


class TestDmEnv(test_utils.EnvironmentTestMixin, absltest.TestCase):
    """dm_env's own tests."""

    def make_object_under_test(self):
        return Environment(Navigation(TASK.replace(laps=1)))

    def make_action_sequence(self):
        random, spec = np.random.default_rng(0), self.environment.action_spec()
        for _ in range(310):
            yield random.uniform(spec.minimum, spec.maximum)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"goal": None}, "goal: navigation needs one"),
        ({"sensing": {"lidar": {"rate": 3.0}}}, "sensing.lidar.rate: "),
    ],
)
def test_refused(change, says):
    """What cannot be is said at once, in one line."""
    with pytest.raises(InputError, match=f"^{says}[^\n]*$"):
        NavigationEnv(TASK.replace(**change))
    other = {"tier": "ideal", "lidar": {**LIDAR, "beams": 60}}
    with pytest.raises(InputError, match="sensing.lidar: the robots"):
        NavigationVectorEnv(2, [TASK, TASK.replace(sensing=other)])
