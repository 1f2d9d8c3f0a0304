"""The command `mrctl view`: the page of a live session or of a replay, which is served or exported."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from mrctl.loop.simulation import simulate
from mrctl.physics import mjcf
from mrctl.record import InputError
from mrctl.scenario import FEEDFORWARDS, FeedforwardName, Scenario
from mrctl.theory.references import Lemniscate, check

if TYPE_CHECKING:
    from mrctl.viewer.page import Page
    from mrctl.viewer.server import Server

RESERVE = 0.9  # share of the robot's limits that a suited reference takes
LIMITS = ("max_speed", "max_rotation", "max_acceleration", "max_rotation_acceleration", "steering_limit")


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
    from mrctl.viewer.live import Live
    from mrctl.viewer.recording import Recording, looks_of

    scenarios = [scenario, *(scenario.model_copy(update=FEEDFORWARDS[name] | {"name": ""}) for name in compare)]
    if export is None:
        return _serve(lambda server: Live(scenarios, server), host, port)
    result = simulate(scenarios, progress=True)
    recordings = [Recording(result.isel(run=k)) for k in range(result.sizes["run"])]
    write(recordings, looks_of(recordings, range(len(recordings))), export)


def replay(
    folder: Path, compare: Sequence[FeedforwardName], run: int | None, export: Path | None, host: str, port: int
) -> None:
    """Shows the replay of a result or a sweep in the browser, or exports it.

    Args:
        folder: Folder of the result or the sweep.
        compare: Must be empty.
        run: Number of the run that is shown first.
        export: File to write instead of serving a page.
        host: Address to listen on.
        port: Port to listen on.

    Raises:
        InputError: The folder is refused, as by `mrctl.open`; the server cannot listen on the address; or options
            contradict each other.
    """
    from mrctl.viewer.export import export as write
    from mrctl.viewer.recording import MAX_SHOWN, Library, looks_of
    from mrctl.viewer.replay import Replay

    if compare:
        raise InputError("compare: it needs a scenario; the ghosts of a replay are chosen in the page")
    library = Library(folder)
    table = library.table
    shown = [int(table.index[0]) if run is None else run]
    if run is None and len(table) <= MAX_SHOWN:
        shown = [int(k) for k in table.index]
    if export is None:
        return _serve(lambda server: Replay(library, shown, server), host, port)
    recordings = [library.recording(k) for k in shown]
    write(recordings, looks_of(recordings, shown), export)


def suited(scenario: Scenario, given: Collection[str] = ()) -> Scenario:
    """Returns the scenario with the steering of its robot, and with a lemniscate that the robot can follow.

    The lemniscate is the default one where possible; otherwise it is larger, then slower.

    Args:
        scenario: The scenario.
        given: Names of the fields that stay as they are.

    Raises:
        InputError: The robot cannot be driven.
    """
    if "steering" not in given:
        scenario = scenario.replace(steering=mjcf.arrangement(scenario.robot))
    if "reference" in given:
        return scenario
    model, robot = mjcf.build(scenario.world, scenario.steering, robot=scenario.robot)
    robot = robot.model_copy(update={name: RESERVE * getattr(robot, name) for name in LIMITS})
    first = Lemniscate()
    for larger, slower in itertools.product(range(12), range(12)):
        size, period = round(first.size * 2 ** (larger / 4), 2), round(first.period * 2 ** (slower / 4), 1)
        reference = Lemniscate(size=size, period=period)
        try:
            check(reference, robot, mjcf.reverses(model, scenario.steering))
        except InputError:
            continue
        return scenario.replace(reference=reference)
    return scenario


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
