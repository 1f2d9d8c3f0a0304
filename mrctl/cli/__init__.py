"""The commands of `mrctl`; tyro derives their flags from functions and from the records that these take.

The docstring of a field or argument is the help text of its flag.
"""

from mrctl.cli.program import main

__all__ = ["main"]
