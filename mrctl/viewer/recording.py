"""Finished runs: their signals, and the positions of the robot."""

# pyright: reportAttributeAccessIssue=false
# (mujoco is compiled and ships no stubs)

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from pathlib import Path

import mujoco
import numpy as np
import xarray as xr

from mrctl.kernel import Array, Rows
from mrctl.loop.timeline import state
from mrctl.physics import mjcf
from mrctl.physics.parameters import read_robot
from mrctl.physics.stand import front_rates, stand, steer
from mrctl.record import InputError
from mrctl.results.controllers import title_of
from mrctl.results.dataset import SIGNALS, blank, faults_of, scenarios_of
from mrctl.results.excitation import parameter_error
from mrctl.results.metrics import as_runs, summary
from mrctl.scenario import Scenario
from mrctl.sensing.scanner import Scanner
from mrctl.sweep import jobs, store
from mrctl.sweep.store import Store
from mrctl.theory.obstacles import turned
from mrctl.theory.perturbation import Perturbation
from mrctl.theory.references import Reference
from mrctl.viewer.deviation import drawn
from mrctl.viewer.looks import Look, looks, told_apart

MAX_SHOWN = 4  # largest number of runs in a result that are all shown at the beginning
PATH_HEIGHT = 0.01  # m, height of a path above the ground
SCENE_FIELDS = ("world", "obstacles", "robot", "control_period")  # in which runs must agree to share a scene
WHEELS = {"wheel_left": "wheel_rate_left", "wheel_right": "wheel_rate_right"}


