"""Regions of passable pixels: the labelling that posts, routes, planner and simulator share.

Two pixels are in one region if a chain of passable pixels that share edges links them. Routes pass
neither between two impassable pixels nor round the corner of one (see `routes`), so that they link
the same pixels: a route exists exactly within a region.
"""

from typing import Any

import numpy as np
from scipy import ndimage

Window = tuple[int, int, int, int]
"""First and end row, then first and end column, of pixels."""


def largest_region(passable: np.ndarray) -> np.ndarray:
    """Mask of the largest region of passable pixels, (row, col); no route leaves it."""
    regions: Any = ndimage.label(passable)
    labels, n_regions = regions
    if n_regions == 0:
        return passable
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    return labels == np.argmax(sizes)


def linked_to(passable: np.ndarray, window: Window, pixel: tuple[int, ...]) -> np.ndarray:
    """Mask of the passable pixels of a window, (row, col), linked to one of them within it."""
    top, bottom, left, right = window
    inside = passable[top:bottom, left:right]
    regions: Any = ndimage.label(inside)
    return inside & (regions[0] == regions[0][pixel[0] - top, pixel[1] - left])
