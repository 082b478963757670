"""Leave-one-mission-out cross-validation and model comparison.

With coefficients, effects and trust integrated out, only the hyperparameters theta are left, and

    p(y_j | y_-j) = 1 / E[ p(y_-j | theta) / p(y | theta) | y ],

so the importance weights are ratios of the evidence without and with mission j (Vehtari, Gelman and
Gabry 2017). If coefficients were not integrated out, the weights would be poor for bounds that
occur only in mission j.
"""

from collections.abc import Mapping

import numpy as np
import pandas as pd
import xarray as xr
from arviz_stats.loo.compare import compare as ranked
from arviz_stats.utils import ELPDData
from scipy.special import logsumexp

from trustbo.display import slow_bar
from trustbo.errors import TrustboError, one_line, warn
from trustbo.inference.density import Density, at
from trustbo.inference.draws import missions_of, read_posterior, require_posterior
from trustbo.inference.fit import by_importance
from trustbo.inference.importance import MAX_KHAT, smoothed
from trustbo.models.model import TrustModel
from trustbo.models.observations import Observations
from trustbo.parallel import computing

_POINTS = 500
"""Maximum number of distinct hyperparameter draws that are used."""
_N_REFIT = 1000
"""Number of draws of a refit without a mission."""


@computing()
def loo(
    posterior: xr.DataTree, *, model: TrustModel | None = None, progress: bool = True
) -> ELPDData:
    """Estimate the log predictive density of each mission given all other missions.

    Hyperparameter draws get Pareto-smoothed weights. All other variables are integrated out, by
    expectation propagation if rates are not Gaussian. If k-hat of a mission exceeds 0.7, the model
    is refitted without that mission and the difference in log evidence is used. Missions without
    measured rates are excluded.

    Args:
        posterior: DataTree from `fit` that includes the data.
        model: Model of the posterior; needed if the priors are custom.
        progress: Whether to show a progress bar after 5 seconds.

    Returns:
        Pointwise `ELPDData` of ArviZ for `az.compare({name: loo(posterior), ...})`. The coordinate
        `refitted` (mission,) of `elpd_i` and `pareto_k` marks refitted missions, for which
        `pareto_k` is the k-hat of the refit.

    Raises:
        TrustboError: If fewer than two missions have measured rates.
    """
    posterior = require_posterior("loo", posterior)
    fitted, draws = read_posterior(posterior, model=model)
    fitted.run_ep(draws.theta)
    measured = np.flatnonzero(~np.isnan(fitted.observations.contact_rate).all((1, 2)))
    if len(measured) < 2:
        raise TrustboError(f"loo needs at least 2 missions with rates; got {len(measured)}.")

    # Resampled draws repeat, and the evidence of each distinct draw is computed only once.
    rows = np.column_stack([v.reshape(len(draws.c), -1) for v in draws.theta.values()])
    _, first, count = np.unique(rows, axis=0, return_index=True, return_counts=True)
    some = np.linspace(0, len(first) - 1, min(len(first), _POINTS)).astype(int)
    theta = at(draws.theta, first[some])
    log_count = np.log(count[some] / count[some].sum())

    whole = fitted.log_evidence(theta)
    n_measured = len(measured)
    density = np.zeros(n_measured)
    average = np.zeros(n_measured)  # log of the mean density under the full posterior
    k_hat = np.zeros(n_measured)
    refitted = np.zeros(n_measured, dtype=bool)
    whole_refit = None
    with slow_bar("loo", " missions", progress, total=n_measured) as bar:
        for i, j in enumerate(measured):
            others = fitted.without(j)  # pyright: ignore[reportArgumentType]
            ratio = others.log_evidence(theta) - whole
            weight, k_hat[i], _ = smoothed(ratio + log_count)
            density[i] = logsumexp(-ratio, b=weight)
            average[i] = logsumexp(log_count - ratio)

            # p(y_j | y_-j) = p(y) / p(y_-j), each from an own fit.
            if not k_hat[i] <= MAX_KHAT:
                seed = int(posterior.attrs["seed"])
                if whole_refit is None:
                    whole_refit, _ = _log_evidence(fitted, seed)
                rest, k_hat[i] = _log_evidence(others, seed)
                density[i] = whole_refit - rest
                refitted[i] = True
            bar.update()

    # Densities of tick counts are comparable between families; NaN where ticks are unknown.
    shift = fitted.model.likelihood.log_resolution(
        fitted.observations.contact_rate, fitted.observations.n_ticks
    ).sum((1, 2))
    if not np.isnan(shift).any():
        density = density + shift[measured]
        average = average + shift[measured]

    is_bad = ~(k_hat <= MAX_KHAT)
    if is_bad.any():
        warn(
            f"Estimated shape parameter of Pareto distribution is greater than {MAX_KHAT:.2f} for "
            f"missions {measured[is_bad].tolist()}; the results may be inaccurate."
        )

    elpd = float(density.sum())
    coords = {"mission": measured, "refitted": ("mission", refitted)}
    return ELPDData(
        elpd=elpd,
        se=float(np.sqrt(n_measured * density.var())),
        p=float(average.sum()) - elpd,
        n_samples=len(draws.c),
        n_data_points=n_measured,
        scale="log",
        warning=bool(is_bad.any()),
        good_k=MAX_KHAT,
        elpd_i=xr.DataArray(density, coords, "mission"),
        pareto_k=xr.DataArray(k_hat, coords, "mission"),
    )


def _log_evidence(density: Density, seed: int) -> tuple[float, float]:
    """Compute the log evidence by importance sampling, and the k-hat of the weights."""
    _, _, summary = by_importance(density, _N_REFIT, seed)
    return summary["log_evidence"], summary["k_hat"]


@computing()
def compare(posteriors: Mapping[str, xr.DataTree], *, progress: bool = True) -> pd.DataFrame:
    """Rank posteriors by leave-one-mission-out cross-validation; see `loo` and `arviz.compare`.

    Args:
        posteriors: Two or more posteriors from `fit` by name, fitted to the same missions. The
            observation families may differ.
        progress: Whether to show a progress bar after 5 seconds.

    Returns:
        Table from `arviz.compare` with one row per posterior, the best first. The columns include
        `elpd`, `elpd_diff` and its standard error `dse` in nats, the stacking `weight`, and
        `diag_elpd`, which names a high Pareto k.

    Raises:
        TrustboError: If there are fewer than two posteriors, or their rates or tick counts differ.

    Example:
        >>> tb.compare({"pooled": pooled, "hierarchical": hierarchical})
    """
    if not isinstance(posteriors, Mapping) or len(posteriors) < 2:
        raise TrustboError(
            f"compare needs a dict of two or more posteriors by name; got {one_line(posteriors)}."
        )
    trees = {name: require_posterior("compare", tree) for name, tree in posteriors.items()}

    data_of = {name: _rates_and_ticks(tree) for name, tree in trees.items()}
    first, *_ = data_of
    reference = data_of[first]
    for name, data in data_of.items():
        if not np.array_equal(reference, data, equal_nan=True):
            raise TrustboError(
                f"{name!r} and {first!r} were fitted to different rates or tick counts, of shape "
                f"{data.shape[1:]} and {reference.shape[1:]}; fit both to the same missions."
            )

    return ranked({name: loo(tree, progress=progress) for name, tree in trees.items()})


def _rates_and_ticks(posterior: xr.DataTree) -> np.ndarray:
    """Return the contact rates and tick counts (2, mission, bound, robot) of a posterior."""
    observations = Observations.from_missions(missions_of(posterior))
    return np.stack([observations.contact_rate, observations.n_ticks])
