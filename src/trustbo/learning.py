"""How a campaign learns: the model, its sampler, and what a mission counts."""

import warnings
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
import xarray as xr

from trustbo.data import Mission
from trustbo.errors import TrustboError, require_choice
from trustbo.models import (
    PooledTrust,
    TrustModel,
    TrustParams,
    fit,
    moment_matched,
    params_of,
    sample_prior,
)
from trustbo.models.gram import require_forgetting
from trustbo.models.params import Params
from trustbo.models.sampling import SAMPLERS, require_sampler

INITIAL = ("prior_draw", "prior_mean")
UPDATES = ("refit", "moment_matched")


@dataclass(frozen=True)
class Learning:
    """What `Campaign` learns with; see there.

    Raises:
        TrustboError: An unknown name; a sampler that does not suit the model; or a model that
            cannot be updated so.
    """

    model: TrustModel
    sampler: str
    update: str
    forgetting: float

    def __post_init__(self) -> None:
        if not isinstance(self.model, TrustModel):
            raise TrustboError(
                f"model must be a trust model, e.g. PooledTrust(); got {self.model!r}."
            )
        require_sampler(self.model, require_choice("sampler", self.sampler, SAMPLERS))
        require_choice("update", self.update, UPDATES)
        if require_forgetting(self.forgetting) < 1.0 and (
            self.update != "refit" or self.model.observation != "gaussian"
        ):
            raise TrustboError(
                f'forgetting = {self.forgetting:g} needs update "refit" and Gaussian observations; '
                f'got "{self.update}" and "{self.model.observation}".'
            )
        if self.update == "moment_matched":
            if not isinstance(self.model, PooledTrust):
                raise TrustboError(
                    f'update="moment_matched" is for PooledTrust; got {type(self.model).__name__}.'
                )
            warnings.warn(
                'update="moment_matched" is for comparison with the 2023 code: over 20 missions it '
                'is off by up to 1.15 posterior standard deviations. update="refit" is exact.',
                stacklevel=4,
            )

    def posterior(
        self, missions: list[Mission], last: xr.DataTree | None, seed: int
    ) -> xr.DataTree:
        """The posterior given missions, the `last` being that before the last of them.

        Raises:
            PosteriorError: Its diagnostics are bad.
        """
        if self.update == "moment_matched":
            priors = self.model.priors
            if last is not None:
                priors = moment_matched(cast(TrustParams, params_of(last)), priors)
            return fit(missions[-1:], replace(self.model, priors=priors), self.sampler, seed=seed)
        weights = None
        if self.forgetting < 1.0:
            weights = self.forgetting ** np.arange(len(missions) - 1, -1, -1)
        return fit(missions, self.model, self.sampler, weights=weights, seed=seed)

    def prior_belief(self, initial: str, n_robots: int, n_features: int, seed: int) -> Params:
        """One draw from the prior, or its mean, as draws with leading axis (draw,) of length 1."""
        if initial == "prior_mean" and isinstance(self.model, PooledTrust):
            priors = self.model.priors
            x0 = {"x0_mean": priors.x0_mean, "x0_sd": priors.x0_sd}
            mean = TrustParams(**priors.mean(n_features), **x0)
        else:
            # What robots have in common has a mean in no closed form.
            n_draws = 1 if initial == "prior_draw" else 1000
            mean = sample_prior(self.model, n_features, n_draws, seed, n_robots=n_robots).mean()
        return type(mean)(*(np.asarray(value, dtype=float)[None] for value in mean))
