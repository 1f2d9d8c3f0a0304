"""Environments: what their own makers' checkers ask for, and the very physics of `simulate`, bit for bit."""

import copy
import os
import pickle
import subprocess
import sys
import warnings

import gymnasium
import numpy as np
import pytest
from absl.testing import absltest
from dm_env import StepType, test_utils
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import TransformObservation
from gymnasium.wrappers.vector import RecordEpisodeStatistics

from mrctl import (
    FEEDFORWARDS,
    PERTURBATIONS,
    Circle,
    Event,
    InputError,
    Line,
    Perturbation,
    Pid,
    Scenario,
    Waypoints,
    replicates,
    summary,
)
from mrctl.envs.dm_env import SUITE, Environment, Tracking, register
from mrctl.envs.episodes import ACTION_KINDS, EPISODE_METRICS, OBSERVATIONS, Episodes
from mrctl.envs.gym import TrackingEnv, TrackingVectorEnv
from mrctl.loop.groups import arranged
from mrctl.loop.runs import simulate
from mrctl.results.dataset import SIGNALS
from mrctl.sensing.tiers import Sensing

IDS = [f"mrctl/{action.capitalize()}Tracking-v0" for action in ACTION_KINDS]
SHORT = Scenario(reference=Circle(period=2.2, radius=0.3), laps=1)
EXACT = SHORT.model_copy(update={"sensing": Sensing(tier="ideal")})
# All that a robot remembers: weights, delays, filters, sensors, the estimate, a perturbation and a push under way.
BUSY = Scenario(
    reference=Circle(period=2.2, radius=0.3),
    laps=1,
    sensing=Sensing(tier="field"),
    perturbation=Perturbation(control_delay=0.02, mass_factor=1.3),
    events=(
        Event(time=0.5, perturbation=PERTURBATIONS["all"]),
        Event(time=1.9, push=(30.0, 0.0, 0.0), push_duration=0.3),
        Event(time=1.0, reference=Circle(period=2.4, radius=0.3)),
    ),
)
PRESENT = [k for k, name in enumerate(SIGNALS) if not name.startswith("fix_")]  # a tick without a fix has NaN
COMPARED = ("none", "true_model", "model+observer", "fel", "rls", "model+composite")


def expected(scenario, seed):
    """Every signal of the scenario alone under `simulate`, `(ticks, signals)`."""
    return expected_of_all([(scenario, seed)])[0]


def expected_of_all(runs):
    """Every signal of scenarios with seeds, which `simulate` computes in a batch, `(runs, ticks, signals)`."""
    result = simulate([scenario.model_copy(update={"seed": seed}) for scenario, seed in runs])
    return np.stack([result[name].values for name in SIGNALS], axis=-1)


def last(loop, row=0):
    """Returns every signal of the tick that has just ended, `(signals,)`."""
    return np.array(loop.log.at(loop.tick - 1)[row].item())


@pytest.mark.parametrize("feedforward", COMPARED)
def test_gym_bits(feedforward):
    """Episodes with a zero residual are the scenario's own run, the first as the second."""
    scenario = BUSY.model_copy(update=FEEDFORWARDS[feedforward])
    env = TrackingEnv(scenario)
    bits = dict(zip((3, 8), expected_of_all([(scenario, 3), (scenario, 8)]), strict=True))
    for seed in (3, 8, 3):
        env.reset(seed=seed)
        found, over = [], False
        while not over:
            _, _, failed, over, _ = env.step(np.zeros(2))
            assert not failed
            found.append(last(env.episodes))
        assert np.array_equal(found, bits[seed], equal_nan=True), seed


@pytest.mark.parametrize("steering", ["compliant", "rigid"])
def test_dm_env_bits(steering):
    """The same through dm_control; the first episode has the scenario's seed."""
    scenario = BUSY.model_copy(update={"seed": 5, "steering": steering})
    env = SUITE["residual"](scenario, random=1)
    seeds = [5, int(np.random.RandomState(1).randint(2**32, dtype=np.uint32))]
    for seed in seeds:
        step, found = env.reset(), []
        while not step.last():
            step = env.step(np.zeros(2))
            found.append(last(env.task.episodes))
        assert np.array_equal(found, expected(scenario, seed), equal_nan=True), seed


