"""Draws of the parameters of any trust model, as planners, filters and simulators need them."""

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, Self

import numpy as np

from trustbo.arrays import Names
from trustbo.data import sight_columns
from trustbo.display import Rows, Summary
from trustbo.errors import TrustboError, require_switch
from trustbo.models.families import FAMILIES, Family
from trustbo.models.robots_in_bounds import RobotsInBounds
from trustbo.models.sight_scale import scale_at, variation
from trustbo.statespace import Inputs, StateSpace
from trustbo.statespace.form import coupled_robots, independent_robots

Dims = Mapping[str, tuple[str, ...]]
"""Axes of each parameter after (draw,)."""

ROBOT_DIMS: Dims = {
    "beta0": ("robot",),
    "beta": ("robot", "feature"),
    "b": ("robot",),
    "delta_w": ("robot",),
    "delta_v": ("robot",),
}
"""Parameters of each robot, without influence on each other."""
COUPLED_DIMS: Dims = {
    "B0": ("robot", "robot_"),
    "B": ("feature", "robot", "robot_"),
    "b": ("robot",),
    "Delta_w": ("robot", "robot_"),
    "Delta_v": ("robot", "robot_"),
}
"""Parameters of the coupled model, equations (1)-(2)."""
PLACES: Dims = {
    "place": ("effect", "row", "col"),
    "place_bound": ("effect", "move", "row", "col"),
}
"""Axes of the effects of places; the first has one entry, or one for each robot."""
_AXES: Dims = {
    **ROBOT_DIMS,
    **COUPLED_DIMS,
    **dict.fromkeys(("x0_mean", "x0_sd"), ("robot",)),
    **PLACES,
}
"""Last axes of the parameters, of which those that all robots share lack the first one."""
_OF_INPUTS = ("beta", "B", "b", "f_v", *PLACES)
"""Parameters that are not part of the equation."""
_MOST_SHOWN = 6
"""Largest number of values that a summary shows; longer parameters are shown as a range."""

Order = Mapping[str, Sequence[str]]
"""Names of robots and features in order, with the keys `robot` and `feature`."""


class OwnDrift(Protocol):
    """Drift that is not linear in awareness, such as that of a NumPyro function."""

    @property
    def shape(self) -> tuple[int, int] | None:
        """Shape (row, col) of the map on whose cells the drift depends; None if on no cell."""
        ...

    @property
    def values(self) -> Mapping[str, np.ndarray]:
        """Parameters (draw, ...) by name."""
        ...

    def inputs(self, awareness: np.ndarray, bounds: np.ndarray | None = None) -> np.ndarray:
        """See `Draws.inputs`."""
        ...

    def noise_scale(self, awareness: np.ndarray, bounds: np.ndarray) -> np.ndarray:
        """Return the factor (draw, robot, bound) of the noise of rates in `bounds` (bound, 3)."""
        ...

    def draw(self, index: np.ndarray) -> Self:
        """Select draws by an index array."""
        ...

    def mean(self) -> Self:
        """Average over draws; the axis (draw,) of the result has length 1."""
        ...

    def require_order(self, own: Order, wanted: Order) -> None:
        """Raise TrustboError unless the drift is that of robots and features in this order.

        Some of the robots may be left out.
        """
        ...

    def of_robots(self, which: Sequence[int]) -> Self:
        """Select some of the robots, by position.

        Raises TrustboError if their drift depends on the other robots.
        """
        ...


