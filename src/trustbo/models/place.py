"""Effects of places on trust, and the index of the places that missions visited."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np
import numpyro.distributions as dist
from numpy.typing import ArrayLike

from trustbo.data import Mission, require_map
from trustbo.errors import TrustboError, require_positive
from trustbo.models.backend import namespace
from trustbo.workspace.moves import MOVES, bounds_along

N_MOVES = len(MOVES[8])
MAX_VISITED = 4000
"""Largest number of visited bounds: the effort grows with its cube."""

_MOST = {
    "length_scale": (1000.0, "cells, not metres"),
    "length_scale_sd": (3.0, "the logarithm of a length scale"),
}


@dataclass(frozen=True)
class PlaceEffect:
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
    def names(self) -> tuple[str, ...]:
        """Names of the hyperparameters: tau_s and length_scale of s, tau_e of e."""
        return ("tau_s", "length_scale") * self.cells + ("tau_e",) * self.bounds

    def draw(self, n: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
        """Draws of the hyperparameters from their prior, each (draw,), by name."""
        scores = rng.standard_normal((3, n))
        drawn = {
            "tau_s": self.tau_s * np.abs(scores[0]),
            "length_scale": self.length_scale * np.exp(self.length_scale_sd * scores[1]),
            "tau_e": self.tau_e * np.abs(scores[2]),
        }
        return {name: drawn[name] for name in self.names}

    def hyperpriors(self) -> dict[str, dist.Distribution]:
        """Priors of the hyperparameters, by name."""
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

    def to_record(self) -> dict[str, Any]:
        """Fields by name, for JSON."""
        return asdict(self)


class Visited(NamedTuple):
    """Cells entered and directed bounds made by some missions.

    A place is a robot, a cell, and for bounds the move into it; the robot is 0 where all share the
    effects. A unit is a visited bound, or a visited cell where bounds have no effect.
    """

    shape: tuple[int, int]  # rows and columns of the grid
    cells: np.ndarray  # (cell, 3): robot, row, col, in order
    units: np.ndarray  # (unit, 4): robot, move, row, col, in order; move -1 where units are cells
    cell_of: np.ndarray  # (unit,), index among the visited cells
    unit: np.ndarray  # (mission, bound, robot), -1 in the padding

    @property
    def n_effects(self) -> int:
        """Number of robots with separate effects, 1 where all share them."""
        return 1 if self.unit.shape[2] == 1 else int(self.unit.shape[2])


def bounds_of(missions: Sequence[Mission], shape: tuple[int, int] | None = None) -> np.ndarray:
    """Move, row and column of each mission's bounds, (mission, bound, 3), -1 in the padding.

    `shape`, missions and bounds, is that with the padding, by default without. TrustboError: a path
    jumps, so that it has no directed bounds, or a mission has no map.
    """
    require_map("a model with effects of places", missions)
    if shape is None:
        shape = len(missions), max(len(mission.bounds) for mission in missions)
    bounds = np.full((*shape, 3), -1)
    for j, mission in enumerate(missions):
        path = mission.path[: len(mission.bounds) + 1]  # a failed mission did not run the rest
        try:
            bounds[j, : len(mission.bounds)] = bounds_along(path)
        except TrustboError as error:
            raise TrustboError(
                f"mission {j}: {error} A model with place effects needs whole paths; give "
                "place=None, or split the mission there."
            ) from None
    return bounds


def places_of(
    missions: Sequence[Mission],
    place: PlaceEffect | None,
    shape: tuple[int, ...],
    grid: tuple[int, int] | None = None,
) -> Visited | None:
    """Places of missions, see `visited`; None where these have no effects.

    `shape` is that of the rates, (mission, bound, robot), with the padding.
    """
    if place is None:
        return None
    return visited(bounds_of(missions, shape[:2]), place, shape[2], grid)  # pyright: ignore


def visited(
    bounds: np.ndarray,
    place: PlaceEffect,
    n_robots: int,
    shape: tuple[int, int] | None = None,
) -> Visited:
    """Index the places of bounds (mission, bound, 3), see `bounds_of`.

    Args:
        bounds: Move, row and column, -1 in the padding.
        place: Effects in the model.
        n_robots: Number of robots.
        shape: Rows and columns of the grid; by default the fewest that hold all cells.

    Raises:
        TrustboError: A cell lies outside the grid, or there are too many bounds for one dense
            factor.
    """
    there = bounds[..., 0] >= 0
    least = tuple((bounds[there].max(0)[1:] + 1).tolist()) if there.any() else (1, 1)
    shape = least if shape is None else shape
    if any(have > rows for have, rows in zip(least, shape, strict=True)):
        j, k = np.argwhere(there & (bounds[..., 1:] >= shape).any(-1))[0]
        raise TrustboError(
            f"mission {j} enters the cell {tuple(bounds[j, k, 1:].tolist())}, outside the grid of "
            f"{shape[0]} rows and {shape[1]} columns; give the workspace the missions were run on."
        )
    n_effects = 1 if place.shared else n_robots
    robot = np.broadcast_to(np.arange(n_effects), (*there.shape, n_effects))
    move = bounds[..., 0] if place.bounds else np.where(there, -1, -2)
    four = np.stack(np.broadcast_arrays(robot, *(column[..., None] for column in (
        move, bounds[..., 1], bounds[..., 2]))), axis=-1)  # fmt: skip
    units, index = np.unique(four[there].reshape(-1, 4), axis=0, return_inverse=True)
    if len(units) > MAX_VISITED:
        raise TrustboError(
            f"{len(units)} visited places are more than {MAX_VISITED}, the most that one dense "
            "factor takes. Give coarser cells, PlaceEffect(bounds=False), shared=True, or "
            "place=None."
        )
    cells, cell_of = np.unique(units[:, [0, 2, 3]], axis=0, return_inverse=True)
    unit = np.full((*there.shape, n_effects), -1)
    unit[there] = index.reshape(-1, n_effects)
    return Visited(shape, cells, units, cell_of.ravel(), unit)


def matern(distance: ArrayLike, length_scale: ArrayLike) -> np.ndarray:
    """Matern 3/2 correlation at a distance, both in cells."""
    xp: Any = namespace(length_scale)
    h = np.sqrt(3.0) * xp.asarray(distance) / xp.asarray(length_scale)
    return (1.0 + h) * xp.exp(-h)


def correlation(cells: np.ndarray, others: np.ndarray, length_scale: float) -> np.ndarray:
    """Correlation of s between cells (cell, 3) and others (other, 3): robot, row, col."""
    gap = cells[:, None].astype(float) - others[None]
    return matern(np.hypot(gap[..., 1], gap[..., 2]), length_scale) * (gap[..., 0] == 0)
