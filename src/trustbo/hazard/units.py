"""Units of the hazard: the options of a bound that pass or fail together, and their maps.

An option of a bound is a set of posts from which T2 watches it, and the next way. Options of one
bound with the same steepest route form a unit, and have one failure probability. For example, if
two sets of posts lead T2 over the same slope, they are one unit. A unit is named by its move, row,
column and first option. Values of units are computed once, and then spread over the maps that
planners read, which are by way and next way; see `workspace.moves` for these words.
"""

import numpy as np

from trustbo.workspace.moves import by_option, by_way


class Units:
    """Units of all bounds of a workspace.

    Attributes:
        named: Move, row, column and first option of each unit, shape (unit, 4).
    """

    def __init__(self, unit: np.ndarray, n_posts: int) -> None:
        """Number the units.

        Args:
            unit: First option of the unit of each bound and next way, shape (way, row, col,
                next_way); -1 where there is no bound (see `Measured.unit`).
            n_posts: Number of sets of posts.
        """
        first = by_option(unit)  # (move, row, col, option)
        self.named = np.argwhere(first == np.arange(first.shape[-1]))

        # First options have their own number, and other options that of their first option.
        number = np.full(first.shape, -1)
        number[*self.named.T] = np.arange(len(self.named))
        of_first = np.take_along_axis(number, np.maximum(first, 0), -1)
        self._number = np.where(first >= 0, of_first, -1)
        self._n_posts = n_posts

    def on_maps(self, values: np.ndarray) -> np.ndarray:
        """Return values (..., unit) as maps (..., way, row, col, next_way); NaN without a bound."""
        nowhere = np.full((*values.shape[:-1], 1), np.nan)
        values = np.concatenate([values, nowhere], axis=-1)  # the number -1 is the last one
        if not self._is_one_per_bound:
            return values[..., by_way(self._number, self._n_posts)]

        # Select a value for each bound, not for each option, of which there may be many more.
        of_bounds = values[..., self._number.max(-1)]
        maps = np.broadcast_to(of_bounds[..., None], (*of_bounds.shape, self._number.shape[-1]))
        return by_way(maps, self._n_posts)

    @property
    def _is_one_per_bound(self) -> bool:
        """Whether all options of each bound are one unit, as without a terrain."""
        same = self._number == self._number.max(-1, keepdims=True)
        return bool((same | (self._number < 0)).all())
