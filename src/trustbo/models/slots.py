"""Rates and features of missions by slot: one bound of one robot in one mission."""

from collections.abc import Sequence
from typing import Any, NamedTuple, Self

import numpy as np
from scipy import sparse

from trustbo.data import Mission, is_line_of_sight
from trustbo.models.visited import Visited
from trustbo.stacking import stack_missions

UNKNOWN_RESOLUTION, COARSEST_RESOLUTION = 0.005, 0.1
"""Resolution of a rate with an unknown number of ticks, and the coarsest resolution."""


class Slots(NamedTuple):
    """Rates and features of missions, padded to the longest one; slots are mission first."""

    y: np.ndarray  # (mission, bound, robot), NaN where not measured
    z: np.ndarray  # (mission, bound, robot, feature), 0 in the padding
    n_ticks: np.ndarray  # (mission, bound, robot), NaN where not known
    features: tuple[str, ...] = ()
    visited: Visited | None = None

    @classmethod
    def of(cls, missions: Sequence[Mission], visited: Visited | None = None) -> Self:
        """Stack missions of one team.

        Raises:
            TrustboError: There are no missions, or they disagree on robots or features; an
                awareness value is NaN.
        """
        batch = stack_missions(missions, pad=False)
        features = tuple(missions[0].features)
        return cls(batch.contact_rate, batch.awareness, batch.n_ticks, features, visited)

    @property
    def n_missions(self) -> int:
        """Number of missions."""
        return self.y.shape[0]

    @property
    def n_bounds(self) -> int:
        """Number of bounds of the longest mission."""
        return self.y.shape[1]

    @property
    def n_robots(self) -> int:
        """Number of robots."""
        return self.y.shape[2]

    @property
    def line_of_sight(self) -> np.ndarray:
        """Predicted contact (mission, bound, robot), 1 where no feature predicts it."""
        sight = [m for m, name in enumerate(self.features) if is_line_of_sight(name)]
        return self.z[..., sight].mean(-1) if sight else np.ones(self.y.shape)

    @property
    def resolution(self) -> float:
        """Median of 1 / n_ticks over the measured rates, at most `COARSEST_RESOLUTION`."""
        ticks = np.nan_to_num(self.n_ticks[~np.isnan(self.y)])
        if not len(ticks):
            return UNKNOWN_RESOLUTION
        some = ticks > 0.0
        steps = np.where(some, 1.0 / np.where(some, ticks, 1.0), UNKNOWN_RESOLUTION)
        return float(min(np.median(steps), COARSEST_RESOLUTION))

    def without(self, missions: Sequence[int] | slice) -> Self:
        """The same slots as if some missions had not been measured."""
        y = self.y.copy()
        y[missions] = np.nan
        return self._replace(y=y)


class Layout(NamedTuple):
    """Blocks and rows that slots form.

    A block is a robot in a mission, its rows bounds; or, if `joint`, a mission, its rows (bound,
    robot). With a rotation, signals of blocks are orthonormal combinations of those of the robots.
    """

    shape: Any  # missions, bounds, robots
    joint: bool = False
    rotation: np.ndarray | None = None  # (combination, robot)
    split: np.ndarray | None = None
    """Mask of columns that are inputs of their own, before the inputs of the others."""
    apart: bool = False
    """Whether the signals of any two blocks differ."""

    @property
    def label(self) -> np.ndarray:
        """Label of each block; the first of the rotated robots differs from the others."""
        n_missions, _, n_robots = self.shape
        if self.joint:
            return np.arange(n_missions) * int(self.apart)
        others = np.arange(n_robots) > 0 if self.rotation is not None else np.zeros(n_robots)
        return np.tile(others.astype(int), n_missions)

    def rows(self, values: np.ndarray) -> np.ndarray:
        """Values (..., mission, bound, robot) as (..., block, row)."""
        if self.rotation is not None:
            values = values @ self.rotation.T
        if not self.joint:
            values = np.swapaxes(values, -1, -2)
        *leading, n, a, b = values.shape
        return values.reshape(*leading, n, a * b) if self.joint else values.reshape(*leading, -1, b)

    def slots(self, values: np.ndarray) -> np.ndarray:
        """Values (..., block, row) as (..., mission, bound, robot)."""
        n, K, R = self.shape
        if self.joint:
            return values.reshape(*values.shape[:-2], n, K, R)
        values = np.swapaxes(values.reshape(*values.shape[:-2], n, R, K), -1, -2)
        return values if self.rotation is None else values @ self.rotation

    def columns(self, U: Any) -> Any:
        """Columns of slots, sparse (slot, column), as those of (block * row, column)."""
        n, K, R = self.shape
        if self.rotation is not None:
            U = sparse.csr_array(sparse.kron(sparse.eye_array(n * K), self.rotation)) @ U
        if self.split is not None:
            p, halves = U.shape[1], (self.split, ~self.split)
            parts = [U @ sparse.diags_array(mask.astype(float)) for mask in halves]
            stacked = sparse.hstack([part.tocoo().reshape((n, K * R * p)) for part in parts])
            return stacked.tocoo().reshape((2 * n * K * R, p)).tocsr()
        if self.joint:
            return U
        order = np.arange(n * K * R).reshape(n, K, R).swapaxes(1, 2).ravel()
        return sparse.csr_array(U)[order]
