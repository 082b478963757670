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
    """Flatten a posterior to one dimension of measured rates, each predicted from those before.

    A posterior's own observations are whole missions, as the rates of a mission depend on each
    other: `loo` leaves out missions. ArviZ's functions of single observations (`loo_pit`,
    `plot_loo_pit`, `loo_expectations`, `loo_metrics`, PIT of predictions) read this view. Its
    likelihood is p(rate | draw, rates of the mission before), whose product over a mission is the
    mission's; its predictions are draws from the same.

    Args:
        posterior: DataTree from `fit`, or one of `Result.posteriors`.
        missions: Missions that it was fitted to; needed where it holds no data.
        model: Its model; needed with custom priors.

    Returns:
        DataTree with `posterior`, `sample_stats`, `prior` and `log_prior` unchanged, and
        `observed_data`, `posterior_predictive`, `prior_predictive` and `log_likelihood` of
        `contact_rate`, over (chain, draw, rate), with the mission, bound and robot of each rate as
        coordinates. Rates that were not measured are left out.

    Raises:
        TrustboError: Rates that are not Gaussian, or no posterior of `fit`.
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
    """Mean and sd (draw, mission, bound, robot) of each rate given those before it in its mission.

    The covariance of the rates of a block is factored in their order, (bound, robot).
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
