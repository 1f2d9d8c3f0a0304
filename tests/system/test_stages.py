"""A user's own stage replaces any of the four; an error in one is reported, and other runs are kept."""

import re
from functools import cache, partial
from pathlib import Path

import numpy as np
import pytest
import torch

import mrctl
from mrctl import Box, Circle, InputError, Lemniscate, Line, Scenario, Sweep
from mrctl.cli import main
from mrctl.control.kanayama import GAINS, kanayama, posture_error
from mrctl.control.nominal import nominal
from mrctl.control.pid import PID, pid
from mrctl.control.steering import ALLOCATION, allocate, steer
from mrctl.experiments.paper import IDEAL
from mrctl.kernel import over_rows
from mrctl.loop import user_files
from mrctl.loop.runs import simulate
from mrctl.results.dataset import GAIN_VARIABLES, SIGNALS
from mrctl.scenario import FEEDFORWARDS
from mrctl.sweep import jobs
from mrctl.sweep.store import Store
from mrctl.viewer.recording import Library

SHORT = Scenario(**IDEAL, reference=Circle(period=4, radius=0.5), laps=1, learner="none")
THREE = [SHORT.model_copy(update={"seed": seed}) for seed in range(3)]
LAP = Scenario(**IDEAL, reference=Lemniscate(period=10), laps=1)
STAGES = "motion", "feedback", "feedforward", "steering"  # and the estimator, whose faults differ: test_estimators.py


def posture_errors(pose, reference):
    """Returns the posture errors of B robots in their own frames, `(B, 3)`."""
    error = np.empty((len(pose), 3))
    over_rows(posture_error, pose, reference[:, :3], error)
    return error


class Stanley:
    """Hoffmann et al. 2007: the front wheel turns by the heading error and by atan(k e / V)."""

    def __init__(self, robot, size):
        self.wheelbase = robot.wheelbase

    def reset(self, pose, reference, period):
        pass

    def output(self, pose, twist, reference):
        e = posture_errors(pose, reference)
        v = reference[:, 3] + 2.0 * e[:, 0]
        angle = (
            e[:, 2]
            + np.arctan2(4.0 * e[:, 1], np.maximum(v, 0.1))
            + np.arctan2(self.wheelbase * reference[:, 4], reference[:, 3])
        )
        return np.stack([v, v * np.tan(angle) / self.wheelbase], axis=1)


class Kanayama:
    """The built-in motion controller as a user's stage."""

    def __init__(self, robot, size):
        self.gains = np.array((3.0, 25.0, 10.0), GAINS)[()]

    def reset(self, pose, reference, period):
        assert period == 0.01 and reference.shape == (len(pose), 7)

    def output(self, pose, twist, reference):
        request = np.empty((len(pose), 2))
        over_rows(kanayama, posture_errors(pose, reference), reference[:, 3:5], self.gains, request)
        return request


class TorchKanayama(Kanayama):
    """The same in torch, with a gradient."""

    def output(self, pose, twist, reference):
        return torch.tensor(super().output(pose, twist, reference), requires_grad=True) * 1.0


class Feedback:
    """The built-in PID as a user's stage."""

    def __init__(self, robot, size, rigid=False):
        self.state = np.zeros(size, PID)
        for name, value in IDEAL["pid"].gains(robot, rigid).items():
            self.state[name] = value
        self.integral = self.state["integral"]

    def reset(self, steady, period):
        self.period = period
        self.integral[:] = steady

    def output(self, command, twist, excess):
        volts = np.zeros_like(command)
        over_rows(pid, command, twist, excess, self.period, self.state, volts)
        return volts


class Fork:
    """The built-in law of the fork as a user's stage."""

    def __init__(self, robot, size):
        self.robot = nominal(robot, False)[0]
        self.state = np.zeros(size, ALLOCATION)

    def reset(self, angle, period):
        self.period = period
        self.state["angle"] = angle

    def output(self, command, derivative):
        zero = np.zeros_like(command)
        over_rows(steer, command, derivative, zero, zero, self.period, self.robot, self.state)
        over_rows(allocate, command, zero, zero, self.period, self.robot, self.state)
        return np.stack([self.state["angle"], self.state["rate"]], axis=1)


