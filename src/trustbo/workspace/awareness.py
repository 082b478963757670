"""Awareness of cells from the features of pixels, strip by strip."""

import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
import xarray as xr

from trustbo.errors import TerrainError, TrustboError, require_kind
from trustbo.parallel import in_order
from trustbo.team import Team
from trustbo.terrain import stencil
from trustbo.terrain.composite import MAX_PIXELS, CompositeIndex
from trustbo.terrain.dataset import is_lazy, pixel_size, warn_if_clipped
from trustbo.terrain.features import openness
from trustbo.terrain.pixel_feature import FEATURES, PixelFeature, feature_named
from trustbo.terrain.strips import Strip, sample_strips, strips
from trustbo.workspace.grid import CellMeans, Grid, Sums

FeatureSpec = PixelFeature | Mapping[str, PixelFeature]
"""Definition of an awareness feature: a pixel feature in [0, 1], or those of a composite."""

SAMPLE = 1 << 15
"""Number of pixels that a composite is fitted on, if the raster is larger than `MAX_PIXELS`."""


class CellMaps(NamedTuple):
    """Maps of cells made from a terrain."""

    awareness: np.ndarray  # (row, col, feature), in [0, 1]; NaN where a cell has no data
    passable_share: np.ndarray  # (row, col), share of pixels with data that are not too steep
    composites: dict[str, CompositeIndex]
    pixels: xr.Dataset | None
    """Awareness and passability of each pixel, dims (y, x), if kept."""


def feature_specs(features: Mapping[str, object]) -> dict[str, FeatureSpec]:
    """Definitions of awareness features, given by names of pixel features or as pixel features.

    TrustboError: an unknown name, or something that is no feature.
    """
    remedy = "give definitions by name, e.g. {'slope': 'slope'}"
    require_kind("features", features, Mapping, remedy)
    return {name: _spec(name, parts) for name, parts in features.items()}


def _spec(name: str, parts: object) -> FeatureSpec:
    if isinstance(parts, PixelFeature):
        return parts
    if isinstance(parts, str):
        return feature_named(parts)
    if isinstance(parts, Mapping) and all(isinstance(p, PixelFeature) for p in parts.values()):
        chosen = dict(parts)
    elif isinstance(parts, Iterable) and not isinstance(parts, Mapping):
        chosen = {part: feature_named(part) for part in parts}
    else:
        chosen = {}
    if not chosen:
        raise TrustboError(
            f"feature {name!r} must be names of pixel features, e.g. ['slope', 'tri'], a mapping "
            f"of names to PixelFeature, or one PixelFeature; got {parts!r}."
        )
    return chosen


def cell_maps(
    terrain: xr.Dataset,
    grid: Grid,
    features: Mapping[str, FeatureSpec],
    *,
    max_slope: float,
    scaling: str = "percentile",
    keep_pixels: bool = True,
) -> CellMaps:
    """Awareness and passability (slope up to `max_slope`, rad) of each cell.

    A composite is fitted on all pixels of a raster of up to a million, on rows spread evenly over a
    larger one; then each pixel's index is added to its cell, strip by strip, so that no feature of
    the whole raster is in memory, unless `keep_pixels`. `scaling` is `CompositeIndex`'s.

    TrustboError: a feature that is no composite outside [0, 1].
    """
    parts = [p for f in features.values() for p in _parts(f)]
    halo = max(part.halo for part in parts)
    whole = list(strips(terrain, halo)) if terrain["dem"].size <= MAX_PIXELS else None
    strip_features = _StripFeatures(whole)
    to_fit = {n: f for n, f in features.items() if isinstance(f, Mapping)}
    fitted = _fit(terrain, to_fit, scaling, strip_features, whole)
    like = terrain["dem"]
    cells = {name: CellMeans(grid, like) for name in (*features, "passable")}
    maps: dict[str, list[np.ndarray]] = {name: [] for name in cells}

    def work(strip: Strip) -> tuple[Strip, dict[str, np.ndarray], dict[str, Sums]]:
        index = {"passable": strip_features.passable(strip, max_slope)}
        for name, f in features.items():
            index[name] = strip_features.index(strip, name, f, fitted)
        sums = {name: means.sums(index[name], strip.rows.start) for name, means in cells.items()}
        wanted = index if keep_pixels else ()
        return strip, {name: index[name].copy() for name in wanted}, sums

    n_clipped = n_valid = 0.0
    for strip, index, sums in in_order(work, whole or strips(terrain, halo)):
        for name, of_strip in sums.items():
            cells[name].merge(of_strip)
        for name, values in index.items():
            maps[name].append(values)
        share = (strip.rows.stop - strip.rows.start) / strip.window.sizes["y"]
        n_clipped, n_valid = n_clipped + share * strip.n_clipped, n_valid + share * strip.n_valid
    if is_lazy(terrain):
        warn_if_clipped(round(n_clipped), round(n_valid), stacklevel=4)
    return CellMaps(
        np.stack([cells[name].cells for name in features], axis=-1),
        cells["passable"].cells,
        fitted,
        _assemble(like, maps) if keep_pixels else None,
    )


