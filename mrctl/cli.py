"""The commands."""

from __future__ import annotations

import contextlib
import io
import json as jsonlib
import re
import sys
from collections.abc import Callable, Sequence
from functools import partial, wraps
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from mrctl.record import InputError
from mrctl.scenario import FEEDFORWARDS, FeedforwardName, Scenario
from mrctl.theory.perturbation import PERTURBATIONS, Perturbation
from mrctl.theory.robot import CAR, RobotFile


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one command.

    Args:
        arguments: The command line without the program's name; `sys.argv` by default.

    Returns:
        0 on success, 2 on bad input, with one line on stderr that names the field or file; 1 if a sweep ends with
        jobs set aside, a run of it does not repeat, or a robot fails a check; 130 on Ctrl-C.
    """
    arguments = list(sys.argv[1:] if arguments is None else arguments) or ["--help"]
    try:
        _parse(arguments)
    except InputError as error:
        print(f"mrctl: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt as stop:
        print(": ".join(["mrctl: interrupted", *map(str, stop.args)]), file=sys.stderr)
        return 130
    except _Incomplete as left:
        print(f"mrctl: {left}", file=sys.stderr)
        return 1
    return 0


class _Incomplete(Exception):
    """Done, but not all of it, or not as it should have come out."""


def _parse(arguments: list[str]) -> None:
    """Lets tyro turn flags into a call of one of the commands below, its complaints into one line."""
    commands: dict[str, Callable[..., Any]] = {
        "run": _run_with(arguments),
        "reproduce": reproduce,
        "sweep": sweep,
        "suite": suite,
        "tune": tune,
        "identify": identify,
        "train": train,
        "check": check,
        "bench": bench,
        "view": view,
        "export": export,
    }
    complaints = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaints):
            command = tyro.extras.subcommand_cli_from_dict(
                {name: _deferred(function) for name, function in commands.items()},
                prog="mrctl",
                description="A physics testbed for adaptive control of a car-like robot.",
                args=arguments,
            )
    except SystemExit as stop:
        if not stop.code:
            raise
        raise InputError(_one_line(complaints.getvalue())) from None
    command()


def _deferred(function: Callable[..., Any]) -> Callable[..., Callable[[], Any]]:
    """The function with its call put off, so that only parsing happens while stderr is caught."""

    @wraps(function)
    def inner(*args: object, **kwargs: object) -> Callable[[], Any]:
        return partial(function, *args, **kwargs)

    return inner


def _one_line(box: str) -> str:
    """The message in one of tyro's boxes, in Unicode or ASCII; pydantic's own as `field: what is wrong`."""
    titled = "╭" not in box  # without box characters the title is a part of its own
    lines = [line.strip("│| ") for line in box.splitlines() if not line.startswith(("╭", "╰", "+"))]
    parts = re.split(r"(?:^|\n)[-─]{8,}(?:\n|$)", "\n".join(lines).strip())
    parts = [" ".join(part.split()) for part in parts if part.strip()]
    text = parts[min(titled, len(parts) - 1)] if parts else "bad arguments"
    pattern = r"Error parsing (\S*): \d+ validation errors? for \w+ (?:([\w.]+) (?=[A-Z]))?(.*?) \[type="
    if not (found := re.match(pattern, text)):
        return text
    path = [part for part in found[1].split(".") if part not in ("__tyro-dummy-inner__", "scenario", "")]
    field = ".".join([*path, *([found[2]] if found[2] else [])])
    return ": ".join(part for part in (field, found[3].removeprefix("Value error, ")) if part)


def _run_with(arguments: list[str]) -> Callable[..., None]:
    """The `run` command, whose flags take their defaults from the scenario file, if one is given."""
    file = next((a for a in arguments[1:] if a.endswith(".toml")), None) if arguments[0] == "run" else None
    default = Scenario.from_toml(file) if file else Scenario()

    def run(
        file: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="SCENARIO.toml|STORE")] = None,
        /,
        scenario: Annotated[Scenario, tyro.conf.arg(name="")] = default,
        out: Path | None = None,
        json: bool = False,
        controller: str | None = None,
        number: Annotated[int | None, tyro.conf.arg(name="run")] = None,
    ) -> None:
        """Runs one scenario and prints its metrics lap by lap.

        Args:
            file: Scenario file; flags override what it says. Or the store of a sweep, with --run.
            scenario: The scenario.
            out: Folder for the result, the figures and the learned weights.
            json: Print JSON.
            controller: Stages of your own, as my_file.py:MyFeedforward, or motion=my_file.py:MyMotion,feedback=...
            number: Run of the sweep to run again and to compare with the store.
        """
        if number is not None:
            return _repeat(file, number, out, json)
        if file is not None and file.is_dir():
            raise InputError(f"run: which one of {file}? give its number with --run")
        from mrctl.experiments import single

        print(single.run(scenario, out, json, controller))

    return run


def _repeat(store: Path | None, number: int, out: Path | None, json: bool) -> None:
    """`mrctl run STORE --run K`."""
    from mrctl.experiments import single
    from mrctl.sweep import jobs
    from mrctl.sweep.store import Store

    if store is None:
        raise InputError("run: needs the store of a sweep in front of it")
    if out is not None or json:
        print(single.run(jobs.scenario_of(store, number), out, json, Store(store).manifest["sweep"]["controller"]))
    repeated = jobs.repeat(store, number)
    verdict = f"run {number}: {repeated.verdict}"
    if not repeated.same:
        raise _Incomplete(verdict)
    print(verdict, file=sys.stderr if json else sys.stdout)


def sweep(
    file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SWEEP.toml")],
    /,
    out: Path,
    workers: int | None = None,
    scheduler: str | None = None,
) -> None:
    """Runs the many runs of a sweep file; the same command again goes on where it stopped.

    Args:
        file: Sweep file.
        out: Folder of the store, which `mrctl.open` opens.
        workers: Processes on this machine; by default one a core.
        scheduler: Address of a Dask scheduler to use instead, such as tcp://127.0.0.1:8786.
    """
    from mrctl.sweep import jobs
    from mrctl.sweep.plan import Sweep

    report = jobs.run(Sweep.from_toml(file), out, workers, scheduler, progress=True)
    print(f"{report.runs} runs, {report.failed} failed; table: {out / 'runs.parquet'}")
    if report.aside:
        lost = "; ".join(f"runs {runs[0]} to {runs[-1]} ({why})" for runs, why in list(report.aside.items())[:5])
        raise _Incomplete(f"{len(report.aside)} jobs set aside: {lost}; the same command tries them again")


def reproduce(out: Path = Path("reproduction")) -> None:
    """Reproduces the paper's figures, Kanayama's table and the comparison of PID with the neural feedforward.

    Args:
        out: Folder for figures (PNG and PDF) and `table.json` with every number.
    """
    from mrctl.experiments import paper

    print(paper.reproduce(out))


def suite(
    feedforward: tuple[FeedforwardName, ...] = FEEDFORWARDS,
    controller: tuple[str, ...] = (),
    seeds: int | None = None,
    random: int | None = None,
    quick: bool = False,
    workers: int | None = None,
    out: Path = Path("suite"),
) -> None:
    """Drives every feedforward through every uncertainty, with paired seeds; the same command goes on where it stopped.

    Args:
        feedforward: Which to compare.
        controller: Controllers of your own beside them, as my_file.py:MyFeedforward or motion=my_file.py:MyMotion.
        seeds: Runs of each case; by default 10, 3 if quick.
        random: Random scenarios; by default 300, 20 if quick.
        quick: A selection of cases with fewer laps: two minutes instead of half an hour.
        workers: Processes on this machine; by default one a core.
        out: Folder for report.html, the tables as Markdown and JSON, the figures and the runs.
    """
    from mrctl.experiments import suite as uncertainty

    usual = (3, 20) if quick else (10, 300)
    runs = (usual[0] if seeds is None else seeds), (usual[1] if random is None else random)
    found = uncertainty.suite(feedforward, controller, *runs, quick, workers, out)
    print(f"{(out / 'table.md').read_text()}\nReport: {out / 'report.html'}")
    if found.aside:
        raise _Incomplete(f"{found.aside}; the same command tries them again")


def tune(
    world: str = "flat",
    time_constant: float = 0.15,
    delay: tuple[float, ...] = (0.0, 0.02, 0.04),
    out: Path | None = None,
    json: bool = False,
) -> None:
    """Designs the velocity PID from equation (3), measures its loops on the physics, and says where learning is safe.

    Args:
        world: World or MJCF file with the robot.
        time_constant: Closed-loop time constant in s.
        delay: Loop delays in s beside the hold, whole control periods.
        out: Folder for the table, the measured responses and a figure of them.
        json: Print JSON.
    """
    from mrctl.experiments import tuning

    print(tuning.tune(world, time_constant, delay, out, json))


def identify(
    world: str = "flat",
    robot: RobotFile = CAR,
    perturbation: Perturbation = PERTURBATIONS["sensor noise"],
    seed: int = 0,
    json: bool = False,
) -> None:
    """Identifies the constants of equation (3) from two drives, with intervals, beside those of the model.

    Args:
        world: Level world to drive in.
        robot: Whose constants.
        perturbation: How the plant differs from its model, and the noise of its sensors.
        seed: Of signals and noise.
        json: Print JSON.
    """
    from mrctl.experiments import identify as identification

    print(identification.run(world, robot, perturbation, seed, json))


def train(out: Path = Path("composite.safetensors"), plants: int = 120, seed: int = 0) -> None:
    """Trains the features of `composite` and their prior on randomised plants; under five minutes.

    A run takes the file with --composite.weights; without, it takes the one that ships with the package.

    Args:
        out: File for the weights.
        plants: Randomised plants; a third as many more are held out.
        seed: Of plants, references and initial network.
    """
    from mrctl.experiments import train as training

    print(training.train(out, plants, seed))


def check(
    robot: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="ROBOT.xml")] = "flat",
    /,
    wheels: tuple[str, ...] = (),
    steering: tuple[str, ...] = (),
    chassis: str = "",
    json: bool = False,
) -> None:
    """Runs the physics checks on a robot and says what in its model is the likely cause of a failure; under a minute.

    Exit status 1 if a check fails.

    Args:
        robot: MJCF file of a robot, with a level floor or without; by default the shipped one.
        wheels: Joints of the driven wheels, left and right; by default the two with a <dcmotor>.
        steering: Joints of what is steered; by default the upright ones with an actuator.
        chassis: Body that carries them; by default the root.
        json: Print JSON.
    """
    from mrctl.checks import command as checking

    text, verdict = checking.run(robot, wheels, steering, chassis, json)
    print(text)
    if verdict:
        raise _Incomplete(f"{robot}: {verdict}")


def bench(json: bool = False) -> None:
    """Measures the closed loop with on-line learning beside the engine's own speed on this machine; under two minutes.

    Args:
        json: Print JSON.
    """
    from mrctl.experiments import bench as benchmark

    figures = benchmark.run()
    print(jsonlib.dumps(figures, indent=2, ensure_ascii=False) if json else benchmark.text(figures))


def view(
    file: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="SCENARIO.toml|RESULT")] = None,
    /,
    compare: tuple[FeedforwardName, ...] = (),
    number: Annotated[int | None, tyro.conf.arg(name="run")] = None,
    export: Path | None = None,
    host: str = "127.0.0.1",
    port: int = 8080,
) -> None:
    """Shows robots in the browser: a live session of a scenario, or the replay of a result or sweep.

    Args:
        file: Scenario file, or what `mrctl run --out` or `mrctl sweep` wrote; by default the default scenario, live.
        compare: Feedforwards that drive ghosts beside the scenario's own, with the same seed and events.
        number: Run of a result or sweep to begin with.
        export: Writes one HTML file that plays by itself, instead of serving a page.
        host: Address to listen on; other than 127.0.0.1 lets others in, without asking them who they are.
        port: Port to listen on.
    """
    from mrctl.viewer.view import view as show

    show(file, compare, number, export, host, port)


def export(
    file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RESULT")],
    /,
    to: Literal["mcap", "csv", "parquet", "npz"],
    out: Path,
    number: Annotated[int | None, tyro.conf.arg(name="run")] = None,
) -> None:
    """Writes a result for other tools: ROS 2 messages, a table, or NumPy arrays.

    Args:
        file: What `mrctl run --out` or `mrctl sweep` wrote.
        to: Format.
        out: File to write.
        number: One run; by default all, numbered in a column or before each topic.
    """
    from mrctl.results import export as exporting
    from mrctl.sweep import store

    count = exporting.export(store.open(file), to, out, number)
    print(f"{out}: {count} {'run' if count == 1 else 'runs'}")


if __name__ == "__main__":
    sys.exit(main())
