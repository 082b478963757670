"""Options of samplers, as checked by `fit`."""

from typing import NamedTuple

import xarray as xr


class Options(NamedTuple):
    """Options of a sampler; see `fit`."""

    sampler: str
    draws: int | None = None
    """Number of draws per chain; None for the default of the model."""
    chains: int = 4
    warmup: int | None = None
    """Number of warm-up draws per chain; None for the default of the model."""
    seed: int = 0
    progress: bool = True
    check: bool = True
    start: xr.DataTree | None = None
    """Posterior of the same model given similar data, or None."""
