"""Estimators in the loop: the filter knows how wrong it is, survives what robots meet, and a user's own replaces it."""

import math
from functools import cache

import numpy as np
import pytest
from scipy.stats import chi2

from mrctl import (
    Box,
    Circle,
    Event,
    InputError,
    LaneChange,
    Lemniscate,
    Obstacles,
    Perturbation,
    RobotFile,
    Scenario,
    Sweep,
    simulate,
)
from mrctl.cli import main
from mrctl.loop.groups import suited
from mrctl.loop.simulation import Simulation
from mrctl.physics.tyres import measure
from mrctl.results.dataset import GAIN_VARIABLES, SIGNALS
from mrctl.scenario import replicates
from mrctl.sensing import ekf
from mrctl.sensing.prediction import wrapped
from mrctl.sensing.tiers import Sensing

SETTLED, APART = 300, 337  # ticks before the first look at the errors, and from one look to the next
TIERS = "lab", "field"
POSTURE, POSTURE_AND_TWIST = [0, 1, 2], [0, 1, 2, 3, 4]
STATES = "x", "y", "theta", "v", "omega"


def watched(scenarios):
    """Returns what the filters of a group of runs believed, tick by tick.

    Returns:
        Errors of posture and twist `(ticks, B, 5)`, their covariances `(ticks, B, 5, 5)`, the normalised innovations
        squared of the fixes, NaN where none arrived `(ticks, B)`, and which robots failed `(B,)`.
    """
    simulation = Simulation(scenarios)
    length, size = simulation.ticks, len(scenarios)
    errors, covariances = np.full((length, size, 5), np.nan), np.full((length, size, 5, 5), np.nan)
    innovations = np.full((length, size), np.nan)
    while simulation.running:
        seen, tick = simulation.sense()[0], simulation.tick
        true = np.hstack([simulation.plant.reading["pose"], simulation.plant.reading["twist"]])
        error = seen["estimate"] - true
        error[:, 2] = np.pi - (np.pi - error[:, 2]) % (2 * np.pi)
        errors[tick], covariances[tick] = error, simulation.estimator.memory["P"][:, :5, :5]
        arrived = ~np.isnan(seen["fix"][:, 0])
        innovations[tick] = np.where(arrived, simulation.estimator.memory["nis"], np.nan)
        simulation.step()
    return errors, covariances, innovations, simulation.plant.stopped.copy()


def normalised(errors, covariances, states=slice(None)):
    """Returns errors squared over their covariances, eᵀ P⁻¹ e."""
    e, P = errors[..., states], covariances[..., states, :][..., states]
    return np.einsum("...i,...i", e, np.linalg.solve(P, e[..., None])[..., 0])


@cache
def nominal(tier, runs):
    """Returns what `watched` does of nominal robots; their seeds are not among those that the filter was tuned with."""
    scenario = Scenario(sensing=Sensing(tier=tier, estimator="ekf"), prior="model", learner="composite", laps=2)
    return watched([scenario.model_copy(update={"seed": 1000 + k}) for k in range(runs)])


MANY = [pytest.param(tier, 100, marks=pytest.mark.full) for tier in TIERS]


NOMINAL = pytest.mark.xdist_group("nominal")  # whose tests share what is driven


@NOMINAL
@pytest.mark.parametrize(("tier", "runs"), [("lab", 24), ("field", 24), *MANY])
def test_consistent(tier, runs):
    """The errors of nominal robots are as large as the filter says; `pytest -m full` takes 100 runs.

    Errors squared over their covariance (NEES) of posture and twist are of chi-square with 3 and 5 degrees of freedom.
    Of the looks, 3.37 s apart, so that a lap of 12 s is seen at other places, nearly all means over the runs are in the
    band of 95 %, and so is the mean over all ticks. Innovations of the fixes (NIS) are white: their means are in the
    band at nearly every fix.
    """
    errors, covariances, innovations, failed = nominal(tier, runs)
    assert not failed.any()
    whole = errors, covariances
    errors, covariances = errors[SETTLED::APART], covariances[SETTLED::APART]
    for states in POSTURE, POSTURE_AND_TWIST:
        found = normalised(errors, covariances, states)
        low, high = chi2.ppf((0.025, 0.975), runs * len(states)) / runs
        means = found.mean(1)
        # Of the 7 looks all are inside with 24 runs; with 100 runs one look at the posture is not.
        assert np.sum((means < low) | (means > high)) <= 1, (low, high, means)
        # At every tick the share is 0.825 and 0.819 in `lab`, 0.876 and 0.948 in `field` (100 runs); with 24 runs,
        # whose bands are wider, it is at least 0.91.
        every = normalised(*whole, states)[SETTLED:].mean(1)
        least = {24: 0.88, 100: {"lab": 0.8, "field": 0.85}[tier]}[runs]
        assert np.mean((every > low) & (every < high)) > least
        # All looks and all ticks together, which are not independent: the errors of a run last for some seconds.
        assert low < means.mean() < high and low < every.mean() < high
        assert np.mean(found < chi2.ppf(0.95, len(states))) > 0.9
    for k, name in enumerate(STATES):
        found = normalised(errors, covariances, [k])
        assert 0.7 < found.mean() < 1.4, name
        assert np.mean(found < 9) > 0.98, name
    innovations = innovations[SETTLED:]
    innovations = innovations[~np.isnan(innovations).all(1)]
    number = 3 * np.sum(~np.isnan(innovations), axis=1)
    sums = np.nansum(innovations, axis=1)
    inside = (sums > chi2.ppf(0.025, number)) & (sums < chi2.ppf(0.975, number))
    assert inside.mean() > 0.9
    assert np.nansum(innovations) / number.sum() == pytest.approx(1, abs=4 * np.sqrt(2 / number.sum()) + 0.01)


