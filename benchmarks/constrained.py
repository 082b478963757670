"""Time of plans within a risk, and of plans without: python benchmarks/constrained.py [--quick].

Random awareness and chances to fail of every bound, on 10 x 10 and 50 x 50 cells; medians over
maps of the time of one plan, with the compiled engine, and of the ratio to the plan without risk.
"""

import statistics

import numpy as np
from common import Table, arguments, median_seconds, parsed

from trustbo.models import TrustParams
from trustbo.planning import Planner
from trustbo.workspace import Workspace

PARAMS = TrustParams(0.5, np.array([0.6, 0.3]), -0.2, 0.1, 0.1)
CASES = (
    ("lost_contact", "gaussian"), ("lost_contact", "censored"), ("lost_contact", "beta_binomial"),
    ("terminal", "gaussian"), ("mean", "gaussian"), ("success", "gaussian"),
    ("bottleneck", "gaussian"), ("stationary", "gaussian"),
)  # fmt: skip
N_MAPS = 5
MAX_FAILURE = 0.1


def seconds(planner):
    return median_seconds(lambda: planner.plan(PARAMS), 3), planner.plan(PARAMS)


def case(n, objective, observation, seed):
    rng = np.random.default_rng([n, seed])
    workspace = Workspace.from_awareness(rng.uniform(size=(1, 8, n, n, 2)))
    shape = 8, n, n
    high = rng.uniform(size=shape) < 0.3
    p_fail = np.where(high, rng.uniform(0.0, 3.0 / n, shape), rng.uniform(0.0, 0.05 / n, shape))
    options = {"observation": observation, "engine": "numba"}
    ends = workspace, (n - 1, 0), (0, n - 1), objective
    free, _ = seconds(Planner(*ends, **options))
    limits = {"max_failure": MAX_FAILURE, "infeasible": "safest"}
    within, plan = seconds(Planner(*ends, **options, **limits).with_risk(p_fail))
    return free, within, plan.exact


def main():
    given = parsed(arguments(__doc__, quick="10 x 10 cells alone"))
    table = Table("cells", "objective", "without risk", "within .1", "ratio", "exact")
    for n in (10,) if given.quick else (10, 50):
        for objective, observation in CASES:
            results = [case(n, objective, observation, seed) for seed in range(N_MAPS)]
            free, within = (1e3 * statistics.median(row[i] for row in results) for i in (0, 1))
            ratio = statistics.median(row[1] / row[0] for row in results)
            exact = sum(row[2] for row in results)
            name = objective if observation == "gaussian" else f"{objective}, {observation}"
            table.row(
                f"{n} x {n}", name, f"{free:.2f} ms", f"{within:.2f} ms", f"{ratio:.1f}",
                f"{exact}/{N_MAPS}",
            )  # fmt: skip


if __name__ == "__main__":
    main()
