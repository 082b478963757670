"""Ablation of a model: LOO with and without each component; prior sensitivity."""

import json
import logging
import warnings
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pandas as pd
import xarray as xr
from arviz_stats.psense import psense_summary

from trustbo.data import Mission
from trustbo.errors import TrustboError
from trustbo.inference.fit import fit
from trustbo.inference.loo import loo
from trustbo.inference.posterior_groups import complete
from trustbo.models.effects.place import PlaceEffect
from trustbo.models.model import TrustModel
from trustbo.models.place import has_places
from trustbo.models.priors import Priors
from trustbo.models.record import model_from_record

_SENSITIVE = 0.05  # threshold of the Cumulative Jensen-Shannon distance, as ArviZ has it


def ablate(
    posterior: xr.DataTree | None, missions: Sequence[Mission], model: TrustModel | None
) -> pd.DataFrame:
    """Difference of elpd by component, left out or added; empty without a posterior.

    Rows: a feature left out, places in or out, and `prior`, whose `value` is the largest
    sensitivity of a parameter to its prior. Positive: the fitted model is better.
    """
    rows: dict[str, tuple[float, float, str]] = {}
    if posterior is not None:
        try:
            features = missions[0].features
            record = json.loads(posterior.attrs["model_record"])
            model = model or model_from_record(record, features=features)
            posterior = complete(posterior, missions, model=model)
            default = Priors.of(features, model.observation).describe()
            if model.priors.describe() == default:  # by the remaining features' names, too
                model = replace(model, priors=Priors.default(model.observation))
            rows = _rows(posterior, missions, model)
        except (KeyError, TrustboError) as error:
            rows = {"comparison": (np.nan, np.nan, f"not made: {error}")}
    columns = ["value", "se", "finding"]
    return pd.DataFrame.from_dict(rows, orient="index", columns=columns).rename_axis("part")


def _rows(
    posterior: xr.DataTree, missions: Sequence[Mission], model: TrustModel
) -> dict[str, tuple[float, float, str]]:
    rows = {"prior": _sensitivity(posterior)}
    if len(missions) < 3:
        return rows
    others: dict[str, tuple[Sequence[Mission], TrustModel, str]] = {}
    features = missions[0].features
    by_feature = len(model.priors.beta.batch_shape) > 0
    for m, feature in enumerate(() if by_feature or len(features) == 1 else features):
        others[feature] = [_without(mission, m) for mission in missions], model, "without it"
    if model.place is None:
        others["places"] = missions, replace(model, place=PlaceEffect()), "with them"
    else:
        others["places"] = missions, replace(model, place=None), "without them"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of single influential missions, by k-hat
        fitted = loo(posterior)
        for name, (data, other, how) in others.items():
            if other.place is not None and model.place is None and not has_places(missions):
                continue
            if other.why_not_exact and not model.why_not_exact:  # NUTS would take minutes
                rows[name] = np.nan, np.nan, f"not compared: {other.why_not_exact}."
                continue
            other_loo = loo(fit(data, other, seed=int(posterior.attrs["seed"]), check=False))
            gap = np.asarray(fitted.elpd_i) - np.asarray(other_loo.elpd_i)  # pyright: ignore
            rows[name] = _compared(gap, how)
    return rows


def _compared(gap: np.ndarray, how: str) -> tuple[float, float, str]:
    value, se = float(gap.sum()), float(gap.std(ddof=1) * np.sqrt(len(gap)))
    sentence = f"elpd {-value:+.1f} +- {se:.1f} {how}"
    if value > 2.0 * se:
        return value, se, f"{sentence}: the model as it is predicts better."
    if value < -2.0 * se:
        return value, se, f"{sentence}: the model as it is predicts worse."
    return value, se, f"{sentence}: no difference that these missions show."


def _sensitivity(posterior: xr.DataTree) -> tuple[float, float, str]:
    if not {"log_prior", "log_likelihood"} <= set(posterior.children):
        return np.nan, np.nan, "its sensitivity is not known: no log_prior of this model."
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        logger = logging.getLogger("arviz_stats")
        level = logger.level
        logger.setLevel(logging.ERROR)  # ArviZ prints a long message at a finding
        try:
            table = psense_summary(posterior)
        finally:
            logger.setLevel(level)
    names = [str(name) for name in table.index]
    by_prior, by_rates = (table[name].to_numpy(dtype=float) for name in ("prior", "likelihood"))
    sensitive = [name for name, d in zip(names, by_prior, strict=True) if d > _SENSITIVE]
    both = [n for n, d in zip(names, by_rates, strict=True) if d > _SENSITIVE and n in sensitive]
    sentence = "no parameter is sensitive to its prior (power scaling)."
    if sensitive:
        sentence = f"sensitive to priors (power scaling): {', '.join(sensitive)}"
        sentence += (
            f"; to priors and rates, a conflict of both: {', '.join(both)}." if both else "."
        )
    return float(by_prior.max()), np.nan, sentence


def _without(mission: Mission, m: int) -> Mission:
    bounds = tuple(replace(b, awareness=np.delete(b.awareness, m, axis=1)) for b in mission.bounds)
    features = tuple(name for i, name in enumerate(mission.features) if i != m)
    return replace(mission, bounds=bounds, features=features)
