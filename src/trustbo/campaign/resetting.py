"""Chance that a place has changed since the last visit: belief in it fades while nobody is there.

Nobody visits a place that was bad, so that nothing shows when it is good again. With a log-uniform
hazard of a change, a place that was first visited n missions before its last visit, and that had
been expected to last `_LIFE` missions before, has changed in the D missions since with chance

    g = D / (D + n + _LIFE).

In a draw of the belief, effects of a visited cell and of the bounds into it are drawn from their
prior with chance g. Optimistic policies then go back to it, ever more rarely where nothing changed.
"""

from collections.abc import Sequence

import numpy as np
import xarray as xr

from trustbo.data import Mission
from trustbo.models.params import Params

_LIFE = 40.0  # missions


def chances(
    missions: Sequence[Mission], numbers: Sequence[int], shape: tuple[int, ...], now: int
) -> np.ndarray:
    """Chance of each cell to have changed since its last visit, (row, col); 0 if never visited.

    Args:
        missions: Missions that were learned from.
        numbers: Their numbers in the campaign, from 0, in order.
        shape: Rows and columns of the grid.
        now: Number of the next mission.
    """
    first, last = np.full(shape, -1), np.full(shape, -1)
    for mission, number in zip(missions, numbers, strict=True):
        rows, cols = np.array([bound.cell for bound in mission.bounds]).T
        last[rows, cols] = number
        first[rows, cols] = np.where(first[rows, cols] < 0, number, first[rows, cols])
    since = now - 1 - last
    return np.where(last < 0, 0.0, since / (since + last - first + _LIFE))


def with_resets(belief: Params, posterior: xr.DataTree, chance: np.ndarray, seed: int) -> Params:
    """Belief whose places are drawn from the prior with a chance.

    Args:
        belief: Draws of a posterior, see `params_of`.
        posterior: The posterior, for the sds of effects.
        chance: Chance of each cell, (row, col).
        seed: Seed.
    """
    rng = np.random.default_rng(seed)
    sites = posterior["posterior"].to_dataset()
    reset, places = None, {}
    for name, tau in (("place", "tau_s"), ("place_bound", "tau_e")):
        if (effect := getattr(belief, name, None)) is None:
            continue
        effect = np.asarray(effect)
        sd = sites[tau].transpose("chain", "draw").values.ravel()
        if reset is None:  # both effects of a cell at once
            reset = rng.random((len(effect), *chance.shape)) < chance
        axes = (slice(None), *(None,) * (effect.ndim - 3))
        drawn = sd.reshape(-1, *(1,) * (effect.ndim - 1)) * rng.standard_normal(effect.shape)
        places[name] = np.where(reset[axes], drawn, effect)
    return belief._replace(**places) if places else belief  # pyright: ignore
