"""Where the program `mrctl` and `python -m mrctl` begin: Ctrl-C ends them with one line, also while they import.

Importing the commands takes a second, and what a command needs some more. Libraries that are interrupted in an import
print tracebacks, or report the interrupt as an error of their own.
"""

from __future__ import annotations

import os
import signal
import sys
from types import FrameType


class _Interrupts:
    """Handles SIGINT.

    Attributes:
        importing: Whether the commands are still being imported, so that nothing needs to be tidied up.
        caught: Whether the program was interrupted.
    """

    importing, caught = True, False

    def __call__(self, number: int, frame: FrameType | None) -> None:
        """Ends the program, or lets the command tidy up and end it."""
        self.caught = True
        if self.importing:
            print("mrctl: interrupted", file=sys.stderr, flush=True)
            os._exit(130)
        signal.default_int_handler(number, frame)


def main() -> int:
    """Runs the command of the command line; see `mrctl.cli.main`.

    Returns:
        The exit status; 130 after Ctrl-C, even if a library turned the interrupt into another error.
    """
    interrupts = _Interrupts()
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # a program in the background ignores Ctrl-C
        signal.signal(signal.SIGINT, interrupts)
    report = sys.unraisablehook
    sys.unraisablehook = lambda error: None if interrupts.caught else report(error)
    try:
        from mrctl import cli

        interrupts.importing = False
        status = cli.main()
    except BaseException as error:
        if not interrupts.caught or isinstance(error, SystemExit):
            raise
        print("mrctl: interrupted", file=sys.stderr)
        status = 130
    if interrupts.caught:
        # Python remembers an interrupt that left a string of code, as dataclasses run them, and would end `python -m`
        # by the signal instead of the status; to run another string makes it forget.
        exec("")
    return status


if __name__ == "__main__":
    sys.exit(main())
