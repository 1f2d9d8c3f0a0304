"""The held-out cells: courses and plants on which learners are judged, and on which nothing is ever chosen.

A setting that was chosen on some runs looks better on them than it is (selection bias). The first set was written down
before any tuning. What it shows is a finding of that set, as soon as one looks at it; the second set was written down
after that, to confirm or refute it. Courses, plants and seeds of a set are used nowhere else.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Literal, NamedTuple

from mrctl.experiments.cases import HELD_OUT_SEEDS, NO_SPREAD, Case
from mrctl.scenario import Scenario, replicates
from mrctl.theory.perturbation import Perturbation
from mrctl.theory.references import Circle, LaneChange, Reference, RoundedSquare, StopAndGo, Waypoints
from mrctl.theory.timing import Limits

Which = Literal["first", "second"]
LAPS = 6


class Cells(NamedTuple):
    """A set of cells, each course with each plant.

    Attributes:
        courses: Five courses; the speed changes along the last three.
        plants: Eight plants that differ from the model, none of them in `PERTURBATIONS`.
        seeds: Seeds of the replicates.
    """

    courses: Mapping[str, Reference]
    plants: Mapping[str, Perturbation]
    seeds: range

    def cases(self, count: int) -> list[Case]:
        """Returns the cells, course by course, with that number of replicates; all cells have the same draws."""
        found = []
        for course, reference in self.courses.items():
            for plant, perturbation in self.plants.items():
                name = f"{course}; {plant}"
                run = Scenario(
                    name=name, laps=LAPS, reference=reference, perturbation=perturbation, initial_spread=NO_SPREAD
                )
                found.append(Case(name, "held-out", tuple(replicates(run, count, self.seeds.start))))
        return found


@cache
def cells(which: Which) -> Cells:
    """Returns a set of 40 cells.

    The sets are no constants, because the timing of courses calls kernels, which are not to be compiled when this
    module is imported.
    """
    return {"first": _first, "second": _second}[which]()


def _first() -> Cells:
    courses = {
        "circle": Circle(radius=1.3, period=9.0, clockwise=True),
        "square": RoundedSquare(side=2.6, radius=0.6, speed=0.6),
        "stop and go": StopAndGo(distance=3.0, move_time=4.5, pause=0.7, reverse=False),
        "fast spline": Waypoints(
            points=((0, 0), (1.4, -0.3), (2.6, 0.5), (1.9, 1.7), (0.7, 1.1), (-0.9, 1.8), (-1.5, 0.6)),
            speed=1.1,
            timing="limits",
            limits=Limits(acceleration=0.8, rotation=1.8, rotation_acceleration=3.5, lateral_acceleration=0.9),
        ),
        "winding spline": Waypoints(
            points=((0, 0), (-0.6, 1.0), (0.4, 1.9), (2.0, 1.5), (3.2, 1.9), (3.6, 0.6), (2.6, -0.6), (1.2, 0.1)),
            speed=0.9,
            timing="limits",
            limits=Limits(acceleration=0.5, rotation=1.5, rotation_acceleration=3.0, lateral_acceleration=0.6),
        ),
    }
    plants = {
        "light, weak supply": Perturbation(mass_factor=0.7, supply_factor=0.95),
        "payload 3 kg aside": Perturbation(payload=3.0, payload_x=0.25, payload_y=-0.12),
        "left motor -8 %, friction x2": Perturbation(left_motor_constant_factor=0.92, drive_friction_factor=2.0),
        "supply -10 %, resistance +20 %": Perturbation(supply_factor=0.9, resistance_factor=1.2),
        "slope 4°, mass +20 %": Perturbation(slope=0.07, mass_factor=1.2),
        "sagging battery, dead zone": Perturbation(battery_resistance=0.2, dead_zone=0.5),
        "delay 10 ms, inertia +40 %": Perturbation(control_delay=0.01, inertia_factor=1.4),
        "right wheel -3 %, right friction x3": Perturbation(right_radius_factor=0.97, right_drive_friction_factor=3.0),
    }
    return Cells(courses, plants, HELD_OUT_SEEDS[:1000])


def _second() -> Cells:
    """Returns the cells that are to confirm or refute what seven drives through the first set had shown.

    Predicted before their first drive, of the four learners on a model with the settings of version 0.49.0: `model+rls`
    exceeds a rival in the fewest of the comparisons, and its position error over all laps is below that of `model` in
    more cells than above.
    """
    courses = {
        "wide circle": Circle(radius=1.9, period=13.0),
        "lane change": LaneChange(length=5.0, shift=1.2, speed=0.7),
        "stop and go, short": StopAndGo(distance=1.6, move_time=2.8, pause=0.5, reverse=False),
        "long spline": Waypoints(
            points=((0, 0), (1.6, 0.4), (3.1, -0.4), (4.2, 0.7), (3.4, 2.1), (1.8, 1.7), (0.3, 2.4), (-1.1, 1.2)),
            speed=1.0,
            timing="limits",
            limits=Limits(acceleration=0.7, rotation=1.6, rotation_acceleration=3.2, lateral_acceleration=0.8),
        ),
        "clockwise spline": Waypoints(
            points=((0, 0), (0.9, -1.1), (0.1, -2.2), (-1.3, -1.9), (-2.4, -2.6), (-3.0, -1.2), (-1.7, -0.3)),
            speed=0.8,
            timing="limits",
            limits=Limits(acceleration=0.6, rotation=1.7, rotation_acceleration=3.4, lateral_acceleration=0.7),
        ),
    }
    plants = {
        "mass +35 %, supply +6 %": Perturbation(mass_factor=1.35, supply_factor=1.06),
        "payload 4 kg behind": Perturbation(payload=4.0, payload_x=-0.1, payload_y=0.08),
        "motor constants -10 %, friction x0.5": Perturbation(motor_constant_factor=0.9, drive_friction_factor=0.5),
        "right resistance +35 %": Perturbation(right_resistance_factor=1.35),
        "slope 6°": Perturbation(slope=0.105),
        "supply -15 %, dead zone": Perturbation(supply_factor=0.85, dead_zone=0.8),
        "delay 20 ms, light": Perturbation(control_delay=0.02, mass_factor=0.8),
        "left wheel +2 %, friction x2.5": Perturbation(left_radius_factor=1.02, drive_friction_factor=2.5),
    }
    return Cells(courses, plants, HELD_OUT_SEEDS[1000:2000])
