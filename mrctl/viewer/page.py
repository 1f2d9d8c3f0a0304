"""The base of every page: a queue of requests, and the loop that carries them out."""

from __future__ import annotations

import html
import queue
import sys
import threading
import time
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable, Coroutine, Sequence
from functools import partial
from typing import Any

import numpy as np
import viser
from viser._messages import HotkeyKey

from mrctl.kernel import Rows
from mrctl.record import InputError
from mrctl.viewer import deviation, sensors
from mrctl.viewer.looks import MAX_MARKED
from mrctl.viewer.recording import Recording, looks_of
from mrctl.viewer.scene import Scene
from mrctl.viewer.server import MANNERS, PHONE, SOFT_LIGHT, Server
from mrctl.viewer.words import block, warning

FRAME, REFRESH = 1 / 25, 1 / 12  # s of wall time between two pictures, and between two updates of the plots
CURVES_WIDTH, INPUTS_WIDTH = 340.0, 290.0  # px of the panels, of which 1280 px leave half to the scene
CAMERAS = ("overview", "top", "chase")
SPEEDS = {"0.1×": 0.1, "0.25×": 0.25, "0.5×": 0.5, "1×": 1.0, "2×": 2.0, "5×": 5.0, "as fast as it goes": float("inf")}


class Page(ABC):
    """A page and the loop behind it.

    Each action of a visitor is queued, and the loop carries it out; a callback itself changes nothing.

    Attributes:
        server: Server of the page.
        playing: Whether time goes on.
        speed: Requested ratio of simulated to wall time.
        curves: Tab for the plots.
    """

    _scene: Scene

    def __init__(self, server: Server) -> None:
        """Takes the server; a subclass builds the rest of the page."""
        self.server = server
        server.gui.add_html(PHONE + MANNERS)
        self._notice = server.gui.add_html("")  # above the tabs, so that it is seen on each of them
        self.message = ""
        self.playing = True
        self.speed = 1.0
        self._requests: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._closing = False
        self._making: threading.Thread | None = None
        self._chasing: dict[int, viser.ClientHandle] = {}  # visitors whose cameras are behind the first robot
        panel = server.gui.add_panel()
        self.curves = panel.add_tab("Curves", viser.Icon.CHART_LINE)
        panel.dock_left()
        panel.set_width(CURVES_WIDTH)
        panel.expand()  # on a phone, where it is a section of the panel of inputs
        server.gui.main_panel.dock_right()
        server.gui.main_panel.set_width(INPUTS_WIDTH)

        @server.on_client_connect
        async def _(client: viser.ClientHandle) -> None:
            client.camera.on_update(self._keep_above())

            @client.camera.on_update
            async def _(_: viser.CameraHandle) -> None:
                self._scene.fit(client)

    def _keep_above(self) -> Callable[[viser.CameraHandle], Coroutine[Any, Any, None]]:
        """Returns a callback that puts a visitor's camera back above the floor, whenever it gets below.

        A slow browser reports its camera before it has placed it where the page begins; that one is not moved.
        """
        placed = False

        async def called(camera: viser.CameraHandle) -> None:
            nonlocal placed
            here, target = np.array(camera.position), np.array(camera.look_at)
            above = self._scene.above_floor(here)
            if np.array_equal(above, here):
                placed = True
            elif placed:
                camera.position, camera.look_at = above, target

        return called

    def add_cameras(self) -> None:
        """Adds the buttons that place a visitor's own camera, in the present context of the GUI."""
        group = self.server.gui.add_button_group("Camera", CAMERAS)

        @group.on_click
        async def _(event: viser.GuiEvent) -> None:
            if event.client is not None:
                self.ask(self._place_camera, event.client, group.value)

    def _place_camera(self, client: viser.ClientHandle, name: str) -> None:
        self._chasing.pop(client.client_id, None)
        if client.client_id not in self.server.get_clients():
            return  # the visitor has left in the meantime
        if name == "chase":
            self._chasing[client.client_id] = client
            return self.chase()
        self._scene.overlook(client, name == "top")

    def chase(self) -> None:
        """Moves the cameras of visitors who chase the first robot."""
        visitors = self.server.get_clients()
        for number, client in list(self._chasing.items()):
            if number not in visitors:
                del self._chasing[number]
                continue
            with client.atomic():
                self._scene.turn(client, *self._scene.behind())

    @property
    def message(self) -> str:
        """Last error, or ""; it stands on every tab."""
        return self._message

    @message.setter
    def message(self, text: str) -> None:
        self._message = text
        self._notice.content = block("message", warning(text)) if text else ""

    def add_drawing(self) -> None:
        """Adds the inputs that say how deviations, estimates and fixes are drawn, in the present context of the GUI."""
        gui = self.server.gui
        self.deviation = gui.add_dropdown(
            "Deviation ×", deviation.CHOICES,
            hint="Factor on the distance of trails and balls from the reference; robots stand where they are.",
        )  # fmt: skip
        self.sensors = gui.add_checkbox("Sensors", False, hint="Draws what the robot knows of its posture.")
        self.magnified = gui.add_dropdown(
            "Sensor errors ×", tuple(f"{m}×" for m in sensors.MAGNIFICATIONS),
            hint="Factor on errors of x and y in the picture, about the true position; headings are not magnified.",
        )  # fmt: skip
        self._sensed = gui.add_html("")
        self.on(gui.add_checkbox("Dark page", self.server.dark), self._set_dark)
        self._soft = gui.add_checkbox(SOFT_LIGHT, self.server.soft, hint="Reflections and shadows, for a GPU.")
        self.on(self._soft, self._set_soft)

    def add_download(self) -> None:
        """Adds the button that makes one HTML file, in the present context of the GUI."""
        button = self.server.gui.add_button(
            "Download as one HTML file", icon=viser.Icon.DOWNLOAD, hint="It plays without a server and a network."
        )

        @button.on_click
        async def _(event: viser.GuiEvent) -> None:
            self.ask(self._download, event.client)

    def _download(self, client: viser.ClientHandle) -> None:
        """Makes the file in another thread, so that the session goes on; one at a time."""
        if self._making is not None and self._making.is_alive():
            raise InputError("download: the file is still being made")
        recordings = self.shown()
        self._making = threading.Thread(target=self._send, args=(client, recordings), daemon=True)
        self._making.start()

    def _send(self, client: viser.ClientHandle, recordings: Sequence[Recording]) -> None:
        from mrctl.viewer.export import page  # which imports this room's scene

        try:
            content = page(recordings, looks_of(recordings, range(len(recordings)))).encode()
        except InputError as error:
            return self.ask(self.complain, error)
        if client.client_id in self.server.get_clients():  # the visitor may have left
            client.send_file_download("mrctl.html", content, save_immediately=True)

    @abstractmethod
    def shown(self) -> list[Recording]:
        """Returns what the page shows, as recordings."""

    def _set_dark(self, dark: bool) -> None:
        self.server.set_dark(dark)
        self._scene.paint()

    def _set_soft(self, soft: bool) -> None:
        self.server.set_soft(soft)
        self._scene.paint()

    def add_key(self, key: HotkeyKey, label: str, action: Callable[[], None]) -> None:
        """Queues an action whenever a visitor presses a key; viser lists it under its label with Ctrl-K.

        The arrows and W, A, S, D, Q and E are viser's own: they move the camera.
        """

        async def called(_: viser.CommandEvent) -> None:
            self.ask(action)

        self.server.gui.add_command(label, hotkey=key).on_trigger(called)

    def magnified_deviation(self, rows: Rows) -> int:
        """Returns the factor on the deviations of some records; by default the largest that keeps them in view."""
        chosen = self.deviation.value
        return sensors.magnification(deviation.extent(rows)) if chosen == "automatic" else int(chosen.rstrip("×"))

    @property
    def marks(self) -> tuple[bool, int]:
        """Whether estimates and fixes are drawn, and the factor on their errors."""
        return self.sensors.value, int(self.magnified.value.removesuffix("×"))

    def set_marks(self, on: bool, spread: float) -> None:
        """Sets the inputs for errors of `spread` in m: whether estimates are drawn, if it is not tiny, and a factor."""
        factor = sensors.magnification(spread)
        self.sensors.value, self.magnified.value = on and factor < max(sensors.MAGNIFICATIONS), f"{factor}×"

    def describe_estimates(self, labels: Sequence[str], last: Rows) -> None:
        """Writes what the marks mean, and the errors that they show.

        Args:
            labels: Label of each robot.
            last: Record of `TICK` of each robot, `(B,)`.
        """
        on, magnified = self.marks
        lines = []
        for label, row in zip(labels[:MAX_MARKED], last, strict=False):
            if on and np.isfinite(off := np.hypot(*sensors.error(row))):
                size = " × ".join(f"{1e3 * a:.1f}" for a in sensors.ellipse(row)[0][::-1])
                known = f", 3σ {size} mm" if row["variance_x"] > 0 else ""
                lines.append(f"{html.escape(label)}: {1e3 * off:.1f} mm off{known}")
        if lines:
            size = f"<b>Errors are drawn {magnified} times.</b>" if magnified > 1 else "Errors have their true size."
            lines.append(
                f"Outline: estimated posture. Black point: true position. Ellipse: {sensors.SIGMAS:g}σ of x and y "
                f"({100 * sensors.ELLIPSE_SHARE:.1f} %). "
                f"Small points: fixes of the last {sensors.FIX_AGE:g} s. {size}"
            )
        self._sensed.content = block("sensors", *lines)

    def choose_speed(self, name: str) -> None:
        """Sets how fast simulated time passes, by the name of a speed in `SPEEDS`."""
        if name not in SPEEDS:
            raise InputError(f"{name}: not one of the choices")
        self.speed = SPEEDS[name]

    def ask(self, action: Callable[..., None], *arguments: Any) -> None:  # noqa: ANN401
        """Queues an action for the loop; any thread may call this."""
        self._requests.put(partial(action, *arguments))

    def on(self, handle: Any, action: Callable[[Any], None]) -> None:  # noqa: ANN401
        """Queues an action with the new value whenever a visitor uses an input."""

        async def called(event: viser.GuiEvent) -> None:  # viser runs coroutines, unlike functions, in order
            if event.client is not None:
                self.ask(action, event.target.value)

        (handle.on_click if hasattr(handle, "on_click") else handle.on_update)(called)

    def complain(self, reason: object) -> None:
        """Shows an error in the page and in the terminal."""
        self.message = str(reason)
        print(f"mrctl: {reason}", file=sys.stderr)

    def close(self) -> None:
        """Makes `run` return after the present iteration."""
        self._closing = True

    def run(self) -> None:
        """Serves the page until `close`."""
        last = next_frame = next_refresh = time.monotonic()
        while not self._closing:
            self._run_requests()
            now = time.monotonic()
            elapsed, last = now - last, now
            if self.playing:
                self._report_errors(partial(self.advance, elapsed, now + FRAME))
            now = time.monotonic()
            if now >= next_frame:
                next_frame = max(next_frame + FRAME, now)
                self._report_errors(self.draw)
            if now >= next_refresh:
                next_refresh = max(next_refresh + REFRESH, now)
                self._report_errors(self.refresh)
            wait = min(next_frame, next_refresh) - time.monotonic()
            if self.playing:
                wait = min(wait, self.idle_time())
            time.sleep(max(wait, 1e-3))  # this lets the thread of the web server run

    @abstractmethod
    def advance(self, elapsed: float, until: float) -> None:
        """Advances the simulated time for `elapsed` s of wall time, but not beyond the monotonic time `until` in s."""

    @abstractmethod
    def idle_time(self) -> float:
        """Returns the wall time in s until `advance` has something to do."""

    @abstractmethod
    def draw(self) -> None:
        """Moves the robots."""

    @abstractmethod
    def refresh(self) -> None:
        """Updates plots and texts, which need fewer pictures per second than the robots."""

    def _report_errors(self, work: Callable[[], None]) -> None:
        """Does a piece of work; an error in it is shown in page and terminal, and the loop goes on."""
        try:
            work()
        except InputError as error:
            self.complain(error)
        except Exception as error:
            self.playing = False
            traceback.print_exc(file=sys.stderr)
            self.complain(f"{type(error).__name__}: {error} (details in the terminal; reset starts again)")

    def _run_requests(self) -> None:
        """Carries out the queued requests."""
        while True:
            try:
                request = self._requests.get_nowait()
            except queue.Empty:
                return
            self.message = ""
            self._report_errors(request)


def not_before_the_start(time: float) -> float:
    """Returns a time in s to which a visitor goes; a negative one, as a page sends it while somebody types, is 0.

    Raises:
        InputError: It is not a finite number.
    """
    if not isinstance(time, int | float) or not np.isfinite(time):
        raise InputError(f"go to: {time} is not a time")
    return max(0.0, time)
