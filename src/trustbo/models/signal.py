"""The matrix form of a model: blocks of slots, and the signals of the blocks."""

from typing import Any, NamedTuple

import numpy as np
from scipy import sparse

from trustbo.models.backend import namespace


class Layout(NamedTuple):
    """Layout of slots in blocks and rows.

    A block is a robot in a mission, with one row per bound. If `joint`, a block is a mission, with
    rows (bound, robot). With a `rotation`, blocks are orthonormal combinations of robots' signals.
    """

    shape: Any  # numbers of missions, bounds and robots
    joint: bool = False
    rotation: np.ndarray | None = None  # (combination, robot)
    split: np.ndarray | None = None
    """Mask of columns with separate inputs, which precede the inputs of other columns."""
    apart: bool = False
    """Whether all blocks have different signal matrices."""

    @property
    def label(self) -> np.ndarray:
        """Label (block,) of each block; blocks with equal labels have equal signal matrices."""
        n_missions, _, n_robots = self.shape
        if self.joint:
            return np.arange(n_missions) * int(self.apart)
        others = np.arange(n_robots) > 0 if self.rotation is not None else np.zeros(n_robots)
        return np.tile(others.astype(int), n_missions)

    def rows(self, values: np.ndarray) -> np.ndarray:
        """Rearrange values (..., mission, bound, robot) as (..., block, row)."""
        if self.rotation is not None:
            values = values @ self.rotation.T
        if not self.joint:
            values = np.swapaxes(values, -1, -2)
        *leading, n, a, b = values.shape
        return values.reshape(*leading, n, a * b) if self.joint else values.reshape(*leading, -1, b)

    def slots(self, values: np.ndarray) -> np.ndarray:
        """Rearrange values (..., block, row) as (..., mission, bound, robot)."""
        n, K, R = self.shape
        if self.joint:
            return values.reshape(*values.shape[:-2], n, K, R)
        values = np.swapaxes(values.reshape(*values.shape[:-2], n, R, K), -1, -2)
        return values if self.rotation is None else values @ self.rotation

    def columns(self, U: Any) -> Any:
        """Rearrange a sparse matrix (slot, column) to (block * input, column)."""
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


class Signal(NamedTuple):
    """Trust x = m + T u + e of each block at each point, with e ~ N(0, S) and inputs u = U c.

    Each row of a block is an observation. The second axis is the label of a block (see `Layout`),
    and has length 1 if all blocks have equal matrices.
    """

    m: Any  # (point, label, row)
    T: Any  # (point, label, row, input)
    S: Any  # (point, label, row, row)
    sd: Any  # (point, 1, 1 or row), sd of independent observation noise
    noise: Any = None  # (point, label, row, row), covariance of shared noise, or None

    @property
    def covariance(self) -> Any:
        """Covariance (point, label, row, row) of trust plus shared noise."""
        return self.S if self.noise is None else self.S + self.noise


def each(M: Any, label: np.ndarray) -> Any:
    """Select values (point, block, ...) by block label; a block axis of length 1 is kept."""
    return M if M.shape[1] == 1 else M[:, label]


def powers(beta0: Any, n: int) -> Any:
    """Compute lower triangular matrices (1 - beta0 Lag)^-1 (..., n, n) of powers beta0^(k - j)."""
    xp = namespace(beta0)
    lag = np.subtract.outer(np.arange(n), np.arange(n))
    return xp.where(lag >= 0, beta0[..., None, None] ** np.maximum(lag, 0), 0.0)
