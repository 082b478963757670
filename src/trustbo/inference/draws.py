"""Parameters from the draws of a posterior."""

import numpy as np
import xarray as xr

from trustbo.inference.place_maps import place_maps_of
from trustbo.inference.posterior_tree import require_posterior
from trustbo.models.params import Params, params_from


def sites_of(posterior: xr.DataTree) -> dict[str, np.ndarray]:
    """All draws of a posterior by name, chains joined: leading axis (draw,)."""
    draws = posterior["posterior"].to_dataset()
    n = draws.sizes["chain"] * draws.sizes["draw"]
    # In one layout, whether just sampled or read from a file: sums over draws then round alike, and
    # a resumed campaign has the same bits.
    arrays = {
        str(name): array.transpose("chain", "draw", ...).values for name, array in draws.items()
    }
    return {name: np.ascontiguousarray(a).reshape(n, *a.shape[2:]) for name, a in arrays.items()}


def params_of(posterior: xr.DataTree) -> Params:
    """All draws of a posterior as parameters, chains joined: leading axis (draw,).

    Args:
        posterior: DataTree from `fit`.

    Returns:
        `TrustParams`, `RobotParams`, `CoupledParams` or `DriftParams`, according to the model.

    Raises:
        TrustboError: No posterior of `fit`; or one with the drift of a `DriftTrust` that this
            process has not made.
    """
    sites = sites_of(require_posterior("params_of", posterior))
    params = params_from(sites, posterior.attrs)
    if "places" not in posterior.children:
        return params
    return params._replace(**place_maps_of(posterior["places"].to_dataset(), sites))  # pyright: ignore
