"""`mrctl tune --search`: finds settings of a controller; budget, worlds and objective are the same for all.

**Worlds.** A world is a random spline, driven twice, and a plant of one of the `KINDS`. Its draws, and those of
`replicates`, have seeds from `cases.TUNING_SEEDS`, which neither the suite nor the held-out set uses. The robot
starts on the reference, as a random offset would hide the first seconds of learning. The guard is off: it would hide
that a setting makes the loop oscillate, and settings must be stable without it.

**Objective.** With the errors e of a run over all its laps, and those of the feedforward `model` in the same world,

    J = mean over worlds of ½ log(e/e_model of position) + ¼ log(… of V) + ¼ log(… of θ̇)

exp J is a weighted geometric mean of ratios. In a mean of logarithms every world and every metric has its weight,
whatever the size of the error; in a mean of errors the hardest world would decide alone. Position counts as much as
both velocities: it is what a user sees, and the velocities are what a learner acts on. All laps count, so that a
setting pays for learning slowly. To each error a floor is added, below which a difference means nothing to a user
(`ERROR_FLOORS`). A run that fails counts as `MAX_RATIO` times the error of `model`, and none counts as more: one loss
among 16 worlds costs as much as 15 % of the error in all of them. In two of the eight kinds of worlds the motors act 10
ms later than the controller knows, in one of these with a light robot; this keeps settings off the edge of stability.
With 20 ms, which PID alone bears in `lab`, the search slows a learner down until it corrects little: the observer to T
= 3.2 s.

**Search.** CMA-ES (Hansen 2016, arXiv:1604.00772) searches in the logarithm of the settings, from the shipped ones on,
in the same worlds in each generation. The shipped settings are a candidate too, so that the result is never worse
in these worlds. Whether it is better elsewhere is measured in fresh worlds.
"""

from __future__ import annotations

import hashlib
import inspect
import sys
from collections.abc import Callable, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from cmaes import CMA
from tqdm import tqdm

from mrctl.control.stages import Stages
from mrctl.experiments.cases import TUNING_SEEDS, careful_spline, slowed
from mrctl.experiments.journal import Journal
from mrctl.experiments.tables import json_text, machine, markdown, number, output_folder, write_json
from mrctl.kernel import Array
from mrctl.loop import user_files
from mrctl.loop.runs import run
from mrctl.loop.simulation import Simulation
from mrctl.physics import mjcf
from mrctl.physics.parameters import read_robot
from mrctl.record import InputError
from mrctl.results import metrics
from mrctl.results.comparison import paired_ratio
from mrctl.results.dataset import versions
from mrctl.scenario import FEEDFORWARDS, Scenario, replicates
from mrctl.sensing.tiers import Sensing, Tier
from mrctl.theory.references import Waypoints