@pytest.mark.parametrize("feedforward", COMPARED)
def test_vector_bits(feedforward):
    """Robots that begin again at different moments, some after a failure: each episode is its run alone."""
    changes = {**FEEDFORWARDS[feedforward], "sensing": BUSY.sensing}
    scenarios = [s.model_copy(update=changes) for s in (BUSY, SHORT, BUSY, SHORT)]
    env = TrackingVectorEnv(4, scenarios, threads=1)
    loop, zero = env.episodes, np.zeros((4, 2))
    env.reset(seed=[1, 2, 3, 4])
    episodes = [[[]] for _ in scenarios]
    seeds = [[1], [2], [3], [4]]
    over = np.zeros(4, bool)
    for tick in range(520):
        action = zero.copy()
        action[1] = np.nan if tick in (70, 130) else 0.0  # which fails it on the spot
        _, reward, terminated, truncated, info = env.step(action)
        for row in range(4):
            if over[row]:
                assert reward[row] == 0 and not terminated[row] and not truncated[row]
                episodes[row].append([])
                seeds[row].append(loop.scenarios[row].seed)
            else:
                episodes[row][-1].append(last(loop, row))
        if terminated[1]:
            assert (
                info["failure"][1] == "non-finite command" and info["_failure"].tolist() == [False, True] + [False] * 2
            )
        over = terminated | truncated
    assert [len(some) for some in episodes] == [3, 4, 3, 3]
    driven = [(row, seed, np.array(found)) for row, some in enumerate(episodes)
              for seed, found in zip(seeds[row], some, strict=True)]  # fmt: skip
    bits = expected_of_all([(scenarios[row], seed) for row, seed, _ in driven])
    for (row, seed, found), alone in zip(driven, bits, strict=True):
        broken = np.isnan(found[:, PRESENT]).any(axis=1)  # from the action that is no number on
        found = found[: np.argmax(broken) if broken.any() else None]
        assert np.array_equal(found, alone[: len(found)], equal_nan=True), (row, seed)


def test_slow_motion_controller():
    """Where the motion controller is slower than the others, an episode that begins on its own has its run's bits."""
    scenario = EXACT.model_copy(update={"motion_period": 0.03})  # 220 ticks are not a whole number of its periods
    env = TrackingVectorEnv(1, scenario)
    env.reset(seed=[4])
    for episode in range(2):
        if episode:
            env.step(np.zeros((1, 2)))  # begins it
        seed, found, over = env.episodes.scenarios[0].seed, [], [False]
        while not over[0]:
            *_, over, _ = env.step(np.zeros((1, 2)))
            found.append(last(env.episodes))
        assert np.array_equal(found, expected(scenario, seed), equal_nan=True)


def drive(env, **reset):
    """Drives a single environment through an episode with zero actions; returns its signals and the last dictionary."""
    env.reset(**reset)
    found, over, info = [], False, {}
    while not over:
        assert not info
        _, _, failed, over, info = env.step(np.zeros(2))
        over |= failed
        found.append(last(env.episodes))
    return np.array(found), info


def test_perturbation_of_a_reset():
    """The option holds for one episode, whatever it is written as; the next one has the scenario's robot again."""
    env = TrackingEnv(SHORT)
    heavy = Perturbation(mass_factor=1.5, control_delay=0.02)
    for given, meant in (
        (None, Perturbation()),
        (heavy, heavy),
        (None, Perturbation()),
        ({"mass_factor": 1.5, "control_delay": 0.02}, heavy),
        ("all", PERTURBATIONS["all"]),
    ):
        found, _ = drive(env, seed=4, options={"perturbation": given} if given else None)
        assert np.array_equal(found, expected(SHORT.replace(perturbation=meant), 4), equal_nan=True)


def test_perturbations_of_a_vector():
    """One for each robot, which the episodes after those of the reset do not have."""
    env = TrackingVectorEnv(3, SHORT, threads=1)
    given = ["all", None, {"payload": 5.0}]
    meant = [SHORT.replace(perturbation=p or Perturbation()) for p in given]
    env.reset(seed=7, options={"perturbation": given})
    found = []
    for _ in range(220 + 1 + 220):
        env.step(np.zeros((3, 2)))
        found.append([last(env.episodes, row) for row in range(3)])
    for row, scenario in enumerate(meant):
        one = np.array(found)[:, row]
        assert np.array_equal(one[:220], expected(scenario, 7 + row), equal_nan=True)
        assert np.array_equal(one[221:], expected(SHORT, env.episodes.scenarios[row].seed), equal_nan=True)


