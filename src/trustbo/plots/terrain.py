"""Terrain, the indices of its pixels, and their composition."""

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, Normalize

from trustbo.errors import TrustboError
from trustbo.plots.layout import (
    as_text,
    colour_bar,
    extent_of,
    grid_lines,
    label_maps,
    map_panels,
    plain,
    small_multiples,
)
from trustbo.plots.maps import CLOSED, COLOURS, draw_hillshade, draw_scale
from trustbo.terrain import CompositeIndex
from trustbo.workspace import Workspace

AGREES, OPPOSES = "#0072b2", "#d55e00"
"""Blue and vermilion of Okabe and Ito (2008): safe for the colour-blind."""


def terrain_maps(workspace: Workspace, *, n_columns: int | None = None) -> np.ndarray:
    """Draw the surface and the index of each feature, Fig. 4 of the paper.

    Args:
        workspace: Workspace made from a terrain in memory.
        n_columns: Panels per row; by default all in one.

    Returns:
        Axes, shape (1 + feature,).

    Raises:
        TrustboError: The workspace has no terrain, or one that is read lazily.
    """
    terrain, pixels = workspace.terrain, workspace.pixels
    if terrain is None or pixels is None:
        raise TrustboError(
            "terrain_maps needs a workspace made with Workspace.from_terrain of a terrain in "
            "memory; coarsen a lazily read one first."
        )
    grid, names = workspace.grid, workspace.features
    n_panels = 1 + len(names)
    figure, axes, panels = map_panels(
        grid, n_panels, n_panels if n_columns is None else n_columns, width=3.3
    )
    extent = extent_of(grid)
    dsm = terrain["dsm"].values
    surface, *indices = panels
    heights = Normalize(float(np.nanmin(dsm)), float(np.nanmax(dsm)))
    surface.imshow(dsm, cmap="cividis", norm=heights, extent=extent)
    surface.set_title("surface (DSM)", fontsize=9)
    colour_bar(figure, ScalarMappable(heights, "cividis"), surface, "height (m)")
    for ax, name in zip(indices, names, strict=True):
        of_cells = workspace.awareness.sel(feature=name).mean("robot")
        values = pixels[name] if name in pixels else of_cells  # line of sight is that of bounds
        ax.imshow(values.values, cmap=COLOURS, vmin=0, vmax=1, extent=extent)
        ax.set_title(as_text(name), fontsize=9)
    steep = np.isfinite(dsm) & ~pixels["passable"].values
    closed = np.where(steep, 1.0, np.nan)
    indices[0].imshow(closed, cmap=ListedColormap([CLOSED]), extent=extent, interpolation="nearest")
    for ax in panels:
        ax.set_facecolor("white")
        draw_hillshade(ax, workspace, "dsm" if ax is surface else "dem")
        grid_lines(ax, grid)
    draw_scale(surface, grid)
    label = "index (0 worst, 1 best; grey: too steep)"
    colour_bar(figure, ScalarMappable(Normalize(0, 1), COLOURS), indices, label)
    label_maps(axes)
    return panels


def loadings(composites: Mapping[str, CompositeIndex]) -> np.ndarray:
    """Draw the loadings of each composite, one bar per feature.

    Args:
        composites: Fitted composites by name, such as `Workspace.composites`.

    Returns:
        Axes, shape (composite,).

    Raises:
        TrustboError: There are no composites.
    """
    if not composites:
        raise TrustboError("there are no composites: this workspace was not made from a terrain.")
    most = max(len(index.signs) for index in composites.values())
    size = 3.4, 0.9 + 0.3 * most
    _, _, panels = small_multiples(len(composites), len(composites), size, sharex=True)
    for ax, (name, index) in zip(panels, composites.items(), strict=True):
        _bars(ax, index)
        share = float(index.explained_variance_ratio_[0])
        ax.set_title(f"{as_text(name)}: {share:.0%} of the variance", fontsize=9)
    return panels


def _bars(ax: Axes, index: CompositeIndex) -> None:
    values, signs = index.loadings_.values, np.array(list(index.signs.values()))
    agrees = values * signs >= 0.0
    names = [as_text(name.replace("_", " ")) for name in index.signs]
    for which, colour, hatch in ((agrees, AGREES, ""), (~agrees, OPPOSES, "///")):
        label = "as declared" if colour == AGREES else "against its sign"
        rows = np.flatnonzero(which)
        ax.barh(rows, values[rows], color=colour, hatch=hatch, edgecolor="white", label=label)
    ax.invert_yaxis()
    ax.axvline(0.0, color="black", linewidth=0.8)
    ax.set_xlim(-1.0, 1.0)
    ax.set_xticks([-1.0, -0.5, 0.0, 0.5, 1.0])
    ax.set_xlabel("loading", fontsize=8)
    plain(ax)
    ax.set_yticks(np.arange(len(names)), names, fontsize=8)
    if not agrees.all():
        ax.legend(fontsize=7, frameon=False)
