"""Strata: the posterior failure probabilities as a small mixture, for the cost of a failure.

Bounds fail together where they share an uncertain slope limit. Given the hyperparameters, they fail
independently, so that a path fails with probability

    E[1 - prod_k (1 - p_k)] = mean over draws of 1 - prod_k (1 - E[p_k | draw]).

Strata are groups of draws, from mild to severe, each treated as one draw with the mean
probabilities of its members, so that a search needs only a sum over a few strata.
"""

from typing import NamedTuple

import numpy as np

MOST = 5
"""Default number of strata; labels of the path search hold one sum for each."""


class Strata(NamedTuple):
    """Failure probabilities under each group of draws."""

    p_fail: np.ndarray
    """Mean failure probability, (stratum, move, row, col), NaN where there is no bound."""
    shares: np.ndarray
    """Share of the draws, (stratum,); they add up to 1."""


def partition(values: np.ndarray, n: int) -> np.ndarray:
    """Split sorted values (value,) into at most `n` groups with the least squared deviations.

    The optimal partition in one dimension, by dynamic programming (Fisher 1958). Group k is
    values[ends[k - 1] : ends[k]]; quantiles would mix the few severe draws with mild ones. Time and
    memory grow with the square of the number of values.
    """
    size = len(values)
    total, squares = (np.concatenate([[0.0], np.cumsum(v)]) for v in (values, values**2))
    first, last = np.meshgrid(np.arange(size + 1), np.arange(size + 1), indexing="ij")
    count = np.maximum(last - first, 1)
    within = squares[last] - squares[first] - (total[last] - total[first]) ** 2 / count
    within[first >= last] = np.inf
    # least[j]: of values[:j] in the groups so far; cut[k, j]: where the last of them begins.
    least, cuts = within[0], []
    for _ in range(min(n, len(np.unique(values))) - 1):
        with_one_more = least[:, None] + within
        cuts.append(with_one_more.argmin(0))
        least = with_one_more.min(0)
    ends = [size]
    for cut in reversed(cuts):
        ends.append(int(cut[ends[-1]]))
    return np.array(ends[::-1])
