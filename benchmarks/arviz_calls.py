"""Calls of ArviZ on exact, NUTS and weighted posteriors, and a view by rate: which fail, and how.

python benchmarks/arviz_calls.py [--quick]

Nearly every public function of ArviZ that takes a posterior is called, some on several groups.
`dt` is a posterior, `other` one of another model, `half` one of half of the missions.
"""

import tempfile
import warnings
from pathlib import Path

import arviz as az
import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import xarray as xr
from common import Table, arguments, parsed

import trustbo as tb

mpl.use("Agg")
CALLS = """
az.summary(dt)
az.summary(dt, var_names=names, kind="stats", ci_kind="hdi")
az.summary(dt, kind="diagnostics")
az.summary(dt, group="prior")
az.summary(dt, group="log_likelihood")
az.summary(dt, group="latent", var_names=["trust"])
az.mean(dt)
az.median(dt)
az.mode(dt, var_names=["beta0"])
az.std(dt)
az.var(dt)
az.mad(dt)
az.iqr(dt)
az.eti(dt)
az.hdi(dt)
az.hdi(dt, group="posterior_predictive")
az.ci_in_rope(dt, var_names=["b"], rope=(-0.1, 0.1))
az.ess(dt)
az.ess(dt, method="tail")
az.mcse(dt)
az.rhat(dt)
az.rhat_nested(dt, superchain_ids=np.arange(dt["posterior"].sizes["chain"]) // 2)
az.diagnose(dt, show_diagnostics=False)
az.bfmi(dt)
az.ecdf(dt["posterior"].dataset["beta0"])
az.histogram(dt, var_names=names)
az.kde(dt, var_names=names)
az.qds(dt, var_names=["beta0"])
az.thin(dt)
az.extract(dt, num_samples=50)
az.extract(dt, group="posterior_predictive", num_samples=50)
az.get_log_likelihood(dt)
az.convert_to_dataset(dt)
az.dataset_to_dataframe(dt["posterior"].to_dataset())
az.from_netcdf(written(dt))
az.bayes_factor(dt, var_names=["b"])
az.kl_divergence(dt, half, var_names=names)
az.wasserstein(dt, half, var_names=names)
az.weight_predictions([dt, dt], weights=[0.3, 0.7])
az.metrics(dt)
az.metrics(dt, kind="mae")
az.psense(dt)
az.psense(dt, group="likelihood")
az.psense_summary(dt)
az.loo(dt)
az.loo(dt, pointwise=True)
az.loo_i(0, dt)
az.loo_subsample(dt, observations=10)
az.loo_approximate_posterior(dt, log_p=density(dt), log_q=density(dt))
az.loo_expectations(dt)
az.loo_influence(dt)
az.loo_metrics(dt)
az.loo_pit(dt)
az.loo_r2(dt, "contact_rate")
az.loo_score(dt)
az.compare({"this": dt, "other": other})
az.compare({"this": tb.inference.loo(dt), "other": tb.inference.loo(other)})
az.plot_compare(az.compare({"this": tb.inference.loo(dt), "other": tb.inference.loo(other)}))
az.plot_khat(tb.inference.loo(dt))
az.plot_autocorr(dt, var_names=names)
az.plot_bf(dt, "b")
az.plot_convergence_dist(dt)
az.plot_dgof(dt, var_names=["beta0"])
az.plot_dgof_dist(dt, var_names=["beta0"])
az.plot_dist(dt)
az.plot_dist(dt, kind="hist", var_names=names)
az.plot_dist(dt, group="prior", var_names=["beta0"])
az.plot_energy(dt)
az.plot_ess(dt, var_names=["beta0"])
az.plot_ess_evolution(dt, var_names=["beta0"])
az.plot_forest(dt)
az.plot_forest(dt, combined=True, var_names=names)
az.plot_forest(dt, group="prior")
az.plot_mcse(dt, var_names=["beta0"])
az.plot_pair(dt, var_names=["beta0", "b"])
az.plot_pair_focus(dt, "beta0", var_names=["b", "delta_w"])
az.plot_parallel(dt, var_names=names)
az.plot_ppc_dist(dt)
az.plot_ppc_dist(dt, group="prior_predictive")
az.plot_ppc_dist(dt, kind="ecdf")
az.plot_ppc_dist_pit(dt)
az.plot_ppc_interval(dt)
az.plot_ppc_pit(dt)
az.plot_ppc_pit(dt, coverage=True)
az.plot_ppc_tstat(dt)
az.plot_ppc_tstat(dt, t_stat="std")
az.plot_ppc_rootogram(dt)
az.plot_ppc_pava(dt)
az.plot_ppc_pava_residuals(dt, x_var="awareness")
az.plot_ppc_censored(dt)
az.plot_loo_interval(dt)
az.plot_loo_pit(dt)
az.plot_loo_pit(dt, coverage=True)
az.plot_loo_pava(dt)
az.plot_prior_posterior(dt, var_names=["beta0", "b"])
az.plot_psense_dist(dt, var_names=["beta0"])
az.plot_psense_quantities(dt, var_names=["beta0"])
az.plot_rank(dt, var_names=["beta0"])
az.plot_rank_dist(dt, var_names=["beta0"])
az.plot_ridge(dt)
az.plot_trace(dt, var_names=["beta0"])
az.plot_trace_dist(dt, var_names=["beta0"])
az.combine_plots(dt, [(az.plot_trace, {}), (az.plot_rank, {})], var_names=["beta0"])
"""


