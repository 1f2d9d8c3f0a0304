"""Kernels: an edited law reaches all that call it, and laws can be put in place."""

import ast
import gc
import importlib
import io
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
from numba import njit
from numba.core.caching import IndexDataCacheFile
from numba.core.errors import TypingError

import mrctl
from mrctl import Event, Line, Scenario, Sensing
from mrctl.envs.gym import TrackingEnv, TrackingVectorEnv
from mrctl.kernel import Held, Kernel, kernel, over_rows
from mrctl.loop.announcement import announced, called
from mrctl.loop.runs import run, simulate
from mrctl.loop.simulation import Simulation
from mrctl.physics.files import models_folder

PACKAGE = Path(mrctl.__file__).parent
FEEDFORWARDS = ("model", "observer", "composite")  # that call `features`, one that does, and `regressors`, that does
# Asks the feedforwards of each copy whose folder it reads in a fork of its own; what mrctl imports is there already.
FORKS = """
import os
import sys

import dm_control.mjcf, numba, numpy, pydantic, scipy.optimize, xarray

assert "mrctl" not in sys.modules
for folder in sys.stdin:
    if not (fork := os.fork()):
        break
    if os.waitpid(fork, 0)[1]:
        print("failed", flush=True)
else:
    sys.exit()
os.chdir(folder.rstrip())
sys.path.insert(0, os.getcwd())

import gc

import numpy as np

import mrctl
from mrctl import Scenario
from mrctl.kernel import Kernel
from mrctl.loop.hierarchy import Hierarchy
from mrctl.physics import mjcf

names = sys.argv[1:]
robot = mjcf.build()[1]
twist, rate = np.array([[0.5, 0.8]]), np.array([[0.3, -0.2]])
voltages = {}
for name in names:
    hierarchy = Hierarchy([Scenario(prior="model", learner="none" if name == "model" else name)], robot)
    stage = hierarchy.learner
    if name != "model":
        stage.rows[{"composite": "a", "observer": "disturbance"}[name]] = 0.1
    if name == "observer":  # its own law, not the model that it contains
        for _ in range(3):
            stage.learn(rate, np.zeros(1), twist, rate)
        voltages[name] = stage.rows["disturbance"].copy()
    else:
        voltages[name] = (hierarchy.prior if name == "model" else stage).output(twist, rate).copy()
np.savez("voltages.npz", **voltages)
kernels = [k for k in gc.get_objects() if type(k) is Kernel]
compiled = [vars(k)[name] for k in kernels for name in ("compiled", "inlined") if name in vars(k)]
hits, misses = (sum(sum(getattr(c.stats, name).values()) for c in compiled) for name in ("cache_hits", "cache_misses"))
print(mrctl.__file__, hits, misses)
"""


@kernel
def root(number: float) -> float:
    """Returns the square root."""
    if number < 0:
        raise ValueError("negative")
    return np.sqrt(number)


@kernel
def sum_of_roots(numbers: np.ndarray) -> float:
    """Adds the square roots of all numbers, the last one first."""
    return root(numbers[-1]) + sum_of_roots(numbers[:-1]) if len(numbers) else 0.0


@kernel
def gathered(factor: float, row: object, sums: np.ndarray) -> bool:
    """Adds the gathered place of a record to the sums."""
    for k in range(2):
        sums[k] += factor * row[0].place[k]
    if not sums[0] >= 0:
        raise ValueError("negative")
    return sums[0] > 1


def test_repeated():
    """What is called repeatedly gives the answers, effects and errors of the compiled function, from the first call."""
    row = np.zeros(1, [("name", "i8"), ("place", "f8", 2)])
    again, sums, expected = gathered.repeated(), np.zeros(2), np.zeros(2)
    for factor in (0.5, 0.25, 2, np.float64(0.125)):
        row["place"] += 0.75
        assert again(float(factor), row, sums) is gathered.compiled(float(factor), row, expected)
        assert np.array_equal(sums, expected)
    with pytest.raises(ValueError, match="negative"):
        again(-100.0, row, sums)
    with pytest.raises(TypeError):
        again(1.0, row)
    with pytest.raises(TypeError):  # records of another size are noticed, others with the same size are not
        again(1.0, np.zeros(1), sums)


