"""Where a command begins: its line is parsed, and what goes wrong becomes one line and an exit status."""

from __future__ import annotations

import contextlib
import inspect
import io
import logging
import os
import re
import sys
import warnings
from collections.abc import Callable, Sequence
from functools import partial, wraps
from typing import Any

import tyro

from mrctl import __version__
from mrctl.cli.arguments import expanded, one_line, refuse_known, refuse_twice
from mrctl.cli.flags import further_flags, is_short_help
from mrctl.cli.navigate import navigate_with
from mrctl.cli.results import export, record, view_with
from mrctl.cli.robot import check, identify_with, tune
from mrctl.cli.run import run_with
from mrctl.cli.shared import Incomplete
from mrctl.cli.studies import bench, reproduce, suite, sweep
from mrctl.record import InputError, printable

TQDM_WITHOUT_TERMINAL = {"MININTERVAL": "60", "MAXINTERVAL": "60", "BAR_FORMAT": "{l_bar}{bar}{r_bar}\n"}
"""tqdm settings for output that is no terminal: one line a minute."""


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
    if not sys.stderr.isatty():
        for name, value in TQDM_WITHOUT_TERMINAL.items():
            os.environ.setdefault(f"TQDM_{name}", value)  # which tqdm reads when it is imported
    if isinstance(sys.stdout, io.TextIOWrapper):  # a file may have a name that is not UTF-8
        sys.stdout.reconfigure(errors="replace")
    warnings.showwarning = _once()
    try:
        try:
            if arguments == ["--version"]:
                print(f"mrctl {__version__}")
                return 0
            command = _parse(expanded(arguments))
            for name in ("absl", "asyncio"):  # of failing runs and damaged files, whose own message says why
                logging.getLogger(name).addFilter(lambda _: False)
            try:
                command()
            except SystemExit as stop:
                raise Incomplete(f"the user's code called sys.exit({stop.code})") from None
        finally:
            sys.stdout.flush()
    except BrokenPipeError:  # the reader of a pipe, such as `head`, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except InputError as error:
        print(f"mrctl: {printable(str(error))}", file=sys.stderr)
        return 2
    except OSError as error:
        text = f"{error.filename}: {error.strerror}" if error.filename else error.strerror or str(error)
        print(f"mrctl: {printable(text)}", file=sys.stderr)
        return 2
    except KeyboardInterrupt as stop:
        print(": ".join(["mrctl: interrupted", *map(str, stop.args)]), file=sys.stderr)
        return 130
    except Incomplete as error:
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
            print(f"mrctl: warning: {text}", file=sys.stderr)

    return show


def _parse(arguments: list[str]) -> Callable[[], Any]:
    """Turns the command line into a call of one of the commands.

    Raises:
        InputError: An argument is invalid.
        SystemExit: Help was asked for and has been printed.
    """
    commands: dict[str, Callable[..., Any]] = {
        "run": run_with(arguments),
        "navigate": navigate_with(arguments),
        "reproduce": reproduce,
        "sweep": sweep,
        "suite": suite,
        "tune": tune,
        "identify": identify_with(arguments),
        "check": check,
        "bench": bench,
        "view": view_with(arguments),
        "record": record,
        "export": export,
    }
    if not arguments[0].startswith("-") and arguments[0] not in commands:
        raise InputError(f"no command is called {arguments[0]!r}; there are {', '.join(commands)}")
    refuse_twice(arguments)
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
            refuse_known(arguments)
            raise InputError(one_line(complaints.getvalue(), arguments[0])) from None
        if is_short_help(arguments):
            print(further_flags(arguments[0]))
        raise


def _deferred(function: Callable[..., Any]) -> Callable[..., Callable[[], Any]]:
    """Wraps a command so that tyro, while stderr is captured, only binds its arguments; the result then runs it."""
    # Where a line of the docstring ends within the text of an argument, tyro would begin a new one.
    function.__doc__ = re.sub(r"\n {8,}(?=\S)", " ", inspect.cleandoc(function.__doc__ or ""))

    @wraps(function)
    def inner(*args: object, **kwargs: object) -> Callable[[], Any]:
        return partial(function, *args, **kwargs)

    return inner
