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
from scipy import sparse
from scipy.linalg import helmert

from trustbo.errors import TrustboError
from trustbo.models.backend import namespace
from trustbo.models.effects.effect import Columns, Effect, Prior, Slots, Theta, hypot, share_of
from trustbo.models.place import PlaceEffect, Visited, matern
from trustbo.models.priors_numpy import half_normal

_JITTER = 1e-12  # of a correlation, times the number of cells: below, rounding decides
_TOGETHER = 16  # points whose cells are split at once
_LENGTH_SCALES = 1e-6, 1e6  # cells: outside, cells are independent, or equal


@dataclass(frozen=True)
class Place(PlaceEffect, Effect):  # pyright: ignore[reportIncompatibleVariableOverride]
    """Effect of a place, see `PlaceEffect`, as an effect among others."""

    def scales(self, scores: np.ndarray) -> dict[str, np.ndarray]:
        """See `Effect.scales`."""
        xp: Any = namespace(scores)
        taus = [i for i, name in enumerate(self.names) if name != "length_scale"]
        values = half_normal(
            scores[:, taus], np.array([getattr(self, self.names[i]) for i in taus])
        )
        named = {self.names[i]: value for i, value in zip(taus, values.T, strict=True)}
        if self.cells:
            score = scores[:, self.names.index("length_scale")]
            length_scale = self.length_scale * xp.exp(self.length_scale_sd * score)
            named["length_scale"] = xp.clip(length_scale, *_LENGTH_SCALES)
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
