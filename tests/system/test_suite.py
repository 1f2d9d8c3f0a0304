"""The suite, on a few short laps: the same files for any workers and interruptions, a page that stands alone."""

import base64
import io
import json
import re
import shutil
import signal
from collections.abc import Iterator
from functools import partial
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from matplotlib.figure import Figure
from numpy.typing import ArrayLike
from PIL import Image
from scipy import stats

import mrctl
from mrctl import cli
from mrctl.experiments import held_out, held_out_cells, report, suite, suite_tables, tuning
from mrctl.experiments.cases import Case, Choice
from mrctl.experiments.held_out_cells import Cells
from mrctl.loop.hindsight import best_fixed
from mrctl.results import metrics, plots
from mrctl.results.comparison import TIE
from mrctl.sweep import jobs
from mrctl.sweep.pool import JobOutcome, Processes
from mrctl.sweep.store import Store
from mrctl.viewer.recording import Library

pytestmark = pytest.mark.xdist_group("suite")  # what its tests share is made once

LAP = 2.5
COURSE = mrctl.Circle(radius=0.3, period=LAP)
GAIN = """
class Gain:
    def __init__(self, robot, size):
        self.gain = 1 / robot.velocity_gain, 1 / robot.rotation_gain
        self.ticks = 0

    def output(self, command, derivative):
        return command * self.gain

    def learn(self, feedback, frozen, twist, voltage):
        self.ticks += 1
"""
OPEN = """
class Open:
    def __init__(self, robot, size):
        pass

    def reset(self, pose, reference, period):
        pass

    def output(self, pose, twist, reference):
        return reference[:, 3:5]
"""
WINDOWS = {"first": lambda e: e[:, 0], "all": lambda e: np.sqrt(np.mean(e**2, axis=1))}


def tiny(mode: str, seeds: int, random: int, course: mrctl.Circle = COURSE) -> list[Case]:
    """A case of each part, on a small circle."""
    base = mrctl.Scenario(laps=2, reference=course)
    payload = mrctl.Event(time=2 * LAP, perturbation=mrctl.PERTURBATIONS["payload ahead"])
    back = mrctl.Event(time=4 * LAP, perturbation=mrctl.Perturbation())
    off, on = mrctl.Event(time=0, learning=False), mrctl.Event(time=LAP, learning=True)
    found = [
        ("payload", "step", {"laps": 6, "events": (payload, back)}, 3, 5),
        ("switch <on>", "learning", {"events": (off, on)}, 2, 0),
        ("nominal", "steady", {}, 0, 0),
        ("all", "steady", {"perturbation": mrctl.PERTURBATIONS["all"]}, 0, 0),
        ("caster", "steering", {"steering": "caster"}, 0, 0),
    ]
    fixed = [
        Case(name, part, tuple(base.model_copy(update={"seed": k, **fields}) for k in range(seeds)), *laps)
        for name, part, fields, *laps in found
    ]
    masses = [mrctl.Perturbation(mass_factor=0.6 + 0.4 * k) for k in range(random)]
    drawn = [base.model_copy(update={"perturbation": one}) for one in masses]
    return [*fixed, *([Case("random", "random", tuple(drawn))] if random else [])]


def as_png(figure: Figure, folder: Path, name: str) -> list[Path]:
    """Writes a figure without the PDF, which takes as long; test_plots.py looks at both."""
    folder.mkdir(parents=True, exist_ok=True)
    figure.savefig(folder / f"{name}.png", dpi=plots.STYLE["savefig.dpi"])
    return [folder / f"{name}.png"] * 2


@pytest.fixture(autouse=True, scope="module")
def small(here_throughout: None) -> Iterator[None]:
    """Few short runs in this process, small figures, and neither PID nor machine measured again."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(suite, "cases", tiny)
        with pytest.MonkeyPatch.context() as few:
            few.setattr(suite, "RUNS_PER_JOB", 2)
            pace = suite.pace()
        patch.setattr(suite, "pace", lambda: pace)
        patch.setitem(plots.STYLE, "savefig.dpi", 60)
        patch.setattr(plots, "save", as_png)
        patch.setattr(tuning, "design", lambda *_: {})
        patch.setattr(tuning, "statement", lambda _: "phase margin 88 degrees")
        yield


@pytest.fixture
def plain(monkeypatch: pytest.MonkeyPatch) -> None:
    """Figures take seconds."""
    monkeypatch.setattr(report, "figures", lambda *_: {})


def short(*of: Any, course: mrctl.Circle = COURSE) -> list[Case]:
    """Two of the cases, for tests of what all share."""
    return [case for case in tiny(*of, course=course) if case.name in ("nominal", "all")]


@pytest.fixture
def two_cases(monkeypatch: pytest.MonkeyPatch) -> None:
    """A suite of two cases."""
    monkeypatch.setattr(suite, "cases", short)


def arguments(out: Path, *more: object) -> list[str]:
    fixed = ["suite", "--feedforward", "none", "model", "rls", "--seeds", "2", "--random", "3", "--out", out]
    return [str(word) for word in (*fixed, *more)]


@pytest.fixture(scope="module")
def whole(small: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A suite that ran without incident, on one worker."""
    out = tmp_path_factory.mktemp("whole") / "suite"
    assert cli.main(arguments(out, "--workers", 1)) == 0
    return out


