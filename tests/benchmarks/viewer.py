"""Does the viewer keep real time while a browser watches? `python tests/benchmarks/viewer.py [SECONDS]`.

For one, two and sixteen robots: median of simulated over wall time, taken each second; the share of control ticks that
began more than a period after they were due; pictures and curves that the page was sent; what was sent to it in all,
once the curves are full; growth of memory; and what a change of the payload costs the session, and the page with it.

`python tests/benchmarks/viewer.py rough [SECONDS]` instead treats it roughly, without a browser: visitors that come and
go and set inputs at random, five times a second. Memory every minute, and its slope in the second half, less the
session's record.
"""

import contextlib
import random
import shutil
import statistics
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

from playwright.sync_api import sync_playwright
from viser._messages import GuiUpdateMessage
from websockets.asyncio.server import ServerConnection

from mrctl import Perturbation, Scenario
from mrctl.viewer.live import WINDOW, Live
from mrctl.viewer.server import Server

# Without a GPU the scene is drawn by SwiftShader; the curves, as in any browser without one, by Skia on the CPU.
SOFTWARE = [
    "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-accelerated-2d-canvas",
]  # fmt: skip


def resident() -> float:
    """Memory of this process in MiB."""
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) / 256


def recorded(live: Live) -> float:
    """What the session keeps in order to be saved and drawn, in MiB; it grows with simulated time, and goes with it."""
    return sum(simulation.log.ticks[: simulation.tick].nbytes for _, simulation in live.session.simulations) / 2**20


def event_cost(apply: Callable[..., None], payload: float) -> float:
    """Time in ms that a change of the payload to so many kg takes."""
    start = time.perf_counter()
    apply(perturbation=Perturbation(payload=payload))
    return 1e3 * (time.perf_counter() - start)


def measure(robots: int, seconds: int) -> None:
    """Prints what it finds."""
    server = Server(port=0)
    live = Live([Scenario(seed=k, name=str(k)) for k in range(robots)], server)
    sent = {"draw": 0, "refresh": 0, "bytes": 0}

    def counted(name: str) -> Callable[[], None]:
        genuine = getattr(live, name)

        def call() -> None:
            sent[name] += 1
            genuine()

        return call

    for name in ("draw", "refresh"):
        setattr(live, name, counted(name))
    while live.session.time < WINDOW:
        live.session.step()
    costs = [event_cost(live.session.apply, payload) for payload in (1.0, 2.0, 3.0, 4.0, 5.0)]
    whole = [event_cost(live._apply_event, payload) for payload in (5.5, 6.0, 7.0, 8.0, 9.0)]
    print(
        f"{robots:2d} robots: an event {statistics.median(costs):.1f} ms, with the page {statistics.median(whole):.1f}"
    )
    genuine = ServerConnection.send

    async def send(connection: ServerConnection, message: Any) -> None:  # noqa: ANN401
        sent["bytes"] += len(message)
        await genuine(connection, message)

    loop = threading.Thread(target=live.run)
    loop.start()
    try:
        with mock.patch.object(ServerConnection, "send", send), sync_playwright() as playwright:
            browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=SOFTWARE)
            page = browser.new_page(viewport={"width": 900, "height": 500})
            page.goto(f"http://127.0.0.1:{server.get_port()}")
            page.wait_for_function("window.__viserMutable?.nodePoseData['/world/robot/chassis']", timeout=120_000)
            page.evaluate(
                "window.arrived = 0; let last = null; setInterval(() => {"
                "  const [first] = Object.values(window.__viserTestpoints?.uplots ?? {});"
                "  if (first && first.chart.data !== last) { last = first.chart.data; window.arrived += 1; } }, 5)"
            )
            time.sleep(3)
            live.late = live.ticks = 0
            sent.update(draw=0, refresh=0, bytes=0)
            arrived, memory, factors = page.evaluate("window.arrived"), resident(), []
            for _ in range(seconds):
                tick, start = live.session.tick, time.monotonic()
                time.sleep(1)
                factors.append((live.session.tick - tick) * live.session.period / (time.monotonic() - start))
            drawn = page.evaluate("window.arrived") - arrived
            print(
                f"{robots:2d} robots: {statistics.median(factors):.3f}× real time (least {min(factors):.3f}), "
                f"{100 * live.late / max(1, live.ticks):.2f} % of ticks late, "
                f"{sent['draw'] / seconds:.1f} pictures/s, curves {sent['refresh'] / seconds:.1f}/s sent, "
                f"{drawn / seconds:.1f}/s in the page, {sent['bytes'] / seconds / 1e6:.2f} MB/s, "
                f"{resident() - memory:+.1f} MiB"
            )
            browser.close()
    finally:
        live.close()
        loop.join()
        server.stop()


def rough(seconds: int) -> None:
    """Prints memory while visitors do whatever comes to their minds."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "system"))
    from test_viewer_server import CAMERA, _random_value, client, packed

    rng, server = random.Random(1), Server(port=0)
    live = Live([Scenario()], server)
    inputs = list(server.gui._gui_input_handle_from_uuid.values())
    loop = threading.Thread(target=live.run)
    loop.start()
    start, samples, actions = time.monotonic(), [], 0
    try:
        while (now := time.monotonic() - start) < seconds:
            with client(server) as visitor:
                visitor.send(packed(CAMERA))
                for _ in range(25):
                    handle = rng.choice(inputs)
                    value = _random_value(handle, rng)
                    visitor.send(packed(GuiUpdateMessage(handle._impl.uuid, {"value": value})))
                    actions += 1
                    end = time.monotonic() + 0.2
                    with contextlib.suppress(TimeoutError):
                        while (left := end - time.monotonic()) > 0:
                            visitor.recv(timeout=left)
            samples.append((now, resident() - recorded(live)))
            if now // 60 > (samples[-2][0] // 60 if len(samples) > 1 else -1):
                print(
                    f"{now:4.0f} s: {resident():.0f} MiB, of which the record of the session {recorded(live):.0f}; "
                    f"{actions} actions, {len(live.session.start)} robots"
                )
        late = [(t, m) for t, m in samples if t > seconds / 2]
        slope = statistics.linear_regression(*zip(*late, strict=True)).slope
        print(f"{actions} actions, alive: {loop.is_alive()}, {60 * slope:+.2f} MiB/min in the second half")
    finally:
        live.close()
        loop.join()
        server.stop()


if __name__ == "__main__":
    mode, *rest = sys.argv[1:] if "rough" in sys.argv else ["watched", *sys.argv[1:]]
    if mode == "rough":
        rough(int(rest[0]) if rest else 600)
    else:
        for robots in (1, 2, 16):
            measure(robots, int(rest[0]) if rest else 60)
