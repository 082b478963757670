"""The columns of the effects of a model in some missions, with their coefficients and prior."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy import sparse

from trustbo.inference.engine import Prior
from trustbo.models.effects.effect import Effect, Theta
from trustbo.models.observations import Observations

Groups = Mapping[str, Mapping[str, np.ndarray]]
"""Variables (draw, ...) by group (`posterior` and one per effect) and name."""


class Columns:
    """Columns of the effects on the drift of missions; the drift of all rates is u = U c.

    Attributes:
        effects: Effects, in the order of their columns.
        observations: Rates and awareness of the missions, with the data that the effects need.
        U: Sparse design matrix (observation, column).
        n: Number of columns.
    """

    def __init__(self, effects: Sequence[Effect], observations: Observations) -> None:
        """Make the design matrix."""
        self.effects = tuple(effects)
        self.observations = observations

        none = sparse.csr_array((observations.contact_rate.size, 0))
        designs = [none, *(effect.design(observations) for effect in effects)]
        self.U: Any = sparse.hstack(designs, format="csr")
        self._ends = np.cumsum([U.shape[1] for U in designs[1:]])
        self.n = int(self._ends[-1]) if effects else 0

    def prior(self, theta: Theta) -> Prior:
        """Return the prior on all coefficients at each theta."""
        return Prior.from_groups(
            [effect.prior(theta, self.observations) for effect in self.effects]
        )

    def to_variables(self, c: np.ndarray, theta: Theta) -> dict[str, dict[str, np.ndarray]]:
        """Return the variables of coefficients c (draw, column), by group and name.

        Effects are stored in single precision, because they take most of the memory of a posterior
        and the error is far below their Monte Carlo error. Computations read them in double
        precision.
        """
        groups: dict[str, dict[str, np.ndarray]] = {}
        for effect, part in zip(self.effects, np.split(c, self._ends[:-1], axis=1), strict=True):
            own = part.copy()  # a view would keep all columns in memory
            values = effect.to_variables(own, theta, self.observations)
            if effect.group:
                values = {name: v.astype(np.float32) for name, v in values.items()}
            groups.setdefault(effect.group or "posterior", {}).update(values)
        return groups

    def coefficients(self, groups: Groups, theta: Theta) -> np.ndarray:
        """Return coefficients (draw, column) from variables, as returned by `to_variables`."""
        parts = []
        for effect in self.effects:
            stored = groups[effect.group or "posterior"]
            values = {name: np.asarray(v, dtype=float) for name, v in stored.items()}
            parts.append(effect.coefficients(values, theta, self.observations))
        return np.concatenate(parts, axis=1)
