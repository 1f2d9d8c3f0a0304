"""What a feedforward of the user has learned is saved, and the next run starts from it, as with a built-in learner."""

import json

import numpy as np
import pytest
import torch
from safetensors.numpy import load_file, save_file

import mrctl
from mrctl import FEEDFORWARDS, Circle, InputError, Lemniscate, Scenario, Sensing, Sweep
from mrctl.cli import main
from mrctl.control.fel_torch import ModuleLearning
from mrctl.loop.simulation import Simulation
from mrctl.sweep import jobs

BASE = Scenario(
    sensing=Sensing(tier="ideal"), perturbation="all", reference=Lemniscate(size=1.2, period=10), laps=2,
    initial_spread=(0, 0, 0),
)  # fmt: skip
ELSEWHERE = BASE.model_copy(update={"reference": Circle(radius=0.8, period=8), "laps": 1})
OWN = """
import numpy as np

class Own:
    def __init__(self, robot, size):
        self.gain, self.ticks, self.size = np.zeros((size, 2, 2)), np.zeros(size), size
        self.start = 1 / robot.velocity_gain, 1 / robot.rotation_gain

    def output(self, command, derivative):
        self.x = np.stack([command, derivative], axis=2)
        return command * self.start + (self.gain * self.x).sum(2)

    def learn(self, feedback, frozen, twist, voltage):
        self.ticks += 1
        step = 0.05 * (frozen == 0)[:, None] / (0.1 + (self.x**2).sum(2))
        self.gain = self.gain + (step * feedback)[:, :, None] * self.x

    def restore(self, rows):
        self.gain[rows] = 0.0

    def adapted(self):
        return {"gain": self.gain, "ticks": self.ticks}

    def adopt(self, row, learned):
        self.gain[row] = learned["gain"]
        learned["gain"][:] = np.nan  # its own copy
"""
SPACE: dict = {}
exec(OWN, SPACE)
Own = SPACE["Own"]


@pytest.fixture(scope="module")
def learned(tmp_path_factory):
    """What it learned in each of two runs, one of them of another robot, by the file of the first."""
    folder, made = tmp_path_factory.mktemp("own"), []

    def factory(robot, size):
        made.append(Own(robot, size))
        return made[-1]

    factory.__name__ = "Own"
    runs = mrctl.simulate([BASE, BASE.model_copy(update={"perturbation": mrctl.Perturbation()})], feedforward=factory)
    for k in range(2):
        mrctl.save_learned(folder / f"{k}.safetensors", runs.isel(run=k))
    return folder / "0.safetensors", made[0], runs


def test_file(learned):
    """The file holds each array by its name without the axis of the robots, and the next stage gets it to the bit."""
    file, stage, runs = learned
    for k in range(2):
        found = load_file(file.with_name(f"{k}.safetensors"))
        assert found["gain"].shape == (2, 2) and found["ticks"].shape == () and found["ticks"] == 2000
        np.testing.assert_array_equal(found["gain"], stage.gain[k])
    assert (stage.gain[0] != stage.gain[1]).any()
    np.testing.assert_array_equal(runs.weights.values[:, :4], stage.gain.reshape(2, 4))
    pair = [BASE.model_copy(update={"learned": path}) for path in (None, str(file))]
    hierarchy = Simulation(pair, feedforward=Own).hierarchy
    assert not hierarchy.learner.stage.stage.gain[0].any()
    np.testing.assert_array_equal(hierarchy.learner.stage.stage.gain[1], stage.gain[0])
    hierarchy.restore(np.arange(2))  # as the guard does
    assert not hierarchy.learner.stage.stage.gain[0].any()
    np.testing.assert_array_equal(hierarchy.learner.stage.stage.gain[1], stage.gain[0])


