"""The events of a run: perturbations, pushes, new gains, new references, and learning switched on or off."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

import numpy as np

from mrctl.loop.hierarchy import Hierarchy
from mrctl.physics.plant import Plant
from mrctl.scenario import Event, Scenario
from mrctl.theory.perturbation import Perturbation


class Events:
    """The events of a group of runs, by control tick; `Courses` samples the references that they bring."""

    def __init__(
        self, scenarios: Sequence[Scenario], plant: Plant, hierarchy: Hierarchy, period: float, preview: int
    ) -> None:
        """Perturbs the robots as their scenarios demand, and schedules their events.

        Args:
            scenarios: Scenario of each robot.
            plant: The physics, on which perturbations and pushes act.
            hierarchy: The controllers, whose gains change.
            period: Control period in s.
            preview: Number of control ticks by which the controllers are given a reference ahead.
        """
        self._plant, self._hierarchy, self._period, self._preview = plant, hierarchy, period, preview
        self._sensing = [s.sensing for s in scenarios]
        self._schedule: dict[int, list[tuple[int, Event]]] = defaultdict(list)
        self._references: dict[int, list[tuple[int, Event]]] = defaultdict(list)
        for row, scenario in enumerate(scenarios):
            self.perturb(row, scenario.perturbation)
            self._enter(row, scenario, 0)

    def _enter(self, row: int, scenario: Scenario, tick: int) -> None:
        for event in scenario.schedule:
            self._schedule[tick + event.tick(self._period)].append((row, event))
            if event.reference is not None:
                since = max(tick, tick + event.tick(self._period) - self._preview)
                self._references[since].append((row, event))

    def add(self, event: Event) -> None:
        """Schedules an event for every robot; those of one tick act in the order of their times, as in a new run."""
        tick, due = event.tick(self._period), [(row, event) for row in range(self._plant.size)]
        self._schedule[tick] = sorted(self._schedule[tick] + due, key=lambda entry: entry[1].time)
        if event.reference is not None:
            since = tick - self._preview
            self._references[since] = sorted(self._references[since] + due, key=lambda entry: entry[1].time)

    def restart(self, row: int, scenario: Scenario, tick: int) -> None:
        """Schedules the events of a new scenario for one robot, whose time begins at this tick.

        If some of them perturb the plant, the perturbation of the scenario itself is applied anew.
        """
        self._schedule, self._references = _others(self._schedule, row, tick), _others(self._references, row, tick)
        self._enter(row, scenario, tick)
        if any(event.perturbation for event in scenario.events):
            self.perturb(row, scenario.perturbation)
        else:
            self._hierarchy.set_truth(row, self._plant.truth[row])

    def apply(self, tick: int) -> None:
        """Applies the events of a control tick."""
        for row, event in self._references.get(tick, ()):
            if event.reference is not None:
                self._hierarchy.set_reference(row, event.reference)
        for row, event in self._schedule.get(tick, ()):
            if event.perturbation is not None:
                self.perturb(row, event.perturbation)
            if event.push is not None:
                self._plant.push(row, np.array(event.push), max(1, round(event.push_duration / self._period)))
            if event.kanayama is not None:
                self._hierarchy.set_kanayama(row, event.kanayama)
            if event.pid is not None:
                self._hierarchy.set_pid(row, event.pid)
            if event.learning is not None:
                self._hierarchy.set_learning(row, event.learning)

    def perturb(self, row: int, perturbation: Perturbation) -> None:
        """Replaces the perturbation of one robot from this tick on."""
        sensing = self._sensing[row]
        delay = round(perturbation.control_delay / self._period) + sensing.periods("delay", self._period)
        self._plant.perturb(row, perturbation, delay, sensing.driver, sensing.servo)
        self._hierarchy.set_truth(row, self._plant.truth[row])


def _others(schedule: dict[int, list[tuple[int, Event]]], row: int, tick: int) -> dict[int, list[tuple[int, Event]]]:
    """Returns a schedule from a tick on, without the entries of one robot."""
    coming = {t: [entry for entry in entries if entry[0] != row] for t, entries in schedule.items() if t >= tick}
    return defaultdict(list, coming)
