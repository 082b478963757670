"""Who sees whom: range, field of view, and what stands between."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit

from trustbo.data import Robot
from trustbo.errors import TrustboError, require_choice
from trustbo.terrain import rays

SIGHT_MODES = {"bare": rays.BARE, "wall": rays.WALL, "transmittance": rays.TRANSMITTANCE}


@dataclass(frozen=True)
class Sight:
    """How terrain and canopy hinder sight.

    The choice matters: on real forest the three modes differ by an order of magnitude.

    Attributes:
        mode: `"bare"`: the ground alone blocks. `"wall"`: the surface blocks, canopy included.
            `"transmittance"`: the ground blocks, and the canopy, a layer from `crown_base` times
            its height to its top, lets exp(-extinction x metres inside) of the beams through.
        extinction: Extinction coefficient of the canopy, 1/m.
        crown_base: Lower edge of the canopy as a share of its height.

    Raises:
        TrustboError: An unknown mode, a negative extinction, a crown base outside [0, 1].
    """

    mode: str = "transmittance"
    extinction: float = 0.1
    crown_base: float = 0.3

    def __post_init__(self) -> None:
        require_choice("sight mode", self.mode, SIGHT_MODES)
        if not self.extinction >= 0.0 or not 0.0 <= self.crown_base <= 1.0:
            raise TrustboError(
                "need extinction >= 0 and crown_base in [0, 1]; got "
                f"{self.extinction} and {self.crown_base}."
            )


class Surface(NamedTuple):
    """The rasters that sight and motion work on, and how positions map to their pixels."""

    ground: np.ndarray  # (row, col), m
    canopy: np.ndarray  # (row, col), m: the DSM
    gradient: np.ndarray  # (2, row, col): dz/dx and dz/dy
    passable: np.ndarray  # (row, col), bool
    pixel: tuple[float, float]  # height, width of a pixel, m
    origin: tuple[float, float]  # x, y of the centre of pixel (0, 0)

    def to_pixel(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Row and column of positions in CRS metres, in fractions of pixels."""
        return (self.origin[1] - y) / self.pixel[0], (x - self.origin[0]) / self.pixel[1]

    def nearest(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Row and column of the pixel each position is in."""
        row, col = self.to_pixel(np.asarray(x), np.asarray(y))
        rows, cols = self.ground.shape
        return (
            np.clip(np.rint(row), 0, rows - 1).astype(int),
            np.clip(np.rint(col), 0, cols - 1).astype(int),
        )


def transmittance(
    surface: Surface,
    sight: Sight,
    sensor: np.ndarray,
    target: np.ndarray,
    sensor_height: float,
    target_height: float,
) -> np.ndarray:
    """Probability that a beam from a sensor reaches a target, whatever their distance.

    Args:
        surface: The terrain.
        sight: What hinders sight.
        sensor: Positions, shape (ray, 2), CRS metres.
        target: Positions, shape (ray, 2), CRS metres.
        sensor_height: m above ground.
        target_height: m above ground.

    Returns:
        Shape (ray,), in [0, 1].
    """

    def end(position: np.ndarray, height: float) -> np.ndarray:
        row, col = surface.to_pixel(position[:, 0], position[:, 1])
        return np.stack([row, col, np.full(len(row), height)], axis=1)

    return _transmittances(
        surface.ground,
        surface.canopy,
        surface.pixel,
        end(sensor, sensor_height),
        end(target, target_height),
        SIGHT_MODES[sight.mode],
        sight.extinction,
        sight.crown_base,
    )


def in_view(
    surface: Surface, robot: Robot, sensor: np.ndarray, target: np.ndarray, target_height: float
) -> np.ndarray:
    """Whether targets are within a robot's lidar range and vertical field of view.

    The field of view tilts with the robot, which stands parallel to the ground.

    Args:
        surface: The terrain.
        robot: Whose lidar.
        sensor: The robot's positions, shape (ray, 2), CRS metres.
        target: Positions, shape (ray, 2), CRS metres.
        target_height: Height of the target above ground, m.

    Returns:
        Shape (ray,), bool.
    """
    here, there = (surface.nearest(p[:, 0], p[:, 1]) for p in (sensor, target))
    rise = surface.ground[there] + target_height - surface.ground[here] - robot.sensor_height
    d = np.column_stack([target - sensor, rise])
    distance = np.maximum(np.linalg.norm(d, axis=1), 1e-9)
    dz_dx, dz_dy = surface.gradient[:, *here]
    normal = np.column_stack([-dz_dx, -dz_dy, np.ones_like(dz_dx)])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    elevation = np.abs((d * normal).sum(1)) / distance
    return (distance <= robot.lidar_range) & (elevation <= math.sin(robot.vertical_fov))


@njit(cache=True)
def _transmittances(ground, canopy, pixel, start, end, mode, extinction, crown_base):
    result, work = np.empty(len(start)), rays.work_space()
    for i in range(len(start)):
        # The outer half of the raster's edge pixels has the heights of their centres.
        r0, c0 = _inward(start[i, 0], ground.shape[0]), _inward(start[i, 1], ground.shape[1])
        r1, c1 = _inward(end[i, 0], ground.shape[0]), _inward(end[i, 1], ground.shape[1])
        z0 = rays.ground_height(ground, r0, c0) + start[i, 2]
        z1 = rays.ground_height(ground, r1, c1) + end[i, 2]
        result[i] = rays.ray_transmittance(
            ground, canopy, pixel, (r0, c0, z0), (r1, c1, z1), mode, extinction, crown_base, work
        )
    return result


@njit(cache=True)
def _inward(x, n):
    return min(max(x, 0.0), n - 1.0) if -0.5 <= x <= n - 0.5 else x