def same(one, other):
    """Two results with the same bits in every signal."""
    for name in (*SIGNALS, "failed", "failure_time", "failure"):
        a, b = one[name].values, other[name].values
        assert np.array_equal(a, b, equal_nan=a.dtype.kind == "f"), name


@cache
def built_in(*scenarios):
    """Scenarios under the built-in laws, with which several tests compare."""
    return simulate(scenarios)


@pytest.mark.parametrize("steering", ["compliant", "rigid"])
@pytest.mark.parametrize(
    "own",
    [{"motion": Kanayama}, {"motion": TorchKanayama}, {"feedback": Feedback}, {"steering": Fork}, None],
    ids=["motion", "torch", "feedback", "steering", "all"],
)
def test_same_law(own, steering):
    """The built-in laws as a user's stages give the built-in bits, with saturation, learning and hand-over."""
    hard = mrctl.Perturbation(supply_factor=0.5, mass_factor=1.5)
    base = LAP.model_copy(update={"steering": steering, "perturbation": hard})
    scenarios = [base, base.model_copy(update={"seed": 1})]
    own = dict(own or {"motion": Kanayama, "feedback": Feedback, "steering": Fork})
    if "feedback" in own:
        own["feedback"] = lambda robot, size: Feedback(robot, size, steering == "rigid")
    builtin = built_in(*scenarios)
    assert float(builtin.saturated.sum()) > 0
    found = simulate(scenarios, **own)
    if steering == "rigid" and "steering" in own:  # the tangent at the limit is NumPy's there
        for name in SIGNALS:
            np.testing.assert_allclose(found[name], builtin[name], rtol=1e-9, atol=1e-9, err_msg=name)
    else:
        same(found, builtin)
    replaced = {"motion": {"k_x", "k_y", "k_theta"}, "feedback": {"k_p", "k_i"}}
    unused = {name for stage in own for name in replaced.get(stage, ())}
    assert {name for name in GAIN_VARIABLES if found[name].isnull().all()} == unused
    assert all(np.array_equal(found[name], builtin[name]) for name in set(GAIN_VARIABLES) - unused)


def test_slow_motion():
    """A user's motion controller is asked at the motion controller's rate."""
    calls = []

    class Counted(Kanayama):
        def reset(self, pose, reference, period):
            calls.append(period)

        def output(self, pose, twist, reference):
            calls.append(len(pose))
            return super().output(pose, twist, reference)

    slow = [s.model_copy(update={"motion_period": 0.05}) for s in THREE]
    same(simulate(slow, motion=Counted), simulate(slow))
    assert calls == [0.05] + [3] * 80


def test_followed():
    """What a motion controller says that it follows replaces the reference, and has to have its shape."""

    class Later(Kanayama):
        def __init__(self, robot, size):
            super().__init__(robot, size)
            self.course = np.hstack(Circle(period=4, radius=0.5).sample(0.01 * np.arange(400.0)))
            self.ticks = 0

        def output(self, pose, twist, reference):
            now = self.course[[max(0, self.ticks - 50)] * len(pose)] * ([1] * 3 + [self.ticks >= 50] * 4)
            self.ticks, self.followed = self.ticks + 1, now
            return super().output(pose, twist, now)

    start = {"initial_pose": (0.0, 0.0, 0.0), "initial_spread": (0, 0, 0)}
    rests = [s.model_copy(update=start) for s in THREE]
    found = simulate(rests, motion=Later)
    x, y = Circle(period=4, radius=0.5).sample(np.array([2.0])).pose[0, :2]  # where it is half a second later
    assert np.abs(found.x.values[:, 250] - x).max() < 0.03 and np.abs(found.y.values[:, 250] - y).max() < 0.03

    class Short(Later):
        def output(self, pose, twist, reference):
            found = super().output(pose, twist, reference)
            self.followed = self.followed[:, :3]
            return found

    text = str(simulate(THREE, motion=Short).failure.values[0])
    assert text.startswith("motion Short: `followed` is shape (3, 3), expected shape (3, 7)")


