"""The commands that drive many runs: `mrctl sweep`, `suite`, `reproduce` and `bench`."""

from __future__ import annotations

import json as jsonlib
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import tyro

from mrctl.cli.shared import Incomplete, check_exists, check_workers, expect_all
from mrctl.record import InputError
from mrctl.scenario import FeedforwardName


def sweep(
    file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SWEEP.toml")],
    /,
    out: Path,
    workers: int | None = None,
    scheduler: str | None = None,
) -> None:
    """Computes the runs of a sweep file in parallel; the same command resumes after an interrupt.

    Args:
        file: Run this sweep file, with the scenarios and what varies in them.
        out: Write the store, which `mrctl.open` opens, to this folder.
        workers: Use this number of processes on this machine; by default one for each core.
        scheduler: Use the Dask scheduler at this address instead, such as tcp://127.0.0.1:8786.
    """
    check_exists(file)
    check_workers(workers)
    from mrctl.sweep import jobs
    from mrctl.sweep.plan import Sweep

    report = jobs.run(Sweep.from_toml(file), out, workers, scheduler, progress=True)
    count = "1 run" if report.runs == 1 else f"{report.runs} runs"
    print(f"{count}, {report.failed} failed; table: {out / 'runs.parquet'}")
    if report.aside:
        lost = "; ".join(f"runs {runs[0]} to {runs[-1]} ({why})" for runs, why in list(report.aside.items())[:5])
        what = "1 job" if len(report.aside) == 1 else f"{len(report.aside)} jobs"
        raise Incomplete(f"{what} set aside: {lost}; the same command tries them again")


def suite(
    feedforward: Annotated[
        tuple[FeedforwardName | Literal["hindsight"], ...] | None, tyro.conf.arg(metavar="NAME ...")
    ] = None,
    controller: tuple[str, ...] = (),
    seeds: int | None = None,
    random: int | None = None,
    quick: bool = False,
    full: bool = False,
    held_out: Annotated[tuple[str, ...] | None, tyro.conf.arg(metavar="NAME ...")] = None,
    cells: Literal["first", "second"] = "first",
    workers: int | None = None,
    out: Path | None = None,
) -> None:
    """Compares feedforwards under uncertainty, with the same draws; the same command resumes after an interrupt.

    It prints how long it will take before it starts: by default less than half an hour on two cores.

    Args:
        feedforward: Feedforwards to compare, such as fel or model+composite; hindsight is the best fixed one for each
            run, either model or coefficients fitted to that run afterwards. By default those in the tables of
            RESULTS.md, with --full all, with --quick six of them.
        controller: Controllers of your own to compare, such as my_file.py:MyFeedforward, or motion=my_file.py:MyMotion
            over PID alone. A feedforward of mrctl may stand in front, as in model+my_file.py:MyFeedforward or
            model+composite+motion=my_file.py:MyMotion.
        seeds: Number of replicates of each case; by default 20, or 3 with --quick.
        random: Number of random scenarios; by default 30, with --quick 6, with --full 1,000 in each tier.
        quick: Run a few cases with few laps and feedforwards, in two minutes; the tables support no claim.
        full: Run all cases, in every tier, in hours.
        held_out: Instead, drive these feedforwards, or some of your own as for --controller, through 40 cells that no
            setting was chosen on, and compare each with model, true_model and model+observer.
        cells: With --held-out: the set of cells; the second one was listed to confirm what the first one had shown.
        workers: Number of processes on this machine; by default one for each core.
        out: Folder for report.html, the tables in Markdown and JSON, the figures and the runs; by default suite,
            suite_quick, suite_full, held_out or, of the second set, held_out_second.
    """
    check_workers(workers)
    if seeds is not None and seeds < 1:
        raise InputError(f"seeds: {seeds} is below 1")
    if random is not None and random < 0:
        raise InputError(f"random: {random} is below 0")
    if quick + full + (held_out is not None) > 1:
        raise InputError("quick: give one of --quick, --full and --held-out")
    if held_out is not None:
        if feedforward or controller or random is not None:
            raise InputError("held_out: names the feedforwards to judge; give no others, and no random scenarios")
        folder = out or Path("held_out" if cells == "first" else f"held_out_{cells}")
        return _judge_held_out(cells, held_out, seeds, workers, folder)
    if cells != "first":
        raise InputError("cells: is for --held-out")
    from mrctl.experiments import suite as uncertainty
    from mrctl.experiments.cases import RANDOM, REPLICATES, Mode, entries

    mode: Mode = "quick" if quick else "full" if full else "core"
    folder = out or Path("suite" if mode == "core" else f"suite_{mode}")
    counts = (REPLICATES[mode] if seeds is None else seeds), (RANDOM[mode] if random is None else random)
    compared = entries(mode) if feedforward is None else feedforward
    aside = uncertainty.suite(mode, compared, controller, *counts, workers, folder).aside
    tables = (folder / "table.md").read_text("utf-8")
    print(f"{tables}\nReport: {folder / 'report.html'}")
    expect_all(aside)


def _judge_held_out(
    cells: Literal["first", "second"], names: Sequence[str], seeds: int | None, workers: int | None, folder: Path
) -> None:
    """Drives feedforwards through cells that no setting was chosen on: `mrctl suite --held-out NAME ...`."""
    from mrctl.experiments import held_out
    from mrctl.experiments.cases import REPLICATES

    aside = held_out.judge(cells, names, REPLICATES["core"] if seeds is None else seeds, workers, folder)
    print((folder / "table.md").read_text("utf-8"))
    expect_all(aside)


def reproduce(out: Path = Path("reproduction")) -> None:
    """Reproduces the paper's figures and tables, and compares the feedforwards in every sensing tier.

    Args:
        out: Write the figures in PNG and PDF, and `table.json` with every number, to this folder.
    """
    from mrctl.experiments import paper

    print(paper.reproduce(out))


def bench(json: bool = False) -> None:
    """Measures the speed of the closed loop with on-line learning, the engine alone, and navigation, in three minutes.

    Args:
        json: Print JSON instead of a table.
    """
    from mrctl.experiments import bench as benchmark

    figures = benchmark.run()
    print(jsonlib.dumps(figures, indent=2, ensure_ascii=False) if json else benchmark.text(figures))
