"""View of a posterior in which each contact rate is an observation, for ArviZ."""

from collections.abc import Sequence

import numpy as np
import xarray as xr

from trustbo.data import Mission
from trustbo.errors import TrustboError
from trustbo.inference.draws import params_of_missions
from trustbo.inference.evidence import kalman_numpy
from trustbo.inference.posterior_groups import Conditional, complete, is_weighted
from trustbo.inference.posterior_tree import missions_of, require_posterior
from trustbo.stacking import stack_missions


def by_rate(posterior: xr.DataTree, missions: Sequence[Mission] | None = None) -> xr.DataTree:
    """Flatten a posterior to one dimension of measured rates, each predicted from those before.

    A posterior's own observations are whole missions, as the rates of a mission depend on each
    other: `az.loo` leaves out missions. ArviZ's functions of single observations (`loo_pit`,
    `plot_loo_pit`, `loo_expectations`, `loo_metrics`, `loo_influence`, PIT of predictions) read
    this view. Its likelihood is p(rate of bound k | draw, rates of the mission before k), whose
    product over a mission is the mission's; its predictions are draws from the same.

    Args:
        posterior: DataTree from `fit`, or one of `Result.posteriors`.
        missions: Missions that it was fitted to; needed where it holds no data.

    Returns:
        DataTree with `posterior`, `sample_stats`, `prior` and `log_prior` unchanged, and
        `observed_data`, `posterior_predictive`, `prior_predictive` and `log_likelihood` of
        `contact_rate`, over (chain, draw, rate), with the mission, bound and robot of each rate as
        coordinates; predictions of the prior are of whole missions, as in `posterior`. Rates that
        were not measured are left out. Where missions have weights, the last is called
        `rate_log_likelihood`, as `az.loo` would take it for that of an unweighted posterior.

    Raises:
        TrustboError: Trust does not integrate out under its observations, or robots influence each
            other; no posterior of `fit`; or see `complete`.
    """
    conditional = Conditional.of(require_posterior("by_rate", posterior))
    if not (conditional.by_numpy and conditional.family.integrates_out):
        raise TrustboError(
            "rates are predicted one by one for Gaussian observations of robots that do not "
            f'influence each other; this posterior has observation "{conditional.family.name}" and '
            f'inter_robot="{posterior.attrs["inter_robot"]}". Use its own groups, by mission.'
        )
    posterior = complete(posterior, missions)
    missions = missions_of(posterior)
    batch = stack_missions(missions, pad=False)
    params = params_of_missions(posterior, missions, batch)
    measured = np.isfinite(batch.contact_rate)
    mean, sd = (a[:, measured] for a in kalman_numpy.one_step(params, batch))
    y = batch.contact_rate[measured]
    rng = np.random.default_rng([posterior.attrs["seed"], 2])
    drawn = mean + sd * rng.standard_normal(mean.shape)
    density = -0.5 * ((y - mean) / sd) ** 2 - np.log(sd * np.sqrt(2.0 * np.pi))
    if posterior.attrs["log_likelihood_of"] == "ticks":
        density += conditional.family.log_resolution(batch.contact_rate, batch.n_ticks)[measured]
    draws = posterior["posterior"].to_dataset()
    shape = draws.sizes["chain"], draws.sizes["draw"], len(y)
    j, k, i = np.nonzero(measured)
    robots = np.array(missions[0].robots)
    coords = {
        "rate": np.arange(len(y)),
        "mission": ("rate", j),
        "bound": ("rate", k + 1),
        "robot": ("rate", robots[i]),
    }
    index = coords | {"chain": draws["chain"], "draw": draws["draw"]}
    dims = ("chain", "draw", "rate")
    before = posterior["prior_predictive"].to_dataset()["contact_rate"].values[..., measured]
    likelihood = "rate_log_likelihood" if is_weighted(posterior) else "log_likelihood"
    kept = ("posterior", "sample_stats", "prior", "log_prior")
    groups = {name: posterior[name].to_dataset() for name in kept if name in posterior.children} | {
        "observed_data": xr.Dataset({"contact_rate": ("rate", y)}, coords),
        "posterior_predictive": xr.Dataset({"contact_rate": (dims, drawn.reshape(shape))}, index),
        "prior_predictive": xr.Dataset({"contact_rate": (dims, before)}, coords),
        likelihood: xr.Dataset({"contact_rate": (dims, density.reshape(shape))}, index),
    }
    view = xr.DataTree.from_dict(groups)
    view.attrs = posterior.attrs
    return view
