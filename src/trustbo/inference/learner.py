"""Models as campaigns use them: fitting to missions, and draws for planning.

A model is a `TrustModel` or a NumPyro function. Both are converted to a `Learner`, which campaigns
and planners use without distinguishing them. How a model is sampled is decided in three steps:

1. `as_learner` makes a `Learner` for a class, or a `FunctionLearner` for a function.
2. Classes: `classes.fit_class` uses importance sampling (`importance.py`), or NUTS (`nuts.py`) on
   request. With Gaussian rates, coefficients are integrated out exactly, otherwise by EP (`ep.py`).
3. Functions: `functions.sampling` uses the same importance sampling in two runs that must agree
   (`agreed.py`). If they do not, it uses NUTS, unless the function has effects.
"""

import json
from collections.abc import Callable, Iterable, Sequence
from typing import Any, ClassVar

import xarray as xr

from trustbo.data import Mission
from trustbo.errors import TrustboError, require_kind, require_switch, see
from trustbo.inference.ahead import read_params
from trustbo.inference.classes import (
    SAMPLERS,
    OfClass,
    fit_class,
    require_poolable_with_model,
)
from trustbo.inference.functions.fit import (
    draws_of_function,
    fit_function,
    prior_draws_of_function,
    prior_draws_of_function_ahead,
    require_learnable,
    require_plannable,
    require_poolable_with_function,
)
from trustbo.inference.functions.function import FunctionModel
from trustbo.inference.functions.known import as_model, is_of_function, model_of_record
from trustbo.inference.functions.missions import FunctionData
from trustbo.inference.functions.sampling import NUTS
from trustbo.inference.functions.sampling import SAMPLERS as OF_FUNCTIONS
from trustbo.inference.functions.source import OfFunction
from trustbo.inference.latent import Source
from trustbo.inference.options import Options
from trustbo.inference.order import as_fitted, in_order_of_features
from trustbo.inference.posterior import names_in
from trustbo.inference.prior_draws import prior_mean, sample_prior, sample_prior_ahead
from trustbo.inference.stored import missions_of, read_posterior
from trustbo.inference.tree import Fitted, with_latent
from trustbo.models.default import default_model
from trustbo.models.draws import Draws, NextMission
from trustbo.models.model import TrustModel
from trustbo.models.people import HumanTrust
from trustbo.models.record import model_from_record, model_to_record
from trustbo.parallel import computing
from trustbo.workspace import Workspace

Model = TrustModel | Callable[..., Any]
"""A trust model: an object of a model class, or a NumPyro function."""

_N_MEAN = 500
"""Number of prior draws of a function that are averaged for the first plan."""


class Learner:
    """A model class that learns from missions, and whose draws are used to plan.

    Attributes:
        samplers: Names of the available samplers, the default first.
        model: The model; None if it is a model class that is not stored, and was not given.
    """

    samplers: ClassVar[tuple[str, ...]] = SAMPLERS

    def __init__(self, model: Any) -> None:
        self.model = model

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

    def sampled(
        self, missions: Sequence[Mission], workspace: Workspace | None, options: Options
    ) -> Fitted:
        """Draw from the posterior given missions that are prepared; see `fit`."""
        return fit_class(missions, self.known, workspace, options)

    def add_latent(
        self, posterior: xr.DataTree, missions: Sequence[Mission], *, progress: bool = True
    ) -> xr.DataTree:
        """Add latent trust, log-likelihoods and predictions to a posterior."""
        return add_latent(posterior, missions, model=self.model, progress=progress)

    def draws(
        self, posterior: xr.DataTree, workspace: Workspace | None, *, next_mission: bool = False
    ) -> Draws:
        """Return all draws of a posterior; see `params_of`."""
        return self._read_for(posterior, workspace, [next_mission])[0]

    def next_mission(self, posterior: xr.DataTree, workspace: Workspace | None) -> NextMission:
        """Return `draws` without and with `next_mission`; the posterior is read once."""
        expected, drawn = self._read_for(posterior, workspace, [False, True])
        return NextMission(expected, drawn)

    def record(self) -> dict[str, Any]:
        """Return plain values that identify the model in files."""
        return model_to_record(self.known)

    def require_poolable(self, earlier: Sequence[Mission], robots: Sequence[str]) -> None:
        """Raise TrustboError if the model cannot be fitted to missions of earlier campaigns.

        `robots` are the names of the robots of the other missions.
        """
        require_poolable_with_model(self.known, earlier, robots)

    def source(
        self, posterior: xr.DataTree, missions: Sequence[Mission], *, contrasts: bool = True
    ) -> Source:
        """Return all draws of a posterior, with missions in the order of its features.

        Blocks may be contrasts of robots unless `contrasts` is false.
        """
        found = read_posterior(posterior, missions, model=self.model)
        return OfClass(*found, contrasts=contrasts)

    def read(
        self, posterior: xr.DataTree, workspace: Workspace | None, next_mission: Sequence[bool]
    ) -> Sequence[Draws]:
        """Return the draws of a posterior for each value of `next_mission`; see `params_of`."""
        return read_params(posterior, workspace, next_mission)

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
        whole = workspace.whole
        model = self.known.for_features(workspace.features)
        sizes = len(workspace.features), n_draws, seed
        draws = sample_prior(model, *sizes, n_robots=whole.team.n_robots)
        return _of_going(draws, workspace)

    def first_mission(self, n_draws: int, seed: int, workspace: Workspace) -> NextMission:
        """Draw parameters from the prior with the effects of the first mission."""
        model = self.known.for_features(workspace.features)
        ahead = sample_prior_ahead(model, workspace.whole, n_draws, seed)
        return NextMission(*(_of_going(draws, workspace) for draws in ahead))

    def prior_mean(self, workspace: Workspace) -> Draws:
        """Return the prior mean."""
        whole = workspace.whole
        model = self.known.for_features(workspace.features)
        mean = prior_mean(model, len(workspace.features), n_robots=whole.team.n_robots)
        return _of_going(mean, workspace)


