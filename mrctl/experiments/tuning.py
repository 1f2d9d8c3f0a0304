"""`mrctl tune`: designs the velocity PID of a robot; computes and measures its margins and where learning is safe."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from tqdm import tqdm

from mrctl.control.design import M_S, M_T, SPEED_SHARES, plants, sensitivity
from mrctl.control.design import motion as motion_design
from mrctl.control.kanayama import Kanayama
from mrctl.control.margins import Gains, learning_ratio, margins, sampled_loop
from mrctl.control.pid import Pid
from mrctl.experiments.response import Response, measure, refine, safety
from mrctl.experiments.tables import Report, json_text, machine, markdown, number, output_folder, write_json
from mrctl.kernel import Array
from mrctl.physics import mjcf
from mrctl.record import InputError, is_whole
from mrctl.results import plots
from mrctl.results.dataset import versions
from mrctl.scenario import Scenario
from mrctl.sensing.tiers import TIERS, Sensing
from mrctl.theory.linear import Linear
from mrctl.theory.perturbation import Perturbation
from mrctl.theory.robot import CAR, Robot, RobotFile

RESPONSES = {"design": "designed", "measured": "measured", "hierarchy": "measured with motion controller"}
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
    "sensitivity": "max \\|S\\|",
}
SAFETY = {
    "positive_to": "Re T > 0 to, rad/s",
    "lowest": "least Re T",
    "built_in_to": "built-in learners safe to, rad/s",
    "step": "largest step",
}
GAIN_COLUMNS = ("plant gain", "plant lag, s", "K_p", "K_i", "learning ratio")
UNITS = """\
Units: common m/s, V/(m/s), V/m; second rad/s, V/(rad/s), V/rad; of rigid steering 1, 1, 1/s. Learning without delay and
hold converges with a first-order plant if the ratio K_p (1 + K K_p)/(τ K_i) is above 1."""
GAINS_UNITS = """\
Units of K_p and K_i: common V/(m/s), V/m; second V/(rad/s), V/rad; of rigid steering 1, 1/s. Each tier is beside the
delay of its loop, for which its runs design the PID."""
MOTION_COLUMNS = (
    *("steering", "delay, ms", "lag of V, ms", "lag of θ̇, ms", "prefilter, ms"),
    *("K_x, 1/s", "K_y, 1/m²", "K_θ, 1/m", "max \\|S\\| common", "max \\|S\\| second"),
)
SECOND_LOOP = """\
The last two columns are max |S| of the loop opened at the voltage, under this motion controller, which closes a second
loop around the PID's: the largest over several speeds, with or without the nominal model as feedforward."""
ADVICE = """\
A learner that the feedback voltage teaches is safe at frequencies where Re T > 0. `fel`, `rls` and `composite` take
half of what they add from the PID's integral (the hand-over), and learn at features delayed by τ, the delay and two
periods: they are safe where Re [(1 + T) e^(jωτ)] > 0. Both hold for commands that do not depend on the motion of the
robot. The third value is measured with the motion controller above, but without its prediction over the delay. Above
the largest step a learner with a constant regressor and without hand-over is unstable: choose at most half of it."""


def tune(
    robot: RobotFile,
    world: str,
    time_constant: float | None,
    delays: Sequence[float],
    lag: float,
    out: Path | None,
    json: bool,
) -> Report:
    """Runs the command: designs and measures; saves `table.json` and the figure `sensitivity` to `out` if given.

    Without a time constant the gains are designed; with one they follow the IMC rule.

    Raises:
        InputError: As `design`, or the folder cannot be written or holds such files already.
    """
    with output_folder(out, files()):
        table = design(world, Pid.from_dict({"time_constant": time_constant, "lag": lag}), delays, robot)
    return Report(json_text(table) if json else text(table), "", partial(_save, table, out))


def files() -> list[str]:
    """Returns the names of the files that `tune` writes and does not overwrite."""
    return ["table.json", *plots.files("sensitivity")]


