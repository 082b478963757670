"""Index in [0, 1] of several features, by their first principal component."""

import warnings
from collections.abc import Mapping, Sequence
from typing import Self

import numpy as np
import xarray as xr
from numba import njit
from sklearn.base import BaseEstimator, TransformerMixin
from sklearn.decomposition import PCA

from trustbo.errors import TerrainError, TrustboError, require_choice, require_whole
from trustbo.files import FilePath, interpreting, read_file, write_file

MAX_PIXELS = 1_000_000
MIN_CALIBRATION = 200
"""Least number of samples to fit a real-time index on: with fewer, its loadings are unstable."""

REALTIME: Mapping[str, Mapping[str, int]] = {
    "traversability": {"offline": +1, "speed_ratio": +1, "pitch": -1, "roll": -1},
    "visibility": {"offline": +1, "return_range": +1, "visible_share": +1},
}
"""Inputs and signs of the real-time indices: the map's value, and motion or sensing state."""


class CompositeIndex(TransformerMixin, BaseEstimator):
    """First principal component of winsorised, standardised features, oriented and scaled.

    Each feature is winsorised at its 1st and 99th percentile and standardised; the first component
    is oriented so that the loadings agree with the declared signs (sum of loading x sign > 0),
    independent of the solver; the 2nd and 98th percentile of its score are mapped to 0 and 1.

    Attributes:
        loadings_: DataArray (feature), the oriented unit vector; 0 for a constant feature.
        explained_variance_ratio_: DataArray (component), shares of the variance, largest first.
    """

    def __init__(self, signs: Mapping[str, int], *, min_samples: int = 1) -> None:
        """Declare the features.

        Args:
            signs: Signs by feature: +1 if it raises the index, -1 if it lowers it.
            min_samples: Least number of samples to fit on.
        """
        self.signs = signs
        self.min_samples = require_whole("min_samples", min_samples, 1)

    @classmethod
    def realtime(cls, feature: str, **options: object) -> Self:
        """Make the index of a driven bound: the map's value fused with the robot's state.

        Fit it once on the bounds of a set of calibration missions: refitted on few bounds, its
        signs may flip.

        Args:
            feature: `"traversability"`: the map's (`offline`) at the robot's true position, its
                `speed_ratio` (achieved over commanded), and the size of its `pitch` and `roll`
                (rad). `"visibility"`: the map's (`offline`), the mean range of the lidar's returns
                (`return_range`, m), and the `visible_share` of its beams.
            **options: See `CompositeIndex`.

        Raises:
            TrustboError: An unknown feature.
        """
        signs = REALTIME[require_choice("real-time feature", feature, REALTIME)]
        return cls(signs, **{"min_samples": MIN_CALIBRATION} | options)  # pyright: ignore[reportArgumentType]

    def fit(self, features: xr.Dataset, y: None = None) -> Self:
        """Fit the limits, the loadings and the scale.

        Args:
            features: One variable per declared feature, any dims; samples with a NaN are left out.
            y: Not used; scikit-learn's convention.

        Raises:
            TerrainError: A declared feature is missing, or too few samples have all of them.
        """
        x = np.stack(self._columns(features), axis=1).astype(float)
        x = x[np.isfinite(x).all(1)]
        if len(x) < self.min_samples:
            problem = f"only {len(x)} samples have" if len(x) else "no pixel has"
            raise TerrainError(
                f"{problem} all of the features {', '.join(self.signs)}; "
                f"{self.min_samples} are needed."
            )
        x = x[:: -(-len(x) // MAX_PIXELS)]
        self._standardise(x)
        x = np.clip(x, self._low, self._high)
        z = ((x - self._mean) / np.where(self._varies, self._sd, 1.0))[:, self._varies]
        weights, ratios = np.zeros(len(self.signs)), np.array([1.0])
        if self._varies.any():
            pca = PCA(svd_solver="covariance_eigh").fit(z)
            first, ratios = np.asarray(pca.components_)[0], pca.explained_variance_ratio_
            signs = np.array(list(self.signs.values()), dtype=float)[self._varies]
            weights[self._varies] = (np.sign(first @ signs) or 1.0) * first
        self.loadings_ = xr.DataArray(
            weights, {"feature": list(self.signs)}, dims="feature", name="loading"
        )
        self.explained_variance_ratio_ = xr.DataArray(
            ratios, {"component": np.arange(1, len(ratios) + 1)}, dims="component"
        )
        self._scale(z @ weights[self._varies])
        self._warn()
        return self

    def transform(self, features: xr.Dataset) -> xr.DataArray:
        """Compute the index of every sample, in [0, 1]; NaN where a feature is.

        If all features are constant, the index is 0.5 everywhere.

        Raises:
            TerrainError: A declared feature is missing.
            TrustboError: It has not been fitted.
        """
        columns = dict(zip(self.signs, self._columns(features), strict=True))
        like = features[next(iter(self.signs))]
        index = self.of_columns(columns).reshape(like.shape)
        attrs = {"units": "1", "long_name": "index"}
        return like.copy(deep=False, data=index).rename(None).assign_attrs(attrs)

    def of_columns(
        self, columns: Mapping[str, np.ndarray], out: np.ndarray | None = None
    ) -> np.ndarray:
        """Compute the index of arrays of one shape, as `transform` does.

        Args:
            columns: Arrays by feature; each is accessed once, in order.
            out: Array to write to; by default a new one.

        Raises:
            TrustboError: It has not been fitted.
        """
        if not hasattr(self, "loadings_"):
            raise TrustboError("this CompositeIndex is not fitted; call fit, or load one.")
        weights = self.loadings_.values / np.where(self._varies, self._sd, 1.0)
        numbers = zip(self._low, self._high, self._mean, weights, strict=True)
        score = out
        for name, of_feature in zip(self.signs, numbers, strict=True):
            column = columns[name]
            if score is None:
                score = np.empty(column.shape, column.dtype if column.dtype.kind == "f" else float)
            if name == next(iter(self.signs)):
                score[...] = 0.0
            _add_score(score.reshape(-1), column.reshape(-1), *np.asarray(of_feature, score.dtype))
        if score is None:
            raise TrustboError("a CompositeIndex needs a feature at least; signs is empty.")
        if self._top - self._bottom < 1e-9:
            return np.where(np.isfinite(score), 0.5, np.nan)
        ends = np.asarray([self._bottom, self._top], score.dtype)
        _to_unit(score.reshape(-1), *ends)
        return score

    def to_dataset(self) -> xr.Dataset:
        """Convert a fitted index to arrays (feature) and attributes, as `save` writes them."""
        columns = {name: getattr(self, f"_{name}") for name in _COLUMNS}
        data = xr.Dataset(
            {name: ("feature", np.asarray(values, float)) for name, values in columns.items()}
            | {"sign": ("feature", list(self.signs.values())), "loading": self.loadings_}
            | {"explained_variance_ratio": self.explained_variance_ratio_}
        )
        data.attrs = {
            "min_samples": self.min_samples,
            **{name: float(getattr(self, f"_{name}")) for name in _NUMBERS},
        }
        return data

    @classmethod
    def from_dataset(cls, data: xr.Dataset) -> Self:
        """Make an index from the dataset of `to_dataset`."""
        names = [str(name) for name in data["feature"].values]
        attrs = data.attrs
        index = cls(
            dict(zip(names, data["sign"].values.astype(int).tolist(), strict=True)),
            min_samples=int(attrs["min_samples"]),
        )
        index.loadings_ = data["loading"].load()
        index.explained_variance_ratio_ = data["explained_variance_ratio"].load()
        for name in _COLUMNS:
            setattr(index, f"_{name}", data[name].values)
        index._varies = index._varies.astype(bool)
        for name in _NUMBERS:
            setattr(index, f"_{name}", float(attrs[name]))
        return index

    def save(self, path: FilePath) -> None:
        """Write a fitted index to a netCDF file."""
        write_file(path, lambda file: self.to_dataset().to_netcdf(file))

    @classmethod
    def load(cls, path: FilePath) -> Self:
        """Read an index that `save` wrote."""
        with interpreting(path), xr.open_dataset(read_file(path), engine="netcdf4") as data:
            return cls.from_dataset(data.load())

    def _columns(self, features: xr.Dataset) -> Sequence[np.ndarray]:
        missing = [name for name in self.signs if name not in features]
        if missing:
            raise TerrainError(f"the composite needs {', '.join(missing)}; got {list(features)}.")
        return [features[name].values.ravel() for name in self.signs]

    def _standardise(self, x: np.ndarray) -> None:
        """Fit the limits, centre and scale of each column."""
        self._low, self._high = np.percentile(x, [1, 99], axis=0)
        x = np.clip(x, self._low, self._high)
        self._mean, self._sd = x.mean(0), x.std(0)
        # A (nearly) constant feature carries no information, and has no z-score.
        self._varies = self._sd > 1e-9 * np.maximum(1.0, np.abs(self._mean))

    def _scale(self, score: np.ndarray) -> None:
        """Fit the scores that become 0 and 1."""
        self._bottom, self._top = np.percentile(score, [2, 98])
        if self._top - self._bottom < 1e-9:  # nearly all pixels are alike: take the extremes
            self._bottom, self._top = float(score.min()), float(score.max())

    def _warn(self) -> None:
        loadings = zip(self.signs.items(), self.loadings_.values, strict=True)
        against = [name for (name, sign), loading in loadings if loading * sign < 0]
        if against:
            warnings.warn(
                f"{', '.join(against)} enters its composite against the declared sign: here it "
                "goes along with what it should oppose. Look at plots.loadings, or leave it out.",
                stacklevel=3,
            )
        if (ratio := float(self.explained_variance_ratio_[0])) < 0.5:
            warnings.warn(
                f"the first component of {', '.join(self.signs)} explains only {ratio:.0%} of "
                "their variance; look at plots.loadings, and leave one out, or give two indices.",
                stacklevel=3,
            )


_COLUMNS = ("low", "high", "mean", "sd", "varies")
_NUMBERS = ("bottom", "top")


@njit(cache=True, nogil=True, fastmath={"contract", "nsz", "arcp", "reassoc"})
def _add_score(score, x, low, high, mean, weight):
    """Add one feature to the score; comparisons with NaN are false, so NaN propagates."""
    for n in range(len(x)):
        v = low if x[n] < low else x[n]
        v = high if v > high else v
        score[n] += (v - mean) * weight


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def _to_unit(score, bottom, top):
    zero, width = bottom - bottom, top - bottom
    one = width / width
    for n in range(len(score)):
        v = (score[n] - bottom) / width
        v = zero if v < zero else v
        score[n] = one if v > one else v
