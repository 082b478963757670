"""The default model of `fit`, campaigns, studies and the command line."""

from trustbo.errors import require_switch
from trustbo.models.effects.place import PlaceEffect
from trustbo.models.effects.robot import RobotEffect
from trustbo.models.pooled import PooledTrust
from trustbo.models.priors import Priors


def default_model(*, places: bool = True, priors: Priors | None = None) -> PooledTrust:
    """Make the default model, which is `PooledTrust` with place and robot effects.

    Args:
        places: Whether to include place effects, which need missions with a map.
        priors: Priors on the parameters; by default those for the features (see
            `Priors.from_features`). Note that `PooledTrust(priors=...)` has no effects.

    Example:
        >>> priors = tb.models.Priors.from_features(workspace.features)
        >>> priors = dataclasses.replace(priors, delta_v=dist.HalfNormal(0.05))
        >>> campaign = tb.Campaign(
        ...     workspace, (9, 0), (0, 9), model=tb.models.default_model(priors=priors)
        ... )
    """
    require_switch("places", places)
    effects = (PlaceEffect(), RobotEffect()) if places else (RobotEffect(),)
    return PooledTrust(effects=effects) if priors is None else PooledTrust(priors, effects=effects)
