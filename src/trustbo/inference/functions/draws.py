"""Draws of a model that is a NumPyro function."""

from collections.abc import Callable, Mapping, Sequence
from copy import copy
from typing import Any

import jax
import numpy as np

from trustbo.errors import TrustboError
from trustbo.inference.functions.data import (
    Data,
    arrays_of,
    data_of_bounds,
    observations_of,
    require_same_order,
)
from trustbo.inference.functions.function import FunctionModel
from trustbo.models.backend import own_settings
from trustbo.models.draws import Draws
from trustbo.models.params import Params, assemble_params
from trustbo.statespace import Inputs, StateSpace

_NUMBERS = 4_000_000
"""Largest number of inputs that are computed at once."""
_SEED = 20261126
"""Seed for the variables of single missions, which are drawn for the next mission."""
_SAME = 1e-9
"""Largest difference, relative to the largest input, of inputs that should be equal."""
N_CHECKED = 2
"""Number of draws for which `require_plannable` runs the function."""


class FunctionDraws(Draws):
    """Draws of the variables of a function, or the mean form and inputs over these draws.

    To find the inputs of bounds, the function is run on these bounds as one mission.

    Attributes:
        model: The function.
        values: Draws (draw, ...) of its variables by name.
        robots: Names of the robots.
        features: Names of the features.
        shape: Number of rows and columns of the map; None without a map.
        resolution: Resolution of the rates of the fit, if the function adds it to its noise.
        effects: Effects that are added to the drift, as parameters without other weights; None if
            there are none.
    """

    __slots__ = (
        "_form",
        "_is_flat",
        "_numbers",
        "_of_mean",
        "effects",
        "features",
        "model",
        "resolution",
        "robots",
        "shape",
        "values",
    )

    def __init__(
        self,
        model: FunctionModel,
        values: Mapping[str, np.ndarray],
        robots: Sequence[str],
        features: Sequence[str],
        shape: tuple[int, int] | None,
        resolution: float = 0.0,
    ) -> None:
        """Store the draws; `values` does not include the variables of single missions."""
        self.model = model
        self.values = dict(values)
        self.robots = tuple(robots)
        self.features = tuple(features)
        self.shape = shape
        self.resolution = resolution
        self.effects: Params | None = None
        self._numbers = np.arange(len(next(iter(self.values.values()))))  # of the random keys
        self._of_mean = False
        self._is_flat = True  # whether a mean has a leading axis
        self._form: StateSpace | None = None

    def __repr__(self) -> str:
        what = "mean of " if self._of_mean else ""
        return f"FunctionDraws({what}{len(self._numbers)} draws of {self.model.in_short()})"

    def in_order(self, robots: Sequence[str], features: Sequence[str]) -> "FunctionDraws":
        """See `Draws.in_order`; a function cannot change the order, in which it was fitted."""
        own = {"robot": self.robots, "feature": self.features}
        require_same_order(self.model.name, own, {"robot": robots, "feature": features})
        return self

    @property
    def leading(self) -> tuple[int, ...]:
        """See `Draws.leading`."""
        if self._of_mean:
            return (1,) if self._is_flat else ()
        return self._numbers.shape

    @property
    def n_robots(self) -> int:
        """Number of robots."""
        return len(self.robots)

    @property
    def n_features(self) -> int:
        """Number of features."""
        return len(self.features)

    @property
    def by_robot(self) -> bool:
        """See `Draws.by_robot`."""
        transition = self._space.transition
        return transition.shape[-1] > 1 or transition.shape[1] > 1

    @property
    def grid_shape(self) -> tuple[int, int] | None:
        """See `Draws.grid_shape`."""
        if self.effects is not None and self.effects.grid_shape:
            return self.effects.grid_shape
        depends = {"cell", "bound"} & {*self.model.inputs}
        return self.shape if depends else None

    @property
    def carried(self) -> bool:
        """Inputs are carried over to later bounds."""
        return True

    @property
    def x0_mean(self) -> Any:
        """Mean of trust before the first bound, shape (draw,) or (); averaged over robots."""
        mean = self._space.initial_mean.mean((1, 2))
        return mean.reshape(self.leading)

    @property
    def _space(self) -> StateSpace:
        """State-space form of each draw or of the mean; it is the same for all bounds."""
        if self._form is None:
            space, _ = self._run(self._flat_values(), np.atleast_1d(self._numbers), self.nothing())
            if self._of_mean:
                fields = [None if f is None else f.mean(0, keepdims=True) for f in space]
                space = StateSpace(*fields)
            self._form = space.with_noise(self.resolution)
        return self._form

    def nothing(self) -> dict[str, Any]:
        """Return the inputs of a mission with one bound, and without awareness of it."""
        return self._data(np.zeros((1, self.n_robots, self.n_features)), np.full((1, 3), -1))

    def theta(self) -> dict[str, np.ndarray]:
        """Return the hyperparameters (draw, ...) of the effects; see `models.effects.Theta`."""
        return self.model.over_draws("theta", 2, self.nothing())(self.values, _keys(self._numbers))

    def adding(
        self, parameters: Mapping[str, np.ndarray], places: Mapping[str, Any]
    ) -> "FunctionDraws":
        """Return the draws with effects; for the arguments, see `inference.draws.with_effects`."""
        other = copy(self)
        x0 = {"x0_mean": 0.0, "x0_sd": 0.0}
        effects = assemble_params(parameters, x0)._replace(**places)  # pyright: ignore
        other.effects = effects.in_order(self.robots, self.features)
        return other

    def require_valid(self, n_robots: int | None = None, n_features: int | None = None) -> None:
        """See `Draws.require_valid`; the values of a posterior are always valid."""
        for what, given, own in (
            ("robots", n_robots, self.n_robots),
            ("features", n_features, self.n_features),
        ):
            if given not in (None, own):
                raise TrustboError(f"the draws are of {own} {what}, not {given}.")

    def state_space(self, n_robots: int, *, adds_noise: bool = True) -> StateSpace:
        """See `Draws.state_space`."""
        self.require_valid(n_robots)
        return self._space

    def inputs(self, awareness: np.ndarray, bounds: np.ndarray | None = None) -> np.ndarray:
        """Compute the inputs of bounds by running the function; see `Draws.inputs`.

        Raises:
            TrustboError: If the function fails, or an input is not finite.
        """
        shape = awareness.shape[1:-1]
        z = awareness.reshape(self.n_robots, -1, self.n_features).swapaxes(0, 1)
        if bounds is None:
            bounds = np.indices(shape).reshape(3, -1).T

        known = ~np.isnan(z).any((1, 2))
        drift = np.full((*self.leading, self.n_robots, len(z)), np.nan)
        drift[..., known] = self._drift(z[known], bounds[known])
        drift = drift.reshape(*self.leading, self.n_robots, *shape)
        if self.effects is None:
            return drift
        return drift + self.effects.inputs(awareness, bounds if len(shape) == 1 else None)

    def _drift(self, z: np.ndarray, bounds: np.ndarray) -> np.ndarray:
        """Compute the drift (..., robot, bound); `z` has the shape (bound, robot, feature)."""
        data = self._data(z, bounds)
        values = self._flat_values()
        numbers = np.atleast_1d(self._numbers)
        n_draws = len(numbers)
        size = max(1, _NUMBERS // data["awareness"][..., 0].size)

        parts = []
        for first in range(0, n_draws, size):
            some = slice(first, first + size)
            chosen = {name: v[some] for name, v in values.items()}
            _, inputs = self._run(chosen, numbers[some], data)
            drift = _by_robot(inputs)[:, 0, : len(z)].swapaxes(1, 2)
            parts.append(drift.sum(0, keepdims=True) if self._of_mean else drift)

        drift = np.concatenate(parts)
        if self._of_mean:
            drift = drift.sum(0) / n_draws
        return drift.reshape(*self.leading, self.n_robots, len(z))

    def _run(
        self, values: dict[str, np.ndarray], numbers: np.ndarray, data: Data
    ) -> tuple[StateSpace, Inputs]:
        """Run the function; return the form (draw, group, member) and the inputs."""
        space, inputs = self.model.over_draws("form", 2, data)(values, _keys(numbers))

        if inputs.drift.shape[1:3] != data["awareness"].shape[:2]:
            raise TrustboError(self._wrong_size())
        offset = np.any(inputs.offset)
        if offset or not np.isfinite(inputs.drift).all():
            reason = "has an offset" if offset else "has a drift that is not finite"
            raise TrustboError(
                f"{self.model.in_short()} {reason} in some bounds, and such a model cannot plan. "
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

    def _data(self, z: np.ndarray, bounds: np.ndarray) -> dict[str, Any]:
        """Return the inputs of bounds; `z` has the shape (bound, robot, feature)."""
        data = data_of_bounds(z, bounds, self.features)
        if self.model.needs_observations:
            data["observations"] = observations_of(data)
        return data

    def _flat_values(self) -> dict[str, np.ndarray]:
        """Return the draws with exactly one leading axis (draw,)."""
        if self._numbers.ndim:
            return self.values
        return {name: values[None] for name, values in self.values.items()}

    def require_plannable(self, awareness: np.ndarray) -> None:
        """Raise TrustboError if the drift of a bound depends on anything but this bound.

        The function is run on the bounds of the map as one mission, and on half of them as two
        missions, in a different order. The drift of each bound and the parameters must be the same
        in both runs.

        Args:
            awareness: Awareness of the map, shape (robot, move, row, col, feature).
        """
        some = self._some(np.arange(min(N_CHECKED, self._numbers.size)))
        z = awareness.reshape(self.n_robots, -1, self.n_features).swapaxes(0, 1)
        bounds = np.indices(awareness.shape[1:-1]).reshape(3, -1).T
        known = ~np.isnan(z).any((1, 2))
        z = z[known]
        bounds = bounds[known]

        # The variables of single missions have the same values in all runs.
        data = some._data(z, bounds)
        of_missions = some._drawn_for_mission(data)
        first, inputs = some._run(some.values | of_missions, some._numbers, data)
        shapes = {name: site.shape for name, site in some.model.sites(data).items()}
        wanted = _by_robot(inputs)[:, 0, : len(z)]

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
        second, inputs = some._run(some.values | twice, some._numbers, data)
        found = _by_robot(inputs).reshape(len(wanted), -1, self.n_robots)[:, : len(order)]

        error = np.abs(found - wanted[:, order]).max(initial=0.0)
        if error > _SAME * max(1.0, np.abs(wanted).max(initial=0.0)):
            raise TrustboError(
                f"{self.model.in_short()} cannot plan: the drift of a bound changes with the order "
                "or the number of bounds or missions. It may depend only on the awareness, the "
                "cell and the move of the same bound."
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
            keys = jax.random.split(jax.random.key(_SEED), self._numbers.size)
        drawn = self.model.over_draws("prior", 1, data)(keys)
        return {name: drawn[name] for name in names}

    def draw(self, index: Any) -> "FunctionDraws":
        """See `Draws.draw`."""
        if not self._of_mean:
            return self._some(index)

        other = copy(self)
        other._is_flat = np.ndim(index) > 0  # the mean is the only draw
        return other._with_effects(lambda effects: effects.draw(index))

    def _some(self, index: Any) -> "FunctionDraws":
        """Return some of the draws, also if the object is a mean."""
        other = copy(self)
        other.values = {name: values[index] for name, values in self.values.items()}
        other._numbers = self._numbers[index]
        other._of_mean = False
        other._form = None
        return other._with_effects(lambda effects: effects.draw(index))

    def mean(self) -> "FunctionDraws":
        """Average the form and the inputs over all draws; see `Draws.mean`."""
        other = copy(self.flat())
        if not other._of_mean:
            other._of_mean = True
            other._form = None
        other._is_flat = False
        return other._with_effects(lambda effects: effects.mean())

    def flat(self) -> "FunctionDraws":
        """See `Draws.flat`."""
        other = copy(self)
        other.values = self._flat_values()
        other._numbers = np.atleast_1d(self._numbers)
        other._is_flat = True
        return other._with_effects(lambda effects: effects.flat())

    def _with_effects(self, change: Callable[[Params], Params]) -> "FunctionDraws":
        """Change the effects of a new object, if there are any, and return the object."""
        if self.effects is not None:
            self.effects = change(self.effects)
        return self

    def record(self) -> dict[str, Any]:
        """See `Draws.record`."""
        return {name: np.asarray(values).tolist() for name, values in self.values.items()}


def no_weights(theta: Mapping[str, np.ndarray], features: Sequence[str]) -> dict[str, np.ndarray]:
    """Return parameters (draw, ...) of a model class whose trust consists of effects alone."""
    zeros = np.zeros(len(theta["inverse_gain"]))
    weights = np.zeros((len(zeros), len(features)))
    none = {name: zeros for name in ("beta0", "b", "delta_w", "delta_v")}
    return {**theta, **none, "beta": weights}


def _keys(numbers: np.ndarray) -> Any:
    """Return the random keys of draws, given by number."""
    with own_settings():
        return jax.vmap(jax.random.fold_in, (None, 0))(jax.random.key(_SEED), numbers)


def _by_robot(inputs: Inputs) -> np.ndarray:
    """Return the drift (draw, mission, bound, robot)."""
    drift = inputs.drift
    return drift.reshape(*drift.shape[:3], -1)
