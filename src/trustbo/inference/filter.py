"""Trust in real time, bound by bound or tick by tick of a running mission."""

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from trustbo.arrays import as_array, require_unit_interval
from trustbo.bound import require_shares
from trustbo.data import Cell
from trustbo.errors import (
    ShapeError,
    TrustboError,
    one_line,
    require_choice,
    require_pair,
    require_whole,
)
from trustbo.inference.draws import params_of
from trustbo.inference.evidence.live import Effect, Rates, live_filter
from trustbo.inference.posterior_tree import of_no_map, require_posterior
from trustbo.inference.samplers.weights import systematic
from trustbo.models.families import FAMILIES, Family
from trustbo.models.params import Params, check_params
from trustbo.models.ticks import broadcast_ticks
from trustbo.workspace.moves import bounds_along, moves_along, require_on_grid


class TrustState(NamedTuple):
    """Mean and sd of trust, averaged over parameter draws."""

    mean: np.ndarray
    """Shape (robot,) now, or (bound, robot) ahead."""
    sd: np.ndarray
    """Standard deviation, of the same shape."""


class TrustForecast(NamedTuple):
    """Trust and contact rates along bounds to come, averaged over parameter draws."""

    mean: np.ndarray
    """Mean of trust, (bound, robot)."""
    sd: np.ndarray
    """Standard deviation of trust."""
    rate: np.ndarray
    """Mean contact rate."""
    rate_low: np.ndarray
    """5 % quantile of the contact rate."""
    rate_high: np.ndarray
    """95 % quantile of the contact rate."""
    draws: np.ndarray
    """Contact rates drawn together for all bounds, of equal weight, (draw, bound, robot)."""


