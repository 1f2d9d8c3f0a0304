"""What an input of the page changes is what the same scenario file would change."""

import asyncio
import re
import time
import tomllib
import typing

import numpy as np
import pytest
import viser

from mrctl import Event, Kanayama, Line, Perturbation, Pid, Scenario, per_lap, save_learned, simulate
from mrctl.loop.groups import arranged
from mrctl.loop.timeline import CHANGEABLE
from mrctl.physics import mjcf
from mrctl.physics.parameters import read_robot
from mrctl.sensing.tiers import Sensing
from mrctl.theory.references import Reference
from mrctl.theory.robot import RobotFile
from mrctl.viewer import live as module
from mrctl.viewer.controls import NEW_RUN_HINT, NEW_RUN_MARK
from mrctl.viewer.live import Live
from mrctl.viewer.server import Server
from mrctl.viewer.stories import STORIES


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
    """Each is in the scenario or in an event of the session thereafter; those that need another run begin one.

    One follows the other without a reset, but where the parts of another kind of reference take their turn.
    """
    kinds = {kind.model_fields["kind"].default: kind() for kind in typing.get_args(Reference.__origin__)}
    seen = []
    for where, handle in list(live._controls._inputs.items()):
        kind = where[1] if where[0] == "reference" and len(where) > 2 else None
        path = (where[0], *where[2:]) if kind else where
        if not seen or kind != seen[-1]:
            live._restart([Scenario(reference=kinds[kind], steering="rigid") if kind else Scenario()])
            live.session.step()
        tick, events = live.session.tick, len(live.session.saved()[0].events)
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
        assert (live.session.tick, len(saved.events)) == ((tick, events + 1) if changing else (0, 0)), where
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
    assert "reverses" in live.message and live.session.start == [arranged(Scenario())]
    live._note_input(("perturbation", "payload_x"), -1.0)
    live._note_input(("perturbation", "payload"), 200.0)
    live._apply_inputs()
    assert "tip over" in live.message
    assert live._controls._inputs["perturbation", "payload"].value == 0.0
    live._note_input(("perturbation", "mass_factor"), "heavy")
    live._apply_inputs()
    assert "mass_factor" in live.message and len(live.session.saved()[0].events) == 1


def visitor_sets(live, handle, value):
    """What viser does with an input of a page."""
    handle.value = value
    (called,) = handle._impl.update_cb
    asyncio.run(called(viser.GuiEvent(live.server, 0, handle)))


@pytest.mark.parametrize("steering", ["compliant", "rigid"])
@pytest.mark.parametrize("tier", ["ideal", "field"])
def test_design(live, steering, tier):
    """What is not set shows the value that the controllers were designed with, and says so, until it is set."""
    live._restart([Scenario(steering=steering, sensing=Sensing(tier=tier), pid=Pid(time_constant=0.2))])
    live._note_input(("pid", "time_constant"), 0.0)
    live._apply_inputs()
    live.session.step()
    inputs, state = live._controls._inputs, live.session.simulations[0][1].hierarchy.state[0]
    second = {f"steering_{name}": state["pid"][name][1] for name in ("k_p", "k_i")}
    known = {("prefilter",): state["limiter"]["time_constant"], ("pid", "delay"): 0.02 if tier == "field" else 0.0}
    known |= {("kanayama", name): state["kanayama"][name] for name in Kanayama.model_fields}
    known |= {("pid", name.replace("k_", "k")): value for name, value in second.items() if steering == "rigid"}
    for path, value in known.items():
        assert inputs[path].value == pytest.approx(value, rel=5e-3) and inputs[path].visible, path
        assert inputs[path].min <= inputs[path].value <= inputs[path].max
        assert inputs[path].label.endswith("(designed)") and not live._controls._buttons[path].visible
    assert inputs["pid", "steering_kp"].visible == (steering == "rigid")
    assert inputs["pid", "time_constant"].value == 0 and "(designed)" in inputs["pid", "time_constant"].label
    assert f"K_p {state['pid']['k_p'][0]:.3g} V/(m/s)" in live._gains.content

    live._note_input(("kanayama", "k_y"), 9.0)
    live._apply_inputs()
    assert inputs["kanayama", "k_y"].label == "k y, 1/m²" and live._controls._buttons["kanayama", "k_y"].visible
    assert inputs["kanayama", "k_theta"].value == 6 and "designed → 9" in live._timeline.content
    live._note_input(("kanayama", "k_y"), None)
    live._apply_inputs()
    assert inputs["kanayama", "k_y"].value == pytest.approx(state["kanayama"]["k_y"], rel=5e-3)
    assert live.session.state()["kanayama"] == Kanayama() and live.message == ""