@NOMINAL
@pytest.mark.parametrize("tier", TIERS)
def test_start(tier):
    """V is as wrong as the filter says from the first tick on, though the motors brake until a voltage comes."""
    errors, covariances, _, _ = nominal(tier, 24)
    early = normalised(errors[:100], covariances[:100], [3])
    assert early.mean(1).max() < 5 and np.mean(early < 9) > 0.94


@pytest.mark.parametrize("tier", TIERS)
@pytest.mark.parametrize("latency", [0.03, 0.1])
def test_late_samples(tier, latency):
    """The variances of a result are those of the estimate that it records, which late samples do not show yet.

    Over the latency the robots accelerate other than commanded: little with a good model, much where PID alone drives a
    robot that is heavy and weak. Without what the predictions missed, the errors of V squared over their variances are
    up to 1e5.
    """
    names = "encoder_latency", "gyro_latency", "accelerometer_latency"
    late = dict.fromkeys(names, latency) | {"fix_latency": max(latency, 0.05)}
    run = Scenario(sensing=Sensing(tier=tier, **late), learner="none", laps=1)
    for changes in ({"prior": "model"}, {"perturbation": "all"}):
        result = simulate([run.replace(seed=seed, **changes) for seed in range(6)])
        assert not result.failed.any()
        for name in STATES:
            error = (result[f"{name}_measured"] - result[name]).values[:, SETTLED:]
            error = np.pi - (np.pi - error) % (2 * np.pi) if name == "theta" else error
            found = np.mean(error**2 / result[f"variance_{name}"].values[:, SETTLED:])
            assert 0.25 < found < 2.2, (changes, name, found)


# Medians in mm that the README of `sensing` states: figure of eight and circle in `lab`, then both in `field`.
RADII = {
    (0.97, 1.0): (0.39, 2.4, 2.2, 8.9),
    (1.02, 1.0): (0.35, 2.4, 2.6, 3.0),
    (0.97, 0.98): (0.36, 0.76, 2.3, 6.5),
    (0.97, 0.97): (0.45, 0.51, 2.1, 7.7),
}


@pytest.mark.full
@pytest.mark.parametrize("factors", RADII)
def test_radii_as_stated(factors):
    """Median and largest error of the estimated position in the last lap, over 8 runs, where radii change after 3 s."""
    worn = Perturbation(left_radius_factor=factors[0], right_radius_factor=factors[1])
    found = []
    for tier in TIERS:
        for reference, laps in ((Lemniscate(), 3), (Circle(radius=0.8, period=5.0), 6)):
            changes = {"reference": reference, "laps": laps, "events": (Event(time=3.0, perturbation=worn),)}
            scenario = Scenario(sensing=Sensing(tier=tier, estimator="ekf"), learner="none", **changes)
            runs = simulate([scenario.replace(seed=seed) for seed in range(8)])
            last = runs.isel(time=slice(-round(reference.period / 0.01), None))
            error = 1e3 * np.hypot(last.x_measured - last.x, last.y_measured - last.y)
            each = np.sqrt((error**2).mean("time")).values
            print(factors, tier, reference.kind, f"{np.median(each):.2f} {each.max():.2f} mm")
            found.append(np.median(each))
    assert found == pytest.approx(RADII[factors], rel=0.05)


