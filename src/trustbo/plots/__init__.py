"""Figures. Each function takes data and returns Axes; only the layout is computed here."""

from trustbo.plots.campaign import campaign_history, parameter_history
from trustbo.plots.criticism import criticism
from trustbo.plots.grid import grid_map
from trustbo.plots.maps import (
    cell_map,
    draw_path,
    draw_scale,
    hazard_map,
    path_posterior,
    robot_maps,
    trust_maps,
)
from trustbo.plots.mission import mission_trust, plan_trust
from trustbo.plots.places import place_map
from trustbo.plots.plan import plan_map
from trustbo.plots.regret import regret_curves
from trustbo.plots.terrain import loadings, terrain_maps

__all__ = [
    "campaign_history", "cell_map", "criticism",
    "draw_path", "draw_scale", "grid_map", "hazard_map", "loadings", "mission_trust",
    "parameter_history", "path_posterior", "place_map", "plan_map", "plan_trust", "regret_curves",
    "robot_maps", "terrain_maps", "trust_maps",
]  # fmt: skip
__dir__ = __all__.copy  # completion lists public names alone
