"""The figures of the suite and its report, an HTML page that contains the figures and needs no server."""

from __future__ import annotations

import base64
import html
import shlex
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import xarray as xr
from jinja2 import Environment, StrictUndefined
from pandas.io.formats.style import Styler

from mrctl.control.feedforward import Prior
from mrctl.control.pid import Pid
from mrctl.control.stages import Stages
from mrctl.experiments import tuning
from mrctl.experiments.cases import RECOVERED_RATIO, REFERENCES, SLOW, Choice, Choices, Outcome
from mrctl.experiments.suite_tables import NO_CLAIM, times, titled, verdict
from mrctl.experiments.tables import Table, number
from mrctl.loop import user_files
from mrctl.loop.simulation import Simulation
from mrctl.loop.user_stages import StageError
from mrctl.results import metrics, plots
from mrctl.results.dataset import versions
from mrctl.results.plots import InverseMap
from mrctl.scenario import MODEL_BASED, Scenario, controller_name

WITHOUT_MAP = ("none", *MODEL_BASED)
"""Learners without a map from motion to voltage."""
GRID_POINTS = 41  # points along each side of a heat map
TEMPLATE = Path(__file__).with_name("report.html")


def write(outcome: Outcome, choices: Choices, tables: Sequence[Table], out: Path) -> None:
    """Writes the figures, as PNG and PDF, and `report.html`.

    Args:
        outcome: Results of the suite.
        choices: The feedforwards, by name.
        tables: The tables of all numbers.
        out: Folder to write to.

    Raises:
        InputError: The folder cannot be written.
    """
    drawn = figures(outcome, choices)
    images = {}
    for name, (figure, caption) in drawn.items():
        png, _ = plots.save(figure, out / "figures", name)
        images[name] = (base64.b64encode(png.read_bytes()).decode(), caption)
    (out / "report.html").write_text(page(outcome, choices, tables, images), "utf-8")


def figures(outcome: Outcome, choices: Choices) -> dict[str, tuple[Any, str]]:
    """Draws the figures; returns them with their captions, by file name."""
    runs = {case.name: case for case in outcome.cases}
    found = outcome.runs
    drawn: dict[str, tuple[Any, str]] = {}
    mean = (
        "Mean over the replicates that finished, and their range as a band; the legend counts those that failed in any "
        "panel. Laps are counted from 1."
    )
    steady = {name: _labelled(found[name]) for name in ("nominal", "all") if name in found}
    drawn["error_per_lap"] = (
        plots.laps_by_case(steady, "position_rmse"),
        f"Position error lap by lap, on the nominal robot and with four things wrong at once (all). {mean}",
    )
    stepped = [case for case in outcome.cases if case.part == "step"]
    steps = {case.name: _labelled(found[case.name]) for case in stepped}
    drawn["recovery"] = (
        plots.laps_by_case(steps, "position_rmse", (stepped[0].change, stepped[0].back)),
        f"Position error lap by lap; the plant changes at the first dotted line and back at the second. {mean}",
    )
    if late := {case.name: case for case in outcome.cases if case.part == "late"}:
        drawn["late_step"] = (
            plots.laps_by_case(
                {name: _labelled(found[name]) for name in late},
                "position_rmse",
                [case.change for case in late.values()],
            ),
            "Position error lap by lap; the plant changes at the dotted line, when learners have long converged on the "
            f"former one. {mean}",
        )
    share = {**steady, stepped[-1].name: steps[stepped[-1].name]}
    drawn["feedback_share"] = (
        plots.laps_by_case(share, "feedback_share"),
        f"Share of the work that feedback still does, RMS(U_fb)/RMS(U), lap by lap. {mean}",
    )
    switched = [case for case in outcome.cases if case.part == "learning"]
    panels = {case.name: _labelled(found[case.name]) for case in switched}
    drawn["learning"] = (
        plots.laps_by_case(panels, "position_rmse", (switched[0].change,)),
        "Learning is off until the dotted line and then on; or it is on until there, then frozen on another course. "
        f"{mean}",
    )
    if "random" in found and "none" in found["random"]:
        ends = {name: metrics.summary(own)["position_rmse"].to_numpy() for name, own in found["random"].items()}
        ratios = {name: end / ends["none"] for name, end in ends.items()}
        drawn["random"] = (
            plots.distributions(ratios, "position error over that of PID, same run", mark=1),
            "Random scenarios: the share of runs whose error is below a multiple of that of PID alone. A curve ends "
            "below 1 by the share of runs that it or PID alone lost.",
        )
    if found := maps(choices, runs["all"].scenarios[0]):
        drawn["inverse_dynamics"] = (
            plots.inverse_dynamics(found),
            "Maps that the feedforwards learned with four things wrong at once (all), beside the true inverse dynamics "
            "in steady motion: the common and the differential voltage of the motors over V and θ̇. The line shows "
            "where the robot drove.",
        )
    return drawn


