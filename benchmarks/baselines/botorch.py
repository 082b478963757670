"""BoTorch on paths, without bounds or trust.

A Gaussian process over path-averaged features predicts the contact lost on a path; the next path
has the largest log expected improvement among 500 candidates, as many as are good and diverse.
"""

import warnings
from typing import Any

import numpy as np
from jax import Array

from trustbo.campaign.campaign import Campaign
from trustbo.data import Cell, Mission
from trustbo.models.params import Params
from trustbo.planning import Plan, Planner
from trustbo.planning.path_sampling import path_sampler
from trustbo.workspace.moves import along, moves_along

_N_DRAWN, _N_CANDIDATES = 3000, 500
_OVERLAP = 0.7
"""Share of its bounds that a candidate may have in common with another, as long as there are
enough."""


class PathBandit:
    """Policy by BoTorch; it learns from the missions, and recommends by the mean of its process."""

    __name__ = "BoTorch"

    def __init__(self) -> None:
        """Begin without missions; ImportError: BoTorch is not installed."""
        import botorch  # noqa: F401

        self._paths: list[tuple[Cell, ...]] = []
        self._features = np.empty((0, 0))
        self._inputs: list[np.ndarray] = []
        self._values: list[float] = []

    def __call__(self, key: Array, posterior: Params, planner: Planner) -> Plan:
        """Choose the path of largest expected improvement."""
        self._prepare(planner)
        return planner.evaluate(self._paths[self._best(improve=True)], posterior.mean())

    def learn(self, campaign: Campaign, mission: Mission) -> None:
        """Learn from a mission: contact lost, bounds that were not driven being like the others."""
        rates = np.nanmean(mission.contact_rate)
        if np.isfinite(rates):
            self._inputs.append(_features(campaign.planner, mission.path))
            self._values.append(-(len(mission.path) - 1) * (1.0 - float(rates)))

    def recommend(self, campaign: Campaign) -> tuple[Cell, ...]:
        """Path with the largest predicted mean."""
        self._prepare(campaign.planner)
        return self._paths[self._best(improve=False)]

    def _prepare(self, planner: Planner) -> None:
        if self._paths:
            return
        sampler, rng = path_sampler(planner.paths), np.random.default_rng(0)
        drawn = list(dict.fromkeys(sampler.draw(rng) for _ in range(_N_DRAWN)))
        features = np.stack([_features(planner, path) for path in drawn])
        # Before any mission: fewer bounds, and more of every feature.
        order = np.argsort(-features.sum(1), kind="stable")
        bounds = [_bounds(path) for path in drawn]
        chosen: list[int] = []
        for i in order:
            others = (len(bounds[i] & bounds[j]) / len(bounds[i]) for j in chosen)
            if len(chosen) < _N_CANDIDATES and max(others, default=0.0) <= _OVERLAP:
                chosen.append(int(i))
        rest = [int(i) for i in order if i not in set(chosen)]
        chosen += rest[: _N_CANDIDATES - len(chosen)]
        self._paths, self._features = [drawn[i] for i in chosen], features[chosen]

    def _best(self, *, improve: bool) -> int:
        if len(self._values) < 2:
            return 0 if not self._values or not improve else len(self._paths) // 2
        import torch
        from botorch.acquisition import LogExpectedImprovement
        from botorch.fit import fit_gpytorch_mll
        from botorch.models import SingleTaskGP
        from botorch.models.transforms import Normalize, Standardize
        from gpytorch.mlls import ExactMarginalLogLikelihood

        x = torch.tensor(np.stack(self._inputs), dtype=torch.float64)
        y = torch.tensor(self._values, dtype=torch.float64)[:, None]
        n = x.shape[1]
        transforms: dict[str, Any] = {
            "input_transform": Normalize(n), "outcome_transform": Standardize(1),
        }  # fmt: skip
        with warnings.catch_warnings(), torch.random.fork_rng():
            warnings.simplefilter("ignore")
            torch.manual_seed(0)
            process = SingleTaskGP(x, y, **transforms)
            fit_gpytorch_mll(ExactMarginalLogLikelihood(process.likelihood, process))
            at = torch.tensor(self._features, dtype=torch.float64)[:, None]
            with torch.no_grad():
                if improve:
                    score = LogExpectedImprovement(process, best_f=y.max())(at)
                else:
                    score = process.posterior(at[:, 0]).mean[:, 0]
        return int(score.argmax())


def _features(planner: Planner, path: tuple[Cell, ...]) -> np.ndarray:
    """Mean awareness along a path, and minus its length relative to the shortest."""
    z = along(planner.mean_awareness, path).mean((0, 1))
    return np.append(z, -(len(path) - 1) / planner.shortest)


def _bounds(path: tuple[Cell, ...]) -> set[tuple[int, Cell]]:
    return set(zip(moves_along(path).tolist(), path[1:], strict=True))