@pytest.mark.parametrize(
    ("tier", "localisation"), [("lab", "fixes"), ("field", "fixes"), ("lab", "scan"), ("field", "particles")]
)
def test_radii_of_nominal_robots_are_not_doubted(tier, localisation):
    """While nothing changes, the filter hardly ever takes its innovations for those of wheels of other radii."""
    walls = (Box(x=0, y=2.5, length=6, width=0.2), Box(x=0, y=-2.5, length=6, width=0.2))
    sensing = Sensing(tier=tier, localisation=localisation)
    scenario = Scenario(sensing=sensing, laps=2, prior="model", learner="none", obstacles=Obstacles(shapes=walls))
    simulation = Simulation([scenario.replace(seed=2000 + k) for k in range(12)])
    before, doubts = np.zeros((12, 2)), 0
    while simulation.running:
        simulation.step()
        means = simulation.estimator.memory["drift"].copy()  # which begin again at exactly 0
        doubts += np.sum((means == 0).all(axis=1) & (before != 0).any(axis=1))
        before = means
    assert not simulation.plant.stopped.any() and doubts <= 1


# What a robot meets: changes of the scenario, and the least share of time in which each of posture and twist is within
# three standard deviations. A lifted wheel, whose encoder still counts, turns the heading by up to 4 mrad where the
# filter believes in 0.5 mrad. Over 48 runs each, x, y, θ, V and θ̇ are within three standard deviations in this share of
# the time: with a lifted wheel 0.995, 0.993, 0.90, 0.99, 0.99 in `lab` and 0.995, 0.997, 0.96, 0.93, 0.99 in `field`;
# with the left wheel on ice 0.99, 0.99, 0.88, 0.87, 0.96 in `lab` and 0.996, 0.99, 0.93, 0.83, 0.97 in `field`.
MEETS = {
    "lost fixes": ({"fix_lost": 0.5}, {}, (0.98,) * 5),
    "outlying fixes": ({"fix_outliers": 0.2}, {}, (0.98,) * 5),
    "lifted wheel": (
        {}, {"perturbation": Perturbation(payload=12, payload_y=-0.2, payload_z=0.8)}, (0.93, 0.93, 0.88, 0.9, 0.93)
    ),
    "lifted wheel, as if on the ground": ({}, {}, (0.93,) * 5),  # by the drives of `lifted wheel`
    "slipping wheel": (
        {}, {"perturbation": Perturbation(left_tyre_friction_factor=0.1 / 0.9)}, (0.96, 0.96, 0.83, 0.78, 0.94)
    ),
}  # fmt: skip


WANTED = pytest.mark.xfail(strict=True, reason="the encoder of a lifted wheel is believed")
LIFTED = pytest.mark.xdist_group("lifted")  # whose tests share what is driven
BELIEVED = "lab", "lifted wheel, as if on the ground"
MET = [(t, n) for n in MEETS for t in TIERS]


@cache
def met(tier, name):
    """Returns what `watched` does of robots that meet what the first words of a name of `MEETS` say."""
    sensing, changes, _ = MEETS[name]
    scenario = Scenario(
        sensing=Sensing(tier=tier, estimator="ekf", **sensing), prior="model", learner="composite", laps=1, **changes
    )
    seeds = range(24 if name == "lifted wheel" else 12)
    return watched([scenario.model_copy(update={"seed": k}) for k in seeds])


