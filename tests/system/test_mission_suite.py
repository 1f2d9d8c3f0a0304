"""The comparison of velocity controllers in corridors: the width that a run needs, and the command."""

import json
import re
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from scipy.signal import lsim
from test_commands import refused

import mrctl.experiments.journal as journal
import mrctl.experiments.learned_limits as feeding
import mrctl.experiments.mission_suite as suite
import mrctl.experiments.reactive_corridors as reactive
import mrctl.experiments.three_mppis as three
import mrctl.navigation.mppi as mppi
from mrctl import Lemniscate, Perturbation, Scenario, cli, simulate
from mrctl.experiments.cases import Choice
from mrctl.experiments.navigation_suite import PARTS
from mrctl.navigation.generators import bent_line, corridor, corridor_width
from mrctl.navigation.vehicle import Vehicle
from mrctl.physics import mjcf
from mrctl.physics.hull import footprint
from mrctl.record import InputError
from mrctl.sweep.pool import JobOutcome, Work
from mrctl.theory.clearance import clearance, clearances
from mrctl.theory.obstacles import Obstacles, Surroundings
from mrctl.theory.timing import Limits

HULL = footprint(mjcf.load())
PID = suite.Contender("none", Choice())
ZERO = """
import numpy as np

class Zero:
    def __init__(self, robot, size): ...
    def output(self, command, derivative): return np.zeros_like(command)
    def learn(self, feedback, frozen, twist, voltage): ...
"""
MOVES = """
import numpy as np

class Stay:
    def __init__(self, robot, size): ...
    def reset(self, pose, reference, period): ...
    def output(self, pose, twist, reference): return np.zeros((len(pose), 2))
"""


class Here:
    """A pool that computes in this process, where what a test has changed is changed."""

    tries = 1

    def __init__(self, work: Work, path: str, _: int) -> None:
        """Takes the arguments of `Processes`."""
        self._work, self._path = work, path

    def room(self) -> int:
        """Returns the number of jobs that are computed at a time."""
        return 1

    def submit(self, job: int) -> None:
        """Computes a job."""
        self._outcome = self._work(self._path, job)

    def wait(self) -> list[JobOutcome]:
        """Returns how it ended."""
        return [self._outcome]

    def close(self) -> None:
        """Has nothing to stop."""


def test_corridor_width() -> None:
    """A robot at random poses touches the walls of a narrower corridor, and not those of a wider one.

    So it is where the corridor is 5 cm beside the middle line, with walls of a wider and a narrower one.
    """
    random = np.random.default_rng(0)
    for seed in range(100):
        shape = {"pieces": int(random.integers(1, 4)), "length": 2.0, "turn": 0.9}
        ends = bent_line(seed, **shape)[1]
        places = np.interp(random.uniform(0.3, 0.9, 5), np.linspace(0, 1, len(ends)), ends)
        poses = np.column_stack([places.real, places.imag, np.zeros(5)]) + random.uniform(-0.3, 0.3, (5, 3))
        width = corridor_width(HULL, poses, seed, **shape)
        for wider in (1e-6, -1e-6):
            walls = Surroundings(corridor(width + wider, seed, **shape).obstacles)
            assert (clearances(HULL, poses, np.zeros(5), walls).min() > 0) == (wider > 0)
            aside = 0.05
            moved = corridor_width(HULL, poses, seed, **shape, aside=aside) + wider
            left, right = (corridor(moved + side * 2 * aside, seed, **shape).obstacles.shapes for side in (1, -1))
            walls = Surroundings(Obstacles(shapes=(*left[shape["pieces"] :], *right[: shape["pieces"]])))
            assert (clearances(HULL, poses, np.zeros(5), walls).min() > 0) == (wider > 0)


def test_width_of_a_run() -> None:
    """In physics a run without walls touches those of a corridor that is 4 mm narrower than it needs, and no others."""
    draw = suite.draw(Vehicle.of(Scenario()), 1, 1.5 * float(np.ptp(HULL[:, 1])), [1.35])
    assert draw is not None
    own = Scenario(reference=draw.references[0], goal=draw.goal, laps=2, learner="none", initial_spread=(0, 0, 0))
    free = simulate(own)
    poses = np.stack([free[name].dropna("time").values for name in ("x", "y", "theta")], -1)
    width = corridor_width(HULL, poses, draw.seed, **suite.SHAPE)
    for wider, failure in ((0.004, ""), (-0.004, "collision")):
        walls = corridor(width + wider, draw.seed, **suite.SHAPE).obstacles
        assert simulate(own.replace(obstacles=walls))["failure"] == failure


