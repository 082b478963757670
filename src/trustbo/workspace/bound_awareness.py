"""Awareness of bounds on a terrain: traversability, line of sight, and maps of cells."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from trustbo.data import is_line_of_sight
from trustbo.errors import TrustboError
from trustbo.workspace.line_of_sight import bound_maps
from trustbo.workspace.moves import existing_bounds
from trustbo.workspace.posts import TRAVERSABLE, Posts


class BoundMaps(NamedTuple):
    """Awareness of bounds and of cells; the last feature is the line of sight."""

    bounds: np.ndarray  # (robot, move, row, col, feature), NaN where there is none
    cells: np.ndarray  # (robot, row, col, feature)


def require_names(features: Mapping[str, object]) -> None:
    """Refuse a feature of cells with the name of the line of sight: TrustboError."""
    for name in features:
        if is_line_of_sight(name):
            raise TrustboError(f"{name!r} is the name of a feature of bounds; give yours another.")


def of_bounds(
    posts: Posts,
    cells: np.ndarray,
    passable: np.ndarray,
    features: Sequence[str],
    traversability: np.ndarray | None,
) -> BoundMaps:
    """Compute awareness of bounds and of cells, the latter with means over the bounds into them.

    Of the maps of `cells` (robot, row, col, feature) under the names `features`, followed by the
    line of sight; `traversability` is the map of pixels (row, col), if there
    is one. TrustboError: a cell without standing room
    for the team.
    """
    for row, col in np.argwhere(passable).tolist():
        posts.require_room((row, col))
    exists = existing_bounds(passable)
    n_robots, n_features = len(cells), cells.shape[-1]
    maps = np.full((n_robots, *exists.shape, n_features + 1), np.nan)
    maps[..., :n_features] = np.where(exists[..., None], cells[:, None], np.nan)
    if traversability is None:
        traversability = np.full(posts.surface.ground.shape, np.nan)
    maps[..., -1], easy = bound_maps(posts, passable, traversability)
    if TRAVERSABLE in features:
        of_route = maps[..., list(features).index(TRAVERSABLE)]
        of_route[...] = np.where(np.isfinite(easy), easy, of_route)
    maps = np.clip(maps, 0.0, 1.0)
    into = np.maximum(exists.sum(0), 1)[..., None]
    seen = np.nansum(maps[..., n_features:], axis=1) / into
    seen = np.where(passable[..., None], seen, np.nan)
    return BoundMaps(maps, np.concatenate([cells, seen], axis=-1))