Bounds = dict[str, tuple[float, float]]
SEARCHED: dict[str, Bounds] = {
    # Parameters of the plant for which the design of the PID keeps its margins.
    "none": {"pid.lag": (1e-3, 0.1), "pid.derivative_time": (1e-3, 0.1)},
    # Bandwidth of the estimated disturbance, a compromise with noise and delay.
    "observer": {"observer.time_constant": (0.02, 5.0)},
    "indi": {"indi.time_constant": (0.005, 0.5)},
    "l1": {"l1.bandwidth": (1.0, 100.0), "l1.predictor": (0.5, 100.0)},
    # Speed of learning, speed of forgetting, and least feedback that teaches.
    "fel": {"fel.step": (0.001, 0.5), "fel.leak": (1e-7, 1e-2), "fel.dead_zone": (0.003, 0.3)},
    # Immediate share of a correction, initial uncertainty, and forgetting.
    "rls": {
        "rls.step": (0.001, 0.2), "rls.initial_covariance": (2e-3, 20.0), "rls.drift": (1e-7, 1e-2),
        "rls.covariance_bound": (2e-3, 20.0),
    },
    # Trust in the prediction error, memory, spread of plants, and weight of the tracking error.
    "mrac": {
        "mrac.noise": (1e-3, 0.5), "mrac.memory": (1.0, 1000.0), "mrac.spread": (0.1, 30.0),
        "mrac.tracking": (0.05, 100.0),
    },
    "composite": {
        "composite.noise": (0.02, 2.0), "composite.gain": (0.03, 3.0), "composite.disturbance": (0.01, 2.0),
        "composite.step": (1e-3, 0.3),
    },
}  # fmt: skip
"""Settings to search, with their bounds, by learner: those that determine how fast and how far it follows an error.
Constants that change no dynamics (units, scales, bounds of weights) and filters that several laws share stay fixed."""
METRICS = {"position_rmse": 0.5, "v_rmse": 0.25, "omega_rmse": 0.25}  # weights in the objective
ERROR_FLOORS = 1e-4, 5e-5, 1e-4  # m, m/s, rad/s, added to the errors; half the physics step changes these by less
MAX_RATIO = 10.0  # largest ratio of an error to that of `model`, and that of a failed run
LAP_TIME, LAPS = 12.0, 2  # lap time of the splines in s and number of laps, which all robots of a batch share
START_DEVIATION = 0.2  # standard deviation of the first generation, as a share of the logarithmic range
FIRST_TUNING_SEED = TUNING_SEEDS.start  # first seed of the worlds that the search sees
FIRST_FRESH_SEED = FIRST_TUNING_SEED + 50_000  # first seed of the worlds that it does not see
NOISE_FACTORS = {
    "encoder_counts": 0.5,
    "gyro_noise": 4.0,
    "fix_position_noise": 2.0,
    "fix_heading_noise": 2.0,
}  # factors
KINDS: dict[str, Callable[[np.random.Generator], dict[str, Any]]] = {
    "as built": lambda r: {},
    "heavy": lambda r: {"perturbation": {"mass_factor": r.uniform(1.25, 1.75)}},
    "light, late": lambda r: {"perturbation": {"mass_factor": r.uniform(0.7, 0.9), "control_delay": 0.01}},
    "weak supply": lambda r: {"perturbation": {"supply_factor": r.uniform(0.75, 0.95)}},
    "several things": lambda r: {
        "perturbation": {
            "mass_factor": r.uniform(1.2, 1.6), "drive_friction_factor": r.uniform(2, 4),
            "resistance_factor": r.uniform(1.1, 1.4), "supply_factor": r.uniform(0.75, 0.95),
        },
    },
    "payload at half time": lambda r: {
        "events": [{"time": LAP_TIME * LAPS / 2, "perturbation": {
            "payload": r.uniform(2, 6), "payload_x": r.uniform(-0.1, 0.3), "payload_y": r.uniform(-0.1, 0.1),
        }}],
    },
    "noise": lambda r: {"sensing": NOISE_FACTORS},
    "late": lambda r: {"perturbation": {"control_delay": 0.01}},
}  # fmt: skip
"""Kinds of plants, as fields of a scenario to draw; the values of `sensing` are factors on those of the tier."""


class Budget(NamedTuple):
    """Effort of a search: numbers of worlds, generations, settings in a generation, and fresh worlds."""

    worlds: int = 2 * len(KINDS)
    generations: int = 15
    population: int = 8
    fresh: int = 4 * len(KINDS)
    """Number of worlds that the search does not see."""


BUDGET = Budget()
"""Budget for every controller, which takes 2 to 3 minutes per tier on two cores."""


