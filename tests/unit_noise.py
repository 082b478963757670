"""Exact moments of what is drawn, for functions that are linear in standard normal numbers.

A function that adds R e to a mean, with standard normal numbers e, gives the mean for e = 0, and
the mean plus a column of R for each unit vector e. Its draws then have the covariance R R'.
"""

import numpy as np


class UnitNoise:
    """Generator whose first point has no noise, and of whose others each has another unit vector.

    The first axis of all numbers is the point; call functions with equal parameters at all points.
    """

    def __init__(self):
        self.n_drawn = 0

    def standard_normal(self, size):
        """Numbers of shape (point, ...)."""
        numbers = np.zeros((size[0], int(np.prod(size[1:]))))
        for point in range(1, size[0]):
            at = point - 1 - self.n_drawn
            if 0 <= at < numbers.shape[1]:
                numbers[point, at] = 1.0
        self.n_drawn += numbers.shape[1]
        return numbers.reshape(size)

    def moments(self, values):
        """Mean and covariance of draws, from the values (point, ...) at all points."""
        assert len(values) > self.n_drawn, f"give {self.n_drawn + 1} points"
        return moments_of(values)


class Unit:
    """Generator of a single point whose number with the given index is 1, and all others are 0."""

    def __init__(self, index=None):
        self.left = -1 if index is None else index

    def standard_normal(self, size):
        """Numbers of this shape."""
        numbers = np.zeros(int(np.prod(size)))
        if 0 <= self.left < numbers.size:
            numbers[self.left] = 1.0
        self.left -= numbers.size
        return numbers.reshape(size)


def moments_of(values):
    """Mean and covariance of draws, from the values (point, ...) without noise and at each unit."""
    values = np.reshape(values, (len(values), -1))
    columns = values[1:] - values[0]
    return values[0], columns.T @ columns
