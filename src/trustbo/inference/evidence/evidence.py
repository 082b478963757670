"""The base class of an evidence: log p(rates | theta), all but theta integrated out."""

from abc import ABC, abstractmethod

import numpy as np

from trustbo.models.effects.effect import Theta


def at(theta: Theta, points: np.ndarray | slice) -> dict[str, np.ndarray]:
    """Hyperparameters at some points."""
    return {name: values[points] for name, values in theta.items()}


def repeated(theta: Theta, count: np.ndarray) -> dict[str, np.ndarray]:
    """Hyperparameters of each point as many times as there are draws of it."""
    return {name: np.repeat(values, count, axis=0) for name, values in theta.items()}


class Evidence(ABC):
    """Density of rates given hyperparameters, and draws of the coefficients given both."""

    exact: bool
    """Whether the density is that of the model, not an approximation to it."""

    @abstractmethod
    def log_density(self, theta: Theta) -> np.ndarray:
        """Log density of the rates at each theta (point,), in nats; NaN where it is not finite."""

    def recentre(self, theta: Theta) -> None:
        """Re-expand an approximate density around one theta, of a leading axis of length 1."""
        return

    def sharpen(self) -> bool:
        """Make an approximate density more accurate, at more cost; whether it could."""
        return False

    @abstractmethod
    def draw(
        self, theta: Theta, count: np.ndarray, rng: np.random.Generator
    ) -> tuple[dict[str, np.ndarray], np.ndarray | None]:
        """Effects by name, each (draw, ...), `count` (point,) draws of each theta in turn.

        With them, where the density is approximate, the log weight of each draw: its exponential
        averages to the density of the rates.
        """
