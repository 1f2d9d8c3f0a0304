"""The command `mrctl view`: the page of a live session or of a replay, which is served or exported."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from mrctl.loop.runs import simulate
from mrctl.navigation.mission import Order
from mrctl.navigation.planning import prepared as prepare
from mrctl.scenario import FeedforwardName, Scenario

if TYPE_CHECKING:
    from mrctl.viewer.page import Page
    from mrctl.viewer.server import Server


def live(scenario: Scenario, compare: Sequence[FeedforwardName], export: Path | None, host: str, port: int) -> None:
    """Shows a live session in the browser, or exports its runs.

    Args:
        scenario: Scenario of the first robot.
        compare: Feedforwards of the ghosts.
        export: File to write instead of serving a page.
        host: Address to listen on.
        port: Port to listen on.

    Raises:
        InputError: A scenario is refused, as by `mrctl.simulate`; or the server cannot listen on the address.
    """
    from mrctl.viewer.export import export as write
    from mrctl.viewer.export import refuse_existing
    from mrctl.viewer.live import Live
    from mrctl.viewer.recording import Recording, looks_of

    if export is not None:
        refuse_existing(export)
    scenarios = [scenario, *(scenario.with_feedforward(name) for name in compare)]
    if export is None:
        return _serve(lambda server: Live(scenarios, server), host, port)
    result = simulate(scenarios, progress=True)
    recordings = [Recording(result.isel(run=k)) for k in range(result.sizes["run"])]
    write(recordings, looks_of(recordings, range(len(recordings))), export)
    print(f"page: {export}")


def mission(order: Order, host: str, port: int) -> None:
    """Shows a mission live in the browser; at the goal the robots wait for another one.

    Args:
        order: The mission; the further robots are ghosts.
        host: Address to listen on.
        port: Port to listen on.

    Raises:
        InputError: As `mrctl.navigation.mission.navigate` and `live`.
    """
    from mrctl.viewer.live import Live

    def page(server: Server) -> Live:
        plan, own = prepare(order.task, order.scenario, order.speed, order.margin, order.avoid)
        own = own.replace(goal=None)
        others = [own.with_feedforward(name) for name in order.compare]
        return Live([own, *others], server, order.avoid, plan.searched)

    _serve(page, host, port)


def replay(folder: Path, run: int | None, export: Path | None, host: str, port: int, code: bool) -> None:
    """Shows the replay of a result or a sweep in the browser, or exports it.

    Args:
        folder: Folder of the result or the sweep.
        run: Number of the run that is shown first.
        export: File to write instead of serving a page.
        host: Address to listen on.
        port: Port to listen on.
        code: Whether a sweep may run the Python files that it names.

    Raises:
        InputError: The folder is refused, as by `mrctl.open`; or the server cannot listen on the address.
    """
    from mrctl.viewer.export import export as write
    from mrctl.viewer.export import refuse_existing
    from mrctl.viewer.recording import Library, looks_of
    from mrctl.viewer.replay import ReplayPage

    if export is not None:
        refuse_existing(export)
    library = Library(folder, code)
    shown = library.first_shown(run)
    if export is None:
        return _serve(lambda server: ReplayPage(library, shown, server), host, port)
    recordings = [library.recording(k) for k in shown]
    write(recordings, looks_of(recordings, shown), export)
    count, those = len(library.table), ", ".join(map(str, shown))
    left_out = f" (run{'s' * (len(shown) > 1)} {those} of {count}; --run takes another)" if len(shown) < count else ""
    print(f"page: {export}{left_out}")


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
