"""Terrains of studies, as plain settings."""

import hashlib
from abc import ABC, abstractmethod
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, cast

import numpy as np

from trustbo import terrain
from trustbo.campaign.loop import path_class
from trustbo.errors import TrustboError, require_pair, require_whole
from trustbo.planning import Planner
from trustbo.study.parts import Part
from trustbo.team import Team
from trustbo.workspace import Location, Workspace, survey
from trustbo.workspace.location import CELL, named

EACH_RUN = "run"
"""Seed of a terrain that differs between runs: it takes the run's seed."""


@dataclass(frozen=True, kw_only=True)
class Terrain(Part, ABC):
    """Planning grid of a run, with start and goal; by default from bottom left to top right."""

    shape: tuple[int, int] = (10, 10)
    start: Location | None = None
    goal: Location | None = None
    n_robots: int = 3

    def __post_init__(self) -> None:
        rows, cols = require_pair("shape", self.shape)
        for name, corner in (("start", (rows - 1, 0)), ("goal", (0, cols - 1))):
            cell = corner if getattr(self, name) is None else getattr(self, name)
            found = named(name, cell)
            # As JSON and hashes can hold it.
            object.__setattr__(self, name, found.values if found.names == CELL else found.text)
        object.__setattr__(self, "shape", (rows, cols))
        require_whole("n_robots", self.n_robots, 1)

    @property
    def ends(self) -> tuple[Location, Location]:
        """Start and goal."""
        return cast(Location, self.start), cast(Location, self.goal)

    def at(self, seed: int) -> "Terrain":
        """Terrain of the run with this seed."""
        each = getattr(self, "seed", 0) == EACH_RUN
        return replace(self, **{"seed": seed}) if each else self

    def workspace(self) -> Workspace:
        """Workspace, which is made once per process, for a few terrains."""
        return _workspace(self)

    @abstractmethod
    def make(self) -> Workspace:
        """Make the workspace anew."""

    def judged_by(self, planner: Planner) -> dict[str, Any]:
        """Paths that regret is held against, see `path_class`."""
        return path_class(planner)


@dataclass(frozen=True, kw_only=True)
class SyntheticTerrain(Terrain):
    """Synthetic terrain, see `terrain.synthetic_terrain`; `seed` may be `"run"`."""

    kind = "synthetic"
    size: tuple[float, float] = (500.0, 500.0)
    resolution: float = 1.0
    seed: int | str = 0
    relief: float = 30.0
    hurst: float = 0.9
    canopy_cover: float = 0.4
    canopy_height: float = 6.0

    def __post_init__(self) -> None:
        super().__post_init__()
        _require_seed(self.seed)

    def make(self) -> Workspace:
        """Make the workspace anew."""
        own = asdict(self)
        for name in ("shape", "start", "goal", "n_robots"):
            del own[name]
        ground = terrain.synthetic_terrain(**own)
        return Workspace.from_terrain(ground, self.shape, Team(n_robots=self.n_robots))


@dataclass(frozen=True, kw_only=True)
class FileTerrain(Terrain):
    """DEM and DSM from files, see `terrain.read_terrain`."""

    kind = "files"
    REQUIRED = ("dem", "dsm")
    dem: str
    dsm: str
    crs: str | None = None
    resolution: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("dem", "dsm"):
            path = Path(getattr(self, name)).absolute()
            if not path.is_file():
                raise TrustboError(f"{name}: there is no file {str(path)!r}.")
            object.__setattr__(self, name, str(path))

    def identity(self) -> dict[str, Any]:
        """Settings with hashes instead of file names: a study may move to another machine."""
        return self.settings() | {name: _digest(getattr(self, name)) for name in ("dem", "dsm")}

    def make(self) -> Workspace:
        """Make the workspace anew."""
        ground = terrain.read_terrain(self.dem, self.dsm, crs=self.crs, resolution=self.resolution)
        team = Team(n_robots=self.n_robots)
        found = survey(ground, self.shape, team)
        for name, end in zip(("start", "goal"), self.ends, strict=True):
            found.require_cell(name, end)  # before awareness is computed
        return Workspace.from_terrain(ground, self.shape, team)


@dataclass(frozen=True, kw_only=True)
class RandomAwareness(Terrain):
    """Awareness drawn uniformly for each cell, the same for every robot, without a terrain.

    `seed` may be `"run"`.
    """

    kind = "random"
    seed: int | str = 0
    n_features: int = 2

    def __post_init__(self) -> None:
        super().__post_init__()
        _require_seed(self.seed)
        require_whole("n_features", self.n_features, 1)

    def make(self) -> Workspace:
        """Make the workspace anew."""
        rng = np.random.default_rng(cast(int, self.seed))
        z = rng.uniform(size=(*self.shape, self.n_features))
        return Workspace.from_awareness(np.repeat(z[None], self.n_robots, axis=0))


TERRAINS = (SyntheticTerrain, FileTerrain, RandomAwareness)


@lru_cache(maxsize=4)
def _workspace(part: Terrain) -> Workspace:
    return part.make()


@lru_cache(maxsize=64)
def _digest(path: str) -> str:
    with open(path, "rb") as file:
        return "sha256:" + hashlib.file_digest(file, "sha256").hexdigest()


def _require_seed(seed: object) -> None:
    if seed != EACH_RUN:
        require_whole(f'seed (or "{EACH_RUN}")', seed, 0)
