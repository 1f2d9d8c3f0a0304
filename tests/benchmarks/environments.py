"""How much of the closed loop's speed is left to an agent? `python tests/benchmarks/environments.py`.

The vector environment takes turns with `Simulation.step`, which is what `mrctl bench` times, on the same scenario in
one process on one thread; learning in every robot, zero residual. A share is the median over neighbouring turns. Then
the same with episodes that end after a second each, so that a robot in a hundred begins again at every step, and the
time that a new episode takes.
"""

import statistics
import time
from collections.abc import Callable

import numpy as np

from mrctl import Line, Scenario
from mrctl.envs.gym import TrackingVectorEnv
from mrctl.loop.simulation import Simulation

TURNS, TICKS = 41, 1500  # turns, and control periods of one over all robots


def seconds(step: Callable[[], object], ticks: int) -> float:
    """Time of so many steps."""
    start = time.perf_counter()
    for _ in range(ticks):
        step()
    return time.perf_counter() - start


def measure(size: int) -> None:
    """Prints what it finds for a number of robots."""
    ticks = max(1, TICKS // size)
    laps = 1 + (TURNS + 2) * ticks // 1000
    scenario = Scenario(laps=laps)
    loop = Simulation([scenario.model_copy(update={"seed": k}) for k in range(size)], threads=1)
    zero = np.zeros((size, 2))
    env = TrackingVectorEnv(size, scenario, threads=1)
    short = TrackingVectorEnv(size, Scenario(reference=Line(speed=0.5, length=0.5), laps=1), threads=1)
    steps = (loop.step, lambda: env.step(zero), lambda: short.step(zero))
    env.reset(seed=0), short.reset(seed=0)
    for row in range(size):  # ends that are spread over the steps
        short.episodes.start[row] -= row % 100
    for step in steps:
        seconds(step, ticks)
    turns = [[seconds(step, ticks) for step in steps] for _ in range(TURNS)]
    rate = ticks * size * round(scenario.control_period / scenario.physics_step)
    plain, agent, restless = (rate / statistics.median(column) for column in zip(*turns, strict=True))
    share, rest = (statistics.median(t[0] / t[k] for t in turns) for k in (1, 2))
    begin = 1e6 * seconds(lambda: env.episodes.begin(0, 1), 50) / 50
    print(f"{size:5} robots: loop {plain:9,.0f} steps/s, environment {agent:9,.0f}, share {share:.2f}; ", end="")
    print(f"episodes of a second {restless:9,.0f}, share {rest:.2f}; a new episode {begin:.0f} µs")


if __name__ == "__main__":
    for robots in (1, 16, 64, 256):
        measure(robots)
