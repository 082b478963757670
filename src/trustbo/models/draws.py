"""Draws of the parameters of any trust model, as planners, filters and simulators need them."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, Self

import numpy as np

from trustbo.statespace import Inputs, StateSpace


class Draws(ABC):
    """Draws of the parameters of a trust model: a state-space form, and the inputs of bounds.

    Inputs are computed when they are needed, for the bounds of a path or for all bounds of a map,
    because an array (draw, robot, move, row, col) of a large map does not fit in memory.
    """

    __slots__ = ()

    x0_mean: Any
    """Mean of trust before the first bound, shape () or (...,)."""
    robots: Any
    """Names of the robots, in the order of the arrays; None if they are not known."""
    features: Any
    """Names of the features, in the order of the arrays; None if they are not known."""

    @abstractmethod
    def in_order(self, robots: Sequence[str], features: Sequence[str]) -> Self:
        """Return the draws with their robots and features in the order of these names.

        Draws without names are in this order already. Raises TrustboError if names differ.
        """

    @property
    @abstractmethod
    def leading(self) -> tuple[int, ...]:
        """Shape of the leading axes: () for a single draw or a mean, usually (draw,)."""

    @property
    @abstractmethod
    def n_robots(self) -> int | None:
        """Number of robots; None if the parameters are the same for all robots."""

    @property
    @abstractmethod
    def n_features(self) -> int | None:
        """Number of features; None if the draws do not determine it."""

    @property
    @abstractmethod
    def by_robot(self) -> bool:
        """Whether the robots' mean trust does not obey the equation of a single robot."""

    @property
    @abstractmethod
    def grid_shape(self) -> tuple[int, int] | None:
        """Shape (row, col) of the map on whose cells the inputs depend; None if on no cell."""

    @property
    @abstractmethod
    def carried(self) -> bool:
        """Whether the inputs of a bound are carried over to later bounds (see `statespace`)."""

    @abstractmethod
    def require_valid(self, n_robots: int | None = None, n_features: int | None = None) -> None:
        """Raise TrustboError if a value is invalid, or if the given numbers do not match."""

    @abstractmethod
    def state_space(self, n_robots: int, *, adds_noise: bool = True) -> StateSpace:
        """Return the model's equation at each draw, with leading axes joined to one axis.

        Args:
            n_robots: Number of robots.
            adds_noise: Whether the observation family adds noise (see `coupled_robots`).
        """

    @abstractmethod
    def inputs(self, awareness: np.ndarray, bounds: np.ndarray | None = None) -> np.ndarray:
        """Compute the input u of bounds, which is carried over to later bounds if `carried`.

        Args:
            awareness: Situational awareness, shape (robot, move, row, col, feature) of all bounds
                of a map, or (robot, bound, feature) of `bounds`. There are no inputs where it is
                NaN.
            bounds: Moves, rows and columns (bound, 3); a move is -1 if the bound is not known.

        Returns:
            Inputs (..., robot, move, row, col) or (..., robot, bound).
        """

    @abstractmethod
    def draw(self, index: Any) -> Self:
        """Select draws by index; a single index also drops the leading axis."""

    @abstractmethod
    def mean(self) -> Self:
        """Average the form and the inputs over all draws."""

    @abstractmethod
    def flat(self) -> Self:
        """Return the draws with exactly one leading axis (draw,)."""

    @abstractmethod
    def record(self) -> dict[str, Any]:
        """Return a description of the draws for files, as plain values keyed by name."""

    def team_inputs(self, awareness: np.ndarray, bounds: np.ndarray | None = None) -> np.ndarray:
        """Compute the mean of `inputs` over robots, with the axis (robot,) of length 1."""
        axis = len(self.leading)
        return self.inputs(awareness, bounds).mean(axis, keepdims=True)

    @property
    def initial_offset(self) -> Any:
        """Offset before the first bound, so that trust is x0_mean in any case."""
        return 0.0 if self.carried else self.x0_mean

    def as_inputs(self, u: Any) -> Inputs:
        """Return inputs as a drift if they are carried over, otherwise as an offset."""
        return Inputs(u) if self.carried else Inputs(drift=0.0, offset=u)
