"""`mrctl bench`: the speed of the closed loop, compared with the engine alone and with a loop in NumPy and torch.

The tables of navigation are those of `mrctl.experiments.bench_navigation`.
"""

from __future__ import annotations

import gc
import math
import os
import resource
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from functools import partial
from typing import Any
from unittest import mock

import numpy as np
import torch
from tqdm import tqdm

from mrctl.control.features import feature_scale
from mrctl.experiments import bench_navigation, paper
from mrctl.experiments.tables import machine, markdown, number
from mrctl.loop.hierarchy import Hierarchy
from mrctl.loop.log import Log
from mrctl.loop.runs import run as run_all
from mrctl.loop.runs import split
from mrctl.loop.simulation import Simulation
from mrctl.physics.car import CarPhysics
from mrctl.physics.mjcf import load
from mrctl.physics.parameters import read_robot
from mrctl.physics.plant import BatchPlant, Plant
from mrctl.physics.stand import stand
from mrctl.results.dataset import versions
from mrctl.scenario import Scenario
from mrctl.sensing.estimators import Estimator
from mrctl.sensing.tiers import Sensing, Tier
from mrctl.theory.kinematics import steering_angle

SIZES = (1, 16, 64, 256, 1024)
REPETITIONS = 41  # many short turns, so that neighbouring turns share the load of the machine
TICKS_PER_TURN = 1500  # control periods of one turn, summed over the robots; a turn takes a twentieth of a second
WARM_TICKS = 20  # control periods before the measurement begins
CONTROLS = ["voltage_left", "voltage_right", "steering_command", "steering_rate_command"]
PARTS: dict[str, tuple[Any, str]] = {
    "physics": (BatchPlant, "_advance"),
    "sensors and estimator": (Estimator, "measure"),
    "control and learning": (Hierarchy, "update"),
    "actuation (delay, supply)": (Plant, "send"),
    "readout, currents": (Plant, "look"),
    "record": (Log, "record"),
}
STOPWATCH = "stopwatch"
STOPWATCH_TURNS = 16  # of the loop with and without stopwatches
MIN_STOPWATCH_TICKS = 17  # of such a turn; so both kinds meet a tick in which the sensors' noise is drawn, each 256th