class FunctionLearner(Learner):
    """Learner of a NumPyro function; variables of single missions are always drawn."""

    samplers = OF_FUNCTIONS

    def record(self) -> dict[str, Any]:
        """See `Learner.record`."""
        return self.model.record()

    def sampled(
        self, missions: Sequence[Mission], workspace: Workspace | None, options: Options
    ) -> Fitted:
        """See `Learner.sampled`."""
        return fit_function(missions, self.model, workspace, options)

    def require_poolable(self, earlier: Sequence[Mission], robots: Sequence[str]) -> None:
        """See `Learner.require_poolable`."""
        require_poolable_with_function(self.model, earlier, robots)

    def source(
        self, posterior: xr.DataTree, missions: Sequence[Mission], *, contrasts: bool = True
    ) -> Source:
        """See `Learner.source`; there are no contrasts."""
        return OfFunction.stored(FunctionData(self.model, missions), posterior)

    def read(
        self, posterior: xr.DataTree, workspace: Workspace | None, next_mission: Sequence[bool]
    ) -> Sequence[Draws]:
        """See `Learner.read`."""
        return draws_of_function(self.model, posterior, workspace, next_mission)

    def prior_draws(self, n_draws: int, seed: int, workspace: Workspace) -> Draws:
        """See `Learner.prior_draws`."""
        draws = prior_draws_of_function(self.model, n_draws, seed, workspace.whole)
        return _of_going(draws, workspace)

    def first_mission(self, n_draws: int, seed: int, workspace: Workspace) -> NextMission:
        """See `Learner.first_mission`."""
        ahead = prior_draws_of_function_ahead(self.model, n_draws, seed, workspace.whole)
        return NextMission(*(_of_going(draws, workspace) for draws in ahead))

    def prior_mean(self, workspace: Workspace) -> Draws:
        """See `Learner.prior_mean`."""
        return self.prior_draws(_N_MEAN, 0, workspace).mean()


def _of_going(draws: Draws, workspace: Workspace) -> Draws:
    """Return draws for the whole team with the robots of a workspace only."""
    whole = workspace.whole
    named = draws.in_order(whole.team.names, whole.features)
    return named if whole is workspace else named.in_order(workspace.team.names, whole.features)


def as_learner(model: Model | FunctionModel) -> Learner:
    """Return the learner of a model; the same function always has the same `FunctionModel`.

    Raises:
        TrustboError: If the model is neither a trust model nor a NumPyro function.
    """
    if isinstance(model, TrustModel):
        return Learner(model)

    is_function = callable(model) and not isinstance(model, type)
    if not is_function and not isinstance(model, FunctionModel):
        page = see("howto/your-own-model")
        remedy = f"give a model such as PooledTrust(), or a NumPyro function ({page})"
        require_kind("model", model, TrustModel, remedy)
    return FunctionLearner(as_model(model))


def learner_of(
    model: Model | FunctionModel | None, workspace: Workspace, sampler: str | None = None
) -> Learner:
    """Return the learner of a model for a workspace; the default is that of the default model.

    Raises:
        TrustboError: If the model is neither a trust model nor a NumPyro function, cannot plan, or
            cannot be sampled by this sampler.
    """
    if isinstance(model, HumanTrust):
        raise TrustboError("model: HumanTrust cannot plan paths; give PooledTrust() instead.")

    learner = as_learner(default_model() if model is None else model)
    if isinstance(learner, FunctionLearner):
        require_plannable(learner.model, workspace)
        require_learnable(learner.model, workspace, by_gradient=sampler == NUTS)
    return learner


