"""The guard in the loop: what diverges without it does not with it, and what is sound it leaves alone, to the bit."""

import json
import re

import numpy as np
import pytest

from mrctl import (
    FEEDFORWARDS,
    PERTURBATIONS,
    Circle,
    Event,
    Fel,
    Guard,
    Lemniscate,
    Perturbation,
    Rls,
    Scenario,
    guard_events,
    per_lap,
    simulate,
)
from mrctl.control.mrac import Mrac
from mrctl.experiments import single
from mrctl.experiments.paper import IDEAL
from mrctl.loop.simulation import Simulation
from mrctl.results.dataset import SIGNALS
from mrctl.sensing.tiers import Sensing

OFF = Guard(on=False)
ERRORS = ("position_rmse", "v_rmse", "omega_rmse")
DELAYED = Scenario(**IDEAL, reference=Lemniscate(period=12.0), laps=3, perturbation=Perturbation(control_delay=0.04))
LATE = DELAYED.model_copy(update={"perturbation": Perturbation(control_delay=0.06)})


def fast(times):
    """Settings with which both learn so many times as fast as by default; 1 is the largest step of `fel`."""
    rate = 0.02 * times
    return {
        "fel": Fel(step=min(0.1 * times, 1.0)),
        "rls": Rls(step=rate, initial_covariance=10 * rate, covariance_bound=10 * rate),
    }


FAST = fast(10)


def of(scenario, feedforward, guard=OFF, **changes):
    """The scenario with another learner and guard."""
    return scenario.model_copy(update={**FEEDFORWARDS[feedforward], "guard": guard, **changes})


def same(one, other):
    """Two runs with the same bits in every signal."""
    return all(np.array_equal(one[name].values, other[name].values, equal_nan=True) for name in SIGNALS)


@pytest.mark.parametrize(
    ("steering", "name", "delay", "times"),
    [("compliant", "rls", 0.06, 25), ("caster", "fel", 0.06, 10), ("rigid", "rls", 0.06, 15)],
)
def test_too_fast(steering, name, delay, times):
    """Delay and many times the learning rate: without the guard it shakes the robot, with it it tracks."""
    base = of(DELAYED, "none", steering=steering, perturbation=Perturbation(control_delay=delay))
    runs = simulate([base, of(base, name, **fast(times)), of(base, name, Guard(), **fast(times))])
    laps = per_lap(runs)
    pid, bare, guarded = (np.array([laps[error].values[k] for error in ERRORS]) for k in range(3))
    assert (bare[:, 0] > 2 * pid[:, 0]).sum() >= 2 and np.abs(runs.feedforward_right[1]).max() > 30
    assert not runs.failed[2] and np.abs(runs.feedforward_right[2]).max() <= np.nextafter(24.0, 25.0)  # the supply
    assert (guarded[0] < pid[0]).all()  # position, also in the lap in which it happened
    assert (guarded[:, 2:] < 0.75 * pid[:, 2:]).all()  # everything, from the third lap on
    events = guard_events(runs)
    assert set(events["run"]) == {2}
    assert set(events["reason"]) - {""} <= {"sustained oscillation", "velocity far from the command"}
    assert laps["guard_actions"].values[2].sum() == (events["action"] != "resume").sum()
    acts = np.flatnonzero(np.diff(runs.guard.values[2]) > 0)[0] + 2  # a fallback has begun, and lasts
    assert len(guard_events(runs.isel(time=slice(acts, None)))) == len(events) - 1
    actions = laps["guard_actions"].values
    assert (actions[0] == 0).all()
    lost = np.isnan(bare[0])  # the laps from the one on in which the robot without a guard is lost, if it is
    assert (actions[1][~lost] == 0).all() and lost.any() == runs.failed[1]


