"""The developers' command that writes `RESULTS.md` from the output of the commands of mrctl.

    python -m mrctl.experiments.results_page --suite suite --bench bench.json --out mrctl/experiments/RESULTS.md
    python -m mrctl.experiments.results_page --everything results --out mrctl/experiments/RESULTS.md

The page is a list of sections, each under a heading of the second level. A section whose input is given is rewritten;
every other section of an existing page stays as it is. So one table can be renewed without the half hour of the suite,
and the paragraphs that people wrote about the tables survive.
"""

from __future__ import annotations

import json
import re
import shlex
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from mrctl import __version__
from mrctl.experiments import bench as benchmark
from mrctl.experiments import identify as identification
from mrctl.experiments import paper, tuning
from mrctl.experiments.cases import RANDOM, REPLICATES, entries
from mrctl.experiments.held_out import LOG_FILE, logged
from mrctl.experiments.suite_tables import COLUMNS, column_title, interval, titled
from mrctl.experiments.tables import markdown, number, output_folder, refuse_held
from mrctl.record import InputError

BEGINNING = """# Results

`python -m mrctl.experiments.results_page` writes the tables of this page from what the commands leave behind."""
BENCHMARK = ("nominal", "all")
"""Cases of the suite in the short table at the beginning of its section."""

ROBOTS = "racecar", "car", "turtlebot"
SEARCHED = (
    "none", "model+observer", "model+indi", "model+l1", "fel", "model+fel", "rls", "model+rls", "model+mrac",
    "model+composite",
)  # fmt: skip
SOURCES: dict[str, tuple[str, ...]] = {
    "reproduce": ("reproduce --out reproduction",),
    "suite": ("suite --out suite",),
    "random": ("suite --full --feedforward none fel true_model model+composite --seeds 4 --random 1000 --out worlds",),
    "held_out": (
        "suite --held-out model+composite model+mrac model+rls model+fel model+l1 model+indi --out held_out",
        "suite --held-out model+composite model+mrac model+rls model+fel --cells second --out held_out_second",
    ),
    "tune": (
        *(f"tune {robot} --delay 0 0.01 0.02 --out tune/{robot}" for robot in ROBOTS),
        "tune --time-constant 0.15 --delay 0 0.02 0.04 --out tune/imc",
    ),
    "search": tuple(f"tune --search {name} --out search/{name}" for name in SEARCHED),
    "navigate": (
        *(f"navigate --suite --robot.path {robot} --out corridors/{robot}" for robot in ROBOTS),
        *(
            f"navigate --suite --robot.path {robot} --sensing.tier {tier} --out corridors/{robot}_{tier}"
            for robot in ROBOTS[:2]
            for tier in ("ideal", "field")
        ),
    ),
    "identify": tuple(f"identify --robot.path {robot} --json > identify_{robot}.json" for robot in ROBOTS),
    "bench": ("bench --json > bench.json",),
}
"""The commands whose output is each input of this one; each ends with where it writes."""

ENDED_FILE = "ended.jsonl"
"""Name of the log of the commands that ended with status 0: a line for each, with the version of mrctl."""

Table = Mapping[str, Any]


