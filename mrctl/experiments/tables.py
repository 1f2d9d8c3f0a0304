"""Tables for terminals and Markdown, JSON without NaN, and output folders."""

from __future__ import annotations

import contextlib
import json
import os
import platform
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from mrctl.record import InputError


def markdown(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Returns a Markdown table whose columns line up in a terminal too."""
    widths = [max(len(cells[i]) for cells in (header, *rows)) for i in range(len(header))]
    lines = [[cell.ljust(width) for cell, width in zip(cells, widths, strict=True)] for cells in (header, *rows)]
    lines.insert(1, ["-" * width for width in widths])
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def number(value: float, digits: int = 3) -> str:
    """Returns a number as text with a number of significant digits."""
    return f"{value:#.{digits}g}".rstrip(".")


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
    if held := [name for name in files if (path / name).exists()]:
        raise InputError(f"out: {path} holds {held[0]} already; nothing was overwritten")
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
    path.write_text(json_text(values) + "\n")


def _finite(values: object) -> object:
    if isinstance(values, dict):
        return {str(key): _finite(value) for key, value in values.items()}
    if isinstance(values, (list, tuple)):
        return [_finite(value) for value in values]
    if isinstance(values, float) and not abs(values) < float("inf"):
        return None
    return values
