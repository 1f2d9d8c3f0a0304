"""`mrctl navigate --suite`: its experiments one after another, on this machine or on a cluster."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from mrctl.experiments import learned_limits, mission_suite, reactive_corridors, three_mppis
from mrctl.experiments.journal import Journal
from mrctl.experiments.mission_suite import Mode
from mrctl.experiments.tables import Table, machine, output_folder, write_json
from mrctl.loop.groups import arranged
from mrctl.physics import mjcf
from mrctl.results.dataset import versions
from mrctl.scenario import Scenario


class Part(NamedTuple):
    """One experiment."""

    files: str
    """Name of its files, without their endings."""
    drive: Callable[..., Any]
    """Drives its runs, with a scenario, a mode, the controllers if it `compares` them, and a journal; says first how
    long that takes."""
    tables: Callable[[Any, str], list[Table]]
    """Makes its tables of what was found, with titles that name robot, sensing tier and mode."""
    values: Callable[[Any], dict[str, Any]]
    """Makes what stands in its JSON file of what was found."""
    compares: bool = False
    """Whether it compares the controllers, so that the user's take part."""


PARTS = [
    Part("table", mission_suite.drive, mission_suite.tables, mission_suite.values, compares=True),
    Part("reactive", reactive_corridors.drive, reactive_corridors.tables, reactive_corridors.values, compares=True),
    Part("mppi", three_mppis.drive, three_mppis.tables, three_mppis.values),
    Part("limits", learned_limits.drive, learned_limits.tables, learned_limits.values),
]


def suite(
    base: Scenario, mode: Mode, out: Path, scheduler: str | None = None, controllers: Sequence[str] = ()
) -> Iterator[str]:
    """Drives all parts; writes the tables of each in Markdown and JSON, and goes on where it was stopped.

    Args:
        base: Robot, steering, sensing and all else that is the same for all.
        mode: Which suite.
        out: Folder.
        scheduler: Address of a Dask scheduler to use; by default all cores of this machine are used.
        controllers: Controllers of the user to compare, each as for `mrctl.loop.user_files.behind`.

    Yields:
        The tables of each part in Markdown, when it has ended.

    Raises:
        InputError: A controller is bad, the folder cannot be written or holds other results, the robot finds no way
            through most worlds, no scheduler answers, its workers have other code or another robot, or a part fails
            there.
    """
    compared = mission_suite.contenders(base, controllers)
    source = {"versions": versions(), "mode": mode, "scenario": base.model_dump(mode="json")}
    shown = f"{base.robot.path}, {base.sensing.tier}, {mode}"
    for part in PARTS:
        with output_folder(out):
            journal = Journal(out / f"{part.files}.jsonl", source, scheduler, partial(model_of, base))
            found = part.drive(base, mode, *([compared] if part.compares else []), journal)
        text = "\n".join(table.markdown for table in part.tables(found, shown))
        (out / f"{part.files}.md").write_text(text, "utf-8")
        where = machine() if scheduler is None else {"processor": "a Dask cluster", "cores": journal.cores}
        write_json(out / f"{part.files}.json", source | {"machine": where} | part.values(found))
        yield text


def model_of(base: Scenario) -> dict[str, str]:
    """Returns the digest of the compiled model of a robot in its world."""
    own = arranged(base)
    return {"robot": mjcf.digest(mjcf.load(own.world, own.steering, robot=own.robot))}
