"""Log prior density of the draws of a posterior, for ArviZ's analysis of sensitivity."""

import json
from collections.abc import Mapping

import numpy as np
import xarray as xr

from trustbo.errors import TrustboError
from trustbo.models.model import TrustModel
from trustbo.models.record import model_from_record


def log_prior(model: TrustModel, sites: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Log prior density of each parameter with an independent prior, up to a constant.

    Deviations of robots from a common mean belong to the model, not to the prior: of a
    `HierarchicalTrust` only means and spreads are here. The LKJ prior of correlations R of the
    coupled model has density det(R)^(concentration - 1).

    Args:
        model: Trust model.
        sites: Parameters of the posterior, (chain, draw, ...).

    Returns:
        Log density (chain, draw) by label.
    """
    terms = model.prior_terms(sites)
    (beta0,) = (values for field, values in terms.values() if field == "beta0")
    beta0 = beta0 if model.memory == "level" else np.zeros_like(beta0)  # of stationary trust
    densities = {
        label: model.priors.log_density(field, values, beta0)
        for label, (field, values) in terms.items()
    }
    for noise in ("Delta_w", "Delta_v"):
        if noise in sites:
            sd = np.sqrt(np.einsum("...ii->...i", sites[noise]))
            correlation = sites[noise] / (sd[..., :, None] * sd[..., None, :])
            log_det = np.linalg.slogdet(correlation)[1]
            densities[f"correlation_{noise[-1]}"] = (model.priors.concentration - 1.0) * log_det
    for effect in model.all_effects:
        densities |= effect.log_prior(sites)
    densities |= model.own_log_prior(sites)
    return {
        label: density.reshape(*density.shape[:2], -1).sum(-1)
        for label, density in densities.items()
    }


def model_of(posterior: xr.DataTree, model: TrustModel | None = None) -> TrustModel | None:
    """Model of a posterior, with its family and priors; None if not on record, nor given.

    Priors are not on record if they are custom ones, or the posterior is of an older version.
    """
    data = "constant_data" if "constant_data" in posterior.children else "posterior"
    data = posterior[data].to_dataset()
    features = [str(n) for n in data["feature"].values] if "feature" in data.coords else []
    if model is None:
        try:
            record = json.loads(posterior.attrs["model_record"])
            model = model_from_record(record, features=features)
        except (KeyError, TrustboError):
            return None
    return model.for_features(features)


def log_prior_group(posterior: xr.DataTree, model: TrustModel | None = None) -> xr.Dataset | None:
    """Group `log_prior` of a posterior; None where `model_of` is."""
    if (recorded := model_of(posterior, model)) is None:
        return None
    draws = posterior["posterior"].to_dataset()
    sites = {str(n): a.transpose("chain", "draw", ...).values for n, a in draws.items()}
    densities = log_prior(recorded, sites)
    index = {"chain": draws["chain"], "draw": draws["draw"]}
    return xr.Dataset({n: (("chain", "draw"), d) for n, d in densities.items()}, index)
