"""Figures: each function takes data and returns Axes; nothing is computed here but the layout."""

from trustbo.plots.maps import cell_map, draw_hillshade, draw_path, draw_scale, trust_maps
from trustbo.plots.regret import regret_curves
from trustbo.plots.terrain import loadings, terrain_maps

__all__ = [
    "cell_map",
    "draw_hillshade",
    "draw_path",
    "draw_scale",
    "loadings",
    "regret_curves",
    "terrain_maps",
    "trust_maps",
]