def main(
    reproduce: Path | None = None,
    suite: Path | None = None,
    random: Path | None = None,
    held_out: tuple[Path, ...] = (),
    tune: tuple[Path, ...] = (),
    search: tuple[Path, ...] = (),
    navigate: tuple[Path, ...] = (),
    reactive: tuple[Path, ...] = (),
    mppi: tuple[Path, ...] = (),
    limits: tuple[Path, ...] = (),
    identify: tuple[Path, ...] = (),
    bench: Path | None = None,
    everything: Path | None = None,
    out: Path = Path("RESULTS.md"),
) -> None:
    """Writes the sections whose inputs are given into the page of results; the other sections stay as they are.

    Args:
        reproduce: Folder that `mrctl reproduce --out` wrote.
        suite: Folder that `mrctl suite --out` wrote.
        random: Folder that `mrctl suite --full --random 1000 --out` wrote, for its random worlds alone.
        held_out: Folders that `mrctl suite --held-out` wrote, one for each set of cells.
        tune: Folders that `mrctl tune --out` wrote: one for each robot, for its designed PID, and one with
            `--time-constant`, for where learning is safe.
        search: Folders that `mrctl tune --search` wrote, one for each entry.
        navigate: Folders that `mrctl navigate --suite` wrote, one for each robot and tier, for what it found in
            corridors.
        reactive: The same folders, for what it found in corridors in reactive mode.
        mppi: The same folders, for what it found with MPPI.
        limits: The same folders, for what it found with learned limits.
        identify: Files with the output of `mrctl identify --json`, one for each robot.
        bench: File with the output of `mrctl bench --json`.
        everything: Instead, run all these commands in this folder, some seven hours of two cores, and take what they
            write. Those that this version of mrctl has ended there already are not run again, so that the same command
            goes on where it was stopped.
        out: The page to write.

    Raises:
        InputError: No input is given, or one cannot be read or was not written by its command, or a command fails.
    """
    if everything is not None:
        found = drive(everything)
        (reproduce,), (suite,), (random,) = found["reproduce"], found["suite"], found["random"]
        (bench,), held_out = found["bench"], found["held_out"]
        tune, search, identify = found["tune"], found["search"], found["identify"]
        navigate = found["navigate"]
        reactive = mppi = limits = navigate[: len(ROBOTS)]
    made = {
        "The paper": reproduce and _paper_section(reproduce),
        "The uncertainty suite": suite and _suite_section(suite),
        "Random worlds": random and _random_section(random),
        "The held-out cells": held_out and "\n\n".join(map(_held_out_section, held_out)),
        **_tune_sections(tune),
        "The search of settings": search and _search_section(search),
        "How narrow and how fast": navigate and _navigated(navigate, "table", "needed"),
        "How narrow in reactive mode": reactive and _navigated(reactive, "reactive", "widths"),
        "Three MPPIs": mppi and _navigated(mppi, "mppi", "runs"),
        "Feeding up": limits and _navigated(limits, "limits", "limits"),
        "Identification": identify and _identify_section(identify),
        "Speed": bench and _bench_section(bench),
    }
    written = {title: text for title, text in made.items() if isinstance(text, str)}  # others have no input
    if not written:
        raise InputError("results_page: name at least one input, such as --bench bench.json")
    page = (sections(_text(out)) if out.exists() else {"": BEGINNING}) | written
    parts = [f"## {title}\n\n{text}" if title else text for title, text in page.items()]
    try:
        out.write_text(narrow("\n\n".join(parts)) + "\n", "utf-8")
    except OSError as error:
        raise InputError(f"{out}: cannot be written: {error.strerror}") from None


def drive(folder: Path) -> dict[str, tuple[Path, ...]]:
    """Runs the commands of `SOURCES` in a folder, but those that this version has ended there without an error.

    Returns:
        The folders and files that they wrote, by input of `main`.

    Raises:
        InputError: A command fails, the folder cannot be made, or a command would refuse what it holds, which is said
            before any runs.
    """
    with output_folder(folder):
        for command in SOURCES["tune"]:
            if not _ended(folder, command):
                refuse_held(folder / command.split()[-1], tuning.files())
        found = {name: tuple(_driven(folder, command) for command in own) for name, own in SOURCES.items()}
    return found


def _driven(folder: Path, command: str) -> Path:
    """Runs a command of `SOURCES`, unless this version has and it ended with status 0; returns where it wrote."""
    words = command.split()
    place = folder / words[-1]
    if _ended(folder, command):
        return place
    print(f"mrctl {command}", flush=True)
    shown = subprocess.PIPE if ">" in words else None
    arguments = words[: words.index(">")] if shown else words
    done = subprocess.run([sys.executable, "-m", "mrctl", *arguments], cwd=folder, stdout=shown, check=False)
    if done.returncode:
        raise InputError(f"everything: mrctl {command} ended with status {done.returncode}")
    if shown:
        place.write_bytes(done.stdout)
    with (folder / ENDED_FILE).open("a", encoding="utf-8") as file:
        file.write(f"{_ending(command)}\n")
    return place