def test_another_learner_before_a_tick(live):
    """The score of the run before is gone with it, before the new run has done its first tick."""

    def score():
        live.refresh()
        return live._plots._score.content + live._plots._lessons.content

    live._restart([Scenario(learner="rls")])
    assert not re.search(r">[0-9]", score())
    for _ in range(20):
        live.session.step()
    assert re.search(r">[0-9]", score())
    live._note_input(("learner",), "fel")
    live._apply_inputs()
    assert live.session.tick == 0 and not re.search(r">[0-9]", score())


def test_another_learner_than_that_of_the_file(live, tmp_path):
    """A session that starts from what was learned takes another learner, and a ghost, which start from nothing."""
    lap = Scenario(reference=Line(length=0.8), laps=1, learner="rls")
    save_learned(tmp_path / "rls.safetensors", simulate(lap))
    live._restart([lap.replace(learned=str(tmp_path / "rls.safetensors"))])
    live._compare("none", True)
    live._apply(("learner",), "fel")
    assert [(s.learner, s.learned) for s in live.session.start] == [("fel", None), ("none", None)]


def test_marks_of_events(live):
    """A line crosses each chart at each event, once where two fall into one sample."""
    live._restart([Scenario()])
    for button in (("Payload", "drop payload"), ("Supply", "sag supply"), ("Push", "push")):
        for _ in range(0 if "sag supply" in button else 60):
            live.session.step()
        live._press(*button)
    for _ in range(60):
        live.session.step()
    live._show_past()
    for handle in live._plots._handles:
        time, marks = handle.data[0], handle.data[-1]
        assert time[1:][np.diff(marks) != 0] == pytest.approx([0.6, 1.2], abs=0.06) and {*marks} == {-1, 1}


def test_typing(live):
    """While somebody types 0.05, what is below the limit yet neither changes nor resets anything."""
    live._restart([Scenario()])
    handle = live._controls._inputs["prefilter",]
    assert handle.min == 0.01
    for text in ("0", "0.", "0.0", "0.05"):
        visitor_sets(live, handle, float(text))
        live._run_requests()
        live._apply_inputs()
        assert handle.value == float(text) and live.message == ""
    assert live.session.start[0].prefilter == 0.05


def test_marks(live):
    """The inputs whose change begins another run are marked, and no others; both tabs say what the mark means."""
    live._restart([Scenario()])
    for (first, *_), handle in live._controls._inputs.items():
        anew = first not in CHANGEABLE
        assert (NEW_RUN_MARK in handle.label, NEW_RUN_HINT in (handle.hint or "")) == (anew, anew), handle.label
    assert (
        live._controls._inputs["learner",].label == f"learner{NEW_RUN_MARK}"
        and live._robot.label == f"robot{NEW_RUN_MARK}"
    )


def test_units(live):
    """The label of a number has the unit that its description says of it; shares and factors have none."""
    labels = {path: handle.label.removesuffix(NEW_RUN_MARK) for path, handle in live._controls._inputs.items()}
    for path, label in {
        "perturbation.payload": "payload, kg",
        "perturbation.mass_factor": "mass factor",
        "sensing.start_position_noise": "start position noise, m",
        "sensing.gyro_noise": "gyro noise, rad/s/√Hz",
        "sensing.fix_outliers": "fix outliers",
        "mrac.noise": "noise, V √s",
        "mrac.radius": "radius",
        "mrac.leak": "leak, 1/(V² s)",
        "guard.oscillation": "oscillation",
        "reference.waypoints.limits.acceleration": "acceleration, m/s²",
    }.items():
        assert labels[tuple(path.split("."))] == label
    live._restart([Scenario(prefilter=0.1, steering="rigid", pid=Pid(steering_kp=1.0))])
    assert live._controls._inputs["prefilter",].label == f"prefilter, s{NEW_RUN_MARK}"
    assert live._controls._inputs["pid", "steering_kp"].label == "steering kp, rad/s per rad/s"


