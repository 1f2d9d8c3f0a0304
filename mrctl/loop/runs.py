"""Scenarios in, result out: runs of any kind, each group of them in simulations that run at the same time."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Unpack

import numpy as np
import xarray as xr
from tqdm import tqdm

from mrctl.control.stages import Stages
from mrctl.loop.groups import arranged, cores, uniform, worthwhile
from mrctl.loop.simulation import Simulation
from mrctl.loop.user_stages import named_stages
from mrctl.record import InputError
from mrctl.results import dataset
from mrctl.scenario import Scenario


def simulate(
    scenarios: Scenario | Sequence[Scenario], *, progress: bool = False, threads: int = 0, **stages: Unpack[Stages]
) -> xr.Dataset:
    """Runs scenarios in closed loop.

    One scenario runs through dm_control, several run together on MuJoCo's batch engine, with the same bits.

    Args:
        scenarios: One scenario, or several. They run in one batch if they have the same world, robot, laws, estimator,
            steering, delay and rates, obstacles of the same kinds in about the same number and, unless they have goals,
            the same length; else in several.
        progress: Whether to show a progress bar.
        threads: Number of threads for control and physics, which does not change the result; 0 for all cores.
        stages: The user's stages `motion`, `feedback`, `feedforward`, `steering` or `estimator` in place of the
            scenario's: a factory, called with the nominal robot and the number of robots, which returns an object with
            the two methods of that stage in `mrctl.control.stages`. One that raises in a tick, or returns an array of
            the wrong shape there, fails all runs that are computed together; one that returns NaN for a robot fails
            that run, except for an estimator, which odometry then replaces, and for a feedforward, which the guard
            replaces if it is on.

    Returns:
        The signals of `results.dataset.SIGNALS` with dimensions run and time (time alone for one scenario), with units;
        `failed`, `failure` and `failure_time` of each run; `weights`, flat, where something was learned.

    Raises:
        InputError: There is no scenario, or one asks for something that does not exist or that the robot cannot do, and
            the message names the field; or a user's stage fails before the first tick, in its factory, in `reset` or
            another method that prepares it, or, for a feedforward, in its first `output`.
    """
    single = isinstance(scenarios, Scenario) or not isinstance(scenarios, Iterable)
    listed: list[Any] = [scenarios] if single else list(scenarios)
    if not all(isinstance(s, Scenario) for s in listed):
        raise InputError("scenarios: neither a Scenario nor a list of them")
    given = [s.replace() for s in listed]  # validated
    several = [arranged(s) for s in given]
    if not several:
        raise InputError("scenarios: none given")
    if len({s.control_period for s in several}) > 1:
        raise InputError("control_period: differs between the scenarios, but runs of one result share their time axis")
    # Built first, so that bad input is refused before anything is computed.
    parts = [part for rows in uniform(several) for part in split(several, rows, threads, **stages)]
    total = sum(simulation.ticks * len(rows) for rows, simulation in parts)
    at_once = 1 if any(stages.values()) else threads
    with tqdm(total=total, unit="tick", unit_scale=True, disable=not progress) as bar:
        run([simulation for _, simulation in parts], bar.update if progress else None, threads=at_once)
        bar.total = bar.n  # where runs ended early, at their goals or because they failed
    whole = dataset.combine([(rows, simulation.result()) for rows, simulation in parts], given)
    if names := named_stages(stages):
        whole.attrs["stages"] = json.dumps(names)
    return whole.isel(run=0) if isinstance(scenarios, Scenario) else whole


def split(
    scenarios: Sequence[Scenario], rows: list[int], threads: int, **stages: Unpack[Stages]
) -> list[tuple[list[int], Simulation]]:
    """Splits a uniform group into simulations that run at the same time, one in each thread.

    With stages of the user the group stays whole: a stage serves all robots at once, and only the engine has threads.

    Args:
        scenarios: All scenarios.
        rows: Indices of those in the group.
        threads: Number of threads; 0 for all cores.
        stages: As in `simulate`.

    Raises:
        InputError: As `simulate`.
    """
    if any(stages.values()):
        return [(rows, Simulation([scenarios[row] for row in rows], threads=threads, **stages))]
    count = worthwhile(threads, len(rows))
    parts = [part.tolist() for part in np.array_split(rows, count)]
    return [(part, Simulation([scenarios[row] for row in part], threads=1)) for part in parts]


def run(
    simulations: Sequence[Simulation],
    progress: Callable[[int], object] | None = None,
    ticks: int | None = None,
    threads: int = 0,
) -> None:
    """Runs simulations, as many at the same time as there are threads; control and physics release the global lock.

    Args:
        simulations: The simulations.
        progress: Is called after every tick of a simulation with the number of its robots.
        ticks: Number of control periods; by default to the end of the runs.
        threads: Number of threads; 0 for all cores.
    """
    stop = threading.Event()

    def drive(simulation: Simulation) -> None:
        last = simulation.ticks if ticks is None else simulation.tick + ticks
        with np.errstate(invalid="ignore", over="ignore"):  # NaN of a failed robot have no effect on the others
            while simulation.running and simulation.tick < last and not stop.is_set():
                simulation.step()
                if progress:
                    progress(simulation.plant.size)

    count = min(threads or cores(), len(simulations))
    if count == 1:
        for simulation in simulations:
            drive(simulation)
        return
    with ThreadPoolExecutor(count) as pool:
        try:
            for future in [pool.submit(drive, simulation) for simulation in simulations]:
                future.result()
        except BaseException:
            stop.set()
            raise
