"""The commands of `mrctl`; tyro derives their flags from the functions below and from the records that these take.

The docstring of a field or argument is the help text of its flag.
"""

from __future__ import annotations

import ast
import contextlib
import inspect
import io
import json as jsonlib
import logging
import math
import os
import re
import sys
import textwrap
import typing
import warnings
from collections.abc import Callable, Sequence
from functools import partial, wraps
from pathlib import Path
from typing import Annotated, Any, Literal

import pydantic
import tyro

from mrctl import __version__
from mrctl.record import InputError, Record, nearest, printable, reading
from mrctl.scenario import COMPARED, FEEDFORWARDS, FeedforwardName, Scenario
from mrctl.sensing.tiers import LAB, TIERS, Sensing, Tier
from mrctl.theory.perturbation import PERTURBATIONS, Perturbation
from mrctl.theory.robot import CAR, RobotFile

FIRST = ("name", "world", "steering", "reference", "laps", "prior", "learner", "seed")
"""Fields of `Scenario` that `mrctl run --help` explains; it lists the others, which `mrctl run --help-all` explains."""

FROM_FILES = ("events", "obstacles", "map")
"""Fields of `Scenario` that have no flags, because they come from a scenario file."""
NOT_OF_MISSIONS = (*FROM_FILES, "reference", "laps", "initial_pose", "goal")
"""Fields of `Scenario` without flags in `mrctl navigate`: they come from files, or the mission sets them."""

WITH_RECORDS = "run", "navigate", "identify", "view"
"""Commands whose short help leaves out most of the flags of a record."""

IDENTIFIED = ("perturbation", "robot", "sensing")
"""Arguments of `mrctl identify` that are records; its short help lists them, as that of `run` does with its fields."""

BEST: FeedforwardName = "model+composite"
"""Feedforward that is best, or level with the best, in more cases of the suite than any other (31 of 34).

`navigate` drives with it, and `view` shows it beside PID alone.
"""

TQDM_WITHOUT_TERMINAL = {"MININTERVAL": "60", "MAXINTERVAL": "60", "BAR_FORMAT": "{l_bar}{bar}{r_bar}\n"}
"""tqdm settings for output that is no terminal: one line a minute."""

SHORT = {"--robot": "--robot.path", "--localise": "--sensing.localisation"}
"""Flags that stand for longer ones."""
POSES = "--goal", "--start", "--initial-pose"
"""Flags whose values may be written as x,y,θ."""

DELAYS = 0.0, 0.01, 0.02  # s


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one command.

    Args:
        arguments: The command line without the program's name; `sys.argv` by default.

    Returns:
        The exit status: 0 on success; 1 if a single run fails, a robot does not arrive or fails a check, jobs of a
        sweep were set aside, or a repeated run differs from its store; 2 on bad input; 130 after Ctrl-C. Except on
        success, one line on stderr says why.
    """
    arguments = list(sys.argv[1:] if arguments is None else arguments) or ["--help"]
    if arguments == ["--version"]:
        print(f"mrctl {__version__}")
        return 0
    if not sys.stderr.isatty():
        for name, value in TQDM_WITHOUT_TERMINAL.items():
            os.environ.setdefault(f"TQDM_{name}", value)  # which tqdm reads when it is imported
    if isinstance(sys.stdout, io.TextIOWrapper):  # a file may have a name that is not UTF-8
        sys.stdout.reconfigure(errors="replace")
    warnings.showwarning = _once()
    try:
        try:
            command = _parse(_expanded(arguments))
            for name in ("absl", "asyncio"):  # of failing runs and damaged files, whose own message says why
                logging.getLogger(name).addFilter(lambda _: False)
            try:
                command()
            except SystemExit as stop:
                raise _Incomplete(f"the user's code called sys.exit({stop.code})") from None
        finally:
            sys.stdout.flush()
    except BrokenPipeError:  # the reader of a pipe, such as `head`, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except InputError as error:
        print(f"mrctl: {printable(str(error))}", file=sys.stderr)
        return 2
    except OSError as error:
        text = f"{error.filename}: {error.strerror}" if error.filename else str(error)
        print(f"mrctl: {printable(text)}", file=sys.stderr)
        return 2
    except KeyboardInterrupt as stop:
        print(": ".join(["mrctl: interrupted", *map(str, stop.args)]), file=sys.stderr)
        return 130
    except _Incomplete as error:
        print(f"mrctl: {printable(str(error))}", file=sys.stderr)
        return 1
    return 0


def _once() -> Callable[..., None]:
    """Returns a function that prints the text of a warning in one line, and every text only once."""
    said = set[str]()

    def show(message: Warning | str, *_: object) -> None:
        text = printable(str(message))
        if text not in said:
            said.add(text)
            print(f"mrctl: {text}", file=sys.stderr)

    return show


def _check_world(world: str, robot: RobotFile = CAR) -> None:
    """Refuses a world or a robot without a file that can be read, before physics is imported, which takes seconds."""
    from mrctl.physics.files import robot_path, world_path

    world_path(world)
    if robot != CAR:
        robot_path(robot)


def _warn_if_impossible(scenario: Scenario) -> None:
    """Says on stderr before a run if no robot could have a number of its file; mrctl's own robots need no check."""
    from mrctl.physics.files import SHIPPED

    file = scenario.robot.path if scenario.robot != CAR else scenario.world
    if file in SHIPPED or not file.endswith(".xml"):
        return
    from mrctl.checks.examination import impossible
    from mrctl.loop.simulation import arranged
    from mrctl.physics.mjcf import load

    scenario = arranged(scenario)
    for cause in impossible(load(scenario.world, scenario.steering, robot=scenario.robot)):
        print(f"mrctl: {printable(f'{file}: {cause.cause}: {cause.text}; see mrctl check {file}')}", file=sys.stderr)


