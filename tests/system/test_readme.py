"""Every snippet of every README runs, the root's and those of the rooms; an expensive command names its own test.

A block whose first line is a comment with a file name, such as `# scenario.toml`, is the content of that file. All
snippets share one folder. A snippet that mentions what a command of a README writes (after `--out`, `--export` or `>`)
finds it there, written once.
"""

import ast
import inspect
import io
import re
import shlex
import tomllib
from contextlib import redirect_stdout
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import pytest

import mrctl
from mrctl import cli
from mrctl.experiments import results_page
from mrctl.scenario import Scenario
from mrctl.sweep.plan import Sweep
from mrctl.theory.obstacles import Obstacles

# What its tests share is made once.
pytestmark = [pytest.mark.xdist_group("readme"), pytest.mark.usefixtures("here")]

ROOT = Path(__file__).resolve().parents[2]
ROOMS = sorted(path.parent for path in (ROOT / "mrctl").glob("*/__init__.py"))
READMES = [ROOT / "README.md", *sorted((ROOT / "mrctl").glob("*/README.md"))]
PAGES = [*READMES, ROOT / "mrctl" / "experiments" / "RESULTS.md"]
FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
WRITES = ("--out", "--export", ">")  # what comes before the path that a command writes

# Commands that are not run here, as patterns, with the test that runs them. The flags of a command of mrctl are parsed
# here all the same: they have to reach the function that is named last.
ELSEWHERE = {
    r'python3 -m pip install -e "\.\[dev\]" && pytest': (".ci/run", ""),
    r"python3 -m pip install -e \. && mrctl reproduce": ("tests/system/test_reproduce.py::test_network_beats_pid", ""),
    r'python3 -m pip install -e "\.\[notebooks\]" && .*': ("tests/system/test_notebooks.py::test_notebook", ""),
    r"pytest --mrctl-robot .*": ("tests/system/test_check.py::test_plugin", ""),
    r"dask .*": ("tests/system/test_sweep_dask.py::test_killed_worker", ""),
    r"python -m mrctl\.experiments\.results_page .*": ("tests/unit/test_results_page.py::test_sections", ""),
    r"mrctl check( turtlebot| racecar --json)?": ("tests/system/test_check.py::test_good", "mrctl.checks.command.run"),
    r"mrctl sweep .* --scheduler .*": ("tests/system/test_sweep_dask.py::test_killed_worker", "mrctl.sweep.jobs.run"),
    r"mrctl reproduce": ("tests/system/test_reproduce.py::test_network_beats_pid", "mrctl.experiments.paper.reproduce"),
    r"mrctl suite( --\w+( \d+)?)*": ("tests/system/test_suite.py::test_table", "mrctl.experiments.suite.suite"),
    r"mrctl suite --held-out \S*( --cells second)?": (
        "tests/system/test_suite.py::test_held_out", "mrctl.experiments.held_out.judge",
    ),
    r"mrctl suite --controller \S*( model\+\S*)?": (
        "tests/system/test_suite.py::test_controller_joins", "mrctl.experiments.suite.suite",
    ),
    r"mrctl identify --json > .*": (
        "tests/system/test_identification.py::test_default_robot", "mrctl.experiments.identify.run",
    ),
    r"mrctl identify racecar .*": (
        "tests/system/test_identification.py::test_racing_car", "mrctl.experiments.identify.run",
    ),
    r"mrctl tune --time-constant .*": (
        "tests/system/test_commands.py::test_tune_states_the_learning_condition", "mrctl.experiments.tuning.tune",
    ),
    r"mrctl tune racecar .*": (
        "tests/system/test_commands.py::test_tune_designs", "mrctl.experiments.tuning.tune",
    ),
    r"mrctl tune": ("tests/system/test_response.py::test_designed_is_measured", "mrctl.experiments.tuning.tune"),
    r"mrctl tune --search .*": ("tests/system/test_search.py::test_command", "mrctl.experiments.search.search"),
    r"mrctl bench": ("tests/benchmarks/test_bench.py::test_command", "mrctl.experiments.bench.run"),
    r"mrctl view( --(?!export)\S+( \w+)*)*": (
        "tests/system/test_viewer_server.py::test_flags", "mrctl.viewer.view.live",
    ),
    r"mrctl navigate .* --view": ("tests/system/test_viewer_missions.py::test_flags", "mrctl.viewer.view.mission"),
    r"mrctl record .*": ("tests/system/test_viewer_server.py::test_record", "mrctl.viewer.video.record"),
    r"mrctl view [\w./]+": ("tests/system/test_viewer.py::test_replay", "mrctl.viewer.view.replay"),
}  # fmt: skip
# One draw of each combination in place of hundreds, one lap, and of the last axes one value.
SMALLER = {
    "sweep.toml": {"runs = 500": "runs = 1"},
    "ablation.toml": {
        "runs = 20": "runs = 1", "laps = 4": "laps = 1",
        '"ideal", "lab", "field"': '"field"', '"nominal", "all"': '"all"',
    },
    "steps.toml": {"runs = 20": "runs = 2", "laps = 2": "laps = 1", '"nominal", "all"': '"all"'},
}  # fmt: skip


