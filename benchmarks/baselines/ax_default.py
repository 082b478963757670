"""Ax with its defaults, on the candidates of BoTorch.

It has what BoTorch's baseline does. A choice among 200 named paths would mean nothing to a
Gaussian process, so its advocates would describe each candidate by a few numbers and let Ax choose
these: here the principal components of the candidates' sums of features, each in its range over the
candidates. The candidate nearest to what Ax asks for is driven, and reported at its own place. The
first mission is that of line of sight; then follow Ax's own centre and Sobol points, five trials
in all, before its Gaussian process; the recommended path is Ax's best trial by the model, thus one
that was driven. The value is reported as it is: to Ax, line of sight is a feature like any other.
0.8 s a mission.
"""

import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from trustbo.campaign.campaign import Campaign
from trustbo.data import Mission
from trustbo.planning import Planner

from .paths import Path, PathPolicy, candidates, features, measured

_LEAST_SD = 1e-6
"""Sd of a sum over candidates, relative to the largest, below which it is a constant."""


class AxDefault(PathPolicy):
    """Policy by Ax's client."""

    __name__ = "Ax"

    def __init__(self) -> None:
        """Begin without missions; ImportError: Ax is not installed."""
        with _quiet():
            import ax.api.client  # noqa: F401

        self._client: Any = None
        self._driven: dict[int, Path] = {}

    def learn(self, campaign: Campaign, mission: Mission) -> None:
        """Report the value of a mission at the place of its path."""
        planner = campaign.planner
        value = measured(planner, mission)
        if value is None:
            return
        with _quiet():
            self._begin(planner)
            index = self._client.attach_trial(self._place(planner, mission.path))
            self._client.complete_trial(index, raw_data={"value": value})
        self._driven[index] = mission.path

    def choose(self, planner: Planner, rng: np.random.Generator) -> Path:
        """Candidate nearest to what Ax asks for; the first is that of line of sight."""
        paths = candidates(planner)
        if not self._driven:
            return paths[0]
        with _quiet():
            ((index, asked),) = self._client.get_next_trials(max_trials=1).items()
            self._client.mark_trial_abandoned(index)
        places = np.array([list(self._place(planner, path).values()) for path in paths])
        away = (places - np.array([asked[name] for name in self._names])) / self._widths
        return paths[int((away**2).sum(1).argmin())]

    def best(self, planner: Planner) -> Path:
        """Ax's best trial; before any the path of line of sight."""
        if not self._driven:
            return candidates(planner)[0]
        with _quiet():
            _, _, index, _ = self._client.get_best_parameterization()
        return self._driven[index]

    def _begin(self, planner: Planner) -> None:
        """Describe the candidates of the first planner to Ax."""
        if self._client is not None:
            return
        from ax.api.client import Client
        from ax.api.configs import RangeParameterConfig

        sums = features(planner, candidates(planner))
        self._middle, sd = sums.mean(0), sums.std(0)
        self._scale = np.where(sd > _LEAST_SD * sd.max(), sd, np.inf)
        _, spread, axes = np.linalg.svd((sums - self._middle) / self._scale, full_matrices=False)
        self._axes = axes[spread > _LEAST_SD * spread[0]]
        places = (sums - self._middle) / self._scale @ self._axes.T
        self._low, self._high = places.min(0), places.max(0)
        self._widths = self._high - self._low
        self._names = [f"component_{k + 1}" for k in range(len(self._axes))]
        self._client = Client(random_seed=0)
        self._client.configure_experiment(parameters=[
            RangeParameterConfig(name=name, parameter_type="float", bounds=(low, high))
            for name, low, high in zip(
                self._names, self._low.tolist(), self._high.tolist(), strict=True
            )
        ])  # fmt: skip
        self._client.configure_optimization(objective="value")

    def _place(self, planner: Planner, path: Path) -> dict[str, float]:
        """Parameters of a path, within the ranges that Ax was given."""
        place = (features(planner, [path])[0] - self._middle) / self._scale @ self._axes.T
        values = np.clip(place, self._low, self._high).tolist()
        return dict(zip(self._names, values, strict=True))


@contextmanager
def _quiet() -> Iterator[None]:
    """Without Ax's log and warnings."""
    disabled = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(disabled)
