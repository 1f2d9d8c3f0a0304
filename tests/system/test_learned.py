"""What a learner has adapted, kept in a file: the next run starts from it, on another course and frozen or not."""

import json

import numpy as np
import pytest

import mrctl
from mrctl import FEEDFORWARDS, PERTURBATIONS, Circle, Event, Fel, InputError, Lemniscate, Scenario, Sensing
from mrctl.control import learners
from mrctl.loop.hindsight import best_fixed
from mrctl.loop.learned import load_learned
from mrctl.loop.simulation import Simulation

COURSE, OTHER = Lemniscate(size=1.2, period=10), Circle(radius=0.8, period=8)
BASE = Scenario(
    sensing=Sensing(tier="ideal"), perturbation=PERTURBATIONS["all"], reference=COURSE, laps=1, initial_spread=(0, 0, 0)
)
FROZEN = (Event(time=0.0, learning=False),)
LEARNERS = ("fel", "model+fel", "model+rls", "model+mrac", "model+composite", "model+observer", "model+l1")


class Still:
    """A motion controller of the user, which wants every robot to stand."""

    def __init__(self, robot, size):
        self.twist = np.zeros((size, 2))

    def reset(self, pose, reference, period):
        pass

    def output(self, pose, twist, reference):
        return self.twist


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A file of what each learner has adapted in a lap."""
    folder = tmp_path_factory.mktemp("learned")
    runs = mrctl.simulate([BASE.model_copy(update=FEEDFORWARDS[name]) for name in LEARNERS])
    for k, name in enumerate(LEARNERS):
        mrctl.save_learned(folder / f"{name}.safetensors", runs.isel(run=k))
    return {name: (str(folder / f"{name}.safetensors"), runs.isel(run=k)) for k, name in enumerate(LEARNERS)}


@pytest.mark.parametrize("name", LEARNERS)
def test_starts_where_it_ended(name, files):
    """Before the first tick the learner of the next run has what was saved, to the bit, and in a batch its own."""
    file, run = files[name]
    pair = [BASE.model_copy(update=FEEDFORWARDS[name] | {"learned": path}) for path in (file, None)]
    learner = Simulation(pair).hierarchy.learner
    found, fresh = learner.adapted()
    kept = found == load_learned(pair[0])
    # But for the slope and the disturbance, which belong to another place and moment.
    if name == "model+composite":
        assert kept.sum() == 2 * (8 + 8 * 8) and np.array_equal(found[:8], run.weights.values[:8])
    elif name.endswith("rls"):
        assert kept.sum() == 8 * 2 + 8 * 8 and np.array_equal(found[:16], run.weights.values[:16])
    elif name.endswith("mrac"):
        assert np.array_equal(found[:16], run.weights.values[:16]) and not found[16:20].any()
    else:
        assert kept.all()
    assert (found != fresh).any()


def test_beside_another_feedforward(files):
    """What `compare` adds, and the best fixed feedforward, have nothing to do with what the first learner kept."""
    first = BASE.model_copy(update={"learner": "fel", "learned": files["fel"][0], "name": "first"})
    for name in ("none", "model+rls", "fel"):
        other = first.with_feedforward(name)
        assert (other.feedforward, other.learned, other.name) == (name, None, "")
        assert Simulation([other]).ticks == Simulation([first]).ticks
    assert not best_fixed([first]).failed.any()


@pytest.mark.parametrize("name", LEARNERS[:5])
def test_transfer(name, files):
    """Learned on one course, frozen on another: it tracks the robot that the model does not know from its first lap on.

    Not frozen, it begins as well and goes on learning.
    """
    pair = FEEDFORWARDS[name]
    elsewhere = BASE.model_copy(update={**pair, "reference": OTHER})
    alone = elsewhere.model_copy(update={"learner": "none"})
    kept = elsewhere.model_copy(update={"learned": files[name][0]})
    frozen = kept.model_copy(update={"events": FROZEN})
    runs = mrctl.simulate([alone, frozen, kept])
    without, still, onward = mrctl.per_lap(runs).feedback_share.values[:, 0]
    assert still < 0.6 * without and onward < 0.6 * without
    assert runs.feedforward_left.values[1, 0] == runs.feedforward_left.values[2, 0] != 0


def test_refused(files, tmp_path):
    """A learner that keeps nothing, another learner's file, several runs, a user's stage: one line that says which."""
    with pytest.raises(InputError, match="^learned: the learner indi keeps nothing that a run could start from$"):
        Simulation([BASE.model_copy(update=FEEDFORWARDS["model+indi"] | {"learned": "x.safetensors"})])
    with pytest.raises(InputError, match=r"^learned: .*fel\.safetensors was learned by fel, not by rls$"):
        Simulation([BASE.model_copy(update={"learner": "rls", "learned": files["fel"][0]})])
    (tmp_path / "learned.safetensors").touch()
    with pytest.raises(InputError, match=r"^learned: .* is a folder; give .*/learned\.safetensors$"):
        Simulation([BASE.replace(learned=tmp_path)])
    other = BASE.replace(robot="turtlebot", reference=Circle(radius=0.5, period=12.0), learned=files["fel"][0])
    with pytest.warns(UserWarning, match=r"fel\.safetensors was learned on the robot car, not on turtlebot$"):
        Simulation([other])
    with pytest.raises(InputError, match="^result: must be an xarray.Dataset, .* not of type PosixPath$"):
        mrctl.save_learned(files["fel"][1], tmp_path / "x.safetensors")  # in the order of `mrctl.save`
    with pytest.raises(InputError, match="^run: 2 runs; choose one"):
        mrctl.save_learned(tmp_path / "x", mrctl.simulate([BASE.model_copy(update={"laps": 1})] * 2))
    with pytest.raises(InputError, match="^learned: no learner of the run keeps anything"):
        mrctl.save_learned(tmp_path / "x", mrctl.simulate(BASE.model_copy(update={"learner": "none"})))
    older = files["model+rls"][1].isel(weight=slice(80))  # before 0.40.0, without the heading
    older.attrs["versions"] = json.dumps({"mrctl": "0.39.0"})
    with pytest.raises(InputError, match=r"^learned: rls kept 80 numbers in mrctl 0\.39\.0, and keeps 120 now$"):
        mrctl.save_learned(tmp_path / "x", older)
    keeping = {name for name, law in learners.LEARNERS.items() if law.kept(Fel())}
    assert keeping == {"observer", "l1", "fel", "rls", "mrac", "composite"}


def test_renewed(files):
    """A robot that begins anew with another file is reset to that one, and to nothing where it has none."""
    first, second = (files[name][0] for name in ("model+rls", "model+fel"))
    start = BASE.model_copy(update=FEEDFORWARDS["model+rls"] | {"learned": first})
    hierarchy = Simulation([start, start]).hierarchy
    hierarchy.renew(1, start.model_copy(update={"learned": None}))
    hierarchy.restore(np.arange(2))
    kept, fresh = hierarchy.learner.adapted()
    assert np.array_equal(kept[:16], load_learned(start)[:16]) and not fresh[:16].any()
    own = Simulation([start], motion=Still).hierarchy  # with a stage of the user beside it
    own.restore(np.arange(1))
    assert np.array_equal(own.learner.adapted()[0], kept)
    with pytest.raises(InputError, match="was learned by fel, not by rls"):
        hierarchy.renew(0, start.model_copy(update={"learned": second}))


def test_other_voltages(files, tmp_path):
    """What was learned beside a prior would be added to it twice, and volts are no rate of a fork."""
    alone = BASE.model_copy(update=FEEDFORWARDS["model+rls"] | {"learned": files["model+rls"][0], "prior": "none"})
    with pytest.raises(InputError, match=r"learned with the prior model, not with none$"):
        mrctl.simulate(alone)
    rigid = BASE.model_copy(update=FEEDFORWARDS["model+rls"] | {"learned": files["model+rls"][0], "steering": "rigid"})
    with pytest.raises(InputError, match=r"learned with compliant steering, not with rigid$"):
        mrctl.simulate(rigid)
    scaled = BASE.model_copy(update=FEEDFORWARDS["fel"] | {"learned": files["fel"][0], "fel": Fel(output_scale=12.0)})
    with pytest.raises(InputError, match=r"learned with fel\.output_scale 6\.0, not 12$"):
        mrctl.simulate(scaled)


@pytest.mark.parametrize("name", ["fel", "model+rls", "model+composite"])
def test_start_with_what_was_learned(name, tmp_path):
    """A robot that starts with what was learned of it has less error than one that knows nothing, from the start on."""
    new = mrctl.Scenario(perturbation="all", initial_spread=(0, 0, 0), **FEEDFORWARDS[name])
    first = mrctl.simulate(new.replace(laps=3))
    mrctl.save_learned(tmp_path / "all.safetensors", first)
    again = mrctl.simulate(new.replace(laps=1, learned=str(tmp_path / "all.safetensors")))
    without, known = (
        np.sqrt(np.mean(run.longitudinal_error[:50] ** 2 + run.lateral_error[:50] ** 2)) for run in (first, again)
    )
    assert known < 0.6 * without


def test_norm_of_what_was_learned(files):
    """A run that starts from coefficients and does not learn has their norm from its first tick on."""
    update = {"learned": files["model+rls"][0], "events": FROZEN}
    run = mrctl.simulate(BASE.model_copy(update=FEEDFORWARDS["model+rls"] | update))
    assert np.allclose(run.weight_norm, np.linalg.norm(files["model+rls"][1].weights.values[:16]), rtol=1e-6)
