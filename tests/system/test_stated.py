"""What must hold in the tier `lab`: a few draws in the usual run, all of them with `pytest -m full`."""

import numpy as np
import pytest

from mrctl import PERTURBATIONS, Scenario, Sensing, simulate, summary
from mrctl.physics import mjcf
from mrctl.physics.parameters import read_robot
from mrctl.scenario import FEEDFORWARDS
from mrctl.theory.references import random_spline


@pytest.mark.parametrize(
    ("draws", "plants", "feedforwards"),
    [
        (3, ("all",), ("none", "model+composite")),
        pytest.param(20, ("nominal", "all"), FEEDFORWARDS, marks=pytest.mark.full),
    ],
)
def test_estimate_adds_as_independent_errors_do(draws, plants, feedforwards):
    """Position and yaw-rate errors in the last lap: each below 1.25 √(a² + b²), with true measurements a, estimate's b.

    That of `model+composite` is at most 1.5 mm, and that of its yaw rate at most 10 mrad/s, in every draw.
    """
    for plant in plants:
        for feedforward in feedforwards:
            common = {**FEEDFORWARDS[feedforward], "perturbation": PERTURBATIONS[plant]}
            estimators = {"ekf": None, "truth": None}
            for name in estimators:
                sensing = Sensing(tier="lab", estimator=name)
                estimators[name] = simulate([Scenario(sensing=sensing, seed=k, **common) for k in range(draws)])
            found, true = (summary(run) for run in estimators.values())
            assert not found.failed.any()
            last = estimators["ekf"].isel(time=slice(-round(12 / 0.01), None))
            estimate = {
                "position_rmse": np.square(last.x_measured - last.x) + np.square(last.y_measured - last.y),
                "omega_rmse": np.square(last.omega_measured - last.omega),
            }
            for error, squared in estimate.items():
                parts = np.mean(true[error] ** 2) + float(squared.mean())
                assert np.sqrt(np.mean(found[error] ** 2)) < 1.25 * np.sqrt(parts), (plant, feedforward, error)
            if feedforward == "model+composite":
                assert found.position_rmse.max() < 1.5e-3 and found.omega_rmse.max() < 10e-3


@pytest.mark.parametrize("count", [8, pytest.param(1000, marks=pytest.mark.full)])
def test_pid_alone(count):
    """On random splines at changing speed up to 0.95 of its limit, PID alone loses no nominal robot."""
    robot = read_robot(mjcf.load())
    courses = [random_spline(np.random.default_rng(seed), robot) for seed in range(count)]
    fastest = max(course.sample(np.linspace(0, course.period, 500)).twist[:, 0].max() for course in courses)
    assert fastest > 0.94 * robot.max_speed  # the tightest splines are slower
    for tier in ("ideal", "lab"):
        for seed, course in enumerate(courses):
            sensing = Sensing(tier=tier)
            run = simulate(Scenario(reference=course, sensing=sensing, learner="none", laps=1, seed=seed))
            assert not run.failed, (tier, seed, str(run.failure.item()))
