"""Connected regions of passable pixels, for posts, routes, the planner and the simulator.

Two pixels are in the same region if they are connected by passable pixels that share edges. Routes
do not pass diagonally between two impassable pixels or cut the corner of one (see `routes`). A
route between two pixels therefore exists if and only if the pixels are in the same region.
"""

from typing import Any

import numpy as np
from scipy import ndimage

Window = tuple[int, int, int, int]
"""First and end row, then first and end column, of a window of pixels."""


def largest_region(passable: np.ndarray) -> np.ndarray:
    """Return a mask (row, col) of the largest region of passable pixels."""
    regions: Any = ndimage.label(passable)
    labels, n_regions = regions
    if n_regions == 0:
        return passable
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    return labels == np.argmax(sizes)


def linked_to(passable: np.ndarray, window: Window, pixel: tuple[int, ...]) -> np.ndarray:
    """Return a mask of a window's passable pixels that are connected to `pixel` in the window."""
    top, bottom, left, right = window
    inside = passable[top:bottom, left:right]
    regions: Any = ndimage.label(inside)
    return inside & (regions[0] == regions[0][pixel[0] - top, pixel[1] - left])