def test_followed_between_calls():
    """Until the next call the twist of what is followed changes at the rate of its acceleration."""

    class Ramp:
        def __init__(self, robot, size):
            self.calls, self.before, self.kept = 0, 0, 0

        def reset(self, pose, reference, period):
            self.period = period

        def output(self, pose, twist, reference):
            now = np.column_stack([pose, np.tile([0.8 - 0.4 * self.period * self.calls, 0, -0.4, 0], (len(pose), 1))])
            self.calls, self.followed = self.calls + 1, now
            np.testing.assert_array_equal(self.before, self.kept)  # nobody writes to the stage's own array
            self.before, self.kept = now, now.copy()
            return now[:, 3:5]

    line = {"reference": Line(length=1.0, speed=0.8), "motion_period": 0.05, "laps": 1}
    found = simulate([s.replace(**line) for s in THREE], motion=Ramp)
    command = found.v_command.values[:, :100]
    np.testing.assert_allclose(command, np.tile(0.8 - 0.004 * np.arange(100), (3, 1)), atol=1e-12)


def test_follow():
    """A motion controller with a method `follow` gets each new reference once, with the first sample of it."""

    class Told(Kanayama):
        told = []

        def __init__(self, robot, size):
            super().__init__(robot, size)
            self.new, self.calls = {}, 0

        def follow(self, row, plan):
            self.new[row] = plan

        def output(self, pose, twist, reference):
            for row, plan in self.new.items():
                self.told.append((self.calls, row, plan.kind))
                expected = np.hstack(plan.sample(np.array([0.0])))[0]
                np.testing.assert_array_equal(reference[row], expected)
            self.new, self.calls = {}, self.calls + 1
            return super().output(pose, twist, reference)

    for tier, preview in (("ideal", 0), ("field", 2)):
        Told.told = []
        events = [{"time": 0.5, "reference": Circle(radius=0.7, period=5)}, {"time": 0.8, "push": (1.0, 0, 0)}]
        changes = {"sensing": {"tier": tier}, "initial_spread": (0.0, 0.0, 0.0), "reference": Line(length=1.0)}
        plain, other = (Scenario(laps=1, seed=k, **changes) for k in range(2))
        simulate([plain.replace(events=events), other], motion=Told)
        assert Told.told == [(50 - preview, 0, "circle")]


def test_scans():
    """A motion controller with a method `see` gets the scans of `sensing.lidar`, at its rate, before `output`."""
    wall, lidar = Box(x=3.0, length=0.2, width=4.0), {"rate": 20.0, "beams": 90, "x": 0.2, "noise": 0.0}
    calls = []

    class Sees(Kanayama):
        def reset(self, pose, reference, period):
            calls.append("reset")
            super().reset(pose, reference, period)

        def see(self, row, scan):
            calls.append((row, scan))

        def output(self, pose, twist, reference):
            calls.append("output")
            return super().output(pose, twist, reference)

    runs = [
        Scenario(
            obstacles={"shapes": (wall.model_dump(),)}, reference=Line(length=1.0, speed=0.5), laps=1, learner="none",
            sensing={"tier": "ideal", "lidar": lidar}, seed=seed,
        )
        for seed in range(2)
    ]  # fmt: skip
    result = simulate(runs, motion=Sees)
    assert calls[0] == "reset" and [call[0] for call in calls[1:3]] == [0, 1] and calls[3] == "output"
    scans = [call for call in calls if not isinstance(call, str)]
    assert len(scans) == 2 * 40  # 2 s
    for row, (ranges, angles, reach, place, time) in scans:
        run = result.isel(run=row, time=round(100 * time))
        x, y, theta = (float(run[name]) for name in ("x", "y", "theta"))
        np.testing.assert_allclose(place, [x + 0.2 * np.cos(theta), y + 0.2 * np.sin(theta), theta], atol=1e-12)
        met = place[:2] + ranges[:, None] * np.column_stack([np.cos(theta + angles), np.sin(theta + angles)])
        hits = np.isfinite(ranges)
        assert reach == 12.0
        assert 5 < hits.sum() < 60 and np.abs(met[hits, 0] - 2.9).max() < 1e-6 and np.abs(met[hits, 1]).max() < 2.0
    assert not any(simulate(runs, motion=Kanayama)["failed"])

    class Blinded(Sees):
        def see(self, row, scan):
            raise OSError("no lens")

    with pytest.raises(InputError, match=r"motion Blinded: OSError: no lens"):
        raise InputError(str(simulate(runs[0], motion=Blinded)["failure"].values))


