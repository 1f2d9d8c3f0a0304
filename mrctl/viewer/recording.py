"""Runs that are over: their record, and where the robot was."""

# pyright: reportAttributeAccessIssue=false
# (mujoco is compiled and ships no stubs)

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path

import mujoco
import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import NDArray

from mrctl.kernel import Rows
from mrctl.loop.simulation import simulate
from mrctl.physics import mjcf
from mrctl.physics.parameters import read_robot
from mrctl.physics.stand import front_rates, stand, steer
from mrctl.record import InputError
from mrctl.results.dataset import SIGNALS, blank, scenarios_of
from mrctl.results.metrics import summary
from mrctl.scenario import Scenario
from mrctl.sweep import store
from mrctl.sweep.store import Store
from mrctl.theory.perturbation import Perturbation
from mrctl.viewer.session import state

Array = NDArray[np.float64]
FEW = 4  # runs of a result that are all shown at once
WHEELS = {"wheel_left": "wheel_rate_left", "wheel_right": "wheel_rate_right"}


class Recording:
    """One run.

    Attributes:
        scenario: What was run.
        label: Its name.
        period: Time between samples in s.
        start: Time of the first sample in the run, s; the times below are counted from there.
        log: What was recorded, one record of `TICK` a sample, `(T,)`; as long as the robot drove.
        failure: Why it stopped early, or "".
    """

    def __init__(self, run: xr.Dataset) -> None:
        """Takes a single run of a result, or a stretch of one."""
        self.scenario: Scenario = scenarios_of(run)[0]
        self.label = str(run["label"].values)
        self.period = float(run.attrs["control_period"])
        self.start = float(run["time"][0])
        log = blank(run.sizes["time"])
        for name in SIGNALS:
            if name in run:
                log[name] = run[name].values
        driven = np.flatnonzero(np.isfinite(log["x"]))
        self.log = log[: 1 + driven[-1]] if driven.size else log[:1]
        self.failure = str(run["failure"].values)

    @property
    def duration(self) -> float:
        """Time of the last sample in s."""
        return self.period * (len(self.log) - 1)

    def index(self, time: float) -> int:
        """The sample at a time, or the last one."""
        return int(np.clip(round(time / self.period), 0, len(self.log) - 1))

    @cached_property
    def model(self) -> mujoco.MjModel:
        """The compiled world with the nominal robot."""
        return mjcf.load(self.scenario.world, self.scenario.steering, robot=self.scenario.robot)

    @cached_property
    def _turned(self) -> dict[str, Array]:
        """How far each wheel has turned at the samples, rad."""
        log, robot = self.log, read_robot(self.model)
        rates = {wheel: log[name] for wheel, name in WHEELS.items()}
        rates |= front_rates(self.model, robot, log["v"], log["omega"], log["steering_angle"])
        return {wheel: self.period * np.cumsum(rate) for wheel, rate in rates.items()}

    def perturbation(self, time: float) -> Perturbation:
        """What the plant did differently at a time."""
        return state(self.scenario, self.start + time)["perturbation"]

    def way(self, points: int = 600) -> Array:
        """The way that P went, a little above the ground, `(points, 3)` in m."""
        rows = self.log[np.linspace(0, len(self.log) - 1, points).astype(int)]
        height = self.qpos(0)[2] - self.model.geom("wheel_left").size[0] + 0.01
        return np.column_stack([rows["x"], rows["y"], np.full(points, height)])

    def qpos(self, index: int) -> Array:
        """Where the robot stood at a sample, `(nq,)`: on the ground, as recorded in the plane."""
        now = self.log[index]
        pose, twist = (np.array([now[name] for name in names]) for names in (("x", "y", "theta"), ("v", "omega")))
        qpos = stand(self.model, pose, twist).qpos
        steer(self.model, qpos, now["steering_angle"])
        for wheel, angle in self._turned.items():
            qpos[self.model.joint(wheel).qposadr[0]] = angle[index]
        return qpos


def together(recordings: Sequence[Recording]) -> tuple[Array, Rows]:
    """Times `(T,)` in s and records of several runs, one of `TICK` a sample and run, `(T, B)`; NaN after its end."""
    log = blank(max(len(r.log) for r in recordings), len(recordings))
    for k, r in enumerate(recordings):
        log[: len(r.log), k] = r.log
    return recordings[0].period * np.arange(len(log), dtype=float), log


def names(recordings: Sequence[Recording], runs: Sequence[int]) -> list[str]:
    """A label a run, with its number where they would be the same.

    Raises:
        InputError: Runs that do not go into one scene.
    """
    first = recordings[0]
    for r in recordings:
        for what in ("world", "robot", "control_period"):
            if getattr(r.scenario, what) != getattr(first.scenario, what):
                raise InputError(f"run: {r.label} drove with another {what} than {first.label}")
    labels = [r.label for r in recordings]
    unique = len(set(labels)) == len(labels)
    return labels if unique else [f"{label} {run}" for label, run in zip(labels, runs, strict=True)]


class Library:
    """The runs of a result or of a sweep.

    Attributes:
        table: A row a run: what varies, and the metrics of its last lap.
    """

    def __init__(self, path: Path) -> None:
        """Opens what `mrctl.save` or `mrctl sweep` wrote.

        Raises:
            InputError: There is neither, or nothing in it.
        """
        self._path, self._result = path, None
        if (path / "sweep.json").is_file():
            Store(path)  # refuses what is none
            self.table = pd.read_parquet(path / "runs.parquet").set_index("run", drop=False)
        else:
            result = store.open(path)
            self._result = result if "run" in result.dims else result.expand_dims("run")
            self.table = summary(self._result).set_index(np.arange(self._result.sizes["run"]))
        if self.table.empty:
            raise InputError(f"{path}: holds no run yet")

    def recording(self, run: int) -> Recording:
        """A run, read, or of a sweep simulated once more: the same bits without a record of every sample.

        Raises:
            InputError: There is no such run.
        """
        if run not in self.table.index:
            raise InputError(f"run: {self._path} has no run {run}")
        if self._result is not None:
            return Recording(self._result.isel(run=run))
        from mrctl.sweep import jobs

        return Recording(simulate([jobs.scenario_of(self._path, run)]).isel(run=0))
