"""The complete description of a run as data.

A `Scenario` is read from TOML or made in Python; its fields are the flags of `mrctl run` and the viewer's controls.
"""

from __future__ import annotations

from math import ceil
from typing import Annotated, Any, Literal, get_args

import numpy as np
from pydantic import Field, field_validator, model_validator

from mrctl.control.composite import Composite
from mrctl.control.fel import Fel
from mrctl.control.guard import Guard
from mrctl.control.indi import Indi
from mrctl.control.kanayama import Kanayama
from mrctl.control.l1 import L1
from mrctl.control.learners import LEARNERS, LearnerName
from mrctl.control.mrac import Mrac
from mrctl.control.observer import Observer
from mrctl.control.pid import Pid
from mrctl.control.rls import Rls
from mrctl.record import InputError, Record, is_whole
from mrctl.sensing.tiers import Sensing
from mrctl.theory.obstacles import Known, Obstacles
from mrctl.theory.perturbation import Perturbation
from mrctl.theory.references import Lemniscate, Reference
from mrctl.theory.robot import CAR, RobotFile, Steering

PriorName = Literal["none", "model", "true_model"]
MODEL_BASED = tuple(name for name, law in LEARNERS.items() if law.needs_model)
"""Learners that compare the robot with a model, so that the prior must be a model."""


def controller_name(*parts: str) -> str:
    """Returns the name of a controller in tables, from those of prior, learner and the user's stages.

    `none` is left out if there is anything else: `none`, `model`, `fel`, `model+fel`, `PurePursuit`, `fel+PurePursuit`.
    """
    return "+".join(part for part in parts if part != "none") or "none"


FeedforwardName = Literal[
    "none", "model", "true_model", "model+observer", "model+indi", "model+l1", "fel", "model+fel", "rls", "model+rls",
    "mrac", "model+mrac", "composite", "model+composite",
]  # fmt: skip
_PAIRS = {controller_name(p, n): {"prior": p, "learner": n} for p in get_args(PriorName) for n in get_args(LearnerName)}
FEEDFORWARDS: dict[FeedforwardName, dict[str, Any]] = {name: _PAIRS[name] for name in get_args(FeedforwardName)}
"""Pairs of a prior and a learner, as fields of a scenario, by their names."""
COMPARED: tuple[FeedforwardName, ...] = tuple(
    name for name, pair in FEEDFORWARDS.items() if pair["prior"] != "none" or name in ("none", "fel")
)
"""Feedforwards that the tables compare: all with a prior and, without one, PID alone and the paper's network."""
MAX_TICKS = 10_000_000
"""Largest number of control periods in a run; the log takes 488 bytes for each."""

Spread = Annotated[float, Field(ge=0, le=0.2)]


class Event(Record):
    """A change at one moment of a run; fields that are left out change nothing."""

    time: Annotated[float, Field(ge=0, le=1e8)]
    """Time of the event in s; it takes effect at the first control tick that is not earlier."""
    perturbation: Perturbation | None = None
    """Perturbation of the plant from then on, which replaces the previous one, so that what shall stay is repeated."""
    push: tuple[float, float, float] | None = None
    """Push on the chassis: forces along the world's x and y in N, and a torque about z in N·m; pushes that overlap add
    up."""
    push_duration: Annotated[float, Field(gt=0, le=10)] = 0.1
    """Duration of the push in s."""
    reference: Reference | None = None
    """Reference from then on, which begins at its own start; laps still have the period of the scenario's reference."""
    kanayama: Kanayama | None = None
    """Gains of the motion controller from then on; refused if it takes none: `window`, `mppi`, and a user's stage
    without `tune`."""
    pid: Pid | None = None
    """Settings of the velocity PID from then on; the gains of the motion controller stay, and so does the delay that
    oscillations have added. With `retune` off or a `time_constant` the PID is designed without that delay, and the
    motion controller stays as slow as it is. Refused where a user's stage takes the place of the PID."""
    learning: bool | None = None
    """Whether the feedforward learns from then on; `observer`, `indi` and `l1`, which do not learn, go on."""

    @model_validator(mode="after")
    def _changes(self) -> Event:
        if all(getattr(self, name) is None for name in set(type(self).model_fields) - {"time", "push_duration"}):
            raise ValueError("changes nothing: it needs a perturbation, push, reference, kanayama, pid or learning")
        return self

    def tick(self, period: float) -> int:
        """Returns the first control tick that is not before the event; `period` is the control period in s."""
        return ceil(self.time / period - 1e-9)


