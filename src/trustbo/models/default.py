"""The default model of `fit`, campaigns, studies and the command line."""

from trustbo.models.effects.place import PlaceEffect
from trustbo.models.effects.robot import RobotEffect
from trustbo.models.pooled import PooledTrust


def default_model(*, places: bool = True) -> PooledTrust:
    """Make the default model, which is `PooledTrust` with place and robot effects.

    Args:
        places: Whether to include place effects, which need missions with a map.
    """
    if not places:
        return PooledTrust(effects=(RobotEffect(),))
    return PooledTrust(effects=(PlaceEffect(), RobotEffect()))
