"""JSON record of a model's settings, and the model rebuilt from it."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from trustbo.errors import TrustboError
from trustbo.models.coupled import CoupledTrust
from trustbo.models.effects.robot import RobotEffect
from trustbo.models.hierarchical import HierarchicalTrust
from trustbo.models.model import TrustModel
from trustbo.models.place import PlaceEffect
from trustbo.models.pooled import PooledTrust
from trustbo.models.priors import Priors

_MODELS = {model.__name__: model for model in (PooledTrust, HierarchicalTrust, CoupledTrust)}


def model_to_record(model: TrustModel) -> dict[str, Any]:
    """Record of class, options, priors as text, and whether these depend on the features' names."""
    custom = {
        "class": type(model).__name__,
        **model.options(),
        "place": None if model.place is None else model.place.to_record(),
        "priors": model.priors.describe(),
    }
    by_feature = model.priors is Priors.default(model.observation)
    effects = [effect.to_record() for effect in model.effects]
    custom |= {"effects": effects} if effects else {}
    return custom | ({"by_feature": True} if by_feature else {})


def model_from_record(
    record: dict[str, Any], given: TrustModel | None = None, features: Sequence[str] = ()
) -> TrustModel:
    """Rebuild the model of a record; one with custom priors or class has to be passed again.

    `features` are those of the posterior, for default priors by feature. TrustboError: it has to be
    passed and was not, or another was passed.
    """
    record = {"place": None, **record}  # version 0.1 had none
    if given is not None:
        if model_to_record(given) != record:
            raise TrustboError(
                f"the campaign's model is {record}; the one given is {model_to_record(given)}."
            )
        return given
    ours = ("class", "priors", "place", "by_feature", "effects")
    options = {name: value for name, value in record.items() if name not in ours}
    if effects := [RobotEffect(**effect) for effect in record.get("effects", ())]:
        options["effects"] = tuple(effects)
    kind = _MODELS.get(record["class"])
    place = None if record["place"] is None else PlaceEffect(**record["place"])
    if kind is not None:
        fixed = replace(Priors.default(record["observation"]))
        of_features = Priors.of(features, record["observation"])
        for priors in (None, fixed, of_features, Priors.zheng2023()):
            model = kind(priors=priors, place=place, **options)  # pyright: ignore
            if model_to_record(model) == record:
                return model
    raise TrustboError(
        f"the campaign's model {record['class']} has priors of its own, or is your own; give it "
        f"again with model=. Its priors: {record['priors']}."
    )
