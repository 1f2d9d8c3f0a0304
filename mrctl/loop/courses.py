"""The references of a group of scenarios, sampled at each control tick."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from mrctl.kernel import Array, Rows
from mrctl.record import InputError
from mrctl.scenario import Scenario

SAMPLED_TICKS = 10_000  # control ticks whose references are sampled at once
MAX_START_DISTANCE = 0.8  # m, largest distance between robot and reference at the start

REFERENCE = np.dtype(
    [
        ("pose", "f8", 3),  # reference x and y in m, θ in rad
        ("twist", "f8", 2),  # reference V in m/s and θ̇ in rad/s
        ("acceleration", "f8", 2),  # their derivatives, m/s² and rad/s²
    ]
)


def course(scenario: Scenario, ticks: range) -> Rows:
    """Returns the reference of a scenario, with the events that change it, one record of `REFERENCE` for each tick."""
    period = scenario.control_period
    samples = np.hstack(scenario.reference.sample(period * np.array(ticks, float)))
    for event in scenario.schedule:
        start = event.tick(period)
        if event.reference is not None and (since := max(start, ticks.start)) < ticks.stop:
            times = period * np.arange(since - start, ticks.stop - start, dtype=float)
            samples[since - ticks.start :] = np.hstack(event.reference.sample(times))
    return np.ascontiguousarray(samples).view(REFERENCE)[:, 0]


def distinct_courses(scenarios: Sequence[Scenario]) -> tuple[list[Scenario], NDArray[np.intp]]:
    """Returns one scenario for each different course, and the index of the one that each robot follows, `(B,)`."""
    keys = [(s.reference, *((e.time, e.reference) for e in s.events if e.reference)) for s in scenarios]
    distinct = dict(zip(keys, scenarios, strict=True))
    place = {key: k for k, key in enumerate(distinct)}
    return list(distinct.values()), np.array([place[key] for key in keys])


class Courses:
    """The references of a uniform group of scenarios; robots with the same reference share its samples."""

    def __init__(self, scenarios: Sequence[Scenario], preview: int) -> None:
        """Takes the scenario of each robot, and the number of control ticks until a voltage acts."""
        self._ticks, self._preview = max(s.ticks for s in scenarios), preview
        self._courses, self._place = distinct_courses(scenarios)
        self._own = len(self._courses) == len(scenarios)  # whether no two robots share a course
        self._block = range(0)
        self._tick, self._now = -1, (np.zeros(0, REFERENCE), np.zeros(0, REFERENCE))  # what `at` returned last

    def at(self, tick: int) -> tuple[Rows, Rows]:
        """Returns the references at a control tick, and those at the time when the voltage of that tick acts.

        Returns:
            Two arrays with a record of `REFERENCE` of each robot, `(B,)`.

        Raises:
            ValueError: The run is over at this tick; robots that begin again have no such end.
        """
        if tick != self._tick:
            self._tick, self._now = tick, self._sampled(tick)
        return self._now

    def extended(self, scenarios: Sequence[Scenario]) -> Courses:
        """Returns the references of the same group with further events."""
        return Courses(scenarios, self._preview)

    def _sampled(self, tick: int) -> tuple[Rows, Rows]:
        """Returns what `at` returns."""
        if tick >= self._ticks:
            raise ValueError(f"step: the run is over after {self._ticks} control periods")
        if tick not in self._block:  # only one block of samples is held, (ticks of a block, courses)
            first = tick // SAMPLED_TICKS * SAMPLED_TICKS
            self._block = range(first, min(first + SAMPLED_TICKS, self._ticks))
            whole = range(first, self._block.stop + self._preview)
            self._samples = np.stack([course(s, whole) for s in self._courses], axis=1)
        row = tick - self._block.start
        now = self._samples[row] if self._own else self._samples[row].take(self._place)  # ten times as fast as [place]
        later = now
        if self._preview:
            later = self._samples[row + self._preview]
            later = later if self._own else later.take(self._place)
        return now, later


class RestartingCourses(Courses):
    """The references of robots that begin again, so that their clocks start at different ticks."""

    def __init__(self, scenarios: Sequence[Scenario], preview: int) -> None:
        """Samples every course once, to the end of the longest run and `preview` ticks beyond; see `Courses`."""
        super().__init__(scenarios, preview)
        self._last = self._ticks + preview
        whole, end = range(self._ticks), range(self._ticks, self._last + 1)
        self._table = np.stack([np.append(course(s, whole), course(s, end)) for s in self._courses], axis=1)
        self._start = np.zeros(len(scenarios), int)

    @override
    def extended(self, scenarios: Sequence[Scenario]) -> Courses:
        raise ValueError("add: robots that begin again keep their references")

    def restart(self, row: int, tick: int) -> None:
        """Begins the course of one robot again at a control tick."""
        self._start[row], self._tick = tick, -1

    @override
    def _sampled(self, tick: int) -> tuple[Rows, Rows]:
        """Returns what `at` returns; beyond the end of a course its last sample."""
        since, place = tick - self._start, self._place
        now = self._table[np.minimum(since, self._last), place]
        return now, self._table[np.minimum(since + self._preview, self._last), place] if self._preview else now


def start_pose(scenario: Scenario, reference: Array) -> Array:
    """Returns the initial pose in m, m, rad, `(3,)`: the scenario's or the reference's, plus the random offset.

    Args:
        scenario: The scenario.
        reference: Pose of the reference at the start in m, m, rad, `(3,)`.

    Raises:
        InputError: The initial pose is more than `MAX_START_DISTANCE` from the reference; the message names the field
            that puts it there, the pose or the spread of the offset.
    """
    base = reference if scenario.initial_pose is None else np.array(scenario.initial_pose)
    offset = np.random.default_rng([scenario.seed, 0]).standard_normal(3) * scenario.initial_spread
    distance = float(np.hypot(*(base + offset - reference)[:2]))
    if distance > MAX_START_DISTANCE:
        field = "initial_spread" if scenario.initial_pose is None else "initial_pose"
        raise InputError(
            f"{field}: {distance:.2f} m from the start of the reference at "
            f"({reference[0]:.2f}, {reference[1]:.2f}); at most {MAX_START_DISTANCE:g} m"
        )
    return base + offset
