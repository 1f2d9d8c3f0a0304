"""Where the program `mrctl` and `python -m mrctl` begin: Ctrl-C ends them with one line, also while they import.

Importing the commands takes a second, and what a command needs some more. Libraries that are interrupted in an import
print tracebacks, report the interrupt as an error of their own, or forget it, as compiled modules do.
"""

from __future__ import annotations

import contextlib
import gc
import os
import signal
import sys
from subprocess import Popen
from types import FrameType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sys import UnraisableHookArgs


class _Interrupts:
    """Handles SIGINT.

    Attributes:
        caught: Whether the program was interrupted.
    """

    def __init__(self) -> None:
        """Begins before any interrupt."""
        self.caught, self._report = False, sys.unraisablehook

    def __call__(self, number: int, frame: FrameType | None) -> None:
        """Ends the program at once if it is importing a module, and otherwise lets the command tidy up and end it."""
        self.caught = True
        begun = list[Popen[str]]()
        while frame:
            begun += [value for value in frame.f_locals.values() if isinstance(value, Popen)]
            if frame.f_code.co_filename.startswith("<frozen importlib"):
                with contextlib.suppress(OSError):
                    sys.stdout.flush()
                for program in begun:  # such as the one that glfw asks for a version, which would print a traceback
                    with contextlib.suppress(AttributeError, TypeError):  # one that is only about to begin
                        program.kill()
                print("mrctl: interrupted", file=sys.__stderr__, flush=True)  # sys.stderr may be captured just now
                os._exit(130)
            frame = frame.f_back
        raise KeyboardInterrupt

    def lost(self, error: UnraisableHookArgs) -> None:
        """Interrupts again if compiled code that had called Python, as LLVM does, dropped the exception."""
        if not self.caught:
            self._report(error)
        elif isinstance(error.exc_value, KeyboardInterrupt):
            signal.setitimer(signal.ITIMER_REAL, 0.01)


def _keep_streams() -> None:
    """Leads standard streams that are closed, as after `>&-`, to nowhere, in programs that this one starts too.

    Otherwise the next file that is opened gets their number, and what C code prints would go to that file.
    """
    for number, name, mode in (0, "stdin", "r"), (1, "stdout", "w"), (2, "stderr", "w"):
        try:
            os.fstat(number)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)  # the lowest number that is free: this one
            setattr(sys, name, open(number, mode, errors="replace", closefd=False))  # noqa: SIM115


def main() -> int:
    """Runs the command of the command line; see `mrctl.cli.main`.

    Returns:
        The exit status; 130 after Ctrl-C, even if a library turned the interrupt into another error.
    """
    _keep_streams()
    # At Python's own thresholds the garbage collector looks through what imports and the compiler make again and again,
    # which is a tenth of the time of a short command.
    gc.set_threshold(50_000, 20, 100)
    interrupts = _Interrupts()
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # a program in the background ignores Ctrl-C
        signal.signal(signal.SIGINT, interrupts)
        signal.signal(signal.SIGALRM, lambda *_: signal.raise_signal(signal.SIGINT))
    sys.unraisablehook = interrupts.lost
    try:
        from mrctl import cli

        status = cli.main()
    except BaseException as error:
        if not interrupts.caught or isinstance(error, SystemExit):
            raise
        print("mrctl: interrupted", file=sys.stderr)
        status = 130
    if interrupts.caught:
        signal.setitimer(signal.ITIMER_REAL, 0)
        # Python remembers an interrupt that left a string of code, as dataclasses run them, and would end `python -m`
        # by the signal instead of the status; to run another string makes it forget.
        exec("")
    return status


if __name__ == "__main__":
    sys.exit(main())
