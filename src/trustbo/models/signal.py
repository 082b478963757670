"""Distribution of the signals of a block given its columns: what a model says, as matrices."""

from typing import Any, NamedTuple

import numpy as np

from trustbo.models.backend import namespace


class Signal(NamedTuple):
    """Trust x = m + T u + e, e ~ N(0, S), of a block at each point; u is the drift by its columns.

    Rows of a block are its observations, inputs the numbers that columns add to. The second axis is
    of labels, see `inference.engine.Blocks`; it has length 1 where all blocks are alike.
    """

    m: Any  # (point, label, row)
    T: Any  # (point, label, row, input)
    S: Any  # (point, label, row, row)
    sd: Any  # (point, 1, 1 or row), sd of the independent noise of observations
    noise: Any = None  # (point, label, row, row), covariance of noise that rows share, or None

    @property
    def covariance(self) -> Any:
        """Covariance of trust and the noise that rows share, (point, label, row, row)."""
        return self.S if self.noise is None else self.S + self.noise


def each(M: Any, label: np.ndarray) -> Any:
    """Values (point, block, ...) of blocks by their labels; one for all where all are alike."""
    return M if M.shape[1] == 1 else M[:, label]


def powers(beta0: Any, n: int) -> Any:
    """Lower triangular matrices (..., n, n) with entries beta0^(k - j), (1 - beta0 Lag)^-1."""
    xp = namespace(beta0)
    lag = np.subtract.outer(np.arange(n), np.arange(n))
    return xp.where(lag >= 0, beta0[..., None, None] ** np.maximum(lag, 0), 0.0)
