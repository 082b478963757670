"""Simulation-based calibration of posteriors (Talts et al. 2018)."""

from collections.abc import Sequence

import numpy as np
import xarray as xr
from scipy import stats

from trustbo.data import Mission
from trustbo.display import progress_bar
from trustbo.errors import PosteriorError, require_whole
from trustbo.inference.fit import by_importance
from trustbo.inference.importance import MAX_KHAT
from trustbo.inference.posterior import Posterior
from trustbo.models.model import TrustModel
from trustbo.parallel import one_blas_thread
from trustbo.workspace import Workspace

_INTERVALS = (0.5, 0.9)


@one_blas_thread()
def sbc(
    model: TrustModel,
    missions: Sequence[Mission],
    *,
    workspace: Workspace | None = None,
    n_datasets: int = 100,
    n_ranked: int = 399,
    seed: int = 0,
    max_refused: float = 0.0,
    progress: bool = True,
) -> xr.Dataset:
    """Rank each true parameter among posterior draws, over data sets simulated from the prior.

    If prior, likelihood and sampler are consistent, ranks are uniform. Measured rates are replaced
    by simulated ones; Gaussian rates are not clipped to [0, 1].

    Args:
        model: Trust model.
        missions: Missions that define the paths, awareness, ticks and gaps of each data set.
        workspace: Workspace of the missions, as for `fit`.
        n_datasets: Number of data sets.
        n_ranked: Number of posterior draws among which each true value is ranked.
        seed: Seed; the same seed gives the same ranks.
        max_refused: Largest share of data sets whose posterior may fail the check of k-hat. They
            are omitted, which can hide a deviation of at most this share.
        progress: Whether to show a progress bar.

    Returns:
        Dataset with `rank` (dataset, parameter), in 0..n_ranked, of each parameter and of the first
        and last element of each effect; `pit`, the ranks in (0, 1), which `az.plot_ecdf_pit` draws;
        `p_value` (parameter) of a chi-squared test of uniformity in at most 20 bins; and `coverage`
        (interval, parameter), the share of true values in the central interval. Its attribute
        `n_refused` is the number of data sets left out.

    Raises:
        PosteriorError: If more than `max_refused` of the data sets fail, or all.
    """
    n_datasets = require_whole("n_datasets", n_datasets, 1)
    n_ranked = require_whole("n_ranked", n_ranked, 1)
    model = model.for_features(missions[0].features)
    slots = model.slots(missions, workspace)
    before, measured, ranks, n_refused = Posterior(model, slots), ~np.isnan(slots.y), [], 0
    for j in progress_bar(progress, iterable=range(n_datasets), desc="data sets"):
        rng = np.random.default_rng([seed, j])
        truth = before.draw_prior(1, rng)
        rates = np.where(measured, before.anew(truth, rng)[0], np.nan)
        posterior = Posterior(model, slots._replace(y=rates))
        drawn, _, summary = by_importance(posterior, n_ranked, int(rng.integers(2**31)))
        if not summary["k_hat"] <= MAX_KHAT:
            n_refused += 1
            if n_refused > max_refused * n_datasets or n_refused == n_datasets:
                raise PosteriorError(
                    f"the sampler refused data set {j}.", None, "Change the priors."
                )
            continue
        found, true = (_numbers(posterior.named(d, rng)) for d in (drawn, truth))
        ranks.append({name: int((found[name] < true[name][0]).sum()) for name in found})
    return _summary(ranks, n_ranked, n_refused)


def _numbers(groups: dict[str, dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Draws (draw,) of every parameter, and of the first and last element of each effect.

    Coefficients of single persons and constants are omitted.
    """
    found = {}
    for group, variables in groups.items():
        for name, values in variables.items():
            flat = values.reshape(len(values), -1)
            columns = range(flat.shape[1])
            if group != "posterior":
                columns = sorted({0, flat.shape[1] - 1})
            if name != "person":
                found |= {_label(name, values, i): flat[:, i] for i in columns}
    return {n: v for n, v in found.items() if len(v) == 1 or np.ptp(v) > 0.0}


def _label(name: str, values: np.ndarray, i: int) -> str:
    if values.ndim == 1:
        return name
    return f"{name}[{','.join(map(str, np.unravel_index(i, values.shape[1:])))}]"


def _summary(ranks: list[dict[str, int]], n_ranked: int, n_refused: int) -> xr.Dataset:
    names = list(ranks[0])
    table = np.array([[rank[name] for name in names] for rank in ranks])
    pit = (table + 0.5) / (n_ranked + 1)
    coverage = [(np.abs(pit - 0.5) < 0.5 * width).mean(0) for width in _INTERVALS]
    return xr.Dataset(
        {
            "rank": (("dataset", "parameter"), table),
            "pit": (("dataset", "parameter"), pit),
            "p_value": ("parameter", [uniformity(column, n_ranked) for column in table.T]),
            "coverage": (("interval", "parameter"), coverage),
        },
        {"parameter": names, "interval": list(_INTERVALS)},
        {"n_ranked": n_ranked, "n_refused": n_refused},
    )


def uniformity(ranks: np.ndarray, n_ranked: int) -> float:
    """P-value of a chi-squared test; bins are as equal as n_ranked + 1 ranks allow."""
    n_bins = min(20, max(2, len(ranks) // 5))  # five ranks to a bin, for the test to hold
    edges = np.linspace(0, n_ranked + 1, n_bins + 1).astype(int)
    counts, _ = np.histogram(ranks, edges - 0.5)
    expected = len(ranks) * np.diff(edges) / (n_ranked + 1)
    return float(stats.chisquare(counts, expected).pvalue)
