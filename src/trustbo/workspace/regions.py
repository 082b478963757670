"""Regions of passable pixels: the labelling that posts, routes, planner and simulator share.

Two pixels are in one region if a chain of passable pixels that share edges links them. Routes pass
neither between two impassable pixels nor round the corner of one (see `routes`), so that they link
the same pixels: a route exists exactly within a region.
"""

from typing import Any

import numpy as np
from numba import njit
from scipy import ndimage

from trustbo.parallel import plain

Window = tuple[int, int, int, int]
"""First and end row, then first and end column, of pixels."""
_compiled = njit(cache=True, nogil=True, error_model="numpy")


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


def are_linked(
    passable: np.ndarray, window: Window, start: tuple[int, ...], goal: tuple[int, ...]
) -> bool:
    """Whether two pixels of a raster (row, col) are in one region within a window."""
    top, bottom, left, right = window
    ends = (start[0] - top, start[1] - left), (goal[0] - top, goal[1] - left)
    return bool(_flood(plain(passable[top:bottom, left:right]), *ends))


@_compiled
def _flood(passable, start, goal):
    """Breadth-first search from one pixel until it meets the other."""
    rows, cols = passable.shape
    for r, c in (start, goal):
        if not (0 <= r < rows and 0 <= c < cols and passable[r, c]):
            return False
    seen = np.zeros(rows * cols, np.bool_)
    queue = np.empty(rows * cols, np.int32)
    queue[0], seen[start[0] * cols + start[1]] = start[0] * cols + start[1], True
    first, last, wanted = 0, 1, goal[0] * cols + goal[1]
    while first < last:
        c = queue[first]
        first += 1
        if c == wanted:
            return True
        i, j = c // cols, c % cols
        for dr, dc in ((-1, 0), (1, 0), (0, -1), (0, 1)):
            r, k = i + dr, j + dc
            if 0 <= r < rows and 0 <= k < cols and passable[r, k] and not seen[r * cols + k]:
                seen[r * cols + k] = True
                queue[last] = r * cols + k
                last += 1
    return False