class Entry(NamedTuple):
    """A controller with settings to search."""

    name: str
    """One of `FEEDFORWARDS`, or the absolute path and name of a user's controller; see `mrctl.loop.user_files`."""
    bounds: Bounds
    shipped: dict[str, float]
    """Values with which the search begins."""

    def tried(self, settings: dict[str, float], worlds: Sequence[Scenario]) -> tuple[list[Scenario], Stages]:
        """Returns the worlds with these settings, and the factories of the user's stages."""
        if self.name in FEEDFORWARDS:
            update: dict[str, Any] = dict(FEEDFORWARDS[self.name])
            for field, value in settings.items():
                record, name = field.split(".")
                update[record] = update.get(record, getattr(Scenario(), record)).model_copy(update={name: value})
            return [world.model_copy(update=update) for world in worlds], {}
        stages: Any = dict(user_files.load(self.name))
        for part in user_files.parts(self.name):
            own = {name: settings[f"{part.attribute}.{name}"] for name in _declared(stages[part.stage])}
            stages[part.stage] = partial(stages[part.stage], **own)
        return [world.model_copy(update=FEEDFORWARDS["none"]) for world in worlds], stages

    def flags(self, settings: dict[str, float]) -> str:
        """Returns the flags of `mrctl run` for these settings, to four digits."""
        if self.name in FEEDFORWARDS:
            chosen = [f"{name} {value}" for name, value in FEEDFORWARDS[self.name].items()]
            chosen += [f"{field.replace('_', '-')} {value:.4g}" for field, value in settings.items()]
            return " ".join(f"--{flag}" for flag in chosen)
        parts = []
        for part in user_files.parts(self.name):
            own = {f.split(".")[1]: float(f"{v:.4g}") for f, v in settings.items() if f.split(".")[0] == part.attribute}
            parts.append(f"{part.stage}={part.path}:{part._replace(settings=part.settings | own).title}")
        return f"--controller '{','.join(parts)}'"

    @property
    def title(self) -> str:
        """Name for tables and folders."""
        return self.name if self.name in FEEDFORWARDS else "+".join(p.title for p in user_files.parts(self.name))


def entry(name: str) -> Entry:
    """Finds a controller by name: one of `FEEDFORWARDS`, or the user's as `my_file.py:MyController`.

    A user's class declares what may be searched, as in `search = {"gain": (0.01, 1.0)}`: names of keyword arguments of
    its constructor, with their bounds; the search begins at their defaults.

    Raises:
        InputError: There is no such controller, or it declares nothing to search, or invalid bounds.
    """
    if name in FEEDFORWARDS and (name == "none" or FEEDFORWARDS[name]["learner"] != "none"):
        bounds = SEARCHED[FEEDFORWARDS[name]["learner"]]
        fields = (field.split(".") for field in bounds)
        return Entry(name, bounds, {f"{r}.{n}": getattr(getattr(Scenario(), r), n) for r, n in fields})
    if ":" not in name:
        known = ", ".join(n for n, pair in FEEDFORWARDS.items() if n == "none" or pair["learner"] != "none")
        raise InputError(f"search: {name!r} has no settings; there are {known}, and my_file.py:MyController")
    name = user_files.absolute(name)
    user_files.trial(name, Scenario(laps=1, **FEEDFORWARDS["none"]))
    stages: Any = user_files.load(name)
    bounds: Bounds = {}
    shipped: dict[str, float] = {}
    for part in user_files.parts(name):
        arguments = inspect.signature(stages[part.stage]).parameters
        for setting, limits in _declared(stages[part.stage]).items():
            field = f"{part.attribute}.{setting}"
            try:
                low, start, high = (float(value) for value in (limits[0], arguments[setting].default, limits[1]))
            except (KeyError, IndexError, TypeError, ValueError):
                low = start = high = np.nan
            if not 0 < low <= start <= high < np.inf or low == high:
                raise InputError(
                    f"search: {field}: needs bounds 0 < low < high, and a keyword argument with a default between them"
                )
            bounds[field], shipped[field] = (low, high), start
    if not bounds:
        raise InputError('search: no class says what may be searched, as in search = {"gain": (0.01, 1.0)}')
    return Entry(name, bounds, shipped)


