"""The guard against learners that do their worst, and beside learners that are in order.

24 kinds of adversary: no robot is lost that PID alone keeps. Benign learners: nothing happens.
"""

from itertools import product

import numpy as np
import pytest

from mrctl import (
    FEEDFORWARDS,
    PERTURBATIONS,
    Guard,
    Lemniscate,
    Perturbation,
    Pid,
    Scenario,
    guard_events,
    per_lap,
    simulate,
)
from mrctl.control.design import motion, points
from mrctl.control.feedforward import Prior
from mrctl.control.guard import HEADING_ARM, TOLERATED_POSTURE, harmless
from mrctl.control.rejection import LinearLoop, rejection
from mrctl.experiments.paper import IDEAL
from mrctl.loop.simulation import Simulation
from mrctl.physics import mjcf
from mrctl.sensing.tiers import TIERS

PERIOD = 0.01
ARRANGEMENTS = "compliant", "caster", "rigid"
WORLDS = "paper", "lab", "field"  # the PID of the paper is the slowest
KINDS = (
    "constant", "ramp", *(f"sine {f} Hz" for f in (0.05, 0.1, 0.2, 0.3, 0.5, 1, 2, 5)), "chirp", "wrong sign",
    "wrong sign growing", "bang-bang", "anti-feedback", "random walk", "noise", "steps", "pulses", "lies", "NaN", "inf",
    "high gain", "delayed",
)  # fmt: skip
LARGEST = 10.0  # amplitude that a growing adversary reaches, as a share of the supply; it begins with a hundredth


class Adversary:
    """A user's stage that adds a disturbance of another kind in each row to the nominal model, which is the prior."""

    def __init__(self, kinds, draws, robot, rigid, grow):
        self.kind, self.tick, size = np.array(kinds), -1, len(kinds)
        self.rng = [np.random.default_rng([KINDS.index(k), d]) for k, d in zip(kinds, draws, strict=True)]
        self.model = Prior([robot] * size, rigid)
        channels = np.array([((1, 0), (0, 1), (1, 1))[r.integers(3)] for r in self.rng])  # common, differential, both
        signs = np.array([r.choice([-1, 1], 2) for r in self.rng])
        self.on = channels * signs * np.array([robot.supply, robot.max_rotation if rigid else robot.supply])
        self.until = np.array([r.uniform(*grow) for r in self.rng])  # s in which it grows
        self.phase = np.array([r.uniform(0, 2 * np.pi) for r in self.rng])
        self.size = np.array([10 ** r.uniform(-0.7, 0.5) for r in self.rng])  # share of the supply
        self.begin = np.array([r.uniform(1, 10) for r in self.rng])  # s
        self.frequency = np.array([10 ** r.uniform(-1.3, 0.7) for r in self.rng])  # Hz
        sines = np.char.startswith(self.kind, "sine")
        self.frequency[sines] = [float(k.split()[1]) for k in self.kind[sines]]
        self.gain = np.array([10 ** r.uniform(0, 1.5) for r in self.rng])
        self.late = np.array([r.integers(5, 60) for r in self.rng])
        self.walk, self.held, self.sum, self.error = np.zeros((4, size, 2))
        self.past = np.zeros((100, size, 2))
        self.weight_norm = np.zeros(size)  # which is a lie

    def output(self, command, derivative):
        self.tick += 1
        self.command = command
        model = self.model.output(command, derivative)
        return np.stack([self.disturbance(i, self.tick * PERIOD, model[i]) for i in range(len(model))])

    def disturbance(self, i, t, model):
        kind, on, rng = self.kind[i], self.on[i], self.rng[i]
        steady = on * self.size[i] * (t > self.begin[i])
        grown = 0.01 * (100 * LARGEST) ** min(t / self.until[i], 1)
        if kind.startswith("sine") or kind == "lies":
            return on * grown * np.sin(2 * np.pi * self.frequency[i] * t + self.phase[i])
        if kind == "constant":
            return steady
        if kind == "ramp":
            return on * 1.5 * min(t / self.until[i], 1)
        if kind == "chirp":  # 0.05 to 5 Hz
            cycles = 0.05 * self.until[i] / np.log(100) * 100 ** min(t / self.until[i], 1)
            return on * self.size[i] * np.sin(2 * np.pi * cycles) * min(t / 5, 1)
        if kind.startswith("wrong sign"):
            return model * (-2.0 if kind == "wrong sign" else -2 * grown)
        if kind == "bang-bang":
            return steady * np.sign(np.sin(2 * np.pi * self.frequency[i] * t))
        if kind == "anti-feedback":  # with full voltage away from the command
            return np.abs(steady) * np.sign(self.error[i])
        if kind == "random walk":
            self.walk[i] += 0.3 * np.sqrt(PERIOD) * rng.normal(size=2)
            return on * self.walk[i]
        if kind == "noise":
            return on * self.size[i] * rng.normal(size=2)
        if kind == "steps":
            self.held[i] = rng.uniform(-1, 1, 2) if self.tick % 50 == 0 else self.held[i]
            return on * self.size[i] * self.held[i]
        if kind == "pulses":
            return on * 1.5 * (self.tick % 100 < 5 + 10 * self.size[i])
        if kind == "high gain":
            return self.sum[i]
        if kind == "delayed":
            return self.gain[i] * self.past[(self.tick - self.late[i]) % 100, i]
        if t < self.begin[i]:
            return np.zeros(2)
        if kind == "NaN":  # comes and goes
            return np.array([np.nan, 0.0]) if self.tick // 20 % 10 == 0 else np.zeros(2)
        return np.where(on != 0, np.inf, 0.0)

    def learn(self, feedback, frozen, twist, voltage):
        self.error = twist - self.command
        self.past[self.tick % 100] = feedback
        self.sum += 30 * PERIOD * self.gain[:, None] * feedback