def content(out: Path) -> dict[str, bytes]:
    """Every file but the locks and the sheets with their dates."""
    files = [file for file in out.rglob("*") if file.is_file() and file.name != "lock" and file.suffix != ".pdf"]
    return {str(file.relative_to(out)): file.read_bytes() for file in files}


def refused(capsys: pytest.CaptureFixture, words: list[str], status: int = 2) -> str:
    """The one line that a command ends with."""
    capsys.readouterr()
    assert cli.main(words) == status
    lines = capsys.readouterr().err.replace("\r", "\n").splitlines()
    lines = [line for line in lines if line.strip() and "run/s" not in line and not re.match(r".* \(\d of \d\)$", line)]
    lines = [line for line in lines if "it/s" not in line and "?" not in line and "s/run" not in line]
    lines = [line for line in lines if not re.fullmatch(r"[\d,]+ runs, \d+% of them done; about \d+ min .*", line)]
    assert len(lines) == 1 and "Traceback" not in lines[0], lines
    return lines[0]


def test_table(whole: Path) -> None:
    """Every combination is there, equal to the same scenarios run directly, and comparisons pair the runs."""
    table = json.loads((whole / "table.json").read_text())
    assert len(table["rows"]) == 6 * 3 and len(table["runs"]) == (5 * 2 + 3) * 3
    cases = {case.name: case.scenarios for case in tiny("core", 2, 3)}
    found = {(row["case"], row["feedforward"]): row for row in table["rows"]}
    for case in ("all", "caster", "random"):
        alone, by_lap = {}, {}
        for name in ("none", "rls"):
            runs = mrctl.simulate([s.model_copy(update=mrctl.FEEDFORWARDS[name]) for s in cases[case]])
            alone[name], by_lap[name] = mrctl.summary(runs), mrctl.per_lap(runs).position_rmse.values
        centre = np.median if case == "random" else np.mean
        row = found[case, "rls"]["omega_rmse"]
        own, bare = (alone[name]["omega_rmse"].to_numpy() for name in ("rls", "none"))
        assert row["value"] == pytest.approx(centre(own), rel=1e-12) and row["worst"] == pytest.approx(own.max())
        assert row["to_PID"]["value"] == pytest.approx(np.exp(np.log(own / bare).mean()), rel=1e-12)
        assert row["beats_PID"]["wins"] == (own < bare).sum() and found[case, "rls"]["failed"] == 0
        if case == "random":
            assert row["no_worse"]["value"] == pytest.approx((own <= 1.02 * bare).mean())
            assert row["no_worse"]["much"] == (own > 5 * bare).sum()
            assert row["no_worse"]["quantile_99"] == pytest.approx((own / bare).max())
        assert ("laps_to_converge" in row) == (case != "random")
        if case != "random":
            laps = alone["rls"]["laps_to_converge"].mean()
            assert found[case, "rls"]["position_rmse"]["laps_to_converge"]["value"] == pytest.approx(laps)
        for window, errors in WINDOWS.items():
            stated = found[case, "rls"]["position_rmse"][window]
            assert stated["value"] == pytest.approx(centre(errors(by_lap["rls"])), rel=1e-12)
    assert (whole / "table.md").read_text().count("| rls ") == 13  # six cases twice, and the recovery


def test_recovery(whole: Path) -> None:
    """Of a step: each run's laps against its own lap before."""
    table = json.loads((whole / "table.json").read_text())
    runs = [row for row in table["runs"] if (row["case"], row["feedforward"]) == ("payload", "rls")]
    laps = np.array([run["v_rmse"] for run in runs])
    assert laps.shape == (2, 6) and [run["seed"] for run in runs] == [0, 1]
    row = next(r for r in table["rows"] if (r["case"], r["feedforward"]) == ("payload", "rls"))["v_rmse"]
    assert row["after_one_lap"]["value"] == pytest.approx(np.exp(np.log(laps[:, 3] / laps[:, 1]).mean()))
    assert row["return_first_lap"]["value"] == pytest.approx(np.exp(np.log(laps[:, 4] / laps[:, 1]).mean()))
    assert row["recovered_within_one_lap"] == np.mean(laps[:, 3] <= 1.2 * laps[:, 1])


def test_step_over_settled() -> None:
    """One lap after the change over the last lap before the return, run by run."""
    error = np.array([[9.0, 2.0, 8.0, 6.0, 5.0, 2.0, 4.0, 2.0], [9.0, 1.0, 8.0, 3.0, 2.0, 6.0, 4.0, 2.0]])
    laps = xr.Dataset({"v_rmse": (("run", "lap"), error)}, {"run": [0, 1], "lap": np.arange(1, 9)})
    found = suite._step(laps, "v_rmse", Case("step", "step", (), change=3, back=7))
    assert found["after_one_lap_to_settled"]["value"] == pytest.approx(np.sqrt(6 / 2 * 3 / 6))
    assert found["after_one_lap"]["value"] == pytest.approx(np.sqrt(6 / 2 * 3 / 1))
    assert found["during"]["value"] == pytest.approx(4.0)


