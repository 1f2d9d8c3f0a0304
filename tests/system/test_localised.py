"""Runs whose posture fixes come from a lidar on the map."""

from typing import ClassVar

import numpy as np
import pytest

from mrctl import Box, Circle, Disc, InputError, Obstacles, Scenario, simulate
from mrctl.loop.simulation import Simulation
from mrctl.sensing.tiers import Sensing

WALLS = tuple(
    Box(x=x, y=y, length=0.2 + 6 * (x == 0), width=0.2 + 5 * (y == 0)) for x, y in ((3, 0), (-3, 0), (0, 3), (0, -3))
)
ROOM = Obstacles(shapes=(*WALLS, Disc(x=-2, y=2, radius=0.3), Disc(x=2, y=-1.8, radius=0.2, course=Circle(radius=0.3))))
RUNS = [
    Scenario(
        reference=Circle(radius=0.8, period=8.0), laps=1, learner="none", obstacles=ROOM, seed=seed,
        sensing=Sensing(tier="field", localisation=("scan", "particles")[seed % 2]),
    )
    for seed in range(4)
]  # fmt: skip


def test_estimate_and_bits():
    """The filter with such fixes errs by less than 20 mm; a run in a batch has the bits of the run alone."""
    together = simulate(RUNS)
    assert not together["failed"].any()
    error = np.hypot(together["x_measured"] - together["x"], together["y_measured"] - together["y"])
    assert np.sqrt(np.square(error).mean()) < 0.02
    fixes = np.isfinite(together["fix_x"]).sum("time")
    assert np.all(fixes >= 75)  # ten in each of eight seconds, but for the first and those on their way
    for row in (2, 3):
        alone = simulate(RUNS[row])
        for name in ("x", "fix_x", "x_measured", "voltage_left"):
            assert np.array_equal(alone[name], together[name][row], equal_nan=True)


def test_map_that_is_off():
    """A robot that is localised on a map with everything shifted by (6, −4) cm is shifted like it."""
    shift = np.array([0.06, -0.04])
    shapes = tuple(shape.model_copy(update={"x": shape.x + 0.06, "y": shape.y - 0.04}) for shape in ROOM.standing)
    runs = [run.replace(map=Obstacles(shapes=shapes)) for run in RUNS[:2]]
    result = simulate(runs)
    for name, wanted in zip("xy", shift, strict=True):
        error = (result[f"{name}_measured"] - result[name])[:, 200:].mean("time")
        assert np.abs(error - wanted).max() < 0.01
    same = simulate(RUNS[0].replace(map=ROOM.still))
    np.testing.assert_array_equal(same["x_measured"], simulate(RUNS[0])["x_measured"])


def test_scans_that_show_nothing():
    """Where the lidar sees no wall it sends no fixes, and the filter knows that odometry drifts.

    The mean of particles that have nothing to be weighed by is odometry, which the filter has already.
    """
    far = Obstacles(shapes=tuple(shape.replace(x=3 * shape.x, y=3 * shape.y) for shape in WALLS))
    base = Scenario(reference=Circle(radius=0.8, period=8.0), laps=3, prior="model", obstacles=far)
    near = [Sensing(localisation=name, lidar={"range": 2.0}) for name in ("particles", "scan")]
    result = simulate([base.replace(seed=seed, sensing=sensing) for sensing in near for seed in range(4)])
    assert not np.isfinite(result["fix_x"]).any()
    error = np.hypot(result["x_measured"] - result["x"], result["y_measured"] - result["y"])[:, -1]
    deviation = np.sqrt(result["variance_x"] + result["variance_y"])[:, -1]
    assert (error / deviation).max() < 2.5 and error[:4].max() > 0.02 and error[4:].max() > 0.02


class Listener:
    """An estimator that stays at its first estimate and keeps the fixes that it receives."""

    fixes: ClassVar[list] = []

    def __init__(self, robot, size):
        self.fixes.clear()

    def reset(self, pose, twist, period):
        self.mean = np.hstack([pose, twist])

    def output(self, encoders, gyro, acceleration, fix, age):
        self.fixes.extend(fix[age >= 0])
        return self.mean


def test_user_receives_the_same_fixes():
    """A user's estimator receives the fixes of the lidar in the tick of the scan, and never those of the tier."""
    sensing = {"tier": "lab", "localisation": "particles", "fix_latency": 0.0}
    run = RUNS[1].replace(sensing=sensing, reference=Circle(radius=0.8, period=1.0e3), laps=1)
    simulation = Simulation([run], estimator=Listener)
    for _ in range(25):
        simulation.step()
    logged = simulation.log.ticks[:25, 0]
    arrived = np.isfinite(logged["fix_x"])
    assert arrived.sum() == 3
    assert np.array_equal(np.array(Listener.fixes)[:, 0], logged["fix_x"][arrived])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"obstacles": Obstacles()}, "sensing.localisation: the map has no obstacles"),
        ({"sensing": {"localisation": "scan", "lidar": {"rate": 30}}}, "sensing.lidar.rate: 30 Hz is no whole"),
        ({"sensing": {"localisation": "scan", "fix_rate": 10}}, "sensing.fix_rate: with a lidar"),
        ({"sensing": {"localisation": "scan", "fix_outliers": 0.1}}, "sensing.fix_outliers: has no effect"),
        (
            {"sensing": {"localisation": "particles", "encoder_latency": 0.1, "fix_latency": 0.0}},
            "sensing.fix_latency: with a lidar it must be at least encoder_latency, 0.1 s",
        ),
        ({"sensing": {"localisation": "scan", "lidar": {"beams": 0}}}, "sensing.lidar.beams: "),
    ],
)
def test_refused(changes, message):
    """Localisation without a map, and rates that do not fit, are refused with one line."""
    with pytest.raises(InputError) as error:
        simulate(Scenario.from_dict(RUNS[0].model_dump() | changes))
    assert message in str(error.value) and "\n" not in str(error.value)
