"""The benchmark measures what it says; how fast it is, is for a quiet machine to say.

To repeat the figures of RESULTS.md on yours, with nothing else running: `mrctl bench`, or `mrctl bench --json`.
"""

import json
import sys
from pathlib import Path
from unittest import mock

import numpy as np
import pytest

from mrctl import Box, Obstacles, cli
from mrctl.experiments import bench, bench_navigation
from mrctl.navigation.hybrid_astar import space
from mrctl.physics.obstacles import multi_ray
from mrctl.theory.obstacles import Surroundings

sys.path.append(str(Path(__file__).parent))
import long_sweep  # noqa: E402

pytestmark = pytest.mark.xdist_group("bench")  # what its tests share is made once


@pytest.fixture(scope="module")
def figures():
    """Everything, in a form of a few seconds."""
    with mock.patch.object(bench_navigation, "MAX_TURNS", 1):
        return bench.run(sizes=(1, 3), repetitions=2, chunk=30, worlds=5)


@pytest.mark.parametrize(("size", "threads"), [(1, 1), (3, 1), (17, 2)])
def test_replay(size, threads):
    """Limit and closed loop do the same work: the rollout of the recorded controls ends in the same bits."""
    simulations = bench.build(size, 60, threads)
    assert len(simulations) == threads and sum(simulation.plant.size for simulation in simulations) == size
    starts = [simulation.plant.qpos.copy() for simulation in simulations]
    for _ in range(2):
        closed, limit, same = bench.turn(simulations, 30)
        assert same
        assert closed > 0 < limit
    for simulation, start in zip(simulations, starts, strict=True):
        assert simulation.tick == bench.WARM_TICKS + 60
        assert (np.abs(simulation.plant.qpos[:, :2] - start[:, :2]).max(axis=1) > 0.05).all()  # they drive
        assert (simulation.hierarchy.weight_norm > 0).all()  # and learn
        assert not simulation.plant.stopped.any()


def test_replay_can_fail():
    """Other controls come to other bits."""
    simulation = bench.build(2, 30)
    wrong = [bench.CONTROLS[1], bench.CONTROLS[0], *bench.CONTROLS[2:]]
    with mock.patch.object(bench, "CONTROLS", wrong):
        assert not bench.turn(simulation, 30)[2]


def test_replay_leaves_no_trace():
    """A run that was replayed in between goes on as one that was not."""
    (replayed,), (straight,) = bench.build(2, 40), bench.build(2, 40)
    bench.turn([replayed], 20)
    for _ in range(20):
        replayed.step()
    for _ in range(40):
        straight.step()
    assert replayed.tick == straight.tick
    records = [simulation.log.ticks[: simulation.tick].tobytes() for simulation in (replayed, straight)]
    assert records[0] == records[1]


def test_figures(figures):
    """Rates, ratios and memory belong together."""
    assert [row["robots"] for row in figures["robots"]] == [1, 3]
    assert figures["threads"][0]["threads"] == 1
    for row in figures["robots"] + figures["threads"]:
        assert row["replayed_exactly"]
        assert row["ticks"] == bench.WARM_TICKS + 2 * max(2, row["threads"] * 30 // row["robots"])
        assert row["real_time_factor"] == pytest.approx(row["steps_per_second"] * 0.002)
        assert row["ratio"] > 0
    assert figures["today"]["steps_per_second"] > 0


def test_parts(figures):
    """All components were measured; the physics is the largest."""
    for parts in figures["parts"].values():
        assert set(parts) == {*bench.PARTS, "the rest"}
        assert all(parts[name] > 0 for name in bench.PARTS)
        assert max(parts, key=parts.__getitem__) == "physics"


def test_first_world_without_a_way():
    """A plan counts, wherever it is in the list, and a world without one does not, be it the first."""
    wall = Surroundings(Obstacles(shapes=(Box(x=1.0),))).at(0.0)
    corners = np.array([[-0.1, -0.1], [0.1, -0.1], [0.1, 0.1], [-0.1, 0.1]])
    where = space(wall, corners, np.full(2, -2.0), np.full(2, 2.0))
    tried = [(where, np.zeros(3), np.array([x, 0.0, 0.0]), 0.3, False) for x in (1.0, -1.0, 0.2)]
    row = bench_navigation._planned("three", tried)
    assert row["worlds"] == 3 and row["found"] == 2 and row["cells"] == 1600


def test_navigation(figures):
    """Everything was measured, the parts take less than the whole, and the worlds have the sizes that are said."""
    found = figures["navigation"]
    lidar, particles, mppi = found["pairs"]
    assert lidar["judge"] == "mujoco.mj_multiRay"
    assert bench_navigation._particles(41)["ratio"] < 1  # a median of two turns is that of a busy machine
    for row in (lidar, particles, mppi):
        assert row["us"] > 0 < row["judge_us"]
    discs, generated = found["plans"]
    assert discs["cells"] == 384**2 and 1000 < generated["cells"] < discs["cells"]
    for row in (discs, generated):
        assert 0 < row["found"] <= row["worlds"] <= 5 and row["expanded"] > 0
        assert 0 < row["around_ms"] < row["ms"] <= row["ms_95"]
    assert list(found["missions"]) == ["none", "barrier", "window", "mppi"]
    assert min(found["missions"].values()) > 0


def test_multi_ray():
    """The judge of the lidar sees a wall where it is, and nothing elsewhere."""
    cast = multi_ray(Obstacles(shapes=(Box(x=2.5, length=1.0, width=8.0),)))
    directions = np.array([0.0, 0.5, np.pi])
    assert cast(np.zeros(2), directions, 9.0) == pytest.approx([2.0, 2.0 / np.cos(0.5), 9.0])


def test_autograd_loop_does_the_same_job():
    """What we compare with is no straw man: it follows the lemniscate within centimetres."""
    *_, last = (rmse for _, rmse in bench.autograd_loop(200, 5))
    assert last < 0.02


def test_command(figures, capsys):
    """The command prints tables, or the figures as JSON."""
    with mock.patch.object(bench, "run", lambda: figures):
        assert cli.main(["bench", "--json"]) == 0
        assert json.loads(capsys.readouterr().out) == figures
        assert cli.main(["bench"]) == 0
    text = capsys.readouterr().out
    assert f"| {figures['robots'][1]['ratio']:.3f} |" in text
    assert "NO" not in text and "mujoco.mj_multiRay" in text and "| mppi " in text
    earlier = {key: value for key, value in figures.items() if key != "navigation"}
    assert text.startswith(bench.text(earlier))  # files of earlier versions are still read


def test_long_sweep(tmp_path):
    """The script behind the README's figures of 10,000 runs does them all, and sees the memory of workers too."""
    curve, seconds, table = long_sweep.watch(tmp_path, runs=2, workers=1, every=0.2)
    assert len(table) == 2 and not table["failed"].any()
    assert curve[-1, 0] <= seconds and (np.diff(curve[:, 0]) > 0).all()
    assert curve[:, 1].max() > 150  # MiB: an interpreter that has imported the engine
