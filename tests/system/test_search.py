"""`mrctl tune --search`: the same result twice, whatever interrupts it, and the optimum where it is known."""

import importlib
import json
from math import exp, log
from pathlib import Path

import numpy as np
import pytest

import mrctl
from mrctl import cli
from mrctl.experiments import cases, search
from mrctl.experiments.search import Budget
from mrctl.loop import user_files
from mrctl.record import InputError
from mrctl.scenario import FEEDFORWARDS, Scenario
from mrctl.sensing.tiers import TIERS

TINY = Budget(worlds=1, generations=2, population=4, fresh=1)
SCALED = """
from mrctl.control.feedforward import Prior

class Scaled:
    '''The nominal inverse dynamics times a gain.'''

    search = {"gain": (0.3, 10.0)}

    def __init__(self, robot, size, gain=0.4):
        self.gain, self.model = gain, Prior([robot] * size, False)

    def output(self, command, derivative):
        return self.gain * self.model.output(command, derivative)

    def learn(self, feedback, frozen, twist, voltage):
        pass

class Plain(Scaled):
    search = {}

class Wrong(Scaled):
    search = {"gain": (0.5, 5.0)}

class Missing(Scaled):
    search = {"bias": (0.5, 5.0)}
"""


@pytest.fixture
def brief(monkeypatch):
    """Worlds of one lap."""
    monkeypatch.setattr(search, "LAPS", 1)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    file = tmp_path / "mine.py"
    file.write_text(SCALED)
    return file


def test_fields():
    """Every learner has 1 to 4 settings that its record has; the bounds are valid there and hold what is shipped."""
    assert set(search.SEARCHED) == {pair["learner"] for pair in FEEDFORWARDS.values()}
    for name, pair in FEEDFORWARDS.items():
        if name in ("model", "true_model"):
            continue
        entry = search.entry(name)
        assert 1 <= len(entry.bounds) <= 4
        for field, (low, high) in entry.bounds.items():
            record, setting = field.split(".")
            assert record == ("pid" if name == "none" else pair["learner"])
            # Zero has no logarithm, so that the search begins at the lower bound.
            assert low <= entry.shipped[field] <= high or entry.shipped[field] == 0 < low < high
            for value in (low, high):
                tried = Scenario.from_dict({**pair, record: {setting: value}})
                (made,), stages = entry.tried(entry.shipped | {field: value}, [Scenario()])
                assert made == tried and not stages


def test_worlds():
    """The draws are of the seeds of tuning, the same again, different from each other, and in the tier."""
    for tier in TIERS:
        seen, fresh = search.worlds(tier, Budget(8, 1, 4, 8))
        seeds = [s.seed for s in (*seen, *fresh)]
        assert len(set(seeds)) == 16 and set(seeds) <= set(cases.TUNING_SEEDS)
        assert [s.name for s in seen] == [s.name for s in fresh] == list(search.KINDS)
        assert len({s.reference for s in (*seen, *fresh)}) == 16
        assert {s.sensing.tier for s in seen} == {tier} and not any(s.guard.on for s in seen)
        assert search.world(tier, seeds[3]) == seen[3]
    lab = {s.name: s for s in search.worlds("lab", Budget(8, 1, 4, 0)).seen}
    assert lab["noise"].sensing["gyro_noise"] == pytest.approx(4 * lab["as built"].sensing["gyro_noise"])
    assert [lab[kind].perturbation.control_delay for kind in ("light, late", "late")] == [0.01, 0.01]
    (payload,) = lab["payload at half time"].events
    assert payload.time == pytest.approx(lab["late"].duration / 2) and payload.perturbation.payload > 1


def test_score_by_hand():
    """The weighted logarithm of the ratios with their floors; a run that failed, or nearly, counts as ten."""
    errors = np.array([[2e-3, 3e-3, 4e-3], [1e-3, 1e-3, 1e-3], [np.nan] * 3, [1e3, 1e-3, 1e-3]])
    yardstick = np.array([[1e-3, 6e-3, 4e-3], [1e-3, 1e-3, 1e-3], [1e-3] * 3, [1e-3] * 3])
    first = 0.5 * log(2.1e-3 / 1.1e-3) + 0.25 * log(3.05e-3 / 6.05e-3)
    expected = [first, 0.0, log(10), 0.5 * log(10)]
    assert search.score(errors, yardstick) == pytest.approx(expected)
    lost = np.vstack([yardstick, [np.nan] * 3])  # a world in which `model` fails says nothing
    assert search.score(np.vstack([errors, errors[:1]]), lost) == pytest.approx(expected)


