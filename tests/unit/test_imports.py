"""The arrows of the architecture: who may import whom, and who may touch the physics engine."""

import ast
import json
import os
import re
import signal
import subprocess
import sys
import time
from functools import cache
from pathlib import Path
from typing import NamedTuple

import pytest

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
    {"__main__"},
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
def tree(path: Path) -> ast.Module:
    """The syntax of a file."""
    return ast.parse(path.read_text())


@cache
def imports(path: Path) -> set[str]:
    """Absolute names of all that a file imports, wherever it does so."""
    names = set()
    for node in ast.walk(tree(path)):
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
    assert {"physics.hull", "results.dataset", "physics.plant"} <= inside(imports(MODULES["loop.outcome"]))


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


class Class(NamedTuple):
    """A class of the package: its module, the names of its bases, and the private names that it defines."""

    module: str
    bases: set[str]
    own: set[str]


def private(name: str) -> bool:
    """Whether a name is private, but none of those that named tuples give to everybody."""
    return name.startswith("_") and not name.startswith("__") and name not in {"_asdict", "_fields", "_replace"}


def owns(node: ast.expr) -> bool:
    """Whether an expression is the object of the method itself: `self`, `cls` or `super()`."""
    return ast.unparse(node) in {"self", "cls", "super()"}


def classes() -> dict[tuple[str, str], Class]:
    """Every class of the package, by module and name."""
    found = {}
    for module, path in MODULES.items():
        for node in ast.walk(tree(path)):
            if not isinstance(node, ast.ClassDef):
                continue
            own = {part.name for part in node.body if isinstance(part, ast.FunctionDef)}
            for part in ast.walk(node):
                if isinstance(part, ast.Attribute) and isinstance(part.ctx, ast.Store) and owns(part.value):
                    own.add(part.attr)
            for part in node.body:
                if isinstance(part, ast.Assign | ast.AnnAssign):
                    targets = part.targets if isinstance(part, ast.Assign) else [part.target]
                    own |= {target.id for target in targets if isinstance(target, ast.Name)}
            bases = {ast.unparse(base).split("[")[0].rpartition(".")[2] for base in node.bases}
            found[module, node.name] = Class(module, bases, {name for name in own if private(name)})
    return found


def touched(module: str, code: ast.AST, known: dict[tuple[str, str], Class]) -> set[str]:
    """Where code of a module touches what is private to a class of another file, or imports what is private."""
    everywhere, found = set().union(*(other.own for other in known.values())), set()

    def inherited(name: str, here: bool) -> set[str]:
        """What is private to a class and its bases: those in this file, which are one piece of work, or all of them."""
        found = set()
        for (home, own), other in known.items():
            if own == name and (home == module or not here):
                found |= other.own.union(*(inherited(base, here) for base in other.bases - {name}))
        return found

    def look(node: ast.AST, family: set[str], ancestors: set[str]) -> None:
        for part in ast.iter_child_nodes(node):
            if isinstance(part, ast.Attribute) and private(part.attr) and part.attr not in family:
                if part.attr in (ancestors if owns(part.value) else everywhere):
                    found.add(f"{module}:{part.lineno} {ast.unparse(part)}")
            elif isinstance(part, ast.ImportFrom):
                found.update(f"{module}:{part.lineno} {alias.name}" for alias in part.names if private(alias.name))
            if isinstance(part, ast.ClassDef):
                look(part, family | inherited(part.name, True), inherited(part.name, False))
            else:
                look(part, family, ancestors)

    look(code, set(), set())
    return found


def test_private() -> None:
    """A private attribute is touched by its class and by subclasses in the same file, by nobody else."""
    known = classes()
    assert {"_every", "_adopt"} <= known["loop.hierarchy", "Hierarchy"].own
    for module, path in MODULES.items():
        assert not touched(module, tree(path), known)
    mine = "class Mine(Hierarchy):\n    def f(self, run):\n        return self._every, self._own, run._asdict()"
    other = {**known, ("loop.other", "Mine"): Class("loop.other", {"Hierarchy"}, {"_own"})}
    assert touched("loop.other", ast.parse(mine), other) == {"loop.other:3 self._every"}
    assert touched("loop.other", ast.parse("simulation._learned"), known) == {"loop.other:1 simulation._learned"}
    assert not touched("loop.hierarchy", ast.parse("class Hierarchy:\n    def f(self, of):\n        of._every"), known)


