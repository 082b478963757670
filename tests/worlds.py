"""Workspaces, terrains and simulators made for tests."""

import dataclasses
import warnings
from itertools import pairwise

import numpy as np
import xarray as xr
from missions import TRUTH, draw_rates

from trustbo.data import Mission
from trustbo.terrain import synthetic_terrain
from trustbo.terrain.read import read_terrain
from trustbo.workspace import Workspace
from trustbo.workspace.moves import MOVE_NAMES, MOVES

CORNER = np.array([100.0, 500.0])  # of `terrain_of`: x of the left edge, y of the top, m


def random_cells(n_robots=3, n=4):
    """A workspace of n x n cells with two features, all awareness drawn at random."""
    return Workspace.from_awareness(np.random.default_rng(0).uniform(size=(n_robots, n, n, 2)))


def terrain_of(dem, height=0.0, resolution=1.0):
    """A terrain of ground heights (row, col) and canopy heights above them, m."""
    rows, cols = dem.shape
    coords = {
        "y": CORNER[1] - (np.arange(rows) + 0.5) * resolution,
        "x": CORNER[0] + (np.arange(cols) + 0.5) * resolution,
    }
    dem = xr.DataArray(dem.astype(float), coords, ("y", "x")).rio.write_crs("EPSG:32633")
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "the DSM lies")  # a canopy of one height is meant
        return read_terrain(dem, dem + height)


def hillside(height=90.0, width=90.0):
    """A small wooded terrain, m; cells of 30 m suit it."""
    return synthetic_terrain((height, width), seed=5, relief=6.0)


def unequal_robots(*, blocked=()):
    """A workspace of 3 rows and 4 columns; were two robots mixed up, a result would show it."""
    workspace = Workspace.from_terrain(hillside(90.0, 120.0), (3, 4), n_posts=1)
    passable = workspace.passable.copy()
    for cell in blocked:
        passable[cell] = False
    awareness = workspace.awareness * np.array([1.0, 0.8, 0.5])[:, None, None, None, None]
    return dataclasses.replace(workspace, passable=passable, awareness=awareness)


class ModelSimulator:
    """Draws contact rates from the trust model with known parameters."""

    def __init__(self, workspace, truth=TRUTH, fail_at=None, blind=False):
        self.workspace, self.truth, self.fail_at, self.blind = workspace, truth, fail_at, blind

    def run(self, path, *, seed, mission=0):
        z = self.workspace.along(path)
        status = "ok"
        if self.fail_at is not None:
            z, status = z[: self.fail_at], "stuck"
        sample = draw_rates(self.truth, z[None], seed=seed)
        if self.blind:
            z = np.full_like(z, np.nan)
        rates = np.clip(sample[0], 0.0, 1.0)
        return Mission.from_arrays(path, z, rates, duration=np.full(len(z), 30.0), status=status)


def contact_along(truth, path):
    """Expected contact (bound,) of a path in a `Truth`, read from its table of bounds."""
    moves = [
        MOVE_NAMES[MOVES.index((row - before[0], col - before[1]))]
        for before, (row, col) in pairwise(path)
    ]
    table = truth.bounds["contact"]
    return np.array(
        [
            float(table.sel(move=move, next_move=onward)[tuple(cell)])
            for move, onward, cell in zip(moves, [*moves[1:], "end"], path[1:], strict=True)
        ]
    )


class Steady:
    """Random numbers of a world without chance: no slip, and every look finds what it may."""

    def standard_normal(self, size):
        return np.zeros(size)

    def random(self, size):
        return np.full(size, 0.5)
