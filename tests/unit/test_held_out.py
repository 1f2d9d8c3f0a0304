"""The held-out cells: frozen, apart from everything that settings are chosen on, and within what the robot can do."""

import hashlib
import json
from itertools import combinations, product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mrctl import PERTURBATIONS, Scenario
from mrctl.experiments import cases, held_out, held_out_cells, results_page
from mrctl.experiments.held_out_cells import Which, cells
from mrctl.experiments.suite import Floor
from mrctl.experiments.suite_tables import COLUMNS, WINDOWS
from mrctl.loop.simulation import Simulation

SETS: tuple[Which, ...] = ("first", "second")


@pytest.mark.parametrize(("which", "seed"), [("first", 200_000), ("second", 201_000)])
def test_apart(which: Which, seed: int) -> None:
    """Forty cells; their seeds, courses and plants are in no other set."""
    found = cells(which).cases(2)
    assert len(found) == len({case.name for case in found}) == 40
    sets = (cases.SUITE_SEEDS, cases.TUNING_SEEDS, cases.HELD_OUT_SEEDS)
    assert all(set(one).isdisjoint(other) for one, other in combinations(sets, 2))
    runs = [run for case in found for run in case.scenarios]
    assert {run.seed for run in runs} == {seed, seed + 1}
    assert {run.sensing.tier for run in runs} == {"lab"}
    others = [run for case in cases.cases("full", 1, 3) for run in case.scenarios]
    assert not {run.reference for run in runs} & {run.reference for run in others}
    assert not set(cells(which).plants.values()) & set(PERTURBATIONS.values())


def test_sets_share_nothing() -> None:
    """No course, plant or seed of the second set is one of the first."""
    first, second = map(cells, SETS)
    assert not set(first.courses.values()) & set(second.courses.values())
    assert not set(first.plants.values()) & set(second.plants.values())
    assert not set(first.seeds) & set(second.seeds)


@pytest.mark.parametrize(("which", "digest"), [("first", "56dedb0ae7ce1e6f"), ("second", "6b2ab0933320b8a5")])
def test_frozen(which: Which, digest: str) -> None:
    """The cells are those that were committed before they were first driven; who changes one makes another set."""
    kinds = (cells(which).courses, cells(which).plants)
    listed = [{name: one.model_dump(exclude_defaults=True) for name, one in kind.items()} for kind in kinds]
    text = json.dumps([*listed, held_out_cells.LAPS, held_out_cells.NO_SPREAD])
    assert hashlib.sha256(text.encode()).hexdigest()[:16] == digest


@pytest.mark.parametrize(("which", "course"), [(which, course) for which in SETS for course in cells(which).courses])
def test_can_be_driven(which: Which, course: str) -> None:
    """The robot can follow each course, and each plant is one that the engine accepts."""
    reference = cells(which).courses[course]
    plants = [Scenario(laps=1, reference=reference, perturbation=plant) for plant in cells(which).plants.values()]
    simulation = Simulation(plants)
    simulation.step()
    assert simulation.running


def test_log_is_read_as_data(tmp_path: Path) -> None:
    """Whether a result is logged depends on the last line on a feedforward, however that line is written."""
    log = tmp_path / held_out.LOG_FILE
    assert not held_out._said(tmp_path, "fel")
    log.write_text('{"entry":"fel","says":"all"}\n{"entry": "rls"}\n')
    assert held_out._said(tmp_path, "fel") and not held_out._said(tmp_path, "rls")


def test_a_line_of_the_log_that_was_cut_off(tmp_path: Path) -> None:
    """What a killed process wrote in part is passed over, and the next line does not continue it."""
    log = tmp_path / held_out.LOG_FILE
    log.write_text('{"time": "t", "entry": "fel", "mrctl": "0", "says": "all"}\n{"entry": "fe')
    assert held_out._said(tmp_path, "fel")
    held_out._log(tmp_path, {"entry": "fel", "mrctl": "0"})
    assert not held_out._said(tmp_path, "fel")
    text = results_page.held_out_text("## Held-out cells\n\n| a |\n", log.read_text() + '{"ti')
    assert text.endswith("fel, mrctl 0: begun")


def test_cells_above_a_rival_are_named() -> None:
    """A cell that is above a rival beyond the floor is listed with both; where there is none, there is no list."""

    error, floor = 1e-3 * np.array([1.0, 1.1, 1.2, 1.0]), Floor(difference=1e-4, mean=1e-4, tie=1e-4)
    level, worse = held_out._standing(error, error, floor), held_out._standing(error + 5e-4, error, floor)
    names = ("course", "plant", "metric", "window", "rival")
    everywhere = list(product(cells("first").courses, cells("first").plants, COLUMNS, WINDOWS, held_out.RIVALS))

    def rows(*above: tuple[str, ...]) -> list[dict[str, Any]]:
        return [dict(zip(names, at, strict=True)) | (worse if at in above else level) for at in everywhere]

    (only,) = held_out.summarised("first", "fel", rows(), 4)
    assert (only.cells.iloc[:, 2:] == "40/40, 40 of them ties").all(axis=None)
    behind = ("square", "slope 4°, mass +20 %", "omega_rmse", "first", "true_model")
    other = ("circle", "light, weak supply", "omega_rmse", "first", "model")
    counts, _ = held_out.summarised("first", "fel", rows(behind, other), 4)
    assert counts.says.endswith("in V at least 40, in θ̇ at least 38, in position at least 40.")  # no cell counts twice
    _, listed = held_out.summarised("first", "fel", rows(behind), 4)
    (line,) = listed.cells.to_dict("records")
    assert line["error"] == "θ̇, mrad/s" and line["rival"] == "true_model" and line["window"] == "lap 1"
    assert line["cell"] == "square; slope 4°, mass +20 %" and line["above it by"].startswith("0.5")
    assert line["floor"] == "0.100"