@dataclass(frozen=True, eq=False, repr=False)
class Draws(Summary):
    """Draws of the parameters of a trust model: its equation, and the inputs of bounds.

    All arrays have the leading axis (draw,); a mean has one draw. Parameters can be read by name,
    such as `draws.beta0`. Inputs are computed when they are needed, for the bounds of a path or for
    all bounds of a map, because an array (draw, robot, move, row, col) of a large map does not fit
    in memory.

    Attributes:
        arrays: Parameters (draw, ...) by name: those of the equation (arguments of
            `independent_robots` or `coupled_robots`, or fields of `StateSpace`), feature weights
            `beta` or `B`, the intercept `b`, and effects of places `place` and `place_bound`.
        own: Drift that is added to the linear inputs, or None.
        place_robot: Effects of robots in bounds, or None.
        robots: Names of the robots, in the order of the arrays; None if they are not known.
        features: Names of the features, in the order of the arrays; None if they are not known.
        memory: Quantity carried over between bounds, `"level"` or `"deviation"`; see `PooledTrust`.
        family: Name of the observation family of the contact rates; see `PooledTrust`.
    """

    arrays: Mapping[str, np.ndarray]
    own: OwnDrift | None = None
    place_robot: RobotsInBounds | None = None
    robots: Names | None = None
    features: Names | None = None
    memory: str = "level"
    family: str = "gaussian"

    def __getattr__(self, name: str) -> np.ndarray:
        # Copies and unpickled objects are asked for special names before they have any field.
        if not name.startswith("_") and name in self.values:
            return self.values[name]
        raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")

    def _rows(self) -> Rows:
        n = self.n_draws
        rows = [("draws", f"{n} draws, mean +- sd" if n > 1 else "one draw")]
        return rows + [(name, _written(value)) for name, value in self.values.items()]

    @property
    def values(self) -> Mapping[str, np.ndarray]:
        """Parameters (draw, ...) by name; those of a function are its variables."""
        return self.arrays if self.own is None else self.own.values

    @property
    def likelihood(self) -> Family:
        """Observation family of the contact rates."""
        return FAMILIES[self.family]

    @property
    def n_draws(self) -> int:
        """Number of draws."""
        return len(self._first)

    @property
    def _first(self) -> np.ndarray:
        """Transition matrix or autoregression coefficient, which is the first parameter."""
        return next(iter(self.arrays.values()))

    @property
    def n_robots(self) -> int | None:
        """Number of robots; None if the parameters are the same for all robots."""
        if self.own is not None:
            return len(self.robots or ())
        if self.place_robot is not None:
            return self.place_robot.n_robots
        if self.arrays["b"].ndim > 1:
            return self.arrays["b"].shape[1]
        n = max((self.arrays[name].shape[1] for name in PLACES if name in self.arrays), default=1)
        return n if n > 1 else None

    @property
    def n_features(self) -> int:
        """Number of features."""
        if self.own is not None:
            return len(self.features or ())
        return self.arrays["B"].shape[1] if "B" in self.arrays else self.arrays["beta"].shape[-1]

    @property
    def by_robot(self) -> bool:
        """Whether the robots' mean trust does not obey the equation of a single robot."""
        return self._first.size > self.n_draws

    @property
    def grid_shape(self) -> tuple[int, int] | None:
        """Shape (row, col) of the map on whose cells the inputs depend; None if on no cell."""
        for name in PLACES:
            if name in self.arrays:
                return self.arrays[name].shape[-2:]
        return self.own.shape if self.own is not None else None

    @property
    def n_ways(self) -> int | None:
        """Number of ways into a cell for which the inputs have effects; None without effects."""
        return self.arrays["place_bound"].shape[-3] if "place_bound" in self.arrays else None

    @property
    def carried(self) -> bool:
        """Whether the inputs of a bound are carried over to later bounds (see `statespace`)."""
        return self.memory == "level"

    @property
    def initial_offset(self) -> np.ndarray:
        """Offset (draw,) before the first bound, so that trust is x0_mean in any case."""
        return np.zeros(self.n_draws) if self.carried else self.arrays["x0_mean"]

    def require_valid(self, n_robots: int, n_features: int) -> None:
        """Raise TrustboError if the draws are for other numbers of robots or features."""
        own = {"robots": self.n_robots, "features": self.n_features}
        for what, given in {"robots": n_robots, "features": n_features}.items():
            if own[what] not in (None, given):
                raise TrustboError(
                    f"the parameters are for {own[what]} {what}, not {given}; give parameters of "
                    f"the same {what}."
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
        robots with any names. Robots that are not named are left out; the values of the others do
        not change. If noise depends on the predicted line of sight (`f_v`), its mean is then that
        of the robots that are left.

        Raises:
            TrustboError: The draws lack a robot, the names of the features differ, or robots are
                left out of a model in which they influence each other.
        """
        wanted = {"robot": tuple(robots), "feature": tuple(features)}
        own = {
            "robot": wanted["robot"] if self.n_robots is None else self.robots or wanted["robot"],
            "feature": self.features or wanted["feature"],
        }
        if self.own is not None:
            self.own.require_order(own, wanted)

        order = {axis: _positions(axis, own[axis], names) for axis, names in wanted.items()}
        if len(wanted["robot"]) < len(own["robot"]):
            return self._of_robots(order["robot"] or [], own).in_order(robots, features)

        order |= dict.fromkeys(("robot_", "effect"), order["robot"])
        order |= dict.fromkeys(("move", "row", "col"))
        arrays = dict(self.arrays)
        for name, value in self.arrays.items():
            axes = _AXES.get(name, ())[1 - value.ndim :] if value.ndim > 1 else ()
            for i, axis in enumerate(axes, start=-len(axes)):
                turn = order[axis]
                if turn is not None and value.shape[i] > 1:
                    arrays[name] = np.take(arrays[name], turn, axis=i)

        in_bounds = self.place_robot
        if in_bounds is not None and order["robot"] is not None:
            in_bounds = in_bounds._replace(known=in_bounds.known[:, order["robot"]])
        names = {"robots": wanted["robot"], "features": wanted["feature"]}
        return self._with(arrays=arrays, place_robot=in_bounds, **names)

    def _of_robots(self, which: Sequence[int], own: Order) -> Self:
        """Select some of the robots, which are named in `own`, by position."""
        names = [own["robot"][i] for i in which]
        if "B0" in self.arrays:
            raise TrustboError(_influenced("CoupledTrust", own["robot"], names))

        arrays = dict(self.arrays)
        for name, value in self.arrays.items():
            axes = _AXES.get(name, ())[1 - value.ndim :] if value.ndim > 1 else ()
            for i, axis in enumerate(axes, start=-len(axes)):
                if axis in ("robot", "effect") and value.shape[i] > 1:
                    arrays[name] = np.take(arrays[name], which, axis=i)

        if "transition" in arrays:
            space = StateSpace(**{n: v for n, v in arrays.items() if n in StateSpace._fields})
            if not space.is_uncoupled:
                raise TrustboError(_influenced("the function", own["robot"], names))
            kept = space.of_robots(which)._asdict()
            arrays |= {name: value for name, value in kept.items() if value is not None}

        return self._with(
            arrays=arrays,
            own=self.own and self.own.of_robots(which),
            place_robot=self.place_robot and self.place_robot.of_robots(which),
            robots=tuple(names),
            features=tuple(own["feature"]),
        )

    def state_space(self, n_robots: int, *, adds_noise: bool = True) -> StateSpace:
        """Return the model's equation at each draw.

        Args:
            n_robots: Number of robots.
            adds_noise: Whether the observation family adds noise (see `coupled_robots`).
        """
        require_switch("adds_noise", adds_noise)
        form: dict[str, Any] = {n: v for n, v in self.arrays.items() if n not in _OF_INPUTS}
        if "transition" in form:
            return StateSpace(**form)
        if not self.carried:
            form["x0_mean"] = 0.0

        if "B0" in form:
            return coupled_robots(**form, adds_noise=adds_noise)
        return independent_robots(**form, n_members=n_robots if "delta_s" in form else 1)

    def inputs(self, awareness: np.ndarray, bounds: np.ndarray | None = None) -> np.ndarray:
        """Compute the input u of bounds, which is carried over to later bounds if `carried`.

        The linear input is u = sum_m beta_m z_m + b, with any effects of places.

        Args:
            awareness: Situational awareness, shape (robot, move, row, col, feature) of all bounds
                of a map, or (robot, bound, feature) of `bounds`. There are no inputs where it is
                NaN.
            bounds: Moves, rows and columns (bound, 3); a move is -1 if the bound is not known.

        Returns:
            Inputs (draw, robot, move, row, col) or (draw, robot, bound).
        """
        if self.own is None:
            return self._linear_inputs(awareness, bounds)
        u = self.own.inputs(awareness, bounds)
        return u + self._linear_inputs(awareness, bounds) if "b" in self.arrays else u

    def _linear_inputs(self, awareness: np.ndarray, bounds: np.ndarray | None) -> np.ndarray:
        """Compute the inputs without those of `own`."""
        flat = awareness.reshape(len(awareness), -1, awareness.shape[-1])
        b = self.arrays["b"]
        if "B" in self.arrays:
            u = np.einsum("...mai,...ikm->...ak", self.arrays["B"], flat)
        elif b.ndim > 1:
            u = np.einsum("...im,...ikm->...ik", self.arrays["beta"], flat)
        else:
            u = np.tensordot(self.arrays["beta"], flat, (-1, -1))
        u += b.reshape(len(b), -1, 1)  # in place, because the array may be large
        if bounds is not None:
            return u + self._at_places(bounds) if self.grid_shape else u

        u = u.reshape(*u.shape[:2], *awareness.shape[1:-1])
        if "place" in self.arrays:  # the effect of a cell is the same for all moves that enter it
            u = u + self.arrays["place"][:, :, None]
        if "place_bound" in self.arrays:
            u = u + self.arrays["place_bound"]
        return u if self.place_robot is None else u + self.place_robot.everywhere()

    def _at_places(self, bounds: np.ndarray) -> np.ndarray:
        """Return the effects (draw, effect, bound) of places; effects of the move -1 are 0."""
        moves, rows, cols = np.asarray(bounds).T
        total: Any = 0.0
        if "place" in self.arrays:
            total = total + self.arrays["place"][..., rows, cols]
        if "place_bound" in self.arrays:
            total = total + self.arrays["place_bound"][..., moves, rows, cols]

        total = np.where(moves < 0, 0.0, total)
        return total if self.place_robot is None else total + self.place_robot.at(bounds)

    def team_inputs(self, awareness: np.ndarray, bounds: np.ndarray | None = None) -> np.ndarray:
        """Compute the mean of `inputs` over robots, with the axis (robot,) of length 1."""
        if self.own is None and self.arrays["b"].ndim == 1:  # the weights apply to the mean
            awareness = awareness.mean(0, keepdims=True)
        return self.inputs(awareness, bounds).mean(1, keepdims=True)

    def along(self, awareness: np.ndarray, bounds: np.ndarray, space: StateSpace) -> list[Inputs]:
        """Return the inputs (draw, group, member) of each bound of a path.

        Args:
            awareness: Awareness of the bounds, shape (robot, bound, feature).
            bounds: See `inputs`.
            space: Equation of the draws; see `state_space`.
        """
        u = self.inputs(awareness, bounds)
        shape = len(u), *awareness.shape[:2]
        u = np.broadcast_to(u, shape)
        noise = np.broadcast_to(self.noise_scale(awareness, bounds), shape)

        found = []
        for k in range(shape[2]):
            of_bound = space.grouped(u[..., k])
            drift, offset = (of_bound, 0.0) if self.carried else (0.0, of_bound)
            found.append(Inputs(drift, offset, space.grouped(noise[..., k])))
        return found

    def noise_scale(self, awareness: np.ndarray, bounds: np.ndarray) -> Any:
        """Return the factor (draw, robot or 1, bound) of the noise of rates in some bounds, or 1.

        The arguments are those of `along`.
        """
        if self.own is not None:
            return self.own.noise_scale(awareness, bounds)
        if "f_v" not in self.arrays:
            return 1.0

        sight = sight_columns(self.features or ())
        if not sight:
            raise TrustboError(
                "f_v needs the names of the features, of which one is line_of_sight; got "
                f"features={self.features}."
            )
        of_team = awareness[..., sight].mean((0, -1))
        return scale_at(variation(of_team), self.arrays["f_v"][:, None, None])

    def draw(self, index: Any) -> Self:
        """Select draws by number, by a list of numbers or by a slice."""
        some = np.atleast_1d(np.arange(self.n_draws)[index])
        return self._with(
            arrays={name: value[some] for name, value in self.arrays.items()},
            own=self.own and self.own.draw(some),
            place_robot=self.place_robot and self.place_robot.draw(some),
        )

    def mean(self) -> Self:
        """Average the equation and the inputs over all draws; the result has one draw."""
        return self._with(
            arrays={name: value.mean(0, keepdims=True) for name, value in self.arrays.items()},
            own=self.own and self.own.mean(),
            place_robot=self.place_robot and self.place_robot.mean(),
        )

    def record(self) -> dict[str, Any]:
        """Return a description for files, as plain values; without effects of robots in bounds."""
        record: dict[str, Any] = {name: value.tolist() for name, value in self.values.items()}
        return record if self.carried else {**record, "memory": self.memory}

    def _with(self, **fields: Any) -> Self:
        """Return a copy with other values of some fields."""
        changed = copy(self)
        vars(changed).update(fields)
        return changed


class NextMission(NamedTuple):
    """Draws for the next mission, with the effects of robots in it expected or drawn.

    Attributes:
        expected: Draws with expected effects and without those of robots in bounds, for planning.
        drawn: Draws with effects drawn at random and those of robots in bounds, for intervals.
    """

    expected: Draws
    drawn: Draws

    def of_robots(self, *, expected: bool) -> Draws:
        """Return draws for trust in single robots, with the effects of robots in bounds."""
        if expected:
            return self.expected._with(place_robot=self.drawn.place_robot)
        return self.drawn


def _influenced(model: str, robots: Sequence[str], given: Sequence[str]) -> str:
    """Return a message that some robots cannot be left out of a model."""
    return (
        f"in {model}, the trust in a robot depends on the other robots, so all of "
        f"{', '.join(robots)} must take part, not only {', '.join(given)}; use a model without "
        "such influence, such as PooledTrust()."
    )


def _positions(axis: str, own: Sequence[str], wanted: Sequence[str]) -> list[int] | None:
    """Return the position of each wanted name; None if they are in order.

    Raises TrustboError if the names differ; robots may be left out.
    """
    if axis == "robot" and len(wanted) < len(own) and set(wanted) <= set(own):
        return [list(own).index(name) for name in wanted]
    if sorted(own) != sorted(wanted):
        raise TrustboError(
            f"the parameters have the {axis}s {', '.join(own)}, not {', '.join(wanted)}; give "
            "parameters of the same names."
        )
    order = [list(own).index(name) for name in wanted]
    return None if order == sorted(order) else order


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