def test_drawn_perturbations():
    """An episode whose perturbation is drawn is the replicate of its seed; in a vector, the same robots."""
    scenario = SHORT.replace(perturbation=PERTURBATIONS["all"])
    env = TrackingEnv(scenario, draw=scenario.perturbation.drawn)
    several = TrackingVectorEnv(2, scenario, draw=scenario.perturbation.drawn, threads=1)
    other = SUITE["residual"](scenario.replace(seed=8), draw=scenario.perturbation.drawn)
    several.reset(seed=np.array([8, 9]))  # as NumPy draws them
    other.reset()
    for row, seed in enumerate((8, 9)):
        (replicate,) = replicates(scenario, 1, first=seed)
        found, info = drive(env, seed=seed)
        assert np.array_equal(found, expected(replicate, seed), equal_nan=True)
        assert several.episodes.scenarios[row] == env.episodes.scenarios[0]
        table = summary(simulate(replicate))
        assert info == pytest.approx({name: table[name][0] for name in EPISODE_METRICS}, rel=1e-9)
    assert other.task.episodes.scenarios[0].perturbation == replicates(scenario, 1, first=8)[0].perturbation
    free = TrackingEnv(scenario, draw=lambda random: {"mass_factor": random.uniform(0.5, 2.0)})
    factors = [(free.reset(), free.episodes.scenarios[0].perturbation.mass_factor)[1] for _ in range(4)]
    assert len({*factors}) == 4 and 0.5 <= min(factors) and max(factors) <= 2.0


def test_scale():
    """A robot that drives at its limits sees numbers of about one; the wrapper is Gymnasium's own."""
    env = TrackingEnv(Scenario(reference=Circle(period=4.0, radius=0.6), laps=1))
    scaled = TransformObservation(env, lambda seen: seen / env.episodes.scale, env.observation_space)
    scaled.reset(seed=0)
    seen = np.array([scaled.step(np.zeros(2))[0] for _ in range(400)])
    largest = np.abs(seen).max(axis=0)
    assert (largest < 1.5).all() and (largest[[3, 4, 5, 6, 9, 10, 11, 12, 13]] > 0.1).all(), largest


RENDER = """
import gymnasium, numpy as np
from gymnasium.utils.env_checker import check_env
from mrctl import Box, Circle, InputError, Obstacles, Scenario
import mrctl.envs.gym

make = lambda mode=None: gymnasium.make("mrctl/ResidualTracking-v0", scenario=Scenario(
    reference=Circle(period=2.2, radius=0.3), laps=1), render_mode=mode).unwrapped
one, other, pictures = make("rgb_array"), make(), []
for env in (one, other):
    env.reset(seed=3)
for tick in range(60):
    assert (one.step(np.zeros(2))[0] == other.step(np.zeros(2))[0]).all()
    if tick in (0, 50):
        pictures.append(one.render())
assert all(p.shape == (480, 640, 3) and p.dtype == np.uint8 and p.std() > 10 for p in pictures)
assert (pictures[0] != pictures[1]).any() and other.render() is None
assert one.metadata["render_fps"] == 100
many = mrctl.envs.gym.TrackingVectorEnv(2, Scenario(reference=Circle(period=2.2, radius=0.3), laps=1),
    render_mode="rgb_array")
many.reset(seed=[3, 4])
for tick in range(51):
    many.step(np.zeros((2, 2)))
drawn = many.render()
assert len(drawn) == 2 and np.mean(drawn[0] != pictures[1]) < 1e-3 < np.mean(drawn[0] != drawn[1])
near, far = (Scenario(reference=Circle(period=2.2, radius=0.3), laps=1, goal=(3, 3, 0),
    obstacles=Obstacles(shapes=(Box(x=1, y=1, length=length, width=0.5),) * n)) for length, n in ((0.5, 1), (2, 2)))
worlds = mrctl.envs.gym.NavigationVectorEnv(3, [near, far, near], render_mode="rgb_array")
worlds.reset(seed=[3, 3, 3])
one, other, same = worlds.render()
assert (one == same).all() and np.mean(one != other) > 1e-2  # each in its own world
"""


