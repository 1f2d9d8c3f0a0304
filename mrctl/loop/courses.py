"""The references of a group of scenarios, sampled at each control tick."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mrctl.kernel import Array, Rows
from mrctl.record import InputError
from mrctl.scenario import Scenario

BLOCK = 10_000  # control ticks whose references are sampled at once
FAR = 0.8  # m, largest distance between robot and reference at the start

GOAL = np.dtype(
    [
        ("pose", "f8", 3),  # reference x and y in m, θ in rad
        ("twist", "f8", 2),  # reference V in m/s and θ̇ in rad/s
        ("acceleration", "f8", 2),  # their derivatives, m/s² and rad/s²
    ]
)


def course(scenario: Scenario, ticks: range) -> Rows:
    """Returns the reference of a scenario, including the events that change it, one record of `GOAL` for each tick."""
    period = scenario.control_period
    samples = np.hstack(scenario.reference.sample(period * np.array(ticks, float)))
    for event in sorted(scenario.events, key=lambda e: e.time):
        start = event.tick(period)
        if event.reference is not None and (since := max(start, ticks.start)) < ticks.stop:
            times = period * np.arange(since - start, ticks.stop - start, dtype=float)
            samples[since - ticks.start :] = np.hstack(event.reference.sample(times))
    return np.ascontiguousarray(samples).view(GOAL)[:, 0]


def distinct_courses(scenarios: Sequence[Scenario]) -> tuple[list[Scenario], NDArray[np.intp]]:
    """Returns one scenario for each different course, and the index of the one that each robot follows, `(B,)`."""
    keys = [(s.reference, *((e.time, e.reference) for e in s.events if e.reference)) for s in scenarios]
    distinct = dict(zip(keys, scenarios, strict=True))
    order = list(distinct)
    return list(distinct.values()), np.array([order.index(key) for key in keys])


class Courses:
    """The references of a uniform group of scenarios; robots with the same reference share its samples."""

    def __init__(self, scenarios: Sequence[Scenario], preview: int = 0) -> None:
        """Takes the scenario of each robot, and the largest argument `ahead` of `at`, in control ticks."""
        self._ticks, self._preview = max(s.ticks for s in scenarios), preview
        self._courses, self._place = distinct_courses(scenarios)
        self._own = len(self._courses) == len(scenarios)  # whether no two robots share a course
        self._block = range(0)

    def at(self, tick: int, ahead: int = 0) -> Rows:
        """Returns the references `ahead` ticks after a control tick, one record of `GOAL` for each robot, `(B,)`."""
        if tick not in self._block:  # only one block of samples is held, (ticks of a block, courses)
            first = tick // BLOCK * BLOCK
            self._block = range(first, min(first + BLOCK, self._ticks))
            whole = range(first, self._block.stop + self._preview)
            self._samples = np.stack([course(s, whole) for s in self._courses], axis=1)
        now = self._samples[tick + ahead - self._block.start]
        return now if self._own else now[self._place]


def start_pose(scenario: Scenario, reference: Array) -> Array:
    """Returns the initial pose in m, m, rad, `(3,)`: the scenario's or the reference's, plus the random offset.

    Args:
        scenario: The scenario.
        reference: Pose of the reference at the start in m, m, rad, `(3,)`.

    Raises:
        InputError: The initial pose is more than 0.8 m from the reference.
    """
    base = reference if scenario.initial_pose is None else np.array(scenario.initial_pose)
    offset = np.random.default_rng([scenario.seed, 0]).standard_normal(3) * scenario.initial_spread
    distance = float(np.hypot(*(base + offset - reference)[:2]))
    if distance > FAR:
        raise InputError(
            f"initial_pose: {distance:.2f} m from the start of the reference at "
            f"({reference[0]:.2f}, {reference[1]:.2f}); at most {FAR:g} m"
        )
    return base + offset
