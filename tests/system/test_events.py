"""What happens in the middle of a run takes effect at its tick, does what it says, and can be taken back."""

import numpy as np
import pytest

from mrctl import Circle, Event, Fel, InputError, Kanayama, Line, Perturbation, Pid, Scenario
from mrctl.experiments.paper import IDEAL
from mrctl.loop.runs import simulate
from mrctl.loop.simulation import Simulation
from mrctl.physics import mjcf
from mrctl.physics.perturb import fields
from mrctl.results.dataset import SIGNALS
from mrctl.theory.dynamics import inverse_coefficients

PERIOD = 0.01
BASE = Scenario(**IDEAL, reference=Circle(period=4, radius=0.5), laps=1, prior="model", learner="none")
PAYLOAD = Perturbation(payload=5, payload_x=0.15, payload_y=0.05)


def with_events(*events, base=BASE, **changes):
    """A run with events."""
    return base.model_copy(update={"events": events, **changes})


def first_difference(one, other) -> int:
    """The first tick at which any recorded signal differs, bit for bit."""
    a, b = (np.array([run[name].values for name in SIGNALS]) for run in (one, other))
    differs = ~((a == b) | (np.isnan(a) & np.isnan(b))).all(axis=0)
    return int(np.argmax(differs)) if differs.any() else len(differs)


@pytest.mark.parametrize(
    "change",
    [
        {"perturbation": PAYLOAD},
        {"perturbation": Perturbation(control_delay=0.02)},
        {"perturbation": Perturbation(supply_factor=0.9)},
        {"push": (10, 0, 0)},
        {"kanayama": Kanayama(k_x=1)},
        {"pid": Pid(time_constant=0.3)},
    ],
    ids=lambda change: "-".join(change),
)
def test_tick(change):
    """The record is the same before, to the bit, and another from the first control tick on that is not before."""
    ticks = {0.0: 0, 0.07: 7, 1.0: 100, 1.501: 151, 1.51: 151, 2.9999: 300}
    runs = simulate([BASE, *(with_events(Event(time=time, **change)) for time in ticks)])
    for row, tick in enumerate(ticks.values(), 1):
        # A change of the plant shows in the state one tick after, in currents and commands at once.
        assert tick <= first_difference(runs.isel(run=0), runs.isel(run=row)) <= tick + 1


def test_learning_switch():
    """Learning stops at its tick and goes on at the other; in between the weights stand still."""
    base = BASE.model_copy(update={"prior": "none", "learner": "fel"})
    run = simulate(with_events(Event(time=1, learning=False), Event(time=2, learning=True), base=base))
    norm = run.weight_norm.values
    moves = np.flatnonzero(np.diff(norm)) + 1
    assert not ((moves >= 100) & (moves < 200)).any()
    assert (moves < 100).sum() > 50 and (moves >= 200).sum() > 50


def test_after_the_end():
    """An event that never comes changes nothing."""
    pair = simulate([BASE, with_events(Event(time=4.0, push=(1e3, 0, 0)), Event(time=1e8, perturbation=PAYLOAD))])
    assert first_difference(pair.isel(run=0), pair.isel(run=1)) == 400


def test_same_moment():
    """Two events at one tick happen in the order given: the last perturbation counts."""
    both = with_events(Event(time=1, perturbation=PAYLOAD), Event(time=1, perturbation=Perturbation(mass_factor=1.2)))
    last = with_events(Event(time=1, perturbation=Perturbation(mass_factor=1.2)))
    pair = simulate([both, last])
    assert first_difference(pair.isel(run=0), pair.isel(run=1)) == 400


def test_added_in_the_same_tick():
    """Of two events in one tick the later one acts last, also if the earlier one is added while the run goes on."""
    late, early = Event(time=1.005, perturbation=PAYLOAD), Event(time=1.002, perturbation=Perturbation())
    live = Simulation([with_events(late)])
    live.add(early)
    while live.running:
        live.step()
    again = simulate(with_events(late, early))
    assert first_difference(live.result().isel(run=0), again) == again.sizes["time"]


def test_added_after_sensing():
    """An event for a tick whose events have been applied is refused; one for the next tick acts as in a new run."""
    live = Simulation([BASE])
    live.step()
    live.sense()
    with pytest.raises(InputError, match=r"time: 0\.01 s has passed, the next tick is at 0\.02 s"):
        live.add(Event(time=0.01, perturbation=PAYLOAD))
    with pytest.raises(InputError, match="has passed"):
        live.add(Event(time=0.01, reference=BASE.reference))
    assert live.scenarios == Simulation([BASE]).scenarios
    live.add(Event(time=0.02, perturbation=PAYLOAD))
    while live.running:
        live.step()
    again = simulate(live.scenarios[0])
    assert first_difference(live.result().isel(run=0), again) == again.sizes["time"]