class TrustFilter:
    """Follows the trust of each robot during a mission (a Rao-Blackwellised filter).

    Given a draw of the parameters, trust under Gaussian rates is Gaussian and the Kalman filter
    exact; under other families its moments are matched after each rate (assumed-density filtering).
    The draws themselves are reweighted by the density with which they predicted each contact rate.
    So after bound k the filter holds p(trust, parameters | earlier missions, bounds 1..k), exactly
    but for the number of draws and the moments.

    A bound is taken in when it is over, by `update`; or while it runs, tick by tick, by
    `begin_bound`, `update_tick` or `update_ticks`, and `end_bound`: each tick gives the trust if
    the bound ended now.

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
        observation: str | None = None,
        max_draws: int = 1000,
    ) -> None:
        """Start before the first bound of a mission.

        Args:
            posterior: DataTree from `fit`, or draws with leading axis (draw,).
            n_robots: Number of robots; needed with `TrustParams`, which all robots share.
            observation: Family of observations, with draws; `"gaussian"` by default. A posterior
                records it.
            max_draws: Largest number of draws to follow; they are evenly spaced.

        Raises:
            ShapeError: Draws or a posterior of another number of robots or features.
            TrustboError: No posterior, `TrustParams` without `n_robots`, an unknown
                family, or one that is not the posterior's.
        """
        self._bounded = True
        if isinstance(posterior, xr.DataTree):
            require_posterior("TrustFilter", posterior)
            self._bounded = not of_no_map(posterior)
            recorded = _robots_of(posterior)
            if n_robots is not None and recorded not in (None, n_robots):
                raise ShapeError(
                    f"the posterior is of {recorded} robots; got n_robots={n_robots!r}. "
                    "Leave it out."
                )
            n_robots = n_robots if recorded is None else recorded
            observation = _of_posterior(posterior, "observation", observation)
            posterior = params_of(posterior, day=True)
        elif not isinstance(posterior, Params):
            raise TrustboError(
                "a filter follows a posterior of fit, or draws of parameters; got "
                f"{one_line(posterior)}. Before its first mission a campaign has no posterior: "
                "take its `belief`."
            )
        n_robots = posterior.n_robots if n_robots is None else n_robots
        if n_robots is None:
            raise TrustboError("with draws of the parameters, say how many robots: n_robots=.")
        n_robots = require_whole("n_robots", n_robots, 1)
        self._n_features = posterior.n_features
        check_params(posterior, n_robots, self._n_features)
        flat = posterior.flat()
        n, most = len(flat.b), require_whole("max_draws", max_draws, 1)
        kept = np.linspace(0, n - 1, min(n, most)).astype(int)
        self.params = flat.draw(kept)  # pyright: ignore[reportArgumentType]
        self._n_robots = n_robots
        family = require_choice("observation", observation or "gaussian", FAMILIES)
        self._family = FAMILIES[family]
        self._core = live_filter(self.params, n_robots)
        self._grids = {np.shape(value)[-2:] for value in self.params.places.values()}
        self.reset()

    def reset(self) -> None:
        """Go back to before the first bound of a new mission, all draws of equal weight."""
        n = len(self.params.b)
        self._mean, self._var = self._core.start()
        self._log_weight = np.zeros(n)
        self.weights = np.full(n, 1.0 / n)
        self.n_bounds, self._running = 0, None
        self._behind: tuple[Any, ...] = ()  # awareness and effect of the bound before

    @property
    def state(self) -> TrustState:
        """Trust after the bounds so far, shapes (robot,)."""
        return self._average(self._core.trust(self._mean, *self._behind), self._var)

    def update(
        self,
        awareness: ArrayLike,
        contact_rate: ArrayLike,
        bound: tuple[Cell, Cell] | None = None,
        *,
        n_ticks: ArrayLike | None = None,
    ) -> TrustState:
        """Take in one bound.

        Args:
            awareness: Shape (robot, feature).
            contact_rate: Shape (robot,); NaN where not measured.
            bound: Cell left and cell entered; needed where places have effects.
            n_ticks: Ticks of the bound, () or (robot,); the beta-binomial family needs them.

        Returns:
            Trust after it, shapes (robot,).

        Raises:
            ShapeError: Another number of robots or features.
            TrustboError: Awareness that is NaN, a value outside [0, 1], ticks that are missing or
                of which the rate is no share, a bound that is missing, off the grid or between
                cells that are no neighbours, or one that is running.
        """
        self._require_running(running=False)
        z, effect = self._bound(awareness, bound)
        y = self._by_robot("contact_rate", contact_rate)
        if n_ticks is not None:
            n_ticks = as_array("n_ticks", n_ticks)
            n_ticks = n_ticks if n_ticks.ndim else np.full(y.shape, n_ticks)
            require_shares(y, n_ticks)
        ticks = broadcast_ticks(self._family, n_ticks, y.shape)
        self._commit(z, effect, Rates(self._family, y, ticks))
        return self.state

    def begin_bound(self, awareness: ArrayLike, bound: tuple[Cell, Cell] | None = None) -> None:
        """Begin a bound, before its ticks (`update_tick`); arguments as those of `update`."""
        self._require_running(running=False)
        z, effect = self._bound(awareness, bound)
        self._running = _Running(z, effect, *np.zeros((2, self._n_robots)))

    def update_tick(self, in_contact: ArrayLike) -> TrustState:
        """Take in one tick of the bound that runs.

        Args:
            in_contact: Whether each robot has contact, (robot,); NaN where it was not measured.

        Returns:
            Trust after the bound if it ended now, with the rate so far; shapes (robot,).

        Raises:
            ShapeError: Another number of robots.
            TrustboError: No bound was begun, or a value outside [0, 1].
        """
        self._require_running(running=True)
        seen = self._by_robot("in_contact", in_contact)
        return self.update_ticks(np.nan_to_num(seen), ~np.isnan(seen))

    def update_ticks(self, n_contact: ArrayLike, n_ticks: ArrayLike) -> TrustState:
        """Take in several ticks of the bound that runs, as `update_tick` would one by one.

        Args:
            n_contact: Number of these ticks with contact, (robot,).
            n_ticks: Number of ticks measured, (robot,).

        Returns:
            Trust after the bound if it ended now, with the rate so far; shapes (robot,).

        Raises:
            ShapeError: Another number of robots.
            TrustboError: No bound was begun, a number that is negative or NaN, or more ticks with
                contact than ticks.
        """
        running = self._require_running(running=True)
        contacts, ticks = as_array("n_contact", n_contact), as_array("n_ticks", n_ticks)
        for name, numbers in (("n_contact", contacts), ("n_ticks", ticks)):
            if numbers.shape != (self._n_robots,):
                raise ShapeError(f"{name} must be ({self._n_robots},); got shape {numbers.shape}.")
        if not ((contacts >= 0.0) & (contacts <= ticks)).all():
            raise TrustboError(
                f"n_contact must be from 0 to n_ticks; got {contacts} of {ticks} ticks."
            )
        running.contacts[:] += contacts
        running.ticks[:] += ticks
        mean, var, increment = self._core.update(
            self._mean, self._var, running.z, running.rates(self._family), running.effect
        )
        trust = self._core.trust(mean, running.z, running.effect)
        return self._average(trust, var, _normalised(self._log_weight + increment))

    def end_bound(self) -> TrustState:
        """End the bound that runs: its rate is taken in as `update` would.

        Raises:
            TrustboError: No bound was begun.
        """
        running = self._require_running(running=True)
        self._running = None
        self._commit(running.z, running.effect, running.rates(self._family))
        return self.state

    def predict(
        self,
        awareness: ArrayLike,
        path: Sequence[Cell] | None = None,
        *,
        n_ticks: ArrayLike = 200,
    ) -> TrustForecast:
        """Trust and contact rates along the bounds to come, none of them measured yet.

        Rates are drawn, one for each parameter draw.

        Args:
            awareness: Shape (bound, robot, feature).
            path: The cell where the team is and the cells to be entered; needed where places have
                effects.
            n_ticks: Ticks of the bounds, (), (bound,) or (bound, robot), where rates are counts.

        Returns:
            Shapes (bound, robot), and draws (draw, bound, robot).

        Raises:
            ShapeError: Another number of robots, features or ticks.
            TrustboError: Awareness that is NaN or outside [0, 1], ticks that are no whole numbers,
                or a path that is missing, of another length, that jumps or that leaves the grid.
        """
        mean, var, ahead = self._mean, self._var, []
        given, rng = self._checked(awareness, 3), np.random.default_rng(self.n_bounds)
        ticks = ticks_ahead(n_ticks, given.shape[:2])
        cells = self._cells(path, len(given))
        x, drawn = self._core.draw(rng, mean, var), []
        for z, effect, n in zip(given, self._effects(cells, len(given)), ticks, strict=True):
            mean, var = self._core.predict(mean, var, z, effect)
            x, rates = self._core.roll(rng, self._family, x, z, effect, n)
            drawn.append(rates)
            order = np.argsort(rates, axis=0)
            below = np.cumsum(self.weights[order], axis=0)
            low, high = (np.argmax(below >= share, axis=0) for share in (0.05, 0.95))
            ranked = np.take_along_axis(rates, order, axis=0)
            robots = np.arange(self._n_robots)
            forecast = self.weights @ rates, ranked[low, robots], ranked[high, robots]
            trust = self._core.trust(mean, z, effect)
            ahead.append((*self._average(trust, var), *forecast))
        columns = (np.stack(column) for column in zip(*ahead, strict=True))
        chosen = systematic(self.weights, len(self.weights), rng)
        return TrustForecast(*columns, draws=np.stack(drawn, axis=1)[chosen])

    def _commit(self, z: np.ndarray, effect: Effect, rates: Rates) -> None:
        predicted = self._mean, self._var, z, rates, effect
        self._mean, self._var, increment = self._core.update(*predicted)
        self._log_weight = self._log_weight + increment  # a copy of the filter keeps its own
        self.weights = _normalised(self._log_weight)
        self.n_bounds, self._behind = self.n_bounds + 1, (z, effect)

    def _require_running(self, *, running: bool) -> Any:
        """Running bound, or None; TrustboError unless a bound runs as `running` asks."""
        if running and self._running is None:
            raise TrustboError("no bound runs: call begin_bound(awareness) first.")
        if not running and self._running is not None:
            raise TrustboError("a bound runs: call end_bound() first.")
        return self._running

    def _cells(self, path: Sequence[Cell] | None, n_bounds: int) -> list[Cell] | None:
        """Cells of a path of `n_bounds` bounds, checked; None where there is no path."""
        if path is None:
            return None
        path = list(path) if isinstance(path, Iterable) else []
        if len(path) != n_bounds + 1:
            raise TrustboError(
                f"say which {n_bounds + 1} cells the {n_bounds} bounds lead over, the cell left "
                f"first; got {path!r}."
            )
        cells = [require_pair("a cell", cell) for cell in path]
        for shape in self._grids:
            require_on_grid(cells, shape)
        moves_along(cells)
        return cells

    def _effects(self, cells: Sequence[Cell] | None, n_bounds: int) -> Sequence[np.ndarray | float]:
        """Effect of each bound's place (draw, robot or 1); 0 where there are none."""
        if not self.params.places:
            return [0.0] * n_bounds
        if cells is None:
            raise TrustboError(
                f"places have effects: say which {n_bounds + 1} cells the bounds lead over, the "
                "cell left first."
            )
        return list(np.moveaxis(self.params.of_places(bounds_along(cells)), -2, 0))

    def _average(
        self, mean: np.ndarray, var: np.ndarray, weights: np.ndarray | None = None
    ) -> TrustState:
        """Mean and sd of the mixture over draws."""
        weights = self.weights if weights is None else weights
        var = var if var.ndim == 2 else np.diagonal(var, axis1=1, axis2=2)
        center = weights @ mean
        spread = weights @ (var + (mean - center) ** 2)
        return TrustState(center, np.sqrt(spread))

    def _checked(self, awareness: ArrayLike, n_axes: int) -> np.ndarray:
        z = as_array("awareness", awareness)
        expected = (self._n_robots, self._n_features)
        if z.ndim != n_axes or z.shape[-2:] != expected or not len(z):
            raise ShapeError(
                f"awareness must be {'(bound, ' if n_axes == 3 else '('}{expected[0]} robots, "
                f"{expected[1]} features); got shape {z.shape}."
            )
        if np.isnan(z).any():
            raise TrustboError(
                "awareness must not be NaN; take unmeasured values from the map: "
                "campaign.known_along(path), or workspace.along(path), (bound, robot, feature)."
            )
        if self._bounded:
            require_unit_interval("awareness", z)
        return z

    def _by_robot(self, what: str, values: ArrayLike) -> np.ndarray:
        """Values of the robots, in [0, 1] or NaN."""
        array = as_array(what, values)
        if array.shape != (self._n_robots,):
            raise ShapeError(f"{what} must be ({self._n_robots},); got shape {array.shape}.")
        require_unit_interval(what, array)
        return array

    def _bound(
        self, awareness: ArrayLike, bound: tuple[Cell, Cell] | None
    ) -> tuple[np.ndarray, np.ndarray | float]:
        """Awareness of a bound, (robot, feature), and its effect."""
        return self._checked(awareness, 2), self._effects(self._cells(bound, 1), 1)[0]


