"""The cases of the suite: each is a named list of scenarios that every feedforward drives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any, Literal, NamedTuple

import numpy as np
import xarray as xr
from scipy.optimize import brentq

from mrctl.control.pid import Pid
from mrctl.loop import user_files
from mrctl.physics import mjcf
from mrctl.physics.parameters import read_robot
from mrctl.record import InputError
from mrctl.scenario import COMPARED, FEEDFORWARDS, Event, FeedforwardName, Scenario, controller_name, replicates
from mrctl.sensing.tiers import Sensing
from mrctl.theory.perturbation import PERTURBATIONS, Perturbation
from mrctl.theory.references import Lemniscate, StopAndGo, Waypoints, random_spline
from mrctl.theory.robot import STEERINGS, Robot
from mrctl.theory.timing import Limits

SUITE_SEEDS, TUNING_SEEDS, HELD_OUT_SEEDS = range(100_000), range(100_000, 200_000), range(200_000, 300_000)
"""Seeds of the suite, of the worlds in which settings are tuned, and of the held-out cells, on which none is chosen."""
HINDSIGHT: Literal["hindsight"] = "hindsight"  # the best fixed feedforward, found by repeating the run
REFERENCES = ("true_model", HINDSIGHT)  # feedforwards that know the plant or the run, and so are no competitors
LADDER = ("nominal", "mass +50 %", "supply -20 %", "all")  # plants that every steering arrangement drives
UNCERTAIN = (
    "mass +50 %", "mass -50 %", "payload ahead", "payload aside", "left wheel +5 %", "drive friction x3",
    "resistance +30 %", "motor constant -15 %", "supply -20 %", "delay 20 ms", "left tyre on ice", "slope 10°",
)  # fmt: skip
FAULTS = {
    "left motor -20 %": Perturbation(left_motor_constant_factor=0.8),
    "left drive friction x3": Perturbation(left_drive_friction_factor=3.0),
}
HARD = {
    "nominal": Perturbation(),
    "tyre friction 0.33": Perturbation(tyre_friction_factor=0.33 / 0.9),
    "current limit 1.5 A": Perturbation(current_limit=1.5),
    "sagging battery": Perturbation(supply_factor=0.8, battery_resistance=1.0),
}
"""Plants that behave like the nominal one on a lap of 12 s, with at most 0.17 g to the side and 1 A per motor."""
STEPS = (*(name for name in UNCERTAIN if name != "mass -50 %"), "all")
LASTING = ("left_radius_factor", "right_radius_factor", "slope")  # fields that do not change while a robot drives
FLOOR, HALF = ("nominal", "all"), ", half the step"  # plants that are also driven with half the physics step
# laps before a late step, after which what a learner knows of the former plant has long been confirmed
LATE_STEP_LAPS = 20
NO_SPREAD = (0.0, 0.0, 0.0)  # no initial offset, which would hide what learning costs in lap 1
FAST, SHORT, LONG = 9.0, 12.0, 18.0  # s, lap times: near the robot's limits, the benchmark's, a slow one to learn on
LAP_TIMES = (8.0, 10.0, 12.0, 16.0, 20.0, 24.0, 30.0)  # s, of random splines; few, so that runs share a batch
RANDOM_LAPS = 4
SPLINE_LIMIT_SHARE = 0.8  # share of the robot's limits that a random spline may ask for
RELIED_FRICTION = 0.3  # tyre friction that a random spline relies on
NO_WORSE = 1.02  # ratio to the error of PID alone up to which a feedforward does no harm
MUCH_WORSE = 5.0  # and above which it does much
# largest ratio to the error before a step, or to the final one, that counts as recovered or converged
RECOVERED_RATIO = 1.2


class Case(NamedTuple):
    """A case of the suite: replicates of one run, which differ in their draws, or the random scenarios."""

    name: str
    part: str
    """One of `PARTS`, or `held-out`."""
    scenarios: tuple[Scenario, ...]
    """The runs, whose feedforwards are set later."""
    change: int = 0
    """Number, from 1, of the lap at whose beginning something changes; 0 if nothing does."""
    back: int = 0
    """Number of the lap at whose beginning it changes back; 0 if it does not."""


class Choice(NamedTuple):
    """What drives the runs: a prior and a learner of mrctl, and a controller of the user, if any."""

    prior: str = "none"
    learner: str = "none"
    controller: str | None = None
    """The user's controller, as for `mrctl.loop.user_files`."""

    @property
    def pair(self) -> dict[str, str]:
        """Prior and learner, as fields of a scenario."""
        return {"prior": self.prior, "learner": self.learner}


