"""Learning of a campaign: its model, its sampler, and the weight of a mission."""

import warnings
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
import xarray as xr

from trustbo.data import Mission
from trustbo.errors import TrustboError, require_choice
from trustbo.models import (
    TrustModel,
    TrustParams,
    fit,
    moment_matched,
    params_of,
    sample_prior,
)
from trustbo.models.model import require_model
from trustbo.models.params import Params
from trustbo.models.samplers.run import SAMPLERS, require_sampler
from trustbo.zheng2023 import MOMENT_MATCHED_WARNING


@dataclass(frozen=True)
class Learning:
    """Model, sampler and way of updating; see `CampaignOptions`, which checks each by itself.

    Raises:
        TrustboError: An unknown sampler; a sampler that does not suit the model; or a model that
            cannot be updated so.
    """

    model: TrustModel
    sampler: str
    update: str
    forgetting: float

    def __post_init__(self) -> None:
        require_model(self.model)
        require_sampler(self.model, require_choice("sampler", self.sampler, SAMPLERS))
        if self.forgetting < 1.0 and (
            self.update != "refit" or not self.model.family.integrates_out
        ):
            raise TrustboError(
                f'forgetting = {self.forgetting:g} needs update "refit" and Gaussian observations; '
                f'got "{self.update}" and "{self.model.observation}".'
            )
        if self.update == "moment_matched":
            if not self.model.priors_are_independent:
                raise TrustboError(
                    f'update="moment_matched" is for PooledTrust; got {type(self.model).__name__}.'
                )
            warnings.warn(MOMENT_MATCHED_WARNING, stacklevel=5)

    def posterior(
        self, missions: list[Mission], last: xr.DataTree | None, seed: int
    ) -> xr.DataTree:
        """Fit the posterior of missions.

        Args:
            missions: All missions so far.
            last: Posterior before the last of them.
            seed: Seed of the sampler.

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
        """Draw from the prior, or take its mean, with a leading axis (draw,) of length 1."""
        if initial == "prior_mean" and self.model.priors_are_independent:
            priors = self.model.priors
            x0 = {"x0_mean": priors.x0_mean, "x0_sd": priors.x0_sd}
            mean = TrustParams(**priors.mean(n_features), **x0)
        else:
            # The mean of parameters that robots share has no closed form.
            n_draws = 1 if initial == "prior_draw" else 1000
            mean = sample_prior(self.model, n_features, n_draws, seed, n_robots=n_robots).mean()
        return type(mean)(*(np.asarray(value, dtype=float)[None] for value in mean))