def held(place):
    """The arrays of `turned`; the reader of a `Held` replaces it."""


@kernel
def turned(factor: float, place: int) -> None:
    """Writes a matrix times a factor, with its axes exchanged, to the places of records."""
    matrix, rows = held(place)
    for k in range(2):
        for i in range(len(rows)):
            rows[i].place[k] = factor * matrix[k, i]


@pytest.mark.parametrize("size", [1, 3])
def test_held(size):
    """A kernel finds arrays where they are, also views that are not contiguous, and what is written to them later."""
    whole, rows = np.arange(4.0 * size).reshape(size, 4), np.zeros(size, [("name", "i8"), ("place", "f8", 2)])
    matrix = whole[:, 1:3].T
    arrays = Held(matrix, rows)
    law = turned.calling(held=arrays.reader).repeated()
    for factor in (0.5, -3.0):
        law(factor, arrays.place)
        assert np.array_equal(rows["place"], factor * whole[:, 1:3])
        whole += 1.0


def checked(self):
    """In place of `Kernel.repeated`: calls that notice whether their callers keep the promise."""
    first = []

    def call(*arguments):
        types = [self.compiled.typeof_pyval(argument) for argument in arguments]
        first[:] = first or types
        assert types == first, self.__name__
        return self.compiled(*arguments)

    return call


def test_promise_of_repeated(monkeypatch):
    """All that a tick calls repeatedly gets arguments of the same types: one robot, several, restarts, new courses."""
    monkeypatch.setattr(Kernel, "repeated", checked)
    here, there = Line(length=0.4), Line(speed=0.4, length=0.4)
    turn = Event(time=0.25, reference=there)
    for tier in ("ideal", "lab"):
        common = {"laps": 1, "learner": "fel", "sensing": Sensing(tier=tier)}
        several = [
            Scenario(reference=reference, seed=seed, events=events, **common)
            for seed, (reference, events) in enumerate([(here, ()), (here, ()), (here, (turn,))])
        ]
        for group in (several[:1], several[2:], several[:2], several):
            simulate(group)
        simulate([scenario.replace(goal=(0.4, 0.0, 0.0)) for scenario in several[:2]])
        added = Simulation(several)
        run([added], ticks=20)
        added.add(Event(time=0.4, reference=there))
        run([added])
        if tier == "ideal":
            continue
        vector = TrackingVectorEnv(3, Scenario(reference=Line(speed=0.5, length=0.3), **common))
        vector.reset(seed=0)
        ends = sum(vector.step(np.zeros((3, 2)))[3].sum() for _ in range(150))
        assert ends >= 3
        one = TrackingEnv(Scenario(reference=Line(speed=0.5, length=0.3), **common))
        for seed in range(2):
            one.reset(seed=seed)
            for _ in range(10):
                one.step(np.zeros(2))


class Copy:
    """A copy of the package and its models, without caches."""

    def __init__(self, folder):
        self.folder = folder
        shutil.copytree(PACKAGE, folder / "mrctl", ignore=shutil.ignore_patterns("__pycache__"))
        shutil.copytree(models_folder(), folder / "models")

    def edit_features(self):
        """Makes the first feature half as large again."""
        file = self.folder / "mrctl" / "control" / "features.py"
        text = file.read_text()
        assert text.count("x[0] = v / scale[0]") == 1
        file.write_text(text.replace("x[0] = v / scale[0]", "x[0] = 1.5 * v / scale[0]"))

    def voltages(self, interpreter):
        """Voltages by feedforward as bytes, and how often machine code was found on disk and was not."""
        print(self.folder, file=interpreter.stdin, flush=True)
        file, hits, misses = interpreter.stdout.readline().split()
        assert file == str(self.folder / "mrctl" / "__init__.py")
        with np.load(self.folder / "voltages.npz") as voltages:
            return {name: voltages[name].tobytes() for name in FEEDFORWARDS}, int(hits), int(misses)


