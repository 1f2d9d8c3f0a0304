"""The complete description of a run, as data: read from TOML, edited from Python, source of the command-line flags."""

from __future__ import annotations

from math import ceil
from typing import Annotated, Literal

from pydantic import Field, model_validator

from mrctl.control.composite import Composite
from mrctl.control.fel import Fel
from mrctl.control.guard import Guard
from mrctl.control.kanayama import Kanayama
from mrctl.control.observer import Observer
from mrctl.control.pid import Pid
from mrctl.control.rls import Rls
from mrctl.record import Record
from mrctl.theory.perturbation import Perturbation
from mrctl.theory.references import Lemniscate, Reference
from mrctl.theory.robot import CAR, RobotFile, Steering

FeedforwardName = Literal["none", "model", "oracle", "observer", "fel", "rls", "composite"]
FEEDFORWARDS: tuple[FeedforwardName, ...] = ("none", "model", "oracle", "observer", "fel", "rls", "composite")
LONGEST = 10_000_000  # control periods in a run; its record takes 290 bytes each


Spread = Annotated[float, Field(ge=0, le=0.2)]


class Event(Record):
    """Something that happens at one moment of a run. What is left out stays as it is."""

    time: Annotated[float, Field(ge=0, le=1e8)]
    """When, in s; takes effect at the first control tick that is not before."""
    perturbation: Perturbation | None = None
    """The plant's complete perturbation from now on."""
    push: tuple[float, float, float] | None = None
    """Forces along the world's x and y on the chassis in N, torque about z in N·m."""
    push_duration: Annotated[float, Field(gt=0, le=10)] = 0.1
    """How long the push lasts in s."""
    reference: Reference | None = None
    """What to follow from now on, from its own start; laps are still counted by the first reference."""
    kanayama: Kanayama | None = None
    """New gains of the motion controller."""
    pid: Pid | None = None
    """New design of the velocity controller."""
    learning: bool | None = None
    """Switches learning on or off."""

    def tick(self, period: float) -> int:
        """The first control tick that is not before the event; `period` is the control period in s."""
        return ceil(self.time / period - 1e-9)


class Scenario(Record):
    """One run. A run is a pure function of its scenario."""

    name: str = ""
    """Label of the run in tables and figures; by default the feedforward's name."""
    world: str = "flat"
    """`flat`, `slope`, `rough`, `patch`, or the path of an MJCF file."""
    robot: RobotFile = CAR
    """Whose robot drives there; by default the world's own."""
    steering: Steering = "compliant"
    """Steering arrangement of the front wheel."""
    reference: Reference = Lemniscate()
    """What the robot shall follow."""
    laps: Annotated[int, Field(ge=1, le=10_000)] = 8
    """How often."""
    feedforward: FeedforwardName = "fel"
    """Feedforward of the velocity controller."""
    measurement: Literal["truth", "odometry"] = "truth"
    """What the controller sees: the true pose and twist, or encoders and gyro."""
    kanayama: Kanayama = Kanayama()
    """Motion controller."""
    pid: Pid = Pid()
    """Feedback part of the velocity controller."""
    fel: Fel = Fel()
    """Settings of the `fel` feedforward."""
    rls: Rls = Rls()
    """Settings of the `rls` feedforward."""
    observer: Observer = Observer()
    """Settings of the `observer` feedforward."""
    composite: Composite = Composite()
    """Settings of the `composite` feedforward."""
    guard: Guard = Guard()
    """Watchdog on a feedforward that learns."""
    perturbation: Perturbation = Perturbation()
    """How the plant differs from the model, from the start."""
    events: tuple[Event, ...] = ()
    """What happens during the run."""
    initial_pose: tuple[float, float, float] | None = None
    """Posture at the start in m, m, rad; by default the reference's own."""
    initial_spread: tuple[Spread, Spread, Annotated[float, Field(ge=0, le=0.5)]] = (0.02, 0.02, 0.03)
    """Standard deviations of the seeded offset from that posture in m, m, rad."""
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0
    """Seed of the initial offset, the initial weights and the sensor noise."""
    prefilter: Annotated[float, Field(ge=0.01, le=1)] = 0.05
    """Time constant of the filter on what the motion controller adds to the reference, s."""
    physics_step: Annotated[float, Field(ge=1e-5, le=0.01)] = 0.002
    """Time step of the physics in s."""
    control_period: Annotated[float, Field(ge=1e-3, le=0.1)] = 0.01
    """Period of the velocity controller, a multiple of `physics_step`, s."""
    motion_period: Annotated[float, Field(ge=1e-3, le=1)] = 0.01
    """Period of the motion controller, a multiple of `control_period`, s."""

    @model_validator(mode="after")
    def _multiples(self) -> Scenario:
        whole(self.control_period, self.physics_step, "control_period", "physics_step")
        whole(self.motion_period, self.control_period, "motion_period", "control_period")
        changes = [("perturbation", self.perturbation)]
        changes += [(f"events.{i}.perturbation", e.perturbation) for i, e in enumerate(self.events) if e.perturbation]
        for name, perturbation in changes:
            whole(perturbation.control_delay, self.control_period, f"{name}.control_delay", "control_period")
        if not 1 <= self.duration / self.control_period <= LONGEST:
            raise ValueError(f"laps: a run of {self.duration:g} s is not between 1 and {LONGEST:,} control periods")
        return self

    def with_event(self, event: Event) -> Scenario:
        """The same run with one event more.

        Raises:
            InputError: It does not fit the run.
        """
        values = {name: getattr(self, name) for name in Scenario.model_fields}
        return Scenario.from_dict(values | {"events": (*self.events, event)})

    @property
    def duration(self) -> float:
        """Length of the run in s."""
        return self.laps * self.reference.period

    @property
    def ticks(self) -> int:
        """Control periods in the run."""
        return round(self.duration / self.control_period)


def whole(value: float, unit: float, name: str, unit_name: str) -> int:
    """How many `unit` fit in `value`.

    Raises:
        ValueError: It is no whole number.
    """
    count = round(value / unit)
    if abs(count * unit - value) > 1e-9 * max(unit, value):
        raise ValueError(f"{name}: {value:g} s is not a whole multiple of {unit_name} ({unit:g} s)")
    return count
