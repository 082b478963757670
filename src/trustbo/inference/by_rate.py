"""View of a posterior in which each contact rate is an observation, for ArviZ."""

from collections.abc import Sequence

import numpy as np
import xarray as xr

from trustbo.data import Mission
from trustbo.errors import TrustboError
from trustbo.inference.draws import missions_of, read_posterior, require_posterior
from trustbo.inference.engine import cholesky, expected
from trustbo.inference.posterior import Posterior, at
from trustbo.inference.tree import complete
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
    y, n = fitted.slots.y, len(draws.c)
    measured = ~np.isnan(y)
    mean, sd = np.empty((2, n, int(measured.sum())))
    for i in range(n):
        one = slice(i, i + 1)
        mean[i], sd[i] = (
            a[measured] for a in _one_step(fitted, at(draws.theta, one), draws.c[one])
        )

    seen, rng = y[measured], np.random.default_rng([posterior.attrs["seed"], 2])
    drawn = mean + sd * rng.standard_normal(mean.shape)
    density = -0.5 * ((seen - mean) / sd) ** 2 - np.log(sd * np.sqrt(2.0 * np.pi))
    if posterior.attrs["log_likelihood_of"] == "ticks":
        density += fitted.model.family.log_resolution(y, fitted.slots.n_ticks)[measured]

    sites = posterior["posterior"].to_dataset()
    shape = sites.sizes["chain"], sites.sizes["draw"], len(seen)
    j, k, i = np.nonzero(measured)
    robots = np.array((missions or missions_of(posterior))[0].robots)
    coords = {
        "rate": np.arange(len(seen)),
        "mission": ("rate", j),
        "bound": ("rate", k + 1),
        "robot": ("rate", robots[i]),
    }
    index, dims = (
        coords | {"chain": sites["chain"], "draw": sites["draw"]},
        ("chain", "draw", "rate"),
    )
    before = posterior["prior_predictive"].to_dataset()["contact_rate"].values[..., measured]
    groups = {name: posterior[name].to_dataset() for name in _KEPT if name in posterior.children}
    for name, values in (("posterior_predictive", drawn), ("log_likelihood", density)):
        groups[name] = xr.Dataset({"contact_rate": (dims, values.reshape(shape))}, index)
    groups["observed_data"] = xr.Dataset({"contact_rate": ("rate", seen)}, coords)
    groups["prior_predictive"] = xr.Dataset({"contact_rate": (dims, before)}, coords)
    view = xr.DataTree.from_dict(groups)
    view.attrs = posterior.attrs
    return view


def _one_step(
    fitted: Posterior, theta: dict[str, np.ndarray], c: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Mean and sd of each rate given those before it in its mission, (mission, bound, robot).

    One draw. The joint covariance of a mission's rates is factored in the order (bound, robot).
    """
    slots, layout = fitted.slots, fitted.layout
    signal = fitted.model.signal(theta, slots, fitted.layout)
    mean = layout.slots(expected(fitted.blocks, signal, c))[0]
    n, K, R = slots.y.shape
    V = each(signal.covariance, layout.label)[0]
    if layout.joint:
        V = np.broadcast_to(V, (n, K * R, K * R))
    else:
        V = np.broadcast_to(V, (n * R, K, K)).reshape(n, R, K, K)
        rotation = np.eye(R) if layout.rotation is None else layout.rotation
        V = np.einsum("ri,rj,nrkl->nkilj", rotation, rotation, V).reshape(n, K * R, K * R)
    noise = np.broadcast_to(signal.sd[0, 0] ** 2, K * R)
    seen = ~np.isnan(slots.y).reshape(n, -1)
    both = seen[:, :, None] & seen[:, None, :]
    L = cholesky(np.where(both, V + np.diag(noise), np.eye(K * R)))
    off = np.where(seen, slots.y.reshape(n, -1) - mean.reshape(n, -1), 0.0)
    white = np.linalg.solve(L, off[..., None])[..., 0]
    sd = np.diagonal(L, axis1=1, axis2=2)
    given = np.where(seen, slots.y.reshape(n, -1), np.nan) - sd * white
    return given.reshape(n, K, R), sd.reshape(n, K, R)