@pytest.mark.parametrize("tier", ["ideal", "lab"])
def test_slow_pid_without_a_prior(tier):
    """PID alone is far off with a slow PID; the guard does not take that for a fault of `fel`, which learns it away."""
    start = {"prior": "none", "learner": "fel", "pid": {"time_constant": 0.15}, "sensing": {"tier": tier}}
    scenario = Scenario.from_dict(start | {"laps": 4, "seed": 1})
    runs = simulate([scenario, scenario.replace(guard={"on": False}), scenario.replace(learner="none")])
    lap = per_lap(runs).position_rmse.values
    assert guard_events(runs).empty and np.array_equal(lap[0], lap[1])
    assert lap[2, -1] > 0.1 and lap[0, -1] < 0.1 * lap[2, -1]


def test_silent():
    """Learners in order: nothing happens, and every bit is what it is without a guard."""
    push = (Event(time=6.0, push=(0.0, 40.0, 0.0)), Event(time=9.0, perturbation=Perturbation(payload=5.0)))
    noise = Sensing(tier="lab")
    cases = (
        {"perturbation": PERTURBATIONS["all"]},
        {"events": push, "perturbation": Perturbation()},
        {"sensing": noise},
        {"perturbation": Perturbation(control_delay=0.04)},
    )
    for name in FAST:
        scenarios = [of(DELAYED, name, laps=1, **case) for case in cases]
        watched = simulate([scenario.model_copy(update={"guard": Guard()}) for scenario in scenarios])
        bare = simulate(scenarios)
        assert guard_events(watched).empty
        assert all(same(watched.isel(run=k), bare.isel(run=k)) for k in range(len(cases)))


def test_batch():
    """A guard that acts in one row does what it does alone, and nothing to the others."""
    hasty = of(LATE, "fel", Guard(), steering="rigid", laps=1, **FAST)
    calm = of(hasty, "fel", Guard(), fel=Fel(step=0.02), seed=3)
    together = simulate([calm, hasty, calm])
    alone = simulate(hasty)
    assert set(guard_events(together)["run"]) == {1} and not guard_events(alone).empty
    assert same(together.isel(run=1), alone)
    assert same(together.isel(run=0), simulate(calm)) and same(together.isel(run=0), together.isel(run=2))


class Shakes:
    """A user's stage that begins to shake after a second, and cannot forget; in row 1 it breaks instead."""

    def __init__(self, robot, size):
        self.ticks, self.out = 0, np.zeros((size, 2))

    def output(self, command, derivative):
        self.ticks += 1
        t = max(0.01 * self.ticks - 1, 0)
        self.out[:, 1] = np.sin(6 * t) * min(np.expm1(3 * t), 60)
        if t > 0:
            self.out[1:2] = np.nan
        return self.out

    def learn(self, feedback, frozen, twist, voltage):
        pass


def test_own_stage():
    """A stage that shakes loses its authority, one that breaks for good, and the robot goes on tracking; it is told."""
    base = DELAYED.model_copy(update={"laps": 1, "perturbation": Perturbation()})
    bare = simulate([of(base, "none")] * 2, feedforward=Shakes)
    watched = simulate([of(base, "none", Guard(hold=0.3, retries=2))] * 2, feedforward=Shakes)
    pid = simulate([of(base, "none")])
    errors = [np.hypot(run.x - run.x_ref, run.y - run.y_ref).values for run in (bare, watched, pid)]
    assert errors[0][0].max() > 0.5 and bare.failed[1]
    assert not watched.failed.any() and errors[1][0].max() < 0.2 * errors[0][0].max()
    assert str(bare.failure[1].item()) == "feedforward Shakes: not finite, tick 99"
    assert watched.feedforward_fault.values.tolist() == ["", "feedforward Shakes: not finite, tick 99"]
    late = watched.time.values > 6.0
    for row in range(2):
        assert errors[1][row, late].max() < errors[2][0, late].max()
    events = guard_events(watched)
    assert (watched["guard"][1, late] == 1).all()
    assert set(events[events["run"] == 0]["reason"]) - {""} == {"velocity far from the command"}
    assert (events[events["run"] == 1]["reason"] == "output not finite").any()


