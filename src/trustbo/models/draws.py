"""Draws of the parameters of any trust model, as planners, filters and simulators need them."""

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, Self

import numpy as np

from trustbo.arrays import Names
from trustbo.display import Rows, Summary
from trustbo.errors import TrustboError
from trustbo.models.robots_in_bounds import RobotsInBounds
from trustbo.statespace import Inputs, StateSpace
from trustbo.statespace.form import coupled_robots, independent_robots

_MOST_SHOWN = 6
"""Largest number of values that a summary shows; longer parameters are shown as a range."""

Order = Mapping[str, Sequence[str]]
"""Names of robots and features in order, with the keys `robot` and `feature`."""


class Drift(Protocol):
    """One term of the input of bounds under each draw."""

    @property
    def is_shared(self) -> bool:
        """Whether all robots have the same weights."""
        ...

    @property
    def n_robots(self) -> int | None:
        """Number of robots; None if the term applies to any number of them."""
        ...

    @property
    def n_features(self) -> int:
        """Number of features."""
        ...

    @property
    def grid_shape(self) -> tuple[int, int] | None:
        """Shape (row, col) of the map on whose cells the term depends; None if on no cell."""
        ...

    @property
    def values(self) -> dict[str, np.ndarray]:
        """Parameters (draw, ...) by name."""
        ...

    def inputs(self, awareness: np.ndarray, bounds: np.ndarray | None = None) -> np.ndarray:
        """See `Draws.inputs`."""
        ...

    def draw(self, index: np.ndarray) -> Self:
        """Select draws by an index array."""
        ...

    def mean(self) -> Self:
        """Average over draws; the axis (draw,) of the result has length 1."""
        ...

    def in_order(self, own: Order, wanted: Order) -> Self:
        """Return the term for the robots and features `own` in the order `wanted`."""
        ...


