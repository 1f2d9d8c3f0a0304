"""Missions: the command and its outcomes, on one plan for several controllers."""

import json
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from test_commands import refused

import mrctl
from mrctl import Box, Disc, Event, InputError, Kanayama, Obstacles, Scenario, cli
from mrctl.control.weights import read_arrays
from mrctl.loop.simulation import Simulation
from mrctl.navigation.avoiders import avoiding
from mrctl.navigation.barrier import Barrier
from mrctl.navigation.barrier_filter import Avoiding
from mrctl.navigation.generators import Task
from mrctl.navigation.mission import again, jerk_of, navigate, order_of, outcomes
from mrctl.navigation.planning import Avoid, prepared
from mrctl.navigation.tasks import task_of
from mrctl.physics import mjcf
from mrctl.physics.hull import footprint
from mrctl.results.dataset import departure
from mrctl.theory.clearance import cover

PID = Scenario(learner="none")
OWN = """
import numpy as np

class Half:
    def __init__(self, robot, size): self.kept = np.full((size, 1), 0.5)
    def output(self, command, derivative): return 0.5 * command
    def learn(self, feedback, frozen, twist, voltage): ...
    def adapted(self): return {"half": self.kept}

class Other(Half): ...

class Broken(Half):
    def __init__(self, robot, size): 1 / 0
"""


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
        x, y = (driven[name].values[::10] for name in ("x", "y"))  # every 0.1 s: a subset of the differences
        assert robot["jerk"] == pytest.approx(np.sqrt(np.mean(np.diff([x, y], 3) ** 2 * 2)) / 1e-3, rel=0.1)
        assert 0 < robot["planning_time"] < 600
    laps = mrctl.per_lap(result)  # all of a mission is one lap, however long its plan takes
    errors = [robot["position_rmse"] for robot in mission["robots"]]
    assert laps["laps"].values.tolist() == [1, 1] and laps["position_rmse"].values[:, 0] == pytest.approx(errors)
    assert "jerk, m/s³" in printed and "planning, s" in printed
    again = refused(capsys, "navigate", "doorway:3", "--out", str(out))
    assert "nothing was overwritten" in again


def test_jerk() -> None:
    """On a circle it is V θ̇² at any period of control, of a constant deceleration nothing, of a short run unknown."""
    for period in (0.01, 0.02):
        angles = 0.8 * period * np.arange(500.0)
        circle = 1.5 * np.column_stack([np.cos(angles), np.sin(angles)])
        assert jerk_of(circle, period) == pytest.approx(1.5 * 0.8**3, rel=1e-3)
    times = 0.01 * np.arange(100.0)
    assert jerk_of(np.column_stack([times - times**2 / 2, 3 + 0 * times]), 0.01) < 1e-9
    for samples in (0, 1, 16, 29, 30):  # as of a robot that collides at once
        assert np.isnan(jerk_of(np.zeros((samples, 2)), 0.01))


