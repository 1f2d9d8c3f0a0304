"""Robot i of a batch is the same scenario run alone: bit for bit, whatever runs beside it, on any number of threads."""

from importlib import import_module

import numpy as np
import pytest

import mrctl
from mrctl import (
    FEEDFORWARDS,
    Box,
    Circle,
    Disc,
    Event,
    Fel,
    InputError,
    Kanayama,
    LaneChange,
    Lemniscate,
    Line,
    Obstacles,
    Perturbation,
    Pid,
    Polygon,
    RobotFile,
    Scenario,
    StopAndGo,
    Sweep,
)
from mrctl.loop.groups import group_of, uniform
from mrctl.loop.runs import simulate
from mrctl.loop.simulation import Simulation
from mrctl.physics.obstacles import layout
from mrctl.physics.plant import BatchPlant, PhysicsPlant
from mrctl.results.dataset import SIGNALS
from mrctl.sensing.tiers import TIERS, Sensing
from mrctl.sweep import jobs
from mrctl.sweep.pool import JobOutcome
from mrctl.sweep.store import Store

pytestmark = pytest.mark.xdist_group("batch_equals_single")  # what its tests share is made once

COUNTS = [60, pytest.param(200, marks=pytest.mark.full)]  # of scenarios in the usual run, and with `pytest -m full`
REFERENCES = (  # four seconds each, so that they share batches, but for the last two
    Circle(period=4, radius=0.5),
    Circle(period=4, radius=0.6, clockwise=True),
    Line(speed=0.5, length=2.0),
    LaneChange(length=2.4, shift=0.3, speed=0.6),
    StopAndGo(distance=0.8, move_time=3, pause=1, reverse=False),
    Line(speed=0.8, length=2.0),
    Lemniscate(size=1.2, period=8),
)
RANGES = {
    "mass_factor": (0.6, 2.0),
    "inertia_factor": (0.6, 2.0),
    "payload": (0.0, 6.0),
    "payload_x": (0.02, 0.2),
    "payload_y": (-0.08, 0.08),
    "payload_z": (0.1, 0.4),
    "left_radius_factor": (0.95, 1.05),
    "right_radius_factor": (0.95, 1.05),
    "drive_friction_factor": (0.0, 3.0),
    "resistance_factor": (0.8, 1.5),
    "motor_constant_factor": (0.8, 1.2),
    "left_drive_friction_factor": (0.5, 1.5),
    "right_resistance_factor": (0.9, 1.2),
    "left_motor_constant_factor": (0.95, 1.05),
    "dead_zone": (0.1, 0.6),
    "current_limit": (1.5, 8.0),
    "battery_resistance": (0.02, 0.3),
    "steering_offset": (-0.02, 0.02),
    "steering_backlash": (0.001, 0.02),
    "supply_factor": (0.7, 1.2),
    "tyre_friction_factor": (0.3, 1.2),
    "slope": (-0.1, 0.1),
}

SENSES = {
    "encoder_counts": (50, 100_000),
    "gyro_noise": (0.0, 0.002),
    "gyro_bias": (0.0, 0.02),
    "gyro_walk": (0.0, 0.001),
    "accelerometer_noise": (0.0, 0.01),
    "accelerometer_bias": (0.0, 0.3),
    "accelerometer_walk": (0.0, 0.01),
    "fix_position_noise": (0.0, 0.03),
    "fix_heading_noise": (0.0, 0.02),
    "fix_lost": (0.0, 0.5),
    "fix_outliers": (0.0, 0.3),
    "dead_zone": (0.0, 0.5),
    "current_limit": (4.0, 12.0),
    "battery_resistance": (0.0, 0.2),
    "steering_offset": (-0.02, 0.02),
    "steering_backlash": (0.0, 0.02),
}
SENSORS = ("encoder", "gyro", "accelerometer", "fix")


def sensing(rng: np.random.Generator, alike: bool) -> Sensing:
    """Any tier and estimator, with a third of the fields at random: noise, rates, latencies, driver and steering."""
    values = {name: float(rng.uniform(*bounds)) for name, bounds in SENSES.items() if rng.random() < 0.35}
    if "encoder_counts" in values:
        values["encoder_counts"] = int(values["encoder_counts"])
    for name in SENSORS:
        if rng.random() < 0.35:
            values[f"{name}_rate"] = float(rng.choice([50, 25, 20]))
        if rng.random() < 0.35:
            values[f"{name}_latency"] = int(rng.integers(5)) / 100
    values["delay"] = 0.01 if alike else int(rng.integers(4)) / 100
    estimator = "ekf" if alike else str(rng.choice(["truth", "odometry", "ekf", "ekf"]))
    return Sensing(tier=str(rng.choice(TIERS)), estimator=estimator, **values)


