"""Typed, frozen configuration: the base of everything that is read from a file."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any, Self

from pydantic import BaseModel, ConfigDict, ValidationError

from mrctl import __version__

WRITTEN_BY = "# written by mrctl "  # first line of a TOML file that `to_toml` made


class InputError(ValueError):
    """Bad input from outside: one line that names the field or the file."""


class Record(BaseModel):
    """A frozen record: unknown keys and non-finite numbers are refused by name."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True)

    @classmethod
    def from_dict(cls, values: object, source: str = "") -> Self:
        """Validates plain data.

        Args:
            values: What a TOML or JSON file holds.
            source: Where it came from, for the message.

        Raises:
            InputError: One line that names the first offending field.
        """
        try:
            return cls.model_validate(values)
        except ValidationError as error:
            raise InputError(describe(error, source)) from None

    @classmethod
    def from_toml(cls, path: str | Path) -> Self:
        """Reads and validates a TOML file.

        Raises:
            InputError: The file cannot be read, is not TOML, or names a bad field; the message names the version of
                mrctl that wrote the file, if another one did.
        """
        try:
            text = Path(path).read_bytes().decode()
        except (OSError, ValueError) as error:
            raise InputError(f"{path}: {getattr(error, 'strerror', None) or error}") from None
        try:
            values = tomllib.loads(text)
        except (ValueError, RecursionError) as error:
            raise InputError(f"{path}: not TOML: {error}") from None
        first = text.partition("\n")[0]
        another = first.startswith(WRITTEN_BY) and first != WRITTEN_BY + __version__
        return cls.from_dict(values, f"{path} ({first.removeprefix('# ')})" if another else str(path))

    def to_toml(self) -> str:
        """The record as `from_toml` reads it: a comment with the version of mrctl, then a line for every field."""
        return f"{WRITTEN_BY}{__version__}\n" + "".join(
            f"{name} = {_toml(value, nested=False)}\n"
            for name, value in self.model_dump(mode="json", exclude_none=True).items()
        )


def _toml(value: Any, nested: bool = True) -> str:  # noqa: ANN401
    """A value in TOML, whose numbers, booleans and, but for one character, strings are JSON's."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {_toml(item)}" for key, item in value.items()) + " }"
    if isinstance(value, list) and not nested and any(isinstance(item, dict) for item in value):
        return "[\n" + "".join(f"    {_toml(item)},\n" for item in value) + "]"
    if isinstance(value, list):
        return "[" + ", ".join(map(_toml, value)) + "]"
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def describe(error: ValidationError, source: str = "") -> str:
    """One line for a pydantic error: `source: field.subfield: what is wrong`."""
    first, *rest = error.errors()
    field = ".".join(str(part) for part in first["loc"])
    message = first["msg"].removeprefix("Value error, ")
    more = f" (and {len(rest)} more)" if rest else ""
    return " ".join((": ".join(part for part in (source, field, message) if part) + more).split())
