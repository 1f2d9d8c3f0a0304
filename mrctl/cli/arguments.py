"""What a command line says: short flags, the fields that it sets, and messages about what is wrong in it."""

from __future__ import annotations

import ast
import math
import re
from collections.abc import Sequence
from pathlib import Path

from mrctl.record import InputError, Record, nearest
from mrctl.scenario import Scenario
from mrctl.theory.perturbation import Perturbation

FROM_FILES = ("events", "obstacles", "map")
"""Fields of `Scenario` that have no flags, because they come from a scenario file."""

NOT_OF_MISSIONS = (*FROM_FILES, "reference", "laps", "initial_pose", "goal")
"""Fields of `Scenario` without flags in `mrctl navigate`: they come from files, or the mission sets them."""

WITH_RECORDS = "run", "navigate", "identify", "view"
"""Commands whose short help leaves out most of the flags of a record."""

SHORT_FLAGS = {"--robot": "--robot.path", "--sensing": "--sensing.tier", "--localise": "--sensing.localisation"}
"""Flags that stand for longer ones."""

FLAGS_ELSEWHERE = {
    "--tier": "--sensing.tier", "--wheels": "--robot.wheels", "--steering": "--robot.steering",
    "--chassis": "--robot.chassis",
}  # fmt: skip
"""Flags of `check` and `tune`, and what they are called in the commands of `WITH_RECORDS`."""

CONTROLLER_OF_VIEW = (
    "controller: a live session drives with those of mrctl; with your own, give mrctl {} --controller and --out "
    "FOLDER, then mrctl view FOLDER"
)
"""Message for a controller of the user in a live session, with the command that drives it."""

POSE_FLAGS = "--goal", "--start", "--initial-pose", "--initial-spread"
"""Flags whose values may be written as x,y,θ."""

LIST_FLAGS = "--controller", "--feedforward", "--compare", "--delay", "--tier"
"""Flags that take several values, and are given once; of a flag that is given twice tyro would take the last."""


