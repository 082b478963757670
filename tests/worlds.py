"""Workspaces, terrains and simulators made for tests."""

import dataclasses
import os
import shutil
from pathlib import Path

import numpy as np
import xarray as xr
from missions import TRUTH, draw_rates

import trustbo as tb
from trustbo.data import Mission
from trustbo.terrain import synthetic_terrain
from trustbo.terrain.read import read_terrain
from trustbo.workspace import Workspace

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
    return read_terrain(dem, dem + height)


def hillside(height=90.0, width=90.0):
    """A small wooded terrain, m; cells of 30 m suit it."""
    return synthetic_terrain((height, width), seed=5, relief=6.0)


def unequal_robots(*, blocked=()):
    """A workspace of 3 rows and 4 columns; were two robots mixed up, a result would show it."""
    workspace = Workspace.from_terrain(hillside(90.0, 120.0), (3, 4))
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


def begin(workspace, folder, n):
    """A campaign of n missions in a folder; its robots measure no awareness."""
    return tb.iterate(
        workspace, (3, 0), (0, 3), n_iterations=n, directory=folder, sampler="importance",
        policy="thompson", simulator=ModelSimulator(workspace, blind=True),
        progress=False,
    )  # fmt: skip


def resume_or_begin(workspace, folder, n):
    """The same, going on with what is there."""
    if not (Path(folder) / "campaign.json").exists():
        return begin(workspace, folder, n)
    simulator = ModelSimulator(workspace, blind=True)
    return tb.resume(folder, simulator=simulator, n_iterations=n, progress=False)


def moments_of(folder, copies, monkeypatch):
    """Copy the folder just before each file of it appears or goes, as a kill then leaves it.

    A file that is being written has half of its bytes under its temporary name. Returned is the
    name of the file of each copy, with whether it appears.
    """
    names = [None]

    def watched(change):
        def changes(file, *target, **options):
            if folder in Path(file).parents and Path(file).exists():
                copies.append(copies[0].with_name(f"moment{len(copies)}"))
                shutil.copytree(folder, copies[-1], ignore=shutil.ignore_patterns(".lock"))
                if target:
                    half = Path(file).stat().st_size // 2
                    os.truncate(copies[-1] / Path(file).relative_to(folder), half)
                names.append((Path(*target or [file]).name, bool(target)))
            change(file, *target, **options)

        return changes

    monkeypatch.setattr(os, "replace", watched(os.replace))
    monkeypatch.setattr(Path, "unlink", watched(Path.unlink))
    return names


class Steady:
    """Random numbers of a world without chance: no slip, and every look finds what it may."""

    def standard_normal(self, size):
        return np.zeros(size)

    def random(self, size):
        return np.full(size, 0.5)