def test_render():
    """A picture shows the robot from a camera that follows it, and changes no bit of the episode."""
    environment = {name: value for name, value in os.environ.items() if name != "DISPLAY"}
    done = subprocess.run(
        [sys.executable, "-c", RENDER], capture_output=True, text=True, env=environment | {"MUJOCO_GL": "egl"}
    )
    if "EGL" in done.stderr:
        pytest.skip("no EGL on this machine")
    assert not done.returncode, done.stderr


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"pertubation": "all"}, "options: there is no 'pertubation', only perturbation"),
        ({"perturbation": "heavy"}, "perturbation: no perturbation is called 'heavy'; there are nominal, "),
        ({"perturbation": {"mass": 2.0}}, "perturbation.mass: "),
        ({"perturbation": {"mass_factor": np.nan}}, "perturbation.mass_factor: "),
        ({"perturbation": {"control_delay": 0.013}}, "perturbation.control_delay: 0.013 s is not a whole multiple"),
        (
            {"perturbation": {"payload": 50.0, "payload_x": -1.0}},
            "perturbation.payload: the centre of mass",
        ),
        ({"perturbation": ["all"]}, "perturbation: 1 of them for 2 robots"),
        (5, "options: must be a dictionary"),
    ],
)
def test_bad_options(options, message):
    """What a reset asks for is refused in one line before anything begins; the next reset is as ever."""
    env = TrackingVectorEnv(2, SHORT, threads=1)
    with pytest.raises(InputError) as error:
        env.reset(seed=1, options=options)
    assert str(error.value).startswith(message) and "\n" not in str(error.value)
    assert np.array_equal(env.reset(seed=1)[0], TrackingVectorEnv(2, SHORT, threads=1).reset(seed=1)[0])


def test_bad_draw():
    """A name in the place of a function that draws is refused with an example of one."""
    with pytest.raises(InputError, match=r"^draw: must be a function of a random generator, such as mrctl\.PERT"):
        TrackingEnv(SHORT, draw="all")


@pytest.mark.parametrize("action", ACTION_KINDS)
def test_vector_is_single(action):
    """Under any actions the vector environment is Gymnasium's own vector of single ones, autoreset and all."""
    line = Scenario(reference=Line(speed=0.5, length=1.1), laps=1)
    scenarios = [SHORT, line, SHORT.model_copy(update={"perturbation": PERTURBATIONS["all"]})]
    mine = TrackingVectorEnv(3, scenarios, action, threads=1)
    theirs = SyncVectorEnv([lambda s=s: TrackingEnv(s, action) for s in scenarios])
    assert mine.metadata["autoreset_mode"] == theirs.metadata["autoreset_mode"] == AutoresetMode.NEXT_STEP
    assert mine.observation_space == theirs.observation_space and mine.action_space == theirs.action_space
    assert mine.single_action_space == theirs.single_action_space
    random = np.random.default_rng(0)
    for one, other in ([env.reset(seed=4) for env in (mine, theirs)],):
        assert np.array_equal(one[0], other[0]) and one[1] == other[1] == {}
    ended = np.zeros(3)
    for _ in range(450):
        actions = random.uniform(-1, 1, (3, 2))
        one, other = mine.step(actions), theirs.step(actions)
        assert mine.observation_space.contains(one[0]) and mine.action_space.contains(actions)
        for a, b in zip(one[:4], other[:4], strict=True):
            assert a.dtype == b.dtype and np.array_equal(a, b)
        assert one[4].keys() == other[4].keys()
        for name in set(EPISODE_METRICS) & one[4].keys():
            np.testing.assert_allclose(one[4][name], other[4][name], rtol=1e-12)
        ended += one[2] | one[3]
    assert (ended >= 2).all()


@pytest.mark.parametrize("name", IDS)
def test_gym_checker(name):
    """Gymnasium's checker has nothing to say, but that what is measured has no bounds."""
    env = gymnasium.make(name, scenario=SHORT)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*Box observation space (minimum|maximum) value is .*infinity")
        check_env(env.unwrapped, skip_render_check=True)


@pytest.mark.parametrize("name", IDS)
def test_make_vec(name):
    """Registered for `make_vec`, and fit for Gymnasium's wrappers."""
    env = RecordEpisodeStatistics(gymnasium.make_vec(name, 2, vectorization_mode="vector_entry_point", scenario=SHORT))
    env.reset(seed=0)
    env.action_space.seed(0)
    lengths = []
    for _ in range(450):
        info = env.step(env.action_space.sample())[4]
        if "episode" in info:
            lengths += info["episode"]["l"][info["_episode"]].tolist()
    assert len(lengths) >= 4 and set(lengths) == {220}


