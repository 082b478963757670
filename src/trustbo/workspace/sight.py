"""Sight between robots, limited by range, field of view, ground and canopy."""

import math
from dataclasses import dataclass
from functools import cache
from typing import Self

import numpy as np

from trustbo.errors import require_kind, require_positive, require_share
from trustbo.kernels import kernel, part
from trustbo.parallel import plain
from trustbo.team import Robot
from trustbo.terrain import rays
from trustbo.terrain.pixels import index_within, row_and_col
from trustbo.workspace.surface import Surface

_compiled = kernel()
_part = part()

_JITTER = 0.7  # radius of the disc of viewpoints around a post, m
_GOLDEN_ANGLE = 2.4  # between successive viewpoints, rad (Vogel 1979)


@dataclass(frozen=True)
class Sight:
    """Model of sight over terrain and through canopy.

    The ground blocks rays. The canopy is a layer from `crown_base` times its height to its top. A
    ray through d metres of canopy is transmitted with probability exp(-extinction d). If extinction
    is 0, the canopy is transparent; with `math.inf` and a crown base of 0, the canopy is solid.

    Attributes:
        extinction: Extinction coefficient of the canopy, in 1/m.
        crown_base: Lower edge of the canopy as a fraction of its height.

    Raises:
        TrustboError: The extinction is negative, or the crown base is outside [0, 1].

    Example:
        >>> dense = tb.workspace.Sight(extinction=0.3)
        >>> simulator = tb.simulation.KinematicSimulator(workspace, sight=dense)  # the true sight
    """

    extinction: float = 0.1
    crown_base: float = 0.3

    def __post_init__(self) -> None:
        # Kernels are compiled again for whole numbers, and the name of a map differs with them.
        crown_base = require_share("crown_base", self.crown_base)
        is_solid = isinstance(self.extinction, float) and self.extinction == math.inf
        extinction = math.inf
        if not is_solid:
            extinction = require_positive("extinction", self.extinction, or_zero=True)

        object.__setattr__(self, "extinction", extinction)
        object.__setattr__(self, "crown_base", crown_base)

    @classmethod
    def of(cls, sight: Self | None) -> Self:
        """Return the model of sight, by default `Sight()`; raises TrustboError if not a Sight."""
        remedy = "give workspace.Sight(extinction=..., crown_base=...)"
        return cls() if sight is None else require_kind("sight", sight, Sight, remedy)


def optics(watcher: Robot, watched: Robot) -> np.ndarray:
    """Return sensor height, target height and range, in m, and the sine of `vertical_fov`."""
    return np.array([
        watcher.sensor_height,
        watched.target_height,
        watcher.lidar_range,
        math.sin(watcher.vertical_fov),
    ])  # fmt: skip


@cache
def jittered(n: int) -> np.ndarray:
    """Return the offsets of n viewpoints from a post, shape (viewpoint, 2), in metres.

    The view from the exact post is not representative, because a robot stops up to half a metre
    away, and its field of view tilts with the ground. The viewpoints are spread over a disc.
    """
    k = np.arange(n)
    order = np.random.default_rng(0).permutation(n)

    radius = _JITTER * np.sqrt((k + 0.5) / n)
    angle = _GOLDEN_ANGLE * k
    return (radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1))[order]


def detection_probability(
    surface: Surface, sight: Sight, sensor: np.ndarray, target: np.ndarray, view: np.ndarray
) -> np.ndarray:
    """Compute the probability that an ideal lidar detects each target, shape (ray,), in [0, 1].

    The probability is the transmittance along the ray if the target is within the lidar's range and
    vertical field of view, and 0 otherwise. The field of view tilts with the robot. Sensors and
    targets have shape (ray, 2), in CRS metres. `view` has shape (ray, 4) or (4,); see `optics`.
    """
    ends = _ends(
        surface.ground,
        surface.gradient,
        surface.pixel,
        surface.origin,
        sensor,
        plain(target),
        plain(np.broadcast_to(view, (len(sensor), 4))),
    )

    rasters = surface.ground, surface.canopy, surface.pixel
    return rays.transmittances(*rasters, ends, sight.extinction, sight.crown_base)


def detection_between(
    surface: Surface, sight: Sight, eye: np.ndarray, target: np.ndarray, view: np.ndarray
) -> np.ndarray:
    """Compute the detection probability (...) between positions (..., 2), which are broadcast."""
    eye, target = np.broadcast_arrays(eye, target)
    ends = np.ascontiguousarray(eye).reshape(-1, 2), np.ascontiguousarray(target).reshape(-1, 2)
    return detection_probability(surface, sight, *ends, view).reshape(eye.shape[:-1])


@_compiled
def _ends(ground, gradient, pixel, origin, sensor, target, view):
    """Compute row, column and height of both ends of each ray, (ray, 6); see `optics` for `view`.

    The first height is NaN if the target is out of view. The loop is separate from ray tracing so
    that the memory accesses of many rays overlap.
    """
    n_rows, n_cols = ground.shape
    ends = np.empty((len(sensor), 6))

    for i in range(len(sensor)):
        r0, c0 = row_and_col(sensor[i, 0], sensor[i, 1], origin, pixel)
        r1, c1 = row_and_col(target[i, 0], target[i, 1], origin, pixel)
        r0 = _inward(r0, n_rows)
        c0 = _inward(c0, n_cols)
        r1 = _inward(r1, n_rows)
        c1 = _inward(c1, n_cols)

        z0 = rays.bilinear(ground, r0, c0) + view[i, 0]
        z1 = rays.bilinear(ground, r1, c1) + view[i, 1]

        east = (c1 - c0) * pixel[1]
        north = (r0 - r1) * pixel[0]
        up = z1 - z0
        distance = math.sqrt(east**2 + north**2 + up**2)

        row = index_within(r0 + 0.5, n_rows)
        col = index_within(c0 + 0.5, n_cols)
        gx = gradient[0, row, col]
        gy = gradient[1, row, col]

        # Distance from the plane of the robot's body, whose normal is (-gx, -gy, 1).
        above = abs(up - gx * east - gy * north) / math.sqrt(1.0 + gx * gx + gy * gy)
        seen = distance <= view[i, 2] and above <= view[i, 3] * max(distance, 1e-9)

        ends[i, 0] = r0
        ends[i, 1] = c0
        ends[i, 2] = z0 if seen else math.nan
        ends[i, 3] = r1
        ends[i, 4] = c1
        ends[i, 5] = z1

    return ends


@_part
def _inward(x, n):
    """Move a coordinate in the outer half of an edge pixel to the centre of this pixel."""
    return min(max(x, 0.0), n - 1.0) if -0.5 <= x <= n - 0.5 else x