def perturbation(rng: np.random.Generator) -> Perturbation:
    """A third of the fields at random, among them delays of 0 to 40 ms."""
    values = {name: float(rng.uniform(*bounds)) for name, bounds in RANGES.items() if rng.random() < 0.35}
    return Perturbation(**values, pwm_steps=int(rng.choice([0, 100, 255])), control_delay=int(rng.integers(5)) / 100)


def event(rng: np.random.Generator) -> Event:
    """One of everything that can happen."""
    what = (
        {"perturbation": perturbation(rng)},
        {"push": tuple(rng.normal(0, [60, 60, 5])), "push_duration": float(rng.uniform(0.01, 0.2))},
        {"kanayama": Kanayama(k_x=float(rng.uniform(1, 4)), k_y=20, k_theta=9)},
        {"pid": Pid(time_constant=0.2, derivative_time=float(rng.uniform(0, 0.01)))},
        {"learning": bool(rng.integers(2))},
    )
    return Event(time=float(rng.uniform(0, 4)), **what[rng.integers(len(what))])


def scenario(seed: int) -> Scenario:
    """A random run; a third are alike enough to share one large batch."""
    rng = np.random.default_rng(60 + seed)
    alike = seed % 3 == 0
    steering = "compliant" if alike else str(rng.choice(["compliant", "caster", "rigid"]))
    reference = REFERENCES[rng.integers(len(REFERENCES) - 2 * alike)]
    if steering == "rigid" and rng.random() < 0.3:
        reference = StopAndGo(distance=0.5, move_time=1.5, pause=0.5, reverse=True)
    return Scenario(
        reference=reference,
        laps=1,
        steering=steering,
        world="flat" if alike else str(rng.choice(["flat", "flat", "flat", "slope", "rough", "patch"])),
        **FEEDFORWARDS["fel" if alike else str(rng.choice(list(FEEDFORWARDS)))],  # type: ignore[index]
        sensing=sensing(rng, alike),
        kanayama=Kanayama(k_x=float(rng.uniform(2, 4))),
        fel=Fel(step=float(rng.uniform(0, 0.1))),
        perturbation=perturbation(rng) if rng.random() < 0.8 else Perturbation(),
        events=tuple(event(rng) for _ in range(rng.integers(4))),
        prefilter=float(rng.uniform(0.03, 0.1)),
        motion_period=0.01 if alike else float(rng.choice([0.01, 0.02])),
        physics_step=0.002 if alike or seed % 2 else 0.005,
        seed=seed,
    )


