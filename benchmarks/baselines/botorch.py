"""BoTorch on paths, without bounds or trust: log expected improvement, or Thompson sampling.

It has the sums of every feature along a path, line of sight among them, and the value of each
path driven; not which bound was good. Its advocates would run it as here: `SingleTaskGP` with its
defaults, of the value less what line of sight predicts, and 200 candidates that are each the best
under jittered line of sight, the first without jitter. So the path before any mission is that of
line of sight, and the process learns how line of sight errs with the features. The next path has
the largest log expected improvement (`expected_improvement`) or is the best under one joint draw
(`thompson`); the recommended path has the largest posterior mean. 0.2 to 0.4 s a mission.
"""

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np

from trustbo.campaign.campaign import Campaign
from trustbo.data import Mission
from trustbo.planning import Planner

from .paths import Path, PathPolicy, candidates, features, measured, predicted


class PathProcess(PathPolicy):
    """Policy by BoTorch's Gaussian process over paths, with one of two acquisitions."""

    def __init__(self, acquisition: str) -> None:
        """Begin without missions; ImportError: BoTorch is not installed."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of torch, about itself
            import botorch  # noqa: F401

        self._acquisition = acquisition
        self._missions: list[tuple[Path, float]] = []
        self._fitted: tuple[int, Any] | None = None

    def learn(self, campaign: Campaign, mission: Mission) -> None:
        """Add the value of a mission."""
        value = measured(campaign.planner, mission)
        if value is not None:
            self._missions.append((mission.path, value))

    def choose(self, planner: Planner, rng: np.random.Generator) -> Path:
        """Path of the largest acquisition."""
        return self._best(planner, self._acquisition, int(rng.integers(2**31)))

    def best(self, planner: Planner) -> Path:
        """Path of the largest posterior mean."""
        return self._best(planner, "mean", 0)

    def _best(self, planner: Planner, acquisition: str, seed: int) -> Path:
        paths = candidates(planner)
        if not self._missions:
            return paths[0]
        import torch

        with warnings.catch_warnings(), torch.random.fork_rng():
            warnings.simplefilter("ignore")
            torch.manual_seed(seed)
            score = self._score(planner, paths, acquisition)
        return paths[int(score.argmax())]

    def _score(self, planner: Planner, paths: list[Path], acquisition: str) -> Any:
        """Acquisition of every candidate, by BoTorch."""
        import torch
        from botorch.acquisition import LogExpectedImprovement

        new, prior = _tensor(features(planner, paths)), _tensor(_predicted(planner, paths))
        process = self._process(planner, new)
        with torch.no_grad():
            if acquisition == "EI":  # of the value: the rest has to exceed the best less the prior
                best = max(value for _, value in self._missions) - prior
                return LogExpectedImprovement(process, best_f=best[:, None])(new[:, None])
            posterior = process.posterior(new)
            rest = posterior.rsample()[0] if acquisition == "Thompson" else posterior.mean
            return prior + rest[:, 0]

    def _process(self, planner: Planner, new: Any) -> Any:
        """Process given all missions, fitted once after each."""
        import torch
        from botorch.fit import fit_gpytorch_mll
        from botorch.models import SingleTaskGP
        from botorch.models.transforms import Normalize, Standardize
        from gpytorch.mlls import ExactMarginalLogLikelihood

        n = len(self._missions)
        if self._fitted is None or self._fitted[0] != n:
            paths, values = zip(*self._missions, strict=True)
            x, rest = _tensor(features(planner, paths)), np.array(values)
            rest = _tensor(rest - _predicted(planner, paths))
            both = torch.cat([x, new])
            limits = torch.stack([both.amin(0), both.amax(0) + 1e-9])
            process = SingleTaskGP(
                x, rest[:, None], input_transform=Normalize(x.shape[1], bounds=limits),
                outcome_transform=Standardize(1),
            )  # fmt: skip
            fit_gpytorch_mll(ExactMarginalLogLikelihood(process.likelihood, process))
            self._fitted = n, process
        return self._fitted[1]


def _predicted(planner: Planner, paths: Sequence[Path]) -> np.ndarray:
    return np.array([predicted(planner, path) for path in paths])


def _tensor(values: Any) -> Any:
    import torch

    return torch.tensor(values, dtype=torch.float64)


def expected_improvement() -> PathProcess:
    """Policy of the largest log expected improvement."""
    return PathProcess("EI")


def thompson() -> PathProcess:
    """Policy of the best path under one draw of the process."""
    return PathProcess("Thompson")