def test_step_after_the_end():
    """A step beyond the last tick is refused with one line, and the result stays as it is."""
    live = Simulation([BASE.replace(reference=Line(speed=0.5, length=0.025), laps=1)])
    while live.running:
        live.step()
    before = live.result()
    for _ in range(2):
        with pytest.raises(ValueError, match="^step: the run is over after 5 control periods$"):
            live.step()
    assert live.result().identical(before)


@pytest.mark.parametrize("size", [1, 2])
def test_payload_is_taken_off_again(size):
    """Dropped and removed: every parameter of the plant is the nominal one again, to the bit, and so is the prior."""
    events = (Event(time=0.1, perturbation=PAYLOAD), Event(time=0.2, perturbation=Perturbation()))
    simulation = Simulation([with_events(*events, prior="true_model", learner="none")] * size)
    nominal = fields(mjcf.load())
    masses = []
    for _ in range(40):
        simulation.step()
        model = simulation.plant._model_of(size - 1)
        masses.append(model.body_subtreemass[model.body("chassis").id])
    assert masses == pytest.approx([20] * 10 + [25] * 10 + [20] * 20)
    for name, value in nominal.items():
        assert np.array_equal(fields(model)[name], value), name
    assert np.array_equal(model.dof_invweight0, mjcf.load().dof_invweight0)
    assert simulation.plant.truth[-1] == simulation.plant.robot


def test_true_model_follows():
    """It is told of each change: its coefficients are those of the plant as it is."""
    heavy = Perturbation(mass_factor=1.5, supply_factor=0.8, resistance_factor=1.3)
    event = Event(time=0.05, perturbation=heavy)
    simulation = Simulation(
        [with_events(event, prior="true_model", learner="none"), with_events(prior="true_model", learner="none")]
    )
    for tick in range(10):
        simulation.step()
        changed = tick >= 5
        stage, truth = simulation.hierarchy.prior, simulation.plant.truth
        assert (truth[0] != simulation.plant.robot) == changed and truth[1] == simulation.plant.robot
        for row in range(2):
            assert np.array_equal(stage.rows["c"][row], inverse_coefficients(truth[row]))


def test_true_model_is_better():
    """After a change in the middle the true model tracks as before; the model does not."""
    event = Event(time=1, perturbation=Perturbation(mass_factor=1.5, supply_factor=0.7, drive_friction_factor=3))
    base = BASE.model_copy(update={"initial_spread": (0, 0, 0), "laps": 2})
    runs = simulate([with_events(event, base=base, prior=kind, learner="none") for kind in ("true_model", "model")])
    late = runs.isel(time=slice(150, 800))
    error = np.hypot(late.x - late.x_ref, late.y - late.y_ref).mean("time")
    assert error[0] < error[1] / 2


def test_push():
    """The run's velocity jumps by the impulse over the mass that the motors move, while they cannot hold against it."""
    base = Scenario(
        **IDEAL, reference=Line(speed=0.5, length=1.5), laps=1, prior="model", learner="none", initial_spread=(0, 0, 0)
    )
    runs = simulate([with_events(Event(time=1, push=(300, 0, 0), push_duration=0.02), base=base), base])
    jump = float(runs.v[0, 102] - runs.v[1, 102])
    assert jump == pytest.approx(300 * 0.02 / 21.3, rel=0.1)
    sideways = simulate(with_events(Event(time=1, push=(0, 200, 0), push_duration=0.1), base=base))
    assert sideways.y[120] > 1e-3 + sideways.y[100]


def test_overlapping_pushes():
    """Two pushes at a time, also added while the run goes on, are the push of their sum, and a restart ends both."""
    line = Scenario(**IDEAL, reference=Line(speed=0.5, length=0.25), laps=1, learner="none", initial_spread=(0, 0, 0))
    first, second = (
        Event(time=t, push=force, push_duration=0.1) for t, force in ((0.1, (20, 0, 0)), (0.15, (0, 9, 0)))
    )
    parts = ((0.1, (20, 0, 0)), (0.15, (20, 9, 0)), (0.2, (0, 9, 0)))
    whole = [Event(time=t, push=force, push_duration=0.05) for t, force in parts]
    both, summed = simulate(with_events(first, second, base=line)), simulate(with_events(*whole, base=line))
    assert first_difference(both, summed) == both.sizes["time"]
    live = Simulation([line])
    live.add(second)
    live.step()
    live.add(first)
    while live.running:
        live.step()
    assert first_difference(live.result().isel(run=0), both) == both.sizes["time"]
    again = Simulation([with_events(first, second, base=line)], restarting=True)
    for _ in range(17):
        again.step()
    assert again.plant.wrench.any()
    again.restart(0, line)
    again.step()
    assert not again.plant.wrench.any()