def test_rooms() -> None:
    """`ls mrctl` stays short, and every room says at its door what lives there."""
    boxes = {path.name for path in PACKAGE.iterdir() if path.suffix == ".py" or (path / "__init__.py").exists()}
    assert len(boxes - {"__init__.py", "__main__.py"}) <= 16
    for path in PACKAGE.glob("*/__init__.py"):
        assert len((ast.get_docstring(tree(path)) or "").splitlines()) >= 3, path


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


STEPS = (  # what a user does one after the other, and what is not loaded until then
    ("import mrctl", ("numpy", "numba", "mujoco", "xarray", "torch")),
    ("mrctl.Scenario(); mrctl.Sweep", ("numba", "mujoco", "dm_control", "torch", "scipy")),
    (
        "mrctl.Simulation, mrctl.simulate, mrctl.summary",
        ("torch", "matplotlib", "scipy", "zarr", "tyro", "viser", "gymnasium", "dask", "mrctl.results.plots"),
    ),
    ("assert callable(mrctl.plots.save)", ()),
)


def test_light() -> None:
    """`import mrctl` loads nothing heavy, a scenario neither Numba, MuJoCo nor torch; a simulation loads neither torch
    nor figures, commands and viewer; `mrctl.plots` is a module that is there before anything else has imported it.
    """
    look = "import sys; print({code!r}, *[m for m in {suspects} if m in sys.modules])"
    code = "\n".join(f"{code}\n{look.format(code=code, suspects=suspects)}" for code, suspects in STEPS)
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert (out.stdout.splitlines(), out.stderr) == ([code for code, _ in STEPS], "")


def test_laws_without_physics() -> None:
    """The laws, the hierarchy and the results are usable where no engine is."""
    code = "import sys; sys.modules['mujoco'] = sys.modules['dm_control'] = None\n"
    code += "import mrctl.loop.hierarchy, mrctl.results.metrics, mrctl.results.dataset"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert (out.stdout, out.stderr) == ("", "")


EVERY_MODULE = """
import importlib, os, pkgutil, sys, warnings
import mrctl

for name in sys.argv[1:]:
    importlib.import_module(name)
if "numba" in sys.modules:
    print("a file of kernels has imported Numba")
from numba.core.event import Listener, register

class Compiled(Listener):
    def on_start(self, event):
        print("compiled", event.data["dispatcher"])

    def on_end(self, event):
        pass

warnings.simplefilter("ignore")
register("numba:compile", Compiled())
for module in pkgutil.walk_packages(mrctl.__path__, "mrctl."):
    importlib.import_module(module.name)
"""


def test_import_compiles_nothing(tmp_path: Path) -> None:
    """No module calls a kernel when it is imported; a command would compile laws only to refuse its arguments.

    All files with kernels can be imported without Numba.
    """
    holders = [
        f"mrctl.{name}" for name, path in MODULES.items() if re.search(r"^@kernel$", path.read_text(), re.MULTILINE)
    ]
    assert {"mrctl.control.fel", "mrctl.loop.hierarchy", "mrctl.physics.plant"} <= {*holders}
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}  # empty, so that what is called is compiled
    command = [sys.executable, "-c", EVERY_MODULE, *holders]
    out = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    assert (out.returncode, out.stdout) == (0, ""), out


@pytest.mark.parametrize(("driver", "early"), [("egl", True), ("osmesa", True), ("", False)])
def test_triton_before_mesa(driver: str, early: bool, tmp_path: Path) -> None:
    """Triton is imported before what draws without a GPU; torch's, imported afterwards, crashes the process."""
    (tmp_path / "triton.py").touch()
    search = os.pathsep.join([str(tmp_path), str(PACKAGE.parent)])
    code = "import sys, mrctl; print('triton' in sys.modules, 'dm_control' in sys.modules)"
    environment = os.environ | {"PYTHONPATH": search, "MUJOCO_GL": driver}
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, env=environment)
    assert out.stdout == f"{early} False\n", out


