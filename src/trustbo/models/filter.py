"""Trust in real time, bound by bound of a running mission."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from trustbo.data import Cell
from trustbo.errors import ShapeError, TrustboError, require_choice
from trustbo.models.likelihood.families import FAMILIES
from trustbo.models.model import RESPONSES
from trustbo.models.params import Params, check_params, params_of
from trustbo.workspace.moves import bounds_along


class TrustState(NamedTuple):
    """Mean and sd of trust, averaged over parameter draws."""

    mean: np.ndarray
    """Shape (robot,) now, or (bound, robot) ahead."""
    sd: np.ndarray
    """Standard deviation, of the same shape."""


class TrustFilter:
    """Follows the trust of each robot during a mission (a Rao-Blackwellised filter).

    Given a draw of the parameters, trust is Gaussian and the Kalman filter exact; the draws
    themselves are reweighted by the density with which they predicted each contact rate. So after
    bound k the filter holds p(trust, parameters | earlier missions, bounds 1..k), exactly but for
    the number of draws.

    Attributes:
        params: Parameter draws, leading axis (draw,).
        weights: Their weights now, shape (draw,), sum 1.
        n_bounds: Bounds taken in since the last `reset`.
    """

    def __init__(
        self,
        posterior: xr.DataTree | Params,
        n_robots: int | None = None,
        *,
        response: str = "level",
        max_draws: int = 1000,
    ) -> None:
        """Start before the first bound of a mission.

        Args:
            posterior: DataTree from `fit` for any model with Gaussian observations, or draws with
                leading axis (draw,).
            n_robots: Number of robots; needed with `TrustParams`, others know their own.
            response: `"level"` or `"change"`; needed with draws, a posterior knows its own.
            max_draws: Largest number of draws to follow; they are evenly spaced.

        Raises:
            ShapeError: Draws of another number of robots.
            TrustboError: `TrustParams` without `n_robots`, or other observations than Gaussian.
        """
        if isinstance(posterior, xr.DataTree):
            n_robots = posterior["constant_data"].sizes["robot"]
            response = posterior.attrs["response"]
            if not FAMILIES[family := posterior.attrs["observation"]].integrates_out:
                raise TrustboError(
                    f'TrustFilter needs Gaussian observations; this posterior has "{family}".'
                )
            posterior = params_of(posterior)
        n_robots = posterior.n_robots if n_robots is None else n_robots
        if n_robots is None:
            raise TrustboError("with draws of the parameters, say how many robots: n_robots=.")
        self._n_features = posterior.n_features
        check_params(posterior, n_robots, self._n_features)
        flat = posterior.flat()
        n = len(flat.b)
        kept = np.linspace(0, n - 1, min(n, max_draws)).astype(int)
        self.params = flat.draw(kept)  # pyright: ignore[reportArgumentType]
        self._n_robots = n_robots
        lag = float(require_choice("response", response, RESPONSES) == "change")
        self._core = self.params.live(lag, n_robots)
        self.reset()

    def reset(self) -> None:
        """Go back to before the first bound of a new mission, all draws of equal weight."""
        n = len(self.params.b)
        self._mean, self._var = self._core.start()
        self._log_weight = np.zeros(n)
        self.weights = np.full(n, 1.0 / n)
        self.n_bounds = 0

    @property
    def state(self) -> TrustState:
        """Trust after the bounds so far, shapes (robot,)."""
        return self._average(self._mean, self._var)

    def update(
        self,
        awareness: ArrayLike,
        contact_rate: ArrayLike,
        bound: tuple[Cell, Cell] | None = None,
    ) -> TrustState:
        """Take in one bound.

        Args:
            awareness: Shape (robot, feature).
            contact_rate: Shape (robot,); NaN where not measured.
            bound: Cell left and cell entered; needed where places have effects.

        Returns:
            Trust after it, shapes (robot,).

        Raises:
            ShapeError: Another number of robots or features.
            TrustboError: Awareness that is NaN, a rate outside [0, 1], or a bound that is missing
                or none.
        """
        z, y = self._checked(awareness, 2), np.asarray(contact_rate, dtype=float)
        effect = self._effects(bound, 1)[0]
        if y.shape != (self._n_robots,):
            raise ShapeError(f"contact_rate must be ({self._n_robots},); got shape {y.shape}.")
        if ((y < 0.0) | (y > 1.0)).any():
            raise TrustboError(f"contact_rate must be in [0, 1]; got {y}.")
        self._mean, self._var, increment = self._core.update(self._mean, self._var, z, y, effect)
        self._log_weight += increment
        weights = np.exp(self._log_weight - self._log_weight.max())
        self.weights = weights / weights.sum()
        self.n_bounds += 1
        return self.state

    def predict(self, awareness: ArrayLike, path: Sequence[Cell] | None = None) -> TrustState:
        """Trust along the bounds to come, none of them measured yet.

        Args:
            awareness: Shape (bound, robot, feature).
            path: The cell where the team is and the cells to be entered; needed where places have
                effects.

        Returns:
            Shapes (bound, robot).

        Raises:
            ShapeError: Another number of robots or features.
            TrustboError: Awareness that is NaN.
        """
        mean, var, ahead = self._mean, self._var, []
        zs = self._checked(awareness, 3)
        for z, effect in zip(zs, self._effects(path, len(zs)), strict=True):
            mean, var = self._core.predict(mean, var, z, effect)
            ahead.append(self._average(mean, var))
        return TrustState(*(np.stack(column) for column in zip(*ahead, strict=True)))

    def _effects(self, path: Sequence[Cell] | None, n_bounds: int) -> Sequence[np.ndarray | float]:
        """Effect of each bound's place (draw, robot or 1); 0 where there are none."""
        if not self.params.places:
            return [0.0] * n_bounds
        if path is None or len(path) != n_bounds + 1:
            raise TrustboError(
                f"places have effects: say which {n_bounds + 1} cells the bounds lead over, the "
                f"cell left first; got {path!r}."
            )
        return list(np.moveaxis(self.params.of_places(bounds_along(path)), -2, 0))

    def _average(self, mean: np.ndarray, var: np.ndarray) -> TrustState:
        """Mean and sd of the mixture over draws."""
        var = var if var.ndim == 2 else np.diagonal(var, axis1=1, axis2=2)
        center = self.weights @ mean
        spread = self.weights @ (var + (mean - center) ** 2)
        return TrustState(center, np.sqrt(spread))

    def _checked(self, awareness: ArrayLike, n_axes: int) -> np.ndarray:
        z = np.asarray(awareness, dtype=float)
        expected = (self._n_robots, self._n_features)
        if z.ndim != n_axes or z.shape[-2:] != expected or not len(z):
            raise ShapeError(
                f"awareness must be {'(bound, ' if n_axes == 3 else '('}{expected[0]} robots, "
                f"{expected[1]} features); got shape {z.shape}."
            )
        if np.isnan(z).any():
            raise TrustboError("awareness must not be NaN; take unmeasured values from the map.")
        return z
