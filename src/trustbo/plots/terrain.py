"""Terrain, the indices of its pixels, and their composition."""

from collections.abc import Mapping
from typing import Unpack

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize

from trustbo.errors import TrustboError, require_kind
from trustbo.plots.layout import as_text, extent_of, grid_lines, map_panels, plain, small_multiples
from trustbo.plots.maps import draw_relief, draw_scale, outlined
from trustbo.plots.style import SMALL, Style, StyleOptions, theme
from trustbo.terrain import CompositeIndex
from trustbo.workspace import Workspace

AGREES, OPPOSES = "#0072b2", "#d55e00"
"""Blue and vermilion of Okabe and Ito (2008): safe for the colour-blind."""


def terrain_maps(workspace: Workspace, **style: Unpack[StyleOptions]) -> np.ndarray:
    """Draw the surface and the index of each feature, Fig. 4 of the paper.

    A feature of bounds, such as line of sight, is the mean over robots and over the bounds into a
    cell.

    Args:
        workspace: Workspace made from a terrain in memory.
        **style: Options of `Style`; `cmap` is that of the indices.

    Returns:
        Axes, shape (1 + feature,).

    Raises:
        TrustboError: The workspace has no terrain, or one that is read lazily.
    """
    require_kind("plots.terrain_maps", workspace, Workspace, "give a Workspace")
    options, terrain, pixels = Style.from_options(style), workspace.terrain, workspace.pixels
    if terrain is None or pixels is None:
        raise TrustboError(
            "terrain_maps needs a workspace made with Workspace.from_terrain of a terrain in "
            "memory; coarsen a lazily read one first."
        )
    grid, names = workspace.grid, workspace.features
    made = map_panels(grid, 1 + len(names), options)
    extent, colours = extent_of(grid), options.colours()
    dsm = terrain["dsm"].values
    surface, *indices = made.panels
    heights = Normalize(float(np.nanmin(dsm)), float(np.nanmax(dsm)))
    surface.imshow(dsm, cmap="cividis", norm=heights, extent=extent)
    of_cells = workspace.awareness.mean("robot")
    for ax, name in zip(indices, names, strict=True):
        index = pixels[name].values if name in pixels else of_cells.sel(feature=name).values
        if ax is indices[0] and name in pixels:
            index = np.where(pixels["passable"].values, index, np.nan)
        ax.set_facecolor(theme().closed)
        ax.imshow(index, cmap=colours, vmin=0, vmax=1, extent=extent, interpolation="nearest")
    for ax in made.panels:
        draw_relief(ax, workspace)
        grid_lines(ax, grid)
    draw_scale(surface, grid)
    made.titles(["surface (DSM)", *(name.replace("_", " ") for name in names)])
    made.label_maps()
    label = "index (0 worst, 1 best; grey: impassable)"
    made.colour_bar(ScalarMappable(Normalize(0, 1), colours), label)
    if options.legend:
        _draw_heights(surface, heights)
    made.fit_height()
    return made.panels


def _draw_heights(ax: Axes, heights: Normalize) -> None:
    """Draw the bar of heights at the top of the surface: inside, for panels to keep one size."""
    low, high = float(heights.vmin or 0.0), float(heights.vmax or 0.0)
    inset = ax.inset_axes((0.05, 0.91, 0.9, 0.04))
    image = ScalarMappable(heights, "cividis")
    bar = ax.figure.colorbar(image, cax=inset, orientation="horizontal")
    bar.set_ticks([])
    digits = 0 if high - low >= 5.0 else 1
    texts = (0.0, "left", f"{low:z.{digits}f}"), (1.0, "right", f"{high:z.{digits}f} m")
    for x, side, text in texts:
        drawn = inset.text(x, -0.4, text, ha=side, va="top", transform=inset.transAxes)
        drawn.set(fontsize=SMALL, path_effects=outlined(2.0), color="black")


def loadings(composites: Mapping[str, CompositeIndex], **style: Unpack[StyleOptions]) -> np.ndarray:
    """Draw the loadings of each composite, one bar per feature.

    Args:
        composites: Fitted composites by name, such as `Workspace.composites`.
        **style: Options of `Style`.

    Returns:
        Axes, shape (composite,).

    Raises:
        TrustboError: There are no composites.
    """
    require_kind(
        "plots.loadings", composites, Mapping, "give composites by name, `Workspace.composites`"
    )
    options = Style.from_options(style)
    if not composites:
        raise TrustboError("there are no composites: this workspace was not made from a terrain.")
    n, most = len(composites), max(len(index.signs) for index in composites.values())
    size = 3.6, 1.0 + 0.3 * most
    made = small_multiples(n, size, options, columns=n, least=2.2, sharex=True)
    titles = []
    for ax, (name, index) in zip(made.panels, composites.items(), strict=True):
        _bars(ax, index, legend=options.legend)
        titles.append(f"{name}:\n{index.explained_variance_ratio_[0]:.0%} of the variance")
    made.titles(titles)
    return made.panels


def _bars(ax: Axes, index: CompositeIndex, *, legend: bool) -> None:
    values, signs = index.loadings_.values, np.array(list(index.signs.values()))
    agrees = values * signs >= 0.0
    names = [as_text(name.replace("_", " ")) for name in index.signs]
    for which, colour, hatch in ((agrees, AGREES, ""), (~agrees, OPPOSES, "///")):
        label = "as declared" if colour == AGREES else "against its sign"
        rows = np.flatnonzero(which)
        ax.barh(rows, values[rows], color=colour, hatch=hatch, edgecolor=theme().paper, label=label)
    ax.invert_yaxis()
    ax.axvline(0.0, color=theme().ink, linewidth=0.8)
    ax.set_xlim(-1.0, 1.0)
    ax.set_xticks([-1.0, -0.5, 0.0, 0.5, 1.0])
    ax.set_xlabel("loading", fontsize=SMALL)
    plain(ax)
    ax.set_yticks(np.arange(len(names)), names, fontsize=SMALL)
    if legend and not agrees.all():
        ax.legend(fontsize=SMALL, frameon=False)