def subjects(quick: bool) -> tuple[dict[str, xr.DataTree], dict[str, xr.DataTree]]:
    """Posteriors of one set of missions by name, and others to compare them with."""
    awareness = np.random.default_rng(0).uniform(size=(3, 6, 6, 2))
    workspace = tb.Workspace.from_awareness(awareness)
    truth = tb.models.TrustParams(0.6, np.array([0.3, 0.2]), 0.05, 0.05, 0.05)
    robots = tb.simulation.ModelSimulator(workspace, truth)
    model = tb.models.PooledTrust()
    campaign = tb.Campaign(workspace, (5, 0), (0, 5), policy="random", model=model)
    for _ in campaign.run(robots, n_iterations=25):
        pass
    missions = campaign.missions
    results = {"exact": tb.fit(missions, model, sampler="exact")}
    if not quick:
        results["NUTS"] = tb.fit(missions, model, sampler="nuts")
    weights = 0.9 ** np.arange(len(missions))[::-1]
    results["weighted"] = tb.fit(missions, model, sampler="exact", weights=weights)
    results["by rate"] = tb.inference.by_rate(results["exact"])
    half = tb.fit(missions[::2], model, sampler="exact")
    other = tb.fit(missions, tb.models.CoupledTrust(inter_robot="none"))
    return results, {"half": half, "other": other}


def written(dt: xr.DataTree) -> Path:
    """File of a posterior."""
    file = Path(tempfile.mkdtemp()) / "posterior.nc"
    dt.to_netcdf(file)
    return file


def density(dt: xr.DataTree) -> np.ndarray:
    """Log density of each draw."""
    return dt["sample_stats"]["lp"].values.ravel()


def failure(call: str, names: dict) -> str:
    """Last line of the error of a call; empty if there is none."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            eval(call, names)
    except Exception as error:
        text = " ".join(str(error).split())
        return f"{type(error).__name__}: {text[:160]}"
    finally:
        plt.close("all")
    return ""


def main() -> None:
    """Print a row for each call that fails."""
    given = parsed(arguments(__doc__, quick="without NUTS"))
    results, others = subjects(given.quick)
    calls = CALLS.split("\n")[1:-1]
    table, failures = Table("posterior", "call", "error"), 0
    for subject, dt in results.items():
        names = {"az": az, "np": np, "tb": tb, "written": written, "density": density}
        names |= {"dt": dt, **others, "names": ["beta0", "beta", "b"]}
        if subject == "by rate":  # compared with a view too: ArviZ asks for the same observations
            names["other"] = tb.inference.by_rate(others["other"])
        for call in calls:
            if error := failure(call, names):
                failures += 1
                table.row(subject, f"`{call}`", error)
    print(f"{len(calls)} calls on {len(results)} posteriors, {failures} failed")


if __name__ == "__main__":
    main()