Choices = Mapping[str, Choice]
"""What drives the runs, by the name in tables."""
Laps = Mapping[str, xr.Dataset]
"""Metrics lap by lap of all runs, `(run, lap)`, by feedforward."""


class Outcome(NamedTuple):
    """The results of a suite."""

    mode: Mode
    """Size of the suite."""
    cases: Sequence[Case]
    laps: Laps
    runs: Mapping[str, Laps]
    """The laps of each case."""
    rows: Sequence[dict[str, Any]]
    """Statistics of each case and feedforward; see `suite.compare`."""
    aside: str
    """A sentence on the runs that could not be done, or ""."""


SLOW = Pid(time_constant=0.15)
"""A PID that is slower than the default, so that a feedforward can gain more."""


@cache
def loop() -> Waypoints:
    """Returns a course at changing speed, which begins where the lemniscate does and in its direction.

    It is no constant, because its timing calls a kernel, which is not to be compiled when this module is imported.
    """
    return Waypoints(
        points=(
            (0, 0), (0.46, 1.16), (1.59, 1.77), (2.36, 0.84), (1.48, -0.12), (1.07, -1.27), (-0.41, -1.56),
            (-0.74, -0.72),
        ),
        speed=1.2,
        timing="limits",
        limits=Limits(acceleration=0.7, rotation=1.8, rotation_acceleration=3.5, lateral_acceleration=0.8),
    )  # fmt: skip


Mode = Literal["quick", "core", "full"]
REPLICATES: dict[Mode, int] = {"quick": 3, "core": 20, "full": 20}
RANDOM: dict[Mode, int] = {"quick": 6, "core": 30, "full": 1000}
Entry = FeedforwardName | Literal["hindsight"]
"""A feedforward of mrctl, or the best fixed one for each run."""
QUICK: tuple[Entry, ...] = ("none", "model", "model+observer", "fel", "model+fel", "model+composite")
"""What `quick` compares: few, and without `hindsight`, which drives each run three times."""


def entries(mode: Mode) -> tuple[Entry, ...]:
    """Returns what the suite compares by default."""
    return QUICK if mode == "quick" else (*(FEEDFORWARDS if mode == "full" else COMPARED), HINDSIGHT)


PARTS = {
    "steady": "One thing wrong from the start, or four at once",
    "fault": "One motor, the current limit, the battery, the grip",
    "course": "Courses at changing speed",
    "step": "A step, and the return",
    "late": "A step after twenty laps, and two laps with it",
    "learning": "Learning carried to another course, switched on, and off",
    "tier": "Other sensors",
    "steering": "Other steering arrangements",
    "random": "Random robots, splines and perturbations: medians",
    "floor": "Half the physics step: what the integrator resolves",
}
UNCHANGED = ("steady", "fault", "course", "tier", "steering")  # parts in whose runs nothing changes between the laps


def by_name(feedforwards: Sequence[Entry], controllers: Sequence[str], base: Scenario | None = None) -> Choices:
    """Returns what drives the runs, by the name of the feedforward or of the user's class.

    Args:
        feedforwards: Names of feedforwards of mrctl.
        controllers: Controllers of the user, each as for `mrctl.loop.user_files.behind`: with a feedforward of mrctl in
            front, as in `model+composite+motion=my_file.py:MyMotion`, or without one.
        base: Scenario on which the user's controllers are tried for a few ticks; by default the default one.

    Raises:
        InputError: A controller is bad, or its name is taken.
    """
    choices = {name: Choice() if name == HINDSIGHT else Choice(**FEEDFORWARDS[name]) for name in feedforwards}
    for entry in controllers:
        front, stages, parts = user_files.behind(entry)
        name = controller_name(front, "+".join(part.title for part in parts))
        if name in choices:
            raise InputError(f"controller: the name {name} is taken")
        own = user_files.absolute(stages)
        user_files.trial(own, (base or Scenario()).replace(laps=1, **FEEDFORWARDS[front]))
        choices[name] = Choice(**FEEDFORWARDS[front], controller=own)
    return choices