class Contract(test_utils.EnvironmentTestMixin):
    """dm_env's own tests."""

    scenario, action = SHORT.model_copy(update={"reference": Line(speed=0.5, length=0.5)}), "residual"

    def make_object_under_test(self):
        return Environment(Tracking(self.scenario, self.action))

    def make_action_sequence(self):
        random = np.random.default_rng(0)
        spec = self.environment.action_spec()
        for _ in range(230):
            yield random.uniform(spec.minimum, spec.maximum)


class TestTwist(Contract, absltest.TestCase):
    action = "twist"


class TestVoltage(Contract, absltest.TestCase):
    action = "voltage"


class TestResidual(Contract, absltest.TestCase):
    pass


class TestFails(Contract, absltest.TestCase):
    """An episode that ends before its time."""

    scenario = SHORT.model_copy(update={"events": (Event(time=0.5, push=(1e12, 0.0, 1e15)),)})

    def test_discount(self):
        steps = [self.environment.reset()]
        while not steps[-1].last():
            steps.append(self.environment.step(np.zeros(2)))
        assert steps[-1].discount == 0 and steps[-1].reward == 0 and len(steps) < 100
        assert all(np.isfinite(value).all() for value in steps[-1].observation.values())


def test_suite():
    """Loaded by name as dm_control's own domains are; settings of the environment go through."""
    from dm_control import suite

    register()
    env = suite.load(
        "mrctl", "twist", task_kwargs={"scenario": SHORT, "random": 0}, environment_kwargs={"flat_observation": True}
    )
    step = env.reset()
    assert step.step_type == StepType.FIRST and step.observation["observations"].shape == (14,)
    assert sorted(SUITE) == sorted([*ACTION_KINDS, "navigation"]) and sorted(SUITE.tagged("navigation")) == [
        "navigation"
    ]
    assert sorted(ACTION_KINDS) == sorted(SUITE.tagged("tracking"))
    limited = SUITE["voltage"](SHORT, environment_kwargs={"time_limit": 0.05})
    limited.reset()
    assert [limited.step(np.zeros(2)).last() for _ in range(5)] == [False] * 4 + [True]


def test_observation():
    """Named, in SI, and of the moment at which the coming action begins."""
    env = SUITE["residual"](EXACT.model_copy(update={"initial_pose": (0.05, -0.02, 1.6), "initial_spread": (0, 0, 0)}))
    first = env.reset().observation
    assert {name: len(value) for name, value in first.items()} == OBSERVATIONS
    physics, reference = env.physics, SHORT.reference
    for tick in (0, 1, 2):
        pose, twist, acceleration = (part[0] for part in reference.sample(np.array([0.01 * tick])))
        seen = first if tick == 0 else env.step(np.zeros(2)).observation
        delta = pose - physics.pose()
        c, s = np.cos(physics.pose()[2]), np.sin(physics.pose()[2])
        ahead = c * delta[0] + s * delta[1], c * delta[1] - s * delta[0], np.angle(np.exp(1j * delta[2]))
        np.testing.assert_allclose(seen["error"], ahead, atol=1e-12)
        np.testing.assert_array_equal(seen["twist"], physics.twist())
        np.testing.assert_allclose(seen["reference"], [*twist, *acceleration], atol=1e-12)
        np.testing.assert_allclose(seen["wheel_rates"], physics.wheel_rates(), rtol=1e-12)
        assert seen["steering_angle"] == pytest.approx(physics.steering_angle(), abs=5e-3)


def test_only_what_a_robot_knows():
    """With real sensors the rates are those of encoders that count, and not the true ones."""
    env = SUITE["residual"](SHORT.model_copy(update={"sensing": Sensing(tier="field")}))
    env.reset()
    for _ in range(5):
        seen = env.step(np.zeros(2)).observation
        counts = seen["wheel_rates"] / (2 * np.pi / 2578 / 0.01)
        np.testing.assert_allclose(counts, np.round(counts), atol=1e-9)
        assert (seen["wheel_rates"] != env.physics.wheel_rates()).all()


def test_reward():
    """One on the reference; a half with both rear wheels 5 cm off."""

    def reward(pose):
        scenario = SHORT.model_copy(update={"initial_pose": pose, "initial_spread": (0, 0, 0)})
        return Episodes([scenario], "residual").observe()[1][0]

    (x, y, theta), half_track = SHORT.reference.sample(np.zeros(1))[0][0], 0.188
    assert reward((x, y, theta)) == 1
    assert reward((x + 0.03, y - 0.04, theta)) == pytest.approx(0.5)
    assert reward((x, y, theta + 0.05 / half_track)) == pytest.approx(0.5, rel=1e-2)


