"""Poses of robots at positions: x, y and heading, rad from the x axis."""

import numpy as np


def onward(positions: np.ndarray) -> np.ndarray:
    """Poses at positions (point, 2), each towards the next, shape (point, 3)."""
    steps = np.diff(positions, axis=0)
    return towards(positions, np.concatenate([steps, steps[-1:]]))


def towards(positions: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Poses at positions (point, 2) in the directions of steps (point, 2), shape (point, 3)."""
    return np.column_stack([positions, np.arctan2(steps[:, 1], steps[:, 0])])
