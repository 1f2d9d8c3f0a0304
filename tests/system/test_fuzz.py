"""Mutated input at every entry point: it is taken, or one line refuses it; by default for a minute, seeded.

`MRCTL_FUZZ=5 pytest tests/system/test_fuzz.py` tries five times as many inputs, 100,000, with other seeds. No input may
take more than 10 s by the clock.
"""

import copy
import os
import random
import re
import shutil
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from test_check import messages

import mrctl
from mrctl import InputError, Scenario, cli
from mrctl.checks import examination
from mrctl.control.fel import initial_weights
from mrctl.control.weights import load_weights
from mrctl.physics import mjcf
from mrctl.physics.files import models_folder
from mrctl.sweep import jobs
from mrctl.sweep.plan import Sweep

TIMES = int(os.environ.get("MRCTL_FUZZ", "1"))
NASTY = [
    None, True, -1, 0, 1, 3, 2**31, 2**63, 10**30, -0.0, 1e-300, 1e300, float("nan"), float("inf"), "", "x", "fel",
    "all", "../x", "\x1b[31m", "\x00", "é" * 300, [], [[]], {}, {"a": 1}, [1, "a"], [float("nan")] * 3,
    {"kind": "circle"},
]  # fmt: skip
BASE = {"laps": 1, "learner": "none", "reference": {"kind": "circle", "radius": 0.5, "period": 4.0}}
SWEEP = {
    "base": BASE,
    "record": "full",
    "chunk": 2,
    "axes": [{"field": "perturbation.mass_factor", "values": [1.0, 1.2]}],
}
WORDS = [
    "0",
    "-1",
    "nan",
    "x",
    "1e9",
    "",
    "=",
    "--",
    "-h",
    "all",
    "fel",
    "a.toml",
    "..",
    "\x1b[31m",
    "reference:circle",
]


def mutated(data: Any, chance: random.Random) -> Any:
    """Returns plain data in which one to three values or names are others."""
    data = copy.deepcopy(data)
    for _ in range(chance.randint(1, 3)):
        node, key = data, None
        while isinstance(node, dict | list) and node and (key is None or chance.random() < 0.8):
            parent, key = node, chance.choice(list(node)) if isinstance(node, dict) else chance.randrange(len(node))
            node = parent[key]
        if key is None:
            return chance.choice(NASTY)
        if isinstance(parent, dict) and chance.random() < 0.1:
            parent[chance.choice(["", "x", "seed", "\x1b"])] = chance.choice(NASTY)
        parent[key] = copy.deepcopy(chance.choice(NASTY))
    return data


def spoilt(data: bytes, chance: random.Random) -> bytes:
    """Returns bytes of which some are others, or the end is missing."""
    found = bytearray(data)
    for _ in range(chance.randint(1, 5)):
        if found:
            found[chance.randrange(len(found))] = chance.randrange(256)
    return bytes(found[: chance.randrange(len(found) + 1)] if chance.random() < 0.3 else found)


@contextmanager
def bounded() -> Iterator[None]:
    """Ends what takes more than 10 s by the clock, as a read that blocks does."""

    def late(*_: object) -> None:
        raise TimeoutError("more than 10 s")

    before = signal.signal(signal.SIGALRM, late)
    signal.setitimer(signal.ITIMER_REAL, 10.0)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def attempt(call: Callable[[], object]) -> None:
    """Lets a call end in any way but an error of another kind, or one that is no single line."""
    try:
        with bounded():
            call()
    except InputError as error:
        assert "\n" not in str(error)


