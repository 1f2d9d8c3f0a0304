"""The two other robots in the whole loop: they track, in a batch as alone, from a file and from the shell."""

import numpy as np
import pytest

import mrctl
from mrctl import FEEDFORWARDS, Circle, Event, Fel, Lemniscate, Perturbation, RobotFile, Scenario, cli
from mrctl.experiments.paper import IDEAL
from mrctl.sensing.tiers import TIERS, Sensing
from mrctl.viewer.recording import Recording

TURTLE = {"robot": RobotFile(path="turtlebot"), "steering": "caster"}
CAR = {"robot": RobotFile(path="racecar"), "steering": "rigid"}
COURSES = {
    "turtlebot": (TURTLE, Lemniscate(size=0.6, period=14.0), Circle(radius=0.4, period=10.0)),
    "racecar": (CAR, Lemniscate(size=4.0, period=12.0), Circle(radius=1.5, period=8.0)),
}


@pytest.mark.parametrize(("name", "laps"), [("turtlebot", 8), ("racecar", 5)])
def test_learning_beats_pid(name, laps):
    """In the last of 5 or 8 laps of the lemniscate V, θ̇ and position are at least twice as good with the network."""
    robot, course, _ = COURSES[name]
    pair = [Scenario(**robot, **IDEAL, reference=course, laps=laps, learner=f) for f in ("none", "fel")]
    found = mrctl.summary(mrctl.simulate(pair, threads=1))
    assert not found["failed"].any()
    for metric in ("v_rmse", "omega_rmse", "position_rmse"):
        pid, fel = found[metric]
        print(f"{name} {metric}: {pid:.5f} PID, {fel:.5f} fel")
        assert fel < pid / 2


def scenarios(robot, course, seed):
    """Random perturbations, noise, delay, events."""
    random = np.random.default_rng(seed)

    def change():
        return Perturbation(
            mass_factor=random.uniform(0.8, 1.5), payload=random.uniform(0, 0.5), payload_x=0.05, payload_y=0.02,
            left_radius_factor=random.uniform(0.97, 1.03), resistance_factor=random.uniform(0.9, 1.3),
            supply_factor=random.uniform(0.8, 1.1), drive_friction_factor=random.uniform(0.5, 2),
            tyre_friction_factor=random.uniform(0.7, 1.0), slope=random.uniform(-0.03, 0.03),
            control_delay=random.integers(3) / 100, dead_zone=random.uniform(0, 0.2),
        )  # fmt: skip

    events = (
        Event(time=random.uniform(1, 3), perturbation=change()),
        Event(time=4.0, push=(1.0, 2.0, 0.1)),
        Event(time=5.0, learning=False),
    )
    return Scenario(
        **robot, reference=course, laps=1, seed=seed, perturbation=change(), events=events, fel=Fel(step=0.05),
        # With real sensors and the network, one in ten of these TurtleBots tips over.
        **FEEDFORWARDS[("fel", "model+composite")[seed % 2]], sensing=Sensing(tier=TIERS[seed % 2]),
        world=("flat", "patch")[seed % 3 == 0],
    )  # fmt: skip


@pytest.mark.parametrize("name", COURSES)
def test_batch_equals_single(name):
    """Each of a batch is the run alone, bit for bit, perturbed, noisy and pushed, whatever else is in the batch."""
    robot, _, course = COURSES[name]
    runs = [scenarios(robot, course, seed) for seed in range(4)]
    together = mrctl.simulate(runs, threads=2)
    for k, scenario in enumerate(runs):
        alone = mrctl.simulate(scenario)
        for signal in ("x", "y", "theta", "v", "omega", "voltage_left", "current_right", "steering_angle", "power"):
            np.testing.assert_array_equal(together[signal].values[k], alone[signal].values, err_msg=signal)
        assert str(together["failure"].values[k]) == str(alone["failure"].values) == ""


