"""Whether trust carries over between bounds: the evidence with and without memory.

The model without memory has beta0 = 0, all other priors unchanged; the difference of the log
evidences is the log Bayes factor. Both are estimated by means of importance weights.
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
        log_bf: Log evidence for beta0 > 0 minus log evidence for beta0 = 0.
        beta0: Posterior mean of beta0 under beta0 > 0.
        sd: Posterior standard deviation of beta0 under beta0 > 0.
    """

    log_bf: float
    beta0: float
    sd: float

    @property
    def p_none(self) -> float:
        """Posterior probability of beta0 = 0, with prior probability .5."""
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
    """Compare the evidence that trust carries over between bounds with beta0 = 0.

    Args:
        posterior: Posterior of a model with one beta0, `PooledTrust`, `HierarchicalTrust` or
            `HumanTrust`, by importance sampling.
        missions: Missions of the fit; by default the data in the posterior.
        model: Model of the posterior; needed with custom priors.

    Raises:
        TrustboError: If the posterior is of another model or sampler, lacks its missions, or has
            custom priors and no model is given.
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