def _check_exists(file: Path) -> None:
    """Refuses a file or folder that does not exist, before what reads it is imported."""
    with reading(file):
        if not file.exists():
            raise InputError(f"{file}: no such file or folder")


def _check_workers(workers: int | None) -> None:
    """Refuses a number of processes below 1."""
    if workers is not None and workers < 1:
        raise InputError(f"workers: {workers} is below 1")


class _Incomplete(Exception):
    """A command has ended, but a part of its work failed; the message says which part."""


def _expanded(arguments: list[str]) -> list[str]:
    """Expands short flags into full ones.

    `--perturbation NAME` becomes the flags of that perturbation, which later flags override, a flag of `SHORT` the
    longer one, and a pose x,y,θ three numbers.

    Raises:
        InputError: There is no perturbation of that name, a short flag has no value, or a pose has not three numbers.
    """
    found: list[str] = []
    rest = iter(arguments)
    for argument in rest:
        flag, given, value = argument.partition("=")
        if flag == "--perturbation":
            if not (name := value if given else next(rest, "")) or name.startswith("--"):
                raise InputError(
                    "perturbation: needs a name, such as all, or a flag such as --perturbation.mass-factor"
                )
            perturbation = Perturbation.from_dict(name, "perturbation")
            for field, changed in perturbation.model_dump(exclude_defaults=True).items():
                found += [f"--perturbation.{field.replace('_', '-')}", str(changed)]
        elif flag in SHORT:
            if not (name := value if given else next(rest, "")) or name.startswith("--"):
                raise InputError(f"{flag.removeprefix('--')}: needs a value; see mrctl {arguments[0]} --help")
            found += [SHORT[flag], name]
        elif given and flag in POSES:
            found += [flag, *_pose(flag, value)]
        else:
            in_pose = "," in argument and found[-1:] and found[-1] in POSES
            found += _pose(found[-1], argument) if in_pose else [argument]
    return found


def _pose(flag: str, text: str) -> list[str]:
    """Splits a pose that is written as x,y,θ.

    Raises:
        InputError: There are not three numbers.
    """
    parts = text.split(",")
    try:
        if len(parts) != 3 or not all(math.isfinite(float(part)) for part in parts):
            raise ValueError
    except ValueError:
        name = flag.removeprefix("--")
        raise InputError(f"{name}: {text} is not x, y and θ in m, m, rad, as in --{name} 2,0,0") from None
    return parts


def _parse(arguments: list[str]) -> Callable[[], Any]:
    """Turns the command line into a call of one of the commands below.

    Raises:
        InputError: An argument is invalid.
        SystemExit: Help was asked for and has been printed.
    """
    commands: dict[str, Callable[..., Any]] = {
        "run": _run_with(arguments),
        "navigate": _navigate_with(arguments),
        "reproduce": reproduce,
        "sweep": sweep,
        "suite": suite,
        "tune": tune,
        "identify": _identify_with(arguments),
        "check": check,
        "bench": bench,
        "view": _view_with(arguments),
        "record": record,
        "export": export,
    }
    if not arguments[0].startswith("-") and arguments[0] not in commands:
        raise InputError(f"no command is called {arguments[0]!r}; there are {', '.join(commands)}")
    complaints = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaints):
            return tyro.extras.subcommand_cli_from_dict(
                {name: _deferred(function) for name, function in commands.items()},
                prog="mrctl",
                description="A physics testbed for adaptive control of a car-like robot. "
                "mrctl COMMAND --help explains a command, mrctl --version prints the version.",
                args=["--help" if argument == "--help-all" else argument for argument in arguments],
            )
    except SystemExit as stop:
        if stop.code:
            _refuse_known(arguments)
            raise InputError(_one_line(complaints.getvalue(), arguments[0])) from None
        if _is_short_help(arguments):
            print(_further_flags(arguments[0]))
        raise


def _refuse_known(arguments: Sequence[str]) -> None:
    """Refuses flags of a scenario's fields that have none, or that had one in an earlier version.

    Raises:
        InputError: There is such a flag; the message says what to do in its place.
    """
    if arguments[0] not in WITH_RECORDS:
        return
    for flag in arguments:
        if flag.startswith("--"):
            name = flag[2:].partition("=")[0].replace("-", "_")
            Scenario.refuse_moved(name)
            if name in FROM_FILES:
                raise InputError(f"{name}: has no flag; set it in a scenario file, as for mrctl run scenario.toml")
            if arguments[0] == "navigate" and name in NOT_OF_MISSIONS and name != "goal":  # it has its own --goal
                raise InputError(f"{name}: has no flag here, because the mission sets it")


def _deferred(function: Callable[..., Any]) -> Callable[..., Callable[[], Any]]:
    """Wraps a command so that tyro, while stderr is captured, only binds its arguments; the result then runs it."""
    # Where a line of the docstring ends within the text of an argument, tyro would begin a new one.
    function.__doc__ = re.sub(r"\n {8,}(?=\S)", " ", inspect.cleandoc(function.__doc__ or ""))

    @wraps(function)
    def inner(*args: object, **kwargs: object) -> Callable[[], Any]:
        return partial(function, *args, **kwargs)

    return inner


