"""A viser server that serves this machine alone."""

from __future__ import annotations

import contextlib
import errno
import http
import ipaddress
import socket
import sys
from collections.abc import Iterator
from functools import partial
from typing import Any
from unittest import mock
from urllib.parse import urlsplit

import rich
import viser
import websockets.asyncio.server
from viser._messages import GuiUpdateMessage
from viser.infra import ClientId
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from mrctl.record import InputError

LOCAL = ("localhost", "127.0.0.1", "::1")
ANYWHERE = ("0.0.0.0", "::")

# On a phone the panel is as wide as the screen and leaves the upper half of it to the scene, and a finger finds the
# buttons. The curves are above the inputs, open, and scroll on their own, so that both are at hand.
PHONE = """<style>@media (max-width: 576px) {
.mantine-Button-root, .mantine-Tabs-tab, .mantine-Input-input, .mantine-ActionIcon-root, .mantine-CloseButton-root,
[aria-label$="panel Curves"] { min-height: 44px !important }
.mantine-ActionIcon-root, .mantine-CloseButton-root { min-width: 44px !important }
.mantine-Checkbox-root { --checkbox-size: 44px !important }
[style*="inset"]:has(> div > div > div > canvas) { bottom: 50% !important }
[style*="width: 20em"] { width: 100vw !important; max-height: 50% !important }
div:has(> div > .mantine-Tabs-root > [aria-label$="panel Curves"]) { display: flex; flex-direction: column }
div:has(> .mantine-Tabs-root > [aria-label$="panel Curves"]) { order: -1 }
[aria-label$="panel Curves"] + * { max-height: 180px; overflow-y: auto !important }
}</style>"""

SOFT_LIGHT = "Soft light"  # label of a checkbox
# A browser that draws on a GPU ticks that box once; one that draws in software would show a third as many pictures.
# After a click on any checkbox it lets go of the focus, since an input with the focus keeps keys to itself.
MANNERS = """<style onload="
if (!window.mrctlManners) {
    window.addEventListener('pointerup', window.mrctlManners = () => setTimeout(() => {
        if (document.activeElement && document.activeElement.type === 'checkbox') document.activeElement.blur();
    }, 50), true);
    const gl = document.createElement('canvas').getContext('webgl2');
    const about = gl && gl.getExtension('WEBGL_debug_renderer_info');
    const drawn = about ? gl.getParameter(about.UNMASKED_RENDERER_WEBGL) : 'software';
    const tick = (tries) => {
        const label = [...document.querySelectorAll('label')].find((l) => l.textContent === 'LABEL');
        const box = label && document.getElementById(label.htmlFor);
        if (!box) return tries && setTimeout(tick, 500, tries - 1);
        sessionStorage.setItem('mrctlLight', 'chosen');
        if (!box.checked) box.click();
    };
    if (!sessionStorage.getItem('mrctlLight') && !/swiftshader|llvmpipe|software|basic render/i.test(drawn)) tick(20);
}"></style>""".replace("LABEL", SOFT_LIGHT)