def test_same_twice_and_resumed(tmp_path, brief):
    """The same table and the same bytes on other threads, and after an interrupt in the middle of a line."""
    once, twice, torn = (tmp_path / name for name in ("once", "twice", "torn"))
    first = search.search("model+rls", ("lab",), once, True, TINY, threads=1)
    assert search.search("model+rls", ("lab",), twice, True, TINY, threads=2) == first
    driven = (once / "lab.jsonl").read_bytes()
    assert (twice / "lab.jsonl").read_bytes() == driven
    lines = driven.decode().splitlines(keepends=True)
    torn.mkdir()
    (torn / "lab.jsonl").write_text("".join(lines[:6]) + lines[6][:40])
    assert search.search("model+rls", ("lab",), torn, True, TINY) == first
    assert (torn / "lab.jsonl").read_bytes() == driven
    # The shipped setting is among those tried, and the best of them is what was found.
    table = json.loads(first)
    objective = table["tiers"]["lab"]["objective"]
    assert objective["found"] <= objective["shipped"]
    fresh = 1 + len(set(objective.values()))  # model and the shipped setting, and the found one if it is another
    assert len(lines) == 1 + (1 + 1 + 8) + fresh  # head; model and 9 settings; those in fresh worlds
    found = table["tiers"]["lab"]["fresh"]
    assert found["lab"]["to_shipped"]["value"] == pytest.approx(found["lab"]["to_model"] / found["shipped"]["to_model"])
    with pytest.raises(mrctl.InputError, match="holds other results .entry differs"):
        search.search("model+fel", ("lab",), once, True, TINY)


def test_known_optimum_of_a_user(monkeypatch, tmp_path, brief, file):
    """The best gain on the inverse dynamics of a robot as built is one; a slow PID shows it."""
    monkeypatch.setattr(search, "KINDS", {"as built": lambda r: {"pid": {"time_constant": 0.3}}})
    search.search(f"{file}:Scaled", ("ideal",), tmp_path / "out", True, Budget(1, 5, 4, 1))
    tier = json.loads((tmp_path / "out" / "table.json").read_text())["tiers"]["ideal"]
    assert tier["found"]["Scaled.gain"] == pytest.approx(1.0, abs=0.06)
    assert exp(tier["objective"]["found"]) < 0.5 * exp(tier["objective"]["shipped"])


def test_settings_of_a_user(file, tmp_path):
    """A name with settings is the class with these arguments, in labels, digests and every spelling."""
    name = f"{file}:Scaled(gain=0.5)"
    (part,) = user_files.parts(name)
    assert part.settings == {"gain": 0.5} and part.title == "Scaled(gain=0.5)"
    assert user_files.absolute(f"feedforward={file}:Scaled( gain = 0.5 )") == name
    both = user_files.parts(f"{file}:Scaled(gain=0.5, more=2),steering={file}:Plain")
    assert [(p.stage, p.attribute, p.settings) for p in both] == [
        ("feedforward", "Scaled", {"gain": 0.5, "more": 2}), ("steering", "Plain", {}),
    ]  # fmt: skip
    settings = {"a": 1, "b": (2, 3), "gains": {"x": [1, 2]}, "path": "a:b, c)d"}
    text = ", ".join(f"{name}={value!r}" for name, value in settings.items())
    several = user_files.parts(f"motion={file}:Scaled({text}),{file}:Scaled({text}),steering={file}:Plain")
    assert [(p.stage, p.settings) for p in several] == [
        ("motion", settings), ("feedforward", settings), ("steering", {}),
    ]  # fmt: skip
    circle = mrctl.Circle(radius=0.5, period=5.0)
    one = mrctl.Scenario(laps=1, reference=circle, prior="none", learner="none")
    runs = [mrctl.simulate([one], **user_files.load(f"{file}:Scaled{text}")) for text in ("(gain=0.4)", "", "(gain=1)")]
    voltage = [run["feedforward_left"].values[0, 5:9] for run in runs]
    assert np.array_equal(voltage[0], voltage[1]) and voltage[2] == pytest.approx(voltage[1] / 0.4, rel=0.2)
    assert runs[0]["label"].values[0] == "Scaled(gain=0.4)"
    for text in ("Scaled(0.4)", "Scaled(gain=)", "Scaled(gain=open)", "Scaled[0]"):
        with pytest.raises(mrctl.InputError, match="is not of the form"):
            user_files.parts(f"{file}:{text}")


def test_edited_file_of_a_user(tmp_path, monkeypatch):
    """In one process, an edited file is loaded anew, and the same name in another directory is another file."""
    for folder, gain in (("one", 1), ("two", 2), ("one", 3)):
        (tmp_path / folder).mkdir(exist_ok=True)
        (tmp_path / folder / "own.py").write_text(f"def own(robot, size):\n    return {gain}\n")
        monkeypatch.chdir(tmp_path / folder)
        stages = user_files.load("own.py:own")
        assert stages["feedforward"](None, 1) == gain
        assert user_files.load("feedforward=own.py:own") is stages


