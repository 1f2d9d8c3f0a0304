"""Files of what a learner has adapted, from which another run can start."""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import xarray as xr

from mrctl.control.learners import LEARNERS
from mrctl.control.weights import arrays_by_name, notes_on, read_arrays, write_arrays
from mrctl.kernel import Array
from mrctl.record import InputError
from mrctl.results.dataset import check_kind, scenarios_of, written_by
from mrctl.scenario import Scenario

LEARNED = "learned.safetensors"
"""Name of the file that a command writes."""
LAYOUT = "weights_layout"
"""Variable of a result with a feedforward of the user: its name, and names and shapes of its `weights`, as JSON."""


def kept(scenario: Scenario) -> dict[str, tuple[int, ...]]:
    """Names and shapes of what the learner of a scenario keeps, in the order of `weights` of a result.

    Raises:
        InputError: The learner keeps nothing.
    """
    found = LEARNERS[scenario.learner].kept(getattr(scenario, scenario.learner, None))
    if not found:
        raise InputError(f"learned: the learner {scenario.learner} keeps nothing that a run could start from")
    return found


def save_learned(path: str | Path, run: xr.Dataset) -> None:
    """Writes what the learner of one run has adapted as a safetensors file, for the field `learned` of a scenario.

    Args:
        path: File to write, whose name ends in `.safetensors`.
        run: One run of a result, such as `result.isel(run=0)`.

    Raises:
        InputError: `run` is no result or has several runs, the learner keeps nothing, or kept something else in the
            version of the result, the run failed, what it learned is not finite, or the file has another suffix or
            cannot be written.
    """
    check_kind(run)
    if run.sizes.get("run", 1) != 1:
        raise InputError(f"run: {run.sizes['run']} runs; choose one with isel(run=…)")
    one = run.squeeze("run") if "run" in run.dims else run
    if bool(one.failed):
        raise InputError(f"learned: the run failed ({one.failure.item()}), and what it learned cannot be trusted")
    if "weights" not in one:
        raise InputError("learned: no learner of the run keeps anything; one of your own needs the method adapted")
    (scenario,) = scenarios_of(one)
    if LAYOUT in one and one[LAYOUT].item():
        own = json.loads(one[LAYOUT].item())
        learner, layout = own["learner"], own["shapes"]
    else:
        learner, layout = scenario.learner, kept(scenario)
    size, wanted = one.weights.size, sum(int(np.prod(shape)) for shape in layout.values())
    if size < wanted:  # beside learners that keep more, NaN follow
        raise InputError(f"learned: {learner} kept {size} numbers in mrctl {written_by(one)}, and keeps {wanted} now")
    arrays = arrays_by_name(one.weights.values, layout)
    for name, array in arrays.items():
        if not np.isfinite(array).all():
            raise InputError(f"learned: {name} of {learner} is not finite, and no run could start from it")
    notes = {"learner": learner, "robot": scenario.robot.path, "prior": scenario.prior}
    notes |= {"output_scale": repr(scenario.fel.output_scale)} if learner == "fel" else {}
    write_arrays(path, arrays, notes | {"steering": str(one["steering"].values)})


def save_if_learned(path: Path, run: xr.Dataset) -> None:
    """Writes a file as `save_learned` where a run ended well and its learner keeps something finite; else nothing."""
    one = run.squeeze("run") if "run" in run.dims else run
    if "weights" not in one or one["failed"]:
        return
    weights = one["weights"].values
    held = weights[: np.flatnonzero(~np.isnan(weights)).max(initial=-1) + 1]  # as for others, NaN may follow
    if len(held) and np.isfinite(held).all():
        save_learned(path, one)


def load_learned(scenario: Scenario) -> Array:
    """Reads what the learner of a scenario starts from, flat, `(n,)`; warns as `load_arrays`.

    Raises:
        InputError: As `load_arrays`.
    """
    expected = kept(scenario)
    arrays = load_arrays(scenario, scenario.learner, expected)
    return np.concatenate([arrays[name].ravel() for name in expected])


def load_arrays(scenario: Scenario, learner: str, expected: Mapping[str, tuple[int, ...]]) -> dict[str, Array]:
    """Reads what a learner of this name starts from, by name; warns if another robot learned it.

    Args:
        scenario: The scenario, whose `learned` names the file.
        learner: One of mrctl's, or the name of the user's factory.
        expected: Names and shapes of what it keeps of a robot.

    Raises:
        InputError: The file is missing, broken, or of another learner; or what it holds was learned with a prior and
            the scenario has none, or the other way round; or with rigid steering, whose second channel is no voltage,
            and the scenario has another, or the other way round; or with another scale of the output of `fel`.
    """
    notes = notes_on(str(scenario.learned))
    if (other := notes.get("learner", learner)) != learner:
        raise InputError(f"learned: {scenario.learned} was learned by {other}, not by {learner}")
    if ((prior := notes.get("prior", scenario.prior)) == "none") != (scenario.prior == "none"):
        raise InputError(f"learned: {scenario.learned} was learned with the prior {prior}, not with {scenario.prior}")
    steering = scenario.steering or notes.get("steering")  # a scenario may leave it to the robot
    if ((other := notes.get("steering", steering)) == "rigid") != (steering == "rigid"):
        raise InputError(f"learned: {scenario.learned} was learned with {other} steering, not with {steering}")
    if learner == "fel" and float(scale := notes.get("output_scale", scenario.fel.output_scale)) != (
        own_scale := scenario.fel.output_scale
    ):
        raise InputError(f"learned: {scenario.learned} was learned with fel.output_scale {scale}, not {own_scale:g}")
    own = scenario.robot.path
    if Path(robot := notes.get("robot", own)).name != Path(own).name:
        warnings.warn(f"learned: {scenario.learned} was learned on the robot {robot}, not on {own}", stacklevel=2)
    return read_arrays(str(scenario.learned), "learned", expected)