def test_leaders() -> None:
    """The least mean, and whom it does not beat by Wilson's interval; the true model and who failed are out of it."""
    random = np.random.default_rng(0)
    errors = {"none": 5 + random.random(10), "model": 2 + random.random(10), "rls": 2.1 + random.random(10)}
    errors |= {"true_model": random.random(10), "fel": np.where(np.arange(10) == 3, np.nan, 0.1)}
    rows = []
    for name, own in errors.items():
        row = {"case": "a", "feedforward": name, "failed": int(np.isnan(own).sum())}
        for metric in suite_tables.COLUMNS:
            row[metric] = {"value": np.nanmean(own), "first": {"value": 0.0}, "all": {"value": 0.0}}
            for rival, theirs in errors.items():
                wins = int((np.nan_to_num(own, nan=np.inf) < np.nan_to_num(theirs, nan=np.inf)).sum())
                low, high = stats.binomtest(wins, 10).proportion_ci(method="wilson")
                for window in (row[metric], row[metric]["first"], row[metric]["all"]):
                    window[f"beats_{'PID' if rival == 'none' else rival}"] = {"low": low, "high": high}
                row[metric]["first"]["value"] = row[metric]["all"]["value"] = np.nanmean(own)
        rows.append(row)
    assert 0.2 < np.mean(errors["model"] < errors["rls"]) < 0.9
    assert suite_tables.leaders(rows) == [["a", *["model, rls"] * 5]]


def test_mean_against_pairs() -> None:
    """Who is worse in 17 of 20 pairs is not the best, although its mean is less, and the table says both."""
    random = np.random.default_rng(1)
    model = 1 + 0.01 * random.random(20)
    fel = np.where(np.arange(20) < 17, 1.1, 0.1) * model
    lost = np.where(np.arange(20) < 10, 0.5, np.nan)
    case = Case("a", "steady", (mrctl.Scenario(laps=2),) * 20)
    runs = {"model": laps_of(model, model), "fel": laps_of(fel, fel), "rls": laps_of(model, lost)}
    rows = suite.compare([case], {"a": runs})
    assert fel.mean() < model.mean() and suite_tables.verdict(rows[1], "model") == 1
    assert suite_tables.leaders(rows) == [["a", *["model"] * 5]]
    cells = suite_tables.positions(rows)
    less = f"{1e3 * (fel - model).mean():.1f} (more in most runs)"
    assert cells.iloc[1, 5] == " / ".join([less] * 3)
    assert cells["feedforward"].tolist() == ["model", "fel", "rls (10/20 lost)"]
    # The guard acts twice a lap in each run; those that are lost in the second lap say nothing.
    runs["rls"]["guard_actions"] = ("run", "lap"), np.where(np.isnan(np.array([model, lost]).T), np.nan, 2.0)
    assert suite.compare([case], {"a": runs})[2]["guard_events"] == 4


def test_all_runs_failed() -> None:
    """Who lost all runs is not the best where each lost one: 19 of 20 pairs are no tie; no cell says nan."""
    random = np.random.default_rng(0)
    case = Case("a", "step", (mrctl.Scenario(laps=6),) * 20, change=3, back=5)
    lost, one = np.full(20, np.nan), np.where(np.arange(20), 0.0, np.nan)
    errors = {"none": lost, "model": 2 + one, "rls": 1 + one}
    runs = {name: laps_of(*(own + 0.1 * random.random(20) for _ in range(6))) for name, own in errors.items()}
    rows = suite.compare([case], {"a": runs})
    assert stats.binomtest(19, 19).pvalue < 0.05
    assert suite_tables.leaders(rows) == [["a", *["rls"] * 5]]
    cells = suite_tables.positions(rows), suite_tables.recovery(rows)
    assert [cells[0].iloc[0, 5], *cells[1].iloc[0, [3, 6, 7]]] == ["– / – / –", "–", "–", "–"]
    assert not any("nan" in cell for table in cells for cell in table.to_numpy().ravel())
    assert "nan" not in report.recoveries(report.Outcome("core", [case], {}, {}, rows, ""))


