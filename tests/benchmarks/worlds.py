"""How much faster are missions in different worlds in one batch than one by one? `python tests/benchmarks/worlds.py`.

The car drives through doors and slaloms with `model+fel` and nothing that keeps it from obstacles, on one thread. One
by one and in a batch take turns; the share is the median over the turns.
"""

import statistics
import time

from mrctl import Scenario
from mrctl.loop.runs import simulate
from mrctl.navigation.planning import prepared
from mrctl.navigation.tasks import task_of

TURNS, SEEDS = 3, 40


def main() -> None:
    """Prints the share of the time that the batch takes."""
    base = Scenario(prior="model", learner="fel")
    runs = [prepared(task_of(f"{kind}:{k}", base), base)[1] for k in range(SEEDS) for kind in ("doorway", "slalom")]
    simulate(runs[:1]), simulate(runs[:2])  # compiled
    shares = []
    for _ in range(TURNS):
        start = time.perf_counter()
        for run in runs:
            simulate(run, threads=1)
        middle = time.perf_counter()
        simulate(runs, threads=1)
        shares.append((time.perf_counter() - middle) / (middle - start))
    print(f"{len(runs)} missions in a batch take {statistics.median(shares):.2f} of the time one by one")


if __name__ == "__main__":
    main()