def expanded(arguments: list[str]) -> list[str]:
    """Expands short flags into full ones.

    `--perturbation NAME` becomes all flags of that perturbation, so that it replaces that of a scenario file; later
    flags override it. A flag of `SHORT_FLAGS` becomes the longer one, and a pose x,y,θ three numbers.

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
            for field, changed in perturbation.model_dump().items():  # all, for it replaces that of a scenario file
                found += [f"--perturbation.{field.replace('_', '-')}", str(changed)]
        elif flag in SHORT_FLAGS:
            if not (name := value if given else next(rest, "")) or name.startswith("--"):
                raise InputError(f"{flag.removeprefix('--')}: needs a value; see mrctl {arguments[0]} --help")
            found += [SHORT_FLAGS[flag], name]
        elif given and flag in POSE_FLAGS:
            found += [flag, *_pose(flag, value)]
        else:
            in_pose = "," in argument and found[-1:] and found[-1] in POSE_FLAGS
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


def fields_set(arguments: Sequence[str]) -> set[str]:
    """Returns the fields that a command line sets; of nested ones the outermost, such as `robot` for --robot.path."""
    flags = [argument for argument in arguments[1:] if argument.startswith(("--", "reference:"))]
    return {re.split("[.:=]", flag.removeprefix("--"))[0].replace("_", "-") for flag in flags}


def scenario_file_of(arguments: Sequence[str]) -> str | None:
    """Returns the argument of `run` or `view` that is a scenario file: it ends in .toml and is no value of a flag."""
    for previous, argument in zip(arguments, arguments[1:], strict=False):
        is_value = previous.startswith("--") and "=" not in previous and _switch(previous) is None
        if argument.endswith(".toml") and not argument.startswith("-") and not is_value:
            return str(Path(argument))
    return None


def refuse_known(arguments: Sequence[str]) -> None:
    """Refuses flags of a scenario's fields that have none, or had one in an earlier version, and --controller.

    Raises:
        InputError: There is such a flag; the message says what to do in its place.
    """
    if arguments[0] not in WITH_RECORDS:
        return
    for place, flag in enumerate(arguments):
        if flag.startswith("--"):
            name = flag[2:].partition("=")[0].replace("-", "_")
            if name == "controller" and arguments[0] == "view":
                raise InputError(CONTROLLER_OF_VIEW.format("run"))
            Scenario.refuse_moved(name)
            behind = any(before.startswith("reference:") for before in arguments[:place])
            if arguments[0] in ("run", "view") and name.split(".")[0] == "reference" and not behind:
                how = "a reference comes last, and its flags behind it, as in reference:circle --reference.radius 0.8"
                raise InputError(f"{flag[2:]}: {how}")
            if name in FROM_FILES:
                raise InputError(f"{name}: has no flag; set it in a scenario file, as for mrctl run scenario.toml")
            if arguments[0] == "navigate" and name in NOT_OF_MISSIONS and name != "goal":  # it has its own --goal
                raise InputError(f"{name}: has no flag here, because the mission sets it")


def refuse_twice(arguments: Sequence[str]) -> None:
    """Refuses --controller without a value, and a second one of the flags that take several, which would replace them.

    Raises:
        InputError: There is one; the message says how to give values.
    """
    given = [argument.partition("=")[0] for argument in arguments]
    for flag, word in zip(arguments, [*arguments[1:], "--"], strict=True):
        if flag == "--controller" and word.startswith("--"):
            raise InputError(f"controller: needs a value; see mrctl {arguments[0]} --help")
    for flag in LIST_FLAGS:
        if given.count(flag) > 1:
            how = "joined by commas" if (arguments[0], flag) == ("run", "--controller") else "one after another"
            raise InputError(f"{flag.removeprefix('--')}: is given twice; its values stand behind one {flag}, {how}")


def check_switches(arguments: Sequence[str]) -> None:
    """Refuses a word such as true behind a flag that takes no value."""
    for flag, word in zip(arguments[1:], arguments[2:], strict=False):
        if word.lower() in ("true", "false", "on", "off", "yes", "no", "0", "1") and (name := _switch(flag)):
            *path, last = name.split(".")
            off = ".".join([*path, f"no-{last}"])
            raise InputError(f"{name}: a switch without a value, but {word} follows it; --{name} is on, --{off} off")


def _switch(flag: str) -> str | None:
    """Returns the name of a flag of `run` or `view` that takes no value, such as `guard.on` for --guard.no-on."""
    name = re.sub(r"(^--|\.)no-", r"\1", flag.replace("_", "-")).removeprefix("--")
    return name if flag.startswith("--") and name in {"json", "code", *_switches(Scenario)} else None


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


def one_line(box: str, command: str) -> str:
    """Returns the message in one of tyro's boxes, about a command, as one line.

    The box is drawn in Unicode or ASCII. The message of a record that is a part of a scenario gets the whole path.
    """
    titled = "╭" not in box  # without box characters the title is a part of its own
    lines = [line.strip("│| ") for line in box.splitlines() if not line.startswith(("╭", "╰", "+"))]
    parts = re.split(r"(?:^|\n)[-─]{8,}(?:\n|$)", "\n".join(lines).strip())
    parts = [" ".join(part.split()) for part in parts if part.strip()]
    text = re.sub(r"\[/?bold\]", "", parts[min(titled, len(parts) - 1)]) if parts else "bad arguments"
    if text.startswith("Missing from "):  # what is missing is indented less than what it means
        missing = re.findall(r"^[│| ] {5}(?! |mrctl )(.*?) *[│|]?$", box, re.MULTILINE)
        return f"{', '.join(missing)}: missing; see mrctl {command} --help"
    if match := re.match(r"Missing value for argument '-*([\w.-]+)'", text):
        return f"{match[1]}: needs a value; see mrctl {command} --help"
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
            flag = line.split()[0].rstrip(",") if line.startswith("--") else flag  # a switch has two, --on, --no-on
            if line.startswith(f"in mrctl {command} "):
                similar.append(flag)
        # Of flags that end alike tyro lists first the one of the reference that is chosen.
        inner = [flag for flag in similar if flag.endswith(f".{match[1].removeprefix('--')}")]
        groups = ["--perturbation", *SHORT_FLAGS] if command in WITH_RECORDS else []
        meant = inner[0] if inner else nearest(match[1], similar) or nearest(match[1], groups)
        return f"no flag is called {match[1]}" + (f"; did you mean {meant}?" if meant else "")
    if match := re.match(r"Unrecognized or misplaced options: (\S+) \(applied to mrctl (\S+)( \S+)?\)", text):
        if match[3]:
            return f"{match[1]}: is no flag of{match[3]}, and those of mrctl {match[2]} stand before it"
        robot = match[1].startswith("--robot.") and command in ("check", "tune")
        instead = f"; the robot stands without a flag, as in mrctl {command} turtlebot" if robot else ""
        if command in WITH_RECORDS and match[1] in FLAGS_ELSEWHERE:
            instead = f"; did you mean {FLAGS_ELSEWHERE[match[1]]}?"
        return f"{match[1]}: is no flag of mrctl {match[2]}{instead}"
    if command in ("run", "view") and (match := re.match(r"Unrecognized options: (\S+\.toml)", text)):
        return f"{match[1]}: one scenario file may be given, in front of the reference"
    if match := re.match(r"Unrecognized options: (\S+\.xml)", text):
        return f"{match[1]}: the file of a robot is given as --robot.path {match[1]}"
    if not (match := re.match(r"Error parsing (\S+): (.*)", text)):
        return text
    parts = match[1].removeprefix("--").split(".")
    path = ".".join(part for part in parts if part not in ("__tyro-dummy-inner__", "scenario"))
    joint = "." if re.match(r"[\w.]+: ", match[2]) else ": "  # that of a record begins with the field
    return f"{path}{joint}{match[2]}" if path else match[2]
