"""What acts at the motors, and where a feedforward asks for more than there is, are in the result."""

import numpy as np
import pytest

import mrctl
from mrctl import Circle, Guard, Lemniscate, Perturbation, Scenario, Sensing
from mrctl.cli import main
from mrctl.physics import mjcf
from mrctl.physics.parameters import read_robot

SIDES = "left", "right"
SUPPLY, STEPS = 24.0, 100  # V, and steps of the pulse width
# Sensors and motors of each run, and what its robot has that others have not.
RUNS = {
    "ideal": (Sensing(tier="ideal"), Perturbation()),
    "lab": (Sensing(tier="lab"), Perturbation()),
    "field": (Sensing(tier="field"), Perturbation(supply_factor=0.9, battery_resistance=0.3, current_limit=1.0)),
    "late": (
        Sensing(tier="ideal", delay=0.02, dead_zone=1.5, pwm_steps=STEPS),
        Perturbation(control_delay=0.01, supply_factor=0.8),
    ),
}


@pytest.fixture(scope="module")
def runs():
    """A lap with each."""
    lap = Scenario(reference=Lemniscate(period=9), laps=1, learner="none", prior="model")
    return {name: mrctl.simulate(lap.replace(sensing=s, perturbation=p)) for name, (s, p) in RUNS.items()}


@pytest.mark.parametrize("name", RUNS)
def test_armature(runs, name):
    """R i = U − N k ω holds with the voltage at the motor, the current of the engine, and the wheel rate at its end."""
    robot, run = read_robot(mjcf.load("flat", "compliant")), runs[name]
    for side in SIDES:
        voltage, current = run[f"motor_voltage_{side}"].values[:-1], run[f"current_{side}"].values[:-1]
        back_emf = robot.gear_ratio * robot.torque_constant * run[f"wheel_rate_{side}"].values[1:]
        np.testing.assert_allclose(robot.resistance * current, voltage - back_emf, atol=1e-9)
        assert run[f"motor_voltage_{side}"].attrs["units"] == "V"
    limit = np.abs(run[["current_left", "current_right"]].to_array()).max()
    assert (limit < 1.0 + 1e-9) == (name == "field")


def test_what_acts(runs):
    """Ideal motors get the command; others late, without what is in the dead zone, in steps, of a weak supply."""
    for side in SIDES:
        ideal, late = runs["ideal"], runs["late"]
        np.testing.assert_array_equal(ideal[f"motor_voltage_{side}"], ideal[f"voltage_{side}"])
        command, acts = (late[f"{name}_{side}"].values for name in ("voltage", "motor_voltage"))
        driven = np.where(np.abs(command) < 1.5, 0.0, command)[:-3]
        np.testing.assert_allclose(acts[3:], 0.8 * SUPPLY / STEPS * np.rint(STEPS * driven / SUPPLY), atol=1e-9)
        assert np.abs(acts - command).max() > 3.0


class Demands:
    """A feedforward that asks for more than the supply after one second."""

    def __init__(self, robot, size):
        self.size, self.calls = size, 0

    def output(self, command, derivative):
        self.calls += 1
        return np.tile([-40.0 if self.calls > 101 else 1.0, 0.0], (self.size, 1))

    def learn(self, feedback, frozen, twist, voltage):
        pass


@pytest.mark.parametrize("steering", ["compliant", "rigid"])
def test_feedforward_limited(steering):
    """The guard limits it to the supply and says so; without the guard, and for a modest one, the signal is 0."""
    lap = Scenario(laps=1, reference=Circle(radius=0.8, period=4), steering=steering)
    found = mrctl.simulate(lap, feedforward=Demands)
    limited = found.feedforward_limited.values
    assert not limited[:100].any() and limited[101:].all()
    assert np.abs(found.feedforward_left.values[:103] + found.feedforward_right.values[:103]).max() <= 2 * SUPPLY + 1e-9
    bare = mrctl.simulate(lap.replace(guard=Guard(on=False)), feedforward=Demands)
    assert np.abs(bare.feedforward_left.values[101]) > 39 and bare.saturated.values[101] == 1
    assert not np.nan_to_num(bare.feedforward_limited).any()
    assert not mrctl.simulate(lap.replace(prior="model")).feedforward_limited.any()


OUTPUTS = {  # of the feedforward, and what the guard limits it to
    "np.tile([40.0, 0.0], (len(command), 1))": ("compliant", "the supply"),
    # with steered wheels the second channel is no voltage: 9 rad/s are beyond the largest yaw rate
    "command * [self.per_speed, 0.0] + [0.0, 9.0]": ("rigid", "the supply or the largest yaw rate"),
}


@pytest.mark.parametrize("output", OUTPUTS)
def test_run_says_so(output, tmp_path, monkeypatch, capsys):
    """`mrctl run` prints for how long; the table's saturation counts limits on the sum alone."""
    steering, bound = OUTPUTS[output]
    monkeypatch.chdir(tmp_path)
    (tmp_path / "own.py").write_text(
        "import numpy as np\n"
        "class Demands:\n"
        "    def __init__(self, robot, size): self.per_speed = 1 / robot.velocity_gain\n"
        f"    def output(self, command, derivative): return {output}\n"
        "    def learn(self, *given): pass\n"
    )
    words = ["--steering", steering, "--controller", "own.py:Demands", "reference:circle"]
    assert main(["run", "--laps", "1", *words]) == 0
    line = next(line for line in capsys.readouterr().out.splitlines() if line.startswith("feedforward beyond"))
    assert line.endswith(f"from 0.00 s on: the guard limited it to {bound}")


class Constant:
    """Requests one twist all the time, whatever the reference is."""

    twist = 0.0, 0.0

    def __init__(self, robot, size):
        self._request = np.tile(self.twist, (size, 1))

    def reset(self, pose, reference, period):
        pass

    def output(self, pose, twist, reference):
        return self._request


@pytest.mark.parametrize("rotation", [0.1, 0.5, 1.0])
def test_saturated_motors_turn(rotation):
    """Under `all` a TurtleBot that is asked for 0.58 m/s reaches at most 0.48, and drives the arc that it is asked for.

    If each voltage were cut by itself, it would drive straight on.
    """
    asked = type("Asked", (Constant,), {"twist": (0.58, rotation)})
    heavy = Scenario(robot="turtlebot", learner="none", perturbation=mrctl.PERTURBATIONS["all"], laps=1)
    result = mrctl.simulate(heavy.replace(reference=mrctl.Line(speed=0.5, length=4.0)), motion=asked)
    steady = result.sel(time=slice(3.0, 4.5))  # later it is 1 m off the line
    assert (steady["saturated"] == 1).all() and steady["v"].max() < 0.5
    curvature = float(steady["omega"].mean() / steady["v"].mean())
    assert curvature == pytest.approx(rotation / 0.58, rel=0.05)
