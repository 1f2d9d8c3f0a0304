"""The viewer in a real headless browser: what a visitor sees and does. Screenshots are in pytest's folders."""

import io
import json
import re
import shutil
import threading
import time
from contextlib import contextmanager

import numpy as np
import pytest
from PIL import Image

from mrctl import Circle, Event, Perturbation, Scenario, Sweep, save
from mrctl.cli import main
from mrctl.control.features import FEATURE_NAMES
from mrctl.loop.runs import simulate
from mrctl.results.excitation import alone
from mrctl.results.metrics import per_lap
from mrctl.sensing.tiers import Sensing
from mrctl.sweep import jobs
from mrctl.viewer.live import Live
from mrctl.viewer.looks import looks
from mrctl.viewer.plots import CURSOR_COLOUR
from mrctl.viewer.recording import Library, looks_of
from mrctl.viewer.replay import ReplayPage
from mrctl.viewer.requests import buttons
from mrctl.viewer.scatter import DROVE_COLOUR, RING_SIZE
from mrctl.viewer.server import Server

CHROMIUM = shutil.which("chromium")
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="needs chromium")
# Chromium would also put the page together with the software that draws the scene, which takes 0.3 s a picture.
SOFTWARE = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-gpu-compositing"]
BASE = Scenario(reference=Circle(radius=0.8, period=6.0), laps=2)
PATIENCE = 60_000  # ms, on a machine that does other things too
ROBOT, GHOST = "/world/robot/chassis", "/world/ghosts/1/chassis"


@pytest.fixture(scope="module")
def browser():
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=SOFTWARE)
        yield browser
        browser.close()


DRAG_ERROR = "Unable to preventDefault inside passive event listener invocation."  # of viser's page, with any drag


# Chromium draws in software, and would keep both cores busy. For tests that click on nothing in the scene and drag
# nothing there but the camera.
SLOWLY = """{
    const draw = window.requestAnimationFrame.bind(window), waiting = new Set();
    let number = 0;
    window.requestAnimationFrame = (callback) => {
        waiting.add(++number);
        const mine = number, once = (time) => waiting.delete(mine) && callback(time);
        setTimeout(() => draw(once), 200);
        return mine;
    };
    window.cancelAnimationFrame = (given) => waiting.delete(given);
}"""


@contextmanager
def visit(browser, url, offline=False, known=(), slowly=False):
    """A page, drawn slowly and coarsely or as often as it can be.

    No error on its console is tolerated, but those that are known.
    """
    context = browser.new_context(viewport={"width": 1280, "height": 800}, offline=offline)
    if slowly:
        context.add_init_script(SLOWLY)
    page = context.new_page()
    errors = []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
    page.goto(f"{url}/?fixedDpr=0.5" if slowly else url)  # a pixel of the scene for four of the page
    yield page
    assert [text for text in errors if text not in known] == []
    context.close()


@contextmanager
def serving(build):
    """A page that is served, with its loop in a thread."""
    server = Server(port=0)
    try:
        served = build(server)
        thread = threading.Thread(target=served.run)
        thread.start()
        try:
            yield served, f"http://127.0.0.1:{server.get_port()}"
        finally:
            served.close()
            thread.join()
    finally:
        server.stop()


def node(page, name, frame="window"):
    """Position of a node of the scene, as the browser has it."""
    found = page.evaluate(f"{frame}.__viserMutable?.nodePoseData[{name!r}]?.position ?? null")
    return None if found is None else np.array(found)


def until(condition, what):
    """Waits for something to become true, and returns it."""
    end = time.monotonic() + PATIENCE / 1000
    while time.monotonic() < end:
        if not any((found := condition()) is no for no in (None, False, np.False_)):
            return found
        time.sleep(0.1)
    raise AssertionError(f"not within {PATIENCE / 1000:g} s: {what}")


def picture(page, path):
    """The scene between the panels as pixels."""
    page.screenshot(path=path, timeout=PATIENCE)
    return np.asarray(Image.open(io.BytesIO(path.read_bytes())).convert("RGB"), float)[:, 450:900]


def pixel(page, path, at):
    """The colour of the page at a place in pixels, x and y."""
    page.screenshot(path=path, timeout=PATIENCE)
    return Image.open(path).convert("RGB").getpixel((round(at[0]), round(at[1])))


def moved(before, after):
    """How many pixels differ clearly."""
    return int((np.abs(before - after).max(axis=-1) > 60).sum())


DRAWN = """(names) => new Promise((done) => {
    const m = window.__viserMutable, seen = [], at = (name) => {
        const node = m.nodeRefFromName[name], place = node.position.clone();
        return m.nodeRefFromName['/world'].worldToLocal(node.getWorldPosition(place)).toArray();
    };
    setTimeout(() => done(seen), 30000);
    m.nodeRefFromName[names[0]].traverse((part) => {
        part.onBeforeRender = () => {
            const now = names.map(at);
            if (`${now}` !== `${seen.at(-1)}` && seen.push(now) === 10) done(seen);
        };
    });
})"""
AXES = """() => Object.fromEntries(Object.values(window.__viserTestpoints.uplots).map(({chart}) => {
    const line = getComputedStyle(chart.over, '::after');
    const { x, y } = chart.scales;
    const title = chart.root.querySelector('.u-title').textContent;
    const cursor = line.content === 'none' ? null : chart.posToVal(parseFloat(line.left), 'x');
    return [title, { times: chart.axes[0]._values, x: [x.min, x.max], y: [y.min, y.max], cursor }];
}))"""
UP = """() => {
    const m = window.__viserMutable, fixed = Object.entries(m.nodeRefFromName);
    const floor = fixed.find(([name, node]) => node && /^.world.fixed.[0-9]+.[0-9]+$/.test(name));
    return floor ? m.camera.position.clone().set(0, 0, 1).applyQuaternion(floor[1].quaternion).toArray() : null;
}"""
UPS = """() => {
    const m = window.__viserMutable, fixed = Object.entries(m.nodeRefFromName);
    const found = fixed.filter(([name, node]) => node && /^.world.fixed.[0-9]+.[0-9]+$/.test(name));
    return found.map(([, node]) => m.camera.position.clone().set(0, 0, 1).applyQuaternion(node.quaternion).z);
}"""
NUMBERS = """() => Object.values(window.__viserTestpoints.uplots).map(({chart}) => {
    const axis = chart.axes[1], pen = document.createElement('canvas').getContext('2d');
    pen.font = axis.font[0];
    const width = Math.max(...axis._values.map((text) => pen.measureText(text).width)) / window.devicePixelRatio;
    return { numbers: axis._values, width: width + axis.ticks.size + axis.gap, room: axis._size };
})"""
CAMERA = """() => {  // nothing while a world is being built
    const m = window.__viserMutable;
    return m.nodeRefFromName['/world']?.worldToLocal(m.camera.position.clone()).toArray();
}"""


