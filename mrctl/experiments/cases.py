"""The cases of the suite: each is a named list of scenarios that every feedforward drives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from scipy.optimize import brentq

from mrctl.control.pid import Pid
from mrctl.physics import mjcf
from mrctl.physics.parameters import read_robot
from mrctl.scenario import Event, Scenario, replicates
from mrctl.sensing.tiers import Sensing
from mrctl.theory.perturbation import PERTURBATIONS, Perturbation
from mrctl.theory.references import Lemniscate, Waypoints, random_spline
from mrctl.theory.robot import STEERINGS, Robot

TUNING, HELD_OUT = 100_000, 200_000
"""First seeds of what tuning sees, and of the held-out set; the suite has those below. No two of them share a draw."""
HINDSIGHT = "hindsight"  # the best fixed feedforward, which is found by repeating the run
REFERENCES = ("true_model", HINDSIGHT)  # feedforwards that know the plant, and compete with nobody
LADDER = ("nominal", "mass +50 %", "supply -20 %", "all")  # plants of every steering arrangement
STEPS = (
    "mass +50 %", "payload ahead", "payload aside", "left wheel +5 %", "drive friction x3", "resistance +30 %",
    "motor constant -15 %", "supply -20 %", "delay 20 ms", "tyre friction 0.2", "left tyre on ice", "slope 10°", "all",
)  # fmt: skip
LASTING = ("left_radius_factor", "right_radius_factor", "slope")  # what does not change while a robot drives
FLOOR = ("nominal", "all")  # plants that are also driven with half the physics step
SHORT, LONG = 12.0, 18.0  # s, lap times of the benchmark, and of slower laps to learn on
LAP_TIMES = (8.0, 10.0, 12.0, 16.0, 20.0, 24.0, 30.0)  # s, of random splines; few, so that runs share a batch
RANDOM_LAPS = 4
MARGIN = 0.8  # share of the robot's limits that a random spline may ask for
GRIP = 0.3  # tyre friction that a random spline relies on
BAND = 1.2  # ratio to the error before a step, or to the final error, that counts as recovered or converged


class Case(NamedTuple):
    """Replicates of one run, which differ in their draws, or the random scenarios."""

    name: str
    part: str
    """One of `PARTS`."""
    scenarios: tuple[Scenario, ...]
    """The runs; the suite sets their feedforward."""
    change: int = 0
    """Number, from 1, of the lap at whose beginning something changes; 0 if nothing does."""
    back: int = 0
    """Number of the lap at whose beginning it changes back; 0 if it does not."""


Choices = Mapping[str, dict[str, Any]]
"""By name what each run is driven with: a `feedforward` of mrctl or a `controller` of the user."""

Laps = Mapping[str, xr.Dataset]
"""Metrics lap by lap of all runs, `(run, lap)`, by feedforward."""


class Outcome(NamedTuple):
    """The results of a suite."""

    quick: bool
    """Whether it was the selection with fewer laps."""
    cases: Sequence[Case]
    laps: Laps
    runs: Mapping[str, Laps]
    """The laps of each case."""
    rows: Sequence[dict[str, Any]]
    """Statistics of each case and feedforward; see `suite.compare`."""
    aside: str
    """A sentence on the runs that could not be done, or ""."""


SLOW = Pid(time_constant=0.15)
"""A PID that leaves more for a feedforward to gain than the default."""

PARTS = {
    "steady": "One thing wrong from the start",
    "step": "A step, and the return",
    "learning": "Learning switched on, and off",
    "steering": "Other steering arrangements",
    "random": "Random robots, splines and perturbations",
    "floor": "Half the physics step: what the integrator resolves",
}


def cases(seeds: int, random: int, quick: bool) -> list[Case]:
    """The cases of the suite, the longest runs first.

    Args:
        seeds: Number of replicates of each case; all cases have the same draws. After a step and its return the robot
            is not quite the one before, but another draw.
        random: Number of random scenarios.
        quick: Whether to take a selection of the cases with fewer laps.
    """
    laps, third = (4, 2) if quick else (8, 4)
    base = Scenario(laps=laps)
    found: list[Case] = []

    def add(part: str, name: str, change: int = 0, back: int = 0, **fields: Any) -> None:  # noqa: ANN401
        changed = base.model_copy(update=fields)
        runs = [run.model_copy(update={"name": name}) for run in replicates(changed, seeds)]
        if back:
            runs = [_another_on_return(run) for run in runs]
        found.append(Case(name, part, tuple(runs), change, back))

    for name in ("supply -20 %", "payload ahead") if quick else STEPS:
        events = (
            Event(time=third * SHORT, perturbation=PERTURBATIONS[name]),
            Event(time=2 * third * SHORT, perturbation=Perturbation()),
        )
        add("step", f"{name}, on and off", third + 1, 2 * third + 1, laps=3 * third, events=events)
    for name in ("nominal", "all"):
        frozen = Event(time=third * LONG, learning=False, reference=Lemniscate(period=SHORT))
        slow = Lemniscate(period=LONG)
        case = {"reference": slow, "laps": third + 2, "events": (frozen,), "perturbation": PERTURBATIONS[name]}
        add("learning", f"{name}, frozen on laps half as fast again", third + 1, **case)
        half = laps // 2
        events = (Event(time=0.0, learning=False), Event(time=half * SHORT, learning=True))
        add("learning", f"{name}, learning from half time", half + 1, perturbation=PERTURBATIONS[name], events=events)
    for name in (*LADDER, "delay 20 ms") if quick else PERTURBATIONS:
        add("steady", name, perturbation=PERTURBATIONS[name])
    for name in FLOOR:
        add("floor", f"{name}, half the step", perturbation=PERTURBATIONS[name], physics_step=base.physics_step / 2)
    if not quick:
        for tier in ("ideal", "field"):
            add("steady", f"sensing {tier}", sensing=Sensing(tier=tier))
        add("steady", "odometry", sensing=Sensing(estimator="odometry"))
        for name in ("nominal", "all"):
            add("steady", f"{name}, slow PID", perturbation=PERTURBATIONS[name], pid=SLOW)
        add("steady", "patch of ice", world="patch")
        add("steady", "rough ground", world="rough")
        for steering in STEERINGS[1:]:
            for name in LADDER:
                add("steering", f"{steering}, {name}", steering=steering, perturbation=PERTURBATIONS[name])
    if random:
        found.append(Case("random", "random", tuple(random_scenarios(random))))
    return found


def _another_on_return(run: Scenario) -> Scenario:
    """The run whose last event brings back a robot of another draw; its wheels and the floor stay what they were."""
    *before, last = run.events
    back = Perturbation().drawn(np.random.default_rng([run.seed, 6]))
    back = back.model_copy(update={name: getattr(run.perturbation, name) for name in LASTING})
    return run.model_copy(update={"events": (*before, last.model_copy(update={"perturbation": back}))})


def random_scenarios(count: int) -> list[Scenario]:
    """The first `count` random scenarios, the shortest runs first; each is a pure function of its seed."""
    robot = read_robot(mjcf.load())
    return sorted((random_scenario(seed, robot) for seed in range(count)), key=lambda s: s.ticks)


def random_scenario(seed: int, robot: Robot) -> Scenario:
    """A random robot on a random closed spline with a random perturbation, from the start or as a step.

    Args:
        seed: Seed of every draw; the scenario has it too.
        robot: The nominal robot, whose limits the spline keeps.
    """
    random = np.random.default_rng([seed, 3])
    body = {
        f"{name}_factor": round(random.uniform(0.5, 1.5), 4)
        for name in ("mass", "inertia", "drive_friction", "resistance", "motor_constant")
    }
    plain, kind = Perturbation.from_dict(body), random.choice(list(_KINDS))
    disturbed = plain.model_copy(update=_KINDS[kind](random))
    reference = _spline(random, robot)
    lap = int(random.integers(RANDOM_LAPS - 1))
    events = (Event(time=lap * reference.period, perturbation=disturbed),)
    return Scenario(
        name=f"random {seed}: {kind}", seed=seed, laps=RANDOM_LAPS, reference=reference,
        perturbation=plain if lap else disturbed, events=events if lap else (),
    )  # fmt: skip


# A payload of 6 kg at these places does not tip a robot of half the mass.
_KINDS = {
    "payload": lambda r: {
        "payload": r.uniform(0, 6), "payload_x": r.uniform(-0.1, 0.3), "payload_y": r.uniform(-0.12, 0.12)
    },
    "supply": lambda r: {"supply_factor": r.uniform(0.7, 1.0)},
    "wheel": lambda r: {"left_radius_factor": r.uniform(0.95, 1.05)},
    "delay": lambda r: {"control_delay": 0.01 * r.integers(1, 4)},
    "grip": lambda r: {"tyre_friction_factor": r.uniform(0.4, 1.0)},
    "ice": lambda r: {"left_tyre_friction_factor": r.uniform(0.1, 0.5)},
    "slope": lambda r: {"slope": r.uniform(-0.17, 0.17)},
    "driver": lambda r: {"dead_zone": r.uniform(0, 1), "battery_resistance": r.uniform(0, 0.3)},
    "motors": lambda r: {f"{side}_motor_constant_factor": r.uniform(0.9, 1.1) for side in ("left", "right")},
}  # fmt: skip


def _spline(random: np.random.Generator, robot: Robot) -> Waypoints:
    """A random spline at changing speed, driven in the shortest lap time that keeps the margins, or in the next."""
    careful = robot.model_copy(update={"tyre_friction": GRIP / MARGIN})
    while True:
        course = random_spline(random, careful, MARGIN, MARGIN)
        slower = int(random.integers(2))
        if times := [time for time in LAP_TIMES if time >= course.period]:
            return slowed(course, times[min(slower, len(times) - 1)])


def slowed(course: Waypoints, period: float) -> Waypoints:
    """The same course in a longer lap time in s, with velocities in one proportion, accelerations in its square."""

    def at(share: float) -> Waypoints:
        linear = {"rotation": course.limits.rotation * share}
        names = ("acceleration", "rotation_acceleration", "lateral_acceleration")
        square = {name: getattr(course.limits, name) * share**2 for name in names}
        limits = course.limits.model_copy(update=linear | square)
        return course.model_copy(update={"speed": course.speed * share, "limits": limits})

    share = brentq(lambda share: at(share).period - period, 0.5 * course.period / period, 1.0)
    return at(float(share))  # type: ignore[arg-type]
