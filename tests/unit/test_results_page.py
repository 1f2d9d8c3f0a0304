"""The page of results, from inputs in the form in which the commands write them."""

import inspect
import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mrctl
from mrctl import cli
from mrctl.experiments import bench, identify, paper, results_page, suite_tables, tuning
from mrctl.experiments.cases import entries
from mrctl.experiments.tables import machine, write_json
from mrctl.results.dataset import versions

SOURCE = {"versions": versions() | {"mujoco": "9.9.9"}, "machine": {"processor": "Abacus", "cores": 3}}
MADE = "with mrctl {mrctl}, mujoco 9.9.9, dm-control".format(**SOURCE["versions"])

TABLES = "## Steady\n\nAll tie.\n\n| case |\n| --- |\n\n## A step\n\n`rls` is back.\n\n| step |\n"


def written(folder: Path, values: dict, table: str = "") -> Path:
    folder.mkdir()
    write_json(folder / "table.json", SOURCE | values)
    (folder / "table.md").write_text(table)
    return folder


@pytest.fixture
def suite(tmp_path: Path) -> Path:
    error = {"value": 0.0123, "low": 0.0121, "high": 0.0125, "samples": 2}
    lost = error | {"value": float("nan"), "samples": 0}
    rows = [
        {"part": "steady", "case": case, "feedforward": name, "failed": 2 * (e is lost), "runs": 2, "v_rmse": e,
         "omega_rmse": e, "position_rmse": e}
        for case, name, e in (("nominal", "none", error), ("slope 10°", "fel", error), ("all", "fel", lost))
    ]  # fmt: skip
    return written(tmp_path / "suite", {"rows": rows, "mode": "full"}, TABLES)


@pytest.fixture
def reproduction(tmp_path: Path) -> Path:
    row = {"steering": "rigid", "plant": "all", "lap_time": 12.0, "feedforward": "fel", "failure": ""}
    row |= {m: 0.00321 for m in paper.METRICS} | {f"{m}_to_pid": float("nan") for m in paper.METRICS}
    long = {"run": "fel, all", "laps": 60} | {m: {"lap_8": 0.002, "last": 0.001} for m in paper.METRICS}
    case = {"case": "an offset", "unit": "%", "target": 9.1, "value": 9.06, "value_10ms": 8.95}
    errors = {"none": (4e-3, 6e-3), "fel": (1e-3, 2e-3)}
    tiers = [
        row | {"sensing": "lab", "feedforward": name, "position_rmse": last, "position_all": over_all}
        for name, (last, over_all) in errors.items()
    ]
    values = {"last_lap": [row], "endurance": [long], "tiers": tiers, "kanayama": [case]}
    return written(tmp_path / "reproduction", values)


@pytest.fixture
def tune(tmp_path: Path) -> Path:
    channel = {"static_gain": 0.1, "plant_lag": 0.2, "k_p": 16.0, "k_i": 68.0, "ratio": 2.5}
    answer = {name: float("inf") for name in (*tuning.MARGINS, *tuning.SAFETY)} | {"phase": 88.5}
    loop = {"steering": "caster", "channel": 1, "delay": 0.02} | channel
    loop |= {name: answer for name in tuning.RESPONSES}
    names = ("k_x", "k_y", "k_theta", "prefilter", "v_lag", "omega_lag")
    motion = {"steering": "caster", "delay": 0.02} | {name: 0.05 for name in names}
    motion["sensitivity"] = [1.6, 1.75]
    values = {"time_constant": 0.15, "lag": 0.0, "loops": [loop], "motion": [motion], "robot": {"path": "car"}}
    return written(tmp_path / "tune", values)


@pytest.fixture
def designed(tune: Path, tmp_path: Path) -> Path:
    values = json.loads((tune / "table.json").read_text()) | {"time_constant": None, "robot": {"path": "racecar"}}
    (loop,) = values["loops"]
    for name, bandwidth, peak in (("design", 20.0, 1.6), ("measured", 21.0, 1.63)):
        loop[name] = loop[name] | {"bandwidth": bandwidth, "sensitivity": peak}
    return written(tmp_path / "designed", values)


