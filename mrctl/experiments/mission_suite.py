"""`mrctl navigate --suite`: how narrow a corridor, and how fast, for velocity controllers that drive the same plans.

A draw is a corridor with a plan through it, and a robot on one day (`mrctl.scenario.replicates`); all controllers have
the same draws. A plan keeps as far from the walls as it can. The robots follow it in time and do not see walls, so a
run in the open shows how wide the corridor must be for them to touch none: a run that ends at its goal needs that
width, and any other an infinite one. The critical width is what 95 % of the draws need at most, at the largest speed.
The allowance is what 95 % of them need at most beyond the widths of their plans, which perfect tracking needs. The
critical speed is the largest that 95 % of the draws reach; a draw reaches a speed if at it, and at all slower ones, it
needs no more than a given allowance.

The error budget of the allowance takes away the error of the map, on which the corridor is drawn `MAP_ERROR` beside its
place (one standard deviation), and then that of the estimate or that of tracking.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from itertools import islice
from typing import Any, Literal, NamedTuple, TypeVar

import numpy as np
import xarray as xr

from mrctl.control.stages import Stages
from mrctl.experiments.cases import HARD, Choice, by_name
from mrctl.experiments.journal import Computation, Journal
from mrctl.experiments.suite_tables import titled
from mrctl.experiments.tables import Table, frame, number, share_cell, wins_cell
from mrctl.kernel import Array
from mrctl.loop import user_files
from mrctl.loop.goals import arrived
from mrctl.loop.runs import simulate
from mrctl.navigation.generators import corridor, corridor_width
from mrctl.navigation.planning import PATIENCE, Query, planned
from mrctl.navigation.vehicle import Vehicle
from mrctl.record import InputError
from mrctl.results.comparison import quantile_interval, superiority
from mrctl.scenario import FeedforwardName, Scenario, replicates
from mrctl.theory.obstacles import Pose
from mrctl.theory.perturbation import PERTURBATIONS, Perturbation
from mrctl.theory.references import Waypoints
from mrctl.theory.timing import LIMIT_SHARE, Limits

CONTROLLERS: tuple[FeedforwardName, ...] = ("none", "model", "fel", "model+composite")
RIVALS: tuple[FeedforwardName, ...] = ("none", "model")  # with which the others are compared
PLANTS: dict[str, Perturbation] = {
    "nominal": Perturbation(),
    "all": PERTURBATIONS["all"],
    "sagging battery": HARD["sagging battery"],
}
SPEEDS = (0.3, 0.45, 0.6, 0.75, LIMIT_SHARE)  # over the robot's largest
SHAPE: dict[str, Any] = {"pieces": 3, "length": 2.0, "turn": np.pi / 4}  # of the corridors, in m and rad
ROOMY_FACTOR = 1.5  # width of the corridor of a plan over that of the robot
# of the plan, over half of the rest; the largest that it can keep
PLAN_MARGINS = (0.8, 0.7, 0.6, 0.5, 0.4, 0.3, 0.2, 0.1)
MAP_ERROR = 0.01  # m, standard deviation of the offset of a corridor from its place on the map; chosen
ALLOWANCE = 0.005  # m, the allowance for the critical speed; chosen
MAX_WORLDS_PER_DRAW = 10  # worlds that are made, over the number of draws
CRITICAL_SHARE = 0.95
DRAWS = {"quick": 20, "core": 80}  # with fewer than 72 the interval of a critical width has no upper end
POSE_STRIDE = 2  # control periods between the poses whose widths are looked at
TIE = 1e-3  # m, difference of widths that counts as a tie
SIMULATED_PER_SECOND = 100  # simulated s in a s of one core, planning included


Mode = Literal["quick", "core"]
T = TypeVar("T")
POSE = ("x", "y", "theta")


class Draw(NamedTuple):
    """A corridor, and the plan through it at each speed."""

    seed: int
    references: list[Waypoints]
    goal: Pose


class Contender(NamedTuple):
    """A velocity controller that is compared, of mrctl or of the user."""

    name: str
    choice: Choice
    digest: str = ""
    """Digest of the user's files."""

    @property
    def key(self) -> Any:  # noqa: ANN401
        """What the journal calls it; after an edit of the user's files another one."""
        return [self.name, self.choice.controller, self.digest] if self.digest else self.name

    def stages(self) -> Stages:
        """Returns the user's stages, as arguments of `simulate`.

        Raises:
            InputError: Their files are missing, or are not those with which the suite began.
        """
        if not (own := self.choice.controller):
            return {}
        if user_files.digest(own) != self.digest:
            raise InputError(f"controller: {own}, or a file that it imports, is not as it was when the suite began")
        return user_files.load(own)


