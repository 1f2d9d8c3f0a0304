"""A file that keeps results as they come, so that a command that was stopped goes on where it was, or on a cluster."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from tqdm import tqdm

from mrctl.loop.simulation import cores
from mrctl.record import InputError
from mrctl.results.dataset import versions
from mrctl.sweep.jobs import code_digest
from mrctl.sweep.pool import Cluster, Outcome, carry_out, check_address

SHOWING = ("envs", "viewer", "cli.py", "__main__.py")  # rooms on which no experiment depends


class Computation(NamedTuple):
    """A part of an experiment."""

    key: object
    """Key of its result, of numbers, strings and lists."""
    compute: Callable[[int], object]
    """Returns the result, of numbers, strings, lists and dictionaries, with that many threads. Workers of a cluster get
    it pickled."""


class Journal:
    """Results by key. Its file has a line of JSON for what all of them depend on, and then one for each result.

    JSON keeps every bit of a float, so that a command that goes on ends as one that was never stopped.

    Attributes:
        cores: Number of cores that compute results.
    """

    def __init__(self, file: Path, head: dict[str, Any], scheduler: str | None = None) -> None:
        """Opens the file or begins it.

        Args:
            file: The file; an unfinished last line is dropped.
            head: Everything that the results depend on, but the Python code of mrctl, whose digest is added.
            scheduler: Address of a Dask scheduler whose workers compute results; by default this process does.

        Raises:
            InputError: The results in the file depend on something else, it cannot be read or written, or no scheduler
                answers.
        """
        self._scheduler, self.cores = scheduler, threads_of(scheduler) if scheduler else cores()
        self._file, head = file, json.loads(json.dumps(head | {"code": code_digest(SHOWING)}))
        try:
            begun = file.read_text() if file.exists() else ""
            first, *rest = [json.loads(line) for line in begun[: begun.rfind("\n") + 1].splitlines()] or [head]
            other = next((name for name in head if first.get(name) != head[name]), "" if first == head else "it")
            self._known = {json.dumps(line["key"]): line["value"] for line in rest}
        except OSError as error:
            raise InputError(f"out: {file}: {error.strerror}") from None
        except (ValueError, LookupError, TypeError, AttributeError):
            raise InputError(f"out: {file} is damaged; choose another folder") from None
        if other:
            raise InputError(f"out: {file} holds other results ({other} differs); choose another folder")
        file.write_text("".join(json.dumps(line) + "\n" for line in (first, *rest)))

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
        with self._file.open("a") as file:
            file.write(line + "\n")
        self._known[json.dumps(key)] = json.loads(line)["value"]

    def results(self, tasks: Sequence[Computation]) -> list[Any]:
        """Returns the results of tasks, of which it computes and keeps those that are missing, with a progress bar.

        Raises:
            InputError: The workers of the cluster have other code, or a task fails there.
        """
        missing = [k for k, task in enumerate(tasks) if task.key not in self]
        with tqdm(total=len(tasks), initial=len(tasks) - len(missing), unit="part") as bar:
            if self._scheduler and missing:
                self._on_cluster(tasks, missing, self._scheduler, bar)
                missing = []
            for k in missing:
                self[tasks[k].key] = tasks[k].compute(self.cores)
                bar.update()
        return [self[task.key] for task in tasks]

    def _on_cluster(self, tasks: Sequence[Computation], missing: Sequence[int], scheduler: str, bar: tqdm) -> None:
        """Computes tasks on a cluster and keeps their results."""

        def ended(outcome: Outcome) -> None:
            if not outcome.error:
                self[tasks[outcome.job].key] = outcome.value
            bar.update()

        pool = Cluster(Remote(tasks, versions(), code_digest(SHOWING)), "", scheduler)
        try:
            aside = carry_out(pool, missing, ended)
        finally:
            pool.close()
        for k, why in sorted(aside.items()):
            raise InputError(f"{tasks[k].key}: {why}; what was done is kept")


def threads_of(scheduler: str) -> int:
    """Returns the number of threads of the workers of a Dask scheduler.

    Raises:
        InputError: No scheduler or no worker answers.
    """
    check_address(scheduler)
    pool = Cluster(Remote((), {}, ""), "", scheduler)
    try:
        return pool.room()
    finally:
        pool.close()


class Remote(NamedTuple):
    """Computes tasks in the workers of a cluster, which have to have the same code."""

    tasks: Sequence[Computation]
    versions: dict[str, str]
    """Versions of the packages of the process that asks."""
    code: str
    """Digest of its code."""

    def __call__(self, _: str, job: int) -> Outcome:
        """Computes a task, with one thread; Dask tries again, or reports, what it raises."""
        if (versions(), code_digest(SHOWING)) != (self.versions, self.code):
            return Outcome(job, error="scheduler: its workers have other versions or other code", fatal=True)
        return Outcome(job, value=self.tasks[job].compute(1))
