"""What the awareness of cells may really be: the offline map, and a field of its errors.

The map from the DEM and DSM is a prediction; missions measure awareness where they pass. Errors are
taken to be a Gaussian process over the cells, one for each feature and the same for all robots:
what is measured in one cell says something of its neighbours, and little of cells far away.
"""

import warnings
from collections.abc import Sequence
from typing import Any, cast

import numpy as np
from scipy.linalg import cholesky
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import ConstantKernel, Matern, WhiteKernel

from trustbo.data import Mission
from trustbo.errors import ShapeError, TrustboError, require_positive
from trustbo.terrain import Workspace

_MOST_CELLS = 4000  # whose errors are drawn jointly


class AwarenessBelief:
    """A Gaussian process over the errors of a workspace's awareness map.

    Attributes:
        workspace: Whose map is believed, more or less.
        n_measured: How many measurements the belief holds, by feature.
    """

    def __init__(
        self,
        workspace: Workspace,
        *,
        sd: float = 0.15,
        length_scale: float = 2.0,
        noise: float = 0.05,
        learn_scales: bool = False,
    ) -> None:
        """Believe in the map, more or less; nothing is measured yet.

        Args:
            workspace: Whose awareness is in doubt.
            sd: How far off the map is, before anything is measured.
            length_scale: Over how many cells errors are alike (of a Matern 3/2 kernel).
            noise: How far off a measurement is.
            learn_scales: Whether these three are fitted to what is measured, by maximum
                likelihood, as soon as 10 cells are; else they stay.

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
        self._kernel = ConstantKernel(require_positive("sd", sd) ** 2, (1e-4, 1.0)) * Matern(
            scale, (0.3, 100.0), nu=1.5
        ) + WhiteKernel(require_positive("noise", noise) ** 2, (1e-6, 1.0))
        self._learns = learn_scales
        self._map = workspace.awareness.values
        n_features = self._map.shape[-1]
        self._seen: list[list[tuple[int, int, float]]] = [[] for _ in range(n_features)]

    @property
    def n_measured(self) -> list[int]:
        """How many measurements the belief holds, by feature."""
        return [len(seen) for seen in self._seen]

    def update(self, mission: Mission) -> None:
        """Take in the awareness that a mission measured; NaN is left out.

        A bound's error is the mean over robots of what they measured less what the map says.

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
        for bound in mission.bounds:
            error = bound.awareness - self._map[:, *bound.cell]
            for m in range(error.shape[1]):
                known = error[~np.isnan(error[:, m]), m]
                if len(known):
                    self._seen[m].append((*bound.cell, float(known.mean())))

    def mean(self) -> np.ndarray:
        """Expected awareness, shape (robot, row, col, feature), in [0, 1]."""
        errors = [self._error(m, with_cov=False)[0] for m in range(len(self._seen))]
        return self._around(np.stack(errors, axis=-1)[None])[0]

    def sd(self) -> np.ndarray:
        """How far off that may be, shape (row, col, feature); NaN in impassable cells."""
        shape = (*self._map.shape[1:3], len(self._seen))
        sd = np.full(shape, np.nan)
        for m in range(len(self._seen)):
            sd[*self._cells.T, m] = np.sqrt(np.diag(self._error(m)[1]))
        return sd

    def draw(self, n_draws: int, seed: int | Sequence[int] = 0) -> np.ndarray:
        """Maps as they may really be, shape (draw, robot, row, col, feature), in [0, 1].

        Args:
            n_draws: How many.
            seed: Same seed, same maps.
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
        """Mean (cell,) and covariance (cell, cell) of a feature's error in the passable cells."""
        seen = np.array(self._seen[m]).reshape(-1, 3)
        field = self._kernel.k1  # the measurement noise is not part of the error
        if not len(seen):
            n = len(self._cells)
            return np.zeros(n), field(self._cells) if with_cov else np.empty(0)
        learns = self._learns and len(seen) >= 10
        # Its annotations know neither `optimizer=None` nor what is returned when.
        regression: Any = GaussianProcessRegressor(
            self._kernel, optimizer="fmin_l_bfgs_b" if learns else cast(Any, None)
        )
        with warnings.catch_warnings():
            # That a scale ends at a limit of ours is no failure.
            warnings.simplefilter("ignore", ConvergenceWarning)
            regression.fit(seen[:, :2], seen[:, 2])
        if not with_cov:
            return regression.predict(self._cells), np.empty(0)
        mean, covariance = regression.predict(self._cells, return_cov=True)
        noise = regression.kernel_.k2.noise_level
        return mean, covariance - noise * np.eye(len(mean))

    def _around(self, errors: np.ndarray) -> np.ndarray:
        """The map with errors (draw, cell, feature) added, kept within [0, 1]."""
        maps = np.repeat(self._map[None], len(errors), axis=0)
        maps[:, :, *self._cells.T] += errors[:, None]
        return np.clip(maps, 0.0, 1.0)
