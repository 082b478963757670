"""A case of path planning, as engines take it, and its kind.

| kind | value of a path | objectives |
|---|---|---|
| `sum` | a sum of weights of its bounds | `terminal`, `mean`, Gaussian `lost_contact` |
| `history` | losses of one trust along it | `success`, `bottleneck`, other `lost_contact` |
| `vector` | any of these of several trusts | all but `stationary` |
| `free` | costs of its bounds, without history | `stationary` |
"""

from typing import NamedTuple

import numpy as np

from trustbo.planning.dynamics import Dynamics
from trustbo.planning.objectives import Objective
from trustbo.planning.paths import AdmissiblePaths
from trustbo.planning.risk import RiskTable
from trustbo.planning.search.graph import Graph
from trustbo.planning.search.layers import Weights, additive_weights
from trustbo.planning.tolls import tolls_of


class Case(NamedTuple):
    """Admissible paths, trust under every draw (draw,), objective, and a risk or none."""

    admissible: AdmissiblePaths
    dynamics: Dynamics
    objective: Objective
    risk: RiskTable | None = None

    @property
    def kind(self) -> str:
        """Kind of the case; see the head of this file."""
        if self.objective.name == "stationary":
            return "free"
        if not self.objective.has_labels:
            return "sum" if len(self.dynamics.views) == 1 else "vector"
        scalar = self.dynamics.is_scalar and self.admissible.can_unroll
        return "history" if scalar else "vector"

    @property
    def tolls(self) -> np.ndarray:
        """Toll of each bound, (move, cell) or (move, 1); see `tolls_of`."""
        return tolls_of(self.admissible, self.objective)

    def tolls_on(self, graph: Graph) -> np.ndarray:
        """Toll of each edge of a graph of bounds, (edge,)."""
        tolls = self.tolls
        return tolls[graph.move, 0] if tolls.shape[1] == 1 else tolls.ravel()[graph.bound]

    @property
    def weights(self) -> Weights:
        """Weights of the bounds of a sum, by the bounds left.

        TrustboError: so many bounds are admissible that their graph is too large to be held.
        """
        _ = self.admissible.layers  # which refuses that, before weights of so many bounds are
        view, longest = self.dynamics.views[0], self.admissible.longest
        return additive_weights(self.dynamics, view, self.objective, longest)
