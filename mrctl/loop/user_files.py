"""A user's own stages, named by their files: `my_file.py:MyController`, `motion=my_file.py:PurePursuit`.

A name stands for a factory as `simulate` takes it; a name without a stage in front is a feedforward. Keyword arguments
of the factory may follow, as in `my_file.py:MyController(gain=0.3)`. Several names are joined by commas. Loading a name
runs its files.
"""

from __future__ import annotations

import ast
import hashlib
import importlib
import re
import sys
from collections.abc import Mapping
from functools import lru_cache, partial
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

from mrctl.control.stages import METHODS, Stages
from mrctl.loop.simulation import Simulation
from mrctl.loop.user_stages import StageError
from mrctl.record import InputError, nearest
from mrctl.scenario import FEEDFORWARDS, FeedforwardName, Scenario

NOT_BESIDE = {*sys.stdlib_module_names, "mrctl"}
"""Modules that are not taken from the folder of the file that imports them: in a clone, mrctl stands there too."""


class Part(NamedTuple):
    """One stage of a controller."""

    stage: str
    file: str
    """The file as it is written in the name."""
    attribute: str
    settings: dict[str, Any]
    """Keyword arguments of the factory."""

    @property
    def path(self) -> Path:
        """Absolute path of the file."""
        return Path(self.file).absolute()

    @property
    def title(self) -> str:
        """Name of the factory, with its settings as in a call."""
        settings = ", ".join(f"{name}={value!r}" for name, value in self.settings.items())
        return f"{self.attribute}({settings})" if settings else self.attribute


def parts(name: str) -> list[Part]:
    """Splits a name into its parts.

    Raises:
        InputError: The name is not of the form above, names an unknown stage or a stage twice, or a file is missing.
    """
    found = split(name)
    for part in found:
        if not part.path.is_file():
            where = "" if Path(part.file).is_absolute() else f" in {Path.cwd()}"
            raise InputError(f"controller: no file {part.file}{where}{_remedy(part.file)}")
    return found


def split(name: str) -> list[Part]:
    """Splits a name into its parts, whose files need not exist.

    Raises:
        InputError: The name is not of the form above, or names an unknown stage or a stage twice.
    """
    found: list[Part] = []
    for part in re.split(r",(?=[^,]*\.py:)", name):
        place, _, call = part.strip().partition(".py:")
        stage, separator, file = f"{place}.py".partition("=")
        stage, file = (stage, file) if separator else ("feedforward", f"{place}.py")
        attribute, settings = _called(call)
        if not attribute:
            form = "my_file.py:MyController or my_file.py:MyController(gain=0.3)"
            raise InputError(f"controller: {part!r} is not of the form {form}")
        if "+" in stage and _front(stage) == "none":
            front = stage.rpartition("+")[0]
            meant = f"; did you mean {close}?" if (close := nearest(front, [*FEEDFORWARDS])) else ""
            raise InputError(f"controller: {front} is no feedforward of mrctl{meant}")
        if stage not in METHODS:
            raise InputError(f"controller: {stage!r} is not a stage; there are {', '.join(METHODS)}{_remedy(stage)}")
        if stage in {known.stage for known in found}:
            raise InputError(f"controller: {stage} is given twice")
        found.append(Part(stage, file, attribute, settings))
    return found


def _called(call: str) -> tuple[str, dict[str, Any]]:
    """Splits `MyController(gain=0.3)` into name and keyword arguments; the name is "" where it is something else."""
    try:
        tree = ast.parse(call.strip(), mode="eval").body
        if isinstance(tree, ast.Name):
            return tree.id, {}
        if isinstance(tree, ast.Call) and isinstance(tree.func, ast.Name) and not tree.args:
            return tree.func.id, {word.arg or "**": ast.literal_eval(word.value) for word in tree.keywords}
    except (SyntaxError, ValueError):
        pass
    return "", {}


