"""Tables for terminals and Markdown, JSON without NaN, and output folders."""

from __future__ import annotations

import contextlib
import json
import os
import platform
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import xarray as xr

from mrctl.kernel import Array
from mrctl.record import InputError
from mrctl.results.comparison import Superiority, mean_interval, wilson

MIN_PAIRS = 6  # pairs that one which always wins needs for 95 % confidence: the exact sign test gives p = 0.03


def markdown(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Returns a Markdown table whose columns line up in a terminal too."""
    widths = [max(len(cells[i]) for cells in (header, *rows)) for i in range(len(header))]
    lines = [[cell.ljust(width) for cell, width in zip(cells, widths, strict=True)] for cells in (header, *rows)]
    lines.insert(1, ["-" * width for width in widths])
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def number(value: float, digits: int = 3) -> str:
    """Returns a number as text with a number of significant digits."""
    return f"{value:#.{digits}g}".rstrip(".")


class Table(NamedTuple):
    """A table of text, with a title and a statement."""

    title: str
    """Content of the table, and the size of the suite that made it."""
    says: str
    """Statement that the table supports, from paired tests."""
    cells: pd.DataFrame
    reads: str = ""
    """How to read its columns, where their titles do not say it all."""

    @property
    def markdown(self) -> str:
        """Title, statement, how to read the columns, and table."""
        cells = markdown(list(self.cells), self.cells.to_numpy().tolist())
        return "\n\n".join(filter(None, (f"## {self.title}", self.says, self.reads, cells))) + "\n"


class Report(NamedTuple):
    """What a command prints and what it saves after that, so that a full disk costs no result."""

    text: str
    """What was found, as text or JSON."""
    ended: str
    """Of `navigate` the outcome of the first robot; of `run` when and why it failed, or ""; else ""."""
    save: Callable[[], None]
    """Writes the files; does nothing where the command writes none."""
    result: xr.Dataset | None = None
    """Result of `run`, which `mrctl.save` saves."""


def frame(rows: Sequence[Sequence[str]], header: Sequence[str]) -> pd.DataFrame:
    """Returns rows of text as the cells of a table."""
    return pd.DataFrame(rows, columns=header)  # pyright: ignore[reportArgumentType] (a list of names)


def share_cell(count: int, total: int) -> str:
    """Returns a number of runs out of all, with Wilson's 95 % interval of the share."""
    low, high = wilson(count / total, total)
    return f"{count}/{total} [{100 * low:.0f}, {100 * high:.0f}] %"


def wins_cell(wins: Superiority) -> str:
    """Returns the share of paired runs that one wins, ties as half, with its interval given the ties."""
    return f"{wins.value:.2f} [{wins.low:.2f}, {wins.high:.2f}]"


def word_of(wins: Superiority, better: str, worse: str) -> str:
    """Returns the word for one that wins more than half of the pairs with confidence, for one that loses, or level."""
    if wins.wins + wins.ties + wins.losses < MIN_PAIRS:
        return "level"
    return better if wins.low > 0.5 else worse if wins.high < 0.5 else "level"


def centre_cell(samples: Array, digits: int, median: bool = False) -> str:
    """Returns the mean or the median of the finite samples with its 95 % interval, as from `mean_interval`.

    The mean of one sample has no interval; – stands for no value, and for an end that is infinite.
    """
    value, low, high, *_ = mean_interval(samples, median=median)
    ends = (f"{end:.{digits}f}" if np.isfinite(end) else "–" for end in (low, high))
    interval = "" if np.isnan(low) else f" [{', '.join(ends)}]"
    return f"{value:.{digits}f}{interval}" if np.isfinite(value) else "–"


def refuse_held(path: Path, files: Iterable[str]) -> None:
    """Refuses a folder that holds one of the files that a command writes and does not overwrite.

    Raises:
        InputError: It does; the message names the first one.
    """
    if held := [name for name in files if (path / name).exists()]:
        raise InputError(f"out: {path} holds {held[0]} already; nothing was overwritten")


@contextlib.contextmanager
def output_folder(path: Path | None, files: Iterable[str] = ()) -> Iterator[None]:
    """Makes the folder that a command writes to, before anything is computed for it.

    If the command ends with an error, the folders that were made, and are still empty, are removed.

    Args:
        path: The folder; None for a command that writes nothing.
        files: Names of the files that the command writes and that must not be there.

    Raises:
        InputError: There is one of the files, or the folder cannot be made or written to.
    """
    if path is None:
        yield
        return
    refuse_held(path, files)
    missing = [folder for folder in (path, *path.parents) if not folder.exists()]
    try:
        try:
            path.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=path):
                pass
        except OSError as error:
            raise InputError(f"out: {path}: cannot be written: {error.strerror}") from None
        yield
    except BaseException:
        for folder in missing:
            with contextlib.suppress(OSError):
                folder.rmdir()
        raise


def machine() -> dict[str, Any]:
    """Returns the processor's name and the number of cores of this machine, which go with what was measured on it."""
    try:
        with open("/proc/cpuinfo") as file:
            name = next(line.partition(":")[2].strip() for line in file if line.startswith("model name"))
    except (OSError, StopIteration):
        name = platform.processor() or platform.machine()
    return {"processor": name, "cores": os.cpu_count()}


def json_text(values: object) -> str:
    """Returns JSON with NaN and infinity as null."""
    return json.dumps(_finite(values), indent=1, ensure_ascii=False)


def write_json(path: Path, values: object) -> None:
    """Writes JSON with NaN and infinity as null."""
    path.write_text(json_text(values) + "\n", "utf-8")


def _finite(values: object) -> object:
    if isinstance(values, dict):
        return {str(key): _finite(value) for key, value in values.items()}
    if isinstance(values, (list, tuple)):
        return [_finite(value) for value in values]
    if isinstance(values, float) and not abs(values) < float("inf"):
        return None
    return values