class Scenario(Record):
    """One run of a robot along a reference; the same scenario gives the same result, bit for bit."""

    moved = {
        "measurement": "set sensing.estimator to truth or odometry",
        "feedforward": "set prior and learner, such as prior model and learner composite",
    }

    foreign = {
        "shapes": "is a field of obstacles; `mrctl navigate FILE --goal X,Y,θ` drives among them, and "
        'obstacles = "FILE" in a scenario names them',
        **dict.fromkeys(
            ("base", "axes", "runs"), "is a field of a sweep, which `mrctl sweep FILE --out FOLDER` computes"
        ),
        "controller": "a scenario names no controller of your own; `mrctl run FILE --controller "
        "my_file.py:MyController` drives with one, and a sweep has a field controller",
    }

    name: str = ""
    """Tables and figures give the run this label; by default that of the feedforward."""
    world: str = "flat"
    """The robot drives in `flat`, `slope`, `rough`, `patch`, or an MJCF file at this path."""
    obstacles: Obstacles = Obstacles()
    """Obstacles that stand in the world or move in it, or the path of a TOML file of them; a run ends when the robot
    touches one."""
    map: Known | None = None
    """Obstacles on the map, with which missions plan and a lidar is localised, or the path of a TOML file of them; by
    default those that stand still in the world."""
    robot: RobotFile = CAR
    """Robot that drives; by default the world's own."""
    steering: Steering | None = None
    """The front wheel has a soft servo (`compliant`), none, so that it trails (`caster`), or a stiff one (`rigid`); by
    default the robot's own."""
    reference: Reference = Lemniscate()
    """The robot follows this reference trajectory."""
    laps: Annotated[int, Field(ge=1, le=10_000)] = 8
    """Laps to drive."""
    prior: PriorName = "none"
    """Model that the feedforward starts from; `true_model` has the true constants, for reference."""
    learner: LearnerName = "fel"
    """Adaptive law, whose output is added to that of the prior. `observer`, `indi` and `l1` need a model as prior."""
    sensing: Sensing = Sensing()
    """Sensors, estimator, motor driver, battery, steering servo and delay, which a tier sets."""
    kanayama: Kanayama = Kanayama()
    """Gains of the motion controller, by default designed for the velocity loops."""
    pid: Pid = Pid()
    """Settings of the velocity PID, by default designed for the delay of the loop."""
    fel: Fel = Fel()
    """Settings of the learner `fel`."""
    rls: Rls = Rls()
    """Settings of the learner `rls`."""
    observer: Observer = Observer()
    """Settings of the learner `observer`."""
    learned: str | None = None
    """File of `save_learned`, from which the learner, or a feedforward of your own, starts."""
    indi: Indi = Indi()
    """Settings of the learner `indi`."""
    l1: L1 = L1()
    """Settings of the learner `l1`."""
    mrac: Mrac = Mrac()
    """Settings of the learner `mrac`."""
    composite: Composite = Composite()
    """Settings of the learner `composite`."""
    guard: Guard = Guard()
    """Settings of the guard, which limits or stops a learner that makes the loop worse."""
    perturbation: Perturbation = Perturbation()
    """Initial differences of the plant from its model, such as a mass factor or a payload; or the name of one of
    `mrctl.PERTURBATIONS`, such as `all`."""
    events: tuple[Event, ...] = ()
    """Changes during the run."""
    initial_pose: tuple[float, float, float] | None = None
    """Pose at the start: x and y in m, θ in rad; by default that of the reference."""
    goal: tuple[float, float, float] | None = None
    """Pose at which the run ends: x and y in m, θ in rad; by default only the laps end it. The run fails
    as `stuck` if the robot moves less than 5 cm in 5 s."""
    initial_spread: tuple[Spread, Spread, Annotated[float, Field(ge=0, le=0.5)]] = (0.02, 0.02, 0.03)
    """Standard deviations of a random offset from the initial pose: x and y in m, θ in rad."""
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0
    """Seed of initial offset, weights, noise and biases of the sensors."""
    prefilter: Annotated[float, Field(ge=0.01, le=10)] | None = None
    """Time constant in s of the filter on the velocities that the motion controller adds to the reference; values below
    the control period act as it. By default it is designed."""
    physics_step: Annotated[float, Field(ge=1e-5, le=0.01)] = 0.002
    """Duration of one physics step in s."""
    control_period: Annotated[float, Field(ge=1e-3, le=0.1)] = 0.01
    """Period of the velocity controller in s, a multiple of the physics step."""
    motion_period: Annotated[float, Field(ge=1e-3, le=1)] = 0.01
    """Period of the motion controller in s, a multiple of the control period."""

    @field_validator("name")
    @classmethod
    def _is_utf8(cls, name: str) -> str:
        if any("\ud800" <= character <= "\udfff" for character in name):
            raise ValueError("is not UTF-8")
        return name

    @model_validator(mode="after")
    def _fits_together(self) -> Scenario:
        _check_multiple(self.control_period, self.physics_step, "control_period", "physics_step")
        _check_multiple(self.motion_period, self.control_period, "motion_period", "control_period")
        changes = [("perturbation", self.perturbation)]
        changes += [(f"events.{i}.perturbation", e.perturbation) for i, e in enumerate(self.events) if e.perturbation]
        for name, perturbation in changes:
            _check_multiple(perturbation.control_delay, self.control_period, f"{name}.control_delay", "control_period")
        if self.learner in MODEL_BASED and self.prior == "none":
            raise ValueError(f"prior: the learner {self.learner} compares the robot with a model; set prior to model")
        if not 1 <= self.duration / self.control_period <= MAX_TICKS:
            raise ValueError(f"laps: a run of {self.duration:g} s is not between 1 and {MAX_TICKS:,} control periods")
        self.sensing.check(self.control_period, self.duration)
        return self

    def with_event(self, event: Event) -> Scenario:
        """Returns the scenario with one more event.

        Raises:
            InputError: The event does not fit the run.
        """
        return self.replace(events=(*self.events, event))

    def with_feedforward(self, name: FeedforwardName) -> Scenario:
        """Returns the scenario without its label and with another feedforward, which starts without `learned`."""
        return self.model_copy(update=FEEDFORWARDS[name] | {"name": "", "learned": None})

    @property
    def known(self) -> Obstacles:
        """Obstacles on the map."""
        return self.obstacles.still if self.map is None else self.map

    @property
    def schedule(self) -> list[Event]:
        """The events in the order of their times; those of one time stay in the order in which they are given."""
        return sorted(self.events, key=lambda event: event.time)

    @property
    def feedforward(self) -> str:
        """Name of prior and learner in tables."""
        return controller_name(self.prior, self.learner)

    @property
    def duration(self) -> float:
        """Length of the run in s."""
        return self.laps * self.reference.period

    @property
    def ticks(self) -> int:
        """Number of control periods in the run."""
        return round(self.duration / self.control_period)