TAKES_DRAGS = """(names) => names.every((name) => {
    const node = window.__viserMutable.nodeRefFromName[name];
    return node?.children.length && node.parent.__r3f.handlers.onPointerDown;
})"""
PICTURES = "() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => done(true))))"
SCENE_WIDTH = "window.__viserMutable.canvas.getBoundingClientRect().width"


CURVES = """(title) => {
    const charts = Object.values(window.__viserTestpoints?.uplots ?? {}).map(({chart}) => chart);
    const named = charts.filter((chart) => chart.root.querySelector('.u-title').textContent === title);
    return JSON.stringify(named.map((chart) => chart.data.map((values) => Array.from(values))));
}"""


def curves(page, title):
    """Data of a chart, as the browser draws it; Playwright alone would take long to return so many numbers."""
    return [[np.array(values, float) for values in data] for data in json.loads(page.evaluate(CURVES, title))]


def rest(page, live):
    """Waits until a page shows its robots where a session that pauses has them."""

    def there():
        shown = [node(page, name) for name in (ROBOT, GHOST)[: live.session.size]]
        return np.allclose(shown, [live.session.qpos(k)[:3] for k in range(len(shown))], atol=1e-5)

    until(there, "the robots where they are")
    page.evaluate(PICTURES)


def test_live(browser, tmp_path):
    """Two robots drive along the reference, pause holds them, a payload is dropped, seen, listed, and felt."""
    quiet = BASE.model_copy(update={"sensing": Sensing(tier="ideal")})  # errors of noise would hide that of a payload
    scenarios = [quiet, quiet.model_copy(update={"prior": "none", "learner": "none"})]
    with serving(lambda server: Live(scenarios, server)) as (live, url), visit(browser, url, slowly=True) as page:
        until(lambda: node(page, ROBOT) is not None, "the scene")
        start = node(page, ROBOT)
        until(lambda: np.linalg.norm(node(page, ROBOT) - start) > 0.3, "the robot to move")
        until(lambda: live.session.time > 3.0, "the offset at the start to be gone")
        drawn = np.array(page.evaluate(DRAWN, [ROBOT, GHOST]))
        page.get_by_text("pause", exact=True).click()
        until(lambda: "paused" in page.inner_text("#mrctl-status"), "the pause")
        page.mouse.move(640, 700)
        rest(page, live)
        held, tick = node(page, ROBOT), live.session.tick
        assert abs(np.hypot(*(held[:2] - [0, 0.8])) - 0.8) < 0.06  # on the circle that the reference is
        still = picture(page, tmp_path / "live_two_robots.png")
        orange = (still[..., 0] > 150) & (still[..., 0] > still[..., 2] + 70)
        assert orange.sum() > 100  # the ghost
        time.sleep(0.5)
        assert live.session.tick == tick and (node(page, ROBOT) == held).all()
        names = page.evaluate("Object.keys(window.__viserSceneTree.getState())")
        assert {ROBOT, GHOST, "/world/reference", "/world/trail"} <= set(names)
        place = np.stack([live.session.log()[name] for name in ("x", "y", "z")], axis=-1)  # (T, B, 3)
        apart = np.linalg.norm(place[None] - drawn[:, None], axis=-1)  # (10, T, B)
        assert len(drawn) == 10 and apart.max(axis=2).min(axis=1).max() < 1e-3  # of one tick

        now, factor = live.session.log()[-1, 1], live._deviation
        highest = [places(page, f"/world/trail/{k}")[:, 2].max() for k in (0, 1)]
        assert places(page, "/world/reference")[:, 2].min() > max(highest)  # it is never hidden
        titles = list(page.evaluate(AXES))
        assert titles[0] == "position error, mm" and "Σ, mean of left and right, V; feedforward dashed" in titles
        target = node(page, "/world/target/1")
        assert target[:2] == pytest.approx([now["x_ref"], now["y_ref"]], abs=1e-6) and target[2] > 0.3
        off = np.hypot(now["longitudinal_error"], now["lateral_error"])
        assert node(page, "/world/target/1/ball")[0] == pytest.approx(factor * off, rel=1e-4) and factor == 100
        assert live._scene._factor.visible
        assert live._scene._factor.text == "robots: where they are\ntrails and balls: deviation × 100"

        seen = lambda: page.evaluate(WORLD_TO_SCREEN, [0, 0.8, 0])  # noqa: E731 (the middle of the circle)
        page.get_by_text("drop payload").click()
        until(lambda: "payload 0 → 10" in page.inner_text("#mrctl-timeline"), "the payload in the timeline")
        live.ask(live.choose_speed, "5×")
        page.keyboard.press("Space")
        until(lambda: live.session.tick > tick + 250, "the robots to drive on")
        page.get_by_text("pause", exact=True).click()
        until(lambda: "paused" in page.inner_text("#mrctl-status"), "the second pause")
        rest(page, live)
        assert moved(still, picture(page, tmp_path / "live_payload.png")) > 300
        error = lambda: curves(page, "position error, mm")[0]  # noqa: E731
        t, _, without, marks = until(lambda: (e := error())[0][-1] > live.session.time - 0.1 and e, "the curves")
        dropped = live.session.saved()[1].events[0].time
        assert t[1:][np.diff(marks) != 0] == pytest.approx([dropped], abs=0.051)  # a sample of the curves, in float32
        post = places(page, "/world/events")[:, :2].mean(axis=0)
        now = live.session.driven()[round(dropped / live.session.period)]
        assert post == pytest.approx([now["x_ref"], now["y_ref"]], abs=0.01)  # within a tick
        page.locator(".u-over").first.hover()
        values = page.locator(".u-legend").first.inner_text()
        assert "PID alone position error" in values and re.search(r"\d\.\d", values), values
        before = without[(t > dropped - 0.3) & (t < dropped)]  # steady to 0.1 µm
        assert without[t > dropped].max() - before.max() > 0.015 > 100 * np.ptp(before)
        assert t[-1] == pytest.approx(live.session.time, abs=0.1)

        assert page.evaluate(SCENE_WIDTH) >= 640  # of 1280
        hidden = page.locator("#mrctl-score").evaluate(
            "(e) => e.parentElement.scrollWidth - e.parentElement.clientWidth"
        )
        assert hidden <= 0 and "energy of last lap, J" in page.inner_text("#mrctl-score")

        tick = live.session.tick
        page.get_by_text("step", exact=True).click()
        until(lambda: live.session.tick == tick + 1, "a single step")
        page.keyboard.press("n")  # the arrows move the camera
        until(lambda: live.session.tick == tick + 2, "a step by the key N")
        page.keyboard.press("f")
        middle = live._scene._middle[:2]
        assert middle == pytest.approx([0, 0.8], abs=0.01)  # of the circle, and of the overview
        away = lambda: np.allclose(node(page, "/world")[:2], middle - node(page, ROBOT)[:2], atol=1e-3)  # noqa: E731
        until(lambda: live._follow.value and away(), "the camera to follow by the key F")
        page.keyboard.press("f")
        until(lambda: np.allclose(node(page, "/world"), 0), "the camera to let go")
        page.get_by_label("Camera follows").click()  # the robot stays, and the world moves
        until(away, "the world to move")
        page.keyboard.press("f")  # a checkbox that was clicked on does not keep the key
        until(lambda: np.allclose(node(page, "/world"), 0), "the world to be back")
        assert live.session.tick == tick + 2
        aspect = page.evaluate("window.__viserMutable.camera.aspect")
        first, above = (live._scene.camera(top, aspect)[0] for top in (False, True))
        assert page.evaluate(CAMERA) == pytest.approx(first, abs=1e-6)
        for name, place in (("top", above), ("overview", first)):
            page.get_by_text(name, exact=True).click()
            until(lambda place=place: np.allclose(page.evaluate(CAMERA), place, atol=1e-6), f"the camera {name!r}")
        assert all(page.evaluate(VISIBLE, f"{robot}/payload") for robot in (ROBOT, GHOST))

        with page.expect_download(timeout=PATIENCE) as download:
            page.get_by_text("Download as one HTML file").click()
        text = download.value.path().read_text()
        assert f'"marks": [{dropped:.5g}' in text and text.count("<canvas") == 0 and len(text) > 1e6
        live.deviation.value = "1×"
        live.ask(live.choose_speed, "as fast as it goes")
        live.ask(live._command, "play")
        until(lambda: live.session.time > 9.0, "some seconds within a few pictures")
        live.ask(live._command, "pause")
        until(lambda: "paused" in page.inner_text("#mrctl-status"), "the third pause")
        until(lambda: curves(page, "V, m/s")[0][0][-1] > live.session.time - 0.1, "the last curves")
        flat = page.evaluate(AXES)["saturated; guard dashed"]
        assert flat["y"] == pytest.approx([0, 1], abs=0.2) and flat["cursor"] is None
        trail = lambda: places(page, "/world/trail/0").reshape(-1, 2, 3).mean(axis=1)  # noqa: E731 (middle of the ribbon)
        until(lambda: np.abs(np.hypot(*(trail()[:, :2] - [0, 0.8]).T) - 0.8).max() < 0.1, "the trail on the circle")
        assert np.linalg.norm(np.diff(trail(), axis=0), axis=-1).max() < 0.12  # m, in 1/8 s

        page.set_viewport_size({"width": 390, "height": 844})
        button = page.get_by_role("button", name="reset", exact=True)
        until(lambda: (box := button.bounding_box()) and box["height"] >= 44, "a button for a finger")
        score, drive = page.locator("#mrctl-score"), page.get_by_role("tab", name="Drive")

        def in_panel():
            upper, lower = score.bounding_box(), drive.bounding_box()  # None while the page is laid out anew
            return upper and lower and 844 / 2 < upper["y"] < lower["y"] < 800

        until(in_panel, "the score in the panel")
        assert page.get_by_label("panel Curves").bounding_box()["height"] >= 44
        boxes = [box.bounding_box() for box in page.locator("input[type=checkbox]").all() if box.is_visible()]
        assert len(boxes) > 2 and all(min(box["width"], box["height"]) >= 44 for box in boxes)
        until(lambda: np.allclose(seen(), [390 / 2, 844 / 4], atol=30), "the circle above the panel")
        page.screenshot(path=tmp_path / "phone.png", timeout=PATIENCE)
        page.set_viewport_size({"width": 1280, "height": 800})
        page.keyboard.press("r")
        until(lambda: live.session.tick == 0, "a reset by the key R")
        emptied = lambda drawn, marks: np.isnan(drawn).all() and (marks < 0).all()  # noqa: E731
        until(lambda: emptied((now := curves(page, "V, m/s")[0])[1:-1], now[-1]), "the old curves to go")
        until(
            lambda: (
                "/world/trail" not in page.evaluate("Object.keys(window.__viserSceneTree.getState())")
                or not len(places(page, "/world/trail/0"))
            ),
            "the old trails to go",
        )


