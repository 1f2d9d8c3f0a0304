"""Motors that act later than the controller knows: the loop is calm in the end, and a calm loop is left alone."""

import numpy as np
import pytest

from mrctl import Circle, Event, Lemniscate, Perturbation, RobotFile, Scenario, per_lap, simulate
from mrctl.control.margins import Gains, sampled_loop
from mrctl.control.pid import Pid
from mrctl.experiments import single
from mrctl.physics import mjcf
from mrctl.physics.parameters import read_robot
from mrctl.results.dataset import SIGNALS
from mrctl.sensing.tiers import TIERS, Sensing
from mrctl.theory import linear
from mrctl.theory.robot import STEERINGS

LATE = 0.03
OFF = Pid(retune=False)


def late(**changes):
    """A figure of eight whose motors act 30 ms later than the controller knows."""
    settings = {"sensing": Sensing(tier="ideal"), "perturbation": Perturbation(control_delay=LATE), "learner": "none"}
    return Scenario(reference=Lemniscate(period=12.0), laps=3, **settings | changes)


@pytest.mark.parametrize("learner", ["none", "fel", "composite"])
def test_late_motors(learner):
    """Without the watch the loop oscillates for ever; with it the last lap is calm, whoever is the learner."""
    result = simulate([late(learner=learner), late(learner=learner, pid=OFF)])
    laps = per_lap(result)
    watched, left = (laps["omega_rmse"].isel(run=k).values[-1] for k in range(2))
    assert left > 0.1 and watched < 0.05 * left
    assert laps["position_rmse"].values[0, -1] < 0.5 * laps["position_rmse"].values[1, -1]
    added = result["added_delay"].values
    assert (added[1] == 0).all() and 0 < added[0, -1] <= 2 * LATE


def test_the_loop_in_theory(robot):
    """The gains in the end are stable with the true delay by the Nyquist curve of the linear loop, those before not."""
    result = simulate([late()])
    added = float(result["added_delay"].values[0, -1])
    frequency = np.geomspace(0.1, np.pi / 0.01 * 0.999, 4000)

    def peak(design):
        gains = Pid().channels(robot, False, design)[0]
        loop = sampled_loop(frequency, linear.common(robot), Gains(*gains), 0.01, LATE)
        crossing = np.flatnonzero(np.diff(np.sign(np.unwrap(np.angle(loop)) + np.pi)))
        return np.abs(loop[crossing]).max()  # the gain at a phase of −180°

    assert peak(0.0) > 1.2
    assert peak(added) < 0.9


def test_a_delay_that_comes(capsys):
    """A delay in the middle of a run; `mrctl run` says when and what was done."""
    event = Event(time=12.0, perturbation=Perturbation(control_delay=LATE))
    scenario = late(perturbation=Perturbation(), events=(event,))
    added = simulate([scenario])["added_delay"].values[0]
    assert (added[:1200] == 0).all() and added[-1] > 0
    text, _ = single.run(scenario, None, False)
    first = 0.01 * np.flatnonzero(added)[0]
    assert f"PID at {first:.2f} s: oscillates, and is designed for 10 ms more delay from now on" in text


@pytest.mark.parametrize("tier", TIERS)
@pytest.mark.parametrize("steering", STEERINGS)
def test_calm_loops_are_left_alone(tier, steering):
    """Nominal and perturbed robots without another delay have the same bits with the watch and without."""
    reference = Circle(radius=1.0, period=8.0)
    cases = [Perturbation(), Perturbation(mass_factor=1.5, drive_friction_factor=1.5, supply_factor=0.9)]
    runs = [
        Scenario(reference=reference, laps=2, steering=steering, sensing=Sensing(tier=tier), perturbation=p, pid=pid)
        for p in cases for pid in (Pid(), OFF)
    ]  # fmt: skip
    result = simulate(runs)
    assert not result["failed"].any()
    for name in SIGNALS:
        np.testing.assert_array_equal(result[name].values[::2], result[name].values[1::2])


@pytest.mark.parametrize(("name", "steering"), [("turtlebot", "caster"), ("racecar", "rigid")])
def test_other_robots(name, steering):
    """The other robots with 30 ms of unknown delay: nobody oscillates in the last lap."""
    file = RobotFile(path=name)
    speed = 0.3 * read_robot(mjcf.load(steering=steering, robot=file)).max_speed
    reference = Circle(radius=2.0, period=2 * np.pi * 2.0 / speed)
    result = simulate([
        Scenario(
            robot=file, steering=steering, reference=reference, laps=2, learner=learner, sensing=Sensing(tier="ideal"),
            perturbation=Perturbation(control_delay=LATE),
        )
        for learner in ("none", "fel")
    ])  # fmt: skip
    assert not result["failed"].any()
    assert per_lap(result)["v_rmse"].values[:, -1].max() < 0.03 * speed