def test_stanley():
    """A published motion controller in a few lines drives the robot, and the label of the result names it."""
    run = simulate(LAP, motion=Stanley)
    assert not run.failed and str(run.label.item()) == "fel+Stanley" and str(run.feedforward.item()) == "fel"
    assert float(np.hypot(run.longitudinal_error, run.lateral_error)[-200:].max()) < 0.1


def breaking(stage, fault, after=100):
    """Returns a stage that does as the built-in one for a while, and then answers what `fault` makes of it."""
    base = {"motion": Kanayama, "feedback": Feedback, "steering": Fork, "feedforward": Silent}[stage]

    class Breaks(base):
        calls = 0

        def output(self, *given):
            self.calls += 1
            answer = np.array(super().output(*given))
            return fault(answer) if self.calls > after else answer

    return {stage: Breaks}


class Silent:
    """A feedforward of nothing."""

    def __init__(self, robot, size):
        self.size = size

    def output(self, command, derivative):
        return np.zeros_like(command)

    def learn(self, feedback, frozen, twist, voltage):
        pass


def raises(answer):
    raise ZeroDivisionError("too near")


def spoilt(answer):
    answer[1, 1] = np.inf
    return answer


FAULTS = {
    "raises": (raises, "ZeroDivisionError: too near (test_stages.py, line "),
    "shape": (lambda answer: answer[:, :1], "output is shape (3, 1), expected shape (3, 2)"),
    "nothing": (lambda answer: None, "output is nothing, expected shape (3, 2)"),
    "complex": (lambda answer: answer * 1j, "TypeError: the numbers are complex"),
    "text": (lambda answer: "left", "ValueError: could not convert string to float: 'left'"),
}


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("stage", STAGES)
def test_fault(stage, fault):
    """A stage that raises or answers in another shape ends its group, whose record is kept; other groups go on."""
    other = SHORT.model_copy(update={"steering": "caster"})
    what, message = FAULTS[fault]
    whole = simulate([*THREE, other], **breaking(stage, what))
    sound = built_in(*THREE, other)
    tick = 99 if stage == "feedforward" else 100  # which is asked once before the first tick
    for run in range(3):
        text = str(whole.failure[run].item())
        assert text.startswith(f"{stage} Breaks: {message}") and text.endswith(f", tick {tick}"), text
        assert float(whole.failure_time[run]) == pytest.approx(0.01 * (tick + 1))
        for name in SIGNALS:
            values, expected = whole[name].values[run], sound[name].values[run]
            assert np.array_equal(values[:tick], expected[:tick]) and np.isnan(values[tick:]).all(), name
    # The other group has a robot alone, whose answers have other shapes.
    text = str(whole.failure[3].item())
    assert text.startswith(f"{stage} Breaks: ") and "(1, 2)" in text if "shape" in message else text