def scenario(steering, world, draw, **changes):
    """A draw of the default robot, every second one with the perturbation `all`."""
    perturbation = PERTURBATIONS["all"] if draw % 2 else Perturbation()
    place = IDEAL if world == "paper" else {"sensing": {"tier": world}}
    values = {
        "steering": steering,
        "seed": draw,
        "reference": Lemniscate(period=12.0),
        "prior": "model",
        "learner": "none",
    }
    return Scenario.from_dict({**values, "perturbation": perturbation, **place, **changes})


def attack(steering, world, draws, laps, grow, kinds=KINDS):
    """Returns the runs of all kinds and draws, and both, row by row."""
    rows = [(kind, k) for k in range(len(draws)) for kind in kinds]
    runs = simulate(
        [scenario(steering, world, draws[k], laps=laps) for _, k in rows],
        feedforward=lambda robot, size: Adversary(
            [kind for kind, _ in rows], [draws[k] for _, k in rows], robot, steering == "rigid", grow
        ),
    )
    return runs, rows


def check(steering, world, draws, laps, grow):
    """No robot is lost that PID alone keeps, and NaN is reported."""
    runs, rows = attack(steering, world, draws, laps, grow)
    alone = simulate([scenario(steering, world, draw, laps=laps, prior="none") for draw in draws]).failed.values
    print(steering, world, "lost: PID alone", alone.sum(), "of", len(alone), "guarded", runs.failed.values.sum(),
          "of", len(rows))  # fmt: skip
    lost = [(kind, k) for (kind, k), failed in zip(rows, runs.failed.values, strict=True) if failed and not alone[k]]
    assert not lost, lost
    broken = np.array([kind in ("NaN", "inf") for kind, _ in rows])
    assert all("not finite" in str(fault) for fault in runs.feedforward_fault.values[broken & ~runs.failed.values])
    assert all(fault == "" for fault in runs.feedforward_fault.values[~broken])


@pytest.mark.parametrize("steering", ARRANGEMENTS)
def test_adversaries(steering):
    """A draw of each kind in the slow world of the paper, which is where robots are lost."""
    check(steering, "paper", (4,), 1, (5, 10))


@pytest.mark.full
@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("steering", ARRANGEMENTS)
def test_many_adversaries(steering, world):
    """Of 40 draws a third in each world, growing over 10 to 60 s."""
    check(steering, world, tuple(range(WORLDS.index(world), 40, len(WORLDS))), 4, (10, 60))


def test_one_breaks():
    """A batch with a row that breaks: that row is what it is alone, and the others are what they are without it."""
    kinds = "sine 0.3 Hz", "NaN", "steps"
    runs, _ = attack("caster", "lab", (3,), 1, (5, 10), kinds)
    for k, kind in enumerate(kinds):
        alone, _ = attack("caster", "lab", (3,), 1, (5, 10), (kind,))
        for name in ("x", "y", "voltage_left", "feedforward_right", "guard"):
            assert np.array_equal(runs[name].values[k], alone[name].values[0]), (kind, name)
        assert runs.feedforward_fault[k].item() == alone.feedforward_fault[0].item()