def test_inputs(browser, tmp_path):
    """A slider becomes an event, a choice another run, a ghost is added; a mistake in a tick is shown, and mended."""
    with serving(lambda server: Live([BASE], server)) as (live, url), visit(browser, url, slowly=True) as page:
        until(lambda: node(page, ROBOT) is not None, "the scene")
        page.get_by_role("tab", name="Robot").click()
        slider = page.get_by_role("slider").first
        thumb = slider.bounding_box()
        page.mouse.move(thumb["x"] + 4, thumb["y"] + 4)
        page.mouse.down()
        for k in range(1, 9):
            page.mouse.move(thumb["x"] + 4 + 4 * k, thumb["y"] + 4)
            time.sleep(0.05)
        page.mouse.up()
        mass_factor = lambda: live.session.state()["perturbation"].mass_factor  # noqa: E731
        shown = lambda: float(slider.get_attribute("aria-valuenow"))  # noqa: E731
        until(lambda: mass_factor() > 1.05 and mass_factor() == pytest.approx(shown()), "the slider's last value")
        typed = slider.locator("xpath=ancestor::*[.//input[@inputmode]][1]").locator("input[inputmode]")
        assert float(slider.get_attribute("aria-valuemax")) == 3
        typed.fill("4.5")
        until(lambda: mass_factor() == 4.5, "a number beyond the end of the slider")
        typed.press("Tab")
        page.wait_for_timeout(1000)
        assert mass_factor() == shown() == 4.5
        typed.fill("1.5")
        until(lambda: mass_factor() == 1.5 and slider.get_attribute("aria-valuemax") == "3", "the end to be back")
        factor, events = mass_factor(), live.session.saved()[0].events  # one event, unless the page takes its time
        live.ask(live._note_input, ("reference",), "stop_and_go")  # it reverses
        until(lambda: "reverses" in page.inner_text("#mrctl-message"), "the refusal, on whatever tab")
        page.get_by_role("tab", name="Controllers").click()
        assert "begins another run" in page.inner_text("#mrctl-anew")
        picture(page, tmp_path / "controllers.png")
        session = live.session
        page.get_by_label("PID + network (paper)", exact=True).first.click()
        until(lambda: "drives already" in page.inner_text("#mrctl-message"), "the refusal of a second one")
        until(lambda: not page.get_by_label("PID + network (paper)", exact=True).first.is_checked(), "the tick to go")
        assert live.session is session and session.saved()[0].events == events
        page.get_by_label("PID + RLS", exact=True).first.click()
        until(lambda: [s.feedforward for s in live.session.start] == ["fel", "rls"], "the ghost")
        assert live.session.start[1].perturbation.mass_factor == factor  # goes on as things were
        until(lambda: node(page, GHOST) is not None, "the ghost in the scene")

        live.ask(live._note_input, ("world",), "slope")
        until(lambda: (up := page.evaluate(UP)) and up[2] < 0.99, "the floor to tilt")
        live.ask(live._note_input, ("world",), "patch")
        level = lambda: (ups := page.evaluate(UPS)) and len(ups) > 1 and np.allclose(ups, 1)  # noqa: E731
        until(level, "floor and ice to be level, in a page that has shown a slope")
        live.ask(live._note_input, ("world",), "slope")
        until(lambda: (up := page.evaluate(UP)) and up[2] < 0.99, "the floor to tilt again")
        live.ask(live._note_input, ("world",), "flat")
        until(lambda: (up := page.evaluate(UP)) and np.allclose(up, [0, 0, 1]), "the floor to be level again")
        camera = until(lambda: page.evaluate(CAMERA), "the camera")
        live.ask(live._note_input, ("reference", "radius"), 1.4)
        until(lambda: page.evaluate(CAMERA)[2] > 1.3 * camera[2], "a view of the larger reference")

        def lowered():
            page.mouse.move(640, 400)
            page.mouse.down()
            page.mouse.move(640, 60, steps=4)  # takes it down by 36°
            page.mouse.up()
            return page.evaluate(CAMERA)[2] < 0.1

        until(lowered, "the camera to come down")
        until(lambda: 0.03 < page.evaluate(CAMERA)[2] < 0.1, "the camera to stop above the floor")
        live.ask(live._compare, "rls", False)  # while the page is busy: it gets all of this at once
        live.ask(live._note_input, ("reference",), "rounded_square")
        page.evaluate("() => { const end = performance.now() + 2000; while (performance.now() < end); }")
        until(lambda: live.session.start[0].reference.kind == "rounded_square", "another reference")

        genuine, live.session.step = live.session.step, lambda: 1 / 0
        page.get_by_role("tab", name="Drive").click()
        until(lambda: "ZeroDivisionError" in page.inner_text("#mrctl-message"), "the error in the page")
        picture(page, tmp_path / "error.png")
        page.get_by_text("reset", exact=True).click()
        page.get_by_text("play", exact=True).click()
        until(lambda: live.session.tick > 20 and live.message == "", "the session to go on")
        del genuine


