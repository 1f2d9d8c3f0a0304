"""Where a robot believes that it starts: within the errors of a fix, far from the truth, or anywhere on its map."""

import numpy as np
import pytest

from mrctl import Box, Circle, Disc, InputError, Obstacles, RobotFile, Scenario, Sensing
from mrctl.loop.runs import simulate
from mrctl.loop.simulation import Simulation
from mrctl.navigation.planning import prepared
from mrctl.navigation.tasks import task_of

WALLS = [
    Box(x=x, y=y, length=0.2 + 6 * (x == 1), width=0.2 + 6 * (y == 0.5))
    for x, y in ((4, 0.5), (-2, 0.5), (1, 3.5), (1, -2.5))
]
ROOM = Obstacles(shapes=(*WALLS, Disc(x=-1, y=2.5, radius=0.3), Box(x=3, y=-1, length=0.8, width=0.4)))
DRIVE = Scenario(obstacles=ROOM, reference=Circle(radius=0.6, period=6.0), laps=1, prior="model", learner="none")
LOCALISERS = ("scan", "particles")
FAR = {"start_position_noise": 0.5, "start_heading_noise": 0.4}
UNKNOWN = {"start_unknown": True}


def runs(count, **sensing):
    """Drives with different seeds."""
    return [DRIVE.replace(seed=seed, sensing=Sensing(**sensing)) for seed in range(count)]


def errors(result):
    """Error of the estimated position in m, `(runs, ticks)`."""
    return np.hypot(result["x_measured"] - result["x"], result["y_measured"] - result["y"]).values


def test_errors_of_the_start():
    """The first estimate errs as much as is stated, and the filter knows that; by default as a fix does."""
    count = 400
    for sensing, sigma, turn in (({}, 0.003, 0.003), (FAR, 0.5, 0.4)):
        loop = Simulation(runs(count, **sensing))
        mean, truth = loop.estimator.memory["mean"][:, :3], loop.plant.reading["pose"]
        away = mean - truth
        expected = np.array([sigma, sigma, turn])
        assert away.std(axis=0) == pytest.approx(expected, rel=0.15)
        assert np.abs(away.mean(axis=0)) == pytest.approx(0.0, abs=4 * sigma / np.sqrt(count))
        P = loop.estimator.memory["P"]
        assert P[:, [0, 1, 2], [0, 1, 2]] == pytest.approx(np.broadcast_to(expected**2, (count, 3)))


@pytest.mark.parametrize("localisation", LOCALISERS)
def test_finds_itself(localisation):
    """From a wrong or unknown start the robot finds itself in the room with its first scans, and drives its lap."""
    starts = {}, FAR, UNKNOWN
    result = simulate([run for start in starts for run in runs(8, localisation=localisation, **start)])
    assert not result["failed"].any()
    usual, *others = np.split(errors(result), 3)
    half = result.sizes["time"] // 2
    for away, name in zip(others, ("far", "unknown"), strict=True):
        assert np.median(away[:, 0]) > 0.3, name
        rms, before = (np.sqrt(np.mean(each[:, half:] ** 2)) for each in (away, usual))
        print(f"{localisation}, {name}: {1e3 * rms:.1f} mm, from a first fix {1e3 * before:.1f} mm")
        assert (away[:, 30:] < 0.1).all() and rms < 1.2 * before + 1e-3, name


STARTS = {
    "fix": {},
    "0.3 m": {"start_position_noise": 0.3, "start_heading_noise": 0.2},
    "1 m": {"start_position_noise": 1.0, "start_heading_noise": 0.5},
    "unknown": UNKNOWN,
}
WORLDS = ("cellular", "doorway", "warehouse", "slalom")
# Share that arrives. Slaloms look alike from many places.
LEAST = {"fix": (1.0, 1.0), "0.3 m": (1.0, 1.0), "1 m": (0.9, 0.5), "unknown": (0.7, 0.0)}
COUNTS = [(2, WORLDS[:2], ("0.3 m",)), pytest.param((12, WORLDS, tuple(STARTS)), marks=pytest.mark.full)]


@pytest.mark.parametrize("counts", COUNTS, ids=["usual", "full"])
def test_missions(counts):
    """Missions from wrong starts arrive; the table of `sensing/README.md` has these counts."""
    count, worlds, starts = counts
    robot = Scenario(robot=RobotFile(path="turtlebot"), prior="model", learner="none")
    for world in worlds:
        tasks = [task_of(f"{world}:{300 + k}", robot) for k in range(count)]
        own = [prepared(task, robot)[1].replace(seed=300 + k) for k, task in enumerate(tasks)]
        for start in starts:
            there = {}
            for name in LOCALISERS:
                result = simulate([s.replace(sensing={"localisation": name, **STARTS[start]}) for s in own])
                there[name] = int((result["failure"] == "").sum())
            print(f"{world}, {start}: " + ", ".join(f"{n} of {count} arrive with {name}" for name, n in there.items()))
            assert min(there.values()) >= LEAST[start][world == "slalom"] * count


def test_without_localisation():
    """Fixes of the tier correct a wrong start as well; odometry never does."""
    assert (errors(simulate(runs(4, **FAR)))[:, 50:] < 0.02).all()
    drift = errors(simulate([run.replace(laps=1) for run in runs(4, estimator="odometry", **FAR)]))
    assert np.median(np.nanmax(drift, axis=1)) > 0.3


def test_batch_is_single():
    """The search for a start has the same bits alone and beside others."""
    every = [*runs(2, localisation="scan", **UNKNOWN), *runs(2, localisation="particles", **FAR)]
    mixed = [run.replace(reference=Circle(radius=0.3, period=2.5)) for run in every]
    whole = simulate(mixed)
    for row, own in enumerate(mixed):
        one = simulate(own)
        for name in ("x", "x_measured", "variance_x", "fix_theta", "voltage_left"):
            assert np.array_equal(one[name].values, whole[name].values[row], equal_nan=True), name


@pytest.mark.parametrize(
    ("sensing", "message"),
    [
        ({"start_unknown": True}, "sensing.start_unknown: needs localisation by scan or particles"),
        ({"start_unknown": True, "localisation": "scan", "estimator": "odometry"}, "sensing.start_unknown: needs"),
        ({"start_unknown": True, "localisation": "particles", "tier": "ideal"}, "sensing.start_unknown: needs"),
        ({"start_position_noise": -1}, "start_position_noise"),
        ({"start_heading_noise": 4}, "start_heading_noise"),
    ],
)
def test_refused(sensing, message):
    """One line names the field."""
    with pytest.raises(InputError, match=message):
        DRIVE.replace(sensing=sensing)
