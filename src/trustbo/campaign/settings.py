"""Settings of a campaign: its arguments after checks, in the form in which they are stored."""

import inspect
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from trustbo.errors import TrustboError, require_kind, require_switch
from trustbo.files import to_json, to_plain
from trustbo.hazard import Hazard
from trustbo.inference.fit import fit, require_numbers_of_draws
from trustbo.inference.learns import Learner
from trustbo.planning import Planner
from trustbo.planning.policies import POLICIES, Policy
from trustbo.workspace import Workspace
from trustbo.workspace.grid import Location

_UNCHANGED = ("objective", "sampler", "seed", "initial", "awareness", "planner", "fit")
"""Arguments of `Campaign` that are stored unchanged."""
_OF_PLANNER = ("workspace", "start", "goal", "objective")
"""Arguments of `Planner` that are also arguments of `Campaign`."""
_OF_FIT = ("model", "earlier", "sampler", "workspace", "seed", "progress")
"""Arguments of `fit` that are also arguments of `Campaign`."""
_SET_IN_FIT = ("missions", "latent", "start")
"""Arguments of `fit` that a campaign sets itself."""
_FIT = inspect.signature(fit)


def require_options_of_planner(options: Any) -> dict[str, Any]:
    """Return options of `Planner`, as given to `Campaign`, in a new dict.

    `Planner` checks the other names and the values.

    Raises:
        TrustboError: The options are not a dict, or one of them is an argument of the campaign.
    """
    return _require_options("planner", options, _OF_PLANNER)


def require_options_of_fit(options: Any) -> dict[str, Any]:
    """Return options of `fit`, as given to `Campaign`, in a new dict.

    Raises:
        TrustboError: The options are not a dict, one of them is given to or set by the campaign, or
            a number of draws is not a whole number or `check` is not True or False.
        TypeError: `fit` has no such option.
    """
    given = _require_options("fit", options, _OF_FIT, _SET_IN_FIT)
    bound = _FIT.bind(**dict.fromkeys((*_OF_FIT, *_SET_IN_FIT)), **given)
    bound.apply_defaults()

    whole = bound.arguments
    require_numbers_of_draws(whole["draws"], whole["chains"], whole["warmup"])
    require_switch("check", whole["check"])
    return given


def _require_options(
    what: str, options: Any, own: Sequence[str], set_itself: Sequence[str] = ()
) -> dict[str, Any]:
    """Return options as a new dict; raises TrustboError for names in `own` and `set_itself`."""
    if options is None:
        return {}

    given = dict(require_kind(what, options, Mapping, "give a dict of options"))
    for name in given:
        if name in own:
            raise TrustboError(f"{name} is an argument of Campaign, not of {what}=.")
        if name in set_itself:
            raise TrustboError(f"a campaign sets {name} itself; leave it out of {what}=.")
    return given


def to_settings(
    base: Planner,
    learner: Learner,
    policy: str | Policy,
    hazard: Hazard,
    *,
    has_course: bool,
    **options: Any,
) -> dict[str, Any]:
    """Return the settings of a campaign as if they were read from a file.

    Args:
        base: Planner of any course, before any learning.
        learner: Learner of the model.
        policy: Policy that chooses the paths.
        hazard: Priors of the failure probabilities.
        has_course: Whether the course of `base` is that of the campaign.
        **options: Other arguments of `Campaign`, which are stored unchanged: `objective`,
            `sampler`, `seed`, `initial`, `awareness`, `planner` and `fit`.

    Raises:
        TrustboError: An option cannot be stored in a file.
    """
    if "bound_cost" in options["planner"]:
        # In the order of the moves, rows and columns.
        options["planner"] = options["planner"] | {"bound_cost": base.problem.bound_cost}
    for name in ("planner", "fit"):
        options[name] = to_plain(name, options[name])

    settings = {
        "start": base.start if has_course else None,
        "goal": base.goal if has_course else None,
        "max_bounds": base.max_bounds,
        "policy": _text_of(policy),
        **options,
        "hazard": asdict(hazard),
        "model": learner.in_short(),
        "model_record": learner.record(),
    }
    return json.loads(to_json(settings))


def _text_of(policy: str | Policy) -> str:
    """Return the name of a policy in the settings."""
    return policy if isinstance(policy, str) else f"{name_of(policy)} (custom)"


def to_arguments(settings: Mapping[str, Any], policy: Policy | None) -> dict[str, Any]:
    """Return the arguments of a stored `Campaign`, except for workspace and model.

    Raises:
        TrustboError: The policy is custom and is not given, or another one is given.
    """
    stored = settings["policy"]
    if policy is None and stored not in POLICIES:
        raise TrustboError(f"the policy {stored!r} is not stored; pass the function as policy=.")
    if policy is not None and _text_of(policy) != stored:
        raise TrustboError(f"policy {_text_of(policy)!r} is not the campaign's, {stored!r}.")

    return {
        "start": settings["start"],
        "goal": settings["goal"],
        "hazard": Hazard(**settings["hazard"]),
        "policy": stored if policy is None else policy,
        **{name: settings[name] for name in _UNCHANGED},
    }


def to_planner(
    settings: Mapping[str, Any], workspace: Workspace, start: Location, goal: Location
) -> Planner:
    """Make the planner of a course before any learning, for the robots of the workspace."""
    return Planner(workspace, start, goal, settings["objective"], **settings["planner"])


def name_of(function: object) -> str:
    """Return the name of a function, or the class of a callable object."""
    return getattr(function, "__name__", type(function).__name__)
