"""Where jobs are computed: processes on this machine, or a Dask cluster. A pool outlives the death of its workers."""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, ThreadPoolExecutor
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from queue import Empty, SimpleQueue
from typing import Any, NamedTuple, Protocol

from mrctl.record import InputError

PATIENCE = 30.0  # s, for a scheduler and its first worker


class Outcome(NamedTuple):
    """What became of a job."""

    job: int
    failed: int = 0
    """Runs that failed."""
    error: str = ""
    """Why there is no result, or ""."""
    fatal: bool = False
    """Whether nothing else would fare better: a full disk, other versions."""


Work = Callable[[str, int], Outcome]
"""Computes a job of the store at a path, in a worker."""


class Pool(Protocol):
    """Computes jobs, a few at a time.

    Attributes:
        tries: How often a job whose worker dies is given to it.
    """

    tries: int

    def room(self) -> int:
        """How many jobs make all workers busy."""
        ...

    def submit(self, job: int) -> None:
        """Starts a job."""
        ...

    def wait(self) -> list[Outcome]:
        """Waits until a job has ended, and says how."""
        ...

    def close(self) -> None:
        """Stops at once; jobs under way are lost."""
        ...


class Processes:
    """Workers on this machine, each a process with one job at a time, so that its death is that job's alone."""

    tries = 3

    def __init__(self, work: Work, path: str, workers: int) -> None:
        """Takes what to do, for which store, and how many processes."""
        self._work, self._path, self._workers = work, path, workers
        # Workers are forked from a process that has the imports behind it and no threads.
        self._context = multiprocessing.get_context("forkserver")
        self._context.set_forkserver_preload(["mrctl.sweep.jobs"])
        self._idle: list[tuple[BaseProcess, Connection]] = []
        self._busy: dict[Connection, tuple[BaseProcess, int]] = {}

    def room(self) -> int:
        """The number of processes."""
        return self._workers

    def submit(self, job: int) -> None:
        """Gives a job to an idle process, or to a new one."""
        process, pipe = self._idle.pop() if self._idle else self._start()
        self._busy[pipe] = process, job
        with contextlib.suppress(OSError):  # died idle: `wait` will see it
            pipe.send(job)

    def _start(self) -> tuple[BaseProcess, Connection]:
        ours, theirs = self._context.Pipe()
        process = self._context.Process(target=_serve, args=(self._work, self._path, theirs), daemon=True)
        with _uninterrupted():
            process.start()
        theirs.close()
        return process, ours

    def wait(self) -> list[Outcome]:
        """Waits for an answer, or for a pipe that breaks with its process."""
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
                outcomes.append(Outcome(job, error=f"its worker died ({how})"))
        return outcomes

    def close(self) -> None:
        """Kills the processes."""
        for process, pipe in [*self._idle, *((process, pipe) for pipe, (process, _) in self._busy.items())]:
            process.kill()
            process.join()
            pipe.close()
        self._idle, self._busy = [], {}


@contextlib.contextmanager
def _uninterrupted() -> Iterator[None]:
    """Puts Ctrl-C off, which would leave half a process behind, and keeps it from the children, who inherit the mask.

    To block it is not enough: the system may hand it to a thread that does not, and Python then raises it here.
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
    """A worker: jobs in, outcomes out, until the other side is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    multiprocessing.set_start_method("fork", force=True)  # libraries make locks; of this kind none outlives a kill
    if parent := multiprocessing.parent_process():
        threading.Thread(target=_follow, args=(parent.sentinel,), daemon=True).start()
    with contextlib.suppress(EOFError, OSError):
        while True:
            pipe.send(work(path, pipe.recv()))


def _follow(sentinel: int) -> None:
    """Ends this process with its parent, also in the middle of a job."""
    wait([sentinel])
    os._exit(1)


class Cluster:
    """A Dask cluster that somebody else has started; every machine sees the store at the same path."""

    tries = 2  # the scheduler itself lets a job kill four workers each time

    def __init__(self, work: Work, path: str, address: str) -> None:
        """Connects to a scheduler and waits for its first worker.

        Raises:
            InputError: Dask is not installed, or there is no scheduler or no worker.
        """
        try:
            import distributed
        except ImportError:
            raise InputError("scheduler: needs Dask: pip install 'mrctl[dask]'") from None
        for name in [*logging.root.manager.loggerDict]:  # what matters of it arrives as an exception
            if name.startswith(("distributed", "tornado", "asyncio")):
                logging.getLogger(name).setLevel(logging.CRITICAL)
        self._distributed, self._work, self._path, self._address = distributed, work, path, address
        self._jobs: dict[Any, int] = {}
        self._ended: SimpleQueue[Any] = SimpleQueue()
        self._thread = ThreadPoolExecutor(1)
        try:
            self._client = distributed.Client(address, timeout=PATIENCE, set_as_default=False)
        except (OSError, ValueError) as error:
            raise InputError(f"scheduler: {address}: {' '.join(str(error).split()) or 'no answer'}") from None
        try:
            self._client.wait_for_workers(1, timeout=PATIENCE)
        except TimeoutError:
            self.close()
            raise InputError(f"scheduler: {address}: has no workers") from None

    def _call(self, function: Callable[..., Any], *args: object) -> Any:  # noqa: ANN401
        """Asks the cluster from another thread, for Dask takes an interruption of its own waiting badly.

        Raises:
            InputError: The scheduler is gone.
        """
        try:
            return self._thread.submit(function, *args).result()
        except (OSError, CancelledError):
            raise InputError(f"scheduler: {self._address}: the connection is lost; what was done is kept") from None

    def room(self) -> int:
        """The threads of all workers there are now."""
        return max(1, sum(self._call(self._client.nthreads).values()))

    def submit(self, job: int) -> None:
        """Hands a job to the scheduler, which gives it to another worker when one dies."""
        future = self._client.submit(self._work, self._path, job, pure=False)
        self._jobs[future] = job
        future.add_done_callback(self._ended.put)

    def wait(self) -> list[Outcome]:
        """Waits for a future."""
        while True:
            with contextlib.suppress(Empty):
                future = self._ended.get(timeout=5)
                return [self._call(self._outcome, future, self._jobs.pop(future))]
            self.room()  # there is still somebody

    def _outcome(self, future: Any, job: int) -> Outcome:  # noqa: ANN401
        if future.status == "cancelled":
            raise CancelledError
        error = future.exception()
        if error is None:
            return future.result()
        if isinstance(error, self._distributed.KilledWorker):
            return Outcome(job, error="its worker died, again and again")
        return Outcome(job, error=" ".join(f"{type(error).__name__}: {error}".split()))

    def close(self) -> None:
        """Gives up what is under way and disconnects; the cluster lives on."""
        jobs, self._jobs = list(self._jobs), {}
        with contextlib.suppress(Exception):
            self._client.cancel(jobs, force=True)
        with contextlib.suppress(Exception):
            self._client.close()
        self._thread.shutdown(wait=False)
