"""`mrctl tune`: the velocity PID of a robot, its margins, and where learning is safe; designed and measured."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from mrctl import model as mjcf
from mrctl import plots
from mrctl.control.kanayama import Kanayama
from mrctl.control.pid import Gains, Pid, learning_ratio, margins, sampled_loop
from mrctl.experiments.response import measure, refine, safety
from mrctl.experiments.tables import markdown, number, output_folder, write_json
from mrctl.record import InputError
from mrctl.robot import Perturbation
from mrctl.scenario import Scenario

CHANNELS = (("common", "V/(m/s)", "V/m"), ("differential", "V/(rad/s)", "V/rad"))
LOOPS = (("compliant", 0), ("compliant", 1), ("caster", 1), ("rigid", 1))
"""Steering arrangement and channel; the common channel is the same for all three."""
RESPONSES = {"design": "equation (3)", "measured": "velocity loop", "hierarchy": "with motion controller"}


def design(world: str, time_constant: float, delays: Sequence[float]) -> dict[str, Any]:
    """PID design of the robot in a world, and the loops that come of it, on paper and on the physics.

    Args:
        world: World or MJCF file.
        time_constant: λ in s.
        delays: Loop delays in s, whole control periods, beside the hold.

    Returns:
        Per channel static gain, time constant, PI gains and the ratio of the learning condition; `loops`, a row for
        every one of `LOOPS` and every delay, with `Margins` and `Safety` for each of `RESPONSES`; `frequency` and
        `responses`, T of the same rows as they were measured.

    Raises:
        InputError: A bad world, time constant or delay, or one that the robot does not survive.
    """
    base = Pid.from_dict({"time_constant": time_constant})
    pid = Pid().faster(Pid().time_constant / base.time_constant)
    perturbations = [Perturbation.from_dict({"control_delay": delay}) for delay in delays]
    scenarios = [
        Scenario.from_dict({"world": world, "pid": pid.model_dump(), "perturbation": p.model_dump(), "kanayama": gains})
        for gains in ({"k_x": 0.0, "k_y": 0.0, "k_theta": 0.0}, Kanayama().model_dump())
        for p in perturbations
    ]
    robot = mjcf.read_robot(mjcf.load(world))
    period = scenarios[0].control_period
    plants = (
        (robot.velocity_gain, robot.velocity_time_constant),
        (robot.rotation_gain, robot.rotation_time_constant),
    )
    table: dict[str, Any] = {"time_constant": time_constant, "loops": [], "responses": []}
    for (name, *_), (gain, tau), row in zip(CHANNELS, plants, pid.gains(robot, rigid=False), strict=True):
        gains = Gains(*row[:2])
        table[name] = {"static_gain": gain, "plant_time_constant": tau, **gains._asdict()}
        table[name]["ratio"] = learning_ratio(gain, tau, gains)
    for steering, channel in LOOPS:
        frequency, measured = measure([s.model_copy(update={"steering": steering}) for s in scenarios], channel)
        rigid = steering == "rigid"
        plant = (1.0, 0.0) if rigid else plants[channel]  # the steering is taken to do what it is asked to
        gains = Gains(*pid.gains(robot, rigid)[channel, :2])
        for k, delay in enumerate(delays):
            loop = sampled_loop(frequency, *plant, gains, period, delay)
            found = dict(zip(RESPONSES, (loop / (1 + loop), measured[k], measured[len(delays) + k]), strict=True))
            row = {"steering": steering, "channel": channel, "delay": delay}
            table["loops"].append(row | {name: _judge(frequency, found[name], period) for name in RESPONSES})
            table["responses"].append(row | {n: {"real": t.real, "imaginary": t.imag} for n, t in found.items()})
        table["frequency"] = frequency
    return table


def _judge(frequency: np.ndarray, response: np.ndarray, period: float) -> dict[str, float]:
    fine, t = refine(frequency, response)
    return margins(fine, t / (1 - t))._asdict() | safety(fine, t, period)._asdict()
