"""Write a model's settings to a JSON record, and rebuild the model from the record."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

from trustbo.errors import TrustboError
from trustbo.models.effects.effect import EFFECTS, Effect
from trustbo.models.model import MODELS, TrustModel
from trustbo.models.priors import Priors


def model_to_record(model: TrustModel) -> dict[str, Any]:
    """Convert a model to a dict of its class, options, effects and priors.

    The entry `by_feature` is true if the priors depend on the feature names.
    """
    record = {
        "class": type(model).__name__,
        **model.options(),
        "priors": model.priors.record(),
        "effects": effects_to_record(model.effects),
        "by_feature": model.priors.by_feature,
    }
    return json.loads(json.dumps(record))  # tuples become lists, as in a file


def effects_to_record(effects: Sequence[Any]) -> list[dict[str, Any]]:
    """Convert effects to dicts of their class and settings."""
    return [{"kind": type(effect).__name__, **asdict(effect)} for effect in effects]


def model_from_record(record: Mapping[str, Any], given: TrustModel | None = None) -> TrustModel:
    """Rebuild a model from its record; a model with priors of own classes must be `given`.

    Raises TrustboError if such a model is not given, or if the given model differs from the record.
    """
    if given is not None:
        if model_to_record(given) != record:
            raise TrustboError(
                f"the given model must match the record {record}; got {model_to_record(given)}."
            )
        return given

    model = with_default_priors(record)
    if record["by_feature"]:
        return model
    return replace(model, priors=Priors.from_record(record["priors"]))


def with_default_priors(record: Mapping[str, Any]) -> TrustModel:
    """Make a model with the class, options and effects of a record, and with default priors.

    Raises TrustboError if the class of the model or of an effect has not been imported.
    """
    kind = MODELS.get(record["class"])
    if kind is None:
        raise TrustboError(f"unknown model {record['class']!r}; import the module that defines it.")

    others = ("class", "priors", "by_feature", "effects")
    options = {name: value for name, value in record.items() if name not in others}
    return kind(effects=effects_from_record(record), **options)


def effects_from_record(record: Mapping[str, Any]) -> tuple[Effect, ...]:
    """Rebuild the effects of a model from its record.

    Raises TrustboError if the class of an effect has not been imported.
    """
    effects = []
    for one in record.get("effects", ()):
        settings = {name: _as_tuple(value) for name, value in one.items()}
        kind = settings.pop("kind")
        if kind not in EFFECTS:
            raise TrustboError(
                f"unknown effect {kind!r} in the model; import the module that defines this class. "
                f"Known effects are {', '.join(sorted(EFFECTS))}."
            )
        effects.append(EFFECTS[kind](**settings))

    return tuple(effects)


def _as_tuple(value: Any) -> Any:
    """Return a setting in which lists, as read from a file, are tuples, so that it has a hash."""
    return tuple(map(_as_tuple, value)) if isinstance(value, list) else value
