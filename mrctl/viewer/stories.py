"""Three scenes to watch: in each, PID alone and `model+composite` meet the same events."""

from __future__ import annotations

from typing import NamedTuple

from mrctl.scenario import FEEDFORWARDS, Event, Scenario
from mrctl.theory.perturbation import Perturbation
from mrctl.theory.references import StopAndGo
from mrctl.theory.robot import RobotFile


class Story(NamedTuple):
    """A scene: what drives, and one sentence of what to watch."""

    scenarios: list[Scenario]
    watch: str


def _story(scenario: Scenario, watch: str) -> Story:
    learner, alone = (scenario.replace(**FEEDFORWARDS[name]) for name in ("model+composite", "none"))
    return Story([learner, alone], watch)


_LOAD = Perturbation(payload=9.5, payload_x=0.09, payload_y=0.04, payload_z=0.12)
_SAG = tuple(Event(time=12.0 + 2 * k, perturbation=Perturbation(supply_factor=1 - k / 10)) for k in range(1, 5))
_ICE = Perturbation(left_tyre_friction_factor=0.1)

STORIES = {
    "racing car, load": _story(
        Scenario(
            robot=RobotFile(path="racecar"),
            steering="rigid",
            reference=StopAndGo(distance=2.0, move_time=2.5, pause=0.5, reverse=True),
            events=(Event(time=6.0, perturbation=_LOAD), Event(time=18.0, push=(0.0, 20.0, 0.0))),
        ),
        "At 6 s a load of two and a half times its mass falls on the racing car, and at 18 s it is pushed: PID alone "
        "swings metres beyond the reference, turns aside from 24 s on, and its run ends at 36 s; the learner drives "
        "on, with an RMS error of 5 cm in the lap of the load and of 2 to 3 cm later.",
    ),
    "draining battery": _story(
        Scenario(laps=5, events=_SAG),
        "From 14 s the battery loses 10 % every 2 s, down to 60 %: the RMS error of PID alone grows to five times "
        "that of the learner, which stays as it is.",
    ),
    "ice": _story(
        Scenario(laps=5, events=(Event(time=12.0, perturbation=_ICE), Event(time=36.0, perturbation=Perturbation()))),
        "From 12 s the left wheel runs on ice: from 18 to 24 s and from 30 to 36 s, in the left turns, both robots "
        "slide up to 15 mm off, and otherwise nothing is seen of it. The learner does not learn from a wheel that "
        "slips, so it is as good as before when the ice ends at 36 s.",
    ),
}
"""Scenes by the name on their buttons."""
