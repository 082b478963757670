"""Effects of places: s of the cell entered, a Gaussian process, and e of the directed bound."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import numpyro.distributions as dist
from scipy import sparse

from trustbo.errors import TrustboError, require_positive
from trustbo.models.backend import namespace
from trustbo.models.effects.effect import (
    LEAST,
    Effect,
    NextMission,
    Theta,
    precision,
    register,
)
from trustbo.models.slots import Slots
from trustbo.models.visited import Visited, matern

_JITTER = 1e-8  # of a correlation of cells
_LENGTH_SCALES = 1e-6, 1e6  # cells: outside, cells are independent, or equal
_MOST = {
    "length_scale": (1000.0, "cells, not metres"),
    "length_scale_sd": (3.0, "the logarithm of a length scale"),
}


@register
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
    noun = "places"
    variables: ClassVar = {"place": (), "place_bound": ()}  # laid out by `place_maps.place_group`

    def __post_init__(self) -> None:
        for name in ("cells", "bounds", "shared"):
            if not isinstance(value := getattr(self, name), bool | np.bool_):
                raise TrustboError(f"PlaceEffect.{name} must be True or False; got {value!r}.")
        if not (self.cells or self.bounds):
            raise TrustboError("PlaceEffect needs an effect of cells or of bounds; got neither.")
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

    def hyperpriors(self) -> dict[str, dist.Distribution]:
        """See `Effect.hyperpriors`."""
        priors = {
            "tau_s": dist.HalfNormal(self.tau_s),
            "length_scale": dist.LogNormal(np.log(self.length_scale), self.length_scale_sd),
            "tau_e": dist.HalfNormal(self.tau_e),
        }
        return {name: priors[name] for name in self.names}

    def columns(self, slots: Slots) -> Any:
        """Indicators of the cells entered and of the bounds made; each robot's where not shared."""
        visited = _visited(slots)
        unit = np.broadcast_to(visited.unit, slots.y.shape).ravel()
        met = np.flatnonzero(unit >= 0)
        parts = []
        if self.cells:
            parts.append((visited.cell_of[unit[met]], len(visited.cells)))
        if self.bounds:
            parts.append((unit[met], len(visited.units)))
        ones = np.ones(len(met))
        return sparse.hstack(
            [sparse.csr_array((ones, (met, at)), shape=(len(unit), n)) for at, n in parts],
            format="csr",
        )

    def prior(self, theta: Theta, slots: Slots) -> tuple[Any, list[Any]]:
        """A Gaussian process over the visited cells, and independent bounds."""
        visited, parts = _visited(slots), []
        if self.cells:
            mine = visited.cells[:, 0] == visited.cells[0, 0]  # all robots visit the same cells
            parts += [self._cells(theta, visited.cells[mine])] * visited.n_effects
        if self.bounds:
            xp: Any = namespace(theta["tau_e"])
            lam = xp.maximum(theta["tau_e"], LEAST) ** -2.0
            parts.append(xp.repeat(lam[:, None], len(visited.units), axis=1))
        return None, parts

    def _cells(self, theta: Theta, cells: np.ndarray) -> Any:
        """Precision (point, cell, cell) of s at cells (cell, 3)."""
        xp: Any = namespace(theta["tau_s"])
        gap = cells[:, None, 1:].astype(float) - cells[None, :, 1:]
        square, pair = np.unique((gap**2).sum(-1), return_inverse=True)
        scale = xp.clip(theta["length_scale"], *_LENGTH_SCALES)
        K = matern(np.sqrt(square), scale[:, None])[:, pair.reshape(gap.shape[:2])]
        tau = xp.maximum(theta["tau_s"], LEAST)[:, None, None]
        return precision(tau**2 * (K + _JITTER * np.eye(len(cells))))

    def named(self, c: np.ndarray, theta: Theta, slots: Slots) -> dict[str, np.ndarray]:
        """Effects of visited cells, place (draw, cell), and bounds, place_bound (draw, unit)."""
        n = len(_visited(slots).cells) if self.cells else 0
        named = {"place": c[:, :n], "place_bound": c[:, n:]}
        return {name: values for name, values in named.items() if values.shape[1]}

    def coefficients(
        self, values: Mapping[str, np.ndarray], theta: Theta, slots: Slots
    ) -> np.ndarray:
        """See `Effect.coefficients`."""
        return np.column_stack([values[name] for name in self.variables if name in values])

    def ahead(
        self, values: Mapping[str, np.ndarray], theta: Theta, mission: NextMission
    ) -> tuple[np.ndarray, np.ndarray]:
        """Nothing: parameters hold maps of the places of every path."""
        n = len(theta["rest"])
        return np.zeros((n, 1, len(mission.features))), np.zeros((n, 1))

    def in_short(self) -> str:
        """Places that have effects, and whether robots share them."""
        places = " and ".join(["cells"] * self.cells + ["bounds"] * self.bounds)
        return f"of {places}, {'shared by robots' if self.shared else 'by robot'}"


def _visited(slots: Slots) -> Visited:
    if slots.visited is None:
        raise TrustboError("effects of places need the visited places; got None.")
    return slots.visited
