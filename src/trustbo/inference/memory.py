"""Whether trust carries over from one bound to the next: the evidence with memory and without.

The model without memory has beta0 = 0, all other priors unchanged; its log evidence less that of
the model is the log Bayes factor. Both are means of importance weights.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import xarray as xr
from scipy.special import expit

from trustbo.data import Mission
from trustbo.errors import TrustboError
from trustbo.inference.draws import read_posterior, require_posterior
from trustbo.inference.fit import by_importance
from trustbo.inference.posterior import Posterior
from trustbo.models.model import TrustModel
from trustbo.models.pooled import PooledTrust
from trustbo.parallel import one_blas_thread

_SURE = 0.95


class Memory(NamedTuple):
    """Evidence that trust carries over from one bound to the next.

    Attributes:
        log_bf: Log evidence of the model, beta0 > 0, less that of beta0 = 0.
        beta0: Posterior mean of beta0 where it is not 0.
        sd: Its standard deviation.
    """

    log_bf: float
    beta0: float
    sd: float

    @property
    def p_none(self) -> float:
        """Probability of beta0 = 0, which is .5 before the missions."""
        return float(expit(-self.log_bf))

    def __str__(self) -> str:
        """Text of the finding."""
        factor = f"log Bayes factor {abs(self.log_bf):.1f} for beta0"
        factor += " > 0" if self.log_bf > 0.0 else " = 0"
        if self.p_none < 1.0 - _SURE:
            return f"trust carries over: beta0 {self.beta0:.2f} +- {self.sd:.2f}, {factor}"
        if self.p_none > _SURE:
            return f"trust does not carry over: {factor}"
        return f"open whether trust carries over: {factor}"


@one_blas_thread()
def memory(
    posterior: xr.DataTree,
    missions: Sequence[Mission] | None = None,
    *,
    model: TrustModel | None = None,
) -> Memory:
    """Weigh whether trust carries over from one bound to the next, against beta0 = 0.

    Args:
        posterior: Posterior of a model with one beta0, `PooledTrust`, `HierarchicalTrust` or
            `HumanTrust`, by importance sampling.
        missions: Missions that it was fitted to; by default those it holds.
        model: Model of the posterior; needed with custom priors.

    Raises:
        TrustboError: A posterior of another model or sampler, without its missions, or with custom
            priors and no model.
    """
    attrs = require_posterior("memory", posterior).attrs
    fitted, _ = read_posterior(posterior, missions, model=model)
    if not isinstance(fitted.model, PooledTrust) or "log_evidence" not in attrs:
        raise TrustboError(
            "memory is weighed under models with one beta0, by importance sampling; got "
            f'{fitted.model.in_short()} by "{attrs["sampler"]}".'
        )
    without = Posterior(fitted.model, fitted.slots, memoryless=True)
    log_evidence = by_importance(without, 1000, attrs["seed"])[2]["log_evidence"]
    beta0, log_bf = np.asarray(posterior["posterior"]["beta0"]), attrs["log_evidence"]
    return Memory(float(log_bf - log_evidence), float(beta0.mean()), float(beta0.std()))