def _declared(factory: Any) -> dict[str, Any]:  # noqa: ANN401
    """Returns what a user's class declares as searchable: bounds by argument."""
    return dict(getattr(getattr(factory, "func", factory), "search", {}))


class Worlds(NamedTuple):
    """The worlds of a tier."""

    seen: Sequence[Scenario]
    """Worlds in which the search takes place."""
    fresh: Sequence[Scenario]
    """Worlds in which its result is measured."""


def worlds(tier: Tier, budget: Budget) -> Worlds:
    """Draws the worlds of a tier; each is a pure function of tier and seed."""
    first = {FIRST_TUNING_SEED: budget.worlds, FIRST_FRESH_SEED: budget.fresh}
    return Worlds(*([world(tier, seed) for seed in range(start, start + count)] for start, count in first.items()))


def world(tier: Tier, seed: int) -> Scenario:
    """Draws the world of a seed; its kind follows from the seed, everything else is drawn with it."""
    random = np.random.default_rng([seed, 7])
    kind = list(KINDS)[seed % len(KINDS)]
    fields = KINDS[kind](random)
    own = Sensing(tier=tier)
    sensing = {name: own[name] * factor for name, factor in fields.get("sensing", {}).items()}
    base = {
        "name": kind,
        "laps": LAPS,
        "reference": _course(seed),
        "initial_spread": (0, 0, 0),
        "guard": {"on": False},
    }
    scenario = Scenario.from_dict(base | fields | {"sensing": {"tier": tier} | sensing}, kind)
    return replicates(scenario, 1, seed)[0]


@cache
def _course(seed: int) -> Waypoints:
    """Draws a random spline with the margins of those in the suite, slowed down to the lap time."""
    random, robot = np.random.default_rng([seed, 8]), read_robot(mjcf.load())
    while (course := careful_spline(random, robot)).period > LAP_TIME:
        pass
    return slowed(course, LAP_TIME)


def score(errors: Array, yardstick: Array) -> Array:
    """Returns the weighted logarithm of the ratio to `model` in each of the n worlds that `model` drives, `(n,)`.

    The objective is its mean.

    Args:
        errors: Errors by world and metric of `METRICS`, `(worlds, 3)`; NaN where the run failed.
        yardstick: Errors of `model`, `(worlds, 3)`; worlds in which it failed are left out.
    """
    known = np.isfinite(yardstick).all(axis=1)
    errors, yardstick = errors[known], yardstick[known]
    ratio = np.nan_to_num(
        (errors + ERROR_FLOORS) / (yardstick + np.array(ERROR_FLOORS)), nan=MAX_RATIO, posinf=MAX_RATIO
    )
    return np.log(np.minimum(ratio, MAX_RATIO)) @ np.array(list(METRICS.values()))


class Memory:
    """The errors of settings that were driven already, by entry, settings and first seed of the worlds."""

    def __init__(self, file: Path, head: dict[str, Any], threads: int = 0) -> None:
        """Opens the file of a search or begins it.

        Args:
            file: The file.
            head: Everything that the search depends on.
            threads: Number of threads; 0 for all cores.

        Raises:
            InputError: The file belongs to another search.
        """
        self._journal, self._threads = Journal(file, head), threads

    def drive(self, entry: Entry, settings: Sequence[dict[str, float]], among: Sequence[Scenario]) -> list[Array]:
        """Returns the errors of each of the settings in the worlds, `(worlds, 3)`; drives settings that are new."""
        keys = [[entry.title, one, among[0].seed] for one in settings]
        missing = [key for k, key in enumerate(keys) if key not in self._journal and key not in keys[:k]]
        simulations = []
        for _, own, _ in missing:
            runs, stages = entry.tried(own, among)
            simulations.append(Simulation(runs, threads=1, **stages))
        if simulations:
            run(simulations, threads=self._threads)
        for key, simulation in zip(missing, simulations, strict=True):
            laps = metrics.per_lap(simulation.result())
            self._journal[key] = np.stack([metrics.over_laps(laps, name).values for name in METRICS], axis=-1).tolist()
        return [np.array(self._journal[key]) for key in keys]


