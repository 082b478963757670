"""The default model of fits, campaigns, commands and studies."""

from trustbo.models.effects.place import PlaceEffect
from trustbo.models.effects.robot import RobotEffect
from trustbo.models.pooled import PooledTrust


def default_model(observation: str = "gaussian", *, places: bool = True) -> PooledTrust:
    """Make the default model: `PooledTrust` with effects of places and of robots in missions.

    Args:
        observation: Family of observations, see `TrustModel`.
        places: False for effects of robots alone, as missions without a map need: effects of places
            are of cells and of the bounds between them.

    Raises:
        TrustboError: The family is unknown.
    """
    effects = (PlaceEffect(),) * places + (RobotEffect(),)
    return PooledTrust(observation=observation, effects=effects)
