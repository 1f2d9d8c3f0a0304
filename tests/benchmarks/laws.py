"""What does each law cost? `python tests/benchmarks/laws.py`.

One robot drives a lemniscate. Every law is called alone, in a compiled loop, on what this robot measures, wants and
has learned at that moment, and takes turns with stretches of the drive, whose control ticks (`Hierarchy.update`) are
timed. Costs are medians over the turns in ns; a ratio is the median of the ratios of neighbouring turns, so that other
work on the machine slows both. A tick takes longer than the sum of its laws: it is called from Python, after the
physics has used the processor's caches.
"""

import copy
import math
import statistics
import time
from functools import cache
from itertools import pairwise
from typing import Any
from unittest import mock

from mrctl import FEEDFORWARDS, Scenario
from mrctl.control.feedforward import Learner, Shown, learn_nothing, nothing
from mrctl.control.guard import guard
from mrctl.control.kanayama import kanayama, posture_error
from mrctl.control.limiter import limit
from mrctl.control.pid import pid
from mrctl.control.steering import allocate, steer
from mrctl.experiments.tables import markdown, number
from mrctl.kernel import Kernel, kernel
from mrctl.loop.simulation import Simulation

OWN = ("control tick", "feedforward", "learning")  # the rows that depend on the feedforward
EMPTY = (nothing, learn_nothing)  # laws that have no cost to measure
MEASURED = ("fel", "none", "model+observer", "rls", "model+composite")
TURNS = 41
TICKS = 50  # control ticks of a turn
CALLS = 100  # calls of a law in a turn; a learner that is taught the same for longer leaves what it meets in a drive
WARM = 200  # control ticks before the first turn

law = posture_error  # what `repeat` calls, until `Kernel.calling` says otherwise


@kernel
def repeat(times: int, *arguments: Any) -> None:
    """Calls a law many times with the same arguments."""
    for _ in range(times):
        law(*arguments)


def laws(simulation: Simulation) -> dict[str, tuple[Kernel, tuple[Any, ...]]]:
    """The laws by name, with copies of the arguments that they have at this moment of a drive."""
    stage = simulation.hierarchy.learner
    assert isinstance(stage, Learner)
    seen, goal, state = (records.copy()[0] for records in (*simulation.sense(), simulation.hierarchy.state))
    robot, prior, period, arrays = (
        stage.robot[0],
        stage.prior.rows[0],
        simulation.scenarios[0].control_period,
        copy.deepcopy(stage.arrays),
    )
    limiter, allocation = state["limiter"], state["allocation"]
    command, derivative = limiter["command"], limiter["derivative"]
    feedback, feedforward, voltage = state["feedback"], state["feedforward"], state["voltage"]
    shown = Shown(command, derivative, feedback, 0.0, seen["twist"], voltage, period)
    named = {
        "posture error": (posture_error, (seen["pose"], goal["pose"], state["error"])),
        "motion controller": (kanayama, (state["error"], goal["twist"], state["kanayama"], state["request"])),
        "limiter": (
            limit,
            (state["request"], goal["twist"], goal["acceleration"], robot["max_twist"], robot["max_acceleration"],
             period, limiter),
        ),
        "PID": (pid, (command, seen["twist"], allocation["excess"], period, state["pid"], feedback)),
        "guard": (
            guard,
            (state["guard"], feedforward, state["nominal"], state["error"], command, seen["twist"], voltage, period,
             bool(robot["rigid"]), state["pid"]["integral"], feedback),
        ),
        "steering": (steer, (command, derivative, feedback, feedforward, period, robot, allocation)),
        "allocation": (allocate, (command, feedback, feedforward, period, robot, allocation)),
        "feedforward": (stage.respond, (0, command, derivative, robot, arrays, feedforward)),
        "learning": (
            stage.learn_one,
            (0, shown, robot, prior, arrays, state["added"]),
        ),
    }  # fmt: skip
    return {name: (function, arguments) for name, (function, arguments) in named.items() if function not in EMPTY}


def tick_cost(simulation: Simulation) -> float:
    """Drives on for a turn; returns the seconds that a control tick takes."""
    update, seconds = simulation.hierarchy.update, []

    def timed(*arguments: Any) -> object:
        start = time.perf_counter()
        output = update(*arguments)
        seconds.append(time.perf_counter() - start)
        return output

    with mock.patch.object(simulation.hierarchy, "update", timed):
        for _ in range(TICKS):
            simulation.step()
    return statistics.median(seconds)


@cache
def loop_of(function: Kernel) -> Kernel:
    """`repeat` with a law."""
    return repeat.calling(law=function)


def law_cost(function: Kernel, arguments: tuple[Any, ...]) -> float:
    """Seconds that a call of a law takes, without what it costs to enter the loop from Python."""
    loop = loop_of(function).compiled
    loop(1, *arguments)
    clock = [time.perf_counter()]
    for times in (0, 0, 0, 0, CALLS):
        loop(times, *arguments)
        clock.append(time.perf_counter())
    *entries, whole = (end - start for start, end in pairwise(clock))
    return (whole - min(entries)) / CALLS


def measure(feedforward: str) -> list[list[str]]:
    """A row of text for the control tick with a feedforward and for each law: name, ns, ratio to the tick."""
    laps = math.ceil((WARM + TURNS * TICKS + 1) / Scenario(laps=1).ticks)
    simulation = Simulation([Scenario.from_dict({**FEEDFORWARDS[feedforward], "laps": laps})], threads=1)
    for _ in range(WARM):
        simulation.step()
    ticks, costs = [], {name: [] for name in laws(simulation)}
    for _ in range(TURNS):
        ticks.append(tick_cost(simulation))
        for name, (function, arguments) in laws(simulation).items():
            costs[name].append(law_cost(function, arguments))
    rows = [["control tick", f"{1e9 * statistics.median(ticks):.0f}", "1"]]
    for name, spent in costs.items():
        ratio = statistics.median(cost / tick for cost, tick in zip(spent, ticks, strict=True))
        rows.append([name, f"{1e9 * statistics.median(spent):.0f}", number(ratio)])
    return [[f"{name} ({feedforward})" if name in OWN else name, *figures] for name, *figures in rows]


if __name__ == "__main__":
    first, *others = MEASURED
    table = measure(first)
    for other in others:
        table += [row for row in measure(other) if row[0].endswith(f"({other})")]
    print(markdown(("law", "ns", "ratio to a control tick"), table))