def contenders(base: Scenario, controllers: Sequence[str]) -> list[Contender]:
    """Returns those of `CONTROLLERS`, and the user's.

    Args:
        base: The robot on which the user's are tried.
        controllers: The user's, as for `by_name`.

    Raises:
        InputError: A controller of the user is bad, or its name is taken.
    """
    return [
        Contender(name, choice, user_files.digest(choice.controller) if choice.controller else "")
        for name, choice in by_name(CONTROLLERS, controllers, base).items()
    ]


class Series(NamedTuple):
    """The drives of all draws on all plants with one controller at one speed."""

    contender: Contender
    speed: int
    """Index of the speed in `SPEEDS`."""
    posture_known: bool = False
    """Whether the true posture replaces the estimate."""

    @property
    def key(self) -> list[Any]:
        """What the journal calls it."""
        return [self.contender.key, "true posture" if self.posture_known else SPEEDS[self.speed]]


class Found(NamedTuple):
    """The widths in m that the runs need, infinite where a robot did not arrive."""

    needed: Array
    """At each speed, `(speeds, controllers, plants, draws)`."""
    map_off: Array
    """At the largest speed, if the map is wrong, `(controllers, plants, draws)`."""
    posture_known: Array
    """At the largest speed, where the true posture replaces the estimate, `(controllers, plants, draws)`."""
    on_reference: Array
    """At the largest speed, if the estimate were always on the reference, `(controllers, plants, draws)`."""
    plans: Array
    """Widths that the plans themselves need, `(draws,)`."""
    speeds: list[float]
    """Speeds at which the corridors are driven, in m/s."""
    impassable: int
    """Number of corridors that were left out, for no plan goes through them."""
    controllers: Sequence[str]
    """Names of the controllers, among them `none` and `model`."""


def drive(base: Scenario, mode: Mode, compared: Sequence[Contender], journal: Journal) -> Found:
    """Drives all draws at all speeds with all controllers on all plants; says first how long that takes.

    Args:
        base: Robot, steering, sensing and all else that is the same for all.
        mode: Which suite.
        compared: The controllers.
        journal: What was driven already, by controller and speed, which is kept there.

    Raises:
        InputError: The robot does not fit most corridors.
    """
    count = DRAWS[mode]
    vehicle = Vehicle.of(base)
    width = ROOMY_FACTOR * vehicle.width
    speeds = [share * vehicle.robot.max_speed for share in SPEEDS]
    complaint = f"suite: {base.robot.path} finds no way through most corridors of {width:.2f} m"
    draws = drawn(lambda seed: draw(vehicle, seed, width, speeds), count, complaint)
    every = [Series(one, k) for one in compared for k in range(len(SPEEDS))]
    every += [Series(one, len(SPEEDS) - 1, posture_known=True) for one in compared]
    left = [series for series in every if series.key not in journal]
    simulated = sum(one.references[series.speed].period for series in left for one in draws) * len(PLANTS)
    seconds = simulated / SIMULATED_PER_SECOND
    print(f"{count * len(PLANTS) * len(left):,} runs, {journal.expected(seconds, len(left))}", flush=True)
    size = len(compared), len(PLANTS), count
    needed, known, on_reference, off = np.empty((len(SPEEDS), *size)), *(np.empty(size) for _ in range(3))
    plants, corners = list(PLANTS.values()), vehicle.footprint
    drives = [Computation(series.key, partial(_driven, series, base, plants, draws, corners)) for series in every]
    for series, driven in zip(every, journal.results(drives), strict=True):
        c, widths = compared.index(series.contender), np.array(driven, float)
        if series.posture_known:
            known[c] = widths[0]
        else:
            needed[series.speed, c], on_reference[c], off[c] = widths  # the last two end with the largest speed
    plans = []
    for one in draws:
        fastest = one.references[-1]
        poses = fastest.sample(np.arange(0, fastest.period, 0.02)).pose
        plans.append(corridor_width(vehicle.footprint, poses, one.seed, **SHAPE))
    names, impassable = [one.name for one in compared], draws[-1].seed + 1 - count
    return Found(needed, off, known, on_reference, np.array(plans), speeds, impassable, names)


def drawn(make: Callable[[int], T | None], count: int, complaint: str) -> list[T]:
    """Makes draws from the seeds 0, 1, … until there are enough.

    Args:
        make: Makes the draw of a seed, or returns None where there is none.
        count: Number of draws.
        complaint: Message of the error.

    Raises:
        InputError: `MAX_WORLDS_PER_DRAW` times as many seeds give too few draws.
    """
    found = list(islice(filter(None, map(make, range(MAX_WORLDS_PER_DRAW * count))), count))
    if len(found) < count:
        raise InputError(complaint)
    return found


