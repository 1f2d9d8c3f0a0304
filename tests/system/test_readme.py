"""Every snippet of the README runs."""

import re
from pathlib import Path

import pytest

from mrctl import cli
from mrctl.scenario import Scenario
from mrctl.sweep.plan import Sweep

README = Path(__file__).resolve().parents[2] / "README.md"
BLOCKS = re.findall(r"^```(\w+)\n(.*?)^```", README.read_text(), re.MULTILINE | re.DOTALL)
# Run by other tests, because they take minutes or make the environment that this test runs in.
ELSEWHERE = ("python3 -m pip", "mrctl reproduce", "mrctl suite", "mrctl bench", "mrctl train", "mrctl view", "pytest")


def blocks(language: str) -> list[str]:
    return [text for name, text in BLOCKS if name == language]


def test_there_are_snippets() -> None:
    """The pattern above finds what it is meant to find."""
    assert {name for name, _ in BLOCKS} >= {"python", "toml", "bash"}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder with the README's scenario, robot and sweep in it, the sweep with one draw, not hundreds."""
    monkeypatch.chdir(tmp_path)
    scenario, sweep = blocks("toml")
    Path("scenario.toml").write_text(scenario)
    for robot in blocks("xml"):
        Path("my_robot.xml").write_text(robot)
    Path("sweep.toml").write_text(re.sub(r"^runs = \d+", "runs = 1", sweep, flags=re.MULTILINE))
    return tmp_path


def with_store(code: str) -> None:
    """Makes the store that a snippet opens."""
    if re.search(r"run store|\"store\"", code):
        assert cli.main(["sweep", "sweep.toml", "--out", "store", "--workers", "1"]) == 0


@pytest.mark.parametrize("code", blocks("python"))
def test_python(code: str, folder: Path) -> None:
    """Python snippets run on their own, in an empty folder."""
    with_store(code)
    exec(compile(code, str(README), "exec"), {"__name__": "__main__"})


@pytest.mark.parametrize("text", blocks("toml"))
def test_toml(text: str, folder: Path) -> None:
    """TOML snippets are valid scenarios, or valid sweeps."""
    Path("snippet.toml").write_text(text)
    if "sweep.toml" in text:
        assert len(Sweep.from_toml("snippet.toml").axes) == text.count("[[axes]]")
    else:
        assert Scenario.from_toml("snippet.toml") != Scenario()


@pytest.mark.parametrize("line", [line for text in blocks("bash") for line in text.splitlines() if line.strip()])
def test_bash(line: str, folder: Path, capsys: pytest.CaptureFixture) -> None:
    """Command lines run; those that other tests run are at least known commands."""
    command = line.split("#")[0].strip()
    with_store(command)
    if command.startswith("mrctl") and not command.startswith(ELSEWHERE):
        assert cli.main(command.split()[1:]) == 0, capsys.readouterr().err
    else:
        assert command.startswith(ELSEWHERE) or command.startswith("git clone"), command


@pytest.mark.parametrize("path", re.findall(r"\]\(([^)#:\"]+)\)", README.read_text()))
def test_links(path: str) -> None:
    """Links and pictures that point into the repository point at something."""
    assert (README.parent / path).exists()
