"""Runs notebooks from top to bottom and keeps their outputs in the files, for those who read them without running them.

    python notebooks/regenerate.py [01_the_paper.ipynb …]

Replays are left out, since they are programs of some megabytes, and so is what differs from run to run: progress bars,
warnings, times of execution, and tables in HTML with random names.
"""

import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import nbformat
from jupyter_client.manager import KernelManager
from nbclient import NotebookClient

FOLDER = Path(__file__).parent
KEPT = "image/png", "text/plain"
REPLAY = "(The replay is shown when the notebook runs.)"


def executed(path: Path, folder: Path, kernel: KernelManager) -> nbformat.NotebookNode:
    """Returns a notebook after a run in a folder, with all outputs; an exception in a cell is raised.

    The kernel first forgets the names of the notebook before. It starts once for all notebooks, because the imports and
    the compiled laws take seconds, and goes on counting; here the cells are counted from 1.
    """
    notebook = nbformat.read(path, as_version=4)
    notebook.cells.insert(0, nbformat.v4.new_code_cell(f"%reset -f\n__spec__ = None\n%cd -q {folder}"))
    # The kernel sends what a cell prints in as many pieces as the load of the machine makes.
    NotebookClient(notebook, km=kernel, timeout=600, record_timing=False, coalesce_streams=True).execute()
    del notebook.cells[0]
    for count, cell in enumerate((cell for cell in notebook.cells if cell.cell_type == "code"), 1):
        for counted in (cell, *(output for output in cell.outputs if "execution_count" in output)):
            counted.execution_count = count
    return notebook


def cleaned(notebook: nbformat.NotebookNode) -> nbformat.NotebookNode:
    """Returns a notebook with the outputs that are the same in every run, and without metadata of the machine."""
    found = nbformat.from_dict({**notebook, "cells": [dict(cell) for cell in notebook.cells]})
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    found.metadata = {"kernelspec": kernel, "language_info": {"name": "python"}}
    for cell in found.cells:
        cell.metadata = {}
        if cell.cell_type == "code":
            cell.outputs = [kept for output in cell.outputs if (kept := _cleaned(output))]
    return found


def _cleaned(output: nbformat.NotebookNode) -> nbformat.NotebookNode | None:
    if output.output_type == "stream":
        return output if output.name == "stdout" else None
    if "mrctl-replay" in output.data.get("text/html", ""):
        data = {"text/plain": REPLAY}
    elif "text/html" in output.data and "<table" in output.data["text/html"] and "xr-" not in output.data["text/html"]:
        data = {kind: output.data[kind] for kind in (*KEPT, "text/html") if kind in output.data}
    else:
        data = {kind: output.data[kind] for kind in KEPT if kind in output.data}
    return nbformat.from_dict({**output, "data": data, "metadata": {}})


@contextmanager
def started() -> Iterator[KernelManager]:
    """Starts a kernel, and stops it in the end."""
    kernel = KernelManager(kernel_name="python3")
    kernel.start_kernel(extra_arguments=["--HistoryManager.hist_file=:memory:"])  # as nbclient starts it
    try:
        yield kernel
    finally:
        kernel.shutdown_kernel(now=True)


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folders, started() as kernel:  # which may not lose the folder that it is in
        for path in [FOLDER / name for name in sys.argv[1:]] or sorted(FOLDER.glob("*.ipynb")):
            (folder := Path(folders, path.stem)).mkdir()
            nbformat.write(cleaned(executed(path, folder, kernel)), path)
            print(f"{path.name}: {path.stat().st_size / 1e6:.2f} MB")
