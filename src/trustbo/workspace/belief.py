"""Belief about the true awareness of cells: the offline map, and a Gaussian process of its errors.

The map from the DEM and DSM is a prediction; missions measure awareness along their paths. The
errors are a Gaussian process over the cells, one for each feature, shared by all robots: a
measurement in one cell informs about its neighbours, and little about cells far away.
"""

from collections.abc import Sequence
from typing import Any, cast

import numpy as np
from scipy.linalg import cholesky
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import ConstantKernel, Matern, WhiteKernel

from trustbo.data import Mission
from trustbo.errors import ShapeError, TrustboError, require_positive
from trustbo.workspace.moves import along
from trustbo.workspace.workspace import Workspace

_MOST_CELLS = 4000  # with jointly drawn errors


class AwarenessBelief:
    """A Gaussian process over the errors of a workspace's awareness map.

    Attributes:
        workspace: Workspace with the map.
        n_measured: Number of measurements taken in, by feature.
    """

    def __init__(
        self,
        workspace: Workspace,
        *,
        sd: float = 0.15,
        length_scale: float = 2.0,
        noise: float = 0.05,
    ) -> None:
        """Set the prior of the errors.

        Args:
            workspace: Workspace with an uncertain awareness map.
            sd: Prior standard deviation of the map's errors.
            length_scale: Length scale of the errors, cells (Matern 3/2 kernel).
            noise: Standard deviation of a measurement.

        Raises:
            TrustboError: A value that is not positive, or a grid of over 4000 passable cells.
        """
        self.workspace = workspace
        self._cells = np.argwhere(workspace.passable.values)
        if len(self._cells) > _MOST_CELLS:
            raise TrustboError(
                f"a belief is over at most {_MOST_CELLS} passable cells; the workspace has "
                f"{len(self._cells)}. Use larger cells, or awareness='map'."
            )
        scale = require_positive("length_scale", length_scale)
        self._field: Any = ConstantKernel(require_positive("sd", sd) ** 2) * Matern(scale, nu=1.5)
        self._noise = require_positive("noise", noise) ** 2
        self._map, self._bounds = workspace.awareness.values, workspace.bound_maps
        n_features = self._map.shape[-1]
        self._seen: list[list[tuple[int, int, float]]] = [[] for _ in range(n_features)]

    @property
    def n_measured(self) -> list[int]:
        """Number of measurements taken in, by feature."""
        return [len(seen) for seen in self._seen]

    def update(self, mission: Mission) -> None:
        """Condition on the awareness that a mission measured; NaN is left out.

        The error in the cell entered is the mean over robots of the awareness measured in a bound,
        less that of the bound in the map.

        Raises:
            ShapeError: Robots or features differ from the workspace's.
            TrustboError: The path leaves the grid.
        """
        if mission.awareness.shape[1:] != (self._map.shape[0], self._map.shape[-1]):
            raise ShapeError(
                f"the mission measured (robot, feature) {mission.awareness.shape[1:]}, the "
                f"workspace has {(self._map.shape[0], self._map.shape[-1])}."
            )
        rows, cols = self._map.shape[1:3]
        for bound in mission.bounds:
            if not (0 <= bound.cell[0] < rows and 0 <= bound.cell[1] < cols):
                raise TrustboError(
                    f"the mission enters {bound.cell}, outside the grid of {rows} rows and {cols} "
                    "columns."
                )
        mapped = along(self._bounds, mission.path)
        for k, bound in enumerate(mission.bounds):
            error = bound.awareness - mapped[:, k]
            for m in range(error.shape[1]):
                measured = error[~np.isnan(error[:, m]), m]
                if len(measured):
                    self._seen[m].append((*bound.cell, float(measured.mean())))

    def mean(self) -> np.ndarray:
        """Expected awareness, shape (robot, row, col, feature), in [0, 1]."""
        errors = [self._error(m, with_cov=False)[0] for m in range(len(self._seen))]
        return self._around(np.stack(errors, axis=-1)[None])[0]

    def sd(self) -> np.ndarray:
        """Standard deviation of awareness, shape (row, col, feature); NaN in impassable cells."""
        shape = (*self._map.shape[1:3], len(self._seen))
        sd = np.full(shape, np.nan)
        for m in range(len(self._seen)):
            sd[*self._cells.T, m] = np.sqrt(np.diag(self._error(m)[1]))
        return sd

    def draw(self, n_draws: int, seed: int | Sequence[int] = 0) -> np.ndarray:
        """Draw maps of awareness, shape (draw, robot, row, col, feature), in [0, 1].

        Args:
            n_draws: Number of draws.
            seed: Seed of the draws.
        """
        rng = np.random.default_rng(seed)
        errors = []
        for m in range(len(self._seen)):
            mean, covariance = self._error(m)
            jitter = 1e-9 * np.eye(len(mean)) * np.trace(covariance) / len(mean)
            L = cholesky(covariance + jitter, lower=True)
            errors.append(mean + rng.standard_normal((n_draws, len(mean))) @ L.T)
        return self._around(np.stack(errors, axis=-1))

    def _error(self, m: int, *, with_cov: bool = True) -> tuple[np.ndarray, np.ndarray]:
        """Mean (cell,) and covariance (cell, cell) of a feature's errors in the passable cells."""
        seen = np.array(self._seen[m]).reshape(-1, 3)
        if not len(seen):
            n = len(self._cells)
            return np.zeros(n), self._field(self._cells) if with_cov else np.empty(0)
        # The annotations of scikit-learn lack `optimizer=None`, and the variants of the result.
        kernel, none = self._field + WhiteKernel(self._noise), cast(Any, None)
        regression: Any = GaussianProcessRegressor(kernel, optimizer=none)
        regression.fit(seen[:, :2], seen[:, 2])
        if not with_cov:
            return regression.predict(self._cells), np.empty(0)
        mean, covariance = regression.predict(self._cells, return_cov=True)
        # The measurement noise is not part of the error.
        return mean, covariance - self._noise * np.eye(len(mean))

    def _around(self, errors: np.ndarray) -> np.ndarray:
        """The map with errors (draw, cell, feature) added, kept within [0, 1]."""
        maps = np.repeat(self._map[None], len(errors), axis=0)
        maps[:, :, *self._cells.T] += errors[:, None]
        return np.clip(maps, 0.0, 1.0)