def _one_line(box: str, command: str) -> str:
    """Returns the message in one of tyro's boxes, about a command, as one line.

    The box is drawn in Unicode or ASCII. The message of a record that is a part of a scenario gets the whole path.
    """
    titled = "╭" not in box  # without box characters the title is a part of its own
    lines = [line.strip("│| ") for line in box.splitlines() if not line.startswith(("╭", "╰", "+"))]
    parts = re.split(r"(?:^|\n)[-─]{8,}(?:\n|$)", "\n".join(lines).strip())
    parts = [" ".join(part.split()) for part in parts if part.strip()]
    text = re.sub(r"\[/?bold\]", "", parts[min(titled, len(parts) - 1)]) if parts else "bad arguments"
    if match := re.match(r"Error parsing -*([\w.-]+): no type matching (.*?) could be instantiated", text):
        return f"{match[1]}: expected {re.sub('[{}]', '', match[2]).replace('|', ' or ')}"
    if match := re.match(r"Error parsing -*([\w.-]+): invalid literal for int\(\) with base 10: (.*)", text):
        return f"{match[1]}: {match[2]} is not a whole number"
    if match := re.match(r"invalid choice (.+) for argument '-*([\w.-]+)'. Expected one of (\(.*\))", text):
        choices = sorted(set(ast.literal_eval(match[3])) - {"None"})  # that of an optional flag which nobody gives
        return f"{match[2]}: {match[1]} is none of {', '.join(choices)}"
    if match := re.match(r"Unrecognized options: (-[^\s,=]+)", text):
        flag, similar = "", []
        for line in lines:
            flag = line.split()[0] if line.startswith("--") else flag
            if line.startswith(f"in mrctl {command} "):
                similar.append(flag)
        meant = nearest(match[1], similar)
        return f"no flag is called {match[1]}" + (f"; did you mean {meant}?" if meant else "")
    if match := re.match(r"Unrecognized or misplaced options: (\S+) \(applied to mrctl (\S+)( \S+)?\)", text):
        if match[3]:
            return f"{match[1]}: is no flag of{match[3]}, and those of mrctl {match[2]} stand before it"
        return f"{match[1]}: is no flag of mrctl {match[2]}"
    if match := re.match(r"Unrecognized options: (\S+\.xml)", text):
        return f"{match[1]}: the file of a robot is given as --robot {match[1]}"
    if not (match := re.match(r"Error parsing (\S+): (.*)", text)):
        return text
    parts = match[1].removeprefix("--").split(".")
    path = ".".join(part for part in parts if part not in ("__tyro-dummy-inner__", "scenario"))
    joint = "." if re.match(r"[\w.]+: ", match[2]) else ": "  # that of a record begins with the field
    return f"{path}{joint}{match[2]}" if path else match[2]


def _is_short_help(arguments: Sequence[str]) -> bool:
    """Tells whether a command line asks for the short help of a command; the help of a reference is always short."""
    asked = bool({"-h", "--help"} & set(arguments))
    return (
        arguments[0] in WITH_RECORDS and asked and not any(argument.startswith("reference:") for argument in arguments)
    )


def _explained(arguments: Sequence[str]) -> Sequence[str]:
    """Returns the fields of a scenario to explain: some for --help, all with flags for --help-all, else none."""
    if _is_short_help(arguments):
        return FIRST
    asked = {"--help", "--help-all", "-h"} & set(arguments)
    return [name for name in Scenario.model_fields if name not in FROM_FILES] if asked else ()


def _fields_set(arguments: Sequence[str]) -> set[str]:
    """Returns the fields that a command line sets; of nested ones the outermost, such as `robot` for --robot.path."""
    flags = [argument for argument in arguments[1:] if argument.startswith(("--", "reference:"))]
    return {re.split("[.:=]", flag.removeprefix("--"))[0].replace("_", "-") for flag in flags}


def _suited(scenario: Scenario, arguments: Sequence[str], scenario_file: str | None) -> Scenario:
    """Adapts the reference of a scenario to its robot, if the command line names a robot and no reference."""
    given = _fields_set(arguments)
    if scenario_file or "robot" not in given or "reference" in given:
        return scenario
    from mrctl.loop.simulation import suited

    return suited(scenario)


def _partial_record(scenario: Scenario, names: Sequence[str]) -> Record:
    """Returns a record of some fields of a scenario, from which tyro makes flags."""
    types = typing.get_type_hints(Scenario, include_extras=True)
    helps = {name: field.description for name, field in Scenario.model_fields.items()}
    fields: dict[str, Any] = {
        name: (types[name], pydantic.Field(getattr(scenario, name), description=helps[name])) for name in names
    }
    # The fields have their descriptions; pydantic would search the source of each calling frame for more.
    described = {"use_attribute_docstrings": False}
    return pydantic.create_model("Part", __base__=Record, __cls_kwargs__=described, **fields)()


def _with_fields(command: Callable[..., None], default: Scenario, names: Sequence[str]) -> Callable[..., None]:
    """Returns `run` or `view` with the flags of these fields of the scenario alone, or of all where there are none."""
    if names:
        part = _partial_record(default, names)
        command.__annotations__["scenario"] = Annotated[type(part), tyro.conf.arg(name="")]
        command.__defaults__ = (None, part, *(command.__defaults__ or ())[2:])
    return command


def _further_flags(command: str) -> str:
    """Lists and explains the fields, or groups of fields, whose flags the short help of a command leaves out."""
    if command == "identify":
        left_out = list(IDENTIFIED)
    else:
        never = NOT_OF_MISSIONS if command == "navigate" else FROM_FILES
        left_out = [name for name in Scenario.model_fields if name not in (*FIRST, *never)]
    # Perturbations are what people change most.
    names = sorted(left_out, key=lambda name: name != "perturbation")
    lines = [f"Further flags, which `mrctl {command} --help-all` explains one by one:"]
    for name in names:
        field = Scenario.model_fields[name]
        flag = f"--{name.replace('_', '-')}" + (".*" if isinstance(field.default, Record) else "")
        lines += textwrap.wrap(field.description or "", 80, initial_indent=f"  {flag:<17} ", subsequent_indent=" " * 20)
    if command in ("run", "view"):
        lines.append(f"`mrctl {command} reference:circle --help` lists the flags of a reference, here of a circle.")
    return "\n".join(lines)