@pytest.fixture
def interpreter():
    """A process that has imported what mrctl is built on, and forks to ask the feedforwards of a copy."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("NUMBA_")}
    environment |= {"PYTHONPATH": "", "NUMBA_NUM_THREADS": "1"}
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen([sys.executable, "-c", FORKS, *FEEDFORWARDS], env=environment, **pipes) as process:
        yield process


def test_edited_law(tmp_path, interpreter):
    """With `features` edited, every feedforward, all in other files, answers as if nothing had been compiled before."""
    used, fresh = Copy(tmp_path / "used"), Copy(tmp_path / "fresh")
    before, hits, misses = used.voltages(interpreter)
    assert hits == 0 < misses
    again, hits, misses = used.voltages(interpreter)
    assert again == before
    assert misses == 0 < hits
    for copy in (used, fresh):
        copy.edit_features()
    after, hits, _ = used.voltages(interpreter)
    assert hits == 0
    expected, _, _ = fresh.voltages(interpreter)
    for name in FEEDFORWARDS:
        assert after[name] != before[name], name
        assert after[name] == expected[name], name


def kernel_files():
    """Modules of the package that hold a kernel."""
    return [path for path in sorted(PACKAGE.rglob("*.py")) if re.search(r"^@kernel$", path.read_text(), re.MULTILINE)]


@kernel
def double(x):
    """Twice x."""
    return 2 * x


@kernel
def triple(x):
    """Three times x."""
    return 3 * x


@kernel
def through(x):
    """What `inner` makes of x."""
    return inner(x)  # noqa: F821


@kernel
def total(x):
    """What `law` makes of the sum of x."""
    return law(x.sum())


law = inner = double


def test_kernel_in_kernel():
    """A kernel that another one takes in can fail, call itself and be called from Python; the garbage collector stays.

    It is off while Numba compiles.
    """
    for _ in range(2):
        assert root(2.25) == 1.5 and sum_of_roots(np.array([1.0, 4.0, 9.0])) == 6.0
        with pytest.raises(ValueError, match="negative"):
            sum_of_roots(np.array([1.0, -4.0, 9.0]))
    assert sum_of_roots.law(np.array([1.0, 4.0])) == 3.0 and gc.isenabled()
    with pytest.raises(TypingError):
        root("4")
    assert gc.isenabled()
    gc.disable()
    try:
        root(4)
        assert not gc.isenabled()
    finally:
        gc.enable()


def test_calling():
    """Other kernels take the place of a global name, also within one that is put in place; the template stays."""
    x = np.array([1.0, 2.0, 4.0])
    laws = {"double": double, "triple": triple}
    templates = [total, total.calling(law=triple), total.calling(law=double)]
    templates += [total.calling(law=through.calling(inner=law)) for law in laws.values()]
    assert [template(x) for template in templates] == [14, 21, 14, 14, 21]
    assert total.calling(law=triple).__name__ == "total"


@kernel
def scaled(x, factor, s, out):
    """A law with a vector, a number, a record, and a result."""
    s.calls += 1
    for k in range(len(x)):
        out[k] = factor * x[k] + s.offset


@pytest.mark.parametrize("factor", [2.0, np.array([1.0, 2.0, -3.0])])
def test_over_rows(factor):
    """Arrays are passed row by row, numbers as they are, and records are written in place."""
    x, out = np.arange(6.0).reshape(3, 2), np.zeros((3, 2))
    records = np.zeros(3, [("offset", "f8"), ("calls", "i8")])
    records["offset"] = 10, 20, 30
    over_rows(scaled, x, factor, records, out)
    np.testing.assert_array_equal(out, np.reshape(factor, (-1, 1)) * x + records["offset"][:, None])
    assert records["calls"].tolist() == [1, 1, 1]


class Module:
    """Constants of one file of the package, by name."""

    def __init__(self, path):
        self.path, tree = path, ast.parse(path.read_text())
        self.imports, self.constants, self.kernels = {}, {}, []
        for node in tree.body:
            if isinstance(node, ast.ImportFrom):
                self.imports |= {alias.asname or alias.name: (node.module, alias.name) for alias in node.names}
            elif isinstance(node, (ast.Assign, ast.AnnAssign)):
                self.constants |= {n.id: node.value for n in ast.walk(node) if stored(n)}
            elif isinstance(node, ast.FunctionDef) and any(ast.unparse(d) == "kernel" for d in node.decorator_list):
                self.kernels.append(node)

    def sources(self, name):
        """Where a constant is written, and all that it is computed from."""
        if name in self.constants:
            used = [n.id for n in ast.walk(self.constants[name]) if isinstance(n, ast.Name) and n.id.isupper()]
            return {self.path}.union(*(self.sources(other) for other in used))
        module, original = self.imports[name]
        path = PACKAGE.joinpath(*module.split(".")[1:]).with_suffix(".py")
        return Module(path).sources(original)


def stored(node):
    """Whether a node is a name that gets a value."""
    return isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)


def constants_in(function):
    """Upper-case names of a kernel that are not its own, of which none may be that of another module's attribute."""
    body = [node for statement in function.body for node in ast.walk(statement)]
    own = {argument.arg for argument in function.args.args} | {node.id for node in body if stored(node)}
    used = {node.id for node in body if isinstance(node, ast.Name)} - own
    for node in body:
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.attr.isupper():
            assert node.value.id in own, f"{function.name}: {ast.unparse(node)}"
    return {name for name in used if name.isupper()}


