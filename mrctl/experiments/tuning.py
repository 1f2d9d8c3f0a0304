"""`mrctl tune`: the velocity PID of a robot, its margins, and where learning is safe."""

from __future__ import annotations

from typing import Any

from mrctl import model as mjcf
from mrctl.control.pid import Pid, imc, margins
from mrctl.record import InputError
from mrctl.scenario import Scenario

CHANNELS = (("common", "V/(m/s)", "V/m"), ("differential", "V/(rad/s)", "V/rad"))


def design(world: str, time_constant: float, delay: float) -> dict[str, Any]:
    """PID design of the robot in a world.

    Args:
        world: World or MJCF file.
        time_constant: λ in s.
        delay: Loop delay in s beside half a control period of hold.

    Returns:
        Per channel: static gain, time constant, gains and `Margins`.

    Raises:
        InputError: A bad world, time constant or delay.
    """
    Pid.from_dict({"time_constant": time_constant})
    if not 0 <= delay <= 0.5:
        raise InputError("delay: must be between 0 and 0.5 s")
    robot = mjcf.read_robot(mjcf.load(world))
    hold = Scenario().control_period / 2
    plants = (
        (robot.velocity_gain, robot.velocity_time_constant),
        (robot.rotation_gain, robot.rotation_time_constant),
    )
    table: dict[str, Any] = {"time_constant": time_constant, "delay": delay + hold}
    for (name, *_), (gain, tau), gains in zip(CHANNELS, plants, imc(robot, time_constant), strict=True):
        found = margins(gain, tau, gains, delay + hold)
        table[name] = {"static_gain": gain, "plant_time_constant": tau, **gains._asdict(), **found._asdict()}
    return table


def text(table: dict[str, Any]) -> str:
    """The design in words and numbers."""
    lines = [f"closed-loop time constant {table['time_constant']:g} s, delay with hold {1e3 * table['delay']:g} ms"]
    for name, unit_p, unit_i in CHANNELS:
        c = table[name]
        verdict = "converges" if c["ratio"] > 1 else "does not converge"
        lines += [
            f"{name}: plant gain {c['static_gain']:.4g}, time constant {c['plant_time_constant']:.3f} s",
            f"  K_p {c['k_p']:.3g} {unit_p}, K_i {c['k_i']:.3g} {unit_i}",
            f"  crossover {c['crossover']:.2f} rad/s, phase margin {c['phase']:.1f}°, gain margin {c['gain']:.3g}, "
            f"delay margin {1e3 * c['delay']:.0f} ms",
            f"  learning without delay: K_p (B + b K_p) / (M K_i) = {c['ratio']:.2f}, {verdict} above 1",
            f"  learning with delay: Re T(jω) > 0 up to {c['positive_to']:.1f} rad/s",
        ]
    return "\n".join(lines)
