"""Reports that Numba compiles kernels, once."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import cache
from multiprocessing import parent_process
from typing import Any

from numba.core.event import Event, Listener, register
from tqdm import tqdm

from mrctl.kernel import COMPILING, Kernel, announced_early


class Announcement(Listener):
    """Tells the user that Numba compiles kernels, for which a first simulation waits.

    On a terminal, a bar counts the compiled callees of the current kernel.

    Attributes:
        said: Whether the message was printed.
        bar: The bar of the current kernel, or of the last one.
    """

    said = False

    def __init__(self) -> None:
        """Waits for the first compilation."""
        self.bar = tqdm(disable=True)
        self._depth, self._left = 0, set[str]()

    def on_start(self, event: Event) -> None:
        """Prints the message at the first compilation; begins a bar for a kernel that no other one called."""
        law = _law(event)
        if not self.said:
            self.said = True
            print(COMPILING, file=sys.stderr)
        if self._depth == 0:
            self._left = called(law)
            name = f"{law.__module__.removeprefix('mrctl.')}.{law.__name__}"
            self.bar = tqdm(desc=name, total=len(self._left), unit="law", leave=False, disable=None)
        self._depth += 1

    def on_end(self, event: Event) -> None:
        """Advances the bar, and clears it when the kernel that began it is compiled."""
        name = _name(_law(event))
        self._depth -= 1
        # The same law may be compiled for several types, and Numba compiles functions of its own.
        if name in self._left:
            self._left.discard(name)
            self.bar.update()
        if self._depth == 0:
            self.bar.close()


def called(law: Callable[..., Any]) -> set[str]:
    """Returns the names of a law and of all kernels that it calls, itself or through others."""
    found: set[str] = set()
    waiting = [law]
    while waiting:
        law = waiting.pop()
        if (name := _name(law)) not in found:
            found.add(name)
            used = (law.__globals__.get(name) for name in law.__code__.co_names)
            waiting += [kernel.law for kernel in used if isinstance(kernel, Kernel)]
    return found


def _law(event: Event) -> Callable[..., Any]:
    assert event.data is not None
    return event.data["dispatcher"].py_func


def _name(law: Callable[..., Any]) -> str:
    return f"{law.__module__}.{law.__qualname__}"


@cache
def announced() -> Announcement:
    """Lets this process announce compilations, unless it is a worker of another process, as in a sweep."""
    announcement = Announcement()
    announcement.said = announced_early()
    if parent_process() is None:
        register("numba:compile", announcement)
    return announcement
