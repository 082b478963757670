"""Seconds per iteration of `iterate` on a synthetic 10 x 10 workspace, and what its NUTS gains.

Run: python benchmarks/loop.py [--quick]

The peer is numpyro's own MCMC object on the same model, data, draws and chains, called for each
mission as a user would; both in this process, medians over iterations.
"""

import arviz as az
import jax
import numpy as np
from common import Table, arguments, parsed, timed
from numpyro.infer import MCMC, NUTS

import trustbo as tb
from trustbo.inference import diagnostics, fit
from trustbo.models import PooledTrust


def plain_numpyro(missions):
    """The posterior's draws by numpyro.infer.MCMC with its defaults and a dense mass matrix."""
    awareness = np.stack([m.awareness for m in missions])
    rates = np.stack([m.contact_rate for m in missions])
    with jax.enable_x64(True):
        mcmc = MCMC(
            NUTS(PooledTrust(), dense_mass=True),
            num_warmup=300,
            num_samples=1000,
            num_chains=4,
            chain_method="sequential",
            progress_bar=False,
        )
        mcmc.run(jax.random.key(0), awareness, rates)
        draws = {k: np.asarray(v) for k, v in mcmc.get_samples(group_by_chain=True).items()}
    sites = az.from_dict({"posterior": draws})["posterior"].to_dataset()
    ess = az.ess(sites, method="bulk")
    return min(float(ess[name].min()) for name in ess.data_vars)


def main():
    given = parsed(arguments(__doc__, quick="3 missions, 1 refit"))
    workspace_seconds, workspace = timed(
        lambda: tb.Workspace.from_terrain(tb.terrain.synthetic_terrain(seed=0))
    )
    result = tb.iterate(
        workspace, (9, 0), (0, 9), n_iterations=3 if given.quick else 8, seed=0, progress=False
    )
    table = result.history[["seconds_plan", "seconds_run", "seconds_fit"]].to_dataframe()
    total = table.sum(axis=1).to_numpy()
    print(f"workspace of 500 x 500 pixels: {workspace_seconds:.1f} s (numba may compile)")
    print(
        f"iteration 1: {total[0]:.2f} s (compiles); later ones: median {np.median(total[1:]):.2f} s"
    )
    later = table.iloc[1:].median()
    for name in ("plan", "run", "fit"):
        print(f"  {name}: median {1000 * later[f'seconds_{name}']:.0f} ms")
    same = [m for m in result.missions if len(m.bounds) == len(result.missions[-1].bounds)][
        -1 if given.quick else -4 :
    ]
    ours, exact, theirs = [], [], []
    fit(same, PooledTrust(), "exact")  # imports and caches
    for n in range(1, len(same) + 1):
        seconds, posterior = timed(lambda n=n: fit(same[:n], PooledTrust(), "nuts", check=False))
        ours.append((seconds, diagnostics(posterior)["ess_bulk"]))
        seconds, posterior = timed(lambda n=n: fit(same[:n], PooledTrust(), "exact"))
        exact.append((seconds, posterior.attrs.get("kish", np.nan)))
        theirs.append(timed(lambda n=n: plain_numpyro(same[:n])))
    print("refit after each of the last missions (median seconds, smallest bulk ESS of 4000 draws;")
    print(
        "exact: Kish size of its 4096 points); the peer compiles anew for each number of missions"
    )
    lines = Table("", "seconds", "ESS", "effective draws/s", "ratio to numpyro")
    for name, runs in (("nuts", ours), ("exact", exact), ("numpyro MCMC", theirs)):
        seconds, ess = (np.median(column) for column in zip(*runs, strict=True))
        ratio = np.median([e / s for s, e in runs]) / np.median([e / s for s, e in theirs])
        speed = f"{ess / seconds:.0f}"
        lines.row(name, f"{seconds:.2f}", f"{ess:.0f}", speed, f"{ratio:.1f}")


if __name__ == "__main__":
    main()