def test_many_robots(browser, tmp_path):
    """Beyond four robots the legend says what is left out; labels of robots together are one; numbers fit."""
    robots = [BASE.replace(seed=k, name=f"seed {k}") for k in range(6)]
    with serving(lambda server: Live(robots, server)) as (live, url), visit(browser, url, slowly=True) as page:
        until(lambda: live.session.time > 1 and curves(page, "V, m/s"), "the curves")
        live.ask(live._command, "pause")
        until(lambda: "paused" in page.inner_text("#mrctl-status"), "the pause")
        text = page.inner_text("body")
        assert -1 < text.find("Curves are of the first 4 of 6 robots.") < text.find("■ seed 0")  # not cut off
        assert all(f"seed {k}" in page.inner_text("#mrctl-score") for k in range(6))
        assert len(curves(page, "position error, mm")[0]) == 1 + 4 + 1  # the time, the robots and the marks of events
        assert [label.text for label in live._scene.robots._labels if label.visible] == ["seed 0\nseed 1\nand 4 more"]
        time = np.linspace(0, 2, 50)
        values = [np.linspace(0, 1.9 * 10.0**k, 50) for k in range(4)]  # mm, up to 1,900
        live.ask(setattr, live._plots._handles[0], "data", (time, *values, np.full(50, -1.0)))
        until(lambda: "1,000" in page.evaluate(NUMBERS)[0]["numbers"], "large numbers")
        page.screenshot(path=tmp_path / "many.png", timeout=PATIENCE)
        for axis in page.evaluate(NUMBERS):
            assert axis["width"] <= axis["room"], axis


WORLD_TO_SCREEN = """([x, y, z = 0]) => {
    const m = window.__viserMutable, point = new m.camera.position.constructor(x, y, z);
    m.nodeRefFromName['/world'].localToWorld(point).project(m.camera);
    const r = m.canvas.getBoundingClientRect();
    return [r.left + (point.x + 1) / 2 * r.width, r.top + (1 - point.y) / 2 * r.height];
}"""


def click_on_curve(page, title, share):
    """Clicks into a chart; returns the time in s that is there."""
    index = list(axes := page.evaluate(AXES)).index(title)
    box = page.locator(".u-over").nth(index).bounding_box()
    page.mouse.click(box["x"] + share * box["width"], box["y"] + box["height"] / 2)
    start, end = axes[title]["x"]
    return start + share * (end - start)


def test_looking_back(browser, tmp_path):
    """A click on a curve, or on a trail, shows the robots as they were then; from there they drive on."""
    with serving(lambda server: Live([BASE], server)) as (live, url), visit(browser, url) as page:
        live.ask(live.choose_speed, "as fast as it goes")
        until(lambda: live.session.time > 15 and curves(page, "V, m/s"), "15 s")
        live.ask(live._command, "pause")
        until(lambda: "paused" in page.inner_text("#mrctl-status"), "the pause")
        page.locator(".mantine-Notification-closeButton").click()  # that rendering is in software
        end = live.session.tick
        until(lambda: curves(page, "V, m/s")[0][0][-1] > live.session.time - 0.1, "the last curves")
        there = click_on_curve(page, "position error, mm", 0.4)
        until(lambda: live._back is not None, "a former moment")
        assert 0.01 * live._back == pytest.approx(there, abs=0.1)  # two pixels
        then = live.session.log()[live._back, 0]
        until(lambda: np.allclose(node(page, ROBOT)[:2], [then["x"], then["y"]], atol=1e-3), "the robot of then")
        until(lambda: page.evaluate(AXES)["V, m/s"]["cursor"] == pytest.approx(0.01 * live._back, abs=0.02), "a cursor")
        picture(page, tmp_path / "back.png")
        ticks, drawn = live._hands.trail
        places = np.array([page.evaluate(WORLD_TO_SCREEN, place.tolist()) for place in drawn[:, 0]])
        clear = (abs(places - [640, 400]) < [240, 300]).all(axis=1)  # not below a panel
        there = np.flatnonzero(clear & (ticks > ticks[-1] - 500))[-1]  # of the last lap of two
        page.mouse.click(*places[there])
        until(lambda: abs(live._back - ticks[there]) < 20, "the moment of that place of the trail")
        back = live._back
        page.get_by_text("step", exact=True).click()
        until(lambda: live.session.tick == back + 1 < end and live._back is None, "it to go on from there")


