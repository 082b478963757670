"""Simulation-based calibration of posteriors (Talts et al. 2018)."""

import json
from pathlib import Path
from typing import Protocol

import numpy as np
import xarray as xr
from jax import random
from scipy import stats
from tqdm import tqdm

from trustbo.errors import PosteriorError, TrustboError, require_whole
from trustbo.files import FilePath, read_record, write_text
from trustbo.inference.draws import theta_of
from trustbo.inference.people import draw_people
from trustbo.inference.prior_predictive import draw_sites
from trustbo.inference.samplers.choice import needs_evidence, resolve_sampler, with_warmup
from trustbo.inference.samplers.run import Draws, draw_posterior
from trustbo.inference.samplers.settings import NutsSettings
from trustbo.models.backend import own_settings
from trustbo.models.effects.effect import Slots, Theta, draw_effects, drift_of
from trustbo.models.model import TrustModel
from trustbo.models.params import Params
from trustbo.models.people import HumanTrust
from trustbo.models.place import Visited
from trustbo.models.pooled import PooledTrust
from trustbo.stacking import MissionBatch

_CHAINS = 4
_INTERVALS = (0.5, 0.9)


class Design(Protocol):
    """Missions that visit places, and the effects that are ranked."""

    def places(self, model: TrustModel) -> Visited:
        """Places that the missions visit."""
        ...

    def simulate(
        self, model: TrustModel, awareness: np.ndarray, ticks: np.ndarray, seed: int
    ) -> dict[str, np.ndarray]:
        """Parameters, ranked effects and contact rates drawn from the prior, by name."""
        ...

    def effects(self, model: TrustModel, draws: Draws, seed: int) -> dict[str, np.ndarray]:
        """Draws of the ranked effects, (chain, draw)."""
        ...