def _run_with(arguments: list[str]) -> Callable[..., None]:
    """Returns the `run` command, whose flags take their defaults from the scenario file where one is given."""
    scenario_file = _scenario_file(arguments) if arguments[0] == "run" else None
    default = Scenario.from_toml(scenario_file) if scenario_file else Scenario()

    def run(
        file: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="[SCENARIO.toml|FOLDER]")] = None,
        /,
        scenario: Annotated[Scenario, tyro.conf.arg(name="")] = default,
        out: Path | None = None,
        json: bool = False,
        controller: str | None = None,
        number: Annotated[int | None, tyro.conf.arg(name="run")] = None,
        code: bool = True,
    ) -> None:
        """Runs one scenario and prints its metrics lap by lap.

        The exit status is 1 if the run fails.

        Args:
            file: Run this scenario file, whose values flags override; or the folder --out of a run, which is then run
                again and compared with what it holds, and the exit status is 1 if a bit differs; or with --run a
                sweep's store.
            scenario: The scenario.
            out: Write the result, the figures and the learned weights to this folder.
            json: Print JSON instead of a table.
            controller: Use stages of your own: my_file.py:MyFeedforward or motion=my_file.py:MyMotion,feedback=...
            number: Drive the run of this number in a sweep's store again, and compare it with what is stored.
            code: With --run: whether the Python files of the controller that the sweep names may be run.
        """
        if number is not None:
            return _repeat(file, number, out, json, code)
        if file is not None and file.is_dir():
            return _repeat_saved(file, arguments, out, json, controller)
        if file is not None and str(file) != scenario_file:
            _check_switches(arguments)
            raise InputError(f"run: {file} is not a scenario file, whose name ends in .toml; see mrctl run --help")
        _check_world(scenario.world, scenario.robot)
        from mrctl.kernel import announced_early

        announced_early()
        from mrctl.experiments import single

        scenario = _suited(scenario, arguments, scenario_file)
        _warn_if_impossible(scenario)
        text, failure = single.run(scenario, out, json, controller)
        _report(text, out, json)
        if failure:
            raise _Incomplete(f"the run failed {failure}")

    return _with_fields(run, default, _explained(arguments))


def _navigate_with(arguments: list[str]) -> Callable[..., None]:
    """Returns the `navigate` command, whose short help leaves out the same fields as that of `run`."""
    names = FIRST if _is_short_help(arguments) else Scenario.model_fields
    default = Scenario() if {"prior", "learner"} & _fields_set(arguments) else Scenario(**FEEDFORWARDS[BEST])
    part = _partial_record(default, [name for name in names if name not in NOT_OF_MISSIONS])

    def navigate(
        world: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="[WORLD|GENERATOR:SEED|MISSION]")] = "",
        /,
        scenario: Record = part,
        goal: tuple[float, float, float] | None = None,
        start: tuple[float, float, float] | None = None,
        known: Annotated[str | None, tyro.conf.arg(name="map")] = None,
        compare: Annotated[tuple[FeedforwardName, ...], tyro.conf.arg(metavar="NAME ...")] = (),
        speed: float | None = None,
        margin: float = 0.05,
        avoid: Literal["none", "barrier", "window", "mppi"] = "none",
        out: Path | None = None,
        json: bool = False,
        view: bool = False,
        port: int = 8080,
        suite: bool = False,
        quick: bool = False,
        scheduler: str | None = None,
    ) -> None:
        """Plans a way among obstacles, drives it, and prints how the drive ended.

        The exit status is 1 if the first robot does not arrive. Its controller is that of --prior and --learner, with
        the defaults of `mrctl run` where one of them is given, and model+composite where none is. --robot NAME stands
        for --robot.path NAME, and --localise NAME for --sensing.localisation NAME.

        Args:
            world: TOML file of obstacles, yaml file of a ROS map, world in SDF, or a generator with a seed, such as
                doorway:3; the others are cellular, corridor, parking_bay, slalom and warehouse. Or the folder --out of
                a mission, which is then driven again and compared with what it holds, bit for bit.
            scenario: The scenario.
            goal: Drive to this pose, x and y in m and θ in rad, as in 2 0 0 or 2,0,0; by default to the generator's.
            start: Start at this pose, written as for --goal; by default at that of the generator, or the origin.
            known: Plan and localise on the map in this file, which may differ from the world and has one of the same
                formats; by default the map has all that stands still in the world.
            compare: Feedforwards of further robots, such as none or model, which drive the same plan.
            speed: Limit the plan to this speed in m/s; by default to 0.9 of the robot's largest.
            margin: Keep this clearance in m in the plan.
            avoid: Law that keeps the robot from what its lidar sees beside the map, such as obstacles that move: none,
                a filter that brakes (`barrier`), or a controller that follows the plan at its own pace and drives
                around what is in the way (`window`, `mppi`).
            out: Write the result, the table in JSON and the figures to this folder.
            json: Print JSON instead of a table.
            view: Instead of a table, show the mission live in the browser, where clicks set further goals.
            port: Number of the port to listen on, with --view.
            suite: Instead of one mission, compare how narrow a corridor, and how fast, the robot can drive with PID,
                model, fel and model+composite, on three plants; then drive MPPI around obstacles, with and without a
                lag in its model, over PID and over model+composite; then plan with what model+composite has learned.
                Each part prints first how long it takes. The tables are written to --out, by default navigate_suite,
                where the same command goes on if it was stopped.
            quick: With --suite, drive fewer draws; some confidence intervals then have no upper end.
            scheduler: With --suite, use the workers of the Dask scheduler at this address, such as
                tcp://127.0.0.1:8786, instead of this machine's cores.
        """
        chosen = Scenario().replace(**{name: getattr(scenario, name) for name in type(scenario).model_fields})
        if port != 8080 and not view:
            raise InputError("port: belongs to --view")
        if suite:
            taken = {"prior", "learner", "perturbation", "margin", "seed", "initial-spread"} & _fields_set(arguments)
            if taken or world or goal or start or known or compare or speed or avoid != "none" or json or view:
                raise InputError("suite: has its own worlds, controllers and speeds; give only flags of the robot")
            return _navigate_suite(chosen, quick, out or Path("navigate_suite"), scheduler)
        if quick or scheduler is not None:
            raise InputError(f"{'quick' if quick else 'scheduler'}: belongs to --suite")
        if not world:
            raise InputError("world: none given; see mrctl navigate --help")
        if Path(world).is_dir():
            return _repeat_mission(Path(world), arguments, out, json)
        if view and (out is not None or json):
            raise InputError("view: a live session has no --out and --json")
        if ":" not in world and not Path(world).is_file():
            raise InputError(f"world: no file {world}; mrctl navigate --help names the generators, such as doorway:3")
        _check_world(chosen.world, chosen.robot)
        _warn_if_impossible(chosen)
        from mrctl.navigation.mission import Order, task_of

        task = task_of(world, chosen, start, goal, known)
        order = Order(task=task, scenario=chosen, compare=tuple(compare), speed=speed, margin=margin, avoid=avoid)
        if view:
            from mrctl.viewer import view as viewing

            return viewing.mission(order, "127.0.0.1", port)
        from mrctl.experiments import mission

        text, outcome = mission.run(world, order, out, json)
        _report(text, out, json)
        _expect_arrival(outcome)

    navigate.__annotations__["scenario"] = Annotated[type(part), tyro.conf.arg(name="")]
    return navigate


