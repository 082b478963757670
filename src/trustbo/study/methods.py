"""Methods that are compared: a model and a policy, or a baseline, ours or the user's."""

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import partial
from typing import Any

import numpy as np

from trustbo.campaign.campaign import Campaign
from trustbo.data import Cell
from trustbo.errors import TrustboError, require_choice
from trustbo.hazard import Hazard
from trustbo.inference.samplers.choice import resolve_sampler
from trustbo.models.model import TrustModel, require_model
from trustbo.models.params import Params
from trustbo.models.record import model_to_record
from trustbo.paper import CAMPAIGN, WORKSPACE
from trustbo.planning import POLICIES, Plan, Planner, Policy
from trustbo.planning.policies import random
from trustbo.planning.policies import random_path as along_random_drifts
from trustbo.study.calls import IMPORTED, identity_of, imported, made
from trustbo.workspace import Workspace
from trustbo.workspace.location import Location

MODELS: dict[str, dict[str, Any]] = {
    "pooled": {"kind": "PooledTrust"},
    "places": {"kind": "PooledTrust", "place": {"kind": "PlaceEffect"}},
    "robots": {"kind": "default_model"},
    "hierarchical": {"kind": "HierarchicalTrust"},
    "coupled": {"kind": "CoupledTrust"},
}
"""Settings of models by short names."""

PLANNER_OPTIONS = ("max_bounds", "max_failure", "failure_cost")
FIT_OPTIONS = ("n_chains", "warmup", "draws", "target_accept", "max_tree_depth")
"""Options of a case that are those of the planner and of fits."""

type Model = Mapping[str, Any] | TrustModel
"""Trust model, or the settings that make it."""


@dataclass(frozen=True)
class Case:
    """Factory of campaigns: a model, a policy and options, on any workspace and with any seed.

    Attributes:
        labels: Name of the case along each axis of the experiment.
        model: Trust model, or the settings that make it.
        policy: Name of a policy, a policy, or `"module:name"` of one.
        objective: Objective of the policy.
        sampler: Sampler of the posterior.
        options: Options of the campaign, and `stop`.
        bounds: False for awareness of cells alone, as in the paper.
        factory: Whether `policy` makes the policy of each campaign, which learns by itself. It has
            no arguments, or gets the scene's truth as one of the name `truth`.
    """

    labels: Mapping[str, Any]
    model: Model
    policy: Any
    objective: str
    sampler: str = "auto"
    options: Mapping[str, Any] = field(default_factory=dict)
    bounds: bool = True
    factory: bool = False

    def campaign(
        self,
        workspace: Workspace,
        ends: tuple[Location, Location],
        seed: int,
        callbacks: Sequence[Any] = (),
    ) -> Campaign:
        """Begin a campaign.

        Raises:
            TrustboError: Impossible settings.
        """
        policy = resolved("policy", self.policy, POLICIES)
        policy = _made(policy, callbacks) if self.factory else policy
        given = {name: value for name, value in self.options.items() if name != "stop"}
        options: dict[str, Any] = {}
        for keyword, names in (("planner", PLANNER_OPTIONS), ("fit", FIT_OPTIONS)):
            options[keyword] = {name: given.pop(name) for name in names if name in given}
        if isinstance(given.get("hazard"), Mapping):
            given["hazard"] = Hazard(**given["hazard"])
        return Campaign(
            workspace,
            *ends,
            model=model_of(self.model),
            policy=self.policy if self.policy in POLICIES else policy,
            objective=self.objective,
            sampler=self.sampler,
            seed=seed,
            **options,
            **given,
        )

    def identity(self) -> dict[str, Any]:
        """Settings that the numbers depend on."""
        return {
            "model": model_to_record(model_of(self.model)),
            "policy": identity_of(self.policy),
            "objective": self.objective,
            "sampler": self.sampler,
            "options": dict(self.options),
            "bounds": self.bounds,
        }


def _made(factory: Callable[..., Any], callbacks: Sequence[Any]) -> Any:
    """Policy of a factory; the truth, where it takes one, is the one that a callback judges by."""
    if "truth" not in inspect.signature(factory).parameters:
        return factory()
    truths = (callback.truth for callback in callbacks if hasattr(callback, "truth"))
    return factory(truth=next(truths, None))


class Unlearned:
    """Policy that recommends what it would do next, and ignores what a model has learned."""

    def __init__(self, name: str, choose: Policy) -> None:
        """Wrap a policy."""
        self.__name__, self._choose = name, choose

    def __call__(self, rng: np.random.Generator, params: Params, planner: Planner) -> Plan:
        """Choose a path."""
        return self._choose(rng, params, planner)

    def recommend(self, campaign: Campaign) -> tuple[Cell, ...]:
        """Path of the next mission."""
        return campaign.ask().path


def random_path() -> Unlearned:
    """Policy that takes the best path under random drifts."""
    return Unlearned("random", random)


def shortest_path() -> Unlearned:
    """Policy that takes the best path under random drifts of those with the fewest bounds."""
    return Unlearned("shortest", _random_shortest)


def _random_shortest(rng: np.random.Generator, params: Params, planner: Planner) -> Plan:
    shortest = Planner(planner.workspace, planner.start, planner.goal, max_bounds="shortest")
    return planner.evaluate(along_random_drifts(rng, shortest), params.mean())


