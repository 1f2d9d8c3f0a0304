"""What an input of the page changes is what the same scenario file would change."""

import typing

import pytest

from mrctl import Scenario
from mrctl.theory.references import Reference
from mrctl.viewer import live as module
from mrctl.viewer.live import Live
from mrctl.viewer.server import Server
from mrctl.viewer.session import CHANGEABLE


@pytest.fixture(scope="module")
def live():
    server = Server(port=0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "_tidy", lambda: None)  # a hundred sessions would take their time
        yield Live([Scenario()], server)
    server.stop()


def other(handle):
    """Another value that the page allows."""
    if hasattr(handle, "options"):
        return next(option for option in reversed(handle.options) if option != handle.value)
    if isinstance(handle.value, bool):
        return not handle.value
    far = handle.max if handle.value < handle.max else handle.min
    return handle.value + round((far - handle.value) / 4 / handle.step) * handle.step


def test_every_input(live):
    """Each is in the scenario or in an event of the session thereafter; those that need another run begin one."""
    kinds = {kind.model_fields["kind"].default: kind() for kind in typing.get_args(Reference.__origin__)}
    seen = []
    for where, handle in list(live._controls._inputs.items()):
        kind = where[1] if where[0] == "reference" and len(where) > 2 else None
        path = (where[0], *where[2:]) if kind else where
        live._restart([Scenario(reference=kinds[kind], steering="rigid") if kind else Scenario()])
        live.session.step()
        value = other(handle)
        if path == ("perturbation", "control_delay"):
            value = 0.12  # in whole control periods
        if path[0] == "sensing" and path[1].endswith(("rate", "latency", "delay")):
            value = 50.0 if path[1].endswith("rate") else 0.03
        if path == ("reference",):
            value = "circle"
        if kind and isinstance(value, float):  # a little, within what the robot can do
            value = handle.value - max(1, round(handle.value / 20 / handle.step)) * handle.step
        live._note_input(path, value)
        live._apply_inputs()
        assert live.message == "", where
        saved = live.session.saved()[0]
        changing = path[0] in CHANGEABLE
        found = saved.events[-1] if changing else saved
        for name in path:
            found = getattr(found, name)
        assert getattr(found, "kind", found) == (pytest.approx(value) if isinstance(value, float) else value), where
        assert live.session.tick == changing and len(saved.events) == changing
        assert handle.value == (pytest.approx(value) if isinstance(value, float) else value), where
        open_folders = [name for name in kinds if live._controls._folders["reference", name].visible]
        assert open_folders == [live.session.start[0].reference.kind]
        for _ in range(3):
            live.session.step()
        live.draw()
        live.refresh()
        seen.append(kind)
    assert len(seen) > 90 and set(seen) == {None, *kinds}


def test_refusals(live):
    """What cannot be is said in the page, and the inputs show again what holds."""
    live._restart([Scenario()])
    live._note_input(("reference",), "stop_and_go")  # reverses, with a fork that cannot
    live._apply_inputs()
    assert "reverses" in live.message and live.session.start == [Scenario()]
    live._note_input(("perturbation", "payload_x"), -1.0)
    live._note_input(("perturbation", "payload"), 200.0)
    live._apply_inputs()
    assert "tip over" in live.message
    assert live._controls._inputs["perturbation", "payload"].value == 0.0
    live._note_input(("perturbation", "mass_factor"), "heavy")
    live._apply_inputs()
    assert "mass_factor" in live.message and len(live.session.saved()[0].events) == 1


def test_order(live):
    """What a visitor does after changing an input comes after it: a reset removes it."""
    live._restart([Scenario()])
    live.ask(live._note_input, ("perturbation", "payload"), 5.0)
    live.ask(live._note_input, ("perturbation", "mass_factor"), "heavy")
    live.ask(live._command, "reset")
    live._run_requests()
    live.refresh()
    assert live.session.saved()[0].events == () and live.message == ""


def test_robot_that_stops(live):
    """The page says that a robot has stopped and why, and waits."""
    live._restart([Scenario()])
    live._apply_event(push=(0.0, 5000.0, 0.0))
    live.playing = True
    for _ in range(30):
        live.advance(0.1, float("inf"))
    live.refresh()
    assert not live.playing and "stopped:" in live._status.content and "reset" in live._status.content