def test_dragging(browser, tmp_path):
    """A drag pushes the robot, or sets a goal; clicks draw a way, whose points can be dragged; the camera stays."""
    robots = [BASE, BASE.replace(learner="none")]
    with serving(lambda server: Live(robots, server)) as (live, url), visit(browser, url, known=[DRAG_ERROR]) as page:
        until(lambda: live.session.time > 1 and node(page, ROBOT) is not None, "the scene")
        live.ask(live._command, "pause")
        page.locator(".mantine-Notification-closeButton").click()  # that rendering is in software
        page.get_by_label("Push by dragging").click()
        until(lambda: not live.playing and live._hands._pushes.value, "the pause")
        rest(page, live)
        first = live._scene.camera(False, page.evaluate("window.__viserMutable.camera.aspect"))[0]
        until(lambda: np.allclose(page.evaluate(CAMERA), first, atol=1e-6), "the camera at its place")

        def held(*names):
            until(lambda: page.evaluate(TAKES_DRAGS, names), "the page to take drags")
            page.evaluate(PICTURES)

        held(*(part.name for part in live._scene.robots.held if "/mesh/" in part.name))
        camera, here = page.evaluate(CAMERA), live.session.qpos(0)[:2].copy()

        def drag(start, *places):
            page.mouse.move(*page.evaluate(WORLD_TO_SCREEN, list(start)))
            page.mouse.down()
            for place in places:
                page.mouse.move(*page.evaluate(WORLD_TO_SCREEN, list(place)))

        theta = live.session.log()["theta"][-1, 0]
        turn = np.array([[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]])

        def at(*place):  # in the robot's frame, in which the circle is to the left, to a place in the world
            return here + turn @ place

        drag((*at(0.15, 0.0), 0.1), here + [0.1, -0.2], here + [0.3, -0.5])
        until(lambda: page.evaluate(VISIBLE, "/world/force/0") and live._hands.pull, "an arrow")
        picture(page, tmp_path / "push.png")
        page.mouse.up()
        (event,) = until(lambda: live.session.saved()[1].events or None, "the push")  # the first robot has it before
        press = buttons(live.session.robot)["Push"]["push"]["push"][1]  # for a drag of a robot's length
        assert np.array(event.push[:2]) / press * live._scene.length == pytest.approx([0.3, -0.5], abs=0.03)
        assert [s.events for s in live.session.saved()] == [(event,)] * 2

        page.get_by_text("Set a goal", exact=True).click()
        until(lambda: "Drag on the floor" in page.inner_text("#mrctl-picking"), "the wait for a goal")
        held("/world/grip")
        drag(at(0.3, 1.2), at(0.3, 1.4), at(0.3, 1.6))
        page.mouse.up()
        until(lambda: len(live.session.saved()[0].events) == 2 and live._ends is not None, "the goal")
        *place, heading = live._ends[1]
        assert place == pytest.approx(at(0.3, 1.2), abs=0.1)
        assert abs(np.angle(np.exp(1j * (heading - theta)) / 1j)) < 0.1  # a way may turn once more
        assert not live._hands._waits

        page.get_by_label("Contact forces").click()
        page.get_by_text("Draw a way", exact=True).click()
        until(lambda: "add a point" in page.inner_text("#mrctl-picking"), "the wait for points")
        held("/world/grip")
        for k, place in enumerate([at(0.8, 0.6), at(0.3, 1.2)]):
            page.mouse.click(*page.evaluate(WORLD_TO_SCREEN, place.tolist()))
            until(lambda k=k: len(live._hands._points) == k + 1, "a point")
        drag(at(0.3, 1.2), at(0.25, 1.25), at(0.2, 1.3))
        until(lambda: live._hands._points[1].tolist() == pytest.approx(at(0.2, 1.3), abs=0.03), "the point elsewhere")
        page.mouse.up()
        until(lambda: page.evaluate(VISIBLE, "/world/way/line"), "the way")
        assert page.evaluate(VISIBLE, f"{ROBOT}/force")  # the wheels stand on the floor
        picture(page, tmp_path / "way.png")
        page.get_by_role("button", name="drive it").click()
        until(lambda: len(live.session.saved()[0].events) == 3 and live.playing, "the way as an event")
        points = live.session.saved()[0].events[2].reference.points
        assert np.array(points[2:]) == pytest.approx(np.array([at(0.8, 0.6), at(0.2, 1.3)]), abs=0.03)
        assert page.evaluate(CAMERA) == pytest.approx(camera, abs=1e-6)


def test_visitors_come_and_go(browser):
    """A second page, a reload and a page that is closed leave the session alone; a late visitor sees it as it is.

    Each has a camera of its own.
    """
    with serving(lambda server: Live([BASE], server)) as (live, url):
        with visit(browser, url, slowly=True) as page:
            until(lambda: node(page, ROBOT) is not None, "the scene")
            with visit(browser, url, slowly=True) as other:
                until(lambda: node(other, ROBOT) is not None, "the other page")
                camera = page.evaluate(CAMERA)
                other.get_by_role("button", name="chase", exact=True).click()
                until(lambda: len(live._chasing) == 1, "the chase")

                def behind():
                    (x, y, z), length = np.array(other.evaluate(CAMERA)) - node(other, ROBOT), live._scene.length
                    theta = live.session.log()[-1, 0]["theta"]
                    along = x * np.cos(theta) + y * np.sin(theta)
                    return abs(along / length + 2.5) < 0.8 and abs(z / length - 1.2) < 0.1

                until(behind, "the camera behind the robot")
                assert page.evaluate(CAMERA) == camera
                page.reload()
            until(lambda: node(page, ROBOT) is not None, "the page again")
        tick = live.session.tick
        until(lambda: live.session.tick > tick + 50, "the session to go on without anybody")
        assert live.playing and live.message == ""