LEARNERS = [name for name, pair in FEEDFORWARDS.items() if pair["learner"] in ("fel", "rls", "mrac", "composite")]
BENIGN = "nominal", "all", "payload aside", "slope 10°", "mass +50 %", "supply -20 %", "drive friction x3"


def benign(cases, draws, laps, **changes):
    """Returns the share of benign runs in which the guard acts, and the largest rise of a case's median error.

    A case is an arrangement, a tier, the name of a perturbation and a learner.
    """

    def runs(cases, on):
        return simulate([
            scenario(steering, tier, draw, laps=laps, guard=Guard(on=on), perturbation=PERTURBATIONS[name],
                     **FEEDFORWARDS[learner], **changes)
            for steering, tier, name, learner in cases for draw in draws
        ])  # fmt: skip

    watched = runs(cases, True)
    acted = (watched.guard.values > 0).any(axis=1)
    some = np.flatnonzero(acted.reshape(len(cases), -1).any(axis=1))  # elsewhere it changes no bit: `test_silent`
    rise = 0.0
    if len(some):
        bare = runs([cases[k] for k in some], False)
        for error in ("position_rmse", "v_rmse", "omega_rmse"):
            on, off = (per_lap(r)[error].values[:, -1].reshape(-1, len(draws)) for r in (watched, bare))
            on, off = (np.median(np.nan_to_num(x, nan=1e9), axis=1) for x in (on[some], off))  # a lost run counts
            rise = max(rise, (on / off).max() - 1)
        print(guard_events(watched).to_string())
    return acted.mean(), rise


def test_benign():
    """Learners in order, with little and much noise: the guard does nothing.

    Each learner has either perturbation in half of the arrangements and tiers, and in all of them with the mark `full`.
    """
    each = product(enumerate(ARRANGEMENTS), enumerate(TIERS), enumerate(LEARNERS))
    cases = [(steering, tier, BENIGN[(i + j + k) % 2], learner) for (i, steering), (j, tier), (k, learner) in each]
    assert benign(cases, (0,), 1, physics_step=0.005) == (0.0, 0.0)


@pytest.mark.full
@pytest.mark.parametrize("tier", TIERS)
def test_much_benign(tier):
    """It acts in at most 1 % of the runs, and raises no case's median by more than 1 %."""
    acted, rise = benign(list(product(ARRANGEMENTS, (tier,), BENIGN, LEARNERS)), range(5), 4)
    print(tier, "acted in", acted, "largest rise", rise)
    assert acted <= 0.01 and rise <= 0.01


def recovery(robot, rigid, gains, loops, delay, limits):
    """Largest position error in m of each channel that follows from any state within limits, at any of several speeds.

        |e(t)| ≤ maxₜ Σ limit · |response of e to that state alone|

    The limits of a channel are the largest error of its velocity in m/s or rad/s, of the `integral` in V (rad/s on a
    steering channel), of the `position` in m and of the `heading` in rad.
    """
    found = []
    for channel in range(2):
        errors = 0.0
        for speed, plant in points(robot, rigid, channel):
            loop = LinearLoop(robot, rigid, channel, plant, gains[channel], loops, speed, delay, PERIOD)
            total = 0.0
            for name, limit in limits[channel].items():
                state = np.zeros(len(loop.step))
                state[loop.state[name]] = limit
                total = total + np.abs(loop.response(state)[1])
            errors = max(errors, np.max(total))
        found.append(errors)
    return found


