"""Simulation-based calibration of both samplers: p-values of uniform ranks, per parameter.

Run: python benchmarks/calibration.py [data sets for exact, default 1000] [for NUTS, default 100]
"""

import sys
import time

from trustbo.models import sbc


def main(n_exact=1000, n_nuts=100):
    for sampler, n in (("exact", n_exact), ("nuts", n_nuts)):
        started = time.perf_counter()
        p_values = sbc(sampler=sampler, n_datasets=n, progress=False)["p_value"].to_series()
        seconds = time.perf_counter() - started
        print(f"{sampler}: {n} data sets of 4 missions, 8 bounds, 3 robots; {seconds:.0f} s")
        for name, p in p_values.items():
            print(f"  {name:8s} p = {p:.3f}")
        limit = 0.01 / len(p_values)
        verdict = "not rejected" if p_values.min() > limit else "REJECTED"
        print(f"  uniformity {verdict} at 1 % (Bonferroni: each p > {limit:.4f})")


if __name__ == "__main__":
    main(*(int(a) for a in sys.argv[1:]))