def search(
    name: str, tiers: Sequence[Tier], out: Path | None, json: bool, budget: Budget = BUDGET, threads: int = 0
) -> str:
    """Runs the command: searches settings for each tier, and drives all that were found in fresh worlds of each tier.

    Args:
        name: The controller, as for `entry`.
        tiers: Sensing tiers.
        out: Folder for `table.json` and the runs; by default `search/NAME`. The same command continues there.
        json: Whether to return JSON instead of a table.
        budget: Effort of the search.
        threads: Number of threads, which changes no bit; 0 for all cores.

    Raises:
        InputError: The controller is invalid, or the folder cannot be written or holds another search.
    """
    searched = entry(name)
    out = out or Path("search") / searched.title
    table: dict[str, Any] = {"versions": versions(), "machine": machine(), "entry": searched.title}
    table |= {"bounds": searched.bounds, "shipped": searched.shipped, "budget": budget._asdict(), "tiers": {}}
    with output_folder(out):
        drawn = {tier: worlds(tier, budget) for tier in tiers}
        heads = {tier: _head(searched, drawn[tier], budget) for tier in tiers}
        memories = {tier: Memory(out / f"{tier}.jsonl", heads[tier], threads) for tier in tiers}
        found = {tier: find(searched, tier, memories[tier], drawn[tier].seen, budget) for tier in tiers}
    candidates = {"shipped": searched.shipped} | {tier: one["found"] for tier, one in found.items()}
    for tier, one in found.items():
        fresh = compare(searched, candidates, memories[tier], drawn[tier].fresh)
        table["tiers"][tier] = one | {"fresh": fresh, "flags": searched.flags(one["found"])}
    write_json(out / "table.json", table)
    return json_text(table) if json else f"{text(table)}\n\nThe files are in {out}."


def _head(searched: Entry, drawn: Worlds, budget: Budget) -> dict[str, Any]:
    """Returns everything but the settings that determines the errors, and the budget and bounds of the search."""
    own = {} if searched.name in FEEDFORWARDS else {"file": user_files.digest(searched.name)}
    written = "".join(world.model_dump_json() for world in (*drawn.seen, *drawn.fresh))
    digest = hashlib.sha256(written.encode()).hexdigest()
    settings = {"bounds": searched.bounds, "shipped": searched.shipped}
    return {"entry": searched.name, **own, "versions": versions(), **settings, "drawn": digest, **budget._asdict()}


def find(searched: Entry, tier: Tier, memory: Memory, among: Sequence[Scenario], budget: Budget) -> dict[str, Any]:
    """Searches in the worlds of one tier.

    Returns:
        The settings `found`, the `objective` of these and of the `shipped` ones, and the `origin` in words.
    """
    (yardstick,) = memory.drive(Entry("model", {}, {}), [{}], among)
    if np.isnan(yardstick).any(axis=1).all():
        raise InputError("search: the learner `none` with the prior `model` loses the robot in every world")
    limits = np.array(list(searched.bounds.values()))
    low, span = limits[:, 0], np.log(limits[:, 1] / limits[:, 0])
    start = np.log(np.clip(list(searched.shipped.values()), limits[:, 0], limits[:, 1]) / low) / span
    unit = np.tile([0.0, 1.0], (len(low), 1))
    optimiser = CMA(start, START_DEVIATION, unit, seed=FIRST_TUNING_SEED, population_size=budget.population)
    tried: list[tuple[float, dict[str, float]]] = []

    def judge(settings: list[dict[str, float]]) -> list[float]:
        found = [float(score(errors, yardstick).mean()) for errors in memory.drive(searched, settings, among)]
        tried.extend(zip(found, settings, strict=True))
        return found

    with tqdm(total=1 + budget.generations * budget.population, unit="setting", desc=tier, file=sys.stderr) as bar:
        judge([searched.shipped])
        bar.update()
        for _ in range(budget.generations):
            points = [optimiser.ask() for _ in range(budget.population)]
            values = [np.clip(low * np.exp(span * x), *limits.T).tolist() for x in points]
            values = judge([dict(zip(searched.bounds, one, strict=True)) for one in values])
            optimiser.tell(list(zip(points, values, strict=True)))
            bar.update(budget.population)
            bar.set_postfix(error=f"{np.exp(min(tried, key=_value)[0]):.4f} of model's")
    best, found = min(tried, key=_value)  # the first of equal ones
    origin = f"mrctl {versions()['mrctl']}, tune --search {searched.title}, {tier}: best of {len(tried)} settings "
    origin += f"in {budget.worlds} worlds with seeds from {FIRST_TUNING_SEED}"
    return {"found": found, "objective": {"shipped": tried[0][0], "found": best}, "origin": origin}