@pytest.mark.usefixtures("plain")
def test_hindsight(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    """The best fixed feedforward is that of `best_fixed`, and the regret of the model is what it does worse."""
    chosen = partial(short, course=mrctl.Circle(radius=0.5, period=4))  # on COURSE the best fixed one is the model
    monkeypatch.setattr(suite, "cases", chosen)
    words = ["suite", "--feedforward", "model", "hindsight", "--seeds", "1", "--random", "0", "--workers", "1"]
    assert cli.main([*words, "--out", str(tmp_path)]) == 0
    rows = json.loads((tmp_path / "table.json").read_text())["rows"]
    all_laps = {r["feedforward"]: r["position_rmse"]["all"]["value"] for r in rows if r["case"] == "all"}
    (scenario,) = next(case.scenarios for case in chosen("core", 1, 0) if case.name == "all")
    laps = mrctl.per_lap(best_fixed([scenario])).position_rmse.values
    assert all_laps["hindsight"] == pytest.approx(np.sqrt(np.mean(laps**2)), rel=1e-9)
    (line,) = (
        one for one in (tmp_path / "table.md").read_text().partition("Position error in mm")[2].splitlines()
        if re.match(r"\| all +\| model ", one) and one.count("|") == 9
    )  # fmt: skip
    folder = tmp_path / "runs" / "hindsight"
    assert cli.main(["run", str(folder), "--run", "0"]) == 0 and "bit-identical" in capsys.readouterr().out
    library = Library(folder)
    shown = np.stack([library.recording(1).log[name] for name in ("x", "y")])
    again = best_fixed([jobs.scenario_of(folder, 1)]).isel(run=0)
    assert np.array_equal(shown, np.stack([again.x, again.y]))
    regret = 1e3 * (all_laps["model"] - all_laps["hindsight"])
    assert float(line.split("|")[7]) == pytest.approx(regret, rel=0.06)  # two digits


def laps_of(*laps: ArrayLike) -> xr.Dataset:
    """The laps of some runs."""
    error = (("run", "lap"), np.array(laps).T)
    names = {name: error for name in metrics.METRICS}
    count = error[1].shape[0]
    lost = np.isnan(laps).any(axis=0)
    per_run = {"laps": ("run", [len(laps)] * count), "failed": ("run", lost)}
    per_run |= {"failure_time": ("run", [np.nan] * count), "lap_time": ("run", [LAP] * count)}
    return xr.Dataset(names | per_run, {"run": np.arange(count), "lap": np.arange(1, len(laps) + 1)})


def test_floors() -> None:
    """The largest change of a mean, and of a difference of two; a feedforward that lost a run says nothing."""
    whole = {"model": laps_of([1.0, 1.0], [1.0, 3.0]), "rls": laps_of([1.0, 1.0], [2.0, 2.0])}
    half = {"model": laps_of([1.4, 1.6], [1.5, 2.9]), "rls": laps_of([1.4, 1.4], [2.3, 2.3])}
    lost = laps_of([9.0, 9.0], [1.1, np.nan])
    for more in ({}, {"fel": lost}):
        found = suite.floors([(whole | more, half | more)], "v_rmse")
        assert found["last"] == pytest.approx((0.3, 0.1, 0.1)) and found["first"] == pytest.approx((0.5, 0.1, 0.1))
    assert set(suite.floors([], "v_rmse").values()) == {(0.0, 0.0, 0.0)}
    few, many = ((laps_of(*[np.ones(n)] * 2), laps_of(*[1 + 1e-5 * np.arange(n)] * 2)) for n in (5, 6))
    ties = [suite.floors([({"a": x, "b": x}, {"a": x, "b": y})], "v_rmse")["last"].tie for x, y in (few, many)]
    assert ties == [TIE["v_rmse"], pytest.approx(2.5e-5)]  # five pairs never tell two apart


def test_tie() -> None:
    """A tie is so large that the paired test finds no change by the step: 5 changes of one sign are chance, 6 are not.

    Their two-sided probabilities are 2 · 2⁻⁵ = 0.06 and 2 · 2⁻⁶ = 0.03.
    """
    changes = np.arange(1.0, 21.0)
    assert suite.unnoticed(changes) == suite.unnoticed(-changes) == 15 and suite.unnoticed(changes[:5]) == 0
    assert suite.unnoticed(changes * (-1.0) ** np.arange(20)) == 0
    still, moved = laps_of(1 + 0 * changes, 1 + 0 * changes), laps_of(1 + 0 * changes, 1 + changes)
    found = suite.floors([({"model": still, "rls": still}, {"model": still, "rls": moved})], "v_rmse")["last"]
    assert found == pytest.approx((10.5, 10.5, 15))


def test_sentences() -> None:
    """They count what the paired test decides: twenty of twenty is, two of three is not, and the floor makes ties."""
    random = np.random.default_rng(0)

    def rows(count: int, floor: float) -> list[dict]:
        case = Case("nominal", "steady", (mrctl.Scenario(laps=2),) * count)
        half = case._replace(name="nominal, half the step", part="floor")
        noise = 0.01 * random.random(count)

        def drives(more: float) -> dict[str, xr.Dataset]:
            """The model's error stays; those of the others grow by so much."""
            first, last = {"none": 5, "rls": 1.2}, {"none": 5, "rls": 1.5}
            others = {name: laps_of(first[name] + more + noise, last[name] + more - noise) for name in first}
            return others | {"model": laps_of(1 + noise, 2 - noise)}

        found, moved = drives(0.0), drives(floor)
        return suite.compare([case, half], {case.name: found, half.name: moved})

    says = [table.says for table in suite_tables.tables(rows(20, 0.1), "core")]
    assert "below it `rls` in 1; above it `PID` in 1; the others are level" in says[0]
    assert "in lap 1 against `model` in 1 case" in says[2] and "above it `PID` in 1, `rls` in 1" in says[2]
    assert "all tie in 0 of 1 cases; in the others, best or level with the best are `rls` in 1." in says[3]
    assert "reverses 0." in says[1]
    (few,) = {suite_tables.against([r for r in rows(3, 0.1) if r["part"] == "steady"], "last")}
    assert "all are level with it" in few
    tied = suite_tables.tables(rows(20, 0.6), "core")[0].says
    assert "below it" not in tied and "above it `PID` in 1" in tied
    for quick in (suite_tables.tables(rows(20, 0.1), "quick"), suite_tables.tables(rows(3, 0.1), "core")):
        assert {one.says for one in quick} == {suite_tables.NO_CLAIM}
        assert not any("level" in one.title for one in quick)  # three draws call PID level with all others


@pytest.mark.parametrize(
    ("value", "low", "high", "text"),
    [(6.5e-4, 6.4e-4, 6.6e-4, "0.650 [0.640, 0.660]"), (6.5e-4, 6.5e-4, 6.5e-4, "0.650"),
     (6.5e-4, 6.49996e-4, 6.50004e-4, "0.650000 [0.649996, 0.650004]"), (1e-3, np.nan, np.nan, "1.00"),
     (1e-3, -np.inf, np.inf, "1.00 [–, –]")],
)  # fmt: skip
def test_interval(value: float, low: float, high: float, text: str) -> None:
    """No interval is printed with equal ends."""
    assert suite_tables.interval({"value": value, "low": low, "high": high, "samples": 2}) == text


@pytest.mark.parametrize(
    ("value", "low", "high", "floor", "text"),
    [
        (1.7236e-3, 1.68e-3, 1.76e-3, 0.54e-3, "1.7 [1.7, 1.8]"),  # one digit of the floor
        (1.7236e-3, 1.71e-3, 1.74e-3, 0.54e-3, "1.7 [1.7, 1.8]"),  # ends that are rounded alike go outwards
        (0.4927e-3, 0.462e-3, 0.552e-3, 0.0447e-3, "0.49 [0.46, 0.55]"),
        (0.4740e-3, 0.452e-3, 0.496e-3, 0.111e-3, "0.47 [0.45, 0.50]"),  # two digits of a floor below 36
        (12.714e-3, 12.6e-3, 12.9e-3, 0.54e-3, "12.7 [12.6, 12.9]"),
        (1.4321, 1.4, 1.5, 0.54e-3, "1.43e+03 [1.40e+03, 1.50e+03]"),  # three significant digits suffice
        (0.65e-3, 0.64e-3, 0.66e-3, 0.0, "0.650 [0.640, 0.660]"),
    ],
)
def test_no_digit_below_the_floor(value: float, low: float, high: float, floor: float, text: str) -> None:
    """The last printed digit is that of the floor, rounded as the Particle Data Group does."""
    stated = {"value": value, "low": low, "high": high, "samples": 20, "floor": {"mean": floor}}
    assert suite_tables.interval(stated) == text


def test_no_worse() -> None:
    """A run that is lost where PID is not counts as infinitely worse; one that PID loses too does no harm."""
    pid, lost = np.full(200, 2.0), np.arange(200) < 3
    pid[-5:] = np.nan
    found = suite.no_worse(np.where(lost, np.nan, np.where(np.arange(200) < 60, 12.0, 2.0)), pid)
    assert found["value"] == 140 / 200 and found["low"] < 0.7 < found["high"] and found["much"] == 60
    assert found["quantile_99"] == np.inf
    assert suite.no_worse(np.where(lost[::-1], np.nan, 3.0), pid)["quantile_99"] == 1.5


def interrupted(path: str, job: int) -> JobOutcome:
    """Computes a job, but Ctrl-C comes in the last one of the second feedforward."""
    if Path(path).name == "model" and job == Store(path).jobs - 1:
        signal.raise_signal(signal.SIGINT)
    return compute(path, job)


compute = jobs.compute


def test_goes_on_where_it_stopped(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    """Interrupted in its second feedforward, it keeps what was done; continued by two workers, it writes the same files
    as one that ran through, byte for byte, page and figures included.
    """
    out = tmp_path / "suite"
    with monkeypatch.context() as patch:
        patch.setattr(jobs, "compute", interrupted)
        assert cli.main(arguments(out, "--workers", 1)) == 130
    assert "mrctl: interrupted" in capsys.readouterr().err.splitlines()[-1]
    assert not (out / "report.html").exists()
    assert 0 < len(Store(out / "runs" / "model").done()) < Store(out / "runs" / "model").jobs
    done = out / "runs" / "none" / "runs.parquet"
    stamp = done.stat().st_mtime_ns
    monkeypatch.setattr(jobs, "Processes", Processes)
    assert cli.main(arguments(out, "--workers", 2)) == 0
    assert content(out) == content(whole) and done.stat().st_mtime_ns == stamp


class Page(HTMLParser):
    """Collects what a page shows and what it would load."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.loads: list[str] = []
        self.words = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.loads += [value or "" for name, value in attrs if name in ("src", "href", "srcset", "data", "action")]
        assert tag not in ("script", "link", "iframe")
        if tag not in ("img", "meta"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.words += data


def test_page_stands_alone(whole: Path) -> None:
    """It loads nothing; its images are whole; it says what was run, with which versions, and how to do it again."""
    text = (whole / "report.html").read_text()
    page = Page(text)
    assert not page.open and "url(" not in text and "@import" not in text
    assert len(page.loads) >= 5
    for source in page.loads:
        assert source.startswith("data:image/png;base64,")
        image = Image.open(io.BytesIO(base64.b64decode(source.split(",")[1], validate=True)))
        image.load()
        assert image.width > 150
    mujoco = mrctl.results.dataset.versions()["mujoco"]
    for text in ("39 runs", "payload", "switch <on>", "laps to 1.2× the final", f"mujoco {mujoco}", "phase margin"):
        assert text in page.words
    again = next(line for line in page.words.splitlines() if line.startswith("mrctl suite --"))
    assert again == "mrctl suite --feedforward none model rls --seeds 2 --random 3"


@pytest.mark.skipif(shutil.which("chromium") is None, reason="needs chromium")
def test_page_fits(whole: Path) -> None:
    """The page is as wide as a screen or a phone: tables and figures scroll on their own, beside their first column."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"))
        for width in (1280, 400):
            page = browser.new_page(viewport={"width": width, "height": 800}, is_mobile=width == 400)
            page.goto((whole / "report.html").as_uri())
            assert page.evaluate("[innerWidth, document.documentElement.scrollWidth]") == [width, width]
            page.evaluate("for (const part of document.querySelectorAll('.wide')) part.scrollLeft = 1e4")
            first = page.locator("#T_scorecard tbody th").first.bounding_box()
            assert first is not None and 0 <= first["x"] < 30
            least = page.evaluate("Math.min(...[...document.images].map((image) => image.width))")
            assert least >= 640
        browser.close()