def test_replay(browser, tmp_path):
    """A saved result: the scrubber puts the robots where they were, and the curves have its cursor."""
    high = Event(time=4.0, perturbation=Perturbation(payload=8, payload_z=0.9))
    tips = high, Event(time=8.0, push=(0.0, 350.0, 0.0), push_duration=0.3)
    result = simulate([BASE.replace(events=(high,)), BASE.replace(learner="none", events=tips)])
    assert result.failure.values.tolist() == ["", "tilt over 30°"]
    save(result, tmp_path / "result.zarr")
    library = Library(tmp_path / "result.zarr")
    with (
        serving(lambda server: ReplayPage(library, [0, 1], server)) as (replay, url),
        visit(browser, url, slowly=True) as page,
    ):
        until(lambda: node(page, ROBOT) is not None, "the scene")

        def on_the_way():
            if not replay.playing:  # it was over before a slow browser showed it
                page.get_by_text("play", exact=True).click()
            return node(page, ROBOT)[0] > 0.3

        until(on_the_way, "it to play")
        page.get_by_text("pause", exact=True).click()
        until(lambda: not replay.playing, "it to pause")
        field = page.locator("input[inputmode=decimal]").first

        def scrubbed():
            field.fill("7.5")  # again, if a time that was still on its way to a slow page has overwritten it
            field.press("Enter")
            page.wait_for_timeout(500)
            return replay.time == pytest.approx(7.5)

        until(scrubbed, "the scrubber")
        expected = result.isel(run=0).sel(time=7.5, method="nearest")
        until(lambda: np.allclose(node(page, ROBOT)[:2], [expected.x, expected.y], atol=1e-3), "the robot to be there")
        cursors = lambda: [axes["cursor"] or np.nan for axes in page.evaluate(AXES).values()]  # noqa: E731
        until(lambda: np.allclose(now := cursors(), 7.5, atol=0.05) and now, "a cursor in each chart")
        picture(page, tmp_path / "replay.png")
        t, *drawn = until(lambda: curves(page, "V, m/s") or None, "the curves")[0]
        assert t[-1] == pytest.approx(11.98, abs=0.02) and len(drawn) == 1 + 2 * 2 + 1  # and the marks of events
        for title, axes in page.evaluate(AXES).items():
            assert axes["cursor"] == pytest.approx(7.5, abs=0.05) and axes["times"], title
        replay.ask(setattr, replay._interval, "value", (7.0, 8.0))
        replay.ask(replay._draw_curves)
        t = until(lambda: len(now := curves(page, "V, m/s")[0][0]) < 105 and now, "one second of the curves")
        assert (t[0], t[-1], len(t)) == (pytest.approx(7.0), pytest.approx(8.0), 101)  # every sample
        until(lambda: page.evaluate(AXES)["V, m/s"]["cursor"] == pytest.approx(7.5, abs=0.01), "the cursor")
        last = result.isel(run=1).dropna("time", subset=["x"]).isel(time=-1)
        tilt = np.arccos(np.cos(last.pitch_angle) * np.cos(last.roll_angle))
        assert tilt > 0.4
        replay.ask(replay._scrub, 12.0)
        laps = per_lap(result)
        score = [f"{1e3 * laps.position_rmse.values[0].min():.3g}", f"{100 * laps.feedback_share.values[0, 1]:.3g}"]
        until(lambda: {*score, "–"} <= set(page.inner_text("#mrctl-score").split()), "the score of the tables")
        # Below the curves: what the last lap excites.
        motion = (result[name].values[:1, 600:1200] for name in ("v_command", "omega_command"))
        excited = alone(np.stack([*motion], -1), 0.01, result.half_track.values[:1], result.feature_scale.values[:1])[0]
        lines = page.inner_text("#mrctl-excitation").splitlines()[1:]
        assert [line.split("\t")[0] for line in lines] == [*FEATURE_NAMES]
        assert [float(line.split("\t")[1]) for line in lines] == pytest.approx(excited, rel=0.05)
        stated = f"RMS distance to the reference: {1e3 * laps.position_rmse.values[0, 1]:.4g} mm"
        assert stated in page.inner_text("#mrctl-status") and "_" not in page.inner_text("#mrctl-status")
        stopped = f"stopped after {result.failure_time.values[1]:.2f} s: tilt over 30°"
        assert stopped in page.inner_text("#mrctl-status")
        pose = f"window.__viserMutable.nodePoseData[{GHOST!r}].wxyz"
        until(lambda: abs(2 * np.arcsin(np.hypot(*page.evaluate(pose)[1:3])) - tilt) < 1e-3, "the ghost to be tipped")
        there = click_on_curve(page, "V, m/s", 0.5)
        until(lambda: replay.time == pytest.approx(there, abs=0.02), "it to go to a click on a curve")
        replay.ask(replay._scrub, float("nan"))
        until(lambda: replay.message == "go to: nan is not a time" and replay.time, "the time to stay")
        replay.ask(replay._scrub, -3.0)  # as a page sends it while somebody types
        until(lambda: replay.time == 0.0, "the beginning")
        replay.ask(replay._choose, 1)
        until(lambda: replay.runs == [1], "the other run, once")
        page.get_by_text("Keep this run as a ghost").click()
        until(lambda: "ghosts: runs 1" in page.inner_text("#mrctl-status"), "it to be kept")
        assert replay.runs == [1]
        replay.ask(replay._choose, 0)
        until(lambda: replay.runs == [0, 1], "it to be a ghost")


# Of each chart, the number of numbers at its y axis, and how far its last time ends before its right edge in pixels.
AXES_IN_VIEW = """() => {
    const charts = Object.values(window.__viserTestpoints?.uplots ?? {}).map(({chart}) => chart);
    if (!charts.length || charts.some(({axes}) => !axes[0]._values || !axes[1]._values)) return null;
    return charts.map((chart) => {
        const [across, up] = chart.axes, pen = document.createElement('canvas').getContext('2d');
        pen.font = across.font[0];
        const half = pen.measureText(across._values.at(-1)).width / window.devicePixelRatio / 2;
        const middle = chart.bbox.left / window.devicePixelRatio + chart.valToPos(across._splits.at(-1), 'x');
        return [up._values.filter((text) => text).length, chart.width - middle - half];
    });
}"""
# How far the marks of sliders end before the right edge of the page in pixels.
MARKS_IN_VIEW = """() => [...document.querySelectorAll('.mantine-Slider-markLabel')].map(
    (mark) => window.innerWidth - mark.getBoundingClientRect().right
)"""


def test_numbers_in_view(browser, tmp_path):
    """Each y axis has two numbers or more, and the page cuts off neither a time nor a mark of a slider."""
    drive = BASE.replace(
        reference=Circle(radius=0.8, period=10.02), laps=1, learner="none"
    )  # the last time is at the edge
    save(simulate(drive), tmp_path / "result.zarr")
    with (
        serving(lambda server: ReplayPage(Library(tmp_path / "result.zarr"), [0], server)) as (_, url),
        visit(browser, url, slowly=True) as page,
    ):
        axes = until(lambda: page.evaluate(AXES_IN_VIEW), "the charts")
        assert all(numbers >= 2 and room > 3 for numbers, room in axes), axes
        marks = until(lambda: page.evaluate(MARKS_IN_VIEW) or None, "the marks")
        assert min(marks) > 10, marks  # which is the margin of the inputs


PLACES = """(name) => {
    const vertices = [], node = window.__viserMutable.nodeRefFromName[name];
    if (!node) return [];
    const world = window.__viserMutable.nodeRefFromName['/world'];
    node.updateWorldMatrix(true, true);
    node.traverse((part) => {
        const at = part.geometry?.attributes.position, point = node.position.clone();
        if (part.instancesCount !== undefined)
            for (let k = 0; k < part.instancesCount; k++) {
                const place = world.worldToLocal(part.getPositionAt(k).applyMatrix4(part.matrixWorld));
                vertices.push([...place.toArray(), part.getOpacityAt(k)]);
            }
        else if (at && !vertices.length)
            for (let k = 0; k < at.count; k++)
                vertices.push(
                    world.worldToLocal(point.fromBufferAttribute(at, k).applyMatrix4(part.matrixWorld)).toArray()
                );
    });
    return vertices;
}"""
VISIBLE = """(name) => {
    let node = window.__viserMutable.nodeRefFromName[name];
    while (node && node.visible) node = node.parent;
    return !node;
}"""
MARKS = "/world/sensors/0"


def places(page, name):
    """Points of a mark on the ground in m, `(n, 2)`, as the browser has them; of fixes also their opacity."""
    return np.array(page.evaluate(PLACES, name))