def test_hints_say_the_limits(live):
    """The hint of a number says what the record accepts, so that a number that the page moves is no riddle."""
    live._restart([Scenario()])
    hints = {path: handle.hint for path, handle in live._controls._inputs.items()}
    assert hints["prefilter",].startswith("Time constant") and "At least 0.01, at most 10." in hints["prefilter",]
    assert "At least 0.05, at most 20." in hints["perturbation", "mass_factor"]
    assert "at most" not in (hints["learner",] or "").lower()


def test_sliders(live):
    """A slider shows the range that suits the robot; a number beyond its ends is accepted up to the record's limits."""
    payload, size = ("perturbation", "payload"), ("reference", "lemniscate", "size")
    shown = {}
    for name in ("turtlebot", "racecar", "car"):
        live._choose_robot(name)
        robot, inputs = live.session.robot, live._controls._inputs
        for path, handle in inputs.items():
            if isinstance(handle, viser.GuiSliderHandle):
                assert handle.min <= handle.value <= handle.max and handle.max > handle.min, path
        speed = inputs["reference", "line", "speed"]
        assert inputs[payload].max == pytest.approx(robot.mass, rel=0.05)
        assert speed.max == pytest.approx(max(robot.max_speed, speed.value), rel=0.05)
        shown[name] = inputs[size].max
    assert shown["turtlebot"] < shown["racecar"] < shown["car"] < 20
    live._restart([Scenario()])
    handle = inputs[payload]
    for typed in (6.0, 60.0):
        visitor_sets(live, handle, typed)
    assert handle.max == 60.0  # before a page, which somebody leaves, limits it
    live._run_requests()
    live._apply_inputs()
    assert live.session.state()["perturbation"].payload == 60.0 and live.message == ""
    visitor_sets(live, handle, 40.0)
    live._run_requests()
    live._apply_inputs()
    assert (handle.value, handle.max) == (40.0, 60.0)  # one can go back up
    live._press("Payload", "remove")
    assert (handle.value, handle.max) == (0.0, 20.0)
    visitor_sets(live, handle, 300.0)
    live._run_requests()
    live._apply_inputs()
    assert "payload" in live.message and (handle.value, handle.max) == (0.0, 20.0)


def test_whole_numbers(live):
    """A fraction that a page sends for a whole number is rounded; what is no number is refused by the record."""
    live._restart([Scenario()])
    controls = live._controls
    for path in (("seed",), ("sensing", "encoder_counts"), ("sensing", "pwm_steps"), ("perturbation", "pwm_steps")):
        for value, noted in ((12.6, 13), (float("inf"), float("inf"))):
            visitor_sets(live, controls._inputs[path], value)
            live._run_requests()
            assert live._changed_inputs == {path: noted}
            live._apply_inputs()
            assert (live.message == "") == (value == 12.6), live.message
        assert controls._inputs[path].value == 13


def test_dragging(live):
    """A slider that is dragged makes one event, when it rests; a choice counts at once."""
    live._restart([Scenario()])
    live.session.step()
    path = ("perturbation", "mass_factor")
    with pytest.MonkeyPatch.context() as patch:
        now = time.monotonic()
        for k in range(1, 23):
            patch.setattr(module.time, "monotonic", lambda k=k: now + 0.1 * k)
            visitor_sets(live, live._controls._inputs[path], 1 + k / 100)
            live._run_requests()
            live.refresh()
        assert live.session.saved()[0].events == ()
        patch.setattr(module.time, "monotonic", lambda: now + 2.2 + 0.31)
        live.refresh()
        (event,) = live.session.saved()[0].events
        assert event.perturbation.mass_factor == 1.22
        visitor_sets(live, live._controls._inputs["perturbation", "payload"], 3.0)
        visitor_sets(live, live._controls._inputs["world",], "slope")
        live._run_requests()
        live.refresh()
        assert live.session.start[0].world == "slope" and live.session.start[0].perturbation.payload == 3.0