def test_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    """The tables say what the numbers beside them say."""
    monkeypatch.setattr(suite, "DRAWS", {"quick": 3})
    monkeypatch.setattr(suite, "SPEEDS", (0.6, 0.9))
    for part in (suite, reactive, three):
        monkeypatch.setattr(part, "PLANTS", {"nominal": suite.PLANTS["nominal"]})
    monkeypatch.setattr(suite, "CONTROLLERS", ("none", "model"))
    monkeypatch.setattr(three, "WORLDS", {"quick": 1})
    for part in (reactive, feeding):
        monkeypatch.setattr(part, "DRAWS", {"quick": 1})
    monkeypatch.setattr(feeding, "PLANTS", {"all": suite.PERTURBATIONS["all"]})
    monkeypatch.setattr(mppi, "SAMPLES", 200)
    monkeypatch.setattr(journal, "Processes", Here)
    assert cli.main(["navigate", "--suite", "--quick", "--out", str(tmp_path)]) == 0
    printed, values = capsys.readouterr().out, json.loads((tmp_path / "table.json").read_text())
    assert printed.startswith("18 runs, about 1 min") and (tmp_path / "table.md").read_text() in printed
    needed = np.array(values["needed"], float)
    assert needed.shape == (2, 2, 1, 3) and np.all(needed > np.ptp(HULL[:, 1]))
    assert np.abs(needed - values["plans"]).max() < 0.1
    assert f"{1e3 * needed[-1, 0, 0].max():.1f} [" in printed and "| 3/3 [44, 100] %" in printed
    values = json.loads((tmp_path / "reactive.json").read_text())
    assert "\n6 runs with the dynamic window, about 1 min" in printed
    assert (tmp_path / "reactive.md").read_text() in printed
    needed = np.array(values["widths"], float)
    assert needed.shape == (2, 1, 1)
    assert set(needed.ravel()) <= {values["robot_width"] + room for room in reactive.ROOMS}
    assert f"| {1e3 * needed[0, 0, 0]:.1f} [" in printed
    values = json.loads((tmp_path / "mppi.json").read_text())
    assert "\n3 runs with MPPI, about 1 min" in printed and (tmp_path / "mppi.md").read_text() in printed
    assert list(values["runs"]) == list(three.ENTRIES) and 0.005 < values["lag"] < 0.1
    for name, of in values["runs"].items():
        (run,) = of["nominal"]
        assert run["outcome"] == "arrived" and 0 < run["clearance"] and abs(run["lateness"]) < 3
        assert re.search(
            rf"{re.escape(name)} +\| 1/1 \[21, 100\] % \| 0/1 .* {run['lateness']:.2f} \[–, ∞\] +\|", printed
        )
    first, second, _ = (of["nominal"][0] for of in values["runs"].values())
    assert first != second  # they differ in the lag alone
    assert (
        "\n3 runs with nominal and with learned limits, about 1 min" in printed
        and (tmp_path / "limits.md").read_text() in printed
    )
    (before,), (after,) = json.loads((tmp_path / "limits.json").read_text())["limits"]["all"].values()
    assert before["arrived"] and after["arrived"] and before["plan"] < after["plan"] < 1.1 * before["plan"]
    assert after["error"] < before["error"]
    # Stopped half-way, it goes on where it was; with everything driven, it drives nothing.
    first = {f"{part.files}.json": (tmp_path / f"{part.files}.json").read_bytes() for part in PARTS}
    for name, lines in (("table.jsonl", 3), ("reactive.jsonl", 2), ("mppi.jsonl", 2), ("limits.jsonl", 1)):
        kept = (tmp_path / name).read_text().splitlines(keepends=True)
        (tmp_path / name).write_text("".join(kept[:lines]) + kept[lines][:30])
    assert cli.main(["navigate", "--suite", "--quick", "--out", str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    assert printed.startswith("12 runs, about") and "\n2 runs with MPPI" in printed
    assert "\n3 runs with the dynamic window" in printed and "\n3 runs with nominal" in printed
    assert {name: (tmp_path / name).read_bytes() for name in first} == first
    # A controller of the user joins in the same folder: only its runs are driven, and again after an edit of its file.
    # One that adds nothing needs what PID alone needs. Where the window is the motion controller, none joins.
    own, moves = tmp_path / "zero.py", tmp_path / "moves.py"
    own.write_text(ZERO)
    moves.write_text(MOVES)
    joined = ["navigate", "--suite", "--quick", "--out", str(tmp_path), "--controller", f"{own}:Zero"]
    assert cli.main([*joined, f"model+motion={moves}:Stay"]) == 0
    printed = capsys.readouterr().out
    assert printed.startswith("18 runs, about") and "\n3 runs with the dynamic window" in printed
    assert "\n0 runs with MPPI" in printed and "\n0 runs with nominal" in printed
    values = json.loads((tmp_path / "table.json").read_text())
    assert values["controllers"] == ["none", "model", "Zero", "model+Stay"]
    needed = np.array(values["needed"], float)
    assert np.array_equal(needed[:, 2], needed[:, 0]) and np.isnan(needed[:, 3]).all()  # null: infinite
    assert re.search(r"\| nominal +\| model\+Stay +\| 0/3 ", printed) and "| nominal | Zero" in printed
    values = json.loads((tmp_path / "reactive.json").read_text())
    assert values["controllers"] == ["none", "model", "Zero"] and values["widths"][2] == values["widths"][0]
    own.write_text(ZERO + "# edited\n")
    assert cli.main(joined) == 0
    assert capsys.readouterr().out.startswith("9 runs, about")
    assert cli.main(["navigate", "--suite", "--quick", "--out", str(tmp_path)]) == 0
    assert {name: (tmp_path / name).read_bytes() for name in first} == first
    for part in (suite, reactive, three, feeding):
        monkeypatch.setattr(part, "simulate", None)
    assert cli.main(["navigate", "--suite", "--quick", "--out", str(tmp_path)]) == 0
    assert {name: (tmp_path / name).read_bytes() for name in first} == first
    capsys.readouterr()
    assert "other results (scenario differs)" in refused(
        capsys, "navigate", "--suite", "--quick", "--robot.path", "turtlebot", "--out", str(tmp_path)
    )


def test_width_by_bisection(monkeypatch: pytest.MonkeyPatch) -> None:
    """The width of a draw is the least at which it passes, of all that are tried, or infinite."""
    one, tried = reactive.Draw(0, Scenario(), 0.4), []
    for least in (0.0, *reactive.ROOMS, 1.0):

        def passes(_: object, width: float, *__: object, least: float = least) -> bool:
            tried[-1] += 1
            return width > 0.4 + least - 1e-9

        tried.append(0)
        monkeypatch.setattr(reactive, "passes", passes)
        (found,) = reactive._driven([one], PID, Perturbation())
        assert found == min((0.4 + room for room in reactive.ROOMS if room >= least), default=np.inf)
    assert set(tried) == {reactive.TRIES}


def test_changed_controller(tmp_path: Path) -> None:
    """A worker refuses a controller whose file was edited since the suite began."""
    own = tmp_path / "zero.py"
    own.write_text(ZERO)
    *_, one = suite.contenders(Scenario(), [f"model+{own}:Zero"])
    assert one.name == "model+Zero" and one.choice.pair == {"prior": "model", "learner": "none"}
    assert list(one.stages()) == ["feedforward"]
    own.write_text(ZERO + "# edited\n")
    with pytest.raises(InputError, match=r"^controller: .*zero\.py:Zero.* is not as it was when the suite began$"):
        one.stages()


def test_critical_cell() -> None:
    """Of 80 draws of which 60 need 0.57 m and 20 need 0.6, 95 % pass at 0.6 m, and at some width above 0.57."""
    needed = 0.42 + np.repeat(reactive.ROOMS[3:5], (60, 20))
    assert reactive.critical_cell(0.42, needed) == "600.0 [570.0, 600.0]"
    assert reactive.critical_cell(0.42, np.full(80, np.inf)) == "∞ [720.0, ∞]"


def test_narrow_corridor_in_reactive_mode() -> None:
    """A robot passes a corridor that is 30 cm wider than itself, and none that is narrower than itself."""
    one = reactive.draw(Scenario(), 0)
    assert one is not None and one.width == pytest.approx(np.ptp(HULL[:, 1]))
    assert reactive.passes(one, one.width + 0.3, {"learner": "none"}, {})
    assert not reactive.passes(one, one.width + 0.005, {"learner": "none"}, {})


def test_ties_of_critical_speeds() -> None:
    """The tie of widths is none of speeds: also one that is 0.5 mm/s larger is larger."""
    size = len(suite.CONTROLLERS), len(suite.PLANTS), 10
    needed = np.zeros((2, *size))
    needed[1] = 1.0
    needed[1, suite.CONTROLLERS.index("fel")] = 0.0  # it alone passes at the larger speed too
    found = suite.Found(needed, *(np.zeros(size) for _ in range(3)), np.zeros(10), [0.5, 0.5005], 0, suite.CONTROLLERS)
    listed = ", ".join(f"`fel` ({plant})" for plant in suite.PLANTS)
    says = suite.critical_speeds(found, "car").says
    assert f"better than `PID` are {listed}; better than `model` are {listed}." in says
    found = found._replace(needed=needed[::-1] * 5e-4)
    assert "none differs from `PID`; none differs from `model`." in suite.critical_widths(found, "car").says


def test_budget_of_none() -> None:
    """Who arrives in fewer than 95 % of the draws has no budget; where nobody has one, the sentence says so."""
    size = len(suite.CONTROLLERS), len(suite.PLANTS), 20
    needed = np.where(np.arange(20) < 2, np.inf, 0.6) * np.ones(size)
    found = suite.Found(needed[None], *(needed for _ in range(3)), np.full(20, 0.5), [0.5], 0, suite.CONTROLLERS)
    says = suite.budget(found, "car").says
    assert says == "On the nominal plant no controller has a finite allowance with each of these maps and estimates."
    rest = needed[..., 2:]
    found = suite.Found(rest[None], *(rest for _ in range(3)), np.full(18, 0.5), [0.5], 0, suite.CONTROLLERS)
    assert "third: `PID` 0.0, 0.0, 0.0; `model`" in suite.budget(found, "car").says


def test_words_of_three_mppis() -> None:
    """What is said of the third is in words that tell who is earlier, and the page of results has the same words."""
    lateness = dict(zip(three.ENTRIES, (1.0, 0.5, 0.3), strict=True))

    def late(by: float) -> list[three.Run]:
        return [three.Run("arrived", by + 0.01 * k, 0.1) for k in range(8)]

    runs = {name: dict.fromkeys(three.PLANTS, late(by)) for name, by in lateness.items()}
    (table,) = three.tables(three.Found(0.03, runs), "car")
    words = "faster (nominal: arrives first in 1.00 [0.63, 1.00] of the pairs; mean difference -0.20"
    assert f"against the second: {words}" in table.says
    number = r"-?\d+(\.\d+)?"
    form = re.sub(r"\d+ ms", "N ms", re.sub(rf"{number} \[{number}, {number}\]", "I", table.says))
    form = re.sub(rf"mean difference {number} s", "mean difference I s", form).replace("faster", "WORD")
    # Who does not arrive is last: with four of eight lost the median is the slowest of those that arrive.
    lost = [run._replace(lateness=np.inf) if k < 4 else run for k, run in enumerate(runs[three.THIRD]["all"])]
    (cells,) = three.tables(three.Found(0.03, runs | {three.THIRD: runs[three.THIRD] | {"all": lost}}), "car")
    cells = cells.cells.set_index(["plant", "MPPI"])["later than the plan, s"]
    assert cells["nominal", three.THIRD] == "0.33 [0.30, 0.37]" and cells["all", three.THIRD] == "0.37 [0.34, ∞]"
    page = (Path(three.__file__).parent / "RESULTS.md").read_text()
    says = [line for line in page.splitlines() if line.startswith("The lag that fits PID")]
    for line in says:
        line = re.sub(r"\d+ ms", "N ms", re.sub(rf"{number} \[{number}, {number}\]", "I", line))
        assert re.sub("(faster|slower|level)(?= \\()", "WORD", line) == form
    assert len(says) == 3


def test_learned_limits() -> None:
    """What is learned on a robot that is half as heavy again and has a weak supply is what its equations say."""
    wrong = Perturbation(mass_factor=1.5, supply_factor=0.8)
    course = Lemniscate(size=1.2, period=9.0)
    run = simulate(Scenario(prior="model", learner="composite", perturbation=wrong, reference=course, laps=3))
    nominal = Vehicle.of(Scenario()).robot
    heavy = nominal.replace(mass=1.5 * nominal.mass, drive_gain=0.8)
    found = feeding.limits_of(run, nominal)
    learned, known, true = (
        np.array(x)[[0, 2], 0] for x in (found.inverse, Limits.of(nominal).inverse, Limits.of(heavy).inverse)
    )
    assert found.replace(inverse=()) == Limits.of(nominal).replace(inverse=())
    np.testing.assert_allclose(learned, true, rtol=0.05)  # of V and V̇
    assert np.abs(known / true - 1).min() > 0.15


def test_failure_in_the_first_tick(monkeypatch: pytest.MonkeyPatch) -> None:
    """A robot that fails at once has not arrived, and its error is infinite, although there is no sample of it."""

    class Bad:
        def __init__(self, robot: object, size: int) -> None: ...

        def reset(self, *_: object) -> None: ...

        def output(self, *_: object) -> None:
            raise ValueError

    monkeypatch.setattr(feeding, "simulate", partial(simulate, motion=Bad))
    draw = feeding.draw(Vehicle.of(Scenario()), 1.5 * float(np.ptp(HULL[:, 1])), 1.35, 1)
    assert draw is not None
    (run,) = feeding._driven(Scenario(learner="none"), [draw], [draw.reference], [None])
    assert not run.arrived and run.error == np.inf


def test_worlds() -> None:
    """The discs cross the middle line where and about when a robot is there, and the plan does not know them."""
    base = Scenario()
    worlds = [three.world(base, seed) for seed in (0, 1)]
    assert all(worlds)
    for one in worlds:
        own, goal = one.scenario.obstacles, one.scenario.goal
        still = tuple(shape for shape in own.shapes if shape.course is None)
        assert goal is not None and goal[0] == pytest.approx(6.0)
        times = np.linspace(0, 10, 2001)
        around = Surroundings(Obstacles(shapes=own.moving))
        places = np.stack([around.at(time).discs[:, :2] for time in times])
        for disc, way in zip(places.swapaxes(0, 1), three.CROSSINGS, strict=True):
            there = int(np.abs(disc[:, 1]).argmin())
            assert 0 < there < len(times) - 1 and abs(disc[there, 0] - way) < 0.51
            assert abs(times[there] - disc[there, 0] / 1.35) < 0.51
        where = Surroundings(Obstacles(shapes=still)).at(0.0)
        assert min(clearance(HULL, pose, where) for pose in one.plan.poses) > 0.049


def test_fitted_lag() -> None:
    """The lag of a first-order system is found from its response, which scipy integrates."""
    times = np.arange(0, 5, 0.01)
    command = np.where(times % 1 < 0.5, 1.0, 0.2)
    for lag in (0.03, 0.2):
        _, v, _ = lsim((1, (lag, 1)), command, times, interp=False)
        result = xr.Dataset(
            {"v_command": (("run", "time"), command[None]), "v": (("run", "time"), v[None])}, {"time": times}
        )
        failed = result.map(lambda values: np.nan * values)  # in its first tick, so that it has no sample
        assert three.fitted([result, failed]) == pytest.approx(lag, rel=0.01)


def test_bad_input(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """The suite has worlds of its own, and a mission needs one."""
    assert "suite: " in refused(capsys, "navigate", "doorway:3", "--suite", "--out", str(tmp_path))
    assert "quick: " in refused(capsys, "navigate", "doorway:3", "--quick")
    assert "world: " in refused(capsys, "navigate")