def _navigate_suite(scenario: Scenario, quick: bool, out: Path, scheduler: str | None) -> None:
    """Drives the suite of navigation: `mrctl navigate --suite`."""
    from mrctl.experiments import navigation_suite

    for tables in navigation_suite.suite(scenario, "quick" if quick else "core", out, scheduler):
        print(tables)


def _scenario_file(arguments: Sequence[str]) -> str | None:
    """Returns the argument of `run` or `view` that is a scenario file: it ends in .toml and is no value of a flag."""
    for previous, argument in zip(arguments, arguments[1:], strict=False):
        is_value = previous.startswith("--") and "=" not in previous and _switch(previous) is None
        if argument.endswith(".toml") and not argument.startswith("-") and not is_value:
            return str(Path(argument))
    return None


def _switch(flag: str) -> str | None:
    """Returns the name of a flag of `run` or `view` that takes no value, such as `guard.on` for --guard.no-on."""
    name = re.sub(r"(^--|\.)no-", r"\1", flag.replace("_", "-")).removeprefix("--")
    return name if flag.startswith("--") and name in {"json", "code", *_switches(Scenario)} else None


def _check_switches(arguments: Sequence[str]) -> None:
    """Refuses a word such as true behind a flag that takes no value."""
    for flag, word in zip(arguments[1:], arguments[2:], strict=False):
        if word.lower() in ("true", "false", "on", "off", "yes", "no", "0", "1") and (name := _switch(flag)):
            *path, last = name.split(".")
            off = ".".join([*path, f"no-{last}"])
            raise InputError(f"{name}: a switch without a value, but {word} follows it; --{name} is on, --{off} off")


def _switches(record: type[Record], prefix: str = "") -> list[str]:
    """Returns the flags of a record that take no value, because they are true or false, such as `guard.on`."""
    found = []
    for name, field in record.model_fields.items():
        flag = prefix + name.replace("_", "-")
        if field.annotation is bool:
            found.append(flag)
        elif isinstance(field.annotation, type) and issubclass(field.annotation, Record):
            found += _switches(field.annotation, f"{flag}.")
    return found


def _report(text: str, out: Path | None, json: bool) -> None:
    """Prints a report, and where its files are; JSON stays alone on stdout."""
    print(text)
    if out is not None:
        print(f"The files are in {out}.", file=sys.stderr if json else sys.stdout)


def _repeat_saved(folder: Path, arguments: Sequence[str], out: Path | None, json: bool, controller: str | None) -> None:
    """Runs a saved run again and compares it with what was saved: `mrctl run FOLDER`."""
    if (folder / "mission.json").exists():
        raise InputError(f"run: {folder} holds a mission, which mrctl navigate {folder} repeats")
    if (folder / "sweep.json").exists():
        raise InputError(f"run: {folder} is the store of a sweep; for one of its runs give its number with --run")
    if new := sorted(_fields_set(arguments) - {"out", "json", "controller"}):
        raise InputError(f"{new[0]}: {folder} holds a run, which is driven as it was; leave --{new[0]} out")
    from mrctl.kernel import announced_early

    announced_early()
    from mrctl.experiments import single

    text, departs = single.repeat(folder, out, json, controller)
    _report(text, out, json)
    _judge(folder, departs, json)


def _repeat_mission(folder: Path, arguments: Sequence[str], out: Path | None, json: bool) -> None:
    """Drives a saved mission again and compares it with what was saved: `mrctl navigate FOLDER`."""
    new = sorted({a.partition("=")[0] for a in arguments if a.startswith("--")} - {"--out", "--json"})
    if new and (folder / "mission.json").exists():
        raise InputError(f"{new[0].removeprefix('--')}: {folder} holds a mission, which is driven as it was")
    from mrctl.experiments import mission

    text, outcome, departs = mission.repeat(folder, out, json)
    _report(text, out, json)
    _judge(folder, departs, json)
    _expect_arrival(outcome)


