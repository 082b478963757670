"""Awareness of bounds, from the pixels of a terrain or from a user's arrays.

Overwatch involves two cells, so awareness is defined for each bound, that is, for a cell and a move
into the cell. The awareness of a cell applies to all moves into the cell.
"""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from trustbo.arrays import read_labelled, without_rounding
from trustbo.data import POST_SETS, is_line_of_sight
from trustbo.errors import TrustboError, one_line, require_kind, require_order
from trustbo.files import is_storable
from trustbo.team import Team
from trustbo.terrain import FEATURES, CompositeIndex
from trustbo.terrain.features import pixel_feature
from trustbo.workspace.grid import MAX_MISSING, Grid
from trustbo.workspace.line_of_sight import bound_maps
from trustbo.workspace.moves import MOVES, existing_bounds, for_sets, way_names
from trustbo.workspace.posts import TRAVERSABLE, Posts
from trustbo.workspace.sight import Sight
from trustbo.workspace.surface import Surface

_DIMS = ("robot", "move", "row", "col", "feature")
_AXES = (
    "(robot, row, col, feature) or (robot, move, row, col, feature) with 8 moves, or 8 for each of "
    f"up to {len(POST_SETS)} sets of posts"
)
_RESERVED = ("passable", "x", "y", "spatial_ref")
"""Names of other variables in the dataset of pixels."""


def pixel_maps(
    terrain: xr.Dataset, features: Mapping[str, object], options: Mapping[str, Mapping[str, float]]
) -> tuple[xr.Dataset, dict[str, CompositeIndex]]:
    """Compute the features of a terrain's pixels, and fit the composite indices.

    `features` are those of `Workspace.from_terrain`; `options` are arguments of pixel features, by
    name, as from `options_of`.

    Returns:
        A dataset (y, x) of each feature, in [0, 1] and in single precision to save memory, and the
        fitted composite indices.

    Raises:
        TrustboError: A feature is unknown, does not return a number for each pixel, has a name that
            is reserved or that files cannot store, or is used unchanged but has values outside
            [0, 1].
    """
    remedy = "map each feature to its pixel features, such as {'ease': ('slope', 'tri')}"
    if not require_kind("features", features, Mapping, remedy):
        raise TrustboError(f"features must contain at least one feature; {remedy}.")

    for name in features:
        require_kind("name of a feature", name, str, remedy)
        if is_line_of_sight(name) or name in _RESERVED:
            raise TrustboError(f"feature name {name!r} is reserved; choose another name.")
        if not is_storable(name):
            raise TrustboError(
                f"feature name {one_line(name)} cannot be stored in a netCDF file; begin with a "
                "letter or a digit, end without a space, and use no '/' or control characters."
            )

    def values_of(name: str) -> np.ndarray:
        return pixel_feature(name, terrain, **options.get(name, {}))

    pixels = {}
    composites = {}

    for name, parts in features.items():
        if isinstance(parts, str):
            values = without_rounding(values_of(parts))
            pixels[name] = values.astype(np.float32)
            low = np.nanmin(values, initial=0.0)
            high = np.nanmax(values, initial=1.0)
            if low < 0.0 or high > 1.0:
                reverses = FEATURES[parts].sign < 0
                order = f", which is larger where {parts} is smaller" if reverses else ""
                raise TrustboError(
                    f"feature {name!r} is used unchanged and must be in [0, 1]; its values are "
                    f"{low:g} to {high:g}. Make it a composite index: {{{name!r}: [{parts!r}]}}"
                    f"{order}; or scale it in a function with tb.terrain.feature."
                )
            continue

        names = require_kind(f"feature {name!r}", parts, Iterable, remedy)
        names = require_order(f"the parts of feature {name!r}", names)
        parts_of = {part: values_of(part) for part in names}

        index = CompositeIndex({part: FEATURES[part].sign for part in parts_of}).fit(parts_of)
        values = index.transform(parts_of)
        pixels[name] = np.ascontiguousarray(values, np.float32)  # as kernels need it
        composites[name] = index
        del parts_of, values  # rasters, which the next feature would otherwise add to

    dem = terrain["dem"]
    maps = {
        name: xr.DataArray(values, dem.coords, dem.dims, attrs={"units": "1"})
        for name, values in pixels.items()
    }
    return xr.Dataset(maps), composites