def test_it_helps(learned, tmp_path):
    """Learned on one course, it leaves less to the feedback in the first lap on another; so it does after a save."""
    file, _, runs = learned
    mrctl.save(runs, tmp_path / "runs.zarr")
    mrctl.save_learned(tmp_path / "again.safetensors", mrctl.open(tmp_path / "runs.zarr").isel(run=0))
    again, first = load_file(tmp_path / "again.safetensors"), load_file(file)
    assert again.keys() == first.keys() and all(np.array_equal(again[name], first[name]) for name in first)
    fresh, kept = (ELSEWHERE.model_copy(update={"learned": path}) for path in (None, str(file)))
    without, within = mrctl.per_lap(mrctl.simulate([fresh, kept], feedforward=Own)).feedback_share.values[:, 0]
    assert within < 0.7 * without


@pytest.mark.parametrize("steering", ["compliant", "rigid"])
def test_module_made_for_other_steering(steering):
    """A torch module whose second channel is not that of the steering is refused in one line, and drives if it is."""

    def module(rigid):
        return lambda robot, size: ModuleLearning(torch.nn.Linear(8, 2), robot, size, rigid=rigid)

    rigid, short = steering == "rigid", BASE.replace(steering=steering, laps=1)
    Simulation([short], feedforward=module(rigid))
    with pytest.raises(mrctl.InputError, match=rf"^feedforward .*: it was made with rigid={not rigid}, .*={rigid}$"):
        Simulation([short], feedforward=module(not rigid))


def test_module(tmp_path):
    """A torch module that starts elsewhere adopts what another one has learned: its outputs are those to the bit."""

    def module(robot, size):
        return ModuleLearning(
            torch.nn.Sequential(torch.nn.Linear(8, 4), torch.nn.Tanh(), torch.nn.Linear(4, 2)), robot, size
        )

    torch.manual_seed(0)
    first = Simulation([BASE.model_copy(update={"laps": 1})], feedforward=module)
    for _ in range(300):
        first.step()
    mrctl.save_learned(tmp_path / "module.safetensors", first.result().assign_attrs(scenarios=scenarios(BASE)))
    kept = BASE.model_copy(update={"learned": str(tmp_path / "module.safetensors")})
    second = Simulation([BASE, kept], feedforward=module).hierarchy
    motion = np.array([[0.5, 0.3]] * 2), np.array([[0.1, 0.2]] * 2)
    expected = first.hierarchy.feedforward(*(one[:1] for one in motion))[0]
    found = second.feedforward(*motion)
    assert not found[0].any() and np.abs(expected).max() > 1.0
    np.testing.assert_allclose(found[1], expected, rtol=1e-12)
    assert second.learner.weight_norm[1] == pytest.approx(first.hierarchy.learner.weight_norm[0], rel=1e-12)


def scenarios(*given):
    return json.dumps([one.model_dump(mode="json") for one in given])


class Forgetful:
    """A feedforward that keeps nothing."""

    def __init__(self, robot, size):
        self.size = size

    def output(self, command, derivative):
        return np.zeros((self.size, 2))

    def learn(self, feedback, frozen, twist, voltage):
        pass


def keeping(answer, after=None):
    """A feedforward whose method `adapted` returns an answer, or after two calls another one."""

    class Keeps(Forgetful):
        calls = 0

        def adapted(self):
            self.calls += 1
            return answer(self.size) if after is None or self.calls < 2 else after(self.size)

    return Keeps