@pytest.mark.parametrize("factor", [0.97, 1.02])
@pytest.mark.parametrize(("tier", "position", "speed"), [("lab", 1e-3, 1e-3), ("field", 15e-3, 1.5e-3)])
def test_radius_changes(tier, position, speed, factor):
    """A wheel that has another radius from one moment on is not taken for one that slips for the rest of the run."""
    event = Event(time=3.0, perturbation=Perturbation(left_radius_factor=factor))
    scenario = Scenario(sensing=Sensing(tier=tier, estimator="ekf"), laps=2, events=(event,))
    runs = simulate([scenario.replace(seed=seed) for seed in range(4)])
    assert not runs.failed.any()
    second = runs.isel(time=slice(runs.sizes["time"] // 2, None))
    error = np.hypot(second.x_measured - second.x, second.y_measured - second.y)
    assert np.sqrt((error**2).mean("time")).max() < position
    assert abs((second.v_measured - second.v).mean("time")).max() < speed


@pytest.mark.parametrize(
    ("tier", "factors", "reference", "position"),
    [
        ("lab", (0.97, 0.97), Lemniscate(), 1e-3),
        ("field", (0.97, 0.97), Lemniscate(), 8e-3),
        ("lab", (0.97, 0.98), Circle(radius=0.8, period=5.0), 2e-3),
        ("field", (1.02, 1.0), Circle(radius=0.8, period=5.0), 10e-3),
    ],
)
def test_radius_changes_unseen_by_the_gyro(tier, factors, reference, position):
    """Where both wheels change alike, or forces always act, the fixes tell that a radius has changed."""
    worn = Perturbation(left_radius_factor=factors[0], right_radius_factor=factors[1])
    scenario = Scenario(
        sensing=Sensing(tier=tier, estimator="ekf"),
        reference=reference,
        learner="none",
        events=(Event(time=3.0, perturbation=worn),),
    )
    laps = 3 if reference.kind == "lemniscate" else 6
    runs = simulate([scenario.replace(seed=seed, laps=laps) for seed in range(6)])
    assert not runs.failed.any()
    last = runs.isel(time=slice(-round(reference.period / 0.01), None))
    error = np.hypot(last.x_measured - last.x, last.y_measured - last.y)
    assert np.sqrt((error**2).mean("time")).max() < position


@pytest.mark.parametrize(
    ("tier", "name"),
    [pytest.param(t, n, marks=[LIFTED] * n.startswith("lifted") + [WANTED] * ((t, n) == BELIEVED)) for t, n in MET],
)
def test_within_three_deviations(tier, name):
    """With lost or outlying fixes or a wheel off the ground, errors stay where the filter says; on ice, less often."""
    errors, covariances, innovations, failed = met(tier, name.split(",")[0])
    assert not failed.any()
    short = False
    for k, share in enumerate(MEETS[name][2]):
        within = (normalised(errors, covariances, [k])[SETTLED:] < 9).mean()
        if (tier, STATES[k], name) == ("field", "v", "lifted wheel, as if on the ground") and 0.92 < within < share:
            short = True
            continue
        assert within >= share, STATES[k]
    if short:
        pytest.xfail("V: 0.929 of 96 draws; with the usual 24 it depends on the processor on which side of 0.93 it is")
    if name == "outlying fixes":  # of which hardly one lies within the gate
        refused = np.mean(innovations[~np.isnan(innovations)] > ekf.FIX_GATE)
        assert 0.15 < refused < 0.25
    if name == "lost fixes":
        expected = 0.5 * {"lab": 20, "field": 10}[tier]
        assert np.mean(~np.isnan(innovations)) == pytest.approx(expected / 100, rel=0.1)


def test_jerked_wheels():
    """Wheels that slip by a fraction of a millimetre where a racing car brakes hard do not mislead the filter.

    Without `ekf.SLIP_SIGMAS` three of these robots are wrong by up to 0.2 m and 0.4 m/s, until fixes that they refuse
    are accepted. `SLIPPED` was chosen with such robots in view.
    """
    base = suited(Scenario(robot=RobotFile(path="racecar"), prior="model", learner="none", laps=1))
    runs = simulate(replicates(base, 24, 100))
    assert (runs["failure"] == "").all()
    assert float(np.hypot(runs.x - runs.x_measured, runs.y - runs.y_measured).max()) < 0.02
    assert float(np.abs(runs.v - runs.v_measured).max()) < 0.06


@pytest.mark.full
def test_jerked_wheels_of_others():
    """The same of 40 cars on which nothing was chosen; `pytest -m full -n 0 -s` prints what sensing/README.md says."""
    base = suited(Scenario(robot=RobotFile(path="racecar"), prior="model", learner="composite", laps=2))
    runs = simulate(replicates(base, 40, 5000))
    errors = np.hypot(runs.longitudinal_error, runs.lateral_error).values
    found = 1e3 * np.sqrt(np.mean(errors**2, axis=1))
    off = 1e3 * float(np.hypot(runs.x - runs.x_measured, runs.y - runs.y_measured).max())
    print(f"RMS mm: mean {found.mean():.2f}, median {np.median(found):.2f}, worst {found.max():.1f}; off {off:.0f} mm")
    assert (runs["failure"] == "").all() and found.mean() < 4 and np.sort(found)[-2] < 8


def test_lateral_slip():
    """The constant of the filter's rear tyres is that of the models: v_y = −c V θ̇, of which c − h/2 is in the path."""
    run = simulate(Scenario(sensing=Sensing(tier="ideal"), prior="model", learner="none", laps=1)).isel(
        time=slice(100, None)
    )
    product = (run.v * run.omega).values
    slope = (product @ run.v_lateral.values) / (product @ product)
    assert -slope - 0.002 / 2 == pytest.approx(ekf.SIDE_SLIP_TIME, rel=0.04)
    rest = run.v_lateral.values - slope * product
    assert rest.std() < 0.01 * run.v_lateral.values.std()


@pytest.mark.parametrize("name", ["car", "turtlebot", "racecar"])
def test_tyres(name):
    """What the wheels turn beyond the way of a curved run is what the bench says, to a quarter."""
    ideal = Sensing(tier="ideal")
    scenario = suited(Scenario(robot=RobotFile(path=name), sensing=ideal, prior="model", learner="none", laps=1))
    simulation = Simulation([scenario])
    robot, period = simulation.plant.robot, simulation.period
    poses, twists, angles = [], [], []
    while simulation.running:
        simulation.sense()
        poses.append(simulation.plant.reading["pose"][0].copy())
        twists.append(simulation.plant.reading["twist"][0].copy())
        angles.append(simulation.plant.state["wheel_angles"][0].copy())
        simulation.step()
    x, y, theta = np.array(poses).T[:, 100:]
    v, omega = np.array(twists).T[:, 100:]
    theta = np.unwrap(theta)
    turn = np.diff(theta)
    middle = theta[:-1] + turn / 2
    arcs = (np.diff(x) * np.cos(middle) + np.diff(y) * np.sin(middle)) * (1 + turn**2 / 24)
    way = np.append(0, np.cumsum(arcs))
    lag, load = measure(simulation.model)
    for wheel, side in ((0, -1), (1, 1)):
        rolled = way + side * robot.half_track * (theta - theta[0])
        beyond = robot.wheel_radius * np.array(angles)[100:, wheel] - rolled
        speed = v + side * robot.half_track * omega
        expected = -lag * speed + side * load * np.cumsum(v * omega * speed) * period
        constant = np.column_stack([np.ones_like(way), rolled])  # phase and rolling radius, which a filter finds
        left, unexplained = (
            np.std(e - constant @ np.linalg.lstsq(constant, e, rcond=None)[0]) for e in (beyond, beyond - expected)
        )
        assert unexplained < left / 4 and left > 2e-5, (unexplained, left)


@pytest.mark.parametrize("estimator", ["truth", "odometry", "ekf", "user"])
def test_acceleration_is_no_slip(estimator):
    """Encoders that are late are compared with the motion of their time, so that wheels that roll do not slip.

    Compared with the estimate of now they showed slip above 0.2, with which nothing is learned.
    """

    class Oracle:
        """The truth as a user's estimator."""

        def __init__(self, robot, size):
            pass

        def reset(self, pose, twist, period):
            pass

        def output(self, encoders, gyro, acceleration, fix, age):
            return np.hstack([simulation.plant.reading["pose"], simulation.plant.reading["twist"]])

    own = {"estimator": Oracle} if estimator == "user" else {}
    chosen = None if own else estimator
    sensing = Sensing(tier="lab", estimator=chosen, encoder_latency=0.2, gyro_latency=0.05)
    scenario = Scenario(reference=Lemniscate(size=1.5, period=10), laps=1, learner="none", sensing=sensing)
    simulation = Simulation([scenario.replace(perturbation="all")], **own)
    while simulation.running:
        simulation.step()
    result = simulation.result()
    assert result.slip.max() < 0.05 and not result.failed.any()


@pytest.mark.parametrize("estimator", ["truth", "odometry", "ekf"])
@pytest.mark.parametrize("counts", [0, 88_064])
def test_slow_encoders_are_no_slip(estimator, counts):
    """Encoders that are read ten times in a second show no slip: the mean of their rates is compared with a mean."""
    slow = {"encoder_counts": counts, "encoder_rate": 10}
    sensing = Sensing(tier="lab", estimator=estimator, **slow)
    scenario = Scenario(reference=Lemniscate(period=10), laps=1, learner="none", sensing=sensing)
    result = simulate(scenario.replace(perturbation="all"))
    assert result.slip.max() < 0.05 and not result.failed


# -- a user's own estimator --------------------------------------------------------------------------------------------

LANE = Scenario(
    reference=LaneChange(length=2.4, shift=0.3, speed=0.6), laps=1, learner="none",
    sensing=Sensing(tier="lab", estimator="odometry"),
)  # fmt: skip
LANES = [LANE.model_copy(update={"seed": seed}) for seed in range(3)]


@cache
def built_in():
    """Those of `LANES` with the built-in odometry."""
    return simulate(LANES)


class Odometry:
    """The built-in odometry as a user's estimator."""

    def __init__(self, robot, size):
        self.radius, self.calls = robot.wheel_radius, 0

    def reset(self, pose, twist, period):
        self.state, self.period, self.last = np.hstack([pose, twist]), period, None

    def output(self, encoders, gyro, acceleration, fix, age):
        assert encoders.shape == acceleration.shape == (len(gyro), 2)
        assert fix.shape == (len(gyro), 3) and np.isin(age, (-1, 0, 0.01)).all() and not fix[age < 0].any()
        m, r, T = self.state, self.radius, self.period
        if self.last is not None:
            before, rotation = self.last
            for i in range(len(m)):
                way = r * (encoders[i, 0] - before[i, 0] + encoders[i, 1] - before[i, 1]) / 2
                turn = T * (gyro[i] + rotation[i]) / 2
                m[i, 0] += way * math.cos(m[i, 2] + turn / 2)
                m[i, 1] += way * math.sin(m[i, 2] + turn / 2)
                m[i, 2] += turn
                rates = (encoders[i] - before[i]) / T
                m[i, 3], m[i, 4] = r * (rates[0] + rates[1]) / 2, gyro[i]
        self.last = encoders.copy(), gyro.copy()
        self.calls += 1
        return np.column_stack([m[:, :2], [wrapped(angle) for angle in m[:, 2]], m[:, 3:]])


def after(ticks, fault):
    """Returns an estimator that is odometry for some ticks, and then answers what `fault` makes of it."""

    class Breaks(Odometry):
        def output(self, *samples):
            answer = super().output(*samples)
            return fault(answer) if self.calls > ticks else answer

    return Breaks


def same(one, other):
    """Two results have the same bits in every signal."""
    for name in (*SIGNALS, "failed", "failure_time", "failure"):
        a, b = one[name].values, other[name].values
        assert np.array_equal(a, b, equal_nan=a.dtype.kind == "f"), name


@cache
def circled(**rates):
    """Four nominal robots on a circle, with sensors that are read at these rates."""
    course = {"prior": "model", "learner": "none", "laps": 2, "reference": Circle(radius=1, period=8)}
    return simulate([Scenario(**course, seed=seed, sensing=Sensing(tier="lab", **rates)) for seed in range(4)])


@pytest.mark.xdist_group("circled")  # whose tests share those with fast sensors
@pytest.mark.parametrize(
    "slow",
    [{"accelerometer_rate": 5}, {"accelerometer_rate": 10}, {"accelerometer_rate": 25}, {"gyro_rate": 10}],
    ids=lambda slow: "-".join(f"{name}-{rate}" for name, rate in slow.items()),
)
def test_slow_inertial_sensors(slow):
    """A sample that is held until the next one does not look like slip: the estimate is as good as with fast ones.

    With 10 Hz the filter of 0.32.0 took both wheels of nominal robots for slipping, and was off by 0.5 to 1.1 m.
    """
    fast, held = circled(), circled(**slow)
    off, still = (np.hypot(run.x_measured - run.x, run.y_measured - run.y).max("time").values for run in (fast, held))
    assert np.all(still < 1.1 * off.max()) and not held.failed.any()


@pytest.mark.parametrize(
    "slow",
    [
        {"estimator": "odometry", "encoder_rate": 10},
        {"estimator": "odometry", "gyro_rate": 5},
        {"encoder_rate": 10, "accelerometer_rate": 10},
        {"encoder_rate": 20, "accelerometer_rate": 20},
        {"accelerometer_noise": 0.5},
        {"accelerometer_noise": 0.5, "accelerometer_rate": 10},
    ],
    ids=lambda slow: "-".join(f"{name}-{value}" for name, value in slow.items()),
)
def test_nominal_robots_bear_poor_sensors(slow):
    """The controllers are designed for samples that are old, and noise is no slip.

    With version 0.48.0 the loop oscillated with slow sensors, or wheels that grip seemed to slip in most ticks, and
    robots were lost in the first and third of these cases.
    """
    base = Scenario(sensing={"tier": "lab", **slow}, prior="model", learner="composite", laps=1)
    runs = simulate([base.replace(seed=seed) for seed in range(2)])
    assert not runs.failed.any()
    assert float((runs.slip > 0.1).mean()) < 0.1
    error = np.sqrt(((runs.omega - runs.omega_ref) ** 2).isel(time=slice(300, None)).mean("time")).values
    assert (error < 0.2).all()


def test_a_slow_gyro_punctures_no_wheel():
    """Samples of a slow gyro are old and repeat their noise, from which no other radius of a wheel follows."""
    scenarios = [Scenario(sensing={"tier": "lab", "gyro_rate": rate}, laps=1, prior="model") for rate in (5, 10)]
    for one in scenarios:
        simulation = Simulation([one])
        while simulation.running:
            simulation.step()
            assert not simulation.estimator.sensors.ring["doubt"].any()


def test_odometry_needs_no_accelerometer():
    """Odometry does not wait for a sensor that it does not use, nor are its controllers designed for one."""
    late = LANE.sensing.model_copy(update={"accelerometer_latency": 0.1})
    prompt, found = simulate(LANE), simulate(LANE.replace(sensing=late))
    unlike = {name for name in SIGNALS if not np.array_equal(found[name], prompt[name], equal_nan=True)}
    assert unlike == {"acceleration_x", "acceleration_y"} and np.array_equal(found.k_p, prompt.k_p)


def test_own_odometry():
    """Odometry written by a user gives the bits of the built-in one, alone and in a batch."""
    builtin = built_in()
    found = simulate(LANES, estimator=Odometry)
    same(found, builtin)
    same(simulate(LANES[1], estimator=Odometry), builtin.isel(run=1))
    assert (found.estimator_fault == "").all() and str(found.label[0].item()) == "Odometry"


def test_the_design_knows_late_sensors():
    """The controllers around a user's estimator are designed for its slowest sensor, whatever the tier's own one is."""
    late = {"encoder_latency": 0.03, "gyro_latency": 0.02}

    def course(estimator, **latencies):
        sensing = Sensing(tier="ideal", estimator=estimator, **latencies)
        return Scenario(reference=LANE.reference, laps=1, learner="fel", sensing=sensing)

    for tier in ("ekf", "odometry", "truth"):
        found = simulate([course(tier), course(tier, **late)], estimator=Odometry)
        expected = [simulate(course("ekf", **latencies)) for latencies in ({}, late)]
        for name in GAIN_VARIABLES:
            assert np.array_equal(found[name], [run[name] for run in expected]), (tier, name)
        assert not found.failed.any()
    alone = simulate(course("truth", **late), estimator=Odometry)
    same(found.isel(run=1), alone)
    assert np.array_equal(found.weights[1], alone.weights)


def test_not_finite():
    """NaN is reported with its tick, and the robot coasts on odometry from then on; the others notice nothing."""

    def spoil(answer):
        answer[1, 3] = np.nan
        return answer

    found = simulate(LANES, estimator=after(100, spoil))
    assert [str(text) for text in found.estimator_fault.values] == ["", "estimator Breaks: not finite, tick 100", ""]
    builtin = built_in()
    for run in (0, 2):
        same(found.isel(run=run), builtin.isel(run=run))
    for name in SIGNALS:  # to rounding, as odometry goes on from a heading that was wrapped
        np.testing.assert_allclose(found[name][1], builtin[name][1], atol=1e-9, err_msg=name)


def test_blind():
    """A robot whose estimator tells nothing from the start drives on odometry."""
    found = simulate(LANES, estimator=after(0, lambda answer: np.full_like(answer, np.inf)))
    assert [str(text) for text in found.estimator_fault.values] == ["estimator Breaks: not finite, tick 0"] * 3
    same(found, built_in())


def fail(answer):
    raise ZeroDivisionError("too near")


FAULTS = {
    "raises": (fail, "ZeroDivisionError: too near (test_estimators.py, line "),
    "shape": (lambda answer: answer[:, :3], "output is shape (3, 3), expected shape (3, 5)"),
    "one": (lambda answer: answer[:1], "output is shape (1, 5), expected shape (3, 5)"),
    "nothing": (lambda answer: None, "output is nothing, expected shape (3, 5)"),
    "text": (lambda answer: "here", "ValueError: could not convert string to float: 'here'"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_fault(fault):
    """One that raises or answers in another shape ends the run with one line, and what was recorded is kept."""
    what, message = FAULTS[fault]
    found, sound = simulate(LANES, estimator=after(100, what)), built_in()
    for run in range(3):
        text = str(found.failure[run].item())
        assert text.startswith(f"estimator Breaks: {message}") and text.endswith(", tick 100"), text
        assert np.array_equal(found.v_measured[run, :100], sound.v_measured[run, :100])
        assert np.isnan(found.v_measured[run, 100:]).all()


def test_no_estimator():
    """An object without the two methods is refused before anything is computed."""
    for method, text in (("reset", "has no method output"), ("output", "has no method reset")):
        half = type("Half", (), {"__init__": lambda self, robot, size: None, method: lambda self, *values: None})
        with pytest.raises(InputError, match=f"^estimator Half: {text}$"):
            simulate(LANE, estimator=half)


def test_command_line(tmp_path, capsys):
    """`--controller estimator=FILE:NAME` takes it too."""
    from mrctl.cli import main

    file = tmp_path / "mine.py"
    file.write_text(
        "import numpy as np\n"
        "class Mine:\n"
        "    def __init__(self, robot, size): pass\n"
        "    def reset(self, pose, twist, period): self.state = np.hstack([pose, twist])\n"
        "    def output(self, encoders, gyro, acceleration, fix, age): return self.state[:, :4]\n"
    )
    scenario = tmp_path / "scenario.toml"
    scenario.write_text(LANE.to_toml())
    assert main(["run", str(scenario), "--controller", f"estimator={file}:Mine"]) == 1
    assert "estimator Mine: output is shape (1, 4), expected shape (1, 5), tick 0" in capsys.readouterr().out


# -- bad input ---------------------------------------------------------------------------------------------------------

REFUSED = {
    "sensing.tier": {"sensing": {"tier": "perfect"}},
    "sensing.estimator": {"sensing": {"estimator": "kalman"}},
    "sensing.gyro_rate": {"sensing": {"gyro_rate": -1}},
    "sensing.encoder_rate": {"sensing": {"encoder_rate": 30}},
    "sensing.fix_rate": {"sensing": {"tier": "field", "fix_rate": 1000}},
    "sensing.fix_latency": {
        "sensing": {"fix_latency": 0.4, "fix_rate": 5},
        "reference": {"kind": "line", "length": 0.1},
    },
    "sensing.gyro_rate: 1e-300 Hz is neither": {"sensing": {"gyro_rate": 1e-300}},
    "sensing.lidar.rate": {"sensing": {"lidar": {"rate": 1e-300}}},
    "sensing.fix_latency: more than 4": {"sensing": {"tier": "lab", "fix_latency": 0.5}},
    "sensing.gyro_latency": {"sensing": {"gyro_latency": 0.013}},
    "sensing.delay": {"sensing": {"delay": 0.015}},
    "sensing.fix_lost": {"sensing": {"fix_lost": 1.5}},
    "sensing.encoder_counts": {"sensing": {"encoder_counts": 2.5}},
    "sensing.gyro_noise": {"sensing": {"gyro_noise": float("nan")}},
    "sensing.lidar": {"sensing": {"lidar": True}},
}


@pytest.mark.parametrize("name", REFUSED)
def test_refused(name, tmp_path, capsys):
    """What no sensor can do is refused with one line that names the field, from Python and from a file."""
    with pytest.raises(InputError) as error:
        Scenario.from_dict({"laps": 1, **REFUSED[name]})
    assert str(error.value).startswith(name) and "\n" not in str(error.value), error.value


@pytest.mark.parametrize(
    ("old", "successor"),
    [
        ({"measurement": "odometry"}, "sensing.estimator"),
        ({"perturbation": {"velocity_noise": 0.01}}, "sensing.encoder_counts"),
        ({"perturbation": {"rotation_noise": 0.01}}, "sensing.gyro_noise"),
        ({"perturbation": {"position_noise": 0.01}}, "sensing.fix_position_noise"),
        ({"events": [{"time": 1, "perturbation": {"heading_noise": 0.01}}]}, "sensing.fix_heading_noise"),
    ],
)
def test_old_keys(old, successor):
    """A key of an earlier version names its successor."""
    with pytest.raises(InputError) as error:
        Scenario.from_dict(old)
    assert successor in str(error.value) and "\n" not in str(error.value), error.value


@pytest.mark.parametrize(
    ("command", "successor"),
    [
        ("run --feedforward fel", "set prior and learner"),
        ("view --feedforward=fel", "set prior and learner"),
        ("navigate doorway:3 --feedforward fel", "set prior and learner"),
        ("run --perturbation.velocity-noise 0.1", "sensing.encoder_counts"),
        ("identify --perturbation.rotation-noise=0.1", "sensing.gyro_noise"),
        ("run --composite.weights trained", "save_learned"),
    ],
)
def test_old_flags(command, successor, capsys):
    """So does a flag of an earlier version, of whichever command."""
    assert main(command.split()) == 2
    assert successor in (line := capsys.readouterr().err.strip()) and "\n" not in line, line


@pytest.mark.parametrize(
    ("field", "value", "successor"),
    [("feedforward", "none", "set prior and learner"), ("perturbation.velocity_noise", 0.1, "sensing.encoder_counts")],
)
def test_old_axes(field, value, successor):
    """So does an axis of a sweep."""
    with pytest.raises(InputError, match=successor):
        Sweep.from_dict({"runs": 1, "axes": [{"field": field, "values": [value]}]})
