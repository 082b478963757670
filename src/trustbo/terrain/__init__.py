"""Rasters of terrain and features of their pixels."""

from trustbo.terrain.composite import CompositeIndex
from trustbo.terrain.dataset import assemble_terrain, pixel_size, read_terrain
from trustbo.terrain.example import example
from trustbo.terrain.features import (
    PAPER_VISIBILITY,
    TRAVERSABILITY,
    VISIBILITY,
    aspect,
    canopy_cover,
    canopy_height,
    exposure,
    openness,
    pixel_features,
    slope,
    vegetation_density,
)
from trustbo.terrain.lidar import read_lidar
from trustbo.terrain.pixel_feature import FEATURES, PixelFeature, register_feature
from trustbo.terrain.synthetic import synthetic_terrain

__all__ = [
    "FEATURES", "PAPER_VISIBILITY", "TRAVERSABILITY", "VISIBILITY", "CompositeIndex",
    "PixelFeature", "aspect", "assemble_terrain", "canopy_cover", "canopy_height", "example",
    "exposure", "openness", "pixel_features", "pixel_size", "read_lidar", "read_terrain",
    "register_feature", "slope", "synthetic_terrain", "vegetation_density",
]  # fmt: skip
__dir__ = __all__.copy  # completion lists public names alone