def options_of(
    surface: Surface, grid: Grid, team: Team, sight: Sight
) -> dict[str, dict[str, float]]:
    """Return arguments of pixel features that depend on the team and on the assumed sight.

    Openness is computed for the sensor height of the first robot of T2 and the target height of the
    lead, so it depends on the order of robots whose sensors differ in height. Its range is the
    smallest of the team's largest lidar range, the diagonal of a cell, and half the terrain's
    shorter side. The canopy of openness and vegetation density is that of the assumed model of
    sight.
    """
    sides = np.multiply(surface.ground.shape, surface.pixel)
    diagonal = float(np.hypot(grid.cell_height, grid.cell_width))
    ranges = [robot.lidar_range for robot in team.robots]

    lidar = {
        "reach": min(max(ranges), diagonal, 0.5 * float(sides.min())),
        "eye": team.robots[0].sensor_height,
        "target": team.lead.target_height,
    }
    return {
        "openness": lidar | {"extinction": sight.extinction, "crown_base": sight.crown_base},
        "vegetation_density": {"crown_base": sight.crown_base},
    }


def cell_maps(
    pixels: xr.Dataset, drivable: xr.DataArray, grid: Grid
) -> tuple[np.ndarray, np.ndarray]:
    """Average the features of pixels, dims (y, x), over cells.

    Returns:
        Awareness (row, col, feature) in [0, 1], NaN where a cell has no data; and passability (row,
        col): enough pixels of a passable cell are `drivable`, and all its features are known.
    """
    z = np.stack([grid.cell_means(values) for values in pixels.values()], axis=-1)
    passable = grid.cell_means(drivable.astype(float)) >= 1.0 - MAX_MISSING
    return z, passable & np.isfinite(z).all(-1)


def of_moves(cells: np.ndarray, passable: np.ndarray) -> np.ndarray:
    """Copy maps of cells (..., row, col, feature) to all moves, (..., move, row, col, feature).

    Values are NaN where a move does not lead from one passable cell to another.
    """
    exists = existing_bounds(passable)[..., None]
    return np.where(exists, cells[..., None, :, :, :], np.nan)


def with_line_of_sight(
    z: np.ndarray, pixels: xr.Dataset, passable: np.ndarray, posts: Posts, n_posts: int
) -> np.ndarray:
    """Append line of sight to the awareness of bounds (robot, move, row, col, feature).

    The result has the ways with the first `n_posts` sets of posts instead of the moves. If
    traversability is one of the features of `pixels`, its values are replaced with means along
    the robots' tracks.
    """
    is_known = TRAVERSABLE in pixels
    of_pixels = pixels[TRAVERSABLE].values if is_known else posts.surface.passable
    seen, traversability = bound_maps(posts, passable, of_pixels, n_posts)
    z = for_sets(z, n_posts, axis=1)
    if is_known:
        of_cells = z[..., list(pixels).index(TRAVERSABLE)]
        of_cells[...] = np.where(np.isfinite(traversability), traversability, of_cells)
    return np.clip(np.concatenate([z, seen[..., None]], axis=-1), 0.0, 1.0)