def draw(vehicle: Vehicle, seed: int, width: float, speeds: Sequence[float]) -> Draw | None:
    """Plans a draw once, with the largest margin that there is a plan for, and times it for each speed.

    Args:
        vehicle: The robot.
        seed: Seed of the corridor, and of the robot on that day.
        width: Width of the corridor in m.
        speeds: Largest speeds in m/s.

    Returns:
        The draw, or None where no plan goes through the corridor.
    """
    limits = Limits.of(vehicle.robot)
    task, rest = corridor(width, seed, **SHAPE), width * (1 - 1 / ROOMY_FACTOR)
    for share in PLAN_MARGINS:
        try:
            found, fastest = planned(Query(task, vehicle, speeds[-1], share * rest / 2))
        except InputError:
            continue
        return Draw(seed, [*(found.reference(speed, limits) for speed in speeds[:-1]), fastest], task.goal)
    return None


def _driven(
    series: Series, base: Scenario, plants: Sequence[Perturbation], draws: Sequence[Draw], corners: Array
) -> list[Any]:
    """Drives a series; returns the widths that the runs need in m, as `_widths` does."""
    return _widths(_simulated(series, base, plants, draws), draws, corners).tolist()


def _simulated(series: Series, base: Scenario, plants: Sequence[Perturbation], draws: Sequence[Draw]) -> xr.Dataset:
    """Drives all draws on all plants; run p · D + d is draw d of D on plant p."""
    own = base.replace(**series.contender.choice.pair, laps=PATIENCE, initial_spread=(0.0, 0.0, 0.0))
    if series.posture_known:
        own = own.replace(sensing=own.sensing.replace(estimator="truth"))
    scenarios = [
        own.replace(perturbation=plant, reference=one.references[series.speed], goal=one.goal)
        for plant in plants
        for one in draws
    ]
    robots = [replicates(s, 1, draws[k % len(draws)].seed)[0] for k, s in enumerate(scenarios)]
    return simulate(robots, threads=1, **series.contender.stages())


def _widths(result: xr.Dataset, draws: Sequence[Draw], corners: Array) -> Array:
    """Returns the width that each run needs in m, infinite where the robot did not arrive, `(3, plants, draws)`.

    The second is what it would need if the estimate were always on the reference, the third if the map were wrong.
    """
    pose, seen, wanted = (
        np.stack([result[f"{name}{end}"].values for name in POSE], -1) for end in ("", "_measured", "_ref")
    )
    v, failure = result["v"].values, result["failure"].values
    found = np.full((3, len(pose)), np.inf)
    for row in range(len(pose)):
        one, driven = draws[row % len(draws)], np.flatnonzero(np.isfinite(v[row]))
        if failure[row] == "" and arrived(pose[row, driven[-1]], v[row, driven[-1]], np.array(one.goal)):
            own = pose[row, driven[::POSE_STRIDE]]
            on_reference = wanted[row, driven[::POSE_STRIDE]] + own - seen[row, driven[::POSE_STRIDE]]
            aside = float(np.random.default_rng([one.seed, 2]).normal(0.0, MAP_ERROR))
            found[:, row] = [
                corridor_width(corners, poses, one.seed, **SHAPE, aside=off)
                for poses, off in ((own, 0.0), (on_reference, 0.0), (own, aside))
            ]
    return found.reshape(3, -1, len(draws))


def tables(found: Found, shown: str) -> list[Table]:
    """Returns the tables; their titles say what is `shown`."""
    return [critical_widths(found, shown), critical_speeds(found, shown), budget(found, shown)]


def values(found: Found) -> dict[str, Any]:
    """Returns what was found for JSON."""
    found_values = {name: np.asarray(part).tolist() for name, part in found._asdict().items()}
    return {"plants": list(PLANTS)} | found_values


def critical_widths(found: Found, shown: str) -> Table:
    """Returns the table of the critical widths at the largest speed, with the wins over PID and over `model`."""
    needed, rows = found.needed[-1], []
    for plant, own in zip(PLANTS, needed.swapaxes(0, 1), strict=True):
        for name, one in zip(found.controllers, own, strict=True):
            there = int(np.isfinite(one).sum())
            share = share_cell(there, len(one))
            rows.append([plant, titled(name), share, quantile_cell(one, 1e3), quantile_cell(one - found.plans, 1e3)])
            for rival in RIVALS:
                wins = superiority(one, own[found.controllers.index(rival)], floor=TIE)
                rows[-1].append("" if rival == name else wins_cell(wins))
    header = [
        "plant",
        "controller",
        "arrived",
        "critical width, mm",
        "allowance, mm",
        "needs less than PID",
        "less than model",
    ]
    says = (
        f"At 95 % success the plans themselves need {quantile_cell(found.plans, 1e3)} mm; corridors left out because "
        f"no plan goes through: {found.impassable}. In paired draws, with 95 % confidence and differences up to "
        f"{1e3 * TIE:.0f} mm as ties: {against(found.controllers, needed, TIE)}."
    )
    return Table(f"Critical width of a corridor at {found.speeds[-1]:.2f} m/s ({shown})", says, frame(rows, header))


