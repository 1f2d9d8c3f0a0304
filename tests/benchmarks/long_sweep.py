"""A long sweep: its rate beside that of loops of `mrctl bench`, and the memory of all its processes over time.

python tests/benchmarks/long_sweep.py [RUNS] [WORKERS] writes `long_sweep.png` and prints the figures. 10,000 runs of
20 s take ten minutes on two cores that have nothing else to do.
"""

import multiprocessing
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from mrctl.experiments import bench
from mrctl.scenario import Scenario

SWEEP = """
runs = {runs}
record = "metrics"
[base]
laps = 1
reference = {{ kind = "lemniscate", period = 20 }}
[[axes]]
field = "perturbation.mass_factor"
uniform = [0.5, 1.5]
"""


def family(root: int) -> list[int]:
    """A process and all its descendants."""
    parents = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            parents[int(stat.parent.name)] = int(stat.read_text().rpartition(")")[2].split()[1])
        except OSError:  # gone meanwhile
            continue
    found = [root]
    for process in found:
        found += [child for child, parent in parents.items() if parent == process]
    return found


def resident(process: int) -> float:
    """Memory of a process that it shares with none or in proportion, MiB; 0 when it is gone."""
    try:
        return int(re.search(r"^Pss:\s+(\d+)", Path(f"/proc/{process}/smaps_rollup").read_text(), re.M)[1]) / 1024
    except OSError:
        return 0.0


def watch(folder: Path, runs: int, workers: int, every: float = 5.0) -> tuple[np.ndarray, float, pd.DataFrame]:
    """Runs the sweep; returns time in s and MiB of the whole family `(n, 2)`, seconds it took, and its table."""
    (folder / "sweep.toml").write_text(SWEEP.format(runs=runs))
    store = folder / "store"
    start = time.perf_counter()
    command = [sys.executable, "-m", "mrctl", "sweep", str(folder / "sweep.toml"), "--out", str(store)]
    sweep = subprocess.Popen([*command, "--workers", str(workers)], stdout=subprocess.DEVNULL)
    curve = []
    while sweep.poll() is None:
        curve.append((time.perf_counter() - start, sum(resident(p) for p in family(sweep.pid))))
        time.sleep(every)
    seconds = time.perf_counter() - start
    if sweep.returncode:
        raise SystemExit(f"the sweep ended with {sweep.returncode}")
    return np.array(curve), seconds, pd.read_parquet(store / "runs.parquet")


def loop(_: int) -> float:
    """Steps/s of a loop of `mrctl bench` with 64 robots in `lab`, the tier of the sweep."""
    return bench._compare(64, 1, 41, bench.TICKS_PER_TURN, "lab")["steps_per_second"]


def side_by_side(workers: int) -> float:
    """Steps/s of as many such loops, each in its own process, while all of them run."""
    with multiprocessing.get_context("spawn").Pool(workers) as pool:
        pool.map(loop, range(workers), chunksize=1)  # imports, and fills the caches
        return sum(pool.map(loop, range(workers), chunksize=1))


def main(runs: int = 10_000, workers: int = 2) -> None:
    """Prints the figures, draws the curve."""
    steps = round(20 / Scenario().physics_step)
    with tempfile.TemporaryDirectory() as folder:
        curve, seconds, table = watch(Path(folder), runs, workers)
    rate = runs * steps / seconds
    limit = side_by_side(workers)
    middle = curve[(curve[:, 0] > 0.1 * seconds) & (curve[:, 0] < 0.95 * seconds)]
    slope = np.polyfit(*middle.T, 1)[0] if len(middle) > 2 else np.nan
    print(f"{runs} runs of {steps} steps, {workers} workers: {seconds:.0f} s, {runs / seconds:.1f} runs/s")
    print(f"{rate:,.0f} steps/s, {rate / limit:.2f} of {workers} loops of `mrctl bench` side by side ({limit:,.0f})")
    print(f"failed: {table['failed'].sum()}, rows: {len(table)}")
    print(f"memory: median {np.median(middle[:, 1]):.0f} MiB, most {curve[:, 1].max():.0f}, slope {slope:.4f} MiB/s")
    figure = Figure(figsize=(6, 2.5), layout="constrained")
    axes = figure.subplots()
    axes.plot(*curve.T)
    axes.set(xlabel="time in s", ylabel="memory of all processes in MiB", ylim=(0, None))
    figure.savefig("long_sweep.png", dpi=120)


if __name__ == "__main__":
    main(*(int(argument) for argument in sys.argv[1:]))