def test_constants_of_kernels():
    """Every constant that a kernel is compiled with is in a file whose edits are noticed: one that holds a kernel."""
    files = kernel_files()
    found = {}
    for path in files:
        module = Module(path)
        assert module.kernels
        for function in module.kernels:
            for name in constants_in(function):
                found[path.stem, function.name, name] = module.sources(name)
    assert {("fel", "network", "HIDDEN_GAIN"), ("fel", "network", "FEATURES")} <= found.keys()
    assert found["steering", "allocate", "SIGN_SPEED"] == {PACKAGE / "control" / "features.py"}
    for place, sources in found.items():
        assert sources <= set(files), place


def test_compilation_is_announced_once(capsys):
    """Whoever waits for a first simulation reads why, once in a process."""
    Simulation([mrctl.Scenario(laps=1)])
    announced().said = False
    capsys.readouterr()
    for _ in range(2):
        njit(lambda x: x + 1.0)(1.0)
    said = "mrctl: compiling the laws that this needs for the first time, up to half a minute\n"
    assert capsys.readouterr().err == said


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_a_terminal_sees_a_bar(tmp_path, monkeypatch):
    """The bar counts a law and those that it calls, each once, though one of them is compiled for two types."""
    (tmp_path / "three_laws.py").write_text(
        "from mrctl.kernel import kernel\n\n"
        "@kernel\ndef inner(x):\n    return x + 1\n\n"
        "@kernel\ndef middle(x):\n    return inner(x)\n\n"
        "@kernel\ndef outer(x):\n    return middle(x) + inner(2)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    three = importlib.import_module("three_laws")
    assert called(three.outer.law) == {f"three_laws.{name}" for name in ("inner", "middle", "outer")}
    announced()
    monkeypatch.setattr(sys, "stderr", shown := Terminal())
    assert three.outer(1.0) == 5.0
    bar = announced().bar
    assert (bar.n, bar.total) == (3, 3) and "\rthree_laws.outer:   0%" in shown.getvalue()


def test_full_disk(monkeypatch):
    """A law that cannot be kept on disk is compiled and computes all the same."""
    monkeypatch.setattr(IndexDataCacheFile, "save", mock.Mock(side_effect=OSError(28, "No space left on device")))

    @kernel
    def doubled(number):
        return 2 * number

    with pytest.warns(UserWarning, match="cannot be kept on disk.*No space left"):
        assert doubled.compiled(2.0) == 4