def _ended(folder: Path, command: str) -> bool:
    """Tells whether this version has run a command of `SOURCES` in a folder, and it ended with status 0.

    Its table has to be there. The log says how it ended: a command that drives several parts writes a table after the
    first, and one that set jobs aside writes tables too.
    """
    place = folder / command.split()[-1]
    with suppress(OSError, ValueError, LookupError):
        table = json.loads((place if place.suffix else place / "table.json").read_text("utf-8"))
        written = (table.get("versions") or table["machine"])["mrctl"]
        return written == __version__ and _ending(command) in (folder / ENDED_FILE).read_text("utf-8").splitlines()
    return False


def _ending(command: str) -> str:
    """Returns the line of the log on a command that this version has ended."""
    return json.dumps({"command": command, "mrctl": __version__})


def sections(page: str) -> dict[str, str]:
    """Returns the sections of a page by heading, in order; the text before the first heading has the name ""."""
    beginning, *others = f"\n{page}".split("\n## ")
    parts = [part.partition("\n") for part in others]
    return {"": beginning.strip()} | {title.strip(): text.strip() for title, _, text in parts}


def narrow(page: str) -> str:
    """Returns Markdown without the padding of its tables, a third of the page; some hosts show only its first 500 KiB.

    Lines that are indented, and blocks of code, stay as they are.
    """
    blocks = page.split("```")
    blocks[::2] = [re.sub(r"^\|.*$", _unpadded, block, flags=re.MULTILINE) for block in blocks[::2]]
    return "```".join(blocks)


def _unpadded(row: re.Match[str]) -> str:
    return re.sub("-{3,}", "---", re.sub(" +", " ", row[0]))


def paper_text(table: Table) -> str:
    """Returns the tables of `mrctl reproduce`: the last lap, the long runs, the sensing tiers, and Kanayama's table."""
    last_lap, long_runs = paper.text(table["last_lap"]), paper.endurance_text(table["endurance"])
    return "\n\n".join([last_lap, long_runs, paper.tiers_text(table["tiers"]), paper.kanayama_text(table["kanayama"])])


def suite_text(table: Table, everything: str) -> str:
    """Returns the statements of the tables of `mrctl suite`, a short table of the benchmark, and all tables folded.

    Args:
        table: The content of `table.json`.
        everything: The content of `table.md`.
    """
    cells = [
        [row["case"], titled(row["feedforward"]), f"{row['failed']}/{row['runs']}"]
        + [interval(row[metric]) for metric in COLUMNS]
        for case in BENCHMARK
        for row in table["rows"]
        if row["case"] == case
    ]
    columns = [column_title(table["rows"], metric) for metric in COLUMNS]
    short = markdown(["case", "feedforward", "failed", *columns], cells)
    by_title = {title: text.partition("\n\n") for title, text in sections(everything).items() if title}
    says = "\n".join(f"- {title}. {says}" for title, (says, _, _) in by_title.items())
    folded = [_folded(title, f"{says}\n\n{text}") for title, (says, _, text) in by_title.items()]
    title = f"RMSE of the last lap ({table['mode']}), mean [95 % confidence interval]:"
    return "\n\n".join([says, title, short, *folded])


def _folded(title: str, text: str) -> str:
    """Returns text under a title that a reader opens."""
    return f"<details><summary>{title}</summary>\n\n{text}\n\n</details>"


def random_text(everything: str) -> str:
    """Returns the statement and the table of the random worlds from the content of a suite's `table.md`."""
    return next(text for title, text in sections(everything).items() if title.startswith("Random"))


def held_out_text(table: str, log: str) -> str:
    """Returns the tables of `mrctl suite --held-out`, and a list of all times that the cells were driven.

    Args:
        table: The content of `table.md`.
        log: The content of `held_out.jsonl`.
    """
    tables = {title: text for title, text in sections(table).items() if title}
    counts = [text for title, text in tables.items() if "above a rival" not in title]
    folded = [_folded(title, text) for title, text in tables.items() if "above a rival" in title]
    driven = [
        f"- {one['time']}, {one['entry']}, mrctl {one['mrctl']}: {one.get('says') or 'begun'}" for one in logged(log)
    ]
    return "\n\n".join(
        [*counts, *folded, "Drives through the cells that the folder of this one has logged:", "\n".join(driven)]
    )


def tune_text(table: Table) -> str:
    """Returns the design, the tables and the advice of `mrctl tune`."""
    design, _, rest = tuning.text(dict(table)).partition("\n\n")
    return f"```text\n{design}\n```\n\n{rest}"


