"""Robots under way, and what was done to them: a session that ran live runs again headless to the bit."""

from __future__ import annotations

from collections.abc import Sequence
from math import ceil, floor
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from mrctl.kernel import Rows
from mrctl.loop.simulation import Simulation, uniform
from mrctl.record import InputError, Record
from mrctl.results.dataset import blank
from mrctl.scenario import Event, Scenario

HOUR = 3600.0  # s of simulated time that a session has room for
ALIKE = ("world", "robot", "steering", "control_period", "physics_step")
# What can change in the middle of a run, by the name of the scenario's field; the rest needs another run.
CHANGEABLE = [name for name in ("perturbation", "kanayama", "pid") if name in Event.model_fields]

AnyRecord = TypeVar("AnyRecord", bound=Record)


class Session:
    """One or more robots in one world, driven by `Simulation.step` alone.

    Attributes:
        start: The scenarios as they were given.
        simulations: Which of the robots, and their simulation.
        tick: Control periods done.
    """

    def __init__(self, scenarios: Sequence[Scenario]) -> None:
        """Stands the robots on their references.

        Args:
            scenarios: A scenario a robot; their laps do not count, a session has room for an hour.

        Raises:
            InputError: As `mrctl.simulate`, or robots that differ in what they must share.
        """
        for name in ALIKE:
            if len({getattr(s, name) for s in scenarios}) > 1:
                raise InputError(f"{name}: robots in one scene must share it")
        self.start = list(scenarios)
        self.period = scenarios[0].control_period
        long = [s.model_copy(update={"laps": max(1, floor(HOUR / s.reference.period))}) for s in scenarios]
        self.simulations = [(rows, Simulation([long[row] for row in rows], threads=1)) for rows in uniform(long)]
        self._place = {row: (sim, k) for rows, sim in self.simulations for k, row in enumerate(rows)}
        self.tick = 0

    @property
    def size(self) -> int:
        """Number of robots."""
        return len(self.start)

    @property
    def time(self) -> float:
        """Simulated time in s."""
        return self.tick * self.period

    @property
    def running(self) -> bool:
        """Whether a robot is left that drives."""
        return any(sim.running for _, sim in self.simulations)

    def step(self) -> None:
        """One control period of every robot."""
        with np.errstate(invalid="ignore", over="ignore"):  # as `simulate`
            for _, sim in self.simulations:
                if sim.running:
                    sim.step()
        self.tick += 1

    def happen(self, **change: Any) -> None:  # noqa: ANN401
        """Lets something happen to every robot at the coming tick.

        Args:
            change: Fields of `Event`.

        Raises:
            InputError: The change is refused; then nothing happened.
        """
        event = Event.from_dict({"time": self.time, **change})
        for _, sim in self.simulations:
            if sim.tick == self.tick:  # not one that has stopped
                sim.add(event)

    def state(self) -> dict[str, Any]:
        """What holds now of what can change: the fields `CHANGEABLE`, and `learning`."""
        return state(max(self.saved(), key=lambda s: len(s.events)), self.time)

    def saved(self) -> list[Scenario]:
        """Scenarios that run again as the robots did, to the end of the lap that they are in."""
        whole = [self._place[row][0].scenarios[self._place[row][1]] for row in range(self.size)]
        return [s.model_copy(update={"laps": max(1, ceil(self.time / s.reference.period - 1e-9))}) for s in whole]

    def log(self, first: int = 0) -> Rows:
        """What was recorded from a tick on, one record of `TICK` a tick and robot; NaN of a robot that has stopped."""
        parts = blank(self.tick - first, self.size)
        for rows, sim in self.simulations:
            done = sim.log.ticks[first : sim.tick]
            parts[: len(done), rows] = done
        return parts

    def qpos(self, row: int) -> NDArray[np.float64]:
        """Generalised position of a robot, `(nq,)`."""
        sim, k = self._place[row]
        return sim.plant.qpos[k]

    def failure(self, row: int) -> str:
        """Why a robot has stopped, or ""."""
        sim, k = self._place[row]
        return sim.plant.failure[k]


def state(scenario: Scenario, time: float) -> dict[str, Any]:
    """What holds at a time of what can change in a run: the fields `CHANGEABLE`, and `learning`."""
    found = {name: getattr(scenario, name) for name in CHANGEABLE} | {"learning": True}
    for event in sorted(scenario.events, key=lambda e: e.time):
        if event.time <= time + 1e-9:
            found |= {name: value for name in found if (value := getattr(event, name)) is not None}
    return found


def changed(record: AnyRecord, path: Sequence[str], value: object) -> AnyRecord:
    """The record with one field changed, however deep.

    Raises:
        InputError: The record refuses it.
    """
    name, *rest = path
    if rest:
        value = changed(getattr(record, name), rest, value)
    fields = {field: getattr(record, field) for field in type(record).model_fields}
    return type(record).from_dict(fields | {name: value})
