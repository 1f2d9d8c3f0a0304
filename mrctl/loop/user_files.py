"""A user's own stages, named by their files: `my_file.py:MyController`, `motion=my_file.py:PurePursuit`.

A name stands for a factory as `simulate` takes it; a name without a stage in front is a feedforward. Several names are
joined by commas. Loading runs the files.
"""

from __future__ import annotations

import hashlib
import importlib.util
import sys
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

from mrctl.control.stages import METHODS, Stages
from mrctl.loop.simulation import Simulation
from mrctl.record import InputError
from mrctl.scenario import Scenario


class Part(NamedTuple):
    """One stage of a controller."""

    stage: str
    path: Path
    attribute: str


def parts(name: str) -> list[Part]:
    """Splits a name into its parts.

    Raises:
        InputError: The name is not of the form above, names an unknown stage or one twice, or a file is missing.
    """
    found: list[Part] = []
    for part in name.split(","):
        before, separator, place = part.partition("=")
        stage, place = (before, place) if separator else ("feedforward", part)
        file, _, attribute = place.rpartition(":")
        if not file.endswith(".py") or not attribute.isidentifier():
            raise InputError(f"controller: {part!r} is not of the form my_file.py:MyController")
        if stage not in METHODS:
            raise InputError(f"controller: {stage!r} is no stage; there are {', '.join(METHODS)}")
        if stage in {known.stage for known in found}:
            raise InputError(f"controller: {stage} is there twice")
        if not Path(file).is_file():
            raise InputError(f"controller: no file {file}")
        found.append(Part(stage, Path(file).absolute(), attribute))
    return found


def absolute(name: str) -> str:
    """Returns the name with absolute paths; it is the same for every spelling of the same controller."""
    return ",".join(f"{part.stage}={part.path}:{part.attribute}" for part in parts(name)).removeprefix("feedforward=")


def digest(name: str) -> str:
    """Returns a digest of the contents of the files, which is the same for the same controller.

    Raises:
        InputError: The name is refused, as by `parts`.
    """
    return hashlib.sha256(b"".join(part.path.read_bytes() for part in parts(name))).hexdigest()


@lru_cache
def load(name: str) -> Stages:
    """Runs the files and returns the factories by stage, as keywords for `simulate`.

    Raises:
        InputError: The name is refused, as by `parts`; a file raises; or it has no such name that can be called.
    """
    factories: Any = {part.stage: _factory(part) for part in parts(name)}
    return factories


def _factory(part: Part) -> Any:  # noqa: ANN401
    path, attribute = part.path, part.attribute
    module_name = f"mrctl_controller_{hashlib.sha256(str(path).encode()).hexdigest()[:12]}"
    spec = importlib.util.spec_from_file_location(module_name, path)
    assert spec and spec.loader
    module = sys.modules[module_name] = importlib.util.module_from_spec(spec)  # where dataclasses look the module up
    sys.path.insert(0, str(path.parent))  # as for a script, so that the file can import its neighbours
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        raise InputError(" ".join(f"controller: {path}: {type(error).__name__}: {error}".split())) from None
    finally:
        sys.path.remove(str(path.parent))
    if not callable(getattr(module, attribute, None)):
        raise InputError(f"controller: {path.name} has no {attribute} that can be called with a robot and a size")
    return getattr(module, attribute)


def trial(name: str, scenario: Scenario) -> None:
    """Tries factories and stages on two robots for three ticks, before anything long is computed.

    Raises:
        InputError: The name is refused, as by `load`; the scenario is refused; or the controller fails.
    """
    stages = load(name)
    Simulation([scenario])  # an error of the scenario is not blamed on the controller
    try:
        simulation = Simulation([scenario, scenario], **stages)
    except InputError as error:
        raise InputError(f"controller: {error}") from None
    for _ in range(min(3, simulation.ticks)):
        simulation.step()
        for fault in filter(None, simulation.plant.failure):
            raise InputError(f"controller: {fault.removesuffix(f', tick {simulation.tick - 1}')}")
