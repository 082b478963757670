"""Interactive page of a campaign: layers of the map, missions on a slider, numbers of places."""

from trustbo.plots.explorer.page import Explorer, draw_explorer
from trustbo.plots.explorer.scene import Layer, Overwatch, Scene, Step

__all__ = ["Explorer", "Layer", "Overwatch", "Scene", "Step", "draw_explorer"]