def labelled(
    z: np.ndarray, passable: np.ndarray, grid: Grid, team: Team, features: Sequence[str]
) -> tuple[xr.DataArray, xr.DataArray]:
    """Label awareness (robot, way, row, col, feature) and passability (row, col) of a grid.

    Raises TrustboError if no cell is passable.
    """
    if not passable.any():
        raise TrustboError(
            "no cell is passable. With a terrain, use a grid of another shape or a team with a "
            "larger max_slope; with arrays, give passable cells."
        )

    cells = {
        **{axis: np.arange(n) for axis, n in zip(("row", "col"), grid.shape, strict=True)},
        "y": ("row", grid.y),
        "x": ("col", grid.x),
    }

    ways = way_names(z.shape[1] // len(MOVES))
    names = {"robot": list(team.names), "move": ways, "feature": list(features)}
    return (
        xr.DataArray(z, names | cells, _DIMS, "awareness"),
        xr.DataArray(passable, cells, ("row", "col"), "passable"),
    )


def labelled_onward(onward: np.ndarray, awareness: xr.DataArray) -> xr.DataArray:
    """Label the change of line of sight (robot, way, row, col, next way); see `labelled`."""
    like = awareness.isel(feature=0, drop=True).expand_dims(
        next_move=awareness["move"].values, axis=-1
    )
    return like.copy(data=onward).rename("onward")


def unlabelled(
    awareness: ArrayLike | xr.DataArray, names: Sequence[str], features: Sequence[str]
) -> tuple[np.ndarray, tuple[str, ...], tuple[str, ...]]:
    """Return awareness in the axis order of `of_arrays`, and the names of robots and features.

    Names that are not given are taken from the labels; see `read_labelled`.
    """
    sizes = awareness.sizes if isinstance(awareness, xr.DataArray) else {}
    dims = [dim for dim in _DIMS if dim != "move" or dim in sizes]
    ways = way_names(sizes.get("move", len(MOVES)) // len(MOVES))
    coords = {"robot": names, "feature": features, "move": ways}

    read = read_labelled("awareness", awareness, dims, coords)
    chosen = {dim: read.coords.get(dim, tuple(given)) for dim, given in coords.items()}
    return read.values, chosen["robot"], chosen["feature"]


def _truth_of(what: str, values: ArrayLike) -> np.ndarray:
    """Read a map (row, col) of truth values; raises TrustboError unless all are 0 or 1."""
    flags = read_labelled(what, values, ("row", "col")).values
    if not np.isin(flags, (0.0, 1.0)).all():
        other = flags[~np.isin(flags, (0.0, 1.0))][0]
        raise TrustboError(f"{what} must be True or False in each cell; got {other:g}.")
    return flags.astype(bool)


def of_arrays(z: np.ndarray, passable: ArrayLike | None) -> tuple[np.ndarray, np.ndarray]:
    """Check the arrays of `Workspace.from_awareness`, and return awareness and passability.

    The awareness of bounds (robot, move, row, col, feature) is NaN where there is no bound. The
    passability has the shape (row, col).

    Raises TrustboError if the axes do not match, a value is outside [0, 1], or the awareness of a
    passable cell or of a bound between passable cells is NaN.
    """
    n_ways = {len(MOVES) * n for n in range(1, 1 + len(POST_SETS))}
    if z.ndim not in (4, 5) or (z.ndim == 5 and z.shape[1] not in n_ways):
        raise TrustboError(f"awareness must have the shape {_AXES}; got shape {z.shape}.")

    if not z.size:
        raise TrustboError(
            f"awareness has an axis of length 0: its shape is {z.shape}. If you have no features, "
            "give one feature that is 0 everywhere."
        )

    z = without_rounding(z)
    if (bad := (z < 0.0) | (z > 1.0)).any():
        index = tuple(int(i) for i in np.argwhere(bad)[0])
        raise TrustboError(f"awareness{list(index)} = {z[index]:g} is outside [0, 1]; rescale it.")

    finite = np.isfinite(z).all((0, -1))  # ([move], row, col)
    reached = finite if z.ndim == 4 else finite.any(0)
    free = reached if passable is None else _truth_of("passable", passable)

    if free.shape != z.shape[-3:-1]:
        shape = z.shape[-3:-1]
        raise TrustboError(f"the shape of passable must be (row, col) = {shape}; got {free.shape}.")

    if (free & ~reached).any():
        cell = tuple(int(i) for i in np.argwhere(free & ~reached)[0])
        raise TrustboError(
            f"awareness of the passable cell {cell} is NaN; give a value or mark it impassable."
        )

    if z.ndim == 4:
        return of_moves(z, free), free

    exists = for_sets(existing_bounds(free), z.shape[1] // len(MOVES))
    if (missing := exists & ~finite).any():
        m, row, col = (int(i) for i in np.argwhere(missing)[0])
        down, right = MOVES[m % len(MOVES)]
        raise TrustboError(
            f"awareness of the bound {(row - down, col - right)} -> {(row, col)} is NaN; give a "
            "value or mark one of the cells impassable."
        )

    return np.where(exists[..., None], z, np.nan), free
