"""From a DEM and a DSM to awareness per planning cell."""

from trustbo.terrain.composite import CompositeIndex
from trustbo.terrain.features import (
    PixelFeature,
    canopy_cover,
    canopy_height,
    openness,
    pixel_features,
    roughness,
    slope,
    step_height,
    tri,
)
from trustbo.terrain.grid import Grid
from trustbo.terrain.raster import assemble_terrain, pixel_size, read_terrain
from trustbo.terrain.synthetic import synthetic_terrain
from trustbo.terrain.workspace import Workspace

__all__ = [
    "CompositeIndex",
    "Grid",
    "PixelFeature",
    "Workspace",
    "assemble_terrain",
    "canopy_cover",
    "canopy_height",
    "openness",
    "pixel_features",
    "pixel_size",
    "read_terrain",
    "roughness",
    "slope",
    "step_height",
    "synthetic_terrain",
    "tri",
]
