"""Any model as campaigns use it: its learner, its parameters for plans, and its latent trust.

A model is a `TrustModel` or a NumPyro function. Both are converted to a `Learner`, which campaigns
and planners use without distinguishing them. How a model is sampled is decided in three steps:

1. `as_learner` makes a `ClassLearner` or a `FunctionLearner`.
2. Classes: `ClassLearner.sampled` uses importance sampling (`importance.py`), or NUTS (`nuts.py`)
   on request. With Gaussian rates, coefficients are integrated out exactly, otherwise by EP
   (`ep.py`).
3. Functions: `functions.sampling` uses the same importance sampling in two runs that must agree
   (`agreed.py`). If they do not, it uses NUTS, unless the function has effects.
"""

import json
from collections.abc import Callable, Iterable
from typing import Any

import xarray as xr

from trustbo.data import Mission
from trustbo.errors import TrustboError, require_kind, require_switch, see
from trustbo.inference.classes import ClassLearner
from trustbo.inference.functions.function import FunctionModel
from trustbo.inference.functions.known import as_model, is_of_function, model_of_record
from trustbo.inference.functions.learner import FunctionLearner
from trustbo.inference.learns import Learner
from trustbo.inference.order import as_fitted, in_order_of_features
from trustbo.inference.stored import missions_of
from trustbo.inference.tree import with_latent
from trustbo.models.default import default_model
from trustbo.models.draws import Draws, NextMission
from trustbo.models.model import TrustModel
from trustbo.models.record import model_from_record
from trustbo.parallel import computing
from trustbo.workspace import Workspace

Model = TrustModel | Callable[..., Any]
"""A trust model: an object of a model class, or a NumPyro function."""


def as_learner(model: Model | FunctionModel) -> Learner:
    """Return the learner of a model; the same function always has the same `FunctionModel`.

    Raises:
        TrustboError: If the model is neither a trust model nor a NumPyro function.
    """
    if isinstance(model, TrustModel):
        return ClassLearner(model)

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
    learner = as_learner(default_model() if model is None else model)
    learner.require_plannable(workspace, sampler)
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
    return ClassLearner(model_from_record(record, given))  # pyright: ignore[reportArgumentType]


def learner_of_posterior(posterior: xr.DataTree, model: Model | None = None) -> Learner:
    """Return the learner of a posterior; a custom model is needed only for its prior."""
    record = json.loads(posterior.attrs["model_record"])
    if is_of_function(record):
        return FunctionLearner(model_of_record(record, model))  # pyright: ignore[reportArgumentType]
    return ClassLearner(model)  # pyright: ignore[reportArgumentType]


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
