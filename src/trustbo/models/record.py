"""JSON record of a model's settings, and the model rebuilt from it."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from trustbo.errors import TrustboError
from trustbo.models.coupled import CoupledTrust
from trustbo.models.effects.effect import EFFECTS, Effect
from trustbo.models.effects.place import PlaceEffect
from trustbo.models.hierarchical import HierarchicalTrust
from trustbo.models.model import TrustModel
from trustbo.models.people import HumanTrust
from trustbo.models.pooled import PooledTrust
from trustbo.models.priors import Priors

_MODELS = {
    model.__name__: model for model in (PooledTrust, HierarchicalTrust, CoupledTrust, HumanTrust)
}
_FIRST = "RobotEffect"  # records without a kind are of it


def model_to_record(model: TrustModel) -> dict[str, Any]:
    """Record of class, options, priors as text, and whether these depend on the features' names."""
    custom = {
        "class": type(model).__name__,
        **model.options(),
        "place": None if model.place is None else model.place.to_record(),
        "priors": model.priors.describe(),
    }
    by_feature = model.priors is Priors.default(model.observation)
    effects = [_effect_to_record(effect) for effect in model.effects]
    custom |= {"effects": effects} if effects else {}
    return custom | ({"by_feature": True} if by_feature else {})


def model_from_record(
    record: dict[str, Any], given: TrustModel | None = None, features: Sequence[str] = ()
) -> TrustModel:
    """Rebuild the model of a record; one with custom priors or class has to be passed again.

    `features` are those of the posterior, for default priors by feature. TrustboError: it has to be
    passed and was not, or another was passed.
    """
    if given is not None:
        if model_to_record(given) != record:
            raise TrustboError(
                f"the campaign's model is {record}; the one given is {model_to_record(given)}."
            )
        return given
    ours = ("class", "priors", "place", "by_feature", "effects")
    options = {name: value for name, value in record.items() if name not in ours}
    if effects := effects_from_record(record):
        options["effects"] = effects
    kind = _MODELS.get(record["class"])
    place = None if record["place"] is None else PlaceEffect(**record["place"])
    if kind is not None:
        fixed = replace(Priors.default(record["observation"]))
        of_features = Priors.of(features, record["observation"])
        known = [None, fixed, of_features]
        for priors in known:
            model = kind(priors=priors, place=place, **options)  # pyright: ignore
            if model_to_record(model) == record:
                return model
    raise TrustboError(
        f"the campaign's model {record['class']} has priors of its own, or is your own; give it "
        f"again with model=. Its priors: {record['priors']}."
    )


def effects_from_record(record: Mapping[str, Any]) -> tuple[Effect, ...]:
    """Effects of a model's record, but those of places.

    TrustboError: one of them is of a class that is not registered in this process.
    """
    return tuple(_effect_from_record(**effect) for effect in record.get("effects", ()))


def _effect_to_record(effect: Effect) -> dict[str, Any]:
    kind = type(effect).__name__
    return ({} if kind == _FIRST else {"kind": kind}) | effect.to_record()


def _effect_from_record(kind: str = _FIRST, **settings: Any) -> Effect:
    if kind not in EFFECTS:
        raise TrustboError(
            f"the model has an effect {kind!r}, which this process does not have; import the "
            f"module that registers it. There are {', '.join(sorted(EFFECTS))}."
        )
    return EFFECTS[kind](**settings)
