"""Fixtures for every test."""

import gc
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator

import pytest
from hypothesis import settings

# The workers of pytest-xdist, which inherit these, use all cores. Threads of BLAS and torch would have to wait for each
# other there: an exponential of a 2 × 2 matrix took 3 ms instead of 0.02. NumPy is imported by the modules below.
for threads in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(threads, "1")

from mrctl.kernel import kernel_files_digest  # noqa: E402
from mrctl.theory.robot import Robot  # noqa: E402

# A shell lets what runs in its background ignore Ctrl-C, and all processes that the tests start would inherit that.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Python's garbage collector took an eighth of the time of all tests.
gc.set_threshold(50_000, 20, 100)

COMPILE = """
import sys

from mrctl import Line, Scenario, per_lap, simulate

for name in sys.argv[1:]:
    runs = [Scenario(reference=Line(length=0.8), laps=1, prior="model", learner=name, seed=seed) for seed in range(2)]
    per_lap(simulate(runs))
"""
COMPILE_MISSIONS = """
from mrctl import Disc, Obstacles, Scenario, simulate
from mrctl.navigation.generators import Task
from mrctl.navigation.avoiders import avoiding
from mrctl.navigation.planning import prepared

task = Task(obstacles=Obstacles(shapes=(Disc(y=1.5),)), start=(0, 0, 0), goal=(1, 0, 0))
for avoid, localisation in (("window", "scan"), ("mppi", "particles")):
    own = Scenario.from_dict({"prior": "model", "learner": "none", "sensing": {"localisation": localisation}})
    simulate(prepared(task, own, avoid=avoid)[1], motion=avoiding(avoid))
"""

# The same examples for everyone, no deadline (shared machines stall); `--hypothesis-profile=explore` looks further.
settings.register_profile("mrctl", deadline=None, derandomize=True, max_examples=50)
settings.register_profile("explore", deadline=None, print_blob=True, max_examples=1000)
settings.load_profile("mrctl")


@pytest.fixture(scope="session")
def robot() -> Robot:
    """The default robot of the documentation, written out: tests of the laws need no MuJoCo."""
    return Robot(
        mass=20, yaw_inertia=0.6, com_offset=0.1, com_height=0.12,
        wheel_radius=0.098, front_wheel_radius=0.075, half_track=0.188,
        wheelbase=0.4, trail=0.03, steering_limit=1.0472,
        resistance=2.32, inductance=0, torque_constant=0.0234, gear_ratio=43, rotor_inertia=1.03e-6,
        no_load_current=0.037, gear_loss=0.1, rolling_coefficient=0.015, wheel_inertia=3.4e-3, front_wheel_inertia=1e-3,
        supply=24, tyre_friction=0.9, max_speed=1.5, max_rotation=3, max_acceleration=1.5, max_rotation_acceleration=6,
    )  # fmt: skip


@pytest.fixture
def no_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """A command writes everything but its figures, which take seconds, for tests that do not look at them."""
    monkeypatch.setattr("mrctl.results.plots.save", lambda *_: [])


class Here:
    """Computes the jobs of a sweep in this process, which has the laws in memory already."""

    tries = 1

    def __init__(self, work: Callable, path: str, _: int) -> None:
        self._work, self._path, self._job = work, path, -1

    def room(self) -> int:
        """One job after the other."""
        return 1

    def submit(self, job: int) -> None:
        """Keeps the number of the job."""
        self._job = job

    def wait(self) -> list:
        """Computes the job."""
        return [self._work(self._path, self._job)]

    def close(self) -> None:
        """Nothing is left to stop."""


@pytest.fixture
def here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Computes sweeps in the test process; that worker processes compute the same is tested in test_sweeps.py."""
    monkeypatch.setattr("mrctl.sweep.jobs.Processes", Here)


@pytest.fixture(scope="module")
def here_throughout() -> Iterator[None]:
    """The same for all tests of a module, and for what they share."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("mrctl.sweep.jobs.Processes", Here)
        yield


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Marks what runs the whole system, so that `pytest -m "not system"` is a quick loop for developers.

    Tests of the mark `full` are left out, unless `-m` asks for them. Groups, which one worker runs, come first, so that
    no worker is left alone with one in the end.
    """
    for item in items:
        if "system" in item.path.parts:
            item.add_marker("system")
    if "full" not in config.option.markexpr:
        left_out = [item for item in items if item.get_closest_marker("full")]
        items[:] = [item for item in items if item not in left_out]
        config.hook.pytest_deselected(items=left_out)
    items.sort(key=lambda item: item.get_closest_marker("xdist_group") is None)


def pytest_collection_finish(session: pytest.Session) -> None:
    """Keeps the garbage collector from what is there for good."""
    gc.freeze()


@pytest.hookimpl(tryfirst=True)
def pytest_sessionstart(session: pytest.Session) -> None:
    """Compiles the laws once for all workers and what they start, where a law has changed since the last session."""
    cache, digest = getattr(session.config, "cache", None), kernel_files_digest()
    if hasattr(session.config, "workerinput") or cache is None or cache.get("mrctl/compiled", "") == digest:
        return
    halves = ("fel", "none", "rls", "l1"), ("composite", "observer", "indi", "mrac")
    commands = [*([COMPILE, *names] for names in halves), [COMPILE_MISSIONS]]
    processes = [subprocess.Popen([sys.executable, "-c", *command]) for command in commands]
    if not any(process.wait() for process in processes):
        cache.set("mrctl/compiled", digest)
