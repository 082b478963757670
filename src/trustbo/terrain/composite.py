"""Composite index in [0, 1]: the first principal component of several features."""

from collections.abc import Mapping
from functools import reduce
from typing import Self

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from trustbo.errors import TrustboError, require_kind, warn

MAX_PIXELS = 1_000_000
"""Maximum number of samples used to fit an index, spread evenly over the given ones."""
_WINSORISED = (1, 99)  # percentiles to which features are limited
_SCALED = (2, 98)  # percentiles of the score that become 0 and 1
_MISLEADING = 0.5  # share of the variance below which the first component gets a warning
_CONSTANT = 1e-9  # spread below which a feature, or the score, counts as constant


class CompositeIndex:
    """First principal component of winsorised, standardised features, oriented and scaled.

    Each feature is winsorised at its 1st and 99th percentiles and standardised. The first component
    is oriented to agree with the declared signs (sum of loading x sign > 0). The 2nd and 98th
    percentiles of its score become 0 and 1.

    Attributes:
        signs: Sign of each feature: +1 if it raises the index, -1 if it lowers it.
        fitted: Dataset of the fit: sign, limits, mean, standard deviation and loading of each
            feature; share of the variance of each component; attributes `bottom` and `top`, the
            scores that become 0 and 1.

    Example:
        >>> slope = np.linspace(0.0, 0.5, 100)
        >>> features = {"slope": slope, "roughness": slope**2}
        >>> index = tb.terrain.CompositeIndex({"slope": -1, "roughness": -1}).fit(features)
        >>> index.transform(features)[[0, -1]]
        array([1., 0.])
    """

    def __init__(self, signs: Mapping[str, int], fitted: xr.Dataset | None = None) -> None:
        """Set the features with their signs and, optionally, the `fitted` of an earlier fit."""
        remedy = "give the sign of each feature, such as {'slope': -1}"
        if not require_kind("signs", signs, Mapping, remedy):
            raise TrustboError(f"a composite index needs at least one feature; {remedy}.")
        self.signs = dict(signs)
        self.fitted = xr.Dataset() if fitted is None else fitted

    def fit(self, features: Mapping[str, ArrayLike] | xr.Dataset) -> Self:
        """Fit the limits, the loadings and the scale.

        Args:
            features: Values of each feature, arrays of one shape; samples with a NaN are left out.
                The dims of DataArrays are put in the order of the first feature's.

        Raises:
            TrustboError: A declared feature is missing, or no sample has all features.
        """
        columns = self._columns(features)
        known = np.flatnonzero(reduce(np.logical_and, map(np.isfinite, columns)))
        if not len(known):
            raise TrustboError(f"no pixel has all of the features {', '.join(self.signs)}.")

        known = known[:: -(-len(known) // MAX_PIXELS)].copy()  # not a view of all samples
        x = np.empty((len(known), len(columns)))
        for k, column in enumerate(columns):
            x[:, k] = column.ravel()[known]
        del known
        limits = [np.percentile(column, _WINSORISED) for column in x.T]
        low, high = np.transpose(limits).copy()
        np.clip(x, low, high, out=x)

        mean = x.mean(0)
        sd = x.std(0)
        # A (nearly) constant feature carries no information, and has no z-score.
        varies = sd > _CONSTANT * np.maximum(1.0, np.abs(mean))
        sd = np.where(varies, sd, np.inf)

        x -= mean
        x /= sd
        x = x[:, varies]
        signs = np.array([*self.signs.values()])
        loadings = np.zeros(len(signs))
        ratios = np.ones(1)
        if varies.any():
            first, ratios = _first_component(x)
            loadings[varies] = (np.sign(first @ signs[varies]) or 1.0) * first

        score = x @ loadings[varies]
        bottom, top = np.percentile(score, _SCALED)
        if top - bottom < _CONSTANT:  # nearly all samples are alike: take the extremes
            bottom = score.min()
            top = score.max()

        columns = {
            "sign": signs, "loading": loadings, "low": low, "high": high, "mean": mean, "sd": sd
        }  # fmt: skip
        self.fitted = xr.Dataset(
            {name: ("feature", column) for name, column in columns.items()}
            | {"explained_variance_ratio": ("component", ratios)},
            {"feature": [*self.signs], "component": np.arange(1, len(ratios) + 1)},
            {"bottom": float(bottom), "top": float(top)},
        )

        agrees = self.loadings_ * signs
        for name in agrees["feature"].values[agrees < 0].tolist():
            warn(
                f"the loading of {name!r} has the opposite sign to the one declared; check "
                "loadings_, and leave the feature out if it misleads."
            )

        if ratios[0] < _MISLEADING:
            warn(
                f"the first component of {', '.join(self.signs)} explains only {ratios[0]:.0%} of "
                "their variance; check loadings_, and leave a feature out or use two composites."
            )

        return self

    @property
    def loadings_(self) -> xr.DataArray:
        """Loadings (feature): unit vector with the declared orientation; 0 where constant."""
        return self.fitted["loading"]

    @property
    def explained_variance_ratio_(self) -> xr.DataArray:
        """Shares of the variance (component), largest first."""
        return self.fitted["explained_variance_ratio"]

    def transform(self, features: Mapping[str, ArrayLike] | xr.Dataset) -> np.ndarray:
        """Compute the index of every sample, in [0, 1], with the shape of the features.

        The index is NaN where a feature is NaN, and 0.5 everywhere if all features were constant.

        Raises:
            TrustboError: A declared feature is missing.
        """
        fitted = self.fitted
        low, high, mean, sd = (fitted[name].values for name in ("low", "high", "mean", "sd"))

        weights = fitted["loading"].values / sd
        bottom = fitted.bottom
        top = fitted.top
        columns = self._columns(features)
        score = np.zeros(columns[0].shape)
        for k, column in enumerate(columns):
            x = np.clip(column, low[k], high[k])
            x -= mean[k]
            x *= weights[k]
            score += x

        if top - bottom < _CONSTANT:
            return np.where(np.isfinite(score), 0.5, np.nan)
        score -= bottom
        score /= top - bottom
        return np.clip(score, 0.0, 1.0, out=score)

    def _columns(self, features: Mapping[str, ArrayLike] | xr.Dataset) -> list[np.ndarray]:
        remedy = "give the values of each feature by name"
        require_kind("features", features, Mapping | xr.Dataset, remedy)

        missing = [name for name in self.signs if name not in features]
        if missing:
            raise TrustboError(f"the composite needs {', '.join(missing)}; got {list(features)}.")

        columns = [features[name] for name in self.signs]
        if isinstance(columns[0], xr.DataArray):
            dims = columns[0].dims
            columns = [x.transpose(*dims) if isinstance(x, xr.DataArray) else x for x in columns]
        return [np.asarray(x, float) for x in columns]


def _first_component(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the first principal component (feature,) of samples z (sample, feature).

    The largest entry of the component is positive. Also returns the share of the variance of each
    component, largest first.
    """
    n = len(z)
    mean = z.mean(0)
    covariance = z.T @ z
    covariance -= n * mean[:, None] * mean  # without a centred copy of z
    covariance /= n - 1

    variances, components = np.linalg.eigh(covariance)
    variances = np.maximum(variances[::-1], 0.0)  # rounding can make the smallest ones negative
    first = components[:, -1]
    return first * np.sign(first[np.abs(first).argmax()]), variances / variances.sum()