def test_delay():
    """Alone and in a batch: what reaches the motors is the command of d ticks before, from the tick of the event on."""
    scenario = with_events(Event(time=0.5, perturbation=Perturbation(control_delay=0.03)))
    for simulation in (Simulation([scenario]), Simulation([BASE, scenario])):
        commands, applied = [], []
        for _ in range(80):
            simulation.step()
            commands.append(simulation.hierarchy.output[-1, :2].copy())
            applied.append(simulation.plant.applied[-1].copy())
        commands, applied = np.array(commands), np.array(applied)
        assert np.array_equal(applied[:50], commands[:50])
        assert np.array_equal(applied[50:], commands[47:77])
        assert len(np.unique(commands[:, 0])) > 70


def test_gains():
    """New gains are in use from their tick on: the same error asks for another command."""
    base = BASE.model_copy(update={"kanayama": Kanayama(k_x=3), "pid": Pid(time_constant=0.15)})
    event = Event(time=0.02, kanayama=Kanayama(k_x=9), pid=Pid(time_constant=0.3))
    simulation = Simulation([with_events(event, base=base)])
    hierarchy = simulation.hierarchy
    for tick in range(4):
        simulation.step()
        assert hierarchy.state["kanayama"]["k_x"][0] == (9 if tick >= 2 else 3)
        gains = Pid(time_constant=0.3 if tick >= 2 else 0.15).gains(simulation.plant.robot, False)
        for name, value in gains.items():
            assert tuple(hierarchy.state["pid"][name][0]) == value, name


def test_settings_of_a_pid_that_is_not_there():
    """New settings of the PID are refused where a user's feedback takes its place, at the start and on the way."""

    class Nothing:
        def __init__(self, robot, size):
            pass

        def reset(self, steady, period):
            pass

        def output(self, command, twist, excess):
            return np.zeros_like(command)

    event = Event(time=0.02, pid=Pid(time_constant=0.3))
    with pytest.raises(InputError, match=r"^events: pid at 0.02 s: the feedback Nothing is not the PID$"):
        Simulation([with_events(event)], feedback=Nothing)
    simulation = Simulation([with_events()], feedback=Nothing)
    with pytest.raises(InputError, match="^events: pid"):
        simulation.add(event)


def test_motion_stage_is_told_its_gains():
    """A motion stage with `tune` gets the gains at the start, from an event, and again when its robot begins anew."""
    told = []

    class Rests:
        def __init__(self, robot, size):
            pass

        def tune(self, row, gains):
            told.append((row, gains.k_x))

        def reset(self, pose, reference, period):
            pass

        def output(self, pose, twist, reference):
            return np.zeros((len(pose), 2))

    scenarios = [with_events().replace(kanayama=Kanayama(k_x=k_x)) for k_x in (1.0, 2.0)]
    simulation = Simulation(scenarios, restarting=True, motion=Rests)
    assert told == [(0, 1.0), (1, 2.0)]
    simulation.add(Event(time=0.0, kanayama=Kanayama(k_x=7.0)))
    simulation.step()
    assert told[2:] == [(0, 7.0), (1, 7.0)]
    simulation.restart(1, scenarios[1])
    assert told[4:] == [(1, 2.0)]


def test_reference():
    """From the event on the robot is shown the new reference from its own start, and follows it."""
    other = Circle(period=5, radius=0.7, clockwise=True)
    event = Event(time=4.0, reference=other)
    changed, plain = (simulate(with_events(*e, laps=3, initial_spread=(0, 0, 0))) for e in ((event,), ()))
    assert first_difference(changed, plain) == 400
    motion = other.sample(PERIOD * np.arange(800))
    for name, column in (("x_ref", motion.pose[:, 0]), ("theta_ref", motion.pose[:, 2]), ("v_ref", motion.twist[:, 0])):
        np.testing.assert_array_equal(changed[name][400:], column)
    assert np.hypot(changed.x - changed.x_ref, changed.y - changed.y_ref)[-100:].max() < 0.02
    together = simulate([with_events(*e, laps=3, initial_spread=(0, 0, 0)) for e in ((event,), (), (event,))])
    for k, one in enumerate((changed, plain, changed)):
        assert first_difference(together.isel(run=k), one) == 1200


def test_impossible_reference():
    """A new reference is held to the robot's limits as the first one is, before anything runs."""
    with pytest.raises(InputError, match="max_speed"):
        Simulation([with_events(Event(time=9, reference=Circle(period=0.5)))])


def test_frozen_from_the_start():
    """`frozen` and learning switched off at once are the same run."""
    off, frozen = with_events(Event(time=0, learning=False)), BASE.model_copy(update={"fel": Fel(frozen=True)})
    pair = simulate([run.model_copy(update={"prior": "none", "learner": "fel"}) for run in (off, frozen)])
    assert first_difference(pair.isel(run=0), pair.isel(run=1)) == 400
    assert (pair.weight_norm == 0).all()
