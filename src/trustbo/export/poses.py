"""Poses of robots at positions: x, y and heading, rad from the x axis."""

import numpy as np


def onward(positions: np.ndarray) -> np.ndarray:
    """Poses at positions (point, 2), each towards the next other one, shape (point, 3)."""
    steps = np.diff(positions, axis=0)
    steps = np.concatenate([steps, steps[-1:]])
    moves = np.where((steps != 0.0).any(1), np.arange(len(steps)), len(steps) - 1)
    return towards(positions, steps[np.minimum.accumulate(moves[::-1])[::-1]])


def towards(positions: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Poses at positions (point, 2) in the directions of steps (point, 2), shape (point, 3)."""
    return np.column_stack([positions, np.arctan2(steps[:, 1], steps[:, 0])])
