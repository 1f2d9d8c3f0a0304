"""A robot that fails stops alone: it says when and why, its record ends in NaN, and its neighbours never notice."""

import numpy as np
import pytest

from mrctl import Circle, Event, Guard, Line, Perturbation, Scenario, Sweep, per_lap
from mrctl.control.feedforward import Loop, NoLearner
from mrctl.loop.runs import simulate
from mrctl.results.dataset import SIGNALS
from mrctl.sweep import jobs

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")
PERIOD = 0.01
HEALTHY = [Scenario(reference=Circle(period=4, radius=0.5), laps=1, learner="none", seed=seed) for seed in range(3)]


class BreaksAfter:
    """A user's stage, silent but for NaN in row 1 from its second second on."""

    def __init__(self, robot, size):
        self.calls, self.out = 0, np.zeros((size, 2))

    def output(self, command, derivative):
        self.calls += 1
        if self.calls > 100:
            self.out[1:2, self.calls % 2] = np.nan
        return self.out

    def learn(self, feedback, frozen, twist, voltage):
        pass


def pushed(force, *, duration=0.1, **changes):
    """The second healthy run, pushed after a second."""
    event = Event(time=1.0, push=force, push_duration=duration)
    return HEALTHY[1].model_copy(update={"events": (event,), **changes})


DIVERGING = {
    "lateral": (pushed((4000.0, 4000.0, 0.0)), "lateral error over 1 m"),
    "tilt": (pushed((0.0, 0.0, 5e5), duration=0.02), "tilt over 30°"),
    "blown up": (pushed((1e12, 0.0, 1e15)), "non-finite state"),
    "no grip": (
        Scenario(
            reference=Circle(period=4, radius=0.5),
            laps=2,
            learner="none",
            steering="caster",
            perturbation=Perturbation(mass_factor=4, tyre_friction_factor=0.02),
        ),
        "lateral error over 1 m",
    ),
}


def check_record(run, reason):
    """Failed, at one time, for one reason; finite before, NaN from the sample at which it was noticed."""
    assert bool(run.failed) and str(run.failure.item()) == reason
    tick = round(float(run.failure_time) / PERIOD) - 1
    assert 0 < tick < len(run.time)
    for name in SIGNALS:
        if not name.startswith("fix_"):  # NaN where no fix arrives
            assert np.isfinite(run[name].values[:tick]).all(), name
        assert np.isnan(run[name].values[tick:]).all(), name


def same(one, other):
    """Two runs of equal length with the same bits in every signal."""
    for name in (*SIGNALS, "failed", "failure_time", "failure"):
        a, b = one[name].values, other[name].values
        assert np.array_equal(a, b, equal_nan=a.dtype.kind == "f"), name


@pytest.mark.parametrize("kind", DIVERGING)
def test_diverging(kind):
    """One of three: it fails, the two others are what they are without it."""
    scenario, reason = DIVERGING[kind]
    whole = simulate([HEALTHY[0], scenario, HEALTHY[2]])
    check_record(whole.isel(run=1), reason)
    without = simulate([HEALTHY[0], HEALTHY[2]])
    for run, row in ((0, 0), (2, 1)):
        same(whole.isel(run=run, time=slice(0, 400)), without.isel(run=row))


@pytest.mark.parametrize("kind", DIVERGING)
def test_alone(kind):
    """Through dm_control: the same record, of the length that was asked for, though the work ends at the failure."""
    scenario, reason = DIVERGING[kind]
    alone = simulate(scenario)
    check_record(alone, reason)
    assert len(alone.time) == scenario.ticks
    same(alone, simulate([scenario, HEALTHY[0]]).isel(run=0, time=slice(0, scenario.ticks)))


def test_laps_beside_a_longer_run(tmp_path):
    """A run that fails counts the laps that it was to drive, whatever the length of the runs beside it."""
    short, long = (pushed((4000.0, 4000.0, 0.0), laps=laps) for laps in (2, 5))
    alone, both = (per_lap(simulate(runs)) for runs in (short, [short, long]))
    assert alone["laps"].item() == 2 and both["laps"].values.tolist() == [2, 5]
    later = simulate([short, long]).isel(run=0, time=slice(400, None))
    assert per_lap(later)["laps"].item() == 1
    after = per_lap(simulate([short, HEALTHY[0], long]).isel(time=slice(900, None)))  # the first two have ended
    assert after["position_rmse"].isnull().all() and after["failed"].values.tolist() == [True, False, True]
    axes = [{"field": "laps", "values": [2, 5]}]
    jobs.run(Sweep.from_dict({"base": short.replace(seed=0).model_dump(), "axes": axes, "record": "laps"}), tmp_path, 1)
    assert all(jobs.repeat(tmp_path, run).same for run in (0, 1))


def test_non_finite_stage():
    """Without the guard, a user's stage that breaks in one row stops that row, not with full voltage, and no other."""
    bare = [scenario.model_copy(update={"guard": Guard(on=False)}) for scenario in HEALTHY]
    whole, sound = (
        simulate(bare, feedforward=BreaksAfter),
        simulate(bare, feedforward=lambda robot, size: NoLearner(Loop(robot, False, PERIOD), [None] * size)),
    )
    tick = round(float(whole.failure_time[1]) / PERIOD) - 1
    check_record(whole.isel(run=1), f"feedforward BreaksAfter: not finite, tick {tick}")
    assert float(whole.failure_time[1]) == pytest.approx(1.0, abs=2 * PERIOD)
    for run in (0, 2):
        same(whole.isel(run=run), sound.isel(run=run))


def test_late_failure_beside_nan():
    """A robot that blew up does not hide the failure of another: NaN is no maximum."""
    slides, reason = DIVERGING["no grip"]
    blown = slides.model_copy(update={"events": (Event(time=0.2, push=(1e12, 0.0, 1e15)),)})
    sound = slides.model_copy(update={"perturbation": Perturbation()})
    whole = simulate([blown, slides, sound])
    assert whole.failure_time[0] < whole.failure_time[1]
    check_record(whole.isel(run=1), reason)
    same(whole.isel(run=1), simulate(slides))
    assert not whole.failed[2]


def test_all_fail():
    """Nothing left to do ends the work, not the program."""
    bad = [scenario for scenario, _ in DIVERGING.values()]
    whole = simulate(bad)
    assert whole.failed.all()
    assert list(map(str, whole.failure.values)) == [reason for _, reason in DIVERGING.values()]


def test_no_ground():
    """Off the edge of the world is a failure like any other, here by driving off it."""
    edge = Scenario(
        world="rough", reference=Line(speed=1.0, length=8.0), laps=1, learner="none", initial_spread=(0, 0, 0)
    )
    run = simulate(edge)
    assert bool(run.failed) and 5.5 < float(run.failure_time) < 7.5
