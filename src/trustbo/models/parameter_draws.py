"""Draws of parameters of any model: tuples of arrays with leading axes such as (draw,)."""

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np

from trustbo.data import Cell
from trustbo.display import Rows, Summary
from trustbo.workspace.moves import bounds_along

if TYPE_CHECKING:
    from trustbo.models.params import Params

Numbers = Any
"""A float, a NumPy array, or a JAX array or tracer."""
PLACES: Mapping[str, tuple[str, ...]] = {
    "place": ("effect", "row", "col"),
    "place_bound": ("effect", "move", "row", "col"),
}


class ParameterDraws(Summary):
    """Methods of parameters of every kind; mixed into their tuples."""

    __slots__ = ()

    AXES: ClassVar[Mapping[str, tuple[str, ...]]]
    """Axes of each field behind the leading ones; none where not listed."""
    WEIGHTS: ClassVar[str] = "beta"
    """Name of the field with the weights of features."""
    BY_ROBOT: ClassVar[bool] = False
    """Whether coefficients differ by robot; b then has the axis (robot,)."""
    _fields: ClassVar[tuple[str, ...]]

    def _rows(self) -> Rows:
        n = int(np.prod(self.leading))
        many = f"{n} draws, mean +- sd" if self.leading else "one draw"
        rows: list[tuple[str, str]] = []

        def add(value: Numbers, n_own: int) -> Numbers:
            numbers = np.asarray(value, dtype=float)
            flat = numbers.reshape(-1, *numbers.shape[numbers.ndim - n_own :])
            rows.append((names[len(rows)], _written(flat)))
            return value

        names = list(self.by_name)

        self.map(add)
        return [("draws", many), *rows]

    @property
    def by_name(self) -> dict[str, Numbers]:
        """Values by name; fields that are None left out."""
        values = {name: getattr(self, name) for name in self._fields}
        return {name: value for name, value in values.items() if value is not None}

    @property
    def leading(self) -> tuple[int, ...]:
        """The leading axes, (draw,) or none."""
        name = next(iter(self.AXES))
        shape = np.shape(getattr(self, name))
        return shape[: len(shape) - len(self.AXES[name])]

    @property
    def n_robots(self) -> int | None:
        """Number of robots; None where all share their parameters."""
        return np.shape(self.b)[-1] if self.BY_ROBOT else None  # pyright: ignore

    @property
    def n_features(self) -> int:
        """Number of features."""
        axes = self.AXES[self.WEIGHTS]
        return np.shape(getattr(self, self.WEIGHTS))[axes.index("feature") - len(axes)]

    def transition(self, n_robots: int) -> np.ndarray:
        """B0 of equation (1), shape (..., robot, robot); diagonal where robots do not interact."""
        beta0 = np.asarray(self.beta0, dtype=float)  # pyright: ignore
        if not self.BY_ROBOT:
            beta0 = beta0[..., None]
        return np.broadcast_to(beta0, (*self.leading, n_robots))[..., None] * np.eye(n_robots)

    def expected_transition(self, n_robots: int) -> np.ndarray:
        """Matrix by which expected trust depends on that before, shape of `transition`."""
        return self.transition(n_robots)

    def increments(self, awareness: np.ndarray) -> np.ndarray:
        """Drift without intercept, (..., robot, move, row, col).

        Awareness is (robot, move, row, col, feature), or has a leading axis (draw,) like the
        parameters'.
        """
        raise NotImplementedError

    def alike(self, n_robots: int) -> list[list[int]]:
        """Groups of robots that share their parameters."""
        everyone = list(range(n_robots))
        return [everyone] if self.n_robots is None else [[i] for i in everyone]

    def of_robot(self, robot: int) -> Self:
        """Parameters of one robot, the axis (robot,) dropped."""
        picked = {
            name: np.take(getattr(self, name), robot, axis=axes.index("robot") - len(axes))
            for name, axes in self.AXES.items()
            if "robot" in axes
        }
        for name, value in self.places.items():
            index = (
                slice(robot, robot + 1) if value.shape[-len(self.AXES[name])] > 1 else slice(None)
            )
            picked[name] = np.moveaxis(np.moveaxis(value, -len(self.AXES[name]), 0)[index], 0,
                                       -len(self.AXES[name]))  # fmt: skip
        return self._replace(**picked)  # pyright: ignore[reportAttributeAccessIssue]

    @property
    def places(self) -> dict[str, np.ndarray]:
        """Effects of places in the model, place and place_bound, by name."""
        effects = {name: getattr(self, name, None) for name in PLACES}
        return {name: np.asarray(value) for name, value in effects.items() if value is not None}

    def of_places(self, bounds: np.ndarray) -> np.ndarray:
        """Effect of each bound, that of the cell entered included; shape (..., bound, effect).

        Args:
            bounds: Move, row and column of each bound (bound, 3), moves as in `MOVES[8]`; the
                effect is 0 where the move is negative.
        """
        moves, rows, cols = np.asarray(bounds).T
        total: Any = 0.0
        if "place" in self.places:
            total = total + self.places["place"][..., rows, cols]
        if "place_bound" in self.places:
            total = total + self.places["place_bound"][..., moves, rows, cols]
        return np.swapaxes(np.where(moves < 0, 0.0, total), -1, -2)

    def along(self, path: Sequence[Cell] | np.ndarray) -> Self:
        """Parameters of the bounds of a path, as of one mission in `on`."""
        if not self.places:
            return self
        return self.on(bounds_along(path)[None])

    def on(self, bounds: np.ndarray | None) -> Self:
        """Parameters of given missions: the effects of their bounds' places are in the intercept.

        Args:
            bounds: Move, row and column of each bound, (mission, bound, 3).

        Returns:
            Parameters without places, b (..., mission, bound, robot), the last axis of length 1
            where all robots share it; the same parameters where there are no places.
        """
        if not self.places or bounds is None:
            return self
        effect = self.of_places(bounds.reshape(-1, 3))
        effect = effect.reshape(*effect.shape[:-2], *bounds.shape[:2], effect.shape[-1])
        b = np.asarray(self.b)  # pyright: ignore[reportAttributeAccessIssue]
        b = b[..., None, None, :] if self.BY_ROBOT else b[..., None, None, None]
        return self._replace(b=b + effect, place=None, place_bound=None)  # pyright: ignore

    def with_drift(self, awareness: np.ndarray) -> "Params":
        """Parameters of given missions whose drift is linear in awareness, or an intercept.

        Awareness is (mission, bound, robot, feature), leading axes of the parameters (draw,).
        """
        return self  # pyright: ignore[reportReturnType]

    def draw(self, index: int) -> Self:
        """One draw out of many, with its leading axis dropped."""
        return self.map(lambda value, n: np.asarray(value)[index] if np.ndim(value) > n else value)

    def mean(self) -> Self:
        """Mean over all leading axes."""

        def average(value: Numbers, n: int) -> Numbers:
            core = np.shape(value)[np.ndim(value) - n :]
            mean = np.asarray(value, dtype=float).reshape(-1, *core).mean(0)
            return mean if n else float(mean)

        return self.map(average)

    def flat(self) -> Self:
        """Every field with exactly one leading axis (draw,), float64."""
        leading = self.leading

        def expand(value: Numbers, n: int) -> np.ndarray:
            core = np.shape(value)[np.ndim(value) - n :]
            full = np.broadcast_to(np.asarray(value, dtype=float), leading + core)
            return full.reshape(int(np.prod(leading)), *core)

        return self.map(expand)

    def map(self, function: Callable[[Numbers, int], Numbers]) -> Self:
        """Apply a function to each field and the number of its trailing axes."""
        values = {
            name: function(value, len(self.AXES.get(name, ())))
            for name, value in self.by_name.items()
        }
        return self._replace(**values)  # pyright: ignore[reportAttributeAccessIssue]


def _written(draws: np.ndarray) -> str:
    """Text of the mean and sd over draws (draw, ...) of a field."""
    mean, sd = draws.mean(0), draws.std(0)
    if mean.size > 6:
        return f"{mean.shape}, {mean.min():.3g} to {mean.max():.3g}"
    spread = zip(np.ravel(mean), np.ravel(sd), strict=True)
    return ", ".join(f"{m:.3g}" + (f" +- {s:.2g}" if len(draws) > 1 else "") for m, s in spread)
