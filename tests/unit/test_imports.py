"""The arrows of the architecture: who may import whom, and who may touch the physics engine."""

import ast
import subprocess
import sys
from functools import cache
from pathlib import Path

import mrctl

PACKAGE = Path(mrctl.__file__).parent

# From the bottom up: a room imports from its own floor's modules and from the floors below it.
FLOORS = (
    {"record", "kernel"},
    {"theory"},
    {"control", "sensing", "physics"},
    {"scenario"},
    {"checks", "results"},
    {"loop"},
    {"navigation"},
    {"sweep", "envs"},
    {"experiments", "viewer"},
    {"cli"},
)
ENGINE = {"physics", "checks", "viewer", "envs"}  # who may import MuJoCo and dm_control


def module_of(path: Path) -> str:
    """Dotted name inside the package, `` for the package itself."""
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(part for part in parts if part != "__init__")


MODULES = {name: path for path in sorted(PACKAGE.rglob("*.py")) if (name := module_of(path))}


def room(name: str) -> str:
    """The folder or file of `mrctl/` that a module belongs to."""
    return name.split(".")[0]


def floor(name: str) -> int:
    """Index of the floor of a module's room."""
    found = [k for k, rooms in enumerate(FLOORS) if room(name) in rooms]
    assert found, f"{name} has no place in the architecture"
    return found[0]


@cache
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
    return {name.removeprefix("mrctl.") for name in names} & MODULES.keys()


def test_walk() -> None:
    """The walk sees what is known to be there."""
    assert {"control.fel", "physics.plant", "scenario"} <= MODULES.keys()
    assert {"record", "theory.robot"} <= inside(imports(MODULES["theory.references"]))
    assert {"physics.mjcf", "results.dataset", "physics.plant"} <= inside(imports(MODULES["loop.simulation"]))


def test_arrows() -> None:
    """Imports point down, between floors and between the rooms of one floor."""
    arrows = set()
    for name, path in MODULES.items():
        if not name:
            continue  # the package itself names its public objects, and loads them when they are used
        for other in inside(imports(path)) - {""}:
            assert floor(other) <= floor(name), f"{name} imports {other}"
            arrows.add((room(name), room(other)))
    both = {(a, b) for a, b in arrows if a != b and (b, a) in arrows}
    assert not both, both


def test_no_circles() -> None:
    """Among modules too."""
    graph = {name: inside(imports(path)) - {name.rpartition(".")[0], ""} for name, path in MODULES.items()}
    while free := {name for name, others in graph.items() if not others & graph.keys()}:
        graph = {name: others for name, others in graph.items() if name not in free}
    assert not graph


def test_rooms() -> None:
    """`ls mrctl` stays short, and every room says at its door what lives there."""
    boxes = {path.name for path in PACKAGE.iterdir() if path.suffix == ".py" or (path / "__init__.py").exists()}
    assert len(boxes) <= 17
    for path in PACKAGE.glob("*/__init__.py"):
        assert len((ast.get_docstring(ast.parse(path.read_text())) or "").splitlines()) >= 3, path


def test_engine() -> None:
    """Only four rooms know MuJoCo."""
    users = set()
    for name, path in MODULES.items():
        if {other.split(".")[0] for other in imports(path)} & {"mujoco", "dm_control", "mjviser"}:
            users.add(room(name))
    assert users == ENGINE


def test_global_callbacks() -> None:
    """`mjcb_control` is process-wide: nobody sets it."""
    for path in MODULES.values():
        assert "mjcb" not in path.read_text(), path


def loaded(code: str, suspects: tuple[str, ...]) -> list[str]:
    """Which of some modules a fresh interpreter has loaded after running `code`, which must print nothing."""
    code += f"\nimport sys; print(*[m for m in {suspects} if m in sys.modules])"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stderr == ""
    return out.stdout.split()


def test_light() -> None:
    """`import mrctl` loads nothing heavy; a simulation loads neither torch nor figures, commands and viewer."""
    assert not loaded("import mrctl", ("numpy", "numba", "mujoco", "xarray", "torch"))
    assert not loaded(
        "import mrctl; mrctl.Simulation, mrctl.simulate, mrctl.summary",
        ("torch", "matplotlib", "scipy", "zarr", "tyro", "viser", "gymnasium", "dask"),
    )


def test_settings_are_data() -> None:
    """A scenario is read where there is neither Numba, MuJoCo nor torch."""
    code = "import mrctl; mrctl.Scenario(); mrctl.Sweep"
    assert not loaded(code, ("numba", "mujoco", "dm_control", "torch", "scipy"))


def test_laws_without_physics() -> None:
    """The laws, the hierarchy and the results are usable where no engine is."""
    block = "import sys; sys.modules['mujoco'] = sys.modules['dm_control'] = None\n"
    loaded(block + "import mrctl.loop.hierarchy, mrctl.results.metrics, mrctl.results.dataset", ())


def test_public_module() -> None:
    """`mrctl.plots` is a module, which is there before anything else has imported it."""
    script = "import mrctl; assert callable(mrctl.plots.save)"
    assert subprocess.run([sys.executable, "-c", script], check=False).returncode == 0
