"""A mixture of a few components, which replaces the posterior of failures in path searches.

Failures of bounds are correlated because the bounds share an uncertain slope limit. Given the
hyperparameters, bounds fail independently, so a path fails with probability

    E[1 - prod_k (1 - p_k)] = mean over draws of 1 - prod_k (1 - E[p_k | draw]).

A component is a group of draws; components are ordered from low to high failure probabilities. Each
group is treated as a single draw with the mean probabilities of its members, so a search needs only
one sum per component.
"""

from typing import NamedTuple

import numpy as np


class Components(NamedTuple):
    """Failure probabilities in each group of draws."""

    p_fail: np.ndarray
    """Mean failure probability, shape (component, way, row, col, next_way); NaN where there is no
    bound."""
    weights: np.ndarray
    """Fraction of the draws in each component, shape (component,); the weights sum to 1."""


def partition(values: np.ndarray, n: int) -> np.ndarray:
    """Split sorted values (value,) into at most `n` groups of similar values.

    Dynamic programming minimises the sum of squared deviations from the group means (Fisher 1958).
    Group k is values[ends[k - 1] : ends[k]], where `ends` is the result. Groups of equal size would
    mix the few largest values with others. Time and memory are quadratic in the number of values.
    """
    size = len(values)
    total = np.concatenate([[0.0], np.cumsum(values)])
    squares = np.concatenate([[0.0], np.cumsum(values**2)])

    # within[i, j] is the sum of squared deviations of values[i:j] from their mean.
    first, last = np.meshgrid(np.arange(size + 1), np.arange(size + 1), indexing="ij")
    count = np.maximum(last - first, 1)
    within = squares[last] - squares[first] - (total[last] - total[first]) ** 2 / count
    within[first >= last] = np.inf

    # least[j] is the optimum for values[:j] in the groups so far; the last begins at cuts[-1][j].
    least = within[0]
    cuts = []
    for _ in range(min(n, len(np.unique(values))) - 1):
        with_one_more = least[:, None] + within
        cuts.append(with_one_more.argmin(0))
        least = with_one_more.min(0)

    # Follow the cuts back from the end of the last group.
    ends = [size]
    for cut in reversed(cuts):
        ends.append(int(cut[ends[-1]]))
    return np.array(ends[::-1])