class LinearDrift(NamedTuple):
    """Input u = sum_m beta_m z_m + b, with any effects of places.

    Attributes:
        weights: Feature weights of all robots (draw, feature), of each robot (draw, robot, feature)
            or of each pair of robots (draw, feature, robot, robot').
        b: Intercept, shape (draw,) or (draw, robot).
        place: Effects of entered cells, shape (draw, effect, row, col), or None.
        place_bound: Effects of bounds, shape (draw, effect, move, row, col), or None.
        place_robot: Effects of robots in bounds, or None.
    """

    weights: np.ndarray
    b: np.ndarray
    place: np.ndarray | None = None
    place_bound: np.ndarray | None = None
    place_robot: RobotsInBounds | None = None

    @property
    def is_shared(self) -> bool:
        """See `Drift.is_shared`."""
        return self.weights.ndim == 2

    @property
    def n_robots(self) -> int | None:
        """See `Drift.n_robots`."""
        if self.b.ndim > 1:
            return self.b.shape[1]
        if self.place_robot is not None:
            return self.place_robot.known.shape[1]
        n = max((effect.shape[1] for effect in self.places.values()), default=1)
        return n if n > 1 else None

    @property
    def n_features(self) -> int:
        """See `Drift.n_features`."""
        return self.weights.shape[1 if self.weights.ndim == 4 else -1]

    @property
    def places(self) -> dict[str, np.ndarray]:
        """Effects of places that are the same in all missions, by name."""
        effects = {"place": self.place, "place_bound": self.place_bound}
        return {name: effect for name, effect in effects.items() if effect is not None}

    @property
    def grid_shape(self) -> tuple[int, int] | None:
        """See `Drift.grid_shape`."""
        for effect in self.places.values():
            return effect.shape[-2:]
        return None

    @property
    def values(self) -> dict[str, np.ndarray]:
        """See `Drift.values`; effects of robots in bounds are left out."""
        name = "B" if self.weights.ndim == 4 else "beta"
        return {name: self.weights, "b": self.b, **self.places}

    def inputs(self, awareness: np.ndarray, bounds: np.ndarray | None = None) -> np.ndarray:
        """See `Draws.inputs`."""
        flat = awareness.reshape(len(awareness), -1, awareness.shape[-1])
        if self.weights.ndim == 2:
            u = np.tensordot(self.weights, flat, (-1, -1))
        elif self.weights.ndim == 3:
            u = np.einsum("...im,...ikm->...ik", self.weights, flat)
        else:
            u = np.einsum("...mai,...ikm->...ak", self.weights, flat)
        u += self.b.reshape(len(self.b), -1, 1)  # in place, because the array may be large

        if bounds is not None:
            return u + self._of_places(bounds) if self.places else u

        u = u.reshape(*u.shape[:2], *awareness.shape[1:-1])
        if self.place is not None:  # the effect of a cell is the same for all moves that enter it
            u = u + self.place[:, :, None]
        if self.place_bound is not None:
            u = u + self.place_bound
        return u if self.place_robot is None else u + self.place_robot.everywhere()

    def _of_places(self, bounds: np.ndarray) -> np.ndarray:
        """Return the effects (draw, effect, bound) of places; effects of the move -1 are 0."""
        moves, rows, cols = np.asarray(bounds).T
        total: Any = 0.0
        if self.place is not None:
            total = total + self.place[..., rows, cols]
        if self.place_bound is not None:
            total = total + self.place_bound[..., moves, rows, cols]

        total = np.where(moves < 0, 0.0, total)
        return total if self.place_robot is None else total + self.place_robot.at(bounds)

    def draw(self, index: np.ndarray) -> Self:
        """See `Drift.draw`."""
        places: dict[str, Any] = {name: effect[index] for name, effect in self.places.items()}
        if self.place_robot is not None:
            places["place_robot"] = self.place_robot.draw(index)
        return self._replace(weights=self.weights[index], b=self.b[index], **places)

    def mean(self) -> Self:
        """See `Drift.mean`."""
        means: dict[str, Any] = {n: v.mean(0, keepdims=True) for n, v in self.places.items()}
        if self.place_robot is not None:
            means["place_robot"] = self.place_robot.mean()
        weights = self.weights.mean(0, keepdims=True)
        return self._replace(weights=weights, b=self.b.mean(0, keepdims=True), **means)

    def in_order(self, own: Order, wanted: Order) -> Self:
        """See `Drift.in_order`."""
        robots = _positions("robot", own, wanted)
        features = _positions("feature", own, wanted)
        n = self.weights.ndim
        changed: dict[str, Any] = {
            "weights": np.take(self.weights, features, axis=1 if n == 4 else -1)
        }
        if n > 2:
            changed["weights"] = np.take(changed["weights"], robots, axis=n - 2)
        if n == 4:
            changed["weights"] = changed["weights"][..., robots]
        if self.b.ndim > 1:
            changed["b"] = self.b[:, robots]
        for name, effect in self.places.items():
            if effect.shape[1] > 1:
                changed[name] = effect[:, robots]
        if self.place_robot is not None:
            known = self.place_robot.known[:, robots]
            changed["place_robot"] = self.place_robot._replace(known=known)
        return self._replace(**changed)