def _tuned(table: Table) -> str:
    """Returns the command that wrote a table of `mrctl tune`, but for the lag and another world."""
    delays = " ".join(f"{delay:g}" for delay in dict.fromkeys(row["delay"] for row in table["loops"]))
    rule = "" if table["time_constant"] is None else f" --time-constant {table['time_constant']:g}"
    return f"mrctl tune {table['robot']['path']}{rule} --delay {delays}"


def search_text(tables: Sequence[Table]) -> str:
    """Returns a table of settings before and after each search, with their errors: a row for each entry and tier."""
    header = [
        "entry",
        "tier",
        "settings: before, found",
        "over `model`: before, found",
        "in fresh worlds",
        "found / before",
    ]
    cells = []
    for table in tables:
        for tier, found in table["tiers"].items():
            before, after = table["shipped"], found["found"]
            settings = "; ".join(f"`{name}` {number(before[name])}, {number(after[name])}" for name in before)
            seen = ", ".join(number(np.exp(found["objective"][which])) for which in ("shipped", "found"))
            fresh, ratio = found["fresh"], found["fresh"][tier]["to_shipped"]
            unseen = ", ".join(number(fresh[which]["to_model"]) for which in ("shipped", tier))
            gain = f"{number(ratio['value'])} [{number(ratio['low'])}, {number(ratio['high'])}]"
            gain = "the same" if before == found["found"] else gain
            cells.append([f"`{titled(table['entry'])}`", tier, settings, seen, unseen, gain])
    budget = tables[0]["budget"]
    tried = 1 + budget["generations"] * budget["population"]
    says = (
        f"Each row is the best of {tried} settings in {budget['worlds']} worlds, and what it is worth in "
        f"{budget['fresh']} others, with 95 % intervals. Errors are geometric means of ratios to `model`."
    )
    return f"{says}\n\n{markdown(header, cells)}"


def identify_text(table: Table) -> str:
    """Returns the table of `mrctl identify`."""
    fields = identification.Constant._fields
    return identification.text([identification.Constant(*(row[f] for f in fields)) for row in table["constants"]])


def _section(command: str, table: Table, text: str) -> str:
    """Returns a section, or a part of one, which begins with the origin of its numbers."""
    versions = ", ".join(f"{name} {version}" for name, version in table["versions"].items())
    machine = table["machine"]
    source = f"`{command}` made this with {versions}, on {machine['processor']} with {machine['cores']} cores."
    return f"{source}\n\n{text}"


def _paper_section(folder: Path) -> str:
    table = _read(folder / "table.json", "last_lap", "endurance", "tiers", "kanayama")
    return _section("mrctl reproduce", table, paper_text(table))


def _suite_section(folder: Path) -> str:
    table = _read(folder / "table.json", "rows", "mode")
    return _section(_suite_command(table), table, suite_text(table, _text(folder / "table.md")))


def _suite_command(table: Table) -> str:
    """Returns the command that wrote a table of `mrctl suite`, without the flags that have their defaults."""
    mode, rows = table["mode"], table["rows"]
    seeds, random = (
        max((row["runs"] for row in rows if (row["part"] == "random") == which), default=0) for which in (False, True)
    )
    flags = f" --seeds {seeds}" if seeds != REPLICATES[mode] else ""
    flags += f" --random {random}" if random != RANDOM[mode] else ""
    return f"{_compared(table, rows)}{flags}"


def _compared(table: Table, rows: Sequence[Mapping[str, Any]]) -> str:
    """Returns the command `mrctl suite` with its mode and, unless it compared what it does by default, what it did."""
    mode, every = table["mode"], entries("full")
    named = tuple(dict.fromkeys(row["feedforward"] for row in rows if row["feedforward"] in every))
    words = ["mrctl", "suite", *([f"--{mode}"] if mode != "core" else [])]
    words += ["--feedforward", *named] if named != entries(mode) else []
    words += ["--controller", *own] if (own := table.get("controllers")) else []
    return shlex.join(words)


