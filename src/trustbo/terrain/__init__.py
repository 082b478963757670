"""Rasters of terrain and features of their pixels."""

from trustbo.terrain.composite import CompositeIndex
from trustbo.terrain.dataset import read_terrain
from trustbo.terrain.example import example
from trustbo.terrain.features import PAPER_VISIBILITY, TRAVERSABILITY, VISIBILITY, pixel_features
from trustbo.terrain.lidar import read_lidar
from trustbo.terrain.pixel_feature import FEATURES, PixelFeature, register_feature
from trustbo.terrain.synthetic import synthetic_terrain

__all__ = [
    "FEATURES", "PAPER_VISIBILITY", "TRAVERSABILITY", "VISIBILITY", "CompositeIndex",
    "PixelFeature", "example", "pixel_features", "read_lidar", "read_terrain", "register_feature",
    "synthetic_terrain",
]  # fmt: skip
__dir__ = __all__.copy  # completion lists public names alone
