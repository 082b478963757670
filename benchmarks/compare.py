"""Compare LOO of one model that is fitted as a class, as a function and by NumPyro's own MCMC.

    python benchmarks/compare.py ["fit, NUTS"] [own] ... [-n 6 20] [--seeds 5]

The missions are driven by the kinematic simulator on the example hillside, and all their rates have
`n_ticks`. The model is `PooledTrust` with equal noise in all bounds. For the function and for
NumPyro's MCMC, the same model is written as a NumPyro function. The true difference is 0 nats,
except for the noise of half a tick that `fit` adds to `delta_v`. Each row shows the `elpd` of a
posterior and its difference from the `elpd` of `tb.fit` with importance sampling. It also shows the
standard error of the difference over missions, its standard deviation over seeds, the largest
k-hat, and the number of missions that were left out by refits.

`own, az.compare` passes NumPyro's own MCMC to `arviz.compare`, which does not refit.
`own, densities` does the same without `n_ticks`; `tb.compare` refuses this
comparison.
"""

import warnings
from dataclasses import replace

import arviz as az
import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
from common import Table, arguments, parsed, timed
from numpyro.infer import MCMC, NUTS

import trustbo as tb
from trustbo.errors import TrustboError
from trustbo.inference import loo

SHAPE = 10, 10
ENDS = (9, 0), (0, 9)
OF = "log_likelihood_of"
REFERENCE = "fit, importance"
WAYS = (
    REFERENCE,
    "fit, NUTS",
    "fit, function",
    "own",
    "own, az.compare",
    "own, densities",
)
"""Ways to fit the model, which are the rows."""


def main():
    """Print a table for each number of missions."""
    parser = arguments(__doc__, names=WAYS, seeds=5)
    parser.add_argument("-n", type=int, nargs="+", default=[6, 20], help="numbers of missions")
    given = parsed(parser)
    warnings.filterwarnings("ignore", category=UserWarning)  # k-hat is shown in the table

    data = hillside(max(given.n))
    for n in given.n:
        print(f"\n{n} missions, {rates_of(data[:n]).size} rates\n")
        one_table(data[:n], given.seeds, given.names)


def hillside(n):
    """Drive n missions along random paths of the example hillside."""
    workspace = tb.Workspace.from_terrain(tb.terrain.example(), SHAPE)
    simulator = tb.simulation.KinematicSimulator(workspace)
    model = tb.models.PooledTrust()
    campaign = tb.Campaign(workspace, *ENDS, policy="random", model=model)
    for _ in campaign.run(simulator, n_iterations=n):
        pass
    return list(campaign.missions)


def rates_of(data):
    """Return all measured rates."""
    rates = np.concatenate([mission.contact_rate.ravel() for mission in data])
    return rates[~np.isnan(rates)]


def one_table(data, n_seeds, names):
    """Print the rows of all ways to fit the model to these missions."""
    model = program(data[0].features)
    pooled = unscaled(data[0].features)
    ways = {
        REFERENCE: lambda seed: tb.fit(data, pooled, seed=seed),
        "fit, NUTS": lambda seed: tb.fit(data, pooled, sampler="nuts", seed=seed, progress=False),
        "fit, function": lambda seed: tb.fit(data, model, seed=seed, progress=False),
        "own": lambda seed: own_mcmc(data, model, seed),
        "own, az.compare": lambda seed: own_mcmc(data, model, seed),
        "own, densities": lambda seed: own_mcmc(data, model, seed, ticks=False),
    }

    table = Table(
        "posterior", "elpd", "difference", "standard error", "sd over seeds", "p", "largest k-hat",
        "refits", "CPU s of the fit", first=16, name="compare",
    )  # fmt: skip
    reference = [loo(ways[REFERENCE](seed), progress=False) for seed in range(n_seeds)]
    for name in names:
        one_row(table, name, ways[name], reference)


