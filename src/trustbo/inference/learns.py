"""What campaigns, plans and predictions need of a model, whether it is a class or a function."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar

import xarray as xr

from trustbo.data import Mission
from trustbo.errors import TrustboError
from trustbo.inference.latent import Source
from trustbo.inference.options import Options
from trustbo.inference.posterior import names_in
from trustbo.inference.tree import Fitted
from trustbo.models.draws import Draws, NextMission
from trustbo.workspace import Workspace


class Learner(ABC):
    """A model that learns from missions, and whose draws are used to plan.

    `classes.ClassLearner` and `functions.learner.FunctionLearner` are the two kinds.

    Attributes:
        samplers: Names of the available samplers, the default first.
        model: The model; None if it is a model class that is not stored, and was not given.
    """

    samplers: ClassVar[tuple[str, ...]]

    def __init__(self, model: Any) -> None:
        self.model = model

    # --- what classes and functions do differently ---

    @abstractmethod
    def record(self) -> dict[str, Any]:
        """Return plain values that identify the model in files."""

    @abstractmethod
    def sampled(
        self, missions: Sequence[Mission], workspace: Workspace | None, options: Options
    ) -> Fitted:
        """Draw from the posterior given missions that are prepared; see `fit`."""

    @abstractmethod
    def require_poolable(self, earlier: Sequence[Mission], robots: Sequence[str]) -> None:
        """Raise TrustboError if the model cannot be fitted to missions of earlier campaigns.

        `robots` are the names of the robots of the other missions.
        """

    @abstractmethod
    def source(
        self, posterior: xr.DataTree, missions: Sequence[Mission], *, contrasts: bool = True
    ) -> Source:
        """Return all draws of a posterior, with missions in the order of its features.

        Blocks may be contrasts of robots unless `contrasts` is false.
        """

    @abstractmethod
    def read(
        self, posterior: xr.DataTree, workspace: Workspace | None, next_mission: Sequence[bool]
    ) -> Sequence[Draws]:
        """Return the draws of a posterior for each value of `next_mission`; see `params_of`."""

    @abstractmethod
    def of_prior(self, n_draws: int, seed: int, whole: Workspace) -> Draws:
        """Draw parameters of the whole team from the prior, without effects."""

    @abstractmethod
    def of_prior_ahead(self, n_draws: int, seed: int, whole: Workspace) -> NextMission:
        """Draw parameters of the whole team from the prior, with effects of the first mission."""

    @abstractmethod
    def mean_of_prior(self, whole: Workspace) -> Draws:
        """Return the prior mean of the parameters of the whole team."""

    @abstractmethod
    def require_plannable(self, workspace: Workspace, sampler: str | None) -> None:
        """Raise TrustboError if the model cannot plan in a workspace, or learn from missions."""

    # --- what is the same for both ---

    @property
    def known(self) -> Any:
        """The model; raises TrustboError if it was not given."""
        if self.model is None:
            raise TrustboError("the model is custom and not stored; give it with model=.")
        return self.model

    @property
    def family(self) -> str:
        """Name of the observation family of the rates."""
        return self.known.family

    def in_short(self) -> str:
        """Describe the model in a few words."""
        return self.known.in_short()

    def draws(
        self, posterior: xr.DataTree, workspace: Workspace | None, *, next_mission: bool = False
    ) -> Draws:
        """Return all draws of a posterior; see `params_of`."""
        return self._read_for(posterior, workspace, [next_mission])[0]

    def next_mission(self, posterior: xr.DataTree, workspace: Workspace | None) -> NextMission:
        """Return `draws` without and with `next_mission`; the posterior is read once."""
        expected, drawn = self._read_for(posterior, workspace, [False, True])
        return NextMission(expected, drawn)

    def _read_for(
        self, posterior: xr.DataTree, workspace: Workspace | None, next_mission: Sequence[bool]
    ) -> Sequence[Draws]:
        """Return what `read` returns, with the robots of the workspace only.

        The draws are read for the whole team, so that their values do not depend on who goes. The
        posterior may lack robots that stay at home.
        """
        if not isinstance(workspace, Workspace) or workspace.within is None:
            return self.read(posterior, workspace, next_mission)

        names = workspace.team.names
        known = names_in(posterior, "robot")
        whole = workspace.within
        if set(names) <= set(known):
            whole = whole.of_robots([name for name in whole.team.names if name in known])
        draws = self.read(posterior, whole, next_mission)
        return [of_whole.in_order(names, workspace.features) for of_whole in draws]

    def prior_draws(self, n_draws: int, seed: int, workspace: Workspace) -> Draws:
        """Draw parameters from the prior without effects."""
        return _of_going(self.of_prior(n_draws, seed, workspace.whole), workspace)

    def first_mission(self, n_draws: int, seed: int, workspace: Workspace) -> NextMission:
        """Draw parameters from the prior with the effects of the first mission."""
        ahead = self.of_prior_ahead(n_draws, seed, workspace.whole)
        return NextMission(*(_of_going(draws, workspace) for draws in ahead))

    def prior_mean(self, workspace: Workspace) -> Draws:
        """Return the prior mean."""
        return _of_going(self.mean_of_prior(workspace.whole), workspace)


def _of_going(draws: Draws, workspace: Workspace) -> Draws:
    """Return draws for the whole team with the robots of a workspace only."""
    whole = workspace.whole
    named = draws.in_order(whole.team.names, whole.features)
    return named if whole is workspace else named.in_order(workspace.team.names, whole.features)