def run(
    sizes: Sequence[int] = SIZES,
    repetitions: int = REPETITIONS,
    chunk: int = TICKS_PER_TURN,
    worlds: int = bench_navigation.WORLDS,
) -> dict[str, Any]:
    """Measures the speed of the closed loop and of its parts, and of navigation, in three minutes on two cores.

    The closed loop (Kanayama, PID, `fel` learning in every robot, record) and its limit (open-loop `Batch.rollout` of
    the controls just recorded, from the same state, recording nothing) take turns in one process on one model. A ratio
    is the median of the ratios of neighbouring turns, because other work on the machine slows both.

    Args:
        sizes: Numbers of robots.
        repetitions: Number of turns of each.
        chunk: Control periods of one turn, summed over the robots.
        worlds: Number of worlds of either kind in which plans are made.

    Returns:
        `machine`; `robots`, a row for each size on one thread; `threads`, rows for one thread and for two; `lab`, such
        a row with the sensors, the filter and the motor driver of that tier, whose rollouts have other bits; `parts`,
        µs per control period in that tier by component, for the smallest and the largest size; `sensing_share`, the
        share of sensors and estimator in it; `today`, the dm_control and autograd loop; and
        `navigation`, what `bench_navigation.run` returns.
    """
    gc.collect()
    gc.freeze()  # as in the workers of a sweep
    threads = [1, 2] if (os.cpu_count() or 1) > 1 else [1]
    middle = sizes[len(sizes) // 2]
    rows = [_compare(size, 1, repetitions, chunk) for size in tqdm(sizes, unit="size")]
    parts = {str(size): _parts(size, 10 * chunk) for size in tqdm((sizes[0], sizes[-1]), unit="size", desc="parts")}
    return {
        "machine": {**machine(), **versions()},
        "robots": rows,
        "threads": [_compare(middle, count, repetitions, chunk) for count in tqdm(threads, desc="threads")],
        "lab": _compare(middle, 1, repetitions, chunk, "lab"),
        "parts": parts,
        "sensing_share": {size: p["sensors and estimator"] / sum(p.values()) for size, p in parts.items()},
        "today": _today(repetitions, chunk),
        "navigation": bench_navigation.run(repetitions, worlds),
    }


def text(figures: dict[str, Any]) -> str:
    """Returns the figures of `run` as Markdown; those of earlier versions have no `navigation`."""
    machine, today = figures["machine"], figures["today"]

    def table(rows: list[dict[str, Any]]) -> str:
        header = ("robots", "threads", "steps/s", "× real time", "engine alone, steps/s", "ratio", "µs a tick", "MiB")
        return markdown(
            header,
            [
                [
                    str(r["robots"]), str(r["threads"]), f"{r['steps_per_second']:,.0f}",
                    f"{r['real_time_factor']:,.0f}", f"{r['limit_steps_per_second']:,.0f}", f"{r['ratio']:.3f}",
                    number(r["overhead_us_per_tick"]), f"{r['memory_mib']:.0f}",
                ]
                for r in rows
            ],
        )  # fmt: skip

    sizes = list(figures["parts"])
    parts = [[name, *(f"{figures['parts'][size][name]:.2f}" for size in sizes)] for name in figures["parts"][sizes[0]]]
    shares = [f"{100 * share:.1f} % with {size}" for size, share in figures["sensing_share"].items()]
    exact = all(r["replayed_exactly"] for r in figures["robots"] + figures["threads"])
    return "\n\n".join(
        [
            f"{machine['processor']}, {machine['cores']} cores, mujoco {machine['mujoco']}",
            "Closed loop (Kanayama, PID, fel learning in every robot, all recorded) on the batch engine, beside\n"
            "open-loop rollouts of the same controls. Ratio: of their speeds. µs a tick: what the loop takes longer.",
            table(figures["robots"]),
            table(figures["threads"]),
            "With the sensors, the filter and the motor driver of `lab`:",
            table([figures["lab"]]),
            f"There, sensors and filter take {' and '.join(shares)} robots of the loop.",
            f"The rollouts of the other tables came to the same bits: {'yes' if exact else 'NO'}",
            f"One dm_control physics, NumPy laws and torch autograd: {today['steps_per_second']:,.0f} steps/s; "
            f"the closed loop with one robot is {today['closed_loop_is_faster_by']:.1f} times as fast.",
            "µs a control period in `lab`:",
            markdown(["part", *(f"{size} robot{'s' * (size != '1')}" for size in sizes)], parts),
            *([bench_navigation.text(figures["navigation"])] if "navigation" in figures else []),
        ]
    )


def build(size: int, ticks: int, threads: int = 1, tier: Tier = "ideal") -> list[Simulation]:
    """Builds closed loops with `fel` in every robot on the batch engine, also for one robot, and warms them up.

    Args:
        size: Number of robots, which differ in their seeds.
        ticks: Number of control periods that they will be driven after that.
        threads: Number of threads, each of which gets a simulation with its share of the robots, as in `simulate`.
        tier: Sensing tier; the record of `ideal` alone holds the voltages that act.
    """
    laps = math.ceil((WARM_TICKS + ticks) / Scenario(laps=1).ticks)
    scenarios = [Scenario(seed=seed, laps=laps, sensing=Sensing(tier=tier)) for seed in range(size)]
    with mock.patch("mrctl.loop.simulation.build", BatchPlant):
        simulations = [simulation for _, simulation in split(scenarios, list(range(size)), threads)]
    for simulation in simulations:
        simulation.log.ticks.view(float).fill(np.nan)  # memory that a virtual machine must first get takes 14 µs a page
    run_all(simulations, ticks=WARM_TICKS)
    return simulations


def turn(simulations: Sequence[Simulation], ticks: int) -> tuple[float, float, bool]:
    """Drives on in closed loop, then replays the same stretch open loop, each simulation in a thread of its own.

    Args:
        simulations: Simulations on a `BatchPlant`, with nominal robots.
        ticks: Control periods.

    Returns:
        Seconds in closed loop, seconds of the rollout, and whether the rollout ended with the same bits of `qpos`.
    """
    plants = [simulation.plant for simulation in simulations if isinstance(simulation.plant, BatchPlant)]
    first = simulations[0].tick
    before = [plant.batch.state.copy() for plant in plants]
    start = time.perf_counter()
    run_all(simulations, ticks=ticks)
    closed = time.perf_counter() - start
    after, qpos = [plant.batch.state.copy() for plant in plants], [plant.qpos.copy() for plant in plants]
    held = []
    for simulation in simulations:
        recorded = simulation.log.ticks[first : first + ticks]
        controls = np.stack([recorded[name].T for name in CONTROLS], axis=-1)
        held.append(np.repeat(controls, simulation.plant.substeps, axis=1))
    for plant, state in zip(plants, before, strict=True):
        plant.batch.state[:] = state
    rollouts = [partial(p.batch.rollout, h.shape[1], h, record=()) for p, h in zip(plants, held, strict=True)]
    start = time.perf_counter()
    if len(rollouts) == 1:
        rollouts[0]()
    else:
        with ThreadPoolExecutor(len(rollouts)) as pool:
            list(pool.map(lambda rollout: rollout(), rollouts))
    limit = time.perf_counter() - start
    same = all(np.array_equal(plant.qpos, q) for plant, q in zip(plants, qpos, strict=True))
    for plant, state in zip(plants, after, strict=True):
        plant.batch.state[:] = state
    return closed, limit, same


def _compare(size: int, threads: int, repetitions: int, chunk: int, tier: Tier = "ideal") -> dict[str, Any]:
    gc.collect()
    memory = _resident()
    ticks = max(2, threads * chunk // size)
    simulations = build(size, ticks * repetitions, threads, tier)
    turns = []
    for _ in range(repetitions):
        gc.collect()
        turns.append(turn(simulations, ticks))
    closed, limit = (statistics.median(column) / ticks for column in list(zip(*turns, strict=True))[:2])
    first = simulations[0]
    steps = size * first.plant.substeps
    return {
        "robots": size,
        "threads": threads,
        "steps_per_second": steps / closed,
        "limit_steps_per_second": steps / limit,
        "real_time_factor": size * first.period / closed,
        "ratio": statistics.median(limit / closed for closed, limit, _ in turns),
        "overhead_us_per_tick": 1e6 * statistics.median(c - limit for c, limit, _ in turns) / ticks,
        "replayed_exactly": all(same for _, _, same in turns),
        "memory_mib": (_resident() - memory) / 2**20,
        "ticks": first.tick,
    }


def _today(repetitions: int, chunk: int) -> dict[str, float]:
    """Measures the closed loop with one robot and the autograd loop, which take turns."""
    ticks = max(chunk // 15, 20)
    simulations = build(1, ticks * repetitions)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # faster for a network this small
    turns = []
    try:
        for seconds, rmse in autograd_loop(ticks, repetitions):
            turns.append((seconds, turn(simulations, ticks)[0], rmse))
    finally:
        torch.set_num_threads(threads)
    return {
        "steps_per_second": simulations[0].plant.substeps * ticks / statistics.median(theirs for theirs, _, _ in turns),
        "closed_loop_is_faster_by": statistics.median(theirs / ours for theirs, ours, _ in turns),
        "position_rmse": turns[-1][2],
    }


def _parts(size: int, chunk: int) -> dict[str, float]:
    """Measures the mean µs per control period of the loop and of each component, in turns, while the loop runs.

    Means, because some ticks cost more: those with a late fix, and each 256th, in which the sensors' noise is drawn.
    """
    ticks = max(MIN_STOPWATCH_TICKS, chunk // size // STOPWATCH_TURNS)
    (simulation,) = build(size, 2 * ticks * STOPWATCH_TURNS, tier="lab")
    whole, seconds = 0.0, {}
    for _ in range(STOPWATCH_TURNS):
        start = time.perf_counter()
        for _ in range(ticks):
            simulation.step()
        whole += time.perf_counter() - start
        with _stopwatches(seconds):
            for _ in range(ticks):
                simulation.step()
    own = statistics.mean(seconds.pop(STOPWATCH))
    parts = {name: 1e6 * (sum(spent) / (ticks * STOPWATCH_TURNS) - own) for name, spent in seconds.items()}
    return parts | {"the rest": 1e6 * whole / (ticks * STOPWATCH_TURNS) - sum(parts.values())}


@contextmanager
def _stopwatches(seconds: dict[str, list[float]]) -> Iterator[None]:
    """Adds the times of each part to `seconds` and, under `STOPWATCH`, those of an empty call, which all contain."""

    def watched(function: Callable[..., Any], name: str) -> Callable[..., Any]:
        spent = seconds.setdefault(name, [])

        def watch(*arguments: object) -> object:
            start = time.perf_counter()
            answer = function(*arguments)
            spent.append(time.perf_counter() - start)
            return answer

        return watch

    with ExitStack() as stack:
        for name, (owner, attribute) in PARTS.items():
            stack.enter_context(mock.patch.object(owner, attribute, watched(getattr(owner, attribute), name)))
        nothing = watched(lambda *_: None, STOPWATCH)
        for _ in range(100):
            nothing(None, None, None)
        yield


def autograd_loop(ticks: int, stretches: int) -> Iterator[tuple[float, float]]:
    """Drives a loop as people write it today: one dm_control physics, laws in NumPy, a torch network trained each tick.

    Robot, reference, rates and laws are the same (without the limits on acceleration, which never act here), and so is
    the network of 8, 24 and 2 units. Autograd does plain gradient descent on the feedback voltage; dm_control has its
    defaults.

    Args:
        ticks: Number of control periods of a stretch.
        stretches: Number of stretches, which follow one another.

    Yields:
        Seconds that a stretch took, and its RMS position error in m.
    """
    scenario = Scenario(**paper.IDEAL)
    period, substeps = scenario.control_period, round(scenario.control_period / scenario.physics_step)
    physics = CarPhysics.from_world(scenario.world)
    physics.legacy_step = True  # dm_control's default, with which sensors are current after a step
    sensors = physics.named.data.sensordata
    robot = read_robot(load(scenario.world))
    motion = scenario.reference.sample(period * np.arange(ticks * stretches + 1, dtype=float))
    reference = np.hstack(motion)
    gains = scenario.pid.gains(robot, rigid=False)
    k_p, k_i = np.array(gains["k_p"]), np.array(gains["k_i"])
    k_x, k_y, k_theta = scenario.kanayama.model_dump().values()
    prefilter: float = paper.IDEAL["prefilter"]
    smooth = period / prefilter
    scale = feature_scale(robot)
    last = torch.nn.Linear(24, 2)
    torch.nn.init.zeros_(last.weight)
    torch.nn.init.zeros_(last.bias)
    network = torch.nn.Sequential(torch.nn.Linear(8, 24), torch.nn.Tanh(), last)
    optimizer = torch.optim.SGD(network.parameters(), lr=1e-3)
    start = stand(physics.model.ptr, reference[0, :3], reference[0, 3:5])
    with physics.reset_context():
        physics.data.qpos[:], physics.data.qvel[:] = start
    correction, integral, fork = np.zeros(2), np.zeros(2), physics.steering_angle()
    begin, squares = 0.0, []
    for tick in range(ticks * stretches):
        if tick % ticks == 0:
            begin, squares = time.perf_counter(), []
        w, i, j, k = sensors["orientation"]
        pose = np.array([*sensors["position"][:2], np.arctan2(2 * (i * j + w * k), 1 - 2 * (j * j + k * k))])
        twist = np.array([sensors["velocity"][0], sensors["rotation"][2]])
        goal, wanted, acceleration = reference[tick, :3], reference[tick, 3:5], reference[tick, 5:]
        c, s = np.cos(pose[2]), np.sin(pose[2])
        error = np.array([[c, s], [-s, c]]) @ (goal[:2] - pose[:2])
        turn = (goal[2] - pose[2] + np.pi) % (2 * np.pi) - np.pi
        request = np.array(
            [
                wanted[0] * np.cos(turn) + k_x * error[0],
                wanted[1] + wanted[0] * (k_y * error[1] + k_theta * np.sin(turn)),
            ]
        )
        rate = (request - wanted - correction) / prefilter
        correction = correction + smooth * (request - wanted - correction)
        command, derivative = wanted + correction, acceleration + rate
        deviation = command - twist
        integral = integral + period * k_i * deviation
        feedback = k_p * deviation + integral
        v, omega = command
        wheels = np.tanh((v + np.array([-1, 1]) * robot.half_track * omega) / 0.05)
        features = np.array([v, omega, *derivative, v * omega, omega**2, *wheels]) / scale
        output = network(torch.from_numpy(features.astype(np.float32)))
        feedforward = 6.0 * output.detach().numpy()
        common, differential = feedback + feedforward
        voltage = np.clip([common - differential, common + differential], -robot.supply, robot.supply)
        angle = steering_angle(command, robot)
        physics.set_control([*voltage, angle, (angle - fork) / period])
        fork = angle
        loss = -torch.dot(output, torch.from_numpy(feedback.astype(np.float32)))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        physics.step(substeps)
        squares.append(error @ error)
        if tick % ticks == ticks - 1:
            yield time.perf_counter() - begin, float(np.sqrt(np.mean(squares)))


def _resident() -> float:
    """Returns the resident memory of this process in bytes: its present value on Linux, elsewhere its peak."""
    try:
        with open("/proc/self/statm") as file:
            return int(file.read().split()[1]) * resource.getpagesize()
    except OSError:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
