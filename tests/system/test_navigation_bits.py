"""A mission is the same alone, in a batch, in a sweep that was killed and resumed, and replayed from its store.

Runs come in pairs of missions that may share a batch.
"""

import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from test_batch_equals_single import equal

import mrctl
from mrctl import Disc, InputError, Line, Obstacles, Scenario, Sweep, simulate
from mrctl.loop import user_files
from mrctl.loop.groups import arranged, uniform
from mrctl.navigation.planning import prepared
from mrctl.navigation.tasks import task_of
from mrctl.results.dataset import SIGNALS
from mrctl.sweep import jobs
from mrctl.sweep.pool import JobOutcome
from mrctl.sweep.store import Store

ALIKE = 90  # difference of the numbers of missions that have the same kind of world, robot and localisation
TOGETHER = 6  # runs in a batch
AVOIDERS = "barrier", "window", "mppi"
KINDS = "doorway", "slalom", "corridor", "cellular", "warehouse"
LOCALISED = "scan", "particles", "none"
# The motion stages of missions, as a file that a sweep names.
STAGES = "\n".join(["from mrctl.navigation.mission import avoiding", *(f"{a} = avoiding('{a}')" for a in AVOIDERS)])
# Computes each sweep in a process of its own, which is killed half-way.
KILLED = """
import json
import os
import sys
from pathlib import Path

sys.path[:0] = sys.argv[1:3]
import test_navigation_bits
from conftest import Here
from mrctl import Sweep
from mrctl.sweep import jobs

jobs.Processes = Here
for name in sys.argv[3:]:
    if not (child := os.fork()):
        sweep = Sweep.from_dict(json.loads(Path(name + ".json").read_text()))
        jobs.run(sweep, name, 1, work=test_navigation_bits.killing)
        os._exit(0)
    _, status = os.waitpid(child, 0)
    assert os.WIFSIGNALED(status) and os.WTERMSIG(status) == 9, status
"""


def killing(path: str, job: int) -> JobOutcome:
    """Kills the process of the sweep, which is the one that computes, in the middle."""
    if job == Store(path).jobs // 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return jobs.compute(path, job)


def pair(number: int, avoid: str) -> list[Scenario]:
    """Two missions in different worlds of the same kind, which differ in seed and plant, and may share a batch."""
    plants = {}, {"mass_factor": 1.2, "payload": 1.0}
    drives = [mission(other, avoid) for other in (number, number + ALIKE)]
    return [own.replace(seed=2 * number + k, perturbation=plants[k]) for k, own in enumerate(drives)]


def mission(number: int, avoid: str) -> Scenario:
    """A mission with obstacles, one of which moves; the kind of world, robot and localisation go by the number."""
    kind, localised = KINDS[number % 5], LOCALISED[number % 3]
    path = "car" if avoid != "none" else ("car", "turtlebot", "racecar")[number // 15 % 3]
    own = Scenario.from_dict({"robot": {"path": path}, "prior": "model", "learner": ("none", "composite")[number % 2]})
    if localised != "none":
        own = own.replace(sensing={"tier": ("lab", "field")[number % 2], "localisation": localised})
    while True:  # worlds without a way are left out
        try:
            task = task_of(f"{kind}:{number}", own)
            x, y, _ = task.start
            course = Line(heading=1.5, speed=0.3)
            mover = Disc(x=-2.5, y=-x - 1.6, radius=0.1, course=course)  # crosses ahead of the start along +y
            task = task.replace(obstacles=Obstacles(shapes=(*task.obstacles.shapes, mover.replace(x=y - 1.5))))
            return prepared(task, own, avoid=avoid)[1]  # pyright: ignore[reportArgumentType]
        except InputError:
            number += 2 * ALIKE


@pytest.mark.parametrize(
    ("plain", "avoiders", "avoided"),
    [([1], AVOIDERS[:2], 1), pytest.param(range(160), AVOIDERS, 30, marks=pytest.mark.full)],
    ids=["6", "500"],
)
def test_same_bits(plain: Sequence[int], avoiders: Sequence[str], avoided: int, here: None, tmp_path: Path) -> None:
    """So with and without the stages that avoid obstacles, in worlds of all generators, with either localisation."""
    (tmp_path / "stages.py").write_text(STAGES)
    sweeps = {"none": Sweep.of([run for k in plain for run in pair(k, "none")], record="full", chunk=1)}
    for avoid in avoiders:
        runs = [run for number in range(avoided) for run in pair(number, avoid)]
        sweeps[avoid] = Sweep.of(runs, record="full", chunk=1, controller=f"motion={tmp_path}/stages.py:{avoid}")
    for name, sweep in sweeps.items():
        (tmp_path / f"{name}.json").write_text(sweep.model_dump_json())
    folders = Path(__file__).parent, Path(__file__).parents[1]
    command = [sys.executable, "-c", KILLED, *map(str, folders), *(str(tmp_path / name) for name in sweeps)]
    subprocess.run(command, check=True)
    count, shared, outcomes = 0, set(), []
    for name, sweep in sweeps.items():
        store = tmp_path / name
        assert len(Store(store).done()) == Store(store).jobs // 2 > 0
        jobs.run(sweep, store, 1)
        opened = mrctl.open(store)
        stages = user_files.load(sweep.controller) if sweep.controller else {}
        for first in range(0, sweep.size, TOGETHER):
            some = [sweep.scenario(run) for run in range(first, min(first + TOGETHER, sweep.size))]
            together = simulate(some, **stages)
            if any(len(rows) > 1 for rows in uniform([arranged(own) for own in some])):
                shared.add(name)
            for row, own in enumerate(some):
                alone, stored = simulate(own, **stages), opened.isel(run=first + row)
                equal(alone, together, row)
                size = alone.sizes["time"]
                for signal_name in SIGNALS:
                    kept = stored[signal_name].values
                    assert kept[:size].tobytes() == alone[signal_name].values.tobytes(), (name, first, signal_name)
                    assert np.isnan(kept[size:]).all()
                assert jobs.repeat(store, first + row) == ("bit-identical", True)
                outcomes.append(str(alone["failure"].values))
                count += 1
    print(f"{count} runs have the same bits; failures: { {why: outcomes.count(why) for why in set(outcomes)} }")
    assert count == 2 * (len(plain) + len(avoiders) * avoided)
    assert shared == {"none", *avoiders}  # missions in different worlds did share a batch
