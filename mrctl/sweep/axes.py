"""The axes of a sweep: what a field of the scenario takes, and from which list or distribution."""

from __future__ import annotations

import json
from functools import cached_property
from typing import Annotated, Any, NamedTuple, Self

import numpy as np
import pyarrow as pa
from pydantic import Field, model_validator

from mrctl.record import InputError, Record
from mrctl.scenario import FEEDFORWARDS, controller_name

SCENARIO_FIELD = "scenario"  # the field of an axis whose values are tables of changes to the scenario
CONTROLLER_FIELD = "controller"  # the field of an axis whose values say what drives


class Chosen(NamedTuple):
    """What a value of an axis of controllers stands for."""

    title: str
    """Name in the table of runs, without the file of a controller."""
    own: str | None
    """Controller of the user, as for `mrctl.loop.user_files`, or None."""
    fields: dict[str, str]
    """Prior and learner, as fields of the scenario; empty where those of the scenario stay."""

    @classmethod
    def of(cls, value: str) -> Self:
        """Reads a value: a name of `FEEDFORWARDS`, or a controller of the user as `mrctl suite` takes it.

        Raises:
            InputError: It is neither.
        """
        if value in FEEDFORWARDS:
            return cls(value, None, FEEDFORWARDS[value])
        if ".py:" not in value:
            raise InputError(f"controller: {value!r} is neither my_file.py:MyController nor {', '.join(FEEDFORWARDS)}")
        from mrctl.loop import user_files  # imported here because it needs the physics, which takes seconds

        front, own, parts = user_files.behind(value)
        says = front != "none" or any(part.stage == "feedforward" for part in parts)
        title = controller_name(front, "+".join(part.title for part in parts))
        return cls(title, own, FEEDFORWARDS[front] if says else {})


class Grid(Record):
    """Evenly spaced numbers from `start` to `stop`, both included."""

    start: float
    """First value."""
    stop: float
    """Last value."""
    count: Annotated[int, Field(ge=1, le=10_000)]
    """Number of values."""


class Axis(Record):
    """One field of the scenario and its values: a list, a grid, or a distribution."""

    field: Annotated[str, Field(min_length=1)]
    """Dotted path into the scenario, such as `perturbation.mass_factor` or `events.0.time`; or `scenario`, whose values
    are tables of changes to the scenario, such as `{ laps = 4, perturbation = { payload = 5.0 } }`; or `controller`,
    whose values are feedforwards such as `model+fel`, or controllers of the user such as `my_file.py:Mine(gain=2)`."""
    values: Annotated[tuple[Any, ...], Field(min_length=1)] | None = None
    """List of values; a value may be a whole table, such as a perturbation."""
    grid: Grid | None = None
    """Evenly spaced numbers, `{ start, stop, count }`."""
    uniform: tuple[float, float] | None = None
    """Lowest and highest value of a uniform distribution."""
    normal: tuple[float, Annotated[float, Field(gt=0)]] | None = None
    """Mean and standard deviation of a normal distribution."""
    loguniform: tuple[Annotated[float, Field(gt=0)], float] | None = None
    """Lowest and highest value of a distribution that is uniform in the logarithm."""
    paired: bool = False
    """Whether every value gets the same seeds and the same draws, for a paired comparison."""
    zip: str = ""
    """Name of a group of axes that change together, value by value; "" for an axis that changes on its own."""

    @model_validator(mode="after")
    def _one_kind(self) -> Axis:
        kinds = ("values", "grid", "uniform", "normal", "loguniform")
        if sum(getattr(self, kind) is not None for kind in kinds) != 1:
            raise ValueError(f"{self.field}: needs exactly one of {', '.join(kinds)}")
        if not self.listed and (self.paired or self.zip):
            raise ValueError(f"{self.field}: only values and grids can be paired or zipped")
        if self.field == CONTROLLER_FIELD and not all(isinstance(value, str) for value in self.values or (None,)):
            raise ValueError('controller: needs values that are names, such as "fel" or "my_file.py:MyController"')
        if self.field == SCENARIO_FIELD and not all(isinstance(value, dict) for value in self.values or (None,)):
            raise ValueError("scenario: needs values that are tables of changes, such as { laps = 4 }")
        for low, high in filter(None, (self.uniform, self.loguniform)):
            if not low < high:
                raise ValueError(f"{self.field}: {low:g} is not below {high:g}")
        return self

    @cached_property
    def listed(self) -> tuple[Any, ...]:
        """Values of a list or grid; a distribution has none."""
        if self.grid is not None:
            return tuple(np.linspace(self.grid.start, self.grid.stop, self.grid.count).tolist())
        return self.values or ()

    @cached_property
    def chosen(self) -> dict[str, Chosen]:
        """What the values of an axis of controllers stand for; nothing for other axes.

        Raises:
            InputError: A value is no controller.
        """
        return {value: Chosen.of(value) for value in self.listed} if self.field == CONTROLLER_FIELD else {}

    @property
    def fields(self) -> list[str]:
        """Dotted paths of what the axis sets: its field, or the keys of its tables of changes to the scenario."""
        if self.field == SCENARIO_FIELD:
            return sorted({key for value in self.listed for key in value})
        return [self.field]

    @property
    def middle(self) -> float:
        """Mean of a normal distribution, or the middle of the range of another."""
        if self.normal is not None:
            return self.normal[0]
        return sum(self.uniform or self.loguniform or ()) / 2

    def draw(self, random: np.random.Generator) -> float:
        """Draws a number from the distribution."""
        if self.uniform is not None:
            return float(random.uniform(*self.uniform))
        if self.normal is not None:
            return float(random.normal(*self.normal))
        assert self.loguniform is not None
        low, high = self.loguniform
        return float(np.clip(np.exp(random.uniform(np.log(low), np.log(high))), low, high))

    @cached_property
    def type(self) -> pa.DataType:
        """Type of the axis's column in the table of runs; tables and values of mixed types are JSON text."""
        kinds = {type(value) for value in self.listed}
        for kind, found in ((pa.bool_(), {bool}), (pa.int64(), {int}), (pa.float64(), {int, float})):
            if kinds <= found and kinds:
                return kind
        return pa.string() if kinds else pa.float64()

    def cell(self, value: object) -> object:
        """Returns a value as the table of runs holds it."""
        if isinstance(value, str) and value in self.chosen:
            return self.chosen[value].title
        return json.dumps(value) if self.type == pa.string() and not isinstance(value, str) else value
