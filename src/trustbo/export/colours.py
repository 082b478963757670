"""Colours of robots, and of values in [0, 1], as red, green and blue of 255."""

import numpy as np

Colour = tuple[int, int, int]
ROBOTS: tuple[Colour, ...] = (
    (213, 94, 0), (0, 114, 178), (0, 158, 115), (204, 121, 167), (86, 180, 233), (230, 159, 0),
    (240, 228, 66),
)  # fmt: skip
"""Colours that colour-blind people distinguish (Okabe and Ito 2008), the lead's first."""
VIRIDIS: tuple[Colour, ...] = (
    (68, 1, 84), (72, 36, 117), (65, 68, 135), (53, 95, 141), (42, 120, 142), (33, 145, 140),
    (34, 168, 132), (68, 191, 112), (122, 209, 81), (189, 223, 38), (253, 231, 37),
)  # fmt: skip
"""Stops at tenths; linear interpolation is within 14 of 255 of matplotlib's colours."""


def of_robot(index: int) -> Colour:
    """Colour of a robot by its index, 0 for the lead."""
    if index == 0:
        return ROBOTS[0]
    return ROBOTS[1 + (index - 1) % (len(ROBOTS) - 1)]


def of_values(values: np.ndarray) -> np.ndarray:
    """Colours of values (...,) from 0 to 1, those outside as at the ends, (..., 3) uint8."""
    stops = np.linspace(0.0, 1.0, len(VIRIDIS))
    channels = [np.interp(values, stops, channel) for channel in zip(*VIRIDIS, strict=True)]
    return np.rint(np.stack(channels, axis=-1)).astype(np.uint8)
