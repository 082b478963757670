"""Connected regions of passable pixels, used by posts, routes, planner and simulator.

Two pixels are in one region if a chain of passable pixels that share edges connects them. Routes do
not pass between two impassable pixels or round the corner of one (see `routes`), so a route between
two pixels exists if and only if they are in the same region.
"""

from typing import Any

import numpy as np
from scipy import ndimage

Window = tuple[int, int, int, int]
"""First and end row, then first and end column, of pixels."""


def largest_region(passable: np.ndarray) -> np.ndarray:
    """Return a mask of the largest region of passable pixels, (row, col)."""
    regions: Any = ndimage.label(passable)
    labels, n_regions = regions
    if n_regions == 0:
        return passable
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    return labels == np.argmax(sizes)


def linked_to(passable: np.ndarray, window: Window, pixel: tuple[int, ...]) -> np.ndarray:
    """Return a mask of a window's passable pixels that are connected within it to one of them."""
    top, bottom, left, right = window
    inside = passable[top:bottom, left:right]
    regions: Any = ndimage.label(inside)
    return inside & (regions[0] == regions[0][pixel[0] - top, pixel[1] - left])