def _save(table: dict[str, Any], out: Path | None) -> None:
    """Writes the table and the figure to a folder, if there is one."""
    if out is not None:
        write_json(out / "table.json", table)
        plots.save(figure(table), out, "sensitivity")


def design(world: str, pid: Pid, delays: Sequence[float], robot: RobotFile = CAR) -> dict[str, Any]:
    """Computes gains, margins and safety of every velocity loop of a robot, as designed and as measured on the physics.

    The common channel is measured in the robot's first steering arrangement, since it is the same in all of them, and
    the second channel in each, at half of the largest speed. The loop is measured with the true twist, so a lag for
    which the PID is designed shows as an additional margin, in the computed and in the measured columns.

    Args:
        world: World or MJCF file.
        pid: The PID; a designed one is designed for each delay. Its derivative part is left out of the design.
        delays: Loop delays in s, in whole control periods, in addition to the hold.
        robot: The robot; by default the world's own.

    Returns:
        `loops`, a row for each loop and delay with the plant's static gain and lag, the PI gains, the ratio of the
        learning condition, and `Margins` and `Safety` for each of `RESPONSES`; `motion`, the motion controller designed
        for the loops of each arrangement and delay; `frequency` in rad/s and `responses`, T of the rows of `loops`.

    Raises:
        InputError: The world, the robot or a delay is invalid, or the robot fails with that delay.
    """
    if not delays:
        raise InputError("delay: at least one delay is needed")
    period = Scenario().control_period
    if odd := [d for d in delays if not (np.isfinite(d) and is_whole(d / period))]:
        raise InputError(f"delay: {odd[0]:g} s is not a whole multiple of the control period ({period:g} s)")
    table: dict[str, Any] = {"versions": versions(), "machine": machine(), "robot": robot.model_dump()}
    table |= {"time_constant": pid.time_constant, "lag": pid.lag}
    table |= {"loops": [], "motion": [], "responses": []}
    offered = mjcf.steerings(mjcf.load(world, mjcf.arrangement(robot), robot=robot))
    for steering in offered:
        _, nominal = mjcf.build(world, steering, robot=robot)
        pids = [pid.replace(delay=delay) for delay in delays]
        fixed = {"world": world, "robot": robot.model_dump(), "steering": steering, "sensing": {"tier": "ideal"}}
        common, rigid = Scenario.from_dict(fixed), steering == "rigid"
        designs = [_designed(nominal, rigid, one, delay, period) for one, delay in zip(pids, delays, strict=True)]
        table["motion"] += [{"steering": steering} | _motion_row(nominal, rigid, one, period) for one in designs]
        still = [one._replace(kanayama=Kanayama(k_x=0, k_y=0, k_theta=0)) for one in designs]
        scenarios = [one.applied(common) for one in (*still, *designs)]
        channels = (0, 1) if steering == offered[0] else (1,)
        for channel in tqdm(channels, unit="loop", desc=steering):
            plant = plants(nominal, rigid, channel)[0]
            frequency, measured = measure(scenarios, channel, SPEED_SHARES[0] * nominal.max_speed)
            for one, alone, whole in zip(designs, *np.split(measured, 2), strict=True):
                loop = sampled_loop(frequency, plant, one.gains[channel], period, one.delay)
                t = dict(zip(RESPONSES, (loop / (1 + loop), alone, whole), strict=True))
                row = {"steering": steering, "channel": channel, "delay": one.delay}
                judged = {name: _judge(frequency, t[name], period, one.delay) for name in RESPONSES}
                table["loops"].append(row | _gains(plant, one.gains[channel]) | judged)
                table["responses"].append(row | {name: _parts(response) for name, response in t.items()})
            table["frequency"] = frequency.tolist()
    return table


