"""When the reference of an event begins: at the control tick at which the run follows it."""

import numpy as np
import pytest

from mrctl import Circle, Event, Lemniscate, Scenario
from mrctl.loop.courses import course
from mrctl.loop.timeline import begun, followed


@pytest.mark.parametrize("time", [0.0, 0.5, 0.503])
def test_begin_of_a_reference(time):
    """An event between two control ticks waits for the second of them, where the run is at the start of its course."""
    circle = Circle(radius=1.0, period=8.0)
    scenario = Scenario(reference=Lemniscate(), events=(Event(time=time, reference=circle),))
    period = scenario.control_period
    start = round(begun(scenario, 1.0) / period)
    poses = course(scenario, range(100))["pose"]
    assert begun(scenario, 1.0) == pytest.approx(period * start, abs=1e-12)
    assert np.array_equal(poses[start], circle.sample(np.zeros(1)).pose[0])
    assert followed(scenario, start * period) == circle
    assert not start or followed(scenario, (start - 1) * period) == scenario.reference