def test_events_of_the_scenario():
    """A payload that the scenario brings along is drawn when it drops, and until then the page says that it comes."""
    server = Server(port=0)
    drop = Event(time=0.05, perturbation=Perturbation(payload=8.0))
    live = Live([Scenario(events=(drop,))], server)
    (box,) = live._scene.robots._payloads
    for _ in range(4):
        live.session.step()
    live.refresh()
    assert not box.visible and "payload 0 → 8 (to come)" in live._timeline.content
    for _ in range(3):
        live.session.step()
    live.refresh()
    assert box.visible and box.dimensions == pytest.approx((0.2, 0.2, 0.2))
    assert "payload 0 → 8" in live._timeline.content and "to come" not in live._timeline.content
    server.stop()


def test_equal_robots():
    """Two robots with the same controller, one of which may start from a file, have two names and two saved files."""
    server = Server(port=0)
    live = Live([Scenario(seed=1), Scenario(seed=2), Scenario(learner="none")], server)
    assert len(set(live._labels)) == 3
    assert [Scenario.from_dict(tomllib.loads(text)).seed for text in live.saved().values()] == [1, 2, 0]
    server.stop()


def test_stories(live):
    """A button sets a scene with its events; what its sentence promises happens."""
    error, runs = {}, {}
    for name, story in STORIES.items():
        live._tell(name)
        assert (
            live.session.start == [arranged(s) for s in story.scenarios]
            and story.watch in live._story.content
            and live._story.order > live._soft.order  # below the buttons and boxes, or it would move them
            and live.playing
        )
        result = runs[name] = simulate(story.scenarios)
        error[name] = 1e3 * per_lap(result).position_rmse.values  # mm, of the learner and of PID alone
        fails = result.failure.values.tolist()
        assert fails == ["", "lateral error over 1 m" if "load" in name else ""]
    load, battery, ice = error.values()
    assert 20 < load[0, 2:].min() and load[0, 2:].max() < 30 and (np.diff(load[1, :4]) > 0).all()
    assert 4.5 < battery[1, -1] / battery[0, -1] < 5.5 and battery[0, 1:].max() < battery[0, 0]
    assert 4 < ice[0, 1] < ice[1, 1] < 7 and ice[0, -1] < ice[0, 0]
    car, _, slides = runs.values()
    off = np.hypot(slides.longitudinal_error, slides.lateral_error)
    for start, left in ((12, False), (18, True), (24, False), (30, True)):
        half = slice(start, start + 5.99)
        largest = 1e3 * off.sel(time=half).max("time")  # mm
        assert ((10 < largest) & (largest < 15) if left else largest < 3).all()
        assert bool((slides.omega_ref.sel(time=half).mean() > 0) == left)
    alone = car.isel(run=1)
    assert 3 < abs(alone.longitudinal_error).max() < 4 and 36 < alone.failure_time < 37
    assert abs(alone.lateral_error.sel(time=slice(None, 24))).max() < 0.2  # of the push; it fails beyond 1 m
    live._restart([Scenario()])
    assert live._story.content == ""


def test_robots(live):
    """Another robot begins another run, in which the controllers of before follow what it can; no other name does."""
    live._restart([Scenario(prior="model", learner="rls", seed=3), Scenario(learner="none", seed=3)])
    live._press("Payload", "drop payload")
    live._set_soft(True)
    for name, steering in (("racecar", "rigid"), ("turtlebot", "caster"), ("car", "compliant")):
        visitor_sets(live, live._robot, name)
        live._run_requests()
        first, other = live.session.start
        assert (first.robot.path, first.steering, first.seed, live.session.tick) == (name, steering, 3, 0)
        assert (first.feedforward, other.feedforward, first.perturbation) == ("model+rls", "none", Perturbation())
        mass = read_robot(mjcf.load(robot=RobotFile(path=name))).mass
        live._press("Payload", "drop payload")
        assert live.session.state()["perturbation"].payload == pytest.approx(mass / 2, rel=0.05)
        for _ in range(100):
            live.session.step()
        log = live.session.log()
        assert np.hypot(log["longitudinal_error"], log["lateral_error"]).max() < 0.1 and live.message == ""
        live.draw()
        live.refresh()
        assert all(part.cast_shadow for part in live._scene.robots.held)  # of the new robot, too
    live._set_soft(False)
    assert not any(part.cast_shadow for part in live._scene.robots.held)
    live.ask(live._choose_robot, "nosuch")
    live._run_requests()
    assert "not one of the choices" in live.message and live._robot.value == "car"