class Recording:
    """One finished run, or an interval of it.

    Attributes:
        scenario: Scenario of the run.
        controller: Name of the controller in tables.
        label: Name of the run for people.
        period: Time between samples in s.
        start: Time of the first sample since the start of the run in s; all methods count time from this sample.
        log: Record of `TICK` for each sample until the end or the failure, `(T,)`.
        failure: Reason of an early end, or "".
        end: Time of the failure in s; without one, or where a result does not have it, that of the last sample.
        faults: What `dataset.faults_of` returns.
        clearance: Distance from the nearest obstacle at each sample in m, `(T,)`; None where there are no obstacles.
        parameter_error: Learned less true coefficients of the features at the end of the run in V, `(8, 2)`, as of
            `results.excitation.parameter_error`; None where the result has none.
    """

    def __init__(self, run: xr.Dataset) -> None:
        """Takes a single run of a result, or an interval of one."""
        self.scenario: Scenario = scenarios_of(run)[0]
        self.controller = str(run["feedforward"].values) if "feedforward" in run.coords else self.scenario.feedforward
        label = str(run["label"].values)
        # Behind the feedforward, which is left out if it is `none`, stand other stages; before 0.49.0 with " + ".
        stages = label.removeprefix(self.controller).strip("+ ")
        named = self.scenario.name or not (label.startswith(self.controller) or self.controller == "none")
        self.label = label if named else " + ".join(filter(None, (title_of(self.controller), stages)))
        self.period = float(run.attrs["control_period"])
        self.start = float(run["time"][0])
        log = blank(run.sizes["time"])
        for name in SIGNALS:
            if name in run:
                log[name] = run[name].values
        driven = np.flatnonzero(np.isfinite(log["x"]))
        self.log = log[: 1 + driven[-1]] if driven.size else log[:1]
        self.failure, self.faults = str(run["failure"].values), faults_of(run)
        there = "failure_time" in run and not run["failure_time"].dims  # to which `where` adds the time
        failed = float(run["failure_time"]) - self.start if there else np.nan
        self.end = failed if np.isfinite(failed) else self.duration
        near = bool(self.scenario.obstacles.shapes) and "clearance" in run
        self._scanned = "scanned" in run and run["scanned"].values.item() is True
        self.clearance: Array | None = run["clearance"].values[: len(self.log)] if near else None
        known = "parameters" in run and "time" not in run["parameters"].dims  # which `where` adds
        self.parameter_error: Array | None = parameter_error(run).values[0] if known else None

    @property
    def _first(self) -> int:
        """Control tick of the first sample."""
        return round(self.start / self.period)

    @property
    def duration(self) -> float:
        """Time of the last sample in s."""
        return self.period * (len(self.log) - 1)

    def index(self, time: float) -> int:
        """Returns the index of the sample at a time in s, limited to the first and the last one."""
        return int(np.clip(round(time / self.period), 0, len(self.log) - 1))

    @cached_property
    def model(self) -> mujoco.MjModel:
        """The compiled world with the nominal robot."""
        s = self.scenario
        return mjcf.load(s.world, s.steering, robot=s.robot, obstacles=s.obstacles)

    @cached_property
    def _wheel_angles(self) -> dict[str, Array]:
        """Angle of each wheel at the samples in rad, `(T,)`."""
        log, robot = self.log, read_robot(self.model)
        rates = {wheel: log[name] for wheel, name in WHEELS.items()}
        rates |= front_rates(self.model, robot, log["v"], log["omega"], log["steering_angle"])
        return {wheel: self.period * np.cumsum(rate) for wheel, rate in rates.items()}

    @cached_property
    def _scans(self) -> list[Array]:
        """Places in the world that the beams of each scan met in m, `(n, 2)`."""
        s, first = self.scenario, self._first
        scanner, found, failed = Scanner([s.sensing], self.period, [s.obstacles]), [], np.zeros(1)
        scanner.start(0, s.seed, 0)
        for tick in range(first + len(self.log)):
            now = self.log[max(0, tick - first)]  # before the interval only the noise is drawn
            pose = np.array([now["x"], now["y"], now["theta"]])
            scanner.scan(tick, pose[None], failed)
            if first <= scanner.taken[0] == tick and (ranges := scanner.scans[0]) is not None:
                found.append(turned(s.sensing.lidar.points(ranges), pose))
        return found

    def scan(self, index: int) -> Array | None:
        """Returns where the beams of the last scan at a sample met something, x and y in m, `(n, 2)`; None without one.

        A result holds no scans. They are taken again from the recorded poses with the noise of the seed of the run,
        and have the same bits.
        """
        if not self._scanned:
            return None
        every = self.scenario.sensing.lidar.every(self.period)
        last = (self._first + index) // every - -(-self._first // every)  # of the interval
        return self._scans[last] if last >= 0 else None

    def perturbation(self, time: float) -> Perturbation:
        """Returns the perturbation of the plant at a time in s."""
        return state(self.scenario, self.start + time)["perturbation"]

    def qpos(self, index: int) -> Array:
        """Returns the generalised position at a sample, `(nq,)`; a result without height and tilt stands upright."""
        now = self.log[index]
        pose, twist = (np.array([now[name] for name in names]) for names in (("x", "y", "theta"), ("v", "omega")))
        if np.isfinite(now["z"]):
            qpos = self.model.qpos0.copy()
            chassis = qpos[self.model.joint("chassis").qposadr[0] :]
            chassis[:3] = now["x"], now["y"], now["z"]
            mujoco.mju_euler2Quat(chassis[3:7], np.array([now["theta"], now["pitch_angle"], now["roll_angle"]]), "zyx")
        else:
            qpos = stand(self.model, pose, twist).qpos
        steer(self.model, qpos, now["steering_angle"])
        for wheel, angle in self._wheel_angles.items():
            qpos[self.model.joint(wheel).qposadr[0]] = angle[index]
        return qpos


def path(rows: Rows, radius: float, height: float, magnified: int) -> Array:
    """Returns the path of P, a little above the ground, in m, with the shape of `rows` and 3.

    Args:
        rows: Records of `TICK`.
        radius: Radius of the driven wheels in m.
        height: Height of the middle between them in m, where none was recorded.
        magnified: Factor on the deviation from the reference.
    """
    z = np.where(np.isfinite(rows["z"]), rows["z"], height)
    return np.concatenate([drawn(rows, magnified), (z - radius + PATH_HEIGHT)[..., None]], axis=-1)


def joint_log(recordings: Sequence[Recording]) -> tuple[Array, Rows, Array | None]:
    """Returns what several recordings hold, with NaN after the end of each.

    Returns:
        Times in s, `(T,)`; a record of `TICK` for each sample and run, `(T, B)`; and clearances in m, `(T, B)`, or None
        where there are no obstacles.
    """
    log = blank(max(len(r.log) for r in recordings), len(recordings))
    clearance = np.full(log.shape, np.nan)
    for k, r in enumerate(recordings):
        log[: len(r.log), k] = r.log
        if r.clearance is not None:
            clearance[: len(r.log), k] = r.clearance
    known = any(r.clearance is not None for r in recordings)
    return recordings[0].period * np.arange(len(log), dtype=float), log, clearance if known else None


