"""`mrctl tune`: designs the velocity PID of a robot; computes and measures its margins and where learning is safe."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from mrctl.control.kanayama import Kanayama
from mrctl.control.margins import learning_ratio, margins, sampled_loop
from mrctl.control.pid import Pid
from mrctl.experiments.response import Array, Response, measure, refine, safety
from mrctl.experiments.tables import json_text, machine, markdown, number, output_folder
from mrctl.loop.hierarchy import TAKE_OVER
from mrctl.physics import mjcf
from mrctl.physics.parameters import read_robot
from mrctl.record import InputError
from mrctl.results import plots
from mrctl.results.dataset import versions
from mrctl.scenario import Scenario

CHANNELS = (("common", "V/(m/s)", "V/m"), ("differential", "V/(rad/s)", "V/rad"))
LOOPS = (("compliant", 0), ("compliant", 1), ("caster", 1), ("rigid", 1))
"""Steering arrangement and channel of each loop; the common channel is the same under all three arrangements."""
RESPONSES = {"design": "equation (3)", "measured": "measured", "hierarchy": "measured with motion controller"}
STYLES: dict[str, dict[str, Any]] = {
    "design": {"lw": 0.8},
    "measured": {"ls": "", "marker": ".", "ms": 4},
    "hierarchy": {"lw": 0.8, "ls": "--"},
}
MARGINS = {
    "crossover": "crossover, rad/s",
    "bandwidth": "bandwidth, rad/s",
    "phase": "phase margin, °",
    "gain": "gain margin",
}
SAFETY = {"positive_to": "Re T > 0 to, rad/s", "lowest": "least Re T", "step": "largest step"}
ADVICE = f"""\
Learning by feedback error is safe at frequencies where Re T > 0; with the hand-over of the built-in learners, where
Re T > {-TAKE_OVER / (1 - TAKE_OVER):g}. Both hold for commands that do not depend on the motion of the robot; a fast
motion controller behind a delay narrows them. Above the largest step a learner of one constant oscillates without
hand-over: choose at most half of it."""


def tune(world: str, time_constant: float, delays: Sequence[float], out: Path | None, json: bool) -> str:
    """The command: designs and measures; writes `table.json` and the figure `sensitivity` to `out` unless it is None.

    Raises:
        InputError: As `design`, or the folder cannot be written.
    """
    if out is not None:
        output_folder(out)
    asked = Pid.from_dict({"time_constant": time_constant})
    # `faster` also scales the gains of the steering, which go with the time constant.
    table = design(world, Pid().faster(Pid().time_constant / asked.time_constant), delays)
    if out is not None:
        (out / "table.json").write_text(json_text(table) + "\n")
        plots.save(figure(table), out, "sensitivity")
    return json_text(table) if json else text(table)


def design(world: str, pid: Pid, delays: Sequence[float]) -> dict[str, Any]:
    """Margins and safety of the loops of a PID design, by equation (3) and measured on the physics.

    Args:
        world: World or MJCF file.
        pid: The design; equation (3) is evaluated without its derivative part.
        delays: Loop delays in s, in whole control periods, in addition to the hold.

    Returns:
        For each channel static gain, time constant, PI gains and the ratio of the learning condition; `loops`, a row
        for each of `LOOPS` and each delay, with `Margins` and `Safety` for each of `RESPONSES`; `frequency` in rad/s
        and `responses`, T of the same rows.

    Raises:
        InputError: The world or a delay is bad, or the robot fails with that delay.
    """
    if not delays:
        raise InputError("delay: at least one delay is needed")
    scenarios = [
        Scenario.from_dict(
            {
                "world": world,
                "pid": pid.model_dump(),
                "kanayama": motion.model_dump(),
                "perturbation": {"control_delay": delay},
            }
        )
        for motion in (Kanayama(k_x=0, k_y=0, k_theta=0), Kanayama())
        for delay in delays
    ]
    robot = read_robot(mjcf.load(world))
    period = scenarios[0].control_period
    plants = (
        (robot.velocity_gain, robot.velocity_time_constant),
        (robot.rotation_gain, robot.rotation_time_constant),
    )
    table: dict[str, Any] = {"versions": versions(), "machine": machine(), "time_constant": pid.time_constant}
    table |= {"loops": [], "responses": []}
    for (name, *_), (gain, tau), gains in zip(CHANNELS, plants, pid.channels(robot, rigid=False), strict=True):
        table[name] = {"static_gain": gain, "plant_time_constant": tau, **gains._asdict()}
        table[name]["ratio"] = learning_ratio(gain, tau, gains)
    for steering, channel in LOOPS:
        frequency, measured = measure([s.model_copy(update={"steering": steering}) for s in scenarios], channel)
        rigid = steering == "rigid"
        plant = (1.0, 0.0) if rigid else plants[channel]  # the steering is taken as ideal
        gains = pid.channels(robot, rigid)[channel]
        for k, delay in enumerate(delays):
            loop = sampled_loop(frequency, *plant, gains, period, delay)
            found = dict(zip(RESPONSES, (loop / (1 + loop), measured[k], measured[len(delays) + k]), strict=True))
            row = {"steering": steering, "channel": channel, "delay": delay}
            table["loops"].append(row | {name: _judge(frequency, found[name], period) for name in RESPONSES})
            table["responses"].append(row | {n: _parts(t) for n, t in found.items()})
        table["frequency"] = frequency.tolist()
    return table


def _parts(response: Response) -> dict[str, list[float]]:
    return {"real": response.real.tolist(), "imaginary": response.imag.tolist()}


def _judge(frequency: Array, response: Response, period: float) -> dict[str, float]:
    fine, t = refine(frequency, response)
    return margins(fine, t / (1 - t))._asdict() | safety(fine, t, period)._asdict()


def text(table: dict[str, Any]) -> str:
    """The design as text."""
    lines = [f"closed-loop time constant {table['time_constant']:g} s"]
    for name, unit_p, unit_i in CHANNELS:
        c = table[name]
        verdict = "converges" if c["ratio"] > 1 else "does not converge"
        lines += [
            f"{name}: plant gain {c['static_gain']:.4g}, time constant {c['plant_time_constant']:.3f} s, "
            f"K_p {c['k_p']:.3g} {unit_p}, K_i {c['k_i']:.3g} {unit_i}",
            f"  learning without delay and hold: K_p (B + b K_p) / (M K_i) = {c['ratio']:.2f}, {verdict} above 1",
        ]
    rows = [
        [
            _name(row),
            f"{1e3 * row['delay']:g}",
            *(" / ".join(_cell(row[kind][name]) for kind in list(RESPONSES)[:2]) for name in MARGINS),
            *(" / ".join(_cell(row[kind][name]) for kind in RESPONSES) for name in SAFETY),
        ]
        for row in table["loops"]
    ]
    header = ["loop", "delay, ms", *MARGINS.values(), *SAFETY.values()]
    return "\n".join([*lines, "", f"{' / '.join(RESPONSES.values())}:", "", markdown(header, rows), "", ADVICE])


def statement(table: dict[str, Any]) -> str:
    """Measured bandwidth and margins without delay, in one line for the report of a comparison."""
    loops = [
        f"{_name(row)} {' / '.join(_cell(row['measured'][name]) for name in ('bandwidth', 'phase', 'gain'))}"
        for row in table["loops"]
        if row["delay"] == 0
    ]
    return (
        f"PID by the IMC rule with λ = {table['time_constant']:g} s; bandwidth in rad/s / phase margin in degrees / "
        f"gain margin as measured: {'; '.join(loops)}"
    )


def _name(row: dict[str, Any]) -> str:
    return "common" if row["channel"] == 0 else f"{row['steering']}, second"


def _cell(value: float) -> str:
    return number(value) if np.isfinite(value) else "–"


@plots.styled
def figure(table: dict[str, Any]) -> Figure:
    """Re T(jω) by equation (3), measured, and in the whole hierarchy; below zero, learning is not safe."""
    drawn = Figure(figsize=(plots.PAGE, 0.7 * plots.PAGE), layout="constrained")
    panels = list(drawn.subplots(2, 2, sharex=True, sharey=True).flat)
    frequency = table["frequency"]
    marks = np.unique(np.geomspace(1, len(frequency), 30).astype(int) - 1).tolist()  # dots evenly spread
    rows, loops = table["responses"], list(dict.fromkeys(map(_name, table["responses"])))
    for axes, name in zip(panels, loops, strict=True):
        axes.axhspan(-2, 0, color="0.93", zorder=0)
        for k, row in enumerate(r for r in rows if _name(r) == name):
            for kind, style in STYLES.items():
                colour = plots.COLOURS[k % len(plots.COLOURS)]
                axes.plot(frequency, row[kind]["real"], color=colour, markevery=marks, **style)
        axes.set(xscale="log", ylim=(-0.8, 1.6), title=name)
    for axes in panels[2:]:
        axes.set_xlabel("ω (rad/s)")
    for axes in panels[::2]:
        axes.set_ylabel(r"Re $T(\mathrm{j}\omega)$")
    delays = [1e3 * row["delay"] for row in rows if _name(row) == loops[0]]
    handles = [Line2D([], [], color=c, label=f"{d:g} ms") for d, c in zip(delays, plots.COLOURS, strict=False)]
    handles += [Line2D([], [], color="0.3", label=RESPONSES[kind], **style) for kind, style in STYLES.items()]
    drawn.legend(handles=handles, loc="outside upper center", ncols=3)
    return drawn
