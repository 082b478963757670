"""Figures. All functions except `explore` accept `ax` and return the axes."""

from trustbo.plots.curves import robot_effects, trust_curves
from trustbo.plots.explore import explore
from trustbo.plots.grid import grid_map
from trustbo.plots.maps import cell_map, terrain_maps, trust_maps
from trustbo.plots.plan import plan_map

__all__ = [
    "cell_map",
    "explore",
    "grid_map",
    "plan_map",
    "robot_effects",
    "terrain_maps",
    "trust_curves",
    "trust_maps",
]
__dir__ = __all__.copy  # tab completion lists only public names
