"""One index in [0, 1] out of several pixel features, by their first principal component."""

import warnings
from collections.abc import Mapping
from typing import Self

import numpy as np
import xarray as xr
from sklearn.decomposition import PCA

from trustbo.errors import TerrainError, require_choice

SCALINGS = ("percentile", "minmax", "logistic")
MAX_PIXELS = 1_000_000


class CompositeIndex:
    """First principal component of winsorised, standardised features, oriented and scaled.

    Each feature is cut at its 1st and 99th percentile and turned into z-scores; the first component
    is oriented so that the loadings agree with the declared signs (sum of loading x sign > 0),
    never as the solver happens to return it; its score is mapped to [0, 1].

    Attributes:
        loadings_: DataArray (feature), the oriented unit vector; 0 for a constant feature.
        explained_variance_ratio_: Share of the variance the component explains.
    """

    def __init__(self, signs: Mapping[str, int], *, scaling: str = "percentile") -> None:
        """Declare the features.

        Args:
            signs: +1 for each feature that raises the index, -1 for one that lowers it.
            scaling: `"percentile"` maps the 2nd and 98th percentile of the score to 0 and 1,
                `"minmax"` its extremes, `"logistic"` passes the standardised score through the
                logistic function.

        Raises:
            TrustboError: An unknown scaling.
        """
        self.signs = dict(signs)
        self.scaling = require_choice("scaling", scaling, SCALINGS)

    def fit(self, features: xr.Dataset) -> Self:
        """Learn cuts, loadings and scale from pixels.

        Args:
            features: One variable per declared feature, any dims; pixels with a NaN are left out.

        Raises:
            TerrainError: A declared feature is missing, or no pixel has all of them.
        """
        x = self._matrix(features)
        x = x[np.isfinite(x).all(1)]
        if not len(x):
            raise TerrainError(f"no pixel has all of the features {', '.join(self.signs)}.")
        x = x[:: -(-len(x) // MAX_PIXELS)]
        self._low, self._high = np.percentile(x, [1, 99], axis=0)
        x = np.clip(x, self._low, self._high)
        self._mean, self._sd = x.mean(0), x.std(0)
        # A feature that (nearly) never changes carries no information, and has no z-score.
        self._varies = self._sd > 1e-9 * np.maximum(1.0, np.abs(self._mean))
        weights = np.zeros(len(self.signs))
        self.explained_variance_ratio_ = 1.0
        if self._varies.any():
            pca = PCA(n_components=1, svd_solver="covariance_eigh").fit(self._standardise(x))
            signs = np.array(list(self.signs.values()), dtype=float)[self._varies]
            component = np.asarray(pca.components_)[0]
            weights[self._varies] = component * (np.sign(component @ signs) or 1.0)
            self.explained_variance_ratio_ = float(np.asarray(pca.explained_variance_ratio_)[0])
        self.loadings_ = xr.DataArray(
            weights, {"feature": list(self.signs)}, dims="feature", name="loading"
        )
        score = self._score(x)
        percentiles = {"percentile": [2, 98], "minmax": [0, 100], "logistic": [0, 100]}
        self._bottom, self._top = np.percentile(score, percentiles[self.scaling])
        if self._top - self._bottom < 1e-9:  # nearly all pixels are alike: take the extremes
            self._bottom, self._top = float(score.min()), float(score.max())
        self._spread = float(score.std()) or 1.0
        self._warn()
        return self

    def transform(self, features: xr.Dataset) -> xr.DataArray:
        """The index of every pixel, in [0, 1]; NaN where a feature is.

        Features that are all constant say nothing: the index is then 0.5 everywhere.
        """
        x = self._matrix(features)
        score = self._score(np.clip(x, self._low, self._high))
        if self._top - self._bottom < 1e-9:
            index = np.where(np.isfinite(x).all(1), 0.5, np.nan)
        elif self.scaling == "logistic":
            index = 1.0 / (1.0 + np.exp(-score / self._spread))
        else:
            index = np.clip((score - self._bottom) / (self._top - self._bottom), 0.0, 1.0)
        like = features[next(iter(self.signs))]
        return like.copy(data=index.reshape(like.shape)).rename(None).assign_attrs(units="1")

    def _matrix(self, features: xr.Dataset) -> np.ndarray:
        missing = [name for name in self.signs if name not in features]
        if missing:
            raise TerrainError(f"the composite needs {', '.join(missing)}; got {list(features)}.")
        return np.stack([features[name].values.ravel() for name in self.signs], axis=1)

    def _standardise(self, x: np.ndarray) -> np.ndarray:
        return ((x - self._mean) / np.where(self._varies, self._sd, 1.0))[:, self._varies]

    def _score(self, x: np.ndarray) -> np.ndarray:
        score = self._standardise(x) @ self.loadings_.values[self._varies]
        return np.where(np.isfinite(x).all(1), score, np.nan)

    def _warn(self) -> None:
        signs = np.array(list(self.signs.values()))
        against = [
            name
            for name, w, s in zip(self.signs, self.loadings_.values, signs, strict=True)
            if w * s < 0
        ]
        if against:
            warnings.warn(
                f"{', '.join(against)} enters its composite against the declared sign: here it "
                "goes along with what it should oppose. Look at the loadings, or leave it out.",
                stacklevel=3,
            )
        if self.explained_variance_ratio_ < 0.5:
            warnings.warn(
                f"the first component of {', '.join(self.signs)} explains only "
                f"{self.explained_variance_ratio_:.0%} of their variance.",
                stacklevel=3,
            )
