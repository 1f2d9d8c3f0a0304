"""Which scenarios run together in one simulation, and in how many threads."""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Hashable, Sequence

from mrctl.physics import mjcf
from mrctl.physics import obstacles as walls
from mrctl.record import InputError
from mrctl.scenario import Scenario
from mrctl.theory.references import enlarged
from mrctl.theory.robot import ANY_ANGLE, LIMITS
from mrctl.theory.timing import LIMIT_SHARE

MIN_ROBOTS_OF_THREAD = 8  # smallest number of robots for which a thread pays


def arranged(scenario: Scenario) -> Scenario:
    """Returns the scenario with the steering arrangement of its robot, where it names none.

    Raises:
        InputError: The robot's file has no robot that can be driven.
    """
    return scenario if scenario.steering else scenario.replace(steering=mjcf.arrangement(scenario.robot))


def suited(scenario: Scenario) -> Scenario:
    """Returns the scenario with the steering of its robot, and with a circle or lemniscate that the robot can follow.

    The reference of the scenario is slowed where necessary, and enlarged where no period is enough; one of another kind
    stays as it is.

    Raises:
        InputError: The robot cannot be driven.
    """
    scenario = arranged(scenario)
    model, robot = mjcf.build(scenario.world, scenario.steering, robot=scenario.robot)
    names = (*LIMITS, "steering_limit") if robot.steering_limit < ANY_ANGLE else LIMITS  # a caster swings to any angle
    careful = robot.replace(**{name: LIMIT_SHARE * getattr(robot, name) for name in names})
    found = enlarged(scenario.reference, careful, mjcf.reverses(model, scenario.steering))
    return scenario.replace(reference=found or scenario.reference)


def group_of(s: Scenario) -> Hashable:
    """Returns what the runs of one simulation must share; runs with goals end one by one, and may differ in length."""
    rates = s.ticks if s.goal is None else None, s.physics_step, s.control_period, s.motion_period
    sensing, period = s.sensing, s.control_period
    delays = [sensing.loop_delay(period, estimator) for estimator in (None, "user")]  # a user's may replace `source`
    chain = sensing.source, sensing.periods("delay", period), *delays
    laws = s.prior, s.learner, s.fel.hidden
    return s.world, walls.layout(s.obstacles), s.robot, s.steering, *laws, *rates, *chain


def together(scenarios: Sequence[Scenario]) -> list[Scenario]:
    """Returns the scenarios of one simulation, `arranged`.

    Raises:
        InputError: They are not scenarios of one group; the message names the fields in which two of them differ.
    """
    if not (isinstance(scenarios, Sequence) and scenarios and all(isinstance(s, Scenario) for s in scenarios)):
        raise InputError("scenarios: must be a list of one or more scenarios")
    found = [arranged(s) for s in scenarios]
    first, group = found[0], group_of(found[0])
    for row, s in enumerate(found):
        if group_of(s) != group:
            fields = {name: getattr(s, name) for name in Scenario.model_fields}
            apart = [n for n, value in fields.items() if group_of(first.model_copy(update={n: value})) != group]
            raise InputError(f"scenarios: 0 and {row} differ in {', '.join(apart)}, and cannot run in one simulation")
    return found


def uniform(scenarios: Sequence[Scenario]) -> list[list[int]]:
    """Returns groups of scenarios that run best in one simulation, as lists of their indices.

    Worlds whose numbers of obstacles differ by a factor of two or more are kept apart, because in one simulation all
    worlds get as many geoms as the largest has, and each costs time.
    """
    groups: dict[Hashable, list[int]] = defaultdict(list)
    for row, s in enumerate(scenarios):
        groups[group_of(s), len(s.obstacles.shapes).bit_length()].append(row)
    return list(groups.values())


def cores() -> int:
    """Returns the number of processor cores that this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)  # only Linux has it
    return len(affinity(0)) if affinity else os.cpu_count() or 1


def worthwhile(threads: int, size: int) -> int:
    """Returns how many of the allowed threads (0 for all cores) pay for a number of robots.

    Raises:
        InputError: The number of threads is negative.
    """
    if threads < 0:
        raise InputError(f"threads: {threads} is below 0, which stands for all cores")
    return min(threads or cores(), max(1, size // MIN_ROBOTS_OF_THREAD))
