"""The viewer in the browser: live sessions, replays, and files that play by themselves."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from mrctl.scenario import FeedforwardName, Scenario


def view(
    file: Path | None, compare: Sequence[FeedforwardName], run: int | None, export: Path | None, host: str, port: int
) -> None:
    """The command `mrctl view`.

    Args:
        file: Scenario, or folder of a result or sweep; None for the default scenario.
        compare: Feedforwards of the ghosts beside a scenario.
        run: Run of a result or sweep to begin with.
        export: File to write instead of serving a page.
        host: Address to listen on.
        port: Port to listen on.

    Raises:
        InputError: What `mrctl.simulate` and `mrctl.open` refuse, an address that cannot be listened on, or options
            that do not go together.
    """
    from mrctl.viewer.live import Live
    from mrctl.viewer.server import Server

    scenario = Scenario() if file is None else Scenario.from_toml(file)
    ghosts = [scenario.model_copy(update={"feedforward": name, "name": ""}) for name in compare]
    page = Live([scenario, *ghosts], Server(host, port))
    print(page.server.announce(), flush=True)
    try:
        page.run()
    finally:
        page.server.stop()
