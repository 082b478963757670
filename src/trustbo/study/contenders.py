"""Contenders of the benchmark: a model and a policy, or a baseline; the user's own among them."""

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import partial
from typing import Any

import numpy as np
from jax import Array

from trustbo.campaign.campaign import Campaign
from trustbo.data import Cell
from trustbo.errors import TrustboError, require_choice
from trustbo.models.model import TrustModel
from trustbo.models.params import Params
from trustbo.planning import POLICIES, Plan, Planner
from trustbo.planning.path_sampling import path_sampler
from trustbo.planning.paths import AdmissiblePaths
from trustbo.planning.policies import random, seed_of
from trustbo.study.parts import NAMED_MODELS, Own, Pooled, imported, parts_of

BASELINES = ("random", "shortest", "paper", "botorch")
"""Baselines: a random path, a random one of the shortest, the paper's method, and BoTorch."""


@dataclass(frozen=True)
class Contender:
    """One row of the table.

    Attributes:
        name: Name of the row.
        model: Trust model.
        policy: Name of a policy, or a policy.
        objective: Objective of the policy.
        options: Options of the campaign.
        bounds: False for awareness of cells alone, as in the paper.
    """

    name: str
    model: Any
    policy: Any
    objective: str
    options: Mapping[str, Any] = field(default_factory=dict)
    bounds: bool = True


class Unlearned:
    """Policy that recommends what it would do next, whatever a model has learned."""

    def __init__(self, name: str, choose: Callable[[Array, Params, Planner], Plan]) -> None:
        """Wrap a policy."""
        self.__name__, self._choose = name, choose

    def __call__(self, key: Array, posterior: Params, planner: Planner) -> Plan:
        """Choose a path."""
        return self._choose(key, posterior, planner)

    def recommend(self, campaign: Campaign) -> tuple[Cell, ...]:
        """Path of the next mission."""
        return campaign.ask().path


def random_shortest(key: Array, posterior: Params, planner: Planner) -> Plan:
    """Path drawn uniformly from those with the fewest bounds."""
    ends = planner.start, planner.goal
    paths = AdmissiblePaths(planner.workspace, *ends, planner.connectivity, "shortest", True)
    path = path_sampler(paths).draw(np.random.default_rng(seed_of(key)))
    return planner.evaluate(path, posterior.mean())


def contenders_of(
    models: Any, policies: Any, baselines: Sequence[str], objective: str, max_bounds: int | str
) -> list[Contender]:
    """Every model with every policy, and baselines; TrustboError: an unknown name."""
    options = {"max_bounds": max_bounds}
    parts = _models_of(models)
    named = _by_name("policies", _listed(policies))
    for policy in named.values():
        if not callable(resolved("policy", policy, POLICIES)):
            raise TrustboError(f"policy must be a name or a callable; got {policy!r}.")
    entrants = [
        Contender(name if len(parts) == 1 else f"{model} {name}", part, policy, objective, options)
        for model, part in parts.items()
        for name, policy in named.items()
    ]
    for name in baselines:
        require_choice("baseline", name, BASELINES)
    pooled, paper = Pooled(), {"initial": "prior_draw", "max_bounds": "shortest+2"}
    known = {
        "random": Contender("random path", pooled, "baseline:random", objective, options),
        "shortest": Contender("shortest path", pooled, "baseline:shortest", objective, options),
        "paper": Contender("paper", pooled, "greedy", "terminal", paper, bounds=False),
        "botorch": Contender("BoTorch", pooled, "baseline:botorch", objective, options),
    }
    return entrants + [known[name] for name in baselines]


def resolved(what: str, given: Any, known: Mapping[str, Any] | None = None) -> Any:
    """Object itself, one of some that are known by name, or that of a `"module:name"`.

    TrustboError: there is no such module or name.
    """
    if not isinstance(given, str) or (known is not None and given in known):
        return known[given] if known is not None and isinstance(given, str) else given
    module, colon, name = given.partition(":")
    if module == "baseline":
        return _baseline(name)
    if not colon:
        require_choice(f'{what} (or give "module:name")', given, known or ())
    return imported(what, given)


def identity_of(given: Any) -> Any:
    """Name of an object, with a hash of a function's code or of an object's state, for JSON."""
    if given is None or isinstance(given, str):
        return given
    if isinstance(given, partial):
        return [identity_of(given.func), repr(given.args), repr(sorted(given.keywords.items()))]
    kind = given if hasattr(given, "__qualname__") else type(given)
    code = getattr(getattr(given, "__code__", None), "co_code", None)
    code = repr(sorted(getattr(given, "__dict__", {}).items())).encode() if code is None else code
    return f"{kind.__module__}:{kind.__qualname__} {hashlib.sha256(code).hexdigest()[:12]}"


def _baseline(name: str) -> Any:
    """New policy of a baseline."""
    if name == "botorch":
        from trustbo.study.outsider import PathBandit

        return PathBandit()
    return Unlearned(
        *{"random": ("random", random), "shortest": ("shortest", random_shortest)}[name]
    )


def _models_of(models: Any) -> dict[str, Any]:
    """Parts of models by name."""
    kinds, parts = {kind.kind for kind in NAMED_MODELS}, {}
    for name, given in _by_name("models", _listed(models)).items():
        if isinstance(given, str) and ":" not in given:
            parts |= parts_of("model", (require_choice("model", given, kinds),), NAMED_MODELS)
        else:
            parts[name] = Own(source=given)
    return parts


def _listed(given: Any) -> list[Any]:
    return list(given) if isinstance(given, list | tuple) else [given]


def _by_name(what: str, given: Sequence[Any]) -> dict[str, Any]:
    """Objects by the names of their rows; TrustboError: two have the same."""
    names = [_name(one) for one in given]
    for name in names:
        if names.count(name) > 1:
            raise TrustboError(
                f"two {what} have the name {name!r}, and a row of the table needs one of its own: "
                'give functions of other names, or "module:name" of each.'
            )
    return dict(zip(names, given, strict=True))


def _name(given: Any) -> str:
    if isinstance(given, str):
        return given.rpartition(":")[2]
    if isinstance(given, partial):
        return f"{_name(given.func)}({', '.join(f'{k}={v}' for k, v in given.keywords.items())})"
    own = getattr(given, "__name__", type(given).__name__)
    if not isinstance(given, TrustModel):
        return own
    usual = {f.name: f.default for f in fields(given)}
    options = given.options().items()
    chosen = [v for name, v in options if isinstance(v, str) and v != usual[name]]
    chosen += [] if given.place is None else ["places"]
    return f"{own}({', '.join(chosen)})" if chosen else own