def _labelled(runs: Mapping[str, xr.Dataset]) -> xr.Dataset:
    """Returns the runs of one case in one dataset, labelled with their feedforwards."""
    own = [one.assign_coords(label=("run", [name] * one.sizes["run"])) for name, one in runs.items()]
    return xr.concat([one.drop_vars("scenario", errors="ignore") for one in own], "run")


def with_map(choices: Choices) -> list[str]:
    """Returns the names of the choices that learn a map: a user's feedforward does."""
    return [
        name
        for name, one in choices.items()
        if one.learner not in WITHOUT_MAP
        or any(part.stage == "feedforward" for part in (user_files.split(one.controller) if one.controller else ()))
    ]


def maps(choices: Choices, scenario: Scenario) -> dict[str, InverseMap]:
    """Returns what was learned in a scenario, by name; a user's controller that raises an error has no map."""
    found = {}
    for name in with_map(choices):
        with suppress(StageError):
            found[name] = learned(choices[name], scenario)
    return found


def learned(choice: Choice, scenario: Scenario) -> InverseMap:
    """Drives a scenario again; evaluates the learned feedforward and the true inverse dynamics in steady motion."""
    stages: Stages = user_files.load(choice.controller) if choice.controller else {}
    scenario = scenario.model_copy(update=choice.pair)
    simulation = Simulation([scenario], **stages)
    while simulation.running:
        simulation.step()
    lap = simulation.log.ticks[-round(scenario.reference.period / scenario.control_period) :, 0]
    path = np.stack([lap["v_command"], lap["omega_command"]], axis=1)
    v, omega, shape = np.linspace(0, 1.2, GRID_POINTS), np.linspace(-2, 2, GRID_POINTS), (GRID_POINTS, GRID_POINTS, 2)
    truth = Prior([simulation.plant.truth[0]], rigid=simulation.scenarios[0].steering == "rigid")
    mine, true = (
        np.reshape([np.array(law(np.array([[x, y]]), np.zeros((1, 2))))[0] for y in omega for x in v], shape)
        for law in (simulation.hierarchy.feedforward, truth.output)
    )
    return InverseMap(v, omega, mine, true, path)


def page(
    outcome: Outcome,
    choices: Choices,
    tables: Sequence[Table],
    images: Mapping[str, tuple[str, str]],
) -> str:
    """Returns the report as HTML.

    Args:
        outcome: Results of the suite.
        choices: The feedforwards, by name.
        tables: The tables of all numbers.
        images: Figures by file name, each as PNG in base64, with its caption.
    """
    fixed = [case for case in outcome.cases if case.part != "random"]
    random = _worlds(outcome)
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    return environment.from_string(TEMPLATE.read_text("utf-8")).render(
        runs=sum(len(case.scenarios) for case in outcome.cases) * len(choices),
        cases=len(fixed),
        seeds=len(fixed[0].scenarios),
        random=random,
        feedforwards=list(choices),
        aside=outcome.aside,
        band=f"{RECOVERED_RATIO:g}",
        mode=outcome.mode,
        says={table.title: table.says for table in tables},
        reads={table.title: table.reads for table in tables},
        no_claim=NO_CLAIM.replace("this table", "this page") if {NO_CLAIM} == {one.says for one in tables} else "",
        scorecard=scorecard(outcome),
        recoveries=recoveries(outcome),
        duels=duels(outcome) if random else "",
        figures=[{"data": data, "caption": caption} for data, caption in images.values()],
        tables={table.title: _plain(table.cells) for table in tables},
        command=command(outcome, choices),
        versions=versions(),
        pids=[tuning.statement(tuning.design("flat", pid, (0.0,))) for pid in (Pid(), SLOW)],
    )


def command(outcome: Outcome, choices: Choices) -> str:
    """Returns the command that repeats the suite."""
    words = ["mrctl", "suite", *([f"--{outcome.mode}"] if outcome.mode != "core" else [])]
    words += ["--feedforward", *(name for name, one in choices.items() if not one.controller)]
    own = controllers(choices)
    words += ["--controller", *own] if own else []
    words += ["--seeds", str(len(next(case for case in outcome.cases if case.part != "random").scenarios))]
    words += ["--random", str(_worlds(outcome))]
    return shlex.join(words)


def controllers(choices: Choices) -> list[str]:
    """Returns the user's controllers, as on the command line."""
    return [
        controller_name(controller_name(one.prior, one.learner), one.controller)
        for one in choices.values()
        if one.controller
    ]


def _worlds(outcome: Outcome) -> int:
    """Returns the number of random scenarios in each tier."""
    return max((len(case.scenarios) for case in outcome.cases if case.part == "random"), default=0)