BASELINE_ROWS: Mapping[str, tuple[str, Mapping[str, Any]]] = {
    "random": ("random path", {"policy": random_path, "factory": True}),
    "shortest": ("shortest path", {"policy": shortest_path, "factory": True}),
    "paper": ("paper", {
        **{name: CAMPAIGN[name] for name in ("model", "policy", "objective")},
        "bounds": WORKSPACE["bounds"],
        "options": {"initial": CAMPAIGN["initial"], "max_bounds": "shortest+2"},
    }),
}  # fmt: skip
"""Baselines by name: a random path, a random one of the shortest, and the paper's method. Each has
the name of its row, and the settings of its `Case`. The sampler is that of all methods: NUTS, the
paper's, has the same posterior as the exact one."""
BASELINES = tuple(BASELINE_ROWS)
_SETTINGS = ("model", "policy", "objective", "options", "bounds", "factory")
"""Settings of a method, those of a `Case`."""


def cases_of(
    models: Any,
    policies: Any,
    baselines: Sequence[str],
    methods: Mapping[str, Any],
    objective: str,
    max_bounds: int | str,
    sampler: str,
) -> dict[str, Case]:
    """Methods by the names of their rows: every model with every policy, baselines, and others.

    Each of `methods` has settings of a `Case`, by default those of the pooled model, or is the
    factory of a policy.

    Raises:
        TrustboError: An unknown name, or two methods of one name.
    """
    rows = _of_models(models, policies)
    for name in baselines:
        if ":" in name:
            rows[_name(name)] = {"policy": name, "factory": True}
        else:
            row, settings = BASELINE_ROWS[require_choice(f"baseline {IMPORTED}", name, BASELINES)]
            rows[row] = settings
    for name, given in methods.items():
        rows[name] = given if isinstance(given, Mapping) else {"policy": given, "factory": True}
    usual: dict[str, Any] = {"model": "pooled", "objective": objective}
    usual["options"] = {"max_bounds": max_bounds}
    cases = {}
    for name, row in rows.items():
        for setting in row:
            require_choice(f"setting of method {name!r}", setting, _SETTINGS)
        settings = {**usual, **row, "options": {**usual["options"], **row.get("options", {})}}
        model = model_from(settings.pop("model"))
        settings["sampler"] = _able(model, sampler)
        cases[name] = Case({"method": name, "policy": name}, model, **settings)
        _require_policy(cases[name].policy)
    return cases


def _of_models(models: Any, policies: Any) -> dict[str, Mapping[str, Any]]:
    """Settings of every model with every policy, by name; the model's is left out if it is one."""
    kinds = {name: model_from(given) for name, given in _by_name("models", models).items()}
    return {
        name if len(kinds) == 1 else f"{label} {name}": {"model": model, "policy": policy}
        for label, model in kinds.items()
        for name, policy in _by_name("policies", policies).items()
    }


def _require_policy(policy: Any) -> None:
    if not callable(resolved("policy", policy, POLICIES)):
        raise TrustboError(f"policy must be a name or a callable; got {policy!r}.")


def model_of(given: Model) -> TrustModel:
    """Make a trust model; TrustboError: it is none."""
    model = made(given)
    require_model(model)
    return model


def model_from(given: Any) -> Model:
    """Model from a short name, a `"module:name"` of one or of a factory, settings, or the model."""
    if isinstance(given, str) and ":" not in given:
        return MODELS[require_choice("model", given, MODELS)]
    model: Any = imported("model", given) if isinstance(given, str) else given
    if callable(model) and not isinstance(model, TrustModel):
        model = {"kind": given} if isinstance(given, str) else model()
    model_of(model)
    return model


def resolved(what: str, given: Any, named: Mapping[str, Any]) -> Any:
    """Object itself, one of those with a name, or that of a `"module:name"`.

    TrustboError: there is no such module or name.
    """
    if not isinstance(given, str):
        return given
    if ":" not in given:
        return named[require_choice(f"{what} {IMPORTED}", given, named)]
    return imported(what, given)


def _able(model: Model, sampler: str) -> str:
    """Sampler, or the default one where the model does not take it."""
    try:
        resolve_sampler(model_of(model), sampler)
    except TrustboError:
        return "auto"
    return sampler


def _by_name(what: str, given: Any) -> dict[str, Any]:
    """Objects, or one, by the names of their rows; TrustboError: two have the same."""
    listed = list(given) if isinstance(given, list | tuple) else [given]
    names = [_name(one) for one in listed]
    for name in names:
        if names.count(name) > 1:
            raise TrustboError(
                f"two {what} have the name {name!r}, and each row of the table needs another: "
                'give functions of other names, or "module:name" of each.'
            )
    return dict(zip(names, listed, strict=True))


def _name(given: Any) -> str:
    if isinstance(given, str):
        return given.rpartition(":")[2]
    if isinstance(given, partial):
        return f"{_name(given.func)}({', '.join(f'{k}={v}' for k, v in given.keywords.items())})"
    name = getattr(given, "__name__", type(given).__name__)
    if not isinstance(given, TrustModel):
        return name
    usual = {f.name: f.default for f in fields(given)}
    options = given.options().items()
    chosen = [v for option, v in options if isinstance(v, str) and v != usual[option]]
    chosen += [] if given.place is None else ["places"]
    return f"{name}({', '.join(chosen)})" if chosen else name
