"""Sweeps as data: turns a sweep file into the scenarios of its runs. `sweep.jobs` runs them, `sweep.store` keeps them.

Run i is a pure function of the sweep and i. The runs are the Cartesian product of the axes that list their values, in
the order of the file, with the first axis slowest; each combination is drawn `runs` times, and the number of the draw
changes fastest. A draw takes the seed of the scenario and the value of every distribution from a random stream of its
own, so neither the order in which runs are computed nor the other runs of a batch change it. Combinations that differ
only in `paired` axes share their draws.
"""

from __future__ import annotations

import contextlib
import copy
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cached_property
from itertools import product
from multiprocessing import parent_process
from typing import Annotated, Any, Literal, Self

import numpy as np
import pyarrow as pa
from pydantic import Field, model_validator
from tqdm import tqdm

from mrctl.record import InputError, Record, instead, printable
from mrctl.results.dataset import FAULTS, SIGNALS
from mrctl.results.metrics import METRICS
from mrctl.scenario import Scenario, replicates
from mrctl.sweep.axes import CONTROLLER_FIELD, SCENARIO_FIELD, Axis, Chosen
from mrctl.theory.robot import RobotFile

CHUNK_BYTES = 2**27  # largest size of the signals of a job in memory
# runs in a job: a core does 10 runs a second in jobs of 4, 12 of 8, 14 of 16, 15 of 32, 16 of 64
MIN_JOB_RUNS, MAX_JOB_RUNS = 4, 64
MIN_JOBS = 16  # number of jobs, at least, of a sweep that is large enough: an interrupt loses those under way
MAX_SIGNAL_BYTES = 2**43  # largest size of the signals of all runs in bytes, before compression
TRIED_RUNS = 20  # number of first runs, at least one of which must have a valid scenario
QUIET_TIME = 2.0  # s for which values are checked without a progress bar
FILE_FIELDS = "learned", "fel.weights"  # fields of the scenario with the name of a file that each run reads


def _given(value: Any) -> Any:  # noqa: ANN401
    """Returns a dumped value without the fields of records that are not set."""
    if isinstance(value, dict):
        return {k: _given(v) for k, v in value.items() if v is not None}
    return [_given(v) for v in value] if isinstance(value, list) else value


