"""The command `mrctl view`: it chooses the page for a file, and serves or exports it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from mrctl.loop.simulation import simulate
from mrctl.record import InputError
from mrctl.scenario import FEEDFORWARDS, FeedforwardName, Scenario

BEST: FeedforwardName = "model+composite"  # with the least errors in the README; shown beside PID alone by default

if TYPE_CHECKING:
    from mrctl.viewer.page import Page
    from mrctl.viewer.server import Server


def view(
    file: Path | None,
    compare: Sequence[FeedforwardName],
    run: int | None,
    export: Path | None,
    host: str,
    port: int,
    code: bool = True,
) -> None:
    """Shows robots in the browser: a live session, or the replay of a result or a sweep.

    Args:
        file: Scenario file, or folder of a result or a sweep; None for the default scenario.
        compare: Feedforwards of the ghosts beside a scenario; with neither, the best learner and PID alone are shown.
        run: Number of the run of a result or a sweep that is shown first.
        export: File to write instead of serving a page.
        host: Address to listen on.
        port: Port to listen on.
        code: Whether a sweep may run the Python files that it names.

    Raises:
        InputError: The file is refused, as by `mrctl.simulate` or `mrctl.open`; the server cannot listen on the
            address; or options contradict each other.
    """
    from mrctl.viewer.export import export as write
    from mrctl.viewer.live import Live
    from mrctl.viewer.recording import MAX_SHOWN, Library, Recording, looks_of
    from mrctl.viewer.replay import Replay

    if file is not None and file.is_dir():
        if compare:
            raise InputError("compare: it needs a scenario; the ghosts of a replay are chosen in the page")
        library = Library(file / "result.zarr" if (file / "result.zarr").is_dir() else file, code)
        table = library.table
        shown = [int(table.index[0]) if run is None else run]
        if run is None and len(table) <= MAX_SHOWN:
            shown = [int(k) for k in table.index]
        if export is not None:
            recordings = [library.recording(k) for k in shown]
            return write(recordings, looks_of(recordings, shown), export)
        return _serve(lambda server: Replay(library, shown, server), host, port)
    if run is not None:
        raise InputError("run: only a result or a sweep has several")
    scenario = Scenario() if file is None else Scenario.from_toml(file)
    if file is None and not compare:
        scenario = scenario.replace(**FEEDFORWARDS[BEST])
        compare = ["none"]
    ghosts = [scenario.model_copy(update=FEEDFORWARDS[name] | {"name": ""}) for name in compare]
    if export is not None:
        result = simulate([scenario, *ghosts], progress=True)
        recordings = [Recording(result.isel(run=k)) for k in range(result.sizes["run"])]
        return write(recordings, looks_of(recordings, range(len(recordings))), export)
    return _serve(lambda server: Live([scenario, *ghosts], server), host, port)


def _serve(page: Callable[[Server], Page], host: str, port: int) -> None:
    """Serves a page until it is interrupted."""
    from mrctl.viewer.server import Server

    server = Server(host, port)
    try:
        built = page(server)
        print(server.announce(), flush=True)
        built.run()
    finally:
        server.stop()
