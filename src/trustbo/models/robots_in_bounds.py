"""Effects of robots in bounds, which are drawn when they are needed."""

from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np
from scipy.special import ndtri

_STEP = np.uint64(0x9E3779B97F4A7C15)
_MIX = (np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB))
_ONE = 2.0**-53  # spacing of the uniform numbers


class RobotsInBounds(NamedTuple):
    """Effects r of robots in the directed bounds of a map, which sum to 0 over robots.

    In visited bounds, the effects are posterior draws. In all other bounds, they are independent
    draws from the prior, g tau_r (n_i - mean n) with standard normal n_i for robot i and the scale
    g = g(f_r) of `PlaceEffect`. An array of the draws in all bounds would be larger than all other
    parameters together, by a factor equal to the number of robots. Therefore, n_i is computed from
    the numbers of the draw, the robot and the bound when it is needed.

    Attributes:
        known: Effects in visited bounds, shape (draw, robot, visited).
        column: Index of the visited bound in `known`, shape (move, row, col); -1 elsewhere.
        tau_r: Standard deviation at the scale 1, shape (draw,).
        scale: Scale g in each bound, shape (move, row, col).
        number: Number of each draw, shape (draw,), which does not change when draws are selected.
        seed: Random seed.
        members: Positions of the robots that take part, in `known`; None for all robots.
    """

    known: np.ndarray
    column: np.ndarray
    tau_r: np.ndarray
    scale: np.ndarray
    number: np.ndarray
    seed: int
    members: np.ndarray | None = None

    @property
    def n_robots(self) -> int:
        """Number of robots that take part."""
        return self.known.shape[1] if self.members is None else len(self.members)

    def of_robots(self, which: Sequence[int]) -> Self:
        """Select some of the robots, by position; their effects stay as they are."""
        every = np.arange(self.known.shape[1]) if self.members is None else self.members
        return self._replace(members=every[list(which)])

    def at(self, bounds: np.ndarray) -> np.ndarray:
        """Return the effects (draw, robot, bound) in the given bounds; for move -1, they are 0.

        Args:
            bounds: Moves, rows and columns, shape (bound, 3).
        """
        which = tuple(np.asarray(bounds).T)
        column = self.column[which]
        bound = np.asarray(np.ravel_multi_index(which, self.column.shape, mode="wrap"))
        effects = self._elsewhere(bound)

        is_known = column >= 0
        effects[..., is_known] = self.known[..., column[is_known]]
        if self.members is not None:
            effects = effects[..., self.members, :]
        return np.where(which[0] < 0, 0.0, effects)

    def _elsewhere(self, bound: np.ndarray) -> np.ndarray:
        """Draw the effects (draw, robot, bound) in bounds that were not visited."""
        n_robots = self.known.shape[-2]
        robot = np.arange(n_robots)[:, None] * self.column.size
        draw = self.number[:, None, None] * n_robots * self.column.size
        n = _standard_normal(draw + robot + bound, self.seed)
        g = self.scale.ravel()[bound]
        return g * self.tau_r[:, None, None] * (n - n.mean(-2, keepdims=True))

    def everywhere(self) -> np.ndarray:
        """Return the effects (draw, robot, move, row, col) in all bounds."""
        bounds = np.indices(self.column.shape).reshape(3, -1).T
        effects = self.at(bounds)
        return effects.reshape(*effects.shape[:-1], *self.column.shape)

    def draw(self, index: np.ndarray) -> Self:
        """Select draws by an index array."""
        return self._replace(
            known=self.known[index],
            tau_r=self.tau_r[index],
            number=self.number[index],
        )

    def mean(self) -> Self:
        """Average over draws; effects are 0 in bounds that were not visited."""
        known = self.known.mean(0, keepdims=True)
        return self._replace(known=known, tau_r=np.zeros(1), number=np.zeros(1, int))


def _standard_normal(counter: np.ndarray, seed: int) -> np.ndarray:
    """Compute standard normal numbers from whole numbers.

    Number i of the generator SplitMix64 (Steele, Lea and Flood 2014) is a function of i alone.
    """
    [first] = np.random.SeedSequence(seed).generate_state(1, np.uint64)
    z = first + _STEP * counter.astype(np.uint64)
    z = (z ^ (z >> np.uint64(30))) * _MIX[0]
    z = (z ^ (z >> np.uint64(27))) * _MIX[1]
    z = z ^ (z >> np.uint64(31))
    return ndtri(((z >> np.uint64(11)) + 0.5) * _ONE)
