"""The default model of `fit`, campaigns, commands and studies."""

from trustbo.models.effects.place import PlaceEffect
from trustbo.models.effects.robot import RobotEffect
from trustbo.models.pooled import PooledTrust


def default_model(*, places: bool = True) -> PooledTrust:
    """Make the default model: `PooledTrust` with effects of places and robots.

    Args:
        places: Whether to include effects of places, which belong to cells and bounds of a map; use
            False for missions without a map.
    """
    return PooledTrust(effects=(PlaceEffect(),) * places + (RobotEffect(),))