@pytest.fixture
def searched(tmp_path: Path) -> Path:
    def fresh(ratio: float) -> dict:
        return {"to_model": 0.9 * ratio, "to_shipped": {"value": ratio, "low": ratio - 0.01, "high": ratio + 0.01}}

    lab = {"found": {"fel.step": 0.02}, "objective": {"shipped": np.log(1.5), "found": np.log(0.75)}}
    lab |= {"fresh": {"shipped": fresh(1.0), "lab": fresh(0.5)}}
    budget = {"worlds": 16, "generations": 15, "population": 8, "fresh": 32}
    values = {"entry": "model+fel", "shipped": {"fel.step": 0.1}, "tiers": {"lab": lab}, "budget": budget}
    return written(tmp_path / "search", values)


@pytest.fixture
def navigated(tmp_path: Path) -> Path:
    values = {"scenario": {"robot": {"path": "racecar"}, "sensing": {"tier": "field"}}, "mode": "quick", "needed": []}
    folder = written(tmp_path / "navigated", values, "## Critical width\n\nAll tie.\n\n| plant |\n| --- |\n")
    write_json(folder / "mppi.json", SOURCE | values | {"runs": {}})
    write_json(folder / "reactive.json", SOURCE | values | {"widths": []})
    write_json(folder / "limits.json", SOURCE | values | {"limits": {}})
    (folder / "reactive.md").write_text("## Critical width in reactive mode\n\nLevel.\n\n| plant |\n| --- |\n")
    (folder / "limits.md").write_text("## Up\n\nSmaller.\n\n| plant |\n| --- |\n")
    (folder / "mppi.md").write_text("## Three\n\nNone differs.\n\n| plant |\n| --- |\n")
    return folder


@pytest.fixture
def identified(tmp_path: Path) -> Path:
    constant = identify.Constant("M_e", "kg", 21.32, 21.0, 21.64, 21.28)
    values = {"robot": {"path": "racecar"}, "constants": [constant._asdict() | {"error": constant.error}]}
    write_json(tmp_path / "identify.json", SOURCE | values)
    return tmp_path / "identify.json"


@pytest.fixture
def figures(tmp_path: Path) -> Path:
    numbers = ("steps_per_second", "limit_steps_per_second", "real_time_factor", "overhead_us_per_tick", "memory_mib")
    row = {"robots": 16, "threads": 1, "ratio": 0.912, "replayed_exactly": True} | {name: 12345.0 for name in numbers}
    values = {
        "machine": SOURCE["machine"] | SOURCE["versions"],
        "robots": [row],
        "threads": [row],
        "lab": row,
        "parts": {"1": {"physics": 31.4}, "16": {"physics": 500.0}},
        "sensing_share": {"1": 0.05, "16": 0.03},
        "today": {"steps_per_second": 9884.0, "closed_loop_is_faster_by": 9.1},
        "navigation": {"pairs": [], "plans": [], "missions": {"mppi": 7.25}},
    }
    (tmp_path / "bench.json").write_text(json.dumps(values))
    return tmp_path / "bench.json"