def cases(mode: Mode, seeds: int, random: int) -> list[Case]:
    """Lists the cases of the suite, the longest runs first.

    Args:
        mode: Size of the suite: `core`, the default; `quick`, a few of its cases with fewer laps; or `full`, which adds
            the other uncertainties, tiers and steering arrangements and a late step, and drives 8 laps in most cases.
        seeds: Number of replicates of each case; all cases have the same draws. The return after a step does not bring
            back the same robot, but another draw.
        random: Number of random scenarios in `lab`; `full` has the same ones in the other tiers.
    """
    quick, full = mode == "quick", mode == "full"
    leading, laps, third = {"quick": (3, 3, 2), "core": (5, 4, 3), "full": (8, 8, 4)}[mode]
    plants = PERTURBATIONS | FAULTS
    found: list[Case] = []

    def add(part: str, name: str, change: int = 0, back: int = 0, **fields: Any) -> None:  # noqa: ANN401
        changed = Scenario(laps=laps, initial_spread=NO_SPREAD).model_copy(update=fields)
        runs = [run.model_copy(update={"name": name}) for run in replicates(changed, seeds)]
        if back:
            runs = [_another_on_return(run) for run in runs]
        found.append(Case(name, part, tuple(runs), change, back))

    steps = {"quick": ("supply -20 %",), "core": ("payload ahead", "supply -20 %", "all"), "full": STEPS}[mode]
    for name in steps:
        events = (
            Event(time=third * SHORT, perturbation=PERTURBATIONS[name]),
            Event(time=2 * third * SHORT, perturbation=Perturbation()),
        )
        add("step", f"{name}, on and off", third + 1, 2 * third + 1, laps=3 * third, events=events)
    if full:
        late = Event(time=LATE_STEP_LAPS * SHORT, perturbation=PERTURBATIONS["all"])
        add("late", f"all, after {LATE_STEP_LAPS} laps", LATE_STEP_LAPS + 1, laps=LATE_STEP_LAPS + 2, events=(late,))
    carried = Event(time=third * SHORT, learning=False, reference=slowed(loop(), SHORT))
    for name in ("all",) if quick else FLOOR:
        case = {"laps": third + 2, "events": (carried,), "perturbation": PERTURBATIONS[name]}
        add("learning", f"{name}, frozen on another course", third + 1, **case)
    if not quick:
        switched = (Event(time=0.0, learning=False), Event(time=third * SHORT, learning=True))
        case = {"laps": 2 * third, "events": switched, "perturbation": PERTURBATIONS["all"]}
        add("learning", "all, learning from half time", third + 1, **case)
    if full:
        frozen = Event(time=third * LONG, learning=False, reference=Lemniscate(period=SHORT))
        for name in FLOOR:
            case = {"reference": Lemniscate(period=LONG), "laps": third + 2, "perturbation": PERTURBATIONS[name]}
            add("learning", f"{name}, frozen on laps half as fast again", third + 1, events=(frozen,), **case)
    for name in FLOOR:
        case = {"laps": leading, "perturbation": PERTURBATIONS[name]}
        add("steady", name, **case)
        add("floor", f"{name}{HALF}", physics_step=Scenario().physics_step / 2, **case)
    steady = {"quick": ("supply -20 %",), "core": UNCERTAIN, "full": (n for n in PERTURBATIONS if n not in FLOOR)}[mode]
    for name in steady:
        add("steady", name, perturbation=PERTURBATIONS[name])
    for name in list(FAULTS)[: 1 if quick else None]:
        add("fault", name, perturbation=FAULTS[name])
    for name in () if quick else HARD:
        add("fault", f"{name}, 9 s a lap", perturbation=HARD[name], reference=Lemniscate(period=FAST))
    for name in ("all",) if quick else FLOOR:
        add("course", f"{name}, spline", perturbation=PERTURBATIONS[name], reference=loop())
    if not quick:
        back = {"reference": StopAndGo(), "steering": "rigid"}
        add("course", "all, forth and back, rigid", perturbation=PERTURBATIONS["all"], **back)
        for tier in ("ideal", "field"):
            for name in PERTURBATIONS | FAULTS if full else FLOOR:
                add("tier", f"{name}, {tier}", perturbation=plants[name], sensing=Sensing(tier=tier))
    if full:
        add("tier", "odometry", sensing=Sensing(estimator="odometry"))
        for name in FLOOR:
            add("steady", f"{name}, slow PID", perturbation=PERTURBATIONS[name], pid=SLOW)
        add("fault", "patch of ice", world="patch")
        add("fault", "rough ground", world="rough")
        for steering in STEERINGS[1:]:
            for name in LADDER:
                add("steering", f"{steering}, {name}", steering=steering, perturbation=PERTURBATIONS[name])
    if random:
        worlds = random_scenarios(random)
        found.append(Case("random", "random", tuple(worlds)))
        for tier in ("ideal", "field") if full else ():
            sensed = (world.model_copy(update={"sensing": Sensing(tier=tier)}) for world in worlds)
            found.append(Case(f"random, {tier}", "random", tuple(sensed)))
    return sorted(found, key=lambda case: -case.scenarios[-1].ticks)


