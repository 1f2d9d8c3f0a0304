"""A live session in the browser: drive, break the robot, watch it learn."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import html
import time
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import viser
from typing_extensions import override

from mrctl.record import InputError
from mrctl.scenario import FEEDFORWARDS, Event, FeedforwardName, Scenario
from mrctl.theory.perturbation import Perturbation
from mrctl.viewer.controls import Controls
from mrctl.viewer.page import SPEEDS, Page, block, warning, write
from mrctl.viewer.plots import Plots
from mrctl.viewer.scene import Scene
from mrctl.viewer.server import Server
from mrctl.viewer.session import CHANGEABLE, Session, changed

WINDOW = 12.0  # s that the plots show
SAMPLES = 300  # in a curve
TIDY = 10.0  # s at least between two times that freed memory is handed back, which may take half a second
UNMARKED = 3  # plots for each point of the trails
BEHIND = 0.25  # s of wall time that are caught up with; what is more is lost
# What the buttons do to the robots: label of the group, button, change of the perturbation or a push.
BUTTONS: dict[str, dict[str, dict[str, Any]]] = {
    "Payload": {"drop payload": {"payload": 10.0, "payload_x": 0.05, "payload_y": 0.06}, "remove": {"payload": 0.0}},
    "Supply": {"sag supply": {"supply_factor": 0.7}, "restore": {"supply_factor": 1.0}},
    "Floor": {"slippery patch": {"tyre_friction_factor": 0.15}, "dry": {"tyre_friction_factor": 1.0}},
    "Push": {"push": {"push": (0.0, 60.0, 0.0)}, "spin": {"push": (0.0, 0.0, 15.0)}},
}
RUN = ("world", "steering", "reference", "measurement", "seed", "prefilter")
HIDDEN = (
    "name",
    "laps",
    "events",
    "initial_pose",
    "initial_spread",
    "robot",
    "physics_step",
    "control_period",
    "motion_period",
)


class Live(Page):
    """The page of a live session: between two ticks, its loop does what visitors have asked for."""

    def __init__(self, scenarios: Sequence[Scenario], server: Server) -> None:
        """Builds the page and stands the robots on their references.

        Args:
            scenarios: A scenario a robot, the first one solid, the others ghosts.
            server: Where the page is served.

        Raises:
            InputError: As `Session`.
        """
        super().__init__(server)
        self.session = Session(scenarios)
        self.factor = 0.0  # simulated time over wall time, of the last second
        self.late = self.ticks = 0  # ticks that began over a period after they were due, and all at a finite speed
        self._owed = 0.0  # ticks that are due
        self._wishes: dict[tuple[str, ...], Any] = {}
        self._cast: tuple[object, ...] | None = None  # what the scene was built for
        self._drawn: tuple[int, bool] | None = None
        self._plotted: int | None = None
        self._unmarked = 0
        self._tidied = time.monotonic()
        self._build()
        self._stage()

    # -- the page ------------------------------------------------------------------------------------------------

    def _build(self) -> None:
        gui, tabs = self.server.gui, self.server.gui.add_tab_group()
        self._plots = Plots(gui, self.curves)
        with tabs.add_tab("Drive"):
            self._status = gui.add_html("")
            self._play = gui.add_button_group("", ("play", "pause", "step", "reset"))
            self.on(self._play, self._command)
            speed = gui.add_dropdown("Speed", tuple(SPEEDS), initial_value="1×")
            self.on(speed, lambda name: self._set_speed(SPEEDS[name]))
            self._follow = gui.add_checkbox("Camera follows", False, hint="The first robot stays in the middle.")
            for label, choices in BUTTONS.items():
                group = gui.add_button_group(label, tuple(choices))
                self.on(group, partial(self._press, choices))
            self._timeline = gui.add_html("")
            save = gui.add_button("Save session", icon=viser.Icon.DOWNLOAD, hint="A scenario that repeats it exactly.")

            @save.on_click
            async def _(event: viser.GuiEvent) -> None:
                self.ask(self._save, event.client)

        self._controls = Controls(gui, partial(self.ask, self._wish))
        first, changing = self.session.start[0], [name for name in Scenario.model_fields if name not in HIDDEN]
        with tabs.add_tab("Robot"):
            self._controls.add(first, only=["perturbation"])
        with tabs.add_tab("Controllers"):
            self._controls.add(first, only=["feedforward"])
            with gui.add_folder("compare with"):
                self._ghosts: dict[FeedforwardName, viser.GuiCheckboxHandle] = {
                    name: gui.add_checkbox(name, False) for name in FEEDFORWARDS
                }
                for name, ghost in self._ghosts.items():
                    self.on(ghost, partial(self._compare, name))
            self._learning = gui.add_checkbox("learning", True)
            self.on(self._learning, lambda on: self._happen(learning=on))
            self._controls.add(first, only=[n for n in changing if n not in (*RUN, "perturbation", "feedforward")])
        with tabs.add_tab("Run"):
            self._controls.add(first, only=RUN)

    def _stage(self) -> None:
        """Puts the robots of the session into the scene and the plots."""
        session, first = self.session, self.session.start[0]
        labels = [s.name or s.feedforward for s in session.start]
        cast = (first.world, first.robot, first.steering, labels)
        if self._cast != cast:
            if self._cast is not None:
                self._scene.remove()
            self._cast = cast
            self._scene = Scene(self.server, session.simulations[0][1].model, labels)
            self._plots.cast(labels, session.period)
        self._scene.show_reference(first)
        self._scene.forget_trails()
        self._controls.show(first)
        for name, ghost in self._ghosts.items():
            ghost.value = any(s.feedforward == name for s in session.start[1:])
        self._drawn = self._plotted = None
        self._counted = (time.monotonic(), session.tick)
        self._describe()

    # -- what visitors ask for, carried out by the loop -------------------------------------------------------------

    def _command(self, name: str) -> None:
        if name == "reset":
            self._restart(self.session.start)
        elif name == "step":
            self.playing = False
            self.session.step()
        else:
            self.playing = name == "play" and self.session.running

    def _set_speed(self, speed: float) -> None:
        self.speed, self._owed = speed, 0.0

    def _press(self, choices: dict[str, dict[str, Any]], name: str) -> None:
        change = choices[name]
        if "push" in change:
            return self._happen(**change)
        now: Perturbation = self.session.state()["perturbation"]
        self._happen(perturbation=now.model_copy(update=change))

    def _happen(self, **change: Any) -> None:  # noqa: ANN401
        self.session.happen(**change)
        self._describe()

    def _wish(self, path: tuple[str, ...], value: Any) -> None:  # noqa: ANN401
        """Remembers what an input was set to; while it is dragged, the last value counts."""
        self._wishes[path] = value

    def _grant(self) -> None:
        """Does what the inputs were set to: an event where that can be, another run where not."""
        wishes, self._wishes = self._wishes, {}
        for path, value in wishes.items():
            try:
                self._apply(path, value)
            except InputError as error:
                self.complain(error)
                self._controls.show(self._present(self.session.start[0]))

    def _apply(self, path: tuple[str, ...], value: Any) -> None:  # noqa: ANN401
        name, *rest = path
        if path == ("perturbation", "control_delay"):  # in whole control periods
            value = round(value / self.session.period) * self.session.period
        if path == ("reference",):
            value = {"kind": value}
        if name in CHANGEABLE:
            return self._happen(**{name: changed(self.session.state()[name], rest, value)})
        start = self.session.start
        touched = start[:1] if name == "feedforward" else start
        others = start[len(touched) :]
        new = [changed(self._present(s), path, value) for s in touched] + [self._present(s) for s in others]
        new = [new[0], *(s for s in new[1:] if name != "feedforward" or s.feedforward != value)]
        self._restart(new)

    def _present(self, scenario: Scenario) -> Scenario:
        """A scenario that starts as things are now."""
        state = self.session.state()
        return scenario.model_copy(update={name: state[name] for name in CHANGEABLE})

    def _compare(self, name: FeedforwardName, wanted: bool) -> None:
        first, *ghosts = map(self._present, self.session.start)
        ghosts = [s for s in ghosts if s.feedforward != name]
        if wanted and name != first.feedforward:
            ghosts.append(first.model_copy(update={"feedforward": name, "name": ""}))
        self._restart([first, *ghosts])

    def _restart(self, scenarios: Sequence[Scenario]) -> None:
        self.session = Session(scenarios)
        if time.monotonic() > self._tidied + TIDY:
            self._tidied = time.monotonic()
            _tidy()
        self.message = ""
        self._learning.value = True
        self._stage()

    def _save(self, client: viser.ClientHandle) -> None:
        if client.client_id not in self.server.get_clients():
            return  # left meanwhile
        for scenario in self.session.saved():
            name = f"session-{scenario.name or scenario.feedforward}.toml"
            client.send_file_download(name, scenario.to_toml().encode(), save_immediately=True)

    # -- the loop ----------------------------------------------------------------------------------------------------

    @override
    def advance(self, elapsed: float, until: float) -> None:
        session = self.session
        if self.speed == float("inf"):
            self._owed = 0.0
            while session.running and time.monotonic() < until:
                session.step()
        else:
            pace = self.speed / session.period
            self._owed = min(self._owed + elapsed * pace, max(1.0, BEHIND * pace))
            while self._owed >= 1 and session.running and time.monotonic() < until:
                self.late += self._owed > 1 + self.speed
                session.step()
                self._owed -= 1
                self.ticks += 1
        if not session.running:
            self.playing = False

    @override
    def rest(self) -> float:
        return (1 - self._owed) * self.session.period / self.speed

    @override
    def draw(self) -> None:
        session, now = self.session, (self.session.tick, self._follow.value)
        if now == self._drawn:
            return
        self._drawn = now
        for row in range(session.size):
            self._scene.show(row, session.qpos(row))
        with self.server.atomic():
            self._scene.flush(self._follow.value)

    @override
    def refresh(self) -> None:
        self._grant()
        session, now = self.session, time.monotonic()
        since, tick = self._counted
        if now - since >= 1:
            self.factor = (session.tick - tick) * session.period / (now - since)
            self._counted = now, session.tick
        state = "playing" if self.playing else "paused" if session.running else "over: reset starts anew"
        lap = 1 + int(session.time / session.start[0].reference.period)
        factor = f" · {self.factor:.2f}× real time" if self.playing else ""
        lines = [f"<b>{session.time:.2f} s</b> · lap {lap} · {state}{factor}"]
        for row, scenario in enumerate(session.start):
            if reason := session.failure(row):
                lines.append(warning(f"{scenario.name or scenario.feedforward} stopped: {reason}"))
        if self.message:
            lines.append(warning(self.message))
        write(self._status, block("status", *lines))
        if session.tick != self._plotted and session.tick > 1:
            self._plotted = session.tick
            self._unmarked += 1
            if self.playing and self._unmarked >= UNMARKED:
                self._unmarked = 0
                self._scene.mark_trails()
            ticks = round(WINDOW / session.period)
            step = max(1, ticks // SAMPLES)
            first = max(0, session.tick - ticks) // step * step
            log = session.log(first)
            times = np.arange(first, first + len(log), dtype=float) * session.period
            self._plots.show(times, log, step)

    def _describe(self) -> None:
        """Writes the timeline, and sets the inputs to what holds now."""
        scenario = max(self.session.saved(), key=lambda s: len(s.events))
        before: dict[str, Any] = {name: getattr(scenario, name) for name in CHANGEABLE}
        lines = []
        for event in sorted(scenario.events, key=lambda e: e.time):
            lines.append(f"<b>{event.time:.2f} s</b> {html.escape(_what(event, before))}")
            before |= {n: v for n in CHANGEABLE if (v := getattr(event, n)) is not None}
        write(self._timeline, block("timeline", *(reversed(lines[-50:]) if lines else ["nothing has happened yet"])))
        state = self.session.state()
        self._scene.show_payload(state["perturbation"])
        for name in CHANGEABLE:
            self._controls.show(state[name], (name,))


def _tidy() -> None:
    """Hands the memory of the session before back; glibc would keep the gaps between its models, and they add up."""
    gc.collect()
    with contextlib.suppress(OSError, AttributeError):  # another C library
        ctypes.CDLL(None).malloc_trim(0)


def _what(event: Event, before: dict[str, Any]) -> str:
    """An event in words."""
    parts = []
    for name in CHANGEABLE:
        if (new := getattr(event, name)) is not None:
            parts += [
                f"{field.replace('_', ' ')} {getattr(before[name], field):g} → {getattr(new, field):g}"
                for field in type(new).model_fields
                if getattr(new, field) != getattr(before[name], field)
            ]
    if event.reference is not None:
        parts.append(f"now along a {event.reference.kind.replace('_', ' ')}")
    if event.push is not None:
        parts.append("push {:g} N, {:g} N, {:g} N·m".format(*event.push))
    if event.learning is not None:
        parts.append("learning on" if event.learning else "learning off")
    return ", ".join(parts) or "no change"
