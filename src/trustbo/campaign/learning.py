"""Learning of a campaign: from its missions to a posterior, a hazard and a belief."""

import warnings
from typing import Any

import numpy as np
import xarray as xr

from trustbo.campaign.checks import never_to_be_learned
from trustbo.campaign.options import CampaignOptions
from trustbo.campaign.posteriors import Posterior
from trustbo.campaign.state import LEARNED, SET_ASIDE, TOLD, CampaignState
from trustbo.data import Mission
from trustbo.display import say
from trustbo.errors import PosteriorError, TrustboError
from trustbo.files import interpreting
from trustbo.hazard import fit_hazard
from trustbo.hazard.exposures import LostMission
from trustbo.hazard.risk import BoundRisk
from trustbo.inference import diagnostics, fit, params_of, sample_prior
from trustbo.inference.posterior_groups import parameters_alone
from trustbo.inference.samplers.choice import resolve_sampler
from trustbo.inference.samplers.settings import NutsSettings
from trustbo.models import HumanTrust, default_model
from trustbo.models.model import TrustModel, require_model
from trustbo.models.params import Params
from trustbo.workspace import Workspace

_N_DRAWS = 1000


class CannotLearnError(TrustboError):
    """Missions for which every sampler was refused."""


class Learner:
    """Fit and hazard of a campaign, and the belief that its plans are made from.

    Attributes:
        workspace: Workspace of the missions.
        options: Options of the campaign.
        model: Trust model, by default `default_model()`.
        sampler: Sampler of the posterior.
        belief: Parameter draws: the posterior's, or, before the first mission, one from the prior.
        observation: Family of observations of the belief.
        progress: Whether fits show their progress, see `tb.fit`.
    """

    progress: bool = True

    def __init__(
        self,
        workspace: Workspace,
        options: CampaignOptions,
        model: TrustModel | None,
        sampler: str,
        seed: int,
    ) -> None:
        """Begin with the prior, drawn by a seed; see `Campaign` for what is refused."""
        if model is None:
            model = default_model()
        _require_learnable(model, sampler, options)
        self.workspace, self.options, self.model, self.sampler = workspace, options, model, sampler
        self._prior = _prior_belief(model, options.initial, workspace, seed)
        self._believe(None)
        self._hazard: tuple[object, xr.Dataset, BoundRisk] | None = None

    def take(self, state: CampaignState, seed: int) -> None:
        """Learn from the last mission of a state, or exclude it where nothing can be learned."""
        entry = state.entries[-1]
        if reason := never_to_be_learned(entry.mission):
            entry.become(SET_ASIDE, reason)
            warnings.warn(f"mission {len(state.entries)} is set aside: {reason}", stacklevel=4)
        else:
            self.learn(state, seed)

    def learn(self, state: CampaignState, seed: int) -> None:
        """Fit the posterior of all missions that are not excluded; if it is refused, go on."""
        entries, waiting = state.entries, state.numbers(TOLD)
        numbers, last = state.numbers(TOLD, LEARNED), state.last
        if not numbers:
            entries[-1].posterior = None
            self._believe(None)
            return
        try:
            tree = self._fit([entries[j].mission for j in numbers], state.last_tree, seed)
        except CannotLearnError as error:
            for j in waiting:
                entries[j].become(TOLD, str(error))
            belief = "the prior" if last is None else "the posterior before"
            reason = str(error).rstrip(".")
            warnings.warn(
                f"mission {len(entries)} is kept, but cannot be learned from yet: {reason}. "
                f"The campaign goes on with {belief}, and tries again with the next mission.",
                stacklevel=5,
            )
            return
        tree.attrs["missions"] = numbers
        tree["hazard"] = xr.DataTree(self.hazard(state)[0])
        if "latent" not in tree.children:
            tree = parameters_alone(tree)
        if last is not None:
            last.shrink()
        for j in waiting:
            entries[j].become(LEARNED)
        entries[-1].row |= diagnostics(tree)
        excluded = len(entries) - len(numbers)
        name = f"{len(entries):04d}" + (f"-{excluded}" if excluded else "")
        entries[-1].posterior = Posterior(name, tree)
        self._believe(tree)

    def restore(self, state: CampaignState) -> None:
        """Restore the belief after the missions of a state that was read from files."""
        if (last := state.last) is not None:
            tree = last()
            with interpreting(last.file or ""):
                self._believe(tree)

    def _believe(self, tree: xr.DataTree | None) -> None:
        """Set the belief to a posterior, or to the prior if there is none."""
        self.belief = self._prior if tree is None else params_of(tree)
        family = self.model.family.name
        self.observation: str = family if tree is None else tree.attrs["observation"]

    def hazard(self, state: CampaignState) -> tuple[xr.Dataset, BoundRisk]:
        """Fit the hazard to all missions of a state when it is first asked for, see `fit_hazard`.

        Returns the group `hazard` of the posterior, of the prior at first; and the chances of the
        bounds to fail under it.
        """
        key = len(state.entries), len(state.failures), tuple(state.numbers(SET_ASIDE))
        if self._hazard is None or self._hazard[0] != key:
            hazard, last = self._fit_hazard(state), state.last_tree
            if hazard is None and last is not None and "hazard" in last.children:
                hazard = last["hazard"].to_dataset()
            if hazard is None:
                hazard = fit_hazard([], self.workspace, self.options.prior_hazard)
            self._hazard = key, hazard, BoundRisk.of(hazard, self.workspace)
        return self._hazard[1:]

    def _fit_hazard(self, state: CampaignState) -> xr.Dataset | None:
        """Fit the hazard of bounds to all missions that were not excluded by hand.

        A mission excluded because it measured no contact rate still shows where it failed.
        None, with a warning, where the posterior is refused.
        """
        measured = [
            entry.measured
            for entry in state.entries
            if entry.state != SET_ASIDE or never_to_be_learned(entry.mission)
        ]
        lost = [LostMission(f.path, f.reason, f.where) for f in state.failures if f.path]
        try:
            return fit_hazard(
                measured, self.workspace, self.options.prior_hazard, lost=lost,
                seed=state.seed_of("hazard"),
            )  # fmt: skip
        except PosteriorError as error:
            warnings.warn(f"{error} The campaign goes on with the hazard before.", stacklevel=5)
            return None

    def _fit(self, missions: list[Mission], last: xr.DataTree | None, seed: int) -> xr.DataTree:
        """Fit the posterior of missions; `last` is that of some of them.

        One that is refused is tried again in other ways. CannotLearnError: every attempt failed.
        """
        reason = ""
        for shift, (sampler, sampling) in enumerate(self._attempts()):
            if reason:
                more = f'sampler "{sampler}" and {sampling["draws"]} draws a chain'
                line = f"another try, with {more}, as the last failed: {reason}."
                if self.progress:
                    say(line)
            try:
                return fit(
                    missions, self.model, sampler, workspace=self.workspace, earlier=last,
                    seed=seed + shift, progress=self.progress, whole=False, **sampling,
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
        """Sampler and sampling options of each attempt."""
        sampler, _ = resolve_sampler(self.model, self.sampler)
        # Draws of the exact sampler are nearly independent, and effects of places make them large.
        n = _N_DRAWS // 4 if sampler == "exact" and self.model.place else _N_DRAWS
        asked = {"draws": n, **self.options.sampling}
        attempts = [(self.sampler, asked), (self.sampler, asked | {"draws": 2 * asked["draws"]})]
        other = "nuts" if sampler == "exact" else "exact"
        try:
            resolve_sampler(self.model, other)
        except TrustboError:
            return attempts
        shared = NutsSettings.of(asked | {"draws": 2 * max(asked["draws"], _N_DRAWS)}).shared
        return [*attempts, (other, shared)]


def _require_learnable(model: TrustModel, sampler: str, options: CampaignOptions) -> None:
    require_model(model)
    if isinstance(model, HumanTrust):
        raise TrustboError(
            "HumanTrust is of reports of people, and plans no paths: give a campaign another "
            "model, and fit reports by trustbo.fit."
        )
    resolved, _ = resolve_sampler(model, sampler)
    NutsSettings.of(options.sampling).require_sampler(resolved)


def _prior_belief(model: TrustModel, initial: str, workspace: Workspace, seed: int) -> Params:
    """Draw from the prior, or take its mean, with a leading axis (draw,) of length 1."""
    n_robots, n_features = len(workspace.team.robots), len(workspace.features)
    model = model.for_features(workspace.features)
    if initial == "prior_mean" and model.priors_are_independent:
        values = model.priors.mean(n_features)
        sizes = model.sizes(n_robots, n_features)
        means = {name: np.broadcast_to(values[name], (1, *sizes[name])) for name in sizes}
        return model.params(means, n_features).flat()
    # The mean of parameters that robots are drawn around has no closed form.
    n_draws = 1 if initial == "prior_draw" else 1000
    mean = sample_prior(model, n_features, n_draws, seed, n_robots=n_robots).mean()
    return mean.flat()