@pytest.mark.parametrize("world", ["lab", "paper"])
@pytest.mark.parametrize("steering", ARRANGEMENTS)
def test_guarantee(steering, world):
    """The worst learner within D keeps the errors near the region, and one beyond it what the loops recover from.

    The linear loops bound the posture error by ρ̄ and the position error by `recovery`; the limits on acceleration and
    the turns of the lemniscate add to them, most of all under rigid steering with the slow PID of the paper. What a
    learner adds to the model's error of the velocity stays within ē or, where the motion controller's answer takes it
    beyond, D · ‖G‖₁ of the whole linear loop; 5 % are for what is not linear.
    """
    seeds = range(3 if world == "lab" else 1)
    bases = [scenario(steering, world, seed, laps=1, initial_spread=(0, 0, 0), learner="none") for seed in seeds]
    base = bases[0]
    rigid, delay = steering == "rigid", base.sensing.periods("delay", PERIOD) * PERIOD
    _, robot = mjcf.build(base.world, steering, base.physics_step, base.robot)
    gains = base.pid.channels(robot, rigid, delay, PERIOD)
    loops = motion(robot, rigid, gains, delay, PERIOD)
    if world == "paper":
        loops = loops._replace(kanayama=base.kanayama, prefilter=base.prefilter)
    region = base.guard.velocity * np.array([robot.max_speed, robot.max_rotation])
    deviation, within = harmless(region, np.array(rejection(robot, rigid, gains, loops, delay, PERIOD)))
    corner = [{"velocity": region[k], "integral": 2 * deviation[k], "position": TOLERATED_POSTURE} for k in range(2)]
    corner[1]["heading"] = TOLERATED_POSTURE / HEADING_ARM
    k = loops.kanayama
    corner[0]["correction"] = k.k_x * TOLERATED_POSTURE
    corner[1]["correction"] = robot.max_speed * np.hypot(k.k_y, k.k_theta / HEADING_ARM) * TOLERATED_POSTURE
    bound = np.hypot(*recovery(robot, rigid, gains, loops, delay, corner))
    assert TOLERATED_POSTURE < bound < 0.3
    answered = within * [
        max(LinearLoop(robot, rigid, k, plant, gains[k], loops, speed, delay, PERIOD).sums()[0]
            for speed, plant in points(robot, rigid, k))
        for k in range(2)
    ]  # fmt: skip
    assert (answered < 1.3 * region).all()

    frequencies, shares = np.array([0.15, 0.3, 1.0]), np.repeat([0.99, 3.0], 3)

    class Worst(Adversary):
        def __init__(self, nominal, size):
            super().__init__(["bang-bang"] * size, [0, 1, 2] * (size // 3), nominal, rigid, (10, 20))
            self.on = np.tile(shares, len(seeds))[:, None] * within
            self.size[:], self.begin[:], self.frequency[:] = 1.0, 1.0, np.tile(frequencies, size // 3)

    guards = [{"on": share > 1, "growth": 100.0} for share in shares]  # the guard ends oscillations
    runs = simulate([one.replace(guard=guard) for one in bases for guard in guards], feedforward=Worst)
    assert not runs.failed.any()
    beyond = np.tile(shares > 1, len(seeds))
    calm, wild = runs.isel(run=~beyond), runs.isel(run=beyond)
    position = np.hypot(calm.x - calm.x_ref, calm.y - calm.y_ref)
    posture = np.hypot(position, HEADING_ARM * np.angle(np.exp(1j * (calm.theta - calm.theta_ref))))
    slack = 1.5 if (steering, world) == ("rigid", "paper") else 1.0
    assert posture.values.max() < slack * TOLERATED_POSTURE
    if not rigid:
        model = simulate(bases)
        largest, own = (
            np.abs(np.stack([one.v_command - one.v, one.omega_command - one.omega], axis=-1)).max(axis=1)
            for one in (calm, model)
        )
        assert (largest - np.repeat(own, len(frequencies), axis=0) < 1.05 * np.maximum(answered, region)).all()
        assert (np.median(largest.reshape(len(seeds), -1, 2).max(axis=1), axis=0) < 1.05 * region).all()
    assert position.values.max() < bound
    assert np.hypot(wild.x - wild.x_ref, wild.y - wild.y_ref).values.max() < 1.5 * bound


def test_gains_change():
    """Slower gains let a voltage do more, and an event with another PID changes D at once."""
    slow, fast = Pid(time_constant=0.3), Pid(time_constant=0.05)
    base = scenario("compliant", "paper", 0, pid=fast, events=[{"time": 0.05, "pid": slow}])
    robot = mjcf.build(base.world, "compliant", base.physics_step, base.robot)[1]
    loops = motion(robot, False, fast.channels(robot, False))._replace(kanayama=base.kanayama, prefilter=base.prefilter)
    weak, strong = (
        np.array(rejection(robot, False, p.channels(robot, False), loops, 0.0, PERIOD)) for p in (slow, fast)
    )
    simulation = Simulation([base], threads=1)
    bounds = []
    for _ in range(10):
        simulation.step()
        bounds.append(simulation.hierarchy.state["guard"]["harmless"][0].copy())
    region = simulation.hierarchy.state["guard"]["region"][0]
    assert (weak[:, 0] > 2 * strong[:, 0]).all()
    np.testing.assert_allclose(bounds[4], harmless(region, strong)[0])
    np.testing.assert_allclose(bounds[5], harmless(region, weak)[0])