def test_sections(
    suite: Path, reproduction: Path, tune: Path, designed: Path, searched: Path, navigated: Path, identified: Path,
    figures: Path, tmp_path: Path,
) -> None:  # fmt: skip
    """Every input becomes a section with its numbers, and with the versions and the machine that it names."""
    out = tmp_path / "RESULTS.md"
    inputs = {"suite": suite, "reproduce": reproduction, "tune": tune, "search": searched}
    inputs |= {"navigate": navigated, "reactive": navigated, "mppi": navigated, "limits": navigated}
    inputs |= {"identify": identified, "bench": figures}
    words = [word for name, path in inputs.items() for word in (f"--{name}", str(path))]
    words.insert(words.index("--tune") + 1, str(designed))
    assert results_page.command([*words, "--out", str(out)]) == 0
    page = results_page.sections(out.read_text())
    titles = ["The paper", "The uncertainty suite", "The designed PID", "Where learning is safe"]
    titles += ["The search of settings"]
    titles += [
        "How narrow and how fast",
        "How narrow in reactive mode",
        "Three MPPIs",
        "Feeding up",
        "Identification",
        "Speed",
    ]
    assert list(page) == ["", *titles]
    assert all(MADE in page[title] and "on Abacus with 3 cores." in page[title] for title in titles)
    short, *folded = page["The uncertainty suite"].split("<details>")
    assert "| nominal | PID | 0/2 | 12.3 [12.1, 12.5] |" in short and "slope" not in short
    assert "| all | fel | 2/2 | – |" in short
    assert (
        "`mrctl suite --full --feedforward none fel --seeds 2 --random 0` made this" in short
        and "- Steady. All tie.\n- A step. `rls` is back." in short
    )
    assert [text.split("</summary>")[0] for text in folded] == ["<summary>Steady", "<summary>A step"]
    assert "| fel | 3.21 | 3.21 | 3.21 | PID fails |" in page["The paper"]
    assert "| lab | " in page["The paper"] and "| 1.00 | 0.25 " in page["The paper"]
    assert "2.00 → 1.00" in page["The paper"] and "| an offset | 9.1 %" in page["The paper"]
    safe, pid = page["Where learning is safe"], page["The designed PID"]
    assert safe.startswith("`mrctl tune car --time-constant 0.15 --delay 0.02` made this") and "λ = 0.15 s" in safe
    assert "| caster, second | 20 " in safe and "88.5" in safe
    assert pid.startswith("`mrctl tune racecar --delay 0.02` made this") and "within 5 % of the designed" in pid
    assert "1.60 as designed and 1.63 as measured" in pid and "| field | 16.0 " in pid
    assert "| 20.0 / 21.0 " in pid and "| 1.60 / 1.63 " in pid
    (row,) = (line for line in page["The search of settings"].splitlines() if "model+fel" in line)
    cells = [
        "",
        "`model+fel`",
        "lab",
        "`fel.step` 0.100, 0.0200",
        "1.50, 0.750",
        "0.900, 0.450",
        "0.500 [0.490, 0.510]",
        "",
    ]
    assert [cell.strip() for cell in row.split("|")] == cells and "best of 121" in page["The search of settings"]
    corridors = page["How narrow and how fast"]
    assert corridors.startswith("`mrctl navigate --suite --quick --robot.path racecar --sensing.tier field` made this")
    assert "\n\n### Critical width\n\nAll tie." in corridors
    assert "\n\n### Three\n\nNone differs." in page["Three MPPIs"] and "### Up" in page["Feeding up"]
    assert "`mrctl identify --robot.path racecar`" in page["Identification"]
    assert "| 21.32 | 21 to 21.64 | 21.28 | +0.19 % |" in page["Identification"]
    assert "| 0.912 |" in page["Speed"] and "| mppi | 7.25 " in page["Speed"]
    assert results_page.narrow(bench.text(json.loads(figures.read_text()))) in page["Speed"]


def test_everything(
    suite: Path, reproduction: Path, tune: Path, designed: Path, searched: Path, navigated: Path, identified: Path,
    figures: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture,
) -> None:  # fmt: skip
    """One command drives what its page shows, and only what this version has not driven; a failure keeps the rest."""
    made = {
        "reproduce": reproduction, "suite": suite, "random": suite, "tune": designed, "search": searched,
        "navigate": navigated, "identify": identified, "bench": figures,
    }  # fmt: skip
    for name, source in (("suite", suite), ("reproduce", reproduction)):
        table = json.loads((source / "table.json").read_text())
        table["versions"]["mrctl"] = mrctl.__version__ if name == "suite" else "0.1.0"
        (source / "table.json").write_text(json.dumps(table))
    sources = {name: own[-1:] for name, own in results_page.SOURCES.items() if name in made}
    monkeypatch.setattr(results_page, "SOURCES", {**sources, "held_out": ("suite --held-out none --out held_out",)})
    shutil.copytree(suite, tmp_path / "all" / "suite")  # of this version
    shutil.copytree(reproduction, tmp_path / "all" / "reproduction")  # of another
    part = tmp_path / "all" / sources["navigate"][0].split()[-1] / "table.json"  # the first part of three
    part.parent.mkdir(parents=True)
    part.write_text((navigated / "table.json").read_text())
    lines = [
        json.dumps({"command": own, "mrctl": mrctl.__version__})
        for name in ("suite", "reproduce")
        for own in sources[name]
    ]
    (tmp_path / "all" / results_page.ENDED_FILE).write_text("\n".join([*lines, ""]))
    ran, failing = [], "suite --held-out"

    def run(words: list[str], cwd: Path, stdout: int | None, **_: object) -> subprocess.CompletedProcess:
        command = " ".join(words[3:])
        ran.append(command)
        if command.startswith(failing):
            return subprocess.CompletedProcess(words, 1)
        (source,) = (made[name] for name, (own,) in sources.items() if own.startswith(command))
        if stdout is None:
            shutil.copytree(source, cwd / words[-1], dirs_exist_ok=True)
        return subprocess.CompletedProcess(words, 0, b"" if stdout is None else source.read_bytes())

    monkeypatch.setattr(subprocess, "run", run)
    words = ["--everything", str(tmp_path / "all"), "--out", str(tmp_path / "RESULTS.md")]
    assert results_page.command(words) == 2
    assert "mrctl suite --held-out none --out held_out ended with status 1" in capsys.readouterr().err
    assert len(ran) == len(sources) and ran[0] == "reproduce --out reproduction" and "suite --out suite" not in ran
    assert sources["navigate"][0] in ran  # it did not end
    before = len(ran)
    assert results_page.command(words) == 2
    assert ran[before:] == ["reproduce --out reproduction", "suite --held-out none --out held_out"]


