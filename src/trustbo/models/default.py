"""The default model of `fit`, campaigns, commands and studies."""

from trustbo.models.effects.place import PlaceEffect
from trustbo.models.effects.robot import RobotEffect
from trustbo.models.pooled import PooledTrust


def default_model(observation: str = "gaussian", *, places: bool = True) -> PooledTrust:
    """Make the default model: `PooledTrust` with effects of places and robots.

    Args:
        observation: Observation family, see `TrustModel`.
        places: Whether to include effects of places, which belong to cells and bounds of a map; use
            False for missions without a map.

    Raises:
        TrustboError: If the family is unknown.
    """
    effects = (PlaceEffect(),) * places + (RobotEffect(),)
    return PooledTrust(observation=observation, effects=effects)
