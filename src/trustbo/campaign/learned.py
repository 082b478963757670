"""Missions of a campaign and all that is learned from them: posterior, hazard, and belief."""

import warnings
from collections.abc import Sequence

import numpy as np
import pandas as pd
import xarray as xr

from trustbo.campaign.failures import learn_hazard
from trustbo.campaign.history import (
    LEARNED,
    TOLD,
    History,
    Posterior,
    table_of,
    whole_posterior,
)
from trustbo.campaign.learning import CannotLearnError
from trustbo.campaign.options import CampaignOptions
from trustbo.data import Mission
from trustbo.errors import require_kind, require_whole
from trustbo.hazard import BoundRisk, fit_hazard
from trustbo.inference import diagnostics, params_of
from trustbo.inference.posterior_groups import parameters_alone
from trustbo.models import TrustModel
from trustbo.models.params import Params
from trustbo.planning import Plan
from trustbo.workspace import Workspace

_STREAMS = ("policy", "fit", "mission", "prior", "awareness", "hazard")


class LearnedMissions:
    """Missions told so far, and what is learned from them; the base of `Campaign`.

    Attributes:
        workspace: Workspace of the paths.
        options: Options of the campaign.
        model: Trust model.
        seed: Seed of everything random.
        log: Missions as measured, their states, plans, posteriors and failures (a `History`).
        belief: Parameter draws that the next plan is made from: the posterior's, or, before the
            first mission, one from the prior.
        progress: Whether fits show their progress, see `tb.fit`; `iterate` and `missions` set
            it.
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
        """Begin with the prior."""
        require_kind("workspace", workspace, Workspace, "give a trustbo.Workspace")
        self.workspace, self.options, self.log = workspace, options, History()
        self._learning = options.learning(model, sampler)
        self.model, self.seed = self._learning.model, require_whole("seed", seed, 0)
        self._hazard: xr.Dataset | None = None
        self._risk: BoundRisk | None = None
        self._whole: tuple[Posterior, xr.DataTree] | None = None
        n_robots, seed_of_prior = len(workspace.team.robots), self.seed_of("prior")
        self._prior: Params = self._learning.prior_belief(
            options.initial, n_robots, workspace.features, seed_of_prior
        )
        self.belief = self._prior

    @property
    def missions(self) -> list[Mission]:
        """Missions told so far, their awareness filled in."""
        return self.log.missions

    @property
    def waiting(self) -> list[Mission]:
        """Missions that were told, and are to be learned from with a later one."""
        return [self.log.entries[j].measured for j in self.log.numbers(TOLD)]

    @property
    def posteriors(self) -> Sequence[xr.DataTree]:
        """Posterior of the parameters after each mission; None where nothing was learned yet."""
        return self.log.posteriors

    @property
    def plans(self) -> list[Plan]:
        """Plan of each mission."""
        return [entry.plan for entry in self.log.entries]

    @property
    def posterior(self) -> xr.DataTree | None:
        """Posterior after the last mission, with all groups; None before anything is learned."""
        last = self.log.last
        if last is None:
            return None
        if self._whole is None or self._whole[0] is not last:
            self._whole = last, whole_posterior(last(), self.missions, self.model)
        whole = self._whole[1]
        whole["hazard"] = xr.DataTree(self.hazard)
        return whole

    @property
    def hazard(self) -> xr.Dataset:
        """Group `hazard` of the posterior, see `hazard.fit_hazard`; of the prior at first."""
        if self._hazard is None:
            log, last = self.log, self.log.last_tree
            self._hazard = learn_hazard(
                log.entries, log.failures, self.workspace, self.options.prior_hazard,
                self.options.forgetting, self.seed_of("hazard"),
            )  # fmt: skip
            if self._hazard is None and last is not None and "hazard" in last.children:
                self._hazard = last["hazard"].to_dataset()
            if self._hazard is None:
                self._hazard = fit_hazard([], self.workspace, self.options.prior_hazard)
        return self._hazard

    @property
    def risk(self) -> BoundRisk:
        """Chances of the bounds to fail, of all missions so far."""
        if self._risk is None:
            self._risk = BoundRisk.of(self.hazard, self.workspace)
        return self._risk

    @property
    def observation(self) -> str:
        """Family of observations of the belief: the posterior's, or that of the prior at first."""
        last = self.log.last_tree
        return self.model.family.name if last is None else last.attrs["observation"]

    @property
    def history(self) -> xr.Dataset:
        """Dataset as `Result.history`; empty before the first mission."""
        return self.log.to_dataset()

    def table(self) -> pd.DataFrame:
        """Table with a row for each mission, as `Result.table`."""
        return table_of(self.history, self.missions, self.log.failures)

    def summary(self) -> pd.DataFrame:
        """Return `table`, by the name that it had in version 0.2."""
        return self.table()

    def _learn(self, seed: int) -> None:
        """Fit the posterior of all missions that are not set aside; if it is refused, go on."""
        self._forget_risk()
        entries, waiting = self.log.entries, self.log.numbers(TOLD)
        numbers, last = self.log.numbers(TOLD, LEARNED), self.log.last
        if not numbers:
            entries[-1].posterior, self.belief = None, self._prior
            return
        try:
            tree = self._learning.learn(
                [entries[j].mission for j in numbers],
                len(waiting),
                self.log.last_tree,
                seed,
                self.workspace,
                self.progress,
            )
        except CannotLearnError as error:
            for j in waiting:
                entries[j].become(TOLD, str(error))
            known = "the prior" if last is None else "the posterior before"
            warnings.warn(
                f"mission {len(entries)} is kept, but cannot be learned from yet: {error} "
                f"The campaign goes on with {known}, and tries again with the next mission.",
                stacklevel=4,
            )
            return
        alone = self.options.update == "moment_matched"  # the prior stands for those before
        tree.attrs["missions"] = waiting if alone else numbers
        tree["hazard"] = xr.DataTree(self.hazard)
        if "latent" not in tree.children:
            tree = parameters_alone(tree)
        if last is not None:
            last.shrink()
        for j in waiting:
            entries[j].become(LEARNED)
        entries[-1].row |= diagnostics(tree)
        entries[-1].posterior = Posterior(len(entries), tree)
        self.belief = params_of(tree)

    def _forget_risk(self) -> None:
        """Let the hazard be fitted again when it is asked for."""
        self._hazard = self._risk = None

    def seed_of(self, stream: str) -> int:
        """Seed of one stream of randomness ("policy", "fit", "mission") at this iteration."""
        entropy = [self.seed, _STREAMS.index(stream), len(self.log.entries)]
        if n_failures := sum(f.after == len(self.log.entries) for f in self.log.failures):
            entropy.append(n_failures)  # another try may choose another path
        return int(np.random.SeedSequence(entropy).generate_state(1)[0])
