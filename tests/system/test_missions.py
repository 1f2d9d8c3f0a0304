"""Missions: the command and its outcomes, on one plan for several controllers."""

import json
from pathlib import Path

import numpy as np
import pytest
from test_commands import refused

import mrctl
from mrctl import Box, Disc, Obstacles, Scenario, cli
from mrctl.navigation.avoidance import Avoiding, Barrier
from mrctl.navigation.generators import Task
from mrctl.navigation.mission import navigate
from mrctl.physics import mjcf
from mrctl.physics.hull import footprint
from mrctl.theory.clearance import cover

PID = Scenario(learner="none")


def test_command(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """Two robots drive one plan through a door; the table says what the saved result says."""
    out = tmp_path / "out"
    assert (
        cli.main(
            ["navigate", "doorway:3", "--prior", "model", "--learner", "none", "--compare", "none", "--out", str(out)]
        )
        == 0
    )
    printed = capsys.readouterr().out
    mission, result = json.loads((out / "mission.json").read_text()), mrctl.open(out / "result.zarr")
    assert [robot["label"] for robot in mission["robots"]] == ["model", "none"] == result["label"].values.tolist()
    assert (out / "path.png").stat().st_size > 5000 and f"plan of {mission['plan']['length']:.2f} m" in printed
    for robot, run in zip(mission["robots"], (result.isel(run=row) for row in (0, 1)), strict=True):
        driven = run.sel(time=slice(robot["time"] + 1e-6))
        end = driven.isel(time=-1)
        assert robot["outcome"] == "arrived"
        assert np.hypot(end["x"] - mission["goal"][0], end["y"] - mission["goal"][1]) < 0.1
        assert robot["clearance"] == float(driven["clearance"].min()) > 0.02
        way = np.hypot(np.diff(driven["x"]), np.diff(driven["y"])).sum()
        assert robot["length"] == pytest.approx(way) and 0.9 < robot["spl"] <= 1
        assert f"| {robot['label']} " in printed
    again = refused(capsys, "navigate", "doorway:3", "--out", str(out))
    assert "nothing was overwritten" in again


def test_outcomes() -> None:
    """A box that moves into the way, of which the plan does not know, is hit; with a weak battery time runs out."""
    still = Disc(x=1.5, y=1.0, radius=0.2)
    course = mrctl.Line(heading=np.pi / 2, speed=0.2)
    mover = Box(x=-0.4, y=-1.0, length=0.2, width=0.2, course=course)  # from (1, −0.4) along +y
    task = Task(obstacles=Obstacles(shapes=(still, mover)), start=(0.0, 0.0, 0.0), goal=(3.0, 0.0, 0.0))
    hit = navigate(task, PID).table.iloc[0]
    assert hit["outcome"] == "collided" and hit["spl"] == 0 and hit["length"] < 1.5 and hit["clearance"] < 0.01
    free = task.replace(obstacles=Obstacles(shapes=(still,)))
    late = navigate(free, PID.replace(perturbation={"supply_factor": 0.2}))
    assert late.table["outcome"].tolist() == ["out of time"] and late.table["spl"].tolist() == [0]
    assert late.table["time"].iloc[0] == pytest.approx(late.result.sizes["time"] * 0.01, abs=0.02)


def test_ends() -> None:
    """A run ends where the robot rests at its goal, or is stuck; alone it has the bits that it has beside others."""
    line = mrctl.Waypoints(points=((0, 0), (1, 0), (2, 0)), closed=False, timing="limits", speed=0.8)
    own = Scenario(reference=line, laps=8, goal=(2.0, 0.0, 0.0), learner="composite", prior="model")
    cases = [
        own,
        own.replace(seed=1, perturbation="all"),
        own.replace(goal=(1.0, 0.0, 0.0)),  # where it does not rest
        own.replace(perturbation={"supply_factor": 0.02}),
        own.replace(goal=None),
    ]
    together = mrctl.simulate(cases)
    assert together["failure"].values.tolist() == ["", "", "stuck", "stuck", ""]
    for row, scenario in enumerate(cases):
        alone, beside = mrctl.simulate(scenario), together.isel(run=row)
        for name in ("x", "v", "voltage_left", "failure_time", "weights"):
            np.testing.assert_array_equal(alone[name], beside[name], name)
    driven = together.isel(run=1).dropna("time", subset=["x"])
    rests = (np.hypot(driven["x"] - 2, driven["y"]) < 0.1) & (np.abs(driven["v"]) < 0.05)
    assert line.period - 1 < float(driven["time"][-1]) < line.period + 2 and np.flatnonzero(rests).tolist() == [
        driven.sizes["time"] - 1
    ]
    stands = together["x"].isel(run=3).dropna("time").values
    assert len(stands) == 501 and float(np.ptp(stands)) < 0.05
    assert bool(np.isfinite(together["x"].isel(run=4)).all())


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["yard.toml"], "goal: a world from a file needs one"),
        (["yard.toml", "--goal", "1.5", "0.8", "0"], "goal: the robot is in an obstacle"),
        (["yard.toml", "--goal", "3", "0", "0", "--start", "1.5", "0.8", "0"], "start: the robot is in an obstacle"),
        (["yard.toml", "--goal", "0", "0", "0"], "goal: the robot starts there"),
        (["yard.toml", "--goal", "10000", "9", "0"], "map: "),
        (["yard.toml", "--goal", "nan", "0", "0"], "goal"),
        (["yard.toml", "--goal", "3", "0", "0", "--speed", "0"], "speed"),
        (["yard.toml", "--goal", "3", "0", "0", "--margin", "-1"], "margin"),
        (["none.toml", "--goal", "3", "0", "0"], "none.toml"),
        (["none.yaml", "--goal", "3", "0", "0"], "none.yaml"),
        (["doorway:3", "--goal", "9", "0", "0"], "goal: no way to (9.00, 0.00) was found"),
        (["doorway:x"], "the seed must be a number"),
        (["maze:3"], "maze:3 is neither a file"),
        (["doorway:3", "--perturbation.control-delay", "0.013"], "control_delay"),
    ],
)
def test_bad_input_is_one_line(
    arguments: list[str], says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    """Every kind of bad mission ends with one line, before anything runs."""
    monkeypatch.chdir(tmp_path)
    Path("yard.toml").write_text('[[shapes]]\nkind = "disc"\nx = 1.5\ny = 0.8\nradius = 0.2\n')
    assert says in refused(capsys, "navigate", *arguments)


class Blind:
    """A motion stage that asks for the reference's twist."""

    def __init__(self, robot, size):
        pass

    def reset(self, pose, reference, period):
        pass

    def output(self, pose, twist, reference):
        return reference[:, 3:5]


def test_filter_in_the_loop() -> None:
    """The car is asked to drive into a wall: with the filter it does not touch the wall, and without it does."""
    obstacles = Obstacles(shapes=(Box(x=2.5, length=0.2, width=4.0),))
    barrier = Barrier(cover(footprint(mjcf.load()), 4), margin=0.05, deceleration=0.6, period=0.01, lever=0.3)
    scenario = PID.replace(obstacles=obstacles, reference=mrctl.Line(length=2.6), laps=1, initial_spread=(0, 0, 0))
    hit = mrctl.simulate(scenario, motion=Blind)
    assert hit["failure"] == "collision"
    result = mrctl.simulate(scenario, motion=lambda robot, size: Avoiding(robot, size, Blind, obstacles, barrier))
    assert result["failure"] == "" and 0.02 < float(result["clearance"].min()) < 0.3
    early = result["clearance"] > 1.0
    assert np.array_equal(result["v_command"].where(early, drop=True), hit["v_command"][: int(early.sum())])