@dataclass(frozen=True, eq=False, repr=False)
class Draws(Summary):
    """Draws of the parameters of a trust model: its equation, and the inputs of bounds.

    All arrays have the leading axis (draw,); a mean has one draw. Parameters can be read by name,
    such as `draws.beta0`. Inputs are computed when they are needed, for the bounds of a path or for
    all bounds of a map, because an array (draw, robot, move, row, col) of a large map does not fit
    in memory.

    Attributes:
        form: Parameters (draw, ...) of the equation by name: the arguments of `independent_robots`
            or `coupled_robots`, or the fields of a `StateSpace`. Further axes are those of robots.
        drifts: Terms of the inputs, whose sum is used. The first one depends on the features.
        robots: Names of the robots, in the order of the arrays; None if they are not known.
        features: Names of the features, in the order of the arrays; None if they are not known.
        memory: Quantity carried over between bounds, `"level"` or `"deviation"`; see `PooledTrust`.
    """

    form: Mapping[str, np.ndarray]
    drifts: tuple[Drift, ...]
    robots: Names | None = None
    features: Names | None = None
    memory: str = "level"

    def __getattr__(self, name: str) -> np.ndarray:
        # Copies and unpickled objects are asked for special names before they have any field.
        if not name.startswith("_") and name in self.values:
            return self.values[name]
        raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")

    def _rows(self) -> Rows:
        n = self.n_draws
        rows = [("draws", f"{n} draws, mean +- sd" if n > 1 else "one draw")]
        for name, value in self.values.items():
            rows.append((name, _written(value)))
        return rows

    @property
    def values(self) -> dict[str, np.ndarray]:
        """Parameters (draw, ...) by name; those of a function are its variables."""
        own = self.drifts[0].values
        return own if "transition" in self.form else {**self.form, **own}

    @property
    def n_draws(self) -> int:
        """Number of draws."""
        return len(next(iter(self.form.values())))

    @property
    def n_robots(self) -> int | None:
        """Number of robots; None if the parameters are the same for all robots."""
        return self.drifts[0].n_robots

    @property
    def n_features(self) -> int:
        """Number of features."""
        return self.drifts[0].n_features

    @property
    def by_robot(self) -> bool:
        """Whether the robots' mean trust does not obey the equation of a single robot."""
        first = next(iter(self.form.values()))
        return first.size > len(first)

    @property
    def grid_shape(self) -> tuple[int, int] | None:
        """Shape (row, col) of the map on whose cells the inputs depend; None if on no cell."""
        for drift in self.drifts:
            if drift.grid_shape is not None:
                return drift.grid_shape
        return None

    @property
    def carried(self) -> bool:
        """Whether the inputs of a bound are carried over to later bounds (see `statespace`)."""
        return self.memory == "level"

    @property
    def initial_offset(self) -> np.ndarray:
        """Offset (draw,) before the first bound, so that trust is x0_mean in any case."""
        return np.zeros(self.n_draws) if self.carried else self.form["x0_mean"]

    @property
    def linear(self) -> LinearDrift | None:
        """Linear term of the inputs, which contains the effects of places; None without one."""
        last = self.drifts[-1]
        return last if isinstance(last, LinearDrift) else None

    def require_valid(self, n_robots: int, n_features: int) -> None:
        """Raise TrustboError if the draws are for other numbers of robots or features."""
        for what, own, given in (
            ("robots", self.n_robots, n_robots),
            ("features", self.n_features, n_features),
        ):
            if own not in (None, given):
                raise TrustboError(
                    f"the parameters are for {own} {what}, not {given}; give parameters of the "
                    f"same {what}."
                )

    def require_grid(self, shape: tuple[int, ...]) -> None:
        """Raise TrustboError if the draws have effects of the places of another map."""
        if self.grid_shape not in (None, shape):
            raise TrustboError(
                f"the parameters are those of a map of {self.grid_shape} cells (row, col), but the "
                f"workspace has {shape}; fit the posterior to the workspace: "
                "tb.fit(missions, workspace=workspace)."
            )

    def in_order(self, robots: Sequence[str], features: Sequence[str]) -> Self:
        """Return the draws with their robots and features in the order of these names.

        Draws without names are in this order already. Parameters that all robots share apply to
        robots with any names. Raises TrustboError if names differ.
        """
        wanted = {"robot": tuple(robots), "feature": tuple(features)}
        own = {
            "robot": wanted["robot"] if self.n_robots is None else self.robots or wanted["robot"],
            "feature": self.features or wanted["feature"],
        }
        named = self._with(robots=wanted["robot"], features=wanted["feature"])
        if own == wanted:
            return named

        drifts = tuple(drift.in_order(own, wanted) for drift in self.drifts)
        order = _positions("robot", own, wanted)
        form = {}
        for name, value in self.form.items():
            for axis in range(1, value.ndim):
                value = np.take(value, order, axis=axis)
            form[name] = value
        return named._with(drifts=drifts, form=form)

    def state_space(self, n_robots: int, *, adds_noise: bool = True) -> StateSpace:
        """Return the model's equation at each draw.

        Args:
            n_robots: Number of robots.
            adds_noise: Whether the observation family adds noise (see `coupled_robots`).
        """
        values: dict[str, Any] = dict(self.form)
        if "transition" in values:
            return StateSpace(**values)
        if not self.carried:
            values["x0_mean"] = 0.0

        if "B0" in values:
            return coupled_robots(**values, adds_noise=adds_noise)
        return independent_robots(**values, n_members=n_robots if "delta_s" in values else 1)

    def inputs(self, awareness: np.ndarray, bounds: np.ndarray | None = None) -> np.ndarray:
        """Compute the input u of bounds, which is carried over to later bounds if `carried`.

        Args:
            awareness: Situational awareness, shape (robot, move, row, col, feature) of all bounds
                of a map, or (robot, bound, feature) of `bounds`. There are no inputs where it is
                NaN.
            bounds: Moves, rows and columns (bound, 3); a move is -1 if the bound is not known.

        Returns:
            Inputs (draw, robot, move, row, col) or (draw, robot, bound).
        """
        u = self.drifts[0].inputs(awareness, bounds)
        for drift in self.drifts[1:]:
            u = u + drift.inputs(awareness, bounds)
        return u

    def team_inputs(self, awareness: np.ndarray, bounds: np.ndarray | None = None) -> np.ndarray:
        """Compute the mean of `inputs` over robots, with the axis (robot,) of length 1."""
        if all(drift.is_shared for drift in self.drifts):
            awareness = awareness.mean(0, keepdims=True)  # the weights apply to the mean
        return self.inputs(awareness, bounds).mean(1, keepdims=True)

    def as_inputs(self, u: Any) -> Inputs:
        """Return inputs as a drift if they are carried over, otherwise as an offset."""
        return Inputs(u) if self.carried else Inputs(drift=0.0, offset=u)

    def draw(self, index: Any) -> Self:
        """Select draws by number, by a list of numbers or by a slice."""
        some = np.atleast_1d(np.arange(self.n_draws)[index])
        form = {name: value[some] for name, value in self.form.items()}
        return self._with(form=form, drifts=tuple(drift.draw(some) for drift in self.drifts))

    def mean(self) -> Self:
        """Average the equation and the inputs over all draws; the result has one draw."""
        form = {name: value.mean(0, keepdims=True) for name, value in self.form.items()}
        return self._with(form=form, drifts=tuple(drift.mean() for drift in self.drifts))

    def record(self) -> dict[str, Any]:
        """Return a description for files, as plain values; without effects of robots in bounds."""
        record: dict[str, Any] = {name: value.tolist() for name, value in self.values.items()}
        return record if self.carried else {**record, "memory": self.memory}

    def with_robots_in_bounds(self, other: "Draws") -> Self:
        """Return the draws with the effects of robots in bounds of other draws, if any."""
        if self.linear is None or other.linear is None or other.linear.place_robot is None:
            return self
        linear = self.linear._replace(place_robot=other.linear.place_robot)
        return self._with(drifts=(*self.drifts[:-1], linear))

    def _with(self, **fields: Any) -> Self:
        """Return a copy with other values of some fields."""
        other = copy(self)
        vars(other).update(fields)
        return other


def _positions(axis: str, own: Order, wanted: Order) -> list[int]:
    """Return the position of each wanted robot or feature; raises TrustboError if names differ."""
    if sorted(own[axis]) != sorted(wanted[axis]):
        raise TrustboError(
            f"the parameters have the {axis}s {', '.join(own[axis])}, not "
            f"{', '.join(wanted[axis])}; give parameters of the same names."
        )
    return [list(own[axis]).index(name) for name in wanted[axis]]


def _written(draws: np.ndarray) -> str:
    """Format the mean and standard deviation of a parameter (draw, ...) over draws."""
    mean = draws.mean(0)
    if mean.size > _MOST_SHOWN:
        return f"{mean.shape}, {mean.min():.3g} to {mean.max():.3g}"
    if len(draws) == 1:
        return ", ".join(f"{m:.3g}" for m in np.ravel(mean))

    sd = draws.std(0)
    moments = zip(np.ravel(mean), np.ravel(sd), strict=True)
    return ", ".join(f"{m:.3g} +- {s:.2g}" for m, s in moments)