def test_looking_back(live):
    """The page shows a former moment as it was; from there the session goes on to the bit, and another one can."""
    live._restart([Scenario(), Scenario(learner="none")])
    for tick, event in ((100, "drop payload"), (200, "remove"), (300, None)):
        while live.session.tick < tick:
            live.session.step()
        if event:
            live._press("Payload", event)
    former = live.session.log().copy()
    live._look_back(1.5)
    live.draw()
    live.refresh()
    then, frames = former[150], [frames[live._scene.robots._chassis] for frames in live._scene.robots._frames]
    for frame, row in zip(frames, then, strict=True):
        assert frame.position == pytest.approx([row["x"], row["y"], row["z"]], abs=1e-6)
    assert live._controls._inputs["perturbation", "payload"].value == pytest.approx(10.0) and live._return.visible
    assert live.session.tick == 300 and "1.50 s" in live._status.content and "of 3.00 s" in live._status.content
    for nonsense in (float("nan"), "soon", None):
        live.ask(live._look_back, nonsense)
        live._run_requests()
        assert "not a time" in live.message and live._back == 150
    live._look_back(9.0)
    live.draw()
    assert not live._return.visible and frames[0].position == pytest.approx(live.session.qpos(0)[:3])

    live._look_back(1.5)
    live._note_input(("learner",), "rls")
    live._apply_inputs()
    saved = live.session.saved()
    assert [(s.feedforward, len(s.events)) for s in saved] == [("rls", 1), ("none", 1)] and live.session.tick == 150
    same = live.session.log()[:, 1]
    assert same.tobytes() == np.ascontiguousarray(former[:150, 1]).tobytes()
    live._command("step")
    live._look_back(1.2)
    live._press("Push", "push")
    live._command("play")
    while live.session.tick < 200:
        live.session.step()
    again = simulate(live.session.saved())
    for name in ("x", "theta", "voltage_left", "weight_norm"):
        assert again[name].values[:, :200].tobytes() == np.ascontiguousarray(live.session.log()[name].T).tobytes()
    assert [e.time for e in live.session.added] == [1.0, 1.2]


def test_learning_is_shown(live):
    """The box says whether the learners learn, whoever switched them off and wherever a visitor looks or goes on."""
    live._restart([Scenario(events=(Event(time=0.05, learning=False),))])
    for tick, learning in ((3, True), (7, False), (10, False)):
        while live.session.tick < tick:
            live.session.step()
        live.refresh()
        assert live._learning.value == learning
    live._look_back(0.02)
    assert live._learning.value
    live._look_back(0.08)
    live._command("step")
    assert live.session.tick == 9 and not live._learning.value
    live._command("reset")
    assert live._learning.value


def test_another_run_begins_empty(live):
    """A reset leaves neither estimates of the run before nor the time to which a visitor went."""
    live._restart([Scenario(sensing={"tier": "field"})])
    for _ in range(100):
        live.session.step()
    live.sensors.value = True
    live.refresh()
    live._look_back(0.5)
    assert " mm off" in live._sensed.content and live._plots.time.value == 0.5
    live._command("reset")
    live._command("play")
    live.refresh()
    assert "compiled" in live._status.content  # which the first tick may take seconds for
    live.session.step()
    live.refresh()
    assert "compiled" not in live._status.content and "playing" in live._status.content
    live._command("reset")
    live.refresh()
    assert " mm off" not in live._sensed.content and live._plots.time.value == 0.0


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
    tick = live.session.tick
    live._command("step")
    assert live.session.tick == tick  # time is over


def test_page_without_those_that_have_stopped(live, monkeypatch):
    """The page of the last minute has no robot that stopped before it, which has no place there."""
    monkeypatch.setattr(module, "MAX_SECONDS", 0.1)
    live._restart([Scenario(learner="none", events=(Event(time=0.0, push=(0.0, 5000.0, 0.0)),)), Scenario()])
    while not live.session.failure(0):
        live.session.step()
    assert [run.controller for run in live.shown()] == ["none", "fel"]
    for _ in range(11):
        live.session.step()
    assert [run.controller for run in live.shown()] == ["fel"]