class Sweep(Record):
    """Many runs: a base scenario, and the axes along which it varies."""

    foreign = dict.fromkeys(
        (name for name in Scenario.model_fields if name != "seed"),
        "is a field of a scenario, which `mrctl run FILE` drives; a sweep has its fields in base",
    )

    base: Scenario = Scenario()
    """Scenario that the runs have in common; each run has a seed drawn for it, of 2³² ones, unless `seed`
    is an axis."""
    axes: tuple[Axis, ...] = ()
    """Axes that vary. Put those that split batches (learner, steering, world) first: large batches are fast."""
    runs: Annotated[int, Field(ge=1, le=100_000_000)] = 1
    """Number of draws of seed and distributions for each combination of the listed values."""
    replicates: bool = False
    """Whether the seed of each run also draws its robot, as `mrctl.replicates` does: mass, motors, friction, wheel
    radii and slope differ a little from those that `base` and axes give. Otherwise it draws only start and noise."""
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 0
    """Seed of all draws."""
    record: Literal["metrics", "laps", "decimated", "full"] = "metrics"
    """Record to keep. `metrics`: metrics of the last lap. `laps`: these, and metrics of every lap as lists in the
    table. `decimated`: metrics of the last lap and every `every`-th sample of the signals. `full`: all samples."""
    every: Annotated[int, Field(ge=1, le=1_000_000)] | None = None
    """Control periods between samples of a decimated record; by default 10."""
    chunk: Annotated[int, Field(ge=1, le=65536)] | None = None
    """Number of runs in a job; by default 64, or fewer where the runs are long or fewer than 1,024."""
    controller: str | None = None
    """Feedforward of the user instead of the named one, as `my_file.py:MyController`, or other stages, as
    `motion=my_file.py:PurePursuit`, in all runs; see `mrctl.loop.user_files`. An axis `controller` varies it."""
    hindsight: bool = False
    """Whether each run is driven with the best fixed feedforward in hindsight instead of its own; see
    `mrctl.loop.hindsight`."""

    @classmethod
    def of(cls, scenarios: Sequence[Scenario], **settings: Any) -> Self:  # noqa: ANN401
        """Makes a sweep whose run i is `scenarios[i]`; `settings` are further fields, all but `base` and `axes`."""
        default = Scenario().model_dump(mode="json")
        every = [s.model_dump(mode="json") for s in scenarios]
        changes = [{k: _given(v) for k, v in one.items() if k == "seed" or v != default[k]} for one in every]
        return cls.from_dict({**settings, "axes": [{"field": SCENARIO_FIELD, "values": changes}]}, "sweep")

    @model_validator(mode="after")
    def _runnable(self) -> Sweep:
        fields = [axis.field for axis in self.axes]
        for name in fields:
            if fields.count(name) > 1:
                raise ValueError(f"axes: {name} is there twice")
        if self.hindsight and self.controller:
            raise ValueError("hindsight: drives with a feedforward of its own; give no controller")
        self._check_controllers()
        if self.every and self.record != "decimated":
            raise ValueError('every: only where record = "decimated"')
        for group in self._dimensions:
            if len({len(self.axes[a].listed) for a in group}) > 1 or len({self.axes[a].paired for a in group}) > 1:
                names = ", ".join(self.axes[a].field for a in group)
                raise ValueError(f"axes: {names} are zipped, but differ in length or in `paired`")
        if self.size > 100_000_000:
            raise ValueError(f"runs: {self.size:,} of them, at most 100,000,000")
        self._check_values()
        kept = self.size * self._longest // self.stride * 8 * len(SIGNALS)
        if self.record in ("decimated", "full") and kept > MAX_SIGNAL_BYTES:
            raise ValueError(f"record: {self.size:,} runs would keep {kept / 1e12:,.0f} TB of signals; keep metrics")
        return self

    def check_draws(self) -> None:
        """Refuses a seed and values without effect, and runs that are exact copies but would count as independent ones.

        This is no part of the validation, because stores of older versions hold such sweeps.

        Raises:
            InputError: There is one of these; the message names the field.
        """
        if self.base.seed:
            raise InputError("base.seed: has no effect, because each run gets its own; set seed, or an axis seed")
        sets_seed = [axis.field for axis in self.axes if "seed" in axis.fields]
        if self.runs > 1 and sets_seed and all(axis.listed for axis in self.axes):
            raise InputError(f"runs: the axis {sets_seed[0]} sets the seed, so that all {self.runs} draws are copies")
        for axis in self.axes:
            if (grid := axis.grid) and grid.count == 1 and grid.start != grid.stop:
                raise InputError(f"{axis.field}: a grid of one value cannot hold both {grid.start:g} and {grid.stop:g}")
        for group in self._dimensions:
            seen = set()
            for values in zip(*(self.axes[a].listed for a in group), strict=True):
                key = json.dumps(values, sort_keys=True, default=str)
                if key in seen and SCENARIO_FIELD not in sets_seed:  # a list of scenarios may have one twice
                    names = ", ".join(self.axes[a].field for a in group)
                    raise InputError(f"{names}: a value is there twice, {printable(key[1:-1])}")
                seen.add(key)
        for place, later in enumerate(self.axes):
            before = [field for axis in self.axes[:place] for field in axis.fields]
            for field, whole in product(before, later.fields):
                if f"{field}.".startswith(f"{whole}."):
                    how = "give it once" if field == whole else f"put the axis {later.field} first"
                    raise InputError(f"{field}: the axis {later.field} comes later and replaces it; {how}")

    def _check_controllers(self) -> None:
        """Refuses an axis of controllers beside something else that says what drives, or with ambiguous names."""
        if not self._chosen:
            return
        if self.controller or self.hindsight:
            other = "controller" if self.controller else "hindsight"
            raise ValueError(f"{other}: leave it out beside an axis controller")
        for axis, name in product(self.axes, ("prior", "learner")):
            if name in axis.fields:
                raise ValueError(f"{axis.field}: the axis controller sets {name}; leave it out here")
        titles = [
            self._chosen[value].title for axis in self.axes if axis.field == CONTROLLER_FIELD for value in axis.listed
        ]
        if doubles := [title for title in titles if titles.count(title) > 1]:
            raise ValueError(f"controller: two values have the name {doubles[0]} in the table")

    def _check_values(self) -> None:
        """Checks that each listed value and each end of a range gives a valid scenario.

        The other axes are at their first listed value, or in the middle of their distribution.
        """
        trials = [{}]
        for group in self._dimensions:
            trials += [{self.axes[a].field: self.axes[a].listed[k] for a in group} for k in range(self._length(group))]
        trials += [{axis.field: end} for axis in self.axes for end in axis.uniform or axis.loguniform or ()]
        silent = parent_process() is not None  # a worker reads a sweep that has been checked
        bar = tqdm(trials, desc="checks the values", unit="value", delay=QUIET_TIME, leave=False, disable=silent)
        periods = {self._assemble(self._middle | trial).control_period for trial in bar}
        if len(periods) > 1 and self.record in ("decimated", "full"):
            raise ValueError("control_period: signals share their time axis; keep it, or record metrics")
        first = range(min(self.size, TRIED_RUNS))
        if not any(self.valid(run) for run in first):
            self.scenario(0)  # raises the error of the first run

    @cached_property
    def _middle(self) -> dict[str, Any]:
        """The first listed value of each axis, or the middle of its distribution, by field."""
        return {"seed": 0} | {axis.field: axis.listed[0] if axis.listed else axis.middle for axis in self.axes}

    @property
    def control_period(self) -> float:
        """Control period in s of all runs whose signals are kept; the others may differ."""
        return self._assemble(self._middle).control_period

    @cached_property
    def _dimensions(self) -> list[list[int]]:
        """Groups of axes that change together, in the order of the file."""
        groups: dict[str, list[int]] = {}
        for number, axis in enumerate(self.axes):
            if axis.listed:
                groups.setdefault(axis.zip or f"axis {number}", []).append(number)
        return list(groups.values())

    @cached_property
    def _shape(self) -> tuple[int, ...]:
        """Number of values in each dimension, followed by the number of draws."""
        return (*map(self._length, self._dimensions), self.runs)

    def _length(self, group: list[int]) -> int:
        return len(self.axes[group[0]].listed)

    @cached_property
    def _chosen(self) -> dict[str, Chosen]:
        """What the values of the axis of controllers stand for; nothing where there is no such axis."""
        return next((axis.chosen for axis in self.axes if axis.field == CONTROLLER_FIELD), {})

    def driven_by(self, run: int) -> str | None:
        """Returns the controller of the user that drives one run, or None."""
        return self._chosen[self.values(run)[CONTROLLER_FIELD]].own if self._chosen else self.controller

    def base_of(self, run: int) -> Scenario:
        """Returns the base with what the axis of controllers sets in one run, which need not be valid itself."""
        if not self._chosen:
            return self.base
        return self.base.replace(**self._chosen[self.values(run)[CONTROLLER_FIELD]].fields)

    @property
    def drivers(self) -> dict[str | None, list[int]]:
        """Controllers of the user that drive runs, None for mrctl's own, each with some of the first such runs."""
        if not self._chosen:
            return {self.controller: list(range(min(self.size, TRIED_RUNS)))}
        found: dict[str | None, list[int]] = {}
        place = next(number for number, axis in enumerate(self.axes) if axis.field == CONTROLLER_FIELD)
        dimension = next(number for number, group in enumerate(self._dimensions) if place in group)
        block = int(np.prod(self._shape[dimension + 1 :], dtype=object))
        for k, one in enumerate(self._chosen.values()):
            found.setdefault(one.own, []).extend(range(k * block, k * block + min(block, TRIED_RUNS)))
        return found

    @property
    def size(self) -> int:
        """Number of runs."""
        return int(np.prod(self._shape, dtype=object))

    @cached_property
    def chunk_size(self) -> int:
        """Number of runs in a job; it depends on the file alone, so that the store does for any number of workers."""
        share = 2 ** (self.size // MIN_JOBS).bit_length() // 2  # a power of two, so that runs are compressed together
        largest = CHUNK_BYTES // (8 * len(SIGNALS) * self._longest)
        return self.chunk or max(1, min(largest, max(MIN_JOB_RUNS, min(share, MAX_JOB_RUNS))))

    @property
    def stride(self) -> int:
        """Number of control periods between samples that are kept."""
        return self.every or 10 if self.record == "decimated" else 1

    @cached_property
    def samples(self) -> int:
        """Number of samples that the store keeps of the longest run; 0 if it keeps metrics only."""
        if self.record in ("metrics", "laps"):
            return 0
        return -(-self._ticks(range(self.size)) // self.stride)

    @cached_property
    def _longest(self) -> int:
        """Number of control periods of the longest run, of a thousand at random where there are more."""
        some: Iterable[int] = range(self.size)
        if self.size > 1000:
            some = np.random.default_rng(0).integers(self.size, size=1000).tolist()
        return self._ticks(some)

    def _ticks(self, runs: Iterable[int]) -> int:
        """Returns the number of control periods of the longest of some runs."""
        ticks = self.base.ticks
        if any(axis.field.startswith((SCENARIO_FIELD, "laps", "reference", "control_period")) for axis in self.axes):
            ticks = max((scenario.ticks for run in runs if (scenario := self.valid(run))), default=ticks)
        return ticks

    def values(self, run: int) -> dict[str, Any]:
        """Returns the value of each axis in one run, by field, and the seed.

        Raises:
            InputError: There is no such run.
        """
        if not 0 <= run < self.size:
            raise InputError(f"run: {run} is not in 0 to {self.size - 1}")
        *place, draw = (int(k) for k in np.unravel_index(run, self._shape))
        unpaired = [k for k, group in enumerate(self._dimensions) if not self.axes[group[0]].paired]
        key = [place[k] for k in unpaired] + [draw]
        stream = int(np.ravel_multi_index(key, [self._shape[k] for k in unpaired] + [self.runs]))
        values: dict[str, Any] = {"seed": int(np.random.SeedSequence((self.seed, stream)).generate_state(1)[0])}
        where = {a: k for k, group in zip(place, self._dimensions, strict=True) for a in group}
        for number, axis in enumerate(self.axes):
            if number in where:
                values[axis.field] = axis.listed[where[number]]
            else:
                key = np.random.SeedSequence((self.seed, stream, number))
                values[axis.field] = axis.draw(np.random.Generator(np.random.Philox(key)))
        return values

    def scenario(self, run: int) -> Scenario:
        """Returns the scenario of one run.

        Raises:
            InputError: There is no such run, or a value that was drawn for it is out of range.
        """
        one = self._assemble(self.values(run), f"run {run}")
        return replicates(one, 1, one.seed)[0] if self.replicates else one

    def valid(self, run: int) -> Scenario | None:
        """Returns the scenario of one run, or None if a value that was drawn for it is out of range."""
        try:
            return self.scenario(run)
        except InputError:
            return None

    def _assemble(self, values: dict[str, Any], source: str = "") -> Scenario:
        data = self._plain
        for field, value in values.items():
            if field == CONTROLLER_FIELD and self._chosen:
                data = data | self._chosen[value].fields
                continue
            data = data | value if field == SCENARIO_FIELD and isinstance(value, dict) else _put(data, field, value)
            inner = isinstance(value, str) and any(other.startswith(f"{field}.") for other in values)
            if isinstance(value, dict) or inner:  # a table, or a name for one, is completed: later axes find its fields
                data = Scenario.from_dict(data, source).model_dump(mode="json")
        return Scenario.from_dict(data, source)

    @cached_property
    def _plain(self) -> dict[str, Any]:
        return self.base.model_dump(mode="json")

    @property
    def files(self) -> set[str]:
        """Files from which learners start, as the base and the listed values name them."""
        values = [(SCENARIO_FIELD, self._plain), *((axis.field, value) for axis in self.axes for value in axis.listed)]
        return {file for field, value in values for file in _named_files(field, value)}

    def with_files(self, names: Mapping[str, str]) -> Self:
        """Returns the sweep with other names of its `files`."""
        if not names:
            return self
        base = Scenario.from_dict(_with_files(SCENARIO_FIELD, self._plain, names))
        axes = [
            axis.replace(values=[_with_files(axis.field, value, names) for value in axis.values])
            if axis.values is not None
            else axis
            for axis in self.axes
        ]
        return self.replace(base=base, axes=axes)

    @cached_property
    def worlds(self) -> list[tuple[str, Any, RobotFile]]:
        """Worlds, steering arrangements and robots that the runs combine."""
        names = SCENARIO_FIELD, "world", "steering", "robot"
        groups = [g for g in self._dimensions if any(self.axes[a].field.split(".")[0] in names for a in g)]
        found = set()
        for place in product(*(range(self._length(group)) for group in groups)):
            values = {self.axes[a].field: self.axes[a].listed[k] for k, g in zip(place, groups, strict=True) for a in g}
            with contextlib.suppress(InputError):  # no scenario, and so no run, has these values
                one = self._assemble(self._middle | values)
                found.add((one.world, one.steering, one.robot))
        return sorted(found, key=str)

    @cached_property
    def columns(self) -> pa.Schema:
        """Columns of the table of runs: number, axes, description, failure, metrics, and metrics of every lap."""
        columns: dict[str, tuple[pa.DataType, str]] = {"run": (pa.int64(), "1")}
        columns |= {axis.field: (axis.type, "") for axis in self.axes}
        for name, kind, unit in (
            ("label", pa.string(), ""), ("feedforward", pa.string(), ""), ("steering", pa.string(), ""),
            ("seed", pa.int64(), "1"), ("lap_time", pa.float64(), "s"), ("laps", pa.int64(), "1"),
            ("samples", pa.int64(), "1"),
            ("failed", pa.bool_(), "1"), ("failure_time", pa.float64(), "s"), ("failure", pa.string(), ""),
            *((name, pa.string(), "") for name in FAULTS),
        ):  # fmt: skip
            columns.setdefault(name, (kind, unit))
        columns |= {name: (pa.float64(), unit) for name, (unit, _) in METRICS.items()}
        if self.record == "laps":
            columns |= {f"{name}_per_lap": (pa.list_(pa.float64()), unit) for name, (unit, _) in METRICS.items()}
        return pa.schema([pa.field(name, kind, metadata={"units": u}) for name, (kind, u) in columns.items()])


def _inner(field: str, key: str) -> str:
    """Returns the dotted path of what has this key in the table at a path."""
    return key if field == SCENARIO_FIELD else f"{field}.{key}"


def _named_files(field: str, value: object) -> Iterator[str]:
    """Yields the names of files in a value of the field at a dotted path."""
    if field in FILE_FIELDS and isinstance(value, str):
        yield value
    elif isinstance(value, dict):
        for key, part in value.items():
            yield from _named_files(_inner(field, key), part)


def _with_files(field: str, value: object, names: Mapping[str, str]) -> Any:  # noqa: ANN401
    """Returns a value of the field at a dotted path with other names of files."""
    if field in FILE_FIELDS and isinstance(value, str):
        return names[value]
    if isinstance(value, dict):
        return {key: _with_files(_inner(field, key), part, names) for key, part in value.items()}
    return value


def _put(data: Any, field: str, value: object) -> Any:  # noqa: ANN401
    """Returns nested tables and lists in which the field at a dotted path has another value; the rest is shared.

    Raises:
        InputError: There is no such field.
    """
    node, parts, passed = data, field.split("."), []
    for depth, part in enumerate(parts):
        known = dict(enumerate(node)) if isinstance(node, list) else node if isinstance(node, dict) else {}
        names = {str(key): key for key in known}
        if part not in names:
            Scenario.refuse_moved(field)
            where = ".".join(parts[:depth]) or "the scenario"
            raise InputError(f"{field}: no {part!r} in {where}{instead(part, list(names))}")
        passed.append((node, names[part]))
        node = node[names[part]]
    for node, key in reversed(passed):
        changed = copy.copy(node)
        changed[key] = value
        value = changed
    return value