def one_row(table, name, fit, reference):
    """Fit with each seed, and add a row; or say why LOO refuses."""
    found, seconds = [], []
    for seed in range(len(reference)):
        second, posterior = timed(lambda seed=seed: fit(seed))
        seconds.append(second)
        try:
            if name.startswith("own,"):
                found.append(az.loo(posterior, pointwise=True))
            else:
                found.append(loo(posterior, progress=False))
        except TrustboError as refusal:
            reason, *_ = str(refusal).split(",")
            table.row(name, f"refused: {reason}", *[""] * 6, f"{second:.1f}")
            return

    each = np.array([
        np.ravel(one.elpd_i) - np.ravel(other.elpd_i)
        for one, other in zip(found, reference, strict=True)
    ])  # fmt: skip
    sums = each.sum(1)
    error = np.sqrt(each.shape[1] * each.var(1)).mean()
    refits = [int(one.elpd_i["refitted"].sum()) if "refitted" in one.elpd_i.coords else 0
              for one in found]  # fmt: skip
    table.row(
        name, f"{np.mean([one.elpd for one in found]):.1f}", f"{sums.mean():.2f}", f"{error:.2f}",
        f"{sums.std():.2f}", f"{np.mean([one.p for one in found]):.1f}",
        f"{max(float(one.pareto_k.max()) for one in found):.2f}", max(refits),
        f"{np.mean(seconds):.1f}",
    )  # fmt: skip


def unscaled(features):
    """Return `PooledTrust` for these features, with the same noise in all bounds."""
    return tb.models.PooledTrust(replace(tb.models.Priors.from_features(features), f_v=None))


def program(features):
    """Write the model of `unscaled` as a NumPyro function."""
    priors = unscaled(features).for_features(features).priors
    of_features = (len(features),)
    mean = np.broadcast_to(priors.beta.loc, of_features).tolist()
    scale = np.broadcast_to(priors.beta.scale, of_features).tolist()
    level = float(priors.b.scale)
    stationary = priors.stationary

    def pooled(awareness, contact_rate=None, n_ticks=None):
        beta0 = numpyro.sample("beta0", dist.Beta(2.0, 2.0))
        delta_w = numpyro.sample("delta_w", dist.HalfNormal(0.2))
        delta_v = numpyro.sample("delta_v", dist.HalfNormal(0.2))

        # With `stationary`, the priors are on the weights of stationary trust.
        gain = 1.0 - beta0 if stationary else 1.0
        beta = numpyro.sample("beta", dist.Normal(jnp.array(mean), jnp.array(scale)).to_event(1))
        b = numpyro.sample("b", dist.Normal(0.0, level))
        drift = gain * (awareness @ beta + b)
        with numpyro.plate("mission", len(awareness)):
            rates = tb.models.ContactRate(drift, beta0, delta_w, delta_v, n_ticks=n_ticks)
            numpyro.sample("contact_rate", rates, obs=contact_rate)

    return pooled


def own_mcmc(data, model, seed, *, ticks=True):
    """Run NumPyro's NUTS on the missions as arrays, and return the DataTree of ArviZ."""
    arrays = tb.fit(data, tb.models.PooledTrust(), latent=False)
    z = arrays["constant_data"]["awareness"].fillna(0.0).values
    y = arrays["observed_data"]["contact_rate"].values
    n_ticks = arrays["constant_data"]["n_ticks"].values if ticks else None

    mcmc = MCMC(
        NUTS(model), num_warmup=500, num_samples=1000, num_chains=4, chain_method="vectorized",
        progress_bar=False,
    )  # fmt: skip
    given = [jnp.asarray(values) for values in (z, y, n_ticks) if values is not None]
    mcmc.run(jax.random.key(seed), *given)
    tree = az.from_numpyro(mcmc, log_likelihood=True)
    if ticks:
        tree.attrs[OF] = "ticks"
    return tree


if __name__ == "__main__":
    main()