def check_marks(page, log, period, robot, times):
    """Estimate, 3σ ellipse and fixes stand where the signals have them, with errors drawn so many times."""
    now = log[-1]
    off = times * np.array([now["x_measured"] - now["x"], now["y_measured"] - now["y"]])
    covariance = times**2 * np.array(
        [[now["variance_x"], now["covariance_xy"]], [now["covariance_xy"], now["variance_y"]]]
    )
    until(lambda: np.allclose(node(page, f"{MARKS}/estimate")[:2], robot + off, atol=1e-5), "the estimate")

    def distances():
        rim = places(page, f"{MARKS}/ellipse/area")[1:, :2] - robot - off
        return np.sqrt(np.einsum("ni,ij,nj->n", rim, np.linalg.inv(covariance), rim))

    until(lambda: np.allclose(distances(), 3, rtol=1e-2), "the ellipse at three standard deviations all around")
    latency = 5  # 50 ms
    arrived = np.flatnonzero(np.isfinite(log["fix_x"]) & (np.arange(len(log)) > len(log) - 1 - 2.0 / period))[-20:]
    true = np.stack([log[axis][arrived - latency] for axis in ("x", "y")], axis=-1)
    fixes = np.stack([log[f"fix_{axis}"][arrived] for axis in ("x", "y")], axis=-1)
    opacity = 1 - (len(log) - 1 - arrived) * period / 2.0
    expected = np.column_stack([true + times * (fixes - true), opacity])

    def seen():
        found = places(page, f"{MARKS}/fixes")
        return found[found[:, 3] > 0][:, [0, 1, 3]]

    until(lambda: (found := seen()).shape == expected.shape and np.allclose(found, expected, atol=1e-4), "the fixes")
    assert len(expected) > 10


FIELD = BASE.model_copy(update={"sensing": Sensing(tier="field"), "prior": "model", "learner": "none"})


def test_estimate_live(browser, tmp_path):
    """What a robot with cheap sensors knows of its posture stands beside the truth, and its V in the same chart."""
    with serving(lambda server: Live([FIELD], server)) as (live, url), visit(browser, url, slowly=True) as page:
        until(lambda: live.session.time > 2.5 and node(page, f"{MARKS}/estimate") is not None, "the robot to drive")
        live.ask(live._command, "pause")
        until(lambda: "paused" in page.inner_text("#mrctl-status"), "the pause")
        log, robot = live.session.log()[:, 0], live.session.qpos(0)[:2]
        check_marks(page, log, live.session.period, robot, 10)
        off = 1e3 * np.hypot(log["x_measured"] - log["x"], log["y_measured"] - log["y"])[-1]
        assert f"{off:.1f} mm off" in page.inner_text("#mrctl-sensors")
        assert "10 times" in page.inner_text("#mrctl-sensors")
        assert page.evaluate(VISIBLE, f"{MARKS}/estimate")

        def chart():
            t, reference, estimated, true, _ = until(lambda: curves(page, "V, m/s") or None, "the curves")[0]
            return t[-1] > 2.4 and (t, estimated, true)

        t, estimated, true = until(chart, "the curves of V")
        at = np.round(t / live.session.period).astype(int)
        np.testing.assert_array_equal(true, log["v"][at].astype(np.float32))
        np.testing.assert_array_equal(estimated, log["v_measured"][at].astype(np.float32))
        assert np.abs(estimated - true).max() > 1e-3
        picture(page, tmp_path / "estimate.png")

        page.get_by_label("Sensors").click()
        until(lambda: not page.evaluate(VISIBLE, f"{MARKS}/estimate"), "the marks to vanish")


def test_estimate_replay(browser, tmp_path):
    """The marks of a replay are those of the recorded signals; a result of an earlier version has none."""
    result = simulate([FIELD.model_copy(update={"laps": 1})])
    save(result, tmp_path / "result.zarr")
    library = Library(tmp_path / "result.zarr")
    with (
        serving(lambda server: ReplayPage(library, [0], server)) as (replay, url),
        visit(browser, url, slowly=True) as page,
    ):
        until(lambda: node(page, f"{MARKS}/estimate") is not None, "the scene")
        replay.ask(replay._scrub, 3.1)
        replay.ask(setattr, replay.magnified, "value", "1×")
        log = replay.recordings[0].log[:311]
        check_marks(page, log, 0.01, np.array([log["x"][-1], log["y"][-1]]), 1)
        measured = result.isel(run=0).sel(time=3.1, method="nearest")
        assert np.allclose(node(page, f"{MARKS}/estimate")[:2], [measured.x_measured, measured.y_measured], atol=1e-5)
    old = result.drop_vars([name for name in result if "measured" in str(name) or str(name).startswith("fix_")])
    save(old, tmp_path / "old.zarr")
    with serving(lambda server: ReplayPage(Library(tmp_path / "old.zarr"), [0], server)) as (replay, _):
        assert not replay.marks[0]
        replay.sensors.value = True
        replay.draw()
        replay.refresh()
        assert replay.message == "" and not replay._scene._marks[0]._root.visible


def test_export(browser, tmp_path):
    """The exported file plays from the disk without a network, and its curves and its scene share the time."""
    scenario = tmp_path / "scenario.toml"
    scenario.write_text('laps = 1\n[reference]\nkind = "circle"\nradius = 0.8\nperiod = 6.0\n')
    file = tmp_path / "run.html"
    assert main(["view", str(scenario), "--compare", "none", "--export", str(file)]) == 0
    scene = "document.getElementById('scene').contentWindow"
    with visit(browser, file.as_uri(), offline=True) as page:
        until(lambda: node(page, ROBOT, scene) is not None, "the scene")
        first = node(page, ROBOT, scene)
        until(lambda: np.linalg.norm(node(page, ROBOT, scene) - first) > 0.2, "it to play by itself")
        chart = page.locator("canvas").first.bounding_box()
        page.mouse.click(chart["x"] + 52 + (chart["width"] - 70) / 2, chart["y"] + 60)
        until(lambda: page.inner_text("#time").startswith(("2.9", "3.0")), "the scrubber to follow the curves")
        half = until(lambda: (p := node(page, ROBOT, scene)) is not None and p[1] > 1.4 and p, "the robot to follow")
        assert np.allclose(half[:2], [0, 1.6], atol=0.1)  # half way around
        picture(page, tmp_path / "export.png")
        page.set_viewport_size({"width": 390, "height": 844})
        boxes = [page.locator(part).bounding_box() for part in ("#scene", "#curves")]
        assert all(box["width"] > 380 for box in boxes) and boxes[0]["height"] > 400 < boxes[1]["y"]
        player = page.frame_locator("#scene").locator("button, input:not([type=hidden])")
        heights = lambda: [b["height"] for part in player.all() if (b := part.bounding_box())]  # noqa: E731
        until(lambda: len(now := heights()) >= 4 and min(now) >= 44, "buttons and inputs for a finger")
        page.screenshot(path=tmp_path / "export_phone.png", timeout=PATIENCE)
    assert main(["view", str(scenario), "--export", str(file)]) == 2  # not overwritten


