"""How the runs of a simulation end, what their learners have then, and the result."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

from mrctl.control.features import feature_scale
from mrctl.kernel import Array, Rows
from mrctl.loop.hierarchy import Hierarchy
from mrctl.loop.learned import LAYOUT
from mrctl.loop.log import Log
from mrctl.loop.user_stages import StageError, UserFeedforward
from mrctl.physics import hull
from mrctl.physics.plant import Plant
from mrctl.results import dataset
from mrctl.scenario import Scenario, controller_name
from mrctl.sensing.estimators import Estimator
from mrctl.theory.clearance import clearances
from mrctl.theory.dynamics import inverse_coefficients
from mrctl.theory.obstacles import Surroundings


def titles(scenario: Scenario, stages: Mapping[str, str]) -> tuple[str, str]:
    """Returns the name of a run's controller, which is the label of a run without name, and that of its feedforward.

    Args:
        scenario: The run.
        stages: Names of the user's factories by stage.
    """
    others = dict(stages)
    feedforward = controller_name(scenario.prior, others.pop("feedforward", scenario.learner))
    return controller_name(feedforward, *others.values()), feedforward


class Outcome:
    """How runs ended: when robots failed, and what each had learned then, for the learners go on in the batch.

    Attributes:
        failure_time: Time at which each robot failed in s, NaN where it has not, `(B,)`.
    """

    def __init__(self, plant: Plant, hierarchy: Hierarchy, estimator: Estimator, period: float) -> None:
        """Takes the parts of a simulation, and its control period in s."""
        self._plant, self._hierarchy, self._estimator, self._period = plant, hierarchy, estimator, period
        self.failure_time = np.full(plant.size, np.nan)
        self._learned: dict[int, Array] = {}  # what each robot had adapted when its run ended, flat
        self._final: dict[int, tuple[Array, Array]] = {}  # what `parameters` had where a run ended without failure

    def restart(self, row: int) -> None:
        """Forgets how the run of one robot ended."""
        self.failure_time[row] = np.nan
        self._learned.pop(row, None)
        self._final.pop(row, None)

    def fail(self, tick: int) -> None:
        """Takes the robots that have been stopped since the last call for failed, after `tick` control periods."""
        new = self._plant.stopped & np.isnan(self.failure_time)
        new[list(self._learned)] = False
        self.failure_time[new] = tick * self._period
        self._keep_learned(np.flatnonzero(new).tolist(), tick)

    def end(self, ended: Mapping[int, str], tick: int) -> None:
        """Stops the robots whose runs end after `tick` control periods, each with the reason of its failure, or ""."""
        ended = {row: reason for row, reason in ended.items() if row not in self._learned}
        if ended and not all(ended.values()) and (coefficients := self.parameters()) is not None:
            known, true = coefficients
            self._final |= {row: (known[row].copy(), true[row].copy()) for row in ended if not ended[row]}
        for row, reason in ended.items():
            self._plant.stop(row, reason)
            self._keep_learned([row], tick)
            if reason:
                self.failure_time[row] = tick * self._period

    def _keep_learned(self, rows: Sequence[int], tick: int) -> None:
        """Keeps what robots have learned."""
        if rows:
            learned = self._adapted(tick)
            self._learned |= {row: learned[row].copy() for row in rows}

    def _adapted(self, tick: int) -> Array:
        """Returns what the learners have adapted, as `Learner.adapted`; a stage that cannot say it fails all runs."""
        learner = self._hierarchy.learner
        try:
            return learner.adapted()
        except StageError as error:
            assert isinstance(learner, UserFeedforward)
            for row in np.flatnonzero(~self._plant.stopped).tolist():
                self._plant.stop(row, str(error))
                self.failure_time[row] = tick * self._period
            width = sum(int(np.prod(shape)) for shape in learner.shapes.values())
            return np.full((self._plant.size, width), np.nan)

    def result(self, scenarios: Sequence[Scenario], stages: Mapping[str, str], log: Log, tick: int) -> xr.Dataset:
        """Returns the signals of the first `tick` control periods, and how the runs ended.

        Args:
            scenarios: Scenario of each run.
            stages: Names of the user's factories by stage.
            log: The records.
            tick: Number of control periods.
        """
        size, ticks, plant = len(scenarios), log.ticks[:tick], self._plant
        label, feedforward = titles(scenarios[0], stages)
        names = [label] * size, [feedforward] * size
        found = dataset.dataset(scenarios, *names, ticks, plant.failure, self.failure_time, self._weights(tick))
        scanned = {}
        if self._estimator.scanner:
            scanned["scanned"] = "run", np.ones(size, bool), {"long_name": "whether its lidar scanned"}
        extra = self._coefficients() | self._layout() | self._clearance(scenarios, ticks) | scanned | self._faults()
        return found.assign(extra | self._constants() | self._gains())

    def _weights(self, tick: int) -> Array | None:
        """Returns what each robot has learned, as of its end if it has ended, flat; None if nothing is learned."""
        learned = self._adapted(tick)
        if not learned.size:
            return None
        for row, kept in self._learned.items():
            learned[row] = kept
        return learned

    def _layout(self) -> dict[str, Any]:
        """Returns the variable `LAYOUT`, where a feedforward of the user keeps what it learns."""
        learner = self._hierarchy.learner
        if not (isinstance(learner, UserFeedforward) and learner.shapes):
            return {}
        text = json.dumps({"learner": learner.stage.name, "shapes": learner.shapes})
        return {LAYOUT: ("run", np.array([text] * self._plant.size, object))}

    def _coefficients(self) -> dict[str, Any]:
        """Returns variables with the coefficients of `parameters`, where the learner has some."""
        if (coefficients := self.parameters()) is None:
            return {}
        axes, units = ("run", "feature", "channel"), {"units": "V"}
        known, true = coefficients
        return {"parameters": (axes, known, units), "true_parameters": (axes, true, units)}

    def _constants(self) -> dict[str, Any]:
        """Returns the variables with which the features of a commanded motion are computed."""
        size, robot = self._plant.size, self._plant.robot
        return {
            "half_track": ("run", np.full(size, robot.half_track), {"units": "m"}),
            "feature_scale": (("run", "feature"), np.tile(feature_scale(robot), (size, 1))),
        }

    def _gains(self) -> dict[str, Any]:
        """Returns variables with the gains of the controllers before any event."""
        gains = {}
        for name, (unit, meaning) in dataset.GAIN_VARIABLES.items():
            values = self._hierarchy.gains[name].copy()
            gains[name] = ("run", "channel")[: values.ndim], values, {"units": unit, "long_name": meaning}
        return gains

    def _faults(self) -> dict[str, Any]:
        """Returns the variables of `dataset.FAULTS`: for each robot the first fault of a stage of the user, or ""."""
        none = [""] * self._plant.size
        faults = {
            "estimator_fault": getattr(self._estimator, "faults", none),
            "feedforward_fault": getattr(self._hierarchy, "feedforward_faults", none),
        }
        return {name: ("run", np.array(texts, object)) for name, texts in faults.items()}

    def _clearance(self, scenarios: Sequence[Scenario], ticks: Rows) -> dict[str, Any]:
        """Returns the variable `clearance`, where there are obstacles: the distance of each footprint from them."""
        around = [s.obstacles for s in scenarios]
        if not around[0].shapes:
            return {}
        footprint = hull.footprint(self._plant.models[0])
        made = {own: Surroundings(own) for own in dict.fromkeys(around)}
        poses = np.stack([ticks[name].T for name in ("x", "y", "theta")], -1)
        times = self._period * np.arange(len(ticks), dtype=float)
        found = np.stack([clearances(footprint, poses[row], times, made[own]) for row, own in enumerate(around)])
        attributes = {"units": "m", "long_name": "distance of the footprint from the nearest obstacle"}
        return {"clearance": (("run", "time"), found, attributes)}

    def parameters(self) -> tuple[Array, Array] | None:
        """Returns the coefficients of the scaled features: the sum of prior and learner, and the true ones.

        They are those of now or, where a run has ended without failure, those of its end.

        Returns:
            Two arrays `(B, 8, 2)` in V, NaN where the second channel is steering, and the first also where a robot has
            failed; None if the learner has no such coefficients.
        """
        hierarchy = self._hierarchy
        if (learned := hierarchy.learner.parameters) is None:
            return None
        scale = feature_scale(self._plant.robot)[:, None]
        known = scale * hierarchy.prior.rows["c"] + learned
        true = scale * np.stack([inverse_coefficients(robot) for robot in self._plant.truth])
        known[self._plant.stopped] = np.nan
        if self._hierarchy.rigid:  # the second channel is steering
            known[:, :, 1] = true[:, :, 1] = np.nan
        for row, final in self._final.items():
            known[row], true[row] = final
        return known, true
