"""View of a posterior in which each contact rate is an observation, for ArviZ."""

from collections.abc import Sequence

import numpy as np
import xarray as xr

from trustbo.data import Mission
from trustbo.errors import TrustboError
from trustbo.inference.draws import missions_of, read_posterior, require_posterior
from trustbo.inference.engine import expected
from trustbo.inference.factor import cholesky
from trustbo.inference.posterior import Draws, Posterior, chunks
from trustbo.inference.tree import complete
from trustbo.models.families.moments import log_normal
from trustbo.models.model import TrustModel
from trustbo.models.signal import each
from trustbo.parallel import one_blas_thread

_KEPT = ("posterior", "sample_stats", "prior", "log_prior")


@one_blas_thread()
def by_rate(
    posterior: xr.DataTree,
    missions: Sequence[Mission] | None = None,
    *,
    model: TrustModel | None = None,
) -> xr.DataTree:
    """Flatten a posterior to one dimension of rates, each predicted from the earlier ones.

    In a posterior, whole missions are the observations, as the rates of a mission depend on each
    other; `loo` leaves out missions. Use this view with ArviZ functions for single observations
    (`loo_pit`, `plot_loo_pit`, `loo_expectations`, `loo_metrics`). Its likelihood is p(rate | draw,
    earlier rates of the mission), whose product is the likelihood of the mission; predictions are
    drawn from this distribution.

    Args:
        posterior: DataTree from `fit`, or one of `Result.posteriors`.
        missions: Missions of the fit; needed if the posterior holds no data.
        model: Model of the posterior; needed with custom priors.

    Returns:
        DataTree with `posterior`, `sample_stats`, `prior` and `log_prior` unchanged, and
        `observed_data`, `posterior_predictive`, `prior_predictive` and `log_likelihood` of
        `contact_rate`, over (chain, draw, rate), with the mission, bound and robot of each rate as
        coordinates. Unmeasured rates are omitted.

    Raises:
        TrustboError: If rates are not Gaussian, or the posterior is not from `fit`.
    """
    posterior = complete(require_posterior("by_rate", posterior), missions, model=model)
    fitted, draws = read_posterior(posterior, missions, model=model)
    if not fitted.exact:
        raise TrustboError(
            f'rates are predicted one by one for observation "gaussian"; this posterior has '
            f'"{fitted.model.observation}". Use its own groups, by mission.'
        )
    y, robots = fitted.slots.y, (missions or missions_of(posterior))[0].robots
    measured = ~np.isnan(y)
    mean, sd = (a[:, measured] for a in _one_step(fitted, draws))
    seen, rng = y[measured], np.random.default_rng([posterior.attrs["seed"], 2])
    drawn = mean + sd * rng.standard_normal(mean.shape)
    density = log_normal(seen - mean, sd**2)
    if posterior.attrs["log_likelihood_of"] == "ticks":
        density += fitted.model.family.log_resolution(y, fitted.slots.n_ticks)[measured]

    j, k, i = np.nonzero(measured)
    coords = {"rate": np.arange(len(seen)), "mission": ("rate", j), "bound": ("rate", k + 1)}
    coords["robot"] = "rate", np.array(robots)[i]
    before = posterior["prior_predictive"].to_dataset()["contact_rate"].values[..., measured]
    groups = {name: posterior[name].to_dataset() for name in _KEPT if name in posterior.children}
    sizes = posterior["posterior"].sizes
    shape, dims = (sizes["chain"], sizes["draw"], len(seen)), ("chain", "draw", "rate")
    for name, axes, values in (
        ("posterior_predictive", dims, drawn.reshape(shape)),
        ("log_likelihood", dims, density.reshape(shape)),
        ("prior_predictive", dims, before),
        ("observed_data", "rate", seen),
    ):
        groups[name] = xr.Dataset({"contact_rate": (axes, values)}, coords)
    view = xr.DataTree.from_dict(groups)
    view.attrs = posterior.attrs
    return view


def _one_step(fitted: Posterior, draws: Draws) -> tuple[np.ndarray, np.ndarray]:
    """Mean and sd (draw, mission, bound, robot) of each rate given earlier ones of its mission.

    The covariance of a block's rates is factored in the order (bound, robot).
    """
    model, slots = fitted.model, fitted.slots
    blocks, layout = fitted.by_robot()
    seen, y, found = blocks.seen[blocks.kind], blocks.y, []
    both, one = seen[:, :, None] & seen[:, None, :], np.eye(y.shape[1])
    for where, theta in chunks(draws.theta):
        signal = model.signal(theta, slots, layout)
        V = each(signal.covariance, blocks.label) + signal.sd[..., None] ** 2 * one
        V = each(V, blocks.kind) if V.shape[1] > 1 else V
        L = cholesky(np.where(both, V, one))
        off = np.where(seen, y - expected(blocks, signal, draws.c[where]), 0.0)
        sd = np.diagonal(L, axis1=2, axis2=3)
        found.append((y - sd * np.linalg.solve(L, off[..., None])[..., 0], sd))
    mean, sd = (np.concatenate(part) for part in zip(*found, strict=True))
    return layout.slots(mean), layout.slots(sd)