def sbc(
    model: TrustModel | None = None,
    sampler: str = "exact",
    *,
    n_datasets: int = 100,
    shape: tuple[int, int, int, int] = (4, 8, 3, 2),
    n_ticks: int = 40,
    n_draws: int = 1000,
    n_ranked: int = 396,
    seed: int = 0,
    design: Design | None = None,
    max_refused: float = 0.0,
    checkpoint: FilePath | None = None,
    progress: bool = True,
) -> xr.Dataset:
    """Rank each true parameter among posterior draws, over data sets simulated from the prior.

    If prior, likelihood and sampler fit together, ranks are uniform. Awareness is uniform in
    [0, 1]; contact rates are the model's, for Gaussian observations not cut to [0, 1].

    Args:
        model: Trust model; by default `PooledTrust()`.
        sampler: `"exact"` or `"nuts"`.
        n_datasets: Number of data sets.
        shape: Missions, bounds, robots and features of each.
        n_ticks: Ticks per bound: what the beta-binomial family counts, and the resolution that
            is the least delta_v of the others.
        n_draws: Draws of each of the 4 chains of NUTS.
        n_ranked: Draws each truth is ranked among, a multiple of 4; NUTS is thinned to these.
        seed: Seed; the same seed gives the same ranks.
        design: Missions that visit places, for a model with effects of places, which are ranked
            too; `benchmarks/sbc_places.py` has random walks.
        max_refused: Largest share of data sets that the sampler may refuse, as its weights are too
            uneven. They are left out, and hide a departure of that share at most.
        checkpoint: A file that keeps the ranks after each data set; with it, a call goes on where
            one with the same arguments stopped.
        progress: Whether to show a progress bar.

    Returns:
        Dataset with `rank` (dataset, parameter), in 0..n_ranked; `pit`, the ranks in (0, 1), which
        `az.plot_ecdf_pit` draws; `p_value` (parameter) of a chi-squared test of uniformity in 20
        bins; and `coverage` (interval, parameter), the share of truths in the central interval.
        Its attribute `n_refused` is the number of data sets left out.

    Raises:
        PosteriorError: The sampler refuses more data sets than that.
        TrustboError: The sampler is unknown or does not suit the model, there are no data sets, a
            model with effects of places has no design, or the checkpoint is of other arguments.
    """
    model = PooledTrust() if model is None else model
    sampler, _ = resolve_sampler(model, sampler)
    require_whole("n_datasets", n_datasets, 1)
    if (model.place is None) != (design is None):
        raise TrustboError(
            f"design={design!r} and place={model.place!r}: a model with effects of places needs a "
            "design, missions that visit places, and one without takes none; see "
            "benchmarks/sbc_places.py."
        )
    kept = require_whole("n_ranked", n_ranked, _CHAINS) // _CHAINS
    settings = NutsSettings(draws=kept if sampler == "exact" else n_draws, n_chains=_CHAINS)
    settings = settings if sampler == "exact" else with_warmup(settings, model)
    thinned = np.linspace(0, settings.draws - 1, kept).astype(int)
    awareness = np.random.default_rng(seed).uniform(size=shape)
    ticks = np.full(shape[:3], float(n_ticks))
    asked = f"{model.describe()}, {model.priors.describe()}, {sampler}, {shape}, {n_ticks}, "
    asked += f"{settings!r}, {n_ranked}, {seed}"
    ranks = _read(checkpoint, asked)
    model = model.at_resolution({float(n_ticks): 1.0})
    for j in tqdm(range(n_datasets), desc="data sets", disable=not progress):
        if j < len(ranks):
            continue
        # Not seed + j, whose random numbers the sampler draws.
        own = int(np.random.SeedSequence([seed, j]).generate_state(1)[0])
        if design is None:
            simulated = _simulate(model, awareness, ticks, own)
        else:
            simulated = design.simulate(model, awareness, ticks, own)
        batch = MissionBatch(awareness, simulated["contact_rate"], ticks)
        places = None if design is None else design.places(model)
        evidence = needs_evidence(model, sampler)
        slots = Slots.of(batch, shape[0], places=places) if evidence else None
        try:
            draws, _ = draw_posterior(
                model, sampler, settings, seed + j, batch, places=places, slots=slots, check=False
            )
        except PosteriorError:
            if sum(not rank for rank in ranks) + 1 > max_refused * n_datasets:
                raise
            ranks.append({})
            _write(checkpoint, asked, ranks)
            continue
        found = dict(draws.params)
        for variables in draws.effects.values():
            found |= {name: _ends(d, 2) for name, d in variables.items()}
        if design is not None:
            found = found | design.effects(model, draws, seed + j)
        ranks.append(_ranked(found, simulated, thinned))
        _write(checkpoint, asked, ranks)
    return _summary(ranks[:n_datasets], kept * _CHAINS, sampler)


def _ranked(
    found: dict[str, np.ndarray], truth: dict[str, np.ndarray], thinned: np.ndarray
) -> dict[str, int]:
    """Rank of each true number among the thinned draws (chain, draw, ...), by label."""
    rank = {}
    for name, drawn in found.items():
        below = (drawn[:, thinned] < truth[name]).sum((0, 1))
        free = np.ptp(drawn, axis=(0, 1)) > 0.0
        rank |= {_label(name, i): int(below[i]) for i in map(tuple, np.argwhere(free))}
    return rank


def _simulate(
    model: TrustModel, awareness: np.ndarray, ticks: np.ndarray, seed: int
) -> dict[str, np.ndarray]:
    """Parameters and contact rates drawn from the prior, by name."""
    sites = draw_sites(model, awareness.shape[2:], 1, seed)
    if isinstance(model, HumanTrust):
        slots = Slots.every(MissionBatch(awareness, ticks, ticks), len(ticks), (), None)
        drawn = draw_people(model, slots, sites, np.random.default_rng([seed, 4]))
        ranked = {"person": _ends(drawn["person"], 1)[0]}
        values = {name: value[0] for name, value in sites.items()}
        return values | ranked | {"contact_rate": drawn["contact_rate"][0]}
    params = model.params(sites, awareness.shape[3]).draw(0)
    batch = MissionBatch(awareness, np.zeros(ticks.shape), ticks)
    params, ranked = with_effects_drawn(model, sites, params, batch, seed)
    with own_settings():
        key = random.key(seed)
    rates = model.simulate(key, params, awareness, ticks).contact_rate
    values = {name: value[0] for name, value in sites.items()}
    return values | ranked | {"contact_rate": rates}