class _Running(NamedTuple):
    """A bound that runs."""

    z: np.ndarray  # (robot, feature)
    effect: Effect
    contacts: np.ndarray  # (robot,), ticks in contact
    ticks: np.ndarray  # (robot,)

    def rates(self, family: Family) -> Rates:
        """Rates so far."""
        with np.errstate(invalid="ignore"):
            return Rates(family, self.contacts / self.ticks, self.ticks)


def _robots_of(posterior: xr.DataTree) -> int | None:
    """Number of robots; None where version 0.2.0 kept parameters alone, which all share."""
    if "constant_data" in posterior.children:
        return posterior["constant_data"].sizes["robot"]
    return posterior.attrs.get("n_robots")


def _of_posterior(posterior: xr.DataTree, name: str, given: str | None) -> str:
    """Observation of the posterior; TrustboError if another is given."""
    recorded = posterior.attrs[name]
    if given not in (None, recorded):
        raise TrustboError(f"the posterior has {name}={recorded!r}; got {given!r}. Leave it out.")
    return recorded


def ticks_ahead(n_ticks: ArrayLike, shape: tuple[int, int]) -> np.ndarray:
    """Ticks of bounds to come as (bound, robot); ShapeError, TrustboError if they are none."""
    given = as_array("n_ticks", n_ticks)
    given = given[:, None] if given.ndim == 1 else given
    if given.ndim > 2 or any(n not in (1, m) for n, m in zip(given.shape, shape, strict=False)):
        raise ShapeError(f"n_ticks must be (), (bound,) or {shape}; got shape {given.shape}.")
    if not ((given >= 1.0) & (given == np.round(given))).all():
        raise TrustboError(f"n_ticks must be whole numbers of ticks from 1; got {given.min():g}.")
    return np.broadcast_to(given, shape)


def _normalised(log_weight: np.ndarray) -> np.ndarray:
    weights = np.exp(log_weight - log_weight.max())
    return weights / weights.sum()