def test_reward_of_an_arrival():
    """A robot that stands at its goal has the reward of its place, and not that of one that has failed."""
    way = Waypoints(points=((0, 0), (0.2, 0), (0.4, 0)), closed=False, speed=0.3)
    (pose,) = way.sample(np.array([way.period])).pose
    env = TrackingEnv(Scenario(reference=way, laps=1, goal=tuple(pose), initial_spread=(0, 0, 0)))
    env.reset(seed=0)
    over = False
    while not over:
        _, reward, over, truncated, info = env.step(np.zeros(2))
        assert not truncated
    assert info["failure"] == "" and reward > 0.5


def test_refused_reset_of_a_vector():
    """Where the perturbation of one robot is refused, no robot begins again; seeds may be NumPy's in a list."""
    env = TrackingVectorEnv(3, SHORT)
    env.reset(seed=[np.int64(3), 1, 2])
    assert [s.seed for s in env.episodes.scenarios] == [3, 1, 2]
    env.step(np.zeros((3, 2)))
    with pytest.raises(InputError):
        env.reset(options={"perturbation": [None, "bad", None]})
    assert not env.episodes.start.any()


def test_actions():
    """What is acted is what is sent: a twist is driven, volts are volts, a residual adds to the controllers'."""
    changes = {
        "reference": Line(speed=0.5, length=2.0),
        "initial_spread": (0, 0, 0),
        "prior": "model",
        "learner": "none",
    }
    straight = EXACT.model_copy(update=changes)
    env = TrackingEnv(straight, "twist")
    env.reset(seed=0)
    for _ in range(200):
        env.step(np.array([0.7, 0.3]) / env.episodes.bound)
    np.testing.assert_allclose(env.episodes.plant.reading["twist"][0], [0.7, 0.3], atol=0.03)
    volts = TrackingEnv(straight, "voltage")
    volts.reset(seed=0)
    for action, sent in (((0.5, -0.25), (12.0, -6.0)), ((1.5, -99.0), (24.0, -24.0))):
        volts.step(np.array(action))
        assert volts.episodes.plant.applied[0].tolist() == list(sent)
    several = [TrackingEnv(straight) for _ in range(5)]
    for env, action in zip(several, (0.0, 0.25, 1.0, 1.5, 99.0), strict=True):
        env.reset(seed=0)
        env.step(np.full(2, action))
    plain, some, largest, *beyond = (env.episodes.plant.applied for env in several)
    assert some - plain == pytest.approx(1.5) and largest - plain == pytest.approx(6.0)
    assert all(np.array_equal(one, largest) for one in beyond)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: TrackingEnv(SHORT, "torque"), "action: 'torque' is not twist, voltage, residual"),
        (lambda: TrackingVectorEnv(2, [SHORT, SHORT.model_copy(update={"laps": 2})]), "scenarios: 0 and 1 differ"),
        (lambda: TrackingVectorEnv(2, SHORT.model_copy(update={"motion_period": 0.05})), "motion_period: "),
        (lambda: TrackingVectorEnv(3, [SHORT]), "num_envs: 3, but 1 scenarios"),
        (lambda: TrackingVectorEnv(0, SHORT), "num_envs: 0 is below 1"),
        (lambda: TrackingVectorEnv(2, 5), "scenario: int is neither"),  # type: ignore
        (lambda: TrackingVectorEnv(1, [SHORT], threads=-1), "threads: -1 is below 0"),
        (lambda: TrackingEnv("nowhere.toml"), "nowhere.toml: No such file"),
        (lambda: TrackingEnv({"laps": 1}), "scenario: dict is neither a Scenario nor the path of a file"),  # type: ignore
        (lambda: TrackingEnv(SHORT, render_mode="human"), "render_mode: 'human' is not rgb_array"),
        (lambda: TrackingEnv(SHORT, draw=lambda r: {"mass_factor": 99}).reset(), "perturbation.mass_factor: "),
        (
            lambda: TrackingEnv(SHORT, draw=lambda r: Perturbation(payload=-r.random())).reset(),
            "perturbation.payload: ",
        ),
        (
            lambda: Episodes([SHORT], "twist").loop.add(Event(time=1.0, reference=SHORT.reference)),
            "add: robots that begin again keep their references",
        ),
    ],
)
def test_refused(make, message):
    """What cannot be is said at once."""
    with pytest.raises((InputError, ValueError), match=message):
        make()


