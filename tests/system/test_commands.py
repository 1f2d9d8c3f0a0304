"""The commands: output, files, help texts, and the refusal of bad input."""

import json
import os
import re
import shutil
import subprocess
import sys
import typing
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest

import mrctl
from mrctl import cli
from mrctl.control.fel import initial_weights
from mrctl.experiments import single
from mrctl.record import Record
from mrctl.results.dataset import save
from mrctl.scenario import Scenario
from mrctl.theory.robot import Robot

CIRCLE = mrctl.Circle(radius=0.5, period=5.0)
SHORT = ["--laps", "1", "reference:circle", "--reference.radius", "0.5", "--reference.period", "5"]
SCENARIO = """
learner = "rls"
laps = 1
[reference]
kind = "circle"
radius = 0.5
period = 5
"""

OWN = """
class Own:
    def __init__(self, robot, size):
        pass

    def output(self, command, derivative):
        return 10 * command

    def learn(self, *_):
        pass
"""


@pytest.fixture
def scenario(tmp_path: Path) -> Path:
    file = tmp_path / "scenario.toml"
    file.write_text(SCENARIO)
    return file


def refused(capsys: pytest.CaptureFixture, *arguments: str) -> str:
    """Returns the one line on stderr of a command that must end with status 2."""
    assert cli.main(list(arguments)) == 2
    captured = capsys.readouterr()
    lines = [line for line in captured.err.splitlines() if "tick" not in line]
    assert len(lines) == 1, captured.err
    assert "Traceback" not in captured.err
    return lines[0]


def test_run_prints_a_row_per_lap(capsys: pytest.CaptureFixture) -> None:
    """The table has a row for each lap and names the feedforward."""
    assert cli.main(["run", "--laps", "2", "--prior", "model", "--learner", "none", *SHORT[2:]]) == 0
    out = capsys.readouterr().out
    assert "feedforward model" in out
    assert [line.split("|")[1].strip() for line in out.splitlines()[3:]] == ["1", "2"]


def test_run_that_fails(capsys: pytest.CaptureFixture) -> None:
    """It ends with status 1, says when and why, and has a row for each lap that was driven to its end, none of nan."""
    tall = ["--perturbation.payload", "20", "--perturbation.payload-z", "0.5"]
    assert cli.main(["run", "--robot.path", "racecar", *tall, "--laps", "1"]) == 1
    out, said = capsys.readouterr()
    assert (
        found := re.fullmatch(
            r"mrctl: the run (failed after \d+\.\d\d s: (?:tilt over 30°|lateral error over 1 m))",
            said.splitlines()[-1],
        )
    )
    assert out.splitlines()[1:] == [found[1]]


