"""Does the viewer keep real time while a browser watches? `python tests/benchmarks/viewer.py [SECONDS]`.

For one and for sixteen robots: median of simulated over wall time, taken each second; the share of control ticks that
began more than a period after they were due; pictures and curves that the page was sent; growth of memory.
"""

import shutil
import statistics
import sys
import threading
import time
from collections.abc import Callable

from playwright.sync_api import sync_playwright

from mrctl import Scenario
from mrctl.viewer.live import Live
from mrctl.viewer.server import Server

SOFTWARE = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


def resident() -> float:
    """Memory of this process in MiB."""
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) / 256


def measure(robots: int, seconds: int) -> None:
    """Prints what it finds."""
    server = Server(port=0)
    live = Live([Scenario(seed=k, name=str(k)) for k in range(robots)], server)
    sent = {"draw": 0, "refresh": 0}

    def counted(name: str) -> Callable[[], None]:
        genuine = getattr(live, name)

        def call() -> None:
            sent[name] += 1
            genuine()

        return call

    for name in sent:
        setattr(live, name, counted(name))
    loop = threading.Thread(target=live.run)
    loop.start()
    try:
        with sync_playwright() as playwright:
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
            sent.update(draw=0, refresh=0)
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
                f"{drawn / seconds:.1f}/s in the page, {resident() - memory:+.1f} MiB"
            )
            browser.close()
    finally:
        live.close()
        loop.join()
        server.stop()


if __name__ == "__main__":
    for robots in (1, 16):
        measure(robots, int(sys.argv[1]) if len(sys.argv) > 1 else 60)