class Block(NamedTuple):
    """A fenced block of a README."""

    page: Path
    line: int
    language: str
    text: str

    @property
    def file(self) -> str:
        """The file that it is the content of, or nothing."""
        title = re.match(r"(?:#|<!--) (\w+\.(?:py|toml|xml))\b", self.text)
        return title[1] if title else ""


def blocks(*languages: str) -> list[Block]:
    """The blocks in some languages, or all of them, in the order of the pages."""
    found = []
    for page in READMES:
        text = page.read_text()
        for match in FENCE.finditer(text):
            found.append(Block(page, text[: match.start()].count("\n") + 1, *match.groups()))
    return [block for block in found if block.language in languages] if languages else found


def place(block: Block) -> str:
    return f"{block.page.parent.name}-{block.line}"


def command_lines() -> list[str]:
    """Every command of every README, once."""
    lines = [line for block in blocks("bash") for line in block.text.splitlines()]
    return list(dict.fromkeys(re.sub(r"\s#.*", "", line).strip() for line in lines if line.strip()))


def excluded(command: str) -> tuple[str, str] | None:
    """The test that runs a command, and the function that its flags must reach; None for a command that runs here."""
    return next((answer for pattern, answer in ELSEWHERE.items() if re.fullmatch(pattern, command)), None)


def written_by(command: str) -> list[str]:
    """Paths that a command writes."""
    words = shlex.split(command)
    return [path for word, path in zip(words, words[1:], strict=False) if word in WRITES]


class Folder:
    """The folder in which the snippets run."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.outputs: dict[str, str] = {}  # of the commands that have run
        self.makers = {file: command for command in command_lines() for file in written_by(command)}
        for block in blocks():
            if block.file:
                file, text = path / block.file, block.text
                for large, small in SMALLER.get(block.file, {}).items():
                    assert text.count(large) == 1
                    text = text.replace(large, small)
                assert not file.exists() or file.read_text() == text, f"two READMEs have a file {block.file}"
                file.write_text(text)
        (path / "models").symlink_to(ROOT / "models")

    def prepare(self, mentioned: list[str]) -> None:
        """Makes those of some paths that a command makes."""
        for made in dict.fromkeys(path.partition("/")[0] for path in mentioned):
            if made in self.makers:
                self.run(self.makers[made])

    def run(self, command: str) -> None:
        """Runs a command of mrctl in this process, once, and without its figures, which no snippet looks at."""
        if command in self.outputs:
            return
        words = shlex.split(command)
        self.prepare([word for before, word in zip(words[1:], words[2:], strict=False) if before not in WRITES])
        arguments = words[1 : words.index(">")] if ">" in words else words[1:]
        if arguments[0] == "sweep":
            arguments += ["--workers", "1"]  # in this process, which has compiled the laws already
        with pytest.MonkeyPatch.context() as patch, redirect_stdout(io.StringIO()) as output:
            patch.setattr("mrctl.results.plots.save", lambda *_: [])
            assert cli.main(arguments) == 0
        self.outputs[command] = output.getvalue()
        if ">" in words:
            (self.path / words[-1]).write_text(output.getvalue())


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Folder:
    return Folder(tmp_path_factory.mktemp("readme"))


@pytest.fixture(autouse=True)
def inside(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Tests that use the folder run in it, and import from it."""
    if "folder" in request.fixturenames:
        path = request.getfixturevalue("folder").path
        monkeypatch.chdir(path)
        monkeypatch.syspath_prepend(path)


def test_there_are_snippets() -> None:
    """The patterns above find what they are meant to find."""
    assert {"python", "toml", "xml", "bash"} <= {block.language for block in blocks()}
    assert {"scenario.toml", "sweep.toml", "my_robot.xml", "my_controller.py"} <= {b.file for b in blocks()}
    assert {"mrctl", "experiments", "sweep", "results"} <= {page.parent.name for page in READMES} | {"mrctl"}
    assert len(command_lines()) > 20


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.parent.name + "-" + page.stem)
def test_fenced(page: Path) -> None:
    """Every block is fenced and says its language, so that none escapes the tests below."""
    text = page.read_text()
    assert {match[1] for match in FENCE.finditer(text)} <= {"python", "toml", "xml", "bash", "text"}
    prose = FENCE.sub("", text)
    assert "```" not in prose
    assert not re.search(r"\n\n {4}", prose), "an indented block"


