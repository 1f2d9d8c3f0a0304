"""The held-out cells: courses and plants on which one learner is judged, and on which nothing is ever chosen.

A setting that was chosen on some runs looks better on them than it is (selection bias). These cells were written down
before any tuning; no course, no plant and no seed of theirs is used anywhere else. A learner is named, with its
settings, before it is driven through them.
"""

from __future__ import annotations

from mrctl.experiments.cases import HELD_OUT_SEEDS, Case
from mrctl.scenario import Scenario, replicates
from mrctl.theory.perturbation import Perturbation
from mrctl.theory.references import Circle, Reference, RoundedSquare, StopAndGo, Waypoints
from mrctl.theory.timing import Limits

LAPS = 6
NO_SPREAD = (0.0, 0.0, 0.0)  # an initial offset, the same for all, would hide what learning costs in lap 1

COURSES: dict[str, Reference] = {
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
"""Five courses; the speed changes along the last three."""

PLANTS: dict[str, Perturbation] = {
    "light, weak supply": Perturbation(mass_factor=0.7, supply_factor=0.95),
    "payload 3 kg aside": Perturbation(payload=3.0, payload_x=0.25, payload_y=-0.12),
    "left motor -8 %, friction x2": Perturbation(left_motor_constant_factor=0.92, drive_friction_factor=2.0),
    "supply -10 %, resistance +20 %": Perturbation(supply_factor=0.9, resistance_factor=1.2),
    "slope 4°, mass +20 %": Perturbation(slope=0.07, mass_factor=1.2),
    "sagging battery, dead zone": Perturbation(battery_resistance=0.2, dead_zone=0.5),
    "delay 10 ms, inertia +40 %": Perturbation(control_delay=0.01, inertia_factor=1.4),
    "right wheel -3 %, right friction x3": Perturbation(right_radius_factor=0.97, right_drive_friction_factor=3.0),
}
"""Eight robots that differ from the model in more than one way, none of them in `PERTURBATIONS`."""


def cells(count: int) -> list[Case]:
    """The 40 cells, each course with each plant, course by course.

    Args:
        count: Number of replicates of each cell; all cells have the same draws.
    """
    return [
        Case(
            f"{course}; {plant}",
            "held-out",
            tuple(
                replicates(
                    Scenario(
                        name=f"{course}; {plant}", laps=LAPS, reference=reference, perturbation=perturbation,
                        initial_spread=NO_SPREAD,
                    ),
                    count,
                    HELD_OUT_SEEDS.start,
                )
            ),
        )
        for course, reference in COURSES.items()
        for plant, perturbation in PLANTS.items()
    ]  # fmt: skip