class _Design(NamedTuple):
    """The controllers of one steering arrangement that are designed for one loop delay."""

    delay: float
    """Loop delay in s."""
    pid: Pid
    gains: tuple[Gains, Gains]
    """PI gains of both channels."""
    kanayama: Kanayama
    prefilter: float
    """Time constant in s."""
    lag: tuple[float, float]
    """Lags of V and θ̇ in s."""

    def applied(self, scenario: Scenario) -> Scenario:
        """Returns a scenario with these controllers and this delay."""
        return scenario.replace(
            pid=self.pid,
            perturbation=Perturbation(control_delay=self.delay),
            kanayama=self.kanayama,
            prefilter=self.prefilter,
        )


def _designed(robot: Robot, rigid: bool, pid: Pid, delay: float, period: float) -> _Design:
    gains = pid.channels(robot, rigid, period=period)
    return _Design(delay, pid, gains, *motion_design(robot, rigid, gains, delay, period))


def _motion_row(robot: Robot, rigid: bool, design: _Design, period: float) -> dict[str, Any]:
    """Returns a row of `motion` without its steering: the motion controller, and max |S| of both channels under it."""
    kanayama = design.kanayama
    gains = np.array([kanayama.k_x, kanayama.k_y, kanayama.k_theta])
    whole = sensitivity(robot, rigid, design.gains, gains, design.prefilter, design.delay, period)
    lags = dict(zip(("v_lag", "omega_lag"), design.lag, strict=True))
    row = {"delay": design.delay} | kanayama.model_dump() | {"prefilter": design.prefilter} | lags
    return row | {"sensitivity": whole.tolist()}


def _gains(plant: Linear, gains: Gains) -> dict[str, float]:
    """Returns the plant, the gains of its PI controller, and the ratio of the learning condition."""
    made = {"static_gain": plant.gain, "plant_lag": plant.lag, **gains._asdict()}
    return made | {"ratio": learning_ratio(plant.gain, plant.lag, gains)}


def _parts(response: Response) -> dict[str, list[float]]:
    return {"real": response.real.tolist(), "imaginary": response.imag.tolist()}


def _judge(frequency: Array, response: Response, period: float, delay: float) -> dict[str, float]:
    fine, t = refine(frequency, response)
    return margins(fine, t / (1 - t))._asdict() | safety(fine, t, period, delay)._asdict()