@pytest.mark.parametrize("stage", STAGES)
def test_not_finite(stage):
    """Not finite, with no guard: it stops the run of its row, whose failure names stage and tick, and no other run."""
    bare = [scenario.model_copy(update={"guard": mrctl.Guard(on=False)}) for scenario in THREE]
    whole, sound = simulate(bare, **breaking(stage, spoilt)), built_in(*bare)
    tick = 99 if stage == "feedforward" else 100
    assert str(whole.failure[1].item()) == f"{stage} Breaks: not finite, tick {tick}"
    assert whole.failed.values.tolist() == [False, True, False]
    for run in (0, 2):
        same(whole.isel(run=run), sound.isel(run=run))


def test_fault_is_in_the_summary():
    """A feedforward that never works drives as the model does, and the summary says why."""

    class Broken:
        def __init__(self, robot, size):
            self.size = size

        def output(self, command, derivative):
            return np.full((self.size, 2), np.nan)

        def learn(self, feedback, frozen, twist, voltage):
            pass

    table = mrctl.summary(simulate(THREE, feedforward=Broken))
    assert table["feedforward_fault"].tolist() == ["feedforward Broken: not finite, tick 0"] * 3
    assert (table["guard_actions"] >= 1).all() and not table["failed"].any()
    assert "feedforward_fault" not in mrctl.summary(simulate(THREE[:1]))


def test_feedforward_knows_the_loop():
    """Its method `reset` is called before all others, with the control period and the delay that is known."""
    told = []

    class Law:
        def __init__(self, robot, size):
            self.size = size

        def reset(self, period, delay):
            told.append((period, delay))

        def output(self, command, derivative):
            assert told
            return np.zeros((self.size, 2))

        def learn(self, feedback, frozen, twist, voltage):
            pass

    for tier in ("ideal", "lab", "field"):
        scenario = mrctl.Scenario(laps=1, reference=mrctl.Line(length=0.5), sensing=mrctl.Sensing(tier=tier))
        simulate(scenario, feedforward=Law)
        assert told.pop() == (0.01, pytest.approx(scenario.sensing.loop_delay(0.01) * 0.01)) and not told


def test_blown_up_robot():
    """A user's stage receives no NaN from a robot that blew up."""

    class Careful(Kanayama):
        def output(self, pose, twist, reference):
            assert np.isfinite(pose).all() and np.isfinite(twist).all()
            return super().output(pose, twist, reference)

    blown = THREE[1].model_copy(update={"events": (mrctl.Event(time=1.0, push=(1e12, 0.0, 1e15)),)})
    whole = simulate([THREE[0], blown, THREE[2]], motion=Careful)
    assert whole.failed.values.tolist() == [False, True, False]


def test_inputs_are_copies():
    """A stage that writes into its arguments changes no result."""

    class Careless(Kanayama):
        def output(self, pose, twist, reference):
            answer = super().output(pose, twist, reference)
            pose[:], twist[:], reference[:] = 1e9, 1e9, 1e9
            return answer

    same(simulate(THREE, motion=Careless), built_in(*THREE))


@pytest.mark.parametrize(
    ("own", "message"),
    [
        ({"motor": Kanayama}, "motor: no such stage; there are motion, feedback, feedforward, steering, estimator"),
        ({"motion": lambda robot: None}, "motion <lambda>: TypeError: "),
        ({"motion": Silent}, "motion Silent: has no method reset"),
        ({"feedforward": Kanayama}, "feedforward Kanayama: has no method learn"),
        ({"feedback": lambda robot, size: robot.nothing}, "feedback <lambda>: AttributeError: "),
        ({"feedforward": "own.py:Mine"}, "feedforward: expected a class or a function, .* not an object of str"),
        ({"motion": Silent(None, 1)}, "motion: expected a class or a function, .* not an object of Silent"),
    ],
)
def test_refused(own, message):
    """An object that is not a stage is refused before anything is computed."""
    with pytest.raises(InputError, match="(?s)^" + message.replace("<", "[<]")):
        simulate(SHORT, **own)


