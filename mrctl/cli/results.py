"""The commands that show results: `mrctl view`, which also shows live sessions, `record` and `export`."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import tyro

from mrctl.cli.arguments import check_switches, fields_set, scenario_file_of
from mrctl.cli.flags import EXPLAINED_FIELDS, explained, with_fields
from mrctl.cli.shared import BEST, check_exists, check_world, suited
from mrctl.record import InputError
from mrctl.scenario import FEEDFORWARDS, FeedforwardName, Scenario


def view_with(arguments: list[str]) -> Callable[..., None]:
    """Returns the `view` command, which takes the scenario flags of `run`.

    Without a file and a choice of controllers, `model+composite` is shown beside PID alone. A robot that is chosen
    without its steering or a reference brings those that suit it.
    """
    asked = arguments[0] == "view"
    scenario_file = scenario_file_of(arguments) if asked else None
    chosen = scenario_file is not None or bool(fields_set(arguments) & {"prior", "learner", "compare"})
    default = Scenario() if chosen else Scenario(**FEEDFORWARDS[BEST])
    if scenario_file:
        default = Scenario.from_toml(scenario_file)

    def view(
        file: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="[SCENARIO.toml|RESULT]")] = None,
        /,
        scenario: Annotated[Scenario, tyro.conf.arg(name="")] = default,
        compare: Annotated[tuple[FeedforwardName, ...], tyro.conf.arg(metavar="NAME ...")] = (),
        number: Annotated[int | None, tyro.conf.arg(name="run")] = None,
        export: Path | None = None,
        host: str = "127.0.0.1",
        port: int = 8080,
        code: bool = True,
    ) -> None:
        """Shows robots in the browser: a live session of a scenario, or the replay of a result or sweep.

        Args:
            file: Scenario file, whose values flags override, or result of `mrctl run --out` or `mrctl sweep`; by
                default model+composite and PID alone, live.
            scenario: The scenario. A robot brings the steering and the reference that suit it, unless they are given.
                Without --prior, --learner and --compare, model+composite drives beside PID alone; with one of them,
                the defaults are those of `mrctl run`. A live session goes on after the last lap.
            compare: Feedforwards of further robots, such as none or model+composite, which are shown as ghosts with the
                same seed and events.
            number: Number of the run to show first, in a result or sweep.
            export: Write this HTML file, which plays without a server, instead of serving a page.
            host: Address to listen on; an address other than 127.0.0.1 lets others in without a password.
            port: Number of the port to listen on.
            code: Whether a sweep may run the Python files of the controller that it names.
        """
        if export is not None and (new := sorted(fields_set(arguments) & {"host", "port"})):
            raise InputError(f"{new[0]}: belongs to a page that is served; --export writes a file")
        if file is not None and str(file) != scenario_file:
            if not file.exists():
                check_switches(arguments)
            if scenario != default:
                raise InputError(f"view: {file} has its own scenarios; flags of a scenario need a live session")
            check_exists(file)
            if compare:
                raise InputError("compare: it needs a scenario; the ghosts of a replay are chosen in the page")
            from mrctl.viewer import view as viewing

            return viewing.replay(file, number, export, host, port, code)
        if number is not None:
            raise InputError("run: chooses a run of a result or a sweep; a live session has none")
        check_world(scenario.world, scenario.robot)
        from mrctl.viewer import view as viewing

        scenario = suited(scenario, arguments, scenario_file)
        viewing.live(scenario, compare if chosen else ("none",), export, host, port)

    return with_fields(view, default, explained(arguments) if asked else EXPLAINED_FIELDS)


def record(
    file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RESULT")],
    /,
    out: Path,
    number: Annotated[int | None, tyro.conf.arg(name="run")] = None,
    code: bool = True,
) -> None:
    """Writes a video of a result: the robots in three dimensions with the reference and their trails.

    Args:
        file: Result of `mrctl run --out` or `mrctl sweep`.
        out: File to write, whose name ends in .gif, or in .mp4, which needs pip install 'mrctl[video]'.
        number: Number of the run to show; by default up to four runs are shown together, the first one solid and those
            of its world as ghosts, and of more runs only the first one.
        code: Whether a sweep may run the Python files of the controller that it names.
    """
    check_exists(file)
    if sys.platform == "linux" and not os.environ.get("DISPLAY"):
        os.environ.setdefault("MUJOCO_GL", "egl")  # which mujoco reads when it is imported
    from mrctl.viewer import video

    left_out = video.record(file, number, out, code)
    print(f"video: {out}" + (f" ({left_out})" if left_out else ""))


def export(
    file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RESULT")],
    /,
    to: Literal["mcap", "csv", "parquet", "npz"],
    out: Path,
    number: Annotated[int | None, tyro.conf.arg(name="run")] = None,
) -> None:
    """Writes a result for other tools: ROS 2 messages, a table, or NumPy arrays.

    Args:
        file: Result of `mrctl run --out` or `mrctl sweep`.
        to: Format of the file: ROS 2 messages (`mcap`), a table (`csv`, `parquet`) or NumPy arrays (`npz`).
        out: File to write.
        number: Number of the run to write; by default all runs, whose numbers are in a column or before each topic.
    """
    check_exists(file)
    from mrctl.results import export as exporting
    from mrctl.sweep import jobs, store

    result = store.open(file)
    of_sweep = None if "scenarios" in result.attrs else partial(jobs.scenario_of, file)
    count = exporting.export(result, to, out, number, of_sweep)
    print(f"{out}: {count} {'run' if count == 1 else 'runs'}")
