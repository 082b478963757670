"""Are posteriors calibrated? Simulation-based calibration (Talts et al. 2018)."""

import jax
import numpy as np
import xarray as xr
from jax import random
from scipy import stats
from tqdm import tqdm

from trustbo.errors import require_choice, require_whole
from trustbo.models.model import TrustModel, prior_draws
from trustbo.models.nuts import NutsSettings
from trustbo.models.pooled import PooledTrust
from trustbo.models.sampling import SAMPLERS, draw_posterior
from trustbo.stacking import MissionBatch

_CHAINS = 4


def sbc(
    model: PooledTrust | None = None,
    sampler: str = "exact",
    *,
    n_datasets: int = 100,
    shape: tuple[int, int, int, int] = (4, 8, 3, 2),
    n_ranked: int = 396,
    seed: int = 0,
    progress: bool = True,
) -> xr.Dataset:
    """Rank each true parameter among posterior draws, over data sets simulated from the prior.

    If prior, likelihood and sampler fit together, ranks are uniform. Awareness is uniform in
    [0, 1]; contact rates are the Gaussian model's, not cut to [0, 1].

    Args:
        model: The trust model; by default `PooledTrust()`.
        sampler: `"exact"` or `"nuts"`.
        n_datasets: How many data sets.
        shape: Missions, bounds, robots and features of each.
        n_ranked: Draws each truth is ranked among, a multiple of 4; NUTS is thinned to these.
        seed: Same seed, same ranks.
        progress: Whether to show a progress bar.

    Returns:
        Dataset with `rank` (dataset, parameter), in 0..n_ranked, and `p_value` (parameter) of a
        chi-squared test of uniformity in 20 bins.

    Raises:
        TrustboError: An unknown sampler, or no data sets.
    """
    require_choice("sampler", sampler, SAMPLERS)
    require_whole("n_datasets", n_datasets, 1)
    model = PooledTrust() if model is None else model
    kept = require_whole("n_ranked", n_ranked, _CHAINS) // _CHAINS
    settings = NutsSettings(n_draws=1000 if sampler == "nuts" else kept, n_chains=_CHAINS)
    ranks = []
    with jax.enable_x64(True):
        awareness = np.random.default_rng(seed).uniform(size=shape)
        keys = random.split(random.key(seed), n_datasets)
        simulated = prior_draws(model.priors, awareness, keys)
        rates = np.asarray(simulated["contact_rate"])
        truths = {name: np.asarray(simulated[name]) for name in SITES}
        for j in tqdm(range(n_datasets), desc="data sets", disable=not progress):
            batch = MissionBatch(awareness, rates[j])
            draws, _ = draw_posterior(model, sampler, settings, seed + j, batch, check=False)
            thinned = np.linspace(0, settings.n_draws - 1, kept).astype(int)
            ranks.append(
                {
                    name: (draws.params[name][:, thinned] < truth[j]).sum((0, 1))
                    for name, truth in truths.items()
                }
            )
    columns = {}
    for name in truths:
        column = np.array([rank[name] for rank in ranks])
        if column.ndim == 1:
            columns[name] = column
        else:
            columns |= {f"{name}[{m}]": column[:, m] for m in range(column.shape[1])}
    table = np.stack(list(columns.values()), axis=1)
    return xr.Dataset(
        {
            "rank": (("dataset", "parameter"), table),
            "p_value": ("parameter", [_uniformity(ranks, kept * _CHAINS) for ranks in table.T]),
        },
        {"parameter": list(columns)},
        {"sampler": sampler, "n_ranked": kept * _CHAINS},
    )


def _uniformity(ranks: np.ndarray, n_ranked: int, n_bins: int = 20) -> float:
    """P-value of a chi-squared test; bins hold as many of the n_ranked + 1 ranks as they can."""
    edges = np.linspace(0, n_ranked + 1, n_bins + 1).astype(int)
    counts, _ = np.histogram(ranks, edges - 0.5)
    expected = len(ranks) * np.diff(edges) / (n_ranked + 1)
    return float(stats.chisquare(counts, expected).pvalue)
