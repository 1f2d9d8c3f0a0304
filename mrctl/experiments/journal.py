"""A file that keeps results as they come, so that a command that was stopped goes on where it was."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mrctl.record import InputError
from mrctl.sweep.jobs import code_digest

SHOWING = ("envs", "viewer", "cli.py", "__main__.py")  # rooms on which no experiment depends


class Journal:
    """Results by key. Its file has a line of JSON for what all of them depend on, and then one for each result.

    JSON keeps every bit of a float, so that a command that goes on ends as one that was never stopped.
    """

    def __init__(self, file: Path, head: dict[str, Any]) -> None:
        """Opens the file or begins it.

        Args:
            file: The file; an unfinished last line is dropped.
            head: Everything that the results depend on, but the Python code of mrctl, whose digest is added.

        Raises:
            InputError: The results in the file depend on something else, or it cannot be read or written.
        """
        self._file, head = file, json.loads(json.dumps(head | {"code": code_digest(SHOWING)}))
        try:
            begun = file.read_text() if file.exists() else ""
            first, *rest = [json.loads(line) for line in begun[: begun.rfind("\n") + 1].splitlines()] or [head]
            other = next((name for name in head if first.get(name) != head[name]), "" if first == head else "it")
            self._known = {json.dumps(line["key"]): line["value"] for line in rest}
        except OSError as error:
            raise InputError(f"out: {file}: {error.strerror}") from None
        except (ValueError, LookupError, TypeError, AttributeError):
            raise InputError(f"out: {file} is damaged; choose another folder") from None
        if other:
            raise InputError(f"out: {file} holds other results ({other} differs); choose another folder")
        file.write_text("".join(json.dumps(line) + "\n" for line in (first, *rest)))

    def __contains__(self, key: object) -> bool:
        """Tells whether the result of a key, of numbers, strings, lists and dictionaries, is there."""
        return json.dumps(key) in self._known

    def __getitem__(self, key: object) -> Any:  # noqa: ANN401
        """Returns the result of a key.

        Raises:
            KeyError: There is none.
        """
        return self._known[json.dumps(key)]

    def __setitem__(self, key: object, value: object) -> None:
        """Keeps a result, of numbers, strings, lists and dictionaries."""
        line = json.dumps({"key": key, "value": value})
        with self._file.open("a") as file:
            file.write(line + "\n")
        self._known[json.dumps(key)] = json.loads(line)["value"]

    def once(self, key: object, compute: Callable[[], object]) -> Any:  # noqa: ANN401
        """Returns the result of a key, and computes and keeps it if there is none."""
        if key not in self:
            self[key] = compute()
        return self[key]