LIGHT = [
    "--help", "run --help", "navigate --help", "view --help", "suite --workers 0", "suite --seeds 0",
    "suite --random -1", "suite --quick --full", "suite --held-out none --random 3", "tune nosuch", "tune no.xml",
    "tune --world moon", "view nosuch", "view --world moon", "record nosuch --out x.gif", "navigate",
    "navigate no.toml", "navigate --quick", "navigate doorway:1 --view --json", "navigate doorway:1 --world moon",
    "navigate doorway:1 --robot.path nosuch", "run --world moon", "run --robot.path nosuch", "run nosuch --run 1",
    "run --laps 0", "run nosuch.toml", "sweep no.toml --out s", "sweep no.toml --out s --workers 0", "check nosuch",
    "check --wheels a b -- nosuch", "identify --world moon", "export nosuch --to csv --out x", "dance",
]  # fmt: skip
ANSWER = """
import sys
from mrctl import cli

for line in {lines!r}:
    try:
        status = cli.main(line.split())
    except SystemExit as stop:
        status = stop.code or 0
    print("answered", status, *[m for m in {heavy} if m in sys.modules])
"""


def test_answers_before_imports() -> None:
    """Help, and refusals of what can be seen without physics, come before anything heavy is imported."""
    heavy = ("numba", "mujoco", "dm_control", "torch", "xarray", "zarr", "scipy", "matplotlib")
    code = ANSWER.format(lines=LIGHT, heavy=heavy)
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    answers = [line for line in out.stdout.splitlines() if line.startswith("answered")]
    assert answers == [f"answered {0 if '--help' in line else 2}" for line in LIGHT], out
    assert len(out.stderr.splitlines()) == sum("--help" not in line for line in LIGHT), out.stderr


FIRST_LINE = """
import os, sys
from mrctl import cli
from numba.core.event import Listener, register

said = []
write = sys.stderr.write
sys.stderr.write = lambda text: said.append(text) or write(text)

class Compiled(Listener):
    def on_start(self, event):  # registered when the laws are about to be compiled, after what announces them
        os._exit(0 if "".join(said).startswith("mrctl: compiling the laws") else 1)

    def on_end(self, event):
        pass

from mrctl.loop import announcement
announcement.announced()
register("numba:compile", Compiled())
cli.main(["run", "--laps", "1"])
os._exit(2)
"""


def test_first_line_before_compiling(tmp_path: Path) -> None:
    """A cold run says that it compiles before it does."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    out = subprocess.run(
        [sys.executable, "-c", FIRST_LINE], capture_output=True, text=True, check=False, env=environment
    )
    assert out.returncode == 0, out


EARLY = """
import os, sys
from mrctl import cli

def first(text):
    heavy = [name for name in ("numba", "mujoco", "dm_control", "torch", "xarray", "zarr") if name in sys.modules]
    os.write(1, repr([text.strip(), heavy]).encode())
    os._exit(0)

sys.stderr.write = first
cli.main(["run", "--laps", "1"])
"""


def test_first_line_before_imports(tmp_path: Path) -> None:
    """Where nothing was compiled yet, a run says so before it imports Numba and MuJoCo, which takes seconds."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    command = [sys.executable, "-c", EARLY]
    out = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    said = "mrctl: compiling the laws that this needs for the first time, up to half a minute"
    assert out.stdout == repr([said, []]), out


IMPORTED = (
    "mrctl.cli", "pydantic", "tyro", "numpy", "mrctl.scenario", "xarray", "numba", "mujoco", "mrctl.loop.simulation",
)  # fmt: skip
TREATMENTS = "nullcontext()", "suppress(KeyboardInterrupt)"
# A program that forks where it imports one of the modules. The fork goes on as the program, and is interrupted there.
INTERRUPTED = f"""
import contextlib, json, os, signal, sys

program, left, ends = os.getpid(), {[*IMPORTED]!r}, []

class Interrupt:
    def find_spec(self, name, path=None, target=None):
        if name not in left or os.getpid() != program:
            return
        left.remove(name)
        for treatment in {TREATMENTS!r}:
            reader, writer = os.pipe()
            if not (fork := os.fork()):
                os.close(reader)
                os.dup2(writer, 2)
                os.close(writer)
                with eval("contextlib." + treatment):
                    signal.raise_signal(signal.SIGINT)
                return
            os.close(writer)
            with open(reader) as errors:
                said = errors.read()
            ends.append((name, treatment, os.waitstatus_to_exitcode(os.waitpid(fork, 0)[1]), said))
        if not left:
            print(json.dumps(ends), flush=True)
            os._exit(0)

sys.meta_path.insert(0, Interrupt())
from mrctl.__main__ import main
sys.argv = ["mrctl", "run", "--laps", "1", "--learner", "none"]
sys.exit(main())
"""