def behind(name: str) -> tuple[FeedforwardName, str, list[Part]]:
    """Splits a name with a feedforward of mrctl in front, as in `model+composite+motion=my_file.py:MyMotion`.

    Returns:
        The feedforward in front, `none` where there is none; the name without it; and its parts.

    Raises:
        InputError: The name is refused, as by `split`, or a learner is in front of a feedforward of the user.
    """
    if name in FEEDFORWARDS:
        raise InputError(f"controller: {name} is one of mrctl; give its prior and learner, and no controller")
    front = _front(name)
    own = name.removeprefix(f"{front}+")
    found = split(own)
    if FEEDFORWARDS[front]["learner"] != "none" and any(part.stage == "feedforward" for part in found):
        raise InputError(
            f"controller: {name!r} has two feedforwards; yours is in the place of a learner, and only model+ can be in "
            f"front of it; another stage is named, as in {front}+feedback=my_file.py:MyFeedback"
        )
    return front, own, found


def _front(name: str) -> FeedforwardName:
    """Returns the feedforward of mrctl that stands in front of a name, `none` where there is none."""
    fronts: list[FeedforwardName] = [one for one in FEEDFORWARDS if name.startswith(f"{one}+") and one != "none"]
    return max(fronts, key=len) if fronts else "none"


def _remedy(name: str) -> str:
    """Returns how to drive with the feedforward in front of a name where such a name is not read, or ""."""
    front = _front(name)
    fields = [f"{field} to {value}" for field, value in FEEDFORWARDS[front].items() if value != "none"]
    return f"; for {front} before it set {' and '.join(fields)}" if fields else ""


def absolute(name: str) -> str:
    """Returns the name with absolute paths; it is the same for every spelling of the same controller."""
    return ",".join(f"{part.stage}={part.path}:{part.title}" for part in parts(name)).removeprefix("feedforward=")


def digest(name: str, beside: bool = True) -> str:
    """Returns a digest of the files that a name names and of those beside them that they import, without the settings.

    Args:
        name: The name.
        beside: Whether the files beside them count; in stores that were written before version 0.29.0 they do not.

    Raises:
        InputError: The name is refused, as by `parts`.
    """
    files = [file for part in parts(name) for file in (part.path, *(neighbours(part.path) if beside else ()))]
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()


def neighbours(path: Path) -> list[Path]:
    """Returns the Python files in the folder of a file, or in packages there, that it imports, and what these import.

    Imports are found by their text, without running a file. Modules of Python and mrctl itself are left out.
    """
    folder, found, queue = path.parent, set[Path](), [path]
    while queue:
        file = queue.pop()
        try:
            nodes = list(ast.walk(ast.parse(file.read_bytes())))
        except (SyntaxError, ValueError, RecursionError):  # loading the file says so
            continue
        new = {one for node in nodes for one in _imported(node, file, folder)} - found - {path}
        found |= new
        queue += new
    return sorted(found)


def _imported(node: ast.AST, file: Path, folder: Path) -> list[Path]:
    """Returns the files in a folder, or in packages there, that an import statement in one of them names."""
    if isinstance(node, ast.Import):
        place, names = folder, [alias.name for alias in node.names]
    elif isinstance(node, ast.ImportFrom):
        place = file.parents[min(node.level, len(file.parents)) - 1] if node.level else folder
        names = [f"{node.module or ''}.{alias.name}".strip(".") for alias in node.names]
    else:
        return []
    found: list[Path] = []
    for words in (name.split(".") for name in names):
        if place.is_relative_to(folder) and not (place == folder and words[0] in NOT_BESIDE):
            ways = [place.joinpath(*words[:depth]) for depth in range(1, len(words) + 1)]
            found += [one for way in ways for one in (way.with_name(f"{way.name}.py"), way / "__init__.py")]
    return [one for one in found if one.is_file()]


