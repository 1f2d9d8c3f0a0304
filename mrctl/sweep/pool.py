"""Pools of workers that compute jobs: processes on this machine, or a Dask cluster. A pool outlives its workers."""

from __future__ import annotations

import contextlib
import gc
import logging
import multiprocessing
import os
import re
import signal
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import CancelledError, ThreadPoolExecutor
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from queue import Empty, SimpleQueue
from typing import Any, NamedTuple, Protocol

from mrctl.record import InputError

KILL_PAUSE = 1.0  # s until a killed process has ended on a busy machine
SCHEDULER_PATIENCE = 30.0  # s to wait for a scheduler and its first worker
PRELOADED = "numba", "scipy.optimize", "dask.array"  # imported in a worker's first run; xarray looks for Dask's arrays


class JobOutcome(NamedTuple):
    """How a job ended."""

    job: int
    failed: int = 0
    """Number of runs that failed."""
    error: str = ""
    """Why the job has no result, or ""."""
    fatal: bool = False
    """Whether every other job would end the same way, because the disk is full or the versions differ."""
    final: bool = False
    """Whether the job would end the same way another time."""
    value: Any = None
    """What the job returns, where it does not write it to a store."""


Work = Callable[[str, int], JobOutcome]
"""Function that computes a job in a worker, from the path of the store and the number of the job."""


class Pool(Protocol):
    """Computes jobs, a few at a time.

    Attributes:
        tries: Number of times that a job is computed whose worker dies or that raises an error.
    """

    tries: int

    def room(self) -> int:
        """Returns the number of jobs that keep all workers busy."""
        ...

    def submit(self, job: int) -> None:
        """Starts a job."""
        ...

    def wait(self) -> list[JobOutcome]:
        """Waits until at least one job has ended; returns the outcomes."""
        ...

    def close(self) -> None:
        """Stops at once; jobs under way are lost."""
        ...


def carry_out(pool: Pool, jobs: Iterable[int], ended: Callable[[JobOutcome], None]) -> dict[int, str]:
    """Lets a pool compute jobs; returns why some were set aside, by job.

    A job that kills its worker or raises an error is tried again after the others, alone, before it is set aside,
    unless its outcome is final.

    Args:
        pool: The pool.
        jobs: Numbers of the jobs.
        ended: Is called with the last outcome of each job as it comes.

    Raises:
        InputError: An outcome is fatal.
    """
    fresh, again = deque(jobs), deque[int]()
    tries, aside, flying = Counter[int](), dict[int, str](), 0
    while fresh or again or flying:
        room = pool.room()
        while (fresh and flying < room) or (again and not fresh and not flying):
            pool.submit((fresh or again).popleft())
            flying += 1
        for outcome in pool.wait():
            flying -= 1
            tries[outcome.job] += 1
            if outcome.fatal:
                raise InputError(f"{outcome.error}; what was done is kept")
            if outcome.error and not outcome.final and tries[outcome.job] < pool.tries:
                again.append(outcome.job)
                continue
            if outcome.error:
                aside[outcome.job] = outcome.error
            ended(outcome)
    return aside


class Processes:
    """Workers on this machine: processes with one job at a time, so that the death of one affects that job alone."""

    tries = 3

    def __init__(self, work: Work, path: str, workers: int) -> None:
        """Makes a pool of `workers` processes that do `work` for the store at `path`."""
        self._work, self._path, self._workers = work, path, workers
        # Workers are forked from a process that has done the imports and has no threads.
        self._context = multiprocessing.get_context("forkserver")
        self._context.set_forkserver_preload(["mrctl.sweep.jobs", *PRELOADED])
        self._idle: list[tuple[BaseProcess, Connection]] = []
        self._busy: dict[Connection, tuple[BaseProcess, int]] = {}

    def room(self) -> int:
        """Returns the number of processes."""
        return self._workers

    def submit(self, job: int) -> None:
        """Gives a job to an idle process, or to a new one."""
        process, pipe = self._idle.pop() if self._idle else self._start()
        self._busy[pipe] = process, job
        with contextlib.suppress(OSError):  # a worker that died while idle is noticed in `wait`
            pipe.send(job)

    def _start(self) -> tuple[BaseProcess, Connection]:
        """Starts a worker; if the process that forks workers is killed meanwhile, another one takes its place.

        Raises:
            InputError: Every such process is killed.
        """
        resource_tracker.ensure_running()  # here, because its start unblocks Ctrl-C
        for _ in range(self.tries):
            ours, theirs = self._context.Pipe()
            process = self._context.Process(target=_serve, args=(self._work, self._path, theirs), daemon=True)
            with theirs, contextlib.suppress(EOFError, OSError), _uninterrupted():
                process.start()
                return process, ours
            ours.close()
            time.sleep(KILL_PAUSE)
        raise InputError("workers: no process can be started; what was done is kept")

    def wait(self) -> list[JobOutcome]:
        """Waits for outcomes, or for pipes that break because their process died."""
        outcomes = []
        for pipe in wait(list(self._busy)):
            assert isinstance(pipe, Connection)
            process, job = self._busy.pop(pipe)
            try:
                outcomes.append(pipe.recv())
                self._idle.append((process, pipe))
            except (EOFError, OSError):
                process.join()
                pipe.close()
                code = process.exitcode or 0
                how = f"signal {-code}" if code < 0 else f"exit status {code}"
                outcomes.append(JobOutcome(job, error=f"its worker died ({how})"))
        return outcomes

    def close(self) -> None:
        """Kills all processes."""
        for process, pipe in [*self._idle, *((process, pipe) for pipe, (process, _) in self._busy.items())]:
            process.kill()
            process.join()
            pipe.close()
        self._idle, self._busy = [], {}