@pytest.fixture(scope="module")
def interrupted() -> dict[tuple[str, str], tuple[int, str]]:
    """Exit status and stderr of a command that was interrupted, by the module that it imported and the treatment."""
    out = subprocess.run([sys.executable, "-c", INTERRUPTED], capture_output=True, text=True, check=False)
    assert out.returncode == 0, out
    ends = json.loads(out.stdout.splitlines()[-1])  # after what forks say that nothing interrupts
    return {(name, treatment): (status, said) for name, treatment, status, said in ends}


@pytest.mark.xdist_group("interrupted")  # whose outcomes are computed once
@pytest.mark.parametrize("treatment", TREATMENTS)
@pytest.mark.parametrize("name", IMPORTED)
def test_interrupt_while_importing(name: str, treatment: str, interrupted: dict) -> None:
    """Ctrl-C ends a command with one line, whatever it is importing, also where a library drops the exception."""
    assert interrupted[name, treatment] == (130, "mrctl: interrupted\n")


@pytest.mark.parametrize("wait", [0.05, 0.2, 0.5, 1.0, 2.0])
def test_interrupt_of_a_program(wait: float) -> None:
    """Ctrl-C at any moment after the program has begun; until then Python has no handler and ends without a word."""
    code = "from mrctl.__main__ import main; print(flush=True); raise SystemExit(main())"
    command = [sys.executable, "-c", code, "run", "--learner", "none", "--laps", "200"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as program:
        assert program.stdout and program.stdout.readline()
        time.sleep(wait)
        program.send_signal(signal.SIGINT)
        said = program.communicate()[1]
    # The announcement of a compilation may stand before it.
    assert program.returncode == 130 and said.splitlines()[-1] == "mrctl: interrupted"
    assert "Traceback" not in said


def check_interrupted(command: str, folder: Path) -> None:
    """Checks that `python -m mrctl` ends as interrupted, with one line, if its command is this expression."""
    (folder / "sitecustomize.py").write_text(
        "import os, signal, sys, types\n"
        "sys.modules['mrctl.cli'] = cli = types.ModuleType('mrctl.cli')\n"
        f"cli.main = lambda: {command}\n"
    )
    paths = os.environ | {"PYTHONPATH": str(folder)}
    ended = subprocess.run([sys.executable, "-m", "mrctl"], env=paths, capture_output=True, text=True)
    assert (ended.returncode, ended.stderr) == (130, "mrctl: interrupted\n")


ASKS = """
import os, signal, sys, time
from subprocess import PIPE, Popen

ASKED = "import os, signal, time; input(); os.kill(os.getppid(), signal.SIGINT); time.sleep(0.3); print(3)"

def version():
    process = Popen([sys.executable, "-c", ASKED], stdin=PIPE, stdout=PIPE, text=True)
    return process.communicate("name")

version()
"""


def test_interrupt_of_a_program_that_an_import_began(tmp_path: Path) -> None:
    """Ctrl-C while a library that is being imported asks a program of its own, as glfw does, gives one line too."""
    (tmp_path / "asks.py").write_text(ASKS)
    check_interrupted("__import__('asks')", tmp_path)


CALLED_BACK = """
import ctypes, os, signal, sys, time, types

def main():
    called = ctypes.CFUNCTYPE(None)(lambda: os.kill(os.getpid(), signal.SIGINT))
    called()  # ctypes drops what its callback raises
    time.sleep(5)
    return 0

sys.modules["mrctl.cli"] = cli = types.ModuleType("mrctl.cli")
cli.main = main
from mrctl.__main__ import main
sys.exit(main())
"""


def test_interrupt_that_was_lost() -> None:
    """Ctrl-C while compiled code calls Python, which LLVM does when numba loads a law, ends the program too."""
    out = subprocess.run([sys.executable, "-c", CALLED_BACK], capture_output=True, text=True, check=False)
    assert (out.returncode, out.stderr) == (130, "mrctl: interrupted\n"), out


def test_interrupt_of_a_string_of_code(tmp_path: Path) -> None:
    """Ctrl-C in code that a library runs from a string, as dataclasses do, ends `python -m mrctl` with the status too.

    Python would end by the signal, which `subprocess` reports as −2.
    """
    check_interrupted("exec('os.kill(os.getpid(), signal.SIGINT); [None for _ in range(10**6)]')", tmp_path)
