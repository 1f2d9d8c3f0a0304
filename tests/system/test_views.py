"""Ten views of the page as pictures, for people to look at; each has the robot between or above the panels."""

import pytest
from test_viewer import (
    AXES,
    BASE,
    GHOST,
    PATIENCE,
    ROBOT,
    WORLD_TO_SCREEN,
    browser,
    node,
    picture,
    serving,
    until,
    visit,
)

from mrctl import Event, Perturbation, Scenario, Sweep, save, simulate
from mrctl.cli import main
from mrctl.cli.shared import BEST
from mrctl.results.controllers import title_of
from mrctl.scenario import FEEDFORWARDS
from mrctl.sweep import jobs
from mrctl.viewer.live import Live
from mrctl.viewer.recording import Library
from mrctl.viewer.replay import ReplayPage

__all__ = ["browser"]  # a fixture
pytestmark = pytest.mark.full
FIRST = [Scenario(**FEEDFORWARDS[BEST]), Scenario(**FEEDFORWARDS["none"])]  # as `mrctl view` begins


def look(page, path, frame="window"):
    """Takes a picture; the first robot is between the panels, or above the panel of a small page."""
    until(lambda: node(page, ROBOT, frame) is not None, "the scene")
    page.wait_for_timeout(2000)  # the last pictures arrive
    if frame == "window":
        x, y = page.evaluate(WORLD_TO_SCREEN, node(page, ROBOT).tolist())
        wide = page.viewport_size["width"] > 600
        assert (344 if wide else 0) < x < (986 if wide else 390) and 0 < y < (800 if wide else 844 / 2)
    page.screenshot(path=path, timeout=PATIENCE)
    return picture(page, path.with_stem(path.stem + "_scene")) if frame == "window" else None


def test_live(browser, tmp_path):
    """First view, after a payload, a ghost close up, the other robots, on a phone, and dark."""
    with serving(lambda server: Live(FIRST, server)) as (live, url), visit(browser, url) as page:
        until(lambda: live.session.time > 14, "more than a lap")
        live.ask(live._command, "pause")
        until(lambda: "paused" in page.inner_text("#mrctl-status"), "the pause")
        page.locator(".mantine-Notification-closeButton").click()
        first = look(page, tmp_path / "1_first.png")
        page.get_by_text("drop payload").click()
        live.ask(live._command, "play")
        until(lambda: live.session.time > 16, "the payload to act")
        live.ask(live._command, "pause")
        assert (abs(look(page, tmp_path / "2_payload.png") - first).max(axis=-1) > 60).sum() > 300
        page.get_by_role("button", name="chase", exact=True).click()
        look(page, tmp_path / "3_ghost.png")
        assert node(page, GHOST) is not None
        page.set_viewport_size({"width": 390, "height": 844})
        page.get_by_role("button", name="overview", exact=True).click()
        look(page, tmp_path / "8_phone.png")
        page.set_viewport_size({"width": 1280, "height": 800})
        page.get_by_label("Dark page").click()
        dark = look(page, tmp_path / "9_dark.png")
        assert dark.mean() < first.mean() / 2
        page.get_by_label("Dark page").click()
        for name, file in (("racecar", "6_racecar.png"), ("turtlebot", "7_turtlebot.png")):
            live.ask(live._choose_robot, name)
            live.ask(live._command, "play")
            until(lambda name=name: live.session.start[0].robot.path == name and live.session.time > 3, name)
            live.ask(live._command, "pause")
            look(page, tmp_path / file)


def test_rollover(browser, tmp_path):
    """The replay of a robot that tips over, beside one that drives on."""
    high = Event(time=4.0, perturbation=Perturbation(payload=8, payload_z=0.9))
    tips = high, Event(time=8.0, push=(0.0, 350.0, 0.0), push_duration=0.3)
    save(simulate([BASE.replace(learner="none", events=tips), BASE.replace(events=(high,))]), tmp_path / "result.zarr")
    library = Library(tmp_path / "result.zarr")
    with serving(lambda server: ReplayPage(library, [0, 1], server)) as (replay, url), visit(browser, url) as page:
        until(lambda: node(page, ROBOT) is not None and page.evaluate(AXES), "the scene")
        page.locator(".mantine-Notification-closeButton").click()
        page.get_by_text("pause", exact=True).click()
        replay.ask(replay._scrub, 9.5)
        look(page, tmp_path / "4_rollover.png")


def test_sweep(browser, tmp_path):
    """The scatter plot of a sweep."""
    base = {"laps": 1, "reference": {"kind": "circle", "period": 4.0, "radius": 0.5}, "learner": "none"}
    axes = [
        {"field": "perturbation.mass_factor", "uniform": [0.5, 2.0]},
        {"field": "prior", "values": ["none", "model"]},
    ]
    jobs.run(Sweep.from_dict({"runs": 20, "base": base, "axes": axes}), tmp_path / "store", workers=1)
    with (
        serving(lambda server: ReplayPage(Library(tmp_path / "store"), [0], server)) as (_, url),
        visit(browser, url) as page,
    ):
        page.locator(".mantine-Notification-closeButton").click()
        page.get_by_role("tab", name="All runs").click()
        look(page, tmp_path / "5_sweep.png")


def test_export(browser, tmp_path):
    """One HTML file without a server, which names its controllers."""
    file = tmp_path / "run.html"
    assert main(["view", "--compare", "none", "--export", str(file)]) == 0
    with visit(browser, file.as_uri(), offline=True) as page:
        look(page, tmp_path / "10_export.png", "document.getElementById('scene').contentWindow")
        assert title_of("none") in page.inner_text("body")