BAD = {
    "a list": (lambda n: [np.zeros(n)], "`adapted` returns list, not a dict of arrays by name"),
    "a number": (lambda n: {0: np.zeros(n)}, "`adapted` returns dict, not a dict of arrays by name"),
    "rows": (lambda n: {"w": np.zeros(n + 1)}, "w of `adapted` is shape (2,), expected one row for each of 1 robots"),
    "text": (lambda n: {"w": "none"}, "ValueError: could not convert string to float: 'none'"),
    "raises": (lambda n: 1 / 0, "ZeroDivisionError: division by zero"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_answers(case):
    """An answer that cannot be kept is refused before anything is computed; later it fails the run."""
    answer, message = BAD[case]
    with pytest.raises(InputError) as refused:
        mrctl.simulate(ELSEWHERE, feedforward=keeping(answer))
    assert str(refused.value).startswith(f"feedforward Keeps: {message}")
    late = mrctl.simulate(ELSEWHERE, feedforward=keeping(lambda n: {"w": np.zeros(n)}, answer))
    assert str(late.failure.item()).startswith(f"feedforward Keeps: {message}")
    assert float(late.failure_time) == pytest.approx(8.0) and np.isfinite(late.x).all()


def test_refused(learned, tmp_path):
    """A stage that keeps nothing or takes nothing, another learner's file, other names and shapes: one line each."""
    file, _, _ = learned

    def start(path, own):
        Simulation([ELSEWHERE.model_copy(update={"learned": str(path)})], feedforward=own)

    for own in (Forgetful, keeping(lambda n: {"gain": np.zeros((n, 2, 2))})):
        with pytest.raises(
            InputError, match="^learned: .* cannot start from a file without the methods adapted and adopt$"
        ):
            start(file, own)
    with pytest.raises(InputError, match=r"^learned: .*0\.safetensors was learned by Own, not by Other$"):
        start(file, type("Other", (Own,), {}))
    with pytest.raises(InputError, match=r"^learned: .*0\.safetensors was learned by Own, not by fel$"):
        Simulation([ELSEWHERE.model_copy(update={"learned": str(file)})])
    for arrays, message in (
        ({"gain": np.zeros(4), "ticks": np.zeros(())}, r"gain is \(4,\), it must have shape \(2, 2\)"),
        ({"gain": np.zeros((2, 2))}, r"ticks is missing, it must have shape \(\)"),
        ({"gain": np.zeros((2, 2)), "ticks": np.zeros(()), "more": np.zeros(1)}, "unknown entry 'more'"),
        ({"gain": np.full((2, 2), np.nan), "ticks": np.zeros(())}, "non-finite weights"),
    ):
        save_file(arrays, tmp_path / "other.safetensors")
        with pytest.raises(InputError, match=f"^learned: .*other.safetensors: {message}$"):
            start(tmp_path / "other.safetensors", Own)
    broken = mrctl.simulate(ELSEWHERE, feedforward=keeping(lambda n: {"w": np.full(n, np.nan)}))
    with pytest.raises(InputError, match="^learned: w of Keeps is not finite, and no run could start from it$"):
        mrctl.save_learned(tmp_path / "x", broken)
    with pytest.raises(InputError, match="^learned: no learner of the run keeps anything"):
        mrctl.save_learned(tmp_path / "x", mrctl.simulate(ELSEWHERE, feedforward=Forgetful))


@pytest.mark.usefixtures("here", "no_figures")
def test_command(tmp_path, monkeypatch, capsys):
    """`mrctl run --out` keeps what it learned, and `--learned` starts from it; a sweep does too."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "own.py").write_text(OWN)
    (tmp_path / "run.toml").write_text(ELSEWHERE.to_toml())
    own = ["run", "run.toml", "--controller", "own.py:Own"]
    assert main([*own, "--out", "first"]) == 0
    again = [*own, "--learner", "none", "--learned", "first/learned.safetensors"]
    assert main([*again, "--out", "second"]) == 0
    without, within = (float(mrctl.summary(mrctl.open(out)).feedback_share[0]) for out in ("first", "second"))
    assert within < 0.7 * without
    assert main(["run", "second", "--controller", "own.py:Own"]) == 0 and "bit-identical" in capsys.readouterr().out
    base = {**ELSEWHERE.model_dump(), "learned": "first/learned.safetensors", **FEEDFORWARDS["none"]}
    sweep = Sweep.from_dict({"base": base, "controller": "own.py:Own", "seed": 1})
    assert jobs.run(sweep, tmp_path / "store", workers=1).failed == 0
    assert float(mrctl.open(tmp_path / "store").feedback_share[0]) == pytest.approx(within, rel=0.3)
    assert main([*own[:2], "--learned", "first/learned.safetensors"]) == 2
    assert capsys.readouterr().err == ("mrctl: learned: first/learned.safetensors was learned by Own, not by fel\n")
