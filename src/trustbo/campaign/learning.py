"""Learning of a campaign: its model, its sampler, and the weight of a mission."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, cast

import numpy as np
import xarray as xr

from trustbo.data import Mission
from trustbo.display.bars import place_of, say
from trustbo.errors import PosteriorError, TrustboError
from trustbo.inference import fit, moment_matched, params_of, sample_prior
from trustbo.inference.samplers.choice import resolve_sampler
from trustbo.inference.samplers.settings import NutsSettings
from trustbo.models import TrustModel, TrustParams
from trustbo.models.families import AUTO
from trustbo.models.model import require_model
from trustbo.models.params import Params
from trustbo.workspace import Workspace
from trustbo.zheng2023 import MOMENT_MATCHED_WARNING

_N_DRAWS = 1000


class CannotLearnError(TrustboError):
    """Missions that no sampler gives a posterior of."""


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
    sampling: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        require_model(self.model)
        sampler, _ = resolve_sampler(self.model, self.sampler)
        NutsSettings.of(self.sampling).require_sampler(sampler)
        gaussian = self.model.family.integrates_out and self.model.observation != AUTO
        if self.forgetting < 1.0 and not (self.update == "refit" and gaussian):
            raise TrustboError(
                f'forgetting = {self.forgetting:g} needs update "refit" and Gaussian observations; '
                f'got "{self.update}" and "{self.model.observation}".'
            )
        if self.update == "moment_matched":
            if self.model.robot_sets != "all" or not gaussian:
                raise TrustboError(
                    f'update="moment_matched" is for PooledTrust of Gaussian rates; got '
                    f"{self.model.describe()}."
                )
            warnings.warn(MOMENT_MATCHED_WARNING, stacklevel=5)

    def learn(
        self,
        missions: list[Mission],
        new: int,
        last: xr.DataTree | None,
        seed: int,
        workspace: Workspace | None = None,
        progress: bool = True,
    ) -> xr.DataTree:
        """Fit the posterior of missions; one that is refused is tried again in other ways.

        Args:
            missions: Missions to learn from, in order.
            new: Number of the last of them that `last` does not know.
            last: Posterior of the others.
            seed: Seed of the sampler.
            workspace: Workspace of the missions, where places have effects.
            progress: Whether NUTS and further attempts are shown, see `tb.fit`.

        Returns:
            Posterior of the parameters, see `inference.complete`.

        Raises:
            CannotLearnError: Every attempt failed.
        """
        model, weights = self.model, None
        if self.update == "moment_matched":
            priors = model.for_features(missions[0].features).priors
            if last is not None:
                priors = moment_matched(cast(TrustParams, params_of(last)), priors)
            model, missions = replace(model, priors=priors), missions[-new:]
        if self.forgetting < 1.0:
            weights = self.forgetting ** np.arange(len(missions) - 1, -1, -1)
        reason = ""
        for shift, (sampler, sampling) in enumerate(self._attempts()):
            if reason:
                more = f'sampler "{sampler}" and {sampling["draws"]} draws a chain'
                say(place_of(progress), f"another try, with {more}, as the last failed: {reason}.")
            try:
                return fit(
                    missions, model, sampler, workspace=workspace, earlier=last, weights=weights,
                    seed=seed + shift, progress=progress, whole=False, **sampling,
                )  # fmt: skip
            except PosteriorError as error:
                reason = error.reason
            except TrustboError as error:  # no other attempt would take these data
                raise CannotLearnError(str(error)) from error
            except Exception as error:  # a defect must not cost a mission that was driven
                if isinstance(error.__cause__, KeyboardInterrupt):  # numba makes it a SystemError
                    raise error.__cause__ from None
                reason = f"{type(error).__name__}: {error}"
        raise CannotLearnError(reason)

    def _attempts(self) -> list[tuple[str, dict[str, Any]]]:
        """Sampler of each attempt, and the number and care of its draws."""
        sampler, _ = resolve_sampler(self.model, self.sampler)
        # Draws of the exact sampler are nearly independent, and effects of places make them large.
        n = _N_DRAWS // 4 if sampler == "exact" and self.model.place else _N_DRAWS
        asked = {"draws": n, **self.sampling}
        attempts = [(self.sampler, asked), (self.sampler, asked | {"draws": 2 * asked["draws"]})]
        other = "nuts" if sampler == "exact" else "exact"
        try:
            resolve_sampler(self.model, other)
        except TrustboError:
            return attempts
        shared = NutsSettings.of(asked | {"draws": 2 * max(asked["draws"], _N_DRAWS)}).shared
        return [*attempts, (other, shared)]

    def prior_belief(
        self, initial: str, n_robots: int, features: Sequence[str], seed: int
    ) -> Params:
        """Draw from the prior, or take its mean, with a leading axis (draw,) of length 1."""
        model = self.model.observing("gaussian").for_features(features)
        n_features = len(features)
        if initial == "prior_mean" and model.priors_are_independent:
            values = model.priors.mean(n_features)
            sizes = model.sizes(n_robots, n_features)
            means = {name: np.broadcast_to(values[name], (1, *sizes[name])) for name in sizes}
            return model.params(means, n_features).flat()
        # The mean of parameters that robots are drawn around has no closed form.
        n_draws = 1 if initial == "prior_draw" else 1000
        mean = sample_prior(model, n_features, n_draws, seed, n_robots=n_robots).mean()
        return mean.flat()
