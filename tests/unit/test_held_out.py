"""The held-out cells: frozen, apart from everything that settings are chosen on, and within what the robot can do."""

import hashlib
import json
from itertools import combinations

import pytest

from mrctl import PERTURBATIONS, Scenario
from mrctl.experiments import cases, held_out
from mrctl.loop.simulation import Simulation


def test_apart() -> None:
    """Forty cells; their seeds, courses and plants are in no other set."""
    found = held_out.cells(2)
    assert len(found) == len({case.name for case in found}) == 40
    sets = (cases.SUITE_SEEDS, cases.TUNING_SEEDS, cases.HELD_OUT_SEEDS)
    assert all(set(one).isdisjoint(other) for one, other in combinations(sets, 2))
    runs = [run for case in found for run in case.scenarios]
    assert {run.seed for run in runs} == {200_000, 200_001}
    assert {run.sensing.tier for run in runs} == {"lab"}
    others = [run for case in cases.cases("full", 1, 3) for run in case.scenarios]
    assert not {run.reference for run in runs} & {run.reference for run in others}
    assert not set(held_out.PLANTS.values()) & set(PERTURBATIONS.values())


def test_frozen() -> None:
    """The cells are those that were committed before any tuning; who changes one makes another set."""
    kinds = (held_out.courses(), held_out.PLANTS)
    listed = [{name: one.model_dump(exclude_defaults=True) for name, one in kind.items()} for kind in kinds]
    text = json.dumps([*listed, held_out.LAPS, held_out.NO_SPREAD])
    assert hashlib.sha256(text.encode()).hexdigest()[:16] == "56dedb0ae7ce1e6f"


@pytest.mark.parametrize("course", held_out.courses())
def test_can_be_driven(course: str) -> None:
    """The robot can follow each course, and each plant is one that the engine accepts."""
    reference = held_out.courses()[course]
    plants = [Scenario(laps=1, reference=reference, perturbation=plant) for plant in held_out.PLANTS.values()]
    simulation = Simulation(plants)
    simulation.step()
    assert simulation.running