class Takes:
    """A user's feedforward whose `learn` returns its whole output in row 0, and far too much in row 1."""

    def __init__(self, robot, size):
        self.out = np.zeros((size, 2))

    def output(self, command, derivative):
        self.out = np.array([21.0, 5.0]) * command
        return self.out

    def learn(self, feedback, frozen, twist, voltage):
        return np.concatenate([self.out[:1], 1e6 * feedback[1:]])


def test_what_learning_takes_from_the_integral():
    """A learner that hands over what it did not learn takes the robot off its path, and the guard stops it."""
    quiet = of(DELAYED, "none", Guard(), laps=2, perturbation=Perturbation())
    bare = simulate([quiet.model_copy(update={"guard": OFF})] * 2, feedforward=Takes)
    watched = simulate([quiet] * 2, feedforward=Takes)
    off = np.hypot(watched.x - watched.x_ref, watched.y - watched.y_ref)
    assert bare.failed.all() and not watched.failed.any() and off.max() < 0.25
    assert set(guard_events(watched)["reason"]) - {""} == {"velocity far from the command"}


class Proportional:
    """A user's feedback without an integral."""

    def __init__(self, robot, size):
        pass

    def reset(self, steady, period):
        pass

    def output(self, command, twist, excess):
        return np.array([20.0, 4.0]) * (command - twist)


class Breaks:
    """A user's feedforward in proportion to the command, which suits a weak supply, until it breaks after 3 s."""

    def __init__(self, robot, size):
        self.ticks = 0

    def output(self, command, derivative):
        self.ticks += 1
        return np.array([17.0, 3.0]) * command if self.ticks <= 300 else np.full(command.shape, np.nan)

    def learn(self, feedback, frozen, twist, voltage):
        pass


def test_feedback_without_integral():
    """The fallback begins without a step in voltage, too, where no integral can take over what the model lacks."""
    weak = of(DELAYED, "none", Guard(), laps=1, perturbation=Perturbation(supply_factor=0.6))
    run = simulate([weak], feedforward=Breaks, feedback=Proportional).isel(run=0)
    assert run["guard"].values[298:300].tolist() == [0, 1]
    sent = np.stack([run["voltage_left"].values, run["voltage_right"].values])
    steps = np.abs(np.diff(sent)).max(axis=0)
    assert np.ptp(sent[:, 298:340], axis=1).max() > 3.0  # what the model gives less
    assert steps[298:340].max() < 0.6  # of which 9 % go in a tick; all at once would be 7 V


@pytest.mark.parametrize("stages", [{}, {"feedback": Proportional}])
def test_nothing_is_taken_where_there_is_no_integral(stages):
    """A learner takes nothing from a feedback without an integral, so the guard counts nothing."""
    simulation = Simulation([of(DELAYED, "none", Guard())] * 2, feedforward=Takes, **stages)
    for _ in range(10):
        simulation.step()
    assert simulation.hierarchy.state["guard"]["handed"].any() == (not stages)


def test_told():
    """A run says how often and why."""
    fast = of(LATE, "fel", Guard(), steering="rigid", laps=1, **FAST)
    text, *_ = single.run(fast, None, False)
    assert re.search(r"guard acted, times \|\n.*\n.* \| [1-9]\d* +\|", text) and re.search(
        r"guard at \d\.\d\d s: fallback, velocity far from the command", text
    )
    listed = json.loads(single.run(fast, None, True)[0])
    assert {"time", "action", "reason"} == set(listed["guard"][0])
    assert listed["laps"][0]["guard_actions"] == sum(event["action"] != "resume" for event in listed["guard"])


def test_learner_that_is_not_finite():
    """Where a learner adds NaN, the guard falls back to the model before the integral of the PID takes it over."""
    silent = Mrac().model_copy(update={"noise": 1e-8})  # below the bound of the field, so that its law overflows
    broken = Scenario(learner="mrac", laps=1, reference=Circle(radius=1, period=8)).model_copy(update={"mrac": silent})
    run = simulate(broken)
    assert not run.failed and guard_events(run)["reason"].iloc[0] == "output not finite"
    assert np.isfinite(run.voltage_left).all()
    assert simulate(broken.model_copy(update={"guard": OFF})).failed