@pytest.mark.usefixtures("plain")
def test_controller_joins(whole: Path, tmp_path: Path) -> None:
    """Somebody's own feedforward joins a suite that is there: only its runs are computed, and they are `simulate`'s."""
    file, out = tmp_path / "mine.py", tmp_path / "suite"
    file.write_text(GAIN)
    shutil.copytree(whole, out)
    before = {p: p.stat().st_mtime_ns for p in out.glob("runs/*/runs.parquet")}
    assert cli.main(arguments(out, "--workers", 1, "--controller", f"{file}:Gain")) == 0
    assert {p: p.stat().st_mtime_ns for p in before} == before
    table = json.loads((out / "table.json").read_text())
    row = next(r for r in table["rows"] if (r["case"], r["feedforward"]) == ("all", "Gain"))
    namespace: dict = {}
    exec(GAIN, namespace)
    scenarios = next(case.scenarios for case in tiny("core", 2, 3) if case.name == "all")
    alone = mrctl.summary(mrctl.simulate(list(scenarios), feedforward=namespace["Gain"]))
    assert row["v_rmse"]["value"] == pytest.approx(alone["v_rmse"].mean(), rel=1e-12)
    assert "Gain" in (out / "report.html").read_text() and table["controllers"] == [f"{file}:Gain"]
    assert content(whole)["runs/rls/runs.parquet"] == content(out)["runs/rls/runs.parquet"]