def _random_section(folder: Path) -> str:
    table = _read(folder / "table.json", "rows", "mode")
    if not any(row["part"] == "random" for row in table["rows"]):
        raise InputError("random: the suite drove no random worlds")
    return _section(_suite_command(table), table, random_text(_text(folder / "table.md")))


def _held_out_section(folder: Path) -> str:
    table = _read(folder / "table.json", "cells", "mode")
    text = held_out_text(_text(folder / "table.md"), _text(folder / LOG_FILE))
    second = [] if (cells := table.get("set", "first")) == "first" else ["--cells", cells]
    return _section(shlex.join(["mrctl", "suite", "--held-out", *table["cells"], *second]), table, text)


def _tune_sections(folders: Sequence[Path]) -> dict[str, str]:
    """Returns the sections of `mrctl tune` by title: of the designed PIDs, and of the last with a time constant."""
    tables = [_read(folder / "table.json", "loops", "motion", "robot", "time_constant") for folder in folders]
    made = {}
    if designed := [t | {"time_constant": None} for t in tables if np.isnan(t["time_constant"])]:
        parts = [_section(_tuned(t), t, tuning.default_text(t)) for t in designed]
        made["The designed PID"] = "\n\n".join([*parts, tuning.GAINS_UNITS])
    for table in tables:
        if not np.isnan(table["time_constant"]):
            made["Where learning is safe"] = _section(_tuned(table), table, tune_text(table))
    return made


def _search_section(folders: Sequence[Path]) -> str:
    tables = [_read(folder / "table.json", "entry", "shipped", "tiers") for folder in folders]
    return _section("mrctl tune --search NAME", tables[0], search_text(tables))


def _identify_section(files: Sequence[Path]) -> str:
    tables = [_read(file, "constants", "robot") for file in files]
    parts = [_section(f"mrctl identify --robot.path {t['robot']['path']}", t, identify_text(t)) for t in tables]
    return "\n\n".join(parts)


def _bench_section(file: Path) -> str:
    table = _read(file, "robots", "threads", "lab", "parts", "sensing_share", "today")
    source = {"versions": {k: v for k, v in table["machine"].items() if k not in ("processor", "cores")}}
    return _section("mrctl bench", {**table, **source}, benchmark.text(dict(table)))


def _navigated(folders: Sequence[Path], name: str, key: str) -> str:
    """Returns one part of what `mrctl navigate --suite` wrote, for each robot and sensing tier."""
    parts = []
    for folder in folders:
        table = _read(folder / f"{name}.json", "scenario", "mode", key)
        flags = " --quick" if table["mode"] == "quick" else ""
        flags += f" --robot.path {table['scenario']['robot']['path']}"
        tier = table["scenario"]["sensing"]["tier"]
        flags += f" --sensing.tier {tier}" if tier != "lab" else ""
        parts.append(_section(f"mrctl navigate --suite{flags}", table, _text(folder / f"{name}.md").strip()))
    return "\n\n".join(parts).replace("\n## ", "\n### ")


def _text(path: Path) -> str:
    try:
        return path.read_text("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read: {getattr(error, 'strerror', error)}") from None


def _read(path: Path, *keys: str) -> dict[str, Any]:
    """Reads the JSON that a command wrote, with NaN in place of null.

    Raises:
        InputError: The file cannot be read, is not JSON, or lacks one of the keys.
    """
    try:
        table = _with_nan(json.loads(_text(path)))
    except ValueError as error:
        raise InputError(f"{path}: {error}") from None
    missing = [key for key in (*keys, "machine") if not isinstance(table, dict) or key not in table]
    if missing:
        raise InputError(f"{path}: has no {missing[0]}; the command that should have written it is another one")
    return table


def _with_nan(value: Any) -> Any:  # noqa: ANN401
    if isinstance(value, dict):
        return {key: _with_nan(one) for key, one in value.items()}
    if isinstance(value, list):
        return [_with_nan(one) for one in value]
    return float("nan") if value is None else value


def command(arguments: Sequence[str] | None = None) -> int:
    """Runs `main` with the flags of a command line.

    Args:
        arguments: The flags; `sys.argv` by default.

    Returns:
        0 on success, 2 on bad input, with one line on stderr.
    """
    try:
        tyro.cli(main, args=arguments, prog="python -m mrctl.experiments.results_page")
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(command())