def replicates(scenario: Scenario, count: int, first: int = 0) -> list[Scenario]:
    """Returns independent repetitions of a run: each is another robot of the kind, on another day.

    Runs that differ in their noise alone are nearly copies, and say little about robots. Replicate k therefore has the
    seed first + k, and that seed draws its perturbation and, alike, those of its events (`Perturbation.drawn`). The
    draw does not depend on the scenario, so that replicates of two scenarios are pairs.

    Args:
        scenario: The run; its seed is replaced.
        count: Number of replicates.
        first: Seed of the first replicate.

    Raises:
        InputError: There are no replicates, or one would have no valid seed.
    """
    if count < 1:
        raise InputError(f"count: {count} is below 1")
    if first < 0 or first + count > 2**32:
        raise InputError(f"first: {first} to {first + count - 1} are not between 0 and {2**32 - 1}, as seeds are")
    found = []
    for draw in range(first, first + count):
        events = tuple(
            e.model_copy(update={"perturbation": e.perturbation.drawn(np.random.default_rng([draw, 5]))})
            if e.perturbation
            else e
            for e in scenario.events
        )
        drawn = {"perturbation": scenario.perturbation.drawn(np.random.default_rng([draw, 5]))}
        found.append(scenario.model_copy(update={**drawn, "events": events, "seed": draw}))
    return found


def _check_multiple(value: float, unit: float, name: str, unit_name: str) -> None:
    """Raises `ValueError` if a duration is not a whole multiple of another one, both in s; takes the names of both."""
    if not is_whole(value / unit):
        raise ValueError(f"{name}: {value:.9g} s is not a whole multiple of {unit_name} ({unit:.9g} s)")
