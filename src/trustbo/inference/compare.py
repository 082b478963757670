"""Ranking of posteriors by leave-one-mission-out cross-validation."""

from collections.abc import Mapping
from typing import Literal

import numpy as np
import pandas as pd
import xarray as xr
from arviz_stats.loo.compare import compare as ranked
from arviz_stats.utils import ELPDData

from trustbo.errors import TrustboError, one_line, require_switch
from trustbo.inference.learner import Model
from trustbo.inference.loo import complete, estimated
from trustbo.inference.tree import LIKELIHOOD_OF, RATES
from trustbo.models.families import FAMILIES
from trustbo.parallel import computing

_LEAST_DIFFERENCE = 4.0
"""Difference in nats below which LOO cannot distinguish models (Sivula et al. 2025)."""
_STANDARD_ERRORS = 2.0
"""The same threshold, in standard errors of the difference."""
_ENOUGH_MISSIONS = 10
"""Number of missions below which the standard error of a difference is not reliable."""
_SINGLE = 1e-6
"""Difference between rates that can result from single precision, the default of JAX."""


@computing()
def compare(
    posteriors: Mapping[str, xr.DataTree],
    *,
    models: Mapping[str, Model] | None = None,
    round_to: int | Literal["auto", "none"] = "none",
    progress: bool = True,
) -> pd.DataFrame:
    """Rank posteriors by leave-one-mission-out cross-validation; see `loo` and `arviz.compare`.

    With few missions, LOO often cannot tell which model is better. The column `verdict` is
    `"undecided"`, followed by the reason, if the difference from the best model is below 4 nats
    (Sivula et al. 2025, arXiv:2008.10296) or, by rules of thumb of trustbo, below two standard
    errors, or if there are fewer than 10 missions. The best model is also `"undecided"`, without a
    reason, if another model is. If a verdict is undecided, do not use the weights or the order of
    the models. `p`, the effective number of parameters, should be much smaller than `n_missions`.

    Args:
        posteriors: Two or more posteriors by name, fitted to the same missions. Each is from `fit`,
            for a model class or a NumPyro function, or from `arviz.from_numpyro(mcmc,
            log_likelihood=True)`. The latter needs a site `contact_rate` in a plate of missions.
            Its attribute `log_likelihood_of` must be `"ticks"` if its `ContactRate` has `n_ticks`,
            and `"contact_rate"` otherwise. An error is raised if one of its missions would need a
            refit.
        models: Models by the same names; needed for models with custom priors and for NumPyro
            functions that were not used before in this process.
        round_to: Number of decimal places, as in `arviz.compare`. `"auto"`, the default of ArviZ,
            rounds `elpd` to the precision of its standard error, which hides smaller differences
            between models. The default `"none"` does not round.
        progress: Whether to show a progress bar after 1.5 seconds.

    Returns:
        Table from `arviz.compare` with one row per posterior, the best first. The columns include
        `elpd`, `p`, `n_missions`, `elpd_diff` and its standard error `dse` (in nats), `verdict`,
        the stacking `weight`, and `diag_elpd`, which reports a high Pareto k. `p_worse` is the
        probability that a model is worse than the best one, by a normal approximation of the
        difference. `diag_diff` is the text of ArviZ for when this approximation is poor:
        `"N < 100"` for fewer than 100 missions, `"|elpd_diff| < 4"`, or empty.

    Raises:
        TrustboError: If there are fewer than two posteriors; if `models` has a name without a
            posterior; if the rates or tick counts differ; if some log-likelihoods refer to tick
            counts and others to rates; if a mission must be left out by a refit (see `loo`) but the
            posterior is from `arviz.from_numpyro`; or if the model of a posterior is needed in
            `models`, or is another one there.

    Example:
        >>> pooled = tb.fit(missions, tb.models.PooledTrust())
        >>> hierarchical = tb.fit(missions, tb.models.HierarchicalTrust())
        >>> tb.compare({"pooled": pooled, "hierarchical": hierarchical})[["rank", "elpd_diff"]]
    """
    require_switch("progress", progress)
    if not isinstance(posteriors, Mapping) or len(posteriors) < 2:
        raise TrustboError(
            f"compare needs a dict of two or more posteriors by name; got {one_line(posteriors)}."
        )
    unknown = [name for name in models or {} if name not in posteriors]
    if unknown:
        raise TrustboError(f"models has {unknown[0]!r}, but there is no posterior of this name.")

    model_of = models or {}
    whole = {
        name: complete(f"compare of {name!r}", tree, model_of.get(name))
        for name, tree in posteriors.items()
    }
    _require_same_data(whole)

    found = {
        name: estimated(tree, model_of.get(name), progress=progress) for name, tree in whole.items()
    }
    table = ranked(found, round_to=round_to)  # pyright: ignore[reportArgumentType]
    after_p = table.columns.get_loc("p") + 1  # pyright: ignore[reportOperatorIssue]
    table.insert(after_p, "n_missions", [found[name].n_data_points for name in table.index])
    table.insert(after_p + 1, "verdict", _verdicts(found, list(table.index)))
    return table