@pytest.mark.parametrize("integral", [torch.zeros((1, 2), dtype=torch.float64), np.zeros((1, 2), int), [[0.0, 0.0]]])
def test_integral(integral):
    """An integral to which the hand-over could not write, or whose numbers it would truncate, fails the run."""

    class Own(Feedback):
        def output(self, command, twist, excess):
            self.integral = integral
            return super().output(command, twist, excess)

    failure = simulate(SHORT, feedback=Own).failure.item()
    assert failure == "feedback Own: `integral` is not a float64 array of NumPy that can be written, tick 0"


def test_raising_properties():
    """A member that is a property and raises fails the run, with one line as any other error of a stage."""

    class Own(Feedback):
        integral = weight_norm = property(lambda self: 1 / 0, lambda self, value: None)

        def __init__(self, robot, size):
            self.state = np.zeros(size, PID)

        def reset(self, *_):
            pass

        def output(self, command, *_):
            return 0 * command

        learn = reset

    for stage in ("feedback", "feedforward"):
        failure = simulate(SHORT, **{stage: Own}).failure.item()
        assert failure.startswith(f"{stage} Own: ZeroDivisionError: division by zero (test_stages.py, line ")


def test_settings_in_the_label():
    """Stages that differ in their settings alone are told apart, named as in the shell."""

    class Tuned(Kanayama):
        def __init__(self, robot, size, gain=1.0, name=""):
            super().__init__(robot, size)

    labels = [str(simulate(SHORT, motion=partial(Tuned, gain=g, name="a,b")).label.values) for g in (0.5, 2.0)]
    assert labels == [f"Tuned(gain={g}, name='a,b')" for g in (0.5, 2.0)]


def test_command_line(tmp_path, capsys):
    """A stage from a file gives the numbers of Python; the table's heading shows faults, and one line each mistake."""
    file = tmp_path / "mine.py"
    file.write_text(
        "import numpy as np\n"
        "from mrctl.control.kanayama import GAINS, kanayama, posture_error\n"
        "from mrctl.kernel import over_rows\n"
        "class Mine:\n"
        "    def __init__(self, robot, size):\n"
        "        self.calls, self.gains = 0, np.array((3.0, 25.0, 10.0), GAINS)[()]\n"
        "    def reset(self, pose, reference, period): pass\n"
        "    def output(self, pose, twist, reference):\n"
        "        self.calls += 1\n"
        "        error, request = np.empty((len(pose), 3)), np.empty((len(pose), 2))\n"
        "        over_rows(posture_error, pose, reference[:, :3], error)\n"
        "        over_rows(kanayama, error, reference[:, 3:5], self.gains, request)\n"
        "        return request\n"
        "class Stops(Mine):\n"
        "    def output(self, pose, twist, reference):\n"
        "        return super().output(pose, twist, reference) if self.calls < 50 else 1 / 0\n"
    )
    scenario = tmp_path / "scenario.toml"
    scenario.write_text(SHORT.to_toml())
    run = ["run", str(scenario)]

    def table(*more, status=0):
        assert main([*run, *more]) == status
        return capsys.readouterr().out.splitlines()

    plain, mine, stops = (
        table(), table("--controller", f"motion={file}:Mine"), table("--controller", f"motion={file}:Stops", status=1)
    )  # fmt: skip
    assert mine[1:] == plain[1:] and f"motion={file}:Mine" in mine[0]
    assert stops[1] == (
        "failed after 0.51 s: motion Stops: ZeroDivisionError: division by zero (mine.py, line 16), tick 50"
    )
    for name, message in (
        (f"{file}:Mine", "feedforward Mine: has no method learn"),
        (
            f"motor={file}:Mine",
            "controller: 'motor' is not a stage; there are motion, feedback, feedforward, steering, estimator",
        ),
        (f"motion={file}:Mine,motion={file}:Mine", "controller: motion is given twice"),
        (f"motion={file}:Other", "controller: mine.py has no Other"),
        ("motion=nowhere.py:Mine", "controller: no file nowhere.py"),
        (f"motion={file}:Mine, motion={file}:Stops", "controller: motion is given twice"),
        ("model+mine.py:Mine", "; for model before it set prior to model\n"),
        ("model+fel+motion=mine.py:Mine", "; for model+fel before it set prior to model and learner to fel\n"),
    ):
        assert main([*run, "--controller", name]) == 2
        error = capsys.readouterr().err
        assert error.count("\n") == 1 and message in error, error