@pytest.mark.parametrize("block", blocks("python"), ids=place)
def test_python(block: Block, folder: Folder) -> None:
    """Python snippets run."""
    folder.prepare(re.findall(r'"([\w./]+)"', block.text))
    exec(compile(block.text, str(block.page), "exec"), {"__name__": "__main__"})


@pytest.mark.parametrize("block", blocks("toml"), ids=place)
def test_toml(block: Block, tmp_path: Path) -> None:
    """TOML snippets are valid scenarios, obstacles or sweeps."""
    file = tmp_path / "snippet.toml"
    file.write_text(block.text)
    if tomllib.loads(block.text).keys() <= Scenario.model_fields.keys():
        assert Scenario.from_toml(file) != Scenario()
    elif block.file == "yard.toml":
        assert Obstacles.from_toml(file).moving
    else:
        assert Sweep.from_toml(file).size > 1


@pytest.mark.parametrize("block", blocks("xml"), ids=place)
def test_xml(block: Block, folder: Folder) -> None:
    """XML snippets are well formed, and those with a file name are robots."""
    ElementTree.fromstring(f"<snippet>{block.text}</snippet>")
    if block.file:
        mrctl.load_robot(block.file)


@pytest.mark.parametrize("command", [line for line in command_lines() if not excluded(line)])
def test_command(command: str, folder: Folder) -> None:
    """Commands run, and write what they say."""
    assert command.startswith("mrctl "), "neither a command of mrctl nor in ELSEWHERE"
    folder.run(command)
    assert all((folder.path / file).exists() for file in written_by(command))


@pytest.mark.parametrize("command", [line for line in command_lines() if excluded(line)])
def test_elsewhere(
    command: str, folder: Folder, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    """A command that is not run here is run by a test that exists, and its flags are right."""
    answer = excluded(command)
    assert answer is not None
    test, function = answer
    file, _, name = test.partition("::")
    text = (ROOT / file).read_text()
    if name:
        assert name in {node.name for node in ast.walk(ast.parse(text)) if isinstance(node, ast.FunctionDef)}
    else:
        assert command in text
    if "results_page" in command:
        flags = {flag.replace("-", "_") for flag in re.findall(r"--([\w-]+)", command)}
        assert flags <= set(inspect.signature(results_page.main).parameters)
    if function:

        def reached(*_: object, **__: object) -> None:
            raise mrctl.InputError("reached")

        monkeypatch.setattr(function, reached)
        words, _, _ = command.partition(" > ")
        assert cli.main(shlex.split(words)[1:]) == 2
        assert capsys.readouterr().err == "mrctl: reached\n"


@pytest.mark.parametrize("pattern", ELSEWHERE)
def test_no_stale_exclusion(pattern: str) -> None:
    """Every exclusion is of a command that a README has."""
    assert any(re.fullmatch(pattern, command) for command in command_lines())


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.parent.name + "-" + page.stem)
def test_items_begin_lines(page: Path) -> None:
    """A numbered item within a line is no item but text; wrapping a list as one paragraph makes it so."""
    assert not re.findall(r"\S \d\. \*\*.*", page.read_text())


def links() -> list[tuple[Path, str]]:
    """Links in the prose of every page that point into the repository."""
    prose = {page: re.sub(r"`[^`\n]*`", "", FENCE.sub("", page.read_text())) for page in PAGES}
    found = [(page, link) for page, text in prose.items() for link in re.findall(r"\]\(([^)]+)\)", text)]
    return [(page, link) for page, link in found if "://" not in link]


@pytest.mark.parametrize(("page", "link"), links(), ids=lambda value: getattr(value, "stem", value))
def test_links(page: Path, link: str) -> None:
    """Links and pictures that point into the repository point at something."""
    file, _, anchor = link.partition("#")
    target = page.parent / file if file else page
    assert target.exists()
    if anchor:
        titles = [line.lstrip("# ") for line in target.read_text().splitlines() if line.startswith("#")]
        assert anchor in {re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-") for title in titles}


def test_root() -> None:
    """The root's README stays short, and its map shows every room."""
    text = READMES[0].read_text()
    assert len(text.splitlines()) <= 230
    for room in ROOMS:
        assert f"`{room.name}/`" in text, room.name
        if (room / "README.md").exists():
            assert f"(mrctl/{room.name}/README.md)" in text, room.name
