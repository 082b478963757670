"""Awareness of bounds on a terrain: traversability of the way, line of sight, and maps of cells."""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
import xarray as xr

from trustbo.data import LINE_OF_SIGHT, is_line_of_sight
from trustbo.errors import TerrainError, TrustboError
from trustbo.workspace.line_of_sight import Geometry, bound_features, over_bounds
from trustbo.workspace.moves import existing_bounds
from trustbo.workspace.sight import Sight
from trustbo.workspace.ways import Ways

TRAVERSABLE = "traversability"
"""Name of the feature that is averaged along the way, instead of over the cell entered."""


class BoundMaps(NamedTuple):
    """Awareness of bounds and of cells; the last features are the lines of sight, by sight."""

    bounds: np.ndarray  # (robot, move, row, col, feature), NaN where there is none
    cells: np.ndarray  # (robot, row, col, feature)


def sight_features(n_sights: int) -> tuple[str, ...]:
    """Names of the line of sight under each assumed sight."""
    if n_sights == 1:
        return (LINE_OF_SIGHT,)
    return tuple(f"{LINE_OF_SIGHT}_{n + 1}" for n in range(n_sights))


def require_sight(
    terrain: xr.Dataset, sights: Sequence[Sight], features: Mapping[str, object]
) -> None:
    """Refuse a terrain on which no line of sight can be computed.

    TerrainError: it has no canopy where a sight needs one. TrustboError: a
    feature has the name of a line of sight.
    """
    for name in features:
        if is_line_of_sight(name):
            raise TrustboError(
                f"{name!r} is the name of a feature of bounds; give yours another, or bounds=False."
            )
    if any(sight.mode == "wall" for sight in sights):
        if not (terrain["dsm"].values > terrain["dem"].values).any():
            raise TerrainError(
                "sight mode 'wall' needs canopy, and the DSM is nowhere above the DEM; give a DSM, "
                "or sight='bare'."
            )


def of_bounds(
    ways: Ways,
    sights: Sequence[Sight],
    cells: np.ndarray,
    passable: np.ndarray,
    features: Sequence[str],
    traversability: np.ndarray | None,
) -> BoundMaps:
    """Compute awareness of bounds and of cells, the latter with means over the bounds into them.

    Of the maps of `cells` (robot, row, col, feature) under the names `features`, followed by the
    line of sight under each of `sights`; `traversability` is the map of pixels (row, col), if there
    is one. Posts are those of `ways` under any sight. TerrainError: a cell without standing room
    for the team.
    """
    exists = existing_bounds(passable)
    n_robots, n_features = len(cells), cells.shape[-1]
    maps = np.full((n_robots, *exists.shape, n_features + len(sights)), np.nan)
    maps[..., :n_features] = np.where(exists[..., None], cells[:, None], np.nan)
    surface = ways.posts.surface
    if traversability is None:
        traversability = np.full(surface.ground.shape, np.nan)
    for row, col in np.argwhere(passable).tolist():
        ways.posts.require_room((row, col))

    def work(given: Geometry) -> tuple[list[np.ndarray], np.ndarray]:
        features_of = partial(bound_features, surface, team=ways.posts.team, given=given)
        both = [features_of(sight=sight, index=traversability) for sight in sights]
        return [los for los, _ in both], both[0][1]

    for bounds, (seen, easy) in over_bounds(ways, passable, work):
        for n, los in enumerate(seen):
            maps[:, *bounds, n_features + n] = los.T
        if TRAVERSABLE in features:
            m = list(features).index(TRAVERSABLE)
            filled = np.where(np.isfinite(easy.T), easy.T, maps[:, *bounds, m])
            maps[:, *bounds, m] = filled
    maps = np.clip(maps, 0.0, 1.0)
    into = np.maximum(exists.sum(0), 1)[..., None]
    seen = np.nansum(maps[..., n_features:], axis=1) / into
    seen = np.where(passable[..., None], seen, np.nan)
    return BoundMaps(maps, np.concatenate([cells, seen], axis=-1))
