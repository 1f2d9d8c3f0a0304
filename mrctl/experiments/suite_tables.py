"""The tables of the suite, each with the sentence that it supports."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations
from typing import Any

import numpy as np
import pandas as pd

from mrctl.experiments.cases import (
    FLOOR,
    HALF,
    HINDSIGHT,
    MUCH_WORSE,
    NO_WORSE,
    PARTS,
    RECOVERED_RATIO,
    REFERENCES,
    UNCHANGED,
)
from mrctl.experiments.tables import MIN_PAIRS, Table, number

COLUMNS = {"v_rmse": "V, mm/s", "omega_rmse": "θ̇, mrad/s", "position_rmse": "position, mm"}
TITLES = {"none": "PID"}  # names of feedforwards in the tables, where these differ
YARDSTICKS = ("none", "model")  # feedforwards that the tables compare all others with
WINDOWS = {"first": "lap 1", "all": "all laps", "last": "the last lap"}
LEADING = {
    "V": ("v_rmse", "last"),
    "θ̇": ("omega_rmse", "last"),
    "position": ("position_rmse", "last"),
    "position in lap 1": ("position_rmse", "first"),
    "position in all laps": ("position_rmse", "all"),
}
WON = "share of runs below {}: V / θ̇ / position [interval of position]"
HARMLESS = f"share of runs at most {NO_WORSE:g}× PID: V / θ̇ / position [interval of position]"
CONVERGED = f"laps to {RECOVERED_RATIO:g}× the final V / θ̇ / position"
READING_OF_POSITIONS = (
    "Lap 1, all laps and the last lap each hold the mean over the runs that drove all of it, for random worlds the "
    "median, with its 95 % interval. Less `model` is the mean of the differences from `model`, run by run, for random "
    "worlds their median, or a tie where the sign test does not tell the two apart; where it has the other sign than "
    "in most runs, that is said. Regret is not paired: it is the mean over all laps less that of `hindsight`, for "
    "random worlds a difference of two medians, each over the runs that finished with that feedforward, or a tie up to "
    "the floor of differences. Excess is a mean over the runs that finished, for random worlds too."
)
NO_CLAIM = "So few draws tell nothing apart: this table supports no claim."

Row = dict[str, Any]


def tables(rows: Sequence[Row], mode: str) -> list[Table]:
    """Makes the tables of the last lap by part, of lap 1 and all laps, of the best, and of the recovery after steps.

    Args:
        rows: What `suite.compare` returns.
        mode: Size of the suite.
    """
    found = []
    few = mode == "quick" or all(row["runs"] < MIN_PAIRS for row in rows)

    def add(title: str, says: str, cells: pd.DataFrame, reads: str = "") -> None:
        found.append(Table(f"{title} ({mode})", NO_CLAIM if few else says, cells, reads))

    for part, title in PARTS.items():
        if own := [row for row in rows if row["part"] == part]:
            cells = last_laps(own)
            add(title, resolution(rows) if part == "floor" else against(own, "last"), cells, reading(list(cells)))
    every = [row for row in rows if row["part"] != "floor"]
    says = " ".join(against(every, window) for window in WINDOWS)
    add("Position error in mm", says, positions(every), READING_OF_POSITIONS)
    if not few and any(row["feedforward"] not in REFERENCES for row in rows):  # few draws call everyone level
        best = pd.DataFrame(leaders(every), columns=["case", *LEADING])
        add("Best in each case, and who is level with it", leading(best), best)
    if steps := [row for row in rows if row["part"] == "step"]:
        add("Recovery and forgetting: position error over that before the step", recovered(steps), recovery(steps))
    return found


def titled(name: str) -> str:
    """Returns the name of a feedforward in tables."""
    return TITLES.get(name, name)


def verdict(row: Row, rival: str, metric: str = "position_rmse", window: str = "last") -> int:
    """Compares two feedforwards in one case: −1 is below the rival with 95 % confidence, 1 is above it, 0 is level.

    The test pairs the runs (exact sign test); differences that the integrator cannot resolve are ties.
    """
    stated = row[metric] if window == "last" else row[metric][window]
    beats = stated[f"beats_{titled(rival)}"]
    return int(beats["high"] < 0.5) - int(beats["low"] > 0.5)


def against(rows: Sequence[Row], window: str) -> str:
    """Returns a sentence on who is below and above `model`, or PID if there is no model, in how many cases."""
    names = list(dict.fromkeys(row["feedforward"] for row in rows))
    rival = next((name for name in reversed(YARDSTICKS) if name in names and len(names) > 1), None)
    if rival is None:
        return "There is nothing to compare with."
    cases, runs = len({row["case"] for row in rows}), sorted({row["runs"] for row in rows})
    stands = {n: [verdict(r, rival, window=window) for r in rows if r["feedforward"] == n] for n in names if n != rival}
    tie = number(1e3 * _window(rows[0]["position_rmse"], window)["floor"]["tie"])
    parts = [
        f"{word} it {listed}"
        for word, sign in (("below", -1), ("above", 1))
        if (listed := _counted({name: own.count(sign) for name, own in stands.items()}))
    ]
    rest = "the others are level with it" if parts else "all are level with it"
    return (
        f"Position error in {WINDOWS[window]} against `{titled(rival)}` in {cases} case{'s' * (cases > 1)} "
        f"({' or '.join(map(str, runs))} runs each, compared run by run with 95 % confidence; differences up to {tie} "
        "mm are ties): "
        f"{'; '.join([*parts, rest])}."
    )


def _counted(counts: dict[str, int]) -> str:
    """Lists names with their counts as text, the largest first, without zeros."""
    ordered = sorted((name for name in counts if counts[name]), key=lambda name: -counts[name])
    return ", ".join(f"`{titled(name)}` in {counts[name]}" for name in ordered)


def resolution(rows: Sequence[Row]) -> str:
    """Returns a sentence on how far half the physics step moves the means, and on the ranks that it reverses."""
    stated = rows[0]
    floor = {metric: [_window(stated[metric], w)["floor"] for w in WINDOWS] for metric in COLUMNS}
    moved = ", ".join(
        f"{title.split(',')[0]} {number(1e3 * max(one['mean'] for one in floor[metric]))} {title.split(', ')[1]} "
        f"(a difference of two {number(1e3 * max(one['difference'] for one in floor[metric]))}, a tie in single runs "
        f"{number(1e3 * max(one['tie'] for one in floor[metric]))})"
        for metric, title in COLUMNS.items()
    )
    pairs = list(_both_steps(rows))
    claimed, turned = sum(one != 0 for one, _ in pairs), sum(one * other < 0 for one, other in pairs)
    return (
        f"Half the step moves no mean by more than: {moved}. Of {claimed} ranks between two feedforwards on these "
        f"plants, in lap 1, all laps and the last lap, it reverses {turned}."
    )


def _both_steps(rows: Sequence[Row]) -> Iterator[tuple[int, int]]:
    """Yields every verdict on the plants of `FLOOR`, with the physics step and with half of it."""
    by = {(row["case"], row["feedforward"]): row for row in rows}
    names = list(dict.fromkeys(row["feedforward"] for row in rows))
    for plant in FLOOR:
        for name, rival in combinations(names, 2):
            if (plant, name) in by and (plant + HALF, name) in by:
                for metric in COLUMNS:
                    for window in WINDOWS:
                        whole, half = (by[case, name] for case in (plant, plant + HALF))
                        yield verdict(whole, rival, metric, window), verdict(half, rival, metric, window)


def last_laps(rows: Sequence[Row]) -> pd.DataFrame:
    """Makes the table of errors in the last lap, with the shares of runs in which they are below PID's and `model`'s.

    For random scenarios it also has the share of them in which the feedforward does no harm, compared with PID alone.
    """
    header = ["case", "feedforward", "failed", *(f"{column_title(rows, metric)}; worst 5 %" for metric in COLUMNS)]
    header += [*(WON.format(titled(one)) for one in YARDSTICKS), "guard acted"]
    unchanged, random = rows[0]["part"] in UNCHANGED, any("no_worse" in row["position_rmse"] for row in rows)
    header += (HARMLESS, f"position over PID, 99 %; runs above {MUCH_WORSE:g}") if random else ()
    header += [CONVERGED] if unchanged else []
    cells = [
        [
            row["case"], row["feedforward"], f"{row['failed']}/{row['runs']}", *(_mean(row[m]) for m in COLUMNS),
            *(_wins(row, titled(one)) for one in YARDSTICKS), _acted(row),
            *(_harm(row) if random else ()), *([_converged(row)] if unchanged else []),
        ]
        for row in rows
    ]  # fmt: skip
    return pd.DataFrame(cells, columns=header)


def reading(header: Sequence[str]) -> str:
    """Returns how to read the columns of `last_laps`, for those that a table has."""
    centre = "median" if HARMLESS in header else "mean"
    found = [
        f"Errors are the {centre} over the runs that finished, with its 95 % interval; after the semicolon stands the "
        "mean of the worst 5 % of all runs (of 20 or fewer, the worst run), which is infinite where a run failed. "
        "Below PID, or below `model`, is the share of runs in which the error of the last lap is less than that of PID "
        "alone, or of `model`, in the same run: 1.00 is all runs, 0.50 is no difference, a tie counts half, and a "
        "failed run loses. The three shares are those for V, θ̇ and position; the brackets hold the "
        "95 % interval of the share for position, given the ties. Guard acted is the mean number of times in a run "
        "that finished."
    ]
    if HARMLESS in header:
        found.append(
            f"At most {NO_WORSE:g}× PID is the share of runs whose error is at most so many times that of PID alone, "
            "with Wilson's 95 % interval of the share for position in brackets. Position over PID is the 99 % quantile "
            f"of that ratio; then comes the number of runs in which it is above {MUCH_WORSE:g}."
        )
    if CONVERGED in header:
        found.append(
            f"The last column counts laps until the error stays within {RECOVERED_RATIO:g} times its final value."
        )
    return " ".join(found)


def positions(rows: Sequence[Row]) -> pd.DataFrame:
    """Makes the table of position errors in lap 1, all laps and the last lap, less those of `model`, and of regret.

    Regret is the error over all laps less that of `hindsight`; `READING_OF_POSITIONS` says how each is computed.
    """
    header = ["case", "feedforward", *WINDOWS.values(), "less `model`: lap 1 / all laps / last lap", "regret"]
    known = {row["case"]: row["position_rmse"]["all"]["value"] for row in rows if row["feedforward"] == HINDSIGHT}
    cells = []
    for row in rows:
        error = row["position_rmse"]
        regret = 1e3 * (error["all"]["value"] - known.get(row["case"], np.nan))
        tie = abs(regret) <= 1e3 * error["all"]["floor"]["difference"]
        excess = error.get("excess", {"samples": 0})
        lost = f" ({row['failed']}/{row['runs']} lost)" if row["failed"] else ""
        name = row["feedforward"] + lost
        cells.append([row["case"], name, *(interval(_window(error, window)) for window in WINDOWS)])
        cells[-1].append(" / ".join(_less(row, window) for window in WINDOWS) if "less_model" in error else "")
        cells[-1].append(("tie" if tie else _signed(regret)) if np.isfinite(regret) else "")
        cells[-1].append(number(1e3 * excess["value"]) if excess["samples"] else "–")
    floor = max(_window(row["position_rmse"], window)["floor"]["mean"] for row in rows for window in WINDOWS)
    return pd.DataFrame(cells, columns=[*header, f"excess, mm s (floor of the means: {number(1e3 * floor)} mm)"])


def leaders(rows: Sequence[Row]) -> list[list[str]]:
    """Finds, for each case and column of `LEADING`, the best feedforward and those level with it.

    The best is the one with the least mean of those that no other beats with 95 % confidence in the same runs; one that
    it does not beat so is level. One with a failed run is left out; where all have one, the best is among those with
    the fewest. `REFERENCES`, which know the plant, are left out too. Where all are level, it is a tie.
    """
    lines = []
    for case in dict.fromkeys(row["case"] for row in rows):
        own = {str(r["feedforward"]): r for r in rows if r["case"] == case and r["feedforward"] not in REFERENCES}
        fine = [name for name, row in own.items() if not row["failed"]] or list(own)
        cells = []
        for metric, window in LEADING.values():
            beaten = {
                one for other in fine for one in fine if other != one and verdict(own[other], one, metric, window) < 0
            }
            order = sorted(fine, key=lambda name: (own[name]["failed"], _window(own[name][metric], window)["value"]))
            best = next((one for one in order if one not in beaten), order[0])
            others = [one for one in order if one != best]
            level = [one for one in others if verdict(own[best], one, metric, window) >= 0]
            names = (titled(name) for name in (best, *level))
            cells.append("tie" if others and len(level) == len(others) else ", ".join(names))
        lines.append([case, *cells])
    return lines


def leading(best: pd.DataFrame) -> str:
    """Returns a sentence on who is best, or level with the best, in how many cases."""
    column = best["position"]
    best_of = [cell.split(", ") for cell in column if cell != "tie"]
    counts = {name: sum(name in names for names in best_of) for name in dict.fromkeys(sum(best_of, []))}
    ties = len(column) - len(best_of)
    shared = f"In position in the last lap all tie in {ties} of {len(column)} cases"
    return f"{shared}; in the others, best or level with the best are {_counted(counts)}." if best_of else f"{shared}."


def recovery(rows: Sequence[Row]) -> pd.DataFrame:
    """Makes the table of position errors after a step and after the return, over that before the step."""
    header = ["case", "feedforward", "failed", "first lap", "one lap later; worst 5 %", "recovered in V / θ̇ / position"]
    header += ["one lap later over settled", "return: first lap", "one lap later; worst 5 %"]
    cells = []
    for row in rows:
        error = row["position_rmse"]
        names = ("in_first_lap", "after_one_lap", "return_first_lap", "return_after_one_lap")
        first, later, back, settled = (times(error[name]["value"]) for name in names)
        within = " / ".join(f"{100 * row[m]['recovered_within_one_lap']:.0f} %" for m in COLUMNS)
        later, settled = (
            f"{text}; {times(error[f'{name}_worst'])}" for text, name in ((later, names[1]), (settled, names[3]))
        )
        cells.append([row["case"], row["feedforward"], f"{row['failed']}/{row['runs']}", first, later, within])
        cells[-1] += [times(error["after_one_lap_to_settled"]["value"]), back, settled]
    return pd.DataFrame(cells, columns=header)


def times(ratio: float) -> str:
    """Returns a ratio of errors as text, or – where no run has one."""
    return "–" if np.isnan(ratio) else f"{number(ratio)}×"


def recovered(rows: Sequence[Row]) -> str:
    """Returns a sentence on whose position error is back one lap after the change, in every run."""
    counts: dict[str, int] = {}
    for row in rows:
        whole = row["position_rmse"]["recovered_within_one_lap"] == 1
        counts[row["feedforward"]] = counts.get(row["feedforward"], 0) + whole
    steps = len({row["case"] for row in rows})
    listed = _counted(counts)
    return (
        f"Of {steps} step{'s' * (steps > 1)}, one lap later the position error of every run is back within "
        f"{RECOVERED_RATIO:g} times that before it {'with ' + listed if listed else 'with no feedforward in any'}."
    )


def interval(error: Row) -> str:
    """Returns a mean in thousandths with its interval, with the digits that the floor leaves, or three without a floor.

    Where the ends of the interval would then be the same, they get more digits without a floor; with one, they are
    rounded to the outside. – stands for an end that is infinite, as of a median of few runs.
    """
    if not error["samples"]:
        return "–"
    value, low, high = (1e3 * error[key] for key in ("value", "low", "high"))
    step = _step(error)
    if not high > low:
        return _resolved(value, step)
    if not np.isfinite(high - low):
        ends = (_resolved(end, step) if np.isfinite(end) else "–" for end in (low, high))
        return f"{_resolved(value, step)} [{', '.join(ends)}]"
    if _resolved(low, step) != _resolved(high, step):
        return f"{_resolved(value, step)} [{_resolved(low, step)}, {_resolved(high, step)}]"
    if step:
        outside = step * np.floor(low / step), step * np.ceil(high / step)
        return f"{_resolved(value, step)} [{', '.join(_resolved(end, step) for end in outside)}]"
    digits = next((n for n in range(4, 9) if number(low, n) != number(high, n)), 9)
    return f"{number(value, digits)} [{number(low, digits)}, {number(high, digits)}]"


def _step(error: Row) -> float:
    """Returns the unit of the last digit, in thousandths, that the floor of the means leaves; 0 without a floor.

    The floor has two digits if they are below 36, else one, as the Particle Data Group rounds errors.
    """
    floor = 1e3 * error.get("floor", {}).get("mean", 0.0)
    if not floor > 0:
        return 0.0
    decade = 10.0 ** np.floor(np.log10(floor))
    return decade / 10 if floor < 3.55 * decade else decade


def _resolved(value: float, step: float) -> str:
    """Returns a number with three significant digits, but none beyond `step`; 0 stands for no such bound."""
    if step and np.isfinite(value) and abs(value) < 100 * step:
        return f"{value:.{max(0, -round(np.log10(step)))}f}"
    return number(value)


def column_title(rows: Sequence[Row], metric: str) -> str:
    """Returns the title of the column of a metric, with the floor of the means in the last lap, if it is known."""
    floor = 1e3 * max(row[metric].get("floor", {}).get("mean", 0.0) for row in rows)
    return COLUMNS[metric] + (f" (floor {number(floor, 2)})" if floor else "")


def _window(error: Row, window: str) -> Row:
    return error if window == "last" else error[window]


def _less(row: Row, window: str) -> str:
    """Returns the difference from `model` in mm, or `tie`, or – where no run finished with both."""
    if verdict(row, "model", window=window) == 0:
        return "tie"
    less, sign = 1e3 * _window(row["position_rmse"], window)["less_model"], verdict(row, "model", window=window)
    other = f" ({'more' if sign > 0 else 'less'} in most runs)" if sign * less < 0 else ""
    return _signed(less) + other if np.isfinite(less) else "–"


def _signed(value: float) -> str:
    return ("+" if value > 0 else "") + number(value, 3 if abs(value) >= 10 else 2)


def _mean(error: Row) -> str:
    return f"{interval(error)}; {_resolved(1e3 * error['worst'], _step(error))}" if error["samples"] else "–"


def _acted(row: Row) -> str:
    return number(row["guard_events"]) if np.isfinite(row["guard_events"]) else "–"


def _converged(row: Row) -> str:
    laps = [row[metric]["laps_to_converge"] for metric in COLUMNS]
    return " / ".join(f"{one['value']:.1f}" if one["samples"] else "–" for one in laps)


def _harm(row: Row) -> tuple[str, str]:
    if "no_worse" not in row["position_rmse"]:
        return "", ""
    shares = [row[metric]["no_worse"] for metric in COLUMNS]
    *_, last = shares
    no_worse = " / ".join(f"{one['value']:.3f}" for one in shares) + f" [{last['low']:.3f}, {last['high']:.3f}]"
    return no_worse, f"{number(last['quantile_99'])}; {last['much']}"


def _wins(row: Row, rival: str) -> str:
    if f"beats_{rival}" not in row["position_rmse"]:
        return ""
    values = [row[metric][f"beats_{rival}"] for metric in COLUMNS]
    last = values[-1]
    return " / ".join(f"{one['value']:.2f}" for one in values) + f" [{last['low']:.2f}, {last['high']:.2f}]"