@contextlib.contextmanager
def _uninterrupted() -> Iterator[None]:
    """Defers Ctrl-C, which would leave a half-started process, and blocks it in children, which inherit the mask.

    Blocking the signal is not enough: the system may deliver it to another thread, and Python then raises it here.
    """
    pressed: list[int] = []
    main = threading.current_thread() is threading.main_thread()
    handler = signal.signal(signal.SIGINT, lambda number, _: pressed.append(number)) if main else None
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        if main:
            signal.signal(signal.SIGINT, handler)
    if pressed:
        raise KeyboardInterrupt


def _serve(work: Work, path: str, pipe: Connection) -> None:
    """Runs the loop of a worker: receives jobs and sends their outcomes until the pipe is closed."""
    gc.freeze()  # else the collector looks through all that was imported, again and again
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    logging.getLogger("absl").addFilter(lambda _: False)  # it warns of failing runs, whose failure says why
    multiprocessing.set_start_method("fork", force=True)  # locks of this method do not outlive a kill
    if parent := multiprocessing.parent_process():
        threading.Thread(target=_follow, args=(parent.sentinel,), daemon=True).start()
    with contextlib.suppress(EOFError, OSError):
        while True:
            pipe.send(work(path, pipe.recv()))


def _follow(sentinel: int) -> None:
    """Ends this process when its parent ends, even during a job."""
    wait([sentinel])
    os._exit(1)


def check_address(scheduler: str) -> None:
    """Checks that a text could be the address of a Dask scheduler.

    Raises:
        InputError: It could not.
    """
    if not re.fullmatch(r"\w+://.+:\d+", scheduler):
        raise InputError(f"scheduler: {scheduler!r} is no address such as tcp://127.0.0.1:8786")


class Cluster:
    """A Dask cluster that is running already; where jobs use a store, every machine must see it at the same path."""

    tries = 2  # in each of which the scheduler lets a job kill four workers

    def __init__(self, work: Work, path: str, address: str) -> None:
        """Connects to a scheduler and waits for its first worker.

        Raises:
            InputError: Dask is not installed, or no scheduler or no worker answers.
        """
        try:
            import distributed
        except ImportError:
            raise InputError("scheduler: needs Dask: pip install 'mrctl[dask]'") from None
        for name in [*logging.root.manager.loggerDict]:  # errors that matter arrive as exceptions
            if name.startswith(("distributed", "tornado", "asyncio")):
                logging.getLogger(name).setLevel(logging.CRITICAL)
        self._distributed, self._work, self._path, self._address = distributed, work, path, address
        self._jobs: dict[Any, int] = {}
        self._ended: SimpleQueue[Any] = SimpleQueue()
        self._thread = ThreadPoolExecutor(1)
        try:
            self._client = distributed.Client(address, timeout=SCHEDULER_PATIENCE, set_as_default=False)
        except (OSError, ValueError) as error:
            raise InputError(f"scheduler: {address}: {' '.join(str(error).split()) or 'no answer'}") from None
        try:
            self._client.wait_for_workers(1, timeout=SCHEDULER_PATIENCE)
        except TimeoutError:
            self.close()
            raise InputError(f"scheduler: {address}: has no workers") from None

    def _call(self, function: Callable[..., Any], *args: object) -> Any:  # noqa: ANN401
        """Calls the cluster from another thread, because Dask does not survive an interruption while it waits.

        Raises:
            InputError: The scheduler is gone.
        """
        try:
            return self._thread.submit(function, *args).result()
        except (OSError, CancelledError):
            raise InputError(f"scheduler: {self._address}: the connection is lost; what was done is kept") from None

    def room(self) -> int:
        """Returns the number of threads that all workers have at present."""
        return max(1, sum(self._call(self._client.nthreads).values()))

    def submit(self, job: int) -> None:
        """Gives a job to the scheduler, which gives it to another worker if the first one dies."""
        future = self._client.submit(self._work, self._path, job, pure=False)
        self._jobs[future] = job
        future.add_done_callback(self._ended.put)

    def wait(self) -> list[JobOutcome]:
        """Waits until a job has ended; returns its outcome."""
        while True:
            with contextlib.suppress(Empty):
                future = self._ended.get(timeout=5)
                return [self._call(self._outcome, future, self._jobs.pop(future))]
            self.room()  # raises an error if the scheduler is gone

    def _outcome(self, future: Any, job: int) -> JobOutcome:  # noqa: ANN401
        if future.status == "cancelled":
            raise CancelledError
        error = future.exception()
        if error is None:
            return future.result()
        if "deserializ" in str(error):
            why = f"scheduler: {self._address}: it or its workers have another version of mrctl"
            return JobOutcome(job, error=why, fatal=True)
        if isinstance(error, self._distributed.KilledWorker):
            return JobOutcome(job, error="its worker died repeatedly")
        return JobOutcome(job, error=" ".join(f"{type(error).__name__}: {error}".split()))

    def close(self) -> None:
        """Cancels jobs that are running and disconnects; the cluster keeps running."""
        jobs, self._jobs = list(self._jobs), {}
        with contextlib.suppress(Exception):
            self._client.cancel(jobs, force=True)
        with contextlib.suppress(Exception):
            self._client.close()
        self._thread.shutdown(wait=False)