def test_sweep(tmp_path):
    """A sweep takes a user's stage by its file, and its table shows a fault of the stage."""
    file = tmp_path / "mine.py"
    file.write_text(
        "import numpy as np\n"
        "class Late:\n"
        "    def __init__(self, robot, size): self.calls = 0\n"
        "    def reset(self, pose, reference, period): pass\n"
        "    def output(self, pose, twist, reference):\n"
        "        self.calls += 1\n"
        "        if self.calls > 60: raise KeyError('late')\n"
        "        return reference[:, 3:5]\n"
    )
    sweep = Sweep(base=SHORT, runs=2, controller=f"motion={file}:Late")
    report = jobs.run(sweep, tmp_path / "store", workers=1)
    assert report.failed == 2 and not report.aside
    failure = mrctl.open(tmp_path / "store").failure.values
    assert all(text == "motion Late: KeyError: 'late' (mine.py, line 7), tick 60" for text in failure)


@pytest.mark.usefixtures("here")
def test_refused_run_has_the_name_of_its_stage(tmp_path):
    """In a sweep's table, a run that could not begin counts against the controller that refused it."""
    file = tmp_path / "mine.py"
    file.write_text(
        "class Pairs:\n"
        "    def __init__(self, robot, size, gain): assert size == 2, 'not two'\n"
        "    def output(self, command, derivative): return 0 * command\n"
        "    def learn(self, feedback, frozen, twist, voltage): pass\n"
    )
    sweep = Sweep(base=SHORT, runs=3, chunk=2, controller=f"{file}:Pairs(gain=2)")
    assert jobs.run(sweep, tmp_path / "store", workers=1).failed == 1
    found = mrctl.open(tmp_path / "store")
    assert found.failed.values.tolist() == [False, False, True]
    assert set(found.feedforward.values) == set(found.label.values) == {"Pairs(gain=2)"}