def test_together_with_the_car():
    """Different robots in one result, each as if alone."""
    mixed = [Scenario(**COURSES[n][0], reference=COURSES[n][2], laps=1) for n in COURSES]
    mixed.insert(1, Scenario(reference=Circle(radius=1.0, period=9.0), laps=1))
    result = mrctl.simulate(mixed)
    for k, scenario in enumerate(mixed):
        alone = mrctl.simulate(scenario)["x"].values
        np.testing.assert_array_equal(result["x"].values[k, : len(alone)], alone)


def test_differential_drive_reverses():
    """Nothing trails: forth and back is allowed, where the tricycle's fork would jackknife."""
    shuttle = mrctl.StopAndGo(distance=0.6, move_time=3.0, pause=0.5, reverse=True)
    result = mrctl.simulate(Scenario(**TURTLE, reference=shuttle, laps=1, prior="model", learner="none"))
    assert str(result["failure"].values) == "" and float(result["v"].min()) < -0.2
    assert float(np.abs(result["lateral_error"]).max()) < 0.1
    with pytest.raises(mrctl.InputError, match="reverses"):
        mrctl.simulate(Scenario(reference=shuttle, laps=1))


def test_kept_with_the_result(tmp_path):
    """The robot is a part of the scenario: of its file, of the saved result and of what runs again from it."""
    scenario = Scenario(**CAR, reference=COURSES["racecar"][2], laps=1)
    (tmp_path / "s.toml").write_text(scenario.to_toml())
    assert Scenario.from_toml(tmp_path / "s.toml") == scenario
    result = mrctl.simulate([scenario])
    mrctl.save(result, tmp_path / "r.zarr")
    run = mrctl.open(tmp_path / "r.zarr").isel(run=0)
    recording = Recording(run)
    assert recording.scenario == scenario
    again = mrctl.simulate(recording.scenario)
    np.testing.assert_array_equal(run["x"].values, again["x"].values)
    # A replay turns the wheels: the outer front wheel farthest, and all by the way over the radius.
    turned = {w: a[-1] for w, a in recording._wheel_angles.items()}
    assert turned["front_right"] > turned["front_left"] > turned["wheel_left"]
    radius = float(mrctl.physics.parameters.read_robot(recording.model).wheel_radius)
    way = 2 * np.pi * 1.5
    assert turned["wheel_left"] == pytest.approx(way * (1 - 0.12065 / 1.5) / radius, rel=0.05)
    qpos = recording.qpos(400)
    assert qpos.shape == (recording.model.nq,) and np.isfinite(qpos).all()


@pytest.mark.usefixtures("here")
def test_sweep(tmp_path):
    """A sweep over robots, with the digest of each."""
    pairs = [
        {"robot": {"path": n}, "steering": COURSES[n][0]["steering"], "reference": COURSES[n][2].model_dump()}
        for n in COURSES
    ]
    sweep = mrctl.Sweep.of(
        [Scenario.from_dict({**pair, "laps": 1, "prior": "none", "learner": "none"}) for pair in pairs]
    )
    assert {robot.path for _, _, robot in sweep.worlds} == set(COURSES)
    from mrctl.sweep import jobs

    report = jobs.run(sweep, tmp_path / "store", workers=1)
    assert report.failed == 0 and not report.aside


def test_command(capsys):
    """From the shell; and one line for what cannot be."""
    flags = ["--robot.path", "turtlebot", "--laps", "1", "--prior", "model", "--learner", "none", "--json"]
    assert cli.main(["run", *flags, "--steering", "caster", "reference:circle", "--reference.radius", "0.5",
                     "--reference.period", "10"]) == 0  # fmt: skip
    assert '"path": "turtlebot"' in capsys.readouterr().out
    assert cli.main(["run", *flags]) == 0  # it brings its steering, and a lemniscate that it can follow
    assert '"steering": "caster"' in capsys.readouterr().out
    assert cli.main(["run", *flags, "--steering", "rigid"]) == 2
    assert "driven with caster, not rigid" in capsys.readouterr().err
