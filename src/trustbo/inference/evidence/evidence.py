"""The protocol of an evidence: log p(rates | theta), all but theta integrated out."""

from typing import Protocol

import numpy as np

from trustbo.models.effects.effect import Theta


class Evidence(Protocol):
    """Density of rates given hyperparameters, and draws of the coefficients given both."""

    exact: bool
    """Whether the density is that of the model, not an approximation to it."""

    def log_density(self, theta: Theta) -> np.ndarray:
        """Log density of the rates at each theta (point,), in nats; NaN where it is not finite."""
        ...

    def draw(
        self, theta: Theta, count: np.ndarray, rng: np.random.Generator
    ) -> dict[str, np.ndarray]:
        """Effects by name, each (draw, ...), `count` (point,) draws of each theta in turn."""
        ...
