"""Makes `images/viewer.png`, the picture of the README: what `mrctl view` opens, after some of its events.

    python notebooks/viewer_picture.py

It needs Chromium, which draws without a GPU, and half a minute.
"""

import io
import shutil
import threading
from pathlib import Path

from PIL import Image
from playwright.sync_api import sync_playwright

from mrctl.cli.shared import BEST
from mrctl.scenario import FEEDFORWARDS, Scenario
from mrctl.viewer.live import Live
from mrctl.viewer.server import Server

FILE = Path(__file__).parent / "images" / "viewer.png"
WIDTH, HEIGHT = 1120, 800  # px of the page, which a README shows 900 px wide
PIXELS = 1.5  # of the picture for one of the page
COLOURS = 255
# Seconds, groups and names of the buttons that are pressed; the end.
PRESSED = (25.5, "Payload", "drop payload"), (28.4, "Supply", "sag supply"), (32.0, "Push", "push")
END = 36.6
SOFTWARE = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-gpu-compositing"]


def drive(live: Live, time: float) -> None:
    """Lets a session that pauses drive on to a time in s."""
    while live.session.time < time - live.session.period / 2:
        live.session.step()


def main() -> None:
    """Writes the picture."""
    server = Server(port=0)
    best = Scenario(**FEEDFORWARDS[BEST])
    live = Live([best, best.with_feedforward("none")], server)
    live.playing = False
    for time, group, name in PRESSED:
        drive(live, time)
        live._press(group, name)
    drive(live, END)
    loop = threading.Thread(target=live.run)
    loop.start()
    try:
        with sync_playwright() as playwright:
            browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=SOFTWARE)
            page = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT}, device_scale_factor=PIXELS)
            page.goto(f"http://127.0.0.1:{server.get_port()}")
            page.locator(".mantine-Notification-closeButton").click(timeout=60_000)  # that rendering is in software
            page.get_by_label("Soft light").click()  # which the page of a browser with a GPU switches on by itself
            page.mouse.move(0, 0)  # away from hints
            page.wait_for_timeout(10_000)
            picture = Image.open(io.BytesIO(page.screenshot(timeout=60_000))).convert("RGB")
            browser.close()
    finally:
        live.close()
        loop.join()
        server.stop()
    picture.quantize(COLOURS, dither=Image.Dither.NONE).save(FILE, optimize=True)
    print(f"{FILE.name}: {picture.width} × {picture.height} pixels, {FILE.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
