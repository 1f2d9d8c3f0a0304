"""A file that keeps results as they come, so that a command goes on where it stopped; other processes compute them."""

from __future__ import annotations

import json
import os
import pickle
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from tqdm import tqdm

from mrctl.loop.groups import cores
from mrctl.record import InputError
from mrctl.results.dataset import versions
from mrctl.sweep.jobs import code_digest
from mrctl.sweep.pool import Cluster, JobOutcome, Processes, carry_out, check_address

SHOWING_ROOMS = ("envs", "viewer", "cli", "__main__.py")  # rooms on which no experiment depends


class Computation(NamedTuple):
    """A part of an experiment."""

    key: object
    """Key of its result, of numbers, strings and lists."""
    compute: Callable[[], object]
    """Returns the result, of numbers, strings, lists and dictionaries, in one thread. Workers get it pickled."""


class Journal:
    """Results by key. Its file has a line of JSON for what all of them depend on, and then one for each result.

    JSON keeps every bit of a float, so that a command that goes on ends as one that was never stopped.

    Attributes:
        cores: Number of cores that compute results.
    """

    def __init__(
        self,
        file: Path,
        head: dict[str, Any],
        scheduler: str | None = None,
        origin: Callable[[], dict[str, str]] = dict,
    ) -> None:
        """Opens the file or begins it.

        Args:
            file: The file; an unfinished last line is dropped.
            head: Everything that the results depend on, but what `origin` returns and the Python code of mrctl, whose
                digest is added.
            scheduler: Address of a Dask scheduler whose workers compute results; by default processes on this machine
                do, one a core.
            origin: Returns what must be the same in this process and in the workers, which get it pickled, such as
                digests of files.

        Raises:
            InputError: The results in the file depend on something else, it cannot be read or written, or no scheduler
                answers.
        """
        self._scheduler, self._origin = scheduler, origin
        self.cores = cores() if scheduler is None else threads_of(scheduler)
        self._file, head = file, json.loads(json.dumps(head | origin() | {"code": code_digest(SHOWING_ROOMS)}))
        try:
            begun = file.read_text("utf-8") if file.exists() else ""
            first, *rest = [json.loads(line) for line in begun[: begun.rfind("\n") + 1].splitlines()] or [head]
            other = next((name for name in head if first.get(name) != head[name]), "" if first == head else "it")
            self._known = {json.dumps(line["key"]): line["value"] for line in rest}
        except OSError as error:
            raise InputError(f"out: {file}: {error.strerror}") from None
        except (ValueError, LookupError, TypeError, AttributeError):
            raise InputError(f"out: {file} is damaged; choose another folder") from None
        if other:
            raise InputError(f"out: {file} holds other results ({other} differs); choose another folder")
        whole = file.with_name(f".{file.name}.whole")  # which takes the place of the file at once, or not at all
        try:
            whole.write_text("".join(json.dumps(line) + "\n" for line in (first, *rest)), "utf-8")
            whole.replace(file)
        except OSError as error:
            raise InputError(f"out: {file}: {error.strerror}") from None

    def __contains__(self, key: object) -> bool:
        """Tells whether the result of a key, of numbers, strings, lists and dictionaries, is there."""
        return json.dumps(key) in self._known

    def __getitem__(self, key: object) -> Any:  # noqa: ANN401
        """Returns the result of a key.

        Raises:
            KeyError: There is none.
        """
        return self._known[json.dumps(key)]

    def __setitem__(self, key: object, value: object) -> None:
        """Keeps a result, of numbers, strings, lists and dictionaries."""
        line = json.dumps({"key": key, "value": value})
        with self._file.open("a", encoding="utf-8") as file:
            file.write(line + "\n")
        self._known[json.dumps(key)] = json.loads(line)["value"]

    def expected(self, seconds: float, parts: int) -> str:
        """Says how long computations take: seconds of one core in so many equal parts."""
        at_once = max(1, min(self.cores, parts))
        return f"about {max(1, round(seconds / at_once / 60))} min on {at_once} core{'s' * (at_once > 1)}"

    def results(self, parts: Sequence[Computation]) -> list[Any]:
        """Returns the results of computations; those that are missing are computed and kept, with a progress bar.

        Raises:
            InputError: A computation fails, the workers of the cluster have other code, or the scheduler is gone.
        """
        missing = [k for k, part in enumerate(parts) if part.key not in self]
        with tqdm(total=len(parts), initial=len(parts) - len(missing), unit="part") as bar:
            if missing:
                self._compute(parts, missing, bar)
        return [self[part.key] for part in parts]

    def _compute(self, parts: Sequence[Computation], missing: Sequence[int], bar: tqdm) -> None:
        """Has workers do computations, and keeps their results."""

        def ended(outcome: JobOutcome) -> None:
            if not outcome.error:
                self[parts[outcome.job].key] = outcome.value
                bar.update()

        here = versions() | self._origin() | {"code": code_digest(SHOWING_ROOMS)}
        work = Computing({k: pickle.dumps(parts[k].compute) for k in missing}, self._origin, here)
        if self._scheduler is None:
            pool = Processes(work, "", min(self.cores, len(missing)))
        else:
            pool = Cluster(work, "", self._scheduler)
        try:
            aside = carry_out(pool, missing, ended)
        finally:
            pool.close()
        if aside:
            k, why = min(aside.items())
            raise InputError(f"{json.dumps(parts[k].key)} failed: {why}; what was done is kept")


def threads_of(scheduler: str) -> int:
    """Returns the number of threads of the workers of a Dask scheduler.

    Raises:
        InputError: No scheduler or no worker answers.
    """
    check_address(scheduler)
    pool = Cluster(Computing({}, dict, {}), "", scheduler)
    try:
        return pool.room()
    finally:
        pool.close()


class Computing(NamedTuple):
    """What a worker does; it has to have the versions, the code and the files of the process that asks."""

    computed: dict[int, bytes]
    """Pickled `Computation.compute`, by number of the job; unpickled after the check below alone."""
    origin: Callable[[], dict[str, str]]
    """As for `Journal`."""
    there: dict[str, str]
    """Versions of the packages of the process that asks, what `origin` returned there, and the digest of its code."""

    def __call__(self, _: str, job: int) -> JobOutcome:
        """Does a computation."""
        here = versions() | self.origin() | {"code": code_digest(SHOWING_ROOMS)}
        if other := next((name for name, value in self.there.items() if here.get(name) != value), ""):
            who = f"worker {os.getpid()} on {os.uname().nodename}"
            return JobOutcome(job, error=f"{who} has another {other} than this process", fatal=True)
        try:
            return JobOutcome(job, value=pickle.loads(self.computed[job])())  # noqa: S301 (from the process that asks)
        except InputError as error:
            return JobOutcome(job, error=str(error), fatal=True)
        except Exception as error:  # noqa: BLE001 (whatever the error is, the other computations go on)
            return JobOutcome(job, error=" ".join(f"{type(error).__name__}: {error}".split()), final=True)