def test_action_of_another_shape():
    """It is refused by name, and one number is not taken for two."""
    env, vector = TrackingEnv(SHORT), TrackingVectorEnv(3, SHORT)
    env.reset(seed=0)
    vector.reset(seed=0)
    for action in (np.zeros(1), np.zeros(3)):
        with pytest.raises(InputError, match=r"^action: has shape \(., ?\), and \(2,\) is expected"):
            env.step(action)
    with pytest.raises(InputError, match=r"and \(3, 2\) is expected"):
        vector.step(np.zeros(2))


def test_seeds_of_another_number():
    """As many seeds as robots, or one."""
    vector = TrackingVectorEnv(3, SHORT)
    with pytest.raises(InputError, match="^seed: 2 seeds for 3 robots"):
        vector.reset(seed=[1, 2])


def test_seeds_that_no_scenario_has():
    """A seed beyond those of scenarios is refused, and not taken for a smaller one; so is that of a single row."""
    with pytest.raises(InputError, match=r"^seed: 4294967296 is not between 0 and 4294967295$"):
        TrackingEnv(SHORT).reset(seed=2**32)
    with pytest.raises(InputError, match=r"^seed: 4294967296 is not"):
        TrackingVectorEnv(2, SHORT).reset(seed=2**32 - 1)


@pytest.mark.parametrize("copied", [copy.deepcopy, pickle.dumps])
def test_no_copy(copied):
    """A copy would share the memory of the laws: it is refused, and the robot drives on with the same bits."""
    for env in (TrackingEnv(SHORT), TrackingVectorEnv(2, SHORT), SUITE["residual"](SHORT)):
        with pytest.raises(TypeError, match="^simulation: cannot be copied or pickled"):
            copied(env)
    env = TrackingEnv(EXACT)
    env.reset(seed=3)
    bits = expected(EXACT, 3)
    for tick in range(20):
        env.step(np.zeros(2))
        if tick == 10:
            with pytest.raises(TypeError):
                copied(env)
        np.testing.assert_array_equal(last(env.episodes)[PRESENT], bits[tick, PRESENT])


def test_tick_of_a_failure():
    """Its tick counts from the beginning of the episode, in whichever episode it is."""
    env, vector = TrackingEnv(SHORT, "twist"), TrackingVectorEnv(2, SHORT, "twist")
    good, bad = np.zeros(2), np.array([np.nan, 0.0])
    for ticks in (10, 3):
        env.reset(seed=0)
        for _ in range(ticks):
            env.step(good)
        assert env.step(bad)[4]["failure"].endswith(f"not finite, tick {ticks}")
    vector.reset(seed=0)
    failures = [vector.step([good, bad if tick in (4, 8) else good])[4].get("failure") for tick in range(9)]
    assert failures[4][1].endswith("tick 4") and failures[8][1].endswith("tick 2")  # it begins in tick 6


@pytest.mark.parametrize("action", [np.array([0.1 + 1j, 0.0]), np.array(["0.1", "0"]), [None, 0.0]])
def test_action_of_no_real_numbers(action):
    """It is refused by name, in every environment; no imaginary part is dropped in silence."""
    single, vector, suite = TrackingEnv(SHORT), TrackingVectorEnv(2, SHORT), SUITE["voltage"](SHORT)
    for env, given in ((single, action), (vector, [action, action]), (suite, np.asarray(action))):
        env.reset()
        with pytest.raises(InputError, match=r"^action: holds \w+, and real numbers are expected$"):
            env.step(given)


def test_scenario_file(tmp_path):
    """The scenario files of the command line are the environments' too; voltages of an agent are no oscillation."""
    file = tmp_path / "scenario.toml"
    file.write_text(BUSY.to_toml())
    expected = [arranged(BUSY.replace(pid=Pid(retune=False)))]
    assert TrackingEnv(file).episodes.scenarios == SUITE["residual"](str(file)).task.episodes.scenarios == expected


def test_without_gymnasium():
    """Who has not installed it is told how."""
    code = "import sys; sys.modules['gymnasium'] = None\nimport mrctl.envs.gym"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert found.stderr.strip().endswith("mrctl.envs.gym needs Gymnasium: pip install 'mrctl[env]'")
