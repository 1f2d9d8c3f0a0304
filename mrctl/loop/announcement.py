"""What is said while laws are compiled."""

from __future__ import annotations

import sys
from functools import cache
from multiprocessing import parent_process

from numba.core.event import Event, Listener, register


class Announcement(Listener):
    """Tells the user that laws are being compiled, for which a first simulation waits."""

    said = False

    def on_start(self, event: Event) -> None:
        """Prints the message at the first compilation."""
        if not self.said:
            self.said = True
            print("mrctl: compiling the laws, which takes half a minute, once", file=sys.stderr)

    def on_end(self, event: Event) -> None:
        """Prints nothing."""


@cache
def announced() -> Announcement:
    """Lets this process announce compilations; the workers of a sweep, one of many, stay silent."""
    announcement = Announcement()
    if parent_process() is None:
        register("numba:compile", announcement)
    return announcement
