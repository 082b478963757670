"""Learning mission by mission: statistics that add up, and, for comparison, matched moments."""

from dataclasses import replace
from typing import NamedTuple

import jax
import numpy as np
import numpyro.distributions as dist
from numpyro.distributions import Distribution, constraints

from trustbo.errors import require_whole
from trustbo.models.exact import sample_exact
from trustbo.models.gram import Statistics
from trustbo.models.model import TrustModel
from trustbo.models.params import Params, TrustParams, params_from
from trustbo.models.priors import Priors


class ExactPosterior(NamedTuple):
    """Draws of the parameters alone, and how well they were got."""

    params: Params
    """Leading axis (draw,)."""
    k_hat: float
    """Good below 0.5; above 0.7 do not use it."""
    kish: float
    """Effective number of the sampler's points."""
    log_evidence: float
    """Log p(all contact rates), nats."""


def sample_statistics(
    model: TrustModel, statistics: Statistics, *, n_draws: int = 4000, seed: int = 0
) -> ExactPosterior:
    """Draws of the parameters from what `TrustModel.update` gathered, by the exact sampler.

    Args:
        model: The model that gathered them.
        statistics: Of all missions.
        n_draws: How many near-independent, equally weighted draws.
        seed: Same seed, same draws.

    Raises:
        TrustboError: A model without such statistics, or priors that are not conjugate.
    """
    model.require_exact()
    require_whole("n_draws", n_draws, 1)
    each = [sample_exact(s, model.priors, n_draws, seed + i) for i, s in enumerate(statistics)]
    pooled = model.robot_sets == "all"
    sites = {
        name: each[0].params[name] if pooled else np.stack([e.params[name] for e in each], axis=1)
        for name in each[0].params
    }
    return ExactPosterior(
        params_from(sites, model.x0),
        max(e.khat for e in each),
        min(e.kish for e in each),
        sum(e.log_evidence for e in each),
    )


def moment_matched(params: TrustParams, priors: Priors) -> Priors:
    """Priors with the mean and sd of posterior draws: the later code's way to go on.

    Each parameter keeps its own moments only; what the posterior knew of how they go together, and
    its skewness, is lost, and so is exactness: off by up to 1.15 posterior sd over 20 missions.

    Args:
        params: Draws of the last posterior, leading axis (draw,).
        priors: The priors it came from, for what is not learned.
    """
    flat = params.flat()
    with jax.enable_x64(True):
        return replace(
            priors,
            beta0=_match(flat.beta0, priors.beta0),
            beta=_match(flat.beta, priors.beta),
            b=_match(flat.b, priors.b),
            delta_w=_match(flat.delta_w, priors.delta_w),
            delta_v=_match(flat.delta_v, priors.delta_v),
        )


def _match(draws: np.ndarray, prior: Distribution) -> Distribution:
    mean, var = draws.mean(0), draws.var(0)
    if prior.support is constraints.unit_interval:
        total = mean * (1.0 - mean) / var - 1.0
        return dist.Beta(mean * total, (1.0 - mean) * total)
    if prior.support is constraints.positive:
        log_var = np.log1p(var / mean**2)
        return dist.LogNormal(np.log(mean) - 0.5 * log_var, np.sqrt(log_var))
    return dist.Normal(mean, np.sqrt(var))