def _expect_arrival(outcome: str) -> None:
    if outcome != "arrived":
        raise _Incomplete(f"the robot did not arrive: {outcome}")


def _judge(folder: Path, departs: str, json: bool) -> None:
    """Says that a repeated run has the bits of the saved one, or fails the command."""
    if departs:
        raise _Incomplete(f"{folder}: departs in {departs}, from what was saved there")
    print(f"{folder}: bit-identical", file=sys.stderr if json else sys.stdout)


def _repeat(store: Path | None, number: int, out: Path | None, json: bool, code: bool) -> None:
    """Runs one run of a sweep again and compares it with the store: `mrctl run STORE --run K`."""
    if store is None:
        raise InputError("run: --run needs the store of a sweep, as in mrctl run STORE --run 3")
    _check_exists(store)
    from mrctl.experiments import single
    from mrctl.sweep import jobs
    from mrctl.sweep.store import Store

    jobs.stages_of(store, code)
    if out is not None or json:
        own = Store(store).manifest["sweep"].get("controller")
        _report(single.run(jobs.scenario_of(store, number), out, json, own)[0], out, json)
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
    """Computes the runs of a sweep file in parallel; the same command resumes after an interrupt.

    Args:
        file: Run this sweep file, with the scenarios and what varies in them.
        out: Write the store, which `mrctl.open` opens, to this folder.
        workers: Use this number of processes on this machine; by default one for each core.
        scheduler: Use the Dask scheduler at this address instead, such as tcp://127.0.0.1:8786.
    """
    _check_exists(file)
    _check_workers(workers)
    from mrctl.sweep import jobs
    from mrctl.sweep.plan import Sweep

    report = jobs.run(Sweep.from_toml(file), out, workers, scheduler, progress=True)
    print(f"{report.runs} runs, {report.failed} failed; table: {out / 'runs.parquet'}")
    if report.aside:
        lost = "; ".join(f"runs {runs[0]} to {runs[-1]} ({why})" for runs, why in list(report.aside.items())[:5])
        raise _Incomplete(f"{len(report.aside)} jobs set aside: {lost}; the same command tries them again")


def reproduce(out: Path = Path("reproduction")) -> None:
    """Reproduces the paper's figures and tables, and compares the feedforwards in every sensing tier.

    Args:
        out: Write the figures in PNG and PDF, and `table.json` with every number, to this folder.
    """
    from mrctl.experiments import paper

    print(paper.reproduce(out))


def suite(
    feedforward: Annotated[
        tuple[FeedforwardName | Literal["hindsight"], ...] | None, tyro.conf.arg(metavar="NAME ...")
    ] = None,
    controller: tuple[str, ...] = (),
    seeds: int | None = None,
    random: int | None = None,
    quick: bool = False,
    full: bool = False,
    held_out: str | None = None,
    workers: int | None = None,
    out: Path | None = None,
) -> None:
    """Compares feedforwards under uncertainty, with the same draws; the same command resumes after an interrupt.

    It prints how long it will take before it starts: by default less than half an hour on two cores.

    Args:
        feedforward: Feedforwards to compare, such as fel or model+composite; hindsight is the best fixed one for each
            run, either model or coefficients fitted to that run afterwards. By default those in the tables of
            RESULTS.md, with --full all.
        controller: Controllers of your own to compare, such as my_file.py:MyFeedforward, the same behind the nominal
            model as model+my_file.py:MyFeedforward, or motion=my_file.py:MyMotion.
        seeds: Number of replicates of each case; by default 20, or 3 with --quick.
        random: Number of random scenarios; by default 30, with --quick 6, with --full 1,000 in each tier.
        quick: Run a few cases with few laps, in two minutes; the tables support no claim.
        full: Run all cases, in every tier, in hours.
        held_out: Instead, drive this one feedforward, or one of your own as for --controller, through 40 cells that no
            setting was chosen on, beside model, true_model and model+observer.
        workers: Number of processes on this machine; by default one for each core.
        out: Folder for report.html, the tables in Markdown and JSON, the figures and the runs; by default suite,
            suite_quick, suite_full or held_out.
    """
    _check_workers(workers)
    if seeds is not None and seeds < 1:
        raise InputError("seeds: the suite needs at least one run of at least one feedforward")
    if random is not None and random < 0:
        raise InputError(f"random: {random} is below 0")
    if quick + full + (held_out is not None) > 1:
        raise InputError("quick: give one of --quick, --full and --held-out")
    if held_out is not None:
        if feedforward or controller or random is not None:
            raise InputError("held_out: names the one feedforward to judge; give no other, and no random scenarios")
        return _judge_held_out(held_out, seeds, workers, out or Path("held_out"))
    from mrctl.experiments import suite as uncertainty
    from mrctl.experiments.cases import HINDSIGHT, RANDOM, REPLICATES, Mode

    mode: Mode = "quick" if quick else "full" if full else "core"
    folder = out or Path("suite" if mode == "core" else f"suite_{mode}")
    every = (*(FEEDFORWARDS if full else COMPARED), HINDSIGHT)
    counts = (REPLICATES[mode] if seeds is None else seeds), (RANDOM[mode] if random is None else random)
    compared = every if feedforward is None else feedforward
    aside = uncertainty.suite(mode, compared, controller, *counts, workers, folder).aside
    print(f"{(folder / 'table.md').read_text()}\nReport: {folder / 'report.html'}")
    _expect_all(aside)


def _judge_held_out(feedforward: str, seeds: int | None, workers: int | None, folder: Path) -> None:
    """Drives a feedforward through cells that no setting was chosen on: `mrctl suite --held-out FEEDFORWARD`."""
    from mrctl.experiments import held_out
    from mrctl.experiments.cases import REPLICATES

    aside = held_out.judge(feedforward, REPLICATES["core"] if seeds is None else seeds, workers, folder)
    print((folder / "table.md").read_text())
    _expect_all(aside)


