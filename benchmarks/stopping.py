"""How often `RegretBound` stops too soon, and how many missions it saves.

Run: python benchmarks/stopping.py [-n 100] [--quick]

Simulated campaigns on 10 x 10 cells with 3 robots, low noise (sd 0.05 and 0.05; the target) and
high (0.2 and 0.2; rates are then cut at 0 and 1 now and then): the truth is drawn from the priors,
but for the noise, and for b: at average awareness trust settles at 1/2. Truths
under which trust would leave [0, 1] are drawn again, so that hardly any rate is cut. A campaign has
failed if, where the rule stopped it, the recommended path's true regret is above eps.
"""

import numpy as np
from common import Table, arguments, parsed, verdict
from scipy.ndimage import gaussian_filter
from scipy.stats import binomtest, rankdata

import trustbo as tb
from trustbo.inference import sample_prior
from trustbo.models import PooledTrust
from trustbo.planning import Planner
from trustbo.simulation import ModelSimulator

SHAPE, ENDS, MOST = (10, 10), ((9, 0), (0, 9)), 15
CASES = (
    (0.05, 0.05, 0.1),
    (0.05, 0.003, 0.1),
    (0.2, 0.01, 0.1),
    (0.2, 0.003, 0.1),
    (0.2, 0.003, 0.3),
)


def world(seed, noise):
    """A workspace of smooth features, and true parameters under which rates are rates."""
    rng = np.random.default_rng(seed)
    z = gaussian_filter(rng.normal(size=(*SHAPE, 2)), (1, 1, 0))
    z = rankdata(z.reshape(-1, 2), axis=0).reshape(*SHAPE, 2) / np.prod(SHAPE)
    workspace = tb.Workspace.from_awareness(np.stack([z] * 3))
    for draw in range(1000):
        truth = sample_prior(PooledTrust(), 2, 1, seed * 1000 + draw).draw(0)
        b = 0.5 * (1.0 - truth.beta0) - truth.beta @ z.mean((0, 1))
        settled = (z @ truth.beta + b) / (1.0 - truth.beta0)
        if 0.1 < settled.min() and settled.max() < 0.9:
            return workspace, truth._replace(b=b, delta_w=noise, delta_v=noise, x0_sd=0.1)
    raise RuntimeError(f"no truth for seed {seed}")


def regret(workspace, truth, path):
    planner = Planner(workspace, *ENDS, "terminal")
    return 1.0 - planner.evaluate(path, truth).value / planner.plan(truth).value


def main():
    given = parsed(arguments(__doc__, n=100, quick="5 campaigns of the first row"))
    n = 5 if given.quick else given.n
    print(f"{n} campaigns of at most {MOST} missions, sampler exact, policy greedy\n")
    head = "noise", "eps", "delta", "stopped", "failures", "95 % interval", "target"
    table = Table(*head, "missions (90 %)")
    for noise, eps, delta in CASES[: 1 if given.quick else None]:
        failed, stopped, missions = 0, 0, []
        for seed in range(n):
            workspace, truth = world(seed, noise)
            result = tb.iterate(
                workspace, *ENDS, n_iterations=MOST, simulator=ModelSimulator(workspace, truth),
                sampler="importance", stop=tb.RegretBound(eps, delta), seed=seed, progress=False,
                objective="terminal",
            )  # fmt: skip
            if result.stop_reason != "n_iterations":
                stopped += 1
                missions.append(len(result.missions))
                failed += regret(workspace, truth, result.path) > eps
        low, high = binomtest(failed, max(1, stopped)).proportion_ci()
        rate = failed / max(1, stopped)
        target = f"<= {delta + 0.03:.0%}: {verdict(rate <= delta + 0.03)}"
        most = f"{np.median(missions):g} ({np.quantile(missions, 0.9):g})" if missions else ""
        interval = f"{low:.1%} to {high:.1%}"
        row = f"{noise:g}", f"{eps:g}", f"{delta:g}", stopped, f"{rate:.1%}", interval
        table.row(*row, target, most)


if __name__ == "__main__":
    main()