ON_A_GPU = """(() => {
    const known = WebGL2RenderingContext.prototype.getParameter;
    WebGL2RenderingContext.prototype.getParameter = function (name) {
        return name === 0x9246 ? 'ANGLE (NVIDIA GeForce RTX)' : known.call(this, name);
    };
})()"""


def test_soft_light(browser):
    """A browser with a GPU switches soft light on, once; one without leaves it off."""
    with serving(lambda server: Live([BASE], server)) as (live, url):
        live.ask(live._command, "pause")
        with visit(browser, url, slowly=True) as page:
            until(lambda: node(page, ROBOT) is not None, "the scene")
            time.sleep(1.0)
            assert not live.server.soft and not page.get_by_label("Soft light").is_checked()
            page.add_init_script(ON_A_GPU)
            page.reload()
            until(lambda: live.server.soft, "soft light")
            page.get_by_label("Soft light").click()
            until(lambda: not live.server.soft, "even light again")
            page.reload()
            until(lambda: node(page, ROBOT) is not None, "the scene")
            time.sleep(2.0)
            assert not live.server.soft


DOT = """(index) => {
    const chart = Object.values(window.__viserTestpoints.uplots).map((u) => u.chart)
        .find((c) => c.series[1].label === 'run');
    if (!chart) return null;
    const box = chart.over.getBoundingClientRect();
    return [box.left + chart.valToPos(chart.data[0][index], 'x'), box.top + chart.valToPos(chart.data[2][index], 'y')];
}"""


@pytest.mark.usefixtures("here")
def test_colours_of_a_sweep(tmp_path):
    """Runs have the colour of their world where a sweep varies it; where it varies the learner, of their controller."""
    base = {"laps": 1, "reference": {"kind": "circle", "period": 4.0, "radius": 0.5}, "learner": "none"}
    for field, values, column in (("world", ["flat", "slope"], "world"), ("learner", ["none", "rls"], "feedforward")):
        axes = [{"field": "perturbation.mass_factor", "values": [0.8, 1.0, 1.2]}, {"field": field, "values": values}]
        jobs.run(Sweep.from_dict({"base": base, "axes": axes}), tmp_path / field, workers=1)
        server = Server(port=0)
        library = Library(tmp_path / field)
        replay = ReplayPage(library, [0], server)
        scatter = replay._scatter
        assert scatter is not None
        chosen, colours = scatter.colours()
        assert chosen == column and len(set(colours.values())) == 2
        for name, dots, series in zip(colours, scatter.data[3:5], scatter._chart.series[3:5], strict=True):
            assert series["points"]["fill"] == f"rgb{colours[name]}"
            drawn = set(scatter.data[1][np.isfinite(dots)])
            assert drawn == set(library.table.index[library.table[column] == name])
        own = looks(["a", "b"], ["none", "rls"])
        assert column == "world" or list(colours.values()) == [look.colour for look in own]
        if column == "world":  # a ghost in another world is refused by its number
            replay._keep()
            other = library.table.index[library.table["world"] == "slope"][0]
            replay._chosen.value = scatter.run.value = float(other)
            replay.ask(replay._choose, other)
            replay._run_requests()
            assert replay.message == f"run: PID alone 0 drove with another world than PID alone {other}"
            assert replay.runs == [0] and replay._chosen.value == scatter.run.value == 0
        server.stop()


def test_runs_of_several_worlds(tmp_path):
    """A result of a few runs opens with its first one, and with those that can stand in the same scene."""
    drive = Scenario(laps=1, reference=Circle(period=4.0, radius=0.5), learner="none")
    result = simulate([drive, drive.replace(world="slope"), drive.replace(seed=1)])
    for runs, shown in ((slice(None), [0, 2]), ([1, 0], [0]), ([2, 0], [0, 1])):
        save(result.isel(run=runs), tmp_path / "result.zarr")
        library = Library(tmp_path / "result.zarr")
        assert library.first_shown(None) == shown
        assert len(looks_of([library.recording(k) for k in shown], shown)) == len(shown)
        shutil.rmtree(tmp_path / "result.zarr")


@pytest.mark.usefixtures("here")
def test_sweep(browser, tmp_path):
    """All runs of a sweep in the panel: a click opens the one under the mouse, as `mrctl run` has it."""
    base = {
        "laps": 1,
        "reference": {"kind": "circle", "period": 4.0, "radius": 0.5},
        "prior": "model",
        "learner": "none",
    }
    axis = {"field": "perturbation.mass_factor", "uniform": [0.5, 2.0]}
    jobs.run(Sweep.from_dict({"runs": 6, "base": base, "axes": [axis]}), tmp_path / "store", workers=1)
    library = Library(tmp_path / "store")
    with (
        serving(lambda server: ReplayPage(library, [0], server)) as (replay, url),
        visit(browser, url, slowly=True) as page,
    ):
        page.locator(".mantine-Notification-closeButton").click()  # that rendering is in software
        page.get_by_role("tab", name="All runs").click()
        scatter = replay._scatter
        assert scatter is not None
        factors = library.table["perturbation.mass_factor"].to_numpy()
        np.testing.assert_array_equal(scatter.data[0], np.sort(factors))
        order = np.argsort(factors)
        np.testing.assert_allclose(scatter.data[2], 1e3 * library.table["position_rmse"].to_numpy()[order])
        dot = lambda: page.evaluate(DOT, order.tolist().index(4))  # noqa: E731
        drawn = lambda at: at and pixel(page, tmp_path / "sweep.png", at) == DROVE_COLOUR and dot() == at  # noqa: E731
        at = until(lambda: drawn(there := dot()) and there, "the dot, where the run is")
        page.mouse.click(at[0] + 3, at[1] - 3)
        until(lambda: replay.runs == [4], "the run to open")
        ring = at[0] + RING_SIZE / 2 - 1, at[1]
        until(lambda: pixel(page, tmp_path / "opened.png", ring) == CURSOR_COLOUR, "the ring")
        assert page.get_by_label("Run to show").input_value() == "4"
        library.table["energy"] = [0.1, 1.0, 10.0, 100.0, 1e3, 1e4]  # J
        scatter.axes[1].value = "electrical energy, J"
        replay.ask(scatter.draw)
        until(lambda: scatter.logarithmic == [False, True], "another axis")
        apart = lambda: np.diff(sorted(page.evaluate(DOT, k)[1] for k in range(6)))  # noqa: E731
        until(lambda: np.ptp(gaps := apart()) < 0.1 and gaps.min() > 1, "decades, which are equally far")
        page.screenshot(path=tmp_path / "logarithmic.png", timeout=PATIENCE)
    again = simulate(jobs.scenario_of(tmp_path / "store", 4))
    assert replay._log["x"][:, 0].tobytes() == again.x.values.tobytes()