def learner_from_record(record: dict[str, Any], given: Model | None = None) -> Learner:
    """Return the learner of a model with this record.

    Raises:
        TrustboError: If the model is custom and is not given, or if a different model is given.
    """
    if is_of_function(record):
        if isinstance(given, TrustModel):
            raise TrustboError(
                f"the model is the function {record['name']!r}; got {type(given).__name__}."
            )
        return FunctionLearner(model_of_record(record, given))
    if given is not None:
        require_kind("model", given, TrustModel, "give the model of the posterior")
    return Learner(model_from_record(record, given))  # pyright: ignore[reportArgumentType]


def learner_of_posterior(posterior: xr.DataTree, model: Model | None = None) -> Learner:
    """Return the learner of a posterior; a custom model is needed only for its prior."""
    record = json.loads(posterior.attrs["model_record"])
    if is_of_function(record):
        return FunctionLearner(model_of_record(record, model))  # pyright: ignore[reportArgumentType]
    return Learner(model)  # pyright: ignore[reportArgumentType]


@computing()
def params_of(
    posterior: xr.DataTree,
    workspace: Workspace | None = None,
    *,
    next_mission: bool = False,
    model: Model | None = None,
) -> Draws:
    """Return all draws of a posterior as parameters (draw, ...), with chains joined.

    Args:
        posterior: DataTree from `fit`.
        workspace: Workspace for planning; features and robots are reordered to match it.
        next_mission: Whether to draw the robot effects of the next mission, and to include the
            effects of robots in bounds. Use True for bands and predictions. By default, expected
            effects are used, as in planning. The effects of robots in bounds are then left out,
            because they are 0 on average over the team.
        model: Model of the posterior; needed only for a NumPyro function that was not used before
            in this process.

    Returns:
        `TrustParams` of the form of the model. Those of a pooled model with robot effects are given
        for each robot (`per_robot`), because its line-of-sight weights include its own effect,
        whose slow part has decayed by one mission. A function gives `Draws`.

    Raises:
        TrustboError: If the posterior is not from `fit`; a variable is missing or has NaN draws; or
            the features or robots differ from those of the workspace.

    Example:
        >>> params = tb.inference.params_of(posterior, workspace)  # leading axis (draw,)
        >>> tb.Planner(workspace, (9, 0), (0, 9)).plan(params.mean()).path
    """
    require_switch("next_mission", next_mission)
    posterior = as_fitted("params_of", posterior)
    learner = learner_of_posterior(posterior, model)
    return learner.draws(posterior, workspace, next_mission=next_mission)


@computing()
def next_mission_of(posterior: xr.DataTree, workspace: Workspace | None = None) -> NextMission:
    """Return `params_of` without and with `next_mission`; the posterior is read once."""
    posterior = as_fitted("params_of", posterior)
    return learner_of_posterior(posterior).next_mission(posterior, workspace)


@computing()
def add_latent(
    posterior: xr.DataTree,
    missions: Iterable[Mission] | None = None,
    *,
    model: Model | None = None,
    progress: bool = True,
) -> xr.DataTree:
    """Add latent trust, log-likelihoods and predictions to a posterior.

    A campaign stores only the parameters of its posteriors, because the other groups grow with the
    number of missions. These groups can be computed at any time, always with the same result.

    Args:
        posterior: DataTree from `fit`, or one of `Result.posteriors`.
        missions: Fitted missions; needed if the posterior contains no data.
        model: Model of the posterior; needed if a prior has a class of your own, or if it is a
            NumPyro function that was not used before in this process.
        progress: Whether to show a progress bar after 1.5 seconds.

    Returns:
        The posterior with the groups `latent`, `posterior_predictive`, `prior_predictive`,
        `log_prior` and `log_likelihood`, or the unchanged posterior if `latent` already exists.

    Raises:
        TrustboError: If the posterior contains no data and no missions are given.

    Example:
        >>> posterior = tb.fit(missions, workspace=workspace, latent=False)
        >>> tb.inference.add_latent(posterior)["latent"]["trust_mean"].dims
        ('mission', 'bound', 'robot')
    """
    require_switch("progress", progress)
    posterior = as_fitted("add_latent", posterior)
    if "latent" in posterior.children:
        return posterior

    missions = missions_of(posterior) if missions is None else missions
    missions = in_order_of_features(missions, posterior)
    source = learner_of_posterior(posterior, model).source(posterior, missions)
    return with_latent(posterior, missions, source, progress=progress)