def with_effects_drawn(
    model: TrustModel, sites: Theta, params: Params, batch: MissionBatch, seed: int
) -> tuple[Params, dict[str, np.ndarray]]:
    """Parameters with effects from the prior, but those of places, and the ranked ones of these.

    Ranked are the first number of each variable, and the last. No feature is a line of sight.

    Args:
        model: Trust model.
        sites: Parameters, leading axis (draw,) of length 1.
        params: The same without it, the intercept perhaps of each (mission, bound, robot).
        batch: Missions.
        seed: Seed of the effects.
    """
    theta, rng, ranked = theta_of(sites, model.memory), np.random.default_rng([seed, 4]), {}
    slots = Slots.every(batch, len(batch.awareness), (), None)
    for effect in model.effects:
        values = draw_effects(effect, theta, slots, rng)
        drift = drift_of(effect, values, theta, slots)[0]
        params = params._replace(b=np.asarray(params.b) + drift)
        ranked |= {name: _ends(d, 1)[0] for name, d in values.items()}
    return params, ranked


def _ends(d: np.ndarray, n_leading: int) -> np.ndarray:
    """First and last number behind the leading axes, or the one there is."""
    flat = d.reshape(*d.shape[:n_leading], -1)
    return flat[..., np.unique([0, flat.shape[-1] - 1])]


def _label(name: str, index: tuple[int, ...]) -> str:
    return f"{name}[{','.join(map(str, index))}]" if index else name


def _summary(ranks: list[dict[str, int]], n_ranked: int, sampler: str) -> xr.Dataset:
    n_refused = sum(not rank for rank in ranks)
    ranks = [rank for rank in ranks if rank]
    names = list(ranks[0])
    table = np.array([[rank[name] for name in names] for rank in ranks])
    pit = (table + 0.5) / (n_ranked + 1)
    coverage = [(np.abs(pit - 0.5) < 0.5 * width).mean(0) for width in _INTERVALS]
    return xr.Dataset(
        {
            "rank": (("dataset", "parameter"), table),
            "pit": (("dataset", "parameter"), pit),
            "p_value": ("parameter", [_uniformity(column, n_ranked) for column in table.T]),
            "coverage": (("interval", "parameter"), coverage),
        },
        {"parameter": names, "interval": list(_INTERVALS)},
        {"sampler": sampler, "n_ranked": n_ranked, "n_refused": n_refused},
    )


def _uniformity(ranks: np.ndarray, n_ranked: int) -> float:
    """P-value of a chi-squared test; bins hold as many of the n_ranked + 1 ranks as they can."""
    n_bins = min(20, max(2, len(ranks) // 5))  # five ranks to a bin, for the test to hold
    edges = np.linspace(0, n_ranked + 1, n_bins + 1).astype(int)
    counts, _ = np.histogram(ranks, edges - 0.5)
    expected = len(ranks) * np.diff(edges) / (n_ranked + 1)
    return float(stats.chisquare(counts, expected).pvalue)


def _read(checkpoint: FilePath | None, asked: str) -> list[dict[str, int]]:
    if checkpoint is None or not Path(checkpoint).exists():
        return []
    kept = read_record(checkpoint)
    if not {"asked", "ranks"} <= kept.keys():
        raise TrustboError(f"{str(checkpoint)!r} holds no ranks; give another file, or delete it.")
    if kept["asked"] != asked:
        raise TrustboError(
            f"{str(checkpoint)!r} holds ranks of other arguments: {kept['asked']}. Give another "
            "file, or delete it."
        )
    return kept["ranks"]


def _write(checkpoint: FilePath | None, asked: str, ranks: list[dict[str, int]]) -> None:
    if checkpoint is None:
        return
    write_text(checkpoint, json.dumps({"asked": asked, "ranks": ranks}))