def test_refused_before_anything_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    """What `mrctl tune` would refuse after hours is refused at once."""
    (tmp_path / "tune" / "imc").mkdir(parents=True)
    (tmp_path / "tune" / "imc" / "table.json").write_text("{}")  # of another version, or of a command that was killed
    monkeypatch.setattr(subprocess, "run", lambda *_, **__: pytest.fail("a command runs"))
    assert results_page.command(["--everything", str(tmp_path), "--out", str(tmp_path / "RESULTS.md")]) == 2
    assert capsys.readouterr().err == f"out: {tmp_path}/tune/imc holds table.json already; nothing was overwritten\n"


@pytest.mark.parametrize("source", [*results_page.SOURCES, "reactive", "mppi", "limits"])
def test_sources(source: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    """Each input of the page has its commands, whose flags are flags of mrctl."""
    assert source in inspect.signature(results_page.main).parameters

    def reached(*_: object, **__: object) -> None:
        raise mrctl.InputError("reached")

    for job in ("paper.reproduce", "suite.suite", "held_out.judge", "tuning.tune", "search.search"):
        monkeypatch.setattr(f"mrctl.experiments.{job}", reached)
    for job in ("navigation_suite.suite", "identify.run", "bench.run"):
        monkeypatch.setattr(f"mrctl.experiments.{job}", reached)
    for command in results_page.SOURCES.get(source, ()):
        assert cli.main(command.partition(" >")[0].split()) == 2
        assert capsys.readouterr().err == "mrctl: reached\n"


def test_random_worlds(suite: Path, tmp_path: Path) -> None:
    """A suite's random worlds become a section of their own; a suite without any is refused in one line."""
    out, error = tmp_path / "RESULTS.md", {"value": 0.0123, "low": 0.0121, "high": 0.0125, "samples": 9}
    rows = [{"part": "random", "feedforward": name, "runs": 9, "v_rmse": error} for name in ("none", "fel")]
    more = [rows[0] | {"part": "floor", "runs": 1}]
    text = f"{TABLES}\n## Random robots (full)\n\nfel wins.\n\n| world |\n| --- |\n\n## More\n\nNo."
    folder = written(tmp_path / "worlds", {"rows": [*more, *rows], "mode": "full"}, text)
    assert results_page.command(["--random", str(folder), "--out", str(out)]) == 0
    found = results_page.sections(out.read_text())["Random worlds"]
    command = "mrctl suite --full --feedforward none fel --seeds 1 --random 9"  # the replicates determine the floors
    assert found.startswith(f"`{command}` made this {MADE}")
    assert found.endswith("fel wins.\n\n| world |\n| --- |")
    (folder / "table.json").write_text((suite / "table.json").read_text())
    assert results_page.command(["--random", str(folder), "--out", str(out)]) == 2


@pytest.mark.parametrize(
    ("mode", "names", "runs", "controllers", "command"),
    [
        ("core", entries("core"), (20, 30), [], "mrctl suite"),
        ("full", entries("full"), (20, 1000), [], "mrctl suite --full"),
        ("core", entries("core"), (50, 30), [], "mrctl suite --seeds 50"),  # not the number of random worlds
        ("quick", entries("quick"), (3, 0), [], "mrctl suite --quick --random 0"),
        ("core", ("none", "fel"), (20, 8), [], "mrctl suite --feedforward none fel --random 8"),
        ("core", ("none", "Gain"), (20, 30), ["a.py:Gain"], "mrctl suite --feedforward none --controller a.py:Gain"),
    ],
)
def test_command_of_a_suite(mode: str, names: Any, runs: Any, controllers: list[str], command: str) -> None:
    """The command above the tables drives the same runs: replicates, random worlds, and what is compared."""
    parts = [(part, count) for part, count in zip(("steady", "random"), runs, strict=True) if count]
    rows = [{"part": part, "feedforward": name, "runs": count} for part, count in parts for name in names]
    assert results_page._suite_command({"mode": mode, "rows": rows, "controllers": controllers}) == command


def test_other_sections_stay(figures: Path, tmp_path: Path) -> None:
    """One input renews its own section in its own place; what people wrote stays, and a second time changes nothing."""
    out = tmp_path / "RESULTS.md"
    out.write_text("# Mine\n\nWords.\n\n## Speed\n\nOld.\n\n### More\n\nOlder.\n\n## What it says\n\nMy view.\n")
    for _ in range(2):
        assert results_page.command(["--bench", str(figures), "--out", str(out)]) == 0
        text = out.read_text()
        assert text.startswith("# Mine\n\nWords.\n\n## Speed\n\n`mrctl bench` made this")
        assert text.endswith("\n\n## What it says\n\nMy view.\n") and "Old" not in text
    assert text.count("## ") == 2


def test_refused(suite: Path, figures: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """One line for what is missing or was written by something else, and the page stays as it was."""
    out = tmp_path / "RESULTS.md"
    (tmp_path / "no.json").write_text("{")
    partial = json.loads(figures.read_text())
    del partial["lab"]
    (tmp_path / "partial.json").write_text(json.dumps(partial))
    for words, says in (
        ([], "name at least one input"),
        (["--suite", tmp_path / "none"], "none/table.json: cannot be read"),
        (["--bench", tmp_path / "no.json"], "no.json: Expecting"),
        (["--bench", suite / "table.json"], "table.json: has no robots"),
        (["--bench", tmp_path / "partial.json"], "partial.json: has no lab"),
    ):
        assert results_page.command([*map(str, words), "--out", str(out)]) == 2
        line = capsys.readouterr().err
        assert says in line and line.count("\n") == 1
        assert not out.exists()
    assert results_page.command(["--bench", str(figures), "--out", str(tmp_path / "no" / "page.md")]) == 2
    assert "cannot be written" in capsys.readouterr().err


@pytest.mark.parametrize("header", [[], [suite_tables.HARMLESS], [suite_tables.CONVERGED]])
def test_explanations(header: list[str]) -> None:
    """The page in the repository explains its tables in the words of the code."""
    page = (Path(results_page.__file__).parent / "RESULTS.md").read_text()
    assert f"\n\n{suite_tables.reading(header)}\n\n" in page
    assert f"\n\n{suite_tables.READING_OF_POSITIONS}\n\n" in page


def test_machine() -> None:
    """The machine has a name and cores."""
    found = machine()
    assert found["processor"] and found["cores"] >= 1


def test_narrow() -> None:
    """Tables lose their padding and nothing else; text, code and what a host shows stay as they are."""
    page = (
        "two  spaces\n\n| a    | b -- c |\n| ---- | ------ |\n| 1  2 |    -3  |\n\n```text\n| kept   |\n```\n\n| x  |\n"
    )
    table = "| a | b -- c |\n| --- | --- |\n| 1 2 | -3 |"
    assert results_page.narrow(page) == f"two  spaces\n\n{table}\n\n```text\n| kept   |\n```\n\n| x |\n"
    assert results_page.narrow(results_page.narrow(page)) == results_page.narrow(page)