@pytest.fixture(scope="module")
def kept(here_throughout: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("kept")
    jobs.run(Sweep.from_dict(SWEEP), folder / "store", 1)
    mrctl.save(mrctl.simulate([Scenario.from_dict(BASE)]), folder / "result.zarr")
    mrctl.save_weights(folder / "weights.safetensors", initial_weights(4, 0))
    return folder


@pytest.mark.parametrize("seed", range(40 * TIMES))
def test_scenarios_and_sweeps(seed: int) -> None:
    """A mutated scenario or sweep is valid or refused; a valid scenario survives TOML and JSON."""
    chance = random.Random(f"records {seed}")
    whole = Scenario.from_dict(BASE).model_dump(mode="json")
    for _ in range(380):
        attempt(lambda: Scenario.from_dict(mutated(whole, chance)))
    for _ in range(100):
        attempt(lambda: Sweep.from_dict(mutated(SWEEP, chance)))


@pytest.mark.parametrize("seed", range(6 * TIMES))
@pytest.mark.parametrize("name", ["car", "turtlebot"])
def test_robots(name: str, seed: int, tmp_path: Path) -> None:
    """A robot with wrong numbers, or without some of its lines, is loaded or refused."""
    chance = random.Random(f"{name} {seed}")
    lines = (models_folder() / f"{name}.xml").read_text().splitlines()
    file = tmp_path / "robot.xml"
    for _ in range(40):
        one = list(lines)
        for _ in range(chance.randint(1, 3)):
            k = chance.randrange(len(one))
            value = chance.choice(["0", "-1", "1e-9", "1e9", "nan", "x", ""])
            one[k] = "" if chance.random() < 0.2 else re.sub(r"(?<=[\" ])-?[\d.]+(?=[\" ])", value, one[k], count=1)
        file.write_text("\n".join(one))
        attempt(lambda: mrctl.load_robot(file))


@pytest.mark.parametrize("seed", range(2 * TIMES))
def test_worlds_and_check(
    seed: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    """A world or robot with wrong numbers, or without some lines, is compiled or refused; `check` has a verdict."""
    monkeypatch.setattr(examination, "MAX_SECONDS", 0.2)
    chance = random.Random(f"worlds {seed}")
    for k in range(20):
        name = chance.choice(["flat", "slope", "rough", "patch"]) if k < 18 else "turtlebot"
        lines = (models_folder() / f"{name}.xml").read_text().splitlines()
        for line in chance.choices(range(len(lines)), k=chance.randint(1, 3)):
            value = chance.choice(["0", "-1", "1e-9", "1e9", "nan", "x", ""])
            lines[line] = re.sub(r"(?<=[\" ])-?[\d.]+(?=[\" ])", value, lines[line], count=chance.randrange(3))
        file = tmp_path / "one.xml"
        file.write_text("\n".join(lines).replace('file="', f'file="{models_folder()}/'))
        if name != "turtlebot":
            attempt(partial(mjcf.load, str(file), None))
            continue
        status = cli.main(["check", str(file)])
        assert status in (0, 1, 2) and len(messages(capsys.readouterr().err)) == (status > 0)


@pytest.mark.parametrize("seed", range(TIMES))
def test_stores_and_weights(kept: Path, tmp_path: Path, seed: int) -> None:
    """A damaged file of a store, result or network gives one line, or leaves what is read as it was, every number."""
    chance = random.Random(f"stores {seed}")
    shutil.copytree(kept, tmp_path / "x")
    files = sorted(f for f in (tmp_path / "x").rglob("*") if f.is_file() and f.name != "lock")
    whole = {name: mrctl.open(kept / name).load() for name in ("store", "result.zarr")}

    def opened(name: str) -> None:
        assert mrctl.open(tmp_path / "x" / name).load().equals(whole[name]), file

    for _ in range(25):
        file = chance.choice(files)
        before = file.read_bytes()
        file.write_bytes(spoilt(before, chance))
        if "result.zarr" in file.parts:
            attempt(partial(opened, "result.zarr"))
        elif "store" in file.parts:
            attempt(partial(opened, "store"))
            attempt(lambda: jobs.scenario_of(tmp_path / "x" / "store", 1))
        else:
            attempt(lambda: load_weights(tmp_path / "x" / "weights.safetensors", 4))
        file.write_bytes(before)
    for name in whole:
        opened(name)


@pytest.mark.parametrize("seed", range(2 * TIMES))
def test_command_lines(
    seed: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    """A command line of random flags and values is refused in one line or prints help; half of them miss nothing.

    Those without `--nosuch` name a file or a folder that is not there, so that none of them drives.
    """
    monkeypatch.chdir(tmp_path)
    chance = random.Random(f"commands {seed}")
    flags = ["--laps", "--seed", "--out", "--json", "--world", "--learner", "--robot.path", "--run", "--fel.step"]
    flags += ["--tier"]
    absent = {
        "run": ["none.toml"], "sweep": ["none.toml", "--out", "new"], "check": ["none.xml"], "view": ["none"],
        "export": ["none", "--to", "csv", "--out", "x.csv"], "navigate": ["none.toml"], "tune": ["none.xml"],
        "record": ["none", "--out", "x.gif"],
    }  # fmt: skip
    for k in range(20):
        if k % 2:
            command = chance.choice([*absent, "suite", "identify"])
            words = [chance.choice(flags + WORDS) for _ in range(chance.randint(1, 5))] + ["--nosuch"]
        else:
            command = chance.choice([*absent])
            some = chance.choices(
                ["--json", "--laps", "2", "--seed", "1", "x", "--world", "flat"], k=chance.randint(0, 2)
            )
            words = [*absent[command], *some]
        try:
            with bounded():
                assert cli.main([command, *words]) == 2, words
            assert capsys.readouterr().err.count("\n") == 1, words
        except SystemExit as stop:
            assert not stop.code
        assert not any(tmp_path.iterdir())
