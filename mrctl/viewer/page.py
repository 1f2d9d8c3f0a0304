"""What every page has: a queue of requests, and the one loop that carries them out."""

from __future__ import annotations

import html
import queue
import sys
import time
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import partial
from typing import Any

import viser

from mrctl.record import InputError
from mrctl.viewer.server import Server

FRAME, REFRESH = 1 / 25, 1 / 15  # s of wall time between pictures, and between plots
SPEEDS = {"0.1×": 0.1, "0.25×": 0.25, "0.5×": 0.5, "1×": 1.0, "2×": 2.0, "5×": 5.0, "as fast as it goes": float("inf")}


class Page(ABC):
    """A page and the loop behind it.

    Whatever a visitor does is queued and carried out by the loop; nothing happens in a callback.

    Attributes:
        server: Where the page is served.
        playing: Whether time goes on.
        speed: Simulated over wall time that is asked for.
        message: What went wrong last, or "".
        curves: The tab for plots.
    """

    def __init__(self, server: Server) -> None:
        """Takes the server; whoever inherits builds the page."""
        self.server = server
        self.playing = True
        self.speed = 1.0
        self.message = ""
        self._requests: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._closing = False
        panel = server.gui.add_panel()
        self.curves = panel.add_tab("Curves", viser.Icon.CHART_LINE)
        panel.dock_left()
        panel.set_width(430)
        server.gui.main_panel.dock_right()

    def ask(self, action: Callable[..., None], *arguments: Any) -> None:  # noqa: ANN401
        """Lets the loop do something, in the order of asking; from any thread."""
        self._requests.put(partial(action, *arguments))

    def on(self, handle: Any, action: Callable[[Any], None]) -> None:  # noqa: ANN401
        """Asks for an action with the new value whenever a visitor uses an input; coroutines keep their order."""

        async def called(event: viser.GuiEvent) -> None:
            if event.client is not None:
                self.ask(action, event.target.value)

        (handle.on_click if hasattr(handle, "on_click") else handle.on_update)(called)

    def complain(self, reason: object) -> None:
        """Says in page and terminal what went wrong."""
        self.message = str(reason)
        print(f"mrctl: {reason}", file=sys.stderr)

    def close(self) -> None:
        """Lets `run` return after the present round."""
        self._closing = True

    def run(self) -> None:
        """Serves the page until `close`."""
        last = next_frame = next_refresh = time.monotonic()
        while not self._closing:
            self._obey()
            now = time.monotonic()
            elapsed, last = now - last, now
            if self.playing:
                self._guarded(partial(self.advance, elapsed, now + FRAME))
            now = time.monotonic()
            if now >= next_frame:
                next_frame = max(next_frame + FRAME, now)
                self._guarded(self.draw)
            if now >= next_refresh:
                next_refresh = max(next_refresh + REFRESH, now)
                self._guarded(self.refresh)
            wait = min(next_frame, next_refresh) - time.monotonic()
            if self.playing:
                wait = min(wait, self.rest())
            time.sleep(max(wait, 1e-3))  # the web server's thread needs its turns

    @abstractmethod
    def advance(self, elapsed: float, until: float) -> None:
        """Lets time go on by `elapsed` s of wall time, with time for it `until` then."""

    @abstractmethod
    def rest(self) -> float:
        """Wall time until `advance` has something to do, s."""

    @abstractmethod
    def draw(self) -> None:
        """Moves the robots."""

    @abstractmethod
    def refresh(self) -> None:
        """Draws what need not be as smooth."""

    def _guarded(self, work: Callable[[], None]) -> None:
        """Does a piece of work; what goes wrong in it is shown in page and terminal, and the loop goes on."""
        try:
            work()
        except InputError as error:
            self.complain(error)
        except Exception as error:
            self.playing = False
            traceback.print_exc(file=sys.stderr)
            self.complain(f"{type(error).__name__}: {error} (details in the terminal; reset starts anew)")

    def _obey(self) -> None:
        while True:
            try:
                request = self._requests.get_nowait()
            except queue.Empty:
                return
            self.message = ""
            self._guarded(request)


def warning(text: str) -> str:
    """Text in red."""
    return f'<span style="color:#b91c1c" class="mrctl-error">{html.escape(text)}</span>'


def block(name: str, *lines: str) -> str:
    """Lines of a page, which tests find by name."""
    return f'<div style="margin:0.4em 1em;max-height:9em;overflow:auto" id="mrctl-{name}">{"<br>".join(lines)}</div>'


def write(handle: viser.GuiHtmlHandle, content: str) -> None:
    """Replaces what a part of the page says."""
    if handle.content != content:
        handle.content = content
