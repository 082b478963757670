"""Draws of a model that is a NumPyro function."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import jax
import numpy as np

from trustbo.arrays import Names, evenly_spaced
from trustbo.errors import TrustboError
from trustbo.inference.functions.data import (
    Data,
    arrays_of,
    data_of_bounds,
    observations_of,
    require_same_order,
)
from trustbo.inference.functions.function import BATCH, FunctionModel, in_batches
from trustbo.models.backend import own_settings
from trustbo.models.draws import PLACES, Draws, Order
from trustbo.models.params import assemble_params
from trustbo.statespace import Inputs, StateSpace

_NUMBERS = 4_000_000
"""Largest number of inputs that are computed at once."""
_SEED = 20261126
"""Seed for the variables of single missions, which are drawn for the next mission."""
_SAME = 1e-9
"""Largest difference, relative to the largest input, of inputs that should be equal."""
_FEW = 8
"""Number of invented bounds on which `FunctionDrift.of_robots` compares drifts."""
_MOST_AVERAGED = 1000
"""Largest number of draws whose drift is averaged. The error of the mean is then 3 % of a standard
deviation, and plans evaluate tens of thousands of bounds for each draw."""
N_CHECKED = 2
"""Number of draws for which `require_plannable` runs the function."""


@dataclass(frozen=True, eq=False)
class FunctionDrift:
    """Drift of a function; to find that of some bounds, they are given to it as one mission.

    Attributes:
        model: The function.
        values: Draws (draw, ...) of its variables by name, except those of single missions.
        robots: Names of the robots.
        features: Names of the features.
        shape: Shape (row, col) of the map on whose cells the drift depends; None if on no cell.
        number: Number of each draw, shape (draw,), from which the variables of single missions are
            drawn.
        of_mean: Whether the drift is averaged over all draws.
        members: Positions of the robots that take part, among `robots`; None for all robots.
    """

    model: FunctionModel
    values: dict[str, np.ndarray]
    robots: Names
    features: Names
    shape: tuple[int, int] | None
    number: np.ndarray
    of_mean: bool = False
    members: tuple[int, ...] | None = None

    @property
    def n_robots(self) -> int:
        """Number of robots that the function knows."""
        return len(self.robots)

    def space(self) -> StateSpace:
        """Return the form (draw, group, member), which is the same for all bounds."""
        space, _ = self._run(self.nothing())
        return space

    def theta(self) -> dict[str, np.ndarray]:
        """Return the hyperparameters (draw, ...) of the effects; see `models.effects.Theta`."""
        return self.model.over_draws("theta", 2, self.nothing())(self.values, _keys(self.number))

    def inputs(self, awareness: np.ndarray, bounds: np.ndarray | None = None) -> np.ndarray:
        """Compute the drift of bounds by running the function; see `Draws.inputs`.

        Raises:
            TrustboError: If the function fails, or an input is not finite.
        """
        shape = awareness.shape[1:-1]
        z, of_map = _bounds_of(awareness)
        bounds = of_map if bounds is None else bounds

        known = ~np.isnan(z).any((1, 2))
        found = self._of_bounds("drift", z[known], bounds[known])
        drift = np.full((len(found), z.shape[1], len(z)), np.nan)
        drift[..., known] = found
        return drift.reshape(*drift.shape[:2], *shape)

    def noise_scale(self, awareness: np.ndarray, bounds: np.ndarray) -> np.ndarray:
        """Compute the scale (draw, robot, bound) of the noise; see `ContactRate`."""
        return self._of_bounds("noise", _bounds_of(awareness)[0], bounds)

    def _of_bounds(self, field: str, z: np.ndarray, bounds: np.ndarray) -> np.ndarray:
        """Compute a field of `Inputs`, shape (draw, robot, bound).

        `z` has the shape (bound, robot, feature).
        """
        if self.members is not None:
            # Only the scale of the noise may depend on the other robots, by a mean over robots.
            filled = np.repeat(z.mean(1, keepdims=True), self.n_robots, axis=1)
            filled[:, list(self.members)] = z
            everyone = replace(self, members=None)
            return everyone._of_bounds(field, filled, bounds)[:, list(self.members)]

        data = self._data(z, bounds)
        n_draws = len(self.number)
        size = min(BATCH, max(1, _NUMBERS // data["awareness"][..., 0].size))

        parts = []
        for first in range(0, n_draws, size):
            _, inputs = self._some(slice(first, first + size))._run(data, size=size)
            part = _by_robot(getattr(inputs, field))[:, 0, : len(z)].swapaxes(1, 2)
            parts.append(part.sum(0, keepdims=True) if self.of_mean else part)

        found = np.concatenate(parts)
        return found.sum(0, keepdims=True) / n_draws if self.of_mean else found

    def _run(
        self, data: Data, of_missions: Mapping[str, Any] | None = None, size: int = BATCH
    ) -> Any:
        """Run the function; return the form (draw, group, member) and the inputs.

        `of_missions` are values of the variables of single missions; by default, they are drawn.
        `size` is the number of draws for which the function is compiled; see `in_batches`.
        """
        values = {**self.values, **(of_missions or {})}
        run = self.model.over_draws("space_and_inputs", 2, data)
        space, inputs = in_batches(run, values, _keys(self.number), size=size)

        if inputs.drift.shape[1:3] != data["awareness"].shape[:2]:
            raise TrustboError(self._wrong_size())
        offset = np.any(inputs.offset)
        if offset or not _is_finite(inputs):
            what = "has an offset" if offset else "has a drift or a noise_scale that is not finite"
            raise TrustboError(
                f"{self.model.in_short()} {what} in some bounds, and such a model cannot plan. "
                "The inputs n_ticks and duration are not known before a mission."
            )

        fields = [None if value is None else value[:, 0] for value in space]
        return StateSpace(*fields), inputs

    def _wrong_size(self) -> str:
        """Return a message that a variable of all missions cannot be used for the next one."""
        return (
            f"a variable of {self.model.in_short()} has a size that depends on the number of "
            "missions or bounds, so it cannot plan; sample variables of one mission each within "
            'numpyro.plate("mission", len(awareness)).'
        )

    def nothing(self) -> dict[str, Any]:
        """Return the inputs of a mission with one bound, and without awareness of it."""
        return self._data(np.zeros((1, self.n_robots, len(self.features))), np.full((1, 3), -1))

    def _data(self, z: np.ndarray, bounds: np.ndarray) -> dict[str, Any]:
        """Return the inputs of bounds; `z` has the shape (bound, robot, feature)."""
        data = data_of_bounds(z, bounds, self.features)
        if self.model.needs_observations:
            data["observations"] = observations_of(data)
        return data

    def require_plannable(self, awareness: np.ndarray) -> None:
        """Raise TrustboError if the drift of a bound depends on anything but this bound.

        The function is run on the bounds of the map as one mission, and on half of them as two
        missions, in a different order. The drift of each bound and the parameters must be the same
        in both runs.

        Args:
            awareness: Awareness of the map, shape (robot, move, row, col, feature).
        """
        some = self._some(slice(N_CHECKED))
        z, bounds = _bounds_of(awareness)
        known = ~np.isnan(z).any((1, 2))
        z = z[known]
        bounds = bounds[known]

        # The variables of single missions have the same values in all runs.
        data = some._data(z, bounds)
        of_missions = some._drawn_for_mission(data)
        first, inputs = some._run(data, of_missions, N_CHECKED)
        shapes = {name: site.shape for name, site in some.model.sites(data).items()}
        wanted = _drift_and_noise(inputs)[:, 0, : len(z)]

        order = np.random.default_rng(0).permutation(len(z))[: max(1, len(z) // 2)]
        data = some._data(z[order], bounds[order])
        n_half = data["awareness"].shape[1] // 2
        data |= {n: v[0].reshape(2, n_half, *v.shape[2:]) for n, v in arrays_of(data).items()}
        if some.model.needs_observations:
            data["observations"] = observations_of(data)
        sites = some.model.sites(data)
        if any(
            shapes.get(name) != site.shape for name, site in sites.items() if name in self.values
        ):
            raise TrustboError(self._wrong_size())
        twice = {
            name: np.repeat(values, 2, axis=1 + (sites[name].mission_axis or 0))
            for name, values in of_missions.items()
        }
        second, inputs = some._run(data, twice, N_CHECKED)
        found = _drift_and_noise(inputs).reshape(len(wanted), -1, 2 * self.n_robots)
        found = found[:, : len(order)]

        error = np.abs(found - wanted[:, order]).max(initial=0.0)
        if error > _SAME * max(1.0, np.abs(wanted).max(initial=0.0)):
            raise TrustboError(
                f"{self.model.in_short()} cannot plan: the drift or the noise_scale of a bound "
                "changes with the order or the number of bounds or missions. It may depend only on "
                "the awareness, the cell and the move of the same bound."
            )

        pairs = [(a, b) for a, b in zip(first, second, strict=True) if a is not None]
        if not all(np.allclose(a, b, rtol=_SAME, atol=_SAME) for a, b in pairs):
            raise TrustboError(
                f"{self.model.in_short()} cannot plan: beta0, a noise or the trust at the start "
                "depends on the awareness or the number of missions; make it depend on sampled "
                "variables alone."
            )

    def _drawn_for_mission(self, data: Data) -> dict[str, np.ndarray]:
        """Draw the variables of single missions for one mission; return them by name."""
        sites = self.model.sites(data)
        names = [name for name, site in sites.items() if site.mission_axis is not None]
        if not names:
            return {}

        with own_settings():
            keys = jax.random.split(jax.random.key(_SEED), len(self.number))
        drawn = self.model.over_draws("prior", 1, data)(keys)
        return {name: drawn[name] for name in names}

    def draw(self, index: np.ndarray) -> Self:
        """See `OwnDrift.draw`; a mean is the only draw."""
        return self if self.of_mean else self._some(index)

    def _some(self, index: Any) -> Self:
        """Return some of the draws, also of a mean."""
        values = {name: array[index] for name, array in self.values.items()}
        return replace(self, values=values, number=self.number[index])

    def mean(self) -> Self:
        """See `OwnDrift.mean`; with many draws, some of them are averaged, evenly spaced."""
        kept = evenly_spaced(len(self.number), _MOST_AVERAGED)
        return replace(self._some(kept), of_mean=True)

    def require_order(self, own: Order, wanted: Order) -> None:
        """See `OwnDrift.require_order`; a function reads robots and features by position."""
        require_same_order(self.model.name, own, wanted, some=True)

    def of_robots(self, which: Sequence[int]) -> Self:
        """See `OwnDrift.of_robots`; the drift is computed with others in the other robots' place.

        Two such computations must agree.
        """
        every = range(self.n_robots) if self.members is None else self.members
        members = tuple(every[i] for i in which)
        others = [i for i in range(self.n_robots) if i not in members]

        some = replace(self._some(slice(N_CHECKED)), of_mean=False, members=None)
        rng = np.random.default_rng(0)
        z = rng.random((_FEW, self.n_robots, len(self.features)))
        changed = z.copy()
        changed[:, others] = 1.0 - z[:, others]

        nowhere = np.full((_FEW, 3), -1)
        pair = [some._of_bounds("drift", a, nowhere)[:, list(members)] for a in (z, changed)]
        if not np.allclose(*pair, rtol=_SAME, atol=_SAME):
            names = ", ".join(self.robots[i] for i in members)
            raise TrustboError(
                f"in {self.model.in_short()}, the trust in a robot depends on the awareness of "
                f"other robots, so all of {', '.join(self.robots)} must take part, not only "
                f"{names}; use a function without such influence."
            )
        return replace(self, members=members)


def function_drift(
    model: FunctionModel,
    values: Mapping[str, np.ndarray],
    robots: Names,
    features: Names,
    shape: tuple[int, int] | None,
) -> FunctionDrift:
    """Return the drift of a function for draws (draw, ...) of its variables by name."""
    number = np.arange(len(next(iter(values.values()))))
    on_map = shape if {"cell", "bound"} & {*model.inputs} else None
    return FunctionDrift(model, dict(values), tuple(robots), tuple(features), on_map, number)


def draws_of_drift(
    drift: FunctionDrift,
    resolution: float = 0.0,
    effects: tuple[Mapping[str, np.ndarray], Mapping[str, Any]] | None = None,
) -> Draws:
    """Return draws with the drift of a function.

    Args:
        drift: The drift.
        resolution: Resolution of the rates of the fit, if the function adds it to its noise.
        effects: Parameters and effects of places that are added to the drift; see
            `inference.ahead.with_effects`.
    """
    space = drift.space().with_noise(resolution)
    arrays = {name: value for name, value in space._asdict().items() if value is not None}
    in_bounds = None
    if effects is not None:
        parameters, places = effects
        linear = assemble_params(parameters, **places)
        names = ("beta", "b", *PLACES)
        arrays |= {name: linear.arrays[name] for name in names if name in linear.arrays}
        in_bounds = linear.place_robot
    family = drift.model.family
    return Draws(arrays, drift, in_bounds, drift.robots, drift.features, family=family)


def no_weights(theta: Mapping[str, np.ndarray], features: Names) -> dict[str, np.ndarray]:
    """Return parameters (draw, ...) of a model class whose trust consists of effects alone."""
    zeros = np.zeros(len(theta["inverse_gain"]))
    weights = np.zeros((len(zeros), len(features)))
    none = {name: zeros for name in ("beta0", "b", "delta_w", "delta_v")}
    return {**theta, **none, "beta": weights}


def _bounds_of(awareness: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return awareness (bound, robot, feature) of all bounds, and their indices (bound, axis)."""
    n_robots = len(awareness)
    z = awareness.reshape(n_robots, -1, awareness.shape[-1]).swapaxes(0, 1)
    return z, np.indices(awareness.shape[1:-1]).reshape(len(awareness.shape) - 2, -1).T


def _keys(number: np.ndarray) -> Any:
    """Return the random keys of draws, given by number."""
    with own_settings():
        return jax.vmap(jax.random.fold_in, (None, 0))(jax.random.key(_SEED), number)


def _by_robot(values: np.ndarray) -> np.ndarray:
    """Return values (draw, mission, bound, robot), without groups of robots."""
    return values.reshape(*values.shape[:3], -1)


def _drift_and_noise(inputs: Inputs) -> np.ndarray:
    """Return the drift and the scale of the noise along the last axis, 2 for each robot."""
    return np.concatenate([_by_robot(inputs.drift), _by_robot(inputs.noise)], axis=-1)


def _is_finite(inputs: Inputs) -> bool:
    """Return whether the drift and the scale of the noise are finite in all bounds."""
    return all(bool(np.isfinite(values).all()) for values in (inputs.drift, inputs.noise))