def event_times(recordings: Sequence[Recording]) -> list[float]:
    """Returns the times of the events of recordings in s, from the first sample on."""
    longest = max(r.duration for r in recordings)
    times = {event.time - r.start for r in recordings for event in r.scenario.events}
    return sorted(time for time in times if 0 <= time <= longest)


def references_of(scenarios: Sequence[Scenario]) -> list[Reference]:
    """Returns the references of scenarios and of their events, each once."""
    found = [[s.reference, *(event.reference for event in s.events if event.reference)] for s in scenarios]
    return list(dict.fromkeys(reference for references in found for reference in references))


def looks_of(recordings: Sequence[Recording], runs: Sequence[int]) -> list[Look]:
    """Returns the look of each run, with its number in the label if labels would be equal.

    Raises:
        InputError: Runs differ in world, obstacles, robot or control period, so they cannot share a scene; or one has
            no sample, as it had failed before.
    """
    labels = told_apart([r.label for r in recordings], runs)
    first = recordings[0].scenario
    for r, label in zip(recordings, labels, strict=True):
        if not np.isfinite(r.log["x"][0]):
            raise InputError(f"run: {label} had failed before {r.start:g} s")
        if field := difference(r.scenario, first):
            raise InputError(f"run: {label} drove with another {field} than {labels[0]}")
    return looks(labels, [r.controller for r in recordings])


def difference(one: Scenario, other: Scenario) -> str:
    """Returns the field in which two runs differ so that they cannot share a scene; "" where there is none."""
    return next((name for name in SCENE_FIELDS if getattr(one, name) != getattr(other, name)), "")


class Library:
    """The runs of a result or of a sweep.

    Attributes:
        table: Row of each run with the values that vary and the metrics of its last lap.
    """

    def __init__(self, path: Path, code: bool = True) -> None:
        """Opens a folder that `mrctl.save` or `mrctl sweep` wrote.

        Args:
            path: The folder.
            code: Whether a sweep may run the Python files of the user's stages that it was driven with.

        Raises:
            InputError: The folder is neither a result nor a sweep, or has no run yet; or as `jobs.stages_of`.
        """
        self._path, self._result, self._code = path, None, code
        self._drives: dict[str | None, Callable[..., xr.Dataset]] = {}  # by the user's controller
        if (path / "sweep.json").is_file():
            self.table = Store(path).frame().set_index("run", drop=False)
            drivers = jobs.sweep_of(Store(path)).drivers
            if len(drivers) == 1:  # otherwise each is loaded when its first run is shown
                self._drive(0)
        else:
            self._result = as_runs(store.open(path))
            self.table = summary(self._result).set_index(np.arange(self._result.sizes["run"]))
        if self.table.empty:
            raise InputError(f"{path}: there is no run in it yet")

    def check(self, run: int) -> None:
        """Raises `InputError` if there is no such run."""
        if run not in self.table.index:
            raise InputError(f"run: {self._path} has no run {run}")

    def first_shown(self, run: int | None) -> list[int]:
        """Returns the runs that are shown first: the one that is asked for, or the first.

        Beside the first of a few runs there are those that can share its scene.

        Raises:
            InputError: There is no such run.
        """
        if run is not None:
            self.check(run)
            return [run]
        first, *others = (int(k) for k in self.table.index)
        if len(others) >= MAX_SHOWN:
            return [first]
        return [first, *(k for k in others if not difference(self._scenario(k), self._scenario(first)))]

    def _scenario(self, run: int) -> Scenario:
        """Returns the scenario of a run."""
        return jobs.scenario_of(self._path, run) if self._result is None else scenarios_of(self._result)[run]

    def recording(self, run: int) -> Recording:
        """Returns a run: one of a result is read, one of a sweep is simulated once more, with the same bits.

        Raises:
            InputError: There is no such run.
        """
        self.check(run)
        if self._result is not None:
            return Recording(self._result.isel(run=run))
        return Recording(self._drive(run)([jobs.scenario_of(self._path, run)]).isel(run=0))

    def _drive(self, run: int) -> Callable[..., xr.Dataset]:
        """Returns what drives a run of a sweep."""
        sweep = jobs.sweep_of(Store(self._path))
        if (own := sweep.driven_by(run)) not in self._drives:
            self._drives[own] = jobs.driver(sweep, jobs.stages_of(self._path, run, self._code))
        return self._drives[own]
