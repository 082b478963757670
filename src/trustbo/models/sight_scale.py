"""Scale of what varies between bounds, by the predicted line of sight.

Let m be the mean over robots of the predicted line of sight in a bound. Contact rates vary most
where m is near 0.5, and least where it is 0 or 1. The scale of effects and of noise is therefore
sqrt(f^2 + (1 - f^2) 4 m (1 - m)), where the floor f is the scale at m = 0 and m = 1. With f = 1,
the scale is 1 everywhere.

All robots have the same scale in a bound, so that their effects sum to 0 and all blocks of a
mission have equal matrices.
"""

from typing import Any

import numpy as np

from trustbo.statespace.matrices import namespace


def variation(sight: np.ndarray) -> np.ndarray:
    """Return 4 m (1 - m) of line of sight m, which is limited to [0, 1]."""
    m = np.clip(sight, 0.0, 1.0)
    return 4.0 * m * (1.0 - m)


def scale_at(variation: np.ndarray, floor: Any) -> Any:
    """Compute the scale from 4 m (1 - m) and the floor, in NumPy or JAX; the shapes broadcast."""
    return namespace(floor).sqrt(variation + floor**2 * (1.0 - variation))