class Server(viser.ViserServer):
    """A viser server that only this machine and pages of its own origin can reach.

    Viser itself listens on all interfaces, moves to another port if one is in use, answers pages of any origin, and
    opens a public tunnel for any client that asks.
    """

    def __init__(self, host: str = "127.0.0.1", port: int = 8080) -> None:
        """Starts to serve.

        Args:
            host: Address to listen on.
            port: Port to listen on; 0 for any free port.

        Raises:
            InputError: The port is in use, or this machine does not have the address.
        """
        with contextlib.closing(_reserve(host, port)) as taken:
            port = taken.getsockname()[1]
        with _guarded(host), _quiet():
            super().__init__(host, port, label="mrctl", verbose=False)
        interface = self.gui._websock_interface
        interface.unregister_handler(GuiUpdateMessage, self.gui._handle_gui_updates)
        interface.register_handler(GuiUpdateMessage, self._update_value)
        if self.get_port() != port:  # another program took it in the meantime
            self.stop()
            raise InputError(f"port: {port} is in use; choose another with --port")
        self.set_dark(False)
        self._ambient = self.scene.add_light_ambient("/light", intensity=1.2)
        self.set_soft(False)

    def set_dark(self, dark: bool) -> None:
        """Makes pages dark or light; `Scene.paint` does so for a scene."""
        self.dark = dark
        self.gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium", dark_mode=dark)

    def set_soft(self, soft: bool) -> None:
        """Lights scenes by a photographed room and with shadows, or evenly; `Scene.paint` does the rest."""
        self.soft = soft
        self.scene.configure_environment_map("studio" if soft else None, environment_intensity=0.2)
        self.scene.configure_default_lights(cast_shadow=soft)
        self._ambient.visible = not soft

    async def _update_value(self, client: ClientId, message: GuiUpdateMessage) -> None:
        """Sets the value of an input for a client; viser would set whatever attribute of it a client names."""
        if set(message.updates) == {"value"}:
            await self.gui._handle_gui_updates(client, message)

    def request_share_url(self, verbose: bool = True) -> None:
        """Refuses to open a tunnel to a public server, which any client may ask for."""
        if verbose:
            print("mrctl: a request to share this page publicly was refused", file=sys.stderr)

    def stop(self) -> None:
        """Stops serving, without viser's announcements."""
        with _quiet():
            super().stop()

    def announce(self) -> str:
        """Returns the address of the page, and how to reach it from another machine."""
        host, port = self.get_host(), self.get_port()
        if host in LOCAL:
            return (
                f"open http://{host}:{port}  (Ctrl-C ends)\n"
                f"from another machine: ssh -L {port}:127.0.0.1:{port} THIS-MACHINE, then http://127.0.0.1:{port}"
            )
        return (
            f"open http://{host}:{port}  (Ctrl-C ends)\n"
            f"warning: --host {host}: everyone who reaches this address controls the viewer, without a login"
        )


def _reserve(host: str, port: int) -> socket.socket:
    """Returns a socket that listens on the address, which shows that the address is free.

    Raises:
        InputError: The server cannot listen on the address.
    """
    if not 0 <= port <= 65535:
        raise InputError(f"port: {port} is not between 0 and 65535")
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        taken = socket.socket(family, kind, protocol)
        try:
            taken.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            taken.bind(address)
            taken.listen()
        except OSError:
            taken.close()
            raise
        return taken
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            raise InputError(f"port: {port} is in use; choose another with --port") from None
        raise InputError(f"host: cannot listen on {host}:{port}: {error.strerror or error}") from None


def _quiet() -> contextlib.AbstractContextManager[object]:
    """Suppresses viser's own announcements, which in a notebook bypass stdout."""
    return mock.patch.object(rich, "print")


@contextlib.contextmanager
def _guarded(host: str) -> Iterator[None]:
    """Makes viser start its web server with a check of every request, for which viser has no option."""
    started = []

    def serve(*args: Any, process_request: Any, **kwargs: Any) -> Any:  # noqa: ANN401
        started.append(True)
        return genuine(*args, process_request=partial(_admit, host, process_request), **kwargs)

    genuine = websockets.asyncio.server.serve
    with mock.patch.object(websockets.asyncio.server, "serve", serve):
        yield
    if not started:
        raise RuntimeError("this version of viser starts its web server in another way; origins are not checked")


def _admit(host: str, answer: Any, connection: ServerConnection, request: Request) -> Response | None:  # noqa: ANN401
    """Refuses requests that pages of another origin make through a visitor's browser.

    The host of the request must be a name of this machine, since a foreign name may point here (DNS rebinding), and the
    origin must be a page of that host. Programs other than browsers send no origin, and could send any. No page may
    show this one in a frame, where a visitor would click without knowing on what.
    """
    names, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
    known = all(_is_own(urlsplit(f"//{name}").hostname or "", host) for name in names)
    if len(names) != 1 or not known or any(origin.partition("://")[2] != names[0] for origin in origins):
        return connection.respond(http.HTTPStatus.FORBIDDEN, "mrctl: a foreign origin\n")
    response = answer(connection, request)
    if response is not None:
        response.headers["X-Frame-Options"] = "DENY"
    return response


def _is_own(name: str, host: str) -> bool:
    """Returns whether a name is this machine's, which listens on `host`; no address can be rebound, as a name can."""
    if name in (*LOCAL, host):
        return True
    if host not in ANYWHERE:
        return False
    with contextlib.suppress(ValueError):
        return bool(ipaddress.ip_address(name))
    return name in (socket.gethostname().lower(), socket.getfqdn().lower())
