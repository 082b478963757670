"""Awareness features of pixels: attributes and composites of them, strip by strip."""

import threading
from collections.abc import Iterable, Iterator, Mapping
from functools import partial

import numpy as np
import xarray as xr

from trustbo.errors import TerrainError, TrustboError, require_kind
from trustbo.team import Team
from trustbo.terrain import stencil
from trustbo.terrain.composite import MAX_PIXELS, CompositeIndex
from trustbo.terrain.dataset import is_lazy, pixel_size
from trustbo.terrain.features import openness
from trustbo.terrain.pixel_feature import FEATURES, PixelFeature, feature_named
from trustbo.terrain.strips import Strip, sample_strips, strips

FeatureSpec = PixelFeature | Mapping[str, PixelFeature]
"""Definition of an awareness feature: a pixel feature in [0, 1], or those of a composite."""

SAMPLE = 1 << 15
"""Number of pixels that a composite is fitted on, if the raster is larger than `MAX_PIXELS`."""


class PixelAwareness:
    """Awareness features and passability of the pixels of each strip of a terrain.

    A composite is fitted on all pixels of a raster of up to a million, on rows spread evenly over a
    larger one; then the indices of a strip's pixels are computed on request, so that no feature of
    the whole raster is in memory.

    Attributes:
        strips: Strips of the terrain, from north to south, to be iterated once.
        composites: Fitted composites by feature.
        names: Names of the features.
        is_lazy: Whether the terrain is read lazily.
    """

    def __init__(
        self,
        terrain: xr.Dataset,
        features: Mapping[str, object],
        team: Team,
        *,
        reach: float = np.inf,
    ) -> None:
        """Fit the composites; see `Workspace.from_terrain` for features.

        Openness is over the range of the team's lidars, at most `reach` and half the terrain.

        TrustboError: an unknown feature. TerrainError: too few pixels.
        """
        remedy = "give definitions by name, e.g. {'slope': 'slope'}"
        features = require_kind("features", features, Mapping, remedy)
        self._features = {name: _spec(name, parts) for name, parts in features.items()}
        height, width = pixel_size(terrain)
        n_rows, n_cols = terrain["dem"].shape
        self._use_lidar(team, min(reach, 0.5 * min(n_rows * height, n_cols * width)))
        # Rows on both sides on which each feature depends.
        around = {
            name: int(min(n_rows, np.ceil(max(part.halo for part in _parts(f)) / height) + 2))
            for name, f in self._features.items()
        }
        whole = None
        if n_rows * n_cols <= MAX_PIXELS:
            whole = list(strips(terrain, max(around.values())))
        self.strips: Iterable[Strip] = whole or strips(terrain, max(around.values()))
        self.is_lazy, self.names = is_lazy(terrain), tuple(self._features)
        self._max_slope, self._keep, self._buffers = (
            team.max_slope,
            whole is not None,
            _BufferPool(),
        )
        self._cached: dict[tuple[int, str], dict[str, np.ndarray]] = {}
        self.composites: dict[str, CompositeIndex] = {}
        for name, f in self._features.items():
            if isinstance(f, Mapping):
                chosen = whole or sample_strips(terrain, around[name], SAMPLE)
                self._fit(name, f, chosen)

    def features_of(self, strip: Strip) -> dict[str, np.ndarray]:
        """Features of a strip's pixels and "passable", valid until the thread's next strip.

        TrustboError: a feature that is no composite outside [0, 1].
        """
        buffer = partial(self._buffers, "slope")
        slope = FEATURES["slope"].of_rows(strip.window, strip.core, buffer)
        index = {"passable": slope <= self._max_slope}
        return index | {name: self._index(strip, name, f) for name, f in self._features.items()}

    def _use_lidar(self, team: Team, reach: float) -> None:
        """Compute openness for the team's heights, over the range of its lidars up to `reach`."""
        reach = min(max(robot.lidar_range for robot in team.robots), reach)
        eye, target = team.robots[0].sensor_height, team.lead.target_height
        compute = partial(openness, reach=reach, eye=eye, target=target)
        ours = PixelFeature(compute, 1, reach, by_rows=True)

        def fitting(part: PixelFeature) -> PixelFeature:
            return ours._replace(sign=part.sign) if part.compute is openness else part

        for name, f in self._features.items():
            is_one = isinstance(f, PixelFeature)
            self._features[name] = fitting(f) if is_one else {n: fitting(p) for n, p in f.items()}

    def _fit(self, name: str, parts: Mapping[str, PixelFeature], chosen: Iterable[Strip]) -> None:
        """Fit a composite on some strips, with the halo that its features need."""
        drawn = [self._columns(strip, name, parts) for strip in chosen]
        sample = xr.Dataset(
            {p: ("pixel", np.concatenate([d[p].ravel() for d in drawn])) for p in parts}
        )
        signs = {part: feature.sign for part, feature in parts.items()}
        try:
            self.composites[name] = CompositeIndex(signs).fit(sample)
        except TerrainError as error:
            raise TerrainError(f"{name}: {error}") from None

    def _columns(
        self, strip: Strip, name: str, parts: Mapping[str, PixelFeature]
    ) -> dict[str, np.ndarray]:
        """Features of the strip's pixels, each (row, col); kept if all strips are in the fit."""
        key = (strip.rows.start, name)
        if key in self._cached:
            return self._cached[key]
        values = {n: part.of_rows(strip.window, strip.core) for n, part in parts.items()}
        if self._keep:
            self._cached[key] = values
        return values

    def _index(self, strip: Strip, name: str, f: FeatureSpec) -> np.ndarray:
        if isinstance(f, Mapping):
            if self._keep:
                return self.composites[name].of_columns(self._columns(strip, name, f))
            dem = strip.window.variables["dem"].values[strip.core]
            out = self._buffers(name, dem.shape, dem.dtype)
            return self.composites[name].of_columns(_LazyColumns(strip, f, self._buffers), out)
        values = f.of_rows(strip.window, strip.core)
        low, high = np.nanmin(values, initial=0.0), np.nanmax(values, initial=1.0)
        if low < 0.0 or high > 1.0:
            raise TrustboError(
                f"feature {name!r} is used as it is and must lie in [0, 1]; it has {low:g} to "
                f"{high:g}. Scale it, or make it a composite of one: {{{name!r}: [...]}}."
            )
        return values


class _BufferPool(threading.local):
    """Arrays that are reused: to allocate memory takes longer than to write to it."""

    def __init__(self) -> None:
        self._cached: dict[tuple[object, ...], np.ndarray] = {}

    def __call__(self, purpose: str, shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
        key = purpose, shape, dtype
        if key not in self._cached:
            self._cached[key] = np.empty(shape, dtype)
        return self._cached[key]


class _LazyColumns(Mapping[str, np.ndarray]):
    """Features of a strip, each computed on access in the buffer of the one before.

    Slope is in its buffer already, computed first for passability.
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


def _parts(f: FeatureSpec) -> list[PixelFeature]:
    return list(f.values()) if isinstance(f, Mapping) else [f]
