"""What a mission of a long campaign costs: seconds, memory and disk, over 200 missions.

Run: python benchmarks/campaigns.py [quick] [--csv FILE]

10 x 10 cells, 3 robots, the exact sampler, kept in a folder as it goes. Each row is the median time
of the last ten missions (ask and tell, without driving), the growth of the process and the size of
the folder since the first row; last, the time to open the folder again. The same script runs under
version 0.1, which the figure of docs/campaigns.md shows beside.
"""

import resource
import sys
import tempfile
import time
import warnings
from pathlib import Path

import numpy as np

import trustbo as tb
from trustbo.models import TrustParams
from trustbo.simulation import ModelSimulator

N = 40 if "quick" in sys.argv else 200
TRUTH = TrustParams(0.6, np.array([0.3, 0.2]), 0.05, 0.05, 0.05)


def megabytes_of(folder):
    return sum(file.stat().st_size for file in folder.rglob("*") if file.is_file()) / 1e6


def measure(folder):
    """Rows (mission, seconds a mission, MB of memory, MB on disk)."""
    workspace = tb.Workspace.from_awareness(np.random.default_rng(0).uniform(size=(3, 10, 10, 2)))
    simulator = ModelSimulator(workspace, TRUTH)
    campaign = tb.Campaign(
        workspace, (9, 0), (0, 9), sampler="exact", objective="mean", policy="thompson",
        directory=folder,
    )  # fmt: skip
    rows, seconds = [], []
    with campaign:
        for j in range(N):
            started = time.perf_counter()
            plan = campaign.ask()
            asked = time.perf_counter() - started
            mission = simulator.run(plan.path, seed=j)
            started = time.perf_counter()
            campaign.tell(mission)
            seconds.append(asked + time.perf_counter() - started)
            if (j + 1) % 10 == 0:
                memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
                rows.append((j + 1, np.median(seconds[-10:]), memory, megabytes_of(folder)))
    return rows


def main():
    warnings.simplefilter("ignore")
    with tempfile.TemporaryDirectory() as folder:
        rows = measure(Path(folder))
        started = time.perf_counter()
        tb.Campaign.load(folder).close()
        loading = time.perf_counter() - started
    print("| mission | seconds a mission | MB of memory | MB on disk |\n|---:|---:|---:|---:|")
    for n, seconds, memory, disk in rows:
        print(f"| {n} | {seconds:.3f} | {memory:.0f} | {disk:.1f} |")
    first, last = rows[0], rows[-1]
    per = [(last[i] - first[i]) / (last[0] - first[0]) for i in (2, 3)]
    print(f"\nlast / first: {last[1] / first[1]:.2f} x the time (target at 150: 2)")
    print(f"a mission adds {per[0]:.2f} MB of memory, {per[1]:.2f} MB on disk (target: 1)")
    print(f"opened in {loading:.2f} s (target: 2)")
    if "--csv" in sys.argv:
        file = Path(sys.argv[sys.argv.index("--csv") + 1])
        lines = [f"{n},{s:.4f},{m:.1f},{d:.2f}" for n, s, m, d in rows]
        file.write_text("\n".join(["mission,seconds,memory_mb,disk_mb", *lines]) + "\n")


if __name__ == "__main__":
    main()
