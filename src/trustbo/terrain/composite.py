"""Composite index in [0, 1]: the first principal component of several features."""

from collections.abc import Mapping
from typing import Self

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike
from sklearn.decomposition import PCA

from trustbo.errors import TrustboError
from trustbo.terrain.heights import warn

MAX_PIXELS = 1_000_000
"""Maximum number of samples for the fit of an index, spread evenly over the given ones."""
_COLUMNS, _NUMBERS = ("low", "high", "mean", "sd"), ("bottom", "top")


class CompositeIndex:
    """First principal component of winsorised, standardised features, oriented and scaled.

    Each feature is winsorised at its 1st and 99th percentile and standardised; the first component
    is oriented so that the loadings agree with the declared signs (sum of loading x sign > 0); the
    2nd and 98th percentile of its score become 0 and 1.

    Attributes:
        signs: Signs by feature: +1 if it raises the index, -1 if it lowers it.
        loadings_: DataArray (feature), the oriented unit vector; 0 for a constant feature.
        explained_variance_ratio_: DataArray (component), shares of the variance, largest first.
    """

    loadings_: xr.DataArray
    explained_variance_ratio_: xr.DataArray

    def __init__(self, signs: Mapping[str, int]) -> None:
        """Set the features and their signs."""
        self.signs = dict(signs)

    def fit(self, features: Mapping[str, ArrayLike] | xr.Dataset) -> Self:
        """Fit the limits, the loadings and the scale.

        Args:
            features: Values by feature, arrays of one shape; samples with a NaN are left out.

        Raises:
            TrustboError: A declared feature is missing, or no sample has all of them.
        """
        x = np.stack([column.ravel() for column in self._columns(features)], axis=1)
        x = x[np.isfinite(x).all(1)]
        if not len(x):
            raise TrustboError(f"no pixel has all of the features {', '.join(self.signs)}.")
        x = x[:: -(-len(x) // MAX_PIXELS)]
        self._low, self._high = np.percentile(x, [1, 99], axis=0)
        x = np.clip(x, self._low, self._high)
        self._mean, sd = x.mean(0), x.std(0)
        # A (nearly) constant feature carries no information, and has no z-score.
        varies = sd > 1e-9 * np.maximum(1.0, np.abs(self._mean))
        self._sd = np.where(varies, sd, np.inf)
        z, signs = ((x - self._mean) / self._sd)[:, varies], np.array([*self.signs.values()])
        loadings, ratios = np.zeros(len(signs)), np.ones(1)
        if varies.any():
            pca = PCA(svd_solver="covariance_eigh").fit(z)
            first, ratios = np.asarray(pca.components_)[0], pca.explained_variance_ratio_
            loadings[varies] = (np.sign(first @ signs[varies]) or 1.0) * first
        self.loadings_ = xr.DataArray(
            loadings, {"feature": [*self.signs]}, dims="feature", name="loading"
        )
        self.explained_variance_ratio_ = xr.DataArray(
            ratios, {"component": np.arange(1, len(ratios) + 1)}, dims="component"
        )
        score = z @ loadings[varies]
        self._bottom, self._top = np.percentile(score, [2, 98])
        if self._top - self._bottom < 1e-9:  # nearly all samples are alike: take the extremes
            self._bottom, self._top = float(score.min()), float(score.max())
        self._warn()
        return self

    def transform(self, features: Mapping[str, ArrayLike] | xr.Dataset) -> np.ndarray:
        """Compute the index of every sample, in [0, 1] and of the features' shape.

        It is NaN where a feature is NaN, and 0.5 everywhere if all features were constant.

        Raises:
            TrustboError: A declared feature is missing; the index has not been fitted.
        """
        if not hasattr(self, "loadings_"):
            raise TrustboError("this CompositeIndex is not fitted; call fit first.")
        weights = self.loadings_.values / self._sd
        numbers = zip(weights, self._low, self._high, self._mean, strict=True)
        score = sum(
            weight * (np.clip(column, low, high) - mean)
            for column, (weight, low, high, mean) in zip(
                self._columns(features), numbers, strict=True
            )
        )
        if self._top - self._bottom < 1e-9:
            return np.where(np.isfinite(score), 0.5, np.nan)
        return np.clip((score - self._bottom) / (self._top - self._bottom), 0.0, 1.0)

    def to_dataset(self) -> xr.Dataset:
        """Convert a fitted index to arrays (feature) and attributes, for files."""
        columns = {name: ("feature", getattr(self, f"_{name}")) for name in _COLUMNS}
        signs = {"sign": ("feature", [*self.signs.values()]), "loading": self.loadings_}
        ratios = {"explained_variance_ratio": self.explained_variance_ratio_}
        attrs = {name: float(getattr(self, f"_{name}")) for name in _NUMBERS}
        return xr.Dataset(columns | signs | ratios, attrs=attrs)

    @classmethod
    def from_dataset(cls, data: xr.Dataset) -> Self:
        """Make an index from the dataset of `to_dataset`."""
        names, signs = data["feature"].values.astype(str), data["sign"].values.astype(int)
        index = cls(dict(zip(names.tolist(), signs.tolist(), strict=True)))
        index.loadings_ = data["loading"].load()
        index.explained_variance_ratio_ = data["explained_variance_ratio"].load()
        for name in _COLUMNS:
            setattr(index, f"_{name}", data[name].values)
        for name in _NUMBERS:
            setattr(index, f"_{name}", float(data.attrs[name]))
        return index

    def _columns(self, features: Mapping[str, ArrayLike] | xr.Dataset) -> list[np.ndarray]:
        missing = [name for name in self.signs if name not in features]
        if missing:
            raise TrustboError(f"the composite needs {', '.join(missing)}; got {list(features)}.")
        return [np.asarray(features[name], float) for name in self.signs]

    def _warn(self) -> None:
        loadings = zip(self.signs.items(), self.loadings_.values, strict=True)
        for name in [name for (name, sign), loading in loadings if loading * sign < 0]:
            warn(
                f"the loading of {name!r} has the opposite sign to the one declared: here it "
                "correlates with what it should oppose. Look at plots.loadings, or leave it out."
            )
        if (ratio := float(self.explained_variance_ratio_[0])) < 0.5:
            warn(
                f"the first component of {', '.join(self.signs)} explains only {ratio:.0%} of "
                "their variance; look at plots.loadings, and leave one out, or give two indices."
            )
