"""What holds in a run at a moment, by its scenario and the events before."""

from __future__ import annotations

from typing import Any

import numpy as np

from mrctl.kernel import Array
from mrctl.scenario import Scenario
from mrctl.theory.references import Reference, Waypoints

# Fields of a scenario that events can change in the middle of a run; a change of another field needs a new run.
CHANGEABLE = ["perturbation", "kanayama", "pid"]


def state(scenario: Scenario, time: float) -> dict[str, Any]:
    """Returns the values of the fields `CHANGEABLE`, and of `learning`, at a time in s of a run."""
    now: dict[str, Any] = {name: getattr(scenario, name) for name in CHANGEABLE} | {"learning": True}
    for event in scenario.schedule:
        if event.time <= time + 1e-9:
            now |= {name: value for name in now if (value := getattr(event, name)) is not None}
    return now


def followed(scenario: Scenario, time: float) -> Reference:
    """Returns the reference that a run follows at a time in s."""
    brought = [e.reference for e in scenario.schedule if e.time <= time + 1e-9]
    return next((reference for reference in reversed(brought) if reference), scenario.reference)


def begun(scenario: Scenario, time: float) -> float:
    """Returns the time in s of the control tick at which the reference began that a run follows at a time in s."""
    period = scenario.control_period
    return max((e.tick(period) * period for e in scenario.events if e.reference and e.time <= time + 1e-9), default=0.0)


def ends(scenario: Scenario, time: float) -> Array | None:
    """Returns start and end of the way that a run follows at a time in s; None where it has no end.

    The end is the goal of the scenario while the run follows the scenario's own reference and there is a goal,
    otherwise the end of open waypoints.

    Returns:
        Two poses, x and y in m and θ in rad, `(2, 3)`.
    """
    plan = followed(scenario, time)
    found = plan.sample(np.array([0.0, plan.period])).pose
    if plan is scenario.reference and scenario.goal is not None:
        found[1] = scenario.goal
    elif not isinstance(plan, Waypoints) or plan.closed:
        return None
    return found