@pytest.mark.usefixtures("no_figures")
@pytest.mark.parametrize("avoid", get_args(Avoid))
def test_again(avoid: Avoid, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    """What is saved of a mission drives it again, bit for bit, also where its world has changed since.

    How many roll-outs the mean of `mppi` is taken of does not matter here. The table has no position error of robots
    that avoid, as they are not where the plan is in time.
    """
    monkeypatch.setattr("mrctl.navigation.mppi.SAMPLES", 400)
    monkeypatch.chdir(tmp_path)
    yard = '[[shapes]]\nkind = "disc"\nx = 1.0\ny = {}\nradius = 0.2\n'
    Path("yard.toml").write_text(yard.format(0.5))
    given = ["--goal", "1.5", "0", "0", "--speed", "0.7", "--margin", "0.07", "--avoid", avoid, "--compare", "none"]
    assert cli.main(["navigate", "yard.toml", *given, "--seed", "3", "--sensing.tier", "lab", "--out", "drive"]) == 0
    lines = capsys.readouterr().out.splitlines()[1:5]
    titles, _, *rows = ([cell.strip() for cell in line.split("|")] for line in lines)
    assert [row[titles.index("position error, mm")] == "–" for row in rows] == [avoid != "none"] * 2
    Path("yard.toml").write_text(yard.format(0.8))
    saved, driven = mrctl.open("drive/result.zarr"), again("drive")
    for name in ("x", "v", "omega_command", "voltage_left", "clearance", "weights"):
        assert driven.result[name].values.tobytes() == saved[name].values.tobytes()


@pytest.mark.usefixtures("no_figures")
@pytest.mark.parametrize("avoid", ["none", "window"])
def test_own_controller(avoid: Avoid, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """A user's controller drives the first robot alone; what is saved needs it again.

    The robot drives as in `simulate`, and the one beside it as in a mission without it.
    """
    own, out = tmp_path / "own.py", tmp_path / "out"
    own.write_text(OWN)
    given, name = ["navigate", "doorway:3", "--avoid", avoid], f"model+{own}:Half"
    assert cli.main([*given, "--controller", name, "--compare", "model", "fel", "--out", str(out)]) == 0
    printed, result = capsys.readouterr().out, mrctl.open(out / "result.zarr")
    beside = "" if avoid == "none" else "+window"
    assert result["label"].values.tolist() == [label + beside for label in ("model+Half", "model", "fel")]
    assert f"| model+Half{beside} " in printed and "| arrived |" in printed
    robot = Scenario(prior="model", learner="none")
    task = task_of("doorway:3", robot)
    whole, (_, scenario) = navigate(task, robot, ["fel"], avoid=avoid), prepared(task, robot, avoid=avoid)
    namespace = {}
    exec(OWN, namespace)  # noqa: S102
    single = mrctl.simulate(scenario, motion=avoiding(avoid), feedforward=namespace["Half"])
    for signal in ("x", "y", "voltage_left"):
        ours = result[signal].dropna("time", how="all").values
        assert np.array_equal(ours[1:, : whole.result.sizes["time"]], whole.result[signal].values, equal_nan=True)
        alone = single[signal].dropna("time").values
        assert np.array_equal(ours[0, : len(alone)], alone) and np.isnan(ours[0, len(alone) :]).all()
        assert not np.array_equal(ours[0, :100], ours[1, :100])
    assert read_arrays(out / "learned.safetensors", "learned", {"half": (1,)})["half"] == 0.5
    assert cli.main(["navigate", str(out), "--controller", name]) == 0
    assert f"{out}: bit-identical" in capsys.readouterr().out
    assert not departure(again(out, feedforward=namespace["Half"]).result, result)
    for other in ([], ["--controller", f"{own}:Half"], ["--controller", f"model+{own}:Other"]):
        needs = f"mrctl: controller: {out} needs --controller {name}, as when it was saved"
        assert refused(capsys, "navigate", str(out), *other) == needs
    with pytest.raises(InputError, match=r"^controller: the run in .* needs --controller with feedforward=Half, as"):
        again(out)
    own.write_text(OWN.replace("0.5 * command", "0.4 * command"))
    assert cli.main(["navigate", str(out), "--controller", name]) == 1
    assert f"; the code of {name} has changed since" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--controller", "a.py:X", "b.py:Y"], "controller: a mission has one of yours; --suite compares several"),
        (
            ["--controller", "a.py:X", "--prior", "model"],
            "controller: leave --prior and --learner out, and write",
        ),
        (
            ["--learner", "rls", "--controller", "feedback=a.py:X"],
            "controller: leave --prior and --learner out, and write rls+feedback=a.py:X",
        ),
        (
            ["--controller", "model+composit+feedback=a.py:X"],
            "controller: composit is no feedforward of mrctl;",
        ),
        (
            ["--controller", "model+composite+a.py:X"],
            "controller: 'model+composite+a.py:X' has two feedforwards;",
        ),
        (
            ["--controller", "model+composite"],
            "controller: model+composite is one of mrctl; give its",
        ),
        (["--controller"], "controller: needs a value; see mrctl navigate --help"),
        (["--controller", "a.py:X", "--view"], "controller: a live session drives with those of mrctl; with your own,"),
        (["--controller", "a.py:X"], "controller: no file a.py in "),
        (["--controller", "motion=own.py:Half", "--avoid", "mppi"], "motion: your own motion controller cannot drive"),
        (["--controller", "own.py:Broken"], "feedforward Broken: ZeroDivisionError: division by zero (own.py, line "),
    ],
)
def test_own_controller_is_refused(
    arguments: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    """A controller that cannot drive a mission is refused in one line."""
    monkeypatch.chdir(tmp_path)
    Path("own.py").write_text(OWN)
    assert refused(capsys, "navigate", "doorway:3", *arguments).startswith(f"mrctl: {message}")


@pytest.mark.usefixtures("no_figures")
def test_changed_mission(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """A saved mission that was changed departs, one that lacks a part is refused, and it takes no further flags."""
    out = tmp_path / "drive"
    assert cli.main(["navigate", "doorway:3", "--learner", "none", "--out", str(out)]) == 0
    capsys.readouterr()
    assert "speed: " in refused(capsys, "navigate", str(out), "--speed", "0.5")
    file = out / "mission.json"
    values = json.loads(file.read_text())
    file.write_text(json.dumps(values | {"speed": 0.5}))
    assert cli.main(["navigate", str(out)]) == 1
    assert "departs in " in capsys.readouterr().err
    for broken in ({k: v for k, v in values.items() if k != "task"}, values | {"avoid": "luck"}, [1]):
        file.write_text(json.dumps(broken))
        assert str(file) in refused(capsys, "navigate", str(out))
    for text in ("{", "[" * 100_000):
        file.write_text(text)
        assert "is not JSON" in refused(capsys, "navigate", str(out))
    file.unlink()
    assert "holds no mission" in refused(capsys, "navigate", str(out))


def test_outcomes() -> None:
    """A box that moves into the way, of which the plan does not know, is hit; with a weak battery time runs out."""
    still = Disc(x=1.5, y=1.0, radius=0.2)
    course = mrctl.Line(heading=np.pi / 2, speed=0.2)
    mover = Box(x=-0.4, y=-1.0, length=0.2, width=0.2, course=course)  # from (1, −0.4) along +y
    task = Task(obstacles=Obstacles(shapes=(still, mover)), start=(0.0, 0.0, 0.0), goal=(3.0, 0.0, 0.0))
    mission = navigate(task, PID)
    hit = mission.table.iloc[0]
    assert hit["outcome"] == "collided" and hit["spl"] == 0 and hit["length"] < 1.5 and hit["clearance"] == 0
    assert hit["time"] == float(mission.result["failure_time"].item()) and mission.result["clearance"].min() < 0.01
    free = task.replace(obstacles=Obstacles(shapes=(still,)))
    late = navigate(free, PID.replace(perturbation={"supply_factor": 0.2}))
    assert late.table["outcome"].tolist() == ["out of time"] and late.table["spl"].tolist() == [0]
    assert late.table["time"].iloc[0] == pytest.approx(late.result.sizes["time"] * 0.01, abs=0.02)


def test_failure_in_the_first_tick() -> None:
    """A robot whose stage fails at once has an outcome that says so, although there is no sample of its drive."""

    class Bad:
        def __init__(self, robot: object, size: int) -> None: ...

        def reset(self, *_: object) -> None: ...

        def output(self, *_: object) -> None:
            raise ValueError("no twist")

    task = Task(obstacles=Obstacles(shapes=(Disc(x=0.0, y=-3.0),)), start=(0.0, 0.0, 0.0), goal=(2.0, 0.0, 0.0))
    plan, drive = prepared(task, Scenario(prior="model", learner="none"))
    (row,) = outcomes(mrctl.simulate(drive, motion=Bad), task.goal, plan).itertuples()
    assert "no twist" in row.outcome and row.length == row.spl == row.energy == 0 and np.isnan(row.position_rmse)


def test_collision_in_the_first_tick() -> None:
    """A robot that something drives into at once has collided, and there is a result of it."""
    course = mrctl.Line(heading=np.pi, speed=1.4)
    mover = Disc(x=-0.55, radius=0.1, course=course)  # from (0.55, 0) towards the robot, whose nose is at 0.44 m
    task = Task(obstacles=Obstacles(shapes=(mover,)), start=(0.0, 0.0, 0.0), goal=(2.0, 0.0, 0.0))
    mission = navigate(task, Scenario(prior="model", learner="none"))
    assert mission.table["outcome"].tolist() == ["collided"] and mission.table["length"].tolist() == [0.0]
    assert mission.result.sizes["time"] == 1 and not np.isfinite(mission.result["x"]).any()


def test_ends() -> None:
    """A run ends where the robot rests at its goal, or is stuck; alone it has the bits that it has beside others."""
    line = mrctl.Waypoints(points=((0, 0), (1, 0), (2, 0)), closed=False, timing="limits", speed=0.8)
    own = Scenario(reference=line, laps=8, goal=(2.0, 0.0, 0.0), learner="composite", prior="model")
    cases = [
        own,
        own.replace(seed=1, perturbation="all"),
        own.replace(goal=(1.0, 0.0, 0.0)),  # where it does not rest
        own.replace(perturbation={"supply_factor": 0.05, "drive_friction_factor": 20}),
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
        (["yard.toml", "--goal", "900", "900", "0"], "map: "),
        (["yard.toml", "--goal", "10000", "9", "0"], "goal: x and y must be between ±1,000 m"),
        (["yard.toml", "--goal", "nan", "0", "0"], "goal"),
        (["yard.toml", "--goal", "3", "0", "0", "--speed", "0"], "speed"),
        (["yard.toml", "--goal", "3", "0", "0", "--margin", "-1"], "margin"),
        (["none.toml", "--goal", "3", "0", "0"], "none.toml"),
        (["none.yaml", "--goal", "3", "0", "0"], "none.yaml"),
        (["doorway:3", "--goal", "9", "0", "0"], "goal: there is no way to (9.00, 0.00)"),
        (
            ["parking_bay:1", "--avoid", "mppi", "--robot", "turtlebot"],
            "avoid: mppi never plans in reverse, and forward there is no way; barrier may",
        ),
        (["yard.toml", "--goal", "3,0"], "goal: 3,0 is not x, y and θ in m, m, rad, as in --goal 2,0,0"),
        (["yard.toml", "--goal=3,0,left"], "goal: 3,0,left is not x, y and θ"),
        (["yard.toml", "--goal", "3,0,0", "--start=nan,0,0"], "start: nan,0,0 is not x, y and θ"),
        (["yard.toml", "--goal", "3,0,0", "--robot", "tram"], "tram"),
        (["doorway:3", "--robot"], "robot: needs a value"),
        (["doorway:3", "--localise", "stars"], "sensing.localisation"),
        (["doorway:3", "--localise", "--json"], "localise: needs a value"),
        (["doorway:x"], "the seed must be a whole number"),
        (["maze:3"], "maze:3 is neither a file"),
        (["doorway:3", "--map", "none.toml"], "map: no file none.toml"),
        (["doorway:3", "--map", "plan.png"], "map: plan.png is not a file that ends in .toml, "),
        (["doorway:3", "--map", "moves.toml"], "map: an obstacle on it has a course"),
        (["doorway:3", "--perturbation.control-delay", "0.013"], "control_delay"),
    ],
)
def test_bad_input_is_one_line(
    arguments: list[str], says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    """Every kind of bad mission ends with one line, before anything runs."""
    monkeypatch.chdir(tmp_path)
    Path("yard.toml").write_text('[[shapes]]\nkind = "disc"\nx = 1.5\ny = 0.8\nradius = 0.2\n')
    Path("moves.toml").write_text('[[shapes]]\nkind = "disc"\ncourse = { kind = "circle", radius = 1.0 }\n')
    assert says in refused(capsys, "navigate", *arguments)


def test_bad_arguments() -> None:
    """What is no task, and a feedforward or an avoider that there is not, is refused by name."""
    task = task_of("doorway:3", Scenario())
    for given, compare, message in (("doorway:3", (), "^task: must be"), (task, "model", "^compare: 'm'")):
        with pytest.raises(mrctl.InputError, match=message):
            navigate(given, Scenario(), compare)
    with pytest.raises(mrctl.InputError, match="^avoid: 'windw' is none of none, barrier, window, mppi"):
        navigate(task, Scenario(), avoid="windw")  # type: ignore[arg-type]
    with pytest.raises(mrctl.InputError, match="^avoid: 'windw'"):  # which is the stage of a batch or a sweep
        avoiding("windw")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("robot", "world"),
    [
        ("car", "cellular:200000"),  # where the nearest twists and the time of the plan had led the robot to a dead end
        ("racecar", "corridor:200001"),
        *(pytest.param("car", f"corridor:{seed}", marks=pytest.mark.full) for seed in (200011, 200036, 200041)),
    ],
)
def test_barrier_arrives(robot: str, world: str) -> None:
    """Among obstacles that the plan passes by, the filter slows the robot, and does not lead it off its plan."""
    scenario = Scenario.from_dict({"prior": "model", "learner": "none", "robot": {"path": robot}})
    driven, free = (
        navigate(task_of(world, scenario), scenario, avoid=avoid).table.to_dict("records")[0]
        for avoid in ("barrier", "none")
    )
    assert driven["outcome"] == free["outcome"] == "arrived" and driven["clearance"] > 0.03
    assert 1.05 * free["time"] < driven["time"] < 2 * free["time"] and driven["spl"] > 0.98


def test_barrier_waits() -> None:
    """Discs that cross are hit without the filter, and waited for with it."""
    shapes = [Disc(x=1.0, y=2.0, radius=0.1)]
    for x, y, speed in ((1.8, 1.1, 0.5), (2.8, -1.6, 0.4)):  # across the straight plan
        heading = -np.sign(y) * np.pi / 2
        course = mrctl.Line(heading=heading, speed=speed, length=9.0)
        shapes.append(Disc(x=-abs(y), y=x * np.sign(y), radius=0.15, course=course))
    task = Task(obstacles=Obstacles(shapes=tuple(shapes)), start=(0.0, 0.0, 0.0), goal=(4.0, 0.0, 0.0))
    scenario = PID.replace(prior="model")
    assert navigate(task, scenario).table["outcome"].tolist() == ["collided"]
    table = navigate(task, scenario, avoid="barrier").table
    assert table["outcome"].tolist() == ["arrived"] and table["clearance"].iloc[0] > 0.02


def test_motors_too_weak_for_the_plan() -> None:
    """A TurtleBot whose motors saturate leaves a plan that does not wait for it, and arrives along one that does.

    Where each voltage was cut by itself, it hardly turned: with `barrier` it was stuck, and with `window` out of time.
    """
    weak = Scenario.from_dict({"robot": "turtlebot", "learner": "none", "perturbation": "all"})
    task = task_of("doorway:3", weak)
    assert navigate(task, weak).table["outcome"].tolist() == ["collided"]
    for avoid in ("barrier", "window", "mppi"):
        driven = navigate(task, weak, avoid=avoid)
        (row,) = driven.table.to_dict("records")
        assert row["outcome"] == "arrived" and row["spl"] > 0.85
        assert driven.result["saturated"].mean() > 0.3
        if avoid == "barrier":  # its plan waits: with a clock that does not, it ran past the goal by 0.2 m
            (x, y, theta), run = task.goal, driven.result.isel(run=0)
            past = (run["x"] - x) * np.cos(theta) + (run["y"] - y) * np.sin(theta)
            assert float(past[run.sizes["time"] // 2 :].max()) < 0.08


@pytest.mark.parametrize("tier", ["ideal", "field"])
def test_idle_barrier(tier: str) -> None:
    """Where nothing is near the filter does not change a bit, whatever the delay of the sensors."""
    shapes = (Disc(x=1.0, y=9.0), Disc(x=9.0, y=9.0, course=mrctl.Line(speed=0.1)))
    task = Task(obstacles=Obstacles(shapes=shapes), start=(0.0, 0.0, 0.0), goal=(3.0, 0.5, 0.2))
    own = PID.replace(sensing={"tier": tier})
    free, filtered = (navigate(task, own, avoid=avoid).result for avoid in ("none", "barrier"))
    ticks = min(free.sizes["time"], filtered.sizes["time"])
    for name in ("x", "v", "omega_command", "voltage_left"):
        np.testing.assert_array_equal(filtered[name][0, :ticks], free[name][0, :ticks], name)


def test_short_flags(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    """The command as the issue writes it asks for the same mission as the long flags do."""
    monkeypatch.chdir(tmp_path)
    Path("yard.toml").write_text('[[shapes]]\nkind = "disc"\nx = 0.6\ny = 0.8\nradius = 0.2\n')
    short = ["--goal", "1,-0.1,0", "--start=-0.2,0,0", "--robot", "turtlebot", "--localise=particles"]
    long = ["--goal", "1", "-0.1", "0", "--start", "-0.2", "0", "0", "--robot.path", "turtlebot"]
    found = []
    for flags in (short, [*long, "--sensing.localisation", "particles"]):
        assert cli.main(["navigate", "yard.toml", *flags, "--learner", "fel", "--json"]) == 0
        found.append(json.loads(capsys.readouterr().out))
        found[-1]["robots"][0].pop("planning_time")
    assert found[0] == found[1] and found[0]["scenario"]["robot"]["path"] == "turtlebot"
    assert found[0]["task"]["goal"] == [1.0, -0.1, 0.0] and found[0]["robots"][0]["outcome"] == "arrived"


@pytest.mark.usefixtures("no_figures")
def test_map_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    """With a map that lacks a box the plan goes through it; the mission keeps the map, and is repeated with it."""
    monkeypatch.chdir(tmp_path)
    wall = '[[shapes]]\nkind = "box"\nx = 1.5\ny = 1.2\nlength = 3.0\nwidth = 0.2\n'
    Path("map.toml").write_text(wall)
    Path("world.toml").write_text(wall + '[[shapes]]\nkind = "box"\nx = 2.0\nlength = 0.2\nwidth = 0.4\n')
    flags = "navigate", "world.toml", "--goal", "3,0,0", "--map", "map.toml"
    assert cli.main([*flags, "--json", "--out", "hit"]) == 1
    assert cli.main(["navigate", "hit", "--json"]) == 1 and "did not arrive: collided" in capsys.readouterr().err
    blind = json.loads(Path("hit/mission.json").read_text())
    assert blind["robots"][0]["outcome"] == "collided" and len(blind["task"]["map"]["shapes"]) == 1
    assert cli.main([*flags, "--avoid", "window", "--out", "driven"]) == 0
    Path("map.toml").unlink()
    assert cli.main(["navigate", "driven"]) == 0 and "driven: bit-identical" in capsys.readouterr().out
    assert order_of("driven").task.known == Obstacles.from_dict({"shapes": blind["task"]["map"]["shapes"]})


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
    result = mrctl.simulate(scenario, motion=lambda robot, size: Avoiding(robot, size, Blind, barrier))
    assert result["failure"] == "" and 0.02 < float(result["clearance"].min()) < 0.3
    early = result["clearance"] > 1.0
    assert np.array_equal(result["v_command"].where(early, drop=True), hit["v_command"][: int(early.sum())])


@pytest.mark.parametrize("avoid", ["none", "barrier"])
def test_event_changes_gains(avoid: Avoid) -> None:
    """An event with gains of Kanayama's law acts with `barrier` as with none: from the start on, as in the scenario."""
    task, gains = Task(obstacles=Obstacles(), start=(0, 0, 0), goal=(2, 0.5, 0)), Kanayama(k_x=0.5, k_y=3.0)
    found = [
        navigate(task, scenario, avoid=avoid).result
        for scenario in (
            PID,
            PID.replace(kanayama=gains),
            PID.replace(events=(Event(time=0.0, kanayama=gains),)),
            PID.replace(events=(Event(time=1.0, kanayama=gains),)),
        )
    ]
    x = [run["x"].values[0] for run in found]
    assert np.array_equal(x[1], x[2]) and not np.array_equal(x[0], x[1])
    assert np.array_equal(x[0][:100], x[3][:100]) and not np.array_equal(x[0][:200], x[3][:200])


@pytest.mark.parametrize("avoid", ["window", "mppi"])
def test_event_with_gains_is_refused(avoid: Avoid) -> None:
    """Motion controllers without gains of Kanayama's law refuse an event that changes them, also during the run."""
    task, event = Task(obstacles=Obstacles(), start=(0, 0, 0), goal=(2, 0.5, 0)), Event(time=1.0, kanayama=Kanayama())
    message = f"^events: kanayama at .* s: the motion controller {avoid} does not take gains in an event$"
    with pytest.raises(InputError, match=message):
        navigate(task, PID.replace(events=(event,)), avoid=avoid)
    running = Simulation([prepared(task, PID, avoid=avoid)[1]], motion=avoiding(avoid))
    with pytest.raises(InputError, match=message):
        running.add(event)
    assert running.scenarios[0].events == ()
