"""A live session in the browser: the robot drives, visitors perturb it, and it learns."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
import viser
from typing_extensions import override
from viser._messages import HotkeyKey

from mrctl.kernel import Array, Rows
from mrctl.loop.groups import arranged
from mrctl.loop.timeline import CHANGEABLE, begun, ends, followed, state
from mrctl.navigation.planning import Avoid
from mrctl.physics.files import SHIPPED
from mrctl.record import InputError
from mrctl.results.controllers import CONTROLLER_FIELDS, title_of
from mrctl.scenario import FEEDFORWARDS, FeedforwardName, Scenario
from mrctl.sensing.tiers import Sensing
from mrctl.theory.obstacles import Pose
from mrctl.theory.perturbation import Perturbation
from mrctl.theory.references import Reference
from mrctl.theory.robot import RobotFile
from mrctl.viewer.controls import NEW_RUN_MARK, Controls
from mrctl.viewer.deviation import drawn
from mrctl.viewer.embed import MAX_SECONDS
from mrctl.viewer.hands import Hands
from mrctl.viewer.looks import MAX_MARKED, looks, told_apart
from mrctl.viewer.page import SPEEDS, Page, not_before_the_start
from mrctl.viewer.plots import Plots
from mrctl.viewer.recording import Recording
from mrctl.viewer.requests import asked, buttons, changed, with_robot
from mrctl.viewer.scene import Scene
from mrctl.viewer.score import Metrics
from mrctl.viewer.sensors import FIX_AGE
from mrctl.viewer.server import Server
from mrctl.viewer.session import MAX_TIME, Session, pushed
from mrctl.viewer.stories import STORIES
from mrctl.viewer.words import arrivals, block, gains, timeline, warning

WINDOW = 12.0  # s, time span of the plots
SAMPLES = 200  # about the largest number of samples in a curve; a chart is some 300 pixels wide
TIDY_INTERVAL = 10.0  # s, least time between two returns of freed memory, each of which may take half a second
PLOTS_PER_TRAIL = 3  # updates of the plots for each one of the trails
SLIDER_REST = 0.3  # s of wall time without a change, after which somebody has let a slider go
MAX_BACKLOG = 0.25  # s of wall time that a late loop catches up with; it drops the rest
TOUCH_HINT = "Blue: forces on the wheels, a robot's length for its weight. Red: slip, for a tenth of its top speed."
WATCH_HINT = "A scene with events; below the buttons stands what to watch."
FAN_HINT = "Draws some of the ways that `window` or `mppi` considers, and the one that it chooses."
# What *Save session* writes beside the scenarios of a mission with an avoider.
AVOIDER = '''"""The motion stage of a session: `mrctl run {scenario} --controller motion={avoid}.py:{avoid}`."""

from mrctl.navigation.avoiders import avoiding

{avoid} = avoiding("{avoid}")
'''
KEYS: tuple[HotkeyKey, ...] = ("1", "2", "3", "4")  # of the first button of each group
NO_ARCS = np.zeros((0, 2, 2))
PLANNED_FIELDS = ("world", "steering", "reference")  # fields on which a plan depends
# Fields of a scenario whose change needs a new run, on their own tab; and fields without an input.
NEW_RUN_FIELDS = ("world", "steering", "sensing", "reference", "seed", "prefilter")
HIDDEN_INPUTS = (
    "name",
    "laps",
    "events",
    "obstacles",
    "map",
    "initial_pose",
    "goal",
    "initial_spread",
    "robot",
    "physics_step",
    "control_period",
    "motion_period",
)


class Live(Page):
    """The page of a live session; its loop carries out the requests of visitors between two ticks."""

    def __init__(
        self, scenarios: Sequence[Scenario], server: Server, avoid: Avoid = "none", searched: Array | None = None
    ) -> None:
        """Builds the page and sets the robots on their references.

        Args:
            scenarios: Scenario of each robot; the first one is solid, the others are ghosts.
            server: Server of the page.
            avoid: What keeps robots on a mission from obstacles that the map lacks or that move.
            searched: The arcs of the search for their plan, as of `Plan`.

        Raises:
            InputError: A scenario is refused, as by `Session`.
        """
        super().__init__(server)
        self.session = Session(scenarios, avoid)
        self._searched = NO_ARCS if searched is None else searched
        self.factor = 0.0  # ratio of simulated to wall time in the last second
        self._back: int | None = None  # tick that is shown, while a visitor looks back
        self.late = self.ticks = 0  # ticks that began more than a period too late, and all ticks, at a finite speed
        self._due = 0.0  # number of ticks that are due
        self._changed_inputs: dict[tuple[str, ...], Any] = {}
        self._rested = 0.0  # monotonic time in s at which the changed inputs are applied
        self._shown_setup: tuple[object, ...] | None = None  # what the present scene was drawn for
        self._shown_sensing: list[Sensing] | None = None
        self._drawn: tuple[object, ...] | None = None
        self._plotted: tuple[object, ...] | None = None
        self._plots_since_trail = 0
        self._tidied = time.monotonic()
        self._build()
        self._show_session()

    # -- the page ------------------------------------------------------------------------------------------------

    def _build(self) -> None:
        gui, tabs = self.server.gui, self.server.gui.add_tab_group()
        self._plots = Plots(gui, self.curves)
        self._plots.time.max = MAX_TIME
        self.on(self._plots.time, self._look_back)
        with tabs.add_tab("Drive"):
            self._add_drive(gui)
        self._add_keys()
        self._controls = Controls(gui, partial(self.ask, self._note_input), self.session.robot, CHANGEABLE)
        self._controls.designed = self.session.designed()
        first = self.session.start[0]
        with tabs.add_tab("Robot"):
            self._controls.add(first, only=["perturbation"])
        with tabs.add_tab("Controllers"):
            self._add_controllers(gui, first)
        with tabs.add_tab("Run"):
            self._add_run(gui, first)

    def _add_drive(self, gui: viser.GuiApi) -> None:
        self.on(gui.add_button_group("Watch", tuple(STORIES), hint=WATCH_HINT), self._tell)
        self._status = gui.add_html("")
        self._play = gui.add_button_group("", ("play", "pause", "step", "reset"))
        self.on(self._play, self._command)
        self._return = gui.add_button("Return to the present", visible=False)
        self.on(self._return, lambda _: self._look_back(self.session.time))
        speed = gui.add_dropdown("Speed", tuple(SPEEDS), initial_value="1×")
        self.on(speed, self.choose_speed)
        self.add_cameras()
        self._follow = gui.add_checkbox("Camera follows", False, hint="The first robot stays in the middle.")
        for label, choices in buttons(self.session.robot).items():
            group = gui.add_button_group(label, tuple(choices))
            self.on(group, partial(self._press, label))
        self._hands = Hands(self, self._command, self._go_on, self._apply_event, self._head_for, self._look_back)
        self._fan = gui.add_checkbox("Avoider", self.session.avoid != "none", hint=FAN_HINT)
        self._touch = gui.add_checkbox("Contact forces", False, hint=TOUCH_HINT)
        self._tree = gui.add_checkbox("Search", False, hint="Draws the arcs that the search for the plan drove.")
        self.on(self._tree, lambda _: self._show_search())
        self.add_drawing()
        self._story = gui.add_html("")  # below all buttons, which it would move
        self._timeline = gui.add_html("")
        save = gui.add_button("Save session", icon=viser.Icon.DOWNLOAD, hint="A scenario that repeats it exactly.")

        @save.on_click
        async def _(event: viser.GuiEvent) -> None:
            self.ask(self._save, event.client)

        self.add_download()

    def _add_keys(self) -> None:
        self.add_key("space", "Play or pause", lambda: self._command("pause" if self.playing else "play"))
        self.add_key("N", "Step", lambda: self._command("step"))
        self.add_key("R", "Reset", lambda: self._command("reset"))
        self.add_key("F", "Camera follows", lambda: setattr(self._follow, "value", not self._follow.value))
        for key, (group, choices) in zip(KEYS, buttons(self.session.robot).items(), strict=True):
            self.add_key(key, next(iter(choices)).capitalize(), partial(self._press, group, next(iter(choices))))
        self.add_key("G", "Set a goal", self._hands.await_goal)
        self.add_key("P", "Draw a way", self._hands.draw_way)

    def _add_controllers(self, gui: viser.GuiApi, first: Scenario) -> None:
        gui.add_html(
            block("anew", f"A change of an input with{NEW_RUN_MARK} begins another run; the others act at once.")
        )
        self._controls.add(first, only=CONTROLLER_FIELDS)
        with gui.add_folder("compare with" + NEW_RUN_MARK):
            self._ghosts: dict[FeedforwardName, viser.GuiCheckboxHandle] = {
                name: gui.add_checkbox(title_of(name), False) for name in FEEDFORWARDS
            }
            for name, ghost in self._ghosts.items():
                self.on(ghost, partial(self._compare, name))
        self._learning = gui.add_checkbox("learning", True)
        self.on(self._learning, lambda on: self._apply_event(learning=on))
        self._gains = gui.add_html("")
        elsewhere = *HIDDEN_INPUTS, *NEW_RUN_FIELDS, "perturbation", *CONTROLLER_FIELDS
        self._controls.add(first, only=[name for name in Scenario.model_fields if name not in elsewhere])

    def _add_run(self, gui: viser.GuiApi, first: Scenario) -> None:
        self._robots = {robot.path: robot for robot in (*(RobotFile(path=p) for p in SHIPPED), first.robot)}
        gui.add_html(block("all-anew", f"A change of any of these inputs begins another run ({NEW_RUN_MARK.strip()})."))
        hint = "Another robot begins another run, with the steering and a reference that suit it."
        names, now = tuple(self._robots), first.robot.path
        self._robot = gui.add_dropdown("robot" + NEW_RUN_MARK, names, initial_value=now, hint=hint)
        self.on(self._robot, self._choose_robot)
        self._controls.add(first, only=NEW_RUN_FIELDS)

    def _show_session(self) -> None:
        """Shows the robots of a new session in the scene and in the plots."""
        session, first = self.session, self.session.start[0]
        self._labels = told_apart([s.name or title_of(s.feedforward) for s in session.start], range(session.size))
        robots = looks(self._labels, [s.feedforward for s in session.start])
        setup = (first.world, first.obstacles, first.robot, first.steering, robots)
        if self._shown_setup != setup:
            if self._shown_setup is not None:
                self._scene.remove()
            self._shown_setup = setup
            self._scene = Scene(self.server, session.simulations[0][1].model, robots, first.obstacles)
            self._plots.set_robots(robots, session.period, bool(first.obstacles.shapes))
        sensing = [s.sensing for s in session.start]
        if self._shown_sensing != sensing:
            self._shown_sensing = sensing
            spread = max(np.inf if s.source == "odometry" else s["fix_position_noise"] for s in sensing)
            self.set_marks(any(s.source != "truth" for s in sensing), spread)
        watch = [story.watch for story in STORIES.values() if [arranged(s) for s in story.scenarios] == session.start]
        self._story.content = block("story", *watch) if watch else ""
        self._latencies = [s.periods("fix_latency", session.period) for s in sensing]
        self._scene.show_references([first])
        self._scene.forget_trails()
        self._hands.begin(self._scene, session)
        self._controls.hide(
            [*(() if session.tunable else ["kanayama"]), *(PLANNED_FIELDS if session.avoid != "none" else ())]
        )
        self._fan.visible = session.avoid in ("window", "mppi")
        self._show_search()
        for name, ghost in self._ghosts.items():
            ghost.value = any(s.feedforward == name for s in session.start[1:])
        self._robot.value = first.robot.path
        self._drawn = self._plotted = None
        self.describe_estimates([], session.log(0, 0))  # in place of those of the run before
        self._plots.time.value = self.time
        self._way: Reference | None = None  # that a visitor has brought, as drawn
        self._deviation = 1  # factor on the deviations from the reference in the picture
        self._metrics = Metrics(session.robot, session.period)
        self._counted = (time.monotonic(), session.tick)
        self._happened = 0  # number of the scenarios' events that have happened
        self._describe()

    # -- requests of visitors, carried out by the loop --------------------------------------------------------------

    @override
    def ask(self, action: Callable[..., None], *arguments: Any) -> None:
        """Queues an action for the loop; inputs that were changed before it are applied before it."""
        if action != self._note_input:
            super().ask(self._apply_inputs)
        super().ask(action, *arguments)

    def _command(self, name: str) -> None:
        if name == "reset":
            self._back = None
            self._restart(self.session.start)
        elif name == "step":
            self._go_on()
            self.playing = False
            if self.session.running:
                self.session.step()
        elif name == "play":
            self._go_on()
            self.playing = self.session.running
        else:
            self.playing = False

    @property
    def tick(self) -> int:
        """Number of control periods before the moment that is shown."""
        return self.session.tick if self._back is None else self._back

    @property
    def time(self) -> float:
        """Time that is shown in s."""
        return self.tick * self.session.period

    def _look_back(self, time: float) -> None:
        """Shows the session at an earlier time in s and pauses; at the present time, or later, shows the present."""
        tick = round(not_before_the_start(time) / self.session.period)
        self._back = tick if tick < self.session.tick else None
        self._return.visible = self._back is not None
        self._hands.forget()
        self._plots.time.value = self.time  # else a second click there would change nothing
        self.playing = False
        self._describe()

    def _go_on(self) -> None:
        """Lets the session go on from where a visitor looks back to, as if nothing had happened since."""
        if self._back is not None:
            self._restart(self.session.start)

    def _tell(self, name: str) -> None:
        if name not in STORIES:
            raise InputError(f"{name}: not one of the choices")
        self._begin(STORIES[name].scenarios)
        self.playing = True

    def _head_for(self, goal: Pose) -> None:
        """Sets a goal, x and y in m and θ in rad."""
        try:
            self._searched = self.session.head_for(goal).searched
            self._show_search()
        finally:
            self._describe()

    def _show_search(self) -> None:
        self._tree.visible = len(self._searched) > 0
        self._scene.navigation.show_search(self._searched if self._tree.value else NO_ARCS)

    @override
    def choose_speed(self, name: str) -> None:
        super().choose_speed(name)
        self._due = 0.0

    def _press(self, group: str, name: str) -> None:
        choices = buttons(self.session.robot)[group]
        if name not in choices:
            raise InputError(f"{name}: not one of the choices")
        self._go_on()
        change = choices[name]
        if "push" in change:
            return self._apply_event(**change)
        now: Perturbation = self.session.state()["perturbation"]
        self._apply_event(perturbation=now.model_copy(update=change))

    def _apply_event(self, **change: Any) -> None:  # noqa: ANN401
        self._go_on()
        self.session.apply(**change)
        self._describe()

    def _note_input(self, path: tuple[str, ...], value: Any) -> None:  # noqa: ANN401
        """Notes the value of an input; while a slider is dragged, only the value counts at which it rests."""
        self._changed_inputs[path] = value
        self._rested = time.monotonic() + (SLIDER_REST if isinstance(value, float) else 0.0)

    def _apply_inputs(self) -> None:
        """Applies the noted inputs: as an event if the field can change during a run, otherwise in a new run."""
        inputs, self._changed_inputs = self._changed_inputs, {}
        for path, value in inputs.items():
            try:
                self._apply(path, value)
            except InputError as error:
                self.complain(error)
                self._controls.show(self._now())

    def _apply(self, path: tuple[str, ...], value: Any) -> None:  # noqa: ANN401
        name = path[0]
        if name in PLANNED_FIELDS and self.session.avoid != "none":
            raise InputError(
                f"{name}: with --avoid {self.session.avoid} the robots take another goal, but no other {name}"
            )
        path, value = asked(path, value, self.session.period)
        if name in CHANGEABLE:
            self._go_on()
            return self._apply_event(**{name: changed(self.session.state()[name], path[1:], value)})
        start = self.session.start
        touched = start[:1] if name in CONTROLLER_FIELDS else start
        others = start[len(touched) :]
        new = [changed(self._present(s), path, value) for s in touched] + [self._present(s) for s in others]
        if name in CONTROLLER_FIELDS:
            new[0] = new[0].model_copy(update={"learned": None})  # which another learner cannot start from
            new = [new[0], *(s for s in new[1:] if s.feedforward != new[0].feedforward)]
        self._restart(new)

    def _present(self, scenario: Scenario) -> Scenario:
        """Returns a scenario of the start with the present values of the fields that events have changed.

        While a visitor looks back it is the scenario itself, since another run repeats the events until then.
        """
        now = self.session.state() if self._back is None else {}
        return scenario.model_copy(update={name: now[name] for name in CHANGEABLE if name in now})

    def _now(self) -> Scenario:
        """Returns the first robot's scenario with the values that hold at the moment that is shown."""
        now = self.session.state(self.time)
        return self.session.start[0].model_copy(update={name: now[name] for name in CHANGEABLE})

    def _compare(self, name: FeedforwardName, wanted: bool) -> None:
        first, *ghosts = map(self._present, self.session.start)
        if wanted and name == first.feedforward:
            self._ghosts[name].value = False
            raise InputError(f"compare with: {title_of(name)} drives already, as the first robot")
        ghosts = [s for s in ghosts if s.feedforward != name]
        if wanted:
            ghosts.append(first.with_feedforward(name))
        self._restart([first, *ghosts])

    def _choose_robot(self, name: str) -> None:
        """Begins another run with another robot, in its steering and on a reference that suit it."""
        if name not in self._robots:
            raise InputError(f"{name}: not one of the choices")
        try:
            self._begin([with_robot(s, self._robots[name]) for s in self.session.start])
        finally:
            self._robot.value = self.session.start[0].robot.path

    def _begin(self, scenarios: Sequence[Scenario]) -> None:
        """Begins a run that has nothing of the one before, nor of a mission."""
        session = Session(scenarios)
        self._searched = NO_ARCS
        self._take(session)

    def _restart(self, scenarios: Sequence[Scenario]) -> None:
        """Begins another run; while a visitor looks back, drives it up to there, with the events until then."""
        if self._back is None:
            self._take(Session(scenarios, self.session.avoid))
        else:
            self._take(self.session.repeated(scenarios, self._back, self._tell_progress()))

    def _take(self, session: Session) -> None:
        """Puts a session in the place of the one before."""
        self.session, self._back = session, None
        self._return.visible = False
        if time.monotonic() > self._tidied + TIDY_INTERVAL:
            self._tidied = time.monotonic()
            _tidy()
        self.message = ""
        self._show_session()

    def _tell_progress(self) -> Callable[[int], None]:
        """Returns what `Session.repeated` calls, which says on the page how far it is."""
        total, done, last = self.tick * len(self.session.start), 0, time.monotonic()

        def tell(robots: int) -> None:
            nonlocal done, last
            done += robots
            if (now := time.monotonic()) > last + 0.5:
                last = now
                self._status.content = block("status", f"driving again up to {self.time:.2f} s: {done / total:.0%}")

        return tell

    def _save(self, client: viser.ClientHandle) -> None:
        if client.client_id not in self.server.get_clients():
            return  # the visitor has left in the meantime
        for name, content in self.saved().items():
            client.send_file_download(name, content.encode(), save_immediately=True)

    def saved(self) -> dict[str, str]:
        """Returns the files that repeat the session, by name: a scenario for each robot, and the avoider, if any."""
        session = self.session
        names = told_apart([s.name or s.feedforward for s in session.start], range(session.size))
        files = {f"session-{n}.toml": s.to_toml() for n, s in zip(names, session.saved(), strict=True)}
        if session.avoid != "none":
            files[f"{session.avoid}.py"] = AVOIDER.format(avoid=session.avoid, scenario=next(iter(files)))
        return files

    @override
    def shown(self) -> list[Recording]:
        if self.session.tick < 2:
            raise InputError("download: nothing has happened yet")
        result = self.session.result(max(0, self.session.tick - round(MAX_SECONDS / self.session.period)))
        found = [Recording(result.isel(run=row)) for row in range(self.session.size)]
        return [run for run in found if np.isfinite(run.log["x"][0])]  # the others had stopped before

    # -- the loop ----------------------------------------------------------------------------------------------------

    @override
    def advance(self, elapsed: float, until: float) -> None:
        session = self.session
        if self.speed == float("inf"):
            self._due = 0.0
            while session.running and time.monotonic() < until:
                session.step()
        else:
            pace = self.speed / session.period
            self._due = min(self._due + elapsed * pace, max(1.0, MAX_BACKLOG * pace))
            while self._due >= 1 and session.running and time.monotonic() < until:
                self.late += self._due > 1 + self.speed
                session.step()
                self._due -= 1
                self.ticks += 1
        if not session.running:
            self.playing = False

    @override
    def idle_time(self) -> float:
        return (1 - self._due) * self.session.period / self.speed

    @override
    def draw(self) -> None:
        session, (marked, magnified), tick = self.session, self.marks, self.tick
        fan, touch = (box.value and self._back is None for box in (self._fan, self._touch))
        now = tick, self._back, touch, self._follow.value, marked, magnified, self._deviation, fan, self._hands.pull
        if now == self._drawn:
            return
        self._drawn = now
        for row in range(session.size):
            self._scene.robots.show(row, self._qpos(row))
        logs, scans = [], []
        if marked:
            scans = [session.scan(row) for row in range(min(session.size, MAX_MARKED))] if self._back is None else []
            ticks = round(FIX_AGE / session.period) + max(self._latencies)
            logs = list(session.log(max(0, tick - ticks), tick).T)
        with self.server.atomic():
            if session.tick:
                self._scene.show_targets(self._record(), self._deviation)
            self._scene.show_obstacles(self.time)
            self._scene.show_sensors(logs, session.period, self._latencies, magnified)
            self._scene.navigation.show_scans(scans)
            push = pushed(session.fullest, self.time)
            for row in range(session.size):
                force = push if row or self._hands.pull is None else np.array(self._hands.pull)
                self._scene.arrows.show_force(row, force)
            shown = range(min(session.size, MAX_MARKED) if fan else 0)
            touching = range(min(session.size, MAX_MARKED) if touch and session.tick else 0)
            self._scene.arrows.show_contacts([session.contacts(row) for row in touching])
            self._scene.navigation.show_considered([session.considered(row) for row in shown])
            self._scene.flush(self._follow.value)
        self.chase()

    def _record(self) -> Rows:
        """Returns a record of `TICK` of each robot: the last one, or that of the moment that is shown."""
        tick = self.session.tick - 1 if self._back is None else self._back
        return self.session.log(tick, tick + 1)[0]

    def _qpos(self, row: int) -> Array:
        """Returns the generalised position of a robot at the moment that is shown; one that has stopped stays."""
        if self._back is None or not np.isfinite(self._record()["x"][row]):
            return self.session.qpos(row)
        return Recording(self.session.result(self._back, self._back + 1).isel(run=row)).qpos(0)

    @override
    def refresh(self) -> None:
        session, now = self.session, time.monotonic()
        if self._changed_inputs and now >= self._rested:
            self._apply_inputs()
            session = self.session
        since, tick = self._counted
        if now - since >= 1:
            self.factor = (session.tick - tick) * session.period / (now - since)
            self._counted = now, session.tick
        self._status.content = block("status", *self._status_lines())
        happened = sum(event.time <= self.time for scenario in session.saved() for event in scenario.events)
        happened += session.oscillations
        if happened != self._happened:  # such as those that the scenarios brought along
            self._happened = happened
            self._describe()
        still = self._back is not None or not self.playing
        self._metrics.update([session.fullest], session.log, self.tick, exact=still)
        past = session.tick, self._back, self.playing, self.deviation.value  # a pause draws what was left out before it
        if past != self._plotted:
            self._plotted = past
            self._show_past()
        if session.tick:
            now = self._record()
            self.describe_estimates(self._labels, now)
            self._plots.score(now, self._metrics, session.parameter_error(), f"at {session.time:.0f} s")

    def _status_lines(self) -> list[str]:
        """Returns what the page says of the session: time, lap and pace, who has stopped and why, and who arrived."""
        doing = "playing" if self.playing else "paused" if self.session.running else "finished; reset starts again"
        if self.playing and not self.session.tick:
            doing = "starting; laws that are new are compiled"
        if self._back is not None:
            doing = f"of {self.session.time:.2f} s; whatever you do goes on from here"
        lap = "" if self._ends is not None else f" · lap {self._lap()}"
        factor = f" · {self.factor:.2f}×" if self.playing else ""  # in one line, or it would move the buttons
        lines = [f"<b>{self.time:.2f} s</b>{lap} · {doing}{factor}"]
        for row, label in enumerate(self._labels):
            stopped = self._back is None or not np.isfinite(self._record()["x"][row])
            if stopped and (reason := self.session.failure(row)):
                lines.append(warning(f"{label} stopped: {reason}"))
        if self.session.tick:
            lines += arrivals(self._labels, self._record(), [self._ends] * self.session.size)
        return lines

    def _lap(self) -> int:
        """Returns the number of the present lap on the present reference."""
        driven = self.session.fullest
        return 1 + int((self.time - begun(driven, self.time)) / followed(driven, self.time).period + 1e-9)

    def _show_past(self) -> None:
        """Draws the last seconds, or those around the moment that is shown: curves, and trails, which change less."""
        session = self.session
        ticks = round(WINDOW / session.period)
        step = max(1, ticks // SAMPLES)
        last = session.tick if self._back is None else min(session.tick, max(self._back + ticks // 2, ticks))
        first = max(0, last - ticks) // step * step
        log = session.log(first, last)
        if len(log) < 2:
            return self._plots.clear(WINDOW, self._metrics)
        times = np.arange(first, first + len(log), dtype=float) * session.period
        near = session.clearance(first)
        self._plots.show(times, log, None if near is None else near[: len(log)], step, self._event_times())
        self._plots.point(None if self._back is None else (self._back - first) / ((len(log) - 1) // step * step))
        self._plots_since_trail += 1
        if self._plots_since_trail >= PLOTS_PER_TRAIL or not self.playing:
            self._plots_since_trail = 0
            every = -(-ticks // (self._scene.trail_points - 2))
            marked = last // every * every - every * np.arange(self._scene.trail_points - 1)[::-1]
            rows = np.clip(np.append(marked, last - 1) - first, 0, len(log) - 1)  # the same moments in every picture
            self._deviation = self.magnified_deviation(log)
            self._hands.trail = first + rows, drawn(log[rows], self._deviation)
            self._scene.show_trails(log[rows], self._deviation)

    def _event_times(self) -> list[float]:
        """Returns the times of the events until now in s."""
        events = {event.time for scenario in self.session.saved() for event in scenario.events}
        return sorted(time for time in events if time <= self.time)

    def _describe(self) -> None:
        """Writes the timeline, marks the events on the track, and sets the inputs to the present values."""
        scenario = self.session.fullest
        lines = timeline(scenario, self.time)
        self._timeline.content = block("timeline", *(reversed(lines[-50:]) if lines else ["no events yet"]))
        driven = self.session.driven()
        ticks = np.minimum(np.round(np.array(self._event_times()) / self.session.period).astype(int), len(driven) - 1)
        self._scene.show_events(driven[ticks[ticks >= 0]])
        soon = self.time + self.session.preview * self.session.period
        self._ends = ends(scenario, soon)
        self._scene.navigation.show_ends([] if self._ends is None else [self._ends])
        way = followed(scenario, soon)
        if way != self._way and any(event.reference for event in self.session.added):
            self._way = way
            self._scene.draw_references([way])
        for row, saved in enumerate(self.session.saved()):
            self._scene.robots.show_payload(row, state(saved, self.time)["perturbation"])
        self._controls.designed = self.session.designed()
        self._controls.suit(self.session.robot)
        self._controls.show(self._now())
        self._learning.value = self.session.state(self.time)["learning"]
        self._gains.content = block("gains", *gains(self.session))


def _tidy() -> None:
    """Returns the memory of old sessions to the system; glibc would keep the gaps between models, which add up."""
    gc.collect()
    with contextlib.suppress(OSError, AttributeError):  # another C library
        ctypes.CDLL(None).malloc_trim(0)
