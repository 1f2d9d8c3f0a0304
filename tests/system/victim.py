"""A sweep, in a process of its own, that cannot end before it is hit, on however fast a machine.

Its later jobs wait for a file `go` beside the store:

    python victim.py sweep FILE --out STORE …
"""

import sys
import time
from pathlib import Path

from mrctl import cli
from mrctl.sweep import jobs
from mrctl.sweep.pool import JobOutcome
from mrctl.sweep.store import Store


def held(path: str, job: int) -> JobOutcome:
    """Computes a job; one of the second half waits before."""
    while job >= Store(path).jobs // 2 and not Path(path).with_name("go").exists():
        time.sleep(0.02)
    return compute(path, job)


compute = jobs.compute

if __name__ == "__main__":
    import victim  # by this name the workers of a Dask cluster find it, too

    jobs.compute = victim.held
    sys.exit(cli.main())
