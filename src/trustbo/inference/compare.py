"""Comparison of posteriors of the same missions."""

from collections.abc import Mapping

import numpy as np
import pandas as pd
import xarray as xr
from arviz_stats.loo.compare import compare as ranked

from trustbo.errors import TrustboError, one_line
from trustbo.inference.draws import require_posterior
from trustbo.inference.loo import loo


def compare(posteriors: Mapping[str, xr.DataTree]) -> pd.DataFrame:
    """Rank posteriors by leave-one-mission-out cross-validation, see `loo` and `arviz.compare`.

    Args:
        posteriors: Two or more posteriors from `fit`, by name, each of the same missions; weights
            of missions and families of observations may differ.

    Returns:
        Table of `arviz.compare`, one row a posterior, the best first: `elpd` and `elpd_diff` in
        nats, its standard error `dse`, stacking `weight`, and `warning` where a Pareto k is high.

    Raises:
        TrustboError: Fewer than two posteriors, or other missions in one of them.
    """
    if not isinstance(posteriors, Mapping) or len(posteriors) < 2:
        raise TrustboError(
            "compare takes two or more posteriors by name, {'pooled': one, 'apart': other}; got "
            f"{one_line(posteriors)}."
        )
    trees = {name: require_posterior("compare", tree) for name, tree in posteriors.items()}
    (first, reference), *others = ((name, _rates(tree)) for name, tree in trees.items())
    for name, rates in others:
        if not np.array_equal(reference, rates, equal_nan=True):
            raise TrustboError(
                f"{name!r} and {first!r} are posteriors of different missions, with rates "
                f"{rates.shape} and {reference.shape}; fit both to the same."
            )
    return ranked({name: loo(tree) for name, tree in trees.items()})


def _rates(posterior: xr.DataTree) -> np.ndarray:
    """Rates as measured, (mission, bound, robot)."""
    if "observed_data" not in posterior.children:
        raise TrustboError("compare needs the group observed_data; give posteriors of fit, whole.")
    return posterior["observed_data"].to_dataset()["contact_rate"].values
