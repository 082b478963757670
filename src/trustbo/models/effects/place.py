"""Effects of places: s of the cell entered, and e of the directed bound.

The sum g = B s + e of visited bounds has covariance tau_e^2 I + tau_s^2 B K B', B naming the cell
that each enters. Helmert's rotation of the n_c bounds into each cell, independent of theta, leaves

    mean of each cell times sqrt(n_c): covariance tau_e^2 I + tau_s^2 W K W, W = diag(sqrt(n_c)),
    contrasts between its bounds:      independent, of variance tau_e^2,

so that D bounds cost the root of a matrix of C cells, and neither tau is ever inverted.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpyro.distributions as dist
from scipy import sparse
from scipy.linalg import helmert

from trustbo.errors import TrustboError, require_positive
from trustbo.models.backend import namespace
from trustbo.models.effects.effect import Columns, Effect, Prior, Slots, Theta, hypot, share_of
from trustbo.models.place import Visited, matern
from trustbo.models.priors_numpy import half_normal

_JITTER = 1e-12  # of a correlation, times the number of cells: below, rounding decides
_TOGETHER = 16  # points whose cells are split at once
_LENGTH_SCALES = 1e-6, 1e6  # cells: outside, cells are independent, or equal
_MOST = {
    "length_scale": (1000.0, "cells, not metres"),
    "length_scale_sd": (3.0, "the logarithm of a length scale"),
}


@dataclass(frozen=True)
class PlaceEffect(Effect):
    """Effect of a place on trust that awareness does not explain.

    The drift of trust by the bound from cell a to cell c is u(a -> c) = beta . z(a -> c) + b + s(c)
    + e(a -> c). s is a Gaussian process over cells, of sd tau_s and covariance Matern 3/2 with a
    length scale in cells; e(a -> c) ~ N(0, tau_e^2), independent for each directed bound.

    Attributes:
        cells: Whether the model has s.
        bounds: Whether the model has e.
        shared: Whether all robots share s and e; else each robot has separate ones, with the same
            tau_s, tau_e and length scale.
        tau_s: Scale of the half-normal prior of the sd of s.
        tau_e: Scale of the half-normal prior of the sd of e.
        length_scale: Median of the log-normal prior of the length scale, in cells.
        length_scale_sd: Its standard deviation, of the logarithm.

    Raises:
        TrustboError: Neither cells nor bounds have an effect, or a number is not positive or far
            too large.
    """

    cells: bool = True
    bounds: bool = True
    shared: bool = True
    tau_s: float = 0.2
    tau_e: float = 0.2
    length_scale: float = 2.0
    length_scale_sd: float = 0.5

    def __post_init__(self) -> None:
        for name in ("cells", "bounds", "shared"):
            if not isinstance(value := getattr(self, name), bool | np.bool_):
                raise TrustboError(f"PlaceEffect.{name} must be True or False; got {value!r}.")
        if not (self.cells or self.bounds):
            raise TrustboError(
                "PlaceEffect needs an effect of cells or of bounds; for neither, give place=None."
            )
        for name in ("tau_s", "tau_e", "length_scale", "length_scale_sd"):
            value = require_positive(f"PlaceEffect.{name}", getattr(self, name))
            most, scale = _MOST.get(name, (100.0, "trust, which is between 0 and 1"))
            if value > most:
                raise TrustboError(
                    f"PlaceEffect.{name} = {value:g} exceeds {most:g}: it is of {scale}."
                )

    @property
    def names(self) -> tuple[str, ...]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Names of the hyperparameters: tau_s and length_scale of s, tau_e of e."""
        return ("tau_s", "length_scale") * self.cells + ("tau_e",) * self.bounds

    def draw(self, n: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
        """See `Effect.draw`."""
        scores = rng.standard_normal((3, n))
        drawn = {
            "tau_s": self.tau_s * np.abs(scores[0]),
            "length_scale": self.length_scale * np.exp(self.length_scale_sd * scores[1]),
            "tau_e": self.tau_e * np.abs(scores[2]),
        }
        return {name: drawn[name] for name in self.names}

    def hyperpriors(self) -> dict[str, dist.Distribution]:
        """See `Effect.hyperpriors`."""
        priors = {
            "tau_s": dist.HalfNormal(self.tau_s),
            "length_scale": dist.LogNormal(np.log(self.length_scale), self.length_scale_sd),
            "tau_e": dist.HalfNormal(self.tau_e),
        }
        return {name: priors[name] for name in self.names}

    def in_short(self) -> str:
        """Places that have effects, and whether robots share them."""
        places = " and ".join(["cells"] * self.cells + ["bounds"] * self.bounds)
        return f"of {places}, {'shared by robots' if self.shared else 'by robot'}"

    def scales(self, scores: np.ndarray) -> dict[str, np.ndarray]:
        """See `Effect.scales`."""
        xp: Any = namespace(scores)
        named = {}
        for name, score in zip(self.names, scores.T, strict=True):
            if name == "length_scale":
                length_scale = self.length_scale * xp.exp(self.length_scale_sd * score)
                named[name] = xp.clip(length_scale, *_LENGTH_SCALES)
            else:
                named[name] = half_normal(score, getattr(self, name))
        return named

    def group(self, slots: Slots) -> "PlaceColumns":
        """See `Effect.group`.

        Raises:
            TrustboError: Visited places are not given.
        """
        if slots.places is None:
            raise TrustboError("effects of places need the visited places; got None.")
        return PlaceColumns.of(self, slots, slots.places)


class PlaceColumns(NamedTuple):
    """Rotated indicators of visited places: means of cells first, then contrasts, by robot."""

    columns: Columns
    rotation: Columns  # (column, unit), orthogonal
    cells: "tuple[_Cells, ...]"
    """One for each robot with separate effects."""
    place: PlaceEffect
    visited: Visited
    fades = False

    @classmethod
    def of(cls, place: PlaceEffect, slots: Slots, visited: Visited) -> "PlaceColumns":
        """Columns of some slots."""
        shared = visited.unit.shape[2] == 1
        robot = np.zeros_like(slots.robot) if shared else slots.robot
        unit = visited.unit[slots.mission, : slots.y.shape[1], robot].ravel()
        met = np.flatnonzero(unit >= 0)
        shape = len(unit), len(visited.units)
        indicator = sparse.csr_array((np.ones(len(met)), (met, unit[met])), shape=shape)
        rotation, cells = _rotation(visited)
        columns = (indicator @ rotation.T).tocsr()
        return cls(columns, rotation, cells, place, visited)

    @property
    def joined(self) -> list[slice]:
        """Means of the cells of each robot."""
        return [slice(c.first, c.first + len(c.w)) for c in self.cells if self.place.cells]

    def prior(self, theta: Theta) -> Prior:
        """Gaussian process over the cells' means, independent contrasts."""
        xp: Any = namespace(theta["beta0"])
        n, place = len(theta["beta0"]), self.place
        tau_e = theta["tau_e"] if place.bounds else xp.zeros(n)
        mean = np.zeros((n, self.columns.shape[1]))
        if not place.cells:
            return Prior(mean, xp.repeat(tau_e[:, None], mean.shape[1], axis=1))
        tau_s, roots, sds = theta["tau_s"], [], []
        scale = hypot(tau_s, tau_e)
        share = share_of(tau_s, scale)[:, None, None]
        stops = [cells.first for cells in self.cells[1:]] + [mean.shape[1]]
        for cells, stop in zip(self.cells, stops, strict=True):
            first, w = cells.first, cells.w
            eye, K = np.eye(len(w)), cells.correlation(theta["length_scale"])
            C = share * (w[:, None] * w * K) + (1.0 - share + _JITTER * len(w) * w.max() ** 2) * eye
            roots.append(xp.linalg.cholesky(C))
            sds.append(xp.repeat(scale[:, None], len(w), axis=1))
            sds.append(xp.repeat(tau_e[:, None], stop - first - len(w), axis=1))
        return Prior(mean, xp.concatenate(sds, axis=1), roots)

    def name(self, c: np.ndarray, theta: Theta, rng: np.random.Generator) -> dict[str, np.ndarray]:
        """Effects of cells, place (draw, cell), and of bounds, place_bound (draw, unit)."""
        return split_units(self.place, self.visited, c @ self.rotation, theta, rng)


def split_units(
    place: PlaceEffect, visited: Visited, g: np.ndarray, theta: Theta, rng: np.random.Generator
) -> dict[str, np.ndarray]:
    """Effects of cells, place (draw, cell), and of bounds, place_bound (draw, unit), of their sums.

    Args:
        place: Effects in the model.
        visited: Visited places.
        g: Sums of the effects of visited bounds (draw, unit).
        theta: Hyperparameters by name, each (draw,).
        rng: Random number generator.
    """
    if not place.bounds:
        return {"place": g}
    if not place.cells:
        return {"place_bound": g}
    s = np.empty((len(g), len(visited.cells)))
    theta_of = np.stack([theta[name] for name in ("tau_s", "length_scale", "tau_e")], axis=1)
    values, point, count = np.unique(theta_of, axis=0, return_inverse=True, return_counts=True)
    order, start = np.argsort(point.ravel(), kind="stable"), np.cumsum(count) - count
    rotation, robots = _rotation(visited)
    c = g @ rotation.T
    by_count = np.argsort(-count)
    for i in range(0, len(values), _TOGETHER):  # points of about as many draws
        some = by_count[i : i + _TOGETHER]
        of_point = np.arange(count[some].max())
        there = of_point < count[some, None]
        draw = order[np.where(there, start[some, None] + of_point, 0)]
        for robot, cells in zip(np.unique(visited.cells[:, 0]), robots, strict=True):
            mean = c[draw, cells.first : cells.first + len(cells.w)]
            drawn = _split(mean, cells, values[some], rng)
            s[draw[there][:, None], np.flatnonzero(visited.cells[:, 0] == robot)] = drawn[there]
    return {"place": s, "place_bound": g - s[:, visited.cell_of]}


class _Cells(NamedTuple):
    """Visited cells of a robot."""

    first: int  # column
    distance: np.ndarray  # (distinct,), in cells
    pair: np.ndarray  # (cell, cell), index of the distance between two
    w: np.ndarray  # (cell,), root of the number of bounds into each

    @classmethod
    def of(cls, first: int, position: np.ndarray, n_bounds: np.ndarray) -> "_Cells":
        """Cells at positions (cell, 2)."""
        gap = np.abs(position[:, None] - position[None])
        square, pair = np.unique((gap**2).sum(-1), return_inverse=True)
        return cls(first, np.sqrt(square), pair.reshape(gap.shape[:2]), np.sqrt(n_bounds))

    def correlation(self, length_scale: Any) -> Any:
        """Correlation of s between cells (point, cell, cell), of length scales (point,)."""
        return matern(self.distance, length_scale[:, None])[:, self.pair]


def _rotation(visited: Visited) -> tuple[Columns, tuple[_Cells, ...]]:
    """Helmert's rotation within each cell (column, unit), and the cells of each robot."""
    rows, cols, values, cells, start = [], [], [], [], 0
    for robot in np.unique(visited.cells[:, 0]):
        mine = np.flatnonzero(visited.cells[:, 0] == robot)
        position, n_units = visited.cells[mine, 1:].astype(float), []
        contrast = start + len(mine)
        for i, cell in enumerate(mine):
            units = np.flatnonzero(visited.cell_of == cell)
            n_units.append(len(units))
            of_cell = np.append(start + i, contrast + np.arange(len(units) - 1))
            contrast += len(units) - 1
            at_row, at_col = np.meshgrid(of_cell, units, indexing="ij")
            rows.append(at_row.ravel())
            cols.append(at_col.ravel())
            values.append(helmert(len(units), full=True).ravel())
        cells.append(_Cells.of(start, position, np.array(n_units)))
        start = contrast
    entries = np.concatenate(rows), np.concatenate(cols)
    shape = start, len(visited.units)
    return sparse.csr_array((np.concatenate(values), entries), shape=shape), tuple(cells)


def _split(
    mean: np.ndarray, cells: _Cells, theta: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """S (point, draw, cell) given means w s + e of cells, by Matheron's rule.

    A prior draw is corrected by its misfit; theta is (point, 3).
    """
    tau_s, _, tau_e = theta.T[:, :, None, None]
    w, eye = cells.w, np.eye(len(cells.w))
    unit = np.where(tau_s > 0.0, tau_s, 1.0)
    ratio = (tau_e / unit) ** 2
    K = cells.correlation(theta[:, 1]) + _JITTER * len(w) * eye
    s = rng.standard_normal(mean.shape) @ np.swapaxes(np.linalg.cholesky(K), 1, 2)
    off = mean / unit - w * s - np.sqrt(ratio) * rng.standard_normal(mean.shape)
    M = w[:, None] * w * K + ratio * eye
    gain = np.swapaxes(np.linalg.solve(M, np.swapaxes(off, 1, 2)), 1, 2)
    return tau_s * (s + gain @ (w[:, None] * K))
