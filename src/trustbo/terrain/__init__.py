"""Terrain rasters and features of their pixels."""

from trustbo.terrain.composite import CompositeIndex
from trustbo.terrain.examples import example, synthetic_terrain
from trustbo.terrain.features import (
    FEATURES,
    PAPER_VISIBILITY,
    TRAVERSABILITY,
    VISIBILITY,
    feature,
    gradient,
)
from trustbo.terrain.lidar import read_lidar
from trustbo.terrain.pixels import pixel_size
from trustbo.terrain.read import read_terrain

__all__ = [
    "FEATURES", "PAPER_VISIBILITY", "TRAVERSABILITY", "VISIBILITY", "CompositeIndex", "example",
    "feature", "gradient", "pixel_size", "read_lidar", "read_terrain", "synthetic_terrain",
]  # fmt: skip
__dir__ = __all__.copy  # tab completion lists only public names
