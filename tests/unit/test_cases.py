"""What the suite drives: complete, paired, reproducible, and within what the robot can do."""

import numpy as np
import pytest

from mrctl import PERTURBATIONS, Perturbation, Scenario
from mrctl.experiments import cases
from mrctl.loop.hindsight import REPETITIONS
from mrctl.physics import mjcf
from mrctl.physics.parameters import read_robot
from mrctl.physics.perturb import perturb
from mrctl.theory.perturbation import REPLICATE_HALF_WIDTHS
from mrctl.theory.references import check

PLAIN = Perturbation()


@pytest.fixture(scope="module")
def robot():
    return read_robot(mjcf.load())


@pytest.mark.parametrize("mode", cases.REPLICATES)
def test_complete_and_paired(mode):
    """Every part is there under names of their own; each case has the same seeds, and runs of one length."""
    found = cases.cases(mode, 3, 2)
    assert {case.part for case in found} == set(cases.PARTS) - {
        "quick": {"late", "steering", "tier"}, "core": {"late", "steering"}, "full": set(),
    }[mode]  # fmt: skip
    assert len({case.name for case in found}) == len(found)
    for case in found:
        if case.part != "random":
            assert [s.seed for s in case.scenarios] == [0, 1, 2]
            assert len({s.perturbation for s in case.scenarios}) == 3  # replicates, not copies
            same = {s.model_copy(update={"seed": 0, "perturbation": PLAIN, "events": ()}) for s in case.scenarios}
            assert len(same) == 1
        assert len({s.laps for s in case.scenarios}) == 1
    drawn = {name: p.drawn(np.random.default_rng([0, 5])) for name, p in PERTURBATIONS.items()}
    if mode == "full":
        for tier in ("ideal", "lab", "field"):
            driven = [s for case in found if case.part in ("steady", "tier") for s in case.scenarios]
            assert {s.perturbation for s in driven if s.sensing.tier == tier} >= set(drawn.values())
        ladder = {
            (s.steering or "compliant", s.perturbation) for case in found if not case.change for s in case.scenarios
        }
        assert ladder >= {(steering, drawn[p]) for steering in cases.STEERINGS for p in cases.LADDER}
    if mode == "core":
        lab = {s.perturbation for case in found if case.part == "steady" for s in case.scenarios}
        assert lab >= {drawn[name] for name in (*cases.UNCERTAIN, "nominal", "all")}


def test_quick_takes_two_minutes():
    """Two cores that each drive 65 s in a second take a minute and a half; starts and tables come on top."""
    found = cases.cases("quick", cases.REPLICATES["quick"], cases.RANDOM["quick"])
    runs = [scenario for case in found for scenario in case.scenarios]
    seconds = sum(s.duration * Scenario().physics_step / s.physics_step for s in runs)
    drives = sum(1 + REPETITIONS if name == cases.HINDSIGHT else 1 for name in cases.entries("quick"))
    assert drives * seconds / 65 / 2 < 90


def test_steps_are_where_the_laps_say():
    """The perturbation comes in the beginning of lap `change`, and goes in that of lap `back`."""
    for case in cases.cases("full", 1, 0):
        events = case.scenarios[0].events
        if case.part == "step":
            laps = [1 + event.time / case.scenarios[0].reference.period for event in events]
            assert laps == [case.change, case.back] and case.back + 1 <= case.scenarios[0].laps
            start, changed, back = case.scenarios[0].perturbation, *(e.perturbation for e in events)
            assert len({start, changed, back}) == 3
            for (
                name,
                width,
            ) in REPLICATE_HALF_WIDTHS.items():  # another draw, but of the wheels, which stay what they are
                assert abs(getattr(back, name) - 1) <= width
                assert (getattr(back, name) == getattr(start, name)) == ("radius" in name)
            assert back.slope == start.slope
        if case.part == "late":
            (event,) = events
            assert 1 + event.time / case.scenarios[0].reference.period == case.change > 20
            assert case.change + 1 == case.scenarios[0].laps and event.perturbation != case.scenarios[0].perturbation


def test_other_course_begins_where_the_lap_ends():
    """In position and direction, and its laps count whole: one to a lap, or three half laps of a symmetric figure."""
    for case in cases.cases("full", 1, 0):
        for event in case.scenarios[0].events:
            if event.reference is not None:
                first = case.scenarios[0].reference
                assert 2 * first.period / event.reference.period % 1 == pytest.approx(0, abs=1e-9)
                ends, begins = (one.sample(np.array([t])).pose[0] for one, t in
                                ((first, first.period), (event.reference, 0.0)))  # fmt: skip
                np.testing.assert_allclose(begins, ends, atol=0.01)


@pytest.fixture(scope="module")
def many():
    return cases.random_scenarios(40)


def test_random_scenario_is_a_function_of_its_seed(robot, many):
    """The same again, also among others; different for another seed; every kind of perturbation comes up."""
    assert sorted(s.seed for s in many) == list(range(40)) and cases.random_scenario(17, robot) in many
    assert len({s.reference for s in many}) == 40
    assert {s.name.split(": ")[1] for s in many} == set(cases._KINDS)
    assert {len(s.events) for s in many} == {0, 1}
    assert len({s.ticks for s in many}) <= len(cases.LAP_TIMES)
    assert Scenario.from_dict(many[0].model_dump(mode="json")) == many[0]


def test_random_robots_can_follow_and_stand(robot, many):
    """Each reference changes its speed, keeps its margin, and has a lap time of the list; no payload tips the robot."""
    limits = ("max_speed", "max_rotation", "max_acceleration", "max_rotation_acceleration", "steering_limit")
    careful = {name: 1.01 * cases.SPLINE_LIMIT_SHARE * getattr(robot, name) for name in limits}
    careful = robot.model_copy(update={**careful, "tyre_friction": 1.01 * cases.RELIED_FRICTION})
    nominal, spread = mjcf.load(), []
    for scenario in many[:12]:
        course = scenario.reference
        check(course, careful, reverse=False)
        assert min(abs(course.period - time) for time in cases.LAP_TIMES) < 1e-9
        v = course.sample(np.linspace(0, course.period, 500)).twist[:, 0]
        spread.append(v.min() / v.max())
        for one in (scenario.perturbation, *(event.perturbation for event in scenario.events)):
            perturb(nominal, mjcf.clone(nominal), one)
            factors = [value for name, value in one.model_dump().items() if name.endswith("_factor")]
            assert np.all(np.abs(np.array(factors) - 1) <= 0.9)
    assert np.mean(spread) < 0.75 and max(spread) < 0.95
