"""Place effects: a process s over cells, and effects e of bounds and r of robots in bounds."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar, Self

import numpy as np
import numpyro.distributions as dist
from numpy.typing import ArrayLike
from scipy import sparse
from scipy.linalg import helmert, lapack

from trustbo.data import Mission, sight_columns
from trustbo.errors import require_positive, require_share, require_switch
from trustbo.models.effects.effect import LEAST, Effect, Theta, Values
from trustbo.models.observations import Observations
from trustbo.models.scores import Pair
from trustbo.models.sight_scale import scale_at, variation
from trustbo.models.visited import Visited, bounds_of, maps_of, visited
from trustbo.statespace.matrices import namespace
from trustbo.workspace import MOVES, Workspace

_JITTER = 1e-8  # added to the correlation matrix of cells
_LENGTH_SCALES = (1e-6, 1e6)  # limits in cells, where cells are independent or equal
BETWEEN_POSTS = 0.5
"""Correlation of the effects e of a bound between different sets of posts."""
_LEAST_F_R = 0.1
"""Least floor f_r of the scale of r. With smaller ones, few robots in bounds with whole contact
decide about tau_r, and posteriors have two modes."""


@dataclass(frozen=True)
class PlaceEffect(Effect):
    """Effect of a place on the trust of robots, beyond what awareness explains.

    In the bound from cell a to c, the drift of robot i is ::

        u_i(a -> c) = beta . z_i(a -> c) + b + s(c) + e(a -> c) + r_i(a -> c)

    The effects s, e and r are added to the drift, which has the unit of trust: that of a contact
    rate, or of a logit for the family `"beta_binomial"`. Unless the model has
    `memory="deviation"`, an effect therefore raises stationary trust by its value divided by
    1 - beta0.

    Here s is a Gaussian process over cells with standard deviation tau_s and a Matern 3/2
    covariance. The effects e(a -> c) ~ N(0, g(f_e)^2 tau_e^2) of directed bounds are independent.
    The effects r_i of robots in a bound sum to 0 over the robots: for n robots, they have the
    covariance g(f_r)^2 tau_r^2 (I - 1/n).

    The scale g depends on the mean m of the robots' predicted line of sight in the bound, because
    the map errs less where it predicts no contact or whole contact ::

        g(f)^2 = f^2 + (1 - f^2) 4 m (1 - m)

    The floor f is g where m is 0 or 1. That of robots, f_r = max(f_e, 0.1), is not smaller than
    0.1, because robots also differ where the map is right about the team. Without a feature that
    predicts line of sight, and if trust is a logit, all bounds have the same scale, 1.

    The map is simply wrong about a few bounds. If f_e is below 1, 5 % of the draws of e in a bound
    that was never driven are therefore half-normal with scale 3 tau_e, and move trust towards 0.5.
    The draws are shifted so that their mean remains 0. Fits and planned paths do not change.

    A bound has an effect e, and effects r, for each set of posts from which T2 watches it. The
    effects e of different sets have the correlation 0.5; effects r are independent.

    The errors of awareness differ between robots, and they are the same each time that the robots
    drive a bound. Without r_i, these errors would look like independent noise, and bounds that the
    robots drive repeatedly would seem to be strong evidence for wrong weights. Plans leave out r_i,
    whose mean over the team is 0; forecasts and the trust in single robots include r_i.

    Missions on another map (see `Mission.map`) have other places. The effects of these places are
    independent of those of the workspace, but have the same standard deviations and length scale.

    Attributes:
        tau_s: Scale of the half-normal prior on the standard deviation of s.
        tau_e: Scale of the half-normal prior on the standard deviation of e.
        tau_r: Scale of the half-normal prior on the standard deviation of r.
        length_scale: Median of the log-normal prior on the length scale of s, in cells.
        length_scale_sd: Prior standard deviation of the log length scale.
        f_e: Floor f_e of the scale of e, at most 1. With 1, all bounds have the same scale.

    Raises:
        TrustboError: If a setting is not positive, or `f_e` is above 1.

    Example:
        >>> model = tb.models.PooledTrust(effects=[tb.models.PlaceEffect(tau_s=0.4)])
        >>> posterior = tb.fit(missions, model, workspace=workspace)
        >>> posterior["places"]["place"].mean(("chain", "draw"))  # (effect, row, col)
    """

    tau_s: float = 0.2
    tau_e: float = 0.2
    tau_r: float = 0.1
    length_scale: float = 2.0
    length_scale_sd: float = 0.5
    f_e: float = 0.02
    names = ("tau_s", "length_scale", "tau_e", "tau_r")
    group = "places"
    # The axes are defined in `place_maps.place_group`.
    variables: ClassVar = {"place": (), "place_bound": (), "place_robot": ()}

    def __post_init__(self) -> None:
        super().__post_init__()
        sd = require_positive("PlaceEffect.length_scale_sd", self.length_scale_sd)
        object.__setattr__(self, "length_scale_sd", sd)
        f_e = require_share("PlaceEffect.f_e", require_positive("PlaceEffect.f_e", self.f_e))
        object.__setattr__(self, "f_e", f_e)

    def for_features(self, features: Sequence[str], *, of_rates: bool) -> Self:
        """See `Effect.for_features`; the floor is 1 if trust is a logit."""
        require_switch("of_rates", of_rates)
        return self if of_rates else replace(self, f_e=1.0)

    def hyperpriors(self) -> dict[str, dist.Distribution]:
        """See `Effect.hyperpriors`."""
        length_scale = dist.LogNormal(np.log(self.length_scale), self.length_scale_sd)
        return super().hyperpriors() | {"length_scale": length_scale}

    def pairs(self, observations: Observations) -> list[Pair]:
        """See `Effect.pairs`; data mostly determine differences of s between neighbours.

        Over visited bounds, the effects e have the standard deviation tau_e times the root mean
        square of g, so s divided by this root is compared with tau_e.
        """
        scale = 1.0
        if observations.visited is not None:  # draws from the prior have no places
            scale = float(np.sqrt((_scale(observations, self.f_e) ** 2).mean()))
        factor = partial(_relative_sd, scale=scale)
        return [Pair("tau_s", "tau_e", "length_scale", factor)]

    def add_data(
        self, observations: Observations, missions: Sequence[Mission], on: Workspace | None
    ) -> Observations:
        """See `Effect.add_data`; adds the visited places."""
        shape: Any = None if on is None else on.passable.shape
        n_posts = None if on is None else on.n_posts
        places = visited(bounds_of(missions), shape, maps_of(missions), n_posts)
        return observations._replace(visited=places)

    def design(self, observations: Observations) -> Any:
        """Return indicator columns of the cells entered and of the directed bounds.

        Further columns are contrasts between the robots in each bound; the contrast varies fastest.
        """
        places: Any = observations.visited
        at = np.broadcast_to(places.at[..., None], observations.contact_rate.shape).ravel()
        row = np.flatnonzero(at >= 0)
        bound = at[row]
        cell = places.cell_of[bound]

        ones = np.ones(len(row))
        of_cells = sparse.csr_array((ones, (row, cell)), shape=(len(at), len(places.cells)))
        of_bounds = sparse.csr_array((ones, (row, bound)), shape=(len(at), len(places.bounds)))

        contrast = contrasts(observations.n_robots)
        n_contrasts = contrast.shape[1]
        robot = row % observations.n_robots
        columns = bound[:, None] * n_contrasts + np.arange(n_contrasts)
        of_robots = sparse.csr_array(
            (contrast[robot].ravel(), (np.repeat(row, n_contrasts), columns.ravel())),
            shape=(len(at), len(places.bounds) * n_contrasts),
        )
        return sparse.hstack([of_cells, of_bounds, of_robots], format="csr")

    def prior(self, theta: Theta, observations: Observations) -> tuple[Any, list[Any]]:
        """Return a Gaussian-process prior on cells and independent priors on bounds."""
        xp: Any = namespace(theta["tau_e"])
        places: Any = observations.visited
        sd_e = _scale(observations, self.f_e) * theta["tau_e"][:, None]
        of_bounds = _precision_of_bounds(xp.maximum(sd_e, LEAST), _same_bound(places))

        sd_r = _scale(observations, floor_of_robots(self.f_e)) * theta["tau_r"][:, None]
        of_robot = xp.maximum(sd_r, LEAST) ** -2.0
        of_robots = xp.repeat(of_robot, observations.n_robots - 1, axis=1)

        of_cells = [self._cells(theta, square) for square in places.squares]
        return None, [*of_cells, of_bounds, of_robots]

    def _cells(self, theta: Theta, square: np.ndarray) -> Any:
        """Compute the precision (point, cell, cell) of s from squared distances (cell, cell)."""
        xp: Any = namespace(theta["tau_s"])

        # Squared distances take few distinct values, so the correlation is computed once for each.
        distance = np.sqrt(np.arange(square.max(initial=0) + 1.0))
        scale = xp.clip(theta["length_scale"], *_LENGTH_SCALES)
        K = matern(distance, scale[:, None])[:, square]

        tau = xp.maximum(theta["tau_s"], LEAST)[:, None, None]
        return _inverse(tau**2 * (K + _JITTER * np.eye(len(square))))

    def to_variables(self, c: np.ndarray, theta: Theta, observations: Observations) -> Values:
        """Return `place` (draw, cell), `place_bound` (draw, bound), `place_robot` (.., robot)."""
        places: Any = observations.visited
        contrast = contrasts(observations.n_robots)
        n_bounds = len(places.bounds)
        of_cells, of_bounds, of_robots = np.split(c, np.cumsum([len(places.cells), n_bounds]), 1)
        of_robots = of_robots.reshape(len(c), n_bounds, contrast.shape[1]) @ contrast.T
        return {"place": of_cells, "place_bound": of_bounds, "place_robot": of_robots}

    def coefficients(self, values: Values, theta: Theta, observations: Observations) -> np.ndarray:
        """See `Effect.coefficients`."""
        of_robots = values["place_robot"] @ contrasts(observations.n_robots)
        of_robots = of_robots.reshape(len(of_robots), -1)
        return np.column_stack([values["place"], values["place_bound"], of_robots])


def _same_bound(places: Visited) -> np.ndarray:
    """Return whether visited ways are those of the same bound, shape (bound, bound)."""
    bounds = np.column_stack([places.bound_map, places.bounds])
    bounds[:, 1] %= len(MOVES)
    return (bounds[:, None] == bounds).all(-1)


def _precision_of_bounds(sd: Any, same: np.ndarray) -> Any:
    """Compute the precision of e, (point, bound, bound), or (point, bound) if it is diagonal.

    In the standard deviations sd (point, bound), the n ways of a bound have unit variances and the
    correlation c = `BETWEEN_POSTS`. The inverse of this matrix is
    (I - c / (1 + (n - 1) c) 1 1^T) / (1 - c).
    """
    n_ways = same.sum(1)
    if (n_ways == 1).all():
        return sd**-2.0

    common = BETWEEN_POSTS / (1.0 + (n_ways - 1.0) * BETWEEN_POSTS)
    inverse = (np.eye(len(same)) - common * same) / (1.0 - BETWEEN_POSTS)
    return inverse / (sd[:, :, None] * sd[:, None, :])


def _scale(observations: Observations, floor: float) -> np.ndarray:
    """Return the scale g(floor) of effects in each visited bound, shape (bound,).

    It depends on the mean line of sight in the bound, and is 1 if line of sight is not predicted.
    """
    places: Any = observations.visited
    if not sight_columns(observations.features):
        return np.ones(len(places.bounds))

    there = places.at >= 0
    at = places.at[there]
    sight = observations.line_of_sight.mean(-1)[there]
    n = len(places.bounds)
    return scale_at(variation(np.bincount(at, sight, n) / np.bincount(at, minlength=n)), floor)


def _inverse(A: Any) -> Any:
    """Invert positive definite matrices (point, n, n); in NumPy, other matrices give NaN."""
    xp = namespace(A)
    if xp is not np:
        return xp.linalg.inv(A)

    H = A.copy()
    for one in H:  # `one.T` equals the symmetric `one`, and has LAPACK's memory order
        _, failed = lapack.dpotrf(one.T, lower=1, overwrite_a=1)  # pyright: ignore[reportAttributeAccessIssue]
        if failed:
            one[:] = np.nan
        lapack.dpotri(one.T, lower=1, overwrite_c=1)  # pyright: ignore[reportAttributeAccessIssue]
    return H + np.swapaxes(np.triu(H, 1), 1, 2)


def _relative_sd(length_scale: Any, *, scale: float) -> Any:
    """Compute the sd of s / tau_s in a cell given s in a neighbouring cell, divided by `scale`."""
    xp: Any = namespace(length_scale)
    correlation = matern(1.0, xp.clip(length_scale, *_LENGTH_SCALES))
    return xp.sqrt(xp.maximum((1.0 - correlation) * (1.0 + correlation), _JITTER)) / scale


def floor_of_robots(f_e: float) -> float:
    """Return the floor f_r of the scale of r, given that of e."""
    return max(f_e, _LEAST_F_R)


def contrasts(n: int) -> np.ndarray:
    """Return orthonormal contrasts (robot, contrast) between n robots."""
    return helmert(n).T


def matern(distance: ArrayLike, length_scale: ArrayLike) -> Any:
    """Compute the Matern 3/2 correlation; the distance and the length scale are in cells."""
    xp: Any = namespace(length_scale)
    h = np.sqrt(3.0) * xp.asarray(distance) / xp.asarray(length_scale)
    return (1.0 + h) * xp.exp(-h)