def _value(tried: tuple[float, dict[str, float]]) -> float:
    return tried[0]


def compare(
    searched: Entry, candidates: dict[str, dict[str, float]], memory: Memory, among: Sequence[Scenario]
) -> dict[str, Any]:
    """Drives settings in fresh worlds.

    Returns:
        For each of the settings `to_model`, exp J; `to_shipped`, the same relative to the shipped settings, with its
        95 % interval; and the number of runs that `failed`.
    """
    (yardstick,) = memory.drive(Entry("model", {}, {}), [{}], among)
    errors = dict(zip(candidates, memory.drive(searched, list(candidates.values()), among), strict=True))
    scores = {name: np.exp(score(one, yardstick)) for name, one in errors.items()}
    return {
        name: {
            "to_model": float(np.exp(np.log(one).mean())),
            "to_shipped": paired_ratio(one, scores["shipped"])._asdict(),
            "failed": int(np.isnan(errors[name]).any(axis=1).sum()),
        }
        for name, one in scores.items()
    }


def text(table: dict[str, Any]) -> str:
    """Returns the settings and their errors as text."""
    tiers = table["tiers"]
    settings = [
        [name, number(shipped), *(number(tiers[tier]["found"][name]) for tier in tiers)]
        for name, shipped in table["shipped"].items()
    ]
    trained = [
        [tier, *(number(np.exp(found["objective"][which])) for which in ("shipped", "found"))]
        for tier, found in tiers.items()
    ]
    fresh = []
    for tier, found in tiers.items():
        for name, one in found["fresh"].items():
            ratio = one["to_shipped"]
            fresh.append([tier, name if name == "shipped" else f"found in {name}", number(one["to_model"])])
            fresh[-1].append(f"{number(ratio['value'])} [{number(ratio['low'])}, {number(ratio['high'])}]")
            fresh[-1].append(f"{one['failed']}/{table['budget']['fresh']}")
    found = [f"found in {tier}" for tier in tiers]

    def level(tier: str) -> bool:
        return tiers[tier]["fresh"][tier]["to_shipped"]["high"] >= 1

    parts = [
        f"{table['entry']}: {1 + table['budget']['generations'] * table['budget']['population']} settings a tier.",
        markdown(["setting", "shipped", *found], settings),
        f"Error over that of `model`, in the {table['budget']['worlds']} worlds of the search:",
        markdown(["tier", "shipped", "found"], trained),
        f"The same in {table['budget']['fresh']} fresh worlds, with 95 % intervals:",
        markdown(["tier", "settings", "over model", "over shipped", "failed"], fresh),
        *(
            f"What was found in {tier} is not shown to be better there than the shipped settings."
            for tier in tiers
            if level(tier)
        ),
        "\n".join(f"mrctl run --sensing.tier {tier} {found['flags']}" for tier, found in tiers.items()),
    ]
    return "\n\n".join(parts)
