"""Standard design: five fixed paths in turn, and the one of the best mean is recommended.

It has line of sight, by which the five paths are chosen before any mission: the best, and four
good ones that have as few bounds as possible in common with it and with each other. Its advocates
would run it as a field trial, which is planned in advance, approved once, and compares a few ways
fairly, with replicates and no model; a later study of bounding overwatch has it as its condition
C1. Less than 0.01 s a mission.
"""

import numpy as np

from trustbo.campaign.campaign import Campaign
from trustbo.data import Mission
from trustbo.planning import Planner
from trustbo.workspace.moves import bounds_along

from .paths import Path, PathPolicy, candidates, measured

_N_PATHS = 5


class StandardDesign(PathPolicy):
    """Policy that drives five paths in turn, and recommends by the mean value of each."""

    __name__ = "standard design"

    def __init__(self) -> None:
        """Begin without missions; the paths follow from the first planner."""
        self.paths: list[Path] = []
        self.values: dict[Path, list[float]] = {}
        self._n_missions = 0

    def learn(self, campaign: Campaign, mission: Mission) -> None:
        """Add the value of a mission to those of its path."""
        self._n_missions += 1
        value = measured(campaign.planner, mission)
        if value is not None:
            self.values.setdefault(mission.path, []).append(value)

    def choose(self, planner: Planner, rng: np.random.Generator) -> Path:
        """Next path of the design."""
        paths = self._design(planner)
        return paths[self._n_missions % len(paths)]

    def best(self, planner: Planner) -> Path:
        """Path with the largest mean; before any mission the first of the design."""
        means = {path: np.mean(values) for path, values in self.values.items()}
        return max(means, key=means.__getitem__) if means else self._design(planner)[0]

    def _design(self, planner: Planner) -> list[Path]:
        if not self.paths:
            self.paths = diverse(candidates(planner), _N_PATHS)
        return self.paths


def diverse(paths: list[Path], n: int) -> list[Path]:
    """Choose the first path, then one by one that which shares least with any chosen before."""
    bounds = [set(map(tuple, bounds_along(path).tolist())) for path in paths]
    chosen = [0]
    while len(chosen) < min(n, len(paths)):
        shared = [max(len(b & bounds[i]) / len(b) for i in chosen) for b in bounds]
        chosen.append(int(np.argmin(shared)))
    return [paths[i] for i in chosen]
