"""From a DEM and a DSM to awareness per planning cell."""

from trustbo.terrain.composite import CompositeIndex
from trustbo.terrain.features import (
    TRAVERSABILITY,
    VISIBILITY,
    aspect,
    canopy_cover,
    canopy_height,
    curvature,
    exposure,
    openness,
    pixel_features,
    roughness,
    slope,
    step_height,
    tpi,
    tri,
    vegetation_density,
)
from trustbo.terrain.grid import Grid
from trustbo.terrain.lidar import read_lidar
from trustbo.terrain.raster import assemble_terrain, pixel_size, read_terrain
from trustbo.terrain.registry import FEATURES, PixelFeature, register_feature
from trustbo.terrain.synthetic import synthetic_terrain
from trustbo.terrain.workspace import Workspace

__all__ = [
    "FEATURES",
    "TRAVERSABILITY",
    "VISIBILITY",
    "CompositeIndex",
    "Grid",
    "PixelFeature",
    "Workspace",
    "aspect",
    "assemble_terrain",
    "canopy_cover",
    "canopy_height",
    "curvature",
    "exposure",
    "openness",
    "pixel_features",
    "pixel_size",
    "read_lidar",
    "read_terrain",
    "register_feature",
    "roughness",
    "slope",
    "step_height",
    "synthetic_terrain",
    "tpi",
    "tri",
    "vegetation_density",
]