def _expect_all(aside: str) -> None:
    """Fails the command if runs were set aside; the text says which."""
    if aside:
        raise _Incomplete(f"{aside}; the same command tries them again")


def tune(
    robot: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="[ROBOT.xml]")] = CAR.path,
    /,
    wheels: tuple[str, ...] = (),
    steering: tuple[str, ...] = (),
    chassis: str = "",
    world: str = "flat",
    delay: tuple[float, ...] = DELAYS,
    lag: float = 0.0,
    time_constant: float | None = None,
    search: str | None = None,
    tier: tuple[Tier, ...] = TIERS,
    out: Path | None = None,
    json: bool = False,
) -> None:
    """Designs the velocity PID and the motion controller, measures the loops, and says where learning is safe.

    With --search, finds settings of a feedforward instead, by driving; the same command resumes after an interrupt.

    Args:
        robot: Robot to design for: `car`, `turtlebot`, `racecar`, or an MJCF file.
        wheels: Joints of the two driven wheels, left and right; by default the two with a <dcmotor>.
        steering: Joints of the steered wheels, at most two; by default the upright joints with an actuator.
        chassis: Body that carries the wheels; by default the one at their root.
        world: World to measure in: `flat`, `slope`, `rough`, `patch`, or the path of an MJCF file.
        delay: Delays of the loop in s in addition to sample and hold, each a multiple of the control period.
        lag: Time constant in s by which, as the design assumes, the measured velocities lag behind the true ones.
        time_constant: Time constant of the closed loop in s, for the IMC rule in place of the design.
        search: Feedforward whose settings to search, such as model+rls; none for the PID; or one of your own, such as
            my_file.py:MyController, whose class has an attribute such as search = {"gain": (0.01, 1.0)}.
        tier: With --search: sensing tiers to search in, each separately.
        out: Folder for the table, the measured responses and their figure; with --search for the table and the runs, by
            default a folder in search.
        json: Print JSON instead of a table.
    """
    if search is not None:
        given = robot, wheels, steering, chassis, world, delay, lag, time_constant
        if given != (CAR.path, (), (), "", "flat", DELAYS, 0.0, None):
            raise InputError(
                "search: drives the default car in worlds of its own; the flags of the design do not apply"
            )
        from mrctl.experiments.search import search as find

        print(find(search, tier, out, json))
        return
    if tier != TIERS:
        raise InputError("tier: is of --search; the design takes its delays from --delay")
    _check_world(world, RobotFile.from_dict({"path": robot}, "robot"))
    from mrctl.experiments import tuning
    from mrctl.physics.mjcf import load_robot

    file = (
        CAR
        if (robot, wheels, steering, chassis) == (CAR.path, (), (), "")
        else load_robot(robot, wheels, steering, chassis)
    )
    _report(tuning.tune(file, world, time_constant, delay, lag, out, json), out, json)


def _identify_with(arguments: list[str]) -> Callable[..., None]:
    """Returns the `identify` command, whose short help leaves out the flags of its records."""

    def identify(
        file: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="[ROBOT.xml]")] = CAR.path,
        /,
        world: str = "flat",
        robot: RobotFile = CAR,
        perturbation: Perturbation = PERTURBATIONS["nominal"],
        sensing: Sensing = LAB,
        seed: int = 0,
        json: bool = False,
    ) -> None:
        """Identifies the constants of equation (3) from two drives, and says which of them the sensors identify.

        Args:
            file: The car, turtlebot or racecar, or the MJCF file of a robot; car stands for the robot of --world.
            world: The robot drives in this level world: `flat`, or the MJCF file at this path.
            robot: File of the robot, in place of ROBOT.xml, with the names of its joints and its chassis.
            perturbation: Differences of the plant from its model.
            sensing: Encoders, gyro and motor driver; delays, accelerometer, fixes and the estimator have no effect.
            seed: This seed determines the test signals and the noise of the sensors.
            json: Print JSON instead of a table.
        """
        if file != CAR.path:
            if robot != CAR:
                raise InputError("robot: give either a file or --robot")
            robot = RobotFile.from_dict({"path": file}, "robot")
        _check_world(world, robot)
        from mrctl.experiments import identify as identification

        print(identification.run(world, robot, perturbation, sensing, seed, json))

    if _is_short_help(arguments):
        for name in IDENTIFIED:
            identify.__annotations__[name] = Annotated[Record, tyro.conf.Suppress]
    return identify


def check(
    robot: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="[ROBOT.xml]")] = "flat",
    /,
    wheels: tuple[str, ...] = (),
    steering: tuple[str, ...] = (),
    chassis: str = "",
    json: bool = False,
) -> None:
    """Runs the physics checks on a robot in at most 30 s, and names the likely cause of a failure in its model.

    The exit status is 1 if a check fails.

    Args:
        robot: The car, turtlebot or racecar, or the MJCF file of a robot, with or without a floor; by default the car.
        wheels: Joints of the two driven wheels, left and right; by default the two with a <dcmotor>.
        steering: Joints of the steered wheels, at most two; by default the upright joints with an actuator.
        chassis: Body that carries the wheels; by default the one at their root.
        json: Print JSON instead of a table.
    """
    from mrctl.physics.files import SHIPPED, find

    if not robot.endswith(".xml") and robot not in SHIPPED and not find(robot).is_file():
        raise InputError(f"robot: {robot} is neither {', '.join(SHIPPED)} nor an MJCF file, which ends in .xml")
    if robot.endswith(".xml") and not find(robot).is_file():
        raise InputError(f"robot: no file {robot}; there are {', '.join(SHIPPED)}")
    if robot in SHIPPED or wheels or steering or chassis:
        _check_world("flat", RobotFile.from_dict({"path": robot}, "robot"))
    else:
        _check_world(robot)
    from mrctl.checks import command as checking

    text, verdict = checking.run(robot, wheels, steering, chassis, json)
    print(text)
    if verdict:
        raise _Incomplete(f"{robot}: {verdict}")