def scorecard(outcome: Outcome) -> str:
    """Makes the table of position errors by case and feedforward, coloured by the ratio to that of PID alone."""
    cells: dict[str, dict[str, Cell]] = {}
    for case, rows in _by_case(outcome, steps=False).items():
        rivals = [row for row in rows if row["feedforward"] not in REFERENCES]
        for row in rows:
            error = row["position_rmse"]
            text = number(1e3 * error["value"]) if error["samples"] else ""
            lost = f"{row['failed']} failed" if row["failed"] else ""
            bold = row in rivals and not row["failed"]
            bold &= all(verdict(one, row["feedforward"]) >= 0 for one in rivals if one is not row)
            ratio = error.get("to_PID", {"value": 1.0})["value"]
            cells.setdefault(case, {})[row["feedforward"]] = Cell(", ".join(filter(None, (text, lost))), ratio, bold)
    return _coloured("scorecard", cells)


def recoveries(outcome: Outcome) -> str:
    """Makes the table of position errors at the end of a step, and one lap after change and return over that before."""
    cells: dict[str, dict[str, Cell]] = {}
    for case, rows in _by_case(outcome, steps=True).items():
        for row in rows:
            error = row["position_rmse"]
            after, back = (error[name]["value"] for name in ("after_one_lap", "return_after_one_lap"))
            mean = f"{number(1e3 * error['during']['value'])}: " if error["during"]["samples"] else ""
            lost = f", {row['failed']} failed" if row["failed"] else ""
            text = f"{mean}{times(after)}, {times(back)}{lost}"
            bold = error["recovered_within_one_lap"] == 1
            cells.setdefault(case, {})[row["feedforward"]] = Cell(text, after / RECOVERED_RATIO, bold)
    return _coloured("recoveries", cells)


def duels(outcome: Outcome) -> str:
    """Makes the table of probabilities that one feedforward beats another in the random scenarios."""
    rows = {row["feedforward"]: row for row in outcome.rows if row["case"] == "random"}
    cells: dict[str, dict[str, Cell]] = {}
    for name, row in rows.items():
        cells[name] = {}
        for other in rows:
            if other == name:
                cells[name][other] = Cell("–")
                continue
            won = row["position_rmse"][f"beats_{titled(other)}"]
            text = f"{won['value']:.2f} [{won['low']:.2f},\u00a0{won['high']:.2f}]"
            cells[name][other] = Cell(text, np.exp(3 * (1 - 2 * won["value"])))
        cells[name]["failed"] = Cell(f"{row['failed']}/{row['runs']}")
        cells[name]["where PID did not"] = Cell(str(row.get("failed_where_pid_did_not", "")))
    return _coloured("duels", cells, corner="")


class Cell(NamedTuple):
    """A cell of a coloured table."""

    text: str
    ratio: float = 1.0
    """Number that determines the colour of the cell: green below one, red above."""
    bold: bool = False

    @property
    def style(self) -> str:
        """The look of the cell in CSS."""
        return f"background-color: {_shade(self.ratio)}; font-weight: {700 if self.bold else 400}"


def _coloured(name: str, cells: dict[str, dict[str, Cell]], corner: str = "case") -> str:
    """Makes an HTML table of cells by row and column; `name` must be unique on the page."""
    frame = pd.DataFrame.from_dict(cells, orient="index").rename_axis(columns=corner)
    styler = Styler(frame.map(lambda cell: cell.text), uuid=name)
    styler.format(escape="html")
    styler.format_index(escape="html", axis="index")
    styler.format_index(_breakable, axis="columns")
    styler.apply(lambda _: frame.map(lambda cell: cell.style), axis=None)
    return styler.to_html()


def _breakable(name: object) -> str:
    """Returns the name of a column as HTML, of which a line may end behind each plus."""
    return html.escape(str(name)).replace("+", "+<wbr>")


def _plain(table: pd.DataFrame) -> str:
    """Makes an HTML table of text."""
    with pd.option_context("display.max_colwidth", None):  # pandas cuts longer text
        return table.to_html(index=False, border=0, classes="text")


def _by_case(outcome: Outcome, steps: bool) -> dict[str, list[dict[str, Any]]]:
    """Returns the rows of the cases that are steps, or of those that are not, by case."""
    found: dict[str, list[dict[str, Any]]] = {}
    for row in outcome.rows:
        if (row["part"] == "step") == steps:
            found.setdefault(row["case"], []).append(row)
    return found


def _shade(ratio: float) -> str:
    """Returns the colour of a ratio in CSS: green below one, deepest at 1/30; red above one, deepest at 3."""
    if not np.isfinite(ratio) or ratio <= 0:
        return "#fff"
    depth = np.log(ratio) / np.log(3 if ratio > 1 else 30)
    depth = float(np.clip(depth, -1, 1))
    other = round(255 - 90 * abs(depth))
    return f"rgb({other},250,{other})" if depth < 0 else f"rgb(255,{other},{other})"