def test_neighbour_of_a_user_s_file(tmp_path):
    """What a file imports from beside it belongs to it: in its digest, after an edit, and of its own folder."""
    for folder in ("one", "two"):
        (tmp_path / folder / "laws").mkdir(parents=True)
        (tmp_path / folder / "laws" / "__init__.py").write_text("from .deep import GAIN\n")
        (tmp_path / folder / "own.py").write_text(
            "import random\nimport mrctl\nfrom laws import GAIN\ndef own(robot, size):\n    return GAIN\n"
        )
        for name in ("random", "mrctl"):  # Python's own and mrctl stay what they are
            (tmp_path / folder / f"{name}.py").write_text("1 / 0\n")
    digests = set()
    for folder, gain in (("one", 1), ("two", 2), ("one", 3), ("two", 2)):
        (tmp_path / folder / "laws" / "deep.py").write_text(f"GAIN = {gain}\n")
        name = f"{tmp_path / folder / 'own.py'}:own"
        assert user_files.load(name)["feedforward"](None, 1) == gain
        digests.add(user_files.digest(name))
    assert len(digests) == 3
    beside = user_files.neighbours(tmp_path / "one" / "own.py")
    assert beside == [tmp_path / "one" / "laws" / name for name in ("__init__.py", "deep.py")]
    assert not list(tmp_path.rglob("*.pyc"))


def test_neighbour_that_stages_share(tmp_path, monkeypatch):
    """Two stages of one controller share what they import from beside them, with a script that imported it before."""
    (tmp_path / "shared_by_stages.py").write_text("known = []\n")
    for name in ("a", "b"):
        (tmp_path / f"{name}.py").write_text(
            "from shared_by_stages import known\ndef own(robot, size):\n    known.append(robot)\n    return known\n"
        )
    monkeypatch.syspath_prepend(str(tmp_path))
    mine = importlib.import_module("shared_by_stages")
    stages = user_files.load(f"{tmp_path / 'a.py'}:own,motion={tmp_path / 'b.py'}:own")
    stages["feedforward"](1, 1)
    assert stages["motion"](2, 1) is mine.known and mine.known == [1, 2]
    (tmp_path / "shared_by_stages.py").write_text("known = [0]\n")
    stages = user_files.load(f"{tmp_path / 'a.py'}:own,motion={tmp_path / 'b.py'}:own")
    assert stages["feedforward"](1, 1) is stages["motion"](2, 1) == [0, 1, 2]


def test_folder_first(tmp_path, monkeypatch):
    """A folder that cannot be written is refused before any world is drawn."""
    (tmp_path / "file").touch()
    monkeypatch.setattr(search, "worlds", lambda *_: pytest.fail("drawn"))
    with pytest.raises(InputError, match="^out: .*cannot be written"):
        search.search("fel", ("ideal",), tmp_path / "file" / "out", True, Budget(1, 1, 4, 1))


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["model"], "search: 'model' has no settings; there are none, model+observer"),
        (["magic"], "search: 'magic' has no settings"),
        (["mine.py:Plain"], "search: no class says what may be searched"),
        (["mine.py:Wrong"], "search: Wrong.gain: needs bounds"),
        (["mine.py:Missing"], "search: Missing.bias: needs bounds"),
        (["mine.py:Other"], "controller: mine.py has no Other"),
        (["mine.py:Scaled(gian=1)"], "gian"),
        (["fel", "--delay", "0.01"], "flags of the design"),
        (["fel", "--tier", "moon"], "tier: 'moon' is none of field, ideal, lab"),
        (["fel", "--out", "mine.py"], "mine.py"),
    ],
)
def test_refused(arguments, says, monkeypatch, capsys, file, tmp_path):
    """Bad input is one line that says what is wrong, before anything is driven."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(search.Memory, "drive", None)
    assert cli.main(["tune", "--search", *arguments]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and says in error, error


def test_command(monkeypatch, capsys, brief, file, tmp_path):
    """The command prints the settings, what they are worth on fresh draws, and how to use those of a user."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(search, "search", lambda *a, given=search.search: given(*a, Budget(1, 1, 4, 1)))
    assert cli.main(["tune", "--search", "mine.py:Scaled", "--tier", "lab", "ideal"]) == 0
    out = capsys.readouterr().out
    assert "| Scaled.gain | 0.400 " in out and "found in ideal" in out
    table = json.loads(Path("search/Scaled/table.json").read_text())
    assert list(table["tiers"]) == ["lab", "ideal"] and "seeds from 100000" in table["tiers"]["lab"]["origin"]
    best = table["tiers"]["lab"]["found"]["Scaled.gain"]
    assert f"mine.py:Scaled(gain={best:.4g})" in out