def bench(json: bool = False) -> None:
    """Measures the speed of the closed loop with on-line learning, the engine alone, and navigation, in three minutes.

    Args:
        json: Print JSON instead of a table.
    """
    from mrctl.experiments import bench as benchmark

    figures = benchmark.run()
    print(jsonlib.dumps(figures, indent=2, ensure_ascii=False) if json else benchmark.text(figures))


def _view_with(arguments: list[str]) -> Callable[..., None]:
    """Returns the `view` command, which takes the scenario flags of `run`.

    Without a file and a choice of controllers, the best learner is shown beside PID alone. A robot that is chosen
    without its steering or a reference brings those that suit it.
    """
    asked = arguments[0] == "view"
    scenario_file = _scenario_file(arguments) if asked else None
    chosen = scenario_file is not None or bool(_fields_set(arguments) & {"prior", "learner", "compare"})
    default = Scenario() if chosen else Scenario(**FEEDFORWARDS[BEST])
    if scenario_file:
        default = Scenario.from_toml(scenario_file)

    def view(
        file: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="[SCENARIO.toml|RESULT]")] = None,
        /,
        scenario: Annotated[Scenario, tyro.conf.arg(name="")] = default,
        compare: Annotated[tuple[FeedforwardName, ...], tyro.conf.arg(metavar="NAME ...")] = (),
        number: Annotated[int | None, tyro.conf.arg(name="run")] = None,
        export: Path | None = None,
        host: str = "127.0.0.1",
        port: int = 8080,
        code: bool = True,
    ) -> None:
        """Shows robots in the browser: a live session of a scenario, or the replay of a result or sweep.

        Args:
            file: Scenario file, whose values flags override, or result of `mrctl run --out` or `mrctl sweep`; by
                default the best learner and PID alone, live.
            scenario: The scenario. A robot brings the steering and the reference that suit it, unless they are given.
                Without --prior, --learner and --compare, model+composite drives beside PID alone; with one of them,
                the defaults are those of `mrctl run`. A live session goes on after the last lap.
            compare: Feedforwards of further robots, such as none or model+composite, which are shown as ghosts with the
                same seed and events.
            number: Number of the run to show first, in a result or sweep.
            export: Write this HTML file, which plays without a server, instead of serving a page.
            host: Address to listen on; an address other than 127.0.0.1 lets others in without a password.
            port: Number of the port to listen on.
            code: Whether a sweep may run the Python files of the controller that it names.
        """
        if file is not None and str(file) != scenario_file:
            if not file.exists():
                _check_switches(arguments)
            if scenario != default:
                raise InputError(f"view: {file} has its own scenarios; flags of a scenario need a live session")
            _check_exists(file)
            if compare:
                raise InputError("compare: it needs a scenario; the ghosts of a replay are chosen in the page")
            from mrctl.viewer import view as viewing

            return viewing.replay(file, number, export, host, port, code)
        if number is not None:
            raise InputError("run: chooses a run of a result or a sweep; a live session has none")
        _check_world(scenario.world, scenario.robot)
        from mrctl.viewer import view as viewing

        scenario = _suited(scenario, arguments, scenario_file)
        viewing.live(scenario, compare if chosen else ("none",), export, host, port)

    return _with_fields(view, default, _explained(arguments) if asked else FIRST)


def record(
    file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RESULT")],
    /,
    out: Path,
    number: Annotated[int | None, tyro.conf.arg(name="run")] = None,
    code: bool = True,
) -> None:
    """Writes a video of a result: the robots in three dimensions with the reference and their trails.

    Args:
        file: Result of `mrctl run --out` or `mrctl sweep`.
        out: File to write, whose name ends in .gif, or in .mp4, which needs pip install 'mrctl[video]'.
        number: Number of the run to show; by default up to four runs are shown together, the first one solid and the
            others as ghosts, and of more runs only the first one.
        code: Whether a sweep may run the Python files of the controller that it names.
    """
    _check_exists(file)
    if sys.platform == "linux" and not os.environ.get("DISPLAY"):
        os.environ.setdefault("MUJOCO_GL", "egl")  # which mujoco reads when it is imported
    from mrctl.viewer import video

    video.record(file, number, out, code)
    print(f"video: {out}")


def export(
    file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RESULT")],
    /,
    to: Literal["mcap", "csv", "parquet", "npz"],
    out: Path,
    number: Annotated[int | None, tyro.conf.arg(name="run")] = None,
) -> None:
    """Writes a result for other tools: ROS 2 messages, a table, or NumPy arrays.

    Args:
        file: Result of `mrctl run --out` or `mrctl sweep`.
        to: Format of the file: ROS 2 messages (`mcap`), a table (`csv`, `parquet`) or NumPy arrays (`npz`).
        out: File to write.
        number: Number of the run to write; by default all runs, whose numbers are in a column or before each topic.
    """
    _check_exists(file)
    from mrctl.results import export as exporting
    from mrctl.sweep import jobs, store

    result = store.open(file)
    of_sweep = None if "scenarios" in result.attrs else partial(jobs.scenario_of, file)
    count = exporting.export(result, to, out, number, of_sweep)
    print(f"{out}: {count} {'run' if count == 1 else 'runs'}")


if __name__ == "__main__":
    sys.exit(main())