def equipped(seed: int) -> Scenario:
    """The same run in the tier lab or field, with every sensor slow, late and noisy and every effect of the driver."""
    rng = np.random.default_rng(1000 + seed)
    values: dict[str, object] = {k: float(rng.uniform(max(a, b / 10), b)) for k, (a, b) in SENSES.items()}
    values["encoder_counts"] = int(rng.integers(50, 100_000))
    values |= {f"{name}_rate": float(rng.choice([50, 25, 20])) for name in SENSORS}
    values |= {f"{name}_latency": int(rng.integers(1, 5)) / 100 for name in SENSORS}
    values |= {"tier": ("lab", "field")[seed % 2], "delay": int(rng.integers(1, 4)) / 100}
    return scenario(seed).replace(
        sensing=Sensing.from_dict({**values, "estimator": ("ekf", "odometry")[seed // 2 % 2]})
    )


@pytest.fixture(scope="module", params=COUNTS)
def scenarios(request):
    """All of them; the last one is pushed off its way."""
    *drawn, last = (scenario(seed) for seed in range(request.param))
    return [*drawn, last.replace(events=(Event(time=0.3, push=(0.0, 900.0, 0.0)),))]


@pytest.fixture(scope="module")
def alone(scenarios):
    """Each by itself, through dm_control."""
    return [simulate(s) for s in scenarios]


def equal(one, whole, run: int) -> None:
    """Every variable of a run alone has the same bits in a batch, which goes on in NaN."""
    row = whole.isel(run=run)
    for name in set(one.variables) - {"run", "time", "weight"}:
        expected, found = one.variables[name].values, row.variables[name].values
        if "time" in row.variables[name].dims or name == "weights":
            found, rest = found[: len(expected)], found[len(expected) :]
            assert np.isnan(rest).all(), name
        same = np.array_equal(expected, found, equal_nan=expected.dtype.kind == "f")
        assert same, f"{name} of seed {int(one.seed)}"
    assert ("weights" in one) or "weights" not in row or row.weights.isnull().all()


def test_plants(scenarios):
    """One run goes through dm_control, several through the batch engine."""
    assert isinstance(Simulation(scenarios[:1]).plant, PhysicsPlant)
    assert isinstance(Simulation(scenarios[:1] * 2).plant, BatchPlant)


def test_scenarios_differ(scenarios, alone):
    """The draw covers what it should: every kind of event, failures but not too many, delays, learning, all worlds."""
    events = [e for s in scenarios for e in s.events]
    for field in ("perturbation", "push", "kanayama", "pid", "learning"):
        assert any(getattr(e, field) is not None for e in events)
    for field, kinds in {"world": 4, "steering": 3, "feedforward": len(FEEDFORWARDS), "motion_period": 2}.items():
        assert len({getattr(s, field) for s in scenarios}) == kinds
    assert {s.sensing.tier for s in scenarios} == set(TIERS)
    assert {s.sensing.source for s in scenarios} == {"truth", "odometry", "ekf"}
    assert {s.perturbation.control_delay for s in scenarios} == {0, 0.01, 0.02, 0.03, 0.04}
    assert 1 <= sum(bool(run.failed) for run in alone) <= len(alone) // 4


@pytest.mark.parametrize("chunk", [200, 7])
def test_equal(scenarios, alone, chunk):
    """Shuffled, all at once, and 28 of them in chunks of seven; all of them with the mark `full`."""
    order = np.random.default_rng(chunk).permutation(len(scenarios))
    if len(scenarios) < 200 and chunk == 7:
        order = order[:28]
    for start in range(0, len(order), chunk):
        rows = order[start : start + chunk]
        whole = simulate([scenarios[row] for row in rows])
        for run, row in enumerate(rows):
            equal(alone[row], whole, run)


@pytest.mark.parametrize("threads", [1, 2])
def test_threads(scenarios, alone, threads, monkeypatch):
    """The number of threads changes nothing; a batch of one is no special case either."""

    def build(models, robot, substeps, _, obstacles):
        return BatchPlant(models, robot, substeps, threads, obstacles)

    monkeypatch.setattr(import_module("mrctl.loop.simulation"), "build", build)
    rows = range(0, len(scenarios), 3)
    whole = simulate([scenarios[row] for row in rows])
    for run, row in enumerate(rows):
        equal(alone[row], whole, run)
    equal(alone[1], simulate([scenarios[1]]), 0)


def surroundings(seed: int) -> Obstacles:
    """Four to seven obstacles around the way of a robot, one of which moves across it; one is a polygon."""
    rng = np.random.default_rng(500 + seed)
    shapes = []
    for k in range(int(rng.integers(4, 8))):
        away, angle = rng.uniform(0.9, 3.0), rng.uniform(-np.pi, np.pi)
        x, y = away * np.cos(angle), 0.5 + away * np.sin(angle)
        if k == 0:
            shapes.append(Polygon(points=((x, y), (x + 0.3, y), (x, y + 0.4))))
        elif k == 1:
            course = Line(speed=float(rng.uniform(0.1, 0.4)), heading=angle)
            shapes.append(Disc(x=-away, radius=0.15, course=course))  # relative to the start of its course
        elif rng.random() < 0.5:
            shapes.append(Box(x=x, y=y, angle=float(rng.uniform(0, 3)), length=0.4, width=0.2))
        else:
            shapes.append(Disc(x=x, y=y, radius=float(rng.uniform(0.05, 0.3))))
    return Obstacles(shapes=tuple(shapes))


@pytest.mark.parametrize("localisation", ["fixes", "particles", "scan"])
def test_worlds(localisation):
    """Robots in worlds that all differ go in one batch, with their own maps, scans, perturbations and collisions."""
    runs = [
        scenario(3 * seed).replace(
            obstacles=surroundings(seed),
            map=surroundings(seed // 2).still,  # of two robots one has a wrong map
            robot=RobotFile(),
            reference=Circle(period=4, radius=0.5),
            sensing=Sensing(localisation=localisation),
        )
        for seed in range(5)
    ]
    alone = [simulate(run) for run in runs]
    for rows in [*range(5)], *([[4, 2]] if localisation != "particles" else []):
        assert len({group_of(runs[row]) for row in rows}) == 1
        whole = simulate([runs[row] for row in rows])
        for run, row in enumerate(rows):
            equal(alone[row], whole, run)
    ends = [str(run["failure"].values) for run in alone]
    assert 1 <= ends.count("collision") <= 4


def test_layouts():
    """Worlds are kept apart where the engine cannot take them together, or one would pay for the other's geoms."""
    disc, box = Disc(x=3), Box(x=3)
    triangle, square = (Polygon(points=((2, 2), (3, 2), (2, 3), (1, 2.5))[:n]) for n in (3, 4))
    moving = Disc(x=3, course=Line())
    together = [(disc, box), (box, disc), (disc, disc, disc)], [(triangle, disc), (box, triangle, box)]
    apart = [(), (disc, box), (triangle, disc), (square, disc), (moving, disc)]
    assert len({layout(Obstacles(shapes=shapes)) for shapes in apart}) == len(apart)
    for group in together:
        assert len({layout(Obstacles(shapes=shapes)) for shapes in group}) == 1
        Simulation([Scenario(obstacles=Obstacles(shapes=shapes)) for shapes in group])
    counts = [1, 2, 3, 4, 7, 8]
    rows = uniform([Scenario(obstacles=Obstacles(shapes=(disc,) * count)) for count in counts])
    assert [[counts[row] for row in group] for group in rows] == [[1], [2, 3], [4, 7], [8]]


def first_half(path: str, job: int) -> JobOutcome:
    """The sweep stops after half of its jobs."""
    return JobOutcome(job, error="half", fatal=True) if job >= Store(path).jobs // 2 else jobs.compute(path, job)


SWEPT = (3, 3), pytest.param((100, 50), marks=pytest.mark.full)


@pytest.mark.parametrize("counts", SWEPT, ids=lambda counts: "-".join(map(str, counts)))
def test_sweep(counts, here, monkeypatch, tmp_path):
    """A sweep that is interrupted after half of its jobs has the bits of runs alone in the end, and so has a repeat.

    The counts are those of runs with all sensors and all effects of the driver, and with a random subset of them.
    """
    drawn = [make(seed) for make, number in zip((equipped, scenario), counts, strict=True) for seed in range(number)]
    sweep, store, count = Sweep.of(drawn, record="full", chunk=3), tmp_path / "store", len(drawn)
    with pytest.raises(InputError, match="half"):
        jobs.run(sweep, store, 1, work=first_half)
    assert len(Store(store).done()) == Store(store).jobs // 2 > 0
    monkeypatch.undo()  # other processes do the rest
    assert jobs.run(sweep, store, 2).runs == count
    opened = mrctl.open(store)
    for run, own in enumerate(drawn):
        one, row = simulate(own), opened.isel(run=run)
        for name in SIGNALS:
            found = row[name].values
            assert found[: one.sizes["time"]].tobytes() == one[name].values.tobytes(), f"{name} of run {run}"
            assert np.isnan(found[one.sizes["time"] :]).all()
        assert str(row["failure"].values) == str(one["failure"].values)
        assert jobs.repeat(store, run) == ("bit-identical", True)
    print(f"{count} runs, {int(opened['failed'].sum())} of them failed, are the same alone, in the sweep and repeated")


@pytest.mark.parametrize("wrong", ["scenario.toml", 3, [Scenario(), None], []])
def test_no_scenarios(wrong):
    """What is no scenario is refused with one line that names the argument."""
    with pytest.raises(InputError, match="^scenarios: "):
        simulate(wrong)
    with pytest.raises(InputError, match="^scenarios: "):
        Simulation(wrong)


def test_not_together():
    """A simulation refuses scenarios of several groups, whose robots it would all drive as the first one."""
    one = Scenario()
    for other, fields in ((one.replace(learner="rls"), "learner"), (one.replace(robot="turtlebot"), "robot, steering")):
        with pytest.raises(InputError, match=f"^scenarios: 0 and 2 differ in {fields}, "):
            Simulation([one, one, other])