def text(table: dict[str, Any]) -> str:
    """Returns the design as text."""
    gains = [
        [
            _name(row),
            f"{1e3 * row['delay']:g}",
            *(number(row[name]) for name in ("static_gain", "plant_lag", "k_p", "k_i", "ratio")),
        ]
        for row in table["loops"]
    ]
    motions = [
        [
            row["steering"],
            f"{1e3 * row['delay']:g}",
            *(number(1e3 * row[name]) for name in ("v_lag", "omega_lag", "prefilter")),
            *(number(row[name]) for name in ("k_x", "k_y", "k_theta")),
            *map(number, row["sensitivity"]),
        ]
        for row in table["motion"]
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
    loops = ["loop", "delay, ms"]
    parts = [
        f"{_rule(table)}:",
        markdown([*loops, *GAIN_COLUMNS], gains),
        UNITS,
        "The motion controller for these loops:",
        markdown([*MOTION_COLUMNS], motions),
        SECOND_LOOP,
        f"{' / '.join(RESPONSES.values())}:",
        markdown([*loops, *MARGINS.values(), *SAFETY.values()], rows),
        ADVICE,
    ]
    return "\n\n".join(parts)


def default_text(table: dict[str, Any]) -> str:
    """Returns gains, bandwidth and margins of the velocity loops, designed and measured, as a statement and a table.

    Args:
        table: What `design` returns for a designed PID.
    """
    loops = table["loops"]
    deviation = max(abs(row["measured"]["bandwidth"] / row["design"]["bandwidth"] - 1) for row in loops)
    designed, measured = (max(row[kind]["sensitivity"] for row in loops) for kind in ("design", "measured"))
    says = (
        f"{_rule(table)}: the measured bandwidth is within {100 * deviation:.2g} % of the designed one, and max |S| is "
        f"at most {number(designed)} as designed and {number(measured)} as measured."
    )
    period = Scenario().control_period
    tiers = {round(1e3 * period * Sensing(tier=tier).loop_delay(period)): tier for tier in TIERS}
    cells = [
        [
            *(_name(row), f"{1e3 * row['delay']:g}", tiers.get(round(1e3 * row["delay"]), "")),
            *(number(row["k_p"]), number(row["k_i"])),
            *(" / ".join(_cell(row[kind][name]) for kind in ("design", "measured")) for name in MARGINS),
        ]
        for row in loops
    ]
    header = ["loop", "delay, ms", "tier", "K_p", "K_i", *MARGINS.values()]
    return "\n\n".join([says, "Designed / measured:", markdown(header, cells)])


def _rule(table: dict[str, Any]) -> str:
    if table["time_constant"] is None:
        return (
            f"PI with the largest K_i for which max |S| ≤ {M_S:g} and max |T| ≤ {M_T:g}, lag {1e3 * table['lag']:g} ms"
        )
    return f"PID by the IMC rule with λ = {table['time_constant']:g} s"


def statement(table: dict[str, Any]) -> str:
    """Returns measured bandwidth and margins without delay as one line for the report of a comparison."""
    loops = [
        f"{_name(row)} {' / '.join(_cell(row['measured'][name]) for name in ('bandwidth', 'phase', 'gain'))}"
        for row in table["loops"]
        if row["delay"] == 0
    ]
    return f"{_rule(table)}; bandwidth in rad/s / phase margin in degrees / gain margin as measured: {'; '.join(loops)}"


def _name(row: dict[str, Any]) -> str:
    return "common" if row["channel"] == 0 else f"{row['steering']}, second"


def _cell(value: float) -> str:
    return number(value) if np.isfinite(value) else "–"


@plots.styled
def figure(table: dict[str, Any]) -> Figure:
    """Draws Re T(jω) as designed, as measured, and in the whole hierarchy; learning is unsafe where it is negative."""
    frequency = table["frequency"]
    marks = np.unique(np.geomspace(1, len(frequency), 30).astype(int) - 1).tolist()  # dots evenly spread
    rows, loops = table["responses"], list(dict.fromkeys(map(_name, table["responses"])))
    delays = [1e3 * row["delay"] for row in rows if _name(row) == loops[0]]
    many = len(delays) > len(plots.COLOURS)
    colours = mpl.colormaps["viridis"](np.linspace(0, 0.9, len(delays))) if many else plots.COLOURS
    height = len(loops) // 2
    drawn = Figure(figsize=(plots.PAGE_WIDTH, 0.35 * height * plots.PAGE_WIDTH + 0.5), layout="constrained")
    panels = list(drawn.subplots(height, 2, sharex=True, sharey=True).flat)
    for axes, name in zip(panels, loops, strict=True):
        axes.axhspan(-2, 0, color="0.93", zorder=0)
        for k, row in enumerate(r for r in rows if _name(r) == name):
            for kind, style in STYLES.items():
                axes.plot(frequency, row[kind]["real"], color=colours[k], markevery=marks, **style)
        axes.set(xscale="log", ylim=(-0.8, 1.6), title=name)
    for axes in panels[-2:]:
        axes.set_xlabel("ω (rad/s)")
    for axes in panels[::2]:
        axes.set_ylabel(r"Re $T(\mathrm{j}\omega)$")
    handles = [Line2D([], [], color=c, label=f"{d:g} ms") for d, c in zip(delays, colours, strict=False)]
    handles += [Line2D([], [], color="0.3", label=RESPONSES[kind], **style) for kind, style in STYLES.items()]
    drawn.legend(handles=handles, loc="outside upper center", ncols=3)
    return drawn
