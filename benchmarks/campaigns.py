"""What a mission of a long campaign costs: seconds, memory and disk, over 200 missions.

Run: python benchmarks/campaigns.py [--quick] [--out FILE.csv]

10 x 10 cells, 3 robots, the exact sampler, kept in a folder as it goes. Each row is the median time
of the last ten missions (ask and tell, without driving), the growth of the process and the size of
the folder since the first row; last, the time to open the folder again. The same script runs under
version 0.1; the figure of docs/campaigns.md shows both.
"""

import resource
import tempfile
import warnings
from pathlib import Path

import numpy as np
from common import Table, arguments, parsed, timed

import trustbo as tb
from trustbo.models import TrustParams
from trustbo.simulation import ModelSimulator

TRUTH = TrustParams(0.6, np.array([0.3, 0.2]), 0.05, 0.05, 0.05)


def megabytes_of(folder):
    return sum(file.stat().st_size for file in folder.rglob("*") if file.is_file()) / 1e6


def measure(folder, n_missions):
    """Rows (mission, seconds a mission, MB of memory, MB on disk)."""
    workspace = tb.Workspace.from_awareness(np.random.default_rng(0).uniform(size=(3, 10, 10, 2)))
    simulator = ModelSimulator(workspace, TRUTH)
    campaign = tb.Campaign(
        workspace, (9, 0), (0, 9), sampler="exact", objective="mean", policy="thompson",
        directory=folder,
    )  # fmt: skip
    rows, seconds = [], []
    with campaign:
        for j in range(n_missions):
            asking, plan = timed(campaign.ask)
            mission = simulator.run(plan.path, seed=j)
            telling, _ = timed(lambda mission=mission: campaign.tell(mission))
            seconds.append(asking + telling)
            if (j + 1) % 10 == 0:
                memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
                rows.append((j + 1, np.median(seconds[-10:]), memory, megabytes_of(folder)))
    return rows


def main():
    parser = arguments(__doc__, quick="40 missions")
    parser.add_argument("--out", type=Path, help="CSV file of the table")
    given = parsed(parser)
    warnings.simplefilter("ignore")
    with tempfile.TemporaryDirectory() as folder:
        rows = measure(Path(folder), 40 if given.quick else 200)
        loading, campaign = timed(lambda: tb.Campaign.load(folder))
        with campaign:  # lets go of the folder
            pass
    table = Table("mission", "seconds", "memory_mb", "disk_mb")
    for n, seconds, memory, disk in rows:
        table.row(n, f"{seconds:.4f}", f"{memory:.1f}", f"{disk:.2f}")
    first, last = rows[0], rows[-1]
    per = [(last[i] - first[i]) / (last[0] - first[0]) for i in (2, 3)]
    print(f"\nlast / first: {last[1] / first[1]:.2f} x the time (target at 150: 2)")
    print(f"a mission adds {per[0]:.2f} MB of memory, {per[1]:.2f} MB on disk (target: 1)")
    print(f"opened in {loading:.2f} s (target: 2)")
    if given.out:
        table.write(given.out)


if __name__ == "__main__":
    main()