def critical_speeds(found: Found, shown: str) -> Table:
    """Returns the table of the critical speeds."""
    # How many speeds, from the slowest on.
    fits = np.cumprod(found.needed <= found.plans + ALLOWANCE, axis=0).sum(axis=0)
    critical, rows = np.array([0.0, *found.speeds])[fits], []
    for plant, own in zip(PLANTS, critical.swapaxes(0, 1), strict=True):
        for name, one in zip(found.controllers, own, strict=True):
            counts = " / ".join(f"{np.mean(one >= speed):.2f}" for speed in found.speeds)
            rows.append([plant, titled(name), quantile_cell(-one, -1), counts])
    header = ["plant", "controller", "critical speed, m/s", "success up to each speed"]
    says = (
        f"Speeds of {', '.join(f'{speed:.2f}' for speed in found.speeds)} m/s; 0 where even the slowest is too fast. "
        f"In paired draws, with 95 % confidence: {against(found.controllers, -critical, 0)}."
    )
    return Table(f"Critical speed with an allowance of {1e3 * ALLOWANCE:.0f} mm ({shown})", says, frame(rows, header))


def budget(found: Found, shown: str) -> Table:
    """Returns the table of the allowance with all errors, without the map's, and without one of the others too."""
    rows, gains = [], {}
    for p, plant in enumerate(PLANTS):
        for c, name in enumerate(found.controllers):
            every = found.map_off[c, p], found.needed[-1, c, p], found.posture_known[c, p], found.on_reference[c, p]
            parts = [needed - found.plans for needed in every]
            rows.append([plant, titled(name), *(quantile_cell(part, 1e3) for part in parts)])
            value = [quantile_interval(part, CRITICAL_SHARE).value for part in parts]
            if plant == "nominal" and np.isfinite(value).all():
                off, right, *others = (1e3 * v for v in value)
                gains[titled(name)] = ", ".join(f"{v:.1f}" for v in (off - right, *(right - v for v in others)))
    listed = "; ".join(f"`{name}` {gain}" for name, gain in gains.items())
    says = (
        f"On the nominal plant with a map that is {1e3 * MAP_ERROR:.0f} mm off, a right map lowers the allowance by "
        "the first of three numbers, and then a known posture by the second, or an estimate that is always on the "
        f"reference by the third: {listed} mm."
        if gains
        else "On the nominal plant no controller has a finite allowance with each of these maps and estimates."
    )
    header = [
        "plant",
        "controller",
        "allowance with a wrong map, mm",
        "with the right map",
        "and a known posture",
        "or the estimate on the reference",
    ]
    return Table(f"Error budget of the allowance ({shown})", says, frame(rows, header))


def quantile_cell(samples: Array, scale: float) -> str:
    """Returns the quantile at `CRITICAL_SHARE` times the scale, with its interval; negated samples: a negated scale."""
    value, low, high, *_ = quantile_interval(samples, CRITICAL_SHARE)
    low, high = sorted((scale * low, scale * high))
    return f"{finite_text(scale * value)} [{finite_text(low)}, {finite_text(high)}]"


def finite_text(value: float) -> str:
    """Returns a number as text, or ∞, or a dash for none."""
    return "∞" if value == np.inf else "–" if not np.isfinite(value) else number(value, 4) if value else "0"


def against(names: Sequence[str], samples: Array, floor: float) -> str:
    """Returns in words who beats or loses to PID alone and to `model`, and where.

    Args:
        names: Names of the controllers, among them the rivals.
        samples: What they need, `(controllers, plants, draws)`; less is better.
        floor: Largest difference that counts as a tie, in the unit of the samples.
    """
    parts = []
    for rival in RIVALS:
        verdicts = {"better": [], "worse": []}
        for c, name in enumerate(names):
            for p, plant in enumerate(PLANTS):
                wins = superiority(samples[c, p], samples[names.index(rival), p], floor=floor)
                if name != rival and (wins.low > 0.5 or wins.high < 0.5):
                    verdicts["better" if wins.low > 0.5 else "worse"].append(f"`{titled(name)}` ({plant})")
        found = [f"{word} than `{titled(rival)}` are {', '.join(who)}" for word, who in verdicts.items() if who]
        parts += found or [f"none differs from `{titled(rival)}`"]
    return "; ".join(parts)
