"""Awareness of cells, from the pixels of a terrain or from a user's arrays."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from trustbo.arrays import as_array
from trustbo.errors import ShapeError, TrustboError
from trustbo.parallel import in_order
from trustbo.team import Team
from trustbo.terrain.composite import CompositeIndex
from trustbo.terrain.dataset import warn_if_clipped
from trustbo.terrain.pixel_awareness import PixelAwareness
from trustbo.terrain.strips import Strip
from trustbo.workspace.grid import CellMeans, Grid, Sums
from trustbo.workspace.moves import MOVES, existing_bounds
from trustbo.workspace.survey import MAX_MISSING

_AXES = "(robot, row, col, feature) or (robot, move, row, col, feature) with 8 moves"


class CellMaps(NamedTuple):
    """Maps of cells made from a terrain."""

    awareness: np.ndarray  # (row, col, feature), in [0, 1]; NaN where a cell has no data
    passable_share: np.ndarray  # (row, col), share of pixels with data that are not too steep
    composites: dict[str, CompositeIndex]  # by feature
    features: tuple[str, ...]
    pixels: xr.Dataset | None
    """Awareness and passability of each pixel, dims (y, x), if kept."""

    def of_team(self, grid: Grid, team: Team) -> tuple[xr.DataArray, xr.DataArray]:
        """Awareness, the same for each robot, and passability of the cells, see `labelled`."""
        passable = np.nan_to_num(self.passable_share) >= 1.0 - MAX_MISSING
        passable &= np.isfinite(self.awareness).all(-1)
        z = np.repeat(self.awareness[None], len(team.robots), axis=0)
        return labelled(z, passable, grid, team, self.features)


def labelled(
    z: np.ndarray, passable: np.ndarray, grid: Grid, team: Team, features: Sequence[str]
) -> tuple[xr.DataArray, xr.DataArray]:
    """Label awareness (robot, row, col, feature) and passability (row, col) of a grid.

    TrustboError: no cell is passable.
    """
    if not passable.any():
        raise TrustboError(
            "no cell is passable: more than half of every cell is missing or too steep. Use "
            "other cells, or a team with a larger max_slope."
        )
    dims = ("robot", "row", "col", "feature")
    cells = {
        **{axis: np.arange(n) for axis, n in zip(dims[1:3], grid.shape, strict=True)},
        "y": ("row", grid.y),
        "x": ("col", grid.x),
    }
    coords = {"robot": list(team.names), **cells, "feature": list(features)}
    return (
        xr.DataArray(z, coords, dims, "awareness"),
        xr.DataArray(passable, cells, dims[1:3], "passable"),
    )


def cell_maps(
    terrain: xr.Dataset,
    grid: Grid,
    features: Mapping[str, object],
    team: Team,
    *,
    keep_pixels: bool = True,
) -> CellMaps:
    """Compute awareness and passability of each cell; see `Workspace.from_terrain`.

    Each pixel is added to its cell strip by strip. Pixels of a terrain read lazily are not kept.
    """
    dem = terrain["dem"]
    cells = CellMeans(grid.shape, *grid.cells_along(dem["y"].values, dem["x"].values))
    diagonal = float(np.hypot(grid.cell_height, grid.cell_width))
    pixels = PixelAwareness(terrain, features, team, reach=diagonal)
    kept = (*pixels.names, "passable") if keep_pixels and not pixels.is_lazy else ()
    maps: dict[str, list[np.ndarray]] = {name: [] for name in kept}

    def work(strip: Strip) -> tuple[Strip, dict[str, np.ndarray], dict[str, Sums]]:
        index = pixels.features_of(strip)
        copied = {name: index[name].copy() for name in kept}
        return strip, copied, cells.sums(index, strip.rows.start)

    n_clipped = n_valid = 0.0
    for strip, index, sums in in_order(work, pixels.strips):
        cells.merge(sums)
        for name, values in index.items():
            maps[name].append(values)
        share = (strip.rows.stop - strip.rows.start) / strip.window.sizes["y"]
        n_clipped, n_valid = n_clipped + share * strip.n_clipped, n_valid + share * strip.n_valid
    if pixels.is_lazy:
        warn_if_clipped(round(n_clipped), round(n_valid), stacklevel=4)
    units = {name: {} if name == "passable" else {"units": "1"} for name in maps}
    whole = {
        name: xr.DataArray(np.concatenate(strips), dem.coords, dem.dims, attrs=units[name])
        for name, strips in maps.items()
    }
    return CellMaps(
        np.stack([cells[name] for name in pixels.names], axis=-1),
        cells["passable"],
        pixels.composites,
        pixels.names,
        xr.Dataset(whole) if kept else None,
    )


def of_cells(
    awareness: ArrayLike, passable: ArrayLike | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Check the arrays of `Workspace.from_awareness`.

    Returns awareness of cells (robot, row, col, feature), passability (row, col), and awareness of
    bounds (robot, move, row, col, feature), or None where it is that of the cells.

    ShapeError: other axes. TrustboError: a value outside [0, 1], NaN in a passable cell or in a
    bound between two.
    """
    z = as_array("awareness", awareness)
    if z.ndim not in (4, 5) or (z.ndim == 5 and z.shape[1] != len(MOVES[8])):
        raise ShapeError(f"awareness must be {_AXES}; got shape {z.shape}.")
    if not z.size:
        raise ShapeError(
            f"awareness has an axis of length 0; got shape {z.shape}. Without features, give one "
            "that is 0 everywhere."
        )
    if (bad := (z < 0.0) | (z > 1.0)).any():
        index = tuple(int(i) for i in np.argwhere(bad)[0])
        raise TrustboError(f"awareness{list(index)} = {z[index]:g} is outside [0, 1].")
    finite = np.isfinite(z).all((0, -1))  # ([move], row, col)
    reached = finite if z.ndim == 4 else finite.any(0)
    free = reached if passable is None else np.asarray(passable, dtype=bool)
    if free.shape != z.shape[-3:-1]:
        raise ShapeError(f"passable must be (row, col) = {z.shape[-3:-1]}; got {free.shape}.")
    if (free & ~reached).any():
        cell = tuple(int(i) for i in np.argwhere(free & ~reached)[0])
        raise TrustboError(
            f"awareness of the passable cell {cell} is NaN; fill it, or mark it impassable."
        )
    if z.ndim == 4:
        return z, free, None
    exists = existing_bounds(free)
    if (missing := exists & ~finite).any():
        m, row, col = (int(i) for i in np.argwhere(missing)[0])
        down, right = MOVES[8][m]
        raise TrustboError(
            f"awareness of the bound {(row - down, col - right)} -> {(row, col)} is NaN; fill it, "
            "or mark one of the cells impassable."
        )
    bounds = np.where(exists[..., None], z, np.nan)
    count = np.maximum(exists.sum(0), 1)[..., None]
    cells = np.nansum(bounds, axis=1) / count
    # A passable cell without a passable neighbour is entered by no bound.
    alone = (free & ~exists.any(0))[..., None]
    fallback = np.nanmean(np.where(free[..., None], z, np.nan), axis=1) if alone.any() else cells
    cells = np.where(alone, fallback, cells)
    return np.where(free[..., None], cells, np.nan), free, bounds