class _BufferPool(threading.local):
    """Arrays that are reused: to allocate memory takes longer than to write to it."""

    def __init__(self) -> None:
        self._known: dict[tuple[object, ...], np.ndarray] = {}

    def __call__(self, purpose: str, shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
        key = purpose, shape, dtype
        if key not in self._known:
            self._known[key] = np.empty(shape, dtype)
        return self._known[key]


class _StripFeatures:
    """Features of strips; they are cached if the whole terrain was sampled for the fit."""

    def __init__(self, whole: Sequence[Strip] | None) -> None:
        self._keep = whole is not None
        self._known: dict[tuple[int, str], dict[str, np.ndarray]] = {}
        self._buffers = _BufferPool()

    def features(
        self, strip: Strip, name: str, parts: Mapping[str, PixelFeature]
    ) -> dict[str, np.ndarray]:
        """Features of the strip's pixels, each of shape (row, col)."""
        key = (strip.rows.start, name)
        if key in self._known:
            return self._known[key]
        values = {n: part.of_rows(strip.window, strip.core) for n, part in parts.items()}
        if self._keep:
            self._known[key] = values
        return values

    def index(
        self, strip: Strip, name: str, f: FeatureSpec, fitted: Mapping[str, CompositeIndex]
    ) -> np.ndarray:
        """Awareness feature of the strip's pixels, valid until the thread's next strip."""
        if isinstance(f, Mapping):
            if self._keep:
                return fitted[name].of_columns(self.features(strip, name, f))
            dem = strip.window.variables["dem"].values[strip.core]
            out = self._buffers(name, dem.shape, dem.dtype)
            return fitted[name].of_columns(_LazyColumns(strip, f, self._buffers), out)
        values = f.of_rows(strip.window, strip.core)
        low, high = np.nanmin(values, initial=0.0), np.nanmax(values, initial=1.0)
        if low < 0.0 or high > 1.0:
            raise TrustboError(
                f"feature {name!r} is used as it is and must lie in [0, 1]; it has {low:g} to "
                f"{high:g}. Scale it, or make it a composite of one: {{{name!r}: [...]}}."
            )
        return values

    def passable(self, strip: Strip, max_slope: float) -> np.ndarray:
        """Whether each pixel of the strip is not too steep."""
        buffer = partial(self._buffers, "slope")
        return FEATURES["slope"].of_rows(strip.window, strip.core, buffer) <= max_slope


class _LazyColumns(Mapping[str, np.ndarray]):
    """Features of a strip, each computed on access in the buffer of the one before.

    Slope is in its buffer already: `passable` is computed first.
    """

    def __init__(
        self, strip: Strip, parts: Mapping[str, PixelFeature], buffers: _BufferPool
    ) -> None:
        self._strip, self._parts, self._buffers = strip, parts, buffers

    def __getitem__(self, name: str) -> np.ndarray:
        part = self._parts[name]
        if part.kernel is stencil.slope:
            dem = self._strip.window.variables["dem"].values[self._strip.core]
            return self._buffers("slope", dem.shape, dem.dtype)
        buffer = partial(self._buffers, "part")
        values = part.of_rows(self._strip.window, self._strip.core, buffer)
        return np.ascontiguousarray(values)

    def __iter__(self) -> Iterator[str]:
        return iter(self._parts)

    def __len__(self) -> int:
        return len(self._parts)


def _fit(
    terrain: xr.Dataset,
    features: Mapping[str, Mapping[str, PixelFeature]],
    scaling: str,
    strip_features: _StripFeatures,
    whole: Sequence[Strip] | None,
) -> dict[str, CompositeIndex]:
    """Composites fitted on a sample of pixels, with the halo that the features of each need."""
    fitted = {}
    for name, parts in features.items():
        halo = max(part.halo for part in parts.values())
        chosen = whole or sample_strips(terrain, halo, SAMPLE)
        drawn = [strip_features.features(strip, name, parts) for strip in chosen]
        sample = xr.Dataset(
            {p: ("pixel", np.concatenate([d[p].ravel() for d in drawn])) for p in parts}
        )
        signs = {part: feature.sign for part, feature in parts.items()}
        try:
            fitted[name] = CompositeIndex(signs, scaling=scaling).fit(sample)
        except TerrainError as error:
            raise TerrainError(f"{name}: {error}") from None
    return fitted


def _parts(f: FeatureSpec) -> list[PixelFeature]:
    return list(f.values()) if isinstance(f, Mapping) else [f]


def _assemble(like: xr.DataArray, maps: Mapping[str, list[np.ndarray]]) -> xr.Dataset:
    """Maps of all pixels from those of the strips."""
    whole = {name: np.concatenate(pieces) for name, pieces in maps.items()}
    return xr.Dataset(
        {
            name: xr.DataArray(
                values, like.coords, like.dims, attrs={} if name == "passable" else {"units": "1"}
            )
            for name, values in whole.items()
        }
    )


def within_reach(
    features: dict[str, FeatureSpec], terrain: xr.Dataset, grid: Grid, team: Team
) -> dict[str, FeatureSpec]:
    """Definitions with openness over the lidar's range, limited by a cell and by the terrain."""
    height, width = pixel_size(terrain)
    rows, cols = terrain["dem"].shape
    reach = min(
        max(robot.lidar_range for robot in team.robots),
        float(np.hypot(grid.cell_height, grid.cell_width)),
        0.5 * min(rows * height, cols * width),
    )
    eye, target = team.robots[0].sensor_height, team.lead.target_height
    ours = PixelFeature(
        partial(openness, reach=reach, eye=eye, target=target), 1, reach, by_rows=True
    )

    def fitting(part: PixelFeature) -> PixelFeature:
        return ours._replace(sign=part.sign) if part.compute is openness else part

    return {
        name: fitting(f) if isinstance(f, PixelFeature) else {n: fitting(p) for n, p in f.items()}
        for name, f in features.items()
    }