def test_sweep_of_controllers(here, tmp_path, capsys, monkeypatch):
    """A sweep drives each run with its controller; it goes on with the same bytes, and with no other controller."""
    file = tmp_path / "mine.py"
    file.write_text(
        "class Gain:\n"
        "    def __init__(self, robot, size, gain): self.gain, self.size = gain, size\n"
        "    def output(self, command, derivative): return self.gain * command\n"
        "    def learn(self, feedback, frozen, twist, voltage): pass\n"
        "class Pairs(Gain):\n"
        "    def output(self, command, derivative):\n"
        "        assert self.size == 2, 'not two'\n"
        "        return 0 * command\n"
    )
    text = (
        f'runs = 2\nchunk = 3\nrecord = "decimated"\n[base]\n{SHORT.to_toml()}[[axes]]\nfield = "controller"\n'
        'values = ["fel", "mine.py:Gain(gain=2.0)", "model+mine.py:Gain(gain=0.5)", "model", "mine.py:Pairs(gain=1)"]\n'
        "paired = true\n"
    )
    (tmp_path / "sweep.toml").write_text(text)
    monkeypatch.chdir(tmp_path)
    assert main(["sweep", "sweep.toml", "--out", "store", "--workers", "1"]) == 0
    found = mrctl.open("store")
    names = ["fel", "Gain(gain=2.0)", "model+Gain(gain=0.5)", "model", "Pairs(gain=1)"]
    assert found.controller.values.tolist() == found.feedforward.values.tolist() == np.repeat(names, 2).tolist()
    assert found.failed.values.tolist() == [False] * 8 + [True] * 2  # each of whose jobs has one of these
    model = {"prior": "model"}
    for place, (fields, gain) in enumerate([(FEEDFORWARDS["fel"], None), ({}, 2.0), (model, 0.5), (model, None)]):
        own = {} if gain is None else {"feedforward": user_files.load(f"mine.py:Gain(gain={gain})")["feedforward"]}
        run = SHORT.replace(learner="none", seed=int(found.seed[2 * place])).replace(**fields)
        assert np.array_equal(simulate(run, **own).v.values[::10], found.v.values[2 * place], equal_nan=True)

    begun = Store.begin  # as another process would have left it after one of its jobs
    monkeypatch.setattr(Store, "begin", lambda path, manifest: [begun(path, manifest), jobs.compute(str(path), 2)][0])
    jobs.run(Sweep.from_toml("sweep.toml"), "again", workers=1)
    files = [f.relative_to("store") for f in Path("store").rglob("*") if f.is_file() and f.name != "lock"]
    assert all((Path("again") / f).read_bytes() == (Path("store") / f).read_bytes() for f in files)
    monkeypatch.undo()

    monkeypatch.chdir(tmp_path.parent)
    capsys.readouterr()
    for run, says in ((1, 0), (3, 1), (5, 1), (8, 1)):
        assert main(["run", str(tmp_path / "store"), "--run", str(run), *([] if says else ["--no-code"])]) == 0
        out, err = capsys.readouterr()
        assert "bit-identical" in out and err.count(f"mrctl: runs {file}:") == says
    assert main(["run", str(tmp_path / "store"), "--run", "3", "--no-code"]) == 2
    assert f"names {file}:Gain(gain=2.0), which --no-code" in capsys.readouterr().err
    monkeypatch.chdir(tmp_path)
    for old, new, message in (
        ("gain=2.0", "gain=3.0", "axes.0.values.1 .*Gain.gain=2.0.*now .*Gain.gain=3.0"),
        ("mine.py:Pairs", "lost.py:Pairs", "controller: no file lost.py"),
        ("gain=0.5", "pain=0.5", "unexpected keyword argument 'pain'"),
    ):
        (tmp_path / "sweep.toml").write_text(text.replace(old, new))
        assert main(["sweep", "sweep.toml", "--out", "store"]) == 2
        assert re.search(message, capsys.readouterr().err)
    (tmp_path / "sweep.toml").write_text(text)
    assert Library(Path("store"), code=False).recording(1).scenario.learner == "fel"  # needs no file of them
    file.write_text(file.read_text().replace("0 * command", "1 * command"))
    assert main(["sweep", "sweep.toml", "--out", "store"]) == 2
    assert f"{file}:Gain(gain=2.0) has changed" in capsys.readouterr().err
    assert main(["run", "store", "--run", "3"]) == 2 and main(["run", "store", "--run", "1"]) == 0


@pytest.mark.usefixtures("here")
def test_company(tmp_path):
    """In a sweep, a stage that raises for one run costs no other run of its job."""
    file = tmp_path / "mine.py"
    file.write_text(
        "class Picky:\n"
        "    def __init__(self, robot, size): pass\n"
        "    def reset(self, pose, reference, period): pass\n"
        "    def output(self, pose, twist, reference):\n"
        "        assert (reference[:, 3] < 0.9).all(), 'too fast'\n"
        "        return reference[:, 3:5]\n"
    )
    sweep = Sweep.from_dict(
        {
            "base": SHORT.model_dump(), "controller": f"motion={file}:Picky",
            "axes": [{"field": "reference.radius", "values": [0.5, 0.6, 0.4]}],
        }
    )  # fmt: skip
    assert jobs.run(sweep, tmp_path / "store", workers=1).failed == 1
    failed = mrctl.open(tmp_path / "store").failed.values
    assert failed.tolist() == [False, True, False]
    assert jobs.repeat(tmp_path / "store", 0).verdict == "bit-identical"