def _require_same_data(posteriors: Mapping[str, xr.DataTree]) -> None:
    """Raise TrustboError unless all log-likelihoods refer to the same data."""
    first, *others = posteriors
    reference = _data_of(posteriors[first])
    for name in others:
        data = _data_of(posteriors[name])
        if "robot" in data.coords and "robot" in reference.coords:
            robots = reference["robot"].values
            if set(robots) == set(data["robot"].values):
                data = data.sel(robot=robots)

        for variable in {RATES, "n_ticks"} & set(data) & set(reference):
            a = reference[variable].values
            b = data[variable].values
            if a.shape != b.shape or not np.allclose(a, b, rtol=0.0, atol=_SINGLE, equal_nan=True):
                raise TrustboError(
                    f"{name!r} and {first!r} were fitted to different rates or tick counts, of "
                    f"shape {b.shape} and {a.shape}; fit both to the same missions."
                )

        if (reference["is_density"].values != data["is_density"].values).any():
            dense, other = (first, name) if reference["is_density"].any() else (name, first)
            raise TrustboError(
                f"the log-likelihoods of {dense!r} are densities of rates, and those of {other!r} "
                "are, at least for some rates, probabilities, so they cannot be compared; give all "
                "missions n_ticks and, in a NumPyro function, ContactRate(..., n_ticks=n_ticks)."
            )


def _data_of(posterior: xr.DataTree) -> xr.Dataset:
    """Return the rates, their tick counts if known, and whether likelihoods are densities."""
    data = posterior["observed_data"].to_dataset()[[RATES]]
    family = FAMILIES[posterior.attrs.get("family", "gaussian")]
    of_rates = posterior.attrs[LIKELIHOOD_OF] == RATES
    is_density = data[RATES].notnull() & family.is_density(data[RATES].values) & of_rates
    if "constant_data" in posterior.children:
        data = data.assign(n_ticks=posterior["constant_data"].to_dataset()["n_ticks"])
    return data.assign(is_density=is_density)


def _verdicts(found: Mapping[str, ELPDData], names: list[str]) -> list[str]:
    """State which models are worse than the first one, if LOO can tell; see `compare`."""
    best = found[names[0]]
    verdicts = []
    for name in names[1:]:
        difference = found[name].elpd_i.values - best.elpd_i.values
        size = abs(float(difference.sum()))
        error = float(np.sqrt(len(difference) * difference.var()))

        verdict = "worse"
        if best.n_data_points < _ENOUGH_MISSIONS:
            verdict = f"undecided: fewer than {_ENOUGH_MISSIONS} missions"
        elif size < _LEAST_DIFFERENCE:
            verdict = f"undecided: |elpd_diff| < {_LEAST_DIFFERENCE:.0f}"
        elif size < _STANDARD_ERRORS * error:
            verdict = f"undecided: |elpd_diff| < {_STANDARD_ERRORS:.0f} dse"
        verdicts.append(verdict)

    is_best = all(verdict == "worse" for verdict in verdicts)
    return ["best" if is_best else "undecided", *verdicts]
