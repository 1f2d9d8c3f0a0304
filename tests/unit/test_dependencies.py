"""What mrctl imports is what pyproject.toml declares: no module is there only because another package needs it."""

import ast
import re
import sys
import tomllib
from functools import cache
from importlib.metadata import packages_distributions
from pathlib import Path

import mrctl

PACKAGE = Path(mrctl.__file__).parent
PROJECT = tomllib.loads((PACKAGE.parent / "pyproject.toml").read_text())["project"]
README = (PACKAGE.parent / "README.md").read_text("utf-8")
OPTIONAL = {  # file that alone may import a module of an extra
    "envs/gym.py": "env",
    "sweep/pool.py": "dask",
    "results/export.py": "mcap",
    "viewer/video.py": "video",
    "checks/pytest_plugin.py": "dev",  # pytest itself loads it
}


def canonical(name: str) -> str:
    """The name of a distribution as PEP 503 spells it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def names(requirements: list[str]) -> set[str]:
    """Names of the distributions that a list of requirements asks for."""
    return {canonical(re.match(r"[\w.-]+", requirement)[0]) for requirement in requirements}


@cache
def imported(path: Path) -> set[str]:
    """Top-level modules from outside mrctl and the standard library that a file imports, wherever it does so."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            found.add(node.module.partition(".")[0])
    return found - set(sys.stdlib_module_names) - {"mrctl"}


DECLARED = names(PROJECT["dependencies"])
EXTRAS = {extra: names(requirements) for extra, requirements in PROJECT["optional-dependencies"].items()}
PROVIDERS = {module: set(map(canonical, found)) for module, found in packages_distributions().items()}


def test_every_import_is_declared() -> None:
    """As a dependency, or in the extra of the one file that does without where it is missing."""
    undeclared = []
    for path in sorted(PACKAGE.rglob("*.py")):
        place = str(path.relative_to(PACKAGE))
        allowed = DECLARED | EXTRAS.get(OPTIONAL.get(place, ""), set())
        for module in imported(path):
            if not PROVIDERS.get(module, {canonical(module)}) & allowed:
                undeclared.append(f"{place}: {module}")
    assert not undeclared


def test_every_dependency_is_imported() -> None:
    """Nobody installs what nothing uses; of numcodecs, which zarr brings, the version matters."""
    modules = set().union(*map(imported, PACKAGE.rglob("*.py")))
    used = set().union(*(PROVIDERS.get(module, set()) for module in modules))
    assert DECLARED - used == {"numcodecs"}


def test_optional_files_use_their_extra() -> None:
    """Each of the files that may import an extra does, and the developer's extra covers all of them."""
    for place, extra in OPTIONAL.items():
        needed = set().union(*(PROVIDERS.get(m, set()) for m in imported(PACKAGE / place))) - DECLARED
        assert needed and needed <= EXTRAS[extra] & EXTRAS["dev"], place


def test_walk(tmp_path: Path) -> None:
    """The walk sees imports inside functions, of submodules and under another name, and nothing of mrctl's own."""
    (tmp_path / "a.py").write_text(
        "import os, numpy.linalg as x\nfrom mrctl.record import Record\ndef f():\n    from rich.text import Text\n"
    )
    assert imported(tmp_path / "a.py") == {"numpy", "rich"}
    assert names(["dm-control==1.0.50", "pyright[nodejs]>=1", "Typing_Extensions"]) == {
        "dm-control", "pyright", "typing-extensions",
    }  # fmt: skip


def test_python_versions():
    """README names the versions of Python with which all dependencies can be installed, as pip is told."""
    first, after = map(int, re.fullmatch(r">=3\.(\d+),<3\.(\d+)", PROJECT["requires-python"]).groups())
    (named,) = re.findall(r"Python (3\.\d+), and runs with (3\.\d+) ", README)
    assert list(named) == [f"3.{k}" for k in range(first, after)]
