"""The suite's figures, and its report: one HTML page with everything in it, read without a server."""

from __future__ import annotations

import base64
import html
import shlex
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from mrctl.control.feedforward import InverseDynamics
from mrctl.control.pid import PIDS
from mrctl.control.stages import Stages
from mrctl.experiments import tuning
from mrctl.experiments.cases import BAND, Outcome
from mrctl.experiments.tables import number
from mrctl.loop import user_files
from mrctl.loop.simulation import Simulation
from mrctl.results import metrics, plots
from mrctl.results.comparison import superiority
from mrctl.results.dataset import versions
from mrctl.results.plots import InverseMap
from mrctl.scenario import Scenario

KNOWING = ("none", "model", "oracle")  # feedforwards that do not learn
GRID = 41  # points a side of a heat map
STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; color: #222; background: #fff; max-width: 1250px; margin: 2em auto;
  padding: 0 1.5em; }
h1 { font-size: 1.7em; margin-bottom: 0; } h2 { font-size: 1.2em; margin-top: 2em; }
p { max-width: 75ch; } figure { margin: 1em 0 2em; } figure img { max-width: 100%; } figcaption { color: #555; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: 13px; font-variant-numeric: tabular-nums; }
th, td { padding: 3px 9px; text-align: right; white-space: nowrap; border-bottom: 1px solid #e4e4e4; }
th { text-align: right; position: sticky; top: 0; background: #fff; border-bottom: 1px solid #999; }
th:first-child, td:first-child { text-align: left; } .text td:nth-child(2), .text th:nth-child(2) { text-align: left; }
tr.new td { border-top: 1px solid #999; } td.best { font-weight: 700; }
summary { cursor: pointer; font-weight: 600; margin: 1em 0; } 
pre { background: #f5f5f5; padding: 1em; overflow-x: auto; }
"""


def write(outcome: Outcome, who: Mapping[str, dict[str, Any]], tables: Mapping[str, str], out: Path) -> None:
    """Writes the figures, as PNG and PDF, and `report.html`.

    Args:
        outcome: What the suite found.
        who: The feedforwards, by name.
        tables: Markdown, by title.
        out: Folder.

    Raises:
        InputError: The folder cannot be written.
    """
    drawn = figures(outcome, who)
    images = {}
    for name, (figure, caption) in drawn.items():
        png, _ = plots.save(figure, out / "figures", name)
        images[name] = (base64.b64encode(png.read_bytes()).decode(), caption)
    (out / "report.html").write_text(page(outcome, who, tables, images))


def figures(outcome: Outcome, who: Mapping[str, dict[str, Any]]) -> dict[str, tuple[Any, str]]:
    """The figures with their captions, by file name."""
    runs = {case.name: case for case in outcome.cases}
    found = outcome.runs
    drawn: dict[str, tuple[Any, str]] = {}
    mean = "Mean over the seeds; the band is their range. Laps are counted from 1."
    steady = {name: _labelled(found[name]) for name in ("nominal", "all") if name in found}
    drawn["error_per_lap"] = (
        plots.laps_by_case(steady, "position_rmse"),
        f"Position error lap by lap, on the nominal robot and with everything wrong at once. {mean}",
    )
    stepped = [case for case in outcome.cases if case.part == "step"]
    steps = {case.name: _labelled(found[case.name]) for case in stepped}
    drawn["recovery"] = (
        plots.laps_by_case(steps, "position_rmse", (stepped[0].change, stepped[0].back)),
        f"A change at the first dotted line, taken back at the second: position error lap by lap. {mean}",
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
        "Learning off until the dotted line and on from there; or on until there, then frozen on laps half as fast "
        f"again, of which three count as two. {mean}",
    )
    if "random" in found and "none" in found["random"]:
        ends = {name: metrics.summary(own)["position_rmse"].to_numpy() for name, own in found["random"].items()}
        ratios = {name: end / ends["none"] for name, end in ends.items()}
        drawn["random"] = (
            plots.distributions(ratios, "position error over that of PID, same run"),
            "Random scenarios: the share of runs in which the error is below so many times that of PID alone. What "
            "does not reach 1 has failed.",
        )
    learners = [name for name in who if name not in KNOWING]
    if learners:
        drawn["inverse_dynamics"] = (
            plots.inverse_dynamics({name: learned(who[name], runs["all"].scenarios[0]) for name in learners}),
            "What was learned with everything wrong at once, against the true inverse dynamics, in steady motion: the "
            "voltage that the motors share and the one in which they differ, over V and θ̇. The line is where the robot "
            "drove.",
        )
    return drawn


def _labelled(runs: Mapping[str, xr.Dataset]) -> xr.Dataset:
    """The runs of one case with their feedforwards as labels."""
    own = [one.assign_coords(label=("run", [name] * one.sizes["run"])) for name, one in runs.items()]
    return xr.concat([one.drop_vars("scenario", errors="ignore") for one in own], "run")


def learned(choice: Mapping[str, Any], scenario: Scenario) -> InverseMap:
    """Drives a scenario once more and asks the feedforward what it makes of steady motion."""
    stages: Stages = user_files.load(choice["controller"]) if "controller" in choice else {}
    scenario = scenario.model_copy(update={"feedforward": choice.get("feedforward", "none")})
    simulation = Simulation([scenario], **stages)
    while simulation.running:
        simulation.step()
    lap = simulation.log.ticks[-round(scenario.reference.period / scenario.control_period) :, 0]
    path = np.stack([lap["v_command"], lap["omega_command"]], axis=1)
    v, omega, shape = np.linspace(0, 1.2, GRID), np.linspace(-2, 2, GRID), (GRID, GRID, 2)
    truth = InverseDynamics([simulation.plant.truth[0]], rigid=scenario.steering == "rigid")
    mine, true = (
        np.reshape([np.array(stage.output(np.array([[x, y]]), np.zeros((1, 2))))[0] for y in omega for x in v], shape)
        for stage in (simulation.hierarchy.feedforward, truth)
    )
    return InverseMap(v, omega, mine, true, path)


def page(
    outcome: Outcome,
    who: Mapping[str, dict[str, Any]],
    tables: Mapping[str, str],
    images: Mapping[str, tuple[str, str]],
) -> str:
    """The report."""
    count = sum(len(case.scenarios) for case in outcome.cases)
    names = ", ".join(who)
    fixed = [case for case in outcome.cases if case.part != "random"]
    random = sum(len(case.scenarios) for case in outcome.cases if case.part == "random")
    body = [
        "<h1>Uncertainty suite</h1>",
        f"<p>{count * len(who):,} runs of a car-like robot in MuJoCo: {len(fixed)} cases with "
        f"{len(fixed[0].scenarios)} seeds each and {random} random scenarios, under each of {len(who)} feedforwards "
        f"({html.escape(names)}). The PID beside them is the same for all of them. Every feedforward drives the same "
        "runs, with the same seeds, so that each is compared with the others run by run.</p>",
        f"<p><strong>{html.escape(outcome.aside)}</strong></p>" if outcome.aside else "",
        "<h2>Position error of the last lap, mm</h2>",
        "<p>Mean over the seeds of a case; bold is the best but <code>oracle</code>, which knows the plant. Colour: "
        "green is less than PID alone, red is more. “3 failed” counts runs that diverged; the mean is of the "
        "others.</p>",
        f"<div class=wide>{scorecard(outcome)}</div>",
    ]
    body += [
        "<h2>A step, and the return</h2>",
        "<p>Mean position error in the last lap before the return, mm; geometric mean of the error one lap after "
        f"the change over that before it; the same after the return. Bold: every run was back within {BAND:g} times "
        "its error before, to stay, one lap after the change. The better the error before, the harder that is.</p>",
        f"<div class=wide>{recoveries(outcome)}</div>",
    ]
    for data, caption in images.values():
        image = f'<img alt="{html.escape(caption)}" src="data:image/png;base64,{data}">'
        body.append(f"<figure>{image}<figcaption>{html.escape(caption)}</figcaption></figure>")
    if any(case.part == "random" for case in outcome.cases):
        body += [
            "<h2>Who beats whom in the random scenarios</h2>",
            "<p>Probability that the row has the smaller position error in the same run, with its 95 % interval; ties "
            "count half, and a run that fails loses. Last columns: the random runs that failed, and those of them in "
            "which PID alone did not.</p>",
            f"<div class=wide>{duels(outcome)}</div>",
        ]
    body += [
        "<h2>All numbers</h2>",
        "<p>RMSE of the last lap against the original reference: mean [95 % bootstrap interval] over the runs that "
        "finished; after the semicolon the mean of the worst 5 % of all runs (CVaR; the worst one where there are no "
        "more than 20), which is infinite where one failed. “beats”: probability of the smaller error in the same run, "
        "with the 95 % interval of the last one. Recovery: geometric mean of the error of a lap over that of the lap "
        "before the change, run by run; recovered is back to stay within 1.2 times, from the second lap on at the "
        "latest, in V / θ̇ / position; settled is the last lap before the return.</p>",
    ]
    for title, text in tables.items():
        body.append(f"<details><summary>{html.escape(title)}</summary><div class=wide>{_table(text)}</div></details>")
    what = "\n".join(f"{name} {version}" for name, version in versions().items())
    pids = [tuning.statement(tuning.design("flat", pid, (0.0,))) for pid in PIDS.values()]
    body += [
        "<h2>How it was made</h2>",
        f"<pre>{html.escape(command(outcome, who))}</pre>",
        f"<pre>{html.escape(what)}</pre>",
        f"<p>{html.escape(pids[0])}.</p><p>The one twice as fast: {html.escape(pids[1])}.</p>",
        "<p>Each run is stored under <code>runs/</code>; <code>mrctl run runs/NAME --run K</code> drives it again and "
        "compares it bit for bit. <code>table.json</code> holds every number, lap by lap.</p>",
    ]
    return (
        f"<!doctype html>\n<html lang=en><head><meta charset=utf-8><title>mrctl suite</title>\n<style>{STYLE}</style>"
        f"</head>\n<body>\n{chr(10).join(filter(None, body))}\n</body></html>\n"
    )


def command(outcome: Outcome, who: Mapping[str, dict[str, Any]]) -> str:
    """The command that does all of it again."""
    words = ["mrctl", "suite", *(["--quick"] if outcome.quick else [])]
    words += ["--feedforward", *(name for name, one in who.items() if "feedforward" in one)]
    own = [one["controller"] for one in who.values() if "controller" in one]
    words += ["--controller", *own] if own else []
    words += ["--seeds", str(len(outcome.cases[0].scenarios))]
    words += ["--random", str(sum(len(case.scenarios) for case in outcome.cases if case.part == "random"))]
    return shlex.join(words)


def scorecard(outcome: Outcome) -> str:
    """The position error of every case under every feedforward, coloured by its ratio to that of PID alone."""
    table: dict[str, dict[str, str]] = {}
    for case, rows in _by_case(outcome, steps=False).items():
        best = min((_mean(row) for row in rows if row["feedforward"] != "oracle"), default=np.inf)
        for row in rows:
            error = row["position_rmse"]
            text = number(1e3 * error["value"]) if error["samples"] else ""
            lost = f"{row['failed']} failed" if row["failed"] else ""
            look = " class=best" if _mean(row) <= best < np.inf and row["feedforward"] != "oracle" else ""
            hint = f"{row['runs']} runs; worst 5 %: {number(1e3 * error['worst'])} mm"
            shade = _shade(error.get("to_PID", {"value": 1.0})["value"])
            cell = f'<td{look} style="background:{shade}" title="{hint}">{", ".join(filter(None, (text, lost)))}</td>'
            table.setdefault(case, {})[row["feedforward"]] = cell
    return _grid(table, outcome.laps)


def recoveries(outcome: Outcome) -> str:
    """Position error at the end of a step, one lap after it and after the return over the error before."""
    table: dict[str, dict[str, str]] = {}
    for case, rows in _by_case(outcome, steps=True).items():
        for row in rows:
            error = row["position_rmse"]
            after, back = (error[name]["value"] for name in ("after_one_lap", "return_after_one_lap"))
            mean = f"{number(1e3 * error['during']['value'])}: " if error["during"]["samples"] else ""
            lost = f", {row['failed']} failed" if row["failed"] else ""
            look = " class=best" if error["recovered_within_one_lap"] == 1 else ""
            cell = f"{mean}{number(after)}×, {number(back)}×{lost}"
            cell = f'<td{look} style="background:{_shade(after / BAND)}">{cell}</td>'
            table.setdefault(case, {})[row["feedforward"]] = cell
    return _grid(table, outcome.laps)


def _by_case(outcome: Outcome, steps: bool) -> dict[str, list[dict[str, Any]]]:
    """The rows of the cases that are steps, or of those that are not."""
    found: dict[str, list[dict[str, Any]]] = {}
    for row in outcome.rows:
        if (row["part"] == "step") == steps:
            found.setdefault(row["case"], []).append(row)
    return found


def _mean(row: Mapping[str, Any]) -> float:
    """The mean position error, infinite where a run failed."""
    return np.inf if row["failed"] else row["position_rmse"]["value"]


def _grid(table: Mapping[str, Mapping[str, str]], names: Iterable[str]) -> str:
    """A table of finished cells."""
    head = "".join(f"<th>{html.escape(name)}</th>" for name in names)
    lines = [f"<tr><td>{html.escape(case)}</td>{''.join(cells.values())}</tr>" for case, cells in table.items()]
    return f"<table><thead><tr><th>case</th>{head}</tr></thead><tbody>{chr(10).join(lines)}</tbody></table>"


def _shade(ratio: float) -> str:
    """Green below one, red above, full at a factor of 30 and 3."""
    if not np.isfinite(ratio) or ratio <= 0:
        return "#fff"
    depth = np.log(ratio) / np.log(3 if ratio > 1 else 30)
    depth = float(np.clip(depth, -1, 1))
    other = round(255 - 90 * abs(depth))
    return f"rgb({other},250,{other})" if depth < 0 else f"rgb(255,{other},{other})"


def duels(outcome: Outcome) -> str:
    """Who beats whom in the random scenarios."""
    errors = {n: metrics.summary(own)["position_rmse"].to_numpy() for n, own in outcome.runs["random"].items()}
    rows = {row["feedforward"]: row for row in outcome.rows if row["part"] == "random"}
    lines = []
    for name, own in errors.items():
        cells = [f"<td>{html.escape(name)}</td>"]
        for other, theirs in errors.items():
            if other == name:
                cells.append("<td>–</td>")
                continue
            won = superiority(own, theirs)
            shade = _shade(np.exp(3 * (1 - 2 * won.value)))
            interval = f"{won.value:.2f} [{won.low:.2f}, {won.high:.2f}]"
            cells.append(f'<td style="background:{shade}">{interval}</td>')
        lost = f"{rows[name]['failed']}/{rows[name]['runs']}"
        cells += [f"<td>{lost}</td>", f"<td>{rows[name].get('failed_where_pid_did_not', '')}</td>"]
        lines.append(f"<tr>{''.join(cells)}</tr>")
    head = "".join(f"<th>{html.escape(name)}</th>" for name in (*errors, "failed", "where PID did not"))
    return f"<table><thead><tr><th></th>{head}</tr></thead><tbody>{''.join(lines)}</tbody></table>"


def _table(text: str) -> str:
    """A Markdown table as HTML."""
    lines = [[cell.strip() for cell in line.strip("| ").split(" | ")] for line in text.splitlines()]
    lines = [[cell.strip(" |") for cell in line] for line in lines]
    head, _, *rows = lines
    cells = "".join(f"<th>{html.escape(cell)}</th>" for cell in head)
    body, last = [], None
    for row in rows:
        new = " class=new" if last not in (None, row[0]) else ""
        last = row[0]
        body.append(f"<tr{new}>{''.join(f'<td>{html.escape(cell)}</td>' for cell in row)}</tr>")
    return f"<table class=text><thead><tr>{cells}</tr></thead><tbody>{''.join(body)}</tbody></table>"