@pytest.mark.usefixtures("plain")
def test_maps_are_those_of_feedforwards() -> None:
    """A heat map is drawn of what learns one: not of PID, the model, or a user's controller without a feedforward."""
    own = {"Gain": "/a.py:Gain", "Pursuit": "motion=/a.py:Pursuit", "Both": "motion=/a.py:Pursuit,feedforward=/b.py:B"}
    learns = {"fel+Pursuit": Choice("none", "fel", own["Pursuit"])}
    choices = suite.by_name(("none", "model", "true_model", "model+l1", "fel", "model+rls", "hindsight"), ())
    choices = {**choices, **{name: Choice(controller=controller) for name, controller in own.items()}, **learns}
    assert report.with_map(choices) == ["fel", "model+rls", "Gain", "Both", "fel+Pursuit"]


@pytest.mark.usefixtures("plain", "two_cases")
def test_controller_with_the_model(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """With `model+` in front it adds to the nominal model, as with that prior in `simulate`; the page repeats that."""
    file, out = tmp_path / "mine.py", tmp_path / "suite"
    file.write_text(GAIN.replace("command * self.gain", "0.2 * command * self.gain"))
    words = ["suite", "--feedforward", "none", "--seeds", "2", "--random", "0", "--workers", "1", "--out", str(out)]
    assert cli.main([*words, "--controller", f"{file}:Gain", f"model+{file}:Gain"]) == 0
    table = json.loads((out / "table.json").read_text())
    found = {r["feedforward"]: r["v_rmse"]["value"] for r in table["rows"] if r["case"] == "all"}
    namespace: dict = {}
    exec(file.read_text(), namespace)
    scenarios = next(case.scenarios for case in tiny("core", 2, 0) if case.name == "all")
    for name, prior in (("Gain", "none"), ("model+Gain", "model")):
        runs = mrctl.simulate([s.replace(prior=prior) for s in scenarios], feedforward=namespace["Gain"])
        assert set(runs.feedforward.values) == {name}
        assert found[name] == pytest.approx(mrctl.summary(runs)["v_rmse"].mean(), rel=1e-12)
    assert found["model+Gain"] != found["Gain"]
    assert f"--controller {file}:Gain model+{file}:Gain" in (out / "report.html").read_text()
    two = refused(capsys, arguments(tmp_path / "no", "--controller", f"model+fel+{file}:Gain"))
    assert "has two feedforwards; yours is in the place of a learner, and only model+ can be in front of it" in two


def test_controller_with_a_learner(tmp_path: Path) -> None:
    """A motion controller drives over the feedforward in front of it, which its name in tables and on the page says."""
    file = tmp_path / "mine.py"
    file.write_text(OPEN)
    entry = f"model+composite+motion={file}:Open"
    choices = suite.by_name(("model+composite",), (entry,))
    assert choices["model+composite+Open"] == Choice("model", "composite", f"motion={file}:Open")
    assert len(choices) == 2 and report.controllers(choices) == [entry]


def test_columns_say_what_they_are(whole: Path) -> None:
    """A share of runs has its interval explained, in the same words on the page and in Markdown, also of few draws."""
    row = next(r for r in json.loads((whole / "table.json").read_text())["rows"] if r["case"] == "random")
    won = row["position_rmse"]["beats_model"]
    assert won["ties"] == 0  # in so few draws, but for chance
    exact = stats.binomtest(won["wins"], 3).proportion_ci(method="exact")  # of the share in position, not of an error
    assert (won["low"], won["high"]) == pytest.approx((exact.low, exact.high), rel=1e-9)
    title = "share of runs below model: V / θ̇ / position [interval of position]"
    meaning = "the brackets hold the 95 % interval of the share for position, given the ties"
    shown, page = (whole / "table.md").read_text(), Page((whole / "report.html").read_text()).words
    assert title in shown and title in page and meaning in shown and meaning in page
    bounds = f"[{won['low']:.2f}, {won['high']:.2f}]"
    assert bounds in shown and bounds in page


def test_held_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    """A cell counts where the mean is no more than the rival's and the floor; each time it is driven is kept."""
    plants = {"heavy": mrctl.Perturbation(mass_factor=2.0), "light": mrctl.Perturbation(mass_factor=0.6)}
    sets = {
        "first": Cells({"circle": COURSE}, plants, range(100)),
        "second": Cells({"circle": COURSE}, plants, range(1)),
    }
    monkeypatch.setattr(held_out, "cells", sets.__getitem__)
    monkeypatch.setattr(held_out_cells, "LAPS", 2)
    words = ["suite", "--held-out", "none", "--seeds", "2", "--workers", "1", "--out", str(tmp_path)]
    for _ in range(2):
        assert cli.main(words) == 0
    log = tmp_path / held_out.LOG_FILE
    begun, ended = map(json.loads, log.read_text().splitlines())
    log.write_text(f"{json.dumps(begun)}\n")  # as when the process ends between the last run and the line on the result
    assert cli.main(words) == 0
    again = [json.loads(line) for line in log.read_text().splitlines()]
    assert again == [begun, ended | {"time": again[-1]["time"]}]
    assert (begun["entry"], begun["replicates"], ended["says"] in capsys.readouterr().out) == ("none", 2, True)
    table = json.loads((tmp_path / "table.json").read_text())
    cells = table["cells"]["none"]
    assert table["mode"] == "held-out" and [*table["cells"]] == ["none"] and len(cells) == 2 * 3 * 3 * 3
    errors = {}
    for name in ("none", "model"):
        for half in (1, 2):
            for cell in sets["first"].cases(2):
                changes = {**mrctl.FEEDFORWARDS[name], "physics_step": 0.002 / half}
                runs = mrctl.simulate([s.model_copy(update=changes) for s in cell.scenarios])
                errors[name, half, cell.name.split("; ")[1]] = mrctl.per_lap(runs).position_rmse.values[:, 0].mean()
    asked = {"metric": "position_rmse", "window": "first", "rival": "model"}
    for row in (row for row in cells if asked.items() <= row.items()):
        differences = {(half, p): errors["none", half, p] - errors["model", half, p] for half in (1, 2) for p in plants}
        assert row["difference"]["value"] == pytest.approx(differences[1, row["plant"]], rel=1e-9)
        changes = (abs(differences[2, p] - differences[1, p]) for p in plants)
        assert row["floor"]["difference"] >= max(changes) * (1 - 1e-9)
        assert row["at_or_below"] == (differences[1, row["plant"]] <= row["floor"]["difference"])
    assert cli.main([*words[:3], "rls", *words[3:]]) == 0  # beside another one, and with the runs of before
    both = json.loads((tmp_path / "table.json").read_text())["cells"]
    assert both["none"] == cells and len(both["rls"]) == len(cells) and both["rls"] != cells
    assert [json.loads(line)["entry"] for line in log.read_text().splitlines()] == ["none", "none", "rls", "rls"]
    assert "Held-out cells, rls" in (tmp_path / "table.md").read_text()
    (tmp_path / "mine.py").write_text(GAIN)
    sets["first"] = sets["first"]._replace(plants={"light": plants["light"]})
    own = [*words[:1], "--held-out", f"model+{tmp_path}/mine.py:Gain", *words[3:-1], str(tmp_path / "own")]
    assert cli.main(own) == 0
    assert "at or below model" in capsys.readouterr().out and (tmp_path / "own" / "runs" / "model+Gain").is_dir()
    assert "seeds: 2 is not between 1 and 1" in refused(capsys, [*words, "--cells", "second"])
    assert "cells: is for --held-out" in refused(capsys, ["suite", "--cells", "second"])
    assert "is neither one of none, model+indi" in refused(capsys, ["suite", "--held-out", "model"])
    assert "name at least one" in refused(capsys, ["suite", "--held-out", "--seeds", "2"])
    assert "one of --quick" in refused(capsys, ["suite", "--held-out", "fel", "--quick"])
    assert "names the feedforwards to judge" in refused(capsys, ["suite", "--held-out", "fel", "--feedforward", "rls"])


@pytest.mark.parametrize(
    ("code", "message"),
    [
        ("class Gain(: pass", "SyntaxError"),
        ("import no_such_module", "ModuleNotFoundError: No module named 'no_such_module'"),
        ("raise SystemExit('no')", "SystemExit: no"),
        ("Other = 1", "has no Gain"),
        (GAIN.replace("robot.velocity_gain", "robot.speed"), "AttributeError"),
        (GAIN.replace("command * self.gain", "command[:1, :1] * [1, 2, 3]"), "output is shape (1, 3)"),
        (GAIN.replace("self.ticks += 1", "raise KeyError('boom')"), "KeyError: 'boom'"),
        (GAIN.replace("def learn", "def teach"), "has no method learn"),
    ],
)
def test_bad_controller(tmp_path: Path, capsys: pytest.CaptureFixture, code: str, message: str) -> None:
    """What is wrong in it, or in loading it, is one line, before anything is run."""
    (tmp_path / "mine.py").write_text(code)
    line = refused(capsys, arguments(tmp_path / "suite", "--controller", tmp_path / "mine.py:Gain"))
    assert line.startswith("mrctl: controller: ") and message in line
    assert not (tmp_path / "suite").exists()


@pytest.mark.usefixtures("plain", "two_cases")
def test_controller_that_fails_later(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """Its runs count as failed, and the tables say where and why."""
    late = GAIN.replace("self.ticks += 1", "self.ticks += 1\n        assert self.ticks < 50, 'tired'")
    (tmp_path / "mine.py").write_text(late)
    words = ["suite", "--feedforward", "none", "--seeds", "1", "--random", "0", "--workers", "1"]
    words += ["--out", str(tmp_path / "suite"), "--controller", str(tmp_path / "mine.py:Gain")]
    assert cli.main(words) == 0
    table = json.loads((tmp_path / "suite" / "table.json").read_text())
    row, run = table["rows"][-1], table["runs"][-1]
    assert row["feedforward"] == "Gain" and row["failed"] == row["runs"] == 1
    assert run["failure"] == "feedforward Gain: AssertionError: tired (mine.py, line 12), tick 49"


def test_controller_without_a_map(tmp_path: Path) -> None:
    """What raises an error at a command of the heat map, or at every one in the end, costs the others no report."""
    tired = GAIN.replace("return", "assert self.ticks < 50\n        return")
    for name, code in (
        ("tired", tired),
        ("fast", GAIN.replace("return", "assert command[0, 0] < 1.1\n        return")),
    ):
        (tmp_path / f"{name}.py").write_text(code)
    (tmp_path / "mine.py").write_text(GAIN)
    choices = {name: Choice(controller=f"{tmp_path / name}.py:Gain") for name in ("tired", "fast", "mine")}
    assert [*report.maps(choices, mrctl.Scenario(reference=COURSE, laps=1))] == ["mine"]


def test_bad_input(whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """One line each."""
    out = tmp_path / "suite"
    assert "seeds" in refused(capsys, arguments(out, "--seeds", -1))
    assert "feedforward" in refused(capsys, ["suite", "--feedforward", "magic", "--out", str(out)])
    assert "not of the form" in refused(capsys, arguments(out, "--controller", "mine.py"))
    assert "no file" in refused(capsys, arguments(out, "--controller", "mine.py:Gain"))
    (tmp_path / "mine.py").write_text(GAIN + "\nrls = Gain\n")
    assert "the name rls is taken" in refused(capsys, arguments(out, "--controller", tmp_path / "mine.py:rls"))
    assert "workers: 0" in refused(capsys, arguments(out, "--workers", 0))
    assert "begun with another" in refused(capsys, arguments(whole, "--seeds", 3))
    (tmp_path / "file").write_text("mine")
    assert "cannot be written" in refused(capsys, arguments(tmp_path / "file"))
