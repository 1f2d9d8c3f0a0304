"""The flags of a scenario's fields, and the short help, which explains those that people use."""

from __future__ import annotations

import textwrap
import typing
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any

import pydantic
import tyro

from mrctl.cli.arguments import FROM_FILES, NOT_OF_MISSIONS, WITH_RECORDS
from mrctl.record import Record, with_limits
from mrctl.scenario import Scenario

EXPLAINED_FIELDS = ("name", "world", "steering", "reference", "laps", "prior", "learner", "seed")
"""Fields of `Scenario` that `mrctl run --help` explains; it lists the others, which `mrctl run --help-all` explains."""

LISTED_RECORDS = ("perturbation", "robot", "sensing")
"""Arguments of `mrctl identify` that are records; its short help lists them, as that of `run` does with its fields."""


def is_short_help(arguments: Sequence[str]) -> bool:
    """Tells whether a command line asks for the short help of a command; the help of a reference is always short."""
    asked = bool({"-h", "--help"} & set(arguments))
    return (
        arguments[0] in WITH_RECORDS and asked and not any(argument.startswith("reference:") for argument in arguments)
    )


def explained(arguments: Sequence[str]) -> Sequence[str]:
    """Returns the fields of a scenario to explain: some for --help, all with flags for --help-all, else none."""
    if is_short_help(arguments):
        return EXPLAINED_FIELDS
    asked = {"--help", "--help-all", "-h"} & set(arguments)
    return [name for name in Scenario.model_fields if name not in FROM_FILES] if asked else ()


def partial_record(scenario: Scenario, names: Sequence[str], defaults: Mapping[str, str] | None = None) -> Record:
    """Returns a record of some fields of a scenario, from which tyro makes flags.

    Args:
        scenario: Its values are the defaults.
        names: The fields.
        defaults: What the help says of the defaults of some of them.
    """
    types = typing.get_type_hints(Scenario, include_extras=True)
    for name, text in (defaults or {}).items():
        types[name] = Annotated[types[name], tyro.conf.arg(help_behavior_hint=f"(default: {text})")]
    helps = {name: field.description for name, field in Scenario.model_fields.items()}
    fields: dict[str, Any] = {
        name: (types[name], pydantic.Field(getattr(scenario, name), description=helps[name])) for name in names
    }
    # The fields have their descriptions; pydantic would search the source of each calling frame for more.
    described = {"use_attribute_docstrings": False}
    return pydantic.create_model("Part", __base__=Record, __cls_kwargs__=described, **fields)()


def with_fields(command: Callable[..., None], default: Scenario, names: Sequence[str]) -> Callable[..., None]:
    """Returns `run` or `view` with the flags of these fields of the scenario alone, or of all where there are none."""
    if names:
        part = partial_record(default, names)
        command.__annotations__["scenario"] = Annotated[type(part), tyro.conf.arg(name="")]
        command.__defaults__ = (None, part, *(command.__defaults__ or ())[2:])
    return command


def further_flags(command: str) -> str:
    """Lists and explains the fields, or groups of fields, whose flags the short help of a command leaves out."""
    if command == "identify":
        left_out = list(LISTED_RECORDS)
    else:
        never = NOT_OF_MISSIONS if command == "navigate" else FROM_FILES
        left_out = [name for name in Scenario.model_fields if name not in (*EXPLAINED_FIELDS, *never)]
    # Perturbations are what people change most.
    names = sorted(left_out, key=lambda name: name != "perturbation")
    lines = [f"Further flags, which `mrctl {command} --help-all` explains one by one:"]
    for name in names:
        field = Scenario.model_fields[name]
        flag = f"--{name.replace('_', '-')}" + (".*" if isinstance(field.default, Record) else "")
        text = (field.description or "").removesuffix(with_limits("", field))
        lines += textwrap.wrap(text, 80, initial_indent=f"  {flag:<17} ", subsequent_indent=" " * 20)
    if command in ("run", "view"):
        lines.append(f"`mrctl {command} reference:circle --help` lists the flags of a reference, here of a circle.")
    return "\n".join(lines)
