"""Time per mission (without the fit), memory and disk space, early and late in a campaign.

python benchmarks/long_campaign.py [--missions 150]
"""

import argparse
import resource
import tempfile
import time
from pathlib import Path

import numpy as np

import trustbo as tb
from trustbo.models import PooledTrust, TrustParams

ENDS = (9, 0), (0, 9)


def main():
    """Run one campaign, and print the results around mission 10 and at the end."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--missions", type=int, default=150)
    n = parser.parse_args().missions
    workspace = tb.Workspace.from_awareness(np.random.default_rng(0).uniform(size=(3, 10, 10, 2)))
    truth = TrustParams(0.6, np.array([0.3, 0.2]), 0.05, 0.05, 0.05)
    robots, megabytes, seconds = tb.simulation.ModelSimulator(workspace, truth), [], []
    fit = {"draws": 250}
    with tempfile.TemporaryDirectory() as folder:
        campaign = tb.Campaign(
            workspace, *ENDS, model=PooledTrust(), policy="thompson", directory=folder, fit=fit
        )
        with campaign:
            for j in range(n):
                start = time.perf_counter()
                plan, asked = campaign.ask(), time.perf_counter()
                mission = robots.run(plan.path, seed=j, mission=j)
                start += time.perf_counter() - asked
                tree = campaign.tell(mission)
                seconds.append(time.perf_counter() - start - tree.attrs["seconds"])
                peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
                megabytes.append(peak / 1024.0)
        size = sum(file.stat().st_size for file in Path(folder).rglob("*") if file.is_file())
    early, late = slice(5, 15), slice(n - 10, n)
    for name, part in (("missions 6 to 15", early), (f"missions {n - 9} to {n}", late)):
        print(f"{name}: {np.median(seconds[part]):.3f} s without the fit, "
              f"{np.max(megabytes[part]):.0f} MB")  # fmt: skip
    print(f"on disk: {size / n / 1e6:.2f} MB per mission")


if __name__ == "__main__":
    main()
