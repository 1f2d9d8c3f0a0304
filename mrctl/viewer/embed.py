"""A replay inside a notebook."""

from __future__ import annotations

import html

import xarray as xr

from mrctl.record import InputError
from mrctl.results.metrics import as_runs

FRAME_HEIGHT = 480  # pixels
MAX_SECONDS = 60.0  # s, longest replay; the page of a minute of two robots takes a few megabytes


class Replay:
    """Runs in three dimensions with their curves, as one page; a notebook shows it when a cell ends with it.

    The page needs neither a server nor a network, and remains in the file that `jupyter nbconvert --to html` writes.

    Attributes:
        page: The page in HTML.
    """

    def __init__(self, page: str) -> None:
        """Takes the page in HTML."""
        self.page = page

    def _repr_html_(self) -> str:
        style = f"width: 100%; height: {FRAME_HEIGHT}px; border: 1px solid #e5e7eb"
        start = '<iframe class="mrctl-replay" title="replay" loading="lazy"'  # loads when a reader scrolls to it
        return f'{start} style="{style}" srcdoc="{html.escape(self.page)}"></iframe>'


def replay(*results: xr.Dataset) -> Replay:
    """Shows runs in three dimensions, the first one solid and the others as ghosts.

    Args:
        results: Results of `simulate`, or parts of them: `result.isel(run=[0, 2])` are two of the runs,
            `result.sel(time=slice(84, 96))` is an interval of time.

    Raises:
        InputError: There is no run, a run is longer than a minute or failed before the interval, or runs differ in
            world, obstacles, robot or control period.
    """
    from mrctl.viewer.export import page
    from mrctl.viewer.recording import Recording, looks_of

    runs = [result.isel(run=k) for result in map(as_runs, results) for k in range(result.sizes["run"])]
    if not runs:
        raise InputError("results: no run to show")
    recordings = [Recording(run) for run in runs]
    for recording in recordings:
        if recording.duration > MAX_SECONDS:
            raise InputError(
                f"results: {recording.duration:g} s are too long for a page; select some with .sel(time=…)"
            )
    return Replay(page(recordings, looks_of(recordings, range(len(recordings)))))
