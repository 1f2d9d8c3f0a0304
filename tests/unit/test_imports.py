"""The arrows of the architecture: who may import whom, and who may touch the physics engine."""

import ast
import subprocess
import sys
from pathlib import Path

import mrctl

PACKAGE = Path(mrctl.__file__).parent

# From the bottom up: a module imports from its own layer and from those above it in this list. `laws` stands for
# everything in `control` but the wiring.
LAYERS = (
    {"record", "robot", "kinematics", "dynamics"},
    {"laws", "references"},
    {"scenario"},
    {"control.hierarchy", "measurement", "comparison", "metrics", "plots", "result"},
    {"adopt", "model", "plant"},
    {"simulate", "checks"},
    {"episodes"},
    {"experiments", "controller", "sweep", "store", "pool", "jobs", "viewer", "environment", "gym", "export"},
    {"cli"},
)
ENGINE = {"adopt", "model", "plant", "checks", "viewer", "environment", "experiments"}


def module_of(path: Path) -> str:
    """Dotted name inside the package, `` for the package itself."""
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(part for part in parts if part != "__init__")


MODULES = {name: path for path in sorted(PACKAGE.rglob("*.py")) if (name := module_of(path))}


def layer(name: str) -> int:
    """Index of a module's layer."""
    top = name.split(".")[0]
    key = name if name == "control.hierarchy" else "laws" if top == "control" else top
    found = [k for k, members in enumerate(LAYERS) if key in members]
    assert found, f"{name} has no place in the architecture"
    return found[0]


def imports(path: Path) -> set[str]:
    """Absolute names of all that a file imports, wherever it does so."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            names.add(node.module)
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def inside(names: set[str]) -> set[str]:
    """Those that are modules of the package, without the prefix."""
    return {name.removeprefix("mrctl.") for name in names} & MODULES.keys() - {"control", "experiments", "viewer"}


def test_walk():
    """The walk sees what is known to be there."""
    assert {"control.fel", "plant", "scenario"} <= MODULES.keys()
    assert {"record", "robot"} <= inside(imports(MODULES["references"]))
    assert {"model", "result", "plant"} <= inside(imports(MODULES["simulate"]))


def test_arrows():
    """Imports point one way."""
    for name, path in MODULES.items():
        for other in inside(imports(path)):
            assert layer(other) <= layer(name), f"{name} imports {other}"


def test_no_circles():
    """Within a layer too."""
    graph = {name: inside(imports(path)) for name, path in MODULES.items()}
    while free := {name for name, others in graph.items() if not others & graph.keys()}:
        graph = {name: others for name, others in graph.items() if name not in free}
    assert not graph


def test_engine():
    """Only the boundary, the checks and what draws know MuJoCo."""
    users = set()
    for name, path in MODULES.items():
        if {other.split(".")[0] for other in imports(path)} & {"mujoco", "dm_control", "mjviser"}:
            users.add(name.split(".")[0])
    assert {"model", "plant"} <= users <= ENGINE


def test_global_callbacks():
    """`mjcb_control` is process-wide: nobody sets it."""
    for path in MODULES.values():
        assert "mjcb" not in path.read_text(), path


def test_light():
    """Importing the package loads neither torch nor what only figures, commands, viewer and environment need."""
    heavy = ("torch", "matplotlib", "tyro", "viser", "gymnasium", "dask")
    code = f"import sys, mrctl; print([m for m in {heavy} if m in sys.modules])"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]" and out.stderr == ""


def test_laws_without_physics():
    """The laws, references and scenarios are usable where no engine is: importing them loads none."""
    block = "import sys; sys.modules['mujoco'] = sys.modules['dm_control'] = None; import types; "
    package = f"p = types.ModuleType('mrctl'); p.__path__ = [{str(PACKAGE)!r}]; sys.modules['mrctl'] = p; "
    code = (
        block
        + package
        + "import mrctl.control.hierarchy, mrctl.references, mrctl.metrics, mrctl.result, mrctl.dynamics"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)
