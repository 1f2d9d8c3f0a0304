"""The comparison of feedforwards, on a short lap."""

import json
from pathlib import Path

import numpy as np
import pytest

import mrctl
from mrctl.experiments import ladder

SCENARIO = mrctl.Scenario(laps=2, reference=mrctl.Circle(radius=0.8, period=6.0))


def test_comparison_is_paired_and_complete(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every combination is there, equal to the same scenario run alone, and ratios pair the seeds."""
    monkeypatch.setattr(ladder, "Scenario", lambda: SCENARIO)
    text = ladder.suite(("none", "oracle"), 2, tmp_path)
    table = json.loads((tmp_path / "table.json").read_text())
    assert (tmp_path / "table.md").read_text() == text + "\n"
    assert len(table["rows"]) == 3 * 4 * 2
    assert len(table["runs"]) == 3 * 4 * 2 * 2
    picked = next(
        r
        for r in table["runs"]
        if (r["steering"], r["perturbation"], r["feedforward"], r["seed"]) == ("rigid", "mass +50 %", "oracle", 1)
    )
    alone = mrctl.simulate(
        [
            SCENARIO.model_copy(
                update={
                    "steering": "rigid",
                    "feedforward": "oracle",
                    "seed": 1,
                    "perturbation": mrctl.PERTURBATIONS["mass +50 %"],
                }
            )
        ]
    )
    assert picked["v_rmse"] == float(mrctl.summary(alone)["v_rmse"].iloc[0])
    keys = ("steering", "perturbation", "feedforward")
    row = next(r for r in table["rows"] if tuple(r[k] for k in keys) == ("compliant", "all", "oracle"))
    own, bare = (
        [r["v_rmse"] for r in table["runs"] if tuple(r[k] for k in keys) == ("compliant", "all", f)]
        for f in ("oracle", "none")
    )
    assert row["v_rmse"]["value"] == pytest.approx(np.mean(own))
    assert row["v_rmse_to_pid"]["value"] == pytest.approx(np.mean(own) / np.mean(bare))
    assert row["v_rmse_to_pid"]["value"] < 1  # on a circle PID has its integral, but the oracle still starts better