def test_run_json_is_the_simulation(capsys: pytest.CaptureFixture, scenario: Path) -> None:
    """`--json` holds the metrics of the same scenario run from Python."""
    assert cli.main(["run", str(scenario), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    laps = mrctl.per_lap(mrctl.simulate([mrctl.Scenario.from_toml(scenario)]))
    for name in ("v_rmse", "lateral_max", "energy"):
        assert printed["laps"][0][name] == float(laps[name].values[0, 0])
    assert mrctl.Scenario.from_dict(printed["scenario"]) == mrctl.Scenario.from_toml(scenario)


def test_event_after_the_arrival(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """The report names an event that comes after the robot has arrived at its goal, where the run ends."""
    line = mrctl.Waypoints(points=((0, 0), (0.2, 0), (0.4, 0)), closed=False, timing="limits", speed=0.5)
    late = mrctl.Event(time=2.5, perturbation=mrctl.Perturbation(payload=1.0))
    run = mrctl.Scenario(learner="none", laps=2, reference=line, goal=(0.4, 0.0, 0.0), events=(late,))
    run = run.replace(perturbation={"mass_factor": 1.1})
    assert run.duration > late.time
    (tmp_path / "run.toml").write_text(run.to_toml())
    assert cli.main(["run", str(tmp_path / "run.toml")]) == 0
    out = capsys.readouterr().out
    assert "event at 2.5 s: after the end of the run at 1." in out and "goes back" not in out


def test_no_such_scenario(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    """A file that is missing is named in one line, and nothing is printed."""
    monkeypatch.chdir(tmp_path)
    assert cli.main(["run", "nowhere.toml"]) == 2
    assert capsys.readouterr() == ("", "mrctl: nowhere.toml: No such file or directory\n")


def test_event_that_takes_back(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """The report says what the perturbation of an event takes back, unless it takes back all on purpose."""
    heavier = mrctl.Perturbation(mass_factor=1.2, slope=0.01)
    changes = {"payload": 1.0, "slope": 0.01}, {"payload": 1.0, "slope": 0.02}, {}
    events = tuple(
        mrctl.Event(time=0.5 * (k + 1), perturbation=mrctl.Perturbation(**one)) for k, one in enumerate(changes)
    )
    run = mrctl.Scenario(learner="none", laps=1, reference=CIRCLE, perturbation=heavier, events=events)
    (tmp_path / "run.toml").write_text(run.to_toml())
    assert cli.main(["run", str(tmp_path / "run.toml")]) == 0
    said = [line for line in capsys.readouterr().out.splitlines() if line.startswith("event")]
    assert said == ["event at 0.5 s: mass_factor goes back to 1"]
    assert cli.main(["run", str(tmp_path / "run.toml"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["notes"] == said


@pytest.mark.parametrize(("learner", "says"), [("rls", True), ("indi", False), ("none", False)])
def test_learning_that_slip_prevents(learner: Any, says: bool) -> None:
    """The report of a learner says for how long slip kept it from learning, if that was most of the run."""
    flat = mrctl.Perturbation(left_radius_factor=0.8)  # which looks like slip
    run = mrctl.Scenario(prior="model", learner=learner, laps=1, reference=CIRCLE, perturbation=flat)
    text = single.run(run, None, False).text
    assert bool(re.search(r"^nothing was learned for \S+ of \S+ s: slip above 0\.1$", text, re.MULTILINE)) == says


def test_flags_override_the_file(capsys: pytest.CaptureFixture, scenario: Path) -> None:
    """Flags override the values of the file, and other values are the file's."""
    assert cli.main(["run", str(scenario), "--learner", "none", "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)["scenario"]
    assert printed["learner"] == "none"
    assert printed["reference"]["kind"] == "circle"


@pytest.mark.parametrize("switch", ["--no-code", "--guard.no-on", "--fel.no_frozen", "--seed=0", "--json"])
def test_file_after_a_switch(capsys: pytest.CaptureFixture, scenario: Path, switch: str) -> None:
    """A scenario file may follow a flag that takes no value."""
    assert cli.main(["run", switch, str(scenario), *([] if switch == "--json" else ["--json"])]) == 0
    printed = mrctl.Scenario.from_dict(json.loads(capsys.readouterr().out)["scenario"])
    expected = mrctl.Scenario.from_toml(scenario)
    assert printed == (expected.replace(guard={"on": False}) if switch == "--guard.no-on" else expected)


def test_out_holds_result_figures_and_weights(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """`--out` writes result, figures and weights, from which learning goes on, and does not overwrite them."""
    out = tmp_path / "out"
    ideal = {"sensing": mrctl.Sensing(tier="ideal"), "pid": mrctl.Pid(time_constant=0.15)}
    flags = ["--sensing.tier", "ideal", "--pid.time-constant", "0.15"]
    command = ["run", "--out", str(out), "--learner", "fel", *flags, *SHORT]
    assert cli.main(command) == 0
    assert capsys.readouterr().out.splitlines()[-1] == f"The files are in {out}."
    result = mrctl.open(out / "result.zarr")
    circle = mrctl.Circle(radius=0.5, period=5)
    again = mrctl.simulate(mrctl.Scenario(learner="fel", laps=1, reference=circle, **ideal))
    np.testing.assert_array_equal(result["voltage_left"].values[0], again["voltage_left"].values)
    for name in ("path", "velocities", "errors", "voltages", "learning"):
        assert (out / f"{name}.png").stat().st_size > 5000
        assert (out / f"{name}.pdf").read_bytes().startswith(b"%PDF")
    capsys.readouterr()
    before = (out / "path.png").stat().st_mtime_ns
    assert "nothing was overwritten" in refused(capsys, *command)
    assert (out / "path.png").stat().st_mtime_ns == before
    # The weights that were learned start the next run better than none.
    first = float(mrctl.per_lap(result)["v_rmse"].values[0, 0])
    carried = mrctl.Scenario(
        laps=1,
        reference=circle,
        **ideal,
        learned=str(out / "learned.safetensors"),
        events=(mrctl.Event(time=0.0, learning=False),),
    )
    assert float(mrctl.per_lap(mrctl.simulate([carried]))["v_rmse"].values[0, 0]) < first


@pytest.mark.usefixtures("no_figures")
def test_saved_run_again(tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    """A saved run is driven again, bit for bit; the first signal that departs is named, with the version that saved."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "own.py").write_text(OWN)
    assert cli.main(["run", "--learner", "rls", "--seed", "3", "--out", "first", *SHORT]) == 0
    assert cli.main(["run", "first", "--out", "second"]) == 0
    assert "first: bit-identical" in capsys.readouterr().out
    first, second = (mrctl.open(tmp_path / name / "result.zarr") for name in ("first", "second"))
    assert first.equals(second) and first.attrs["scenarios"] == second.attrs["scenarios"]
    assert cli.main(["run", "second", "--json"]) == 0
    captured = capsys.readouterr()
    assert json.loads(captured.out)["scenario"]["seed"] == 3 and "second: bit-identical" in captured.err

    second["v"][0, 100] = -second["v"][0, 100]
    second["omega"][0, 50] = np.nextafter(second["omega"][0, 50], 1)
    second.attrs["versions"] = json.dumps(json.loads(second.attrs["versions"]) | {"mujoco": "3.0.0"})
    shutil.rmtree(tmp_path / "second" / "result.zarr")
    save(second, tmp_path / "second" / "result.zarr")
    assert cli.main(["run", "second"]) == 1
    departs = "second: departs in omega from t = 0.5 s on (saved with mujoco 3.0.0, not 3.17.0), from what was saved"
    assert departs in capsys.readouterr().err

    assert cli.main(["run", "--controller", "own.py:Own", "--out", "own", *SHORT]) == 0
    assert cli.main(["run", "own", "--controller", "own.py:Own"]) == 0
    assert "own: bit-identical" in capsys.readouterr().out
    refusals = {
        ("own",): "controller: the run in own needs --controller with feedforward=Own, as when it was saved",
        ("own", "--controller", "motion=own.py:Own"): "the run in own needs --controller with feedforward=Own",
        ("first", "--controller", "own.py:Own"): "controller: the run in first needs no --controller",
        ("first", "--seed", "4"): "seed: first holds a run, which is driven as it was; leave --seed out",
        ("first", "--out", "first"): "first",
        ("empty",): "empty: not a saved result",
        ("mission",): "mission holds a mission, which mrctl navigate mission repeats",
        ("both",): "both: holds 2 runs; mrctl run repeats a single one",
    }
    for folder in ("empty", "mission"):
        (tmp_path / folder).mkdir()
    (tmp_path / "mission" / "mission.json").write_text("{}")
    scenario = mrctl.Scenario(laps=1, reference=mrctl.Circle(radius=0.5, period=5.0), learner="none")
    mrctl.save(mrctl.simulate([scenario, scenario.replace(seed=1)]), "both")
    for arguments, says in refusals.items():
        assert says in refused(capsys, "run", *arguments)


def test_saved_results_again(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """So is a result that Python saved, of one run, a named one, one that fails, or one with events."""
    course = mrctl.Circle(radius=0.5, period=5.0)
    over = mrctl.Event(time=0.5, push=(4000.0, 4000.0, 0.0))
    runs = [
        mrctl.Scenario(name="mine", laps=1, reference=course, learner="rls"),
        mrctl.Scenario(laps=1, reference=course, events=(mrctl.Event(time=1.0, push=(3.0, 0.0, 0.0)),)),
        mrctl.Scenario(laps=1, reference=course, events=(over,), learner="none"),
    ]
    for k, scenario in enumerate(runs):
        folder = tmp_path / f"{k}"
        saved = mrctl.simulate(scenario)
        mrctl.save(saved, folder)
        assert cli.main(["run", str(folder)]) == bool(saved["failed"])
        said = capsys.readouterr()
        assert f"{folder}: bit-identical" in said.out
        assert (f"mrctl: the run failed after {saved['failure_time'].item():.2f} s" in said.err) == (k == 2)


def test_tune_states_the_learning_condition(
    tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By the IMC rule the ratio of the learning condition is 1 + τ/λ, with the robot's own time constant."""
    monkeypatch.setattr("mrctl.experiments.response.PERIOD_TICKS", 200)  # what is measured is looked at elsewhere
    by_rule = ["tune", "--time-constant", "0.15", "--delay", "0", "0.02", "0.04", "--out", str(tmp_path), "--json"]
    assert cli.main(by_rule) == 0
    printed, said = capsys.readouterr()
    assert said.splitlines()[-1] == f"The files are in {tmp_path}."
    table = json.loads(printed)
    assert json.loads((tmp_path / "table.json").read_text()) == table
    assert (tmp_path / "sensitivity.png").stat().st_size > 5000
    assert [row["delay"] for row in table["loops"]] == 4 * [0, 0.02, 0.04]
    assert table["time_constant"] == 0.15
    assert table["loops"][0]["ratio"] == pytest.approx(1 + 0.234 / 0.15, rel=5e-3)
    assert [row["k_p"] for row in table["loops"][-3:]] == [0.3, 0.3, 0.3]


def test_tune_designs(capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    """For any robot it prints gains, the motion controller, and each loop as designed and as measured."""
    monkeypatch.setattr("mrctl.experiments.response.PERIOD_TICKS", 200)  # of the racing car 1000, as ever
    for robot, lines in (("car", 4 + 3 + 4), ("turtlebot", 2 + 1 + 2)):
        assert cli.main(["tune", robot, "--delay", "0.01"]) == 0
        out = capsys.readouterr().out
        assert "max |S| ≤ 1.6" in out and "is above 1" in out
        rows = [
            line for line in out.splitlines() if line.startswith(("| common", "| compliant", "| caster", "| rigid"))
        ]
        assert len(rows) == lines
    monkeypatch.undo()
    assert cli.main(["tune", "racecar", "--delay", "0.01", "--lag", "0.02", "--json"]) == 0
    table = json.loads(capsys.readouterr().out)
    assert table["robot"]["path"] == "racecar" and table["lag"] == 0.02
    assert [row["steering"] for row in table["motion"]] == ["rigid"]
    assert all(row["measured"]["sensitivity"] < 1.6 for row in table["loops"])


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("feedforwar = 'fel'", "feedforwar"),
        ("learner = 'magic'", "learner"),
        ("feedforward = 'composite'", "set prior and learner"),
        ("learner = 'observer'", "prior"),
        ("laps = 0", "laps"),
        ("[fel]\nstep = nan", "fel.step"),
        ("[perturbation]\nmass_factor = -1", "perturbation.mass_factor"),
        ("[perturbation]\ncontrol_delay = 0.013", "control_delay"),
        ("control_period = 0.003", "control_period"),
        ("[reference]\nkind = 'circle'\nradius = 0.2\nperiod = 1", "circle"),
        ("[reference]\nkind = 'spiral'", "spiral"),
        ("[reference]\nkind = 'stop_and_go'", "reverse"),
        ("initial_pose = [5.0, 0.0, 0.0]", "initial_pose"),
        ("world = 'moon'", "world"),
        ("world = 'broken.xml'", "broken.xml"),
        ("world = 'empty.xml'", "chassis"),
        ("[perturbation]\npayload = 100\npayload_x = -0.9", "perturbation"),
        ("[fel]\nweights = 'missing.safetensors'", "fel.weights"),
        ("[fel]\nweights = 'weights.safetensors'\nhidden = 7", "fel.weights"),
        ("this is not TOML", "scenario.toml"),
    ],
)
def test_bad_scenario_is_one_line(
    text: str, says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    """Every kind of bad scenario ends with one line that names what is wrong."""
    monkeypatch.chdir(tmp_path)
    Path("scenario.toml").write_text(text)
    Path("broken.xml").write_text("<mujoco><worldbody></mujoco>")
    Path("empty.xml").write_text("<mujoco/>")
    mrctl.save_weights("weights.safetensors", initial_weights(24, 0))
    assert says in refused(capsys, "run", "scenario.toml")
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        "broken.xml", "empty.xml", "scenario.toml", "weights.safetensors",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["run", "missing.toml"], "missing.toml"),
        (["run", "turtlebot"], "turtlebot is not a scenario file"),
        (["run", "scenario.tml", "--laps", "1"], "scenario.tml is not a scenario file"),
        (
            ["run", "--pid.retune", "false"],
            "pid.retune: a switch without a value, but false follows it; --pid.retune is",
        ),
        (["view", "--guard.no-on", "1"], "guard.on: a switch without a value, but 1 follows it"),
        (["run", "--json", "turtlebot"], "turtlebot is not a scenario file"),
        (["run", "--perturbation", "al"], "perturbation: no perturbation is called 'al'; there are nominal, mass"),
        (["identify", "--perturbation"], "perturbation: needs a name"),
        (["run", "--goal", "1"], "goal: expected None or FLOAT FLOAT FLOAT"),
        (["run", "--laps", "1.5"], "laps: '1.5' is not a whole number"),
        (["run", "--map", "hall.yaml"], "map: has no flag; set it in a scenario file"),
        (["run", "--sensing.teir", "field"], "no flag is called --sensing.teir; did you mean --sensing.tier?"),
        (["run", "--perturbation.mas", "2"], "--perturbation.mas; did you mean --perturbation.mass-factor?"),
        (["navigate", "doorway:1", "--perturbation.mas", "2"], "did you mean --perturbation.mass-factor?"),
        (["check", "--robot.path", "mule.xml"], "--robot.path: is no flag of mrctl check"),
        (["run", "reference:circle", "--laps", "1"], "--laps: is no flag of reference:circle, and those of mrctl run"),
        (["navigate", "doorway:1", "mule.xml"], "mule.xml: the file of a robot is given as --robot.path mule.xml"),
        (["run", "mule.xml"], "mule.xml: the file of a robot is given as --robot.path mule.xml"),
        (["navigate", "doorway:1", "--sensing.lidar.nois", "3"], "did you mean --sensing.lidar.noise?"),
        (["run", "--lapz=3"], "no flag is called --lapz"),
        (["run", "--pertubation", "all"], "no flag is called --pertubation; did you mean --perturbation?"),
        (["view", "--controller=a.py:A"], "controller: a live session drives with those of mrctl; with your own, give"),
        (["run", "--out"], "out: needs a value; see mrctl run --help"),
        (["sweep"], "SWEEP.toml, --out PATH: missing; see mrctl sweep --help"),
        (["record", "run"], "--out PATH: missing; see mrctl record --help"),
        (["check", "--jso"], "no flag is called --jso; did you mean --json?"),
        (["run", "reference:circle", "--radius", "-1"], "--radius; did you mean --reference.radius?"),
        (["sweep", "x.toml", "--out", "y", "--wxyz", "3"], "no flag is called --wxyz"),
        (["navigate", "--laps", "3"], "laps: has no flag here, because the mission sets it"),
        (["run", "--feedforward", "fel"], "feedforward: this field of an earlier version is gone"),
        (["suite", "--feedforward", "foo"], "feedforward: 'foo' is none of composite, fel, hindsight, model, model+c"),
        (["navigate", "doorway:3", "--goal", "1"], "goal: expected"),
        (["run", "--initial-pose", "1,2"], "initial-pose: 1,2 is not x, y and θ"),
        (["run", "--initial-spread", "0,0"], "initial-spread: 0,0 is not x, y and θ"),
        (["navigate", "doorway:3", "--speed", "15"], "speed: must be between 0.01 and 1.5 m/s, not 15"),
        (["navigate", ".", "--goal", "1,0,0"], ".: holds no mission"),
        (["navigate", "--suite", "--port", "9000"], "port: belongs to --view"),
        (["navigate", "--suite", "--initial_spread", "0", "0", "0"], "suite: has its own worlds"),
        (["check", "missing.xml"], "robot: no file missing.xml; there are car"),
        (["tune", "--tier", "lab"], "tier: belongs to --search"),
        (["check", "submarine"], "robot: submarine is neither car"),
        (["run", "--fel.step", "7"], "fel.step"),
        (["run", "--fel.stride", "1"], "--fel.stride"),
        (["run", "--learner", "magic"], "learner: 'magic' is none of composite, fel"),
        (["run", "--perturbation.slope", "nan"], "perturbation.slope"),
        (["tune", "--time-constant", "-1"], "time_constant"),
        (["tune", "--world", "moon"], "moon"),
        (["tune", "submarine.xml"], "submarine.xml"),
        (["tune", "--lag", "-1"], "lag"),
        (["tune", "--delay", "0.013"], "delay: 0.013 s is not a whole multiple"),
        (["tune", "--delay", "0.6"], "delay: "),
        (["suite", "--seeds", "0"], "seeds"),
        (["suite", "--quick", "--feedforward"], "feedforward: the suite needs at least one"),
        (["suite", "--quick", "--random", "100001"], "random: the suite has the first 100,000"),
        (["suite", "--quick", "--seeds", "100001"], "seeds: the suite has the first 100,000"),
        (["dance"], "no command is called 'dance'; there are run, navigate, reproduce"),
        (["run", "--feedforward", "rls"], "feedforward: this field of an earlier version is gone"),
        (["run", "--reference", "circle"], "reference: a reference comes last, and its flags behind it"),
        (["view", "--reference.radius", "2", "reference:circle"], "reference.radius: a reference comes last"),
        (["run", "reference:circle", "--reference.radios", "2"], "did you mean --reference.radius?"),
        (["run", "circle"], "nor a reference, which is written as reference:circle"),
        (["run", "--sensing", "fild"], "sensing.tier: 'fild' is none of field, ideal, lab"),
        (["tune", "--robot", "mule.xml"], "the robot stands without a flag, as in mrctl tune turtlebot"),
        (["run", "--tier", "field"], "--tier: is no flag of mrctl run; did you mean --sensing.tier?"),
        (["identify", "mule.xml", "--wheels", "l", "r"], "did you mean --robot.wheels?"),
        (["identify", "mule.xml", "--robot.wheels", "l", "r"], "a file or --robot FILE, beside which --robot.wheels"),
        (["run", "--controller", "motion=a.py:A", "--controller=b.py:B"], "controller: is given twice; its values"),
        (["run", "--controller", "a.py:A", "--controller", "b.py:B"], "behind one --controller, joined by commas"),
        (["suite", "--feedforward", "fel", "--feedforward", "none"], "one --feedforward, one after another"),
        (["tune", "--delay", "0", "--delay", "0.01"], "delay: is given twice"),
    ],
)
def test_bad_flags_are_one_line(arguments: list[str], says: str, capsys: pytest.CaptureFixture) -> None:
    """Every kind of bad flag ends with one line that names it."""
    assert says in refused(capsys, *arguments)


def test_scenario_file_behind_the_reference(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    """One line says where the file belongs."""
    monkeypatch.chdir(tmp_path)
    Path("a.toml").write_text("laps = 1")
    assert "a.toml: one scenario file may be given, in front of the" in refused(
        capsys, "run", "reference:line", "a.toml"
    )


@pytest.mark.parametrize("arguments", [["run", "--help"], ["run", "--laps", "0"]])
def test_reader_of_a_pipe_that_leaves(arguments: list[str]) -> None:
    """A pipe that nobody reads any more, as after `mrctl run --help | head`, is no error, and hides none."""
    command = [sys.executable, "-m", "mrctl", *arguments]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout and process.stderr
    process.stdout.close()
    said = process.stderr.read()
    if "--help" in arguments:
        assert (process.wait(), said) == (0, "")
    else:
        assert process.wait() == 2 and said == "mrctl: laps: Input should be greater than or equal to 1\n"


def test_perturbation_by_name(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """On the command line and in a file; later flags override it. The value of a flag is no scenario file."""
    flags = ["--perturbation", "all", "--perturbation.mass-factor", "1", "--name", "x.toml", "--json"]
    assert cli.main(["run", *flags, *SHORT]) == 0
    scenario = mrctl.Scenario.from_dict(json.loads(capsys.readouterr().out)["scenario"])
    assert scenario.perturbation == mrctl.PERTURBATIONS["all"].replace(mass_factor=1.0)
    assert scenario.name == "x.toml"
    (tmp_path / "all.toml").write_text('perturbation = "all"')
    assert mrctl.Scenario.from_toml(tmp_path / "all.toml").perturbation == mrctl.PERTURBATIONS["all"]
    # It replaces that of the file, whatever the file has beside it.
    (tmp_path / "laden.toml").write_text("[perturbation]\npayload = 5.0")
    assert cli.main(["run", str(tmp_path / "laden.toml"), "--perturbation", "all", "--json", *SHORT]) == 0
    assert json.loads(capsys.readouterr().out)["scenario"]["perturbation"]["payload"] == 0


COMMANDS = (
    "run",
    "navigate",
    "reproduce",
    "sweep",
    "suite",
    "tune",
    "identify",
    "check",
    "bench",
    "view",
    "record",
    "export",
)
REFERENCES = ("line", "circle", "lemniscate", "lane-change", "rounded-square", "stop-and-go", "waypoints")


def help_texts(capsys: pytest.CaptureFixture, *arguments: str) -> dict[str, str]:
    """Returns the help text of each flag and positional argument of a help screen, without its default."""
    with pytest.raises(SystemExit) as stop:
        cli.main(list(arguments))
    assert not stop.value.code
    texts: dict[str, list[str]] = {}
    flag = ""
    for line in capsys.readouterr().out.splitlines():  # in boxes, or with spaces in their place
        if begin := re.match(r"[│ ] (--?[a-z].*?|\[?[A-Z]{5,}.*?)(?:  +(.*))?$", line.rstrip("│ ")):
            flag = begin[1]
            texts[flag] = [begin[2] or ""]
        elif not re.match(r"[│ ]   ", line):
            flag = ""  # the title of a box, or its description
        elif flag:
            texts[flag].append(line.strip("│ "))
    del texts["-h, --help"]  # which is tyro's own
    return {name: re.sub(r" *\((default: .*|required)\)$", "", " ".join(t).strip()) for name, t in texts.items()}


@pytest.mark.parametrize("command", [*([c] for c in COMMANDS), *(["run", f"reference:{k}"] for k in REFERENCES)])
def test_every_flag_is_explained(
    command: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    """The help text of a flag is a sentence of three words or more, from a capital letter to a full stop."""
    monkeypatch.setenv("COLUMNS", "80")
    texts = help_texts(capsys, *command, "--help-all")
    assert texts
    for flag, text in texts.items():
        assert re.fullmatch(r"[A-Z]\S*( \S+){2,}\.", text), f"{flag}: {text!r}"


def test_short_help_of_run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    """The short help explains the usual flags, and names each further flag or its group."""
    monkeypatch.setenv("COLUMNS", "80")
    short = help_texts(capsys, "run", "--help")
    for flag in (
        "[SCENARIO.toml",
        "--laps",
        "--prior",
        "--learner",
        "--steering",
        "--seed",
        "--out",
        "--json",
        "--controller",
    ):
        assert any(name.startswith(flag) for name in short), flag
    with pytest.raises(SystemExit):
        cli.main(["run", "--kanayama.k-x", "2", "--help"])
    screen = capsys.readouterr().out
    assert len(screen.splitlines()) < 100
    assert "mrctl run reference:circle --help" in screen and "mrctl run --help-all" in screen
    every = help_texts(capsys, "run", "--help-all")
    assert len(every) > 80
    for flag in every.keys() - short.keys():
        name = flag.split()[0].rstrip(",")
        assert re.search(rf"^  {re.escape(re.sub(r'[.].*', '.*', name))} ", screen, re.MULTILINE), flag


def test_defaults_of_navigate(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    """The help says that `--learner` alone takes the prior away, and the other way round."""
    monkeypatch.setenv("COLUMNS", "200")
    with pytest.raises(SystemExit):
        cli.main(["navigate", "--help"])
    screen = " ".join(capsys.readouterr().out.split())
    assert "(default: model, or none where --learner is given)" in screen
    assert "(default: composite, or fel where --prior is given)" in screen


def test_short_help_of_identify(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    """The short help of `identify` is one screen; it names the groups of the flags that it leaves out."""
    monkeypatch.setenv("COLUMNS", "80")
    with pytest.raises(SystemExit):
        cli.main(["identify", "--perturbation.payload", "2", "--help"])
    screen = capsys.readouterr().out
    assert len(screen.splitlines()) < 30 and "mrctl identify --help-all" in screen
    short, every = (help_texts(capsys, "identify", flag) for flag in ("--help", "--help-all"))
    assert len(short) == 4 + 3 and len(every) > 60  # flags and groups of flags
    for flag in every.keys() - short.keys():
        assert f"  {flag.partition('.')[0]}.* " in screen, flag


def test_short_help_has_the_defaults_of_the_file(capsys: pytest.CaptureFixture, scenario: Path) -> None:
    """The help of `run` on a scenario file shows the file's values as defaults."""
    with pytest.raises(SystemExit):
        cli.main(["run", str(scenario), "--help"])
    out = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert "(default: rls)" in out and "Laps to drive. At least 1, at most 10000. (default: 1)" in out


def test_version(capsys: pytest.CaptureFixture) -> None:
    """`mrctl --version` prints the version of the installed package; `mrctl --help` names it, and every command."""
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out == f"mrctl {mrctl.__version__}\n"
    with pytest.raises(SystemExit):
        cli.main(["--help"])
    out = capsys.readouterr().out
    assert "mrctl --version" in out and f"{{{','.join(COMMANDS)}}}" in out


UNIT = r"(?<=[ (])(1/)?(k?g|m|s|rad|V|A|N|H|Ω|Hz)([·/]√?(m|s|rad|V|A|kg|Hz)[²³]?)*[²³]?(?=[ .,;:)])"
DIMENSIONLESS = r"\b([Ff]actor|[Rr]atio|[Ss]hare|[Cc]oefficient|[Nn]umber of|[Dd]imensionless)\b"


def test_closed_streams() -> None:
    """A command whose output is closed says what is wrong, and ends with the status of that."""
    line = f"{sys.executable} -m mrctl run --laps x <&- >&-"
    ended = subprocess.run(["sh", "-c", line], check=False, capture_output=True, text=True)
    assert (ended.returncode, ended.stderr) == (2, "mrctl: laps: 'x' is not a whole number\n")


def test_version_on_a_full_disk(capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(sys.stdout, "write", mock.Mock(side_effect=OSError(28, "No space left on device")))
        assert cli.main(["--version"]) == 2
    assert capsys.readouterr().err == "mrctl: No space left on device\n"


def records_of(kind: Any) -> set[type[Record]]:
    """Returns the records in a type and, recursively, in their fields."""
    if isinstance(kind, type) and issubclass(kind, Record):
        return {kind}.union(*(records_of(field.annotation) for field in kind.model_fields.values()))
    return set().union(*map(records_of, typing.get_args(kind)))


def holds_floats(kind: Any) -> bool:
    """Tells whether a type is float, or a tuple or union with floats in it."""
    return kind is float or any(map(holds_floats, typing.get_args(kind)))


HELD = sorted(records_of(Scenario) | {Robot}, key=lambda record: record.__name__)


@pytest.mark.parametrize("record", HELD, ids=lambda record: record.__name__)
def test_every_field_is_explained(record: type[Record]) -> None:
    """The text of a field is a sentence; that of a float has a unit, or says that the number is dimensionless."""
    for name, field in record.model_fields.items():
        text = field.description or ""
        assert re.fullmatch(r"[A-Z].*\.", text, re.DOTALL), f"{name}: {text!r}"
        if holds_floats(field.annotation):
            assert re.search(UNIT, text) or re.search(DIMENSIONLESS, text), f"{name}: {text!r}"


def test_fields_are_found() -> None:
    """The fields of references and events are held too; words that only look like units do not count."""
    assert {"Scenario", "Event", "Perturbation", "RobotFile", "Lemniscate", "Waypoints"} <= {r.__name__ for r in HELD}
    assert holds_floats(Scenario.model_fields["initial_pose"].annotation)
    assert not holds_floats(Scenario.model_fields["laps"].annotation)
    assert re.search(UNIT, "Torque in N·m.") and re.search(UNIT, "Gain in 1/m², squared.")
    assert not re.search(UNIT, "The robot's own model, a mesh.")


@pytest.mark.parametrize("command", [["run", *SHORT], ["reproduce"], ["suite"]])
def test_unwritable_folder_is_refused_before_the_work(
    command: list[str], tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    """A folder that cannot be made is refused before anything is computed."""
    (tmp_path / "file").write_text("kept")
    assert "out" in refused(capsys, command[0], "--out", str(tmp_path / "file" / "out"), *command[1:])
    assert (tmp_path / "file").read_text() == "kept"


def test_installed_command_without_a_display(tmp_path: Path) -> None:
    """The console script runs without a display; its stderr, a file, has lines of progress alone, one a minute."""
    environment = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "MUJOCO_GL")}
    script = Path(sys.executable).with_name("mrctl")
    done = subprocess.run(
        [script, "run", *SHORT], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "RMSE per lap" in done.stdout
    lines = [line for line in done.stderr.splitlines() if line.strip()]
    assert len(lines) == 2 and all("tick" in line for line in lines), done.stderr  # the first and the last


def test_bad_field_of_the_scenario_is_one_line(capsys: pytest.CaptureFixture) -> None:
    """A flag out of range that belongs to the scenario itself, not to a part of it, is named too."""
    assert refused(capsys, "run", "--laps", "0").startswith("mrctl: laps: ")