def _another_on_return(run: Scenario) -> Scenario:
    """Returns a run whose last event brings back another draw of the robot, with the same wheels on the same floor."""
    *before, last = run.events
    back = Perturbation().drawn(np.random.default_rng([run.seed, 6]))
    back = back.model_copy(update={name: getattr(run.perturbation, name) for name in LASTING})
    return run.model_copy(update={"events": (*before, last.model_copy(update={"perturbation": back}))})


def random_scenarios(count: int) -> list[Scenario]:
    """Returns the first `count` random scenarios, the shortest runs first; each is a pure function of its seed."""
    robot = read_robot(mjcf.load())
    return sorted((random_scenario(seed, robot) for seed in range(count)), key=lambda s: s.ticks)


def random_scenario(seed: int, robot: Robot) -> Scenario:
    """Draws a random robot on a random closed spline with a random perturbation, from the start or as a step.

    Args:
        seed: Seed of every draw, and of the scenario.
        robot: The nominal robot, whose limits the spline respects.
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
    """Draws a spline at changing speed; its lap time is the least of `LAP_TIMES` within the margins, or the next."""
    while True:
        course = careful_spline(random, robot)
        slower = int(random.integers(2))
        if times := [time for time in LAP_TIMES if time >= course.period]:
            return slowed(course, times[min(slower, len(times) - 1)])


def careful_spline(random: np.random.Generator, robot: Robot) -> Waypoints:
    """Draws a spline at changing speed that relies on little grip and keeps a margin from the robot's other limits."""
    careful = robot.model_copy(update={"tyre_friction": RELIED_FRICTION / SPLINE_LIMIT_SHARE})
    return random_spline(random, careful, SPLINE_LIMIT_SHARE, SPLINE_LIMIT_SHARE)


def slowed(course: Waypoints, period: float) -> Waypoints:
    """Slows a course to a lap time in s: velocities shrink by one factor, accelerations by its square."""

    def at(share: float) -> Waypoints:
        linear = {"rotation": course.limits.rotation * share}
        names = ("acceleration", "rotation_acceleration", "lateral_acceleration")
        square = {name: getattr(course.limits, name) * share**2 for name in names}
        limits = course.limits.model_copy(update=linear | square)
        return course.model_copy(update={"speed": course.speed * share, "limits": limits})

    share = brentq(lambda share: at(share).period - period, 0.5 * course.period / period, 1.0)
    return at(float(share))  # type: ignore[arg-type]