def load(name: str) -> Stages:
    """Runs the files and returns the factories by stage, as keywords for `simulate`.

    The files run once as long as they and their `neighbours` stay the same; the same file name in another directory is
    another file, as is that of a neighbour. Neighbours belong at the top of a file: an import in a function takes what
    was loaded last under this name.

    Raises:
        InputError: The name is refused, as by `parts`; a file raises; or a file has no such attribute to call.
    """
    return _load(absolute(name), digest(name))


@lru_cache
def _load(name: str, _digest: str) -> Stages:
    found = parts(name)
    _forget_others({file: part.path.parent for part in found for file in neighbours(part.path)})
    factories: Any = {part.stage: _factory(part) for part in found}
    return factories


_imported_as: dict[str, str] = {}
"""Digests of the neighbours as they were imported last, by path."""


def _forget_others(folders: Mapping[Path, Path]) -> None:
    """Forgets modules that have the names of neighbours, but are of another folder or from before an edit.

    Args:
        folders: The folder from which each neighbour is imported.
    """
    now = {str(file): hashlib.sha256(file.read_bytes()).hexdigest() for file in folders}
    edited = any(_imported_as.get(file, digest) != digest for file, digest in now.items())
    names = {file.relative_to(folder).parts[0].removesuffix(".py") for file, folder in folders.items()}
    for name, module in list(sys.modules.items()):
        if name.partition(".")[0] in names and (edited or getattr(module, "__file__", None) not in now):
            del sys.modules[name]
    importlib.invalidate_caches()
    _imported_as.update(now)


def _factory(part: Part) -> Any:  # noqa: ANN401
    path, attribute = part.path, part.attribute
    module_name = f"mrctl_controller_{hashlib.sha256(str(path).encode()).hexdigest()[:12]}"
    module = sys.modules[module_name] = ModuleType(module_name)  # dataclasses look the module up there
    module.__file__ = str(path)
    sys.path.insert(0, str(path.parent))  # as for a script, so that the file can import its neighbours
    writes, sys.dont_write_bytecode = sys.dont_write_bytecode, True
    try:
        # Python's own cache of compiled files takes an edit within a second that keeps the size for no edit.
        exec(compile(path.read_bytes(), str(path), "exec"), module.__dict__)
    except (Exception, SystemExit) as error:
        raise InputError(" ".join(f"controller: {path}: {type(error).__name__}: {error}".split())) from None
    finally:
        sys.dont_write_bytecode = writes
        sys.path.remove(str(path.parent))
    if not callable(getattr(module, attribute, None)):
        raise InputError(f"controller: {path.name} has no {attribute} that can be called with a robot and a size")
    factory = getattr(module, attribute)
    if part.settings:
        factory = partial(factory, **part.settings)
        factory.__name__ = part.title  # type: ignore[attr-defined] (the name in labels and messages)
    return factory


def without_learned(name: str, scenario: Scenario) -> Scenario:
    """Returns the scenario without the file that a feedforward of this name starts from, which no other can read."""
    own = any(part.stage == "feedforward" for part in parts(name))
    return scenario.model_copy(update={"learned": None}) if own else scenario


def trial(name: str, scenario: Scenario) -> None:
    """Tries factories and stages on two robots for three ticks, before a long computation.

    A robot that collides so early does so with every controller, and ends the trial.

    Raises:
        InputError: The name is refused, as by `load`; the scenario is refused; or the controller fails.
    """
    stages = load(name)
    Simulation([without_learned(name, scenario)])  # an error of the scenario is not blamed on the controller
    try:
        simulation = Simulation([scenario, scenario], **stages)
    except StageError as error:
        raise InputError(f"controller: {error}") from None
    for _ in range(min(3, simulation.ticks)):
        if not simulation.running:
            break
        simulation.step()
        for fault in (one for one in simulation.plant.failure if one not in ("", "collision")):
            raise InputError(f"controller: {fault.removesuffix(f', tick {simulation.tick - 1}')}")
