"""A replay inside a notebook."""

from __future__ import annotations

import html

import numpy as np
import xarray as xr

from mrctl.record import InputError
from mrctl.results.metrics import as_runs

HEIGHT = 480  # pixels
LONGEST = 60.0  # s; the page of a minute of two robots takes a few megabytes


class Replay:
    """Runs in three dimensions with their curves, as one page; a notebook that ends a cell with it shows it.

    It needs no server and no network, and what `jupyter nbconvert --to html` writes still has it.

    Attributes:
        page: The page, HTML.
    """

    def __init__(self, page: str) -> None:
        """Takes the page."""
        self.page = page

    def _repr_html_(self) -> str:
        style = f"width: 100%; height: {HEIGHT}px; border: 1px solid #e5e7eb"
        start = '<iframe class="mrctl-replay" title="replay" loading="lazy"'  # begins when a reader gets there
        return f'{start} style="{style}" srcdoc="{html.escape(self.page)}"></iframe>'


def replay(*results: xr.Dataset) -> Replay:
    """Shows runs in three dimensions: the first one solid, the others as ghosts.

    Args:
        results: What `simulate` returns, or some of it: `result.isel(run=[0, 2])` are two runs of it,
            `result.sel(time=slice(84, 96))` is a stretch of time.

    Raises:
        InputError: No run, more than a minute of one, or runs of different worlds or control periods.
    """
    from mrctl.viewer.export import page
    from mrctl.viewer.recording import Recording, names

    runs = [one.isel(run=k) for one in map(as_runs, results) for k in range(one.sizes["run"])]
    if not runs:
        raise InputError("results: no run to show")
    recordings = [Recording(run) for run in runs]
    for recording in recordings:
        if not np.isfinite(recording.log["x"][0]):
            raise InputError(f"results: {recording.label} had failed before {recording.start:g} s")
        if recording.duration > LONGEST:
            raise InputError(
                f"results: {recording.duration:g} s are too long for a page; select some with .sel(time=…)"
            )
    return Replay(page(recordings, names(recordings, range(len(recordings)))))
