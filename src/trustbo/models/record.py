"""JSON record of a model's settings, and the model rebuilt from it."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

from trustbo.errors import TrustboError
from trustbo.models.effects.effect import EFFECTS, Effect
from trustbo.models.model import MODELS, TrustModel
from trustbo.models.priors import Priors


def model_to_record(model: TrustModel) -> dict[str, Any]:
    """Write a model's class, options, effects and, as text, priors to a record.

    `by_feature` states that the priors depend on the features' names.
    """
    effects: Any = model.effects
    record = {
        "class": type(model).__name__,
        **model.options(),
        "priors": model.priors.describe(),
        "effects": [{"kind": type(effect).__name__, **asdict(effect)} for effect in effects],
        "by_feature": model.priors is Priors.default(model.observation),
    }
    return json.loads(json.dumps(record))  # a tuple is a list


def model_from_record(
    record: dict[str, Any], given: TrustModel | None = None, features: Sequence[str] = ()
) -> TrustModel:
    """Rebuild a model from its record; models with custom priors or class must be `given`.

    `features` are the posterior's features, for default priors by feature. Raises TrustboError if
    the model is required but not given, or a different one is given.
    """
    if given is not None:
        if model_to_record(given) != record:
            raise TrustboError(
                f"the campaign's model is {record}; the one given is {model_to_record(given)}."
            )
        return given
    if (kind := MODELS.get(record["class"])) is not None:
        ours = ("class", "priors", "by_feature", "effects")
        options = {name: value for name, value in record.items() if name not in ours}
        usual = kind(effects=effects_from_record(record), **options)
        of_features = Priors.of(features, record["observation"])
        for priors in (usual.priors, replace(usual.priors), of_features):
            model = replace(usual, priors=priors)
            if model_to_record(model) == record:
                return model
    raise TrustboError(
        f"the campaign's model {record['class']} has priors of its own, or is your own; give it "
        f"again with model=. Its priors: {record['priors']}."
    )


def effects_from_record(record: Mapping[str, Any]) -> tuple[Effect, ...]:
    """Rebuild the effects of a model from its record.

    Raises TrustboError if the class of an effect has not been imported.
    """
    return tuple(_effect_from_record(**effect) for effect in record.get("effects", ()))


def _effect_from_record(kind: str, **settings: Any) -> Effect:
    if kind not in EFFECTS:
        raise TrustboError(
            f"the model has an effect {kind!r}, which this process does not have; import the "
            f"module that defines it. There are {', '.join(sorted(EFFECTS))}."
        )
    return EFFECTS[kind](**{n: tuple(v) if isinstance(v, list) else v for n, v in settings.items()})
