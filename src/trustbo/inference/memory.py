"""Whether trust carries over from one bound to the next: the evidence with memory and without.

The model without memory has beta0 = 0, all other priors unchanged; its log evidence less that of
the model is the log Bayes factor. Both are means of importance weights. The density of beta0 at 0
under its posterior and prior, whose ratio is the same factor, is not estimated well by draws there.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import xarray as xr
from scipy.special import expit

from trustbo.data import Mission
from trustbo.errors import TrustboError, require_whole
from trustbo.inference.fit_data import FitData
from trustbo.inference.posterior_tree import require_posterior
from trustbo.inference.samplers.choice import resolve_sampler
from trustbo.inference.samplers.importance import sample_scores
from trustbo.inference.samplers.people import PeoplePosterior
from trustbo.inference.samplers.posterior import posterior_of
from trustbo.models.model import TrustModel
from trustbo.models.people import HumanTrust
from trustbo.models.pooled import PooledTrust
from trustbo.workspace import Workspace

_N_DRAWS = 400
_SURE = 0.95


class Memory(NamedTuple):
    """Evidence that trust carries over from one bound to the next."""

    log_bf: float
    """Log evidence of the model, beta0 > 0, less that of beta0 = 0."""
    beta0: float
    """Posterior mean of beta0 where it is not 0."""
    sd: float
    """Its standard deviation."""

    @property
    def p_none(self) -> float:
        """Probability of beta0 = 0, which is .5 before the missions."""
        return float(expit(-self.log_bf))

    def __str__(self) -> str:
        """Text of the finding."""
        factor = f"log Bayes factor {abs(self.log_bf):.1f} for beta0"
        if self.p_none < 1.0 - _SURE:
            size = f"beta0 {self.beta0:.2f} +- {self.sd:.2f}"
            return f"trust carries over from one bound to the next: {size}, {factor} > 0"
        if self.p_none > _SURE:
            return f"trust does not carry over from one bound to the next: {factor} = 0"
        side = "> 0" if self.log_bf > 0.0 else "= 0"
        return f"open whether trust carries over from one bound to the next: {factor} {side}"


def memory(
    posterior: xr.DataTree,
    missions: Sequence[Mission] | None = None,
    workspace: Workspace | None = None,
    *,
    model: TrustModel | None = None,
    seed: int = 0,
) -> Memory:
    """Weigh whether trust carries over from one bound to the next, against beta0 = 0.

    Args:
        posterior: Posterior of `PooledTrust`, with any effects, or of `HumanTrust`, by the exact
            sampler.
        missions: Missions that it was fitted to, or those of a campaign whose reports it is of; by
            default those it holds.
        workspace: Workspace of the missions, to fill in awareness that they lack, as for `fit`.
        model: Model of the posterior; needed with custom priors.
        seed: Seed of the draws without memory.

    Returns:
        The log Bayes factor `log_bf` of beta0 > 0 against beta0 = 0, the probability `p_none` of
        the latter, and the mean and sd of beta0; as text, the finding in words.

    Raises:
        TrustboError: A posterior of another model or sampler, without its missions, or with custom
            priors and no model.
    """
    seed = require_whole("seed", seed, 0)
    attrs = require_posterior("memory", posterior).attrs
    data = FitData.of(posterior, missions, workspace, model)
    model = data.model
    exact = isinstance(model, PooledTrust) and "log_evidence" in attrs
    if not exact or resolve_sampler(model, "auto")[0] != "exact":
        raise TrustboError(
            "memory is weighed under PooledTrust for rates of trust, by the exact sampler; got "
            f'{model.describe()} by "{attrs.get("sampler")}".'
        )
    slots = data.slots(model.place)
    if isinstance(model, HumanTrust):
        target = PeoplePosterior(model, slots, carries=False)
    else:
        target = posterior_of(model, slots, carries=False)
    without = sample_scores(target, _N_DRAWS, seed).draws.log_evidence
    beta0 = np.asarray(posterior["posterior"]["beta0"])
    log_bf = float(attrs["log_evidence"]) - without
    return Memory(log_bf, float(beta0.mean()), float(beta0.std()))
